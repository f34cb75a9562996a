"""Two channels of the controller, A and B: the stroke that each believes, what it tells the other, which one drives.

Each channel runs the firmware (`controller.firmware`) on the LVDT of its own actuator. Every tick of one of them::

    own LVDT -> range, rate, stuck --+
    link: the other's stroke, age ---+--> selection --> firmware --> i_cmd --> its coil, if it is to drive
    model of the actuator -----------+                     ^
    standby: its integral follows the current of the one in charge

**Selection.** Both good and within ``disagree_limit``: their mean. Farther apart for ``confirm_time``: the one that is
nearer to the model; until then the model itself stands in. One alone is good: that one at once. None: none, and the
firmware has the faults of the channel's LVDT. The way back to the mean asks for ``disagree_limit`` less ``hysteresis``
over the same time; from one of two that disagree to the other it must be nearer by ``hysteresis``. A change fades in at
``fade_rate``, so that the piston is not moved by a step.

**Model.** First-order rate of the stroke under the sent current, held to the selected stroke x_s by a critically damped
observer, which stands still while a change is being confirmed::

    dv/dt = (G i - v) / T_v,   dx/dt = v + d + 2 (x_s - x) / T,   dd/dt = (x_s - x) / T^2

Symbols: G rate_gain (m/s/A), T_v rate_lag (s), T model_time (s), d drift (m/s): what null bias and a wrong gain leave.

**Link.** A message each tick: stroke, whether it is good, mode, health, current. Its age grows until the next one
comes; one older than ``link_timeout`` is not used. The stroke is moved on by the model's speed times its age.

**Health.** 0 failed (off, in INIT, coil wrong), 1 FAIL_SAFE, 2 DEGRADED, 3 fit. Discrete lines take it to a latch,
which gives the drive to one of them: to the other one once that was healthier for ``takeover_time``. So a lost link
leaves neither both in charge nor none.

**Coils.** The driver of a coil reads back its current and its voltage over the coil's resistance. Either more than
``coil_limit`` off the command for ``coil_time``: the coil is wrong until the channel is switched off and on.

Limits: two LVDTs that disagree from the first sample on cannot be told apart, and each channel takes its own; nor can
one that drifts more slowly than ``disagree_limit`` in ``model_time``.
Source: selection of duplex sensors, Collinson, Introduction to Avionics Systems (2011), ch. 4; back-calculation of an
integral, Astrom and Hagglund, Advanced PID Control (2006), section 3.5.
"""

from __future__ import annotations

import math

import numpy as np

from controller.monitors import FAR, condition_lvdt
from controller.records import (
    DEGRADED,
    FAIL_SAFE,
    FAULT_FIELDS,
    FAULTS,
    HALF_TICK,
    INIT,
    LVDT_MASK,
    STATE,
    TICK,
    Field,
    Record,
    flat,
    flat_names,
    record,
    viewer,
)
from vaneloop.base.compiled import in_place

__all__ = [
    "CATCH_UP", "CHANNELS", "CHANNEL_FIELDS", "HEALTHS", "KEPT", "LATCH_FIELDS", "LINE_FIELDS", "LINK", "NEVER",
    "PAIR_FIELDS", "PAIR_SCALARS", "SEEN", "SOURCES", "as_channel", "as_latch", "as_line", "as_pair", "change_over",
    "health_of", "judge_coil", "linked", "listen", "new_channel", "pass_on", "select", "share_of", "speak", "track",
]  # fmt: skip

CHANNELS = ("A", "B")
SOURCES = ("mean", "own", "other", "none", "model")
MEAN, OWN, OTHER, NONE, MODEL = range(5)
HEALTHS = ("failed", "fail-safe", "degraded", "fit")
FAILED, AT_FAIL_SAFE, AT_DEGRADED, FIT = range(4)
KEPT = 256  # messages under way: a delay of up to 0.2 s
NEVER = -1e9  # tick of a message that never came

