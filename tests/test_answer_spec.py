"""What one stage says, against numpy and closed forms: sums of a long log, effects that begin, figures of a fit; how
stages settle each other's answers.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as settings_of
from hypothesis import strategies as st
from scipy.stats import norm

from tests.conftest import examples
from vaneloop.identification import Effect, Parameter, Stage, workflow
from vaneloop.identification.chunked_residuals import Failing, Sums, failing, joined, of_whole, sums_of
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.onset import begun, change_point, onset_of, quiet_until, that_begins
from vaneloop.identification.results import (
    Found,
    StageDiagnosis,
    answer_of,
    at_bound,
    found_of,
    interval_of,
    parameters_of,
    recalibrated,
    rms_of,
    rms_per_output,
    trust,
    weigh,
)
from vaneloop.identification.selection.diagnosis import extend_stage
from vaneloop.identification.selection.rules import PROBABLE
from vaneloop.identification.settings import LIKELY
from vaneloop.identification.subsystem import Array

# docs/settings.md
AGREES, NOISE_KNOWN_TO, PIECE_BLOCKS, REGIME_LEVEL, NINETY_ONSET, ONSET_BLOCKS = 1.1, 0.05, 6, 0.01, 5.94, 2
COLOUR, SIZES_AGREE, EXPLAINED = 2.0, 0.5, 0.5

DT = 0.5  # s
FLOOR = np.array([0.1, 0.3])


def stage_on(
    t: Array, x: Array, measured: Array, names: tuple[str, ...] = ("a", "b"), outputs: tuple[str, ...] = ("y", "z"),
    **more: Any,
) -> Stage:  # fmt: skip
    """A stage linear in a gain and in its effects' sizes, of signals x, float64[1 + effects, outputs, samples]."""
    effects = tuple(Effect(c, (Parameter("size", 0.0, "1", -50.0, 50.0),), ((0.5,), (2.0,))) for c in names)
    gain = Parameter("gain", 1.0, "1", 0.0, 9.0, 0.5)
    return Stage(
        name=more.pop("name", "s"), outputs=outputs, units=("mm", "deg")[: len(outputs)], parameters=(gain,),
        effects=effects, run=lambda thetas: np.einsum("sp,pon->son", thetas, x), t=t, measured=measured,
        floor=FLOOR[: len(outputs)], **more,
    )  # fmt: skip


