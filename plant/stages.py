"""One stage alone, driven by what the log says went into it, for many parameter sets side by side.

Engine, actuator and linkage of `plant.chain`, with the same functions and effects, on the log's own raster. Parameters
and state are p[row, lane], s[row, lane]; a lane is one parameter set. A few lanes run one after the other, through the
chain; more run in blocks, step by step together, so that the compiler can use vector instructions. Both ways agree to
rounding. A lane with an effect that the blocks do not call, as one just added to `plant.chain`, runs alone: right, but
some five times slower. SI; times in s.

The derived rows of ``p`` must be those of the raster: ``derive(p, dt / substeps, dt)``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from plant import chain, drive, electromechanical, lanes, places, stem
from plant.actuator import speed_factor
from plant.chain import measured_stroke, true_stroke
from plant.effects import (
    EFFECTS,
    NEUTRAL,
    ROW,
    acceleration_limit_error,
    aero_load,
    lvdt_nonlinearity,
    oil_compressibility,
    oil_viscosity,
    pot_lag,
    rotor_lag_error,
    valve_gain_asymmetry,
    valve_hysteresis,
    valve_null_bias,
)
from plant.engine import engine_step
from plant.layout import N_NOMINAL
from plant.linkage import G_LE, G_LX0, G_X1, G_Y1, crank
from plant.parameters import (
    ACCELERATION,
    DECELERATION,
    DRIVE_EFFECTS,
    DRIVE_LOADED,
    FLOW_GAIN,
    GEOMETRY,
    KIND,
    LAG,
    LVDT_FACTOR,
    LVDT_LAG,
    LVDT_SHARE,
    P_REF,
    POT_LAG,
    STROKE,
    VALVE_SHARE,
    motor_steps,
)
from plant.places import (
    AERO_LOAD,
    CURRENT,
    GIVE,
    INTERNAL_LEAKAGE,
    LAGGED,
    LVDT_BIAS,
    LVDT_GAIN,
    LVDT_LAG_ERROR,
    LVDT_NONLINEARITY,
    LVDT_THERMAL_DRIFT,
    N_R,
    OIL_COMPRESSIBILITY,
    OIL_VISCOSITY,
    PISTON_STICTION,
    POT,
    POT_LAG_ERROR,
    READING,
    SCREW_PITCH_ERROR,
    SUPPLY_PRESSURE_DROOP,
    TACHO_THERMAL_DRIFT,
    VALVE_FLOW_SATURATION,
    VALVE_GAIN_ASYMMETRY,
    VALVE_HYSTERESIS,
    VALVE_LAG,
    VALVE_NULL_BIAS,
    X_LVDT,
    X,
)
from plant.series import arctangent, tangent
from vaneloop.base.compiled import compiled_free, inlined

__all__ = ["actuator_run", "engine_run", "linkage_run", "step_currents"]

W = 8  # lanes in a block of the actuator: two vectors of four; more do not run faster
FEW = 1  # so few lanes or fewer are quicker one by one
WIDE = 32  # lanes in a block of the linkage: its short loops over fewer would be unrolled instead of vectorised
SOME = 5  # so few lanes or fewer are quicker one by one there
# effects that the blocks call; those of the LVDT are in `measured_stroke`, which both forms share
ACTUATOR_BLOCKS = (
    "aero_load", "amplifier_dead_band", "amplifier_lag", "amplifier_offset", "end_stop_shift", "gear_backlash",
    "internal_leakage", "motor_torque_constant_error", "oil_compressibility", "oil_viscosity", "piston_friction",
    "piston_stiction", "screw_friction", "screw_pitch_error", "supply_pressure_droop", "tacho_thermal_drift",
    "valve_dead_band", "valve_flow_saturation", "valve_gain_asymmetry", "valve_hysteresis", "valve_lag",
    "valve_null_bias",
)  # fmt: skip
LINKAGE_BLOCKS = (
    "crank_length_error", "link_length_error", "linkage_backlash", "linkage_compliance", "linkage_friction",
    "linkage_wear", "pot_bias",
    "pot_gain", "pot_lag", "ring_eccentricity", "thermal_growth",
)  # fmt: skip
ENGINE_STEP = 2e-3  # s: the engine's explicit step is within 0.1 % of a change at this length

# A block's memory comes from the caller, who keeps it: a record that compiled code takes out of an array of its own
# does not keep that array alive. Its width is constant, so that the compiler sees the strides.


def engine_run(n_dem: np.ndarray, dt: float, p: np.ndarray, s: np.ndarray, out: np.ndarray) -> None:
    """Fill out[k, lane] with the rotor speed (%) at sample k; n_dem[k] (%) holds until sample k + 1. ``s`` is
    moved on.
    """
    _engine_run(np.ascontiguousarray(n_dem), dt, max(1, math.ceil(dt / ENGINE_STEP - 1e-6)), p, s, out)


def step_currents(i_cmd: np.ndarray, dt: float, substeps: int, behind: float = chain.TICK) -> np.ndarray:
    """Return the current (A) of every step of `actuator_run`, float64[n, substeps]: [k, m] in step m after sample k -
    1.

    i_cmd     [k]: mean current (A) of the ticks after sample k - 1, up to and with the one at sample k, as VGV_SERVO
              carries it; or [k, m]: the current in each of the equal parts of that time
    behind    s: how much later than logged the current acts; that of the tick at sample k drives the next millisecond

    No step leads to sample 0: its row is the mean, under which the valve rests there.
    """
    if i_cmd.ndim == 1:
        out = _currents(np.ascontiguousarray(i_cmd), dt, substeps, behind)
    else:
        out = _late(i_cmd, dt, substeps, behind)
    out[0] = np.mean(i_cmd[0])
    return out


def actuator_run(
    current: np.ndarray,
    n_r: np.ndarray,
    p_s: np.ndarray,
    t_oil: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    x_lvdt: np.ndarray | None = None,
    window: int = 0,
) -> None:
    """Fill out[k, lane] with the stroke (m) as the LVDT gives it at sample k, without noise. ``s`` is moved on.

    current           A in every step, of `step_currents`
    n_r, p_s, t_oil   %, Pa, degC; their mean over the step is used
    out               quickest where a lane's samples lie side by side in memory
    x_lvdt, window    measured stroke (m): every ``window`` samples, from the first on, the piston is put where the LVDT
                      saw it, so that a small error of speed does not carry it away; without them it starts from ``s``
                      and runs free

    The lags' shares in ``p`` are set to h / (h + tau): over long steps h this keeps the delay of a ramp exact, where
    the share of a constant input, 1 - exp(-h / tau), would be early by h / 2.
    """
    if window and x_lvdt is None:
        raise ValueError(f"window (={window}) needs x_lvdt")
    x = np.ascontiguousarray(x_lvdt) if window else np.zeros(1)
    if window:
        _rest(p, s, current[0, 0], n_r[0], t_oil[0])
    h = dt / current.shape[1]
    for share, tau in ((LVDT_FACTOR, LVDT_LAG), (LVDT_SHARE, LVDT_LAG_ERROR), (VALVE_SHARE, VALVE_LAG)):
        p[share] = h / (h + np.maximum(p[tau], 0.0))
    # what one lane of a block needs is computed for all eight: those that need the same are put side by side
    alone = _elsewhere(p, ("valve", "supply", "amplifier", "motor", "screw", "actuator"), ACTUATOR_BLOCKS)
    motor = p[KIND, 0] != 0.0  # all lanes are of one machine
    lossy = (p[SUPPLY_PRESSURE_DROOP] != 0.0) | (p[INTERNAL_LEAKAGE] != 0.0)
    order = np.lexsort(
        (
            p[VALVE_HYSTERESIS] != 0.0,
            p[PISTON_STICTION] != 0.0,
            lossy,
            p[DRIVE_LOADED] != 0.0,
            p[SCREW_PITCH_ERROR] != 0.0,
            alone,
        )
    )
    wide = _in_blocks(p.shape[1] - np.count_nonzero(alone), W, FEW)
    work = [range(j, min(j + W, wide)) for j in range(0, wide, W)]
    each = max(1, -(-(p.shape[1] - wide) // (os.cpu_count() or 1)))
    work += [range(j, min(j + each, p.shape[1])) for j in range(wide, p.shape[1], each)]

    def run(part: range) -> None:
        some = order[part.start : part.stop]
        if part.start < wide and motor:
            _motor_blocks(current, n_r, t_oil, dt, p, s, out.T, x, window, some, np.empty(1, _MOTOR))
        elif part.start < wide:
            _actuator_blocks(current, n_r, p_s, t_oil, dt, p, s, out.T, x, window, some, np.empty(1, _ACTUATOR))
        else:
            _actuator_lanes(current, n_r, p_s, t_oil, dt, p, s, out.T, x, window, some)

    if len(work) == 1:
        run(work[0])
    else:  # compiled code needs no interpreter; the costly ones, which come last, begin first
        with ThreadPoolExecutor(min(len(work), os.cpu_count() or 1)) as threads:
            list(threads.map(run, work[::-1]))


def linkage_run(
    x_lvdt: np.ndarray,
    n_r: np.ndarray,
    t_oil: np.ndarray,
    t: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
) -> None:
    """Fill out[k, stage, lane] with the vane angle (rad) as its potentiometer gives it at sample k, without noise.
    ``s`` is moved on.

    x_lvdt   measured stroke (m): the LVDT's effects and lags are taken off it lane by lane, so that a wrong reading
             moves all stages
    n_r, t_oil, t   %, degC, s from the start of the log
    """
    x_lvdt = np.ascontiguousarray(x_lvdt)
    reach = max(
        1, round(1e-2 / dt)
    )  # samples over which the speed is taken: shorter, and the noise of the LVDT would come through its lag
    ahead, behind = (
        np.minimum(np.arange(len(x_lvdt)) + reach, len(x_lvdt) - 1),
        np.maximum(np.arange(len(x_lvdt)) - reach, 0),
    )
    speed = (x_lvdt[ahead] - x_lvdt[behind]) / (np.maximum(ahead - behind, 1) * dt)
    alone = _elsewhere(p, ("linkage", "pot"), LINKAGE_BLOCKS)
    order = np.argsort(alone, kind="stable")
    wide = _in_blocks(p.shape[1] - np.count_nonzero(alone), WIDE, SOME)
    if wide:
        _linkage_blocks(x_lvdt, speed, n_r, t_oil, t, dt, p, s, out, order[:wide], np.empty(1, _linkage(out.shape[1])))
    if wide < p.shape[1]:
        _linkage_lanes(x_lvdt, speed, n_r, t_oil, t, dt, p, s, out, order[wide:])


@compiled_free
def _currents(mean: np.ndarray, dt: float, substeps: int, behind: float) -> np.ndarray:
    """Currents (n, substeps) between the samples, from the logged means: linear in each interval, of its mean, its
    slope the neighbours'.

    Interval k begins ``behind`` after sample k - 1; a step that begins in the interval before takes its share of both.
    """
    n = len(mean)
    out = np.empty((n, substeps))
    h = 1.0 / substeps
    slope_before, before = 0.0, mean[0]
    for k in range(n):
        slope = 0.5 * (mean[k + 1] - mean[k - 1]) if 0 < k < n - 1 else 0.0  # per interval
        for m in range(substeps):
            begin = m * h - behind / dt
            old = min(max(-begin, 0.0), h)  # length in the interval before
            in_old = before + slope_before * (begin + 0.5 * old + 0.5)
            in_own = mean[k] + slope * (begin + 0.5 * (h + old) - 0.5)
            share = old / h
            out[k, m] = share * in_old + (1.0 - share) * in_own
        slope_before, before = slope, mean[k]
    return out


def _late(parts: np.ndarray, dt: float, substeps: int, behind: float) -> np.ndarray:
    """Currents (n, substeps) between the samples, from those of equal ``parts`` of the time between them that act
    ``behind`` later.
    """
    n, many = parts.shape
    edges = np.arange(n * many + 1) * (dt / many) + behind - dt
    charge = np.concatenate([[0.0], np.cumsum(parts.ravel())]) * (dt / many)
    at = np.arange(n * substeps + 1) * (dt / substeps) - dt
    return np.diff(np.interp(at, edges, charge)).reshape(n, substeps) / (dt / substeps)


def _in_blocks(lanes: int, width: int, few: int) -> int:
    """How many of the lanes run in blocks; the rest of at most ``few`` one by one."""
    rest = lanes % width
    return lanes - rest if rest <= few else lanes


def _elsewhere(p: np.ndarray, sites: Collection[str], called: Collection[str]) -> np.ndarray:
    """Return bool[lane]: whether the lane has an effect of these ``sites`` that is not among the ``called`` ones."""
    rows = [
        ROW[e.name] + i
        for e in EFFECTS.values()
        if e.site in sites and e.name not in called
        for i in range(len(e.parameters))
    ]
    return (p[rows] != np.array([[NEUTRAL[r - N_NOMINAL]] for r in rows]).reshape(-1, 1)).any(axis=0)


@compiled_free
def _rest(p: np.ndarray, s: np.ndarray, i: float, n_r: float, t_oil: float) -> None:
    """Valve and oil at rest, a motor at its steady speed, under the current ``i`` (A) at ``n_r`` (%) and ``t_oil``
    (degC).
    """
    for j in range(p.shape[1]):
        current = valve_null_bias.step(i, p[VALVE_NULL_BIAS, j])
        s[CURRENT : CURRENT + 4, j] = s[LAGGED, j] = current
        load = aero_load.step(n_r, p[AERO_LOAD, j])
        s[GIVE, j] = oil_compressibility.step(load, 0.0, p[OIL_COMPRESSIBILITY, j], p[OIL_COMPRESSIBILITY + 1, j])
        if p[KIND, j] != 0.0:
            electromechanical.rest(p, s, j, i, load, t_oil)


# ---- engine ----------------------------------------------------------------------------------------------------------


@compiled_free
def _engine_run(n_dem: np.ndarray, dt: float, steps: int, p: np.ndarray, s: np.ndarray, out: np.ndarray) -> None:
    lanes = p.shape[1]
    h = dt / steps
    b = np.empty((4, W))
    for j0 in range(0, lanes, W):
        for j in range(W):
            q = min(j0 + j, lanes - 1)
            b[0, j] = s[N_R, q]
            b[1, j] = rotor_lag_error.step(p[LAG, q], p[places.ROTOR_LAG_ERROR, q])
            b[2, j] = acceleration_limit_error.step(p[ACCELERATION, q], p[places.ACCELERATION_LIMIT_ERROR, q])
            b[3, j] = p[DECELERATION, q]
        last = min(W, lanes - j0)
        for k in range(len(n_dem)):
            if k > 0:
                for _ in range(steps):
                    for j in range(W):
                        b[0, j] = engine_step(b[0, j], n_dem[k - 1], b[1, j], b[2, j], b[3, j], h)
            for j in range(last):
                out[k, j0 + j] = b[0, j]
        for j in range(last):
            s[N_R, j0 + j] = b[0, j]


# ---- actuator --------------------------------------------------------------------------------------------------------


@inlined
def _between(a: np.ndarray, k: int) -> float:
    """Mean of a signal over the step to sample ``k``."""
    return 0.5 * (a[k - 1] + a[k])


@compiled_free
def _actuator_lanes(
    current: np.ndarray,
    n_r: np.ndarray,
    p_s: np.ndarray,
    t_oil: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    x_lvdt: np.ndarray,
    window: int,
    lanes: np.ndarray,
) -> None:
    """These ``lanes``, one after the other; out[lane, k]."""
    n, substeps = current.shape
    h = dt / substeps
    for j in lanes:
        effects = p[DRIVE_EFFECTS, j] != 0.0
        for k in range(n):
            if k > 0:
                speed, supply, warm = _between(n_r, k), _between(p_s, k), _between(t_oil, k)
                for m in range(substeps):
                    chain.drive_step(s, p, j, current[k, m], speed, supply, warm, h, 1)
            if not effects:
                s[READING, j] = s[X_LVDT, j]
            if window > 0 and k % window == 0:
                x = true_stroke(x_lvdt[k], p, j, t_oil[k])
                if k == 0:
                    s[X, j] = s[X_LVDT, j] = s[READING, j] = x
                else:
                    shift = x - s[READING, j]
                    s[X, j] += shift
                    s[X_LVDT, j] += shift
                    s[READING, j] += shift
            out[j, k] = measured_stroke(s[READING, j], p, j, t_oil[k]) if effects else s[READING, j]


class _Around(NamedTuple):
    """What a block of lanes needs of each beside `drive.Drive`: the valve's hysteresis, flow, load, reading."""

    bias: float
    width: float
    spread: float
    flow: float
    viscosity: float
    asymmetry: float
    p_ref: float
    aero: float
    lvdt_gain: float
    lvdt_drift: float
    lvdt_bias: float


