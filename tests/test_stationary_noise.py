"""Noise that is the same under every condition is told from missing physics, which is not."""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.loggers import Logger, recorded
from hil.logs import Log
from tests import rig
from tests.firmware_on_rig import firmware
from tests.rig import Hidden
from tests.test_recorders import verdicts
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.settings import AGREES
from vaneloop.identification.subsystem import Array, Effect, Parameter, Stage
from vaneloop.identification.vane_chain.chain import build_chain
from vaneloop.identification.vane_chain.stationary_noise import (
    Expected,
    _alike,
    _noise_in,
    _of_parameters,
    _over_blocks,
    bounded,
    expect_stationary_noise,
    like,
)
from vaneloop.identification.vane_chain.subsystem_data import Made
from vaneloop.identification.workflow import diagnose

DT, ROWS = 0.01, 30_000
T = DT * np.arange(ROWS)
SPEED = np.interp(T % 20.0, [0.0, 4.0, 5.0, 9.0, 10.0, 14.0, 15.0, 20.0], [0.0, 0.0, 3.0, 3.0, 0.0, 0.0, -3.0, -3.0])
FLOOR = 1.0


def coloured(seed: int, tau: float = 0.1) -> Array:
    """Noise of RMS 1 with that correlation time (s)."""
    a, white = np.exp(-DT / tau), np.random.default_rng([seed, 1]).standard_normal(ROWS)
    return np.asarray(scipy.signal.lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], white))


def said(
    error: Array,
    window: float | None = None,
    made: Array | None = None,
    own: Array | None = None,
    hidden: Array | None = None,
) -> Expected | None:
    """What is said of an error beyond a floor of 1, as an actuator's or linkage's that moves and rests; ``own``: what
    its output does at rest, the same noise by default; ``hidden``: draws of what its rows hide.
    """
    regimes = {"time": T, "stroke speed": SPEED, "direction": np.sign(SPEED), "stroke": np.cumsum(SPEED) * DT}
    stage = Stage("s", ("y",), ("mm",), (), (), lambda p: np.zeros((len(p), 1, ROWS)), T, error[None], window=window,
                  regimes=regimes, floor=np.array([FLOOR]), memory=10.0, lost=hidden)  # fmt: skip
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    e = judge.errors(stage.neutral()[None])[0, 0]
    output = np.cumsum(SPEED) * DT + (error if own is None else own)
    return _noise_in(judge, 0, e, np.zeros(ROWS) if made is None else made, output, judge.lost()[0])


PHYSICS: dict[str, Callable[[Array], Array]] = {
    "a lag": lambda white: white + 0.5 * SPEED,
    "friction": lambda white: white + 1.5 * np.sign(SPEED),
    "a bias": lambda white: white + 1.2,
    "an error that grows with time": lambda white: white * (1.0 + T / T[-1]),
    "an oscillation": lambda white: white + 1.5 * np.sin(2.0 * np.pi * 7.3 * T),
    "vibration in motion": lambda white: white + np.abs(SPEED) * np.sin(40.0 * T),
}


@given(st.integers(0, 2**31), st.sampled_from([0.03, 0.1, 0.4]), st.floats(0.8, 3.0))
def test_what_is_the_same_under_every_condition_is_noise(seed: int, tau: float, size: float) -> None:
    white = np.random.default_rng(seed).standard_normal(ROWS)
    found = said(white + size * coloured(seed, tau))
    assert found is not None and found.share == 0.0
    assert found.size == pytest.approx(np.hypot(1.0, size), rel=0.2)


@given(st.integers(0, 2**31), st.sampled_from(sorted(PHYSICS)))
def test_what_turns_on_a_condition_is_none(seed: int, law: str) -> None:
    assert said(PHYSICS[law](np.random.default_rng(seed).standard_normal(ROWS))) is None


