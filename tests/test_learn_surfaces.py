"""Laws of two quantities that nobody listed: surfaces inside the simulation against another integrator, their law file,
and which truths get one.
"""

from __future__ import annotations

import dataclasses
import json
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from benchmarks.hidden_law import surface_summary
from plant import Model, load_model, write_model
from plant.model import Learned, Second
from tests.browser import open_to_all
from tests.conftest import examples
from tests.rig_systems import draw_case
from tests.rig_systems.surfaces import SHAPES, draw_surface
from tests.test_learn import TANK, run_of_a_tank
from vaneloop import InputError, Record, System, compare, extend, unknown
from vaneloop.base.curve import SIDE, on_grid
from vaneloop.base.hull import hull_of, nearest_within, within
from vaneloop.base.tables import read
from vaneloop.identification import StageError
from vaneloop.identification.unmodelled.curve_candidates import with_curves
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.injection_points import from_file
from vaneloop.verbs.learn import learn

NAME = "outflow.gain_of_level_and_oil"
KNOTS = {
    "level": [0.0] * 4 + [15.0] + [40.0] * 4,
    "oil": [20.0] * 4 + [40.0] + [60.0] * 4,
    "time": [0.0] * 4 + [399.0] * 4,
}


@pytest.fixture(scope="module")
def bound():
    return BoundSystem(TANK, [run_of_a_tank()])


def law(
    how: str = "parameter times", at: str = "outflow", of: str = "level", second: str = "oil", **more: Any
) -> Learned:
    """A surface that bends along both."""
    ends = [(k[0], k[-1], k) for k in (KNOTS[of], KNOTS[second])]
    count = [len(k) - 4 for _, _, k in ends]
    values = 0.4 * np.sin(np.arange(count[0])[:, None] * 1.3 + np.arange(count[1]) * 0.9)
    return Learned(
        how=how, at=at, of=of, low=ends[0][0], high=ends[0][1], knots=ends[0][2], values=values.ravel().tolist(),
        second=Second(of=second, low=ends[1][0], high=ends[1][1], knots=ends[1][2], **more),
    )  # fmt: skip


def exact(law: Learned, x: float, z: float) -> float:
    """The surface itself, by scipy's own tensor product."""
    from scipy.interpolate import BSpline

    assert law.second is not None
    rows = len(law.knots) - 4
    along = BSpline(np.array(law.knots), np.reshape(law.values, (rows, -1)), 3)(np.clip(x, law.low, law.high))
    return float(BSpline(np.array(law.second.knots), along, 3)(np.clip(z, law.second.low, law.second.high)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "at", "of", "second"),
    [
        ("parameter times", "outflow", "level", "oil"), ("state adds", "level", "oil", "level"),
        ("input adds", "pump", "time", "level"), ("output adds", "level_sensor", "level", "oil"),
        ("output times", "level_sensor", "oil", "time"),
    ],
)  # fmt: skip
def test_a_surface_does_what_its_place_says(bound, how: str, at: str, of: str, second: str) -> None:
    """Against scipy's integrator of the equations with the surface written out."""
    one = law(how, at, of, second)
    w = with_curves(bound, (), [from_file("a.b", one, bound.data)])
    w.runner.steps = 8
    ours = w.run(np.array([[0.2, 0.05, *one.values]]))[0, 0]
    r = bound.data.records[0]

    def c(t: float, x: float) -> float:
        held = r.t[min(int(t + 1e-12), len(r.t) - 1)]  # a column holds from sample to sample
        known = {"level": x, "oil": float(np.interp(t, r.t, r.columns["oil"])), "time": held}
        return exact(one, known[of], known[second])

    def rate(t: float, x: np.ndarray) -> list[float]:
        y, pump = c(t, x[0]), np.interp(t, r.t, r.columns["pump"])
        b = 0.05 * (1.0 + y) if at == "outflow" else 0.05
        pump = pump + y if at == "pump" else pump
        return [0.2 * pump - b * x[0] - (y if how == "state adds" else 0.0)]

    theirs = [20.0]
    for k in range(len(r.t) - 1):
        s = solve_ivp(rate, (r.t[k], r.t[k + 1] - 1e-9), [theirs[-1]], rtol=1e-8, atol=1e-9)
        theirs.append(float(s.y[0, -1]))
    y = np.array([c(t, x) for t, x in zip(r.t, theirs, strict=True)])
    shown = theirs + y if how == "output adds" else theirs * (1.0 + y) if how == "output times" else np.array(theirs)
    plain = with_curves(bound, (), ()).run(np.array([[0.2, 0.05]]))[0, 0]
    assert np.sqrt(np.mean((shown - plain) ** 2)) > 0.05  # it does something
    assert np.max(np.abs(ours - shown)) < 0.02


