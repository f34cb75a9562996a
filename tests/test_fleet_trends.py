"""Trends of a fleet against other computations of the same: least squares by numpy, closed forms, brute search; and
what the report makes of them, on small tables.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

pytest.importorskip("psutil", reason="the extra `fleet` is not installed")
pytest.importorskip("duckdb", reason="the extra `fleet` is not installed")

from vaneloop.base.errors import InputError
from vaneloop.fleet import report
from vaneloop.fleet.trends import (
    HALF,
    Trend,
    _along,
    _by_ruptures,
    _candidates,
    _fitted,
    _scatter,
    _straight,
    limit_of,
    odd,
    trend,
)
from vaneloop.pages.fleet import YEAR, Series

Array = Any
TIMES = np.cumsum([0.05, 0.1, 0.02, 0.2, 0.1, 0.15, 0.07, 0.3, 0.05, 0.12, 0.08, 0.11, 0.2, 0.04, 0.13, 0.1])
NOISE = np.random.default_rng(3).normal(0.0, 1.0, len(TIMES))  # of standard deviation 1, once and for all


def shape(kind: str, t: Array, at: float) -> Array:
    return np.maximum(t - at, 0.0) if kind == "growth" else (t >= at) * 1.0


def line(kind: str, t: Array, y: Array, w: Array, at: float) -> tuple[Array, Array, float]:
    """Level and growth, their covariance with unit weight, and the squares left: by numpy's least squares."""
    x = np.column_stack([np.ones(len(t)), shape(kind, t, at)])
    found = np.linalg.lstsq(x * np.sqrt(w)[:, None], y * np.sqrt(w), rcond=None)[0]
    return found, np.linalg.inv(x.T @ (x * w[:, None])), float(np.sum(w * (y - x @ found) ** 2))


def everywhere(kind: str, t: Array, y: Array, w: Array) -> tuple[Array, Array]:
    """Times at which a change may begin, close to each other, and the squares left by a curve from each."""
    if kind == "step":
        places = np.array([(t[i] + t[i + 1]) / 2 for i in range(2, len(t) - 3)])
    else:
        places = np.linspace(t[0], t[-3], 801)
    return places, np.array([line(kind, t, y, w, at)[2] for at in places])


# ---- one curve -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["growth", "step"])
def test_a_curve_is_that_of_least_squares_by_numpy(kind: str) -> None:
    y, w = 5.0 + 3.0 * NOISE, np.linspace(0.5, 4.0, len(TIMES))
    at = np.array([0.1, 0.41, 0.9, 1.3])
    for row in _fitted(kind, TIMES, y, w, at):
        (a, g), cov, left = line(kind, TIMES, y, w, row[0])
        assert row[1:] == pytest.approx([a, g, left, cov[0, 0], cov[0, 1], cov[1, 1]], rel=1e-9)
    assert _fitted(kind, TIMES, y, w, at)[:, 0].tolist() == at.tolist()


def test_squares_left_by_a_straight_line_are_those_of_polyfit() -> None:
    (left,) = np.polyfit(TIMES, NOISE, 1, full=True)[1]
    assert _straight(TIMES, NOISE) == pytest.approx(left)
    assert _straight(TIMES, 2.0 - 3.0 * TIMES) == pytest.approx(0.0, abs=1e-12)
    assert _straight(np.ones(3), np.array([0.0, 1.0, 2.0])) == 2.0, "over one place only the mean can be taken off"


def test_a_step_lies_midway_between_two_logs_with_three_on_each_side() -> None:
    t = np.array([0.0, 1.0, 3.0, 4.0, 6.0, 9.0, 10.0, 20.0])
    assert _candidates(t, "step").tolist() == [3.5, 5.0, 7.5]
    for at in _candidates(t, "step"):
        assert (t < at).sum() >= 3 and (t > at).sum() >= 3


def test_a_growth_begins_with_the_first_log_or_at_120_times_with_three_logs_on_each_side() -> None:
    t = np.array([0.0, 1.0, 3.0, 4.0, 6.0, 9.0, 10.0, 20.0])
    first, *others = _candidates(t, "growth")
    assert first == 0.0 and others == pytest.approx([3.0 + 6.0 * k / 119 for k in range(120)])


# ---- scatter ---------------------------------------------------------------------------------------------------------


def test_second_differences_tell_scatter_and_not_a_straight_change() -> None:
    """A bend of three values at times t is y1 - (1-q) y0 - q y2, q = (t1-t0)/(t2-t0); its deviation is that of one
    value times sqrt(1 + (1-q)^2 + q^2), and the median of |bend| is 0.6745 of it.
    """
    s = np.full(len(TIMES), 0.1)
    assert _scatter(TIMES, 7.0 - 2.0 * TIMES, 0.0 * s) == pytest.approx(0.0, abs=1e-12)
    bends = []
    for k in range(1, len(TIMES) - 1):
        (t0, t1, t2), (y0, y1, y2) = TIMES[k - 1 : k + 2], NOISE[k - 1 : k + 2]
        q = (t1 - t0) / (t2 - t0)
        bends.append(abs(y1 - (1 - q) * y0 - q * y2) / np.sqrt(1 + (1 - q) ** 2 + q**2))
    deviation = np.median(bends) / stats.norm.ppf(0.75)
    assert _scatter(TIMES, NOISE, s) == pytest.approx(np.sqrt(deviation**2 - 0.01), rel=1e-3)
    assert _scatter(TIMES, NOISE, 0.0 * s) == pytest.approx(deviation, rel=1e-3)
    assert _scatter(TIMES, NOISE, 10.0 * s * deviation) == 0.0, "no more than the logs say of themselves"


