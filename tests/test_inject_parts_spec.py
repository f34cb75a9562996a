"""What scenarios without the bus take from their claims and machines, sample by sample, against the verdict of a trace;
what is done to two channels; frames that are authenticated wrongly; what a fuzzer of two services does.
"""

from __future__ import annotations

import math
import random
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller import FAULTS, MODES, load_calibration, new_state
from controller.records import as_state
from hil.bus import frames
from hil.inject import fuzz, fuzz_tools, in_lanes, injection
from hil.inject.actions import BusOff, ChannelFault, Flood, Link, Machine, Send
from hil.inject.heard import Heard, _disturbed, _mark, hear
from hil.inject.in_lanes import Changes, Noted, _claim, _facts, _note_tick, _note_vanes, _spans, changes_of
from hil.inject.on_lockstep import PairChange
from hil.inject.scenario import Expect, Scenario
from hil.inject.tamper import Intruder
from hil.inject.verdict import Facts, Trace, facts_of, holds
from hil.loop.heard_lanes import H_DEMAND, H_FRESH, H_P_S, H_SOURCE, H_T_OIL, N_HEARD
from plant import build_plant, places
from plant.model import Side
from vaneloop.base.errors import InputError

PLANT, CAL = build_plant(), load_calibration()
VANES = PLANT.vanes

# ---- claims, sample by sample ----------------------------------------------------------------------------------------

ABOUT: list[dict[str, Any]] = [
    {"mode": "RUN"}, {"fault": "any"}, {"fault": FAULTS[2]}, {"signal": "x_dem", "low": 10.0, "high": 30.0},
    {"signal": "x_lvdt", "high": 30.0}, {"signal": "i_cmd", "low": -5.0}, {"signal": "n_r", "low": 60.0, "high": 90.0},
    {"signal": "n_dem", "low": 60.0}, {"signal": "vigv", "low": -10.0, "high": 20.0},
    {"signal": VANES[-1], "high": 9.0},
]  # fmt: skip
WHEN: list[dict[str, Any]] = [
    {"at": 0.02}, {"by": 0.05, "after": 0.011}, {"by": 0.03}, {"during": [0.01, 0.03]}, {"never": True},
    {"never": True, "during": [0.02, 0.04]},
]  # fmt: skip


def noted(claims: list[Expect]) -> Noted:
    """Notes of one machine of which nothing has been seen."""
    facts = np.zeros((len(claims), in_lanes.N_FACT, 1))
    facts[:, [in_lanes.F_NEAREST, in_lanes.F_FIRST, in_lanes.F_WORST]] = np.inf
    facts[:, [in_lanes.F_BEST, in_lanes.F_LAST]] = -np.inf
    mode, wrong = np.zeros((2, 1), np.int64)
    rows = np.array([_claim(c, VANES) for c in claims])
    return Noted(in_lanes.COLUMNS + len(VANES), rows, facts, mode, wrong, in_lanes.ALLOWED)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_noted_while_a_machine_runs_is_what_its_trace_shows(seed: int) -> None:
    """Random samples; the trace's facts are worked out by arrays."""
    rng, ticks = np.random.default_rng(seed), 60
    claims = [Expect(**what, **when) for what in ABOUT for when in WHEN]
    si = {
        "x_dem": rng.uniform(0, 0.048, ticks), "x_meas": rng.uniform(0, 0.048, ticks),
        "i_cmd": rng.uniform(-0.01, 0.01, ticks), "n_dem": rng.uniform(40, 100, ticks),
        "n_r_raw": rng.uniform(40, 100, ticks),
    }  # fmt: skip
    vanes = rng.uniform(-0.5, 0.5, (len(VANES), ticks))
    mode, faults = rng.integers(0, len(MODES), ticks), rng.integers(0, 2, ticks) * rng.integers(0, 16, ticks)
    notes = noted(claims)
    for k in range(ticks):
        state = as_state(new_state())
        for name, values in {"mode": mode, "faults": faults, **si}.items():
            setattr(state, name, float(values[k]))
        _note_tick(notes, k, 0, state, None)
        s = np.full((places.POT + len(VANES), 1), 9e9)
        s[places.POT :, 0] = vanes[:, k]
        _note_vanes(notes, k, 0, s, None, None, 0, 0.0)
    signals = {
        "x_dem": 1e3 * si["x_dem"], "x_lvdt": 1e3 * si["x_meas"], "i_cmd": 1e3 * si["i_cmd"], "n_dem": si["n_dem"],
        "n_r": si["n_r_raw"], **dict(zip(VANES, np.degrees(vanes), strict=True)),
    }  # fmt: skip
    trace = Trace(np.arange(ticks) * 1e-3, mode, faults, signals)
    for c, claim in enumerate(claims):
        found, expected = _facts(claim, notes.facts[c, :, 0]), facts_of(claim, trace)
        assert expected is not None and holds(claim, found) == holds(claim, expected), claim
        of = ["best", "worst", "seen", "broken"]
        if claim.at is not None:
            of = ["nearest"]
        elif claim.by is not None:
            of = ["first", "best", "worst"]
        elif claim.signal is None and not claim.never:
            of.append("last")
        for name in of:
            assert getattr(found, name) == pytest.approx(getattr(expected, name), nan_ok=True), (claim, name)
    changes = [(MODES[a], MODES[b]) for a, b in zip(mode, mode[1:], strict=False) if a != b]
    assert notes.wrong[0] == sum(change not in in_lanes.TRANSITIONS for change in changes) and notes.mode[0] == mode[-1]


