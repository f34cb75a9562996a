"""Design of the servo loop: margins, noise, steps and the limit cycles that play makes, each predicted and held against
the simulation.

The loop, broken at the stroke (positive current extends)::

    e = x_dem - x_lvdt,   i = kp e + ki T sum(e) + kff dx_dem/dt                     controller, T = 1 ms
    u'' + 2 zeta w u' + w^2 u = w^2 i / i_rated,   dx/dt = g sqrt(p_s/p_ref) u       valve, actuator
    x_lvdt' = (x - x_lvdt) / tau                                                     LVDT

    L(s) = (kp + ki/s) w^2 / (i_rated (s^2 + 2 zeta w s + w^2)) g sqrt(p_s/p_ref) / s  1 / (tau s + 1)  exp(-s T (1/2 +
                                                                                       d))

Timing: the LVDT is read at the tick and the current of that tick is written at once and held, so a tick costs half a
tick of delay; ``d`` is a computation delay in whole ticks on top of it. The design must stand for d = 0 and d = 1.

Units: SI in the code, the border's units (mm, mA, deg, Hz) in every figure of a `DesignResult`, as its names say.

Sources: Merritt, Hydraulic Control Systems (1967), ch. 6 and 7; Seiler, Packard, Gahinet, An Introduction to Disk
Margins, IEEE Control Systems Magazine 40 (2020); Gelb, Vander Velde, Multiple-Input Describing Functions (1968), ch. 3.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vaneloop.base.errors import InputError

if TYPE_CHECKING:
    import control

__all__ = [
    "Check",
    "Corner",
    "DesignResult",
    "Gains",
    "LimitCycle",
    "Limits",
    "Margins",
    "Play",
    "ServoPlant",
    "Trajectory",
    "analyse",
    "continuous_loop",
    "continuous_response",
    "default_gains",
    "design",
    "evaluate",
    "harmonic_balance",
    "limit_cycles",
    "margins",
    "noise_current",
    "play_describing_function",
    "ramp_demand",
    "sampled_loop",
    "simulate",
    "steady_cycle",
    "summary",
]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

QUANTISER_PEAK = 4.0 / math.pi  # greatest describing function of a rounding quantiser, at an amplitude of 0.71 steps


# ---------------------------------------------------------------- what is designed, and for what


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
    """Valve, actuator, LVDT and sampling as the loop sees them; SI. Defaults: `from_tables` reads the shipped ones."""

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

    @classmethod
    def from_tables(cls, plant: str | Path = "plant.toml") -> ServoPlant:
        """Read ``plant.toml``; the current limit comes from ``calibration.toml``."""
        from controller.calibration import CalibrationTable
        from plant.parameters import PlantTable
        from vaneloop.base.tables import read

        t = read(plant, PlantTable)
        limit = read("calibration.toml", CalibrationTable).servo.current_limit.value
        return cls(
            rated_current=t.valve.rated_current.value * 1e-3,
            bandwidth=t.valve.bandwidth.value,
            damping=t.valve.damping.value,
            flow_gain=t.actuator.flow_gain.value,
            pressure=t.supply.pressure.value * 1e6,
            stroke=t.actuator.stroke.value * 1e-3,
            lvdt_lag=t.sensors.lvdt_lag.value * 1e-3,
            lvdt_noise=t.sensors.lvdt_noise.value * 1e-3,
            lvdt_step=t.sensors.lvdt_range.value * 1e-3 / 2.0**t.sensors.lvdt_bits.value,
            current_limit=limit * 1e-3,
        )

    @property
    def speed_per_ampere(self) -> float:
        """Steady speed of the piston for a current, (m/s)/A, at the present supply pressure."""
        return self.flow_gain * math.sqrt(self.pressure / self.p_ref) / self.rated_current


def default_gains() -> Gains:
    """The gains in ``calibration.toml``."""
    from controller.calibration import CalibrationTable
    from vaneloop.base.tables import read

    servo = read("calibration.toml", CalibrationTable).servo
    return Gains(servo.kp.value, servo.ki.value, servo.kff.value)


@dataclass(frozen=True)
class Limits:
    """What the design must keep; why is in docs/control_design.md."""

    gain_margin_db: float = 8.0
    phase_margin_deg: float = 50.0
    disk_margin: float = 0.86  # 8 dB and 46.6 deg at the same time: alpha = 2 (r - 1)/(r + 1), r = 10^(8/20)
    noise_current_ma: float = 1.0  # rms; 2.5 % of rated: a valve's own threshold is about 0.5 to 1 %
    overshoot_percent: float = 20.0  # of a linear step of x_dem; the product's demand never steps
    ramp_peak_mm: float = 0.15  # at 20 mm/s; 0.15 deg of VIGV, a tenth of its hysteresis
    ramp_steady_mm: float = 0.005  # the LVDT's noise
    bias_settled_s: float = 0.5  # 1 mA of null bias, back within 0.005 mm
    hunting_mm: float = 0.05  # amplitude of the piston in a limit cycle by play or hysteresis inside the loop
    hunting_at_rest_codes: float = 3.0  # peak to peak at rest with a quantised, noise-free LVDT


# ---------------------------------------------------------------- linear loop


def _s_plant(plant: ServoPlant) -> control.TransferFunction:
    """From current (A) to measured stroke (m)."""
    import control as ct

    w = 2.0 * math.pi * plant.bandwidth
    valve = ct.tf([w * w], [1.0, 2.0 * plant.damping * w, w * w])
    actuator = ct.tf([plant.speed_per_ampere], [1.0, 0.0])
    lvdt = ct.tf([1.0], [plant.lvdt_lag, 1.0])
    return valve * actuator * lvdt


def continuous_loop(gains: Gains, plant: ServoPlant, order: int = 4) -> control.TransferFunction:
    """Loop transfer function L(s) with the delay of half a tick and of the computation as a Pade approximation of
    ``order``.
    """
    import control as ct

    pi = ct.tf([gains.kp, gains.ki], [1.0, 0.0]) if gains.ki else ct.tf([gains.kp], [1.0])
    delay = ct.tf(*ct.pade(plant.tick * (0.5 + plant.delay), order))
    return pi * _s_plant(plant) * delay


def continuous_response(gains: Gains, plant: ServoPlant, omega: ArrayLike) -> Complex:
    """L(j omega) in closed form, delay exact; omega in rad/s."""
    s = 1j * np.asarray(omega, dtype=float)
    w = 2.0 * math.pi * plant.bandwidth
    valve = w * w / (s * s + 2.0 * plant.damping * w * s + w * w)
    path = valve * plant.speed_per_ampere / s / (plant.lvdt_lag * s + 1.0)
    return np.asarray((gains.kp + gains.ki / s) * path * np.exp(-s * plant.tick * (0.5 + plant.delay)))


def _sampled_plant(plant: ServoPlant) -> control.StateSpace:
    """From current (A, held for a tick) to the LVDT's sample (m), computation delay included."""
    import control as ct

    p = ct.sample_system(ct.ss(_s_plant(plant)), plant.tick, method="zoh")
    if plant.delay:
        p = p * ct.ss(ct.tf([1.0], [1.0] + [0.0] * plant.delay, plant.tick))
    return p