@given(st.integers(0, 2**31), st.floats(0.5, 2.0))
def test_noise_does_not_follow_the_nominal_parameters_and_play_at_its_limit_does(seed: int, size: float) -> None:
    """A slope of the output by a parameter; and two outputs, of which each is judged by itself."""
    slope = np.array([np.sign(SPEED), SPEED])
    nominal = (Parameter("a", 0.0, "mm", tolerance=0.1), Parameter("b", 0.0, "mm", tolerance=0.1))
    white = np.random.default_rng(seed).standard_normal((2, ROWS)) + size * np.array(
        [coloured(seed), coloured(seed + 1)]
    )
    for more in (0.0, 1.5):
        stage = Stage("s", ("x", "y"), ("mm", "mm"), nominal, (), lambda p: p[:, :, None] * slope, T,
                      white + np.array([[more], [0.0]]) * slope, floor=np.ones(2), memory=10.0)  # fmt: skip
        judge = LeastSquaresProblem(stage, np.ones(2))
        x, y = _of_parameters(judge, stage.neutral())
        there = SPEED != 0.0
        left = judge.errors(stage.neutral()[None])[0, 0]
        assert x == pytest.approx((left @ slope[0]) ** 2 / there.sum() / (left @ left)) and y < 0.01
        assert (x > 0.05) == (more > 0.0)


@pytest.mark.parametrize(("size", "known"), [(1.0, False), (1.0, True), (0.0, True)])
def test_what_an_effect_of_the_library_explains_is_no_noise(size: float, known: bool) -> None:
    """An error that is the same under every condition, as an effect's that turns on none of them, and then it is
    another's.
    """
    law, white = coloured(7), np.random.default_rng(8).standard_normal(ROWS)
    error = white + size * law + (0.0 if size else coloured(9))
    effects = (Effect("stray", (Parameter("size", 0.0, "mm", -10.0, 10.0),), ((0.5,), (-0.5,))),) if known else ()
    regimes = {"time": T, "stroke speed": SPEED, "direction": np.sign(SPEED)}
    stage = Stage("actuator", ("x_lvdt",), ("mm",), (), effects,
                  lambda p: (p @ np.ones((p.shape[1], 1)) * law)[:, None], T, error[None], regimes=regimes,
                  floor=np.ones(1), memory=10.0, noise=lambda when, e: 1.0)  # fmt: skip
    stage.made = Made(lambda driven: stage, SimpleNamespace(columns={"x_lvdt": error}))  # type: ignore[arg-type]
    notes = expect_stationary_noise([stage])
    assert stage.floor is not None
    if size and known:
        assert not notes and stage.floor[0] == FLOOR
    else:
        assert len(notes) == 1 and stage.floor[0] == pytest.approx(np.sqrt(2.0), rel=0.1)


def test_a_drift_in_every_window_is_no_noise() -> None:
    """That of a piston whose valve has a null bias: alike under every condition, and always to the same side."""
    white = np.random.default_rng(1).standard_normal(ROWS)
    assert said(white + 4.0 * (T % 1.0), window=1.0) is None
    assert said(white + coloured(1), window=1.0) is not None


def test_an_error_that_its_output_does_not_show_where_it_is_quiet_is_no_noise_of_it() -> None:
    """That of a piston that rests within its valve's dead band: alike under every condition."""
    white = np.random.default_rng(5).standard_normal(ROWS)
    error = white + 3.0 * coloured(5)
    assert said(error, window=1.0) is not None
    assert said(error, window=1.0, own=white) is None
    assert said(error, window=1.0, own=white, made=np.full(ROWS, 0.2)) is None  # too little by what drives it
    bursts = np.where(T % 30.0 < 3.0, 10.0, 1.0) * error  # and where blocks differ so much that bins tell little
    assert said(bursts, window=1.0, own=white, made=np.full(ROWS, 0.2)) is None
    through = said(error, window=1.0, own=white, made=np.full(ROWS, 9.0))  # but it may come in by what drives it
    assert through is not None and through.share > 0.5


def test_an_excess_that_the_bins_could_not_tell_is_not_taken_for_noise() -> None:
    white = np.random.default_rng(2).standard_normal(ROWS)
    assert said(white) == Expected(FLOOR, 0.0)
    little = said(1.012 * white)
    assert little is not None and not little.told


@given(st.integers(0, 2**31), st.floats(0.1, 1.0), st.sampled_from(["stroke", "stroke speed"]))
def test_an_excess_under_half_of_a_condition_is_not_taken_for_noise(seed: int, excess: float, of: str) -> None:
    """Whatever its size: it is told from noise, or said to be too small for that."""
    rng = np.random.default_rng(seed)
    condition = np.cumsum(SPEED) * DT if of == "stroke" else SPEED
    more = np.where(condition > np.median(condition), 2.0 * excess, 0.0)
    found = said(np.sqrt(1.0 + more) * rng.standard_normal(ROWS))
    assert found is None or not found.told


