"""The engine: rotor speed from the demand."""

from __future__ import annotations

import math

import numpy as np

from plant import chain, curve, places
from plant.curve_lanes import OWN_SPEED, alike, gives, gives_each, of_signal, site_of, tables_of
from plant.effects import CURVES, acceleration_limit_error, rotor_lag_error
from plant.engine import engine_step
from plant.parameters import ACCELERATION, DECELERATION, LAG
from plant.places import N_R
from plant.stages.blocks import NOTHING, W
from vaneloop.base.compiled import compiled_free

__all__ = ["engine_run"]

ENGINE_STEP = 2e-3  # s: the engine's explicit step is within 0.1 % of a change at this length


def engine_run(
    n_dem: np.ndarray, dt: float, p: np.ndarray, s: np.ndarray, out: np.ndarray, known: np.ndarray = NOTHING
) -> None:
    """Fill out[k, lane] with the rotor speed (%) at sample k; n_dem[k] (%) holds until sample k + 1. ``s`` is
    moved on.

    known  signals of curves (`plant.curve.take`); the speed's is the rotor's own
    """
    steps = max(1, math.ceil(dt / ENGINE_STEP - 1e-6))
    if p[CURVES].any() and alike(p).all():
        _engine_curved(np.ascontiguousarray(n_dem), dt, steps, p, s, out, known)
    elif p[CURVES].any():  # lane by lane, through the chain
        _engine_lanes(np.ascontiguousarray(n_dem), dt, steps, p, s, out, known)
    else:
        _engine_run(np.ascontiguousarray(n_dem), dt, steps, p, s, out)


@compiled_free
def _engine_lanes(
    n_dem: np.ndarray, dt: float, steps: int, p: np.ndarray, s: np.ndarray, out: np.ndarray, known: np.ndarray
) -> None:
    for j in range(p.shape[1]):
        for k in range(len(n_dem)):
            if k > 0:
                curve.take(s, p, j, known, k - 1, k - 1)
                for _ in range(steps):
                    s[curve.S_N_R, j] = s[N_R, j]
                    chain.rotor_step(s, p, j, n_dem[k - 1], dt / steps)
            out[k, j] = s[N_R, j]


@compiled_free
def _engine_run(n_dem: np.ndarray, dt: float, steps: int, p: np.ndarray, s: np.ndarray, out: np.ndarray) -> None:
    lanes = p.shape[1]
    h = dt / steps
    b = np.empty((4, W))
    for j0 in range(0, lanes, W):
        for j in range(W):
            q = min(j0 + j, lanes - 1)
            b[0, j] = s[N_R, q]
            b[1, j] = rotor_lag_error.step(p[LAG, q], p[places.ROTOR_LAG_ERROR, q])
            b[2, j] = acceleration_limit_error.step(p[ACCELERATION, q], p[places.ACCELERATION_LIMIT_ERROR, q])
            b[3, j] = p[DECELERATION, q]
        last = min(W, lanes - j0)
        for k in range(len(n_dem)):
            if k > 0:
                for _ in range(steps):
                    for j in range(W):
                        b[0, j] = engine_step(b[0, j], n_dem[k - 1], b[1, j], b[2, j], b[3, j], h)
            for j in range(last):
                out[k, j0 + j] = b[0, j]
        for j in range(last):
            s[N_R, j0 + j] = b[0, j]


@compiled_free
def _engine_curved(
    n_dem: np.ndarray, dt: float, steps: int, p: np.ndarray, s: np.ndarray, out: np.ndarray, known: np.ndarray
) -> None:
    """`_engine_run` of lanes with curves, which are alike."""
    h = dt / steps
    b = np.empty((4, W))
    bent = np.empty((3, W))  # by site
    sites = (curve.ENGINE_ADDS, curve.LAG_TIMES, curve.RISE_TIMES)
    for j0 in range(0, p.shape[1], W):
        last = min(W, p.shape[1] - j0)
        lanes = np.arange(j0, j0 + last)
        tables = tables_of(p, 0, lanes, W)
        for j in range(W):
            q = j0 + min(j, last - 1)
            b[0, j] = s[N_R, q]
            b[1, j] = rotor_lag_error.step(p[LAG, q], p[places.ROTOR_LAG_ERROR, q])
            b[2, j] = acceleration_limit_error.step(p[ACCELERATION, q], p[places.ACCELERATION_LIMIT_ERROR, q])
            b[3, j] = p[DECELERATION, q]
        for k in range(len(n_dem)):
            for _ in range(steps if k > 0 else 0):
                bent[...] = 0.0
                for c in range(len(tables)):
                    for i, site in enumerate(sites):
                        if site_of(p, 0, c) != site:
                            continue
                        if of_signal(p, 0, c, OWN_SPEED):
                            gives_each(bent[i], p, 0, c, b[0], tables)
                        else:
                            gives(bent[i], p, 0, c, known, k - 1, k - 1, tables, lanes)
                for j in range(W):
                    lag = b[1, j] * max(1.0 + bent[1, j], curve.LEAST)
                    rise = b[2, j] * max(1.0 + bent[2, j], curve.LEAST)
                    b[0, j] = engine_step(b[0, j], n_dem[k - 1] + bent[0, j], lag, rise, b[3, j], h)
            for j in range(last):
                out[k, j0 + j] = b[0, j]
        for j in range(last):
            s[N_R, j0 + j] = b[0, j]
