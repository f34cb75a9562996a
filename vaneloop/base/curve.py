"""A curve of one quantity as a table: what runs in compiled loops of a function that somebody fitted or learned."""

from __future__ import annotations

import numpy as np

from vaneloop.base.compiled import inlined

__all__ = ["POINTS", "on_table"]

POINTS = 257  # of a table, evenly spaced from its lowest to its highest argument


@inlined
def on_table(x: float, low: float, high: float, table: np.ndarray) -> float:
    """The curve at ``x``: straight between the points of ``table``, which stand evenly from ``low`` to ``high``; beyond
    its ends it stays as at them.
    """
    last = len(table) - 1
    z = (x - low) / (high - low) * last
    if not z > 0.0:
        return table[0]
    if z >= last:
        return table[last]
    k = int(z)
    return table[k] + (z - k) * (table[k + 1] - table[k])
