"""The search for missing physics on small stages made of numpy, which know nothing of vanes: it names what is missing,
and nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Barrier

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vaneloop.base.terminal import plain
from vaneloop.identification import Effect, Parameter, Stage, StageError
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.regimes import locate, onset, regimes, shape, step_in
from vaneloop.identification.results import Found, StageDiagnosis
from vaneloop.identification.selection.diagnosis import diagnose_stage, extend_stage
from vaneloop.identification.subsystem import noise_of, reach_of
from vaneloop.identification.workflow import compare_stages, diagnose, diagnosis_json, locate_stages

DT = 0.01  # s
N = 10_000  # samples: 100 s
T = np.arange(N) * DT
NOISE = 0.005  # mm
GAIN = 3.0  # mm/s per mA
FLOOR = np.array([NOISE])


def wave(seed: int, amplitude: float, slowest: float, fastest: float) -> np.ndarray:
    """A smooth random signal: eight sines between two frequencies (Hz)."""
    rng = np.random.default_rng([77, seed])
    f, phase = rng.uniform(slowest, fastest, 8), rng.uniform(0, 2 * np.pi, 8)
    return amplitude * np.sqrt(2 / 8) * np.sin(2 * np.pi * f[:, None] * T + phase[:, None]).sum(axis=0)


CURRENT = wave(1, 9.0, 0.05, 1.0)  # mA
LOAD = 0.8 + 0.12 * np.sin(2 * np.pi * T / 37.0) + 0.08 * np.sin(2 * np.pi * T / 11.0)  # a slow condition

NULL_BIAS = Effect(
    "null_bias", (Parameter("bias", 0.0, "mA", -5.0, 5.0),), ((-1.0,), (-0.1,), (0.1,), (1.0,)), "any motion"
)
DEAD_BAND = Effect(
    "dead_band", (Parameter("half_width", 0.0, "mA", 0.0, 5.0),), ((0.1,), (0.5,), (2.0,)), "small currents"
)
ASYMMETRY = Effect("gain_asymmetry", (Parameter("share", 0.0, "1", -0.5, 0.5),), ((-0.1,), (0.1,)), "motion both ways")
SATURATION = Effect(
    "saturation", (Parameter("limit", 40.0, "mA", 2.0, 40.0),), ((30.0,), (20.0,), (12.0,), (6.0,)), "large currents"
)
LIBRARY = (NULL_BIAS, DEAD_BAND, ASYMMETRY, SATURATION)
TRUTH = {"null_bias": (0.4,), "dead_band": (0.6,), "gain_asymmetry": (0.06,), "saturation": (14.0,)}


def speed(current: np.ndarray, bias: np.ndarray, half: np.ndarray, share: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Valve characteristic: current (mA) to effective current, for columns of parameters."""
    i = current + bias
    i = np.sign(i) * np.maximum(np.abs(i) - half, 0.0)
    i = i * (1.0 + share * np.sign(i))
    return np.clip(i, -limit, limit)


def simulator(effects: tuple[Effect, ...]) -> Callable[[np.ndarray], np.ndarray]:
    """``run`` of a stage that has these effects of the library: stroke (mm) from zero, the integral of gain times the
    characteristic.
    """
    column = {e.name: k + 1 for k, e in enumerate(effects)}

    def run(thetas: np.ndarray) -> np.ndarray:
        values = [
            thetas[:, column[e.name], None] if e.name in column else np.full((len(thetas), 1), e.parameters[0].value)
            for e in LIBRARY
        ]
        return (np.cumsum(thetas[:, :1] * speed(CURRENT, *values), axis=1) * DT)[:, None, :]

    return run


def integrator(
    seed: int = 0,
    effects: tuple[Effect, ...] = LIBRARY,
    gain: float = GAIN,
    added: np.ndarray | float = 0.0,
    **hidden: float,
) -> Stage:
    """An integrating stage with hidden effects (name=value), and ``added`` to the measured stroke."""
    truth = np.array([[gain, *(hidden.get(e.name, e.parameters[0].value) for e in LIBRARY)]])
    measured = simulator(LIBRARY)(truth)[0] + added + NOISE * np.random.default_rng([5, seed]).standard_normal((1, N))
    direction = np.sign(np.where(np.abs(CURRENT) > 0.2, CURRENT, 0.0))
    return Stage(
        name="slide", outputs=("x",), units=("mm",), parameters=(Parameter("gain", GAIN, "mm/s/mA", 2.0, 4.0, 0.15),),
        effects=effects,
        run=simulator(effects), t=T, measured=measured, window=1.0,
        regimes={"time": T, "current": CURRENT, "direction": direction, "load": LOAD},
        regime_units={"time": "s", "current": "mA", "load": "kN"}, floor=FLOOR,
    )  # fmt: skip


