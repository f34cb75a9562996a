"""The servo loop in time, with the firmware's own servo step and the plant's own steps; what the design predicts is
held against it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller import new_state
from controller.records import SCALAR_FIELDS, as_state, record
from controller.servo import servo_step
from plant.play import play_step
from plant.sensors import lag_factor, quantise
from vaneloop.design.limit_cycles import LimitCycle, Play
from vaneloop.design.servo import Gains, ServoPlant

__all__ = ["Trajectory", "ramp_demand", "simulate", "steady_cycle"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """A simulated run, one sample a tick; SI. ``x_vane`` is the stroke after the play outside the loop."""

    t: Array
    x_dem: Array
    x: Array
    x_lvdt: Array
    x_vane: Array
    i: Array
    play_in: Array  # input of the play inside the loop, in its unit


def ramp_demand(points: ArrayLike, plant: ServoPlant) -> tuple[Array, Array]:
    """Servo reference (m) and its rate (m/s) at each tick from stroke demands every 10 ms: straight lines, as the
    firmware draws them.
    """
    p = np.asarray(points, dtype=float)
    n = round(10e-3 / plant.tick)
    start = np.concatenate([[p[0]], p[:-1]])
    rate = (p - start) / (n * plant.tick)
    k = np.arange(1, n + 1)
    return (start[:, None] + rate[:, None] * k * plant.tick).ravel(), np.repeat(rate, n)


def simulate(
    gains: Gains,
    plant: ServoPlant,
    x_ref: ArrayLike,
    dx_ref: ArrayLike | None = None,
    *,
    play: Play | None = None,
    outside: float = 0.0,
    noise_seed: int | None = None,
    quantised: bool = False,
    null_bias: float = 0.0,
    start: float | None = None,
    integral: float = 0.0,
    substeps: int = 10,
) -> Trajectory:
    """The loop in time, with the firmware's `servo_step` and the plant's own steps; one row a tick.

    x_ref, dx_ref   reference (m) and its rate (m/s) at each tick
    play            lost motion inside the loop, None for none
    outside         total gap (m of stroke) between piston and vanes
    noise_seed      None for a noise-free LVDT
    null_bias       A, added to the current in the valve
    start           m, stroke at t = 0 (default the reference's); ``play`` then stands at its edge, as if the piston had
                    come from below
    integral        A, integral part at t = 0
    """
    ref = np.asarray(x_ref, dtype=float)
    rate = np.zeros_like(ref) if dx_ref is None else np.asarray(dx_ref, dtype=float)
    z, k = as_state(new_state()), record(SCALAR_FIELDS)
    k.kp, k.ki, k.kff, k.current_limit = gains.kp, gains.ki, gains.kff, plant.current_limit
    z.integral = integral
    lag = lag_factor(plant.lvdt_lag, plant.tick / substeps)
    site, gap = (play.site, play.gap) if play else ("", 0.0)
    noise = np.zeros(ref.size)
    if noise_seed is not None:
        noise = plant.lvdt_noise * np.random.default_rng(noise_seed).standard_normal(ref.size)
    x = float(ref[0] if start is None else start)
    rod = x - 0.5 * gap if site == "lvdt" else x
    x_lvdt, vane, spool_i = rod, x - 0.5 * outside, 0.0
    step = plant.stepper(x, substeps)
    pending = [0.0] * plant.delay
    out: Array = np.empty((6, ref.size), dtype=np.float64)
    for n in range(ref.size):
        y = x_lvdt + noise[n]
        z.x_meas = quantise(y, plant.lvdt_step) if quantised else y
        servo_step(z, k, ref[n], rate[n])
        pending.append(float(z.i_cmd))
        i = pending.pop(0) + null_bias
        if site == "valve":
            spool_i = play_step(spool_i, i, gap)
            drive = spool_i
        else:
            drive = i
        out[:, n] = x, z.x_meas, vane, z.i_cmd, x if site != "valve" else i, rod
        for _ in range(substeps):
            x = step(drive)
            rod = play_step(rod, x, gap) if site == "lvdt" else x
            x_lvdt += lag * (rod - x_lvdt)
        vane = play_step(vane, x, outside)
    t: Array = np.arange(ref.size, dtype=np.float64) * plant.tick
    return Trajectory(t, ref, out[0], out[1], out[2], out[3], out[4])


def steady_cycle(t: Array, signal: Array, smallest: float) -> LimitCycle | None:
    """The oscillation in the second half of a run: fundamental amplitude and frequency, None if below ``smallest`` peak
    to peak.

    ``after`` is half the peak-to-peak value, to tell how far from a sine it is.
    """
    half = signal.size // 2
    y, tt = signal[half:] - np.mean(signal[half:]), t[half:]
    y = y - 0.5 * (y.max() + y.min())
    span = float(np.ptp(y))
    if span < smallest:
        return None
    # upward crossings that follow a swing below a quarter of the amplitude: noise near zero makes no extra ones
    crossings, armed = [], False
    for n in range(1, y.size):
        armed = armed or y[n] < -0.125 * span
        if armed and y[n - 1] < 0.0 <= y[n]:
            crossings.append(tt[n - 1] + (tt[n] - tt[n - 1]) * y[n - 1] / (y[n - 1] - y[n]))
            armed = False
    if len(crossings) < 3:
        return None
    w = 2.0 * math.pi * (len(crossings) - 1) / (crossings[-1] - crossings[0])
    whole = (tt >= crossings[0]) & (tt < crossings[-1])
    fundamental = 2.0 * abs(np.mean(y[whole] * np.exp(-1j * w * tt[whole])))
    return LimitCycle(float(fundamental), float(w), 0.5 * span)
