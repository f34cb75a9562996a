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
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from plant import chain
from plant.actuator import speed_factor
from plant.chain import (
    AERO_LOAD,
    BRISTLE,
    CRANK_LENGTH_ERROR,
    CURRENT,
    DRIVEN,
    END_STOP_SHIFT,
    FRICTION,
    GIVE,
    INTERNAL_LEAKAGE,
    LAGGED,
    LINK_LENGTH_ERROR,
    LINKAGE_BACKLASH,
    LINKAGE_COMPLIANCE,
    LINKAGE_FRICTION,
    LINKAGE_WEAR,
    LVDT_BIAS,
    LVDT_GAIN,
    LVDT_LAG_ERROR,
    LVDT_NONLINEARITY,
    LVDT_THERMAL_DRIFT,
    N_R,
    OIL_COMPRESSIBILITY,
    OIL_VISCOSITY,
    PISTON_FRICTION,
    PISTON_STICTION,
    POT,
    POT_BIAS_ERROR,
    POT_GAIN,
    POT_LAG_ERROR,
    READING,
    RING,
    RING_ECCENTRICITY,
    SPEED,
    SPOOL,
    SPOOL_RATE,
    SUPPLY_PRESSURE_DROOP,
    THERMAL_GROWTH,
    VALVE_DEAD_BAND,
    VALVE_FLOW_SATURATION,
    VALVE_GAIN_ASYMMETRY,
    VALVE_HYSTERESIS,
    VALVE_LAG,
    VALVE_NULL_BIAS,
    X_LVDT,
    X,
    measured_stroke,
    true_stroke,
)
from plant.effects import (
    EFFECTS,
    NEUTRAL,
    ROW,
    acceleration_limit_error,
    aero_load,
    crank_length_error,
    end_stop_shift,
    link_length_error,
    linkage_backlash,
    linkage_compliance,
    linkage_friction,
    linkage_wear,
    lvdt_nonlinearity,
    oil_compressibility,
    oil_viscosity,
    pot_bias,
    pot_gain,
    pot_lag,
    ring_eccentricity,
    rotor_lag_error,
    thermal_growth,
    valve_gain_asymmetry,
    valve_hysteresis,
    valve_null_bias,
)
from plant.engine import engine_step
from plant.layout import N_NOMINAL
from plant.linkage import G_AX, G_AY, G_L, G_LB, G_LC, G_LD, G_LDP, G_LE, G_LX0, G_X1, G_Y1, N_CRANK, N_PER_STAGE, crank
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
    LVDT_LAG,
    LVDT_SHARE,
    P_REF,
    PLAY,
    POT_BIAS,
    POT_LAG,
    RATED_CURRENT,
    STROKE,
    VALVE_A11,
    VALVE_A12,
    VALVE_A21,
    VALVE_A22,
    VALVE_SHARE,
)
from plant.play import play_step
from plant.series import arctangent, tangent
from vaneloop.base.compiled import compiled_free, inlined

__all__ = ["actuator_run", "engine_run", "linkage_run", "step_currents"]

W = 8  # lanes in a block of the actuator: two vectors of four; more do not run faster
FEW = 1  # so few lanes or fewer are quicker one by one
WIDE = 32  # lanes in a block of the linkage: its short loops over fewer would be unrolled instead of vectorised
SOME = 5  # so few lanes or fewer are quicker one by one there
# effects that the blocks call; those of the LVDT are in `measured_stroke`, which both forms share
ACTUATOR_BLOCKS = (
    "aero_load", "end_stop_shift", "internal_leakage", "oil_compressibility", "oil_viscosity", "piston_friction",
    "piston_stiction",
    "supply_pressure_droop", "valve_dead_band", "valve_flow_saturation", "valve_gain_asymmetry", "valve_hysteresis",
    "valve_lag",
    "valve_null_bias",
)  # fmt: skip
LINKAGE_BLOCKS = (
    "crank_length_error", "link_length_error", "linkage_backlash", "linkage_compliance", "linkage_friction",
    "linkage_wear", "pot_bias",
    "pot_gain", "pot_lag", "ring_eccentricity", "thermal_growth",
)  # fmt: skip
ENGINE_STEP = 2e-3  # s: the engine's explicit step is within 0.1 % of a change at this length

