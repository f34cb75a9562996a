"""How far a claim of a scenario is from being broken: a number for each, so that the worst machine can be searched for.

A verdict only says held or broken. A margin says by how much: positive while the claim holds, negative once it is
broken, in the unit of the claim and as a share, which compares claims of different units.

======================  ==============================================================  ===========================
claim                   margin                                                          share of
======================  ==============================================================  ===========================
``at``                  tolerance less the distance of the nearest change, s            the tolerance
``by``                  time left when it first came true, s; too late: how late, s     the time allowed
``during``, signal      least distance to the nearer limit, the signal's unit           half the band, or the limit
``during``, mode ...    how long before ``during`` it already held, s                   the time before ``during``
the same, broken        how long it did not hold, s                                     the time of ``during``
``never``               none while it holds; broken: how long it was seen, s            the time looked at
======================  ==============================================================  ===========================

A share lies in [-1, 1]. Where nothing measures the distance, a claim that holds has no margin (NaN).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.inject.scenario import Expect, Scenario
from hil.inject.verdict import Outcome, Trace

__all__ = ["Margin", "margins"]

_TICK = 1e-3  # s
_UNITS = {"x_dem": "mm", "x_lvdt": "mm", "i_cmd": "mA", "n_dem": "%", "n_r": "%"}
_EDGE = 1e-9  # a claim that is broken has a share below zero, also where its distance rounds to nothing


@dataclass(frozen=True)
class Margin:
    """Margin of one claim.

    expected  the claim in words, as `hil.inject.verdict.Check` has it
    held      its verdict
    value     distance in ``unit``, below zero where broken; NaN: nothing measures it
    share     the same as a share, in [-1, 1]; NaN with ``value``
    """

    expected: str
    held: bool
    value: float
    unit: str
    share: float


def margins(scenario: Scenario, outcome: Outcome) -> list[Margin]:
    """Margins of all claims that were judged, in the order of ``outcome.checks``.

    ``scenario`` has the claims that the outcome was judged by; what is always demanded has a margin only where broken.
    """
    out = []
    claims = len(scenario.expect) if len(outcome.checks) > 1 else 0  # a controller that failed: nothing else is known
    for i, check in enumerate(outcome.checks):
        if check.held is None:
            continue
        value, unit, whole = np.nan, "", 1.0
        if i < claims:
            value, unit, whole = _distance(scenario.expect[i], outcome.trace, check.held)
        out.append(_margin(check.expected, check.held, value, unit, whole))
    return out


def _margin(expected: str, held: bool, value: float, unit: str, whole: float) -> Margin:
    """The margin with the sign that its verdict has: times are seen in ticks, and verdicts allow rounding."""
    share = float(np.clip(value / whole, -1.0, 1.0)) if whole > 0.0 else np.nan
    if held:
        return Margin(expected, True, max(value, 0.0), unit, max(share, 0.0)) if np.isfinite(share) else Margin(
            expected, True, np.nan, unit, np.nan
        )  # fmt: skip
    if not np.isfinite(share):
        return Margin(expected, False, np.nan, unit, -1.0)
    return Margin(expected, False, min(value, 0.0), unit, min(share, -_EDGE))


def _distance(claim: Expect, trace: Trace, held: bool) -> tuple[float, str, float]:
    """Distance, its unit, and what it is a share of; NaN: nothing measures it."""
    truth = trace.truth(claim)
    assert truth is not None  # on lockstep everything is seen
    t, nothing = trace.t, (np.nan, "s", 1.0)
    if claim.at is not None:
        rises = t[truth & ~np.concatenate([[False], truth[:-1]])]
        if not len(rises):
            return nothing
        return claim.tolerance - float(np.min(np.abs(rises - claim.at))), "s", claim.tolerance
    if claim.by is not None:
        when = t[truth & (t >= claim.after - _EDGE)]
        if len(when):
            return claim.by - float(when[0]), "s", claim.by - claim.after
        return _to_band(claim, trace, t >= claim.after) if claim.signal else nothing
    begin, end = claim.during or (0.0, float(t[-1]))
    inside = (t >= begin - _EDGE) & (t <= end + _EDGE)
    if claim.signal and not claim.never:
        return _to_band(claim, trace, inside, nearest=False)
    broken = truth if claim.never else ~truth
    if not held:
        return -float(np.sum(broken & inside)) * _TICK, "s", end - begin
    if claim.never:
        return nothing
    earlier = t[broken & (t < begin)]
    return (begin - float(earlier[-1]) - _TICK if len(earlier) else np.nan), "s", begin


def _to_band(claim: Expect, trace: Trace, inside: np.ndarray, nearest: bool = True) -> tuple[float, str, float]:
    """Distance of a signal to its limits: of its best sample (``nearest``), or of its worst."""
    values = trace.signals[str(claim.signal)][inside]
    low = -np.inf if claim.low is None else claim.low
    high = np.inf if claim.high is None else claim.high
    both = np.isfinite([low, high]).all()
    whole = 0.5 * (high - low) if both else abs(low if np.isfinite(low) else high)
    distance = np.minimum(values - low, high - values)
    unit = _UNITS.get(str(claim.signal), "deg")
    if not len(distance) or np.isnan(distance).any():
        return np.nan, unit, 1.0
    return float(np.max(distance) if nearest else np.min(distance)), unit, whole or 1.0
