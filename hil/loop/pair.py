"""Two channels of the controller in the one tick: their firmware, the link and the lines between them, the coils.

The torque motor of a valve has a coil for each channel, whose ampere turns add. Of an open coil no current comes, and
its driver's voltage is at its end; of a shorted one the current comes, but flows past the turns, and there is no
voltage. What is decided from that is `controller.channels`; here is what happens to it, and its order in a tick::

    A, then B   power; message of the other; selection; firmware; integral of a standby
    both        health; latch; share of the drive; coils, and what their drivers read back; message for the next tick

What leaves the pair is what the channel in charge says, with the current that both coils make together.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from controller import Calibration, new_inputs, new_state, tick
from controller.channels import (
    CATCH_UP,
    CHANNEL_FIELDS,
    KEPT,
    LATCH_FIELDS,
    LINE_FIELDS,
    LINK,
    NEVER,
    as_channel,
    as_latch,
    as_line,
    as_pair,
    change_over,
    health_of,
    judge_coil,
    linked,
    listen,
    new_channel,
    pass_on,
    select,
    share_of,
    speak,
    track,
)
from controller.records import (
    DEGRADED,
    INIT,
    RUN,
    STATE_FIELDS,
    as_inputs,
    as_outputs,
    as_scalars,
    as_state,
    flat_names,
)
from hil.native.call import firmware
from plant import Plant
from vaneloop.base.compiled import in_place
from vaneloop.base.errors import InputError

__all__ = ["COILS", "LVDTS", "Pair", "control_pair", "controller", "new_pair", "remember", "seen"]

COILS = ("whole", "open", "short")
WHOLE, OPEN, SHORT = range(len(COILS))
LVDTS = ("whole", "lost", "frozen")
_, LOST, FROZEN = range(len(LVDTS))


class Pair(NamedTuple):
    """What two channels work on, A's row, then B's.

    k        float64[n] of `controller.channels.PAIR_FIELDS`
    memory   float64[n] states, latch and lines, for a state hash; the messages under way follow from them
    z        float64[2, n] the firmware's states
    w        float64[2, n] the channels' own (`CHANNEL_FIELDS`)
    latch    float64[n] (`LATCH_FIELDS`)
    link     float64[2, KEPT, n] messages under way, of the one that sent them
    line     float64[2, n] the link in that direction (`LINE_FIELDS`)
    coil     float64[2] numbers in `COILS`
    lvdt     float64[2] numbers in `LVDTS`; held: float64[2] m, the last samples, where one freezes
    power    float64[2] 1: supplied
    inputs   float64[2, n] of the firmware
    fresh_z, fresh_w  float64[n] states of a channel that was just switched on
    """

    k: np.ndarray
    memory: np.ndarray
    z: np.ndarray
    w: np.ndarray
    latch: np.ndarray
    link: np.ndarray
    line: np.ndarray
    coil: np.ndarray
    lvdt: np.ndarray
    held: np.ndarray
    power: np.ndarray
    inputs: np.ndarray
    fresh_z: np.ndarray
    fresh_w: np.ndarray


def new_pair(plant: Plant, calibration: Calibration) -> Pair:
    """Return two channels that have just been switched on, A in charge. Raises InputError for a machine without two
    actuators, and for a controller of the user's own.
    """
    if plant.sides != 2:
        raise InputError(
            f"calibration: channels.number (=2) needs two actuators; the plant table's actuators.number is "
            f"{plant.sides} (--plant plant_two_actuators.toml)"
        )
    if calibration.program is not None:
        calibration.of_one_channel("a controller of your own")
    assert calibration.channels is not None
    sizes = [len(flat_names(of)) for of in (STATE_FIELDS, CHANNEL_FIELDS, LATCH_FIELDS, LINE_FIELDS)]
    shapes = [(2, sizes[0]), (2, sizes[1]), (sizes[2],), (2, sizes[3])]
    memory, at, parts = np.zeros(sum(int(np.prod(s)) for s in shapes)), 0, []
    for shape in shapes:
        parts.append(memory[at : at + int(np.prod(shape))].reshape(shape))
        at += parts[-1].size
    z, w, latch, line = parts
    z[:], w[:] = new_state(), new_channel()
    link = np.full((2, KEPT, len(LINK)), NEVER)
    for side in range(2):
        as_line(line[side]).chance = 1.0 + side
    inputs = np.array([new_inputs()] * 2)
    coil, lvdt, held = np.zeros((3, 2))
    return Pair(
        calibration.channels, memory, z, w, latch, link, line, coil, lvdt, held, np.ones(2), inputs,
        new_state(), new_channel(),
    )  # fmt: skip


def seen(q: Pair) -> list[float]:
    """What is seen of both channels: `controller.channels.SEEN`; ``in_charge`` 1 for A, 2 for B."""
    latch, w, z = as_latch(q.latch), [as_channel(row) for row in q.w], [as_state(row) for row in q.z]
    of_each = (
        (z[0].mode, z[1].mode), *((w[0][name], w[1][name]) for name in ("source", "health")),
        *((1e3 * w[0][name], 1e3 * w[1][name]) for name in ("x_select", "i_sent", "age")),
    )  # fmt: skip
    return [float(latch.in_charge) + 1.0, float(latch.changes), *(float(v) for pair in of_each for v in pair)]


@in_place
def _copy(to: np.ndarray, of: np.ndarray) -> None:
    for row in range(to.shape[0]):
        to[row] = of[row]


@in_place
def _catch_up(q: Pair, c: int, in_charge: bool) -> None:
    """Give a channel that came up the slow state of the one in charge, once."""
    w, z, other = as_channel(q.w[c]), as_state(q.z[c]), as_channel(q.w[1 - c])
    if w.caught_up == 1.0 or z.mode == INIT:
        return
    if in_charge:
        w.caught_up = 1.0
    elif linked(w, as_pair(q.k)) and other.power == 1.0 and (w.other_mode == RUN or w.other_mode == DEGRADED):
        for row in CATCH_UP:
            q.z[c, row] = q.z[1 - c, row]
        w.caught_up = 1.0


@in_place
def _drive(q: Pair, on: int) -> float:
    """Send the currents through the coils; return what they make together (A)."""
    total = 0.0
    for c in range(2):
        w, of = as_channel(q.w[c]), as_pair(q.k)
        i = share_of(w, as_channel(q.w[1 - c]), of, c == on) * as_state(q.z[c]).i_cmd
        w.i_sent = i
        coil = int(q.coil[c])
        if w.power == 1.0:
            judge_coil(w, of, 0.0 if coil == OPEN else i, 0.0 if coil == SHORT else 2.0 * i if coil == OPEN else i)
        total += i if coil == WHOLE else 0.0
    return total


@in_place
def control_pair(
    k: int, inputs: np.ndarray, outputs: np.ndarray, z: np.ndarray, cal: Calibration, q: Pair, x_a: float, x_b: float
) -> None:
    """Run both channels for tick ``k`` on the LVDTs' samples ``x_a``, ``x_b`` (m).

    inputs   what both get, and of the channel in charge the stroke that it believes
    outputs  of the channel in charge, with the current of both coils
    z        a copy of its state
    """
    of, scalars, latch = as_pair(q.k), as_scalars(cal.k), as_latch(q.latch)
    on = int(latch.in_charge)
    for c in range(2):
        w, state, x = as_channel(q.w[c]), as_state(q.z[c]), x_b if c == 1 else x_a
        if q.lvdt[c] == FROZEN:
            x = q.held[c]
        q.held[c] = x
        if q.power[c] != w.power:
            if q.power[c] == 1.0:
                _copy(q.z[c], q.fresh_z)
                _copy(q.w[c], q.fresh_w)
            else:
                w.power = 0.0
        if w.power == 0.0:
            continue
        _copy(q.inputs[c], inputs)
        fed = as_inputs(q.inputs[c])
        listen(w, q.link[1 - c], as_line(q.line[1 - c]), k)
        i = w.other_i if c != on and linked(w, of) else state.i_cmd
        was = int(w.source)
        fed.x_lvdt = select(w, of, scalars, np.nan if q.lvdt[c] == LOST else x, i, fed.pause)
        pass_on(w, state, was)
        tick(q.inputs[c], q.z[c], cal)
        _catch_up(q, c, c == on)
        track(w, state, of, scalars, c == on)
    a, b = as_channel(q.w[0]), as_channel(q.w[1])
    a.health, b.health = health_of(a, as_state(q.z[0])), health_of(b, as_state(q.z[1]))
    change_over(latch, a, b, of)
    on = int(latch.in_charge)
    total = _drive(q, on)
    for c in range(2):
        if q.power[c] == 1.0:
            speak(as_channel(q.w[c]), as_state(q.z[c]), q.link[c], as_line(q.line[c]), k)
    given, state = as_outputs(outputs), as_state(q.z[on])
    given.i_cmd, given.x_dem, given.mode, given.faults = total, state.x_dem, state.mode, state.faults
    as_inputs(inputs).x_lvdt = as_channel(q.w[on]).x_select
    _copy(z, q.z[on])


def controller(
    k: int, inputs: np.ndarray, outputs: np.ndarray, z: np.ndarray, calibration: Calibration, foreign: Any,
    pair: Any, sides: np.ndarray,
) -> None:  # fmt: skip
    """Run the controller for tick ``k``: two channels where ``pair`` is one, else one (`firmware`)."""
    if isinstance(pair, Pair):
        control_pair(k, inputs, outputs, z, calibration, pair, sides[0], sides[1])
    else:
        firmware(inputs, outputs, z, calibration, foreign)


_AS_INLINED: Any = {  # as `hil.native.call.firmware`
    "_nrt": False, "forceinline": True, "error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True
}  # fmt: skip


@overload(controller, jit_options=_AS_INLINED)
def _controller(
    k: Any, inputs: Any, outputs: Any, z: Any, calibration: Any, foreign: Any, pair: Any, sides: Any
) -> Any:
    def one(
        k: Any, inputs: Any, outputs: Any, z: Any, calibration: Any, foreign: Any, pair: Any, sides: Any
    ) -> None:  # fmt: skip
        firmware(inputs, outputs, z, calibration, foreign)

    def two(
        k: Any, inputs: Any, outputs: Any, z: Any, calibration: Any, foreign: Any, pair: Any, sides: Any
    ) -> None:  # fmt: skip
        control_pair(k, inputs, outputs, z, calibration, pair, sides[0], sides[1])

    return two if isinstance(pair, types.NamedTuple) else one


def remember(pair: Any, row: np.ndarray, at: int) -> None:
    """Write what two channels remember into a ``row`` of a snapshot, from the number ``at`` on; of one channel
    nothing.
    """
    if isinstance(pair, Pair):
        row[at : at + len(pair.memory)] = pair.memory


@overload(remember, jit_options=_AS_INLINED)
def _remember(pair: Any, row: Any, at: Any) -> Any:
    def one(pair: Any, row: Any, at: Any) -> None:
        pass

    def two(pair: Any, row: Any, at: Any) -> None:
        for q in range(pair.memory.shape[0]):
            row[at + q] = pair.memory[q]

    return two if isinstance(pair, types.NamedTuple) else one