# Each block makes its scratch array (so compiled_free, not in_place), of constant width: the compiler sees the strides.


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
        _rest(p, s, current[0, 0], n_r[0])
    h = dt / current.shape[1]
    for share, tau in ((LVDT_FACTOR, LVDT_LAG), (LVDT_SHARE, LVDT_LAG_ERROR), (VALVE_SHARE, VALVE_LAG)):
        p[share] = h / (h + np.maximum(p[tau], 0.0))
    # what one lane of a block needs is computed for all eight: those that need the same are put side by side
    alone = _elsewhere(p, ("valve", "supply", "actuator"), ACTUATOR_BLOCKS)
    lossy = (p[SUPPLY_PRESSURE_DROOP] != 0.0) | (p[INTERNAL_LEAKAGE] != 0.0)
    order = np.lexsort((p[VALVE_HYSTERESIS] != 0.0, p[PISTON_STICTION] != 0.0, lossy, p[DRIVE_LOADED] != 0.0, alone))
    wide = _in_blocks(p.shape[1] - np.count_nonzero(alone), W, FEW)
    work: list[tuple[Callable[..., None], np.ndarray]] = [
        (_actuator_blocks, order[j : min(j + W, wide)]) for j in range(0, wide, W)
    ]
    if wide < p.shape[1]:
        work.append((_actuator_lanes, order[wide:]))

    def run(part: Any) -> None:
        part[0](current, n_r, p_s, t_oil, dt, p, s, out.T, x, window, part[1])

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
             moves all three stages
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
        _linkage_blocks(x_lvdt, speed, n_r, t_oil, t, dt, p, s, out, order[:wide])
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
def _rest(p: np.ndarray, s: np.ndarray, i: float, n_r: float) -> None:
    """Valve and oil at rest under the current ``i`` (A) at ``n_r`` (%)."""
    for j in range(p.shape[1]):
        current = valve_null_bias.step(i, p[VALVE_NULL_BIAS, j])
        s[CURRENT : CURRENT + 4, j] = s[LAGGED, j] = current
        load = aero_load.step(n_r, p[AERO_LOAD, j])
        s[GIVE, j] = oil_compressibility.step(load, 0.0, p[OIL_COMPRESSIBILITY, j], p[OIL_COMPRESSIBILITY + 1, j])


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
            b[1, j] = rotor_lag_error.step(p[LAG, q], p[chain.ROTOR_LAG_ERROR, q])
            b[2, j] = acceleration_limit_error.step(p[ACCELERATION, q], p[chain.ACCELERATION_LIMIT_ERROR, q])
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


