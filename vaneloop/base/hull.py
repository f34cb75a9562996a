"""Where a log has been, of two quantities at once: the convex hull of its samples, and what is nearest within it."""

from __future__ import annotations

import numpy as np
import scipy

from vaneloop.base.curve import SIDE

__all__ = ["hull_of", "nearest_within", "within"]

Array = np.ndarray


def hull_of(x: Array, z: Array, low: Array, high: Array) -> Array | None:
    """Corners of the hull of samples, float64[corners, 2], to the nearest points of a grid of `SIDE` points each way
    from ``low`` to ``high``; None where they lie along a line.
    """
    unit = (np.stack([x, z], axis=1) - low) / (high - low)
    unit = unit[np.all((unit >= 0.0) & (unit <= 1.0), axis=1)]
    points = np.unique(np.round(unit * (SIDE - 1)), axis=0) / (SIDE - 1)
    try:
        hull = scipy.spatial.ConvexHull(points)
    except (scipy.spatial.QhullError, ValueError):
        return None
    return np.asarray(low + (high - low) * points[hull.vertices])


def within(hull: Array, low: Array, high: Array, x: Array, z: Array) -> Array:
    """Whether values of the two quantities are within the hull, or half a grid's step beyond it. Raises ValueError
    where its corners lie along a line.
    """
    try:
        edges = scipy.spatial.ConvexHull((np.asarray(hull, dtype=float) - low) / (high - low)).equations
    except scipy.spatial.QhullError:
        raise ValueError("corners along a line") from None
    at = np.stack([(x - low[0]) / (high[0] - low[0]), (z - low[1]) / (high[1] - low[1])])
    return np.asarray((edges[:, :2] @ at + edges[:, 2:] <= 0.5 / (SIDE - 1)).all(axis=0))


def nearest_within(hull: Array, low: Array, high: Array) -> Array:
    """For each point of the grid, row by row, the number of the one that is nearest to it and within the hull."""
    x, z = (np.linspace(a, b, SIDE) for a, b in zip(low, high, strict=True))
    been = within(hull, low, high, np.repeat(x, SIDE), np.tile(z, SIDE)).reshape(SIDE, SIDE)
    k, m = scipy.ndimage.distance_transform_edt(~been, return_distances=False, return_indices=True)
    return np.asarray(k * SIDE + m).ravel()
