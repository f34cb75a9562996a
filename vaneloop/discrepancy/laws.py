"""Reusable laws: what a measured system may do that its model does not, one small function each.

A law acts at a *place* of a model (`vaneloop.discrepancy.models.system.System`):

- on a **signal**, an input or an output: y = law(u), `SIGNAL_LAWS`;
- as a **force** added where things move (or to the derivative of a velocity), from velocity v and displacement x:
  `FORCE_LAWS`;
- on the derivative of a **state** x of first order (a level, a pressure, a temperature): `STATE_LAWS`.

Every law has neutral parameters at which it is an exact identity (or adds exactly nothing). Bounds and starting values
follow from the `Size` of the data at the place, never from constants of one machine; the laws themselves are
dimensionally right for any unit.

Laws with memory keep it in a state row of `MEMORY` numbers. All steps are numba functions at module level, called
sample by sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vaneloop.base.compiled import compiled_free
from vaneloop.discrepancy.stage import Array, Parameter

__all__ = [
    "FORCE_LAWS",
    "HYSTERETIC",
    "LAWS",
    "MEMORY",
    "PARAMETERS",
    "SIGNAL_LAWS",
    "STATE_LAWS",
    "Law",
    "Size",
    "apply",
    "force_of",
    "load",
    "state_rate",
    "transform",
]

MEMORY = 4  # numbers that a law may remember
PARAMETERS = 3  # most parameters of one law


@dataclass(frozen=True)
class Size:
    """How large the data are at a place; everything that bounds a law comes from here.

    low, high   smallest and largest value (0.1 and 99.9 % quantiles)
    rate        RMS of the derivative, per s
    fastest     99.9 % quantile of the derivative's magnitude
    step, span  s: median time between samples, length of the longest log
    noise       RMS of the noise in the values
    unit        of the values
    force       RMS of the force (or derivative) that the law adds to
    force_unit  of that
    speed, speed_unit, travel, travel_unit   RMS velocity and half range of the displacement of a force law
    """

    low: float
    high: float
    rate: float
    fastest: float
    step: float
    span: float
    noise: float = 0.0
    unit: str = "-"
    force: float = 1.0
    force_unit: str = "-"
    speed: float = 1.0
    speed_unit: str = "-"
    travel: float = 1.0
    travel_unit: str = "-"

    @property
    def half(self) -> float:
        """Half the range."""
        return max(0.5 * (self.high - self.low), 1e-300)

    @property
    def greatest(self) -> float:
        """Largest magnitude."""
        return max(abs(self.low), abs(self.high), 1e-300)


@dataclass(frozen=True)
class Law:
    """A law: what it is, its number in the compiled dispatch, and how its parameters follow from the size of the data.

    make   Size -> parameters (neutral values and bounds) and starts, the parameter vectors from which a fit is tried
    looks  how it shows in a log
    memory True where the answer depends on what was before
    constant  a number of the law that is not free, from the size of the data; it follows the parameters
    """

    name: str
    code: int
    text: str
    make: Callable[[Size], tuple[tuple[Parameter, ...], tuple[tuple[float, ...], ...]]]
    looks: str = ""
    memory: bool = False
    constant: Callable[[Size], float] | None = None


# ---- laws on a signal ------------------------------------------------------------------------------------------------

BIAS, GAIN, ASYMMETRIC_GAIN, ABSOLUTE, SQUARE_ROOT, CUBIC, DEAD_ZONE, SATURATION, SMOOTH_SATURATION, QUANTISATION = (
    range(1, 11)
)
PLAY, RATE_LIMIT, LAG, SECOND_ORDER_LAG, DEAD_TIME = range(11, 16)


@compiled_free
def transform(code: int, k: int, t: Array, u: Array, p: Array, s: Array) -> float:
    """Law ``code`` on sample ``k`` of the signal ``u`` at times ``t`` (s), with parameters ``p`` and memory ``s``
    (changed in place).

    Samples after ``k`` are not looked at, so that the same function serves inside a loop. At k = 0 the memory is set
    up: laws start at rest at the first value.
    """
    x = u[k]
    dt = t[k] - t[k - 1] if k > 0 else 0.0
    if code == BIAS:
        return x + p[0]
    if code == GAIN:
        return x * p[0]
    if code == ASYMMETRIC_GAIN:
        return x * (1.0 + p[0]) if x > 0.0 else x * (1.0 - p[0])
    if code == ABSOLUTE:
        return x + p[0] * (abs(x) - x)
    if code == SQUARE_ROOT:  # p[1]: magnitude that stays as it is
        root = math.sqrt(abs(x) * p[1])
        return x + p[0] * ((root if x > 0.0 else -root) - x)
    if code == CUBIC:
        return x + p[0] * x * x * x
    if code == DEAD_ZONE:
        if x > p[0]:
            return x - p[0]
        return x + p[0] if x < -p[0] else 0.0
    if code == SATURATION:
        return min(max(x, p[0]), p[1])
    if code == SMOOTH_SATURATION:
        z = p[0] * x
        return math.tanh(z) / p[0] if abs(z) > 1e-9 else x
    if code == QUANTISATION:
        return math.floor(x / p[0] + 0.5) * p[0] if p[0] > 0.0 else x
    if code == PLAY:
        h = 0.5 * p[0]
        s[0] = x if k == 0 else min(max(s[0], x - h), x + h)
        return s[0]
    if code == RATE_LIMIT:
        s[0] = x if k == 0 else s[0] + min(max(x - s[0], -p[0] * dt), p[0] * dt)
        return s[0]
    if code == LAG:  # exact for an input that runs straight between samples
        if k == 0:
            s[0] = x
            return x
        if p[0] <= 0.0:
            s[0] = x
            return x
        a = dt / p[0]
        e = math.exp(-a)
        ramp = (1.0 - e) / a if a > 1e-6 else 1.0 - 0.5 * a
        s[0] = e * s[0] + (ramp - e) * u[k - 1] + (1.0 - ramp) * x
        return s[0]
    if (
        code == SECOND_ORDER_LAG
    ):  # p[0] = 1/natural frequency, p[1] = damping; trapezoidal, input straight between samples
        if k == 0 or p[0] <= 0.0:
            s[0], s[1] = x, 0.0
            return x
        w, z = 1.0 / p[0], p[1]
        n = int(min(max(math.ceil(4.0 * dt * w), 1.0), 50.0))
        h = dt / n
        for i in range(n):
            f0 = u[k - 1] + (x - u[k - 1]) * i / n
            f1 = u[k - 1] + (x - u[k - 1]) * (i + 1) / n
            # (I - h/2 A) y1 = (I + h/2 A) y0 + h/2 (b f0 + b f1), A = [[0, 1], [-w^2, -2 z w]]
            g = 0.5 * h
            r0 = s[0] + g * s[1]
            r1 = s[1] + g * (-w * w * s[0] - 2.0 * z * w * s[1]) + g * w * w * (f0 + f1)
            d = 1.0 + 2.0 * g * z * w + g * g * w * w
            s[0], s[1] = ((1.0 + 2.0 * g * z * w) * r0 + g * r1) / d, (r1 - g * w * w * r0) / d
        return s[0]
    if code == DEAD_TIME:
        when = t[k] - p[0]
        if p[0] <= 0.0:
            return x
        j = int(s[0])
        if k == 0:
            j = 0
        while j + 1 <= k and t[j + 1] <= when:
            j += 1
        s[0] = j
        if when <= t[0] or j >= k:
            return u[0] if when <= t[0] else x
        f = (when - t[j]) / (t[j + 1] - t[j])
        return u[j] + f * (u[j + 1] - u[j])
    return x


@compiled_free
def apply(code: int, t: Array, u: Array, p: Array) -> Array:
    """Law ``code`` on a whole signal: float64[samples] from float64[samples]."""
    s = np.zeros(MEMORY)
    out = np.empty(len(u))
    for k in range(len(u)):
        out[k] = transform(code, k, t, u, p, s)
    return out


# ---- laws of forces --------------------------------------------------------------------------------------------------

FORCE_OFFSET, VISCOUS, COULOMB, STRIBECK, QUADRATIC_DRAG, SPRING, CUBIC_SPRING, ELASTIC_PLASTIC, BOUC_WEN = range(
    21, 30
)
BACKLASH_GAP, FRICTION_ASYMMETRY = 30, 31


@compiled_free
def _slip(v: float, small: float) -> float:
    """Direction of motion; a straight line within ``small``, so that a simulation can come to rest."""
    return min(max(v / small, -1.0), 1.0) if small > 0.0 else (1.0 if v > 0.0 else -1.0 if v < 0.0 else 0.0)


@compiled_free
def force_of(
    code: int, v: float, x: float, first: bool, p: Array, gap: float, asymmetry: float, small: float, s: Array
) -> float:
    """Force of law ``code`` at velocity ``v`` and displacement ``x``, positive where it opposes positive motion.

    gap        lost motion between the displacement and every elastic element
    asymmetry  friction is (1 + asymmetry) as large in the positive direction, (1 - asymmetry) in the negative one
    small      speed within which friction is regularised; 0: not at all
    s          memory; ``first``: set it up, elements start unloaded
    """
    if code == FORCE_OFFSET:
        return p[0]
    if code == VISCOUS:
        return p[0] * v
    if code == COULOMB:
        return p[0] * _slip(v, small) * (1.0 + asymmetry if v > 0.0 else 1.0 - asymmetry)
    if code == STRIBECK:  # Coulomb level, what breaking away takes beyond it, speed over which that fades
        level = p[0] + p[1] * math.exp(-((v / p[2]) ** 2)) if p[2] > 0.0 else p[0]
        return level * _slip(v, small) * (1.0 + asymmetry if v > 0.0 else 1.0 - asymmetry)
    if code == QUADRATIC_DRAG:
        return p[0] * v * abs(v)
    h = 0.5 * gap
    if code == SPRING or code == CUBIC_SPRING:
        d = x - h if x > h else (x + h if x < -h else 0.0)
        return p[0] * d if code == SPRING else p[0] * d * d * d
    if code == ELASTIC_PLASTIC:  # spring p[0] in series with a slider of level p[1]; s[0]: where the slider stands
        if first:
            s[0] = x
        if p[0] <= 0.0 or p[1] <= 0.0:
            return 0.0
        d = x - s[0]
        e = d - h if d > h else (d + h if d < -h else 0.0)
        f = p[0] * e
        up, down = p[1] * (1.0 + asymmetry), p[1] * (1.0 - asymmetry)
        if f > up:
            f = up
            s[0] = x - h - up / p[0]
        elif f < -down:
            f = -down
            s[0] = x + h + down / p[0]
        return f
    if (
        code == BOUC_WEN
    ):  # p[0] stiffness, p[1] level, p[2] sharpness n; s[0] force, s[1] last x, s[2] place within the gap
        if first:
            s[0], s[1], s[2] = 0.0, x, 0.0
        if p[0] <= 0.0 or p[1] <= 0.0:
            return 0.0
        dx = x - s[1]
        s[1] = x
        f, g = s[0], s[2]
        for _ in range(3):  # out of the load, across the gap, into the next load
            if dx == 0.0:
                break
            if f == 0.0 or (abs(f) < 1e-12 * p[1]):
                f = 0.0
                m = min(dx, h - g) if dx > 0.0 else max(dx, -h - g)
                g += m
                dx -= m
                if dx == 0.0:
                    break
                f = 2e-12 * p[1] * (1.0 if dx > 0.0 else -1.0)
            level = p[1] * (1.0 + asymmetry if f > 0.0 else 1.0 - asymmetry)
            if (f > 0.0) == (dx > 0.0):
                left = 1.0 - (abs(f) / level) ** p[2]
                f += p[0] * dx * max(left, 0.0)
                f = min(max(f, -level), level)
                dx = 0.0
            else:
                new = f + p[0] * dx
                if new * f <= 0.0:
                    dx += f / p[0]
                    g = h if f > 0.0 else -h
                    f = 0.0
                else:
                    f = new
                    dx = 0.0
        s[0], s[2] = f, g
        return f
    return 0.0


@compiled_free
def load(code: int, x: float, p: Array, gap: float, asymmetry: float, held: float, s: Array) -> float:
    """Set up the memory of a hysteretic law so that at displacement ``x`` it carries the force ``held``, or its
    friction; return that.
    """
    f = min(max(held, -p[1] * (1.0 - asymmetry)), p[1] * (1.0 + asymmetry))
    side = 0.5 * gap if f > 0.0 else -0.5 * gap
    if code == ELASTIC_PLASTIC:
        s[0] = x - side - f / p[0]
    else:
        s[0], s[1], s[2] = f, x, side
    return f


# ---- laws of a state of first order ----------------------------------------------------------------------------------

STATE_OFFSET, LEAK, STATE_QUADRATIC, STATE_SQUARE_ROOT, STATE_CUBIC, STATE_LIMIT, STATE_RATE_LIMIT = range(41, 48)


@compiled_free
def state_rate(code: int, x: float, p: Array) -> float:
    """What law ``code`` takes off the derivative of the state ``x``. The two limits take nothing off; the simulation
    applies them.
    """
    if code == STATE_OFFSET:
        return p[0]
    if code == LEAK:
        return p[0] * x
    if code == STATE_QUADRATIC:
        return p[0] * x * abs(x)
    if code == STATE_SQUARE_ROOT:
        return p[0] * math.sqrt(x) if x > 0.0 else -p[0] * math.sqrt(-x)
    if code == STATE_CUBIC:
        return p[0] * x * x * x
    return 0.0


# ---- parameters from the size of the data ----------------------------------------------------------------------------

_Made = tuple[tuple[Parameter, ...], tuple[tuple[float, ...], ...]]
_TINY = (0.01, 0.05, 0.2, 0.6)  # of a place's size: from hardly seen to gross


def _one(name: str, unit: str, neutral: float, low: float, high: float, starts: list[float]) -> _Made:
    return (Parameter(name, neutral, unit, low, high),), tuple((float(v),) for v in starts)


def _both(size: float, parts: tuple[float, ...] = _TINY) -> list[float]:
    return [sign * part * size for part in parts for sign in (1.0, -1.0)]


def _bias(z: Size) -> _Made:
    return _one("offset", z.unit, 0.0, -2.0 * z.greatest, 2.0 * z.greatest, _both(z.greatest))


def _gain(z: Size) -> _Made:
    return _one("factor", "-", 1.0, 0.05, 20.0, [0.5, 0.8, 0.95, 1.05, 1.25, 2.0])


def _asymmetric_gain(z: Size) -> _Made:
    return _one("difference", "-", 0.0, -0.95, 0.95, _both(1.0, (0.02, 0.1, 0.4)))


def _absolute(z: Size) -> _Made:
    return _one("share", "-", 0.0, 0.0, 1.0, [0.1, 0.5, 1.0])


def _square_root(z: Size) -> _Made:
    return _one("share", "-", 0.0, 0.0, 1.0, [0.2, 0.6, 1.0])


def _greatest(z: Size) -> float:
    return z.greatest


def _cubic(z: Size) -> _Made:
    unit = 1.0 / z.greatest**2
    return _one("coefficient", f"1/({z.unit})^2", 0.0, -5.0 * unit, 20.0 * unit, _both(unit, (0.02, 0.1, 0.3)))


def _dead_zone(z: Size) -> _Made:
    return _one(
        "half_width", z.unit, 0.0, 0.0, z.greatest, [part * z.greatest for part in (0.01, 0.03, 0.1, 0.25, 0.5)]
    )


def _saturation(z: Size) -> _Made:
    r = z.high - z.low
    low, high = z.low - r, z.high + r
    starts = [(low, z.high - part * r) for part in (0.002, 0.03, 0.1, 0.25, 0.5)]
    starts += [(z.low + part * r, high) for part in (0.002, 0.03, 0.1, 0.25, 0.5)]
    starts += [(z.low + part * r, z.high - part * r) for part in (0.03, 0.1, 0.25, 0.4)]
    return (Parameter("low", low, z.unit, low, z.high), Parameter("high", high, z.unit, z.low, high)), tuple(starts)


def _smooth_saturation(z: Size) -> _Made:
    return _one(
        "inverse_limit",
        f"1/({z.unit})",
        0.0,
        0.0,
        10.0 / z.greatest,
        [part / z.greatest for part in (0.2, 0.6, 1.2, 2.5)],
    )


def _quantisation(z: Size) -> _Made:
    return _one("step", z.unit, 0.0, 0.0, z.half, [part * z.half for part in (0.003, 0.01, 0.03, 0.1, 0.3)])


def _play(z: Size) -> _Made:
    return _one("width", z.unit, 0.0, 0.0, 2.0 * z.half, [part * z.half for part in (0.01, 0.03, 0.1, 0.3, 0.8)])


def _rate_limit(z: Size) -> _Made:
    least = 2.0 * z.half / z.span
    most = max(1e3 * z.fastest, 1e6 * least)
    starts = np.geomspace(2.0 * least, max(z.fastest, 4.0 * least), 10)
    scale = float(np.sqrt(starts[0] * starts[-1]))
    return (Parameter("rate", most, f"({z.unit})/s", 0.1 * least, most, scale=scale),), tuple(
        (float(v),) for v in starts
    )


def _times(z: Size, least: float = 0.5, points: int = 7) -> list[float]:
    return list(np.geomspace(least * z.step, max(z.span / 30.0, 4.0 * z.step), points))


def _lag(z: Size) -> _Made:
    return _one("time_constant", "s", 0.0, 0.0, z.span / 4.0, _times(z))


def _second_order_lag(z: Size) -> _Made:
    ps = (Parameter("inverse_frequency", 0.0, "s", 0.0, z.span / 4.0), Parameter("damping", 1.0, "-", 0.05, 5.0))
    return ps, tuple((v, d) for v in _times(z, points=6) for d in (0.3, 1.0))


def _dead_time(z: Size) -> _Made:
    return _one("delay", "s", 0.0, 0.0, z.span / 10.0, _times(z, 1.0, 12))


def _force_offset(z: Size) -> _Made:
    return _one("force", z.force_unit, 0.0, -3.0 * z.force, 3.0 * z.force, _both(z.force, (0.02, 0.1, 0.4)))


def _viscous(z: Size) -> _Made:
    c = z.force / z.speed
    return _one(
        "coefficient", f"({z.force_unit})/({z.speed_unit})", 0.0, 0.0, 20.0 * c, [part * c for part in (0.02, 0.1, 0.5)]
    )


def _coulomb(z: Size) -> _Made:
    return _one("friction", z.force_unit, 0.0, 0.0, 5.0 * z.force, [part * z.force for part in (0.02, 0.1, 0.3, 1.0)])


def _stribeck(z: Size) -> _Made:
    ps = (
        Parameter("friction", 0.0, z.force_unit, 0.0, 5.0 * z.force),
        Parameter("breakaway_excess", 0.0, z.force_unit, -2.0 * z.force, 5.0 * z.force),
        Parameter("speed", 0.3 * z.speed, z.speed_unit, 0.01 * z.speed, 5.0 * z.speed),
    )
    return ps, tuple(
        (f * z.force, e * f * z.force, w * z.speed) for f in (0.1, 0.5) for e in (0.5, -0.5) for w in (0.1, 0.5)
    )


def _quadratic_drag(z: Size) -> _Made:
    c = z.force / z.speed**2
    return _one(
        "coefficient", f"({z.force_unit})/({z.speed_unit})^2", 0.0, -20.0 * c, 20.0 * c, _both(c, (0.02, 0.1, 0.5))
    )


def _spring(z: Size) -> _Made:
    k = z.force / z.travel
    return _one(
        "stiffness", f"({z.force_unit})/({z.travel_unit})", 0.0, -20.0 * k, 100.0 * k, _both(k, (0.02, 0.1, 0.5))
    )


def _cubic_spring(z: Size) -> _Made:
    k = z.force / z.travel**3
    return _one(
        "stiffness",
        f"({z.force_unit})/({z.travel_unit})^3",
        0.0,
        -20.0 * k,
        100.0 * k,
        _both(k, (0.02, 0.1, 0.5, 2.5, 10.0)),
    )


def _slider(z: Size) -> tuple[list[Parameter], list[tuple[float, float]]]:
    k = z.force / z.travel
    ps = [
        Parameter("stiffness", 0.0, f"({z.force_unit})/({z.travel_unit})", 0.0, 1e4 * k),
        Parameter("friction", 0.0, z.force_unit, 0.0, 5.0 * z.force),
    ]
    return ps, [(a * k, f * z.force) for a in (2.0, 6.0, 20.0, 100.0) for f in (0.1, 0.4, 1.0)]


def _elastic_plastic(z: Size) -> _Made:
    ps, starts = _slider(z)
    return tuple(ps), tuple(starts)


def _bouc_wen(z: Size) -> _Made:
    ps, starts = _slider(z)
    return (*ps, Parameter("sharpness", 1.0, "-", 0.2, 20.0)), tuple((*s, 1.0) for s in starts)


def _backlash_gap(z: Size) -> _Made:
    return _one("gap", z.travel_unit, 0.0, 0.0, z.travel, [part * z.travel for part in (0.01, 0.03, 0.1, 0.2, 0.4)])


def _friction_asymmetry(z: Size) -> _Made:
    return _one("difference", "-", 0.0, -0.9, 0.9, _both(1.0, (0.03, 0.1, 0.3)))


def _state_offset(z: Size) -> _Made:
    return _one("rate", f"({z.unit})/s", 0.0, -10.0 * z.rate, 10.0 * z.rate, _both(z.rate, (0.02, 0.1, 0.5)))


def _power(z: Size, n: float, unit: str, signs: bool = True) -> _Made:
    c = z.rate / z.greatest**n
    return _one(
        "coefficient",
        unit,
        0.0,
        -30.0 * c if signs else 0.0,
        100.0 * c,
        _both(c, (0.05, 0.3, 1.0, 3.0)) if signs else [0.1 * c, c],
    )


def _leak(z: Size) -> _Made:
    return _power(z, 1.0, "1/s")


def _state_quadratic(z: Size) -> _Made:
    return _power(z, 2.0, f"1/({z.unit} s)")


def _state_square_root(z: Size) -> _Made:
    return _power(z, 0.5, f"({z.unit})^0.5/s")


def _state_cubic(z: Size) -> _Made:
    return _power(z, 3.0, f"1/(({z.unit})^2 s)")


LAWS: dict[str, dict[str, Law]] = {
    "signal": {
        law.name: law
        for law in (
            Law("bias", BIAS, "a constant is added", _bias),
            Law("gain", GAIN, "multiplied by a factor", _gain),
            Law(
                "asymmetric_gain",
                ASYMMETRIC_GAIN,
                "one sign counts more than the other",
                _asymmetric_gain,
                "the error changes with the sign",
            ),
            Law(
                "absolute_value",
                ABSOLUTE,
                "the sign is lost (wholly at share 1)",
                _absolute,
                "the output never turns negative",
            ),
            Law(
                "square_root",
                SQUARE_ROOT,
                "bends as a square root does",
                _square_root,
                "steep near zero, flat far from it",
                constant=_greatest,
            ),
            Law("cubic", CUBIC, "a cubic term", _cubic, "grows at both ends"),
            Law(
                "dead_zone",
                DEAD_ZONE,
                "nothing passes near zero",
                _dead_zone,
                "no answer to small values, a constant lack beyond",
            ),
            Law("saturation", SATURATION, "nothing passes beyond a limit", _saturation, "flat tops"),
            Law("smooth_saturation", SMOOTH_SATURATION, "limits by and by (tanh)", _smooth_saturation, "rounded tops"),
            Law("quantisation", QUANTISATION, "moves in steps", _quantisation, "stairs"),
            Law("play", PLAY, "lost motion at each reversal", _play, "flat after each reversal, then parallel", True),
            Law(
                "rate_limit",
                RATE_LIMIT,
                "cannot change faster than a limit",
                _rate_limit,
                "straight ramps after steps",
                True,
            ),
            Law("lag", LAG, "first-order lag", _lag, "exponential after steps", True),
            Law(
                "second_order_lag",
                SECOND_ORDER_LAG,
                "second-order lag",
                _second_order_lag,
                "rounded start, perhaps overshoot",
                True,
            ),
            Law(
                "dead_time",
                DEAD_TIME,
                "comes later, otherwise unchanged",
                _dead_time,
                "nothing at all, then everything",
                True,
            ),
        )
    },
    "force": {
        law.name: law
        for law in (
            Law("force_offset", FORCE_OFFSET, "a constant force", _force_offset),
            Law("viscous", VISCOUS, "friction proportional to velocity", _viscous),
            Law(
                "coulomb",
                COULOMB,
                "friction of constant size against the motion",
                _coulomb,
                "jumps where the direction changes",
            ),
            Law("quadratic_drag", QUADRATIC_DRAG, "friction with the square of velocity", _quadratic_drag),
            Law("spring", SPRING, "force proportional to displacement", _spring),
            Law("cubic_spring", CUBIC_SPRING, "hardening spring", _cubic_spring),
            Law(
                "elastic_plastic",
                ELASTIC_PLASTIC,
                "Coulomb friction behind a spring",
                _elastic_plastic,
                "ramps over a distance after reversals",
                True,
            ),
            Law(
                "stribeck",
                STRIBECK,
                "Coulomb friction that is larger (or smaller) at small speed",
                _stribeck,
                "spikes at reversals",
            ),
            Law(
                "bouc_wen",
                BOUC_WEN,
                "smooth hysteresis: a spring that yields by and by",
                _bouc_wen,
                "rounded loops",
                True,
            ),
            Law(
                "backlash_gap",
                BACKLASH_GAP,
                "lost motion in series with the elastic elements",
                _backlash_gap,
                "no force over a distance",
                True,
            ),
            Law("friction_asymmetry", FRICTION_ASYMMETRY, "friction differs with the direction", _friction_asymmetry),
        )
    },
    "state": {
        law.name: law
        for law in (
            Law("offset", STATE_OFFSET, "a constant rate", _state_offset),
            Law("leak", LEAK, "loses in proportion to itself", _leak),
            Law("square_root", STATE_SQUARE_ROOT, "outflow as the square root (Torricelli)", _state_square_root),
            Law("quadratic_drag", STATE_QUADRATIC, "loses with its square", _state_quadratic),
            Law("cubic", STATE_CUBIC, "loses with its cube", _state_cubic),
            Law(
                "saturation",
                STATE_LIMIT,
                "cannot leave a range (an overflow, an end stop)",
                _saturation,
                "flat tops",
                True,
            ),
            Law(
                "rate_limit", STATE_RATE_LIMIT, "cannot change faster than a limit", _rate_limit, "straight ramps", True
            ),
        )
    },
}
SIGNAL_LAWS, FORCE_LAWS, STATE_LAWS = LAWS["signal"], LAWS["force"], LAWS["state"]
HYSTERETIC = (ELASTIC_PLASTIC, BOUC_WEN)  # carry a force at rest: where they start is unknown
MODIFIERS = (
    BACKLASH_GAP,
    FRICTION_ASYMMETRY,
)  # add no force of their own: they change what the friction and spring laws add
