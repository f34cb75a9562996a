"""The plant, part by part in the order of the signal flow, every effect in its place. The same code serves lockstep,
real time, diagnosis.

State ``s`` and parameters ``p`` are float64[n, lanes]; lane ``j`` is one plant, so that many parameter sets run side by
side. Units: SI.

Valve, piston and LVDT with their effects are `plant.drive`, an electromechanical actuator `plant.electromechanical`:
`drive_step` takes the one that the machine has. A vane stage with its effects is `plant.stem`. To add an
effect: its file in `plant.effects`, its name in `plant.places`, one call where it acts. Where all effects of a part are
neutral, the part takes a short way that holds the nominal equations only; both ways give the same bits then, which a
test checks.
"""

from __future__ import annotations

import math

import numpy as np

from plant import curve, drive, electromechanical, engine, lvdt, stem, unison
from plant.actuator import speed_factor, stroke_step
from plant.effect import T_REF
from plant.effects import CURVES, N_STATE, STATE, aero_load
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
    ring_angle_of_vane,
    vane_angle,
    vane_per_ring,
)
from plant.parameters import (
    ACTUATORS,
    DRIVE_EFFECTS,
    DRIVE_LOADED,
    FLOW_GAIN,
    GEOMETRY,
    KIND,
    LINE_CONDUCTANCE,
    LVDT_FACTOR,
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
    VANE_COUNT,
    VANE_EFFECTS,
    motor_steps,
)
from plant.places import (
    AERO_LOAD,
    BRISTLE,
    CURRENT,
    DRIVEN,
    FRICTION,
    GIVE,
    LAGGED,
    LINKAGE_FRICTION,
    N_R,
    POT,
    READING,
    RING,
    SPEED,
    SPOOL,
    SPOOL_RATE,
    X_LVDT,
    X,
)
from plant.play import play_step
from plant.sensors import quantise
from plant.valve import valve_step
from vaneloop.base.compiled import in_place, inlined

__all__ = [
    "N_STATE", "STATE", "SUBSTEPS", "TICK", "bent_reading", "drive_step", "driven_stroke", "measured_stroke",
    "place_rings", "rest", "rest_actuator", "rotor_step", "sample_lvdt", "stem_angle", "straightened", "true_stroke",
    "unloaded_ring_angle", "vane_step", "wake",
]  # fmt: skip

TICK = 1e-3  # s, one servo tick
SUBSTEPS = 10  # plant steps a tick: 10 kHz


@in_place
def rotor_step(s: np.ndarray, p: np.ndarray, j: int, n_dem: float, dt: float = TICK) -> None:
    """Engine: one step ``dt`` (s) towards the demand ``n_dem`` (%)."""
    lag_times = rise_times = 1.0
    if p[CURVES, j] != 0.0:
        n_dem += curve.bend(s, p, j, curve.ENGINE_ADDS)
        lag_times = curve.factor(s, p, j, curve.LAG_TIMES)
        rise_times = curve.factor(s, p, j, curve.RISE_TIMES)
    s[N_R, j] = engine.step(s[N_R, j], engine.prepare(p, j), n_dem, dt, lag_times, rise_times)


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
    """Actuator and LVDT: one step ``dt`` (s) under the current ``i_cmd`` (A), at ``n_r`` (%), ``p_s`` (Pa; of a
    hydraulic actuator), ``t_oil`` (degC, the actuator's temperature).

    The derived rows of ``p`` must be those of dt/substeps.
    """
    if p[DRIVE_EFFECTS, j] != 0.0:
        if p[KIND, j] != 0.0:
            _motor_step(s, p, j, i_cmd, n_r, t_oil, dt, substeps)
            return
        if p[ACTUATORS, j] != 0.0:
            _joined_step(s, p, j, i_cmd, n_r, p_s, t_oil, dt, substeps)
            return
        _drive_step(s, p, j, i_cmd, n_r, p_s, t_oil, dt, substeps)
        return
    target = i_cmd / p[RATED_CURRENT, j]
    a11, a12, a21, a22 = p[VALVE_A11, j], p[VALVE_A12, j], p[VALVE_A21, j], p[VALVE_A22, j]
    gain = p[FLOW_GAIN, j] * speed_factor(p_s, 0.0, p[P_REF, j])
    u, du, v, x, y = s[SPOOL, j], s[SPOOL_RATE, j], s[SPEED, j], s[X, j], s[X_LVDT, j]
    for _ in range(substeps):
        u, du = valve_step(u, du, target, a11, a12, a21, a22)
        v_before = v
        v = u * gain
        x = stroke_step(x, v_before, v, p[STROKE, j], dt / substeps)
        y += p[LVDT_FACTOR, j] * (x - y)
    s[SPOOL, j], s[SPOOL_RATE, j], s[SPEED, j], s[X, j], s[X_LVDT, j] = u, du, v, x, y


