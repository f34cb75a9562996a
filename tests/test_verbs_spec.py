"""Verbs by their specification: parts and records of logs, long logs, law files, what is refused, what answers hold."""

from __future__ import annotations

import math
import struct
from base64 import b64decode
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.logs import Channel, Log, LogError
from plant import Model, write_model
from plant.model import Learned as Table
from vaneloop.base.errors import InputError
from vaneloop.base.spans import Span
from vaneloop.identification import Record, StageError, System
from vaneloop.identification.chunked_residuals import Failing, Sums
from vaneloop.identification.least_squares.problem import LeastSquaresProblem, recalibrate
from vaneloop.identification.onset import Onset
from vaneloop.identification.settings import PIECE_BLOCKS
from vaneloop.identification.subsystem import Effect, Parameter, Stage
from vaneloop.identification.unmodelled.fitted_candidate import Outcome
from vaneloop.verbs import answer as answer_verb
from vaneloop.verbs import learn, long, parts, search
from vaneloop.verbs import replay as replay_verb
from vaneloop.verbs.answer import Answer
from vaneloop.verbs.curves import Curves, curves_of_logs, curves_of_stages
from vaneloop.verbs.estimates import COLUMNS, Fitted, NoParameter, correlation_of, parameters_of
from vaneloop.verbs.long import Held, Whole
from vaneloop.verbs.machine import TABLES, Machine, files_of, with_law_files
from vaneloop.verbs.replay import brief

# ---- parts of logs ---------------------------------------------------------------------------------------------------

T = np.arange(11) * 1.0


def record(**columns: Any) -> Record:
    """Eleven samples, a second apart, that begin at 3 s."""
    return Record("r", T + 3.0, {"y": T * 2.0, "constant": np.array([7.0])} | columns, 100.0)


def test_what_is_fitted_and_what_tests_are_told_apart() -> None:
    a, b = Span(0.0, 5.0), Span(5.0, 9.0)
    assert parts.split("0:5", "5:9") == ([a], [b], []) and parts.split((0, 5), [(5, 9), "x.csv"]) == (
        [a],
        [b],
        ["x.csv"],
    )
    assert parts.split((), ["x.csv", "y.csv"]) == ([], [], ["x.csv", "y.csv"])
    assert parts.split((), "x.csv") == ([], [], ["x.csv"]) and parts.split((), ()) == ([], [], [])
    one = record()
    assert parts.split((), one) == ([], [], [one])
    with pytest.raises(InputError, match="parts must not overlap"):
        parts.split("0:6", "5:9")


def test_a_part_of_a_record_is_one_of_its_own() -> None:
    whole = record()
    assert parts.records_of(whole, []) == [whole]
    first, second = parts.records_of(whole, [Span(-math.inf, 5.0), Span(5.0, 8.0)])
    assert first.name == "r :5" and first.t.tolist() == [3.0, 4.0] and first.begin == 100.0
    assert second.t.tolist() == [5.0, 6.0, 7.0] and second.columns["y"].tolist() == [4.0, 6.0, 8.0]
    assert second.begin == 102.0 and second.columns["constant"].tolist() == [7.0]
    for span, count in ((Span(5.0, 6.0), 1), (Span(50.0, 60.0), 0)):
        with pytest.raises(InputError, match=rf"r: {count} samples in '.*'; the log is from 3 to 13 s"):
            parts.records_of(whole, [span])
    assert len(parts.records_of(whole, [Span(5.0, 6.5)])[0].t) == 2


def test_a_part_of_a_log_has_its_channels_that_have_two_samples_there() -> None:
    log = Log("a.csv", {"n_dem": Channel(T, 60.0 + T), "p_s": Channel(T[::5], 20.0 + T[::5], framed=True)})
    assert parts.part_of(log, []) is log
    part = parts.part_of(log, [Span(0.0, 2.0), Span(4.0, 6.0)])
    assert part.channels["n_dem"].t.tolist() == [0.0, 1.0, 4.0, 5.0] and part.path == "a.csv"
    assert part.channels["n_dem"].values.tolist() == [60.0, 61.0, 64.0, 65.0]
    assert part.channels["p_s"].t.tolist() == [0.0, 5.0] and part.channels["p_s"].framed
    assert list(parts.part_of(log, [Span(4.0, 9.0)]).channels) == ["n_dem"]  # one sample is none
    with pytest.raises(InputError, match="a.csv: 1 samples in '4:5'; the log is from 0 to 10 s"):
        parts.part_of(log, [Span(0.0, 3.0), Span(4.0, 5.0)])


def test_stages_of_the_parts_that_test_stand_beside_those_that_are_fitted() -> None:
    log = Log("a.csv", {"n_dem": Channel(T, 60.0 + T)})
    machine: Any = SimpleNamespace(bind=lambda part: SimpleNamespace(of=part, test=None))
    fitted = parts.bind_parts(machine, log, [Span(0.0, 5.0)], [Span(5.0, 9.0)])
    assert fitted.of.channels["n_dem"].t[-1] == 4.0 and fitted.test.of.channels["n_dem"].t.tolist() == [
        5.0,
        6.0,
        7.0,
        8.0,
    ]
    assert parts.bind_parts(machine, log, [], []).test is None


def stage(name: str, outputs: tuple[str, ...] = ("y",), **more: Any) -> Stage:
    """A stage whose outputs are its first parameter plus its effect's."""
    measured = np.array([10.0 + T * 0.0 for _ in outputs])
    parameters = (Parameter("k", 1.0, "-", tolerance=9.0), Parameter(f"of_{name}", 0.0, "-", tolerance=9.0))
    effect = Effect("bend", (Parameter("size", 0.0, "mm", -9.0, 9.0),), ((1.0,),))

    def run(thetas: np.ndarray) -> np.ndarray:
        return np.repeat((thetas[:, :1] + thetas[:, 2:3])[:, :, None] * np.ones(len(T)), len(outputs), axis=1)

    given = {"name": name, "outputs": outputs, "units": ("mm",) * len(outputs), "parameters": parameters,
             "effects": (effect,), "run": run, "t": T, "measured": measured, "window": None,
             "floor": np.full(len(outputs), 0.5)}  # fmt: skip
    return Stage(**(given | more))


def fit(k: float, size: float) -> Any:
    """Parameters as they were fitted."""
    return SimpleNamespace(theta=np.array([k, 5.0, size]))


def test_fits_are_held_against_the_part_that_they_have_not_seen() -> None:
    measured = np.array([np.where(np.arange(11) < 3, np.nan, 10.0), np.full(11, 12.0)])
    other = stage("b")
    other = replace(other, effects=(replace(other.effects[0], name="other"),))
    chain: Any = SimpleNamespace(stages=[other, stage("a", ("y", "z"))], test=None)
    fits = [("a", fit(7.0, 0.0), fit(7.0, 2.0)), ("b", fit(1.0, 0.0), fit(1.0, 0.0))]
    assert parts.tested(chain, fits) == [] and parts.tested(SimpleNamespace(stages=[]), fits) == []
    chain.test = SimpleNamespace(stages=[stage("a", ("y", "z"), measured=measured)], whole=None)
    y, z = parts.tested(chain, fits)  # the log shows no stage b there
    assert (y.stage, y.signal, y.unit, y.samples, y.noise_floor) == ("a", "y", "mm", 8, 0.5)
    assert (y.error_before, y.error_after) == (pytest.approx(3.0), pytest.approx(1.0))
    assert (z.error_before, z.error_after, z.samples) == (pytest.approx(5.0), pytest.approx(3.0), 11)


def test_parameters_are_carried_by_their_names() -> None:
    here, there = stage("a"), stage("b")
    assert long.carried(here, np.array([7.0, 5.0, 2.0]), there).tolist() == [7.0, 0.0, 2.0]
    other = replace(there, effects=(replace(there.effects[0], name="other"),))
    assert long.carried(here, np.array([7.0, 5.0, 2.0]), other).tolist() == [7.0, 0.0, 0.0]


# ---- records of systems ----------------------------------------------------------------------------------------------


def system(**more: Any) -> System:
    """A system of one input and two outputs."""
    given = {"name": "pump", "kind": "static", "model": lambda u, p: (u.u, u.u), "inputs": {"u": "V"},
             "outputs": {"y": "mm", "z": "mm"}}  # fmt: skip
    return System(**(given | more))


def test_a_log_of_a_system_is_on_the_raster_of_its_output_with_most_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    slow, fine = np.arange(6) * 0.2, np.arange(21) * 0.05
    gap = fine[(fine < 0.3) | (fine > 0.62)]
    log = SimpleNamespace(path="logs/r.csv", notes=["read"], ordered=True, channels={
        "u": Channel(slow, slow, framed=True), "y": Channel(fine, fine**2), "z": Channel(gap, 2.0 * gap),
        "one": Channel(np.array([0.5]), np.array([3.0])),
    })  # fmt: skip
    asked: list[Any] = []
    monkeypatch.setattr(parts, "read_log", lambda path, **how: asked.append((path, how)) or log)
    found, notes = parts.read_record("logs/r.csv", system(), design_rpm=5000.0)
    signals = {"u": "V", "y": "mm", "z": "mm"}
    how = {"design_rpm": 5000.0, "require": list(signals), "signals": signals, "rows": True}
    assert asked == [("logs/r.csv", how)]
    assert (found.name, found.begin, notes) == ("r.csv", 0.0, ["r.csv: read"]) and found.t == pytest.approx(fine)
    assert found.columns["u"] == pytest.approx(fine) and found.columns["y"] == pytest.approx(fine**2)
    assert found.columns["one"].tolist() == [3.0] * 21
    z = found.columns["z"]
    far = np.array([min(abs(gap - t)) > 0.075 for t in fine])
    assert np.isnan(z[far]).all() and z[~far] == pytest.approx(2.0 * fine[~far]) and far.sum() == 5
    simulated = system(kind="simulate", states={"y": "mm", "z": "mm"}, model=lambda x, u, p: (u.u, u.u))
    held = parts.read_record("r.csv", simulated)[0].columns["u"]  # a value holds from its frame on
    assert held == pytest.approx(np.floor(fine / 0.2 + 1e-9) * 0.2)
    log.channels["u"] = replace(log.channels["u"], framed=False)
    assert parts.read_record("r.csv", simulated)[0].columns["u"] == pytest.approx(fine)


def test_a_system_s_own_reader_is_asked_and_its_complaints_told(tmp_path: Path) -> None:
    at = tmp_path / "x.bin"
    at.write_text("data")
    read = {"t": [0.0, 1.0], "u": [1, 2], 3: np.array([4.0, 5.0])}
    found, notes = parts.read_record(at, system(read=lambda path: read if path == str(at) else None))
    assert found.t.tolist() == [0.0, 1.0] and found.columns["u"].dtype == float and "3" in found.columns and notes == []
    with pytest.raises(StageError, match="no such file"):
        parts.read_record(tmp_path / "none", system(read=lambda _: read))
    for made, says in (
        (lambda _: 1 / 0, r"read\(\) of system 'pump' failed: ZeroDivisionError: division by zero"),
        (lambda _: {"u": [1.0]}, "returned u; a time 't' is needed"), (lambda _: {}, "returned nothing; a time"),
        (lambda _: {"t": ["a"]}, "not numbers"),
    ):  # fmt: skip
        with pytest.raises(StageError, match=says):
            parts.read_record(at, system(read=made))


# ---- long logs -------------------------------------------------------------------------------------------------------


@dataclass
class Grid:
    """A raster: a row a tenth of a second, ten to a second's window."""

    start: float = 50.0
    dt: float = 0.1
    rows: int = 0
    window: int = 10


PIECE_ROWS = 600  # of 60 s


@dataclass
class Stages:
    """Stands for the stages of some rows."""

    rows: list[tuple[int, int]]
    draws: Any = None
    notes: tuple[str, ...] = ("own",)
    whole: Any = None
    stages: Any = ()
    test: Any = None
    late: Any = None


def whole_of(pieces: float, channels: dict[str, Channel] | None = None, chosen: Sequence[int] = ()) -> Whole:
    """A long log of so many pieces of 60 s."""
    log: Any = SimpleNamespace(channels=channels or {})
    bind: Any = lambda rows, draws=None: Stages(rows, draws)  # noqa: E731
    grid: Any = Grid(rows=int(pieces * PIECE_ROWS))
    return Whole(log, grid, bind, tuple(chosen))


def test_pieces_of_a_long_log_are_a_minute() -> None:
    assert (long.LONG, long.FITTED, long.PIECE, long.STRETCH, long.LEAD) == (360_000, 120_000, 60.0, 16, 30.0)
    whole = whole_of(7.5)
    assert (whole.rows, whole.pieces) == (PIECE_ROWS, 7)
    assert [whole.time(k) for k in (0, 2, 7, 8)] == pytest.approx([50.0, 170.0, 470.0, 500.0])
    chain: Any = whole.chain((0, 1, 4, 7))
    assert chain.rows == [(0, 1200), (2400, 3000), (4200, 4500)]  # what follows one another is one; the last is short
    assert chain.whole.chosen == (0, 1, 4, 7)
    assert (
        chain.notes[0].startswith("a long log: 240 s of 450 are fitted, in pieces of 60 s") and chain.notes[1] == "own"
    )
    more: Any = chain.whole.with_more([5, 1])
    assert more.rows == [(0, 1200), (2400, 3600), (4200, 4500)] and more.whole.chosen == (0, 1, 4, 5, 7)
    doubled: Any = whole.changed(lambda c: replace(c, notes=("changed",)) if isinstance(c, Stages) else c).chain((2,))
    assert doubled.notes[1] == "changed" and doubled.rows == [(1200, 1800)]


def test_runs_are_joined_where_they_touch() -> None:
    assert long._runs([(0, 1), (1, 2), (3, 4), (4, 6), (7, 8)]) == [(0, 2), (3, 6), (7, 8)] and long._runs([]) == []


def at_levels(levels: Sequence[float], **more: Sequence[float]) -> dict[str, Channel]:
    """Channels that stay for 60 s at each level."""
    t = 50.0 + np.arange(len(levels) * 600) * 0.1
    return {n: Channel(t, np.repeat(np.asarray(v, dtype=float), 600)) for n, v in {"n_r": levels, **more}.items()}


