"""The strategies inverse and adaptive: they follow each stage through its play, and learn play and offset.

docs/strategies.md has the reasons.
"""

from __future__ import annotations

import math

import numpy as np

from controller.records import HALF_TICK, RUN, SLOW_TICK, TICK, Record
from controller.schedule import ANGLE_STROKE, ANGLE_VIGV, ROW_SINGLE, ROW_SPEED, look_up
from vaneloop.base.compiled import in_place

__all__ = ["filter_pots", "inverse_step", "learn", "observe_speed"]

DRIFT_LIMIT = 3.0  # %/s
NOISE_SHARE = 2e-3  # of 10 ms: the noise is known after 5 s
QUICK = 0.02  # rad/s: targets that run faster are worth a faster crossing
SOFT_END = 0.25  # of what is left of the gap in 10 ms
POT_SHARE = 0.1  # of 1 ms: a lag of 10 ms
STROKE_SHARE = 0.1
OVERSHOT = 3e-5  # m: six times the LVDT's noise
# of 10 ms: five implausible readings cost the trust, one plausible takes back a tenth of one
SUSPICION, FORGIVEN = 0.2, 0.02
QUIET_MOTION, QUIET_ERROR = 2e-5, 1e-4  # m in 10 ms, m: the stroke is at rest
SETTLED = 0.1  # s at rest
UNSETTLED, MOVING = 0.004, 60.0  # rad, rad/m: what lags may add while the stroke moves: three steps at 20 rad/m
KNOWN, WELL_KNOWN = 15.0, 30.0  # s of learning on a side
SEEN_AGAIN = 0.6  # of well known: a side to which the stage comes back may have moved since


@in_place
def observe_speed(z: Record, k: Record) -> None:
    """Rotor speed and its rate without the noise and the lag of a filter: one 10 ms step.

    ::

        rate = clip((n_dem - n) / engine_lag, -engine_deceleration, engine_acceleration) + drift
        n- = n + rate T,   e = n_r - n-,   n = n- + observer_alpha e,   drift = drift + observer_beta e / T

    The engine's model is driven by the demand, so the rate is there before the speed has moved. ``drift`` takes up what
    the model does not know. Whatever the model says, n stays within ``observer_band`` of the filtered measurement.
    Without a new frame the model goes on alone; without one for ``demand_timeout`` the speed stands.
    """
    if k.table_input == 1.0:
        z.speed, z.speed_rate = z.n_dem, z.trend_rate
        return
    if z.demand_age >= k.demand_timeout - HALF_TICK:
        z.speed_rate = 0.0
    else:
        model = min(max((z.n_dem - z.speed) / k.engine_lag, -k.engine_deceleration), k.engine_acceleration)
        z.speed_rate = model + z.speed_drift
        z.speed += z.speed_rate * SLOW_TICK
        if z.demand_age < SLOW_TICK - HALF_TICK:
            e = z.n_r_raw - z.speed
            z.speed += k.observer_alpha * e
            e = min(max(e, -k.observer_band), k.observer_band)
            z.speed_drift = min(max(z.speed_drift + k.observer_beta * e / SLOW_TICK, -DRIFT_LIMIT), DRIFT_LIMIT)
            z.speed_noise += NOISE_SHARE * (e * e - z.speed_noise)
    z.speed = min(max(z.speed, z.n_r - k.observer_band), z.n_r + k.observer_band)


@in_place
def angle_at(axis: int, row: int, angles: np.ndarray, v: float) -> float:
    """Look up ``angles``, see `look_up`."""
    return look_up(axis, row, angles, v)


@in_place
def scheduled_angle(table: np.ndarray, angles: np.ndarray, n: float) -> float:
    """Target (rad) of the VIGV at speed ``n`` (%)."""
    return angle_at(ANGLE_STROKE, ANGLE_VIGV, angles, angle_at(ROW_SPEED, ROW_SINGLE, table, n))