@in_place
def _drive_step(
    s: np.ndarray, p: np.ndarray, j: int, i_cmd: float, n_r: float, p_s: float, t_oil: float, dt: float, substeps: int
) -> None:
    """`drive_step` with every effect: what changes within the step is in `plant.drive`."""
    d, z = drive.prepare(p, j), drive.taken(s, j)
    y, i = drive.current(drive.remembered(s, j), d, i_cmd, True)
    gain, load = drive.flow_gain(d, t_oil), drive.load_of(d, n_r)
    if p[CURVES, j] != 0.0:
        i += curve.bend(s, p, j, curve.CURRENT_ADDS)
        gain *= curve.factor(s, p, j, curve.FLOW_TIMES)
        load += curve.bend(s, p, j, curve.LOAD_ADDS)
    feed = drive.feed(d, gain, load, p_s)
    h, loaded, shut = dt / substeps, p[DRIVE_LOADED, j] != 0.0, 0.0
    bent = p[CURVES, j] != 0.0 and curve.acts(p, j, curve.OPENING_ADDS)
    i_logged = s[curve.S_CURRENT, j]
    for _ in range(substeps):
        if bent:  # of the current that holds the spool where it comes to
            s[curve.S_CURRENT, j] = (z.spool + h * z.spool_rate) * d.rated
            shut = -curve.bend(s, p, j, curve.OPENING_ADDS) / d.rated
        z = drive.step(z, d, feed, i, p_s, h, loaded, True, True, True, shut)
    s[curve.S_CURRENT, j] = i_logged
    drive.stored(s, j, z)
    drive.told(s, j, y)


@in_place
def _motor_step(
    s: np.ndarray, p: np.ndarray, j: int, i_cmd: float, n_r: float, t_oil: float, dt: float, substeps: int
) -> None:
    """`drive_step` of an electromechanical actuator."""
    d, z = electromechanical.prepare(p, j, t_oil), electromechanical.taken(s, j)
    force = electromechanical.load_of(d, n_r)
    if p[CURVES, j] != 0.0:
        i_cmd += curve.bend(s, p, j, curve.CURRENT_ADDS)
        force += curve.bend(s, p, j, curve.LOAD_ADDS)
    load, friction = electromechanical.load_torques(d, force)
    many = motor_steps(dt / substeps)
    h = dt / (substeps * many)
    for _ in range(substeps):
        for _ in range(many):
            z = electromechanical.step(z, d, i_cmd, load, friction, h, True)
        z = electromechanical.sense(z, d)
    electromechanical.stored(s, j, z)


