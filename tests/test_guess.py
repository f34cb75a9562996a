"""A log maps itself: names and units of other benches are guessed, shown, and never guessed wrong."""

from __future__ import annotations

import datetime as dt
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hil.logs import LogError, read_log
from hil.logs.guess import ENOUGH, contradictions
from hil.logs.mapping import Bench, read_mapping, write_mapping
from hil.logs.mdf_write import write_groups
from hil.logs.names import is_time, meaning
from hil.logs.survey import sparkline, survey
from tests.conftest import ROOT, examples, quick_first
from tests.test_logs import DATA, data
from vaneloop.base.errors import InputError
from vaneloop.base.signals import UNITS
from vaneloop.cli.main import main
from vaneloop.verbs.machine import files_of

ROWS = 3000
SIGNALS = ("n_dem", "n_r", "x_dem", "x_lvdt", "i_cmd", "p_s", "t_oil", "vigv", "vgv1", "vgv2")
ALL = tuple(UNITS)


@pytest.fixture(scope="module")
def run() -> dict[str, np.ndarray]:
    """Thirty seconds of the example on one raster, by our own names, with a supply and an oil that are not exact."""
    log = read_log(ROOT / "examples" / "hidden_effect.parquet").channels
    t = log["n_r"].t[:ROWS]
    return {"t": t - t[0], **{s: np.interp(t, log[s].t, log[s].values) for s in SIGNALS}}


def table(
    path: Path,
    columns: dict[str, np.ndarray | list[str]],
    separator: str = ",",
    comma: bool = False,
    units: list[str] | None = None,
    encoding: str = "utf-8",
) -> Path:
    """Write a CSV as a bench would."""

    def cell(x: float | str) -> str:
        text = x if isinstance(x, str) else f"{x:.10g}"
        return text.replace(".", ",") if comma and not isinstance(x, str) else text

    lines = [separator.join(columns)] + ([separator.join(units)] if units else [])
    lines += [separator.join(map(cell, row)) for row in zip(*columns.values(), strict=True)]
    path.write_bytes(("\n".join(lines) + "\n").encode(encoding))
    return path


def same(path: Path, run: dict[str, np.ndarray], signals: tuple[str, ...] = SIGNALS, **reading: Any) -> list[str]:
    """Assert that the log reads as the run does; its notes."""
    log = read_log(path, **reading)
    for s in signals:
        assert s in log.channels, (s, log.notes)
        np.testing.assert_allclose(log.channels[s].values, run[s], rtol=1e-6, atol=1e-6, err_msg=s)
        np.testing.assert_allclose(log.channels[s].t, run["t"], atol=2e-6, err_msg=s)
    assert set(log.channels) == set(signals)
    return log.notes


# ---- names as tools write them: signal -> (name, factor, offset) -----------------------------------------------------

Style = dict[str, tuple[str, float, float]]
GERMAN: Style = {
    "n_dem": ("Drehzahl_Soll", 1, 0), "n_r": ("Drehzahl_Ist", 1, 0), "x_dem": ("Kolbenweg_Soll_mm", 1, 0),
    "x_lvdt": ("Kolbenweg_Ist_mm", 1, 0), "i_cmd": ("Ventilstrom_Soll_mA", 1, 0),
    "p_s": ("Versorgungsdruck_bar", 10, 0),
    "t_oil": ("\u00d6ltemperatur_\u00b0C", 1, 0), "vigv": ("VIGV_Winkel_Grad", 1, 0),
    "vgv1": ("VGV1_Winkel_Grad", 1, 0), "vgv2": ("VGV2_Winkel_Grad", 1, 0),
}  # fmt: skip
INCA: Style = {
    "n_dem": ("nEngSetp\\ETKC:1", 1, 0), "n_r": ("nEngAct\\ETKC:1", 1, 0), "x_dem": ("xDem\\ETKC:1", 1e-3, 0),
    "x_lvdt": ("xLvdt\\ETKC:1", 1e-3, 0), "i_cmd": ("iServoCmd\\ETKC:1", 1e-3, 0), "p_s": ("pSup\\ETKC:1", 1e6, 0),
    "t_oil": ("tOil\\ETKC:1", 1, 273.15), "vigv": ("angVigv\\ETKC:1", 1, 0), "vgv1": ("angVgv1\\ETKC:1", 1, 0),
    "vgv2": ("angVgv2\\ETKC:1", 1, 0),
}  # fmt: skip
DSPACE: Style = {
    s: (f'"Model Root"/"VGV"/"{name}"', 1, 0)
    for s, name in {
        "n_dem": "Rotor Speed Demand", "n_r": "Rotor Speed Measured", "x_dem": "Stroke Demand", "x_lvdt": "LVDT Stroke",
        "i_cmd": "Servo Valve Current", "p_s": "Supply Pressure", "t_oil": "Oil Temperature", "vigv": "VIGV Angle",
        "vgv1": "VGV1 Angle", "vgv2": "VGV2 Angle",
    }.items()
}  # fmt: skip
SIMULINK: Style = {
    "n_dem": ("<SpeedRef>:1", 1, 0), "n_r": ("<SpeedFbk>:1", 1, 0), "x_dem": ("<PosCmd>:1", 1, 0),
    "x_lvdt": ("<PosFbk>:1", 1, 0), "i_cmd": ("<ValveCurrentCmd>:1", 1, 0), "p_s": ("<SupplyPress>:1", 1, 0),
    "t_oil": ("<OilTemp>:1", 1, 0), "vigv": ("<IGV>:1", 1, 0), "vgv1": ("<VSV1>:1", 1, 0), "vgv2": ("<VSV2>:1", 1, 0),
}  # fmt: skip
CANAPE: Style = {
    s: (f"ECU1.{name}", 1, 0)
    for s, name in {
        "n_dem": "N1_DEM", "n_r": "N1_ACT", "x_dem": "ACT_POS_DMD", "x_lvdt": "ACT_POS_MEAS", "i_cmd": "SV_CURR_CMD",
        "p_s": "HYD_PRESS", "t_oil": "OIL_TEMP", "vigv": "VIGV_POT", "vgv1": "VGV_1", "vgv2": "VGV_2",
    }.items()
}  # fmt: skip
CANAPE["vigv"] = ("ECU1.VIGV_ANG", 1, 0)
STYLES = {"german": GERMAN, "inca": INCA, "dspace": DSPACE, "simulink": SIMULINK, "canape": CANAPE}


def styled(run: dict[str, np.ndarray], style: Style) -> dict[str, np.ndarray | list[str]]:
    return {name: run[s] * factor + offset for s, (name, factor, offset) in style.items()}


