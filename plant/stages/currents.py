"""The current in every step of the actuator, from the currents of a log."""

from __future__ import annotations

import numpy as np

from plant import chain
from vaneloop.base.compiled import compiled_free

__all__ = ["step_currents"]


def step_currents(i_cmd: np.ndarray, dt: float, substeps: int, behind: float = chain.TICK) -> np.ndarray:
    """Return the current (A) of every step of `actuator_run`, float64[n, substeps]: [k, m] in step m after sample k -
    1.

    i_cmd     [k]: mean current (A) of the ticks after sample k - 1, up to and with the one at sample k, as VGV_SERVO
              carries it; or [k, m]: the current in each of the equal parts of that time
    behind    s: how much later than logged the current acts; that of the tick at sample k drives the next millisecond

    No step leads to sample 0: its row is the mean, under which the valve rests there.
    """
    if i_cmd.ndim == 1:
        out = _currents(np.ascontiguousarray(i_cmd), dt, substeps, behind)
    else:
        out = _late(i_cmd, dt, substeps, behind)
    out[0] = np.mean(i_cmd[0])
    return out


@compiled_free
def _currents(mean: np.ndarray, dt: float, substeps: int, behind: float) -> np.ndarray:
    """Currents (n, substeps) between the samples, from the logged means: linear in each interval, of its mean, its
    slope the neighbours'.

    Interval k begins ``behind`` after sample k - 1; a step that begins in the interval before takes its share of both.
    """
    n = len(mean)
    out = np.empty((n, substeps))
    h = 1.0 / substeps
    slope_before, before = 0.0, mean[0]
    for k in range(n):
        slope = 0.5 * (mean[k + 1] - mean[k - 1]) if 0 < k < n - 1 else 0.0  # per interval
        for m in range(substeps):
            begin = m * h - behind / dt
            old = min(max(-begin, 0.0), h)  # length in the interval before
            in_old = before + slope_before * (begin + 0.5 * old + 0.5)
            in_own = mean[k] + slope * (begin + 0.5 * (h + old) - 0.5)
            share = old / h
            out[k, m] = share * in_old + (1.0 - share) * in_own
        slope_before, before = slope, mean[k]
    return out


@compiled_free
def _late(parts: np.ndarray, dt: float, substeps: int, behind: float) -> np.ndarray:
    """Currents (n, substeps) between the samples, from those of equal ``parts`` of the time between them that act
    ``behind`` later: the mean over each step.
    """
    n, many = parts.shape
    out = np.empty((n, substeps))
    length = many / substeps  # of a step, in parts; nothing flows before the first
    for k in range(n):
        for m in range(substeps):
            begin = max((k * substeps + m) * length - behind / dt * many, 0.0)
            end = max((k * substeps + m + 1) * length - behind / dt * many, 0.0)
            charge = 0.0
            for i in range(int(begin), min(int(end) + 1, n * many)):
                charge += (min(end, i + 1.0) - max(begin, float(i))) * parts[i // many, i % many]
            out[k, m] = charge / length
    return out
