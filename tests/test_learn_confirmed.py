"""What confirms a curve: another amplitude, which a part of one sine is not, and another log."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vaneloop.base.forms import FORMS
from vaneloop.discrepancy.formulas import begin
from vaneloop.discrepancy.models.confirmed import OTHER, moves, stands_before
from vaneloop.discrepancy.models.memory import NO_TURN, swings

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
    assert np.median(np.array(ways)[large]) > OTHER * np.median(np.array(ways)[~large])
    assert far.max() < OTHER * far.min()


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
