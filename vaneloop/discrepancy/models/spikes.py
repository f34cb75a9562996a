"""Samples of a reading that jump away from their neighbours and back: a sensor or a logger that failed for a moment.

No machine does that between two samples, and one such sample can hold more of the squared error than all others do. The
noise of the others says how far is too far. What drives the model is looked at, too: where a reading jumps with an
input again and again, that is the machine.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vaneloop.discrepancy.stage import Array

__all__ = ["spikes"]

LONGEST = 3  # samples: what stays away for longer is no spike
FAR = 10.0  # times what all but 3 % of the samples stay within, of the straight line between their neighbours
BACK = 0.1  # of the jump: so near to where they were before it the samples come back, and move so little beside it
JUMP = 5.0  # times what is usual from sample to sample: a jump of an input
ANSWERS = 0.25  # share of an input's jumps with a spike beside them
FEW = 0.005  # share of the samples: what is away more often is how the machine is


def spikes(y: Array, drives: Sequence[Array] = ()) -> Array:
    """Which samples of a reading are spikes, bool[samples]; NaN is none.

    drives  what drives the model, float64[samples] each
    """
    at, out = np.flatnonzero(np.isfinite(y)), np.zeros(len(y), dtype=bool)
    v = y[at]
    if len(v) < 50:
        return out
    off = np.abs(v[1:-1] - 0.5 * (v[:-2] + v[2:]))
    steps = np.abs(np.diff(v))
    usual = max(float(np.quantile(off, 0.97)), float(steps[steps > 0.0].min(initial=np.inf)))
    found = np.zeros(len(v), dtype=bool)
    for run in range(LONGEST, 0, -1):
        n = len(v) - run - 3
        first, before, after, last = (v[k : k + n] for k in (0, 1, run + 2, run + 3))
        between = np.stack([v[k : k + n] for k in range(2, run + 2)]) - 0.5 * (before + after)
        least = np.abs(between).min(axis=0)
        away = (least > FAR * usual) & (np.all(between > 0.0, axis=0) | np.all(between < 0.0, axis=0))
        for one, other in ((before, after), (first, before), (after, last)):  # what swings does not stand still there
            away &= np.abs(one - other) < BACK * least
        for k in np.flatnonzero(away):
            found[k + 2 : k + 2 + run] = True
    about = np.convolve(found, np.ones(2 * LONGEST + 1), "same") > 0.5
    for u in drives:
        moved = np.abs(np.diff(u[at], prepend=u[at][0]))
        jumps = moved > JUMP * np.median(moved)
        if about[jumps].sum() > ANSWERS * jumps.sum():  # so the machine answers to this input
            found &= np.convolve(jumps, np.ones(2 * LONGEST + 1), "same") < 0.5
    if found.mean() <= FEW:
        out[at[found]] = True
    return out
