"""``vaneloop clearance``: the hysteresis of each stage traced to clearances of its joints, in millimetres."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from hil import cli

if TYPE_CHECKING:
    import numpy as np

    from plant import Geometry
    from plant.spatial import Clearances

__all__ = ["DESCRIPTION", "FITS", "ClearanceStudy", "add_options", "clearance_study", "command"]

# mm. Chosen: running fits as new (H8/f7 on 10 to 18 mm: 0.016 to 0.061 mm) at the pivots, as much in each spherical joint, two of
# which hold the actuator; a close fit at the lever arms' ends. What these leave of the hysteresis is the ring's own freedom.
FITS = {"actuator": 0.10, "crank_pivot": 0.04, "crank_link": 0.05, "link_clevis": 0.05, "lever_pin": 0.03}
WORDS = {
    "actuator": "actuator, both ends",
    "crank_pivot": "bell crank's bearing",
    "crank_link": "crank to link",
    "link_clevis": "link to clevis",
    "ring": "ring across its links",
    "lever_pin": "lever arm's end",
}


@dataclass(frozen=True)
class ClearanceStudy:
    """One stage's hysteresis made of clearances. deg, mm.

    width       what was to be explained; made: what the clearances make
    clearances  the joints' fits, and the ring's freedom that makes up the rest
    parts       width that each joint makes alone
    per_mm      width for 1 mm of clearance of each joint
    alone       clearance that each joint would need if it made the whole width by itself (None: more than 5 mm)
    freedoms    change of the vane angle for 1 mm of each of the ring's four freedoms, largest over the stroke
    stroke, extension, retraction   the loop in space; play: half the width of a play operator at the ring, seen at the vane
    around, width_around            width over the vane's place on the ring, deg from the right clevis
    """

    stage: str
    width: float
    made: float
    clearances: Clearances
    parts: dict[str, float]
    per_mm: dict[str, float]
    alone: dict[str, float | None]
    freedoms: dict[str, float]
    stroke: np.ndarray
    extension: np.ndarray
    retraction: np.ndarray
    play: np.ndarray
    around: np.ndarray
    width_around: np.ndarray


def clearance_study(
    geometry: Geometry, stage: str, width: float, fits: Clearances, vane: float = -90.0, ring: float | None = None
) -> ClearanceStudy:
    """Find the ring's clearance that, beside ``fits``, gives the stage's ``width`` (deg) at the vane; ``ring`` (mm) takes it as given.

    vane  deg along the ring from the right clevis to the measured vane; -90 is the lowest
    Raises InputError where the fits alone are wider than the width, or no clearance reaches it.
    """
    import numpy as np

    from plant.spatial import Clearances, clearance_for, clearance_loop, clearance_width, contributions, freedoms
    from tables import InputError

    fits.check()
    if ring is None:
        ring = clearance_for(geometry, stage, width, replace(fits, ring=0.0), "ring", vane)
    whole = replace(fits, ring=ring)
    stroke = np.linspace(0.0, 48.0, 49)
    extension, retraction = clearance_loop(geometry, stage, stroke, whole, vane)
    alone: dict[str, float | None] = {}
    for joint in WORDS:
        try:
            alone[joint] = clearance_for(geometry, stage, width, Clearances(), joint, vane)
        except InputError:
            alone[joint] = None
    around = np.linspace(-180.0, 180.0, 25)
    made = clearance_width(geometry, stage, whole, vane)
    ratio = getattr(geometry, stage).l.value / getattr(geometry, stage).ld_prime.value
    mean = np.deg2rad(0.5 * (extension + retraction))
    at_vane = (1.0 + (ratio * np.sin(mean)) ** 2) / np.cos(mean)  # d vane / d ring over its value in mid-range
    each = [freedoms(geometry, stage, x, vane) for x in (0.0, 24.0, 48.0)]
    return ClearanceStudy(
        stage,
        width,
        made,
        whole,
        contributions(geometry, stage, whole, vane),
        {j: clearance_width(geometry, stage, Clearances(**{j: 0.1}), vane) / 0.1 for j in WORDS},
        alone,
        {name: max((e[name] for e in each), key=abs) for name in each[0]},
        stroke,
        extension,
        retraction,
        0.5 * made * at_vane,
        around,
        np.array([clearance_width(geometry, stage, whole, float(v)) for v in around]),
    )


DESCRIPTION = """Where hysteresis comes from: clearance in the joints and a ring whose centre can wander, in the mechanism closed in space.
Each joint rests on the side that carries the load; the vanes resist motion, so all of them change sides at a reversal. Given the
fits of the pins, the command finds the ring's freedom that explains each stage's nominal width, and shows what each joint adds.