@in_place
def _joined_step(
    s: np.ndarray, p: np.ndarray, j: int, i_cmd: float, n_r: float, p_s: float, t_oil: float, dt: float, substeps: int
) -> None:
    """`drive_step` of two actuators, A in lane ``j`` and B in the next, on the same rings (`plant.unison`). Both valves
    get the current, or the one that both lanes have; each piston has half of the air's load.
    """
    d_a, d_b, z_a, z_b = drive.prepare(p, j), drive.prepare(p, j + 1), drive.taken(s, j), drive.taken(s, j + 1)
    y_a, i_a = drive.current(drive.remembered(s, j), d_a, i_cmd, True)
    y_b, i_b = drive.current(drive.remembered(s, j + 1), d_b, i_cmd, True)
    load = 0.5 * drive.load_of(d_a, n_r)
    feed_a = drive.feed(d_a, drive.flow_gain(d_a, t_oil), load, p_s)
    feed_b = drive.feed(d_b, drive.flow_gain(d_b, t_oil), load, p_s)
    c_a, c_b = 1.0 / d_a.stiffness, 1.0 / d_b.stiffness
    tie, h, line = unison.tie(s, p, j), dt / substeps, p[LINE_CONDUCTANCE, j]
    one_valve = line != 0.0
    for _ in range(substeps):
        w_a, w_b = unison.unjoined(z_a, d_a, load, h), unison.unjoined(z_b, d_b, load, h)
        f_a, f_b = unison.forces(tie, w_a, w_b, c_a, c_b)
        now_a, now_b = drive.loaded_by(feed_a, f_a), drive.loaded_by(feed_b, f_b)
        port = 0.5 * (drive.pressure(z_a, d_a, now_a) + drive.pressure(z_b, d_b, now_b))
        z_a = drive.step(z_a, d_a, now_a, i_a, p_s, h, True, True, True, True, 0.0, one_valve, port, line)
        z_b = drive.step(z_b, d_b, now_b, i_b, p_s, h, True, True, True, True, 0.0, one_valve, port, line)
    drive.stored(s, j, z_a)
    drive.stored(s, j + 1, z_b)
    drive.told(s, j, y_a)
    drive.told(s, j + 1, y_b)


@in_place
def rest(s: np.ndarray, p: np.ndarray, j: int, stroke: float, n_r: float, t_oil: float) -> None:
    """Put lane ``j`` to rest at ``stroke`` (m), speed ``n_r`` (%) and ``t_oil`` (degC), every ring in the middle of its
    play. What it remembered is forgotten.
    """
    for row in range(s.shape[0]):
        s[row, j] = 0.0
    s[N_R, j] = n_r
    s[X, j] = s[X_LVDT, j] = s[READING, j] = stroke
    curve.begin(s, p, j, t_oil)
    load = aero_load.step(n_r, p[AERO_LOAD, j])
    if p[CURVES, j] != 0.0:
        load += curve.bend(s, p, j, curve.LOAD_ADDS)
    if p[ACTUATORS, j] != 0.0:
        for row in range(s.shape[0]):
            s[row, j + 1] = 0.0
        load *= 0.5
        s[X, j + 1] = s[X_LVDT, j + 1] = s[READING, j + 1] = stroke
        rest_actuator(s, p, j + 1, 0.0, load, t_oil)
    rest_actuator(s, p, j, 0.0, load, t_oil)
    g = GEOMETRY
    c, d = crank(driven_stroke(s, p, j), p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])
    for k in range(int(p[VANE_COUNT, j])):
        s[RING + k, j] = s[DRIVEN + k, j] = ring = unloaded_ring_angle(s, p, j, k, c, d, n_r, t_oil)
        stage = stem.prepare(p, j, k)
        s[POT + k, j] = stem.reading(stage, vane_angle(ring, stage.ldp, stage.length), t_oil, 0.0)
    curve.begin(s, p, j, t_oil)  # once more, now that the potentiometers have their angles


@inlined
def rest_actuator(s: np.ndarray, p: np.ndarray, j: int, i_cmd: float, load: float, t_oil: float) -> None:
    """Let the actuator of lane ``j`` rest, a motor go at its steady speed, under ``i_cmd`` (A) and the ``load`` (N) at
    ``t_oil`` (degC): its state but for the stroke.
    """
    drive.rest(s, p, j, i_cmd, load)
    if p[KIND, j] != 0.0:
        electromechanical.rest(p, s, j, i_cmd, load, t_oil)


