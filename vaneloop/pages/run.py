"""A run on a page: what a page needs of its result, the names of its signals, and the pictures that the replay and the
engine test share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hil.figures import SignalError, noise_floor
from vaneloop.base.signals import SIDES
from vaneloop.base.vanes import VANES
from vaneloop.pages.figures import Line, loop
from vaneloop.pages.page import Page
from vaneloop.pages.series import break_at_holes

__all__ = [
    "NAMES", "ZOOM", "Channel", "Result", "against_speed", "axis_title", "loops", "rotor_speed", "signal_name",
    "speed_lines",
]  # fmt: skip

Array = NDArray[np.float64]
NAMES = {
    "n_dem": ("rotor speed demand", "%"),
    "n_r": ("rotor speed", "%"),
    "x_dem": ("stroke demand", "mm"),
    "x_lvdt": ("stroke", "mm"),
    "i_cmd": ("valve current", "mA"),
    "p_s": ("supply pressure", "MPa"),
    "t_oil": ("oil temperature", "degC"),
    **{v: (f"{v.upper()} angle", "deg") for v in VANES},
    "state": ("controller mode", ""),
    "i_motor": ("motor current", "A"),
    **{name: (f"stroke of actuator {name[-1].upper()}", "mm") for name in SIDES},
}
ZOOM = "Drag across a plot to zoom, double-click to return; click a name in the legend to hide its curve."


class Channel(Protocol):
    """Logged samples: time in s, values in the border unit."""

    @property
    def t(self) -> Array: ...
    @property
    def values(self) -> Array: ...


class Result(Protocol):
    """What a page needs of a `hil.replay.ReplayResult`."""

    @property
    def log(self) -> str: ...
    @property
    def simulated_s(self) -> float: ...
    @property
    def wall_s(self) -> float: ...
    @property
    def state_hash(self) -> str: ...
    @property
    def signals(self) -> Sequence[SignalError]: ...
    @property
    def t(self) -> Array: ...
    @property
    def model(self) -> Mapping[str, Array]: ...
    @property
    def target(self) -> Mapping[str, Array]: ...
    @property
    def measured(self) -> Mapping[str, Any]: ...


def signal_name(signal: str) -> str:
    """Name of a signal in words."""
    return NAMES.get(signal, (signal, ""))[0]


def axis_title(signal: str, unit: str | None = None) -> str:
    """Title of a signal's axis: its name and its unit."""
    name, own = NAMES.get(signal, (signal, unit or ""))
    return f"{name} [{unit or own}]" if unit or own else name


def rotor_speed(result: Result) -> Array:
    """Rotor speed on the result's raster: measured where the log has it, as the schedule's target is."""
    if "n_r" in result.measured:
        c = result.measured["n_r"]
        return np.interp(result.t, c.t, c.values)
    return np.asarray(result.model["n_r"], dtype=float)


def speed_lines(result: Result) -> list[Line]:
    """Rotor speed over time: demanded, measured, simulated, as far as there is any."""
    lines = []
    if "n_dem" in result.measured:
        lines.append(Line("demanded", result.measured["n_dem"].t, result.measured["n_dem"].values, "target", 1.6))
    if "n_r" in result.measured:
        lines.append(Line("measured", result.measured["n_r"].t, result.measured["n_r"].values, "measured", 1.6))
    if "n_r" in result.model:
        lines.append(Line("simulated", result.t, result.model["n_r"], "model", 1.2, shown="n_r" not in result.measured))
    return lines


def against_speed(result: Result, vane: str, name: str = "simulated", role: str = "model") -> Any:
    """Figure of one vane's angle against rotor speed: measured, simulated, and the schedule."""
    speed = rotor_speed(result)
    lines = []
    if vane in result.measured:
        t, angle = break_at_holes(result.measured[vane].t, result.measured[vane].values)
        lines.append(Line("measured", np.interp(t, result.t, speed, left=np.nan, right=np.nan), angle, "measured", 1.2))
    lines.append(Line(name, speed, result.model[vane], role, 1.2))
    n, target = speed, np.asarray(result.target[vane], dtype=float)
    good = np.isfinite(n) & np.isfinite(target)
    n, target = n[good], target[good]
    if n.size:  # the schedule is a function of speed: mean in narrow bands of speed draws it once
        edges = np.linspace(n.min(), n.max() + 1e-9, 201)
        where = np.digitize(n, edges) - 1
        count = np.bincount(where, minlength=200)[:200]
        visited = count > 0
        mean_n, mean_target = (
            np.bincount(where, weights=a, minlength=200)[:200][visited] / count[visited] for a in (n, target)
        )
        lines.append(Line("schedule", mean_n, mean_target, "target", 2.6))
    return loop(lines, "rotor speed [%]", axis_title(vane))


def loops(page: Page, vane: str, paths: Sequence[tuple[str, Array, Array, str]]) -> None:
    """Angle against stroke, and the same less one common smooth curve."""
    lines, flat = [], []
    mean = None
    for name, x, y, role in paths:
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        good = np.isfinite(x) & np.isfinite(y)
        if good.sum() < 20:
            continue
        if mean is None:
            mean = _middle_curve(x[good], y[good])
        lines.append(Line(name, x, y, role, 1.3))
        if mean is not None:
            flat.append(Line(name, x, y - mean(x), role, 1.0))
    if lines:
        page.plot(loop(lines, "stroke [mm]", axis_title(vane)), half=bool(flat))
    if flat:
        page.plot(loop(flat, "stroke [mm]", f"{signal_name(vane)} less mean curve [deg]"), half=True)


def _middle_curve(x: Array, y: Array) -> Any:
    """Smooth curve midway between the two sides of the loop, or None where the stroke hardly moves."""
    if np.ptp(x) < 10 * noise_floor(np.arange(x.size, dtype=float), x) or np.ptp(x) <= 0:
        return None
    line = np.polynomial.Polynomial.fit(x, y, 1)
    edges = np.linspace(x.min(), x.max() + 1e-9, 41)
    where = np.digitize(x, edges) - 1
    order = np.argsort(where, kind="stable")
    sides = []
    for group in np.split(order, np.flatnonzero(np.diff(where[order])) + 1):
        low, high = np.quantile(y[group] - line(x[group]), [0.02, 0.98])
        sides.append((float(np.mean(x[group])), float(low), float(high)))
    at, low_side, high_side = np.array(sides).T
    width = high_side - low_side
    open_loop = width >= 0.6 * np.quantile(width, 0.95)  # elsewhere, as at the ends, only one side was visited
    if open_loop.mean() < 0.6:  # too little of both sides for a curve
        return line
    degree = min(3, int(open_loop.sum()) - 1)
    if degree < 1:
        return line
    return (
        line.convert()
        + np.polynomial.Polynomial.fit(at[open_loop], 0.5 * (low_side + high_side)[open_loop], degree).convert()
    )