U, V, W = wave(2, 1.0, 0.05, 1.0), wave(3, 1.0, 0.05, 1.0), wave(4, 1.0, 0.05, 1.0)
GAUGE_FLOOR = np.array([0.01, 0.02, 0.03])


def linear(name: str, row: tuple[float, float, float], of: np.ndarray) -> tuple[Effect, np.ndarray]:
    """An effect that adds size * row * of to three outputs."""
    return Effect(name, (Parameter("size", 0.0, "1", -5.0, 5.0),), ((-1.0,), (0.1,), (1.0,))), np.outer(row, of)


def gauges(terms: list[tuple[Effect, np.ndarray]], sizes: list[float], seed: int = 0, bias: float = 0.0) -> Stage:
    """A static stage with three outputs of different noise, each with a bias that moves it alone."""
    shapes = np.array([s for _, s in terms])
    lead = np.outer((1.0, 2.0, -1.0), U)

    def simulate(thetas: np.ndarray) -> np.ndarray:
        return lead + thetas[:, :3, None] + np.einsum("se,eon->son", thetas[:, 3:], shapes)

    rng = np.random.default_rng([6, seed])
    measured = simulate(np.array([[bias, 0.0, 0.0, *sizes]]))[0] + GAUGE_FLOOR[:, None] * rng.standard_normal((3, N))
    return Stage(
        name="gauges", outputs=("a", "b", "c"), units=("deg",) * 3,
        parameters=tuple(Parameter(f"{k}_bias", 0.0, "deg", -1.0, 1.0, 0.1, k) for k in "abc"),
        effects=tuple(e for e, _ in terms),
        run=simulate, t=T, measured=measured, regimes={"time": T, "u": U, "v": V}, floor=GAUGE_FLOOR,
    )  # fmt: skip


def names(d: StageDiagnosis) -> set[str]:
    return {f.effect for f in d.effects}


def holds(f: Found, parameter: str, truth: float) -> bool:
    p = f.parameters[parameter]
    return float(p["low"]) <= truth <= float(p["high"])  # type: ignore[arg-type]


def search(stage: Stage) -> StageDiagnosis:
    assert stage.floor is not None
    return diagnose_stage(stage, stage.floor)


# ---- nothing missing -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_clean_data_lack_nothing(seed: int) -> None:
    d = search(integrator(seed))
    assert (d.verdict, d.effects) == ("none", [])
    assert d.error_after[0] == pytest.approx(NOISE, rel=0.03)


@pytest.mark.parametrize("seed", range(3))
def test_clean_static_data_lack_nothing(seed: int) -> None:
    d = search(gauges([linear("slope", (1, 1, 1), V), linear("tilt", (1, 0, -1), W)], [0.0, 0.0], seed))
    assert (d.verdict, d.effects) == ("none", [])


def test_a_floor_known_only_to_one_per_cent_is_no_reason_to_find_an_effect() -> None:
    stage = integrator()
    assert diagnose_stage(stage, 0.99 * FLOOR).verdict == "none"


def test_a_parameter_moved_within_its_tolerance_is_recalibrated_and_no_effect() -> None:
    d = search(integrator(gain=3.09))
    assert (d.verdict, d.effects) == ("none", [])
    (q,) = d.recalibrated
    assert q["parameter"] == "gain" and q["unit"] == "mm/s/mA"
    assert q["low"] <= 3.09 <= q["high"] and not q["low"] <= GAIN <= q["high"]  # type: ignore[operator]


def test_a_nominal_parameter_that_stayed_is_not_called_recalibrated() -> None:
    moved = sum(bool(search(integrator(seed)).recalibrated) for seed in range(5))
    assert moved <= 2  # 90 % intervals


def test_only_the_output_whose_bias_moved_is_recalibrated() -> None:
    d = search(gauges([linear("slope", (1, 1, 1), V)], [0.0], bias=0.05))
    assert d.verdict == "none"
    moved = {q["parameter"]: q["value"] for q in d.recalibrated}
    assert moved.pop("a_bias") == pytest.approx(0.05, abs=1e-3)
    assert all(abs(float(v)) < 2e-3 for v in moved.values())  # type: ignore[arg-type]


# ---- effects ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TRUTH)
def test_each_effect_is_named_with_its_parameter_inside_its_interval(name: str) -> None:
    (truth,) = TRUTH[name]
    d = search(integrator(3, **{name: truth}))
    assert d.verdict == "missing"
    (found,) = d.effects
    assert found.effect == name and found.rivals == [] and found.probability > 0.9
    (parameter,) = found.parameters
    assert holds(found, parameter, truth)
    assert d.error_before[0] > 1.5 * NOISE and d.error_after[0] == pytest.approx(NOISE, rel=0.03)