PAIR_FIELDS = (
    Field("both", "-", "1: both drive half each; 0: the one in charge drives alone"),
    Field("disagree_limit", "m", "farthest apart that two good strokes are taken for the same"),
    Field("hysteresis", "m", "of the way back to the mean, and from one stroke to the other"),
    Field("confirm_time", "s", "for which a change of source must be due"),
    Field("fade_rate", "m/s", "at which it fades in"),
    Field("rate_gain", "m/s/A", "speed of the piston for the current"),
    Field("rate_lag", "s", "of that speed behind the current"),
    Field("model_time", "s", "of the observer"),
    Field("link_timeout", "s", "age beyond which a message is not used"),
    Field("track_time", "s", "in which a standby's integral follows"),
    Field("takeover_time", "s", "for which the standby must be healthier"),
    Field("coil_limit", "A", "farthest that what a driver reads back is from its command"),
    Field("coil_time", "s", "beyond it: the coil is wrong"),
)
PAIR_SCALARS = flat_names(PAIR_FIELDS)

CHANNEL_FIELDS = (
    Field("power", "-", "1: on"),
    # of its own LVDT, under the names that `condition_lvdt` works on
    Field("x_meas", "m", "last plausible stroke"),
    Field("x_reach", "m", "how far from x_meas the stroke can have come since that sample"),
    Field("lvdt_good", "-", "1 if the last sample was plausible"),
    Field("stuck_x", "m", "where the stuck timer started"),
    Field("stuck_timer", "s", "of a current that moves nothing"),
    Field("i_cmd", "A", "current that moves the actuator, as far as the channel knows"),
    Field("faults", "-", "bit mask of the firmware's faults; those of the LVDT"),
    Field("timers", "s", "of them", FAULT_FIELDS),
    Field("good", "-", "1: its stroke is plausible and its LVDT has no fault"),
    # selection
    Field("source", "-", "number of the settled source in `SOURCES`"),
    Field("basis", "-", "the same, the model while a change is being confirmed"),
    Field("source_timer", "s", "for which a change has been due"),
    Field("fade", "m", "of the last change, what is still to come"),
    Field("x_select", "m", "selected stroke"),
    Field("x_model", "m", "stroke of the model"),
    Field("v_model", "m/s", "its speed under the current"),
    Field("v_drift", "m/s", "what null bias and a wrong gain add"),
    # what came over the link
    Field("heard", "-", "tick at which the last message was sent"),
    Field("age", "s", "of the last message"),
    Field("other_x", "m", "the other's stroke"),
    Field("other_good", "-", "1: it is good"),
    Field("other_mode", "-", "the other's mode"),
    Field("other_health", "-", "the other's health"),
    Field("other_i", "A", "the other's current command"),
    # drive
    Field("integral", "A", "of the firmware's servo, as the last tick left it"),
    Field("caught_up", "-", "1 once it has the other's slow state, or was in charge"),
    Field("health", "-", "number in `HEALTHS`"),
    Field("i_sent", "A", "current that its driver is to send through its coil"),
    Field("coil_timer", "s", "for which what the driver reads back is wrong"),
    Field("coil_fault", "-", "1: the coil is wrong"),
)
LATCH_FIELDS = (
    Field("in_charge", "-", "0 A, 1 B"),
    Field("timer", "s", "for which the standby has been healthier"),
    Field("changes", "-", "change-overs since power-on"),
)
LINE_FIELDS = (  # the link in one direction
    Field("delay", "s", "beyond the tick that a message takes"),
    Field("loss", "-", "share of the messages that are lost"),
    Field("chance", "-", "state of the random numbers that decide it"),
)
LINK = ("tick", "x", "good", "mode", "health", "i_cmd")  # of a message
# what is seen of both from outside, in the units of the border (mm, mA, ms)
SEEN = (
    "in_charge", "changes", "mode_a", "mode_b", "source_a", "source_b", "health_a", "health_b", "x_select_a",
    "x_select_b", "i_a", "i_b", "link_age_a", "link_age_b",
)  # fmt: skip
M_TICK, M_X, M_GOOD, M_MODE, M_HEALTH, M_I = range(len(LINK))

# what a channel that comes up copies from the one in charge: all that follows from demand and speed over a longer time
_SLOW = (
    "n_r", "trend_n", "trend_rate", "trend_turn", "trend_timer", "direction", "blend", "trend_last", "x_target",
    "speed", "speed_rate", "speed_drift", "speed_noise", "side", "crossing", "offset_in_use", "width_in_use",
)  # fmt: skip
_SLOW_OF_STAGES = (
    "farthest_", "engaged_", "offset_", "width_", "proved_", "learned_", "trusted_", "lowest_", "highest_",
)  # fmt: skip
CATCH_UP = np.array([i for i, name in enumerate(STATE) if name in _SLOW or name.startswith(_SLOW_OF_STAGES)])

