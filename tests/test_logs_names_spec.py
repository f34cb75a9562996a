"""What a name says, which guess is made of it, what a channel of this machine can hold: each rule at its boundary."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.logs import plausible
from hil.logs.guess import Guess, contradictions, design_speed, guess, mean_stroke
from hil.logs.names import CERTAIN, bracketed, is_time, lacks, meaning, spool, unit_behind, unit_in_name, unit_kind
from hil.logs.plausible import RANGES, judge, latest, longest_part, out_of_order, proposed, span_complaint, too_small
from hil.logs.source import LogError, Series
from hil.logs.units import factor_of
from plant.geometry import load_schedules
from vaneloop.base.signals import SIDES, UNITS
from vaneloop.base.vanes import VANES

ALL = tuple(UNITS)


# ---- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "unit", "said"),
    [
        # our own names, in other letters and with a unit of their kind behind
        ("N_Dem", "", ("n_dem", "", 0.98)),
        ("NR_pct", "", ("n_r", "%", 0.98)),
        ("xlvdt_mm", "", ("x_lvdt", "mm", 0.98)),
        ("vgv3_deg", "", ("vgv3", "deg", 0.98)),
        ("vgv3_mm", "", ("vgv3", "", 0.4)),
        ("VIGV", "", ("vigv", "", 0.98)),
        ("x_lvdt_bar", "", ("x_lvdt", "", 0.4)),
        # Nr counts rows in German
        ("nr", "", ("n_r", "", 0.5)),
        ("Nr", "rpm", ("n_r", "", 0.98)),
        ("nr_rpm", "", ("n_r", "rpm", 0.98)),
        # vanes: named, or counted, with fewer than three digits, as many as there are
        ("VSV3", "", ("vgv3", "", 0.98)),
        ("Vane 1", "", ("vgv1", "", 0.88)),
        ("Vane 0", "", ("vigv", "", 0.88)),
        ("Vane 07", "", ("vgv7", "", 0.88)),
        ("Vane 8", "", None),
        ("Vane 001", "", None),
        ("VGV", "", None),
        ("vane_2_angle", "", ("vgv2", "", 0.88)),
        ("stage 3", "deg", ("vgv3", "", 0.88)),
        ("stage 3", "", ("vgv3", "", 0.4)),
        ("VGV1_CMD", "", None),
        ("VGV 1 jack", "", ("vgv1", "", 0.98)),
        ("VGV 2 pump", "", None),
        ("VGV 2 foo", "", ("vgv2", "", 0.4)),
        ("vorleitschaufl", "", ("vigv", "", 0.88)),
        # the role: demand, measured, or unsaid
        ("speed_demand", "", ("n_dem", "", 0.98)),
        ("speed", "", ("n_r", "", 0.85)),
        ("Rotor Speed", "", ("n_r", "", 0.85)),
        ("speed_act", "", ("n_r", "", 0.98)),
        ("speed_ist_soll", "", None),
        ("stroke", "", ("x_lvdt", "", 0.85)),
        ("stroke_cmd", "", ("x_dem", "", 0.98)),
        ("Hub_Ist", "", ("x_lvdt", "", 0.98)),
        ("valve current act", "", None),
        ("ACT_POS_CMD", "", ("x_dem", "", 0.98)),
        ("speed_act_cmd", "", ("n_dem", "", 0.4)),
        # a number, a misspelling, and two channels of a sensor cost a tenth each; N1 is a rotor
        ("speed_2", "", ("n_r", "", 0.75)),
        ("N1", "", ("n_r", "", 0.85)),
        ("N1_act", "", ("n_r", "", 0.98)),
        ("N1_act_2", "", ("n_r", "", 0.88)),
        ("presure_supply", "", ("p_s", "", 0.88)),
        ("presure_supply_2", "", ("p_s", "", 0.78)),
        ("drehzhal_soll", "", ("n_dem", "", 0.88)),
        ("LVDT", "", ("x_lvdt", "", 0.98)),
        ("LVDT_A", "", ("x_lvdt", "", 0.88)),
        ("LVDT_B", "", ("x_lvdt", "", 0.88)),
        ("LVDT_C", "", ("x_lvdt", "", 0.4)),
        ("A_LVDT", "", ("x_lvdt", "", 0.4)),
        # one letter, or one and a number, may be anything; two letters of a stroke are a coordinate
        ("n", "", ("n_r", "", 0.5)),
        ("x", "", ("x_lvdt", "", 0.5)),
        ("p", "", ("p_s", "", 0.5)),
        ("x2", "", ("x_lvdt", "", 0.5)),
        ("position_x", "", ("x_lvdt", "", 0.5)),
        ("lvdt_x_pos", "", ("x_lvdt", "", 0.98)),
        # what must be said: a valve, a supply, an oil; what else is said makes it another's
        ("servo_current", "", ("i_cmd", "", 0.75)),
        ("current", "", ("i_cmd", "", 0.5)),
        ("valve_current_cmd", "", ("i_cmd", "", 0.98)),
        ("supply_pressure", "", ("p_s", "", 0.98)),
        ("pressure", "", ("p_s", "", 0.5)),
        ("pump_pressure_2", "", ("p_s", "", 0.88)),
        ("oil_supply_pressure", "", ("p_s", "", 0.98)),
        ("oil_temp", "", ("t_oil", "", 0.98)),
        ("supply_oil_temp", "", ("t_oil", "", 0.98)),
        ("temp", "", ("t_oil", "", 0.5)),
        ("engine_oil_temp", "", ("t_oil", "", 0.4)),
        ("fuel_pressure", "", ("p_s", "", 0.4)),
        ("speed_foo", "", ("n_r", "", 0.4)),
        ("speed pressure", "", None),
        ("speed_bar", "", ("n_r", "", 0.4)),
        # the unit says what the name does not
        ("valve", "mA", ("i_cmd", "", 0.75)),
        ("valve", "mm", None),
        ("supply", "bar", ("p_s", "", 0.98)),
        ("supply", "mA", None),
        ("oil", "degC", ("t_oil", "", 0.98)),
        ("oil", "mm", None),
        ("actuator", "mm", ("x_lvdt", "", 0.85)),
        ("actuator", "bar", None),
        ("act_cmd", "mm", ("x_dem", "", 0.98)),
        ("act_cmd", "mA", None),
        ("vgv_act", "mm", ("x_lvdt", "", 0.98)),
        ("vgv", "mm", None),
        ("vgv_pos", "", ("x_lvdt", "", 0.5)),
        ("vgv_pos_mm", "", ("x_lvdt", "mm", 0.85)),
        ("vgv_stroke", "", ("x_lvdt", "", 0.85)),
        ("pos_vane1", "", ("x_lvdt", "", 0.5)),
        ("pos_vane1", "deg", ("vgv1", "", 0.88)),
        ("pos_vane1", "mm", ("x_lvdt", "", 0.75)),
        ("weg_vane1", "deg", ("x_lvdt", "", 0.75)),
        # the path counts where the name alone says too little, and may say that it is another part's
        ("supply.pressure", "", ("p_s", "", 0.98)),
        ("foo.speed_act", "", ("n_r", "", 0.98)),
        ("servo/ current", "", ("i_cmd", "", 0.75)),
        ("coolant.supply_pressure", "", ("p_s", "", 0.4)),
        ("luft::speed", "", ("n_r", "", 0.4)),
        ("supply.foo", "", None),
        ("oil.temp", "", ("t_oil", "", 0.98)),
        # words without a gap, apart, with capitals
        ("solldrehzahl", "", ("n_dem", "", 0.98)),
        ("NHist", "", ("n_r", "", 0.98)),
        ("nhist", "", ("n_r", "", 0.98)),
        ("versorgungsdruck", "", ("p_s", "", 0.98)),
        ("set point speed", "", ("n_dem", "", 0.98)),
        ("inlet guide vane", "", ("vigv", "", 0.98)),
        ("nSoll", "", ("n_dem", "", 0.98)),
        ("xsoll", "", ("x_dem", "", 0.98)),
        ("VSVs 2", "", ("vgv2", "", 0.98)),
        ("VSV_S1", "", ("vgv1", "", 0.98)),
        ("x_s1", "", ("x_lvdt", "", 0.5)),
        ("Drehzahl (Soll)", "", ("n_dem", "", 0.98)),
        ("Druck_Versorgung_\u00d6l", "", ("p_s", "", 0.98)),
        ("t", "", None),
        ("time", "", None),
        ("foo", "", None),
        ("state", "", None),
        ("vgvx 2", "", None),
    ],
)
def test_a_name_says_the_signal_the_unit_and_how_surely(
    name: str, unit: str, said: tuple[str, str, float] | None
) -> None:
    m = meaning(name, ALL, unit)
    assert (m and (m.signal, m.unit, m.confidence)) == said


def test_a_name_is_only_a_signal_that_is_looked_for() -> None:
    assert meaning("speed_demand", ("n_r",)) is None
    assert meaning("vgv3", ("vgv2",)) is None
    assert meaning("speed", ("x_dem", "n_r")) is not None


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("n_dem", "is called n_dem"), ("Rotor Speed", "its name says speed, rotor"), ("VSV3", "its name says vane"),
        ("valve_current_cmd", "its name says current, valve, demand"), ("vigv_act", "its name says vigv, actual"),
        ("speed_foo_bla_qq_ww", "its name says speed; foo, bla, qq is not known"),
        ("vgv_pos", "a stroke or an angle: no unit says which"),
        ("coolant.supply_pressure", "its name says pressure, supply, but of another part"),
    ],
)  # fmt: skip
def test_a_meaning_says_why(name: str, why: str) -> None:
    m = meaning(name, ALL)
    assert m is not None and m.why == why


@pytest.mark.parametrize(
    ("name", "unit", "why"),
    [
        ("foo", "", "no signal of the model has such a name"),
        ("signal_out", "", "no signal of the model has such a name"),
        ("engine", "", "no signal of the model has such a name"),
        ("soll", "", "no signal of the model has such a name"),
        ("speed_foo_bla_qq_ww", "", "no signal of the model has such a name: 'foo', 'bla', 'qq' is not known"),
        ("VGV_CMD", "", "a stroke or an angle: no unit says which"),
        ("VGV1_CMD", "", "the model has no demand of a vane's angle"),
        ("VGV_angle_CMD", "", "the model has no demand of a vane's angle"),
        ("VGV", "", "it does not say of which vane row"),
        ("VGV 9", "", "the model has no such signal: vgv"),
        ("speed pressure", "", "it says speed and pressure"),
        ("oil", "mm", "it does not say what is measured; a unit would"),
        ("vane current pressure", "", "it does not say what is measured; a unit would"),
        ("valve current act", "", "the model has no such signal: valve, current, actual"),
        ("valve", "mA", "the model has no such signal: valve"),
        ("speed_foos", "", "no signal of the model has such a name: 'foos' is not known"),
    ],
)
def test_what_a_name_lacks_is_said_in_a_few_words(name: str, unit: str, why: str) -> None:
    assert lacks(name, unit) == why


@pytest.mark.parametrize(
    ("name", "words", "unit", "quantity"),
    [
        ("PosMm", ("pos",), "mm", "stroke"), ("speed_rpm", ("speed",), "rpm", "speed"),
        ("speed 1/min", ("speed",), "rpm", "speed"), ("speed_u_min", ("speed",), "rpm", "speed"),
        ("pressure_k", ("pressure", "k"), "", "pressure"), ("oiltemp_k", ("oil", "temp"), "K", "temperature"),
        ("oiltempk", ("oiltempk",), "", ""), ("oil_temp2c", ("oil", "temp", "2", "c"), "", "temperature"),
        ("speed_%", ("speed",), "%", "speed"),
        ("pressure_mpa", ("pressure",), "MPa", "pressure"), ("mpa", ("mpa",), "", ""),
        ("oil_temp_deg_c", ("oil", "temp"), "degC", "temperature"), ("vigv_grad", ("vigv",), "deg", "vigv"),
        ("vgv_2_mrad", ("vgv", "2"), "mrad", "vgv"), ("hub [mm]", ("hub",), "", "stroke"),
        ("vgv_2_mm", ("vgv", "2", "mm"), "", "vgv"), ("jack_um", ("jack",), "um", "stroke"),
    ],
)  # fmt: skip
def test_a_unit_at_the_end_of_a_name_is_one_of_its_quantity(
    name: str, words: tuple[str, ...], unit: str, quantity: str
) -> None:
    assert unit_in_name(name) == (words, unit, quantity)


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("load [kN]", ("load [kN]", "")), ("load [mm]", ("load", "mm")), ("load (bar)", ("load", "bar")),
        ("flow_bar", ("flow", "bar")), ("flow_deg_c", ("flow", "degC")), ("flowMm", ("flow", "mm")),
        ("flow_a", ("flow_a", "")), ("flow %", ("flow %", "")), ("mm", ("mm", "")), ("bar mm", ("bar", "mm")),
        ("deg c", ("deg c", "")), ("a[1] - rpm", ("a[1]", "rpm")),
    ],
)  # fmt: skip
def test_a_unit_behind_any_name_has_two_letters_or_a_bracket(name: str, found: tuple[str, str]) -> None:
    assert unit_behind(name) == found


@pytest.mark.parametrize(
    ("unit", "kind"),
    [
        ("rpm", "speed"),
        ("Hz", "speed"),
        ("%", ""),
        ("1/min", "speed"),
        ("ms", "time"),
        ("mm", "stroke"),
        ("uA", "current"),
        ("psi", "pressure"),
        ("\u00b0C", "temperature"),
        ("\u00b0", "angle"),
        ("mrad", "angle"),
        ("-bar", "pressure"),
        ("kN", ""),
        ("", ""),
        (" mm ", "stroke"),
        ("\u00b5m", "stroke"),
    ],
)
def test_a_unit_is_of_a_quantity(unit: str, kind: str) -> None:
    assert unit_kind(unit) == kind


def test_a_bracket_at_the_end_holds_a_unit_or_nothing() -> None:
    assert [bracketed(n) for n in ("a [mm]", "a (%)", "a [kN]", "a", "a [mm] b", "a[1] [ bar ]")] == [
        "mm", "%", "", "", "", "bar"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "sure", "unit"),
    [
        ("t", CERTAIN, ""), ("t_s", CERTAIN, "s"), ("Time", CERTAIN, ""), ("time_ms", CERTAIN, "ms"),
        ("time 2", CERTAIN - 0.1, ""), ("timestmap", CERTAIN - 0.1, ""), ("timestmap 2", CERTAIN - 0.2, ""),
        ("log start time", CERTAIN, ""), ("system time", CERTAIN, ""), ("time of flight", 0.0, ""),
        ("oil time", 0.0, ""), ("start", 0.0, ""), ("speed", 0.0, ""), ("Messzeit [s]", CERTAIN, ""),
    ],
)  # fmt: skip
def test_a_time_is_called_so_and_nothing_else(name: str, sure: float, unit: str) -> None:
    said = is_time(name)
    assert said[0] == pytest.approx(sure, abs=1e-9) and said[1] == unit


def test_a_rotor_is_its_number_or_its_letters() -> None:
    rotors = {"N1_DEM": ("1",), "NH act": ("hp",), "NL": ("lp",), "hp speed": ("hp",), "N speed": (), "ND": ("lp",),
              "HD Drehzahl 2": ("2", "hp")}  # fmt: skip
    assert {n: spool(n) for n in rotors} == rotors


# ---- guesses ---------------------------------------------------------------------------------------------------------


class Columns:
    """A source of columns: name -> values, or (values, unit); None: words."""

    kind, sorted = "column", False

    def __init__(self, /, comments: Any = None, **columns: Any):
        self.columns, self.notes = columns, list[str]()
        self.names = {n: (n,) for n in columns}
        self.comments = comments or {}

    def series(self, key: str) -> Series:
        of = self.columns[key]
        if of is None:
            raise LogError("words")
        values, unit = of if isinstance(of, tuple) else (of, "")
        values = np.asarray(values, float)
        return Series(0.01 * np.arange(values.size), values, unit)

    def has(self) -> str:
        return ""

    def absent(self, name: str) -> str:
        return ""


def wave(low: float, high: float, n: int = 400) -> np.ndarray:
    """A channel between two values, at both of which it stays: its 99th percentile is ``high``."""
    w = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / 200)
    return low + (high - low) * np.clip(1.2 * w - 0.1, 0.0, 1.0)


def guessed(signal: str, source: Columns, **more: Any) -> Any:
    arguments = {"taken": set(), "stated": {}, "design_rpm": None, "missing": [signal]} | more
    return guess(source, **arguments)  # type: ignore[arg-type]


SUPPLY, STROKE, CURRENT, OIL, SPEED = "supply_pressure", "stroke_act", "servo_current_cmd", "oil_temp", "speed_act"


@pytest.mark.parametrize(
    ("signal", "name", "size", "unit"),
    [
        # the greatest value that shows a unit, just inside and just outside each end
        ("n_r", SPEED, 20.1, "%"), ("n_r", SPEED, 19.9, ""), ("n_r", SPEED, 129.9, "%"), ("n_r", SPEED, 130.1, ""),
        ("n_r", SPEED, 0.201, "ratio"), ("n_r", SPEED, 0.199, ""), ("n_r", SPEED, 1.299, "ratio"),
        ("n_r", SPEED, 1.301, ""), ("n_r", SPEED, 999.0, ""), ("n_r", SPEED, 1001.0, "rpm"),
        ("n_r", SPEED, 199_900.0, "rpm"), ("n_r", SPEED, 200_100.0, ""),
        ("x_lvdt", STROKE, 6.01, "mm"), ("x_lvdt", STROKE, 59.9, "mm"), ("x_lvdt", STROKE, 60.1, ""),
        ("x_lvdt", STROKE, 0.00401, "m"), ("x_lvdt", STROKE, 0.00399, ""), ("x_lvdt", STROKE, 0.0599, "m"),
        ("x_lvdt", STROKE, 0.0601, ""), ("x_lvdt", STROKE, 5_990.0, ""), ("x_lvdt", STROKE, 6_010.0, "um"),
        ("x_lvdt", STROKE, 59_900.0, "um"), ("x_lvdt", STROKE, 60_100.0, ""), ("x_lvdt", STROKE, 0.41, "inch"),
        ("x_lvdt", STROKE, 0.39, ""), ("x_lvdt", STROKE, 0.599, "inch"), ("x_lvdt", STROKE, 0.601, ""),
        ("x_lvdt", STROKE, 2.39, ""), ("x_lvdt", STROKE, 2.41, "cm"), ("x_lvdt", STROKE, 5.99, "cm"),
        ("i_cmd", CURRENT, 0.51, "mA"), ("i_cmd", CURRENT, 0.49, ""), ("i_cmd", CURRENT, 99.9, "mA"),
        ("i_cmd", CURRENT, 100.1, ""), ("i_cmd", CURRENT, 0.00051, "A"), ("i_cmd", CURRENT, 0.00049, ""),
        ("i_cmd", CURRENT, 0.0999, "A"), ("i_cmd", CURRENT, 0.101, ""), ("i_cmd", CURRENT, 499.0, ""),
        ("i_cmd", CURRENT, 501.0, "uA"), ("i_cmd", CURRENT, 0.999e5, "uA"), ("i_cmd", CURRENT, 1.001e5, ""),
        ("p_s", SUPPLY, 7.99, ""), ("p_s", SUPPLY, 8.01, "MPa"), ("p_s", SUPPLY, 39.9, "MPa"),
        ("p_s", SUPPLY, 40.1, ""), ("p_s", SUPPLY, 79.9, ""), ("p_s", SUPPLY, 80.1, "bar"),
        ("p_s", SUPPLY, 399.0, "bar"), ("p_s", SUPPLY, 401.0, ""), ("p_s", SUPPLY, 1_199.0, ""),
        ("p_s", SUPPLY, 1_201.0, "psi"), ("p_s", SUPPLY, 5_799.0, "psi"), ("p_s", SUPPLY, 5_801.0, ""),
        ("p_s", SUPPLY, 7_990.0, ""), ("p_s", SUPPLY, 8_010.0, "kPa"), ("p_s", SUPPLY, 3.99e4, "kPa"),
        ("p_s", SUPPLY, 4.01e4, ""), ("p_s", SUPPLY, 7.99e6, ""), ("p_s", SUPPLY, 8.01e6, "Pa"),
        ("p_s", SUPPLY, 3.99e7, "Pa"), ("p_s", SUPPLY, 4.01e7, ""),
        ("t_oil", OIL, 4.9, ""), ("t_oil", OIL, 5.1, "degC"), ("t_oil", OIL, 89.9, "degC"), ("t_oil", OIL, 90.1, ""),
        ("t_oil", OIL, 159.0, ""), ("t_oil", OIL, 161.0, "degF"), ("t_oil", OIL, 249.9, "degF"),
        ("t_oil", OIL, 250.1, ""), ("t_oil", OIL, 252.9, ""), ("t_oil", OIL, 253.1, "K"), ("t_oil", OIL, 432.9, "K"),
        ("t_oil", OIL, 433.1, ""),
        ("vgv1", "VSV1", 3.01, "deg"), ("vgv1", "VSV1", 2.99, ""), ("vgv1", "VSV1", 89.9, "deg"),
        ("vgv1", "VSV1", 90.1, ""), ("vgv1", "VSV1", 0.051, "rad"), ("vgv1", "VSV1", 0.049, ""),
        ("vgv1", "VSV1", 1.569, "rad"), ("vgv1", "VSV1", 1.571, ""),
    ],
)  # fmt: skip
def test_values_tell_the_unit_where_one_alone_makes_them_usual(signal: str, name: str, size: float, unit: str) -> None:
    found = guessed(signal, Columns(**{name: wave(0.9 * size, size)}), design_rpm=10_000.0)
    assert (found.made[signal].unit if signal in found.made else "") == unit
    assert bool(unit) or "not guessed" in found.open[signal]


def test_a_guess_is_as_sure_as_its_name_times_its_unit() -> None:
    assert guessed("x_lvdt", Columns(stroke_act=wave(2, 40))).made["x_lvdt"].confidence == pytest.approx(0.98 * 0.95)
    assert guessed("p_s", Columns(supply_pressure=wave(200, 210))).made["p_s"].confidence == pytest.approx(0.98 * 0.9)
    (g,) = guessed("p_s", Columns(supply_pressure=(wave(200, 210), "bar"))).made.values()
    assert (g.confidence, g.unit, g.why) == (CERTAIN, "bar", "its name says pressure, supply; the log says bar")
    assert g.note() == (
        "p_s: guessed to be 'supply_pressure' in bar, 98 % sure (its name says pressure, supply; the log says bar); "
        "--map NAME=p_s takes another, --no-guess none"
    )
    assert Guess("state", "mode", "", 0.5, "why").note().startswith("state: guessed to be 'mode' in -, 50 % sure (why)")


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"supply_pressure": []}, "(it has no sample)"),
        ({"supply_pressure": np.full(30, np.nan)}, "(it has no sample)"),
        ({"supply_pressure_bar": (wave(200, 210), "psi")}, "(the log says psi, its name says bar)"),
        ({"supply_pressure": np.arange(21.0)}, "(it counts the rows)"),
        ({"supply_pressure": (wave(1, 2), "mm")}, "(the log says mm, which is no unit of p_s)"),
        ({"supply_pressure": (wave(300, 700), "MPa")}, "(the log says MPa, but all values are outside -1 to 60 MPa"),
        ({"supply_pressure": (wave(1, 7.9), "MPa")}, "its values reach 7.9 MPa, and a supply has 8 to 40"),
        ({"supply_pressure": (wave(1, 401), "bar")}, "its values reach 40.1 MPa, and a supply has 8 to 40"),
        ({"stroke_act": wave(0.5, 8.0)}, None),
        ({"stroke_act": wave(0.3, 0.5)}, None),
        ({"supply_pressure": wave(0, 1)}, "(its values reach 1, which no p_s does in any usual unit)"),
        ({"pressure": wave(20, 21)}, "(its name says pressure; that is not enough)"),
    ],
)
def test_what_speaks_against_a_guess_is_said(columns: dict[str, Any], said: str | None) -> None:
    signal = "x_lvdt" if "stroke_act" in columns else "p_s"
    found = guessed(signal, Columns(**columns))
    if said is None:
        assert signal in found.made
    else:
        assert not found.made and said in found.open[signal]
        assert (
            found.open[signal].startswith("may be '") and "not guessed; --map NAME=p_s takes one" in found.open["p_s"]
        )


def test_counts_are_rows_from_the_twenty_first_on() -> None:
    assert "x_lvdt" in guessed("x_lvdt", Columns(stroke_act=7.0 + np.arange(20.0))).made
    assert "x_lvdt" not in guessed("x_lvdt", Columns(stroke_act=7.0 + np.arange(21.0))).made


def test_two_units_that_are_possible_are_named() -> None:
    assert guessed("t_oil", Columns(oil_temp=wave(90, 120))).open["t_oil"] == (
        "may be 'oil_temp' (its values reach 120: degC or degF? --unit t_oil=degC states it): not guessed; "
        "--map NAME=t_oil takes one"
    )
    assert "its values reach 1: inch, cm?" in guessed("x_lvdt", Columns(stroke_act=wave(0.2, 1.0))).open["x_lvdt"]


def test_a_unit_that_nobody_knows_is_passed_over_and_one_beside_the_same_is_no_contradiction() -> None:
    assert guessed("p_s", Columns(supply_pressure=(wave(200, 210), "quux"))).made["p_s"].unit == "bar"
    assert guessed("p_s", Columns(supply_pressure=(wave(200, 210), "1"))).made["p_s"].unit == "bar"
    assert guessed("p_s", Columns(supply_pressure_bar=(wave(200, 210), "bar"))).made["p_s"].unit == "bar"
    # the user's word goes before the file's and needs no usual size; its sign turns the channel
    made = guessed("p_s", Columns(supply_pressure=(wave(1, 7), "MPa")), stated={"p_s": "MPa"}).made["p_s"]
    assert (made.unit, made.confidence) == ("MPa", CERTAIN) and made.why.endswith("you say MPa")
    turned = guessed("x_lvdt", Columns(stroke_act=wave(-70, -30)), stated={"x_lvdt": "-mm"})
    assert turned.made["x_lvdt"].unit == "-mm"
    assert not guessed("x_lvdt", Columns(stroke_act=wave(-70, -30)), stated={"x_lvdt": "mm"}).made


def test_a_speed_in_turns_waits_for_the_design_speed() -> None:
    source = Columns(speed_act=(wave(7_000, 9_000), "rpm"))
    waits = guessed("n_r", source)
    assert not waits.made and waits.rpm == {"n_r": "speed_act"}
    assert waits.open == {"n_r": "'speed_act' is in rpm and needs the design speed: --design-rpm R"}
    assert waits.unused["speed_act"].startswith("n_r? its name says")
    assert guessed("n_r", source, design_rpm=10_000.0).made["n_r"].unit == "rpm"
    assert "outside -10 to 150 %" in guessed("n_r", source, design_rpm=4_000.0).open["n_r"]
    assert guessed("n_r", source, design_rpm=7_000.0).made["n_r"].unit == "rpm"  # 9000 is 129 %
    assert guessed("n_r", Columns(speed_act=(wave(70, 90), "%"))).made["n_r"].unit == "%"
    assert guessed("n_r", Columns(speed_act=(wave(120, 150), "Hz"))).rpm == {"n_r": "speed_act"}
    demand = guessed("n_dem", Columns(speed_cmd=(wave(7_000, 9_000), "rpm")))
    assert demand.rpm == {"n_dem": "speed_cmd"} and "speed_cmd" in demand.open["n_dem"]


def test_two_names_within_a_tenth_are_alike_and_the_surer_wins_beyond() -> None:
    alike = guessed("n_r", Columns(speed_act=wave(70, 90), speed_meas=wave(70, 91), speed_act_2=wave(60, 80)))
    assert alike.open["n_r"] == (
        "may be 'speed_act' or 'speed_meas' or 'speed_act_2': not guessed; --map NAME=n_r takes one"
    )
    assert alike.unused["speed_act"] == "two could be n_r: 'speed_act' or 'speed_meas' or 'speed_act_2'"
    won = guessed("n_r", Columns(speed_act=wave(70, 90), speed=wave(70, 91)))  # 0.98 against 0.85
    assert won.made["n_r"].name == "speed_act" and won.unused == {"speed": "n_r is 'speed_act', more surely"}
    five = guessed("n_r", Columns(**{f"speed_{w}": wave(70, 90) for w in ("act", "meas", "ist", "fbk", "sel")}))
    assert five.open["n_r"].count(" or ") == 3


def test_a_name_that_is_taken_or_not_missing_is_no_candidate() -> None:
    source = Columns(speed_act=wave(70, 90))
    assert not guessed("n_r", source, taken={"speed_act"}).made
    other = guessed("x_dem", source)
    assert not other.made and other.unused == {"speed_act": "n_r has a name already"}
    assert guess(source, ["state", "foo"], set(), {}, None).made == {}  # type: ignore[arg-type]


def test_words_and_names_without_a_meaning_are_told() -> None:
    found = guessed("n_r", Columns(speed_act=None, foo=None, oil=wave(1, 2)))
    assert found.unused["speed_act"] == "words, not numbers"
    assert found.unused["foo"] == "no signal of the model has such a name"
    assert found.unused["oil"] == "it does not say what is measured; a unit would"
    assert guessed("x_lvdt", Columns(jack=(wave(2, 40), "mm"))).made["x_lvdt"].confidence == 0.85


def test_a_comment_says_what_a_name_does_not_a_twentieth_less_surely() -> None:
    source = Columns({"foo": "measured rotor speed"}, foo=wave(70, 90))
    (g,) = guessed("n_r", source).made.values()
    assert g.confidence == pytest.approx(0.93 * 0.95) and g.why.startswith("its comment: 'measured rotor speed'")
    spaces = " " * 60 + "measured rotor speed"
    assert guessed("n_r", Columns({"foo": spaces}, foo=wave(70, 90))).made
    assert not guessed("n_r", Columns({"foo": " " + spaces}, foo=wave(70, 90))).made  # of 81 letters


def test_a_measured_speed_is_of_the_rotor_of_the_demand() -> None:
    both = Columns(N1_DEM=wave(70, 90), N2_ACT=wave(60, 80))
    found = guess(both, ["n_dem", "n_r"], set(), {}, None)  # type: ignore[arg-type]
    assert set(found.made) == {"n_dem"}
    assert "'N2_ACT' (another rotor than that of 'N1_DEM')" in found.open["n_r"]
    for other in ("N1_ACT", "speed_act"):
        same = Columns(N1_DEM=wave(70, 90), **{other: wave(60, 80), "N2_ACT": wave(50, 70)})
        assert guess(same, ["n_dem", "n_r"], set(), {}, None).made["n_r"].name == other  # type: ignore[arg-type]


def test_vanes_counted_from_one_need_the_name_of_the_inlet() -> None:
    vanes = {f"Vane{k}": wave(3, 30) for k in (1, 2, 3)}
    missing = list(VANES)
    assert not guess(Columns(**vanes), missing, set(), {}, None).made  # type: ignore[arg-type]
    assert "1 may be it" in guess(Columns(**vanes), missing, set(), {}, None).open["vgv2"]  # type: ignore[arg-type]
    assert len(guess(Columns(**vanes, IGV=wave(3, 30)), missing, set(), {}, None).made) == 4  # type: ignore[arg-type]
    assert len(guess(Columns(**vanes), missing[1:], set(), {}, None).made) == 3  # type: ignore[arg-type]
    two = {n: vanes[n] for n in ("Vane1", "Vane2")}
    assert len(guess(Columns(**two), missing, set(), {}, None).made) == 2  # type: ignore[arg-type]
    named = {f"VSV{k}": wave(3, 30) for k in (1, 2, 3)}
    assert len(guess(Columns(**named), missing, set(), {}, None).made) == 3  # type: ignore[arg-type]
    assert len(guess(Columns(**vanes, Vane4=wave(3, 30)), missing, set(), {}, None).open) == 4  # type: ignore[arg-type]


# ---- guesses against the other signals -------------------------------------------------------------------------------


T = 0.01 * np.arange(1000)
UP = 40.0 + 40.0 * np.sin(2 * np.pi * T / 10.0)


def clash(guessed_too: str, **channels: np.ndarray) -> dict[str, str]:
    return contradictions({n: (T[: v.size], v) for n, v in channels.items()}, set(guessed_too.split()))


def test_a_demand_and_its_measurement_are_of_one_size_and_sign() -> None:
    assert clash("n_r", n_dem=UP, n_r=UP + 14.9) == {}
    assert clash("n_r", n_dem=UP, n_r=UP + 15.1) == {"n_r": "it is 15.1 % away from n_dem half of the time"}
    assert clash("x_lvdt", x_dem=UP, x_lvdt=UP - 15.1) == {"x_lvdt": "it is 15.1 mm away from x_dem half of the time"}
    assert clash("n_dem", n_dem=UP, n_r=UP + 20.0) == {"n_dem": "it is 20 % away from n_r half of the time"}
    assert clash("n_r", n_dem=UP, n_r=-UP - 4.9) == {"n_r": "it is n_dem with the other sign; --unit n_r=-% turns it"}
    assert "away" in clash("n_r", n_dem=UP, n_r=-UP - 5.1)["n_r"]
    assert clash("", n_dem=UP, n_r=UP + 100.0) == {}
    # twenty samples in common prove nothing, twenty-one do
    assert clash("n_r", n_dem=UP, n_r=UP[:20] + 100.0) == {}
    assert clash("n_r", n_dem=UP, n_r=UP[:21] + 100.0) != {}


def test_what_moves_against_the_machine_is_contradicted_by_its_correlation() -> None:
    against = "it runs against n_r: our stroke grows with the speed"
    assert clash("x_lvdt", n_r=UP, x_lvdt=48.0 - 0.5 * UP) == {"x_lvdt": against}
    assert clash("n_r", n_r=UP, x_lvdt=48.0 - 0.5 * UP)["n_r"].startswith("it runs against x_lvdt")
    small = UP / np.ptp(UP)
    assert clash("n_r", n_r=7.9 * small, x_lvdt=-20.0 * small) == {}
    assert clash("n_r", n_r=8.1 * small, x_lvdt=-20.0 * small) != {}
    assert clash("n_r", n_r=20.0 * small, x_lvdt=-7.9 * small) == {}
    assert clash("n_r", n_r=20.0 * small, x_lvdt=-8.1 * small) != {}
    turned = {"vgv1": "it runs against x_lvdt; --unit vgv1=-deg turns its sign"}
    assert clash("vgv1", vgv1=-3.9 * small, x_lvdt=20.0 * small) == {}
    assert clash("vgv1", vgv1=-4.1 * small, x_lvdt=20.0 * small) == turned
    assert clash("vgv1", vgv1=-20.0 * small, x_lvdt=5.9 * small) == {}
    assert clash("vgv1", vgv1=-20.0 * small, x_lvdt=6.1 * small) == turned
    assert clash("vgv1", vgv1=-4.1 * small, n_dem=7.9 * small) == {}
    assert "runs against n_dem" in clash("vgv1", vgv1=-4.1 * small, n_dem=8.1 * small)["vgv1"]
    other = np.cos(2 * np.pi * T / 10.0) * 0.5
    for way, wrong in ((0.69, False), (0.71, True)):  # its correlation with the stroke
        mixed = 20.0 * (-way * 2.0 * (small - small.mean()) + np.sqrt(1 - way**2) * 2.0 * other)
        assert (clash("vgv1", vgv1=mixed, x_lvdt=20.0 * small) != {}) == wrong


def test_a_current_that_drives_the_stroke_backwards_is_turned() -> None:
    drive = 5.0 * np.cos(2 * np.pi * T / 5.0)
    stroke = 20.0 + 12.0 * np.sin(2 * np.pi * T / 5.0)
    assert clash("i_cmd", i_cmd=drive, x_lvdt=stroke) == {}
    said = "drives the stroke backwards; --unit i_cmd=-mA turns its sign"
    assert said in clash("i_cmd", i_cmd=-drive, x_lvdt=stroke)["i_cmd"]
    assert "drives n_r backwards" in clash("i_cmd", i_cmd=-drive, n_r=stroke)["i_cmd"]
    assert clash("", i_cmd=-drive, x_lvdt=stroke) == {}
    assert clash("i_cmd", i_cmd=-0.099 * drive, x_lvdt=stroke) == {}  # moves less than 1 mA
    assert clash("i_cmd", i_cmd=-0.101 * drive, x_lvdt=stroke) != {}
    rate = 12.0 * 2 * np.pi / 5.0 * 2.0  # mm/s from peak to peak
    assert clash("i_cmd", i_cmd=-drive, x_lvdt=stroke * 1.9 / rate) == {}
    assert clash("i_cmd", i_cmd=-drive, x_lvdt=stroke * 2.1 / rate) != {}


def by_schedule(speed: np.ndarray) -> np.ndarray:
    """The shipped controller's mean curve: mm."""
    return np.interp(speed, *mean_stroke({}))


