"""Shipped tables load and say where their numbers come from; a wrong table is refused in one line; strokes follow from
the linkage.
"""

# ruff: noqa: D103 - a test's name is its claim
from __future__ import annotations

import copy
import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controller import load_calibration
from controller.calibration import AngleTable, CalibrationTable, StrokeTable
from hil.engine_test import EngineTestTable
from plant import build_plant
from plant.geometry import Geometry, Schedules, load_geometry, load_schedules
from plant.parameters import ElectromechanicalTable, PlantTable, load_plant
from tests.conftest import examples
from vaneloop.base.errors import InputError
from vaneloop.base.tables import Bound, Quantity, load_toml, path, read
from vaneloop.design.schedule_files import write_stroke_tables, write_vane_angles
from vaneloop.design.stroke_tables import stroke_tables, vane_angle_table

MODELS = {
    "calibration.toml": CalibrationTable,
    "engine_test.toml": EngineTestTable,
    "geometry.toml": Geometry,
    "plant.toml": PlantTable,
    "plant_electromechanical.toml": ElectromechanicalTable,
    "plant_two_actuators.toml": PlantTable,
    "schedules.toml": Schedules,
    "stroke_tables.toml": StrokeTable,
    "vane_angles.toml": AngleTable,
}
# what a program calls with a table, flattening included
LOADERS = {
    "calibration.toml": load_calibration,
    "engine_test.toml": lambda f: read(f, EngineTestTable),
    "geometry.toml": lambda f: load_plant(geometry=f),
    "plant.toml": load_plant,
    "plant_electromechanical.toml": load_plant,
    "plant_two_actuators.toml": load_plant,
    "schedules.toml": load_schedules,
    "stroke_tables.toml": lambda f: load_calibration(strokes=f),
    "vane_angles.toml": lambda f: load_calibration(angles=f),
}
SHIPPED = {name: tomllib.loads(path(name).read_text(encoding="utf-8")) for name in MODELS}


def toml(value: Any) -> str:
    """A value as TOML; whole documents come from `document`."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(toml(v) for v in value) + "]"
    if isinstance(value, float):
        return repr(value)  # nan, inf and 1e+30 are TOML, too
    return json.dumps(value)


def document(data: dict[str, Any]) -> str:
    return "\n".join(f"{json.dumps(k)} = {toml(v)}" for k, v in data.items()) + "\n"


def walk(data: Any, at: tuple = ()) -> Iterator[tuple]:
    """Path of every key and list entry."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield (*at, key)
        yield from walk(value, (*at, key))


def parent(data: Any, at: tuple) -> Any:
    for step in at[:-1]:
        data = data[step]
    return data


def refusal(tmp_path, name: str, content: str | bytes) -> str:
    """The one line with which a table of this kind is refused."""
    file = tmp_path / name
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as e:
        LOADERS[name](file)
    text = str(e.value)
    assert "\n" not in text and "\r" not in text and str(file) in text
    return text.removeprefix(f"{file}: ")


def edited(name: str, at: str, value: Any) -> str:
    """A shipped table with the value at a dotted key replaced; ... removes the key."""
    data = copy.deepcopy(SHIPPED[name])
    keys = tuple(int(k) if k.isdigit() else k for k in at.split("."))
    if value is ...:
        del parent(data, keys)[keys[-1]]
    else:
        parent(data, keys)[keys[-1]] = value
    return document(data)


# ---- what is shipped -------------------------------------------------------------------------------------------------


def test_every_shipped_table_has_its_model():
    assert {f.name for f in path("").glob("*.toml")} == set(MODELS)


@pytest.mark.parametrize("name", MODELS)
def test_every_shipped_table_loads_by_name_and_by_path(name):
    assert read(name, MODELS[name]) == read(path(name), MODELS[name])
    LOADERS[name](name)


@pytest.mark.parametrize("name", MODELS)
def test_every_number_has_a_unit_and_an_origin_that_says_published_derived_or_chosen(name):
    numbers = 0
    for at in walk(SHIPPED[name]):
        value = parent(SHIPPED[name], at)[at[-1]]
        if isinstance(value, int | float) and not isinstance(value, bool):
            holder = SHIPPED[name]
            for step in at:
                if isinstance(holder, dict) and "origin" in holder:
                    break
                holder = holder[step]
            assert isinstance(holder, dict) and "unit" in holder, at
            kind, _, why = holder["origin"].partition(":")
            assert kind in ("published", "derived", "chosen") and len(why.strip()) >= 4, (at, holder["origin"])
            numbers += 1
    assert numbers > 10


