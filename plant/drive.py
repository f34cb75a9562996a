"""Valve, oil, piston and LVDT as one part, with every effect: what is known before a step, and the step.

`prepare` works out what a step needs from a lane of the plant's parameters; `step` moves the state on. The chain runs
one lane so, the search many side by side (`plant.stages`). Units: SI.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from plant.actuator import speed_factor
from plant.effects import (
    aero_load,
    end_stop_shift,
    internal_leakage,
    lvdt_lag,
    oil_compressibility,
    oil_viscosity,
    piston_friction,
    piston_stiction,
    supply_pressure_droop,
    valve_dead_band,
    valve_flow_saturation,
    valve_gain_asymmetry,
    valve_hysteresis,
    valve_lag,
    valve_null_bias,
)
from plant.parameters import (
    ACTUATORS,
    AREA,
    FLOW_GAIN,
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
    CURRENT,
    END_STOP_SHIFT,
    FRICTION,
    GIVE,
    LAGGED,
    OIL_COMPRESSIBILITY,
    READING,
    SPEED,
    SPOOL,
    SPOOL_RATE,
    VALVE_DEAD_BAND,
    VALVE_NULL_BIAS,
    X_LVDT,
    X,
)
from plant.prepared import with_effects
from plant.valve import valve_step
from vaneloop.base.compiled import inlined

__all__ = [
    "Drive", "DriveState", "Feed", "Plays", "current", "feed", "flow_gain", "gains", "half_share", "load_of",
    "loaded_by", "nominal_compliance", "prepare", "pressure", "remembered", "rest", "root", "step", "stored", "taken",
    "told",
]  # fmt: skip


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


class Plays(NamedTuple):
    """What the valve's hysteresis remembers: four currents (A)."""

    current_1: float
    current_2: float
    current_3: float
    current_4: float


class _Drive(NamedTuple):
    """What a step needs of the machine, worked out once; behind these fields those of the effects at valve, supply and
    actuator (`plant.prepared`).

    rated, valve_share   A; share of the way that the valve's lag goes in a step
    a11 .. a22           the spool's exact step
    flow, p_ref          m/s at full spool and p_ref (Pa)
    overlap              -, of the valve's lands: its dead band
    nominal, stiffness   m/N, compliance of the trapped oil without an effect; N/m with it
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
    flow: float
    p_ref: float
    overlap: float
    nominal: float
    stiffness: float
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
def nominal_compliance(p: np.ndarray, j: int) -> float:
    """Return the compliance (m/N) of the oil that lane ``j`` traps, without an effect; of two actuators, by the area of
    this one.
    """
    return oil_compressibility.NOMINAL if p[ACTUATORS, j] == 0.0 else oil_compressibility.of_area(p[AREA, j])


@inlined
def _numbers(p: np.ndarray, j: int) -> _Drive:
    """Return what lane ``j`` of the parameters needs for its steps, but for the effects' own numbers."""
    low, high = end_stop_shift.step(p[STROKE, j], p[END_STOP_SHIFT, j])
    nominal = nominal_compliance(p, j)
    return _Drive(
        p[RATED_CURRENT, j],
        p[VALVE_SHARE, j],
        p[VALVE_A11, j],
        p[VALVE_A12, j],
        p[VALVE_A21, j],
        p[VALVE_A22, j],
        p[FLOW_GAIN, j],
        p[P_REF, j],
        p[VALVE_DEAD_BAND, j] / p[RATED_CURRENT, j],
        nominal,
        1.0 / (nominal + p[OIL_COMPRESSIBILITY, j]),
        1.0 / p[P_REF, j],
        1.0 / p[AREA, j],
        1.0 / p[STROKE, j],
        low,
        high,
        p[LVDT_FACTOR, j],
        p[LVDT_SHARE, j],
    )


Drive, prepare = with_effects(_Drive, _numbers, "p, j", "valve", "supply", "actuator")


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
def remembered(s: np.ndarray, j: int) -> Plays:
    """Return what the valve of lane ``j`` remembers."""
    return Plays(s[CURRENT, j], s[CURRENT + 1, j], s[CURRENT + 2, j], s[CURRENT + 3, j])


@inlined
def told(s: np.ndarray, j: int, y: Plays) -> None:
    """Let the valve of lane ``j`` remember it."""
    s[CURRENT, j], s[CURRENT + 1, j], s[CURRENT + 2, j], s[CURRENT + 3, j] = (
        y.current_1,
        y.current_2,
        y.current_3,
        y.current_4,
    )


@inlined
def rest(s: np.ndarray, p: np.ndarray, j: int, i_cmd: float, load: float) -> None:
    """Let valve and oil of lane ``j`` rest under the command ``i_cmd`` (A) and the ``load`` (N)."""
    i = valve_null_bias.step(i_cmd, p[VALVE_NULL_BIAS, j])
    told(s, j, Plays(i, i, i, i))
    s[LAGGED, j] = i
    compliance, drag = p[OIL_COMPRESSIBILITY, j], p[OIL_COMPRESSIBILITY + 1, j]
    s[GIVE, j] = oil_compressibility.step(load, 0.0, compliance, drag, nominal_compliance(p, j))


@inlined
def current(y: Plays, d: Any, i_cmd: float, memory: bool) -> tuple[Plays, float]:
    """Return what the valve remembers under the command ``i_cmd`` (A), and the current (A) that moves the spool.

    memory  False leaves out its hysteresis: for lanes where it is neutral
    """
    i = valve_null_bias.step(i_cmd, d.valve_null_bias)
    if not memory:
        return y, i
    y1, y2, y3, y4 = valve_hysteresis.step(
        y.current_1, y.current_2, y.current_3, y.current_4, i, d.valve_hysteresis_width, d.valve_hysteresis_spread
    )
    return Plays(y1, y2, y3, y4), valve_hysteresis.mean(y1, y2, y3, y4)


