"""Parameters and effects of a stage as the search takes them, with the starts of their fits, and the rows of the
plant's parameters behind them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from plant import chain
from plant.curve import PLACES, Place, at_curve, quantity_of
from plant.effect import Effect as PlantEffect
from plant.effects import EFFECTS
from plant.geometry import STANDS_FOR
from plant.model import SIDE_NAMES, allowed_of, of_a_side, side_of
from plant.stages import run_bends
from vaneloop.base.vanes import VANES, vane_in
from vaneloop.identification.settings import EFFECT_FACTORS, EFFECT_SIZES, SHAPE_KNOWN, SHAPE_STARTS
from vaneloop.identification.subsystem import Array, Effect, Parameter
from vaneloop.identification.user_models.terms import Curve
from vaneloop.identification.vane_chain.subsystem_data import Driven

__all__ = [
    "ALL_PLACES", "BOTH", "FREE", "SHAPES", "Declared", "bends", "declared", "declared_by_side", "lanes",
    "lanes_by_side", "like_temperature", "like_time",
]  # fmt: skip

BOTH = -1  # of two actuators, where a number is of each: not 0 A, nor 1 B
ALL_PLACES = tuple(PLACES.values())  # a curve's place is a number of these

FREE = {  # nominal parameters that a stage refits within their tolerance, those of them that the machine has
    "demand": (),
    "servo": (),
    "engine": ("engine.lag", "engine.acceleration", "engine.deceleration"),
    "actuator": (
        "actuator.flow_gain",
        "valve.bandwidth",
        "valve.damping",  # of a hydraulic one
        "drive.rated_speed",
        "drive.speed_gain",
        "drive.speed_time",
        "screw.friction",  # of an electromechanical one
        "sensors.lvdt_lag",
        "actuators.ring_stiffness",  # of two
    ),
    "linkage": (
        *(f"linkage.{s}_play" for s in VANES),
        *(f"sensors.{s}_bias" for s in VANES),
        *(f"linkage.{s}_{length}" for s in VANES for length in STANDS_FOR),
    ),
}
SHAPES = (*SHAPE_STARTS, "phase", "roundness")


class Declared(NamedTuple):
    """Parameters and effects of a stage as the search takes them.

    rows, si  rows of the plant's parameters behind its columns, and their factors to SI; its curves, which are the last
              effects, have none
    sides     of two actuators, whose number each is: 0 A, 1 B, -1 both
    """

    parameters: tuple[Parameter, ...]
    effects: tuple[Effect, ...]
    rows: Array
    si: Array
    sides: Array


def declared(stage: str, driven: Driven) -> tuple[tuple[Parameter, ...], tuple[Effect, ...], Array, Array]:
    """`declared_by_side` of a stage that two actuators have in common."""
    return declared_by_side(stage, driven)[:4]


def declared_by_side(stage: str, driven: Driven) -> Declared:
    """Parameters and effects of a stage.

    Of two actuators those of valve, actuator, LVDT and link are a side's, named as in a model file:
    ``side_a.lvdt_bias``. The actuator of a side has its own, and LVDT and link of the other, which drive it through the
    rings. Where both strokes drive a stage it has either LVDT's and link's, and what both have alike.
    """
    machine = driven.machine
    known = {n.name: n for n in machine.nominal}
    parameters, rows, si, sides = [], [], [], []
    for name in FREE[stage]:
        if name not in known:
            continue
        n = known[name]
        side = driven.side if driven.side is not None and of_a_side(name, machine.one_valve) else BOTH
        ring = 1.0
        if name.endswith("_play"):  # known at the vane, used at the ring; a model's lever does not change what it says
            vane = VANES.index(str(vane_in(name)))
            lever = known[f"linkage.{VANES[vane]}_l"]
            ring = lever.value * lever.si / machine.lever(vane)[0]
        value = float(machine.p[n.row, max(side, 0)]) / (n.si * ring)
        middle = machine.nominal_of(n, max(side, 0))
        value = middle if math.isclose(value, middle, rel_tol=1e-12) else value  # through SI and back
        at = "" if side == BOTH else f"{SIDE_NAMES[side]}."
        parameters.append(
            Parameter(f"{at}{name}", value, n.unit, *allowed_of(machine, n), n.tolerance, vane_in(name), middle=middle)
        )
        si.append(n.si * ring)
        rows.append(n.row)
        sides.append(side)
    effects = []
    for e in EFFECTS.values():
        if stage not in e.stages or not machine.can_have(e):
            continue
        own = machine.parameters_of(e.name)
        ps = tuple(
            Parameter(
                p.name,
                p.neutral,
                p.unit,
                p.low,
                p.high,
                SHAPE_KNOWN.get(p.name, 0.0) * p.neutral,
                p.vane or None,
                shape=p.name in SHAPES,
                period=p.period,
            )
            for p in own.values()
        )
        for side in sides_of(e, driven):
            name = e.name if side == BOTH else f"{SIDE_NAMES[side]}.{e.name}"
            if driven.present and _has(driven.present, name):
                continue
            if driven.laws is not None and name not in driven.laws:
                continue
            family = e.name if machine.sides > 1 and of_a_side(e.name, machine.one_valve) else ""
            effects.append(Effect(name, ps, _starts(e.name, ps), e.excites, family=family))
            rows += list(own)
            si += [p.si for p in own.values()]
            sides += [side] * len(own)
    effects += [e for _, e in driven.curves]
    columns = (np.array(x, dtype=kind) for x, kind in ((rows, int), (si, float), (sides, int)))
    return Declared(tuple(parameters), tuple(effects), *columns)


def sides_of(e: PlantEffect, driven: Driven) -> tuple[int, ...]:
    """Whose an effect can be in a stage: `BOTH`, 0 A, 1 B."""
    machine = driven.machine
    if machine.sides == 1 or not of_a_side(e.name, machine.one_valve):
        return (BOTH,)
    if e.site == "link":  # of both it is a fault of the linkage, or of the stiffness of the rings
        return (0, 1) if driven.both is not None else ()
    if driven.side is None:
        return (BOTH, 0, 1) if driven.both is not None else (BOTH,)
    return (driven.side, 1 - driven.side) if e.site == "lvdt" and driven.both is not None else (driven.side,)


def _has(present: Sequence[str], name: str) -> bool:
    """Whether a model that has the effects ``present`` has that of this name: of both, it has either side's, too."""
    side, effect = side_of(name)
    return any(effect == its and (not side or not at or at == side) for at, its in map(side_of, present))


