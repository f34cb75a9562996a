"""How much a curve or a surface may bend: as much as its held-out error says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from vaneloop.discrepancy.models.curved import Candidate
from vaneloop.discrepancy.models.tried import Tried
from vaneloop.discrepancy.stage import Array

if TYPE_CHECKING:
    from vaneloop.discrepancy.fit import Fit
    from vaneloop.discrepancy.models.learning import Learner

__all__ = ["SCREENED", "smoothed"]

SCREENED = 1.0  # of the standard deviations of a first bend that are tried, the one with which candidates are screened


def smoothed(
    learner: Learner, current: Tried, candidate: Candidate, begin: Array | Fit, wiggles: Sequence[float],
    first: float = SCREENED,
) -> Tried:  # fmt: skip
    """A candidate fitted to the end, as smooth as suits it best: from the ``first`` of ``wiggles`` smoother, else less
    so, while that helps, each from where the last one ended.
    """
    best, at = learner._fitted(current, candidate, first, begin, 12), wiggles.index(first)
    for others in (wiggles[:at][::-1], wiggles[at + 1 :]):
        for wiggle in others if best.wiggle == first else ():
            more = learner._fitted(current, candidate, wiggle, best.fit, 12)
            if learner._score(more) >= learner._score(best):
                break
            best = more
    return best
