"""Electromechanical actuator as one part, with every effect: servo amplifier, motor, gear, ball screw and LVDT.

What is known before a step, and the step; in the form of `plant.drive`. Equations, at the motor's shaft::

    w* = w_rated lag(deadband(i_cmd + offset)) / i_rated              amplifier: the command is a speed demand
    i* = k_p (w* - w) + I,   dI/dt = k_p / T_i (w* - w)               its PI speed loop; I stands while i* is cut
    di/dt = w_c (cut(i*) - i)                                         its current loop
    cut: |i| <= i_peak,   |R i + K_e w| <= V,   K_e = K_t             peak current; bus voltage less back-EMF
    J dw/dt = K_t i - B w - F r - T_f sgn(w)                          motor, gear and screw
    T_f = r (f + |F| (1/eta - 1))                                     friction; at rest it holds up to T_f
    x = r (angle of the motor) - F / k,   0 <= x <= stroke            rod on a screw of stiffness k

Symbols: w motor speed (rad/s, > 0 extends), i motor current (A), I integral part (A), F load against extension (N), f
Coulomb friction seen at the rod (N), eta efficiency of the screw when it lifts the load, x stroke (m), J inertia of
rotor, gear and rod (kg m2), r = lead / (2 pi ratio) way of the rod for an angle of the motor (m/rad).

A screw loses a share of its load. Written as friction this gives the efficiency eta where the motor drives the load and
2 - 1/eta where the load drives the motor; a screw with eta <= 1/2 locks itself. That is what lead angle l and friction
angle q give while q is small: eta = tan l / tan(l + q) = 1 / (1 + q/l), back-driven tan(l - q) / tan l = 1 - q/l.

The motor is the direct-current one that is equivalent to a machine with sinusoidal currents. The screw bends under the
outer load without delay. The end stops take the speed away (inelastic) and the current goes on to its limit. The step
of the current is exact; that of the friction is implicit, so that it stops a motor and never turns it back.

Sources: Krishnan, Electric Motor Drives (2001), ch. 3 (current and speed controllers of a direct-current drive);
Budynas and Nisbett, Shigley's Mechanical Engineering Design (2015), section 8-2 (power screws: raising, lowering,
self-locking); Moreau, Numerical aspects of the sweeping process (1999) (implicit friction).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from plant.effects import (
    aero_load,
    amplifier_dead_band,
    amplifier_lag,
    amplifier_offset,
    end_stop_shift,
    gear_backlash,
    lvdt_lag,
    motor_torque_constant_error,
    screw_friction,
    screw_pitch_error,
    tacho_thermal_drift,
)
from plant.parameters import (
    AMPLIFIER_SHARE,
    CURRENT_SHARE,
    GEAR_INERTIA,
    GEAR_RATIO,
    LVDT_FACTOR,
    LVDT_SHARE,
    MOTOR_INERTIA,
    PEAK_CURRENT,
    RATED_CURRENT,
    RATED_SPEED,
    RESISTANCE,
    SCREW_EFFICIENCY,
    SCREW_FRICTION,
    SCREW_LEAD,
    SCREW_MASS,
    SCREW_STIFFNESS,
    SCREW_VISCOUS,
    SPEED_GAIN,
    SPEED_TIME,
    STROKE,
    TORQUE_CONSTANT,
    VOLTAGE,
)
from plant.places import (
    AHEAD,
    BENT,
    DEMANDED,
    END_STOP_SHIFT,
    I_MOTOR,
    MOTOR_SPEED,
    MOTOR_TORQUE_CONSTANT_ERROR,
    READING,
    SCREW_FRICTION_ERROR,
    SPEED,
    SPEED_INTEGRAL,
    TACHO_THERMAL_DRIFT,
    X_LVDT,
    X,
)
from plant.prepared import with_effects
from vaneloop.base.compiled import inlined

__all__ = [
    "Motor", "MotorState", "demand", "load_of", "load_torques", "prepare", "rated_speed", "rest", "sense", "step",
    "stored", "taken",
]  # fmt: skip


class MotorState(NamedTuple):
    """What moves.

    demanded    A, command behind the amplifier's lag
    integral    A, integral part of the speed loop
    i           A, motor current
    w           rad/s, motor speed
    speed       m/s, of the nut
    ahead       m, by which the motor is ahead of the rod in the play
    bent        m, by which the load bends screw and bearings
    x, x_lvdt   m, stroke, and behind the LVDT's lag
    reading     m, stroke behind both lags of the LVDT
    """

    demanded: float
    integral: float
    i: float
    w: float
    speed: float
    ahead: float
    bent: float
    x: float
    x_lvdt: float
    reading: float


class _Motor(NamedTuple):
    """What a step needs of the machine, worked out once; behind these fields those of the effects at amplifier, motor,
    screw and actuator (`plant.prepared`).

    per_rated, bare_rated, rated    1/A, rad/s without and with the tacho's drift: command to speed demand
    lag_share, current_share        shares of the way that amplifier_lag and the current loop go in a step
    gain, rate                      A s/rad, A/rad: speed loop
    peak, voltage, per_ohm          A, V, 1/Ohm
    torque                          N m/A, also V s/rad
    inertia, viscous                kg m2, N m s/rad
    r, friction, loss               m/rad, N, 1/eta - 1
    per_stiffness                   m/(N m), of the load's torque
    lead                            m
    low, high                       m, end stops
    lvdt_factor, lvdt_share         shares of the way that the LVDT's lags go in a plant step
    """

    per_rated: float
    bare_rated: float
    rated: float
    lag_share: float
    current_share: float
    gain: float
    rate: float
    peak: float
    voltage: float
    per_ohm: float
    torque: float
    inertia: float
    viscous: float
    r: float
    friction: float
    loss: float
    per_stiffness: float
    lead: float
    low: float
    high: float
    lvdt_factor: float
    lvdt_share: float


@inlined
def _numbers(p: np.ndarray, j: int, temperature: float) -> _Motor:
    """Return what lane ``j`` of the parameters needs for its steps at ``temperature`` (degC), but for the effects' own
    numbers.
    """
    low, high = end_stop_shift.step(p[STROKE, j], p[END_STOP_SHIFT, j])
    r = p[SCREW_LEAD, j] / (2.0 * math.pi * p[GEAR_RATIO, j])
    return _Motor(
        1.0 / p[RATED_CURRENT, j],
        p[RATED_SPEED, j] / r,
        tacho_thermal_drift.step(p[RATED_SPEED, j] / r, temperature, p[TACHO_THERMAL_DRIFT, j]),
        p[AMPLIFIER_SHARE, j],
        p[CURRENT_SHARE, j],
        p[SPEED_GAIN, j],
        p[SPEED_GAIN, j] / p[SPEED_TIME, j],
        p[PEAK_CURRENT, j],
        p[VOLTAGE, j],
        1.0 / p[RESISTANCE, j],
        motor_torque_constant_error.step(p[TORQUE_CONSTANT, j], p[MOTOR_TORQUE_CONSTANT_ERROR, j]),
        p[MOTOR_INERTIA, j] + p[GEAR_INERTIA, j] + p[SCREW_MASS, j] * r * r,
        p[SCREW_VISCOUS, j],
        r,
        screw_friction.step(p[SCREW_FRICTION, j], p[SCREW_FRICTION_ERROR, j]),
        1.0 / p[SCREW_EFFICIENCY, j] - 1.0,
        1.0 / (p[SCREW_STIFFNESS, j] * r),
        p[SCREW_LEAD, j],
        low,
        high,
        p[LVDT_FACTOR, j],
        p[LVDT_SHARE, j],
    )


Motor, prepare = with_effects(_Motor, _numbers, "p, j, temperature", "amplifier", "motor", "screw", "actuator")


@inlined
def taken(s: np.ndarray, j: int) -> MotorState:
    """Return the state of lane ``j``."""
    return MotorState(
        s[DEMANDED, j],
        s[SPEED_INTEGRAL, j],
        s[I_MOTOR, j],
        s[MOTOR_SPEED, j],
        s[SPEED, j],
        s[AHEAD, j],
        s[BENT, j],
        s[X, j],
        s[X_LVDT, j],
        s[READING, j],
    )


@inlined
def stored(s: np.ndarray, j: int, z: MotorState) -> None:
    """Put the state of lane ``j`` back."""
    s[DEMANDED, j], s[SPEED_INTEGRAL, j], s[I_MOTOR, j], s[MOTOR_SPEED, j] = z.demanded, z.integral, z.i, z.w
    s[SPEED, j], s[AHEAD, j], s[BENT, j] = z.speed, z.ahead, z.bent
    s[X, j], s[X_LVDT, j], s[READING, j] = z.x, z.x_lvdt, z.reading


@inlined
def rated_speed(d: Any, temperature: float) -> float:
    """Return the speed (rad/s) that the rated current asks for at ``temperature`` (degC): what is ``rated`` then."""
    return tacho_thermal_drift.step(d.bare_rated, temperature, d.tacho_thermal_drift)


@inlined
def demand(d: Any, i_read: float) -> float:
    """Return the speed (rad/s) that the amplifier asks for at the command ``i_read`` (A) behind its lag."""
    return d.rated * (amplifier_dead_band.step(i_read, d.amplifier_dead_band) * d.per_rated)


@inlined
def load_of(d: Any, n_r: float) -> float:
    """Return the load (N) against extension at the speed ``n_r`` (%)."""
    return aero_load.step(n_r, d.aero_load)


@inlined
def load_torques(d: Any, force: float) -> tuple[float, float]:
    """Return the torque (N m) of the load ``force`` (N against extension) at the motor, and the most that friction
    takes.
    """
    return d.r * force, d.r * (d.friction + abs(force) * d.loss)


@inlined
def rest(p: np.ndarray, s: np.ndarray, j: int, i_cmd: float, force: float, temperature: float) -> None:
    """Let lane ``j`` go at the steady speed that ``i_cmd`` (A) asks for, under the load ``force`` (N): its state but
    for the stroke.
    """
    d = prepare(p, j, temperature)
    read = amplifier_offset.step(i_cmd, d.amplifier_offset)
    w = demand(d, read)
    load, friction = load_torques(d, force)
    torque = load + d.viscous * w + (friction if w > 0.0 else -friction if w < 0.0 else 0.0)
    i = min(max(torque / d.torque, -d.peak), d.peak)
    s[DEMANDED, j], s[SPEED_INTEGRAL, j], s[I_MOTOR, j], s[MOTOR_SPEED, j], s[SPEED, j] = read, i, i, w, d.r * w
    s[BENT, j] = load * d.per_stiffness
    s[AHEAD, j] = 0.5 * d.gear_backlash if w > 0.0 else -0.5 * d.gear_backlash if w < 0.0 else 0.0


@inlined
def step(z: MotorState, d: Any, i_cmd: float, load: float, friction: float, h: float, swaying: bool) -> MotorState:
    """One step ``h`` (s) of the motor and the rod under the command ``i_cmd`` (A) and the torques (N m) of
    `load_torques`.

    swaying  False leaves out the screw's pitch error: for lanes where it is neutral
    """
    demanded = amplifier_lag.step(z.demanded, amplifier_offset.step(i_cmd, d.amplifier_offset), d.lag_share)
    e = demand(d, demanded) - z.w
    wanted = d.gain * e + z.integral
    back = d.torque * z.w
    low, high = (-d.voltage - back) * d.per_ohm, (d.voltage - back) * d.per_ohm
    allowed = min(max(min(max(wanted, low), high), -d.peak), d.peak)
    # a cut demand goes no deeper into its limit
    integral = z.integral + d.rate * e * h if (wanted - allowed) * e <= 0.0 else z.integral
    i = allowed + (z.i - allowed) * (1.0 - d.current_share)
    # friction takes the speed away within the step, but not beyond rest
    share = h / (d.inertia + h * d.viscous)
    w = share * (d.inertia / h * z.w + d.torque * i - load)
    w -= min(max(w, -share * friction), share * friction)
    ahead, way = gear_backlash.step(z.ahead, 0.5 * (z.w + w) * d.r * h, d.gear_backlash)
    if swaying:
        way = screw_pitch_error.step(z.x, way, d.lead, d.screw_pitch_error_amplitude, d.screw_pitch_error_phase)
    bent = load * d.per_stiffness
    free = z.x + (way - (bent - z.bent))
    x = min(max(free, d.low), d.high)
    w = w if free == x else 0.0
    return MotorState(demanded, integral, i, w, d.r * w, ahead, bent, x, z.x_lvdt, z.reading)


@inlined
def sense(z: MotorState, d: Any) -> MotorState:
    """The LVDT's step, at the end of a plant step."""
    x_lvdt = z.x_lvdt + d.lvdt_factor * (z.x - z.x_lvdt)
    reading = lvdt_lag.step(z.reading, x_lvdt, d.lvdt_share)
    return MotorState(z.demanded, z.integral, z.i, z.w, z.speed, z.ahead, z.bent, z.x, x_lvdt, reading)
