"""The page of ``vaneloop schedule``: what the paper's in-house tool showed (figures 9 to 13), in one self-contained
file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from plant import Geometry
from plant.geometry import vane_angles
from plant.spatial import plane_joints
from vaneloop.base.vanes import VANES
from vaneloop.design.scheduling import ScheduleResult
from vaneloop.design.stroke_tables import DESIGN_SPEED, STROKE_LIMITS
from vaneloop.pages.figures import Line, Panel, bars, loop, overlay
from vaneloop.pages.page import Page
from vaneloop.pages.style import STAGE_ROLES

__all__ = ["mechanism_figure", "schedule_page", "with_points"]

NAMES = {v: v.upper() for v in VANES}


def mechanism_figure(geometry: Geometry, stage: str, strokes: tuple[float, ...]) -> dict[str, Any]:
    """One stage's mechanism, drawn to scale in its plane at some strokes (mm): actuator, crank, link, ring."""
    lines = []
    for role, stroke in zip(STAGE_ROLES, strokes, strict=False):
        j = {name: p * 1e3 for name, p in plane_joints(geometry, stage, stroke * 1e-3).items()}
        path = [j["J0"], j["J1"], j["J2"], j["J3"], j["J4"], j["J5"]]
        lines.append(Line(f"{stroke:g} mm of stroke", [p.real for p in path], [p.imag for p in path], role, 2.2))
    ring = float(geometry.stage(stage).ld.value)
    centre = plane_joints(geometry, stage, 0.0)["J5"] * 1e3
    around = centre + ring * np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 181))
    lines.append(Line("unison ring", around.real, around.imag, "muted", 1.0, "dot"))
    figure = loop(lines, "x [mm]", "y [mm]", height=560)
    for trace in figure["data"][: len(strokes)]:
        trace["mode"] = "lines+markers"
        trace["marker"]["size"] = 7
    figure["layout"]["yaxis"] |= {"scaleanchor": "x", "scaleratio": 1}
    figure["layout"]["yaxis"].pop("range", None)
    return figure


