"""The plant of the closed loop for lanes side by side: one tick of `plant.chain`, with the same step functions.

A block holds the lanes of one way through each part: without effects, with effects, with a load on the actuator. Units:
SI, angles rad, speeds %.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from plant import chain, drive, engine, lanes, linkage_lanes, lvdt, stem
from plant.effects import CURVES, EFFECTS, ROW
from plant.linkage import G_LE, G_LX0, G_X1, G_Y1
from plant.parameters import (
    ACTUATORS,
    DRIVE_EFFECTS,
    DRIVE_LOADED,
    GEOMETRY,
    KIND,
    LVDT_STEP,
    POT_SHARE,
    VANE_EFFECTS,
    changed,
)
from plant.places import N_R, POT
from plant.sensors import quantise
from vaneloop.base.compiled import in_place, inlined
from vaneloop.base.vanes import MOST

__all__ = ["W", "feed", "fields", "move", "place", "sample_lvdt", "take_back", "way"]

W = 64  # lanes in a block: with fewer, one chain of operations waits for itself
HALF = chain.SUBSTEPS // 2  # plant steps that a lane takes at once, its state in registers
DT = chain.TICK / chain.SUBSTEPS

# Blocks have every effect of the plant. Of those of the demand they have what is in the calibration as it is flashed
# (`hil.loop.tick.flashed`), not what comes between bus and controller.
_FLASHED = ("schedule_error", "trend_threshold_error", "controller_gain_error")
_ON_THE_WAY = np.array([
    ROW[e.name] + i
    for e in EFFECTS.values()
    if e.site == "demand" and e.name not in _FLASHED
    for i in range(len(e.parameters))
])  # fmt: skip

# n_r: the engine's speed; i, target: current (A) and its share of the rated one over a tick; p_s, t_oil: Pa, degC;
# c, d: the crank's direction; lvdt_step: m, of the converter
_MORE = ("n_r", "i", "target", "p_s", "t_oil", "c", "d", "lvdt_step")
_OF_STAGE = ("pot", "pot_share", "lever", "span", "half", "theta")

_state, _put_state = lanes.getter(drive.DriveState), lanes.putter(drive.DriveState)
_drive, _put_drive = lanes.getter(drive.Drive), lanes.putter(drive.Drive)
_share_drive = lanes.getter(drive.Drive, rated=1.0)  # for currents that are shares of the rated one
_feed, _put_feed = lanes.getter(drive.Feed), lanes.putter(drive.Feed)
_plays, _put_plays = lanes.getter(drive.Plays), lanes.putter(drive.Plays)
_engine, _put_engine = lanes.getter(engine.Engine), lanes.putter(engine.Engine)
_lvdt, _put_lvdt = lanes.getter(lvdt.Lvdt), lanes.putter(lvdt.Lvdt)
_crank, _put_crank = lanes.getter(linkage_lanes.Crank), lanes.putter(linkage_lanes.Crank)
_stem, _put_stem = lanes.getter(stem.Stem, "k", "stem_"), lanes.putter(stem.Stem, "k", "stem_")
_stem_state = lanes.getter(stem.StemState, "k", "stem_")
_put_stem_state = lanes.putter(stem.StemState, "k", "stem_")


def fields() -> list[tuple[str, Any, tuple[int, ...]]]:
    """Fields of a block: each a row of `W` lanes, or one for each of `MOST` stages."""
    kinds: tuple[Any, ...] = (
        drive.DriveState, drive.Drive, drive.Feed, drive.Plays, engine.Engine, lvdt.Lvdt, linkage_lanes.Crank,
    )  # fmt: skip
    once = [*(n for kind in kinds for n in kind._fields), *_MORE]
    of_stage = [*(f"stem_{n}" for n in (*stem.StemState._fields, *stem.Stem._fields)), *_OF_STAGE]
    return [*((n, np.float64, (W,)) for n in once), *((n, np.float64, (MOST, W)) for n in of_stage)]


def way(p: np.ndarray) -> tuple[int, bool] | None:
    """Return the way of a machine (its p) through a block: through the drive (0 without effects, 1 with them, 2 with a
    load too), and whether its linkage has effects. None: it goes through no block.
    """
    alone = p[KIND, 0] != 0.0 or p[ACTUATORS, 0] != 0.0 or p[CURVES, 0] != 0.0
    if alone or changed(p, 0, _ON_THE_WAY) != 0.0:
        return None
    drive_way = 0 if p[DRIVE_EFFECTS, 0] == 0.0 else 1 if p[DRIVE_LOADED, 0] == 0.0 else 2
    return drive_way, bool(p[VANE_EFFECTS, 0] != 0.0)


@in_place
def place(b: Any, j: int, p: np.ndarray, s: np.ndarray, stages: int) -> None:
    """Put a machine, its parameters and its state (one lane each), into lane ``j`` of a block."""
    g = GEOMETRY
    _put_state(b, j, drive.taken(s, 0))
    _put_drive(b, j, drive.prepare(p, 0))
    _put_plays(b, j, drive.remembered(s, 0))
    _put_engine(b, j, engine.prepare(p, 0))
    _put_lvdt(b, j, lvdt.prepare(p, 0))
    _put_crank(b, j, linkage_lanes.crank_numbers(p[g + G_LX0, 0], p[g + G_X1, 0], p[g + G_Y1, 0], p[g + G_LE, 0]))
    b.n_r[j], b.lvdt_step[j] = s[N_R, 0], p[LVDT_STEP, 0]
    for k in range(stages):
        d = stem.prepare(p, 0, k)
        _put_stem(b, k, j, d)
        _put_stem_state(b, k, j, stem.taken(s, 0, k))
        b.pot[k, j], b.pot_share[k, j], b.lever[k, j] = s[POT + k, 0], p[POT_SHARE + k, 0], d.ldp / d.length
        b.span[k, j], b.half[k, j] = linkage_lanes.ring_numbers(d.lc, d.ld)


@in_place
def take_back(b: Any, j: int, s: np.ndarray, stages: int) -> None:
    """Put the state of lane ``j`` of a block back into a machine's (one lane): the inverse of `place`."""
    drive.stored(s, 0, _state(b, j))
    drive.told(s, 0, _plays(b, j))
    s[N_R, 0] = b.n_r[j]
    for k in range(stages):
        stem.stored(s, 0, k, _stem_state(b, k, j))
        s[POT + k, 0] = b.pot[k, j]


