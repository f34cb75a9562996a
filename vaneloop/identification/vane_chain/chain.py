"""The vane chain as stages: with the stages in `vane_stages`, all that the search knows of a vane.

| stage    | driven by (logged)      | explains (logged)         | scored                                            |
|----------|-------------------------|---------------------------|---------------------------------------------------|
| demand   | n_dem, n_r              | x_dem                     | the firmware's own trend, tables and rate limits  |
| servo    | x_dem, x_lvdt           | i_cmd                     | windows, integral free                            |
| engine   | n_dem                   | n_r                       | free run                                          |
| actuator | i_cmd, n_r, p_s, t_oil  | x_lvdt                    | windows, stroke free                              |
| linkage  | x_lvdt, n_r, t_oil      | the vanes' angles, jointly | free run, play a state                            |

All stages run on one raster of 10 ms, the ECU frame's period, or the log's own where that is slower. Each has the rows
from where the last of its channels begins to where the first of them ends; a vane that begins later, or ends earlier,
than the others is not measured there. Noise floors are
measured on the errors of the nominal model, whose motion is mostly gone, and where the raster is slow the error that it
causes is measured and added.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from controller import Calibration, load_calibration
from controller.records import RUN
from hil.figures import noise_floor, resolution, resolution_before
from hil.logs import Channel, Log, LogError
from hil.logs.notes import Note
from hil.loop.tick import flashed
from plant import Plant, build_plant
from plant.curve import QUANTITIES
from plant.effects import CURVES
from plant.layout import C_OF, CURVE_ROWS, MOST_CURVES
from vaneloop.base.signals import SIDES, UNITS
from vaneloop.base.vanes import VANES, same_stages
from vaneloop.identification.least_squares.problem import LeastSquaresProblem, recalibrate
from vaneloop.identification.settings import (
    CHAIN_MEMORY,
    CURRENT_DRAWS,
    LEAST_FLOOR,
    NOISE_DRAWS,
    OTHER_CURRENT,
    RASTER,
    SETTLE,
    SIMPLER_LINKAGE,
    WINDOW,
)
from vaneloop.identification.subsystem import Array, Stage, lifted, noise_of
from vaneloop.identification.vane_chain.actuator import actuator_stage
from vaneloop.identification.vane_chain.alignment import (
    Late,
    LateIn,
    aligned,
    demand_of,
    driving,
    late_in_controller,
    late_vanes,
    passed_by,
    vanes_late,
    zeros_in_controller,
)
from vaneloop.identification.vane_chain.candidates import OF_STROKE, reversals, room_for
from vaneloop.identification.vane_chain.current import (
    SAMPLED,
    SLOW_CURRENTS,
    between_rows,
    other_current,
    servo_law,
    without_noise,
)
from vaneloop.identification.vane_chain.demand import demand_stage, own_demand_stage
from vaneloop.identification.vane_chain.engine import engine_stage
from vaneloop.identification.vane_chain.hum import without_hum
from vaneloop.identification.vane_chain.linkage import linkage_stage
from vaneloop.identification.vane_chain.resample import (
    OF_SIDES,
    OF_SUBSYSTEM,
    Gaps,
    Grid,
    OfSubsystem,
    every_other,
    grid_of,
    last_digit,
    no_gap_in_window,
    on_raster,
    regimes_of,
    rms,
    since,
    stretches,
)
from vaneloop.identification.vane_chain.servo import servo_stage
from vaneloop.identification.vane_chain.stationary_noise import expect_stationary_noise
from vaneloop.identification.vane_chain.subsystem_data import SAMPLED_OF, STROKE_OFF, Driven, stroke_of
from vaneloop.identification.vane_chain.swapped import swapped

__all__ = ["STAGE_ORDER", "Chain", "build_chain"]

ACTUATORS = {"actuator": None, **{name: side for side, name in enumerate(OF_SIDES)}}  # whose of two each is
BUS, DELAYS = {"n_dem", "n_r", "x_dem"}, ("can_delay", "frame_hold")  # channels in frames, and what delays frames
_LAST = "linkage"
STAGE_ORDER = (*(name for name in OF_SUBSYSTEM if name != _LAST), *OF_SIDES, _LAST)
MAKERS: dict[str, Callable[[Driven], Stage]] = {
    "demand": demand_stage,
    "servo": servo_stage,
    "engine": engine_stage,
    "actuator": actuator_stage,
    "actuator_a": actuator_stage,
    "actuator_b": actuator_stage,
    "linkage": linkage_stage,
}


@dataclass(eq=False)
class Chain:
    """The stages of one log.

    stages        the stages that can be judged
    not_observed  stage -> what the log lacks
    columns       channel -> values on the raster ``t`` of the stage that has most rows (border units)
    steps         channel -> step (border unit) in which its reading comes, where its converter's low bits are lost
    test          the stages on a part of the log that nothing is fitted to; None: there is none
    whole         of a long log, of which these are the stages of an excerpt: all of it; None: it is here whole
    start         s of the log's own time, where ``t`` is 0
    late          what stands late in the file, by subsystem, and was moved
    plant, built, calibration  the machine; its controller's tables, and the same as flashed (`hil.loop.tick.flashed`)
    """

    t: Array
    stages: list[Stage]
    not_observed: dict[str, str]
    columns: dict[str, Array]
    plant: Plant
    built: Calibration
    calibration: Calibration
    notes: list[str] = field(default_factory=list)
    steps: dict[str, float] = field(default_factory=dict)
    test: Chain | None = None
    whole: Any = None
    start: float = 0.0
    late: LateIn = field(default_factory=dict)

    def stage(self, name: str) -> Stage:
        """Return a stage by name."""
        return next(s for s in self.stages if s.name == name)


def build_chain(
    log: Log,
    plant: Plant | None = None,
    calibration: Calibration | None = None,
    present: tuple[str, ...] = (),
    grid: Grid | None = None,
    pieces: Sequence[tuple[int, int]] = (),
    draws: int = CURRENT_DRAWS,
    late: LateIn | None = None,
) -> Chain:
    """Put ``log`` on one raster and make every stage that its channels allow, each of the rows that its own have;
    channels that stand late in the file are moved to where they belong (`alignment`).

    present  effects that the model already has: they are part of ``plant`` and not tried again
    grid     of the log, where it is known
    pieces   rows of it, as `on_raster` takes them: the stages of these only
    draws    of what the log hides from the servo
    late     what stands late in the log, where that is known; None: it is to be found
    """
    log = with_mean_stroke(log, plant or build_plant())
    grid = grid or grid_of(log)
    log = without_hum(log)
    known = late or {}
    framed = any(c.framed for c in log.channels.values())  # frames are stamped by one clock
    chain = _build(log, plant, calibration, present, grid, pieces, draws, known)
    known_clocks = late is not None or framed or chain.plant.sides > 1
    noisy = expect_stationary_noise(chain.stages) if known_clocks else []

    def moved(find: Callable[[Sequence[Stage]], LateIn], clocks: bool = True) -> bool:
        """Whether ``find`` finds something in the stages; the chain is then made anew with it, and with the clocks that
        were found before or without those.
        """
        nonlocal chain, known, noisy
        found = find(chain.stages)
        if found:
            kept = {name: tuple(one for one in all_of if clocks or one.zero) for name, all_of in known.items()}
            known = {**kept, **{name: kept.get(name, ()) + more for name, more in found.items()}}
            hidden = {s.name: s.raster_error for s in chain.stages}
            chain = _build(log, plant, calibration, present, grid, pieces, draws, known)
            for stage in chain.stages:
                _hides_no_less(stage, hidden.get(stage.name))
        if found or find is late_in_controller:
            noisy = expect_stationary_noise(chain.stages)
        return bool(found)

    if not known_clocks:
        moved(zeros_in_controller)
        if moved(late_in_controller) and moved(zeros_in_controller, clocks=False):
            moved(late_in_controller)  # clocks had hidden a zero, and were read off channels with a wrong one
        moved(late_vanes)
    chain.notes += _moved(known) + noisy + _one_stroke(log, chain.plant) + swapped(chain.stages)
    chain.late = known
    return chain


def with_mean_stroke(log: Log, machine: Plant) -> Log:
    """The log of a machine with two actuators, with the mean stroke that the controller gets of both, where only theirs
    are logged.
    """
    if machine.sides == 1 or "x_lvdt" in log.channels or not {*SIDES} <= log.channels.keys():
        return log
    a, b = (log.channels[name] for name in SIDES)
    mean = replace(a, values=0.5 * (a.values + np.interp(a.t, b.t, b.values)))
    return replace(log, channels={**log.channels, "x_lvdt": mean})


def _one_stroke(log: Log, machine: Plant) -> list[str]:
    """What a log without both strokes of two actuators does not tell."""
    missing = [name for name in SIDES if name not in log.channels]
    if machine.sides == 1 or not missing:
        return []
    return [
        f"{', '.join(missing)}: not logged; which actuator or LVDT is at fault cannot be told, and the linkage is "
        f"judged with both at the mean stroke"
    ]


def subsystems_of(log: Log, machine: Plant) -> dict[str, OfSubsystem]:
    """The subsystems that a machine has, in order, with their channels in a log."""
    if machine.sides == 1:
        return OF_SUBSYSTEM
    of = OF_SUBSYSTEM | OF_SIDES
    if {*SIDES} <= log.channels.keys():
        of["linkage"] = of["linkage"]._replace(needs=SIDES)
    return {name: of[name] for name in STAGE_ORDER if name != "actuator"}


def _hides_no_less(stage: Stage, error: Array | None) -> None:
    """Have a slow log's stage whose channels were moved expect what its rows hid before: straight lines between them
    look smoother, and hide the same.
    """
    if error is None or stage.raster_error is None or stage.t[1] - stage.t[0] < 1.5 * RASTER:
        return
    if np.any(error > stage.raster_error):
        stage.raster_error = np.maximum(error, stage.raster_error)
        stage.floor = noise_of(stage, stage.neutral())


def _moved(late: LateIn) -> list[Note]:
    """Notes of what stands late, each channel against what its subsystems explain."""
    of: dict[Late, list[str]] = {}
    for name, all_of in late.items():
        for one in all_of:
            of.setdefault(one, []).append(name)
    return [Note(f"{', '.join(on)}: {one.text()}", "converted", ", ".join(one.channels)) for one, on in of.items()]


def _build(
    log: Log,
    plant: Plant | None,
    calibration: Calibration | None,
    present: tuple[str, ...],
    grid: Grid,
    pieces: Sequence[tuple[int, int]],
    draws: int,
    late: LateIn,
) -> Chain:
    """`build_chain` with every channel where the file has it, but for what stands ``late`` in a subsystem."""
    machine = plant or build_plant()
    tables = calibration or load_calibration()
    same_stages(geometry=machine.vanes, vane_angles=tables.vanes)
    if machine.one_valve:
        raise LogError(f"{log.path}: actuators.feed (='one valve') must be 'a valve each' for judging subsystems")
    if tables.channels is not None:
        raise LogError(f"{log.path}: channels.number (=2) must be 1 for judging subsystems (docs/channels.md)")
    absent: dict[str, str] = {}
    # subsystems that have the same rows, and the same channels late
    together: dict[tuple[tuple[tuple[int, int], ...], tuple[Late, ...]], list[str]] = {}
    of_machine = subsystems_of(log, machine)
    for name, of in of_machine.items():
        rows = grid.pieces_of(name, pieces)
        missing = [c for c in of.needs if c not in log.channels]
        gives = [c for c in of.gives if c in machine.vanes or c not in VANES]
        if name == "servo" and tables.program is not None:
            absent[name] = "a controller of your own gives its current for its own demand, not for the logged one"
        elif missing or not any(c in log.channels for c in gives):
            absent[name] = "no " + ", ".join(missing or gives)
        elif rows is None:
            absent[name] = f"{', '.join(c for c in (*of.needs, *gives) if c in log.channels)} have no time in common"
        else:
            together.setdefault((rows, late.get(name, ())), []).append(name)
    chains, why = [], None
    for (rows, moved), names in together.items() or {(tuple(pieces), ()): []}.items():
        # a recorder's lateness and that of the bus look alike
        theirs = DELAYS if any(BUS.intersection(one.channels) for one in moved if not one.zero) else ()
        try:
            chains.append(_chain(log, grid, rows, names, machine, tables, (*present, *theirs), draws, moved))
        except LogError as e:
            why = why or e
            absent |= dict.fromkeys(names, str(e).removeprefix(f"{log.path}: "))
    if not chains and why is not None:
        raise why
    longest = max(chains, key=lambda c: len(c.t))
    absent |= {name: said for c in chains for name, said in c.not_observed.items()}
    stages = {s.name: s for c in chains for s in c.stages}
    return replace(
        longest,
        stages=[stages[name] for name in STAGE_ORDER if name in stages],
        not_observed={name: absent[name] for name in STAGE_ORDER if name in absent},
        notes=list(dict.fromkeys(n for c in (longest, *chains) for n in c.notes))
        + _cut(log, grid, {name: of_machine[name] for name in stages}),
    )


def _cut(log: Log, grid: Grid, stages: Mapping[str, OfSubsystem]) -> list[str]:
    """Notes of the time of the log that subsystems have not, and which of their channels is at fault."""
    many = {name: c for name, c in log.channels.items() if len(c.t) > 1}
    edges = min(c.t[0] for c in many.values()), max(c.t[-1] for c in many.values())
    said: dict[tuple[str, str, int], list[str]] = {}
    notes: dict[str, Note] = {}
    for name, of in stages.items():
        rows = grid.rows_of(name)
        drives = [c for c in (*of.needs, *of.takes, "state") if c in many]
        for k, (words, side) in enumerate((("begins at", "before"), ("ends at", "after"))):
            if abs(grid.start + rows[k] * grid.dt - edges[k]) > 1.5 * WINDOW:
                at = [c for c in (*drives, *of.gives) if c in many and grid.rows_of(c)[k] == rows[k]]
                last = min(at, key=lambda c: (c not in drives, many[c].t[-1] if k else -many[c].t[0]))
                # of the rows behind the last, the first is lost, too
                lost = round(abs(grid.start + rows[k] * grid.dt - edges[k]) / grid.dt) + k
                said.setdefault((f"{last} {words} {many[last].t[-k]:.5g} s", side, lost), []).append(name)
        for c in of.gives:
            if c in many and (grid.rows_of(c)[0] > rows[0] or grid.rows_of(c)[1] < rows[1]):
                text = f"{c}: measured from {many[c].t[0]:.5g} to {many[c].t[-1]:.5g} s, judged there alone"
                notes[c] = Note(text, "cut", c, rows[1] - rows[0] - (grid.rows_of(c)[1] - grid.rows_of(c)[0]))
    for (text, side, lost), names in said.items():
        notes[text] = Note(f"{text}: {', '.join(names)} not judged {side} it", "cut", text.split()[0], lost)
    return list(notes.values())


def _chain(
    log: Log,
    grid: Grid,
    pieces: Sequence[tuple[int, int]],
    names: Sequence[str],
    machine: Plant,
    tables: Calibration,
    present: tuple[str, ...],
    draws: int,
    late: Sequence[Late] = (),
) -> Chain:
    """The stages of these ``names``, which have the same rows, and the same channels ``late``; a channel that has not
    all of its rows is left out, but for what is explained.
    """
    behind, late = demand_of(late)
    passed = passed_by(late)
    as_filed, log = log, aligned(log, late, grid)
    cal = flashed(tables, machine)
    theirs = tables.program is not None  # a controller of the user's own: its servo's law is not known
    low, high = grid.rows_of(names[0]) if names else (0, grid.rows)
    of_machine = subsystems_of(log, machine)
    explained = {c for name in names for c in of_machine[name].gives}
    known = {c: grid.rows_of(c) for c in log.channels}
    part = {c: known[c] for c in known if known[c][0] > low or known[c][1] < high}
    here = log if not part else log[[c for c in known if c not in part or c in explained]]
    t, columns, gaps, notes = on_raster(here, grid, pieces)
    if len(t) < 500:
        raise LogError(
            f"{log.path}: {len(t)} samples of {t[1] - t[0] if len(t) > 1 else 0:g} s; at least 500 are needed to "
            f"search for missing physics"
        )
    dt = float(t[1] - t[0])
    columns = driving(t, columns, late) | vanes_late(t, late, as_filed, grid)
    running = np.round(columns["state"]) == RUN if "state" in columns else None
    mostly, share = True, 1.0
    if running is not None:
        # the machine obeys its physics in any mode; where the controller mostly stood aside, that is all there is
        usable = _rows(t, gaps, (), running, True).usable
        share = float((usable & running).sum()) / max(float(usable.sum()), 1.0)
        mostly = share >= 0.5
        if not mostly:
            notes.append(
                f"state: mode RUN in {share:.0%} of the log; engine, actuator and linkage are judged in all modes"
            )
    # the stroke between its rows follows from stroke and current, and the current between its own from the servo, too:
    # pressure, oil and speed change slowly, and a line through their gaps takes no motion out of the stroke
    motion = _rows(t, gaps, ("i_cmd", "x_lvdt"), running, mostly)
    both = _rows(t, gaps, _used(of_machine["servo"]), running, mostly)
    foreign = [v for v in VANES if v in columns and v not in machine.vanes]
    notes += [f"{v}: this machine has no such vane row (geometry); not judged" for v in foreign]
    if room_for(machine.p) < MOST_CURVES:
        logged = {*columns, *machine.usual, "time", *(OF_STROKE if "x_lvdt" in columns else ())}
        curves = range(CURVES + 1, CURVES + 1 + CURVE_ROWS * int(machine.p[CURVES].max()), CURVE_ROWS)
        of = {int(machine.p[r + C_OF, 0]) for r in curves}
        if lost := next((q.name for q in QUANTITIES.values() if q.of in of and q.name not in logged), None):
            raise LogError(f"{log.path}: has no {lost}, of which a learned law of the model is a function")
    filled, assumed = machine.usual, dict[str, float]()
    have = {**columns, **motion.columns()}
    for name in explained & columns.keys():
        there = _sampled(log.channels[name], t, grid, known[name])
        if name in gaps.lost:
            there = ~gaps.lost[name] & (True if there is None else there)
        if name in VANES and name in gaps.far:  # a gap of one vane is none of the others
            there = gaps.fresh([name])[0] & (True if there is None else there)
        if there is not None:
            have[SAMPLED_OF + name] = there.astype(float)
    for name, value in filled.items():
        if name not in have:
            have[name] = np.full(len(t), value)
            if name in log.channels or (name == "p_s" and machine.kind != "hydraulic"):
                continue  # no subsystem here takes it; a motor needs no oil
            if doubt := machine.usual_within[name]:
                assumed[name] = doubt / 3.0**0.5  # of a uniform interval of that half-width
            notes.append(
                f"{name}: not logged; {value:g} {UNITS[name]} assumed, and effects that need it to change cannot be "
                f"seen"
            )
    full = machine.table.actuator.stroke.value
    if {"x_lvdt", "i_cmd"} <= columns.keys():
        rough = Driven(t, have, machine, cal, (), motion.usable, (), turns=partial(reversals, t, have["x_lvdt"], full))
        motor = machine if machine.sides == 1 else machine.alone(0)  # both of two move nearly alike
        smooth = without_noise(t, have, motor, rough.slipping(rough.signals(), machine.p))
    samples = min(10, max(1, round(dt / grid.steps.get("i_cmd", dt))))
    if dt < 1.5 * RASTER and {"x_lvdt", "i_cmd"} <= columns.keys():
        if "x_dem" in columns and not theirs and {"servo", "actuator"} & set(names):
            law, *off = servo_law(t, have, cal, smooth, grid.digits, draws, samples, behind)
            what = other_current(t, have, law, both.run, cal, samples)
            if what:
                notes.append(
                    f"i_cmd: {what}, not the mean of those since the row before, which is worked out from stroke and "
                    f"demand"
                )
                columns["i_cmd"] = have["i_cmd"]
                smooth = without_noise(t, have, motor, rough.slipping(rough.signals(), machine.p))
                law, *off = servo_law(t, have, cal, smooth, grid.digits, draws, samples, behind)
            sampled = what == SAMPLED
            have["law"], have["law_error"] = law, off[1] if sampled else off[0]
            errors = (off[0], off[1]) if sampled else None
            size = cal.scalars.kp * smooth.noise
            have["ticks"], have["other_ticks"] = (
                between_rows(have, law, size, both.run, cal, errors, seed) for seed in (0, 1)
            )
        have["stroke"] = smooth.stroke
    smooth_of = {}
    if machine.sides > 1 and {"i_cmd", *SIDES} <= columns.keys():
        for side, name in enumerate(SIDES):
            smooth_of[name] = without_noise(t, {**have, "x_lvdt": columns[name]}, machine.alone(side))
            have[stroke_of(name)] = smooth_of[name].stroke
    if "linkage" in names and "x_lvdt" in have and grid.digits.get("x_lvdt"):
        digit = last_digit(have["x_lvdt"], grid.digits["x_lvdt"])
        digits = (digit(np.random.default_rng(k)) for k in range(NOISE_DRAWS))
        off_by = (smooth.smoothed(d) if "stroke" in have else d for d in digits)
        have[STROKE_OFF] = np.array([passed.before(d, dt) for d in off_by]).T
    if "linkage" in names and "x_lvdt" in have and passed.kind:
        have["stroke"] = passed.before(have.get("stroke", have["x_lvdt"]), dt)
    coarse_current = None
    if dt > 1.5 * RASTER and {"x_lvdt", "i_cmd"} <= columns.keys():
        what = _slow_current(Driven(t, have, motor, cal, ("x_lvdt",), motion.currents, present))
        if what:
            notes.append(f"i_cmd: {what}, not the mean since the row before, which is worked out from it")
            coarse_current = SLOW_CURRENTS[what](columns["i_cmd"][::2])
            columns["i_cmd"] = have["i_cmd"] = SLOW_CURRENTS[what](columns["i_cmd"])
            smooth = without_noise(t, have, motor, rough.slipping(rough.signals(), machine.p))
    turns: Callable[[], dict[str, Array]] = dict
    if "x_lvdt" in columns:
        stroke = have.get("stroke", columns["x_lvdt"])
        turns = lru_cache(partial(reversals, t, stroke, full))
    regimes, units = regimes_of(t, columns, gaps)
    step = _lost_step(log, machine)
    bits = _lost_bits(step, machine)
    steps = {"x_lvdt": step} if step else {}
    if theirs:
        cal = cal._replace(program=tables.program)
    make_of = MAKERS | ({"demand": own_demand_stage} if theirs else {})
    stages, absent = [], {}
    for name in names:
        needs, _, gives = of_machine[name]
        outputs = tuple(c for c in gives if c in columns and (c in machine.vanes or c not in VANES))
        if name in ("servo", "demand") and dt > 1.5 * RASTER:
            absent[name] = f"sample time of {dt:g} s; the controller works every 0.01 s"
            continue
        own = _rows(t, gaps, _used(of_machine[name]), running, mostly)
        rows = own.law_holds if name in ("servo", "demand") else own.currents if name in ACTUATORS else own.machine
        have |= own.columns()
        # how much of the rotor speed's noise is an error of the demand, only a whole log tells
        told = name == "demand" and bool(pieces)
        driven = Driven(
            t, dict(have), machine, cal, outputs, rows, present, turns=turns, assumed=assumed, passed=passed,
            again=told, side=ACTUATORS.get(name), digits=grid.digits, samples=samples,
        )  # fmt: skip
        make = make_of[name]
        stage = make(driven)
        stage.regimes, stage.regime_units = regimes, units
        if np.isfinite(stage.measured).sum() < 300:
            absent[name] = "fewer than 300 samples in mode RUN without gaps"
            continue
        if all(_never_changes(v) for v in (*(columns[c] for c in needs), *stage.measured)):
            absent[name] = f"{', '.join((*needs, *outputs))} never change"
            continue
        if dt > 1.5 * RASTER:
            # a corner of an input between two rows costs about as much as the corners that the doubled raster loses
            # besides
            coarse = make(driven.at(slice(None, None, 2), every_other(have, coarse_current), rows[::2]))
            lost = stage.run(stage.neutral()[None])[0][:, ::2] - coarse.run(coarse.neutral()[None])[0]
            more, own = rms(coarse, lost), lost.repeat(2, axis=1)[None, :, : len(t)]
            stage.lost = own if stage.lost is None else own + stage.lost
            stage.raster_error = more if stage.raster_error is None else np.hypot(stage.raster_error, more)
        if (apart := max(round(log.channels[c].apart / dt) for c in needs)) > 1:
            more = np.zeros(len(outputs))
            true, half = np.arange(0, len(t), 2 * apart), np.minimum(np.arange(len(t)) + apart // 2, len(t) - 1)
            slow = [c for c in needs if log.channels[c].apart > 1.5 * dt]
            # what half of the true samples cost, or half the time between two, is more than what the lines do
            for other in ({c: np.interp(t, t[true], have[c][true]) for c in slow}, {c: have[c][half] for c in slow}):
                varied = make(driven._replace(columns=have | other, again=True))
                change = stage.run(stage.neutral()[None])[0] - varied.run(varied.neutral()[None])[0]
                more = np.maximum(more, rms(stage, change))
            stage.raster_error = more if stage.raster_error is None else np.hypot(stage.raster_error, more)
        least = LEAST_FLOOR[name.split("_")[0]]
        if bits and "x_lvdt" in (*needs, *gives):
            stage.coarse = {"x_lvdt": bits}
        if name in ACTUATORS:
            # the error of a stage that integrates moves most: the stroke by itself, or freed of a fitted model's
            # motion, may be quieter
            channel = noise_floor(t, stage.measured[0])
            freed = noise_floor(
                t, np.where(np.isfinite(stage.measured[0]), smooth_of.get(outputs[0], smooth).off, np.nan)
            )
            stage.quiet = np.maximum([min(channel, freed)], least)
        stage.memory = CHAIN_MEMORY
        shown = passed.shown(t)
        stage.noise = lambda when, error, least=least, shown=shown: max(noise_floor(when, error) / shown, least)
        stage.floor = noise_of(stage, stage.neutral())
        if name == "linkage" and np.any(lifted(stage.floor, SIMPLER_LINKAGE) > stage.floor):
            stage.raster_error = np.hypot(0.0 if stage.raster_error is None else stage.raster_error, SIMPLER_LINKAGE)
            stage.raster_error = np.broadcast_to(stage.raster_error, stage.floor.shape)
            stage.floor = noise_of(stage, stage.neutral())
        stages.append(stage)
    return Chain(t, stages, absent, columns, machine, tables, cal, notes, steps, start=grid.start)


class _Rows(NamedTuple):
    """Which rows of a log count in a subsystem, each bool[rows], and the stretches without a gap in its channels.

    usable                 no gap in its channels near, and it has had time to settle
    run                    in mode RUN
    law_holds              and the firmware has caught up
    machine                those that count in the machine
    currents               and those in which a current follows from the firmware's law between two rows, too
    stretch, spell, machine_spell  number of the stretch; in mode RUN; of those that count in the machine
    fresh, missing         no gap in its channels; one of them misses a sample
    """

    usable: Array
    run: Array
    law_holds: Array
    machine: Array
    currents: Array
    stretch: Array
    spell: Array
    machine_spell: Array
    fresh: Array
    missing: Array

    def columns(self) -> dict[str, Array]:
        """What the stages ask for."""
        return {
            "stretch": self.stretch, "spell": self.spell, "machine_spell": self.machine_spell,
            "fresh": self.fresh.astype(float), "missing": self.missing.astype(float),
        }  # fmt: skip


def _used(of: OfSubsystem) -> tuple[str, ...]:
    """Channels whose gaps count in a subsystem: what drives it, what it explains but for the vanes, of which each has
    gaps of its own.
    """
    return (*of.needs, *of.takes, *(c for c in of.gives if c not in VANES))


def _rows(t: Array, gaps: Gaps, names: Sequence[str], running: Array | None, mostly: bool) -> _Rows:
    """The rows that count where these channels and ``state`` do.

    running  at which rows the controller is in mode RUN; None: nobody says
    mostly   whether it mostly is: else the machine is judged in all modes
    """
    # after a gap everything is as at the start of a log: what the stages remember must come from the rows behind it
    fresh, missing = gaps.fresh((*names, "state"))
    stretch = stretches(fresh)
    usable = fresh & (since(t, stretch) >= SETTLE) & no_gap_in_window(t, fresh)
    if running is None:
        return _Rows(usable, usable, usable, usable, usable, stretch, stretch, stretch, fresh, missing)
    run = usable & running
    spell = stretches(fresh & running)  # nor is it known what a controller in another mode has made of the demand
    law_holds = run & (since(t, spell) >= SETTLE)  # back in RUN, it first catches up
    if not mostly:
        return _Rows(usable, run, law_holds, usable, usable, stretch, spell, stretch, fresh, missing)
    return _Rows(usable, run, law_holds, run, law_holds, stretch, spell, spell, fresh, missing)


def _slow_current(driven: Driven) -> str:
    """Which of `SLOW_CURRENTS` moves the piston as logged clearly better than the mean since the row before, with the
    nominal parameters of the table or with those that suit it: what they are off by may hide a current that is late,
    and may make up for it. "": none.
    """

    def misfits(current: Array) -> Array:
        stage = actuator_stage(driven._replace(columns={**driven.columns, "i_cmd": current}))
        off = stage.measured - stage.run(stage.neutral()[None])[0]
        floor = max(noise_floor(stage.t, off[0]), LEAST_FLOOR["actuator"])
        judge = LeastSquaresProblem(stage, np.array([floor]))
        suited = judge.mean_squares(judge.errors(recalibrate(judge).theta[None])[0])
        return np.array([float(rms(stage, off)[0]), floor * float(np.sqrt(suited[0]))])

    i = driven.columns["i_cmd"]
    as_mean = misfits(i)
    shares = {what: float(np.min(misfits(mean_of(i)) / as_mean)) for what, mean_of in SLOW_CURRENTS.items()}
    what = min(shares, key=lambda k: shares[k])
    return what if shares[what] < OTHER_CURRENT else ""


def _never_changes(values: Array) -> bool:
    """Whether all values are the same to the last bit: a sensor's noise would change them."""
    known = values[np.isfinite(values)]
    return bool(np.all(known == known[:1]))


