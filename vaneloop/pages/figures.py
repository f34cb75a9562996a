"""Figures of a page: curves over a common axis, loops, bars, histograms, maps.

    overlay([Panel("vigv [deg]", [Line("measured", t, y, "measured")])])

A figure is a plain dictionary in Plotly's JSON form. Colours are names of roles (``@measured``, ``@model``,
``@target``, ``@error``, ...), which the page resolves for the reader's light or dark scheme.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vaneloop.pages.series import decimate, packed, thin_path
from vaneloop.pages.style import THEMES, cell_role, number

__all__ = ["UNDER", "Figure", "Line", "Panel", "bars", "heat", "histogram", "loop", "overlay", "ranking", "waterfall"]

Figure = dict[str, Any]
UNDER = 2.6  # px, width of a measured curve under that of a model: seen beside it where the two are one
MOST_NAMED = 20  # bars that have their value above them; of more the words are too small


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
                    "x": packed(x),
                    "y": packed(y),
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
                "y": math.log10(level) if panel.log else level,  # placed by exponent on such an axis
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
                "x": packed(middle),
                "y": packed(share),
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
                "x": packed(middle),
                "y": packed(bell),
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
        x, y = thin_path(np.asarray(line.x, dtype=float), np.asarray(line.y, dtype=float))
        colour = _role(line.role)
        reach += [float(np.nanmin(y)), float(np.nanmax(y))] if np.isfinite(y).any() and line.shown else []
        data.append(
            {
                "type": "scatter",
                "mode": "markers" if markers else "lines",
                "name": _label(line.name),
                "x": packed(x),
                "y": packed(y),
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
    x_title: str = "",
) -> Figure:
    """Grouped bars with their values above them, where there is room; ``marks`` are named dashed levels."""
    colours = dict(zip(series, ["measured", "model", "target", "error", "other"], strict=False)) | dict(roles or {})
    data = [
        {
            "type": "bar",
            "name": _label(name),
            "x": [_label(g) for g in groups],
            "y": [None if v is None or not math.isfinite(v) else float(v) for v in values],
            "text": [number(v) if v is not None else "none" for v in values],
            "textposition": "outside" if len(groups) * len(series) <= MOST_NAMED else "none",
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
        "xaxis": {"type": "category", "showgrid": False, "title": {"text": _label(x_title)}},
        "yaxis": {"title": {"text": _label(y_title)}, "rangemode": "tozero"},
        "shapes": [],
        "annotations": [],
    }
    _band_and_marks(layout, Panel("", [], marks=marks or {}), "y")
    return {"data": data, "layout": layout}


def waterfall(
    steps: Sequence[tuple[str, float]],
    y_title: str,
    floor: float | None = None,
    height: int = 400,
    told: Callable[[float], str] = number,
) -> Figure:
    """How an error falls step by step, on a logarithmic axis, so that a small step is seen beside a great one.

    The level after each step stands above it; the fall hangs from the level before.

    steps  (name, level reached, above 0); the first is where it starts, the last where it ends
    floor  level that cannot be undercut, drawn as a line
    told   a level for a reader
    """
    names = [_label(s[0]) for s in steps]
    levels = [float(s[1]) for s in steps]
    shown = [v for v in [*levels, floor or 0.0] if v > 0.0] or [1.0]
    bottom, top = 0.5 * min(shown), 2.0 * max(shown)
    base, size, colours = [], [], []
    for i, level in enumerate(levels):
        ends = i in (0, len(levels) - 1)
        low, high = (bottom, level) if ends else sorted((level, levels[i - 1]))
        base.append(max(low, bottom))
        size.append(max(high - max(low, bottom), 0.0))
        if ends:
            colours.append("@error" if i == 0 else "@measured")
        else:
            colours.append("@good" if level <= levels[i - 1] else "@bad")
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
        "yaxis": {
            "title": {"text": _label(y_title)},
            "type": "log",
            "dtick": 1,
            "range": [math.log10(bottom), math.log10(top)],
        },
        "shapes": connectors,
        "annotations": [
            {"x": i, "y": math.log10(max(b + d, bottom)), "text": told(level), "showarrow": False, "yanchor": "bottom"}
            for i, (level, b, d) in enumerate(zip(levels, base, size, strict=True))
        ],
    }
    if floor is not None:  # named where no bar stands at it
        named = "" if steps[-1][1] == floor else f"floor {number(floor)}"
        _band_and_marks(layout, Panel("", [], log=True, marks={named: floor}), "y")
    bar = {
        "type": "bar",
        "x": names,
        "y": size,
        "base": base,
        "customdata": levels,
        "marker": {"color": colours},
        "hovertemplate": "%{x}: %{customdata:.3g}<extra></extra>",
    }
    return {"data": [bar], "layout": layout}


def ranking(
    names: Sequence[str],
    values: Sequence[float],
    x_title: str,
    highlight: Sequence[str] = (),
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
    log: bool = False,
    marks: Mapping[str, float] | None = None,
) -> Figure:
    """Horizontal bars, greatest on top, for example candidate effects by probability; ``highlight`` ones stand out.

    log    a logarithmic axis
    marks  levels with their names, dashed lines
    """
    order = sorted(range(len(names)), key=lambda i: values[i])
    bar: Figure = {
        "type": "bar",
        "orientation": "h",
        "y": [_label(names[i]) for i in order],
        "x": [float(values[i]) for i in order],
        "text": [number(values[i]) for i in order],
        "textposition": "none",
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
    layout: Figure = {
        "height": 110 + 26 * max(3, len(names)),
        "bargap": 0.3,
        "showlegend": False,
        "xaxis": {"title": {"text": _label(x_title)}, "range": [0, 1.25 * top]},
        "yaxis": {"type": "category", "showgrid": False, "automargin": True},
        "shapes": [],
        "annotations": [],
    }
    levels = dict(marks or {})
    if log:
        shown = [v for v in [*values, *levels.values()] if v > 0.0] or [1.0]
        reach = [math.log10(0.6 * min(shown)), math.log10(max(shown))]
        layout["xaxis"] |= {"type": "log", "dtick": 1, "range": [reach[0], reach[1] + 0.3 * (reach[1] - reach[0])]}
    for name, level in levels.items():
        line = {"color": "@soft", "width": 1, "dash": "dot"}
        layout["shapes"].append(
            {"type": "line", "xref": "x", "yref": "paper", "x0": level, "x1": level, "y0": 0, "y1": 1, "line": line}
        )
        layout["annotations"].append(
            {
                "x": math.log10(level) if log else level, "xref": "x", "y": 1, "yref": "paper", "yanchor": "bottom",
                "text": _label(name), "showarrow": False, "font": {"size": 11, "color": "@soft"},
            }
        )  # fmt: skip
    ends = high or values
    layout["annotations"] += [  # the numbers, on a ground of their own: no line crosses them
        {
            "x": math.log10(max(ends[i], 1e-300)) if log else ends[i], "y": y, "xanchor": "left", "xshift": 2,
            "text": text, "showarrow": False, "bgcolor": "@panel", "borderpad": 1, "font": {"size": 12},
        }
        for y, i, text in zip(bar["y"], order, bar["text"], strict=True)
    ]  # fmt: skip
    return {"data": [bar], "layout": layout}


def heat(
    values: Sequence[Sequence[float | None]] | ArrayLike,
    columns: Sequence[str],
    rows: Sequence[str],
    unit: str,
    x_title: str = "",
    y_title: str = "",
    places: Sequence[Sequence[str]] | None = None,
    moments: Sequence[Sequence[float | None]] | None = None,
) -> Figure:
    """Map of a figure over two conditions (rows, columns); an empty cell was never visited.

    Colours grow from zero.

    places   the range of values of each cell, where every row has its own: it stands in the cell
    moments  s, what a click on a cell shows in the curves
    """
    z = np.array(
        [[math.nan if v is None else float(v) for v in row] for row in np.asarray(values, dtype=object)], dtype=float
    )
    text = [["" if not math.isfinite(v) else number(v, 2) for v in row] for row in z]
    if places is not None:
        text = [
            [f"{t}<br>{_label(p)}" if t else "" for t, p in zip(*row, strict=True)]
            for row in zip(text, places, strict=True)
        ]
    reach = float(np.nanmax(np.abs(z))) if np.isfinite(z).any() else 1.0
    reach = reach or 1.0
    trace: Figure = {
        "type": "heatmap",
        "z": [[None if not math.isfinite(v) else float(v) for v in row] for row in z],
        "x": [_label(c) for c in columns],
        "y": [_label(r) for r in rows],
        "colorscale": [[0, "@heat0"], [0.5, "@heat1"], [1, "@heat2"]],
        "zmin": 0.0,
        "zmax": reach,
        "xgap": 2,
        "ygap": 2,
        "showlegend": False,
        "colorbar": {"title": {"text": _label(unit), "side": "right"}, "thickness": 12, "outlinewidth": 0},
        "hovertemplate": f"%{{y}}, %{{x}}: %{{z:.3g}} {_label(unit)}<extra></extra>",
    }
    if places is not None:
        trace["hovertext"] = [[_label(p) for p in row] for row in places]
        trace["hovertemplate"] = f"%{{y}} %{{hovertext}}: %{{z:.3g}} {_label(unit)}<extra></extra>"
    if moments is not None:
        trace["customdata"] = [
            [None if v is None or not math.isfinite(v) else float(v) for v in row] for row in moments
        ]
    filled = [(i, j) for i, row in enumerate(text) for j, t in enumerate(row) if t]
    words = {  # on the cells, each readable on its own colour
        "type": "scatter",
        "mode": "text",
        "x": [trace["x"][j] for _, j in filled],
        "y": [trace["y"][i] for i, _ in filled],
        "text": [text[i][j] for i, j in filled],
        "textfont": {"size": 11, "color": [f"@{cell_role(max(0.0, float(z[i, j])) / reach)}" for i, j in filled]},
        "hoverinfo": "skip",
        "showlegend": False,
    }
    return {
        "data": [trace, words],
        "layout": {
            "meta": {"wide": places is not None},
            "height": 120 + (46 if places is not None else 38) * max(3, len(rows)),
            "xaxis": {
                "type": "category",
                "title": {"text": _label(x_title)},
                "range": [-0.5, len(columns) - 0.5],
                "showgrid": False,
            },
            "yaxis": {
                "type": "category",
                "title": {"text": _label(y_title)},
                "range": [len(rows) - 0.5, -0.5],
                "showgrid": False,
            },
        },
    }


def _label(text: object) -> str:
    """Text for the inside of a plot, where Plotly reads tags."""
    return html.escape(str(text), quote=False)


def _role(role: str) -> str:
    """Colour of a role as the page's own name for it; any other colour passes."""
    return "@" + role if role in THEMES["light"] else role


def _nth(k: int) -> str:
    """Plotly's suffix of the k-th axis: none, 2, 3, ..."""
    return "" if k == 1 else str(k)
