"""The plant's tables, model files and machines by their specification: units, bounds, rows, what is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from benchmarks import effects_page
from plant import Model, build_plant, chain, chain_lanes, curve, lanes, linkage, load_geometry, load_model, write_model
from plant import model as model_module
from plant.curve import PLACES, QUANTITIES, at_curve, quantity_of
from plant.curve_lanes import alike
from plant.effect import HYDRAULIC, KINDS, MOTOR, SITES, STAGES, T_REF, UNITS, Effect, Parameter, per_vane_stage
from plant.effects import CURVES, EFFECTS, ROW
from plant.geometry import Schedules, length_tolerances, load_schedules, stroke_for_vigv, vane_angles
from plant.layout import (
    C_HIGH,
    C_LAG,
    C_LOW,
    C_OF,
    C_PERIOD,
    C_SITE,
    C_STOPS,
    C_TABLE,
    CURVE_ROWS,
    LVDT_STEP,
    PLAY,
    SIGNALS,
    VANE_COUNT,
)
from plant.model import Learned, Second, allowed_of
from plant.parameters import KIND, POT_BIAS, names_of, read_plant
from plant.places import DRIVEN, LINKAGE_BACKLASH, POT, POT_BIAS_ERROR, POT_GAIN, RING
from plant.spatial import (
    Clearances,
    clearance_for,
    clearance_loop,
    clearance_width,
    contributions,
    freedoms,
    spatial_angles,
)
from vaneloop.base.curve import FINE_SIDE, POINTS, SIDE
from vaneloop.base.errors import InputError
from vaneloop.base.hysteresis import RADII, weights_of
from vaneloop.base.vanes import VANES

SHIPPED, ELECTRIC = build_plant(), build_plant("plant_electromechanical.toml")
OWN = VANES[:3]

# ---- effects ---------------------------------------------------------------------------------------------------------


def test_border_units_are_their_powers_of_ten() -> None:
    degree = math.radians(1.0)
    factors = {
        "-": 1.0, "s": 1.0, "%/s": 1.0, "mm": 1e-3, "mm/s": 1e-3, "mA": 1e-3, "N": 1.0, "N/(m/s)": 1.0,
        "MPa/(m/s)": 1e6, "mm/s/MPa": 1e-9, "mm/kN": 1e-6, "1/K": 1.0, "mm/K": 1e-3, "deg": pytest.approx(degree),
        "deg/K": pytest.approx(degree), "deg/h": pytest.approx(degree / 3600.0),
    }  # fmt: skip
    assert factors == UNITS
    assert Parameter("a", "mm", 0.0, 0.0, 1.0, "x").si == 1e-3 and T_REF == 40.0
    assert (HYDRAULIC, MOTOR) == (("hydraulic",), ("electromechanical",))


@pytest.mark.parametrize("change, says", [
    ({}, ""), ({"neutral": -1.0}, ""), ({"neutral": 1.0}, ""), ({"unit": "rod"}, "unit .='rod'. must be one of"),
    ({"neutral": 1.1}, r"neutral \(=1.1 deg\) must be in \[-1, 1\]"), ({"neutral": -1.1}, "neutral"),
    ({"period": 2.0}, ""), ({"period": 1.9}, r"period \(=1.9 deg\) must be high - low"), ({"period": 0.0}, ""),
])  # fmt: skip
def test_a_parameter_is_neutral_within_its_bounds(change: dict[str, Any], says: str) -> None:
    given: dict[str, Any] = {"name": "a", "unit": "deg", "neutral": 0.0, "low": -1.0, "high": 1.0, "meaning": "x"}
    if not says:
        assert Parameter(**given | change).period == change.get("period", 0.0)
        return
    with pytest.raises(ValueError, match=f"^a: {says}"):
        Parameter(**given | change)


A, B = Parameter("a", "mm", 0.0, 0.0, 1.0, "x"), Parameter("b", "mm", 0.0, 0.0, 1.0, "x")


@pytest.mark.parametrize("change, says", [
    ({}, ""), ({"stages": STAGES}, ""), ({"kinds": KINDS[:1]}, ""), ({"site": "wing"}, "site .='wing'. must be one of"),
    ({"stages": ()}, "stages"), ({"stages": ("servo", "wing")}, "stages"), ({"kinds": ()}, "kinds"),
    ({"kinds": ("steam",)}, "kinds"), ({"parameters": ()}, "parameters must be there"),
    ({"parameters": (A, A)}, "parameters must be there and have different names"),
])  # fmt: skip
def test_an_effect_is_of_a_known_site_stage_and_kind(change: dict[str, Any], says: str) -> None:
    given: dict[str, Any] = {
        "name": "e", "site": SITES[0], "stages": ("servo",), "parameters": (A, B), "states": (), "summary": "",
        "excites": "",
    }  # fmt: skip
    if not says:
        made = Effect(**given | change)
        assert made["b"] is B and made["a"] is A
        with pytest.raises(KeyError, match="e.c"):
            _ = made["c"]
        return
    with pytest.raises(ValueError, match=f"^e: {says}"):
        Effect(**given | change)


def test_the_same_of_every_stage_has_its_name() -> None:
    each = per_vane_stage("deg", 0.0, -2.0, 3.0, "x", "hysteresis")
    assert [(p.name, p.vane, p.beyond, p.low, p.high) for p in each] == [(v, v, "hysteresis", -2.0, 3.0) for v in VANES]


def test_the_page_has_a_row_and_a_section_for_each_effect() -> None:
    text = effects_page.page()
    for e in EFFECTS.values():
        kind = "any" if e.kinds == KINDS else e.kinds[0]
        row = f"| [`{e.name}`](#{e.name}) | {e.site} | {kind} | {', '.join(e.stages)} | {e.summary} |\n"
        assert text.count(row) == 1 and text.count(f"\n## {e.name}\n") == 1
    assert "\n| `vigv`, `vgv1`, ... | deg |" in text and "`vgv2`" not in text
    assert effects_page._sentence(" what  is\n told ") == "What is told"
    assert max(len(line) for line in text.splitlines() if not line.startswith("|")) <= 120


# ---- curves ----------------------------------------------------------------------------------------------------------


def test_signals_of_curves_are_in_si() -> None:
    si = {"mA": 1e-3, "mm": 1e-3, "mm/s": 1e-3, "MPa": 1e6, "deg": math.radians(1.0)}
    of = {"x_lvdt": "x", "speed_of_x_lvdt": "speed", "direction_of_x_lvdt": "direction",
          "distance_since_reversal_of_x_lvdt": "distance", "time_since_reversal_of_x_lvdt": "since"}  # fmt: skip
    for name, q in QUANTITIES.items():
        assert SIGNALS[q.of] == of.get(name, name) and q.si == pytest.approx(si.get(q.unit, 1.0)) and q.name == name
        assert (q.period, q.lag, q.stops) == (0.0, 0.0, False) and quantity_of(name) is q
    assert len(QUANTITIES) == 12 + len(VANES)


def test_places_of_curves_have_numbers_of_their_own() -> None:
    assert len({p.site for p in PLACES.values()}) == len(PLACES)
    for name, p in PLACES.items():
        assert name == f"{p.at} {p.how}" and p.si == {"mm": 1e-3, "mA": 1e-3, "deg": math.radians(1.0)}.get(p.unit, 1.0)
        assert (p.unit == "-") == (p.how == "times") and p.stages and (not p.vane or p.vane in p.at)
        if p.vane:
            all_of = {"ring": curve.RING_ADDS, "play": curve.PLAY_ADDS}.get(p.at.rpartition("_")[2])
            base = all_of or (curve.POT_ADDS if p.how == "adds" else curve.POT_TIMES)
            assert p.site == base + 1 + VANES.index(p.vane)
    assert (curve.LEAST, curve.TURN) == (0.05, 0.02)


@pytest.mark.parametrize("name, period, lag, stops", [
    ("time_every_20_ms", 0.02, 0.0, False), ("n_r_lagged_by_20_s", 0.0, 20.0, False), ("stops_of_n_r", 0.0, 0.0, True),
    ("n_r", 0.0, 0.0, False), ("time_lagged_by_2_s", None, None, None), ("stops_of_time", None, None, None),
    ("what", None, None, None), ("what_lagged_by_2_s", None, None, None), ("stops_of_what", None, None, None),
])  # fmt: skip
def test_a_quantity_by_its_name(name: str, period: Any, lag: Any, stops: Any) -> None:
    q = quantity_of(name)
    if period is None:
        assert q is None
    else:
        assert q is not None and (q.name, q.period, q.lag, q.stops) == (name, pytest.approx(period), lag, stops)
        assert q.of == QUANTITIES["time" if period else "n_r"].of


def test_curves_stand_behind_each_other_in_si() -> None:
    p = np.repeat(SHIPPED.p, 3, axis=1)
    tables = np.arange(3.0 * POINTS).reshape(POINTS, 3)
    at_curve(p, PLACES["valve.current adds"], QUANTITIES["x_lvdt"], 1.0, 40.0, tables)
    stops = quantity_of("stops_of_p_s")
    assert stops is not None
    table = np.linspace(0.0, 2.0, POINTS)[:, None]
    at_curve(p, PLACES["actuator.load adds"], stops, 0.0, 3.0, table)
    assert (p[CURVES] == 2.0).all()
    first, second = CURVES + 1, CURVES + 1 + CURVE_ROWS
    assert p[first : first + C_TABLE, 1].tolist() == [
        {C_SITE: PLACES["valve.current adds"].site, C_OF: 1, C_LOW: 1e-3, C_HIGH: 40.0 * 1e-3}.get(k, 0.0)
        for k in range(C_TABLE)
    ]
    assert p[first + C_TABLE : second] == pytest.approx(1e-3 * tables)
    assert p[second + C_LOW : second + C_HIGH + 1, 0].tolist() == [0.0, 3e6] and p[second + C_STOPS, 0] == 1.0
    assert p[second + C_TABLE : second + C_TABLE + RADII, 2] == pytest.approx(weights_of(0.0, 3.0, table)[:, 0] * 1e-6)
    late = quantity_of("n_r_lagged_by_20_s")
    every = quantity_of("time_every_20_ms")
    assert late is not None and every is not None
    for q in (late, every):
        at_curve(p, PLACES["actuator.load adds"], q, 0.0, 3.0, table)
    third = second + CURVE_ROWS
    assert p[third + C_LAG, 0] == 20.0 and p[third + CURVE_ROWS + C_PERIOD, 0] == pytest.approx(0.02)
    with pytest.raises(ValueError, match="a machine has room for 4 curves"):
        at_curve(p, PLACES["actuator.load adds"], stops, 0.0, 3.0, table)


def test_curves_are_alike_but_for_their_tables() -> None:
    p = np.repeat(SHIPPED.p, 5, axis=1)
    assert alike(p).tolist() == [False] * 5
    bent = p[:, 1:]
    for _ in range(2):
        at_curve(bent, PLACES["valve.current adds"], QUANTITIES["n_r"], 40.0, 90.0, np.ones((POINTS, 4)))
    p[:, 1:] = bent
    p[CURVES + 1 + CURVE_ROWS + C_TABLE, 2] *= 3.0
    assert alike(p).tolist() == [False, True, True, True, True]
    p[CURVES + 1 + CURVE_ROWS + C_STOPS, 3] = 1.0  # the last of the second one's head
    p[CURVES, 4] = 1.0
    assert alike(p).tolist() == [False, True, True, False, False]


# ---- learned laws ----------------------------------------------------------------------------------------------------

ENDS = {"low": 1.0, "high": 4.0}
CLAMPED = [1.0] * 4 + [4.0] * 4


def law(**change: Any) -> Learned:
    """A curve of four splines, or with changes."""
    given = {"how": "adds", "at": "valve.current", "of": "n_r", "values": [1.0, 2.0, 3.0, 4.0], "knots": CLAMPED}
    return Learned(**(given | ENDS | change))


def formula(name: str, values: list[float], **change: Any) -> Learned:
    """A formula of one quantity."""
    return law(form=name, values=values, knots=[], **change)


def surface(values: int = 16, **second: Any) -> Learned:
    """A surface of splines."""
    other = Second(**({"of": "t_oil", "low": 10.0, "high": 20.0, "knots": [10.0] * 4 + [20.0] * 4} | second))
    return law(values=[float(v) for v in range(values)], second=other)


@pytest.mark.parametrize("made, says", [
    (law(), ""), (law(values=[1.0] * 5, jump=True), ""), (formula("line", [2.0]), ""), (surface(), ""),
    (formula("line", [2.0], reach=[1.0, 4.0]), ""), (formula("line", [2.0], reach=[0.0, 9.0]), ""),
    (law(knots=[1.0, 1.0, 1.0, 1.0, 2.0, 3.0, 4.0, 4.0, 4.0, 4.0], values=[1.0] * 6), ""),
    (law(low=4.0), r"a: low \(=4\) must be below high \(=4\)"), (law(low=5.0), r"a: low \(=5\) must be below"),
    (surface(low=20.0), r"a.second: low \(=20\) must be below high \(=20\)"),
    (formula("circle", [1.0]), r"a: form \(='circle', 1 values\) must be one of constant \(1 values\), line"),
    (formula("line", [1.0, 2.0]), r"a: form \(='line', 2 values\) must be one of .*\(3 values\)$"),
    (formula("line", [1.0], second=Second(of="t_oil", low=0.0, high=1.0)), r"a.second: form \(='', 1 values\) must"),
    (law(second=Second(of="t_oil", low=0.0, high=1.0, form="line")), "a.second: form .* none, as the first quantity"),
    (formula("line", [1.0], second=Second(of="t_oil", low=0.0, high=1.0, form="above")),
     "a: form .*; with second, a, second_b are needed$"),
    (surface().model_copy(update={"jump": True}), "a: jump and reach are of one quantity"),
    (surface().model_copy(update={"reach": [0.0, 9.0]}), "a: jump and reach are of one quantity"),
    (law(reach=[0.0, 9.0]), "a: reach .* must be of a formula"), (formula("line", [2.0], reach=[0.0]), "a: reach"),
    (formula("line", [2.0], reach=[1.1, 9.0]), "a: reach"), (formula("line", [2.0], reach=[0.0, 3.9]), "a: reach"),
    (law(values=[1.0] * 5), r"a: knots \(8 of them\) must rise, and be 4 more than the 5 values$"),
    (law(jump=True), r"a: knots \(8 of them\) must rise, and be 4 more than the 3 values less the jump"),
    (law(knots=CLAMPED[::-1]), "a: knots .* must rise"),
    (surface(15), r"a: values \(15 of them\) must be 4 x 4, as the knots have it"),
    (surface(knots=[10.0] * 4 + [20.0] * 3), r"a.second: knots \(7 of them\) must rise, and be 8 at least"),
    (surface(knots=[20.0] * 4 + [10.0] * 4), "a.second: knots .* must rise"),
    (surface(been=[(1.0, 10.0), (4.0, 10.0), (4.0, 20.0)]), ""),
    (surface(been=[(1.0, 10.0), (2.5, 15.0), (4.0, 20.0)]), r"a.second: been \(3 corners\) must be three or more"),
])  # fmt: skip
def test_a_law_that_is_no_curve_and_no_surface_is_refused(made: Learned, says: str) -> None:
    if not says:
        made.check("a")
        return
    with pytest.raises(InputError, match=f"^{says}"):
        made.check("a")


def test_values_of_a_law_have_names() -> None:
    assert law().numbers == ("c1", "c2", "c3", "c4") and law(jump=True).numbers == ("c1", "c2", "c3", "jump")
    assert formula("gentle step", [1.0] * 3).numbers == ("a", "b", "c") and formula("none", [1.0]).numbers == ()
    both = formula("line", [1.0, 2.0], second=Second(of="t_oil", low=0.0, high=1.0, form="above"))
    assert both.numbers == ("a", "second_b")
    assert law().now({"c2": 9.0, "c9": 5.0}).values == [1.0, 9.0, 3.0, 4.0] and law().values[1] == 2.0
    assert law().ends == (1.0, 4.0) and formula("line", [2.0], reach=[0.0, 9.0]).ends == (0.0, 9.0)
    assert law().size == 1.0 and law().unit == "" and not law().jump


def test_tables_of_laws() -> None:
    x = np.linspace(1.0, 4.0, POINTS)
    assert law().table()(np.ones(4)) == pytest.approx(np.ones(POINTS))
    line = np.array([1.0, 2.0, 3.0, 4.0])  # coefficients of a straight line are its values at the knots' means
    assert law().table()(line) == pytest.approx(x) and law().table(5)(line) == pytest.approx(x[::64])
    assert formula("square", [1.0]).table()(np.array([0.5])) == pytest.approx(0.5 * x**2)
    assert formula("constant", [1.0]).table(7)(np.array([2.0])).tolist() == [2.0] * 7
    far = formula("line", [1.0], reach=[0.0, 8.0]).table(9)(np.array([3.0]))
    assert far == pytest.approx(3.0 * np.arange(9.0))
    jump = law(low=-1.0, high=1.0, knots=[-1.0] * 4 + [1.0] * 4, values=[0.0] * 5, jump=True).table(3)
    assert jump(np.array([0.0, 0.0, 0.0, 0.0, 0.5])).tolist() == [-0.5, 0.0, 0.5]
    assert jump(np.array([1.0, 1.0, 1.0, 1.0, 0.25])).tolist() == pytest.approx([0.75, 1.0, 1.25])


def test_surfaces_of_laws() -> None:
    x, z = np.linspace(1.0, 4.0, SIDE), np.linspace(10.0, 20.0, SIDE)
    lines = np.outer([1.0, 2.0, 3.0, 4.0], np.linspace(10.0, 20.0, 4)).ravel()
    assert surface().table()(lines) == pytest.approx(np.outer(x, z))
    corner = surface(been=[(1.0, 10.0), (2.5, 10.0), (2.5, 15.0), (1.0, 15.0)]).table()(lines)
    half = SIDE // 2
    assert corner[: half + 1, : half + 1] == pytest.approx(np.outer(x, z)[: half + 1, : half + 1])
    assert corner[-1, -1] == pytest.approx(x[half] * z[half])  # beyond, as at the nearest place
    made = formula("line", [1.0, 2.0], second=Second(of="t_oil", low=10.0, high=20.0, form="above"))
    x, z = np.linspace(1.0, 4.0, FINE_SIDE), np.linspace(10.0, 20.0, FINE_SIDE)
    assert made.table()(np.array([2.0, 15.0])) == pytest.approx(2.0 * np.outer(x, np.maximum(z - 15.0, 0.0)))


# ---- model files -----------------------------------------------------------------------------------------------------


def test_a_model_file_comes_back_with_its_curves_and_words(tmp_path: Path) -> None:
    model = Model(
        parameters={"actuator.flow_gain": value_of("actuator.flow_gain") * 1.01},
        effects={"valve_dead_band": {"half_width": 1.25}, "bend é": {"c1": 0.5}},
        meta={"note": 'says "so"', "history": ["one", "two"], "n": 3, "good": True},
        curves={"bend é": law(unit="mA", size=0.25), "two": formula("line", [2.0], reach=[0.0, 9.0])},
    )
    write_model(tmp_path / "m.toml", model)
    assert load_model(tmp_path / "m.toml") == model
    text = (tmp_path / "m.toml").read_text(encoding="utf-8")
    assert "half_width = 1.25  # mm" in text or "half_width = 1.25  # mA" in text
    assert '[curves."bend é"]' in text and '"bend é"]\nc1 = 0.5\n' in text and '"actuator.flow_gain" = ' in text
    write_model(tmp_path / "none.toml", Model())
    assert (tmp_path / "none.toml").read_text() == "" and load_model(tmp_path / "none.toml") == Model()
    of_two = Model(curves={"s": surface()})
    write_model(tmp_path / "s.toml", of_two)
    assert "[curves.s.second]\n" in (tmp_path / "s.toml").read_text()
    with pytest.raises(InputError, match="curves.s: second .='t_oil'. makes it a surface"):
        load_model(tmp_path / "s.toml")
    with pytest.raises(InputError, match="cannot write"):
        write_model(tmp_path / "no" / "m.toml", model)


def value_of(name: str) -> float:
    """A nominal value, in its table's unit."""
    return next(n.value for n in SHIPPED.nominal if n.name == name)


