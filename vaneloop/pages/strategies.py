"""The page of the comparison of control strategies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from controller import STRATEGIES
from plant import Plant
from plant.effect import T_REF
from vaneloop.design.strategies import FIGURES, HEAT, STEP, Failure, Outcome, Outcomes, Scenario, casing
from vaneloop.pages.figures import Line, Panel, bars, loop, overlay
from vaneloop.pages.page import Page
from vaneloop.pages.style import number

__all__ = ["report"]

# failures drawn, and their colours
_SHOWN = {"no signal": "model", "stuck": "other", "drift of 0.005 deg/s": "target", "drift of -0.005 deg/s": "measured"}


def report(
    path: str | Path,
    rows: tuple[Scenario, ...],
    plant: Plant,
    outcomes: Outcomes,
    failures: list[tuple[Failure, Outcome]],
    goals: list[dict[str, Any]],
    best: str,
    words: str = "",
) -> Path:
    """Write the page; return its path."""
    last = rows[-1]
    both = dual, mine = outcomes[last.name, "dual"], outcomes[last.name, best]
    errors = [o.figures["vigv"] for o in (dual, mine)]
    missed = [g for g in goals if not g["held"]]
    page = Page(
        "Control strategies",
        f"On a worn, hot, noisy engine with a dithering demand the VIGV is off by {number(errors[1]['mean_abs'])} deg "
        f"on average under {best}, by {number(errors[0]['mean_abs'])} deg under the dual curves: "
        f"{goals[0]['value']:.1f} times less, with {mine.travel / max(dual.travel, 1e-9):.2f} of the travel. "
        + (f"{len(missed)} of {len(goals)} goals are missed." if missed else f"All {len(goals)} goals are met."),
        tone="bad" if missed else "good",
        subtitle=f"{', '.join(v.upper() for v in plant.vanes)}, closed loop of firmware and plant",
        command=words,
    )
    page.tile(
        "Mean VIGV error, all together", errors[1]["mean_abs"], "deg", f"{best}; dual {number(errors[0]['mean_abs'])}"
    )
    page.tile("Maximum", errors[1]["max_abs"], "deg", f"{best}; dual {number(errors[0]['max_abs'])}")
    page.tile("Travel of the actuator", mine.travel, "mm", f"{best}; dual {number(dual.travel)}")
    if failures:
        page.tile("Largest step when potentiometers fail", max(f.step for f, _ in failures), "deg", f"allowed {STEP}")
    roles = dict(zip(STRATEGIES, ("muted", "model", "target", "measured"), strict=True))
    page.section(
        "Error and cost",
        "Each group is one machine, each bar one strategy. Lower is better. Errors of the true angles.",
    )
    for title, value in (
        ("mean VIGV error [deg]", lambda o: o.figures["vigv"]["mean_abs"]),
        ("maximum VIGV error [deg]", lambda o: o.figures["vigv"]["max_abs"]),
        ("mean VIGV error at 99 to 100 % [deg]", lambda o: o.figures["vigv"]["mean_abs_99_100"]),
        ("travel of the actuator [mm]", lambda o: o.travel),
    ):
        series = {s: [value(outcomes[r.name, s]) for r in rows] for s in STRATEGIES}
        page.plot(bars([r.name for r in rows], series, title, roles=roles), half=True)
    figures = [f"{s.upper()} {word}" for s in plant.vanes for word in ("mean", "max", "99-100 %")]
    columns = ["machine", "strategy", *figures, "travel [mm]", "turns", "mA rms"]
    page.table(
        columns,
        [
            [m, s, *(o.figures[v][k] for v in plant.vanes for k in FIGURES), o.travel, o.reversals, o.current]
            for (m, s), o in outcomes.items()
        ],
        "Errors in deg; 99-100 %: mean at these speeds; turns: reversals of the piston; mA rms: servo-valve current. "
        "The stroke is scheduled for the VIGV; the others follow through their links, whose own error stays in.",
    )
    page.section(
        "The run, all together", f"Rotor speed, VIGV error under the dual curves and under {best}, and the stroke."
    )
    page.plot(
        overlay(
            [
                Panel(
                    "VIGV error [deg]",
                    [Line(o.strategy, o.t, o.errors[:, 0], roles[o.strategy]) for o in both],
                    zero=True,
                    height=1.4,
                ),
                Panel("stroke demand [mm]", [Line(o.strategy, o.t, o.stroke_demand, roles[o.strategy]) for o in both]),
                Panel("rotor speed [%]", [Line("rotor speed", mine.t, mine.n_r, "muted")]),
            ]
        )
    )
    adaptive = outcomes[last.name, "adaptive"]
    worn = 0.0 if last.play is None else last.play - plant.geometry.vigv.hysteresis.value
    growth = last.growth / HEAT * (casing(adaptive.n_r) - T_REF)
    t, grown = adaptive.t, np.full(len(adaptive.t), worn)
    page.section("What adaptive learns", "Offset, and backlash beyond the one as built: as learned and as they are.")
    page.plot(
        overlay(
            [
                Panel(
                    "offset [deg]", [Line("true", t, growth, "muted"), Line("learned", t, adaptive.offset, "measured")]
                ),
                Panel(
                    "backlash beyond built [deg]",
                    [Line("true", t, grown, "muted"), Line("learned", t, adaptive.width, "measured")],
                ),
            ]
        )
    )
    page.section(
        "VIGV against speed, all together",
        "All rises and falls on top of each other; the closer to one line, the better.",
    )
    for o in both:
        page.plot(
            loop([Line(o.strategy, o.n_r, o.vanes[:, 0], roles[o.strategy])], "rotor speed [%]", "VIGV [deg]"),
            half=True,
        )
    if failures:
        page.section(
            "Potentiometers that fail",
            "All fail at once, after the middle of the run. The compensation stays as learned; nothing jumps. "
            "A drift slower than what the casing may do cannot be distinguished from growth: it is followed, slowly, "
            "up to the limit of the offset, and may leave more error than dual has. Step: what the failure changes "
            "within 1 s.",
        )
        page.table(
            [
                "when",
                "failure",
                "step [deg]",
                "in 10 s [deg]",
                "crossings of the gap",
                "mean VIGV error since [deg]",
                "of dual [deg]",
            ],
            [[f.during, f.failure, f.step, f.departure, f.crossings, f.mean_abs, f.mean_abs_dual] for f, _ in failures],
        )
        page.plot(
            overlay(
                [
                    Panel(
                        "offset in use [deg]",
                        [Line("healthy", adaptive.t, adaptive.offset, "muted", 2.4)]
                        + [
                            Line(f.failure, o.t, o.offset, _SHOWN[f.failure])
                            for f, o in failures
                            if f.failure in _SHOWN and f.during == failures[0][0].during
                        ],
                    )
                ]
            )
        )
    page.section("Goals", f"The best strategy, {best}, against the dual curves.")
    page.table(["goal", "value", "limit", "held"], [[g["goal"], g["value"], g["limit"], g["held"]] for g in goals])
    return page.write(path)
