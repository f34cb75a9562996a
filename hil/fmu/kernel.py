"""What an FMU does: the functions that the product runs, on the memory of one FMU.

`entry` gives for a part and a shape the function that the archive's C code is made of (`hil.fmu.source`); each
takes the address of the memory (`hil.fmu.memory`). The ticks are `hil.loop.tick`'s, the physics `plant.chain`'s.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numba.np import arrayobj

from controller import Calibration, new_inputs, new_state
from controller.records import SLOW, as_inputs, as_outputs
from hil.fmu.memory import FED, HELD_N_DEM, HELD_N_R, NEXT, OWN_ENGINE, SHOWN, Shape, places_of
from hil.loop.lockstep import WARM_UP
from hil.loop.tick import Loop, control, hear, mean_stroke, move, reflash
from hil.native.call import firmware
from plant import chain, places
from plant.parameters import derive_lane
from vaneloop.base.compiled import inlined

__all__ = ["entry"]

(F_N_DEM, F_N_R, F_I_CMD, F_X_LVDT, F_P_S, F_T_OIL, F_MODE_REQUEST, F_FRESH, F_REJECTED, F_PAUSE) = range(len(FED))
S_I_CMD, S_X_DEM, S_X_LVDT, S_X, S_N_ENGINE, S_I_MOTOR, S_STATE, S_FAULTS = range(len(SHOWN))
F_POTS, S_VANES = len(FED), len(SHOWN)
SUBSTEP = chain.TICK / chain.SUBSTEPS
_types: Any = types  # numba's own have no types
_arrays: Any = arrayobj
_NEW, _NO_INPUTS = new_state(), new_inputs()


def _view_code(context: Any, memory: Any, offset: Any, shape: Any) -> Any:
    """Show the numbers from ``offset`` on as an array in C order; numba's own carray counts references."""
    kind = types.Array(types.float64, len(shape), "C")

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        pointer, begin, sizes = values
        array = _arrays.make_array(kind)(context, builder)
        size = ir.Constant(ir.IntType(64), 8)
        strides = [size]
        shapes = [builder.extract_value(sizes, i) for i in range(len(shape))]
        for n in shapes[:0:-1]:
            strides.insert(0, builder.mul(n, strides[0]))
        _arrays.populate_array(array, builder.gep(pointer, [begin]), shapes, strides, size, None)
        return array._getvalue()

    return kind(memory, types.int64, _types.UniTuple(types.int64, len(shape))), code


_view: Any = intrinsic(_view_code)


@inlined
def _change(a: Loop) -> None:
    """Take over changed parameters: what follows from them, and the calibration."""
    derive_lane(a.p, 0, SUBSTEP, chain.TICK)
    for q in range(a.built.k.shape[0]):
        a.calibration.k[q] = a.built.k[q]
    a.flash[0] = np.nan
    reflash(a)


@inlined
def _start(a: Loop, clock: np.ndarray, fed: np.ndarray) -> None:
    """Switch the firmware on, and put the machine to rest at the speed that it is fed with: `hil.loop.tick.new_loop`
    in place.
    """
    for q in range(a.z.shape[0]):
        a.z[q] = _NEW[q]
    for q in range(a.outputs.shape[0]):
        a.outputs[q] = 0.0
    a.mean[0], a.mean[1] = 0.0, 0.0
    for q in range(a.sent.shape[0]):
        for r in range(a.sent.shape[1]):
            a.sent[q, r] = np.nan
    for q in range(a.inputs.shape[0]):
        a.inputs[q] = _NO_INPUTS[q]
    _change(a)
    n_dem = fed[F_N_DEM]
    n_r = n_dem if clock[OWN_ENGINE] > 0.5 else fed[F_N_R]
    chain.rest(a.s, a.p, 0, mean_stroke(a.calibration.table, n_r), n_dem, fed[F_T_OIL])
    clock[NEXT], clock[HELD_N_DEM], clock[HELD_N_R] = 0.0, n_dem, n_r


@inlined
def _hear(k: int, a: Loop, clock: np.ndarray, fed: np.ndarray) -> None:
    """Every 10th tick a frame of the ECU comes, with what the FMU is fed."""
    if k % SLOW == 0:
        n_r = np.nan if clock[OWN_ENGINE] > 0.5 else fed[F_N_R]
        clock[HELD_N_DEM] = fed[F_N_DEM]
        clock[HELD_N_R] = hear(a, fed[F_N_DEM], n_r, fed[F_FRESH], fed[F_REJECTED], fed[F_MODE_REQUEST], k, 0.0)
    else:
        inputs = as_inputs(a.inputs)
        inputs.demand_fresh = inputs.demand_rejected = 0.0


@inlined
def loop_run(a: Loop, clock: np.ndarray, fed: np.ndarray, still: np.ndarray, ticks: int) -> None:
    """Run the closed loop for so many ticks."""
    for _ in range(ticks):
        k = int(clock[NEXT])
        _hear(k, a, clock, fed)
        control(k, a, still, 0, fed[F_T_OIL])
        a.mean[0], a.mean[1] = 0.0, 0.0
        move(k, a, clock[HELD_N_DEM], clock[HELD_N_R], fed[F_P_S], fed[F_T_OIL])
        clock[NEXT] = k + 1.0


