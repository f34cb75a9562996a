"""A self-contained HTML page of figures, tables and plots that opens from disk, with no network, in light and in dark.

    page = Page("Replay of run.csv", "The model follows the log.", tone="good", log="run.csv")
    page.tile("worst signal", "0.21", "deg", "VIGV, RMS")
    page.section("Vane angle", "Measured and simulated over the whole run.")
    page.plot(overlay([Panel("vigv [deg]", [Line("measured", t, y, "measured")])]), "Drag to zoom.")
    page.table(["signal", "rms"], [["vigv", 0.21]])
    page.write("out.html")

A plot is a plain dictionary in Plotly's JSON form; a `plotly.graph_objects.Figure` works too. Colours are names of
roles (``@measured``, ``@model``, ``@target``, ``@error``, ...), which the page resolves for the reader's light or dark
scheme. All text that enters a page is escaped: names out of logs cannot become markup.
"""

from __future__ import annotations

import base64
import html
import json
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vaneloop.base.errors import InputError

__all__ = [
    "Line",
    "Page",
    "Panel",
    "bars",
    "break_at_holes",
    "decimate",
    "heat",
    "histogram",
    "loop",
    "number",
    "overlay",
    "ranking",
    "waterfall",
    "write_atomically",
]

Array = NDArray[np.float64]
Figure = dict[str, Any]
Tone = Literal["neutral", "good", "bad"]
TONE_OF: dict[str, Tone] = {"none": "good", "missing": "neutral", "unknown": "bad"}  # verdict of a diagnosis

MAX_POINTS = 4500  # points a line, three times the pixels of a wide plot; 48 kB of the file
GAP = 10.0  # a hole in the samples this many times the usual distance breaks the line

# Blue and orange stay apart for all common colour-vision deficiencies; both themes keep a contrast above 4.5 on their
# background.
THEMES: dict[str, dict[str, str]] = {
    "light": {
        "measured": "#1f6fc4",
        "model": "#d1560a",
        "target": "#2b8256",
        "error": "#a8327d",
        "noise": "#7a8694",
        "other": "#6a5acd",
        "good": "#2b8256",
        "bad": "#c0322b",
        "muted": "#8c97a3",
        "text": "#1c2530",
        "soft": "#54606d",
        "grid": "#e3e8ed",
        "panel": "#ffffff",
        "heat0": "#f4f7fa",
        "heat1": "#f6b073",
        "heat2": "#a3240f",
        "cold": "#1f5fae",
    },
    "dark": {
        "measured": "#63abf5",
        "model": "#ff9447",
        "target": "#56c48b",
        "error": "#ef7fc4",
        "noise": "#8a97a6",
        "other": "#a99cf5",
        "good": "#56c48b",
        "bad": "#ff7b72",
        "muted": "#7b8794",
        "text": "#e8edf2",
        "soft": "#a7b3bf",
        "grid": "#2b343e",
        "panel": "#171d24",
        "heat0": "#1d252e",
        "heat1": "#a8571c",
        "heat2": "#ffb38a",
        "cold": "#6fb1ff",
    },
}


# ---------------------------------------------------------------- numbers and series


def number(value: object, digits: int = 3) -> str:
    """Return ``value`` for a reader: three significant digits, no exponent between 0.001 and 100,000, an en dash for
    nothing.
    """
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{int(value):,}"
    if isinstance(value, float | np.floating):
        v = float(value)
        if not math.isfinite(v):
            return "–"
        if v == 0:
            return "0"
        if not 1e-3 <= abs(v) < 1e5:
            return f"{v:.{digits - 1}e}"
        decimals = max(0, digits - 1 - math.floor(math.log10(abs(v))))
        while decimals > 0 and round(v, decimals - 1) == v:  # 0.55 as published, not 0.550
            decimals -= 1
        return f"{v:,.{decimals}f}"
    return str(value)


def break_at_holes(x: Array, y: Array) -> tuple[Array, Array]:
    """Insert a NaN where the samples pause: where ``x`` leaps by more than 10 times the usual distance."""
    if x.size < 3:
        return x, y
    step = np.diff(x)
    usual = float(np.median(step))
    if usual <= 0:  # not a time axis
        return x, y
    holes = np.flatnonzero(step > GAP * usual)
    if holes.size == 0 or holes.size > x.size // 20:  # many holes: an irregular raster, not a broken one
        return x, y
    return np.insert(x, holes + 1, x[holes] + usual), np.insert(y, holes + 1, np.nan)


