"""Where a stroke reverses between two slow rows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vaneloop.identification.vane_chain.linkage import _with_midpoints, _with_reversals

ROWS = np.arange(12.0)


@given(st.floats(3.0, 8.0), st.floats(0.5, 20.0), st.floats(0.5, 20.0), st.sampled_from([-1.0, 1.0]))
def test_a_corner_is_where_the_lines_through_its_rows_meet(at: float, up: float, down: float, sign: float) -> None:
    x = sign * np.minimum(up * (ROWS - at), -down * (ROWS - at))
    peak = (sign * _with_reversals(x, 1.0)[1::2]).max()
    between = min(at % 1.0, 1.0 - at % 1.0) > 1e-6
    assert peak == pytest.approx(0.0, abs=1e-9) if between else peak <= 1e-9


@given(st.floats(3.0, 8.0), st.floats(0.5, 20.0))
def test_the_peak_of_a_parabola_has_a_quarter_of_the_way_at_most(at: float, a: float) -> None:
    x = -a * (ROWS - at) ** 2
    farther, corner = x.max(), _with_reversals(x, 1.0).max()
    assert farther - 1e-9 <= 0.0 <= farther + 0.25 * (corner - farther) + 1e-9 * a


@given(st.lists(st.floats(-50.0, 50.0), min_size=4, max_size=30), st.floats(0.0, 1.0))
def test_rows_stay_as_they_are_and_a_reversal_lies_beyond_them(rows: list[float], share: float) -> None:
    x = np.array(rows)
    out, midpoints = _with_reversals(x, share), _with_midpoints(x)
    assert np.array_equal(out[::2], x) and len(out) == 2 * len(x) - 1
    other = out[1::2] != midpoints[1::2]
    beyond = np.maximum(out[1::2] - np.maximum(x[1:], x[:-1]), np.minimum(x[1:], x[:-1]) - out[1::2])
    assert np.all(beyond[other] >= -1e-9)
    mirrored = -_with_reversals(-x, share)
    assert out == pytest.approx(mirrored) and out == pytest.approx(_with_reversals(x, np.full(len(x) - 1, share)))


@given(st.lists(st.floats(0.0, 5.0), min_size=4, max_size=30), st.floats(0.0, 1.0))
def test_a_stroke_that_never_reverses_runs_straight(steps: list[float], share: float) -> None:
    x = np.cumsum(steps)
    assert _with_reversals(x, share) == pytest.approx(_with_midpoints(x))
