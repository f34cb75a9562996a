"""The page of a comparison, a location or a diagnosis: the verdict in one sentence, then the pictures behind it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vaneloop.discrepancy.fit import Judge
from vaneloop.discrepancy.locate import Located, bins_of, locate
from vaneloop.discrepancy.models.by_log import ByLog
from vaneloop.discrepancy.stage import Bound, Stage
from vaneloop.discrepancy.stage_answer import StageDiagnosis
from vaneloop.discrepancy.workflow import Diagnosis
from vaneloop.pages.by_log import curves_by_log, log_by_log
from vaneloop.pages.figures import Line, Panel, heat, loop, overlay, ranking, waterfall
from vaneloop.pages.page import Page
from vaneloop.pages.style import TONE_OF, number

__all__ = ["compare_page", "diagnosis_page", "located_sentence", "located_tone", "verdict_sentence"]


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
            parts.append(f"the {s.stage} stage lacks {' and '.join(names)}")
        elif s.verdict == "unknown":
            first = d.shapes.get(s.stage, [])
            what = f": {first[0].text}" if first else ""
            parts.append(f"the {s.stage} stage lacks something that the library does not have{what}")
    if not parts:
        return "Nothing is missing: every observed stage explains its measurements down to the noise floor."
    text = "; ".join([*parts, by_log.sentence()] if by_log is not None else parts)
    return text[0].upper() + text[1:] + "."


def located_sentence(located: Sequence[Located]) -> str:
    """What all stages say together, in one sentence."""
    failing = [x for x in located if x.fails]
    if not failing:
        return "Every stage agrees with its measurements to within the noise."
    worst = max(failing, key=lambda x: x.worst.ratio)
    s = worst.worst
    others = [x.stage for x in failing if x is not worst]
    also = f" {' and '.join(others)} {'fail' if len(others) > 1 else 'fails'} too." if others else ""
    off = f"{s.signal} is off by {number(s.rms)} {s.unit} RMS, {number(s.ratio)} times its noise floor"
    return f"The model fails most in the {worst.stage} stage: {off}.{also}"


def located_tone(located: Sequence[Located]) -> Literal["good", "neutral", "bad"]:
    """Whether that is good news."""
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
) -> Page:
    """The page of ``vaneloop compare`` or ``locate``: error by stage, curves, and where it fails."""
    page = Page(
        f"Stages of {Path(log).name}", located_sentence(located), tone=located_tone(located), command=command, log=log
    )
    page.section(
        "Stage by stage",
        "Each stage is driven by its own logged inputs, so one stage's error cannot hide behind another's, as it does "
        "in closed loop. Nominal parameters are refitted within their tolerances; beside it the error with the "
        "parameters as given.",
    )
    rows: list[list[object]] = [
        [x.stage, "fails" if x.fails else "agrees", f.signal, f.rms, f.noise_floor, f.ratio, f.rms_as_given, f.unit,
        f.samples]
        for x in located for f in x.signals
    ]  # fmt: skip
    rows += [
        [name, "not observed: " + why, "", None, None, None, None, "", None] for name, why in bound.not_observed.items()
    ]
    page.table(["stage", "verdict", "signal", "RMS error", "noise floor", "ratio", "as given", "unit", "samples"], rows)
    _tested(page, tested)
    for x in located:
        page.text(f"{x.stage}: {x.verdict()}.")
        judge = Judge(_stage(bound, x.stage), x.floor)
        _curves(page, judge, [("model", x.fit.theta, "error")], f"{x.stage}: measured and model")
        _failure_map(page, x)
    if by_log is not None:
        log_by_log(page, by_log)
        curves_by_log(page, by_log)
        _notes(page, by_log.notes)
    return page


def _tested(page: Page, rows: Sequence[Any]) -> None:
    """Errors on the part of the log that nothing was fitted to (`vaneloop.verbs.parts.Tested`)."""
    if rows:
        page.section("On the part that nothing was fitted to", "RMS error with the parameters of the fitted part.")
        columns = ["stage", "signal", "error before", "error after", "noise floor", "unit", "samples"]
        page.table(
            columns,
            [[r.stage, r.signal, r.error_before, r.error_after, r.noise_floor, r.unit, r.samples] for r in rows],
        )


def _notes(page: Page, notes: Sequence[str]) -> None:
    if notes:
        page.section("Notes")
        for n in notes:
            page.text(n[0].upper() + n[1:] + ".")


def diagnosis_page(
    d: Diagnosis,
    bound: Bound,
    command: str,
    log: str,
    experiment: dict[str, Any] | None = None,
    by_log: ByLog | None = None,
    tested: Sequence[Any] = (),
) -> Page:
    """The page of ``vaneloop diagnose`` or ``extend``."""
    title = f"Diagnosis of {Path(log).name}"
    page = Page(title, verdict_sentence(d, by_log), tone=TONE_OF[d.verdict], command=command, log=log)
    for s in d.stages:
        k = int(np.argmax(s.error_before / s.floor))
        page.tile(
            f"{s.stage}: {s.outputs[k]}", f"{number(s.error_before[k])} to {number(s.error_after[k])}", s.units[k],
            f"noise floor {number(s.floor[k])}; {s.verdict}", "good" if s.verdict == "none" else "bad",
        )  # fmt: skip
    page.section(
        "What each stage says",
        "A stage is judged on its own logged inputs. Errors are RMS on data that the parameters were not fitted to; a "
        "complete model stands at its noise floor.",
    )
    rows: list[list[object]] = []
    for s in d.stages:
        for k in range(len(s.floor)):
            rows.append([s.stage, s.verdict, s.outputs[k], s.error_before[k], s.error_after[k], s.floor[k], s.units[k]])
    rows += [[name, "not observed: " + why, "", None, None, None, ""] for name, why in d.not_observed.items()]
    page.table(["stage", "verdict", "signal", "error before", "error after", "noise floor", "unit"], rows)
    _tested(page, tested)
    found = [(s, f) for s in d.stages for f in s.effects]
    if found:
        page.section(
            "Effects found",
            "Parameters with their 90 % intervals. Rivals explain this log as well: another experiment must decide.",
        )
        rows = []
        for s, f in found:
            for name, p in f.parameters.items():
                rows.append(
                    [
                        f.effect,
                        s.stage,
                        f"{100 * f.probability:.0f} %",
                        name,
                        p["value"],
                        p["low"],
                        p["high"],
                        p["unit"],
                        ", ".join(f.rivals) or "none",
                    ]
                )
        page.table(["effect", "stage", "probability", "parameter", "value", "low", "high", "unit", "rivals"], rows)
    if by_log is not None:
        log_by_log(page, by_log)
        curves_by_log(page, by_log)
    for s in d.stages:
        if s.verdict == "none":
            continue
        _stage_story(page, s, bound)
        for x in d.shapes.get(s.stage, []):
            page.text(x.text[0].upper() + x.text[1:] + ".")
            page.plot(
                loop(
                    [Line("what is left", x.x, x.y, "error", 2.0)],
                    f"{x.feature} [{x.x_unit}]",
                    f"{x.output} [{x.y_unit}]",
                )
            )
    recal = [r for s in d.stages for r in s.recalibrated]
    if recal:
        page.section("Recalibrated", "Nominal parameters that moved within their tolerance: not a missing effect.")
        page.table(
            ["parameter", "value", "low", "high", "unit"],
            [[r["parameter"], r["value"], r["low"], r["high"], r["unit"]] for r in recal],
        )
    if experiment:
        page.section("Next experiment", str(experiment["text"]))
        page.plot(
            overlay([Panel("rotor speed demand [%]", [Line("n_dem", experiment["t"], experiment["n_dem"], "target")])])
        )
    unseen = [[c.effect, s.stage, c.reason] for s in d.stages for c in s.candidates if c.reason]
    if unseen:
        page.section(
            "What this log cannot show",
            "These effects would have left no trace here, however large: their absence is not shown.",
        )
        page.table(["effect", "stage", "what would excite it"], unseen)
    _notes(page, d.notes)
    return page


def _stage_story(page: Page, s: StageDiagnosis, bound: Bound) -> None:
    stage = _stage(bound, s.stage)
    judge = Judge(stage, s.floor)
    page.section(
        f"The {s.stage} stage",
        f"Verdict: {s.verdict}. Noise is correlated by a factor of {s.correlation:.1f} in variance.",
    )
    curves = [("nominal model", s.base.theta, "error")]
    if s.final.effects:
        curves.append(("with " + " + ".join(s.final.effects), s.final.theta, "model"))
    _curves(page, judge, curves, f"{s.stage}: error before and after")
    _failure_map(page, locate(judge, s.base))
    top = [c for c in s.candidates if c.nats > 0][:12]
    if top:
        chosen = [f.effect for f in s.effects]
        page.plot(
            ranking([c.effect for c in top], [c.nats for c in top], s.gain, highlight=chosen),
            "Effects tried alone, by what they gain on data that they were not fitted to.",
        )
    page.plot(
        waterfall([*s.steps, ("noise floor", 1.0)], "held-out error [noise floors]", floor=1.0),
        "How the error falls as effects are added, down to the noise floor.",
    )


def _curves(page: Page, judge: Judge, models: list[tuple[str, np.ndarray, str]], caption: str) -> None:
    stage = judge.stage
    e = judge.errors(np.array([m[1] for m in models])) * judge.floor[None, :, None]
    panels = []
    for k, output in enumerate(stage.outputs):
        y = np.where(judge.valid[k], stage.measured[k], np.nan)
        panels.append(Panel(f"{output} [{stage.units[k]}]", [Line("measured", stage.t, y, "measured")], height=1.0))
        lines = [
            Line(name, stage.t, np.where(judge.valid[k], e[i, k], np.nan), role, 1.0)
            for i, (name, _, role) in enumerate(models)
        ]
        panels.append(Panel(f"error [{stage.units[k]}]", lines, band=3.0 * float(judge.floor[k]), height=1.0))
    page.plot(overlay(panels), caption + ". The grey band is three noise floors to each side.")


def _failure_map(page: Page, located: Located) -> None:
    if located.onset is not None:
        page.text(f"The error of the {located.stage} stage begins at t = {located.onset:.0f} s.")
    for output in dict.fromkeys(r.output for r in located.hot):
        mine = [r for r in located.hot if r.output == output]
        page.plot(
            heat(*bins_of(mine, lambda r: r.ratio), "noise floors", "from the lowest values to the highest", ""),
            f"Where the {located.stage} stage fails: error of {output} in noise floors. Worst: {mine[0].worst()}.",
        )
