"""The page of a comparison, a location or a diagnosis: the verdict in one sentence, then the pictures behind it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vaneloop.base.signals import heading
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.regimes import Located, locate
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.settings import MOST_REPEATS, SHAPE_TOLD
from vaneloop.identification.subsystem import Bound, Stage
from vaneloop.identification.user_models.by_log import ByLog
from vaneloop.identification.workflow import Diagnosis
from vaneloop.pages.by_log import curves_by_log, log_by_log
from vaneloop.pages.decisions import explain
from vaneloop.pages.failures import failure_map, worst_cell
from vaneloop.pages.figures import UNDER, Line, Panel, loop, overlay, ranking, waterfall
from vaneloop.pages.page import Page
from vaneloop.pages.story import (
    CANNOT,
    EXPLAINED,
    MISSING,
    added,
    doubt,
    extended_sentence,
    fall,
    falling,
    floors,
    jumps,
    reached,
    since,
    stage_tone,
    untold,
    word,
    word_of_located,
    worths,
)
from vaneloop.pages.style import TONE_OF, Tone, capital, interval, number

__all__ = [
    "APART",
    "compare_page",
    "diagnosis_page",
    "errors_apart",
    "experiment_page",
    "experiment_panels",
    "experiment_rows",
    "extended_page",
    "located_sentence",
    "located_tone",
    "verdict_sentence",
]  # fmt: skip

APART = "On the part that nothing was fitted to"


def verdict_sentence(d: Diagnosis, by_log: ByLog | None = None) -> str:
    """The answer in one sentence; of a user's own model with what is left."""
    parts = []
    if by_log is not None:
        left, name = by_log.sentence(), by_log.d.stage
        if d.verdict == "none":
            return f"Nothing is missing that the library could add to {name}; {left}."
    for s in d.stages:
        if s.verdict == "missing":
            names = [f"{f.effect}" + (f" (or {', '.join(f.rivals)})" if f.rivals else "") for f in s.effects]
            parts.append(f"the {s.stage} subsystem lacks {' and '.join(names)} {since(s)}".rstrip())
        elif s.verdict == "unknown":
            first = [x for x in d.shapes.get(s.stage, []) if x.explained >= SHAPE_TOLD]
            what = f": {first[0].text}" if first else ""
            parts.append(f"the {s.stage} subsystem lacks something that the library does not have{what}")
    if not parts:
        silent = untold(d.not_observed)
        which = "observed " if silent else ""
        return f"Nothing is missing: every {which}subsystem fits its measurements down to the noise floor.{silent}"
    text = "; ".join([*parts, by_log.sentence()] if by_log is not None else parts)
    return f"{capital(text)}.{untold(d.not_observed)}"


def located_sentence(
    located: Sequence[Located], not_observed: Iterable[str] = (), at_times: Sequence[object] = ()
) -> str:
    """What all stages say together, in one sentence; in a second one those of which the log says nothing.

    at_times  when a stage fails though the part of a very long log that was fitted does not, in words
    """
    failing = [x for x in located if x.fails]
    silent = untold(not_observed)
    if not failing and at_times:
        more = f" So it is in {len(at_times) - 1} stretches more." if len(at_times) > 1 else ""
        return f"Most of the log fits its measurements, but the {at_times[0]}.{more}{silent}"
    if not failing:
        which = "observed " if silent else ""
        return f"Every {which}subsystem fits its measurements to within the noise.{silent}"
    worst = max(failing, key=lambda x: x.worst.ratio)
    s = worst.worst
    if s.agrees:  # no more than noise over the whole log
        where = "; ".join(f"the {x.stage} subsystem fails at {x.hot[0].worst()}" for x in failing)
        return f"Over the whole log every subsystem fits its measurements, but {where}.{silent}"
    others = [x.stage for x in failing if x is not worst]
    also = f" {' and '.join(others)} {'fail' if len(others) > 1 else 'fails'} too." if others else ""
    off = f"{s.signal} is off by {number(s.rms)} {s.unit} RMS, {floors(s.ratio)} times its noise floor"
    return f"The model fails most in the {worst.stage} subsystem: {off}.{also}{silent}"


def located_tone(located: Sequence[Located]) -> Tone:
    """Whether that is good news, of the stages that the log tells of."""
    failing = [x.worst.ratio for x in located if x.fails]
    return "good" if not failing else "bad" if max(failing) > 2.0 else "neutral"


def _stage(bound: Bound, name: str) -> Stage:
    return next(s for s in bound.stages if s.name == name)


