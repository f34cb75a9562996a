"""Blocks of lanes of the electromechanical actuator: motor, gear, screw."""

from __future__ import annotations

from typing import Any

import numpy as np

from plant import curve, electromechanical, lanes
from plant.chain import measured_stroke, true_stroke
from plant.curve_lanes import first_curved, tables_of
from plant.parameters import motor_steps
from plant.places import SCREW_PITCH_ERROR
from plant.stages.bends import BENT, bend_drive, bend_reading
from plant.stages.blocks import W, between, put_where_seen
from vaneloop.base.compiled import compiled_free, inlined

__all__ = ["BLOCK", "run"]

BLOCK = lanes.block(
    W, electromechanical.MotorState, electromechanical.Motor,
    more=("i_cmd", "torque_of_load", "most", "logged", *BENT),
)  # fmt: skip
_motor_state, _put_motor_state = (
    lanes.getter(electromechanical.MotorState),
    lanes.putter(electromechanical.MotorState),
)
_motor, _put_motor = lanes.getter(electromechanical.Motor), lanes.putter(electromechanical.Motor)


@compiled_free
def run(
    current: np.ndarray,
    n_r: np.ndarray,
    t_oil: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    x_lvdt: np.ndarray,
    window: int,
    order: np.ndarray,
    block: np.ndarray,
    known: np.ndarray,
) -> None:
    """The lanes of ``order``, eight at a time; out[lane, k]. ``block``: memory for one record `BLOCK`; ``known``:
    signals of curves (`plant.curve.take`).
    """
    n, substeps = current.shape
    many = motor_steps(dt / substeps)
    h = dt / (substeps * many)
    b = block[0]
    for j0 in range(0, len(order), W):
        last = min(W, len(order) - j0)
        swaying = False
        for j in range(W):
            q = order[j0 + min(j, last - 1)]
            swaying |= p[SCREW_PITCH_ERROR, q] != 0.0
            _put_motor_state(b, j, electromechanical.taken(s, q))
            _put_motor(b, j, electromechanical.prepare(p, q, t_oil[0]))
        some = order[j0 : j0 + last]
        first = first_curved(p, some)
        tables = tables_of(p, max(first, 0), some, W)
        for k in range(n):
            if k > 0:
                speed, warm = between(n_r, k), between(t_oil, k)
                for j in range(W):
                    b.rated[j] = electromechanical.rated_speed(_motor(b, j), warm)
                    force = electromechanical.load_of(_motor(b, j), speed)
                    b.torque_of_load[j], b.most[j] = electromechanical.load_torques(_motor(b, j), force)
                for m in range(substeps):
                    for j in range(W):
                        b.i_cmd[j] = current[k, m]
                    if first >= 0:
                        bend_drive(b, p, first, known, k, current[k, m], tables, some)
                        for j in range(W):
                            b.i_cmd[j] += b.current_adds[j]
                            force = electromechanical.load_of(_motor(b, j), speed) + b.load_adds[j]
                            b.torque_of_load[j], b.most[j] = electromechanical.load_torques(_motor(b, j), force)
                    if swaying:
                        _substep(b, many, h, True)
                    else:
                        _substep(b, many, h, False)
            if first >= 0:
                bend_reading(b, p, first, known, k, tables, some)
            if window > 0 and k % window == 0:
                for j in range(last):
                    seen = x_lvdt[k]
                    if first >= 0:
                        seen = curve.unbent(seen, b.lvdt_times[j], b.lvdt_adds[j])
                    put_where_seen(b, j, true_stroke(seen, p, order[j0 + j], t_oil[k]), k == 0)
            for j in range(last):
                reading = measured_stroke(b.reading[j], p, order[j0 + j], t_oil[k])
                if first >= 0:
                    reading = curve.bent(reading, b.lvdt_times[j], b.lvdt_adds[j])
                out[order[j0 + j], k] = reading
        for j in range(last):
            electromechanical.stored(s, order[j0 + j], _motor_state(b, j))


@inlined
def _substep(b: Any, many: int, h: float, swaying: bool) -> None:
    """One plant step of every lane of the block, in ``many`` steps of the motor."""
    for _ in range(many):
        for j in range(W):
            z, d = _motor_state(b, j), _motor(b, j)
            _put_motor_state(b, j, electromechanical.step(z, d, b.i_cmd[j], b.torque_of_load[j], b.most[j], h, swaying))
    for j in range(W):
        _put_motor_state(b, j, electromechanical.sense(_motor_state(b, j), _motor(b, j)))
