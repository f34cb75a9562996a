"""The air turns the vanes: its force on the piston grows with the square of rotor speed.

Equation::

    F = force (n_r / 100 %)^2

Symbols: F against extension (N), force at 100 % (N; negative helps extension), n_r rotor speed (%).
Limits: one force whatever the vane angle and inlet conditions. It enters the orifice equation (p_L = F / A) and
compresses the nominal oil; a screw hands it to the motor and rubs the more for it (plant/electromechanical.py).
In a log: extension is slower than retraction for the same current, the more so at high n_r (4 kN at 100 %: 8 % each
way); the null does not move.
Source: dynamic pressure; orifice equation under load, Merritt (1967), section 5-3.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "aero_load",
    "actuator",
    ("actuator",),
    (Parameter("force", "N", 0.0, -20000.0, 20000.0, "force against extension at 100 %, grows with n_r squared"),),
    (),
    "air forces load the piston",
    "motion both ways at low and at high rotor speed",
)


@compiled
def step(n_r: float, force: float) -> float:
    """Return the load (N) against extension at the rotor speed ``n_r`` (%)."""
    r = 0.01 * n_r
    return force * (r * r)
