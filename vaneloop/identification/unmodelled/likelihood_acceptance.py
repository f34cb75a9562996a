"""Curves where the error is hardly more than a noise that is known: there a log-likelihood tells what a share of the
error cannot.

A law may move an output by 2 % of its noise and be beyond doubt over 30,000 samples. So where a stage comes near its
noise floor errors are compared in nats (`identification.selection.likelihood_acceptance`), as laws of the library are
there. All limits in log error then stand for as many nats as `RIVAL` does, which is `rival_nats`. A curve must gain
what a law of the library must, by as much more as it has more numbers: that is more than the number of candidates asks.
And samples that nothing was fitted to must say so by themselves.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.selection.likelihood_acceptance import (
    LikelihoodAcceptance,
    correlation_of,
    gain,
    rival_nats,
)
from vaneloop.identification.settings import LEAST_SHARE, NATS, RIVAL, SPREADS
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.fitted_candidate import CandidateSource

__all__ = ["above_the_noise", "earns", "grain_of", "in_grains", "promises", "unconfirmed"]


def above_the_noise(judge: LeastSquaresProblem, fit: Fit) -> bool:
    """Whether a fit's error is more than its noise, as well as that is known."""
    criterion = LikelihoodAcceptance(judge)
    criterion.learn(fit)
    return criterion.fails(fit)


def grain_of(judge: LeastSquaresProblem, fit: Fit) -> float:
    """Log error that counts as much as 1 does far from the noise, where the best model is ``fit`` of ``judge``."""
    correlation = correlation_of(judge, fit)
    nats = rival_nats(judge, float(fit.held_out.sum()), correlation)
    return min(1.0, nats * correlation / max(judge.n, 1) / RIVAL)


def in_grains(ground: CandidateSource, grain: float, judges: Iterable[LeastSquaresProblem]) -> None:
    """Compare the errors of a ground's stages, and those of these judges, in ``grain`` from now on."""
    ground.in_grains(grain)
    for judge in judges:
        judge.stage.grain = grain


def promises(bare: float, best: float) -> bool:
    """Whether a step with the best candidate gains what a law must; ``bare``, ``best``: sums of squares left by a step
    of the model's own parameters, and by that one.
    """
    return bare - best > 2.0 * NATS


def earns(judge: LeastSquaresProblem, before: Fit, after: Fit, correlation: float) -> bool:
    """Whether a curve gains enough nats on held-out blocks; ``correlation`` of the errors that it leaves."""
    fall, excess = before.held_out.sum() - after.held_out.sum(), before.held_out.sum() - judge.n
    extra = max(len(after.free) - len(before.free), 1)
    return fall > LEAST_SHARE * excess and gain(judge, before, after, correlation)[0] > NATS + extra - 1


def unconfirmed(before: Mapping[str, Array], after: Mapping[str, Array], tests: frozenset[str]) -> str:
    """Why a curve is not believed, by the errors of all samples, log by log, in noise floors; "": it is.

    tests  logs that nothing was fitted to
    """
    was, now = ({log: float(np.nansum(e * e)) for log, e in errors.items()} for errors in (before, after))
    many = {log: int(np.isfinite(e).sum()) for log, e in after.items()}
    for log in sorted(tests & set(now)):
        nats = 0.5 * (was[log] - now[log])
        if many[log] and nats < NATS:
            return f"{log}: log-likelihood gain of {nats:.1f} only"
    n = max(sum(many.values()), 1)
    fall = (np.sqrt(sum(was.values()) / n) - np.sqrt(sum(now.values()) / n)) * np.sqrt(2.0 * n)
    return "" if fall > SPREADS else f"the error falls by {fall:.1f} standard deviations of its noise only"
