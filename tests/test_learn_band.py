"""The band of a learned curve: it holds the curve as a whole, and is no wider than that takes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vaneloop.base.curve import POINTS
from vaneloop.identification.candidates.spline_basis import basis_of
from vaneloop.identification.unmodelled.learned_law import band_of

BLOCKS, SAMPLES = 14, 60  # samples of each


def a_fit(seed: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """A curve fitted to noisy samples of one that is as smooth as it was known to be; that one, and the design."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.0, 1.0, BLOCKS * SAMPLES)
    basis = basis_of(q)
    assert basis is not None
    within = np.append([2.0, 2.0], 1.0 / np.sqrt(basis.bend[2:]))
    true = within * rng.standard_normal(len(within))
    rows = basis.design(q) @ basis.turn
    prior = within**-2.0
    y = rows @ true + rng.standard_normal(len(q))
    theta = np.linalg.solve(rows.T @ rows + np.diag(prior), rows.T @ y)
    parts = np.split(np.arange(len(q)), BLOCKS)
    fit = SimpleNamespace(
        free=np.arange(len(theta)), prior=prior, theta=theta,
        normals=np.array([rows[k].T @ rows[k] for k in parts]),
        gradients=np.array([rows[k].T @ (y - rows @ theta)[k] for k in parts]),
    )  # fmt: skip
    judge = SimpleNamespace(
        scale=np.ones(len(theta)), n_blocks=BLOCKS, bounds=lambda: (np.full(len(theta), -np.inf), np.inf * theta**2),
        stage=SimpleNamespace(index=lambda: {"curve": slice(0, len(theta))}, neutral=lambda: np.zeros(len(theta))),
    )  # fmt: skip
    design = basis.design(np.linspace(basis.low, basis.high, POINTS)) @ basis.turn
    tried = SimpleNamespace(
        judge=judge, fit=fit, candidate=SimpleNamespace(name="curve"), table=lambda: (design.__matmul__, theta)
    )
    return tried, true, design


@pytest.mark.slow
def test_in_nine_logs_of_ten_the_law_is_within_its_band_nearly_everywhere() -> None:
    """And the band is no wider than that takes: point by point 1.645 spreads to each side would do for nine points in
    ten, and 4 for all sums of ten functions at once (Scheffe).
    """
    held, wide = [], []
    for seed in range(100):
        tried, true, design = a_fit(seed)
        low, high = band_of(tried, np.ones(POINTS, dtype=bool))
        held.append(np.mean((low <= design @ true) & (design @ true <= high)) >= 0.9)
        a = tried.fit.normals.sum(axis=0) + np.diag(tried.fit.prior)
        spread = np.sqrt(np.einsum("in,nm,im->i", design, np.linalg.inv(a), design))
        wide.append(float(np.median(0.5 * (high - low) / spread)))
    assert np.mean(held) >= 0.85
    assert 1.645 < np.median(wide) < 4.0


def test_where_no_log_has_been_a_draw_may_leave_the_band() -> None:
    """What a draw does between two stretches that the logs have visited says nothing of the curve."""
    tried, _, _ = a_fit(1)
    some = np.arange(POINTS) < POINTS // 4
    (low, high), (lowest, highest) = band_of(tried, some), band_of(tried, np.ones(POINTS, dtype=bool))
    assert np.all(high - low <= highest - lowest)
    assert np.median((high - low) / (highest - lowest)) < 0.95


def test_each_draw_counts_to_both_sides() -> None:
    """A block that alone tells an end pulls all draws without it one way; the fit may be off to the other."""
    tried, _, design = a_fit(2)
    y = design @ tried.fit.theta
    low, high = band_of(tried, np.ones(POINTS, dtype=bool))
    assert np.allclose(high - y, y - low, rtol=1e-9)


def test_a_band_ends_where_amplitudes_do() -> None:
    """An amplitude that cannot be less than it is leaves nothing below."""
    tried, _, design = a_fit(3)
    theta, n = tried.fit.theta, len(tried.fit.theta)
    tried.judge.bounds = lambda: (theta, np.full(n, np.inf))
    tried.table = lambda: (np.abs(design).__matmul__, theta)
    low, high = band_of(tried, np.ones(POINTS, dtype=bool))
    y = np.abs(design) @ theta
    assert np.max(y - low) < 1e-6 * np.median(high - y)


def test_a_fit_that_ends_before_its_solution_has_the_same_band() -> None:
    """What it is still pulled by is no block's: of an end that one block tells it would make any width."""
    done, _, design = a_fit(4)
    low, high = band_of(done, np.ones(POINTS, dtype=bool))
    short = 0.05 * np.sqrt(1.0 / (done.fit.normals.sum(axis=0).diagonal() + done.fit.prior))
    done.fit.theta = theta = done.fit.theta - short
    done.fit.gradients = done.fit.gradients + done.fit.normals @ short
    done.table = lambda: (design.__matmul__, theta)
    lower, higher = band_of(done, np.ones(POINTS, dtype=bool))
    assert np.allclose(higher - lower, high - low, rtol=1e-6)