@in_place
def follow_play(z: Record, stage: int, drive: float, width: float) -> None:
    """Where in its gap is a stage? One step of the play operator, with the ``drive`` angle and total ``width`` (rad).

    The stage stands at ``farthest - engaged width / 2``: pushed there by the farthest drive on the engaged side, until
    the drive has come back by the whole width and pushes from the other side.
    """
    side = z.engaged[stage]
    if side == 0.0:
        z.engaged[stage] = 1.0 if z.direction > 0.0 else -1.0
        z.farthest[stage] = drive
    elif side * (drive - z.farthest[stage]) > 0.0:
        z.farthest[stage] = drive
    elif side * (z.farthest[stage] - drive) > width:
        z.farthest[stage] = drive
        z.engaged[stage] = -side
        learned = z.learned_down if side > 0.0 else z.learned_up
        learned[stage] = min(learned[stage], SEEN_AGAIN * WELL_KNOWN)


@in_place
def inverse_step(z: Record, k: Record, table: np.ndarray, angles: np.ndarray) -> None:
    """Strategies `INVERSE` and `ADAPTIVE`: the stroke demand that brings the VIGV to its target through the play, one
    10 ms step.

    The stroke pushes on one side of the gap while the target moves on along it; it stands while the target comes back
    by less than a band; beyond, it crosses the gap and pushes from the other side. The vane's present angle comes from
    the play followed along the stroke demand, or the measured stroke where that is clearly elsewhere; the target from
    the observed speed, ahead by the servo's delay.
    """
    observe_speed(z, k)
    stroke = z.x_dem + max(z.x_slow - z.x_dem - OVERSHOT, 0.0) + min(z.x_slow - z.x_dem + OVERSHOT, 0.0)
    for stage in range(int(k.stages)):
        drive = angle_at(ANGLE_STROKE, ANGLE_VIGV + stage, angles, stroke)
        extra = z.width_in_use if stage == 0 else z.width[stage]
        follow_play(z, stage, drive, max(k.play[stage] + extra, 0.0))
    width = max(k.play[0] + z.width_in_use, 0.0)
    vane = z.farthest[0] - 0.5 * z.engaged[0] * width + z.offset_in_use
    n, rate = z.speed, z.speed_rate
    target = scheduled_angle(table, angles, n + rate * k.lead)
    ahead = scheduled_angle(table, angles, n + rate * (k.lead + k.look_ahead))
    slope = abs(scheduled_angle(table, angles, n + 0.5) - scheduled_angle(table, angles, n - 0.5))  # rad/%
    alpha = k.observer_alpha
    band = k.turn_band + k.turn_noise * slope * math.sqrt(max(z.speed_noise, 0.0) * alpha / (2.0 - alpha))
    if z.side == 0.0:
        z.side = z.crossing = 1.0 if z.direction > 0.0 else -1.0
    side = z.side
    if side * (ahead - vane) < -band:
        side = z.side = -side
    # across the gap in blend_time, faster where the target runs, ending softly so that the servo does not overshoot
    left = side - z.crossing
    step = 2.0 * SLOW_TICK / k.blend_time * (1.0 + min(slope * abs(rate) / QUICK, 3.0))
    step = min(step, SOFT_END * abs(left) + 1e-3)
    z.crossing += min(max(left, -step), step)
    aim = target if side * (target - vane) > 0.0 else vane
    stroke = angle_at(ANGLE_VIGV, ANGLE_STROKE, angles, aim - z.offset_in_use + 0.5 * z.crossing * width)
    z.x_target = min(max(stroke, k.stroke_min), k.stroke_max)


@in_place
def filter_pots(z: Record, k: Record, inputs: Record) -> None:
    """Take the potentiometers' readings: one tick of 1 ms. A reading out of range, NaN included, is not used and counts
    against it.
    """
    for stage in range(int(k.stages)):
        y = inputs.pots[stage]
        if k.pot_low <= y <= k.pot_high:
            if z.pot_seen[stage] == 0.0:
                z.pot_seen[stage] = 1.0
                z.pot[stage] = y
            z.pot[stage] += POT_SHARE * (y - z.pot[stage])
        else:
            z.suspect[stage] += SUSPICION * TICK / SLOW_TICK


