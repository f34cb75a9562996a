"""The page of a user's own model: the verdict in one sentence, then the pictures behind it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vaneloop.discrepancy.locate import bins_of
from vaneloop.discrepancy.models.own_model import NO_HELP, Answer
from vaneloop.pages.figures import Line, Panel, bars, heat, loop, overlay, ranking, waterfall
from vaneloop.pages.page import Page
from vaneloop.pages.style import TONE_OF, Tone, number

__all__ = ["own_page", "short_names"]


def own_page(answer: Answer, command: str, log: str) -> Page:
    """The page of ``vaneloop compare|locate|diagnose|extend --system``."""
    d, b = answer.diagnosis, answer.bound
    looks = answer.verb in ("compare", "locate")
    k = int(np.argmax(d.error_before / d.floor))
    size = float(np.sqrt(np.nanmean(b.measured[k] ** 2)))
    sentence = (
        f"System {d.stage} misses {d.outputs[k]} by {number(d.error_before[k])} {d.units[k]} RMS, "
        f"{100 * d.error_before[k] / size:.2g} % of it."
        if looks
        else answer.sentence()
    )
    tone: Tone = "neutral" if looks else TONE_OF[d.verdict]
    title = f"{answer.verb.capitalize()}: {d.stage} on {Path(log).name}"
    page = Page(title, sentence, tone=tone, command=command, log=log)
    for i, name in enumerate(d.outputs):
        own = float(np.sqrt(np.nanmean(b.measured[i] ** 2))) or 1.0
        page.tile(
            name,
            f"{number(d.error_before[i])} to {number(d.error_after[i])}",
            d.units[i],
            f"{100 * d.error_after[i] / own:.3g} % of its RMS, held out",
        )
    if answer.elapsed_s:
        page.tile("logs", len(b.logs), "fitted", f"{len(answer.test.logs) if answer.test else 0} more to test")
    steps = list(answer.logs)
    page.section(
        "Log by log",
        "RMS error of the model as it was given, then with each law added, every step fitted anew to the fitted logs "
        "alone. A law that only imitates what is missing makes some test log worse.",
    )
    fitted = set(b.logs)
    short = short_names(list(answer.logs[steps[0]]))
    rows = []
    for name in answer.logs[steps[0]]:
        for i, output in enumerate(d.outputs):
            rows.append(
                [
                    short[name],
                    "fitted" if name in fitted else "test",
                    output,
                    *(float(answer.logs[s][name][i]) for s in steps),
                    d.units[i],
                ]
            )
    together = answer.together()
    for what, bound in (("fitted", b), ("test", answer.test)):
        if bound is not None and len(bound.logs) > 1:
            rows += [
                [f"all {len(bound.logs)} together", what, o, *(float(together[s][what][i]) for s in steps), d.units[i]]
                for i, o in enumerate(d.outputs)
            ]
    heads = ["model", *(f"+ {s.split(' + ')[-1]}" for s in steps[1:])]
    page.table(["log", "", "signal", *heads, "unit"], rows)
    if answer.ablation:
        names = list(answer.ablation)
        logs = list(answer.logs[steps[0]])
        page.section(
            "Which law helps where",
            "Error with the law over error without it; 1: it does nothing there, above 1: it does harm there.",
        )
        page.table(["law", *(short[x] for x in logs)], [[n, *(answer.ablation[n][x] for x in logs)] for n in names])
        page.plot(
            bars(
                [short[x] for x in logs],
                {n: [answer.ablation[n][x] for x in logs] for n in names},
                "error with the law / without",
                marks={"no help": 1.0},
            ),  # fmt: skip
            "Short bars help.",
        )
        for n in names:
            idle = [x for x in logs if answer.ablation[n][x] > NO_HELP]
            if idle:
                page.text(f"{n} hardly helps, or does harm, on {', '.join(short[x] for x in idle)}.")
    if d.effects:
        page.section(
            "Laws found",
            "Parameters with their 90 % intervals. Rivals do as well on the fitted logs: another experiment must "
            "decide.",
        )
        page.table(
            ["law", "wins", "parameter", "value", "low", "high", "unit", "rivals"],
            [
                [f.effect, f"{100 * f.probability:.0f} %", n, p["value"], p["low"], p["high"], p["unit"],
                ", ".join(f.rivals) or "none"]
                for f in d.effects for n, p in f.parameters.items()
            ],
        )  # fmt: skip
    if b.stage.parameters:
        page.section("Parameters of the model")
        page.table(
            ["parameter", "value", "low", "high", "unit"],
            [[p["parameter"], p["value"], p["low"], p["high"], p["unit"]] for p in answer.parameters()],
        )
    _pictures(page, answer)
    if not looks:
        page.plot(
            waterfall(
                [(n.split(" + ")[-1] if n != "model" else n, v * float(d.floor[0])) for n, v in d.steps],
                f"held-out error [{d.units[0]}]",
            )
            if len(d.outputs) == 1
            else waterfall([(n.split(" + ")[-1], v) for n, v in d.steps], "held-out error [noise of the samples]"),
            "How the held-out error falls as laws are added, in the order in which the search found them.",
        )
        top = [c for c in d.candidates if c.nats > 0.1][:12]
        if top:
            page.plot(
                ranking(
                    [c.effect for c in top],
                    [c.nats for c in top],
                    "fall of the held-out error [%]",
                    highlight=[f.effect for f in d.effects],
                ),
                "Laws tried alone on the model as it was given.",
            )
    _map(page, answer)
    for s in answer.shapes:
        page.section("What is left", s.text[0].upper() + s.text[1:] + ".")
        page.plot(
            loop(
                [Line("what is left", s.x, s.y, "error", 2.0)], f"{s.feature} [{s.x_unit}]", f"{s.output} [{s.y_unit}]"
            )
        )
    if answer.notes:
        page.section("Notes")
        for n in answer.notes:
            page.text(n[0].upper() + n[1:] + ".")
    return page


def short_names(names: Sequence[str], width: int = 28) -> dict[str, str]:
    """File names as they fit into tables and axes: their ends, without the suffix, where that keeps them apart."""
    stems = {
        n: Path(n).stem if Path(n).suffix.lower() in (".csv", ".json", ".mat", ".parquet", ".mf4", ".txt") else n
        for n in names
    }
    cut = {n: s if len(s) <= width else "…" + s[1 - width :] for n, s in stems.items()}
    return next((d for d in (cut, stems) if len(set(d.values())) == len(names)), {n: n for n in names})


def _pictures(page: Page, answer: Answer) -> None:
    """Measured and modelled signals on every log; for a force model, force over displacement too."""
    d = answer.diagnosis
    looks = not d.final.effects
    page.section("Measured and modelled")
    for bound in (answer.bound, answer.test):
        if bound is None:
            continue
        thetas = [answer.diagnosis.base.theta, d.final.theta]
        if bound is not answer.bound:
            thetas = [bound.theta_from(answer.bound, v) for v in thetas]
        y = bound.run(np.array(thetas))
        for name, at in list(bound.logs.items())[:6]:
            panels = []
            t = bound.t[at] - bound.t[at][0]
            for i, output in enumerate(d.outputs):
                m = bound.measured[i, at]
                lines = [Line("measured", t, m, "measured"), Line("as given", t, y[0, i, at], "error", 1.0)]
                errors = [Line("as given", t, m - y[0, i, at], "error", 1.0)]
                if not looks:
                    lines.append(Line("with the laws", t, y[1, i, at], "model"))
                    errors.append(Line("with the laws", t, m - y[1, i, at], "model"))
                panels += [Panel(f"{output} [{d.units[i]}]", lines, height=1.2), Panel(f"error [{d.units[i]}]", errors)]
            kind = "fitted" if bound is answer.bound else "test"
            page.plot(overlay(panels), f"{name} ({kind}).")
            if bound.system.kind == "force" and d.outputs:
                x = np.concatenate(bound.u, axis=1)[0, at]
                m = bound.measured[0, at]
                lines = [Line("measured", x, m, "measured", 1.0), Line("as given", x, y[0, 0, at], "error", 1.0)]
                if not looks:
                    lines.append(Line("with the laws", x, y[1, 0, at], "model", 1.0))
                page.plot(
                    loop(
                        lines,
                        f"displacement [{bound.system.units.get('position', 'm')}]",
                        f"{d.outputs[0]} [{d.units[0]}]",
                    ),
                    f"{name}: force over displacement.",
                )


def _map(page: Page, answer: Answer) -> None:
    hot = answer.located.hot
    if not hot:
        return
    page.section("Where the model as given fails")
    for output in dict.fromkeys(r.output for r in hot):
        mine = [r for r in hot if r.output == output]
        worst = mine[0]
        page.plot(
            heat(*bins_of(mine, lambda r: r.rms), worst.unit, "from the lowest values to the highest", ""),
            f"RMS error of {output}. Worst: {worst.worst()}.",
        )