examples:
  vaneloop clearance --report clearance.html
  vaneloop clearance --width vigv=2.4 --actuator 0.3
  vaneloop clearance --ring 0.5 --vane 90

exit codes: 0 good, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--geometry", metavar="F.toml", default="geometry.toml", help="the mechanism (default: the shipped one)")
    parser.add_argument(
        "--width", metavar="STAGE=DEG", action="append", default=[], help="width to explain (default: the hysteresis of the geometry)"
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
            f"--{joint.replace('_', '-')}", metavar="MM", type=float, default=value, help=f"{WORDS[joint]} (default {value:g})"
        )
    group.add_argument("--ring", metavar="MM", type=float, help=f"{WORDS['ring']} (default: found, so that the width comes out)")
    cli.add_output_options(parser)
    parser.add_argument("--report", metavar="F.html", help="write a self-contained HTML page with plots")


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    from plant import load_geometry
    from plant.linkage import STAGES
    from plant.spatial import Clearances
    from tables import InputError

    fits = Clearances(**{joint: getattr(args, joint) for joint in FITS})
    fits.check()
    if args.ring is not None:
        replace(fits, ring=args.ring).check()
    if not -360.0 <= args.vane <= 360.0:
        raise InputError(f"--vane (={args.vane:g} deg) must be in [-360, 360]")
    geometry = load_geometry(args.geometry)
    widths = {s: getattr(geometry, s).hysteresis.value for s in STAGES}
    for stage, text in cli.pairs(args.width, "width", lambda k: k in STAGES, ", ".join(STAGES)).items():
        try:
            widths[stage] = float(text)
        except ValueError:
            widths[stage] = float("nan")
        if not 0.0 <= widths[stage] <= 10.0:
            raise InputError(f"--width {stage}={text}: must be a number in [0, 10] deg")
    studies = []
    with cli.progress_bar(args, "crossing the clearances") as progress:
        for i, s in enumerate(STAGES):
            studies.append(clearance_study(geometry, s, widths[s], fits, args.vane, args.ring))
            if progress is not None:
                progress((i + 1) / len(STAGES))
    rows = _rows(studies)
    rows.append(["together", *(t for s in studies for t in ("", f"{s.made:.3f}", ""))])
    columns = ["joint", *(f"{s.stage} {w}" for s in studies for w in ("mm", "deg", "alone, mm"))]
    where = f"at the vane {args.vane:g} deg from the right clevis"
    cli.print_table(args, f"clearance of each joint and the width of the loop that it makes, {where}", columns, rows)
    rows = [[name.replace("_", " "), *(f"{s.freedoms[name]:.4f}" for s in studies)] for name in studies[0].freedoms]
    title = "the ring's four freedoms: change of the vane angle, deg for 1 mm, largest over the stroke"
    cli.print_table(args, title, ["freedom", *STAGES], rows)
    unit = {"clearance": "mm", "width": "deg"}
    cli.write_json(args, {"schema": 1, "unit": unit, "vane": args.vane, "stages": [asdict(s) for s in studies]})
    if args.report:
        cli.say(args, f"page: {_page(studies, args.report, ' '.join(['vaneloop clearance', *sys.argv[2:]]), args.vane)}")
    return 0