def two(seed: int, n: int = 240, sizes: tuple[float, ...] = (1.2, 2.0, -1.0), **more: Any) -> Stage:
    """Two outputs; effects of these sizes are in the log."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((3, 2, n))
    measured = np.einsum("p,pon->on", np.array(sizes), x) + FLOOR[:, None] * rng.standard_normal((2, n))
    return stage_on(DT * np.arange(n), x, measured, **more)


# ---- a long log, stretch by stretch ----------------------------------------------------------------------------------


def part(stage: Stage, rows: slice) -> Stage:
    """The same stage on these rows of its log."""
    run, lost = stage.run, stage.lost
    return replace(
        stage, t=stage.t[rows], measured=stage.measured[:, rows], run=lambda thetas: run(thetas)[..., rows],
        lost=None if lost is None else lost[..., rows],
    )  # fmt: skip


@given(seed=st.integers(0, 99), uneven=st.booleans(), lead=st.integers(0, 13))
@settings_of(max_examples=examples(12), deadline=None)
def test_sums_of_stretches_are_those_of_the_log_block_by_block(seed: int, uneven: bool, lead: int) -> None:
    rng = np.random.default_rng(seed)
    stage, rows, blocks = two(seed), 20, 12
    stage.measured[rng.random((2, 240)) < 0.3] = np.nan
    stage.lost = 0.2 * rng.standard_normal((5, 2, 240)) if uneven else None
    thetas = rng.standard_normal((3, 3))
    whole = sums_of(stage, FLOOR, thetas, 0, blocks, rows)
    errors = (stage.measured - stage.run(thetas)) / FLOOR[:, None]
    counted = np.isfinite(stage.measured)
    assert (whole.outputs, whole.units, whole.first, whole.uneven) == (("y", "z"), ("mm", "deg"), 0, uneven)
    for b in range(blocks):
        here = slice(rows * b, rows * (b + 1))
        assert whole.samples[:, b].tolist() == counted[:, here].sum(axis=1).tolist()
        assert whole.squares[:, :, b] == pytest.approx(np.nansum(errors[:, :, here] ** 2, axis=2))
    if uneven:  # a raster says where more is lost; the log as a whole is at its floor
        squares = np.where(counted, np.mean((stage.lost / FLOOR[:, None]) ** 2, axis=0), 0.0)
        mean = squares.sum(axis=1) / counted.sum(axis=1)
        beyond = np.where(counted, squares - mean[:, None], 0.0).reshape(2, blocks, rows).sum(axis=2)
        assert whole.expected == pytest.approx(whole.samples + beyond)
    else:
        assert np.array_equal(whole.expected, whole.samples)
    assert whole.rms() == pytest.approx(np.sqrt(np.nansum(errors**2, axis=2) / counted.sum(axis=1)))
    assert whole.total() == pytest.approx(np.sqrt(np.nansum(errors**2, axis=(1, 2)) / counted.sum()))
    # a stretch is simulated with a lead, which counts in the stretch before it
    stage.lost = None
    whole = sums_of(stage, FLOOR, thetas, 0, blocks, rows)
    cut = [
        sums_of(part(stage, slice(max(0, rows * first - lead), rows * end + lead)), FLOOR, thetas, first, end, rows)
        for first, end in ((5, 9), (0, 5), (9, 12))
    ]
    whole, *cut = (replace(s, expected=1.5 * s.expected) for s in (whole, *cut))
    again = joined(cut)
    assert again.first == 0 and [s.first for s in cut] == [5, 0, 9]
    for name in ("samples", "expected", "squares"):
        assert getattr(again, name) == pytest.approx(getattr(whole, name))
    assert joined(cut[::2]).samples == pytest.approx(whole.samples[:, 5:])  # a log may begin later


def test_a_stretch_without_an_output_has_no_samples_of_it() -> None:
    whole = sums_of(two(1), FLOOR, np.zeros((2, 3)), 0, 12, 20)
    lacking = replace(
        whole, outputs=("z",), first=12, samples=whole.samples[1:], expected=whole.expected[1:],
        squares=whole.squares[:, 1:],
    )  # fmt: skip
    both = joined([lacking, whole])
    assert both.outputs == ("y", "z") and both.samples.shape == (2, 24)
    assert both.samples[0, 12:].sum() == 0.0 and both.squares[:, 0, 12:].sum() == 0.0
    assert np.array_equal(both.squares[:, 1, 12:], whole.squares[:, 1])
    assert both.rms()[:, 0] == pytest.approx(whole.rms()[:, 0])
    nothing = replace(whole, samples=0.0 * whole.samples, squares=0.0 * whole.squares)
    assert nothing.rms().tolist() == [[0.0, 0.0]] * 2 and nothing.total().tolist() == [0.0, 0.0]


def even(pieces: int, each: float, outputs: int = 1, missing: int = 0, uneven: bool = False) -> Sums:
    """So many pieces that are exactly at the noise floor, the last less some blocks; the first parameter set is off."""
    n = np.full((outputs, PIECE_BLOCKS * pieces - missing), each)
    return Sums(
        "s", ("y", "z")[:outputs], ("mm",) * outputs, FLOOR[:outputs], 0, n, n.copy(), np.array([50.0 * n, n]), uneven
    )


@pytest.mark.parametrize("side", [0.995, 1.005])
@pytest.mark.parametrize("uneven", [False, True])
@pytest.mark.parametrize(("level", "looks", "each"), [(0.8, 1, 30.0), (1.3, 40, 25.0), (1.0, 500, 200.0)])
def test_a_piece_fails_where_all_but_its_two_worst_blocks_still_does(
    side: float, uneven: bool, level: float, looks: int, each: float
) -> None:
    sums = even(4, each, outputs=2, uneven=uneven)
    known = max(1.0, level) * ((1.0 + NOISE_KNOWN_TO) ** 2 if uneven else 1.0)
    # the mean square at which one in a hundred pieces of noise stands out
    few = 1.0 + norm.isf(REGIME_LEVEL) / np.sqrt(each * (PIECE_BLOCKS - 2) / (2.0 * COLOUR))
    all_of_them = 1.0 + norm.isf(REGIME_LEVEL / looks) / np.sqrt(each * PIECE_BLOCKS / (2.0 * COLOUR))
    limit = max(known * max(few, all_of_them), AGREES**2 * max(1.0, level))
    sums.squares[1, 1, PIECE_BLOCKS : 2 * PIECE_BLOCKS] *= side * limit
    hot, ratio = failing(sums, level, looks)
    assert hot.tolist() == [[False] * 4, [False, side > 1.0, False, False]]
    assert ratio == pytest.approx(np.array([[1.0] * 4, [1.0, np.sqrt(side * limit), 1.0, 1.0]]))


@pytest.mark.parametrize("side", [0.99, 1.01])
@pytest.mark.parametrize("level", [0.5, 1.0, 1.6])
def test_a_piece_that_fails_is_a_tenth_above_what_is_left_everywhere(side: float, level: float) -> None:
    sums = even(3, 1e6, missing=2)
    sums.squares[1, 0, -4:] *= (side * AGREES) ** 2 * max(1.0, level)
    hot, ratio = failing(sums, level, 3)
    assert hot.tolist() == [[False, False, side > 1.0]]  # of a piece that the log's end cuts, too
    assert ratio[0, 2] == pytest.approx(side * AGREES * np.sqrt(max(1.0, level)))


@pytest.mark.parametrize(("at", "fails"), [((2, 3), False), ((0, 1), False), ((4, 5), False), ((1, 4), True)])
def test_what_lasts_one_block_and_lies_across_a_border_fails_no_piece(at: tuple[int, int], fails: bool) -> None:
    sums = even(2, 1000.0)
    sums.squares[1, 0, [PIECE_BLOCKS + k for k in at]] *= 6.0
    assert failing(sums, 1.0, 2)[0].tolist() == [[False, fails]]
    sums.expected[0, [PIECE_BLOCKS + k for k in at]] *= 6.0  # where the raster makes expect it, nothing fails
    assert not failing(sums, 1.0, 2)[0].any()


def test_the_worst_blocks_are_those_farthest_above_what_is_expected() -> None:
    sums = even(1, 1000.0)
    sums.expected[0, :2] *= 9.0  # a slam, which the raster lets one expect
    sums.squares[1, 0, :2] *= 9.0
    sums.squares[1, 0, 3:5] *= 5.0
    assert not failing(sums, 1.0, 1)[0].any()
    sums.squares[1, 0, :2] *= 2.0
    assert failing(sums, 1.0, 1)[0].all()


def said(names: tuple[str, ...], verdict: str, **more: Any) -> StageDiagnosis:
    """An answer that an excerpt has given."""
    given: dict[str, Any] = {
        "stage": "s", "outputs": ("y",), "units": ("mm",), "verdict": verdict, "floor": FLOOR[:1],
        "base": None, "final": SimpleNamespace(effects=names), "error_before": np.array([9.0]),
        "error_after": np.array([9.0]), "effects": [Found(e, 1.0, {}, [], 20.0) for e in names],
        "recalibrated": [], "candidates": [], "correlation": 2.0, "criterion": "noise_floor",
    }  # fmt: skip
    return StageDiagnosis(**given | more)


def of_log(before: float, after: float) -> Sums:
    """A log on which the first parameter set leaves that many noise floors, the last that many."""
    n = np.full((1, 24), 1000.0)
    return Sums("s", ("y",), ("mm",), 2.0 * FLOOR[:1], 0, n, n.copy(), np.array([before**2 * n, after**2 * n]), False)


FAILS = Failing("s", "y", "mm", 600.0, 660.4, 0.12345, 5.4321)


def test_a_time_at_which_a_stage_fails_is_said_with_its_error() -> None:
    assert str(FAILS) == "s fails from 600 to 660 s: y is off by 0.123 mm, 5.43 noise floors"


def test_an_answer_of_an_excerpt_has_the_errors_of_the_whole_log() -> None:
    d = of_whole(said(("a", "b"), "missing"), of_log(5.0, 1.02), [])
    assert d.verdict == "missing" and [f.effect for f in d.effects] == ["a", "b"] and d.refused == []
    assert d.steps == [("nominal", pytest.approx(5.0)), ("a + b", pytest.approx(1.02))]
    assert (d.error_before[0], d.error_after[0], d.floor[0]) == pytest.approx((1.0, 0.204, 0.2))
    assert d.excess == pytest.approx(1.02)
    assert [v.rule for one in d.decisions for v in one.verdicts] == ["explained"]  # noise is left: no rule on it
    none = of_whole(said((), "none"), of_log(1.0, 1.0), [])
    assert none.verdict == "none" and none.steps == [("nominal", pytest.approx(1.0))]


@pytest.mark.parametrize(
    ("effects", "before", "after", "fails", "why"),
    [
        (("a",), 3.0, 2.5, [], ["over the whole log a explains 34% of what exceeds the noise"]),
        (("a", "b"), 3.0, 3.1, [], ["over the whole log a and b explains 0% of what exceeds the noise"]),
        (("a",), 3.0, 2.0, [], ["leaves 2 noise floors over the whole log"]),
        (("a",), 3.0, 2.0, [FAILS], [f"leaves 2 noise floors over the whole log; {FAILS}"]),
        (("a",), 5.0, 1.02, [FAILS], []),
        ((), 1.0, 1.0, [FAILS, FAILS], [f"{FAILS}; {FAILS}"]),
        ((), 1.6, 1.6, [], ["leaves 1.6 noise floors over the whole log"]),
    ],
)
def test_an_answer_that_does_not_hold_over_the_whole_log_is_unknown(
    effects: tuple[str, ...], before: float, after: float, fails: list[Failing], why: list[str]
) -> None:
    first = said(effects, "missing" if effects else "none", refused=["c: too large"], nearest=["c"])
    d = of_whole(first, of_log(before, after), fails)
    assert d.refused == ["c: too large", *why]
    if why:
        assert d.verdict == "unknown" and d.effects == [] and d.nearest == (list(effects) or ["c"])
    else:
        assert d.verdict == first.verdict and len(d.effects) == len(effects)
    for other in (replace(first, verdict="unknown"), replace(first, criterion="relative")):
        kept = of_whole(other, of_log(before, after), fails)  # there the excerpt's answer stands
        assert (kept.verdict, kept.refused) == (other.verdict, other.refused) and kept.excess == pytest.approx(after)


# ---- effects that begin ----------------------------------------------------------------------------------------------

LATE = 4.0 + DT * np.arange(400)  # s: a log's time need not begin at 0


def late_stage(x: Array) -> Stage:
    """One output, an effect a; its twin doubles it."""
    stage = stage_on(LATE, x, np.zeros((1, 400)), ("a",), ("y",), memory=10.0)
    run = stage.run
    stage.finer = lambda thetas: run(thetas) + 1.0
    stage.hidden = lambda theta: np.array([theta.sum() * len(theta)])
    stage.twins = {"a": ("time", lambda thetas: run(thetas * np.array([1.0, 2.0])))}
    return stage


def begins(seed: int, size: float, onset: float, window: float | None = None, noise: float = 1.0) -> Stage:
    """The log of `late_stage` with its effect from the onset on."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((2, 1, 400))
    stage = that_begins(late_stage)(x)
    stage.window = window
    truth = 1.1 * x[0, 0] + np.where(onset > LATE, 0.0, size * x[1, 0])
    stage.measured = (truth + noise * FLOOR[0] * rng.standard_normal(400))[None]
    return stage


