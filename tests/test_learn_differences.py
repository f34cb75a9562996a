"""Curves of a difference: of two states, or of a state and what drives the model. Inside the simulation against another
integrator, names, the law file, the Python file, and laws that are learned where one is hidden.
"""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace as Values
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.same_law import same_by_equations
from plant import write_model
from plant.model import Learned, Model
from vaneloop import Record, System, unknown
from vaneloop.base.tables import read
from vaneloop.identification import StageError
from vaneloop.identification.candidates.closed_forms import Formula
from vaneloop.identification.unmodelled.curve_candidates import UserModelCandidates, candidates, with_curves
from vaneloop.identification.unmodelled.fitted_candidate import plain
from vaneloop.identification.unmodelled.learned_law import LearnedLaw
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.unmodelled.python_law import python_law
from vaneloop.identification.unmodelled.regressors import quantities
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.by_log import bind
from vaneloop.identification.user_models.exogenous_regressors import sides_of
from vaneloop.identification.user_models.injection_points import from_file
from vaneloop.verbs.learn import learn

D = "motor_minus_drum"
VALUES = {"clutch": 2.0, "drag": 0.8}


def drive(x, u, p):
    torque = p.clutch * (x.motor - x.drum)
    return (u.torque - torque) / 0.5, (torque - p.drag * x.drum) / 2.0


DRIVE = System(
    "drive", "simulate", drive, inputs={"torque": "N m", "belt": "rad/s"},
    states={"motor": "rad/s", "drum": "rad/s"}, outputs={"motor": "rad/s", "drum": "rad/s"},
    parameters=[unknown("clutch", 1.2, "N m s/rad", low=0.0), unknown("drag", 1.0, "N m s/rad", low=0.0)],
    start={"motor": 0.0, "drum": 0.0},
)  # fmt: skip


