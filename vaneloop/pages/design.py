"""The page of the servo loop's design: checks, open loop, steps, limit cycles."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np

from vaneloop.design.limit_cycles import play_describing_function
from vaneloop.design.servo_design import MIDDLE, DesignResult
from vaneloop.pages.figures import Line, Panel, loop, overlay
from vaneloop.pages.page import Page

__all__ = ["design_page"]


def design_page(result: DesignResult, path: str | Path) -> Path:
    """Write a self-contained HTML page: checks, open loop, Nyquist with the disk, steps, ramp, limit cycles."""
    g, m, c = result.gains, result.nominal, result.curves
    missed = [k.name for k in result.checks if not k.ok]
    verdict = "All stated limits hold." if result.ok else "Not met: " + "; ".join(missed) + "."
    tone: Literal["good", "bad"] = "good" if result.ok else "bad"
    page = Page("Design of the servo loop", verdict, tone=tone, subtitle="vaneloop design", command="vaneloop design")
    for label, value, unit, note in (
        ("crossover", m.crossover_hz, "Hz", "nominal plant"),
        ("gain margin", result.worst["gain_margin_db"], "dB", f"worst corner; nominal {m.gain_margin_db:.1f}"),
        ("phase margin", result.worst["phase_margin_deg"], "deg", f"worst corner; nominal {m.phase_margin_deg:.1f}"),
        ("disk margin", result.worst["disk_margin"], "", f"worst corner; nominal {m.disk_margin:.2f}"),
    ):
        page.tile(label, value, unit, note)

    page.section("Stated limits", f"Gains: kp {g.kp:g} mA/mm, ki {g.ki:g} mA/(mm s), kff {g.kff:g} mA/(mm/s).")
    page.table(
        ["figure", "value", "limit", "unit", "holds", "where"],
        [[k.name, k.value, k.limit, k.unit, "yes" if k.ok else "no", k.at] for k in result.checks],
    )

    page.section(
        "Open loop",
        "Loop gain and phase, with the loop sampled as the firmware closes it and as a continuous loop with half a "
        "tick of delay. They agree far beyond crossover, so the tick of 1 ms costs half a millisecond and nothing "
        "else.",
    )
    hz = c["omega"] / (2.0 * math.pi)
    phase = [np.degrees(np.unwrap(np.angle(c[k]))) for k in ("sampled", "continuous")]
    phase = [p - 360.0 * round((p[0] + 180.0) / 360.0) for p in phase]
    show = np.abs(c["sampled"]) > 1e-3
    bode = overlay(
        [
            Panel(
                "gain [dB]",
                [
                    Line("sampled", hz[show], 20.0 * np.log10(np.abs(c["sampled"][show])), "model"),
                    Line(
                        "continuous", hz[show], 20.0 * np.log10(np.abs(c["continuous"][show])), "measured", dash="dot"
                    ),
                ],
                marks={"0 dB": 0.0},
            ),
            Panel(
                "phase [deg]",
                [
                    Line("sampled", hz[show], phase[0][show], "model"),
                    Line("continuous", hz[show], phase[1][show], "measured", dash="dot"),
                ],
                marks={"-180 deg": -180.0},
            ),
        ],
        "frequency [Hz]",
    )
    bode["layout"]["xaxis"]["type"] = "log"
    page.plot(bode)

    page.section(
        "Nyquist curve and disk",
        "The loop stays outside the disk. Inside it lie all points that some gain and phase error of the disk margin's "
        "size would carry to -1.",
    )
    near = (np.abs(c["sampled"]) < 4.0) & (np.abs(c["sampled"]) > 1e-3)
    turn = np.linspace(0.0, 2.0 * math.pi, 200)
    lines = [Line("L(j omega)", c["sampled"][near].real, c["sampled"][near].imag, "model")]
    a = m.disk_margin
    if a > 0.0:
        left, right = -(2.0 + a) / (2.0 - a) if a < 2.0 else -10.0, -(2.0 - a) / (2.0 + a)
        middle, radius = 0.5 * (left + right), 0.5 * (right - left)
        lines.append(Line(f"disk margin {a:.2f}", middle + radius * np.cos(turn), radius * np.sin(turn), "error"))
    lines.append(Line("unit circle", np.cos(turn), np.sin(turn), "muted", dash="dot"))
    nyquist = loop(lines, "real part", "imaginary part", height=560)
    nyquist["layout"]["xaxis"] |= {"range": [-3.5, 1.5]}
    nyquist["layout"]["yaxis"] |= {"range": [-2.5, 2.5], "scaleanchor": "x"}
    page.plot(nyquist)
    if not result.step:
        page.text("A corner is unstable, so no time response is shown.")
        return page.write(path)

    page.section(
        "Steps and ramp",
        "A bare step of 10 mm saturates the valve; the firmware draws it as a ramp of 100 mm/s, which does not.",
    )
    bare, drawn, ramp = c["step_bare"], c["step_drawn"], c["ramp"]
    show_t = bare.t < 0.5
    page.plot(
        overlay(
            [
                Panel(
                    "stroke [mm]",
                    [
                        Line("demand, bare step", bare.t[show_t], 1e3 * bare.x_dem[show_t], "target", dash="dot"),
                        Line("piston, bare step", bare.t[show_t], 1e3 * bare.x[show_t], "measured"),
                        Line("demand, 100 mm/s", drawn.t[show_t], 1e3 * drawn.x_dem[show_t], "muted", dash="dot"),
                        Line("piston, 100 mm/s", drawn.t[show_t], 1e3 * drawn.x[show_t], "model"),
                    ],
                ),
                Panel(
                    "current [mA]",
                    [
                        Line("piston, bare step", bare.t[show_t], 1e3 * bare.i[show_t], "measured"),
                        Line("piston, 100 mm/s", drawn.t[show_t], 1e3 * drawn.i[show_t], "model"),
                    ],
                ),
            ]
        ),
        half=True,
    )
    page.plot(
        overlay(
            [
                Panel(
                    "stroke [mm]",
                    [Line("demand", ramp.t, 1e3 * ramp.x_dem, "target"), Line("piston", ramp.t, 1e3 * ramp.x, "model")],
                ),
                Panel(
                    "error at the LVDT [mm]",
                    [Line("error", ramp.t, 1e3 * (ramp.x_dem - ramp.x_lvdt), "error")],
                    zero=True,
                ),
            ]
        ),
        half=True,
    )
    step = overlay(
        [Panel("x_lvdt / x_dem", [Line("linear step", c["step_t"], c["step_linear"], "model")], marks={"1": 1.0})]
    )
    page.plot(step, "Linear closed loop, no feed-forward, no limit.")

    page.section(
        "Limit cycles by backlash",
        "With an integral in the controller any backlash inside the loop sustains a slow oscillation: the loop must "
        "cross the curve -1/N(A). Its size is about half the gap and it grows with ki/kp. Backlash between piston and "
        "vanes is not seen by the LVDT and is not in the loop: nothing to cross, no oscillation, only lost motion.\n\n"
        "The describing function takes the motion before the backlash for a sine. Where the piston hardly leaves its "
        "gap (grazing), it is not: the amplitude holds within some 10 %, the frequency within some 50 %. The column "
        "'with harmonics' solves the same balance with all odd harmonics and has no such error.",
    )
    page.table(
        [
            "where",
            "gap",
            "unit",
            "predicted",
            "Hz",
            "with harmonics",
            "Hz",
            "simulated",
            "Hz",
            "predicted with ki = 0",
            "grazing",
        ],
        [
            [
                {"lvdt": "piston to LVDT", "valve": "valve", "vanes": "piston to vanes"}[p.site],
                p.gap,
                p.unit,
                p.predicted_amplitude,
                p.predicted_hz,
                p.harmonic_amplitude,
                p.harmonic_hz,
                p.simulated_amplitude,
                p.simulated_hz,
                p.without_integral,
                "yes" if p.grazing else "no",
            ]
            for p in result.play
        ],
        "Amplitudes of the fundamental before the backlash.",
    )
    amplitude = 0.5 + np.geomspace(0.02, 30.0, 300)
    inverse = -1.0 / play_describing_function(amplitude, 1.0)
    curve = c["sampled"]
    wide = (np.abs(curve) < 60.0) & (np.abs(curve) > 1e-3)
    diagram = loop(
        [
            Line(
                "loop", np.degrees(np.angle(curve[wide])) % 360.0 - 360.0, 20.0 * np.log10(np.abs(curve[wide])), "model"
            ),
            Line("-1/N(A)", np.degrees(np.angle(inverse)) % 360.0 - 360.0, 20.0 * np.log10(np.abs(inverse)), "error"),
        ],
        "phase [deg]",
        "gain [dB]",
    )
    diagram["layout"]["xaxis"] |= {"range": [-270.0, -80.0]}
    diagram["layout"]["yaxis"] |= {"range": [-30.0, 35.0]}
    page.plot(diagram, "Loop and -1/N(A), for any gap: the crossing is the limit cycle.", half=True)
    for site, run in c["play"].items():
        last = run.t <= 1.5 if site == "vanes" else run.t >= run.t[-1] - 3.0
        lines = [Line("piston", run.t[last], 1e3 * (run.x[last] - MIDDLE), "model")]
        if site == "vanes":
            lines.append(Line("vanes, as stroke", run.t[last], 1e3 * (run.x_vane[last] - MIDDLE), "measured"))
        else:
            lines.append(Line("LVDT", run.t[last], 1e3 * (run.x_lvdt[last] - MIDDLE), "measured"))
        where = {
            "lvdt": "Backlash between piston and LVDT.",
            "valve": "Hysteresis in the valve.",
            "vanes": "Backlash between piston and vanes, after a reversal.",
        }[site]
        page.plot(overlay([Panel("stroke about mid-stroke [mm]", lines)], height=440), where, half=True)
    return page.write(path)
