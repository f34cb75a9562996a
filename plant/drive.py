"""Valve, oil, piston and LVDT as one part, with every effect: what is known before a step, and the step.

`prepare` works out what a step needs from a lane of the plant's parameters; `step` moves the state on. The chain runs
one lane so, the search many side by side (`plant.stages`). Units: SI.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from plant.effects import (
    end_stop_shift,
    internal_leakage,
    lvdt_lag,
    oil_compressibility,
    piston_friction,
    piston_stiction,
    supply_pressure_droop,
    valve_dead_band,
    valve_flow_saturation,
    valve_lag,
)
from plant.parameters import (
    AREA,
    LVDT_FACTOR,
    LVDT_SHARE,
    P_REF,
    RATED_CURRENT,
    STROKE,
    VALVE_A11,
    VALVE_A12,
    VALVE_A21,
    VALVE_A22,
    VALVE_SHARE,
)
from plant.places import (
    END_STOP_SHIFT,
    FRICTION,
    GIVE,
    INTERNAL_LEAKAGE,
    LAGGED,
    OIL_COMPRESSIBILITY,
    PISTON_FRICTION,
    PISTON_STICTION,
    READING,
    SPEED,
    SPOOL,
    SPOOL_RATE,
    SUPPLY_PRESSURE_DROOP,
    VALVE_DEAD_BAND,
    VALVE_FLOW_SATURATION,
    X_LVDT,
    X,
)
from plant.valve import valve_step
from vaneloop.base.compiled import inlined

__all__ = ["Drive", "DriveState", "Feed", "prepare", "step", "stored", "taken"]


class DriveState(NamedTuple):
    """What moves.

    spool, spool_rate  -, 1/s
    speed       m/s, of the oil behind the piston
    x, x_lvdt   m, stroke, and behind the LVDT's lag
    lagged      A, current behind the valve's lag
    force, off_centre  N, friction's push and its mean off mid-stroke
    give        m, by which oil and linkage yield
    reading     m, stroke behind both lags of the LVDT
    """

    spool: float
    spool_rate: float
    speed: float
    x: float
    x_lvdt: float
    lagged: float
    force: float
    off_centre: float
    give: float
    reading: float


class Drive(NamedTuple):
    """What a step needs of the machine, worked out once.

    rated, valve_share   A; share of the way that the valve's lag goes in a step
    a11 .. a22           the spool's exact step
    overlap, limit, roundness   valve: dead band (-), flow limit (m/s) and its corner
    droop, leakage       supply and internal leakage
    friction, excess, stribeck  N, N, m/s
    stiffness, compliance, drag N/m of the trapped oil; m/N, N/(m/s)
    per_p_ref, per_area, per_stroke  1/Pa, 1/m2, 1/m
    low, high            m, end stops
    lvdt_factor, lvdt_share     shares of the way that the LVDT's lags go in a step
    """

    rated: float
    valve_share: float
    a11: float
    a12: float
    a21: float
    a22: float
    overlap: float
    limit: float
    roundness: float
    droop: float
    leakage: float
    friction: float
    excess: float
    stribeck: float
    stiffness: float
    compliance: float
    drag: float
    per_p_ref: float
    per_area: float
    per_stroke: float
    low: float
    high: float
    lvdt_factor: float
    lvdt_share: float


class Feed(NamedTuple):
    """What is fed to it over a step: flow gains of either direction (m/s), root of the supply's share (-), load (N),
    half of what a newton on the piston is of the supply (1/N).
    """

    extending: float
    retracting: float
    root: float
    load: float
    half_share: float


@inlined
def prepare(p: np.ndarray, j: int) -> Drive:
    """Return what lane ``j`` of the parameters needs for its steps."""
    low, high = end_stop_shift.step(p[STROKE, j], p[END_STOP_SHIFT, j])
    return Drive(
        p[RATED_CURRENT, j],
        p[VALVE_SHARE, j],
        p[VALVE_A11, j],
        p[VALVE_A12, j],
        p[VALVE_A21, j],
        p[VALVE_A22, j],
        p[VALVE_DEAD_BAND, j] / p[RATED_CURRENT, j],
        p[VALVE_FLOW_SATURATION, j],
        p[VALVE_FLOW_SATURATION + 1, j],
        p[SUPPLY_PRESSURE_DROOP, j],
        p[INTERNAL_LEAKAGE, j],
        p[PISTON_FRICTION, j],
        p[PISTON_STICTION, j],
        p[PISTON_STICTION + 1, j],
        1.0 / (oil_compressibility.NOMINAL + p[OIL_COMPRESSIBILITY, j]),
        p[OIL_COMPRESSIBILITY, j],
        p[OIL_COMPRESSIBILITY + 1, j],
        1.0 / p[P_REF, j],
        1.0 / p[AREA, j],
        1.0 / p[STROKE, j],
        low,
        high,
        p[LVDT_FACTOR, j],
        p[LVDT_SHARE, j],
    )


@inlined
def taken(s: np.ndarray, j: int) -> DriveState:
    """Return the state of lane ``j``."""
    return DriveState(
        s[SPOOL, j],
        s[SPOOL_RATE, j],
        s[SPEED, j],
        s[X, j],
        s[X_LVDT, j],
        s[LAGGED, j],
        s[FRICTION, j],
        s[FRICTION + 1, j],
        s[GIVE, j],
        s[READING, j],
    )


@inlined
def stored(s: np.ndarray, j: int, z: DriveState) -> None:
    """Put the state of lane ``j`` back."""
    s[SPOOL, j], s[SPOOL_RATE, j], s[SPEED, j], s[X, j], s[X_LVDT, j] = z.spool, z.spool_rate, z.speed, z.x, z.x_lvdt
    s[LAGGED, j], s[FRICTION, j], s[FRICTION + 1, j] = z.lagged, z.force, z.off_centre
    s[GIVE, j], s[READING, j] = z.give, z.reading


@inlined
def step(
    z: DriveState,
    d: Drive,
    f: Feed,
    i: float,
    p_s: float,
    dt: float,
    loaded: bool,
    lossy: bool,
    sticky: bool,
    limited: bool,
    shut: float = 0.0,
) -> DriveState:
    """One plant step ``dt`` (s) under the valve's current ``i`` (A) at the supply pressure ``p_s`` (Pa).

    loaded  False leaves out what needs the load pressure: for lanes with `DRIVE_LOADED` 0, where it changes nothing
    lossy   False leaves out droop, leakage and round saturation, sticky: stiction, which take long: for lanes where
            these are neutral
    limited False leaves out the valve's lag, the LVDT's second one and the flow's limit, likewise
    """
    lagged = valve_lag.step(z.lagged, i, d.valve_share) if limited else i
    spool, spool_rate = valve_step(z.spool, z.spool_rate, lagged / d.rated, d.a11, d.a12, d.a21, d.a22)
    opening = valve_dead_band.step(spool, d.overlap) - shut
    gain = f.extending if opening > 0.0 else f.retracting
    force, off_centre, give = z.force, z.off_centre, z.give
    if loaded:
        p_load = (f.load + z.force) * d.per_area
        against = p_load if opening > 0.0 else -p_load
        speed = opening * (gain * math.sqrt(max(0.0, (p_s - against) * d.per_p_ref)))
        if lossy:
            speed = supply_pressure_droop.step(speed, p_s - against, d.droop)
            speed = valve_flow_saturation.step(speed, d.limit, d.roundness)
            speed = internal_leakage.step(speed, p_load, d.drag * d.per_area, d.leakage)
        elif limited:
            speed = valve_flow_saturation.corner(speed, d.limit)
        travel = 0.5 * (z.speed + speed) * dt
        level = piston_stiction.step(d.friction, speed, d.excess, d.stribeck) if sticky else d.friction
        r = piston_friction.off_middle(z.x, d.per_stroke)
        k = 1.0 - r * r
        force = piston_friction.step(z.force, travel, level, d.stiffness / k)
        moved = force - z.force
        off_centre, back = piston_friction.recentre(z.off_centre, r * moved, abs(travel) * d.stiffness * f.half_share)
        give = oil_compressibility.step(f.load, speed, d.compliance, d.drag)
        travel += (give - z.give) - (k * moved + r * back) / d.stiffness
    else:
        speed = opening * (gain * f.root)
        if limited:
            speed = valve_flow_saturation.corner(speed, d.limit)
        travel = 0.5 * (z.speed + speed) * dt
    x = min(max(z.x + travel, d.low), d.high)
    x_lvdt = z.x_lvdt + d.lvdt_factor * (x - z.x_lvdt)
    reading = lvdt_lag.step(z.reading, x_lvdt, d.lvdt_share) if limited else x_lvdt
    return DriveState(spool, spool_rate, speed, x, x_lvdt, lagged, force, off_centre, give, reading)
