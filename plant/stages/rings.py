"""What the rings do to the piston of one of two actuators whose strokes are both measured (`plant.unison`)."""

from __future__ import annotations

import numpy as np

from plant import chain, unison
from plant.effects import N_STATE, rows_at
from plant.parameters import LVDT_LAG, RING_STIFFNESS
from plant.places import LVDT_LAG_ERROR, X
from plant.stages.linkage import speed_of
from vaneloop.base.compiled import compiled_free

__all__ = ["ring_loads"]

_SENSED = np.array([LVDT_LAG, *rows_at("lvdt")])


def ring_loads(
    strokes: np.ndarray, t_oil: np.ndarray, dt: float, p_a: np.ndarray, p_b: np.ndarray, side: int
) -> np.ndarray:
    """Loads of the rings, against extension, on the piston of a ``side`` (0 A, 1 B) in each lane: float64[lanes,
    samples], N.

    strokes   float64[2, samples] m, as both LVDTs give them; effects and lags of either are taken off lane by lane
    t_oil     degC
    p_a, p_b  parameters of either side, a parameter set a lane
    """
    sensed = np.concatenate([p_a[_SENSED], p_b[_SENSED]])
    _, first, which = np.unique(sensed, axis=1, return_index=True, return_inverse=True)
    stiffness = p_a[RING_STIFFNESS]
    # the loads are in proportion to the stiffness: sets that see the same strokes share the rest
    p_a, p_b = np.ascontiguousarray(p_a[:, first]), np.ascontiguousarray(p_b[:, first])
    p_a[RING_STIFFNESS] = 1.0
    out = np.empty((len(first), strokes.shape[1]))
    _unit_loads(strokes, np.array([speed_of(x, dt) for x in strokes]), t_oil, p_a, p_b, side, out)
    return np.asarray(stiffness[:, None] * out[which.ravel()])


@compiled_free
def _unit_loads(
    strokes: np.ndarray,
    speeds: np.ndarray,
    t_oil: np.ndarray,
    p_a: np.ndarray,
    p_b: np.ndarray,
    side: int,
    out: np.ndarray,
) -> None:
    """`ring_loads` with the stiffness that ``p_a`` has."""
    s = np.zeros((N_STATE, 2))
    for j in range(out.shape[0]):
        late_a = max(p_a[LVDT_LAG, j], 0.0) + p_a[LVDT_LAG_ERROR, j]
        late_b = max(p_b[LVDT_LAG, j], 0.0) + p_b[LVDT_LAG_ERROR, j]
        one = p_a[:, j : j + 1]
        for k in range(out.shape[1]):
            s[X, 0] = chain.true_stroke(strokes[0, k] + late_a * speeds[0, k], p_a, j, t_oil[k])
            s[X, 1] = chain.true_stroke(strokes[1, k] + late_b * speeds[1, k], p_b, j, t_oil[k])
            tie = unison.tie(s, one, 0)
            out[j, k] = tie.f_a if side == 0 else tie.f_b