def _sampled_pi(gains: Gains, plant: ServoPlant) -> control.StateSpace:
    """kp + ki T z/(z - 1): the firmware adds a tick's error to the integral before it uses it."""
    import control as ct

    if not gains.ki:
        return ct.ss([], [], [], [[gains.kp]], plant.tick)
    # state: the integral before this tick
    return ct.ss([[1.0]], [[gains.ki * plant.tick]], [[1.0]], [[gains.kp + gains.ki * plant.tick]], plant.tick)


def sampled_loop(gains: Gains, plant: ServoPlant) -> control.StateSpace:
    """Loop transfer function L(z) as the firmware closes it: exact zero-order hold, tick of ``plant.tick``."""
    return _sampled_plant(plant) * _sampled_pi(gains, plant)


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


def _grid(plant: ServoPlant, points: int = 2500) -> Array:
    """Frequencies (rad/s) from 0.05 Hz to just below half the sampling rate."""
    return np.geomspace(2.0 * math.pi * 0.05, 0.999 * math.pi / plant.tick, points)


def _response(system: control.StateSpace, omega: Array) -> Complex:
    """Frequency response of a loop with one input and one output."""
    import control as ct

    return np.asarray(ct.frequency_response(system, np.atleast_1d(omega), squeeze=False).complex, dtype=complex)[0, 0]


