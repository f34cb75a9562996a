"""The verdict on a scenario: what was seen, held against what must be seen.

Every claim of the scenario is judged; besides them, safe limits of stroke demand and current, and the documented mode
changes, always. What a claim's verdict and its margin follow from are its `Facts`: taken from a `Trace`, or while loops
run side by side (`hil.inject.in_lanes`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from controller import FAULTS, MODES
from hil.inject.scenario import Expect, Scenario

__all__ = [
    "CHANGES", "EDGE", "ROUNDING", "TRANSITIONS", "Check", "Facts", "Outcome", "Trace", "always", "facts_of", "failed",
    "holds", "judge", "outcome_of",
]  # fmt: skip

# docs/controller.md, "Modes": these and no others
TRANSITIONS = frozenset({
    ("INIT", "STANDBY"), ("INIT", "FAIL_SAFE"), ("STANDBY", "RUN"), ("STANDBY", "FAIL_SAFE"), ("RUN", "STANDBY"),
    ("RUN", "DEGRADED"),
    ("RUN", "FAIL_SAFE"), ("DEGRADED", "RUN"), ("DEGRADED", "FAIL_SAFE"), ("FAIL_SAFE", "RUN"),
    ("FAIL_SAFE", "STANDBY"),
})  # fmt: skip
SLACK = (
    0.05  # s: what frames every 10 ms, another clock and a busy machine may add to a time on a bus between processes
)

EDGE = 1e-9  # s: rounding of a time
ROUNDING = 1e-6  # mm, mA, beyond the safe limits
CHANGES = "mode changes as documented"

# ---- what was seen ---------------------------------------------------------------------------------------------------


@dataclass
class Trace:
    """What a run showed: samples over time.

    t        s, float64[n]
    mode     int[n], number of the mode
    faults   int64[n], bit mask
    signals  name -> float64[n] in border units; missing where this bus does not show it
    counts   name -> int64[n], `hil.inject.scenario.COUNTS`; empty where this bus does not show them
    late     frame -> bool[n]; empty where this bus does not show it
    stroke, current   what is safe: stroke demand (low, high) in mm, current in mA
    """

    t: np.ndarray
    mode: np.ndarray
    faults: np.ndarray
    signals: dict[str, np.ndarray]
    counts: dict[str, np.ndarray] = field(default_factory=dict)
    late: dict[str, np.ndarray] = field(default_factory=dict)
    stroke: tuple[float, float] = (0.0, 48.0)
    current: float = 40.0
    exact: bool = True  # every tick was seen, not only what frames say
    ours: bool = True  # of the firmware here, whose mode changes are documented

    def truth(self, claim: Expect) -> np.ndarray | None:
        """Whether the claim's condition holds, sample by sample; None where this bus does not show it."""
        if claim.mode is not None:
            return self.mode == MODES.index(claim.mode)
        if claim.fault == "any":
            return self.faults != 0
        if claim.fault is not None:
            return (self.faults >> FAULTS.index(claim.fault)) & 1 == 1
        if claim.late is not None:
            return self.late.get(claim.late)
        values = self.signals.get(claim.signal) if claim.signal is not None else self.counts.get(str(claim.count))
        if values is None:
            return None
        low = -np.inf if claim.low is None else claim.low
        high = np.inf if claim.high is None else claim.high
        return (values >= low) & (values <= high)

    def shown(self, claim: Expect, at: np.ndarray) -> str:
        """What the samples ``at`` show of what the claim is about, in words."""
        if not at.any():
            return "nothing"
        if claim.mode is not None:
            modes = self.mode[at]
            return " > ".join(MODES[m] for m in modes[np.flatnonzero(np.diff(modes, prepend=-1))])
        if claim.fault is not None:
            names = [f for i, f in enumerate(FAULTS) if (np.bitwise_or.reduce(self.faults[at]) >> i) & 1]
            return ", ".join(names) or "no fault"
        if claim.late is not None:
            return "late at times" if self.late[claim.late][at].any() else "not late"
        values = (self.signals[claim.signal] if claim.signal is not None else self.counts[str(claim.count)])[at]
        values = values[~np.isnan(values)]
        if not len(values):
            return f"{claim.signal} nan"
        low, high = float(np.min(values)), float(np.max(values))
        return f"{claim.signal or claim.count} {low:.6g}" + (f" to {high:.6g}" if high > low else "")


@dataclass(frozen=True)
class Check:
    """One claim held against what was seen; ``held`` is None where this bus does not show it."""

    expected: str
    seen: str
    held: bool | None
    because: str = ""