def test_a_claim_becomes_numbers() -> None:
    modes = in_lanes.COLUMNS + len(VANES)
    for claim, row in (
        (Expect(mode=MODES[2], at=0.5), [0, modes, 1, 2, -np.inf, np.inf, 0, 0.5, np.inf]),
        (Expect(fault="any", by=2.0, after=1.0), [2, modes + 1, 1, 0, -np.inf, np.inf, 1, 1.0, np.inf]),
        (Expect(fault=FAULTS[3], never=True), [1, modes + 1, 1, 3, -np.inf, np.inf, 3, 0.0, np.inf]),
        (Expect(signal="x_lvdt", low=1.0, high=2.0, during=[1.0, 2.0]), [3, 1, 1e3, 0, 1.0, 2.0, 2, 1.0, 2.0]),
        (Expect(signal="n_r", high=2.0, never=True, during=[1.0, 2.0]), [3, 4, 1.0, 0, -np.inf, 2.0, 3, 1.0, 2.0]),
        (Expect(signal="vigv", low=2.0, by=3.0), [3, 5, 180.0 / math.pi, 0, 2.0, np.inf, 1, 0.0, np.inf]),
    ):  # fmt: skip
        assert _claim(claim, VANES) == pytest.approx(row), claim


def test_distances_are_of_signals_that_were_seen() -> None:
    row = np.array([1.0, 0.1, 0.2, 0.3, 0.4, 5.0, 6.0, 0.7, 0.0])
    signal = Expect(signal="x_dem", low=1.0, never=True)
    assert _facts(signal, row[:8]) == Facts(0.1, 0.2, 0.3, 0.4, 5, 6, 0.7)
    unseen = np.where(np.arange(8) == in_lanes.F_SEEN, 0.0, row[:8])
    for claim, of in ((signal, unseen), (Expect(mode="RUN", never=True), row[:8]),
                      (Expect(signal="x_dem", low=1.0, at=0.1), row[:8])):  # fmt: skip
        assert math.isnan(_facts(claim, of).best) and math.isnan(_facts(claim, of).worst)


# ---- changes of machines ---------------------------------------------------------------------------------------------


