"""Formulas of channels: rasters that meet, holes, units, and the place of whatever is wrong, each worked out here."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from hil.logs import Channel
from hil.logs.formula import BINARY, FUNCTIONS, Formula, FormulaError, _powers, _said, aligned, formula_of, named
from hil.logs.units import factor_of

T = np.arange(40.0)


def channel(t: object, values: object, unit: str = "") -> Channel:
    return Channel(np.asarray(t, float), np.asarray(values, float), unit=unit)


def of(text: str, unit: str = "", **channels: Channel) -> tuple[list[float], list[float], str]:
    made = formula_of(text).made(channels, unit)
    return made.t.tolist(), made.values.tolist(), made.unit


def values(text: str, **channels: Channel) -> list[float]:
    return of(text, **channels)[1]


def refused(text: str, unit: str = "", **channels: Channel) -> tuple[int, str]:
    """Position, from 1, and words."""
    with pytest.raises(FormulaError) as caught:
        formula_of(text).made(channels, unit)
    line = str(caught.value)
    place, _, what = line.rpartition(f"position {caught.value.at + 1}: ")
    assert place, line
    return caught.value.at + 1, what


# ---- what binds how --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [
    "1 + 2 * 3 - 4 / 2", "-2 ** 2", "2 ** 3 ** 2", "-3 * -2", "- -3", "+3 - +2", "7 % 4 * 2", "2 * 7 % 4", "1 - 2 - 3",
    "8 / 4 / 2", "(1 + 2) * 3", "1 < 2", "2 <= 2", "3 > 3", "3 >= 3", "1 == 1", "1 != 1", "1 + 1 == 2", "not 1 == 2",
    "not 0", "not 3", "not not 3", "1 and 0 or 1", "1 or 0 and 0", "(1 or 0) and 0", "not 0 and 0", "1 < 2 and 3 > 2",
    "1e3 + .5 + 2. + 1.5e-1", "-7 % 4", "2 * -3", "2 ** -1", "0 or 0", "3 and 2", "1 < 2 or 1 > 2 and 0",
])  # fmt: skip
def test_operators_bind_as_in_python(text: str) -> None:
    assert values(f"{text} + 0 * x" if " and" not in text else f"({text}) + 0 * x", x=channel(T, T))[0] == (
        pytest.approx(float(bool(want)) if isinstance(want := eval(text), bool) or " and" in text or "not" in text
                      or " or" in text else want)
    )  # fmt: skip


def test_a_second_comparison_wants_an_and() -> None:
    x = channel(T, T)
    assert refused("1 < x < 3", x=x) == (7, "a second comparison: write a < b and b < c")
    assert refused("x == 1 >= 3", x=x) == (8, "a second comparison: write a == b and b >= c")
    assert values("(1 < x) == (x < 3)", x=x)[:4] == [0.0, 0.0, 1.0, 0.0]
    assert values("1 < x and x < 3", x=x)[:4] == [0.0, 0.0, 1.0, 0.0]


def test_truth_is_one_or_zero_and_nothing_where_a_part_is_nothing() -> None:
    x = channel(T[:3], [-1.0, 0.0, 4.0])
    t, found, unit = of("sqrt(x) > 1", x=x)
    assert (t, found, unit) == ([1.0, 2.0], [0.0, 1.0], "-")  # the root of -1 is no number, and no less than 1
    assert of("1 > sqrt(x) or 1", x=x)[0] == [1.0, 2.0] and of("not sqrt(x)", x=x)[1] == [1.0, 0.0]
    assert values("x and 2", x=x) == [1.0, 0.0, 1.0] and values("where(x > 0, 5, 7)", x=x) == [7.0, 7.0, 5.0]
    assert of("where(sqrt(x) > 1, 5, 7)", x=x)[0] == [1.0, 2.0]


@pytest.mark.parametrize(("text", "want"), [
    ("abs(x)", np.abs), ("sign(x)", np.sign), ("round(x)", np.round), ("exp(x)", np.exp), ("sin(x)", np.sin),
    ("cos(x)", np.cos), ("tan(x)", np.tan), ("atan(x)", np.arctan), ("asin(x / 9)", lambda x: np.arcsin(x / 9)),
    ("acos(x / 9)", lambda x: np.arccos(x / 9)), ("log(x + 9)", lambda x: np.log(x + 9)),
    ("log10(x + 9)", lambda x: np.log10(x + 9)), ("sqrt(x + 9)", lambda x: np.sqrt(x + 9)),
    ("atan2(x, 2)", lambda x: np.arctan2(x, 2)), ("hypot(x, 2)", lambda x: np.hypot(x, 2)),
    ("min(x, 1, -x)", lambda x: np.minimum(np.minimum(x, 1), -x)), ("max(x, 1)", lambda x: np.maximum(x, 1)),
    ("mean(x) + 0 * x", lambda x: x.mean() + 0 * x), ("x * pi", lambda x: x * np.pi), ("x % 2", lambda x: np.mod(x, 2)),
])  # fmt: skip
def test_functions_are_those_of_mathematics(text: str, want: object) -> None:
    v = np.array([-2.5, -0.4, 0.7, 3.2])
    assert values(text, x=channel(T[:4], v)) == pytest.approx(want(v).tolist())  # type: ignore[operator]


def test_a_function_takes_its_own_number_of_parts() -> None:
    for name, f in FUNCTIONS.items():
        allowed = f"{f.least}" if f.least == f.most else f"{f.least} or more"
        for n in (f.least - 1, (f.most or 9) + 1):
            if n < 1 or (f.most is None and n > f.least):
                continue
            parts = ", ".join(["x"] * n)
            assert refused(f"1 + {name}({parts})", x=channel(T, T)) == (
                5, f"{name} is given {n}; it takes {allowed}"
            )  # fmt: skip
    assert refused("abs(x", x=channel(T, T)) == (6, "the end where ')' closes abs( of position 1")
    assert refused("abs(x y)", x=channel(T, T)) == (7, "'y' where ')' closes abs( of position 1")
    assert refused("1 + (x", x=channel(T, T)) == (7, "the end where ')' closes the bracket of position 5")


# ---- rasters ---------------------------------------------------------------------------------------------------------


def test_on_the_finer_raster_the_other_is_a_straight_line_or_holds() -> None:
    fine, coarse = channel(0.25 * np.arange(17), np.full(17, 0.5)), channel([0, 1, 2, 3], [0.0, 10.5, 20.0, 30.0])
    t, found, _ = of("c + 0 * f", c=coarse, f=fine)
    assert t == (0.25 * np.arange(13)).tolist() and found[1] == pytest.approx(2.625) and found[-1] == 30.0
    modes = channel([0, 1, 2, 3], [2.0, 3.0, 3.0, 1.0])
    t, found, _ = of("m + 0 * f", m=modes, f=fine)
    assert found == [2.0] * 4 + [3.0] * 8 + [1.0]  # whole numbers hold
    half = channel([0, 1, 2, 3], [2.0, 3.0, 3.0, 1.5])
    assert of("m + 0 * f", m=half, f=fine)[1][1] == pytest.approx(2.25)
    # what is made of whole numbers holds, too; a quotient does not
    assert of("(m + 1) * 2 + 0 * f", m=modes, f=fine)[1][1] == 6.0
    assert of("m / 2 + 0 * f", m=modes, f=fine)[1][1] == pytest.approx(1.125)
    assert of("(m > 2) + 0 * f", m=half, f=fine)[1][1] == 0.0  # nor has a truth halves
    assert of("where(m > 2, 1, m) + 0 * f", m=modes, f=fine)[1][1] == 2.0


def test_rasters_meet_from_the_last_beginning_to_the_first_end() -> None:
    a, b = channel(np.arange(10.0), np.arange(10.0)), channel(0.5 + 0.5 * np.arange(9), np.ones(9))
    assert of("a * b", a=a, b=b)[0] == (0.5 + 0.5 * np.arange(9)).tolist()
    apart = channel(np.arange(20.0, 30.0), np.ones(10))
    assert refused("a * b", a=a, b=apart) == (3, "gives no finite number at any time that its channels share")
    one = channel([3.0], [4.0])
    assert of("a * b", a=a, b=one)[:2] == ([3.0], [12.0])  # the raster of ten is finer than a single sample's
    same = channel(np.arange(10.0), np.ones(10))
    assert of("a + s", a=a, s=same)[1] == (1.0 + np.arange(10.0)).tolist()


def test_in_a_hole_there_is_no_sample() -> None:
    """A channel each second but for 100 s, beside one of four a second."""
    broken = np.r_[np.arange(40.0), np.arange(140.0, 180.0)]
    fine = channel(0.25 * np.arange(800), np.zeros(800))
    t, found, _ = of("b + f", b=channel(broken, broken + 0.5), f=fine)
    assert not [x for x in t if 39.0 < x < 140.0] and 39.0 in t and 140.0 in t
    assert found == pytest.approx([x + 0.5 for x in t])
    at, (one, other) = aligned([channel(broken, broken + 0.5), fine])
    gap = (at > 39.0) & (at < 140.0)
    assert np.isnan(one[gap]).all() and np.isfinite(one[~gap]).all() and np.isfinite(other).all()
    assert at[0] == 0.0 and at[-1] == 179.0
    modes = np.where(broken < 100.0, 2.0, 3.0)
    assert not [x for x in of("b + f", b=channel(broken, modes), f=fine)[0] if 39.0 < x < 140.0]


def test_a_rate_knows_nothing_beside_a_hole_and_an_integral_adds_nothing_over_it() -> None:
    broken = np.r_[np.arange(40.0), np.arange(140.0, 180.0)]
    x = channel(broken, 3.0 * broken, "mm")
    t, found, unit = of("rate(x)", x=x)
    assert t == [*broken[:39], *broken[41:]] and found == pytest.approx([3.0] * 78) and unit == "mm/s"
    t, found, unit = of("integral(x)", x=channel(broken, np.full(80, 2.0), "mm"))
    assert t == broken.tolist() and unit == "mm*s" and found[39] == 78.0 and found[40] == 78.0 and found[-1] == 156.0
    ramp = channel(np.arange(5.0), [0.0, 1.0, 2.0, 3.0, 4.0])
    assert of("integral(r)", r=ramp)[1] == [0.0, 0.5, 2.0, 4.5, 8.0]  # trapezoids
    assert of("rate(r * r)", r=ramp)[1] == [1.0, 2.0, 4.0, 6.0, 7.0]  # central, one-sided at the ends


def test_a_delay_is_what_was_so_long_before() -> None:
    x = channel(np.arange(10.0), np.arange(10.0) ** 2 + 0.5, "mm")
    assert of("delay(x, 2)", x=x) == ([2.0, 3, 4, 5, 6, 7, 8, 9], [k * k + 0.5 for k in range(8)], "mm")
    assert of("delay(x, 0.5)", x=x)[:2] == (list(range(1, 10)), [k * k + k + 1.0 for k in range(9)])
    assert of("delay(x, -2)", x=x)[0] == list(range(8))
    minutes = channel(np.arange(10.0), np.full(10, 1.0), "min")
    assert of("delay(x, mean(m) / 30)", x=x, m=minutes)[0] == list(range(2, 10))  # in its unit
    for text in ("delay(x, x)", "delay(x, mean(x))"):
        assert refused(text, x=x) == (1, "the second part of delay must be a number of seconds")
    assert refused("2 + delay(3, 1)", x=x) == (5, "delay needs a channel of two samples")
    assert refused("rate(x)", x=channel([1.0], [2.0])) == (1, "rate needs a channel of two samples")


def test_time_is_that_of_the_channels_that_are_named_else_the_finest() -> None:
    a, b = channel([0.0, 2.0, 4.0], [1, 2, 3], "mm"), channel([1.0, 1.5, 2.0, 2.5], [1.5, 2, 3, 4])
    assert of("t", a=a, b=b)[1] == [1.0, 1.5, 2.0, 2.5] and of("t", a=a)[2] == "s"
    assert of("a * t", a=a, b=b)[:2] == ([0.0, 2.0, 4.0], [0.0, 4.0, 12.0]) and of("a * t", a=a)[2] == "mm*s"
    assert of("2 * t", a=a, t=channel([5.0, 6.0], [7.5, 8.0], "V")) == ([5.0, 6.0], [15.0, 16.0], "V")
    assert of("sin(2 * pi * t / 8)", a=a)[1] == pytest.approx([0.0, 1.0, 0.0])  # a number before the time is in rad/s


# ---- units -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "powers"), [
    ("mm", {"mm": 1}), ("N*m", {"N": 1, "m": 1}), ("m/s^2", {"m": 1, "s": -2}), ("m/s**2", {"m": 1, "s": -2}),
    ("1/s", {"s": -1}), ("m s", {"m": 1, "s": 1}), ("N\u00b7m", {"N": 1, "m": 1}), ("m/s/s", {"m": 1, "s": -2}),
    ("%", {"%": 1}), ("\u00b0", {"\u00b0": 1}), ("m2", {"m": 2}), ("m*m", {"m": 2}), ("m/m", {}), ("s**-1", {"s": -1}),
    ("", {}), ("-", {}), ("1", {}), ("none", {}), ("2 m", {"2 m": 1}), ("m/2", {"m/2": 1}),
    ("delta_degF", {"delta_degF": 1}),
])  # fmt: skip
def test_a_unit_is_its_symbols_with_their_powers(unit: str, powers: dict[str, int]) -> None:
    assert dict(_powers(unit)) == {s: Fraction(p) for s, p in powers.items()}


@pytest.mark.parametrize(("powers", "said"), [
    ({}, "-"), ({"mm": 1}, "mm"), ({"N": 1, "m": 1}, "N*m"), ({"m": 1, "s": -2}, "m/s**2"), ({"s": -1}, "1/s"),
    ({"mm": Fraction(1, 2)}, "mm**0.5"), ({"s": Fraction(-1, 2)}, "1/s**0.5"), ({"m": -1, "s": -1}, "1/m/s"),
    ({"m": 3}, "m**3"),
])  # fmt: skip
def test_a_unit_is_said_as_it_is_read(powers: dict[str, Fraction], said: str) -> None:
    unit = tuple((s, Fraction(p)) for s, p in powers.items())
    assert _said(unit) == said and (Fraction(1, 2) in {abs(p) for _, p in unit} or _powers(said) == unit)


def test_degrees_of_a_temperature_have_a_zero_only_where_it_is_one() -> None:
    t = channel(T[:2], [20.0, 30.0], "degC")
    f = channel(T[:2], [68.0, 104.0], "degF")
    assert of("t", t=t)[2] == "degC" and of("t + 5", t=t)[1:] == ([25.0, 35.0], "degC")
    assert of("t - mean(t)", t=t)[1:] == ([-5.0, 5.0], "K") and of("f - mean(f)", f=f)[1:] == (
        [-18.0, 18.0],
        "delta_degF",
    )
    assert of("t - f", t=t, f=f)[1] == pytest.approx([0.0, -10.0]) and of("max(t, f)", t=t, f=f)[2] == "degC"
    assert of("t * f", t=t, f=f)[2] == "K*delta_degF" and of("t / t", t=t)[2] == "-"
    assert of("rate(t) [degF/s]", t=t)[2] == "degF/s" and of("t [degF]", t=t)[1] == pytest.approx([68.0, 86.0])
    assert (
        of("2 * t", t=t)[2] == "degC" and of("t - 3", t=t)[2] == "degC" and of("t > f - 1", t=t, f=f)[1] == [1.0, 0.0]
    )


def test_a_stated_unit_converts_names_or_is_refused() -> None:
    x, k = channel(T[:2], [1.0, 2.0], "mm"), channel(T[:2], [1.0, 2.0])
    assert of("x [um]", x=x) == ([0.0, 1.0], [1000.0, 2000.0], "um") and of("x", "m", x=x)[1:] == ([1e-3, 2e-3], "m")
    assert of("x [um]", "m", x=x)[1:] == (pytest.approx([1e-3, 2e-3]), "m")
    assert of("k [um]", k=k)[1:] == ([1.0, 2.0], "um")  # what has no unit gets the one stated
    assert of("k * x [um]", k=k, x=x)[1:] == ([1000.0, 4000.0], "um")
    assert of("x / x [%]", x=x)[1:] == ([100.0, 100.0], "%")  # a ratio
    assert of("k / x * x [%]", k=k, x=x)[1:] == ([1.0, 2.0], "%")  # of unknown unit: it is said to be in %
    assert of("x [-]", x=channel(T[:2], [1.0, 2.0]))[2] == "-"
    assert refused("x [s]", x=x) == (1, "is in mm, which does not convert to s")
    assert refused("1 + x", "MPa", x=x) == (3, "is in mm, which does not convert to MPa")
    assert refused("x + y", x=x, y=channel(T[:2], [1.0, 2.0], "s")) == (3, "mm and s do not go together")
    assert factor_of("mm", "s") == "mm"


def test_angles_are_taken_in_their_unit() -> None:
    w, h = channel(T[:3], [0.0, 30.0, 90.0], "deg"), channel(T[:3], [0.0, 1.0, 2.0], "mm")
    assert of("sin(w)", w=w)[1:] == (pytest.approx([0.0, 0.5, 1.0]), "-")
    assert of("cos(w)", w=w)[1] == pytest.approx([1.0, np.sqrt(0.75), 0.0])
    assert of("asin(sin(w)) [deg]", w=w)[1] == pytest.approx([0.0, 30.0, 90.0])
    assert of("atan2(h, h)", h=h)[1:] == (pytest.approx([0.0, np.pi / 4, np.pi / 4]), "rad")
    assert refused("2 * sin(h)", h=h) == (5, "mm is no angle")


def test_a_power_multiplies_the_powers_of_the_unit() -> None:
    x, n = channel(T[:2], [4.0, 9.0], "mm"), channel(T[:2], [1.0, 2.0])
    assert of("x ** 2", x=x)[1:] == ([16.0, 81.0], "mm**2") and of("x ^ -1", x=x)[2] == "1/mm"
    assert of("x ** 0.5", x=x)[1:] == ([2.0, 3.0], "mm**0.5") and of("(x * x) ** 0.5", x=x)[2] == "mm"
    assert of("n ** n", n=n)[1] == [1.0, 4.0] and of("x ** 0", x=x)[2] == "-"
    assert refused("x ** n", x=x, n=n) == (3, "the power of mm must be a number")
    assert refused("2 ** x", x=x) == (3, "the power of - must be a number")
    assert of("x ** (1 / 3)", x=x)[2].startswith("mm**0.333")


# ---- what a formula is -----------------------------------------------------------------------------------------------


def test_a_formula_says_its_name_its_unit_and_what_it_needs() -> None:
    f = formula_of("  lag2 = x_dem - `odd name` + max(x_dem, 2) * pi + M.x  [um] ")
    assert (f.name, f.expression, f.unit) == ("lag2", "x_dem - `odd name` + max(x_dem, 2) * pi + M.x", "um")
    assert f.names == ("x_dem", "odd name", "M.x") and isinstance(f, Formula) and named("a = b").name == "a"
    assert formula_of("a == b").name == "" and formula_of("a == b").names == ("a", "b")
    assert formula_of("`max` + `and`").names == ("max", "and") and formula_of("max + 1").names == ("max",)
    assert values("`or` or `not`", **{"or": channel(T[:2], [0, 1]), "not": channel(T[:2], [0, 0])}) == [0.0, 1.0]
    assert formula_of("pi * x").names == ("x",) and formula_of("`pi` * x").names == ("pi", "x")
    for name in ("t", "pi", "and", "or", "not", *FUNCTIONS):
        with pytest.raises(FormulaError, match=rf"position 3: the name '{name}' has a meaning of its own"):
            formula_of(f"  {name} = x")
    assert all(sign in BINARY for sign in ("+", "^", "or"))


@pytest.mark.parametrize(("text", "at", "what"), [
    ("  ", 1, "no formula"), ("a = [mm]", 4, "no formula"), (" = x", 1, "no name before '='"),
    ("x [m;]", 3, "[m;] is no unit"),
    ("x ? 2", 3, "'?' is not understood; allowed: names of channels, numbers, + - * / % ** ^ < <= > >= =="),
    ("x 2", 3, "'2' is not expected here"), ("x ) + 2", 3, "')' is not expected here"),
    ("x +", 4, "the end where a channel"),
    ("* x", 1, "'*' where a channel, a number or a bracket is needed"), ("x + and", 5, "'and' where a channel"),
    ("x + nosin(x)", 5, "no function 'nosin' (did you mean sin?); allowed: abs, sign"),
    ("max()", 5, "')' where a channel"),
    ("x [" + "m" * 32 + "]", 0, ""), ("x [" + "m" * 33 + "]", 3, "is no unit"), ("x [2]", 3, "[2] is no unit"),
])  # fmt: skip
def test_what_cannot_be_read_is_told_with_its_position(text: str, at: int, what: str) -> None:
    if not at:
        assert formula_of(text).unit == "m" * 32
        return
    with pytest.raises(FormulaError) as caught:
        formula_of(text)
    assert caught.value.at + 1 == at and f"position {at}: " in str(caught.value) and what in str(caught.value)


def test_a_formula_has_four_hundred_characters_and_forty_parts_within_each_other() -> None:
    fits = "x" + " + x" * 99 + "  "
    assert len(fits) == 399 and values(fits[:-1] + "  ", x=channel(T[:2], [1.0, 2.0])) == [100.0, 200.0]
    assert len(fits + " ") == 400 and formula_of(fits + " ").names == ("x",)
    with pytest.raises(
        FormulaError, match=r"^formula 'x \+ .*\.\.\.', position 401: 401 characters; allowed: up to 400$"
    ):
        formula_of(fits + "  ")
    for signs, fine in ((39, True), (40, False)):
        text = "-" * signs + "x"
        if fine:
            assert values(text, x=channel(T[:1], [1.0])) == [-1.0]
        else:
            assert refused(text) == (41, "more than 40 parts within each other")
    assert values(" + ".join(["(x)"] * 60), x=channel(T[:1], [1.0])) == [60.0]  # beside each other, not within


def test_a_channel_that_is_not_there_or_empty_is_told_where_it_stands_first() -> None:
    x = channel(T, T)
    assert refused("x + (y * y)", x=x, load=x) == (6, "no channel 'y'; the log has x, load")
    assert refused("x + none", x=x, none=channel([], [])) == (5, "none has no sample")
    assert refused("2 * 3", x=x) == (3, "names no channel: a number alone has no time")
    assert refused("log(0 * x - 1)", x=x) == (1, "gives no finite number at any time that its channels share")
    assert of("log(x)", x=x)[0] == T[1:].tolist()  # what is not finite is left out
