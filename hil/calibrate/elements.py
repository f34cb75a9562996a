"""The numbers of a calibration that may be changed, each with its bounds and its place in a TOML table.

All numbers of a calibration stand in one row of float64: the scalars, the stroke tables, the vane angles, then the
scalars of a controller of the user's own. Units are SI, as in the firmware.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from math import nextafter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ValidationError

from controller import STRATEGIES, Calibration
from controller.calibration import SECTIONS, SI, AngleTable, CalibrationTable, StrokeTable
from controller.records import SCALAR_FIELDS, SCALARS
from vaneloop.base.files import write_all
from vaneloop.base.tables import Bound
from vaneloop.base.vanes import vane_in

__all__ = ["CHOICES", "Curve", "Element", "complaint", "curves_of", "documents", "elements_of", "write_tables"]

MODELS: dict[str, type[BaseModel]] = {
    "calibration": CalibrationTable,
    "stroke_tables": StrokeTable,
    "vane_angles": AngleTable,
}
CHOICES = {"strategy": STRATEGIES, "table_input": ("n_r", "n_dem")}  # scalars that are a word in the table
CURVES = ("extension", "retraction", "single")  # rows of the stroke tables behind the speeds
# What limits the current or watches the loop: like `CHOICES`, not to be changed while the loop is closed.
GUARDED_SECTIONS = ("fail_safe", "demand_monitor", "lvdt_monitor", "servo_monitor")
GUARDED = ("current_limit", "stroke_min", "stroke_max")
ORIGIN = "chosen: frozen from a calibration page by XCP"


class Element(NamedTuple):
    """One number: SI name, unit and bounds, and the table, section and key that it is from ("" = in no table).

    factor   from the table's unit, ``border``, into SI
    guarded  not to be changed while the loop is closed
    whole    the number of one of `CHOICES`
    fixed    not to be changed at all
    """

    name: str
    unit: str
    meaning: str
    low: float
    high: float
    table: str
    section: str
    key: str
    border: str
    factor: float
    guarded: bool = False
    whole: bool = False
    fixed: bool = False

    @property
    def of_curve(self) -> bool:
        """Whether it is one of the numbers of an axis or a curve."""
        return self.table in ("stroke_tables", "vane_angles") and self.section != ""


class Curve(NamedTuple):
    """Numbers ``first`` to ``first + n`` of the row as a curve over those from ``axis`` on."""

    name: str
    meaning: str
    first: int
    axis: int
    n: int


@lru_cache
def _bounds() -> dict[str, tuple[str, str, Bound]]:
    """Scalar -> its section, its table, its bound."""
    out: dict[str, tuple[str, str, Bound]] = {}
    for section in SECTIONS:
        kind: Any = CalibrationTable.model_fields[section].annotation
        for key, of in kind.model_fields.items():
            for bound in of.metadata:
                if isinstance(bound, Bound):
                    out[key] = section, "calibration", bound
    for key, of in AngleTable.model_fields.items():
        if key.startswith("play_"):
            out[key] = "", "vane_angles", next(m for m in of.metadata if isinstance(m, Bound))
    return out


def _scalar(name: str, unit: str, meaning: str, vanes: tuple[str, ...]) -> Element:
    if name in CHOICES:
        last = len(CHOICES[name]) - 1.0
        return Element(
            *(name, unit, meaning, 0.0, last, "calibration", "schedule", name, "", 1.0), guarded=True, whole=True
        )
    stage = vane_in(name)
    if name not in _bounds() or (stage is not None and stage not in vanes):
        return Element(name, unit, meaning, 0.0, 8.0, "", "", name, "", 1.0, guarded=True, fixed=True)
    section, table, b = _bounds()[name]
    factor = SI.get(b.unit, 1.0)
    guarded = section in GUARDED_SECTIONS or name in GUARDED
    return Element(
        *(name, unit, meaning, b.low * factor, b.high * factor, table, section, name, b.unit, factor), guarded
    )


def elements_of(cal: Calibration, own: Mapping[str, Any] | None = None) -> tuple[Element, ...]:
    """Return what every number of a calibration is, in the order of the row.

    own  name -> unit, meaning, low, high of a controller's own scalars
    """
    out = [
        _scalar(name, f.unit, f.meaning if not f.each else f"{f.meaning}, {name.rpartition('_')[2]}", cal.vanes)
        for f in SCALAR_FIELDS
        for name in (f.each or (f.name,))
    ]
    assert len(out) == len(SCALARS)
    for table, keys, n in (
        ("stroke_tables", ("speed", *CURVES), cal.table.shape[1]),
        ("vane_angles", ("stroke", *cal.vanes), cal.angles.shape[1]),
    ):
        fields = MODELS[table].model_fields
        for key in keys:
            b = next(m for m in fields[key].metadata if isinstance(m, Bound))
            f = SI.get(b.unit, 1.0)
            unit = {"mm": "m", "deg": "rad"}.get(b.unit, b.unit)
            what = f"{table}, {key}"
            out += [
                Element(f"{table}_{key}_{i}", unit, what, b.low * f, b.high * f, table, key, key, b.unit, f)
                for i in range(n)
            ]
    for name, o in (own or {}).items():
        out.append(
            Element(
                *(f"own_{name}", o["unit"], o["meaning"], o["low"], o["high"], "own_calibration", name, name),
                *(o["unit"], 1.0, True),
            )
        )
    return tuple(out)


def curves_of(cal: Calibration) -> tuple[Curve, ...]:
    """Return the curves of a calibration: stroke over speed, and each stage's angle over stroke."""
    n, m, at = cal.table.shape[1], cal.angles.shape[1], len(SCALARS)
    out = [
        Curve(f"stroke_{key}", f"stroke demand against speed, {key}", at + (q + 1) * n, at, n)
        for q, key in enumerate(CURVES)
    ]
    at += 4 * n
    return (
        *out,
        *(
            Curve(f"angle_{v}", f"vane angle against stroke, {v}", at + (q + 1) * m, at, m)
            for q, v in enumerate(cal.vanes)
        ),
    )