def margins(gains: Gains, plant: ServoPlant, omega: Array | None = None) -> Margins:
    """Margins of the sampled loop, from `control.stability_margins` and `control.disk_margins`."""
    import control as ct

    omega = _grid(plant) if omega is None else omega
    loop = sampled_loop(gains, plant)
    closed = ct.feedback(loop, 1)
    stable = bool(np.all(np.abs(closed.poles()) < 1.0))
    value = _response(loop, omega)
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
    import control as ct

    transfer = ct.feedback(_sampled_pi(gains, plant), _sampled_plant(plant))
    omega = np.linspace(0.0, math.pi / plant.tick, 40001)[1:]
    power = np.abs(_response(transfer, omega)) ** 2
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
    """Margins at every corner: flow 5 %, valve bandwidth and damping 15 %, 19 to 22 MPa, 0 or 1 tick of computation
    delay.
    """
    out = []
    omega = _grid(plant, 500)
    for flow, band, damp, mpa, delay in itertools.product(
        (0.95, 1.05), (0.85, 1.15), (0.85, 1.15), (19.0, 22.0), (0, 1)
    ):
        p = replace(
            plant,
            flow_gain=plant.flow_gain * flow,
            bandwidth=plant.bandwidth * band,
            damping=min(plant.damping * damp, 0.99),
            pressure=mpa * 1e6,
            delay=delay,
        )
        out.append(Corner(flow, band, damp, mpa, delay, margins(gains, p, omega)))
    return out


# ---------------------------------------------------------------- play: describing function


@dataclass(frozen=True)
class Play:
    """Lost motion somewhere in the servo.

    site   "lvdt": between the piston and the LVDT's rod, inside the loop (gap in m)
           "valve": hysteresis of the valve, inside the loop (gap in A, referred to the current)
           "vanes": in the linkage after the LVDT, outside the loop (gap in m of stroke)
    gap    total width
    """

    site: str
    gap: float

    def __post_init__(self) -> None:
        if self.site not in ("lvdt", "valve", "vanes"):
            raise InputError(f"site (={self.site!r}) must be lvdt, valve or vanes")
        if not 0.0 <= self.gap < math.inf:
            raise InputError(f"gap (={self.gap:g}) must be 0 or more")


@dataclass(frozen=True)
class LimitCycle:
    """A sustained oscillation at the input of the play.

    amplitude    of the fundamental, in the gap's unit
    omega        rad/s
    after        amplitude of the fundamental after the play
    """

    amplitude: float
    omega: float
    after: float


def play_describing_function(amplitude: ArrayLike, gap: float) -> Complex:
    """N(A) of a play of total width ``gap``: output fundamental over a sine of ``amplitude`` (scalar or array).

    From `control.friction_backlash_nonlinearity`, whose argument is the *total* gap. 0 for A <= gap/2.
    """
    import control as ct

    f = ct.friction_backlash_nonlinearity(gap)
    a = np.atleast_1d(np.asarray(amplitude, dtype=float))
    out = np.array([complex(f.describing_function(float(v))) for v in a])
    return out if np.ndim(amplitude) else out[0]


def limit_cycles(response: Any, gap: float, low: float, high: float) -> list[LimitCycle]:
    """Every (A, omega) with L(j omega) N(A) = -1 between ``low`` and ``high`` rad/s.

    response: function of omega (array, rad/s) that gives L. The inverse of N has a phase of its own for each amplitude,
    so for each omega the amplitude that makes the phase right is found first, then the omegas where the magnitude is
    right too. Only oscillations that hold themselves (a greater amplitude decays) are returned: at a crossing of the
    other kind the loop leaves it.
    """
    from scipy.optimize import brentq

    if gap <= 0.0:
        return []
    # phase and magnitude of N as functions of x = A / (gap/2) > 1; both rise from (-90 deg, 0) to (0, 1)
    x = 1.0 + np.geomspace(1e-6, 1e5, 4000)
    n = play_describing_function(x, 2.0)
    phase = np.angle(n)

    def mismatch(value: complex) -> float:
        wanted = math.remainder(math.pi - np.angle(value), 2.0 * math.pi)  # phase that N must have
        if not phase[0] < wanted < phase[-1]:
            return math.nan
        return math.log(abs(value) * float(np.interp(wanted, phase, np.abs(n))))

    def at(w: float) -> complex:
        return complex(np.asarray(response(np.array([w])))[0])

    grid = np.geomspace(low, high, 600)
    level = np.array([mismatch(v) for v in np.asarray(response(grid))])
    found = []
    for a, b, va, vb in zip(grid, grid[1:], level, level[1:], strict=False):
        if not (np.isfinite(va) and np.isfinite(vb) and va * vb < 0.0):
            continue
        w = float(brentq(lambda v: mismatch(at(v)), a, b, rtol=1e-10))
        wanted = math.remainder(math.pi - np.angle(at(w)), 2.0 * math.pi)
        ratio = float(np.interp(wanted, phase, x))
        amplitude = ratio * gap / 2.0
        after = amplitude * abs(complex(play_describing_function(amplitude, gap)))
        if _holds(response, w, ratio):
            found.append(LimitCycle(amplitude, w, after))
    return found


