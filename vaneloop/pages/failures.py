"""Where a stage fails: the map of its error under each condition, light enough for whoever only draws it."""

from __future__ import annotations

from collections.abc import Sequence

from vaneloop.base.signals import heading
from vaneloop.identification.regimes import Regime
from vaneloop.pages.figures import Figure, heat

__all__ = ["failure_map", "worst_cell"]

MOST_CONDITIONS = 9  # rows of a failure map
FEWEST = 20  # samples; a cell with no more stays empty


def failure_map(regimes: Sequence[Regime]) -> Figure:
    """Error in noise floors under each condition: every cell has its range of values, and the moment it is worst at.

    ``layout.meta.worst`` is the moment (s) of the worst cell.
    """
    regimes = regimes[:MOST_CONDITIONS]
    width = max(len(r.ratio) for r in regimes)
    cells: list[list[float | None]] = []
    places, moments = [], []
    for r in regimes:
        empty = width - len(r.ratio)
        cells.append(
            [float(v) if n > FEWEST else None for v, n in zip(r.ratio, r.samples, strict=True)] + [None] * empty
        )
        places.append([_range(r, b) for b in range(len(r.ratio))] + [""] * empty)
        moments.append([*(float(v) for v in r.moments), *[None] * empty])
    names = [heading(r.condition, r.condition_unit) for r in regimes]
    columns = [f"eighth {i + 1}" for i in range(width)]
    figure = heat(cells, columns, names, "noise floors", "an eighth of the samples each, lowest values to highest", "",
                  places=places, moments=moments)  # fmt: skip
    k, b = worst_cell(regimes)
    figure["layout"]["meta"] |= {"worst": moments[k][b]}
    return figure


def worst_cell(regimes: Sequence[Regime]) -> tuple[int, int]:
    """Condition and bin with the greatest error in noise floors among those that a map shows."""
    filled = [
        (float(v), k, b)
        for k, r in enumerate(regimes[:MOST_CONDITIONS])
        for b, (v, n) in enumerate(zip(r.ratio, r.samples, strict=True))
        if n > FEWEST
    ]
    _, k, b = max(filled, key=lambda cell: cell[0])
    return k, b


def _range(r: Regime, b: int) -> str:
    """The values of a bin, short enough for a cell."""
    if r.condition == "direction":
        return r.place(b).partition(" ")[2]
    return f"{_short(r.edges[b])} … {_short(r.edges[b + 1])}"


def _short(v: float) -> str:
    """Three digits, those before the point all."""
    return f"{v:.0f}" if 1e3 <= abs(v) < 1e6 else f"{v:.3g}"
