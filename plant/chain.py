"""The plant, part by part in the order of the signal flow, every effect in its place. The same code serves lockstep,
real time, diagnosis.

State ``s`` and parameters ``p`` are float64[n, lanes]; lane ``j`` is one plant, so that many parameter sets run side by
side. Units: SI.

To add an effect: its file in `plant.effects`, one constant below, one call where it acts. Where all effects of a part
are neutral, the part takes a short way that holds the nominal equations only; both ways give the same bits then, which
a test checks.
"""

from __future__ import annotations

import math

import numpy as np

from plant.actuator import speed_factor, stroke_step
from plant.effect import T_REF
from plant.effects import (
    N_STATE,
    ROW,
    STATE,
    STATE_ROW,
    acceleration_limit_error,
    aero_load,
    crank_length_error,
    end_stop_shift,
    internal_leakage,
    link_length_error,
    linkage_backlash,
    linkage_compliance,
    linkage_friction,
    linkage_wear,
    lvdt_bias,
    lvdt_gain,
    lvdt_lag,
    lvdt_nonlinearity,
    lvdt_thermal_drift,
    oil_compressibility,
    oil_viscosity,
    piston_friction,
    piston_stiction,
    pot_bias,
    pot_gain,
    ring_eccentricity,
    rotor_lag_error,
    supply_pressure_droop,
    thermal_growth,
    valve_dead_band,
    valve_flow_saturation,
    valve_gain_asymmetry,
    valve_hysteresis,
    valve_lag,
    valve_null_bias,
)
from plant.engine import engine_step
from plant.layout import NOMINAL_STATE
from plant.linkage import (
    G_AX,
    G_AY,
    G_L,
    G_LB,
    G_LC,
    G_LD,
    G_LDP,
    G_LE,
    G_LX0,
    G_X1,
    G_Y1,
    N_CRANK,
    N_PER_STAGE,
    crank,
    ring_angle,
    vane_angle,
)
from plant.parameters import (
    ACCELERATION,
    AREA,
    DECELERATION,
    DRIVE_EFFECTS,
    DRIVE_LOADED,
    FLOW_GAIN,
    GEOMETRY,
    LAG,
    LVDT_FACTOR,
    LVDT_SHARE,
    LVDT_STEP,
    P_REF,
    PLAY,
    POT_BIAS,
    POT_FACTOR,
    POT_SHARE,
    RATED_CURRENT,
    STROKE,
    VALVE_A11,
    VALVE_A12,
    VALVE_A21,
    VALVE_A22,
    VALVE_SHARE,
    VANE_EFFECTS,
)
from plant.play import play_step
from plant.sensors import quantise
from plant.valve import valve_step
from vaneloop.base.compiled import in_place, inlined

__all__ = [
    "N_STATE",
    "STATE",
    "SUBSTEPS",
    "TICK",
    "drive_step",
    "drive_substep",
    "measured_stroke",
    "rotor_step",
    "sample_lvdt",
    "stem_angle",
    "straight_reading",
    "true_stroke",
    "unloaded_ring_angle",
    "vane_step",
    "wake",
]

TICK = 1e-3  # s, one servo tick
SUBSTEPS = 10  # plant steps a tick: 10 kHz

(N_R, SPOOL, SPOOL_RATE, SPEED, X, X_LVDT, RING, _, _, POT, _, _) = range(len(NOMINAL_STATE))

