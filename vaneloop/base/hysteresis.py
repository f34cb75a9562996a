"""Hysteresis as a sum of stops (elastic-plastic elements; Prandtl 1928, Ishlinskii 1944): what runs, in a loop as on a
log.

A stop follows its channel up to its radius and then slips. The radii are fixed, closer the smaller, since most of a
hysteresis slips early; so the sum is known by its virgin curve, which is what it makes of a channel that first leaves
rest.
"""

from __future__ import annotations

import numpy as np

from vaneloop.base.compiled import compiled, in_place

__all__ = ["RADII", "STOPS", "slip", "slipped", "stops_of", "weights_of"]

STOPS = "stops_of_"  # a quantity STOPS + CHANNEL is a hysteresis of that channel
RADII = 64  # stops of a hysteresis
AT_ONCE = 8  # samples whose sums over the stops run side by side


def stops_of(name: str) -> str:
    """Channel of a quantity ``stops_of_CHANNEL``; "": it is none."""
    return name[len(STOPS) :] if name.startswith(STOPS) else ""


def weights_of(low: float, high: float, table: np.ndarray, count: int = RADII) -> np.ndarray:
    """Weights of ``count`` stops, the widest of radius ``high``, that a virgin curve is made of: even points from
    ``low`` to ``high``, its first axis.
    """
    radii = high * np.linspace(0.0, 1.0, count + 1) ** 2
    x = np.linspace(low, high, len(table))
    curves = table.reshape(len(table), -1).T
    slopes = np.diff([np.interp(radii, x, y) for y in curves]) / np.diff(radii)
    weights = slopes - np.column_stack([slopes[:, 1:], np.zeros(len(slopes))])
    return np.asarray(weights.T.reshape(count, *table.shape[1:]))


@in_place
def slip(s: np.ndarray, first: int, j: int, move: float, p: np.ndarray, weights: int, high: float) -> float:
    """Move the stops s[first + i, j] after their channel by ``move``; return their sum with weights p[weights + i, j].

    high  radius of the widest, in the channel's unit
    """
    total = 0.0
    for i in range(RADII):
        share = (i + 1.0) / RADII
        radius = high * share * share
        at = min(max(s[first + i, j] + move, -radius), radius)
        s[first + i, j] = at
        total += p[weights + i, j] * at
    return total


@compiled
def slipped(q: np.ndarray, high: float, weights: np.ndarray) -> np.ndarray:
    """What stops of these ``weights`` make of a channel ``q`` that starts at rest; float64[samples].

    Bit for bit the sums of `slip`, those of `AT_ONCE` samples side by side: one alone would wait for each addition.
    """
    out, radii = np.zeros(len(q)), np.empty(RADII)
    for i in range(RADII):
        share = (i + 1.0) / RADII
        radii[i] = high * share * share
    s, gives, total = np.zeros(RADII), np.zeros((AT_ONCE, RADII)), np.empty(AT_ONCE)
    for first in range(1, len(q), AT_ONCE):
        many = min(AT_ONCE, len(q) - first)
        for k in range(many):
            move = q[first + k] - q[first + k - 1]
            for i in range(RADII):
                at = min(max(s[i] + move, -radii[i]), radii[i])
                s[i] = at
                gives[k, i] = weights[i] * at
        total[:] = 0.0
        for i in range(RADII):
            for k in range(AT_ONCE):
                total[k] += gives[k, i]
        out[first : first + many] = total[:many]
    return out
