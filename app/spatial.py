"""``vaneloop spatial``: the planar model against the mechanism in space, over the whole stroke."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hil import cli

if TYPE_CHECKING:
    import numpy as np

    from plant import Geometry

__all__ = ["DESCRIPTION", "SpatialCheck", "add_options", "command", "spatial_check"]


@dataclass(frozen=True)
class SpatialCheck:
    """Vane angles (deg) over the stroke (mm) by three ways, keyed by stage.

    planar     the paper's analytic model
    newton     constraint equations in space, Newton's method (`plant.spatial`)
    multibody  the same joints in a general multibody library (`app.multibody`); empty where Exudyn is not installed
    """

    stroke: np.ndarray
    planar: dict[str, np.ndarray]
    newton: dict[str, np.ndarray]
    multibody: dict[str, np.ndarray]
    notes: list[str]

    def difference(self, stage: str) -> np.ndarray:
        """Angle in space minus planar angle, deg: the multibody library's where it ran."""
        return (self.multibody or self.newton)[stage] - self.planar[stage]


def spatial_check(geometry: Geometry, offset: float = 0.0, points: int = 97, progress: Any = None) -> SpatialCheck:
    """Close the three stages in space over the stroke of 0 to 48 mm.

    offset  mm along the engine's axis between the crank's plane and the clevis' where the vane angle is 0
    Raises InputError, naming stage and stroke, where a stage does not close.
    """
    import importlib.util

    import numpy as np

    from app.multibody import multibody_angles
    from plant.geometry import vane_angles
    from plant.linkage import STAGES
    from plant.spatial import spatial_angles
    from tables import InputError

    if not -100.0 <= offset <= 100.0:
        raise InputError(f"--offset (={offset:g} mm) must be in [-100, 100]")
    if not 2 <= points <= 10_000:
        raise InputError(f"--points (={points}) must be in [2, 10000]")
    stroke = np.linspace(0.0, 48.0, points)
    planar = dict(zip(STAGES, np.rad2deg(vane_angles(stroke * 1e-3, geometry)).T, strict=True))
    newton = {s: spatial_angles(geometry, s, stroke, offset) for s in STAGES}
    multibody, notes = {}, []
    if importlib.util.find_spec("exudyn") is None:
        notes.append("exudyn is not installed (pip install 'vaneloop[multibody]'): constraint equations by Newton's method only")
    else:
        for i, s in enumerate(STAGES):
            multibody[s] = multibody_angles(geometry, s, stroke, offset)
            if progress is not None:
                progress((i + 1) / len(STAGES))
    return SpatialCheck(stroke, planar, newton, multibody, notes)