def test_ninety_per_cent_intervals_hold_the_truth_about_nine_times_in_ten() -> None:
    hits = []
    for seed in range(20):
        stage = integrator(100 + seed, null_bias=0.1)
        start = stage.neutral()
        start[1] = 0.05
        fit = LeastSquaresProblem(stage, FLOOR).fit(("null_bias",), start)
        k = int(np.flatnonzero(fit.free == 1)[0])
        hits.append(fit.low[k] <= 0.1 <= fit.high[k])
    assert sum(hits) >= 14  # fewer than 14 of 20 happen once in 400 when the share is 0.9
    assert np.all(fit.high - fit.low > 0)


@pytest.mark.parametrize(
    "pair", [("null_bias", "dead_band"), ("dead_band", "gain_asymmetry"), ("gain_asymmetry", "saturation")]
)
def test_two_effects_together_are_both_found(pair: tuple[str, str]) -> None:
    d = search(integrator(4, **{p: TRUTH[p][0] for p in pair}))
    assert d.verdict == "missing" and names(d) == set(pair)
    for f in d.effects:
        (parameter,) = f.parameters
        value = float(f.parameters[parameter]["value"])  # type: ignore[arg-type]
        assert value == pytest.approx(TRUTH[f.effect][0], rel=0.05)
    assert d.error_after[0] < 1.1 * NOISE


def test_two_effects_that_gain_little_alone_are_found_as_a_pair() -> None:
    # what is seen is 0.25 v; alone neither u nor 0.25 v - u looks like it
    first, second = linear("first", (1, 1, 1), U), linear("second", (1, 1, 1), 0.25 * V - U)
    stage = gauges([linear("decoy", (1, 0, 0), W), first, second], [0.0, 1.0, 1.0])
    judge = LeastSquaresProblem(stage, GAUGE_FLOOR)
    base = judge.fit((), stage.neutral()).held_out.sum()
    for name in ("first", "second"):
        assert judge.fit((name,), stage.neutral()).held_out.sum() > 0.8 * base
    d = search(stage)
    assert d.verdict == "missing" and names(d) == {"first", "second"}
    assert np.all(d.error_after < 1.1 * GAUGE_FLOOR)


def test_an_effect_on_one_output_of_three_is_named() -> None:
    terms = [linear("all_slope", (1, 1, 1), V), linear("b_slope", (0, 1, 0), V), linear("c_slope", (0, 0, 1), V)]
    d = search(gauges(terms, [0.0, 0.05, 0.0]))
    assert d.verdict == "missing" and names(d) == {"b_slope"}
    assert d.effects[0].parameters["size"]["value"] == pytest.approx(0.05, abs=1e-3)
    assert d.error_after[0] == pytest.approx(d.error_before[0], rel=0.02)


def test_effects_that_are_the_same_on_this_data_are_rivals() -> None:
    twin = replace(NULL_BIAS, name="clock_drift")
    stage = integrator(2, effects=(*LIBRARY, twin), null_bias=0.4)

    def both(thetas: np.ndarray) -> np.ndarray:
        merged = thetas[:, :5].copy()
        merged[:, 1] += thetas[:, 5]
        return alone(merged)

    alone = simulator(LIBRARY)
    stage.run = both
    d = search(stage)
    assert d.verdict == "missing"
    (found,) = d.effects
    assert {found.effect, *found.rivals} == {"null_bias", "clock_drift"}
    assert found.probability == pytest.approx(0.5, abs=0.1)


def test_an_effect_that_the_log_does_not_excite_says_what_it_needs() -> None:
    d = search(integrator(effects=(*LIBRARY, replace(NULL_BIAS, name="cold_start", excites="oil below 0 degC"))))
    assert {c.effect: c.reason for c in d.candidates if c.reason} == {"cold_start": "oil below 0 degC"}


def test_extending_by_what_was_named_brings_the_held_out_error_to_the_floor() -> None:
    stage = integrator(5, dead_band=0.6, gain_asymmetry=0.06)
    d = extend_stage(stage, ("dead_band", "gain_asymmetry"))
    errors = [e for _, e in d.steps]
    assert [n for n, _ in d.steps] == ["nominal", "+ gain_asymmetry", "+ dead_band"]  # what explains most comes first
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1.1 and d.error_after[0] < 1.1 * NOISE
    assert d.error_before[0] > 3 * NOISE