@inlined
def controller_run(a: Loop, clock: np.ndarray, fed: np.ndarray, still: np.ndarray, ticks: int) -> None:
    """Run the firmware for so many ticks on the stroke and the angles that it is fed."""
    inputs = as_inputs(a.inputs)
    for _ in range(ticks):
        k = int(clock[NEXT])
        clock[OWN_ENGINE] = 0.0
        _hear(k, a, clock, fed)
        reflash(a)
        inputs.x_lvdt, inputs.pause = fed[F_X_LVDT], fed[F_PAUSE]
        for q in range(a.angles.shape[0]):
            inputs.pots[q] = fed[F_POTS + q]
        firmware(a.inputs, a.outputs, a.z, a.calibration, a.foreign)
        clock[NEXT] = k + 1.0


@inlined
def plant_run(a: Loop, clock: np.ndarray, fed: np.ndarray, still: np.ndarray, ticks: int) -> None:
    """Let the machine move on for so many ticks under the current that it is fed."""
    for _ in range(ticks):
        k = int(clock[NEXT])
        if clock[OWN_ENGINE] < 0.5:
            clock[HELD_N_R] = fed[F_N_R]
        elif k % SLOW == 0:  # as it is measured and sent
            clock[HELD_N_R] = a.s[places.N_R, 0]
        as_outputs(a.outputs).i_cmd = fed[F_I_CMD]
        move(k, a, fed[F_N_DEM], clock[HELD_N_R], fed[F_P_S], fed[F_T_OIL])
        clock[NEXT] = k + 1.0


@inlined
def _show(a: Loop, fed: np.ndarray, shown: np.ndarray) -> None:
    """Fill ``shown`` with what the sensors give now, and what the firmware gave in the last tick."""
    out = as_outputs(a.outputs)
    shown[S_I_CMD], shown[S_X_DEM], shown[S_STATE], shown[S_FAULTS] = out.i_cmd, out.x_dem, out.mode, out.faults
    shown[S_X_LVDT] = chain.sample_lvdt(a.s, a.p, 0, 0.0, fed[F_T_OIL])
    shown[S_X], shown[S_N_ENGINE], shown[S_I_MOTOR] = a.s[places.X, 0], a.s[places.N_R, 0], a.s[places.I_MOTOR, 0]
    for q in range(a.angles.shape[0]):
        shown[S_VANES + q] = a.s[places.POT + q, 0]


START, RUN, SHOW, WAKE, CHANGE = range(5)


def entry(part: str, shape: Shape) -> Callable[..., None]:
    """Return the one function of a part, ``serve(m, what, ticks)``, to be compiled for the address of the memory.

    START   before t = 0: everything follows from parameters and what is fed; a loop begins `WARM_UP` ticks earlier
    RUN     so many ticks
    SHOW    fill what is shown
    WAKE    before parameters change while it runs;  CHANGE  afterwards
    """
    at = places_of(shape)
    stages, points, strokes = shape
    n_in, n_out, n_z, n_k = (at[name].shape[0] for name in ("inputs", "outputs", "z", "k"))
    n_s, n_p, n_sent, n_fed, n_shown = (at[name].shape[0] for name in ("s", "p", "sent", "fed", "shown"))
    o_clock, o_fed, o_shown, o_in, o_out, o_z = (at[n].at for n in ("clock", "fed", "shown", "inputs", "outputs", "z"))
    o_bk, o_bt, o_ba, o_k, o_t = (at[n].at for n in ("built_k", "built_table", "built_angles", "k", "table"))
    o_flash, o_s, o_p, o_sigma, o_still = (at[n].at for n in ("flash", "s", "p", "sigma", "still"))
    o_mean, o_angles, o_sent = (at[n].at for n in ("mean", "angles", "sent"))
    run_part: Any = {"plant": plant_run, "controller": controller_run, "loop": loop_run}[part]
    absent: Any = None  # the rows of a state hash
    warm_up = WARM_UP if part == "loop" else 0

    @inlined
    def loop(m: Any) -> Loop:
        angles = _view(m, o_ba, (1 + stages, strokes))
        return Loop(
            _view(m, o_in, (n_in,)),
            _view(m, o_out, (n_out,)),
            _view(m, o_z, (n_z,)),
            Calibration(_view(m, o_bk, (n_k,)), _view(m, o_bt, (4, points)), angles, None, None),
            Calibration(_view(m, o_k, (n_k,)), _view(m, o_t, (4, points)), angles, None, None),
            _view(m, o_flash, (3,)),
            _view(m, o_s, (n_s, 1)),
            _view(m, o_p, (n_p, 1)),
            absent,
            absent,
            _view(m, o_sigma, (2 + stages,)),
            _view(m, o_mean, (2,)),
            _view(m, o_angles, (stages,)),
            _view(m, o_in, (0, 1)),
            _view(m, o_in, (0,)),
            _view(m, o_in, (0,)),
            _view(m, o_sent, (n_sent, 4)),
            (),
            (),
        )

    def serve(m: Any, what: int, ticks: int) -> None:
        a, clock, fed = loop(m), _view(m, o_clock, (4,)), _view(m, o_fed, (n_fed,))
        if what == RUN:
            run_part(a, clock, fed, _view(m, o_still, (1, 2 + stages)), ticks)
        elif what == SHOW:
            _show(a, fed, _view(m, o_shown, (n_shown,)))
        elif what == START:
            _start(a, clock, fed)
            clock[NEXT] = -float(warm_up)
        elif what == WAKE:
            chain.wake(a.s, a.p, 0, as_outputs(a.outputs).i_cmd)
        else:
            _change(a)

    return serve