@pytest.mark.parametrize("bins", [2, 8])
@pytest.mark.parametrize("blocks", [4, 30])
def test_the_chances_of_the_test_of_a_condition_are_those_of_draws(bins: int, blocks: int) -> None:
    """Bins whose deviation is estimated from as many blocks."""
    rng, excess, draws = np.random.default_rng(bins), 0.4, 1000
    n, away = np.ones((bins, blocks)), excess * np.resize([1.0, -1.0], bins)
    spread = 0.15 * np.sqrt(rng.chisquare(blocks - 1, (draws, bins)) / (blocks - 1))
    noise = 0.15 * rng.standard_normal((draws, bins))
    noise -= noise.mean(axis=1, keepdims=True)  # what is expected is fitted to them
    alike = [_alike(1.0 + e, s, n, excess, 0.05) for e, s in zip(noise, spread, strict=True)]
    unlike = [_alike(1.0 + e + away, s, n, excess, 0.05) for e, s in zip(noise, spread, strict=True)]
    assert np.mean([not one.holds for one in alike]) < 0.06  # noise may differ by `NOISE_ALIKE` besides
    assert np.mean([not one.holds for one in unlike]) > np.mean([one.power for one in unlike]) - 0.1


def test_bins_without_samples_do_not_count_and_a_single_bin_says_nothing() -> None:
    n, ratio, deviation = np.ones((3, 10)), np.array([1.0, 1.01, 0.99]), np.full(3, 0.05)
    empty = np.vstack([n, np.zeros((1, 10))])
    assert _alike(np.append(ratio, np.nan), np.append(deviation, 0.0), empty, 0.4, 0.05) == _alike(
        ratio, deviation, n, 0.4, 0.05
    )
    one = _alike(ratio[:1], deviation[:1], n[:1], 0.4, 0.05)
    assert one.holds and one.power == 0.0


@pytest.mark.parametrize(("least", "expects"), [(1.2, True), (1.06, True), (1.012, False)])
def test_of_outputs_with_one_recorder_one_must_tell(least: float, expects: bool) -> None:
    white = np.random.default_rng(3).standard_normal((2, ROWS))
    white *= np.array([[1.012], [least]]) / np.sqrt(np.mean(white**2, axis=1, keepdims=True))
    regimes = {"stroke speed": SPEED, "direction": np.sign(SPEED), "time": T}

    def made(driven: object) -> Stage:
        return Stage("linkage", ("vigv", "vgv1"), ("deg", "deg"), (), (), lambda p: np.zeros((len(p), 2, ROWS)), T,
                     white, regimes=regimes, floor=np.full(2, FLOOR), memory=10.0)  # fmt: skip

    stage = made(None)
    stage.noise = lambda when, error: FLOOR
    columns = {c: np.cumsum(SPEED) * DT + w for c, w in zip(("vigv", "vgv1"), white, strict=True)}
    stage.made = Made(made, SimpleNamespace(columns=columns))  # type: ignore[arg-type]
    notes = expect_stationary_noise([stage])
    assert bool(notes) == (least > AGREES)  # only of what would fail
    assert stage.floor == pytest.approx([1.012, least] if expects else [FLOOR, FLOOR], rel=0.01 if expects else 0.0)


def test_noise_through_a_gain_is_expected_where_the_gain_is() -> None:
    """Of a channel that drives the subsystem: half of its power is an error, where there is a gain."""
    gain = np.where(T % 20.0 < 10.0, 0.1, 3.0)
    error = np.random.default_rng(3).standard_normal(ROWS) + np.sqrt(0.5) * gain * coloured(3)
    found = said(error, made=gain**2)
    assert found is not None and found.share == pytest.approx(0.5, rel=0.15)
    assert said(error) is None


@given(st.integers(0, 2**31), st.floats(0.5, 2.0))
def test_what_rows_hide_is_expected_where_they_hide_it(seed: int, size: float) -> None:
    """Of the floor's power 0.6 is of what slow rows hide of motion; an upper bound of it may stand there in vain."""
    rng, hides = np.random.default_rng(seed), np.sqrt(0.6 * (SPEED != 0.0) / np.mean(SPEED != 0.0))
    draws = hides * rng.standard_normal((8, 1, ROWS))
    error = np.sqrt(0.4) * rng.standard_normal(ROWS) + draws[0, 0] + size * coloured(seed)
    for one in (error, np.sqrt(0.4) * rng.standard_normal(ROWS) + np.hypot(0.7, size) * coloured(seed)):
        found = said(one, hidden=draws)
        assert found is not None and found.size == pytest.approx(np.sqrt(np.mean(one**2)), rel=0.01)
    assert said(np.sqrt(0.4) * rng.standard_normal(ROWS) + 3.0 * draws[1, 0], hidden=draws) is None