def decimate(x: ArrayLike, y: ArrayLike, limit: int = MAX_POINTS) -> tuple[Array, Array]:
    """Thin a long line to at most ``limit`` points and keep what the eye would see: every extreme and every gap.

    The samples are cut into equal groups; of each group its least value, its greatest value and one NaN, if it has any,
    stay. A hole in ``x`` of more than 10 times the usual distance becomes a NaN, so that no line is drawn across it.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if x.shape != y.shape:
        raise ValueError(f"x has {x.size} values, y has {y.size}; they must be equal in number")
    y = np.where(np.isfinite(y), y, np.nan)
    x, y = break_at_holes(x, y)
    n = x.size
    if n <= limit:
        return x, y
    groups = max(1, (limit - 2) // 3)
    width = -(-n // groups)
    rows = np.full(-(-n // width) * width, np.nan)
    rows[:n] = y
    grid: Any = rows.reshape(-1, width)
    base = np.arange(grid.shape[0]) * width
    missing = np.isnan(grid)
    low = base + np.argmin(np.where(missing, np.inf, grid), axis=1)
    high = base + np.argmax(np.where(missing, -np.inf, grid), axis=1)
    hole = (base + np.argmax(missing, axis=1))[missing.any(axis=1)]
    keep = np.unique(np.concatenate([[0], low, high, hole, [n - 1]]))
    keep = keep[keep < n]  # the last group is padded
    return x[keep], y[keep]


def _thin_path(x: Array, y: Array, limit: int = MAX_POINTS) -> tuple[Array, Array]:
    """Thin a path in the plane to what the eye can tell apart.

    The plane is divided into cells of about two pixels. A sample stays where the path enters a cell; a step between two
    cells that was drawn before is not drawn again. So dwells cost nothing, and no chord cuts across a fast motion.
    Cells grow until ``limit`` is met.
    """
    good = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if x.size <= limit or good.size == 0:
        bad = ~(np.isfinite(x) & np.isfinite(y))
        return np.where(bad, np.nan, x), np.where(bad, np.nan, y)
    gaps = np.concatenate([[0], np.cumsum(np.diff(good) > 1)])  # gaps in the data before each sample
    x, y = x[good], y[good]
    cells = 500
    while True:
        column, row = (np.floor((a - a.min()) / ((np.ptp(a) or 1.0) / cells)).astype(np.int64) for a in (x, y))
        cell = column * (cells + 1) + row
        enters = np.concatenate([[0], np.flatnonzero(np.diff(cell)) + 1])
        a, b = cell[enters[:-1]], cell[enters[1:]]
        steps = np.sort(np.unique(np.minimum(a, b) * (cells + 1) ** 2 + np.maximum(a, b), return_index=True)[1])
        steps = steps[gaps[enters[steps]] == gaps[enters[steps + 1]]]
        jumps = np.flatnonzero(np.diff(steps) > 1) + 1  # the pen is lifted here
        points = steps.size + 2 * jumps.size + 2
        if points <= limit or cells < 20:
            break
        cells = int(cells * max(0.4, 0.95 * math.sqrt(limit / points)))
    if steps.size == 0:
        return x[:1], y[:1]
    ends = np.concatenate([jumps, [steps.size]])
    at = np.insert(
        enters[steps], ends, enters[steps[ends - 1] + 1]
    )  # each stroke of the pen ends where its last step does
    lifts = ends[:-1] + np.arange(1, ends.size)
    return np.insert(x[at], lifts, np.nan), np.insert(y[at], lifts, np.nan)


def _packed(values: ArrayLike) -> dict[str, str]:
    """Plotly's binary form: single precision where it resolves the spacing of the values, else double."""
    a = np.ascontiguousarray(values, dtype=float)
    finite = a[np.isfinite(a)]
    dtype = "f4"
    if finite.size:
        step = np.abs(np.diff(finite))
        step = step[step > 0]
        rounding = np.abs(finite - finite.astype(np.float32)).max()
        spread = float(np.ptp(finite))
        if spread > 0 and rounding > max(1e-5 * spread, 0.05 * float(np.median(step)) if step.size else 0.0):
            dtype = "f8"
    return {"dtype": dtype, "bdata": base64.b64encode(a.astype("<" + dtype).tobytes()).decode()}


def _label(text: object) -> str:
    """Text for the inside of a plot, where Plotly reads tags."""
    return html.escape(str(text), quote=False)


# ---------------------------------------------------------------- plots


@dataclass(frozen=True)
class Line:
    """One curve: its name in the legend, its points and the role that gives it its colour."""

    name: str
    x: ArrayLike
    y: ArrayLike
    role: str = "model"
    width: float = 1.4
    dash: str = "solid"
    opacity: float = 1.0
    shown: bool = True  # False: hidden until the reader clicks its name


