"""Where a stage fails, and how that is said: bins and their significance against numpy and scipy, onset, shapes in
words; what all stages say together.
"""

from __future__ import annotations

from dataclasses import replace
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
from vaneloop.identification.least_squares.noise import most_floor, tolerance
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.regimes import (
    Regime,
    StageFigures,
    _edges,
    _greatest,
    _in_words,
    locate,
    onset,
    regimes,
    shape,
    stands_out,
)
from vaneloop.identification.results import Candidate, Found, StageDiagnosis
from vaneloop.identification.selection.diagnosis import extend_stage
from vaneloop.identification.subsystem import Array

# docs/settings.md
AGREES, REGIME_BINS, REGIME_LEVEL, SHORT_SEARCH, USUAL_FITS = 1.1, 8, 0.01, 10, 60.0

N = 2400
T = 3.0 + 0.05 * np.arange(N)  # s
FLOOR = 0.1


def stage_of(error: Array, regimes: dict[str, Array], window: float | None = None) -> Stage:
    """A stage with nothing to fit that leaves this error, in noise floors."""
    return Stage(
        "s", ("y",), ("mm",), (Parameter("gain", 1.0, "1"),), (), lambda thetas: np.zeros((len(thetas), 1, N)), T,
        FLOOR * error, window=window, regimes=regimes, regime_units={"load": "kN", "time": "s"},
        floor=np.array([FLOOR]),
    )  # fmt: skip


def problem(stage: Stage) -> tuple[LeastSquaresProblem, Any]:
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    return judge, judge.fit((), stage.neutral())


# ---- where -----------------------------------------------------------------------------------------------------------


@given(values=st.lists(st.integers(-4, 4), min_size=2, max_size=200), scale=st.floats(0.1, 10.0))
@settings_of(max_examples=examples(25), deadline=None)
def test_a_bin_for_each_of_few_values_or_as_many_samples_in_each(values: list[int], scale: float) -> None:
    few = np.unique(values)[:REGIME_BINS]
    v = scale * np.array([x for x in values if x in few])
    if len(np.unique(v)) > 1:
        edges = _edges(v)
        assert len(edges) == len(np.unique(v)) + 1
        assert all(edges[i] < x < edges[i + 1] for i, x in enumerate(np.unique(v)))
        assert (edges[0], edges[-1]) == pytest.approx((v.min() - 0.5, v.max() + 0.5))
    many = np.random.default_rng(len(values)).standard_normal(1000)
    edges = _edges(many)
    assert len(edges) == REGIME_BINS + 1 and edges[0] == many.min() and edges[-1] > many.max()
    assert np.histogram(many, edges)[0] == pytest.approx(np.full(REGIME_BINS, 1000 / REGIME_BINS), abs=1)
    many[: 8 * REGIME_BINS] = 0.0  # a condition that begins with one value for long has others yet
    assert len(_edges(many[: 8 * REGIME_BINS + 3])) == 5


@given(seed=st.integers(0, 999), looks=st.integers(1, 300), known=st.floats(1.0, 1.5), c=st.floats(1.0, 5.0))
@settings_of(max_examples=examples(25), deadline=None)
def test_a_bin_stands_out_by_the_normal_distribution_with_and_without_its_worst_block(
    seed: int, looks: int, known: float, c: float
) -> None:
    rng = np.random.default_rng(seed)
    n = rng.integers(0, 60, (5, 4)).astype(float)
    square, floor = n * rng.uniform(0.5, 3.0, (5, 4)), n * rng.uniform(0.5, 1.5, (5, 4))
    square[1, 2] += 2000.0  # one block is bad
    hot, samples, mean = stands_out(n, square, floor, known, looks, c)
    for b in range(5):
        rest = np.delete(np.arange(4), np.argmax(square[b] - floor[b]))
        significant = []
        for blocks, level in ((np.arange(4), REGIME_LEVEL / looks), (rest, REGIME_LEVEL)):
            m, s, f = n[b, blocks].sum(), square[b, blocks].sum(), floor[b, blocks].sum()
            z = (s / max(f, m, 1.0) / known - 1.0) * np.sqrt(max(m, 1) / (2.0 * c))
            significant.append(z > norm.isf(level))
        assert samples[b] == n[b].sum()
        assert mean[b] == pytest.approx(square[b].sum() / max(floor[b].sum(), n[b].sum(), 1.0))
        assert bool(hot[b]) == (all(significant) and n[b].sum() > 20)


