"""The blind benchmark for users' own models is honest: its families are the nominal models' own physics, its integrator
and the product agree where both know a law, and answers are counted as the page says.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from benchmarks import hidden_law, start
from benchmarks.blind import as_curve
from tests.nominal_systems import NOMINAL, nominal
from tests.rig_systems import FAMILIES, LEARNED, Case, Family, Hidden, draw_case, left_out, left_over
from tests.rig_systems.cases import RATES, hide
from tests.rig_systems.laws import Size, draw_values, on_signal
from tests.rig_systems.simulate import course, simulate
from tests.system_variants import SCALES, rescaled, variants
from vaneloop import Record, System
from vaneloop.identification import Parameter
from vaneloop.identification.candidates import laws
from vaneloop.identification.candidates.library import LAWS
from vaneloop.identification.user_models import simulation as runner
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.kernel import build_kernels
from vaneloop.verbs import search

MODULE = "benchmarks.hidden_law"
# sensors whose law the product reads back, to where the state must have been
READ_BACK = (".bias", ".gain", ".cubic", ".square_root", ".smooth_saturation", ".dead_zone")
CLOSE = 0.25  # noise floors between the product with the true law and the truth
SHARE = 0.03  # or of what the law changes, where that is gross
SAMPLES = 500
# these switch within a sample; the product chooses its steps for the model without them
SWITCHES, STEPS = ("coulomb", "stribeck", "friction_asymmetry", "elastic_plastic", "saturation"), 8


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Models run as plain Python: a few short runs take less time than to compile them."""
    monkeypatch.setattr(runner, "build_kernels", lambda *of: (build_kernels(*of)[1],) * 2)


def exact(system: System, case: Case) -> System:
    """The nominal model with its true parameters, known. Forces: all that the samples tell, not the filtered part."""
    system.parameters = [Parameter(p.name, p.value, p.unit, p.low, p.high) for p in system.parameters]
    if system.kind == "force":
        system.cutoff = 0.45 * case.rate
    return system


def records(case: Case) -> list[Record]:
    """The first log without noise. A state starts where its sensor reads its first value: that one sample is the true
    state, where the sensor's law cannot be read back.
    """
    f, log = case.family, case.logs[0]
    columns = case.columns(0, noisy=False)
    if f.kind in ("simulate", "closed_loop"):
        _, states, _ = course(f, case.p, case.hidden, log.t, log.drive, case.greatest)
        read_back = {h.name.rpartition(".")[0] for h in case.hidden if h.name.endswith(READ_BACK)}
        for i, name in enumerate(f.states):
            if name in f.outputs and f"{name}_sensor" not in read_back:
                columns[name][0] = states[i, 0]
    return [Record("log", log.t, columns)]


def apart(case: Case, bound: BoundSystem, with_law: bool) -> np.ndarray:
    """RMS between the product's model and the truth in noise floors, output by output."""
    theta = bound.stage.neutral()
    for h in case.hidden if with_law else ():
        effect = bound.stage.effect(h.name)
        theta[bound.stage.index()[h.name]] = [h.values.get(q.name, q.value) for q in effect.parameters]
    e = (bound.run(theta[None])[0] - bound.measured)[:, 1:]
    return np.sqrt(np.nanmean(e**2, axis=1)) / case.floors


QUICK = ("tanks", "battery", "heat_exchanger", "valve_bench", "servo_axis", "spool", "flow_loop", "thermal_mass")
EVERY = [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in FAMILIES]


