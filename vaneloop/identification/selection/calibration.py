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

from vaneloop.identification.settings import TRUST_COEFFICIENTS, TRUST_MOST_FALL, TRUST_MOST_LEFT

__all__ = ["Evidence", "terms", "trust"]

Evidence = Mapping[str, float]  # left, fall, share: see `terms`


def terms(evidence: Evidence) -> tuple[float, float, float, float]:
    """The regression's terms of one answer.

    left   error that the stage's best model leaves on its worst output, noise floors
    fall   error of the model without the law over the error with it
    share  of all that was tried in its place, what the law and its rivals have, 0 to 1
    """
    left, fall = (
        float(np.clip(evidence[k], 1.0, most)) for k, most in (("left", TRUST_MOST_LEFT), ("fall", TRUST_MOST_FALL))
    )
    return 1.0, float(np.log(left)), float(np.log(fall)), float(np.clip(evidence["share"], 0.0, 1.0)) - 1.0


def trust(criterion: str, evidence: Evidence) -> float:
    """Probability that what is missing is the law named, or one of its rivals."""
    score = sum(b * x for b, x in zip(TRUST_COEFFICIENTS[criterion], terms(evidence), strict=True))
    return float(1.0 / (1.0 + np.exp(-score)))
