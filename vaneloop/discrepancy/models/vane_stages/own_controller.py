"""Stage `demand` of a controller of the user's own: the stroke demand that it makes of logged speeds.

Its piston here is the actuator that the calibration's feed-forward assumes, with the speed i_cmd / kff: on the logged
stroke, which answers to another current, its integral would run away and its monitors would stop it.
"""

from __future__ import annotations

import numpy as np

from controller import Calibration, new_inputs, new_outputs, new_state
from controller.records import SLOW, SLOW_TICK, TICK, as_inputs, as_outputs, as_scalars
from hil.native.call import firmware
from plant.effects import ROW
from vaneloop.base.compiled import compiled_free
from vaneloop.discrepancy.models.vane_stages.declared import declared
from vaneloop.discrepancy.models.vane_stages.driven import Driven
from vaneloop.discrepancy.models.vane_stages.raster import lately
from vaneloop.discrepancy.stage import Array, Stage

__all__ = ["own_demand_stage"]

WARM = 200  # frames before the log: the controller comes to RUN and its demand settles
APPROACH = 4.0  # %, from where the demand comes in them: from below, and from above
SAME = 1e-6  # m: what the controller remembers from before the log makes no difference any more


@compiled_free
def _run(
    n_dem: np.ndarray,
    n_r: np.ndarray,
    start: float,
    angles: np.ndarray,
    before: float,
    inputs: np.ndarray,
    outputs: np.ndarray,
    z: np.ndarray,
    calibration: Calibration,
    foreign: object,
    out: np.ndarray,
) -> None:
    """Run a controller on a frame every 10 ms, its piston from ``start`` (m) on: x_dem (m) of every frame.

    before  %, by which the demand begins below the log's first one, `WARM` frames before it
    """
    fed, given = as_inputs(inputs), as_outputs(outputs)
    n, x = len(n_dem), start
    scalars = as_scalars(calibration.k)
    per_ampere = 1.0 / scalars.kff if scalars.kff > 0.0 else scalars.stroke_rate / scalars.current_limit
    for i in range(-WARM, n):
        j = max(i, 0)
        to_go = 0.0 if i >= -WARM // 2 else 2.0 * (-i - WARM // 2) / WARM
        fed.n_dem, fed.n_r = n_dem[j] - before * to_go, n_r[j] - before * to_go
        for q in range(angles.shape[0]):
            fed.pots[q] = angles[q, j]
        for k in range(SLOW):
            fed.demand_fresh = 1.0 if k == 0 else 0.0
            fed.x_lvdt = x
            firmware(inputs, outputs, z, calibration, foreign)
            x = min(max(x + given.i_cmd * per_ampere * TICK, scalars.stroke_min), scalars.stroke_max)
            if k == 0 and i >= 0:
                out[i] = given.x_dem


def own_demand_stage(driven: Driven) -> Stage:
    """Stroke demand from logged speeds, by the user's library as it is flashed.

    What it remembers from before the log is not known: it is run twice, with a demand that came from below and one that
    came from above, and only rows where both agree count.
    """
    t, c, machine, cal, outputs, run = driven[:6]
    _, effects, _, _ = declared("demand", driven)
    effects = tuple(e for e in effects if e.name != "frame_hold")
    at = {e.name: sum(len(f.parameters) for f in effects[:i]) for i, e in enumerate(effects)}
    n_dem, n_r, start = c["n_dem"], c["n_r"], float(c["x_dem"][0]) * 1e-3
    angles = np.array([np.deg2rad(c[v]) if v in c else np.full(len(t), np.nan) for v in machine.vanes])

    def demanded(theta: Array, before: float) -> Array:
        def value(name: str, neutral: float) -> float:
            return float(theta[at[name]]) if name in at else neutral

        k, table = cal.k.copy(), cal.table.copy()
        scalars, factor = as_scalars(k), value("trend_threshold_error", 1.0)
        scalars.trend_rate_on *= factor
        scalars.trend_change *= factor
        table[1:] += value("schedule_error", 0.0) * 1e-3
        flashed = cal._replace(k=k, table=table, program=None)
        late = value("can_delay", float(machine.p[ROW["can_delay"], 0]))
        frames = np.arange(len(t)) - late / SLOW_TICK
        came, came_r = (np.interp(frames, np.arange(len(t)), v) for v in (n_dem, n_r))
        out, program = np.empty(len(t)), cal.program.start(flashed)
        _run(came, came_r, start, angles, before, new_inputs(), new_outputs(), new_state(), flashed, program, out)
        return out

    def simulate(thetas: Array) -> Array:
        return np.array([[demanded(theta, APPROACH) * 1e3] for theta in thetas])

    neutral = Stage("demand", outputs, ("mm",), (), effects, simulate, t, c["x_dem"][None]).neutral()
    differs = np.abs(demanded(neutral, APPROACH) - demanded(neutral, -APPROACH)) > SAME
    rows = run & ~lately(differs, 0.5) & ~lately(c["missing"] > 0.0, 0.4)
    return Stage("demand", outputs, ("mm",), (), effects, simulate, t, np.where(rows, c["x_dem"], np.nan)[None])
