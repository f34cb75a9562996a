"""Laws of the product's library, coded again from their physics, and how large they are drawn.

Signal laws act on a finely sampled signal (numpy, scipy); forces and rates are functions for the integrator. Sizes are
shares of what the nominal system does at the place (`Size`), log-uniform from hardly there to gross; none is fitted to
what a search can find.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

from tests.rig_systems.family import Array

__all__ = ["LTI", "SIGNAL_MEMORY", "Size", "draw_values", "on_signal", "state_loss"]

SIGNAL_MEMORY = ("play", "rate_limit", "lag", "second_order_lag", "dead_time")
LTI = ("lag", "second_order_lag", "dead_time")


@dataclass(frozen=True)
class Size:
    """How large the nominal system's values are at a place.

    low, high   of the values; ``rate``: RMS of the derivative, ``fastest``: its 99.9 % quantile
    force, speed, travel   RMS force, RMS speed, half the range of the displacement (force places)
    scale       time scale of the system, s; ``step``: time between samples
    """

    low: float
    high: float
    rate: float
    fastest: float
    scale: float
    step: float
    force: float = 1.0
    speed: float = 1.0
    travel: float = 1.0

    @property
    def half(self) -> float:
        """Half the range."""
        return 0.5 * (self.high - self.low)

    @property
    def greatest(self) -> float:
        """Greatest magnitude."""
        return max(abs(self.low), abs(self.high))


def draw_values(law: str, kind: str, z: Size, rng: np.random.Generator) -> dict[str, float]:
    """Values of a law at a place of a kind (input, output, command: signal; force; state)."""

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    sign = float(rng.choice([-1.0, 1.0]))
    if kind == "force":
        stiff = z.force / z.travel
        friction = log(0.005, 0.5) * z.force
        slider = log(0.02, 0.6) * z.force
        return {
            "force_offset": lambda: {"force": sign * log(0.005, 0.4) * z.force},
            "viscous": lambda: {"coefficient": log(0.005, 0.5) * z.force / z.speed},
            "coulomb": lambda: {"friction": friction},
            "stribeck": lambda: {
                "friction": friction, "breakaway_excess": friction * log(0.1, 0.8),
                "speed": log(0.05, 0.4) * z.speed,
            },
            "quadratic_drag": lambda: {"coefficient": log(0.005, 0.5) * z.force / z.speed**2},
            "spring": lambda: {"stiffness": log(0.005, 0.5) * stiff},
            "cubic_spring": lambda: {"stiffness": log(0.005, 1.0) * stiff / z.travel**2},
            "elastic_plastic": lambda: {"stiffness": slider / (log(0.03, 0.4) * z.travel), "friction": slider},
            "bouc_wen": lambda: {
                "stiffness": slider / (log(0.03, 0.4) * z.travel), "friction": slider, "sharpness": log(0.5, 3.0)
            },
            "backlash_gap": lambda: {"gap": log(0.02, 0.4) * z.travel},
            "friction_asymmetry": lambda: {"difference": sign * log(0.03, 0.5)},
        }[law]()  # fmt: skip
    if kind == "state":
        if law == "saturation":
            return _cut(z, rng, log)
        power = {"leak": 1.0, "square_root": 0.5, "quadratic_drag": 2.0, "cubic": 3.0}
        if law == "offset":
            return {"rate": sign * log(0.005, 0.5) * z.rate}
        if law == "rate_limit":
            return {"rate": log(0.2, 1.0) * z.fastest}
        return {"coefficient": log(0.005, 1.0) * z.rate / z.greatest ** power[law]}
    return {
        "bias": lambda: {"offset": sign * log(0.003, 0.3) * z.half},
        "gain": lambda: {"factor": 1.0 + sign * log(0.003, 0.3)},
        "asymmetric_gain": lambda: {"difference": sign * log(0.003, 0.4)},
        "absolute_value": lambda: {"share": 1.0 if rng.random() < 0.5 else log(0.01, 1.0)},
        "square_root": lambda: {"share": 1.0 if rng.random() < 0.3 else log(0.01, 1.0)},
        "cubic": lambda: {"coefficient": sign * log(0.003, 0.3) / z.greatest**2},
        "dead_zone": lambda: {"half_width": log(0.003, 0.3) * z.greatest},
        "saturation": lambda: _cut(z, rng, log),
        "smooth_saturation": lambda: {"inverse_limit": log(0.1, 1.5) / z.greatest},
        "quantisation": lambda: {"step": log(0.003, 0.3) * z.half},
        "play": lambda: {"width": log(0.005, 0.4) * z.half},
        "rate_limit": lambda: {"rate": 2.0 * z.half / (log(0.02, 2.0) * z.scale)},
        "lag": lambda: {"time_constant": log(0.01, 1.0) * z.scale},
        "second_order_lag": lambda: {"inverse_frequency": log(0.02, 0.5) * z.scale, "damping": log(0.3, 1.0)},
        "dead_time": lambda: {"delay": max(round(log(0.02, 1.0) * z.scale / z.step * 8.0), 1) * z.step / 8.0},
    }[law]()


def _cut(z: Size, rng: np.random.Generator, log: object) -> dict[str, float]:
    """A limit that takes 0.5 to 40 % of the range off the top; one time in three off the bottom instead."""
    part = float(np.exp(rng.uniform(np.log(0.005), np.log(0.4)))) * 2.0 * z.half
    far = 10.0 * z.greatest
    return {"low": z.low + part, "high": far} if rng.random() < 1 / 3 else {"low": -far, "high": z.high - part}


def on_signal(law: str, v: dict[str, float], y: Array, h: float, hold: bool, greatest: float) -> Array:
    """A law on a signal sampled every ``h`` s. ``hold``: the signal stands still from sample to sample, else it runs
    straight.

    greatest  magnitude that a square root leaves as it is
    """
    if law == "bias":
        return y + v["offset"]
    if law == "gain":
        return y * v["factor"]
    if law == "asymmetric_gain":
        return y + v["difference"] * np.abs(y)
    if law == "absolute_value":
        return np.where(y < 0.0, y * (1.0 - 2.0 * v["share"]), y)
    if law == "square_root":
        return (1.0 - v["share"]) * y + v["share"] * np.sign(y) * np.sqrt(np.abs(y) * greatest)
    if law == "cubic":
        return y + v["coefficient"] * y**3
    if law == "dead_zone":
        return np.sign(y) * np.maximum(np.abs(y) - v["half_width"], 0.0)
    if law == "saturation":
        return np.clip(y, v["low"], v["high"])
    if law == "smooth_saturation":
        return np.tanh(y * v["inverse_limit"]) / v["inverse_limit"]
    if law == "quantisation":
        return np.round(y / v["step"]) * v["step"]
    if law == "play":
        return _follow(y, 0.5 * v["width"])
    if law == "rate_limit":
        return _ramp(y, v["rate"] * h)
    if law == "lag":  # T x' = u - x
        return _linear([[-1.0 / v["time_constant"]]], [[1.0 / v["time_constant"]]], y, h, hold)
    if law == "second_order_lag":  # x'' = w^2 (u - x) - 2 d w x'
        w, d = 1.0 / v["inverse_frequency"], v["damping"]
        return _linear([[0.0, 1.0], [-w * w, -2.0 * d * w]], [[0.0], [w * w]], y, h, hold)
    if law == "dead_time":
        n = v["delay"] / h
        at = np.maximum(np.arange(len(y)) - n, 0.0)
        if hold:
            return y[np.floor(at + 1e-9).astype(int)]
        return np.interp(at, np.arange(len(y)), y)
    raise ValueError(f"law {law!r} is not one on a signal")


def _follow(y: Array, half: float) -> Array:
    """Friction drive with lost motion: the follower stays while the leader moves within +- half."""
    out = np.empty(len(y))
    s = y[0]
    for k, x in enumerate(y.tolist()):
        if x - s > half:
            s = x - half
        elif s - x > half:
            s = x + half
        out[k] = s
    return out


def _ramp(y: Array, most: float) -> Array:
    """A follower that moves by ``most`` a sample at most."""
    out = np.empty(len(y))
    s = y[0]
    for k, x in enumerate(y.tolist()):
        s = x if abs(x - s) <= most else s + (most if x > s else -most)
        out[k] = s
    return out


def _linear(a: list[list[float]], b: list[list[float]], y: Array, h: float, hold: bool) -> Array:
    """First state of x' = a x + b u, at rest at the first value: the exact discrete filter."""
    n = len(a)
    c = np.zeros((1, n))
    c[0, 0] = 1.0
    method = "zoh" if hold else "foh"
    ad, bd, cd, dd, _ = cont2discrete((np.array(a), np.array(b), c, np.zeros((1, 1))), h, method)
    from scipy.signal import ss2tf

    num, den = ss2tf(ad, bd, cd, dd)
    return y[0] + lfilter(num[0], den, y - y[0])


def state_loss(law: str, v: dict[str, float], x: float) -> float:
    """What a law takes off the derivative of a state."""
    if law == "offset":
        return v["rate"]
    c = v["coefficient"]
    if law == "leak":
        return c * x
    if law == "quadratic_drag":
        return c * x * abs(x)
    if law == "square_root":
        return c * (x**0.5 if x > 0.0 else -((-x) ** 0.5))
    if law == "cubic":
        return c * x**3
    raise ValueError(f"law {law!r} is not one of a state")