_MEMORY = ("y1", "y2", "y3", "y4")  # A, of the valve's hysteresis
_ACTUATOR = lanes.block(W, drive.DriveState, drive.Drive, drive.Feed, _Around, more=(*_MEMORY, "logged"))
_state, _put_state = lanes.getter(drive.DriveState), lanes.putter(drive.DriveState)
_drive, _put_drive = lanes.getter(drive.Drive), lanes.putter(drive.Drive)
_feed, _put_around = lanes.getter(drive.Feed), lanes.putter(_Around)


@inlined
def _around(p: np.ndarray, q: int) -> _Around:
    return _Around(
        p[VALVE_NULL_BIAS, q],
        p[VALVE_HYSTERESIS, q],
        p[VALVE_HYSTERESIS + 1, q],
        p[FLOW_GAIN, q],
        p[OIL_VISCOSITY, q],
        p[VALVE_GAIN_ASYMMETRY, q],
        p[P_REF, q],
        p[AERO_LOAD, q],
        p[LVDT_GAIN, q],
        p[LVDT_THERMAL_DRIFT, q],
        p[LVDT_BIAS, q],
    )


@compiled_free
def _actuator_blocks(
    current: np.ndarray,
    n_r: np.ndarray,
    p_s: np.ndarray,
    t_oil: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    x_lvdt: np.ndarray,
    window: int,
    order: np.ndarray,
    block: np.ndarray,
) -> None:
    """The lanes of ``order``, eight at a time; out[lane, k]. ``block``: memory for one record `_ACTUATOR`."""
    n, substeps = current.shape
    h = dt / substeps
    b = block[0]
    for j0 in range(0, len(order), W):
        last = min(W, len(order) - j0)
        loaded = lossy = sticky = memory = viscous = sensed = curved = False
        for j in range(W):
            q = order[j0 + min(j, last - 1)]
            loaded |= p[DRIVE_LOADED, q] != 0.0
            lossy |= (
                p[SUPPLY_PRESSURE_DROOP, q] != 0.0
                or p[INTERNAL_LEAKAGE, q] != 0.0
                or p[VALVE_FLOW_SATURATION + 1, q] != 0.0
            )
            sticky |= p[PISTON_STICTION, q] != 0.0
            memory |= p[VALVE_HYSTERESIS, q] != 0.0
            viscous |= p[OIL_VISCOSITY, q] != 0.0
            sensed |= p[DRIVE_EFFECTS, q] != 0.0
            curved |= p[LVDT_NONLINEARITY, q] != 0.0 or p[LVDT_NONLINEARITY + 1, q] != 0.0
            _put_state(b, j, drive.taken(s, q))
            _put_drive(b, j, drive.prepare(p, q))
            _put_around(b, j, _around(p, q))
            b.y1[j], b.y2[j], b.y3[j], b.y4[j] = s[CURRENT, q], s[CURRENT + 1, q], s[CURRENT + 2, q], s[CURRENT + 3, q]
        for k in range(n):
            if k > 0:
                supply, warm, speed = _between(p_s, k), _between(t_oil, k), _between(n_r, k)
                if viscous or k == 1:
                    for j in range(W):
                        gain = oil_viscosity.step(b.flow[j], warm, b.viscosity[j])
                        b.extending[j], b.retracting[j] = valve_gain_asymmetry.step(gain, b.asymmetry[j])
                if loaded:
                    for j in range(W):
                        b.load[j] = aero_load.step(speed, b.aero[j])
                else:
                    for j in range(W):
                        b.root[j] = speed_factor(supply, 0.0, b.p_ref[j])
                if loaded and (memory or (lossy and sticky)):
                    for m in range(substeps):
                        _block_substep(b, current[k, m], supply, h, True, True, True, True)
                elif lossy:
                    for m in range(substeps):
                        _block_substep(b, current[k, m], supply, h, True, True, False, False)
                elif sticky:
                    for m in range(substeps):
                        _block_substep(b, current[k, m], supply, h, True, False, True, False)
                elif loaded:
                    for m in range(substeps):
                        _block_substep(b, current[k, m], supply, h, True, False, False, False)
                elif memory:
                    for m in range(substeps):
                        _block_substep(b, current[k, m], supply, h, False, False, False, True)
                else:
                    for m in range(substeps):
                        _block_substep(b, current[k, m], supply, h, False, False, False, False)
            if window > 0 and k % window == 0:
                for j in range(last):
                    x = true_stroke(x_lvdt[k], p, order[j0 + j], t_oil[k])
                    if k == 0:
                        b.x[j] = b.x_lvdt[j] = b.reading[j] = x
                    else:
                        shift = x - b.reading[j]
                        b.x[j] += shift
                        b.x_lvdt[j] += shift
                        b.reading[j] += shift
            for j in range(W):
                b.logged[j] = b.reading[j]
            if curved:
                for j in range(last):
                    q = order[j0 + j]
                    b.logged[j] = lvdt_nonlinearity.step(
                        b.reading[j], p[STROKE, q], p[LVDT_NONLINEARITY, q], p[LVDT_NONLINEARITY + 1, q]
                    )
            if sensed:
                for j in range(W):
                    b.logged[j] = chain.straight_reading(
                        b.logged[j], b.lvdt_gain[j], b.lvdt_drift[j], b.lvdt_bias[j], t_oil[k]
                    )
            for j in range(last):
                out[order[j0 + j], k] = b.logged[j]
        for j in range(last):
            q = order[j0 + j]
            drive.stored(s, q, _state(b, j))
            s[CURRENT, q], s[CURRENT + 1, q], s[CURRENT + 2, q], s[CURRENT + 3, q] = b.y1[j], b.y2[j], b.y3[j], b.y4[j]