DESCRIPTION = """Check the planar model of the linkage against the mechanism in space: spherical joints at both ends of the vertical link,
a ring that turns and slides along the engine's axis as its lever arms pull it (equation 17). Constraint equations, solved by Newton's
method and, where it is installed, by the multibody library Exudyn, as the paper does with ADAMS.

examples:
  vaneloop spatial --report spatial.html
  vaneloop spatial --geometry tables/geometry.toml --offset 10

exit codes: 0 planar and spatial agree within --limit, 1 they do not, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--geometry", metavar="F.toml", default="geometry.toml", help="the mechanism (default: the shipped one)")
    parser.add_argument(
        "--offset", metavar="MM", type=float, default=0.0, help="along the engine's axis from the crank's plane to the clevis (default 0)"
    )
    parser.add_argument("--points", metavar="N", type=int, default=97, help="strokes from 0 to 48 mm (default 97)")
    parser.add_argument("--limit", metavar="DEG", type=float, default=0.1, help="largest difference allowed (default 0.1 deg)")
    cli.add_output_options(parser)
    parser.add_argument("--report", metavar="F.html", help="write a self-contained HTML page with plots")


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    import numpy as np

    from plant import load_geometry
    from plant.linkage import STAGES
    from tables import InputError

    if not args.limit >= 0.0:
        raise InputError(f"--limit (={args.limit:g} deg) must be 0 or more")
    geometry = load_geometry(args.geometry)
    with cli.progress_bar(args, "closing the loop in space") as progress:
        check = spatial_check(geometry, args.offset, args.points, progress)
    rows, stages = [], []
    for s in STAGES:
        d = check.difference(s)
        worst = int(np.argmax(np.abs(d)))
        two = float(np.max(np.abs(check.multibody[s] - check.newton[s]))) if check.multibody else None
        figures = {"max_abs": abs(float(d[worst])), "rms": float(np.sqrt(np.mean(d**2))), "at_stroke": float(check.stroke[worst])}
        stages.append({"stage": s, "unit": "deg", **figures, "multibody_against_newton": two, "difference": d})
        apart = "-" if two is None else f"{two:.1e}"
        numbers = (f"{figures['max_abs']:.4f}", f"{figures['rms']:.4f}", f"{figures['at_stroke']:.1f}", f"{check.planar[s][worst]:.1f}")
        rows.append([s, *numbers, apart])
    columns = ["spatial minus planar, deg", "max", "rms", "at stroke, mm", "vane angle, deg", "Exudyn against Newton"]
    cli.print_table(args, f"{len(check.stroke)} strokes from 0 to 48 mm, axial offset {args.offset:g} mm", columns, rows)
    for note in check.notes:
        cli.say(args, f"note: {note}")
    exceeded = [f"{s['stage']} {s['max_abs']:.4f} deg exceeds {args.limit:g} deg" for s in stages if s["max_abs"] > args.limit]
    for line in exceeded:
        cli.say(args, f"exceeded: {line}")
    out = {"schema": 1, "stroke": check.stroke, "offset": args.offset, "stages": stages, "notes": check.notes, "exceeded": exceeded}
    cli.write_json(args, out)
    if args.report:
        cli.say(args, f"page: {_page(check, args.report, ' '.join(['vaneloop spatial', *sys.argv[2:]]))}")
    return 1 if exceeded else 0


def _page(check: SpatialCheck, path: str, command: str) -> Any:
    import numpy as np

    from hil.page import Line, Page, Panel, overlay
    from plant.linkage import STAGES

    by = "Exudyn, a general multibody library" if check.multibody else "Newton's method on the constraint equations"
    worst = {s: float(np.max(np.abs(check.difference(s)))) for s in STAGES}
    page = Page(
        "Planar model against the mechanism in space",
        f"Solved by {by}: " + ", ".join(f"{s.upper()} differs by at most {worst[s]:.3f} deg" for s in STAGES) + ".",
        subtitle="linkage",
        command=command,
    )
    for s in STAGES:
        page.tile(f"{s.upper()} largest difference", round(worst[s], 4), "deg", "spatial minus planar, 0 to 48 mm")
    page.section(
        "Vane angle and difference over the stroke",
        "Above: planar model (lines) and mechanism in space (dots), as in the paper's validation. Below: their difference. The ring moves "
        "along the engine's axis by L (1 - cos of the vane angle), equation (17); the link leans by it and is shorter in the plane by that "
        "motion squared over twice its length: a few hundredths of a millimetre, at 1.6 deg for each millimetre.",
    )
    roles = ("measured", "model", "target")
    lines, differences = [], []
    for s, role in zip(STAGES, roles, strict=True):
        lines.append(Line(f"{s.upper()} planar", check.stroke, check.planar[s], role, 1.4))
        lines.append(Line(f"{s.upper()} in space", check.stroke, (check.multibody or check.newton)[s], role, 4.0, "dot", 0.6))
        differences.append(Line(f"{s.upper()} difference", check.stroke, check.difference(s), role, 1.8))
    panels = [Panel("vane angle [deg]", lines, height=1.5), Panel("in space less planar [deg]", differences, zero=True)]
    page.plot(overlay(panels, "stroke [mm]"))
    if check.multibody:
        page.section(
            "Two codes, one mechanism", "Exudyn's rigid bodies and joints against Newton's method on the loop's equations: rounding."
        )
        rows = [[s.upper(), f"{np.max(np.abs(check.multibody[s] - check.newton[s])):.1e}"] for s in STAGES]
        page.table(["stage", "largest difference [deg]"], rows)
    return page.write(path)
