"""Laws that nobody listed: curves inside the simulation against other integrators, quantities, formulas, the law file,
and the command from logs to a law that another log confirms.
"""

from __future__ import annotations

import json
import math
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from benchmarks.blind import as_curve
from plant import Model, load_model, write_model
from plant.model import Learned
from tests.browser import open_to_all
from vaneloop import InputError, Record, System, unknown
from vaneloop.base.curve import POINTS, on_table
from vaneloop.base.forms import FORMS
from vaneloop.base.tables import read
from vaneloop.cli.main import main
from vaneloop.identification import StageError
from vaneloop.identification.candidates.closed_forms import begin, text_of
from vaneloop.identification.candidates.spline_basis import basis_of
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.settings import NEGATIVE_STOPS
from vaneloop.identification.subsystem import Effect, Parameter, Stage
from vaneloop.identification.unmodelled.closed_form_fits import fitted_formulas, goes_on
from vaneloop.identification.unmodelled.curve_candidates import UserModelCandidates, candidates, on_logs, with_curves
from vaneloop.identification.unmodelled.curve_choice import harmless
from vaneloop.identification.unmodelled.fitted_candidate import (
    FittedCandidate,
    held_out,
    left_by_its_mean,
    one_constant,
    surely_more,
    told_by_others,
)
from vaneloop.identification.unmodelled.screening import best_step, starts_of
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.by_log import bind
from vaneloop.identification.user_models.exogenous_regressors import (
    column_of,
    lagged,
    lagged_name,
    named_lag,
    of_stops,
    share_given_back,
)
from vaneloop.identification.user_models.injection_points import from_file
from vaneloop.verbs.learn import learn
from vaneloop.verbs.search import diagnose

OIL = np.linspace(20.0, 60.0, 5)


def tank(x, u, p):
    return p.inflow * u.pump - p.outflow * x.level


TANK = System(
    "tank", "simulate", tank, inputs={"pump": "V", "oil": "degC"}, states={"level": "cm"}, outputs={"level": "cm"},
    parameters=[unknown("inflow", 0.2, "cm/(V s)", low=0.0), unknown("outflow", 0.05, "1/s", low=0.0)],
    start={"level": 20.0}, between="line",
)  # fmt: skip


def run_of_a_tank(n: int = 400) -> Record:
    t = np.arange(float(n))
    rng = np.random.default_rng(0)
    pump = 4.0 + 2.0 * np.sin(t / 30.0) + np.sin(t / 7.0)
    oil = 40.0 + 20.0 * np.sin(t / 50.0)
    level = 20.0 + np.cumsum(rng.standard_normal(n)) * 0.05
    return Record("run", t, {"pump": pump, "oil": oil, "level": level})


@pytest.fixture(scope="module")
def bound():
    return BoundSystem(TANK, [run_of_a_tank()])


def bent(how: str, at: str, q: str):
    """A smooth curve of some size, as the candidate of that place and quantity has it."""
    size = {"parameter times": 0.3, "input adds": 0.5, "state adds": 0.1, "output adds": 0.4}.get(how, 0.2)
    return lambda z: size * np.sin(z / {"oil": 12.0, "level": 4.0, "pump": 1.5, "time": 90.0}[q])


@pytest.mark.parametrize(
    ("how", "at", "q"),
    [
        ("parameter times", "outflow", "oil"), ("parameter times", "inflow", "level"), ("input adds", "pump", "pump"),
        ("input times", "pump", "level"), ("state adds", "level", "level"), ("state adds", "level", "time"),
        ("output adds", "level_sensor", "level"), ("output times", "level_sensor", "oil"),
    ],
)  # fmt: skip
def test_a_curve_does_what_its_place_says(bound, how: str, at: str, q: str) -> None:
    """Against scipy's integrator of the equations with the curve written out."""
    values = bound.stage.neutral()[:2]
    c = next(c for c in candidates(bound, values) if (c.how, c.at, c.quantity.name) == (how, at, q))
    curve = bent(how, at, q)
    table = curve(c.grid)
    placed = c.placed_as(lambda n: n[0] * table, 1)
    effect = c.effect(1.0)
    one = type(effect)(c.name, effect.parameters[:1], ((1.0,),))
    w = with_curves(bound, (), [(placed, one)])
    w.runner.steps = 8
    inflow, outflow = 0.2, 0.05
    ours = w.run(np.array([[inflow, outflow, 1.0]]))[0, 0]
    r = bound.data.records[0]

    def of(z: float) -> float:
        return float(curve(np.clip(z, c.grid[0], c.grid[-1])))

    def drive(t: float, x: float) -> dict[str, float]:
        held = r.t[min(int(t + 1e-12), len(r.t) - 1)]  # a column holds from sample to sample
        return {"pump": np.interp(t, r.t, r.columns["pump"]), "oil": np.interp(t, r.t, r.columns["oil"]),
                "level": x, "time": held}  # fmt: skip

    def rate(t: float, x: np.ndarray) -> list[float]:
        d = drive(t, x[0])
        y, pump, a, b = of(d[q]), d["pump"], inflow, outflow
        a *= 1.0 + y if at == "inflow" else 1.0
        b *= 1.0 + y if at == "outflow" else 1.0
        pump = pump + y if how == "input adds" else pump * (1.0 + y) if how == "input times" else pump
        return [a * pump - b * x[0] - (y if how == "state adds" else 0.0)]

    theirs = [20.0]
    for k in range(len(r.t) - 1):
        s = solve_ivp(rate, (r.t[k], r.t[k + 1] - 1e-9), [theirs[-1]], rtol=1e-8, atol=1e-9)
        theirs.append(float(s.y[0, -1]))
    x = np.array(theirs)
    y = np.array([of(drive(t, z)[q]) for t, z in zip(r.t, x, strict=True)])
    shown = x + y if how == "output adds" else x * (1.0 + y) if how == "output times" else x
    plain = bound.run(np.array([[inflow, outflow, *bound.stage.neutral()[2:]]]))[0, 0]
    assert np.sqrt(np.mean((shown - plain) ** 2)) > 0.05  # it does something
    assert np.max(np.abs(ours - shown)) < 4e-3


def test_a_curve_of_nothing_changes_not_a_bit(bound) -> None:
    c = candidates(bound, bound.stage.neutral()[:2])[0]
    w = with_curves(bound, (), [(c.placed(), c.effect(1.0))])
    theta = w.stage.neutral()
    assert np.array_equal(w.run(theta[None]), bound.run(bound.stage.neutral()[None]))