# rows of a block's scratch array: state, what the step needs, what the sample needs
(_U, _DU, _V, _X, _Y, _LAGGED, _Z, _GIVE, _READING, _H1, _H2, _H3, _H4) = range(13)
(_BIAS, _WIDTH, _RATED, _VALVE_SHARE, _A11, _A12, _A21, _A22, _OVERLAP, _LIMIT, _LOW, _HIGH, _LVDT, _LVDT_SHARE) = (
    range(13, 27)
)
(_DROOP, _LEAK, _FORCE, _EXCESS, _STRIBECK, _STIFFNESS, _COMPLIANCE, _DRAG, _PER_P_REF, _PER_AREA) = range(27, 37)
(_EXTENDING, _RETRACTING, _ROOT, _LOAD, _SPREAD, _FLOW, _VISCOSITY, _ASYMMETRY, _P_REF, _AERO) = range(37, 47)
(_LVDT_GAIN, _LVDT_DRIFT, _LVDT_BIAS, _LOGGED, _PER_STROKE, _OFF, _ROUNDNESS, _N_ROWS) = range(47, 55)


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
) -> None:
    """The lanes of ``order``, eight at a time; out[lane, k]."""
    n, substeps = current.shape
    h = dt / substeps
    b = np.empty((_N_ROWS, W))
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
            b[_U, j], b[_DU, j], b[_V, j], b[_X, j], b[_Y, j] = (
                s[SPOOL, q],
                s[SPOOL_RATE, q],
                s[SPEED, q],
                s[X, q],
                s[X_LVDT, q],
            )
            b[_LAGGED, j], b[_Z, j], b[_OFF, j] = s[LAGGED, q], s[FRICTION, q], s[FRICTION + 1, q]
            b[_GIVE, j], b[_READING, j] = s[GIVE, q], s[READING, q]
            b[_H1, j], b[_H2, j], b[_H3, j], b[_H4, j] = (
                s[CURRENT, q],
                s[CURRENT + 1, q],
                s[CURRENT + 2, q],
                s[CURRENT + 3, q],
            )
            b[_BIAS, j], b[_WIDTH, j], b[_SPREAD, j] = (
                p[VALVE_NULL_BIAS, q],
                p[VALVE_HYSTERESIS, q],
                p[VALVE_HYSTERESIS + 1, q],
            )
            b[_RATED, j], b[_VALVE_SHARE, j] = p[RATED_CURRENT, q], p[VALVE_SHARE, q]
            b[_A11, j], b[_A12, j], b[_A21, j], b[_A22, j] = (
                p[VALVE_A11, q],
                p[VALVE_A12, q],
                p[VALVE_A21, q],
                p[VALVE_A22, q],
            )
            b[_OVERLAP, j] = p[VALVE_DEAD_BAND, q] / p[RATED_CURRENT, q]
            b[_LIMIT, j], b[_ROUNDNESS, j] = p[VALVE_FLOW_SATURATION, q], p[VALVE_FLOW_SATURATION + 1, q]
            b[_LOW, j], b[_HIGH, j] = end_stop_shift.step(p[STROKE, q], p[END_STOP_SHIFT, q])
            b[_LVDT, j], b[_LVDT_SHARE, j] = p[LVDT_FACTOR, q], p[LVDT_SHARE, q]
            b[_DROOP, j], b[_LEAK, j] = p[SUPPLY_PRESSURE_DROOP, q], p[INTERNAL_LEAKAGE, q]
            b[_FORCE, j], b[_EXCESS, j], b[_STRIBECK, j] = (
                p[PISTON_FRICTION, q],
                p[PISTON_STICTION, q],
                p[PISTON_STICTION + 1, q],
            )
            b[_STIFFNESS, j] = 1.0 / (oil_compressibility.NOMINAL + p[OIL_COMPRESSIBILITY, q])
            b[_COMPLIANCE, j], b[_DRAG, j] = p[OIL_COMPRESSIBILITY, q], p[OIL_COMPRESSIBILITY + 1, q]
            b[_PER_P_REF, j], b[_PER_AREA, j] = 1.0 / p[P_REF, q], 1.0 / p[AREA, q]
            b[_FLOW, j], b[_VISCOSITY, j], b[_ASYMMETRY, j] = (
                p[FLOW_GAIN, q],
                p[OIL_VISCOSITY, q],
                p[VALVE_GAIN_ASYMMETRY, q],
            )
            b[_P_REF, j], b[_AERO, j], b[_PER_STROKE, j] = p[P_REF, q], p[AERO_LOAD, q], 1.0 / p[STROKE, q]
            b[_LVDT_GAIN, j], b[_LVDT_DRIFT, j], b[_LVDT_BIAS, j] = (
                p[LVDT_GAIN, q],
                p[LVDT_THERMAL_DRIFT, q],
                p[LVDT_BIAS, q],
            )
        for k in range(n):
            if k > 0:
                supply, warm, speed = _between(p_s, k), _between(t_oil, k), _between(n_r, k)
                if viscous or k == 1:
                    for j in range(W):
                        gain = oil_viscosity.step(b[_FLOW, j], warm, b[_VISCOSITY, j])
                        b[_EXTENDING, j], b[_RETRACTING, j] = valve_gain_asymmetry.step(gain, b[_ASYMMETRY, j])
                if loaded:
                    for j in range(W):
                        b[_LOAD, j] = aero_load.step(speed, b[_AERO, j])
                else:
                    for j in range(W):
                        b[_ROOT, j] = speed_factor(supply, 0.0, b[_P_REF, j])
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
                        b[_X, j] = b[_Y, j] = b[_READING, j] = x
                    else:
                        shift = x - b[_READING, j]
                        b[_X, j] += shift
                        b[_Y, j] += shift
                        b[_READING, j] += shift
            for j in range(W):
                b[_LOGGED, j] = b[_READING, j]
            if curved:
                for j in range(last):
                    q = order[j0 + j]
                    b[_LOGGED, j] = lvdt_nonlinearity.step(
                        b[_READING, j], p[STROKE, q], p[LVDT_NONLINEARITY, q], p[LVDT_NONLINEARITY + 1, q]
                    )
            if sensed:
                for j in range(W):
                    b[_LOGGED, j] = chain.straight_reading(
                        b[_LOGGED, j], b[_LVDT_GAIN, j], b[_LVDT_DRIFT, j], b[_LVDT_BIAS, j], t_oil[k]
                    )
            for j in range(last):
                out[order[j0 + j], k] = b[_LOGGED, j]
        for j in range(last):
            q = order[j0 + j]
            s[SPOOL, q], s[SPOOL_RATE, q], s[SPEED, q], s[X, q], s[X_LVDT, q] = (
                b[_U, j],
                b[_DU, j],
                b[_V, j],
                b[_X, j],
                b[_Y, j],
            )
            s[LAGGED, q], s[FRICTION, q], s[FRICTION + 1, q] = b[_LAGGED, j], b[_Z, j], b[_OFF, j]
            s[GIVE, q], s[READING, q] = b[_GIVE, j], b[_READING, j]
            s[CURRENT, q], s[CURRENT + 1, q], s[CURRENT + 2, q], s[CURRENT + 3, q] = (
                b[_H1, j],
                b[_H2, j],
                b[_H3, j],
                b[_H4, j],
            )