@pytest.mark.parametrize("name", MODELS)
def test_every_quantity_is_bounded_on_both_sides(name):
    def check(model):
        for key, field in model.model_fields.items():
            inner = field.annotation
            bound = next((m for m in field.metadata if isinstance(m, Bound)), None)
            if bound is not None:
                assert np.isfinite([bound.low, bound.high]).all() and bound.low < bound.high, (model.__name__, key)
            elif hasattr(inner, "model_fields"):
                assert not issubclass(inner, Quantity), f"{model.__name__}.{key} has no bound"
                check(inner)

    check(MODELS[name])


@pytest.mark.parametrize("name", MODELS)
def test_the_tests_own_writer_keeps_every_value(name):
    assert tomllib.loads(document(SHIPPED[name])) == SHIPPED[name]


# ---- what is refused -------------------------------------------------------------------------------------------------

WRONG = [
    # NaN, infinity, out of bounds
    ("calibration.toml", "servo.kp.value", float("nan"), "servo.kp.value (=nan): Input should be a finite number"),
    ("calibration.toml", "servo.kp.value", float("inf"), "servo.kp.value (=inf): Input should be a finite number"),
    ("calibration.toml", "servo.kp.value", -1.0, "kp (=-1 mA/mm) must be in [0, 1000]"),
    ("plant.toml", "valve.damping.value", 1.2, "damping (=1.2 -) must be in [0.05, 0.99]"),
    (
        "plant.toml",
        "valve.damping.tolerance",
        -0.1,
        "valve.damping.tolerance (=-0.1): Input should be greater than or equal to 0",
    ),
    (
        "stroke_tables.toml",
        "extension.values.3",
        float("nan"),
        "extension.values.3 (=nan): Input should be a finite number",
    ),
    # order and length
    (
        "stroke_tables.toml",
        "speed.values.5",
        44,
        "speed.values[5] (=44) must be greater than the value before it (=44)",
    ),
    (
        "stroke_tables.toml",
        "extension.values.5",
        3.0,
        "extension.values[5] (=3) must not be less than the value before it (=3.1682)",
    ),
    (
        "stroke_tables.toml",
        "single.values.65",
        47.5,
        "single.values[65] (=47.5) must lie between retraction (=45.6868) and extension (=47.1267)",
    ),
    ("stroke_tables.toml", "single.values.65", ..., "single.values has 65 numbers; speed has 66"),
    ("stroke_tables.toml", "speed.values", [40.0], "speed.values (=[40.0]): List should have at least 2 items"),
    (
        "schedules.toml",
        "vigv.values.10",
        -30.0,
        "vigv.values[10] (=-30) must be greater than the value before it (=-12.9)",
    ),
    ("engine_test.toml", "dwell.values.0", ..., "dwell.values has 49 numbers; speed has 50"),
    # missing keys
    ("calibration.toml", "servo.kp", ..., "key 'servo.kp' is missing; allowed here: kp, ki, kff, current_limit"),
    ("calibration.toml", "servo", ..., "key 'servo' is missing; allowed here: trend, schedule, servo"),
    (
        "calibration.toml",
        "servo.kp.origin",
        ...,
        "key 'servo.kp.origin' is missing; allowed here: value, unit, origin, tolerance",
    ),
    # unit, type
    ("calibration.toml", "servo.kp.unit", "A/mm", "kp.unit (='A/mm') must be 'mA/mm'"),
    ("geometry.toml", "crank.le.unit", "m", "le.unit (='m') must be 'mm'"),
    ("calibration.toml", "servo.kp.value", "16", "servo.kp.value (='16'): Input should be a valid number"),
    ("calibration.toml", "servo.kp.value", True, "servo.kp.value (=True): Input should be a valid number"),
    ("calibration.toml", "servo.kp.value", [16.0], "servo.kp.value (=[16.0]): Input should be a valid number"),
    (
        "calibration.toml",
        "servo.kp",
        16.0,
        "servo.kp (=16.0): must be a table with the keys value, unit, origin, tolerance",
    ),
    ("calibration.toml", "servo", 16.0, "servo (=16.0): must be a table with the keys kp, ki, kff, current_limit"),
    ("calibration.toml", "servo.kp.origin", "", "servo.kp.origin (=''): String should have at least 4 characters"),
    (
        "calibration.toml",
        "schedule.strategy",
        "tripple",
        "strategy (='tripple') must be one of single, dual, inverse, adaptive",
    ),
    ("calibration.toml", "schedule.table_input", "n_x", "table_input (='n_x') must be n_r or n_dem"),
    # possible one by one, not together
    (
        "calibration.toml",
        "schedule.stroke_min.value",
        47.6,
        "stroke_min (=47.6 mm) must be below stroke_max (=47.5 mm)",
    ),
    (
        "calibration.toml",
        "fail_safe.fail_safe_stroke.value",
        48,
        "fail_safe.fail_safe_stroke (=48 mm) must be in [0.5, 47.5]",
    ),
    (
        "calibration.toml",
        "fail_safe.fail_safe_current.value",
        -41,
        "fail_safe.fail_safe_current (=-41 mA) must be in [-40, 40]",
    ),
    ("calibration.toml", "demand_monitor.demand_high.value", 0.0, "demand_high (=0 %) must be in [1, 150]"),
    (
        "calibration.toml",
        "lvdt_monitor.lvdt_low.value",
        0.5,
        "lvdt_monitor.lvdt_low (=0.5 mm) must be below stroke_min (=0.5 mm)",
    ),
    (
        "calibration.toml",
        "lvdt_monitor.lvdt_high.value",
        40,
        "lvdt_monitor.lvdt_high (=40 mm) must be above stroke_max (=47.5 mm)",
    ),
    (
        "calibration.toml",
        "lvdt_monitor.stuck_margin.value",
        30,
        "lvdt_monitor.stuck_margin (=30 mm) must be below 23.5",
    ),
    (
        "calibration.toml",
        "lvdt_monitor.stuck_current.value",
        40,
        "lvdt_monitor.stuck_current (=40 mA) must be below current_limit (=40 mA)",
    ),
    ("geometry.toml", "crank.le.value", 900, "cannot be assembled"),
]


