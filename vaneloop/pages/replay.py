"""Pages of a replayed engine run and of the engine test: one sentence, figures, then pictures from coarse to fine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hil.figures import AGREES, SignalError, noise_floor
from vaneloop.pages.page import Line, Page, Panel, Tone, bars, break_at_holes, histogram, loop, number, overlay

__all__ = ["PAPER_TABLE_5", "engine_test_report", "replay_report"]

Array = NDArray[np.float64]


class Channel(Protocol):
    """Logged samples: time in s, values in the border unit."""

    @property
    def t(self) -> Array: ...
    @property
    def values(self) -> Array: ...


class Result(Protocol):
    """What a page needs of a `hil.replay.ReplayResult`."""

    @property
    def log(self) -> str: ...
    @property
    def simulated_s(self) -> float: ...
    @property
    def wall_s(self) -> float: ...
    @property
    def state_hash(self) -> str: ...
    @property
    def signals(self) -> Sequence[SignalError]: ...
    @property
    def t(self) -> Array: ...
    @property
    def model(self) -> Mapping[str, Array]: ...
    @property
    def target(self) -> Mapping[str, Array]: ...
    @property
    def measured(self) -> Mapping[str, Any]: ...


PAPER_TABLE_5 = {
    "max_abs": 2.17,
    "mean_abs": 0.55,
    "mean_abs_99_100": 0.47,
    "hysteresis": 1.6,
}  # deg, VIGV; Kim & Ki 2020

NAMES = {
    "n_dem": ("rotor speed demand", "%"),
    "n_r": ("rotor speed", "%"),
    "x_dem": ("stroke demand", "mm"),
    "x_lvdt": ("stroke", "mm"),
    "i_cmd": ("valve current", "mA"),
    "p_s": ("supply pressure", "MPa"),
    "t_oil": ("oil temperature", "degC"),
    "vigv": ("VIGV angle", "deg"),
    "vgv1": ("VGV1 angle", "deg"),
    "vgv2": ("VGV2 angle", "deg"),
    "state": ("controller mode", ""),
}
DETAIL = 40.0  # s around the worst moment: a whole rise or fall of the engine
VANES = ("vigv", "vgv1", "vgv2")
ZOOM = "Drag across a plot to zoom, double-click to return; click a name in the legend to hide its curve."


def replay_report(result: Result, path: str | Path, command: str = "", title: str | None = None) -> Path:
    """Write the page of one replay; return its path."""
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
        "the sensor itself: a perfect model has an RMS error of 1 noise floor, so the last column tells how much is "
        "left to explain.",
    )
    _figures_table(page, result.signals)

    page.section("The run", f"What the log asked of the controller: every curve below has this time axis. {ZOOM}")
    page.plot(_speed(result))

    if measured:
        page.section(
            "Signal by signal",
            "Blue is what was measured, orange what the model says. The error below each pair has a grey band three "
            "noise floors wide on each side of zero: what stays inside cannot be told from sensor noise.",
        )
        worst_first = sorted(measured, key=lambda s: -_ratio(s))
        for s in worst_first:
            if s.signal in result.model and s.signal in result.measured:
                page.plot(_against_measurement(result, s), _in_words(s))
        _worst_moment(page, result, worst_first[0])
        page.section(
            "How the errors are spread",
            "Share of samples at each size of error. A hill on zero as narrow as the dotted curve is noise alone; a "
            "shifted hill is a bias, two hills are a hysteresis that the model has too wide or too narrow, a long tail "
            "is a disagreement in a few moments.",
        )
        for s in worst_first:
            if s.signal in result.model and s.signal in result.measured:
                page.plot(
                    histogram(
                        {"simulated − measured": _error(result, s.signal)[1]},
                        f"{_name(s.signal)}, error [{s.unit}]",
                        noise=s.noise_floor,
                    ),
                    half=True,
                )

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
                page.plot(_against_speed(result, v), half=len(vanes) > 1)
    return page.write(path)


def engine_test_report(
    single: Result, dual: Result, paper: Mapping[str, float] | None, path: str | Path, command: str = ""
) -> Path:
    """Write the page of the engine test: one mean curve against two curves, beside the paper's Table 5; return its
    path.

    paper  max_abs, mean_abs, mean_abs_99_100 and hysteresis in deg; None: `PAPER_TABLE_5`
    """
    paper = PAPER_TABLE_5 | dict(paper or {})
    one, two = _vigv(single), _vigv(dual)
    gap_one, gap_two = _rise_fall_gap(single), _rise_fall_gap(dual)
    within = all(v is not None and v <= paper[k] for k, v in _three(two).items())
    page = Page(
        "Engine test: one schedule curve against two",
        f"With separate curves for rising and falling speed the VIGV stays within {number(two.mean_abs)} deg of its "
        f"target on average ({number(two.max_abs)} deg at worst); the published engine test had "
        f"{number(paper['mean_abs'])} and {number(paper['max_abs'])} deg. With a single mean curve it is "
        f"{number(one.mean_abs)} deg: the linkage's hysteresis stays in.",
        tone="good" if within else "bad",
        subtitle="VIGV, closed loop of firmware and plant",
        command=command,
        log=dual.log,
        state_hash=f"single {single.state_hash}, dual {dual.state_hash}",
    )
    tiles = {
        "mean_abs": "Mean error, two curves",
        "max_abs": "Maximum error, two curves",
        "mean_abs_99_100": "Mean error, 99 to 100 % speed",
    }
    for key, label in tiles.items():
        value = _three(two)[key]
        note = f"paper {number(paper[key])}, one curve {number(_three(one)[key])}"
        page.tile(label, value, "deg", note, _tone(value, paper[key]))
    note = f"mean over speed; one curve {number(gap_one)}, linkage alone {number(paper['hysteresis'])}"
    page.tile("Gap between rise and fall", gap_two, "deg", note)
    page.tile(
        "Length of the test", dual.simulated_s, "s", f"{two.samples:,} samples, computed in {number(dual.wall_s)} s"
    )

    page.section(
        "Against the published engine test",
        "Three figures of the VIGV's error against the schedule's target at the measured speed, as in Table 5 of Kim & "
        "Ki 2020. Lower is better. The hysteresis of the linkage itself, from its clearances, is "
        f"{paper['hysteresis']:g} deg between rise and fall.",
    )
    labels = ["maximum", "mean", "mean, 99 to 100 % speed"]
    keys = list(_three(two))
    page.plot(
        bars(
            labels,
            {
                "one mean curve": [_three(one)[k] for k in keys],
                "two curves": [_three(two)[k] for k in keys],
                "paper, two curves": [paper[k] for k in keys],
            },
            "VIGV error [deg]",
            roles={"one mean curve": "model", "two curves": "measured", "paper, two curves": "muted"},
            marks={"hysteresis of the linkage": paper["hysteresis"]},
        )
    )
    page.table(
        ["VIGV error [deg]", "one mean curve", "two curves", "paper, two curves", "two curves at or below the paper"],
        [
            [label, _three(one)[k], _three(two)[k], paper[k], (v := _three(two)[k]) is not None and v <= paper[k]]
            for label, k in zip(labels, keys, strict=True)
        ]
        + [["gap between rise and fall at the same speed", gap_one, gap_two, None, "not published"]],
    )

    page.section(
        "Where the hysteresis goes",
        "Mean error at each rotor speed, separately while the speed rises (solid) and while it falls (dashed). With "
        "one curve the two lie on opposite sides of zero, half the hysteresis each: a compromise for both directions. "
        "With two curves they close up. Dips stand where the run often turns back: there the clearance is just being "
        "crossed.",
    )
    lines = []
    for name, run, role in (("one curve", single, "model"), ("two curves", dual, "measured")):
        speed, rise, fall = _rise_and_fall(run)
        lines += [
            Line(f"{name}, rising", speed, rise, role, 2.4),
            Line(f"{name}, falling", speed, fall, role, 2.4, "dash"),
        ]
    page.plot(overlay([Panel("mean VIGV error [deg]", lines, zero=True, height=1.35)], "rotor speed [%]"))

    page.section(
        "VIGV angle against rotor speed",
        "The whole run, all rises and falls on top of each other; green is the schedule's target. The paper shows this "
        "picture as its figure 14.",
    )
    page.plot(_against_speed(single, "vigv", "one mean curve", "model"), "One mean curve.", half=True)
    page.plot(_against_speed(dual, "vigv", "two curves", "measured"), "Two curves.", half=True)

    page.section("Error over the run", f"VIGV angle minus its target, and the rotor speed that caused it. {ZOOM}")
    both = [_error_line(single, "one curve", "model"), _error_line(dual, "two curves", "measured")]
    page.plot(
        overlay([Panel("VIGV error [deg]", both, zero=True, height=1.3), Panel("rotor speed [%]", _speed_lines(dual))])
    )

    page.section(
        "How the errors are spread",
        "Share of the samples at each size of error: one curve leaves two hills, one for each direction.",
    )
    page.plot(
        histogram(
            {"one curve": _schedule_error(single), "two curves": _schedule_error(dual)},
            "VIGV error [deg]",
            roles={"one curve": "model", "two curves": "measured"},
        )
    )

    page.section(
        "The linkage's own hysteresis",
        "VIGV angle against stroke. The loop is a property of the joints' clearances and the same under both "
        "schedules: the controller cannot take it out, it can only aim at the right side of it. On the right the mean "
        "curve is taken off, so that the width can be read.",
    )
    runs = [("one curve", single, "model"), ("two curves", dual, "measured")]
    paths = [(n, r.model["x_lvdt"], r.model["vigv"], role) for n, r, role in runs if "x_lvdt" in r.model]
    _loops(page, "vigv", paths)
    return page.write(path)


# ---------------------------------------------------------------- sentences and figures


def _replay_verdict(
    result: Result, measured: Sequence[SignalError], schedule: Sequence[SignalError]
) -> tuple[str, Tone]:
    """One sentence that a newcomer understands, and whether it is good news."""
    if measured:
        worst = max(measured, key=_ratio)
        ratio = _ratio(worst)
        what, size = _name(worst.signal), f"{number(worst.mean_abs)} {worst.unit} on average"
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
            f"{_name(worst.signal)}).",
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
        page.tile(f"{_name(s.signal)} against measurement, RMS", s.rms, s.unit, note)
    for s in [s for s in schedule if s.signal == "vigv"] or list(schedule)[:1]:
        page.tile(
            f"{_name(s.signal)} against schedule, mean", s.mean_abs, s.unit, f"worst {number(s.max_abs)} {s.unit}"
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
                _name(s.signal),
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
        f"{_capital(_name(s.signal))}: on average {number(s.mean_abs)} {s.unit} off, at worst {number(s.max_abs)} "
        f"{s.unit}"
    )
    if s.noise_floor:
        text += (
            f"; RMS {number(s.rms)} {s.unit} is {number(_ratio(s), 2)} times the noise floor of "
            f"{number(s.noise_floor)} {s.unit}"
        )
    return text + "."


def _name(signal: str) -> str:
    return NAMES.get(signal, (signal, ""))[0]


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _axis(signal: str, unit: str | None = None) -> str:
    name, own = NAMES.get(signal, (signal, unit or ""))
    return f"{name} [{unit or own}]" if unit or own else name


def _ratio(s: SignalError) -> float:
    """RMS error in noise floors; infinite where the channel has no noise and the model an error."""
    if s.noise_floor > 0:
        return s.rms / s.noise_floor
    return np.inf if s.rms > 0 else 0.0


def _three(s: SignalError) -> dict[str, float | None]:
    return {"max_abs": s.max_abs, "mean_abs": s.mean_abs, "mean_abs_99_100": s.mean_abs_99_100}


def _tone(value: float | None, limit: float) -> Tone:
    return "good" if value is not None and value <= limit else "bad"


def _vigv(result: Result) -> SignalError:
    """VIGV against the schedule."""
    found = [s for s in result.signals if s.signal == "vigv"]
    if not found:
        raise ValueError("the engine test holds no figures for 'vigv'; its result must have them")
    return next((s for s in found if s.reference == "schedule"), found[0])


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


def _schedule_error(result: Result) -> Array:
    return np.asarray(result.model["vigv"]) - np.asarray(result.target["vigv"])


def _error_line(result: Result, name: str, role: str) -> Line:
    return Line(name, result.t, _schedule_error(result), role, 1.1)


def _rotor_speed(result: Result) -> Array:
    """Rotor speed on the result's raster: measured where the log has it, as the schedule's target is."""
    if "n_r" in result.measured:
        c = result.measured["n_r"]
        return np.interp(result.t, c.t, c.values)
    return np.asarray(result.model["n_r"], dtype=float)


def _rise_and_fall(result: Result) -> tuple[Array, Array, Array]:
    """Mean VIGV error in bands of rotor speed while it rises and while it falls by more than 0.3 %/s."""
    n, e = _rotor_speed(result), _schedule_error(result)
    dt = float(np.median(np.diff(result.t)))
    half = max(1, round(0.5 / dt))
    rate = np.zeros(n.size)
    if n.size > 2 * half:
        rate[half:-half] = (n[2 * half :] - n[: -2 * half]) / (2 * half * dt)
    edges = np.linspace(np.nanmin(n), np.nanmax(n) + 1e-9, 31)
    where = np.clip(np.digitize(n, edges) - 1, 0, 29)
    out = []
    for moving in (rate > 0.3, rate < -0.3):
        use = moving & np.isfinite(e)
        count = np.bincount(where[use], minlength=30)
        total = np.bincount(where[use], weights=e[use], minlength=30)
        out.append(np.where(count >= 20, total / np.maximum(count, 1), np.nan))
    return 0.5 * (edges[1:] + edges[:-1]), out[0], out[1]


def _rise_fall_gap(result: Result) -> float | None:
    """Mean distance in deg between the VIGV's errors of rising and of falling speed at the same speed."""
    _, rise, fall = _rise_and_fall(result)
    gap = np.abs(rise - fall)
    return float(np.nanmean(gap)) if np.isfinite(gap).any() else None


