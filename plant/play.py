"""Lost motion: the pins of a stage must cross their clearance before the ring follows.

The play operator, with u the driving angle, y the ring's and w the total width::

    y <- min(max(y, u - w/2), u + w/2)

It has memory (y is its state), no dependence on speed, and a reversal loses the whole width w before y moves.

Source: Krasnosel'skii and Pokrovskii, Systems with Hysteresis (1989), section 2.
"""

from __future__ import annotations

from vaneloop.base.compiled import compiled

__all__ = ["play_step"]


@compiled
def play_step(y: float, u: float, width: float) -> float:
    """Return the new output (rad) of a play of total ``width`` (rad) whose output was ``y`` and whose input is
    ``u``.
    """
    half = 0.5 * width
    return min(max(y, u - half), u + half)
