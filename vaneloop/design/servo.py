"""The servo loop: gains, plant, the open loop, its margins at the nominal plant and at every corner of the tolerances.

The loop, broken at the stroke (positive current extends)::

    e = x_dem - x_lvdt,   i = kp e + ki T sum(e) + kff dx_dem/dt                     controller, T = 1 ms
    u'' + 2 zeta w u' + w^2 u = w^2 i / i_rated,   dx/dt = g sqrt(p_s/p_ref) u       valve, actuator
    x_lvdt' = (x - x_lvdt) / tau                                                     LVDT

    L(s) = (kp + ki/s) w^2 / (i_rated (s^2 + 2 zeta w s + w^2)) g sqrt(p_s/p_ref) / s  1 / (tau s + 1)  exp(-s T (1/2 +
                                                                                       d))

Timing: the LVDT is read at the tick and the current of that tick is written at once and held, so a tick costs half a
tick of delay; ``d`` is a computation delay in whole ticks on top of it. The design must stand for d = 0 and d = 1.

Units: SI. What play does to the loop is in `limit_cycles`, the loop in time in `servo_simulation`, the whole design
with its stated limits in `servo_design`.

Sources: Merritt, Hydraulic Control Systems (1967), ch. 6 and 7; Seiler, Packard, Gahinet, An Introduction to Disk
Margins, IEEE Control Systems Magazine 40 (2020).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.calibration import CalibrationTable
from plant.actuator import speed_factor, stroke_step
from plant.valve import valve_matrix, valve_step
from vaneloop.base.errors import InputError
from vaneloop.base.tables import read

__all__ = [
    "Corner", "Gains", "Margins", "ServoPlant", "analyse", "continuous_loop", "continuous_response", "default_gains",
    "frequency_grid", "frequency_response", "margins", "noise_current", "sampled_loop",
]  # fmt: skip

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


# ---------------------------------------------------------------- what is designed


@dataclass(frozen=True)
class Gains:
    """Gains of the stroke loop.

    kp   A/m (= mA/mm)
    ki   A/(m s) (= mA/(mm s))
    kff  A/(m/s) (= mA/(mm/s))
    """

    kp: float
    ki: float
    kff: float

    def __post_init__(self) -> None:
        for name, low, high in (("kp", 1e-3, 1e3), ("ki", 0.0, 1e5), ("kff", 0.0, 10.0)):
            v = getattr(self, name)
            if not low <= v <= high:  # NaN included
                raise InputError(f"{name} (={v:g}) must be in [{low:g}, {high:g}]")


@dataclass(frozen=True)
class ServoPlant:
    """Valve, actuator, LVDT and sampling as the loop sees them; SI. Defaults: those of the shipped tables, which
    `servo_motor.plant_of_tables` reads."""

    rated_current: float = 0.040  # A
    bandwidth: float = 60.0  # Hz, undamped natural frequency of the valve
    damping: float = 0.8
    flow_gain: float = 0.150  # m/s at full spool and p_ref
    pressure: float = 21e6  # Pa
    p_ref: float = 21e6  # Pa
    stroke: float = 48e-3  # m
    lvdt_lag: float = 1e-3  # s
    lvdt_noise: float = 5e-6  # m rms, white from tick to tick
    lvdt_step: float = 50e-3 / 65536  # m, one code of 16 bits
    current_limit: float = 0.040  # A
    tick: float = 1e-3  # s
    delay: int = 0  # ticks of computation delay (a tick is 1 ms)

    @property
    def speed_per_ampere(self) -> float:
        """Steady speed of the piston for a current, (m/s)/A, at the present supply pressure."""
        return self.flow_gain * math.sqrt(self.pressure / self.p_ref) / self.rated_current

    @property
    def hysteretic(self) -> bool:
        """Whether what reads the current remembers where it came from: a valve does."""
        return True

    def dynamics(self) -> tuple[ArrayLike, ArrayLike]:
        """Numerator and denominator, powers of s falling, from steady to present speed: the valve."""
        w = 2.0 * math.pi * self.bandwidth
        return [w * w], [1.0, 2.0 * self.damping * w, w * w]

    def response(self, s: Complex) -> Complex:
        """The same at the complex frequencies ``s`` (rad/s)."""
        w = 2.0 * math.pi * self.bandwidth
        return np.asarray(w * w / (s * s + 2.0 * self.damping * w * s + w * w))

    def corners(self) -> list[tuple[Callable[[Margins], Corner], ServoPlant]]:
        """Flow 5 %, valve bandwidth and damping 15 %, 19 to 22 MPa, 0 or 1 tick of computation delay."""
        out: list[tuple[Callable[[Margins], Corner], ServoPlant]] = []
        for flow, band, damp, mpa, delay in itertools.product(
            (0.95, 1.05), (0.85, 1.15), (0.85, 1.15), (19.0, 22.0), (0, 1)
        ):
            p = replace(
                self,
                flow_gain=self.flow_gain * flow,
                bandwidth=self.bandwidth * band,
                damping=min(self.damping * damp, 0.99),
                pressure=mpa * 1e6,
                delay=delay,
            )
            out.append((partial(Corner, flow, band, damp, mpa, delay), p))
        return out

    def stepper(self, x: float, substeps: int) -> Callable[[float], float]:
        """Return the plant's own step of a tick's ``substeps``-th part, from rest at the stroke ``x`` (m): from current
        (A) to stroke (m).
        """
        dt = self.tick / substeps
        matrix = valve_matrix(self.bandwidth, self.damping, dt)
        speed = self.flow_gain * speed_factor(self.pressure, 0.0, self.p_ref)
        u, du = 0.0, 0.0

        def step(i: float) -> float:
            nonlocal u, du, x
            before = u
            u, du = valve_step(u, du, i / self.rated_current, *matrix)
            x = stroke_step(x, speed * before, speed * u, self.stroke, dt)
            return x

        return step


def default_gains() -> Gains:
    """The gains in ``calibration.toml``."""
    servo = read("calibration.toml", CalibrationTable).servo
    return Gains(servo.kp.value, servo.ki.value, servo.kff.value)


# ---------------------------------------------------------------- the open loop


def _s_plant(plant: ServoPlant) -> ct.TransferFunction:
    """From current (A) to measured stroke (m)."""
    valve = ct.tf(*plant.dynamics())
    actuator = ct.tf([plant.speed_per_ampere], [1.0, 0.0])
    lvdt = ct.tf([1.0], [plant.lvdt_lag, 1.0])
    return valve * actuator * lvdt


def continuous_loop(gains: Gains, plant: ServoPlant, order: int = 4) -> ct.TransferFunction:
    """Loop transfer function L(s) with the delay of half a tick and of the computation as a Pade approximation of
    ``order``.
    """
    pi = ct.tf([gains.kp, gains.ki], [1.0, 0.0]) if gains.ki else ct.tf([gains.kp], [1.0])
    delay = ct.tf(*ct.pade(plant.tick * (0.5 + plant.delay), order))
    return pi * _s_plant(plant) * delay


def continuous_response(gains: Gains, plant: ServoPlant, omega: ArrayLike) -> Complex:
    """L(j omega) in closed form, delay exact; omega in rad/s."""
    s = 1j * np.asarray(omega, dtype=float)
    path = plant.response(s) * plant.speed_per_ampere / s / (plant.lvdt_lag * s + 1.0)
    return np.asarray((gains.kp + gains.ki / s) * path * np.exp(-s * plant.tick * (0.5 + plant.delay)))


def _sampled_plant(plant: ServoPlant) -> ct.StateSpace:
    """From current (A, held for a tick) to the LVDT's sample (m), computation delay included."""
    p = ct.sample_system(ct.ss(_s_plant(plant)), plant.tick, method="zoh")
    if plant.delay:
        p = p * ct.ss(ct.tf([1.0], [1.0] + [0.0] * plant.delay, plant.tick))
    return p


