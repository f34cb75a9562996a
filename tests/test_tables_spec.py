"""How a table is read: its units and bounds, what its file may hold, and what is said of a key that is wrong."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from pydantic import Field, ValidationError

from vaneloop.base import tables
from vaneloop.base.errors import InputError
from vaneloop.base.tables import Axis, Bound, Bounded, Quantity, Table, load_toml, read


class Part(Bounded):
    """A part with bounds of either kind."""

    stroke: Annotated[Quantity, Bound("mm", 0.0, 48.0)]
    speed: Annotated[Axis, Bound("%", 0.0, 120.0)] | None = None
    free: Quantity | None = None


class One(Table):
    """A member of a union."""

    kind: Literal["one"] = "one"
    gain: float


class Two(Table):
    """Another member."""

    kind: Literal["two"] = "two"
    delay: float


class Whole(Table):
    """A table with parts, a list and a union."""

    part: Part
    more: Part | None = None
    rows: list[One] = []
    law: Annotated[One | Two, Field(discriminator="kind")] | None = None


def quantity(value: float, unit: str = "mm") -> dict[str, Any]:
    return {"value": value, "unit": unit, "origin": "chosen: a test"}


def refused(data: dict[str, Any], model: type[Table] = Whole) -> str:
    with pytest.raises(ValidationError) as e:
        model.model_validate(data)
    return tables._complaint(e.value, model)


@pytest.mark.parametrize("value", [0.0, 24.0, 48.0])
def test_a_value_may_be_at_both_ends_of_its_bounds(value: float) -> None:
    part = Part.model_validate({"stroke": quantity(value)})
    assert part.stroke.value == value and part.free is None


@pytest.mark.parametrize(("given", "says"), [
    ({"stroke": quantity(-1e-9)}, "stroke (=-1e-09 mm) must be in [0, 48]"),
    ({"stroke": quantity(48.001)}, "stroke (=48.001 mm) must be in [0, 48]"),
    ({"stroke": quantity(5.0, "m")}, "stroke.unit (='m') must be 'mm'"),
    ({"stroke": quantity(5.0) | {"origin": "abc"}}, "stroke.origin (='abc'): String should have at least 4 characters"),
    ({"stroke": quantity(5.0) | {"value": "5"}}, "stroke.value (='5'): Input should be a valid number"),
    ({"stroke": quantity(math.nan)}, "stroke.value (=nan): Input should be a finite number"),
])  # fmt: skip
def test_a_value_beyond_its_bounds_or_in_another_unit_is_refused(given: dict[str, Any], says: str) -> None:
    assert refused(given, Part) == says


def test_each_number_of_an_axis_is_within_the_bounds() -> None:
    def axis(*values: float, unit: str = "%") -> dict[str, Any]:
        return {"stroke": quantity(1.0), "free": quantity(1e9, "any"), "speed": {
            "values": list(values), "unit": unit, "origin": "chosen: a test"}}  # fmt: skip

    speed = Part.model_validate(axis(0.0, 120.0)).speed
    assert speed is not None and speed.increasing("speed") is speed
    assert Bound("x").low == -math.inf and Bound("x").high == math.inf


@pytest.mark.parametrize(("values", "says"), [
    ([1.0, 1.0], "k.values[1] (=1) must be greater than the value before it (=1)"),
    ([1.0, 3.0, 2.5], "k.values[2] (=2.5) must be greater than the value before it (=3)"),
])  # fmt: skip
def test_breakpoints_rise(values: list[float], says: str) -> None:
    with pytest.raises(ValueError) as e:
        Axis(values=values, unit="%", origin="chosen: a test").increasing("k")
    assert str(e.value) == says
    assert Axis(values=[1.0, np.nextafter(1.0, 2.0)], unit="%", origin="chosen: a test").increasing("k")


GOOD = {"part": {"stroke": quantity(1.0)}}


@pytest.mark.parametrize(("data", "says"), [
    ({}, "key 'part' is missing; allowed here: part, more, rows, law"),
    ({"part": {}}, "key 'part.stroke' is missing; allowed here: stroke, speed, free"),
    (GOOD | {"more": {"strok": 1.0}},
     "key 'more.strok' is unknown, probably 'stroke' is meant; allowed here: stroke, speed, free (and 1 more)"),
    (GOOD | {"part": {"stroke": quantity(1.0) | {"qqqqqq": 1}}},
     "key 'part.stroke.qqqqqq' is unknown; allowed here: value, unit, origin, tolerance"),
    (GOOD | {"par": 1}, "key 'par' is unknown, probably 'part' is meant; allowed here: part, more, rows, law"),
    (GOOD | {"part": {"stroke": quantity(1.0) | {"valu": 1}}},
     "key 'part.stroke.valu' is unknown, probably 'value' is meant; allowed here: value, unit, origin, tolerance"),
    ({"part": {"stroke": {}}}, "key 'part.stroke.value' is missing; allowed here: value, unit, origin, tolerance "
                               "(and 2 more)"),
    (GOOD | {"rows": [{"gain": 1.0}, {}]}, "key 'rows.1.gain' is missing; allowed here: kind, gain"),
    (GOOD | {"law": {"kind": "two"}}, "key 'law.two.delay' is missing; allowed here: kind, delay"),
    (GOOD | {"law": {"kind": "one", "dela": 1.0, "gain": 1.0}},
     "key 'law.one.dela' is unknown; allowed here: kind, gain"),
    (GOOD | {"part": 5}, "part (=5): must be a table with the keys stroke, speed, free"),
    (GOOD | {"part": "x" * 59}, f"part (='{'x' * 56}...): must be a table with the keys stroke, speed, free"),
    (GOOD | {"part": "x" * 58}, f"part (='{'x' * 58}'): must be a table with the keys stroke, speed, free"),
])  # fmt: skip
def test_a_wrong_key_is_named_with_those_that_are_allowed(data: dict[str, Any], says: str) -> None:
    assert refused(data) == says


def test_a_shipped_table_is_read_once_and_a_file_of_ones_own_anew(tmp_path: Path) -> None:
    assert tables.path("vgv.dbc").is_file() and tables.file_of("plant.toml") == tables.path("plant.toml")
    own = tmp_path / "own.toml"
    text = '[part]\nstroke = { value = %s, unit = "mm", origin = "chosen: a test" }\n'
    for value in (3.0, 4.0):
        own.write_text(text % value)
        assert read(own, Whole).part.stroke.value == value and tables.file_of(own) == own
    own.write_text(text % 49.0)
    with pytest.raises(InputError) as e:
        read(own, Whole)
    assert str(e.value) == f"{own}: part: stroke (=49 mm) must be in [0, 48]"


@pytest.mark.parametrize("installed", [True, False])
def test_shipped_tables_lie_in_the_package_or_beside_it(
    installed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = tmp_path / "vaneloop"
    (room / "tables" if installed else room).mkdir(parents=True)
    monkeypatch.setattr(tables, "_ROOM", room)
    assert tables.path("a.toml") == (room if installed else tmp_path) / "tables" / "a.toml"


@pytest.mark.parametrize(("content", "says"), [
    (b"# " + b"x" * (tables.MOST_BYTES - 2), ""),
    (b"# " + b"x" * (tables.MOST_BYTES - 1), "is longer than a TOML table may be (1,048,576 bytes)"),
    (b"a" * 1_000 + b" = 1", ""),
    (b"\n\nb = 1\n" + b"a" * 1_001 + b" = 1",
     f"line 4: {'a' * 30}... is too long a word; allowed: 1,000 letters"),
    (b".".join([b"a"] * 16) + b" = 1", ""),
    (b"\n" + b".".join([b"ab"] * 17) + b" = 1",
     f"line 2: key {'ab.' * 10}... has too many dotted parts; allowed: 16"),
    (b"a = '" + b"x" * 2_000 + b"'", ""), (b'a = """' + b"x" * 2_000 + b'"""', ""), (b"#" + b"x" * 2_000, ""),
    (b"a = '" + b"x" * 2_000, "not a TOML table (Expected \"'\" (at end of document))"),
    (b"a = \xff", "not a TOML table ('utf-8' codec can't decode byte 0xff in position 4: invalid start byte)"),
    (b"\xef\xbb\xbfa = 1\r\n", ""),
])  # fmt: skip
def test_a_file_has_no_more_than_its_reader_can_bear(content: bytes, says: str, tmp_path: Path) -> None:
    file = tmp_path / "t.toml"
    file.write_bytes(content)
    if not says:
        assert isinstance(load_toml(file), dict)
        return
    with pytest.raises(InputError) as e:
        load_toml(file)
    assert str(e.value) == f"{file}: {says}"


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for name, says in (("none.toml", "cannot be read (No such file or directory)"),
                       ("a\0b", "not a TOML table (embedded null byte)")):  # fmt: skip
        with pytest.raises(InputError) as e:
            load_toml(tmp_path / name)
        assert str(e.value) == f"{tmp_path / name}: {says}"
    with pytest.raises(InputError, match=r"cannot be read \(File name too long\)$"):
        read("a" * 5_000, Whole)
