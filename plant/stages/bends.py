"""Curves in the stages: where the controller acts, on its demand and its current; and in blocks of lanes, at the
actuator.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from plant import curve
from plant.curve_lanes import CURRENT, alike, gives, gives_at, of_signal, on_curve, signal_of, site_of
from plant.effects import CURVES
from plant.layout import C_STOPS, C_TABLE, CURVE_ROWS
from plant.stages.blocks import W
from vaneloop.base.compiled import compiled_free, inlined
from vaneloop.base.curve import POINTS

__all__ = ["BENT", "bend_drive", "bend_reading", "run_bends"]

BENT = ("current_adds", "flow_times", "load_adds", "lvdt_adds", "lvdt_times")  # what curves give: numbers of a block


def run_bends(known: np.ndarray, p: np.ndarray, s: np.ndarray, site: int, out: np.ndarray) -> None:
    """Fill out[lane, k] with the sum of each lane's curves at a ``site``, SI, at the signals ``known`` of sample k."""
    if alike(p).all():
        _side_by_side(known, p, site, out)
    else:
        _lane_by_lane(known, p, s, site, out)


@compiled_free
def _lane_by_lane(known: np.ndarray, p: np.ndarray, s: np.ndarray, site: int, out: np.ndarray) -> None:
    for j in range(p.shape[1]):
        for k in range(known.shape[1]):
            curve.take(s, p, j, known, k, k)
            out[j, k] = curve.bend(s, p, j, site)


@compiled_free
def _side_by_side(known: np.ndarray, p: np.ndarray, site: int, out: np.ndarray) -> None:
    out[...] = 0.0
    n = known.shape[1]
    at, share, table = np.empty(n, np.int64), np.empty(n), np.empty(POINTS)
    for c in range(int(p[CURVES, 0])):
        if site_of(p, 0, c) != site:
            continue
        r, slips = CURVES + 1 + c * CURVE_ROWS, p[CURVES + 1 + c * CURVE_ROWS + C_STOPS, 0] != 0.0
        if not slips:
            row = signal_of(p, 0, c, len(known))
            for k in range(n):
                at[k], share[k] = on_curve(p, r, 0, known[row, k])
        for j in range(p.shape[1]):
            if slips:
                row = signal_of(p, j, c, len(known))
                for k in range(n):
                    out[j, k] += known[row, k]
                continue
            for k in range(POINTS):
                table[k] = p[r + C_TABLE + k, j]
            for k in range(n):
                a = table[at[k]]
                out[j, k] += a + share[k] * (table[at[k] + 1] - a)


@inlined
def bend_drive(
    b: Any, p: np.ndarray, q: int, known: np.ndarray, k: int, i_cmd: float, tables: np.ndarray, some: np.ndarray
) -> None:  # fmt: skip
    """Put into block ``b`` what curves of the drive give its lanes ``some`` in the step to sample ``k``, under
    ``i_cmd`` (A). ``q``: one of them that has any.
    """
    for j in range(W):
        b.current_adds[j] = b.flow_times[j] = b.load_adds[j] = 0.0
    for c in range(len(tables)):
        site = site_of(p, q, c)
        if site == curve.CURRENT_ADDS:
            _gives_in_step(b.current_adds, p, q, c, known, k, i_cmd, tables, some)
        elif site == curve.FLOW_TIMES:
            _gives_in_step(b.flow_times, p, q, c, known, k, i_cmd, tables, some)
        elif site == curve.LOAD_ADDS:
            _gives_in_step(b.load_adds, p, q, c, known, k, i_cmd, tables, some)


@inlined
def _gives_in_step(
    into: Any, p: np.ndarray, q: int, c: int, known: np.ndarray, k: int, i_cmd: float, tables: np.ndarray,
    some: np.ndarray,
) -> None:  # fmt: skip
    """What curve ``c`` gives in the step to sample ``k``: of the current, of that of this plant step."""
    if of_signal(p, q, c, CURRENT):
        gives_at(into, p, q, c, i_cmd, tables)
    else:
        gives(into, p, q, c, known, k - 1, k, tables, some)


@inlined
def bend_reading(
    b: Any, p: np.ndarray, q: int, known: np.ndarray, k: int, tables: np.ndarray, some: np.ndarray
) -> None:  # fmt: skip
    """The same of curves of the LVDT at sample ``k``."""
    for j in range(W):
        b.lvdt_adds[j] = b.lvdt_times[j] = 0.0
    for c in range(len(tables)):
        site = site_of(p, q, c)
        if site == curve.LVDT_ADDS:
            gives(b.lvdt_adds, p, q, c, known, k, k, tables, some)
        elif site == curve.LVDT_TIMES:
            gives(b.lvdt_times, p, q, c, known, k, k, tables, some)