# ---- the effects' first rows in p, in the order of the signal flow
CAN_DELAY = ROW["can_delay"]
FRAME_HOLD = ROW["frame_hold"]
SCHEDULE_ERROR = ROW["schedule_error"]
TREND_THRESHOLD_ERROR = ROW["trend_threshold_error"]
CONTROLLER_GAIN_ERROR = ROW["controller_gain_error"]
ROTOR_LAG_ERROR = ROW["rotor_lag_error"]
ACCELERATION_LIMIT_ERROR = ROW["acceleration_limit_error"]
VALVE_NULL_BIAS = ROW["valve_null_bias"]
VALVE_HYSTERESIS = ROW["valve_hysteresis"]  # width, spread
VALVE_LAG = ROW["valve_lag"]  # used through VALVE_SHARE
VALVE_DEAD_BAND = ROW["valve_dead_band"]
VALVE_GAIN_ASYMMETRY = ROW["valve_gain_asymmetry"]
OIL_VISCOSITY = ROW["oil_viscosity"]
AERO_LOAD = ROW["aero_load"]
SUPPLY_PRESSURE_DROOP = ROW["supply_pressure_droop"]
VALVE_FLOW_SATURATION = ROW["valve_flow_saturation"]
INTERNAL_LEAKAGE = ROW["internal_leakage"]
PISTON_STICTION = ROW["piston_stiction"]  # excess, speed
PISTON_FRICTION = ROW["piston_friction"]
OIL_COMPRESSIBILITY = ROW["oil_compressibility"]  # compliance, drag
END_STOP_SHIFT = ROW["end_stop_shift"]
LVDT_LAG_ERROR = ROW["lvdt_lag"]  # used through LVDT_SHARE
LVDT_NONLINEARITY = ROW["lvdt_nonlinearity"]  # amplitude, cubic
LVDT_GAIN = ROW["lvdt_gain"]
LVDT_THERMAL_DRIFT = ROW["lvdt_thermal_drift"]
LVDT_BIAS = ROW["lvdt_bias"]
CRANK_LENGTH_ERROR = ROW["crank_length_error"]  # here and below: one row a vane stage
LINK_LENGTH_ERROR = ROW["link_length_error"]
RING_ECCENTRICITY = ROW["ring_eccentricity"]  # three amplitudes, phase
THERMAL_GROWTH = ROW["thermal_growth"]
LINKAGE_COMPLIANCE = ROW["linkage_compliance"]  # one row for all
LINKAGE_BACKLASH = ROW["linkage_backlash"]
LINKAGE_WEAR = ROW["linkage_wear"]
LINKAGE_FRICTION = ROW["linkage_friction"]  # three widths, distance
POT_GAIN = ROW["pot_gain"]
POT_LAG_ERROR = ROW["pot_lag"]  # used through POT_SHARE
POT_BIAS_ERROR = ROW["pot_bias"]

# ---- and in s
CURRENT = STATE_ROW["valve_hysteresis"]  # four of A: the valve's memory
LAGGED = STATE_ROW["valve_lag"]  # A, behind the valve's lag
FRICTION = STATE_ROW["piston_friction"]  # N: force, off centre
GIVE = STATE_ROW["oil_compressibility"]  # m
READING = STATE_ROW["lvdt_lag"]  # m, stroke behind both lags of the LVDT
BRISTLE = STATE_ROW["linkage_friction"]  # three of -1..1
DRIVEN = BRISTLE + 3  # rad, three rings at the last tick, as friction saw them


@in_place
def rotor_step(s: np.ndarray, p: np.ndarray, j: int, n_dem: float, dt: float = TICK) -> None:
    """Engine: one step ``dt`` (s) towards the demand ``n_dem`` (%)."""
    lag = rotor_lag_error.step(p[LAG, j], p[ROTOR_LAG_ERROR, j])
    acceleration = acceleration_limit_error.step(p[ACCELERATION, j], p[ACCELERATION_LIMIT_ERROR, j])
    s[N_R, j] = engine_step(s[N_R, j], n_dem, lag, acceleration, p[DECELERATION, j], dt)


@in_place
def drive_step(
    s: np.ndarray,
    p: np.ndarray,
    j: int,
    i_cmd: float,
    n_r: float,
    p_s: float,
    t_oil: float,
    dt: float = TICK,
    substeps: int = SUBSTEPS,
) -> None:
    """Valve, actuator and LVDT: one step ``dt`` (s) under the current ``i_cmd`` (A), at ``n_r`` (%), ``p_s`` (Pa),
    ``t_oil`` (degC).

    The derived rows of ``p`` must be those of dt/substeps.
    """
    if p[DRIVE_EFFECTS, j] != 0.0:
        _drive_step(s, p, j, i_cmd, n_r, p_s, t_oil, dt, substeps)
        return
    target = i_cmd / p[RATED_CURRENT, j]
    a11, a12, a21, a22 = p[VALVE_A11, j], p[VALVE_A12, j], p[VALVE_A21, j], p[VALVE_A22, j]
    out = p[FLOW_GAIN, j] * speed_factor(p_s, 0.0, p[P_REF, j])
    back = p[FLOW_GAIN, j] * speed_factor(p_s, 0.0, p[P_REF, j])
    u, du, v, x, y = s[SPOOL, j], s[SPOOL_RATE, j], s[SPEED, j], s[X, j], s[X_LVDT, j]
    for _ in range(substeps):
        u, du = valve_step(u, du, target, a11, a12, a21, a22)
        v_before = v
        v = u * (out if u > 0.0 else back)
        x = stroke_step(x, v_before, v, p[STROKE, j], dt / substeps)
        y += p[LVDT_FACTOR, j] * (x - y)
    s[SPOOL, j], s[SPOOL_RATE, j], s[SPEED, j], s[X, j], s[X_LVDT, j] = u, du, v, x, y