def compare_page(
    located: Sequence[Located],
    bound: Bound,
    command: str,
    log: str,
    by_log: ByLog | None = None,
    tested: Sequence[Any] = (),
    title: str = "Model and log",
) -> Page:
    """The page of ``vaneloop compare`` or ``locate``: error by stage, curves, and where it fails."""
    page = Page(
        f"{title}: {Path(log).name}",
        located_sentence(located, bound.not_observed),
        tone=located_tone(located),
        command=command,
        log=log,
    )
    for x in located:
        w = x.worst
        note = f"{number(w.rms)} {w.unit}; noise floor {number(w.noise_floor)}"
        page.tile(
            f"{x.stage}: {w.signal}",
            floors(w.ratio),
            "noise floors",
            f"{word_of_located(x)}; {note}",
            located_tone([x]),
        )
    page.section(
        "By subsystem",
        "Each subsystem is driven by its own logged inputs, so an error of one cannot be hidden by another, as in "
        "closed loop. Nominal parameters are refitted within their tolerances; beside it the error with the parameters "
        "as given.",
    )
    rows: list[list[object]] = [
        [x.stage, word_of_located(x), f.signal, f.rms, f.noise_floor, f.ratio, f.rms_as_given, f.unit,
        f.samples]
        for x in located for f in x.signals
    ]  # fmt: skip
    rows += [
        [name, f"{CANNOT}: {why}", "", None, None, None, None, "", None] for name, why in bound.not_observed.items()
    ]
    page.table(
        ["subsystem", "verdict", "signal", "RMS error", "noise floor", "ratio", "as given", "unit", "samples"], rows
    )
    _tested(page, tested)
    for x in located:
        page.text(f"{x.stage}: {x.verdict()}.")
        judge = LeastSquaresProblem(_stage(bound, x.stage), x.floor)
        drawn = _curves(page, judge, [("model", x.fit.theta, "error")], f"{x.stage}: measured and model")
        _failure_map(page, x, drawn)
    if by_log is not None:
        log_by_log(page, by_log)
        curves_by_log(page, by_log)
    page.notes(by_log.notes if by_log is not None else bound.notes)
    return page


def _tested(page: Page, rows: Sequence[Any]) -> None:
    """Errors on the part of the log that nothing was fitted to (`vaneloop.verbs.parts.Tested`)."""
    if rows:
        page.section(APART, "RMS error with the parameters of the fitted part.")
        page.table(*errors_apart(rows))


def errors_apart(rows: Sequence[Any]) -> tuple[list[str], list[list[Any]]]:
    """Columns and rows of `vaneloop.verbs.parts.Tested`."""
    columns = ["subsystem", "signal", "error before", "error after", "noise floor", "unit", "samples"]
    return columns, [[r.stage, r.signal, r.error_before, r.error_after, r.noise_floor, r.unit, r.samples] for r in rows]


def extended_page(
    d: Diagnosis,
    bound: Bound,
    command: str,
    log: str,
    refused: str = "",
    by_log: ByLog | None = None,
    tested: Sequence[Any] = (),
) -> Page:
    """The page of ``vaneloop extend``: the model with its effects, and the error that is left."""
    good = not refused and all(reached(s) for s in d.stages)
    sentence = " ".join([extended_sentence(d, refused), *([f"{capital(by_log.sentence())}."] if by_log else [])])
    page = Page(f"Extended model: {Path(log).name}", sentence, tone="good" if good else "bad", command=command, log=log)
    return _told(page, d, bound, None, by_log, tested, True)


def experiment_page(
    d: Diagnosis, bound: Bound, command: str, log: str, sentence: str, experiment: dict[str, Any] | None,
    by_log: ByLog | None = None,
) -> Page:  # fmt: skip
    """The page of ``vaneloop experiment``: what to measure next, and the diagnosis that asks for it."""
    page = Page(f"Next experiment: {Path(log).name}", sentence, command=command, log=log)
    return _told(page, d, bound, experiment, by_log, ())


def diagnosis_page(
    d: Diagnosis,
    bound: Bound,
    command: str,
    log: str,
    experiment: dict[str, Any] | None = None,
    by_log: ByLog | None = None,
    tested: Sequence[Any] = (),
) -> Page:
    """The page of ``vaneloop diagnose``."""
    title = f"What is missing: {Path(log).name}"
    page = Page(title, verdict_sentence(d, by_log), tone=TONE_OF[d.verdict], command=command, log=log)
    return _told(page, d, bound, experiment, by_log, tested)


