"""Stage `linkage`: the vane angles from the stroke, jointly, run freely; the play is a state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from plant.model import side_of
from plant.parameters import derive
from plant.places import X
from plant.stages import linkage_run
from plant.stages.linkage import speed_reach
from vaneloop.identification.onset import that_begins
from vaneloop.identification.settings import NOISE_DRAWS, RASTER, SETTLE, WINDOW
from vaneloop.identification.subsystem import Array, Named, Stage
from vaneloop.identification.vane_chain.parameters import declared_by_side, lanes_by_side, like_temperature, like_time
from vaneloop.identification.vane_chain.resample import expect_draws, pieces_of, since
from vaneloop.identification.vane_chain.subsystem_data import STROKE_OFF, VANES_LATE, Driven, Made, excerpts

__all__ = ["linkage_stage"]


@that_begins
def linkage_stage(driven: Driven) -> Stage:
    """Vane angles that the log has, from the stroke, or from those of two actuators."""
    t, c, machine, _, outputs, run = driven[:6]
    of = declared_by_side("linkage", driven)
    parameters, effects = of.parameters, of.effects
    signals = driven.signals()
    dt = float(t[1] - t[0])
    strokes = driven.both or (c.get("stroke", c["x_lvdt"]),) * machine.sides  # of two that nobody logged, their mean
    x, *x_b = (np.ascontiguousarray(one * 1e-3) for one in strokes)
    n_r = np.ascontiguousarray(c.get("n_r", np.zeros(len(t))))
    t_oil = np.ascontiguousarray(c["t_oil"])
    late = c.get(VANES_LATE)
    which = [machine.vanes.index(o) for o in outputs]
    begun = [o in c and bool(driven.sampled(o)[: round(WINDOW / dt)].any()) for o in machine.vanes]
    first = [np.deg2rad(np.median(c[o][:5])) if b else np.nan for o, b in zip(machine.vanes, begun, strict=True)]

    slow = dt > 1.5 * RASTER  # the stroke reverses between two rows, and the play remembers where
    step = 0.5 * dt if slow else dt

    def halved(values: Array) -> Array:
        return _with_midpoints(values) if slow else values

    def driving(off: Array | float, share: Array | float) -> list[Array]:
        return [_with_reversals(one + off, share) if slow else one + off for one in (x, *x_b)]

    as_logged, speed = driving(0.0, 0.5), halved(n_r)

    def simulate(thetas: Array, t: Array = t, t_oil: Array = t_oil, moved: Sequence[Array] = as_logged) -> Array:
        p, *p_b = lanes_by_side(driven, thetas, of)
        derive(p, step, step)
        own, *other = moved
        curves = halved(driven.slipping(signals, p))
        start = machine.start(stroke=own[0], n_r=n_r[0])
        for side, one in enumerate(other, 1):
            start[X, side] = one[0]
        machine.place_rings(start, tuple(first))
        s = np.repeat(start[:, :1], len(thetas), axis=1)
        out = np.empty((len(thetas), len(first), len(own)))
        linkage_run(own, speed, halved(t_oil), halved(t), step, p, s, out.transpose(2, 1, 0), curves, *other, *p_b)
        out = out[..., ::2] if slow else out
        out = out if which == list(range(len(first))) else out[:, which]
        out = driven.passed.of_rows(np.rad2deg(out, out=out), dt)
        return out if late is None else _earlier(out, late / dt)

    # until the stroke has crossed the play twice over, nobody knows where in it the rings started; nor where they were
    # left at full speed by a controller that had to catch up, which turns between two rows
    first_spell, settled = c["machine_spell"] == c["machine_spell"][0], since(t, c["machine_spell"]) >= SETTLE
    known = np.zeros(len(t), dtype=bool)
    for piece in pieces_of(c["machine_spell"]):
        counts = np.flatnonzero((first_spell | settled)[piece]) + piece.start
        known[counts] = _crossed(c["x_lvdt"][counts])
    moved = known.any()
    if moved:
        run = run & known
    measured = driven.measured(run)
    stage = Stage("linkage", outputs, ("deg",) * len(outputs), parameters, effects, simulate, t, measured)
    stage.alike = {"pot_gain": _cross_talk, "pot_lag": _late_recorder}
    ageing, warming = like_time(t, t_oil), like_temperature(t, t_oil)
    stage.twins = {
        "linkage_wear": ("oil temperature", lambda thetas: simulate(thetas, t=warming)),
        **{
            e.name: ("time", lambda thetas: simulate(thetas, t_oil=ageing))
            for e in effects
            if side_of(e.name)[1] in ("thermal_growth", "lvdt_thermal_drift")
        },
    }

    def kept(at: Array) -> Array:
        keep, last = run[at], speed_reach(dt)
        for piece in np.split(np.arange(len(at)), np.flatnonzero(np.diff(at) != 1) + 1):
            if moved:
                keep[piece] &= _crossed(c["x_lvdt"][at[piece]])
            if at[piece[-1]] < len(t) - 1:  # the stroke's speed there is that of a leap to the next piece
                keep[piece[-last:]] = False
        return keep

    if (slow or STROKE_OFF in c) and not driven.again:
        neutral = stage.neutral()[None]
        digits = 1e-3 * c[STROKE_OFF].T if STROKE_OFF in c else np.zeros((NOISE_DRAWS, 1))
        shares = [np.random.default_rng(k).random(len(t) - 1) for k in range(len(digits))]
        drawn = [simulate(neutral, moved=driving(*one))[0] for one in zip(digits, shares, strict=True)]
        expect_draws(stage, np.array(drawn) - simulate(neutral)[0])
    stage.counted = kept
    stage.excerpt, stage.made = excerpts(linkage_stage, driven, stage, kept), Made(linkage_stage, driven)
    return stage


def _with_midpoints(values: Array) -> Array:
    """Values with one half way between any two: float64[..., 2 samples - 1] of float64[..., samples]."""
    out = np.empty((*values.shape[:-1], max(2 * values.shape[-1] - 1, 0)))
    out[..., ::2] = values
    out[..., 1::2] = 0.5 * (values[..., :-1] + values[..., 1:])
    return out


def _with_reversals(x: Array, share: Array | float) -> Array:
    """A stroke with a value between any two rows: half way, or its peak where it reverses there.

    The peak lies between the farther of the two rows and the point where the line through the two rows before meets
    that through the two rows after: at a ``share`` of that way, one number or float64[rows - 1]. A corner has 1, a
    parabola up to 1/4; between slow rows any share is taken to be equally likely.
    """
    out = _with_midpoints(x)
    first, second = x[1:-2], x[2:-1]
    rise, fall = first - x[:-3], x[3:] - second
    reverses = rise * fall < 0.0
    at = (second - fall - first) / np.where(reverses, rise - fall, 1.0)  # rows behind the first
    farther = np.where(rise > 0.0, np.maximum(first, second), np.minimum(first, second))
    peak = farther + np.broadcast_to(share, len(x) - 1)[1:-1] * (first + rise * at - farther)
    out[3:-2:2] = np.where(reverses & (at > 0.0) & (at < 1.0), peak, out[3:-2:2])
    return out


def _earlier(values: Array, rows: Array) -> Array:
    """The ``values``, float64[..., samples], each so many ``rows``, float64[samples], before, by straight lines."""
    at = np.clip(np.arange(values.shape[-1]) - rows, 0.0, values.shape[-1] - 1.0)
    before = np.minimum(at.astype(int), values.shape[-1] - 2)
    share = at - before
    return np.asarray(values[..., before] * (1.0 - share) + values[..., before + 1] * share)


def _crossed(x: Array) -> Array:
    """Samples from which on the stroke x (mm) has crossed any ring's play: where in it the ring began is forgotten."""
    return np.asarray(np.maximum.accumulate(x) - np.minimum.accumulate(x) > 3.0)


def _late_recorder(named: Named) -> str:
    """One lag of several potentiometers is that of what they have in common."""
    lags = named["pot_lag"].values()
    one = len(lags) > 1 and max(p["low"] for p in lags) <= min(p["high"] for p in lags)
    return "a recorder of the vanes that is late" if one and min(p["low"] for p in lags) > 0.0 else ""


def _cross_talk(named: Named) -> str:
    """The stages turn together: a share of another's reading is a gain and an offset to 1 %."""
    changed = {
        effect: {v for v, p in named[effect].items() if not p["low"] <= none <= p["high"]}
        for effect, none in (("pot_gain", 1.0), ("pot_bias", 0.0))
        if effect in named
    }
    gains = changed["pot_gain"]
    one = len(gains) == 1 and gains <= changed.get("pot_bias", set())
    return "a share of another vane row's reading" if one else ""
