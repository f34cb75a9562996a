"""One tick of the closed loop, written once: lockstep, the nodes on the bus, replay and injection all run it.

Tick k, at t = k ms, in two halves; what is logged or sent at t is taken between them::

    `arrive`    a good frame of the ECU came: its demand, late and held as can_delay and frame_hold say
    `control`   the calibration as it is flashed, the sensors' samples at t, the firmware's tick, its current
    `move`      the plant moves on to t + 1 ms under the new current

Everything works in place on the arrays of a `Loop` and allocates nothing. An effect whose parameters change in ``p``
while the loop runs acts from the next tick on; `plant.parameters.derive` must follow such a change.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from controller import Calibration, new_inputs, new_outputs, new_state
from controller.records import SLOW, Record, as_inputs, as_outputs, as_scalars, as_state, state_rows
from hil.loop.pair import controller, new_pair
from hil.native.program import readable
from plant import Plant, chain, curve, places
from plant.effects import CURVES, can_delay, controller_gain_error, frame_hold, schedule_error, trend_threshold_error
from vaneloop.base.compiled import in_place, inlined
from vaneloop.base.vanes import same_stages

__all__ = [
    "FRAME",
    "KEPT",
    "Loop",
    "arrive",
    "control",
    "flashed",
    "hear",
    "mean_current",
    "mean_stroke",
    "move",
    "new_loop",
    "reflash",
]

FRAME = 1e-2  # s, period of the ECU's frame
KEPT = 256  # contents of frames kept: can_delay and frame_hold together reach back 2 s
CHANGED_BY = (
    places.SCHEDULE_ERROR,
    places.TREND_THRESHOLD_ERROR,
    places.CONTROLLER_GAIN_ERROR,
)  # rows of p that the flashed calibration has


class Loop(NamedTuple):
    """What the one tick works on.

    inputs, outputs, z  float64[n], the firmware's (`controller.records`); ``fed``, ``given``, ``state``: their records
    built        calibration as the tables have it
    calibration  the same as it is flashed: with the effects that change tables and gains
    flash        float64[3] those effects' parameters, as flashed
    s, p         the plant's state and parameters
    z_rows, s_rows  int64: numbers of z and rows of s that this machine has; the others are of stages it lacks
    sigma        float64[2 + stages] rms noise of the sensors, SI (LVDT, each potentiometer, speed; of two actuators,
                 B's LVDT); zeros = noise-free
    mean         float64[2] sum and number of currents since the last one that was logged or sent
    angles       float64[stages] rad, the potentiometers' readings at this tick
    pots         float64[frames or 0, 2 stages] what the controller gets of each reading: share of it and offset
                 (rad; NaN = not fitted), stage by stage, a row every 10 ms, the last one held
    lvdt         float64[0 or 1] stroke (m) that the controller gets in place of the LVDT's; NaN: the LVDT's
    sides        float64[0, or 2 of two actuators] m, the LVDTs' readings of A and B at this tick; the controller gets
                 their mean, two channels one each
    sent         float64[KEPT, 4] contents of good frames: number of the 10 ms in which it came, n_dem, n_r (%),
                 mode_request
    foreign      a controller of the user's own (`hil.native.call.Foreign`); (): the firmware here
    pair         two channels of it (`hil.loop.pair.Pair`), then ``z``, ``inputs`` and ``outputs`` are those of the one
                 in charge; (): one channel
    """

    inputs: np.ndarray
    outputs: np.ndarray
    z: np.ndarray
    built: Calibration
    calibration: Calibration
    flash: np.ndarray
    s: np.ndarray
    p: np.ndarray
    z_rows: np.ndarray
    s_rows: np.ndarray
    sigma: np.ndarray
    mean: np.ndarray
    angles: np.ndarray
    pots: np.ndarray
    lvdt: np.ndarray
    sides: np.ndarray
    sent: np.ndarray
    foreign: Any = ()
    pair: Any = ()

    @property
    def fed(self) -> Record:
        """The firmware's inputs by name."""
        return as_inputs(self.inputs)

    @property
    def given(self) -> Record:
        """The firmware's outputs by name."""
        return as_outputs(self.outputs)

    @property
    def state(self) -> Record:
        """The firmware's state by name."""
        return as_state(self.z)

    def begin_on(self, direction: float, blend: float) -> None:
        """Let the controller, each channel of it, begin on a curve: as `controller.records.STATE_FIELDS` have it."""
        for z in (self.z, *(self.pair.z if self.pair else ())):
            as_state(z).direction, as_state(z).blend = direction, blend


def new_loop(
    plant: Plant,
    calibration: Calibration,
    *,
    n_engine: float,
    n_r: float,
    t_oil: float,
    noisy: bool,
    pots: np.ndarray | None = None,
) -> Loop:
    """Return a loop at rest: its engine at ``n_engine`` (%), its stroke where the mean curve has it at the measured
    speed ``n_r`` (%). Raises InputError for a controller and a plant with different stages.
    """
    same_stages(geometry=plant.vanes, vane_angles=calibration.vanes)
    stages = len(plant.vanes)
    cal = flashed(calibration, plant)
    pair = () if calibration.channels is None else new_pair(plant, calibration)
    foreign = () if calibration.program is None else calibration.program.start(cal)
    stroke = mean_stroke(cal.table, n_r)
    return Loop(
        new_inputs(),
        new_outputs(),
        new_state(),
        calibration._replace(program=None, channels=None),
        cal,
        plant.p[list(CHANGED_BY), 0],
        plant.start(stroke=stroke, n_r=n_engine, t_oil=t_oil),
        plant.p.copy(),
        state_rows(stages),
        plant.rows,
        plant.sigma.copy() if noisy else np.zeros_like(plant.sigma),
        np.zeros(2),
        np.zeros(stages),
        np.empty((0, 2 * stages)) if pots is None else np.ascontiguousarray(pots, dtype=np.float64),
        np.full(1, np.nan),
        np.full(plant.sides if plant.sides > 1 else 0, stroke),
        np.full((KEPT, 4), np.nan),
        foreign,
        pair,
    )


def flashed(calibration: Calibration, plant: Plant) -> Calibration:
    """Return the calibration as it is in the controller: with the effects that change its tables and gains."""
    if calibration.program is None:
        cal = calibration._replace(k=calibration.k.copy(), table=calibration.table.copy(), channels=None)
    else:
        cal = readable(calibration)
    _flash(
        calibration._replace(program=None, channels=None), cal, np.empty(3), plant.p, plant.p[places.SCHEDULE_ERROR, 0]
    )
    return cal


@in_place
def _flash(built: Calibration, cal: Calibration, flash: np.ndarray, p: np.ndarray, offset: float) -> None:
    """Write ``built``, with the effects in ``p`` that change tables and gains, into ``cal``; ``offset`` (m): of the
    tables.
    """
    flash[0], flash[1], flash[2] = (offset, p[places.TREND_THRESHOLD_ERROR, 0], p[places.CONTROLLER_GAIN_ERROR, 0])
    for row in range(1, built.table.shape[0]):
        for i in range(built.table.shape[1]):
            cal.table[row, i] = schedule_error.step(built.table[row, i], flash[0])
    k, was = as_scalars(cal.k), as_scalars(built.k)
    k.trend_rate_on = trend_threshold_error.step(was.trend_rate_on, flash[1])
    k.trend_change = trend_threshold_error.step(was.trend_change, flash[1])
    k.kp = controller_gain_error.step(was.kp, flash[2])
    k.ki = controller_gain_error.step(was.ki, flash[2])
    k.kff = controller_gain_error.step(was.kff, flash[2])


@in_place
def mean_stroke(table: np.ndarray, n_r: float) -> float:
    """Return the stroke (m) that the mean curve of a `Calibration.table` has at the speed ``n_r`` (%): where a machine
    starts.
    """
    last = table.shape[1] - 1
    if not n_r > table[0, 0]:
        return table[3, 0]
    for i in range(last):
        if n_r < table[0, i + 1]:
            slope = (table[3, i + 1] - table[3, i]) / (table[0, i + 1] - table[0, i])
            return slope * (n_r - table[0, i]) + table[3, i]
    return table[3, last]


@in_place
def _last_by(sent: np.ndarray, then: int, now: int) -> int:
    """Return the row of the last frame that came in the 10 ms ``then`` or before; of the first one kept if there is
    none.
    """
    then = min(then, now)
    for q in range(then, now - KEPT, -1):
        if sent[q % KEPT, 0] == q:
            return q % KEPT
    first = now
    for q in range(now, max(then, now - KEPT), -1):
        if sent[q % KEPT, 0] == q:
            first = q
    return first % KEPT


@inlined
def arrive(k: int, a: Loop, n_dem: float, n_r: float, mode_request: float) -> None:
    """Give the controller what it gets of a good frame of the ECU that comes at tick ``k``: the content of this one or
    of an older one.
    """
    now = k // SLOW
    at = now % KEPT
    a.sent[at, 0], a.sent[at, 1], a.sent[at, 2], a.sent[at, 3] = now, n_dem, n_r, mode_request
    delay, period = a.p[places.CAN_DELAY, 0], a.p[places.FRAME_HOLD, 0]
    if delay > 0.0 or period > 0.0:
        content = can_delay.step(now * SLOW * chain.TICK, delay)
        content = frame_hold.step(content, period)
        at = _last_by(a.sent, int(math.floor(content / FRAME + 1e-6)), now)
    inputs = as_inputs(a.inputs)
    inputs.n_dem, inputs.n_r, inputs.mode_request = a.sent[at, 1], a.sent[at, 2], a.sent[at, 3]


@inlined
def reflash(a: Loop) -> None:
    """Flash the calibration anew where the parameters of an effect that changes it are others than those flashed."""
    p = a.p
    offset = p[places.SCHEDULE_ERROR, 0]
    if p[CURVES, 0] != 0.0:
        offset += curve.bend(a.s, p, 0, curve.DEMAND_ADDS)
    if (
        offset != a.flash[0]
        or p[places.TREND_THRESHOLD_ERROR, 0] != a.flash[1]
        or p[places.CONTROLLER_GAIN_ERROR, 0] != a.flash[2]
    ):
        _flash(a.built, a.calibration, a.flash, p, offset)


@inlined
def hear(
    a: Loop, n_dem: float, n_r: float, fresh: float, rejected: float, mode_request: float, k: int, noise: float
) -> float:
    """Let the ECU's frame of tick ``k``, a multiple of 10, come; return the measured speed (%) in it.

    n_r    %, measured; NaN: the speed of the plant's own engine, with ``noise`` (standard normal)
    fresh  1: a good frame; 0: none came.  rejected: frames refused
    """
    if n_r != n_r:
        n_r = a.s[places.N_R, 0] + a.sigma[1 + a.angles.shape[0]] * noise
    inputs = as_inputs(a.inputs)
    inputs.demand_fresh = fresh
    inputs.demand_rejected = rejected
    if fresh > 0.5:
        arrive(k, a, n_dem, n_r, mode_request)
    return n_r


@inlined
def control(k: int, a: Loop, noise: np.ndarray, row: int, t_oil: float) -> None:
    """Sample the sensors and run the firmware at tick ``k``.

    noise  float64[:, sensors] standard normal numbers in the order of `Loop.sigma`, this tick's in ``row``
    """
    s, p, inputs, sigma = a.s, a.p, as_inputs(a.inputs), a.sigma
    reflash(a)
    inputs.x_lvdt = chain.sample_lvdt(s, p, 0, sigma[0] * noise[row, 0], t_oil)
    if a.sides.shape[0] > 0:
        last = a.angles.shape[0] + 2
        a.sides[0] = inputs.x_lvdt
        a.sides[1] = chain.sample_lvdt(s, p, 1, sigma[last] * noise[row, last], t_oil)
        inputs.x_lvdt = 0.5 * (a.sides[0] + a.sides[1])
    if a.lvdt.shape[0] > 0 and a.lvdt[0] == a.lvdt[0]:
        inputs.x_lvdt = a.lvdt[0]
        for side in range(a.sides.shape[0]):
            a.sides[side] = a.lvdt[0]
    for q in range(a.angles.shape[0]):
        a.angles[q] = s[places.POT + q, 0] + sigma[1 + q] * noise[row, 1 + q]
        inputs.pots[q] = a.angles[q]
    if a.pots.shape[0] > 0:
        r = min(max(k // SLOW, 0), a.pots.shape[0] - 1)
        for q in range(a.angles.shape[0]):
            inputs.pots[q] = a.pots[r, 2 * q] * inputs.pots[q] + a.pots[r, 2 * q + 1]
    controller(k, a.inputs, a.outputs, a.z, a.calibration, a.foreign, a.pair, a.sides)
    if p[CURVES, 0] != 0.0:
        out, most = as_outputs(a.outputs), as_scalars(a.calibration.k).current_limit
        bent = out.i_cmd * curve.factor(s, p, 0, curve.SERVO_TIMES) + curve.bend(s, p, 0, curve.SERVO_ADDS)
        out.i_cmd = min(max(bent, -most), most)
    a.mean[0] += as_outputs(a.outputs).i_cmd
    a.mean[1] += 1.0


@inlined
def mean_current(a: Loop) -> float:
    """Return the mean current (A) of the ticks since it was last asked for."""
    mean = a.mean[0] / a.mean[1]
    a.mean[0], a.mean[1] = 0.0, 0.0
    return mean


@inlined
def move(k: int, a: Loop, n_dem: float, n_r: float, p_s: float, t_oil: float) -> None:
    """Let the machine move on from tick ``k`` to the next under the controller's current, at demand ``n_dem`` and speed
    ``n_r`` (%).
    """
    s, p = a.s, a.p
    if p[CURVES, 0] != 0.0:
        out = as_outputs(a.outputs)
        curve.follow(s, p, 0, out.i_cmd, as_state(a.z).x_dem, n_dem, n_r, p_s, t_oil, k * chain.TICK)
    chain.rotor_step(s, p, 0, n_dem, chain.TICK)
    chain.drive_step(s, p, 0, as_outputs(a.outputs).i_cmd, n_r, p_s, t_oil, chain.TICK, chain.SUBSTEPS)
    chain.vane_step(s, p, 0, n_r, t_oil, (k + 1) * chain.TICK)
