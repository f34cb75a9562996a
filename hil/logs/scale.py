"""Gain and zero that the log itself says of a signal whose unit does not: it follows another signal, or the schedule,
as a straight line.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hil.logs.guess import Files, mean_stroke, planned_angles
from vaneloop.base.signals import UNITS
from vaneloop.base.vanes import VANES

__all__ = ["proposed_scale"]

_PEERS = {"n_dem": ("n_r",), "n_r": ("n_dem",), "x_dem": ("x_lvdt",), "x_lvdt": ("x_dem",)}
_FOLLOWS = 0.97  # correlation with the peer, at least
_FEWEST = 50  # samples
_ALIKE = 0.02  # of gain, and of the peer's reach: as good as what is stated

Samples = tuple[np.ndarray, np.ndarray]  # t (s), values


def proposed_scale(signal: str, own: Samples, channels: Mapping[str, Samples], tables: Files) -> tuple[str, str] | None:
    """The unit with gain and zero (`hil.logs.units.scale_of`) under which ``own`` numbers are the signal, and what they
    follow; None where nothing says so, or where the numbers are right as they are.

    channels  the log's other signals, in their units
    """
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
        unit = UNITS[signal]
        scaled = f"{'-' if gain == -1.0 else '' if gain == 1.0 else f'{gain:g}*'}{unit}"
        return f"{scaled}{zero:+g}" if zero else scaled, peer
    return None


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
