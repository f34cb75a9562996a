"""The controller's firmware: rotor-speed demand in, servo-valve current out, 1,000 times a second.

Signal flow of one tick (Kim & Ki 2020, figure 7)::

    n_dem --> trend (10 ms) --> which curve ---+
    n_r ----> filter (10 ms) ------------------+--> stroke tables --> x_dem --> PI (1 ms) --> i_cmd
    x_lvdt -> range, rate, stuck (1 ms) ---------------------------------------^

`tick` has no clock, no file and no bus: the same inputs and state give the same state, bit for bit. It writes into
``state`` in place and allocates nothing. Every threshold is calibration (`controller.calibration`).

Units: SI, speeds in % of design speed. Positive current extends.

This file holds all compiled code of the controller on purpose: numba's cache looks at one file's date only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from controller.calibration import Calibration

import math

import numpy as np

from vaneloop.base.compiled import in_place, inlined

# ---- inputs ----------------------------------------------------------------------------------------------------------
INPUTS = ("n_dem", "n_r", "demand_fresh", "demand_rejected", "mode_request", "x_lvdt", "vigv", "vgv1", "vgv2", "pause")
N_INPUTS = len(INPUTS)
(
    IN_N_DEM,  # %, demand of the last good ECU frame
    IN_N_R,  # %, measured speed of the last good ECU frame
    IN_FRESH,  # 1 if a good ECU frame came since the last tick
    IN_REJECTED,  # ECU frames refused since the last tick (CRC, counter, length)
    IN_MODE_REQUEST,  # 0 standby, 1 run
    IN_X_LVDT,  # m, stroke as the LVDT gives it
    IN_VIGV,  # rad, vane angles as the stem potentiometers give them; NaN = not fitted
    IN_VGV1,
    IN_VGV2,
    IN_PAUSE,  # s for which the controller stood still before this tick, as its supervisor says; 0 = it ran on time
) = range(N_INPUTS)

# ---- strategies: how the stroke demand follows from the speed, docs/strategies.md ------------------------------------
STRATEGIES = ("single", "dual", "inverse", "adaptive")
SINGLE, DUAL, INVERSE, ADAPTIVE = range(4)

# ---- modes -----------------------------------------------------------------------------------------------------------
INIT, STANDBY, RUN, DEGRADED, FAIL_SAFE = range(5)
MODES = ("INIT", "STANDBY", "RUN", "DEGRADED", "FAIL_SAFE")

# ---- fault codes: bit numbers in the state's `faults` and in the frame VGV_SERVO -------------------------------------
FAULTS = (
    "demand_stale",
    "demand_rejected",
    "lvdt_range",
    "lvdt_rate",
    "lvdt_stuck",
    "tracking",
    "current_saturated",
    "demand_range",
    "paused",
)
N_FAULTS = len(FAULTS)
(F_STALE, F_REJECTED, F_LVDT_RANGE, F_LVDT_RATE, F_LVDT_STUCK, F_TRACKING, F_SATURATED, F_DEMAND_RANGE, F_PAUSED) = (
    range(N_FAULTS)
)

# ---- calibration scalars ---------------------------------------------------------------------------------------------
SCALARS = (
    "strategy",  # of `STRATEGIES`
    "table_input",  # 0 table entered with filtered n_r, 1 with n_dem
    "trend_alpha",  # - fixed gains of the trend's Kalman filter, per 10 ms
    "trend_beta",
    "trend_rate_on",  # %/s: rate of demand against the direction that counts as moving
    "trend_change",  # %: way back from the farthest demand that turns the direction; half of it while moving
    "trend_hold",  # s: for how long both must stand
    "speed_filter",  # s: lag of the n_r filter
    "blend_time",  # s: full change from one curve to the other
    "stroke_rate",  # m/s: fastest stroke demand
    "stroke_min",  # m
    "stroke_max",  # m
    "kp",  # A/m
    "ki",  # A/(m s)
    "kff",  # A/(m/s)
    "current_limit",  # A
    "init_time",  # s
    "fail_safe_stroke",  # m
    "fail_safe_current",  # A, when the LVDT cannot be used
    "fail_safe_rate",  # m/s, on the way to the fail-safe stroke
    "degraded_hold",  # s: longest presence of a fault's cause in DEGRADED before FAIL_SAFE
    "recover_time",  # s: all clear for this long before RUN returns
    "demand_timeout",  # s without a good frame: stale
    "demand_reject_limit",  # refused frames in the bucket: rejected
    "demand_reject_leak",  # refused frames forgiven per second
    "demand_low",  # %
    "demand_high",  # %
    "lvdt_low",  # m
    "lvdt_high",  # m
    "lvdt_rate",  # m/s
    "lvdt_debounce",  # s of bad samples: fault
    "lvdt_heal",  # s of good samples: healed
    "stuck_current",  # A: a current above this must move the piston
    "stuck_motion",  # m: less motion than this is none
    "stuck_time",  # s
    "stuck_margin",  # m from the end stops within which no motion is expected
    "tracking_limit",  # m
    "tracking_time",  # s
    "saturated_time",  # s
    "engine_lag",  # s: the engine as the speed observer knows it
    "engine_acceleration",  # %/s
    "engine_deceleration",  # %/s
    "observer_alpha",  # - fixed gains of the speed observer, per 10 ms
    "observer_beta",
    "observer_band",  # %: farthest from the filtered speed that the observer may be
    "play_vigv",  # rad: total play at the vane, as built
    "play_vgv1",
    "play_vgv2",
    "lead",  # s: delay from the stroke demand to the vane, made up for
    "look_ahead",  # s: how early the gap is crossed before the vanes must turn round
    "turn_band",  # rad: the vanes' error that is not worth a reversal
    "turn_noise",  # - the same in multiples of the observed speed's noise
    "pot_low",  # rad
    "pot_high",  # rad
    "pot_gate",  # rad: farthest from its expected value that a reading is believed
    "pot_trust",  # rad over which a reading must have followed the linkage before it is learned from
    "learn_time",  # s: time constant of learning
    "learn_rate",  # rad/s: fastest change of what is known already
    "learn_budget",  # rad by which what is known may change before the readings must have followed the linkage again
    "apply_rate",  # rad/s: fastest change of the compensation in use
    "offset_limit",  # rad
    "width_limit",  # rad from the play as built
)
N_SCALARS = len(SCALARS)
(
    STRATEGY,
    TABLE_INPUT,
    TREND_ALPHA,
    TREND_BETA,
    TREND_RATE_ON,
    TREND_CHANGE,
    TREND_HOLD,
    SPEED_FILTER,
    BLEND_TIME,
    STROKE_RATE,
    STROKE_MIN,
    STROKE_MAX,
    KP,
    KI,
    KFF,
    CURRENT_LIMIT,
    INIT_TIME,
    FAIL_SAFE_STROKE,
    FAIL_SAFE_CURRENT,
    FAIL_SAFE_RATE,
    DEGRADED_HOLD,
    RECOVER_TIME,
    DEMAND_TIMEOUT,
    DEMAND_REJECT_LIMIT,
    DEMAND_REJECT_LEAK,
    DEMAND_LOW,
    DEMAND_HIGH,
    LVDT_LOW,
    LVDT_HIGH,
    LVDT_RATE,
    LVDT_DEBOUNCE,
    LVDT_HEAL,
    STUCK_CURRENT,
    STUCK_MOTION,
    STUCK_TIME,
    STUCK_MARGIN,
    TRACKING_LIMIT,
    TRACKING_TIME,
    SATURATED_TIME,
    ENGINE_LAG,
    ENGINE_ACCELERATION,
    ENGINE_DECELERATION,
    OBSERVER_ALPHA,
    OBSERVER_BETA,
    OBSERVER_BAND,
    PLAY_VIGV,
    PLAY_VGV1,
    PLAY_VGV2,
    LEAD,
    LOOK_AHEAD,
    TURN_BAND,
    TURN_NOISE,
    POT_LOW,
    POT_HIGH,
    POT_GATE,
    POT_TRUST,
    LEARN_TIME,
    LEARN_RATE,
    LEARN_BUDGET,
    APPLY_RATE,
    OFFSET_LIMIT,
    WIDTH_LIMIT,
) = range(N_SCALARS)

# ---- state -----------------------------------------------------------------------------------------------------------
STATE = (
    "mode",
    "ticks",
    "n_dem",  # %, demand in use
    "n_r_raw",  # %, measured speed of the last good frame
    "n_r",  # %, filtered measured speed
    "demand_age",  # s since the last good frame
    "reject_bucket",
    "demand_seen",
    "trend_n",  # %, filtered demand
    "trend_rate",  # %/s
    "trend_turn",  # %, farthest demand along the present direction, of two steps in a row
    "trend_timer",  # s for which a turn has been due
    "direction",  # +1 demand rises (extension curve), -1 falls (retraction curve)
    "blend",  # 0 retraction curve .. 1 extension curve
    "x_target",  # m, stroke from the tables
    "x_dem",  # m, stroke demand, rate-limited (the end of the present 10 ms)
    "x_from",  # m, stroke demand 10 ms before
    "x_meas",  # m, last plausible stroke
    "x_reach",  # m, how far from x_meas the stroke can have come since that sample
    "lvdt_good",  # 1 if the last sample was plausible
    "stuck_x",  # m, where the stuck timer started
    "stuck_timer",
    "integral",  # A
    "i_cmd",  # A
    "saturated",
    "recover_timer",
    "degraded_timer",
    "faults",  # bit mask
    "t_stale",
    "t_rejected",
    "t_lvdt_range",
    "t_lvdt_rate",
    "t_lvdt_stuck",
    "t_tracking",
    "t_saturated",
    "t_demand_range",
    "t_paused",
    "x_servo",  # m, reference of the servo at this tick
    "run_request",  # 1 if the last good frame asked for RUN
    "trend_last",  # %, demand of the 10 ms step before
    # inverse and adaptive only
    "speed",  # %, observed speed
    "speed_rate",  # %/s, as observed
    "speed_drift",  # %/s by which the engine runs away from its model
    "speed_noise",  # %^2, mean square of what each new speed brings
    "side",  # +1, -1: the pushing side of the VIGV's gap that the stroke is to be on; 0 not yet known
    "crossing",  # -1 .. 1: where in the gap the stroke demand is
    "x_slow",  # m, stroke as measured, without its noise
    "quiet",  # s for which the stroke demand has stood
    "offset_in_use",  # rad, VIGV
    "width_in_use",  # rad beyond the play as built, VIGV
    *(f"{name}_{stage}" for name in (
        "farthest",  # rad, farthest drive of the stage along its engaged side
        "engaged",  # +1, -1: the side of the gap on which the stage was last pushed; 0 not yet known
        "pot",  # rad, potentiometer, filtered
        "pot_seen",  # 1 once a reading came
        "suspect",  # 0 .. 1: doubts about the readings; with 1 the trust is lost
        "trusted",  # 1: the readings are learned from
        "lowest",  # rad, least and greatest angle expected since the last doubt or proof
        "highest",
        "offset",  # rad, learned
        "width",  # rad beyond the play as built, learned
        "proved_offset",  # rad, when the readings last followed the linkage over a motion
        "proved_width",
        "learned_up",  # s learned on side +1
        "learned_down",  # s learned on side -1
    ) for stage in ("vigv", "vgv1", "vgv2")),
)  # fmt: skip
N_STATE = len(STATE)
(
    MODE,
    TICKS,
    N_DEM,
    N_R_RAW,
    N_R,
    DEMAND_AGE,
    REJECT_BUCKET,
    DEMAND_SEEN,
    TREND_N,
    TREND_RATE,
    TREND_TURN,
    TREND_TIMER,
    DIRECTION,
    BLEND,
    X_TARGET,
    X_DEM,
    X_FROM,
    X_MEAS,
    X_REACH,
    LVDT_GOOD,
    STUCK_X,
    STUCK_TIMER,
    INTEGRAL,
    I_CMD,
    SATURATED,
    RECOVER_TIMER,
    DEGRADED_TIMER,
    FAULT_BITS,
    T_STALE,
    T_REJECTED,
    T_LVDT_RANGE,
    T_LVDT_RATE,
    T_LVDT_STUCK,
    T_TRACKING,
    T_SATURATED,
    T_DEMAND_RANGE,
    T_PAUSED,
    X_SERVO,
    RUN_REQUEST,
    TREND_LAST,
    SPEED,
    SPEED_RATE,
    SPEED_DRIFT,
    SPEED_NOISE,
    SIDE,
    CROSSING,
    X_SLOW,
    QUIET,
    OFFSET_IN_USE,
    WIDTH_IN_USE,
    FARTHEST,  # here and below: three rows, one a stage
    _,
    _,
    ENGAGED,
    _,
    _,
    POT,
    _,
    _,
    POT_SEEN,
    _,
    _,
    SUSPECT,
    _,
    _,
    TRUSTED,
    _,
    _,
    LOWEST,
    _,
    _,
    HIGHEST,
    _,
    _,
    OFFSET,
    _,
    _,
    WIDTH,
    _,
    _,
    PROVED_OFFSET,
    _,
    _,
    PROVED_WIDTH,
    _,
    _,
    LEARNED_UP,
    _,
    _,
    LEARNED_DOWN,
    _,
    _,
) = range(N_STATE)

TICK = 1e-3  # s, servo rate 1 kHz
SLOW = 10  # ticks: demand, trend and schedule run every 10 ms
SLOW_TICK = 1e-2  # s
HALF_TICK = 0.5 * TICK  # s: timers are sums of ticks; half a tick keeps their rounding from costing a whole one

# ---- rows of the stroke table ----------------------------------------------------------------------------------------
ROW_SPEED, ROW_EXTENSION, ROW_RETRACTION, ROW_SINGLE = range(4)

ANGLE_STROKE, ANGLE_VIGV = 0, 1  # rows of the angle table; VGV1 and VGV2 follow

FAR = 1.0  # m, beyond any stroke


# ---- of the strategies inverse and adaptive
DRIFT_LIMIT = 3.0  # %/s
NOISE_SHARE = 2e-3  # of 10 ms: the noise is known after 5 s
QUICK = 0.02  # rad/s: targets that run faster are worth a faster crossing
SOFT_END = 0.25  # of what is left of the gap in 10 ms
POT_SHARE = 0.1  # of 1 ms: a lag of 10 ms
STROKE_SHARE = 0.1
OVERSHOT = 3e-5  # m: six times the LVDT's noise
SUSPICION, FORGIVEN = (
    0.2,
    0.02,
)  # of 10 ms: five implausible readings cost the trust, one plausible takes back a tenth of one
QUIET_MOTION, QUIET_ERROR = 2e-5, 1e-4  # m in 10 ms, m: the stroke is at rest
SETTLED = 0.1  # s at rest
UNSETTLED, MOVING = 0.004, 60.0  # rad, rad/m: what lags may add while the stroke moves: three steps at 20 rad/m
KNOWN, WELL_KNOWN = 15.0, 30.0  # s of learning on a side
SEEN_AGAIN = 0.6  # of well known: a side to which the stage comes back may have moved since


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
def trend_step(z: np.ndarray, k: np.ndarray, n_dem: float) -> None:
    """Is the demand rising or falling? One 10 ms step.

    The rate comes from a constant-rate Kalman filter in its steady-state form (alpha-beta)::

        n- = n + rate T,   r = n_dem - n-,   n = n- + alpha r,   rate = rate + beta r / T

    ``back`` is how far the demand has come back from its farthest point along the present direction. The direction
    turns once the demand has been moving against it (rate beyond ``trend_rate_on``) and is back by half of
    ``trend_change``, or has crept back by the whole of it, and this has stood without a gap for ``trend_hold``. The
    turning point is taken from the demand itself: the filter overshoots after a slam and would turn falsely at its end.
    It takes two steps in a row to move it, so that one wrong demand moves nothing.
    """
    predicted = z[TREND_N] + z[TREND_RATE] * SLOW_TICK
    r = n_dem - predicted
    z[TREND_N] = predicted + k[TREND_ALPHA] * r
    z[TREND_RATE] = z[TREND_RATE] + k[TREND_BETA] * r / SLOW_TICK
    d = z[DIRECTION]
    last = z[TREND_LAST]
    ahead = d * (n_dem - last) > 0.0
    reached = last if ahead else n_dem
    if d * (reached - z[TREND_TURN]) > 0.0:
        z[TREND_TURN] = reached
    z[TREND_LAST] = n_dem
    back = d * (z[TREND_TURN] - n_dem)
    moving = -d * z[TREND_RATE] > k[TREND_RATE_ON] and back > 0.5 * k[TREND_CHANGE]
    if moving or back > k[TREND_CHANGE]:
        z[TREND_TIMER] += SLOW_TICK
        if z[TREND_TIMER] >= k[TREND_HOLD] - HALF_TICK:
            z[DIRECTION] = -d
            z[TREND_TURN] = n_dem if ahead else last
            z[TREND_TIMER] = 0.0
    else:
        z[TREND_TIMER] = 0.0


@inlined
def schedule_step(z: np.ndarray, k: np.ndarray, table: np.ndarray) -> None:
    """Strategies `SINGLE` and `DUAL`: stroke demand from the speed by curves, one 10 ms step.

    The extension curve serves a rising demand, the retraction curve a falling one. Between them ``blend`` moves at a
    limited rate, so the change of table is bumpless; the demand itself is limited to ``stroke_rate``.
    """
    n = z[N_DEM] if k[TABLE_INPUT] == 1.0 else z[N_R]
    if k[STRATEGY] == 0.0:
        target = look_up(ROW_SPEED, ROW_SINGLE, table, n)
    else:
        goal = 1.0 if z[DIRECTION] > 0.0 else 0.0
        step = SLOW_TICK / k[BLEND_TIME]
        z[BLEND] += min(max(goal - z[BLEND], -step), step)
        retraction = look_up(ROW_SPEED, ROW_RETRACTION, table, n)
        extension = look_up(ROW_SPEED, ROW_EXTENSION, table, n)
        target = retraction + z[BLEND] * (extension - retraction)
    z[X_TARGET] = min(max(target, k[STROKE_MIN]), k[STROKE_MAX])


@in_place
def observe_speed(z: np.ndarray, k: np.ndarray) -> None:
    """Rotor speed and its rate without the noise and the lag of a filter: one 10 ms step.

    ::

        rate = clip((n_dem - n) / engine_lag, -engine_deceleration, engine_acceleration) + drift
        n- = n + rate T,   e = n_r - n-,   n = n- + observer_alpha e,   drift = drift + observer_beta e / T

    The engine's model is driven by the demand, so the rate is there before the speed has moved. ``drift`` takes up what
    the model does not know. Whatever the model says, n stays within ``observer_band`` of the filtered measurement.
    Without a new frame the model goes on alone; without one for ``demand_timeout`` the speed stands.
    """
    if k[TABLE_INPUT] == 1.0:
        z[SPEED], z[SPEED_RATE] = z[N_DEM], z[TREND_RATE]
        return
    if z[DEMAND_AGE] >= k[DEMAND_TIMEOUT] - HALF_TICK:
        z[SPEED_RATE] = 0.0
    else:
        model = min(max((z[N_DEM] - z[SPEED]) / k[ENGINE_LAG], -k[ENGINE_DECELERATION]), k[ENGINE_ACCELERATION])
        z[SPEED_RATE] = model + z[SPEED_DRIFT]
        z[SPEED] += z[SPEED_RATE] * SLOW_TICK
        if z[DEMAND_AGE] < SLOW_TICK - HALF_TICK:
            e = z[N_R_RAW] - z[SPEED]
            z[SPEED] += k[OBSERVER_ALPHA] * e
            e = min(max(e, -k[OBSERVER_BAND]), k[OBSERVER_BAND])
            z[SPEED_DRIFT] = min(max(z[SPEED_DRIFT] + k[OBSERVER_BETA] * e / SLOW_TICK, -DRIFT_LIMIT), DRIFT_LIMIT)
            z[SPEED_NOISE] += NOISE_SHARE * (e * e - z[SPEED_NOISE])
    z[SPEED] = min(max(z[SPEED], z[N_R] - k[OBSERVER_BAND]), z[N_R] + k[OBSERVER_BAND])


@in_place
def angle_at(axis: int, row: int, angles: np.ndarray, v: float) -> float:
    """Look up ``angles``, see `look_up`."""
    return look_up(axis, row, angles, v)


@in_place
def scheduled_angle(table: np.ndarray, angles: np.ndarray, n: float) -> float:
    """Target (rad) of the VIGV at speed ``n`` (%)."""
    return angle_at(ANGLE_STROKE, ANGLE_VIGV, angles, angle_at(ROW_SPEED, ROW_SINGLE, table, n))


@in_place
def follow_play(z: np.ndarray, stage: int, drive: float, width: float) -> None:
    """Where in its gap is a stage? One step of the play operator, with the ``drive`` angle and total ``width`` (rad).

    The stage stands at ``farthest - engaged width / 2``: pushed there by the farthest drive on the engaged side, until
    the drive has come back by the whole width and pushes from the other side.
    """
    side = z[ENGAGED + stage]
    if side == 0.0:
        z[ENGAGED + stage] = 1.0 if z[DIRECTION] > 0.0 else -1.0
        z[FARTHEST + stage] = drive
    elif side * (drive - z[FARTHEST + stage]) > 0.0:
        z[FARTHEST + stage] = drive
    elif side * (z[FARTHEST + stage] - drive) > width:
        z[FARTHEST + stage] = drive
        z[ENGAGED + stage] = -side
        learned = LEARNED_DOWN if side > 0.0 else LEARNED_UP
        z[learned + stage] = min(z[learned + stage], SEEN_AGAIN * WELL_KNOWN)


@in_place
def inverse_step(z: np.ndarray, k: np.ndarray, table: np.ndarray, angles: np.ndarray) -> None:
    """Strategies `INVERSE` and `ADAPTIVE`: the stroke demand that brings the VIGV to its target through the play, one
    10 ms step.

    The stroke pushes on one side of the gap while the target moves on along it; it stands while the target comes back
    by less than a band; beyond, it crosses the gap and pushes from the other side. The vane's present angle comes from
    the play followed along the stroke demand, or the measured stroke where that is clearly elsewhere; the target from
    the observed speed, ahead by the servo's delay.
    """
    observe_speed(z, k)
    stroke = z[X_DEM] + max(z[X_SLOW] - z[X_DEM] - OVERSHOT, 0.0) + min(z[X_SLOW] - z[X_DEM] + OVERSHOT, 0.0)
    for stage in range(3):
        drive = angle_at(ANGLE_STROKE, ANGLE_VIGV + stage, angles, stroke)
        extra = z[WIDTH_IN_USE] if stage == 0 else z[WIDTH + stage]
        follow_play(z, stage, drive, max(k[PLAY_VIGV + stage] + extra, 0.0))
    width = max(k[PLAY_VIGV] + z[WIDTH_IN_USE], 0.0)
    vane = z[FARTHEST] - 0.5 * z[ENGAGED] * width + z[OFFSET_IN_USE]
    n, rate = z[SPEED], z[SPEED_RATE]
    target = scheduled_angle(table, angles, n + rate * k[LEAD])
    ahead = scheduled_angle(table, angles, n + rate * (k[LEAD] + k[LOOK_AHEAD]))
    slope = abs(scheduled_angle(table, angles, n + 0.5) - scheduled_angle(table, angles, n - 0.5))  # rad/%
    alpha = k[OBSERVER_ALPHA]
    band = k[TURN_BAND] + k[TURN_NOISE] * slope * math.sqrt(max(z[SPEED_NOISE], 0.0) * alpha / (2.0 - alpha))
    if z[SIDE] == 0.0:
        z[SIDE] = z[CROSSING] = 1.0 if z[DIRECTION] > 0.0 else -1.0
    side = z[SIDE]
    if side * (ahead - vane) < -band:
        side = z[SIDE] = -side
    # across the gap in blend_time, faster where the target runs, ending softly so that the servo does not overshoot
    left = side - z[CROSSING]
    step = 2.0 * SLOW_TICK / k[BLEND_TIME] * (1.0 + min(slope * abs(rate) / QUICK, 3.0))
    step = min(step, SOFT_END * abs(left) + 1e-3)
    z[CROSSING] += min(max(left, -step), step)
    aim = target if side * (target - vane) > 0.0 else vane
    stroke = angle_at(ANGLE_VIGV, ANGLE_STROKE, angles, aim - z[OFFSET_IN_USE] + 0.5 * z[CROSSING] * width)
    z[X_TARGET] = min(max(stroke, k[STROKE_MIN]), k[STROKE_MAX])


@in_place
def filter_pots(z: np.ndarray, k: np.ndarray, inputs: np.ndarray) -> None:
    """Take the potentiometers' readings: one tick of 1 ms. A reading out of range, NaN included, is not used and counts
    against it.
    """
    for stage in range(3):
        y = inputs[IN_VIGV + stage]
        if k[POT_LOW] <= y <= k[POT_HIGH]:
            if z[POT_SEEN + stage] == 0.0:
                z[POT_SEEN + stage] = 1.0
                z[POT + stage] = y
            z[POT + stage] += POT_SHARE * (y - z[POT + stage])
        else:
            z[SUSPECT + stage] += SUSPICION * TICK / SLOW_TICK


@in_place
def _judge_pot(z: np.ndarray, k: np.ndarray, stage: int, expected: float, plausible: bool) -> None:
    """Is a potentiometer trusted? One 10 ms step.

    It is once its readings have followed the linkage over ``pot_trust`` without a doubt: one that is stuck may be right
    by chance where it stands, not over a motion. What was learned until then is proved, and kept. With the doubts of
    some readings in a row the trust is lost, and what was learned since the last proof goes back.
    """
    if plausible:
        z[SUSPECT + stage] = max(z[SUSPECT + stage] - FORGIVEN, 0.0)
        z[LOWEST + stage] = min(z[LOWEST + stage], expected)
        z[HIGHEST + stage] = max(z[HIGHEST + stage], expected)
        if z[HIGHEST + stage] - z[LOWEST + stage] >= k[POT_TRUST] and z[SUSPECT + stage] == 0.0:
            z[TRUSTED + stage] = 1.0
            z[PROVED_OFFSET + stage], z[PROVED_WIDTH + stage] = z[OFFSET + stage], z[WIDTH + stage]
            z[LOWEST + stage] = z[HIGHEST + stage] = expected
    else:
        z[SUSPECT + stage] += SUSPICION
        z[LOWEST + stage] = z[HIGHEST + stage] = expected
    if z[SUSPECT + stage] >= 1.0:
        if z[TRUSTED + stage] == 1.0:
            z[OFFSET + stage], z[WIDTH + stage] = z[PROVED_OFFSET + stage], z[PROVED_WIDTH + stage]
        z[TRUSTED + stage] = z[POT_SEEN + stage] = 0.0
        z[SUSPECT + stage] = 1.0
        z[LOWEST + stage] = z[HIGHEST + stage] = expected


@in_place
def learn(z: np.ndarray, k: np.ndarray) -> None:
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
    quiet = z[MODE] == RUN and abs(z[X_DEM] - z[X_FROM]) < QUIET_MOTION and abs(z[X_DEM] - z[X_MEAS]) < QUIET_ERROR
    z[QUIET] = min(z[QUIET] + SLOW_TICK, 1.0) if quiet else 0.0
    for stage in range(3):
        side = z[ENGAGED + stage]
        play = k[PLAY_VIGV + stage]
        expected = z[FARTHEST + stage] + z[OFFSET + stage] - 0.5 * side * max(play + z[WIDTH + stage], 0.0)
        r = z[POT + stage] - expected
        known = min(z[LEARNED_UP + stage], z[LEARNED_DOWN + stage])
        gate = k[POT_GATE] if known >= KNOWN else k[POT_GATE] + k[OFFSET_LIMIT] + 0.5 * k[WIDTH_LIMIT]
        if z[QUIET] < SETTLED:
            gate += UNSETTLED + MOVING * abs(z[X_DEM] - z[X_FROM])
        plausible = z[POT_SEEN + stage] == 1.0 and side != 0.0 and abs(r) <= gate
        _judge_pot(z, k, stage, expected, plausible)
        if not plausible or z[TRUSTED + stage] == 0.0 or z[QUIET] < SETTLED:
            continue
        learned = LEARNED_UP if side > 0.0 else LEARNED_DOWN
        new = 1.0 - z[learned + stage] / WELL_KNOWN
        rate = k[LEARN_RATE] * (1.0 + 11.0 * new)
        step = min(max(r / (k[LEARN_TIME] * (1.0 - 0.75 * new)), -rate), rate) * SLOW_TICK
        share = 0.5 + 0.4 * min(known / WELL_KNOWN, 1.0)
        offset = z[OFFSET + stage] + share * step
        width = z[WIDTH + stage] - 2.0 * side * (1.0 - share) * step
        if known >= KNOWN:
            budget, proved = k[LEARN_BUDGET], z[PROVED_OFFSET + stage]
            offset = min(max(offset, proved - budget), proved + budget)
            proved = z[PROVED_WIDTH + stage]
            width = min(max(width, proved - budget), proved + budget)
        z[OFFSET + stage] = min(max(offset, -k[OFFSET_LIMIT]), k[OFFSET_LIMIT])
        z[WIDTH + stage] = min(max(width, -min(k[WIDTH_LIMIT], play)), k[WIDTH_LIMIT])
        z[learned + stage] = min(z[learned + stage] + SLOW_TICK, WELL_KNOWN)
        if known < KNOWN:
            z[PROVED_OFFSET + stage], z[PROVED_WIDTH + stage] = z[OFFSET + stage], z[WIDTH + stage]
    step = k[APPLY_RATE] * SLOW_TICK
    z[OFFSET_IN_USE] += min(max(z[OFFSET] - z[OFFSET_IN_USE], -step), step)
    z[WIDTH_IN_USE] += min(max(z[WIDTH] - z[WIDTH_IN_USE], -step), step)


@inlined
def move_demand(z: np.ndarray, k: np.ndarray, target: float, rate: float) -> None:
    """Let the stroke demand follow ``target`` (m) no faster than ``rate`` (m/s): one 10 ms step."""
    step = rate * SLOW_TICK
    z[X_FROM] = z[X_DEM]
    z[X_DEM] += min(max(target - z[X_DEM], -step), step)
    z[X_DEM] = min(max(z[X_DEM], k[STROKE_MIN]), k[STROKE_MAX])


@inlined
def servo_step(z: np.ndarray, k: np.ndarray, x_ref: float, dx_ref: float) -> None:
    """Servo-valve current: PI on the stroke error with feed-forward of the demanded speed, one tick of 1 ms.

    ::

        e = x_ref - x_meas,   i = kp e + integral + kff dx_ref,   d(integral)/dt = ki e

    The current is limited to +-``current_limit``; while it is, the integral does not grow further into the limit
    (anti-windup).
    """
    e = x_ref - z[X_MEAS]
    limit = k[CURRENT_LIMIT]
    integral = z[INTEGRAL] + k[KI] * e * TICK
    i = k[KP] * e + integral + k[KFF] * dx_ref
    if i > limit:
        i = limit
        z[SATURATED] = 1.0
        if e < 0.0:
            z[INTEGRAL] = integral
    elif i < -limit:
        i = -limit
        z[SATURATED] = 1.0
        if e > 0.0:
            z[INTEGRAL] = integral
    else:
        z[SATURATED] = 0.0
        z[INTEGRAL] = integral
    z[INTEGRAL] = min(max(z[INTEGRAL], -limit), limit)
    z[I_CMD] = i


@inlined
def _debounce(z: np.ndarray, timer: int, bad: bool, bit: int, rise: float, heal: float) -> None:
    """Set fault ``bit`` after ``rise`` seconds of bad ticks, clear it after ``heal`` seconds of good ones.

    The timer counts up to ``rise`` while bad; once the fault stands it counts down from 0 to -``heal`` while good.
    """
    mask = int(z[FAULT_BITS])
    if mask & (1 << bit):
        z[timer] = 0.0 if bad else z[timer] - TICK
        if z[timer] <= HALF_TICK - heal:
            z[FAULT_BITS] = float(mask & ~(1 << bit))
            z[timer] = 0.0
    else:
        z[timer] = z[timer] + TICK if bad else 0.0
        if bad and z[timer] >= rise - HALF_TICK:
            z[FAULT_BITS] = float(mask | (1 << bit))
            z[timer] = 0.0


@inlined
def _condition_lvdt(z: np.ndarray, k: np.ndarray, x: float, pause: float) -> None:
    """Take a stroke sample if it is plausible (range, rate, not stuck); otherwise keep the last plausible one.

    A sample is plausible if the piston can have come there from the last plausible one at ``lvdt_rate``, however long
    ago that was: a spike costs one sample, a gap none after it, and a lasting step is refused until it is a fault.
    ``pause`` (s): time before this tick in which no sample was taken.
    """
    in_range = k[LVDT_LOW] <= x <= k[LVDT_HIGH]  # False for NaN
    z[X_REACH] = min(z[X_REACH] + k[LVDT_RATE] * (TICK + pause), FAR)
    jump = in_range and abs(x - z[X_MEAS]) > z[X_REACH]
    if in_range and not jump:
        z[LVDT_GOOD] = 1.0
        z[X_MEAS] = x
        z[X_REACH] = 0.0
    else:
        z[LVDT_GOOD] = 0.0
    _debounce_leaky(z, T_LVDT_RANGE, not in_range, F_LVDT_RANGE, k[LVDT_DEBOUNCE], k[LVDT_HEAL])
    # each jump counts as five samples of the debounce time: a lasting step of more than 2 mm (the tracking limit) is a
    # fault
    if jump:
        z[T_LVDT_RATE] += 4.0 * TICK
    _debounce_leaky(z, T_LVDT_RATE, jump, F_LVDT_RATE, k[LVDT_DEBOUNCE], k[LVDT_HEAL])

    # stuck: a current that must move the piston, and no motion, away from the end stops; then stuck until there is
    # motion
    inside = k[STROKE_MIN] + k[STUCK_MARGIN] < z[X_MEAS] < k[STROKE_MAX] - k[STUCK_MARGIN]
    stuck = z[STUCK_TIMER] >= k[STUCK_TIME] - HALF_TICK
    asked = abs(z[I_CMD]) > k[STUCK_CURRENT] and inside
    if (asked or stuck) and abs(z[X_MEAS] - z[STUCK_X]) < k[STUCK_MOTION]:
        if not stuck:
            z[STUCK_TIMER] += TICK
    else:
        z[STUCK_X] = z[X_MEAS]
        z[STUCK_TIMER] = 0.0
    _debounce(z, T_LVDT_STUCK, z[STUCK_TIMER] >= k[STUCK_TIME] - HALF_TICK, F_LVDT_STUCK, TICK, k[LVDT_HEAL])


@inlined
def _debounce_leaky(z: np.ndarray, timer: int, bad: bool, bit: int, rise: float, heal: float) -> None:
    """Like `_debounce`, but good ticks only count the timer down: intermittent faults add up."""
    mask = int(z[FAULT_BITS])
    if mask & (1 << bit):
        _debounce(z, timer, bad, bit, rise, heal)
        return
    z[timer] = z[timer] + TICK if bad else max(0.0, z[timer] - 0.1 * TICK)
    if z[timer] >= rise - HALF_TICK:
        z[FAULT_BITS] = float(mask | (1 << bit))
        z[timer] = 0.0


@inlined
def _monitor_demand(inputs: np.ndarray, z: np.ndarray, k: np.ndarray, pause: float) -> None:
    """Age, refusals and range of the ECU's demand; take the values of a good frame, its mode request too. It aged by
    ``pause`` (s), too.
    """
    n_dem, n_r, request = inputs[IN_N_DEM], inputs[IN_N_R], inputs[IN_MODE_REQUEST]
    fresh = inputs[IN_FRESH] > 0.5
    in_range = (
        (k[DEMAND_LOW] <= n_dem <= k[DEMAND_HIGH])
        and (k[DEMAND_LOW] <= n_r <= k[DEMAND_HIGH])
        and 0.0 <= request <= 1.0
    )  # not NaN
    good = fresh and in_range
    rejected = inputs[IN_REJECTED]
    if not (rejected >= 0.0):
        rejected = 0.0
    bucket = max(z[REJECT_BUCKET] - k[DEMAND_REJECT_LEAK] * TICK, 0.0) + rejected
    z[REJECT_BUCKET] = min(bucket, k[DEMAND_REJECT_LIMIT])
    if good:
        z[DEMAND_AGE] = 0.0
        z[N_DEM] = n_dem
        z[N_R_RAW] = n_r
        z[RUN_REQUEST] = 1.0 if request > 0.5 else 0.0
        if z[DEMAND_SEEN] == 0.0:
            z[DEMAND_SEEN] = 1.0
            z[N_R] = n_r
            z[SPEED] = n_r
            z[TREND_N] = n_dem
            z[TREND_TURN] = n_dem
            z[TREND_LAST] = n_dem
    else:
        z[DEMAND_AGE] = min(z[DEMAND_AGE] + (TICK + pause), 1e6)
    _debounce(z, T_STALE, z[DEMAND_AGE] >= k[DEMAND_TIMEOUT] - HALF_TICK, F_STALE, TICK, k[RECOVER_TIME])
    _debounce(z, T_REJECTED, z[REJECT_BUCKET] >= k[DEMAND_REJECT_LIMIT], F_REJECTED, TICK, k[RECOVER_TIME])
    _debounce(z, T_DEMAND_RANGE, fresh and not in_range, F_DEMAND_RANGE, TICK, k[RECOVER_TIME])


LVDT_MASK = (1 << F_LVDT_RANGE) | (1 << F_LVDT_RATE) | (1 << F_LVDT_STUCK)
DEMAND_MASK = (1 << F_STALE) | (1 << F_REJECTED) | (1 << F_DEMAND_RANGE)
SERVO_MASK = (1 << F_TRACKING) | (1 << F_SATURATED)
STOP_MASK = LVDT_MASK | (1 << F_PAUSED)  # FAIL_SAFE at once


@inlined
def _cause_present(z: np.ndarray, mask: int) -> bool:
    """Is the cause of any fault in ``mask`` there at this tick, rather than gone and the fault healing?"""
    faults = int(z[FAULT_BITS]) & mask
    present = False
    for bit in range(N_FAULTS):
        present |= faults & (1 << bit) != 0 and z[T_STALE + bit] == 0.0
    return present


@inlined
def _choose_mode(z: np.ndarray, k: np.ndarray) -> None:
    """Next mode. The transitions that can happen are listed in docs/controller.md; this is all of them."""
    mode = int(z[MODE])
    faults = int(z[FAULT_BITS])
    must_stop = (faults & STOP_MASK) != 0
    trouble = (faults & (DEMAND_MASK | SERVO_MASK)) != 0
    wants_run = z[RUN_REQUEST] == 1.0
    if mode == INIT:
        if must_stop:
            mode = FAIL_SAFE
        elif z[TICKS] * TICK >= k[INIT_TIME] - HALF_TICK and z[LVDT_GOOD] == 1.0:
            mode = STANDBY
    elif must_stop:
        mode = FAIL_SAFE
        z[RECOVER_TIMER] = 0.0
    elif mode == STANDBY:
        if wants_run and z[DEMAND_SEEN] == 1.0 and not trouble:
            mode = RUN
    elif mode == RUN:
        if trouble:
            mode = DEGRADED
        elif not wants_run:
            mode = STANDBY
    elif mode == DEGRADED:
        if _cause_present(z, DEMAND_MASK | SERVO_MASK):
            z[DEGRADED_TIMER] += TICK
        if not trouble:
            mode = RUN
        elif z[DEGRADED_TIMER] >= k[DEGRADED_HOLD] - HALF_TICK:
            mode = FAIL_SAFE
    elif mode == FAIL_SAFE:
        z[RECOVER_TIMER] = 0.0 if trouble else z[RECOVER_TIMER] + TICK
        if z[RECOVER_TIMER] >= k[RECOVER_TIME] - HALF_TICK:
            mode = RUN if wants_run and z[DEMAND_SEEN] == 1.0 else STANDBY
    if mode != int(z[MODE]):
        z[RECOVER_TIMER] = 0.0
        z[DEGRADED_TIMER] = 0.0
        if mode == STANDBY or mode == FAIL_SAFE or int(z[MODE]) == INIT or int(z[MODE]) == STANDBY:
            z[X_DEM] = min(max(z[X_MEAS], k[STROKE_MIN]), k[STROKE_MAX])  # bumpless: start from where the piston is
            z[X_FROM] = z[X_DEM]
    z[MODE] = float(mode)


@inlined
def tick(inputs: np.ndarray, state: np.ndarray, calibration: Calibration) -> None:
    """Run the controller for one servo tick of 1 ms.

    inputs       float64[N_INPUTS], see `INPUTS`; any value, NaN and infinity included, is safe
    state        float64[N_STATE], changed in place, see `STATE`; start from `controller.new_state()`
    calibration  `controller.Calibration` (scalars ``k``, stroke ``table``, vane ``angles``)

    Invariants: ``state[I_CMD]`` within +-current_limit, ``state[X_DEM]`` within [stroke_min, stroke_max], mode one of
    `MODES`.
    """
    z, k = state, calibration.k
    pause = min(inputs[IN_PAUSE], 1e6) if inputs[IN_PAUSE] > 0.0 else 0.0  # not NaN
    _condition_lvdt(z, k, inputs[IN_X_LVDT], pause)
    _monitor_demand(inputs, z, k, pause)
    _debounce(z, T_PAUSED, pause > 0.0, F_PAUSED, TICK, k[RECOVER_TIME])
    if k[STRATEGY] >= INVERSE:
        z[X_SLOW] += STROKE_SHARE * (z[X_MEAS] - z[X_SLOW])
    if k[STRATEGY] == ADAPTIVE:
        filter_pots(z, k, inputs)
    mode = int(z[MODE])
    phase = int(z[TICKS]) % SLOW
    if phase == 0:
        if z[DEMAND_SEEN] == 1.0:
            z[N_R] += (z[N_R_RAW] - z[N_R]) * SLOW_TICK / (k[SPEED_FILTER] + SLOW_TICK)
            trend_step(z, k, z[N_DEM])
            if k[STRATEGY] <= DUAL:
                schedule_step(z, k, calibration.table)
            else:
                if k[STRATEGY] == ADAPTIVE:
                    learn(z, k)
                inverse_step(z, k, calibration.table, calibration.angles)
        if mode == RUN or mode == DEGRADED:
            move_demand(z, k, z[X_TARGET], k[STROKE_RATE])
        elif mode == FAIL_SAFE:
            move_demand(z, k, k[FAIL_SAFE_STROKE], k[FAIL_SAFE_RATE])
        else:
            z[X_FROM] = z[X_DEM]

    servo_on = mode != INIT and not (mode == FAIL_SAFE and (int(z[FAULT_BITS]) & LVDT_MASK) != 0)
    if not servo_on:
        z[X_DEM] = min(
            max(z[X_MEAS], k[STROKE_MIN]), k[STROKE_MAX]
        )  # bumpless: the servo starts from where the piston is
        z[X_FROM] = z[X_DEM]
    # the servo's reference runs straight through the 10 ms from the last demand to the new one
    dx_ref = (z[X_DEM] - z[X_FROM]) / SLOW_TICK
    x_ref = z[X_FROM] + dx_ref * TICK * (phase + 1)
    z[X_SERVO] = x_ref
    if servo_on:
        servo_step(z, k, x_ref, dx_ref)
    else:
        limit = k[CURRENT_LIMIT]
        z[I_CMD] = 0.0 if mode == INIT else min(max(k[FAIL_SAFE_CURRENT], -limit), limit)
        z[INTEGRAL] = 0.0
        z[SATURATED] = 0.0
    _debounce(
        z,
        T_TRACKING,
        servo_on and abs(x_ref - z[X_MEAS]) > k[TRACKING_LIMIT],
        F_TRACKING,
        k[TRACKING_TIME],
        k[RECOVER_TIME],
    )
    _debounce(z, T_SATURATED, servo_on and z[SATURATED] == 1.0, F_SATURATED, k[SATURATED_TIME], k[RECOVER_TIME])
    z[TICKS] += 1.0
    _choose_mode(z, k)
    # NaN cannot enter through the inputs; this guards the outputs against a calibration edited by hand
    if math.isnan(z[I_CMD]):
        z[I_CMD] = 0.0
