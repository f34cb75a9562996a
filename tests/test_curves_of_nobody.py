"""Smooth curves: a basis that is what it says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vaneloop.identification.candidates.spline_basis import Basis, basis_of


def values(basis: Basis, x: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
    """The curve with these amplitudes at ``x``."""
    return basis.design(x) @ basis.turn @ amplitudes


def a_log(seed: int, n: int = 3000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.standard_normal(n)) * 10.0 ** rng.uniform(-6, 6) + rng.normal()


@given(st.integers(0, 200))
def test_functions_have_unit_size_stand_apart_and_bend_more_and_more(seed: int) -> None:
    x = a_log(seed)
    basis = basis_of(x)
    assert basis is not None
    rounding = 1e-9 * (basis.high - basis.low)
    inside = x[(x >= basis.low - rounding) & (x <= basis.high + rounding)]
    functions = np.array([values(basis, inside, e) for e in np.eye(len(basis.bend))])
    assert np.allclose(functions @ functions.T / len(inside), np.eye(len(functions)), atol=0.05)
    assert np.ptp(functions[0]) < 1e-9
    line = np.polyfit(inside, functions[1], 1)
    assert np.allclose(np.polyval(line, inside), functions[1], atol=1e-6)
    assert basis.bend[0] == basis.bend[1] == 0.0 and basis.bend[2] == 1.0 and (np.diff(basis.bend[2:]) >= 0.0).all()
    straight = values(basis, inside, np.array([0.3, -2.0] + [0.0] * (len(functions) - 2)))
    assert np.allclose(np.polyval(np.polyfit(inside, straight, 1), inside), straight, atol=1e-6)


@given(st.integers(0, 200), st.floats(0.0, 1e3))
def test_a_basis_reaches_as_far_as_the_log_but_not_to_a_stray_value(seed: int, times: float) -> None:
    x = a_log(seed)
    x = np.append(x, x.max() + times * np.ptp(x))
    basis = basis_of(x)
    assert basis is not None
    low, high = np.quantile(x, [0.001, 0.999])
    apart = 0.25 * (high - low)
    assert np.isclose(basis.low, max(x.min(), low - apart)) and np.isclose(basis.high, min(x.max(), high + apart))


@pytest.mark.parametrize("x", [np.zeros(100), np.full(100, np.nan), np.arange(5.0)])
def test_a_quantity_that_has_hardly_moved_has_no_basis(x: np.ndarray) -> None:
    assert basis_of(x) is None


def test_a_quantity_of_two_values_has_a_constant_and_a_straight_line() -> None:
    basis = basis_of(np.tile([-1.0, 1.0, 1.0], 100))
    assert basis is not None
    mean, line = values(basis, np.array([-1.0, 0.0, 1.0]), np.array([2.0, 0.0])), np.array([0.0, 1.0])
    assert np.allclose(mean, 2.0)
    assert np.allclose(np.diff(values(basis, np.array([-1.0, 0.0, 1.0]), line), 2), 0.0, atol=1e-9)
