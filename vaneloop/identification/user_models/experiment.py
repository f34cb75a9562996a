"""Which run of a user's own system would tell most? Runs of its inputs within stated limits are simulated, and judged
by what they would tell: T- and D-optimal designs (Atkinson and Fedorov 1975; Fedorov 1972).

rivals are left   the run on which the better of two laws, refitted, stays farthest from the other: the error with the
                  wrong law over that with the right one, where what is left of the log is left of the run, too
none are left     the run with the greatest determinant of the information on all parameters: their standard errors
                  over those of the log

The best of a bank of shapes is improved by shifting parts of it, one at a time, and checked by simulated runs with
noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy

from vaneloop.base.errors import InputError, meant
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.settings import (
    DESIGN_CHECKS,
    DESIGN_GAIN,
    DESIGN_PACE,
    DESIGN_PARTS,
    DESIGN_SAMPLES,
    DESIGN_SHIFTS,
    DESIGN_SIZES,
    MARGIN,
    RIVAL,
)
from vaneloop.identification.subsystem import Array, StageError
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.system import Record, System

__all__ = ["Limits", "driven", "recommend"]

Shape = Callable[[Array], Array]  # share of the run, 0 to 1, to share of the range, -1 to 1
Run = dict[str, Array]  # what drives the system, channel -> values


@dataclass(frozen=True)
class Limits:
    """What a run must keep to, each by channel, in the system's unit.

    ranges  lowest and highest value; of what drives the system, default as in the log, of outputs none
    rates   greatest rate per s, of what drives the system
    seconds length of the run; None: as the first log
    """

    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rates: Mapping[str, float] = field(default_factory=dict)
    seconds: float | None = None


def driven(system: System) -> dict[str, str]:
    """The channels that whoever runs the system sets, name -> unit: inputs; of kind force its motion too."""
    motion = system.position or system.velocity
    unit = system.unit_of_position if system.position else ""
    return ({motion: unit} if system.kind == "force" and motion else {}) | dict(system.inputs)


# ---- runs ------------------------------------------------------------------------------------------------------------


def _chirp(size: float, cycles: float) -> Shape:
    return lambda s: size * scipy.signal.chirp(s, 1.0, 1.0, cycles, phi=-90)


def _levels(n: int, seed: int, ends: bool = False) -> Shape:
    rng = np.random.default_rng(seed)
    levels = rng.choice([-1.0, 1.0], n) if ends else rng.uniform(-1.0, 1.0, n)
    return lambda s: levels[np.minimum((s * n).astype(int), n - 1)]


def _stairs(s: Array) -> Array:
    return np.round(4.0 * scipy.signal.sawtooth(2.0 * np.pi * s, 0.5)) / 4.0


def _triangle(cycles: float, size: float = 1.0) -> Shape:
    return lambda s: size * scipy.signal.sawtooth(2.0 * np.pi * cycles * s, 0.5)


SHAPES: dict[str, Shape] = {
    "one slow ramp up and down": _triangle(1.0),
    "five ramps up and down": _triangle(5.0),
    "small reversals about the middle": _triangle(12.0, 0.1),
    "stairs up and down with dwells": _stairs,
    "steps to 30 random levels": _levels(30, 1),
    "steps to 100 random levels": _levels(100, 2),
    "30 steps between the ends at random": _levels(30, 3, ends=True),
    "swept sine to 40 cycles a run": _chirp(1.0, 40.0),
    "small swept sine about the middle, to 40 cycles a run": _chirp(0.1, 40.0),
}


@dataclass(eq=False)
class _Bench:
    """A system on which runs are tried: its own range of each channel that is driven, and the times of a run."""

    bound: BoundSystem
    limits: Limits

    def __post_init__(self) -> None:
        self.system, log = self.bound.system, self.bound.data.records[0]
        self.sets, outputs = driven(self.system), self.system.outputs
        for name in self.limits.ranges:
            if name not in self.sets and name not in outputs:
                allowed = ", ".join([*self.sets, *outputs])
                raise InputError(f"limit {name!r}{meant(name, [*self.sets, *outputs])}: allowed: {allowed}")
        for name in self.limits.rates:
            if name not in self.sets:
                raise InputError(f"rate {name!r}{meant(name, self.sets)}: allowed: {', '.join(self.sets)}")
        if not self.sets:
            raise InputError(f"system {self.system.name!r} has no input; there is nothing to choose in a run of it")
        span = float(log.t[-1] - log.t[0])
        seconds = span if self.limits.seconds is None else self.limits.seconds
        step = max(float(np.median(np.diff(log.t))), seconds / DESIGN_SAMPLES)
        if seconds / step < 50:
            raise InputError(f"a run of {seconds:g} s has {seconds / step:.0f} samples; allowed: 50 or more")
        self.t = np.arange(0.0, seconds + 0.5 * step, step)
        own = {n: (float(np.min(log.columns[n])), float(np.max(log.columns[n]))) for n in self.sets if n in log.columns}
        self.ranges = {n: self.limits.ranges.get(n, own.get(n, (-1.0, 1.0))) for n in self.sets}
        self.first = {o: _first(log.columns[o]) if o in log.columns else 0.0 for o in outputs}
        # what a machine does is one free run, where its model is held against a log window by window, too
        begin: dict[str, float | str] = {
            x: self.system.start.get(x, self.first.get(x, 0.0)) for x in self.system.states
        }
        self.free = replace(self.system, window=None, start=begin) if self.system.window else self.system
        again = np.linspace(log.t[0], log.t[-1], len(self.t))
        self.usual = {o: _again(log.columns[o], log.t, again) if o in log.columns else 0.0 * again for o in outputs}
        self.log_again = {n: self._within(n, np.interp(again, log.t, log.columns[n])) for n in own}

    def _within(self, name: str, values: Array) -> Array:
        """A course of a channel brought within its range and rate."""
        low, high = self.ranges[name]
        out = np.clip(values, low, high)
        if (cutoff := self.bound.data.motion_cutoff) and name in (self.system.position, self.system.velocity):
            weights = np.hanning(2 * max(1, round(1.0 / (cutoff * float(self.t[1])))) + 3)
            padded = np.pad(out, len(weights) // 2, mode="edge")  # an average leaves range and rate as they are
            out = np.convolve(padded, weights / weights.sum(), mode="valid")
        most = self.limits.rates.get(name, np.inf) * float(self.t[1])
        if np.isfinite(most):
            for k in range(1, len(out)):
                out[k] = np.clip(out[k], out[k - 1] - most, out[k - 1] + most)
        return out

    def of_shape(self, shape: Shape, size: float) -> Run:
        """A shape as a run of every channel that is driven, over a part of its range about the middle."""
        share, out = np.linspace(0.0, 1.0, len(self.t)), {}
        for k, (name, (low, high)) in enumerate(self.ranges.items()):
            values = shape((share * (1.0 + DESIGN_PACE * k)) % 1.0 if k else share)
            out[name] = self._within(name, 0.5 * (low + high) + 0.5 * size * (high - low) * np.asarray(values))
        return out

    def shifted(self, run: Run, rng: np.random.Generator) -> Run:
        """The run with one part of a channel shifted at random: whole where the system's inputs hold, else as a hat."""
        name, part = list(run)[int(rng.integers(len(run)))], len(self.t) // DESIGN_PARTS
        at = int(rng.integers(len(self.t) - part))
        low, high = self.ranges[name]
        shape = np.ones(part) if self.system.holds else scipy.signal.windows.triang(part)
        values = run[name].copy()
        values[at : at + part] += rng.uniform(-1.0, 1.0) * (high - low) * shape
        return {**run, name: self._within(name, values)}

    def simulated(self, run: Run, theta: Array, noise: Array, draw: int) -> BoundSystem | None:
        """The system held against the log that this run would give with parameters ``theta`` (of the log's stage).
        None where it leaves its limits.

        noise  RMS of what is added to each output in the simulation ``draw``; in 0 nothing is
        """
        columns = dict(run)
        s = self.system
        if s.kind == "force" and s.position and s.velocity:
            columns[s.velocity] = np.gradient(run[s.position], self.t)
        try:
            empty = BoundSystem(self.free, [Record("run", self.t, columns | self.usual)], like=self.bound)
            y = empty.run(self.theta_on(empty, theta)[None])[0]
        except StageError:
            return None
        for k, name in enumerate(s.outputs):
            low, high = self.limits.ranges.get(name, (-np.inf, np.inf))
            if not np.all(np.isfinite(y[k])) or y[k].min() < low or y[k].max() > high:
                return None
        if draw:
            y = y + noise[:, None] * np.random.default_rng(draw).standard_normal(y.shape)
        measured = dict(zip(s.outputs, y, strict=True))
        return BoundSystem(s, [Record("run", self.t, columns | measured)], like=self.bound)

    def theta_on(self, on: BoundSystem, theta: Array) -> Array:
        """Parameters of the log's stage as those of a run's: it starts as the first log does."""
        n, mine, theirs = len(self.system.parameters), len(on.runner.free_starts), len(self.bound.runner.free_starts)
        return np.concatenate([theta[:n], theta[n : n + mine], theta[n + theirs :]])