@given(seed=st.integers(0, 99), onset=st.floats(-10.0, 250.0))
@settings_of(max_examples=examples(12), deadline=None)
def test_a_stage_is_without_its_effects_before_the_onset_and_with_them_behind_it(seed: int, onset: float) -> None:
    stage = begins(seed, 1.0, 50.0)
    assert [p.name for p in stage.parameters] == ["gain", "onset"]
    assert stage.parameters[-1].unit == "s" and stage.parameters[-1].limits() == (0.0, 0.0)  # no fit sets it free
    x = np.random.default_rng(seed).standard_normal((2, 1, 400))
    thetas = np.array([[1.2, onset, 0.7], [0.9, onset, 0.7], [1.2, 0.0, -3.0], [1.2, onset, 0.0]])

    def wanted(times: float) -> Array:
        acts = (thetas[:, 1:2] <= LATE) * times
        return np.asarray(thetas[:, :1] * x[0, 0] + acts * thetas[:, 2:] * x[1, 0])

    assert stage.run(thetas)[:, 0] == pytest.approx(wanted(1.0))
    assert stage.finer is not None and stage.finer(thetas)[:, 0] == pytest.approx(wanted(1.0) + 1.0)
    assert stage.twins["a"][0] == "time" and stage.twins["a"][1](thetas)[:, 0] == pytest.approx(wanted(2.0))
    assert stage.hidden is not None and stage.hidden(thetas[0]) == pytest.approx([2.0 * 1.9])
    near = begun(stage, onset)
    assert near.neutral().tolist() == [1.0, onset, 0.0] and begun(stage, None) is stage
    for at in (onset, LATE[0], LATE[0] + 0.1 * DT):
        near = begun(stage, at)
        assert onset_of(near, near.neutral()) == (at if at > LATE[0] else None)
    plain = two(seed)
    assert onset_of(plain, plain.neutral()) is None and begun(plain, 9.0).neutral().tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize("lacks", [None, "behind", "ahead"])