@given(st.floats(-5.0, 5.0), st.integers(0, 50))
def test_a_table_is_straight_between_points_and_stays_beyond_its_ends(x: float, seed: int) -> None:
    table = np.random.default_rng(seed).standard_normal(9)
    assert on_table(x, -2.0, 3.0, table) == pytest.approx(np.interp(x, np.linspace(-2.0, 3.0, 9), table), abs=1e-12)


def test_what_follows_from_reversals_of_a_triangle() -> None:
    t = np.arange(4000) * 0.01  # up and down with 1/s, turning each 5 s
    y = 2.5 - np.abs(t % 10.0 - 5.0)
    r = Record("r", t, {"y": y})
    way, far, since = (
        column_of(r, t, f"{n}_of_y") for n in ("direction", "distance_since_reversal", "time_since_reversal")
    )
    inside = (t > 6.0) & (np.abs(t % 5.0 - 2.5) < 2.2)  # away from the turns, which a filter rounds
    assert np.array_equal(way[inside], np.where(t[inside] % 10.0 < 5.0, 1.0, -1.0))
    assert np.allclose(far[inside], t[inside] % 5.0, atol=0.1)
    assert np.allclose(since[inside], t[inside] % 5.0, atol=0.1)
    assert np.array_equal(column_of(r, t + 7.0, "time"), t + 7.0)


NUMBERS = {
    "power": (0.3, 1.7), "exponential": (0.2, 0.9), "tanh": (2.0, 1.1), "quotient": (0.5, 0.8), "above": (1.5, 0.4),
    "below": (1.5, 0.4), "step": (1.0, 0.3), "gentle step": (2.0, 0.5, 0.4), "dead zone": (1.2, 0.5),
    "straight line": (0.7, 0.4),
    "limit": (0.7, 1.1), "limit to one side": (0.7, 1.1), "Arrhenius": (0.8, 3000.0), "sine": (0.6, 2.2, 0.4),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS, ids=lambda f: f.name)
def test_a_formula_is_found_in_its_own_values(form) -> None:
    q = np.linspace(0.2, 3.0, 257) if form.positive else np.linspace(-2.0, 3.0, 257)
    if form.name == "Arrhenius":
        q = np.linspace(-10.0, 90.0, 257)
    numbers = np.array(NUMBERS.get(form.name, (0.7,)))
    y = form.value(q, numbers)
    got = begin(form, q, y, free=())
    assert got is not None
    assert got[1] < (0.05 if form.name == "step" else 1e-3)
    if form.name not in ("step", "sine"):  # anywhere between two points; several phases are one
        assert np.allclose(got[0], numbers, rtol=0.02, atol=0.01)
    code = form.code.format(**{name: repr(float(v)) for name, v in zip(form.numbers, numbers, strict=True)})
    assert [eval(code, {"math": math, "q": float(v)}) for v in q] == pytest.approx(y.tolist(), abs=1e-9)
    assert "a" not in text_of(form, numbers, "Q").replace("tanh", "").replace("max", "")
    if form.name not in ("constant", "straight line"):  # a parameter that is fitted takes a constant off
        shifted = begin(form, q, y + 5.0, free=(0,))
        assert shifted is not None
        assert shifted[1] < (0.05 if form.name == "step" else 1e-3)


def test_what_is_left_out_is_what_a_refit_leaves() -> None:
    """Held-out errors of a linear model with a prior, against fits with one block left out each."""
    rng = np.random.default_rng(1)
    blocks, n, k = 8, 30, 4
    a = rng.standard_normal((blocks, n, k))
    y = a @ np.array([1.0, -2.0, 0.5, 0.0]) + 0.3 * rng.standard_normal((blocks, n))
    prior = np.array([2.0, 0.5, 3.0, 40.0])
    normals, pulls = np.einsum("bni,bnj->bij", a, a), np.einsum("bni,bn->bi", a, y)
    theta = np.linalg.solve(normals.sum(axis=0) + np.diag(prior), pulls.sum(axis=0))
    e = y - a @ theta
    cost, gradients = np.sum(e * e, axis=1), np.einsum("bni,bn->bi", a, e)
    mine = np.ones(k, dtype=bool)
    held = held_out(cost, gradients, normals, mine, prior, theta)
    for b in range(blocks):
        rest = np.arange(blocks) != b
        without = np.linalg.solve(normals[rest].sum(axis=0) + np.diag(prior), pulls[rest].sum(axis=0))
        assert held[b] == pytest.approx(np.sum((y[b] - a[b] @ without) ** 2), rel=1e-6)
    some = np.random.default_rng(1).random(y.shape) < 0.7  # of samples that count
    some_a, some_e = a * some[..., None], e * some
    judged = np.sum(some_e**2, axis=1), np.einsum("bni,bn->bi", some_a, e), np.einsum("bni,bnj->bij", some_a, a)
    held = held_out(cost, gradients, normals, mine, prior, theta, judged)
    for b in range(blocks):
        rest = np.arange(blocks) != b
        without = np.linalg.solve(normals[rest].sum(axis=0) + np.diag(prior), pulls[rest].sum(axis=0))
        assert held[b] == pytest.approx(np.sum(((y[b] - a[b] @ without) * some[b]) ** 2), rel=1e-6)


def test_where_a_block_alone_has_been_the_others_do_not_tell() -> None:
    start = np.array([0, 3, 6])
    q = np.array([0.0, 1.0, 2.0, -1.0, 1.0, 3.0, 0.0, 5.0, 4.0])
    # the second block alone is below 0, the third alone is above 3
    assert told_by_others(q, start).tolist() == [True, True, True, False, True, True, True, False, False]
    assert told_by_others(q, np.array([0])).all()


def test_more_error_is_sure_where_the_blocks_agree() -> None:
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((400, 24))
    assert sum(surely_more(n) for n in noise) <= 4  # 0.3 % of chances, at both ends less
    assert all(surely_more(n + 2.0) for n in noise[:50]) and not any(surely_more(n - 2.0) for n in noise[:50])
    one = np.zeros(24)
    one[3] = 1e6  # one block says nothing of the others
    assert not surely_more(one) and not surely_more(np.zeros(24))