@pytest.mark.slow
@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("name", EVERY)
def test_the_product_with_the_true_law_is_the_truth(name: str) -> None:
    f = FAMILIES[name]
    far: dict[str, str] = {}
    first: BoundSystem | None = None
    for law in ("", *f.laws):
        hidden = [law] if law and law not in f.partners else [f.partners[law], law] if law else []
        case = draw_case(1, 3, (name,), names=hidden, samples=4 * SAMPLES if f.window else SAMPLES)
        system = first.system if first else exact(nominal(f, case.values, {}), case)
        rng = np.random.default_rng([1, 3])
        for _ in range(20):  # other sizes, until the law shows
            bound = BoundSystem(system, records(case), like=first)
            first = first or bound
            if law.rpartition(".")[2] in SWITCHES and f.kind == "simulate":
                bound.runner.steps = STEPS
            left, without = apart(case, bound, True), apart(case, bound, False)
            if not law or without.max() > 4.0 * CLOSE:
                break
            if law.endswith("rate_limit"):
                case.hidden[0].values["rate"] *= 0.5  # what moves slowly meets no limit of the range drawn
            else:
                case.hidden = hide(f, case.p, case.logs[:1], hidden, rng)
            log = case.logs[0]
            log.outputs = simulate(f, case.p, case.hidden, log.t, log.drive, case.greatest)
        assert not law or without.max() > CLOSE, f"{law} does not show in this log: nothing is proven"
        if np.any(left > np.maximum(CLOSE, SHARE * without.max())):
            far[law] = f"{left.max():.2f} of {without.max():.2f} noise floors"
        if law in f.apart:
            assert left.max() < 0.4 * without.max() + CLOSE, law
    unknown = {law: v for law, v in far.items() if law not in f.apart}
    assert not unknown, unknown


@pytest.mark.parametrize("name", list(FAMILIES))
def test_every_family_and_its_nominal_model_name_the_same_things(name: str) -> None:
    f = FAMILIES[name]
    case = draw_case(5, 2, (name,), names=[], samples=200)
    system = nominal(f, case.values, {})
    assert tuple(system.states) == f.states and set(system.outputs) == set(f.outputs)
    assert {p.name for p in system.parameters if np.isinf(p.tolerance)} == set(f.parameters)
    assert dict(system.rates) == f.rates and dict(system.masses) == f.masses
    for law in (*f.laws, *(n for group in f.same for n in group)):
        place, _, short = law.rpartition(".")
        kind, _ = f.where(place)
        assert short in LAWS[kind if kind in ("force", "state") else "signal"], law
    assert all(
        law in f.laws
        or law.endswith(
            (".bias", ".cubic", ".end_stop", ".overflow_to_lower", ".radiation", ".stiction", ".stick_slip")
        )
        for o in f.outside.values()
        for group in o.amounts_to
        for law in group
    )
    assert set(f.apart) <= {"", *f.laws} and len(f.outside) >= 1
    assert all(len(case.columns(k)) >= len(system.outputs) for k in range(len(case.logs)))
    assert all(np.isfinite(v).all() for k in range(len(case.logs)) for v in case.columns(k).values())


@pytest.mark.parametrize("name", list(FAMILIES))
def test_what_is_outside_changes_the_truth_and_is_drawn_within_its_range(name: str) -> None:
    f = FAMILIES[name]
    clean = draw_case(1, 3, (name,), names=[], samples=300)
    for what, outside in f.outside.items():
        case = draw_case(1, 3, (name,), names=[what], samples=300)
        assert outside.low <= case.hidden[0].values["size"] <= outside.high
        change = max(
            float(np.sqrt(np.mean((a.outputs - b.outputs) ** 2))) for a, b in zip(case.logs, clean.logs, strict=True)
        )
        assert change > 1e-3 * case.floors.min(), what


def test_the_families_are_nineteen_and_cover_slow_and_fast_logs() -> None:
    assert len(FAMILIES) >= 16 and set(FAMILIES) == set(NOMINAL)
    rates = {
        draw_case(9, i, (name,), names=[], samples=60).rate
        for name in ("thermal_mass", "resonator", "dc_motor") for i in range(8)
    }  # fmt: skip
    assert min(rates) <= 0.5 and max(rates) == 2000.0 == max(RATES) and min(RATES) == 0.2


