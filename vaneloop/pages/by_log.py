"""What an answer on several logs has beyond that on one: each log's error, which law helps where, each log's curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hil.logs.formats import suffixes
from vaneloop.identification.settings import NO_HELP
from vaneloop.identification.user_models.by_log import ByLog
from vaneloop.pages.figures import UNDER, Line, Panel, bars, loop, overlay
from vaneloop.pages.page import Page
from vaneloop.pages.style import interval

__all__ = ["curves_by_log", "errors_by_log", "heads", "log_by_log", "short_names"]

OTHER_SUFFIXES = (".json", ".mat", ".txt")  # of runs that a program of the user's own has read
SHOWN = 6  # logs whose curves are drawn


def short_names(names: Sequence[str], width: int = 28) -> dict[str, str]:
    """File names as they fit into tables and axes: their ends, without the suffix, where that keeps them apart."""
    ends = (*suffixes(), *OTHER_SUFFIXES)
    stems = {n: Path(n).stem if Path(n).suffix.lower() in ends else n for n in names}
    cut = {n: s if len(s) <= width else "…" + s[1 - width :] for n, s in stems.items()}
    return next((d for d in (cut, stems) if len(set(d.values())) == len(names)), {n: n for n in names})


def heads(by_log: ByLog) -> list[str]:
    """What each step added."""
    return ["model", *(f"+ {step.split(' + ')[-1]}" for step in list(by_log.steps)[1:])]


def errors_by_log(by_log: ByLog) -> tuple[list[str], list[list[Any]]]:
    """Columns and rows: the RMS error of each log, after each step."""
    d = by_log.d
    short = short_names(list(next(iter(by_log.steps.values()))))
    rows = [[short.get(log, log), what, d.outputs[k], *errors, d.units[k]] for log, what, k, errors, _ in by_log.rows()]
    return ["log", "fitted or test", "signal", *heads(by_log), "unit"], rows


def log_by_log(page: Page, by_log: ByLog) -> None:
    """Errors of every log after every step, which law helps where, and the model's own parameters."""
    fitted = by_log.logs.fitted
    logs = list(next(iter(by_log.steps.values())))
    short = short_names(logs)
    page.section(
        "Log by log",
        "RMS error of the model as it was given, then with each law added, every step refitted to the fitted logs "
        "alone. A law that only imitates what is missing degrades some validation log.",
    )
    page.table(*errors_by_log(by_log))
    if by_log.ablation:
        names = list(by_log.ablation)
        page.section(
            "Which law helps where",
            "Error with the law over error without it; 1: no change, above 1: it degrades that log.",
        )
        page.table(["law", *(short[x] for x in logs)], [[n, *(by_log.ablation[n][x] for x in logs)] for n in names])
        page.plot(
            bars(
                [short[x] for x in logs],
                {n: [by_log.ablation[n][x] for x in logs] for n in names},
                "error with the law / without",
                marks={"no help": 1.0},
            ),
            "Short bars help.",
        )
        for n in names:
            if idle := [x for x in logs if by_log.ablation[n][x] > NO_HELP]:
                page.text(f"{n} hardly helps, or degrades, {', '.join(short[x] for x in idle)}.")
    if fitted.stage.parameters:
        page.section("Parameters of the model")
        page.table(
            ["parameter", "value", "low", "high", "unit"],
            [[p["parameter"], *interval(p["value"], p["low"], p["high"]), p["unit"]] for p in by_log.parameters()],
        )


def curves_by_log(page: Page, by_log: ByLog) -> None:
    """Measured and modelled signals on every log; for a force model, force over displacement too."""
    d = by_log.d
    looks = not d.final.effects
    page.section("Measured and modelled")
    for bound in (by_log.logs.fitted, by_log.logs.test):
        if bound is None:
            continue
        thetas = [d.base.theta, d.final.theta]
        if bound is not by_log.logs.fitted:
            thetas = [bound.theta_from(by_log.logs.fitted, v) for v in thetas]
        y = bound.run(np.array(thetas))
        if bound.data.cutoff:  # at the ends of a log that is differentiated nothing is compared
            y = np.where(np.isfinite(bound.measured), y, np.nan)
        for name, at in list(bound.logs.items())[:SHOWN]:
            panels = []
            t = bound.t[at] - bound.t[at][0]
            for i, output in enumerate(d.outputs):
                m = bound.measured[i, at]
                lines = [Line("measured", t, m, "measured", UNDER), Line("as given", t, y[0, i, at], "error", 1.0)]
                errors = [Line("as given", t, m - y[0, i, at], "error", 1.0)]
                if not looks:
                    lines.append(Line("with the laws", t, y[1, i, at], "model", 1.0))
                    errors.append(Line("with the laws", t, m - y[1, i, at], "model"))
                panels += [Panel(f"{output} [{d.units[i]}]", lines, height=1.2), Panel(f"error [{d.units[i]}]", errors)]
            page.plot(overlay(panels), f"{name} ({'fitted' if bound is by_log.logs.fitted else 'test'}).")
            if bound.system.kind == "force" and d.outputs:
                x, m = np.concatenate(bound.u, axis=1)[0, at], bound.measured[0, at]
                lines = [Line("measured", x, m, "measured", UNDER), Line("as given", x, y[0, 0, at], "error", 1.0)]
                if not looks:
                    lines.append(Line("with the laws", x, y[1, 0, at], "model", 1.0))
                over = f"displacement [{bound.system.units.get('position', 'm')}]"
                page.plot(loop(lines, over, f"{d.outputs[0]} [{d.units[0]}]"), f"{name}: force over displacement.")
