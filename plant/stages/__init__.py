"""One stage alone, driven by what the log says went into it, for many parameter sets side by side.

Engine, actuator and linkage of `plant.chain`, with the same functions and effects, on the log's own raster. Parameters
and state are p[row, lane], s[row, lane]; a lane is one parameter set. A few lanes run one after the other, through the
chain; more run in blocks, step by step together, so that the compiler can use vector instructions. Both ways agree to
rounding. A lane with an effect that the blocks do not call, as one just added to `plant.chain`, runs alone: right, but
some five times slower. So does one whose curves differ from its neighbours' in more than their tables. SI; times in s.

The derived rows of ``p`` must be those of the raster: ``derive(p, dt / substeps, dt)``.
"""

from plant.stages.actuator import actuator_run
from plant.stages.bends import run_bends
from plant.stages.currents import step_currents
from plant.stages.engine import engine_run
from plant.stages.linkage import linkage_run
from plant.stages.rings import ring_loads

__all__ = ["actuator_run", "engine_run", "linkage_run", "ring_loads", "run_bends", "step_currents"]