# ---------------------------------------------------------------- pictures


def _speed_lines(result: Result) -> list[Line]:
    lines = []
    if "n_dem" in result.measured:
        lines.append(Line("demanded", result.measured["n_dem"].t, result.measured["n_dem"].values, "target", 1.6))
    if "n_r" in result.measured:
        lines.append(Line("measured", result.measured["n_r"].t, result.measured["n_r"].values, "measured", 1.6))
    if "n_r" in result.model:
        lines.append(Line("simulated", result.t, result.model["n_r"], "model", 1.2, shown="n_r" not in result.measured))
    return lines


def _speed(result: Result) -> Any:
    panels = [Panel("rotor speed [%]", _speed_lines(result))]
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
            Panel(_axis(s.signal, s.unit), values, height=1.2),
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
        Panel(_axis(s.signal, s.unit), [part(v) for v in values], height=1.2),
        Panel(
            f"error [{s.unit}]",
            [part(Line("simulated − measured", t, e, "error"))],
            band=3 * s.noise_floor,
            height=0.8,
            zero=True,
        ),
        Panel("rotor speed [%]", [part(v) for v in _speed_lines(result) if v.shown], height=0.8),
    ]
    page.section(
        "The worst moment",
        f"{_capital(_name(s.signal))} around t = {number(at, 4)} s, where its error is greatest. What the rotor speed "
        "does just then is the first hint at the cause: an error that changes sign with the direction of motion is "
        "hysteresis or friction, one that appears only in motion is a lag, one that stays is a bias.",
    )
    page.plot(overlay(panels))