@inlined
def drive_substep(
    u: float, du: float, v: float, x: float, y: float, lagged: float, z: float, off: float, give: float, reading: float,
    i: float, rated: float, share: float, a11: float, a12: float, a21: float, a22: float, overlap: float,
    extending: float, retracting: float, root: float, p_s: float, per_p_ref: float, per_area: float, load: float,
    droop: float,
    limit: float, roundness: float,
    leakage: float, force: float, excess: float, stribeck: float, stiffness: float, compliance: float, drag: float,
    per_stroke: float, low: float, high: float, lvdt_factor: float, lvdt_share: float, dt: float,
    loaded: bool, lossy: bool, sticky: bool,
) -> tuple[float, float, float, float, float, float, float, float, float, float]:  # fmt: skip
    """One plant step ``dt`` of spool, oil, piston and LVDT with every effect; state in, state out.

    loaded  False leaves out what needs the load pressure: for lanes with `DRIVE_LOADED` 0, where it changes nothing
    lossy   False leaves out droop, leakage and round saturation, sticky: stiction, which take long: for lanes where
            these are neutral
    """
    lagged = valve_lag.step(lagged, i, share)
    u, du = valve_step(u, du, lagged / rated, a11, a12, a21, a22)
    opening = valve_dead_band.step(u, overlap)
    gain = extending if opening > 0.0 else retracting
    v_before = v
    if loaded:
        p_load = (load + z) * per_area
        against = p_load if opening > 0.0 else -p_load
        v = opening * (gain * math.sqrt(max(0.0, (p_s - against) * per_p_ref)))
        if lossy:
            v = supply_pressure_droop.step(v, p_s - against, droop)
            v = valve_flow_saturation.step(v, limit, roundness)
            v = internal_leakage.step(v, p_load, drag * per_area, leakage)
        else:
            v = valve_flow_saturation.corner(v, limit)
        travel = 0.5 * (v_before + v) * dt
        level = piston_stiction.step(force, v, excess, stribeck) if sticky else force
        z_before, give_before = z, give
        r = piston_friction.off_middle(x, per_stroke)
        k = 1.0 - r * r
        z = piston_friction.step(z, travel, level, stiffness / k)
        off, back = piston_friction.recentre(off, r * (z - z_before), abs(travel) * stiffness * (0.5 * per_area / p_s))
        give = oil_compressibility.step(load, v, compliance, drag)
        travel += (give - give_before) - (k * (z - z_before) + r * back) / stiffness
    else:
        v = valve_flow_saturation.corner(opening * (gain * root), limit)
        travel = 0.5 * (v_before + v) * dt
    x = min(max(x + travel, low), high)
    y += lvdt_factor * (x - y)
    reading = lvdt_lag.step(reading, y, lvdt_share)
    return u, du, v, x, y, lagged, z, off, give, reading