def test_what_a_piece_visits_is_counted_by_condition_and_direction() -> None:
    channels = at_levels([0.0, 8.0, 4.0]) | {"state": Channel(np.array([50.0, 51.0]), np.array([1.0, 2.0]))}
    channels["one"] = Channel(np.array([50.0]), np.array([1.0]))
    visits = long._visits(whole_of(3, channels))
    assert visits.shape == (3, 24) and visits.sum(axis=1).tolist() == [600.0] * 3
    for piece, bin_ in enumerate((0, 7, 4)):
        assert visits[piece, 3 * bin_ + 1] >= 595.0  # at rest; a bin has its lower end, the last its upper too
    assert long._visits(whole_of(3)).tolist() == [[0.0]] * 3
    assert long._visits(whole_of(3, at_levels([5.0, 5.0, 5.0]))).tolist() == [[0.0]] * 3


@pytest.mark.parametrize("speed, direction", [(0.3, 2), (-0.3, 0), (0.15, 1), (0.0, 1)])
def test_a_stroke_that_moves_faster_than_a_fifth_of_a_millimetre_a_second_has_a_direction(
    speed: float, direction: int
) -> None:
    t = 50.0 + np.arange(600) * 0.1
    channels = {"x_lvdt": Channel(t, 10.0 + speed * t), "n_r": Channel(t, np.linspace(0.0, 1.0, 600))}
    visits = long._visits(whole_of(1, channels)).reshape(-1, 8, 3)
    assert visits[..., direction].sum() == visits.sum() and len(visits) == (3 if speed else 1)
    only = {"x_dem": channels["x_lvdt"], "n_r": channels["n_r"]}  # without a measured stroke the demanded one
    assert long._visits(whole_of(1, only)).reshape(-1, 8, 3)[..., direction].sum() == visits.sum()


def test_pieces_are_added_until_every_visited_bin_is_in() -> None:
    levels = [0.0, 0.0, 8.0, 0.0, 4.0, 4.0]
    whole = whole_of(6, at_levels(levels))
    assert long._everywhere(whole, [0]) == [0, 2, 4]
    assert long._everywhere(whole, [0, 5]) == [0, 2, 5] and long._everywhere(whole, [0, 2, 4]) == [0, 2, 4]
    for looks, expected in ((29, [0]), (30, [0, 1])):  # 3 s make a bin visited
        channels = at_levels([0.0] * 4)
        channels["n_r"].values[610 : 610 + looks] = 8.0
        assert long._everywhere(whole_of(4, channels), [0]) == expected
    channels = at_levels([0.0] * 4)
    channels["n_r"].values[900:929] = channels["n_r"].values[1500:1501] = 8.0  # 29 looks, and one in the next piece
    assert long._everywhere(whole_of(4, channels), [0]) == [0, 1, 2]
    assert long._everywhere(whole_of(4, channels), [0, 2]) == [0, 1, 2]


def test_an_excerpt_has_half_its_pieces_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(long, "spread", lambda pieces, many, _: asked.append((pieces, many)) or [0])
    stages_of: Any = lambda log, grid, rows, late=None: Stages(rows, late=late or {"engine": "late"})  # noqa: E731
    whole = whole_of(9, at_levels([0.0] * 9))
    for fitted, many in ((3000, 5), (600, 2), (0, 2), (3599, 5)):
        chain: Any = long.excerpted(whole.log, whole.grid, stages_of, fitted)
        assert asked.pop() == (9, many) and chain.rows == [(0, 600)] and chain.whole.chosen == (0,)
    chain = long.excerpted(whole.log, whole.grid, stages_of)
    assert chain.whole.bind.keywords == {"late": chain.late} and chain.late == {"engine": "late"}  # not found anew
    assert asked == [(9, 200)]  # of 120,000 rows


def sums(name: str, hot: Sequence[int], pieces: int, first: int = 0, outputs: tuple[str, ...] = ("y",)) -> Sums:
    """Sums of a stage whose last parameter set fails in the ``hot`` pieces."""
    n = np.full((len(outputs), pieces * PIECE_BLOCKS), 100.0)
    squares = np.repeat(n[None], 2, axis=0).copy()
    for piece in hot:
        squares[1, 0, piece * PIECE_BLOCKS : (piece + 1) * PIECE_BLOCKS] = 900.0 + 100.0 * piece
    return Sums(name, outputs, ("mm",) * len(outputs), np.full(len(outputs), 0.5), first, n, n.copy(), squares, False)


def test_a_log_is_held_stretch_by_stretch_and_what_fails_told_by_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    pieces = 2 * long.STRETCH + 3
    asked: list[int] = []

    def stretch(work: long.Work, k: int) -> list[Sums]:
        asked.append(k)
        whole, chain, fits = work
        assert whole.pieces == pieces and chain is held_chain and list(fits) == ["a", "b"]
        assert fits["a"][0].tolist() == [[1.0], [2.0]] and fits["a"][1].tolist() == [0.5]
        here = long.STRETCH if k < 2 else 4
        hot = {0: [2, 3, 7], 2: [1]}.get(k, [])
        return [
            sums("a", hot, here, k * long.STRETCH * PIECE_BLOCKS),
            sums("b", [], here, k * long.STRETCH * PIECE_BLOCKS),
        ]

    looked: list[tuple[float, int]] = []
    judged = long.failing
    monkeypatch.setattr(long, "_stretch", stretch)
    monkeypatch.setattr(
        long, "failing", lambda s, level, looks: looked.append((level, looks)) or judged(s, level, looks)
    )
    held_chain: Any = SimpleNamespace(whole=whole_of(pieces + 0.5, chosen=(0, 1, 5)))
    told: list[float] = []
    fits = [(n, [np.array([1.0]), np.array([2.0])], np.array([0.5]), 1.0) for n in ("a", "b")]
    held = long.held_against(held_chain, fits, workers=1, progress=told.append)
    assert asked == [0, 1, 2] and told == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert [(f.stage, f.signal, f.unit, f.low, f.high) for f in held.failing] == [
        ("a", "y", "mm", 170.0, 290.0), ("a", "y", "mm", 470.0, 530.0), ("a", "y", "mm", 2030.0, 2090.0),
    ]  # fmt: skip
    assert held.failing[0].ratio == pytest.approx(math.sqrt((11.0 + 12.0) / 2.0))
    assert held.failing[0].error == pytest.approx(0.5 * held.failing[0].ratio)
    assert held.pieces == (7, 3, 2, 2 * long.STRETCH + 1)  # the worst first
    assert held.fitted == [(50.0, 170.0), (350.0, 410.0)] and set(held.sums) == {"a", "b"}
    assert held.of("a") == held.failing and held.of("b") == [] and looked == [(1.0, 2 * (pieces + 1))] * 2
    assert held.json()["fitted_s"] == held.fitted and held.json()["failing"][0]["low"] == 170.0


def test_a_stretch_is_simulated_with_what_leads_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = whole_of(20)
    asked: list[Any] = []

    def bind(rows: Any, draws: Any) -> Any:
        asked.append((rows, draws))
        if rows[0][0] == 0 and len(asked) > 1:
            raise LogError("nothing can be judged")
        return SimpleNamespace(stages=[stage("a", ("z",)), stage("not asked")])

    made: list[Any] = []
    monkeypatch.setattr(long, "sums_of", lambda *a: made.append(a) or "sums")
    chain: Any = SimpleNamespace(stage=lambda name: stage(name, ("y", "z")))
    thetas = np.array([[7.0, 5.0, 2.0]])
    work = long.Work(replace(whole, bind=bind), chain, {"a": (thetas, np.array([0.25, 0.75]))})
    assert long._stretch(work, 1) == ["sums"]
    assert asked == [([(9600 - 300, 12_000)], 1)]
    of, floor, moved, first, behind, block = made[0]
    assert of.name == "a" and floor.tolist() == [0.75] == of.floor.tolist() and moved.tolist() == [[7.0, 5.0, 2.0]]
    assert (first, behind, block) == (96, 120, 100)
    assert long._stretch(work, 0) == [] and asked[1][0] == [(0, 9600)]


def test_a_search_goes_on_once_where_the_whole_log_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[tuple[int, ...]] = []
    told: list[float] = []
    words: list[Any] = []
    weighed: list[Any] = []

    def found(stages: Any, not_observed: Any, _: Any, workers: int, news: Any) -> Any:
        chosen.append(stages)
        news(SimpleNamespace(fraction=0.5, text="tries", found="f"))
        return Found(["stage"])

    @dataclass
    class Found:
        stages: list[Any]
        verdict: str = "first"
        elapsed_s: float = -1.0

    def held(chain: Any, stages: Any, workers: int, progress: Any) -> Any:
        progress(0.5)
        return SimpleNamespace(pieces=tuple(range(3, 30)), sums={})

    class Excerpt:
        def __init__(self, pieces: tuple[int, ...]):
            self.stages, self.not_observed = pieces, {}
            self.whole = SimpleNamespace(chosen=pieces, with_more=lambda new: Excerpt((*pieces, *new)))

    monkeypatch.setattr(long, "search", found)
    monkeypatch.setattr(long, "_held", held)
    monkeypatch.setattr(long, "_of_all", lambda held, stages: [f"all {s}" for s in stages])
    monkeypatch.setattr(long, "weigh", weighed.append)
    monkeypatch.setattr(long, "verdict_of", lambda stages: f"verdict of {stages}")
    chain, d, _ = long.searched(Excerpt((3, 9)), 2, told.append, words.append)
    new = tuple(k for k in range(3, 30) if k not in (3, 9))[:10]
    assert chosen == [(3, 9), (3, 9, *new)] and chain.stages == chosen[1]
    assert told == pytest.approx([0.15, 0.4, 0.65, 0.9]) and [n.fraction for n in words] == pytest.approx(told)
    assert words[0].text == "tries" and words[0].found == "f" and words[1].text == "checking the whole log"
    assert (
        d.stages == ["all stage"] == weighed and d.verdict == "verdict of ['all stage']" and 0.0 <= d.elapsed_s < 60.0
    )
    chosen.clear()
    long.searched(Excerpt(tuple(range(40))))
    assert len(chosen) == 1  # nothing new fails


