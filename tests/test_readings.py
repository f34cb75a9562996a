"""Logs as loggers write them: slow, fast, begun anywhere, the current sampled or averaged. What the raster hides is not
missing physics.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.logs import Channel, Log
from plant import Model
from tests.conftest import quick_first
from tests.firmware_on_rig import firmware
from tests.rig import Hidden, manoeuvre, simulate
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import StageDiagnosis, rms_per_output
from vaneloop.identification.selection.diagnosis import diagnose_stage
from vaneloop.identification.vane_chain.chain import Chain, build_chain
from vaneloop.verbs.search import extended


def recorded(hidden: list[Hidden], seed: int, rate: int, duration: float = 120.0) -> dict[str, np.ndarray]:
    return dict(simulate(manoeuvre(seed, duration), firmware(), hidden, seed=seed, rate=rate).log)


def chain_of(rows: dict[str, np.ndarray], which: slice = slice(None)) -> Chain:
    t = rows["t"][which]
    return build_chain(Log("rig", {k: Channel(t, v[which]) for k, v in rows.items() if k != "t"}))


def said(chain: Chain, stage: str) -> StageDiagnosis:
    s = chain.stage(stage)
    assert s.floor is not None
    return diagnose_stage(s, s.floor)


@pytest.fixture(scope="module")
def fast() -> dict[str, np.ndarray]:
    return recorded([], 31, 1000)


@pytest.mark.parametrize("begin", quick_first([4, 0, 9]))
def test_a_fast_log_is_put_on_the_controllers_frame_wherever_it_begins(fast: dict[str, np.ndarray], begin: int) -> None:
    chain = chain_of(fast, slice(begin, None))
    for name in ("demand", "servo", "actuator"):
        assert said(chain, name).verdict == "none", name


def test_a_current_sampled_at_the_rows_is_known_as_such_and_nothing_is_missing(fast: dict[str, np.ndarray]) -> None:
    chain = chain_of(fast, slice(None, None, 10))
    assert any("i_cmd: the current at single ticks" in n for n in chain.notes)
    for name in ("demand", "servo", "actuator"):
        assert said(chain, name).verdict == "none", name


def test_a_mean_current_is_not_taken_for_a_sampled_one() -> None:
    assert not any("i_cmd" in n for n in chain_of(recorded([], 32, 100, 60.0)).notes)


@pytest.mark.slow
def test_a_mean_of_the_ticks_before_the_row_is_known_as_such_and_nothing_is_missing() -> None:
    chain = chain_of(dict(simulate(manoeuvre(37, 120.0), firmware(), [], seed=37, rate=100, mean_through=False).log))
    assert any("the mean of the ten ticks before the row" in n for n in chain.notes)
    for name in ("servo", "actuator"):
        assert said(chain, name).verdict == "none", name


@pytest.mark.slow
@pytest.mark.parametrize("seed", [38, 39])
def test_noise_in_the_loop_asks_for_no_soft_oil_and_leaves_no_error(seed: int) -> None:
    """The LVDT's noise is in the current too: a model driven by it must not be correlated with the noise that it has to
    explain.
    """
    chain = chain_of(recorded([], seed, 100, 200.0))
    for name, most in (("actuator", 0.02), ("servo", 0.15), ("linkage", 0.03)):
        stage = chain.stage(name)
        assert stage.floor is not None
        judge = LeastSquaresProblem(stage, stage.floor)
        fit = judge.fit((), stage.neutral())
        assert np.sqrt(fit.held_out.sum() / judge.n) == pytest.approx(1.0, abs=most), name
        if name == "actuator":
            start = fit.theta.copy()
            start[stage.index()["oil_compressibility"].start] = 1.0
            soft = judge.fit(("oil_compressibility",), start)
            assert (
                0.5 * float(fit.held_out.sum() - soft.held_out.sum()) < 30.0
            )  # nats; 350 with the noise in all ten ticks


@pytest.mark.slow
def test_a_dead_band_much_smaller_than_the_noise_in_the_current_is_found() -> None:
    d = said(chain_of(recorded([Hidden("valve_dead_band", {"half_width": 1e-5})], 40, 100, 200.0)), "actuator")
    assert [e.effect for e in d.effects] == ["valve_dead_band"]
    assert float(d.effects[0].parameters["half_width"]["value"]) == pytest.approx(0.01, rel=0.1)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_null_bias_is_found_in_a_log_of_sampled_current() -> None:
    rows = recorded([Hidden("valve_null_bias", {"bias": 5e-4})], 33, 1000)
    d = said(chain_of(rows, slice(None, None, 10)), "actuator")
    assert [e.effect for e in d.effects] == ["valve_null_bias"]
    assert float(d.effects[0].parameters["bias"]["value"]) == pytest.approx(0.5, abs=0.01)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["engine", "actuator", "linkage"])
def test_a_log_of_ten_rows_a_second_lacks_nothing(stage: str) -> None:
    assert said(chain_of(recorded([], 34, 10, 200.0)), stage).verdict == "none"


def test_play_is_found_in_a_log_of_ten_rows_a_second() -> None:
    d = said(chain_of(recorded([Hidden("linkage_backlash", {"stage": 0, "width": 0.01})], 35, 10, 200.0)), "linkage")
    assert [e.effect for e in d.effects] == ["linkage_backlash"]
    assert float(d.effects[0].parameters["vigv"]["value"]) == pytest.approx(np.rad2deg(0.01), rel=0.15)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_valve_with_hysteresis_is_found_though_it_turns_between_the_rows() -> None:
    chain = chain_of(recorded([Hidden("valve_hysteresis", {"width": 2e-3})], 36, 100))
    d = said(chain, "actuator")
    assert [e.effect for e in d.effects] == ["valve_hysteresis"]
    assert float(d.effects[0].parameters["width"]["value"]) == pytest.approx(2.0, rel=0.15)  # type: ignore[arg-type]
    # the floor given is what can be reached, far above the sensor's noise of 0.005 mm
    assert d.floor[0] > 0.01 and d.error_after[0] < 1.5 * d.floor[0]


def test_many_effects_that_leave_much_are_an_imitation() -> None:
    """Three effects that bring an error from 6 to 2 floors: enough of it for one effect, not for three."""
    from vaneloop.identification.least_squares.problem import LeastSquaresProblem
    from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance

    stage = chain_of(recorded([], 37, 100, 60.0)).stage("engine")
    assert stage.floor is not None
    judge = LeastSquaresProblem(stage, stage.floor)
    base = judge.fit((), stage.neutral(), 2)
    before, after = (replace(base, held_out=base.held_out * r**2 / (base.held_out.sum() / judge.n)) for r in (6.0, 2.0))

    def verdict(*effects: str) -> str:
        return LikelihoodAcceptance(judge).conclude(before, replace(after, effects=effects), [], [], []).verdict

    assert verdict("a") == "missing" and verdict("a", "b", "c") == "unknown"


@pytest.mark.slow
def test_a_stroke_far_behind_is_smoothed_no_rounder_than_it_was() -> None:
    """The linkage takes the lag off the smoothed stroke: what smoothing cut off its corners would ask for more laws."""
    stage = chain_of(recorded([Hidden("lvdt_lag", {"time_constant": 0.0267})], 55, 100)).stage("linkage")
    assert stage.floor is not None
    judge, start = LeastSquaresProblem(stage, stage.floor), stage.neutral()
    lag = stage.index()["lvdt_lag"].start
    start[lag] = 0.03
    fit = judge.fit(("lvdt_lag",), start, 8)
    assert fit.theta[lag] == pytest.approx(0.0267, rel=0.02)
    assert np.all(rms_per_output(judge, fit) < 1.03 * stage.floor)


@pytest.mark.slow
def test_extend_fits_an_effect_where_the_log_shows_it_most_clearly() -> None:
    """To the actuator a wrong gain of the LVDT is a wrong flow gain, which is known within its tolerance only."""
    chain = chain_of(recorded([Hidden("lvdt_gain", {"factor": 0.9845})], 7, 100, 100.0))
    answer = extended(chain, ["lvdt_gain"], Model(), "log")
    (stage,) = answer.diagnosis.stages
    assert stage.stage == "linkage" and not answer.refused
    assert answer.model is not None and answer.model.effects["lvdt_gain"]["factor"] == pytest.approx(0.9845, abs=5e-4)
    assert stage.steps[0][1] > 3.0 and stage.excess < 1.05
