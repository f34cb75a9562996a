"""Test signals as engineers use them: steps, pseudo-random binary, multisine, sine sweep, cycles of ramps; and motions
with exact velocity and acceleration.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.rig_systems.family import Array

__all__ = ["KINDS", "MOTIONS", "motion", "signal"]

Rng = np.random.Generator
HELD = 6  # samples for which a generator holds a value of what is smooth


def _steps(t: Array, scale: float, rng: Rng) -> Array:
    """Levels held for 1.5 to 8 time scales."""
    out = np.empty(len(t))
    at = 0.0
    while at <= t[-1]:
        last = at + scale * rng.uniform(1.5, 8.0)
        out[(t >= at) & (t < last)] = rng.uniform(0.0, 1.0)
        at = last
    return out


def _binary(t: Array, scale: float, rng: Rng) -> Array:
    """Pseudo-random binary signal with a clock of 0.7 to 2 time scales."""
    clock = scale * rng.uniform(0.7, 2.0)
    bits = rng.integers(0, 2, int(t[-1] / clock) + 2)
    return bits[(t / clock).astype(int)].astype(float)


def _lines(t: Array, scale: float, rng: Rng) -> Array:
    """Multisine of 12 lines between 0.01 and 0.4 / time scale, random phases."""
    f = np.geomspace(max(0.01 / scale, 1.0 / t[-1]), 0.4 / scale, 12)
    y = np.sin(2.0 * np.pi * np.outer(t, f) + rng.uniform(0.0, 2.0 * np.pi, 12)).sum(axis=1)
    return (y - y.min()) / max(float(np.ptp(y)), 1e-12)


def _sweep(t: Array, scale: float, rng: Rng) -> Array:
    """Sine whose frequency rises exponentially from 0.01 to 0.4 / time scale."""
    first, last = max(0.01 / scale, 1.0 / t[-1]), 0.4 / scale * rng.uniform(0.6, 1.0)
    k = np.log(last / first) / t[-1]
    return 0.5 + 0.5 * np.sin(2.0 * np.pi * first * np.expm1(k * t) / k)


def _cycle(t: Array, scale: float, rng: Rng) -> Array:
    """Cycle of ramps and dwells, as a vehicle or an engine is driven."""
    times, levels = [0.0], [rng.uniform(0.0, 1.0)]
    while times[-1] < t[-1]:
        times += [times[-1] + scale * rng.uniform(0.5, 6.0)]
        levels += [levels[-1]]
        times += [times[-1] + scale * rng.uniform(0.3, 5.0)]
        levels += [float(rng.choice([0.0, 1.0, rng.uniform(), rng.uniform()]))]
    return np.interp(t, times, levels)


KINDS: dict[str, Callable[[Array, float, Rng], Array]] = {
    "steps": _steps,
    "binary": _binary,
    "multisine": _lines,
    "sweep": _sweep,
    "cycle": _cycle,
}


def signal(kind: str, t: Array, scale: float, low: float, high: float, line: bool, rng: Rng) -> Array:
    """Signal of a kind between ``low`` and ``high`` at times ``t``; where inputs hold, what is smooth changes every
    few samples.
    """
    y = KINDS[kind](t, scale, rng)
    if not line and kind in ("multisine", "sweep", "cycle"):
        y = y[(np.arange(len(t)) // HELD) * HELD]
    return low + (high - low) * y


MOTIONS = ("moves", "multisine", "sweep")


def motion(kind: str, t: Array, scale: float, reach: float, rng: Rng) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration within +- ``reach``.

    moves: point to point in minimum jerk (Flash and Hogan 1985), x = a (10 s^3 - 15 s^4 + 6 s^5), without dwells: at
    rest the motion does not tell what dry friction holds.
    """
    if kind == "moves":
        x, v, a = np.zeros(len(t)), np.zeros(len(t)), np.zeros(len(t))
        at, place = 0.0, 0.0
        while at < t[-1]:
            to, time = rng.uniform(-reach, reach), scale * rng.uniform(1.5, 6.0)
            s = np.clip((t - at) / time, 0.0, 1.0)
            on = (t >= at) & (t < at + time)
            way = to - place
            x = np.where(t >= at, place + way * (10 * s**3 - 15 * s**4 + 6 * s**5), x)
            v = np.where(on, way / time * (30 * s**2 - 60 * s**3 + 30 * s**4), v)
            a = np.where(on, way / time**2 * (60 * s - 180 * s**2 + 120 * s**3), a)
            at += time
            place = to
        return x, v, a
    if kind == "multisine":
        w = 2.0 * np.pi * np.geomspace(0.02 / scale, 0.3 / scale, 8)
        size = reach / w**0.7
        size *= reach / size.sum()
        angle = np.outer(w, t) + rng.uniform(0.0, 2.0 * np.pi, 8)[:, None]
        return (
            (size[:, None] * np.sin(angle)).sum(axis=0),
            ((size * w)[:, None] * np.cos(angle)).sum(axis=0),
            (-(size * w**2)[:, None] * np.sin(angle)).sum(axis=0),
        )
    # sine at four amplitudes and a frequency that rises
    first, last = 0.03 / scale, 0.25 / scale
    k = np.log(last / first) / t[-1]
    angle, w = 2.0 * np.pi * first * np.expm1(k * t) / k, 2.0 * np.pi * first * np.exp(k * t)
    size = reach / (1.0 + w / w[0]) ** 0.5
    # amplitude falls as the frequency rises: derivatives of A(t) sin(angle)
    q = w / w[0]
    da = -0.5 * reach * (1.0 + q) ** -1.5 * k * q
    dda = reach * k * k * q * (0.75 * q * (1.0 + q) ** -2.5 - 0.5 * (1.0 + q) ** -1.5)
    x = size * np.sin(angle)
    v = da * np.sin(angle) + size * w * np.cos(angle)
    a = dda * np.sin(angle) + 2.0 * da * w * np.cos(angle) + size * (k * w * np.cos(angle) - w**2 * np.sin(angle))
    return x, v, a
