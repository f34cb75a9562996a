"""Very long logs: an excerpt that has been wherever the log has been is fitted, and what was found is held against all
of the log, stretch by stretch.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hil.logs import LogError
from vaneloop.base.side_by_side import forks, in_processes
from vaneloop.identification.chunked_residuals import Failing, Sums, failing, joined, of_whole, sums_of
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.regimes import Located
from vaneloop.identification.results import StageDiagnosis, rms_of, weigh
from vaneloop.identification.selection.subsampled_search import spread
from vaneloop.identification.settings import PIECE_BLOCKS
from vaneloop.identification.subsystem import Array, Stage
from vaneloop.identification.workflow import Diagnosis, News, locate_stages, verdict_of
from vaneloop.identification.workflow import diagnose as search

if TYPE_CHECKING:
    from hil.logs import Log
    from vaneloop.identification.vane_chain.chain import Chain
    from vaneloop.identification.vane_chain.resample import Grid

__all__ = [
    "LONG", "Held", "Whole", "carried", "changed", "excerpted", "held_against", "held_results", "located", "searched",
]  # fmt: skip

LONG = 360_000  # rows, an hour at 100 Hz; a log with more is fitted on an excerpt
FITTED = 120_000  # rows of an excerpt, half of them evenly spaced: three times what a stage is searched on
BLOCK = 10.0  # s, the memory of the stages
PIECE = PIECE_BLOCKS * BLOCK  # s: an excerpt is made of such pieces, of which the first 3 s are forgotten
STRETCH = 16  # pieces that are held against the model at one time; bounds what is in memory
LEAD = 30.0  # s before a stretch that are simulated with it: play and lags then know where they are
FAST = 0.1  # s between two looks at what the log visits
BINS = 8  # of each condition's range
SEEN = 30  # looks (3 s) in a bin that make it visited
ROUNDS = 1  # searches more, where the whole log fails and the excerpt did not
MORE = 10  # pieces that are added then, half as many as the excerpt has
ONE_DRAW = 1  # of what the log hides from the servo, where its noise floor is known


@dataclass(frozen=True)
class Whole:
    """A long log of which an excerpt has been put into stages.

    bind    function from pieces of rows to their stages
    chosen  numbers of the pieces of the excerpt
    """

    log: Log
    grid: Grid
    bind: Callable[..., Chain]
    chosen: tuple[int, ...] = ()

    @property
    def rows(self) -> int:
        """Of a piece."""
        return self.grid.window * round(PIECE)

    @property
    def pieces(self) -> int:
        """Whole ones that the log has."""
        return self.grid.rows // self.rows

    def time(self, piece: int) -> float:
        """When a piece begins, or the log ends before it, s of the log's own time."""
        return float(self.grid.start + min(piece * self.rows, self.grid.rows) * self.grid.dt)

    def chain(self, chosen: Sequence[int]) -> Chain:
        """The stages of these pieces."""
        rows, end = self.rows, self.grid.rows
        chain = self.bind(_runs([(k * rows, min((k + 1) * rows, end)) for k in chosen]))
        return replace(chain, whole=replace(self, chosen=tuple(chosen)), notes=[self.note(chosen), *chain.notes])

    def note(self, chosen: Sequence[int]) -> str:
        """What is fitted, in words."""
        fitted, seconds = len(chosen) * PIECE, self.grid.rows * self.grid.dt
        return (
            f"a long log: {fitted:,.0f} s of {seconds:,.0f} are fitted, in pieces of {PIECE:.0f} s that cover its "
            f"whole operating range; the result is checked on all of it"
        )

    def changed(self, change: Callable[[Chain], Chain]) -> Whole:
        """The same log, whose stages are ``change``d."""
        return replace(self, bind=lambda *pieces, **few: change(self.bind(*pieces, **few)))

    def with_more(self, pieces: Iterable[int]) -> Chain:
        """The stages with these pieces besides."""
        return self.chain(sorted({*self.chosen, *pieces}))