@pytest.mark.parametrize(
    ("name", "at", "value", "said"),
    WRONG,
    ids=[f"{at}={value}" if value is not ... else f"no {at}" for _, at, value, _ in WRONG],
)
def test_a_wrong_value_is_refused_in_one_line_with_key_value_and_what_is_allowed(tmp_path, name, at, value, said):
    assert said in refusal(tmp_path, name, edited(name, at, value))


@pytest.mark.parametrize(
    ("name", "right", "wrong", "key"),
    [
        (
            "calibration.toml",
            "[servo]",
            "[sevro]",
            "'sevro' is unknown, probably 'servo' is meant; allowed here: trend, schedule, servo",
        ),
        (
            "calibration.toml",
            "kff =",
            "kf =",
            "'servo.kf' is unknown, probably 'kff' is meant; allowed here: kp, ki, kff, current_limit",
        ),
        (
            "calibration.toml",
            "kp = { value",
            "kp = { valeu",
            "'servo.kp.valeu' is unknown, probably 'value' is meant; allowed here: value, unit,",
        ),
        (
            "plant.toml",
            'tolerance = 0.12, origin = "chosen: small',
            'tolerence = 0.12, origin = "chosen: small',
            "'engine.lag.tolerence' is unknown, probably 'tolerance'",
        ),
        ("geometry.toml", "theta6", "theta_6", "'vigv.theta_6' is unknown, probably 'theta6' is meant"),
        ("stroke_tables.toml", "[retraction]", "[retracton]", "'retracton' is unknown, probably 'retraction' is meant"),
        (
            "stroke_tables.toml",
            "[retraction]",
            "[zzz]",
            "'zzz' is unknown; allowed here: speed, extension, retraction, single",
        ),
    ],
)
def test_a_misspelt_key_is_refused_with_the_key_that_was_probably_meant(tmp_path, name, right, wrong, key):
    text = path(name).read_text(encoding="utf-8")
    assert right in text
    assert key in refusal(tmp_path, name, text.replace(right, wrong, 1))


