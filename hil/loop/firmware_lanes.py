"""The firmware for lanes side by side: `controller.firmware`'s own functions, on records that stand in registers.

A block has the numbers of the firmware's records, `plant.chain_lanes.W` lanes each: ``in_`` of its inputs, ``z_`` of
its state, ``k_`` of its calibration. Strategies `single` and `dual`; what the others need besides is not in a block.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from controller import Calibration
from controller.firmware import act, aim, filter_speed, watch
from controller.records import DUAL, INPUT_FIELDS, RUN, SCALAR_FIELDS, STATE_FIELDS, Field, Record, kind
from controller.schedule import schedule_step
from hil.loop.tick import Loop
from plant.chain_lanes import W
from plant.lanes import filler, on_stack, wide_vectors
from vaneloop.base.compiled import inlined

__all__ = ["between_frames", "fields", "flash", "on_frame", "on_late_frame", "place", "runs_in_lanes"]


def _first(of: tuple[Field, ...], before: str) -> dict[str, int]:
    """Names of the fields that stand before the field ``before``, and how many numbers each has (0: it is no array)."""
    names = [f.name for f in of]
    return {f.name: len(f.each) for f in of[: names.index(before)]}


# what the strategies inverse and adaptive have for themselves stands behind all others
_STATE = _first(STATE_FIELDS, "speed")
_SCALARS = _first(SCALAR_FIELDS, "engine_lag")
_INPUTS = _first(INPUT_FIELDS, "pots")
_Inputs, _State, _Scalars = kind(INPUT_FIELDS), kind(STATE_FIELDS), kind(SCALAR_FIELDS)
_take_inputs, _take_scalars = filler(_INPUTS, "in_", False), filler(_SCALARS, "k_", False)
_take_state, _put_state = filler(_STATE, "z_", False), filler(_STATE, "z_", True)
CALM = float(RUN)


def fields() -> list[tuple[str, Any, tuple[int, ...]]]:
    """Fields of a block."""
    return [
        (f"{prefix}{name}", np.float64, (count, W) if count else (W,))
        for prefix, names in (("in_", _INPUTS), ("z_", _STATE), ("k_", _SCALARS))
        for name, count in names.items()
    ]


def runs_in_lanes(calibration: Calibration) -> bool:
    """Whether a controller can be in a block: one channel of the firmware here, with a strategy of curves."""
    own = calibration.program is None and calibration.channels is None
    return own and bool(calibration.scalars.strategy <= DUAL)


def place(b: Any, j: int, loop: Loop) -> None:
    """Put a loop's controller into lane ``j`` of a block (a numpy record)."""
    for name in _STATE:
        b[f"z_{name}"][..., j] = loop.state[name]
    flash(b, j, loop.calibration)


def flash(b: Any, j: int, calibration: Calibration) -> None:
    """Put a calibration's scalars into lane ``j`` of a block (a numpy record)."""
    for name in _SCALARS:
        b[f"k_{name}"][..., j] = calibration.scalars[name]


@inlined
def _no_frame(b: Any, j: int, inputs: Record) -> None:
    """What comes in at a tick without a frame of the ECU."""
    inputs.x_lvdt = b.in_x_lvdt[j]
    inputs.n_dem = inputs.n_r = inputs.mode_request = 0.0  # nobody reads them
    inputs.demand_fresh = inputs.demand_rejected = inputs.pause = 0.0


@inlined
def on_frame(b: Any, n: int, tables: np.ndarray) -> None:
    """The firmware's tick of ``n`` lanes, every 10 ms, with the inputs in the block; tables[lane]: of its strokes."""
    wide_vectors()
    inputs, z, k = on_stack(_Inputs), on_stack(_State), on_stack(_Scalars)
    z1, k1 = on_stack(_State), on_stack(_Scalars)
    z2, k2 = on_stack(_State), on_stack(_Scalars)
    for j in range(n):
        _take_inputs(b, j, inputs), _take_state(b, j, z), _take_scalars(b, j, k)
        inputs.pause = 0.0
        watch(inputs, z, k)
        if z.demand_seen == 1.0:
            filter_speed(z, k)
        _put_state(b, j, z)
    for j in range(n):  # looks things up in tables, which no vector does
        _take_state(b, j, z1), _take_scalars(b, j, k1)
        if z1.demand_seen == 1.0:
            schedule_step(z1, k1, tables[j])
        _put_state(b, j, z1)
    for j in range(n):
        _take_state(b, j, z2), _take_scalars(b, j, k2)
        aim(z2, k2)
        act(z2, k2, 0)
        _put_state(b, j, z2)


@inlined
def between_frames(b: Any, n: int, phase: int) -> None:
    """The firmware's tick of ``n`` lanes, the ``phase``-th after a frame of the ECU.

    Where every lane runs and has no fault, the compiler is told so: what only other modes and faults need is left out.
    """
    wide_vectors()
    inputs, z, k = on_stack(_Inputs), on_stack(_State), on_stack(_Scalars)
    inputs1, z1, k1 = on_stack(_Inputs), on_stack(_State), on_stack(_Scalars)
    other = 0
    for j in range(n):
        other += b.z_mode[j] != CALM or b.z_faults[j] != 0.0
    if other == 0:
        for j in range(n):
            _take_state(b, j, z), _take_scalars(b, j, k), _no_frame(b, j, inputs)
            z.mode, z.faults = CALM, 0.0
            watch(inputs, z, k)
            act(z, k, phase)
            _put_state(b, j, z)
        return
    for j in range(n):
        _take_state(b, j, z1), _take_scalars(b, j, k1), _no_frame(b, j, inputs1)
        watch(inputs1, z1, k1)
        act(z1, k1, phase)
        _put_state(b, j, z1)


@inlined
def on_late_frame(b: Any, n: int, phase: int) -> None:
    """The firmware's tick of ``n`` lanes, the ``phase``-th of ten and not the first, with the inputs in the block."""
    wide_vectors()
    inputs, z, k = on_stack(_Inputs), on_stack(_State), on_stack(_Scalars)
    for j in range(n):
        _take_inputs(b, j, inputs), _take_state(b, j, z), _take_scalars(b, j, k)
        inputs.pause = 0.0
        watch(inputs, z, k)
        act(z, k, phase)
        _put_state(b, j, z)