def test_all_of_a_log_answers_for_its_excerpt(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    held = SimpleNamespace(sums={"a": "sums of a"}, of=lambda name: f"fails of {name}")
    monkeypatch.setattr(long, "held_against", lambda *a: asked.append(a) or held)
    monkeypatch.setattr(long, "of_whole", lambda *a: a)
    a, b = (SimpleNamespace(stage=n, base=fit(1.0, 0.0), final=fit(2.0, 1.0), floor=0.5, excess=3.0) for n in "ab")
    chain: Any = object()
    results, found = long.held_results(chain, [a, b])  # type: ignore[list-item]
    assert found is held and results == [(a, "sums of a", "fails of a"), b]
    ((of, fits, workers, progress),) = asked
    assert of is chain and workers == 2 and progress is None
    assert [(n, t[0].tolist(), t[1].tolist(), floor, left) for n, t, floor, left in fits] == [
        (n, [1.0, 5.0, 0.0], [2.0, 5.0, 1.0], 0.5, 9.0) for n in "ab"
    ]


def test_a_change_reaches_the_test_and_the_whole_log() -> None:
    change = lambda c: replace(c, notes=("changed",))  # noqa: E731
    bare: Any = long.changed(Stages([]), change)  # type: ignore[arg-type]
    assert bare.notes == ("changed",) and bare.whole is None and bare.test is None
    full: Any = long.changed(Stages([], whole=whole_of(3), test=Stages([])), change)  # type: ignore[arg-type]
    assert full.test.notes == ("changed",) and full.whole.bind([(0, 1)]).notes == ("changed",)


# ---- tables of a machine ---------------------------------------------------------------------------------------------


def test_tables_come_from_the_folder_where_it_has_them(tmp_path: Path) -> None:
    shipped = {name: f"{name}.toml" for name in TABLES}
    assert files_of(None) == shipped and files_of(None, "p.toml") == shipped | {"plant": "p.toml"}
    with pytest.raises(InputError, match="is not a folder"):
        files_of(tmp_path / "none")
    with pytest.raises(InputError, match=r"holds none of calibration.toml, .*plant.toml"):
        files_of(tmp_path)
    (tmp_path / "own_calibration.toml").write_text("")
    assert files_of(tmp_path) == shipped
    (tmp_path / "schedules.toml").write_text("")
    assert files_of(tmp_path) == shipped | {"schedules": str(tmp_path / "schedules.toml")}


@pytest.mark.parametrize("rows, excerpt", [(long.LONG, False), (long.LONG + 1, True)])
def test_a_log_of_more_than_an_hour_is_fitted_on_an_excerpt(
    rows: int, excerpt: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vaneloop.identification.vane_chain.resample.grid_of", lambda log: Grid(rows=rows))
    monkeypatch.setattr(long, "excerpted", lambda log, grid, stages_of: "excerpt")
    monkeypatch.setattr(Machine, "stages_of", lambda self, log, grid: "all")
    log: Any = None
    assert Machine().bind(log) == ("excerpt" if excerpt else "all")


# ---- learned laws ----------------------------------------------------------------------------------------------------


PLACES = np.arange(257.0)


def law(name: str = "bend", **more: Any) -> Any:
    """A law that was learned."""
    given = {
        "name": name, "how": "adds", "at": "valve.current", "of": "n_r", "unit": "mA", "of_unit": "%", "spoken": None,
        "x": PLACES, "y": PLACES * 2.0, "low": PLACES - 1.0, "high": PLACES + 1.0,
        "visited": np.array([0.25, 0.75]), "error_before": 4.0, "error_after": 1.5, "formulas": [], "untold": (),
        "trades": [], "rivals": [], "knots": np.array([0.0] * 4 + [256.0] * 4), "reach": (0.0, 300.0),
        "more": dict, "axis": lambda: None, "sentence": lambda: f"{name} is added",
        "range_note": lambda: f"{name}: range", "of_the_kind_of": lambda other: other.name == name,
    }  # fmt: skip
    return SimpleNamespace(**(given | more))


def test_a_law_as_json_has_33_places() -> None:
    formula = SimpleNamespace(form="line", text="a q", numbers={"a": 2.0}, error=1.0, law="spring", more=9)
    said = learn.law_json(law(formulas=[formula], untold=(0,), trades=["k"], rivals=["r"], more=lambda: {"z": 1}))
    assert len(said["x"]) == 33 and said["x"][:2] == [0.0, 8.0] and said["x"][-1] == 256.0 and said["y"][1] == 16.0
    assert (said["low"][1], said["high"][1], said["visited"]) == (7.0, 9.0, [0.25, 0.75]) and said["effect"] == "bend"
    assert said["formulas"] == [{"form": "line", "text": "a q", "numbers": {"a": 2.0}, "error": 1.0, "law": "spring"}]
    assert said["untold"] == (0,) and said["z"] == 1 and said["error_before"] == 4.0


def answer(verdict: str, laws: Sequence[Any] = (), **more: Any) -> Any:
    """An answer of ``learn``."""
    diagnosed: Any = SimpleNamespace(effects=["valve_lag"], diagnosis=SimpleNamespace(notes=[]))
    outcome = Outcome(verdict, nearest=["near"], why="why", notes=["note"])
    return learn.Learned(diagnosed, outcome, list(laws), log="a.csv", **more)


def test_an_answer_of_learn_in_words() -> None:
    assert answer("none").sentence() == "Nothing is missing: why."
    assert answer("named").sentence() == "Laws of the library explain it: why."
    assert answer("unknown").sentence() == "No law of one or two quantities was accepted: why."
    assert answer("unknown", steps={"x_lvdt": 0.1}).sentence() == "A reading lacks bits: why."
    assert answer("named", steps={"x_lvdt": 0.1}).sentence() == "Laws of the library explain it: why."
    two = answer("learned", [law("one"), law("two", error_before=9.0, error_after=1.25)])
    assert two.sentence().startswith("One is added; two is added. Held-out error in noise floors: 4")
    assert "1.25" in two.sentence() and "9" not in two.sentence().split("floors:")[1]
    said = answer("learned", [law()], path="m.toml").to_dict()
    assert (said["log"], said["verdict"], said["model"], said["named"]) == ("a.csv", "learned", "m.toml", ["valve_lag"])
    assert len(said["laws"]) == 1 and said["nearest"] == ["near"] and said["schema"] == 1
    assert "steps" not in said and "logs" not in said
    by_log: Any = SimpleNamespace(json=lambda: {"logs": [1, 2], "more": 3})
    said = answer("learned", [law()], by_log=by_log, steps={"x_lvdt": 0.1}).to_dict()
    assert said["logs"] == [1, 2] and said["steps"] == {"x_lvdt": 0.1} and "more" not in said


def test_notes_of_learned_laws() -> None:
    laws = [law("a"), law("b", untold=(0, 1), trades=["k", "l"], rivals=["c", "d"]), law("c", untold=(1,))]
    assert answer("learned", laws).notes == [
        "note", "a: range", "b: its mean and slope cannot be estimated from these logs; it trades with k, l",
        "b: as good: c, d", "b: range", "c: its slope cannot be estimated from these logs", "c: range",
    ]  # fmt: skip


def test_shapes_of_curves_that_go_together() -> None:
    assert learn.checked_shape(["zero", "odd", "zero"]) == ("zero", "odd") and learn.checked_shape([]) == ()
    for one in ("odd", "rising", "falling"):
        assert learn.checked_shape([one]) == (one,)
    with pytest.raises(InputError, match=r"shape \(='round'\): allowed: .*odd"):
        learn.checked_shape(["round"])
    with pytest.raises(InputError, match=r"shape \(=falling, zero, odd\): of odd and falling one is allowed"):
        learn.checked_shape(["falling", "zero", "odd"])


KNOTS = [0.0] * 4 + [100.0] * 4
CURVE = Table(how="adds", at="valve.current", of="n_r", low=0.0, high=100.0, values=[1.0, 2.0, 3.0, 4.0], knots=KNOTS)


def test_law_files_are_added_by_their_names(tmp_path: Path) -> None:
    write_model(tmp_path / "law.toml", Model(curves={"bend": CURVE}, effects={"bend": {"c1": 0.5}}))
    write_model(tmp_path / "other.toml", Model())
    machine = Machine(model=Model(effects={"lvdt_bias": {"bias": 0.1}}))
    wanted, model = with_law_files(["valve_lag", str(tmp_path / "law.toml")], machine)
    assert wanted == ["valve_lag", "bend"] and model.curves == {"bend": CURVE}
    assert model.effects == {"lvdt_bias": {"bias": 0.1}, "bend": {"c1": 0.5}}
    assert with_law_files(["valve_lag"], machine) == (["valve_lag"], machine.added)
    with pytest.raises(InputError, match="has no table curves; allowed: a law file of vaneloop learn"):
        with_law_files([str(tmp_path / "other.toml")], machine)


def tried(size: float = 2.0, jump: bool = False) -> Any:
    """A curve that was fitted."""
    candidate = SimpleNamespace(
        name="own name", size=np.float64(size), jump=jump, coefficients=lambda theta: 10.0 * np.asarray(theta)
    )
    judge = SimpleNamespace(stage=SimpleNamespace(index=lambda: {"own name": slice(1, 5)}))
    return SimpleNamespace(candidate=candidate, judge=judge, fit=SimpleNamespace(theta=np.arange(6.0)))


def test_laws_become_a_model_file_s_curves() -> None:
    formula = SimpleNamespace(form="line", numbers={"a": 3.0})
    laws = [law("splines"), law("spoken", spoken=formula)]
    outcome: Any = SimpleNamespace(tried=[tried(), tried(4.0)])
    before = Model(effects={"lvdt_bias": {"bias": 0.1}}, curves={"old": CURVE})
    model = learn._as_model(before, outcome, laws, outcome.tried[1])
    assert list(model.curves) == ["old", "splines", "spoken"] and list(before.curves) == ["old"]
    splines, spoken = model.curves["splines"], model.curves["spoken"]
    assert splines.values == [10.0, 20.0, 30.0, 40.0] and splines.knots == [0.0] * 4 + [256.0] * 4 and not splines.jump
    assert (splines.low, splines.high, splines.size, splines.unit, splines.form) == (0.0, 256.0, 2.0, "mA", "")
    assert model.effects["splines"] == {"c1": 10.0, "c2": 20.0, "c3": 30.0, "c4": 40.0}
    assert (spoken.form, spoken.values, spoken.reach, spoken.size) == ("line", [3.0], [0.0, 300.0], 4.0)
    assert (spoken.low, spoken.high, spoken.knots) == (0.0, 256.0, [])
    assert model.effects["spoken"] == {"a": 3.0} and model.effects["lvdt_bias"] == {"bias": 0.1}


def test_without_a_curve_the_others_are_fitted_from_where_they_are() -> None:
    fits: list[Any] = []
    index = {"a": slice(0, 2), "b": slice(2, 4)}
    of = SimpleNamespace(index=lambda: index, neutral=lambda: np.full(4, 9.0))
    judge: Any = SimpleNamespace(stage=of, fit=lambda names, theta: fits.append((names, theta.tolist())) or "fit")
    theta = np.arange(4.0)
    at: Any = SimpleNamespace(theta=theta)
    assert learn._without(judge, at, ("a", "b"), "b") == "fit" and fits == [(("a",), [0.0, 1.0, 9.0, 9.0])]
    assert learn._without(judge, at, ("a",), "a") is None and theta.tolist() == [0.0, 1.0, 2.0, 3.0] and len(fits) == 1


def test_which_stages_are_asked_for_laws(monkeypatch: pytest.MonkeyPatch) -> None:
    noisy: list[bool] = []
    monkeypatch.setattr(learn, "above_the_noise", lambda judge, base: noisy[-1])
    monkeypatch.setattr(learn, "LeastSquaresProblem", lambda stage, floor: None)
    for made, verdict, above, asked in (
        ("x", "missing", True, False), ("x", "unknown", False, True), ("x", "none", True, True),
        ("x", "none", False, False), (None, "unknown", True, False),
    ):  # fmt: skip
        noisy.append(above)
        chain: Any = SimpleNamespace(stage=lambda name, made=made: SimpleNamespace(made=made))
        d: Any = SimpleNamespace(stage="a", verdict=verdict, floor=None, base=None)
        assert learn._open(chain, d) == asked


@dataclass
class Says:
    """What a learner said."""

    verdict: str
    tried: list[Any]
    notes: list[str]
    nearest: list[str]
    why: str = "none fits"
    decisions: tuple[Any, ...] = ()


class Learning:
    """Stands for what learns on the stages of a log; answers by stage."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **stages: tuple[str, Says | None]):
        self.told: list[float] = []
        self.asked: list[Any] = []
        says = {name: said for name, (_, said) in stages.items()}

        def learner(ground: Any, d: Any, tell: Any, shape: Any, formulas: bool) -> Any:
            self.asked.append((d.stage, ground, shape, formulas))
            tell(0.5)
            return SimpleNamespace(learned=lambda: says[d.stage], judge="judge", base="base")

        monkeypatch.setattr(learn, "_open", lambda chain, d: d.verdict != "missing")
        monkeypatch.setattr(learn, "CurveSearch", learner)
        monkeypatch.setattr(learn, "VaneChainCandidates", lambda stage, floor, test, others: (stage.name, test))
        monkeypatch.setattr(learn, "law_of", lambda ground, before, tried: law(tried.name, before=before))
        monkeypatch.setattr(learn, "spoken", lambda learner, tried, own: (tried[-1], own))
        monkeypatch.setattr(learn, "_as_model", lambda model, kept, laws, last: model.noted(f"{len(kept.tried)} laws"))
        monkeypatch.setattr(learn, "_with_stage", lambda model, judge, fit: model.noted(f"stage of {judge}"))
        monkeypatch.setattr(learn, "with_fits", lambda model, stages: model.noted(f"fits of {len(stages)}"))
        self.stages = [
            SimpleNamespace(name=name, coarse={} if said else {"x_lvdt": "its steps"}, outputs=("y",), made="x")
            for name, (_, said) in stages.items()
        ]
        found = [SimpleNamespace(stage=name, verdict=verdict, floor=0.5) for name, (verdict, _) in stages.items()]
        self.found: Any = SimpleNamespace(diagnosis=SimpleNamespace(stages=found), effects=["valve_lag"])
        self.chain: Any = SimpleNamespace(
            stage=lambda name: next(s for s in self.stages if s.name == name), test=None, steps={"x_lvdt": 0.1},
            stages=self.stages, start=0.0,
        )  # fmt: skip

    def learned(self, **more: Any) -> Any:
        """The answer."""
        return learn.learned(self.chain, "a.csv", Model(), 2, self.told.append, self.found, **more)


def curves(*names: str) -> list[Any]:
    """Curves that were fitted, by name."""
    return [SimpleNamespace(name=n, judge=f"judge of {n}", fit=f"fit of {n}") for n in names]


def test_laws_of_all_stages_are_one_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    at = Learning(
        monkeypatch,
        a=("unknown", Says("learned", curves("one", "two"), ["hm"], [])),
        b=("none", Says("learned", curves("two", "three"), [], [])),
        c=("missing", None),
    )
    said = at.learned(shape=["odd"], formulas=False)
    assert said.verdict == "learned" and [x.name for x in said.laws] == ["one", "two", "three"]
    assert said.laws[0].before == ("judge", "base") and said.laws[1].before == ("judge of one", "fit of one")
    assert said.outcome.notes == ["a: hm", "b: two: another subsystem has the same law"] and said.steps == {
        "x_lvdt": 0.1
    }
    assert said.model.meta["history"] == [
        "2 laws", "stage of judge of two", "1 laws", "stage of judge of three", "fits of 1",
    ]  # fmt: skip
    assert at.told == pytest.approx([0.25, 0.75, 1.0]) and said.log == "a.csv" and said.diagnosed is at.found
    assert [(n, shape, formulas) for n, _, shape, formulas in at.asked] == [
        ("a", ("odd",), False),
        ("b", ("odd",), False),
    ]
    at.chain.test = SimpleNamespace(stages=[SimpleNamespace(name="b")])
    at.asked.clear()
    at.learned()
    assert [ground for _, ground, _, _ in at.asked] == [("a", None), ("b", at.chain.test.stages[0])]
    assert at.asked[0][3] is True


def test_without_a_law_the_answer_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = Says("unknown", [], ["hm"], ["x", "y"], "a why"), Says("unknown", [], [], ["y", "z"], "b why")
    said = Learning(monkeypatch, a=("unknown", a), b=("unknown", b), c=("none", Says("none", [], [], []))).learned()
    assert said.verdict == "unknown" and said.laws == [] and said.model is None and said.outcome.notes == []
    assert said.outcome.nearest == ["x", "y", "z"] and said.outcome.why == "a: hm; a: a why; b: b why"
    none = Learning(monkeypatch, a=("none", Says("none", [], [], [])))
    assert none.learned().verdict == "named" and none.learned().outcome.why == "valve_lag of the library"
    none.found.effects = []
    assert none.learned().verdict == "none" and none.learned().outcome.why.endswith("nothing is missing")


def test_a_stage_of_a_coarse_reading_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    at = Learning(monkeypatch, a=("unknown", None))
    assert at.learned().outcome.why == "a: not asked, as it is driven by x_lvdt" and at.asked == []
    at.stages[0].outputs = ("x_lvdt", "y")
    assert at.learned().outcome.why == "a: its steps"


def test_a_search_before_learning_is_four_tenths_of_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    at = Learning(monkeypatch, a=("unknown", Says("learned", curves("one"), [], [])))
    monkeypatch.setattr(learn, "of_chain", lambda chain, log, workers, tell: tell(0.5) or at.found)
    learn.learned(at.chain, "a.csv", Model(), progress=at.told.append)
    assert at.told == pytest.approx([0.2, 0.7, 1.0])


# ---- what is refused, what answers hold ------------------------------------------------------------------------------


def test_an_unknown_effect_is_refused_with_the_one_that_is_near() -> None:
    search.known(["valve_lag", "lvdt_bias"])
    with pytest.raises(
        InputError, match="--effect 'valve_leg' is not in the library; probably 'valve_lag' is meant; doc"
    ):
        search.known(["valve_lag", "valve_leg"])
    with pytest.raises(InputError, match="--without 'qqqq' is not in the library; docs/effects.md lists it"):
        search.known(["qqqq"], "without")
    assert search._close("valve_leg", ["valve_lag", "other"]) == "close: valve_lag"
    assert search._close("qqqq", ["valve_lag", "other"]) == "it can have valve_lag, other"


def test_values_at_the_end_of_their_tolerance_are_told() -> None:
    rows = [{"parameter": "k", "value": 1.23456, "unit": "mm", "at_limit": True},
            {"parameter": "l", "value": 2.0, "unit": "mm", "at_limit": False}]  # fmt: skip
    d: Any = SimpleNamespace(stage="a", recalibrated=rows)
    assert search._at_limit([d]) == ["a: k stands at the end of its tolerance, 1.235 mm: the log would have it go on"]


def test_fits_become_the_model_s_numbers() -> None:
    model = Model(parameters={"actuator.flow_gain": 0.1}, effects={"bend": {"c1": 5.0}}, curves={"bend": CURVE})
    found = [
        SimpleNamespace(effect="valve_dead_band", parameters={"half_width": {"value": 1.5}, "own": {"value": 3.0}}),
        SimpleNamespace(effect="bend", parameters={"scale": {"value": 2.0}}),
    ]
    d: Any = SimpleNamespace(recalibrated=[{"parameter": "supply.pressure", "value": 20.5}], effects=found)
    out = search.with_fits(model, [d])
    assert out.parameters == {"actuator.flow_gain": 0.1, "supply.pressure": 20.5}
    assert out.effects == {
        "bend": {"c1": 10.0, "c2": 4.0, "c3": 6.0, "c4": 8.0}, "valve_dead_band": {"half_width": 1.5},
    }  # fmt: skip
    assert model.effects == {"bend": {"c1": 5.0}} and list(model.parameters) == ["actuator.flow_gain"]


def test_an_experiment_is_recommended_where_rivals_are_left() -> None:
    diagnosed: Any = SimpleNamespace(diagnosis=SimpleNamespace(notes=["n"]))
    none = search.Experiment(diagnosed, None, "a.csv")
    assert none.sentence() == "Nothing to separate: the log leaves no rivals."
    assert none.to_dict() == {
        "schema": 1,
        "log": "a.csv",
        "recommended": None,
        "profiles": [],
        "notes": ["n"],
        "done": [],
    }
    e = {"score": 3.5, "profile": "p", "repeats": 2, "separates": ["x"], "text": "Run p.", "table": [1],
         "heads": {"nats": "nats"}, "more": 0}  # fmt: skip
    said = search.Experiment(diagnosed, e, "a.csv").to_dict()
    assert said["recommended"] == {"nats": 3.5, "profile": "p", "repeats": 2, "separates": ["x"], "text": "Run p."}
    assert said["profiles"] == [1] and (said["schema"], said["log"], said["notes"]) == (1, "a.csv", ["n"])
    assert search.Experiment(diagnosed, e).sentence() == "Run p."


def located(fails: bool) -> Any:
    """A stage's answer."""
    signal = SimpleNamespace(json=lambda: {"signal": "y"})
    return SimpleNamespace(stage="a", fails=fails, fit=None, json=lambda: {"stage": "a"}, signals=[signal])


HELD = Held({}, [Failing("a", "y", "mm", 1.0, 2.0, 3.0, 4.0)], (0,), [(0.0, 60.0)])


@pytest.mark.parametrize("stages, held, fails", [
    ([False, False], None, False), ([False, True], None, True), ([False], HELD, True),
    ([False], replace(HELD, failing=[]), False), ([], None, False),
])  # fmt: skip
def test_a_model_fails_where_a_stage_or_a_time_of_a_long_log_does(stages: Any, held: Any, fails: bool) -> None:
    bound: Any = SimpleNamespace(not_observed={"b": "no x"}, notes=["n"], test=None, stages=[])
    by_log: Any = SimpleNamespace(json=lambda: {"logs": [1]})
    said = search.Stages(bound, [located(f) for f in stages], "a.csv", by_log, held=held)
    out = said.to_dict()
    assert said.fails == fails and out["verdict"] == ("fails" if fails else "agrees") and out["logs"] == [1]
    assert (
        out["stages"] == [{"stage": "a"}] * len(stages) and out["not_observed"] == {"b": "no x"} and out["schema"] == 1
    )
    assert out["signals"] == [{"signal": "y", "reference": "measured"}] * len(stages) and "tested" not in out
    assert ("whole" in out) == (held is not None) and said.verb == "compare"
    plain = search.Stages(bound, [located(False)], "a.csv").to_dict()
    assert not {"signals", "verdict", "whole"} & plain.keys() and plain["notes"] == ["n"]


def test_a_page_is_headed_by_what_was_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "compare_page", lambda *a: a)
    bound: Any = SimpleNamespace(test=None)
    compared = search.Stages(bound, [], "a.csv")
    one, two = (replace(compared, verb=verb).page("words") for verb in ("compare", "locate"))
    assert one == ([], bound, "words", "a.csv", None, [], "Model and log") and two[-1] == "Where the model fails"


def test_an_extended_model_is_written(tmp_path: Path) -> None:
    diagnosis: Any = SimpleNamespace(stages=[])
    bound: Any = SimpleNamespace(test=None)
    made = search.Extended(bound, diagnosis, model=Model(effects={"lvdt_bias": {"bias": 0.1}}))
    assert made.write(tmp_path / "m.toml") == tmp_path / "m.toml" and made.refused == made.path == ""
    assert "bias = 0.1" in (tmp_path / "m.toml").read_text()
    laws = answer("learned", [law()], model=Model(curves={"bend": CURVE}))
    assert (
        laws.write(tmp_path / "l.toml") == tmp_path / "l.toml" and "[curves.bend]" in (tmp_path / "l.toml").read_text()
    )
    noted = learn.with_path(laws, str(tmp_path / "n.toml"), "learn a.csv")
    assert noted.path == str(tmp_path / "n.toml") and noted.model is not None
    assert noted.model.meta == {"history": ["learn a.csv"]} and "learn a.csv" in (tmp_path / "n.toml").read_text()


def test_a_controller_of_the_user_s_own_has_the_scalars_beside_the_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vaneloop.verbs.machine.Program", lambda path, own: (path, own))
    assert Machine().calibration.program is None
    assert Machine(controller="c.so").calibration.program == ("c.so", None)
    (tmp_path / "calibration.toml").write_text(Path("tables/calibration.toml").read_text())
    assert Machine(tmp_path, controller="c.so").calibration.program == ("c.so", None)
    (tmp_path / "own_calibration.toml").write_text("")
    own = str(tmp_path / "own_calibration.toml")
    assert Machine(tmp_path, controller="c.so").calibration.program == ("c.so", own)
    assert Machine(tmp_path).calibration.program is None


def test_a_diagnosis_notes_what_the_log_said_what_fails_and_what_is_at_its_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []
    row = {"parameter": "k", "value": 1.0, "unit": "mm", "at_limit": True}
    stages = [SimpleNamespace(stage="a", recalibrated=[row], onset=Onset(2.0, 1.5, 3.0))]
    stages.append(SimpleNamespace(stage="b", recalibrated=[], onset=None))
    found = SimpleNamespace(stages=stages, notes=["old"])
    monkeypatch.setattr(search, "search", lambda *a, **how: asked.append((a, how)) or found)
    limit = "a: k stands at the end of its tolerance, 1 mm: the log would have it go on"
    chain: Any = SimpleNamespace(whole=None, stages=["s"], not_observed={"b": "x"}, notes=["n"], start=100.0)
    tell: Any = object()
    said = search.diagnosed(chain, "a.csv", 3, tell, tell)
    assert asked == [((["s"], {"b": "x"}, tell, 3), {"news": tell})] and said.held is None and said.bound is chain
    assert said.diagnosis.notes == ["n", limit] and said.log == "a.csv"
    assert stages[0].onset == Onset(102.0, 101.5, 103.0) and stages[1].onset is None  # in the log's own time
    chain.whole = "whole"
    monkeypatch.setattr(search, "searched", lambda *a: asked.append(a) or (chain, found, HELD))
    said = search.diagnosed(chain, "a.csv", 3, tell, tell)
    assert asked[-1] == (chain, 3, tell, tell) and said.held is HELD
    assert said.diagnosis.notes == ["n", str(HELD.failing[0]), limit]


def test_stages_of_a_log_that_is_there_whole_are_located_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long, "locate_stages", lambda stages, progress: [stages, progress])
    chain: Any = SimpleNamespace(whole=None, stages=["s"])
    tell: Any = object()
    assert long.located(chain, tell) == ([["s"], tell], None)