def test_a_stroke_far_from_the_schedule_has_another_zero_or_unit() -> None:
    speed = 60.0 + 40.0 * np.sin(2 * np.pi * T / 10.0)
    planned = by_schedule(speed)
    reach = float(np.ptp(by_schedule(np.linspace(0.0, 120.0, 1001))))
    assert reach == pytest.approx(44.0, abs=0.5)
    assert clash("x_dem", n_r=speed, x_dem=planned) == {}
    assert clash("x_dem", n_r=speed, x_dem=planned + 0.179 * reach) == {}
    assert clash("x_dem", n_r=speed, x_dem=planned + 0.181 * reach) == {
        "x_dem": "it is 8 mm away, half of the time, from what the schedule says at n_r; "
        "--map NAME=x_dem takes it as it is"
    }
    middle = planned.mean()
    assert clash("x_dem", n_r=speed, x_dem=middle + 1.49 * (planned - middle)) == {}
    wide = clash("x_dem", n_r=speed, x_dem=middle + 1.51 * (planned - middle))["x_dem"]
    assert wide.startswith("it moves 1.5 times as far as the schedule says at n_r")
    assert clash("x_dem", n_r=speed, x_dem=middle + 0.671 * (planned - middle)) == {}
    assert clash("x_dem", n_r=speed, x_dem=middle + 0.66 * (planned - middle)) != {}
    assert clash("", n_r=speed, x_dem=planned + 30.0) == {}