def test_the_moment_of_a_bin_is_that_of_its_greatest_error() -> None:
    rng = np.random.default_rng(1)
    size, bins = rng.random(500), rng.integers(0, 6, 500)
    found = _greatest(bins, size, T[:500], 7)
    for b in range(6):
        assert found[b] == T[np.argmax(np.where(bins == b, size, -1.0))]
    assert np.isnan(found[6])


def test_the_error_under_a_condition_is_told_bin_by_bin() -> None:
    rng = np.random.default_rng(2)
    load, other = rng.uniform(0.0, 8.0, N), rng.uniform(0.0, 1.0, N)
    direction = np.sign(np.sin(T))
    error = rng.standard_normal(N) * np.where(load > 7.0, 1.6, 1.0)
    stage = stage_of(error, {"time": T, "load": load, "other": other, "direction": direction, "still": np.ones(N)})
    judge, fit = problem(stage)
    found = regimes(judge, fit, 2.0)
    assert {r.condition for r in found} == {"time", "load", "other", "direction"}  # what never changes is none
    r = found[0]
    assert (r.condition, r.condition_unit, r.output, r.unit) == ("load", "kN", "y", "mm")
    bins = np.clip(np.digitize(load, r.edges) - 1, 0, REGIME_BINS - 1)
    for b in range(REGIME_BINS):
        mine = error[bins == b]
        assert r.samples[b] == len(mine)
        assert r.ratio[b] == pytest.approx(np.sqrt(np.mean(mine**2))) and r.rms[b] == pytest.approx(FLOOR * r.ratio[b])
        assert r.moments[b] == T[np.flatnonzero(bins == b)[np.argmax(np.abs(mine))]]
    assert r.significant.tolist() == [False] * 7 + [True]
    excess = np.maximum(r.ratio**2 - 1.0, 0.0)
    share = excess / excess.sum()
    assert r.contrast == pytest.approx((np.sum(share**2) - 1.0 / 8.0) / (7.0 / 8.0)) and r.contrast > 0.5
    assert all(not of.significant.any() for of in found if of.condition in ("other", "direction"))
    edge = f"{r.edges[7]:.4g} to {r.edges[8]:.4g} kN"
    assert r.worst() == f"y: {r.rms[7]:.3g} mm ({r.ratio[7]:.3g} noise floors) at load {edge}"
    turns = next(of for of in found if of.condition == "direction")
    assert [turns.place(b) for b in range(len(turns.samples))] == ["direction negative", "direction positive"]
    at = locate(judge, fit)
    assert [h.condition for h in at.hot] == ["load"] and at.fails and at.onset is None
    (s,) = at.signals
    assert (s.rms, s.rms_as_given) == pytest.approx((FLOOR * np.sqrt(np.mean(error**2)),) * 2)
    assert (s.noise_floor, s.samples, s.ratio) == pytest.approx((FLOOR, N, s.rms / FLOOR))
    assert at.verdict() == f"fits over the whole log, fails in 1 of 4 conditions: {r.worst()}"
    assert at.json()["verdict"] == "fails" and at.json()["signals"][0]["agrees"] is True
    loud = replace(at, signals=(s, replace(s, signal="z", rms=9.0 * FLOOR)))
    assert loud.worst.signal == "z" and loud.verdict() == "fails in 1 of 4 conditions: z at 9 noise floors"
    even = replace(loud, regimes=tuple(of for of in found if of is not r))
    assert even.fails and even.verdict() == "fails in no single condition more than in others: z at 9 noise floors"
    clean = replace(even, signals=(s,))
    assert not clean.fails and clean.verdict() == "fits everywhere" and clean.json()["verdict"] == "agrees"


def test_an_error_that_is_everywhere_is_no_matter_of_one_bin_as_far_as_the_floor_may_be_wrong() -> None:
    rng = np.random.default_rng(3)
    load = rng.uniform(0.0, 8.0, N)
    error = rng.standard_normal(N)
    error *= 1.0 / np.sqrt(np.mean(error**2))

    def hot(level: float) -> bool:
        judge, fit = problem(stage_of(level * error, {"load": load}))
        return any(r.significant.any() for r in regimes(judge, fit, 2.0))

    assert most_floor(N, 2.0) == pytest.approx(1.0866, abs=1e-3)
    assert not hot(1.0) and not hot(1.06) and hot(1.5)