def test_names_in_a_file_are_quoted_where_they_must_be() -> None:
    names = {"plain_1-a": "plain_1-a", "a.b": '"a.b"', "": '""', "é": '"é"', 'a"b': '"a\\"b"', "a b": '"a b"'}
    assert {n: model_module._key(n) for n in names} == names


def test_a_history_grows_and_older_files_are_read() -> None:
    assert Model().noted("a").noted("b").meta == {"history": ["a", "b"]}
    assert Model(meta={"history": "old", "x": 1}).noted("b").meta == {"history": ["old", "b"], "x": 1}
    older = Model.model_validate({"system": "pump", "history": ["a"], "meta": {"x": 1}, "parameters": {"k": 2.0}})
    assert older.meta == {"system": "pump", "history": ["a"], "x": 1} and older.parameters == {"k": 2.0}
    with pytest.raises(InputError, match="m: is a model of the system 'pump'; --system says where that is"):
        older.check(SHIPPED, "m")


@pytest.mark.parametrize("given, says", [
    ({"parameters": {"actuator.flow_gian": 1.0}}, "parameters: 'actuator.flow_gian' is unknown, probably 'actuator"),
    ({"parameters": {"linkage.vgv5_play": 1.0}}, r"parameters: .* is of a vane row that this machine lacks \(vgv5\)"),
    ({"effects": {"valve_dead_bend": {}}}, "effects: 'valve_dead_bend' is unknown, probably 'valve_dead_band'"),
    ({"effects": {"gear_backlash": {}}}, "effects: 'gear_backlash' is of an actuator of kind electromechanical; this"),
    ({"effects": {"valve_dead_band": {"halfwidth": 1.0}}}, "effects.valve_dead_band: 'halfwidth' is unknown, probably"),
    ({"effects": {"linkage_backlash": {"vgv6": 0.1}}}, "effects.linkage_backlash: 'vgv6' is of a vane row that this"),
    ({"curves": {f"c{k}": law() for k in range(5)}}, r"curves \(=5\) must be at most 4"),
    ({"curves": {"c": law(at="nowhere")}}, r"curves.c: at, how \(='nowhere', 'adds'\) is unknown; allowed: contr"),
    ({"curves": {"c": law(at="sensors.vgv6")}}, "curves.c: at, how .* is of a vane row that this machine lacks"),
    ({"curves": {"c": law(of="vgv6")}}, r"curves.c: of \(='vgv6'\) is unknown; allowed: i_cmd, "),
    ({"curves": {"c": law(of="what_lagged_by_2_s")}}, r"curves.c: of \(='what_lagged_by_2_s'\) is unknown"),
    ({"curves": {"c": law(of="stops_of_time")}}, r"curves.c: of \(='stops_of_time'\) is unknown"),
    ({"curves": {"c": law(low=4.0)}}, r"curves.c: low \(=4\)"),
    ({"curves": {"c": law()}, "effects": {"c": {"c5": 1.0}}}, "effects.c: 'c5' is unknown; allowed: c1, c2, c3, c4"),
])  # fmt: skip
def test_what_a_machine_has_not_is_refused(given: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=f"^m.toml: {says}"):
        Model(**given).check(SHIPPED, "m.toml")


