"""Scenarios on many machines side by side: each machine's trace, verdicts and margins are those of its own run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from controller import FAULTS, MODES, load_calibration
from hil import inject
from hil.bus import frames
from hil.inject import Scenario, library, load_scenario
from hil.inject.heard import Heard, hear
from hil.inject.in_lanes import can, margins_in_lanes
from hil.inject.margin import margins
from hil.inject.scenario import COUNTS, SIGNALS
from plant import Model, Plant, build_plant
from tests.conftest import quick_first
from tests.test_lanes import drawn

ON_THE_BUS = {"babbling_idiot", "bus_off_controller"}  # when the queues empty depends on the length of each frame
CALIBRATION = load_calibration()


def machines(scenario: Scenario, count: int, seed: int) -> list[Plant]:
    """Machines at random: nominal ones, and ones with effects."""
    generator, out = np.random.default_rng(seed), list[Plant]()
    while len(out) < count:
        plant = drawn(generator, build_plant(), 3 * (len(out) % 2))
        if can(scenario, plant, CALIBRATION):
            out.append(plant)
    return out


def assert_same(name: str, scenario: Scenario, plants: list[Plant]) -> list[inject.Outcome]:
    """Hold every machine's samples and margins in lanes against its run on the lockstep bus; return those."""
    heard = hear(scenario, build_plant())
    assert isinstance(heard, Heard), f"{name}: {heard}"
    samples: list[list[np.ndarray]] = [[] for _ in plants]

    def watch(some: list[int], k: int, out: np.ndarray) -> None:
        for j, i in enumerate(some):
            assert sum(map(len, samples[i])) == k
            samples[i].append(out[:, :, j].copy())

    found, outcomes = margins_in_lanes(scenario, plants, CALIBRATION, heard, watch), []
    for plant, seen, mine in zip(plants, samples, found, strict=True):
        outcome = inject.run(scenario, plant=plant, name=name)
        vanes, trace = plant.vanes, outcome.trace
        factor = np.array([1e3, 1e3, 1e3, 1.0, 1.0, *[180.0 / np.pi] * len(vanes), 1.0, 1.0])
        signals = [trace.signals[n] for n in ("x_dem", "x_lvdt", "i_cmd", "n_dem", "n_r", *vanes)]
        alone = np.array([*signals, trace.mode, trace.faults]).T
        np.testing.assert_allclose(np.concatenate(seen) * factor, alone, rtol=0.0, atol=1e-9, err_msg=name)
        for one, other in zip(mine, margins(scenario, outcome), strict=True):
            assert (one.expected, one.held, one.unit) == (other.expected, other.held, other.unit)
            numbers = ((one.value, one.share), (other.value, other.share))
            np.testing.assert_allclose(*numbers, rtol=1e-9, atol=1e-9, err_msg=f"{name}: {one.expected}")
        outcomes.append(outcome)
    return outcomes


@pytest.mark.parametrize("name", quick_first(["demand_gap_200ms", "status_lost", "standby_asked"], 2))
def test_a_shipped_scenario_in_lanes_is_the_one_on_the_bus(name: str) -> None:
    scenario = load_scenario(name)
    assert_same(name, scenario, machines(scenario, 2, len(name)))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(library()))
def test_every_shipped_scenario_but_two_runs_in_lanes(name: str) -> None:
    scenario = load_scenario(name)
    if name in ON_THE_BUS:
        why = hear(scenario, build_plant())
        assert isinstance(why, str) and "arbitration" in why
        return
    assert_same(name, scenario, machines(scenario, 2, len(name)))