def test_parameters_stay_within_their_bounds() -> None:
    d = extend_stage(integrator(null_bias=7.0), ("null_bias",))
    assert d.effects[0].parameters["bias"]["value"] == pytest.approx(5.0, abs=0.2)
    assert np.all(d.final.theta[1] <= 5.0)
    far = LeastSquaresProblem(integrator(gain=3.8), FLOOR).fit((), integrator().neutral())
    assert far.theta[0] == pytest.approx(3.15)  # nominal 3.0, tolerance 0.15


def test_a_parameter_beyond_its_tolerance_is_not_nothing() -> None:
    assert search(integrator(gain=3.8)).verdict != "none"


# ---- unknown ---------------------------------------------------------------------------------------------------------


def unknown(stage: Stage) -> str:
    d = search(stage)
    assert (d.verdict, d.effects) == ("unknown", [])
    return shape(LeastSquaresProblem(stage, d.floor), d.final)[0].text


def test_a_speed_that_depends_on_a_condition_is_unknown_and_the_condition_is_named() -> None:
    text = unknown(integrator(effects=(DEAD_BAND, ASYMMETRY, SATURATION), added=np.cumsum(8.0 * (LOAD - 0.8)) * DT))
    assert "rate of the error of x grows linearly with load" in text and "kN" in text


def test_drag_that_grows_with_a_condition_opposes_the_motion() -> None:
    drag = -4.0 * np.sign(CURRENT) * np.maximum(LOAD - 0.75, 0.0)
    text = unknown(integrator(effects=(NULL_BIAS, SATURATION), added=np.cumsum(drag) * DT))
    assert "load" in text and "opposes the motion" in text


def test_an_oscillation_is_unknown_and_its_frequency_and_amplitude_are_named() -> None:
    stage = integrator(added=0.05 * np.sin(2 * np.pi * 7.3 * T))
    d = search(stage)
    assert d.verdict == "unknown"
    (s,) = shape(LeastSquaresProblem(stage, d.floor), d.final)
    assert s.feature == "frequency" and "oscillates at 7.30 Hz" in s.text
    assert float(s.text.split("amplitude of ")[1].split()[0]) == pytest.approx(0.05, rel=0.1)


def test_a_static_error_is_described_by_the_error_itself() -> None:
    stage = gauges([linear("slope", (1, 1, 1), W)], [0.0])
    stage.measured[1] += 0.2 * V**2
    d = search(stage)
    assert d.verdict == "unknown"
    first = shape(LeastSquaresProblem(stage, d.floor), d.final)[0]
    assert (first.output, first.feature) == ("b", "v")
    assert "error of b grows with the square of v" in first.text


# ---- where and since when --------------------------------------------------------------------------------------------


def test_the_onset_is_found_within_seconds() -> None:
    stage = integrator(1, added=np.cumsum(np.where(T > 62.0, 0.6, 0.0)) * DT)
    judge = LeastSquaresProblem(stage, FLOOR)
    start = onset(judge, judge.fit((), stage.neutral()))
    assert start is not None and abs(start - 62.0) <= 4.0


@given(st.integers(16, 200), st.floats(0.0, 1.0), st.floats(0.0, 3.0), st.integers(0, 10_000))
def test_a_step_is_where_ruptures_finds_it(n: int, at: float, size: float, seed: int) -> None:
    import ruptures

    y = np.random.default_rng(seed).standard_normal(n) + size * (np.arange(n) > at * n)
    assert step_in(y) == ruptures.Binseg(model="l2", min_size=4).fit(y[:, None]).predict(n_bkps=1)[0]


@pytest.mark.parametrize("hidden", [{}, {"null_bias": 0.4}])
def test_what_is_always_or_never_there_has_no_onset(hidden: dict[str, float]) -> None:
    stage = integrator(1, **hidden)
    judge = LeastSquaresProblem(stage, FLOOR)
    assert onset(judge, judge.fit((), stage.neutral())) is None


def test_the_map_of_conditions_points_to_the_bin_that_fails() -> None:
    rng = np.random.default_rng(9)
    stage = integrator(added=np.where((LOAD > 0.72) & (LOAD < 0.76), 0.03, 0.0) * rng.standard_normal(N))
    judge = LeastSquaresProblem(stage, FLOOR)
    found = regimes(judge, judge.fit((), stage.neutral()), 2.0)
    first = found[0]
    assert first.condition == "load" and first.condition_unit == "kN"
    worst = int(np.argmax(first.rms))
    assert first.significant[worst] and first.edges[worst] < 0.76 and first.edges[worst + 1] > 0.72
    assert "load" in first.worst() and "kN" in first.worst()
    far = (first.edges[:-1] > 0.8) | (first.edges[1:] < 0.7)
    assert not first.significant[far].any()
    assert first.samples.sum() == N


