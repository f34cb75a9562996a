"""How far a name can be trusted: the probability that the law which is missing is the one named or among its rivals.

The search's own shares say which of the laws *that it tried* explains the log best. They cannot say how often none of
them is it. That is learnt from blind answers (`benchmarks/hidden_effect.py`, `hidden_law.py`), by a logistic
regression (Platt 1999) on what an answer shows of itself:

| term | a name is doubted |
|---|---|
| log of the error left, in noise floors (the worst output of the stage) | the more is left |
| log of the error without it over the error with it | the less it does |
| the share that the named law and its rivals have of all that were tried | where others come close |

`python -m benchmarks.trust` fits and judges it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

__all__ = ["COEFFICIENTS", "Evidence", "terms", "trust"]

Evidence = Mapping[str, float]  # left, fall, share: see `terms`

# Constant, left, fall, share; by the criterion that named the law. Fitted to the names of development seeds: 37 of 60
# logs of hidden_effect (seed 7), 73 of 117 diagnoses of hidden_law (seeds 1 and 2). With so few, the vane chain's names
# differ by nothing yet: nine in ten are right.
COEFFICIENTS: dict[str, tuple[float, float, float, float]] = {
    "noise_floor": (1.99, -0.01, 0.05, 0.0),
    "error_share": (0.57, -0.93, 1.23, 0.23),
}
MOST_LEFT, MOST_FALL = 100.0, 30.0  # beyond what blind answers have shown, more says no more


def terms(evidence: Evidence) -> tuple[float, float, float, float]:
    """The regression's terms of one answer.

    left   error that the stage's best model leaves on its worst output, noise floors
    fall   error of the model without the law over the error with it
    share  of all that was tried in its place, what the law and its rivals have, 0 to 1
    """
    left, fall = (float(np.clip(evidence[k], 1.0, most)) for k, most in (("left", MOST_LEFT), ("fall", MOST_FALL)))
    return 1.0, float(np.log(left)), float(np.log(fall)), float(np.clip(evidence["share"], 0.0, 1.0)) - 1.0


def trust(criterion: str, evidence: Evidence) -> float:
    """Probability that what is missing is the law named, or one of its rivals."""
    score = sum(b * x for b, x in zip(COEFFICIENTS[criterion], terms(evidence), strict=True))
    return float(1.0 / (1.0 + np.exp(-score)))