@pytest.mark.parametrize("of", ["n_r", "time", "time_every_20_ms", "n_r_lagged_by_20_s", "stops_of_n_r", "vgv2"])
def test_a_curve_may_be_of_each_of_these(of: str) -> None:
    Model(curves={f"c{k}": law(of=of) for k in range(4)}, effects={"c1": {"c4": 1.0}}).check(SHIPPED)


def test_values_are_within_their_bounds_on_both_sides() -> None:
    for effect in ("valve_dead_band", "lvdt_gain", "linkage_backlash"):
        for p in SHIPPED.parameters_of(effect).values():
            for value, good in ((p.low, True), (p.high, True), (p.low - 1e-6, False), (p.high + 1e-6, False)):
                made = Model(effects={effect: {p.name: value}})
                if good:
                    made.check(SHIPPED)
                    continue
                with pytest.raises(InputError, match=rf"{effect}.{p.name} \(=.*\) must be in \["):
                    made.check(SHIPPED)
    for n in SHIPPED.nominal:
        low, high = allowed_of(SHIPPED, n)
        assert low <= n.value <= high
        Model(parameters={n.name: low}).check(SHIPPED)
        with pytest.raises(InputError, match=rf"parameters: {n.name} \(="):
            Model(parameters={n.name: high + 1e-6 * abs(high) + 1e-9}).check(SHIPPED)