@inlined
def feed(b: Any, n: int) -> None:
    """What the supply and the load give the drive of ``n`` lanes, while ``b.p_s``, ``b.t_oil`` and ``b.heard`` stay."""
    lanes.wide_vectors()
    for j in range(n):
        d = _drive(b, j)
        _put_feed(b, j, drive.feed(d, drive.flow_gain(d, b.t_oil[j]), drive.load_of(d, b.heard[j]), b.p_s[j]))


@inlined
def sample_lvdt(b: Any, n: int, drive_way: int, noise: float) -> None:
    """Put the LVDTs' samples (m) into ``b.in_x_lvdt``, with ``noise`` (standard normal) times ``b.sigma_lvdt``."""
    lanes.wide_vectors()
    if drive_way == 0:
        for j in range(n):
            b.in_x_lvdt[j] = quantise(b.x_lvdt[j] + b.sigma_lvdt[j] * noise, b.lvdt_step[j])
        return
    for j in range(n):
        b.in_x_lvdt[j] = lvdt.bend(_lvdt(b, j), b.reading[j], b.t_oil[j])
    for j in range(n):
        x = lvdt.straight(_lvdt(b, j), b.in_x_lvdt[j], b.t_oil[j])
        b.in_x_lvdt[j] = quantise(x + b.sigma_lvdt[j] * noise, b.lvdt_step[j])


@inlined
def move(b: Any, n: int, stages: int, drive_way: int, vane_effects: bool, t: float) -> None:
    """Move ``n`` lanes on by one tick, to ``t`` (s), under the currents ``b.z_i_cmd`` (A)."""
    lanes.wide_vectors()
    for j in range(n):
        b.n_r[j] = engine.step(b.n_r[j], _engine(b, j), b.n_dem[j], chain.TICK)
    if drive_way == 0:
        for j in range(n):
            b.target[j] = b.z_i_cmd[j] / b.rated[j]
        for _ in range(chain.SUBSTEPS // HALF):
            for j in range(n):
                d, f, z = _share_drive(b, j), _feed(b, j), _state(b, j)
                for _ in range(HALF):
                    z = drive.step(z, d, f, b.target[j], 0.0, DT, False, False, False, False)
                _put_state(b, j, z)
    else:
        for j in range(n):
            y, b.i[j] = drive.current(_plays(b, j), _drive(b, j), b.z_i_cmd[j], True)
            _put_plays(b, j, y)
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
                b.theta[k, j] = stem.drive(_stem(b, k, j), b.theta[k, j], b.heard[j], b.t_oil[j], t, True)
            for j in range(n):
                z, b.theta[k, j] = stem.follow(_stem_state(b, k, j), _stem(b, k, j), b.theta[k, j], b.t_oil[j], t, True)
                _put_stem_state(b, k, j, z)
            for j in range(n):
                _read(b, k, j, b.theta[k, j], t)
        else:
            for j in range(n):
                z, ring = stem.follow(_stem_state(b, k, j), _stem(b, k, j), b.theta[k, j], b.t_oil[j], t, False)
                _put_stem_state(b, k, j, z)
                _read(b, k, j, ring, t)


@inlined
def _read(b: Any, k: int, j: int, ring: float, t: float) -> None:
    """Let potentiometer ``k`` of lane ``j`` follow the vane of its ring (rad) for one tick."""
    vane = stem.reading(_stem(b, k, j), linkage_lanes.vane_angle(ring, b.lever[k, j]), b.t_oil[j], t)
    b.pot[k, j] += b.pot_share[k, j] * (vane - b.pot[k, j])
