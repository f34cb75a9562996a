"""Two laws that nobody listed, in one machine: each is told by its formula beside the other's."""

from __future__ import annotations

import numpy as np
import pytest

from vaneloop import Record, System, unknown
from vaneloop.verbs.learn import learn

SENSOR = System(
    "sensor", "static", lambda u, p: p.g * u.gap + p.h * u.heat + p.zero, inputs={"gap": "mm", "heat": "K"},
    outputs={"y": "V"},
    parameters=[unknown("g", 1.5, "V/mm"), unknown("h", 0.7, "V/K"), unknown("zero", 0.1, "V")],
)  # fmt: skip


def record(seed: int) -> Record:
    """A reading with a steep tanh of the gap and a sine of the heat; the second run goes further."""
    rng = np.random.default_rng(seed)
    t = np.arange(1500) * 0.01
    gap, heat = (
        sum(rng.uniform(0.2, 0.6) * np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.0)) for f in (0.3, 0.7, 1.1))
        for _ in range(2)
    )
    y = 2.0 * gap + heat + 3.0 * np.tanh(9.0 * gap) + 1.5 * np.sin(4.0 * heat) + 0.01 * rng.standard_normal(len(t))
    return Record(f"run {seed}", t, {"gap": gap, "heat": heat, "y": y})


@pytest.mark.slow
def test_each_of_two_laws_is_told_by_its_formula() -> None:
    """Splines follow no tanh as steep as this, so that the second law is hidden in what they leave."""
    answer = learn([record(1)], SENSOR, test=[record(2)])
    assert answer.verdict == "learned"
    said = {law.of: law.spoken for law in answer.laws}
    step, wave = said["gap"], said["heat"]
    assert step is not None and step.form == "tanh"
    assert abs(step.numbers["b"]) == pytest.approx(9.0, rel=0.01)
    assert wave is not None and wave.form == "sine"
    assert abs(wave.numbers["b"]) == pytest.approx(4.0, rel=0.01)
    assert answer.laws[-1].error_after < 1.1
    beside = [f.error for f, _ in answer.outcome.tried[0].formulas or ()]
    assert min(beside) < 5.0  # fitted beside the curve of the heat; alone it leaves all that the sine does


DAMPER = System(
    "damper", "force", lambda u, p: p.c * u.velocity + p.k * u.position, inputs={}, outputs={"force": "N"},
    position="position", parameters=[unknown("c", 30.0, "N s/m"), unknown("k", 200.0, "N/m")],
)  # fmt: skip


def damped(seed: int) -> Record:
    """A damper with friction like a tanh of its speed, and a spring that bends like a sine; the second goes further."""
    rng = np.random.default_rng(seed)
    t = np.arange(1500) * 0.005
    x = sum(rng.uniform(0.2, 0.6) * np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.0)) for f in (0.3, 0.7, 1.1))
    v = np.gradient(x, t)
    y = 40.0 * v + 300.0 * x + 60.0 * np.tanh(v / 0.3) + 30.0 * np.sin(3.0 * x) + rng.standard_normal(len(t))
    return Record(f"run {seed}", t, {"position": x, "force": y})


@pytest.mark.slow
def test_a_formula_is_learned_beside_friction_that_the_library_names() -> None:
    """The library has the friction; of the spring its cubic takes a part, and a formula of the position the rest."""
    answer = learn([damped(1)], DAMPER, test=[damped(2)])
    assert answer.verdict == "learned" and "force.smooth_coulomb" in answer.to_dict()["named"]
    (spring,) = answer.laws
    assert spring.of == "position" and spring.spoken is not None and spring.spoken.form == "sine"
    assert spring.error_after < 1.1