@pytest.mark.parametrize("style", STYLES)
def test_a_log_with_the_names_of_a_tool_maps_itself(tmp_path: Path, run: dict[str, np.ndarray], style: str) -> None:
    file = table(tmp_path / "a.csv", {"time": run["t"], **styled(run, STYLES[style])}, separator=";")
    notes = same(file, run)
    for s, (name, _, _) in STYLES[style].items():
        (note,) = [n for n in notes if n.startswith(f"{s}: guessed")]
        assert name[-6:] in note and "% sure" in note and "--no-guess" in note
    with pytest.raises(LogError, match="no n_dem"):
        read_log(file, guess=False)


def test_a_german_bench_with_decimal_comma_rpm_and_a_row_of_units_maps_itself(
    tmp_path: Path, run: dict[str, np.ndarray]
) -> None:
    columns = {"Zeit_s": run["t"], **styled(run, {**GERMAN, "n_dem": ("Drehzahl_Soll", 380, 0),
                                                  "n_r": ("Drehzahl_Ist", 380, 0)})}  # fmt: skip
    units = ["s", "U/min", "1/min", "mm", "mm", "mA", "bar", "\u00b0C", "\u00b0", "\u00b0", "\u00b0"]
    file = table(tmp_path / "a.csv", columns, ";", True, units, "cp1252")
    with pytest.raises(LogError) as e:
        read_log(file)
    assert "'Drehzahl_Soll' is in U/min" in str(e.value) and "--design-rpm 38000, if that is 100 %" in str(e.value)
    notes = same(file, run, design_rpm=38000)
    assert any(n.startswith("t: guessed to be 'Zeit_s'") for n in notes)
    # the same with the units in the header
    heads = {"n_dem": ("Drehzahl Soll [U/min]", 380, 0), "n_r": ("Drehzahl (Ist)", 380, 0)}
    file = table(
        tmp_path / "b.csv", {"Zeit [s]": run["t"], **styled(run, {**GERMAN, **heads})}, ";", True, None, "cp1252"
    )
    same(file, run, design_rpm=38000)


