"""Pages about the mechanism: hysteresis traced to clearances, and the planar model against the mechanism in space."""

from __future__ import annotations

from typing import Any

import numpy as np

from vaneloop.design.clearance import WORDS, ClearanceStudy, study_rows
from vaneloop.design.spatial import SpatialCheck
from vaneloop.pages.figures import Line, Panel, bars, overlay
from vaneloop.pages.page import Page
from vaneloop.pages.style import STAGE_ROLES

__all__ = ["clearance_page", "spatial_page"]


def clearance_page(studies: list[ClearanceStudy], path: str, command: str, vane: float) -> Any:
    """Write the page of `vaneloop clearance`; return its path."""
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
        page.tile(
            n,
            s.clearances.ring,
            "mm of ring freedom",
            f"{pins:.2f} deg from pins, {s.parts['ring']:.2f} deg from the ring",
        )
    page.section(
        "What each joint adds",
        "Width of the loop that each joint's clearance makes by itself; together they add up. Clearance before the "
        "crank's lower arm counts with the vane row's slope, clearance after it with 1.6 deg for each mm in every row.",
    )
    roles = STAGE_ROLES[: len(names)]
    series: dict[str, list[float | None]] = {
        n: [round(s.parts[j], 4) for j in WORDS] for n, s in zip(names, studies, strict=True)
    }
    page.plot(bars(list(WORDS.values()), series, "width [deg]", roles=dict(zip(names, roles, strict=True))))
    columns = ["joint", *(f"{n} {w}" for n in names for w in ("[mm]", "[deg]", "alone [mm]"))]
    page.table(columns, study_rows(studies), "Alone: the clearance that would make the whole width without any other.")
    page.section(
        "The loop in space",
        "Extension and retraction branch of the mechanism with these clearances, less their mean. With friction the "
        "ring stays anywhere between, which is the backlash (play operator) of the simulated machine; dotted: that "
        "operator, of constant width at the ring.",
    )
    lines = []
    for n, s, role in zip(names, studies, roles, strict=True):
        half = 0.5 * (s.retraction - s.extension)
        lines += [
            Line(f"{n} retraction", s.stroke, half, role, 1.8),
            Line(f"{n} extension", s.stroke, -half, role, 1.8, "dash"),
        ]
        lines.append(Line(f"{n} play operator", s.stroke, s.play, "text", 1.4, "dot"))
    page.plot(overlay([Panel("angle less mean curve [deg]", lines, zero=True)], "stroke [mm]", 420))
    page.section(
        "Where on the ring one measures",
        "A ring that is shifted moves its lowest vane one way and its highest the other; vanes beside the clevises do "
        f"not feel it. The figures above are for the vane at {vane:g} deg from the right clevis. A mean over all vanes "
        "shows only what the pins make. Where the width is negative, the shift leads the motion.",
    )
    lines = [Line(n, s.around, s.width_around, role, 1.8) for n, s, role in zip(names, studies, roles, strict=True)]
    page.plot(overlay([Panel("width [deg]", lines, zero=True)], "vane's place from the right clevis [deg]", 380))
    page.section(
        "The ring's four freedoms",
        "Two links leave the ring four of its six freedoms. Only the shift across the links reaches the vanes; the "
        "others lean the long links a little.",
    )
    rows = [[k.replace("_", " "), *(f"{s.freedoms[k]:.4f}" for s in studies)] for k in studies[0].freedoms]
    page.table(["freedom", *(f"{n} [deg per mm]" for n in names)], rows, "Largest of strokes 0, 24 and 48 mm.")
    return page.write(path)


def spatial_page(check: SpatialCheck, path: str, command: str) -> Any:
    """Write the page of `vaneloop spatial`; return its path."""
    by = "Exudyn, a general multibody library" if check.multibody else "Newton's method on the constraint equations"
    vanes = tuple(check.planar)
    worst = {s: float(np.max(np.abs(check.difference(s)))) for s in vanes}
    page = Page(
        "Planar model against the mechanism in space",
        f"Solved by {by}: " + ", ".join(f"{s.upper()} differs by at most {worst[s]:.3f} deg" for s in vanes) + ".",
        subtitle="linkage",
        command=command,
    )
    for s in vanes:
        page.tile(f"{s.upper()} largest difference", round(worst[s], 4), "deg", "spatial minus planar, 0 to 48 mm")
    page.section(
        "Vane angle and difference over the stroke",
        "Above: planar model (lines) and mechanism in space (dots), as in the paper's validation. Below: their "
        "difference. The ring moves along the engine's axis by L (1 - cos of the vane angle), equation (17); the link "
        "leans by it and is shorter in the plane by that motion squared over twice its length: a few hundredths of a "
        "millimetre, at 1.6 deg for each millimetre.",
    )
    roles = STAGE_ROLES[: len(vanes)]
    lines, differences = [], []
    for s, role in zip(vanes, roles, strict=True):
        lines.append(Line(f"{s.upper()} planar", check.stroke, check.planar[s], role, 1.4))
        lines.append(
            Line(f"{s.upper()} in space", check.stroke, (check.multibody or check.newton)[s], role, 4.0, "dot", 0.6)
        )
        differences.append(Line(f"{s.upper()} difference", check.stroke, check.difference(s), role, 1.8))
    panels = [Panel("vane angle [deg]", lines, height=1.5), Panel("in space less planar [deg]", differences, zero=True)]
    page.plot(overlay(panels, "stroke [mm]"))
    if check.multibody:
        page.section(
            "Two codes, one mechanism",
            "Exudyn's rigid bodies and joints against Newton's method on the loop's equations: rounding.",
        )
        rows = [[s.upper(), f"{np.max(np.abs(check.multibody[s] - check.newton[s])):.1e}"] for s in vanes]
        page.table(["vane row", "largest difference [deg]"], rows)
    return page.write(path)
