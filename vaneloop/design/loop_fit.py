"""Robust fit of one stage's loop: which samples lie on which branch, and the centre, gap, drift and lag that they show.

`fit_with_width` is the way in; `vaneloop.design.measured_loop` makes the two curves of what it finds. Strokes in mm,
angles in deg at the ring, scaled to the vane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from hil.logs import LogError
from vaneloop.base.compiled import compiled

__all__ = ["LoopFit", "fit_with_width"]

Array = NDArray[np.float64]
LEAST_OVERLAP = 1.0  # mm of stroke that both branches must have in common
KNOT = 2.0  # mm between the knots of a measured curve: finer than the linkage bends, coarser than scatter
MAX_SAMPLES = 6_000  # samples that enter a fit; longer logs are averaged in groups


@compiled
def _branches(x: Array, width: float, tolerance: float) -> NDArray[np.int8]:
    """Branch of each sample of the stroke x: 1 where a play of ``width`` is surely driven in extension, -1 in
    retraction, 0 else.

    Two plays of that width start at either end of their gap; where both say the same the unknown start is forgotten. A
    play of a wider gap is in contact only where every narrower one is (nested contact sets), so a width above the
    machine's own gives no wrong sample.
    """
    half = 0.5 * width
    a, b = x[0] - half, x[0] + half
    out = np.zeros(x.size, np.int8)
    for i in range(x.size):
        a = min(max(a, x[i] - half), x[i] + half)
        b = min(max(b, x[i] - half), x[i] + half)
        if b - a < tolerance:
            if x[i] - b >= half - tolerance:
                out[i] = 1
            elif a - x[i] >= half - tolerance:
                out[i] = -1
    return out


@dataclass(frozen=True)
class LoopFit:
    """Result of the robust fit of one stage: knots of centre and gap (deg, ring scaled to the vane)."""

    knots: Array
    centre: Array
    gap: Array
    gap_sigma: float
    noise: float
    drift: float | None
    lag: float
    branch: NDArray[np.int8]
    covered: dict[int, tuple[float, float]]

    @property
    def low(self) -> float:
        return min(self.covered[1][0], self.covered[-1][0])

    @property
    def high(self) -> float:
        return max(self.covered[1][1], self.covered[-1][1])

    def on(self, x: Array) -> tuple[Array, Array]:
        return np.interp(x, self.knots, self.centre), np.maximum(np.interp(x, self.knots, self.gap), 0.0)


def fit_with_width(
    t: Array,
    x: Array,
    r: Array,
    s: Array,
    v: Array,
    travel: float,
    tolerance: float,
    lag: tuple[float, float],
    stage: str,
    source: str,
) -> LoopFit:
    """Find the play width that tells the samples apart: wide first, then 1.25 times the gap that the fit shows."""
    width = 0.0
    for share in (0.4, 0.25, 0.15, 0.08, 0.04):
        width = max(share * travel, 3.0 * tolerance)
        missing = _missing(_branches(x, width, tolerance), x)
        if missing is None:
            break
    else:
        raise _one_branch(x, missing or "", width, stage, source)
    least = float(np.quantile(s, 0.02))
    fit, used = None, 0.0
    for _ in range(8):
        branch = _branches(x, width, tolerance)
        missing = _missing(branch, x)
        if missing is not None:
            if fit is not None and width > used:
                raise _one_branch(x, missing, width, stage, source)
            break
        fit, used = _fit(t, x, r, s, v, branch, lag), width
        wanted = max(1.25 * float(np.max(fit.gap)) / least + 2.0 * tolerance, 4.0 * tolerance)
        if abs(wanted - width) < 0.03 * width:
            break
        width = wanted
    assert fit is not None
    return fit


def _missing(branch: NDArray[np.int8], x: Array) -> str | None:
    """Name of the branch that is missing or too short, None where both are there and overlap."""
    for side, name in ((1, "extension"), (-1, "retraction")):
        on = branch == side
        if on.sum() < 10 or np.ptp(x[on]) < 0.5 * LEAST_OVERLAP:
            return name
    up, down = x[branch == 1], x[branch == -1]
    return None if min(up.max(), down.max()) - max(up.min(), down.min()) >= LEAST_OVERLAP else "overlap"


def _one_branch(x: Array, missing: str, width: float, stage: str, source: str) -> LogError:
    rise = float(np.max(x - np.minimum.accumulate(x)))
    fall = float(np.max(np.maximum.accumulate(x) - x))
    if missing == "overlap":
        return LogError(
            f"{source}: {stage}: the two branches of the loop do not overlap by {LEAST_OVERLAP:g} mm of stroke "
            f"(x_lvdt rises by {rise:.3g} mm and falls by {fall:.3g} mm at a stretch); a loop goes there and back"
        )
    other, had, got = ("retraction", rise, fall) if missing == "retraction" else ("extension", fall, rise)
    return LogError(
        f"{source}: {stage}: the loop has one branch only, {missing} is missing: x_lvdt from {x.min():.4g} to "
        f"{x.max():.4g} mm moves {'back' if other == 'retraction' else 'forward'} by {got:.3g} mm at most ({had:.3g} "
        f"mm the other way); more than {max(width, LEAST_OVERLAP) + LEAST_OVERLAP:.3g} mm is needed to cross the gap "
        "and measure"
    )


def _hats(at: Array, knots: Array) -> Array:
    """Piecewise-linear basis: row of weights of each knot, held beyond the ends."""
    i = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, knots.size - 2)
    f = np.clip((at - knots[i]) / (knots[i + 1] - knots[i]), 0.0, 1.0)
    out = np.zeros((at.size, knots.size))
    rows = np.arange(at.size)
    out[rows, i] = 1.0 - f
    out[rows, i + 1] += f
    return out


def _fit(
    t: Array, x: Array, r: Array, s: Array, v: Array, branch: NDArray[np.int8], lag: tuple[float, float]
) -> LoopFit:
    """One robust (Huber) regularised least-squares fit of centre, gap, drift and lag to the samples on the branches."""
    on = np.flatnonzero(branch != 0)
    loops = _loop_times(t[on], x[on], branch[on])
    d = branch[on].astype(float)
    ton, xon, ron, son, von = t[on], x[on], r[on], s[on], v[on]
    if on.size > MAX_SAMPLES:  # groups of neighbours on one branch
        size = -(-on.size // MAX_SAMPLES)
        n = on.size // size * size
        group = [a[:n].reshape(-1, size) for a in (ton, xon, ron, son, von, d)]
        same = (np.abs(group[5].mean(axis=1)) == 1.0) & (
            np.ptp(group[0], axis=1) < 5.0 * size * float(np.median(np.diff(ton)))
        )
        ton, xon, son, von, d = (a[same].mean(axis=1) for a in (*group[:2], *group[3:]))
        ron = np.median(group[2][same], axis=1)
    covered = {side: (float(xon[d == side].min()), float(xon[d == side].max())) for side in (1, -1)}
    knots = np.linspace(xon.min(), xon.max(), max(3, int(round(np.ptp(xon) / KNOT)) + 1))
    m = knots.size
    hats = _hats(xon, knots)
    parts = [hats, -0.5 * d[:, None] * hats, -(son * von)[:, None]]
    prior: list[tuple[Array, float, float]] = []  # row, value, sigma

    def row(*entries: tuple[int, float]) -> Array:
        a = np.zeros(2 * m + 1 + n_drift)
        for i, value in entries:
            a[i] = value
        return a

    n_drift = 0
    if loops.size > 2:  # one knot a loop: more could follow the passes, and would take the curve's slope for drift
        n_drift = loops.size
        parts.append(
            scipy.interpolate.CubicSpline(loops, np.eye(n_drift), bc_type="natural")(np.clip(ton, loops[0], loops[-1]))
        )
    for i in range(1, m - 1):
        prior.append((row((i - 1, 1.0), (i, -2.0), (i + 1, 1.0)), 0.0, 0.03))
        prior.append((row((m + i - 1, 1.0), (m + i, -2.0), (m + i + 1, 1.0)), 0.0, 0.03))
    for i in range(m - 1):
        prior.append((row((m + i, -1.0), (m + i + 1, 1.0)), 0.0, 0.03))
    prior.append((row((2 * m, 1.0)), lag[0], lag[1]))
    for i in range(n_drift - 1):
        prior.append((row((2 * m + 1 + i, -1.0), (2 * m + 2 + i, 1.0)), 0.0, 0.3))
    if n_drift:  # the curves stand for the log's mean
        prior.append((np.concatenate([np.zeros(2 * m + 1), parts[-1].mean(axis=0)]), 0.0, 1e-4))
    design = np.hstack(parts)
    p_rows = np.array([p[0] / p[2] for p in prior])
    p_values = np.array([p[1] / p[2] for p in prior])
    weight, sigma = np.ones(ron.size), 0.05
    theta = np.zeros(design.shape[1])
    normal = np.eye(design.shape[1])
    for _ in range(12):
        w = weight / (sigma * sigma)
        normal = design.T @ (design * w[:, None]) + p_rows.T @ p_rows
        new = np.linalg.solve(normal, design.T @ (w * ron) + p_rows.T @ p_values)
        e = ron - design @ new
        sigma = max(1.4826 * float(np.median(np.abs(e))), 1e-4)
        weight = np.minimum(1.0, 1.5 * sigma / np.maximum(np.abs(e), 1e-12))
        moved = float(np.max(np.abs(new - theta)))
        theta = new
        if moved < 1e-6:
            break
    mean_gap = np.zeros(design.shape[1])
    mean_gap[m : 2 * m] = 1.0 / m
    gap_sigma = float(np.sqrt(mean_gap @ np.linalg.solve(normal, mean_gap)))
    drift = float(np.ptp(parts[-1] @ theta[2 * m + 1 :])) if n_drift else None
    return LoopFit(knots, theta[:m], theta[m : 2 * m], gap_sigma, sigma, drift, float(theta[2 * m]), branch, covered)


def _loop_times(t: Array, x: Array, branch: NDArray[np.int8]) -> Array:
    """Times at which the loops begin, and the end: passes along a branch over a third of the log's stroke, two a loop;
    16 at most.
    """
    need = np.ptp(x) / 3.0
    edges = np.concatenate([[0], np.flatnonzero(np.diff(branch)) + 1, [branch.size]])
    starts = [t[a] for a, b in zip(edges[:-1], edges[1:], strict=True) if np.ptp(x[a:b]) >= need]
    if len(starts) < 4:
        return np.empty(0)
    times = np.unique([t[0], *starts[2 : len(starts) // 2 * 2 : 2], t[-1]])
    return times[:: -(-times.size // 16)] if times.size > 17 else times