def test_effects_begin_and_end_between_ticks_and_leave_what_was_before() -> None:
    row = places.LVDT_BIAS
    twice = [
        Machine(effect="lvdt_bias", parameters={"bias": 0.2}, start=0.05, duration=0.1),
        Send(frame=1, data="00", start=0.0),
        Machine(p_s=20.0, start=0.01),
        Machine(effect="lvdt_bias", parameters={"bias": 0.4}, start=0.1, duration=0.2),
        Machine(effect="lvdt_bias", parameters={"bias": 0.1}, start=0.15),
    ]
    found = changes_of(Scenario(title="some", duration=1.0, inject=twice), PLANT)
    assert [(k, v[row]) for k, v in found.at] == [
        (50, pytest.approx(0.2e-3)), (100, pytest.approx(0.4e-3)), (150, 0.0), (150, pytest.approx(0.1e-3)),
        (300, pytest.approx(0.2e-3)),
    ]  # fmt: skip
    assert len(found.ways) == 6 and None not in found.ways and PLANT.p[row, 0] == 0.0
    assert changes_of(Scenario(title="none", duration=1.0), PLANT) == Changes((), found.ways[:1])
    assert in_lanes.can(Scenario(title="some", duration=1.0, inject=twice), PLANT, CAL)
    assert not in_lanes.can(Scenario(title="some", duration=1.0), PLANT, CAL._replace(program="own.so"))


def test_an_effect_shorter_than_a_tick_is_over_when_it_begins() -> None:
    short = Machine(effect="lvdt_bias", parameters={"bias": 0.2}, start=0.05, duration=0.0004)
    found = changes_of(Scenario(title="some", duration=1.0, inject=[short]), PLANT)
    assert [(k, v[places.LVDT_BIAS]) for k, v in found.at] == [(50, pytest.approx(0.2e-3)), (50, 0.0)]


def test_a_run_on_two_actuators_shows_the_stroke_of_each() -> None:
    two = Scenario(title="some", duration=0.03, side_b=Side(effects={"lvdt_bias": {"bias": 0.5}}))
    signals = injection._lockstep("n", two, build_plant("plant_two_actuators.toml"), None, None, None).trace.signals
    assert signals["x_lvdt_b"] - signals["x_lvdt_a"] == pytest.approx(np.full(30, 0.5), abs=0.1)
    assert (signals["x_lvdt_a"] > 1.0).all()


def test_spans_lie_between_changes() -> None:
    one = Changes(((5, {1: 1.0}), (5, {2: 2.0}), (9, {3: 3.0}), (30, {4: 4.0})), ())
    other = Changes(((5, {1: 10.0}), (5, {2: 20.0}), (9, {3: 30.0}), (30, {4: 40.0})), ())
    assert list(_spans([one, other], 20)) == [
        (0, 5, None), (5, 5, [{1: 1.0}, {1: 10.0}]), (5, 9, [{2: 2.0}, {2: 20.0}]), (9, 20, [{3: 3.0}, {3: 30.0}])
    ]  # fmt: skip
    assert list(_spans([Changes((), ())], 20)) == [(0, 20, None)]
    assert list(_spans([one], 4)) == [(0, 4, None)] and [s[:2] for s in _spans([one], 9)] == [(0, 5), (5, 5), (5, 9)]


# ---- what is heard ---------------------------------------------------------------------------------------------------


def test_marks_tell_frames_apart_and_only_fillers_disturb() -> None:
    assert [_mark(frame, 1) for frame in range(3)] == [1, 2, 3] and _mark(5, 0) == 0
    assert len({_mark(frame, 40_503) for frame in range(62_500)}) == 62_500 and _mark(62_500, 1) == 0
    of = {
        True: [Flood(frame=1, start=0.0), BusOff(node="VGV", start=0.0)],
        False: [Send(frame=1, data="00", start=0.0)],
    }
    for disturbs, actions in of.items():
        for action in actions:
            assert _disturbed(Scenario(title="some", duration=1.0, inject=[action])) == disturbs
    assert not _disturbed(Scenario(title="some", duration=1.0))
    long = Scenario(title="long", duration=624.99)
    assert hear(long, PLANT) == "longer than 625 s"


