"""A run of the rig: machine, manoeuvre, controller and hidden effects in; a log, and apart from it the truth, out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import kernel
from .controller import Compiled, Controller
from .effects import CATALOGUE, Hidden, apply
from .geometry import STAGES, Geometry, load, ring_tables, schedule, vane_angle
from .kernel import FRAME, TICK, P, S
from .manoeuvre import Manoeuvre
from .parameters import NOMINAL, specimen, with_motor

RATES = (10, 100, 1000)  # Hz
UNITS = {
    "t": "s",
    "n_dem": "%",
    "n_r": "%",
    "x_dem": "mm",
    "x_lvdt": "mm",
    "i_cmd": "mA",
    "p_s": "MPa",
    "t_oil": "degC",
    **dict.fromkeys(STAGES, "deg"),
    "state": "-",
}


@dataclass(frozen=True)
class Spell:
    """Some seconds in which the controller is asked to stand by (``standby``) or hears no frame of the ECU (``deaf``),
    from ``start`` (s).

    A logger hears the ECU all the same.
    """

    kind: str
    start: float
    length: float

    def __post_init__(self) -> None:
        if self.kind not in ("standby", "deaf"):
            raise ValueError(f"spell (={self.kind!r}) must be standby or deaf")


@dataclass(frozen=True)
class Run:
    """What a run leaves.

    log      channel -> values in border units (`UNITS`); ``t`` (s) is the logger's time
    truth    quantity -> true values in SI on the same rows (`kernel.truth_names`), ``t`` without jitter
    machine  the specimen's parameters (array in the order of `kernel.P`), before hidden effects
    hidden   the effects in it, in the order given
    record   everything that is needed to repeat the run or to judge an answer, ready for JSON
    """

    log: dict[str, np.ndarray]
    truth: dict[str, np.ndarray]
    machine: np.ndarray
    hidden: tuple[Hidden, ...]
    record: dict[str, Any]


def machine(geometry: Geometry | None = None) -> np.ndarray:
    """Return the nominal parameters with this geometry's play and lever ratios."""
    g = geometry or load()
    p = NOMINAL.copy()
    for k, s in enumerate(g.stages):
        # a width at the vane is a width at the ring over the lever ratio, where the vane stands at zero
        p[P.half_gap_0 + k] = 0.5 * s.hysteresis / s.vane_ratio
        p[P.vane_ratio_0 + k] = s.vane_ratio
    return p