@given(st.integers(0, 2**31), st.sampled_from([0.02, 0.1, 0.3]))
def test_drawn_noise_has_the_power_and_the_colour_of_what_was_seen(seed: int, tau: float) -> None:
    seen = coloured(seed, tau)
    drawn = like(seen.reshape(-1, 400), ROWS, seed)
    assert np.std(drawn) == pytest.approx(np.std(seen), rel=0.15)
    lag = round(tau / DT)
    assert np.mean(drawn[lag:] * drawn[:-lag]) / np.var(drawn) == pytest.approx(np.exp(-1.0), abs=0.15)


@given(st.integers(0, 2**31), st.lists(st.floats(-2.0, 5.0), min_size=1, max_size=3), st.booleans())
def test_bounded_least_squares_are_those_of_scipy(seed: int, truth: list[float], endless: bool) -> None:
    rng, most = np.random.default_rng(seed), np.array([np.inf if endless else 1.0, 4.0, 1.0])[: len(truth)]
    a = rng.uniform(0.0, 1.0, (20, len(truth)))
    b = a @ truth + 0.1 * rng.standard_normal(20)
    ours, theirs = bounded(a, b, most), scipy.optimize.lsq_linear(a, b, (0.0, most), method="bvls").x
    assert np.all((ours >= 0.0) & (ours <= most))
    assert np.sum((a @ ours - b) ** 2) <= np.sum((a @ theirs - b) ** 2) * (1.0 + 1e-9)


def test_the_jackknife_over_blocks_is_the_deviation_of_a_mean() -> None:
    values = np.random.default_rng(4).standard_normal((3, 40)) + 5.0
    ratio, deviation = _over_blocks(values, np.ones((3, 40)))
    assert ratio == pytest.approx(values.mean(axis=1))
    assert deviation == pytest.approx(values.std(axis=1, ddof=1) / np.sqrt(40.0))
    values[1, 1:], there = 0.0, np.ones((3, 40))
    there[1, 1:] = 0.0  # a bin that one block has alone
    assert np.isfinite(_over_blocks(values, there)).all()


RECORDERS = {
    "coloured noise": Logger(100, colour=(0.1, 1.0)),
    "coloured noise in fast rows": Logger(1000, colour=(0.06, 1.0)),
    "a clock that drifts": Logger(200, drift=-4e-5),
    "a clock that drifts, in slow rows": Logger(10, drift=-4e-5),
    "slow rows": Logger(20),
    "coloured noise in slow rows": Logger(10, colour=(0.5, 1.0)),
    "slow rows behind a mean": Logger(20, window=0.05),
    "slow rows behind a low-pass": Logger(10, filter=(2, 2.4)),
}


@functools.cache
def five_minutes() -> dict[str, Array]:
    """A clean log of the rig with a row each ms."""
    return rig.simulate(rig.manoeuvre(47, 300.0), firmware(), seed=47, rate=1000).log


@pytest.mark.slow
@pytest.mark.parametrize("kind", RECORDERS)
def test_what_a_recorder_adds_to_a_clean_log_is_no_missing_physics(kind: str) -> None:
    log = recorded(five_minutes(), RECORDERS[kind], np.random.default_rng(2))
    answer = verdicts(build_chain(Log(kind, log)))
    assert set(answer.values()) == {"none"}, answer


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "stage"),
    [
        (Hidden("valve_dead_band", {"half_width": 1e-3}), "actuator"),
        (Hidden("valve_null_bias", {"bias": 5e-4}), "actuator"),
        (Hidden("linkage_backlash", {"stage": 0, "width": 0.01}), "linkage"),
    ],
)
def test_physics_is_named_behind_the_noise_of_a_recorder(hidden: Hidden, stage: str) -> None:
    log = rig.simulate(rig.manoeuvre(41, 120.0), firmware(), [hidden], seed=41, rate=1000).log
    chain = build_chain(Log("log", recorded(log, RECORDERS["coloured noise"], np.random.default_rng(3))))
    (d,) = diagnose([chain.stage(stage)], workers=1).stages
    assert hidden.name in {n for f in d.effects for n in (f.effect, *f.rivals)}, d