def test_of_a_stage_that_integrates_both_parts_of_a_window_have_the_same_mean_error(lacks: str | None) -> None:
    stage = begins(3, 1.0, 50.0, window=20.0)
    first, k, end = 80, 92, 120  # the window from 44 to 64 s, and the onset in it
    if lacks:
        stage.measured[0, first:k] = np.nan if lacks == "behind" else stage.measured[0, first:k]
        stage.measured[0, k:end] = np.nan if lacks == "ahead" else stage.measured[0, k:end]
    stage.measured[0, 85] = np.nan
    without, with_it, out = (stage.run(np.array([[1.2, at, 0.7]]))[0, 0] for at in (1e3, 0.0, LATE[k]))
    assert np.array_equal(out[:k], without[:k]) and np.array_equal(out[end:], with_it[end:])
    moved = out[k:end] - with_it[k:end]
    if lacks:
        assert not moved.any()  # nothing says where it goes on
    else:
        assert moved == pytest.approx(np.full(end - k, moved[0])) and moved[0] != 0.0
        error = stage.measured[0] - out
        assert np.nanmean(error[first:k]) == pytest.approx(np.nanmean(error[k:end]))
    assert np.array_equal(stage.run(np.array([[1.2, LATE[-1] + 9.0, 0.7]]))[0, 0], without)


@given(seed=st.integers(0, 99), at=st.integers(80, 320), window=st.sampled_from([None, 10.0, 25.0]))
@settings_of(max_examples=examples(10), deadline=None)
def test_a_change_point_leaves_the_least_squares_of_all_onsets(seed: int, at: int, window: float | None) -> None:
    stage = begins(seed, 0.4, float(LATE[at]) - 0.1, window=window)
    judge = LeastSquaresProblem(stage, FLOOR[:1])
    near = begun(stage, float(LATE[at]) - 0.1)
    fit = LeastSquaresProblem(near, FLOOR[:1]).fit(("a",), near.neutral())
    middle = 0.5 * (LATE[1:] + LATE[:-1])
    thetas = np.repeat(fit.theta[None], len(middle), axis=0)
    thetas[:, 1] = middle
    squares = np.sum(judge.errors(thetas)[:, 0] ** 2, axis=1)
    tried = np.arange(len(middle))
    if judge.window_start is not None:  # between windows, and in those next to the best of these
        between = judge.window_start[1:] - 1
        k = int(np.argmin(squares[between]))
        tried = np.union1d(between, np.arange(between[max(k - 1, 0)], between[min(k + 1, len(between) - 1)] + 1))
    for correlation in (1.0, 4.0):
        found = change_point(judge, fit, correlation)
        k = int(np.flatnonzero(middle == found.value)[0])
        assert k in tried and squares[k] == pytest.approx(squares[tried].min(), rel=1e-9)
        good = tried[squares[tried] <= squares[k] + NINETY_ONSET * correlation]
        assert found.low < middle[good[0]] and middle[good[-1]] < found.high
        # the interval ends at the next that is ruled out, or with the log
        assert found.low == (LATE[tried[tried < good[0]][-1] + 1] if np.any(tried < good[0]) else LATE[0])
        assert found.high == (LATE[tried[tried > good[-1]][0]] if np.any(tried > good[-1]) else LATE[-1])


def test_where_nothing_begins_every_onset_does_as_well() -> None:
    for window in (None, 25.0):
        stage = begins(2, 0.0, 50.0, window=window)
        fit = LeastSquaresProblem(stage, FLOOR[:1]).fit((), stage.neutral())
        found = change_point(LeastSquaresProblem(stage, FLOOR[:1]), fit, 1.0)
        assert (found.low, found.high) == (LATE[0], LATE[-1]) and LATE[0] < found.value < LATE[-1]


@pytest.mark.parametrize("size", [0.0, 0.7])
def test_a_model_is_quiet_up_to_the_block_in_which_it_begins_to_fail(size: float) -> None:
    edges = LATE[LeastSquaresProblem(begins(5, 0.0, 0.0), FLOOR[:1]).block_start]
    blocks = len(edges)
    tried: list[int] = []

    def fails(part: LeastSquaresProblem, fit: Fit) -> bool:
        tried.append(part.n)
        assert fit.effects == () and part.n == part.valid.sum()
        return rms_of(part, fit) > 1.3

    for b in range(blocks):
        stage = begins(5, size, float(edges[b]) + 0.1, noise=0.5)
        quiet = quiet_until(LeastSquaresProblem(stage, FLOOR[:1]), fails)
        if size and ONSET_BLOCKS <= b <= blocks - ONSET_BLOCKS:
            assert quiet is not None and edges[b] <= quiet <= edges[min(b + 1, blocks - 1)]
        elif b < ONSET_BLOCKS - 1 or not size:
            assert quiet is None
    assert max(tried) < 400  # the whole log is known to fail
    plain = two(5)
    assert quiet_until(LeastSquaresProblem(plain, FLOOR), fails) is None  # its effects cannot begin


