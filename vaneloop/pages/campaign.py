"""The page of a campaign: does every machine within tolerance hold every requirement, how surely, how nearly not."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from vaneloop.pages.figures import Line, Panel, overlay, ranking
from vaneloop.pages.page import Page
from vaneloop.pages.series import distribution

__all__ = ["CampaignView", "FailedMachine", "GroupView", "Rare", "Requirement", "Traced", "campaign_page"]

DIGITS = 6  # of limits: a tolerance may be a thousandth


@dataclass(frozen=True)
class Requirement:
    """One claim over all trials of a group.

    trials, broken   in how many it was judged, in how many broken
    least, median    margin in ``unit``; None: nothing measures it
    share            the least as a share (`hil.inject.margin`)
    searched, held   margin of the case that the search ended with, and whether it held there; None: no search
    low, high        interval of the probability that it is broken
    ids              identifiers of the plan's requirements that it verifies
    """

    expected: str
    trials: int
    broken: int
    unit: str
    least: float | None
    median: float | None
    share: float | None
    searched: float | None
    held: bool | None
    low: float = 0.0
    high: float = 1.0
    ids: list[str] = field(default_factory=list)

    @property
    def fails(self) -> bool:
        """Whether it was broken in any run."""
        return self.broken > 0 or self.held is False


@dataclass(frozen=True)
class FailedMachine:
    """A failed sample that is saved: its name, its least margin (a share), its model file, the command that runs it
    again, and whether it came to the same verdicts and margins from these files.
    """

    name: str
    least: float
    file: str
    command: str
    same: bool


@dataclass(frozen=True)
class Rare:
    """A small failure probability by subset simulation, with its interval (`vaneloop.fleet.probability`).

    probability   0: no machine failed; then the interval ends at what the last level is sure of
    runs          machines beyond the samples
    levels        margin (a share), share of the machines of the level before, its coefficient of variation
    worst         whether the worst machine is one of its
    """

    probability: float
    low: float
    high: float
    runs: int
    levels: list[dict[str, float]]
    worst: bool

    @property
    def text(self) -> str:
        """The result in one sentence."""
        said = f"failure probability {self.probability:.3g}" if self.probability else "no machine failed"
        return (
            f"Subset simulation: {said}, {self.low:.2g} to {self.high:.2g}, from {len(self.levels)} levels with "
            f"{self.runs:,} machines beyond the samples"
        )


@dataclass(frozen=True)
class GroupView:
    """One scenario with one calibration and one firmware.

    trials, lost, failed   samples with an answer, without one, and those in which a claim was broken
    low, high              interval of the failure probability
    shares, points         least margin and point (unit cube) of each sample
    worst                  values of what was varied, in the worst case; its least margin is ``least``
    by_search, runs        whether the search found it, and the search's runs
    same                   whether the saved case ran to the same bits
    first, total           sensitivity indices of the least margin; empty: none
    alone                  samples that ran on the lockstep bus and not in lanes, by the reason
    failures               failed samples that are saved, the worst first
    rare                   the probability by subset simulation; None: it is counted
    counted                why it is counted where the plan asks for a subset simulation; empty: it does not, or it came
    """

    name: str
    scenario: str
    calibration: str
    firmware: str
    trials: int
    lost: int
    failed: int
    low: float
    high: float
    requirements: list[Requirement]
    shares: list[float]
    points: list[list[float]]
    worst: list[float]
    least: float
    by_search: bool
    runs: int
    seen: list[str]
    state_hash: str | None
    saved: str
    command: str
    same: bool
    first: list[float]
    total: list[float]
    alone: dict[str, int] = field(default_factory=dict)
    failures: list[FailedMachine] = field(default_factory=list)
    rare: Rare | None = None
    counted: str = ""

    @property
    def probability(self) -> float:
        """Estimate of the failure probability."""
        return self.rare.probability if self.rare else self.failed / self.trials

    @property
    def found_by(self) -> str:
        """What the worst machine is one of."""
        return "search" if self.by_search else "level" if self.rare and self.rare.worst else "sample"

    @property
    def reproduces(self) -> bool:
        """Whether the worst machine and every failed one that is saved came to the same from their files."""
        return self.same and all(f.same for f in self.failures)

    def saved_failures(self) -> str:
        """How many of the failed samples are saved, in words; empty: none failed."""
        if not self.failed:
            return ""
        n, left = len(self.failures), self.failed - len(self.failures)
        rest = f"; {left} more failed and {'is' if left == 1 else 'are'} not saved" if left else ""
        return f"{n} of {self.failed} failed machines saved, the worst first{rest}"


@dataclass(frozen=True)
class Traced:
    """A requirement of the plan: its identifier and text, whether it holds in every combination that verifies it, and
    the combinations with their claims.
    """

    id: str
    text: str
    holds: bool
    verified_by: list[tuple[str, str]]


@dataclass(frozen=True)
class CampaignView:
    """What a campaign says: its groups, and what was varied (name, unit, low, high).

    simulated_s  s of samples, indices, levels and search by what ran them: a GPU's name, "cpu" (lanes), "bus"
    notes        what ran elsewhere than it was asked to, and why
    texts        requirements of the plan: identifier -> text
    """

    title: str
    run: str
    version: str
    varied: list[dict[str, Any]]
    confidence: float
    allowed: float | None
    sampling: str
    seed: int
    groups: list[GroupView]
    simulated_s: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    texts: dict[str, str] = field(default_factory=dict)

    @property
    def traced(self) -> list[Traced]:
        """Each requirement of the plan with what verifies it."""
        out = []
        for name, text in self.texts.items():
            by = [(g, r) for g in self.groups for r in g.requirements if name in r.ids]
            holds = all(not g.lost and self.holds(r) for g, r in by)
            out.append(Traced(name, text, holds and bool(by), [(g.name, r.expected) for g, r in by]))
        return out

    def holds(self, claim: Requirement) -> bool:
        """Whether a claim holds: in every run, or as surely as the plan allows."""
        return not claim.fails if self.allowed is None else claim.high <= self.allowed

    @property
    def simulated_on(self) -> str:
        """How many seconds were simulated on what, in words."""
        names = {"cpu": "the processor (in lanes)", "bus": "the lockstep bus (one by one)"}
        return "Simulated: " + ", ".join(f"{s:,.6g} s on {names.get(on, on)}" for on, s in self.simulated_s.items())

    def passed(self, g: GroupView) -> bool:
        """Whether a group is good: no trial lost and all that is saved reproduced; and either nothing broken, or the
        interval's upper end within what the plan allows.
        """
        if g.lost or not g.reproduces:
            return False
        return not any(r.fails for r in g.requirements) if self.allowed is None else g.high <= self.allowed

    def sentence(self) -> str:
        """The answer in one sentence."""
        bad = [g for g in self.groups if not self.passed(g)]
        near = min(self.groups, key=lambda g: g.least)
        rule = "no claim may break" if self.allowed is None else f"at most {self.allowed:g} of the machines may fail"
        n = len(self.groups)
        what = "is broken most" if near.least < 0.0 else "comes closest to failing"
        return (
            f"{n - len(bad)} of {n} combinations of scenario, calibration and firmware pass ({rule}); "
            f"{near.name} {what}, with a least margin of {near.least:.3g} of what is allowed."
        )

    def json(self) -> dict[str, Any]:
        """The answer as plain data."""
        out = {"schema": 1, **asdict(self), "passed": all(self.passed(g) for g in self.groups)}
        out["requirements"] = [asdict(r) for r in self.traced]
        out.pop("texts")
        for row, g in zip(out["groups"], self.groups, strict=True):
            row |= {"passed": self.passed(g), "failures_not_saved": g.failed - len(g.failures)}
            row.pop("points"), row.pop("shares")
        return out


def campaign_page(view: CampaignView, command: str = "") -> Page:
    """The page of a campaign."""
    good = all(view.passed(g) for g in view.groups)
    page = Page("Campaign", view.sentence(), tone="good" if good else "bad", subtitle=view.title, command=command,
                log=view.run)  # fmt: skip
    page.tile("combinations", len(view.groups), note="scenario, calibration, firmware")
    page.tile("machines tried", sum(g.trials for g in view.groups), note=f"{view.sampling}, seed {view.seed}")
    page.tile("failed", sum(g.failed for g in view.groups), tone="good" if good else "bad")
    page.tile("runs of the search", sum(g.runs for g in view.groups))
    page.section(
        "Result",
        f"Failure probability of a machine drawn uniformly from the tolerances, with its {100.0 * view.confidence:g} % "
        "interval (Clopper-Pearson, which takes the samples as independent; points of a Sobol sequence are distributed "
        "more evenly than that)"
        + (", or by subset simulation where that is said below" if any(g.rare for g in view.groups) else "")
        + ". The least margin is a share: 1 is the best, 0 is at the limit, below 0 is broken.",
    )
    page.table(
        ["combination", "passes", "machines", "without answer", "failed", "probability", "low", "high", "least margin",
         "found by"],
        [[g.name, view.passed(g), g.trials, g.lost, g.failed, g.probability, g.low, g.high, g.least,
          g.found_by] for g in view.groups],
    )  # fmt: skip
    if view.texts:
        page.section(
            "Requirements",
            "Each with the combinations and claims that verify it. Low and high are the interval of the probability "
            "that a machine breaks the claim.",
        )
        page.table(
            ["id", "requirement", "holds", "combination", "claim", "judged in", "broken in", "low", "high"],
            [[t.id, t.text, t.holds, g.name, r.expected, r.trials, r.broken, r.low, r.high]
             for t in view.traced for g in view.groups for r in g.requirements if t.id in r.ids],
        )  # fmt: skip
    page.section("What was varied", "Each uniformly and independently of the others, between these limits.")
    rows = [[q["name"], q["low"], q["high"], q["unit"]] for q in view.varied]
    page.table(["quantity", "low", "high", "unit"], rows, digits=DIGITS)
    for g in view.groups:
        _group(page, view, g)
    page.section("Basis")
    if view.simulated_s:
        page.text(" ".join(f"{said}." for said in (view.simulated_on, *view.notes)))
    page.text(f"VaneLoop {view.version}. All trials, their answers and the copies of all files are in {view.run}.")
    return page


def _group(page: Page, view: CampaignView, g: GroupView) -> None:
    page.section(
        f"{g.scenario}, calibration {g.calibration}, firmware {g.firmware}",
        "Requirements of the scenario. Low and high are the interval of the probability that a machine breaks it. A "
        "margin is the distance from being broken, in the unit of the claim; a claim without a margin is only held or "
        "broken.",
    )
    columns = ["requirement", "holds", "judged in", "broken in", "low", "high", "least margin", "median margin", "unit",
               "margin after search"]  # fmt: skip
    page.table(columns, [[" ".join([*r.ids, r.expected]), view.holds(r), r.trials, r.broken, r.low, r.high, r.least,
                          r.median, r.unit or "–", r.searched] for r in g.requirements])  # fmt: skip
    for why, n in g.alone.items():
        page.text(f"{n} of {g.trials} machines ran one by one on the lockstep bus, not in lanes: {why}.")
    if g.rare:
        page.text(
            f"{g.rare.text}. A level holds the share of the machines before it that come as near to failing. Its "
            "coefficient of variation is from the autocorrelation of its chains; the interval adds those of all "
            "levels, an upper bound. Failures that no chain came near are not seen."
        )
        page.table(
            ["level", "least margin at or below", "share", "coefficient of variation"],
            [[k, of["margin"], of["share"], of["variation"]] for k, of in enumerate(g.rare.levels, 1)],
        )
    if g.counted:
        page.text(f"The failure probability is counted: {g.counted}.")
    names = [q["name"] for q in view.varied]
    if g.total:
        total, first = np.round(g.total, 3).tolist(), np.round(g.first, 3).tolist()
        page.plot(
            ranking(names, total, "total Sobol index"),
            "Which tolerance the least margin depends on: the share of its variance that a quantity has, alone and "
            "together with others."
            + (" A share above 1 is none: it wants more base points (sensitivity)." if max(total) > 1.1 else ""),
            half=True,
        )
    line = Line("machines", *distribution(g.shares), "model", 2.2)
    page.plot(overlay([Panel("share of machines", [line])], "least margin at or below", 320),
              "Distribution of the least margin over the machines.", half=True)  # fmt: skip
    if g.total:
        order = np.argsort(-np.array(total)).tolist()
        page.table(
            ["quantity", "share of the variance, alone", "with others (total)"],
            [[names[k], first[k], total[k]] for k in order],
        )
    how = f"by the search ({g.runs} runs)"
    if g.found_by == "level":
        how = "in the levels of the subset simulation"
    elif not g.by_search:
        how = f"among the samples; {f'the search ({g.runs} runs) found none' if g.runs else 'no search was made'}"
    page.text(f"Worst machine, found {how}; least margin {g.least:.4g}." + "".join(f" Seen: {s}." for s in g.seen))
    page.table(
        ["quantity", "worst machine", "low", "high", "unit"],
        [[q["name"], v, q["low"], q["high"], q["unit"]] for q, v in zip(view.varied, g.worst, strict=True)],
        digits=DIGITS,
    )
    again = "It ran to the same bits" if g.same else "It did NOT run to the same result"
    page.text(f"{again} from its saved files (state {g.state_hash}): {g.command}")
    if saved := g.saved_failures():
        page.text(f"{saved}.")
    if g.failures:
        page.table(
            ["failed machine", "least margin", "reproduces", "model file", "command"],
            [[f.name, f.least, f.same, f.file, f.command] for f in g.failures],
        )
