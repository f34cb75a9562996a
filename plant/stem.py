"""One vane stage from the crank's direction to its stem: ring, play, friction, with every effect.

`prepare` works out what a stage needs from a lane of the plant's parameters; `drive` and `follow` move it on. The chain
runs one lane so, the search many side by side (`plant.stages`). Units: SI, angles rad, temperature degC.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from plant.effects import (
    crank_length_error,
    link_length_error,
    linkage_backlash,
    linkage_compliance,
    linkage_friction,
    linkage_wear,
    pot_bias,
    pot_gain,
    rigging_offset,
    ring_eccentricity,
    thermal_growth,
)
from plant.linkage import G_AX, G_AY, G_L, G_LB, G_LC, G_LD, G_LDP, N_CRANK, N_PER_STAGE
from plant.parameters import GEOMETRY, PLAY, POT_BIAS
from plant.places import (
    BRISTLE,
    CRANK_LENGTH_ERROR,
    DRIVEN,
    LINK_LENGTH_ERROR,
    LINKAGE_BACKLASH,
    POT_BIAS_ERROR,
    RIGGING_OFFSET,
    RING,
)
from plant.play import play_step
from plant.prepared import with_effects
from vaneloop.base.compiled import inlined

__all__ = ["Stem", "StemState", "drive", "follow", "prepare", "reading", "stored", "taken"]


class StemState(NamedTuple):
    """What a stage remembers: its ring (rad), friction's bristle (-1..1), the ring as friction saw it last (rad)."""

    ring: float
    bristle: float
    driven: float


class _Stem(NamedTuple):
    """What a stage is, worked out once; behind these fields those of the effects at linkage and potentiometer
    (`plant.prepared`).

    ax, ay, lb, lc, ld  m, of the linkage (`plant.linkage`), errors of length and of rigging included
    ldp, length, ratio  m, m: clevis and vane lever; ring angle per vane angle
    play                rad total width at the ring, nominal and linkage_backlash
    offset              rad, of the potentiometer
    """

    ax: float
    ay: float
    lb: float
    lc: float
    ld: float
    ldp: float
    length: float
    ratio: float
    play: float
    offset: float


@inlined
def _numbers(p: np.ndarray, j: int, k: int) -> _Stem:
    """Return what stage ``k`` is in lane ``j`` of the parameters, but for the effects' own numbers."""
    o = GEOMETRY + N_CRANK + k * N_PER_STAGE
    ratio = p[o + G_L, j] / p[o + G_LDP, j]
    return _Stem(
        p[o + G_AX, j],
        p[o + G_AY, j],
        crank_length_error.step(p[o + G_LB, j], p[CRANK_LENGTH_ERROR + k, j]),
        rigging_offset.step(link_length_error.step(p[o + G_LC, j], p[LINK_LENGTH_ERROR + k, j]), p[RIGGING_OFFSET, j]),
        p[o + G_LD, j],
        p[o + G_LDP, j],
        p[o + G_L, j],
        ratio,
        linkage_backlash.step(p[PLAY + k, j], p[LINKAGE_BACKLASH + k, j], ratio),
        pot_bias.step(p[POT_BIAS + k, j], p[POT_BIAS_ERROR + k, j]),
    )


Stem, prepare = with_effects(_Stem, _numbers, "p, j, k", "linkage", "pot")


@inlined
def taken(s: np.ndarray, j: int, k: int) -> StemState:
    """Return the state of stage ``k`` in lane ``j``."""
    return StemState(s[RING + k, j], s[BRISTLE + k, j], s[DRIVEN + k, j])


@inlined
def stored(s: np.ndarray, j: int, k: int, z: StemState) -> None:
    """Put the state of stage ``k`` in lane ``j`` back."""
    s[RING + k, j], s[BRISTLE + k, j], s[DRIVEN + k, j] = z.ring, z.bristle, z.driven


@inlined
def drive(d: Any, theta: float, n_r: float, t_oil: float, t: float, eccentric: bool) -> float:
    """Return the angle to which the linkage drives the ring at time ``t`` (s from the start of the log), of the rigid
    linkage's ``theta``; before its play.

    eccentric  False leaves out what takes a sine: for lanes where it is neutral
    """
    if eccentric:
        theta = ring_eccentricity.step(theta, d.ring_eccentricity, d.ring_eccentricity_phase)
    theta = thermal_growth.step(theta, t_oil, d.thermal_growth, d.ratio)
    return linkage_compliance.step(theta, n_r, d.linkage_compliance)


@inlined
def follow(
    z: StemState, d: Any, theta: float, t_oil: float, t: float, rubbed: bool, more: float = 0.0
) -> tuple[StemState, float]:
    """Let the ring follow ``theta`` at time ``t`` (s from the start of the log); return its state, and its angle.

    rubbed  False leaves out friction, and what it remembers: for a stage that has none
    more    rad of play at the ring, beyond the stage's own; all of it is never negative
    """
    play = linkage_wear.step(d.play, d.linkage_wear, d.ratio, t)
    if more != 0.0:
        play = max(play + more, 0.0)
    ring = play_step(z.ring, theta, play)
    if not rubbed:
        return StemState(ring, z.bristle, z.driven), ring
    bristle = linkage_friction.step(z.bristle, ring - z.driven, d.linkage_friction_distance)
    return StemState(ring, bristle, ring), linkage_friction.loop(ring, bristle, d.linkage_friction, d.ratio)


@inlined
def reading(d: Any, vane: float, t_oil: float, t: float) -> float:
    """Return what the potentiometer makes of a resting vane angle at time ``t`` (s from the start of the log)."""
    return pot_gain.step(vane, d.pot_gain) + d.offset
