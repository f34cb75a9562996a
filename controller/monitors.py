"""What the firmware believes: plausibility of the LVDT and of the demand, fault bits and their timers."""

from __future__ import annotations

from controller.records import (
    F_DEMAND_RANGE,
    F_LVDT_RANGE,
    F_LVDT_RATE,
    F_LVDT_STUCK,
    F_REJECTED,
    F_STALE,
    HALF_TICK,
    TICK,
    Record,
)
from vaneloop.base.compiled import inlined

__all__ = ["condition_lvdt", "debounce", "debounce_leaky", "monitor_demand"]

FAR = 1.0  # m, beyond any stroke


@inlined
def debounce(z: Record, bit: int, bad: bool, rise: float, heal: float) -> None:
    """Set fault ``bit`` after ``rise`` seconds of bad ticks, clear it after ``heal`` seconds of good ones.

    The timer counts up to ``rise`` while bad; once the fault stands it counts down from 0 to -``heal`` while good.
    """
    mask = int(z.faults)
    if mask & (1 << bit):
        z.timers[bit] = 0.0 if bad else z.timers[bit] - TICK
        if z.timers[bit] <= HALF_TICK - heal:
            z.faults = float(mask & ~(1 << bit))
            z.timers[bit] = 0.0
    else:
        z.timers[bit] = z.timers[bit] + TICK if bad else 0.0
        if bad and z.timers[bit] >= rise - HALF_TICK:
            z.faults = float(mask | (1 << bit))
            z.timers[bit] = 0.0


@inlined
def condition_lvdt(z: Record, k: Record, x: float, pause: float) -> None:
    """Take a stroke sample if it is plausible (range, rate, not stuck); otherwise keep the last plausible one.

    A sample is plausible if the piston can have come there from the last plausible one at ``lvdt_rate``, however long
    ago that was: a spike costs one sample, a gap none after it, and a lasting step is refused until it is a fault.
    ``pause`` (s): time before this tick in which no sample was taken.
    """
    in_range = k.lvdt_low <= x <= k.lvdt_high  # False for NaN
    z.x_reach = min(z.x_reach + k.lvdt_rate * (TICK + pause), FAR)
    jump = in_range and abs(x - z.x_meas) > z.x_reach
    if in_range and not jump:
        z.lvdt_good = 1.0
        z.x_meas = x
        z.x_reach = 0.0
    else:
        z.lvdt_good = 0.0
    debounce_leaky(z, F_LVDT_RANGE, not in_range, k.lvdt_debounce, k.lvdt_heal)
    # each jump counts as five samples of the debounce time: a lasting step of more than 2 mm (the tracking limit) is a
    # fault
    if jump:
        z.timers[F_LVDT_RATE] += 4.0 * TICK
    debounce_leaky(z, F_LVDT_RATE, jump, k.lvdt_debounce, k.lvdt_heal)

    # stuck: a current that must move the piston, and no motion, away from the end stops; then stuck until there is
    # motion
    inside = k.stroke_min + k.stuck_margin < z.x_meas < k.stroke_max - k.stuck_margin
    stuck = z.stuck_timer >= k.stuck_time - HALF_TICK
    asked = abs(z.i_cmd) > k.stuck_current and inside
    if (asked or stuck) and abs(z.x_meas - z.stuck_x) < k.stuck_motion:
        if not stuck:
            z.stuck_timer += TICK
    else:
        z.stuck_x = z.x_meas
        z.stuck_timer = 0.0
    debounce(z, F_LVDT_STUCK, z.stuck_timer >= k.stuck_time - HALF_TICK, TICK, k.lvdt_heal)


@inlined
def debounce_leaky(z: Record, bit: int, bad: bool, rise: float, heal: float) -> None:
    """Like `debounce`, but good ticks only count the timer down: intermittent faults add up."""
    mask = int(z.faults)
    if mask & (1 << bit):
        debounce(z, bit, bad, rise, heal)
        return
    z.timers[bit] = z.timers[bit] + TICK if bad else max(0.0, z.timers[bit] - 0.1 * TICK)
    if z.timers[bit] >= rise - HALF_TICK:
        z.faults = float(mask | (1 << bit))
        z.timers[bit] = 0.0


@inlined
def monitor_demand(inputs: Record, z: Record, k: Record, pause: float) -> None:
    """Age, refusals and range of the ECU's demand; take the values of a good frame, its mode request too. It aged by
    ``pause`` (s), too.
    """
    n_dem, n_r, request = inputs.n_dem, inputs.n_r, inputs.mode_request
    fresh = inputs.demand_fresh > 0.5
    in_range = (
        (k.demand_low <= n_dem <= k.demand_high) and (k.demand_low <= n_r <= k.demand_high) and 0.0 <= request <= 1.0
    )  # not NaN
    good = fresh and in_range
    rejected = inputs.demand_rejected
    if not (rejected >= 0.0):
        rejected = 0.0
    bucket = max(z.reject_bucket - k.demand_reject_leak * TICK, 0.0) + rejected
    z.reject_bucket = min(bucket, k.demand_reject_limit)
    if good:
        z.demand_age = 0.0
        z.n_dem = n_dem
        z.n_r_raw = n_r
        z.run_request = 1.0 if request > 0.5 else 0.0
        if z.demand_seen == 0.0:
            z.demand_seen = 1.0
            z.n_r = n_r
            z.speed = n_r
            z.trend_n = n_dem
            z.trend_turn = n_dem
            z.trend_last = n_dem
    else:
        z.demand_age = min(z.demand_age + (TICK + pause), 1e6)
    debounce(z, F_STALE, z.demand_age >= k.demand_timeout - HALF_TICK, TICK, k.recover_time)
    debounce(z, F_REJECTED, z.reject_bucket >= k.demand_reject_limit, TICK, k.recover_time)
    debounce(z, F_DEMAND_RANGE, fresh and not in_range, TICK, k.recover_time)