def test_a_seed_draws_the_same_case_and_kinds_come_in_their_shares() -> None:
    a, b = (draw_case(4, 1, ("tanks",), samples=200) for _ in range(2))
    assert a.kind == b.kind and a.values == b.values and a.factors == b.factors and a.hidden == b.hidden
    assert all(np.array_equal(a.columns(0)[c], b.columns(0)[c]) for c in a.columns(0))
    assert all(0.1 <= f <= 10.0 for f in a.factors.values())
    kinds = [draw_case(4, i, ("valve_bench",), samples=60).kind for i in range(200)]
    for kind, share in zip(("clean", "outside", "pair", "single"), (0.25, 0.25, 0.2, 0.3), strict=True):
        assert abs(kinds.count(kind) / 200 - share) < 0.1
    some = ("clean", "outside")
    assert {draw_case(4, i, ("valve_bench",), samples=60, kinds=some).kind for i in range(40)} == {*some}


def test_a_lag_is_the_exponential_and_a_dead_time_is_late() -> None:
    t = np.arange(0.0, 5.0, 0.01)
    y = on_signal("lag", {"time_constant": 0.7}, np.where(t >= 0.01, 1.0, 0.0), 0.01, True, 1.0)
    assert y[2:] == pytest.approx(1.0 - np.exp(-(t[2:] - 0.01) / 0.7), abs=1e-9)
    assert np.array_equal(on_signal("dead_time", {"delay": 0.25}, t, 0.01, True, 1.0)[25:], t[:-25])


def test_friction_stops_a_motor_in_the_time_that_mechanics_says() -> None:
    """J w' = - friction from w0: the speed falls in a straight line, then it rests; no voltage, no resistance."""
    f = FAMILIES["dc_motor"]
    case = draw_case(1, 3, ("dc_motor",), names=["speed.coulomb"], samples=200)
    p = type(case.p)(resistance=1e9, constant=0.05, inertia=1e-4)
    rolling = replace(f, start=lambda p, u: (100.0, 0.0))
    t = np.arange(200) * 0.001
    case.hidden[0].values["friction"] = 0.1  # 1000 rad/s^2: at rest after 0.1 s
    _, states, _ = course(rolling, p, case.hidden, t, np.zeros((1, 200)), {})
    fine = np.linspace(0.0, t[-1], states.shape[1])
    assert states[0] == pytest.approx(np.maximum(100.0 - 1000.0 * fine, 0.0), abs=1e-4)
    assert states[1, -1] == pytest.approx(5.0, rel=1e-4)  # w0^2 / (2 a)


def test_what_a_parameter_can_take_up_is_not_detectable() -> None:
    """A gain at the magnet's command is its strength: nothing is left after the refit. A cubic term is not."""
    same, other = (
        draw_case(2, 5, ("levitation",), names=[law], samples=200) for law in ("command.gain", "command.cubic")
    )
    same.hidden[0].values["factor"] = 1.05
    for log in same.logs:
        log.outputs = simulate(same.family, same.p, same.hidden, log.t, log.drive, {})
    assert left_over(same)[0] < 0.1
    other.hidden[0].values["coefficient"] = 10.0
    assert len(left_over(other)) == 1


# ---- counting --------------------------------------------------------------------------------------------------------