def _against_speed(result: Result, vane: str, name: str = "simulated", role: str = "model") -> Any:
    speed = _rotor_speed(result)
    lines = []
    if vane in result.measured:
        t, angle = break_at_holes(result.measured[vane].t, result.measured[vane].values)
        lines.append(Line("measured", np.interp(t, result.t, speed, left=np.nan, right=np.nan), angle, "measured", 1.2))
    lines.append(Line(name, speed, result.model[vane], role, 1.2))
    n, target = speed, np.asarray(result.target[vane], dtype=float)
    good = np.isfinite(n) & np.isfinite(target)
    n, target = n[good], target[good]
    if n.size:  # the schedule is a function of speed: mean in narrow bands of speed draws it once
        edges = np.linspace(n.min(), n.max() + 1e-9, 201)
        where = np.digitize(n, edges) - 1
        count = np.bincount(where, minlength=200)[:200]
        visited = count > 0
        mean_n, mean_target = (
            np.bincount(where, weights=a, minlength=200)[:200][visited] / count[visited] for a in (n, target)
        )
        lines.append(Line("schedule", mean_n, mean_target, "target", 2.6))
    return loop(lines, "rotor speed [%]", _axis(vane))


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
        _loops(page, v, paths)


def _loops(page: Page, vane: str, paths: Sequence[tuple[str, Array, Array, str]]) -> None:
    """Angle against stroke, and the same less one common smooth curve."""
    lines, flat = [], []
    mean = None
    for name, x, y, role in paths:
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        good = np.isfinite(x) & np.isfinite(y)
        if good.sum() < 20:
            continue
        if mean is None:
            mean = _middle_curve(x[good], y[good])
        lines.append(Line(name, x, y, role, 1.3))
        if mean is not None:
            flat.append(Line(name, x, y - mean(x), role, 1.0))
    if lines:
        page.plot(loop(lines, "stroke [mm]", _axis(vane)), half=bool(flat))
    if flat:
        page.plot(loop(flat, "stroke [mm]", f"{_name(vane)} less mean curve [deg]"), half=True)


