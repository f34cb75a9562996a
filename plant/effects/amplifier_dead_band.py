"""Small commands are taken for noise: the amplifier asks for no speed until the command leaves a band.

Equation::

    i_read = i - clip(i, -half_width, half_width)

Symbols: i command current (A), half_width (A).
Limits: the same on both sides (else see amplifier_offset); the speed loop itself has no band: its speed is held at
zero within it.
In a log: i_cmd jumps by twice the half-width at each reversal of the stroke, which stands still meanwhile; the speed
for a given current is less by the same amount in both directions. In closed loop: a flat spot at reversals.
Source: definition; Slotine and Li, Applied Nonlinear Control (1991), section 5.2, dead zone.
"""

from __future__ import annotations

from plant.effect import MOTOR, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "amplifier_dead_band",
    "amplifier",
    ("actuator",),
    (Parameter("half_width", "mA", 0.0, 0.0, 20.0, "command that the amplifier takes for none"),),
    (),
    "small commands turn no motor",
    "small currents: slow motion, reversals",
    MOTOR,
)


@compiled
def step(i: float, half: float) -> float:
    """Return what is left of the command ``i`` (A) outside a band of +-``half`` (A)."""
    return i - min(max(i, -half), half)
