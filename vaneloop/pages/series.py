"""Series as a figure holds them: broken at holes, thinned to what the eye can tell apart, packed for Plotly."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vaneloop.base.holes import holes

__all__ = ["MAX_POINTS", "break_at_holes", "decimate", "distribution", "packed", "thin_path"]

Array = NDArray[np.float64]
MAX_POINTS = 4500  # points a line, three times the pixels of a wide plot; 48 kB of the file


def break_at_holes(x: Array, y: Array) -> tuple[Array, Array]:
    """Insert a NaN where the samples pause (`vaneloop.base.holes`)."""
    at = holes(x)
    if at.size == 0:
        return x, y
    return np.insert(x, at + 1, x[at] + float(np.median(np.diff(x)))), np.insert(y, at + 1, np.nan)


def distribution(values: ArrayLike) -> tuple[Array, Array]:
    """Empirical distribution as a line in steps: at each of the sorted ``values`` the share rises, between two of them
    it stays. From 0 at the least value to 1 at the greatest.
    """
    order = np.sort(np.asarray(values, dtype=float))
    shares = np.arange(order.size + 1) / max(order.size, 1)
    return np.repeat(order, 2), np.repeat(shares, 2)[1:-1]


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


def thin_path(x: Array, y: Array, limit: int = MAX_POINTS) -> tuple[Array, Array]:
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


def packed(values: ArrayLike) -> dict[str, str]:
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
