"""What an answer says against itself: parameters at their bounds, signs the other way round; and that compare and
diagnose begin from the same model.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import vaneloop
from tests.conftest import ROOT
from tests.test_identification import FLOOR, integrator
from tests.test_your_own_model import STRAIGHT, T, cascade, noise, tanks, wave
from vaneloop import Parameter, Record, System, unknown
from vaneloop.identification import Stage
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance
from vaneloop.identification.workflow import compare_stages, diagnose
from vaneloop.verbs.search import Diagnosed, Stages

t = np.arange(0.0, 20.0, 0.005)


def axis(seed: int = 4, sign: float = 1.0, spring: float = 0.0, drag: float = 0.0) -> Record:
    """A driven mass of 2 kg with friction 4 N s/m, as measured; ``sign``: of the force's channel."""
    x = np.cumsum(wave(seed, t)) * 0.005
    v, a = np.gradient(x, t), np.gradient(np.gradient(x, t), t)
    force = 2.0 * a + 4.0 * v + spring * x + drag * v * np.abs(v) + 0.02 * noise(len(t))
    return Record("axis", t, {"x": x, "force": sign * force})


def model(low: float = 0.0, high: float = np.inf, tolerance: float = np.inf) -> System:
    return System(
        "axis", "force", lambda u, p: p.mass * u.acceleration + p.friction * u.velocity, outputs={"force": "N"},
        position="x",
        parameters=[
            unknown("mass", 1.0, "kg", low=-100.0),
            Parameter("friction", 1.0, "N s/m", low, high, tolerance),
        ],
    )  # fmt: skip


def notes(answer: Stages | Diagnosed) -> list[str]:
    """Notes of the answer, which its JSON and its page have too."""
    assert answer.by_log is not None
    page = answer.page().html()
    told = answer.to_dict()["notes"]
    if isinstance(answer, Diagnosed):
        assert told == answer.diagnosis.notes
    for n in answer.by_log.notes:
        assert n in told and n[1:].replace("'", "&#x27;") in page.replace("&#39;", "&#x27;")
    return answer.by_log.notes


def test_a_sound_model_raises_no_doubt() -> None:
    assert [n for n in notes(vaneloop.compare(axis(), model())) if "stands" in n or "sign" in n] == []


def test_a_parameter_at_its_bound_is_told() -> None:
    (note,) = [n for n in notes(vaneloop.compare(axis(), model(high=3.0))) if n.startswith("friction")]
    assert (
        note
        == "friction stands at its bound, 3 N s/m: the logs would have it go beyond; is a sign the other way round?"
    )
    system = System(
        "map", "static", lambda u, p: p.gain * u.u + p.bend * u.u**2, outputs={"y": "V"}, inputs={"u": "V"},
        parameters=[unknown("gain", 1.0, "-"), unknown("bend", 0.1, "1/V", low=0.0)],
    )  # fmt: skip
    u = wave(1)
    told = notes(vaneloop.compare(Record("a", T, {"u": u, "y": 2.0 * u - 0.3 * u**2}), system))
    assert any(n.startswith("bend stands at its bound, 0 1/V: the logs would have it go beyond") for n in told)


def test_a_tolerance_that_does_not_suffice_is_told() -> None:
    told = notes(vaneloop.compare(axis(), model(tolerance=0.5)))
    assert any(n.startswith("friction stands at the end of its tolerance, 1.5 N s/m: the logs") for n in told)


def test_a_force_with_the_other_sign_is_told() -> None:
    told = notes(vaneloop.compare(axis(sign=-1.0), model()))
    assert any("friction stands at its bound, 0 N s/m" in n for n in told)
    (note,) = [n for n in told if n.startswith("axis: force acts against the motion")]
    assert note.endswith("is a sign the other way round?")
    # without a bound, its negative friction is told by the power
    assert any("acts against the motion" in n for n in notes(vaneloop.compare(axis(sign=-1.0), model(low=-np.inf))))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "law", "said"),
    [
        ({"spring": -3.0}, "force.spring", "it pushes away from the middle instead of back to it"),
        ({"drag": -1.0}, "force.quadratic_drag", "it drives the motion instead of braking it"),
    ],
)
def test_a_law_with_the_unusual_sign_is_told(given: dict[str, float], law: str, said: str) -> None:
    log = axis(**given)  # type: ignore[arg-type]
    answer = vaneloop.extend(log, [law], model())
    assert any(n.startswith(f"{law} is negative (") and said in n for n in notes(answer))
    usual = vaneloop.extend(axis(**{k: -v for k, v in given.items()}), [law], model())  # type: ignore[arg-type]
    assert not any("is negative" in n for n in notes(usual))


