"""The controller's firmware: rotor-speed demand in, servo-valve current out, 1,000 times a second.

Signal flow of one tick (Kim & Ki 2020, figure 7)::

    n_dem --> trend (10 ms) --> which curve ---+
    n_r ----> filter (10 ms) ------------------+--> stroke tables --> x_dem --> PI (1 ms) --> i_cmd
    x_lvdt -> range, rate, stuck (1 ms) ---------------------------------------^

Each part is a module of its own: `trend`, `schedule`, `strategies`, `servo`, `monitors`, `modes`; what they work on is
declared in `records`. `tick` has no clock, no file and no bus: the same inputs and state give the same state, bit for
bit. It writes into ``state`` in place and allocates nothing. Every threshold is calibration (`controller.calibration`).

Units: SI, speeds in % of design speed. Positive current extends.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from controller.modes import choose_mode
from controller.monitors import condition_lvdt, debounce, monitor_demand
from controller.records import (
    ADAPTIVE,
    DEGRADED,
    DUAL,
    F_PAUSED,
    F_SATURATED,
    F_TRACKING,
    FAIL_SAFE,
    INIT,
    INVERSE,
    LVDT_MASK,
    RUN,
    SLOW,
    SLOW_TICK,
    TICK,
    Record,
    as_inputs,
    as_outputs,
    as_scalars,
    as_state,
)
from controller.schedule import move_demand, schedule_step
from controller.servo import servo_step
from controller.strategies import STROKE_SHARE, filter_pots, inverse_step, learn
from controller.trend import trend_step
from vaneloop.base.compiled import inlined

if TYPE_CHECKING:
    from controller.calibration import Calibration

__all__ = ["act", "aim", "filter_speed", "give", "tick", "watch"]


@inlined
def tick(inputs: Record, state: Record, calibration: Calibration) -> None:
    """Run the controller for one servo tick of 1 ms.

    inputs       float64[n] of `INPUTS`, or their record; any value, NaN and infinity included, is safe
    state        float64[n] of `STATE`, or their record, changed in place; start from `controller.new_state()`
    calibration  `controller.Calibration` (scalars ``k``, stroke ``table``, vane ``angles``)

    Invariants: ``state.i_cmd`` within +-current_limit, ``state.x_dem`` within [stroke_min, stroke_max], mode one of
    `MODES`.
    """
    inputs, z, k = as_inputs(inputs), as_state(state), as_scalars(calibration.k)
    watch(inputs, z, k)
    if k.strategy >= INVERSE:
        z.x_slow += STROKE_SHARE * (z.x_meas - z.x_slow)
    if k.strategy == ADAPTIVE:
        filter_pots(z, k, inputs)
    phase = int(z.ticks) % SLOW
    if phase == 0:
        if z.demand_seen == 1.0:
            filter_speed(z, k)
            if k.strategy <= DUAL:
                schedule_step(z, k, calibration.table)
            else:
                if k.strategy == ADAPTIVE:
                    learn(z, k)
                inverse_step(z, k, calibration.table, calibration.angles)
        aim(z, k)
    act(z, k, phase)


@inlined
def watch(inputs: Record, z: Record, k: Record) -> None:
    """First part of every tick: what came in, and whether it can be believed."""
    pause = min(inputs.pause, 1e6) if inputs.pause > 0.0 else 0.0  # not NaN
    condition_lvdt(z, k, inputs.x_lvdt, pause)
    monitor_demand(inputs, z, k, pause)
    debounce(z, F_PAUSED, pause > 0.0, TICK, k.recover_time)


@inlined
def filter_speed(z: Record, k: Record) -> None:
    """Every 10 ms: the measured speed without its noise, and the trend of the demand."""
    z.n_r += (z.n_r_raw - z.n_r) * SLOW_TICK / (k.speed_filter + SLOW_TICK)
    trend_step(z, k, z.n_dem)


@inlined
def aim(z: Record, k: Record) -> None:
    """Every 10 ms: the stroke demand of the present mode."""
    mode = int(z.mode)
    if mode == RUN or mode == DEGRADED:
        move_demand(z, k, z.x_target, k.stroke_rate)
    elif mode == FAIL_SAFE:
        move_demand(z, k, k.fail_safe_stroke, k.fail_safe_rate)
    else:
        z.x_from = z.x_dem


@inlined
def act(z: Record, k: Record, phase: int) -> None:
    """Last part of every tick, the ``phase``-th of ten: servo, its monitors, the next mode."""
    mode = int(z.mode)
    servo_on = mode != INIT and not (mode == FAIL_SAFE and (int(z.faults) & LVDT_MASK) != 0)
    if not servo_on:
        z.x_dem = min(max(z.x_meas, k.stroke_min), k.stroke_max)  # bumpless: the servo starts from where the piston is
        z.x_from = z.x_dem
    # the servo's reference runs straight through the 10 ms from the last demand to the new one
    dx_ref = (z.x_dem - z.x_from) / SLOW_TICK
    x_ref = z.x_from + dx_ref * TICK * (phase + 1)
    z.x_servo = x_ref
    if servo_on:
        servo_step(z, k, x_ref, dx_ref)
    else:
        limit = k.current_limit
        z.i_cmd = 0.0 if mode == INIT else min(max(k.fail_safe_current, -limit), limit)
        z.integral = 0.0
        z.saturated = 0.0
    debounce(z, F_TRACKING, servo_on and abs(x_ref - z.x_meas) > k.tracking_limit, k.tracking_time, k.recover_time)
    debounce(z, F_SATURATED, servo_on and z.saturated == 1.0, k.saturated_time, k.recover_time)
    z.ticks += 1.0
    choose_mode(z, k)
    # NaN cannot enter through the inputs; this guards the outputs against a calibration edited by hand
    if math.isnan(z.i_cmd):
        z.i_cmd = 0.0


@inlined
def give(state: Record, outputs: Record) -> None:
    """Fill ``outputs`` (float64[n] of `OUTPUTS`, or their record) with what leaves the firmware after a tick."""
    z, out = as_state(state), as_outputs(outputs)
    out.i_cmd, out.x_dem, out.mode, out.faults = z.i_cmd, z.x_dem, z.mode, z.faults