@dataclass(frozen=True)
class Panel:
    """One plot of a stack over a common axis.

    title   what the vertical axis shows, with its unit
    band    half-width of a grey band about zero, for example three times the noise floor
    height  relative to the other panels
    zero    draw the line of zero
    """

    title: str
    lines: Sequence[Line]
    band: float | None = None
    height: float = 1.0
    zero: bool = False
    log: bool = False
    marks: Mapping[str, float] = field(default_factory=dict)  # name -> level of a dashed horizontal line


def overlay(panels: Sequence[Panel], x_title: str = "time [s]", height: int | None = None) -> Figure:
    """Curves in stacked panels over one common axis: zoom in one and all follow."""
    total = sum(p.height for p in panels)
    space = 0.055 if len(panels) > 1 else 0.0
    usable = 1.0 - space * (len(panels) - 1)
    data: list[Figure] = []
    layout: Figure = {
        "height": height or int(110 + 215 * total),
        "hovermode": "x unified",
        "hoversubplots": "axis",
        "xaxis": {"title": {"text": _label(x_title)}, "anchor": "y" + _nth(len(panels)), "showspikes": True},
        "shapes": [],
        "annotations": [],
    }
    top, seen = 1.0, set()
    for k, panel in enumerate(panels, start=1):
        bottom = max(0.0, top - usable * panel.height / total)
        layout["yaxis" + _nth(k)] = {
            "title": {"text": _label(panel.title)},
            "domain": [bottom, top],
            "zeroline": panel.zero,
            "type": "log" if panel.log else "linear",
        }
        top = bottom - space
        _band_and_marks(layout, panel, "y" + _nth(k))
        for line in panel.lines:
            x, y = decimate(line.x, line.y)
            data.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": _label(line.name),
                    "legendgroup": _label(line.name),
                    "showlegend": line.name not in seen,
                    "visible": True if line.shown else "legendonly",
                    "xaxis": "x",
                    "yaxis": "y" + _nth(k),
                    "x": _packed(x),
                    "y": _packed(y),
                    "opacity": line.opacity,
                    "line": {"color": _role(line.role), "width": line.width, "dash": line.dash},
                    "connectgaps": False,
                    "hovertemplate": "%{y:.4g}",
                }
            )
            seen.add(line.name)
    return {"data": data, "layout": layout}


def _band_and_marks(layout: Figure, panel: Panel, axis: str) -> None:
    """Draw the grey band and the level marks of one panel."""
    across = {"xref": "x domain", "x0": 0, "x1": 1, "yref": axis, "layer": "below"}
    if panel.band:
        rect = {
            "type": "rect",
            "y0": -panel.band,
            "y1": panel.band,
            "fillcolor": "@noise",
            "opacity": 0.22,
            "line": {"width": 0},
        }
        layout["shapes"].append(across | rect)
        edge = {"type": "line", "line": {"color": "@text", "width": 1, "dash": "dot"}, "opacity": 0.7, "layer": "above"}
        layout["shapes"] += [across | edge | {"y0": level, "y1": level} for level in (-panel.band, panel.band)]
    for name, level in panel.marks.items():
        layout["shapes"].append(
            across | {"type": "line", "y0": level, "y1": level, "line": {"color": "@soft", "width": 1, "dash": "dot"}}
        )
        layout["annotations"].append(
            {
                "xref": "x domain",
                "x": 1,
                "xanchor": "right",
                "yref": axis,
                "y": level,
                "yanchor": "bottom",
                "text": _label(name),
                "showarrow": False,
                "font": {"size": 11, "color": "@soft"},
            }
        )


def histogram(
    errors: Mapping[str, ArrayLike],
    x_title: str,
    roles: Mapping[str, str] | None = None,
    noise: float | None = None,
    bins: int = 81,
) -> Figure:
    """Share of the samples at each size of error. Outermost bins hold what lies beyond the 99.8 % range.

    noise: RMS of the measurement noise; a dotted line shows what a perfect model would leave.
    """
    series = {name: (a := np.asarray(e, dtype=float))[np.isfinite(a)] for name, e in errors.items()}
    series = {name: e for name, e in series.items() if e.size}
    reach = max((float(np.quantile(np.abs(e), 0.998)) for e in series.values()), default=0.0)
    reach = max(reach, 4 * (noise or 0.0)) or 1.0
    edges = np.linspace(-reach, reach, bins + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    colours = dict(zip(series, ["error", "measured", "model", "target", "other"], strict=False)) | dict(roles or {})
    data: list[Figure] = []
    highest = 0.0
    for name, e in series.items():
        share = 100.0 * np.histogram(np.clip(e, -reach, reach), edges)[0] / e.size
        highest = max(highest, float(share.max()))
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": _label(name),
                "x": _packed(middle),
                "y": _packed(share),
                "line": {"shape": "hvh", "color": _role(colours.get(name, "other")), "width": 1.5},
                "fill": "tozeroy",
                "fillcolor": _role(colours.get(name, "other")) + "/0.25",
                "hovertemplate": "%{x:.3g}: %{y:.2f} %",
            }
        )
    if noise:
        step = edges[1] - edges[0]
        # share of a Gaussian in one bin; narrower than the bin it would exceed the plot, so it is clipped there
        bell = 100.0 * step / (noise * math.sqrt(2 * math.pi)) * np.exp(-0.5 * (middle / noise) ** 2)
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": "measurement noise alone",
                "x": _packed(middle),
                "y": _packed(bell),
                "line": {"color": "@soft", "width": 1.3, "dash": "dot"},
                "hoverinfo": "skip",
            }
        )
    layout = {
        "height": 340,
        "xaxis": {"title": {"text": _label(x_title)}, "range": [-reach * 1.02, reach * 1.02]},
        "yaxis": {"title": {"text": "share of samples [%]"}, "range": [0, 1.12 * highest or 1.0]},
    }
    return {"data": data, "layout": layout}