def row(kind: str, truth: list[str], left: list[float], named: dict[str, list[str]], **more: Any) -> dict[str, Any]:
    verdict = more.pop("verdict", "missing" if named else "none")
    same = more.pop("same", {})
    return {
        "seed": 1, "index": more.pop("index", 0), "families": "", "family": "tanks", "kind": kind, "truth": truth,
        "sizes": "[]", "same": json.dumps({law: [law, *same.get(law, [])] for law in truth}), "left": left,
        "amounts": json.dumps(more.pop("amounts", [])),
        "verdict": verdict, "named": list(named), "rivals": json.dumps(named), "error": more.pop("error", ""),
        "seconds": 1.0, "intervals": json.dumps(more.pop("intervals", [])), "variants": more.pop("variants", "{}"),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("answer", "right"),
    [
        (row("clean", [], [], {}), True),
        (row("clean", [], [], {"a.lag": []}), False),
        (row("clean", [], [], {}, verdict="unknown"), True),
        (row("single", ["a.lag"], [5.0], {"a.lag": []}), True),
        (row("single", ["a.lag"], [5.0], {"b.lag": ["a.lag"]}), True),
        (row("single", ["a.lag"], [5.0], {"b.lag": []}), False),
        (row("single", ["a.lag"], [5.0], {"b.lag": []}, same={"a.lag": ["b.lag"]}), True),
        (row("single", ["a.lag"], [5.0], {"a.lag": [], "b.bias": []}), False),
        (row("single", ["a.lag"], [5.0], {}), False),
        (row("single", ["a.lag"], [0.1], {}), True),
        (row("single", ["a.lag"], [0.1], {"b.bias": []}), False),
        (row("pair", ["a.lag", "b.bias"], [5.0, 5.0], {"a.lag": []}), False),
        (row("pair", ["a.lag", "b.bias"], [5.0, 0.1], {"a.lag": []}), True),
        (row("pair", ["a.lag", "b.bias"], [5.0, 5.0], {"a.lag": [], "b.bias": []}), True),
        (row("outside", ["spill"], [5.0], {}, verdict="unknown"), True),
        (row("outside", ["spill"], [5.0], {}), False),
        (row("outside", ["spill"], [0.1], {}), True),
        (row("outside", ["spill"], [5.0], {"a.lag": []}), False),
        (row("outside", ["edge"], [5.0], {"b": [], "a": []}, amounts=[["a", "b"]]), True),
        (row("outside", ["edge"], [5.0], {"a": []}, amounts=[["a", "b"]]), False),
        (row("clean", [], [], {}, error="StageError: x", verdict="error"), False),
    ],
)
def test_an_answer_is_right_where_the_page_says_so(answer: dict[str, Any], right: bool) -> None:
    assert (not hidden_law.misses([answer])) == right
    assert hidden_law.summary([answer])["whole answer right"]["hits"] == int(right)


def test_the_table_counts_singles_pairs_intervals_and_variants() -> None:
    inside = {"effect": "a.lag", "parameter": "t", "truth": 1.0, "value": 1.01, "low": 0.9, "high": 1.1}
    rows = [
        row("single", ["a.lag"], [5.0], {"a.lag": []}, intervals=[inside, {**inside, "low": 1.005}]),
        row("single", ["a.lag"], [5.0], {"b.lag": []}),
        row("single", ["a.lag"], [0.1], {}),
        row("pair", ["a.lag", "b.bias"], [5.0, 5.0], {"a.lag": []}),
        row("clean", [], [], {}, variants=json.dumps({"time x 20": {"same": True}, "reordered": {"same": False}})),
    ]
    s = hidden_law.summary(rows)

    def count(name: str) -> tuple[int, int]:
        return s[name]["hits"], s[name]["of"]

    assert count("detectable single named or among rivals") == (1, 2)
    assert count("a single name given is right") == (1, 2)
    assert count("nothing hidden, nothing named") == (1, 1)
    assert count("both of a detectable pair") == (0, 1)
    assert count("90 % interval covers the truth") == (1, 2)
    assert count("size within 5 % of the truth") == (2, 2)
    assert count("same answer: time x 20") == (1, 1) and count("same answer: reordered") == (0, 1)
    low, high = s["a single name given is right"]["low"], s["a single name given is right"]["high"]
    assert 0.0 < low < 0.5 < high < 1.0


def test_what_is_learned_is_counted_where_it_was_asked() -> None:
    def asked(kind: str, curves: list[str], names: list[str], error: float | None = None, left: float = 5.0) -> Any:
        laws = [{"names": names, "formulas": []}] if names else []
        said = {"verdict": "learned" if names else "unknown", "laws": laws, "error": error, "nearest": []}
        truth = ["clogging"] if kind == "outside" else []
        of = row(kind, truth, [left] * len(truth), {})
        return {**of, "learned": json.dumps(said), "curves": json.dumps(curves)}

    rows = [
        asked("outside", ["a.gain_of_time"], ["a.gain_of_time"], 1.1),
        asked("outside", ["a.gain_of_time"], ["b.curve_of_u", "a.gain_of_time"], 1.7),  # among its rivals
        asked("outside", ["a.gain_of_time"], ["b.curve_of_u"], 1.0),
        asked("outside", [], [], None),  # no curve of one quantity is it, and none was given: not found either
        asked("outside", ["a.gain_of_time"], [], None, 0.1),  # nobody could see it
        asked("clean", [], []),
        asked("clean", [], ["b.curve_of_u"]),
    ]
    s = hidden_law.summary(rows)
    assert s["learned: outside the library, right place and quantity"]["hits"] == 2
    assert s["learned: outside the library, right place and quantity"]["of"] == 4
    assert s["learned: of these, error on the test log within 1.5 noise floors"]["hits"] == 1
    assert s["learned: nothing hidden, nothing learned"]["hits"] == 1
    assert not any(k.startswith("learned") for k in hidden_law.summary([row("clean", [], [], {})]))


