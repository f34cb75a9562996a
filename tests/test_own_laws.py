"""Laws of the user's own: found where they are, whatever they act on, read back from the model file, and refused in one
line where they cannot be.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.test_your_own_model import STRAIGHT, T, line, named, noise, wave
from vaneloop import Law, Parameter, Record, System, unknown
from vaneloop.base.errors import InputError
from vaneloop.cli.main import main
from vaneloop.identification.subsystem import StageError
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.codegen import dispatch_of
from vaneloop.verbs.search import compare, diagnose, extend


def worn(u: Any, t: Any, p: Any) -> Any:
    """A gain that falls with time."""
    return u * math.exp(-p.wear * t)


def creep(u: Any, t: Any, dt: Any, p: Any, m: Any) -> Any:
    """A share of the signal comes late: m[0] follows u."""
    if dt == 0.0:
        m[0] = u
    m[0] += (u - m[0]) * (1.0 - math.exp(-dt / p.after))
    return u + p.share * (m[0] - u)


def magnet(v: Any, x: Any, t: Any, p: Any) -> Any:
    """A force that holds near the middle."""
    return p.force * math.tanh(x / 0.3) * math.exp(-((x / 0.8) ** 2))


def ratchet(v: Any, x: Any, t: Any, dt: Any, p: Any, m: Any) -> Any:
    """A force that grows with the way made: m[0]."""
    m[0] += abs(v) * dt
    return p.growth * m[0] * (1.0 if v > 0.0 else -1.0 if v < 0.0 else 0.0)


def drain(x: Any, t: Any, p: Any) -> Any:
    """A drain that opens above a level of 4."""
    return p.rate * max(x - 4.0, 0.0) ** 1.5


WEAR = Law("worn", "signal", worn, [Parameter("wear", 0.0, "1/s", -1.0, 1.0)], [1e-3, 1e-2, -1e-3], places=["input"])
CREEP = Law(
    "creep", "signal", creep,
    [Parameter("share", 0.0, "-", -1.0, 1.0), Parameter("after", 1.0, "s", 0.1, 20.0, shape=True)],
    [(s, a) for s in (0.1, 0.5, -0.3) for a in (0.5, 4.0)], memory=1,
)  # fmt: skip
MAGNET = Law("magnet", "force", magnet, [Parameter("force", 0.0, "N", -50.0, 50.0)], [0.1, 1.0, -1.0])
RATCHET = Law("ratchet", "force", ratchet, [Parameter("growth", 0.0, "N/m", 0.0, 50.0)], [0.01, 0.1, 1.0], memory=1)
DRAIN = Law("drain", "state", drain, [Parameter("rate", 0.0, "cm^-0.5/s", 0.0, 5.0)], [0.005, 0.05, 0.5])


def map_with(*own: Law, **more: Any) -> System:
    given: dict[str, Any] = {"outputs": {"y": "V"}, "inputs": {"u": "V"}, "parameters": STRAIGHT.parameters} | more
    return System("map", "static", line, laws=own, **given)


# ---- the equations, against others -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_laws_on_signals_follow_their_closed_forms() -> None:
    d = dispatch_of([WEAR, CREEP])
    u = np.full(len(T), 2.0)
    u[0] = 0.0
    np.testing.assert_allclose(d.apply(101, T, u, np.array([0.05, 0.0, 0.0, 0.0])), u * np.exp(-0.05 * T), rtol=1e-12)
    late = d.apply(102, T, u, np.array([1.0, 4.0, 0.0, 0.0]))  # a lag from rest: 2 (1 - exp(-t/T))
    np.testing.assert_allclose(late, 2.0 * (1.0 - np.exp(-T / 4.0)), atol=1e-12)
    # the library's laws are there as ever
    assert list(d.apply(1, T[:2], u[:2], np.array([0.5, 0.0, 0.0, 0.0]))) == [0.5, 2.5]
    # what a sensor without memory reads as 2 at the start
    assert d.argument(101, 2.0, np.array([0.05, 0.0, 0.0, 0.0])) == 2.0


def test_a_force_that_grows_with_the_way_made_does_its_work() -> None:
    d = dispatch_of([RATCHET])
    t = np.linspace(0.0, 3.0, 30_001)
    assert d.forces is not None
    f = d.forces(201, t, np.cos(t), np.sin(t), np.array([2.0, 0.0, 0.0, 0.0]))
    way = np.where(t < np.pi / 2, np.sin(t), 2.0 - np.sin(t))
    np.testing.assert_allclose(f, 2.0 * way * np.sign(np.cos(t)), atol=1e-3)


@pytest.mark.slow
def test_a_simulation_with_a_law_of_ones_own_is_that_of_the_model_that_has_it() -> None:
    t = np.arange(0.0, 20.0, 0.05)
    u = wave(3, t)

    def model(x: Any, u: Any, p: Any) -> Any:
        return x.v, u.force - 0.3 * x.v - 2.0 * x.x

    def whole(x: Any, u: Any, p: Any) -> Any:
        return x.v, u.force - 0.3 * x.v - 2.0 * x.x - 1.5 * math.tanh(x.x / 0.3) * math.exp(-((x.x / 0.8) ** 2))

    given: dict[str, Any] = {
        "inputs": {"force": "N"}, "states": {"x": "m", "v": "m/s"}, "outputs": {"x": "m"}, "rates": {"v": "x"},
        "start": {"x": 0.5}, "between": "line",
    }  # fmt: skip
    record = Record("run", t, {"force": u, "x": u})
    have = BoundSystem(
        System("a", "simulate", model, laws=[MAGNET], **given), [record], present={"v.magnet": {"force": 1.5}}
    )
    want = BoundSystem(System("a", "simulate", whole, **given), [record])
    have.runner.steps = want.runner.steps = 8
    np.testing.assert_allclose(
        have.run(have.stage.neutral()[None]), want.run(want.stage.neutral()[None]), rtol=1e-9, atol=1e-12
    )


# ---- found -----------------------------------------------------------------------------------------------------------


def test_an_own_law_is_found_fitted_kept_in_the_model_file_and_shown(tmp_path: Path) -> None:
    u, v = wave(1), wave(2)
    system = map_with(WEAR, CREEP)

    def record(name: str, u: np.ndarray) -> Record:
        return Record(name, T, {"u": u, "y": 2.0 * u * np.exp(-0.03 * T) + 0.3 + 0.02 * noise()})

    answer = diagnose([record("a", u)], system, test=[record("b", v)])
    assert named(answer) == ["u.worn"]
    wear = answer.diagnosis.stages[0].effects[0].parameters["wear"]
    assert float(str(wear["low"])) < 0.03 < float(str(wear["high"])) and wear["unit"] == "1/s"
    assert "u.worn" in answer.page().html() and answer.to_dict()["effects"][0]["effect"] == "u.worn"
    better = extend([record("a", u)], ["u.worn"], system)
    file = better.write(tmp_path / "better.toml")
    from vaneloop.identification.user_models.by_log import load_model_of

    model = load_model_of(file, system)
    again = diagnose([record("b", v)], system, added=model)
    assert again.verdict == "none"
    assert compare([record("b", v)], system, added=model).located[0].signals[0].rms < 0.025


@pytest.mark.slow
def test_a_law_with_memory_is_found_in_a_sensor() -> None:
    d = dispatch_of([CREEP])
    u = np.sign(wave(5)) + 0.3 * wave(6)
    late = d.apply(101, T, 2.0 * u + 0.3, np.array([0.4, 2.5, 0.0, 0.0]))
    answer = diagnose([Record("a", T, {"u": u, "y": late + 0.02 * noise()})], map_with(CREEP))
    (found,) = answer.diagnosis.stages[0].effects
    assert found.effect.rpartition(".")[2] == "creep"  # at the input or the output: the same
    assert float(str(found.parameters["share"]["value"])) == pytest.approx(0.4, rel=0.1)
    assert float(str(found.parameters["after"]["value"])) == pytest.approx(2.5, rel=0.2)


@pytest.mark.slow
def test_an_own_force_is_found_in_measured_motion() -> None:
    t = np.arange(0.0, 20.0, 0.005)
    w, size = np.array([0.7, 1.9, 3.1, 5.3]), np.array([0.5, 0.3, 0.15, 0.05])
    x, v = np.sin(np.outer(t, w)) @ size, np.cos(np.outer(t, w)) @ (size * w)
    a = -np.sin(np.outer(t, w)) @ (size * w * w)
    f = 2.0 * a + 4.0 * v + 3.0 * np.tanh(x / 0.3) * np.exp(-((x / 0.8) ** 2)) + 0.05 * noise(len(t))
    system = System(
        "axis", "force", lambda u, p: p.mass * u.acceleration + p.viscous * u.velocity, outputs={"force": "N"},
        position="x", laws=[MAGNET, RATCHET],
        parameters=[unknown("mass", 5.0, "kg", low=0.0), unknown("viscous", 10.0, "N s/m", low=0.0)],
    )  # fmt: skip
    answer = diagnose([Record("axis", t, {"x": x, "force": f})], system)
    (found,) = answer.diagnosis.stages[0].effects
    assert found.effect == "force.magnet"
    assert float(str(found.parameters["force"]["value"])) == pytest.approx(3.0, rel=0.05)


@pytest.mark.slow
def test_an_own_law_of_a_state_is_found_in_a_simulation() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 600.0, 1.0)
    pump = np.repeat(rng.uniform(0.0, 8.0, 20), 30)
    level, rows = 2.0, []
    for k in range(len(t)):
        rows.append(level)
        for _ in range(10):
            level += 0.1 * (0.1 * pump[k] - 0.05 * level - 0.02 * max(level - 4.0, 0.0) ** 1.5)
    system = System(
        "tank", "simulate", lambda x, u, p: p.inflow * u.pump - p.outflow * x.level, inputs={"pump": "V"},
        states={"level": "cm"}, outputs={"level": "cm"}, laws=[DRAIN],
        parameters=[unknown("inflow", 0.15, "", low=0.0), unknown("outflow", 0.03, "1/s", low=0.0)],
    )  # fmt: skip
    log = Record("tank", t, {"pump": pump, "level": np.array(rows) + 0.01 * rng.standard_normal(len(t))})
    (found,) = diagnose([log], system).diagnosis.stages[0].effects
    assert found.effect == "level.drain"
    assert float(str(found.parameters["rate"]["value"])) == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(
    ("places", "where"), [(None, {"u.worn", "y.worn"}), (["y"], {"y.worn"}), (["input"], {"u.worn"})]
)
def test_a_law_acts_where_it_may(places: list[str] | None, where: set[str]) -> None:
    law = Law("worn", "signal", worn, WEAR.parameters, WEAR.starts, places=places)
    bound = BoundSystem(map_with(law), [Record("a", T, {"u": wave(1), "y": wave(1)})])
    assert {e.name for e in bound.effects if e.name.endswith("worn")} == where


# ---- what numba cannot compile ---------------------------------------------------------------------------------------

MODEL = """import math
from vaneloop import Law, Parameter, System, unknown


