"""A sample that a sensor or a logger got wrong is left out, and nothing that a machine does is taken for one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.conftest import examples
from tests.test_your_own_model import drained, tank_of
from vaneloop.identification.settings import LONGEST_SPIKE
from vaneloop.identification.user_models.data import spikes
from vaneloop.verbs.search import diagnose

T = np.arange(0.0, 60.0, 0.05)


def smooth(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.sum([rng.uniform(0.3, 1.0) * np.sin(2.0 * np.pi * f * T + rng.uniform(0.0, 6.0))
                   for f in (0.03, 0.11, 0.24)], axis=0)  # fmt: skip


@settings(max_examples=examples(60), deadline=None)
@given(seed=st.integers(0, 10_000), size=st.sampled_from([-1e9, -30.0, 30.0, 1e9]), run=st.integers(1, LONGEST_SPIKE),
       at=st.integers(2, len(T) - LONGEST_SPIKE - 3), noise=st.sampled_from([0.0, 0.02, 0.3]))  # fmt: skip
def test_a_jump_away_and_back_is_found_and_nothing_else(
    seed: int, size: float, run: int, at: int, noise: float
) -> None:
    y = 1e3 * (smooth(seed) + noise * np.random.default_rng(seed).standard_normal(len(T)))
    y[at : at + run] += 1e3 * size
    assert np.flatnonzero(spikes(y)).tolist() == list(range(at, at + run))


@settings(max_examples=examples(40), deadline=None)
@given(seed=st.integers(0, 10_000), factor=st.sampled_from([1e-12, 1e-3, 1e6]), offset=st.sampled_from([0.0, -4.0]))
def test_it_does_not_turn_on_units(seed: int, factor: float, offset: float) -> None:
    rng = np.random.default_rng(seed)
    y = smooth(seed) + 0.02 * rng.standard_normal(len(T))
    y[rng.integers(0, len(T), 3)] = 0.0
    assert np.array_equal(spikes(y), spikes(factor * (y + offset)))


def laplace(rng: np.random.Generator) -> np.ndarray:
    return smooth(1) + 0.1 * rng.laplace(size=len(T))


def quantised(rng: np.random.Generator) -> np.ndarray:
    return np.round(4.0 * (smooth(2) + 0.02 * rng.standard_normal(len(T)))) / 4.0


def switched(rng: np.random.Generator) -> np.ndarray:
    return np.repeat(rng.integers(0, 2, len(T) // 40), 40).astype(float)


def blips(rng: np.random.Generator) -> np.ndarray:
    y = np.zeros(len(T))
    y[rng.integers(10, len(T) - 10, 4)] = 1.0  # a contact that closes for one sample
    return y


def walk(rng: np.random.Generator) -> np.ndarray:
    return np.cumsum(rng.standard_normal(len(T)))


def struck(rng: np.random.Generator) -> np.ndarray:
    """What is hit a few times, and rings."""
    y = 0.001 * rng.standard_normal(len(T))
    for k in rng.integers(10, len(T) - 200, 4):
        y[k : k + 200] += np.exp(-np.arange(200) / 15.0) * np.cos(np.arange(200) / 2.0)
    return y


@pytest.mark.parametrize("draw", [laplace, quantised, switched, blips, walk, struck])
def test_what_a_machine_does_is_no_spike(draw) -> None:
    for seed in range(40):
        assert not spikes(draw(np.random.default_rng(seed))).any()


@pytest.mark.parametrize("width", [1, 2, 3])
def test_where_the_input_jumps_again_and_again_the_reading_may(width: int) -> None:
    """Pulses of a current, and the voltage that falls with each."""
    rng = np.random.default_rng(width)
    current = np.zeros(len(T))
    for k in range(100, len(T), 600):
        current[k : k + width] = 20.0
    voltage = 12.0 - 0.05 * current + 1e-4 * rng.standard_normal(len(T))
    assert spikes(voltage).any()  # without the current they would be
    assert not spikes(voltage, [current]).any()
    voltage[[550, 800]] = 0.0
    assert np.flatnonzero(spikes(voltage, [current])).tolist() == [550, 800]


@pytest.mark.slow
def test_a_log_with_lost_samples_has_the_same_answer() -> None:
    system = tank_of(1.0, 1.0)
    whole, lossy = drained(1, 1.0, 1.0), drained(1, 1.0, 1.0)
    lossy.columns["level"][[120, 311]] = 0.0, 1e6
    answers = [diagnose([r], system, test=[drained(2, 1.0, 1.0)]) for r in (whole, lossy)]
    for a in answers:
        assert [f.effect for f in a.diagnosis.stages[0].effects] == ["level.quadratic_drag"]
    errors = [a.diagnosis.stages[0].excess for a in answers]
    assert errors[1] == pytest.approx(errors[0], rel=0.1)  # the noise is estimated from the samples, too
    said = [n for n in answers[1].bound.notes if "left out" in n]
    assert said == ["run 1: level: 2 samples left out that jump away and back, first 0 at 240 s"]