def _again(values: Array, t: Array, again: Array) -> Array:
    """An output of the log as a run may have it before it is simulated: its size says what is far out of bounds."""
    there = np.isfinite(values)
    return np.interp(again, t[there], values[there]) if there.any() else np.zeros(len(again))


def _first(values: Array) -> float:
    there = values[np.isfinite(values)]
    return float(there[0]) if len(there) else 0.0


def _problem(on: BoundSystem, left: Array) -> LeastSquaresProblem:
    """The fit of a run against what is left of the log, or what a search would take for the run's noise, where that is
    more: levels that change from sample to sample look like noise.
    """
    return LeastSquaresProblem(on.thinned, np.maximum(left, on.data.noise()))


# ---- what a run tells ------------------------------------------------------------------------------------------------


class _Rivals:
    """How well a run tells rivals apart: of each pair the log of the error with the wrong law over that with the right
    one, the worse of either as the truth.
    """

    heads = {"profile": "run", "told": "error with the wrong law, times that with the right one"}
    goal = MARGIN * RIVAL

    def __init__(self, bench: _Bench, d: StageDiagnosis):
        self.bench, self.left = bench, np.maximum(d.error_after, d.floor)
        self.pairs = []
        for f in d.effects:
            beside = tuple(o.effect for o in d.effects if o is not f)
            for rival in f.rivals[:3]:
                if rival in f.fits:
                    self.pairs.append(((f.effect, d.final.theta), (rival, f.fits[rival].theta), beside))

    def told(self, run: Run, draw: int = 0) -> list[float] | None:
        """What the run tells of each pair, with draw ``draw`` of noise (0: none); None: it leaves its limits."""
        out = []
        for one, other, beside in self.pairs:
            for (right, truth), (wrong, start) in ((one, other), (other, one)):
                on = self.bench.simulated(run, truth, self.left, draw)
                if on is None:
                    return None
                judge = _problem(on, self.left)
                right_theta = self.bench.theta_on(on, truth)
                error = float(judge.fit((*beside, wrong), self.bench.theta_on(on, start), 12).cost.sum()) / judge.n
                if draw:
                    least = float(judge.fit((*beside, right), right_theta, 12).cost.sum()) / judge.n
                    out.append(0.5 * float(np.log(error / least)))
                else:  # what is left of a run without noise is of filters and steps of the time, with either law
                    least = float(np.sum(judge.errors(right_theta[None]) ** 2)) / judge.n
                    out.append(0.5 * float(np.log((1.0 + error) / (1.0 + least))))
        return [min(out[k : k + 2]) for k in range(0, len(out), 2)]

    def row(self, score: float) -> float:
        """A score as the table has it."""
        return float(np.exp(score))

    def checked(self, run: Run, asked: Sequence[int]) -> str:
        """What simulated runs with noise say."""
        draws = [self.told(run, k + 1) for k in range(DESIGN_CHECKS)]
        said = [of[i] for of in draws if of is not None for i in asked]
        right = sum(s > RIVAL for s in said)
        return f"in {right} of {len(said)} simulations with noise the right law is told, whichever it is"

    def text(self, name: str, score: float, seconds: float, checked: str, asked: Sequence[int]) -> str:
        """The answer in words."""
        of = {k: f"{one[0]} from {other[0]}" for k, (one, other, _) in enumerate(self.pairs)}
        never = "; ".join(names for k, names in of.items() if k not in asked or score < self.goal)
        none = f"No run within the limits separates {never}"
        if score < self.goal:
            return (
                f"{none}. With the best, {name}, the wrong law leaves {np.exp(score):.2f} times the error of the right "
                f"one; {np.exp(self.goal):.2f} times is required."
            )
        return (
            f"To distinguish {', '.join(of[k] for k in asked)}: {name}, {seconds:g} s; the wrong law then leaves "
            f"{np.exp(score):.2f} times the error of the right one; {checked}.{f' {none}.' if never else ''}"
        )