# ---- figures of a fit ------------------------------------------------------------------------------------------------


@given(
    shares=st.lists(st.sampled_from([0.0, 0.2, 0.5, 1.0]), min_size=3, max_size=3),
    left=st.floats(0.5, 5.0),
    fall=st.floats(0.9, 9.0),
)
@settings_of(max_examples=examples(20), deadline=None)
def test_an_effect_and_its_rivals_share_what_a_name_can_be_trusted(
    shares: list[float], left: float, fall: float
) -> None:
    found = Found("a", 0.0, {}, ["b"], 9.0, shares=dict(zip("abc", shares, strict=True)), fall=fall)
    asked = Found("d", 0.0, {}, [], 9.0)  # of what was asked for nothing else was tried
    d = said((), "missing", effects=[found, asked], error_after=np.array([0.3, left]) * FLOOR, floor=FLOOR)
    weigh(d)
    most = max(0.3, left)
    together = shares[0] + shares[1]
    assert found.evidence == pytest.approx({"left": most, "fall": fall, "share": together})
    whole = trust("noise_floor", {"left": most, "fall": fall, "share": together})
    assert set(found.probabilities) == {"a", "b"} and found.probability == found.probabilities["a"]
    if together > 0.0:
        assert sum(found.probabilities.values()) == pytest.approx(whole)
        assert found.probability * together == pytest.approx(whole * shares[0])
    assert asked.evidence["share"] == 1.0
    assert asked.probability == pytest.approx(trust("noise_floor", {"left": most, "fall": 1.0, "share": 1.0}))


def test_the_error_of_an_output_is_its_rms_as_far_as_blocks_that_were_not_fitted_have_it() -> None:
    stage = two(7)
    stage.measured[1, 30:90] = np.nan
    judge = LeastSquaresProblem(stage, FLOOR)
    fit = judge.fit(("a",), stage.neutral())
    error = stage.measured - stage.run(fit.theta[None])[0]
    more = np.sqrt(fit.held_out.sum() / fit.cost.sum())
    assert more > 1.0
    assert rms_per_output(judge, fit) == pytest.approx(more * np.sqrt(np.nanmean(error**2, axis=1)))
    assert rms_of(judge, fit) == pytest.approx(np.sqrt(fit.held_out.sum() / np.isfinite(stage.measured).sum()))
    assert rms_of(judge, replace(fit, held_out=-fit.held_out)) == 0.0
    d = answer_of(judge, "missing", judge.fit((), stage.neutral()), fit, [], [("nominal", 9.0)])
    assert (d.stage, d.outputs, d.units, d.verdict) == ("s", ("y", "z"), ("mm", "deg"), "missing")
    assert (d.candidates, d.correlation, d.steps, d.effects) == ([], 1.0, [("nominal", 9.0)], [])
    assert d.error_after == pytest.approx(rms_per_output(judge, fit)) and d.excess == rms_of(judge, fit)
    assert d.error_before == pytest.approx(rms_per_output(judge, d.base)) and d.floor.tolist() == FLOOR.tolist()
    (found,) = found_of(judge, fit, ("a",), {"a": judge.fit((), stage.neutral())})
    assert (found.effect, found.probability, found.rivals, found.nats) == ("a", 1.0, [], 0.0)
    assert found.parameters == parameters_of(stage, fit, "a")
    assert found.fall == pytest.approx(rms_of(judge, judge.fit((), stage.neutral())) / rms_of(judge, fit))
    stage.measured[1, 1:], stage.measured[1, 0] = np.nan, 9.0  # one sample is its own mean
    judge = LeastSquaresProblem(stage, FLOOR)
    even = replace(fit, held_out=fit.cost)
    alone = rms_per_output(judge, even)[1]
    assert alone == pytest.approx(abs(9.0 - stage.run(fit.theta[None])[0, 1, 0]))
    stage.measured[1] = np.nan
    assert rms_per_output(LeastSquaresProblem(stage, FLOOR), even)[1] == 0.0


@pytest.mark.parametrize(
    ("value", "low", "high", "shape", "there"),
    [
        (5.0, -5.0, 5.0, False, True), (-5.0, -5.0, 5.0, False, True), (4.9999, -5.0, 5.0, False, False),
        (4.999999, -5.0, 5.0, False, True), (-4.999999, -5.0, 5.0, False, True), (5.0, -5.0, 5.0, True, False),
        (1.0, 1.0, 5.0, False, False), (1.0 + 3e-6, 1.0, 5.0, False, False), (9.0, -5.0, np.inf, False, False),
        (-5.0, -5.0, np.inf, False, True), (-5.0 + 1e-9, -5.0, np.inf, False, False),
    ],
)  # fmt: skip
def test_a_size_stands_at_a_bound_that_is_not_its_neutral_value(
    value: float, low: float, high: float, shape: bool, there: bool
) -> None:
    effect = Effect("e", (Parameter("free", 0.0, "1"), Parameter("p", 1.0, "1", low, high, shape=shape)), ())
    stage = stage_on(LATE, np.zeros((1, 1, 400)), np.zeros((1, 400)), (), ("y",))
    stage.effects = (Effect("other", (Parameter("q", 0.0, "1", 0.0, 1.0),), ()), effect)
    fit: Any = SimpleNamespace(theta=np.array([1.0, 1.0, 7.0, value]))
    assert at_bound(stage, fit, "e") == there and at_bound(stage, fit, "other")


