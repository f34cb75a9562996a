"""Blocks of lanes of the hydraulic actuator: valve, oil, piston."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from plant import chain, curve, drive, lanes
from plant.actuator import speed_factor
from plant.chain import true_stroke
from plant.curve_lanes import CURRENT as OF_CURRENT
from plant.curve_lanes import first_curved, gives, gives_each, of_signal, site_of, tables_of
from plant.effects import (
    aero_load,
    lvdt_nonlinearity,
    oil_viscosity,
    valve_flow_saturation,
    valve_gain_asymmetry,
    valve_hysteresis,
    valve_null_bias,
)
from plant.parameters import (
    DRIVE_EFFECTS,
    DRIVE_LOADED,
    FLOW_GAIN,
    LVDT_SHARE,
    P_REF,
    RATED_CURRENT,
    STROKE,
    VALVE_SHARE,
)
from plant.places import (
    AERO_LOAD,
    CURRENT,
    INTERNAL_LEAKAGE,
    LVDT_BIAS,
    LVDT_GAIN,
    LVDT_NONLINEARITY,
    LVDT_THERMAL_DRIFT,
    OIL_VISCOSITY,
    PISTON_STICTION,
    SUPPLY_PRESSURE_DROOP,
    VALVE_FLOW_SATURATION,
    VALVE_GAIN_ASYMMETRY,
    VALVE_HYSTERESIS,
    VALVE_NULL_BIAS,
)
from plant.stages.bends import BENT, bend_drive, bend_reading
from plant.stages.blocks import W, between, put_where_seen
from vaneloop.base.compiled import compiled_free, inlined

__all__ = ["BLOCK", "CALLED", "Around", "around", "run"]

# effects that the blocks call; those of the LVDT are in `measured_stroke`, which both forms share
CALLED = (
    "aero_load", "end_stop_shift", "internal_leakage", "oil_compressibility", "oil_viscosity", "piston_friction",
    "piston_stiction", "supply_pressure_droop", "valve_dead_band", "valve_flow_saturation", "valve_gain_asymmetry",
    "valve_hysteresis", "valve_lag", "valve_null_bias",
)  # fmt: skip


class Around(NamedTuple):
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
# flow gain and load without curves; the current that would hold the spool, and by how much curves shut its lands
_BESIDE = ("logged", "gain", "bare_load", "holds", "shut")
BLOCK = lanes.block(W, drive.DriveState, drive.Drive, drive.Feed, Around, more=(*_MEMORY, *_BESIDE, *BENT))
_state, _put_state = lanes.getter(drive.DriveState), lanes.putter(drive.DriveState)
_drive, _put_drive = lanes.getter(drive.Drive), lanes.putter(drive.Drive)
_rated_drive = lanes.getter(drive.Drive, rated=1.0)  # for currents that are shares of the rated one
_feed, _put_around = lanes.getter(drive.Feed), lanes.putter(Around)


@inlined
def around(p: np.ndarray, q: int) -> Around:
    """Return it from lane ``q`` of the parameters."""
    return Around(
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
def run(
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
    known: np.ndarray,
) -> None:
    """The lanes of ``order``, eight at a time; out[lane, k]. ``block``: memory for one record `BLOCK`; ``known``:
    signals of curves (`plant.curve.take`).
    """
    n, substeps = current.shape
    h = dt / substeps
    b = block[0]
    rated = p[RATED_CURRENT, 0]
    for j0 in range(0, len(order), W):
        last = min(W, len(order) - j0)
        loaded = lossy = sticky = memory = limited = viscous = sensed = bent = False
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
            limited |= (
                p[VALVE_SHARE, q] < 1.0
                or p[LVDT_SHARE, q] < 1.0
                or p[VALVE_FLOW_SATURATION, q] < valve_flow_saturation.OFF
                or p[VALVE_NULL_BIAS, q] != 0.0
                or p[RATED_CURRENT, q] != rated
            )
            viscous |= p[OIL_VISCOSITY, q] != 0.0
            sensed |= p[DRIVE_EFFECTS, q] != 0.0
            bent |= p[LVDT_NONLINEARITY, q] != 0.0 or p[LVDT_NONLINEARITY + 1, q] != 0.0
            _put_state(b, j, drive.taken(s, q))
            _put_drive(b, j, drive.prepare(p, q))
            _put_around(b, j, around(p, q))
            b.y1[j], b.y2[j], b.y3[j], b.y4[j] = s[CURRENT, q], s[CURRENT + 1, q], s[CURRENT + 2, q], s[CURRENT + 3, q]
        some = order[j0 : j0 + last]
        first = first_curved(p, some)
        tables = tables_of(p, max(first, 0), some, W)
        for k in range(n):
            if k > 0:
                supply, warm, speed = between(p_s, k), between(t_oil, k), between(n_r, k)
                if viscous or k == 1:
                    for j in range(W):
                        b.gain[j] = oil_viscosity.step(b.flow[j], warm, b.viscosity[j])
                        b.extending[j], b.retracting[j] = valve_gain_asymmetry.step(b.gain[j], b.asymmetry[j])
                if loaded:
                    for j in range(W):
                        b.load[j] = aero_load.step(speed, b.aero[j])
                        b.half_share[j] = 0.5 * b.per_area[j] / supply
                else:
                    for j in range(W):
                        b.root[j] = speed_factor(supply, 0.0, b.p_ref[j])
                if first >= 0:
                    for j in range(W):
                        b.bare_load[j] = b.load[j]
                if first >= 0 and loaded and (lossy or sticky or memory):
                    _curved_substeps(b, current, k, supply, h, True, True, True, p, first, known, tables, some)
                elif first >= 0 and loaded:
                    _curved_substeps(b, current, k, supply, h, True, False, False, p, first, known, tables, some)
                elif first >= 0:
                    _curved_substeps(b, current, k, supply, h, False, False, True, p, first, known, tables, some)
                elif loaded and (lossy and (memory or sticky) or memory and (sticky or limited)):
                    _substeps(b, current, k, rated, supply, h, True, True, True, True, True)
                elif lossy:
                    _substeps(b, current, k, rated, supply, h, True, True, False, False, True)
                elif sticky and limited:
                    _substeps(b, current, k, rated, supply, h, True, False, True, False, True)
                elif loaded and limited:
                    _substeps(b, current, k, rated, supply, h, True, False, False, False, True)
                elif sticky:
                    _substeps(b, current, k, rated, supply, h, True, False, True, False, False)
                elif loaded and memory:
                    _substeps(b, current, k, rated, supply, h, True, False, False, True, False)
                elif loaded:
                    _substeps(b, current, k, rated, supply, h, True, False, False, False, False)
                elif limited and memory:
                    _substeps(b, current, k, rated, supply, h, False, False, False, True, True)
                elif limited:
                    _substeps(b, current, k, rated, supply, h, False, False, False, False, True)
                elif memory:
                    _substeps(b, current, k, rated, supply, h, False, False, False, True, False)
                else:
                    _substeps(b, current, k, rated, supply, h, False, False, False, False, False)
            if first >= 0:
                bend_reading(b, p, first, known, k, tables, some)
            if window > 0 and k % window == 0:
                for j in range(last):
                    seen = x_lvdt[k]
                    if first >= 0:
                        seen = curve.unbent(seen, b.lvdt_times[j], b.lvdt_adds[j])
                    put_where_seen(b, j, true_stroke(seen, p, order[j0 + j], t_oil[k]), k == 0)
            for j in range(W):
                b.logged[j] = b.reading[j]
            if bent:
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
            if first >= 0:
                for j in range(W):
                    b.logged[j] = curve.bent(b.logged[j], b.lvdt_times[j], b.lvdt_adds[j])
            for j in range(last):
                out[order[j0 + j], k] = b.logged[j]
        if n > 1 and not memory:  # what steps without these do not keep
            for j in range(W):
                i = valve_null_bias.step(current[n - 1, substeps - 1], b.bias[j])
                b.y1[j], b.y2[j], b.y3[j], b.y4[j] = i, i, i, i
                b.lagged[j] = b.lagged[j] if limited or first >= 0 else i
        for j in range(last):
            q = order[j0 + j]
            drive.stored(s, q, _state(b, j))
            s[CURRENT, q], s[CURRENT + 1, q], s[CURRENT + 2, q], s[CURRENT + 3, q] = b.y1[j], b.y2[j], b.y3[j], b.y4[j]


@inlined
def _moving_current(b: Any, j: int, i_cmd: float, memory: bool) -> float:
    """The current (A) that moves the spool of lane ``j``; ``memory``: behind its hysteresis."""
    i = valve_null_bias.step(i_cmd, b.bias[j])
    if not memory:
        return i
    y1, y2, y3, y4 = valve_hysteresis.step(b.y1[j], b.y2[j], b.y3[j], b.y4[j], i, b.width[j], b.spread[j])
    b.y1[j], b.y2[j], b.y3[j], b.y4[j] = y1, y2, y3, y4
    return valve_hysteresis.mean(y1, y2, y3, y4)


@inlined
def _substeps(
    b: Any,
    current: np.ndarray,
    k: int,
    rated: float,
    p_s: float,
    h: float,
    loaded: bool,
    lossy: bool,
    sticky: bool,
    memory: bool,
    limited: bool,
) -> None:
    """The plant steps of row ``k`` of ``current`` (A), of every lane of the block; ``rated`` (A): that of them all.

    memory  some of them have hysteresis; the others see `plant.drive.step`
    """
    for m in range(current.shape[1]):
        i_cmd = current[k, m]
        share = valve_null_bias.step(i_cmd, 0.0) / rated
        for j in range(W):
            if not memory and not limited:  # all lanes have the same current: it is divided once
                z = drive.step(
                    _state(b, j), _rated_drive(b, j), _feed(b, j), share, p_s, h, loaded, lossy, sticky, limited
                )
                _put_state(b, j, z)
                continue
            i = _moving_current(b, j, i_cmd, memory)
            z = drive.step(_state(b, j), _drive(b, j), _feed(b, j), i, p_s, h, loaded, lossy, sticky, limited)
            _put_state(b, j, z)


@inlined
def _curved_substeps(
    b: Any,
    current: np.ndarray,
    k: int,
    p_s: float,
    h: float,
    loaded: bool,
    lossy: bool,
    memory: bool,
    p: np.ndarray,
    q: int,
    known: np.ndarray,
    tables: np.ndarray,
    some: np.ndarray,
) -> None:
    """`_substeps` of the lanes ``some`` with curves, of which ``q`` is one that has them; ``lossy``: or sticky."""
    opens = False
    for c in range(len(tables)):
        opens |= site_of(p, q, c) == curve.OPENING_ADDS
    for m in range(current.shape[1]):
        i_cmd = current[k, m]
        bend_drive(b, p, q, known, k, i_cmd, tables, some)
        for j in range(W):
            gain = b.gain[j] * curve.times(b.flow_times[j])
            b.extending[j], b.retracting[j] = valve_gain_asymmetry.step(gain, b.asymmetry[j])
            b.load[j] = b.bare_load[j] + b.load_adds[j]
            b.shut[j] = 0.0
        if opens:
            for j in range(W):
                b.holds[j] = (b.spool[j] + h * b.spool_rate[j]) * b.rated[j]
            for c in range(len(tables)):
                if site_of(p, q, c) == curve.OPENING_ADDS:
                    if of_signal(p, q, c, OF_CURRENT):
                        gives_each(b.shut, p, q, c, b.holds, tables)
                    else:
                        gives(b.shut, p, q, c, known, k - 1, k, tables, some)
            for j in range(W):
                b.shut[j] = -b.shut[j] / b.rated[j]
        for j in range(W):
            i = _moving_current(b, j, i_cmd, memory) + b.current_adds[j]
            z = drive.step(_state(b, j), _drive(b, j), _feed(b, j), i, p_s, h, loaded, lossy, lossy, True, b.shut[j])
            _put_state(b, j, z)
