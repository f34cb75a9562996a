"""Held-out errors of curves, and the samples at which they say something.

A curve stays level beyond the values that it was fitted to. Where a block alone reaches an end of its quantity's range,
the curve without that block is held there against what it never saw, and the same holds for a log that goes further
than the fitted ones: what is counted is how a level end suits the law, not whether the law is this curve. So curves are
compared over samples where each of them was told something by other blocks, all over the same samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vaneloop.discrepancy.fit import Fit, Judge
from vaneloop.discrepancy.stage import Array

__all__ = ["Blocks", "at_samples", "held_out", "surely_more", "told_by_others", "with_held_out"]

SURELY = 3.0  # standard errors of a sum over blocks
Blocks = tuple[Array, Array, Array]  # sum of squares, gradient and normal matrix of each block, as `Fit` has them


def told_by_others(q: Array, start: Array) -> Array:
    """Of a quantity's samples, those at which it is between the least and the greatest value of the other blocks;
    ``start``: first sample of each block.
    """
    if len(start) < 2:
        return np.ones(len(q), dtype=bool)
    many = np.diff(np.append(start, len(q)))
    low, high = np.minimum.reduceat(q, start), np.maximum.reduceat(q, start)
    least, greatest = np.sort(low)[:2], np.sort(high)[-2:]
    others_low = np.where(np.arange(len(low)) == np.argmin(low), least[1], least[0])
    others_high = np.where(np.arange(len(high)) == np.argmax(high), greatest[0], greatest[1])
    return np.asarray((q >= np.repeat(others_low, many)) & (q <= np.repeat(others_high, many)))


def surely_more(by: Array) -> bool:
    """Whether what the error of a fit is more ``by``, block by block, than another's is no chance of the blocks."""
    return bool(by.sum() > SURELY * np.sqrt(len(by) * np.var(by, ddof=1)) > 0.0)


def at_samples(values: Sequence[float] | Array, n: int) -> Array | None:
    """A quantity's values at the ``n`` samples that a stage is judged on; None where they are others."""
    some = np.asarray(values, dtype=float)
    some = some[:: max(1, round(len(some) / n))][:n]
    return some if len(some) == n and bool(np.isfinite(some).all()) else None


def held_out(
    cost: Array, gradients: Array, normals: Array, mine: Array, prior: Array, deviation: Array,
    judged: Blocks | None = None,
) -> Array:  # fmt: skip
    """Cost of each block with a curve's parameters (``mine``, of all free ones) fitted to the other blocks, within its
    prior. All in the parameters' scales.

    judged  of those samples of each block that count (default: of all)
    """
    cost, counted, bends = judged or (cost, gradients, normals)
    g, a = gradients[:, mine], normals[:, mine][:, :, mine]
    p = prior[mine]
    pull = g.sum(axis=0) - p * deviation[mine]
    total = a.sum(axis=0) + np.diag(p + 1e-9 * np.maximum(np.diag(a.sum(axis=0)), 1e-12))
    step = np.linalg.solve(total - a, (pull - g)[:, :, None])[:, :, 0]
    out = cost - 2.0 * np.sum(step * counted[:, mine], axis=1)
    out += np.einsum("bi,bij,bj->b", step, bends[:, mine][:, :, mine], step)
    return np.asarray(np.maximum(out, 0.5 * cost))


def with_held_out(judge: Judge, fit: Fit, judged: Blocks | None = None) -> Fit:
    """The fit with the held-out errors of its curves within their priors; ``judged``: of samples that count."""
    cost = (judged or (fit.cost,))[0]
    scale = judge.scale[fit.free]
    mine = fit.free >= len(judge.stage.parameters)
    if not mine.any():
        return replace(fit, held_out=cost) if judged else fit
    deviation = (fit.theta - judge.stage.neutral())[fit.free] / scale
    # what a bound holds stays there, whatever block is left out
    low, high = (b[fit.free] for b in judge.bounds())
    pull = fit.gradients.sum(axis=0) - fit.prior * scale**2 * deviation
    at = fit.theta[fit.free]
    mine &= ~((at <= low) & (pull < 0.0) | (at >= high) & (pull > 0.0))
    if not mine.any():
        return replace(fit, held_out=cost) if judged else fit
    held = held_out(fit.cost, fit.gradients, fit.normals, mine, fit.prior * scale**2, deviation, judged)
    return replace(fit, held_out=held)
