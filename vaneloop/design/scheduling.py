"""The stepwise scheduling method: mechanism -> VIGV strokes -> links of the others -> measured loop -> two curves ->
tables.

Source: Kim & Ki, Appl. Sci. 2020, 10, 6643, sections 4 and 5, figures 7 to 13. Pure functions: inputs in, a dataclass
out; the command line is `vaneloop.cli.schedule`, the page `vaneloop.pages.schedule`. Lengths in mm and angles in deg,
as at every border; rotor speed in per cent.

    schedule(geometry, schedules, log=...) -> ScheduleResult        the whole method in one call

Its steps and its files, each a module of this room:

    stroke_tables      the controller's tables from the model's play
    links              Lb and Lc that best meet the schedules
    measured_loop      one stage's measured loop split into its two curves, by the fit in loop_fit
    schedule_files     stroke_tables.toml, vane_angles.toml, geometry.toml, schedules.toml, and the JSON
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.logs import Log, LogError
from plant import Geometry, Schedules
from plant.geometry import WORKING_SPEED, vane_angles
from plant.linkage import G_L, G_LDP, N_CRANK, N_PER_STAGE, check_assembly, stage_ring_angle, vane_angle
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import same_stages
from vaneloop.design.links import LinkChange, ScheduleOptions, adjust_links, geometry_with
from vaneloop.design.measured_loop import DEG, MeasuredLoop, measure_loop
from vaneloop.design.stroke_tables import (
    DESIGN_SPEED,
    STROKE_LIMITS,
    refuse_outside,
    schedules_at_design,
    stroke_of_model,
    stroke_tables,
    table_speeds,
)

__all__ = ["ScheduleResult", "schedule"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScheduleResult:
    """What the method gives.

    speed    %, raster of tables and errors; target float64[n, stages] deg
    table    float64[4, n]: speed, strokes (mm) for extension, retraction and the mean: what the controller loads
    links    one entry a stage
    loops    measured loops by stage; empty without a log
    geometry the machine as measured and adjusted (equivalent lengths); written as geometry.toml
    """

    speed: Array
    target: Array
    table: Array
    links: list[LinkChange]
    loops: dict[str, MeasuredLoop]
    geometry: Geometry
    built: Geometry
    schedules: Schedules
    options: ScheduleOptions
    log: str
    origin: str
    notes: list[str]


def schedule(
    geometry: Geometry,
    schedules: Schedules,
    log: Log | None = None,
    options: ScheduleOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> ScheduleResult:
    """The paper's stepwise method in one call.

    geometry   mechanism as built (`lb`; `lb_initial` is only compared with)
    schedules  target angles over rotor speed
    log        stroke and angle of at least the VIGV, measured on the machine as built; None: the geometry's own play

    Raises InputError in one line: a mechanism that cannot be assembled, a schedule that cannot be met, a log without a
    loop.
    """
    o = options or ScheduleOptions()
    o.check()
    same_stages(geometry=geometry.vanes, schedules=schedules.vanes)
    vanes = geometry.vanes
    notes: list[str] = list(log.notes) if log is not None else []
    loops: dict[str, MeasuredLoop] = {}
    if log is not None:
        if "x_lvdt" not in log.channels or "vigv" not in log.channels:
            missing = [n for n in ("x_lvdt", "vigv") if n not in log.channels]
            raise LogError(f"{log.path}: no {' and no '.join(missing)}; a loop needs stroke and angle")
        for done, name in enumerate(vanes):
            if name in log.channels:
                try:
                    loops[name] = measure_loop(log.channels["x_lvdt"], log.channels[name], geometry, name, log.path)
                except LogError as e:
                    if name == "vigv":
                        raise
                    notes.append(f"{name} is not measured, the geometry's own curves stand for it: {e}")
            if progress is not None:
                progress(0.8 * (done + 1) / len(vanes))
    said: dict[str, list[str]] = {}
    for name, measured in loops.items():
        for note in measured.notes:
            said.setdefault(note, []).append(name)
    notes += [f"{', '.join(names)}: {note}" for note, names in said.items()]
    speed = table_speeds(schedules)
    works = (speed >= WORKING_SPEED[0]) & (speed <= WORKING_SPEED[1])
    if not works.any():
        low, high = WORKING_SPEED
        raise InputError(
            f"schedules: vigv rises from {speed[0]:g} to {speed[-1]:g} % speed; it must reach into {low:g} to "
            f"{high:g} %"
        )
    if not speed[0] <= DESIGN_SPEED <= speed[-1]:
        nearest = speed[schedules_at_design(speed)]
        notes.append(
            f"the schedule's table runs from {speed[0]:g} to {speed[-1]:g} %: figures at 100 % speed are those at "
            f"{nearest:g} %"
        )
    target = np.rad2deg(schedules.targets(speed))
    design = schedules_at_design(speed)
    table = _tables(geometry, schedules, speed, loops.get("vigv"), notes)
    mean_stroke = table[3]

    file = Path(log.path).name if log is not None else ""
    links, changes, origins = [], {}, {}
    for k, name in enumerate(vanes):
        built = geometry.stage(name)
        loop = loops.get(name)
        correction = _correction(loop, geometry, k)
        initial = target[:, k] - np.rad2deg(
            vane_angles(stroke_of_model(geometry, schedules, speed), geometry.arrays(True))[:, k]
        )
        as_built = target[:, k] - np.rad2deg(vane_angles(mean_stroke * 1e-3, geometry)[:, k]) - correction(mean_stroke)
        d_lb, d_lc, error = 0.0, 0.0, as_built
        if name != "vigv" and o.adjust:
            d_lb, d_lc, error = adjust_links(geometry, schedules, name, mean_stroke, speed, o, correction)
        width = loop.width if loop is not None else built.hysteresis.value
        lb, lc = (loop.lb, loop.lc) if loop is not None else (built.lb.value, built.lc.value)
        changes[name] = {"lb": lb + d_lb, "lc": lc + d_lc, "hysteresis": width}
        if loop is not None:
            for key, q, value, change in (("lb", built.lb, lb, d_lb), ("lc", built.lc, lc, d_lc)):
                origins[f"{name}.{key}"] = (
                    f"measured: {file}, {value:.3f} mm equivalent where the geometry has {q.value:g} mm; adjusted by "
                    f"{change:+g} mm"
                )
            origins[f"{name}.hysteresis"] = (
                f"measured: {file}, width of the loop, standard error {loop.width_sigma:.3f} deg"
            )
        else:
            if d_lb:
                origins[f"{name}.lb"] = (
                    f"derived: vaneloop schedule, {built.lb.value:g} mm as built, adjusted by {d_lb:+g} mm"
                )
            if d_lc:
                origins[f"{name}.lc"] = (
                    f"derived: vaneloop schedule, {built.lc.value:g} mm as built, adjusted by {d_lc:+g} mm"
                )
        links.append((name, built, d_lb, d_lc, initial, as_built, error))
    if loops:
        changes = {n: {k: round(v, 4) for k, v in c.items()} for n, c in changes.items()}
    machine = geometry_with(geometry, changes, origins)
    try:
        check_assembly(machine.arrays(initial=True))
    except InputError:  # the arms as first built do not go with the new links
        machine = geometry_with(machine, {n: {"lb_initial": machine.stage(n).lb.value} for n in vanes})
    both = [
        _branch_errors(machine, geometry, k, table, target, loops.get(n), links[k][2:4]) for k, n in enumerate(vanes)
    ]
    out = []
    for (name, built, d_lb, d_lc, initial, as_built, error), (up, down) in zip(links, both, strict=True):
        columns = {"initial": initial, "built": as_built, "adjusted": error, "extension": up, "retraction": down}
        out.append(
            LinkChange(
                name, built.lb_initial.value, built.lb.value, built.lc.value, built.lb.value + d_lb,
                built.lc.value + d_lc,
                initial, as_built, error, up, down,
                at_design={c: float(e[design]) for c, e in columns.items()},
                rms={c: float(np.sqrt(np.mean(e[works] ** 2))) for c, e in columns.items()},
                largest={c: float(np.max(np.abs(e[works]))) for c, e in columns.items()},
            )
        )  # fmt: skip
    if progress is not None:
        progress(1.0)
    words = f"hysteresis of {geometry.vigv.hysteresis.value:g} deg"
    if loops:
        words = f"loop of {loops['vigv'].width:.2f} deg measured in {file}"
    origin = f"derived: vaneloop schedule, inverse of the two branches at the VIGV schedule, {words}"
    source = log.path if log is not None else ""
    return ScheduleResult(speed, target, table, out, loops, machine, geometry, schedules, o, source, origin, notes)


def _correction(loop: MeasuredLoop | None, geometry: Geometry, k: int) -> Callable[[Array], Array]:
    """Deg over stroke (mm): measured mean curve minus the geometry's."""
    if loop is None:
        return lambda x: np.zeros(np.shape(x))
    grid, difference = loop.stroke, loop.mean - np.rad2deg(vane_angles(loop.stroke * 1e-3, geometry)[:, k])
    return lambda x: np.interp(x, grid, difference)