def _rows(studies: list[ClearanceStudy]) -> list[list[str]]:
    """Per joint and stage: clearance, width, and the clearance that alone would make the whole width."""
    return [
        [WORDS[j], *(t for s in studies for t in (f"{getattr(s.clearances, j):.3f}", f"{s.parts[j]:.3f}", _or(s.alone[j])))] for j in WORDS
    ]


def _or(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _page(studies: list[ClearanceStudy], path: str, command: str, vane: float) -> Any:
    from hil.page import Line, Page, Panel, bars, overlay

    names = [s.stage.upper() for s in studies]
    ring = ", ".join(f"{n} {s.clearances.ring:.2f} mm" for n, s in zip(names, studies, strict=True))
    widths = ", ".join(f"{s.made:.2f}" for s in studies)
    page = Page(
        "Where the hysteresis comes from",
        f"Widths of {widths} deg: the pins' fits, and rings that can wander across their links by {ring}.",
        subtitle="clearance",
        command=command,
    )
    for n, s in zip(names, studies, strict=True):
        pins = sum(v for j, v in s.parts.items() if j != "ring")
        page.tile(n, s.clearances.ring, "mm of ring freedom", f"{pins:.2f} deg from pins, {s.parts['ring']:.2f} deg from the ring")
    page.section(
        "What each joint adds",
        "Width of the loop that each joint's clearance makes by itself; together they add up. Clearance before the crank's lower arm "
        "counts with the stage's slope, clearance after it with 1.6 deg for each mm in every stage.",
    )
    roles = ("measured", "model", "target")
    series: dict[str, list[float | None]] = {n: [round(s.parts[j], 4) for j in WORDS] for n, s in zip(names, studies, strict=True)}
    page.plot(bars(list(WORDS.values()), series, "width [deg]", roles=dict(zip(names, roles, strict=True))))
    columns = ["joint", *(f"{n} {w}" for n in names for w in ("[mm]", "[deg]", "alone [mm]"))]
    page.table(columns, _rows(studies), "Alone: the clearance that would make the whole width without any other.")
    page.section(
        "The loop in space",
        "Extension and retraction branch of the mechanism with these clearances, less their mean. With friction the ring stays anywhere "
        "between, which is the play operator of the simulated machine; dotted: that operator, of constant width at the ring.",
    )
    lines = []
    for n, s, role in zip(names, studies, roles, strict=True):
        half = 0.5 * (s.retraction - s.extension)
        lines += [Line(f"{n} retraction", s.stroke, half, role, 1.8), Line(f"{n} extension", s.stroke, -half, role, 1.8, "dash")]
        lines.append(Line(f"{n} play operator", s.stroke, s.play, "text", 1.4, "dot"))
    page.plot(overlay([Panel("angle less mean curve [deg]", lines, zero=True)], "stroke [mm]", 420))
    page.section(
        "Where on the ring one measures",
        f"A ring that is shifted moves its lowest vane one way and its highest the other; vanes beside the clevises do not feel it. The "
        f"figures above are for the vane at {vane:g} deg from the right clevis. A mean over all vanes shows only what the pins make. "
        "Where the width is negative, the shift leads the motion.",
    )
    lines = [Line(n, s.around, s.width_around, role, 1.8) for n, s, role in zip(names, studies, roles, strict=True)]
    page.plot(overlay([Panel("width [deg]", lines, zero=True)], "vane's place from the right clevis [deg]", 380))
    page.section(
        "The ring's four freedoms",
        "Two links leave the ring four of its six freedoms. Only the shift across the links reaches the vanes; the others lean the long "
        "links a little.",
    )
    rows = [[k.replace("_", " "), *(f"{s.freedoms[k]:.4f}" for s in studies)] for k in studies[0].freedoms]
    page.table(["freedom", *(f"{n} [deg per mm]" for n in names)], rows, "Largest of strokes 0, 24 and 48 mm.")
    return page.write(path)