def loop(lines: Sequence[Line], x_title: str, y_title: str, height: int = 440, markers: bool = False) -> Figure:
    """One quantity against another; a loop that stays open is hysteresis."""
    data, reach = [], []
    for line in lines:
        x, y = _thin_path(np.asarray(line.x, dtype=float), np.asarray(line.y, dtype=float))
        colour = _role(line.role)
        reach += [float(np.nanmin(y)), float(np.nanmax(y))] if np.isfinite(y).any() and line.shown else []
        data.append(
            {
                "type": "scatter",
                "mode": "markers" if markers else "lines",
                "name": _label(line.name),
                "x": _packed(x),
                "y": _packed(y),
                "line": {"color": colour, "width": line.width, "dash": line.dash},
                "marker": {"color": colour, "size": 3},
                "visible": True if line.shown else "legendonly",
                "hovertemplate": "%{x:.4g}, %{y:.4g}",
            }
        )
    layout: Figure = {
        "height": height,
        "hovermode": "closest",
        "xaxis": {"title": {"text": _label(x_title)}},
        "yaxis": {"title": {"text": _label(y_title)}},
    }
    if reach and max(reach) > min(reach):
        margin = 0.06 * (max(reach) - min(reach))
        layout["yaxis"]["range"] = [min(reach) - margin, max(reach) + margin]
    return {"data": data, "layout": layout}


def bars(
    groups: Sequence[str],
    series: Mapping[str, Sequence[float | None]],
    y_title: str,
    roles: Mapping[str, str] | None = None,
    marks: Mapping[str, float] | None = None,
    height: int = 360,
) -> Figure:
    """Grouped bars with their values above them; ``marks`` are named dashed levels."""
    colours = dict(zip(series, ["measured", "model", "target", "error", "other"], strict=False)) | dict(roles or {})
    data = [
        {
            "type": "bar",
            "name": _label(name),
            "x": [_label(g) for g in groups],
            "y": [None if v is None or not math.isfinite(v) else float(v) for v in values],
            "text": [number(v) if v is not None else "none" for v in values],
            "textposition": "outside",
            "cliponaxis": False,
            "marker": {"color": _role(colours.get(name, "other"))},
            "hovertemplate": "%{x}: %{text}",
        }
        for name, values in series.items()
    ]
    layout: Figure = {
        "height": height,
        "barmode": "group",
        "bargap": 0.28,
        "bargroupgap": 0.06,
        "xaxis": {"type": "category", "showgrid": False},
        "yaxis": {"title": {"text": _label(y_title)}, "rangemode": "tozero"},
        "shapes": [],
        "annotations": [],
    }
    _band_and_marks(layout, Panel("", [], marks=marks or {}), "y")
    return {"data": data, "layout": layout}


