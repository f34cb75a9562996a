"""Whether the strokes of two actuators stand for each other in a log, as the vane angles tell.

Current and load say next to nothing of it: the actuators are built alike. Away from the middle between both, a
potentiometer feels the nearer actuator more (`plant.unison`), so that the angles follow from the strokes only in their
right places, where the strokes differ. A wrong LVDT looks alike there, but the rings' load tells it: then an actuator
does not fit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vaneloop.base.signals import SIDES
from vaneloop.identification.least_squares.problem import LeastSquaresProblem, recalibrate
from vaneloop.identification.subsystem import Stage
from vaneloop.identification.vane_chain.alignment import explains, fits
from vaneloop.identification.vane_chain.subsystem_data import Made, stroke_of

__all__ = ["swapped"]


def swapped(stages: Sequence[Stage]) -> list[str]:
    """A note where the linkage fits with either stroke in the other's place, does not fit as logged, and both actuators
    fit.
    """
    of = {s.name: s for s in stages if s.floor is not None and isinstance(s.made, Made)}
    stage = of.get("linkage")
    if stage is None or stage.made.driven.both is None or fits(stage):  # type: ignore[attr-defined]
        return []
    if any(not fits(s) for name, s in of.items() if name.startswith("actuator_")):
        return []
    made = stage.made
    assert isinstance(made, Made)
    columns = dict(made.driven.columns)
    a, b = SIDES
    for one, other in ((a, b), (stroke_of(a), stroke_of(b))):
        if one in columns and other in columns:
            columns[one], columns[other] = columns[other], columns[one]
    before, after = (
        _mean_squares(s, stage) for s in (stage, made.make(made.driven._replace(columns=columns, again=True)))
    )
    if not explains(stage, before, after):
        return []
    falls = " to ".join(f"{float(np.sqrt(x.max())):.3g}" for x in (before, after))
    return [
        f"{a}, {b}: each seems to stand in the other's place in the log: with both exchanged the error of the vane "
        f"angles falls from {falls} noise floors, and both actuators fit either way"
    ]


def _mean_squares(stage: Stage, of: Stage) -> np.ndarray:
    """Of each output's error, in squared noise floors ``of`` a stage, nominal parameters refitted."""
    judge = LeastSquaresProblem(stage, np.asarray(of.floor))
    return np.asarray(judge.mean_squares(judge.errors(recalibrate(judge).theta[None])[0]))
