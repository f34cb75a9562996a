"""Magnetic memory of the torque motor: rising and falling current open the valve differently.

Equation, play operators in parallel, with i the command and y the current that counts::

    y_k <- min(max(y_k, i - w_k / 2), i + w_k / 2),   w_k = width (1 + spread (-3/4, -1/4, 1/4, 3/4)),   y = mean of y_k

Symbols: i, y (A), width total (A), of a loop over the whole range; spread (-) of the operators' widths. At spread 1,
equal shares of operators from 0 to 2 width are Rayleigh's law of magnetisation: a small reversal shows little of the
width and its loop is round. At spread 0 all are one plain backlash: friction in the torque motor, a loose feedback
spring.
Limits: rate-independent; the same at every current (no saturation of the iron). Dither, which shrinks it in practice,
counts as a smaller width. On a log of mean currents the turns between two samples are not seen.
In a log: after a reversal of i_cmd the stroke's speed follows the current only in part until it has come back by
twice the width. Unlike a dead band it is centred on the last turn, not on zero current; the current of a dwell at
rest depends on how it was reached.
Source: Bertotti, Hysteresis in Magnetism (1998), ch. 2, Rayleigh law; Krasnosel'skii and Pokrovskii, Systems with
Hysteresis (1989), section 2; 2 to 4 % of rated current are usual (Moog type 30 catalogue).
"""

from __future__ import annotations

from plant.effect import HYDRAULIC, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "mean", "step"]

EFFECT = Effect(
    "valve_hysteresis",
    "valve",
    ("actuator",),
    (
        Parameter("width", "mA", 0.0, 0.0, 20.0, "total width between rising and falling current"),
        Parameter("spread", "-", 1.0, 0.0, 1.0, "1: magnetic, round loops; 0: one backlash, with corners"),
    ),
    ("current_1", "current_2", "current_3", "current_4"),
    "the valve opens differently on rising and falling current",
    "reversals of the current",
    HYDRAULIC,
)


@compiled
def step(
    y1: float, y2: float, y3: float, y4: float, i: float, width: float, spread: float
) -> tuple[float, float, float, float]:
    """Return the four plays' currents (A) for the command ``i`` (A); what counts is their `mean`."""
    half, far, near = 0.5 * width, 0.375 * width * spread, 0.125 * width * spread
    a, b, c, d = half - far, half - near, half + near, half + far
    return (
        min(max(y1, i - a), i + a),
        min(max(y2, i - b), i + b),
        min(max(y3, i - c), i + c),
        min(max(y4, i - d), i + d),
    )


@compiled
def mean(y1: float, y2: float, y3: float, y4: float) -> float:
    """Return the current (A) that moves the spool; of four equal numbers it is exactly that number."""
    return 0.25 * ((y1 + y2) + (y3 + y4))
