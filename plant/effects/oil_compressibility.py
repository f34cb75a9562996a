"""Air in the oil, hoses that swell: the trapped columns give way under the load.

Equation::

    give = -(C0 + compliance) F - compliance drag v,   x = s + give

Symbols: s way that the oil has pushed (m), F load against extension (N), v speed (m/s), drag of seals and oil
(N/(m/s)). C0 = (stroke + 2 d) / (4 B A) = 6.9e-9 m/N is that of two columns of oil: B = 1.6 GPa, A = 1.2e-3 m2, 48 mm,
d = 2.4 mm of dead volume at either end. Each of two actuators has that of its own area. Friction acts through the same
compliance (piston_friction).
Limits: quasi-static: the load changes slowly, so that the valve keeps both chambers' mean pressure and the compliance
is that of mid-stroke anywhere (piston_friction). The resonance with the moving mass (200 Hz for 5 kg at 0.1 mm/kN) lies
above the servo's band.
In a log: the stroke shifts as the load changes with n_r; reversals with friction lose more motion; while moving it
trails by compliance * drag * v. Without load, friction or fast motion nothing shows.
Source: Merritt (1967), section 6-2, hydraulic stiffness 4 B A^2 / V.
"""

from __future__ import annotations

from plant.effect import HYDRAULIC, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["DEAD", "EFFECT", "NOMINAL", "of_area", "step"]

EFFECT = Effect(
    "oil_compressibility",
    "actuator",
    ("actuator",),
    (
        Parameter("compliance", "mm/kN", 0.0, 0.0, 10.0, "give of the oil beyond nominal"),
        Parameter("drag", "N/(m/s)", 1500.0, 0.0, 20000.0, "viscous force of seals and oil, as it compresses the oil"),
    ),
    ("give",),
    "the oil columns give way under load",
    "a load that changes, or fast motion",
    HYDRAULIC,
)

DEAD = 0.05  # of the stroke: length of the dead volume at either end
AREA = 1.2e-3  # m2
NOMINAL = 0.048 * (1.0 + 2.0 * DEAD) / (4.0 * 1.6e9 * AREA)  # m/N, see the docstring


@compiled
def of_area(area: float) -> float:
    """Return C0 (m/N) of a piston of this ``area`` (m2)."""
    return NOMINAL * (AREA / area)


@compiled
def step(force: float, v: float, compliance: float, drag: float, nominal: float = NOMINAL) -> float:
    """Return by how far (m) the piston stands off the pushed way, under ``force`` (N, against extension) at ``v``
    (m/s); ``nominal`` C0 (m/N).
    """
    return -((nominal + compliance) * force + compliance * drag * v)