@inlined
def _block_substep(
    b: Any, i_cmd: float, p_s: float, h: float, loaded: bool, lossy: bool, sticky: bool, memory: bool
) -> None:
    """One plant step of every lane of the block; ``memory``: some of them have hysteresis, the others see
    `plant.drive.step`.
    """
    for j in range(W):
        i = valve_null_bias.step(i_cmd, b.bias[j])
        y1 = y2 = y3 = y4 = i
        if memory:
            y1, y2, y3, y4 = valve_hysteresis.step(b.y1[j], b.y2[j], b.y3[j], b.y4[j], i, b.width[j], b.spread[j])
            i = valve_hysteresis.mean(y1, y2, y3, y4)
        z = drive.step(_state(b, j), _drive(b, j), _feed(b, j), i, p_s, h, loaded, lossy, sticky)
        _put_state(b, j, z)
        b.y1[j], b.y2[j], b.y3[j], b.y4[j] = y1, y2, y3, y4


_MOTOR = lanes.block(
    W, electromechanical.MotorState, electromechanical.Motor, more=("aero", "torque_of_load", "most", "logged")
)
_motor_state, _put_motor_state = (
    lanes.getter(electromechanical.MotorState),
    lanes.putter(electromechanical.MotorState),
)
_motor, _put_motor = lanes.getter(electromechanical.Motor), lanes.putter(electromechanical.Motor)


