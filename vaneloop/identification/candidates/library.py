"""The library of laws that the search tries on users' own models: `LAWS`, with names, parameters, bounds and starts.

`SIGNAL_LAWS` act on inputs and outputs, `FORCE_LAWS` where things move, `STATE_LAWS` on states of first order; their
equations are in `identification.candidates.laws`. Bounds and starting values follow from the `Size` of the data at the
place, never from constants of one machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vaneloop.base.quantities import absolute_zero, kind_of
from vaneloop.identification.candidates import laws
from vaneloop.identification.settings import TRIED_SIZES
from vaneloop.identification.subsystem import Parameter

__all__ = ["FORCE_LAWS", "LAWS", "SIGNAL_LAWS", "STATE_LAWS", "Law", "Size"]


@dataclass(frozen=True)
class Size:
    """How large the data are at a place; everything that bounds a law comes from here.

    low, high   smallest and largest value (0.1 and 99.9 % quantiles)
    rate        RMS of the derivative, per s
    fastest     99.9 % quantile of the derivative's magnitude
    step, span  s: median time between samples, length of the longest log
    held        s: median time from one change of the value to the next; 0: not known
    unit        of the values
    force       RMS of the force (or derivative) that the law adds to
    force_unit  of that
    speed, speed_unit, travel, travel_unit   RMS velocity and half range of the displacement of a force law
    ends    smallest and largest displacement of a force law
    """

    low: float
    high: float
    rate: float
    fastest: float
    step: float
    span: float
    unit: str = "-"
    force: float = 1.0
    force_unit: str = "-"
    speed: float = 1.0
    speed_unit: str = "-"
    travel: float = 1.0
    travel_unit: str = "-"
    held: float = 0.0
    ends: tuple[float, float] = (-1.0, 1.0)

    @property
    def half(self) -> float:
        """Half the range."""
        return max(0.5 * (self.high - self.low), 1e-300)

    @property
    def greatest(self) -> float:
        """Largest magnitude."""
        return max(-self.low, self.high, 1e-300)


@dataclass(frozen=True)
class Law:
    """A law: what it is, its number in the compiled dispatch, and how its parameters follow from the size of the data.

    make   Size -> parameters (neutral values and bounds) and starts, the parameter vectors from which a fit is tried
    looks  how it shows in a log
    memory True where the answer depends on what was before
    holds   a law of the same place that this one is at some values of its parameters, and where, as `Effect.holds`
    onward  from values of the law that it holds to starts of this one, as `Effect.onward`
    constant  a number of the law that is not free, from the size of the data; it follows the parameters
    of        kinds of quantity (`base.quantities`) that the law makes sense for; empty: any
    """

    name: str
    code: int
    text: str
    make: Callable[[Size], tuple[tuple[Parameter, ...], tuple[tuple[float, ...], ...]]]
    looks: str = ""
    memory: bool = False
    constant: Callable[[Size], float] | None = None
    holds: tuple[str, tuple[float | None, ...]] | None = None
    onward: Callable[[Sequence[float]], list[tuple[float, ...]]] | None = None
    of: tuple[str, ...] = ()

    def suits(self, unit: str) -> bool:
        """Whether the law makes sense for a quantity in this unit."""
        return not self.of or kind_of(unit) in self.of


# ---- parameters from the size of the data ----------------------------------------------------------------------------

_Made = tuple[tuple[Parameter, ...], tuple[tuple[float, ...], ...]]


def _one(name: str, unit: str, neutral: float, low: float, high: float, starts: list[float]) -> _Made:
    return (Parameter(name, neutral, unit, low, high),), tuple((float(v),) for v in starts)


def _both(size: float, parts: tuple[float, ...] = (0.02, 0.1, 0.5)) -> list[float]:
    return [sign * part * size for part in parts for sign in (1.0, -1.0)]


def _bias(z: Size) -> _Made:
    return _one("offset", z.unit, 0.0, -2.0 * z.greatest, 2.0 * z.greatest, _both(z.greatest, TRIED_SIZES))


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


def _square(z: Size) -> _Made:
    # a little beyond the whole square, so that the interval of one lies within
    ps = (Parameter("share", 0.0, "-", -2.0, 1.2),)
    return ps, tuple((v,) for v in _both(1.0, (0.05, 0.25, 1.0)))


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


_BEGIN = Parameter("begin", 0.0, "-", -1.0, 1.0, shape=True)  # where in its band something with play stands at first


def _play(z: Size) -> _Made:
    widths = [part * z.half for part in (0.005, 0.015, 0.03, 0.06, 0.1, 0.2, 0.35, 0.8, 1.6, 2.6)]
    ps = (Parameter("width", 0.0, z.unit, 0.0, 4.0 * z.half), _BEGIN)
    return ps, tuple((width, begin) for width in widths for begin in (0.0, 0.6, -0.6))


def _stiction(z: Size) -> _Made:
    widths = [part * z.half for part in (0.015, 0.04, 0.1, 0.2, 0.5, 1.2, 2.6)]
    jump = Parameter("jump", 0.5, "-", 0.0, 1.0, shape=True)
    ps = (Parameter("width", 0.0, z.unit, 0.0, 4.0 * z.half), jump, _BEGIN)
    return ps, tuple((width, j, begin) for width in widths for j in (0.3, 1.0) for begin in (0.6, -0.6))


def _from_play(values: Sequence[float]) -> list[tuple[float, ...]]:
    """What sticks and slides as far behind as something with play, and stands at first where that does; and what slides
    less far behind: play without the jumps is wider.
    """
    width, begin = values
    jumps = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    return [(part * width / (1.0 - j), j, begin * (1.0 - j) / (1.0 + j)) for j in jumps for part in (1.0, 0.9)]


def _stopped(z: Size) -> float:
    """Time without a change from which a command has stopped: where it changes with every sample, the next one."""
    return max(1.5 * z.held - z.step, 0.5 * z.step)


def _overflow(z: Size) -> _Made:
    above = z.high + (z.high - z.low)
    ps = (Parameter("level", above, z.unit, z.low, above), Parameter("share", 1.0, "-", 0.0, 2.0, shape=True))
    return ps, tuple((z.high - part * (z.high - z.low), 1.0) for part in (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5))


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
    return _one("time_constant", "s", 0.0, 0.0, z.span / 8.0, _times(z))  # a log shows what ends in it


def _second_order_lag(z: Size) -> _Made:
    ps = (Parameter("inverse_frequency", 0.0, "s", 0.0, z.span / 16.0), Parameter("damping", 1.0, "-", 0.05, 2.0))
    return ps, tuple((v, d) for v in _times(z, points=6) for d in (0.3, 1.0))


def _dead_time(z: Size) -> _Made:
    return _one("delay", "s", 0.0, 0.0, z.span / 10.0, _times(z, 1.0, 12))


def _force_offset(z: Size) -> _Made:
    return _one("force", z.force_unit, 0.0, -3.0 * z.force, 3.0 * z.force, _both(z.force, (0.02, 0.1, 0.4)))


def _viscous(z: Size) -> _Made:
    c = z.force / z.speed
    return _one(
        "coefficient", f"({z.force_unit})/({z.speed_unit})", 0.0, 0.0, 20.0 * c, [v for v in _both(c) if v > 0.0]
    )


def _coulomb(z: Size) -> _Made:
    return _one("friction", z.force_unit, 0.0, 0.0, 5.0 * z.force, [part * z.force for part in (0.02, 0.1, 0.3, 1.0)])


def _stribeck(z: Size) -> _Made:
    ps = (
        Parameter("friction", 0.0, z.force_unit, 0.0, 5.0 * z.force),
        Parameter("breakaway_excess", 0.0, z.force_unit, 0.0, 5.0 * z.force),
        Parameter("speed", 0.3 * z.speed, z.speed_unit, 0.01 * z.speed, 5.0 * z.speed),
    )
    return ps, tuple(
        (f * z.force, e * f * z.force, w * z.speed) for f in (0.1, 0.5) for e in (0.2, 0.7) for w in (0.1, 0.5)
    )


def _smooth_coulomb(z: Size) -> _Made:
    ps = (
        Parameter("friction", 0.0, z.force_unit, 0.0, 5.0 * z.force),
        Parameter("speed", 0.3 * z.speed, z.speed_unit, 0.01 * z.speed, 5.0 * z.speed, shape=True),
    )
    return ps, tuple((f * z.force, w * z.speed) for f in (0.02, 0.1, 0.4, 1.5) for w in (0.1, 0.3, 1.0))


def _quadratic_drag(z: Size) -> _Made:
    c = z.force / z.speed**2
    return _one("coefficient", f"({z.force_unit})/({z.speed_unit})^2", 0.0, -20.0 * c, 20.0 * c, _both(c))


def _spring(z: Size) -> _Made:
    k = z.force / z.travel
    return _one("stiffness", f"({z.force_unit})/({z.travel_unit})", 0.0, -20.0 * k, 100.0 * k, _both(k))


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


def _end_stop(z: Size) -> _Made:
    k, (low, high) = z.force / z.travel, z.ends
    r = high - low
    ps = (  # a third of the travel at least is free: a stop that is always touched is a spring, or a constant
        Parameter("stiffness", 0.0, f"({z.force_unit})/({z.travel_unit})", 0.0, 1e4 * k),
        Parameter("low", low - r, z.travel_unit, low - r, low + r / 3.0, shape=True),
        Parameter("high", high + r, z.travel_unit, high - r / 3.0, high + r, shape=True),
    )
    ways = [(d * r * a, d * r * b) for d in (0.1, 0.3) for a, b in ((1, 1), (1, 0), (0, 1))]  # how deep, on each side
    sides = [(low + a if a else low - r, high - b if b else high + r) for a, b in ways]
    return ps, tuple((a * k, *at) for at in sides for a in (3.0, 10.0, 30.0))


def _backlash_gap(z: Size) -> _Made:
    return _one("gap", z.travel_unit, 0.0, 0.0, z.travel, [part * z.travel for part in (0.01, 0.03, 0.1, 0.2, 0.4)])


def _friction_asymmetry(z: Size) -> _Made:
    return _one("difference", "-", 0.0, -0.9, 0.9, _both(1.0, (0.03, 0.1, 0.3)))


def _state_offset(z: Size) -> _Made:
    return _one("rate", f"({z.unit})/s", 0.0, -10.0 * z.rate, 10.0 * z.rate, _both(z.rate))


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


def _absolute_zero(z: Size) -> float:
    """Absolute temperature at the place's zero. What is in K and begins near 0 is a rise over a room's temperature."""
    zero = absolute_zero(z.unit)
    return zero if zero > 0.0 or z.low > 0.1 * (z.high - z.low) else absolute_zero("degC") + 20.0


def _radiation(z: Size) -> _Made:
    zero = _absolute_zero(z)
    c = z.rate / max((z.high + zero) ** 4 - (z.low + zero) ** 4, 1e-300)
    r = z.high - z.low
    ps = (
        Parameter("coefficient", 0.0, f"1/(({z.unit})^3 s)", 0.0, 100.0 * c),
        Parameter("surroundings", z.low, z.unit, min(max(z.low - 3.0 * r, -zero), z.low), z.high, shape=True),
    )
    return ps, tuple((part * c, z.low) for part in (0.05, 0.3, 1.0, 3.0))


def _radiation_to(z: Size) -> _Made:
    (coefficient, _), starts = _radiation(z)
    return (coefficient,), tuple((c,) for c, _ in starts)


LAWS: dict[str, dict[str, Law]] = {
    "signal": {
        law.name: law
        for law in (
            Law("bias", laws.BIAS, "a constant is added", _bias),
            Law("gain", laws.GAIN, "multiplied by a factor", _gain),
            Law(
                "asymmetric_gain",
                laws.ASYMMETRIC_GAIN,
                "one sign counts more than the other",
                _asymmetric_gain,
                "the error changes with the sign",
            ),
            Law(
                "absolute_value",
                laws.ABSOLUTE,
                "the sign is lost (wholly at share 1)",
                _absolute,
                "the output never turns negative",
            ),
            Law(
                "square_root",
                laws.SQUARE_ROOT,
                "bends as a square root does",
                _square_root,
                "steep near zero, flat far from it",
                constant=_greatest,
            ),
            Law(
                "square",
                laws.SQUARE,
                "bends as a square does",
                _square,
                "flat near zero, steep far from it; the sign is lost",
                constant=_greatest,
            ),
            Law("cubic", laws.CUBIC, "a cubic term", _cubic, "grows at both ends"),
            Law(
                "dead_zone",
                laws.DEAD_ZONE,
                "nothing passes near zero",
                _dead_zone,
                "no answer to small values, a constant lack beyond",
            ),
            Law("saturation", laws.SATURATION, "nothing passes beyond a limit", _saturation, "flat tops"),
            Law(
                "smooth_saturation", laws.SMOOTH_SATURATION, "limits by and by (tanh)", _smooth_saturation, "round tops"
            ),
            Law("quantisation", laws.QUANTISATION, "moves in steps", _quantisation, "stairs"),
            Law(
                "play",
                laws.PLAY,
                "lost motion at each reversal",
                _play,
                "flat after each reversal, then parallel",
                True,
            ),
            Law(
                "stiction",
                laws.STICTION,
                "sticks, jumps, then slides on behind its command",
                _stiction,
                "flat after each reversal or stop, a jump, then parallel",
                True,
                constant=_stopped,
                holds=("play", (None, 0.0, None)),
                onward=_from_play,
            ),
            Law(
                "stick_slip",
                laws.STICK_SLIP,
                "sticks, jumps, and sticks again at once",
                _stiction,
                "stairs while the command moves",
                True,
                holds=("play", (None, 0.0, None)),
                onward=_from_play,
            ),
            Law(
                "rate_limit",
                laws.RATE_LIMIT,
                "cannot change faster than a limit",
                _rate_limit,
                "straight ramps after steps",
                True,
            ),
            Law("lag", laws.LAG, "first-order lag", _lag, "exponential after steps", True),
            Law(
                "second_order_lag",
                laws.SECOND_ORDER_LAG,
                "second-order lag",
                _second_order_lag,
                "rounded start, perhaps overshoot",
                True,
            ),
            Law(
                "dead_time",
                laws.DEAD_TIME,
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
            Law("force_offset", laws.FORCE_OFFSET, "a constant force", _force_offset),
            Law("viscous", laws.VISCOUS, "friction proportional to velocity", _viscous),
            Law(
                "coulomb",
                laws.COULOMB,
                "friction of constant size against the motion",
                _coulomb,
                "jumps where the direction changes",
            ),
            Law("quadratic_drag", laws.QUADRATIC_DRAG, "friction with the square of velocity", _quadratic_drag),
            Law("spring", laws.SPRING, "force proportional to displacement", _spring),
            Law("cubic_spring", laws.CUBIC_SPRING, "hardening spring", _cubic_spring),
            Law(
                "end_stop",
                laws.END_STOP,
                "a stiff contact at each end of the travel",
                _end_stop,
                "sharp turns at the ends",
            ),
            Law(
                "elastic_plastic",
                laws.ELASTIC_PLASTIC,
                "Coulomb friction behind a spring",
                _elastic_plastic,
                "ramps over a distance after reversals",
                True,
            ),
            Law(
                "stribeck",
                laws.STRIBECK,
                "Coulomb friction that is larger at small speed",
                _stribeck,
                "spikes at reversals",
                holds=("coulomb", (None, 0.0, np.nan)),
            ),
            Law(
                "smooth_coulomb",
                laws.SMOOTH_COULOMB,
                "friction that builds up over a speed, then stays: a digressive damper",
                _smooth_coulomb,
                "the error bends at small speed",
            ),
            Law(
                "bouc_wen",
                laws.BOUC_WEN,
                "smooth hysteresis: a spring that yields by and by",
                _bouc_wen,
                "rounded loops",
                True,
                holds=("elastic_plastic", (None, None, 20.0)),  # all but
            ),
            Law(
                "backlash_gap",
                laws.BACKLASH_GAP,
                "lost motion in series with the elastic elements",
                _backlash_gap,
                "no force over a distance",
                True,
            ),
            Law(
                "friction_asymmetry",
                laws.FRICTION_ASYMMETRY,
                "friction differs with the direction",
                _friction_asymmetry,
            ),
        )
    },
    "state": {
        law.name: law
        for law in (
            Law("offset", laws.STATE_OFFSET, "a constant rate", _state_offset),
            Law("leak", laws.LEAK, "loses in proportion to itself", _leak),
            Law("square_root", laws.STATE_SQUARE_ROOT, "outflow as the square root (Torricelli)", _state_square_root),
            Law("quadratic_drag", laws.STATE_QUADRATIC, "loses with its square", _state_quadratic),
            Law("cubic", laws.STATE_CUBIC, "loses with its cube", _state_cubic),
            Law(
                "radiation",
                laws.RADIATION,
                "radiates heat to its surroundings",
                _radiation,
                "loses more and more as it grows hot",
                constant=_absolute_zero,
                of=("temperature",),
            ),
            Law(
                "saturation",
                laws.STATE_LIMIT,
                "cannot leave a range (an overflow, an end stop)",
                _saturation,
                "flat tops",
                True,
            ),
            Law("rate_limit", laws.STATE_RATE_LIMIT, "cannot change faster than a limit", _rate_limit, "ramps", True),
            Law(
                "radiation_to",
                laws.RADIATION_TO,
                "radiates heat to surroundings that are measured",
                _radiation_to,
                "loses more and more as it grows hot",
                constant=_absolute_zero,
                of=("temperature",),
            ),
            Law(
                "overflow",
                laws.STATE_OVERFLOW,
                "what is above a level goes into another state",
                _overflow,
                "a flat top here, a rise there",
                True,
                of=("length", "volume", "mass", "share"),
            ),
        )
    },
}
SIGNAL_LAWS, FORCE_LAWS, STATE_LAWS = LAWS["signal"], LAWS["force"], LAWS["state"]
