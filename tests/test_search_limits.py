"""The numbers that decide the search, each a fifth below and a quarter above: what is named, confirmed, called unknown,
tried at all.

The documented values stand in one place, `DOCUMENTED`, and must be those of the tables in docs/methods.md. The
decisions are asked of the functions that make them, on errors made up to stand exactly where a number says; nothing is
simulated.
"""

from __future__ import annotations

import itertools
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as settings_of
from hypothesis import strategies as st
from scipy.stats import norm

from tests.conftest import ROOT, examples
from vaneloop.identification import regimes as locate
from vaneloop.identification import results as stage_answer
from vaneloop.identification import settings, workflow
from vaneloop.identification.least_squares import problem as fit
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.selection import diagnosis as diagnose
from vaneloop.identification.selection import likelihood_acceptance as noise_floor
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance
from vaneloop.identification.selection.rules import gain
from vaneloop.identification.selection.search import Search
from vaneloop.identification.subsystem import Effect, Parameter, Stage

DOCUMENTED = {
    "NATS": 12.0, "SPREADS": 3.0, "BLOCK_SPREADS": 8.0, "LEAST_SHARE": 0.15, "FLOOR_KNOWN": 0.01, "TOLERATED": 1.05,
    "LEFT_FLOORS": 3.0,
    "RIVAL_NATS": 3.0, "RIVAL_SPREADS": 0.3, "RIVAL_SHARE": 0.25,
}  # fmt: skip
BELOW, ABOVE = 0.81, 1.24  # just inside what a number wrong by a fifth or a quarter would let through
SIDES = pytest.mark.parametrize(("times", "beyond"), [(BELOW, False), (0.99, False), (1.01, True), (ABOVE, True)])


def test_the_page_documents_the_numbers_that_are_in_force():
    page = (ROOT / "docs" / "methods.md").read_text()
    found: dict[str, set[float]] = {}
    for names, values in re.findall(r"^\| ((?:`[A-Z_]+`(?:, )?)+) \| ([\d., ]+) \|", page, re.M):
        for name, value in zip(re.findall(r"`([A-Z_]+)`", names), values.split(", "), strict=True):
            found.setdefault(name, set()).add(float(value))
    for name, value in DOCUMENTED.items():
        assert found[name] == {value} and getattr(settings, name) == value, name
    for name, values in found.items():
        assert values == {getattr(settings, name)}, name


# ---- made-up errors --------------------------------------------------------------------------------------------------


def judge_of(blocks: int, each: int) -> Any:
    """What a decision asks of a `LeastSquaresProblem`: how many samples, and where."""
    return SimpleNamespace(
        n=blocks * each, samples=np.full(blocks, each), n_blocks=blocks, expected=lambda: np.ones(blocks)
    )


def fit_of(rms: Any, judge: Any, effects: tuple[str, ...] = ()) -> Fit:
    """A fit that leaves an error of ``rms`` noise floors, the same in each block or one number for each."""
    held = np.broadcast_to(np.asarray(rms, dtype=float) ** 2, judge.n_blocks) * judge.samples
    none = np.zeros(0)
    free = np.arange(len(effects))
    return Fit(effects, np.zeros(len(effects)), free, held.copy(), held.copy(), none, none, none, none, none)


def rms_after(judge: Any, nats: float) -> float:
    """Error before, where the floor is reached after a gain of so many nats."""
    return float(np.sqrt(1.0 + 2.0 * nats / judge.n))


# ---- is an effect accepted? -----------------------------------------------------------------------------------------


@SIDES
def test_an_effect_must_gain_twelve_nats(times: float, beyond: bool) -> None:
    judge = judge_of(4, 2)  # so few samples that the nats decide
    before = fit_of(rms_after(judge, 12.0 * times), judge)
    assert noise_floor.significant(judge, before, fit_of(1.0, judge, ("a",)), 1.0) == beyond


