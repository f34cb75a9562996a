"""Blocks of lanes of the hydraulic actuator: valve, oil, piston."""

from __future__ import annotations

from typing import Any

import numpy as np

from plant import chain, curve, drive, lanes, lvdt, unison
from plant.curve_lanes import CURRENT as OF_CURRENT
from plant.curve_lanes import first_curved, gives, gives_each, of_signal, site_of, tables_of
from plant.effects import valve_flow_saturation, valve_null_bias
from plant.parameters import DRIVE_EFFECTS, DRIVE_LOADED, LVDT_SHARE, RATED_CURRENT, VALVE_SHARE
from plant.places import (
    INTERNAL_LEAKAGE,
    PISTON_STICTION,
    SUPPLY_PRESSURE_DROOP,
    VALVE_FLOW_SATURATION,
    VALVE_HYSTERESIS,
    VALVE_NULL_BIAS,
)
from plant.stages.bends import BENT, bend_drive, bend_reading
from plant.stages.blocks import W, between, put_where_seen
from vaneloop.base.compiled import compiled_free, inlined

__all__ = ["BLOCK", "NEEDS", "WAYS", "costs", "needs", "run"]

# What a plant step may leave out where no lane of a block needs it: the flags of `plant.drive.step`, the valve's
# hysteresis, curves. A block goes the first way that has all that its lanes need; the cheap ones come first.
NEEDS = ("loaded", "lossy", "sticky", "memory", "limited", "curved")
WAYS = np.array([
    [flag in way.split() for flag in NEEDS]
    for way in (
        "", "memory", "limited", "memory limited", "loaded", "loaded memory", "loaded sticky", "loaded limited",
        "loaded sticky limited", "loaded lossy limited", "loaded lossy sticky memory limited",
        "memory limited curved", "loaded limited curved", "loaded lossy sticky memory limited curved",
    )
])  # fmt: skip

# flow gain and load without curves; the current that would hold the spool, and by how much curves shut its lands; what
# the rings do to one of two pistons: the load at stroke 0, its slope, and by how much these grow in a plant step
_BESIDE = ("logged", "gain", "bare_load", "holds", "shut", "ring_load", "ring_slope", "ring_load_by", "ring_slope_by")
BLOCK = lanes.block(W, drive.DriveState, drive.Drive, drive.Feed, drive.Plays, lvdt.Lvdt, more=(*_BESIDE, *BENT))
_state, _put_state = lanes.getter(drive.DriveState), lanes.putter(drive.DriveState)
_drive, _put_drive = lanes.getter(drive.Drive), lanes.putter(drive.Drive)
_rated_drive = lanes.getter(drive.Drive, rated=1.0)  # for currents that are shares of the rated one
_feed = lanes.getter(drive.Feed)
_plays, _put_plays = lanes.getter(drive.Plays), lanes.putter(drive.Plays)
_lvdt, _put_lvdt = lanes.getter(lvdt.Lvdt), lanes.putter(lvdt.Lvdt)


def needs(p: np.ndarray) -> np.ndarray:
    """Return bool[lane, `NEEDS`]: what each lane needs; of curves `run` knows by itself."""
    limited = (p[VALVE_SHARE] < 1.0) | (p[LVDT_SHARE] < 1.0) | (p[VALVE_NULL_BIAS] != 0.0)
    limited |= (p[VALVE_FLOW_SATURATION] < valve_flow_saturation.OFF) | (p[RATED_CURRENT] != p[RATED_CURRENT, 0])
    lossy = (p[SUPPLY_PRESSURE_DROOP] != 0.0) | (p[INTERNAL_LEAKAGE] != 0.0) | (p[VALVE_FLOW_SATURATION + 1] != 0.0)
    loaded, sticky, memory = (p[row] != 0.0 for row in (DRIVE_LOADED, PISTON_STICTION, VALVE_HYSTERESIS))
    return np.array([loaded, lossy, sticky, memory, limited, np.zeros_like(loaded)]).T