@dataclass(frozen=True)
class Facts:
    """What a claim's verdict and margin follow from.

    nearest      s, from ``at`` to the nearest time at which the condition became true; inf: it never did
    first        s, when it first was true from ``after`` on; inf: never
    best, worst  distance of a signal to the nearer limit, from ``after`` on, or within ``during``: of its best and its
                 worst sample; NaN where one is no number
    seen, broken samples within ``during`` (all, where it is not given), and those of them that break the claim
    last         s, of the last sample before ``during`` that would break it; -inf: none
    """

    nearest: float = np.inf
    first: float = np.inf
    best: float = np.nan
    worst: float = np.nan
    seen: int = 0
    broken: int = 0
    last: float = -np.inf


def facts_of(claim: Expect, trace: Trace, slack: float = 0.0) -> Facts | None:
    """Facts of a claim in a trace, whose times may be off by ``slack`` (s); None where this bus does not show it."""
    truth, t = trace.truth(claim), trace.t
    if truth is None:
        return None
    if claim.at is not None:
        rises = t[truth & ~np.concatenate([[False], truth[:-1]])]
        return Facts(nearest=float(np.min(np.abs(rises - claim.at), initial=np.inf)))
    if claim.by is not None:
        inside = t >= claim.after - EDGE
        best, worst = _distances(claim, trace, inside)
        return Facts(first=float(np.min(t[truth & inside], initial=np.inf)), best=best, worst=worst)
    begin, end = claim.during or (0.0, float(t[-1]))
    inside = (t >= begin + slack - EDGE) & (t <= end - slack + EDGE) if claim.during else np.ones(len(t), bool)
    broken = truth if claim.never else ~truth
    last = float(np.max(t[broken & (t < begin - EDGE)], initial=-np.inf))
    best, worst = _distances(claim, trace, inside)
    return Facts(best=best, worst=worst, seen=int(np.sum(inside)), broken=int(np.sum(broken & inside)), last=last)


def _distances(claim: Expect, trace: Trace, inside: np.ndarray) -> tuple[float, float]:
    """Distances of a signal to its limits: of its best and its worst sample; NaN where there are none."""
    if claim.signal is None or not inside.any():
        return np.nan, np.nan
    values = trace.signals[claim.signal][inside]
    low = -np.inf if claim.low is None else claim.low
    high = np.inf if claim.high is None else claim.high
    distance = np.minimum(values - low, high - values)
    return float(np.max(distance)), float(np.min(distance))


def holds(claim: Expect, facts: Facts, slack: float = 0.0) -> bool:
    """Whether a claim holds."""
    if claim.at is not None:
        return facts.nearest <= claim.tolerance + slack + EDGE
    if claim.by is not None:
        return facts.first <= claim.by + slack + EDGE
    return facts.seen > 0 and facts.broken == 0


def _check(claim: Expect, trace: Trace, slack: float, lockstep: bool) -> Check:
    facts = facts_of(claim, trace, slack) if lockstep or claim.only is None else None
    if facts is None:
        why = "only lockstep has this timing" if claim.only else "the frames on this bus do not show it"
        return Check(claim.words, why, None, claim.because)
    return Check(claim.words, _seen(claim, trace, slack, facts), holds(claim, facts, slack), claim.because)


def _seen(claim: Expect, trace: Trace, slack: float, facts: Facts) -> str:
    """What a trace shows of a claim, in words."""
    t, truth = trace.t, trace.truth(claim)
    assert truth is not None
    if claim.at is not None:
        rises = t[truth & ~np.concatenate([[False], truth[:-1]])]
        seen = ", ".join(f"{x:.3f}" for x in rises[:6]) + (f" and {len(rises) - 6} more" if len(rises) > 6 else "")
        return f"from {seen} s on" if len(rises) else "never"
    if claim.by is not None:
        if facts.first == np.inf:
            return "never"
        return f"at {facts.first:.3f} s" if holds(claim, facts, slack) else f"not before {facts.first:.3f} s"
    begin, end = claim.during or (0.0, float(t[-1]))
    inside = (t >= begin + slack - EDGE) & (t <= end - slack + EDGE) if claim.during else np.ones(len(t), bool)
    broken = inside & (truth if claim.never else ~truth)
    if not inside.any():
        return "nothing was seen then"
    if broken.any():
        return f"broken at {t[broken][0]:.3f} s: {trace.shown(claim, broken)}"
    return trace.shown(claim, inside)


def always(stroke: tuple[float, float], current: float) -> list[tuple[str, float, float, str, str]]:
    """Safe limits that are always demanded: signal, least, most, unit, and the demand in words."""
    limits = (("x_dem", *stroke, "mm"), ("i_cmd", -current, current, "mA"))
    return [(n, least, most, unit, f"always {least:g} <= {n} <= {most:g} {unit}") for n, least, most, unit in limits]