def test_a_vane_that_follows_another_stage_s_schedule_is_told() -> None:
    schedules = load_schedules("schedules.toml")
    speed = 60.0 + 40.0 * np.sin(2 * np.pi * T / 10.0)
    angles = np.rad2deg(schedules.targets(speed))
    first, last = schedules.vanes[0], schedules.vanes[-1]
    assert clash(first, n_r=speed, **{first: angles[:, 0]}) == {}
    assert clash(first, n_dem=speed, **{first: angles[:, -1]}) == {
        first: f"it moves as {last} does; --map NAME={first} takes it as it is"
    }
    assert clash("", n_r=speed, **{first: angles[:, -1]}) == {}
    # a third of the distance to its own is not clear, nor what lies within 2 degrees of its own
    apart = float(np.median(np.abs(angles[:, 0] - angles[:, -1])))
    way = np.sign(angles[:, 0] - angles[:, -1])
    between = angles[:, -1] + way * np.minimum(0.26 * apart, np.abs(angles[:, 0] - angles[:, -1]))
    assert apart > 4.0 and clash(first, n_r=speed, **{first: angles[:, -1] - 0.0 * between}) != {}


@pytest.mark.parametrize(("scale", "rpm"), [(10_000.0, 10_000.0), (12_500.0, 12_500.0), (9_460.0, 9_460.0)])
def test_the_design_speed_is_that_under_which_the_stroke_follows_the_schedule(scale: float, rpm: float) -> None:
    speed = 60.0 + 35.0 * np.sin(2 * np.pi * T / 10.0)
    found, why = design_speed((T, speed * scale / 100.0), (T, by_schedule(speed)))
    assert found == pytest.approx(rpm, rel=0.01)
    assert why.startswith("the stroke follows the schedule best with ") and why.endswith(" rpm")
    top, because = design_speed((T, speed * scale / 100.0), None)
    assert top == pytest.approx(0.95 * scale, rel=0.01) and because.startswith("the largest speed is ")
    still = design_speed((T, speed * scale / 100.0), (T, np.full(T.size, 20.0)))
    assert still == (top, because)
    wrong = design_speed((T, speed * scale / 100.0), (T, 20.0 + 5.0 * np.sin(T)))
    assert wrong == (top, because)  # no design speed brings it within 2 mm