def waterfall(
    steps: Sequence[tuple[str, float]], y_title: str, floor: float | None = None, height: int = 400
) -> Figure:
    """How an error falls step by step: the level after each step, the fall hanging from the level before.

    steps  (name, level reached); the first is where it starts, the last where it ends
    floor  level that cannot be undercut, drawn as a line
    """
    names = [_label(s[0]) for s in steps]
    levels = [float(s[1]) for s in steps]
    base, size, colours, text = [], [], [], []
    for i, level in enumerate(levels):
        if i in (0, len(levels) - 1):
            base.append(0.0)
            size.append(level)
            colours.append("@error" if i == 0 else "@measured")
            text.append(number(level))
        else:
            base.append(min(level, levels[i - 1]))
            size.append(abs(level - levels[i - 1]))
            colours.append("@good" if level <= levels[i - 1] else "@bad")
            text.append(f"{level - levels[i - 1]:+.3g}".replace("-", "−"))
    thin = {"color": "@muted", "width": 1, "dash": "dot"}
    connectors = [
        {"type": "line", "xref": "x", "yref": "y", "x0": i, "x1": i + 1, "y0": levels[i], "y1": levels[i], "line": thin}
        for i in range(len(levels) - 1)
    ]
    layout: Figure = {
        "height": height,
        "showlegend": False,
        "bargap": 0.35,
        "xaxis": {"type": "category", "showgrid": False},
        "yaxis": {"title": {"text": _label(y_title)}, "rangemode": "tozero"},
        "shapes": connectors,
        "annotations": [],
    }
    _band_and_marks(layout, Panel("", [], marks={} if floor is None else {f"noise floor {number(floor)}": floor}), "y")
    bar = {
        "type": "bar",
        "x": names,
        "y": size,
        "base": base,
        "text": text,
        "textposition": "outside",
        "cliponaxis": False,
        "marker": {"color": colours},
        "hovertemplate": "%{x}: %{text}",
    }
    return {"data": [bar], "layout": layout}


def ranking(
    names: Sequence[str],
    values: Sequence[float],
    x_title: str,
    notes: Sequence[str] | None = None,
    highlight: Sequence[str] = (),
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
) -> Figure:
    """Horizontal bars, greatest on top, for example candidate effects by probability; ``highlight`` ones stand out."""
    order = sorted(range(len(names)), key=lambda i: values[i])
    bar: Figure = {
        "type": "bar",
        "orientation": "h",
        "y": [_label(names[i]) for i in order],
        "x": [float(values[i]) for i in order],
        "text": [number(values[i]) + (f"  {_label(notes[i])}" if notes else "") for i in order],
        "textposition": "outside",
        "cliponaxis": False,
        "marker": {"color": ["@model" if names[i] in highlight else "@muted" for i in order]},
        "hovertemplate": "%{y}: %{text}",
    }
    if low is not None and high is not None:
        bar["error_x"] = {
            "type": "data",
            "symmetric": False,
            "array": [high[i] - values[i] for i in order],
            "arrayminus": [values[i] - low[i] for i in order],
            "color": "@soft",
        }
    top = max([*values, *(high or [])], default=1.0) or 1.0
    layout = {
        "height": 90 + 26 * max(3, len(names)),
        "bargap": 0.3,
        "showlegend": False,
        "xaxis": {"title": {"text": _label(x_title)}, "range": [0, 1.25 * top]},
        "yaxis": {"type": "category", "showgrid": False, "automargin": True},
    }
    return {"data": [bar], "layout": layout}


def heat(
    values: Sequence[Sequence[float | None]] | ArrayLike,
    columns: Sequence[str],
    rows: Sequence[str],
    unit: str,
    x_title: str = "",
    y_title: str = "",
    signed: bool = False,
) -> Figure:
    """Map of a figure over two conditions (rows, columns); an empty cell was never visited.

    signed: colours diverge about zero (bias); otherwise they grow from zero (size of an error).
    """
    z = np.array(
        [[math.nan if v is None else float(v) for v in row] for row in np.asarray(values, dtype=object)], dtype=float
    )
    text = [["" if not math.isfinite(v) else number(v, 2) for v in row] for row in z]
    reach = float(np.nanmax(np.abs(z))) if np.isfinite(z).any() else 1.0
    scale = (
        [[0, "@cold"], [0.5, "@heat0"], [1, "@heat2"]] if signed else [[0, "@heat0"], [0.5, "@heat1"], [1, "@heat2"]]
    )
    trace = {
        "type": "heatmap",
        "z": [[None if not math.isfinite(v) else float(v) for v in row] for row in z],
        "x": [_label(c) for c in columns],
        "y": [_label(r) for r in rows],
        "text": text,
        "texttemplate": "%{text}",
        "colorscale": scale,
        "zmin": -reach if signed else 0.0,
        "zmax": reach or 1.0,
        "xgap": 2,
        "ygap": 2,
        "showlegend": False,
        "colorbar": {"title": {"text": _label(unit)}, "thickness": 12, "outlinewidth": 0},
        "hovertemplate": f"%{{y}}, %{{x}}: %{{z:.3g}} {_label(unit)}<extra></extra>",
    }
    return {
        "data": [trace],
        "layout": {
            "height": 120 + 38 * max(3, len(rows)),
            "xaxis": {"type": "category", "title": {"text": _label(x_title)}, "showgrid": False},
            "yaxis": {
                "type": "category",
                "title": {"text": _label(y_title)},
                "autorange": "reversed",
                "showgrid": False,
            },
        },
    }


def _role(role: str) -> str:
    """Colour of a role as the page's own name for it; any other colour passes."""
    return "@" + role if role in THEMES["light"] else role