def test_a_demand_range_without_width_is_refused(tmp_path):
    data = copy.deepcopy(SHIPPED["calibration.toml"])
    data["demand_monitor"]["demand_low"]["value"] = data["demand_monitor"]["demand_high"]["value"] = 50.0
    said = refusal(tmp_path, "calibration.toml", document(data))
    assert said == "demand_monitor.demand_low (=50 %) must be below demand_high (=50 %)"


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n",
        b"servo",
        b"= 3",
        b"[servo",
        b"\xff\xfe\x00\x01\x80" * 50,
        bytes(range(256)),
        b"PK\x03\x04" + b"\x00" * 100,
        b"x = " + b"[" * 5000,
    ]
    + [b"n = 1" + b"0" * 5000, b"a = 1\na = 2", b"time,n_dem\n0,60\n", b'{"servo": 1}'],
    ids=range(13),
)
def test_what_is_not_a_table_is_refused(tmp_path, name, content):
    refusal(tmp_path, name, content)


@pytest.mark.parametrize("name", MODELS)
def test_a_missing_file_a_folder_and_an_impossible_name_are_refused(tmp_path, name):
    for source in (tmp_path / "no.toml", tmp_path, "no_such_table.toml", "x" * 5000, "a\0b", ""):
        with pytest.raises(InputError) as e:
            LOADERS[name](source)
        assert "\n" not in str(e.value)
    with pytest.raises(InputError, match=r"no\.toml: cannot be read \(No such file or directory\)"):
        LOADERS[name](tmp_path / "no.toml")
    with pytest.raises(InputError, match=r"cannot be read \(Is a directory\)"):
        LOADERS[name](tmp_path)


def test_a_file_of_the_users_comes_before_a_shipped_one_of_that_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert read("plant.toml", PlantTable).engine.lag.value == 1.2
    (tmp_path / "plant.toml").write_text(edited("plant.toml", "engine.lag.value", 2.5), encoding="utf-8")
    assert read("plant.toml", PlantTable).engine.lag.value == 2.5


def test_a_byte_order_mark_and_windows_line_ends_are_no_error(tmp_path):
    file = tmp_path / "calibration.toml"
    file.write_bytes(b"\xef\xbb\xbf" + path(file.name).read_bytes().replace(b"\n", b"\r\n"))
    assert np.array_equal(load_calibration(file).k, load_calibration().k)


def test_an_unknown_strategy_is_refused():
    with pytest.raises(InputError, match=r"strategy \(='both'\) must be one of single, dual, inverse, adaptive"):
        load_calibration(strategy="both")


ODD = st.sampled_from(
    [
        float("nan"),
        float("inf"),
        -float("inf"),
        0,
        -1,
        1,
        1e30,
        -1e308,
        10**400,
        5e-324,
        "",
        "text",
        "mm",
        "nan",
        True,
        False,
        [],
        [1.0],
        ["a"],
        {},
        {"value": 1},
    ]
) | st.floats(-100, 200)


@settings(max_examples=examples(150), suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("name", MODELS)
@given(data=st.data())
def test_any_edit_of_a_table_gives_a_loaded_table_or_one_line(tmp_path, name, data):
    table = copy.deepcopy(SHIPPED[name])
    for _ in range(data.draw(st.integers(1, 3))):
        places = list(walk(table))
        if not places:
            break
        at = data.draw(st.sampled_from(places))
        holder, key = parent(table, at), at[-1]
        how = data.draw(st.sampled_from(["delete", "rename", "perturb", "add", "scale"]))
        if how == "delete":
            del holder[key]
        elif how == "rename" and isinstance(holder, dict):
            holder[data.draw(st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), max_size=8))] = (
                holder.pop(key)
            )
        elif how == "add" and isinstance(holder, dict):
            holder[f"{key}x"] = copy.deepcopy(data.draw(ODD))
        elif how == "scale" and isinstance(holder[key], int | float):
            holder[key] = float(np.clip(float(min(holder[key], 1e300)) * data.draw(st.floats(0.5, 1.5)), -1e300, 1e300))
        else:
            holder[key] = copy.deepcopy(data.draw(ODD))
    file = tmp_path / name
    file.write_text(document(table), encoding="utf-8")
    try:
        LOADERS[name](file)
    except InputError as e:
        assert len(str(e).splitlines()) == 1 and str(e).startswith(f"{file}: ")


