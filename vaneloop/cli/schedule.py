"""``vaneloop schedule``: from geometry, schedules and a measured loop to links, stroke tables and the errors that
remain.
"""

from __future__ import annotations

import argparse
from typing import Any

from plant import load_geometry, load_schedules
from vaneloop.base import terminal
from vaneloop.cli import options
from vaneloop.design.links import ScheduleOptions
from vaneloop.design.schedule_files import result_json, write_tables
from vaneloop.design.scheduling import schedule
from vaneloop.pages.schedule import schedule_page

__all__ = ["DESCRIPTION", "add_options", "command", "log_of"]

DESCRIPTION = """The stepwise scheduling method of Kim & Ki 2020: strokes for the VIGV's schedule, bell cranks and links
of the other vane rows that best meet theirs, and, from a measured stroke-angle log, the loop split into its two curves,
made into stroke tables.

The log needs x_lvdt and vigv (vgv1, ... where they were measured), the machine as built (lb of the geometry) driven
there and back: any format that replay reads. Without a log the backlash is the geometry's own.

examples:
  vaneloop schedule --report schedule.html
  vaneloop schedule --geometry tables/geometry.toml --schedules tables/schedules.toml --log LOOP.csv --out engine7/
  vaneloop schedule --log LOOP.mf4 --map STROKE=x_lvdt --map IGV=vigv --step 0.25 --criterion max
  vaneloop engine-test --tables engine7/

exit codes: 0 good, 2 bad input (a mechanism that cannot be assembled, a schedule that no length meets, a log without a
loop)
"""

SIDE_BY_SIDE = 2  # stages in the table of errors: more do not fit a terminal


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    group = parser.add_argument_group("the engine")
    group.add_argument(
        "--geometry",
        metavar="F.toml",
        default="geometry.toml",
        help="the mechanism as built (default: the shipped one)",
    )
    group.add_argument(
        "--schedules", metavar="F.toml", default="schedules.toml", help="target angles over speed (default: shipped)"
    )
    group.add_argument("--log", metavar="LOG", help=f"measured stroke-angle loop, a log: {options.A_LOG}")
    group = parser.add_argument_group("adjusting the vane rows but the VIGV")
    group.add_argument(
        "--step", metavar="MM", type=float, default=0.5, help="lengths change by multiples of it (default 0.5 mm)"
    )
    group.add_argument(
        "--lb-range", metavar="MM", type=float, default=5.0, help="largest change of a bell crank (default 5 mm)"
    )
    group.add_argument(
        "--lc-range", metavar="MM", type=float, default=5.0, help="largest change of a vertical link (default 5 mm)"
    )
    group.add_argument(
        "--adjust", metavar="NAMES", default="lb,lc", help="lengths that may change: lb,lc (default), lb, lc or none"
    )
    group.add_argument(
        "--criterion",
        metavar="C",
        default="rms",
        help="best by: rms (default) or max error, or design: error at 100 %% plus rms",
    )
    group.add_argument(
        "--limit",
        metavar="DEG",
        type=float,
        default=1.0,
        help="refuse a schedule that no length meets within it, 40 to 102 %% (default 1)",
    )
    group = parser.add_argument_group("reading the log (docs/logs.md)")
    options.add_reading_options(group)
    terminal.add_output_options(parser, report=True)
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="write stroke_tables, vane_angles, geometry, schedules .toml; --tables DIR loads it",
    )


def log_of(args: argparse.Namespace) -> Any:
    """The measured loop that ``args`` name, or None."""
    options.log_options(args)
    return None if args.log is None else options.read_log_of(args, require=("x_lvdt", "vigv"))


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    adjust = () if args.adjust == "none" else tuple(a.strip() for a in args.adjust.split(","))
    options = ScheduleOptions(args.step, args.lb_range, args.lc_range, adjust, args.criterion, args.limit)
    options.check()
    geometry, schedules = load_geometry(args.geometry), load_schedules(args.schedules)
    log = log_of(args)
    with terminal.progress_bar(args, "scheduling") as progress:
        result = schedule(geometry, schedules, log, options, progress)

    rows = []
    for s in result.links:
        for name, words in (("initial", "as first built"), ("built", "as it is"), ("adjusted", "adjusted")):
            lb = {"initial": s.lb_initial, "built": s.lb_built, "adjusted": s.lb}[name]
            lc = s.lc if name == "adjusted" else s.lc_built
            figures = (s.at_design[name], s.rms[name], s.largest[name])
            rows.append([f"{s.stage}: {words}", f"{lb:g}", f"{lc:g}", *(f"{v:.3f}" for v in figures)])
        for name, words in (("extension", "on the extension curve"), ("retraction", "on the retraction curve")):
            rows.append(
                [
                    f"{s.stage}: {words}",
                    "",
                    "",
                    *(f"{v:.3f}" for v in (s.at_design[name], s.rms[name], s.largest[name])),
                ]
            )
    columns = ["error of the vane angle, deg", "Lb, mm", "Lc, mm", "at 100 %", "rms", "max"]
    terminal.print_table(
        args, "links, and what remains (target minus angle; rms and max over 40 to 102 % speed)", columns, rows
    )
    pick = [i for i, n in enumerate(result.speed) if n % 10 == 0 or n >= 95 or i == len(result.speed) - 1]
    for k in range(0, max(len(result.links) - 1, 1), SIDE_BY_SIDE):
        some = result.links[1 + k : 1 + k + SIDE_BY_SIDE]
        rows = [
            [
                f"{result.speed[i]:g}",
                *(f"{v:.2f}" for v in result.table[1:, i]),
                *(f"{e[i]:.2f}" for s in some for e in (s.error_initial, s.error_built, s.error)),
            ]
            for i in pick
        ]
        errors = [f"{s.stage} {w}" for s in some for w in ("first", "as is", "adjusted")]
        columns = ["speed, %", "extension, mm", "retraction", "mean", *errors]
        terminal.print_table(args, "stroke tables, and errors over speed, deg (all speeds: --json)", columns, rows)
    if result.loops:
        rows = [
            [
                name, f"{m.width:.3f} ± {m.width_sigma:.3f}",
                f"{m.offset:.3f}", f"{m.lb:.2f}", f"{m.lc:.2f}", f"{m.misfit:.3f}", f"{m.noise:.3f}",
                "-" if m.drift is None else f"{m.drift:.3f}", f"{m.lag * 1e3:.1f}",
                "{:.1f}-{:.1f}".format(*m.extension_covered), "{:.1f}-{:.1f}".format(*m.retraction_covered),
            ]
            for name, m in result.loops.items()
        ]  # fmt: skip
        columns = [
            "loop",
            "width, deg",
            "offset",
            "Lb equiv., mm",
            "Lc equiv.",
            "misfit, deg",
            "noise",
            "drift",
            "lag, ms",
        ]
        columns += ["extension, mm", "retraction"]
        terminal.print_table(args, f"measured in {result.log}", columns, rows)
    terminal.notes(args, result.notes)
    if args.out:
        terminal.say(args, "tables: " + ", ".join(str(p) for p in write_tables(result, args.out)))
    terminal.write_json(args, result_json(result))
    if args.report:
        terminal.say(args, f"page: {schedule_page(result, args.report, terminal.typed('schedule'))}")
    return 0