@pytest.mark.parametrize(
    ("named", "verdict", "curve", "right"),
    [
        (["a", "b"], "named", "", True),
        (["a", "b"], "unknown", "", True),  # of curves; what is named is what is hidden
        (["a", "b"], "learned", "c.curve_of_u", False),  # a wrong curve instead of the right names
        (["a"], "unknown", "", False),
        (["a"], "named", "", False),
    ],
)
def test_nothing_is_left_to_learn_where_the_laws_that_amount_to_it_are_named(
    named: list[str], verdict: str, curve: str, right: bool
) -> None:
    laws = [{"names": [curve], "formulas": []}] if curve else []
    said = {"verdict": verdict, "laws": laws, "error": None, "nearest": []}
    of = row("outside", ["edge"], [5.0], {n: [] for n in named}, amounts=[["a", "b"]])
    s = hidden_law.summary([{**of, "learned": json.dumps(said), "curves": "[]"}])
    assert s["learned: outside the library, right place and quantity"]["hits"] == right


def test_what_is_left_out_is_counted_beside_what_other_laws_say() -> None:
    def asked(laws: list[dict[str, Any]], *also: str) -> Any:
        said = {"verdict": "learned", "laws": laws, "error": None, "nearest": [], "also": also}
        return {**row("left out", ["a.cubic"], [5.0], {}), "learned": json.dumps(said)}

    right = {"names": ["a.curve_of_a"], "formulas": ["a^3"], "inside": 0.95, "formula": True}
    narrow = {**right, "inside": 0.5, "formula": False}
    other = {"names": ["b.curve_of_a"], "formulas": []}
    rows = [asked([right]), asked([other, narrow]), asked([other]), asked([], "b.gain")]
    s = {k.removeprefix("learned: left out"): (v["hits"], v["of"]) for k, v in hidden_law.summary(rows).items()
         if k.startswith("learned: left out")}  # fmt: skip
    assert s == {
        " of the library, right place and quantity": (2, 4), ", and no other law of the library does as well": (2, 3),
        ", the curve is the law within its band": (1, 4), ", the right formula among those given": (1, 4),
    }  # fmt: skip


def test_every_law_outside_the_library_has_its_curves_or_is_said_to_have_none() -> None:
    assert set(LEARNED) == {(name, law) for name, f in FAMILIES.items() for law in f.outside}


SIGNALS = {"absolute_value": laws.ABSOLUTE}  # where the product's number has another name
FORCES = ("force_offset", "viscous", "coulomb", "stribeck", "quadratic_drag", "spring", "cubic_spring")


def as_product(kind: str, law: str, values: list[float], x: float) -> float:
    """What the product's own law of that name adds."""
    p, memory = np.array([*values, 0.0, 0.0, 0.0]), np.zeros(laws.MEMORY)
    if kind == "force":
        code = getattr(laws, law.upper())
        return laws.force_of(code, x, x, True, p, 0.0, 0.0, 0.0, memory)
    if kind == "state":
        code = {"leak": laws.LEAK, "offset": laws.STATE_OFFSET}.get(law) or getattr(
            laws, f"STATE_{law.removesuffix('_drag').upper()}"
        )
        return laws.state_rate(code, x, p)
    code = SIGNALS.get(law) or getattr(laws, law.upper())
    return laws.transform(code, 0, np.zeros(1), np.array([x]), p, memory) - x