@inlined
def _block_substep(
    b: np.ndarray, i_cmd: float, p_s: float, h: float, loaded: bool, lossy: bool, sticky: bool, memory: bool
) -> None:
    """One plant step of every lane of the block; ``memory``: some of them have hysteresis, the others see
    `chain.drive_substep`.
    """
    for j in range(W):
        i = valve_null_bias.step(i_cmd, b[_BIAS, j])
        y1 = y2 = y3 = y4 = i
        if memory:
            y1, y2, y3, y4 = valve_hysteresis.step(
                b[_H1, j], b[_H2, j], b[_H3, j], b[_H4, j], i, b[_WIDTH, j], b[_SPREAD, j]
            )
            i = valve_hysteresis.mean(y1, y2, y3, y4)
        u, du, v, x, y, lagged, z, off, give, reading = chain.drive_substep(
            b[_U, j], b[_DU, j], b[_V, j], b[_X, j], b[_Y, j], b[_LAGGED, j], b[_Z, j], b[_OFF, j], b[_GIVE, j],
            b[_READING, j],
            i, b[_RATED, j], b[_VALVE_SHARE, j], b[_A11, j], b[_A12, j], b[_A21, j], b[_A22, j], b[_OVERLAP, j],
            b[_EXTENDING, j], b[_RETRACTING, j], b[_ROOT, j], p_s, b[_PER_P_REF, j], b[_PER_AREA, j], b[_LOAD, j],
            b[_DROOP, j],
            b[_LIMIT, j], b[_ROUNDNESS, j], b[_LEAK, j], b[_FORCE, j], b[_EXCESS, j], b[_STRIBECK, j], b[_STIFFNESS, j],
            b[_COMPLIANCE, j], b[_DRAG, j], b[_PER_STROKE, j], b[_LOW, j], b[_HIGH, j], b[_LVDT, j], b[_LVDT_SHARE, j],
            h, loaded, lossy, sticky,
        )  # fmt: skip
        b[_U, j], b[_DU, j], b[_V, j], b[_X, j], b[_Y, j] = u, du, v, x, y
        b[_H1, j], b[_H2, j], b[_H3, j], b[_H4, j] = y1, y2, y3, y4
        b[_LAGGED, j], b[_Z, j], b[_OFF, j], b[_GIVE, j], b[_READING, j] = lagged, z, off, give, reading


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
    g = GEOMETRY
    before = np.empty(3)
    for j in lanes:
        late = max(p[LVDT_LAG, j], 0.0) + p[LVDT_LAG_ERROR, j]
        for m in range(len(x_lvdt)):
            x = true_stroke(x_lvdt[m] + late * speed[m], p, j, t_oil[m])
            s[X, j] = x
            c, d = crank(x, p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])
            for k in range(3):
                vane = chain.stem_angle(s, p, j, k, c, d, n_r[m], t_oil[m], t[m])
                if m > 0:
                    e, b = _ramp_lag(pot_lag.step(p[POT_LAG, j], p[POT_LAG_ERROR + k, j]), dt)
                    s[POT + k, j] = e * s[POT + k, j] + ((b - e) * before[k] + (1.0 - b) * vane)
                before[k] = vane
                out[m, k, j] = s[POT + k, j]