@compiled_free
def _motor_blocks(
    current: np.ndarray,
    n_r: np.ndarray,
    t_oil: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    x_lvdt: np.ndarray,
    window: int,
    order: np.ndarray,
    block: np.ndarray,
) -> None:
    """`_actuator_blocks` of an electromechanical actuator. ``block``: memory for one record `_MOTOR`."""
    n, substeps = current.shape
    many = motor_steps(dt / substeps)
    h = dt / (substeps * many)
    b = block[0]
    for j0 in range(0, len(order), W):
        last = min(W, len(order) - j0)
        swaying = drifting = False
        for j in range(W):
            q = order[j0 + min(j, last - 1)]
            swaying |= p[SCREW_PITCH_ERROR, q] != 0.0
            drifting |= p[TACHO_THERMAL_DRIFT, q] != 0.0
            b.aero[j] = p[AERO_LOAD, q]
            _put_motor_state(b, j, electromechanical.taken(s, q))
            _put_motor(b, j, electromechanical.prepare(p, q, t_oil[0]))
        for k in range(n):
            if k > 0:
                speed, warm = _between(n_r, k), _between(t_oil, k)
                if drifting:
                    for j in range(last):
                        _put_motor(b, j, electromechanical.prepare(p, order[j0 + j], warm))
                for j in range(W):
                    force = aero_load.step(speed, b.aero[j])
                    b.torque_of_load[j], b.most[j] = electromechanical.load_torques(_motor(b, j), force)
                if swaying:
                    for m in range(substeps):
                        _motor_substep(b, current[k, m], many, h, True)
                else:
                    for m in range(substeps):
                        _motor_substep(b, current[k, m], many, h, False)
            if window > 0 and k % window == 0:
                for j in range(last):
                    x = true_stroke(x_lvdt[k], p, order[j0 + j], t_oil[k])
                    shift = x - b.reading[j]
                    b.x[j] = x if k == 0 else b.x[j] + shift
                    b.x_lvdt[j] = x if k == 0 else b.x_lvdt[j] + shift
                    b.reading[j] = x if k == 0 else b.reading[j] + shift
            for j in range(last):
                out[order[j0 + j], k] = measured_stroke(b.reading[j], p, order[j0 + j], t_oil[k])
        for j in range(last):
            electromechanical.stored(s, order[j0 + j], _motor_state(b, j))