def test_clean_data_fail_nowhere() -> None:
    for seed in range(4):
        judge = LeastSquaresProblem(integrator(seed), FLOOR)
        found = regimes(judge, judge.fit((), judge.stage.neutral()), 2.0)
        assert {r.condition for r in found} == {"time", "current", "direction", "load"}
        assert not any(r.significant.any() for r in found)


def uneven(where: np.ndarray) -> Stage:
    """Three gauges, the first of which errs by one and a half noise floors more ``where`` that is true."""
    stage = gauges([linear("drift", (1.0, 0.0, 0.0), W)], [0.0])
    more = 1.5 * GAUGE_FLOOR[0] * np.random.default_rng(11).standard_normal(N)
    stage.measured[0] += np.where(where, more, 0.0)
    return stage


def test_what_the_whole_log_hides_is_unknown_where_one_condition_shows_it() -> None:
    found = diagnose([uneven(np.abs(U - np.quantile(U, 0.75)) < 0.03)], workers=1)
    (d,) = found.stages
    assert d.excess < 1.05 and found.verdict == "unknown" and not d.effects
    assert "fails at a: " in d.refused[0] and " at u " in d.refused[0]


def test_one_stretch_of_the_log_is_no_condition() -> None:
    stage = uneven(np.abs(T - 33.0) < 1.0)
    judge = LeastSquaresProblem(stage, GAUGE_FLOOR)
    found = {r.condition: r for r in regimes(judge, judge.fit((), stage.neutral()), 2.0) if r.output == "a"}
    assert found["time"].ratio.max() > 1.1  # one bin has it, and no other of these samples says so
    assert not any(r.significant.any() for r in found.values())
    assert diagnose([stage], workers=1).verdict == "none"


# ---- samples that are not there --------------------------------------------------------------------------------------


def test_missing_samples_do_not_count() -> None:
    rng = np.random.default_rng(3)
    gone = rng.random(N) < 0.05
    gone[4_000:4_700] = True
    clean = integrator(6, dead_band=0.6)
    holes = integrator(6, dead_band=0.6)
    holes.measured[0, gone] = np.nan
    garbage = integrator(6, dead_band=0.6)
    garbage.measured[0, gone] = 1e6
    a = diagnose_stage(holes, FLOOR)
    b = diagnose_stage(garbage, FLOOR, keep=~gone)
    assert names(a) == {"dead_band"} and holds(a.effects[0], "half_width", 0.6)
    assert np.array_equal(a.final.theta, b.final.theta) and a.error_after[0] == b.error_after[0]
    assert LeastSquaresProblem(holes, FLOOR).n == N - gone.sum() < LeastSquaresProblem(clean, FLOOR).n
    assert compare_stages([holes])[0].samples == N - gone.sum()


def test_an_output_that_was_never_measured_changes_nothing() -> None:
    stage = gauges([linear("slope", (1, 1, 1), V)], [0.05])
    stage.measured[2] = np.nan
    d = search(stage)
    assert names(d) == {"slope"} and holds(d.effects[0], "size", 0.05)
    assert d.error_after[2] == 0.0


# ---- noise -----------------------------------------------------------------------------------------------------------


def white(t: np.ndarray, error: np.ndarray) -> float:
    return float(np.std(np.diff(error)) / np.sqrt(2.0))


