"""The tachometer's magnets weaken with heat: the motor runs faster than it is told to.

Equation::

    w_rated(T) = w_rated (1 + coefficient (T - 40 degC))

Symbols: w_rated motor speed at rated command (rad/s), T temperature of the actuator (degC), coefficient (1/K).
Limits: linear; the actuator's temperature stands for the tachometer's. Kept above 5 % of w_rated.
In a log: the speed for a given i_cmd drifts with t_oil, both ways alike. Without a change of t_oil it is a
recalibration of the rated speed.
Source: data sheets of direct-current tachometers give a temperature coefficient: some 0.02 % per kelvin compensated,
0.2 % with plain ferrite magnets.
"""

from __future__ import annotations

from plant.effect import MOTOR, T_REF, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "tacho_thermal_drift",
    "amplifier",
    ("actuator",),
    (Parameter("coefficient", "1/K", 0.0, -0.02, 0.02, "relative speed per kelvin above 40 degC"),),
    (),
    "the rated speed changes with temperature",
    "moving strokes while the actuator warms up by 10 K or more",
    MOTOR,
)


@compiled
def step(speed: float, temperature: float, coefficient: float) -> float:
    """Return the rated motor speed (rad/s) at ``temperature`` (degC)."""
    return speed if coefficient == 0.0 else speed * max(1.0 + coefficient * (temperature - T_REF), 0.05)