@in_place
def _judge_pot(z: Record, k: Record, stage: int, expected: float, plausible: bool) -> None:
    """Is a potentiometer trusted? One 10 ms step.

    It is once its readings have followed the linkage over ``pot_trust`` without a doubt: one that is stuck may be right
    by chance where it stands, not over a motion. What was learned until then is proved, and kept. With the doubts of
    some readings in a row the trust is lost, and what was learned since the last proof goes back.
    """
    if plausible:
        z.suspect[stage] = max(z.suspect[stage] - FORGIVEN, 0.0)
        z.lowest[stage] = min(z.lowest[stage], expected)
        z.highest[stage] = max(z.highest[stage], expected)
        if z.highest[stage] - z.lowest[stage] >= k.pot_trust and z.suspect[stage] == 0.0:
            z.trusted[stage] = 1.0
            z.proved_offset[stage], z.proved_width[stage] = z.offset[stage], z.width[stage]
            z.lowest[stage] = z.highest[stage] = expected
    else:
        z.suspect[stage] += SUSPICION
        z.lowest[stage] = z.highest[stage] = expected
    if z.suspect[stage] >= 1.0:
        if z.trusted[stage] == 1.0:
            z.offset[stage], z.width[stage] = z.proved_offset[stage], z.proved_width[stage]
        z.trusted[stage] = z.pot_seen[stage] = 0.0
        z.suspect[stage] = 1.0
        z.lowest[stage] = z.highest[stage] = expected


@in_place
def learn(z: Record, k: Record) -> None:
    """Learn offset and play of each stage from its potentiometer: one 10 ms step.

    With the stroke at rest, the reading less the angle expected, r, is put into the side on which the stage is
    engaged::

        expected = farthest + offset - engaged (play + width) / 2
        offset = offset + share g r,   width = width - 2 engaged (1 - share) g r

    share is 1/2 as long as one side is little known (each side is then learned on its own) and rises to 0.9: what moves
    later is growth rather than wear. g r is limited to ``learn_rate``, up to twelve times that on a side that is new or
    seen again. A reading farther than ``pot_gate`` from its expected value (while a side is new: than the limits allow)
    is implausible. Once both sides are known, offset and width stay within ``learn_budget`` of what was proved last
    (`_judge_pot`). Without trust nothing is learned: the values stand.
    """
    quiet = z.mode == RUN and abs(z.x_dem - z.x_from) < QUIET_MOTION and abs(z.x_dem - z.x_meas) < QUIET_ERROR
    z.quiet = min(z.quiet + SLOW_TICK, 1.0) if quiet else 0.0
    for stage in range(int(k.stages)):
        side = z.engaged[stage]
        play = k.play[stage]
        expected = z.farthest[stage] + z.offset[stage] - 0.5 * side * max(play + z.width[stage], 0.0)
        r = z.pot[stage] - expected
        known = min(z.learned_up[stage], z.learned_down[stage])
        gate = k.pot_gate if known >= KNOWN else k.pot_gate + k.offset_limit + 0.5 * k.width_limit
        if z.quiet < SETTLED:
            gate += UNSETTLED + MOVING * abs(z.x_dem - z.x_from)
        plausible = z.pot_seen[stage] == 1.0 and side != 0.0 and abs(r) <= gate
        _judge_pot(z, k, stage, expected, plausible)
        if not plausible or z.trusted[stage] == 0.0 or z.quiet < SETTLED:
            continue
        learned = z.learned_up if side > 0.0 else z.learned_down
        new = 1.0 - learned[stage] / WELL_KNOWN
        rate = k.learn_rate * (1.0 + 11.0 * new)
        step = min(max(r / (k.learn_time * (1.0 - 0.75 * new)), -rate), rate) * SLOW_TICK
        share = 0.5 + 0.4 * min(known / WELL_KNOWN, 1.0)
        offset = z.offset[stage] + share * step
        width = z.width[stage] - 2.0 * side * (1.0 - share) * step
        if known >= KNOWN:
            budget, proved = k.learn_budget, z.proved_offset[stage]
            offset = min(max(offset, proved - budget), proved + budget)
            proved = z.proved_width[stage]
            width = min(max(width, proved - budget), proved + budget)
        z.offset[stage] = min(max(offset, -k.offset_limit), k.offset_limit)
        z.width[stage] = min(max(width, -min(k.width_limit, play)), k.width_limit)
        learned[stage] = min(learned[stage] + SLOW_TICK, WELL_KNOWN)
        if known < KNOWN:
            z.proved_offset[stage], z.proved_width[stage] = z.offset[stage], z.width[stage]
    step = k.apply_rate * SLOW_TICK
    z.offset_in_use += min(max(z.offset[0] - z.offset_in_use, -step), step)
    z.width_in_use += min(max(z.width[0] - z.width_in_use, -step), step)
