"""The firmware's place in the compiled tick: the one here, or a library of the user's own, called at its address.

Which of the two is known when the tick is compiled (`Loop.foreign` is an empty tuple, or a `Foreign`), so the firmware
here does not pay for the choice.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from controller import Calibration, give, tick
from controller.records import (
    FAULTS,
    INPUTS,
    MODES,
    OBSERVABLE_FIELDS,
    OUTPUTS,
    STATE,
    TICK,
    as_inputs,
    as_outputs,
    as_scalars,
    as_state,
    flat_names,
)
from vaneloop.base.compiled import in_place

__all__ = [
    "CALL", "CALLS", "ENTERED", "OBSERVABLES", "REASON", "REASONS", "RETURNED", "STEP", "VALUE", "Foreign", "firmware",
]  # fmt: skip

OBSERVABLES = flat_names(OBSERVABLE_FIELDS)
N_IN, N_OUT, N_SEEN, CANARIES = len(INPUTS), len(OUTPUTS), len(OBSERVABLES), 8
N_MODES, ALL_FAULTS = len(MODES), float((1 << len(FAULTS)) - 1)
CANARY = 7.25e77  # before each struct, where a controller that writes below it leaves a trace
ROUNDING = 1e-9  # A: a limit of 40 mA in single precision is 0.6 nA more

# numbers of the black box's head, float64
ENTERED, RETURNED, REASON, VALUE, CALL, N_HEAD = range(6)
# in which function of the controller's the process is; of a step and what it shows, ENTERED and RETURNED say whether
CALLS = (
    "vaneloop_step", "the loading of its library", "vaneloop_version", "vaneloop_init", "vaneloop_describe",
    "vaneloop_save", "vaneloop_restore", "the unloading of its library",
)  # fmt: skip
STEP = 0.0  # in CALLS
# why a controller was stopped; what it gave is in VALUE
CURRENT_NAN, CURRENT_LIMIT, DEMAND_NAN, MODE, FAULT, BELOW = range(1, 7)
REASONS = {
    CURRENT_NAN: "i_cmd (={0:g} A) must be a finite number",
    CURRENT_LIMIT: "i_cmd (={0:.6g} A) must be within the current_limit",
    DEMAND_NAN: "x_dem (={0:g} m) must be a finite number",
    MODE: f"mode (={{0:g}}) must be one of 0 to {N_MODES - 1}",
    FAULT: f"faults (={{0:g}}) must be a whole number from 0 to {(1 << len(FAULTS)) - 1}",
    BELOW: "it wrote outside the structs that it was given",
}


class Foreign(NamedTuple):
    """A running library of the user's own.

    step, observe, stop  addresses of its functions (observe: 0 = it has none), and of the one that ends the process
    fed, given, seen     float64[n] inputs, outputs, observables, in memory with a wall behind each; the numbers before
                         each are canaries
    at_fed, at_given, at_seen  their addresses
    box                  float64[N_HEAD] black box: the tick that was begun and ended last (counted from 1), why it
                         was stopped, what it gave then, and in which other call it is
    rows                 float64[n, inputs] inputs of the ticks, tick k in row k % n
    shown                int64[n] numbers of the firmware's state where the observables belong
    """

    step: int
    observe: int
    stop: int
    fed: np.ndarray
    given: np.ndarray
    seen: np.ndarray
    at_fed: int
    at_given: int
    at_seen: int
    box: np.ndarray
    rows: np.ndarray
    shown: np.ndarray


SHOWN = np.array([STATE.index(name) for name in OBSERVABLES])


def _calls(builder: Any, address: Any, kinds: list[Any], values: list[Any]) -> None:
    of = ir.FunctionType(ir.VoidType(), kinds).as_pointer()
    builder.call(builder.inttoptr(address, of), values)


def _step_code(context: Any, address: Any, time: Any, inputs: Any, outputs: Any) -> Any:
    """Call ``void f(double, void *, void *)`` at an address."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        where, *rest = values
        pointers = [builder.inttoptr(v, cgutils.voidptr_t) for v in rest[1:]]
        _calls(builder, where, [ir.DoubleType(), cgutils.voidptr_t, cgutils.voidptr_t], [rest[0], *pointers])
        return context.get_dummy_value()

    return types.void(types.int64, types.float64, types.int64, types.int64), code