def run_of_a_drive(seed: int, rate=drive, size: float = 6.0, n: int = 900, noise: float = 0.01) -> Record:
    """The drive by Runge and Kutta's steps of a tenth of a sample, the torque held from sample to sample."""
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(float(n))
    torque = np.repeat(rng.uniform(-size, size, n // 30 + 1), 30)[:n]
    belt = 2.0 * np.sin(0.4 * t + seed)
    p, h, x = Values(**VALUES), 0.005, np.zeros(2)
    states = []

    for a, b in zip(torque, belt, strict=True):
        u = Values(torque=a, belt=b)

        def f(x, u=u):
            return np.array(rate(Values(motor=x[0], drum=x[1]), u, p))

        states.append(x)
        for _ in range(10):
            k1 = f(x)
            k2 = f(x + 0.5 * h * k1)
            k3 = f(x + 0.5 * h * k2)
            x = x + h / 6.0 * (k1 + 2.0 * (k2 + k3) + f(x + h * k3))
    motor, drum = np.array(states).T + noise * rng.standard_normal((2, n))
    return Record(f"run {seed}", t, {"torque": torque, "belt": belt, "motor": motor, "drum": drum})


@pytest.fixture(scope="module")
def bound():
    return BoundSystem(DRIVE, [run_of_a_drive(1, n=400)])


# ---- what there is ---------------------------------------------------------------------------------------------------


def differences(bound) -> dict[str, object]:
    own = len(bound.system.parameters) + len(bound.runner.free_starts)
    return {q.name: q for q in quantities(bound, bound.stage.neutral()[:own]) if q.less}


@pytest.mark.slow
def test_a_difference_is_of_one_unit_and_in_the_order_of_the_model(bound) -> None:
    assert list(differences(bound)) == ["motor_minus_drum", "motor_minus_belt", "drum_minus_belt"]
    r = bound.data.records[0]
    d = differences(bound)[D]
    assert d.unit == "rad/s"
    assert np.sqrt(np.mean((d.visited - r.columns["motor"] + r.columns["drum"]) ** 2)) < 0.02


@pytest.mark.parametrize("unit", ["", "-", "%"])
def test_numbers_without_a_unit_need_not_be_of_one_kind(unit: str) -> None:
    plain_numbers = replace(DRIVE, states=dict.fromkeys(DRIVE.states, unit), inputs={"torque": unit, "belt": unit})
    assert not differences(BoundSystem(plain_numbers, [run_of_a_drive(1, n=200)]))


def test_a_difference_that_says_what_another_quantity_says_is_none() -> None:
    record = run_of_a_drive(1, n=300)
    constant = Record("run", record.t, {**record.columns, "belt": np.full(300, 2.0)})
    assert list(differences(BoundSystem(DRIVE, [constant]))) == [D]  # less a constant, a speed is the same quantity
    logged = Record("run", record.t, {**record.columns, "slip": record.columns["motor"] - record.columns["drum"]})
    assert D not in differences(BoundSystem(DRIVE, [logged]))


@pytest.mark.slow
def test_what_the_model_has_as_a_difference_comes_first_of_many() -> None:
    """A ring of ten bodies that exchange heat has 45 pairs; its links are among the differences."""
    names = [f"t{k}" for k in range(10)]

    def heat(x, u, p):
        return tuple(p.link * (x[k - 1] - x[k]) + p.link * (x[(k + 1) % 10] - x[k]) for k in range(10))

    ring = System(
        "ring", "simulate", heat, states=dict.fromkeys(names, "K"), outputs=dict.fromkeys(names, "K"),
        parameters=[unknown("link", 0.1, "1/s", low=0.0)],
    )  # fmt: skip
    rng = np.random.default_rng(0)
    t = np.arange(100.0)
    bodies = {n: 300.0 + np.cumsum(rng.standard_normal(100)) for n in names}
    found = list(differences(BoundSystem(ring, [Record("run", t, bodies)])))
    assert len(found) == 20
    assert set(found[:10]) == {*(f"t{k}_minus_t{k + 1}" for k in range(9)), "t0_minus_t9"}


def test_a_difference_is_less_plain_than_its_channels_and_plainer_than_what_drifts_turns_or_remembers(bound) -> None:
    at = {
        c.quantity.name: plain(c)
        for c in candidates(bound, bound.stage.neutral()[:2])
        if (c.how, c.at) == ("parameter times", "drag")
    }
    lag = next(n for n in at if "lagged_by" in n)
    assert max(at["motor"], at["drum"]) < at[D] < min(at["time"], at["direction_of_motor"], at[lag])


def test_a_curve_of_a_difference_has_the_shape_that_is_known(bound) -> None:
    c = next(c for c in candidates(bound, np.array([2.0, 0.8])) if c.name == f"drum.curve_of_{D}")
    odd = c.shaped(["odd"])
    assert odd is not None
    y = odd.basis.design(odd.grid) @ odd.turn
    assert np.allclose(y, -y[::-1], atol=1e-9 * np.abs(y).max())


@given(st.lists(st.sampled_from(["a", "b", "minus", "a_minus_b"]), min_size=2, max_size=2, unique=True))
def test_a_name_is_taken_apart_where_both_sides_are_known(names: list[str]) -> None:
    one, other = names
    whole = f"{one}_minus_{other}"
    sides = sides_of(whole, set(names))
    assert sides is not None and f"{sides[0]}_minus_{sides[1]}" == whole and set(sides) <= set(names)
    assert sides_of(whole, {*names, whole}) is None  # a channel of that name is one
    assert sides_of(whole, {one}) is None


# ---- what it does ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "at", "of"),
    [
        ("parameter times", "clutch", "motor_minus_drum"), ("state adds", "drum", "motor_minus_drum"),
        ("state adds", "motor", "motor_minus_belt"), ("input times", "torque", "drum_minus_belt"),
        ("output adds", "motor_sensor", "motor_minus_drum"),
    ],
)  # fmt: skip
def test_a_curve_is_of_the_difference_of_what_is_simulated(bound, how: str, at: str, of: str) -> None:
    """Against another integrator; what is measured would differ by its noise."""
    c = next(c for c in candidates(bound, np.array([2.0, 0.8])) if (c.how, c.at, c.quantity.name) == (how, at, of))
    size = 0.3 if how.endswith("times") else 0.4

    def curve(q: float) -> float:
        return size * np.sin(np.clip(q, c.basis.low, c.basis.high))

    table = curve(c.grid)
    one = replace(c.effect(1.0), parameters=c.effect(1.0).parameters[:1], starts=((1.0,),))
    ours = with_curves(bound, (), [(c.placed_as(lambda n: n[0] * table, 1), one)])
    ours.runner.steps = 4
    y = ours.run(np.array([[2.0, 0.8, 1.0]]))[0]

    def of_this(x, u) -> float:
        return curve(eval(of.replace("_minus_", " - "), {"motor": x.motor, "drum": x.drum, "belt": u.belt}))

    def rate(x, u, p):
        k = of_this(x, u)
        clutch = p.clutch * (1.0 + k) if at == "clutch" else p.clutch
        torque = u.torque * (1.0 + k) if at == "torque" else u.torque
        d = np.array(drive(x, Values(torque=torque), Values(clutch=clutch, drag=p.drag)))
        return d - k * (np.array(["motor", "drum"]) == at)

    theirs = run_of_a_drive(1, rate, n=400, noise=0.0)
    motor, drum = theirs.columns["motor"], theirs.columns["drum"]
    shown = motor + curve(motor - drum) if at == "motor_sensor" else motor
    still = run_of_a_drive(1, n=400, noise=0.0)
    assert np.max(np.abs(shown - still.columns["motor"])) > 0.05  # it does something
    assert np.max(np.abs(y - [shown, drum])) < 2e-3


def test_a_model_that_is_not_simulated_takes_the_difference_of_its_inputs() -> None:
    valve = System(
        "valve", "static", lambda u, p: p.gain * (u.supply - u.tank), inputs={"supply": "bar", "tank": "bar"},
        outputs={"flow": "l/min"}, parameters=[unknown("gain", 2.0, "l/(min bar)", low=0.0)],
    )  # fmt: skip
    rng = np.random.default_rng(0)
    supply, tank = rng.uniform(50.0, 90.0, 300), rng.uniform(0.0, 40.0, 300)
    pressures = {"supply": supply, "tank": tank, "flow": 2.0 * (supply - tank)}
    bound = BoundSystem(valve, [Record("run", np.arange(300.0), pressures)])
    law = Learned(how="parameter times", at="gain", of="supply_minus_tank", low=0.0, high=90.0, form="line",
                  values=[-0.005])  # fmt: skip
    y = with_curves(bound, (), [from_file("gain.gain_of_supply_minus_tank", law, bound.data)])
    assert np.allclose(y.run(np.array([[2.0, -0.005]]))[0, 0], 2.0 * (supply - tank) * (1.0 - 0.005 * (supply - tank)))


# ---- files -----------------------------------------------------------------------------------------------------------

LAW = Learned(how="parameter times", at="clutch", of=D, low=-3.0, high=3.0, form="square", values=[0.1], unit="-")


def test_a_law_file_of_a_difference_does_what_the_curve_does(bound, tmp_path: Path) -> None:
    model = Model(meta={"system": "drive"}, effects={f"clutch.gain_of_{D}": {"a": 0.1}},
                  curves={f"clutch.gain_of_{D}": LAW})  # fmt: skip
    write_model(tmp_path / "law.toml", model)
    law = read(tmp_path / "law.toml", Model).curves[f"clutch.gain_of_{D}"]
    y = with_curves(bound, (), [from_file("law", law, bound.data)])
    c = next(c for c in candidates(bound, np.array([2.0, 0.8])) if c.name == f"clutch.gain_of_{D}")
    grid = np.linspace(-3.0, 3.0, 1025)
    own = c.placed_as(lambda n: n[0] * grid**2, 1, (-3.0, 3.0))
    theta = np.array([[2.0, 0.8, 0.1]])
    effect = replace(c.effect(1.0), parameters=c.effect(1.0).parameters[:1], starts=((0.1,),))
    assert np.array_equal(y.run(theta), with_curves(bound, (), [(own, effect)]).run(theta))


def test_a_channel_of_that_name_stands_before_the_difference() -> None:
    record = run_of_a_drive(1, n=300)
    named = Record("run", record.t, {**record.columns, D: np.sin(record.t)})
    bound = BoundSystem(DRIVE, [named])
    (placed, _), d = from_file("law", LAW, bound.data), differences(bound)
    assert D not in d and placed.curve is not None
    assert placed.curve.less is None
    assert np.allclose(placed.curve.values(bound.data, 0, bound.data.u[0]), np.sin(record.t))


@pytest.mark.parametrize("of", ["motor_minus_hub", "hub_minus_motor", "motor_minus_", "motor_minus_time"])
def test_a_difference_of_what_is_not_known_gets_one_line(bound, of: str) -> None:
    with pytest.raises(StageError, match=f"of .='{of}'. is not one of system 'drive'; allowed: motor, drum"):
        from_file("law", LAW.model_copy(update={"of": of}), bound.data)


def law_of(name: str, of: str, end: float = 3.0, a: float = 0.1) -> LearnedLaw:
    """A law as it was learned, with a formula that does as well."""
    x = np.linspace(-end, end, 257)
    spoken = Formula("square", f"{a} {of}^2", {"a": a}, 1.0, 3)
    at, _, kind = name.partition(".")
    how = "parameter times" if kind.startswith("gain") else "state adds"
    return LearnedLaw(
        name, how, at, of, "-", "rad/s", x, a * x**2, a * x**2 - 0.01, a * x**2 + 0.01, x[::32], x[:8] * 0.0, 9.0, 1.0,
        np.zeros(0), [spoken], spoken=spoken, reach=(-end, end),
    )  # fmt: skip


@pytest.mark.slow
def test_the_python_file_gives_the_same_simulation(bound, tmp_path: Path) -> None:
    (tmp_path / "law.py").write_text(python_law(law_of(f"clutch.gain_of_{D}", D), DRIVE))
    own = runpy.run_path(str(tmp_path / "law.py"))
    own["test_curve"]()
    assert "p.clutch * (1.0 + c)" in own["quantity"].__doc__
    curve, quantity = own["curve"], own["quantity"]

    def with_law(x, u, p):
        torque = p.clutch * (1.0 + curve(quantity(x, u))) * (x.motor - x.drum)
        return (u.torque - torque) / 0.5, (torque - p.drag * x.drum) / 2.0

    short = [run_of_a_drive(1, n=60)]
    by_hand = with_curves(BoundSystem(replace(DRIVE, model=with_law), short), (), [])
    plain_drive = with_curves(BoundSystem(DRIVE, short), (), [])
    file = with_curves(plain_drive, (), [from_file("law", LAW, plain_drive.data)])
    by_hand.runner.steps = file.runner.steps
    theirs, ours = by_hand.run(np.array([[2.0, 0.8]])), file.run(np.array([[2.0, 0.8, 0.1]]))
    assert np.allclose(theirs, ours, atol=1e-5)
    assert not np.allclose(theirs, plain_drive.run(np.array([[2.0, 0.8]])), atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("at", "of", "same"), [("drum", D, True), ("drum", "motor", False), ("motor", D, False)])
def test_the_judge_knows_a_difference_by_its_two_sides(bound, at: str, of: str, same: bool) -> None:
    true = replace(DRIVE, parameters=[replace(p, value=VALUES[p.name]) for p in DRIVE.parameters])
    law = law_of(f"{at}.curve_of_{of}", of, 20.0)
    said = same_by_equations(law, bound, true, "drum", D, lambda q: 0.1 * q**2)
    assert (said["inside"] > 0.9) is same and said["formula"] is same


def test_a_test_log_speaks_of_a_difference_that_would_be_none_by_itself() -> None:
    """In the test log the belt stands, so that less it a speed is the same quantity there."""
    further = run_of_a_drive(2, size=12.0)
    further = Record("further", further.t, {**further.columns, "belt": np.full(len(further.t), 1.0)})
    ground = UserModelCandidates(bind(DRIVE, [run_of_a_drive(1)], [further]))
    assert ground.logs.test is not None and list(differences(ground.logs.test)) == [D]
    every = ground.candidates(ground.logs.fitted.stage.neutral()[:2])
    for of in (D, "motor_minus_belt"):
        c = next(c for c in every if c.name == f"clutch.gain_of_{of}")
        one, other = (further.columns[n] for n in of.split("_minus_"))
        inside = (one - other >= c.basis.low) & (one - other <= c.basis.high)
        assert 0.4 < inside.mean() < 0.95
        assert np.mean(ground.within(c)["further"] == inside) > 0.98


# ---- learning --------------------------------------------------------------------------------------------------------


def stiffer(x, u, p):
    """The clutch's torque has a cube of the slip."""
    slip = x.motor - x.drum
    torque = p.clutch * slip * (1.0 + 0.15 * slip**2)
    return (u.torque - torque) / 0.5, (torque - p.drag * x.drum) / 2.0


def windage(x, u, p):
    """The drum's drag grows with its speed."""
    torque = p.clutch * (x.motor - x.drum)
    return (u.torque - torque) / 0.5, (torque - p.drag * x.drum * (1.0 + 0.15 * abs(x.drum))) / 2.0


@pytest.mark.slow
def test_a_cubic_coupling_of_the_difference_is_learned() -> None:
    answer = learn([run_of_a_drive(1, stiffer)], DRIVE, test=[run_of_a_drive(2, stiffer)])
    (law,) = answer.laws
    assert law.name == f"clutch.gain_of_{D}"
    assert law.spoken is not None and law.spoken.form == "square"
    assert law.spoken.numbers["a"] == pytest.approx(0.15, rel=0.1)
    assert answer.model is not None and answer.model.curves[law.name].of == D


@pytest.mark.slow
def test_what_is_of_one_of_the_two_alone_is_learned_as_that() -> None:
    answer = learn([run_of_a_drive(1, windage)], DRIVE, test=[run_of_a_drive(2, windage)])
    assert answer.verdict in ("learned", "named")
    assert all(law.of == "drum" for law in answer.laws)


def test_where_a_formula_of_a_plainer_curve_goes_before_the_best_curve_all_have_theirs() -> None:
    """A log that goes further asks for formulas: a curve of one side must not win by its formula over the difference's
    curve without one.
    """

    def fitted(of: str, formula: float) -> Any:
        quantity = Values(name=of, less=(1, "b") if "minus" in of else None, remembers=False, period=0.0)
        candidate = Values(name=of, at="place", near=False, how="state adds", quantity=quantity)
        said = Values(fit=Values(free=[0]), left=formula)
        return Values(candidate=candidate, fit=Values(cost=np.ones(1), free=[0]), judge=Values(n=1), loose=[said])

    learner: Any = Values(
        fails=lambda _: False, objection=lambda *_: "", ground=Values(shares=False), left=lambda _, f, __: f.left
    )
    for plainer, expected in ((-0.5, {"a": -0.5, "a_minus_b": -2.0}), (0.2, {"a": 0.2, "a_minus_b": 0.0})):
        left = {"a": 0.3, "a_minus_b": 0.0}
        CurveSearch._with_formulas(learner, fitted("b", 9.0), [fitted("a", plainer), fitted("a_minus_b", -2.0)], left)
        assert left == expected


def test_where_nothing_is_missing_no_difference_is_learned() -> None:
    assert not learn([run_of_a_drive(1)], DRIVE, test=[run_of_a_drive(2)]).laws
