"""The first step that a candidate is ranked by: from the model's own parameters, by the slopes there, simulated."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vaneloop.discrepancy.carried import bounded_step
from vaneloop.discrepancy.fit import Fit, Judge
from vaneloop.discrepancy.promise import Slopes
from vaneloop.discrepancy.stage import Array, Effect

__all__ = ["Step", "best_step", "starts_of"]

DAMPED = (0.003, 0.03, 0.3)  # of the diagonal of the slopes' equations: their steps are simulated


class Step(NamedTuple):
    """What the best step leaves, where it leads, and what the slopes say that the boldest step leaves."""

    left: float
    theta: Array
    promised: float


def starts_of(judge: Judge, fit: Fit) -> list[tuple[Array, Slopes]]:
    """Parameters from which a candidate's step is taken, with their slopes: those of the fit; and where what is missing
    has pulled one of the model's own to a bound, those that are nominal, too.

    Far from the truth a model without what it lacks is bent out of shape, and no step brings it back.

    judge  of the samples on which candidates are ranked
    """
    starts, own, nominal = [fit.theta], len(judge.stage.parameters), fit.theta.copy()
    nominal[:own] = judge.stage.neutral()[:own]
    free = fit.free[fit.free < own]
    room = [np.abs(b - fit.theta)[free] for b in judge.bounds()]
    if np.any(np.minimum(*room) <= 1e-6 * judge.scale[free]):
        starts.append(nominal)
    return [(theta, Slopes(judge, theta, fit.free, fit.prior)) for theta in starts]


def best_step(fit: Fit, effect: Effect, judge: Judge, begin: Array, slopes: Slopes, cut_off: bool = False) -> Step:
    """The best step from ``begin`` with ``effect``, the last of the judge's stage.

    cut_off  a step beyond bounds ends there; else what a bound stops, others take over
    """
    theta = np.concatenate([begin, np.zeros(len(effect.parameters))])
    own = np.arange(len(begin), len(theta))
    moved, derivative = judge._differences(theta, own, judge.scale[own], judge.bounds()[1], slopes.error)
    rows = np.concatenate([slopes.jac, derivative(judge.errors(moved))[1]])
    _, gradients, normals = judge._blocks(slopes.error, rows)
    free = np.concatenate([fit.free, own])
    scale = judge.scale[free]
    tolerance = np.array([p.tolerance for p in effect.parameters])
    prior = np.concatenate([fit.prior, 3.0 / tolerance**2]) * scale**2
    deviation = (theta - judge.stage.neutral())[free] / scale
    a, g = normals.sum(axis=0) + np.diag(prior + 1e-9), gradients.sum(axis=0) - prior * deviation
    trials, promised = np.repeat(theta[None], len(DAMPED), axis=0), np.inf
    here = float(judge.totals(slopes.error[None], theta[None])[0])
    low, high = judge.bounds()
    for row, damping in zip(trials, DAMPED, strict=True):
        stiff, room = a + damping * np.diag(np.diag(a)), [(b - theta)[free] / scale for b in (low, high)]
        step = np.linalg.solve(stiff, g)
        if not cut_off and np.any((step < room[0]) | (step > room[1])):
            step = bounded_step(stiff, g, *room)
        row[free] = np.clip(row[free] + step * scale, low[free], high[free])
        gone = (row[free] - theta[free]) / scale
        promised = min(promised, here - 2.0 * float(g @ gone) + float(gone @ a @ gone))
    left = judge.totals(judge.errors(trials), trials)
    k = int(np.argmin(left))
    return Step(float(left[k]), trials[k], promised)
