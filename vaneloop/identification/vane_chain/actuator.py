"""Stage `actuator`: stroke from the servo valve's current, in windows with the stroke free."""

from __future__ import annotations

from functools import partial

import numpy as np

from plant import chain, places
from plant.drive import nominal_compliance
from plant.effects import piston_stiction
from plant.parameters import derive
from plant.places import AERO_LOAD
from plant.stages import actuator_run, ring_loads, step_currents
from plant.stages.blocks import NO_RINGS
from vaneloop.identification.onset import that_begins
from vaneloop.identification.settings import NEAR_STOP, RASTER, SIMPLER, SUBSTEPS, WINDOW
from vaneloop.identification.subsystem import Array, Named, Stage, without_jumps
from vaneloop.identification.vane_chain.parameters import declared_by_side, lanes_by_side, like_time
from vaneloop.identification.vane_chain.resample import lately, rms
from vaneloop.identification.vane_chain.subsystem_data import Driven, Made, excerpts

__all__ = ["actuator_stage"]


@that_begins
def actuator_stage(driven: Driven) -> Stage:
    """Stroke from the current of every tick, started anew in each window.

    That of one of two actuators feels the rings: their loads follow from the other's measured stroke (`plant.unison`).
    """
    t, c, machine, _, outputs, run = driven[:6]
    of = declared_by_side("actuator", driven)
    parameters, effects = of.parameters, of.effects
    (own,) = outputs
    side = driven.side
    signals = driven.signals()
    dt = float(t[1] - t[0])
    # the current of every tick, where it is known: its noise is dither to a valve with hysteresis or overlap
    substeps = c["ticks"].shape[1] if "ticks" in c else SUBSTEPS if dt < 1.5 * RASTER else int(round(dt / 2e-3))
    i = np.ascontiguousarray(c.get("ticks", c["i_cmd"]) * 1e-3)
    others = np.ascontiguousarray(c["other_ticks"] * 1e-3) if "other_ticks" in c else i
    n_r = np.ascontiguousarray(c.get("n_r", np.zeros(len(t))))
    p_s, t_oil = np.ascontiguousarray(c["p_s"] * 1e6), np.ascontiguousarray(c["t_oil"])
    x = np.ascontiguousarray(c[own] * 1e-3)
    both = None if side is None or driven.both is None else np.ascontiguousarray(np.array(driven.both) * 1e-3)

    logged = step_currents(i, dt, substeps)

    def simulate(thetas: Array, current: Array = logged, t_oil: Array = t_oil, p_s: Array = p_s) -> Array:
        each = lanes_by_side(driven, thetas, of)
        p, rings = each[side or 0], NO_RINGS
        if side is not None:
            p[AERO_LOAD] *= machine.share_of_load
            rings = NO_RINGS if both is None else ring_loads(both, t_oil, dt, each[0], each[1], side)
        derive(p, dt / current.shape[1], dt)
        s = np.zeros((chain.N_STATE, len(thetas)))
        s[places.X] = s[places.X_LVDT] = x[0]
        out = np.empty((len(thetas), 1, len(t)))
        known = driven.slipping(signals, p)
        actuator_run(current, n_r, p_s, t_oil, dt, p, s, out[:, 0].T, x, int(round(WINDOW / dt)), known,
                     rings)  # fmt: skip
        out *= 1e3
        return out

    # a piston that leaned on a stop leaves it only when its chambers have turned their pressures round, which no
    # valve's curve tells
    stroke = np.clip(c[own], 0.0, known_stroke := machine.table.actuator.stroke.value)
    leaning = np.minimum(stroke, known_stroke - stroke) < NEAR_STOP
    run = run & (leaning | ~lately(leaning, WINDOW, dt))
    measured = driven.measured(run)
    stage = Stage(driven.name("actuator"), outputs, ("mm",), parameters, effects, simulate, t, measured, window=WINDOW)
    stage.finer = lambda thetas: simulate(thetas, step_currents(i, dt, 4 * substeps))
    ageing = like_time(t, t_oil)
    stage.twins = {name: ("time", lambda thetas: simulate(thetas, t_oil=ageing)) for name in ("oil_viscosity",)}
    stage.alike = {driven.own("valve_flow_saturation"): partial(_quadratic_drag, driven.own("valve_flow_saturation"))}
    window = int(round(WINDOW / dt))

    trapped = nominal_compliance(machine.p, side or 0)
    columns, other = stage.index(), step_currents(others, dt, substeps)

    def hidden(theta: Array) -> Array:
        out = simulate(theta[None])[0]
        between = rms(stage, out - simulate(theta[None], other)[0])
        stiction, soft = driven.own("piston_stiction"), driven.own("oil_compressibility")
        if stiction not in columns or theta[columns[stiction].start] == 0.0:
            return between
        excess, speed = theta[columns[stiction]] * (1.0, 1e-3)
        give = trapped
        if soft in columns:
            give += 1e-6 * float(theta[columns[soft].start])  # mm/kN
        force = piston_stiction.scatter(np.gradient(without_jumps(stage, out[0])) * 1e-3 / dt, excess, speed)
        return np.hypot(between, 1e3 * give * float(np.sqrt(np.mean(force[np.isfinite(measured[0])] ** 2))))

    if assumed := driven.assumed:
        moved = {"p_s": p_s + 1e6 * assumed.get("p_s", 0.0), "t_oil": t_oil + assumed.get("t_oil", 0.0)}
        neutral = stage.neutral()[None]
        as_assumed = simulate(neutral)[0]
        stage.unlogged = np.array([simulate(neutral, **{c: moved[c]})[0] - as_assumed for c in moved if c in assumed])
    stage.raster_error = np.array([SIMPLER[machine.kind]])
    if others is not i:
        stage.hidden = hidden
        if not driven.again:
            neutral = stage.neutral()[None]
            lost = simulate(neutral) - simulate(neutral, other)
            stage.raster_error = np.hypot(stage.raster_error, rms(stage, lost[0]))
            if c["missing"].any():  # most of it is where samples of the current are missing
                stage.lost = lost

    def kept(at: Array) -> Array:
        keep = run[at]
        for b in np.flatnonzero(np.diff(at, prepend=at[0]) != 1):  # the spool and the lags come from another time
            keep[b : b + window] = False
        return keep

    stage.counted = kept
    stage.excerpt, stage.made = excerpts(actuator_stage, driven, stage, kept), Made(actuator_stage, driven)
    return stage


def _quadratic_drag(effect: str, named: Named) -> str:
    """A drag b v^2 takes b v^2 / A off the pressure drop of the orifices, so v = v0 / sqrt(1 + (v0 / limit)^2): an
    orifice in series, the round end of the saturation.
    """
    round_end = float(named[effect]["roundness"]["high"]) >= 1.0 - 1e-6
    return "a drag that grows with the square of the speed" if round_end else ""
