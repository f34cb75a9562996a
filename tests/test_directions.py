"""Parameters that repeat themselves: an eccentric ring has a direction, and no direction is special to the search."""

from __future__ import annotations

import numpy as np
import pytest

from hil.logs import Channel, Log
from tests.firmware_on_rig import firmware
from tests.rig import Hidden, manoeuvre, simulate
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.selection.diagnosis import diagnose_stage
from vaneloop.identification.subsystem import Effect, Parameter, Stage
from vaneloop.identification.vane_chain.chain import build_chain

NOISE = 0.03
PHASES = (-180, -159, -90, -20, 45, 120)


def ring_stage(phase: float, size: float = 0.6) -> Stage:
    """An angle (deg) that swings over +-40 deg, hidden in it ``size`` sin(angle + phase), beside a bias, and rivals of
    other shape.
    """
    t = np.arange(1500) * 0.02
    angle = 40.0 * np.sin(2 * np.pi * t / 7.3) * np.sin(2 * np.pi * t / 31.0)
    rad = np.deg2rad(angle)

    def run(theta: np.ndarray) -> np.ndarray:
        bias, amplitude, turn, cube, late = (theta[:, i, None] for i in range(5))
        y = (
            angle
            + bias
            + amplitude * np.sin(rad + np.deg2rad(turn))
            + cube * (angle / 40.0) ** 3
            + late * np.gradient(angle, t)
        )
        return y[:, None, :]

    measured = (
        angle + 0.05 + size * np.sin(rad + np.deg2rad(phase)) + NOISE * np.random.default_rng(0).standard_normal(len(t))
    )
    effects = (
        Effect(
            "eccentric",
            (
                Parameter("amplitude", 0.0, "deg", 0.0, 5.0),
                Parameter("phase", 0.0, "deg", -180.0, 180.0, shape=True, period=360.0),
            ),
            tuple((a, p) for a in (0.01, 0.1, 1.0) for p in (0.0, 90.0, 180.0, 270.0)),
        ),
        Effect("cubic", (Parameter("cube", 0.0, "deg", -5.0, 5.0),), ((0.1,), (-0.1,), (1.0,), (-1.0,))),
        Effect("late", (Parameter("lag", 0.0, "s", -1.0, 1.0),), ((0.1,), (-0.1,))),
    )
    return Stage(
        "ring", ("angle",), ("deg",), (Parameter("bias", 0.0, "deg", tolerance=0.1),), effects, run, t, measured[None]
    )


@pytest.mark.parametrize("phase", PHASES)
def test_any_direction_of_the_same_size_gives_the_same_verdict(phase):
    d = diagnose_stage(ring_stage(phase), np.array([NOISE]))
    assert d.verdict == "missing"
    assert [f.effect for f in d.effects] == ["eccentric"]
    assert d.excess < 1.03
    p = d.effects[0].parameters["phase"]
    off = (p["value"] - phase + 180.0) % 360.0 - 180.0
    assert abs(off) < 6.0
    assert p["low"] <= p["value"] <= p["high"]
    assert -180.0 <= p["value"] < 180.0


def test_an_interval_may_cross_the_cut():
    d = diagnose_stage(ring_stage(180.0), np.array([NOISE]))
    p = d.effects[0].parameters["phase"]
    assert p["low"] < -180.0 < p["high"] or p["low"] < 180.0 < p["high"]
    assert 0.1 < p["high"] - p["low"] < 20.0


def test_a_direction_has_no_bound():
    judge = LeastSquaresProblem(ring_stage(0.0), np.array([NOISE]))
    low, high = judge.bounds()
    assert (low[2], high[2]) == (-np.inf, np.inf)
    start = np.array([0.0, 0.6, 170.0, 0.0, 0.0])
    fits = [judge.fit(("eccentric",), start + [0, 0, 360.0 * k, 0, 0]) for k in (-1, 0, 2)]
    for f in fits[1:]:
        np.testing.assert_allclose(f.theta, fits[0].theta, atol=1e-6)
        np.testing.assert_allclose(f.high - f.low, fits[0].high - fits[0].low, rtol=1e-5, atol=1e-9)


def test_the_phase_of_a_held_frame_repeats_itself():
    chain = rig_chain([], 20.0)
    stage = chain.stage("demand")
    at = stage.index()["frame_hold"].start
    thetas = np.repeat(stage.neutral()[None], 3, axis=0)
    thetas[:, at] = 0.06
    thetas[:, at + 1] = 0.3, 1.3, -0.7
    out = stage.run(thetas)
    np.testing.assert_allclose(out[1], out[0], atol=1e-9)
    np.testing.assert_allclose(out[2], out[0], atol=1e-9)
    assert stage.effect("frame_hold").parameters[1].period == 1.0


def rig_chain(hidden: list[Hidden], seconds: float):
    run = simulate(manoeuvre(3, seconds), firmware(), hidden, seed=3, rate=100)
    return build_chain(Log("rig", {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"}, ()))


@pytest.mark.slow
def test_an_eccentric_ring_towards_the_cut_is_named_alone():
    """At -159 deg the phase once stopped at -180, and two other effects were named with certainty."""
    stage = rig_chain(
        [Hidden("ring_eccentricity", {"amplitude": 12e-3, "phase": np.deg2rad(-159.0), "stage": 0.0})], 80.0
    ).stage("linkage")
    assert stage.floor is not None
    d = diagnose_stage(stage, stage.floor)
    assert [f.effect for f in d.effects] == ["ring_eccentricity"]
    assert d.excess < 1.05
    assert d.effects[0].parameters["phase"]["value"] == pytest.approx(
        -159.0, abs=12.0
    )  # links within tolerance turn it
