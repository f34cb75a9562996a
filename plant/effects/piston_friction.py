"""Seals hold the piston: a constant force against its motion, which the oil must overcome before it moves.

Equation, with s the way that the oil has pushed (m), z the friction force (N), level the greatest one, C the
compliance of the oil (m/N)::

    z <- clip(z + ds / (k C), -level, level),   p_L = (F + z) / A
    m <- m + r C dz,   back = m min(1, |ds| / way),   m <- m - back,   dx = ds - k C dz - r back
    r = 1 - 2 (x + d) / (stroke + 2 d),   k = 1 - r^2,   way = 2 A C p_s

Symbols: x stroke (m), F load (N), level = force (with piston_stiction: more at low speed), C and dead length d see
oil_compressibility, A area (m2), p_s, p_L supply and load pressure (Pa). In words: at a reversal the oil is first
compressed by 2 k C force while the piston stands. Near an end one column is short and stiff (k < 1), and takes most of
the change of pressure; m is by how much the chambers' mean pressure is then off, as a length. The valve sets it right
again within the next ``way`` (0.35 mm), and the rest of 2 C force is lost. Then the force is Coulomb's.
Limits: no viscous part (it is in the flow gain), no presliding of the seals themselves; the piston has no mass.
In a log: the stroke loses 2 C force at each reversal (2 kN: 28 um), and runs slower by force / (2 A p_s) both ways (2
kN: 4 %). In closed loop the tracking hardly changes; i_cmd rises.
Source: Coulomb friction on an elastic support (Prandtl), Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30
(1994), section 2; the chambers' balance by linearising Merritt (1967), section 6-2, about its middle.
"""

from __future__ import annotations

from plant.effect import HYDRAULIC, Effect, Parameter
from plant.effects.oil_compressibility import DEAD
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "off_middle", "recentre", "step"]

EFFECT = Effect(
    "piston_friction",
    "actuator",
    ("actuator",),
    (Parameter("force", "N", 0.0, 0.0, 20000.0, "Coulomb friction"),),
    ("force", "off_centre"),
    "seals hold the piston back",
    "reversals, and fast motion",
    HYDRAULIC,
)


@compiled
def step(z: float, travel: float, level: float, stiffness: float) -> float:
    """Return the friction force (N) after the oil has pushed by ``travel`` (m) from where it was ``z`` (N);
    ``stiffness`` 1/C (N/m).
    """
    if level == 0.0:
        return 0.0
    return min(max(z + travel * stiffness, -level), level)


@compiled
def off_middle(x: float, per_stroke: float) -> float:
    """Return r, how unequal the columns of oil are at stroke ``x`` (m), 0 in the middle; ``per_stroke`` 1 over the full
    stroke (1/m).
    """
    return 1.0 - (x * per_stroke + DEAD) * (2.0 / (1.0 + 2.0 * DEAD))


@compiled
def recentre(off: float, jump: float, ways: float) -> tuple[float, float]:
    """Return (off, back): the mean pressure's offset (N) after a ``jump`` of it and |ds| = ``ways`` of the way, and
    what of it went (N).
    """
    back = (off + jump) * min(ways, 1.0)
    return off + jump - back, back
