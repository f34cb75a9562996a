"""``vaneloop clearance``: the hysteresis of each stage traced to clearances of its joints, in millimetres."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace

from plant import load_geometry
from plant.spatial import Clearances
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.design.clearance import FITS, WORDS, clearance_study, study_rows
from vaneloop.pages.mechanism import clearance_page

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Where hysteresis comes from: clearance in the joints and a ring whose centre can wander, in the
mechanism closed in space. Each joint rests on the side that carries the load; the vanes resist motion, so all of them
change sides at a reversal. Given the fits of the pins, the command finds the ring's freedom that explains each vane
row's nominal width, and shows what each joint adds.

examples:
  vaneloop clearance --report clearance.html
  vaneloop clearance --width vigv=2.4 --actuator 0.3
  vaneloop clearance --ring 0.5 --vane 90

exit codes: 0 good, 2 bad input"""

SIDE_BY_SIDE = 3  # stages in a table: more do not fit a terminal


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--geometry", metavar="F.toml", default="geometry.toml", help="the mechanism (default: the shipped one)"
    )
    parser.add_argument(
        "--width",
        metavar="STAGE=DEG",
        action="append",
        default=[],
        help="width to explain (default: the hysteresis of the geometry)",
    )
    parser.add_argument(
        "--vane",
        metavar="DEG",
        type=float,
        default=-90.0,
        help="the measured vane's place, from the right clevis (default -90: the lowest)",
    )
    group = parser.add_argument_group("total clearances, mm")
    for joint, value in FITS.items():
        group.add_argument(
            f"--{joint.replace('_', '-')}",
            metavar="MM",
            type=float,
            default=value,
            help=f"{WORDS[joint]} (default {value:g})",
        )
    group.add_argument(
        "--ring", metavar="MM", type=float, help=f"{WORDS['ring']} (default: found, so that the width comes out)"
    )
    terminal.add_output_options(parser, report=True)


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    fits = Clearances(**{joint: getattr(args, joint) for joint in FITS})
    fits.check()
    if args.ring is not None:
        replace(fits, ring=args.ring).check()
    if not -360.0 <= args.vane <= 360.0:
        raise InputError(f"--vane (={args.vane:g} deg) must be in [-360, 360]")
    geometry = load_geometry(args.geometry)
    vanes = geometry.vanes
    widths = {s: geometry.stage(s).hysteresis.value for s in vanes}
    for stage, text in terminal.pairs(args.width, "width", lambda k: k in vanes, ", ".join(vanes)).items():
        widths[stage] = terminal.number(text)
        if not 0.0 <= widths[stage] <= 10.0:
            raise InputError(f"--width {stage}={text}: must be a number in [0, 10] deg")
    studies = []
    with terminal.progress_bar(args, "crossing the clearances") as progress:
        for i, s in enumerate(vanes):
            studies.append(clearance_study(geometry, s, widths[s], fits, args.vane, args.ring))
            if progress is not None:
                progress((i + 1) / len(vanes))
    where = f"at the vane {args.vane:g} deg from the right clevis"
    for i in range(0, len(studies), SIDE_BY_SIDE):
        some = studies[i : i + SIDE_BY_SIDE]
        rows = study_rows(some)
        rows.append(["together", *(t for s in some for t in ("", f"{s.made:.3f}", ""))])
        columns = ["joint", *(f"{s.stage} {w}" for s in some for w in ("mm", "deg", "alone, mm"))]
        terminal.print_table(
            args, f"clearance of each joint and the width of the loop that it makes, {where}", columns, rows
        )
    rows = [[name.replace("_", " "), *(f"{s.freedoms[name]:.4f}" for s in studies)] for name in studies[0].freedoms]
    title = "the ring's four freedoms: change of the vane angle, deg for 1 mm, largest over the stroke"
    terminal.print_table(args, title, ["freedom", *vanes], rows)
    unit = {"clearance": "mm", "width": "deg"}
    terminal.write_json(args, {"schema": 1, "unit": unit, "vane": args.vane, "stages": [asdict(s) for s in studies]})
    if args.report:
        terminal.say(args, f"page: {clearance_page(studies, args.report, terminal.typed('clearance'), args.vane)}")
    return 0