def _starts(name: str, ps: tuple[Parameter, ...]) -> tuple[tuple[float, ...], ...]:
    """Sizes from which a fit of the effect starts: small to gross, both signs where the bounds allow."""
    if name == "valve_flow_saturation":
        # a sharp limit above all speeds of the log has no slope to follow, and one a tenth too low costs more than none
        return (
            *((4.0 * 1.18**k, 0.0) for k in range(24)),
            *((v, 1.0) for v in (4.0, 8.0, 14.0, 25.0, 50.0, 100.0, 200.0)),
        )
    if name in ("can_delay", "frame_hold"):
        return tuple((v,) for v in np.arange(0.01, 0.51, 0.01) if name != "frame_hold" or v > 0.015)
    if name == "trend_threshold_error":
        return tuple((float(v),) for v in np.geomspace(0.1, 12.0, 121))
    if name == "end_stop_shift":
        return tuple((s * v,) for v in (1.0, 2.0, 4.0, 7.0) for s in (-1.0, 1.0))
    second = [SHAPE_STARTS.get(p.name, p.value) for p in ps]
    mains = [i for i, p in enumerate(ps) if p.name not in SHAPES]
    out = []
    for size in EFFECT_SIZES if ps[mains[0]].value == 0.0 else range(len(EFFECT_FACTORS)):
        for sign in (1.0, -1.0):
            start = list(second)
            ok = True
            for i in mains:
                p = ps[i]
                if p.value == 0.0:
                    v = sign * size * (p.high if sign > 0 else -p.low)
                else:
                    v = p.value * EFFECT_FACTORS[int(size)]
                    ok &= sign > 0
                ok &= p.low <= v <= p.high and v != p.value
                start[i] = v
            if ok:
                phases = (0.0, 90.0, 180.0, 270.0) if any(p.name == "phase" for p in ps) else (None,)
                for phase in phases:
                    out.append(
                        tuple(phase if p.name == "phase" and phase is not None else start[i] for i, p in enumerate(ps))
                    )
    return tuple(out)


