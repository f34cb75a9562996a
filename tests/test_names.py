"""When a name may be given, and what is said instead: bounds, shares of the error, causes that go together, other
stages' objections.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.test_identification import FLOOR, GAIN, LIBRARY, NULL_BIAS, T, integrator, wave
from tests.test_search_limits import SIDES, verdict
from vaneloop.identification import Effect, Parameter, Stage
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.regimes import shape
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.selection.diagnosis import diagnose_stage
from vaneloop.identification.selection.likelihood_acceptance import with_rivals
from vaneloop.identification.workflow import diagnose, diagnosis_json

SMALL = Effect(
    "null_bias", (replace(NULL_BIAS.parameters[0], low=-0.4, high=0.4),), ((-0.1,), (0.1,), (0.3,)), "any motion"
)


def test_an_effect_and_its_rivals_hold_nine_tenths_of_the_probability():
    shares = {"a": 0.37, "b": 0.30, "c": 0.25, "d": 0.08}
    assert with_rivals("a", [], shares) == ["b", "c"]
    assert with_rivals("a", ["d"], shares) == ["d", "b", "c"]
    assert with_rivals("a", [], {"a": 0.95, "b": 0.05}) == []


@pytest.mark.parametrize(("own", "rivals"), [(0.73, ["b"]), (0.89, ["b"]), (0.91, [])])
def test_nine_tenths_are_neither_less_nor_more(own, rivals):
    assert with_rivals("a", [], {"a": own, "b": 0.98 - own, "c": 0.02}) == rivals


@pytest.mark.parametrize(("truth", "said"), [(0.3, "missing"), (0.4002, "unknown")])
def test_a_size_at_its_bound_is_no_answer(truth, said):
    stage = integrator(effects=(SMALL,), null_bias=truth)
    d = diagnose_stage(stage, FLOOR)
    assert d.verdict == said
    if said == "unknown":
        assert d.nearest == ["null_bias"] and "end of its physical range" in d.refused[0] and not d.effects


@pytest.mark.parametrize(
    ("before", "after", "said"), [(1.048, 1.040, "none"), (1.08, 1.062, "unknown"), (1.04, 1.005, "missing")]
)
def test_what_explains_less_than_half_of_the_excess_is_not_named(monkeypatch, before, after, said):
    assert verdict(monkeypatch, before, after, ("a",)) == said


@SIDES
def test_half_of_the_excess_is_the_limit(monkeypatch, times, beyond):
    after = np.sqrt(1.048**2 - 0.5 * times * (1.048**2 - 1.01**2))
    assert verdict(monkeypatch, 1.048, after, ("a",)) == ("missing" if beyond else "none")


# ---- causes that go together -----------------------------------------------------------------------------------------

WARM = 40.0 + 20.0 * T / T[-1]  # degC: goes with time
BUSY = 50.0 + 10.0 * np.sin(2.0 * np.pi * T / 41.0)  # degC: goes its own way
U = wave(8, 1.0, 0.05, 1.0)


def ageing(t_oil: np.ndarray, true_cause: np.ndarray) -> Stage:
    """A gain that falls with time in the library, and with ``true_cause`` (0 to 1) in the log."""

    def with_cause(cause: np.ndarray):
        return lambda thetas: ((thetas[:, :1] + thetas[:, 1:2] * cause) * U)[:, None, :]

    measured = (2.0 - 0.5 * true_cause) * U + 0.01 * np.random.default_rng(6).standard_normal(len(T))
    drift = Effect("gain_drift", (Parameter("fall", 0.0, "1", -2.0, 2.0),), ((-0.1,), (0.1,), (1.0,)), "time")
    share = (t_oil - t_oil.min()) / np.ptp(t_oil)
    return Stage(
        "valve", ("x",), ("mm",), (Parameter("gain", 2.0, "1", 1.0, 3.0, 0.05),), (drift,), with_cause(T / T[-1]), T,
        measured[None],
        regimes={"time": T, "oil temperature": t_oil}, floor=np.array([0.01]),
        twins={"gain_drift": ("oil temperature", with_cause(share))},
    )  # fmt: skip


def test_time_and_temperature_that_went_together_are_both_said():
    d = diagnose([ageing(WARM, T / T[-1])], workers=1)
    assert [(f.effect, f.inseparable) for f in d.stages[0].effects] == [("gain_drift", ["oil temperature"])]
    assert diagnosis_json(d, "x")["effects"][0]["inseparable"] == ["oil temperature"]


def test_time_and_temperature_that_went_apart_are_told_apart():
    (found,) = diagnose([ageing(BUSY, T / T[-1])], workers=1).stages[0].effects
    assert found.inseparable == []


def test_an_effect_that_would_have_to_turn_on_something_else_is_the_nearest_of_an_unknown():
    slow = np.clip(T / T[-1] + 0.25 * np.sin(2.0 * np.pi * T / 60.0), 0.0, 1.3) / 1.3
    d = diagnose([ageing(40.0 + 20.0 * slow, slow)], workers=1)
    assert d.verdict == "unknown" and d.stages[0].nearest == ["gain_drift"]
    assert "gain_drift" in diagnosis_json(d, "x")["unknown"][0]["nearest_effects"]


# ---- other stages' objections ----------------------------------------------------------------------------------------


def reading(name: str, effects: tuple[str, ...], bias: float) -> Stage:
    """A stage whose output any of these effects moves by its size; ``bias`` is in the log."""
    size = Parameter("size", 0.0, "mm", -5.0, 5.0)
    library = tuple(Effect(e, (size,), ((-1.0,), (0.1,), (1.0,))) for e in effects)

    def run(thetas: np.ndarray) -> np.ndarray:
        return (U + thetas.sum(axis=1)[:, None])[:, None, :]

    seed = sum(map(ord, name))
    measured = U + bias + 0.01 * np.random.default_rng(seed).standard_normal(len(T))
    return Stage(name, ("x",), ("mm",), (), library, run, T, measured[None], floor=np.array([0.01]))


def answers(*stages: Stage) -> dict[str, StageDiagnosis]:
    return {s.stage: s for s in diagnose(stages, workers=1).stages}


def test_a_rival_that_another_stage_refutes_goes():
    alone = answers(reading("actuator", ("lvdt_bias", "end_stop"), 1.0))["actuator"].effects[0]
    assert {alone.effect, *alone.rivals} == {"lvdt_bias", "end_stop"}
    both = answers(reading("actuator", ("lvdt_bias", "end_stop"), 1.0), reading("linkage", ("lvdt_bias",), 0.0))
    assert [(f.effect, f.rivals) for f in both["actuator"].effects] == [("end_stop", [])]
    assert both["actuator"].effects[0].evidence["share"] == pytest.approx(1.0, abs=1e-3)


def test_a_name_without_a_rival_that_another_stage_refutes_is_none():
    d = answers(reading("actuator", ("lvdt_bias",), 1.0), reading("linkage", ("lvdt_bias",), 0.0))["actuator"]
    assert d.verdict == "unknown" and d.effects == [] and d.nearest == ["lvdt_bias"]
    assert d.refused == ["lvdt_bias is contradicted by linkage"]


def test_a_name_that_another_stage_sees_too_stays():
    d = answers(reading("actuator", ("lvdt_bias", "end_stop"), 1.0), reading("linkage", ("lvdt_bias",), 1.0))[
        "actuator"
    ]
    assert [(f.effect, f.rivals) for f in d.effects] == [("lvdt_bias", [])]


@SIDES
def test_two_stages_may_differ_by_half_of_a_size(times, beyond):
    there = 1.0 + 0.5 * times + (0.01 if beyond else -0.01)
    d = answers(reading("actuator", ("lvdt_bias",), 1.0), reading("linkage", ("lvdt_bias",), there))
    assert d["actuator"].verdict == ("unknown" if beyond else "missing")


# ---- the tool's own rate ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("hertz", "named"), [(None, ""), (1.37, "1.37")])
def test_only_an_oscillation_of_the_machine_is_called_one(hertz, named):
    slow = 0.5 * np.sin(2.0 * np.pi * 0.21 * T)  # leaves a sawtooth at the rate of the windows
    fast = 0.0 if hertz is None else 0.3 * np.sin(2.0 * np.pi * hertz * T)
    stage = integrator(effects=LIBRARY[:1], gain=GAIN, added=slow + fast)
    stage.memory = 10.0
    judge = LeastSquaresProblem(stage, FLOOR)
    texts = " ".join(s.text for s in shape(judge, judge.fit((), stage.neutral())))
    assert re.findall(r"oscillates at ([\d.]+) Hz", texts) == ([named] if named else [])
