"""From speed to stroke demand by curves: the strategies single and dual, and what moves the demand."""

from __future__ import annotations

import numpy as np

from controller.records import SLOW_TICK, Record
from vaneloop.base.compiled import inlined

__all__ = ["look_up", "move_demand", "schedule_step"]

ROW_SPEED, ROW_EXTENSION, ROW_RETRACTION, ROW_SINGLE = range(4)

ANGLE_STROKE, ANGLE_VIGV = 0, 1  # rows of the angle table; the other stages follow


@inlined
def look_up(axis: int, row: int, table: np.ndarray, v: float) -> float:
    """Linear interpolation of ``table[row]`` over the increasing ``table[axis]``, held constant beyond both ends."""
    last = table.shape[1] - 1
    if not v > table[axis, 0]:
        return table[row, 0]
    if v >= table[axis, last]:
        return table[row, last]
    lo, hi = 0, last
    while hi - lo > 1:
        mid = (lo + hi) // 2
        if table[axis, mid] <= v:
            lo = mid
        else:
            hi = mid
    w = (v - table[axis, lo]) / (table[axis, hi] - table[axis, lo])
    return table[row, lo] + w * (table[row, hi] - table[row, lo])


@inlined
def schedule_step(z: Record, k: Record, table: np.ndarray) -> None:
    """Strategies `SINGLE` and `DUAL`: stroke demand from the speed by curves, one 10 ms step.

    The extension curve serves a rising demand, the retraction curve a falling one. Between them ``blend`` moves at a
    limited rate, so the change of table is bumpless; the demand itself is limited to ``stroke_rate``.
    """
    n = z.n_dem if k.table_input == 1.0 else z.n_r
    if k.strategy == 0.0:
        target = look_up(ROW_SPEED, ROW_SINGLE, table, n)
    else:
        goal = 1.0 if z.direction > 0.0 else 0.0
        step = SLOW_TICK / k.blend_time
        z.blend += min(max(goal - z.blend, -step), step)
        retraction = look_up(ROW_SPEED, ROW_RETRACTION, table, n)
        extension = look_up(ROW_SPEED, ROW_EXTENSION, table, n)
        target = retraction + z.blend * (extension - retraction)
    z.x_target = min(max(target, k.stroke_min), k.stroke_max)


@inlined
def move_demand(z: Record, k: Record, target: float, rate: float) -> None:
    """Let the stroke demand follow ``target`` (m) no faster than ``rate`` (m/s): one 10 ms step."""
    step = rate * SLOW_TICK
    z.x_from = z.x_dem
    z.x_dem += min(max(target - z.x_dem, -step), step)
    z.x_dem = min(max(z.x_dem, k.stroke_min), k.stroke_max)