def _tables(
    geometry: Geometry, schedules: Schedules, speed: Array, loop: MeasuredLoop | None, notes: list[str]
) -> Array:
    """The controller's stroke tables, between the actuator's stops; ``notes`` gains where a stop cuts a branch off."""
    if loop is None:
        table = stroke_tables(geometry, schedules, speed)
    else:
        target = np.rad2deg(schedules.targets(speed)[:, 0])
        low, high = np.interp(STROKE_LIMITS, loop.stroke, loop.mean)
        refuse_outside(speed, target, float(low), float(high))
        rows = [np.interp(target, getattr(loop, b), loop.stroke) for b in ("extension", "retraction", "mean")]
        table = np.vstack([speed, *rows])
    cut = np.clip(table[1:], *STROKE_LIMITS)
    for row, name in enumerate(("extension", "retraction")):
        beyond = np.abs(table[1 + row] - cut[row])
        if beyond.max() > 0.0:
            i = int(np.argmax(beyond))
            notes.append(
                f"{name}: the stop at {cut[row, i]:g} mm cuts the table off at {int((beyond > 0).sum())} speeds, most "
                f"at {speed[i]:g} % ({beyond[i]:.2f} mm): the gap is not crossed in full there"
            )
    # the controller wants rising rows, extension above the mean above retraction
    up, down, mean = cut
    mean = np.maximum.accumulate(mean)
    up = np.maximum(np.maximum.accumulate(up), mean)
    down = np.minimum(np.maximum.accumulate(down), mean)
    return np.vstack([speed, up, down, mean])


def _branch_errors(
    machine: Geometry,
    built: Geometry,
    k: int,
    table: Array,
    target: Array,
    loop: MeasuredLoop | None,
    change: Sequence[Any],
) -> tuple[Array, Array]:
    """Errors (deg) of stage k with the dual tables, in extension and in retraction: target minus the angle on its own
    branch.
    """
    out = []
    for row, side, name in ((1, -1.0, "extension"), (2, 1.0, "retraction")):
        stroke = table[row]
        if loop is not None and not any(change):
            angle = np.interp(stroke, loop.stroke, getattr(loop, name))
        else:
            g = machine.arrays()
            o = N_CRANK + k * N_PER_STAGE
            ldp, lever = float(g[o + G_LDP]), float(g[o + G_L])
            half = 0.5 * math.radians(machine.stages()[k].hysteresis.value) * lever / ldp
            angle = (
                np.array([vane_angle(stage_ring_angle(x * 1e-3, g, k) + side * half, ldp, lever) for x in stroke]) * DEG
            )
        out.append(target[:, k] - angle)
    return out[0], out[1]
