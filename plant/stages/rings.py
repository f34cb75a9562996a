"""What the rings do to the piston of one of two actuators whose strokes are both measured (`plant.unison`)."""

from __future__ import annotations

import numpy as np

from plant import chain, unison
from plant.effects import N_STATE, ring_stiffness, rows_at
from plant.parameters import LVDT_LAG, RING_STIFFNESS
from plant.places import LVDT_LAG_ERROR, RIGGING_OFFSET, RING_STIFFNESS_RATIO, X
from plant.stages.linkage import speed_of
from vaneloop.base.compiled import compiled_free

__all__ = ["ring_loads"]

_SEEN = np.array([LVDT_LAG, RIGGING_OFFSET, *rows_at("lvdt")])  # what the places depend on that both sides ask


def ring_loads(
    strokes: np.ndarray, t_oil: np.ndarray, dt: float, p_a: np.ndarray, p_b: np.ndarray, side: int
) -> np.ndarray:
    """The rings as springs on the piston of a ``side`` (0 A, 1 B) in each lane: float64[2, lanes, samples], their load
    against extension at the stroke 0 (N), and by how much it grows with the stroke (N/m).

    They are linear about the measured strokes. The load follows the simulated piston: one that followed its measured
    stroke would carry the noise of the LVDT through the leakage, which adds it up.

    strokes   float64[2, samples] m, as both LVDTs give them; effects and lags of either are taken off lane by lane
    t_oil     degC
    p_a, p_b  parameters of either side, a parameter set a lane
    """
    seen = np.concatenate([p_a[_SEEN], p_b[_SEEN]])
    _, first, which = np.unique(seen, axis=1, return_index=True, return_inverse=True)
    stiffness = p_a[RING_STIFFNESS] * ring_stiffness.step(p_a[RING_STIFFNESS_RATIO], p_b[RING_STIFFNESS_RATIO])[0]
    # the loads are in proportion to the stiffness: sets that ask for the same places share the rest
    both = np.ascontiguousarray(np.stack([p_a[:, first], p_b[:, first]], axis=2))
    both[RING_STIFFNESS] = both[RING_STIFFNESS_RATIO] = 1.0
    out = np.empty((2, len(first), strokes.shape[1]))
    _unit_loads(strokes, np.array([speed_of(x, dt) for x in strokes]), t_oil, both, side, out)
    return np.asarray(stiffness[:, None] * out[:, which.ravel()])


@compiled_free
def _unit_loads(
    strokes: np.ndarray, speeds: np.ndarray, t_oil: np.ndarray, both: np.ndarray, side: int, out: np.ndarray
) -> None:
    """`ring_loads` with the stiffness that A has; ``both``: float64[N_PARAMETERS, lanes, 2]."""
    s = np.zeros((N_STATE, 2))
    for j in range(out.shape[1]):
        p = both[:, j]
        late_a = max(p[LVDT_LAG, 0], 0.0) + p[LVDT_LAG_ERROR, 0]
        late_b = max(p[LVDT_LAG, 1], 0.0) + p[LVDT_LAG_ERROR, 1]
        for k in range(out.shape[2]):
            s[X, 0] = chain.true_stroke(strokes[0, k] + late_a * speeds[0, k], p, 0, t_oil[k])
            s[X, 1] = chain.true_stroke(strokes[1, k] + late_b * speeds[1, k], p, 1, t_oil[k])
            tie = unison.tie(s, p, 0)
            load, slope = (tie.f_a, tie.k_a) if side == 0 else (tie.f_b, tie.k_b)
            out[0, j, k], out[1, j, k] = load - slope * s[X, side], slope