@pytest.mark.slow
@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.integers(0, 50))
def test_a_surface_is_the_same_in_the_loop_and_beside_it(x: float, z: float, seed: int) -> None:
    """Straight between its points each way, and beyond its edges as at them."""
    table = np.random.default_rng(seed).standard_normal((SIDE, SIDE))
    low, high = np.array([-2.0, -1.0]), np.array([3.0, 2.5])
    model = read_surface(law(), low, high)
    beside = float(model.at(np.array([[x], [z]]), table)[0])
    assert on_grid(x, z, low, high, table) == pytest.approx(beside, abs=1e-9)
    near = np.clip([x, z], low, high)
    assert on_grid(x, z, low, high, table) == pytest.approx(on_grid(near[0], near[1], low, high, table), abs=1e-9)


def read_surface(one: Learned, low: np.ndarray, high: np.ndarray) -> Any:
    placed, _ = from_file("a.b", one, BoundSystem(TANK, [run_of_a_tank(60)]).data)
    ends = {"low": low[0], "high": high[0], "low_second": low[1], "high_second": high[1]}
    return dataclasses.replace(placed.curve, **ends)


def test_beyond_where_both_have_been_a_surface_stays_as_at_the_nearest_place() -> None:
    """The samples fill a triangle: the corner opposite is as the middle of its long side."""
    rng = np.random.default_rng(1)
    x, z = rng.uniform(0.0, 10.0, 4000), rng.uniform(0.0, 2.0, 4000)
    below = z / 2.0 + x / 10.0 < 1.0
    low, high = np.array([0.0, 0.0]), np.array([10.0, 2.0])
    hull = hull_of(x[below], z[below], low, high)
    assert hull is not None and len(hull) < 100
    assert within(hull, low, high, x[below], z[below]).all()
    assert not within(hull, low, high, np.array([9.0]), np.array([1.9])).any()
    nearest = nearest_within(hull, low, high).reshape(SIDE, SIDE)
    k, m = divmod(int(nearest[-1, -1]), SIDE)
    assert abs(k - SIDE // 2) <= 1 and abs(m - SIDE // 2) <= 1
    assert nearest[3, 3] == 3 * SIDE + 3
    assert hull_of(x, x / 5.0, low, high) is None  # along a line there is no surface
    held = law(of="level", second="oil", been=[(0.0, 20.0), (40.0, 20.0), (0.0, 60.0)])
    values = np.array(held.values)
    assert held.table()(values)[-1, -1] == pytest.approx(law().table()(values)[SIDE // 2, SIDE // 2], abs=0.05)


# ---- the law file ----------------------------------------------------------------------------------------------------


def test_a_surface_is_read_as_it_was_written_and_the_vane_chain_says_that_it_takes_none(tmp_path: Path) -> None:
    been = [(0.0, 20.0), (40.0, 20.0), (0.0, 60.0)]
    model = Model(meta={"system": "tank"}, effects={NAME: {"c1": 0.5}}, curves={NAME: law(been=been)})
    write_model(tmp_path / "law.toml", model)
    assert read(tmp_path / "law.toml", Model) == model
    write_model(tmp_path / "law.toml", model.model_copy(update={"meta": {}}))
    with pytest.raises(InputError, match="second .='oil'. makes it a surface; the vane chain takes curves of one") as e:
        load_model(tmp_path / "law.toml")
    assert "\n" not in str(e.value)


@pytest.mark.slow
def test_a_product_of_formulas_is_a_surface(bound) -> None:
    """Their numbers: those of the first, and of the second all but what multiplies it."""
    second = Second(of="oil", low=20.0, high=60.0, form="exponential")
    one = Learned(
        how="state adds", at="level", of="level", low=0.0, high=40.0, form="root", values=[0.1, 0.02], second=second
    )
    assert one.numbers == ("a", "second_b")
    table = one.table()(np.array(one.values))
    assert table[64, 128] == pytest.approx(0.1 * np.sqrt(10.0) * np.expm1(0.02 * 40.0))
    out = with_curves(bound, (), [from_file("a.b", one, bound.data)]).run(np.array([[0.2, 0.05, *one.values]]))[0, 0]
    assert np.all(out[5:] < with_curves(bound, (), ()).run(np.array([[0.2, 0.05]]))[0, 0, 5:])  # an outflow more


@pytest.mark.parametrize(
    ("change", "second", "said"),
    [
        ({}, {"of": "speed"}, r"second: of \(='speed'\) is not one of system 'tank'; allowed: level, pump, oil, time"),
        ({}, {"of": "stops_of_pump"}, r"second: of \(='stops_of_pump'\) is not one"),
        ({"of": "stops_of_pump"}, {}, r"of \(='stops_of_pump'\) is not one"),
        ({}, {"low": 60.0, "high": 20.0}, r"second: low \(=60\) must be below high \(=20\)"),
        ({}, {"knots": [0.0, 1.0]}, r"second: knots \(2 of them\) must rise, and be 8 at least"),
        ({"values": [1.0] * 9}, {}, r"values \(9 of them\) must be 5 x 5"),
        ({}, {"form": "line"}, r"second: form \(='line', 25 values\) must be one of none"),
        ({"form": "line", "values": [1.0]}, {}, r"second: form \(='', 1 values\) must be one of constant"),
        ({"form": "line", "values": [1.0]}, {"form": "tanh"}, r"with second, a, second_b are needed"),
        ({}, {"been": [(0.0, 20.0), (40.0, 60.0)]}, r"second: been \(2 corners\) must be three or more, not along"),
        ({}, {"been": [(0.0, 20.0), (20.0, 40.0), (40.0, 60.0)]}, r"been \(3 corners\) must be three or more"),
    ],
)
def test_a_wrong_surface_gets_one_line(bound, change: dict[str, Any], second: dict[str, Any], said: str) -> None:
    one = law()
    assert one.second is not None
    wrong = one.model_copy(update={**change, "second": one.second.model_copy(update=second)})
    with pytest.raises(StageError, match=said) as e:
        from_file(NAME, wrong, bound.data)
    assert "\n" not in str(e.value)


NUMBER = st.one_of(st.floats(allow_nan=True), st.integers(-3, 3), st.just("x"))
ANY = st.one_of(
    NUMBER, st.lists(NUMBER, max_size=30), st.lists(st.lists(NUMBER, max_size=3), max_size=6), st.text(max_size=4)
)


@pytest.mark.slow
@given(st.sampled_from(["of", "low", "high", "knots", "form", "been"]), ANY, st.booleans(), st.booleans())
@settings(max_examples=examples(150), deadline=None)
def test_no_law_file_ends_in_a_traceback(bound, key: str, value: Any, drop: bool, outer: bool) -> None:
    """Whatever one of its keys is: the file is refused in one line, or it runs."""
    as_file = json.loads(law(been=[(0.0, 20.0), (40.0, 20.0), (0.0, 60.0)]).model_dump_json())
    table = as_file if outer else as_file["second"]
    table.pop(key, None) if drop else table.update({key: value})
    try:
        one = Learned.model_validate(as_file)
    except ValidationError:
        return
    try:
        placed = from_file(NAME, one, bound.data)
    except StageError as e:
        assert "\n" not in str(e)
        return
    out = with_curves(bound, (), [placed]).run(np.array([[0.2, 0.05, *one.values]]))
    assert np.isfinite(out).all()


# ---- the benchmark ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_no_hidden_law_of_two_quantities_is_a_sum(shape: str) -> None:
    """What is left of it beside the best function of each, over a grid, is a good part of it."""
    a, b = np.meshgrid(np.linspace(-1.0, 1.0, 41), np.linspace(-1.0, 1.0, 41))
    z = SHAPES[shape](a, b)
    left = z - z.mean(axis=0) - z.mean(axis=1)[:, None] + z.mean()
    assert np.std(left) > 0.15 * np.std(z)


@pytest.mark.slow
def test_a_law_of_two_quantities_is_hidden_where_both_move() -> None:
    case, both = draw_surface(3, 0, ("valve_bench", "dc_motor"))
    assert case.family.name == "dc_motor"  # the other has one quantity only
    assert set(both) <= {*case.family.states, *case.family.inputs} and len(set(both)) == 2
    assert [h.name for h in case.hidden] == ["together"]
    plain = draw_case(3, 0, ("dc_motor",), [])
    assert case.values == plain.values
    assert all(np.array_equal(a.drive, b.drive) for a, b in zip(case.logs, plain.logs, strict=True))
    assert not np.allclose(case.logs[0].outputs, plain.logs[0].outputs)


def test_a_surface_counts_where_its_quantities_are_right() -> None:
    def row(kind: str, names: list[str], two: bool, error: float = 1.0, left: float = 5.0) -> dict[str, Any]:
        laws = [{"names": names, "formulas": [], "two": two}]
        return {"kind": kind, "both": ["angle", "rate"], "learned": json.dumps({"laws": laws, "error": error}),
                "left": [left], "truth": ["together"]}  # fmt: skip

    rows = [
        row("surface", ["rate.curve_of_rate_and_angle"], True),
        row("surface", ["rate.curve_of_rate_and_torque"], True, 3.0), row("surface", ["rate.curve_of_rate"], False),
        row("surface", ["rate.curve_of_rate"], False, left=0.2),
        row("clean", ["rate.curve_of_rate_and_angle"], True), row("outside", ["rate.curve_of_rate"], False),
    ]  # fmt: skip
    counted = [(v["hits"], v["of"]) for v in surface_summary(rows).values()]
    assert counted == [(1, 3), (2, 3), (1, 1), (1, 2)]


# ---- from logs to a law ----------------------------------------------------------------------------------------------

METER = System(
    "meter", "static", lambda u, p: p.gain * u.speed, inputs={"speed": "rad/s", "pressure": "MPa", "oil": "degC"},
    outputs={"flow": "l/min"}, parameters=[unknown("gain", 1.0, "l/rad", low=0.0)], places=["flow"],
)  # fmt: skip


def warm(oil: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-(oil - 50.0) / 8.0))


LAWS = {
    "leak": lambda p, oil: 0.1 * p * warm(oil),
    "crossed": lambda p, oil: 2.0 * np.sin(p / 6.0 + oil / 15.0),
    "one": lambda p, oil: 0.02 * p * p,
    "sum": lambda p, oil: 0.02 * p * p + 3.0 * warm(oil),
    "nothing": lambda p, oil: 0.0 * p,
}


def run_of_a_pump(seed: int, truth: str, n: int = 900) -> Record:
    """A pump's flow with a leak; pressure and oil wander."""
    rng, t = np.random.default_rng(seed), np.arange(n) * 0.1

    def wander(low: float, high: float, turns: int) -> np.ndarray:
        return np.interp(t, np.linspace(0.0, t[-1], turns), rng.uniform(low, high, turns))

    speed, pressure, oil = wander(0.0, 100.0, 40), wander(1.0, 20.0, 50), wander(20.0, 80.0, 12)
    flow = 0.5 * speed - LAWS[truth](pressure, oil) + 0.05 * rng.standard_normal(n)
    return Record(f"run {seed}", t, {"speed": speed, "pressure": pressure, "oil": oil, "flow": flow})


def learned(truth: str) -> Any:
    runs = [run_of_a_pump(seed, truth) for seed in (1, 2, 3)]
    return learn(runs[:2], METER, test=runs[2:])


@pytest.mark.slow
def test_a_leak_that_grows_with_pressure_and_with_warmth_is_a_surface_and_a_product(tmp_path: Path) -> None:
    answer = learned("leak")
    (one,) = answer.laws
    assert (one.how, one.at, {one.of, one.second}) == ("output adds", "flow", {"pressure", "oil"})
    assert one.error_before > 4.0 and one.error_after < 1.2
    where = one.within
    p, oil = np.meshgrid(one.x, one.across, indexing="ij")
    off = one.values + LAWS["leak"](p, oil)
    assert np.sqrt(np.mean(off[where] ** 2)) < 0.05  # of a leak of up to 2, in noise of 0.05
    assert where.any() and not where.all()
    said = one.formulas[0]
    assert (said.form, said.second_form) == ("line", "gentle step")
    assert list(said.numbers.values()) == pytest.approx([-0.1, 50.0, 8.0], rel=0.03)
    assert said.text.startswith("-0.0") and "pressure / (1 + exp(-(oil - " in said.text
    answer.write(tmp_path / "law.toml")
    model = read(tmp_path / "law.toml", Model)
    assert model.curves[one.name].form == "line"  # the product does as well: it is the law, and goes on
    after = compare([run_of_a_pump(4, "leak")], METER, added=model)
    assert after.to_dict()["signals"][0]["rms"] < 0.065
    assert "values" in answer.to_dict()["laws"][0]
    space = runpy.run_path(str(answer.write_python(tmp_path / "leak.py", METER)))
    space["test_surface"]()
    assert space["surface"](10.0, 50.0) == pytest.approx(-0.5, abs=0.02)
    table = dataclasses.replace(answer, laws=[dataclasses.replace(one, formulas=[])])
    space = runpy.run_path(str(table.write_python(tmp_path / "table.py", METER)))
    space["test_surface"]()
    assert space["surface"](10.0, 50.0) == pytest.approx(-0.5, abs=0.05)
    given = model.model_copy(update={"effects": {}})
    again = extend([run_of_a_pump(5, "leak")], [one.name], METER, added=given).to_dict()
    before, now = again["waterfall"]["meter"]
    assert before["noise_floors"] > 4.0 and now["noise_floors"] < 1.3
    page = answer.report(tmp_path / "law.html")
    assert "beyond the logs" in page.read_text(encoding="utf-8")
    open_to_all(page, "surface")


@pytest.mark.slow
@pytest.mark.parametrize("truth", ["one", "sum", "nothing"])
def test_what_does_not_act_together_gets_no_surface(truth: str) -> None:
    answer = learned(truth)
    assert not any("_and_" in law.name for law in answer.laws)
    assert len(answer.laws) == {"one": 1, "sum": 2, "nothing": 0}[truth]
