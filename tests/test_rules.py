"""Acceptance rules as objects: their verdicts are the conditions, and an answer holds every one of them."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as settings_of
from hypothesis import strategies as st

from tests.conftest import examples
from vaneloop import Record, System, unknown
from vaneloop.cli import explain as command
from vaneloop.identification.least_squares.problem import Fit
from vaneloop.identification.selection import rules
from vaneloop.identification.selection.rules import RULES, Comparison, Decision, Decisions, LogChanges, Remainder
from vaneloop.identification.selection.stepwise import eliminate, stepwise
from vaneloop.identification.subsystem import Parameter
from vaneloop.pages.decisions import decision_table, explain, reasons
from vaneloop.pages.page import Page
from vaneloop.verbs.learn import learn

# docs/settings.md
LIMITS = SimpleNamespace(
    AGREE=0.05, BLOCK_SPREADS=8.0, FLAT=0.1, FLOOR_KNOWN=0.01, LEAST_FALL=0.2, LEAST_HELP=0.75, LEAST_OF_NOISE=0.1,
    LEAST_SHARE=0.15, LEFT_FLOORS=3.0, NATS=12.0, NEGATIVE_STOPS=0.2, SPREADS=3.0, TOLERATED=1.05, UNKNOWN=1.25,
)  # fmt: skip
BLOCKS = 6
LEVELS = st.lists(st.floats(0.2, 50.0), min_size=BLOCKS, max_size=BLOCKS)


def comparison(before: list[float], after: list[float], form: float = 0.0) -> Comparison:
    """Two fits with these mean squares, block by block, of 50 samples each."""
    samples = np.full(BLOCKS, 50)
    judge: Any = SimpleNamespace(n=int(samples.sum()), samples=samples, n_blocks=BLOCKS)
    none = np.zeros(0)
    fits = [
        Fit((), none, np.zeros(k, dtype=int), np.array(level) * samples, np.array(level) * samples, none, none, none,
            none, none)
        for k, level in ((2, before), (3, after))
    ]  # fmt: skip
    return Comparison(judge, fits[0], fits[1], 1.0, form)


@pytest.mark.parametrize(("was", "now", "share"), [(8.0, 2.0, 0.5), (5.0, 4.0, 0.125), (5.0, 5.0, 0.0)])
def test_what_was_predicted_badly_before_is_no_merit_of_the_new_term(was: float, now: float, share: float) -> None:
    c = comparison([8.0] * BLOCKS, [4.0] * BLOCKS)  # held out half goes
    c.before.cost[:], c.after.cost[:] = 50.0 * was, 50.0 * now  # where all blocks are fitted
    assert c.share_of_fall == pytest.approx(share)


@given(before=LEVELS, after=LEVELS)
@settings_of(max_examples=examples(60), deadline=None)
def test_against_a_known_noise_the_rules_are_the_three_conditions(before: list[float], after: list[float]) -> None:
    c = comparison(before, after)
    was, now, n = 50.0 * sum(before), 50.0 * sum(after), 50.0 * BLOCKS
    gain = 0.5 * (was - now)
    deviations = (np.sqrt(was / n) - np.sqrt(now / n)) * np.sqrt(2.0 * n)
    blocks = sorted((np.sqrt(a) - np.sqrt(b)) * np.sqrt(2.0 * 50.0) for a, b in zip(before, after, strict=True))
    local = LIMITS.SPREADS / LIMITS.BLOCK_SPREADS * np.mean(blocks[-2:])
    expected = was - now >= LIMITS.LEAST_SHARE * (was - n) and gain > LIMITS.NATS
    expected = expected and max(deviations, local) > LIMITS.SPREADS
    assert all(r.verdict(c).holds for r in rules.KNOWN_NOISE) == expected


@given(before=LEVELS, after=LEVELS, form=st.floats(0.0, 3.0))
@settings_of(max_examples=examples(60), deadline=None)
def test_against_an_unknown_noise_the_rules_are_the_three_conditions(
    before: list[float], after: list[float], form: float
) -> None:
    c = comparison(before, after, form)
    a, b = (np.maximum(level, 1.0) for level in (before, after))
    noise = float(BLOCKS)
    least = max(LIMITS.LEAST_FALL * (a.sum() - noise), LIMITS.LEAST_OF_NOISE * noise, form**2 * noise)
    flat = max(1.0, LIMITS.FLAT**2 * np.mean(before))
    r = np.log(np.maximum(before, flat) / np.maximum(after, flat))
    helps = np.maximum(r, 0.0).sum() / np.abs(r).sum() if np.abs(r).sum() > 0.0 else 0.0
    expected = a.sum() - b.sum() >= least - 1e-12 and helps >= LIMITS.LEAST_HELP
    expected = bool(expected and np.sum(r > LIMITS.AGREE) >= 2)
    assert all(rule.verdict(c).holds for rule in rules.UNKNOWN_NOISE) == expected


@given(before=LEVELS, after=LEVELS, correlation=st.floats(1.0, 6.0), form=st.floats(0.0, 3.0))
@settings_of(max_examples=examples(40), deadline=None)
def test_each_rule_of_two_fits_measures_what_it_names_in_its_unit(
    before: list[float], after: list[float], correlation: float, form: float
) -> None:
    c = replace(comparison(before, after, form), correlation=correlation)
    v = {r.name: r.verdict(c) for r in (*rules.KNOWN_NOISE, *rules.UNKNOWN_NOISE)}
    a, b = np.array(before), np.array(after)
    each, n = 50.0, 50.0 * BLOCKS
    beyond = each * a.sum() - n
    assert all(r.applies(c) for r in (*rules.KNOWN_NOISE, *rules.UNKNOWN_NOISE, rules.AWAY))
    assert v["share of the excess"].value == pytest.approx(each * (a - b).sum() / beyond if beyond > 0.0 else np.inf)
    assert v["log-likelihood gain"].value == pytest.approx(0.5 * each * (a - b).sum() / correlation)
    assert v["log-likelihood gain"].limit == LIMITS.NATS  # of the second parameter on, one more each
    more = replace(c, after=replace(c.after, free=np.arange(6)))
    assert more.further == 3 and rules.GAIN.verdict(more).limit == LIMITS.NATS + 3.0
    whole = (np.sqrt(a.mean()) - np.sqrt(b.mean())) * np.sqrt(2.0 * n / correlation)
    local = np.sort((np.sqrt(a) - np.sqrt(b)) * np.sqrt(2.0 * each / correlation))[-2:].mean()
    expected = max(whole, local * LIMITS.SPREADS / LIMITS.BLOCK_SPREADS)
    assert v["fall of the error"].value == pytest.approx(expected, abs=1e-9)
    a, b = np.maximum(a, 1.0), np.maximum(b, 1.0)  # where nobody knows the noise, no block counts for less than its own
    assert v["share of the error"].value == pytest.approx(1.0 - b.sum() / a.sum(), abs=1e-12)
    least = max(LIMITS.LEAST_FALL * (a.sum() - BLOCKS), LIMITS.LEAST_OF_NOISE * BLOCKS, form**2 * BLOCKS)
    assert v["share of the error"].limit == pytest.approx(least / a.sum())
    flat = max(1.0, LIMITS.FLAT**2 * np.mean(before))
    r = np.log(np.maximum(before, flat) / np.maximum(after, flat))
    helps = np.maximum(r, 0.0).sum() / np.abs(r).sum() if np.abs(r).sum() > 0.0 else 0.0
    assert v["share improved"].value == pytest.approx(helps)
    assert v["blocks that improve"].value == np.sum(r > LIMITS.AGREE)


@given(
    value=st.floats(-5.0, 5.0), neutral=st.floats(-1.0, 1.0), low=st.floats(0.01, 3.0), high=st.floats(0.01, 3.0),
    others=st.floats(-5.0, 5.0),
)  # fmt: skip
@settings_of(max_examples=examples(40), deadline=None)
def test_a_size_is_away_from_neutral_by_the_near_half_of_its_interval(
    value: float, neutral: float, low: float, high: float, others: float
) -> None:
    shape = Parameter("shape", 0.0, "1", -9.0, 9.0, shape=True)
    sizes = (shape, Parameter("size", neutral, "1", -9.0, 9.0))
    stage: Any = SimpleNamespace(
        index=lambda: {"known": slice(1, 2), "new": slice(2, 4)}, effect=lambda _: SimpleNamespace(parameters=sizes)
    )
    theta = np.array([1.0, 0.0, others, value])
    c = comparison([9.0] * BLOCKS, [1.0] * BLOCKS)
    after = replace(
        c.after, effects=("known", "new"), theta=theta, free=np.array([0, 1, 2, 3]),
        low=theta - np.array([0.1, 0.1, 5.0, low]), high=theta + np.array([0.1, 0.1, 5.0, high]),
    )  # fmt: skip
    judge: Any = SimpleNamespace(stage=stage, **vars(c.judge))
    away = rules.AWAY.verdict(replace(c, judge=judge, before=replace(c.before, effects=("known",)), after=after))
    near = low if neutral < value else high
    assert away.value == pytest.approx(abs(value - neutral) / near, rel=1e-6)
    if abs(abs(value - neutral) - near) > 1e-9:
        assert away.holds == (not value - low <= neutral <= value + high)


@given(before=st.lists(st.floats(0.0, 9.0), min_size=3, max_size=3), lost=st.integers(0, 3))
@settings_of(max_examples=examples(25), deadline=None)
def test_of_all_rows_each_unfitted_log_and_the_whole_must_show_the_gain(before: list[float], lost: int) -> None:
    n = 40
    rows = {log: np.full(n, rms) for log, rms in zip("fgh", before, strict=True)}
    after = {log: np.full(n, 1.0) for log in "fgh"}
    for of in (rows, after):
        of["g"][:lost] = np.nan
    r = rules.AllRows(rows, after, frozenset("gh"))
    counts = {"f": n, "g": n - lost, "h": n}
    gains = {log: 0.5 * counts[log] * (rms**2 - 1.0) for log, rms in zip("fgh", before, strict=True)}
    least, worst = min((gains[log], log) for log in "gh")
    assert r.least_gain[0] == pytest.approx(least) and gains[r.least_gain[1]] == pytest.approx(least)
    total = sum(counts.values())
    fall = (np.sqrt(sum(counts[k] * v * v for k, v in zip("fgh", before, strict=True)) / total) - 1.0) * np.sqrt(
        2.0 * total
    )
    assert r.fall == pytest.approx(fall, abs=1e-9)
    said = f"{r.least_gain[1]}: log-likelihood gain of {least:.1f} only"
    if abs(least - LIMITS.NATS) > 1e-6 and abs(fall - LIMITS.SPREADS) > 1e-6:
        if least >= LIMITS.NATS:
            said = "" if fall > LIMITS.SPREADS else f"the error falls by {fall:.1f} standard deviations"
        assert r.objection().startswith(said) and bool(r.objection()) == bool(said)
    fitted = replace(r, tests=frozenset())  # where every log was fitted, none of them is asked by itself
    assert not rules.UNFITTED_ROWS.applies(fitted) and fitted.least_gain[0] == np.inf


@given(before=st.floats(1.1, 50.0), after=st.floats(0.9, 50.0), worst=st.floats(0.9, 50.0), effects=st.integers(0, 4))
@settings_of(max_examples=examples(40), deadline=None)
def test_what_a_set_leaves_is_measured_in_squares_beyond_the_noise(
    before: float, after: float, worst: float, effects: int
) -> None:
    r = Remainder(before, after, worst, effects, 10_000)
    known = before**2 - (1.0 + LIMITS.FLOOR_KNOWN) ** 2
    assert rules.EXPLAINS_HALF.verdict(r).value == pytest.approx((before**2 - after**2) / known)
    assert rules.EXPLAINS_HALF.applies(r) == (effects > 0)
    left, output = (rule.verdict(r) for rule in rules.LEAVES_LITTLE)
    assert left.value == pytest.approx(after**2 - 1.0)
    assert left.limit == pytest.approx(LIMITS.LEAST_SHARE * (before**2 - 1.0))
    assert output.value == max(after, worst)
    assert output.limit == pytest.approx(1.0 + (LIMITS.LEFT_FLOORS - 1.0) / max(effects, 1))
    assert all(rule.applies(r) == (after > max(LIMITS.TOLERATED, 1.0 + 3.0 / np.sqrt(2.0 * 10_000))) for rule in
               rules.LEAVES_LITTLE)  # fmt: skip
    quarter = rules.LEAVES_A_QUARTER.verdict(r)
    assert quarter.value == pytest.approx(max(after**2 - 1.0, 0.0) / (before**2 - 1.0))
    assert rules.LEAVES_A_QUARTER.applies(r) == (after > LIMITS.UNKNOWN)


@pytest.mark.parametrize(
    ("rule", "after", "holds"),
    [
        ("share of the error", [81.0] * 6, False),  # a fifth of what is beyond noise
        ("share of the error", [79.0] * 6, True),
        ("blocks that improve", [95.3, 95.3, 100.0, 100.0, 100.0, 100.0], False),  # by a twentieth, in log mean square
        ("blocks that improve", [94.9, 94.9, 100.0, 100.0, 100.0, 100.0], True),
        ("blocks that improve", [50.0, 100.0, 100.0, 100.0, 100.0, 100.0], False),
        ("share improved", [100.0 * np.exp(-0.74), 100.0 * np.exp(0.26), 100.0, 100.0, 100.0, 100.0], False),
        ("share improved", [100.0 * np.exp(-0.76), 100.0 * np.exp(0.24), 100.0, 100.0, 100.0, 100.0], True),
    ],
)
def test_where_nobody_knows_the_noise_the_limits_are_these(rule: str, after: list[float], holds: bool) -> None:
    assert RULES[rule].verdict(comparison([100.0] * 6, after)).holds == holds
    assert RULES["share of the error"].verdict(comparison([1.0 + 1e-9] * 6, [0.0] * 6)).limit == pytest.approx(0.1)
    flat = comparison([10_000.0, *[1e-9] * 5], [10_000.0, *[1e-12] * 5])  # nearly perfect beside the others
    assert not flat.block_changes.any()
    # a tenth of the whole error is nearly perfect
    whole = comparison([60_000.0, *[0.0] * 5], [60_000.0, *[0.0] * 5])
    was, now = (whole._levels(f, 0.1 * 100.0) / 50.0 for f in (whole.before, whole.after))
    assert was[1:] == pytest.approx([100.0] * 5) and np.array_equal(was, now)
    c = comparison([60_000.0, 150.0, *[0.0] * 4], [60_000.0, *[0.0] * 5])
    flat_at = LIMITS.FLAT**2 * np.mean([60_000.0, 150.0, 0.0, 0.0, 0.0, 0.0])
    assert c.block_changes == pytest.approx([0.0, np.log(150.0 / flat_at), 0.0, 0.0, 0.0, 0.0])


@given(bad=st.sampled_from([np.nan, np.inf]), at=st.integers(0, BLOCKS - 1))
@settings_of(max_examples=examples(20), deadline=None)
def test_an_error_that_is_not_finite_is_never_accepted(bad: float, at: int) -> None:
    after = [1.0] * BLOCKS
    after[at] = bad
    c = comparison([40.0] * BLOCKS, after)
    for table in (rules.KNOWN_NOISE, rules.UNKNOWN_NOISE):
        assert not all(r.verdict(c).holds for r in table)
    left = Remainder(40.0, bad, bad, 1, 300)
    assert not left.is_noise and not any(r.verdict(left).holds for r in rules.LEAVES_LITTLE)


def test_a_validation_log_that_gets_worse_objects_and_says_so() -> None:
    harm = LogChanges({"a": -0.5, "b": 0.2}, frozenset("b"))
    assert harm.objection() == "makes b worse: 1.22 times the error"
    assert LogChanges({"a": -0.01}, frozenset()).objection() == "no log is better by 2% for it"
    assert LogChanges({"a": -0.5, "b": 0.05}, frozenset("b")).objection() == ""


def test_decisions_keep_the_latest_verdict_of_each_rule_on_each_pair() -> None:
    d = Decisions()
    assert not d.decide(rules.OTHER_LOGS, LogChanges({"a": 0.3}, frozenset("a")), ("x",), ())
    assert d.decide([rules.LEAVES_A_QUARTER], Remainder(10.0, 2.0, 2.0, 1), ("x",), ())
    assert d.decide(rules.OTHER_LOGS, LogChanges({"a": -0.3}, frozenset("a")), ("x",), ())
    assert not d.decide(rules.OTHER_LOGS, LogChanges({"a": 0.3}, frozenset("a")), ("x", "y"), ("x",))
    first, second = list(Decisions(list(d)))  # a search that goes on from another keeps its decisions
    assert [v.rule for v in first.verdicts] == ["validation logs", "best log", "error left"] and first.accepted
    assert second == Decision(("x", "y"), ("x",), second.verdicts) and not second.accepted


def test_every_rule_has_a_name_of_its_own_and_a_sentence_for_its_reason() -> None:
    objects = [v for v in vars(rules).values() if isinstance(v, rules.Rule)]
    tables = [r for v in vars(rules).values() if isinstance(v, tuple) for r in v if isinstance(r, rules.Rule)]
    assert {id(r) for r in (*objects, *tables)} == {id(r) for r in RULES.values()}
    assert all(r.reason[0].isupper() and r.reason.endswith(".") and r.unit for r in RULES.values())


def test_a_number_may_reach_its_limit_from_the_side_that_the_rule_allows() -> None:
    most = {
        "energy given back", "memory confirmed", "validation logs", "best log", "other subsystems", "physical range",
        "cause", "excess left", "worst output", "error left",
    }  # fmt: skip
    for rule in RULES.values():
        at = replace(rule, limit=lambda _: 1.0)
        holds = [replace(at, measure=lambda _, v=v: v).verdict(None).holds for v in (0.999, 1.0, 1.001, np.nan)]
        assert holds == ([True, True, False, False] if rule.name in most else [False, True, True, False]), rule.name
    assert [rules.CONFIRMED.verdict(rules.Confirmation(left, 0.4)).holds for left in (0.3, np.inf)] == [True, False]
    given = LIMITS.NEGATIVE_STOPS
    assert [rules.DISSIPATES.verdict(share).holds for share in (0.9 * given, 1.1 * given)] == [True, False]
    for at_bound, better in ((False, False), (True, False), (False, True)):
        within, cause = (rule.verdict(rules.Naming(at_bound, "time", better)) for rule in rules.NAMED)
        assert (within.holds, cause.holds) == (not at_bound, not better)
    assert [rules.NAMED[1].applies(rules.Naming(False, cause, False)) for cause in ("", "time")] == [False, True]


class Sums:
    """Stepwise selection on numbers: add what brings a sum nearer to a target."""

    def __init__(self, target: int, numbers: list[int]):
        self.target, self.numbers = target, numbers

    def left(self, model: tuple[int, ...]) -> int:
        return abs(self.target - sum(model))

    def wants_more(self, model: tuple[int, ...]) -> bool:
        return self.left(model) > 0

    def finalists(self, model: tuple[int, ...]) -> list[tuple[int, ...]]:
        return sorted(((*model, n) for n in self.numbers), key=self.left)

    def accepted(self, model: tuple[int, ...], tried: Any) -> list[tuple[int, ...]]:
        return [t for t in tried if self.left(t) < self.left(model)]

    def chosen(self, model: tuple[int, ...], accepted: Any) -> tuple[int, ...] | None:
        return accepted[0]

    def pruned(self, models: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
        less = lambda m: [m[:k] + m[k + 1 :] for k in range(len(m))]  # noqa: E731
        needed = lambda fewer, more: self.left(fewer) > self.left(more)  # noqa: E731
        return [*models, eliminate(models[-1], less, needed, lambda idle: idle[0])]


@given(target=st.integers(0, 60), numbers=st.lists(st.integers(1, 9), min_size=1, max_size=5))
@settings_of(max_examples=examples(50), deadline=None)
def test_a_step_never_leaves_more_and_the_last_model_needs_all_that_it_has(target: int, numbers: list[int]) -> None:
    s = Sums(target, numbers)
    models = stepwise(s, ())
    left = [s.left(m) for m in models]
    assert models[0] == () and left == sorted(left, reverse=True)
    last = models[-1]
    assert all(s.left(last[:k] + last[k + 1 :]) > s.left(last) for k in range(len(last)))
    assert not s.wants_more(last) or not s.accepted(last, s.finalists(last))


# ---- in answers ------------------------------------------------------------------------------------------------------

VALVE = System(
    "valve", "static", lambda u, p: p.g * u.lift + p.zero, inputs={"lift": "mm"}, outputs={"flow": "l/min"},
    parameters=[unknown("g", 1.5, "l/(min mm)"), unknown("zero", 0.1, "l/min")],
)  # fmt: skip


@pytest.fixture(scope="module")
def answer() -> Any:
    """A valve whose flow bends: what learn says of it."""
    rng = np.random.default_rng(4)
    t = np.arange(800) * 0.01
    lift = sum(rng.uniform(0.3, 0.6) * np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.0)) for f in (0.3, 0.7, 1.1))
    flow = 2.0 * lift + 0.5 + 3.0 * np.tanh(2.0 * lift) + 0.02 * rng.standard_normal(len(t))
    return learn([Record("bench", t, {"lift": lift, "flow": flow})], VALVE)


def test_an_answer_holds_the_verdict_of_every_rule(answer: Any) -> None:
    said = json.loads(json.dumps(answer.to_dict(), allow_nan=False))["decisions"]
    assert answer.verdict == "learned" and said
    chosen = [d for d in said if d["added"] == [answer.laws[0].name] and d["beside"] == []]
    assert len(chosen) == 1 and chosen[0]["accepted"]
    assert {"share of the error", "share improved", "blocks that improve"} <= {v["rule"] for v in chosen[0]["rules"]}
    for d in said:
        assert d["accepted"] == all(v["holds"] for v in d["rules"])
        for v in d["rules"]:
            if v["value"] is not None and v["limit"] is not None:
                at_most = RULES[v["rule"]].at_most
                assert v["holds"] == (v["value"] <= v["limit"] if at_most else v["value"] >= v["limit"])
    found = answer.diagnosed.to_dict()["decisions"]
    assert {d["stage"] for d in found} == {"valve"} and any(d["accepted"] for d in found)


def test_the_table_marks_what_was_chosen_and_the_page_folds_it(answer: Any) -> None:
    ((name, (decisions, chosen)),) = answer.explained.items()
    columns, rows = decision_table(decisions, chosen)
    assert rows[0][0] == answer.laws[0].name and rows[0][2] == "chosen"
    assert all(len(row) == len(columns) for row in rows) and columns[3:] == [r[0] for r in reasons(decisions)]
    assert all(("<" in cell or ">" in cell) <= (row[2] == "rejected") for row in rows for cell in row[3:])
    page = Page("t", "v")
    explain(page, {name: (decisions, chosen)})
    assert "<details><summary>Acceptance rules" in page.html() and "</details>" in page.html()
    assert page.html().count("<details>") == 2


def test_explain_prints_every_decision_and_the_reason_of_every_rule(
    answer: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    args = argparse.Namespace(explain=True, quiet=False, json=None)
    command.show(args, answer.explained)
    printed = " ".join(capsys.readouterr().out.split())
    decisions = answer.explained["valve"][0]
    assert f"valve: {len(decisions)} decisions of the acceptance rules" in printed
    for name, _, _, reason in reasons(decisions):
        assert name in printed and " ".join(reason.split()[:4]) in printed
    args.explain = False
    command.show(args, answer.explained)
    assert capsys.readouterr().out == ""


@given(value=st.floats(-2.0, 2.0), low=st.floats(0.01, 1.0), high=st.floats(0.01, 1.0))
@settings_of(max_examples=examples(50), deadline=None)
def test_an_effect_whose_interval_holds_its_neutral_size_is_not_there(value: float, low: float, high: float) -> None:
    """The size, not the shape: where a knee lies says nothing of whether it is there."""
    c = comparison([40.0] * BLOCKS, [1.0] * BLOCKS)
    sizes = (Parameter("size", 0.5, "1"), Parameter("knee", 0.0, "1", shape=True))
    c.judge.stage = SimpleNamespace(
        index=lambda: {"e": slice(0, 2)}, effect=lambda _: SimpleNamespace(parameters=sizes)
    )
    theta = np.array([value, 0.0])
    ends = np.array([value - low, -1.0]), np.array([value + high, 1.0])
    after = replace(c.after, effects=("e",), theta=theta, free=np.arange(2), low=ends[0], high=ends[1])
    verdict = rules.AWAY.verdict(replace(c, after=after))
    assert verdict.holds == (not value - low < 0.5 < value + high) or abs(verdict.value - 1.0) < 1e-9


def test_of_two_limits_one_that_is_reached_is_enough() -> None:
    """A saturation has two limits; one that the log never reaches stands at neutral, without an interval."""
    c = comparison([40.0] * BLOCKS, [1.0] * BLOCKS)
    limits = (Parameter("low", -15.0, "deg"), Parameter("high", np.inf, "deg"))
    effect = SimpleNamespace(parameters=limits)
    c.judge.stage = SimpleNamespace(index=lambda: {"e": slice(0, 2)}, effect=lambda _: effect)
    for high, there in ((3.78, True), (np.inf, False)):
        theta = np.array([-15.0, high])
        after = replace(c.after, effects=("e",), theta=theta, free=np.arange(2), low=theta - [0.0, 0.1], high=theta)
        assert rules.AWAY.verdict(replace(c, after=after)).holds == there