ACTIONS: list[dict[str, Any]] = [
    {"action": "drop", "probability": 0.3},
    {"action": "drop", "duration": 0.12},
    {"action": "delay", "delay": 0.01, "jitter": 0.03},
    {"action": "duplicate", "every": 3},
    {"action": "reorder", "window": 3},
    {"action": "corrupt", "bits": 1, "probability": 0.2},
    {"action": "corrupt", "length": 5, "every": 4},
    {"action": "freeze", "signal": "n_r", "duration": 0.2},
    {"action": "freeze", "signal": "counter", "duration": 0.1},
    {"action": "override", "signals": {"n_dem": 124.0}, "count": 2},
    {"action": "override", "signals": {"n_r": 71.5}, "every": 2},
    {"action": "override", "signals": {"mode_request": 0}, "duration": 0.15},
    {"action": "send", "frame": "ECU_DEMAND", "signals": {"n_dem": 90.0, "n_r": 70.0}, "period": 0.05},
    {"action": "replay", "frame": "ECU_DEMAND", "begin": 0.1, "length": 0.2, "start": 0.4, "duration": 0.1},
    {"action": "flood", "frame": 0x050, "rate": 1500.0, "duration": 0.3},
    {"action": "error_frames", "probability": 0.1, "duration": 0.2},
    {"action": "bus_off", "node": "ECU", "duration": 0.1},
    {"action": "machine", "p_s": 0.0, "duration": 0.2},
    {"action": "machine", "t_oil": 90.0},
    {"action": "machine", "effect": "lvdt_bias", "parameters": {"bias": 1.5}, "duration": 0.2},
    {"action": "machine", "effect": "valve_dead_band", "parameters": {"half_width": 2.0}},
    {"action": "machine", "effect": "schedule_error", "parameters": {"offset": 1.0}, "duration": 0.3},
    {"action": "machine", "effect": "aero_load", "parameters": {"force": 2000.0}},
]  # fmt: skip


def claims(generator: np.random.Generator) -> list[dict[str, Any]]:
    """Claims of every kind at random, of which some are broken."""
    times = [{"at": 0.4, "tolerance": 0.2}, {"by": 0.7, "after": 0.2}, {"during": [0.3, 0.6]}, {"never": True},
             {"never": True, "during": [0.5, 0.8]}]  # fmt: skip
    out = []
    for time in times:
        about: list[dict[str, Any]] = [
            {"mode": str(generator.choice(MODES))}, {"fault": str(generator.choice([*FAULTS, "any"]))},
            {"signal": str(generator.choice(SIGNALS[:7])), "low": float(generator.uniform(-5.0, 25.0))},
            {"signal": "x_lvdt", "low": 2.0, "high": float(generator.uniform(10.0, 20.0))},
            {"count": str(generator.choice(COUNTS)), "high": 3}, {"late": "VGV_STATUS"},
        ]  # fmt: skip
        out += [{**a, **time} for a in about]
    return out


@pytest.mark.parametrize("seed", range(6))
def test_actions_of_every_kind_do_the_same_in_lanes_and_on_the_bus(seed: int) -> None:
    generator = np.random.default_rng(seed)
    chosen = ACTIONS[seed::6]
    actions = [{"start": float(generator.uniform(0.15, 0.4)), **a} for a in chosen]
    scenario = Scenario.model_validate({
        "title": "At random", "duration": 0.9, "seed": seed, "demand": [[0.0, 60.0], [0.2, 60.0], [0.9, 75.0]],
        "inject": actions, "expect": claims(generator),
    })  # fmt: skip
    outcomes = assert_same(f"seed {seed}", scenario, machines(scenario, 2, seed))
    assert {c.held for o in outcomes for c in o.checks} == {True, False}


def test_what_lanes_do_not_have_is_said_before_anything_runs() -> None:
    scenario = Scenario.model_validate({"title": "Nothing", "duration": 0.1})
    late = Model(effects={"can_delay": {"delay": 0.02}}).plant(build_plant())
    assert can(scenario, build_plant(), CALIBRATION) and not can(scenario, late, CALIBRATION)
    assert not can(scenario, build_plant(), load_calibration(strategy="adaptive"))
    then = {"action": "machine", "effect": "frame_hold", "parameters": {"period": 0.05}, "start": 0.05}
    assert not can(scenario.model_validate({**scenario.model_dump(), "inject": [then]}), build_plant(), CALIBRATION)


def test_a_measured_speed_with_wrong_bits_and_a_right_crc_is_what_the_controller_gets() -> None:
    wrong = frames.crc(frames.ECU_DEMAND, 0) ^ frames.crc(frames.ECU_DEMAND, 1 << 42)
    bits = [42, *(q for q in range(8) if wrong >> q & 1)]
    flipped = {"action": "corrupt", "at": bits, "every": 5, "start": 0.2}
    scenario = Scenario.model_validate({"title": "Bits", "duration": 0.4, "inject": [flipped]})
    (outcome,) = assert_same("bits", scenario, machines(scenario, 1, 1))
    assert outcome.counts["wrong_crc"] == 0 and np.ptp(outcome.trace.signals["n_r"][200:]) > 2.0
