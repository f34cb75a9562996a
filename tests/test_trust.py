"""Probabilities of names: what they follow from, and that they are learnt as they should be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.trust import Name, fitted, judged, names_of
from vaneloop.identification import results as module
from vaneloop.identification import settings
from vaneloop.identification.results import trust
from vaneloop.identification.settings import TRUST_COEFFICIENTS

LEFT, FALL, SHARE = st.floats(0.5, 1e4), st.floats(0.5, 1e4), st.floats(0.0, 1.0)


@given(st.sampled_from(sorted(TRUST_COEFFICIENTS)), LEFT, LEFT, FALL, FALL, SHARE, SHARE)
def test_what_leaves_more_does_less_or_is_rivalled_is_never_trusted_more(criterion, l1, l2, f1, f2, s1, s2) -> None:
    better = {"left": min(l1, l2), "fall": max(f1, f2), "share": max(s1, s2)}
    worse = {"left": max(l1, l2), "fall": min(f1, f2), "share": min(s1, s2)}
    assert 0.0 < trust(criterion, worse) <= trust(criterion, better) < 1.0


def drawn(n: int, seed: int, truth: tuple[float, ...]) -> list[Name]:
    """Names whose truth follows the logistic law with coefficients ``truth``."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(n):
        evidence = {"left": rng.uniform(1.0, 8.0), "fall": rng.uniform(1.0, 5.0), "share": rng.uniform(0.5, 1.0)}
        p = 1.0 / (1.0 + np.exp(-float(np.dot(truth, module.terms(evidence)))))
        right = frozenset({"a"}) if rng.random() < p else frozenset[str]()
        out.append(Name("error_share", evidence, {"a": evidence["share"]}, right))
    return out


def test_coefficients_that_made_the_answers_are_found_and_judged_right(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = (2.0, -1.5, 0.8, 1.0)
    found = fitted(drawn(4000, 1, truth))
    assert np.allclose(found, truth, atol=0.35)
    monkeypatch.setitem(settings.TRUST_COEFFICIENTS, "error_share", found)
    table, brier, size, covered = judged(drawn(2000, 2, truth))
    for _, mean, _, interval in table:
        low, high = (float(v) for v in interval.split(" to "))
        assert low - 0.05 <= float(mean) <= high + 0.05
    monkeypatch.setitem(settings.TRUST_COEFFICIENTS, "error_share", (9.0, 0.0, 0.0, 0.0))  # always sure
    assert judged(drawn(2000, 2, truth))[1] > brier
    assert 1.0 <= size <= 2.0 and covered["share"] > 0.85


def test_right_names_of_a_blind_answer_are_those_hidden_or_the_same_law() -> None:
    import json

    effect = {"effect": "a.lag", "probabilities": {"a.lag": 0.6, "b.lag": 0.3}, "evidence": {}}
    row = {"answer": json.dumps({"effects": [effect]}), "truth": ["c.lag"], "named": ["a.lag"], "amounts": "[]",
           "same": json.dumps({"c.lag": ["b.lag", "c.lag"]})}  # fmt: skip
    assert names_of([row])[0].right == {"b.lag"}
    assert names_of([row | {"same": json.dumps({"c.lag": ["c.lag"]})}])[0].right == frozenset()
