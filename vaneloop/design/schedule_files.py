"""What the scheduling method writes: tables as the controller and the plant load them, each number with its origin, and
the command's JSON.

    write_tables(result, folder)                                    stroke_tables.toml, vane_angles.toml, geometry.toml,
                                                                    schedules.toml
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.logs.notes import told
from plant import Geometry, Schedules
from vaneloop.base.errors import InputError
from vaneloop.base.files import write, write_all
from vaneloop.design.scheduling import ScheduleResult
from vaneloop.design.stroke_tables import vane_angle_table

__all__ = [
    "result_json", "write_geometry", "write_schedules", "write_stroke_tables", "write_tables", "write_vane_angles",
]  # fmt: skip

Array = NDArray[np.float64]
LOOP_FIGURES = (
    "width",
    "width_sigma",
    "offset",
    "lb",
    "lc",
    "misfit",
    "noise",
    "drift",
    "lag",
    "extension_covered",
    "retraction_covered",
)


def write_tables(result: ScheduleResult, folder: str | Path) -> list[Path]:
    """Write stroke_tables, vane_angles, geometry, schedules (.toml) into ``folder``, made where missing; each number
    with its origin. They belong together: all of them are written, or none.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(f"{folder}: cannot be made ({e.strerror})") from None
    linkage = "Linkage of the vane rows, as measured and adjusted: vaneloop schedule."
    texts = {
        "stroke_tables": _stroke_tables(result.table, result.origin),
        "geometry": _geometry(result.geometry, linkage),
        "schedules": _schedules(result.schedules),
        "vane_angles": _vane_angles(vane_angle_table(result.geometry), result.geometry, result.origin),
    }
    return write_all({folder / f"{name}.toml": text for name, text in texts.items()})


def write_stroke_tables(table: Array, path: str | Path, origin: str) -> None:
    """Write ``stroke_tables.toml`` as the controller loads it; ``table`` as from `stroke_tables`."""
    write(path, _stroke_tables(table, origin))


def _stroke_tables(table: Array, origin: str) -> str:
    lines = [
        "# Stroke against rotor speed for the VIGV schedule: one curve per direction of the demand, and their mean.",
        "",
    ]
    for name, unit, row in zip(
        ("speed", "extension", "retraction", "single"), ("%", "mm", "mm", "mm"), table, strict=True
    ):
        lines += _axis(name, unit, origin, row)
    return "\n".join(lines)


def write_vane_angles(table: Array, geometry: Geometry, path: str | Path, origin: str) -> None:
    """Write ``vane_angles.toml`` as the controller loads it: ``table`` as from `vane_angle_table`, the plays of
    ``geometry``.
    """
    write(path, _vane_angles(table, geometry, origin))


def _vane_angles(table: Array, geometry: Geometry, origin: str) -> str:
    lines = [
        "# Vane angles over stroke in the middle of the backlash, and the backlash: the model that the strategies "
        "inverse and adaptive use.",
        "",
    ]
    for stage in geometry.vanes:
        q = geometry.stage(stage).hysteresis
        lines.append(f'play_{stage} = {{ value = {q.value!r}, unit = "deg", origin = {_quoted(q.origin)} }}')
    lines.append("")
    for name, unit, row in zip(("stroke", *geometry.vanes), ("mm", *["deg"] * len(geometry.vanes)), table, strict=True):
        lines += _axis(name, unit, origin, row)
    return "\n".join(lines)


def write_geometry(geometry: Geometry, path: str | Path, words: str = "Linkage of the vane rows.") -> None:
    """Write a geometry as `plant.load_geometry` reads it, each number with its origin."""
    write(path, _geometry(geometry, words))


def _geometry(geometry: Geometry, words: str) -> str:
    lines = [f"# {words}", ""]
    for name in ("crank", *geometry.vanes):
        lines.append(f"[{name}]")
        for key, q in getattr(geometry, name):
            tolerance = f", tolerance = {q.tolerance!r}" if q.tolerance else ""
            lines.append(
                f'{key} = {{ value = {q.value!r}, unit = "{q.unit}"{tolerance}, origin = {_quoted(q.origin)} }}'
            )
        lines.append("")
    return "\n".join(lines)


def write_schedules(schedules: Schedules, path: str | Path) -> None:
    """Write schedules as `plant.load_schedules` reads them."""
    write(path, _schedules(schedules))


def _schedules(schedules: Schedules) -> str:
    lines = ["# Target vane angles over rotor speed.", ""]
    for name in ("speed", *schedules.vanes):
        axis = getattr(schedules, name)
        lines += [
            f"[{name}]",
            f'unit = "{axis.unit}"',
            f"origin = {_quoted(axis.origin)}",
            f"values = {axis.values!r}",
            "",
        ]
    return "\n".join(lines)


def result_json(result: ScheduleResult) -> dict[str, Any]:
    """The result as the JSON of the command."""
    error_keys = ("error_initial", "error_built", "error", "error_extension", "error_retraction")
    return {
        "schema": 1,
        "log": result.log or None,
        "origin": result.origin,
        "table": dict(zip(("speed", "extension", "retraction", "single"), result.table, strict=True)),
        "stages": [
            {
                "stage": s.stage,
                "unit": {"length": "mm", "error": "deg"},
                "lb_initial": s.lb_initial,
                "lb_built": s.lb_built,
                "lc_built": s.lc_built,
                "lb": s.lb,
                "lc": s.lc,
                "target": result.target[:, k],
                **{key: getattr(s, key) for key in error_keys},
                "at_100": s.at_design,
                "rms": s.rms,
                "max_abs": s.largest,
            }
            for k, s in enumerate(result.links)
        ],
        "loops": {name: {key: getattr(m, key) for key in LOOP_FIGURES} for name, m in result.loops.items()},
        **told(result.notes),
    }


def _axis(name: str, unit: str, origin: str, row: Array) -> list[str]:
    """Lines of a list of numbers, ten a line."""
    lines = [f"[{name}]", f'unit = "{unit}"', f"origin = {_quoted(origin)}", "values = ["]
    lines += [
        "  " + ", ".join(f"{v:.4f}".rstrip("0").rstrip(".") for v in row[i : i + 10]) + ","
        for i in range(0, len(row), 10)
    ]
    return [*lines, "]", ""]


def _quoted(text: str) -> str:
    """Text as a TOML basic string."""
    return json.dumps(text, ensure_ascii=False)