def test_a_constant_is_one_law_whatever_it_is_called_a_function_of() -> None:
    """A linear stage whose curve is a mean and a line, beside one parameter of its own."""
    rng = np.random.default_rng(4)
    n, x = 600, np.linspace(-1.0, 1.0, 600)
    rows = np.stack([np.sin(9.0 * x), np.ones(n), x], axis=1)

    def tried(at: str, mean: float, slope: float, of: str = "q") -> FittedCandidate:
        y = rows @ np.array([0.3, mean, slope]) + rng.standard_normal(n)
        theta = np.linalg.lstsq(rows, y, rcond=None)[0]
        e = y - rows @ theta
        stage = SimpleNamespace(index=lambda: {"c": slice(1, 3)}, grain=1.0)
        wide = np.full(3, np.inf)
        judge = SimpleNamespace(stage=stage, scale=np.array([2.0, 1.0, 0.5]), n=n, bounds=lambda: (-wide, wide))
        j = rows * judge.scale
        fit = SimpleNamespace(
            free=np.arange(3), theta=theta, prior=np.zeros(3), cost=np.array([e @ e]), gradients=(j.T @ e)[None],
            normals=(j.T @ j)[None],
        )  # fmt: skip
        quantity = SimpleNamespace(name=of, period=0.0, remembers="lagged" in of, less=None)
        c = SimpleNamespace(how="adds", at=at, name="c", kept=[0, 1], quantity=quantity, near=False)
        one = cast(FittedCandidate, SimpleNamespace(candidate=c, fit=fit, judge=judge))
        only = np.linalg.lstsq(rows[:, :2], y, rcond=None)[0]
        assert left_by_its_mean(one) == pytest.approx(np.sum((y - rows[:, :2] @ only) ** 2))
        held = np.array([theta[0], np.inf, np.inf])  # at its bound, the model's own parameter takes over nothing
        judge.bounds = lambda: (held * [1.0, -1.0, -1.0], held)
        alone = y - rows[:, 0] * theta[0]
        assert left_by_its_mean(one) == pytest.approx(np.sum((alone - alone.mean()) ** 2))
        return one

    flat, again, elsewhere, bent = (
        tried("a", 9.0, 0.0),
        tried("a", 9.0, 0.5),
        tried("b", 9.0, 0.0),
        tried("a", 9.0, 6.0),
    )
    assert one_constant([bent, flat, again, elsewhere]) == [bent, flat, elsewhere]
    assert one_constant([again, flat, bent]) == [again, bent]
    late = tried("a", 9.0, 0.0, "q_lagged_by_3_s")
    assert one_constant([late, bent, flat, again]) == [flat, bent]  # the plainest: all of a log may tell more


@given(st.floats(0.2, 30.0), st.sampled_from([-1.0, 1.0]))
def test_what_a_bound_stops_the_curve_takes_over(size: float, sign: float) -> None:
    """A line is missing; a slope of the model's own, known to 0.1, has gone to its bound to imitate it."""
    t = np.linspace(0.0, 10.0, 400)
    shapes = np.stack([np.sin(t), t / 10.0, t / 10.0 + 0.3 * np.cos(2.0 * t)])
    own = (Parameter("swing", 1.0, "", tolerance=0.1), Parameter("slope", 0.5, "", tolerance=0.1))
    curve = Effect("curve", (Parameter("line", 0.0, "", scale=1.0, tolerance=100.0),), ((0.3,),))
    measured = np.array([1.02, 0.46, sign * size]) @ shapes + 0.01 * np.random.default_rng(0).standard_normal(len(t))

    def judge(effects: tuple[Effect, ...]) -> LeastSquaresProblem:
        rows = shapes[: 2 + len(effects)]
        stage = Stage("s", ("y",), ("",), own, effects, lambda p: (p @ rows)[:, None], t, measured[None])
        return LeastSquaresProblem(stage, np.array([0.01]))

    before = judge(())
    fit = before.fit((), before.stage.neutral())
    starts = starts_of(before, fit)
    low, high = before.bounds()
    at_bound = bool(np.any(np.minimum(fit.theta - low, high - fit.theta) <= 1e-7))
    assert len(starts) == 1 + at_bound
    left, theta, _ = min((best_step(fit, curve, judge((curve,)), *s) for s in starts), key=lambda s: s[0])
    assert np.all(np.abs(theta[:2] - (1.0, 0.5)) <= 0.1 + 1e-12)
    assert left - len(t) < 0.01 * float(np.sum(before.errors(fit.theta[None]) ** 2))


# ---- the law file ----------------------------------------------------------------------------------------------------

NAME = "outflow.gain_of_oil"
BASIS = basis_of(run_of_a_tank().columns["oil"])
assert BASIS is not None
LAW = Learned(
    how="parameter times", at="outflow", of="oil", low=BASIS.low, high=BASIS.high, knots=BASIS.knots.tolist(),
    values=(0.01 * np.arange(len(BASIS.turn))).tolist(), unit="-", size=0.5,
)  # fmt: skip


def test_a_law_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    model = Model(meta={"system": "tank"}, effects={NAME: {"c1": 0.5}}, curves={NAME: LAW})
    write_model(tmp_path / "law.toml", model)
    assert read(tmp_path / "law.toml", Model) == model
    with pytest.raises(InputError, match="system 'tank'"):
        load_model(tmp_path / "law.toml")
    write_model(tmp_path / "law.toml", model.model_copy(update={"meta": {}}))
    with pytest.raises(InputError, match="at, how .*'outflow'.*is unknown"):
        load_model(tmp_path / "law.toml")


def test_a_law_from_a_file_does_what_the_curve_does(bound) -> None:
    c = next(c for c in candidates(bound, bound.stage.neutral()[:2]) if c.name == NAME)
    placed, effect = from_file(NAME, LAW, bound.data)
    theirs = with_curves(bound, (), [(c.placed_as(c.basis.design(c.grid).__matmul__, len(LAW.values)), effect)])
    theta = np.concatenate([[0.2, 0.05], LAW.values])
    ours = with_curves(bound, (), [(placed, effect)]).run(theta[None])[0, 0]
    assert np.allclose(ours, theirs.run(theta[None])[0, 0], rtol=1e-9)
    form = Learned(how="state adds", at="level", of="level", low=0.0, high=50.0, form="root", values=[0.1])
    more = with_curves(bound, (), [from_file("p.q", form, bound.data)]).run(np.array([[0.2, 0.05, 0.1]]))[0, 0]
    assert np.all(more[5:] < with_curves(bound, (), ()).run(np.array([[0.2, 0.05]]))[0, 0, 5:])  # an outflow more


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"how": "adds"}, "how .='adds'.*allowed: parameter times"),
        ({"at": "inflw"}, "at .='inflw'.*allowed: inflow, outflow"),
        ({"of": "speed"}, "of .='speed'.*allowed: level, pump, oil, time"),
        ({"low": 70.0, "high": 60.0}, "low .=70. must be below high"),
        ({"knots": [0.0, 1.0]}, "knots .2 of them. must rise"),
        ({"form": "cosine"}, "form .='cosine'.*must be one of constant"),
    ],
)
def test_a_wrong_law_gets_one_line(bound, change: dict[str, object], said: str) -> None:
    with pytest.raises(StageError, match=said) as e:
        from_file(NAME, LAW.model_copy(update=change), bound.data)
    assert "\n" not in str(e.value)


