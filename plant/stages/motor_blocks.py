"""Blocks of lanes of the electromechanical actuator: motor, gear, screw."""

from __future__ import annotations

from typing import Any

import numpy as np

from plant import electromechanical, lanes
from plant.chain import measured_stroke, true_stroke
from plant.effects import aero_load
from plant.parameters import motor_steps
from plant.places import AERO_LOAD, SCREW_PITCH_ERROR, TACHO_THERMAL_DRIFT
from plant.stages.blocks import W, between, put_where_seen
from vaneloop.base.compiled import compiled_free, inlined

__all__ = ["BLOCK", "CALLED", "run"]

# effects that the blocks call; those of the LVDT are in `measured_stroke`, which both forms share
CALLED = (
    "aero_load", "amplifier_dead_band", "amplifier_lag", "amplifier_offset", "end_stop_shift", "gear_backlash",
    "motor_torque_constant_error", "screw_friction", "screw_pitch_error", "tacho_thermal_drift",
)  # fmt: skip
BLOCK = lanes.block(
    W, electromechanical.MotorState, electromechanical.Motor, more=("aero", "torque_of_load", "most", "logged")
)
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
) -> None:
    """The lanes of ``order``, eight at a time; out[lane, k]. ``block``: memory for one record `BLOCK`."""
    n, substeps = current.shape
    many = motor_steps(dt / substeps)
    h = dt / (substeps * many)
    b = block[0]
    for j0 in range(0, len(order), W):
        last = min(W, len(order) - j0)
        swaying = drifting = False
        for j in range(W):
            q = order[j0 + min(j, last - 1)]
            swaying |= p[SCREW_PITCH_ERROR, q] != 0.0
            drifting |= p[TACHO_THERMAL_DRIFT, q] != 0.0
            b.aero[j] = p[AERO_LOAD, q]
            _put_motor_state(b, j, electromechanical.taken(s, q))
            _put_motor(b, j, electromechanical.prepare(p, q, t_oil[0]))
        for k in range(n):
            if k > 0:
                speed, warm = between(n_r, k), between(t_oil, k)
                if drifting:
                    for j in range(last):
                        _put_motor(b, j, electromechanical.prepare(p, order[j0 + j], warm))
                for j in range(W):
                    force = aero_load.step(speed, b.aero[j])
                    b.torque_of_load[j], b.most[j] = electromechanical.load_torques(_motor(b, j), force)
                if swaying:
                    for m in range(substeps):
                        _substep(b, current[k, m], many, h, True)
                else:
                    for m in range(substeps):
                        _substep(b, current[k, m], many, h, False)
            if window > 0 and k % window == 0:
                for j in range(last):
                    put_where_seen(b, j, true_stroke(x_lvdt[k], p, order[j0 + j], t_oil[k]), k == 0)
            for j in range(last):
                out[order[j0 + j], k] = measured_stroke(b.reading[j], p, order[j0 + j], t_oil[k])
        for j in range(last):
            electromechanical.stored(s, order[j0 + j], _motor_state(b, j))


@inlined
def _substep(b: Any, i_cmd: float, many: int, h: float, swaying: bool) -> None:
    """One plant step of every lane of the block, in ``many`` steps of the motor."""
    for _ in range(many):
        for j in range(W):
            z, d = _motor_state(b, j), _motor(b, j)
            _put_motor_state(b, j, electromechanical.step(z, d, i_cmd, b.torque_of_load[j], b.most[j], h, swaying))
    for j in range(W):
        _put_motor_state(b, j, electromechanical.sense(_motor_state(b, j), _motor(b, j)))
