"""What confirms a curve: another amplitude, which a part of one sine is not, and another log."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vaneloop
from vaneloop import Record, System, unknown
from vaneloop.base.forms import FORMS
from vaneloop.identification.candidates.closed_forms import begin
from vaneloop.identification.candidates.library import FORCE_LAWS
from vaneloop.identification.settings import NO_TURN, OTHER_AMPLITUDE
from vaneloop.identification.unmodelled import curve_choice as confirmed
from vaneloop.identification.unmodelled.curve_choice import earning_by_formula, moves, stands_before
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.user_models.exogenous_regressors import swings

T = np.linspace(0.0, 28.0, 5601)  # s


def moved(course: np.ndarray, blocks: int) -> np.ndarray:
    """How wide a channel swings in each of so many blocks."""
    tried: Any = SimpleNamespace(
        candidate=SimpleNamespace(quantity=SimpleNamespace(course=[course])),
        judge=SimpleNamespace(
            measured=np.zeros((1, len(course))), block_start=np.arange(blocks) * (len(course) // blocks)
        ),
    )
    return moves(tried)[0]


@given(st.floats(0.2, 3.0), st.floats(0.0, 6.0), st.floats(1e-3, 1e3))
def test_a_sine_swings_by_twice_its_amplitude_wherever_one_looks(frequency: float, phase: float, size: float) -> None:
    q = size * np.sin(2.0 * np.pi * frequency * T + phase)
    assert swings(q) == pytest.approx(2.0 * size, rel=0.02)


def test_parts_of_one_sine_are_no_other_amplitude() -> None:
    """Blocks shorter than a period go by other ways each, and all belong to the same swing."""
    far = moved(np.sin(2.0 * np.pi * 0.25 * T), 24)
    ways = [np.ptp(part) for part in np.array_split(np.sin(2.0 * np.pi * 0.25 * T), 24)]
    large = np.array(ways) > np.median(ways)
    assert np.median(np.array(ways)[large]) > OTHER_AMPLITUDE * np.median(np.array(ways)[~large])
    assert far.max() < OTHER_AMPLITUDE * far.min()


def test_a_sine_of_two_amplitudes_has_two() -> None:
    far = moved(np.where(T < 14.0, 1.0, 0.4) * np.sin(2.0 * np.pi * T / 2.0), 14)
    assert far[1:6] == pytest.approx(2.0, rel=1e-3)
    assert far[8:13] == pytest.approx(0.8, rel=1e-3)


def test_noise_is_no_turn_and_what_stands_still_has_no_swing() -> None:
    noise = 0.2 * NO_TURN * np.random.default_rng(1).uniform(-1.0, 1.0, len(T))
    assert swings(T / T[-1] + noise) == pytest.approx(1.0, abs=0.01)
    assert not swings(np.ones(50)).any()


@pytest.mark.parametrize(
    "named, learned, tests, stands",
    [
        (300.0, 240.0, {}, False),  # both fail, and the one log that both were fitted to is all that tells them apart
        (300.0, 140.0, {}, True),
        (300.0, 240.0, {"other": -0.1}, True),
        (300.0, 240.0, {"other": -0.01}, False),
        (300.0, 1.0, {"other": 0.2}, False),
        (300.0, 140.0, {"one": -0.5, "other": 0.2}, False),
        (1.6, 1.1, {}, True),
        (1.6, 1.1, {"other": 0.0}, True),
        (1.1, 1.0, {}, True),
    ],
)
def test_what_fails_too_stands_before_names_where_another_log_confirms_it(
    named: float, learned: float, tests: dict[str, float], stands: bool
) -> None:
    assert stands_before(named, learned, tests) is stands


@pytest.mark.parametrize(
    ("formula_left", "on_test", "stands"), [(1.05, -0.1, True), (1.05, 0.2, False), (1.8, 0.0, False)]
)
def test_before_a_name_stands_the_formula_is_asked(
    monkeypatch: pytest.MonkeyPatch, formula_left: float, on_test: float, stands: bool
) -> None:
    """A curve harms a test log at its ends; its formula may not, and must then itself be what stands."""

    def tried(left: float, change: float) -> Any:
        return SimpleNamespace(
            judge=None, fit=left, formulas=None, change=change,
            candidate=SimpleNamespace(axes=(None,), quantity=SimpleNamespace(stops=())),
        )  # fmt: skip

    named, curve, formula = tried(1.9, 0.0), tried(1.06, 0.2), tried(formula_left, on_test)
    asked = []
    monkeypatch.setattr(confirmed, "rms_of", lambda _, fit: fit)
    monkeypatch.setattr(confirmed, "better_than", lambda *_: True)
    monkeypatch.setattr(confirmed, "fitted_formulas", lambda _, t: asked.append(t) or [(None, formula)])
    learner: Any = SimpleNamespace(
        speaks=True, ground=SimpleNamespace(tests={"test"}), change=lambda _, t: {"test": t.change, "fitted": 0.0}
    )
    assert confirmed.instead_of(learner, named, [curve]) is stands
    assert asked == [curve]
    learner.speaks = False
    assert not confirmed.instead_of(learner, named, [tried(1.06, 0.2)])


@pytest.mark.parametrize("name", [f.name for f in FORMS if f.inner and f.name not in ("step", "Arrhenius", "quotient")])
def test_a_formula_comes_as_near_as_from_each_of_its_begins_alone(name: str) -> None:
    """Against scipy's least squares of all its numbers, from where the form begins best; Arrhenius' law is of
    temperatures, and a quotient may end beside a pole.
    """
    from scipy.optimize import least_squares

    form = next(f for f in FORMS if f.name == name)
    rng = np.random.default_rng(7)
    q = np.linspace(-1.0, 2.5, 257)
    for y in (np.tanh(2.0 * (q - 0.6)), q**2 + 0.3 * np.sin(4.0 * q), np.maximum(q - 0.4, 0.0)):
        y = y + 0.02 * rng.standard_normal(len(q))
        got = begin(form, q, y, free=())
        assert got is not None
        assert np.sum((form.value(q, got[0]) - y) ** 2) == pytest.approx(got[1] * np.sum(y * y), rel=1e-9)
        again = least_squares(lambda n, y=y: form.value(q, n) - y, got[0], x_scale=np.maximum(np.abs(got[0]), 1e-3))
        assert 2.0 * again.cost > 0.999 * got[1] * np.sum(y * y)


def test_a_curve_at_its_place_is_asked_by_its_formula_however_far_its_splines_go_astray() -> None:
    """A block alone has been as fast: left out, splines of the speed say anything there."""

    def tried(near: bool, score: float, left: float, good: bool, remembers: bool = False) -> Any:
        quantity = SimpleNamespace(name="q", remembers=remembers, period=0.0, less=None)
        return SimpleNamespace(
            candidate=SimpleNamespace(near=near, at="force.force", quantity=quantity),
            score=score, fit=SimpleNamespace(cost=np.array([left**2 * 100.0])), judge=SimpleNamespace(n=100),
            loose=[SimpleNamespace(good=good)],
        )  # fmt: skip

    learner: Any = SimpleNamespace(
        score=lambda t, among: t.score, accepts=lambda _, f: f.good, ground=SimpleNamespace(shares=False)
    )
    before = tried(False, 0.0, 4.0, False)
    best, elsewhere = tried(False, 0.4, 1.0, False), tried(False, 2.0, 0.9, True)
    home, corner = tried(True, 2.0, 0.9, True), tried(True, 2.0, 0.9, False)
    poor, stops = tried(True, 2.0, 3.5, True), tried(True, 2.0, 0.9, True, remembers=True)
    every = [best, elsewhere, home, corner, poor, stops]
    assert earning_by_formula(learner, before, every, every) == [home]


@pytest.mark.slow
def test_a_friction_is_tried_with_its_jump_though_its_splines_leave_more_than_another_curve(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Enough(Exception):
        pass

    finalists: list[Any] = []
    found = CurveSearch.finalists

    def first(self: CurveSearch, current: Any) -> Any:
        finalists.extend(found(self, current))
        raise Enough

    monkeypatch.setattr(CurveSearch, "finalists", first)
    t, rng = np.arange(0.0, 16.0, 0.01), np.random.default_rng(3)
    phases = zip((0.3, 0.7, 1.1, 1.7), rng.uniform(0.0, 6.0, 4), strict=True)
    x = np.sum([np.sin(2.0 * np.pi * f * t + phase) / f for f, phase in phases], axis=0)
    v = np.gradient(x, t, edge_order=2)
    force = 40.0 * x + 0.4 * v + 1.5 * np.sign(v) + 0.02 * rng.standard_normal(len(t))
    system = System(
        "slide", "force", lambda u, p: p.stiffness * u.position + p.damping * u.velocity, position="way",
        outputs={"force": "N"}, parameters=[unknown("stiffness", 40.0, "N/m"), unknown("damping", 1.0, "N s/m")],
        without=[f"force.{law}" for law in FORCE_LAWS if law != "force_offset"],
    )  # fmt: skip
    with pytest.raises(Enough):
        vaneloop.learn([Record("log", t, {"way": x, "force": force})], system)
    assert finalists[0].candidate.name != "force.curve_of_velocity"
    (friction,) = [f for f in finalists if f.candidate.name == "force.curve_of_velocity"]
    assert friction.candidate.jump
    assert np.sqrt(friction.fit.cost.sum() / friction.judge.n) < 5.0  # 39 without