def _middle_curve(x: Array, y: Array) -> Any:
    """Smooth curve midway between the two sides of the loop, or None where the stroke hardly moves."""
    if np.ptp(x) < 10 * noise_floor(np.arange(x.size, dtype=float), x) or np.ptp(x) <= 0:
        return None
    line = np.polynomial.Polynomial.fit(x, y, 1)
    edges = np.linspace(x.min(), x.max() + 1e-9, 41)
    where = np.digitize(x, edges) - 1
    order = np.argsort(where, kind="stable")
    sides = []
    for group in np.split(order, np.flatnonzero(np.diff(where[order])) + 1):
        low, high = np.quantile(y[group] - line(x[group]), [0.02, 0.98])
        sides.append((float(np.mean(x[group])), float(low), float(high)))
    at, low_side, high_side = np.array(sides).T
    width = high_side - low_side
    open_loop = width >= 0.6 * np.quantile(width, 0.95)  # elsewhere, as at the ends, only one side was visited
    if open_loop.mean() < 0.6:  # too little of both sides for a curve
        return line
    degree = min(3, int(open_loop.sum()) - 1)
    if degree < 1:
        return line
    return (
        line.convert()
        + np.polynomial.Polynomial.fit(at[open_loop], 0.5 * (low_side + high_side)[open_loop], degree).convert()
    )