@pytest.mark.parametrize(
    ("at", "before", "after", "found"),
    [(0.5, 1.0, 3.0, True), (0.25, 1.0, 3.0, True), (0.5, 1.0, 1.1, False), (0.5, 3.0, 1.0, False),
     (0.5, 2.0, 6.0, False), (0.02, 1.0, 3.0, False)],
)  # fmt: skip
def test_an_onset_is_where_a_quiet_error_rises_for_good(at: float, before: float, after: float, found: bool) -> None:
    rng = np.random.default_rng(4)
    begin = int(at * N)
    error = rng.standard_normal(N) * np.where(np.arange(N) < begin, before, after)
    judge, fit = problem(stage_of(error, {"time": T}))
    when = onset(judge, fit)
    assert (when is not None) == found
    if when is not None:
        assert when == pytest.approx(T[begin], abs=0.2 * judge.memory * 5.0)
    judge.stage.measured[0, ::2] = np.nan  # every other sample lost: as much in the others
    judge.valid[0, 30:] = False
    assert onset(judge, fit) is None


# a block is a fifth of the stage's time scale, here of 10 s
BLOCK = 40


def stepped(before: float, after: float, at: int) -> tuple[LeastSquaresProblem, Any]:
    """An error whose size steps at the beginning of a block, without any scatter."""
    sizes = np.where(np.arange(N) < BLOCK * at, before, after)
    stage = stage_of(sizes * np.where(np.arange(N) % 2, 1.0, -1.0), {"time": T})
    stage.memory = 10.0
    return problem(stage)


@pytest.mark.parametrize(
    ("before", "after", "at", "found"),
    [
        (1.0, np.exp(0.26), 20, True), (1.0, np.exp(0.24), 20, False),  # by half a nat of power, not less
        (np.sqrt(1.29), 3.0, 20, True), (np.sqrt(1.31), 3.0, 20, False),  # where it was no more than noise before
        (1.0, 3.0, 5, True), (1.0, 3.0, 55, True), (0.0, 0.02, 20, False), (0.0, 0.05, 20, True),
    ],
)  # fmt: skip
def test_an_onset_is_told_at_the_block_in_which_a_quiet_error_steps_up(
    before: float, after: float, at: int, found: bool
) -> None:
    judge, fit = stepped(before, after, at)
    when = pytest.approx(T[BLOCK * at]) if found else None
    assert onset(judge, fit) == when
    here = locate(judge, fit)
    assert here.onset == (when if here.hot else None)  # where nothing fails, nothing begins to


def test_of_few_samples_in_its_time_scale_an_onset_is_a_sample() -> None:
    judge, fit = stepped(1.0, 3.0, 5)
    judge.memory = 5.0 * 0.05
    assert onset(judge, fit) == pytest.approx(T[BLOCK * 5])
    judge.memory = 0.01 * 0.05
    assert onset(judge, fit) == pytest.approx(T[BLOCK * 5])


def test_an_onset_asks_for_sixteen_blocks_that_are_three_tenths_measured() -> None:
    for blocks, each, found in ((16, 13, True), (15, 13, False), (16, 12, False)):
        stage = stepped(1.0, 3.0, 10)[0].stage
        stage.measured[0, np.arange(N) % BLOCK >= each] = np.nan
        stage.measured[0, BLOCK * blocks :] = np.nan
        assert onset(*problem(stage)) == (pytest.approx(T[BLOCK * 10]) if found else None)


@given(ratio=st.floats(0.1, 3.0), limit=st.floats(1.0, 2.0))
@settings_of(max_examples=examples(15), deadline=None)
def test_a_signal_agrees_up_to_its_tolerance(ratio: float, limit: float) -> None:
    s = StageFigures("s", "y", "mm", ratio * FLOOR, 2.0 * FLOOR, FLOOR, 100, limit)
    assert s.agrees == (ratio * FLOOR <= limit * FLOOR) and s.ratio == pytest.approx(ratio)
    assert s.json()["ratio"] == s.ratio and s.json()["agrees"] == s.agrees and s.json()["rms_as_given"] == 2.0 * FLOOR
    assert StageFigures("s", "y", "mm", 1.0, 1.0, 1.0, 1).tolerance == AGREES and tolerance(10**9, 1.0) == AGREES


# ---- what it looks like ----------------------------------------------------------------------------------------------

X = np.linspace(1.0, 9.0, 8)
BOTH = np.linspace(-4.0, 4.0, 8)