def _nth(k: int) -> str:
    """Plotly's suffix of the k-th axis: none, 2, 3, ..."""
    return "" if k == 1 else str(k)


# ---------------------------------------------------------------- the page


class Page:
    """A report under construction: verdict, key figures, sections, footer."""

    def __init__(
        self,
        title: str,
        verdict: str,
        *,
        tone: Tone = "neutral",
        subtitle: str = "",
        command: str = "",
        log: str = "",
        state_hash: str = "",
        version: str | None = None,
    ):
        self.title, self.verdict, self.tone, self.subtitle = title, verdict, tone, subtitle
        self.facts = {"version": version or _version(), "command": command, "log": log, "state hash": state_hash}
        self._tiles: list[str] = []
        self._body: list[str] = []
        self._sections: list[str] = []
        self._figures: list[Figure] = []
        self._grid = False

    def tile(self, label: str, value: object, unit: str = "", note: str = "", tone: Tone = "neutral") -> None:
        """Add a key figure; ``note`` says in a few words what it means."""
        e = html.escape
        self._tiles.append(
            f'<div class="tile {e(tone)}"><div class="label">{e(label)}</div><div '
            f'class="value">{e(number(value))}<span class="unit">{e(unit)}</span></div><div '
            f'class="note">{e(note)}</div></div>'
        )

    def section(self, title: str, text: str = "") -> None:
        """Begin a section: a heading and what its plots say in plain words; an empty line in ``text`` begins a new
        paragraph.
        """
        self._end_grid()
        self._sections.append(title)
        self._body.append(f'<h2 id="s{len(self._sections)}">{html.escape(title)}</h2>')
        self.text(text)

    def text(self, text: str) -> None:
        """Add paragraphs."""
        self._end_grid()
        self._body += [f"<p>{html.escape(p.strip())}</p>" for p in text.split("\n\n") if p.strip()]

    def plot(self, figure: Any, caption: str = "", *, half: bool = False) -> None:
        """Add a plot; two ``half`` ones in a row stand side by side where the screen is wide enough."""
        if hasattr(figure, "to_plotly_json"):
            figure = json.loads(figure.to_json())
        if half and not self._grid:
            self._body.append('<div class="pair">')
            self._grid = True
        elif not half:
            self._end_grid()
        height = int(figure.get("layout", {}).get("height") or 400)
        note = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
        self._body.append(
            f'<figure><div class="plot" id="p{len(self._figures)}" style="height:{height}px"></div>{note}</figure>'
        )
        self._figures.append(figure)

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[object]], caption: str = "") -> None:
        """Add a table; numbers are rounded to three digits and set flush right."""
        self._end_grid()
        e = html.escape
        head = "".join(
            f"<th{_right(all(_is_number(r[i]) for r in rows) and bool(rows))}>{e(str(c))}</th>"
            for i, c in enumerate(columns)
        )
        body = "".join("<tr>" + "".join(f"<td{_kind(v)}>{e(number(v))}</td>" for v in row) + "</tr>\n" for row in rows)
        note = f"<caption>{e(caption)}</caption>" if caption else ""
        self._body.append(
            f'<div class="scroll"><table>{note}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )

    def html(self) -> str:
        """Return the whole page."""
        from plotly.offline import get_plotlyjs

        self._end_grid()
        e = html.escape
        toc = "".join(f'<a href="#s{i}">{e(s)}</a>' for i, s in enumerate(self._sections, start=1))
        facts = "".join(f"<div><dt>{e(k)}</dt><dd>{e(v)}</dd></div>" for k, v in self.facts.items() if v)
        parts = [
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" '
            'content="light dark">',
            f"<title>{e(self.title)}</title>",
            f"<style>{_css()}</style>",
            "</head><body><main>",
            f"<header><p "
            f'class="kicker">VaneLoop{" · " + e(self.subtitle) if self.subtitle else ""}</p><h1>{e(self.title)}</h1>'
            f'<p class="verdict {e(self.tone)}">{e(self.verdict)}</p></header>',
            f'<div class="tiles">{"".join(self._tiles)}</div>' if self._tiles else "",
            f'<nav aria-label="contents">{toc}</nav>' if len(self._sections) > 1 else "",
            *self._body,
            f"<footer><dl>{facts}</dl></footer>",
            "</main>",
            f'<script type="application/json" id="figures">{_json(self._figures)}</script>',
            f'<script type="application/json" id="themes">{_json(THEMES)}</script>',
            f"<script>{get_plotlyjs()}</script>",
            f"<script>{_SCRIPT}</script>",
            "</body></html>",
        ]
        return "\n".join(parts) + "\n"

    def write(self, path: str | Path) -> Path:
        """Write the page in one go: a reader never sees half of it. Raises InputError when it cannot be written."""
        return write_atomically(path, self.html())

    def _end_grid(self) -> None:
        if self._grid:
            self._body.append("</div>")
            self._grid = False


def write_atomically(path: str | Path, text: str) -> Path:
    """Write UTF-8 text into a temporary file beside ``path`` and rename it. Raises InputError when it cannot be
    written.
    """
    file = Path(path)
    temporary = ""
    try:
        if file.is_dir():
            raise IsADirectoryError(21, "it is a folder; a file name is needed")
        handle, temporary = tempfile.mkstemp(prefix="." + file.name + ".", suffix=".part", dir=file.parent)
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace", newline="\n") as f:
            f.write(text)
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)  # mkstemp makes it private
        os.replace(temporary, file)
    except (OSError, ValueError) as error:
        if temporary and os.path.exists(temporary):
            os.unlink(temporary)
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{file}: report cannot be written ({reason}); the folder must exist and be writable"
        ) from None
    return file


