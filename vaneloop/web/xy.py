"""One channel of a log over another: coloured by time or by a third, with arrows along its way."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.logs import Channel
from hil.logs.formula import aligned
from vaneloop.base.holes import holes
from vaneloop.pages.series import packed
from vaneloop.web.charts import thinned

__all__ = ["TIME", "Plane", "plane", "xy_figure"]

Array = np.ndarray
TIME = "time"  # what colours a point unless a channel does
MOST = 4000  # points drawn
ARROWS = 14
STEP = 0.12  # of the plane, along which an arrow points


@dataclass(frozen=True)
class Plane:
    """Samples that lie in both channels: s, both values and what colours them; NaN in a hole. ``n``: of the log."""

    t: Array
    x: Array
    y: Array
    colour: Array
    n: int


def plane(x: Channel, y: Channel, colour: Channel | None, span: tuple[float, float] | None = None) -> Plane:
    """Both channels, and what colours them (None: the time), on one raster, thinned so that every extreme of each
    stays. span: from and to before, s.
    """
    t, (a, b, *rest) = aligned([x, y, *([colour] if colour is not None else [])])
    c = rest[0] if rest else t
    if span is not None:
        use = (t >= span[0]) & (t < span[1])
        t, a, b, c = t[use], a[use], b[use], c[use]
    there = np.isfinite(a) & np.isfinite(b) & np.isfinite(c)
    n = int(np.count_nonzero(there))
    lines = [np.where(there, v, np.nan) for v in (a, b, c)]
    if at := list(holes(t)):
        behind = np.array(at) + 1
        t, lines = np.insert(t, behind, t[at]), [np.insert(v, behind, np.nan) for v in lines]
    t, (a, b, c) = thinned(t, lines, MOST)
    return Plane(t, a, b, c, n)


def arrows(x: Array, y: Array) -> tuple[Array, Array]:
    """Pairs of points, from one to the next along the way, evenly spread; at most `ARROWS` pairs.

    The way is that of the steps of at least `STEP` of the plane: noise below it turns no arrow.
    """
    good = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    x, y = x[good], y[good]
    u, v = ((a - a.min()) / (float(np.ptp(a)) or 1.0) if a.size else a for a in (x, y))
    way = [0] if x.size else []
    for k in range(1, x.size):
        if (u[k] - u[way[-1]]) ** 2 + (v[k] - v[way[-1]]) ** 2 >= STEP**2:
            way.append(k)
    steps = len(way) - 1
    if steps < 1:
        return x[:0], y[:0]
    at = np.unique(np.linspace(0, steps - 1, min(steps, ARROWS)).round().astype(int))
    pairs = np.array(way)[np.column_stack([at, at + 1]).ravel()]
    return x[pairs], y[pairs]


def xy_figure(p: Plane, names: Sequence[str]) -> dict[str, Any]:
    """The plane as a figure of Plotly; ``names`` are the headings of x, y and colour."""
    x_name, y_name, c_name = (html.escape(n) for n in names)
    shown = np.isfinite(p.x) & np.isfinite(p.y)
    ax, ay = arrows(p.x, p.y)
    first, last = (np.flatnonzero(shown)[[0, -1]] if shown.any() else (0, 0)) if len(p.x) else (0, 0)
    points: Mapping[str, Any] = {
        "color": [round(float(v), 9) for v in p.colour[shown]], "colorscale": "Viridis", "size": 4,
        "colorbar": {"title": {"text": c_name, "side": "right"}, "thickness": 14},
    }  # fmt: skip
    data: list[dict[str, Any]] = [
        {"type": "scatter", "mode": "lines", "x": packed(p.x), "y": packed(p.y), "hoverinfo": "skip",
         "line": {"color": "@muted", "width": 1}, "showlegend": False},
        {"type": "scatter", "mode": "markers", "x": packed(p.x[shown]), "y": packed(p.y[shown]), "marker": points,
         "customdata": [round(float(v), 6) for v in p.t[shown]], "showlegend": False,
         "hovertemplate": f"%{{x:.5g}}, %{{y:.5g}}<br>{c_name}: %{{marker.color:.5g}}<br>t = %{{customdata}} s"
                          "<extra></extra>"},
        {"type": "scatter", "mode": "markers", "x": ax.tolist(), "y": ay.tolist(), "hoverinfo": "skip",
         "name": "direction",
         "marker": {"symbol": "arrow", "angleref": "previous", "size": [0, 13] * (len(ax) // 2), "color": "@error",
                    "line": {"width": 0}, "opacity": 1}},
    ]  # fmt: skip
    for name, at, symbol in (("begin", first, "circle-open"), ("end", last, "square-open")):
        if shown.any():
            data.append({
                "type": "scatter", "mode": "markers", "name": name, "x": [float(p.x[at])], "y": [float(p.y[at])],
                "hoverinfo": "skip", "marker": {"symbol": symbol, "size": 12, "color": "@text", "line": {"width": 2}},
            })  # fmt: skip
    layout = {"hovermode": "closest", "xaxis": {"title": {"text": x_name}}, "yaxis": {"title": {"text": y_name}}}
    return {"data": data, "layout": layout}