@pytest.mark.parametrize("name", FAMILIES)
def test_a_law_that_is_left_out_is_the_products_as_a_curve(name: str) -> None:
    """The rig's own equations of each law against the product's, at the place and of the quantity that are told."""
    f, rng = FAMILIES[name], np.random.default_rng(1)
    x = rng.uniform(0.1, 3.0, 20) * rng.choice([-1.0, 1.0], 20)
    for full in left_out.laws_of(f):
        place, _, law = full.rpartition(".")
        kind = f.where(place)[0]
        hidden = Hidden(full, draw_values(law, kind, Size(-3.0, 3.0, 1.0, 2.0, 1.0, 0.01), rng))
        values = [*hidden.values.values()]
        if law == "square_root" and kind != "state":
            values.append(3.0)
        truth = left_out.truth_of(f, hidden, 3.0)
        theirs = [as_product(kind, law, values, float(v)) for v in x]
        assert truth.value(x) == pytest.approx(theirs, abs=1e-12), full
        assert truth.found(f"{truth.at}.curve_of_{truth.quantity or 'time'}")
        assert not truth.found(f"{truth.at}.gain_of_{truth.quantity or 'time'}")


def learned_law(y: np.ndarray, width: float, untold: tuple[int, ...] = ()) -> Any:
    """A learned law on [-1, 1], visited evenly, with a band of a width."""
    x = np.linspace(-1.0, 1.0, 257)
    return SimpleNamespace(
        x=x, y=y, low=y - width, high=y + width, edges=np.linspace(-1.0, 1.0, 25), visited=np.full(24, 1 / 24),
        untold=untold, formulas=[SimpleNamespace(form="cube")],
    )  # fmt: skip


def test_a_curve_is_the_law_where_its_band_holds_it() -> None:
    x = np.linspace(-1.0, 1.0, 257)
    near, off = learned_law(x**3 + 0.01, 0.02), learned_law(x**3 + 0.03, 0.02)
    assert as_curve(near, lambda q: q**3, ("cube",)) == {"inside": pytest.approx(1.0), "formula": True}
    assert as_curve(off, lambda q: q**3, ("line",)) == {"inside": 0.0, "formula": False}
    assert as_curve(near, lambda q: q**3, ())["formula"] is None
    # a slope that the logs do not tell from a gain makes the rest larger or smaller, and says so
    scaled = 1.7 * x**3 + 0.7 * x
    assert as_curve(learned_law(scaled, 1e-6, (1,)), lambda q: q**3, ())["inside"] == pytest.approx(1.0)
    assert as_curve(learned_law(scaled, 1e-6), lambda q: q**3, ())["inside"] < 0.1
    assert as_curve(learned_law(scaled + 0.1, 1e-6, (1,)), lambda q: q**3, ())["inside"] < 0.1


def test_a_diagnosis_that_raises_is_a_row_with_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise RuntimeError("no way\nat all")

    monkeypatch.setattr(search, "diagnose", fails)
    got = hidden_law.judge_case(1, 10, ("valve_bench",), True)
    assert got["error"] == "RuntimeError: no way at all" and got["verdict"] == "error"
    assert hidden_law.misses([got]) and hidden_law.summary([got])["diagnosed without an error"]["hits"] == 0