as_pair, as_channel, as_latch, as_line = map(viewer, (PAIR_FIELDS, CHANNEL_FIELDS, LATCH_FIELDS, LINE_FIELDS))
MULTIPLIER, MODULUS = 16807.0, 2147483647.0  # Park and Miller (1988)


def new_channel() -> np.ndarray:
    """State (float64[n] of `CHANNEL_FIELDS`) of a channel that has just been switched on."""
    w = record(CHANNEL_FIELDS)
    w.power, w.x_reach, w.source, w.basis, w.heard, w.age = 1.0, FAR, NONE, NONE, NEVER, FAR
    return flat(w)


# ---- link ------------------------------------------------------------------------------------------------------------


@in_place
def speak(w: Record, z: Record, link: np.ndarray, line: Record, k: int) -> None:
    """Send the message of tick ``k``: ``link`` (float64[KEPT, `LINK`]) keeps it until the other one takes it, and a
    ``line`` with losses may lose it.

    z  the firmware's state
    """
    row = link[k % KEPT]
    row[M_TICK], row[M_X], row[M_GOOD], row[M_MODE], row[M_HEALTH], row[M_I] = (
        float(k), w.x_meas, w.good, z.mode, w.health, z.i_cmd
    )  # fmt: skip
    if line.loss > 0.0:
        line.chance = line.chance * MULTIPLIER % MODULUS
        if line.chance <= line.loss * MODULUS:
            row[M_TICK] = NEVER


@in_place
def listen(w: Record, link: np.ndarray, line: Record, k: int) -> None:
    """Take what comes over the ``link`` at tick ``k``: the message that was sent a tick and the line's delay before."""
    sent = k - 1 - int(line.delay / TICK + 0.5)
    row = link[sent % KEPT]
    if row[M_TICK] == sent and sent > w.heard:
        w.heard = float(sent)
        w.other_x, w.other_good, w.other_mode = row[M_X], row[M_GOOD], row[M_MODE]
        w.other_health, w.other_i = row[M_HEALTH], row[M_I]
    w.age = min((k - w.heard) * TICK, FAR)


@in_place
def linked(w: Record, c: Record) -> bool:
    """Whether the last message is young enough to be used."""
    return w.age <= c.link_timeout + HALF_TICK


# ---- selection -------------------------------------------------------------------------------------------------------


@in_place
def wanted(w: Record, c: Record, x_other: float) -> int:
    """Return the source to which two good strokes ask for: the own one, and the other's at this time (m)."""
    was, apart = int(w.source), abs(w.x_meas - x_other)
    own, other = abs(w.x_meas - w.x_model), abs(x_other - w.x_model)
    if was == OWN or was == OTHER:
        if apart < c.disagree_limit - c.hysteresis:
            return MEAN
        if was == OWN:
            return OTHER if own > other + c.hysteresis else OWN
        return OWN if other > own + c.hysteresis else OTHER
    if apart <= c.disagree_limit:
        return MEAN
    return OWN if was == NONE or own <= other else OTHER


@in_place
def select(w: Record, c: Record, k: Record, x: float, i: float, pause: float) -> float:
    """Return the stroke (m) that a channel believes at this tick; NaN: none.

    c, k   `PAIR_FIELDS`; the firmware's calibration, for the monitors of the LVDT
    x, i   m, sample of its own LVDT; A, current that moves the actuator
    pause  s, for which it stood still before this tick
    """
    w.i_cmd = i
    condition_lvdt(w, k, x, pause)
    w.good = 1.0 if w.lvdt_good == 1.0 and int(w.faults) & LVDT_MASK == 0 else 0.0
    w.v_model += (c.rate_gain * i - w.v_model) * TICK / (c.rate_lag + TICK)
    moved = (w.v_model + w.v_drift) * TICK
    w.x_model += moved
    was = int(w.source)
    x_other = w.other_x + moved * (w.age / TICK)
    own, other = w.good == 1.0, linked(w, c) and w.other_good == 1.0
    if own and other:
        now = wanted(w, c, x_other)
        w.source_timer = 0.0 if now == was else w.source_timer + TICK
        if was != NONE and w.source_timer < c.confirm_time - HALF_TICK:
            now = was
    else:
        now = OWN if own else OTHER if other else NONE
        w.source_timer = 0.0
    if now != was:
        w.source_timer = 0.0
    basis, before = MODEL if w.source_timer > 0.0 else now, int(w.basis)
    w.source, w.basis = float(now), float(basis)
    if now == NONE:
        return math.nan
    chosen = w.x_meas if basis == OWN else x_other
    if basis == MODEL:
        chosen = w.x_model
    elif basis == MEAN:
        chosen = 0.5 * (w.x_meas + x_other)
    if basis != before:
        w.fade = 0.0 if before == NONE else w.x_select + moved - chosen
        w.x_model = chosen
    step = c.fade_rate * TICK
    w.fade -= min(max(w.fade, -step), step)
    if basis != MODEL:
        off = chosen - w.x_model
        w.x_model += 2.0 * off * TICK / c.model_time
        w.v_drift += off * TICK / (c.model_time * c.model_time)
    w.x_select = chosen + w.fade
    return w.x_select


