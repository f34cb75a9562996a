"""A model that says nothing is never a model that fits: what is no number is far off, or refused where it arises."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from hil.fmu.plant_fmu import PlantFmu
from hil.fmu.plant_fmu import _Joined as Joined
from hil.logs import Channel, Log, read_log
from hil.loop.lanes import lockstep_lanes
from hil.loop.lockstep import Stimulus, lockstep
from hil.replay import replay
from plant.effects import EFFECTS
from plant.machine import build_plant
from plant.model import Learned, Model, allowed_of
from plant.parameters import LVDT_FACTOR
from tests.conftest import ROOT
from vaneloop.base.errors import InputError
from vaneloop.base.forms import FORMS
from vaneloop.identification.least_squares.problem import LeastSquaresProblem, recalibrate
from vaneloop.identification.least_squares.residuals import normalise_residuals
from vaneloop.identification.settings import NO_ANSWER_ERROR
from vaneloop.identification.subsystem import Parameter, Stage, StageError
from vaneloop.identification.vane_chain.chain import Chain, build_chain
from vaneloop.identification.vane_chain.parameters import FREE

TABLES = ("plant.toml", "plant_electromechanical.toml")


@cache
def log() -> Log:
    """20 s of the example."""
    whole = read_log(ROOT / "examples" / "hidden_effect.parquet")
    return Log("short", {k: Channel(c.t[c.t < 20.0], c.values[c.t < 20.0]) for k, c in whole.channels.items()})


def chain(table: str, model: Model | None = None) -> Chain:
    return build_chain(log(), build_plant(table, model=model))


def free_of(table: str) -> list[tuple[str, str]]:
    known = {n.name for n in build_plant(table).nominal}
    return [(stage, name) for stage, names in FREE.items() for name in names if name in known]


def fake(model: float) -> Stage:
    """A stage of one output that was measured as 0, but for its first sample, and is simulated as ``model``."""
    t = np.arange(400) * 0.01
    measured = np.zeros((1, len(t)))
    measured[0, 0] = np.nan

    def run(thetas: np.ndarray) -> np.ndarray:
        out = np.broadcast_to(thetas[:, 0, None, None], (len(thetas), 1, len(t))).copy()
        out[:, 0, 7] = model
        return out

    return Stage("servo", ("i_cmd",), ("mA",), (Parameter("gain", 0.1, "-", tolerance=1.0),), (), run, t, measured)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_a_model_does_not_say_is_far_off_and_what_was_not_measured_counts_nothing(value: float) -> None:
    model = np.array([[[0.5, value, value]]])
    out = np.empty_like(model)
    normalise_residuals(
        model, np.zeros((1, 3)), np.array([[1.0, 1.0, 0.0]]), np.array([0.1]), np.empty(0, np.int64), out
    )
    assert out.tolist() == [[[-5.0, NO_ANSWER_ERROR, 0.0]]]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_stage_that_gives_no_number_as_it_was_given_is_refused_in_one_line(value: float) -> None:
    with pytest.raises(
        StageError, match=r"^subsystem 'servo': the model's i_cmd is no number at 0.07 s and in 1 samples"
    ):
        recalibrate(LeastSquaresProblem(fake(value), np.array([0.1])))


def test_a_sample_that_was_not_measured_asks_nothing_of_the_model() -> None:
    stage = fake(0.0)
    stage.measured[0, 7] = np.nan
    recalibrate(LeastSquaresProblem(stage, np.array([0.1])))


@pytest.mark.parametrize(
    ("value", "middle", "limits"),
    [(0.8, None, (0.6, 0.9)), (0.8, 0.8, (0.6, 0.9)), (0.75, 0.8, (0.6, 0.9)), (0.55, 0.8, (0.55, 0.9)),
     (0.9, 0.7, (0.5, 0.9))],
)  # fmt: skip
def test_a_tolerance_is_about_its_middle_within_the_bounds(
    value: float, middle: float | None, limits: tuple[float, float]
) -> None:
    p = Parameter("damping", value, "-", 0.4, 0.9, 0.2, middle=middle)
    assert p.limits() == pytest.approx(limits) and p.expected == (value if middle is None else middle)


def test_a_parameter_without_tolerance_stays() -> None:
    assert Parameter("damping", 0.8, "-", 0.4, 0.9).limits() == (0.8, 0.8)


@pytest.mark.parametrize("table", TABLES)
def test_a_recalibrated_model_may_go_where_the_table_allows_and_no_farther(table: str) -> None:
    """However often a model is recalibrated and continued: its tolerances do not wander with it."""
    machine = build_plant(table)
    known = {n.name: n for n in machine.nominal}
    names = [name for _, name in free_of(table)]
    moved = {name: known[name].value + 0.9 * known[name].tolerance for name in names}
    for name, value in moved.items():
        low, high = allowed_of(machine, known[name])
        moved[name] = float(np.clip(value, low, high))
    plain, model = chain(table), chain(table, Model(parameters=moved))
    for one, other in zip(plain.stages, model.stages, strict=True):
        for p, q in zip(one.parameters, other.parameters, strict=True):
            if p.name == "onset":
                assert p == q
                continue
            n = known[p.name]
            assert p.expected == q.expected == n.value and p.value == n.value
            assert q.value == pytest.approx(moved[p.name], rel=1e-9)
            assert q.limits() == pytest.approx(p.limits(), rel=1e-12)
            assert allowed_of(machine, n)[0] <= q.limits()[0] < q.limits()[1] <= allowed_of(machine, n)[1]


@pytest.mark.parametrize("table", TABLES)
def test_every_stage_gives_numbers_to_the_ends_of_every_tolerance_and_of_every_effect(table: str) -> None:
    for stage in chain(table).stages:
        low, high = LeastSquaresProblem(stage, np.ones(len(stage.outputs))).bounds()
        low, high = np.maximum(low, -1e9), np.minimum(high, 1e9)
        own, index = len(stage.parameters), stage.index()
        thetas = [stage.neutral() for _ in range(2 * own)]
        for k in range(own):
            thetas[2 * k][k], thetas[2 * k + 1][k] = low[k], high[k]
        for e in stage.effects:
            for end in (low, high):
                thetas.append(stage.neutral())
                thetas[-1][index[e.name]] = end[index[e.name]]
        for theta in thetas:
            out = stage.run(theta[None])[0]
            names = [p.name for p, a, b in zip(stage.all_parameters(), theta, stage.neutral(), strict=True) if a != b]
            assert np.isfinite(out).all(), (stage.name, names)


@pytest.mark.parametrize("table", TABLES)
def test_every_parameter_of_a_model_gives_numbers_at_its_ends_and_is_refused_beyond(table: str) -> None:
    machine = build_plant(table)
    for n in machine.nominal:
        low, high = allowed_of(machine, n)
        for end, beyond in ((low, low - 1e-6 * max(abs(low), 1.0)), (high, high + 1e-6 * max(abs(high), 1.0))):
            p = build_plant(table, model=Model(parameters={n.name: end})).p
            assert np.isfinite(p).all(), (n.name, end)
            for wrong in (beyond, np.nan, np.inf):
                with pytest.raises((InputError, ValueError), match=r"must be in|finite"):
                    Model(parameters={n.name: wrong}).check(machine)


@pytest.mark.parametrize("table", TABLES)
def test_every_effect_of_a_model_gives_numbers_at_its_ends_and_is_refused_beyond(table: str) -> None:
    machine = build_plant(table)
    for e in EFFECTS.values():
        if not machine.can_have(e):
            continue
        for p in machine.parameters_of(e.name).values():
            for end in (p.low, p.high):
                made = build_plant(table, model=Model(effects={e.name: {p.name: end}}))
                assert np.isfinite(made.p).all(), (e.name, p.name, end)
            for wrong in (p.low - 1.0, p.high + 1.0, np.nan, np.inf):
                with pytest.raises((InputError, ValueError), match=r"must be in|finite"):
                    Model(effects={e.name: {p.name: wrong}}).check(machine)


@pytest.mark.parametrize("table", TABLES)
def test_a_loop_gives_numbers_at_any_ends_of_all_parameters_and_effects_at_once(table: str) -> None:
    machine, rng = build_plant(table), np.random.default_rng(38)
    effects = [e for e in EFFECTS.values() if machine.can_have(e)]
    plants = []
    for _ in range(16 if table == TABLES[0] else 2):
        parameters = {n.name: float(rng.choice(allowed_of(machine, n))) for n in machine.nominal}
        some = [e for e in effects if rng.random() < 0.4]
        at = {
            e.name: {p.name: float(rng.choice([p.low, p.high])) for p in machine.parameters_of(e.name).values()}
            for e in some
        }
        plants.append(Model(parameters=parameters, effects=at).plant(machine))
    demand = np.concatenate([np.full(30, 70.0), np.linspace(70.0, 100.0, 60), np.linspace(100.0, 60.0, 30)])
    for plant in plants:
        run = lockstep(Stimulus.of(demand), plant=plant, hashed=False)
        assert all(np.isfinite(v).all() for v in run.columns.values())


RUNS = [
    lambda stimulus, plant: lockstep(stimulus, plant=plant),
    lambda stimulus, plant: replay(log(), plant=plant),
    pytest.param(lambda stimulus, plant: lockstep_lanes(stimulus, [plant]), marks=pytest.mark.slow),  # compiles
]


@pytest.mark.parametrize("run", RUNS)
def test_a_run_that_is_no_number_is_refused_where_it_arises(run: Any) -> None:
    machine = build_plant()
    p = machine.p.copy()
    p[LVDT_FACTOR] = np.nan
    with pytest.raises(InputError, match=r"^simulation: x_lvdt \(=nan\) at t = 0.000 s must be finite"):
        run(Stimulus.of(np.full(20, 70.0)), replace(machine, p=p))


def test_a_model_whose_curve_overflows_is_refused() -> None:
    x, many = np.linspace(0.0, 100.0, 5), 0
    for form in FORMS:
        values = [1e308] * len(form.numbers)
        with np.errstate(all="ignore"):
            if np.isfinite(form.value(x, np.array(values))).all():
                continue
        curve = Learned(how="times", at="sensors.lvdt", of="n_r", low=0.0, high=100.0, values=values, form=form.name)
        with pytest.raises(InputError, match="is not finite$"):
            Model(curves={"push": curve}, effects={"push": {}}).plant()
        many += 1
    assert many > 2


class Fmu(PlantFmu):
    """A running FMU that shows ``value`` as its stroke."""

    def __init__(self, value: float):
        self.path, self._outputs, self._out_refs, self._k = "own.fmu", [Joined("x_lvdt", 1, 1.0, 0.0)], [1], 7
        self._read = lambda refs: [value]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_plant_of_others_that_shows_no_number_is_refused(value: float) -> None:
    assert Fmu(0.02).outputs() == {"x_lvdt": 0.02}
    with pytest.raises(InputError, match=r"^--plant own.fmu: x_lvdt \(=(nan|inf)\) at t = 0.007 s must be finite$"):
        Fmu(value).outputs()
