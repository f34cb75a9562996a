"""What the blocks of lanes share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from vaneloop.base.compiled import inlined, threads
from vaneloop.base.side_by_side import side_by_side

__all__ = ["NOTHING", "NO_RINGS", "W", "between", "in_blocks", "on_all_cores", "parts_of", "put_where_seen"]

NOTHING = np.empty((0, 0))  # where no lane has a curve
NO_RINGS = np.empty((2, 0, 0))  # of an actuator alone
W = 8  # lanes in a block of the actuator: two vectors of four; more do not run faster

# A block's memory comes from the caller, who keeps it: a record that compiled code takes out of an array of its own
# does not keep that array alive. Its width is constant, so that the compiler sees the strides.


def in_blocks(lanes: int, width: int, few: int) -> int:
    """How many of the lanes run in blocks; the rest of at most ``few`` one by one."""
    rest = lanes % width
    return lanes - rest if rest <= few else lanes


def parts_of(lanes: int, wide: int, width: int) -> list[range]:
    """Lanes, ``wide`` of them in blocks of ``width``, the rest shared out to the cores: what one thread does at a
    time.
    """
    each = max(1, -(-(lanes - wide) // threads()))
    work = [range(j, min(j + width, wide)) for j in range(0, wide, width)]
    return work + [range(j, min(j + each, lanes)) for j in range(wide, lanes, each)]


def on_all_cores(run: Callable[[range], None], work: list[range]) -> None:
    """``run`` all parts: compiled code needs no interpreter. The costly ones, which come last, begin first."""
    for _ in side_by_side(run, work[::-1]):
        pass


@inlined
def between(a: np.ndarray, k: int) -> float:
    """Mean of a signal over the step to sample ``k``."""
    return 0.5 * (a[k - 1] + a[k])


@inlined
def put_where_seen(b: Any, j: int, x: float, first: bool) -> None:
    """Put the piston of lane ``j`` where the LVDT saw it, at the true stroke ``x`` (m), with all that trails it."""
    shift = x - b.reading[j]
    b.x[j] = x if first else b.x[j] + shift
    b.x_lvdt[j] = x if first else b.x_lvdt[j] + shift
    b.reading[j] = x if first else b.reading[j] + shift