@pytest.mark.parametrize(
    ("top", "said"), [(9_950.0, 10_000.0), (10_400.0, 10_400.0), (12_345.0, 12_300.0), (997.0, 1000.0)]
)
def test_a_design_speed_has_two_digits_or_three_within_one_per_cent(top: float, said: float) -> None:
    assert design_speed((T, np.full(T.size, top)), None) == (said, f"the largest speed is {top:,.0f} rpm")


# ---- what a channel can hold -----------------------------------------------------------------------------------------


LIMITS = {
    "n_dem": (-10.0, 150.0), "n_r": (-10.0, 150.0), "x_dem": (-25.0, 75.0), "x_lvdt": (-25.0, 75.0),
    **dict.fromkeys(SIDES, (-25.0, 75.0)),
    "i_cmd": (-100.0, 100.0), "p_s": (-1.0, 60.0), "t_oil": (-80.0, 200.0), "state": (0.0, 4.0),
    **dict.fromkeys(VANES, (-90.0, 90.0)),
}  # fmt: skip


@pytest.mark.parametrize("signal", ALL)
def test_a_range_holds_its_ends_and_nothing_beyond(signal: str) -> None:
    low, high = LIMITS[signal]
    inside, why = judge(signal, np.array([low, high, 0.5 * (low + high)]))
    assert inside.all() and why == ""
    inside, why = judge(signal, np.array([np.nextafter(low, -1e9), np.nextafter(high, 1e9)]))
    unit = "" if signal == "state" else f" {UNITS[signal]}"
    assert not inside.any() and why.startswith(f"all values are outside {low:g} to {high:g}{unit} (median of these ")