class _Parameters:
    """How well a run tells the parameters: minus the log of their standard errors over those of the log, on average."""

    heads = {"profile": "run", "told": "standard errors over those of the log"}
    goal = -np.inf  # the best is the best, whatever the log was

    def __init__(self, bench: _Bench, d: StageDiagnosis):
        self.bench, self.theta, self.effects = bench, d.final.theta, d.final.effects
        self.left = np.maximum(d.error_after, d.floor)
        bound = bench.bound
        self.log = self._information(bound, self.theta)[0]

    def _information(self, on: BoundSystem, theta: Array) -> tuple[Array, Array]:
        """The information on the parameters that are free, and their columns: not where the run starts, nor what stands
        at a bound.
        """
        judge = _problem(on, self.left)
        n, starts = len(self.bench.system.parameters), len(on.runner.free_starts)
        low, high = judge.bounds()
        columns = judge.columns(self.effects)
        free = np.array([c for c in columns if not n <= c < n + starts and low[c] < theta[c] < high[c]], dtype=int)
        _, _, normals = judge.blocks(*judge.linearise(theta, free))
        return normals.sum(axis=0) / np.outer(judge.scale[free], judge.scale[free]), free

    def told(self, run: Run) -> list[float] | None:
        """What the run tells; None: it leaves its limits."""
        on = self.bench.simulated(run, self.theta, self.left, 0)
        if on is None:
            return None
        now = self._information(on, self.bench.theta_on(on, self.theta))[0]
        (sign, size), (_, before) = np.linalg.slogdet(now), np.linalg.slogdet(self.log)
        if sign <= 0.0:
            return None
        return [float(size - (before if np.isfinite(before) else 0.0)) / (2.0 * max(len(now), 1))]

    def row(self, score: float) -> float:
        """A score as the table has it."""
        return float(np.exp(-score))

    def checked(self, run: Run, asked: Sequence[int]) -> str:
        """How far parameters refitted to simulated runs with noise scatter, over what the information promises."""
        off = []
        for k in range(DESIGN_CHECKS):
            on = self.bench.simulated(run, self.theta, self.left, k + 1)
            if on is not None:
                theta = self.bench.theta_on(on, self.theta)
                information, free = self._information(on, theta)
                fit = _problem(on, self.left).fit(self.effects, theta, 12)
                away = fit.theta[free] - theta[free]
                off.append(float(away @ information @ away) / max(len(free), 1))
        scatter = float(np.sqrt(np.mean(off))) if off else float("nan")
        return f"{DESIGN_CHECKS} simulated runs with noise scatter {scatter:.2f} times as far as their errors say"

    def text(self, name: str, score: float, seconds: float, checked: str, asked: Sequence[int]) -> str:
        """The answer in words."""
        return (
            f"No rivals are left. For the parameters: {name}, {seconds:g} s; standard errors are "
            f"{np.exp(-score):.2f} times those of the log; {checked}."
        )


