"""Figures of a law of two quantities: its map with the places where the logs have been, and cross sections."""

from __future__ import annotations

import numpy as np

from vaneloop.base.signals import heading
from vaneloop.identification.unmodelled.learned_law import LearnedSurface
from vaneloop.pages.figures import Figure, Line, loop
from vaneloop.pages.series import packed
from vaneloop.pages.style import number

__all__ = ["BEYOND", "map_figure", "sections_figure"]

BEYOND = (
    "Hatched or dashed: no log has been at both values at once, and the surface stays as at the nearest place where "
    "one has."
)
SECTIONS = (0.1, 0.3, 0.5, 0.7, 0.9)  # quantiles of the second quantity at which it is cut
ROLES = ("other", "measured", "model", "target", "error")
EACH, HATCH = 2, 3  # of the surface's points each way, every so many-th is drawn; has a stroke of the hatching


def map_figure(law: LearnedSurface) -> Figure:
    """The surface over both quantities, and a dot for each place where the logs have been."""
    x, across, values = law.x[::EACH], law.across[::EACH], law.values[::EACH, ::EACH]
    reach = float(np.abs(values).max()) or 1.0
    surface = {
        "type": "heatmap", "name": "learned", "x": x.tolist(), "y": across.tolist(), "z": values.T.tolist(),
        "colorscale": [[0, "@measured"], [0.5, "@heat0"], [1, "@model"]], "zmin": -reach, "zmax": reach,
        "colorbar": {"title": {"text": heading(law.name, law.unit), "side": "right"}, "thickness": 12,
                     "outlinewidth": 0},
        "hovertemplate": "%{x:.4g}, %{y:.4g}: %{z:.4g}<extra></extra>", "showlegend": False,
    }  # fmt: skip
    i, j = np.nonzero(~law.within[::HATCH, ::HATCH])
    hatch = {
        "type": "scatter", "mode": "markers", "name": "beyond the logs", "x": packed(law.x[::HATCH][i]),
        "y": packed(law.across[::HATCH][j]), "hoverinfo": "skip",
        "marker": {"symbol": "line-ne-open", "size": 10, "color": "@text", "opacity": 0.5, "line": {"width": 1}},
    }  # fmt: skip
    been = {
        "type": "scatter", "mode": "markers", "name": "the logs", "x": packed(law.samples[0]),
        "y": packed(law.samples[1]), "hoverinfo": "skip", "marker": {"size": 3, "color": "@text", "opacity": 0.5},
    }  # fmt: skip
    axes = zip((law.of, law.second), (law.of_unit, law.second_unit), (law.x, law.across), strict=True)
    one, other = ({"title": {"text": heading(q, unit)}, "range": [v[0], v[-1]]} for q, unit, v in axes)
    return {"data": [surface, hatch, been], "layout": {"height": 480, "xaxis": one, "yaxis": other}}


def sections_figure(law: LearnedSurface) -> Figure:
    """The surface over its first quantity at some values of the second; in the middle with its band."""
    lines = [
        Line("from", law.x, law.low, "other", 1.0),
        Line(f"90 % band, {law.second} {number(law.middle)}", law.x, law.high, "other", 1.0),
    ]
    for share, role in zip(SECTIONS, ROLES, strict=True):
        at = law.middle if share == 0.5 else float(np.quantile(law.samples[1], share))
        k = int(np.argmin(np.abs(law.across - at)))
        y, been = law.values[:, k], law.within[:, k]
        beyond = ~been | ~np.roll(been, 1) | ~np.roll(been, -1)
        unit = law.second_unit.strip("-")
        name = f"{law.second} {number(float(law.across[k]))} {unit}".strip()
        lines.append(Line(name, law.x, np.where(been, y, np.nan), role, 2.0 if share == 0.5 else 1.4))
        lines.append(Line(f"{name}, beyond", law.x, np.where(beyond, y, np.nan), role, 1.2, "dash"))
    out = loop(lines, heading(law.of, law.of_unit), heading(law.name, law.unit))
    out["data"][1] |= {"fill": "tonexty", "fillcolor": "@noise"}
    for line in (out["data"][0], *out["data"][3::2]):  # named by the other of their pair
        line["showlegend"] = False
    return out
