"""One vane stage from the crank's direction to its stem: ring, play, friction, with every effect.

`prepare` works out what a stage needs from a lane of the plant's parameters; `drive` and `follow` move it on. The chain
runs one lane so, the search many side by side (`plant.stages`). Units: SI, angles rad, temperature degC.
"""

from __future__ import annotations

from typing import NamedTuple

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
    LINKAGE_COMPLIANCE,
    LINKAGE_FRICTION,
    LINKAGE_WEAR,
    POT_BIAS_ERROR,
    POT_GAIN,
    RING,
    RING_ECCENTRICITY,
    THERMAL_GROWTH,
)
from plant.play import play_step
from vaneloop.base.compiled import inlined
from vaneloop.base.vanes import MOST

__all__ = ["Stem", "StemState", "drive", "follow", "prepare", "reading", "stored", "taken"]


class StemState(NamedTuple):
    """What a stage remembers: its ring (rad), friction's bristle (-1..1), the ring as friction saw it last (rad)."""

    ring: float
    bristle: float
    driven: float


class Stem(NamedTuple):
    """What a stage is, worked out once.

    ax, ay, lb, lc, ld  m, of the linkage (`plant.linkage`), errors of length included
    ldp, length, ratio  m, m: clevis and vane lever; ring angle per vane angle
    amplitude, phase    rad, of the ring's eccentricity
    warm, bend          rad/K of growth, rad of compliance at 100 % speed
    play, wear          rad total width at the ring; rad/s at the vane by which it grows
    friction, distance  rad width of friction's loop at the vane, rad over which it turns
    gain, offset        -, rad, of the potentiometer
    """

    ax: float
    ay: float
    lb: float
    lc: float
    ld: float
    ldp: float
    length: float
    ratio: float
    amplitude: float
    phase: float
    warm: float
    bend: float
    play: float
    wear: float
    friction: float
    distance: float
    gain: float
    offset: float


@inlined
def prepare(p: np.ndarray, j: int, k: int) -> Stem:
    """Return what stage ``k`` is in lane ``j`` of the parameters."""
    o = GEOMETRY + N_CRANK + k * N_PER_STAGE
    ratio = p[o + G_L, j] / p[o + G_LDP, j]
    return Stem(
        p[o + G_AX, j],
        p[o + G_AY, j],
        crank_length_error.step(p[o + G_LB, j], p[CRANK_LENGTH_ERROR + k, j]),
        link_length_error.step(p[o + G_LC, j], p[LINK_LENGTH_ERROR + k, j]),
        p[o + G_LD, j],
        p[o + G_LDP, j],
        p[o + G_L, j],
        ratio,
        p[RING_ECCENTRICITY + k, j],
        p[RING_ECCENTRICITY + MOST, j],
        p[THERMAL_GROWTH + k, j],
        p[LINKAGE_COMPLIANCE, j],
        linkage_backlash.step(p[PLAY + k, j], p[LINKAGE_BACKLASH + k, j], ratio),
        p[LINKAGE_WEAR + k, j],
        p[LINKAGE_FRICTION + k, j],
        p[LINKAGE_FRICTION + MOST, j],
        p[POT_GAIN + k, j],
        pot_bias.step(p[POT_BIAS + k, j], p[POT_BIAS_ERROR + k, j]),
    )


@inlined
def taken(s: np.ndarray, j: int, k: int) -> StemState:
    """Return the state of stage ``k`` in lane ``j``."""
    return StemState(s[RING + k, j], s[BRISTLE + k, j], s[DRIVEN + k, j])


@inlined
def stored(s: np.ndarray, j: int, k: int, z: StemState) -> None:
    """Put the state of stage ``k`` in lane ``j`` back."""
    s[RING + k, j], s[BRISTLE + k, j], s[DRIVEN + k, j] = z.ring, z.bristle, z.driven


@inlined
def drive(d: Stem, theta: float, n_r: float, t_oil: float, eccentric: bool) -> float:
    """Return the angle to which the linkage drives the ring, of the rigid linkage's ``theta``; before its play.

    eccentric  False leaves out what takes a sine: for lanes where it is neutral
    """
    if eccentric:
        theta = ring_eccentricity.step(theta, d.amplitude, d.phase)
    theta = thermal_growth.step(theta, t_oil, d.warm, d.ratio)
    return linkage_compliance.step(theta, n_r, d.bend)


@inlined
def follow(
    z: StemState, d: Stem, theta: float, t_oil: float, t: float, rubbed: bool, more: float = 0.0
) -> tuple[StemState, float]:
    """Let the ring follow ``theta`` at time ``t`` (s from the start of the log); return its state, and its angle.

    rubbed  False leaves out friction, and what it remembers: for a stage that has none
    more    rad of play at the ring, beyond the stage's own; all of it is never negative
    """
    play = linkage_wear.step(d.play, d.wear, d.ratio, t)
    if more != 0.0:
        play = max(play + more, 0.0)
    ring = play_step(z.ring, theta, play)
    if not rubbed:
        return StemState(ring, z.bristle, z.driven), ring
    bristle = linkage_friction.step(z.bristle, ring - z.driven, d.distance)
    return StemState(ring, bristle, ring), linkage_friction.loop(ring, bristle, d.friction, d.ratio)


@inlined
def reading(d: Stem, vane: float) -> float:
    """Return what the potentiometer makes of a resting vane angle."""
    return pot_gain.step(vane, d.gain) + d.offset
