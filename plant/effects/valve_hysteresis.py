"""Magnetic memory of the torque motor and friction of the spool: rising and falling current open the valve differently.

Equation, a play with i the command, y the current that counts::

    y <- min(max(y, i - width/2), i + width/2)

Symbols: i, y (A), width total (A).
Limits: a play has parallel branches and sharp corners; magnetic minor loops are narrower and round. Rate-independent.
Dither, which shrinks it in practice, counts as a smaller width.
In a log: at a reversal of i_cmd the stroke's speed keeps its value until the current has come back by the width.
Unlike a dead band it is centred on the last turn, not on zero current, and a dwell at rest can sit anywhere within
the width.
Source: Krasnosel'skii and Pokrovskii, Systems with Hysteresis (1989), section 2; 2 to 4 % of rated current are usual
(Moog type 30 catalogue).
"""

from __future__ import annotations

from plant.compiled import compiled
from plant.effect import Effect, Parameter

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "valve_hysteresis",
    "valve",
    ("actuator",),
    (Parameter("width", "mA", 0.0, 0.0, 20.0, "total width between rising and falling current"),),
    ("current",),
    "the valve remembers where its current came from",
    "reversals of the current",
)


@compiled
def step(y, i, width):
    """Return the current (A) that counts, for the command ``i`` (A) and the one that counted before, ``y`` (A)."""
    half = 0.5 * width
    return min(max(y, i - half), i + half)
