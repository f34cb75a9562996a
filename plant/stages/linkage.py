"""The linkage: vane angles from the stroke."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from plant import chain, curve, lanes, linkage_lanes, lvdt, stem, unison
from plant.chain import straightened, true_stroke
from plant.curve_lanes import alike, first_curved, gives, site_of, tables_of
from plant.effects import CURVES, pot_lag, ring_stiffness
from plant.linkage import G_LE, G_LX0, G_X1, G_Y1, crank
from plant.parameters import GEOMETRY, LVDT_LAG, POT_LAG, POT_SHIFT
from plant.places import (
    LINKAGE_FRICTION,
    LVDT_LAG_ERROR,
    POT,
    POT_LAG_ERROR,
    RING_ECCENTRICITY,
    RING_STIFFNESS_RATIO,
    X,
)
from plant.stages.blocks import NOTHING, in_blocks, on_all_cores, parts_of
from vaneloop.base.compiled import compiled_free, inlined

__all__ = ["linkage_run", "speed_of", "speed_reach"]

WIDE = 16  # lanes in a block: more are no quicker each, and fewer sets than a block's lanes fill it badly
SOME = 1  # so few lanes or fewer are quicker one by one


def linkage_run(
    x_lvdt: np.ndarray,
    n_r: np.ndarray,
    t_oil: np.ndarray,
    t: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    known: np.ndarray = NOTHING,
    x_b: np.ndarray | None = None,
    p_b: np.ndarray = NOTHING,
) -> None:
    """Fill out[k, stage, lane] with the vane angle (rad) as its potentiometer gives it at sample k, without noise.
    ``s`` is moved on.

    x_lvdt   measured stroke (m): the LVDT's effects and lags are taken off it lane by lane, so that a wrong reading
             moves all stages
    n_r, t_oil, t   %, degC, s from the start of the log
    out      quickest where a lane's samples lie side by side in memory
    known    signals of curves (`plant.curve.take`)
    x_b, p_b  of two actuators, whose A the stroke and ``p`` then are: B's stroke (m), and its parameters, a lane of B
              for each of A
    """
    x_lvdt = np.ascontiguousarray(x_lvdt)
    speed = speed_of(x_lvdt, dt)
    two = x_b is not None
    b_too = x_lvdt[:0] if x_b is None else np.ascontiguousarray(x_b)
    b_speed = speed_of(b_too, dt) if two else b_too
    curved = p[CURVES] != 0.0
    alone = curved & ~alike(p)
    # what one lane of a block needs is computed for all of them: those that need the same are put side by side
    stages = range(out.shape[1])
    rubbed = (p[[LINKAGE_FRICTION + k for k in stages]] != 0.0).any(axis=0)
    eccentric = (p[[RING_ECCENTRICITY + k for k in stages]] != 0.0).any(axis=0)
    bent = np.array([lvdt.bends(p, j) or (two and lvdt.bends(p_b, j)) for j in range(p.shape[1])])
    order = np.lexsort((eccentric, rubbed, bent, curved, alone))
    wide = in_blocks(p.shape[1] - np.count_nonzero(alone), WIDE, 0 if two else SOME)  # the chain has B in the next lane
    to = out.transpose(2, 1, 0)
    to = to if to.flags.c_contiguous else np.empty(to.shape)

    def run(part: range) -> None:
        some = order[part.start : part.stop]
        if part.start < wide:
            block = np.empty(1, _linkage(out.shape[1]))
            _linkage_blocks(x_lvdt, speed, n_r, t_oil, t, dt, p, s, to, some, block, known, b_too, b_speed, p_b)
        else:
            _linkage_lanes(x_lvdt, speed, n_r, t_oil, t, dt, p, s, to, some, known)

    on_all_cores(run, parts_of(p.shape[1], wide, WIDE))
    if not np.may_share_memory(to, out):
        out[...] = to.transpose(2, 1, 0)


def speed_of(x_lvdt: np.ndarray, dt: float) -> np.ndarray:
    """Speed (m/s) of a measured stroke (m)."""
    reach = speed_reach(dt)
    ahead, behind = (
        np.minimum(np.arange(len(x_lvdt)) + reach, len(x_lvdt) - 1),
        np.maximum(np.arange(len(x_lvdt)) - reach, 0),
    )
    return np.asarray((x_lvdt[ahead] - x_lvdt[behind]) / (np.maximum(ahead - behind, 1) * dt))


def speed_reach(dt: float) -> int:
    """Samples to each side over which the stroke's speed is taken: fewer, and the noise of the LVDT would come through
    its lag.
    """
    return max(1, round(1e-2 / dt))


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
    known: np.ndarray,
) -> None:
    """These ``lanes``, one after the other; out[lane, stage, m]."""
    g, stages = GEOMETRY, out.shape[1]
    before = np.empty(stages)
    for j in lanes:
        late, curved = max(p[LVDT_LAG, j], 0.0) + p[LVDT_LAG_ERROR, j], p[CURVES, j] != 0.0
        for m in range(len(x_lvdt)):
            seen = x_lvdt[m] + late * speed[m]
            if curved:
                curve.take(s, p, j, known, m, m)
                seen = straightened(seen, s, p, j)
            x = true_stroke(seen, p, j, t_oil[m])
            s[X, j] = x
            c, d = crank(chain.driven_stroke(s, p, j), p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])
            for k in range(stages):
                vane = chain.stem_angle(s, p, j, k, c, d, n_r[m], t_oil[m], t[m])
                if m > 0:
                    e, b = _ramp_lag(pot_lag.step(p[POT_LAG, j], p[POT_LAG_ERROR + k, j]), dt)
                    s[POT + k, j] = e * s[POT + k, j] + ((b - e) * before[k] + (1.0 - b) * vane)
                before[k] = vane
                out[j, k, m] = s[POT + k, j]


# what curves give: to the reading, the crank, and of each stage
_BENT = ("lvdt_adds", "lvdt_times", "crank_adds")
_BENT_OF_STAGE = ("ring_adds", "play_adds", "pot_adds", "pot_times")
_OF_STAGE = (
    (stem.StemState, stem.Stem),
    ("pot", "before", "theta", "twist", "e", "b", "lever", "span", "half", "span_b", "half_b", *_BENT_OF_STAGE),
)  # fmt: skip


@lru_cache
def _linkage(stages: int) -> np.dtype[np.void]:
    """Block for that many stages: the compiler knows how often its loops over them go."""
    # late: s, by which the LVDT trails the stroke
    more = ("late", "stroke", "c", "d", "c_b", "d_b", "shift", "give_a", "give_b", *_BENT)
    return lanes.block(WIDE, linkage_lanes.Crank, lvdt.Lvdt, more=more, each=(stages, *_OF_STAGE))


_crank, _put_crank = lanes.getter(linkage_lanes.Crank), lanes.putter(linkage_lanes.Crank)
_lvdt, _put_lvdt = lanes.getter(lvdt.Lvdt), lanes.putter(lvdt.Lvdt)
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
    known: np.ndarray,
    x_b: np.ndarray,
    speed_b: np.ndarray,
    p_b: np.ndarray,
) -> None:
    """The lanes of ``order``, `WIDE` at a time; out[lane, stage, m]. ``block``: memory for one record `_linkage`; with
    ``x_b`` the rings have an actuator B, too.
    """
    two = len(x_b) > 0
    g = GEOMETRY
    b = block[0]
    for j0 in range(0, len(order), WIDE):
        last = min(WIDE, len(order) - j0)
        rubbed = eccentric = bent = False
        for j in range(WIDE):
            q = order[j0 + min(j, last - 1)]
            _put_crank(
                b, j, linkage_lanes.crank_numbers(p[g + G_LX0, q], p[g + G_X1, q], p[g + G_Y1, q], p[g + G_LE, q])
            )
            b.late[j], b.shift[j] = max(p[LVDT_LAG, q], 0.0) + p[LVDT_LAG_ERROR, q], p[POT_SHIFT, q]
            _put_lvdt(b, j, lvdt.prepare(p, q))
            bent |= lvdt.bends(p, q)
            if two:
                _, b.give_a[j], b.give_b[j] = ring_stiffness.step(
                    p[RING_STIFFNESS_RATIO, q], p_b[RING_STIFFNESS_RATIO, q]
                )
            for k in range(b.pot.shape[0]):
                d = stem.prepare(p, q, k)
                _put_stem(b, k, j, d)
                _put_stem_state(b, k, j, stem.taken(s, q, k))
                b.pot[k, j], b.lever[k, j] = s[POT + k, q], d.ldp / d.length
                b.span[k, j], b.half[k, j] = linkage_lanes.ring_numbers(d.lc, d.ld)
                if two:
                    d_b = stem.prepare(p_b, q, k)
                    b.span_b[k, j], b.half_b[k, j] = linkage_lanes.ring_numbers(d_b.lc, d_b.ld)
                b.e[k, j], b.b[k, j] = _ramp_lag(pot_lag.step(p[POT_LAG, q], p[POT_LAG_ERROR + k, q]), dt)
                rubbed |= d.linkage_friction != 0.0
                eccentric |= d.ring_eccentricity != 0.0
        some = order[j0 : j0 + last]
        first = first_curved(p, some)
        tables = tables_of(p, max(first, 0), some, WIDE)
        for m in range(len(x_lvdt)):
            if first >= 0:
                _bend(b, p, first, known, m, tables, some)
            if bent or first >= 0:
                for j in range(WIDE):
                    q = order[j0 + min(j, last - 1)]
                    seen = x_lvdt[m] + b.late[j] * speed[m]
                    if first >= 0:
                        seen = curve.unbent(seen, b.lvdt_times[j], b.lvdt_adds[j])
                    b.stroke[j] = true_stroke(seen, p, q, t_oil[m])
            else:
                for j in range(WIDE):
                    b.stroke[j] = lvdt.straightened(_lvdt(b, j), x_lvdt[m] + b.late[j] * speed[m], t_oil[m])
            if first >= 0:
                for j in range(WIDE):
                    b.c[j], b.d[j] = linkage_lanes.crank(b.stroke[j] + b.crank_adds[j], _crank(b, j))
            else:
                for j in range(WIDE):
                    b.c[j], b.d[j] = linkage_lanes.crank(b.stroke[j], _crank(b, j))
            if two:
                for j in range(WIDE):
                    q = order[j0 + min(j, last - 1)]
                    late = max(p_b[LVDT_LAG, q], 0.0) + p_b[LVDT_LAG_ERROR, q]
                    stroke = true_stroke(x_b[m] + late * speed_b[m], p_b, q, t_oil[m])
                    b.c_b[j], b.d_b[j] = linkage_lanes.crank(stroke, _crank(b, j))
            for k in range(b.pot.shape[0]):
                for j in range(WIDE):
                    b.theta[k, j] = linkage_lanes.ring_angle(
                        b.c[j], b.d[j], b.ax[k, j], b.ay[k, j], b.lb[k, j], b.span[k, j], b.half[k, j]
                    )
                if two:
                    for j in range(WIDE):
                        theta_b = linkage_lanes.ring_angle(
                            b.c_b[j], b.d_b[j], b.ax[k, j], b.ay[k, j], b.lb[k, j], b.span_b[k, j], b.half_b[k, j]
                        )
                        b.theta[k, j], b.twist[k, j] = unison.shared(
                            b.theta[k, j], theta_b, b.shift[j], b.give_a[j], b.give_b[j]
                        )
                if eccentric:
                    for j in range(WIDE):
                        b.theta[k, j] = stem.drive(_stem(b, k, j), b.theta[k, j], n_r[m], t_oil[m], t[m], True)
                else:
                    for j in range(WIDE):
                        b.theta[k, j] = stem.drive(_stem(b, k, j), b.theta[k, j], n_r[m], t_oil[m], t[m], False)
                if first >= 0:
                    for j in range(WIDE):
                        b.theta[k, j] += b.ring_adds[k, j]
                if first >= 0 and rubbed:
                    _follow(b, k, t_oil[m], t[m], True, True)
                elif first >= 0:
                    _follow(b, k, t_oil[m], t[m], False, True)
                elif rubbed:
                    _follow(b, k, t_oil[m], t[m], True, False)
                else:
                    _follow(b, k, t_oil[m], t[m], False, False)
                if two:
                    for j in range(WIDE):
                        b.theta[k, j] += b.twist[k, j]
                if first >= 0:
                    _read(b, k, m, t_oil[m], t[m], True)
                else:
                    _read(b, k, m, t_oil[m], t[m], False)
                for j in range(last):
                    out[order[j0 + j], k, m] = b.pot[k, j]
        for j in range(last):
            q = order[j0 + j]
            s[X, q] = b.stroke[j]
            for k in range(b.pot.shape[0]):
                stem.stored(s, q, k, _stem_state(b, k, j))
                s[POT + k, q] = b.pot[k, j]


@inlined
def _follow(b: Any, k: int, t_oil: float, t: float, rubbed: bool, curved: bool) -> None:
    """Let the rings of stage ``k`` follow their drives."""
    for j in range(WIDE):
        more = b.play_adds[k, j] if curved else 0.0
        z, b.theta[k, j] = stem.follow(_stem_state(b, k, j), _stem(b, k, j), b.theta[k, j], t_oil, t, rubbed, more)
        _put_stem_state(b, k, j, z)


@inlined
def _read(b: Any, k: int, m: int, t_oil: float, t: float, curved: bool) -> None:
    """Let the potentiometers of stage ``k`` follow their vanes at sample ``m``."""
    for j in range(WIDE):
        vane = stem.reading(_stem(b, k, j), linkage_lanes.vane_angle(b.theta[k, j], b.lever[k, j]), t_oil, t)
        if curved:
            vane = curve.bent(vane, b.pot_times[k, j], b.pot_adds[k, j])
        before = vane if m == 0 else b.before[k, j]
        slow = b.e[k, j] * b.pot[k, j] + ((b.b[k, j] - b.e[k, j]) * before + (1.0 - b.b[k, j]) * vane)
        b.pot[k, j] = b.pot[k, j] if m == 0 else slow
        b.before[k, j] = vane


@inlined
def _bend(
    b: Any, p: np.ndarray, q: int, known: np.ndarray, m: int, tables: np.ndarray, lanes: np.ndarray
) -> None:  # fmt: skip
    """What the curves of these ``lanes`` give at sample ``m``; ``q``: one of them that has any."""
    for j in range(WIDE):
        b.lvdt_adds[j] = b.lvdt_times[j] = b.crank_adds[j] = 0.0
    for k in range(b.pot.shape[0]):
        for j in range(WIDE):
            b.ring_adds[k, j] = b.play_adds[k, j] = b.pot_adds[k, j] = b.pot_times[k, j] = 0.0
    for c in range(len(tables)):
        site = site_of(p, q, c)
        if site == curve.LVDT_ADDS:
            gives(b.lvdt_adds, p, q, c, known, m, m, tables, lanes)
        elif site == curve.LVDT_TIMES:
            gives(b.lvdt_times, p, q, c, known, m, m, tables, lanes)
        elif site == curve.CRANK_ADDS:
            gives(b.crank_adds, p, q, c, known, m, m, tables, lanes)
        for k in range(b.pot.shape[0]):
            if site in (curve.RING_ADDS, curve.RING_ADDS + 1 + k):
                gives(b.ring_adds[k], p, q, c, known, m, m, tables, lanes)
            elif site in (curve.PLAY_ADDS, curve.PLAY_ADDS + 1 + k):
                gives(b.play_adds[k], p, q, c, known, m, m, tables, lanes)
            elif site == curve.POT_ADDS + 1 + k:
                gives(b.pot_adds[k], p, q, c, known, m, m, tables, lanes)
            elif site == curve.POT_TIMES + 1 + k:
                gives(b.pot_times[k], p, q, c, known, m, m, tables, lanes)
