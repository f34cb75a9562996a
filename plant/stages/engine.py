"""The engine: rotor speed from the demand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from plant import chain, curve, engine, lanes
from plant.curve_lanes import OWN_SPEED, alike, gives, gives_each, of_signal, site_of, tables_of
from plant.effects import CURVES
from plant.places import N_R
from plant.stages.blocks import NOTHING, W
from vaneloop.base.compiled import compiled_free, inlined

__all__ = ["engine_run"]

_SITES = (curve.ENGINE_ADDS, curve.LAG_TIMES, curve.RISE_TIMES)  # where a curve may act here
_BLOCK = lanes.block(W, engine.Engine, more=("n_r",))
_engine, _put_engine = lanes.getter(engine.Engine), lanes.putter(engine.Engine)
ENGINE_STEP = 2e-3  # s: the engine's explicit step is within 0.1 % of a change at this length


def engine_run(
    n_dem: np.ndarray, dt: float, p: np.ndarray, s: np.ndarray, out: np.ndarray, known: np.ndarray = NOTHING
) -> None:
    """Fill out[k, lane] with the rotor speed (%) at sample k; n_dem[k] (%) holds until sample k + 1. ``s`` is
    moved on.

    known  signals of curves (`plant.curve.take`); the speed's is the rotor's own
    """
    steps = max(1, math.ceil(dt / ENGINE_STEP - 1e-6))
    if p[CURVES].any() and not alike(p).all():  # lane by lane, through the chain
        _engine_lanes(np.ascontiguousarray(n_dem), dt, steps, p, s, out, known)
    else:
        _engine_run(np.ascontiguousarray(n_dem), dt, steps, p, s, out, known, np.empty(1, _BLOCK))


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
def _engine_run(
    n_dem: np.ndarray,
    dt: float,
    steps: int,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    known: np.ndarray,
    block: np.ndarray,
) -> None:
    """Lanes side by side: none has curves, or all have, and theirs are alike. ``block``: memory for one `_BLOCK`."""
    count = p.shape[1]
    h = dt / steps
    b = block[0]
    bent = np.zeros((len(_SITES), W))
    curved = p[CURVES, 0] != 0.0
    for j0 in range(0, count, W):
        last = min(W, count - j0)
        some = np.arange(j0, j0 + last)
        tables = tables_of(p, 0, some, W)
        for j in range(W):
            q = min(j0 + j, count - 1)
            b.n_r[j] = s[N_R, q]
            _put_engine(b, j, engine.prepare(p, q))
        for k in range(len(n_dem)):
            for _ in range(steps if k > 0 else 0):
                if curved:
                    _bend(bent, p, known, k - 1, b.n_r, tables, some)
                    for j in range(W):
                        asked, lag, rise = n_dem[k - 1] + bent[0, j], curve.times(bent[1, j]), curve.times(bent[2, j])
                        b.n_r[j] = engine.step(b.n_r[j], _engine(b, j), asked, h, lag, rise)
                else:
                    for j in range(W):
                        b.n_r[j] = engine.step(b.n_r[j], _engine(b, j), n_dem[k - 1], h)
            for j in range(last):
                out[k, j0 + j] = b.n_r[j]
        for j in range(last):
            s[N_R, j0 + j] = b.n_r[j]


@inlined
def _bend(
    bent: np.ndarray, p: np.ndarray, known: np.ndarray, k: int, n_r: Any, tables: np.ndarray, some: np.ndarray
) -> None:  # fmt: skip
    """What the curves of the lanes ``some`` give at each of `_SITES`, at sample ``k`` and their own speeds ``n_r``."""
    bent[...] = 0.0
    for c in range(len(tables)):
        for i, site in enumerate(_SITES):
            if site_of(p, 0, c) == site and of_signal(p, 0, c, OWN_SPEED):
                gives_each(bent[i], p, 0, c, n_r, tables)
            elif site_of(p, 0, c) == site:
                gives(bent[i], p, 0, c, known, k, k, tables, some)
