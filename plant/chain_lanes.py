"""The plant of the closed loop for lanes side by side: one tick of `plant.chain`, with the same step functions.

A block holds the lanes of one way through each part: without effects, with effects, with a load on the actuator. Units:
SI, angles rad, speeds %.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from plant import chain, drive, lanes, linkage_lanes, stem
from plant.actuator import speed_factor
from plant.effects import (
    CURVES,
    EFFECTS,
    acceleration_limit_error,
    aero_load,
    lvdt_nonlinearity,
    oil_viscosity,
    rotor_lag_error,
    valve_gain_asymmetry,
    valve_hysteresis,
    valve_null_bias,
)
from plant.engine import engine_step
from plant.linkage import G_LE, G_LX0, G_X1, G_Y1
from plant.parameters import (
    ACCELERATION,
    DECELERATION,
    DRIVE_EFFECTS,
    DRIVE_LOADED,
    GEOMETRY,
    KIND,
    LAG,
    LVDT_STEP,
    POT_SHARE,
    STROKE,
    VANE_EFFECTS,
)
from plant.places import ACCELERATION_LIMIT_ERROR, CURRENT, LVDT_NONLINEARITY, N_R, POT, ROTOR_LAG_ERROR
from plant.sensors import quantise
from plant.stages.blocks import elsewhere
from plant.stages.hydraulic_blocks import Around, around
from vaneloop.base.compiled import in_place, inlined
from vaneloop.base.vanes import MOST

__all__ = ["EFFECTS_CALLED", "W", "feed", "fields", "move", "place", "sample_lvdt", "way"]

W = 64  # lanes in a block: with fewer, one chain of operations waits for itself
HALF = chain.SUBSTEPS // 2  # plant steps that a lane takes at once, its state in registers
DT = chain.TICK / chain.SUBSTEPS

# effects that the blocks have; those of the demand are in the calibration as it is flashed (`hil.loop.tick.flashed`)
EFFECTS_CALLED = (
    "acceleration_limit_error", "aero_load", "controller_gain_error", "crank_length_error", "end_stop_shift",
    "internal_leakage", "link_length_error", "linkage_backlash", "linkage_compliance", "linkage_friction",
    "linkage_wear", "lvdt_bias", "lvdt_gain", "lvdt_lag", "lvdt_nonlinearity", "lvdt_thermal_drift",
    "oil_compressibility", "oil_viscosity", "piston_friction", "piston_stiction", "pot_bias", "pot_gain", "pot_lag",
    "ring_eccentricity", "rotor_lag_error", "schedule_error", "supply_pressure_droop", "thermal_growth",
    "trend_threshold_error", "valve_dead_band", "valve_flow_saturation", "valve_gain_asymmetry", "valve_hysteresis",
    "valve_lag", "valve_null_bias",
)  # fmt: skip
_SITES = frozenset(e.site for e in EFFECTS.values())


class _EngineAndLvdt(NamedTuple):
    """What a lane needs of its engine (lag, limits) and of its LVDT (travel, bend, step of the converter), beside
    `drive.Drive` and `hydraulic_blocks.Around`.
    """

    lag: float
    acceleration: float
    deceleration: float
    travel: float
    sine: float
    cubic: float
    lvdt_step: float


# n_r: the engine's speed; i, target: current (A) and its share of the rated one over a tick; m1 to m4: A, of the
# valve's hysteresis; p_s, t_oil: Pa, degC; c, d: the crank's direction
_MORE = ("n_r", "i", "target", "m1", "m2", "m3", "m4", "p_s", "t_oil", "c", "d")
_OF_STAGE = ("pot", "pot_share", "lever", "span", "half", "theta")

_state, _put_state = lanes.getter(drive.DriveState), lanes.putter(drive.DriveState)
_drive, _put_drive = lanes.getter(drive.Drive), lanes.putter(drive.Drive)
_share_drive = lanes.getter(drive.Drive, rated=1.0)  # for currents that are shares of the rated one
_feed, _put_feed = lanes.getter(drive.Feed), lanes.putter(drive.Feed)
_put_around, _put_others = lanes.putter(Around), lanes.putter(_EngineAndLvdt)
_crank, _put_crank = lanes.getter(linkage_lanes.Crank), lanes.putter(linkage_lanes.Crank)
_stem, _put_stem = lanes.getter(stem.Stem, "k", "stem_"), lanes.putter(stem.Stem, "k", "stem_")
_stem_state = lanes.getter(stem.StemState, "k", "stem_")
_put_stem_state = lanes.putter(stem.StemState, "k", "stem_")


def fields() -> list[tuple[str, Any, tuple[int, ...]]]:
    """Fields of a block: each a row of `W` lanes, or one for each of `MOST` stages."""
    kinds: tuple[Any, ...] = (drive.DriveState, drive.Drive, drive.Feed, Around, _EngineAndLvdt, linkage_lanes.Crank)
    once = [*(n for kind in kinds for n in kind._fields), *_MORE]
    of_stage = [*(f"stem_{n}" for n in (*stem.StemState._fields, *stem.Stem._fields)), *_OF_STAGE]
    return [*((n, np.float64, (W,)) for n in once), *((n, np.float64, (MOST, W)) for n in of_stage)]


def way(p: np.ndarray) -> tuple[int, bool] | None:
    """Return the way of a machine (its p) through a block: through the drive (0 without effects, 1 with them, 2 with a
    load too), and whether its linkage has effects. None: it goes through no block.
    """
    if p[KIND, 0] != 0.0 or p[CURVES, 0] != 0.0 or elsewhere(p, _SITES, EFFECTS_CALLED)[0]:
        return None
    drive_way = 0 if p[DRIVE_EFFECTS, 0] == 0.0 else 1 if p[DRIVE_LOADED, 0] == 0.0 else 2
    return drive_way, bool(p[VANE_EFFECTS, 0] != 0.0)


@in_place
def place(b: Any, j: int, p: np.ndarray, s: np.ndarray, stages: int) -> None:
    """Put a machine, its parameters and its state (one lane each), into lane ``j`` of a block."""
    g = GEOMETRY
    _put_state(b, j, drive.taken(s, 0))
    _put_drive(b, j, drive.prepare(p, 0))
    others = _EngineAndLvdt(
        rotor_lag_error.step(p[LAG, 0], p[ROTOR_LAG_ERROR, 0]),
        acceleration_limit_error.step(p[ACCELERATION, 0], p[ACCELERATION_LIMIT_ERROR, 0]),
        p[DECELERATION, 0],
        p[STROKE, 0],
        p[LVDT_NONLINEARITY, 0],
        p[LVDT_NONLINEARITY + 1, 0],
        p[LVDT_STEP, 0],
    )
    _put_others(b, j, others)
    _put_around(b, j, around(p, 0))
    _put_crank(b, j, linkage_lanes.crank_numbers(p[g + G_LX0, 0], p[g + G_X1, 0], p[g + G_Y1, 0], p[g + G_LE, 0]))
    b.n_r[j] = s[N_R, 0]
    b.m1[j], b.m2[j], b.m3[j], b.m4[j] = s[CURRENT, 0], s[CURRENT + 1, 0], s[CURRENT + 2, 0], s[CURRENT + 3, 0]
    for k in range(stages):
        d = stem.prepare(p, 0, k)
        _put_stem(b, k, j, d)
        _put_stem_state(b, k, j, stem.taken(s, 0, k))
        b.pot[k, j], b.pot_share[k, j], b.lever[k, j] = s[POT + k, 0], p[POT_SHARE + k, 0], d.ldp / d.length
        b.span[k, j], b.half[k, j] = linkage_lanes.ring_numbers(d.lc, d.ld)


@inlined
def feed(b: Any, n: int, drive_way: int) -> None:
    """What the supply and the load give the drive of ``n`` lanes, while ``b.p_s``, ``b.t_oil`` and ``b.heard`` stay."""
    lanes.wide_vectors()
    for j in range(n):
        b.root[j] = speed_factor(b.p_s[j], 0.0, b.p_ref[j])
        b.extending[j] = b.retracting[j] = b.flow[j]
    if drive_way > 0:
        for j in range(n):
            gain = oil_viscosity.step(b.flow[j], b.t_oil[j], b.viscosity[j])
            b.extending[j], b.retracting[j] = valve_gain_asymmetry.step(gain, b.asymmetry[j])
            b.load[j] = aero_load.step(b.heard[j], b.aero[j])
            b.half_share[j] = 0.5 * b.per_area[j] / b.p_s[j]


@inlined
def sample_lvdt(b: Any, n: int, drive_way: int, noise: float) -> None:
    """Put the LVDTs' samples (m) into ``b.in_x_lvdt``, with ``noise`` (standard normal) times ``b.sigma_lvdt``."""
    lanes.wide_vectors()
    if drive_way == 0:
        for j in range(n):
            b.in_x_lvdt[j] = quantise(b.x_lvdt[j] + b.sigma_lvdt[j] * noise, b.lvdt_step[j])
        return
    for j in range(n):
        b.in_x_lvdt[j] = lvdt_nonlinearity.step(b.reading[j], b.travel[j], b.sine[j], b.cubic[j])
    for j in range(n):
        x = chain.straight_reading(b.in_x_lvdt[j], b.lvdt_gain[j], b.lvdt_drift[j], b.lvdt_bias[j], b.t_oil[j])
        b.in_x_lvdt[j] = quantise(x + b.sigma_lvdt[j] * noise, b.lvdt_step[j])


