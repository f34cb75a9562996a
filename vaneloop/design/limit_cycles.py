"""Limit cycles that play makes in a loop: its describing function, the crossings with the loop, the harmonics kept.

Source: Gelb, Vander Velde, Multiple-Input Describing Functions (1968), ch. 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from vaneloop.base.errors import InputError

__all__ = ["LimitCycle", "Play", "harmonic_balance", "limit_cycles", "play_describing_function"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


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
        w = float(scipy.optimize.brentq(lambda v: mismatch(at(v)), a, b, rtol=1e-10))
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
    answer = scipy.optimize.root(balance, first, method="hybr", tol=1e-10)
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