@pytest.mark.slow
def test_the_vane_chain_tells_a_parameter_at_the_end_of_its_tolerance(monkeypatch: pytest.MonkeyPatch) -> None:
    from vaneloop.verbs.search import _at_limit

    answer = vaneloop.diagnose(ROOT / "examples" / "hidden_effect.parquet")
    assert _at_limit(answer.diagnosis.stages) == [] == answer.diagnosis.notes
    stage = next(s for s in answer.diagnosis.stages if s.recalibrated)
    stage.recalibrated[0]["at_limit"] = True
    (line,) = _at_limit([stage])
    assert line.startswith(f"{stage.stage}: {stage.recalibrated[0]['parameter']} stands at the end of its tolerance")


# ---- compare and diagnose begin from the same model ------------------------------------------------------------------


def before(answer: Stages | Diagnosed) -> list[float]:
    if isinstance(answer, Stages):
        return [f.rms for x in answer.located for f in x.signals]
    return [float(v) for s in answer.diagnosis.stages for v in s.error_before]


def oscillator() -> tuple[Record, System]:
    """Its frequency may be anywhere at first: the error has many valleys."""
    when = np.arange(0.0, 40.0, 0.05)
    u = np.sign(wave(7, when))
    x, v, rows = 0.0, 0.0, []
    for force in u:
        rows.append(x)
        for _ in range(10):
            v += 0.005 * (force - 6.0 * x - 0.3 * v - 0.4 * np.sign(v))
            x += 0.005 * v
    system = System(
        "swing", "simulate", lambda x, u, p: (x.v, u.u - p.stiffness * x.x - p.damping * x.v), inputs={"u": "N"},
        states={"x": "m", "v": "m/s"}, outputs={"x": "m"}, rates={"v": "x"},
        parameters=[unknown("stiffness", 40.0, "1/s^2", low=0.0), unknown("damping", 0.05, "1/s", low=0.0)],
    )  # fmt: skip
    return Record("swing", when, {"u": u, "x": np.array(rows) + 0.002 * noise(len(rows))}), system


def cascaded() -> tuple[Record, System]:
    return tanks(1, True), System(
        "tanks", "simulate", cascade, inputs={"pump": "V"}, states={"upper": "cm", "lower": "cm"},
        outputs={"upper": "cm", "lower": "cm"},
        parameters=[
            unknown("inflow", 2.0, "cm/(V s)", low=0.0), unknown("down", 0.04, "cm^0.5/s", low=0.0),
            unknown("out", 2.4, "cm^0.5/s", low=0.0),
        ],
    )  # fmt: skip


def mapped() -> tuple[Record, System]:
    u = wave(3)
    return Record("map", T, {"u": u, "y": np.abs(2.0 * u + 0.3) + 0.02 * noise()}), STRAIGHT


@pytest.mark.slow
@pytest.mark.parametrize("made", [mapped, oscillator, cascaded])
def test_compare_shows_the_error_that_diagnose_starts_from(made: Any) -> None:
    log, system = made()
    compared, found = vaneloop.compare(log, system), vaneloop.diagnose(log, system)
    extended = vaneloop.extend(log, [found.diagnosis.stages[0].candidates[0].effect], system)
    assert before(compared) == before(found) == before(extended)
    of = [list(a.by_log.steps["model"].values())[0].tolist() for a in (compared, found, extended) if a.by_log]
    assert of[0] == of[1] == of[2]


def test_the_chain_s_stages_show_the_same_error_before_where_the_floor_was_too_high() -> None:
    stage = integrator(null_bias=0.3)
    high = replace(stage, floor=5.0 * FLOOR, noise=lambda when, error: float(FLOOR[0]))
    d = diagnose([high]).stages[0]
    assert np.all(d.floor < 0.5 * high.floor)  # the search began anew
    assert d.error_before.tolist() == [f.rms for f in compare_stages([high])]


@pytest.mark.slow
def test_the_vane_chain_s_compare_and_diagnose_show_the_same_error_before() -> None:
    log = vaneloop.read_log(ROOT / "examples" / "hidden_effect.parquet")
    compared = vaneloop.compare(log, fit=(0, 60))
    # one simulation among others side by side and one alone differ in the last bit
    assert before(compared) == pytest.approx(before(vaneloop.diagnose(log, fit=(0, 60))), rel=1e-12)


def test_a_stage_begins_where_its_fit_may_begin_whoever_asks() -> None:
    """A sine whose nominal frequency lies in another valley of the error than the beginning that the stage offers."""
    when = np.linspace(0.0, 20.0, 2000)
    measured = np.sin(3.0 * when) + 0.01 * np.random.default_rng(2).standard_normal(len(when))
    stage = Stage(
        "sine", ("y",), ("V",), (Parameter("w", 2.0, "rad/s", 0.0, 10.0, 8.0),), (),
        lambda thetas: np.sin(thetas[:, :1] * when)[:, None, :], when, measured[None],
        floor=np.array([0.01]), begins=np.array([[2.98]]),
    )  # fmt: skip
    (figures,) = compare_stages([stage])
    assert figures.rms < 0.011
    assert diagnose([stage], judged=RelativeErrorAcceptance).stages[0].error_before.tolist() == [figures.rms]
