"""The vane chain as stages: the only module of the search that knows what a vane is.

| stage    | driven by (logged)            | explains (logged)            | scored
                |
|----------|-------------------------------|------------------------------|---------------------------------------------------|
| demand   | n_dem, n_r                    | x_dem                        | the firmware's own trend, tables and rate
           limits  |
| servo    | x_dem, x_lvdt                 | i_cmd                        | windows, integral free
                |
| engine   | n_dem                         | n_r                          | free run
                |
| actuator | i_cmd, n_r, p_s, t_oil        | x_lvdt                       | windows, stroke free
                                                |
| linkage  | x_lvdt, n_r, t_oil            | vigv, vgv1, vgv2, jointly    | free run, play a state
                |

All stages run on one raster of 10 ms, the ECU frame's period, or the log's own where that is slower. Noise floors are
measured on the errors of the nominal model, whose motion is mostly gone, and where the raster is slow the error that it
causes is measured and added.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import binary_propagation, uniform_filter1d
from scipy.signal import savgol_coeffs, savgol_filter

from controller import Calibration, load_calibration, new_state
from controller.records import RUN, SLOW_TICK, Record, as_scalars, as_state
from controller.schedule import ROW_EXTENSION, ROW_RETRACTION, move_demand, schedule_step
from controller.trend import trend_step
from hil.figures import noise_floor
from hil.logs import Channel, Log, LogError
from hil.loop.tick import flashed
from plant import Plant, build_plant, chain, places
from plant.effects import EFFECTS, ROW
from plant.geometry import STANDS_FOR
from plant.linkage import STAGES
from plant.parameters import NAMES, derive, nominal
from plant.stages import actuator_run, engine_run, linkage_run, step_currents
from vaneloop.base.compiled import compiled
from vaneloop.discrepancy.stage import Array, Effect, Parameter, Stage, noise_of

__all__ = ["STAGE_ORDER", "Chain", "build_chain"]

STAGE_ORDER = ("demand", "servo", "engine", "actuator", "linkage")
RASTER = 1e-2  # s
WINDOW = 1.0  # s
SUBSTEPS = 5  # of the actuator between two samples of 10 ms
NEAR_STOP = 0.3  # mm, where a piston rests on its stop
SETTLE = 3.0  # s at the start of a log that do not count: filters, lags and play forget how they started
FREE = {  # nominal parameters that a stage refits within their tolerance
    "demand": (),
    "servo": (),
    "engine": ("engine.lag", "engine.acceleration", "engine.deceleration"),
    "actuator": ("actuator.flow_gain", "valve.bandwidth", "valve.damping", "sensors.lvdt_lag"),
    "linkage": (
        *(f"linkage.{s}_play" for s in STAGES),
        *(f"sensors.{s}_bias" for s in STAGES),
        *(f"linkage.{s}_{length}" for s in STAGES for length in STANDS_FOR),
    ),
}
LEAST_FLOOR = {
    "demand": 2e-3,
    "servo": 1e-3,
    "engine": 1e-4,
    "actuator": 1e-4,
    "linkage": 1e-3,
}  # border units: nobody measures finer

# mm: what a valve and piston without mass and oil spring leave of one that has them; logs of the rig without noise
# leave 0.0004
QUASI_STATIC = 4e-4


@dataclass
class Chain:
    """The stages of one log.

    stages        the stages that can be judged
    not_observed  stage -> what the log lacks
    columns       channel -> values on the common raster ``t`` (border units), for plots
    """

    t: Array
    stages: list[Stage]
    not_observed: dict[str, str]
    columns: dict[str, Array]
    plant: Plant
    calibration: Calibration
    notes: list[str] = field(default_factory=list)

    def stage(self, name: str) -> Stage:
        """Return a stage by name."""
        return next(s for s in self.stages if s.name == name)


def build_chain(
    log: Log, plant: Plant | None = None, calibration: Calibration | None = None, present: tuple[str, ...] = ()
) -> Chain:
    """Put ``log`` on one raster and make every stage that its channels allow.

    present  effects that the model already has: they are part of ``plant`` and not tried again
    """
    machine = plant or build_plant()
    cal = flashed(calibration or load_calibration(), machine)
    t, columns, fresh, lacking, notes = _raster(log)
    if len(t) < 500:
        raise LogError(
            f"{log.path}: {len(t)} samples of {t[1] - t[0] if len(t) > 1 else 0:g} s; at least 500 are needed to "
            f"search for missing physics"
        )
    dt = float(t[1] - t[0])
    # after a gap everything is as at the start of a log: what the stages remember must come from the rows behind it
    fresh = ~binary_propagation(~fresh, mask=~fresh | lacking)
    stretch = _stretches(fresh)
    usable = fresh & (_since(t, stretch) >= SETTLE) & _no_gap_in_window(t, fresh)
    run = law_holds = machine_rows = currents = usable
    spell = machine_spell = stretch
    if "state" in columns:
        running = np.round(columns["state"]) == RUN
        run = usable & running
        spell = _stretches(fresh & running)  # nor is it known what a controller in another mode has made of the demand
        law_holds = run & (_since(t, spell) >= SETTLE)  # back in RUN, it first catches up
        # the machine obeys its physics in any mode; where the controller mostly stood aside, that is all there is
        share = float(run.sum()) / max(float(usable.sum()), 1.0)
        machine_rows = run if share >= 0.5 else usable
        machine_spell = spell if share >= 0.5 else stretch
        currents = law_holds if share >= 0.5 else usable  # between two rows they follow from the firmware's law
        if share < 0.5:
            notes.append(
                f"state: mode RUN in {share:.0%} of the log; engine, actuator and linkage are judged in all modes"
            )
    supply = machine.table.supply
    filled = {"p_s": supply.pressure.value, "t_oil": supply.temperature.value}
    have = {**columns, "stretch": stretch, "spell": spell, "machine_spell": machine_spell}
    have |= {"fresh": fresh.astype(float), "missing": lacking.astype(float)}
    for name, value in filled.items():
        if name not in have:
            have[name] = np.full(len(t), value)
            notes.append(f"{name}: not logged; {value:g} assumed, and effects that need it to change cannot be seen")
    if {"x_lvdt", "i_cmd"} <= columns.keys():
        smooth = _without_noise(t, have, machine)
    if dt < 1.5 * RASTER and {"x_lvdt", "i_cmd"} <= columns.keys():
        if "x_dem" in columns:
            law, off = _law(t, have, cal, smooth)
            what = _other_current(t, have, law, run, cal)
            if what:
                notes.append(
                    f"i_cmd: {what}, not the mean of those since the row before, which is worked out from stroke and "
                    f"demand"
                )
                columns["i_cmd"] = have["i_cmd"]
                smooth = _without_noise(t, have, machine)
                law, off = _law(t, have, cal, smooth)
            sampled = what == SAMPLED
            have["law"], have["law_error"] = law, off[:, -1] if sampled else off.mean(axis=1)
            unknown = off.mean(axis=1) - off[:, -1] if sampled else None
            size = cal.scalars.kp * smooth.noise
            have["ticks"], have["other_ticks"] = (
                _between_rows(have, law, size, run, cal, unknown, seed) for seed in (0, 1)
            )
        have["stroke"] = smooth.stroke
    regimes, units = _regimes(t, columns)
    makers: dict[str, tuple[tuple[str, ...], tuple[str, ...], Callable[..., Stage]]] = {
        "demand": (("n_dem", "n_r"), ("x_dem",), _demand),
        "servo": (("x_dem", "x_lvdt"), ("i_cmd",), _servo),
        "engine": (("n_dem",), ("n_r",), _engine),
        "actuator": (("i_cmd",), ("x_lvdt",), _actuator),
        "linkage": (("x_lvdt",), STAGES, _linkage),
    }
    stages, absent = [], {}
    for name in STAGE_ORDER:
        needs, gives, make = makers[name]
        missing = [c for c in needs if c not in columns]
        outputs = tuple(c for c in gives if c in columns)
        if missing or not outputs:
            absent[name] = "no " + ", ".join(missing or gives)
            continue
        if name in ("servo", "demand") and dt > 1.5 * RASTER:
            absent[name] = f"raster of {dt:g} s; the controller works every 0.01 s"
            continue
        rows = law_holds if name in ("servo", "demand") else currents if name == "actuator" else machine_rows
        stage = make(t, have, machine, cal, outputs, rows, present)
        stage.regimes, stage.regime_units = regimes, units
        if np.isfinite(stage.measured).sum() < 300:
            absent[name] = "fewer than 300 samples in mode RUN without gaps"
            continue
        if dt > 1.5 * RASTER:
            # a corner of an input between two rows costs about as much as the corners that the doubled raster loses
            # besides
            coarse = make(t[::2], _every_other(have), machine, cal, outputs, rows[::2], present)
            more = _rms(coarse, stage.run(stage.neutral()[None])[0][:, ::2] - coarse.run(coarse.neutral()[None])[0])
            stage.raster_error = more if stage.raster_error is None else np.hypot(stage.raster_error, more)
        least = LEAST_FLOOR[name]
        if name == "actuator":
            # the error of a stage that integrates moves most: the stroke by itself, or freed of a fitted model's
            # motion, may be quieter
            channel = noise_floor(t, stage.measured[0])
            freed = noise_floor(t, np.where(np.isfinite(stage.measured[0]), smooth.off, np.nan))
            stage.quiet = np.maximum([min(channel, freed)], least)
        stage.noise = lambda when, error, least=least: max(noise_floor(when, error), least)
        stage.floor = noise_of(stage, stage.neutral())
        stages.append(stage)
    return Chain(t, stages, absent, columns, machine, cal, notes)


# ---- raster ----------------------------------------------------------------------------------------------------------


def _raster(log: Log) -> tuple[Array, dict[str, Array], Array, Array, list[str]]:
    """All channels on one uniform raster; which samples are near measured ones; at which some channel misses a row of
    its own; notes.
    """
    channels = log.channels
    steps = [float(np.median(np.diff(c.t))) for c in channels.values() if len(c.t) > 10]
    if not steps:
        raise LogError(f"{log.path}: no channel has more than 10 samples")
    dt = max(RASTER, round(float(np.median(steps)) / RASTER) * RASTER)
    start = max(c.t[0] for c in channels.values() if len(c.t) > 10)
    end = min(c.t[-1] for c in channels.values() if len(c.t) > 10)
    start += _to_frame(channels, start, dt)
    reference = max((c for c in channels.values()), key=lambda c: len(c.t))
    own = float(np.median(np.diff(reference.t)))
    phase = float(np.median((reference.t - start + 0.5 * own) % own) - 0.5 * own) if own >= 0.5 * dt else 0.0
    t = np.arange(max(1, int((end - start) / dt + 1e-6) + 1)) * dt
    fresh, missing = np.ones(len(t), dtype=bool), np.zeros(len(t), dtype=bool)
    columns = {}
    for name, c in channels.items():
        if len(c.t) < 2:
            columns[name] = np.full(len(t), c.values[0] if len(c.t) else np.nan)
            continue
        when = t + start + phase
        step = float(np.median(np.diff(c.t)))
        uniform = np.abs(np.diff(c.t) - step) < 0.3 * step
        if name == "i_cmd" and step < 0.6 * dt:
            total = np.concatenate([[0.0], np.cumsum(c.values)])
            edge = np.searchsorted(c.t, np.concatenate([[when[0] - dt], when]) + 0.5 * step)
            count = np.maximum(np.diff(edge), 1)
            columns[name] = np.diff(total[edge]) / count
        elif (
            uniform.mean() > 0.98 and abs(step - dt) < 0.02 * dt or name in ("n_dem", "x_dem", "state") or _held(c, dt)
        ):
            # rows of a regular logger: the nearest row, whatever its clock's jitter; commands and what comes in frames
            # hold their value
            i = np.clip(np.searchsorted(c.t, when + 0.5 * step) - 1, 0, len(c.t) - 1)
            columns[name] = c.values[i]
        else:
            columns[name] = np.interp(when, c.t, c.values)
        i = np.clip(np.searchsorted(c.t, when), 1, len(c.t) - 1)
        away = np.minimum(np.abs(c.t[i] - when), np.abs(when - c.t[i - 1]))
        fresh &= away < 1.5 * max(step, dt)  # one or two rows are bridged, more are a gap
        missing |= away > 0.75 * max(step, dt)
    return t, columns, fresh, missing, list(log.notes)


def _held(c: Channel, dt: float) -> bool:
    """Whether the channel is logged faster than the raster and yet holds its value for rows: it came in frames."""
    step = float(np.median(np.diff(c.t))) if len(c.t) > 1 else np.inf
    return bool(step < 0.6 * dt and np.count_nonzero(np.diff(c.values)) < 0.3 * len(c.t))


def _to_frame(channels: Mapping[str, Channel], start: float, dt: float) -> float:
    """Return the time from ``start`` to the controller's next frame, as the commands in a log faster than the frames
    show it; else 0.
    """
    for name in ("x_dem", "n_dem"):
        if name in channels and _held(channels[name], dt):
            c = channels[name]
            turn = np.exp(2j * np.pi * (c.t[1:][np.diff(c.values) != 0.0] - start) / dt)
            if len(turn) > 20 and abs(turn.mean()) > 0.5:
                return float(np.angle(turn.mean()) / (2.0 * np.pi) % 1.0 * dt)
    return 0.0


def _every_other(columns: dict[str, Array]) -> dict[str, Array]:
    """Every other row; of the current, which is a mean since the row before, the mean of two."""
    out = {k: v[::2] for k, v in columns.items()}
    if "i_cmd" in columns:
        i = columns["i_cmd"]
        out["i_cmd"] = np.concatenate([i[:1], 0.5 * (i[1:-1:2] + i[2::2])])
    return out


def _rms(stage: Stage, difference: Array) -> Array:
    """RMS of a difference of outputs where the stage counts them, its windows' constants free: float64[outputs]."""
    e = np.where(np.isfinite(stage.measured), difference, np.nan)
    if stage.window:
        w = int(round(stage.window / (stage.t[1] - stage.t[0])))
        e = e[:, : e.shape[1] // w * w].reshape(len(e), -1, w)
        e = (e - e.mean(axis=2, keepdims=True)).reshape(len(e), -1)
    return np.asarray(np.sqrt(np.nansum(e**2, axis=1) / np.maximum(np.isfinite(e).sum(axis=1), 1)))


def _stretches(good: Array) -> Array:
    """Number of the stretch of good rows that each row belongs to, from 0; a row that is not good belongs to the
    stretch before it.
    """
    begins = good & ~np.concatenate([[False], good[:-1]])
    begins[0] = False
    return np.cumsum(begins)


def _since(t: Array, stretch: Array) -> Array:
    """Time since the first row of each row's stretch, s."""
    return np.asarray(t - t[np.searchsorted(stretch, stretch)])


def _pieces(stretch: Array) -> list[slice]:
    """Rows of each stretch."""
    edges = [0, *(np.flatnonzero(np.diff(stretch)) + 1).tolist(), len(stretch)]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def _no_gap_in_window(t: Array, fresh: Array) -> Array:
    w = (t / WINDOW).astype(int)
    bad = np.unique(w[~fresh])
    return ~np.isin(w, bad)


def _regimes(t: Array, columns: dict[str, Array]) -> tuple[dict[str, Array], dict[str, str]]:
    """Conditions under which a stage may fail."""
    out: dict[str, Array] = {"time": t}
    units = {"time": "s"}
    dt = t[1] - t[0]
    if "x_lvdt" in columns:
        x = columns["x_lvdt"]
        k = max(3, int(round(0.1 / dt)))
        smooth = np.convolve(np.pad(x, k, mode="edge"), np.ones(2 * k + 1) / (2 * k + 1), mode="valid")
        v = np.gradient(smooth, dt)
        out |= {"stroke": x, "stroke speed": v, "direction": np.sign(np.where(np.abs(v) > 0.2, v, 0.0))}
        units |= {"stroke": "mm", "stroke speed": "mm/s", "direction": ""}
        turns = np.zeros(len(t))
        last, sign = smooth[0], 0.0
        for i in range(1, len(t)):
            if abs(v[i]) > 0.2 and np.sign(v[i]) != sign:
                sign, last = float(np.sign(v[i])), smooth[i]
            turns[i] = abs(smooth[i] - last)
        out["distance since reversal"], units["distance since reversal"] = turns, "mm"
    for name, label, unit in (
        ("n_r", "rotor speed", "%"),
        ("t_oil", "oil temperature", "degC"),
        ("p_s", "supply pressure", "MPa"),
    ):
        if name in columns:
            out[label], units[label] = columns[name], unit
    if "i_cmd" in columns:
        out["current"], units["current"] = columns["i_cmd"], "mA"
    return out, units


# ---- parameters and effects ------------------------------------------------------------------------------------------


def _declared(
    stage: str, machine: Plant, present: tuple[str, ...]
) -> tuple[tuple[Parameter, ...], tuple[Effect, ...], Array, Array]:
    """Parameters and effects of a stage, the rows of the plant's parameter array behind its columns, and their factors
    to SI.
    """
    known = {n.name: n for n in nominal(machine.table, machine.geometry)}
    parameters, rows, si = [], [], []
    for name in FREE[stage]:
        if name not in known:
            continue
        n = known[name]
        value = float(machine.p[n.row, 0]) / n.si
        if name.endswith("_play"):
            # the play is known at the vane and used at the ring
            factor = machine.p[n.row, 0] / (n.value * n.si)
            parameters.append(Parameter(name, n.value, n.unit, 0.0, np.inf, n.tolerance, _vane(name)))
            si.append(n.si * factor)
        else:
            parameters.append(Parameter(name, value, n.unit, -np.inf, np.inf, n.tolerance, _vane(name)))
            si.append(n.si)
        rows.append(n.row)
    effects = []
    for e in EFFECTS.values():
        if stage not in e.stages or e.name in present:
            continue
        ps = tuple(
            Parameter(
                p.name,
                p.neutral,
                p.unit,
                p.low,
                p.high,
                KNOWN.get(p.name, 0.0) * p.neutral,
                _vane(p.name),
                shape=p.name in SHAPES,
                period=p.period,
            )
            for p in e.parameters
        )
        effects.append(Effect(e.name, ps, _starts(e.name, ps), e.excites))
        rows += list(range(ROW[e.name], ROW[e.name] + len(ps)))
        si += [p.si for p in e.parameters]
    return tuple(parameters), tuple(effects), np.array(rows, dtype=int), np.array(si)


def _vane(name: str) -> str | None:
    """The vane stage that a parameter belongs to."""
    return next((v for v in STAGES if v in name), None)


SIZES = (0.003, 0.03, 0.2, 0.6)  # of the way from neutral to a bound
FIXED_START = {"speed": 5.0, "distance": 0.3, "spread": 0.6}  # of second parameters
SHAPES = (*FIXED_START, "phase", "roundness")
KNOWN = {
    "drag": 0.5
}  # half-width, of its neutral value, to which a second parameter is known: few logs show it by itself
FACTORS = (0.8, 0.95, 0.99, 1.01, 1.05, 1.25)


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
    second = [FIXED_START.get(p.name, p.value) for p in ps]
    mains = [i for i, p in enumerate(ps) if p.name not in SHAPES]
    out = []
    for size in SIZES if ps[mains[0]].value == 0.0 else range(len(FACTORS)):
        for sign in (1.0, -1.0):
            start = list(second)
            ok = True
            for i in mains:
                p = ps[i]
                if p.value == 0.0:
                    v = sign * size * (p.high if sign > 0 else -p.low)
                else:
                    v = p.value * FACTORS[int(size)]
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


def _lanes(machine: Plant, thetas: Array, rows: Array, si: Array) -> Array:
    """The plant's parameter array with one lane per parameter set."""
    p = np.repeat(machine.p, len(thetas), axis=1)
    p[rows] = (thetas * si).T
    return p


def _on_two_cores(simulate: Callable[[Array], Array], thetas: Array, least: int) -> Array:
    """simulate(thetas), half of it in a second thread where there are more than ``least`` sets: compiled code needs no
    interpreter.
    """
    if len(thetas) <= least:
        return simulate(thetas)
    half = -(-len(thetas) // 2 // least) * least
    with ThreadPoolExecutor(1) as other:
        second = other.submit(simulate, thetas[half:])
        first = simulate(thetas[:half])
        return np.concatenate([first, second.result()])


# ---- stages ----------------------------------------------------------------------------------------------------------


def _engine(
    t: Array,
    c: dict[str, Array],
    machine: Plant,
    cal: Calibration,
    outputs: tuple[str, ...],
    run: Array,
    present: tuple[str, ...],
) -> Stage:
    parameters, effects, rows, si = _declared("engine", machine, present)
    dt = float(t[1] - t[0])
    n_dem = np.ascontiguousarray(c["n_dem"])
    inner = 1
    if dt > 1.5 * RASTER:  # between rows of a slow log the demand is taken to run straight
        inner = int(round(dt / RASTER))
        n_dem = np.interp(np.arange(len(t) * inner) / inner, np.arange(len(t)), n_dem)
    pieces = _pieces(c["stretch"])
    second = max(1, int(round(1.0 / dt)))

    def simulate(thetas: Array) -> Array:
        p = _lanes(machine, thetas, rows, si)
        s = np.zeros((chain.N_STATE, len(thetas)))
        out = np.empty((len(n_dem), len(thetas)))
        for piece in pieces:
            head = min(piece.start + second, piece.stop)
            start = np.full(len(thetas), np.median(c["n_r"][piece][:5]))
            # at its rate limit the engine never forgets how it began: the speed at the start is what suits the first
            # second
            for stop in (head, piece.stop):
                inside = slice(piece.start * inner, stop * inner)
                s[places.N_R] = start
                engine_run(n_dem[inside], dt / inner, p, s, out[inside])
                start = start + np.mean(
                    c["n_r"][piece.start : head, None] - out[piece.start * inner : head * inner : inner], axis=0
                )
        return out[::inner].T[:, None, :]

    return Stage("engine", outputs, ("%",), parameters, effects, simulate, t, np.where(run, c["n_r"], np.nan)[None])


def _actuator(
    t: Array,
    c: dict[str, Array],
    machine: Plant,
    cal: Calibration,
    outputs: tuple[str, ...],
    run: Array,
    present: tuple[str, ...],
) -> Stage:
    parameters, effects, rows, si = _declared("actuator", machine, present)
    dt = float(t[1] - t[0])
    # the current of every tick, where it is known: its noise is dither to a valve with hysteresis or overlap
    substeps = c["ticks"].shape[1] if "ticks" in c else SUBSTEPS if dt < 1.5 * RASTER else int(round(dt / 2e-3))
    i = np.ascontiguousarray(c.get("ticks", c["i_cmd"]) * 1e-3)
    others = np.ascontiguousarray(c["other_ticks"] * 1e-3) if "other_ticks" in c else i
    n_r = np.ascontiguousarray(c.get("n_r", np.zeros(len(t))))
    p_s, t_oil = np.ascontiguousarray(c["p_s"] * 1e6), np.ascontiguousarray(c["t_oil"])
    x = np.ascontiguousarray(c["x_lvdt"] * 1e-3)

    logged = step_currents(i, dt, substeps)

    def simulate(thetas: Array, current: Array = logged, t_oil: Array = t_oil) -> Array:
        p = _lanes(machine, thetas, rows, si)
        derive(p, dt / current.shape[1], dt)
        s = np.zeros((chain.N_STATE, len(thetas)))
        s[places.X] = s[places.X_LVDT] = x[0]
        out = np.empty((len(thetas), 1, len(t)))
        actuator_run(current, n_r, p_s, t_oil, dt, p, s, out[:, 0].T, x, int(round(WINDOW / dt)))
        out *= 1e3
        return out

    # a piston that leaned on a stop leaves it only when its chambers have turned their pressures round, which no
    # valve's curve tells
    stroke = np.clip(c["x_lvdt"], 0.0, known_stroke := machine.table.actuator.stroke.value)
    leaning = np.minimum(stroke, known_stroke - stroke) < NEAR_STOP
    run = run & (leaning | ~_lately(leaning, WINDOW, dt))
    measured = np.where(run, c["x_lvdt"], np.nan)[None]
    stage = Stage("actuator", outputs, ("mm",), parameters, effects, simulate, t, measured, window=WINDOW)
    stage.finer = lambda thetas: simulate(thetas, step_currents(i, dt, 4 * substeps))
    ageing = _like_time(t, t_oil)
    stage.twins = {name: ("time", lambda thetas: simulate(thetas, t_oil=ageing)) for name in ("oil_viscosity",)}
    window = int(round(WINDOW / dt))

    def hidden(theta: Array) -> Array:
        return _rms(stage, simulate(theta[None])[0] - simulate(theta[None], step_currents(others, dt, substeps))[0])

    stage.raster_error = np.array([QUASI_STATIC])
    if others is not i:
        stage.hidden = hidden
        stage.raster_error = np.hypot(stage.raster_error, hidden(stage.neutral()))

    def excerpt(at: Array) -> Stage:
        begins = np.flatnonzero(np.diff(at, prepend=at[0] - 2) != 1)
        keep = run[at]
        for b in begins:  # the spool and the lags come from another time
            keep[b : b + window] = False
        part = _actuator(t[at], {k: v[at] for k, v in c.items()}, machine, cal, outputs, keep, present)
        part.floor, part.quiet, part.noise, part.raster_error = (
            stage.floor,
            stage.quiet,
            stage.noise,
            stage.raster_error,
        )
        return part

    stage.excerpt = excerpt
    return stage


def _linkage(
    t: Array,
    c: dict[str, Array],
    machine: Plant,
    cal: Calibration,
    outputs: tuple[str, ...],
    run: Array,
    present: tuple[str, ...],
) -> Stage:
    parameters, effects, rows, si = _declared("linkage", machine, present)
    dt = float(t[1] - t[0])
    x = np.ascontiguousarray(c.get("stroke", c["x_lvdt"]) * 1e-3)
    n_r = np.ascontiguousarray(c.get("n_r", np.zeros(len(t))))
    t_oil = np.ascontiguousarray(c["t_oil"])
    which = [STAGES.index(o) for o in outputs]
    first = [float(np.deg2rad(np.median(c[o][:5]))) if o in c else np.nan for o in STAGES]

    def simulate(thetas: Array, t: Array = t, t_oil: Array = t_oil) -> Array:
        p = _lanes(machine, thetas, rows, si)
        derive(p, dt, dt)
        start = machine.start(stroke=x[0], n_r=n_r[0])
        machine.place_rings(start, tuple(first))
        s = np.repeat(start, len(thetas), axis=1)
        out = np.empty((len(t), 3, len(thetas)))
        linkage_run(x, n_r, t_oil, t, dt, p, s, out)
        return np.rad2deg(out[:, which].transpose(2, 1, 0))

    # until the stroke has crossed the play twice over, nobody knows where in it the rings started; nor where they were
    # left at full speed by a controller that had to catch up, which turns between two rows
    first_spell, settled = c["machine_spell"] == c["machine_spell"][0], _since(t, c["machine_spell"]) >= SETTLE
    known = np.zeros(len(t), dtype=bool)
    for piece in _pieces(c["machine_spell"]):
        counts = np.flatnonzero((first_spell | settled)[piece]) + piece.start
        known[counts] = _crossed(c["x_lvdt"][counts])
    if known.any():
        run = run & known
    measured = np.array([np.where(run, c[o], np.nan) for o in outputs])
    both = partial(_on_two_cores, simulate, least=32)  # a block of lanes
    stage = Stage("linkage", outputs, ("deg",) * len(outputs), parameters, effects, both, t, measured)
    ageing, warming = _like_time(t, t_oil), _like_temperature(t, t_oil)
    stage.twins = {
        "linkage_wear": ("oil temperature", lambda thetas: simulate(thetas, t=warming)),
        **{
            name: ("time", lambda thetas: simulate(thetas, t_oil=ageing))
            for name in ("thermal_growth", "lvdt_thermal_drift")
        },
    }

    def excerpt(at: Array) -> Stage:
        keep = run[at]
        for piece in np.split(np.arange(len(at)), np.flatnonzero(np.diff(at) != 1) + 1):
            keep[piece] &= _crossed(c["x_lvdt"][at[piece]])
        part = _linkage(t[at], {k: v[at] for k, v in c.items()}, machine, cal, outputs, keep, present)
        part.floor, part.quiet, part.noise, part.raster_error = (
            stage.floor,
            stage.quiet,
            stage.noise,
            stage.raster_error,
        )
        return part

    stage.excerpt = excerpt
    return stage


def _like_time(t: Array, t_oil: Array) -> Array:
    """A temperature (degC) that goes straight with time, as far up or down as the oil's went."""
    if np.ptp(t_oil) == 0.0:
        return np.linspace(-0.5, 0.5, len(t)) + t_oil[0]
    sign = 1.0 if np.corrcoef(t, t_oil)[0, 1] >= 0.0 else -1.0
    return np.asarray(t_oil.mean() + sign * np.ptp(t_oil) * ((t - t[0]) / np.ptp(t) - 0.5))


def _like_temperature(t: Array, t_oil: Array) -> Array:
    """A time (s) that goes with the oil's temperature, over the same span; time itself where the temperature is not
    known to change.
    """
    return t if np.ptp(t_oil) == 0.0 else np.asarray(t[0] + np.ptp(t) * (t_oil - t_oil.min()) / np.ptp(t_oil))


def _crossed(x: Array) -> Array:
    """Samples from which on the stroke x (mm) has crossed any ring's play: where in it the ring began is forgotten."""
    return np.asarray(np.maximum.accumulate(x) - np.minimum.accumulate(x) > 3.0)


SMOOTH = (9, 15, 25, 41)  # rows over which the stroke's noise may be smoothed
SMOOTH_ORDER = 3
BENDS = (0.3, 0.6, 0.85, 0.97)  # shares of the rows that move less: where the curve of flow over opening may bend


class _Smooth(NamedTuple):
    """Stroke (mm) at the rows with less of the LVDT's noise; its RMS (mm); errors (mm) such as it leaves, and as
    smoothing makes.

    off: mm, the logged stroke less the fitted model's, whose motion is mostly gone.
    """

    stroke: Array
    noise: float
    left: Array
    distortion: Array
    off: Array


def _without_noise(t: Array, c: dict[str, Array], machine: Plant) -> _Smooth:
    """The logged stroke with less of the LVDT's noise in it: the nominal model's, plus what it is off by, smoothed.

    The model takes the motion out, so that what is smoothed changes slowly; over how many rows, is decided by
    leave-one-out errors.
    """
    dt = float(t[1] - t[0])
    p = machine.p.copy()
    p[NAMES.index("actuator.stroke")] = 2e3  # the stops out of the way: a wrong null runs away in minutes
    derive(p, dt / SUBSTEPS, dt)
    s = np.zeros((chain.N_STATE, 1))
    s[places.X] = s[places.X_LVDT] = s[places.READING] = 1e3
    out = np.empty((len(t), 1))
    n_r = np.ascontiguousarray(c.get("n_r", np.zeros(len(t))))
    current = step_currents(c["i_cmd"] * 1e-3, dt, SUBSTEPS)
    actuator_run(current, n_r, np.ascontiguousarray(c["p_s"] * 1e6), np.ascontiguousarray(c["t_oil"]), dt, p, s, out)
    # the model's steps, calibrated by least squares: the flow of both directions as a curve, its lag, null
    step = np.diff(out[:, 0], prepend=1e3) * 1e3
    bends = [0.0, *np.quantile(np.abs(step), BENDS)]
    sides = [np.maximum(side * step - bend, 0.0) for side in (1.0, -1.0) for bend in bends]
    parts = np.column_stack([np.roll(side, k) for side in sides for k in (-1, 0, 1)] + [np.ones(len(t))])
    logged = np.diff(c["x_lvdt"], prepend=c["x_lvdt"][0])
    whole = uniform_filter1d(c["fresh"], 5) > 0.999  # rows with their neighbours
    calibrated = parts @ np.linalg.lstsq(parts[whole], logged[whole], rcond=None)[0]
    model = np.cumsum(np.where(whole, calibrated, logged))  # over a gap the model goes where the stroke went
    off = c["x_lvdt"] - model
    tried = []
    for rows in SMOOTH:
        smooth, own = savgol_filter(off, rows, SMOOTH_ORDER), savgol_coeffs(rows, SMOOTH_ORDER)[rows // 2]
        left = float(np.mean((off - smooth) ** 2)) / (1.0 - own)  # white noise leaves 1 - own of its power
        tried.append((left / (1.0 - own), rows, np.sqrt(left), smooth))
    _, rows, size, smooth = min(tried, key=lambda x: x[0])
    noise = min(noise_floor(t, np.where(whole, off, np.nan)), size)
    left = savgol_filter(noise * np.random.default_rng(1).standard_normal(len(t)), rows, SMOOTH_ORDER)
    distortion = smooth - savgol_filter(off, rows // 4 * 2 + 1, SMOOTH_ORDER)
    fast = np.abs(distortion) > 2.0 * noise  # rather noisy than wrong
    return _Smooth(
        np.where(fast, c["x_lvdt"], model + smooth), noise, left, np.where(fast, off - smooth, distortion), off
    )


def _law(t: Array, c: dict[str, Array], cal: Calibration, smooth: _Smooth) -> tuple[Array, Array]:
    """What the firmware's servo loop makes of logged demand and stroke, but for a constant of its integral.

    At the row it has the logged stroke with its noise; the nine ticks before it had other noise, so theirs is taken off
    the stroke.

    Returns the current (mA) of the ten ticks since the row before, the last at the row, float64[rows, 10]; and a draw
    of how much they are off because the stroke between two rows is not logged, of the same shape.
    """
    x_dem, x = c["x_dem"], c["x_lvdt"]
    kp, ki, kff = (cal.scalars.kp, cal.scalars.ki, cal.scalars.kff)  # A/m = mA/mm
    # ticks since the last row: nine of the ramp before, the first of the new one (docs/controller.md, timing)
    before, two = np.roll(x_dem, 1), np.roll(x_dem, 2)
    before[0], two[:2] = x_dem[0], x_dem[0]
    ramp = two[:, None] + (before - two)[:, None] * (np.arange(2, 12) / 10.0)[None]
    ramp[:, -1] = before + (x_dem - before) / 10.0
    rate = np.repeat((before - two)[:, None], 10, axis=1) / RASTER
    rate[:, -1] = (x_dem - before) / RASTER
    when = np.maximum(t[:, None] - RASTER + chain.TICK * np.arange(1, 11)[None], t[0])
    stroke = CubicSpline(t, smooth.stroke)(when)
    straight = np.interp(when.ravel(), t, smooth.stroke).reshape(when.shape)
    stroke[:, -1] = straight[:, -1] = x
    error = ramp - stroke

    def loop(e: Array) -> Array:
        return np.asarray(kp * e + ki * np.cumsum(e).reshape(e.shape) * chain.TICK)

    # not known: the LVDT's noise in nine ticks, what smoothing leaves at the rows, and the way between them, which is
    # known as well as a straight line and a cubic agree
    noise = smooth.noise * np.random.default_rng(0).standard_normal((len(t), 10))
    off = CubicSpline(t, smooth.left + smooth.distortion)(when) - noise + (stroke - straight)
    off[:, -1] = 0.0
    return loop(error) + kff * rate, loop(off)


def _between_rows(
    c: dict[str, Array], law: Array, size: float, run: Array, cal: Calibration, unknown: Array | None, seed: int
) -> Array:
    """Current (mA) of every tick, float64[rows, 10], whose mean over a row is the logged one.

    Between two rows it is what the firmware's law makes of the stroke between them, and of the LVDT's noise in the nine
    ticks that nobody logged: any noise of that size, for it works like dither on a valve with hysteresis or overlap.
    Where the law does not hold (not in mode RUN, at the current's limit) the current is the row's mean.

    law      of `_law`
    size     mA, RMS of the LVDT's noise in the current
    unknown  mA, such an error as the law left in each row's mean, where that was worked out from its last tick; with
             the noise of about one tick it is added for any ``seed`` but 0
    """
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(law.shape)
    noise[:, -1] = 0.0
    slow = uniform_filter1d(c["i_cmd"] - law.mean(axis=1), SMOOTH[-1])  # the integral's constant
    ticks = law + slow[:, None] + size * noise
    # the row's own tick is known; the others' noise was such that the mean comes out
    ticks[:, :-1] += (c["i_cmd"] - ticks.mean(axis=1))[:, None] * (law.shape[1] / (law.shape[1] - 1.0))
    alone = ~run | (np.abs(c["i_cmd"]) > 0.9e3 * cal.scalars.current_limit)
    ticks[alone] = c["i_cmd"][alone, None]
    if unknown is not None and seed:
        ticks += (unknown + size * rng.standard_normal(len(law)))[:, None]
    return np.asarray(ticks)


SAMPLED = "the current of the tick at each row"
BEFORE = "the mean of the ten ticks before the row"


def _other_current(t: Array, c: dict[str, Array], law: Array, run: Array, cal: Calibration) -> str:
    """Where the log's current is not the mean of the ticks since the row before, the one at the row included, put that
    in its place.

    The firmware's ``law`` on the logged stroke says which it is instead (`SAMPLED`, `BEFORE`; "": neither), and what
    the other ticks added.
    """
    width = int(round(WINDOW / RASTER))
    use = run & (np.abs(c["i_cmd"]) < 0.9e3 * cal.scalars.current_limit)

    def misfit(model: Array) -> float:
        e = np.where(use, c["i_cmd"] - model, np.nan)[: len(t) // width * width].reshape(-1, width)
        e = e[np.isfinite(e).all(axis=1)]
        return float(np.median(np.std(e, axis=1))) if len(e) else 0.0

    mean = law.mean(axis=1)
    others = {SAMPLED: law[:, -1], BEFORE: mean + 0.1 * (np.roll(law[:, -1], 1) - law[:, -1])}
    what = min(others, key=lambda k: misfit(others[k]))
    if misfit(others[what]) >= 0.9 * misfit(mean):
        return ""
    c["i_cmd"] = c["i_cmd"] + (mean - others[what])
    return what


def _servo(
    t: Array,
    c: dict[str, Array],
    machine: Plant,
    cal: Calibration,
    outputs: tuple[str, ...],
    run: Array,
    present: tuple[str, ...],
) -> Stage:
    parameters, effects, _, _ = _declared("servo", machine, present)
    mean, hidden = c["law"].mean(axis=1), c["law_error"]

    def simulate(thetas: Array) -> Array:
        factor = thetas[:, :1] if len(effects) else np.ones((len(thetas), 1))
        i = factor * mean[None]
        return i[:, None, :]

    # at the limit the integral stands still: its constant is another one before and after
    at_limit = np.convolve(np.abs(c["i_cmd"]) >= 0.9e3 * cal.scalars.current_limit, np.ones(5), "same") > 0.5
    near = _no_gap_in_window(t, ~at_limit) & ~(np.convolve(c["missing"], np.ones(9), "same") > 0.5)
    stage = Stage(
        "servo",
        outputs,
        ("mA",),
        parameters,
        effects,
        simulate,
        t,
        np.where(run & near, c["i_cmd"], np.nan)[None],
        window=WINDOW,
    )
    # the part of the hidden error that moves too slowly to be seen as noise in the stage's error
    seen = min(noise_floor(t, hidden), noise_floor(t, stage.measured[0] - mean))
    stage.raster_error = np.sqrt(np.maximum(_rms(stage, hidden) ** 2 - seen**2, 0.0))
    stage.lost = hidden[None]
    return stage


@compiled
def _demand_run(
    first: int,
    last: int,
    t: np.ndarray,
    n_dem: np.ndarray,
    n_r: np.ndarray,
    delay: float,
    hold: float,
    phase: float,
    k: Record,
    table: np.ndarray,
    z: Record,
    out: np.ndarray,
) -> None:
    """The firmware's 10 ms part on the logged frames from row ``first`` to before ``last``: x_dem (m) of every
    frame.
    """
    dt = t[1] - t[0]
    for i in range(first, last):
        at = t[i]
        if hold > 0.0:
            at = np.floor((at - phase) / hold + 1e-9) * hold + phase
        at = (at - delay) / dt
        j = min(max(int(np.floor(at + 1e-9)), first), last - 1)
        w = min(max(at - j, 0.0), 1.0)
        if w < 1e-6 or j == last - 1:
            a, b = n_dem[j], n_r[j]
        else:
            a = n_dem[j] + w * (n_dem[j + 1] - n_dem[j])
            b = n_r[j] + w * (n_r[j + 1] - n_r[j])
        if i == first:
            z.trend_n = a
            z.trend_turn = a
            z.trend_last = a
            z.n_r = b
        z.n_dem = a
        z.n_r += (b - z.n_r) * SLOW_TICK / (k.speed_filter + SLOW_TICK)
        trend_step(z, k, a)
        schedule_step(z, k, table)
        if i == first:
            z.x_dem = z.x_target
        move_demand(z, k, z.x_target, k.stroke_rate)
        out[i] = z.x_dem


@compiled
def _directions(n_dem: np.ndarray, k: Record, z: Record, out: np.ndarray) -> None:
    """Direction of the demand's trend at each row, from the trend's state ``z``."""
    for i in range(len(n_dem)):
        trend_step(z, k, n_dem[i])
        out[i] = z.direction


def _direction_known(n_dem: Array, cal: Calibration) -> Array:
    """Rows at which the trend's direction does not turn on what the demand did before the first of them.

    How far the demand had already come back then is not known: nothing, or nearly all that turns the direction. Where
    the two lead to different directions, from either, the row does not count, nor those in which the curves blend.
    """
    known = np.ones(len(n_dem), dtype=bool)
    for direction in (1.0, -1.0):
        out = np.empty((2, len(n_dem)))
        for back, row in zip((0.0, 0.999 * cal.scalars.trend_change), out, strict=True):
            z = as_state(new_state())
            z.trend_n = z.trend_last = n_dem[0]
            z.trend_turn, z.direction = n_dem[0] + direction * back, direction
            _directions(n_dem, cal.scalars, z, row)
        known &= out[0] == out[1]
    return known & ~_lately(~known, cal.scalars.blend_time + 0.1)


def _lately(rows: Array, seconds: float, dt: float = RASTER) -> Array:
    """Whether any of these rows, ``dt`` (s) apart, was less than some seconds ago."""
    n = np.arange(len(rows))
    return np.asarray(n - np.maximum.accumulate(np.where(rows, n, -len(rows))) < seconds / dt)


def _demand(
    t: Array,
    c: dict[str, Array],
    machine: Plant,
    cal: Calibration,
    outputs: tuple[str, ...],
    run: Array,
    present: tuple[str, ...],
) -> Stage:
    _, effects, _, _ = _declared("demand", machine, present)
    n_dem, n_r = np.ascontiguousarray(c["n_dem"]), np.ascontiguousarray(c["n_r"])
    pieces = _pieces(c["spell"])
    run = (
        run
        & np.concatenate([_direction_known(n_dem[piece], cal) for piece in pieces])
        & ~_lately(c["missing"] > 0.0, 0.4)
    )
    measured = np.where(run, c["x_dem"], np.nan)
    at = {e.name: sum(len(f.parameters) for f in effects[:i]) for i, e in enumerate(effects)}

    def value(theta: Array, name: str, neutral: float) -> float:
        return float(theta[at[name]]) if name in at else neutral

    def simulate(thetas: Array) -> Array:
        out = np.empty((len(thetas), 1, len(t)))
        other = np.empty(len(t))
        for i, theta in enumerate(thetas):
            k, table = as_scalars(cal.k.copy()), cal.table.copy()
            factor = value(theta, "trend_threshold_error", 1.0)
            k.trend_rate_on *= factor
            k.trend_change *= factor
            offset = value(theta, "schedule_error", 0.0)
            table[1:] += offset * 1e-3
            hold = value(theta, "frame_hold", float(machine.p[ROW["frame_hold"], 0]))
            phase = float(theta[at["frame_hold"] + 1]) * hold if hold > 0.0 and "frame_hold" in at else 0.0
            delay = value(theta, "can_delay", float(machine.p[ROW["can_delay"], 0]))
            for piece in pieces:
                first, last = piece.start, piece.stop
                curves = [
                    float(np.interp(n_r[first], table[0], table[row])) * 1e3 for row in (ROW_EXTENSION, ROW_RETRACTION)
                ]
                rising = abs(curves[0] - c["x_dem"][first]) <= abs(curves[1] - c["x_dem"][first])
                # at the start of a log the demand stands on a curve; later both directions are tried
                for x, up in ((out[i, 0], rising), (other, not rising)) if first else ((out[i, 0], rising),):
                    z = as_state(new_state())
                    z.demand_seen = 1.0
                    z.direction, z.blend = (1.0, 1.0) if up else (-1.0, 0.0)
                    _demand_run(first, last, t, n_dem, n_r, delay, hold, phase, k, table, z, x)
                if first:
                    one, two = (np.nansum((x[piece] * 1e3 - measured[piece]) ** 2) for x in (out[i, 0], other))
                    if two < one:
                        out[i, 0, piece] = other[piece]
        return out * 1e3

    # the hold's clock is not the log's: where it stands is a nuisance that is fitted with it
    held = []
    for e in effects:
        if e.name == "frame_hold":
            phase = Parameter("phase", 0.0, "-", 0.0, 1.0, shape=True, period=1.0)
            starts = tuple((s[0], k * RASTER / s[0]) for s in e.starts for k in range(max(1, round(s[0] / RASTER))))
            e = Effect(e.name, (*e.parameters, phase), starts, e.excites)
        held.append(e)
    effects = tuple(held)
    at = {e.name: sum(len(f.parameters) for f in effects[:i]) for i, e in enumerate(effects)}
    return Stage("demand", outputs, ("mm",), (), effects, simulate, t, measured[None])