def test_stages_of_a_long_log_have_the_errors_of_all_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass
    class Figures:
        signal: str
        rms: float = -1.0
        rms_as_given: float = -1.0
        samples: int = -1

    @dataclass
    class At:
        stage: str
        signals: tuple[Figures, ...]
        fit: Any = None
        floor: Any = None

    found = [
        At("a", (Figures("z"), Figures("y")), fit(7.0, 0.0), np.array([0.5, 0.5])),
        At("b", (Figures("y"),), fit(1.0, 0.0)),
    ]
    found[1].floor = np.array([0.5])
    asked: list[Any] = []
    held = SimpleNamespace(sums={"a": sums("a", [0], 2, outputs=("y", "z"))})
    monkeypatch.setattr(long, "locate_stages", lambda stages, progress: list(found))
    monkeypatch.setattr(long, "held_against", lambda *a: asked.append(a) or held)
    monkeypatch.setattr(long, "rms_of", lambda judge, f: 3.0)
    chain: Any = SimpleNamespace(
        whole="whole", stages=[], stage=lambda name: stage(name, ("y", "z") if name == "a" else ("y",))
    )
    long.located(chain)
    assert asked.pop()[2] == 2
    out, same = long.located(chain, None, 5)
    assert same is held and out[1] is found[1] and asked[0][0] is chain and asked[0][2] == 5
    (name, (given, fitted), floor, left), _ = asked[0][1]
    assert (name, given.tolist(), fitted.tolist(), left) == ("a", [1.0, 0.0, 0.0], [7.0, 5.0, 0.0], 9.0)
    assert floor.tolist() == [0.5, 0.5]
    z, y = out[0].signals
    assert (z.signal, z.rms, z.rms_as_given, z.samples) == ("z", 0.5, 0.5, 1200)
    assert y.rms == pytest.approx(0.5 * math.sqrt((9.0 + 1.0) / 2.0)) and y.rms_as_given == 0.5


def test_verbs_tell_a_system_from_a_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(search, "chain_for", lambda *a: asked.append(("chain", *a)) or ("chain", "a.csv"))
    monkeypatch.setattr(search, "not_given", lambda chain, without: (chain, *without))
    monkeypatch.setattr(search, "diagnosed", lambda *a: ("diagnosed", *a))
    monkeypatch.setattr(search, "compared", lambda *a, progress: ("compared", *a, progress))
    monkeypatch.setattr(search, "recommend", lambda d, progress, bound: {"text": "go"})
    machine, tell = Machine(), object()
    said: Any = search.diagnose("a.csv", machine, fit="0:1", without=["x"], progress=tell)  # type: ignore[arg-type]
    assert said == ("diagnosed", ("chain", "x"), "a.csv", 2, tell) and asked == [("chain", "a.csv", machine, "0:1", ())]
    said = search.compare("a.csv", progress=tell)  # type: ignore[arg-type]
    assert said == ("compared", "chain", "a.csv", tell) and asked[-1][2] == Machine()
    monkeypatch.setattr(search, "diagnosed", lambda *a: search.Diagnosed("bound", SimpleNamespace(), "a.csv"))  # type: ignore[arg-type]
    assert search.experiment("a.csv", machine).sentence() == "go" and asked[-1][2] is machine
    assert search.experiment("a.csv").log == "a.csv" and asked[-1][2] == Machine()
    bound = SimpleNamespace(fitted=SimpleNamespace(stages=["s"]), judged=lambda: "judged")
    monkeypatch.setattr(search, "logs_for", lambda *a: asked.append(("logs", *a)) or (bound, "r.csv"))
    found = SimpleNamespace(stages=["first", "second"], notes=["old"])
    monkeypatch.setattr(search, "search", lambda *a: asked.append(("search", *a)) or found)
    by_log = SimpleNamespace(notes=["by log"])
    monkeypatch.setattr(
        "vaneloop.identification.user_models.by_log.ByLog.of", lambda *a: asked.append(("of", *a)) or by_log
    )
    own = system(without=["a"])
    said = search.diagnose("r.csv", own, without=["b"], progress=tell)  # type: ignore[arg-type]
    (_, log, of, *_), (_, *how), (_, *by) = asked[-3:]
    assert log == "r.csv" and tuple(of.without) == ("a", "b") and how == [["s"], None, tell, 1, "judged", None]
    assert by == [bound, "first", None] and said.diagnosis.notes == ["by log"] and said.by_log is by_log
    monkeypatch.setattr(search, "_extended", lambda *a: ("extended", *a))
    assert search.extend("r.csv", ["law"], own) == ("extended", bound, "r.csv", ["law"], None)


# ---- learning on a system --------------------------------------------------------------------------------------------


class Own:
    """Stands for what `learn` calls on a system's logs: what each part was asked, and what it says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, verdict: str = "learned", errors: Sequence[float] = (2.0, 1.5)):
        self.asked: dict[str, list[Any]] = {}
        self.told: list[float] = []
        self.judge = SimpleNamespace(
            stage=SimpleNamespace(parameters=("k",), neutral=lambda: np.array([9.0, 0.0, 0.0])),
            fit=self.note("fit", "base fit"),
        )
        self.tried = [
            SimpleNamespace(candidate=n, judge=self.judge, fit=f"fit of {n}", curves=[(0, SimpleNamespace(name=n))])
            for n in "ab"
        ]
        self.tried[1].curves = [*self.tried[0].curves, *self.tried[1].curves]
        self.outcome = Outcome(verdict, tried=list(self.tried), why="why")
        self.learner = SimpleNamespace(
            learned=lambda: self.outcome, judge="judge", base=SimpleNamespace(theta=np.array([7.0]))
        )
        self.by_log = SimpleNamespace(model=Model(meta={"x": 1}), json=dict)
        self.errors, self.first = errors, SimpleNamespace(stage="tank")
        for name, said in (
            ("CurveSearch", self.learner), ("UserModelCandidates", "ground"), ("on_logs", "logs on"), ("rms_of", 4.0),
            ("found_of", "found"), ("answer_of", self.answer()),
        ):  # fmt: skip
            monkeypatch.setattr(learn, name, self.note(name, said))
        monkeypatch.setattr("vaneloop.identification.user_models.by_log.ByLog.of", self.note("of", self.by_log))
        monkeypatch.setattr(learn, "law_of", self.law_of)
        monkeypatch.setattr(learn, "spoken", lambda learner, tried, laws: (tried[0], laws[:1]))
        monkeypatch.setattr(learn, "_without", lambda judge, fit, names, n: f"without {n}" if len(names) > 1 else None)
        monkeypatch.setattr(learn, "_as_model", self.note("as_model", "the model"))
        logs = SimpleNamespace(fitted=None, test=None)
        self.diagnosed: Any = search.Diagnosed(
            "bound",
            SimpleNamespace(stages=[self.first, "second"]),
            "r.csv",
            SimpleNamespace(logs=logs),  # type: ignore[arg-type]
        )

    def answer(self) -> Any:
        """A stage's answer."""
        return SimpleNamespace(criterion="")

    def note(self, name: str, said: Any) -> Any:
        """A function that keeps what it is asked."""
        return lambda *a, **how: self.asked.setdefault(name, []).append(a) or said

    def law_of(self, ground: Any, before: Any, tried: Any) -> Any:
        """A law."""
        self.asked.setdefault("law_of", []).append((ground, before, tried.candidate))
        return law(tried.candidate, error_after=self.errors["ab".index(tried.candidate)])

    def learned(self, formulas: bool = False) -> Any:
        """What `learn` makes of it."""
        return learn._learned(self.diagnosed, None, self.told.append, ("odd",), formulas)