def test_logs_of_one_moment_count_alike_in_a_bend() -> None:
    t, y = np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0, 1.0])
    # the first three: 1 - (0 + 0) / 2 over sqrt(1.5); the others have their neighbour's value: -1 over sqrt(2)
    expected = np.median([1 / np.sqrt(1.5), 1 / np.sqrt(2.0)]) / 0.6745
    assert _scatter(t, y, np.zeros(4)) == pytest.approx(expected, rel=1e-6)


def test_fewer_than_four_logs_tell_no_scatter() -> None:
    y = np.array([0.0, 3.0, 0.0, 3.0])
    assert _scatter(np.arange(3.0), y[:3], np.zeros(3)) == 0.0 < _scatter(np.arange(4.0), y, np.zeros(4))


# ---- the second opinion ----------------------------------------------------------------------------------------------


def two_lines(t: Array, y: Array) -> tuple[float, float, float]:
    """Squares left by the mean, by one straight line, and by the best two with three logs on each side."""
    left = [
        sum(float(np.polyfit(t[p], y[p], 1, full=True)[1][0]) for p in (slice(0, k), slice(k, len(t))))
        for k in range(3, len(t) - 2)
    ]
    return float(np.sum((y - y.mean()) ** 2)), float(np.polyfit(t, y, 1, full=True)[1][0]), min(left)


def said_by_schwarz(t: Array, y: Array) -> bool:
    """Two straight lines leave less than one level, or one line does, by log n for each number more."""
    n, (flat, one, two) = len(t), two_lines(t, y)
    return bool(n * 0 + flat - one > 2 * np.log(n) * one / (n - 2) or flat - two > 3 * np.log(n) * two / (n - 4))


@pytest.mark.parametrize(
    "change", [TIMES - 1.0, np.maximum(TIMES - 0.8, 0.0), 1.0 * (TIMES > 0.75), 1.0 * (TIMES > 1.45)]
)
def test_ruptures_sees_a_change_from_the_size_on_that_schwarz_s_criterion_says(change: Array) -> None:
    low, high = 0.0, 64.0
    while high - low > 1e-6:
        mid = 0.5 * (low + high)
        low, high = (low, mid) if said_by_schwarz(TIMES, NOISE + mid * change) else (mid, high)
    assert 0.01 < low < 60.0
    assert not _by_ruptures(TIMES, NOISE + (low - 1e-3) * change)
    assert _by_ruptures(TIMES, NOISE + (high + 1e-3) * change)


def test_ruptures_takes_level_and_unit_as_they_come() -> None:
    for size, seen in ((0.5, False), (9.0, True)):
        y = NOISE + size * (TIMES > 0.8)
        for offset, unit in ((0.0, 1.0), (1e3, 1.0), (0.0, 1e-3), (-5.0, 1e3)):
            assert _by_ruptures(TIMES, unit * (y + offset)) == seen


# ---- the trend -------------------------------------------------------------------------------------------------------


def weights(t: Array, y: Array, s: Array, told: Array) -> tuple[Array, float]:
    b = _scatter(t[told], y[told], s[told])
    return 1.0 / (s**2 + np.where(told, b, 0.0) ** 2), b


def checked(f: Trend, t: Array, y: Array, s: Array, told: Array) -> None:
    """Every number of a change, computed anew from the times of its lines."""
    n, m = len(t), int(told.sum())
    w, b = weights(t, y, s, told)
    assert f.scatter == pytest.approx(b) and f.logs == n and f.lines is not None
    places, fits = everywhere(f.kind, t, y, w)
    (a, g), _, left = line(f.kind, t, y, w, f.onset)
    assert left <= fits.min() * (1 + 1e-4) and (f.start, f.rate) == pytest.approx((a, g), rel=1e-6)
    reach = (lambda at: t[-1] - at) if f.kind == "growth" else (lambda at: 1.0)
    assert f.now == pytest.approx(a + g * reach(f.onset), rel=1e-6)
    level = np.average(y, weights=w)
    rest = float(np.sum(w * (y - level) ** 2))
    other = {"growth": "step", "step": "growth"}[f.kind]
    coarse, others = (min(line(k, t, y, w, at)[2] for at in _candidates(t, k)) for k in (f.kind, other))
    assert coarse < others
    assert f.p == pytest.approx(min(1.0, 6 * stats.f.sf((rest - coarse) / 3 / (coarse / (n - 3)), 3, n - 3)), rel=1e-6)
    freedom = max(m - (3 if m == n else 2), 1)
    squares = float(np.sum((w * (y - a - g * shape(f.kind, t, f.onset)) ** 2)[told]))
    sigma2, widest = squares / freedom, stats.f.ppf(0.9, 1, freedom)
    common = np.sqrt(max(1 - squares / stats.chi2.ppf(0.1, freedom), 0.0) * m / w[told].sum())
    rates, levels = [], []
    for row in f.lines:
        (a, g), cov, here = line(f.kind, t, y, w, row[0])
        q = np.sqrt(max(widest - (here - left) / sigma2, 0.0))
        late = max(reach(row[0]), 1e-9)
        sure = [1.6448536 * common, 1.6448536 * common / np.sqrt(m) / late]
        expected = [a, g, *(sigma2 * np.array([cov[0, 0], cov[0, 1], cov[1, 1]])), q, *sure]
        assert row[1:] == pytest.approx(expected, rel=1e-5, abs=1e-7)
        half = max(q * np.sqrt(sigma2 * cov[1, 1]), sure[1])
        rates += [g - half, g + half]
        x = np.array([1.0, late])
        half = np.hypot(max(q * np.sqrt(sigma2 * x @ cov @ x), sure[1] * late), sure[0])
        levels += [a + g * late - half, a + g * late + half]
    assert (f.rate_low, f.rate_high) == pytest.approx((min(rates), max(rates)), rel=1e-5)
    assert (f.now_low, f.now_high) == pytest.approx((min(levels), max(levels)), rel=1e-5)
    # the lines are all curves that fit about as well: the onset's interval ends where none is any more
    fine = places[(fits - left) / sigma2 <= widest]
    near = 0.02 * (fine[-1] - fine[0]) + places[1] - places[0] if f.kind == "growth" else 1e-9
    assert (f.onset_low, f.onset_high) == pytest.approx((fine[0], fine[-1]), abs=near)


