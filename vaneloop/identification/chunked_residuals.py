"""What a model that was fitted to an excerpt of a very long log says of all of it, stretch by stretch.

A stretch gives sums, a few numbers for each of its pieces, and is forgotten: memory does not grow with the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.regimes import stands_out
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.selection.rules import EXPLAINS_HALF, LEAVES_LITTLE, Decisions, Remainder
from vaneloop.identification.settings import AGREES, NOISE_KNOWN_TO, PIECE_BLOCKS
from vaneloop.identification.subsystem import Array, Stage

__all__ = ["Failing", "Sums", "failing", "joined", "of_whole", "sums_of"]


@dataclass(frozen=True, eq=False)
class Sums:
    """Squared errors of a stage, in squared noise floors, by block of the log's raster.

    first     number of the first block
    floor     noise floor of each output, in its unit
    samples   of each output and block, float64[outputs, blocks]
    expected  squared error that the raster makes expect there, likewise
    squares   the same with each parameter set, float64[sets, outputs, blocks]
    uneven    the expected error was drawn, and is known as well as that
    """

    stage: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    floor: Array
    first: int
    samples: Array
    expected: Array
    squares: Array
    uneven: bool

    def rms(self) -> Array:
        """Error of every output with every parameter set, in noise floors: float64[sets, outputs]."""
        return np.asarray(np.sqrt(self.squares.sum(axis=2) / np.maximum(self.samples.sum(axis=1), 1.0)))

    def total(self) -> Array:
        """Error of all outputs together with every parameter set, in noise floors: float64[sets]."""
        return np.asarray(np.sqrt(self.squares.sum(axis=(1, 2)) / max(float(self.samples.sum()), 1.0)))


def sums_of(stage: Stage, floor: Array, thetas: Array, first: int, behind: int, rows: int) -> Sums:
    """Sums of a stage on a stretch of a log, of the blocks from ``first`` to before ``behind``.

    rows  of the log's raster in a block; row 0 is at t = 0
    """
    judge = LeastSquaresProblem(stage, floor)
    dt = float(stage.t[1] - stage.t[0])
    block = (stage.t / dt + 0.5).astype(int) // rows - first
    use = (block >= 0) & (block < behind - first)

    def summed(values: Array) -> Array:
        return np.array([np.bincount(block[use], v[use], behind - first) for v in values])

    errors = judge.errors(thetas)
    return Sums(
        stage.name, stage.outputs, stage.units, judge.floor, first, summed(judge.valid.astype(float)),
        summed(np.where(judge.valid, judge.lost(), 0.0)), np.array([summed(e * e) for e in errors]),
        stage.lost is not None,
    )  # fmt: skip


def joined(parts: Sequence[Sums]) -> Sums:
    """Sums of stretches, in the order of the log, as those of the log; a stretch may lack some outputs."""
    parts = sorted(parts, key=lambda s: s.first)
    most = max(parts, key=lambda s: len(s.outputs))
    at = [[most.outputs.index(o) for o in s.outputs] for s in parts]
    start, blocks = parts[0].first, parts[-1].first + parts[-1].samples.shape[1] - parts[0].first
    out = [np.zeros((*v.shape[:-2], len(most.outputs), blocks)) for v in (most.samples, most.expected, most.squares)]
    for s, rows in zip(parts, at, strict=True):
        here = np.arange(s.samples.shape[1]) + s.first - start
        for whole, part in zip(out, (s.samples, s.expected, s.squares), strict=True):
            whole[..., np.array(rows)[:, None], here] = part
    return replace(most, first=start, samples=out[0], expected=out[1], squares=out[2])


@dataclass(frozen=True)
class Failing:
    """A time of the log in which a stage fails though it does not elsewhere.

    low, high  s of the log's own time
    error      RMS of the output there, in its unit; ``ratio``: in noise floors
    """

    stage: str
    signal: str
    unit: str
    low: float
    high: float
    error: float
    ratio: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"{self.stage} fails from {self.low:.0f} to {self.high:.0f} s: {self.signal} is off by {self.error:.3g} "
            f"{self.unit}, {self.ratio:.3g} noise floors"
        )


def failing(sums: Sums, level: float, looks: int) -> tuple[Array, Array]:
    """Pieces, of `PIECE_BLOCKS` blocks each, in which a stage with the last parameter set fails; and the error of each
    piece in noise floors: both [outputs, pieces].

    level  mean square error of the last parameter set where it was fitted, in squared noise floors: what it leaves
           everywhere is no matter of one piece
    looks  pieces of all outputs that are looked at, as of `stands_out`
    """
    known = max(1.0, level) * ((1.0 + NOISE_KNOWN_TO) ** 2 if sums.uneven else 1.0)
    hot, ratio = [], []
    for k in range(len(sums.outputs)):
        n, square, floor = (_pieces(v[k]) for v in (sums.samples, sums.squares[-1], sums.expected))
        out, _, mean = stands_out(*_in_one(n, square, floor), known, looks)
        ratio.append(np.sqrt(mean))
        hot.append(out & (ratio[-1] > AGREES * np.sqrt(max(1.0, level))))
    return np.array(hot), np.array(ratio)


def _in_one(n: Array, square: Array, floor: Array) -> tuple[Array, Array, Array]:
    """The worst two blocks of each piece that follow one another, as one: what lasts no longer than a block, a slam or
    a turn of the trend, may lie across their border.
    """
    excess = square - floor
    at = np.argmax(excess[:, :-1] + excess[:, 1:], axis=1)
    pieces = np.arange(len(n))
    out = n.copy(), square.copy(), floor.copy()
    for values in out:
        values[pieces, at] += values[pieces, at + 1]
        values[pieces, at + 1] = 0.0
    return out


def _pieces(blocks: Array) -> Array:
    """Blocks as pieces: float64[pieces, BLOCKS]; what lacks to a whole piece is 0."""
    return np.pad(blocks, (0, -len(blocks) % PIECE_BLOCKS)).reshape(-1, PIECE_BLOCKS)


def of_whole(d: StageDiagnosis, sums: Sums, fails: Sequence[Failing]) -> StageDiagnosis:
    """A stage's answer, found on an excerpt, as the whole log has it: the errors of all of it; "unknown" where what was
    found does not hold there, or where the stage fails at some time though it needs nothing.

    sums  with the parameters before and after
    """
    before, after = sums.total()
    floors = sums.rms()
    out = replace(
        d,
        error_before=floors[0] * sums.floor,
        error_after=floors[1] * sums.floor,
        floor=sums.floor,
        steps=[("nominal", float(before)), *([(" + ".join(d.final.effects), float(after))] if d.final.effects else [])],
        excess=float(after),
    )
    if d.verdict == "unknown" or d.criterion != "noise_floor":
        return out
    names, why, decisions = d.final.effects, "", Decisions(d.decisions)
    worst, n = float(floors[1].max()), int(sums.samples.sum())
    left = Remainder(float(before), float(after), worst, len(names), n, d.correlation)
    if not decisions.decide([EXPLAINS_HALF], left, names, ()):
        share = max(left.explained, 0.0)
        why = f"over the whole log {' and '.join(names)} explains {share:.0%} of what exceeds the noise"
    elif not decisions.decide(LEAVES_LITTLE, left, names, ()):
        why = f"leaves {after:.3g} noise floors over the whole log"
    out.decisions = list(decisions)
    if fails and (why or not names):
        why = "; ".join(filter(None, [why, *map(str, fails)]))
    if not why:
        return out
    return replace(out, verdict="unknown", effects=[], nearest=list(names) or d.nearest, refused=[*d.refused, why])