def test_a_recalibrated_value_is_within_four_tolerances_and_what_is_physical() -> None:
    by = {n.name: n for n in SHIPPED.nominal}
    gain = by["actuator.flow_gain"]
    assert gain.tolerance > 0.0
    assert allowed_of(SHIPPED, gain) == (
        pytest.approx(gain.value - 4.0 * gain.tolerance), pytest.approx(gain.value + 4.0 * gain.tolerance),
    )  # fmt: skip
    for change in (0.0, -1.0):
        exact = allowed_of(SHIPPED, replace(gain, tolerance=change))
        assert exact[0] < gain.value - 9.0 * gain.tolerance or exact[0] == 0.0
    wide = allowed_of(SHIPPED, replace(by["linkage.vigv_play"], tolerance=100.0))
    assert wide == (0.0, 10.0)  # the bounds of `hysteresis` in geometry.toml
    assert allowed_of(SHIPPED, replace(by["linkage.vigv_lc"], tolerance=1e6)) == (10.0, 2000.0)
    bias = allowed_of(SHIPPED, replace(by["sensors.vigv_bias"], tolerance=1e6))
    assert bias[0] < 0.0 < bias[1]


def test_a_model_fills_rows_in_si_and_leaves_its_base() -> None:
    before = SHIPPED.p.copy()
    made = Model(parameters={"linkage.vgv1_play": 1.0}, effects={"linkage_backlash": {"vgv1": 0.25}}).plant(SHIPPED)
    ldp, lever = SHIPPED.lever(1)
    assert made.p[PLAY + 1, 0] == pytest.approx(math.radians(1.0) * lever / ldp)
    assert made.p[LINKAGE_BACKLASH + 1, 0] == pytest.approx(math.radians(0.25)) and made.p[LINKAGE_BACKLASH, 0] == 0.0
    assert np.array_equal(SHIPPED.p, before) and made.table is SHIPPED.table
    at = next(n for n in SHIPPED.nominal if n.name == "supply.pressure")
    assert Model(parameters={at.name: at.value * 1.01}).plant(SHIPPED).p[at.row, 0] == pytest.approx(1.01e6 * at.value)
    bent = Model(curves={"c": law()}, effects={"c": {"c1": 3.0, "c2": 3.0, "c3": 3.0, "c4": 3.0}}).plant(SHIPPED)
    first = CURVES + 1 + C_TABLE
    assert bent.p[CURVES, 0] == 1.0 and bent.p[first : first + POINTS, 0] == pytest.approx(np.full(POINTS, 3e-3))
    assert Model(curves={"c": law()}).plant(SHIPPED).p[CURVES, 0] == 0.0  # it acts where its effect says so
    endless = Model(curves={"c": law(values=[1e308] * 4)}, effects={"c": {"c2": -1e308}})
    with pytest.raises(InputError, match="model: a number that follows .* is not finite"):
        endless.plant(replace(SHIPPED, p=np.where(SHIPPED.p == value_of("engine.lag"), np.inf, SHIPPED.p)))