@inlined
def _motor_substep(b: Any, i_cmd: float, many: int, h: float, swaying: bool) -> None:
    """One plant step of every lane of the block, in ``many`` steps of the motor."""
    for _ in range(many):
        for j in range(W):
            z, d = _motor_state(b, j), _motor(b, j)
            _put_motor_state(b, j, electromechanical.step(z, d, i_cmd, b.torque_of_load[j], b.most[j], h, swaying))
    for j in range(W):
        _put_motor_state(b, j, electromechanical.sense(_motor_state(b, j), _motor(b, j)))


# ---- linkage ---------------------------------------------------------------------------------------------------------


@inlined
def _ramp_lag(tau: float, dt: float) -> tuple[float, float]:
    """Return (e, b) of a first-order lag over ``dt`` for an input that goes straight from u0 to u1: y1 = e y0 + (b - e)
    u0 + (1 - b) u1.
    """
    if tau <= 0.0:
        return 0.0, 0.0
    e = math.exp(-dt / tau)
    return e, (1.0 - e) * tau / dt


@compiled_free
def _linkage_lanes(
    x_lvdt: np.ndarray,
    speed: np.ndarray,
    n_r: np.ndarray,
    t_oil: np.ndarray,
    t: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    lanes: np.ndarray,
) -> None:
    """These ``lanes``, one after the other."""
    g, stages = GEOMETRY, out.shape[1]
    before = np.empty(stages)
    for j in lanes:
        late = max(p[LVDT_LAG, j], 0.0) + p[LVDT_LAG_ERROR, j]
        for m in range(len(x_lvdt)):
            x = true_stroke(x_lvdt[m] + late * speed[m], p, j, t_oil[m])
            s[X, j] = x
            c, d = crank(x, p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])
            for k in range(stages):
                vane = chain.stem_angle(s, p, j, k, c, d, n_r[m], t_oil[m], t[m])
                if m > 0:
                    e, b = _ramp_lag(pot_lag.step(p[POT_LAG, j], p[POT_LAG_ERROR + k, j]), dt)
                    s[POT + k, j] = e * s[POT + k, j] + ((b - e) * before[k] + (1.0 - b) * vane)
                before[k] = vane
                out[m, k, j] = s[POT + k, j]


