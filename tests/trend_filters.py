"""The trend filter in other ways than `vaneloop.design.trend` has it: filterpy's filter, the tracking index in closed
form, and the firmware's own steps.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy
from filterpy.kalman import KalmanFilter
from numpy.typing import ArrayLike

from controller import new_state
from controller.records import SCALAR_FIELDS, as_state, record
from controller.trend import trend_step
from vaneloop.base.compiled import in_place
from vaneloop.design.trend import Array, TrendDesign, TrendModel


def _filter(model: TrendModel, first: float) -> Any:
    """A filterpy KalmanFilter at rest on the demand ``first``."""
    kf = KalmanFilter(dim_x=2, dim_z=1)
    kf.F, kf.H, kf.Q, kf.R = model.matrices()
    kf.x = np.array([[first], [0.0]])
    kf.P = np.diag([model.sigma**2, 1.0])
    return kf


def filterpy_gain(model: TrendModel, steps: int = 20_000) -> tuple[float, float]:
    """(alpha, beta): the gain that filterpy's filter settles to; the steps stop when it changes by rounding only."""
    kf = _filter(model, 0.0)
    last = np.zeros((2, 1))
    for _ in range(steps):
        kf.predict()
        kf.update(0.0)
        if np.all(np.abs(kf.K - last) <= 1e-15 * np.abs(kf.K)):
            break
        last = kf.K.copy()
    return float(kf.K[0, 0]), float(kf.K[1, 0]) * model.step


def tracking_index_gain(model: TrendModel) -> tuple[float, float]:
    """(alpha, beta) in closed form, from the tracking index lambda = sigma_a T^2 / sigma_v (Kalata; Bar-Shalom
    6.5.3).
    """
    index = model.acceleration * model.step**2 / model.sigma
    r = (4.0 + index - math.sqrt(8.0 * index + index * index)) / 4.0
    alpha = 1.0 - r * r
    return alpha, 2.0 * (2.0 - alpha) - 4.0 * math.sqrt(1.0 - alpha)


def filterpy_estimates(
    model: TrendModel, n_dem: ArrayLike, gain: tuple[float, float] | None = None
) -> tuple[Array, Array]:
    """Demand and rate (%, %/s) as filterpy's filter estimates them, started in its steady state, at rest on the first
    sample.
    """
    y = np.asarray(n_dem, dtype=float)
    kf = _filter(model, float(y[0]))
    f, h, q, r = model.matrices()
    p = scipy.linalg.solve_discrete_are(f.T, h.T, q, r)
    k = p @ h.T / (h @ p @ h.T + r)
    kf.P = (np.eye(2) - k @ h) @ p  # after an update
    out = np.empty((2, y.size))
    for i, v in enumerate(y):
        kf.predict()
        kf.update(v)
        out[:, i] = kf.x[:, 0]
    return out[0], out[1]


def firmware_estimates(n_dem: ArrayLike, design: TrendDesign) -> tuple[Array, Array, Array]:
    """Demand, rate (%, %/s) and direction (+1, -1) as the firmware's `trend_step` finds them; one sample every
    10 ms.
    """
    y = np.asarray(n_dem, dtype=float)
    z, k = as_state(new_state()), record(SCALAR_FIELDS)
    k.trend_alpha, k.trend_beta = design.alpha, design.beta
    k.trend_rate_on, k.trend_change, k.trend_hold = design.rate_on, design.change, design.hold
    z.trend_n = z.trend_turn = z.trend_last = y[0]
    z.direction = 1.0
    out = np.empty((3, y.size))
    _followed(z, k, y, out)
    return out[0], out[1], out[2]


@in_place
def _followed(z: Any, k: Any, y: Array, out: Array) -> None:
    for i in range(len(y)):
        trend_step(z, k, y[i])
        out[0, i], out[1, i], out[2, i] = z.trend_n, z.trend_rate, z.direction