# ---- machines --------------------------------------------------------------------------------------------------------


def test_noise_and_usual_values_are_those_of_the_tables() -> None:
    shipped, electric = build_plant(), build_plant("plant_electromechanical.toml")
    for machine in (shipped, electric):
        sensors = machine.table.sensors
        pot = math.radians(sensors.pot_noise.value)
        assert machine.sigma == pytest.approx([1e-3 * sensors.lvdt_noise.value, *[pot] * 3, sensors.speed_noise.value])
        assert machine.usual["t_oil"] == machine.table.supply.temperature.value and machine.vanes == OWN
    assert shipped.usual["p_s"] == value_of("supply.pressure") and electric.usual["p_s"] == 0.0
    assert shipped.usual_within == {"p_s": 2.1, "t_oil": 40.0} and electric.usual_within == {"p_s": 0.0, "t_oil": 0.0}
    assert shipped.kind == "hydraulic" and electric.kind == "electromechanical"
    assert shipped.p[KIND, 0] == 0.0 and electric.p[KIND, 0] == 1.0 and (shipped.p[VANE_COUNT] == 3.0).all()
    assert not shipped.rows.flags.writeable and set(shipped.rows) != set(electric.rows)
    step = 1e-3 * shipped.table.sensors.lvdt_range.value / 2 ** int(shipped.table.sensors.lvdt_bits.value)
    assert shipped.p[LVDT_STEP, 0] == pytest.approx(step)
    for k, s in enumerate(shipped.geometry.stages()):
        ring = math.radians(s.hysteresis.value) * s.l.value / s.ld_prime.value
        assert shipped.p[PLAY + k, 0] == pytest.approx(ring)
    made = build_plant(model=Model(parameters={"actuator.flow_gain": value_of("actuator.flow_gain") * 1.01}))
    assert (made.p != SHIPPED.p).any() and np.array_equal(build_plant().p, SHIPPED.p)


def test_a_machine_has_the_parameters_of_its_own_stages_and_never_less_than_no_play() -> None:
    own = SHIPPED.parameters_of("linkage_backlash")
    assert list(own) == [ROW["linkage_backlash"] + k for k in range(3)] and [q.name for q in own.values()] == list(OWN)
    declared = EFFECTS["linkage_backlash"].parameters
    for q, d in zip(own.values(), declared, strict=False):
        play = SHIPPED.geometry.stage(q.vane).hysteresis.value
        assert q.low == max(d.low, -play) and q.high == d.high
    assert list(SHIPPED.parameters_of("valve_dead_band")) == [ROW["valve_dead_band"]]