def test_a_quiet_scenario_is_heard_frame_by_frame() -> None:
    scenario = Scenario(title="some", duration=0.055, demand=[[0.0, 60.0], [0.05, 70.0]],
                        inject=[Machine(p_s=20.0, t_oil=50.0, start=0.02, duration=0.01)])  # fmt: skip
    found = hear(scenario, PLANT)
    assert isinstance(found, Heard) and found.rows.shape == (55, N_HEARD)
    rows = found.rows
    came = np.flatnonzero(rows[:, H_FRESH])
    assert came.tolist() == [11, 21, 31, 41, 51] and rows[came, H_SOURCE].tolist() == [1, 2, 3, 4, 5]
    # the first one only shows where the counter is
    assert (np.delete(rows[:, H_SOURCE], came) == -1.0).all()
    assert rows[:, H_DEMAND] == pytest.approx(np.interp(np.arange(55) // 10 * 0.01, [0, 0.05], [60, 70]))
    changed = (np.arange(55) >= 20) & (np.arange(55) < 30)
    assert np.array_equal(rows[:, H_P_S] == 20e6, changed) and np.array_equal(rows[:, H_T_OIL] == 50.0, changed)
    assert found.counts["good"].max() + found.counts["sync"].max() <= 6 and not any(
        v.any() for v in found.late.values()
    )


# ---- two channels ----------------------------------------------------------------------------------------------------


def pair() -> Any:
    """Numbers of two channels, each another one."""
    return SimpleNamespace(
        line=np.array([[0.1, 0.2, 9.0], [0.3, 0.4, 9.0]]), coil=np.zeros(2), lvdt=np.zeros(2), power=np.ones(2)
    )


@pytest.mark.parametrize(("fault", "part", "value"), [
    ("off", "power", 0.0), ("coil_open", "coil", 1.0), ("coil_short", "coil", 2.0), ("lvdt_lost", "lvdt", 1.0),
    ("lvdt_frozen", "lvdt", 2.0),
])  # fmt: skip
@pytest.mark.parametrize("channel", ["A", "B"])
def test_a_fault_of_a_channel_is_its_own_and_ends(fault: Any, part: str, value: float, channel: Any) -> None:
    q, at = pair(), "AB".index(channel)
    change = PairChange(ChannelFault(channel=channel, fault=fault, start=0.01, duration=0.02), q)
    before = {name: getattr(q, name).copy() for name in vars(q)}
    for k in range(40):
        change.tick(k)
        if k in (9, 10, 29, 30):
            expected = before[part].copy()
            if 10 <= k < 30:
                expected[at] = value
            assert getattr(q, part).tolist() == expected.tolist(), k
            assert all(np.array_equal(getattr(q, name), before[name]) for name in before if name != part)


@pytest.mark.parametrize(("sender", "rows"), [("A", [0]), ("B", [1]), ("both", [0, 1])])
def test_a_link_is_slow_or_lossy_in_the_direction_asked_for(sender: Any, rows: list[int]) -> None:
    q = pair()
    change = PairChange(Link(delay=0.05, loss=0.5, sender=sender, start=0.01, duration=0.02), q)
    before = q.line.copy()
    for k in range(10, 31):
        change.tick(k)
        expected = before.copy()
        if k < 30:
            expected[rows, :2] = 0.05, 0.5
        assert q.line.tolist() == expected.tolist(), k


def test_a_vane_that_a_machine_lacks_has_no_changes() -> None:
    lacking = Machine(effect="pot_bias", parameters={"vgv7": 1.0}, start=0.0)
    with pytest.raises(InputError, match="vgv7"):
        changes_of(Scenario(title="some", duration=1.0, inject=[lacking]), PLANT)


# ---- authentication --------------------------------------------------------------------------------------------------


class Key:
    """A key that shows what it was asked for."""

    def __init__(self, name: str):
        self.name, self.asked = name, list[Any]()

    def frame(self, ident: int, data: int, freshness: int) -> tuple[int, int]:
        self.asked.append((ident, data, freshness))
        return 77, len(self.asked)


@pytest.mark.parametrize(("secoc", "key", "fresh"), [
    ("right", 0, 1_200), ("wrong_key", 1, 1_200), ("stale", 0, 200), ("wrong_mac", 0, 1_200),
])  # fmt: skip
def test_an_outsider_s_frame_is_authenticated_as_asked(secoc: Any, key: int, fresh: int) -> None:
    keys = Key("right"), Key("wrong")
    action = Send(frame="ECU_DEMAND", data="0102030405060708", e2e="none", secoc=secoc, start=1.2)
    out = Intruder(action, random.Random(3), [], keys).tick(1_200, 0)  # type: ignore[arg-type]
    word = int.from_bytes(bytes(range(1, 9)), "little")
    assert out[0] == (frames.ECU_DEMAND | 8 << 32, word) and out[1][0] == 77
    assert keys[key].asked == [(frames.ECU_DEMAND, word, fresh)] and keys[1 - key].asked == []
    made = int(frames.encode_auth(fresh, random.Random(3).getrandbits(32)))
    assert out[1][1] == (made if secoc == "wrong_mac" else 1)
    early = Intruder(action.model_copy(update={"start": 0.5}), random.Random(3), [], keys)  # type: ignore[arg-type]
    early.tick(500, 0)
    assert keys[key].asked[-1][2] == (0 if secoc == "stale" else 500)  # none is below 0


# ---- fuzzing ---------------------------------------------------------------------------------------------------------


def test_a_cut_frame_keeps_the_bytes_that_its_length_has() -> None:
    rng = np.random.default_rng(1)
    rows = rng.integers(-(2**63), 2**63, (32, 2), dtype=np.int64)
    rows[:, 0] = frames.ECU_DEMAND | 8 << 32
    length = np.arange(32) % 16
    found = fuzz._cut(rows.copy(), length)
    for (head, data), (was_head, was), n in zip(found.tolist(), rows.tolist(), length.tolist(), strict=True):
        whole = was.to_bytes(8, "little", signed=True)
        assert data.to_bytes(8, "little", signed=True) == whole[:n].ljust(8, b"\0")
        assert head == was_head & 0xFFFFFFFF | n << 32


class Dice:
    """Chance that is given, and what it was asked for."""

    def __init__(self, integers: list[int], choices: list[int]):
        self.numbers, self.choices, self.asked = integers, choices, list[Any]()

    def integers(self, low: int, high: int) -> int:
        self.asked.append((low, high))
        return self.numbers.pop(0)

    def choice(self, of: list[int], p: list[float] | None = None) -> int:
        self.asked.append((of, p))
        return self.choices.pop(0)


@pytest.mark.parametrize(("integers", "choices", "request_", "away", "ticks", "waits"), [
    ([1, 1, 1], [], None, 0, 0, True), ([0, 1, 5, 0], [30], 1, 30, 0, False),
    ([0, 0, 0, 1], [1200, 100], 0, 1200, 100, True), ([7, 0, 0], [5200], None, 0, 5200, False),
])  # fmt: skip
def test_two_services_at_once_meet_an_ecu_that_goes_and_a_bus_that_is_silent(
    integers: list[int], choices: list[int], request_: int | None, away: int, ticks: int, waits: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    demands: list[Any] = []
    ran: list[Any] = []
    ecu = SimpleNamespace(set_demand=lambda n, mode_request: demands.append((n, mode_request)))
    target = SimpleNamespace(ecu=ecu, away=0, tick=ran.append, slave="slave", server="server", keys="keys")
    monkeypatch.setattr(fuzz_tools, "Tool", lambda *given: given)
    monkeypatch.setattr(fuzz_tools, "rules_of", lambda tool: [tool])
    dice = Dice(integers, choices)
    found = fuzz_tools._both(dice, target, b"")  # type: ignore[arg-type]
    assert demands == ([] if request_ is None else [(70.0, request_)]) and target.away == away
    assert ran == [[]] * ticks and not dice.numbers and not dice.choices
    assert found == ([] if waits else [(dice, "slave", "server", fuzz_tools.uds_key, "keys")])
    numbers = [a for a in dice.asked if isinstance(a[0], int)]
    assert numbers == [(0, 60), *([(0, 2)] if request_ is not None else []), (0, 300), (0, 2)]
    for of, p in (a for a in dice.asked if not isinstance(a[0], int)):
        assert (of, p) in (([0, 0, 0, 30, 1200], None), ([100, 300, 5200], [0.7, 0.27, 0.03]))
        assert p is None or math.fsum(p) == pytest.approx(1.0)