def excerpted(log: Log, grid: Grid, stages_of: Callable[..., Chain], fitted: int = FITTED) -> Chain:
    """The stages of an excerpt of a long log, of about so many rows (``fitted``). What stands late in the excerpt does
    so in all of the log.

    stages_of  function from the log, its grid and pieces of rows to their stages (`Machine.stages_of`)
    """
    whole = Whole(log, grid, partial(stages_of, log, grid))
    chain = whole.chain(_everywhere(whole, spread(whole.pieces, max(2, fitted // whole.rows), ())))
    return replace(chain, whole=replace(chain.whole, bind=partial(whole.bind, late=chain.late)))


def _runs(pieces: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Pieces of rows, those that follow one another in one."""
    out: list[tuple[int, int]] = []
    for first, behind in pieces:
        if out and out[-1][1] == first:
            out[-1] = out[-1][0], behind
        else:
            out.append((first, behind))
    return out


# ---- what a log visits -----------------------------------------------------------------------------------------------


def _everywhere(whole: Whole, chosen: Sequence[int]) -> list[int]:
    """The pieces that are ``chosen``, and more until they have been wherever the log has been, in every bin of every
    condition and each direction of the stroke: always the one that adds most.
    """
    visits = _visits(whole)
    missing = np.where(visits.sum(axis=0) >= SEEN, float(SEEN), 0.0)
    out = list(chosen)
    for k in out:
        missing = np.maximum(missing - visits[k], 0.0)
    visits[out] = 0.0
    while missing.any():
        out.append(int(np.argmax(np.minimum(visits, missing).sum(axis=1))))
        missing = np.maximum(missing - visits[out[-1]], 0.0)
        visits[out[-1]] = 0.0
    return sorted(out)


def _visits(whole: Whole) -> Array:
    """How often each piece is looked at in each cell of the conditions: float64[pieces, cells].

    A cell is one of `BINS` bins of a condition's range, the piston retracting, at rest or extending.
    """
    looks = round(PIECE / FAST)
    t = whole.grid.start + FAST * np.arange(whole.pieces * looks)
    seen = {n: np.interp(t, c.t, c.values) for n, c in whole.log.channels.items() if len(c.t) > 1 and n != "state"}
    direction = np.zeros(len(t), dtype=int)
    stroke = seen.get("x_lvdt", seen.get("x_dem"))
    if stroke is not None:
        speed = np.gradient(stroke, FAST)
        direction = np.sign(np.where(np.abs(speed) > 0.2, speed, 0.0)).astype(int)
        seen["stroke speed"] = speed
    piece = np.arange(len(t)) // looks
    out = []
    for values in seen.values():
        low, high = float(values.min()), float(values.max())
        if high > low:
            cell = 3 * np.minimum((BINS * (values - low) / (high - low)).astype(int), BINS - 1) + direction + 1
            counts = np.bincount(3 * BINS * piece + cell, minlength=3 * BINS * whole.pieces)
            out.append(counts.reshape(whole.pieces, 3 * BINS))
    return np.concatenate(out, axis=1).astype(float) if out else np.zeros((whole.pieces, 1))


# ---- the whole log ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Held:
    """What an excerpt's fits say of the whole log.

    sums     stage -> its errors, with each of the parameter sets
    failing  times in which a stage fails with the last of them, and did not where it was fitted
    pieces   numbers of the pieces in these times, the worst first
    fitted   of the log, from and to, s of its own time
    """

    sums: dict[str, Sums] = field(repr=False)
    failing: list[Failing]
    pieces: tuple[int, ...]
    fitted: list[tuple[float, float]]

    def json(self) -> dict[str, Any]:
        """What was fitted, and where it does not hold, as the commands' JSON."""
        return {"fitted_s": self.fitted, "failing": [asdict(f) for f in self.failing]}

    def of(self, stage: str) -> list[Failing]:
        """Times in which a stage fails."""
        return [f for f in self.failing if f.stage == stage]


class Work(NamedTuple):
    """What a stretch of a log is held against: its subsystems, the parameters to try and noise floors."""

    whole: Whole
    chain: Chain
    fits: dict[str, tuple[Array, Array]]


def held_against(
    chain: Chain,
    fits: Sequence[tuple[str, Sequence[Array], Array, float]],
    workers: int = 2,
    progress: Callable[[float], None] | None = None,
) -> Held:
    """Hold fits of an excerpt against the whole log, stretch by stretch, in ``workers`` processes where the system can
    fork.

    fits  stage, parameters to try (those found last), noise floor, mean square error that these leave where they were
          fitted, in squared noise floors
    """
    whole = chain.whole
    work = Work(whole, chain, {name: (np.array(thetas), floor) for name, thetas, floor, _ in fits})
    pieces = -(-whole.grid.rows // whole.rows)  # the last one may be short
    many = -(-pieces // STRETCH)
    parts: dict[str, list[Sums]] = {}

    def take(k: int, found: list[Sums]) -> None:
        for s in found:
            parts.setdefault(s.stage, []).append(s)
        if progress:
            progress((k + 1) / many)

    if forks(workers, many):
        with in_processes(_stretch, work, workers) as submit:
            for k, job in enumerate([submit(k) for k in range(many)]):
                take(k, job.result())
    else:
        for k in range(many):
            take(k, _stretch(work, k))
    sums = {name: joined(found) for name, found in parts.items()}
    looks = sum(len(s.outputs) * pieces for s in sums.values())
    out: list[Failing] = []
    worst = np.zeros(pieces)
    for name, _, _, level in fits:
        if name in sums:
            hot, ratio = failing(sums[name], level, looks)
            at = np.arange(hot.shape[1]) + sums[name].first // PIECE_BLOCKS
            worst[at] = np.maximum(worst[at], np.where(hot, ratio, 0.0).max(axis=0))
            out += _times(whole, sums[name], hot, ratio)
    fail = [int(k) for k in np.argsort(-worst, kind="stable") if worst[k] > 0.0]
    runs = _runs([(k, k + 1) for k in whole.chosen])
    return Held(sums, out, tuple(fail), [(whole.time(a), whole.time(b)) for a, b in runs])


def _times(whole: Whole, sums: Sums, hot: Array, ratio: Array) -> list[Failing]:
    """Failing pieces that follow one another as one time, told by the output that is worst there."""
    at = np.flatnonzero(hot.any(axis=0))
    out = []
    for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if at.size else []:
        mean = np.sqrt(np.mean(np.where(hot[:, run], ratio[:, run], 0.0) ** 2, axis=1))
        k = int(np.argmax(mean))
        first = sums.first // PIECE_BLOCKS
        low, high = whole.time(first + int(run[0])), whole.time(first + int(run[-1]) + 1)
        unit, error = sums.units[k], float(mean[k] * sums.floor[k])
        out.append(Failing(sums.stage, sums.outputs[k], unit, low, high, error, float(mean[k])))
    return out


def _stretch(work: Work, k: int) -> list[Sums]:
    """Sums of one stretch of the log at work."""
    whole, chain, fits = work
    rows, block = whole.rows, whole.rows // PIECE_BLOCKS
    first, behind = k * STRETCH * rows, min((k + 1) * STRETCH * rows, whole.grid.rows)
    lead = whole.grid.window * round(LEAD)
    try:
        here = whole.bind([(max(first - lead, 0), behind)], draws=ONE_DRAW)
    except LogError:  # nothing can be judged here
        return []
    out = []
    for stage in here.stages:
        if stage.name not in fits:
            continue
        thetas, floor = fits[stage.name]
        of = chain.stage(stage.name)
        stage.floor = np.array([floor[of.outputs.index(o)] for o in stage.outputs])
        moved = np.array([carried(of, theta, stage) for theta in thetas])
        out.append(sums_of(stage, stage.floor, moved, first // block, -(-behind // block), block))
    del here, stage
    gc.collect()  # a stage and its functions hold each other
    return out


def carried(here: Stage, theta: Array, there: Stage) -> Array:
    """Parameters of one stage as another's of the same machine."""
    out = there.neutral()
    names = [p.name for p in here.parameters]
    for i, p in enumerate(there.parameters):
        if p.name in names:
            out[i] = theta[names.index(p.name)]
    mine = here.index()
    for name, columns in there.index().items():
        if name in mine:
            out[columns] = theta[mine[name]]
    return out


# ---- verbs -----------------------------------------------------------------------------------------------------------


def searched(
    chain: Chain,
    workers: int = 2,
    progress: Callable[[float], None] | None = None,
    news: Callable[[News], None] | None = None,
) -> tuple[Chain, Diagnosis, Held]:
    """The diagnosis of a long log, the stages of the excerpt that it rests on, and what all of the log says of it.

    Where the log fails in pieces that the excerpt has not, these are added to it and the search goes on.
    """
    started = time.perf_counter()
    for again in range(ROUNDS + 1):
        done = again / (ROUNDS + 1.0)

        def tell(fraction: float, text: str = "", found: Any = None, done: float = done) -> None:
            if progress:
                progress(done + fraction / (ROUNDS + 1.0))
            if news:
                news(News(done + fraction / (ROUNDS + 1.0), text, found))

        d = search(
            chain.stages, chain.not_observed, None, workers, news=lambda n: tell(0.6 * n.fraction, n.text, n.found)
        )
        held = _held(chain, d.stages, workers, lambda f: tell(0.6 + 0.4 * f, "checking the whole log"))
        new = [k for k in held.pieces if k not in chain.whole.chosen][:MORE]
        if again == ROUNDS or not new:
            break
        gc.collect()
        chain = chain.whole.with_more(new)
    stages = _of_all(held, d.stages)
    for s in stages:
        weigh(s)
    elapsed = time.perf_counter() - started
    return chain, replace(d, verdict=verdict_of(stages), stages=stages, elapsed_s=elapsed), held


def held_results(chain: Chain, results: list[StageDiagnosis]) -> tuple[list[StageDiagnosis], Held]:
    """Answers of a long log's excerpt with the errors of all of it."""
    held = _held(chain, results, 2, None)
    return _of_all(held, results), held


def _held(
    chain: Chain, results: Sequence[StageDiagnosis], workers: int, progress: Callable[[float], None] | None
) -> Held:
    fits = [(s.stage, (s.base.theta, s.final.theta), s.floor, s.excess**2) for s in results]
    return held_against(chain, fits, workers, progress)


def _of_all(held: Held, results: Sequence[StageDiagnosis]) -> list[StageDiagnosis]:
    return [of_whole(s, held.sums[s.stage], held.of(s.stage)) if s.stage in held.sums else s for s in results]


def changed(chain: Chain, change: Callable[[Chain], Chain]) -> Chain:
    """A chain whose stages are ``change``d, those of its test and of all the log as well."""
    whole = chain.whole and chain.whole.changed(change)
    return replace(change(chain), test=chain.test and changed(chain.test, change), whole=whole)


def located(
    chain: Chain, progress: Callable[[float, str], None] | None = None, workers: int = 2
) -> tuple[list[Located], Held | None]:
    """Every stage with nothing added; of a long log the errors of all of it, and where it fails and its excerpt does
    not.
    """
    out = locate_stages(chain.stages, progress)
    if chain.whole is None:
        return out, None
    fits = []
    for x in out:
        judge = LeastSquaresProblem(chain.stage(x.stage), x.floor)
        fits.append((x.stage, (judge.stage.neutral(), x.fit.theta), x.floor, rms_of(judge, x.fit) ** 2))
    held = held_against(chain, fits, workers)
    for k, x in enumerate(out):
        if x.stage in held.sums:
            s = held.sums[x.stage]
            given, fitted = s.rms() * s.floor
            n = s.samples.sum(axis=1)
            signals = tuple(
                replace(f, rms=float(fitted[i]), rms_as_given=float(given[i]), samples=int(n[i]))
                for f in x.signals for i in [s.outputs.index(f.signal)]
            )  # fmt: skip
            out[k] = replace(x, signals=signals)
    return out, held
