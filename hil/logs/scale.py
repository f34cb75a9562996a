"""Gain and zero that the log itself says of a signal whose unit does not: it follows another signal, the schedule, or
the rate of the stroke, as a straight line.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hil.logs.guess import Files, feed_forward, mean_stroke, planned_angles
from vaneloop.base.signals import UNITS
from vaneloop.base.vanes import VANES

__all__ = ["proposed_scale"]

_PEERS = {"n_dem": ("n_r",), "n_r": ("n_dem",), "x_dem": ("x_lvdt",), "x_lvdt": ("x_dem",)}
_FOLLOWS = 0.97  # correlation with the peer, at least
_FEWEST = 50  # samples
_ALIKE = 0.02  # of gain, and of the peer's reach: as good as what is stated
_OVER = 0.2  # s, over which the stroke's rate is taken
_MOVES = 1.0  # mm/s: slower than that, the valve may be within its dead band
_VALVE = 0.1  # of the gain, as well as the stroke's rate says it: flow gain, pressure, load
_NULL = 5.0  # mA; no valve has a greater null bias
_ROUND = np.array([1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0])  # full scales that people choose

Samples = tuple[np.ndarray, np.ndarray]  # t (s), values


def proposed_scale(signal: str, own: Samples, channels: Mapping[str, Samples], tables: Files) -> tuple[str, str] | None:
    """The unit with gain and zero (`hil.logs.units.scale_of`) under which ``own`` numbers are the signal, and what they
    follow; None where nothing says so, or where the numbers are right as they are.

    channels  the log's other signals, in their units
    """
    if signal == "i_cmd":
        return _of_valve(own, channels, tables)
    for peer, t, values in _peers(signal, channels, tables):
        inside = (own[0] >= t[0]) & (own[0] <= t[-1])
        if np.count_nonzero(inside) < _FEWEST:
            continue
        a, b = own[1][inside], np.interp(own[0][inside], t, values)
        if not (np.ptp(a) > 0.0 and np.ptp(b) > 0.0):
            continue
        together = float(np.corrcoef(a, b)[0, 1])
        if abs(together) < _FOLLOWS:
            continue
        gain = float(np.std(b) / np.std(a)) * np.sign(together)
        gain = float(np.sign(gain)) if abs(abs(gain) - 1.0) < 5.0 * _ALIKE else float(f"{gain:.4g}")
        zero = float(f"{np.median(b - gain * a):.4g}")
        if abs(zero) < _ALIKE * float(np.ptp(b)):
            zero = 0.0
        if gain == 1.0 and zero == 0.0:
            return None
        return _written(signal, gain, zero), peer
    return None


def _written(signal: str, gain: float, zero: float) -> str:
    """The unit with gain and zero, as `--unit` takes it."""
    scaled = f"{'-' if gain == -1.0 else '' if gain == 1.0 else f'{gain:g}*'}{UNITS[signal]}"
    return f"{scaled}{zero:+g}" if zero else scaled


def _of_valve(own: Samples, channels: Mapping[str, Samples], tables: Files) -> tuple[str, str] | None:
    """`proposed_scale` of a valve's current: where the stroke moves with v, it is kff v + d sign(v) + i0, by the
    feed-forward kff of the controller, the valve's dead band d and its null bias i0.
    """
    for peer in ("x_lvdt", "x_dem"):
        if peer not in channels or len(channels[peer][0]) < _FEWEST:
            continue
        x = channels[peer]
        inside = (own[0] >= x[0][0] + 0.5 * _OVER) & (own[0] <= x[0][-1] - 0.5 * _OVER)
        t, current = own[0][inside], own[1][inside]
        v = (np.interp(t + 0.5 * _OVER, *x) - np.interp(t - 0.5 * _OVER, *x)) / _OVER
        moves = np.abs(v) > _MOVES
        if np.count_nonzero(moves) < _FEWEST:
            continue
        v, mean = v[moves], _mean_over(t, current)[moves]
        laws = np.column_stack([feed_forward(tables) * v, np.sign(v), np.ones(v.size)])
        found, _, rank, _ = np.linalg.lstsq(laws, mean, rcond=None)
        left = float(np.std(mean - laws @ found))
        if rank < laws.shape[1] or found[0] == 0.0 or left > np.sqrt(1.0 - _FOLLOWS**2) * float(np.std(mean)):
            continue
        gain = 1.0 / float(found[0])
        gain = float(np.sign(gain)) if abs(abs(gain) - 1.0) < 2.0 * _VALVE else _usual(gain)
        zero = float(f"{-gain * found[2]:.2g}")
        zero = zero if abs(zero) > _NULL else 0.0
        return None if gain == 1.0 and zero == 0.0 else (_written("i_cmd", gain, zero), f"the rate of {peer}")
    return None


def _usual(gain: float) -> float:
    """The nearest gain that people choose, where it is as good; else two digits."""
    near = _ROUND * 10.0 ** np.floor(np.log10(abs(gain)))
    best = float(near[np.argmin(np.abs(np.log(near / abs(gain))))])
    best = best if abs(best / abs(gain) - 1.0) < _VALVE else abs(gain)
    return float(np.sign(gain)) * float(f"{best:.2g}")


def _mean_over(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The mean of what is sampled within `_OVER` around each time."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    first, last = np.searchsorted(t, t - 0.5 * _OVER), np.searchsorted(t, t + 0.5 * _OVER, side="right")
    return np.asarray((total[last] - total[first]) / (last - first))


def _peers(signal: str, channels: Mapping[str, Samples], tables: Files) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """What the signal must follow, in its unit: names, t (s), values."""
    out = [(n, *channels[n]) for n in _PEERS.get(signal, ()) if n in channels]
    speed = next(((n, *channels[n]) for n in ("n_r", "n_dem") if n in channels), None)
    if signal in ("x_dem", "x_lvdt") and speed is not None:
        out.append(("the schedule", speed[1], np.interp(speed[2], *mean_stroke(tables))))
    if signal in VANES and speed is not None:
        planned = planned_angles(speed[2], tables)
        if signal in planned:
            out.append(("the schedule", speed[1], planned[signal]))
    return out