def test_a_tenth_of_the_telling_samples_may_be_wild() -> None:
    values = np.full(1000, 50.0)
    values[:100] = 3000.0
    assert judge("n_r", values)[1] == ""
    values[100] = 3000.0
    inside, why = judge("n_r", values)
    assert why == "101 of 1,000 values are outside -10 to 150 % (median of these 3,000)"
    assert np.count_nonzero(~inside) == 101
    # what is within a hundredth of the range's end tells nothing
    for rest, refused in ((1.5, True), (1.51, False), (-1.5, True), (-1.51, False)):
        values = np.full(1010, rest)
        values[:101] = 3000.0
        assert bool(judge("n_r", values)[1]) == refused


def test_units_that_would_explain_a_channel_convert_as_pint_does() -> None:
    for signal, r in RANGES.items():
        assert r.unit == UNITS[signal] and r.why
        for unit, factor in (r.large or {}).items():
            if unit == "rpm":
                assert factor == (0.0, 0.0)  # the design speed says it
            else:
                assert factor == pytest.approx(factor_of(unit, r.unit), rel=2e-3)
        if r.small is not None:
            assert r.small[1] == pytest.approx(factor_of(r.small[0], r.unit)[0], rel=1e-6)  # type: ignore[index]
    usual = {"n_dem": 80.0, "x_dem": 24.0, "i_cmd": 5.0, "p_s": 21.0, "t_oil": 40.0, "vigv": 15.0, "state": 0.0}
    assert {s: RANGES[s].typical for s in usual} == usual