@pytest.mark.parametrize(
    ("name", "x", "y", "says"),
    [
        ("load", X, 2.0 * X, "grows linearly with load, independent of direction, from 2 mm at 1 to 18 mm at 9 kN"),
        ("load", X, -2.0 * X, "falls linearly with load, independent of direction, from -2 mm at 1 to -18 mm at 9 kN"),
        ("load", X, X * X, "grows with the square of load, independent of direction, from 1 mm at 1 to 81 mm at 9 kN"),
        (
            "load", BOTH, np.abs(BOTH),
            "grows with the magnitude of load, independent of direction, from 4 mm at -4 to 4 mm at 4 kN",
        ),
        (
            "load", BOTH, np.sign(BOTH),
            "depends on the sign of load, independent of direction, from -1 mm at -4 to 1 mm at 4 kN",
        ),
        ("load, against the motion", X, -2.0 * X,
         "falls linearly with load and opposes the motion, from -2 mm at 1 to -18 mm at 9 kN"),
        ("load, against the motion", X, 2.0 * X,
         "grows linearly with load and follows the motion, from 2 mm at 1 to 18 mm at 9 kN"),
        ("load", X, np.linspace(3.0, 4.0, 8),
         "grows linearly with load, independent of direction, from 3 mm at 1 to 4 mm at 9 kN"),
        ("load", np.full(3, 2.0), np.array([1.0, 9.0, 2.0]),
         "is greatest, 9 mm, near load 2 kN, independent of direction, from 1 mm at 2 to 2 mm at 2 kN"),
        ("load", X, 5.0 + 0.01 * X, "is nearly constant at 5.05 mm, independent of direction"),
        ("load", X[:2], np.array([1.0, 3.0]),
         "differs between load 1 and 2.14 kN: 1 and 3 mm, independent of direction"),
        ("direction", np.array([-1.0, 1.0]), np.array([1.0, 3.0]), "changes with the direction of motion: 1, 3 mm"),
        ("load", X, np.array([0.0, 1.0, -2.0, 9.0, -1.0, 0.5, 2.0, 0.1]),
         "is greatest, 9 mm, near load 4.429 kN, independent of direction, from 0 mm at 1 to 0.1 mm at 9 kN"),
    ],
)  # fmt: skip
def test_how_a_curve_runs_in_words(name: str, x: Array, y: Array, says: str) -> None:
    assert _in_words(name, x, y, "mm", "kN") == says