def test_laws_of_a_system_are_held_against_its_model_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    own = Own(monkeypatch)
    said = own.learned()
    assert own.asked["CurveSearch"] == [("ground", own.first, own.told.append, ("odd",), False)]
    assert own.asked["law_of"] == [
        ("ground", ("judge", own.learner.base), "a"), ("ground", (own.judge, "fit of a"), "b"),
    ]  # fmt: skip
    ((names, theta, steps),) = own.asked["fit"]
    assert (names, theta.tolist(), steps) == ((), [7.0, 0.0, 0.0], 1)  # its own parameters as fitted, no curve
    assert own.asked["found_of"] == [(own.judge, "fit of b", ("a", "b"), {"a": "without a", "b": "without b"})]
    ((judge, verdict, base, fitted, found, fall),) = own.asked["answer_of"]
    assert (judge, verdict, base, fitted, found) == (own.judge, "missing", "base fit", "fit of b", "found")
    assert fall == [("nominal", 4.0), ("a + b", 4.0)]
    ((logs, d, added),) = own.asked["of"]
    assert (logs, d.criterion, added) == ("logs on", "error_share", None) and own.told == [1.0]
    assert own.asked["on_logs"] == [(own.diagnosed.by_log.logs, own.tried[1].curves)]
    assert said.model == "the model" and said.by_log is own.by_log and [x.name for x in said.laws] == ["a", "b"]
    assert own.asked["as_model"][0][0] == own.by_log.model and own.asked["as_model"][0][3] is own.tried[1]


def test_formulas_that_do_as_well_are_the_laws(monkeypatch: pytest.MonkeyPatch) -> None:
    own = Own(monkeypatch)
    said = own.learned(formulas=True)
    assert [x.name for x in said.laws] == ["a"] and said.outcome.tried == own.tried[:1]
    assert own.asked["found_of"] == [(own.judge, "fit of a", ("a",), {"a": "base fit"})]  # nothing else is left
    none = Own(monkeypatch, "unknown").learned()
    assert none.laws == [] and none.model is None and none.log == "r.csv" and none.by_log is None


@pytest.mark.parametrize("beside", [None, "beside"])
def test_learning_on_a_system_diagnoses_first(beside: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    told: list[float] = []

    def made(name: str, said: Any) -> Any:
        def of(*a: Any, progress: Any = None, **how: Any) -> Any:
            asked.append((name, a, how))
            tell = progress or next(x for x in a if callable(x))
            tell(0.4)
            return said

        return of

    monkeypatch.setattr(learn, "diagnose", made("diagnose", "diagnosed"))
    monkeypatch.setattr(learn, "_learned", made("alone", "alone"))
    monkeypatch.setattr(learn, "_beside_named", made("beside", beside))
    model, before = system(), Model()
    said = learn.learn("r.csv", model, fit="0:1", added=before, without=["x"], shape=["odd"], progress=told.append)
    assert said == (beside or "alone") and told == pytest.approx([0.2, 0.6, 0.85, 1.0])
    how = {"fit": "0:1", "test": (), "added": before, "without": ["x"]}
    assert asked[0] == ("diagnose", ("r.csv", model), how)
    assert asked[1][1][:2] == ("diagnosed", before) and asked[1][1][3:] == (("odd",), True)
    assert asked[2][1][:2] == ("diagnosed", "alone") and asked[2][1][3:] == (("odd",), True)

    def fails(*_: Any, **how: Any) -> Any:
        raise StageError("a stage: cannot run")

    monkeypatch.setattr(learn, "_learned", fails)
    with pytest.raises(InputError, match="^a stage: cannot run"):
        learn.learn("r.csv", model)


def test_learning_on_a_machine_takes_its_chain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learn, "chain_for", lambda log, machine, fit, test: ((log, machine, fit, test), "a.csv"))
    monkeypatch.setattr(learn, "not_given", lambda chain, without: (*chain, *without))
    monkeypatch.setattr(learn, "learned", lambda *a: a)
    machine = Machine(model=Model(meta={"x": 1}))
    said: Any = learn.learn("a.csv", machine, fit="0:1", test="1:2", without=["x"], shape=["odd"], workers=3)
    chain, log, before, workers, _, found, shape, formulas = said
    assert chain == ("a.csv", machine, "0:1", "1:2", "x") and (log, before, workers) == ("a.csv", machine.added, 3)
    assert (found, shape, formulas) == (None, ("odd",), True)
    assert learn.learn("a.csv")[0][1] == Machine() and learn.learn("a.csv", formulas=False)[7] is False  # type: ignore[index]


def test_the_first_law_is_written_as_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learn, "python_law", lambda law, system: f"{law.name} {system}")
    own: Any = "pump"
    laws = [law("one"), law("two")]
    assert answer("learned", laws).write_python(tmp_path / "l.py", own) == tmp_path / "l.py"
    assert (tmp_path / "l.py").read_text() == "one pump"
    answer("learned", [law("s"), law("two")]).write_python(tmp_path / "l.py")
    assert (tmp_path / "l.py").read_text() == "s None"


class Beside(Own):
    """Laws of the library that leave more than noise, and what is learned beside them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, excess: float = 4.0, after: float = 1.2, **more: Any):
        super().__init__(monkeypatch)
        fitted = SimpleNamespace(system="sys", data=SimpleNamespace(records=["r"]), floor=np.ones(2), thinned="thin")
        by_logs = SimpleNamespace(fitted=fitted, test=None)
        named = SimpleNamespace(effects=more.get("effects", ["valve_lag"]), excess=excess,
                                final=SimpleNamespace(effects=("valve_lag", "spring")))  # fmt: skip
        self.by = SimpleNamespace(logs=by_logs, model="by model", steps={"model": 1}, tested=lambda: {"t": 1.0})
        self.of: Any = search.Diagnosed("bound", Diagnosis([named]), "r.csv", self.by)  # type: ignore[arg-type]
        floor = more.get("floor", np.array([1.0, 1.0]))
        self.again = SimpleNamespace(fitted=SimpleNamespace(thinned="thin", floor=floor))
        self.given = SimpleNamespace(verdict="missing")
        self.bound: list[Any] = []
        d = SimpleNamespace(error_after=np.array([2.0, 2.0]))
        tested = more.get("tested", 1.0)
        self.with_them = SimpleNamespace(
            d=d, steps={"model": 2, "a": 3, "a + b": 4}, tested=lambda floor: {"t": tested}, json=dict
        )
        laws = [law("first", error_after=9.0), law("last", error_after=after)] if more.get("found", True) else []
        self.said = learn.Learned(self.of, Outcome("learned", notes=[]), laws, self.with_them, log="x")  # type: ignore[arg-type]
        monkeypatch.setattr(learn, "bind", lambda *a: self.bound.append(a) or self.again)
        monkeypatch.setattr(learn, "as_given", lambda logs, fit: self.given)
        monkeypatch.setattr(learn, "LeastSquaresProblem", lambda stage, floor: self.judge)
        monkeypatch.setattr(learn, "_learned", lambda again, *a: self.bound.append((again, *a)) or self.said)

    def beside(self, alone: Any = None) -> Any:
        """What is learned beside the named ones."""
        alone = alone or learn.Learned(self.of, Outcome("unknown"), [])
        return learn._beside_named(self.of, alone, self.told.append, ("odd",), False)


@dataclass
class Diagnosis:
    """What all stages say."""

    stages: list[Any]


def test_curves_are_learned_beside_the_laws_that_have_names(monkeypatch: pytest.MonkeyPatch) -> None:
    at = Beside(monkeypatch)
    said = at.beside()
    assert said.diagnosed is at.of and said.laws == at.said.laws and at.bound[0] == ("sys", ["r"], (), "by model")
    again, before, _, shape, formulas = at.bound[1]
    assert again.diagnosis.stages == [at.given] and at.given.verdict == "unknown" and again.bound is at.again.fitted
    assert (before, shape, formulas) == ("by model", ("odd",), False)
    assert at.with_them.steps == {"model": 1, "valve_lag + spring + a": 3, "valve_lag + spring + a + b": 4}
    assert said.outcome.notes == ["learned beside valve_lag and spring of the library: the law file has both"]
    ((names, theta, steps),) = at.asked["fit"]
    assert (names, theta.tolist(), steps) == ((), [9.0, 0.0, 0.0], 12)
    at.by.logs.test = SimpleNamespace(data=SimpleNamespace(records=["t"]))
    at.beside()
    assert at.bound[2] == ("sys", ["r"], ["t"], "by model")


@pytest.mark.parametrize("change, better", [
    ({}, True), ({"effects": []}, False), ({"excess": 1.25}, False), ({"excess": 1.3, "after": 1.0}, True),
    ({"found": False}, False), ({"excess": 2.0, "after": 1.84}, True), ({"excess": 2.0, "after": 1.85}, False),
    ({"tested": 1.1}, True), ({"tested": 1.11}, False),
    ({"excess": 2.0, "after": 1.0, "floor": np.full(2, 2.0)}, False),
    ({"excess": 2.0, "after": 0.9, "floor": np.full(2, 2.0)}, True),
])  # fmt: skip
def test_what_is_learned_beside_must_do_better(
    change: dict[str, Any], better: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fifth less of what exceeds the noise of the first model, and no test log a tenth worse."""
    assert (Beside(monkeypatch, **change).beside() is not None) == better


def test_what_was_learned_alone_stands_where_it_does_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    at = Beside(monkeypatch)
    alone = learn.Learned(at.of, Outcome("learned"), [law(error_after=9.0), law(error_after=1.2)])
    assert at.beside(alone) is None  # what it leaves is noise
    at = Beside(monkeypatch, after=1.28, tested=1.3)
    worse = SimpleNamespace(tested=lambda: {"t": 1.3})
    alone = learn.Learned(at.of, Outcome("learned"), [law(error_after=1.4)], worse)  # type: ignore[arg-type]
    assert at.beside(alone) is not None  # held against the test logs of what was learned alone

    def fails(*_: Any) -> Any:
        raise StageError("does not run")

    monkeypatch.setattr(learn, "bind", fails)
    assert Beside(monkeypatch).beside() is not None
    monkeypatch.setattr(learn, "bind", fails)
    assert at.beside() is None


# ---- extending -------------------------------------------------------------------------------------------------------