@settings(max_examples=examples(200), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=300), st.integers(0, 3000))
def test_a_table_with_bytes_overwritten_gives_a_loaded_table_or_one_line(tmp_path, junk, where):
    raw = path("calibration.toml").read_bytes()
    file = tmp_path / "calibration.toml"
    file.write_bytes(raw[:where] + junk + raw[where + len(junk) :])
    try:
        load_calibration(file)
    except InputError as e:
        assert len(str(e).splitlines()) == 1 and str(e).startswith(f"{file}: ")


# ---- the stroke tables -----------------------------------------------------------------------------------------------


def test_the_shipped_stroke_tables_follow_from_geometry_schedules_and_hysteresis_to_their_last_digit(tmp_path):
    derived = stroke_tables(load_geometry(), load_schedules())
    shipped = read("stroke_tables.toml", StrokeTable)
    assert np.array_equal(derived[0], shipped.speed.values)
    for row, axis in zip(derived[1:], (shipped.extension, shipped.retraction, shipped.single), strict=True):
        assert np.array_equal(np.round(row, 4), axis.values)
    write_stroke_tables(derived, tmp_path / "again.toml", shipped.speed.origin)
    assert (tmp_path / "again.toml").read_text(encoding="utf-8") == path("stroke_tables.toml").read_text(
        encoding="utf-8"
    )


def test_the_shipped_vane_angles_follow_from_the_geometry_to_their_last_digit(tmp_path):
    from plant.geometry import vane_angles

    derived = vane_angle_table(load_geometry())
    shipped = read("vane_angles.toml", AngleTable)
    for row, key in zip(derived, ("stroke", "vigv", "vgv1", "vgv2"), strict=True):
        assert np.array_equal(np.round(row, 4), getattr(shipped, key).values)
    write_vane_angles(derived, load_geometry(), tmp_path / "again.toml", shipped.stroke.origin)
    assert (tmp_path / "again.toml").read_text(encoding="utf-8") == path("vane_angles.toml").read_text(encoding="utf-8")
    x, *angles = load_calibration().angles
    fine = np.linspace(x[0], x[-1], 2000)
    between = np.array([np.interp(fine, x, a) for a in angles]).T
    assert np.abs(np.rad2deg(between - vane_angles(fine, load_geometry()))).max() < 2e-3


def test_extension_needs_the_longest_stroke_and_retraction_the_shortest_at_every_speed():
    _, extension, retraction, single = load_calibration().table
    assert (extension > single).all() and (single > retraction).all()
    assert np.abs((extension + retraction) / 2 - single).max() < 0.1e-3


def test_the_vane_is_on_target_on_either_curve_with_the_play_taken_up():
    """Forward again, through the linkage: stroke of a curve, play of half the hysteresis, vane angle."""
    from plant.geometry import vane_angles

    geometry, schedules = load_geometry(), load_schedules()
    n, extension, retraction, single = load_calibration().table
    target = np.rad2deg(schedules.targets(n)[:, 0])
    half = 0.5 * geometry.vigv.hysteresis.value
    for strokes, lag in ((extension, half), (retraction, -half), (single, 0.0)):
        assert np.abs(np.rad2deg(vane_angles(strokes, geometry)[:, 0]) - lag - target).max() < 1e-4


def test_strokes_stay_off_the_calibrated_limits_and_on_the_machine():
    machine = build_plant()
    calibration = read("calibration.toml", CalibrationTable)
    strokes = load_calibration().table[1:] * 1e3
    assert (
        strokes.min() > calibration.schedule.stroke_min.value and strokes.max() < calibration.schedule.stroke_max.value
    )
    assert (
        calibration.schedule.stroke_min.value > 0.0
        and calibration.schedule.stroke_max.value < machine.table.actuator.stroke.value
    )
    assert calibration.servo.current_limit.value == machine.table.valve.rated_current.value


@pytest.mark.parametrize("text", ["a = {w}", "a = 0.{w}", "{w} = 1", "b.{w} = 1", "[{w}]", "a = [1, {w}]"])
def test_a_word_that_is_too_long_is_refused_with_its_line(text: str, tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text("x = 1\n" + text.format(w="1" * 1_000) + "\n")
    assert load_toml(file)["x"] == 1
    file.write_text("x = 1\n" + text.format(w="1" * 1_001) + "\n")
    with pytest.raises(InputError, match=r"a.toml: line 2: 1{30}\.\.\. is too long a word; allowed: 1,000 letters"):
        load_toml(file)