def costs(p: np.ndarray) -> np.ndarray:
    """Return int[lane]: lanes with neighbouring numbers cost little more together than each with its like."""
    loaded, lossy, sticky, memory, limited, _ = needs(p).T
    return np.where(loaded, 4 + 8 * lossy + 2 * limited + 4 * sticky - memory, limited + 2 * memory)


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
    needed: np.ndarray,
    rings: np.ndarray,
) -> None:
    """The lanes of ``order``, eight at a time; out[lane, k]. ``block``: memory for one record `BLOCK`; ``known``:
    signals of curves (`plant.curve.take`); ``needed``: what each lane of ``p`` `needs`; ``rings``: what they do to one
    of two pistons (`plant.stages.actuator.actuator_run`).
    """
    n, substeps = current.shape
    h = dt / substeps
    b = block[0]
    rated, joined = p[RATED_CURRENT, 0], rings.shape[1] > 0
    need = np.empty(len(NEEDS), np.bool_)
    for j0 in range(0, len(order), W):
        last = min(W, len(order) - j0)
        some = order[j0 : j0 + last]
        sensed = bent = False
        need[:] = False
        for j in range(W):
            q = order[j0 + min(j, last - 1)]
            need |= needed[q]
            sensed |= p[DRIVE_EFFECTS, q] != 0.0
            bent |= lvdt.bends(p, q)
            _put_state(b, j, drive.taken(s, q))
            _put_drive(b, j, drive.prepare(p, q))
            _put_plays(b, j, drive.remembered(s, q))
            _put_lvdt(b, j, lvdt.prepare(p, q))
        first = first_curved(p, some)
        need[len(NEEDS) - 1] = first >= 0
        way = _way(need)
        memory, limited = WAYS[way, 3], WAYS[way, 4]
        tables = tables_of(p, max(first, 0), some, W)
        for k in range(n):
            if k > 0:
                supply, warm, speed = between(p_s, k), between(t_oil, k), between(n_r, k)
                other = 0
                for j in range(W):
                    gain = drive.flow_gain(_drive(b, j), warm)
                    other += gain != b.gain[j]
                    b.gain[j] = gain
                if other > 0 or k == 1:
                    for j in range(W):
                        b.extending[j], b.retracting[j] = drive.gains(_drive(b, j), b.gain[j])
                if need[0]:
                    for j in range(W):
                        b.load[j] = b.bare_load[j] = drive.load_of(_drive(b, j), speed)
                        b.half_share[j] = drive.half_share(_drive(b, j), supply)
                    if joined:
                        for j in range(W):
                            q = order[j0 + min(j, last - 1)]
                            b.ring_load[j], b.ring_slope[j] = rings[0, q, k - 1], rings[1, q, k - 1]
                            b.ring_load_by[j] = (rings[0, q, k] - rings[0, q, k - 1]) / substeps
                            b.ring_slope_by[j] = (rings[1, q, k] - rings[1, q, k - 1]) / substeps
                else:
                    for j in range(W):
                        b.root[j] = drive.root(_drive(b, j), supply)
                _go(way, b, current, k, rated, supply, h, joined, p, first, known, tables, some)
            if first >= 0:
                bend_reading(b, p, first, known, k, tables, some)
            if window > 0 and k % window == 0:
                for j in range(last):
                    seen = x_lvdt[k]
                    if first >= 0:
                        seen = curve.unbent(seen, b.lvdt_times[j], b.lvdt_adds[j])
                    put_where_seen(b, j, chain.true_stroke(seen, p, order[j0 + j], t_oil[k]), k == 0)
            for j in range(W):
                b.logged[j] = b.reading[j]
            if bent:
                for j in range(last):
                    b.logged[j] = lvdt.bend(_lvdt(b, j), b.reading[j], t_oil[k])
            if sensed:
                for j in range(W):
                    b.logged[j] = lvdt.straight(_lvdt(b, j), b.logged[j], t_oil[k])
            if first >= 0:
                for j in range(W):
                    b.logged[j] = curve.bent(b.logged[j], b.lvdt_times[j], b.lvdt_adds[j])
            for j in range(last):
                out[order[j0 + j], k] = b.logged[j]
        if n > 1 and not memory:  # what steps without these do not keep
            for j in range(W):
                i = valve_null_bias.step(current[n - 1, substeps - 1], b.valve_null_bias[j])
                _put_plays(b, j, drive.Plays(i, i, i, i))
                b.lagged[j] = b.lagged[j] if limited else i
        for j in range(last):
            q = order[j0 + j]
            drive.stored(s, q, _state(b, j))
            drive.told(s, q, _plays(b, j))


