"""Curves and figures of the pages: long time curves thinned on the server for the view that is asked for, small figures
from Plotly.

A view of n pixels gets about two points a pixel and line: the greatest and least of each stretch, chosen by
tsdownsample's MinMax, so that no spike is lost at any zoom. The browser draws them with uPlot (chart.js).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from nicegui.element import Element
from nicegui.elements import plotly as bundled
from tsdownsample import MinMaxDownsampler

from controller import MODES
from vaneloop.base.signals import heading
from vaneloop.base.vanes import VANES
from vaneloop.pages.figures import UNDER
from vaneloop.pages.series import break_at_holes
from vaneloop.pages.style import THEMES

__all__ = [
    "OVER", "Band", "Chart", "Curves", "Figure", "Mark", "Over", "Panel", "Trace", "bands", "figure", "mode_bands",
    "of_log", "of_stage", "painted", "thinned", "view",
]  # fmt: skip

Array = np.ndarray
MOST_BANDS = 400
NEAR, NEAR_SAMPLES = 2.0, 20  # s, and samples, to each side of a moment that is shown
MODE_ROLES = {"DEGRADED": "model", "FAIL_SAFE": "bad"}  # modes that are drawn as bands
MOST_POINTS = 4000  # a line and view, whatever the browser asks for


@dataclass(frozen=True)
class Trace:
    """One line of a panel; its colour by role (`vaneloop.pages.style.THEMES`). dash: pixels drawn, pixels left out."""

    name: str
    y: Array
    role: str = "measured"
    width: float = 1.25
    dash: tuple[int, ...] = ()


@dataclass(frozen=True)
class Panel:
    """Lines over one time axis ``t`` (s, increasing). band: half-width of a grey band about zero. least: smallest
    height of the y axis. group: under which the list of channels has it.
    """

    title: str
    unit: str
    t: Array
    traces: Sequence[Trace]
    band: float | None = None
    height: int = 110
    least: float = 0.0
    group: str = ""


@dataclass(frozen=True)
class Mark:
    """A moment with a name: a fault that was injected."""

    t: float
    text: str


@dataclass(frozen=True)
class Band:
    """A stretch of time with a name: a mode, a fault; its colour by role."""

    start: float
    end: float
    text: str
    role: str


@dataclass
class Curves:
    """What a chart shows. ``key`` changes where the old view makes no sense any more."""

    panels: Sequence[Panel] = field(default_factory=list)
    key: str = ""
    marks: Sequence[Mark] = field(default_factory=list)
    bands: Sequence[Band] = field(default_factory=list)


def bands(t: Array, values: Array, names: Mapping[int, tuple[str, str]]) -> list[Band]:
    """Stretches in which a signal has one of these values: value -> name, role ("": not drawn)."""
    if not len(t):
        return []
    v = np.where(np.isfinite(values), values, -1.0).astype(np.int64)
    at = np.flatnonzero(np.diff(v, prepend=v[0] - 1))
    ends = [*at[1:], len(v) - 1]
    return [
        Band(float(t[i]), float(t[j]), *names[int(v[i])])
        for i, j in zip(at, ends, strict=True)
        if names.get(int(v[i]), ("", ""))[1]
    ][:MOST_BANDS]


def mode_bands(t: Array, state: Array) -> list[Band]:
    """Stretches in which the controller is in a mode that is drawn."""
    return bands(t, state, {k: (m, MODE_ROLES.get(m, "")) for k, m in enumerate(MODES)})


def view(curves: Curves, start: float | None, end: float | None, pixels: int) -> bytes:
    """Answer a chart's question: head (JSON, its length before it), then x and lines of every panel as float64."""
    n_out = int(np.clip(2 * pixels, 200, MOST_POINTS))
    heads: list[dict[str, Any]] = []
    body: list[bytes] = []
    low, high = np.inf, -np.inf
    for p in curves.panels:
        if len(p.t):
            low, high = min(low, float(p.t[0])), max(high, float(p.t[-1]))
        i = 0 if start is None else max(0, int(np.searchsorted(p.t, start)) - 1)
        j = len(p.t) if end is None else min(len(p.t), int(np.searchsorted(p.t, end)) + 1)
        x, lines = thinned(p.t[i:j], [t.y[i:j] for t in p.traces], n_out)
        names = [{"name": t.name, "role": t.role, "width": t.width, "dash": t.dash} for t in p.traces]
        heads.append(
            {
                "title": p.title,
                "unit": p.unit,
                "band": p.band,
                "height": p.height,
                "least": p.least,
                "group": p.group,
                "n": len(x),
                "lines": names,
            }
        )
        body += [np.ascontiguousarray(a, dtype="<f8").tobytes() for a in (x, *lines)]
    span = [low, high if high > low else low + 1.0] if np.isfinite(low) else [0.0, 1.0]
    steps = [float(np.median(np.diff(p.t))) for p in curves.panels if len(p.t) > 1]
    more: dict[str, Any] = {"near": max([NEAR, *(NEAR_SAMPLES * s for s in steps)])}
    more |= {"marks": [[m.t, m.text] for m in curves.marks]}
    more |= {"bands": [[b.start, b.end, b.text, b.role] for b in curves.bands]}
    head = json.dumps({"panels": heads, "span": span, "key": curves.key, **more}).encode()
    return struct.pack("<I", len(head)) + head + bytes(-(4 + len(head)) % 8) + b"".join(body)


