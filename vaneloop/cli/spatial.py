"""``vaneloop spatial``: the planar model against the mechanism in space, over the whole stroke."""

from __future__ import annotations

import argparse

import numpy as np

from plant import load_geometry
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.design.spatial import spatial_check
from vaneloop.pages.mechanism import spatial_page

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Check the planar model of the linkage against the mechanism in space: spherical joints at both ends of
the vertical link, a ring that turns and slides along the engine's axis as its lever arms pull it (equation 17).
Constraint equations, solved by Newton's method and, where it is installed, by the multibody library Exudyn, as the
paper does with ADAMS.

examples:
  vaneloop spatial --report spatial.html
  vaneloop spatial --geometry tables/geometry.toml --offset 10

exit codes: 0 planar and spatial agree within --limit, 1 they do not, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--geometry", metavar="F.toml", default="geometry.toml", help="the mechanism (default: the shipped one)"
    )
    parser.add_argument(
        "--offset",
        metavar="MM",
        type=float,
        default=0.0,
        help="along the engine's axis from the crank's plane to the clevis (default 0)",
    )
    parser.add_argument("--points", metavar="N", type=int, default=97, help="strokes from 0 to 48 mm (default 97)")
    parser.add_argument(
        "--limit", metavar="DEG", type=float, default=0.1, help="largest difference allowed (default 0.1 deg)"
    )
    terminal.add_output_options(parser, report=True)


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if not args.limit >= 0.0:
        raise InputError(f"--limit (={args.limit:g} deg) must be 0 or more")
    geometry = load_geometry(args.geometry)
    with terminal.progress_bar(args, "closing the loop in space") as progress:
        check = spatial_check(geometry, args.offset, args.points, progress)
    rows, stages = [], []
    for s in geometry.vanes:
        d = check.difference(s)
        worst = int(np.argmax(np.abs(d)))
        two = float(np.max(np.abs(check.multibody[s] - check.newton[s]))) if check.multibody else None
        figures = {
            "max_abs": abs(float(d[worst])),
            "rms": float(np.sqrt(np.mean(d**2))),
            "at_stroke": float(check.stroke[worst]),
        }
        stages.append({"stage": s, "unit": "deg", **figures, "multibody_against_newton": two, "difference": d})
        apart = "-" if two is None else f"{two:.1e}"
        numbers = (
            f"{figures['max_abs']:.4f}",
            f"{figures['rms']:.4f}",
            f"{figures['at_stroke']:.1f}",
            f"{check.planar[s][worst]:.1f}",
        )
        rows.append([s, *numbers, apart])
    columns = ["spatial minus planar, deg", "max", "rms", "at stroke, mm", "vane angle, deg", "Exudyn against Newton"]
    terminal.print_table(
        args, f"{len(check.stroke)} strokes from 0 to 48 mm, axial offset {args.offset:g} mm", columns, rows
    )
    terminal.notes(args, check.notes)
    exceeded = [
        f"{s['stage']} {s['max_abs']:.4f} deg exceeds {args.limit:g} deg" for s in stages if s["max_abs"] > args.limit
    ]
    for line in exceeded:
        terminal.say(args, f"exceeded: {line}")
    out = {
        "schema": 1,
        "stroke": check.stroke,
        "offset": args.offset,
        "stages": stages,
        "notes": check.notes,
        "exceeded": exceeded,
    }
    terminal.write_json(args, out)
    if args.report:
        terminal.say(args, f"page: {spatial_page(check, args.report, terminal.typed('spatial'))}")
    return 1 if exceeded else 0