def _call_code(context: Any, address: Any, argument: Any) -> Any:
    """Call ``void f(void *)`` at an address."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        _calls(builder, values[0], [cgutils.voidptr_t], [builder.inttoptr(values[1], cgutils.voidptr_t)])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), code


# numba's type of an intrinsic asks for the context, which only the compiler gives
_step: Any = intrinsic(_step_code)
_call: Any = intrinsic(_call_code)


@in_place
def _stopped(a: Foreign, reason: int, value: float) -> None:
    """Note why, and end the process: what the library left in memory is not to be trusted."""
    a.box[REASON], a.box[VALUE] = reason, value
    _call(a.stop, 0)


@in_place
def _judge(a: Foreign, outputs: np.ndarray, limit: float) -> None:
    """Stop a controller whose ``outputs`` cannot be, or which wrote outside its own."""
    out = as_outputs(outputs)
    i, mode, faults = out.i_cmd, out.mode, out.faults
    if not abs(i) < np.inf:
        _stopped(a, CURRENT_NAN, i)
    if abs(i) > limit + ROUNDING:
        _stopped(a, CURRENT_LIMIT, i)
    if not abs(out.x_dem) < np.inf:
        _stopped(a, DEMAND_NAN, out.x_dem)
    if not (0.0 <= mode < N_MODES and mode == np.floor(mode)):
        _stopped(a, MODE, mode)
    if not (0.0 <= faults <= ALL_FAULTS and faults == np.floor(faults)):
        _stopped(a, FAULT, faults)
    for q in range(CANARIES):
        if a.fed[q] != CANARY or a.given[q] != CANARY or a.seen[q] != CANARY:
            _stopped(a, BELOW, 0.0)


@in_place
def foreign_tick(inputs: np.ndarray, outputs: np.ndarray, z: np.ndarray, calibration: Calibration, a: Foreign) -> None:
    """One tick of a library of the user's own, in place of `controller.tick` and `controller.give`.

    Of the state it fills what the outputs and the observables say; where the library shows none, the inputs.
    """
    state = as_state(z)
    k = int(state.ticks)
    row = k % a.rows.shape[0]
    for q in range(N_IN):
        a.fed[CANARIES + q] = inputs[q]
        a.rows[row, q] = inputs[q]
    a.box[ENTERED] = k + 1.0
    _step(a.step, k * TICK, a.at_fed, a.at_given)
    if a.observe != 0:
        _call(a.observe, a.at_seen)
        for q in range(N_SEEN):
            z[a.shown[q]] = a.seen[CANARIES + q]
    else:
        fed = as_inputs(inputs)
        if fed.demand_fresh > 0.5:
            state.n_dem, state.n_r_raw, state.n_r = fed.n_dem, fed.n_r, fed.n_r
        if abs(fed.x_lvdt) < np.inf:
            state.x_meas = fed.x_lvdt
    for q in range(N_OUT):  # what is judged is ours: a thread of the library's cannot change it any more
        outputs[q] = a.given[CANARIES + q]
    _judge(a, outputs, as_scalars(calibration.k).current_limit)
    a.box[RETURNED] = k + 1.0
    out = as_outputs(outputs)
    state.i_cmd, state.x_dem, state.mode, state.faults = out.i_cmd, out.x_dem, out.mode, out.faults
    state.ticks += 1.0


def firmware(inputs: np.ndarray, outputs: np.ndarray, z: np.ndarray, calibration: Calibration, foreign: Any) -> None:
    """Run the controller for one tick of 1 ms: ``inputs`` in, ``outputs`` and ``z`` (its state) changed in place.

    foreign  an empty tuple: the firmware here; a `Foreign`: a library of the user's own
    """
    if isinstance(foreign, Foreign):
        foreign_tick(inputs, outputs, z, calibration, foreign)
    else:
        tick(inputs, z, calibration)
        give(z, outputs)


_AS_INLINED: Any = {  # `vaneloop.base.compiled.inlined`, and without what Python would call
    "_nrt": False, "forceinline": True, "error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True
}  # fmt: skip


@overload(firmware, jit_options=_AS_INLINED)
def _firmware(inputs: Any, outputs: Any, z: Any, calibration: Any, foreign: Any) -> Any:
    def own(inputs: Any, outputs: Any, z: Any, calibration: Any, foreign: Any) -> None:
        tick(inputs, z, calibration)
        give(z, outputs)

    def theirs(inputs: Any, outputs: Any, z: Any, calibration: Any, foreign: Any) -> None:
        foreign_tick(inputs, outputs, z, calibration, foreign)

    return theirs if isinstance(foreign, types.NamedTuple) else own
