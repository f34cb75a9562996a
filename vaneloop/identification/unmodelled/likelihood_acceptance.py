"""Curves where the error is hardly more than a noise that is known: there a log-likelihood tells what a share of the
error cannot.

A law may move an output by 2 % of its noise and be beyond doubt over 30,000 samples. So where a stage comes near its
noise floor errors are compared in nats (`identification.selection.likelihood_acceptance`), as laws of the library are
there. All limits in log error then stand for as many nats as `RIVAL` does, which is `rival_nats`. A curve must gain
what a law of the library must, by as much more as it has more numbers: that is more than the number of candidates asks.
And samples that nothing was fitted to must say so by themselves.
"""

from __future__ import annotations

from collections.abc import Iterable

from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance, rival_nats
from vaneloop.identification.settings import NATS, RIVAL
from vaneloop.identification.unmodelled.fitted_candidate import CandidateSource

__all__ = ["above_the_noise", "grain_of", "in_grains", "promises"]


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