@pytest.mark.parametrize(
    ("signal", "value", "said"),
    [
        ("p_s", 21e6, "Pa"),
        ("p_s", 21e3, "kPa"),
        ("p_s", 210.0, "bar"),
        ("p_s", 3045.0, "psi"),
        ("p_s", 7000.0, "psi"),
        ("p_s", 8400.0, "kPa"),
        ("t_oil", 313.0, "K"),
        ("t_oil", 282.5, "degF"),
        ("t_oil", 287.5, "K"),
        ("x_dem", 24e3, "um"),
        ("i_cmd", 5e3, "uA"),
        ("vgv1", 300.0, "mrad"),
        ("p_s", -21e6, "Pa"),
    ],
)
def test_the_unit_that_comes_nearest_to_what_is_usual_is_proposed(signal: str, value: float, said: str) -> None:
    values = np.array([value, 0.9 * value, 1.1 * value, 0.0, 1.0])
    assert proposed(signal, values) == f"--unit {signal}={said}, if it is in {said}"


def test_where_no_unit_explains_it_that_is_asked_for() -> None:
    assert proposed("x_dem", np.array([1e9])) == "--unit x_dem=UNIT says what it is in"
    assert proposed("state", np.array([9.0])) == "map another name to it, or leave it out"
    assert proposed("n_r", np.array([9e3])) == "--unit n_r=rpm --design-rpm R, if it is in rpm"
    # at the very ends of the range: 75 mm are 75,000 um
    assert "um" in proposed("x_dem", np.array([75e3])) and "UNIT" in proposed("x_dem", np.array([75.1e3]))