@in_place
def pass_on(w: Record, z: Record, was: int) -> None:
    """Give the firmware the faults of the channel's LVDT while no stroke is left; take them back with the first good
    one.

    z    the firmware's state, before its tick
    was  the source of the tick before
    """
    none, own, faults = int(w.source) == NONE, int(w.faults) & LVDT_MASK, int(z.faults)
    if none:
        z.faults = float(faults | own)
    elif was == NONE:
        z.faults = float(faults & ~LVDT_MASK)
    for bit in range(len(FAULTS)):
        if LVDT_MASK & (1 << bit) and (own & (1 << bit) if none else was == NONE):
            z.timers[bit] = 0.0


# ---- health, change-over, drive --------------------------------------------------------------------------------------


@in_place
def health_of(w: Record, z: Record) -> float:
    """Return how fit a channel is to drive: number in `HEALTHS`."""
    mode = int(z.mode)
    if w.power == 0.0 or w.coil_fault == 1.0 or mode == INIT:
        return float(FAILED)
    return float(AT_FAIL_SAFE if mode == FAIL_SAFE else AT_DEGRADED if mode == DEGRADED else FIT)


@in_place
def change_over(latch: Record, a: Record, b: Record, c: Record) -> None:
    """Give the drive to the standby once it was healthier than the one in charge for ``takeover_time``: one tick."""
    better = b.health - a.health if latch.in_charge == 0.0 else a.health - b.health
    latch.timer = latch.timer + TICK if better > 0.0 else 0.0
    if latch.timer >= c.takeover_time - HALF_TICK:
        latch.in_charge, latch.timer, latch.changes = 1.0 - latch.in_charge, 0.0, latch.changes + 1.0


@in_place
def share_of(w: Record, other: Record, c: Record, in_charge: bool) -> float:
    """Return the share of its command that a channel sends through its coil: with ``both`` half of it while both are
    as healthy.
    """
    if w.power == 0.0:
        return 0.0
    if c.both == 1.0 and w.health == other.health and w.health > FAILED:
        return 0.5
    return 1.0 if in_charge else 0.0


@in_place
def track(w: Record, z: Record, c: Record, k: Record, in_charge: bool) -> None:
    """Let the integral of a standby follow the current of the one in charge, or stand where it does not hear it."""
    servo_on = z.mode != INIT and not (z.mode == FAIL_SAFE and int(z.faults) & LVDT_MASK != 0)
    if not in_charge and servo_on:
        if linked(w, c) and w.other_mode != INIT and w.other_mode != FAIL_SAFE:
            follow = z.integral + (w.other_i - z.i_cmd) * TICK / (c.track_time + TICK)
            z.integral = min(max(follow, -k.current_limit), k.current_limit)
        else:
            z.integral = w.integral
    w.integral = z.integral


@in_place
def judge_coil(w: Record, c: Record, current: float, voltage: float) -> None:
    """Judge what the driver of a coil reads back: its ``current`` (A) and its ``voltage`` over the coil's resistance
    (A).
    """
    wrong = abs(current - w.i_sent) > c.coil_limit or abs(voltage - w.i_sent) > c.coil_limit
    w.coil_timer = w.coil_timer + TICK if wrong else 0.0
    if w.coil_timer >= c.coil_time - HALF_TICK:
        w.coil_fault = 1.0
