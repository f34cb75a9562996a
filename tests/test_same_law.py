"""The benchmark's judge: a learned law is the hidden one where it does the same by the model's equations."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.same_law import same_by_equations
from vaneloop import Record, System, unknown
from vaneloop.identification.candidates.closed_forms import Formula
from vaneloop.identification.user_models.bound_system import BoundSystem

VALVE = System(
    "valve", "static", lambda u, p: p.gain * u.current + p.offset, inputs={"current": "mA"}, outputs={"flow": "l/min"},
    parameters=[unknown("gain", 2.0, "-"), unknown("offset", 3.0, "l/min")],
)  # fmt: skip
CART = System(
    "cart", "simulate", lambda x, u, p: (u.push - p.damping * x.speed) / p.mass, inputs={"push": "N"},
    states={"speed": "m/s"}, outputs={"speed": "m/s"},
    parameters=[unknown("mass", 4.0, "kg"), unknown("damping", 2.0, "N s/m")],
)  # fmt: skip
T = np.arange(400.0) * 0.05


def law(how: str, at: str, of: str, x: np.ndarray, y: np.ndarray, band: float, formulas=(), untold=()):
    return SimpleNamespace(
        how=how, at=at, of=of, x=x, y=y, low=y - band, high=y + band, formulas=list(formulas), untold=untold
    )


def test_a_flow_that_is_rectified_is_a_curve_of_the_current_that_makes_it() -> None:
    current = 4.0 * np.sin(T)
    bound = BoundSystem(VALVE, [Record("run", T, {"current": current, "flow": np.abs(2.0 * current + 3.0)})])
    x = np.linspace(-4.0, 4.0, 257)
    formula = Formula("below", "", {"a": -2.0, "b": -1.5}, 1.0, 4)

    def judged(y: np.ndarray, a: float = -2.0, untold: tuple[int, ...] = ()) -> dict:
        f = Formula(formula.form, "", {"a": a, "b": -1.5}, 1.0, 4)
        learned = law("input adds", "current", "current", x, y, 0.02, [f], untold)
        return same_by_equations(learned, bound, VALVE, "flow", "flow", lambda q: np.abs(q) - q)

    right = -2.0 * np.minimum(x + 1.5, 0.0)
    assert judged(right) == {"inside": pytest.approx(1.0, abs=0.01), "formula": True}
    assert judged(1.2 * right, -2.4)["inside"] < 0.9 and not judged(right, -2.4)["formula"]
    assert judged(right + 0.3 * x - 1.0)["inside"] < 0.1  # which the logs would not tell from another gain
    assert judged(right + 0.3 * x - 1.0, untold=(0, 1))["inside"] > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "at", "of", "same"),
    [
        ("parameter times", "damping", "speed", True),
        ("input adds", "push", "speed", True),
        ("parameter times", "mass", "speed", False),
        ("parameter times", "damping", "time", False),
        ("input adds", "push", "push_lagged_by_2_s", False),
    ],
)
def test_a_drag_is_a_gain_of_the_damping_and_no_gain_of_the_mass(how: str, at: str, of: str, same: bool) -> None:
    """Along a log a function of time could be the same; by the equations it is not."""
    bound = BoundSystem(CART, [Record("run", T, {"push": 5.0 * np.sin(T), "speed": np.sin(T - 0.8)})])
    x = np.linspace(-1.0, 1.0, 257) if of == "speed" else np.linspace(0.0, 20.0, 257)
    q = x if of == "speed" else np.sin(x - 0.8)
    y = {"damping": 0.35 * np.abs(q), "push": -0.7 * q * np.abs(q), "mass": 0.35 * np.abs(q)}[at]
    said = same_by_equations(
        law(how, at, of, x, y, 0.01), bound, CART, "speed", "speed", lambda v: 0.7 / 4.0 * v * np.abs(v)
    )
    assert (said["inside"] > 0.95) == same


@pytest.mark.slow
@pytest.mark.parametrize("untold", [(), (0,), (1,), (0, 1)])
@pytest.mark.parametrize(("flow", "same"), [(0.3, True), (0.4, False)])
def test_a_bias_of_the_pump_is_a_constant_flow_into_its_tank_whatever_cannot_be_told(
    untold: tuple[int, ...], flow: float, same: bool
) -> None:
    tanks = System(
        "tanks", "simulate",
        lambda x, u, p: [p.inflow * u.pump - p.outflow * x.upper, p.outflow * x.upper - 0.2 * x.lower],
        inputs={"pump": "V"}, states={"upper": "cm", "lower": "cm"}, outputs={"lower": "cm"},
        parameters=[unknown("inflow", 0.15, "cm/(V s)"), unknown("outflow", 0.35, "1/s")],
    )  # fmt: skip
    pump = 3.0 + 2.0 * np.sin(T)
    bound = BoundSystem(tanks, [Record("run", T, {"pump": pump, "lower": 2.0 * pump})])
    x = np.linspace(1.0, 5.0, 257)
    # what adds to a state is taken off it; no parameter makes a constant flow
    learned = law("state adds", "upper", "pump", x, np.full(257, -flow + 1e-5), 1e-3, untold=untold)
    judged = same_by_equations(learned, bound, tanks, "pump", "", lambda q: np.full(len(q), 2.0))
    assert (judged["inside"] > 0.9) is same