@inlined
def flow_gain(d: Any, t_oil: float) -> float:
    """Return the flow gain (m/s) at ``t_oil`` (degC), the mean of both directions."""
    return oil_viscosity.step(d.flow, t_oil, d.oil_viscosity)


@inlined
def load_of(d: Any, n_r: float) -> float:
    """Return the load (N) against extension at the speed ``n_r`` (%)."""
    return aero_load.step(n_r, d.aero_load)


@inlined
def gains(d: Any, gain: float) -> tuple[float, float]:
    """Return the flow gains (m/s) of extension and retraction, whose mean is ``gain``."""
    return valve_gain_asymmetry.step(gain, d.valve_gain_asymmetry)


@inlined
def root(d: Any, p_s: float) -> float:
    """Return the root of the supply's share ``p_s`` (Pa) of the pressure for which the flow gain holds."""
    return speed_factor(p_s, 0.0, d.p_ref)


@inlined
def half_share(d: Any, p_s: float) -> float:
    """Return half of what a newton on the piston is of the supply ``p_s`` (Pa), 1/N; finite where that is gone."""
    return 0.5 * d.per_area / max(p_s, 1.0)


@inlined
def feed(d: Any, gain: float, load: float, p_s: float) -> Feed:
    """Return what is fed at the flow gain ``gain`` (m/s), the ``load`` (N) and the supply pressure ``p_s`` (Pa)."""
    extending, retracting = gains(d, gain)
    return Feed(extending, retracting, root(d, p_s), load, half_share(d, p_s))


@inlined
def loaded_by(f: Feed, force: float) -> Feed:
    """Return what is fed to a piston with a ``force`` (N, against extension) beside its load."""
    return Feed(f.extending, f.retracting, f.root, f.load + force, f.half_share)


@inlined
def pressure(z: DriveState, d: Any, f: Feed) -> float:
    """Return the load pressure (Pa) of a piston, against extension."""
    return (f.load + z.force) * d.per_area


@inlined
def step(
    z: DriveState,
    d: Any,
    f: Feed,
    i: float,
    p_s: float,
    dt: float,
    loaded: bool,
    lossy: bool,
    sticky: bool,
    limited: bool,
    shut: float = 0.0,
    lined: bool = False,
    port: float = 0.0,
    line: float = 0.0,
) -> DriveState:
    """One plant step ``dt`` (s) under the valve's current ``i`` (A) at the supply pressure ``p_s`` (Pa).

    loaded  False leaves out what needs the load pressure: for lanes with `DRIVE_LOADED` 0, where it changes nothing
    lossy   False leaves out droop, leakage and round saturation, sticky: stiction, which take long: for lanes where
            these are neutral
    limited False leaves out the valve's lag, the LVDT's second one and the flow's limit, likewise
    lined   the valve feeds another piston, too: its ports have the load pressure ``port`` (Pa), and a line of the
            conductance ``line`` (m/s/Pa) leads to this one (`plant.unison`)
    """
    lagged = valve_lag.step(z.lagged, i, d.valve_share) if limited else i
    spool, spool_rate = valve_step(z.spool, z.spool_rate, lagged / d.rated, d.a11, d.a12, d.a21, d.a22)
    opening = valve_dead_band.step(spool, d.overlap) - shut
    gain = f.extending if opening > 0.0 else f.retracting
    force, off_centre, give = z.force, z.off_centre, z.give
    if loaded:
        p_load = pressure(z, d, f)
        felt = port if lined else p_load
        against = felt if opening > 0.0 else -felt
        speed = opening * (gain * math.sqrt(max(0.0, (p_s - against) * d.per_p_ref)))
        if lossy:
            speed = supply_pressure_droop.step(speed, p_s - against, d.supply_pressure_droop)
            speed = valve_flow_saturation.step(speed, d.valve_flow_saturation_limit, d.valve_flow_saturation_roundness)
            if lined:
                speed += line * (port - p_load)
            speed = internal_leakage.step(speed, p_load, d.oil_compressibility_drag * d.per_area, d.internal_leakage)
        elif limited:
            speed = valve_flow_saturation.corner(speed, d.valve_flow_saturation_limit)
        travel = 0.5 * (z.speed + speed) * dt
        level = d.piston_friction
        if sticky:
            level = piston_stiction.step(level, speed, d.piston_stiction_excess, d.piston_stiction_speed)
        r = piston_friction.off_middle(z.x, d.per_stroke)
        k = 1.0 - r * r
        force = piston_friction.step(z.force, travel, level, d.stiffness / k)
        moved = force - z.force
        off_centre, back = piston_friction.recentre(z.off_centre, r * moved, abs(travel) * d.stiffness * f.half_share)
        give = oil_compressibility.step(
            f.load, speed, d.oil_compressibility_compliance, d.oil_compressibility_drag, d.nominal
        )
        travel += (give - z.give) - (k * moved + r * back) / d.stiffness
    else:
        speed = opening * (gain * f.root)
        if limited:
            speed = valve_flow_saturation.corner(speed, d.valve_flow_saturation_limit)
        travel = 0.5 * (z.speed + speed) * dt
    x = min(max(z.x + travel, d.low), d.high)
    x_lvdt = z.x_lvdt + d.lvdt_factor * (x - z.x_lvdt)
    reading = lvdt_lag.step(z.reading, x_lvdt, d.lvdt_share) if limited else x_lvdt
    return DriveState(spool, spool_rate, speed, x, x_lvdt, lagged, force, off_centre, give, reading)