@inlined
def _way(need: np.ndarray) -> int:
    """The first of `WAYS` that has all of what is needed."""
    for way in range(len(WAYS)):
        has = True
        for flag in range(len(NEEDS)):
            has &= WAYS[way, flag] or not need[flag]
        if has:
            return way
    return len(WAYS) - 1


@inlined
def _substeps(
    b: Any,
    current: np.ndarray,
    k: int,
    rated: float,
    p_s: float,
    h: float,
    joined: bool,
    p: np.ndarray,
    q: int,
    known: np.ndarray,
    tables: np.ndarray,
    some: np.ndarray,
    loaded: bool,
    lossy: bool,
    sticky: bool,
    memory: bool,
    limited: bool,
    curved: bool,
) -> None:
    """The plant steps of row ``k`` of ``current`` (A), of every lane of the block; ``rated`` (A): that of them all;
    ``joined``: rings join each to another piston.

    The flags say what is not left out (`NEEDS`). ``curved``: lanes ``some`` have curves, ``q`` is one that has them.
    """
    opens = False
    if curved:
        for c in range(len(tables)):
            opens |= site_of(p, q, c) == curve.OPENING_ADDS
    for m in range(current.shape[1]):
        i_cmd = current[k, m]
        if curved:
            _bend(b, p, q, known, k, i_cmd, h, opens, tables, some)
        if loaded and joined:
            for j in range(W):
                load = b.bare_load[j] + (b.load_adds[j] if curved else 0.0)
                w = unison.unjoined(_state(b, j), _drive(b, j), load, h)
                b.ring_load[j] += b.ring_load_by[j]
                b.ring_slope[j] += b.ring_slope_by[j]
                b.load[j] = load + unison.felt(b.ring_load[j], b.ring_slope[j], w, 1.0 / b.stiffness[j])
        share = valve_null_bias.step(i_cmd, 0.0) / rated
        for j in range(W):
            if not memory and not limited:  # all lanes have the same current: it is divided once
                z = drive.step(
                    _state(b, j), _rated_drive(b, j), _feed(b, j), share, p_s, h, loaded, lossy, sticky, limited
                )
                _put_state(b, j, z)
                continue
            y, i = drive.current(_plays(b, j), _drive(b, j), i_cmd, memory)
            if memory:
                _put_plays(b, j, y)
            if curved:
                i += b.current_adds[j]
            shut = b.shut[j] if curved else 0.0
            z = drive.step(_state(b, j), _drive(b, j), _feed(b, j), i, p_s, h, loaded, lossy, sticky, limited, shut)
            _put_state(b, j, z)


@inlined
def _bend(
    b: Any,
    p: np.ndarray,
    q: int,
    known: np.ndarray,
    k: int,
    i_cmd: float,
    h: float,
    opens: bool,
    tables: np.ndarray,
    some: np.ndarray,
) -> None:
    """What curves give in a plant step under ``i_cmd`` (A); ``opens``: one of them acts on the lands of the valve."""
    bend_drive(b, p, q, known, k, i_cmd, tables, some)
    for j in range(W):
        b.extending[j], b.retracting[j] = drive.gains(_drive(b, j), b.gain[j] * curve.times(b.flow_times[j]))
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


_REST = "b, current, k, rated, p_s, h, joined, p, q, known, tables, some"
_go = lanes.compiled_text(  # `_substeps` of a way: in each the compiler knows the flags
    f"def f(way, {_REST}):\n"
    + "".join(f"    if way == {i}: substeps({_REST}, {', '.join(map(str, way))})\n" for i, way in enumerate(WAYS)),
    {"substeps": _substeps},
)