class _Crank(NamedTuple):
    """What a block of lanes needs of each crank; by how much (s) the LVDT trails the stroke."""

    lx0: float
    x1: float
    y1: float
    le: float
    late: float


_OF_STAGE = ((stem.StemState, stem.Stem), ("pot", "before", "theta", "e", "b", "lever"))


@lru_cache
def _linkage(stages: int) -> np.dtype[np.void]:
    """Block for that many stages: the compiler knows how often its loops over them go."""
    return lanes.block(WIDE, _Crank, more=("stroke", "c", "d"), each=(stages, *_OF_STAGE))


_stem, _put_stem = lanes.getter(stem.Stem, "k"), lanes.putter(stem.Stem, "k")
_stem_state, _put_stem_state = lanes.getter(stem.StemState, "k"), lanes.putter(stem.StemState, "k")


@compiled_free
def _linkage_blocks(
    x_lvdt: np.ndarray,
    speed: np.ndarray,
    n_r: np.ndarray,
    t_oil: np.ndarray,
    t: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    order: np.ndarray,
    block: np.ndarray,
) -> None:
    """The lanes of ``order``, `WIDE` at a time. ``block``: memory for one record `_linkage`."""
    g = GEOMETRY
    b = block[0]
    for j0 in range(0, len(order), WIDE):
        last = min(WIDE, len(order) - j0)
        rubbed = eccentric = False
        for j in range(WIDE):
            q = order[j0 + min(j, last - 1)]
            b.lx0[j], b.x1[j], b.y1[j], b.le[j] = p[g + G_LX0, q], p[g + G_X1, q], p[g + G_Y1, q], p[g + G_LE, q]
            b.late[j] = max(p[LVDT_LAG, q], 0.0) + p[LVDT_LAG_ERROR, q]
            for k in range(b.pot.shape[0]):
                d = stem.prepare(p, q, k)
                _put_stem(b, k, j, d)
                _put_stem_state(b, k, j, stem.taken(s, q, k))
                b.pot[k, j], b.lever[k, j] = s[POT + k, q], d.ldp / d.length
                b.e[k, j], b.b[k, j] = _ramp_lag(pot_lag.step(p[POT_LAG, q], p[POT_LAG_ERROR + k, q]), dt)
                rubbed |= d.friction != 0.0
                eccentric |= d.amplitude != 0.0
        for m in range(len(x_lvdt)):
            for j in range(WIDE):
                q = order[j0 + min(j, last - 1)]
                b.stroke[j] = true_stroke(x_lvdt[m] + b.late[j] * speed[m], p, q, t_oil[m])
            for j in range(WIDE):
                b.c[j], b.d[j] = _crank(b.stroke[j], b.lx0[j], b.x1[j], b.y1[j], b.le[j])
            for k in range(b.pot.shape[0]):
                for j in range(WIDE):
                    b.theta[k, j] = _ring(b.c[j], b.d[j], b.ax[k, j], b.ay[k, j], b.lb[k, j], b.lc[k, j], b.ld[k, j])
                if eccentric:
                    for j in range(WIDE):
                        b.theta[k, j] = stem.drive(_stem(b, k, j), b.theta[k, j], n_r[m], t_oil[m], True)
                else:
                    for j in range(WIDE):
                        b.theta[k, j] = stem.drive(_stem(b, k, j), b.theta[k, j], n_r[m], t_oil[m], False)
                if rubbed:
                    for j in range(WIDE):
                        z, b.theta[k, j] = stem.follow(
                            _stem_state(b, k, j), _stem(b, k, j), b.theta[k, j], t_oil[m], t[m], True
                        )
                        _put_stem_state(b, k, j, z)
                else:
                    for j in range(WIDE):
                        z, b.theta[k, j] = stem.follow(
                            _stem_state(b, k, j), _stem(b, k, j), b.theta[k, j], t_oil[m], t[m], False
                        )
                        _put_stem_state(b, k, j, z)
                for j in range(WIDE):
                    vane = stem.reading(_stem(b, k, j), _vane(b.theta[k, j], b.lever[k, j]))
                    before = vane if m == 0 else b.before[k, j]
                    slow = b.e[k, j] * b.pot[k, j] + ((b.b[k, j] - b.e[k, j]) * before + (1.0 - b.b[k, j]) * vane)
                    b.pot[k, j] = b.pot[k, j] if m == 0 else slow
                    b.before[k, j] = vane
                for j in range(last):
                    out[m, k, order[j0 + j]] = b.pot[k, j]
        for j in range(last):
            q = order[j0 + j]
            s[X, q] = b.stroke[j]
            for k in range(b.pot.shape[0]):
                stem.stored(s, q, k, _stem_state(b, k, j))
                s[POT + k, q] = b.pot[k, j]


