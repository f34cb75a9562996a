"""Is the demand rising or falling? The trend of the ECU"s demand, which chooses the curve."""

from __future__ import annotations

from controller.records import HALF_TICK, SLOW_TICK, Record
from vaneloop.base.compiled import inlined

__all__ = ["trend_step"]


@inlined
def trend_step(z: Record, k: Record, n_dem: float) -> None:
    """Is the demand rising or falling? One 10 ms step.

    The rate comes from a constant-rate Kalman filter in its steady-state form (alpha-beta)::

        n- = n + rate T,   r = n_dem - n-,   n = n- + alpha r,   rate = rate + beta r / T

    ``back`` is how far the demand has come back from its farthest point along the present direction. The direction
    turns once the demand has been moving against it (rate beyond ``trend_rate_on``) and is back by half of
    ``trend_change``, or has crept back by the whole of it, and this has stood without a gap for ``trend_hold``. The
    turning point is taken from the demand itself: the filter overshoots after a slam and would turn falsely at its end.
    It takes two steps in a row to move it, so that one wrong demand moves nothing.
    """
    predicted = z.trend_n + z.trend_rate * SLOW_TICK
    r = n_dem - predicted
    z.trend_n = predicted + k.trend_alpha * r
    z.trend_rate = z.trend_rate + k.trend_beta * r / SLOW_TICK
    d = z.direction
    last = z.trend_last
    ahead = d * (n_dem - last) > 0.0
    reached = last if ahead else n_dem
    if d * (reached - z.trend_turn) > 0.0:
        z.trend_turn = reached
    z.trend_last = n_dem
    back = d * (z.trend_turn - n_dem)
    moving = -d * z.trend_rate > k.trend_rate_on and back > 0.5 * k.trend_change
    if moving or back > k.trend_change:
        z.trend_timer += SLOW_TICK
        if z.trend_timer >= k.trend_hold - HALF_TICK:
            z.direction = -d
            z.trend_turn = n_dem if ahead else last
            z.trend_timer = 0.0
    else:
        z.trend_timer = 0.0
