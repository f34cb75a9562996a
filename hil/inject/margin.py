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

from hil.inject.scenario import OF_CHANNELS, Expect, Scenario
from hil.inject.verdict import Facts, Outcome, facts_of
from vaneloop.base.signals import SIDES

__all__ = ["Margin", "margin_of", "margins", "without_distance"]

_TICK = 1e-3  # s
_UNITS = {
    **dict.fromkeys(OF_CHANNELS, "-"), "x_dem": "mm", "x_lvdt": "mm", "i_cmd": "mA", "n_dem": "%", "n_r": "%",
    **dict.fromkeys((*SIDES, "x_select_a", "x_select_b"), "mm"), **dict.fromkeys(("i_a", "i_b", "i_coils"), "mA"),
    **dict.fromkeys(("link_age_a", "link_age_b"), "ms"),
}  # fmt: skip
_BROKEN = 1e-9  # a claim that is broken has a share below zero, also where its distance rounds to nothing


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
        facts = facts_of(scenario.expect[i], outcome.trace) if i < claims else None
        if facts is None:
            out.append(without_distance(check.expected, check.held))
        else:
            out.append(margin_of(scenario.expect[i], facts, check.held))
    return out


def margin_of(claim: Expect, facts: Facts, held: bool) -> Margin:
    """Margin of a claim with its verdict."""
    return _margin(claim.words, held, *_distance(claim, facts, held))


def without_distance(expected: str, held: bool) -> Margin:
    """Margin of what is always demanded: broken or not."""
    return _margin(expected, held, np.nan, "", 1.0)


def _margin(expected: str, held: bool, value: float, unit: str, whole: float) -> Margin:
    """The margin with the sign that its verdict has: times are seen in ticks, and verdicts allow rounding."""
    share = float(np.clip(value / whole, -1.0, 1.0)) if whole > 0.0 else np.nan
    if held:
        return Margin(expected, True, max(value, 0.0), unit, max(share, 0.0)) if np.isfinite(share) else Margin(
            expected, True, np.nan, unit, np.nan
        )  # fmt: skip
    if not np.isfinite(share):
        return Margin(expected, False, np.nan, unit, -1.0)
    return Margin(expected, False, min(value, 0.0), unit, min(share, -_BROKEN))


def _distance(claim: Expect, facts: Facts, held: bool) -> tuple[float, str, float]:
    """Distance, its unit, and what it is a share of; NaN: nothing measures it."""
    if claim.at is not None:
        return claim.tolerance - facts.nearest if np.isfinite(facts.nearest) else np.nan, "s", claim.tolerance
    if claim.by is not None:
        if np.isfinite(facts.first):
            return claim.by - facts.first, "s", claim.by - claim.after
        return (facts.best, *_band(claim)) if claim.signal else (np.nan, "s", 1.0)
    if claim.signal and not claim.never:
        return facts.worst, *_band(claim)
    begin = claim.during[0] if claim.during else 0.0
    if not held:
        return -facts.broken * _TICK, "s", (claim.during[1] if claim.during else (facts.seen - 1) * _TICK) - begin
    if claim.never or not np.isfinite(facts.last):
        return np.nan, "s", 1.0
    return begin - facts.last - _TICK, "s", begin


def _band(claim: Expect) -> tuple[str, float]:
    """Unit of a signal, and what its distance is a share of: half of its band, or its limit."""
    low = -np.inf if claim.low is None else claim.low
    high = np.inf if claim.high is None else claim.high
    whole = 0.5 * (high - low) if np.isfinite([low, high]).all() else abs(low if np.isfinite(low) else high)
    return _UNITS.get(str(claim.signal), "deg"), whole or 1.0