def _version() -> str:
    """Version of the installed distribution."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return "vaneloop " + version("vaneloop")
    except PackageNotFoundError:
        return "vaneloop (not installed)"


def _is_number(value: object) -> bool:
    return value is None or (isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool))


def _kind(value: object) -> str:
    """Class of a table cell: numbers flush right, short text unbroken."""
    return ' class="num"' if _is_number(value) else ' class="short"' if len(str(value)) <= 24 else ""


def _right(yes: bool) -> str:
    return ' class="num"' if yes else ""


def _json(data: object) -> str:
    """JSON that can stand inside a script element: no tag can end it, no NaN breaks it."""
    text = json.dumps(_finite(data), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for c in "<>&\u2028\u2029":
        text = text.replace(c, f"\\u{ord(c):04x}")
    return text


def _finite(data: Any) -> Any:
    """Plain Python data with None for what JSON cannot hold."""
    if isinstance(data, Mapping):
        return {str(k): _finite(v) for k, v in data.items()}
    if isinstance(data, np.ndarray):
        return _finite(data.tolist())
    if isinstance(data, list | tuple):
        return [_finite(v) for v in data]
    if isinstance(data, float | np.floating):
        return float(data) if math.isfinite(data) else None
    if isinstance(data, np.integer):
        return int(data)
    return data


_POLICY = (  # no network at all, whatever a page may hold
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; "
    "form-action 'none'"
)


def _css() -> str:
    light, dark = ("".join(f"--{k}:{v};" for k, v in THEMES[s].items()) for s in ("light", "dark"))
    return (
        f":root{{{light}--page:#f3f5f8}}\n@media (prefers-color-scheme: dark){{:root{{{dark}--page:#0f1419}}}}\n"
        f"@media print{{:root{{{light}--page:#ffffff}}}}\n" + _STYLE
    )


_STYLE = """
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--text);
 font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Noto Sans","DejaVu Sans",sans-serif}
main{max-width:1560px;margin:0 auto;padding:28px 36px 40px}
.kicker{margin:0;color:var(--soft);font-size:14px;letter-spacing:.04em}
h1{margin:2px 0 10px;font-size:26px;line-height:1.25;overflow-wrap:anywhere}
.verdict{margin:0 0 22px;padding:14px 20px;border-left:6px solid var(--measured);background:var(--panel);
  border-radius:6px;
 font-size:22px;line-height:1.4;max-width:78ch;overflow-wrap:anywhere}
.verdict.good{border-color:var(--good)}.verdict.bad{border-color:var(--bad)}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(190px,1fr));gap:14px;margin-bottom:20px}
.tile{background:var(--panel);border:1px solid var(--grid);border-radius:8px;padding:12px 16px}
.tile .label{color:var(--soft);font-size:14px}
.tile .value{font-size:28px;font-weight:600;line-height:1.25;font-variant-numeric:tabular-nums;overflow-wrap:anywhere}
.tile .unit{font-size:16px;font-weight:400;color:var(--soft);margin-left:6px}
.tile .note{color:var(--soft);font-size:13.5px;line-height:1.35}
.tile.good .value{color:var(--good)}.tile.bad .value{color:var(--bad)}
nav{display:flex;flex-wrap:wrap;gap:4px 18px;margin-bottom:6px;font-size:15px}
nav a{color:var(--measured)}
h2{margin:34px 0 4px;font-size:20px;overflow-wrap:anywhere}
p{margin:6px 0 12px;max-width:92ch}
figure{margin:12px 0;background:var(--panel);border:1px solid var(--grid);border-radius:8px;padding:8px 10px 10px;
  min-width:0}