@SIDES
def test_an_effect_must_lower_the_error_by_three_spreads(times: float, beyond: bool) -> None:
    judge = judge_of(20, 100)
    before = fit_of(1.0 + 3.0 * times / np.sqrt(2.0 * judge.n), judge)
    assert noise_floor.significant(judge, before, fit_of(1.0, judge, ("a",)), 1.0) == beyond


@SIDES
def test_an_effect_that_acts_rarely_must_lower_its_two_blocks_by_eight_spreads(times: float, beyond: bool) -> None:
    judge = judge_of(400, 100)
    errors = np.ones(400)
    errors[[7, 300]] += 8.0 * times / np.sqrt(200.0)
    assert noise_floor.significant(judge, fit_of(errors, judge), fit_of(1.0, judge, ("a",)), 1.0) == beyond


@SIDES
def test_an_effect_must_explain_a_seventh_of_the_excess(times: float, beyond: bool) -> None:
    judge = judge_of(20, 10_000)
    after = fit_of(np.sqrt(1.0 + 2.0 * (1.0 - 0.15 * times)), judge, ("a",))
    assert noise_floor.significant(judge, fit_of(np.sqrt(3.0), judge), after, 1.0) == beyond


# ---- is anything missing? --------------------------------------------------------------------------------------------


@SIDES
@pytest.mark.parametrize(("blocks", "each", "edge"), [(20, 100_000, 0.01), (20, 100, 3.0 / np.sqrt(4000.0))])
def test_a_search_begins_one_per_cent_or_three_deviations_above_the_floor(
    blocks: int, each: int, edge: float, times: float, beyond: bool
) -> None:
    judge = judge_of(blocks, each)
    assert noise_floor._above_floor(judge, fit_of(1.0 + edge * times, judge), 1.0) == beyond


@SIDES
def test_a_search_begins_where_one_block_stands_eight_spreads_above_the_floor(times: float, beyond: bool) -> None:
    judge = judge_of(2000, 100)
    errors = np.ones(2000)
    errors[3] += 0.01 + 8.0 * times / np.sqrt(200.0)
    assert noise_floor._above_floor(judge, fit_of(errors, judge), 1.0) == beyond


def verdict(monkeypatch: pytest.MonkeyPatch, before: float, after: float, effects: tuple[str, ...]) -> str:
    judge = judge_of(20, 1_000_000)
    judge.stage = SimpleNamespace(name="s", outputs=("x",), units=("mm",), parameters=())
    judge.floor = np.ones(1)
    for module in (noise_floor, stage_answer):
        monkeypatch.setattr(module, "rms_per_output", lambda *_: np.ones(1))
    monkeypatch.setattr(stage_answer, "recalibrated", lambda *_: [])
    return (
        LikelihoodAcceptance(judge).conclude(fit_of(before, judge), fit_of(after, judge, effects), [], [], []).verdict
    )


@SIDES
def test_nothing_is_missing_up_to_five_per_cent_above_the_floor(
    monkeypatch: pytest.MonkeyPatch, times: float, beyond: bool
) -> None:
    rms = 1.0 + 0.05 * times
    assert verdict(monkeypatch, rms, rms, ()) == ("unknown" if beyond else "none")


@SIDES
def test_a_named_model_may_leave_a_seventh_of_the_excess(
    monkeypatch: pytest.MonkeyPatch, times: float, beyond: bool
) -> None:
    after = float(np.sqrt(1.0 + 0.15 * times * 10.0))
    assert verdict(monkeypatch, np.sqrt(11.0), after, ("a",)) == ("unknown" if beyond else "missing")


@SIDES
@pytest.mark.parametrize(("effects", "floors"), [(("a",), 3.0), (("a", "b"), 2.0), (("a", "b", "c"), 5.0 / 3.0)])
def test_a_named_model_may_leave_three_floors_and_two_effects_two(
    monkeypatch: pytest.MonkeyPatch, effects: tuple[str, ...], floors: float, times: float, beyond: bool
) -> None:
    after = 1.0 + (floors - 1.0) * times
    assert verdict(monkeypatch, 1000.0, after, effects) == ("unknown" if beyond else "missing")