@in_place
def _drive_step(
    s: np.ndarray, p: np.ndarray, j: int, i_cmd: float, n_r: float, p_s: float, t_oil: float, dt: float, substeps: int
) -> None:
    """`drive_step` with every effect: what changes within the step is in `drive_substep`."""
    i = valve_null_bias.step(i_cmd, p[VALVE_NULL_BIAS, j])
    y1, y2, y3, y4 = s[CURRENT, j], s[CURRENT + 1, j], s[CURRENT + 2, j], s[CURRENT + 3, j]
    y1, y2, y3, y4 = valve_hysteresis.step(y1, y2, y3, y4, i, p[VALVE_HYSTERESIS, j], p[VALVE_HYSTERESIS + 1, j])
    i = valve_hysteresis.mean(y1, y2, y3, y4)
    gain = oil_viscosity.step(p[FLOW_GAIN, j], t_oil, p[OIL_VISCOSITY, j])
    extending, retracting = valve_gain_asymmetry.step(gain, p[VALVE_GAIN_ASYMMETRY, j])
    load = aero_load.step(n_r, p[AERO_LOAD, j])
    low, high = end_stop_shift.step(p[STROKE, j], p[END_STOP_SHIFT, j])
    overlap = p[VALVE_DEAD_BAND, j] / p[RATED_CURRENT, j]
    root = speed_factor(p_s, 0.0, p[P_REF, j])
    per_p_ref, per_area = 1.0 / p[P_REF, j], 1.0 / p[AREA, j]
    stiffness = 1.0 / (oil_compressibility.NOMINAL + p[OIL_COMPRESSIBILITY, j])
    u, du, v, x, y = s[SPOOL, j], s[SPOOL_RATE, j], s[SPEED, j], s[X, j], s[X_LVDT, j]
    lagged, z, off, give, reading = s[LAGGED, j], s[FRICTION, j], s[FRICTION + 1, j], s[GIVE, j], s[READING, j]
    for _ in range(substeps):
        u, du, v, x, y, lagged, z, off, give, reading = drive_substep(
            u, du, v, x, y, lagged, z, off, give, reading,
            i, p[RATED_CURRENT, j], p[VALVE_SHARE, j], p[VALVE_A11, j], p[VALVE_A12, j], p[VALVE_A21, j],
            p[VALVE_A22, j],
            overlap, extending, retracting, root, p_s, per_p_ref, per_area, load, p[SUPPLY_PRESSURE_DROOP, j],
            p[VALVE_FLOW_SATURATION, j], p[VALVE_FLOW_SATURATION + 1, j], p[INTERNAL_LEAKAGE, j],
            p[PISTON_FRICTION, j], p[PISTON_STICTION, j], p[PISTON_STICTION + 1, j],
            stiffness, p[OIL_COMPRESSIBILITY, j], p[OIL_COMPRESSIBILITY + 1, j], 1.0 / p[STROKE, j], low, high,
            p[LVDT_FACTOR, j], p[LVDT_SHARE, j], dt / substeps, p[DRIVE_LOADED, j] != 0.0, True, True,
        )  # fmt: skip
    s[SPOOL, j], s[SPOOL_RATE, j], s[SPEED, j], s[X, j], s[X_LVDT, j] = u, du, v, x, y
    s[CURRENT, j], s[CURRENT + 1, j], s[CURRENT + 2, j], s[CURRENT + 3, j] = y1, y2, y3, y4
    s[LAGGED, j], s[FRICTION, j], s[FRICTION + 1, j], s[GIVE, j], s[READING, j] = lagged, z, off, give, reading


@in_place
def wake(s: np.ndarray, p: np.ndarray, j: int, i_cmd: float) -> None:
    """Set what only the effects remember to where it would be had they been followed: before ``p`` changes while the
    plant runs.

    i_cmd  A, the current of the last tick
    """
    if p[DRIVE_EFFECTS, j] == 0.0:
        for q in range(4):
            s[CURRENT + q, j] = i_cmd
        s[LAGGED, j], s[FRICTION, j], s[FRICTION + 1, j], s[GIVE, j], s[READING, j] = i_cmd, 0.0, 0.0, 0.0, s[X_LVDT, j]
    for k in range(3):
        if p[LINKAGE_FRICTION + k, j] == 0.0:
            s[BRISTLE + k, j], s[DRIVEN + k, j] = 0.0, s[RING + k, j]


@in_place
def measured_stroke(x: float, p: np.ndarray, j: int, t_oil: float) -> float:
    """Return what the LVDT makes of a resting stroke ``x`` (m): its effects without its lags."""
    x = lvdt_nonlinearity.step(x, p[STROKE, j], p[LVDT_NONLINEARITY, j], p[LVDT_NONLINEARITY + 1, j])
    return straight_reading(x, p[LVDT_GAIN, j], p[LVDT_THERMAL_DRIFT, j], p[LVDT_BIAS, j], t_oil)


@inlined
def straight_reading(x: float, gain: float, drift: float, bias: float, t_oil: float) -> float:
    """`measured_stroke` behind the windings' curve."""
    return lvdt_bias.step(lvdt_thermal_drift.step(lvdt_gain.step(x, gain), t_oil, drift), bias)


@in_place
def true_stroke(reading: float, p: np.ndarray, j: int, t_oil: float) -> float:
    """Return the resting stroke (m) that the LVDT gives as ``reading`` (m): the inverse of `measured_stroke`, to 1e-9
    m.
    """
    off = straight_reading(0.0, p[LVDT_GAIN, j], p[LVDT_THERMAL_DRIFT, j], p[LVDT_BIAS, j], t_oil)
    x = target = (reading - off) / p[LVDT_GAIN, j]
    sine, cubic = p[LVDT_NONLINEARITY, j], p[LVDT_NONLINEARITY + 1, j]
    if sine != 0.0 or cubic != 0.0:
        for _ in range(12):  # Newton; the error's slope is below 0.7 within the stroke
            e = lvdt_nonlinearity.step(x, p[STROKE, j], sine, cubic) - target
            if abs(e) < 1e-10:
                break
            x -= e / max(lvdt_nonlinearity.slope(x, p[STROKE, j], sine, cubic), 0.2)
    return x


