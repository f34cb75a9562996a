"""Curves beside laws of the library, and laws of the library that only show beside another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plant import Model
from vaneloop import Record, System, unknown
from vaneloop.base.tables import read
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.selection.search import Search
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.by_log import bind
from vaneloop.verbs.learn import learn

LATE = 0.7  # s
VALVE = System(
    "valve", "static", lambda u, p: p.gain * u.lever + p.offset, inputs={"lever": "V"}, outputs={"flow": "l/s"},
    parameters=[unknown("gain", 1.0, "l/(s V)"), unknown("offset", 0.0, "l/s")], places=["lever"],
)  # fmt: skip


def notches(u: np.ndarray) -> np.ndarray:
    return 0.4 * np.sin(3.0 * u)


def run_of_a_valve(seed: int) -> Record:
    """A valve with notches behind a dead time."""
    rng = np.random.default_rng(seed)
    t = np.arange(1500) * 0.1
    phases = rng.uniform(0.0, 6.0, 3)

    waves = zip((2.0, 1.0, 0.5), (0.35, 1.1, 2.3), phases, strict=True)
    lever = np.sum([a * np.sin(t * w + f) for a, w, f in waves], axis=0)
    late = np.interp(t - LATE, t, lever)  # before the log it was at rest
    flow = 1.5 * (late + notches(late)) + 0.2 + 0.02 * rng.standard_normal(len(t))
    return Record(f"log {seed}", t, {"lever": lever, "flow": flow})


@pytest.mark.slow
def test_a_curve_is_learned_behind_a_dead_time(tmp_path: Path) -> None:
    """Neither alone comes down to the noise: the curve of a lever that is late is none of the lever."""
    without = [f"lever.{law}" for law in ("lag", "second_order_lag", "play", "stiction", "stick_slip", "rate_limit")]
    said = learn([run_of_a_valve(1)], VALVE, test=[run_of_a_valve(2)], without=without)
    assert said.diagnosed.effects == ["lever.dead_time"]
    (law,) = said.laws
    assert (law.name, law.error_after < 1.3) == ("lever.curve_of_lever", True)
    line = np.polynomial.Polynomial.fit(law.x, notches(law.x) - law.y, 1)  # gain and offset take it
    middle = np.abs(law.x) < 2.5
    assert (law.y + line(law.x))[middle] == pytest.approx(notches(law.x)[middle], abs=0.08)
    assert said.by_log is not None and max(said.by_log.tested().values()) < 1.5
    for log, v in said.by_log.tested(0.1 * said.by_log.logs.fitted.floor).items():  # in another noise
        assert max(0.1 * v, 1.0) == pytest.approx(said.by_log.tested()[log])
    said.write(tmp_path / "law.toml")
    model = read(tmp_path / "law.toml", Model)
    assert model.effects["lever.dead_time"]["delay"] == pytest.approx(LATE, abs=0.02)
    other = run_of_a_valve(3)
    bound = BoundSystem(VALVE, [other], values=model.parameters, present=model.effects, curves=model.curves)
    assert np.std(bound.measured[0] - bound.run(bound.stage.neutral()[None])[0, 0]) < 0.04


def test_a_size_that_changes_nothing_is_no_beginning() -> None:
    """A limit beyond all that was seen leaves as much as the model without it, and no fit leads on from there."""
    record = run_of_a_valve(1)
    logs = bind(VALVE, [record])
    search = Search(logs.judged()(LeastSquaresProblem(logs.fitted.thinned, logs.fitted.floor)))
    with_it = search.single("lever.dead_time")
    theta, rest = with_it.theta.copy(), frozenset(with_it.effects)
    at = search.stage.index()["lever.saturation"]
    left = []
    for high in (100.0, 2.0):
        theta[at] = -100.0, high
        left.append(search._left(rest, search.judge.errors(theta[None])[0]))
    assert left[0] == np.inf and np.isfinite(left[1])


def test_a_cube_is_told_whose_slope_the_gain_takes() -> None:
    """A gain takes a line through 0, which leaves the curve a mean that is none of the cube's."""
    rng = np.random.default_rng(4)
    t = np.arange(1200) * 0.1
    opening = 50.0 + 30.0 * np.sin(0.4 * t) + 15.0 * np.sin(1.7 * t)  # %
    flow = 0.2 * (opening + 8e-6 * opening**3) + 0.02 * rng.standard_normal(len(t))
    trim = System(
        "trim", "static", lambda u, p: p.gain * u.opening, inputs={"opening": "%"}, outputs={"flow": "l/s"},
        parameters=[unknown("gain", 0.1, "l/(s %)")], places=["opening"],
    )  # fmt: skip
    record = Record("log", t, {"opening": opening, "flow": flow})
    others = [f"opening.{law}" for law in ("cubic", "square_root", "smooth_saturation", "dead_zone", "saturation")]
    (law,) = learn([record], trim, without=others).laws
    assert law.name == "opening.curve_of_opening"
    cubes = [f.numbers["a"] for f in law.formulas if f.form == "cube"]
    assert cubes == [pytest.approx(8e-6, rel=0.05)], [f.text for f in law.formulas]