# ---- does one of two beat the other? ---------------------------------------------------------------------------------


@SIDES
def test_a_rival_goes_at_odds_of_twenty_to_one(times: float, beyond: bool) -> None:
    judge = judge_of(4, 2)
    assert (
        noise_floor._worse(judge, fit_of(rms_after(judge, 3.0 * times), judge), fit_of(1.0, judge), 1.0, 0.0) == beyond
    )


@SIDES
def test_a_rival_goes_where_it_needs_three_nats_more_freedom(times: float, beyond: bool) -> None:
    judge = judge_of(4, 2)
    assert noise_floor._worse(judge, fit_of(1.0, judge), fit_of(1.0, judge), 1.0, 3.0 * times) == beyond


@SIDES
def test_a_rival_goes_for_a_third_of_a_spread_and_not_for_less(times: float, beyond: bool) -> None:
    judge = judge_of(20, 10_000)
    other = fit_of(1.0 + 0.3 * times / np.sqrt(2.0 * judge.n), judge)
    nats = gain(other, fit_of(1.0, judge), 1.0)[0]
    assert nats > 30.0
    assert noise_floor._worse(judge, other, fit_of(1.0, judge), 1.0, 0.0) == beyond


@SIDES
def test_a_rival_must_be_worse_by_a_quarter_of_what_is_left(times: float, beyond: bool) -> None:
    judge = judge_of(20, 1000)
    best = fit_of(2.0, judge)
    left = 0.5 * judge.n * (4.0 - 1.01**2)
    other = fit_of(np.sqrt(4.0 + 2.0 * 0.25 * left * times / judge.n), judge)
    assert noise_floor._worse(judge, other, best, 1.0, 0.0) == beyond


# ---- how much is tried -----------------------------------------------------------------------------------------------


class Endless:
    """A search in which every further effect helps; it notes what it was asked for."""

    asked: list[list[tuple[str, ...]]]

    def __init__(self, judge: Any):
        self.judge, self.stage, self.criterion, self.quiet, Endless.asked = (
            judge,
            judge.stage,
            LikelihoodAcceptance(judge),
            False,
            [],
        )
        self.base = self._fit(())
        self.fits: dict[frozenset[str], Fit] = {}
        self.reach = dict.fromkeys((e.name for e in judge.stage.effects), 1e9)

    def _fit(self, effects: tuple[str, ...]) -> Fit:
        return fit_of(100.0 * 0.5 ** len(effects) + 0.001 * sum(map(ord, "".join(effects))), self.judge, effects)

    def singles(self, names: list[str]) -> dict[str, Fit]:
        return {n: self._fit((n,)) for n in names}

    def best_of(self, sets: list[tuple[str, ...]]) -> list[Fit]:
        self.asked.append(list(sets))
        return [self._fit(s) for s in sets]

    def pruned(self, fit: Fit) -> Fit:
        return fit


def test_the_five_leaders_are_tried_in_pairs_and_no_more_than_four_effects_are_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    effects = tuple(Effect(c, (Parameter("size", 0.0, "1"),), ((1.0,),)) for c in "abcdefgh")
    starts = lambda: dict.fromkeys("abcdefgh", slice(0, 1))  # noqa: E731
    stage: Any = SimpleNamespace(effects=effects, effect=lambda n: SimpleNamespace(parameters=()), index=starts)
    judge = judge_of(20, 100)
    judge.stage = stage
    monkeypatch.setattr(noise_floor, "correlation_of", lambda *_: 1.0)
    search: Any = Endless(judge)
    _, current, candidates, _ = diagnose._search(search)
    assert len(current.effects) == 4
    leaders = [c.effect for c in candidates[:5]]
    beside = {frozenset((leaders[0], e.name)) for e in effects if e.name != leaders[0]}
    assert {frozenset(s) for s in Endless.asked[0]} == beside  # does another make up for what the first leaves?
    assert {frozenset(s) for s in Endless.asked[1]} == {frozenset(s) for s in itertools.combinations(leaders, 2)}


