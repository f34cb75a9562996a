"""What kind of quantity a unit is one of, and which laws a state gets for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vaneloop import Parameter, Record, System, diagnose, unknown
from vaneloop.base.quantities import absolute_zero, kind_of
from vaneloop.identification.user_models.bound_system import BoundSystem


@pytest.mark.parametrize(
    ("kind", "units"),
    [
        ("velocity", "m/s mm/s (m)/s km/h m*s^-1 mph"),
        ("angular velocity", "rad/s deg/s rpm 1/min rev/min"),
        ("length", "m mm cm"),
        ("volume", "l m3 m^3 cm**3 mL"),
        ("mass", "kg g"),
        ("share", "% -"),
        ("temperature", "K degC degF"),
        ("", "V A N 1/s l/s m/s2 rad/s^2 m3/h bar W s Pa N/s"),
    ],
)
def test_a_unit_says_its_kind(kind: str, units: str) -> None:
    assert [kind_of(u) for u in units.split()] == [kind] * len(units.split())


def test_absolute_zero() -> None:
    assert [absolute_zero(u) for u in ("K", "degC", "degF", "V")] == [0.0, 273.15, 459.67, 0.0]


T = np.arange(0.0, 60.0, 0.1)


def laws_of(states: dict[str, str], inputs: dict[str, str], **more: Any) -> tuple[BoundSystem, set[str]]:
    """A model whose every state follows the first input by itself, and its laws at the states."""
    n = len(states)
    system = System(
        name="s", kind="simulate", model=lambda x, u, p: tuple(p.a * (u[0] - x[i]) for i in range(n)), inputs=inputs,
        states=states, outputs={next(iter(states)): next(iter(states.values()))}, start=dict.fromkeys(states, 0.0),
        parameters=[unknown("a", 1.0, "1/s"), Parameter("m", 2.0, "kg")], places=["state", "force"], **more,
    )  # fmt: skip
    columns = {name: 5.0 * np.sin(0.3 * T) for name in (*inputs, next(iter(states)))}
    bound = BoundSystem(system, [Record("log", T, columns)])
    return bound, {e.name for e in bound.effects}


def test_a_velocity_without_a_displacement_has_friction_and_every_other_state_has_none() -> None:
    bound, laws = laws_of({"w": "rad/s", "flow": "l/s"}, {"u": "V"}, masses={"w": "m"})
    friction = {"coulomb", "smooth_coulomb", "stribeck", "friction_asymmetry"}
    assert {n for n in laws if n.partition(".")[2] in friction} == {f"w.{f}" for f in friction}
    assert not laws & {"w.spring", "w.end_stop", "w.viscous", "flow.radiation"} and {"w.leak", "flow.leak"} <= laws
    (coulomb,) = next(e.parameters for e in bound.effects if e.name == "w.coulomb")
    assert coulomb.unit == "N m" and bound.runner.smalls[0] > 0.0 == bound.runner.smalls[1]


def test_what_is_no_store_does_not_overflow_and_only_what_is_warm_radiates() -> None:
    _, hot = laws_of({"a": "degC", "b": "degC"}, {"heater": "W", "room": "degC"})
    _, wet = laws_of({"a": "cm", "b": "cm"}, {"pump": "V", "sea": "cm"})
    assert {n for n in hot if "_to_" in n} == {"a.radiation_to_room", "b.radiation_to_room"}
    assert {n for n in wet if "_to_" in n} == {"a.overflow_to_b", "b.overflow_to_a"}
    assert {"a.radiation", "b.radiation"} <= hot and not {n for n in wet if "radiation" in n}
    powers = {"a.square_root", "a.quadratic_drag", "a.cubic"}  # of degC they would be others than of degF
    assert powers <= wet and not powers & hot and "a.leak" in hot


def plate(x: Any, u: Any, p: Any) -> float:
    return p.gain * u.heater - p.loss * (x.hot - u.room)


def radiating(x: Any, u: Any, p: Any) -> float:
    return p.gain * u.heater - p.loss * (x.hot - u.room) - 4e-11 * ((x.hot + 273.15) ** 4 - (u.room + 273.15) ** 4)


def stuck(x: Any, u: Any, p: Any) -> float:
    return p.gain * u.volts - p.loss * x.speed


def rubbing(x: Any, u: Any, p: Any) -> float:
    return p.gain * u.volts - p.loss * x.speed - 3.0 * np.tanh(x.speed / 0.05)


def logged(true: Any, output: str, unit: str, inputs: dict[str, str], p: tuple[float, float], seed: int) -> Record:
    """A log of ``true``, with steps of the first input and a slow second one, noise 0.5 %."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 400.0, 0.5)
    drives = [np.repeat(rng.uniform(-10.0 if unit == "rad/s" else 0.0, 10.0, 40), 20)]
    drives += [20.0 + 5.0 * np.sin(0.02 * t + seed)] * (len(inputs) - 1)
    system = System(
        name="true", kind="simulate", model=true, inputs=inputs, states={output: unit}, outputs={output: unit},
        parameters=[Parameter("gain", p[0], "-"), Parameter("loss", p[1], "1/s")],
        start={output: 25.0 if unit == "degC" else 0.0},
    )  # fmt: skip
    columns = dict(zip(inputs, drives, strict=True))
    bound = BoundSystem(system, [Record("log", t, columns | {output: np.linspace(0.0, 1e3, len(t))})])
    y = bound.run(np.array([p]))[0, 0]
    return Record(f"log {seed}", t, columns | {output: y + 0.005 * np.std(y) * rng.standard_normal(len(y))})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("true", "nominal", "output", "unit", "inputs", "p", "name"),
    [
        (radiating, plate, "hot", "degC", {"heater": "W", "room": "degC"}, (2.0, 0.01), "hot.radiation_to_room"),
        (rubbing, stuck, "speed", "rad/s", {"volts": "V"}, (2.0, 0.5), "speed.smooth_coulomb"),
    ],
)
def test_what_a_state_loses_is_named_by_its_physics(
    true: Any, nominal: Any, output: str, unit: str, inputs: dict[str, str], p: tuple[float, float], name: str
) -> None:
    system = System(
        name="nominal", kind="simulate", model=nominal, inputs=inputs, states={output: unit}, outputs={output: unit},
        parameters=[unknown("gain", 0.5, "-", low=0.0), unknown("loss", 0.05, "1/s", low=0.0)],
    )  # fmt: skip
    logs = [logged(true, output, unit, inputs, p, seed) for seed in (11, 12)]
    answer = diagnose(logs[:1], system, test=logs[1:])
    assert [e["effect"] for e in answer.to_dict()["effects"]] == [name]


def test_what_drives_a_model_may_count_squared_and_no_sensor_reads_a_square() -> None:
    system = System(
        name="s", kind="static", model=lambda u, p: p.a * u.volts, inputs={"volts": "V"}, outputs={"heat": "W"},
        parameters=[unknown("a", 1.0, "W/V")],
    )  # fmt: skip
    bound = BoundSystem(system, [Record("log", T, {"volts": 2.0 + np.sin(T), "heat": 3.0 + np.sin(T)})])
    assert [e.name for e in bound.effects if e.name.endswith(".square")] == ["volts.square"]