def _told(
    page: Page,
    d: Diagnosis,
    bound: Bound,
    experiment: dict[str, Any] | None,
    by_log: ByLog | None,
    tested: Sequence[Any],
    extended: bool = False,
) -> Page:
    """Fill the page of a diagnosis, of an extended model or of the next experiment."""
    for s in d.stages:
        k, before, after = fall(s)
        moved = s.verdict != "none"
        note = f"{s.outputs[k]} " if len(s.outputs) > 1 else ""
        note += f"{number(s.error_before[k])}{f' to {number(s.error_after[k])}' if moved else ''} {s.units[k]}"
        note += f"; noise floor {number(s.floor[k])}"
        value = f"{before} → {after}" if moved else before
        said = word(s, extended)
        if said in (MISSING, EXPLAINED) and s.effects:
            names = ", ".join(f.effect for f in s.effects)
            said = f"{said}, with {names} added" if extended and said == MISSING else f"{said}: {names}"
        page.tile(
            f"{s.stage}: {f'its {len(s.outputs)} signals together' if len(s.outputs) > 1 else s.outputs[0]}",
            value,
            "noise floors",
            f"{said}; {note}",
            stage_tone(s, extended),
        )
    if experiment:
        _next(page, experiment)
    page.section(
        "Answer of each subsystem",
        "Each subsystem is judged on its own logged inputs. Errors are RMS on held-out data, to which the parameters "
        "were not fitted; a complete model is at its noise floor.",
    )
    rows: list[list[object]] = []
    for s in d.stages:
        for k in range(len(s.floor)):
            rows.append(
                [s.stage, word(s, extended), s.outputs[k], s.error_before[k], s.error_after[k], s.floor[k], s.units[k]]
            )
    rows += [[name, f"{CANNOT}: {why}", "", None, None, None, ""] for name, why in d.not_observed.items()]
    page.table(["subsystem", "verdict", "signal", "error before", "error after", "noise floor", "unit"], rows)
    _floors_anew(page, d, bound)
    _tested(page, tested)
    found = [(s, f) for s in d.stages for f in s.effects]
    if found:
        page.section(
            "Effects added" if extended else "Effects found",
            "Parameters with their 90 % intervals."
            + ("" if extended else " Rivals explain this log as well: another experiment must decide."),
        )
        rows = []
        for s, f in found:
            for name, p in f.parameters.items():
                row = [name, *interval(p["value"], p["low"], p["high"]), p["unit"]]
                sure = [] if extended else [f"{100 * f.probability:.0f} %"]
                rows.append([f.effect, s.stage, *sure, *row, *([] if extended else [doubt(f) or "none"])])
        columns = ["parameter", "value", "low", "high", "unit"]
        page.table(
            [
                "effect",
                "subsystem",
                *([] if extended else ["probability"]),
                *columns,
                *([] if extended else ["rivals"]),
            ],
            rows,
        )
    for s in d.stages:
        if s.effects and s.onset is not None:
            page.text(f"{capital(s.stage)}: {added(s)}, not before.")
    if by_log is not None:
        log_by_log(page, by_log)
        curves_by_log(page, by_log)
    for s in d.stages:
        if s.verdict == "none":
            continue
        _stage_story(page, s, bound, extended)
        for x in d.shapes.get(s.stage, []):
            page.text(f"{capital(x.text)}.")
            page.plot(
                loop(
                    [Line("what is left", x.x, x.y, "error", 2.0)],
                    heading(x.feature, x.x_unit),
                    heading(x.output, x.y_unit),
                )
            )
    recal = [r for s in d.stages for r in s.recalibrated]
    if recal:
        page.section("Recalibrated", "Nominal parameters that moved within their tolerance: not a missing effect.")
        page.table(
            ["parameter", "value", "low", "high", "unit"],
            [[r["parameter"], *interval(r["value"], r["low"], r["high"]), r["unit"]] for r in recal],
        )
    unseen = [[c.effect, s.stage, c.reason] for s in d.stages for c in s.candidates if c.reason]
    if unseen:
        page.section(
            "What this log cannot show",
            "These effects would have left no trace here, however large: their absence is not shown.",
        )
        page.table(["effect", "subsystem", "what would excite it"], unseen)
    explain(page, {s.stage: (s.decisions, s.final.effects) for s in d.stages})
    page.notes(d.notes)
    return page


def _next(page: Page, experiment: dict[str, Any]) -> None:
    page.section("The next experiment", str(experiment["text"]))
    if experiment["separates"]:
        page.plot(overlay(experiment_panels(experiment)))
    page.table(list(experiment["heads"].values()), experiment_rows(experiment), digits=4)


def experiment_panels(experiment: Mapping[str, Any]) -> list[Panel]:
    """What drives the run that is recommended."""
    return [
        Panel(heading(name, unit), [Line(name, experiment["t"], values, "target")])
        for name, (unit, values) in experiment["inputs"].items()
    ]


def experiment_rows(experiment: Mapping[str, Any]) -> list[list[Any]]:
    """The runs that were tried, the best first, a row each."""

    def cell(row: Mapping[str, Any], key: str) -> Any:
        if key == "repeats":
            return str(row[key] or f"over {MOST_REPEATS}")
        return "leaves its limits" if row[key] is None else row[key]

    return [[cell(row, key) for key in experiment["heads"]] for row in experiment["table"]]


