"""Very long logs: an excerpt that has been wherever the log has been is fitted; all of the log is held against it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hil.logs import Channel, Log
from tests.firmware_on_rig import firmware
from tests.rig import Hidden, manoeuvre, simulate
from vaneloop.identification.chunked_residuals import Failing, Sums, failing, joined, of_whole
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.settings import PIECE_BLOCKS
from vaneloop.identification.vane_chain.candidates import remade
from vaneloop.identification.vane_chain.resample import Grid, grid_of, on_raster
from vaneloop.identification.workflow import diagnose
from vaneloop.verbs import long
from vaneloop.verbs.machine import Machine

SECONDS = 600  # of the log here, ten pieces
BURST = slice(18_200, 23_800)  # rows in which the valve has a dead band


@cache
def machine() -> Machine:
    return Machine()


@cache
def logs() -> tuple[Log, Log]:
    """A clean run of the rig, and the same with a dead band from 182 to 238 s."""
    columns = []
    for hidden in ([], [Hidden("valve_dead_band", {"half_width": 0.8e-3})]):
        columns.append(simulate(manoeuvre(5, SECONDS), firmware(), hidden, seed=5, rate=100).log)
    t = columns[0]["t"]
    burst = {k: v.copy() for k, v in columns[0].items()}
    for k in burst:
        burst[k][BURST] = columns[1][k][BURST]
    return tuple(Log("rig", {k: Channel(t, v) for k, v in c.items() if k != "t"}) for c in (columns[0], burst))  # type: ignore[return-value]


@pytest.mark.slow
def test_rows_of_an_excerpt_are_those_of_the_log() -> None:
    log = logs()[0]
    grid = grid_of(log)
    whole, part = on_raster(log, grid), on_raster(log, grid, [(3_000, 9_000), (12_000, 15_000)])
    rows = np.r_[3_000:9_000, 12_000:15_000]
    assert np.array_equal(part[0], whole[0][rows])
    assert all(np.array_equal(part[1][k], whole[1][k][rows]) for k in whole[1])
    assert set(np.flatnonzero(part[2].border)) == {5_999, 6_000}  # the pieces' border is a gap


@pytest.mark.slow
def test_errors_of_an_excerpt_are_those_that_the_log_has_there() -> None:
    """Also of the demand, whose frames are late by whole rows of the log, and of play, which remembers its turns."""
    log = logs()[0]
    grid = grid_of(log)
    whole = machine().stages_of(log, grid)
    part = machine().stages_of(log, grid, [(6_000, 18_000), (36_000, 54_000)])
    rows = np.r_[6_000:18_000, 36_000:54_000]
    for stage in part.stages:
        full = whole.stage(stage.name)
        theta = stage.neutral()
        for e in stage.effects:
            if e.name == "can_delay":
                theta[stage.index()[e.name]] = 0.02
        a, b = LeastSquaresProblem(stage, full.floor), LeastSquaresProblem(full, full.floor)
        both = a.valid & b.valid[:, rows]
        assert both.mean() > 0.7
        one, other = (np.where(both, e, 0.0) for e in (a.errors(theta[None])[0], b.errors(theta[None])[0][:, rows]))
        assert np.sqrt(np.sum((one - other) ** 2) / np.sum(other**2)) < 0.15, stage.name
        assert np.allclose(stage.floor, full.floor, rtol=0.05), stage.name


@pytest.mark.slow
def test_errors_of_the_whole_log_are_those_of_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    log = logs()[1]
    monkeypatch.setattr(long, "STRETCH", 4)
    monkeypatch.setattr(long, "LEAD", 10.0)
    chain = long.excerpted(log, grid_of(log), machine().stages_of, 24_000)
    whole = machine().stages_of(log, grid_of(log))
    fits = [(s.name, [s.neutral()], s.floor, np.inf) for s in chain.stages]
    held = long.held_against(chain, fits, workers=1)
    assert not held.failing
    assert len(held.sums) == len(whole.stages) == 5
    for stage in whole.stages:
        judge = LeastSquaresProblem(stage, chain.stage(stage.name).floor)
        n = judge.valid.sum(axis=1)
        rms = np.sqrt((judge.errors(stage.neutral()[None])[0] ** 2).sum(axis=1) / n)
        assert held.sums[stage.name].rms()[0] == pytest.approx(rms, rel=0.02), stage.name
        assert held.sums[stage.name].samples.sum(axis=1) == pytest.approx(n, rel=0.02), stage.name


@pytest.mark.slow
def test_what_the_excerpt_has_not_seen_is_found_and_searched() -> None:
    """A dead band of one minute in ten, of which the excerpt has nothing at first."""
    log, laws = logs()[1], ("valve_dead_band", "valve_null_bias")
    chain = long.excerpted(log, grid_of(log), machine().stages_of, 24_000)
    chain = chain.whole.chain([k for k in chain.whole.chosen if k not in (2, 3, 4)])
    chain = long.changed(
        chain, lambda c: replace(c, stages=[remade(s, laws, ()) for s in c.stages if s.name == "actuator"])
    )
    first = long.located(chain, workers=1)[1]
    assert first is not None
    assert set(first.pieces) == {3}
    assert [(round(f.low), round(f.high)) for f in first.failing] == [(180, 240)]
    again, d, _ = long.searched(chain, workers=1)
    assert set(again.whole.chosen) == {*chain.whole.chosen, 3}
    said = d.stages[0]
    assert d.verdict in ("missing", "unknown")
    assert "valve_dead_band" in [*(f.effect for f in said.effects), *said.nearest]
    assert said.error_before[0] > 3.0 * said.floor[0]


def test_an_excerpt_has_been_wherever_the_log_has_been() -> None:
    """Also where it was for six seconds only."""
    n = 60 * 6_000
    t = 0.01 * np.arange(n)
    stroke = 24.0 + 20.0 * np.sin(2.0 * np.pi * t / 20.0)
    oil = 40.0 + 0.0 * t
    oil[211_300:211_900] = 90.0
    log = Log("made", {"x_lvdt": Channel(t, stroke), "t_oil": Channel(t, oil)})
    whole = long.Whole(log, Grid(0.0, 0.01, n, {}), lambda *_, **__: None)  # type: ignore[arg-type,return-value]
    chosen = long._everywhere(whole, [0, 59])
    assert 211_500 // 6_000 in chosen
    assert {0, 59} <= set(chosen)
    assert len(chosen) < 8
    visits = long._visits(whole)
    seen = visits[chosen].sum(axis=0)
    assert np.all(seen[visits.sum(axis=0) >= long.SEEN] >= long.SEEN)


def noise(pieces: int, seed: int = 0) -> Sums:
    """A stage at its noise floor with both of two parameter sets."""
    n = np.full((1, pieces * PIECE_BLOCKS), 1_000.0)
    squares = np.random.default_rng(seed).chisquare(1_000.0, (2, *n.shape))
    return Sums("actuator", ("x_lvdt",), ("mm",), np.array([0.005]), 0, n, n.copy(), squares, False)


def test_a_piece_fails_by_more_than_ten_seconds() -> None:
    sums = noise(500)
    assert not failing(sums, 1.0, 500)[0].any()
    sums.squares[1, 0, 60:66] *= 1.5  # one minute, 22 % above the floor
    sums.squares[1, 0, 120] *= 8.0  # ten seconds of another
    sums.squares[1, 0, 182:184] *= 4.0  # and ten that lie across a border
    assert np.flatnonzero(failing(sums, 1.0, 500)[0][0]).tolist() == [10]
    assert not failing(sums, 1.5, 500)[0].any()  # where the answer leaves as much everywhere


def test_stretches_join_in_the_order_of_the_log() -> None:
    whole = noise(8)
    parts = [
        replace(whole, first=k, **{v: getattr(whole, v)[..., k : k + 24] for v in ("samples", "expected", "squares")})
        for k in (24, 0)
    ]
    for name in ("samples", "expected", "squares"):
        assert np.array_equal(getattr(joined(parts), name), getattr(whole, name))
    assert joined(parts).rms() == pytest.approx(whole.rms())


def test_a_clean_answer_does_not_stand_where_the_log_fails() -> None:
    log = logs()[0]
    chain = machine().stages_of(log, grid_of(log), [(0, 12_000)])
    d = diagnose([chain.stage("engine")], workers=1).stages[0]
    assert d.verdict == "none"
    sums = noise(20)
    assert of_whole(d, sums, []).verdict == "none"
    fails = [Failing("engine", "n_r", "%", 600.0, 660.0, 0.1, 5.0)]
    said = of_whole(d, sums, fails)
    assert said.verdict == "unknown"
    assert "from 600 to 660 s" in said.refused[0]
    assert of_whole(d, replace(sums, squares=1.5 * sums.squares), []).verdict == "unknown"


@pytest.mark.slow
def test_a_short_log_is_searched_whole() -> None:
    log = logs()[0]
    assert machine().bind(log).whole is None