@in_place
def place_rings(s: np.ndarray, p: np.ndarray, j: int, angles: np.ndarray, n_r: float, t_oil: float) -> None:
    """Turn each ring of lane ``j``, as far as its play allows, to where its potentiometer gives the angle (rad; NaN =
    leave it) at speed ``n_r`` (%) and ``t_oil`` (degC). It rests there.

    `stem_angle` itself says what an angle reads as, so every effect counts: what the potentiometer's straight line
    leaves is taken off by Newton.
    """
    g = GEOMETRY
    c, d = crank(driven_stroke(s, p, j), p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])
    for k in range(int(p[VANE_COUNT, j])):
        if not math.isfinite(angles[k]):
            continue
        stage = stem.prepare(p, j, k)
        ring = ring_angle_of_vane((angles[k] - stage.offset) / stage.pot_gain, stage.ldp, stage.length)
        last = math.nan
        for _ in range(12):
            s[RING + k, j], s[DRIVEN + k, j], s[BRISTLE + k, j] = ring, ring, 0.0
            off = stem_angle(s, p, j, k, c, d, n_r, t_oil, 0.0) - angles[k]
            if abs(off) < 1e-12 or s[RING + k, j] == last:  # there, or at the end of its play
                break
            last = s[RING + k, j]
            ring = last - off / (stage.pot_gain * vane_per_ring(last, stage.ldp, stage.length))
        s[DRIVEN + k, j], s[BRISTLE + k, j] = s[RING + k, j], 0.0
        s[POT + k, j] = stem_angle(s, p, j, k, c, d, n_r, t_oil, 0.0)


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
    for k in range(int(p[VANE_COUNT, j])):
        if p[LINKAGE_FRICTION + k, j] == 0.0:
            s[BRISTLE + k, j], s[DRIVEN + k, j] = 0.0, s[RING + k, j]


@in_place
def measured_stroke(x: float, p: np.ndarray, j: int, t_oil: float) -> float:
    """Return what the LVDT makes of a resting stroke ``x`` (m): its effects without its lags."""
    return lvdt.reading(lvdt.prepare(p, j), x, t_oil)


@in_place
def true_stroke(reading: float, p: np.ndarray, j: int, t_oil: float) -> float:
    """Return the resting stroke (m) that the LVDT gives as ``reading`` (m): the inverse of `measured_stroke`, to 1e-9
    m.
    """
    return lvdt.true_stroke(lvdt.prepare(p, j), reading, t_oil)


@inlined
def driven_stroke(s: np.ndarray, p: np.ndarray, j: int) -> float:
    """The stroke (m) to which the piston drives the crank."""
    if p[CURVES, j] == 0.0:
        return s[X, j]
    return s[X, j] + curve.bend(s, p, j, curve.CRANK_ADDS)


@inlined
def bent_reading(x: float, s: np.ndarray, p: np.ndarray, j: int) -> float:
    """What the LVDT's curves make of its reading ``x`` (m)."""
    if p[CURVES, j] == 0.0:
        return x
    return curve.bent(x, curve.bend(s, p, j, curve.LVDT_TIMES), curve.bend(s, p, j, curve.LVDT_ADDS))


@inlined
def straightened(reading: float, s: np.ndarray, p: np.ndarray, j: int) -> float:
    """The inverse of `bent_reading` at the same signals."""
    if p[CURVES, j] == 0.0:
        return reading
    return curve.unbent(reading, curve.bend(s, p, j, curve.LVDT_TIMES), curve.bend(s, p, j, curve.LVDT_ADDS))


@in_place
def sample_lvdt(s: np.ndarray, p: np.ndarray, j: int, noise: float, t_oil: float = T_REF) -> float:
    """Return the LVDT's sample (m): lagged stroke plus ``noise`` (m), in steps of the converter."""
    x = s[X_LVDT, j]
    if p[DRIVE_EFFECTS, j] != 0.0:
        x = bent_reading(measured_stroke(s[READING, j], p, j, t_oil), s, p, j)
    return quantise(x + noise, p[LVDT_STEP, j])