# ---- from logs to a law ----------------------------------------------------------------------------------------------


def logs_of_a_tank(folder: Path) -> None:
    """Two logs of a tank whose outflow grows with the warmth of the oil; nobody listed that."""
    rng = np.random.default_rng(3)
    for name in ("cold.csv", "warm.csv"):
        t = np.arange(0.0, 1500.0, 1.0)
        pump = np.repeat(rng.uniform(0.0, 8.0, 30), 50)
        oil = 40.0 + 25.0 * np.sin(2.0 * np.pi * t / 1100.0 + rng.uniform(0.0, 6.0))
        level, rows = 20.0, []
        for k in range(len(t)):
            rows.append((t[k], pump[k], oil[k], level + 0.05 * rng.standard_normal()))
            for _ in range(10):
                level += 0.1 * (0.2 * pump[k] - true_outflow(oil[k]) * level)
        np.savetxt(folder / name, rows, delimiter=",", header="t,pump,oil,level", comments="", fmt="%.5f")
    (folder / "tank.py").write_text(
        "from vaneloop import System, unknown\n\n\n"
        "def f(x, u, p):\n    return p.inflow * u.pump - p.outflow * x.level\n\n\n"
        'system = System("tank", "simulate", f, inputs={"pump": "V", "oil": "degC"}, states={"level": "cm"},\n'
        '    outputs={"level": "cm"}, parameters=[unknown("inflow", 0.1, "cm/(V s)", low=0.0),\n'
        '    unknown("outflow", 0.01, "1/s", low=0.0)])\n'
    )


def true_outflow(oil: np.ndarray) -> np.ndarray:
    return 0.02 + 0.05 / (1.0 + np.exp(-(oil - 35.0) / 6.0))


def vaneloop(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "vaneloop", *words], cwd=folder, capture_output=True, text=True, timeout=600, check=False
    )


@pytest.mark.slow
def test_the_command_learns_the_law_and_another_log_confirms_it(tmp_path: Path) -> None:
    logs_of_a_tank(tmp_path)
    own = ("--system", "tank.py")
    done = vaneloop(tmp_path, "learn", "cold.csv", *own, "--out", "law.toml", "--json", "a.json", "--report", "a.html")
    assert done.returncode == 1, done.stderr
    answer = json.loads((tmp_path / "a.json").read_text())
    assert answer["verdict"] == "learned"
    (law,) = answer["laws"]
    assert (law["at"], law["of"], law["how"]) == ("outflow", "oil", "parameter times")
    x, y, low, high = (np.array(law[k]) for k in ("x", "y", "low", "high"))
    truth = true_outflow(x) / true_outflow(x[16]) * (1.0 + y[16])  # the outflow itself is fitted, so its size is free
    assert np.max(np.abs(1.0 + y - truth)) < 0.03
    assert np.all(low <= y) and np.all(y <= high)
    assert law["formulas"][0]["form"] == "gentle step"
    assert abs(law["formulas"][0]["numbers"]["b"] - 35.0) < 0.5
    assert "outflow.gain_of_oil" in (tmp_path / "a.html").read_text()
    done = vaneloop(tmp_path, "extend", "warm.csv", *own, "--effect", "law.toml", "--out", "m.toml", "--json", "b.json")
    assert done.returncode in (0, 1), done.stderr
    before, after = json.loads((tmp_path / "b.json").read_text())["waterfall"]["tank"]
    assert before["noise_floors"] > 50.0
    assert after["noise_floors"] < 2.0
    done = vaneloop(tmp_path, "compare", "warm.csv", *own, "--model", "law.toml", "--json", "c.json")
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "c.json").read_text())["signals"][0]["rms"] < 0.075  # its noise is 0.05
    open_to_all(tmp_path / "a.html", "learn")