def test_jumps_between_windows_are_not_noise() -> None:
    jumps = np.repeat(np.random.default_rng(8).standard_normal(N // 100), 100)
    stage = integrator(added=jumps)
    stage.noise = white
    assert noise_of(stage, stage.neutral())[0] == pytest.approx(NOISE, rel=0.05)
    assert noise_of(replace(stage, window=None), stage.neutral())[0] > 10 * NOISE


def test_what_the_raster_hides_adds_to_the_floor() -> None:
    stage = replace(integrator(), noise=white, raster_error=np.array([0.012]))
    assert noise_of(stage, stage.neutral())[0] == pytest.approx(np.hypot(NOISE, 0.012), rel=0.05)


def test_a_floor_that_motion_had_raised_is_measured_again_on_the_best_model() -> None:
    stage = replace(integrator(2, gain_asymmetry=0.06), noise=white)
    d = diagnose_stage(stage, 4 * FLOOR)
    assert names(d) == {"gain_asymmetry"} and d.floor[0] == pytest.approx(NOISE, rel=0.05)


# ---- all stages together ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def machine() -> list[Stage]:
    drag = integrator(effects=(DEAD_BAND, SATURATION), added=np.cumsum(8.0 * (LOAD - 0.8)) * DT)
    return [
        replace(integrator(7, dead_band=0.6), name="first"),
        replace(drag, name="second"),
        gauges([linear("slope", (1, 1, 1), V)], [0.0], bias=0.05),
    ]


KEYS = {
    "": {"schema", "log", "verdict", "stages", "effects", "recalibrated", "unknown", "elapsed_s"},
    "stages": {"stage", "verdict", "signal", "unit", "error_before", "error_after", "noise_floor"},
    "effects": {"effect", "stage", "probability", "parameters", "rivals"},
    "recalibrated": {"parameter", "value", "low", "high", "unit"},
    "unknown": {"stage", "shape"},
}


def test_the_json_of_a_diagnosis_keeps_its_contract(machine: list[Stage]) -> None:
    progress: list[float] = []
    d = diagnose(machine, {"third": "no pressure"}, progress.append, workers=1)
    assert progress == sorted(progress) and progress[-1] == 1.0
    sizes = sorted((len(s.effects) * len(s.outputs) for s in machine), reverse=True)  # the longest first
    parts = [sum(sizes[: n + 1]) / sum(sizes) for n in range(len(sizes))]
    assert all(any(abs(p - part) < 1e-9 for p in progress) for part in parts)
    text = json.dumps(plain(diagnosis_json(d, "run.csv")), allow_nan=False)
    j = json.loads(text)
    assert KEYS[""] <= set(j) and (j["schema"], j["log"], j["verdict"]) == (1, "run.csv", "missing")
    for name in ("stages", "effects", "recalibrated", "unknown"):
        assert j[name] and all(KEYS[name] <= set(entry) for entry in j[name])
    assert {(s["stage"], s["verdict"]) for s in j["stages"]} == {
        ("first", "missing"), ("second", "unknown"), ("gauges", "none"), ("third", "not_observed"),
    }  # fmt: skip
    (effect,) = j["effects"]
    assert (effect["effect"], effect["stage"]) == ("dead_band", "first") and 0.0 <= effect["probability"] <= 1.0
    assert set(effect["parameters"]["half_width"]) == {"value", "low", "high", "unit"}
    assert "load" in j["unknown"][0]["shape"]
    assert "a_bias" in {q["parameter"] for q in j["recalibrated"]}


def test_side_by_side_gives_the_same_answer_as_one_after_the_other(machine: list[Stage]) -> None:
    answers = []
    for workers in (1, 2):
        j = diagnosis_json(diagnose(machine, workers=workers), "run.csv")
        j.pop("elapsed_s")
        answers.append(json.dumps(plain(j)))
    assert answers[0] == answers[1]


def test_comparing_refits_nominal_parameters_and_tells_the_error_as_given_too() -> None:
    clean, moved = compare_stages([integrator(), replace(integrator(gain=3.09), name="moved")])
    assert clean.rms == pytest.approx(NOISE, rel=0.03) and clean.noise_floor == NOISE and clean.samples == N
    assert clean.rms_as_given == pytest.approx(NOISE, rel=0.03)
    assert moved.rms_as_given > 5 * NOISE
    assert moved.agrees and moved.rms == pytest.approx(NOISE, rel=0.03)


def test_locating_and_diagnosing_start_from_the_same_error() -> None:
    stage = integrator(3, gain=3.05, dead_band=0.6)
    (located,) = locate_stages([stage])
    d, e = diagnose_stage(stage, FLOOR), extend_stage(stage, ("dead_band",))
    assert located.fails and not located.signals[0].agrees
    assert located.signals[0].rms == d.error_before[0] == e.error_before[0]
    assert located.json()["verdict"] == "fails" and located.verdict().startswith("fails in ")


def test_a_stage_fails_where_one_condition_does_or_the_whole_is_more_than_noise() -> None:
    clean = locate(LeastSquaresProblem(integrator(1), FLOOR))
    assert not clean.fails and clean.verdict() == "fits everywhere" and clean.json()["fails"] is False
    louder = locate(LeastSquaresProblem(integrator(1), FLOOR / 1.2))
    assert louder.fails and louder.worst.ratio == pytest.approx(1.2, rel=0.03)
    assert replace(louder, regimes=()).verdict().startswith("fails in no single condition more than in others: ")


def test_what_is_quieter_than_the_model_s_error_is_the_noise() -> None:
    stage = replace(integrator(2, gain_asymmetry=0.06), noise=white)
    given = noise_of(stage, stage.neutral())[0]
    assert noise_of(replace(stage, quiet=np.array([0.5 * given])), stage.neutral())[0] == 0.5 * given
    for less in (0.99, 1.5):  # no more than two estimates of one noise differ
        assert noise_of(replace(stage, quiet=np.array([less * given])), stage.neutral())[0] == given


def test_a_floor_is_raised_to_what_an_effect_hides_between_two_rows_and_only_then() -> None:
    stage = integrator(2, dead_band=0.6)
    at = stage.index()["dead_band"].start
    stage = replace(stage, hidden=lambda theta: np.array([0.03 if theta[at] else 0.0]))
    with_it = stage.neutral()
    assert reach_of(stage, FLOOR, with_it)[0] == NOISE
    with_it[stage.index()["dead_band"]] = 0.6
    assert reach_of(stage, FLOOR, with_it)[0] == pytest.approx(np.hypot(NOISE, 0.03))
    assert (
        diagnose_stage(stage, FLOOR).floor[0]
        == extend_stage(replace(stage, floor=FLOOR), ("dead_band",)).floor[0]
        > 0.03
    )


# ---- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            lambda: replace(integrator(), measured=np.zeros((2, N))),
            r"subsystem 'slide': measured has shape \(2, 10000\); \(1, 10000\) is",
        ),
        (lambda: integrator(effects=(NULL_BIAS, NULL_BIAS)), "two parameters or effects share a name"),
        (lambda: integrator(effects=(replace(NULL_BIAS, starts=((1.0, 2.0),)),)), "a start has 2 values; 1 are needed"),
        (lambda: compare_stages([replace(integrator(), floor=None)]), "subsystem 'slide': no noise floor"),
        (
            lambda: compare_stages([replace(integrator(), floor=np.array([np.nan]))]),
            "subsystem 'slide': no noise floor",
        ),
        (
            lambda: extend_stage(integrator(), ("sticky",)),
            "subsystem 'slide' has no effect 'sticky'; it has null_bias, dead_band",
        ),
    ],
)
def test_a_stage_that_cannot_be_used_says_why(make: Callable[[], object], says: str) -> None:
    with pytest.raises(StageError, match=says):
        make()