def border(value: float, factor: float) -> float:
    """Return the number in the table's unit that is read back as the same bits; the shortest one if there are some."""
    v = value / factor
    for digits in range(6, 17):
        if (short := float(f"{v:.{digits}g}")) * factor == value:
            return short
    for near in (v, nextafter(v, -1e300), nextafter(v, 1e300)):
        if near * factor == value:
            return near
    return v


def documents(elements: tuple[Element, ...], row: np.ndarray, tables: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Return the content of the TOML tables named, as a calibration's row has it."""
    out: dict[str, dict[str, Any]] = {name: {} for name in tables}
    for e, value in zip(elements, row.tolist(), strict=True):
        if e.table not in out:
            continue
        v = border(value, e.factor)
        if e.whole:
            entry: Any = CHOICES[e.name][int(value)]
        else:
            entry = {"value": v, "unit": e.border, "origin": ORIGIN}
        if e.of_curve:
            axis = out[e.table].setdefault(e.key, {"unit": e.border, "origin": ORIGIN, "values": []})
            axis["values"].append(v)
        elif e.table == "own_calibration":
            out[e.table][e.key] = entry
        elif e.section:
            out[e.table].setdefault(e.section, {})[e.key] = entry
        else:
            out[e.table][e.key] = entry
    return out


def complaint(elements: tuple[Element, ...], row: np.ndarray, tables: tuple[str, ...]) -> str:
    """Why these tables would be refused when they are read, in one line; "" where they would not."""
    for name, content in documents(elements, row, tables).items():
        if name in MODELS:
            try:
                MODELS[name].model_validate(content)
            except ValidationError as e:
                return f"{name}: {e.errors()[0]['msg'].removeprefix('Value error, ')}"
    return ""


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return json.dumps(value) if isinstance(value, str) else repr(float(value))


def write_tables(folder: Path, elements: tuple[Element, ...], row: np.ndarray) -> list[Path]:
    """Write a calibration as tables that ``--tables`` takes; return the files. They are read back as the same bits."""
    folder.mkdir(parents=True, exist_ok=True)
    names = (*MODELS, *(["own_calibration"] if any(e.table == "own_calibration" for e in elements) else []))
    out = {}
    for name, content in documents(elements, row, names).items():
        lines = [f"{key} = {_toml(v)}" for key, v in content.items() if not _is_section(v)]
        for section, of in content.items():
            if _is_section(of):
                lines += ["", f"[{section}]", *(f"{key} = {_toml(v)}" for key, v in of.items())]
        out[folder / f"{name}.toml"] = "\n".join(lines).lstrip() + "\n"
    return write_all(out)


def _is_section(value: Any) -> bool:
    return isinstance(value, dict) and "value" not in value