@inlined
def move(b: Any, n: int, stages: int, drive_way: int, vane_effects: bool, t: float) -> None:
    """Move ``n`` lanes on by one tick, to ``t`` (s), under the currents ``b.z_i_cmd`` (A)."""
    lanes.wide_vectors()
    for j in range(n):
        b.n_r[j] = engine_step(b.n_r[j], b.n_dem[j], b.lag[j], b.acceleration[j], b.deceleration[j], chain.TICK)
    if drive_way == 0:
        for j in range(n):
            b.target[j] = b.z_i_cmd[j] / b.rated[j]
        for _ in range(chain.SUBSTEPS // HALF):
            for j in range(n):
                f = drive.Feed(b.flow[j], b.flow[j], b.root[j], 0.0, 0.0)
                d, z = _share_drive(b, j), _state(b, j)
                for _ in range(HALF):
                    z = drive.step(z, d, f, b.target[j], 0.0, DT, False, False, False, False)
                _put_state(b, j, z)
    else:
        for j in range(n):
            i = valve_null_bias.step(b.z_i_cmd[j], b.bias[j])
            y1, y2, y3, y4 = valve_hysteresis.step(b.m1[j], b.m2[j], b.m3[j], b.m4[j], i, b.width[j], b.spread[j])
            b.i[j] = valve_hysteresis.mean(y1, y2, y3, y4)
            b.m1[j], b.m2[j], b.m3[j], b.m4[j] = y1, y2, y3, y4
        for _ in range(chain.SUBSTEPS):
            if drive_way == 1:
                for j in range(n):
                    z = drive.step(
                        _state(b, j), _drive(b, j), _feed(b, j), b.i[j], b.p_s[j], DT, False, False, False, True
                    )
                    _put_state(b, j, z)
            else:
                for j in range(n):
                    z = drive.step(
                        _state(b, j), _drive(b, j), _feed(b, j), b.i[j], b.p_s[j], DT, True, True, True, True
                    )
                    _put_state(b, j, z)
    for j in range(n):
        b.c[j], b.d[j] = linkage_lanes.crank(b.x[j], _crank(b, j))
    for k in range(stages):
        for j in range(n):
            b.theta[k, j] = linkage_lanes.ring_angle(
                b.c[j], b.d[j], b.stem_ax[k, j], b.stem_ay[k, j], b.stem_lb[k, j], b.span[k, j], b.half[k, j]
            )
        if vane_effects:
            for j in range(n):
                b.theta[k, j] = stem.drive(_stem(b, k, j), b.theta[k, j], b.heard[j], b.t_oil[j], True)
            for j in range(n):
                z, b.theta[k, j] = stem.follow(_stem_state(b, k, j), _stem(b, k, j), b.theta[k, j], b.t_oil[j], t, True)
                _put_stem_state(b, k, j, z)
            for j in range(n):
                _read(b, k, j, b.theta[k, j])
        else:
            for j in range(n):
                z, ring = stem.follow(_stem_state(b, k, j), _stem(b, k, j), b.theta[k, j], b.t_oil[j], t, False)
                _put_stem_state(b, k, j, z)
                _read(b, k, j, ring)


@inlined
def _read(b: Any, k: int, j: int, ring: float) -> None:
    """Let potentiometer ``k`` of lane ``j`` follow the vane of its ring (rad) for one tick."""
    vane = stem.reading(_stem(b, k, j), linkage_lanes.vane_angle(ring, b.lever[k, j]))
    b.pot[k, j] += b.pot_share[k, j] * (vane - b.pot[k, j])