@pytest.mark.slow
def test_a_run_goes_on_where_it_was_stopped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "r.parquet"
    words = ["--seed", "3", "--family", "valve_bench", "--workers", "1", "--out", str(out)]
    assert start.main(MODULE, [*words, "--systems", "1", "--quiet"]) == 0
    first = pq.read_table(out).to_pylist()
    assert start.main(MODULE, [*words, "--systems", "2", "--json", str(tmp_path / "r.json")]) == 0
    both = pq.read_table(out).to_pylist()
    assert [r["index"] for r in both] == [0, 1] and both[0] == first[0]
    assert "1 systems done before" in capsys.readouterr().out
    assert json.loads((tmp_path / "r.json").read_text())["summary"]["systems"] == 2
    for more, said in (
        (["--seed", "4", "--family", "valve_bench"], "drawn with seed 3; allowed: that --seed, or another --out"),
        (["--seed", "3"], "drawn from families valve_bench; allowed: the same --family, or another --out"),
        (["--seed", "3", "--family", "valve_bench", "--variants"], "has rows without variants"),
    ):
        assert start.main(MODULE, ["--systems", "1", "--out", str(out), *more]) == 2
        err = capsys.readouterr().err
        assert said in err and len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--systems", "0"], "--systems (=0) must be in [1, 100000]"),
        (["--workers", "65"], "--workers (=65) must be in [1, 64]"),
        (["--family", "tank"], "--family 'tank': not a family; allowed: tanks, flow_loop"),
        (["--seed", "-1"], "--seed (=-1) must be in [0, 2^63)"),
        (["--kinds", "clean", "--leave-out"], "--kinds clean: not with --leave-out or --surface"),
    ],
)
def test_bad_options_are_told_in_one_line(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert start.main(MODULE, words) == 2
    err = capsys.readouterr().err
    assert said in err and len(err.strip().splitlines()) == 1


def test_a_file_that_is_no_result_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.parquet"
    pq.write_table(pa.table({"a": [1]}), bad)
    assert start.main(MODULE, ["--out", str(bad)]) == 2
    assert "not a result of hidden_law" in capsys.readouterr().err


# ---- variants --------------------------------------------------------------------------------------------------------


def family_of(kind: str) -> Family:
    return next(f for f in FAMILIES.values() if f.kind == kind)


@pytest.mark.slow
@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize(
    "name",
    [
        "valve_bench",
        "servo_axis",
        "tanks",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("levitation", "pendulum", "battery")),
    ],
)
def test_a_rescaled_model_says_the_same_in_other_units(name: str) -> None:
    f = FAMILIES[name]
    case = draw_case(1, 3, (name,), names=[], samples=200)
    logs = [Record(f"log {k}", log.t, case.columns(k)) for k, log in enumerate(case.logs)]
    plain_bound = BoundSystem(exact(nominal(f, case.values, {}), case), logs[:-1])
    want = plain_bound.run(plain_bound.stage.neutral()[None])[0]
    seen = set()
    for what, (system, fitted, test) in variants(case, logs, lambda f, v, _: exact(nominal(f, v, {}), case)):
        seen.add(what)
        if what == "logs cut in two":
            assert [len(r.t) for r in fitted] == [100] * 2 * (len(logs) - 1)
            continue
        assert len(test) == 1
        bound = BoundSystem(system, fitted)
        got = bound.run(bound.stage.neutral()[None])[0]
        scale = np.nanstd(bound.measured, axis=1) / np.nanstd(plain_bound.measured, axis=1)
        sign = np.sign(np.nansum(bound.measured * plain_bound.measured, axis=1))
        assert got / (scale * sign)[:, None] == pytest.approx(want, rel=1e-5, abs=1e-5 * np.abs(want).max()), what
    assert set(SCALES) | {"reordered", "other starts", "a sign flipped"} <= seen


def test_reordering_leaves_the_library_as_it_was() -> None:
    before = {k: list(v) for k, v in LAWS.items()}
    case = draw_case(1, 3, ("tanks",), names=[], samples=100)
    logs = [Record(f"log {k}", log.t, case.columns(k)) for k, log in enumerate(case.logs)]
    turned = False
    for what, _ in variants(case, logs, nominal):
        turned |= what == "reordered" and [*LAWS["signal"]] == before["signal"][::-1]
    assert turned and {k: list(v) for k, v in LAWS.items()} == before


def test_a_rescaled_system_keeps_its_kind_and_its_parameters() -> None:
    case = draw_case(1, 3, ("hydraulic_cylinder",), names=[], samples=100)
    system = nominal(case.family, case.values, {})
    other = rescaled(system, 20.0, {"position": -2.0})
    assert other.window == 60.0 and other.kind == "simulate" and other.parameters is system.parameters