OWN = ("--system", "tank.py")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("learn", "cold.csv"), "cold.csv: no channel"),
        (("learn", "cold.csv", "--system", "tank.py", "--out", "no/law.toml"), "cannot write no/law.toml: No such"),
        (("extend", "cold.csv", *OWN, "--effect", "plain.toml", "--out", "m.toml"), "has no table curves"),
    ],
)  # fmt: skip
def test_bad_input_gets_one_line(
    tmp_path: Path,
    words: tuple[str, ...],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    logs_of_a_tank(tmp_path)
    write_model(tmp_path / "plain.toml", Model(meta={"system": "tank"}))
    monkeypatch.chdir(tmp_path)
    assert main([*words]) == 2
    told = capsys.readouterr().err
    assert said in told and len(told.strip().splitlines()) == 1


def test_a_judge_of_a_curve_counts_its_amplitudes_as_effects(bound) -> None:
    c = candidates(bound, bound.stage.neutral()[:2])[0]
    w = with_curves(bound, (), [(c.placed(), c.effect(1.0))])
    judge = LeastSquaresProblem(w.thinned, bound.floor)
    assert len(judge.columns((c.name,))) == len(judge.columns(())) + len(c.effect(1.0).parameters)


@pytest.mark.slow
def test_a_slope_that_parameters_take_is_left_to_them_and_the_formula_is_found(tmp_path: Path) -> None:
    """A limit of a signal whose gain and offset are fitted; the library is not given the limit."""
    rng = np.random.default_rng(3)
    records = []
    for k in range(3):
        t = np.arange(1200) * 0.1
        u = 5.0 * np.sin(t / (3.0 + k)) + 1.5 * np.sin(t / 0.9)
        y = 2.0 * np.minimum(u, 3.0) + 0.7 + 0.02 * rng.standard_normal(len(t))
        records.append(Record(f"log {k}", t, {"u": u, "y": y}))
    limited = System(
        "limited", "static", lambda u, p: p.gain * u.u + p.offset, inputs={"u": "V"}, outputs={"y": "V"},
        parameters=[unknown("gain", 1.0, "-"), unknown("offset", 0.0, "V")], places=["u"],
    )  # fmt: skip
    without = ["u.saturation", "u.smooth_saturation", "u.dead_zone"]  # which is a limit, with a bias
    said = learn(records[:2], limited, test=records[2:], without=without)
    law = said.laws[0]
    assert law.name == "u.curve_of_u" and law.error_after < 1.2
    assert law.untold == (0, 1)  # the gain takes the slope, the offset the mean
    right = [f for f in law.formulas if f.form == "above" and f.numbers["b"] == pytest.approx(3.0, abs=0.05)]
    assert right, [f.text for f in law.formulas]
    truth = as_curve(law, lambda u: np.minimum(u, 3.0) - u, ("above",))
    assert truth == {"inside": pytest.approx(1.0, abs=0.1), "formula": True}
    held_to = said.write_python(tmp_path / "limit.py", limited)
    space = runpy.run_path(str(held_to))
    space["test_curve"](), space["test_law"]()
    assert [space["curve"](u) for u in (-2.0, 2.9, 5.0)] == pytest.approx([0.0, 0.0, -2.0], abs=0.08)
    with_law = replace(limited, laws=[space["LAW"]])
    named = diagnose(records[:2], with_law, test=records[2:], without=without)
    assert named.effects == [law.name]
    with pytest.raises(InputError, match=r"'u\.satration': not a law that system 'limited' can have"):
        learn(records[:1], limited, without=["u.satration"])


@pytest.mark.slow
@pytest.mark.parametrize("law", ["force.coulomb", "force.stribeck", "force.spring"])
def test_a_law_is_searched_for_without_another_that_it_holds(law: str) -> None:
    """Each effect that says what it holds within it names one that is there; friction without its plain law is found
    by another.
    """
    axis = System(
        "axis", "force", lambda u, p: p.mass * u.acceleration, position="x", outputs={"force": "N"},
        parameters=[unknown("mass", 1.0, "kg")], without=[law],
    )  # fmt: skip
    t = np.arange(0.0, 20.0, 0.01)
    x = np.sin(2.0 * t) + 0.3 * np.sin(5.1 * t)
    speed = np.gradient(x, t)
    force = (
        3.0 * np.gradient(speed, t)
        + 4.0 * np.tanh(speed / 0.05)
        + 0.1 * np.random.default_rng(0).standard_normal(len(t))
    )
    record = Record("there and back", t, {"x": x, "force": force})
    there = {e.name: e for e in BoundSystem(axis, [record]).effects}
    assert law not in there
    assert all(held in there for e in there.values() for held, _ in e.holds)
    assert law not in diagnose([record], axis).diagnosis.stages[0].final.effects


# ---- what remembers --------------------------------------------------------------------------------------------------


def stops_written_out(q: np.ndarray, radii: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """A sum of elastic-plastic elements, each by its own rule."""
    out, at = np.zeros(len(q)), np.zeros(len(radii))
    for k in range(1, len(q)):
        at = np.clip(at + q[k] - q[k - 1], -radii, radii)
        out[k] = weights @ at
    return out


@pytest.mark.parametrize("seed", range(4))
def test_a_hysteresis_is_known_by_its_virgin_curve(seed: int) -> None:
    """A sum of stops from the curve alone, against the stops themselves; Masing's rule: a turn doubles the curve."""
    rng = np.random.default_rng(seed)
    reach = 10.0 ** rng.uniform(-6, 6)
    radii, weights = reach * rng.uniform(0.05, 1.0, 5), rng.uniform(0.1, 3.0, 5) / reach
    grid = np.linspace(0.0, reach, POINTS)
    virgin = (weights * np.minimum(grid[:, None], radii)).sum(axis=1)
    q = reach * np.interp(np.arange(800), np.arange(0, 800, 40), np.append(0.0, rng.uniform(-1.0, 1.0, 19)))
    ours, theirs = of_stops(q, 0.0, reach, virgin), stops_written_out(q, radii, weights)
    assert np.max(np.abs(ours - theirs)) < 0.02 * np.ptp(theirs)
    assert share_given_back(0.0, reach, virgin) <= NEGATIVE_STOPS >= share_given_back(0.0, reach, -virgin)
    assert share_given_back(0.0, reach, reach * np.sin(9.0 * grid / reach)) > NEGATIVE_STOPS
    way = np.linspace(0.0, reach, 101)
    back = of_stops(np.concatenate([way, way[::-1]]), 0.0, reach, virgin)
    fall = back[100] - back[101:]
    assert fall == pytest.approx(2.0 * np.interp(0.5 * (way[100] - way[::-1]), grid, virgin), abs=0.02 * virgin[-1])


@pytest.mark.parametrize("tau", [0.02, 0.7, 40.0])
def test_a_lag_is_one_of_first_order(tau: float) -> None:
    """Against scipy's integrator, at uneven samples."""
    rng = np.random.default_rng(5)
    t = np.cumsum(rng.uniform(0.01, 0.3, 200))
    q = rng.standard_normal(200).cumsum()
    theirs = [q[0]]
    for k in range(1, len(t)):
        step = solve_ivp(
            lambda at, y: (np.interp(at, t, q) - y) / tau, t[k - 1 : k + 1], theirs[-1:], method="LSODA", rtol=1e-9,
            atol=1e-9,
        )  # fmt: skip
        theirs.append(float(step.y[0, -1]))
    assert lagged(t, q, tau) == pytest.approx(np.array(theirs), abs=1e-5 * np.ptp(q))


@given(st.floats(1e-6, 1e6))
def test_the_name_of_a_lag_says_how_long(tau: float) -> None:
    name, said = named_lag(lagged_name("pump_lagged", tau)) or ("", 0.0)
    assert name == "pump_lagged"
    assert said == pytest.approx(max(tau, 1e-9), rel=6e-3)


VALVE = System(
    name="sticky_valve", kind="static", model=lambda u, p: p.gain * u.current, inputs={"current": "mA"},
    outputs={"flow": "l/min"}, parameters=[unknown("gain", 1.0, "l/(min mA)")],
)  # fmt: skip
STOPS_OF_VALVE = np.array([0.5, 1.0, 2.0, 4.0]), np.array([-0.4, -0.3, -0.3, -0.2])


def run_of_a_valve(seed: int, name: str, ways: np.ndarray | None = None) -> Record:
    """A valve that follows its current late, going there and back by ``ways`` (default: of all sizes)."""
    rng = np.random.default_rng(seed)
    ways = np.append(0.0, rng.uniform(-10.0, 10.0, 41)) if ways is None else ways
    t = np.arange(0.0, 200.0, 0.05)
    current = np.interp(t, np.linspace(0.0, 200.0, len(ways)), ways)
    flow = 3.0 * current + stops_written_out(current, *STOPS_OF_VALVE)
    return Record(name, t, {"current": current, "flow": flow + 0.05 * rng.standard_normal(len(t))})


@pytest.mark.slow
def test_a_hysteresis_is_learned_and_helps_another_log(tmp_path: Path) -> None:
    answer = learn([run_of_a_valve(1, "one")], VALVE)
    (law,) = answer.laws
    assert (law.at, law.of) == ("flow", "stops_of_current")
    radii, weights = STOPS_OF_VALVE
    truth = (weights * np.minimum(law.x[:, None], radii)).sum(axis=1)
    line = law.x * float(law.x @ (truth - law.y) / (law.x @ law.x)) if 1 in law.untold else 0.0
    assert law.y + line == pytest.approx(truth, abs=0.15)
    assert "hysteresis of current" in law.sentence()
    answer.write(tmp_path / "law.toml")
    model = read(tmp_path / "law.toml", Model)
    other = run_of_a_valve(2, "other")

    def left(m: Model) -> float:
        bound = BoundSystem(VALVE, [other], values=m.parameters, present=m.effects, curves=m.curves)
        return float(np.std(bound.measured[0] - bound.run(bound.stage.neutral()[None])[0, 0]))

    before, after = left(Model(parameters=model.parameters)), left(model)
    assert before > 0.5 and after < 0.06


@pytest.mark.slow
def test_a_hysteresis_that_one_amplitude_shows_is_not_learned() -> None:
    """Every way there and back is as long as the others: what imitates one imitates all."""
    answer = learn([run_of_a_valve(1, "one", np.append(0.0, np.tile([6.0, -6.0], 20)))], VALVE)
    assert not any(law.of.startswith("stops_of") for law in answer.laws)
    if answer.outcome.verdict != "learned":
        assert any("neither another log nor another amplitude" in n for n in answer.outcome.notes)


def bent_valve() -> Record:
    """A valve whose flow is 3 i + 4 tanh(i / 2)."""
    r = run_of_a_valve(1, "bent")
    t, i = r.t[::4], r.columns["current"][::4]
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(i))
    return Record("bent", t, {"current": i, "flow": 3.0 * i + 4.0 * np.tanh(i / 2.0) + noise})


@pytest.mark.parametrize("shape", [("odd",), ("zero",), ("rising", "zero"), ("rising",), ("falling",)])
def test_a_curve_has_the_shape_that_is_known(shape: tuple[str, ...]) -> None:
    """Whatever its amplitudes, within their bounds; and a time that begins at 0 has no odd curve."""
    bound = BoundSystem(VALVE, [bent_valve()])
    shaped = [s for c in candidates(bound, bound.stage.neutral()[:1]) if (s := c.shaped(shape)) is not None]
    shaped = [c for c in shaped if not c.quantity.stops]
    assert any(c.quantity.name == "current" for c in shaped)
    assert any(c.quantity.name == "time" for c in shaped) == ("odd" not in shape)
    rng = np.random.default_rng(3)
    for c in shaped:
        low = np.array([p.low for p in c.effect(1.0).parameters])
        placed = c.placed()
        assert placed.curve is not None
        x, y = c.grid, placed.curve.table(np.maximum(rng.standard_normal(len(low)), low))
        size = float(np.max(np.abs(y)))
        assert size > 0.0
        if "zero" in shape:
            assert np.interp(0.0, x, y) == pytest.approx(0.0, abs=0.01 * size)
        if "odd" in shape:
            assert x[0] == pytest.approx(-x[-1])
            assert y == pytest.approx(-y[::-1], abs=1e-9 * size)
        if up := ("rising" in shape) - ("falling" in shape):
            assert np.min(up * np.diff(y)) >= -1e-9 * size


@pytest.mark.slow
def test_a_curve_that_is_known_to_rise_from_zero_is_learned_so() -> None:
    (law,) = learn([bent_valve()], VALVE, shape=("rising", "zero")).laws
    assert law.error_after < 1.5
    assert np.min(np.diff(law.y)) >= -1e-9
    assert law.formulas[0].form == "tanh"


@pytest.mark.parametrize("shape", [["round"], ["rising", "falling"], ["odd", "rising"]])
def test_a_shape_that_no_curve_has_is_refused(shape: list[str]) -> None:
    with pytest.raises(InputError, match=r"^shape \(="):
        learn([bent_valve()], VALVE, shape=shape)


def test_a_test_log_speaks_of_a_curve_where_its_quantity_has_been() -> None:
    run = run_of_a_tank()
    further = replace(run, name="further", columns={**run.columns, "oil": run.columns["oil"] + 15.0})
    ground = UserModelCandidates(bind(TANK, [run], [further]))
    every = ground.candidates(BoundSystem(TANK, [run]).stage.neutral()[:2])
    assert {c.quantity.name for c in every} >= {"oil", "pump", "level", "time", "direction_of_pump"}
    for c in every:
        if c.quantity.stops:
            assert not ground.within(c)
            continue
        inside = ground.within(c)["further"]
        if c.quantity.name == "oil":
            oil = further.columns["oil"]
            assert np.array_equal(inside, (oil >= c.basis.low) & (oil <= c.basis.high)) and 0.4 < inside.mean() < 0.9
        elif not c.quantity.remembers:
            assert inside.mean() > 0.99, c.name


def test_a_formula_goes_on_while_it_is_not_much_steeper_than_where_logs_have_been() -> None:
    ground = UserModelCandidates(bind(TANK, [run_of_a_tank()]))
    c = next(c for c in ground.candidates(BoundSystem(TANK, [run_of_a_tank()]).stage.neutral()[:2]) if c.name == NAME)
    low, high = c.basis.low, c.basis.high
    span = high - low
    form = {f.name: f for f in FORMS}
    assert goes_on(ground, c, form["line"], np.array([2.0])) == pytest.approx((low - span, high + span))
    assert goes_on(ground, c, form["cube"], np.array([-1.0])) == pytest.approx((low - span, high + span))
    rate = 4.0 / span  # its slope is ten times that at the end of the logs log(10) / rate beyond
    end = goes_on(ground, c, form["exponential"], np.array([1.0, rate]))[1]
    assert end == pytest.approx(high + np.log(10.0) / rate, abs=0.01 * span)
    pole = goes_on(ground, c, form["inverse"], np.array([1.0]))[0]
    assert 0.0 < pole < low and (pole / low) ** 2 == pytest.approx(0.1, abs=0.03)


def test_a_law_that_goes_on_or_jumps_is_what_its_file_says(bound) -> None:
    """A table of a formula is fine enough for three times the range; a jump is one, and not a slope of the table."""
    file = Learned(how="input adds", at="pump", of="oil", low=20.0, high=60.0, form="step", values=[0.5, 41.3])
    told = file.model_copy(update={"reach": [-20.0, 100.0]})
    for law in (file, told):
        placed, _ = from_file("p.q", law, bound.data)
        q = np.array([41.2, 41.299, 41.301, 41.4, 99.0])
        assert placed.curve.at(q, placed.curve.row(np.array(law.values))).tolist() == [0.0, 0.0, 0.5, 0.5, 0.5]
    for wrong in ({"reach": [30.0, 100.0]}, {"reach": [1.0]}, {"form": "", "knots": [0.0] * 6, "reach": [0.0, 100.0]}):
        with pytest.raises(StageError, match="reach|knots"):
            from_file("p.q", told.model_copy(update=wrong), bound.data)


def test_a_reading_at_its_limit_does_not_hide_where_its_curve_bends() -> None:
    """A sensor that ends at 3 reads a flow that goes to 8: its curve is one of the flow."""
    valve = System(
        "valve", "static", lambda u, p: p.gain * u.current, inputs={"current": "mA"}, outputs={"flow": "l/min"},
        parameters=[unknown("gain", 2.0, "-")],
    )  # fmt: skip
    t = np.arange(400.0) * 0.05
    current = 4.0 * np.sin(t)
    bound = BoundSystem(valve, [Record("run", t, {"current": current, "flow": np.minimum(2.0 * current, 3.0)})])
    every = {c.name: c.basis for c in candidates(bound, np.array([2.0]))}
    assert every["flow.curve_of_flow"].high == pytest.approx(8.0, abs=0.1)
    assert every["flow.curve_of_flow"].low == pytest.approx(-8.0, abs=0.1)
    far = {c.name: c.basis for c in candidates(bound, np.array([1e6]))}  # a model that is far off says nothing
    assert far["flow.curve_of_flow"].high < 20.0


@pytest.mark.slow
def test_a_jump_is_the_friction_of_the_library() -> None:
    """Bit for bit inside an integration, also of a law file; and the curve of a speed has it where that turns."""
    cart = System(
        "cart", "simulate", lambda x, u, p: (x.speed, (u.push - p.damping * x.speed) / p.mass), inputs={"push": "N"},
        states={"place": "m", "speed": "m/s"}, outputs={"speed": "m/s"}, rates={"speed": "place"},
        masses={"speed": "mass"}, parameters=[unknown("mass", 4.0, "kg"), unknown("damping", 2.0, "N s/m")],
    )  # fmt: skip
    t = np.arange(400.0) * 0.05
    bound = BoundSystem(cart, [Record("run", t, {"push": 9.0 * np.sin(t), "speed": np.sin(t - 0.8)})])
    named = with_curves(bound, ("speed.coulomb",), ())
    theta = np.append(named.stage.neutral()[:-1], 1.7)
    friction = named.run(theta[None])[0]
    speed = next(c for c in candidates(bound, theta[:-1]) if c.name == "speed.curve_of_speed")
    c = speed.jumping()
    assert c is not None and c.jumping() is None
    placed, effect = c.placed(), c.effect(1.0)
    curve = np.zeros(len(effect.parameters))
    curve[-1] = 1.7
    ours = with_curves(bound, (), [(placed, effect)])
    assert np.allclose(ours.run(np.append(theta[:-1], curve)[None])[0], friction, rtol=1e-12, atol=1e-12)
    low, high = c.basis.low, c.basis.high
    plain = Learned(how="state adds", at="speed", of="speed", low=low, high=high, values=[1.7], form="sign")
    splines = plain.model_copy(
        update={"form": "", "jump": True, "knots": list(c.basis.knots), "values": [*c.coefficients(curve)]}
    )
    for law in (plain, splines):
        read_back = with_curves(bound, (), [from_file(c.name, law, bound.data)])
        assert np.allclose(read_back.run(np.append(theta[:-1], law.values)[None])[0], friction, rtol=1e-9, atol=1e-9)
    assert splines.numbers[-1] == "jump" and np.ptp(splines.table()(np.array(splines.values))) == pytest.approx(3.4)


def hardening(seed: int, size: float) -> Record:
    """A slide that is moved, with a spring that nobody listed: 90 position^3."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 30.0, 0.03)
    way = size * (np.sin(1.1 * t + seed) + 0.4 * np.sin(2.9 * t))
    speed = np.gradient(way, t)
    force = 2.0 * np.gradient(speed, t) + 5.0 * speed + 90.0 * way**3
    return Record(f"slide {seed}", t, {"way": way, "force": force + 0.05 * rng.standard_normal(len(t))})


@pytest.mark.slow
def test_a_formula_that_does_as_well_as_its_curve_is_the_law(tmp_path: Path) -> None:
    """And holds on a log that goes further, where the curve is off."""
    system = System(
        "slide", "force", lambda u, p: p.mass * u.acceleration + p.viscous * u.velocity, position="way",
        outputs={"force": "N"}, without=["force.cubic_spring", "force.spring", "force.elastic_plastic"],
        parameters=[unknown("mass", 1.0, "kg", low=0.0), unknown("viscous", 3.0, "N s/m", low=0.0)],
    )  # fmt: skip
    logs, test = [hardening(1, 0.3)], [hardening(3, 0.5)]
    said = learn(logs, system, test=test)
    (law,), (curve,) = said.laws, said.outcome.tried
    assert law.name == "force.curve_of_position" and "near" not in law.sentence()
    assert law.spoken.form == "cube" and law.spoken.numbers["a"] == pytest.approx(90.0, rel=0.01)
    (left,) = said.by_log.tested().values()
    worse = on_logs(said.by_log.logs, curve.curves).figures(curve.fit.theta)["slide 3"]
    assert left < 2.0 and worse[0] > 10.0 * left * curve.judge.floor[0]
    file = read(said.write(tmp_path / "law.toml"), Model).curves[law.name]
    assert file.form == "cube" and tuple(file.reach) == law.reach
    assert law.reach[0] < -0.7 and law.reach[1] > 0.7  # where the test log has been


def weighed(seed: int, size: float) -> Record:
    """A slide that is moved, on which a constant force acts that nobody listed."""
    run = hardening(seed, size)
    way, force = run.columns["way"], run.columns["force"]
    return Record(run.name, run.t, {"way": way, "force": force - 90.0 * way**3 + 1.3})


@pytest.mark.slow
def test_a_constant_is_said_as_one_and_holds_on_a_log_that_goes_further() -> None:
    """A curve that is nearly one stays at its ends as chance has it: there it harms, and makes way."""
    system = System(
        "slide", "force", lambda u, p: p.mass * u.acceleration + p.viscous * u.velocity, position="way",
        outputs={"force": "N"}, without=["force.force_offset"],
        parameters=[unknown("mass", 1.0, "kg", low=0.0), unknown("viscous", 3.0, "N s/m", low=0.0)],
    )  # fmt: skip
    said = learn([weighed(1, 0.3), weighed(2, 0.25)], system, test=[weighed(3, 0.5)])
    (law,) = said.laws
    assert law.spoken.form == "constant" and law.spoken.numbers["a"] == pytest.approx(1.3, abs=0.01)
    assert law.sentence() == f"a constant is added to the force, {law.spoken.text}"
    assert max(said.by_log.tested().values()) < 1.2  # noise floors


def test_a_force_of_position_or_speed_is_one_at_the_place_itself() -> None:
    t = np.arange(0.0, 20.0, 0.02)
    boom = System(
        "boom", "force", lambda u, p: p.mass * u.acceleration, position="angle", outputs={"torque": "Nm"},
        parameters=[unknown("mass", 2.0, "kg", low=0.0)],
    )  # fmt: skip
    bound = BoundSystem(boom, [Record("run", t, {"angle": np.sin(t), "torque": np.cos(3.0 * t)})])
    near = {c.quantity.name for c in candidates(bound, bound.stage.neutral()[:1]) if c.near}
    assert near == {"position", "velocity"}


def boom(seed: int, size: float) -> Record:
    """A boom that is moved, with a spring that nobody listed: 40 cos(angle) is its weight, 14 angle the spring."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 60.0, 0.02)
    angle = sum(
        size * rng.uniform(0.3, 1.0) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.05, 0.11, 0.23)
    )
    speed = np.gradient(angle, t)
    torque = 2.0 * np.gradient(speed, t) + 40.0 * np.cos(angle) + 5.0 * speed + 14.0 * angle
    return Record(f"boom {seed}", t, {"angle": angle, "torque": torque + 0.01 * rng.standard_normal(len(t))})