def thinned(t: Array, lines: Sequence[Array], n_out: int) -> tuple[Array, list[Array]]:
    """Points of all lines at the times that any of them needs."""
    if len(t) > n_out:
        t = np.ascontiguousarray(t)
        share = max(100, n_out // max(1, len(lines))) // 2 * 2
        keep = [MinMaxDownsampler().downsample(t, _whole(y), n_out=share) for y in lines]
        pick = np.unique(np.concatenate(keep).astype(np.int64))
        t, lines = t[pick], [y[pick] for y in lines]
    return t, list(lines)


def _whole(y: Array) -> Array:
    """Values without NaN, for choosing points: a hole holds the value before it."""
    bad = ~np.isfinite(y)
    if not bad.any():
        return np.ascontiguousarray(y, dtype=np.float64)
    last = np.maximum.accumulate(np.where(bad, -1, np.arange(len(y))))
    return np.where(last >= 0, np.asarray(y, dtype=np.float64)[np.maximum(last, 0)], 0.0)


Channels = Mapping[str, tuple[str, Array, Array]]  # name -> unit, s, values
GROUPS = {
    "speed": ("n_dem", "n_r"), "actuator": ("x_dem", "x_lvdt", "i_cmd"), "vanes": VANES, "supply": ("p_s", "t_oil"),
    "controller": ("state",),
}  # fmt: skip
GROUP_OF = {signal: group for group, signals in GROUPS.items() for signal in signals}
# of the logs laid over: colour by role, and dashes, so that they differ without colour, too
OVER = (("model", (7, 3)), ("target", (2, 3)), ("error", (9, 3, 2, 3)), ("other", (12, 4)))


@dataclass(frozen=True)
class Over:
    """Channels of another log, laid over this one ``later`` (s)."""

    name: str
    channels: Channels
    later: float = 0.0


def of_log(
    channels: Channels, key: str, over: Sequence[Over] = (), marks: Sequence[Mark] = (), spans: Sequence[Band] = (),
    modes: bool = True, made: Collection[str] = (),
) -> Curves:  # fmt: skip
    """All channels of a log, one below the other, holes open; those of other logs at the first one's samples.

    made   names of those that formulas make

    modes  ``state`` is the controller's mode: stretches in a mode other than RUN are drawn
    """
    panels = []
    for name, (unit, t, values) in channels.items():
        x, y = break_at_holes(t, values)
        lines = [Trace("this log" if over else name, np.asarray(y), "measured")]
        for other, (role, dash) in zip(over, OVER, strict=False):
            if name in other.channels:
                _, t2, v2 = other.channels[name]
                there = np.interp(np.asarray(x), np.asarray(t2) + other.later, v2, np.nan, np.nan)
                lines.append(Trace(other.name, there, role, dash=dash))
        group = "formulas" if name in made else GROUP_OF.get(name, "")
        panels.append(Panel(heading(name, unit), unit, np.asarray(x), lines, height=74, group=group))
    if modes and "state" in channels:
        _, t, values = channels["state"]
        spans = [*mode_bands(np.asarray(t), np.asarray(values)), *spans]
    return Curves(panels, key, marks, spans)


STAGE_ROLES = {"nominal model": "error", "with effects": "model", "by hand": "target"}


def of_stage(curves: Mapping[str, Any], by_hand: Mapping[str, Any] | None, key: str) -> Curves:
    """Outputs of a stage, measured and as models have them, and below each its errors; ``by_hand``: those of a model
    whose parameters are set by hand.
    """
    t, panels = curves["t"], []
    for output, c in curves["outputs"].items():
        measured, unit = c["measured"], c["unit"]
        errors = dict(c["errors"]) | (by_hand["outputs"][output]["errors"] if by_hand is not None else {})
        over = [Trace(n, measured - e, STAGE_ROLES[n]) for n, e in errors.items()]
        left = [Trace(n, e, STAGE_ROLES[n]) for n, e in errors.items()]
        panels.append(
            Panel(heading(output, unit), unit, t, [Trace("measured", measured, "measured", UNDER), *over], height=150)
        )
        panels.append(Panel(heading("error", unit), unit, t, left, band=3.0 * c["floor"], height=150))
    return Curves(panels, key)


class Chart(Element, component="chart.js", esm={"uplot": "uplot"}):
    """Time curves in the browser; ``source`` names the curves at the server (`/curves/SOURCE`)."""

    def __init__(
        self, source: str, live: float = 0.0, tree: bool = False,
        cursors: tuple[float | None, float | None] = (None, None),
    ):  # fmt: skip
        """``live``: questions a second of a chart whose curves move on by themselves; ``tree``: channels are found by
        name, and there are two ``cursors`` (s), of which the event "cursors" tells.
        """
        super().__init__()
        self._props["src"] = f"/curves/{source}"
        self._props["version"] = 0
        self._props["live"] = live
        self._props["tree"] = tree
        self._props["cursors"] = list(cursors)

    def refetch(self) -> None:
        """Tell the browser that the curves have changed."""
        self._props["version"] += 1
        self.update()


class Figure(Element, component="figure.js"):
    """A figure in Plotly's JSON, drawn by the Plotly that NiceGUI bundles."""

    needs = bundled.Plotly  # puts "nicegui-plotly" among the page's modules

    def __init__(self, options: dict[str, Any]):
        super().__init__()
        self._props["options"] = options
        self.classes("w-full")


# ---- small figures ---------------------------------------------------------------------------------------------------


def painted(x: Any, theme: Mapping[str, str]) -> Any:
    """``@role`` of vaneloop.pages.figures as this theme's colour."""
    if isinstance(x, str) and x.startswith("@"):
        role, _, alpha = x[1:].partition("/")
        if role not in theme:
            return x
        return theme[role] + (f"{round(255 * float(alpha)):02x}" if alpha else "")
    if isinstance(x, list | tuple):
        return [painted(v, theme) for v in x]
    if isinstance(x, dict):
        return x if "bdata" in x else {k: painted(v, theme) for k, v in x.items()}
    return x


def figure(f: dict[str, Any], dark: bool, height: int | None = None) -> Figure:
    """Show a figure of vaneloop.pages.figures in the page's theme."""
    c = THEMES["dark" if dark else "light"]
    axis = {
        "gridcolor": c["grid"],
        "linecolor": c["muted"],
        "zerolinecolor": c["muted"],
        "tickcolor": c["muted"],
        "automargin": True,
    }
    layout = painted(f["layout"], c)
    for key in [k for k in layout if k.startswith(("xaxis", "yaxis"))]:
        layout[key] = {**axis, **layout[key]}
        layout[key]["title"] = {"font": {"size": 12}, **layout[key].get("title", {})}  # whole on a phone
    layout |= {
        "font": {"family": "system-ui, sans-serif", "size": 12.5, "color": c["text"]},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 60, "r": 24, "t": 26, "b": 42},
        "autosize": True,
        "legend": {
            "orientation": "h",
            "itemsizing": "constant",
            "x": 0,
            "xanchor": "left",
            "y": 1.02,
            "yanchor": "bottom",
        },
        "hoverlabel": {"bgcolor": c["panel"], "bordercolor": c["muted"], "font": {"color": c["text"]}},
        "colorway": [c["measured"], c["model"], c["target"], c["error"], c["other"]],
    }
    if height is not None:
        layout["height"] = height
    config = {"displayModeBar": False, "displaylogo": False, "plotlyServerURL": ""}
    return Figure({"data": painted(f["data"], c), "layout": layout, "config": config})