@in_place
def sample_lvdt(s: np.ndarray, p: np.ndarray, j: int, noise: float, t_oil: float = T_REF) -> float:
    """Return the LVDT's sample (m): lagged stroke plus ``noise`` (m), in steps of the converter."""
    x = s[X_LVDT, j]
    if p[DRIVE_EFFECTS, j] != 0.0:
        x = measured_stroke(s[READING, j], p, j, t_oil)
    return quantise(x + noise, p[LVDT_STEP, j])


@in_place
def unloaded_ring_angle(p: np.ndarray, j: int, k: int, c: float, d: float, n_r: float, t_oil: float) -> float:
    """Return the angle (rad) to which crank direction (c, d) drives the ring of stage ``k``, before its play."""
    o = GEOMETRY + N_CRANK + k * N_PER_STAGE
    lb = crank_length_error.step(p[o + G_LB, j], p[CRANK_LENGTH_ERROR + k, j])
    lc = link_length_error.step(p[o + G_LC, j], p[LINK_LENGTH_ERROR + k, j])
    theta = ring_angle(c, d, p[o + G_AX, j], p[o + G_AY, j], lb, lc, p[o + G_LD, j])
    theta = ring_eccentricity.step(theta, p[RING_ECCENTRICITY + k, j], p[RING_ECCENTRICITY + 3, j])
    theta = thermal_growth.step(theta, t_oil, p[THERMAL_GROWTH + k, j], p[o + G_L, j] / p[o + G_LDP, j])
    return linkage_compliance.step(theta, n_r, p[LINKAGE_COMPLIANCE, j])


@in_place
def stem_angle(
    s: np.ndarray, p: np.ndarray, j: int, k: int, c: float, d: float, n_r: float, t_oil: float, t: float
) -> float:
    """Turn ring ``k`` after the crank direction (c, d) at time ``t`` (s); return the angle (rad) for its potentiometer,
    bias included.
    """
    o = GEOMETRY + N_CRANK + k * N_PER_STAGE
    ratio = p[o + G_L, j] / p[o + G_LDP, j]
    drive = unloaded_ring_angle(p, j, k, c, d, n_r, t_oil)
    play = linkage_backlash.step(p[PLAY + k, j], p[LINKAGE_BACKLASH + k, j], ratio)
    play = linkage_wear.step(play, p[LINKAGE_WEAR + k, j], ratio, t)
    ring = play_step(s[RING + k, j], drive, play)
    s[RING + k, j] = ring
    if p[LINKAGE_FRICTION + k, j] != 0.0:
        bristle = linkage_friction.step(s[BRISTLE + k, j], ring - s[DRIVEN + k, j], p[LINKAGE_FRICTION + 3, j])
        s[BRISTLE + k, j] = bristle
        s[DRIVEN + k, j] = ring
        ring = linkage_friction.loop(ring, bristle, p[LINKAGE_FRICTION + k, j], ratio)
    vane = vane_angle(ring, p[o + G_LDP, j], p[o + G_L, j])
    vane = pot_gain.step(vane, p[POT_GAIN + k, j])
    return vane + pot_bias.step(p[POT_BIAS + k, j], p[POT_BIAS_ERROR + k, j])


@in_place
def vane_step(s: np.ndarray, p: np.ndarray, j: int, n_r: float, t_oil: float, t: float = 0.0) -> None:
    """Linkage, play and stem potentiometers: one step at the present stroke, at time ``t`` (s) from the start of the
    log.

    How long the step is stands in the derived rows of ``p`` (`plant.parameters.derive`, its tick).
    """
    g = GEOMETRY
    c, d = crank(s[X, j], p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])
    if p[VANE_EFFECTS, j] != 0.0:
        for k in range(3):
            vane = stem_angle(s, p, j, k, c, d, n_r, t_oil, t)
            s[POT + k, j] += p[POT_SHARE + k, j] * (vane - s[POT + k, j])
        return
    for k in range(3):
        o = g + N_CRANK + k * N_PER_STAGE
        drive = ring_angle(c, d, p[o + G_AX, j], p[o + G_AY, j], p[o + G_LB, j], p[o + G_LC, j], p[o + G_LD, j])
        s[RING + k, j] = play_step(s[RING + k, j], drive, p[PLAY + k, j])
        vane = vane_angle(s[RING + k, j], p[o + G_LDP, j], p[o + G_L, j]) + p[POT_BIAS + k, j]
        s[POT + k, j] += p[POT_FACTOR, j] * (vane - s[POT + k, j])