def simulate(
    test: Manoeuvre,
    controller: Compiled | Controller,
    hidden: Sequence[Hidden] = (),
    *,
    seed: int = 0,
    rate: int = 100,
    randomised: bool = True,
    noise: bool = True,
    jitter: float = 2e-4,
    substeps: int = 50,
    run_up: float = 8.0,
    x0: float | None = None,
    mean_through: bool = True,
    parameters: np.ndarray | None = None,
    motor: bool = False,
    geometry: Geometry | None = None,
    spells: Sequence[Spell] = (),
    gaps: Sequence[tuple[float, float]] = (),
) -> Run:
    """Run a controller on the machine through a manoeuvre.

    controller    a `Compiled` tick (fast), or any object with ``step`` called from Python every 1 ms
    hidden        effects to hide, each from its onset on
    seed          of the specimen, of all noise and of the jitter, each from a stream of its own
    rate          rows of the log a second: 10, 100 or 1000
    randomised    draw the nominal parameters within their tolerances; False: exactly nominal
    noise         False: sensors and speed without noise (converters still quantise)
    jitter        s: the logger's clock is late by up to this much, uniformly
    substeps      hydraulic steps a tick, a multiple of 10
    run_up        s before the log starts, for the controller to reach its running mode: a second 3 % above or below the
                  first demand, then at it. Which, is the seed's: logs start on either stroke table and with the pins on
                  either side
    x0            m, stroke at the start of the run-up; None: where the schedule wants it
    mean_through  i_cmd is the mean of the ticks since the last row, the one at the row included (as a frame sent after
                  the tick); False: of the ticks before the row, which is the current that acted between the two rows
    parameters    array in the order of `kernel.P` in place of the drawn specimen
    motor         the machine has the electromechanical actuator
    geometry      links of this machine; None: those of the table (`geometry.load` draws some within their tolerance)
    spells        seconds in which the controller is asked to stand by, or hears nothing and takes care of itself
    gaps          (start, length), s: stretches whose rows the logger lost; time stamps go on
    """
    if rate not in RATES:
        raise ValueError(f"rate (={rate}) must be one of {', '.join(map(str, RATES))} Hz")
    if substeps < kernel.LINKS or substeps % kernel.LINKS:
        raise ValueError(f"substeps (={substeps}) must be a multiple of {kernel.LINKS}")
    if not 0.0 <= jitter < 1.0 / rate:
        raise ValueError(f"jitter (={jitter:g} s) must be in [0, {1.0 / rate:g})")
    geometry = geometry or load()
    stages = len(geometry.stages)
    columns, truths = kernel.log_names(STAGES[:stages]), kernel.truth_names(stages)
    streams = {
        name: np.random.default_rng([seed, k])
        for k, name in enumerate(("specimen", "speed", "lvdt", "pots", "jitter", "start"), start=10)
    }
    nominal = with_motor(machine(geometry)) if motor else machine(geometry)
    p = (
        specimen(nominal, streams["specimen"] if randomised else None, stages)
        if parameters is None
        else parameters.copy()
    )

    # segments between onsets, each with its parameters and ring tables
    warm = round(run_up / TICK / FRAME) * FRAME
    controller, from_outside = _change_controller(controller, hidden)
    onsets = sorted({0.0, *(h.onset for h in hidden if h.onset > 0.0)})
    par, tables, cache = [], [], {}
    for at in onsets:
        q, g = p, geometry
        for h in hidden:
            if h.onset <= at and h.name not in from_outside:
                q, g = apply(h, q, g)
        if g not in cache:
            cache[g] = ring_tables(g)
        par.append(q)
        tables.append(cache[g])
    onset = np.array([0 if at == 0.0 else warm + round(at / TICK) for at in onsets])

    ahead = warm // FRAME
    came_from = _came_from(test, streams["start"])
    before = np.where(np.arange(ahead) < 100, came_from, test.n_dem[0])
    n_dem = np.concatenate([before, test.n_dem])
    p_s = np.concatenate([np.full(ahead, test.p_s[0]), test.p_s])
    t_oil = np.concatenate([np.full(ahead, test.t_oil[0]), test.t_oil])
    n_frames = len(n_dem)
    n_ticks = n_frames * FRAME
    every = 1000 // rate
    rows = -(-(n_ticks - warm) // every)
    level = 1.0 if noise else 0.0
    speed_noise = level * streams["speed"].standard_normal(n_frames)
    lvdt_noise = level * streams["lvdt"].standard_normal(n_ticks)
    pot_noise = level * streams["pots"].standard_normal((rows, stages))
    frames = np.empty((n_frames, 4))
    frames[:, 2] = 1.0
    hears = np.ones(n_frames, dtype=bool)
    for spell in spells:
        during = slice(ahead + round(spell.start * 100), ahead + round((spell.start + spell.length) * 100))
        if spell.kind == "standby":
            frames[during, 2] = 0.0
        else:
            hears[during] = False
    frames[:, 3] = np.maximum.accumulate(np.where(hears, np.arange(n_frames), 0))
    log, truth = np.empty((rows, len(columns))), np.empty((rows, len(truths)))

    s = np.zeros(kernel.N_S)
    if x0 is None:
        x0 = _scheduled_stroke(tables[0], p, n_dem[0])
    kernel.start(s, par[0], tables[0], x0, n_dem[0], p_s[0])
    common = (onset, np.array(par), np.array(tables), s, warm)
    feeds = (every, substeps, n_dem, p_s, t_oil, speed_noise, lvdt_noise, pot_noise, frames, log, truth)
    if isinstance(controller, Compiled):
        kernel.run_compiled(
            controller.tick,
            controller.inputs.copy(),
            controller.state.copy(),
            controller.calibration,
            controller.slots,
            *common,
            controller.current_limit,
            mean_through,
            *feeds,
        )
    else:
        _run_object(controller, *common, mean_through, *feeds)

    out = {name: np.ascontiguousarray(log[:, k]) for k, name in enumerate(columns)}
    true = {"t": out["t"].copy()} | {name: np.ascontiguousarray(truth[:, k]) for k, name in enumerate(truths)}
    out["t"] = out["t"] + streams["jitter"].uniform(0.0, jitter, rows)
    kept = np.ones(rows, dtype=bool)
    for start, length in gaps:
        kept &= (true["t"] < start) | (true["t"] >= start + length)
    if not kept.all():
        out, true = ({name: np.ascontiguousarray(v[kept]) for name, v in part.items()} for part in (out, true))
    record = {
        "manoeuvre": test.name,
        "manoeuvre_seed": test.seed,
        "duration_s": test.duration,
        "seed": seed,
        "rate_hz": rate,
        "jitter_s": jitter,
        "came_from": came_from,
        "spells": [{"kind": s.kind, "start_s": s.start, "length_s": s.length} for s in spells],
        "gaps_s": [list(g) for g in gaps],
        "hidden": [
            {
                "effect": h.name,
                "stage": CATALOGUE[h.name].stage,
                "site": CATALOGUE[h.name].site,
                "onset_s": h.onset,
                "parameters": dict(h.parameters),
                "units": {k: v.unit for k, v in CATALOGUE[h.name].parameters.items()},
            }
            for h in hidden
        ],
        "specimen": {slot.name: float(p[slot]) for slot in P if p[slot] != nominal[slot]},
    }
    return Run(out, true, p, tuple(hidden), record)


def _came_from(test: Manoeuvre, rng: np.random.Generator) -> float:
    """Speed demand (%) from which the first demand is approached."""
    first = float(test.n_dem[0])
    step = 3.0 if rng.random() < 0.5 else -3.0
    return first + step if 40.0 <= first + step <= 100.0 else first - step


def _scheduled_stroke(table: np.ndarray, p: np.ndarray, n: float) -> float:
    speeds, angles = schedule()
    vigv = vane_angle(table[0], p[P.vane_ratio_0])
    strokes = kernel.X_LOW + kernel.X_STEP * np.arange(len(vigv))
    return float(np.clip(np.interp(np.interp(n, speeds, angles), vigv, strokes), 5e-4, 47.5e-3))


def _change_controller(
    controller: Compiled | Controller, hidden: Sequence[Hidden]
) -> tuple[Compiled | Controller, set[str]]:
    """Let the controller put its own errors in. Those it did are named; the rig does what is left from outside, if that
    is possible.
    """
    done: set[str] = set()
    for h in hidden:
        if h.name not in ("schedule_error", "trend_threshold_error", "controller_gain_error"):
            continue
        change = getattr(controller, "change", None)
        changed = change(h.name, dict(h.parameters)) if change is not None and h.onset == 0.0 else None
        if changed is not None:
            controller = changed
            done.add(h.name)
        elif h.name == "trend_threshold_error" and h.parameters["factor"] != 1.0:
            raise ValueError(
                "trend_threshold_error lies inside the controller: hand in one whose `change` can make it, with onset 0"
            )
    return controller, done


def _run_object(
    controller,
    onset,
    par,
    tables,
    s,
    warm,
    through,
    every,
    steps,
    n_dem,
    p_s,
    t_oil,
    speed_noise,
    lvdt_noise,
    pot_noise,
    frames,
    log,
    truth,
):
    """`kernel.run_compiled` for a controller called from Python."""
    view = np.zeros(6)
    currents: list[float] = []
    row, segment = 0, 0
    for k in range(len(lvdt_noise)):
        while segment + 1 < len(onset) and k >= onset[segment + 1]:
            segment += 1
        p, f = par[segment], k // FRAME
        kernel.before_tick(k, warm, s, p, frames, speed_noise, lvdt_noise, n_dem, t_oil, view)
        i = controller.step(view[0], view[1], view[2], view[3] == 1.0, int(view[5]))
        i = kernel.current(i, p, getattr(controller, "current_limit", 0.040), t_oil[f])
        if k == warm:
            currents.clear()
        if through:
            currents.append(i)
        if k >= warm and (k - warm) % every == 0:
            mean = float(np.mean(currents)) if currents else i
            kernel.write_row(
                row,
                k,
                warm,
                s,
                p,
                frames,
                view,
                controller.x_dem,
                controller.state,
                mean,
                p_s[f],
                t_oil[f],
                pot_noise,
                log,
                truth,
            )
            row += 1
            currents.clear()
        if not through:
            currents.append(i)
        kernel.advance(s, p, tables[segment], i, frames[f, 0], p_s[f], t_oil[f], (k - warm) * TICK, steps)


def write(run: Run, path: str | Path) -> None:
    """Write the log as CSV or Parquet, by suffix. The truth is not in it."""
    path = Path(path)
    if path.suffix == ".csv":
        np.savetxt(path, np.column_stack(list(run.log.values())), "%.6f", ",", header=",".join(run.log), comments="")
    elif path.suffix == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table(run.log), path)
    else:
        raise ValueError(f"suffix (={path.suffix!r}) must be .csv or .parquet")


__all__ = ["RATES", "UNITS", "Run", "S", "Spell", "machine", "simulate", "write"]