def recommend(
    bound: BoundSystem, d: StageDiagnosis, limits: Limits, progress: Callable[[float], None] | None = None
) -> dict[str, Any]:
    """The best run for the rivals of a diagnosis, or else for the parameters; as `vane_chain.experiment.recommend`."""
    bench = _Bench(bound, limits)
    rivals = _Rivals(bench, d)
    judged: _Rivals | _Parameters = rivals if rivals.pairs else _Parameters(bench, d)
    tell = progress or (lambda _: None)
    tried: list[tuple[str, list[tuple[float, Run]]]] = [
        (name, [(size, bench.of_shape(shape, size)) for size in DESIGN_SIZES]) for name, shape in SHAPES.items()
    ]
    if set(bench.log_again) == set(bench.sets):
        tried.append(("the log's own again", [(1.0, bench.log_again)]))
    steps = len(tried) + DESIGN_SHIFTS + 1
    table: list[dict[str, Any]] = []
    able: dict[str, tuple[Run, list[float]]] = {}
    for k, (name, of) in enumerate(tried):
        for size, run in of:  # the largest that keeps the outputs within their limits
            if (said := judged.told(run)) is not None and np.all(np.isfinite(said)):
                able[name + (f", {100 * size:.0f} % of the range" if size < 1.0 else "")] = run, said
                break
        else:
            table.append({"profile": name, "score": None, "told": None})
        tell((k + 1) / steps)
    if not able:
        raise InputError(f"system {bench.system.name!r}: no run of the bank keeps its outputs within the limits")
    most = np.max([said for _, said in able.values()], axis=0)
    asked = [k for k, v in enumerate(most) if v >= judged.goal] or list(range(len(most)))  # what no run tells is said
    scores = {name: min(said[k] for k in asked) for name, (_, said) in able.items()}
    best = max(scores, key=lambda name: scores[name])
    run, score, rng = able[best][0], scores[best], np.random.default_rng(0)
    for k in range(DESIGN_SHIFTS):
        other = bench.shifted(run, rng)
        if (said := judged.told(other)) is not None and (now := min(said[k] for k in asked)) > score + DESIGN_GAIN:
            run, score = other, now
        tell((len(tried) + k + 1) / steps)
    if score > scores[best]:
        best += ", parts of it shifted"
        scores[best] = score
    separates = bool(score >= judged.goal)
    checked = judged.checked(run, asked) if separates else ""
    rows = [
        {"profile": n, "score": scores[n], "told": judged.row(scores[n])}
        for n in sorted(scores, key=lambda n: scores[n])
    ]
    tell(1.0)
    return {
        "text": judged.text(best, score, float(bench.t[-1]), checked, asked), "profile": best,
        "score": score, "separates": separates, "repeats": 1, "t": bench.t,
        "inputs": {name: (unit, run[name]) for name, unit in bench.sets.items()}, "table": [*reversed(rows), *table],
        "heads": judged.heads,
    }  # fmt: skip
