"""Why was this accepted, and why was that not: the verdicts of the acceptance rules as a table."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from vaneloop.identification.selection.rules import RULES, Decision, Verdict
from vaneloop.pages.page import Page

__all__ = ["Explained", "counted", "decision_table", "explain", "reasons"]

Explained = tuple[Sequence[Decision], Collection[str]]  # decisions, and names of what was chosen

SHOWN = 40  # decisions in one table: what was accepted, and what came nearest


def decision_table(decisions: Sequence[Decision], chosen: Collection[str]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows: a candidate each, accepted ones first, then those that fail fewest rules.

    chosen  names of the effects and curves of the answer: of what is accepted the best is chosen
    """

    def is_chosen(d: Decision) -> bool:
        return d.accepted and bool(d.added) and set(d.added) == set(chosen)

    ordered = sorted(decisions, key=lambda d: (not is_chosen(d), sum(not v.holds for v in d.verdicts)))[:SHOWN]
    rules = [name for name in RULES if any(v.rule == name for d in ordered for v in d.verdicts)]
    rows = []
    for d in ordered:
        of = {v.rule: _cell(v) for v in d.verdicts}
        verdict = "chosen" if is_chosen(d) else "accepted" if d.accepted else "rejected"
        names = " + ".join(d.added) or "nominal model"
        rows.append([names, " + ".join(d.beside) or "nominal model", verdict, *(of.get(r, "") for r in rules)])
    return ["candidate", "compared with", "verdict", *rules], rows


def _cell(v: Verdict) -> str:
    """The number, how it compares with the limit, and the limit."""
    if RULES[v.rule].at_most:
        return f"{v.value:.3g} {'≤' if v.holds else '>'} {v.limit:.3g}"
    return f"{v.value:.3g} {'≥' if v.holds else '<'} {v.limit:.3g}"


def reasons(decisions: Sequence[Decision]) -> list[list[str]]:
    """Each rule that was applied: name, unit, what must hold, and the reason."""
    used = [rule for name, rule in RULES.items() if any(v.rule == name for d in decisions for v in d.verdicts)]
    return [[r.name, r.unit, "at most" if r.at_most else "at least", r.reason] for r in used]


def counted(decisions: Sequence[Decision]) -> str:
    """How many decisions there are, and how many of them are shown."""
    many = f"{len(decisions)} decision{'s' * (len(decisions) != 1)} of the acceptance rules"
    return many + (f", {SHOWN} of them shown; the JSON has all" if len(decisions) > SHOWN else "")


def explain(page: Page, of: Mapping[str, Explained]) -> None:
    """Add the acceptance rules to a page, folded; ``of``: subsystem -> decisions, and what was chosen."""
    every = [d for decisions, _ in of.values() for d in decisions]
    if not every:
        return
    page.section(
        "Why accepted, why not",
        "Each candidate is judged by every rule of its kind: the number measured, and the limit. Of what is accepted "
        "the best is chosen.",
    )
    with page.folded("Acceptance rules, with reasons"):
        page.table(["rule", "unit", "limit", "reason"], reasons(every))
    for name, (decisions, chosen) in of.items():
        if decisions:
            with page.folded(f"{name}: {counted(decisions)}"):
                page.table(*decision_table(decisions, chosen))