def lanes(driven: Driven, thetas: Array, rows: Array, si: Array) -> Array:
    """The plant's parameter array with one lane per parameter set; of two actuators, A's."""
    p = np.repeat(driven.machine.p[:, :1], len(thetas), axis=1)
    p[rows] = (thetas[:, : len(rows)] * si).T
    for place, curve, tables in tables_of(driven, thetas):
        q = quantity_of(curve.quantity)
        assert q is not None
        at_curve(p, place, q, curve.low, curve.high, tables)
    return p


def lanes_by_side(driven: Driven, thetas: Array, of: Declared) -> list[Array]:
    """`lanes` of each actuator that the machine has."""
    if driven.machine.sides == 1:
        return [lanes(driven, thetas, of.rows, of.si)]
    out = []
    for side in range(driven.machine.sides):
        p = np.repeat(driven.machine.p[:, side : side + 1], len(thetas), axis=1)
        # what is of both stands before what a side has in its place: a set has one of them
        values, neutral = thetas[:, : len(of.rows)] * of.si, _neutral(of) * of.si
        for column in np.flatnonzero((of.sides == BOTH) | (of.sides == side)):
            if of.sides[column] == BOTH or column < len(of.parameters):
                p[of.rows[column]] = values[:, column]
            else:
                has = values[:, column] != neutral[column]
                p[of.rows[column], has] = values[has, column]
        out.append(p)
    return out


def _neutral(of: Declared) -> Array:
    """The value of each column where nothing is recalibrated and no effect is there."""
    return np.array([p.value for p in (*of.parameters, *(p for e in of.effects for p in e.parameters))][: len(of.rows)])


def tables_of(driven: Driven, thetas: Array) -> list[tuple[Place, Curve, Array]]:
    """Each curve of a stage with its place, and its table in every parameter set, float64[POINTS, sets]."""
    at = thetas.shape[1] - sum(len(e.parameters) for _, e in driven.curves)
    out = []
    for placed, effect in driven.curves:
        columns = slice(at, at + len(effect.parameters))
        at = columns.stop
        assert placed.curve is not None
        tables = np.array([placed.curve.whole(theta[columns]) for theta in thetas]).T
        out.append((ALL_PLACES[placed.curve.place], placed.curve, tables))
    return out


def bends(driven: Driven, thetas: Array, known: Array, *sites: int) -> Iterator[Array]:
    """What the curves at each of some sites of the controller give at the signals of a log, float64[sets, samples],
    border units: those of the machine, and those that are tried.
    """
    p = lanes(driven, thetas, np.zeros(0, dtype=int), np.zeros(0))
    s = np.zeros((chain.N_STATE, len(thetas)))
    known = driven.slipping(known, p)
    for site in sites:
        out = np.zeros((len(thetas), len(driven.t)))
        run_bends(known, p, s, site, out)
        yield out / next(place.si for place in ALL_PLACES if place.site == site)


# ---- Time in place of the oil's temperature, and the other way round: where both run alike, a log cannot tell which of


def like_time(t: Array, t_oil: Array) -> Array:
    """A temperature (degC) that goes straight with time, as far up or down as the oil's went."""
    if np.ptp(t_oil) == 0.0:
        return np.linspace(-0.5, 0.5, len(t)) + t_oil[0]
    sign = 1.0 if np.corrcoef(t, t_oil)[0, 1] >= 0.0 else -1.0
    return np.asarray(t_oil.mean() + sign * np.ptp(t_oil) * ((t - t[0]) / np.ptp(t) - 0.5))


def like_temperature(t: Array, t_oil: Array) -> Array:
    """A time (s) that goes with the oil's temperature, over the same span; time itself where the temperature is not
    known to change.
    """
    return t if np.ptp(t_oil) == 0.0 else np.asarray(t[0] + np.ptp(t) * (t_oil - t_oil.min()) / np.ptp(t_oil))