@pytest.mark.parametrize("stage", range(3))
def test_a_ring_goes_where_its_vane_is_as_far_as_its_play_allows(stage: int) -> None:
    p = SHIPPED.p.copy()
    p[POT_BIAS + stage], p[POT_BIAS_ERROR + stage], p[POT_GAIN + stage] = 0.01, 0.02, 1.25
    machine = replace(SHIPPED, p=p)
    s = machine.start(0.024, 60.0)
    middle = s[RING + stage, 0]
    ldp, lever = machine.lever(stage)
    half, slope = 0.5 * p[PLAY + stage, 0], ldp / lever

    def reading(ring: float) -> float:
        return 1.25 * linkage.vane_angle(ring, ldp, lever) + 0.03

    for off, expected in ((0.0, 0.0), (0.5 * half, 0.5 * half), (-9.0 * half, -half), (9.0 * half, half)):
        angles = [math.nan] * 3
        angles[stage] = reading(middle + off)
        machine.place_rings(s, tuple(angles))
        assert s[RING + stage, 0] == pytest.approx(middle + expected, abs=1e-12) == s[DRIVEN + stage, 0]
        assert s[POT + stage, 0] == pytest.approx(reading(middle + expected))
    assert slope > 1.0
    others = [k for k in range(3) if k != stage]
    assert s[[RING + k for k in others]].tolist() == SHIPPED.start(0.024, 60.0)[[RING + k for k in others]].tolist()


def test_a_wider_play_reaches_farther() -> None:
    p = SHIPPED.p.copy()
    p[LINKAGE_BACKLASH] = 0.01  # rad, at the vane
    machine = replace(SHIPPED, p=p)
    s = machine.start(0.024, 60.0)
    middle, (ldp, lever) = s[RING, 0], machine.lever(0)
    machine.place_rings(s, (1.5, math.nan, math.nan))
    assert s[RING, 0] == pytest.approx(middle + 0.5 * (p[PLAY, 0] + 0.01 * lever / ldp))


def test_a_ring_that_is_placed_reads_as_asked_at_the_first_tick_with_any_effects() -> None:
    sizes = {
        "linkage_friction": 0.4, "linkage_wear": 30.0, "thermal_growth": 0.01, "ring_eccentricity": 0.2,
        "crank_length_error": 0.5, "link_length_error": 0.2, "pot_gain": 1.04, "pot_bias": 0.7,
    }  # fmt: skip
    effects = {name: dict.fromkeys(OWN, v) for name, v in sizes.items()} | {"linkage_compliance": {"compliance": 0.1}}
    curves = {
        "crank": law(at="linkage.crank", values=[0.1] * 4),
        "ring": law(at="linkage.vigv_ring", values=[0.3] * 4),
        "pot": law(at="sensors.vgv1", how="times", values=[0.1] * 4),
    }
    machine = Model(effects={**effects, "crank": {}, "ring": {}, "pot": {}}, curves=curves).plant(SHIPPED)
    s = machine.start(0.024, 90.0, 75.0)
    machine.place_rings(s, (-1.0, -1.0, -1.0), 90.0, 75.0)
    low = s[POT : POT + 3, 0].copy()
    machine.place_rings(s, (1.0, 1.0, 1.0), 90.0, 75.0)
    resting = 0.5 * (low + s[POT : POT + 3, 0])
    asked = tuple(resting + np.array([2e-3, -2e-3, 0.0]))
    machine.place_rings(s, asked, 90.0, 75.0)
    assert s[POT : POT + 3, 0] == pytest.approx(asked, abs=1e-12)
    rings = s[RING : RING + 3, 0].copy()
    chain.vane_step(s, machine.p, 0, 90.0, 75.0)
    assert s[RING : RING + 3, 0].tolist() == rings.tolist()
    assert s[POT : POT + 3, 0] == pytest.approx(asked, abs=1e-12)


def test_names_of_parameters_belong_to_the_kind_of_actuator() -> None:
    hydraulic, motor = (names_of(kind, OWN) for kind in KINDS)
    assert "valve.bandwidth" in hydraulic and "drive.rated_current" not in hydraulic
    assert not any(n.startswith(("valve.", "supply.pressure")) or n == "actuator.area" for n in motor)
    assert "actuator.stroke" in motor and motor["drive.rated_speed"] == KIND + 1
    assert motor["drive.rated_current"] == hydraulic["valve.rated_current"]
    for names in (hydraulic, motor):
        assert len(set(names.values())) == len(names) and not any("vgv3" in n for n in names)
    for machine in (build_plant(), build_plant("plant_electromechanical.toml")):
        names = [n.name for n in machine.nominal]
        lengths = [f"linkage.{v}_{key}" for v in OWN for key in ("lc", "l")]
        assert names == [*names_of(machine.kind, OWN), *lengths]
        for n in machine.nominal:
            if "play" not in n.name:
                assert machine.p[n.row, 0] == pytest.approx(n.value * n.si), n.name