def _sampled(c: Channel, t: Array, grid: Grid, rows: tuple[int, int]) -> Array | None:
    """At which of the rows ``t`` an output was sampled: between its first row and its last, and where its samples were
    joined by straight lines at these alone, since noise between them is not its own; None: at all.
    """
    row = np.rint(t / grid.dt)
    there = (row >= rows[0]) & (row < rows[1])
    if c.apart > 1.5 * grid.dt:
        when = t + grid.start
        i = np.clip(np.searchsorted(c.t, when), 1, len(c.t) - 1)
        there &= np.minimum(np.abs(c.t[i] - when), np.abs(when - c.t[i - 1])) <= 0.3 * grid.dt
    return None if there.all() else there


def _lost_step(log: Log, machine: Plant) -> float:
    """Step (mm) of a stroke in steps of at least four of the LVDT's converter; 0: it is not.

    Steps that end in 1, 2, 2.5 or 5 are some logger's last digit and say nothing of the machine.
    """
    if "x_lvdt" not in log.channels:
        return 0.0
    x = log.channels["x_lvdt"].values
    step = resolution(x) or resolution_before(x)
    if step < 4.0 * _converter_step(machine):
        return 0.0
    digits = step / 10.0 ** np.floor(np.log10(step))
    if np.min(np.abs(digits / np.array([1.0, 2.0, 2.5, 5.0, 10.0]) - 1.0)) < 1e-3:
        return 0.0
    return float(step)


def _converter_step(machine: Plant) -> float:
    sensors = machine.table.sensors
    return float(sensors.lvdt_range.value / 2.0**sensors.lvdt_bits.value)


def _lost_bits(step: float, machine: Plant) -> str:
    """What is to be said of a stroke in such steps; "": nothing."""
    if not step:
        return ""
    many = step / _converter_step(machine)
    return f"x_lvdt comes in steps of {step:.4g} mm, {many:.0f} of its converter's: low bits are lost"