@in_place
def unloaded_ring_angle(
    s: np.ndarray, p: np.ndarray, j: int, k: int, c: float, d: float, n_r: float, t_oil: float
) -> float:
    """Return the angle (rad) to which crank direction (c, d) drives the ring of stage ``k``, with B's of two actuators,
    before its play.
    """
    stage = stem.prepare(p, j, k)
    theta = ring_angle(c, d, stage.ax, stage.ay, stage.lb, stage.lc, stage.ld)
    if p[ACTUATORS, j] != 0.0:
        theta, _ = unison.ring_at(s, p, j, k, theta)
    return stem.drive(stage, theta, n_r, t_oil, 0.0, True)


@in_place
def stem_angle(
    s: np.ndarray, p: np.ndarray, j: int, k: int, c: float, d: float, n_r: float, t_oil: float, t: float
) -> float:
    """Turn ring ``k`` after the crank direction (c, d), after both cranks of two actuators, at time ``t`` (s); return
    the angle (rad) for its potentiometer, bias included.
    """
    stage = stem.prepare(p, j, k)
    theta = ring_angle(c, d, stage.ax, stage.ay, stage.lb, stage.lc, stage.ld)
    twist = 0.0
    if p[ACTUATORS, j] != 0.0:
        theta, twist = unison.ring_at(s, p, j, k, theta)
    theta, play = stem.drive(stage, theta, n_r, t_oil, t, True), 0.0
    if p[CURVES, j] != 0.0:
        theta += curve.bend(s, p, j, curve.RING_ADDS) + curve.bend(s, p, j, curve.RING_ADDS + 1 + k)
        play = curve.bend(s, p, j, curve.PLAY_ADDS) + curve.bend(s, p, j, curve.PLAY_ADDS + 1 + k)
    z, ring = stem.follow(stem.taken(s, j, k), stage, theta, t_oil, t, stage.linkage_friction != 0.0, play)
    stem.stored(s, j, k, z)
    if twist != 0.0:
        ring += twist
    reading = stem.reading(stage, vane_angle(ring, stage.ldp, stage.length), t_oil, t)
    if p[CURVES, j] != 0.0:
        by, adds = curve.bend(s, p, j, curve.POT_TIMES + 1 + k), curve.bend(s, p, j, curve.POT_ADDS + 1 + k)
        reading = curve.bent(reading, by, adds)
    return reading


@in_place
def vane_step(s: np.ndarray, p: np.ndarray, j: int, n_r: float, t_oil: float, t: float = 0.0) -> None:
    """Linkage, play and stem potentiometers: one step at the present stroke, at time ``t`` (s) from the start of the
    log.

    How long the step is stands in the derived rows of ``p`` (`plant.parameters.derive`, its tick).
    """
    g, n = GEOMETRY, int(p[VANE_COUNT, j])
    if p[VANE_EFFECTS, j] != 0.0:
        c, d = crank(driven_stroke(s, p, j), p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])
        for k in range(n):
            vane = stem_angle(s, p, j, k, c, d, n_r, t_oil, t)
            s[POT + k, j] += p[POT_SHARE + k, j] * (vane - s[POT + k, j])
        return
    c, d = crank(s[X, j], p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])
    for k in range(n):
        o = g + N_CRANK + k * N_PER_STAGE
        drive = ring_angle(c, d, p[o + G_AX, j], p[o + G_AY, j], p[o + G_LB, j], p[o + G_LC, j], p[o + G_LD, j])
        s[RING + k, j] = play_step(s[RING + k, j], drive, p[PLAY + k, j])
        vane = vane_angle(s[RING + k, j], p[o + G_LDP, j], p[o + G_L, j]) + p[POT_BIAS + k, j]
        s[POT + k, j] += p[POT_FACTOR, j] * (vane - s[POT + k, j])