def test_the_three_leading_sets_are_finished() -> None:
    search: Any = object.__new__(Search)
    judge = judge_of(2, 10)
    search.criterion, search.fits = LikelihoodAcceptance(judge), {}
    finished = []

    def joined(effects: tuple[str, ...], whole: bool) -> Any:
        if whole:
            finished.append(effects)
        return fit_of(float(ord(effects[0])), judge, effects)

    search._joined, search.judge = joined, SimpleNamespace(together=list)
    assert len(search.best_of([(c,) for c in "fedcba"])) == 6
    assert finished == [("a",), ("b",), ("c",)]


def test_a_stage_of_sixty_thousand_samples_is_searched_on_forty_thousand_in_pieces_of_four(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert (settings.LONG_SAMPLES, settings.EXCERPT_SAMPLES, settings.EXCERPT_PIECE) == (60_000, 40_000, 4_000)
    seen = []
    monkeypatch.setattr(
        diagnose, "_whenever", lambda stage, *_: seen.append(len(stage.t)) or SimpleNamespace(verdict="unknown")
    )
    nothing = SimpleNamespace(theta=np.zeros(1))
    monkeypatch.setattr(diagnose, "_confirm", lambda *_: SimpleNamespace(verdict="none", final=nothing))

    def judge(stage: Any, *_: Any) -> Any:
        return SimpleNamespace(stage=stage, fit=lambda *_: nothing, errors=lambda _: np.ones((1, 1, len(stage.t))))

    monkeypatch.setattr(diagnose, "LeastSquaresProblem", judge)
    monkeypatch.setattr(diagnose, "recalibrate", lambda _: nothing)
    for n in (59_999, 60_000, 200_000):
        whole: Any = SimpleNamespace(t=0.01 * np.arange(n), window=1.0, coarse={}, counted=None)
        whole.excerpt = lambda at: SimpleNamespace(t=at)
        diagnose.diagnose_stage(whole, np.ones(1))
    assert seen == [59_999, 40_000, 40_000]
    at = diagnose.excerpt_of(judge(whole), nothing, 4_000, 40_000)  # type: ignore[arg-type]
    assert np.diff(np.flatnonzero(np.diff(at, prepend=-9) > 1)).min() >= 4_000


# ---- fits ------------------------------------------------------------------------------------------------------------


def straight(n: int, dt: float, noise: float = 0.1, tolerance: float = 0.0) -> Stage:
    """A stage y = a + size u with hidden a = 0; what ``run`` was asked is in ``stage.asked``."""
    t = dt * np.arange(n)
    u = np.sin(t)
    asked: list[np.ndarray] = []

    def run(thetas: np.ndarray) -> np.ndarray:
        asked.append(thetas.copy())
        return (thetas[:, :1] + thetas[:, 1:] * u)[:, None, :]

    stage = Stage(
        "line", ("y",), ("mm",), (Parameter("a", 0.0, "mm", -9.0, 9.0, tolerance),),
        (Effect("slope", (Parameter("size", 0.0, "1", -5.0, 5.0, scale=2.0),), ((1.0,),)),), run, t,
        noise * np.random.default_rng(0).standard_normal((1, n)),
    )  # fmt: skip
    stage.asked = asked  # type: ignore[attr-defined]
    return stage


@pytest.mark.parametrize(("seconds", "blocks"), [(30.0, 12), (119.0, 12), (131.0, 13), (405.0, 40), (5000.0, 60)])
def test_a_log_is_cut_into_blocks_of_ten_seconds_twelve_at_least_and_sixty_at_most(seconds: float, blocks: int) -> None:
    stage = straight(round(seconds / 0.1) + 1, 0.1)
    stage.memory = 10.0
    assert LeastSquaresProblem(stage, np.ones(1)).n_blocks == blocks


@pytest.mark.parametrize("dt", [1e-4, 0.1, 3600.0])
def test_blocks_of_a_stage_of_unknown_memory_do_not_turn_on_the_unit_of_time(dt: float) -> None:
    assert LeastSquaresProblem(straight(301, dt), np.ones(1)).n_blocks == 24


@pytest.mark.parametrize(("n", "worth"), [(150, 150), (20_000, 200)])
def test_a_log_is_worth_two_hundred_observations_at_most(n: int, worth: float) -> None:
    """Interval of a slope over a sine: 1.645 sqrt(2 / N) noises, N no more than 200."""
    found = LeastSquaresProblem(straight(n, 40.0 * np.pi / n), np.array([0.1])).fit(("slope",), np.zeros(2))
    assert found.high[0] - found.low[0] == pytest.approx(
        2.0 * 1.645 * 0.1 * np.sqrt(2.0 / worth), rel=0.07 if n > 1000 else 0.12
    )


def test_derivatives_are_taken_over_a_thousandth_of_a_parameters_scale() -> None:
    stage = straight(200, 0.1)
    judge = LeastSquaresProblem(stage, np.ones(1))
    judge.linearise(np.zeros(2), np.array([1]))
    steps = stage.asked[-1][:, 1]  # type: ignore[attr-defined]
    assert np.allclose(np.sort(steps), [0.0, 2.0 * 1e-3], rtol=1e-12)


# ---- where it fails --------------------------------------------------------------------------------------------------


def test_a_condition_has_eight_bins_of_equal_population() -> None:
    edges = locate._edges(np.random.default_rng(0).normal(size=8000))
    assert len(edges) == 9
    assert len(locate._edges(np.repeat(np.arange(8.0), 5))) == 9  # eight values: a bin each
    assert len(locate._edges(np.repeat(np.arange(9.0), 5))) == 9


def first_of_eight_bins_beyond(chance: float, correlation: float) -> Any:
    """A stage of pure noise, but for one of its eight bins, whose error so many independent samples exceed by that
    chance.
    """
    n = 500
    squares = np.ones(8 * n)
    squares[:n] = 1.0 + float(norm.isf(chance / 8)) * np.sqrt(2.0 * correlation / n)
    stage = SimpleNamespace(
        name="s", t=np.arange(8.0 * n), outputs=("y",), units=("mm",), regimes={"u": np.arange(8.0 * n)},
        regime_units={}, neutral=lambda: np.zeros(1), lost=None, raster_error=None,
    )  # fmt: skip
    white = np.sqrt(squares) * np.where(np.arange(8 * n) % 2, 1.0, -1.0)  # no neighbour is alike
    return SimpleNamespace(
        stage=stage, valid=np.ones((1, 8 * n), bool), floor=np.ones(1), errors=lambda _: white[None, None],
        lost=lambda: np.ones((1, 8 * n)), block_of=np.arange(8 * n) // 50, n_blocks=-(-8 * n // 50),
    )  # fmt: skip


AT_NOTHING: Any = SimpleNamespace(theta=np.zeros(1))


@pytest.mark.parametrize(("chance", "significant"), [(0.0108, False), (0.0092, True)])
def test_one_log_in_a_hundred_has_a_bin_called_significant_by_chance(chance: float, significant: bool) -> None:
    found = locate.regimes(first_of_eight_bins_beyond(chance, 1.0), AT_NOTHING, 1.0)[0]
    assert bool(found.significant[0]) == significant and not found.significant[1:].any()


@SIDES
def test_two_samples_count_as_one_where_bins_are_judged(
    monkeypatch: pytest.MonkeyPatch, times: float, beyond: bool
) -> None:
    monkeypatch.setattr(locate, "onset", lambda *_: None)
    monkeypatch.setattr(locate, "rms_per_output", lambda *_: np.ones(1))
    said = locate.locate(first_of_eight_bins_beyond(0.01, 2.0 * times), AT_NOTHING)
    assert said.fails == beyond


def test_a_level_that_is_noise_everywhere_is_no_matter_of_one_bin() -> None:
    """A floor of a short log is 5 % low: each bin stands above it, and none above the others."""
    judge = first_of_eight_bins_beyond(0.5, 1.0)
    rng = np.random.default_rng(3)
    e = 1.08 * rng.standard_normal((1, 1, 4000))
    judge.errors = lambda _: e
    assert not any(r.significant.any() for r in locate.regimes(judge, AT_NOTHING, 2.0))
    e[..., :500] *= 1.4  # one bin beyond the others is told all the same
    assert locate.regimes(judge, AT_NOTHING, 2.0)[0].significant[0]


@pytest.mark.parametrize(("error", "share", "significant"), [(1.9, 1.0, True), (1.4, 1.0, False), (1.4, 0.0, True)])
def test_what_the_raster_hides_is_known_to_half_of_it(error: float, share: float, significant: bool) -> None:
    """``share`` of the floor is the raster's: as far as that may be wrong, a bin does not fail."""
    judge = first_of_eight_bins_beyond(0.5, 1.0)
    judge.stage.raster_error = np.full(1, share)
    e = np.random.default_rng(3).standard_normal((1, 1, 4000))
    e[..., :500] *= error
    judge.errors = lambda _: e
    assert bool(locate.regimes(judge, AT_NOTHING, 1.0)[0].significant[0]) == significant


@given(seed=st.integers(0, 10_000), band=st.floats(0.5, 3.0))
@settings_of(max_examples=examples(30), deadline=None)
def test_a_steady_condition_is_within_the_band_and_does_not_follow_what_stays_in_it(seed: int, band: float) -> None:
    rng = np.random.default_rng(seed)
    values = np.concatenate([rng.uniform(-band, band, 200), 10.0 * np.cumsum(rng.standard_normal(100))])
    values[rng.integers(1, 300, 5)] = np.nan
    out = locate.steady(values, band)
    assert np.nanmax(np.abs(values - out)) <= band * (1.0 + 1e-12)
    assert np.ptp(out[:200]) <= band and np.isfinite(out).all()


def test_rest_is_no_condition_and_motion_is_one_as_before() -> None:
    rng = np.random.default_rng(2)
    noise = rng.standard_normal(3000)
    assert np.ptp(locate.steady(noise, 4.0)) < 1.0  # all of the noise is within the band
    moving = 100.0 * np.sin(np.arange(3000) / 100.0) + noise
    assert np.corrcoef(locate.steady(moving, 4.0), moving)[0, 1] > 0.99


@SIDES
def test_the_shape_of_what_is_left_is_told_a_tenth_above_the_floor(
    monkeypatch: pytest.MonkeyPatch, times: float, beyond: bool
) -> None:
    said = SimpleNamespace(verdict="missing", criterion="", excess=1.0 + 0.1 * times, floor=np.ones(1), final=None)
    work = workflow._Work([SimpleNamespace()])  # type: ignore[list-item]
    monkeypatch.setattr(workflow, "diagnose_stage", lambda *_, **__: said)
    monkeypatch.setattr(workflow, "floor_of", lambda *_: np.ones(1))
    monkeypatch.setattr(workflow, "LeastSquaresProblem", lambda *_: None)
    monkeypatch.setattr(workflow, "shape", lambda *_: ["a shape"])
    assert workflow._one(work, 0) == (said, ["a shape"] if beyond else [])


def test_the_limits_of_work_done_at_one_time_change_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = []
    for sets, values in ((64, 8_000_000), (2, 500)):
        monkeypatch.setattr(fit, "MAX_SETS", sets)
        monkeypatch.setattr(fit, "MAX_VALUES", values)
        judge = LeastSquaresProblem(straight(300, 0.1), np.ones(1))
        many = judge.together([judge.fitting(("slope",), np.array([0.0, s])) for s in (-1.0, 0.5, 2.0)])
        answers.append([f.theta.tolist() for f in many])
    assert answers[0] == answers[1]