def test_channels_of_an_mdf_map_themselves_by_name_and_unit(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    fast = {name: (run[s] * f, u) for s, name, f, u in (("n_dem", "NSetp", 380, "rpm"), ("n_r", "NAct", 380, "1/min"),
            ("x_dem", "StrokeSetp", 1e-3, "m"), ("x_lvdt", "StrokeAct", 1, "mm"))}  # fmt: skip
    slow = {"OilTemp": (run["t_oil"][::10] + 273.15, "K"), "FuelPress": (run["p_s"][::10], "MPa")}
    write_groups(tmp_path / "a.mf4", [(run["t"], fast), (run["t"][::10], slow)])
    log = read_log(tmp_path / "a.mf4", design_rpm=38000)
    assert set(log.channels) == {"n_dem", "n_r", "x_dem", "x_lvdt", "t_oil"}
    np.testing.assert_allclose(log.channels["x_dem"].values, run["x_dem"], rtol=1e-9)
    np.testing.assert_allclose(log.channels["n_r"].values, run["n_r"], rtol=1e-9)
    np.testing.assert_allclose(log.channels["t_oil"].values, run["t_oil"][::10], atol=1e-9)


def test_a_comment_of_a_database_says_what_its_name_does_not(tmp_path: Path) -> None:
    (tmp_path / "a.dbc").write_text(
        'VERSION ""\nNS_ :\nBS_:\nBU_: A\nBO_ 100 M: 4 A\n SG_ S17 : 0|16@1+ (0.01,0) [0|600] "%" A\n'
        ' SG_ S18 : 16|16@1+ (0.01,0) [0|600] "bar" A\nCM_ SG_ 100 S17 "rotor speed demand";\n'
        'CM_ SG_ 100 S18 "brake pressure";\n'
    )
    (tmp_path / "a.log").write_text(
        "".join(f"({k * 0.01:.6f}) can0 064#{int(6000 + k).to_bytes(2, 'little').hex()}0852\n" for k in range(300))
    )
    log = read_log(tmp_path / "a.log", dbc=tmp_path / "a.dbc")
    assert set(log.channels) == {"n_dem"} and log.channels["n_dem"].values[1] == pytest.approx(60.01)
    assert any("its comment: 'rotor speed demand'" in n for n in log.notes)


# ---- time ------------------------------------------------------------------------------------------------------------


def dates(t: np.ndarray, form: str, start: dt.datetime) -> list[str]:
    return [(start + dt.timedelta(microseconds=round(1e6 * s))).strftime(form) for s in t]


NIGHT = dt.datetime(2026, 11, 22, 23, 59, 50)  # midnight is in the run
EPOCH = NIGHT.replace(tzinfo=dt.UTC).timestamp()
TIMES: dict[str, tuple[str, Callable[[np.ndarray], Any]]] = {
    "seconds": ("Zeit_s", lambda t: t), "ms": ("Time_ms", lambda t: t * 1e3), "us": ("t_us", lambda t: t * 1e6),
    "minutes": ("Zeit [min]", lambda t: t / 60), "elapsed": ("Elapsed Time (s)", lambda t: t),
    "capitals": ("EpochMs", lambda t: (t + EPOCH) * 1e3),
    "epoch": ("epoch", lambda t: t + EPOCH), "epoch ms": ("Timestamp", lambda t: (t + EPOCH) * 1e3),
    "epoch us": ("time", lambda t: (t + EPOCH) * 1e6),
    "iso": ("Zeitstempel", lambda t: dates(t, "%Y-%m-%dT%H:%M:%S.%fZ", NIGHT)),
    "iso with a blank": ("time", lambda t: dates(t, "%Y-%m-%d %H:%M:%S.%f", NIGHT)),
    "german": ("Datum/Uhrzeit", lambda t: [x.replace(";", ",") for x in dates(t, "%d.%m.%Y %H:%M:%S.%f", NIGHT)]),
    "clock": ("Uhrzeit", lambda t: dates(t, "%H:%M:%S.%f", NIGHT)),
    "american": ("DateTime", lambda t: dates(t, "%m/%d/%Y %H:%M:%S.%f", NIGHT)),
    "excel": ("Datum", lambda t: [f"{46348 + (86390 + s) / 86400:.11f}" for s in t]),
}  # fmt: skip


@pytest.mark.parametrize("kind", TIMES)
def test_a_time_of_every_usual_kind_is_taken(tmp_path: Path, run: dict[str, np.ndarray], kind: str) -> None:
    name, made = TIMES[kind]
    few = {k: v[:1500] for k, v in run.items()}
    when = made(few["t"])
    cells = when if isinstance(when, list) else [f"{x:.12g}" if abs(x) < 1e9 else f"{x:.3f}" for x in when]
    file = table(tmp_path / "a.csv", {"extra": few["p_s"], name: cells, "n_dem": few["n_dem"]})
    log = read_log(file)
    np.testing.assert_allclose(log.channels["n_dem"].t - log.channels["n_dem"].t[0], few["t"], atol=3e-6)
    if kind not in ("iso", "iso with a blank"):
        assert all("dates" not in n for n in log.notes) or kind in ("german", "american")
    assert kind == "minutes" or log.notes, "a guess is shown"
    if name not in ("time", "Timestamp", "Zeit [min]", "epoch"):
        with pytest.raises(LogError, match="time column"):
            read_log(file, guess=False)


def test_a_date_and_a_clock_beside_it_are_one_time(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    t = run["t"][:500]
    columns = {
        "Datum": dates(t, "%d.%m.%Y", NIGHT),
        "Uhrzeit": dates(t, "%H:%M:%S.%f", NIGHT),
        "n_dem": run["n_dem"][:500],
    }
    log = read_log(table(tmp_path / "a.csv", columns))
    np.testing.assert_allclose(log.channels["n_dem"].t, t, atol=2e-6)


def test_two_times_that_are_alike_are_named_and_not_guessed(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    columns = {"abs_time": run["t"], "rel_time": run["t"], "n_dem": run["n_dem"]}
    with pytest.raises(LogError, match="'abs_time' or 'rel_time': --map NAME=t"):
        read_log(table(tmp_path / "a.csv", columns))


def test_days_and_months_that_cannot_be_told_apart_are_no_time_beyond_a_day(tmp_path: Path) -> None:
    rows = {"Datum_Zeit": ["03/04/2026 23:59:59", "04/04/2026 00:00:00"], "n_dem": [60.0, 61.0]}
    with pytest.raises(LogError, match="is not a number"):
        read_log(table(tmp_path / "a.csv", rows))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "first, last, span",
    [
        ("24/11/26 08:00:00", "24/11/26 09:30:00", 5400.0),  # whichever number is the year, it is one day
        ("31/12/25 23:59:50", "01/01/26 00:00:10", None),  # 31 is no month: yet it may be day or year
        ("2026/12/31 23:59:50", "2027/01/01 00:00:10", 20.0),
        ("31/12/2026 23:59:50", "01/01/2027 00:00:10", 20.0),  # 31 is no month
    ],
)
def test_short_years_after_a_slash_are_read_where_it_does_not_matter_which_they_are(
    first: str, last: str, span: float | None, tmp_path: Path
) -> None:
    rows = {"Datum_Zeit": [first, last], "n_dem": [60.0, 61.0]}
    file = table(tmp_path / "a.csv", rows)  # type: ignore[arg-type]
    if span is None:
        with pytest.raises(LogError, match="is not a number"):
            read_log(file)
        return
    assert read_log(file).channels["n_dem"].t[-1] == pytest.approx(span)


def test_milliseconds_from_the_start_are_never_guessed(tmp_path: Path) -> None:
    """A row every 10 may be a row in 10 s: the name has to say it."""
    file = table(tmp_path / "a.csv", {"t": np.arange(200) * 10.0, "n_dem": np.full(200, 60.0)})
    assert read_log(file).channels["n_dem"].t[-1] == 1990.0


# ---- properties ------------------------------------------------------------------------------------------------------

NAMES: dict[str, list[str]] = {
    "n_dem": ["N_Demand", "Solldrehzahl", "speed_setpoint", "RotorSpeedCmd", "N1_REF", "nSoll", "Engine Speed Target"],
    "n_r": ["N_Meas", "Istdrehzahl", "speed_actual", "RotorSpeed", "N1_ACT", "nIst", "Engine Speed Feedback"],
    "x_dem": ["Stroke_Cmd", "Sollweg", "actuator_position_demand", "xSoll", "HubSoll", "VGV_Stroke_Req"],
    "x_lvdt": ["LVDT", "Istweg", "actuator_position", "xIst", "Kolbenhub", "Ram Position Measured"],
    "i_cmd": ["SV_Current_Cmd", "Servoventilstrom_Soll", "valve_current_demand", "iServoSoll"],
    "p_s": ["Supply_Pressure", "Versorgungsdruck", "p_sys", "HydPress", "Systemdruck"],
    "t_oil": ["Oil_Temp", "Oeltemperatur", "TempOil", "fluid temperature"],
}
SCALES: dict[str, list[tuple[str, float, float]]] = {
    "n_dem": [("", 1, 0), ("[%]", 1, 0)], "n_r": [("", 1, 0), ("(%)", 1, 0)],
    "x_dem": [("", 1, 0), ("", 1e-3, 0), ("[m]", 1e-3, 0), ("_mm", 1, 0), (" [inch]", 1 / 25.4, 0)],
    "x_lvdt": [("", 1, 0), ("", 1e-3, 0), ("[um]", 1e3, 0), ("_mm", 1, 0), ("_inch", 1 / 25.4, 0)],
    "i_cmd": [("", 1, 0), ("", 1e-3, 0), ("_A", 1e-3, 0), (" (mA)", 1, 0)],
    "p_s": [("", 1, 0), ("", 10, 0), ("", 1e6, 0), ("_psi", 145.0377377, 0), (" [kPa]", 1e3, 0)],
    "t_oil": [("", 1, 0), ("", 1, 273.15), ("_degF", 1.8, 32.0), ("[K]", 1, 273.15)],
}  # fmt: skip
FOREIGN = ["fuel_flow", "T3", "EGT", "room_temperature", "coolant_pressure", "wheel_speed", "motor_current", "op", "u"]


@settings(max_examples=examples(40), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(draw=st.data())
def test_names_units_order_and_other_columns_do_not_change_what_is_read(
    tmp_path: Path, run: dict[str, np.ndarray], draw: st.DataObject
) -> None:
    columns: dict[str, np.ndarray | list[str]] = {"Zeit_s": run["t"]}
    for s, names in NAMES.items():
        tail, factor, offset = draw.draw(st.sampled_from(SCALES[s]))
        name = draw.draw(st.sampled_from(names))
        columns[(name + tail) if tail[:1] != "_" or " " not in name else name + " " + tail[1:]] = (
            run[s] * factor + offset
        )
    for k, name in enumerate(draw.draw(st.lists(st.sampled_from(FOREIGN), unique=True))):
        columns[name] = run["x_lvdt"] * (k + 1) + k
    order = draw.draw(st.permutations(list(columns)))
    same(table(tmp_path / "a.csv", {k: columns[k] for k in order}), run, tuple(NAMES))


# ---- never wrong -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*FOREIGN, "fuel_pressure", "ENGINE_OIL_PRESSURE", "Raumtemperatur", "valve_position",
    "Ventilstrom_Ist", "n_corr", "vehicle speed", "gear_position", "tank_temp", "brake_pressure", "battery_current",
    "pump_current", "x_rear", "Servo_Motor_Position", "throttle position demand", "pressure", "Druck", "temp", "vgv",
    "vgv1_demand", "status", "state", "counter", "CRC", "x", "n", "s", "S17", "X2", "", "position_x",
    "   ", "12", "%", "\u00b0", "[rpm]", "u", "y"])  # fmt: skip
def test_a_name_that_says_something_else_is_no_guess(name: str) -> None:
    m = meaning(name, ALL)
    assert m is None or m.confidence < ENOUGH, m


@given(st.text(max_size=40))
def test_no_name_breaks_the_dictionary(name: str) -> None:
    m = meaning(name, ALL)
    assert m is None or (m.signal in UNITS and 0.0 <= m.confidence <= 1.0)
    assert 0.0 <= is_time(name)[0] <= 1.0


# ---- names put together from words ---------------------------------------------------------------------------------

DEMAND, ACTUAL = ["Demand", "Cmd", "Setpoint", "Set Point", "Soll", "Ref"], ["Sense", "Feedback", "Ist", "Act", "Meas"]
THINGS: dict[str, tuple[list[str], list[str], list[str]]] = {  # signal -> things, roles, units
    "n_dem": (["NH", "N2", "HP Speed", "Core Speed", "Drehzahl", "Gas Generator Speed"], DEMAND, ["rpm", "pct"]),
    "n_r": (["NH", "NR", "HP Speed", "Core Speed", "Drehzahl", "Gas Generator Speed"], ACTUAL, ["rpm", "pct"]),
    "x_dem": (["VSV", "VSV Act", "VGV", "Actuator", "Stellglied", "Ram Position", "Zylinder"], DEMAND, ["mm", "inch"]),
    "x_lvdt": (["VSV", "VSV Actuator", "VGV", "Actuator", "Stellglied", "Stellung"], ACTUAL, ["mm", "cm"]),
    "i_cmd": (["EHSV", "Servo Valve", "Torque Motor", "VSV TM", "Ventilstrom"], ["", *DEMAND], ["mA"]),
    "p_s": (["Hyd Supply", "Hydraulic System", "Versorgung", "Supply Pressure"], ["", *ACTUAL], ["psi", "bar"]),
    "t_oil": (["Oil", "Hyd Oil", "Hydraulic Fluid", "Oel Temperatur"], ["", *ACTUAL], ["degC", "degF"]),
    "vigv": (["IGV", "VIGV", "Inlet Guide Vane", "Vorleitrad", "Leitschaufel 0"], ["", *ACTUAL, "Pos"], ["deg", "rad"]),
    "vgv1": (["Vane 1", "Leitschaufel 1", "VSV 1", "Stator Vane 1", "Stage 1"], ["", *ACTUAL, "Pos"], ["deg", "rad"]),
    "vgv2": (["Vane 2", "Guide Vane 2", "VSV S2", "Leitrad 2", "Stufe 2"], ["", *ACTUAL, "Winkel"], ["deg", "rad"]),
}  # fmt: skip
WRITTEN: dict[str, Callable[[list[str]], str]] = {
    "snake": "_".join, "blanks": " ".join,
    "capitals": lambda w: "_".join(w).upper(), "low": lambda w: "_".join(w).lower(),
    "camel": lambda w: "".join(x if x.isupper() else x.capitalize() for x in w), "hyphens": "-".join,
}  # fmt: skip
BESIDE: list[Callable[[str], tuple[str, str]]] = [  # unit -> what stands behind the name, the unit of the file
    lambda u: (f"_{u}", ""), lambda u: (f"[{u}]", ""), lambda u: (f" ({u})", ""), lambda u: ("", u),
]  # fmt: skip


@given(st.data())
@settings(max_examples=examples(600), deadline=None)
def test_words_in_any_order_and_writing_with_a_unit_are_understood(draw: st.DataObject) -> None:
    signal = draw.draw(st.sampled_from(sorted(THINGS)))
    things, roles, units = THINGS[signal]
    thing, role, unit = (draw.draw(st.sampled_from(x)) for x in (things, roles, units))
    groups = [thing.split(), role.split()] if draw.draw(st.booleans()) else [role.split(), thing.split()]
    if thing[-1].isdigit() and role and not role[-1].isdigit():
        groups = [thing.split(), role.split()]  # Ist_VSV_1 is said by none
    name = WRITTEN[draw.draw(st.sampled_from(sorted(WRITTEN)))]([w for g in groups for w in g])
    behind, in_file = draw.draw(st.sampled_from(BESIDE))(unit)
    m = meaning(name + behind, ALL, in_file)
    assert m is not None and m.signal == signal and m.confidence >= ENOUGH, (name + behind, m)
    assert in_file or behind[0] != "_" or m.unit


KINDS = {"mm": "stroke", "inch": "stroke", "mA": "current", "bar": "pressure", "psi": "pressure", "degC": "temperature",
         "deg": "angle", "rad": "angle", "rpm": "speed"}  # fmt: skip
OF = {"n": "speed", "x": "stroke", "i": "current", "p": "pressure", "t": "temperature", "v": "angle"}


OUR_WORDS = sorted({w for things, roles, _ in THINGS.values() for x in (*things, *roles) for w in x.split()})


@given(
    st.lists(st.sampled_from(OUR_WORDS), min_size=1, max_size=4),
    st.sampled_from(sorted(KINDS)),
    st.sampled_from(BESIDE),
)  # fmt: skip
@settings(max_examples=examples(1500), deadline=None)
def test_no_order_of_our_words_makes_a_signal_of_another_kind_or_role(
    words: list[str], unit: str, beside: Callable[[str], tuple[str, str]]
) -> None:
    behind, in_file = beside(unit)
    m = meaning("_".join(words) + behind, ALL, in_file)
    if m is None or m.confidence < ENOUGH:
        return
    if m.unit:  # a unit of the file that is none of the signal is told in `guess`
        assert KINDS[unit] == OF[m.signal[0]]
    demands = any(w in ("Demand", "Cmd", "Setpoint", "Set", "Soll", "Ref") for w in words)
    assert not (demands and m.signal in ("n_r", "x_lvdt", *(v for v in ALL if v.startswith("v"))))


@pytest.mark.parametrize(
    "names, signal",
    [(("NHSense_rpm", "NH_Fbk_rpm"), "n_r"), (("VSV_ActCmd_mm", "ActuatorSetpoint[mm]"), "x_dem"),
     (("HydSupply_MPa", "Hydraulic System [MPa]"), "p_s"), (("LVDT_A", "LVDT_B"), "x_lvdt"),
     (("EHSV_mA", "TorqueMotor_mA"), "i_cmd"), (("Leitschaufelwinkel 1", "Stator Vane 1"), "vgv1")],
)  # fmt: skip
def test_two_names_that_say_the_same_are_told_and_neither_is_taken(
    tmp_path: Path, run: dict[str, np.ndarray], names: tuple[str, str], signal: str
) -> None:
    scale = 380.0 if signal == "n_r" else 1.0
    columns = {
        "t": run["t"],
        "n_dem": run["n_dem"],
        **{n: run[signal] * scale * (1 + 0.01 * k) for k, n in enumerate(names)},
    }
    seen = survey(table(tmp_path / "a.csv", columns), design_rpm=38000)
    assert {r.signal for r in seen.rows} == {"t", "n_dem"}
    assert all(seen.other[n].startswith(f"two could be {signal}: ") for n in names)


def test_a_bench_of_names_that_only_their_units_explain_maps_itself(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    columns = {"Zeit_s": run["t"], "NHDemand_rpm": run["n_dem"] * 380, "NHSense_rpm": run["n_r"] * 380,
               "ActuatorSetpoint[mm]": run["x_dem"], "VSV_ActFbk_in": run["x_lvdt"] / 25.4,
               "EHSV_mA": run["i_cmd"], "HydSupply_psi": run["p_s"] * 145.0377377, "Oil_degF": run["t_oil"] * 1.8 + 32,
               "Leitschaufelwinkel 0": run["vigv"], "Leitschaufelwinkel 1": run["vgv1"],
               "Leitschaufelwinkel 2": run["vgv2"]}  # fmt: skip
    same(table(tmp_path / "a.csv", columns), run, design_rpm=38000)


def test_what_is_not_used_says_why(
    tmp_path: Path, run: dict[str, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    columns: dict[str, np.ndarray | list[str]] = {
        "t": run["t"], "n_dem": run["n_dem"], "x_lvdt": run["x_lvdt"], "Fuel": run["p_s"], "Nr": np.arange(ROWS),
        "VGV_Pos": run["x_lvdt"], "Leitschaufelwinkel": run["vgv1"], "HydSupply": run["p_s"],
        "Fuel Pressure": run["p_s"], "HydSupply_bar": run["p_s"] * 0.1,
        "Oil Temp degC [K]": run["t_oil"], "VGV1_Soll": run["vgv1"],
        "Oil Temp": ["warm"] * ROWS, "Leitschaufelwinkel 1": run["vigv"], "Zeile Nr": np.arange(ROWS) + 1,
        "Drehzahl_Ist_pct": np.arange(ROWS) + 1,
        "Hub_Stellung": run["x_lvdt"],
    }  # fmt: skip
    file = table(tmp_path / "a.csv", columns)
    seen = survey(file)
    assert [r.signal for r in seen.rows] == ["t", "n_dem", "x_lvdt"]
    for name, why in {
        "Fuel": "no signal of the model has such a name", "Nr": "is called n_r", "VGV_Pos": "x_lvdt has a name already",
        "Leitschaufelwinkel": "it does not say of which vane row", "HydSupply": "a unit would",
        "Fuel Pressure": "fuel is not known", "HydSupply_bar": "a supply has 8 to 40", 
        "VGV1_Soll": "no demand of a vane", "Hub_Stellung": "x_lvdt has a name already",
        "Oil Temp degC [K]": "the log says K, its name says degC", "Oil Temp": "words, not numbers",
        "Leitschaufelwinkel 1": "it moves as vigv does", "Drehzahl_Ist_pct": "it counts the rows",
    }.items():  # fmt: skip
        assert why in seen.other[name], (name, seen.other[name])
    assert main(["map", str(file), "--json", str(tmp_path / "a.json")]) == 0
    assert "not used: Fuel: no signal of the model has such a name" in capsys.readouterr().out
    answer = json.loads((tmp_path / "a.json").read_text())
    assert answer["other"] == list(answer["why_not"]) and all(answer["why_not"].values())


def test_vanes_counted_from_one_are_not_guessed_where_no_name_is_the_inlet(
    tmp_path: Path, run: dict[str, np.ndarray]
) -> None:
    columns = {"t": run["t"], "n_dem": run["n_dem"], "Leitschaufelwinkel 1": run["vigv"],
               "Leitschaufelwinkel 2": run["vgv1"], "Leitschaufelwinkel 3": run["vgv2"]}  # fmt: skip
    log = read_log(table(tmp_path / "a.csv", columns))
    assert set(log.channels) == {"n_dem"} and any("no name of an inlet vane: 1 may be it" in n for n in log.notes)


def test_two_rotors_are_named_and_neither_is_guessed(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    columns = {"t": run["t"], "N1_Dem": run["n_dem"], "N2_Dem": run["n_dem"] * 0.9, "x_lvdt": run["x_lvdt"]}
    file = table(tmp_path / "a.csv", columns)
    with pytest.raises(LogError) as e:
        read_log(file)
    assert "may be 'N1_Dem' or 'N2_Dem': not guessed" in str(e.value)
    log = read_log(file, mapping={"N2_Dem": "n_dem"})
    np.testing.assert_allclose(log.channels["n_dem"].values, run["n_dem"] * 0.9, rtol=1e-8)
    assert not log.guesses


def test_the_measured_speed_is_of_the_rotor_of_the_demand(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    columns = {"t": run["t"], "N1_DEM": run["n_dem"], "N2_ACT": run["n_r"] * 0.95, "N1_ACT": run["n_r"]}
    log = read_log(table(tmp_path / "a.csv", columns))
    np.testing.assert_allclose(log.channels["n_r"].values, run["n_r"], rtol=1e-8)
    del columns["N1_ACT"]
    log = read_log(table(tmp_path / "a.csv", columns))
    assert set(log.channels) == {"n_dem"} and any("another rotor than that of 'N1_DEM'" in n for n in log.notes)
    columns = {"t": run["t"], "NH_CMD": run["n_dem"], "NL_FBK": run["n_r"], "HP Speed Measured": run["n_r"] * 0.98}
    log = read_log(table(tmp_path / "a.csv", columns))
    np.testing.assert_allclose(log.channels["n_r"].values, run["n_r"] * 0.98, rtol=1e-8)


@pytest.mark.parametrize(
    "name, signal, unit",
    [
        ("supply.pressure [Pa]", "p_s", ""), ("vigv.angle [rad]", "vigv", ""), ("StrokeActMm", "x_lvdt", "mm"),
        ("OilTempDegC", "t_oil", "degC"), ("VSV_ActPos_in", "x_lvdt", "inch"), ("phiVGV2", "vgv2", ""),
        ("Model Root/Hydraulik/Versorgungsdruck", "p_s", ""), ("TM_Current_mA", "i_cmd", "mA"),
    ],
)  # fmt: skip
def test_paths_and_capitals_are_read_as_people_read_them(name: str, signal: str, unit: str) -> None:
    m = meaning(name, ALL)
    assert m is not None and m.signal == signal and m.unit == unit and m.confidence >= ENOUGH


@pytest.mark.parametrize("name", ["coolant.supply_pressure", "Kraftstoff/Versorgungsdruck", "fuel.supply.pressure"])
def test_the_path_of_another_part_makes_no_guess(name: str) -> None:
    m = meaning(name, ALL)
    assert m is None or m.confidence < ENOUGH


@pytest.mark.parametrize(
    "name", ["timeout", "dead_time", "date_of_test", "uptime", "Zeitkonstante", "rise_time_s", "T1"]
)
def test_a_name_with_time_in_it_is_not_yet_the_time(name: str) -> None:
    assert is_time(name) == (0.0, "")


def test_what_contradicts_the_other_signals_is_withdrawn(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    columns = {"t": run["t"], "n_dem": run["n_dem"], "x_lvdt": run["x_lvdt"], "VGV1_Winkel": -run["vgv1"],
               "Valve_Current_Cmd": -run["i_cmd"], "Stroke_Demand": 50.0 - run["x_dem"]}  # fmt: skip
    file = table(tmp_path / "a.csv", columns)
    log = read_log(file)
    assert set(log.channels) == {"n_dem", "x_lvdt"}
    said = " ".join(log.notes)
    assert "'VGV1_Winkel' would be it by name, but it runs against x_lvdt; --unit vgv1=-deg" in said
    assert "drives the stroke backwards" in said
    log = read_log(file, units={"vgv1": "-deg", "i_cmd": "-mA"})  # what the notes propose mends it
    np.testing.assert_allclose(log.channels["vgv1"].values, run["vgv1"], rtol=1e-8)
    np.testing.assert_allclose(log.channels["i_cmd"].values, run["i_cmd"], rtol=1e-8)
    log = read_log(file, mapping={"VGV1_Winkel": "vgv1"}, units={"vgv1": "-deg"})
    np.testing.assert_allclose(log.channels["vgv1"].values, run["vgv1"], rtol=1e-8)


@pytest.mark.parametrize("signal", ["n_r", "x_lvdt"])
def test_a_measurement_that_counts_the_other_way_is_told_with_what_mends_it(
    tmp_path: Path, run: dict[str, np.ndarray], signal: str
) -> None:
    demand = {"n_r": "n_dem", "x_lvdt": "x_dem"}[signal]
    name = {"n_r": "Drehzahl_Ist", "x_lvdt": "Kolbenweg_Ist"}[signal]
    file = table(tmp_path / "a.csv", {"t": run["t"], "n_dem": run["n_dem"], demand: run[demand], name: -run[signal]})
    log = read_log(file)
    assert signal not in log.channels
    option = f"{signal}=-{UNITS[signal]}"
    assert f"it is {demand} with the other sign; --unit {option} turns it" in " ".join(log.notes)
    mended = read_log(file, units=dict([option.split("=", 1)]))
    np.testing.assert_allclose(mended.channels[signal].values, run[signal], rtol=1e-8)


def test_without_a_stroke_the_speed_tells_what_is_turned(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    columns = {"t": run["t"], "Speed Demand": run["n_dem"], "Speed Measured": run["n_r"], "IGV_deg": -run["vigv"],
               "VGV1_deg": run["vgv1"], "VGV2_deg": -run["vgv2"], "SV_Current_mA": -run["i_cmd"]}  # fmt: skip
    log = read_log(table(tmp_path / "a.csv", columns))
    assert set(log.channels) == {"n_dem", "n_r", "vgv1"}
    said = " ".join(log.notes)
    assert all(f"--unit {s}=-{UNITS[s]}" in said for s in ("vigv", "vgv2", "i_cmd"))


@pytest.mark.parametrize(
    "how",
    [lambda x: x - 24.0, lambda x: x / 0.48, lambda x: x + 12.0],
    ids=["counted from the middle", "in per cent", "counted from elsewhere"],
)
def test_a_stroke_far_from_the_schedule_is_told(
    tmp_path: Path, run: dict[str, np.ndarray], how: Callable[[np.ndarray], np.ndarray]
) -> None:
    """Demand and measurement agree with each other, and values of a part of the stroke look like mm."""
    some = run["x_dem"] < 28.0
    columns = {"Zeit_s": run["t"][some], "n_soll": run["n_dem"][some], "n_ist": run["n_r"][some],
               "weg_soll": how(run["x_dem"])[some], "weg_ist": how(run["x_lvdt"])[some]}  # fmt: skip
    file = table(tmp_path / "a.csv", columns)
    log = read_log(file)
    assert set(log.channels) == {"n_dem", "n_r"}
    assert "the schedule says at n_r; --map NAME=x_lvdt takes it as it is" in " ".join(log.notes)
    assert "x_lvdt" in read_log(file, mapping={"weg_ist": "x_lvdt"}).channels


def test_an_oil_that_may_be_in_either_degree_is_not_guessed(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    columns = {"t": run["t"], "n_dem": run["n_dem"], "Oil Temperature": run["t_oil"] * 1.8 + 32.0}
    file = table(tmp_path / "a.csv", columns)
    log = read_log(file)
    assert set(log.channels) == {"n_dem"} and "degC or degF?" in " ".join(log.notes)
    log = read_log(file, units={"t_oil": "degF"})
    np.testing.assert_allclose(log.channels["t_oil"].values, run["t_oil"], rtol=1e-8)


def test_a_name_of_a_user_s_system_is_taken_in_other_letters_where_it_is_the_only_one(tmp_path: Path) -> None:
    signals = {"pump": "V", "level": "cm"}
    t = np.arange(0.0, 50.0)
    columns = {"Time": t, "Pump (V)": np.sin(t), "LEVEL [mm]": 10.0 * t}
    file = table(tmp_path / "a.csv", columns)
    log = read_log(file, signals=signals, require=tuple(signals))
    np.testing.assert_allclose(log.channels["level"].values, t, atol=1e-8)
    assert sum("its name in other letters" in n for n in log.notes) == 2
    with pytest.raises(LogError, match="no pump"):
        read_log(file, signals=signals, require=tuple(signals), guess=False)
    file = table(tmp_path / "b.csv", {**columns, "Level": t})
    with pytest.raises(LogError, match="no level"):
        read_log(file, signals=signals, require=tuple(signals))


NAMED_UNITS = {"level": ("cm", [("_mm", 10.0, 0.0), ("Mm", 10.0, 0.0), ("_inch", 1 / 2.54, 0.0), ("_cm", 1.0, 0.0)]),
               "dwell": ("s", [("_min", 1 / 60, 0.0), (" [ms]", 1e3, 0.0), ("_sec", 1.0, 0.0)]),
               "temp": ("degC", [("_degF", 1.8, 32.0), ("_kelvin", 1.0, 273.15), ("DegC", 1.0, 0.0)]),
               "pump": ("V", [("_min", 1.0, 0.0), ("_mm", 1.0, 0.0), ("", 1.0, 0.0)])}  # fmt: skip


@pytest.mark.parametrize("signal, own, behind", [(s, o, b) for s, (o, bs) in NAMED_UNITS.items() for b in bs])
def test_a_unit_in_the_name_of_a_user_s_channel_is_converted_and_told(
    tmp_path: Path, signal: str, own: str, behind: tuple[str, float, float]
) -> None:
    """By its own name with the unit behind it, and under any name that is mapped to it; never silently its own unit."""
    tail, factor, offset = behind
    t, v = np.arange(0.0, 50.0), 20.0 + np.arange(50.0) ** 0.5
    for name, mapping in ((f"{signal}{tail}", None), (f"Kanal{tail}", {f"Kanal{tail}": signal})):
        file = table(tmp_path / "a.csv", {"Time": t, name: v * factor + offset})
        reading: dict[str, Any] = {"signals": {signal: own}, "require": (), "mapping": mapping}
        log = read_log(file, **reading)
        if signal == "pump" and tail and not mapping:  # pump_min is no pump in V
            assert signal not in log.channels
        else:
            np.testing.assert_allclose(log.channels[signal].values, v, rtol=1e-8)
        converted = factor != 1.0 or offset != 0.0
        assert not converted or "[" in name or any(n.startswith(signal) for n in log.notes)
        if mapping:
            np.testing.assert_allclose(
                read_log(file, **reading, units={signal: own}).channels[signal].values,
                v * factor + offset, rtol=1e-8,
            )  # fmt: skip
            plain = read_log(file, **reading, guess=False)
            assert not converted or "[" in name or any("though its name says" in n for n in plain.notes)


def test_a_mapped_name_of_ours_and_a_mapped_time_keep_the_unit_that_they_say(
    tmp_path: Path, run: dict[str, np.ndarray]
) -> None:
    columns = {"Lauf_ms": run["t"] * 1e3, "n_dem": run["n_dem"], "Kuehler_degF": run["t_oil"] * 1.8 + 32,
               "Kanal7_inch": run["x_lvdt"] / 25.4, "Kanal8_rpm": run["n_r"] * 380}  # fmt: skip
    file = table(tmp_path / "a.csv", columns)
    mapping = {"Lauf_ms": "t", "Kuehler_degF": "t_oil", "Kanal7_inch": "x_lvdt"}
    notes = same(file, run, ("n_dem", "t_oil", "x_lvdt"), mapping=mapping)
    assert sum("as its name says" in n for n in notes) == 3
    with pytest.raises(LogError, match="Kanal8_rpm.* needs the design speed"):
        read_log(file, mapping={**mapping, "Kanal8_rpm": "n_r"})
    same(file, run, ("n_dem", "t_oil", "x_lvdt", "n_r"), mapping={**mapping, "Kanal8_rpm": "n_r"}, design_rpm=38000)
    seen = survey(file, mapping=mapping)
    assert {r.signal: r.unit for r in seen.rows}["x_lvdt"] == "inch"  # the mapping file says it too
    assert seen.bench().units["t_oil"] == "degF"


@pytest.mark.parametrize("scale", [0.25, 0.5, 2.0])
def test_a_stroke_is_held_against_the_schedule_of_its_own_machine(
    tmp_path: Path, run: dict[str, np.ndarray], scale: float
) -> None:
    """A machine whose piston has another way to go: with its tables the guess is made, with the shipped ones not."""

    def strokes(text: re.Match[str]) -> str:
        return re.sub(r"\d+\.\d+|\d+(?=,)", lambda m: f"{float(m[0]) * scale:.5f}", text[0])

    own = tmp_path / "own"
    own.mkdir()
    shipped = (ROOT / "tables" / "stroke_tables.toml").read_text()
    head, rest = shipped.split("[extension]")
    (own / "stroke_tables.toml").write_text(head + "[extension]" + re.sub(r"values = \[[^]]*\]", strokes, rest))
    at = run["x_lvdt"] * scale
    columns = {"t": run["t"], "n_dem": run["n_dem"], "n_r": run["n_r"], "Hub_Ist_mm": np.minimum(at, 60.0)}
    file = table(tmp_path / "a.csv", columns)
    assert "x_lvdt" not in read_log(file).channels
    assert "x_lvdt" in read_log(file, tables=files_of(own)).channels
    assert "x_lvdt" in {r.signal for r in survey(file, tables=files_of(own)).rows}
    shipped_file = table(tmp_path / "b.csv", {**columns, "Hub_Ist_mm": run["x_lvdt"]})
    assert "x_lvdt" in read_log(shipped_file).channels
    assert "x_lvdt" not in read_log(shipped_file, tables=files_of(own)).channels
    assert main(["map", str(file), "--tables", str(own), "--json", str(tmp_path / "a.json"), "--quiet"]) == 0
    assert "x_lvdt" in {s["signal"] for s in json.loads((tmp_path / "a.json").read_text())["signals"]}


def test_our_own_signs_contradict_nothing(run: dict[str, np.ndarray]) -> None:
    assert contradictions({s: (run["t"], run[s]) for s in SIGNALS}, set(SIGNALS)) == {}


def test_values_that_no_unit_explains_are_not_guessed(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    columns = {"t": run["t"], "n_dem": run["n_dem"], "Versorgungsdruck": run["p_s"] * 0 + 0.4,
               "Oil_Temp": run["t_oil"] * 0,
               "Stroke_Cmd": run["x_dem"] * 0.03, "Supply_Pressure_2_bar": run["p_s"] * 1e6}  # fmt: skip
    log = read_log(table(tmp_path / "a.csv", columns))
    assert set(log.channels) == {"n_dem"} and not log.guesses
    assert sum("not guessed" in n for n in log.notes) == 3


def test_our_own_names_stay_as_they_are(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    """An own name in a wrong unit is refused as ever, and what is called as ours goes before what could be meant."""
    with pytest.raises(LogError, match="--unit p_s=bar"):
        read_log(table(tmp_path / "a.csv", {"t": run["t"], "n_dem": run["n_dem"], "p_s": run["p_s"] * 10}))
    log = read_log(
        table(tmp_path / "a.csv", {"t": run["t"], "Speed_Demand": run["n_dem"] * 0.5, "n_dem": run["n_dem"]})
    )
    np.testing.assert_allclose(log.channels["n_dem"].values, run["n_dem"], rtol=1e-8)
    assert not log.notes


EXAMPLES = ["examples/engine_run.blf", "examples/hidden_effect.parquet", "examples/four_stages/worn_vgv3.parquet"]


@pytest.mark.parametrize("name", EXAMPLES)
def test_nothing_is_guessed_in_the_shipped_examples(name: str) -> None:
    plain, log = read_log(ROOT / name, guess=False), read_log(ROOT / name)
    assert not log.guesses and log.notes == plain.notes and set(log.channels) == set(plain.channels)
    for s, c in plain.channels.items():
        assert np.array_equal(c.t, log.channels[s].t) and np.array_equal(c.values, log.channels[s].values)


def test_nothing_is_guessed_wrong_in_recordings_of_other_things() -> None:
    """Cars, a truck, valves of a process, a micro gas turbine: no signal of vanes is in them."""
    files = [*DATA.glob("*/*.csv"), data("can_honda/revlog.log"), data("can_j1939/log.mf4")]
    assert len(files) > 5
    for p in files:
        dbc = next(p.parent.glob("*.dbc"), None)
        try:
            seen = survey(p, dbc=dbc)
        except LogError as e:
            assert "no time column" in str(e)
            continue
        assert [r.signal for r in seen.rows if r.how == "guessed" and r.signal != "t"] == [], p


def test_a_rotor_that_needs_its_design_speed_gets_the_one_of_the_schedule(
    tmp_path: Path, run: dict[str, np.ndarray]
) -> None:
    for rpm in (12_500.0, 38_000.0):
        columns = {"Zeit_s": run["t"], "NSoll": run["n_dem"] * rpm / 100, "LVDT": run["x_lvdt"]}
        seen = survey(table(tmp_path / "a.csv", columns))
        assert (
            seen.suggested_rpm == pytest.approx(rpm, rel=0.02)
            and f"--design-rpm {seen.suggested_rpm:g}" in seen.complaint
        )


# ---- mapping files ---------------------------------------------------------------------------------------------------


def test_a_mapping_file_reads_as_the_guesses_it_keeps(tmp_path: Path, run: dict[str, np.ndarray]) -> None:
    file = table(tmp_path / "a.csv", {"Zeit_s": run["t"], **styled(run, GERMAN)})
    assert main(["map", str(file), "--out", str(tmp_path / "bench.toml"), "--quiet"]) == 0
    notes = same(file, run, mapping_file=tmp_path / "bench.toml")
    assert notes == []  # nothing is guessed any more
    # a log of this bench that lacks a channel says so; an option goes before the file
    less = table(tmp_path / "b.csv", {k: v for k, v in {"Zeit_s": run["t"], **styled(run, GERMAN)}.items()
                                      if k != GERMAN["p_s"][0]})  # fmt: skip
    log = read_log(
        less, mapping_file=tmp_path / "bench.toml", mapping={"Drehzahl_Ist": "n_dem", "n_r": "Drehzahl_Soll"}
    )
    assert any(n.startswith("p_s: ") and "which the log does not have" in n for n in log.notes)
    np.testing.assert_allclose(log.channels["n_dem"].values, run["n_r"], rtol=1e-6)


@given(
    st.dictionaries(st.sampled_from(ALL), st.text(min_size=1, max_size=20).filter(lambda s: s.strip()), max_size=4),
    st.none() | st.floats(1.0, 1e6),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_mapping_file_gives_back_any_names(tmp_path: Path, names: dict[str, str], rpm: float | None) -> None:
    write_mapping(tmp_path / "m.toml", Bench(names, {"t": "ms"}, rpm), dict.fromkeys(names, "guessed\nas ever"), "a\nb")
    assert read_mapping(tmp_path / "m.toml") == Bench(names, {"t": "ms"}, rpm)


@pytest.mark.parametrize(
    "text, said",
    [("names = 3", "must be a table"), ("[names]\nn_den = 'a'", "close: n_dem"), ("[units]\nt = 3", "quotation marks"),
     ("design_rpm = 0", "above 0"), ("design_rpm = true", "above 0"), ("dbc = 1", "file name"),
     ("nams = 1", "close: names"),
     ("[names", "not a TOML table")],
)  # fmt: skip
def test_a_wrong_mapping_file_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(InputError, match=said) as e:
        read_log(ROOT / EXAMPLES[1], mapping_file=tmp_path / "m.toml")
    assert "m.toml" in str(e.value) and "\n" not in str(e.value)


# ---- commands --------------------------------------------------------------------------------------------------------

COMMANDS = [
    ["replay", "{log}"],
    ["compare", "{log}"],
    ["locate", "{log}"],
    ["diagnose", "{log}"],
    ["extend", "{log}", "--effect", "valve_dead_band", "--out", "{folder}/m.toml"],
    ["schedule", "--log", "{log}"],
    ["run", "--bus", "lockstep", "--log", "{log}"],
    ["run", "--bus", "lockstep", "--profile", "{log}"],
    ["experiment", "{log}"],
]


@pytest.mark.parametrize("words", quick_first(COMMANDS, len(COMMANDS) - 1), ids=[" ".join(w) for w in COMMANDS])
def test_every_guess_is_in_text_and_json_of_a_command(
    tmp_path: Path, run: dict[str, np.ndarray], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    file = table(tmp_path / "a.csv", {"Zeit_s": run["t"], **styled(run, GERMAN)})
    out = tmp_path / "a.json"
    assert main([w.format(log=file, folder=tmp_path) for w in words] + ["--json", str(out)]) in (0, 1)
    said = capsys.readouterr().out
    guesses = [g.note() for g in read_log(file).guesses]
    notes = json.loads(out.read_text())["notes"]
    assert len(guesses) == len(SIGNALS)
    for note in guesses:
        assert said.count(note) == 1 and note in notes
    assert main([w.format(log=file, folder=tmp_path) for w in words] + ["--no-guess"]) == 2
    assert "no time column" in capsys.readouterr().err


def test_map_shows_what_is_in_a_log(
    tmp_path: Path, run: dict[str, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    rpm = {**GERMAN, "n_dem": ("Drehzahl_Soll_U_min", 380.0, 0.0)}
    file = table(tmp_path / "a.csv", {"Zeit_s": run["t"], **styled(run, rpm), "Fuel": run["t"]})
    assert main(["map", str(file), "--json", str(tmp_path / "a.json")]) == 1
    said = capsys.readouterr().out
    assert "--design-rpm 38000" in said and "Kolbenweg_Ist_mm" in said and "not used: " in said and "Fuel" in said
    answer = json.loads((tmp_path / "a.json").read_text())
    assert answer["suggested_rpm"] == 38000 and {s["signal"] for s in answer["signals"]} == {"t", *SIGNALS} - {"n_dem"}
    assert main(["map", str(file), "--design-rpm", "38000"]) == 0
    assert main(["map", str(table(tmp_path / "b.csv", {"t": run["t"], "Fuel": run["t"]}))]) == 1
    assert "none of its names is a signal of ours" in capsys.readouterr().out
    (tmp_path / "c.csv").write_text("t;n_dem\n")
    assert main(["map", str(tmp_path / "c.csv")]) == 1 and "has no sample" in capsys.readouterr().out


def test_a_sparkline_rises_with_its_curve() -> None:
    assert (
        sparkline(np.arange(8.0)) == "".join(sorted(sparkline(np.arange(8.0))))
        and len(sparkline(np.arange(99.0))) == 16
    )
    assert sparkline(np.zeros(3)) and sparkline(np.empty(0)) == ""