def test_an_interval_ends_at_the_physical_bounds_but_not_where_a_turn_is_cut() -> None:
    fit: Any = SimpleNamespace(low=np.array([0.0, -3.0]), high=np.array([1.0, 4.0]))
    assert interval_of(Parameter("p", 0.0, "1", -2.0, 3.0), fit, 1) == (-2.0, 3.0)
    assert interval_of(Parameter("p", 0.0, "1", -9.0, 9.0), fit, 1) == (-3.0, 4.0)
    assert interval_of(Parameter("p", 0.0, "rad", -2.0, 3.0, period=5.0), fit, 1) == (-3.0, 4.0)


@pytest.mark.parametrize(
    ("value", "half", "said_so"),
    [(1.2, 0.1, False), (1.2, 0.3, None), (1.49999, 0.1, True), (0.50001, 0.1, True), (1.49, 0.1, False)],
)
def test_a_parameter_is_recalibrated_where_its_interval_leaves_what_it_was(
    value: float, half: float, said_so: bool | None
) -> None:
    stage = two(1)
    fit: Any = SimpleNamespace(
        theta=np.array([value, 8.0, 0.0]), free=np.array([0, 1]), low=np.array([value - half, 7.0]),
        high=np.array([value + half, 9.0]),
    )  # fmt: skip
    found = recalibrated(stage, fit)
    if said_so is None:
        assert found == []
    else:
        assert found == [
            {"parameter": "gain", "value": value, "low": value - half, "high": value + half, "unit": "1",
             "at_limit": said_so}
        ]  # fmt: skip


# ---- stages settle each other's answers ------------------------------------------------------------------------------

U = np.sin(0.37 * np.arange(240)) + 0.5 * np.sin(0.11 * np.arange(240))


@cache
def reading(name: str, sizes: tuple[tuple[str, float], ...], turn: float = 0.0) -> tuple[Stage, StageDiagnosis]:
    """A stage whose log holds effects of these sizes, and the answer that it gives by itself: those that are not 0.

    Effects of one letter move the output alike.
    """
    waves = {"a": U, "b": U**2, "c": np.cos(1.3 * np.arange(240))}
    names = tuple(n for n, _ in sizes)
    x = np.array([[np.ones(240)], *([waves[n[0]]] for n in names)])
    noise = FLOOR[0] * np.random.default_rng(len(name)).standard_normal(240)
    measured = 1.2 + sum(size * x[1 + i, 0] for i, (_, size) in enumerate(sizes)) + noise
    stage = stage_on(DT * np.arange(240), x, measured[None], names, ("y",), name=name)
    if turn:
        size = Parameter("size", 0.0, "rad", 0.0, turn, period=turn)
        stage.effects = tuple(replace(e, parameters=(size,)) for e in stage.effects)
    judge = LeastSquaresProblem(stage, FLOOR[:1])
    there = tuple(n for n, size in sizes if size)
    base, fit = (judge.fit(e, stage.neutral()) for e in ((), there))
    fits = {}
    for n in names:  # each in the place of what is there of its letter
        fits[n] = judge.fit(tuple(n if m[0] == n[0] else m for m in there) if there else (n,), stage.neutral())
    found = [
        Found(
            n, 0.5, parameters_of(stage, fit, n), [m for m in names if m[0] == n[0] and m != n], 30.0,
            fits={m: fits[m] for m in names if m == n or m not in there},
            shares={m: 0.4 if m[0] == n[0] else 0.1 for m in names if m == n or m not in there},
        )
        for n in there
    ]  # fmt: skip
    left = rms_of(judge, fit)
    d = StageDiagnosis(
        name, ("y",), ("mm",), "missing" if there else "none", FLOOR[:1], base, fit, rms_per_output(judge, base),
        rms_per_output(judge, fit), found, [], [], 1.0, [("nominal", rms_of(judge, base)), (" + ".join(there), left)],
        left,
    )  # fmt: skip
    return stage, d


def settled(*stages: tuple[Stage, StageDiagnosis]) -> list[StageDiagnosis]:
    results = [replace(d, effects=[replace(f) for f in d.effects]) for _, d in stages]
    workflow._agree({s.name: s for s, _ in stages}, results)
    return results


def named(d: StageDiagnosis) -> list[tuple[str, list[str]]]:
    return [(f.effect, f.rivals) for f in d.effects]


def test_an_answer_that_no_other_stage_speaks_of_is_left_as_it_is() -> None:
    one, other = reading("one", (("a", 1.0), ("a2", 0.0), ("c", 0.0))), reading("others", (("b", 1.0),))
    assert named(one[1]) == [("a", ["a2"])]
    d, _ = settled(one, other)
    assert named(d) == [("a", ["a2"])] and d.effects[0].shares == one[1].effects[0].shares
    assert d.final is one[1].final and d.steps == one[1].steps