figcaption{color:var(--soft);font-size:14px;padding:2px 10px 2px;max-width:110ch}
.pair{display:grid;grid-template-columns:repeat(2,minmax(0,1fr));gap:0 14px}
@media (max-width:900px){.pair{grid-template-columns:minmax(0,1fr)}main{padding:18px 14px}}
.plot{width:100%}
.scroll{overflow-x:auto;margin:12px 0;background:var(--panel);border:1px solid var(--grid);border-radius:8px}
table{border-collapse:collapse;width:100%;font-size:15px;font-variant-numeric:tabular-nums}
caption{caption-side:bottom;text-align:left;color:var(--soft);font-size:14px;padding:8px 14px}
th,td{padding:7px 14px;text-align:left;border-bottom:1px solid var(--grid)}
th{font-weight:600;color:var(--soft);font-size:14px;vertical-align:bottom}
th.num,td.num{text-align:right}td.num,td.short{white-space:nowrap}
tbody tr:last-child td{border-bottom:0}
footer{margin-top:36px;border-top:1px solid var(--grid);color:var(--soft);font-size:13.5px}
dl{display:grid;gap:2px;margin:12px 0}dl div{display:flex;gap:12px}dt{flex:0 0 90px}
dd{margin:0;font-family:ui-monospace,"DejaVu Sans Mono",monospace;font-size:12.5px;overflow-wrap:anywhere}
@page{size:A4 landscape;margin:11mm}
@media print{body{font-size:12px}main{padding:0;max-width:none}nav{display:none}.verdict{font-size:18px}
  .tile .value{font-size:20px}
 h2,h2+p{break-after:avoid}.modebar{display:none!important}figure,.tile,tr,.scroll{break-inside:avoid}.pair{grid-template-columns:repeat(2,minmax(0,1fr))}
 *{-webkit-print-color-adjust:exact;print-color-adjust:exact}}
"""

_SCRIPT = """
"use strict";
(() => {
  const read = id => JSON.parse(document.getElementById(id).textContent);
  const figures = read("figures"), themes = read("themes");
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  // "@role" and "@role/opacity" become the theme's colour
  const paint = (x, c) => {
    if (typeof x === "string" && x[0] === "@") {
      const [role, alpha] = x.slice(1).split("/");
      const colour = c[role];
      if (colour === undefined) return x;
      return alpha === undefined ? colour : colour + Math.round(255 * alpha).toString(16).padStart(2, "0");
    }
    if (Array.isArray(x)) return x.map(v => paint(v, c));
    if (x !== null && typeof x === "object") {
      if (x.bdata !== undefined) return x;
      return Object.fromEntries(Object.entries(x).map(([k, v]) => [k, paint(v, c)]));
    }
    return x;
  };
  const axis = c => ({gridcolor: c.grid, linecolor: c.muted, zerolinecolor: c.muted, zerolinewidth: 1,
    tickcolor: c.muted,
    automargin: true, title: {standoff: 8}, spikecolor: c.muted, spikethickness: 1, spikedash: "solid",
    spikemode: "across"});
  const template = c => ({layout: {
    font: {family: 'system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif',
      size: 13, color: c.text},
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", xaxis: axis(c), yaxis: axis(c),
    margin: {l: 66, r: 44, t: 44, b: 50}, dragmode: "zoom", showlegend: true,
    legend: {orientation: "h", x: 0, xanchor: "left", y: 1, yanchor: "bottom", yref: "container"},
    hoverlabel: {bgcolor: c.panel, bordercolor: c.muted, font: {color: c.text}},
    modebar: {orientation: "v", bgcolor: "rgba(0,0,0,0)", color: c.muted, activecolor: c.text},
    colorway: [c.measured, c.model, c.target, c.error, c.other]}});
  // the buttons are named one by one: Plotly's own list has one that sends the plot to a server
  const config = {responsive: true, displaylogo: false, displayModeBar: "hover", plotlyServerURL: "",
    modeBarButtons: [["zoom2d", "pan2d", "resetScale2d"], ["toImage"]]};
  const draw = (name, width) => figures.forEach((figure, i) => {
    const c = themes[name], painted = paint(figure, c), element = document.getElementById("p" + i);
    painted.layout.template = template(c);
    painted.layout.uirevision = "keep";
    painted.layout.legend = Object.assign({orientation: "h", x: 0, y: 1, yanchor: "top", yref: "container"},
      painted.layout.legend);
    if (width) painted.layout.width = element.closest(".pair") ? width / 2 - 24 : width - 24;
    else painted.layout.autosize = true;
    Plotly.react(element, painted.data, painted.layout, config);
  });
  const screen = () => draw(dark.matches ? "dark" : "light");
  screen();
  dark.addEventListener("change", screen);
  window.addEventListener("beforeprint", () => draw("light", 1010));
  window.addEventListener("afterprint", screen);
})();
"""