# rows of a block's scratch array: of the lane, then of each stage
(_LX0, _X1, _Y1, _LE, _BEND, _PHASE, _DISTANCE, _LATE, _STROKE, _C, _D, _N_LANE) = range(12)
(
    _RING,
    _BRISTLE,
    _DRIVEN,
    _POT,
    _BEFORE,
    _THETA,
    _AX,
    _AY,
    _LB,
    _LC,
    _LD,
    _RATIO,
    _PLAY,
    _WEAR,
    _FRICTION,
    _AMPLITUDE,
    _WARM,
) = range(17)
(_LEVER, _GAIN, _OFFSET, _E, _B, _N_STAGE) = range(17, 23)


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
) -> None:
    """The lanes of ``order``, `WIDE` at a time."""
    g = GEOMETRY
    b = np.empty((_N_LANE, WIDE))
    w = np.empty((3, _N_STAGE, WIDE))
    for j0 in range(0, len(order), WIDE):
        last = min(WIDE, len(order) - j0)
        rubbed = eccentric = False
        for j in range(WIDE):
            q = order[j0 + min(j, last - 1)]
            b[_LX0, j], b[_X1, j], b[_Y1, j], b[_LE, j] = (
                p[g + G_LX0, q],
                p[g + G_X1, q],
                p[g + G_Y1, q],
                p[g + G_LE, q],
            )
            b[_BEND, j], b[_PHASE, j] = p[LINKAGE_COMPLIANCE, q], p[RING_ECCENTRICITY + 3, q]
            b[_DISTANCE, j], b[_LATE, j] = p[LINKAGE_FRICTION + 3, q], max(p[LVDT_LAG, q], 0.0) + p[LVDT_LAG_ERROR, q]
            for k in range(3):
                o = g + N_CRANK + k * N_PER_STAGE
                ratio = p[o + G_L, q] / p[o + G_LDP, q]
                w[k, _RING, j], w[k, _BRISTLE, j], w[k, _DRIVEN, j] = (
                    s[RING + k, q],
                    s[BRISTLE + k, q],
                    s[DRIVEN + k, q],
                )
                w[k, _POT, j] = s[POT + k, q]
                w[k, _AX, j], w[k, _AY, j], w[k, _LD, j], w[k, _RATIO, j] = (
                    p[o + G_AX, q],
                    p[o + G_AY, q],
                    p[o + G_LD, q],
                    ratio,
                )
                w[k, _LB, j] = crank_length_error.step(p[o + G_LB, q], p[CRANK_LENGTH_ERROR + k, q])
                w[k, _LC, j] = link_length_error.step(p[o + G_LC, q], p[LINK_LENGTH_ERROR + k, q])
                w[k, _PLAY, j] = linkage_backlash.step(p[PLAY + k, q], p[LINKAGE_BACKLASH + k, q], ratio)
                w[k, _WEAR, j], w[k, _FRICTION, j] = p[LINKAGE_WEAR + k, q], p[LINKAGE_FRICTION + k, q]
                w[k, _AMPLITUDE, j], w[k, _WARM, j] = p[RING_ECCENTRICITY + k, q], p[THERMAL_GROWTH + k, q]
                w[k, _LEVER, j], w[k, _GAIN, j] = p[o + G_LDP, q] / p[o + G_L, q], p[POT_GAIN + k, q]
                w[k, _OFFSET, j] = pot_bias.step(p[POT_BIAS + k, q], p[POT_BIAS_ERROR + k, q])
                w[k, _E, j], w[k, _B, j] = _ramp_lag(pot_lag.step(p[POT_LAG, q], p[POT_LAG_ERROR + k, q]), dt)
                rubbed |= w[k, _FRICTION, j] != 0.0
                eccentric |= w[k, _AMPLITUDE, j] != 0.0
        for m in range(len(x_lvdt)):
            for j in range(WIDE):
                q = order[j0 + min(j, last - 1)]
                b[_STROKE, j] = true_stroke(x_lvdt[m] + b[_LATE, j] * speed[m], p, q, t_oil[m])
            for j in range(WIDE):
                b[_C, j], b[_D, j] = _crank(b[_STROKE, j], b[_LX0, j], b[_X1, j], b[_Y1, j], b[_LE, j])
            for k in range(3):
                for j in range(WIDE):
                    w[k, _THETA, j] = _ring(
                        b[_C, j], b[_D, j], w[k, _AX, j], w[k, _AY, j], w[k, _LB, j], w[k, _LC, j], w[k, _LD, j]
                    )
                if eccentric:
                    for j in range(WIDE):
                        w[k, _THETA, j] = ring_eccentricity.step(w[k, _THETA, j], w[k, _AMPLITUDE, j], b[_PHASE, j])
                for j in range(WIDE):
                    theta = thermal_growth.step(w[k, _THETA, j], t_oil[m], w[k, _WARM, j], w[k, _RATIO, j])
                    theta = linkage_compliance.step(theta, n_r[m], b[_BEND, j])
                    play = linkage_wear.step(w[k, _PLAY, j], w[k, _WEAR, j], w[k, _RATIO, j], t[m])
                    ring = play_step(w[k, _RING, j], theta, play)
                    w[k, _RING, j] = ring
                    w[k, _THETA, j] = ring
                if rubbed:
                    for j in range(WIDE):
                        ring = w[k, _RING, j]
                        bristle = linkage_friction.step(w[k, _BRISTLE, j], ring - w[k, _DRIVEN, j], b[_DISTANCE, j])
                        w[k, _BRISTLE, j] = bristle
                        w[k, _DRIVEN, j] = ring
                        w[k, _THETA, j] = linkage_friction.loop(ring, bristle, w[k, _FRICTION, j], w[k, _RATIO, j])
                for j in range(WIDE):
                    vane = pot_gain.step(_vane(w[k, _THETA, j], w[k, _LEVER, j]), w[k, _GAIN, j]) + w[k, _OFFSET, j]
                    before = vane if m == 0 else w[k, _BEFORE, j]
                    slow = w[k, _E, j] * w[k, _POT, j] + (
                        (w[k, _B, j] - w[k, _E, j]) * before + (1.0 - w[k, _B, j]) * vane
                    )
                    w[k, _POT, j] = w[k, _POT, j] if m == 0 else slow
                    w[k, _BEFORE, j] = vane
                for j in range(last):
                    out[m, k, order[j0 + j]] = w[k, _POT, j]
        for j in range(last):
            q = order[j0 + j]
            s[X, q] = b[_STROKE, j]
            for k in range(3):
                s[RING + k, q], s[BRISTLE + k, q], s[DRIVEN + k, q] = (
                    w[k, _RING, j],
                    w[k, _BRISTLE, j],
                    w[k, _DRIVEN, j],
                )
                s[POT + k, q] = w[k, _POT, j]


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