def steps(size: float, count: int, n: int = 60) -> np.ndarray:
    """Up and down in equal steps, ``count`` of them from end to end."""
    k = np.arange(n) % (2 * count)
    return size * np.minimum(k, 2 * count - k).astype(float)


def small(stated: Any = "", **channels: np.ndarray) -> tuple[dict[str, str], dict[str, str]]:
    return too_small({n: (0.01 * np.arange(v.size), v) for n, v in channels.items()}, set(stated.split()))


@pytest.mark.parametrize(
    ("signal", "enough", "beside", "unit"),
    [
        ("n_r", 0.15, {}, "ratio"), ("x_lvdt", 0.0075, {}, "m"),
        ("vgv1", 0.1571, {"x_dem": np.linspace(0.0, 10.01, 60)}, "rad"),
        ("i_cmd", 0.0005, {"x_dem": np.linspace(0.0, 5.01, 60)}, "A"),
    ],
)  # fmt: skip
def test_a_channel_that_moves_smoothly_within_the_larger_unit_s_range_is_too_small(
    signal: str, enough: float, beside: dict[str, np.ndarray], unit: str
) -> None:
    good = np.linspace(0.0, 1.01 * enough, 60)
    sure, perhaps = small(**{signal: good}, **beside)
    assert set(sure) == {signal} and not perhaps
    own = UNITS[signal]
    assert sure[signal] == (
        f"all values are within 0 to {1.01 * enough:.4g} {own}, which is too little for a machine that moves; "
        f"--unit {signal}={unit}, if it is in {unit} ({signal}={own}, if not)"
    )
    less, fewer = 0.99 * good / 1.01, good[:49] * 60 / 49
    assert not small(**{signal: less}, **beside)[0]  # moves by less than a tenth of its range
    assert not small(**{signal: fewer}, **beside)[0]  # forty-nine samples are too few
    assert small(**{signal: good[:50] * 60 / 49}, **beside)[0]
    assert not small(signal, **{signal: good}, **beside)[0]  # whoever states the unit is believed
    step = 2.0 ** np.ceil(np.log2(enough / 20))
    assert not small(**{signal: steps(step, 20)}, **beside)[0]  # twenty equal steps are not smooth
    assert small(**{signal: steps(step, 21, 84)}, **beside)[0]
    assert not small(**{signal: 0.0 * good}, **beside)[0]  # nothing but 0 says nothing


@pytest.mark.parametrize(
    ("signal", "low", "high"),
    [("n_r", -0.1, 1.5), ("x_lvdt", -0.025, 0.075), ("i_cmd", -0.1, 0.1), ("vgv1", -1.5707, 1.5707)],
)
def test_what_leaves_the_larger_unit_s_range_is_not_too_small(signal: str, low: float, high: float) -> None:
    beside = {} if signal == "x_lvdt" else {"x_dem": np.linspace(0.0, 30.0, 200)}
    for a, b, found in ((low, high, True), (1.01 * low, high, False), (low, 1.01 * high, False)):
        assert bool(small(**{signal: np.linspace(a, b, 200)}, **beside)[0]) == found


def test_what_may_be_too_small_is_told_where_the_machine_moves() -> None:
    flat = np.full(60, 0.001)
    for other, moves in ((10.01, True), (9.99, False)):
        sure, perhaps = small(x_dem=np.linspace(0.0, other, 60), vgv1=flat)
        assert not sure and (set(perhaps) == {"vgv1"}) == moves
    _, perhaps = small(n_r=np.linspace(0.0, 11.0, 60), vgv1=flat)
    assert perhaps == {"vgv1": "all values are within 0.001 to 0.001 deg; if they are in rad: --unit vgv1=rad"}
    # angles alone do not prove an angle; a current needs a stroke that is pushed 5 mm within a second
    ramp = np.linspace(0.0, 1.0, 60)
    assert small(vgv1=0.3 * ramp, vgv2=30.0 * ramp)[0] == {} and set(small(vgv1=0.3 * ramp, vgv2=30.0 * ramp)[1]) == {
        "vgv1"
    }
    for way, certain in ((4.99, False), (5.01, True)):
        sure, perhaps = small(i_cmd=0.01 * ramp, x_dem=np.linspace(0.0, way, 60))
        assert ("i_cmd" in sure) == certain and ("i_cmd" in perhaps) != certain
    slow = 0.02 * np.arange(600)  # 5 mm, but in 2.5 s
    assert small(i_cmd=0.01 * np.linspace(0, 1, 600), x_dem=slow)[0] == {}
    # a speed that stands above a tenth of a per cent may be a ratio
    assert set(small(n_r=np.full(60, 0.11))[1]) == {"n_r"} and small(n_r=np.full(60, 0.09))[1] == {}
    # what is small itself does not show that the machine moves
    assert small(x_dem=0.001 * np.arange(60.0), vgv1=flat)[1].keys() <= {"x_dem"}


# ---- a time that runs ------------------------------------------------------------------------------------------------


def test_seconds_end_in_the_year_2286() -> None:
    assert latest(np.array([1e10])) and latest(np.empty(0)) and latest(np.array([-1e10]))
    assert not latest(np.array([1.01e10])) and not latest(np.array([-1.01e10]))
    assert latest(np.array([0.0, 1.0, 1e12]))  # the median tells


def wrong_rows(t: np.ndarray, slack: float = 0.0) -> list[int] | None:
    found = out_of_order(t, slack)
    return None if found is None else np.flatnonzero(found).tolist()