@pytest.mark.slow
def test_a_force_is_not_said_as_a_gain_of_a_parameter() -> None:
    """The weight times a function of the angle is any function of the angle: what adds is said first."""

    def model(u, p):
        return p.inertia * u.acceleration + p.weight * np.cos(u.position) + p.viscous * u.velocity

    parameters = [unknown("inertia", 1.0, "t m^2", low=0.0), unknown("weight", 60.0, "kN m")]
    system = System(
        "boom", "force", model, position="angle", units={"position": "rad"}, outputs={"torque": "kN m"},
        parameters=[*parameters, unknown("viscous", 2.0, "kN m s/rad", low=0.0)], cutoff=1.5,
        without=["force.spring", "force.cubic_spring", "force.elastic_plastic", "force.bouc_wen"],
    )  # fmt: skip
    said = learn([boom(1, 0.3)], system, test=[boom(2, 0.4)])
    assert [law.name for law in said.laws] == ["force.curve_of_position"] and said.laws[0].formulas
    slope = np.polyfit(said.laws[0].x, said.laws[0].y, 1)[0]
    assert slope == pytest.approx(14.0, rel=0.05) or 1 in said.laws[0].untold


def test_a_formula_of_a_full_sensor_is_fitted_beyond_what_the_sensor_shows() -> None:
    rng = np.random.default_rng(5)
    t = np.arange(1200.0)
    u = np.sin(t / 9.0) * np.where((t > 500.0) & (t < 560.0), 6.0, 2.0)
    y = np.minimum(2.0 * u, 5.0) + 0.01 * rng.standard_normal(len(t))

    def gauge(u, p):
        return p.gain * u.pressure

    system = System(
        "gauge", "static", gauge, inputs={"pressure": "bar"}, outputs={"reading": "V"},
        parameters=[unknown("gain", 1.0, "V/bar", low=0.0)],
    )  # fmt: skip
    ground = UserModelCandidates(bind(system, [Record("run", t, {"pressure": u, "reading": y})]))
    judge = LeastSquaresProblem(ground.stage((), ()), ground.floor)
    base = judge.fit((), judge.stage.neutral(), 12)
    c = next(c for c in ground.candidates(base.theta) if c.name == "reading.curve_of_reading")
    curves = ((c.placed(), c.effect(1.0)),)
    curved = LeastSquaresProblem(ground.stage((), curves), ground.floor)
    fit = curved.fit((c.name,), np.concatenate([base.theta, np.zeros(len(c.parts))]), 12)
    best, _ = fitted_formulas(ground, FittedCandidate(c, 1.0, curved, fit, curves))[0]
    assert best.form == "above"
    assert best.numbers["a"] == pytest.approx(-1.0, abs=0.02)
    assert best.numbers["b"] == pytest.approx(5.0, abs=0.02)


def test_beside_a_curve_the_slopes_of_unknown_parameters_are_taken_over_small_steps(bound) -> None:
    for before, now in zip(bound.stage.parameters, with_curves(bound, (), ()).stage.parameters, strict=True):
        assert now.tolerance == before.tolerance  # as free as before
        assert now.scale < before.scale / 10.0


def test_what_harms_a_test_log_makes_way_for_what_does_not_and_is_near_it() -> None:
    def named(name: str, *formulas: Any) -> Any:
        return SimpleNamespace(candidate=SimpleNamespace(name=name), loose=list(formulas))

    bad, fine, said = named("bad"), named("fine"), named("said", named("formula"))
    learner: Any = SimpleNamespace(objection=lambda _, t: "" if t.candidate.name in ("fine", "formula") else "worse")
    before: Any = None
    assert harmless(learner, before, [bad, fine, said], {"bad": 0.0, "fine": 0.4, "said": 0.3}) == [fine, said]
    assert harmless(learner, before, [bad, fine], {"bad": 0.0, "fine": 0.6}) == [bad, fine]
