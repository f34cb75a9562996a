"""Demagnetised motor: less torque for a current, and less voltage for a speed.

Equation::

    K_t <- factor K_t,   K_e = K_t

Symbols: K_t torque constant (N m/A), K_e voltage constant (V s/rad), factor (-).
Limits: one factor at all temperatures and currents; no saturation of the iron.
In a log: the speed loop is slower in proportion, so that x_lvdt trails i_cmd by more after each change, and a reversal
against friction takes longer. i_motor rises, but is seldom logged. Steady motion does not change.
Source: Krishnan, Electric Motor Drives (2001), ch. 2, K_t and K_e of a direct-current machine.
"""

from __future__ import annotations

from plant.effect import MOTOR, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "motor_torque_constant_error",
    "motor",
    ("actuator",),
    (Parameter("factor", "-", 1.0, 0.1, 2.0, "torque for a current over its nominal value"),),
    (),
    "the motor gives less torque than nominal",
    "changes of speed, reversals",
    MOTOR,
)


@compiled
def step(constant: float, factor: float) -> float:
    """Return the torque constant (N m/A) of the motor."""
    return constant * factor