@inlined
def _crank(stroke: float, lx0: float, x1: float, y1: float, le: float) -> tuple[float, float]:
    """`plant.linkage.crank` without branches."""
    lx = lx0 + stroke
    d2 = x1 * x1 + y1 * y1
    m = 0.5 * (d2 + le * le - lx * lx)
    r = d2 * le * le - m * m
    root = math.sqrt(max(r, 0.0))
    m = m if r > 0.0 else (math.sqrt(d2) * le if m >= 0.0 else -math.sqrt(d2) * le)
    f = 1.0 / (d2 * le)
    return (x1 * m - y1 * root) * f, (x1 * root + y1 * m) * f


@inlined
def _ring(c: float, d: float, ax: float, ay: float, lb: float, lc: float, ld: float) -> float:
    """`plant.linkage.ring_angle` for angles within +-90 deg, without branches."""
    qx = ax + lb * c
    qy = ay + lb * d
    q2 = qx * qx + qy * qy
    u = 0.5 * (q2 + ld * ld - lc * lc) / ld
    r = q2 - u * u
    v = math.sqrt(max(r, 0.0))
    u = u if r > 0.0 else (math.sqrt(q2) if u >= 0.0 else -math.sqrt(q2))
    return arctangent(-(qx * u + qy * v), qy * u - qx * v)


@inlined
def _vane(theta: float, lever: float) -> float:
    """`plant.linkage.vane_angle` as an arctangent, asin q = atan(q / sqrt(1 - q^2)); ``lever`` = Ld'/L."""
    q = min(max(lever * tangent(theta), -1.0), 1.0)
    return arctangent(q, math.sqrt(1.0 - q * q))