def harmonic_balance(
    response: Any, gap: float, start: LimitCycle, highest: float, count: int = 12
) -> LimitCycle | None:
    """The limit cycle near ``start`` with the odd harmonics 1, 3, 5, ... kept: X_k = -L(j k w) Y_k, Y the harmonics of
    play(x).

    The describing function is this with one harmonic. At most ``count`` harmonics, none above ``highest`` rad/s. None
    if the balance is not found. Source: Gelb, Vander Velde (1968), ch. 3.
    """
    from scipy.optimize import root

    k = 2 * np.arange(count) + 1
    k = k[k * start.omega * 1.5 < highest]
    n = 256
    wave = np.exp(1j * np.outer(k, 2.0 * math.pi * np.arange(n) / n))

    def spectrum(x: Array) -> Complex:
        half, y, out = 0.5, 0.0, np.empty(n)
        for turn in range(2):  # the first turn settles the play
            for j in range(n):
                y = min(max(y, x[j] - half), x[j] + half)
                if turn:
                    out[j] = y
        return np.asarray(2.0 * (np.conj(wave) @ out) / n)

    def unpack(v: Array) -> tuple[float, Complex]:
        harmonics = np.concatenate([[v[1] + 0j], v[2::2] + 1j * v[3::2]])
        return math.exp(v[0]) * start.omega, harmonics

    def balance(v: Array) -> Array:
        w, harmonics = unpack(v)
        rest = (harmonics + np.asarray(response(k * w)) * spectrum(np.real(harmonics @ wave))) / np.abs(response(k * w))
        return np.stack([rest.real, rest.imag], axis=1).ravel()

    first = np.zeros(2 * k.size)
    first[1] = start.amplitude / gap
    answer = root(balance, first, method="hybr", tol=1e-10)
    w, harmonics = unpack(answer.x)
    if np.abs(balance(answer.x)).max() > 1e-5 or not 0.5 < harmonics[0].real < 1e3 or k[-1] * w > highest:
        return None
    return LimitCycle(gap * float(harmonics[0].real), w, gap * float(abs(spectrum(np.real(harmonics @ wave))[0])))


def _holds(response: Any, w: float, ratio: float) -> bool:
    """Loeb's criterion. With H = 1/L + N = 0, a change dA of amplitude makes it grow at a rate dsigma/dA = Im(H_A
    conj(H_w)) / |H_w|^2.

    The oscillation holds itself where this is negative.
    """
    d = 1e-4
    lo, hi = np.asarray(response(np.array([w * (1 - d), w * (1 + d)])))
    dw = (1.0 / hi - 1.0 / lo) / (2.0 * d * w)
    na, nb = play_describing_function(np.array([ratio - d * (ratio - 1.0), ratio + d * (ratio - 1.0)]), 2.0)
    da = (nb - na) / (2.0 * d * (ratio - 1.0))
    return bool((da * np.conj(dw)).imag < 0.0)


# ---------------------------------------------------------------- time simulation


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
    from controller import new_state
    from controller.records import SCALAR_FIELDS, record
    from controller.servo import servo_step
    from plant.actuator import speed_factor, stroke_step
    from plant.play import play_step
    from plant.sensors import lag_factor, quantise
    from plant.valve import valve_matrix, valve_step

    ref = np.asarray(x_ref, dtype=float)
    rate = np.zeros_like(ref) if dx_ref is None else np.asarray(dx_ref, dtype=float)
    z, k = new_state(), record(SCALAR_FIELDS)
    k.kp, k.ki, k.kff, k.current_limit = gains.kp, gains.ki, gains.kff, plant.current_limit
    z.integral = integral
    dt = plant.tick / substeps
    matrix = valve_matrix(plant.bandwidth, plant.damping, dt)
    lag = lag_factor(plant.lvdt_lag, dt)
    speed = plant.flow_gain * speed_factor(plant.pressure, 0.0, plant.p_ref)
    site, gap = (play.site, play.gap) if play else ("", 0.0)
    noise = np.zeros(ref.size)
    if noise_seed is not None:
        noise = plant.lvdt_noise * np.random.default_rng(noise_seed).standard_normal(ref.size)
    x = float(ref[0] if start is None else start)
    rod = x - 0.5 * gap if site == "lvdt" else x
    x_lvdt, vane, spool_i, u, du = rod, x - 0.5 * outside, 0.0, 0.0, 0.0
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
            before = u
            u, du = valve_step(u, du, drive / plant.rated_current, *matrix)
            x = stroke_step(x, speed * before, speed * u, plant.stroke, dt)
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


