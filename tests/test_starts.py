"""Logs that begin in motion, and logs of the velocity alone: the start is fitted, log by log."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from tests.test_your_own_model import named
from vaneloop import InputError, Record, System, compare, diagnose, unknown
from vaneloop.verbs.search import Stages

T = np.arange(0.0, 30.0, 0.02)


def swing(name: str, seed: int, x: float, v: float, noise: float = 0.002) -> Record:
    """A pendulum without drive, k = 4 1/s^2, c = 0.2 1/s, let go at x with the speed v: closed form."""
    w = np.sqrt(4.0 - 0.1**2)
    course = np.exp(-0.1 * T) * (x * np.cos(w * T) + (v + 0.1 * x) / w * np.sin(w * T))
    return Record(name, T, {"x": course + noise * np.random.default_rng(seed).standard_normal(len(T))})


def pendulum(**more: Any) -> System:
    return System(
        "pendulum", "simulate", lambda x, u, p: (x.v, -p.stiffness * x.x - p.damping * x.v),
        states={"x": "m", "v": "m/s"}, outputs={"x": "m"}, rates={"v": "x"},
        parameters=[unknown("stiffness", 3.0, "1/s^2", low=0.0), unknown("damping", 0.1, "1/s", low=0.0)], **more,
    )  # fmt: skip


def fitted(answer: Stages) -> dict[str, float]:
    assert answer.by_log is not None
    return {str(p["parameter"]): float(str(p["value"])) for p in answer.by_log.parameters()}


def errors(answer: Stages) -> dict[str, float]:
    assert answer.by_log is not None
    return {log: float(v[0]) for log, v in answer.by_log.steps["model"].items()}


@pytest.mark.slow
def test_a_log_that_begins_in_motion_may_start_at_a_fitted_velocity() -> None:
    logs, test = [swing("a", 1, 0.5, -1.2), swing("b", 2, -0.3, 0.8)], [swing("c", 3, 0.1, 1.0)]
    free = compare(logs, pendulum(start={"v": "fitted"}), test=test)
    values = fitted(free)
    assert values["start_v_1"] == pytest.approx(-1.2, abs=0.01) and values["start_v_2"] == pytest.approx(0.8, abs=0.01)
    assert values["stiffness"] == pytest.approx(4.0, rel=0.002) and values["damping"] == pytest.approx(0.2, rel=0.02)
    assert max(errors(free).values()) < 0.005
    rest = compare(logs, pendulum(), test=test)
    assert min(errors(rest).values()) > 0.05
    assert rest.by_log is not None and free.by_log is not None
    (note,) = [n for n in rest.by_log.notes if n.startswith("a: v is about")]
    about = re.search(r"about (\S+) m/s at the start", note)
    assert about is not None and float(about[1]) == pytest.approx(-1.2, rel=0.1)
    assert "start={'v': 'fitted'} fits it" in note and not any("at the start" in n for n in free.by_log.notes)


@pytest.mark.slow
def test_a_measured_state_may_start_beside_its_noisy_first_sample() -> None:
    log = swing("a", 5, 0.5, 0.0, noise=0.0)
    log.columns["x"][0] = 0.8  # an outlier
    errors_of = {
        name: errors(compare([log], pendulum(start=start)))["a"]
        for name, start in (("measured", {"v": "fitted"}), ("fitted", {"x": "fitted", "v": "fitted"}))
    }
    assert errors_of["fitted"] < 0.01 < 0.05 < errors_of["measured"]


def drive(name: str, seed: int, at: float) -> Record:
    """Force and velocity of a mass of 2 kg with friction 4 N s/m that begins at ``at`` m beside the rest of a spring of
    3 N/m.
    """
    t = np.arange(0.0, 20.0, 0.005)
    w = 2.0 * np.pi * np.array([0.11, 0.31, 0.7])
    phase = np.random.default_rng(seed).uniform(0.0, 6.0, 3)
    v = sum(a * np.cos(k * t + f) for a, k, f in zip((0.4, 0.5, 0.3), w, phase, strict=True))
    x = at + sum(a / k * (np.sin(k * t + f) - np.sin(f)) for a, k, f in zip((0.4, 0.5, 0.3), w, phase, strict=True))
    acceleration = sum(-a * k * np.sin(k * t + f) for a, k, f in zip((0.4, 0.5, 0.3), w, phase, strict=True))
    noise = 0.01 * np.random.default_rng(seed).standard_normal((2, len(t)))
    return Record(name, t, {"v": v + 0.1 * noise[0], "force": 2.0 * acceleration + 4.0 * v + 3.0 * x + noise[1]})


def axis(spring: bool) -> System:
    def whole(u: Any, p: Any) -> Any:
        return p.mass * u.acceleration + p.friction * u.velocity + p.spring * u.position

    def less(u: Any, p: Any) -> Any:
        return p.mass * u.acceleration + p.friction * u.velocity

    own = [unknown("mass", 5.0, "kg", low=0.0), unknown("friction", 2.0, "N s/m", low=0.0)]
    return System(
        "axis", "force", whole if spring else less, outputs={"force": "N"}, velocity="v",
        parameters=[*own, unknown("spring", 1.0, "N/m")] if spring else own,
    )  # fmt: skip


def test_a_force_model_takes_the_velocity_alone() -> None:
    answer = compare([drive("a", 1, 0.7), drive("b", 2, -0.4)], axis(True), test=[drive("c", 3, 0.2)])
    values = fitted(answer)
    truth = {"mass": 2.0, "friction": 4.0, "spring": 3.0, "start_position_1": 0.7, "start_position_2": -0.4}
    assert values == pytest.approx(truth, rel=0.02)
    assert max(errors(answer).values()) < 0.01


@pytest.mark.slow
def test_a_spring_is_found_where_only_the_velocity_is_logged() -> None:
    answer = diagnose([drive("a", 1, 0.7)], axis(False), test=[drive("b", 2, -0.4)])
    assert named(answer) == ["force.spring"]
    stiffness = answer.diagnosis.stages[0].effects[0].parameters["stiffness"]["value"]
    assert float(str(stiffness)) == pytest.approx(3.0, rel=0.02)
    assert answer.by_log is not None
    assert list(answer.by_log.together().values())[-1]["test"][0] < 0.02
    assert answer.page().html()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"start": {"w": "fitted"}}, "start: 'w' is not a state; states are x, v"),
        ({"start": {"v": "free"}}, "start: 'v' (='free') must be a number or 'fitted'"),
        ({"start": {"v": float("nan")}}, "start: 'v' (=nan) must be a number or 'fitted'"),
        ({"start": {"v": "fitted"}, "window": 2.0}, "start: 'v' 'fitted' does not go with window="),
    ],
)
def test_a_start_that_cannot_be_is_refused(more: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        pendulum(**more)


def test_a_force_model_needs_some_motion() -> None:
    with pytest.raises(InputError, match=re.escape("needs position=, the channel of the displacement, or velocity=")):
        System("axis", "force", lambda u, p: u.velocity, outputs={"force": "N"})
