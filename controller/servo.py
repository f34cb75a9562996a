"""The servo loop: PI with feed-forward on the LVDT"s stroke, current limit, anti-windup."""

from __future__ import annotations

from controller.records import TICK, Record
from vaneloop.base.compiled import inlined

__all__ = ["servo_step"]


@inlined
def servo_step(z: Record, k: Record, x_ref: float, dx_ref: float) -> None:
    """Servo-valve current: PI on the stroke error with feed-forward of the demanded speed, one tick of 1 ms.

    ::

        e = x_ref - x_meas,   i = kp e + integral + kff dx_ref,   d(integral)/dt = ki e

    The current is limited to +-``current_limit``; while it is, the integral does not grow further into the limit
    (anti-windup).
    """
    e = x_ref - z.x_meas
    limit = k.current_limit
    integral = z.integral + k.ki * e * TICK
    i = k.kp * e + integral + k.kff * dx_ref
    if i > limit:
        i = limit
        z.saturated = 1.0
        if e < 0.0:
            z.integral = integral
    elif i < -limit:
        i = -limit
        z.saturated = 1.0
        if e > 0.0:
            z.integral = integral
    else:
        z.saturated = 0.0
        z.integral = integral
    z.integral = min(max(z.integral, -limit), limit)
    z.i_cmd = i