@pytest.mark.parametrize("kind", ["line", "load", "time", "nothing"])
def test_what_is_left_is_told_as_a_function_of_what_explains_most(kind: str) -> None:
    rng = np.random.default_rng(5)
    load = np.repeat(rng.uniform(0.0, 8.0, N // 8), 8)
    of = {"line": 8.0 * np.sin(2.0 * np.pi * 2.5 * T), "load": load, "time": 0.1 * T, "nothing": 0.0 * T}[kind]
    conditions = {"time": T, "load": load, "direction": np.sign(np.sin(5.0 * T))}
    stage = stage_of(of + 0.3 * rng.standard_normal(N), conditions)
    judge, fit = problem(stage)
    (s,) = shape(judge, fit)
    assert s.output == "y"
    if kind == "line":
        assert s.feature == "frequency" and s.explained == pytest.approx(1.0, abs=0.05)
        before, _, amplitude = s.text.removesuffix(" mm").rpartition(" ")
        assert before == "error of y oscillates at 2.50 Hz with an amplitude of"
        assert float(amplitude) == pytest.approx(0.8, abs=0.02)
    elif kind == "nothing":
        total = np.sqrt(np.mean(stage.measured**2))
        assert s.text == f"error of y: {total:.3g} mm rms, not a function of any one logged condition"
        assert abs(s.explained) < 0.1
    else:
        assert s.feature == kind and (s.x_unit, s.y_unit) == ("kN" if kind == "load" else "s", "mm")
        assert s.text.startswith(f"error of y grows linearly with {kind}, independent of direction, from ")
        bins = np.clip(np.digitize(conditions[kind], _edges(conditions[kind])) - 1, 0, REGIME_BINS - 1)
        for b in range(REGIME_BINS):  # the curve that is drawn
            assert s.x[b] == pytest.approx(conditions[kind][bins == b].mean())
            assert s.y[b] == pytest.approx(stage.measured[0, bins == b].mean())
        total = np.mean(stage.measured**2)
        expected = 1.0 - (0.3 * FLOOR) ** 2 / total
        assert s.explained == pytest.approx(expected, abs=0.06)
        assert s.text.endswith(f"; explains {100 * s.explained:.0f} % of what is left")


@pytest.mark.parametrize("against", [False, True])
def test_of_a_stage_that_integrates_the_rate_of_the_error_is_told(against: bool) -> None:
    rng = np.random.default_rng(6)
    load = np.interp(T, np.arange(0.0, 130.0, 4.0), rng.uniform(0.0, 8.0, 33))
    direction = np.sign(np.sin(1.1 * T))
    rate = 5.0 * load * (-direction if against else 1.0)  # noise floors per second
    error = 0.05 * np.cumsum(rate) + 0.1 * rng.standard_normal(N)
    stage = stage_of(error, {"load": load, "direction": direction}, window=20.0)
    stage.memory = 100.0
    judge, fit = problem(stage)
    (s,) = shape(judge, fit)
    assert s.feature == ("load, against the motion" if against else "load") and (s.x_unit, s.y_unit) == ("kN", "mm/s")
    says = "falls linearly with load and opposes the motion" if against else "grows linearly with load, independent of"
    assert s.text.startswith(f"rate of the error of y {says}")
    slope = np.full(N, np.nan)  # over a second to each side, within a window
    for first, end in ((0, 400), (400, 800), (800, 1200), (1200, 1600), (1600, N)):  # the rest is no window of its own
        slope[first + 20 : end - 20] = FLOOR * (error[first + 40 : end] - error[first : end - 40]) / 2.0
    target = slope * (direction if against else 1.0)
    told = np.isfinite(target)
    edges = _edges(load[told])
    of = np.clip(np.digitize(load, edges) - 1, 0, REGIME_BINS - 1)
    assert s.y == pytest.approx([target[told & (of == b)].mean() for b in range(REGIME_BINS)], abs=1e-9)
    still = replace(judge.stage, measured=judge.stage.measured[:, :200], t=T[:200], regimes={"load": load[:200]},
                    run=lambda thetas: np.zeros((len(thetas), 1, 200)))  # fmt: skip
    short, fit = problem(still)
    assert shape(short, fit) == []  # slopes of fewer than 200 samples say nothing


@pytest.mark.parametrize("first", ["time", "load"])
def test_time_is_named_only_where_nothing_physical_explains_as_much(first: str) -> None:
    noise = 0.1 * np.random.default_rng(8).standard_normal(N)
    of = {"time": T, "load": T**3}
    conditions = {first: of[first], **of}
    judge, fit = problem(stage_of(0.05 * T + noise, conditions))
    assert shape(judge, fit)[0].feature == "load"


@pytest.mark.parametrize(
    ("hertz", "share", "told"),
    [(2.5, 0.29, True), (2.5, 0.21, False), (1.5, 0.6, True), (1.3, 0.6, False), (9.0, 0.6, True)],
)
def test_a_line_is_told_that_is_a_quarter_of_the_error_and_quicker_than_the_stage(
    hertz: float, share: float, told: bool
) -> None:
    noise = np.random.default_rng(9).standard_normal(N)
    noise *= np.sqrt(1.0 - share) / noise.std()
    judge, fit = problem(stage_of(np.sqrt(2.0 * share) * np.sin(2.0 * np.pi * hertz * T) + noise, {"time": T}))
    (s,) = shape(judge, fit)
    assert (s.feature == "frequency") == told
    if told:
        assert f"oscillates at {hertz:.2f} Hz" in s.text and s.explained == pytest.approx(share, abs=0.04)
        assert s.x.min() > 1.4 and np.all(np.diff(s.x) > 0.0) and s.x[np.argmax(s.y)] == pytest.approx(hertz, abs=0.01)


@pytest.mark.parametrize(("share", "told"), [(0.14, False), (0.3, True)])
def test_a_condition_is_told_that_explains_a_fifth_of_what_is_left(share: float, told: bool) -> None:
    rng = np.random.default_rng(10)
    load = np.repeat(rng.uniform(-1.0, 1.0, N // 40), 40)
    of = np.sqrt(share) * load / np.sqrt(np.mean(load**2))
    judge, fit = problem(stage_of(of + np.sqrt(1.0 - share) * rng.standard_normal(N), {"load": load}))
    (s,) = shape(judge, fit)
    assert s.explained == pytest.approx(share, abs=0.05) and ("not a function of" in s.text) != told


def test_shapes_come_in_the_order_of_what_they_explain() -> None:
    rng = np.random.default_rng(11)
    load = np.repeat(rng.uniform(-4.0, 4.0, N // 8), 8)
    stage = stage_of(np.zeros(N), {"load": load})
    stage.outputs, stage.units, stage.floor = ("y", "z"), ("mm", "deg"), np.full(2, FLOOR)
    stage.run = lambda thetas: np.zeros((len(thetas), 2, N))
    stage.measured = FLOOR * np.array([load + 4.0 * rng.standard_normal(N), load + rng.standard_normal(N)])
    judge = LeastSquaresProblem(stage, stage.floor)
    fit = judge.fit((), stage.neutral())
    assert [s.output for s in shape(judge, fit)] == ["z", "y"]
    for count, told in ((200, ["y", "z"]), (199, ["y"])):  # of so few samples nothing is told
        stage.measured[1, count:] = np.nan
        assert sorted(s.output for s in shape(LeastSquaresProblem(stage, stage.floor), fit)) == told
    stage.regimes["load"][:] = np.where(np.arange(N) < 200, 1.0, np.nan)  # nor of a condition that never changes
    judge = LeastSquaresProblem(stage, stage.floor)
    assert shape(judge, fit) == []
    stage.regimes = {}
    assert shape(judge, fit) == []


def test_a_curve_is_told_of_the_samples_that_have_both_an_error_and_the_condition() -> None:
    rng = np.random.default_rng(12)
    load = np.repeat(rng.uniform(0.0, 8.0, N // 8), 8)
    stage = stage_of(load + rng.standard_normal(N), {"load": load.copy()})
    stage.measured[0, 200:500] = np.nan
    stage.regimes["load"][400:900] = np.nan
    judge, fit = problem(stage)
    (s,) = shape(judge, fit)
    both = np.isfinite(stage.measured[0]) & np.isfinite(stage.regimes["load"])
    edges = _edges(load[both])
    of = np.clip(np.digitize(load, edges) - 1, 0, REGIME_BINS - 1)
    assert s.y == pytest.approx([stage.measured[0, both & (of == b)].mean() for b in range(REGIME_BINS)])
    (r,) = regimes(judge, fit, 2.0)
    assert r.samples.sum() == both.sum()
    for lack in (101, 99):  # of fewer than 100 samples no condition is made
        stage.measured[0, lack:] = np.nan
        judge, fit = problem(stage)
        assert len(regimes(judge, fit, 2.0)) == (lack == 101)


def eight_bins(level: float, last: float) -> tuple[LeastSquaresProblem, Any]:
    """Errors of this mean square in seven bins of a condition and of that in the eighth, without any scatter."""
    load = np.arange(N) % 8
    square = np.where(load == 7, last, level)
    stage = stage_of(np.sqrt(square) * np.where(np.arange(N) // 8 % 2, 1.0, -1.0), {"load": load.astype(float)})
    return problem(stage)


# mean square over the noise at which one of eight bins of 300 samples stands out, two of which count as one
STANDS_OUT = 1.0 + norm.isf(REGIME_LEVEL / 8) / np.sqrt(N / 8 / 4.0)


@pytest.mark.parametrize("side", [0.99, 1.01])
@pytest.mark.parametrize("level", [0.7, 1.0, 1.1, 1.5])
def test_a_bin_is_held_against_what_all_others_have_as_far_as_a_floor_may_be_wrong(side: float, level: float) -> None:
    limit = STANDS_OUT * max(1.0, min(level, most_floor(N, 2.0) ** 2))
    judge, fit = eight_bins(level, side * limit)
    (r,) = regimes(judge, fit, 2.0)
    assert r.significant.tolist() == [False] * 7 + [side > 1.0]


@pytest.mark.parametrize("side", [0.99, 1.01])
@pytest.mark.parametrize("share", [0.3, 0.8, 1.7])
def test_what_a_raster_hides_is_known_to_half_of_it(side: float, share: float) -> None:
    limit = STANDS_OUT * (1.0 + min(share**2, 1.0) * (1.5**2 - 1.0))
    judge, fit = eight_bins(1.0, side * limit)
    judge.stage.raster_error = np.array([share * FLOOR])
    (r,) = regimes(judge, fit, 2.0)
    assert r.significant.tolist() == [False] * 7 + [side > 1.0]


def test_directions_are_said_in_words() -> None:
    three = np.zeros(3)
    r = Regime("y", "mm", "direction", "", np.array([-1.5, -0.5, 0.5, 1.5]), three, three, three, three, 0.0, three)
    words = [r.place(b) for b in range(3)]
    assert words == ["direction negative", "direction at rest", "direction positive"]


# ---- all stages together ---------------------------------------------------------------------------------------------


@given(sizes=st.lists(st.integers(1, 300), min_size=1, max_size=6))
@settings_of(max_examples=examples(20), deadline=None)
def test_stages_that_take_next_to_nothing_come_first_then_the_longest(sizes: list[int]) -> None:
    stages: Any = [SimpleNamespace(effects=(None,) * n, outputs=("y",)) for n in sizes]
    order = workflow._order(stages, False)
    assert sorted(order) == list(range(len(sizes)))
    short = [i for i in order if SHORT_SEARCH * sizes[i] < max(sizes)]
    assert order[: len(short)] == short
    assert [sizes[i] for i in short] == sorted(sizes[i] for i in short)
    assert [sizes[i] for i in order[len(short) :]] == sorted((sizes[i] for i in order[len(short) :]), reverse=True)
    beside = workflow._order(stages, True)
    assert sizes[beside[0]] == max(sizes) and [i for i in order if i != beside[0]] == beside[1:]


def test_how_far_a_search_is_counts_stages_by_their_size() -> None:
    sizes = (4, 2, 0)
    stages: Any = [
        SimpleNamespace(name=name, effects=(None,) * n, outputs=("y", "z"))
        for name, n in zip("abc", sizes, strict=True)
    ]
    work = workflow._Work(stages)
    work.fits[0].value = 20
    share, text = workflow._how_far(work, {1})
    assert share == pytest.approx((8.0 * 20.0 / (20.0 + USUAL_FITS) + 4.0) / (8.0 + 4.0 + 2.0))
    assert text == "1 of 3 subsystems searched; trying a (4 effects, 20 fits)"
    assert workflow._how_far(work, {0, 1, 2}) == (1.0, "3 of 3 subsystems searched")


@pytest.mark.parametrize(
    ("verdicts", "together"),
    [(["none", "none"], "none"), (["none", "unknown"], "unknown"), (["unknown", "missing"], "missing")],
)
def test_one_stage_that_lacks_something_is_a_model_that_does(verdicts: list[str], together: str) -> None:
    results: Any = [SimpleNamespace(verdict=v) for v in verdicts]
    assert workflow.verdict_of(results) == together


def small(seed: int, size: float) -> Stage:
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((2, 240))
    effects = tuple(Effect(c, (Parameter("size", 0.0, "mm", -9.0, 9.0),), ((-1.0,), (1.0,)), "needs c") for c in "ab")
    signals = np.vstack([x, np.zeros(240)])  # the last effect does nothing here
    return Stage(
        "small", ("y",), ("mm",), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), effects,
        lambda thetas: (thetas @ signals)[:, None, :], 0.1 * np.arange(240),
        x[0] + size * x[1] + FLOOR * rng.standard_normal(240), floor=np.array([FLOOR]),
    )  # fmt: skip


def test_effects_that_bring_the_model_no_nearer_are_told() -> None:
    assert workflow.no_better(extend_stage(small(6, 2.0), ("a",))) is None
    assert workflow.no_better(extend_stage(small(6, 2.0), ())) is None
    told = []
    for seed in range(6):  # where nothing is missing, half of them do better on what they were not fitted to
        d = extend_stage(small(seed, 0.0), ("a",))
        before = d.steps[0][1]
        says = f"small: a takes the error from {before:.4g} to {d.excess:.4g} noise floors, no better"
        told.append(workflow.no_better(d))
        assert told[-1] == (None if d.excess < before else says)
    assert any(told) and None in told
    (f,) = d.effects
    f.parameters["a"] = {"low": 1.0, "value": 1.0, "high": 1.0}
    d.steps[0] = ("nominal", 0.5 * d.excess)
    assert str(workflow.no_better(d)).endswith(", no better; on a bound or neutral: a a")


def test_the_json_of_a_diagnosis_says_what_its_stages_say() -> None:
    d = workflow.diagnose([small(8, 2.0)], {"other": "no oil temperature"}, workers=1)
    out = workflow.diagnosis_json(d, "log.csv")
    assert (out["schema"], out["log"], out["verdict"]) == (1, "log.csv", "missing")
    (f,) = d.stages[0].effects
    first, other = out["stages"]
    assert first["error_before"] == pytest.approx(2.0, rel=0.2) and first["error_after"] == pytest.approx(0.1, rel=0.2)
    assert other == {
        "stage": "other", "verdict": "not_observed", "signal": None, "unit": None, "error_before": None,
        "error_after": None, "noise_floor": None, "reason": "no oil temperature",
    }  # fmt: skip
    assert out["effects"][0]["effect"] == "a" and out["effects"][0]["probability"] == f.probability
    assert out["not_observable"] == [{"effect": "b", "stage": "small", "needs": "needs c"}]
    assert out["unknown"] == [] and out["decisions"]

    def stage_says(name: str, nats: float, verdict: str = "missing") -> StageDiagnosis:
        found = Found("a", 0.9, {}, [], nats, probabilities={"a": 0.9})
        found.probability = nats / 100.0
        return replace(d.stages[0], stage=name, effects=[found], verdict=verdict)

    both = workflow.diagnosis_json(replace(d, stages=[stage_says("one", 20.0), stage_says("two", 50.0)]), "log.csv")
    assert [e["stage"] for e in both["effects"]] == ["two"]  # where it gains most
    less = replace(stage_says("three", 90.0), effects=[replace(f, effect="c", probability=0.1)])
    more = workflow.diagnosis_json(replace(d, stages=[less, stage_says("two", 50.0)]), "log.csv")
    assert [(e["effect"], e["probability"]) for e in more["effects"]] == [("a", 0.5), ("c", 0.1)]
    lost = replace(
        d.stages[0], verdict="unknown", effects=[], nearest=[], refused=["a why"],
        candidates=[Candidate("a", 13.0, 1.0), Candidate("b", 11.0, 1.0)],
    )  # fmt: skip
    said = workflow.diagnosis_json(replace(d, stages=[lost], shapes={}), "log.csv")["unknown"]
    assert said == [{"stage": "small", "shape": "no shape found; a why", "nearest_effects": ["a"]}]


def test_stages_are_located_in_their_order_and_it_is_told_how_far_that_is() -> None:
    told: list[tuple[float, str]] = []
    stages = [small(9, 0.0), replace(small(10, 2.0), name="other")]
    found = workflow.locate_stages(stages, lambda share, name: told.append((share, name)))
    assert told == [(0.0, "small"), (0.5, "other")] and [at.stage for at in found] == ["small", "other"]
    assert [at.fails for at in found] == [False, True]
    assert [f.stage for f in workflow.compare_stages(stages)] == ["small", "other"]


def test_a_bin_without_samples_is_never_the_worst() -> None:
    r = Regime(
        "y", "mm", "load", "", np.arange(4.0), np.array([0.1, 9.0, 0.2]), np.array([1.0, 90.0, 2.0]),
        np.array([5, 0, 5]), np.zeros(3, dtype=bool), 0.0, np.full(3, np.nan),
    )  # fmt: skip
    assert r.worst() == "y: 0.2 mm (2 noise floors) at load 2 to 3"


@pytest.mark.parametrize("workers", [1, 2])
def test_a_search_tells_how_far_it_is_and_what_each_stage_says_at_once(workers: int) -> None:
    stages = [replace(small(seed, size), name=name) for seed, size, name in ((8, 2.0, "one"), (9, 0.0, "two"))]
    stages[0].measured = stages[0].measured + 0.5 * np.sin(2.0 * np.pi * 2.0 * stages[0].t)  # what no effect explains
    stages[0].memory = 10.0
    shares: list[float] = []
    news: list[workflow.News] = []
    d = workflow.diagnose(stages, {"x": "no oil"}, shares.append, workers, news=news.append)
    assert shares == [n.fraction for n in news] and sorted(shares) == shares and shares[-1] == 1.0
    assert sorted(n.found.stage for n in news if n.found) == ["one", "two"]
    assert news[-1].text == "2 of 2 subsystems searched" and news[-1].found is not None
    if workers == 1:
        assert any("; trying one (2 effects, 1 fits)" in n.text for n in news)
        assert [n.fraction for n in news if n.found] == [pytest.approx(0.5, abs=0.3), 1.0]
    assert [s.stage for s in d.stages] == ["one", "two"] and d.verdict == d.stages[0].verdict == "unknown"
    assert d.stages[1].verdict == "none"
    assert list(d.shapes) == ["one"] and "oscillates at 2.0" in d.shapes["one"][0].text
    assert d.not_observed == {"x": "no oil"} and d.notes == [] and 0.0 < d.elapsed_s < 100.0
    assert workflow.diagnose(stages[1:], workers=workers).not_observed == {}
