"""Stroke tables from geometry, schedules and hysteresis: the inverse of the two branches of the loop."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from plant import Geometry, Schedules
from plant.geometry import stroke_for_vigv

__all__ = ["stroke_tables", "write_stroke_tables"]


def stroke_tables(geometry: Geometry, schedules: Schedules, speed: np.ndarray | None = None) -> np.ndarray:
    """Return float64[4, n]: speed (%), strokes (mm) for extension, retraction and the single mean curve.

    While the stroke extends, the VIGV lags behind by half the hysteresis: the stroke that gives the target then is the stroke of
    (target + half), and of (target - half) while it retracts.
    """
    n = np.arange(40.0, 106.0) if speed is None else speed
    target = schedules.targets(n)[:, 0]
    half = 0.5 * np.deg2rad(geometry.vigv.hysteresis.value)
    return np.vstack([n, *[stroke_for_vigv(target + side * half, geometry) * 1e3 for side in (1, -1, 0)]])


def write_stroke_tables(table: np.ndarray, path: str | Path, origin: str) -> None:
    """Write ``stroke_tables.toml`` as the controller loads it; ``table`` as from `stroke_tables`."""
    lines = ["# Stroke against rotor speed for the VIGV schedule: one curve per direction of the demand, and their mean.", ""]
    for name, unit, row in zip(("speed", "extension", "retraction", "single"), ("%", "mm", "mm", "mm"), table, strict=True):
        lines += [f"[{name}]", f'unit = "{unit}"', f'origin = "{origin}"', "values = ["]
        lines += ["  " + ", ".join(f"{v:.4f}".rstrip("0").rstrip(".") for v in row[i : i + 10]) + "," for i in range(0, len(row), 10)]
        lines += ["]", ""]
    Path(path).write_text("\n".join(lines), encoding="utf-8")