# ---------------------------------------------------------------- the whole design


@dataclass(frozen=True)
class Check:
    """One stated margin and whether it holds."""

    name: str
    value: float
    limit: float
    unit: str
    ok: bool
    at: str = ""


@dataclass(frozen=True)
class PlayFigures:
    """Limit cycle by play: predicted by the describing function, and simulated. Lengths and currents in ``unit``."""

    site: str
    gap: float
    unit: str
    inside: bool
    predicted_amplitude: float | None
    predicted_hz: float | None
    harmonic_amplitude: float | None  # the same prediction with the odd harmonics kept
    harmonic_hz: float | None
    simulated_amplitude: float | None
    simulated_hz: float | None
    simulated_lvdt_mm: float  # half of peak to peak of what the LVDT sees in the second half of the run
    without_integral: float | None  # predicted amplitude with ki = 0
    grazing: (
        bool  # the piston hardly leaves the gap: the signal after the play is far from a sine, expect 30 % in frequency
    )


@dataclass(frozen=True)
class DesignResult:
    """All figures of a design, in border units; `to_dict` is JSON."""

    gains: Gains
    plant: ServoPlant
    limits: Limits
    nominal: Margins
    worst: dict[str, float]
    worst_at: dict[str, str]
    corners: list[Corner]
    noise_current_ma: float
    step: dict[str, float]
    ramp: dict[str, float]
    bias: dict[str, float]
    rest: dict[str, float]
    play: list[PlayFigures]
    checks: list[Check]
    ok: bool
    curves: dict[str, Any] = field(repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values: no NaN, no infinity (both become null), no curves."""
        d = {k: v for k, v in asdict(replace(self, curves={})).items() if k != "curves"}
        return {"schema": 1, **_plain(d)}


def _plain(v: Any) -> Any:
    """Replace what JSON cannot hold."""
    if isinstance(v, dict):
        return {k: _plain(w) for k, w in v.items()}
    if isinstance(v, list | tuple):
        return [_plain(w) for w in v]
    if isinstance(v, np.bool_):
        return bool(v)
    if isinstance(v, float | np.floating):
        return float(v) if math.isfinite(v) else None
    return v


BACKLASH_INSIDE = 0.02e-3  # m: a rod end in good order, between piston and LVDT
MIDDLE = 24e-3  # m: simulations run about mid-stroke, away from the stops


def _step_figures(gains: Gains, plant: ServoPlant, curves: dict[str, Any]) -> dict[str, float]:
    """Linear step (no feed-forward, no limit), and 10 mm as a bare step and as the firmware would draw it (100
    mm/s).
    """
    import control as ct

    closed = ct.feedback(sampled_loop(gains, plant), 1)
    t = np.arange(0.0, 1.0, plant.tick)
    y = np.asarray(ct.step_response(closed, t).outputs).ravel()
    final = float(np.real(closed.dcgain()))
    inside = np.abs(y - final) <= 0.05 * abs(final)
    last_outside = int(np.flatnonzero(~inside)[-1]) if not inside.all() else 0
    curves["step_t"], curves["step_linear"] = t, y
    bare = simulate(gains, plant, np.full(1000, MIDDLE + 5e-3), start=MIDDLE - 5e-3)
    points = np.clip(MIDDLE - 5e-3 + 0.1 * np.arange(100) * 10e-3, None, MIDDLE + 5e-3)
    drawn = simulate(gains, plant, *ramp_demand(points, plant), start=MIDDLE - 5e-3)
    curves["step_bare"], curves["step_drawn"] = bare, drawn
    return {
        "rise_10_90_ms": float(1e3 * plant.tick * (np.argmax(y >= 0.9 * final) - np.argmax(y >= 0.1 * final))),
        "settle_5_percent_ms": 1e3 * plant.tick * (last_outside + 1),
        "overshoot_percent": 100.0 * max(0.0, float(y.max()) / final - 1.0),
        "bare_10mm_overshoot_mm": 1e3 * max(0.0, float(bare.x.max()) - (MIDDLE + 5e-3)),
        "bare_10mm_saturated_ms": 1e3 * plant.tick * float(np.sum(np.abs(bare.i) >= plant.current_limit)),
        "drawn_10mm_overshoot_mm": 1e3 * max(0.0, float(drawn.x.max()) - (MIDDLE + 5e-3)),
        "drawn_10mm_error_mm": 1e3 * float(np.abs(drawn.x_dem - drawn.x_lvdt).max()),
    }


def _ramp_figures(gains: Gains, plant: ServoPlant, curves: dict[str, Any]) -> dict[str, float]:
    """A ramp of 20 mm/s for 0.6 s, then hold: greatest error, error at the end of the ramp."""
    points = MIDDLE - 6e-3 + 0.02 * np.clip(np.arange(120) * 10e-3 - 0.1, 0.0, 0.6)
    run = simulate(gains, plant, *ramp_demand(points, plant))
    error = 1e3 * (run.x_dem - run.x_lvdt)
    curves["ramp"] = run
    moving = (run.t >= 0.65) & (run.t < 0.70)
    return {
        "speed_mm_s": 20.0,
        "peak_error_mm": float(np.abs(error).max()),
        "steady_error_mm": float(np.abs(error[moving]).max()),
        "overshoot_mm": 1e3 * max(0.0, float(run.x.max() - run.x_dem.max())),
    }


def _bias_figures(gains: Gains, plant: ServoPlant) -> dict[str, float]:
    """A null bias of 1 mA appears: greatest stroke error, and time until it stays within 0.005 mm."""
    run = simulate(gains, plant, np.full(3000, MIDDLE), null_bias=1e-3)
    error = 1e3 * np.abs(run.x - MIDDLE)
    outside = np.flatnonzero(error > 0.005)
    return {
        "current_ma": 1.0,
        "peak_mm": float(error.max()),
        "settled_s": plant.tick * float(outside[-1] + 1 if outside.size else 0),
    }


def _rest_figures(gains: Gains, plant: ServoPlant) -> dict[str, float]:
    """At rest: quantised LVDT without noise (hunting by the converter's steps), then with noise (current, piston)."""
    middle = MIDDLE + 0.37 * plant.lvdt_step  # between two codes: the error can never be 0
    quiet = simulate(gains, plant, np.full(10_000, middle), quantised=True, null_bias=1e-3, integral=-1e-3)
    noisy = simulate(gains, plant, np.full(5000, middle), quantised=True, noise_seed=1)
    return {
        "quantised_codes": float(np.ptp(quiet.x[5000:])) / plant.lvdt_step if plant.lvdt_step else 0.0,
        "quantised_current_ma": 1e3 * float(np.ptp(quiet.i[5000:])),
        "noisy_current_ma_rms": 1e3 * float(np.std(noisy.i[500:])),
        "noisy_stroke_mm_rms": 1e3 * float(np.std(noisy.x[500:])),
    }


@dataclass(frozen=True)
class _Predicted:
    """Limit cycles of a play of width 1: by the describing function, with harmonics, and without the integral. All
    scale with the gap.
    """

    plain: LimitCycle | None
    harmonic: LimitCycle | None
    proportional: LimitCycle | None


def _predict(gains: Gains, plant: ServoPlant) -> _Predicted:
    """Limit cycles of the loop with a play of width 1 in it, wherever it sits: broken there, the loop is the same."""
    low, high = 0.05, 0.9 * math.pi / plant.tick

    def greatest(g: Gains) -> tuple[Any, LimitCycle | None]:
        loop = sampled_loop(g, plant)

        def response(w: ArrayLike) -> Complex:
            return _response(loop, np.asarray(w, dtype=float))

        return response, max(limit_cycles(response, 1.0, low, high), key=lambda c: c.amplitude, default=None)

    response, top = greatest(gains)
    return _Predicted(
        top, harmonic_balance(response, 1.0, top, high) if top else None, greatest(replace(gains, ki=0.0))[1]
    )


def _play_figures(
    gains: Gains, plant: ServoPlant, play: Play, predicted: _Predicted, curves: dict[str, Any], seconds: float = 16.0
) -> PlayFigures:
    """Predict and simulate the limit cycle of ``play``."""
    inside = play.site != "vanes"
    scale, unit = 1e3, "mA" if play.site == "valve" else "mm"
    gap = scale * play.gap
    top, better, bare = (
        (predicted.plain, predicted.harmonic, predicted.proportional) if inside and gap > 0.0 else (None, None, None)
    )
    n = round(seconds / plant.tick)
    if inside:
        # start on the predicted oscillation: a servo that comes to rest inside its play stays there
        size = play.gap * (top.amplitude if top else 1.0)
        away, wind = (size, 0.0) if play.site == "lvdt" else (0.0, size)
        run = simulate(gains, plant, np.full(n, MIDDLE), play=play, start=MIDDLE + away, integral=wind)
        seen = steady_cycle(run.t, run.play_in, 0.02 * play.gap) if play.gap > 0.0 else None
        ripple = 0.5e3 * float(np.ptp(run.x_lvdt[n // 2 :]))
    else:
        # a reversal, then rest
        points = MIDDLE + np.interp(np.arange(n // 10) * 10e-3, [0.1, 0.3, 0.5], [0.0, 4e-3, 2e-3])
        run = simulate(gains, plant, *ramp_demand(points, plant), outside=play.gap)
        seen = steady_cycle(run.t, run.x_vane, 1e-9)
        ripple = 0.5e3 * float(np.ptp(run.x_vane[n // 2 :]))
    curves.setdefault("play", {})[play.site] = run
    return PlayFigures(
        site=play.site,
        gap=gap,
        unit=unit,
        inside=inside,
        predicted_amplitude=gap * top.amplitude if top else None,
        predicted_hz=top.omega / (2.0 * math.pi) if top else None,
        harmonic_amplitude=gap * better.amplitude if better else None,
        harmonic_hz=better.omega / (2.0 * math.pi) if better else None,
        simulated_amplitude=scale * seen.amplitude if seen else None,
        simulated_hz=seen.omega / (2.0 * math.pi) if seen else None,
        simulated_lvdt_mm=ripple,
        without_integral=gap * bare.amplitude if bare else None,
        grazing=bool(top and top.amplitude < 0.75),
    )


def analyse(gains: Gains, plant: ServoPlant) -> tuple[Margins, list[Corner]]:
    """Margins of the nominal loop and of every corner of the tolerances."""
    return margins(gains, plant), _corners(gains, plant)


def design(
    gains: Gains | None = None,
    plant: ServoPlant | None = None,
    limits: Limits | None = None,
    *,
    backlash_inside: float = BACKLASH_INSIDE,
    valve_hysteresis: float = 1.2e-3,
    backlash_outside: float = 1.5e-3,
) -> DesignResult:
    """Analyse the servo loop with ``gains`` (default: ``calibration.toml``) and say whether the stated limits hold.

    backlash_inside   m, total play between piston and LVDT rod
    valve_hysteresis  A, total width of the valve's hysteresis (3 % of rated current)
    backlash_outside  m of stroke, total play between piston and vanes (1.6 deg of VIGV)
    """
    gains = gains or default_gains()
    plant = plant or ServoPlant.from_tables()
    limits = limits or Limits()
    curves: dict[str, Any] = {}
    nominal, corners = analyse(gains, plant)
    everywhere = [("nominal", nominal), *((c.describe(), c.margins) for c in corners)]
    worst, worst_at = {}, {}
    for name in ("gain_margin_db", "phase_margin_deg", "disk_margin"):
        at, m = min(everywhere, key=lambda p, name=name: getattr(p[1], name))  # type: ignore[misc]
        worst[name], worst_at[name] = getattr(m, name), at
    at, m = max(everywhere, key=lambda p: p[1].sensitivity_peak)
    worst["sensitivity_peak"], worst_at["sensitivity_peak"] = m.sensitivity_peak, at
    stable = all(m.stable for _, m in everywhere)

    omega = _grid(plant, 1200)
    curves["omega"], curves["sampled"] = omega, _response(sampled_loop(gains, plant), omega)
    curves["continuous"] = continuous_response(gains, plant, omega)
    if not stable:  # nothing else means anything
        checks = [Check("stable at every corner", 0.0, 1.0, "-", False, next(a for a, m in everywhere if not m.stable))]
        return DesignResult(
            gains, plant, limits, nominal, worst, worst_at, corners, math.nan, {}, {}, {}, {}, [], checks, False, curves
        )

    noise = 1e3 * noise_current(gains, plant)
    step = _step_figures(gains, plant, curves)
    ramp = _ramp_figures(gains, plant, curves)
    bias = _bias_figures(gains, plant)
    rest = _rest_figures(gains, plant)
    predicted = _predict(gains, plant)
    play = [
        _play_figures(gains, plant, p, predicted, curves)
        for p in (Play("lvdt", backlash_inside), Play("valve", valve_hysteresis), Play("vanes", backlash_outside))
    ]
    hunting = max(play[0].predicted_amplitude or 0.0, play[0].simulated_amplitude or 0.0)
    checks = [
        *(
            Check(name, worst[key], limit, unit, worst[key] >= limit, worst_at[key])
            for name, key, limit, unit in (
                ("gain margin, worst corner", "gain_margin_db", limits.gain_margin_db, "dB"),
                ("phase margin, worst corner", "phase_margin_deg", limits.phase_margin_deg, "deg"),
                ("disk margin, worst corner", "disk_margin", limits.disk_margin, "-"),
            )
        ),
        *(
            Check(name, value, limit, unit, bool(value <= limit))
            for name, value, limit, unit in (
                ("current from LVDT noise, rms", noise, limits.noise_current_ma, "mA"),
                ("overshoot of a linear step", step["overshoot_percent"], limits.overshoot_percent, "%"),
                ("greatest error on a 20 mm/s ramp", ramp["peak_error_mm"], limits.ramp_peak_mm, "mm"),
                ("steady error on a 20 mm/s ramp", ramp["steady_error_mm"], limits.ramp_steady_mm, "mm"),
                ("1 mA of null bias settled", bias["settled_s"], limits.bias_settled_s, "s"),
                ("hunting by the converter's steps", rest["quantised_codes"], limits.hunting_at_rest_codes, "codes"),
                ("hunting by play at the LVDT", hunting, limits.hunting_mm, "mm"),
                ("hunting by the valve's hysteresis", play[1].simulated_lvdt_mm, limits.hunting_mm, "mm"),
            )
        ),
        Check(
            "hunting by play outside the loop", play[2].simulated_lvdt_mm, 1e-4, "mm", play[2].simulated_lvdt_mm <= 1e-4
        ),
    ]
    ok = all(c.ok for c in checks)
    return DesignResult(
        gains, plant, limits, nominal, worst, worst_at, corners, noise, step, ramp, bias, rest, play, checks, ok, curves
    )


def evaluate(
    *, kp: float | None = None, ki: float | None = None, kff: float | None = None, backlash_inside: float | None = None
) -> tuple[DesignResult, int]:
    """``vaneloop design``: the calibrated gains with overrides (kp A/m, ki A/(m s), kff A/(m/s)), play inside the loop
    in mm.

    Returns the result and the exit code: 0 all stated limits hold, 1 not. Raises InputError for a value outside its
    range.
    """
    base = default_gains()
    gains = Gains(base.kp if kp is None else kp, base.ki if ki is None else ki, base.kff if kff is None else kff)
    if backlash_inside is not None and not 0.0 <= backlash_inside <= 10.0:
        raise InputError(f"backlash_inside (={backlash_inside:g} mm) must be in [0, 10]")
    result = design(gains, backlash_inside=BACKLASH_INSIDE if backlash_inside is None else backlash_inside * 1e-3)
    return result, 0 if result.ok else 1


def summary(result: DesignResult) -> list[str]:
    """What the command prints."""
    g, m = result.gains, result.nominal
    lines = [
        f"gains: kp {g.kp:g} mA/mm, ki {g.ki:g} mA/(mm s), kff {g.kff:g} mA/(mm/s)",
        f"nominal: crossover {m.crossover_hz:.1f} Hz, gain margin {m.gain_margin_db:.1f} dB, phase margin "
        f"{m.phase_margin_deg:.1f} deg, disk margin {m.disk_margin:.2f}, bandwidth {m.bandwidth_hz:.1f} Hz",
    ]
    for c in result.checks:
        at = f", at {c.at}" if c.at else ""
        lines.append(f"{'ok  ' if c.ok else 'MISS'} {c.name}: {c.value:.3g} {c.unit} (limit {c.limit:g}{at})")
    lines += [_say_play(p) for p in result.play]
    return lines


def _say_play(p: PlayFigures) -> str:
    """One line about one play."""
    where = {
        "lvdt": "between piston and LVDT",
        "valve": "in the valve",
        "vanes": "between piston and vanes (outside the loop)",
    }[p.site]

    def cycle(a: float | None, hz: float | None) -> str:
        return "none" if a is None or hz is None else f"{a:.3g} {p.unit} at {hz:.2f} Hz"

    return (
        f"play of {p.gap:g} {p.unit} {where}: limit cycle predicted {cycle(p.predicted_amplitude, p.predicted_hz)}, "
        f"with harmonics {cycle(p.harmonic_amplitude, p.harmonic_hz)}, simulated "
        f"{cycle(p.simulated_amplitude, p.simulated_hz)}"
    )


# ---------------------------------------------------------------- report


# ---------------------------------------------------------------- command line
