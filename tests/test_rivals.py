"""Which of two effects that fit is it? Less freedom, the other stages, and how certain the size is."""

from __future__ import annotations

import pytest

from tests.rig import Hidden
from tests.test_readings import chain_of, recorded
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.selection.diagnosis import diagnose_stage
from vaneloop.identification.workflow import diagnose


def said(hidden: list[Hidden], seed: int, stage: str) -> StageDiagnosis:
    s = chain_of(recorded(hidden, seed, 100, 200.0)).stage(stage)
    assert s.floor is not None
    return diagnose_stage(s, s.floor)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sizes", "rivals"),
    [
        # a ring off its centre of the right phase does the same and has more freedom; a crank's length does it too,
        # since the link's may be off within its tolerance
        ("pot_gain", {"factor": 1.03, "stage": 1}, {"crank_length_error"}),
        # three wrong cranks do the same; and nothing does what a ring does
        pytest.param("lvdt_gain", {"factor": 0.98}, set(), marks=pytest.mark.slow),
        pytest.param("ring_eccentricity", {"amplitude": 6e-3, "phase": 1.0, "stage": 0}, set(), marks=pytest.mark.slow),
    ],
)
def test_what_needs_least_freedom_is_named(name: str, sizes: dict[str, float], rivals: set[str]) -> None:
    (found,) = said([Hidden(name, sizes)], 51, "linkage").effects
    assert found.effect == name and set(found.rivals) <= rivals


@pytest.mark.slow
def test_a_slow_valve_is_told_from_a_slow_lvdt_by_the_linkage() -> None:
    chain = chain_of(recorded([Hidden("valve_lag", {"time_constant": 0.01})], 52, 100, 200.0))
    actuator = chain.stage("actuator")
    assert actuator.floor is not None
    alone = diagnose_stage(actuator, actuator.floor).effects[0]
    assert {alone.effect, *alone.rivals} >= {"valve_lag", "lvdt_lag"}
    together = [e for s in diagnose(chain.stages).stages for e in s.effects]
    assert [(e.effect, e.rivals) for e in together] == [("valve_lag", [])]


@pytest.mark.slow
def test_a_threshold_has_the_interval_of_the_sizes_that_fit_as_well() -> None:
    d = said([Hidden("trend_threshold_error", {"factor": 2.2})], 53, "demand")
    factor = d.effects[0].parameters["factor"]
    assert float(factor["low"]) < 2.2 < float(factor["high"])  # type: ignore[arg-type]
    assert float(factor["high"]) - float(factor["low"]) < 0.4  # type: ignore[operator, arg-type]


@pytest.mark.slow
def test_friction_has_its_size_though_the_piston_stands_off_the_middle() -> None:
    d = said([Hidden("piston_friction", {"force": 4000.0})], 54, "actuator")
    assert "piston_friction" in [e.effect for e in d.effects]
    found = next(e for e in d.effects if e.effect == "piston_friction")
    assert float(found.parameters["force"]["value"]) == pytest.approx(4000.0, rel=0.08)  # type: ignore[arg-type]