def extending(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A chain of two stages, and what is fitted in them."""
    asked: list[Any] = []
    monkeypatch.setattr(search, "extend_stage", lambda stage, names, **how: SimpleNamespace(
        stage=stage.name, recalibrated=[], names=names, on=stage,
        onset=Onset(5.0, 4.0, 6.0) if "valve_null_bias" in names else None, effects=[
            SimpleNamespace(effect=n, parameters={"scale": {"value": 1.0}}, fall=1.0 + (stage.name == "linkage"))
            for n in names
        ]))  # fmt: skip
    monkeypatch.setattr(search, "as_compared", lambda stage, answer: answer)
    monkeypatch.setattr(search, "no_better", lambda answer: "no better" if answer.stage == "linkage" else None)
    monkeypatch.setattr(search, "changed", lambda chain, change: change(chain))
    monkeypatch.setattr(search, "with_laws", lambda stage, names, curves, log: SimpleNamespace(
        name=stage.name, given=(tuple(names), tuple(curves), log), measured=np.zeros(3)))  # fmt: skip
    monkeypatch.setattr(search, "curve_effect", lambda name, law: (name, law.values))

    @dataclass
    class Shown:
        stages: list[Any]
        not_observed: Any
        notes: Any = ("n",)
        whole: Any = None
        plant: Any = field(
            default_factory=lambda: SimpleNamespace(
                kind="hydraulic", sides=1, lacks=lambda effect: "" if "hydraulic" in effect.kinds else "is of motors"
            )
        )
        start: float = 10.0

        def stage(self, name: str) -> Any:
            return next(s for s in self.stages if s.name == name)

    chain = Shown([SimpleNamespace(name="actuator"), SimpleNamespace(name="linkage")], {"engine": "no n_r"})
    return chain, asked


def test_effects_are_fitted_in_the_stage_that_shows_them_most_clearly(monkeypatch: pytest.MonkeyPatch) -> None:
    chain, _ = extending(monkeypatch)
    before = Model(curves={"bend": CURVE}, effects={"bend": {"c1": 7.0}, "rotor_lag_error": {}, "lvdt_bias": {}})
    said = search.extended(chain, ["valve_lag", "valve_lag", "bend"], before, "a.csv")
    shown = {s.stage: s for s in said.diagnosis.stages}
    assert shown["actuator"].names[-1] == "valve_lag" and "lvdt_bias" in shown["linkage"].names
    names, curves, log = shown["actuator"].on.given
    assert "bend" not in names and curves == (("bend", [7.0, 2.0, 3.0, 4.0]),) and log == "a.csv"
    assert said.refused == "no better" and said.diagnosis.notes == ["n"]
    assert 0.0 <= said.diagnosis.elapsed_s < 60.0
    assert said.diagnosis.verdict == "missing" and said.diagnosis.not_observed == {"engine": "no n_r"}
    assert said.held is None and said.model is not None and said.model.curves == {"bend": CURVE}
    chain.whole = "whole"
    monkeypatch.setattr(search, "held_results", lambda bound, results: (results, HELD))
    said = search.extended(chain, ["valve_lag"], Model(), "a.csv")
    assert said.held is HELD and said.diagnosis.notes == ["n", str(HELD.failing[0])]
    said = search.extended(chain, ["valve_null_bias"], Model(), "a.csv")
    told = "actuator: effects from 15.0 s on [14.0, 16.0]; the model has them all along"
    assert said.diagnosis.notes[-1] == told and said.diagnosis.stages[0].onset == Onset(15.0, 14.0, 16.0)


def test_effects_of_a_subsystem_stay_in_the_order_in_which_they_were_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    chain, _ = extending(monkeypatch)
    for asked in (["lvdt_bias", "pot_bias"], ["pot_bias", "lvdt_bias"], ["linkage_wear", "lvdt_bias", "pot_bias"]):
        (shown,) = search.extended(chain, asked, Model(), "a.csv").diagnosis.stages
        assert (shown.stage, list(shown.names)) == ("linkage", asked)  # the first is shown by two subsystems


def two_sides(sides: int = 2, one_valve: bool = False) -> Any:
    """Subsystems of a machine with so many actuators, and the effects that each may have."""
    of = {"actuator_a": ["side_a.lvdt_bias"], "actuator_b": ["side_b.lvdt_bias", "aero_load"], "linkage": ["pot_bias"]}
    stages = [
        SimpleNamespace(name=n, effects=[SimpleNamespace(name=e) for e in names], index=lambda names=names: names)
        for n, names in of.items()
    ]
    plant = SimpleNamespace(sides=sides, one_valve=one_valve)
    return SimpleNamespace(stages=stages, plant=plant, not_observed={"engine": "no n_r", "actuator_c": "nothing"})


@pytest.mark.parametrize(("name", "forms", "shown"), [
    ("side_a.lvdt_bias", ("side_a.lvdt_bias",), ("actuator_a", "actuator_c")),
    ("lvdt_bias", ("side_a.lvdt_bias", "side_b.lvdt_bias"), ("actuator_c",)),
    ("pot_bias", ("pot_bias",), ("linkage",)), ("aero_load", ("aero_load",), ("actuator_b", "actuator_c")),
    ("rotor_lag_error", ("rotor_lag_error",), ("engine",)),
])  # fmt: skip
def test_an_effect_is_of_the_side_that_has_it(name: str, forms: tuple[str, ...], shown: tuple[str, ...]) -> None:
    assert search._forms(name, two_sides()) == forms and search._forms(name, two_sides(1)) == (name,)
    assert search._shown_by(name, two_sides()) == shown
    if "." not in name:
        assert search._shown_by(name, two_sides(1)) == search.EFFECTS[name].stages


@pytest.mark.parametrize(("name", "sides", "one_valve"), [
    ("side_a.lvdt_bias", 1, False), ("side_a.pot_bias", 2, False), ("side_b.valve_lag", 2, True),
])  # fmt: skip
def test_what_is_of_no_side_of_this_machine_is_refused(name: str, sides: int, one_valve: bool) -> None:
    with pytest.raises(InputError) as e:
        search._shown_by(name, two_sides(sides, one_valve))
    assert str(e.value) == (
        f"--effect {name}: {name.partition('.')[2]} is not of one of two actuators of this machine (docs/machines.md)"
    )


def test_what_the_log_does_not_show_cannot_be_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    chain, _ = extending(monkeypatch)
    with pytest.raises(
        InputError, match=r"a.csv: --effect rotor_lag_error: the log does not show its subsystem .engine: no n_r"
    ):
        search.extended(chain, ["rotor_lag_error"], Model(), "a.csv")
    with pytest.raises(InputError, match="--effect gear_backlash: is of motors .docs/effects.md"):
        search.extended(chain, ["gear_backlash"], Model(), "a.csv")
    curve = CURVE.model_copy(update={"at": "engine.demand"})
    with pytest.raises(InputError, match=r"--effect bend: the log does not show its subsystem .engine: no n_r"):
        search.extended(chain, ["bend"], Model(curves={"bend": curve}), "a.csv")
    chain.not_observed = {}
    with pytest.raises(InputError, match=r"--effect rotor_lag_error: .*engine: cannot tell from this log"):
        search.extended(chain, ["rotor_lag_error"], Model(), "a.csv")
    with pytest.raises(InputError, match=r"--effect bend: .*engine: cannot tell from this log"):
        search.extended(chain, ["bend"], Model(curves={"bend": curve}), "a.csv")
    assert search.extended(chain, [], Model(effects={"rotor_lag_error": {}}), "a.csv").diagnosis.stages == []


def test_laws_of_a_system_are_those_that_it_can_be_given(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    answer_ = SimpleNamespace(stage="a")
    by_log = SimpleNamespace(model="by model", notes=["by log"])
    monkeypatch.setattr(search, "extend_stage", lambda *a, **how: asked.append((a, how)) or answer_)
    monkeypatch.setattr("vaneloop.identification.user_models.by_log.ByLog.of", lambda *a: asked.append(a) or by_log)
    effects = (SimpleNamespace(name="force.spring"), SimpleNamespace(name="force.friction"))
    bound = SimpleNamespace(stage=SimpleNamespace(effects=effects), present={"force.damper"}, thinned="thin",
                            system=SimpleNamespace(name="pump"))  # fmt: skip
    logs: Any = SimpleNamespace(fitted=bound)
    for better, refused in ((None, ""), ("no better", "no better")):
        monkeypatch.setattr(search, "no_better", lambda r, better=better: better)
        said = search._extended(logs, "r.csv", ["force.spring", "force.spring"], None)
        assert said.refused == refused and said.model == "by model" and said.diagnosis.notes == ["by log"]
        assert asked[-2][0] == ("thin", ("force.spring",)) and asked[-1] == (logs, answer_, None)
        assert said.diagnosis.verdict == "missing" and 0.0 <= said.diagnosis.elapsed_s < 60.0 and said.by_log is by_log
    for law_, why in (("force.damper", "it is part of the model already"), ("force.sprung", "close: force.spring")):
        with pytest.raises(InputError, match=f"--effect '{law_}': not a law that system 'pump' can be given; {why}"):
            search._extended(logs, "r.csv", [law_], None)


def test_of_a_surface_what_goes_on_is_its_range(monkeypatch: pytest.MonkeyPatch) -> None:
    class Surface(SimpleNamespace):
        pass

    monkeypatch.setattr(learn, "LearnedSurface", Surface)
    second = {"of": "t_oil", "low": 10.0, "high": 20.0, "form": "line"}
    formula = SimpleNamespace(form="line", numbers={"a": 3.0})
    made = Surface(**vars(law("s", spoken=formula, axis=lambda: second)))
    outcome: Any = SimpleNamespace(tried=[tried()])
    table = learn._as_model(Model(), outcome, [made], outcome.tried[0]).curves["s"]
    assert (table.low, table.high, table.reach) == (0.0, 300.0, []) and table.second is not None
    assert table.second.of == "t_oil"


def test_a_log_is_read_where_it_is_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(replay_verb, "read_log", lambda path, **how: asked.append((path, how)) or "the log")
    log = Log("a.csv", {"n_dem": Channel(T, 60.0 + T)})
    assert replay_verb.log_of(log, Machine()) is log and asked == []
    for name in ("a.csv", Path("a.csv")):
        assert replay_verb.log_of(name, Machine(), ()) == "the log"
        assert asked.pop() == (name, {"require": (), "tables": files_of(None)})
    replay_verb.log_of("a.csv", Machine())
    assert asked.pop()[1]["require"] == ("n_dem",)
    monkeypatch.setattr(replay_verb, "run", lambda log, **how: (log, how))
    machine = Machine(model=Model(effects={"lvdt_bias": {"bias": 0.1}}))
    for given, m in ((machine, machine), (None, Machine())):
        found, how = replay_verb.replay(log, given, floors={"vigv": 0.1}).result  # type: ignore[misc]
        assert found is log and how["floors"] == {"vigv": 0.1} and how["progress"] is None
        assert (
            how["plant"].p.tolist() == m.plant.p.tolist() and how["calibration"].k.tolist() == m.calibration.k.tolist()
        )


def test_stages_are_compared_and_told_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[float] = []
    bound: Any = SimpleNamespace(not_observed={"b": "x"}, test=None)
    monkeypatch.setattr(search, "located_sentence", lambda *a: a)
    assert search.Stages(bound, ["x"]).sentence() == (["x"], {"b": "x"}, ())  # type: ignore[comparison-overlap, list-item]
    said: Any = search.Stages(bound, [], held=HELD).sentence()
    assert said == ([], {"b": "x"}, HELD.failing)
    monkeypatch.setattr(search, "located_of", lambda chain, tell: ([tell and tell(0.5, "a")], HELD))
    found = search.compared(bound, "a.csv", "locate", told.append)
    assert told == [0.5] and found.held is HELD and (found.log, found.verb, found.bound) == ("a.csv", "locate", bound)
    assert search.compared(bound, "a.csv").located == [None] and told == [0.5]


def test_effects_are_left_out_of_every_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "without_laws", lambda stages, effects: (stages, effects))
    monkeypatch.setattr(search, "changed", lambda chain, change: change(chain))
    chain: Any = Stages([], stages="stages")
    assert search.not_given(chain, []) is chain
    assert search.not_given(chain, ["valve_lag"]).stages == ("stages", ["valve_lag"])  # type: ignore[comparison-overlap]
    with pytest.raises(InputError, match="--without 'valve_leg' is not in the library"):
        search.not_given(chain, ["valve_leg"])


# ---- what every answer can do ----------------------------------------------------------------------------------------


class Asked(Answer):
    """An answer of known parts."""

    def __init__(self, fits: Sequence[Fitted] = (), rows: Sequence[Any] = (), said: str = "a < b"):
        self.log, self._of, self._rows, self._said = "folder/run.csv", fits, rows, said

    def sentence(self) -> str:
        return self._said

    def rows(self) -> Sequence[Any]:
        return self._rows

    def page(self, command: str = "") -> Any:
        return SimpleNamespace(
            html=lambda: '<b>"x"</b>', title="T & U", verdict="so it is",
            figures=[{"data": []}, {"data": [{"y": [1]}]}], write=lambda path: (Path(path), command),
        )  # fmt: skip

    def _fits(self) -> Sequence[Fitted]:
        return self._of


def line_stage(name: str, noise: float, outputs: tuple[str, ...] = ("y",)) -> Stage:
    """A line of known noise, y = a + b x, measured at forty places."""
    x = np.linspace(-1.0, 1.0, 40)
    of = np.random.default_rng(1).standard_normal((len(outputs), 40)) * noise
    return Stage(
        name=name, outputs=outputs, units=("mm",) * len(outputs), t=0.5 * np.arange(40), window=None,
        parameters=(Parameter("a", 2.0, "mm", tolerance=1.0), Parameter("b", 3.0, "mm", tolerance=0.05)),
        effects=(Effect("bend", (Parameter("size", 0.0, "mm", -9.0, 9.0),), ((1.0,),)),),
        run=lambda th: np.repeat(
            (th[:, :1] + th[:, 1:2] * x + th[:, 2:3] * x**2)[:, None, :], len(outputs), axis=1
        ),
        measured=2.2 + 3.4 * x + 0.5 * x**2 + of, floor=np.full(len(outputs), noise),
    )  # fmt: skip


def fitted_line(name: str, outputs: tuple[str, ...] = ("y",), base: Any = None, start: float = 0.0) -> Fitted:
    judge = LeastSquaresProblem(line_stage(name, 0.1, outputs), np.full(len(outputs), 0.1))
    return Fitted(judge, judge.fit(("bend",), judge.stage.neutral()), base, start)


def test_parameters_have_their_errors_intervals_and_bounds() -> None:
    f = fitted_line("stem")
    p = parameters_of([f])
    assert list(p) == ["a", "b", "bend.size"] and len(p) == 3 and "a" in p and "size" not in p
    a, b, size = p.values()
    assert (a.stage, a.effect, a.name, a.unit, a.bound, a.at_bound) == ("stem", "", "a", "mm", (1.0, 3.0), False)
    assert a.low < a.value < a.high and a.stderr == pytest.approx(
        0.5 * (f.fit.high[0] - f.fit.low[0]) / 1.6449, rel=1e-3
    )
    assert (b.at_bound, b.value, b.bound) == (True, 3.05, (2.95, 3.05)) and math.isnan(b.stderr)
    assert (size.effect, size.bound) == ("bend", (-9.0, 9.0)) and size.value == pytest.approx(0.5, abs=0.2)
    with pytest.raises(
        NoParameter,
        match=r"^parameter 'bend.siz' was not fitted \(did you mean bend.size\?\); fitted: a, b, bend.size$",
    ):
        p["bend.siz"]
    frame = p.to_frame()
    assert list(frame.columns) == list(COLUMNS) and frame.index.name == "parameter"
    assert frame.loc["bend.size", ["subsystem", "effect", "lower_bound", "upper_bound", "at_bound"]].tolist() == [
        "stem", "bend", -9.0, 9.0, False,
    ]  # fmt: skip
    assert repr(p).splitlines()[0].split() == ["parameter", *COLUMNS] and len(repr(p).splitlines()) == 4
    assert p._repr_html_().count("<tr>") == 4 and repr(parameters_of([])) == "Parameters(nothing was fitted)"
    two = parameters_of([f, fitted_line("ring")])
    assert list(two) == [f"{s}: {n}" for s in ("stem", "ring") for n in ("a", "b", "bend.size")]


def test_errors_of_parameters_go_together_within_a_fit() -> None:
    f, g = fitted_line("stem"), fitted_line("ring")
    c = correlation_of([f, g])
    own = f.judge.correlation(f.fit)
    assert len(c) == 6 and "ring: a" in c and "a" not in c and list(c)[0] == "stem: a"
    frame = c.to_frame()
    np.testing.assert_array_equal(frame.to_numpy()[:3, :3], own)
    np.testing.assert_array_equal(frame.to_numpy()[3:, 3:], own)
    assert np.isnan(frame.to_numpy()[:3, 3:]).all() and frame.index.equals(frame.columns)
    row = c["stem: a"]
    assert row["stem: bend.size"] == own[0, 2] < -0.5 and math.isnan(row["ring: a"])
    with pytest.raises(NoParameter, match=r"^parameter 'b' was not fitted"):
        c["b"]
    assert repr(c).splitlines()[1].split()[:2] == ["stem:", "a"] and f"{own[0, 2]:.3g}" in repr(c)
    assert repr(correlation_of([])) == "Correlation(nothing was fitted)"


def test_curves_are_what_was_measured_and_what_is_left() -> None:
    f = fitted_line("stem", ("y", "z"), start=7.0)
    f.judge.stage.measured[1, 3] = np.nan
    judge = LeastSquaresProblem(f.judge.stage, np.array([0.1, 0.2]))
    f = f._replace(judge=judge, fit=judge.fit(("bend",), judge.stage.neutral()))
    curves = curves_of_stages([f], "run.csv")
    assert list(curves.by_name) == ["y", "z"]
    y, z = curves.by_name.values()
    model, nominal = judge.stage.run(np.array([f.fit.theta, recalibrate(judge).theta]))
    np.testing.assert_allclose(y.residual, judge.stage.measured[0] - model[0], atol=1e-9)
    np.testing.assert_allclose(y.before, judge.stage.measured[0] - nominal[0], atol=1e-9)
    np.testing.assert_allclose(y.t, 7.0 + judge.stage.t)
    assert (y.of, y.unit, y.floor, z.floor) == ("stem", "mm", 0.1, 0.2) and np.isnan(z.residual[3])
    assert y.ratio() == pytest.approx(np.sqrt(np.mean(y.before**2)) / 0.1)
    assert z._replace(floor=0.0).ratio() == 0.0 and z._replace(before=np.full(40, np.nan)).ratio() == 0.0
    assert z.ratio() == pytest.approx(np.sqrt(np.nanmean(z.before**2)) / 0.2)
    assert curves.worst() == "y" and Curves([], "x").worst() == ""
    left, said = curves.residuals, curves.fitted
    assert (left.path, len(left["y"]), len(left["z"]), left["z"].unit) == ("run.csv", 40, 39, "mm")
    np.testing.assert_allclose(said["y"].values, model[0], atol=1e-9)
    np.testing.assert_allclose(left["z"].values, np.delete(z.residual, 3))
    with_base = curves_of_stages([f._replace(base=SimpleNamespace(theta=np.array([2.0, 3.0, 0.0])))], "x")
    np.testing.assert_allclose(
        with_base.by_name["y"].before, judge.stage.measured[0] - 2.0 - 3.0 * np.linspace(-1, 1, 40)
    )
    both = curves_of_stages([f, fitted_line("ring")], "x")
    assert list(both.by_name) == ["stem: y", "z", "ring: y"]


def test_curves_of_logs_are_those_that_were_fitted_and_those_that_test() -> None:
    def bound(names: list[str], many: int) -> Any:
        at = {n: slice(k * 3, k * 3 + 3) for k, n in enumerate(names)}
        measured = np.arange(float(2 * 3 * many)).reshape(2, -1)
        return SimpleNamespace(
            logs=at, measured=measured, data=SimpleNamespace(times=[np.arange(3.0) + k for k in range(many)]),
            system=SimpleNamespace(outputs={"y": "V", "z": "A"}), floor=np.array([0.5, 0.25]),
        )  # fmt: skip

    errors = {n: np.full((2, 3), k + 1.0) for k, n in enumerate(("a", "b", "t"))}
    logs: Any = SimpleNamespace(
        fitted=bound(["a", "b"], 2), test=bound(["t"], 1),
        errors=lambda theta: {n: e * theta for n, e in errors.items()},
    )  # fmt: skip
    curves = curves_of_logs(logs, 2.0, 3.0, "p")  # type: ignore[arg-type]
    assert list(curves.by_name) == [f"{n}: {s}" for n in "abt" for s in "yz"]
    c = curves.by_name["b: z"]
    assert (c.of, c.unit, c.floor, c.t.tolist(), c.measured.tolist()) == ("b", "A", 0.25, [1, 2, 3], [9, 10, 11])
    assert c.residual.tolist() == [-4.0] * 3 and c.before.tolist() == [-6.0] * 3
    assert curves.by_name["t: y"].floor == 0.5  # of the logs that were fitted
    logs.test = None
    assert len(curves_of_logs(logs, 2.0, 3.0, "p").by_name) == 4  # type: ignore[arg-type]


def test_an_answer_says_itself_in_a_console_a_cell_a_file_and_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [{"signal": f"s{k}", "verdict": "none", "rms": 0.5 * k} for k in range(13)]
    a = Asked(rows=rows)
    assert str(a) == "a < b" and repr(a) == "<Asked of run.csv: a < b>"
    a.log = ""
    assert repr(a) == "<Asked of a log: a < b>"
    assert a.report("x.html", "why") == (Path("x.html"), "why")  # type: ignore[comparison-overlap]
    frame = a.to_frame()
    assert list(frame.columns) == ["signal", "verdict", "rms"] and frame["rms"].tolist() == [0.5 * k for k in range(13)]
    shown = a.show()
    assert repr(shown) == "T & U: so it is"
    assert shown._repr_html_() == (
        '<iframe srcdoc="&lt;b&gt;&quot;x&quot;&lt;/b&gt;" width="100%" height="600" title="T &amp; U"></iframe>'
    )
    monkeypatch.setattr(answer_verb, "is_there", lambda name: False)
    cell = a._repr_html_()
    assert cell.startswith("<p><strong>a &lt; b</strong></p>\n<table>") and cell.count("<tr>") == 13
    assert "<p>and 1 rows more: <code>answer.to_frame()</code></p>" in cell and "<img" not in cell
    assert f">{answer_verb.verdict_word('none')}<" in cell and ">none<" not in cell
    a._rows = rows[:12]
    assert "rows more" not in a._repr_html_()
    a._rows = []
    assert "<table>" not in a._repr_html_()
    with pytest.raises(NotImplementedError):
        Answer().rows()
    monkeypatch.setattr(answer_verb, "painted", lambda figure: figure)
    assert a.figure().data == () and a.figure(1).data[0].y == (1,)
    a.page = lambda command="": SimpleNamespace(figures=[])  # type: ignore[method-assign]
    assert a.figure(3).data == ()


def test_an_answer_is_drawn_as_measured_and_as_the_model_has_it() -> None:
    figure = pytest.importorskip("matplotlib.figure")
    f = fitted_line("stem", ("y", "z"))
    a = Asked([f])
    ax = figure.Figure().subplots()
    assert a.plot(ax) is ax and a.params is a.params and list(a.correl) == list(a.params)
    c = a._curves.by_name[a._curves.worst()]
    lines = {line.get_label(): line for line in ax.get_lines()}
    assert list(lines) == ["measured", "nominal model", "with what was found"]
    for label, values in (
        ("measured", c.measured),
        ("nominal model", c.measured - c.before),
        ("with what was found", c.measured - c.residual),
    ):
        np.testing.assert_array_equal(lines[label].get_ydata(), values)
        np.testing.assert_array_equal(lines[label].get_xdata(), c.t)
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.margins()[0]) == ("t [s]", f"{c.name} [mm]", 0.0)
    assert ax.get_legend() is not None and ax.get_xgridlines()[0].get_visible()
    assert [lines[n].get_linewidth() for n in lines] == [2.0, 0.8, 0.8]
    left = figure.Figure().subplots()
    a.plot(left, signal="z", residuals=True)
    assert [line.get_label() for line in left.get_lines()] == ["nominal model", "with what was found"]
    np.testing.assert_array_equal(left.get_lines()[1].get_ydata(), a._curves.by_name["z"].residual)
    assert left.get_ylabel() == "residual of z [mm]"
    same = Asked([f._replace(base=f.fit)])
    alone = figure.Figure().subplots()
    same.plot(alone, residuals=True)
    assert [line.get_label() for line in alone.get_lines()] == ["model"] and alone.get_legend() is None
    with pytest.raises(InputError, match=r"^plot: signal \(='zz'\) \(did you mean z\?\): allowed: y, z$"):
        a.plot(ax, signal="zz")
    with pytest.raises(InputError, match=r"allowed: nothing, as nothing was fitted$"):
        Asked().plot(ax)
    image = a._picture()
    assert image.startswith('<img alt="a &lt; b" src="data:image/png;base64,iVBOR') and Asked()._picture() == ""
    png = b64decode(image.split("base64,")[1].rstrip('">'))
    assert struct.unpack(">II", png[16:24]) == (720, 300)
    np.testing.assert_array_equal(a.residuals["y"].values, a._curves.by_name["y"].residual)
    np.testing.assert_array_equal(a.fitted["z"].values, a._curves.fitted["z"].values)


def test_what_an_answer_takes_as_a_log() -> None:
    assert brief("x" * 58) == repr("x" * 58) and len(brief("x" * 58)) == 60
    assert brief("x" * 59) == repr("x" * 59)[:57] + "..." and brief([1, 2]) == "[1, 2]"
    assert replay_verb.a_log("a.csv") == "a.csv" and replay_verb.a_log(Path("a.csv")) == Path("a.csv")
    with pytest.raises(
        InputError, match=r"^log \(=7\): allowed: what read_log gives, a pandas.DataFrame, or a file's name$"
    ):
        replay_verb.a_log(7)
    log = Log("a.csv", {"n_dem": Channel(T, 60.0 + T), "mine": Channel(T, T)}, [], {"mine": "mm"})
    assert list(replay_verb.log_of(log, Machine())) == ["n_dem"]
    ours = log[["n_dem"]]
    assert replay_verb.log_of(ours, Machine()) is ours
    with pytest.raises(LogError, match=r"^a.csv: no x_lvdt; it has n_dem, mine$"):
        replay_verb.log_of(log, Machine(), require=("n_dem", "x_lvdt"))


def test_a_model_is_judged_where_what_drives_it_is_known() -> None:
    """For one step before a driver's first sample and behind its last; of a single sample it is a constant."""
    t = np.arange(11) * 0.1
    slow, late = np.arange(3) * 0.2 + 0.31, np.arange(20) * 0.05 + 0.45
    known, notes = parts._driven(
        t, {"u": Channel(slow, slow), "w": Channel(late, late), "c": Channel(slow[:1], slow[:1])}
    )
    assert known == pytest.approx([0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]) and [n.split(":")[0] for n in notes] == [
        "u",
        "w",
    ]
    assert notes[0] == "u: logged from 0.31 to 0.71 s: what is measured outside does not count"
    assert [(n.kind, n.of, n.number) for n in notes] == [("cut", "u", 1), ("cut", "w", 4)]
    ends, _ = parts._driven(t, {"u": Channel(slow - 0.2, slow)})
    assert ends == pytest.approx(t[:9])
    whole, none = parts._driven(t, {"u": Channel(t, t)})
    assert whole is t and none == []


def test_channels_come_in_the_units_of_the_system() -> None:
    y, u, flag = (Channel(T, T, unit=unit) for unit in ("um", "V", "-"))
    log = Log("a.csv", {"y": y, "u": u, "z": flag, "other": u}, ["n"], {"y": "um", "u": "V", "z": "-", "other": "V"})
    read = parts._in_units(log, {"y": "mm", "u": "V", "z": "mm"}, ["y", "u"])
    assert read["y"].values == pytest.approx(1e-3 * T) and (read["y"].unit, read["z"].unit) == ("mm", "mm")
    assert read["u"].values.tolist() == T.tolist() == read["z"].values.tolist() and list(read) == ["y", "u", "z"]
    assert (read.path, list(read.notes)) == ("a.csv", ["n"])
    with pytest.raises(LogError, match=r"^a.csv: u is in V; allowed: A or what converts to it$"):
        parts._in_units(log, {"u": "A"}, [])
    with pytest.raises(
        LogError,
        match=r"^a.csv: no v \(did you mean u\?\); it has y, u, z, other$|^a.csv: no v; it has y, u, z, other$",
    ):
        parts._in_units(log, {"v": "V"}, ["v"])
    short = Log("a.csv", {"y": Channel(T[:1], T[:1], unit="mm")}, [], {"y": "mm"})
    with pytest.raises(LogError, match=r"^a.csv: no y"):
        parts._in_units(short, {"y": "mm"}, ["y"])
    found, notes = parts.read_record(log, system(inputs={"u": "V"}, outputs={"y": "mm"}, model=lambda u, p: u.u))
    assert found.name == "a.csv" and notes == ["a.csv: n"] and found.columns["y"] == pytest.approx(1e-3 * T)
    moved = system(kind="force", model=lambda u, p: u.u, outputs={"y": "N"}, position="x", velocity="v",
                   units={"position": "mm"})  # fmt: skip
    assert parts.signals_of(moved) == {"x": "mm", "v": "", "u": "V", "y": "N"}


def test_rows_without_time_stand_in_an_order_of_their_numbers_alone() -> None:
    u = np.array([3.0, 1.0, 2.0, 5.0, 4.0, 7.0])
    y = 10.0 * u
    found = []
    for order in (np.arange(6), np.array([5, 2, 0, 4, 1, 3])):
        t = np.arange(6.0)
        has = y[order] != 50.0  # of one row no output
        channels = {"u": Channel(t, u[order]), "y": Channel(t[has], y[order][has])}
        read: Any = SimpleNamespace(channels=channels, notes=["n"], path="folder/t.csv")
        record, said = parts._without_order(read, system(outputs={"y": "mm"}, model=lambda u, p: u.u), "t.csv")
        found.append(record.columns["u"].tolist())
        assert record.columns["y"].tolist() == [10.0 * v for v in found[-1]] and record.t.tolist() == list(range(5))
        assert said == ["t.csv: n", "t.csv: rows: 1 without an input, or without any output: left out"]
        assert not record.ordered and list(record.notes) == said and record.begin == 0.0
    assert found[0] == found[1] != sorted(found[0]) and sorted(found[0]) == [1.0, 2.0, 3.0, 4.0, 7.0]


def test_logs_of_a_system_are_those_to_fit_and_those_to_test(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []
    monkeypatch.setattr(search, "bind", lambda *of: given.append(of) or "logs")
    monkeypatch.setattr(search, "read_record", lambda x, system: (Record(x, T, {"y": T}), []))
    pump, one, two = system(), record(), Record("two", T, {"y": T})
    assert search.logs_for([one, "b.csv"], pump, "3:6", ["6:9", two, "c.csv"], None) == ("logs", "r")
    ((of, fitted, tests, added),) = given
    assert of is pump and added is None
    assert [r.name for r in fitted] == ["r 3:6", "b.csv"] and [r.name for r in tests] == ["r 6:9", "two", "c.csv"]
    search.logs_for("a.csv", pump, (), (), Model())
    assert [r.name for r in given[1][1]] == ["a.csv"] and given[1][2] == [] and given[1][3] == Model()
    monkeypatch.setattr(search, "bind", lambda *of: (_ for _ in ()).throw(StageError("no y")))
    with pytest.raises(InputError, match="^no y$"):
        search.logs_for(one, pump, (), (), None)


def test_a_machine_s_log_is_bound_in_parts_and_takes_no_other_log(monkeypatch: pytest.MonkeyPatch) -> None:
    log = Log("a.csv", {"n_dem": Channel(T, 60.0 + T)})
    asked: list[Any] = []
    monkeypatch.setattr(search, "bind_parts", lambda *of: asked.append(of) or "chain")
    machine = Machine()
    assert search.chain_for(log, machine, "0:5", "5:9") == ("chain", "a.csv")
    assert asked == [(machine, log, [Span(0.0, 5.0)], [Span(5.0, 9.0)])]
    with pytest.raises(
        InputError, match=r"^test='b.csv': the vane chain takes parts of its log, such as \(200, None\)$"
    ):
        search.chain_for(log, machine, (), "b.csv")
    monkeypatch.setattr(search, "chain_for", lambda log, model, fit, test: (model, log))
    monkeypatch.setattr(search, "diagnosed", lambda chain, name, workers, progress: (chain, name, workers, progress))
    monkeypatch.setattr(search, "compared", lambda chain, name, progress=None: (chain, name, progress))
    found: Any = search.diagnose("a.csv", machine, workers=5)
    assert found[0] is machine and found[1:] == ("a.csv", 5, None)
    usual: Any = search.diagnose("a.csv")
    assert isinstance(usual[0], Machine) and usual[2] == 2
    compared: Any = search.compare("a.csv", machine)
    assert compared == (machine, "a.csv", None) and isinstance(search.compare("a.csv").__getitem__(0), Machine)  # type: ignore[attr-defined]


def test_answers_about_stages_say_their_signals_as_rows_and_json(monkeypatch: pytest.MonkeyPatch) -> None:
    signal = SimpleNamespace(signal="y", unit="mm", rms=0.5, rms_as_given=0.75, noise_floor=0.25, ratio=2.0, samples=9,
                             json=lambda: {"signal": "y"})  # fmt: skip
    x: Any = SimpleNamespace(stage="a", signals=[signal], fails=False, fit="f", json=lambda: {"stage": "a"})
    bound: Any = SimpleNamespace(not_observed={"b": "x"}, notes=["n"], test=None)
    s = search.Stages(bound, [x], "a.csv")
    assert s.rows() == [{"subsystem": "a", "signal": "y", "unit": "mm", "rms": 0.5, "rms_as_given": 0.75,
                         "noise_floor": 0.25, "ratio": 2.0, "samples": 9, "fails": False}]  # fmt: skip
    plain = {"schema": 1, "log": "a.csv", "stages": [{"stage": "a"}], "not_observed": {"b": "x"}, "notes": ["n"]}
    said = s.to_dict()
    assert said.pop("done") == search.counted(["n"]) and said == plain and s.verdict == "agrees"
    by_log: Any = SimpleNamespace(json=lambda: {"logs": [1], "notes": ["m"]})
    own = search.Stages(bound, [x], "a.csv", by_log, held=HELD).to_dict()
    assert own.pop("whole") == HELD.json() and own.pop("done") == search.counted(["m"])
    assert own == plain | {
        "signals": [{"signal": "y", "reference": "measured"}],
        "logs": [1],
        "notes": ["m"],
        "verdict": "fails",
    }
    monkeypatch.setattr(
        search, "tested", lambda bound, fits: fits and [parts.Tested("a", "y", "mm", 1.0, 0.5, 0.25, 4)]
    )
    assert search.Stages(bound, [x], "a.csv").to_dict()["tested"] == [
        {
            "stage": "a",
            "signal": "y",
            "unit": "mm",
            "error_before": 1.0,
            "error_after": 0.5,
            "noise_floor": 0.25,
            "samples": 4,
        }
    ]
    found = SimpleNamespace(effect="lag")
    stage: Any = SimpleNamespace(
        stage="a", verdict="missing", outputs=["y", "z"], units=["mm", "V"], floor=np.array([0.1, 0.2]),
        error_before=np.array([1.0, 2.0]), error_after=np.array([0.5, 0.25]), effects=[found, found], base="b",
        final="f",
    )  # fmt: skip
    diagnosis: Any = SimpleNamespace(stages=[stage], verdict="missing")
    monkeypatch.setattr(
        search, "diagnosis_json", lambda d, log: {"log": log, "notes": ["n"], "effects": [{"effect": "lag"}]}
    )
    d = search.Diagnosed(bound, diagnosis, "a.csv", held=HELD)
    assert d.rows()[1] == {"subsystem": "a", "verdict": "missing", "signal": "z", "unit": "V", "error_before": 2.0,
                           "error_after": 0.25, "noise_floor": 0.2, "effects": "lag, lag"}  # fmt: skip
    assert len(d.rows()) == 2 and d.effects == ["lag"] and d.verdict == "missing"
    said = d.to_dict()
    assert said["whole"] == HELD.json() and said["done"] == search.counted(["n"]) and len(said["tested"]) == 1  # type: ignore[arg-type]
    assert "whole" not in search.Diagnosed(bound, diagnosis, "a.csv").to_dict()
    assert search.Diagnosed(bound, diagnosis, "a.csv", by_log).to_dict()["logs"] == [1]


def test_an_experiment_says_what_it_recommends() -> None:
    diagnosed: Any = SimpleNamespace(diagnosis=SimpleNamespace(notes=["n"]), _fits=lambda: ["fit"], _curves="curves")
    none = search.Experiment(diagnosed, None, "a.csv")
    assert none.sentence() == "Nothing to separate: the log leaves no rivals." and none.rows() == []
    assert none.to_dict() == {"schema": 1, "log": "a.csv", "recommended": None, "profiles": [], **search.told(["n"])}
    table: Any = [{"profile": "p", "score": 3.0, "by_pair": {}}, {"profile": "q", "score": 1.0}]
    run: Any = {
        "text": "Ramp it.", "profile": "p", "score": 3.0, "separates": True, "repeats": 2, "t": T,
        "inputs": {"n_dem": ("%", T), "i": ("mA", 2.0 * T)}, "table": table, "heads": {"nats": "x"},
    }  # fmt: skip
    e = search.Experiment(diagnosed, run, "a.csv")
    assert str(e) == "Ramp it." and e.rows() == [{"profile": "p", "score": 3.0}, {"profile": "q", "score": 1.0}]
    best = {"nats": 3.0, "profile": "p", "repeats": 2, "separates": True, "text": "Ramp it."}
    assert e.to_dict() == {"schema": 1, "log": "a.csv", "recommended": best, "profiles": table, **search.told(["n"])}
    other: Any = search.Experiment(diagnosed, {**run, "heads": {"score": "x"}}, "a.csv").to_dict()["recommended"]
    assert other["score"] == 3.0 and "nats" not in other
    assert e._fits() == ["fit"] and e._worked_out() == "curves"  # type: ignore[comparison-overlap]
    ax = pytest.importorskip("matplotlib.figure").Figure().subplots()
    e.plot(ax)
    assert [line.get_label() for line in ax.get_lines()] == ["n_dem [%]", "i [mA]"]
    assert ax.get_lines()[1].get_ydata().tolist() == (2.0 * T).tolist() and ax.get_ylabel() == "n_dem [%], i [mA]"


def test_an_extended_model_is_explained_at_its_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    one = SimpleNamespace(
        stage="a", steps=[("nominal", 9.0), ("lag", 1.0)], verdict="missing", effects=["lag"], good=True
    )
    two = SimpleNamespace(stage="b", steps=[], verdict="missing", effects=[], good=False)
    monkeypatch.setattr(search, "reached", lambda s: s.good)
    monkeypatch.setattr(search.Diagnosed, "to_dict", lambda self: {"stages": [
        {"stage": "a", "verdict": "missing"}, {"stage": "b", "verdict": "missing"}, {"stage": "c", "verdict": "none"}
    ]})  # fmt: skip

    def answer(stages: Sequence[Any], refused: str = "") -> search.Extended:
        return search.Extended(None, SimpleNamespace(stages=stages), "a.csv", refused=refused, path="m.toml")  # type: ignore[arg-type]

    assert answer([one]).verdict == "explained" and answer([one, two]).verdict == "missing"
    assert answer([one], "worse").verdict == "missing" and answer([one]).reached and not answer([two]).reached
    said = answer([one, two]).to_dict()
    assert said["stages"] == [
        {"stage": n, "verdict": v} for n, v in (("a", "explained"), ("b", "missing"), ("c", "none"))
    ]
    assert said["waterfall"] == {
        "a": [{"step": "nominal", "noise_floors": 9.0}, {"step": "lag", "noise_floors": 1.0}],
        "b": [],
    }
    assert (said["model"], said["verdict"]) == ("m.toml", "missing")
    assert answer([one], "worse").to_dict()["stages"][0]["verdict"] == "missing"  # type: ignore[index]


def test_an_experiment_begins_with_the_diagnosis_that_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[Any] = []

    def found(by_log: Any) -> Any:
        d: Any = SimpleNamespace(stages=["first", "second"], notes=[])
        return search.Diagnosed("bound", d, "a.csv", by_log)  # type: ignore[arg-type]

    of_machine, of_system = found(None), found(SimpleNamespace(logs=SimpleNamespace(fitted="fitted")))
    monkeypatch.setattr(search, "recommend", lambda d, progress, bound: said.append((d, progress, bound)) or "run")
    monkeypatch.setattr(search, "best_run", lambda *of: said.append(of[:3]) or of[3](0.5) or "own run")
    monkeypatch.setattr(search, "chain_for", lambda *of: ("chain", of))
    monkeypatch.setattr(search, "diagnosed", lambda chain, name: said.append((chain, name)) or of_machine)
    monkeypatch.setattr(
        search, "diagnose", lambda *of, **how: said.append((of, how)) or how["progress"](1.0) or of_system
    )
    told: list[float] = []
    answer: Any = search.experiment("a.csv", of_machine, progress=told.append)
    assert answer.recommended == "run" and answer.diagnosed is of_machine and answer.log == "a.csv"
    assert said == [(of_machine.diagnosis, told.append, "bound")]
    machine = Machine()
    said.clear()
    search.experiment("a.csv", machine, fit="0:5", test="5:9")
    assert said[0] == ("chain", ("a.csv", machine, "0:5", "5:9")) and len(said) == 2
    search.experiment("a.csv")
    assert isinstance(said[2][1][1], Machine)
    pump, limits, added = system(), search.Limits(), Model()
    said.clear()
    own: Any = search.experiment("a.csv", pump, fit="0:5", added=added, limits=limits, progress=told.append)
    ((of, how), run) = said
    assert of == ("a.csv", pump) and (how["fit"], how["test"], how["added"]) == ("0:5", (), added)
    assert run == ("fitted", "first", limits) and own.recommended == "own run" and told == pytest.approx([0.3, 0.65])
    search.experiment("a.csv", of_system)
    assert said[-1] == ("fitted", "first", search.Limits())


def test_a_machine_is_extended_by_effects_and_law_files(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    more: Any = SimpleNamespace(curves={"mine": 1})
    monkeypatch.setattr(
        search,
        "with_law_files",
        lambda effects, machine: (asked.append((effects, machine)), (["valve_lag", "mine"], more))[1],
    )
    monkeypatch.setattr(search, "chain_for", lambda log, machine, fit, test: ((machine, fit, test), log))
    monkeypatch.setattr(search, "extended", lambda *of: of)
    machine = Machine(model=Model(effects={"lvdt_bias": {"bias": 0.1}}))
    chain, wanted, model, name = search.extend("a.csv", ["valve_lag", "m.toml"], machine, fit="0:5", test="5:9")  # type: ignore[misc]
    assert asked[0] == (["valve_lag", "m.toml"], machine) and (wanted, model, name) == (
        ["valve_lag", "mine"],
        more,
        "a.csv",
    )
    bare, fit, test = chain  # type: ignore[misc]
    assert (
        bare.model is None
        and (bare.tables, bare.strategy, bare.table) == (None, None, None)
        and (fit, test) == ("0:5", "5:9")
    )  # type: ignore[has-type]
    search.extend("a.csv", "valve_lag")
    assert asked[1][0] == ["valve_lag"] and isinstance(asked[1][1], Machine)
    monkeypatch.setattr(search, "with_law_files", lambda effects, machine: (["valve_leg"], more))
    with pytest.raises(InputError, match="^--effect 'valve_leg' is not in the library; probably 'valve_lag' is meant"):
        search.extend("a.csv", ["valve_leg"])
    with pytest.raises(InputError, match="^effects is empty; allowed: at least one effect"):
        search.extend("a.csv", [])


def test_an_answer_of_learn_has_its_decisions_and_draws_its_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learn, "decisions_json", lambda of, stage: [{"stage": stage, "rule": r} for r in of])
    found = answer("learned", [law()], decisions={"a": ["r1", "r2"], "b": ["r3"]})
    assert found.to_dict()["decisions"] == [{"stage": s, "rule": r} for s, r in (("a", "r1"), ("a", "r2"), ("b", "r3"))]
    assert found.explained == {"a": (["r1", "r2"], [found.laws[0].name]), "b": (["r3"], [found.laws[0].name])}
    (row,) = found.rows()
    one = found.laws[0]
    assert row == {"effect": one.name, "how": one.how, "at": one.at, "of": one.of, "unit": one.unit,
                   "error_before": one.error_before, "error_after": one.error_after, "formula": ""}  # fmt: skip
    ax = pytest.importorskip("matplotlib.figure").Figure().subplots()
    one.how, one.at, one.of_unit = "force adds", "force", "mm"
    found.plot(ax)
    (line,) = ax.get_lines()
    assert (
        line.get_label() == one.name
        and line.get_ydata().tolist() == list(one.y)
        and line.get_xdata().tolist() == list(one.x)
    )
    assert ax.get_ylabel() == f"force adds at force [{one.unit}]" and len(ax.collections) == 1
    cell = answer_verb.Answer._repr_html_(found)  # with a picture of it
    assert '<img alt="' in cell and cell.index("<img") > cell.index("<table>")