def test_where_another_stage_is_without_it_the_rival_stays_with_its_own_fit() -> None:
    one = reading("one", (("a", 1.0), ("a2", 0.0), ("b", 0.6), ("c", 0.0)))
    assert named(one[1]) == [("a", ["a2"]), ("b", [])]
    d, other = settled(one, reading("other", (("a", 0.0), ("c", 0.0))))
    assert named(d) == [("a2", []), ("b", [])] and d.verdict == "missing" and other.effects == []
    first, second = d.effects
    assert first.shares == pytest.approx({"a2": 0.4 / 0.5, "c": 0.1 / 0.5})  # what is refuted has none
    judge = LeastSquaresProblem(one[0], FLOOR[:1])
    direct = judge.fit(("b", "a2"), one[0].neutral())
    assert set(d.final.effects) == {"a2", "b"} and d.final.theta == pytest.approx(direct.theta, abs=1e-6)
    size = first.parameters["size"]["value"]
    assert isinstance(size, float) and size == pytest.approx(1.0, abs=0.05)
    assert first.parameters == parameters_of(one[0], d.final, "a2")
    assert second.parameters == parameters_of(one[0], d.final, "b")
    assert d.excess == rms_of(judge, d.final) and np.array_equal(d.error_after, rms_per_output(judge, d.final))
    assert d.steps[0] == one[1].steps[0] and d.steps[1] == (" + ".join(d.final.effects), d.excess)
    assert d.recalibrated == recalibrated(one[0], d.final) and d.recalibrated[0]["parameter"] == "gain"


def test_what_another_stage_names_too_stays_alone() -> None:
    one = reading("one", (("a", 1.0), ("a2", 0.0)))
    d, other = settled(one, reading("other", (("a2", 1.1), ("c", 0.0))))
    assert named(d) == [("a2", [])] and named(other) == [("a2", [])]
    unknown = reading("other", (("a2", 1.1), ("c", 0.0)))
    stands = settled(one, (unknown[0], replace(unknown[1], verdict="unknown", effects=[])))[0]
    assert named(stands) == [("a", ["a2"])]  # who does not know says nothing


def test_where_all_are_contradicted_what_does_as_well_takes_the_place() -> None:
    """Of what was tried beside them, the best that no stage contradicts and that explains as much."""
    one, other = reading("one", (("a", 1.0), ("b", 0.0), ("a3", 0.0))), reading("other", (("a", 0.0), ("c", 0.0)))
    f = one[1].effects[0]
    tried = replace(one[1], effects=[replace(f, rivals=[], shares={"a": 0.4, "b": 0.3, "a3": 0.2})])
    d, _ = settled((one[0], tried), other)
    assert named(d) == [("a3", [])] and d.final.effects == ("a3",)
    assert d.effects[0].shares == pytest.approx({"b": 0.6, "a3": 0.4})
    poor = replace(one[1], effects=[replace(f, rivals=[], shares={"a": 0.4, "b": 0.3})])
    d, _ = settled((one[0], poor), other)
    assert d.verdict == "unknown" and d.effects == [] and d.nearest == ["a"]
    assert d.refused == ["a is contradicted by other"]


@pytest.mark.parametrize("side", [0.95, 1.3])
def test_a_size_agrees_within_half_of_it_where_both_stages_name_it(side: float) -> None:
    one = reading("one", (("a", 1.0),))
    for there in (1.0 + SIZES_AGREE * side, 1.0 - SIZES_AGREE * side):
        d, _ = settled(one, reading("other", (("a", there), ("c", 0.0))))
        assert (d.verdict == "missing") == (side < 1.0)
    stages = {"one": one[0], "other": reading("other", (("a", 0.0),))[0]}
    none = reading("other", (("a", 0.0),))[1]
    fit = one[1].final
    assert workflow._doubt(none, "a") == 0.0 and workflow._doubt(one[1], "a") == SIZES_AGREE
    assert not workflow._fits(stages, one[1], fit, none, "a")  # a size that is not there is no size of half
    assert workflow._fits(stages, one[1], replace(fit, low=fit.low - 1.0), none, "a")  # one that may be 0 is
    wide = replace(fit, theta=np.array([1.0, 1.0]), low=np.array([1.0, 1.0]), high=np.array([1.0, 1.0]))
    assert workflow._fits(stages, one[1], wide, none, "a", 1.0)
    assert not workflow._fits(stages, one[1], wide, none, "a", 0.9)


def test_an_angle_agrees_with_itself_a_turn_farther() -> None:
    one, other = reading("one", (("a", 2.0),), 5.0), reading("other", (("a", 2.0), ("c", 0.0)), 5.0)
    stages = {s.name: s for s, _ in (one, other)}
    for turns in (-2.0, 0.0, 1.0):
        theta = one[1].final.theta + np.array([0.0, 5.0 * turns])
        fit = replace(one[1].final, theta=theta, low=theta - 0.05, high=theta + 0.05)
        assert workflow._fits(stages, one[1], fit, other[1], "a")
        assert not workflow._fits(stages, one[1], replace(fit, theta=theta + 2.0, low=theta + 1.9, high=theta + 2.1),
                                  other[1], "a")  # fmt: skip


def test_a_search_that_began_anew_is_compared_by_the_floor_that_comparing_has() -> None:
    stage = two(9, sizes=(1.2, 0.0, 0.0))
    d = extend_stage(stage, ())
    before = d.error_before.copy()
    assert workflow.as_compared(stage, d) is d and np.array_equal(d.error_before, before)
    d.floor = 0.5 * FLOOR
    d.error_before, d.error_after, d.base = np.zeros(2), np.zeros(2), None  # type: ignore[assignment]
    again = workflow.as_compared(stage, d)
    assert again.error_before == pytest.approx(before) and again.error_after is again.error_before
    assert again.final is again.base
    judge = LeastSquaresProblem(stage, FLOOR)
    d.final, d.error_after = judge.fit(("a",), stage.neutral()), np.ones(2)
    assert workflow.as_compared(stage, d).error_after.tolist() == [1.0, 1.0] and d.final.effects == ("a",)