def _sampled_pi(gains: Gains, plant: ServoPlant) -> ct.StateSpace:
    """kp + ki T z/(z - 1): the firmware adds a tick's error to the integral before it uses it."""
    if not gains.ki:
        return ct.ss([], [], [], [[gains.kp]], plant.tick)
    # state: the integral before this tick
    return ct.ss([[1.0]], [[gains.ki * plant.tick]], [[1.0]], [[gains.kp + gains.ki * plant.tick]], plant.tick)


def sampled_loop(gains: Gains, plant: ServoPlant) -> ct.StateSpace:
    """Loop transfer function L(z) as the firmware closes it: exact zero-order hold, tick of ``plant.tick``."""
    return _sampled_plant(plant) * _sampled_pi(gains, plant)


# ---------------------------------------------------------------- margins


@dataclass(frozen=True)
class Margins:
    """How far the loop is from instability.

    disk_margin       alpha = 1 / max |S - T|/2: gain and phase may err together inside the disk that alpha describes
    disk_gain_db, disk_phase_deg   what the disk allows: gain alone (up or down), phase alone
    sensitivity_peak, complementary_peak   max |S|, max |T|
    """

    stable: bool
    crossover_hz: float
    gain_margin_db: float
    phase_margin_deg: float
    phase_crossover_hz: float
    disk_margin: float
    disk_gain_db: float
    disk_phase_deg: float
    disk_hz: float
    sensitivity_peak: float
    complementary_peak: float
    bandwidth_hz: float  # |T| = -3 dB, x_dem to x_lvdt without feed-forward