def half(x):
    return 0.5 * x


def derivative(x, u, p):
{model}


def law(u, t, p):
{law}


system = System(name="tank", kind="simulate", model=derivative, inputs={{"pump": "V"}},
    states={{"level": "cm"}}, outputs={{"level": "cm"}},
    parameters=[unknown("inflow", 0.1, "cm/(V s)", low=0.0), unknown("outflow", 0.01, "1/s", low=0.0)],
    laws=[Law("mine", "signal", law, [Parameter("size", 0.0, "-", 0.0, 1.0)], [0.1, 0.5], places=["input"])])
"""
RIGHT = "    return 2.0 * half(p.inflow * u.pump - p.outflow * x.level)"
MINE = "    return u * (1.0 - p.size)"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "law", "note"),
    [
        (RIGHT, MINE, ""),
        (f"    import math\n{RIGHT}", MINE, "numba cannot compile the model (an import inside a function"),
        (f"    from math import sqrt\n{RIGHT}", MINE, "an import inside a function; it belongs at the top of the file"),
        (RIGHT, f"    import math\n{MINE}", "numba cannot compile the model (law 'mine': an import inside a function"),
        (RIGHT, f"    d = dict(a=[1, 'b'])\n{MINE}", "numba cannot compile the model (law 'mine'"),
    ],
)
def test_what_numba_cannot_compile_runs_all_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], model: str, law: str, note: str
) -> None:
    (tmp_path / "m.py").write_text(MODEL.format(model=model, law=law))
    t = np.arange(0.0, 60.0)
    np.savetxt(
        tmp_path / "log.csv", np.column_stack([t, np.sin(t), np.exp(-0.02 * t)]), delimiter=",", header="t,pump,level",
        comments="",
    )  # fmt: skip
    words = ["compare", str(tmp_path / "log.csv"), "--system", str(tmp_path / "m.py")]
    assert main([*words, "--json", str(tmp_path / "c.json")]) == 0
    notes = json.loads((tmp_path / "c.json").read_text())["notes"]
    assert any(note in n for n in notes) if note else not any("numba" in n for n in notes)
    capsys.readouterr()


# ---- what cannot be --------------------------------------------------------------------------------------------------


def two(u: Any, p: Any) -> Any:
    return u


P = Parameter("size", 0.0, "-", -1.0, 1.0)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"name": "coulomb"}, "law 'coulomb': the library has a law of that name (on a force); choose another"),
        ({"name": "my law"}, "law 'my law': its name must be a Python name"),
        ({"on": "input"}, "on (='input') must be one of signal, force, state"),
        ({"function": two}, "a law on a signal with no memory is called with (u, t, p)"),
        ({"memory": 1}, "a law on a signal with memory=1 is called with (u, t, dt, p, m)"),
        ({"memory": -1}, "memory (=-1) must be a whole number in [0, 64]"),
        ({"function": 3.0}, "function (=3.0) must be a function"),
        ({"parameters": []}, "parameters (=[]) must be a list of 1 to 8 Parameter(...)"),
        ({"parameters": [0.0]}, "parameters: 0.0 is not a Parameter"),
        ({"parameters": [Parameter("size", 2.0, "-", -1.0, 1.0)]}, "parameter size (=2 -) must be in [-1, 1]"),
        ({"parameters": [Parameter("size", 0.0, "-", 0.0, 0.0)]}, "parameter size: low (=0) must be below high (=0)"),
        ({"parameters": [P, P]}, "two parameters share a name"),
        ({"starts": []}, "starts is empty"),
        ({"starts": [2.0]}, "starts: size (=2 -) must be in [-1, 1]"),
        ({"starts": [math.nan]}, "starts: size (=nan -) must be in [-1, 1]"),
        ({"starts": [(0.1, 0.2)]}, "starts: (0.1, 0.2) has 2 values; 1 are needed (size)"),
        ({"starts": ["big"]}, "starts: 'big' is not a number"),
        ({"starts": [0.0]}, "starts: 0.0 is neutral, where the law changes nothing"),
        ({"places": "input"}, "places (='input') must be a list of names"),
    ],
)  # fmt: skip
def test_a_law_that_cannot_be_is_refused_in_one_line(given: dict[str, Any], said: str) -> None:
    usual: dict[str, Any] = {"name": "mine", "on": "signal", "function": worn, "parameters": [P], "starts": [0.1]}
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        Law(**(usual | given))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("laws", "said"),
    [
        ([WEAR, WEAR], "laws: two are named 'worn'"),
        ([worn], "is not a Law"),
        (WEAR, "must be a list of Law(...)"),
        ([Law("mine", "signal", worn, WEAR.parameters, WEAR.starts, places=["pomp"])], "places: 'pomp' is not known"),
    ],
)
def test_a_system_with_laws_that_cannot_be_is_refused(laws: Any, said: str) -> None:
    with pytest.raises(StageError, match=re.escape(said)):
        System("map", "static", line, outputs={"y": "V"}, inputs={"u": "V"}, laws=laws)


def lost(u: Any, t: Any, p: Any) -> Any:
    return u * math.log(p.size)


@pytest.mark.parametrize(
    ("function", "parameter", "said"),
    [
        (lambda u, t, p: math.nan if p.size else u, P, "law 'mine' on u: returned nan with size 0.1 at u = "),
        (lambda u, t, p: u + 1.0 + p.size, P, "law 'mine' on u: must change nothing at its neutral sizes (size 0)"),
        (lambda u, t, p: u * p.seize, P, "has no attribute 'seize'"),
        (lambda u, t, p: (u, u), P, "a finite number is needed"),
        (lost, P, "ValueError"),
    ],
)  # fmt: skip
def test_a_law_that_is_wrong_on_the_data_is_refused_in_one_line(function: Any, parameter: Any, said: str) -> None:
    system = map_with(Law("mine", "signal", function, [parameter], [0.1], places=["u"]))
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        compare([Record("a", T, {"u": wave(1), "y": wave(1)})], system)
    assert "\n" not in str(caught.value)


def test_the_command_line_says_so_with_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = MODEL.format(model=RIGHT, law=MINE).replace('"mine"', '"dead_zone"')
    (tmp_path / "m.py").write_text(text)
    assert main(["compare", "log.csv", "--system", str(tmp_path / "m.py")]) == 2
    err = capsys.readouterr().err
    assert "law 'dead_zone': the library has a law of that name (on a signal)" in err and len(err.splitlines()) == 1


# ---- the same as a law of the library, in every kind of model --------------------------------------------------------


def scale(u: Any, t: Any, p: Any) -> Any:
    return u * p.factor


def brake(v: Any, x: Any, t: Any, p: Any) -> Any:
    return p.coefficient * v


def loss(x: Any, t: Any, p: Any) -> Any:
    return p.coefficient * x


def follow(u: Any, t: Any, dt: Any, p: Any, m: Any) -> Any:
    """Play: m[0] stands until an end of its band pushes it."""
    m[0] = u if dt == 0.0 else min(max(m[0], u - 0.5 * p.width), u + 0.5 * p.width)
    return m[0]


OWN = {
    "gain": Law("scale", "signal", scale, [Parameter("factor", 1.0, "-", 0.0, 20.0)], [2.0]),
    "play": Law("follow", "signal", follow, [Parameter("width", 0.0, "-", 0.0, 20.0)], [0.1], memory=1),
    "viscous": Law("brake", "force", brake, [Parameter("coefficient", 0.0, "-", 0.0, 20.0)], [0.5]),
    "leak": Law("loss", "state", loss, [Parameter("coefficient", 0.0, "-", -20.0, 20.0)], [0.5]),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "place", "law", "size", "window"),
    [
        pytest.param("simulate", "u", "gain", 1.3, None, marks=pytest.mark.slow),
        ("simulate", "x_sensor", "gain", 0.7, 2.0),
        ("simulate", "v", "viscous", 0.4, None),
        pytest.param("simulate", "w", "leak", 0.3, None, marks=pytest.mark.slow),
        pytest.param("closed_loop", "u", "gain", 1.3, None, marks=pytest.mark.slow),
        ("closed_loop", "x_sensor", "play", 0.2, None),
        pytest.param("closed_loop", "v", "viscous", 0.4, None, marks=pytest.mark.slow),
    ],
)
def test_an_own_law_with_the_equation_of_the_library_s_gives_the_same(
    kind: str, place: str, law: str, size: float, window: float | None
) -> None:
    t = np.arange(0.0, 20.0, 0.05)
    loop = kind == "closed_loop"
    drive = {"r": "m"} if loop else {"u": "N"}
    given: dict[str, Any] = {"control": lambda r, y, p: 2.0 * (r.r - y.x), "commands": {"u": "N"}} if loop else {}
    own = OWN[law]
    system = System(
        "swing", kind, lambda x, u, p: (x.v, u.u - 2.0 * x.x - 0.3 * x.v, x.x - x.w), inputs=drive,
        states={"x": "m", "v": "m/s", "w": "m"}, outputs={"x": "m", "w": "m"}, rates={"v": "x"}, laws=[own],
        window=window, start={"x": 0.0, "w": 0.0}, **given,
    )  # fmt: skip
    columns = {next(iter(drive)): wave(3, t), "x": 0.3 * wave(4, t), "w": 0.2 * wave(5, t)}
    effects = [f"{place}.{name}" for name in (law, own.name)]
    p = own.parameters[0]
    bound = BoundSystem(system, [Record("run", t, columns)], present={e: {p.name: size} for e in effects})
    bound.runner.steps = 8
    names = [q.name for q in bound.stage.parameters]
    column = [names.index(f"{e}.{p.name}") for e in effects]

    def with_(*sizes: float) -> np.ndarray:
        theta = bound.stage.neutral()
        theta[column] = sizes
        return np.asarray(bound.run(theta[None]))

    np.testing.assert_allclose(with_(p.value, size), with_(size, p.value), rtol=1e-12, atol=1e-14)
    assert not np.allclose(with_(p.value, size), with_(p.value, p.value))