def judge(scenario: Scenario, trace: Trace, *, lockstep: bool = True) -> list[Check]:
    """Hold every claim of a scenario against what was seen; then what is always demanded: safe limits and documented
    mode changes.
    """
    slack = 0.0 if lockstep else SLACK
    checks = [_check(claim, trace, slack, lockstep) for claim in scenario.expect]
    count = ROUNDING if trace.exact else 2e-3  # frames round
    for name, least, most, unit, words in always(trace.stroke, trace.current):
        values = trace.signals.get(name, np.empty(0))
        good = bool(np.all((values >= least - count) & (values <= most + count)))  # NaN is not good
        seen = f"{np.min(values):.4g} to {np.max(values):.4g} {unit}" if len(values) else "nothing"
        checks.append(Check(words, seen, good and len(values) > 0))
    changes = [(MODES[a], MODES[b]) for a, b in zip(trace.mode, trace.mode[1:], strict=False) if a != b]
    if trace.exact and trace.ours:
        wrong = [f"{a} > {b}" for a, b in changes if (a, b) not in TRANSITIONS]
        seen = "not: " + ", ".join(wrong) if wrong else f"{len(changes)} changes"
        checks.append(Check(CHANGES, seen, not wrong))
    return checks


def failed(name: str, scenario: Scenario, why: str) -> Outcome:
    """Outcome of a scenario in which the controller ended its process (``why``): nothing else is known of it."""
    nothing = Trace(np.zeros(1), np.zeros(1, np.int8), np.zeros(1, np.int64), {}, ours=False)
    checks = [Check("the controller runs to the end", why, False)]
    return Outcome(name, scenario.title, "lockstep", checks, nothing, [(0.0, MODES[0])], [], {}, [], 0.0, 0.0, None)


@dataclass(frozen=True)
class Outcome:
    """What came of a scenario.

    held      whether every claim that this bus can show held
    checks    the claims, then what is always demanded
    modes     [(s, mode)], each mode from when on
    counts    of the controller's receiver at the end
    notes     what could not be done or seen
    """

    name: str
    title: str
    bus: str
    checks: list[Check]
    trace: Trace
    modes: list[tuple[float, str]]
    faults: list[tuple[float, str]]
    counts: dict[str, int]
    notes: list[str]
    simulated_s: float
    wall_s: float
    state_hash: str | None

    @property
    def held(self) -> bool:
        """Whether no claim was broken."""
        return all(c.held is not False for c in self.checks)

    @property
    def mode(self) -> str:
        """Mode at the end."""
        return self.modes[-1][1]

    def mode_at(self, t: float) -> str:
        """Mode at ``t`` s."""
        return MODES[int(self.trace.mode[max(int(np.searchsorted(self.trace.t, t + 1e-9)) - 1, 0)])]

    def faults_seen(self) -> set[str]:
        """Return the names of all faults that stood at any time."""
        return {name for _, name in self.faults}

    def text(self) -> str:
        """Return the claims line by line, broken ones marked: what an assert should show."""
        mark = {True: "held  ", False: "BROKEN", None: "unseen"}
        lines = [f"{self.name}: {'held' if self.held else 'NOT held'} ({self.title})"]
        lines += [f"  {mark[c.held]}  {c.expected}  |  seen: {c.seen}" for c in self.checks]
        return "\n".join([*lines, "  modes: " + ", ".join(f"{m} {t:.3f} s" for t, m in self.modes)])

    def json(self) -> dict[str, Any]:
        """Return the outcome as plain data."""
        return {
            "name": self.name, "title": self.title, "held": self.held, "simulated_s": self.simulated_s,
            "wall_s": self.wall_s,
            "state_hash": self.state_hash, "counts": self.counts, "notes": self.notes,
            "modes": [{"t": t, "mode": m} for t, m in self.modes],
            "faults": [{"t": t, "fault": f} for t, f in self.faults],
            "expectations": [{"expected": c.expected, "seen": c.seen, "held": c.held,
            "because": c.because} for c in self.checks],
        }  # fmt: skip


def outcome_of(name: str, scenario: Scenario, bus: str, trace: Trace, **rest: Any) -> Outcome:
    """Judge a trace; ``rest`` are the other fields of `Outcome`."""
    change = np.flatnonzero(np.diff(trace.mode, prepend=-1))
    modes = [(float(trace.t[i]), MODES[int(trace.mode[i])]) for i in change]
    before = np.concatenate([[0], trace.faults[:-1]])
    rises = [(i, trace.faults[i] & ~before[i]) for i in np.flatnonzero(trace.faults & ~before)]
    faults = [(float(trace.t[i]), f) for i, bits in rises for q, f in enumerate(FAULTS) if (bits >> q) & 1]
    counts = {k: int(v[-1]) for k, v in trace.counts.items()}
    checks = judge(scenario, trace, lockstep=bus == "lockstep")
    return Outcome(name, scenario.title, bus, checks, trace, modes, faults, counts, **rest)