ALL = np.ones(len(TIMES), dtype=bool)
LATE = TIMES > 0.7


@pytest.mark.parametrize("change", [9.0 * np.maximum(TIMES - 0.8, 0.0), 12.0 * (TIMES - 1.0), 6.0 * (TIMES > 0.75)])
@pytest.mark.parametrize(("claims", "told"), [(0.3, ALL), (4.0, ALL), (1.6, LATE), (4.0, LATE)])
def test_a_trend_has_the_numbers_of_its_definition(change: Array, claims: float, told: Array) -> None:
    """Logs that scatter more than they claim, much less, and about as much; all tell the value, or the late ones."""
    s = claims * np.linspace(0.5, 1.5, len(TIMES))
    y = 2.0 + 4.0 * change + NOISE * np.where(told, 1.0, 0.01)
    f = trend(TIMES, y, s, told=told)
    assert f.kind in ("growth", "step")
    checked(f, TIMES, y, s, told)


def test_the_order_of_logs_does_not_matter() -> None:
    y, s = 9.0 * np.maximum(TIMES - 0.8, 0.0) + 0.3 * NOISE, np.linspace(0.1, 0.5, len(TIMES))
    mixed = np.random.default_rng(1).permutation(len(TIMES))
    a, b = trend(TIMES, y, s, told=LATE), trend(TIMES[mixed], y[mixed], s[mixed], told=LATE[mixed])
    for name in ("kind", "onset", "rate", "rate_low", "rate_high", "now_high", "p"):
        assert getattr(a, name) == getattr(b, name), name


@pytest.mark.parametrize("claims", [0.1, 1.0])
def test_what_does_not_change_has_a_weighted_mean_with_student_s_interval(claims: float) -> None:
    s = claims * np.linspace(0.5, 2.0, len(TIMES))
    f = trend(TIMES, 5.0 + 0.2 * NOISE, s)
    w, b = weights(TIMES, 5.0 + 0.2 * NOISE, s, ALL)
    mean = np.average(5.0 + 0.2 * NOISE, weights=w)
    n = len(TIMES)
    rest = float(np.sum(w * (5.0 + 0.2 * NOISE - mean) ** 2))
    half = stats.t.ppf(0.95, n - 1) * np.sqrt(rest / (n - 1) / w.sum())
    assert (f.kind, f.logs, f.scatter) == ("none", n, pytest.approx(b))
    assert (f.start, f.now, f.now_low, f.now_high) == pytest.approx((mean, mean, mean - half, mean + half))
    left = min(
        min(line(k, TIMES, 5.0 + 0.2 * NOISE, w, at)[2] for at in _candidates(TIMES, k)) for k in ("growth", "step")
    )
    assert f.p == pytest.approx(min(1.0, 6 * stats.f.sf((rest - left) / 3 / (left / (n - 3)), 3, n - 3)))


def test_a_change_is_named_below_its_probability_and_not_at_it() -> None:
    y, s = 2.0 * np.maximum(TIMES - 0.8, 0.0) + 0.4 * NOISE, np.full(len(TIMES), 0.1)
    p = trend(TIMES, y, s, sure=1.0).p
    assert 0.0 < p < 1.0 and _by_ruptures(TIMES, y)
    assert trend(TIMES, y, s, sure=p).kind == "none" != trend(TIMES, y, s, sure=1.0001 * p).kind


def test_eight_logs_and_two_moments_are_needed() -> None:
    t = np.linspace(0.0, 1.0, 8)
    y = 3.0 * t + np.resize([0.01, -0.01], 8)
    assert trend(t, y, np.full(8, 0.01)).kind == "growth"
    few = trend(t[:7], y[:7], np.full(7, 0.01))
    assert (few.kind, few.logs, few.p, few.scatter) == ("too few", 7, 1.0, 0.0) and np.isnan([few.now, few.rate]).all()
    assert trend(np.ones(8), y, np.full(8, 0.01)).kind == "too few"
    assert trend(np.r_[np.ones(7), 2.0], np.resize([0.0, 0.1], 8), np.full(8, 0.1)).kind == "none"


def test_logs_without_any_deviation_are_followed_all_the_same() -> None:
    f = trend(TIMES, 1.0 + 3.0 * (TIMES > 0.75), np.zeros(len(TIMES)))
    assert f.kind == "step" and (f.start, f.rate, f.now) == pytest.approx((1.0, 3.0, 4.0))
    still = trend(TIMES, np.full(len(TIMES), 2.0), np.zeros(len(TIMES)))
    assert (still.kind, still.now_low, still.now_high) == ("none", 2.0, 2.0)


@pytest.mark.parametrize("kind", ["growth", "step"])
def test_nine_intervals_in_ten_have_the_truth_in_them(kind: str) -> None:
    rng, inside = np.random.default_rng(11), []
    for _ in range(60):
        t = np.sort(rng.uniform(0.0, 2.0, 24))
        f = trend(t, 12.0 * shape(kind, t, 0.9) + rng.normal(0.0, 1.0, 24), np.full(24, 0.3))
        inside.append(f.kind == kind and f.rate_low <= 12.0 <= f.rate_high)
    assert 46 <= sum(inside) <= 59, "of 60 with a chance of 0.9: outside in one of 500 draws"


