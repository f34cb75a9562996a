"""When effects are accepted, named, exchanged and left out: each limit from both sides, on sums of squares that are
given, and the pieces that an excerpt is made of.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vaneloop.identification import Effect, Parameter
from vaneloop.identification.selection import relative_error_acceptance
from vaneloop.identification.selection.likelihood_acceptance import (
    LikelihoodAcceptance,
    _above_floor,
    _worse,
    as_close,
    rival_nats,
    with_rivals,
)
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance, score, structure
from vaneloop.identification.selection.rules import (
    EXPLAINS_HALF,
    LEAVES_A_QUARTER,
    LEAVES_LITTLE,
    AllRows,
    Comparison,
    Decision,
    LogChanges,
    Remainder,
    Verdict,
    decisions_json,
    gain,
)
from vaneloop.identification.selection.subsampled_search import _telling, _tried, _ways, excerpt_of
from vaneloop.identification.subsystem import Array

# docs/settings.md
SPREADS, BLOCK_SPREADS, FLOOR_KNOWN, NATS, RIVAL_NATS, RIVAL_SHARE, RIVAL_SPREADS = 3.0, 8.0, 0.01, 12.0, 3.0, 0.25, 0.3
RIVAL, BETTER, UNKNOWN, MOST_LEFT, PER_PARAMETER, FORM, HARM, LEAST_USE = 0.05, 0.02, 1.25, 0.25, 0.01, 0.02, 0.1, 0.02

SAMPLES = np.array([100, 100, 50, 0])


@dataclass
class OfFit:
    """What is used of a fit: held-out sums of squares of its blocks, and how many parameters it has."""

    held_out: Array
    free: Array = field(default_factory=lambda: np.arange(2))
    effects: tuple[str, ...] = ()
    cost: Array = field(default_factory=lambda: np.zeros(4))
    theta: Array = field(default_factory=lambda: np.zeros(3))


def fit(error: float = 1.0, many: int = 2, effects: tuple[str, ...] = (), **more: Any) -> Any:
    """A fit whose RMS error is the same in each block, in noise floors."""
    squares = error**2 * SAMPLES
    return OfFit(squares, np.arange(many), effects, squares, **more)


def judged(**more: Any) -> Any:
    given: dict[str, Any] = {
        "samples": SAMPLES, "n": int(SAMPLES.sum()), "n_blocks": 4, "floor": np.ones(1),
        "expected": lambda: np.ones(4), "stage": SimpleNamespace(grain=1.0, effects=(), parameters=(), regimes={}),
    }  # fmt: skip
    return SimpleNamespace(**given | more)


# ---- a known noise ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("correlation", [1.0, 6.0])
@pytest.mark.parametrize("known", [0.01, 0.5])
def test_an_error_is_above_its_floor_over_the_log_or_in_a_block_that_counts(correlation: float, known: float) -> None:
    judge = judged()
    whole = 1.0 + max(SPREADS * np.sqrt(correlation / 500.0), known)
    for side in (0.999, 1.001):
        assert _above_floor(judge, fit(side * whole), correlation, known) == (side > 1.0)
    block = 1.0 + known + BLOCK_SPREADS * np.sqrt(correlation / 200.0)
    for side in (0.999, 1.001):
        f = fit(0.1)
        f.held_out[1] = 100.0 * (side * block) ** 2
        if np.sqrt(f.held_out.sum() / 250.0) < whole:
            assert _above_floor(judge, f, correlation, known) == (side > 1.0)
        raster = judged(expected=lambda: np.array([1.0, 1.44, 1.0, 1.0]))  # where the raster makes expect more
        f.held_out[1] *= 1.44
        if np.sqrt(f.held_out.sum() / 250.0) < whole:
            assert _above_floor(raster, f, correlation, known) == (side > 1.0)
    for many, counts in ((19, False), (21, True)):  # a block of less than a fifth of the fullest says nothing
        few, f = judged(samples=np.array([100, 100, many, 50 - many])), fit(0.1)
        f.held_out[2] = many * (1.5 + 1.02 * BLOCK_SPREADS * np.sqrt(correlation / (2.0 * many))) ** 2
        assert _above_floor(few, f, correlation, 0.5) == counts


def test_rivals_may_have_more_between_them_the_more_is_left_above_the_noise() -> None:
    judge = judged()
    floor = 250.0 * (1.0 + FLOOR_KNOWN) ** 2
    assert rival_nats(judge, floor, 1.0) == rival_nats(judge, 100.0, 1.0) == RIVAL_NATS
    for left in (23.0, 25.0, 200.0):
        wanted = max(RIVAL_NATS, RIVAL_SHARE * 0.5 * left / 2.0)
        assert rival_nats(judge, floor + left, 2.0) == pytest.approx(wanted)


def test_what_a_fit_gains_is_in_nats_and_in_deviations_of_its_whole_or_of_its_two_best_blocks() -> None:
    before, after = fit(2.0), fit(1.5)
    for c in (1.0, 4.0):
        nats, spreads = gain(before, after, c)
        assert nats == pytest.approx(0.5 * 250.0 * (4.0 - 2.25) / c)
        assert spreads == pytest.approx(0.5 * np.sqrt(250.0) / np.sqrt(c / 2.0))
    local = fit(2.0)
    local.held_out[:2] = [100.0 * 9.0, 100.0 * 4.0]
    nats, spreads = gain(local, fit(2.0), 1.0)
    whole = np.sqrt(local.held_out.sum()) - np.sqrt(1000.0)
    assert spreads == pytest.approx(max(whole * np.sqrt(2.0), SPREADS / BLOCK_SPREADS * np.sqrt(2.0) * 0.5 * 10.0))


def test_another_is_worse_that_leaves_more_or_is_freer() -> None:
    judge, best = judged(), fit(0.5)
    for nats, worse in ((2.9, False), (3.1, True)):
        other = replace(best, held_out=best.held_out + np.array([2.0 * nats, 0.0, 0.0, 0.0]))
        assert gain(other, best, 1.0)[1] > RIVAL_SPREADS
        assert _worse(judge, other, best, 1.0, 0.0) == worse
    # of a great error nats tell a fall that is none in deviations
    loud, more = fit(40.0), fit(40.0)
    more.held_out = loud.held_out * (1.0 + 1e-4)
    assert not _worse(judge, more, loud, 1.0, 0.0)
    for freer, worse in ((2.9, False), (3.1, True)):
        assert _worse(judge, best, best, 1.0, freer) == worse
    better = replace(best, held_out=best.held_out - np.array([4.0, 0.0, 0.0, 0.0]))  # two nats make up for freedom
    for freer, worse in ((4.9, False), (5.1, True)):
        assert _worse(judge, better, best, 1.0, freer) == worse


def test_rivals_are_those_given_and_others_until_ninety_per_cent_are_named() -> None:
    shares = {"a": 0.5, "b": 0.05, "c": 0.3, "d": 0.15}
    assert with_rivals("a", [], shares) == ["c", "d"]
    assert with_rivals("a", ["b"], shares) == ["b", "c", "d"]
    assert with_rivals("a", [], {"a": 0.91, "b": 0.09}) == [] == with_rivals("a", [], {"a": 1.82, "b": 0.18})
    assert with_rivals("a", [], {"a": 0.89, "b": 0.11}) == ["b"]
    given: list[str] = []
    with_rivals("a", given, shares)
    assert given == []


@pytest.mark.parametrize(("excess", "most"), [(1.0, 1.05), (1.2, 1.01 * 1.2)])
def test_a_rival_of_another_subsystem_comes_as_close_as_the_answer_or_to_what_is_tolerated(
    excess: float, most: float
) -> None:
    d: Any = SimpleNamespace(excess=excess)
    for side in (0.999, 1.001):
        assert as_close(judged(), d, fit(side * most)) == (side < 1.0)


def test_an_effect_could_have_been_seen_from_twice_the_nats_on() -> None:
    criterion = LikelihoodAcceptance(judged())
    for c in (1.0, 5.0):
        criterion.correlation = c
        assert criterion.shows(2.0 * NATS * c) and not criterion.shows(2.0 * NATS * c - 1e-6)
    assert criterion.order(fit(2.0)) == 1000.0 and criterion.spared(f := fit()) is f
    assert not criterion.accepts(f, f)
    assert (criterion.most, criterion.leaders, criterion.finished, criterion.least, criterion.roams) == (
        4, 5, 3, NATS, False,
    )  # fmt: skip


# ---- an unknown noise ------------------------------------------------------------------------------------------------


def test_the_score_counts_the_whole_the_blocks_and_the_parameters() -> None:
    judge, f = judged(), fit(2.0, 5)
    f.held_out = np.array([400.0, 900.0, 25.0, 7.0])  # the third is below its noise, the last has no samples
    s, m = np.array([400.0, 900.0, 50.0]), np.array([100.0, 100.0, 50.0])
    wanted = 0.25 * np.log(s.sum() / 250.0) + 0.25 * np.mean(np.log(s / m)) + 5 * PER_PARAMETER
    assert score(judge, f) == pytest.approx(wanted)
    some = np.array([0, 0, 2])
    again = 0.25 * np.log(850.0 / 250.0) + 0.25 * np.mean(np.log([4.0, 4.0, 1.0])) + 5 * PER_PARAMETER
    assert score(judge, f, some) == pytest.approx(again)
    judge.stage.grain = 0.2
    assert score(judge, f) == pytest.approx(0.5 * np.log(1332.0 / 250.0) / 0.2 + 5 * PER_PARAMETER)
    criterion = RelativeErrorAcceptance(judged())
    assert criterion.order(f) == round(wanted, 4)


def test_what_a_search_may_do_and_what_it_notes_where_nobody_knows_the_noise() -> None:
    criterion = RelativeErrorAcceptance(judged())
    criterion.begin(fit(30.0))
    assert criterion.form == pytest.approx(30.0 * FORM)
    assert criterion.shows(1e-12) and not criterion.shows(0.0)
    for error, fails in ((1.099, False), (1.101, True)):
        assert criterion.fails(fit(error)) == fails
    same = fit(2.0)
    assert not criterion.accepts(same, same)
    per_cent, improved = criterion.gain(fit(4.0), fit(3.0))
    assert per_cent == pytest.approx(25.0) and improved == 1.0
    assert (criterion.most, criterion.leaders, criterion.fitted, criterion.finished, criterion.roams) == (
        6, 4, 8, 3, True,
    )  # fmt: skip


def searching(fits: dict[tuple[str, ...], Any], **more: Any) -> Any:
    """A search that has made these fits."""
    by = {frozenset(k): f for k, f in fits.items()}
    given: dict[str, Any] = {
        "best_of": lambda sets: sorted(
            (by[frozenset(s)] for s in sets if frozenset(s) in by), key=lambda f: float(f.held_out.sum())
        ),
        "joined": lambda effects: by[frozenset(effects)], "pruned": lambda f: f, "simpler": lambda f, drop: [],
        "without": lambda f, drop: by[frozenset(f.effects) - {drop}], "base": by.get(frozenset()), "fits": by,
    }  # fmt: skip
    return SimpleNamespace(**given | more)


def criterion_of(names: str = "abc", parameters: dict[str, int] | None = None) -> RelativeErrorAcceptance:
    judge = judged()
    judge.stage.effects = [
        SimpleNamespace(name=n, parameters=[Parameter(f"p{k}", 0.0, "1") for k in range((parameters or {}).get(n, 1))])
        for n in names
    ]
    return RelativeErrorAcceptance(judge)


@pytest.mark.parametrize("side", [0.99, 1.01])
def test_an_effect_is_exchanged_for_one_that_is_better_by_its_score_and_leaves_no_more(side: float) -> None:
    criterion = criterion_of()
    now = fit(4.0, 3, ("a",))
    better = fit(4.0 * float(np.exp(-side * BETTER)), 3, ("b",))
    got = criterion._swapped(searching({("a",): now, ("b",): better}), now, ["a", "b"])
    assert (got is better) == (side > 1.0)
    big = fit(3.0, 3, ("b",))
    left = searching({("a",): now, ("b",): big})
    assert criterion._swapped(left, now, ["a", "b"]) is big and criterion._swapped(left, now, ["a"]) is now
    freer = fit(3.0, 4, ("b",))  # one with more parameters must be worth them
    for worth in (False, True):
        criterion.accepts = lambda before, after, worth=worth: worth  # type: ignore[method-assign, misc]
        assert (criterion._swapped(searching({("a",): now, ("b",): freer}), now, ["a", "b"]) is freer) == worth
    worse = searching({("a",): now, ("b",): big}, pruned=lambda f: fit(4.0, 3, ("c",)))
    assert criterion._swapped(worse, now, ["a", "b"]) is now  # what is needed of it in the end is no better


def test_a_set_leaves_more_of_the_whole_log_from_a_twentieth_on() -> None:
    criterion = criterion_of()
    for side in (0.999, 1.001):
        assert criterion._leaves_more(fit(2.0), fit(2.0 * float(np.exp(side * RIVAL)))) == (side > 1.0)


def test_a_law_of_many_numbers_gives_way_to_one_or_two_of_fewer() -> None:
    criterion = criterion_of("abcd", {"a": 3})
    law, bare = fit(2.0, 5, ("a",)), fit(9.0, 2, ())
    one, two, pair = fit(3.0, 3, ("b",)), fit(4.0, 3, ("c",)), fit(2.0, 4, ("b", "c"))
    accepted: set[tuple[tuple[str, ...], tuple[str, ...]]] = set()
    criterion.accepts = lambda before, after: (before.effects, after.effects) in accepted  # type: ignore[method-assign]
    fits = {("a",): law, (): bare, ("b",): one, ("c",): two, ("b", "c"): pair}
    names = list("abcd")
    assert criterion._simpler(searching(fits), law, names) is law  # nothing is accepted over the model without it
    accepted |= {((), ("b",)), ((), ("c",))}
    assert criterion._simpler(searching(fits), law, names) is one
    accepted |= {(("b",), ("b", "c"))}
    assert criterion._simpler(searching(fits), law, names) is pair
    accepted |= {(("b", "c"), ("a",)), (("b",), ("a",)), (("c",), ("a",))}
    assert criterion._simpler(searching(fits), law, names) is law  # it is worth its numbers
    accepted -= {(("c",), ("a",))}
    assert criterion._simpler(searching(fits), law, names) is two
    held = fit(1.0, 4, ("d",))
    assert criterion._simpler(searching(fits, simpler=lambda f, drop: [held]), law, names) is held
    small = criterion_of("ab", {"a": 2})
    small.accepts = lambda before, after: (before.effects, after.effects) in {((), ("b",))}  # type: ignore[method-assign]
    assert small._simpler(searching({("a",): law, (): bare, ("b",): one}), law, ["a", "b"]) is one


def test_what_makes_a_validation_log_worse_or_none_better_is_left_out() -> None:
    levels: dict[tuple[str, ...], dict[str, float]] = {}

    def figures(theta: Array) -> dict[str, float]:
        return levels[of[float(theta[0])]]

    a, b, both, bare = fit(2.0, 3, ("a",)), fit(2.0, 3, ("b",)), fit(1.0, 4, ("a", "b")), fit(9.0)
    for k, f in enumerate((bare, a, b, both)):
        f.theta = np.array([float(k)])
    of: dict[float, tuple[str, ...]] = {0.0: (), 1.0: ("a",), 2.0: ("b",), 3.0: ("a", "b")}
    search = searching({(): bare, ("a",): a, ("b",): b, ("a", "b"): both})
    for harm, kept in ((0.99 * HARM, both), (1.01 * HARM, a)):
        criterion = criterion_of("ab")
        criterion.figures = figures
        criterion.tests = frozenset("v")
        levels |= {(): {"f": 1.0, "v": 1.0}, ("a",): {"f": 0.5, "v": 0.5}, ("b",): {"f": 0.5, "v": 0.5 - 0.5 * harm},
                   ("a", "b"): {"f": 0.2, "v": 0.5 + harm}}  # fmt: skip
        levels["b",] = {"f": 0.5, "v": 0.9}
        assert criterion._harmless(search, both) is kept
        assert list(criterion.left_out) == (["b"] if kept is a else [])
        assert criterion.notes == (
            [f"b fits, but is not named: makes v worse: {np.exp(harm):.2f} times the error"] if kept is a else []
        )
    for use, kept in ((1.01 * LEAST_USE, a), (0.99 * LEAST_USE, bare)):
        criterion = criterion_of("ab")
        criterion.figures = figures
        levels |= {(): {"f": 1.0}, ("a",): {"f": 1.0 - use}}
        assert criterion._harmless(search, a) is kept
    criterion.tests, levels[()], levels["a",] = frozenset("v"), {"v": 1.0}, {"v": 1.0 + 1.01 * HARM}
    assert criterion._harmless_together(search, a) is bare and criterion.left_out == {
        "a": f"makes v worse: {np.exp(1.01 * HARM):.2f} times the error"
    }
    assert criterion._tested(a) == pytest.approx(1.0 + 1.01 * HARM)
    criterion.figures = None
    assert criterion._harmless(search, a) is a


@pytest.mark.parametrize("left", [1.24, 1.26])
@pytest.mark.parametrize("named", [False, True])
def test_the_verdict_is_unknown_from_a_quarter_above_the_noise_where_nothing_is_named(
    left: float, named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[Any] = []
    shares = [0.0]

    def answer(judge: Any, verdict: str, *more: Any) -> Any:
        said.append((verdict, more))
        return SimpleNamespace()

    monkeypatch.setattr(relative_error_acceptance, "answer_of", answer)
    monkeypatch.setattr(relative_error_acceptance, "at_bound", lambda stage, f, name: True)
    monkeypatch.setattr(relative_error_acceptance, "structure", lambda judge, f: shares[-1])
    criterion = criterion_of()
    base, found = fit(9.0), [SimpleNamespace(effect="a", rivals=["r"])] if named else []
    out = criterion.conclude(base, fit(left, 3, ("a",)), found, [], [])  # type: ignore[arg-type]
    assert said[-1][0] == ("missing" if named else "unknown" if left > UNKNOWN else "none")
    assert out.criterion == "error_share" and out.gain == "fall of the held-out error [%]"
    assert out.notes == (["a stands at the end of its physical range: the log would have it go on"] if named else [])
    for share, verdict in ((0.249, "none"), (0.251, "unknown")):
        shares.append(share)
        criterion.conclude(base, fit(1.2), [], [], [])
        assert said[-1][0] == verdict
        criterion.conclude(base, fit(1.05), [], [], [])
        assert said[-1][0] == "none"  # what agrees with the noise has no structure to be asked for
    edge = np.sqrt(1.0 + MOST_LEFT * 80.0)
    for side in (0.999, 1.001):
        f = fit(side * float(edge), 3, ("a",))
        out = criterion.conclude(base, f, [SimpleNamespace(effect="a", rivals=["r", "s", "t"])], [], [])  # type: ignore[list-item]
        assert said[-1][0] == ("missing" if side < 1.0 else "unknown")
        if side > 1.0:
            assert out.nearest == ["a", "r", "s"] and said[-1][1][1] is base and said[-1][1][2] == []
            assert out.refused == ["a comes nearest and leaves 50% of the error"]


def test_the_structure_of_an_error_is_asked_of_channels_and_not_of_time() -> None:
    n = 2400
    rng = np.random.default_rng(3)
    u, e = rng.standard_normal(n), rng.standard_normal((1, n))
    judge = judged(valid=np.ones((1, n), bool), block_of=np.arange(n) // 100, errors=lambda thetas: e[None])
    stage = judge.stage
    stage.t, stage.outputs = np.arange(n), ("y",)
    f: Any = SimpleNamespace(theta=np.zeros(1))
    stage.regimes = {"time": np.arange(n), "log": np.ones(n), "y": e[0]}
    assert structure(judge, f) == 0.0
    for law in (u, np.abs(u), np.append(np.zeros(10), u[:-10]), np.sign(u) * np.sqrt(np.abs(u))):
        stage.regimes = {"u": u}
        e[0] = 3.0 * law + rng.standard_normal(n)
        share = 1.0 - 1.0 / np.mean(e[0] ** 2)
        assert structure(judge, f) == pytest.approx(share, abs=0.06)
        stage.regimes = {"u": 100.0 * u + 7.0}
        assert structure(judge, f) == pytest.approx(share, abs=0.06)
    e[0] = rng.standard_normal(n)
    assert structure(judge, f) < 0.02


# ---- rules -----------------------------------------------------------------------------------------------------------


def test_a_remainder_is_noise_little_or_too_much() -> None:
    r = Remainder(5.0, 2.0, 2.5, 2, 400, 3.0)
    assert r.explained == pytest.approx(21.0 / (25.0 - 1.01**2)) and r.share_left == pytest.approx(3.0 / 24.0)
    assert Remainder(1.0, 0.9, 1.0, 1).explained == np.inf and Remainder(1.0, 0.5, 1.0, 1).share_left == 0.0
    assert EXPLAINS_HALF.applies(r) and not EXPLAINS_HALF.applies(replace(r, effects=0))
    for after, much in ((UNKNOWN - 1e-3, False), (UNKNOWN + 1e-3, True)):
        assert LEAVES_A_QUARTER.applies(replace(r, after=after)) == much
    excess, worst = LEAVES_LITTLE
    v = excess.verdict(r)
    assert v.value == 3.0 and v.limit == pytest.approx(24.0 * excess.limit(replace(r, before=np.sqrt(2.0))))
    one, two, four = (worst.limit(replace(r, effects=k)) - 1.0 for k in (1, 2, 4))
    assert one == pytest.approx(2.0 * two) == pytest.approx(4.0 * four)
    assert worst.limit(replace(r, effects=0)) - 1.0 == pytest.approx(one)
    assert worst.verdict(r).value == 2.5 and worst.verdict(replace(r, worst=1.0)).value == 2.0
    spread = SPREADS * np.sqrt(3.0 / 800.0 + 3.0 / 400.0)
    for side in (-1e-3, 1e-3):
        assert replace(r, after=1.0 + spread + side).is_noise == (side < 0.0)


def test_a_comparison_counts_parameters_shares_and_blocks() -> None:
    judge = judged()
    c = Comparison(judge, fit(4.0, 3), fit(2.0, 6), 2.0, 0.5)
    assert c.further == 2 and Comparison(judge, fit(4.0, 3), fit(2.0, 3)).further == 0
    assert c.share_of_excess == pytest.approx(250.0 * 12.0 / (250.0 * 15.0))
    assert Comparison(judge, fit(1.0), fit(0.5)).share_of_excess == np.inf
    assert c.squares == (4000.0, 1000.0) and c.share_of_fall == pytest.approx(0.75)
    learnt = replace(c, after=replace(fit(2.0, 6), cost=9.0 * SAMPLES))
    assert learnt.share_of_fall == pytest.approx(250.0 * 7.0 / 4000.0)  # no more than falls where all is fitted
    assert len(c.block_changes) == 3 and c.share_improved == 1.0
    mixed = replace(c, after=fit(2.0))
    mixed.after.held_out[1] = 100.0 * 64.0
    ups = np.log([4.0, 0.25, 4.0])
    np.testing.assert_allclose(mixed.block_changes, ups)
    assert mixed.share_improved == pytest.approx(2.0 / 3.0)
    assert Comparison(judge, fit(4.0), fit(4.0)).share_improved == 0.0
    tall = replace(c, form=3.0)
    assert tall.least_share == pytest.approx(max(0.2 * 3750.0, 0.1 * 250.0, 9.0 * 250.0) / 4000.0)
    assert replace(c, before=fit(1.01), form=0.0).least_share == pytest.approx(25.0 / (1.01**2 * 250.0))


def test_rows_that_nothing_was_fitted_to_and_all_rows_must_fall() -> None:
    e = {"f": np.ones((1, 90)), "v": np.ones((1, 60)), "w": np.full((1, 30), np.nan)}
    now = {"f": np.sqrt(0.9) * e["f"], "v": np.sqrt(0.5) * e["v"], "w": e["w"]}
    rows = AllRows(e, now, frozenset("vw"))
    assert (
        rows.least_gain[0] == pytest.approx(15.0)
        and rows.least_gain[1] == "v"
        and rows.many == {"f": 90, "v": 60, "w": 0}
    )
    fall = (np.sqrt(150.0) - np.sqrt(111.0)) * np.sqrt(2.0)
    assert rows.fall == pytest.approx(fall)
    assert fall < SPREADS
    assert rows.objection() == f"the error falls by {fall:.1f} standard deviations of its noise only"
    assert AllRows(e, now, frozenset()).least_gain == (np.inf, "")


def test_decisions_as_json_have_no_number_that_is_none() -> None:
    d = Decision(("a",), (), (Verdict("gain", np.inf, 2.0, True), Verdict("share", 0.5, np.nan, False)))
    (row,) = decisions_json([d], "shaft")
    assert row == {
        "stage": "shaft", "added": ["a"], "beside": [], "accepted": False,
        "rules": [{"rule": "gain", "value": None, "limit": 2.0, "holds": True},
                  {"rule": "share", "value": 0.5, "limit": None, "holds": False}],
    }  # fmt: skip
    assert LogChanges({"f": -1.0}).worst is None and LogChanges({"v": 0.1, "w": 0.2}, frozenset("vw")).worst == "w"


# ---- excerpts --------------------------------------------------------------------------------------------------------


def test_a_direction_is_tried_all_round_at_its_middle_size_and_what_moves_one_output_goes_alone() -> None:
    phase = Parameter("phase", 0.0, "rad", 0.0, 6.0, period=6.0, shape=True)
    turning = Effect("run-out", (Parameter("size", 0.0, "mm"), phase), ((1.0, 0.5), (2.0, 0.5), (3.0, 0.5)))
    tries = _tried(turning)
    assert [s for s, _ in tries] == [2.0] * len(tries) and len(tries) >= 8
    np.testing.assert_allclose([p for _, p in tries], 6.0 * np.arange(len(tries)) / len(tries))
    plain = Effect("gain", (Parameter("a", 0.0, "1"), Parameter("b", 0.0, "1")), ((1.0, 1.0),))
    assert _tried(plain) == [(1.0, 1.0)]
    assert _ways(plain, [0, 1], 3) == [[0], [1]] and _ways(plain, [0, None], 3) == [[0, 1, 2]]
    assert _ways(plain, [1, 1], 3) == [[0, 1, 2]]
    shaped = replace(plain, parameters=(plain.parameters[0], replace(plain.parameters[1], shape=True)))
    assert _ways(shaped, [0, None], 2) == [[0, 1]]


def test_an_excerpt_has_whole_windows_and_those_where_the_model_fails_most() -> None:
    n = 4000
    e = np.zeros((2, n))
    e[0, 3000:3100] = 5.0
    e[1, 700:800] = 4.0
    stage = SimpleNamespace(t=0.1 * np.arange(n), window=2.5, counted=None)
    judge: Any = SimpleNamespace(stage=stage, errors=lambda thetas: e[None])
    at = excerpt_of(judge, SimpleNamespace(theta=np.zeros(1)), 90, 800)  # type: ignore[arg-type]
    pieces = at.reshape(-1, 100)  # windows have 25 samples; 90 are nearest to four of them
    assert len(pieces) == 8 and all(p.tolist() == list(range(p[0], p[0] + 100)) for p in pieces)
    assert {3000, 700} <= set(pieces[:, 0].tolist()) and (pieces[:, 0] % 100 == 0).all()
    even = excerpt_of(judge, None, 90, 800).reshape(-1, 100)[:, 0]
    assert even.tolist() == (np.linspace(0, 39, 4).round().astype(int) * 100).tolist()
    assert len(excerpt_of(judge, None, 90, 50)) == 100  # two pieces at least, half of them evenly
    # pieces of which little counts tell little
    stage.counted = lambda rows: np.where(rows // 100 % 2 == 0, 1.0, 0.0) * (rows % 100 < 40)
    assert _telling(stage, 100, 40, 8).tolist() == list(range(0, 40, 2))  # type: ignore[arg-type]
    assert len(_telling(stage, 100, 40, 30)) == 40  # type: ignore[arg-type]