def schedule_page(result: ScheduleResult, path: str | Path, command: str = "") -> Path:
    """Write the page; return its path. Raises InputError where it cannot be written."""
    others, vanes = result.links[1:], result.geometry.vanes
    design = int(np.argmin(np.abs(result.speed - DESIGN_SPEED)))
    verdict = "; ".join(
        f"{NAMES[s.stage]} with Lb {s.lb:g} mm and Lc {s.lc:g} mm: {s.rms['adjusted']:.2f} deg rms "
        f"({s.rms['built']:.2f} as it is, {s.rms['initial']:.2f} as first built), {s.at_design['adjusted']:.2f} deg at "
        f"100 % speed ({s.at_design['built']:.2f} as it is, {s.at_design['initial']:.2f} as first built)"
        for s in others
    )
    page = Page(
        "Stroke schedule and links",
        (verdict or "One vane row: its stroke is what meets the schedule") + ".",
        subtitle="schedule",
        command=command,
        log=result.log,
    )
    page.tile("stroke at 100 %", float(result.table[3, design]), "mm", "mean curve, VIGV on its schedule")
    for s in others:
        page.tile(
            f"{NAMES[s.stage]} worst error",
            s.largest["adjusted"],
            "deg",
            f"40 to 102 %; was {s.largest['built']:.2f} deg",
        )
    if "vigv" in result.loops:
        m = result.loops["vigv"]
        page.tile("VIGV hysteresis", m.width, "deg", f"measured, ± {max(m.width_sigma, 0.001):.3f} deg")
    else:
        page.tile("VIGV hysteresis", result.built.vigv.hysteresis.value, "deg", "from the geometry: no log given")

    page.section(
        "Mechanism at three strokes",
        "Actuator from its mount (0, 0) to the bell crank, lower arm, vertical link, unison ring; drawn to scale, "
        "lengths as adjusted. A longer stroke turns crank, ring and vanes anticlockwise.",
    )
    strokes = (STROKE_LIMITS[0], 0.5 * sum(STROKE_LIMITS), STROKE_LIMITS[1])
    for name in vanes:
        page.plot(mechanism_figure(result.geometry, name, strokes), NAMES[name], half=True)

    page.section(
        "Vane angle against stroke",
        "Solid: lengths as adjusted. Dotted: the geometry as entered. The bell crank's lower arm changes the slope, "
        "the link the offset.",
    )
    x = np.linspace(*STROKE_LIMITS, 193)
    after, before = (np.rad2deg(vane_angles(x * 1e-3, g)) for g in (result.geometry, result.built))
    lines = [Line(NAMES[n], x, after[:, k], STAGE_ROLES[k], 2.0) for k, n in enumerate(vanes)]
    lines += [Line(f"{NAMES[n]}, as entered", x, before[:, k], STAGE_ROLES[k], 1.2, "dot") for k, n in enumerate(vanes)]
    page.plot(overlay([Panel("vane angle [deg]", lines)], "stroke [mm]", 460))

    page.section(
        "Schedule and result",
        "One stroke serves all vane rows: it is scheduled for the VIGV; the others follow as their lengths let them. "
        "Error is target minus angle.",
    )
    angle_lines, error_lines = [], []
    for k, s in enumerate(result.links):
        angle_lines.append(Line(f"{NAMES[s.stage]} target", result.speed, result.target[:, k], "text", 1.2, "dot"))
        angle_lines.append(
            Line(f"{NAMES[s.stage]} adjusted", result.speed, result.target[:, k] - s.error, STAGE_ROLES[k], 1.8)
        )
    for k, s in enumerate(result.links[1:], start=1):
        error_lines.append(
            Line(f"{NAMES[s.stage]} as first built", result.speed, s.error_initial, STAGE_ROLES[k], 1.2, "dot")
        )
        error_lines.append(Line(f"{NAMES[s.stage]} as it is", result.speed, s.error_built, STAGE_ROLES[k], 1.4, "dash"))
        error_lines.append(Line(f"{NAMES[s.stage]} adjusted", result.speed, s.error, STAGE_ROLES[k], 2.2))
    panels = [Panel("vane angle [deg]", angle_lines, height=1.3)]
    if others:
        panels.append(Panel("error [deg]", error_lines, zero=True))
    page.plot(overlay(panels, "rotor speed [%]"))
    if others:
        page.plot(
            bars(
                [NAMES[s.stage] for s in others],
                {
                    words: [round(abs(s.at_design[name]), 4) for s in others]
                    for name, words in (("initial", "as first built"), ("built", "as it is"), ("adjusted", "adjusted"))
                },
                "error at 100 % speed [deg]",
                roles={"as first built": "bad", "as it is": "model", "adjusted": "good"},
            )
        )
    columns = ["vane row", "state", "Lb [mm]", "Lc [mm]", "at 100 % [deg]", "rms [deg]", "max [deg]"]
    rows: list[list[object]] = []
    for s in result.links:
        for name, words in (("initial", "as first built"), ("built", "as it is"), ("adjusted", "adjusted")):
            lb = {"initial": s.lb_initial, "built": s.lb_built, "adjusted": s.lb}[name]
            lc = s.lc if name == "adjusted" else s.lc_built
            figures = (s.at_design[name], s.rms[name], s.largest[name])
            rows.append([NAMES[s.stage], words, f"{lb:g}", f"{lc:g}", *(f"{v:z.3f}" for v in figures)])
        for name in ("extension", "retraction"):
            figures = (s.at_design[name], s.rms[name], s.largest[name])
            rows.append([NAMES[s.stage], f"on the {name} curve", "", "", *(f"{v:z.3f}" for v in figures)])
    page.table(
        columns,
        rows,
        "Errors of the mean curve, and on either branch with both stroke tables; rms and max over 40 to 102 % speed.",
    )

    for name, m in result.loops.items():
        page.section(
            f"{NAMES[name]}: measured loop and its two curves",
            f"Width {m.width:.2f} deg at the vane. Samples inside the gap (crossing it, or dithering in it) belong to "
            f"neither curve. The geometry with Lb {m.lb:.2f} mm and Lc {m.lc:.2f} mm has the measured mean curve to "
            f"{m.misfit:.3f} deg rms.",
        )
        sx, sy, side = m.samples
        pick = np.linspace(0, sx.size - 1, min(sx.size, 6000)).astype(int)
        sx, sy, side = sx[pick], sy[pick], side[pick]
        base = np.rad2deg(vane_angles(m.stroke * 1e-3, result.built)[:, vanes.index(name)])
        inside = (m.stroke >= STROKE_LIMITS[0]) & (m.stroke <= STROKE_LIMITS[1])
        g = m.stroke[inside]
        points = [
            Line("measured, extension", sx[side > 0], sy[side > 0], "measured"),
            Line("measured, retraction", sx[side < 0], sy[side < 0], "model"),
            Line("inside the gap", sx[side == 0], sy[side == 0], "muted"),
        ]
        points = [p for p in points if np.size(p.x)]
        curves = [
            Line("extension", g, m.extension[inside], "measured", 2.0),
            Line("retraction", g, m.retraction[inside], "model", 2.0),
        ]
        page.plot(with_points(points, curves, "vane angle [deg]"), "Angle against stroke.")
        points = [
            Line(p.name, p.x, np.asarray(p.y) - np.interp(np.asarray(p.x), m.stroke, base), p.role) for p in points
        ]
        curves = [Line(c.name, c.x, np.asarray(c.y) - base[inside], c.role, c.width) for c in curves]
        caption = "The same less the geometry's own curve: the gap is seen by itself."
        page.plot(with_points(points, curves, "angle less model as entered [deg]"), caption)

    page.section(
        "Stroke tables",
        "What the controller loads: the curve of the direction in which the speed demand moves, or their mean.",
    )
    lines = [Line(n, result.speed, result.table[r], role, 1.8, dash) for r, n, role, dash in
             ((1, "extension", "measured", "solid"), (2, "retraction", "model", "solid"),
             (3, "mean", "text", "dot"))]  # fmt: skip
    page.plot(overlay([Panel("stroke [mm]", lines)], "rotor speed [%]", 420))
    rows = [
        [f"{c[0]:g}", *(f"{v:z.3f}" for v in c[1:]), *(f"{s.error[i]:z.3f}" for s in others)]
        for i, c in enumerate(result.table.T)
    ]
    page.table(
        [
            *("speed [%]", "extension [mm]", "retraction [mm]", "mean [mm]"),
            *(f"{NAMES[s.stage]} error [deg]" for s in others),
        ],
        rows,
    )
    page.notes(result.notes)
    return page.write(path)


def with_points(points: list[Line], curves: list[Line], y_title: str) -> dict[str, Any]:
    """Measured samples over the stroke as dots, curves as lines."""
    figure = loop([*points, *curves], "stroke [mm]", y_title, height=480)
    for trace, line in zip(figure["data"][: len(points)], points, strict=True):
        x, y = (np.round(np.asarray(v), 4).tolist() for v in (line.x, line.y))
        trace |= {"mode": "markers", "x": x, "y": y}
        trace["marker"] |= {"size": 3, "opacity": 0.5}
    return figure