# ---- limits ----------------------------------------------------------------------------------------------------------

ONE = np.array([[0.5, 1.0, 2.0, 0.04, -0.01, 0.09, 1.5, 0.05, 0.02], [0.7, 1.1, 2.3, 0.03, 0.0, 0.05, 0.8, 0.0, 0.5]])


def test_a_line_s_level_is_as_uncertain_as_level_and_growth_together() -> None:
    late = np.array([3.0, 0.2])
    level, half = _along(ONE, late)
    for k, row in enumerate(ONE):
        _, a, g, vaa, vag, vgg, q, alike, growth = row
        x = np.array([1.0, late[k]])
        own = q * np.sqrt(x @ np.array([[vaa, vag], [vag, vgg]]) @ x)
        assert level[k] == pytest.approx(a + g * late[k])
        assert half[k] == pytest.approx(np.sqrt(max(own, growth * late[k]) ** 2 + alike**2))
    torn = np.array([[0.0, 1.0, 2.0, 1.0, -1.0, 1.0 - 1e-12, 1.0, 0.0, 0.0]])
    assert _along(torn, np.ones(1))[1][0] == 0.0, "a variance that rounding has made negative is none"


def growing(lines: Array, sign: float = 1.0) -> Trend:
    """A growth of 2 a year at 4 now, or the same downwards."""
    lines = lines.copy()
    lines[:, 1:3] *= sign
    return Trend("growth", 20, start=sign * 1.0, now=sign * 4.0, rate=sign * 2.0, lines=lines)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_limit_is_reached_between_the_first_and_the_last_crossing_of_the_lines(sign: float) -> None:
    """Without uncertainty along the line but of its level: crossings at (limit -+ alike - a) / g + T."""
    lines = np.array([[0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.4, 0.0], [0.5, 1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    when = limit_of(growing(lines, sign), 1.5, sign * 9.0)
    assert when.time == pytest.approx(1.5 + 5.0 / 2.0) and when.why == ""
    assert when.low == pytest.approx((9.0 - 0.4 - 1.0) / 2.0, rel=2e-2)
    assert when.high == pytest.approx((9.0 - 1.0) / 2.0 + 0.5, rel=2e-2)
    grid = 10.0 ** (-3.0 + 5.0 * np.arange(2000) / 1999)
    firsts = [grid[np.argmax(1.5 + grid >= at - 1e-12)] for at in (3.8, 4.5)]
    assert (when.low - 1.5, when.high - 1.5) == pytest.approx(firsts, rel=1e-9)


def test_an_interval_of_the_time_to_a_limit_is_open_where_growth_may_be_none() -> None:
    lines = np.array([[0.0, 1.0, 2.0, 0.0, 0.0, 4.0, 1.2, 0.0, 0.0]])  # growth 2 +- 2.4
    when = limit_of(growing(lines), 1.5, 9.0)
    assert when.high == float("inf") and when.why == "its growth is not sure enough for a latest time"
    assert when.low == pytest.approx(8.0 / 4.4, rel=0.01) and when.time == 4.0
    sure = limit_of(growing(lines * np.array([1, 1, 1, 1, 1, 0.25, 1, 1, 1])), 1.5, 9.0)  # 2 +- 1.2
    assert sure.high == pytest.approx(8.0 / 0.8, rel=0.01)


def test_a_limit_beyond_a_hundred_years_is_not_told() -> None:
    lines = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    f = Trend("growth", 20, start=0.0, now=2.0, rate=1.0, lines=lines)
    assert limit_of(f, 2.0, 101.0).high == pytest.approx(101.0, rel=0.01)
    assert limit_of(f, 2.0, 103.0).high == limit_of(f, 2.0, 103.0).low == float("inf")
    assert limit_of(f, 2.0, 2.0 + 1e-6).low == pytest.approx(2.001), "a third of a day is as good as now"


@pytest.mark.parametrize(
    ("found", "limit", "said"),
    [
        (Trend("too few", 5), 2.0, (None, None, None, "5 logs with a known time are too few, 8 are needed")),
        (Trend("none", 20, now=1.0), 2.0, (None, None, None, "it does not grow")),
        (Trend("step", 20, now=1.0), 2.0, (None, None, None, "it has changed in one step")),
        (Trend("growth", 20, start=0.0, now=1.0, rate=1.0), -2.0, (None, None, None, "it grows away from its limit")),
        (Trend("growth", 20, start=0.0, now=1.0, rate=1.0), 0.0, (None, None, None, "it grows away from its limit")),
        (Trend("growth", 20, start=0.0, now=3.0, rate=1.0), 3.0, (2.0, None, None, "it is beyond its limit")),
        (Trend("growth", 20, start=0.0, now=-3.0, rate=-1.0), -2.0, (2.0, None, None, "it is beyond its limit")),
    ],
)
def test_words_stand_where_no_time_can(found: Trend, limit: float, said: tuple[Any, ...]) -> None:
    when = limit_of(found, 2.0, limit)
    assert (when.time, when.low, when.high, when.why) == said


# ---- unlike its sisters ----------------------------------------------------------------------------------------------


def unlike(v: list[float], i: int, spread: float = 0.0, tests: int = 1) -> float:
    """Median and median deviation of the others; efficiency of this scale: 0.37, of a median: 2 / pi."""
    others = [x for k, x in enumerate(v) if k != i and np.isfinite(x)]
    n, centre = len(others), float(np.median(others))
    scale = float(np.median([abs(x - centre) for x in others])) / stats.norm.ppf(0.75) * (1 + 0.8 / n)
    width = np.sqrt(scale**2 * (1 + np.pi / 2 / n) + spread**2)
    return min(1.0, tests * 2 * stats.t.sf(abs(v[i] - centre) / width, max(0.37 * (n - 1), 2.0)))


@pytest.mark.parametrize("n", [6, 7, 8, 30])
def test_an_engine_is_held_against_the_others_only(n: int) -> None:
    v = [*np.random.default_rng(n).normal(5.0, 1.0, n - 1).tolist(), 8.0]
    assert odd(v).tolist() == pytest.approx([unlike(v, i) for i in range(n)], rel=2e-3)
    assert odd(v, tests=3).tolist() == pytest.approx([unlike(v, i, tests=3) for i in range(n)], rel=2e-3)
    spread = np.linspace(0.1, 3.0, n)
    said = [unlike(v, i, spread=spread[i]) for i in range(n)]
    assert odd(v, spread).tolist() == pytest.approx(said, rel=2e-3) and min(said) < 1.0


def test_five_others_with_a_value_are_needed() -> None:
    v = [1.0, 1.1, 0.9, 1.05, 0.95, 9.0]
    assert odd(v)[-1] < 0.05
    assert odd(v[1:]).tolist() == [1.0] * 5
    assert odd([np.nan, *v])[-1] == odd(v)[-1] and odd([np.nan, *v])[0] == 1.0
    assert odd([np.nan, *v[1:]]).tolist() == [1.0] * 6


def test_among_equals_any_difference_is_odd() -> None:
    assert odd([2.0] * 6 + [2.1]).tolist() == [1.0] * 6 + [0.0]
    assert odd([2.0] * 6 + [2.1], spread=[1.0] * 7)[-1] > 0.5


# ---- the report's series ---------------------------------------------------------------------------------------------

WIDE = 2.0 * 1.6449  # of a 90 % interval, over a standard deviation


def test_a_series_is_in_the_order_of_time_and_has_deviations_of_its_intervals() -> None:
    s = report._series("e", "q.p", "deg", [3.0, 1.0, np.nan, 2.0], [0.3, 0.1, 0.9, 0.2], [WIDE, None, WIDE, 2 * WIDE],
                       ["c", "a", "x", "b"], 0.5, 0.8, "nominal", [True, False, True, True])  # fmt: skip
    assert (s.t.tolist(), s.y.tolist(), s.keys) == ([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], ["a", "b", "c"])
    assert s.s.tolist() == pytest.approx([2.0, 2.0, 1.0]), "of no known width: the widest"
    assert s.told.tolist() == [False, True, True]
    assert (s.engine, s.quantity, s.unit, s.neutral, s.tolerance, s.kind) == ("e", "q.p", "deg", 0.5, 0.8, "nominal")
    bare = report._series(
        "e", "q", "", [1.0, 1.0, 2.0], [0.0, 1.0, float("nan")], [0.0, None, None], list("abc"), 0.0, None, ""
    )
    assert bare.s.tolist() == [0.0, 0.0] and bare.told.tolist() == [True, True] and bare.keys == ["a", "b"]


def test_a_whole_is_what_both_parts_say() -> None:
    """A log that names the effect knows the sum; the share's doubt is taken off, down to that of the silent logs."""
    parts = {"a": (0.1, 0.3, False), "c": (0.2, 0.05, False), "d": (0.08, 0.5, True), "e": (0.0, 0.07, False)}
    silent = [(1.0, "kc", "c"), (2.0, "kd", "d"), (3.0, "ke", "e"), (4.0, "kf", "f")]
    sums, widths, found = report._whole([1.0, 2.0, 3.0], [0.5, 0.04, None], ["a", "b", "b"], silent, parts, 10.0)
    assert sums == pytest.approx([1.1, 2.0, 3.0])
    assert widths == pytest.approx([0.4, 0.04, 0.0])
    assert found == [(1.0, "kc", pytest.approx(10.2), 0.05), (3.0, "ke", 10.0, 0.07)], "not at its end, and not untold"
    sums, widths, found = report._whole([1.0], [0.3], ["a"], silent, parts, 10.0)
    assert widths == pytest.approx([0.06]), "no surer than the silent logs: the median of 0.05 and 0.07"
    assert report._whole([1.0], [0.31], ["a"], [], parts, 0.0)[1] == pytest.approx([np.sqrt(0.31**2 - 0.3**2)])
    assert report._whole([1.0], [0.29], ["a"], [], parts, 0.0)[1] == [0.0]


def of_engine(engine: str, y: Array, **more: Any) -> Series:
    t = 1e9 + TIMES * YEAR
    n = len(t)
    return Series(engine, "linkage.vigv_play", "deg", t, y, np.full(n, 0.01), [f"{k}" for k in range(n)],
                  np.ones(n, dtype=bool), **{"neutral": 1.0, "tolerance": 0.5, "kind": "nominal", **more})  # fmt: skip


GROWS = 1.0 + 0.5 * np.maximum(TIMES - 0.8, 0.0) + 0.002 * NOISE


def test_times_of_a_judged_series_are_seconds_since_1970() -> None:
    f = trend(TIMES - TIMES[0], GROWS, np.full(len(TIMES), 0.01))
    zero = 1e9 + TIMES[0] * YEAR
    s = report._judged(of_engine("e", GROWS), {"linkage.vigv_play": 2.0}, 1e-3)
    for name in ("onset", "onset_low", "onset_high"):
        assert s.trend[name] == pytest.approx(zero + getattr(f, name) * YEAR, abs=60.0)
    for name in ("kind", "logs", "rate", "now", "start", "p"):
        assert s.trend[name] == pytest.approx(getattr(f, name), rel=1e-6) if name != "kind" else f.kind
    when = limit_of(f, float(TIMES[-1] - TIMES[0]), 2.0)
    for name, v in (("limit_time", when.time), ("limit_low", when.low), ("limit_high", when.high)):
        assert v is not None and s.trend[name] == pytest.approx(zero + v * YEAR, abs=3600.0)
    assert s.trend["limit"] == 2.0 and s.trend["limit_why"] == "" and "lines" not in s.trend


def test_the_limit_of_a_nominal_parameter_is_the_end_of_its_tolerance_to_which_it_grows() -> None:
    assert report._judged(of_engine("e", GROWS), {}, 1e-3).trend["limit"] == 1.5
    assert report._judged(of_engine("e", 2.0 - GROWS), {}, 1e-3).trend["limit"] == 0.5
    without = report._judged(of_engine("e", GROWS, tolerance=None), {}, 1e-3)
    assert without.trend["limit"] is None and without.trend["limit_why"] == "no limit is given (--limits)"
    still = report._judged(of_engine("e", 1.0 + 0.002 * NOISE), {}, 1e-3)
    assert still.trend["limit"] is None and still.trend["limit_why"] == "" and still.trend["limit_time"] is None
    still = report._judged(of_engine("e", 1.0 + 0.002 * NOISE), {"linkage.vigv_play": 2.0}, 1e-3)
    assert still.trend["limit_why"] == "it does not grow" and still.trend["limit_time"] is None
    empty = report._judged(replace(of_engine("e", GROWS), t=np.array([]), y=np.array([])), {}, 1e-3)
    assert empty.trend == {"kind": "too few", "logs": 0}


def test_the_curve_of_a_trend_bends_or_jumps_at_its_onset() -> None:
    t = 1e9 + np.array([0.0, 3.0]) * YEAR
    f = Trend("growth", 9, start=1.0, now=4.0, onset=2.0, rate=3.0)
    at, y = report._curve(f, t)
    assert at.tolist() == [t[0], t[0] + 2.0 * YEAR, t[1]] and y.tolist() == [1.0, 1.0, 4.0]
    at, y = report._curve(replace(f, kind="step"), t)
    assert at.tolist() == [t[0], t[0] + 2.0 * YEAR, t[0] + 2.0 * YEAR, t[1]] and y.tolist() == [1.0, 1.0, 4.0, 4.0]
    at, y = report._curve(replace(f, kind="none"), t)
    assert at.tolist() == [t[0], t[1]] and y.tolist() == [4.0, 4.0]


def test_an_outlier_is_held_against_its_sisters_in_its_own_quantity(monkeypatch: pytest.MonkeyPatch) -> None:
    level = np.random.default_rng(5).normal(1.0, 0.01, 8).tolist()
    level[6] = 1.6

    def told(k: int, v: float, quantity: str = "q", kind: str = "nominal") -> Series:
        said = {"now": v, "now_low": v - 0.001, "now_high": v + 0.002}
        return replace(of_engine(f"e{k}", GROWS), quantity=quantity, kind=kind, trend=said)

    group = [told(k, v) for k, v in enumerate(level)]
    (row,) = report._outliers([*group, told(0, 9.0, kind="effect"), replace(group[0], trend={"kind": "too few"})])
    own = [0.003 / WIDE] * 8
    assert row["p"] == pytest.approx(odd(level, own, 1)[6]) and row["p"] < 0.01
    assert (row["engine"], row["quantity"], row["unit"], row["value"]) == ("e6", "q", "deg", 1.6)
    assert row["sisters"] == pytest.approx(np.median(level[:6] + level[7:]))
    with monkeypatch.context() as m:
        m.setattr(report, "ODD", row["p"])
        assert report._outliers(group) == [], "what one healthy engine in a hundred is, is not odd"
    both = report._outliers([*group, *(told(k, v, "r") for k, v in enumerate(level))])
    assert [(r["engine"], r["quantity"]) for r in both] == [("e6", "q"), ("e6", "r")]
    assert both[0]["p"] == pytest.approx(2.0 * row["p"]), "over two quantities chance has twice the tries"


# ---- tables ----------------------------------------------------------------------------------------------------------

OF = ("path", "engine", "time", "key")


def database(**tables: list[dict[str, Any]]) -> Any:
    """A database as `roll_up` gives it, of these rows; a table without any has one of nobody."""
    import duckdb
    import pyarrow as pa

    idle: dict[str, dict[str, Any]] = {
        "effects": {"effect": "", "stage": "", "parameter": "", "unit": "", "value": 0.0, "low": 0.0, "high": 0.0,
                    "neutral": 0.0, "probability": 0.0},
        "nominal": {"stage": "", "parameter": "", "unit": "", "value": 0.0, "low": 0.0, "high": 0.0, "table": 0.0,
                    "tolerance": 0.0},
        "coverage": {"effect": "", "stage": "", "needs": ""},
    }  # fmt: skip
    db = duckdb.connect(config={"threads": "1"})
    nobody = {"path": "", "engine": "", "time": None, "key": ""}
    for name in ("logs", *idle):
        rows = tables.get(name) or [nobody | idle[name]]
        table = pa.Table.from_pylist(rows)
        times = pa.array([row["time"] for row in rows], pa.float64())
        db.register("rows", table.set_column(table.column_names.index("time"), "time", times))
        db.execute(f"CREATE TABLE {name} AS SELECT * FROM rows")
    return db


def logs(engine: str, n: int, **more: Any) -> list[dict[str, Any]]:
    row = {"engine": engine, "status": "done", "reason": "", "verdict": "none", "duration_s": 60.0} | more
    return [
        {"path": f"{engine}/{k:03d}", "time": 1e9 + TIMES[k % 16] * YEAR, "key": f"{engine}{k}"} | row for k in range(n)
    ]


def named(log: dict[str, Any], value: float, half: float = 0.1, **more: Any) -> dict[str, Any]:
    row = {
        "effect": "dip",
        "stage": "actuator",
        "parameter": "depth",
        "unit": "MPa",
        "neutral": 0.0,
        "probability": 0.9,
    }
    return {k: log[k] for k in OF} | row | {"value": value, "low": value - half, "high": value + half} | more


@pytest.mark.parametrize(
    ("n", "names", "blind", "lacks"),
    [(2, 2, 0, False), (8, 3, 0, False), (8, 4, 0, True), (40, 3, 34, False), (40, 4, 34, True), (40, 5, 38, True),
     (3, 3, 0, True), (10, 4, 0, False), (42, 8, 0, True)],
)  # fmt: skip
def test_an_engine_lacks_an_effect_that_false_names_do_not_explain(n: int, names: int, blind: int, lacks: bool) -> None:
    """A twentieth of the logs names some effect falsely; the chance of so many of those that could show it."""
    of = logs("e", n)
    effects = [named(log, 1.0 + k, probability=0.5 + 0.1 * k) for k, log in enumerate(of[:names])]
    missed = [{k: log[k] for k in OF} | {"effect": "dip", "stage": "actuator", "needs": "x"} for log in of[n - blind :]]
    (row,) = report._lacks(database(logs=of, effects=effects, coverage=missed if blind else []))
    able = max(n - blind, names)
    assert (row["named"], row["able"], row["share"]) == (names, able, pytest.approx(names / able))
    assert row["chance"] == pytest.approx(1.0 - stats.binom.cdf(names - 1, able, 0.05))
    assert row["lacks"] == lacks == (row["chance"] < 1e-3)
    assert row["probability"] == pytest.approx(np.mean([e["probability"] for e in effects]))
    times = [e["time"] for e in effects]
    assert (row["first"], row["last"], row["key"]) == (min(times), max(times), f"e{names - 1}")


def test_one_name_is_no_lack_however_small_its_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "FALSE", 1e-4)
    one, two = logs("e", 1), logs("f", 2)
    said = report._lacks(database(logs=[*one, *two], effects=[named(log, 1.0) for log in [*one, *two]]))
    assert [(r["engine"], r["lacks"]) for r in said] == [("e", False), ("f", True)]


def test_silent_logs_say_that_an_effect_is_as_small_as_the_smallest_that_was_told() -> None:
    of = logs("e", 16) + logs("healthy", 2)
    of[0]["verdict"], of[1]["status"], of[2]["time"] = "unknown", "refused", None
    sizes = {k: 0.1 * k for k in range(8, 16)}
    effects = [named(of[k], v) for k, v in sizes.items()]
    effects.append(named(of[16], 0.45, 0.4))  # of another engine: the smallest that is told from nothing
    effects.append(named(of[17], 0.05, 0.4))  # told from nothing by no means
    effects.append(named(of[3], 1.0, effect="rival"))
    missed = [
        {k: of[n][k] for k in OF} | {"effect": effect, "stage": stage, "needs": "x"}
        for n, effect, stage in (
            (4, "dip", "actuator"),
            (5, "", "actuator"),
            (6, "other", "actuator"),
            (7, "", "other"),
        )
    ]
    db = database(logs=of, effects=effects, coverage=missed)
    (s,) = report._effects(db, report._lacks(db))
    assert s.keys == ["e6", "e7", *(f"e{k}" for k in sizes)] and s.quantity == "dip.depth" and s.kind == "effect"
    assert s.told.tolist() == [False] * 2 + [True] * 8
    assert s.y.tolist() == pytest.approx([0.0, 0.0, *sizes.values()])
    assert s.s.tolist() == pytest.approx([0.45, 0.45, *[0.2 / WIDE] * 8])
    assert (s.engine, s.unit, s.neutral, s.tolerance) == ("e", "MPa", 0.0, None)


def test_an_effect_that_no_log_tells_from_nothing_has_no_series() -> None:
    of = logs("e", 4)
    db = database(logs=of, effects=[named(log, 0.05) for log in of])
    lacks = report._lacks(db)
    assert lacks[0]["lacks"] and report._effects(db, lacks) == []


def test_all_logs_may_name_an_effect() -> None:
    of = logs("e", 4)
    db = database(logs=of, effects=[named(log, 1.0) for log in of])
    (s,) = report._effects(db, report._lacks(db))
    assert s.told.tolist() == [True] * 4 and s.keys == ["e0", "e1", "e2", "e3"]


def parameter(log: dict[str, Any], name: str, value: float, width: float, tolerance: float | None) -> dict[str, Any]:
    row = {"stage": "linkage", "parameter": name, "unit": "deg", "value": value, "table": 0.0, "tolerance": tolerance}
    return {k: log[k] for k in OF} | row | {"low": value - width / 2, "high": value + width / 2}


def test_a_nominal_parameter_counts_where_a_log_tells_it_and_where_no_effect_has_it() -> None:
    """The interval of a tolerance alone is 2 * 1.6449 / sqrt(3) of it wide; from nine tenths of it nothing is told."""
    of, untold = logs("e", 6), 0.9 * WIDE / np.sqrt(3.0)
    rows = [parameter(of[k], "p", 0.1 * k, (untold + d) * 0.5, 0.5) for k, d in enumerate((-1e-6, 1e-6, -1.0))]
    rows += [parameter(log, "free", 7.0, 99.0, None) for log in of[:2]]
    rows += [parameter(log, "linkage.vigv_play", 0.01, 0.01, 0.08) for log in of]
    db = database(logs=of, nominal=rows, effects=[named(log, 0.2, effect="linkage_backlash", parameter="vigv",
                                                        stage="linkage") for log in of[4:]])  # fmt: skip
    said = {s.quantity: s for s in report._nominal(db, [])}
    assert said.keys() == {"free", "linkage.vigv_play", "p"} and said["p"].keys == ["e0", "e2"]
    assert (said["p"].tolerance, said["p"].neutral, said["p"].kind) == (0.5, 0.0, "nominal")
    lack = {"engine": "e", "effect": "linkage_backlash", "lacks": True}
    assert {s.quantity for s in report._nominal(db, [lack])} == {"free", "p"}
    assert {s.quantity for s in report._nominal(db, [lack | {"lacks": False}])} == said.keys()
    (whole,) = report._effects(db, [lack])
    assert whole.told.tolist() == [True] * 6 and whole.y.tolist() == pytest.approx([0.01] * 4 + [0.21] * 2)


def test_a_value_at_the_end_of_its_tolerance_says_only_that_there_is_no_less() -> None:
    of = logs("e", 3)
    rows = [parameter(log, "p", v, 0.1, 0.5) for log, v in zip(of, (0.5, -0.4995, 0.499), strict=True)]
    found = report._nominal_parts(database(logs=of, nominal=rows), "e", "p")
    assert found == {
        "e/000": (0.5, pytest.approx(0.1), True), "e/001": (-0.4995, pytest.approx(0.1), True),
        "e/002": (0.499, pytest.approx(0.1), False),
    }  # fmt: skip


def test_a_view_has_every_part_and_leaves_its_tables_in_the_database() -> None:
    of = [
        *logs("e", 16),
        *logs("f", 16, verdict="missing"),
        *logs("g", 1, status="refused", reason="why", verdict=None),
    ]
    rows = [parameter(log, name, (0.05 if name == "a" else 2.0 * k / 16) + 1e-3 * NOISE[k % 16], 0.01, 9.0)
            for name in "ab" for k, log in enumerate(of[:16])]  # fmt: skip
    missed = [{k: log[k] for k in OF} | {"effect": "dip", "stage": "actuator", "needs": "x"} for log in of[:3]]
    db = database(logs=of, nominal=rows, coverage=missed, effects=[named(log, 1.0) for log in of[16:22]])
    view = report.view_of(db, {"b": 5.0}, "run")
    assert (view.name, view.engines, view.statuses) == ("run", ["e", "f", "g"], {"done": 32, "refused": 1})
    assert view.verdicts == {"e": {"none": 16}, "f": {"missing": 16}}
    assert view.span == (1e9 + TIMES[0] * YEAR, 1e9 + TIMES[15] * YEAR)
    assert view.refused == [{"engine": "g", "path": "g/000", "status": "refused", "reason": "why"}]
    assert view.coverage == [{"engine": "e", "stage": "actuator", "effect": "dip", "logs": 3, "of": 16, "needs": "x"}]
    assert [(r["engine"], r["effect"]) for r in view.lacking] == [("f", "dip")]
    assert [(s.engine, s.quantity, s.trend["limit"]) for s in view.changed if s.engine == "e"] == [("e", "b", 5.0)]
    stored = {t: db.execute(f"SELECT count(*) FROM {t}").fetchall()[0][0] for t in ("lacks", "trends", "outliers")}
    assert stored == {"lacks": 1, "trends": 3, "outliers": 0}
    with pytest.raises(InputError, match=r"^--limits: quantity \(='c'\) is in no log"):
        report.view_of(db, {"b": 5.0, "c": 1.0, "a": 1.0, "d": 1.0})
    report.view_of(db, {"dip.depth": 1.0})


def test_the_chance_of_a_change_is_shared_by_all_nominal_parameters_of_an_engine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: dict[str, float] = {}

    def judged(s: Series, limits: dict[str, float], sure: float) -> Series:
        asked[s.quantity] = sure
        return replace(s, trend={"kind": "none"})

    monkeypatch.setattr(report, "_judged", judged)
    of = logs("e", 16)
    rows = [parameter(log, name, 0.05, 0.01, 9.0) for name in "abcd" for log in of]
    report.view_of(database(logs=of, nominal=rows, effects=[named(log, 1.0) for log in of]), {})
    assert asked == {"dip.depth": 1e-3, **dict.fromkeys("abcd", pytest.approx(0.0025))}


def test_limits_are_read_from_two_columns_and_perhaps_others(tmp_path: Path) -> None:
    assert report.limits_of(None) == {}
    file = tmp_path / "l.csv"
    file.write_text("quantity,limit\na.b, 1.5\nc,-2\n")
    assert report.limits_of(str(file)) == {"a.b": 1.5, "c": -2.0}
    file.write_text("note,quantity,limit\nx,a.b,1.5\n")
    assert report.limits_of(str(file)) == {"a.b": 1.5}
    file.write_text("quantity,note\na,b\n")
    with pytest.raises(InputError, match="needs the columns quantity, limit; has quantity, note"):
        report.limits_of(str(file))


def test_each_log_that_the_page_leads_to_has_its_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def page(key: str, answer: dict[str, Any]) -> Any:
        return SimpleNamespace(write=lambda file: file.write_text(f"{key} {answer}"))

    monkeypatch.setattr(report, "log_page", page)
    for _ in range(2):
        report.write_pages(tmp_path / "deep" / "logs", {"a": {"n": 1}, "b": {}})
    said = {f.name: f.read_text() for f in (tmp_path / "deep" / "logs").iterdir()}
    assert said == {"a.html": "a {'n': 1}", "b.html": "b {}"}


def test_half_an_interval_is_a_normal_s_at_ninety_percent() -> None:
    assert pytest.approx(stats.norm.interval(0.9)[1]) == HALF and pytest.approx(2.0 * HALF, rel=1e-4) == WIDE