def test_ten_wrong_stamps_in_a_row_are_single_ones_and_a_tenth_of_all_at_most() -> None:
    t = np.arange(200.0)
    assert wrong_rows(t) == []
    for n, found in ((10, list(range(50, 60))), (11, None)):
        s = t.copy()
        s[50 : 50 + n] = 5.0 + 0.1 * np.arange(n)
        assert wrong_rows(s) == found
    for n, fine in ((20, True), (21, False)):  # of 200
        s = t.copy()
        s[5 : 5 + 9 * n : 9] = 0.5
        assert (wrong_rows(s) is not None) == fine


def test_a_clock_that_jumped_by_more_than_ten_thousand_seconds_leaves_one_side() -> None:
    t = 20_000.0 + np.arange(200.0)
    for jump, fine in ((9_999.0, False), (10_000.0, False), (10_001.0, True)):
        s = t.copy()
        s[50:80] = t[0] - jump - np.linspace(0.0, 0.9, 30)[::-1]
        s[:50] += 0.0
        assert (wrong_rows(s) == list(range(50, 80))) == fine
        ahead = t.copy()
        ahead[50:80] = t[-1] + jump + np.linspace(0.0, 0.9, 30)
        assert (wrong_rows(ahead) == list(range(50, 80))) == fine
    half = np.concatenate([t[:101] + 50_000.0, t[101:]])  # more than half of it is the one side
    assert wrong_rows(half) == list(range(101, 200))
    halves = np.concatenate([t[:100] + 50_000.0, t[100:]])
    assert wrong_rows(halves) is not None


def test_rows_that_are_a_little_late_are_no_wrong_stamps() -> None:
    t = np.arange(100.0)
    t[50] = 48.5  # 0.5 s before the row before it
    assert wrong_rows(t) == [50]
    assert wrong_rows(t, 0.49) == [50] and wrong_rows(t, 0.51) == []
    ahead = np.arange(100.0)
    ahead[50] = 51.5  # 0.5 s beyond the row behind it
    assert wrong_rows(ahead, 0.51) == [] and len(wrong_rows(ahead, 0.49) or []) == 1


def test_a_silence_of_ten_thousand_seconds_is_a_gap_and_a_longer_one_a_jump() -> None:
    t = np.arange(100.0)
    for gap, cut in ((9_999.0, False), (10_000.0, False), (10_001.0, True)):
        s = np.concatenate([t, t[:40] + t[-1] + gap])
        a, b, note, why = longest_part([s])
        assert (a, b, why) == ((0.0, 99.0, "") if cut else (0.0, s[-1], ""))
        assert bool(note) == cut
    assert note == "time jumps from 99 s to 10100 s: only the longer part is kept, 100 of 140 stamps"
    # ten stamps far away are single ones, eleven a part of the log
    for n, said in (
        (10, "time: 10 of 110 stamps are far from all others (1000000 s): left out"),
        (11, "time jumps from 99 s to 1000000 s: only the longer part is kept, 100 of 111 stamps"),
    ):
        assert longest_part([np.concatenate([t, 1e6 + np.zeros(n) + 1e-9 * np.arange(n)])])[2] == said
    assert "(-1000000 s)" in longest_part([np.concatenate([[-1e6], t])])[2]
    # a raster so slow that a hundred of its steps are longer is no jump; the slowest channel counts
    slow = 200.0 * np.arange(400.0)
    s = np.concatenate([slow, slow[-1] + 19_999.0 + slow[:20]])
    assert longest_part([s])[2] == "" and longest_part([s, t])[2] == ""
    assert longest_part([np.concatenate([slow, slow[-1] + 20_001.0 + slow[:20]])])[2] != ""


def test_a_clock_that_jumps_more_than_once_is_refused_unless_little_is_lost() -> None:
    t = np.arange(100.0)
    many = np.concatenate([t, t + 1e5, t + 2e5])
    assert longest_part([many])[2:] == (
        "", "time jumps 2 times, first from 99 s to 100000 s; allowed: one jump, or a few wrong stamps"
    )  # fmt: skip
    two = np.concatenate([t - 1e6, t, t[:1] + 1e6])
    assert longest_part([two])[3].startswith("time jumps 2 times")
    few = np.concatenate([t[:12] - 1e6, np.arange(300.0), t[:12] + 1e6])  # 24 of 324 lost at both ends
    assert "24 of 324 stamps are far from all others" in longest_part([few])[2]
    more = np.concatenate([t[:20] - 1e6, np.arange(300.0), t[:20] + 1e6])  # 40 of 340
    assert "only the longer part is kept, 300 of 340" in longest_part([more])[2]
    one = np.concatenate([t[:12] - 1e6, np.arange(300.0)])
    assert "only the longer part" in longest_part([one])[2]
    assert longest_part([np.concatenate([t, t + 1e6])])[3] == ""  # as much as is lost may be kept


@pytest.mark.parametrize(("rows", "most"), [(10, 20_000.0), (2_000, 20_000.0), (5_000, 50_000.0), (20_000, 100_000.0)])
def test_a_log_spans_ten_seconds_a_row_at_least_twenty_thousand_and_a_day_at_most(rows: int, most: float) -> None:
    assert span_complaint([np.linspace(5.0, 5.0 + most, rows)]) == ""
    said = span_complaint([np.linspace(5.0, 6.0 + most, rows), np.array([6.0, 7.0])])
    assert said == (
        f"spans {most + 1.0:,.6g} s with {rows:,} rows; allowed: up to {most:,.6g} s (10 s a row, 100,000 s in all)"
    )
    assert span_complaint([np.linspace(0.0, most, rows), np.array([-1.0, 1.0])])  # from the first to the last of all


def test_the_limits_that_others_read() -> None:
    assert (plausible.FEW, plausible.JUMP, plausible.LATEST) == (0.1, 1e4, 1e10)
    assert SimpleNamespace(**vars(RANGES["p_s"])).large.keys() == {"Pa", "kPa", "bar", "psi"}


def test_unused_names_of_a_source_are_all_told(tmp_path: Path) -> None:
    found = guessed("n_r", Columns(speed_act=wave(70, 90), foo=wave(1, 2)))
    assert set(found.unused) == {"foo"} and set(found.made) == {"n_r"}


def test_a_guess_is_made_from_seven_tenths_on() -> None:
    """A current whose name does not say what it is for, in a unit that only its values tell: 0.75 of 0.9."""
    found = guessed("i_cmd", Columns(servo_current=wave(0.04, 0.05)))
    assert not found.made and found.open["i_cmd"] == (
        "may be 'servo_current' (its name says current, valve; its values reach 0.05, so A): not guessed; "
        "--map NAME=i_cmd takes one"
    )
    assert guessed("i_cmd", Columns(servo_current=wave(4, 5))).made["i_cmd"].confidence == pytest.approx(0.75 * 0.95)
    assert guessed("x_dem", Columns(pressure=wave(20, 21))).unused == {"pressure": "p_s has a name already"}
    assert guessed("x_dem", Columns(fuel_pressure=wave(20, 21))).unused["fuel_pressure"].startswith("no signal of")


def test_a_speed_in_turns_is_no_surer_than_one_in_per_cent() -> None:
    found = guessed("n_r", Columns(speed_act=(wave(70, 90), "%"), speed=(wave(7_000, 9_000), "rpm")))
    assert found.made["n_r"].name == "speed_act"