def frequency_grid(plant: ServoPlant, points: int = 2500) -> Array:
    """Frequencies (rad/s) from 0.05 Hz to just below half the sampling rate."""
    return np.geomspace(2.0 * math.pi * 0.05, 0.999 * math.pi / plant.tick, points)


def frequency_response(system: ct.StateSpace, omega: Array) -> Complex:
    """Frequency response of a loop with one input and one output."""
    return np.asarray(ct.frequency_response(system, np.atleast_1d(omega), squeeze=False).complex, dtype=complex)[0, 0]


def margins(gains: Gains, plant: ServoPlant, omega: Array | None = None) -> Margins:
    """Margins of the sampled loop, from `control.stability_margins` and `control.disk_margins`."""
    omega = frequency_grid(plant) if omega is None else omega
    loop = sampled_loop(gains, plant)
    closed = ct.feedback(loop, 1)
    stable = bool(np.all(np.abs(closed.poles()) < 1.0))
    value = frequency_response(loop, omega)
    data = ct.frd(value, omega, plant.tick, smooth=True)
    # all crossings: of several the nearest to instability counts
    gm, pm, _, w_pc, w_gc, _ = ct.stability_margins(data, returnall=True)
    s = 1.0 / (1.0 + value)
    t = value * s
    alpha, disk_gain, disk_phase = ct.disk_margins(loop, omega, returnall=True)
    worst = int(np.argmin(alpha))
    below = np.flatnonzero(np.abs(t) < math.sqrt(0.5))
    above = np.flatnonzero(np.abs(t[: below[0]]) >= math.sqrt(0.5)) if below.size else np.array([], dtype=int)
    tight_g = int(np.argmin(np.abs(20.0 * np.log10(gm)))) if len(gm) else -1
    tight_p = int(np.argmin(np.abs(pm))) if len(pm) else -1
    return Margins(
        stable=stable,
        crossover_hz=float(w_gc[tight_p] / (2.0 * math.pi)) if len(pm) else math.nan,
        gain_margin_db=float(20.0 * np.log10(gm[tight_g])) if len(gm) else math.inf,
        phase_margin_deg=float(pm[tight_p]) if len(pm) else math.inf,
        phase_crossover_hz=float(w_pc[tight_g] / (2.0 * math.pi)) if len(gm) else math.nan,
        disk_margin=float(alpha[worst]) if stable else 0.0,
        disk_gain_db=float(disk_gain[worst]) if stable else 0.0,
        disk_phase_deg=float(disk_phase[worst]) if stable else 0.0,
        disk_hz=float(omega[worst] / (2.0 * math.pi)),
        sensitivity_peak=float(np.abs(s).max()),
        complementary_peak=float(np.abs(t).max()),
        bandwidth_hz=float(omega[above[-1]] / (2.0 * math.pi)) if above.size else math.nan,
    )


def noise_current(gains: Gains, plant: ServoPlant) -> float:
    """Current (A rms) that the LVDT's white noise makes: the 2-norm of -C/(1 + P C) times the noise's rms."""
    transfer = ct.feedback(_sampled_pi(gains, plant), _sampled_plant(plant))
    omega = np.linspace(0.0, math.pi / plant.tick, 40001)[1:]
    power = np.abs(frequency_response(transfer, omega)) ** 2
    return plant.lvdt_noise * math.sqrt(float(np.trapezoid(power, omega)) * plant.tick / math.pi)


@dataclass(frozen=True)
class Corner:
    """One corner of the tolerances, and its margins."""

    flow: float  # factor
    bandwidth: float  # factor
    damping: float  # factor
    pressure_mpa: float
    delay_ticks: int
    margins: Margins

    def describe(self) -> str:
        """The corner in words."""
        return (
            f"flow {self.flow - 1:+.0%}, valve bandwidth {self.bandwidth - 1:+.0%}, damping {self.damping - 1:+.0%}, "
            f"{self.pressure_mpa:g} MPa, computation delay {self.delay_ticks} ms"
        )


def _corners(gains: Gains, plant: ServoPlant) -> list[Corner]:
    """Margins at every corner of the plant's tolerances."""
    omega = frequency_grid(plant, 500)
    return [corner(margins(gains, p, omega)) for corner, p in plant.corners()]


def analyse(gains: Gains, plant: ServoPlant) -> tuple[Margins, list[Corner]]:
    """Margins of the nominal loop and of every corner of the tolerances."""
    return margins(gains, plant), _corners(gains, plant)