def test_an_answer_none_is_unknown_where_a_condition_fails() -> None:
    load = np.repeat(np.arange(8.0), 300)
    rng = np.random.default_rng(3)
    error = rng.standard_normal(2400) * np.where(load > 6.0, 1.25, 1.0)
    stage = stage_on(DT * np.arange(2400), np.zeros((1, 1, 2400)), FLOOR[0] * error[None], (), ("y",))
    stage.regimes, stage.regime_units = {"load": rng.permutation(8)[load.astype(int)].astype(float)}, {"load": "kN"}
    judge = LeastSquaresProblem(stage, FLOOR[:1])
    d = said((), "none", final=judge.fit((), stage.neutral()))
    again = workflow._as_located(stage, d)
    assert again.verdict == "unknown" and again.refused[0].startswith("fails at y: ") and "load" in again.refused[0]
    stage.measured = FLOOR[0] * np.sign(error)[None]
    assert workflow._as_located(stage, d) is d


@pytest.mark.parametrize(("size", "verdict"), [(1.07, "none"), (1.13, "unknown")])
def test_an_answer_unknown_is_none_where_the_stage_fits_everywhere(size: float, verdict: str) -> None:
    error = size * np.sign(np.random.default_rng(4).standard_normal(30_000))
    stage = stage_on(DT * np.arange(30_000), np.zeros((1, 1, 30_000)), FLOOR[0] * error[None], (), ("y",))
    stage.floor = FLOOR[:1]
    final = LeastSquaresProblem(stage, FLOOR[:1]).fit((), stage.neutral())
    assert workflow._as_located(stage, said((), "unknown", final=final)).verdict == verdict
    refused = said((), "unknown", final=final)
    refused.refused = ["a explains 20% of what exceeds the noise"]
    assert workflow._as_located(stage, refused) is refused


@pytest.mark.parametrize(("size", "verdict"), [(0.3, "none"), (1.0, "missing")])
def test_no_name_is_given_where_the_stage_fits_everywhere_without_it(size: float, verdict: str) -> None:
    """A size whose gain is a thousand nats, and makes 4 % of the error or 41 %."""
    n, rng = 30_000, np.random.default_rng(6)
    x = np.array([np.ones((1, n)), FLOOR[0] * rng.standard_normal((1, n))])
    measured = 1.2 + size * x[1] + FLOOR[0] * rng.standard_normal((1, n))
    stage = stage_on(DT * np.arange(n), x, measured, ("a",), ("y",))
    d, _ = workflow._one(workflow._Work([stage]), 0)
    assert d.verdict == verdict and [f.effect for f in d.effects] == ["a"] * (verdict == "missing")
    if verdict == "none":
        assert d.final is d.base and np.array_equal(d.error_after, d.error_before) and d.steps[1:] == []
        assert d.notes == ["s fits everywhere with nothing added; a would help, and is not named"]
        assert d.recalibrated == recalibrated(stage, d.base)


@pytest.mark.parametrize(
    ("left", "falls", "names"),
    [
        (1.09, (1.05, 1.05), ["a", "b"]),  # it fits with them
        (1.4, (9.0, 9.0), ["a", "b"]),
        (1.4, (9.0, 1.05), ["a"]),
        (1.4, (1.05, 1.05), []),
    ],
)
def test_where_a_stage_fails_with_its_names_an_improbable_one_goes(
    left: float, falls: tuple[float, float], names: list[str]
) -> None:
    stage = two(9)
    judge = LeastSquaresProblem(stage, FLOOR)
    base, final = (judge.fit(e, stage.neutral()) for e in ((), ("a", "b")))
    effects = [Found(e, 0.0, {}, [], 20.0, fall=f) for e, f in zip("ab", falls, strict=True)]
    d = said((), "missing", floor=FLOOR, base=base, final=final, error_after=np.array([1.0, left]) * FLOOR,
             effects=effects, steps=[("nominal", 9.0), ("a + b", left)])  # fmt: skip
    out = workflow._probable(stage, d)
    assert [f.effect for f in out.effects] == names and out.verdict == ("missing" if names else "unknown")
    assert out.final.effects == tuple(names)
    low = trust("noise_floor", {"left": left, "fall": 1.05, "share": 1.0})
    assert low < LIKELY < trust("noise_floor", {"left": left, "fall": 9.0, "share": 1.0})
    why = [f"{e} has a probability of {low:.2g}, and the subsystem fails with it" for e in "ab" if e not in names]
    if len(names) == 2:
        assert out is d
    elif names:
        alone = judge.fit(("a",), stage.neutral())
        assert out.notes == why and out.steps[-1] == ("a", out.excess)
        assert out.final.theta == pytest.approx(alone.theta, abs=1e-3)
        assert out.error_after == pytest.approx(rms_per_output(judge, alone), rel=1e-3)
        assert out.effects[0].parameters == parameters_of(stage, out.final, "a")
    else:
        assert out.refused == why and out.nearest == ["a", "b"] and out.final is base and out.steps == d.steps[:1]
    if left > 1.1:
        assert {x.rule for one in out.decisions for x in one.verdicts} == {PROBABLE.name}


@pytest.mark.parametrize(
    ("verdict", "excess", "leaves"),
    [("none", 9.0, False), ("unknown", 1.0, True), ("missing", 1.09, False), ("missing", 1.11, True)],
)
def test_words_are_asked_for_where_something_is_still_missing(verdict: str, excess: float, leaves: bool) -> None:
    assert workflow._leaves(said((), verdict, excess=excess)) == leaves