# ---- long logs -------------------------------------------------------------------------------------------------------


def in_pieces(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> tuple[Stage, list[int]]:
    """A stage that is searched on a third of its samples, and a list that notes how many the search saw."""
    monkeypatch.setattr("vaneloop.identification.selection.diagnosis.LONG_SAMPLES", N)
    monkeypatch.setattr("vaneloop.identification.selection.diagnosis.EXCERPT_SAMPLES", N // 3)
    monkeypatch.setattr("vaneloop.identification.selection.diagnosis.EXCERPT_PIECE", 400)
    seen: list[int] = []

    def excerpt(at: np.ndarray) -> Stage:
        seen.append(len(at))
        return replace(
            stage,
            run=lambda thetas: stage.run(thetas)[..., at],
            t=stage.t[at],
            measured=stage.measured[:, at],
            excerpt=None,
        )

    return replace(stage, excerpt=excerpt), seen


def test_a_long_log_is_searched_on_an_excerpt_and_judged_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    terms = [linear("slope", (1, 1, 1), V), linear("tilt", (1, 0, -1), W)]
    stage, seen = in_pieces(gauges(terms, [0.0, 0.05]), monkeypatch)
    d = search(stage)
    assert seen and max(seen) < 0.4 * N
    assert d.verdict == "missing" and names(d) == {"tilt"} and holds(d.effects[0], "size", 0.05)
    assert len(d.final.cost) == len(
        LeastSquaresProblem(stage, GAUGE_FLOOR).block_start
    )  # the verdict's errors are the whole log's


def test_an_effect_that_acts_in_one_stretch_of_a_long_log_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    stretch = np.where((T > 41.0) & (T < 52.0), W, 0.0)
    terms = [linear("slope", (1, 1, 1), V), linear("stretch", (1, 1, 0), stretch)]
    stage, _ = in_pieces(gauges(terms, [0.0, 0.2]), monkeypatch)
    d = search(stage)
    assert names(d) == {"stretch"} and holds(d.effects[0], "size", 0.2)


@pytest.mark.parametrize("seed", range(3))
def test_a_clean_long_log_lacks_nothing(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    stage, _ = in_pieces(
        gauges([linear("slope", (1, 1, 1), V), linear("tilt", (1, 0, -1), W)], [0.0, 0.0], seed), monkeypatch
    )
    assert search(stage).verdict == "none"


def test_an_integrating_stage_is_cut_at_its_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    stage, seen = in_pieces(integrator(4, dead_band=0.6), monkeypatch)
    assert names(search(stage)) == {"dead_band"} and all(n % 100 == 0 for n in seen)


# ---- fits side by side -----------------------------------------------------------------------------------------------


def test_fits_made_together_are_those_made_one_by_one() -> None:
    judge = LeastSquaresProblem(integrator(7, null_bias=0.3), FLOOR)
    starts = {e.name: judge.stage.neutral() for e in LIBRARY}
    for e in LIBRARY:
        starts[e.name][judge.stage.index()[e.name]] = e.starts[0]
    together = judge.together([judge.fitting((name,), theta) for name, theta in starts.items()])
    for fit, (name, theta) in zip(together, starts.items(), strict=True):
        alone = judge.fit((name,), theta)
        np.testing.assert_array_equal(fit.theta, alone.theta)
        np.testing.assert_array_equal(fit.held_out, alone.held_out)


def test_a_fit_goes_on_from_a_fit_as_from_its_parameters_without_asking_for_errors_there_again() -> None:
    stage = integrator(7, null_bias=0.3)
    judge, name, calls = LeastSquaresProblem(stage, FLOOR), LIBRARY[0].name, []
    begin = stage.neutral()
    begin[stage.index()[name]] = LIBRARY[0].starts[0]
    quick, errors = judge.fit((name,), begin, 1), judge.errors
    judge.errors = lambda thetas: calls.append(len(thetas)) or errors(thetas)
    again = judge.fit((name,), quick.theta, 8)
    asked = sum(calls)
    calls.clear()
    on = judge.fit((name,), quick, 8)
    assert sum(calls) == asked - len(quick.free) - 1
    np.testing.assert_allclose(on.theta, again.theta, rtol=1e-9)
    np.testing.assert_allclose(on.held_out, again.held_out, rtol=1e-9)
    calls.clear()
    other = judge.fit((), quick, 8)  # of other effects: only its parameters count
    assert calls and other.effects == ()


def test_stages_settle_two_places_of_rivals_in_one_stage() -> None:
    """Twins that one stage cannot tell apart; the other stage, where they differ, lacks neither twin that came
    first.
    """
    first, second = wave(31, 1.0, 0.05, 1.0), wave(32, 1.0, 0.05, 1.0)
    row = (1.0, 1.0, 1.0)
    twins = [
        linear("a", row, first),
        linear("a_twin", row, first),
        linear("b", row, second),
        linear("b_twin", row, second),
    ]
    here = gauges(twins, [0.0, 0.4, 0.0, 0.3])
    there = replace(gauges([twins[0], twins[2]], [0.0, 0.0], seed=1), name="others")
    alone = diagnose([here], workers=1).stages[0]
    assert {frozenset((f.effect, *f.rivals)) for f in alone.effects} == {
        frozenset(("a", "a_twin")),
        frozenset(("b", "b_twin")),
    }
    d = diagnose([here, there], workers=1).stages[0]
    assert {f.effect: f.rivals for f in d.effects} == {"a_twin": [], "b_twin": []}
    assert set(d.final.effects) == {"a_twin", "b_twin"}
    sizes = {f.effect: float(f.parameters["size"]["value"]) for f in d.effects}  # type: ignore[arg-type]
    assert sizes == pytest.approx({"a_twin": 0.4, "b_twin": 0.3}, rel=0.02)


def test_what_is_searched_at_once_comes_first_and_then_the_longest() -> None:
    from vaneloop.identification.workflow import _order

    sizes = {"long": (16, 3), "short": (1, 1), "middle": (19, 1), "quick": (4, 1), "tenth": (5, 1)}
    stages = [type("S", (), {"effects": [0] * n, "outputs": [0] * m}) for n, m in sizes.values()]
    names = [list(sizes)[i] for i in _order(stages, False)]  # type: ignore[arg-type]
    assert names == ["short", "quick", "long", "middle", "tenth"]
    names = [list(sizes)[i] for i in _order(stages, True)]  # type: ignore[arg-type]
    assert names == ["long", "short", "quick", "middle", "tenth"]


def test_threads_that_search_at_once_get_their_own_answers() -> None:
    sizes = [(name, factor * TRUTH[name][0]) for name in ("null_bias", "dead_band") for factor in (0.5, 1.0, 1.5, 2.0)]
    begin = Barrier(len(sizes))

    def sought(k: int) -> list[list[str]]:
        name, size = sizes[k]
        gauge = gauges([linear("lean", (1.0, 0.5, 0.0), V)], [0.01 * k], seed=k)
        begin.wait()
        return [[f.effect for f in d.effects] for d in diagnose([integrator(k, **{name: size}), gauge]).stages]

    with ThreadPoolExecutor(len(sizes)) as pool:
        answers = list(pool.map(sought, range(len(sizes))))
    assert answers == [[[name], ["lean"] if k else []] for k, (name, _) in enumerate(sizes)]
