"""The page of a fleet: engines by effects, what changes in which engine, who is unlike its sisters, what logs could not
show; and the short page of one log, to which it leads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from vaneloop.pages.figures import Figure, Line, Panel, heat, overlay
from vaneloop.pages.page import Link, Page
from vaneloop.pages.story import verdict_word
from vaneloop.pages.style import interval

__all__ = ["FleetView", "Series", "fleet_page", "log_page"]

SHOWN = 12  # trends drawn
ROWS = 200  # of a table
EFFECTS = 24  # columns of the heat map
YEAR = 365.25 * 86400.0  # s


@dataclass(frozen=True)
class Series:
    """One quantity of one engine over time.

    t, y, s    s since 1970; value; standard deviation that the log gives
    keys       the log of each
    told       whether the log tells the value; if not, only that it is near neutral, within s
    neutral    value where nothing is amiss; tolerance: half-width about it, None: there is none
    kind       "effect" (its size) or "nominal" (a parameter as recalibrated)
    trend      `vaneloop.fleet.trends.Trend` and its limit, times in s since 1970
    curve      the trend as a line
    """

    engine: str
    quantity: str
    unit: str
    t: np.ndarray
    y: np.ndarray
    s: np.ndarray
    keys: list[str]
    told: np.ndarray
    neutral: float
    tolerance: float | None
    kind: str
    trend: dict[str, Any] = field(default_factory=dict)
    curve: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def changes(self) -> bool:
        """Whether it has changed."""
        return self.trend.get("kind") in ("growth", "step")

    def first(self) -> str:
        """The first log after its onset, of a quantity that has changed."""
        return self.keys[int(np.searchsorted(self.t, self.trend["onset"]).clip(0, len(self.t) - 1))]

    def json(self) -> dict[str, Any]:
        """A row of the table ``trends``."""
        numbers = {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in self.trend.items()}
        return {"engine": self.engine, "quantity": self.quantity, "unit": self.unit, "of": self.kind, **numbers}


@dataclass(frozen=True)
class FleetView:
    """What a fleet's logs say together.

    statuses  what came of the logs: status -> logs
    verdicts  engine -> verdict -> logs
    lacks     a row an engine and effect: named in how many of the logs that could show it, and whether that is enough
    span      first and last time, s since 1970
    damaged   what of the run's folder cannot be used: name, reason
    """

    name: str
    engines: list[str]
    statuses: dict[str, int]
    verdicts: dict[str, dict[str, int]]
    lacks: list[dict[str, Any]]
    series: list[Series]
    outliers: list[dict[str, Any]]
    coverage: list[dict[str, Any]]
    refused: list[dict[str, Any]]
    span: tuple[float | None, float | None]
    damaged: dict[str, str] = field(default_factory=dict)

    @property
    def changed(self) -> list[Series]:
        """Quantities that have changed, the surest first."""
        return sorted((s for s in self.series if s.changes), key=lambda s: (s.trend["p"], s.engine, s.quantity))

    @property
    def lacking(self) -> list[dict[str, Any]]:
        """Engines and the effects that they lack."""
        return [r for r in self.lacks if r["lacks"]]

    @property
    def found(self) -> bool:
        """Whether an engine lacks something, changes, or is unlike its sisters."""
        return bool(self.lacking or self.changed or self.outliers)

    def sentence(self) -> str:
        """The answer in one sentence."""
        if not any(self.verdicts.values()):
            return "No log of the fleet could be diagnosed."
        lack, change = {r["engine"] for r in self.lacking}, {s.engine for s in self.changed}
        odd = {r["engine"] for r in self.outliers}
        n = len(self.engines)
        return (
            f"Of {n} engines {len(lack)} {'lacks' if len(lack) == 1 else 'lack'} an effect in the model, {len(change)} "
            f"{'changes' if len(change) == 1 else 'change'} over time, {len(odd)} {'is' if len(odd) == 1 else 'are'} "
            f"unlike {'its' if len(odd) == 1 else 'their'} fleet peers."
        )

    def keys(self) -> list[str]:
        """Logs that the page leads to."""
        return sorted({*(r["key"] for r in self.lacking), *(s.first() for s in self.changed[:ROWS])})

    def json(self) -> dict[str, Any]:
        """The answer as plain data."""
        return {
            "schema": 1, "run": self.name, "engines": self.engines, "logs": self.statuses, "lacks": self.lacking,
            "trends": [s.json() for s in self.changed], "outliers": self.outliers, "coverage": self.coverage,
            "damaged": self.damaged,
        }  # fmt: skip


def day(seconds: float | None) -> str:
    """A time as a date."""
    if seconds is None or not np.isfinite(seconds):
        return "–"
    try:
        return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d")
    except (OverflowError, OSError, ValueError):  # which of them depends on how far it is
        return "later than any date"


def fleet_page(view: FleetView, command: str = "", logs: str = "") -> Page:
    """The page of a fleet. ``logs``: folder of the pages of logs, from this page; "": there are none."""
    tone = "good" if view.verdicts and not view.found else "neutral" if view.verdicts else "bad"
    page = Page("Fleet", view.sentence(), tone=tone, subtitle="fleet", command=command, log=view.name)  # type: ignore[arg-type]
    page.tile("engines", len(view.engines))
    page.tile("logs", sum(view.statuses.values()), note=f"{day(view.span[0])} to {day(view.span[1])}")
    page.tile("diagnosed", view.statuses.get("done", 0))
    page.tile("engines that lack an effect", len({r["engine"] for r in view.lacking}))
    page.tile("trends", len(view.changed), note="quantities that have changed")
    page.tile("unlike their fleet peers", len({r["engine"] for r in view.outliers}))
    _lacks(page, view, logs)
    _trends(page, view, logs)
    _outliers(page, view)
    _coverage(page, view)
    if view.refused:
        page.section("Logs without an answer", "They are rows, not the end of a run.")
        rows = [[r["engine"], r["path"], r["status"], r["reason"]] for r in view.refused]
        _table(page, ["engine", "log", "what came of it", "reason"], rows)
    if view.damaged:
        page.section("Damaged parts of the run", "Their results are not in this report.")
        _table(page, ["part", "reason"], list(view.damaged.items()))
    return page


def _table(page: Page, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """A table of a bounded length."""
    page.table(columns, rows[:ROWS])
    if len(rows) > ROWS:
        page.text(f"{len(rows) - ROWS:,} more rows are in the tables (--tables-out).")


def _lacks(page: Page, view: FleetView, logs: str) -> None:
    page.section(
        "Engines and effects",
        "Share of an engine's logs in which an effect was named, of those that could show it. An engine is said to "
        "lack an effect where that is more often than false names explain.",
    )
    names = sorted(
        {r["effect"] for r in view.lacks}, key=lambda e: -sum(r["named"] for r in view.lacks if r["effect"] == e)
    )
    names = names[:EFFECTS]
    if names:
        share: Mapping[tuple[str, str], float] = {(r["engine"], r["effect"]): r["share"] for r in view.lacks}
        rows = [e for e in view.engines if any((e, n) in share for n in names)]
        page.plot(heat([[share.get((e, n)) for n in names] for e in rows], names, rows, "share of logs"))
    rows_ = [
        [r["engine"], r["effect"], r["stage"], r["named"], r["able"], r["probability"], day(r["first"]), day(r["last"]),
         _to(r["key"], logs)]
        for r in view.lacking
    ]  # fmt: skip
    if rows_:
        columns = ["engine", "effect", "subsystem", "named in", "of logs", "mean probability", "first", "last", "log"]
        _table(page, columns, rows_)


def _trends(page: Page, view: FleetView, logs: str) -> None:
    page.section(
        "What changes",
        "Sizes of effects and nominal parameters over time, with 90 % intervals. Growth is a straight rise from its "
        "onset on; a step is a sudden change, as of a part that was exchanged. A limit is that of --limits, or the end "
        "of a nominal parameter's tolerance.",
    )
    rows = []
    for s in view.changed:
        x, step = s.trend, s.trend["kind"] == "step"
        when = day(x["limit_time"]) if x["limit_time"] else "–"
        if x["limit_time"]:
            when += f" ({day(x['limit_low'])} to {day(x['limit_high']) if x['limit_high'] else 'no latest time'})"
        rate, low, high = interval(x["rate"], x["rate_low"], x["rate_high"])
        numbers = f"{rate} ({low} to {high})"
        change = f"{numbers} {s.unit}{'' if step else '/year'}"
        rows.append([
            s.engine, s.quantity, x["kind"], f"{day(x['onset'])} ({day(x['onset_low'])} to {day(x['onset_high'])})",
            change, f"{x['now']:.4g} {s.unit}", when, x["limit_why"] or "–", _to(s.first(), logs),
        ])  # fmt: skip
    if rows:
        columns = ["engine", "quantity", "change", "since", "rate or height", "now", "limit reached", "remark", "log"]
        _table(page, columns, rows)
    else:
        page.text("None.")
    for s in view.changed[:SHOWN]:
        page.plot(_drawn(s), f"{s.engine}: {s.quantity}", half=True)


def _drawn(s: Series) -> Figure:
    """A quantity over time: the logs, each with its interval, and the trend."""
    zero = float(s.t[0])
    lines = [Line("logs", (s.t - zero) / YEAR, s.y, "measured", width=0.0)]
    if s.curve is not None:
        lines.append(Line("trend", (s.curve[0] - zero) / YEAR, s.curve[1], "model", width=2.2))
    marks = {"limit": s.trend["limit"]} if s.trend.get("limit") is not None else {}
    figure = overlay([Panel(f"{s.quantity} [{s.unit}]", lines, marks=marks)], f"years since {day(zero)}", 320)
    figure["data"][0] |= {
        "mode": "markers", "marker": {"color": "@measured", "size": 5},
        "error_y": {"type": "data", "array": [float(v) for v in 1.6449 * s.s], "color": "@noise", "thickness": 1},
        "x": [float(v) for v in (s.t - zero) / YEAR], "y": [float(v) for v in s.y],
    }  # fmt: skip
    return figure


def _outliers(page: Page, view: FleetView) -> None:
    page.section(
        "Unlike their fleet peers",
        "Engines of which a nominal parameter, as recalibrated, is farther from that of the others than one healthy "
        "engine in a hundred would be in any of its parameters.",
    )
    rows = [[r["engine"], r["quantity"], r["value"], r["sisters"], r["unit"], r["p"]] for r in view.outliers]
    if rows:
        _table(page, ["engine", "quantity", "value", "its fleet peers", "unit", "probability if healthy"], rows)
    else:
        page.text("None.")


def _coverage(page: Page, view: FleetView) -> None:
    page.section("What the logs could not show", "An effect that no log of an engine could show may be there.")
    by: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for r in view.coverage:
        by.setdefault((r["stage"], r["effect"]), []).append(r)
    total = {e: sum(v.values()) for e, v in view.verdicts.items()}
    rows = [
        [stage, effect or "(the whole subsystem)", sum(r["logs"] for r in group), sum(total.values()),
         sum(r["logs"] == r["of"] for r in group), group[0]["needs"] or "–"]
        for (stage, effect), group in by.items()
    ]  # fmt: skip
    rows.sort(key=lambda r: (-int(str(r[2])), str(r[1])))
    if rows:
        _table(page, ["subsystem", "effect", "not shown in", "of logs", "engines never", "needs"], rows)
    else:
        page.text("Every log could show every effect.")


def _to(key: str, logs: str) -> object:
    return Link(key[:8], f"{logs}/{key}.html") if logs else key[:8]


class _Size(BaseModel):
    value: float | None
    low: float | None
    high: float | None
    unit: str


class _Effect(BaseModel):
    effect: str
    stage: str
    probability: float | None
    parameters: dict[str, _Size]
    rivals: list[str]


class _Nominal(_Size):
    stage: str
    parameter: str
    table: float | None
    tolerance: float | None


class _Answer(BaseModel):
    """What of an answer the page of a log shows."""

    verdict: str
    log: str
    stages: list[dict[str, Any]]
    effects: list[_Effect]
    nominal: list[_Nominal] = []
    notes: list[str] = []


def log_page(key: str, answer: dict[str, Any]) -> Page:
    """The short page of one log, from its answer: tables, no curves. Of a damaged answer it says that it is."""
    try:
        _Answer.model_validate(answer)
    except ValidationError as e:
        where = ".".join(str(x) for x in e.errors()[0]["loc"])
        return Page(f"Log {key[:8]}", f"Its answer is damaged ({where}).", tone="bad", subtitle="fleet")
    tones = {"none": "good", "missing": "neutral", "unknown": "bad"}
    page = Page(
        f"Log {key[:8]}", f"Verdict: {verdict_word(answer['verdict'])}.", tone=tones.get(answer["verdict"], "neutral"),  # type: ignore[arg-type]
        subtitle="fleet", log=answer["log"], command=f"vaneloop diagnose {answer['log']} --report diagnosis.html",
    )  # fmt: skip
    columns = ["subsystem", "verdict", "signal", "error before", "error after", "noise floor", "unit"]
    fields = ("stage", "verdict", "signal", "error_before", "error_after", "noise_floor", "unit")
    if rows := [{**s, "verdict": verdict_word(s["verdict"])} for s in answer["stages"]]:
        page.section("Subsystems", "RMS errors on held-out data. The command below gives the page with all curves.")
        page.table(columns, [[s.get(k) for k in fields] for s in rows])
    if answer["effects"]:
        page.section("Effects")
        page.table(
            ["effect", "subsystem", "probability", "parameter", "value", "low", "high", "unit", "as good"],
            [[e["effect"], e["stage"], e["probability"], n, *interval(p["value"], p["low"], p["high"]), p["unit"],
              ", ".join(e["rivals"]) or "–"] for e in answer["effects"] for n, p in e["parameters"].items()],
        )  # fmt: skip
    if answer.get("nominal"):
        page.section("Nominal parameters")
        page.table(
            ["subsystem", "parameter", "value", "low", "high", "table", "tolerance", "unit"],
            [[p["stage"], p["parameter"], *interval(p["value"], p["low"], p["high"]), p["table"], p["tolerance"],
              p["unit"]] for p in answer["nominal"]],
        )  # fmt: skip
    done = answer.get("done", [])
    for note in answer.get("notes", []):
        if note not in [one["said"] for one in done]:
            page.text(note)
    page.done(done)
    return page