@pytest.mark.parametrize("text, says", [
    ("[actuator]\nkind = 'steam'", r"actuator.kind \(='steam'\) must be one of hydraulic, electromechanical"),
    ("[actuator]\nkind = 3", r"actuator.kind \(=3\) must be one of"), ("actuator = 3", "actuator"), ("", "is missing"),
])  # fmt: skip
def test_a_plant_of_no_known_kind_is_refused(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(InputError, match=says):
        read_plant(tmp_path / "p.toml")


def test_which_way_a_chain_runs_follows_from_its_effects() -> None:
    for effects, expected in (
        ({}, (0, False)), ({"valve_dead_band": {"half_width": 1.0}}, (1, False)),
        ({"aero_load": {"force": 900.0}}, (2, False)), ({"linkage_wear": {"vigv": 1.0}}, (0, True)),
    ):  # fmt: skip
        assert chain_lanes.way(Model(effects=effects).plant(SHIPPED).p) == expected
    assert chain_lanes.way(ELECTRIC.p) is None
    assert chain_lanes.way(Model(curves={"c": law()}, effects={"c": {}}).plant(SHIPPED).p) is None


# ---- blocks of lanes -------------------------------------------------------------------------------------------------


class Pair(NamedTuple):
    """Two numbers."""

    a: float
    b: float


def test_a_block_has_a_row_of_lanes_for_each_name() -> None:
    layout = lanes.block(4, Pair, more=("c",), each=(3, (), ("d",)))
    assert layout.names == ("a", "b", "c", "d")
    assert [layout[n].shape for n in layout.names] == [(4,), (4,), (4,), (3, 4)]
    assert lanes.block(2, Pair).names == ("a", "b") and lanes.block(2, Pair).itemsize == 2 * 2 * 8
    for more, each in ((("a",), (0, (), ())), (("c",), (2, (), ("c",))), (("c",), (2, (Pair,), ()))):
        with pytest.raises(ValueError, match="a name stands twice among a, b"):
            lanes.block(4, Pair, more=more, each=each)


def test_what_was_put_is_got_and_filled() -> None:
    row = np.zeros(1, lanes.block(4, Pair, each=(3, (), ("d_a", "d_b"))))[0].view(np.recarray)
    uncompiled = SimpleNamespace(**{n: row[n] for n in row.dtype.names})
    put, get, known = (f.py_func for f in (lanes.putter(Pair), lanes.getter(Pair), lanes.getter(Pair, b=7.0)))
    put(uncompiled, 2, Pair(1.0, 2.0))
    assert get(uncompiled, 2) == Pair(1.0, 2.0) and known(uncompiled, 2) == Pair(1.0, 7.0)
    assert get(uncompiled, 1) == Pair(0.0, 0.0)
    lanes.putter(Pair, "k", "d_").py_func(uncompiled, 1, 3, Pair(5.0, 6.0))
    assert lanes.getter(Pair, "k", "d_").py_func(uncompiled, 1, 3) == Pair(5.0, 6.0) and row["d_a"].sum() == 5.0
    fill, back = (lanes.filler({"a": 0, "d_a": 3}, "", put).py_func for put in (False, True))
    record = SimpleNamespace(a=0.0, d_a=np.zeros(3))
    fill(uncompiled, 2, record)
    assert record.a == 1.0 and record.d_a.tolist() == [0.0, 0.0, 0.0]
    record.a, record.d_a[:] = 9.0, (1.0, 2.0, 3.0)
    back(uncompiled, 0, record)
    assert row["a"].tolist() == [9.0, 0.0, 1.0, 0.0] and row["d_a"][:, 0].tolist() == [1.0, 2.0, 3.0]
    assert (
        lanes.getter(Pair).targetoptions["forceinline"] and lanes.getter(Pair).targetoptions["error_model"] == "numpy"
    )


# ---- geometry --------------------------------------------------------------------------------------------------------


def test_geometry_is_flat_in_si() -> None:
    g, table = SHIPPED.geometry.arrays(), SHIPPED.geometry
    c = table.crank
    assert g[:4] == pytest.approx([1e-3 * q.value for q in (c.lx0, c.x1, c.y1, c.le)])
    built = table.arrays(initial=True)
    for k, s in enumerate(table.stages()):
        o = linkage.N_CRANK + k * linkage.N_PER_STAGE
        long = 1e-3 * math.hypot(s.dx.value, s.dy.value)
        turn = math.radians(270.0 + s.theta6.value)
        lengths = [1e-3 * q.value for q in (s.lb, s.lc, s.ld, s.ld_prime, s.l)]
        expected = [*lengths, long * math.cos(turn), long * math.sin(turn), math.radians(s.hysteresis.value)]
        assert g[o : o + 8] == pytest.approx(expected)
        assert (
            built[o] == pytest.approx(1e-3 * s.lb_initial.value)
            and built[o + 1 : o + 8].tolist() == g[o + 1 : o + 8].tolist()
        )
    assert len(g) == 4 + 3 * 8 and (linkage.STROKE_LOW, linkage.STROKE_HIGH) == (-2e-3, 50e-3)


def test_the_stroke_for_an_angle_reaches_a_little_beyond_the_stops() -> None:
    g = SHIPPED.geometry
    low, high = (float(vane_angles(x, g)[0, 0]) for x in (-2e-3, 50e-3))
    for angle, stroke in ((low, -2e-3), (high, 50e-3)):
        assert stroke_for_vigv(angle, g) == pytest.approx(stroke, abs=1e-9)
    assert stroke_for_vigv(vane_angles([0.01, 0.03], g)[:, 0], g) == pytest.approx([0.01, 0.03], abs=1e-9)
    for angle in (low - 1e-6, high + 1e-6):
        with pytest.raises(InputError, match=r"vigv angle \(=.* deg\) must be in \[.*\], what the stroke can give"):
            stroke_for_vigv(angle, g)


def schedule_with(**values: list[float]) -> Schedules:
    """A schedule of one stage."""
    given = {"speed": [30.0, 40.0, 70.0, 102.0, 110.0], "vigv": [0.0, 0.0, 5.0, 9.0, 9.0]} | values
    units = {"speed": "%"}
    return Schedules.model_validate(
        {k: {"values": v, "unit": units.get(k, "deg"), "origin": "chosen: a test"} for k, v in given.items()}
    )


def test_angles_rise_where_the_engine_works_and_never_fall() -> None:
    made = schedule_with()
    assert made.vanes == ("vigv",) and made.targets(55.0) == pytest.approx(np.radians([[2.5]]))
    assert made.targets([0.0, 200.0]) == pytest.approx(np.radians([[0.0], [9.0]]))
    speeds, angles = made.arrays()
    assert speeds.tolist() == [30.0, 40.0, 70.0, 102.0, 110.0] and angles == pytest.approx(
        np.radians([[0, 0, 5, 9, 9]]).T
    )
    for speed, vigv, says in (
        ([30.0, 41.0, 70.0, 102.0, 110.0], [0.0, 0.0, 5.0, 9.0, 9.0], r"vigv.values\[1\] \(=0\) must be greater"),
        ([30.0, 40.0, 70.0, 101.0, 110.0], [0.0, 0.0, 5.0, 9.0, 9.0], r"vigv.values\[4\] \(=9\) must be greater"),
        ([30.0, 40.0, 70.0, 102.0, 110.0], [0.0, -0.1, 5.0, 9.0, 9.0], r"vigv.values\[1\] \(=-0.1\)"),
        ([30.0, 40.0, 70.0, 102.0, 110.0], [0.0, 0.0, 5.0, 9.0, 8.9], r"vigv.values\[4\]"),
        ([30.0, 40.0, 70.0, 102.0], [0.0, 0.0, 5.0, 9.0, 9.0], "vigv.values has 5 numbers, speed.values has 4"),
        ([30.0, 40.0, 40.0, 102.0, 110.0], [0.0, 0.0, 5.0, 9.0, 9.0], "speed"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=says):
            schedule_with(speed=speed, vigv=vigv)
    assert load_schedules().vanes == OWN


def test_two_lengths_stand_for_all_within_the_sum_of_their_tolerances() -> None:
    g = SHIPPED.geometry
    found = length_tolerances(g)
    assert list(found) == [f"{v}_{key}" for v in OWN for key in ("lc", "l")]
    for name, tolerance in found.items():
        stage, key = name.split("_")
        assert tolerance >= getattr(g.stage(stage), key).tolerance * (1.0 - 1e-9)
    exact = g.vigv.l.model_copy(update={"tolerance": 0.0})
    without = g.model_copy(update={"vigv": g.vigv.model_copy(update={"l": exact})})
    assert list(length_tolerances(without)) == list(found)[2:]


def test_a_geometry_assembles_over_the_whole_stroke_and_no_farther_than_it_does() -> None:
    g = SHIPPED.geometry.arrays()
    linkage.check_assembly(g)
    for k in range(3):
        low, high = linkage.assembly_range(g, k)
        assert low < -2e-3 and high > 50e-3
        one = np.concatenate([g[:4], g[4 + 8 * k : 12 + 8 * k]])
        linkage.check_assembly(one, low, high, 1e-3)
        for beyond in (low - 2e-9, high + 2e-9):
            with pytest.raises(InputError, match="cannot be assembled at stroke"):
                linkage.check_assembly(one, beyond, beyond)
        assert linkage.assembly_range(g, k, 0.03) == pytest.approx((low, high), abs=2e-9)
        with pytest.raises(InputError, match="cannot be assembled"):
            linkage.assembly_range(g, k, high + 1e-3)


def test_a_linkage_is_tried_every_tenth_of_a_millimetre_and_to_half_a_metre(monkeypatch: pytest.MonkeyPatch) -> None:
    g, asked = SHIPPED.geometry.arrays(), []
    monkeypatch.setattr(linkage, "_fault", lambda stroke, g, k: asked.append((k, stroke)) or (0, 0.0, 0.0, 0.0))
    linkage.check_assembly(g)
    assert asked == [(k, x) for k in range(3) for x in np.linspace(-2e-3, 50e-3, 521).tolist()]
    asked.clear()
    linkage.check_assembly(g, 0.01, 0.01)
    assert asked == [(k, 0.01) for k in range(3) for _ in range(2)]
    assert linkage.assembly_range(g, 1) == pytest.approx((0.024 - 0.5, 0.024 + 0.5), abs=1.5e-3)


# ---- in space --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("joint", list(Clearances.__dataclass_fields__))
def test_a_clearance_is_none_to_five_millimetres(joint: str) -> None:
    for value in (0.0, 5.0):
        Clearances(**{joint: value}).check()
    for value in (-1e-9, 5.01, math.nan):
        with pytest.raises(InputError, match=rf"clearance {joint} \(=.* mm\) must be in \[0, 5\]"):
            Clearances(**{joint: value}).check()
    assert getattr(Clearances(), joint) == 0.0


def test_a_lever_pin_s_clearance_is_felt_whole() -> None:
    """The vane lags by half the pin's clearance over the lever, each way."""
    g = load_geometry()
    width = clearance_width(g, "vigv", Clearances(lever_pin=0.2))
    s = g.vigv
    assert width == pytest.approx(math.degrees(0.2 / s.l.value), rel=0.05)
    assert clearance_width(g, "vigv", Clearances()) == pytest.approx(0.0, abs=1e-9)
    assert clearance_width(g, "vigv", Clearances(ring=0.5), vane=0.0) == pytest.approx(0.0, abs=0.02)


def test_a_width_is_the_ring_s_mean_over_the_stroke_and_each_joint_s_that_of_it_alone() -> None:
    g, given = load_geometry(), Clearances(actuator=0.1, crank_link=0.1, ring=0.4)
    ratio = g.vgv1.l.value / g.vgv1.ld_prime.value
    out, back = clearance_loop(g, "vgv1", np.linspace(0.0, 48.0, 13), given)
    rings = [np.arctan(ratio * np.sin(np.radians(a))) for a in (out, back)]
    assert clearance_width(g, "vgv1", given) == pytest.approx(np.degrees((rings[1] - rings[0]).mean() / ratio))
    for how in ({}, {"vane": -60.0}, {"offset": 8.0}):
        alone = contributions(g, "vgv1", given, **how)
        assert alone == {
            joint: clearance_width(g, "vgv1", Clearances(**{joint: getattr(given, joint)}), **({"vane": -90.0} | how))
            for joint in Clearances.__dataclass_fields__
        }
    at_rest = contributions(g, "vgv1", given)
    assert contributions(g, "vgv1", given, -90.0, 0.0) == at_rest and at_rest["crank_pivot"] == 0.0
    assert at_rest["ring"] != contributions(g, "vgv1", given, -60.0)["ring"]
    width = at_rest["ring"] + 0.05
    found = clearance_for(g, "vgv1", width, Clearances(), "ring")
    assert found == clearance_for(g, "vgv1", width, Clearances(), "ring", -90.0, 0.0) != 0.4
    assert clearance_for(g, "vgv1", width, Clearances(), "ring", -60.0) > found


def test_a_width_that_no_clearance_gives_is_refused() -> None:
    g = load_geometry()
    others = Clearances(lever_pin=0.2)
    alone = clearance_width(g, "vigv", others)
    assert clearance_for(g, "vigv", alone, others, "crank_link") == pytest.approx(0.0, abs=1e-5)
    for width in (0.9 * alone, 50.0):
        with pytest.raises(InputError, match=r"vigv: no clearance of crank_link gives a width of .* deg, 5 mm of it"):
            clearance_for(g, "vigv", width, others, "crank_link")


def test_freedoms_of_a_ring_grow_with_their_amount() -> None:
    g = load_geometry()
    one, two = (freedoms(g, "vigv", 24.0, amount=a) for a in (0.5, 1.0))
    assert list(one) == ["across", "along", "tilt_across", "tilt_along"]
    assert two["across"] == pytest.approx(2.0 * one["across"], rel=0.02) and two["tilt_across"] == 0.0
    assert freedoms(g, "vigv", 24.0) == two
    assert spatial_angles(g, "vigv", 24.0).shape == (1,)
