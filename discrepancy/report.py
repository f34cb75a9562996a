"""The page of a comparison, a location or a diagnosis: the verdict in one sentence, then the pictures behind it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from discrepancy.adapter import Chain
from discrepancy.diagnose import StageDiagnosis
from discrepancy.fit import Judge
from discrepancy.locate import Regime, bins_of, onset, regimes
from discrepancy.workflow import Diagnosis, StageFigures, floor_of
from hil.page import Line, Page, Panel, heat, loop, number, overlay, ranking, waterfall

__all__ = ["compare_report", "diagnosis_report", "verdict_sentence"]


def verdict_sentence(d: Diagnosis) -> str:
    """The answer in one sentence."""
    parts = []
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
    text = "; ".join(parts)
    return text[0].upper() + text[1:] + "."


def compare_report(figures: Sequence[StageFigures], chain: Chain, path: str | Path, command: str, log: str) -> Path:
    """Write the page of ``vaneloop compare`` or ``locate``: error by stage, curves, and where it fails."""
    worst = max(figures, key=lambda f: f.rms / f.noise_floor)
    ratio = worst.rms / worst.noise_floor
    verdict = (
        f"The model fails most in the {worst.stage} stage: {worst.signal} is off by {number(worst.rms)} {worst.unit} RMS, "
        f"{ratio:.1f} times its noise floor."
        if ratio > 1.1
        else "Every stage agrees with its measurements to within the noise."
    )
    page = Page(
        f"Stages of {Path(log).name}", verdict, tone="bad" if ratio > 2 else "good" if ratio < 1.1 else "neutral", command=command, log=log
    )
    page.section(
        "Stage by stage",
        "Each stage is driven by its own logged inputs, so one stage's error cannot hide behind another's, as it does in closed loop.",
    )
    rows = [[f.stage, f.signal, f.rms, f.noise_floor, f.rms / f.noise_floor, f.unit, f.samples] for f in figures]
    rows += [[name, "not observed: " + why, None, None, None, "", None] for name, why in chain.not_observed.items()]
    page.table(["stage", "signal", "RMS error", "noise floor", "ratio", "unit", "samples"], rows)
    for stage in chain.stages:
        judge = Judge(stage, floor_of(stage))
        theta = stage.neutral()
        _curves(page, judge, [("model", theta, "error")], f"{stage.name}: measured and model")
        from discrepancy.fit import Fit

        nothing = np.empty(0)
        fit = Fit((), theta, nothing.astype(int), nothing, nothing, nothing, nothing, nothing, nothing, nothing)
        _failure_map(page, regimes(judge, fit, 1.0), stage.name, onset(judge, fit))
    return page.write(path)


def diagnosis_report(
    d: Diagnosis, chain: Chain, path: str | Path, command: str, log: str, experiment: dict[str, object] | None = None
) -> Path:
    """Write the page of ``vaneloop diagnose`` or ``extend``."""
    tone = {"none": "good", "missing": "neutral", "unknown": "bad"}[d.verdict]
    page = Page(f"Diagnosis of {Path(log).name}", verdict_sentence(d), tone=tone, command=command, log=log)  # type: ignore[arg-type]
    for s in d.stages:
        k = int(np.argmax(s.error_before / s.floor))
        page.tile(
            f"{s.stage}: {s.outputs[k]}", f"{number(s.error_before[k])} to {number(s.error_after[k])}", s.units[k],
            f"noise floor {number(s.floor[k])}; {s.verdict}", "good" if s.verdict == "none" else "bad",
        )  # fmt: skip
    page.section(
        "What each stage says",
        "A stage is judged on its own logged inputs. Errors are RMS on data that the parameters were not fitted to; a complete model "
        "stands at its noise floor.",
    )
    rows: list[list[object]] = []
    for s in d.stages:
        for k in range(len(s.floor)):
            rows.append([s.stage, s.verdict, s.outputs[k], s.error_before[k], s.error_after[k], s.floor[k], s.units[k]])
    rows += [[name, "not observed: " + why, "", None, None, None, ""] for name, why in d.not_observed.items()]
    page.table(["stage", "verdict", "signal", "error before", "error after", "noise floor", "unit"], rows)
    found = [(s, f) for s in d.stages for f in s.effects]
    if found:
        page.section(
            "Effects found", "Parameters with their 90 % intervals. Rivals explain this log as well: another experiment must decide."
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
    for s in d.stages:
        if s.verdict == "none":
            continue
        _stage_story(page, s, chain)
        for x in d.shapes.get(s.stage, []):
            page.text(x.text[0].upper() + x.text[1:] + ".")
            page.plot(loop([Line("what is left", x.x, x.y, "error", 2.0)], f"{x.feature} [{x.x_unit}]", f"{x.output} [{x.y_unit}]"))
    recal = [r for s in d.stages for r in s.recalibrated]
    if recal:
        page.section("Recalibrated", "Nominal parameters that moved within their tolerance: not a missing effect.")
        page.table(
            ["parameter", "value", "low", "high", "unit"], [[r["parameter"], r["value"], r["low"], r["high"], r["unit"]] for r in recal]
        )
    if experiment:
        page.section("Next experiment", str(experiment["text"]))
        page.plot(overlay([Panel("rotor speed demand [%]", [Line("n_dem", experiment["t"], experiment["n_dem"], "target")])]))  # type: ignore[arg-type]
    unseen = [[c.effect, s.stage, c.reason] for s in d.stages for c in s.candidates if c.reason]
    if unseen:
        page.section("What this log cannot show", "These effects would have left no trace here, however large: their absence is not shown.")
        page.table(["effect", "stage", "what would excite it"], unseen)
    return page.write(path)


def _stage_story(page: Page, s: StageDiagnosis, chain: Chain) -> None:
    stage = chain.stage(s.stage)
    judge = Judge(stage, s.floor)
    page.section(f"The {s.stage} stage", f"Verdict: {s.verdict}. Noise is correlated by a factor of {s.correlation:.1f} in variance.")
    curves = [("nominal model", s.base.theta, "error")]
    if s.final.effects:
        curves.append(("with " + " + ".join(s.final.effects), s.final.theta, "model"))
    _curves(page, judge, curves, f"{s.stage}: error before and after")
    _failure_map(page, regimes(judge, s.base, s.correlation), s.stage, onset(judge, s.base))
    top = [c for c in s.candidates if c.nats > 0][:12]
    if top:
        chosen = [f.effect for f in s.effects]
        page.plot(
            ranking([c.effect for c in top], [c.nats for c in top], "gain on held-out data [nats]", highlight=chosen),
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
        lines = [Line(name, stage.t, np.where(judge.valid[k], e[i, k], np.nan), role, 1.0) for i, (name, _, role) in enumerate(models)]
        panels.append(Panel(f"error [{stage.units[k]}]", lines, band=3.0 * float(judge.floor[k]), height=1.0))
    page.plot(overlay(panels), caption + ". The grey band is three noise floors to each side.")


def _failure_map(page: Page, found: list[Regime], stage: str, start: float | None) -> None:
    if start is not None:
        page.text(f"The error of the {stage} stage begins at t = {start:.0f} s.")
    hot = [r for r in found if r.significant.any()]
    if not hot:
        return
    for output in dict.fromkeys(r.output for r in hot):
        mine = [r for r in hot if r.output == output]
        page.plot(
            heat(*bins_of(mine, lambda r: r.ratio), "noise floors", "from the lowest values to the highest", ""),
            f"Where the {stage} stage fails: error of {output} in noise floors. Worst: {mine[0].worst()}.",
        )
