"""Page of a replayed engine run: one sentence, figures, then pictures from coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.figures import AGREES, SignalError
from vaneloop.base.signals import SIDES
from vaneloop.base.vanes import VANES
from vaneloop.pages.figures import Line, Panel, histogram, overlay
from vaneloop.pages.page import Page
from vaneloop.pages.run import ZOOM, Result, against_speed, axis_title, loops, signal_name, speed_lines
from vaneloop.pages.series import break_at_holes
from vaneloop.pages.style import Tone, capital, number

__all__ = ["replay_page"]

Array = NDArray[np.float64]

DETAIL = 40.0  # s around the worst moment: a whole rise or fall of the engine


def replay_page(result: Result, command: str = "", title: str | None = None, notes: Sequence[str] = ()) -> Page:
    """The page of one replay, with ``notes`` on what reading did to the log."""
    measured = [s for s in result.signals if s.reference == "measured"]
    schedule = [s for s in result.signals if s.reference == "schedule"]
    sentence, tone = _replay_verdict(result, measured, schedule)
    name = Path(result.log).name
    page = Page(
        title or f"Replay of {name}",
        sentence,
        tone=tone,
        subtitle="logged engine run against firmware and plant model",
        command=command,
        log=result.log,
        state_hash=result.state_hash,
    )
    _replay_tiles(page, result, measured, schedule)

    page.section(
        "All figures",
        "Error is simulated minus reference. The reference is either the signal as the log measured it, or, for vane "
        "angles, the angle that the schedule asks for at the measured rotor speed. The noise floor is the scatter of "
        "the sensor itself: a perfect model has an RMS error of 1 noise floor, so RMS/noise tells how much is "
        "left to explain.",
    )
    _figures_table(page, result.signals)

    page.section("The run", f"What the log asked of the controller: every curve below has this time axis. {ZOOM}")
    page.plot(_speed(result))

    if measured:
        page.section(
            "Signal by signal",
            "Blue is measured, orange is the model. The error below each pair has a grey band three "
            "noise floors wide on each side of zero: an error inside it cannot be distinguished from sensor noise.",
        )
        worst_first = sorted(measured, key=lambda s: -_ratio(s))
        for s in worst_first:
            if s.signal in result.model and s.signal in result.measured:
                page.plot(_against_measurement(result, s), _in_words(s))
        _worst_moment(page, result, worst_first[0])
        page.section(
            "Distribution of the errors",
            "Share of samples at each size of error. A hill on zero as narrow as the dotted curve is noise alone; a "
            "shifted hill is a bias, two hills are a hysteresis that the model has too wide or too narrow, a long tail "
            "is a disagreement in a few moments.",
        )
        for s in worst_first:
            if s.signal in result.model and s.signal in result.measured:
                page.plot(
                    histogram(
                        {"simulated − measured": _error(result, s.signal)[1]},
                        f"{signal_name(s.signal)}, error [{s.unit}]",
                        noise=s.noise_floor,
                    ),
                    half=True,
                )

    if "i_motor" in result.model:
        page.section("Motor current", "What the actuator's motor takes in the simulated run. It is not on the bus.")
        page.plot(overlay([Panel(axis_title("i_motor"), [Line("model", result.t, result.model["i_motor"])])]))
    if result.model.keys() >= {*SIDES}:
        page.section(
            "Both actuators",
            "Strokes as the LVDT of each actuator measures them, and how far A is ahead of B. The controller gets "
            "their mean. Unequal strokes twist the unison rings, and the pistons work against each other.",
        )
        strokes = [
            Line(name, result.t, result.model[side], role)
            for name, side, role in zip("AB", SIDES, ("model", "other"), strict=True)
        ]
        ahead = Line("A − B", result.t, result.model[SIDES[0]] - result.model[SIDES[1]], "error")
        page.plot(overlay([Panel("stroke [mm]", strokes), Panel("A − B [mm]", [ahead])]))
    vanes = [v for v in VANES if v in result.model]
    if vanes:
        _hysteresis_section(page, result, vanes)
    if any(v in result.target for v in vanes):
        page.section(
            "Vane angle against rotor speed",
            "The job of the whole system: at each speed the vanes shall stand where the schedule (green) says. "
            "Distance from the green curve is the error the compressor feels.",
        )
        for v in vanes:
            if v in result.target:
                page.plot(against_speed(result, v), half=len(vanes) > 1)
    page.notes(notes)
    return page


# ---------------------------------------------------------------- sentences and figures


def _replay_verdict(
    result: Result, measured: Sequence[SignalError], schedule: Sequence[SignalError]
) -> tuple[str, Tone]:
    """One sentence that a newcomer understands, and whether it is good news."""
    if measured:
        worst = max(measured, key=_ratio)
        ratio = _ratio(worst)
        what, size = signal_name(worst.signal), f"{number(worst.mean_abs)} {worst.unit} on average"
        at = _time_of_worst(result, worst.signal)
        peak = f"{number(worst.max_abs)} {worst.unit} at worst" + (
            f", at t = {number(at, 4)} s" if at is not None else ""
        )
        if ratio <= AGREES:
            text = (
                f"The model follows the log to within the sensors' noise: the largest disagreement, in {what}, is "
                f"{size} and {peak}."
            )
            return text, "good"
        times = (
            f"{number(ratio, 2)} times what sensor noise explains"
            if np.isfinite(ratio)
            else "and its sensor shows no noise"
        )
        return f"The largest disagreement is in {what}: {size} ({peak}), {times}.", "neutral" if ratio < 3 else "bad"
    if schedule:
        worst = max(schedule, key=lambda s: s.mean_abs)
        return (
            "The log holds no signal to hold the model against. Driven by its demand, the simulated vanes stay within "
            f"{number(worst.mean_abs)} deg of their schedules on average ({number(worst.max_abs)} deg at worst, "
            f"{signal_name(worst.signal)}).",
            "neutral",
        )
    return (
        "The log's demand was run through firmware and plant; it holds no signal to compare the result with.",
        "neutral",
    )


def _replay_tiles(page: Page, result: Result, measured: Sequence[SignalError], schedule: Sequence[SignalError]) -> None:
    for s in sorted(measured, key=lambda s: -_ratio(s))[:3]:
        note = (
            f"{number(_ratio(s), 2)} noise floors, " if s.noise_floor else ""
        ) + f"worst {number(s.max_abs)} {s.unit}"
        page.tile(f"{signal_name(s.signal)} against measurement, RMS", s.rms, s.unit, note)
    for s in [s for s in schedule if s.signal == "vigv"] or list(schedule)[:1]:
        page.tile(
            f"{signal_name(s.signal)} against schedule, mean", s.mean_abs, s.unit, f"worst {number(s.max_abs)} {s.unit}"
        )
    speed = result.simulated_s / result.wall_s if result.wall_s > 0 else None
    page.tile(
        "Length of the run",
        result.simulated_s,
        "s",
        f"computed in {number(result.wall_s)} s, {number(speed)} times real time",
    )


def _figures_table(page: Page, signals: Sequence[SignalError]) -> None:
    page.table(
        [
            "signal",
            "",
            "stage",
            "against",
            "unit",
            "RMS",
            "mean",
            "maximum",
            "mean, 99 to 100 %",
            "noise floor",
            "RMS/noise",
            "samples",
        ],
        [
            [
                s.signal,
                signal_name(s.signal),
                s.stage,
                s.reference,
                s.unit,
                s.rms,
                s.mean_abs,
                s.max_abs,
                s.mean_abs_99_100,
                s.noise_floor if s.noise_floor else None,
                _ratio(s) if s.noise_floor else None,
                s.samples,
            ]
            for s in sorted(signals, key=lambda s: (s.reference, -_ratio(s)))
        ],
        "Mean and maximum are of the absolute error; the column 99 to 100 % is its mean near the design point of the "
        "engine.",
    )


def _in_words(s: SignalError) -> str:
    text = (
        f"{capital(signal_name(s.signal))}: on average {number(s.mean_abs)} {s.unit} off, at worst "
        f"{number(s.max_abs)} {s.unit}"
    )
    if s.noise_floor:
        text += (
            f"; RMS {number(s.rms)} {s.unit} is {number(_ratio(s), 2)} times the noise floor of "
            f"{number(s.noise_floor)} {s.unit}"
        )
    return text + "."


def _ratio(s: SignalError) -> float:
    """RMS error in noise floors; infinite where the channel has no noise and the model an error."""
    if s.noise_floor > 0:
        return s.rms / s.noise_floor
    return np.inf if s.rms > 0 else 0.0


# ---------------------------------------------------------------- series


def _error(result: Result, signal: str) -> tuple[Array, Array]:
    """Simulated minus measured, at the measured samples; NaN outside the simulated run."""
    channel = result.measured[signal]
    return channel.t, _at(result, result.model[signal], channel.t) - channel.values


def _at(result: Result, values: Array, t: Array) -> Array:
    return np.interp(t, result.t, values, left=np.nan, right=np.nan)


def _error_lines(t: Array, e: Array) -> list[Line]:
    """The error and, on rasters that allow it, its mean over 1 s: what is left once noise is averaged out."""
    dt = float(np.median(np.diff(t))) if t.size > 1 else 0.0
    width = round(1.0 / dt) if dt > 0 else 0
    if width < 5 or t.size < 10 * width:
        return [Line("simulated − measured", t, e, "error", 1.1)]
    groups = e[: e.size // width * width].reshape(-1, width)
    when = t[: e.size // width * width].reshape(-1, width)
    whole = np.isfinite(groups).all(axis=1) & (np.ptp(when, axis=1) < 2.0)
    mean = np.where(whole, groups.mean(axis=1), np.nan)
    return [
        Line("simulated − measured", t, e, "error", 1.0, opacity=0.4),
        Line("its mean over 1 s", when.mean(axis=1), mean, "error", 1.7),
    ]


def _time_of_worst(result: Result, signal: str) -> float | None:
    if signal not in result.model or signal not in result.measured:
        return None
    t, e = _error(result, signal)
    return float(t[np.nanargmax(np.abs(e))]) if np.isfinite(e).any() else None


# ---------------------------------------------------------------- pictures


def _speed(result: Result) -> Any:
    panels = [Panel("rotor speed [%]", speed_lines(result))]
    stroke = []
    if "x_lvdt" in result.measured:
        stroke.append(Line("measured", result.measured["x_lvdt"].t, result.measured["x_lvdt"].values, "measured", 1.6))
    if "x_lvdt" in result.model:
        stroke.append(Line("simulated", result.t, result.model["x_lvdt"], "model", 1.2))
    if stroke:
        panels.append(Panel("stroke [mm]", stroke))
    return overlay(panels)


def _against_measurement(result: Result, s: SignalError) -> Any:
    channel = result.measured[s.signal]
    values = [
        Line("measured", channel.t, channel.values, "measured", 2.2),
        Line("simulated", result.t, result.model[s.signal], "model", 1.2),
    ]
    if s.signal in result.target:
        values.append(Line("schedule", result.t, result.target[s.signal], "target", 1.3, "dash", shown=False))
    t, e = _error(result, s.signal)
    return overlay(
        [
            Panel(axis_title(s.signal, s.unit), values, height=1.2),
            Panel(f"error [{s.unit}]", _error_lines(t, e), band=3 * s.noise_floor, height=0.75, zero=True),
        ]
    )


def _worst_moment(page: Page, result: Result, s: SignalError) -> None:
    """Every sample around the largest error of one signal, with the speed that went with it."""
    at = _time_of_worst(result, s.signal)
    if at is None:
        return
    start, end = at - 0.4 * DETAIL, at + 0.6 * DETAIL

    def part(line: Line) -> Line:
        t, y = np.asarray(line.x), np.asarray(line.y)
        use = (t >= start) & (t <= end)
        return Line(line.name, t[use], y[use], line.role, line.width, line.dash)

    channel = result.measured[s.signal]
    t, e = _error(result, s.signal)
    values = [
        Line("measured", channel.t, channel.values, "measured", 2.2),
        Line("simulated", result.t, result.model[s.signal], "model", 1.4),
    ]
    if s.signal in result.target:
        values.append(Line("schedule", result.t, result.target[s.signal], "target", 1.3, "dash"))
    panels = [
        Panel(axis_title(s.signal, s.unit), [part(v) for v in values], height=1.2),
        Panel(
            f"error [{s.unit}]",
            [part(Line("simulated − measured", t, e, "error"))],
            band=3 * s.noise_floor,
            height=0.8,
            zero=True,
        ),
        Panel("rotor speed [%]", [part(v) for v in speed_lines(result) if v.shown], height=0.8),
    ]
    page.section(
        "The worst moment",
        f"{capital(signal_name(s.signal))} around t = {number(at, 4)} s, where its error is greatest. What the rotor "
        "speed does just then is the first hint at the cause: an error that changes sign with the direction of motion "
        "is hysteresis or friction, one that appears only in motion is a lag, one that stays is a bias.",
    )
    page.plot(overlay(panels))


def _hysteresis_section(page: Page, result: Result, vanes: Sequence[str]) -> None:
    """Loops of vane angle against stroke, measured and simulated."""
    pictures = []
    for v in vanes:
        paths = []
        if v in result.measured and "x_lvdt" in result.measured:
            x, c = result.measured["x_lvdt"], result.measured[v]
            t, angle = break_at_holes(c.t, c.values)
            paths.append(("measured", np.interp(t, x.t, x.values, left=np.nan, right=np.nan), angle, "measured"))
        if "x_lvdt" in result.model:
            paths.append(("simulated", result.model["x_lvdt"], result.model[v], "model"))
        if paths:
            pictures.append((v, paths))
    if not pictures:
        return
    compare = (
        " If the measured (blue) and the simulated (orange) loop differ in width, height or tilt, the linkage "
        "model misses something."
    )
    page.section(
        "Hysteresis between stroke and vane angle",
        "The joints between actuator and vane have clearance, so the vane stands elsewhere after extending than after "
        "retracting. Left: the angle itself. Right: the same with the mean curve taken off, so that the width of the "
        "loop and its shape can be read." + (compare if any(len(paths) > 1 for _, paths in pictures) else ""),
    )
    for v, paths in pictures:
        loops(page, v, paths)