def _floors_anew(page: Page, d: Diagnosis, bound: Bound) -> None:
    """Say where the noise floor is another than that of compare."""
    for s in d.stages:
        before = _stage(bound, s.stage).floor
        for k, output in enumerate(s.outputs):
            if before is not None and abs(s.floor[k] / before[k] - 1.0) > 0.02:
                page.text(
                    f"The noise floor of {output} is {number(s.floor[k])} {s.units[k]} here, and "
                    f"{number(before[k])} {s.units[k]} where nothing is added: it was measured again on the errors of "
                    f"the best model."
                )


def _stage_story(page: Page, s: StageDiagnosis, bound: Bound, extended: bool) -> None:
    stage = _stage(bound, s.stage)
    judge = LeastSquaresProblem(stage, s.floor)
    page.section(f"The {s.stage} subsystem", f"Verdict: {word(s, extended)}.{_correlated(s.correlation)}")
    page.plot(
        waterfall(falling(s), "held-out error [noise floors]", floor=1.0, told=floors),
        "How the error falls as effects are added, down to the noise floor. All outputs of the subsystem together.",
    )
    if worth := worths(s):
        page.plot(
            ranking(
                [w.effect for w in worth], [w.without for w in worth], "error without it [noise floors]",
                highlight=[w.effect for w in worth],
                log=True, marks={"with all": s.excess, "nominal": s.steps[0][1]},
            ),
            "What each effect is worth in the final model: the error that comes back without it, the others "
            "refitted.",
        )  # fmt: skip
    curves = [("nominal model", s.base.theta, "error")]
    if s.final.effects:
        curves.append(("with " + " + ".join(s.final.effects), s.final.theta, "model"))
    drawn = _curves(page, judge, curves, f"{s.stage}: error before and after")
    _failure_map(page, locate(judge, s.base), drawn, "before" if s.final.effects else "")
    known = [c for c in s.candidates if np.isfinite(c.left)]
    chosen = [f.effect for f in s.effects]
    best = sorted((c for c in known if c.nats > 0), key=lambda c: c.left)[:12]
    top = [*best, *(c for c in known if c.effect in chosen and c not in best)]
    if top:
        nominal = s.steps[0][1]
        page.plot(
            ranking(
                [c.effect for c in top], [c.left for c in top], "error with it alone [noise floors]", highlight=chosen,
                log=True, marks={"nominal": nominal},
            ),
            f"Each effect alone, added to the nominal model ({floors(nominal)} noise floors): the error that is left. "
            f"Short bars help. Effects found are orange; one that helps only beside another has a long bar.",
        )  # fmt: skip


def _curves(page: Page, judge: LeastSquaresProblem, models: list[tuple[str, np.ndarray, str]], caption: str) -> int:
    """Draw what was measured under what each model says, and the errors; return the number of the plot."""
    stage = judge.stage
    e = judge.errors(np.array([m[1] for m in models])) * judge.floor[None, :, None]
    panels = []
    for k, output in enumerate(stage.outputs):
        y = np.where(judge.valid[k], stage.measured[k], np.nan)
        curves, lines = [Line("measured", stage.t, y, "measured", UNDER)], []
        for i, (name, _, role) in enumerate(models):
            error = np.where(judge.valid[k], e[i, k], np.nan)
            curves.append(Line(name, stage.t, y - error, role, 1.0))
            lines.append(Line(name, stage.t, error, role, 1.0))
        panels.append(Panel(f"{output} [{stage.units[k]}]", curves, height=1.0))
        panels.append(Panel(f"error [{stage.units[k]}]", lines, band=3.0 * float(judge.floor[k]), height=1.0))
    page.plot(
        overlay(panels),
        f"{caption}. The error is measured minus model; the grey band is three noise floors to each side."
        f"{jumps(stage.window)}",
    )
    return len(page.figures) - 1


def _correlated(factor: float) -> str:
    """How the noise limits what the log can tell, where it does."""
    if factor < 1.05:
        return ""
    return f" Neighbouring errors are alike, so {factor:.1f} samples tell as much as one of white noise."


def _failure_map(page: Page, located: Located, drawn: int, when: str = "") -> None:
    """Draw where a stage fails; ``drawn``: the plot of its curves, which a click on a cell moves to the moment."""
    if located.onset is not None:
        page.text(f"The error of the {located.stage} subsystem begins at t = {located.onset:.0f} s.")
    for output in dict.fromkeys(r.output for r in located.hot):
        mine = [r for r in located.hot if r.output == output]
        (k, b), figure = worst_cell(mine), failure_map(mine)
        figure["layout"]["meta"] |= {"shows": drawn}
        said = f" {when} anything was added" if when else ""
        page.plot(
            figure,
            f"Where the {located.stage} subsystem fails{said}: error of {output} in noise floors. "
            f"Worst: {mine[k].told(b)}. A click on a cell shows its moment in the curves above.",
        )
