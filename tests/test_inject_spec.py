"""Injection action by action, tick by tick and byte by byte, as docs/injection.md has it; claims, verdicts, margins.

Frames are worked out here: CRC and counter bit by bit, identifiers and layouts from the DBC's text. Traces are a few
samples made by hand.
"""

from __future__ import annotations

import math
import random
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from controller import FAULTS, MODES, load_calibration
from hil import inject, native
from hil.bus import wire
from hil.bus.frames import EXTENDED, REMOTE
from hil.bus.lockstep_bus import run_lockstep
from hil.inject import Check, Expect, Outcome, Scenario, Trace, injection, judge, on_lockstep, sil
from hil.inject.actions import ACTIONS, identifier, raw_signal
from hil.inject.any_controller import Reactions, expected_of_any, load_reactions
from hil.inject.margin import Margin, margins
from hil.inject.scenario import library, load_scenario
from hil.inject.tamper import Gateway, Intruder, tick_of
from hil.inject.verdict import failed, outcome_of
from hil.logs.candump import write_candump
from hil.logs.frames import Frames
from hil.loop.node import Ecu, Node
from plant import build_plant, places
from tests.machines import machine
from vaneloop.base.errors import InputError

DEMAND, STATUS, SERVO, ANGLES, HEALTH = 0x0A0, 0x0B0, 0x0B1, 0x0B2, 0x0B3
Row = tuple[int, int]

# ---- frames, worked out here -----------------------------------------------------------------------------------------


def crc8(data: bytes) -> int:
    """CRC-8 with the polynomial 0x1D, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
    return crc


def protected(ident: int, counter: int, body: bytes, high_nibble: int = 0) -> bytes:
    """Eight bytes under E2E profile 1: CRC over the DataID 0x5600 + identifier, low byte first, and what follows."""
    rest = bytes([counter | high_nibble << 4]) + body
    return bytes([crc8((0x5600 + ident).to_bytes(2, "little") + rest)]) + rest


def demand(n_dem: float = 80.0, n_r: float = 80.0, counter: int = 0, request: int = 1) -> bytes:
    """ECU_DEMAND: speeds in steps of 0.002 %."""
    body = b"".join(round(v / 0.002).to_bytes(2, "little") for v in (n_dem, n_r)) + b"\0\0"
    return protected(DEMAND, counter, body, request)


def row(ident: int, data: bytes, flags: int = 0) -> Row:
    """A frame as two words: identifier, flags and length; data, the first byte lowest."""
    return ident | flags | len(data) << 32, int.from_bytes(data.ljust(8, b"\0"), "little", signed=True)


def seen(frame: Row) -> tuple[int, int, bytes]:
    """Identifier with flags, length, data of a frame."""
    head, data = frame
    length = head >> 32
    return head & 0xFFFFFFFF, length, data.to_bytes(8, "little", signed=True)[: max(length, 0)]


# ---- times, identifiers, signals -------------------------------------------------------------------------------------


def test_a_time_is_the_nearest_tick_of_a_millisecond_and_no_end_is_no_tick() -> None:
    assert [tick_of(t) for t in (0.0, 0.0004, 0.0006, 2.041, 3.0)] == [0, 0, 1, 2041, 3000]
    assert tick_of(math.inf) == math.inf


def test_a_frame_is_given_by_name_by_number_or_by_text_of_a_number() -> None:
    names = ["ECU_DEMAND", "VGV_STATUS", "VGV_SERVO", "VGV_ANGLES", "VGV_HEALTH", "VGV_ANGLES_2", "VGV_ANGLES_3"]
    assert [identifier(n) for n in names] == [0xA0, 0xB0, 0xB1, 0xB2, 0xB3, 0xB4, 0xB5]
    assert [identifier(v) for v in (0, 0x7FF, "0x7FF", "160", "0b1")] == [0, 0x7FF, 0x7FF, 160, 1]
    assert [identifier(v, extended=True) for v in (0, 0x800, 0x1FFFFFFF)] == [0, 0x800, 0x1FFFFFFF]


@pytest.mark.parametrize(
    ("frame", "extended", "last"),
    [(0x800, False, "0x7FF"), (-1, False, "0x7FF"), ("VGV", False, "0x7FF"), (0x20000000, True, "0x1FFFFFFF")],
)
def test_another_frame_is_refused_with_what_is_allowed(frame: int | str, extended: bool, last: str) -> None:
    with pytest.raises(ValueError, match=rf"^frame \(={frame!r}\) must be one of ECU_DEMAND, .*from 0 to {last}$"):
        identifier(frame, extended)


def test_a_signal_s_bits_lie_where_the_dbc_has_them() -> None:
    assert raw_signal("ECU_DEMAND", "n_dem", 80.0) == (40000 << 16, 0xFFFF << 16)
    assert raw_signal("ECU_DEMAND", "mode_request", 3) == (3 << 12, 3 << 12)
    assert raw_signal("ECU_DEMAND", "counter", 14) == (14 << 8, 15 << 8)
    assert raw_signal("VGV_STATUS", "x_dem", -8.0) == (0, 0xFFFF << 16), "the offset is -8 mm"
    assert raw_signal("VGV_STATUS", "x_lvdt", 20.0) == (28000 << 32, 0xFFFF << 32)
    assert raw_signal("VGV_SERVO", "i_cmd", -0.002) == (0xFFFF << 16, 0xFFFF << 16), "two's complement"
    assert raw_signal("VGV_ANGLES", "vgv2", -0.002) == (0xFFFF << 48, 0xFFFF << 48)
    assert raw_signal("VGV_SERVO", "fault_paused", 1) == (1 << 40, 1 << 40)
    assert raw_signal(0xA0, "n_dem", 0.003) == (2 << 16, 0xFFFF << 16), "the nearest step"


@pytest.mark.parametrize(
    ("frame", "name", "least", "most", "said"),
    [
        ("ECU_DEMAND", "n_dem", 0.0, 131.07, "0 to 131.07 %"),
        ("VGV_STATUS", "x_dem", -8.0, 57.535, "-8 to 57.535 mm"),
        ("VGV_SERVO", "i_cmd", -65.536, 65.534, "-65.536 to 65.534 mA"),
        ("ECU_DEMAND", "mode_request", 0, 3, "0 to 3"),
    ],
)
def test_a_value_fits_from_the_least_to_the_most_of_its_bits(
    frame: str, name: str, least: float, most: float, said: str
) -> None:
    raw_signal(frame, name, least), raw_signal(frame, name, most)
    step = 1.0 if name == "mode_request" else 0.002
    for value in (least - step, most + step):
        with pytest.raises(ValueError, match=rf"^{name} \(=.* does not fit its bits in {frame}; allowed: {said}$"):
            raw_signal(frame, name, value)


def test_a_signal_of_no_frame_and_a_frame_of_no_signals_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"signal \(='p_s'\) is not in VGV_STATUS; allowed: crc, counter, state, x_dem"
    ):
        raw_signal("VGV_STATUS", "p_s", 1.0)
    with pytest.raises(
        ValueError, match=r"frame \(=291\) has no signals in vgv.dbc; frames with signals: ECU_DEMAND, "
    ):
        raw_signal(0x123, "n_dem", 1.0)


# ---- what an action is by default, and what it refuses ---------------------------------------------------------------

ALWAYS: dict[str, Any] = {"start": 0.0, "duration": None}
FRAME: dict[str, Any] = {**ALWAYS, "frame": "ECU_DEMAND", "every": 1, "probability": 1.0, "count": None}
NEEDED: dict[str, dict[str, Any]] = {
    "delay": {"delay": 0.01},
    "freeze": {"signal": "n_dem"},
    "override": {"signals": {"n_dem": 1.0}},
    "send": {"frame": 0x10, "data": "00"},
    "replay": {"log": "a.log"},
    "machine": {"p_s": 1.0},
    "channel": {"channel": "A", "fault": "off"},
    "link": {"loss": 1.0},
}
DEFAULTS: dict[str, dict[str, Any]] = {
    "drop": FRAME,
    "delay": {**FRAME, "jitter": 0.0},
    "duplicate": {**FRAME, "copies": 1},
    "reorder": {**FRAME, "window": 2},
    "corrupt": {**FRAME, "bits": 1, "at": None, "length": None},
    "freeze": {**FRAME, "e2e": "right"},
    "override": {**FRAME, "e2e": "right"},
    "send": {
        **ALWAYS, "signals": None, "e2e": None, "counter": 0, "period": None, "length": None, "extended": False,
        "remote": False, "secoc": "none",
    },
    "flood": {**ALWAYS, "frame": 0x7FF, "last": None, "rate": None},
    "babble": ALWAYS,
    "replay": {**ALWAYS, "begin": None, "length": 1.0, "frame": None, "loop": True},
    "error_frames": {**ALWAYS, "probability": 1.0},
    "bus_off": {**ALWAYS, "node": "ECU"},
    "machine": {**ALWAYS, "t_oil": None, "effect": None, "parameters": {}, "side": None},
    "channel": ALWAYS,
    "link": {**ALWAYS, "delay": 0.0, "sender": "both"},
}  # fmt: skip


@pytest.mark.parametrize("name", ACTIONS)
def test_an_action_s_defaults_are_those_of_the_page(name: str) -> None:
    needed = NEEDED.get(name, {})
    assert ACTIONS[name](**needed).model_dump() == {"action": name, **DEFAULTS[name], **needed}


def test_an_action_ends_after_its_duration_or_never() -> None:
    assert inject.Drop(start=1.5, duration=0.25).end == 1.75
    assert inject.Drop(start=1.5).end == math.inf


GOOD_NUMBERS: list[tuple[str, dict[str, Any]]] = [
    ("drop", {"start": 0.5, "duration": 0.5}),
    ("drop", {"probability": 1.0}),
    ("drop", {"probability": 0.9}),
    ("drop", {"probability": 1e-9}),
    ("corrupt", {"at": [0, 63]}),
    ("corrupt", {"length": 0}),
    ("corrupt", {"bits": 0}),
    ("corrupt", {"bits": 64}),
    ("reorder", {"window": 100}),
    ("duplicate", {"copies": 1000}),
    ("send", {"frame": 0x1FFFFFFF, "data": "0011223344556677", "extended": True}),
    ("send", {"frame": 0x7FF, "data": "", "period": 0.001, "counter": 15, "length": 8}),
    ("flood", {"frame": 0x10, "last": 0x10, "rate": 1e5}),
    ("replay", {"begin": 1.0, "length": 1.0, "start": 2.0}),
    ("replay", {"begin": 0.0, "length": 1.0, "start": 1.0, "frame": "VGV_STATUS"}),
    ("replay", {"begin": 0.1, "length": 0.2, "start": 0.3}),  # whose sum is a little more
    ("machine", {"p_s": 40.0, "t_oil": -60.0}),
    ("machine", {"p_s": 0.0, "t_oil": 200.0}),
    ("machine", {"t_oil": 20.0}),
    ("machine", {"effect": "lvdt_bias", "parameters": {"bias": 5.0}}),
    ("machine", {"effect": "lvdt_bias", "parameters": {"bias": -5.0}}),
]


@pytest.mark.parametrize(("name", "keys"), GOOD_NUMBERS)
def test_what_lies_on_a_bound_is_taken(name: str, keys: dict[str, Any]) -> None:
    made = ACTIONS[name](**keys)
    assert {k: getattr(made, k) for k in keys} == keys


BAD: list[tuple[str, dict[str, Any], str]] = [
    ("drop", {"start": -0.001}, "greater than or equal to 0"),
    ("drop", {"start": math.inf}, "finite number"),
    ("drop", {"start": math.nan}, "finite number"),
    ("drop", {"start": True}, "valid number"),
    ("drop", {"duration": 0.0}, "greater than 0"),
    ("drop", {"every": 0}, "greater than or equal to 1"),
    ("drop", {"count": 0}, "greater than or equal to 1"),
    ("drop", {"probability": 0.0}, "greater than 0"),
    ("drop", {"probability": 1.1}, "less than or equal to 1"),
    ("drop", {"frame": 0x123}, "frame (=291) is sent by neither node; allowed: ECU_DEMAND, VGV_STATUS"),
    ("delay", {"delay": -0.1}, "greater than or equal to 0"),
    ("corrupt", {"bits": 65}, "less than or equal to 64"),
    ("corrupt", {"at": [64]}, "less than or equal to 63"),
    ("corrupt", {"length": 8}, "less than or equal to 7"),
    ("reorder", {"window": 1}, "greater than or equal to 2"),
    ("duplicate", {"copies": 0}, "greater than or equal to 1"),
    ("freeze", {"signal": "speed"}, "signal (='speed') is not in ECU_DEMAND"),
    ("override", {"signals": {}}, "at least 1 item"),
    ("override", {"signals": {"n_r": 132.0}}, "n_r (=132) does not fit its bits in ECU_DEMAND"),
    ("send", {"frame": 0x10}, "send takes either data (hex) or signals, and not both"),
    ("send", {"frame": 0xA0, "data": "00", "signals": {"n_r": 1.0}}, "send takes either data (hex) or signals"),
    ("send", {"frame": 0x10, "data": "0"}, "data (='0') must be bytes in hex, for example '0011AABB'"),
    ("send", {"frame": 0x10, "data": "00" * 9}, "has 9 bytes; a classic CAN frame holds at most 8"),
    ("send", {"frame": 0x800, "data": "00"}, "frame (=2048) must be one of"),
    ("send", {"frame": 0xA0, "signals": {"n_dem": 132.0}}, "n_dem (=132) does not fit its bits"),
    ("send", {"frame": 0x10, "data": "00", "e2e": "wrong_crc"}, "e2e (='wrong_crc') needs a frame with a DataID"),
    ("flood", {"last": 0x7FE}, "last (=2046) must not be below frame (=2047)"),
    ("flood", {"frame": 0x800}, "frame (=2048) must be one of"),
    ("flood", {"rate": 0.0}, "greater than 0"),
    ("replay", {}, "replay takes either log (a file) or begin (s, of this run), and not both"),
    ("replay", {"log": "a.log", "begin": 0.0, "start": 2.0}, "replay takes either log (a file) or begin"),
    ("replay", {"begin": 0.5, "length": 1.0, "start": 1.4}, "begin + length (=1.5 s) must not be after start (=1.4 s)"),
    ("replay", {"log": "a.log", "frame": "VGV"}, "frame (='VGV') must be one of"),
    ("replay", {"log": "a.log", "frame": 0x800}, "frame (=2048) must be one of"),
    ("machine", {}, "machine takes p_s, t_oil or effect"),
    ("machine", {"p_s": 1.0, "parameters": {"bias": 1.0}}, "parameters need an effect"),
    ("machine", {"effect": "bias"}, "effect (='bias') must be one of"),
    ("machine", {"effect": "lvdt_bias", "parameters": {"gain": 1.0}}, "parameters.gain is not one of lvdt_bias's: "),
    ("machine", {"effect": "lvdt_bias", "parameters": {"bias": 5.1}}, "(=5.1 mm) must be in [-5, 5]"),
    ("machine", {"effect": "lvdt_bias", "parameters": {"bias": -5.1}}, "(=-5.1 mm) must be in [-5, 5]"),
]


@pytest.mark.parametrize(("name", "keys", "said"), BAD)
def test_what_lies_beyond_a_bound_or_makes_no_sense_is_refused(name: str, keys: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError) as e:
        ACTIONS[name](**{**({} if "frame" in keys or name == "replay" or not keys else NEEDED.get(name, {})), **keys})
    assert said in str(e.value)


# ---- frames on their way ---------------------------------------------------------------------------------------------


def fed(actions: list[Any], ticks: int, frames: dict[int, list[Row]] | None = None, seed: int = 1) -> dict[int, list]:
    """What leaves a gateway by tick; into it goes, if nothing else is said, a demand every 10 ticks, its n_dem the
    tick's number in 0.002 %.
    """
    gateway = Gateway(actions, random.Random(seed))
    out = {}
    for k in range(ticks):
        sent = [numbered(k)] if frames is None and k % 10 == 0 else (frames or {}).get(k, [])
        if left := gateway.feed(k, sent):
            out[k] = left
    return out


def numbered(k: int) -> Row:
    """The demand of tick ``k``."""
    return row(DEMAND, demand(k * 0.002, 80.0, k // 10 % 15))


def number(frame: Row) -> int:
    """The tick of a `numbered` demand."""
    return frame[1] >> 16 & 0xFFFF


def numbers(left: dict[int, list]) -> dict[int, list[int]]:
    """Which demands leave when."""
    return {k: [number(f) for f in frames] for k, frames in left.items()}


def test_without_an_action_every_frame_passes_at_once() -> None:
    assert fed([], 40) == {k: [numbered(k)] for k in (0, 10, 20, 30)}
    assert Gateway([inject.Babble()], random.Random(1)).stages == [], "what others send is none of its business"


def test_an_action_acts_from_its_first_tick_on_to_the_tick_before_its_end() -> None:
    assert list(fed([inject.Drop(start=0.01, duration=0.02)], 50)) == [0, 30, 40]
    assert list(fed([inject.Drop(start=0.011, duration=0.02)], 50)) == [0, 10, 40]
    assert list(fed([inject.Drop(start=0.01, duration=0.021)], 50)) == [0, 40]


def test_only_the_frames_asked_for_are_met_whatever_their_kind() -> None:
    """Of a gateway for ECU_DEMAND neither a status nor a demand's lookalike among the frames of 29 bits is dropped."""
    status = row(STATUS, protected(STATUS, 0, bytes(6)))
    frames = {0: [status, numbered(0)], 5: [status]}
    assert fed([inject.Drop()], 10, frames) == {0: [status], 5: [status]}
    assert fed([inject.Drop(frame="VGV_STATUS")], 10, frames) == {0: [numbered(0)]}


def test_every_counts_the_frames_met_and_count_those_that_were_acted_on() -> None:
    assert [k // 10 for k in range(0, 100, 10) if k not in fed([inject.Drop(every=3)], 100)] == [0, 3, 6, 9]
    gone = fed([inject.Drop(every=2, count=2, start=0.01)], 100)
    assert [k // 10 for k in range(0, 100, 10) if k not in gone] == [1, 3]
    assert [k for k in range(0, 100, 10) if k not in fed([inject.Drop(count=1)], 100)] == [0]


def test_a_chance_is_drawn_once_for_each_frame_met_and_none_where_it_is_certain() -> None:
    chance = random.Random(1)
    gone = [k for k in range(0, 300, 10) if chance.random() < 0.4]
    left = fed([inject.Drop(probability=0.4)], 300)
    assert [k for k in range(0, 300, 10) if k not in left] == gone and 5 < len(gone) < 20
    gateway = Gateway([inject.Drop()], chance := random.Random(1))
    gateway.feed(0, [numbered(0)])
    assert gateway.stages[0].probability == 1.0 and chance.random() == random.Random(1).random()


def test_what_chance_spares_does_not_count() -> None:
    left = fed([inject.Drop(probability=0.5, count=3)], 400)
    assert 400 // 10 - len(left) == 3


def test_delayed_frames_keep_their_order_and_come_with_those_of_their_tick_before_them() -> None:
    left = numbers(fed([inject.Delay(delay=0.02, start=0.01, duration=0.03)], 80))
    assert left == {0: [0], 30: [10], 40: [20, 40], 50: [30, 50], 60: [60], 70: [70]}
    two = {0: [numbered(0), numbered(1)]}
    assert numbers(fed([inject.Delay(delay=0.005)], 10, two)) == {5: [0, 1]}
    assert numbers(fed([inject.Delay(delay=0.005)], 10, {0: two[0][::-1]})) == {5: [1, 0]}, "as they were sent"
    assert numbers(fed([inject.Delay(delay=0.0004)], 10, two)) == {0: [0, 1]}, "less than half a tick is none"
    assert numbers(fed([inject.Delay(delay=0.0006)], 10, two)) == {1: [0, 1]}


def test_jitter_is_added_at_random_up_to_its_most() -> None:
    late = {n: k - n for k, ns in numbers(fed([inject.Delay(delay=0.02, jitter=0.008)], 2000)).items() for n in ns}
    assert set(late.values()) == set(range(20, 29)), "20 ms and up to 8 ms more"


def test_copies_follow_their_frame_and_go_on_to_the_next_action() -> None:
    assert numbers(fed([inject.Duplicate(copies=3, count=1)], 20)) == {0: [0, 0, 0, 0], 10: [10]}
    both = [inject.Duplicate(count=1), inject.Drop(every=2)]
    assert numbers(fed(both, 20)) == {0: [0]}, "of 0, 0, 10 the first and the third are dropped"
    other = [inject.Drop(every=2), inject.Duplicate(count=1)]
    assert numbers(fed(other, 40)) == {10: [10, 10], 30: [30]}, "in the order of the scenario"


def test_a_delayed_frame_goes_on_to_the_actions_behind_and_not_again_to_its_own() -> None:
    two = [inject.Delay(delay=0.003), inject.Delay(delay=0.004)]
    assert numbers(fed(two, 30)) == {7: [0], 17: [10], 27: [20]}
    assert numbers(fed([inject.Delay(delay=0.003), inject.Drop(start=0.003, duration=0.001)], 30)) == {
        13: [10],
        23: [20],
    }


def test_reordered_frames_wait_for_their_window_and_come_in_reverse() -> None:
    assert numbers(fed([inject.Reorder()], 60)) == {10: [10, 0], 30: [30, 20], 50: [50, 40]}
    assert numbers(fed([inject.Reorder(window=3, start=0.01)], 60)) == {0: [0], 30: [30, 20, 10]}
    ended = [inject.Reorder(window=3, duration=0.015), inject.Duplicate()]
    assert numbers(fed(ended, 30)) == {15: [0, 0, 10, 10], 20: [20, 20]}, "the rest goes on in its old order"


def test_a_gateway_is_done_when_it_is_over_and_keeps_nothing_back() -> None:
    assert Gateway([], random.Random(1)).done(0)
    dropped = Gateway([inject.Drop(duration=0.02)], random.Random(1))
    assert [dropped.done(k) for k in (0, 19, 20)] == [False, False, True]
    late = Gateway([inject.Delay(delay=0.01, duration=0.001)], random.Random(1))
    late.feed(0, [numbered(0)])
    assert not late.done(5)
    late.feed(10, [])
    assert late.done(10)
    held = Gateway([inject.Reorder(duration=0.005)], random.Random(1))
    held.feed(0, [numbered(0)])
    assert not held.done(5) and held.feed(5, []) == [numbered(0)] and held.done(5)
    both = Gateway([inject.Drop(duration=0.02), inject.Drop()], random.Random(1))
    assert not both.done(10**9), "one without an end"


def test_corrupted_bits_are_those_asked_for_or_as_many_different_ones_by_chance() -> None:
    data = demand(80.0, 80.0, 3)
    through = {0: [row(DEMAND, data)]}
    ((_, turned),) = fed([inject.Corrupt(at=[0, 9, 63])], 1, through)[0]
    expected = bytearray(data)
    expected[0] ^= 1
    expected[1] ^= 2
    expected[7] ^= 0x80
    assert turned.to_bytes(8, "little", signed=True) == bytes(expected)
    turns = []
    for seed in range(200):
        ((head, turned),) = fed([inject.Corrupt(bits=5)], 1, through, seed)[0]
        turns.append((turned ^ through[0][0][1]) & (1 << 64) - 1)
        assert head == through[0][0][0] and turns[-1].bit_count() == 5
    assert np.bitwise_or.reduce(np.array(turns, np.uint64)) == np.uint64(2**64 - 1), "any of the 64"
    ((_, turned),) = fed([inject.Corrupt()], 1, through)[0]
    assert ((turned ^ through[0][0][1]) & (1 << 64) - 1).bit_count() == 1


@pytest.mark.parametrize("length", [0, 3, 7])
def test_a_cut_frame_keeps_its_first_bytes_and_says_its_length(length: int) -> None:
    data = bytes([1, 2, 3, 4, 5, 6, 7, 0xF8])
    ((head, cut),) = fed([inject.Corrupt(length=length, bits=9)], 1, {0: [row(DEMAND, data)]})[0]
    assert seen((head, cut)) == (DEMAND, length, data[:length])
    assert cut == int.from_bytes(data[:length], "little"), "nothing is left behind the end"
    twice = [inject.Corrupt(length=7), inject.Corrupt(length=2)]
    assert fed(twice, 1, {0: [row(DEMAND, data)]}) == {0: [row(DEMAND, data[:2])]}


def test_a_frozen_signal_keeps_the_first_value_while_everything_else_goes_on() -> None:
    sent = {k: [row(DEMAND, demand(10.0 + k, 50.0 + k, k))] for k in range(5)}
    left = fed([inject.Freeze(signal="n_dem", start=0.001, duration=0.003)], 5, sent)
    held = [demand(10.0 + (k if k in (0, 4) else 1), 50.0 + k, k) for k in range(5)]
    assert left == {k: [row(DEMAND, held[k])] for k in range(5)}
    kept = fed([inject.Freeze(signal="n_dem", e2e="keep")], 5, sent)
    for k in range(5):
        data = demand(10.0 + k, 50.0 + k, k)
        assert kept[k] == [row(DEMAND, data[:2] + demand(10.0)[2:4] + data[4:])], "the CRC is that of the old value"


def test_two_frozen_signals_are_kept_apart() -> None:
    sent = {k: [row(DEMAND, demand(10.0 + k, 50.0 + k, k))] for k in range(3)}
    both = [inject.Freeze(signal="n_dem"), inject.Freeze(signal="n_r", start=0.001)]
    assert fed(both, 3, sent)[2] == [row(DEMAND, demand(10.0, 51.0, 2))]


def test_overridden_signals_have_the_new_values_and_the_frame_s_own_counter() -> None:
    sent = {0: [row(DEMAND, demand(10.0, 50.0, 7))]}
    assert fed([inject.Override(signals={"n_dem": 99.0, "mode_request": 0})], 1, sent) == {
        0: [row(DEMAND, demand(99.0, 50.0, 7, request=0))]
    }
    kept = demand(10.0, 50.0, 7)[:4] + demand(0.0, 60.0)[4:]
    assert fed([inject.Override(signals={"n_r": 60.0}, e2e="keep")], 1, sent) == {0: [row(DEMAND, kept)]}
    ((_, counted),) = fed([inject.Override(signals={"counter": 9})], 1, sent)[0]
    assert counted.to_bytes(8, "little", signed=True) == demand(10.0, 50.0, 9), "its CRC fits the new counter"
    servo = {0: [row(SERVO, protected(SERVO, 4, bytes(6)))]}
    assert fed([inject.Override(frame="VGV_SERVO", signals={"i_cmd": -1.0})], 1, servo) == {
        0: [row(SERVO, protected(SERVO, 4, (-500 & 0xFFFF).to_bytes(2, "little") + bytes(4)))]
    }


def test_a_crc_that_is_itself_overridden_or_frozen_stays_as_given() -> None:
    data = demand(10.0, 50.0, 7)
    ((_, word),) = fed([inject.Override(signals={"crc": 0x5A})], 1, {0: [row(DEMAND, data)]})[0]
    assert word.to_bytes(8, "little", signed=True) == b"\x5a" + data[1:]
    later = demand(11.0, 50.0, 8)
    left = fed([inject.Freeze(signal="crc")], 2, {0: [row(DEMAND, data)], 1: [row(DEMAND, later)]})
    assert left[1] == [row(DEMAND, data[:1] + later[1:])]


def test_data_whose_last_byte_is_large_stay_within_a_word_of_64_bits_with_sign() -> None:
    data = bytes(7) + b"\xff"
    assert fed([inject.Corrupt(at=[])], 1, {0: [row(DEMAND, data)]}) == {0: [row(DEMAND, data)]}
    low = row(DEMAND, bytes(7) + b"\x7f")
    ((_, word),) = fed([inject.Corrupt(at=[63])], 1, {0: [low]})[0]
    assert word == -(1 << 56), "0xFF << 56 as int64"


# ---- what a third station sends --------------------------------------------------------------------------------------


def sent(action: Any, ticks: int, waiting: int = 0, recorded: list | None = None, seed: int = 1) -> dict[int, list]:
    """What an outsider sends by tick, as (identifier and flags, length, data)."""
    intruder = Intruder(action, random.Random(seed), recorded or [])
    out = {k: [seen(f) for f in intruder.tick(k, waiting)] for k in range(ticks)}
    return {k: frames for k, frames in out.items() if frames}


def test_without_a_period_a_frame_is_sent_once_at_the_start() -> None:
    assert sent(inject.Send(frame=0x123, data="0102FF", start=0.005), 50) == {5: [(0x123, 3, b"\1\2\xff")]}


def test_with_a_period_it_comes_from_the_start_on_to_before_the_end() -> None:
    often = inject.Send(frame=0x123, data="01", start=0.005, period=0.02, duration=0.06)
    assert list(sent(often, 100)) == [5, 25, 45]
    assert list(sent(often.model_copy(update={"duration": 0.061}), 100)) == [5, 25, 45, 65]


def test_a_frame_of_signals_counts_from_its_counter_on_to_14_under_a_right_crc() -> None:
    made = inject.Send(frame="ECU_DEMAND", signals={"n_dem": 70.0, "n_r": 71.0}, period=0.001, counter=13)
    assert sent(made, 4) == {
        k: [(DEMAND, 8, demand(70.0, 71.0, counter, request=0))] for k, counter in enumerate((13, 14, 0, 1))
    }
    first = sent(inject.Send(frame="ECU_DEMAND", signals={"n_dem": 70.0}), 1)
    assert first == {0: [(DEMAND, 8, demand(70.0, 0.0, 0, request=0))]}, "from 0, and what is not named is 0"


def test_protection_can_be_wrong_in_crc_or_counter_or_left_to_the_bytes() -> None:
    keys: dict[str, Any] = {"frame": "ECU_DEMAND", "signals": {"n_dem": 70.0}, "period": 0.001, "counter": 4}
    right = [demand(70.0, 0.0, c, request=0) for c in (4, 5)]
    for e2e, expected in (
        ("right", right),
        ("wrong_crc", [bytes([d[0] ^ 0xFF]) + d[1:] for d in right]),
        ("wrong_counter", [right[0], right[0]]),
        ("none", [b"\0\0" + right[0][2:]] * 2),
    ):
        assert sent(inject.Send(e2e=e2e, **keys), 2) == {k: [(DEMAND, 8, d)] for k, d in enumerate(expected)}, e2e


def test_raw_bytes_of_a_frame_with_a_data_id_are_protected_where_that_is_asked() -> None:
    raw = demand(33.0, 44.0, 0)
    plain = inject.Send(frame="ECU_DEMAND", data="FFFF" + raw[2:].hex())
    assert sent(plain, 1) == {0: [(DEMAND, 8, b"\xff\xff" + raw[2:])]}
    asked = inject.Send(frame="ECU_DEMAND", data="FF1F" + raw[2:].hex(), e2e="right", counter=2)
    assert sent(asked, 1) == {0: [(DEMAND, 8, demand(33.0, 44.0, 2))]}


def test_length_cuts_or_fills_and_kinds_are_marked() -> None:
    assert sent(inject.Send(frame=0x10, data="010203", length=2), 1) == {0: [(0x10, 2, b"\1\2")]}
    assert sent(inject.Send(frame=0x10, data="010203", length=5), 1) == {0: [(0x10, 5, b"\1\2\3\0\0")]}
    assert sent(inject.Send(frame=0x10, data="01", length=0), 1) == {0: [(0x10, 0, b"")]}
    assert sent(inject.Send(frame=0x10, data="0102", remote=True), 1) == {0: [(0x10 | REMOTE, 2, b"\0\0")]}
    assert sent(inject.Send(frame=0x12345678, data="01", extended=True), 1) == {0: [(0x12345678 | EXTENDED, 1, b"\1")]}
    assert sent(inject.Send(frame="ECU_DEMAND", signals={"n_dem": 70.0}, length=4), 1) == {
        0: [(DEMAND, 4, demand(70.0, 0.0, 0, request=0)[:4])]
    }
    intruder = Intruder(inject.Send(frame=0x10, data="0102FF", length=2), random.Random(1), [])
    assert intruder.tick(0, 0) == [row(0x10, b"\1\2")], "nothing behind the end"


@pytest.mark.parametrize("rate", [100.0, 1000.0, 2500.0, 3333.0])
def test_a_flood_with_a_rate_sends_so_many_up_to_each_tick_whatever_waits(rate: float) -> None:
    made = sent(inject.Flood(frame=0x100, rate=rate, start=0.1, duration=0.2), 500, waiting=50)
    total = 0
    for k in range(100, 300):
        total += len(made.get(k, []))
        assert total == math.floor((k - 99) * rate / 1000.0 + 1e-9)
    assert min(made) >= 100 and max(made) < 300


def test_a_flood_without_a_rate_keeps_twelve_frames_waiting() -> None:
    assert len(sent(inject.Flood(), 1)[0]) == 12, "the bus takes at most 11 in a tick"
    assert len(sent(inject.Flood(), 1, waiting=5)[0]) == 7
    assert sent(inject.Flood(), 1, waiting=12) == sent(inject.Flood(), 1, waiting=40) == {}


def test_a_flood_has_its_identifier_and_random_data_of_eight_bytes() -> None:
    frames = [f for of in sent(inject.Flood(rate=1e4), 200).values() for f in of]
    assert {(ident, length) for ident, length, _ in frames} == {(0x7FF, 8)}
    for byte in range(8):
        assert len({data[byte] for _, _, data in frames}) > 200
    between = [f for of in sent(inject.Flood(frame=0x10, last=0x13, rate=1e4), 100).values() for f in of]
    assert {ident for ident, _, _ in between} == {0x10, 0x11, 0x12, 0x13}


def test_a_babbling_idiot_sends_identifier_0_as_often_as_the_bus_takes_it() -> None:
    made = sent(inject.Babble(start=0.002, duration=0.002), 10, waiting=2)
    assert {k: {f[:2] for f in frames} for k, frames in made.items()} == {2: {(0, 8)}, 3: {(0, 8)}}
    assert [len(frames) for frames in made.values()] == [10, 10]


RECORDED = [(k, *row(DEMAND if k % 10 == 0 else STATUS, bytes([k] * 8))) for k in (10, 12, 20, 22, 30)]


def test_frames_of_this_run_come_again_with_their_spacing_over_and_over() -> None:
    made = inject.Replay(begin=0.01, length=0.02, start=0.1)
    again = {k: [data[0] for _, _, data in frames] for k, frames in sent(made, 145, recorded=RECORDED).items()}
    assert again == {
        k + n: [v] for n in (0, 20, 40) for k, v in ((100, 10), (102, 12), (110, 20), (112, 22)) if k + n < 145
    }
    once = made.model_copy(update={"loop": False})
    assert list(sent(once, 200, recorded=RECORDED)) == [100, 102, 110, 112], "the frame of 30 ms is behind the length"
    only = made.model_copy(update={"frame": "VGV_STATUS", "loop": False})
    assert list(sent(only, 200, recorded=RECORDED)) == [102, 112]
    number = made.model_copy(update={"frame": 0xA0, "loop": False})
    assert list(sent(number, 200, recorded=RECORDED)) == [100, 110]
    zero = inject.Replay(begin=0.0, length=0.013, start=0.1, loop=False)
    assert list(sent(zero, 200, recorded=RECORDED)) == [110, 112]


def test_frames_that_came_in_one_tick_come_again_in_one_tick() -> None:
    twice = [(5, *row(DEMAND, bytes([i] * 8))) for i in range(3)]
    made = sent(inject.Replay(begin=0.0, length=0.01, start=0.01, loop=False), 30, recorded=twice)
    assert {k: [d[0] for _, _, d in frames] for k, frames in made.items()} == {15: [0, 1, 2]}


def log_of(path: Path, frames: list[tuple[float, int, bytes]]) -> str:
    """A candump log of (s, identifier, data)."""
    data = np.array([[*d.ljust(8, b"\0")] for _, _, d in frames], np.uint8)
    columns = (
        np.array([t for t, _, _ in frames]),
        np.array([i for _, i, _ in frames], np.uint32),
        np.zeros(len(frames), np.int32),
        np.array([len(d) for _, _, d in frames], np.uint8),
    )
    write_candump(path, Frames(*columns, data))
    return str(path)


def test_a_log_s_frames_come_again_ten_ms_after_its_last_from_the_first(tmp_path: Path) -> None:
    log = log_of(
        tmp_path / "old.log",
        [
            (0.0, 0xA0, b"\1" * 8),
            (0.0104, 0x123, b"\2\3"),
            (0.0106, 0x12345678 | EXTENDED, b"\xff" * 8),
            (0.02, 0xA0, b""),
        ],
    )
    old = {0: [(0xA0, 8, b"\1" * 8)], 10: [(0x123, 2, b"\2\3")], 11: [(0x12345678 | EXTENDED, 8, b"\xff" * 8)]}
    old[20] = [(0xA0, 0, b"")]
    assert sent(inject.Replay(log=log, loop=False, start=0.005), 200) == {k + 5: f for k, f in old.items()}
    assert sent(inject.Replay(log=log), 60) == {k + n: f for n in (0, 30) for k, f in old.items()}
    assert list(sent(inject.Replay(log=log, frame="ECU_DEMAND", loop=False), 60)) == [0, 20]


def test_frames_of_can_fd_are_left_out_and_the_first_eight_bytes_read(tmp_path: Path) -> None:
    log = tmp_path / "fd.log"
    log.write_text("(0.000000) can0 123##0" + "01" * 12 + "\n(0.010000) can0 124##0" + "02" * 8 + "\n")
    assert sent(inject.Replay(log=str(log), loop=False), 50) == {10: [(0x124, 8, b"\2" * 8)]}


def test_a_log_without_such_a_frame_or_of_another_kind_is_refused(tmp_path: Path) -> None:
    log = log_of(tmp_path / "old.log", [(0.0, 0xB0, b"\1" * 8)])
    with pytest.raises(InputError, match=r"old\.log: holds no frame to replay of ECU_DEMAND$"):
        sent(inject.Replay(log=log, frame="ECU_DEMAND"), 1)
    fd = tmp_path / "fd.log"
    fd.write_text("(0.000000) can0 123##0" + "01" * 12 + "\n")
    with pytest.raises(InputError, match=r"fd\.log: holds no frame to replay$"):
        sent(inject.Replay(log=str(fd)), 1)
    with pytest.raises(InputError, match=r"old\.csv: suffix '\.csv' holds no frames to replay; allowed: .*\.log"):
        sent(inject.Replay(log=str(tmp_path / "old.csv")), 1)
    upper = log_of(tmp_path / "OLD.LOG", [(0.0, 0xB0, b"\1" * 8)])
    assert list(sent(inject.Replay(log=upper, loop=False), 5)) == [0]


# ---- claims ----------------------------------------------------------------------------------------------------------

BAD_CLAIMS: list[tuple[dict[str, Any], str]] = [
    ({"by": 1.0}, "about exactly one of mode, fault, signal, count, late; here: none"),
    ({"mode": "RUN", "late": "VGV_SERVO", "by": 1.0}, "mode, fault, signal, count, late; here: mode, late"),
    ({"mode": "OFF", "by": 1.0}, "mode (='OFF') must be one of INIT, STANDBY, RUN, DEGRADED, FAIL_SAFE"),
    ({"fault": "all", "by": 1.0}, "fault (='all') must be one of demand_stale, "),
    ({"signal": "speed", "low": 1.0, "by": 1.0}, "signal (='speed') must be one of x_dem, x_lvdt, i_cmd"),
    ({"count": "bad", "low": 1.0, "by": 1.0}, "count (='bad') must be one of good, sync, wrong_crc, repeated"),
    ({"late": "ECU_DEMAND", "by": 1.0}, "late (='ECU_DEMAND') must be one of VGV_STATUS, VGV_SERVO, VGV_ANGLES"),
    ({"mode": "RUN", "low": 1.0, "by": 1.0}, "mode does not take low or high"),
    ({"fault": "any", "high": 1.0, "by": 1.0}, "fault does not take low or high"),
    ({"late": "VGV_SERVO", "high": 1.0, "by": 1.0}, "late does not take low or high"),
    ({"signal": "x_dem", "by": 1.0}, "signal needs low or high"),
    ({"count": "lost", "by": 1.0}, "count needs low or high"),
    ({"signal": "x_dem", "low": 2.5, "high": 2.0, "by": 1.0}, "low (=2.5) must not be above high (=2)"),
    ({"mode": "RUN"}, "exactly one of at, by, during, never; here: none"),
    ({"mode": "RUN", "at": 1.0, "by": 1.0}, "exactly one of at, by, during, never; here: at, by"),
    ({"mode": "RUN", "by": 1.0, "during": [0.0, 1.0]}, "exactly one of at, by, during, never; here: by, during"),
    ({"mode": "RUN", "at": 1.0, "never": True}, "exactly one of at, by, during, never; here: at, never"),
    ({"mode": "RUN", "during": [1.0, 1.0]}, "during (=[1.0, 1.0]) must be a time and a later one"),
    ({"mode": "RUN", "never": True, "during": [2.0, 1.0]}, "during (=[2.0, 1.0]) must be a time and a later one"),
    ({"mode": "RUN", "during": [1.0]}, "at least 2 items"),
    ({"mode": "RUN", "during": [1.0, 2.0, 3.0]}, "at most 2 items"),
    ({"mode": "RUN", "by": 1.0, "after": 1.0}, "by (=1 s) must be after 1 s"),
    ({"mode": "RUN", "by": 0.0}, "by (=0 s) must be after 0 s"),
    ({"mode": "RUN", "at": -1.0}, "greater than or equal to 0"),
    ({"mode": "RUN", "at": 1.0, "tolerance": 0.0}, "greater than 0"),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "said"), BAD_CLAIMS)
def test_a_claim_that_says_nothing_or_too_much_is_refused(keys: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError) as e:
        Expect(**keys)
    assert said in str(e.value)


CLAIMS: list[tuple[dict[str, Any], str, float]] = [
    ({"mode": "RUN", "at": 2.0}, "RUN from 2.000 s on (+-2 ms)", 2.0),
    ({"mode": "RUN", "at": 2.0, "tolerance": 0.05}, "RUN from 2.000 s on (+-50 ms)", 2.0),
    ({"fault": "any", "by": 3.5}, "any fault by 3.500 s", 3.5),
    ({"fault": "demand_stale", "by": 3.5, "after": 2.0}, "demand_stale by 3.500 s, after 2.000 s", 3.5),
    ({"late": "VGV_STATUS", "during": [1.0, 2.5]}, "VGV_STATUS late from 1.000 to 2.500 s", 2.5),
    ({"mode": "RUN", "never": True}, "never RUN", 0.0),
    ({"mode": "RUN", "never": True, "during": [1.0, 2.5]}, "never RUN from 1.000 to 2.500 s", 2.5),
    ({"signal": "x_dem", "low": 1.5, "during": [0.0, 1.0]}, "1.5 <= x_dem from 0.000 to 1.000 s", 1.0),
    ({"signal": "x_dem", "high": 2.0, "by": 1.0}, "x_dem <= 2 by 1.000 s", 1.0),
    ({"count": "lost", "low": 4, "high": 4.0, "at": 1.0}, "4 <= lost <= 4 from 1.000 s on (+-2 ms)", 1.0),
]


@pytest.mark.parametrize(("keys", "words", "latest"), CLAIMS)
def test_a_claim_says_in_words_what_and_when_and_of_how_late_it_speaks(
    keys: dict[str, Any], words: str, latest: float
) -> None:
    claim = Expect(**keys)
    assert (claim.words, claim.latest) == (words, latest)


def test_a_claim_has_two_ms_from_power_on_and_is_of_every_bus_by_default() -> None:
    claim = Expect(mode="RUN", at=0.0)
    assert claim.model_dump(exclude_none=True) == {
        "mode": "RUN", "at": 0.0, "tolerance": 0.002, "after": 0.0, "never": False, "because": "",
    }  # fmt: skip


# ---- scenarios -------------------------------------------------------------------------------------------------------


def test_a_scenario_is_an_ecu_at_80_percent_by_default() -> None:
    made = Scenario(title="four", duration=1.0)
    assert made.model_dump() == {
        "title": "four", "why": "", "duration": 1.0, "seed": 1, "demand": [[0.0, 80.0]], "secoc": False, "inject": [],
        "expect": [], **dict.fromkeys(("side_a", "side_b"), {"parameters": {}, "effects": {}}),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"title": "bad"}, "at least 4 characters"),
        ({"duration": 0.0}, "greater than 0"),
        ({"duration": 3600.1}, "less than or equal to 3600"),
        ({"seed": -1}, "greater than or equal to 0"),
        ({"demand": []}, "at least 1 item"),
        ({"demand": [[0.0]]}, "at least 2 items"),
        ({"demand": [[0.0, 80.0], [1.0, 80.0], [1.0, 90.0]]}, "demand: its times (=[0.0, 1.0, 1.0]) must increase"),
        ({"demand": [[0.0, -0.1]]}, "demand: -0.1 % must be in [0, 125]"),
        ({"demand": [[0.0, 80.0], [1.0, 125.1]]}, "demand: 125.1 % must be in [0, 125]"),
        ({"inject": [inject.Drop(), inject.Drop(start=3.0)]}, "inject.1.start (=3 s) must be before the end (du"),
        ({"expect": [Expect(mode="RUN", by=3.1)]}, "expect.0 speaks of 3.1 s; the scenario ends at 3 s"),
    ],
)  # fmt: skip
def test_a_scenario_beyond_its_bounds_is_refused(keys: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError) as e:
        Scenario(**{"title": "bounds", "duration": 3.0, **keys})
    assert said in str(e.value)


def test_a_scenario_on_its_bounds_is_taken() -> None:
    Scenario(title="bounds", duration=3600.0, demand=[[0.0, 0.0], [1.0, 125.0]], seed=0)
    last = Scenario(
        title="bounds", duration=3.0, inject=[inject.Drop(start=2.999)], expect=[Expect(mode="RUN", by=3.0)]
    )
    assert last.inject[0].end == math.inf, "what has no end may outlast the scenario"


def test_a_log_beside_its_scenario_is_found_there_and_another_stays_as_named(tmp_path: Path) -> None:
    (tmp_path / "here.log").write_text("")
    file = tmp_path / "again.toml"
    file.write_text(
        'title = "again"\nduration = 3.0\n[[inject]]\naction = "replay"\nlog = "here.log"\n'
        '[[inject]]\naction = "replay"\nlog = "there.log"\n[[inject]]\naction = "drop"\n'
        '[[inject]]\naction = "replay"\nbegin = 0.0\nstart = 1.0\n'
    )
    for source in (file, str(file)):
        made = load_scenario(source)
        assert [getattr(a, "log", "none") for a in made.inject] == [
            str(tmp_path / "here.log"),
            "there.log",
            "none",
            None,
        ]


def test_what_is_no_file_is_a_shipped_name_or_refused(tmp_path: Path) -> None:
    assert load_scenario("nominal").title == load_scenario(library()["nominal"]).title
    with pytest.raises(InputError, match=r"^nominl: no such file or shipped scenario; 'nominal' ships$"):
        load_scenario("nominl")
    with pytest.raises(InputError, match=r"^qqqq: no such file .*; vaneloop inject --list shows those that ship$"):
        load_scenario("qqqq")
    with pytest.raises(InputError, match="no such file or shipped scenario"):
        load_scenario(tmp_path)


# ---- the verdict -----------------------------------------------------------------------------------------------------

# 0.0 to 0.9 s
MODE_NAMES = ["INIT", "STANDBY", "RUN", "RUN", "RUN", "DEGRADED", "DEGRADED", "RUN", "RUN", "RUN"]
STALE, REJECTED = 1, 2  # the first two fault bits


def trace(modes: list[str] | None = None, **keys: Any) -> Trace:
    """A sample every 0.1 s: the modes above; stale from 0.5 s, rejected at 0.6 s; x_dem 20 to 29 mm; lost counts."""
    names = modes or MODE_NAMES
    n = len(names)
    faults = np.zeros(n, np.int64)
    faults[5:7] = STALE
    faults[6:7] |= REJECTED
    made: dict[str, Any] = {
        "t": np.arange(n) * 0.1,
        "mode": np.array([MODES.index(m) for m in names]),
        "faults": faults,
        "signals": {"x_dem": 20.0 + np.arange(n), "i_cmd": np.zeros(n)},
        "counts": {"lost": np.arange(n) // 3},
        "late": {"VGV_STATUS": np.arange(n) >= 8},
    }
    return Trace(**{**made, **keys})


def check(claim: Expect, of: Trace | None = None, lockstep: bool = True) -> Check:
    """The verdict on one claim."""
    return judge(Scenario(title="made", duration=10.0, expect=[claim]), of or trace(), lockstep=lockstep)[0]


JUDGED: list[tuple[dict[str, Any], bool, str]] = [
    ({"mode": "DEGRADED", "at": 0.5}, True, "from 0.500 s on"),
    ({"mode": "DEGRADED", "at": 0.502}, True, "from 0.500 s on"),  # on the tolerance
    ({"mode": "DEGRADED", "at": 0.498}, True, "from 0.500 s on"),
    ({"mode": "DEGRADED", "at": 0.5021}, False, "from 0.500 s on"),
    ({"mode": "DEGRADED", "at": 0.4979}, False, "from 0.500 s on"),
    ({"mode": "DEGRADED", "at": 0.4, "tolerance": 0.1}, True, "from 0.500 s on"),
    ({"mode": "INIT", "at": 0.0}, True, "from 0.000 s on"),  # what is true at first begins there
    ({"mode": "RUN", "at": 0.7}, True, "from 0.200, 0.700 s on"),
    ({"mode": "FAIL_SAFE", "at": 0.7}, False, "never"),
    ({"fault": "demand_rejected", "at": 0.6}, True, "from 0.600 s on"),
    ({"fault": "demand_stale", "at": 0.5}, True, "from 0.500 s on"),
    ({"fault": "any", "at": 0.5}, True, "from 0.500 s on"),
    ({"late": "VGV_STATUS", "at": 0.8}, True, "from 0.800 s on"),
    ({"count": "lost", "low": 2, "at": 0.6}, True, "from 0.600 s on"),
    ({"mode": "DEGRADED", "by": 0.5}, True, "at 0.500 s"),
    ({"mode": "DEGRADED", "by": 0.499}, False, "not before 0.500 s"),
    ({"mode": "DEGRADED", "by": 0.9, "after": 0.6}, True, "at 0.600 s"),
    ({"mode": "DEGRADED", "by": 0.9, "after": 0.601}, False, "never"),
    ({"mode": "RUN", "by": 0.6, "after": 0.401}, False, "not before 0.700 s"),
    ({"mode": "FAIL_SAFE", "by": 0.5}, False, "never"),
    ({"mode": "RUN", "during": [0.2, 0.4]}, True, "RUN"),
    ({"mode": "RUN", "during": [0.199, 0.4]}, True, "RUN"),
    ({"mode": "RUN", "during": [0.1, 0.4]}, False, "broken at 0.100 s: STANDBY"),
    ({"mode": "RUN", "during": [0.1, 0.6]}, False, "broken at 0.100 s: STANDBY > DEGRADED"),
    ({"mode": "RUN", "during": [0.41, 0.49]}, False, "nothing was seen then"),
    ({"mode": "RUN", "during": [1.0, 2.0]}, False, "nothing was seen then"),
    ({"mode": "FAIL_SAFE", "never": True}, True, "INIT > STANDBY > RUN > DEGRADED > RUN"),
    ({"mode": "INIT", "never": True}, False, "broken at 0.000 s: INIT"),
    ({"mode": "DEGRADED", "never": True}, False, "broken at 0.500 s: DEGRADED"),
    ({"mode": "DEGRADED", "never": True, "during": [0.0, 0.4]}, True, "INIT > STANDBY > RUN"),
    ({"mode": "DEGRADED", "never": True, "during": [0.0, 0.5]}, False, "broken at 0.500 s: DEGRADED"),
    ({"mode": "DEGRADED", "never": True, "during": [0.7, 0.9]}, True, "RUN"),
    ({"mode": "DEGRADED", "never": True, "during": [0.6, 0.9]}, False, "broken at 0.600 s: DEGRADED"),
    ({"signal": "x_dem", "low": 22.0, "high": 24.0, "during": [0.2, 0.4]}, True, "x_dem 22 to 24"),
    ({"signal": "x_dem", "low": 22.1, "during": [0.2, 0.4]}, False, "broken at 0.200 s: x_dem 22"),
    ({"signal": "x_dem", "high": 23.9, "during": [0.2, 0.4]}, False, "broken at 0.400 s: x_dem 24"),
    ({"signal": "x_dem", "low": 25.0, "high": 25.0, "at": 0.5}, True, "from 0.500 s on"),
    ({"count": "lost", "high": 1, "during": [0.0, 0.5]}, True, "lost 0 to 1"),
    ({"count": "lost", "high": 1, "during": [0.0, 0.6]}, False, "broken at 0.600 s: lost 2"),
    ({"fault": "any", "never": True}, False, "broken at 0.500 s: demand_stale, demand_rejected"),
    ({"fault": "demand_stale", "never": True, "during": [0.0, 0.4]}, True, "no fault"),
    ({"fault": "demand_rejected", "never": True, "during": [0.5, 0.5001]}, True, "demand_stale"),
    ({"fault": "demand_stale", "during": [0.5, 0.6]}, True, "demand_stale, demand_rejected"),
    ({"late": "VGV_STATUS", "never": True, "during": [0.0, 0.7]}, True, "not late"),
    ({"late": "VGV_STATUS", "never": True}, False, "broken at 0.800 s: late at times"),
]


@pytest.mark.parametrize(("keys", "held", "said"), JUDGED, ids=[str(k) for k, _, _ in JUDGED])
def test_a_claim_is_judged_with_its_bounds_included_and_what_was_seen_is_told(
    keys: dict[str, Any], held: bool, said: str
) -> None:
    claim = Expect(because="the rule", **keys)
    assert check(claim) == Check(claim.words, said, held, "the rule")


def test_more_than_six_beginnings_are_counted() -> None:
    def seen_of(n: int) -> str:
        return check(Expect(mode="RUN", at=5.0), trace(["STANDBY", "RUN"] * n, signals={})).seen

    assert seen_of(6) == "from 0.100, 0.300, 0.500, 0.700, 0.900, 1.100 s on"
    assert seen_of(7).endswith(", 1.100 and 1 more s on")
    assert seen_of(8) == "from 0.100, 0.300, 0.500, 0.700, 0.900, 1.100 and 2 more s on"


ELSEWHERE: list[tuple[dict[str, Any], bool | None, str]] = [
    ({"mode": "DEGRADED", "at": 0.552}, True, "from 0.500 s on"),  # 50 ms and the tolerance
    ({"mode": "DEGRADED", "at": 0.5521}, False, "from 0.500 s on"),
    ({"mode": "DEGRADED", "by": 0.45}, True, "at 0.500 s"),
    ({"mode": "DEGRADED", "by": 0.4499}, False, "not before 0.500 s"),
    ({"mode": "RUN", "during": [0.15, 0.45]}, True, "RUN"),
    ({"mode": "RUN", "during": [0.06, 0.54]}, True, "RUN"),
    ({"mode": "RUN", "during": [0.05, 0.54]}, False, "broken at 0.100 s: STANDBY"),
    ({"mode": "RUN", "during": [0.06, 0.55]}, False, "broken at 0.500 s: DEGRADED"),
    ({"mode": "INIT", "never": True}, False, "broken at 0.000 s: INIT"),
    ({"mode": "RUN", "at": 0.2, "only": "lockstep"}, None, "only lockstep has this timing"),
    ({"count": "good", "low": 1, "never": True}, None, "the frames on this bus do not show it"),
    ({"signal": "x_lvdt", "low": 1, "never": True}, None, "the frames on this bus do not show it"),
    ({"late": "VGV_SERVO", "never": True}, None, "the frames on this bus do not show it"),
]


@pytest.mark.parametrize(("keys", "held", "said"), ELSEWHERE, ids=[str(k) for k, _, _ in ELSEWHERE])
def test_on_another_bus_every_time_has_50_ms_more(keys: dict[str, Any], held: bool | None, said: str) -> None:
    claim = Expect(because="the rule", **keys)
    assert check(claim, lockstep=False) == Check(claim.words, said, held, "the rule")


def test_on_lockstep_a_claim_of_lockstep_alone_is_judged() -> None:
    assert check(Expect(mode="RUN", at=0.2, only="lockstep")).held is True


def test_a_signal_that_is_no_number_is_shown_as_nan_and_where_it_is_one_as_that() -> None:
    claim = Expect(signal="x_dem", low=20.0, never=True)
    values = np.array([np.nan, 20.0, np.nan, 21.0, *[np.nan] * 6])
    of = trace(signals={"x_dem": values})
    assert of.shown(claim, np.isnan(values)) == "x_dem nan" and of.shown(claim, values > 0) == "x_dem 20 to 21"
    assert of.shown(claim, np.arange(10) < 2) == "x_dem 20"


def test_what_no_sample_shows_is_shown_as_nothing() -> None:
    assert trace().shown(Expect(mode="RUN", never=True), np.zeros(10, bool)) == "nothing"


def always(of: Trace) -> list[Check]:
    """What is demanded of every run."""
    return judge(Scenario(title="made", duration=1.0), of)


def test_stroke_current_and_mode_changes_are_always_judged() -> None:
    low, high, changes = always(trace(current=0.5))
    assert low == Check("always 0 <= x_dem <= 48 mm", "20 to 29 mm", True)
    assert high == Check("always -0.5 <= i_cmd <= 0.5 mA", "0 to 0 mA", True)
    assert changes == Check("mode changes as documented", "4 changes", True)
    assert always(trace())[1].expected == "always -40 <= i_cmd <= 40 mA"


@pytest.mark.parametrize(("exact", "allowed"), [(True, 1e-6), (False, 2e-3)])
@pytest.mark.parametrize(("name", "at"), [("x_dem", 0), ("i_cmd", 1)])
def test_a_limit_may_be_reached_and_passed_by_rounding_alone(exact: bool, allowed: float, name: str, at: int) -> None:
    low, high = ((1.0, 30.0), (-30.0, 30.0))[at]

    def held(value: float) -> bool | None:
        values = {"x_dem": np.full(10, 10.0), "i_cmd": np.zeros(10)}
        values[name] = values[name].copy()
        values[name][3] = value
        return always(trace(signals=values, stroke=(1.0, 30.0), current=30.0, exact=exact))[at].held

    assert [held(high + 0.9 * allowed), held(low - 0.9 * allowed)] == [True, True]
    assert [held(high + 1.1 * allowed), held(low - 1.1 * allowed), held(math.nan)] == [False, False, False]


def test_a_signal_that_was_not_seen_is_not_within_its_limits() -> None:
    assert [(c.seen, c.held) for c in always(trace(signals={}))[:2]] == [("nothing", False)] * 2
    assert [c.held for c in always(trace(["RUN"]))] == [True] * 3, "one sample is one"
    assert check(Expect(mode="FAIL_SAFE", never=True), trace(["RUN"])).held


def test_mode_changes_are_those_of_the_page_where_every_tick_of_our_firmware_is_seen() -> None:
    page = {
        ("INIT", "STANDBY"), ("INIT", "FAIL_SAFE"), ("STANDBY", "RUN"), ("STANDBY", "FAIL_SAFE"), ("RUN", "STANDBY"),
        ("RUN", "DEGRADED"), ("RUN", "FAIL_SAFE"), ("DEGRADED", "RUN"), ("DEGRADED", "FAIL_SAFE"),
        ("FAIL_SAFE", "RUN"), ("FAIL_SAFE", "STANDBY"),
    }  # fmt: skip
    for a in MODES:
        for b in set(MODES) - {a}:
            *_, changes = always(trace([a, a, b, b]))
            assert changes == Check(
                "mode changes as documented", "1 changes" if (a, b) in page else f"not: {a} > {b}", (a, b) in page
            )
    assert always(trace(["INIT", "RUN", "INIT"]))[-1].seen == "not: INIT > RUN, RUN > INIT"
    assert len(always(trace(exact=False))) == len(always(trace(ours=False))) == 2, "not judged"


def test_an_outcome_tells_modes_faults_and_counts() -> None:
    faults = np.array([0, STALE, STALE, STALE | REJECTED, REJECTED, STALE | 1 << 8, 0, 0, 0, 0])
    rest: dict[str, Any] = {"notes": ["a note"], "simulated_s": 1.0, "wall_s": 0.5, "state_hash": "ab"}
    claim = Expect(mode="RUN", at=0.7, because="the rule")
    scenario = Scenario(title="made", duration=1.0, expect=[claim])
    outcome = outcome_of("name", scenario, "lockstep", trace(faults=faults), **rest)
    assert outcome.modes == [
        (0.0, "INIT"), (pytest.approx(0.1), "STANDBY"), (pytest.approx(0.2), "RUN"), (0.5, "DEGRADED"),
        (pytest.approx(0.7), "RUN"),
    ]  # fmt: skip
    assert [(round(t, 3), f) for t, f in outcome.faults] == [
        (0.1, "demand_stale"), (0.3, "demand_rejected"), (0.5, "demand_stale"), (0.5, FAULTS[8]),
    ]  # fmt: skip
    assert outcome.faults_seen() == {"demand_stale", "demand_rejected", "paused"}
    assert outcome.counts == {"lost": 3} and outcome.mode == "RUN" and outcome.held
    assert [outcome.mode_at(t) for t in (-1.0, 0.0, 0.05, 0.1, 0.4999, 0.5, 0.65, 9.0)] == [
        "INIT", "INIT", "INIT", "STANDBY", "RUN", "DEGRADED", "DEGRADED", "RUN",
    ]  # fmt: skip
    assert outcome.text().splitlines() == [
        "name: held (made)",
        "  held    RUN from 0.700 s on (+-2 ms)  |  seen: from 0.200, 0.700 s on",
        "  held    always 0 <= x_dem <= 48 mm  |  seen: 20 to 29 mm",
        "  held    always -40 <= i_cmd <= 40 mA  |  seen: 0 to 0 mA",
        "  held    mode changes as documented  |  seen: 4 changes",
        "  modes: INIT 0.000 s, STANDBY 0.100 s, RUN 0.200 s, DEGRADED 0.500 s, RUN 0.700 s",
    ]
    plain = outcome.json()
    assert plain["expectations"][0] == {
        "expected": claim.words, "seen": "from 0.200, 0.700 s on", "held": True, "because": "the rule",
    }  # fmt: skip
    assert plain["modes"][0] == {"t": 0.0, "mode": "INIT"} and plain["faults"][0]["fault"] == "demand_stale"
    assert (plain["name"], plain["title"], plain["held"], plain["notes"]) == ("name", "made", True, ["a note"])
    at_once = outcome_of("name", scenario, "lockstep", trace(faults=np.full(10, STALE)), **rest)
    assert at_once.faults == [(0.0, "demand_stale")], "a fault of the first sample begins there"
    assert outcome_of("name", scenario, "lockstep", trace(["STANDBY", "RUN"]), **rest).modes[0] == (0.0, "STANDBY")


def test_one_broken_claim_breaks_the_outcome_and_one_unseen_does_not() -> None:
    rest: dict[str, Any] = {"notes": [], "simulated_s": 1.0, "wall_s": 0.5, "state_hash": None}
    broken = Scenario(title="made", duration=1.0, expect=[Expect(mode="RUN", at=0.6)])
    outcome = outcome_of("name", broken, "lockstep", trace(), **rest)
    assert not outcome.held
    assert outcome.text().splitlines()[:2] == [
        "name: NOT held (made)",
        "  BROKEN  RUN from 0.600 s on (+-2 ms)  |  seen: from 0.200, 0.700 s on",
    ]
    unseen = Scenario(title="made", duration=1.0, expect=[Expect(count="good", low=1.0, at=0.6)])
    outcome = outcome_of("name", unseen, "local", trace(exact=False), **rest)
    assert outcome.held and "  unseen  1 <= good from 0.600 s on (+-2 ms)" in outcome.text()
    fast = Scenario(title="made", duration=1.0, expect=[Expect(mode="RUN", at=0.65)])
    assert outcome_of("name", fast, "local", trace(), **rest).held
    assert not outcome_of("name", fast, "lockstep", trace(), **rest).held


def test_of_a_controller_that_failed_nothing_else_is_known() -> None:
    outcome = failed("name", Scenario(title="made", duration=1.0), "it crashed")
    of = outcome.trace
    assert (of.t.tolist(), of.mode.tolist(), of.faults.tolist(), of.signals, of.ours) == ([0.0], [0], [0], {}, False)
    assert outcome == Outcome(
        "name", "made", "lockstep", [Check("the controller runs to the end", "it crashed", False)], of,
        [(0.0, "INIT")], [], {}, [], 0.0, 0.0, None,
    )  # fmt: skip
    assert not outcome.held


# ---- margins ---------------------------------------------------------------------------------------------------------

# every 1 ms for a second: STANDBY, RUN from 0.2 s, DEGRADED from 0.8 s; x_lvdt rises by 10 mm/s from 0
MS = np.arange(1001) * 1e-3
RAMP = Trace(
    MS,
    np.where(MS < 0.1995, 1, np.where(MS < 0.7995, 2, 3)),
    np.zeros(1001, np.int64),
    {"x_dem": 20.0 + MS, "x_lvdt": 10.0 * MS, "i_cmd": 0.0 * MS, "n_dem": 80.0 + MS, "vigv": -MS},
)
NAN = math.nan
MARGINS: list[tuple[dict[str, Any], bool, float, str, float]] = [
    ({"mode": "RUN", "at": 0.2}, True, 0.002, "s", 1.0),
    ({"mode": "RUN", "at": 0.2015}, True, 0.0005, "s", 0.25),
    ({"mode": "RUN", "at": 0.202}, True, 0.0, "s", 0.0),
    ({"mode": "RUN", "at": 0.203}, False, -0.001, "s", -0.5),
    ({"mode": "RUN", "at": 0.3, "tolerance": 0.4}, True, 0.3, "s", 0.75),
    ({"mode": "RUN", "at": 0.21}, False, -0.008, "s", -1.0),  # -4 times the tolerance
    ({"mode": "FAIL_SAFE", "at": 0.2}, False, NAN, "s", -1.0),
    ({"mode": "STANDBY", "at": 0.001}, True, 0.001, "s", 0.5),  # what is true at first begins there
    ({"signal": "vigv", "low": 0.5, "by": 0.5, "after": 0.2}, False, -0.7, "deg", -1.0),  # -0.2 deg at 0.2 s is best
    ({"signal": "x_lvdt", "low": 1.0, "during": [0.4, 0.7]}, True, 3.0, "mm", 1.0),  # three times the limit
    ({"signal": "x_lvdt", "low": 1.0, "during": [0.4002, 0.4008]}, False, NAN, "mm", -1.0),  # nothing was seen
    ({"mode": "RUN", "by": 0.5}, True, 0.3, "s", 0.6),
    ({"mode": "RUN", "by": 0.5, "after": 0.1}, True, 0.3, "s", 0.75),
    ({"mode": "RUN", "by": 0.2}, True, 0.0, "s", 0.0),
    ({"mode": "RUN", "by": 0.15, "after": 0.05}, False, -0.05, "s", -0.5),
    ({"mode": "STANDBY", "by": 0.5, "after": 0.199}, True, 0.301, "s", 1.0),
    ({"mode": "FAIL_SAFE", "by": 0.5}, False, NAN, "s", -1.0),
    ({"signal": "x_lvdt", "low": 12.0, "by": 0.5}, False, -2.0, "mm", -2.0 / 12.0),  # the best is 10 mm
    ({"signal": "x_lvdt", "low": 12.0, "high": 14.0, "by": 0.5}, False, -2.0, "mm", -1.0),
    ({"mode": "RUN", "during": [0.4, 0.7]}, True, 0.2, "s", 0.5),
    ({"mode": "RUN", "during": [0.2, 0.7]}, True, 0.0, "s", 0.0),
    ({"mode": "STANDBY", "during": [0.0, 0.1]}, True, NAN, "", NAN),  # nothing came before it
    ({"mode": "RUN", "during": [0.7, 0.9]}, False, -0.101, "s", -0.505),
    ({"mode": "RUN", "during": [0.1, 0.3]}, False, -0.1, "s", -0.5),
    ({"mode": "FAIL_SAFE", "never": True}, True, NAN, "", NAN),
    ({"mode": "DEGRADED", "never": True}, False, -0.201, "s", -0.201),
    ({"mode": "DEGRADED", "never": True, "during": [0.5, 0.9]}, False, -0.101, "s", -0.2525),
    ({"signal": "x_lvdt", "low": 3.0, "high": 8.0, "during": [0.4, 0.7]}, True, 1.0, "mm", 0.4),
    ({"signal": "x_lvdt", "low": 3.0, "high": 9.0, "during": [0.4, 0.7]}, True, 1.0, "mm", 1.0 / 3.0),
    ({"signal": "x_lvdt", "low": 2.0, "during": [0.4, 0.7]}, True, 2.0, "mm", 1.0),
    ({"signal": "x_lvdt", "high": 8.0, "during": [0.4, 0.7]}, True, 1.0, "mm", 0.125),
    ({"signal": "x_lvdt", "high": 5.0, "during": [0.4, 0.6]}, False, -1.0, "mm", -0.2),
    ({"signal": "x_lvdt", "low": 5.0, "high": 5.0, "during": [0.5, 0.5001]}, True, 0.0, "mm", 0.0),
    ({"signal": "n_dem", "low": 80.0, "during": [0.5, 0.6]}, True, 0.5, "%", 0.5 / 80.0),
    ({"signal": "vigv", "high": 0.0, "during": [0.5, 0.6]}, True, 0.5, "deg", 0.5),  # of a limit of 0: of 1
    ({"signal": "i_cmd", "low": -2.0, "during": [0.5, 0.6]}, True, 2.0, "mA", 1.0),
    ({"signal": "x_lvdt", "low": 5.0, "never": True}, False, -0.501, "s", -0.501),
]  # fmt: skip


def outcome_on(of: Trace, checks: list[Check]) -> Outcome:
    """An outcome with these verdicts."""
    return Outcome("made", "", "lockstep", checks, of, [], [], {}, [], 1.0, 0.0, None)


@pytest.mark.parametrize(("keys", "held", "value", "unit", "share"), MARGINS, ids=[str(m[0]) for m in MARGINS])
def test_a_margin_is_told_in_the_claim_s_unit_and_as_a_share(
    keys: dict[str, Any], held: bool, value: float, unit: str, share: float
) -> None:
    claim = Expect(**keys)
    scenario = Scenario(title="made", duration=1.0, expect=[claim])
    first, *always_made = margins(scenario, outcome_on(RAMP, judge(scenario, RAMP)))
    assert (first.expected, first.held) == (claim.words, held)
    assert first.value == pytest.approx(value, abs=1e-9, nan_ok=True)
    assert first.share == pytest.approx(share, abs=1e-6, nan_ok=True)
    assert math.isnan(value) or first.unit == unit
    assert len(always_made) == 3


def test_a_broken_claim_s_margin_is_below_zero_even_where_its_distance_is_rounding() -> None:
    signals = {**RAMP.signals, "x_dem": np.full(1001, 20.0 - 2e-9)}
    scenario = Scenario(title="made", duration=1.0, expect=[Expect(signal="x_dem", low=20.0, during=[0.1, 0.2])])
    (m, *_) = margins(scenario, outcome_on(of := Trace(MS, RAMP.mode, RAMP.faults, signals), judge(scenario, of)))
    assert m.value == pytest.approx(-2e-9, rel=1e-3) and m.share == -1e-9 and not m.held


def test_a_signal_that_is_no_number_has_no_margin_and_is_broken() -> None:
    signals = {**RAMP.signals, "x_dem": np.where(MS == 0.15, np.nan, 20.0)}
    scenario = Scenario(title="made", duration=1.0, expect=[Expect(signal="x_dem", low=1.0, during=[0.1, 0.2])])
    (m, *_) = margins(scenario, outcome_on(of := Trace(MS, RAMP.mode, RAMP.faults, signals), judge(scenario, of)))
    assert math.isnan(m.value) and m.share == -1.0


def test_what_is_always_demanded_has_a_margin_only_where_it_is_broken() -> None:
    scenario = Scenario(title="made", duration=1.0)
    held = margins(scenario, outcome_on(RAMP, judge(scenario, RAMP)))
    assert [(m.expected, m.held, m.unit) for m in held] == [(c.expected, True, "") for c in judge(scenario, RAMP)]
    assert all(math.isnan(m.value) and math.isnan(m.share) for m in held)
    broken = Trace(MS, RAMP.mode, RAMP.faults, {**RAMP.signals, "x_dem": RAMP.signals["x_dem"] + 40.0})
    (m, *_) = margins(scenario, outcome_on(broken, judge(scenario, broken)))
    assert not m.held and math.isnan(m.value) and m.share == -1.0


def test_a_margin_has_its_verdict_s_sign_even_where_the_samples_say_otherwise() -> None:
    scenario = Scenario(title="made", duration=1.0, expect=[Expect(mode="RUN", by=0.5), Expect(mode="RUN", by=0.1)])
    words = [c.words for c in scenario.expect]
    checks = [Check(words[0], "", False), Check(words[1], "", True)]
    assert margins(scenario, outcome_on(RAMP, checks)) == [
        Margin(words[0], False, 0.0, "s", -1e-9), Margin(words[1], True, 0.0, "s", 0.0),
    ]  # fmt: skip


def test_what_was_not_judged_has_no_margin_and_the_others_keep_their_places() -> None:
    claims = [Expect(mode="RUN", at=0.2), Expect(mode="RUN", by=0.5)]
    scenario = Scenario(title="made", duration=1.0, expect=claims)
    checks = judge(scenario, RAMP)
    made = margins(scenario, outcome_on(RAMP, [Check(checks[0].expected, "", None), *checks[1:]]))
    assert (made[0].expected, made[0].value) == (claims[1].words, pytest.approx(0.3)) and len(made) == 4


def test_a_controller_that_failed_has_one_margin_the_least() -> None:
    scenario = Scenario(title="made", duration=1.0, expect=[Expect(mode="INIT", at=0.0)])
    (m,) = margins(scenario, failed("made", scenario, "it crashed"))
    assert m.expected == "the controller runs to the end" and not m.held and math.isnan(m.value) and m.share == -1.0
    assert isinstance(m, Margin) and m.unit == ""


# ---- any controller --------------------------------------------------------------------------------------------------

LIMITS = {"current": (20.0, "mA"), "stroke_min": (1.0, "mm"), "stroke_max": (40.0, "mm")}
TIMES = {"start": 0.3, "leave": 0.25, "fail_safe": 0.75, "sensor": 0.06, "recover": 0.5}


def table(**reactions: list[str]) -> Reactions:
    """A table with times that are all different."""
    return Reactions.model_validate({
        "limits": {k: {"value": v, "unit": u, "origin": "chosen"} for k, (v, u) in LIMITS.items()},
        "times": {k: {"value": v, "unit": "s", "origin": "chosen"} for k, v in TIMES.items()},
        "reactions": reactions,
    })  # fmt: skip


def of_any(*reactions: str, duration: float = 4.0, actions: list[Any] | None = None) -> list[dict[str, Any]]:
    """The claims of a scenario with two actions, from 1 to 2 s and from 1.5 to 3 s, without what has its default."""
    actions = actions if actions is not None else [
        inject.Drop(start=1.5, duration=1.5), inject.Drop(start=1.0, duration=1.0),
    ]  # fmt: skip
    own = Scenario(title="mine", duration=duration, inject=actions, expect=[Expect(mode="DEGRADED", at=0.1)])
    made = expected_of_any("mine", own, table(mine=list(reactions)))
    assert made.inject == own.inject and made.title == "mine"
    return [c.model_dump(exclude_defaults=True) for c in made.expect]


def test_each_reaction_is_a_claim_about_the_time_in_which_something_is_injected() -> None:
    assert of_any("ride") == [{"mode": "RUN", "during": [0.3, 4.0], "because": "ride: the controller goes on"}]
    assert of_any("leave") == [
        {"mode": "RUN", "during": [1.25, 3.0], "never": True, "because": "leave: RUN without what it needs"}
    ]
    assert of_any("fail_safe") == [
        {"mode": "FAIL_SAFE", "during": [1.75, 3.0], "because": "fail_safe: the cause lasts"}
    ]
    assert of_any("sensor") == [
        {"mode": "FAIL_SAFE", "after": 1.0, "by": 1.06, "because": "sensor: the stroke is not known"}
    ]
    assert of_any("standby") == [{"mode": "STANDBY", "during": [1.25, 3.0], "because": "standby: it is asked for"}]
    assert of_any("wait") == [{"mode": "RUN", "during": [0.0, 3.0], "never": True, "because": "wait: no demand yet"}]
    assert of_any("recover") == [{"mode": "RUN", "during": [3.5, 4.0], "because": "recover: the cause has gone"}]
    assert of_any("limits") == []
    finer = [inject.Drop(start=1.0004, duration=1.0)]
    assert [c["during"] for c in of_any("leave", "recover", actions=finer)] == [[1.25, 2.0], [2.5, 4.0]], "whole ticks"
    assert [c["by"] for c in of_any("sensor", actions=finer)] == [1.06]
    assert [c["because"][:4] for c in of_any("recover", "limits", "ride")] == ["reco", "ride"], "in the table's order"


def test_a_cause_without_an_end_lasts_to_the_end_of_the_scenario() -> None:
    for_good = [inject.Drop(start=1.0), inject.Drop(start=2.0, duration=0.5)]
    assert of_any("leave", "recover", actions=for_good) == [
        {"mode": "RUN", "during": [1.25, 4.0], "never": True, "because": "leave: RUN without what it needs"}
    ], "nothing is left in which to recover"


def test_a_claim_of_no_more_than_two_ticks_is_not_made() -> None:
    def made(end: float) -> int:
        return len(of_any("leave", actions=[inject.Drop(start=1.0, duration=end - 1.0)]))

    assert [made(1.2), made(1.25), made(1.251), made(1.253)] == [0, 0, 0, 1]
    assert [len(of_any("wait", actions=[inject.Drop(duration=s)])) for s in (0.002, 0.003)] == [0, 1]


def test_without_an_injection_the_cause_has_no_time_and_the_end_is_not_passed() -> None:
    assert of_any("sensor", actions=[])[0]["by"] == 0.06
    assert of_any("wait", "recover", actions=[]) == [
        {"mode": "RUN", "during": [0.5, 4.0], "because": "recover: the cause has gone"}
    ]
    (ride,) = of_any("ride", duration=0.4375, actions=[])
    assert ride["during"][0] == 0.3 and ride["during"][1] <= 0.4375


def test_a_scenario_of_which_the_table_says_nothing_is_refused() -> None:
    with pytest.raises(InputError, match=r"^reactions.other: the table of reactions says nothing of this scenario$"):
        expected_of_any("other", Scenario(title="other", duration=1.0), table(mine=["ride"]))


# ---- in a user's own tests -------------------------------------------------------------------------------------------


def test_the_fixture_runs_what_ships_a_file_beside_the_test_and_one_made_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What reaches `run`, with what, is noted here instead of run."""
    ran: list[tuple[Scenario, dict[str, Any]]] = []

    def run(scenario: Scenario, **keys: Any) -> Any:
        ran.append((scenario, keys))
        return SimpleNamespace(held=scenario.title != "bad one", text=lambda: "in words")

    monkeypatch.setattr(injection, "run", run)
    (tmp_path / "mine.toml").write_text('title = "mine"\nduration = 1.0\n')
    ours = sil.Sil(tmp_path)
    ours("nominal")
    ours("mine.toml", seed=7, duration=2.0)
    ours(tmp_path / "mine.toml")
    ours(Scenario(title="made", duration=1.0))
    ours.run(ours.Drop(start=0.5), duration=3.0, seed=9)
    assert [(s.title, s.duration, s.seed, keys) for s, keys in ran] == [
        (load_scenario("nominal").title, load_scenario("nominal").duration, 1, {"name": "nominal"}),
        ("mine", 2.0, 7, {"name": "mine"}),
        ("mine", 1.0, 1, {"name": "mine"}),
        ("made", 1.0, 1, {"name": "scenario"}),
        ("scenario of a test", 3.0, 9, {"name": "scenario"}),
    ]
    assert ran[-1][0].inject == [inject.Drop(start=0.5)] and ran[-1][0].expect == []
    claim = ours.Expect(mode="RUN", by=1.0)
    ours.run(duration=3.0, expect=[claim])
    assert ran[-1][0].expect == [claim] and ran[-1][0].inject == []
    with pytest.raises(pytest.fail.Exception, match="in words") as e:
        ours(Scenario(title="bad one", duration=1.0))
    assert not e.value.pytrace, "the claims, not the code of the fixture"
    with pytest.raises(AttributeError, match=r"^sil\.Dorp is not known; allowed: run, Expect, Scenario, Drop, Delay"):
        ours.Dorp  # noqa: B018
    with pytest.raises(InputError, match="no such file or shipped scenario"):
        ours("other.toml")
    assert ours.Scenario is Scenario and ours.BusOff is inject.BusOff


def test_the_fixture_has_two_options_and_gives_them_on() -> None:
    options: dict[str, str] = {}
    group = SimpleNamespace(addoption=lambda name, metavar, help: options.setdefault(name, metavar))
    sil.pytest_addoption(SimpleNamespace(getgroup=lambda *_: group))  # type: ignore[arg-type]
    assert options == {"--vaneloop-controller": "PATH.so", "--vaneloop-reactions": "F.toml"}


def test_a_controller_of_the_user_s_own_is_judged_by_the_table_of_reactions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert sil.Sil(tmp_path)._of_own_controller() == {}
    monkeypatch.setattr(native, "Program", lambda path: f"program of {path}")
    given = sil.Sil(tmp_path, "mine.so")._of_own_controller()
    assert given["calibration"].program == "program of mine.so"
    assert given["reactions"] == load_reactions()
    (tmp_path / "mine.toml").write_text(Path(str(injection.__file__)).with_name("any_controller.toml").read_text())
    given = sil.Sil(tmp_path, "mine.so", str(tmp_path / "mine.toml"))._of_own_controller()
    assert given["reactions"] == load_reactions()


# ---- lockstep --------------------------------------------------------------------------------------------------------


def lockstep(duration: float, *actions: Any, **keys: Any) -> Outcome:
    """A run of so many seconds without claims."""
    of_run = {k: keys.pop(k) for k in ("plant", "calibration", "reactions", "name", "progress") if k in keys}
    return inject.run(Scenario(title="made", duration=duration, inject=list(actions), **keys), **of_run)


def test_without_an_action_it_is_the_run_of_both_nodes_on_the_wire() -> None:
    """The compiled loop of `hil.bus.lockstep_bus` runs the same seeds and demands."""
    points = [[0.0, 70.0], [0.1, 70.0], [0.3, 78.0]]
    outcome = lockstep(0.4, demand=points, seed=5)
    n_dem = np.interp(np.arange(40) * 0.01, *np.array(points).T)
    vgv = run_lockstep(n_dem, seed=5).vgv
    assert outcome.state_hash == vgv.fingerprint()
    state, angles = vgv.loop.state, vgv.loop.s[places.POT : places.POT + 3, 0]
    last = {
        "x_dem": state.x_dem * 1e3, "x_lvdt": state.x_meas * 1e3, "i_cmd": state.i_cmd * 1e3, "n_dem": state.n_dem,
        "n_r": state.n_r_raw, **dict(zip(("vigv", "vgv1", "vgv2"), np.degrees(angles), strict=True)),
    }  # fmt: skip
    of = outcome.trace
    assert {k: v[-1] for k, v in of.signals.items()} == pytest.approx(last, rel=1e-12)
    assert outcome.counts == {
        **{k: vgv.counts[k] for k in ("good", "sync", "wrong_crc", "repeated", "wrong_sequence", "wrong_length")},
        "wrong_kind": 0, "lost": 0, "refused": 0, "unauthentic": 0,
    }  # fmt: skip
    assert (outcome.counts["good"], outcome.counts["sync"]) == (39, 1)
    assert np.array_equal(of.t, np.arange(400) * 1e-3) and (outcome.bus, outcome.simulated_s) == ("lockstep", 0.4)
    assert (outcome.name, outcome.title, outcome.notes, outcome.mode) == ("scenario", "made", [], "RUN")
    assert 0.0 < outcome.wall_s < time.perf_counter()
    cal = load_calibration().scalars
    assert of.stroke == (cal.stroke_min * 1e3, cal.stroke_max * 1e3) and of.current == cal.current_limit * 1e3
    assert of.exact and of.ours and {name: bool(v.any()) for name, v in of.late.items()} == {
        "VGV_STATUS": False, "VGV_SERVO": False, "VGV_ANGLES": False, "VGV_HEALTH": False,
    }  # fmt: skip


def test_another_seed_is_another_run_of_sensors_of_both_nodes() -> None:
    one, other = lockstep(0.1, seed=5), lockstep(0.1, seed=6)
    assert one.state_hash != other.state_hash
    assert np.abs(one.trace.signals["x_lvdt"] - other.trace.signals["x_lvdt"]).max() > 0.0
    assert np.abs(one.trace.signals["n_r"] - other.trace.signals["n_r"]).max() > 0.0


def rises(outcome: Outcome, name: str) -> list[int]:
    """Ticks at which a count rises, each as often as it does by one."""
    return np.repeat(np.arange(len(outcome.trace.t)), np.diff(outcome.trace.counts[name], prepend=0)).tolist()


def test_what_is_sent_in_a_tick_is_heard_in_the_next_and_counted_there() -> None:
    outcome = lockstep(
        0.4,
        inject.Corrupt(at=[20], start=0.2, count=2),
        inject.Corrupt(length=3, start=0.22, count=1),
        inject.Send(frame="ECU_DEMAND", data="00", start=0.255),
        inject.Send(frame="ECU_DEMAND", data="00" * 8, remote=True, start=0.265),
        inject.Send(frame="ECU_DEMAND", signals={"n_dem": 1.0}, counter=12, start=0.275),
    )
    assert rises(outcome, "wrong_crc") == [201, 211]
    assert rises(outcome, "wrong_length") == [221, 256]
    assert rises(outcome, "wrong_kind") == [266]
    assert rises(outcome, "repeated") == [276], "the counter is that of the ECU's frame of 0.27 s"
    assert rises(outcome, "lost") == [231] * 3
    assert rises(outcome, "refused") == [201, 211, 221, 256, 266, 276]
    assert outcome.counts["good"] == 39 - 3


def test_frames_of_the_controller_that_do_not_come_are_late_for_the_ecu_from_then_on() -> None:
    outcome = lockstep(0.8, inject.Drop(frame="VGV_STATUS", start=0.2), inject.Drop(frame="VGV_HEALTH"))
    late = {name: np.flatnonzero(v).tolist() for name, v in outcome.trace.late.items()}
    # the status of tick 190 is heard at 191: five periods later, at the ECU's next frame; of health none ever came
    assert late == {
        "VGV_STATUS": list(range(250, 800)), "VGV_SERVO": [], "VGV_ANGLES": [], "VGV_HEALTH": list(range(500, 800)),
    }  # fmt: skip


def test_chance_of_one_place_is_not_another_s() -> None:
    """What is dropped at random of the ECU's frames is the same whatever others send."""
    half = inject.Drop(probability=0.5, start=0.1)
    alone, beside = lockstep(0.4, half), lockstep(0.4, half, inject.Flood(rate=500.0), inject.Drop(frame="VGV_SERVO"))
    other = lockstep(0.4, half, seed=2)
    assert rises(alone, "good") == rises(beside, "good") != rises(other, "good")
    assert rises(alone, "good") == [
        k + 1 for k in range(10, 400, 10) if k < 100 or (k - 100) // 10 in kept_of(random.Random("1 0"), 30)
    ], "the seed, and the place"


def kept_of(chance: random.Random, n: int) -> list[int]:
    """Which of ``n`` frames a chance of one half spares."""
    return [i for i in range(n) if chance.random() >= 0.5]


def test_a_run_s_own_frames_come_again_and_are_refused_as_old() -> None:
    """The demands of 100 to 140 ms once more from 150 ms on, when the ECU is silent: their counters are 10 to 14."""
    again = inject.Replay(begin=0.1, length=0.05, start=0.15, frame="ECU_DEMAND", loop=False)
    outcome = lockstep(0.25, inject.Drop(start=0.15), again)
    assert rises(outcome, "good")[-1] == 141
    assert rises(outcome, "wrong_sequence") == [151, 161, 171, 181]
    assert rises(outcome, "repeated") == [191], "14 was the last that was good"


def test_progress_is_told_every_simulated_second() -> None:
    told: list[float] = []
    lockstep(2.5, progress=told.append)
    assert told == [0.0, 0.4, 0.8]


def test_with_reactions_limits_are_the_table_s_and_mode_changes_are_nobody_s() -> None:
    made = Scenario(title="made", duration=0.3, expect=[Expect(mode="RUN", by=0.2)])
    named = inject.run(made, reactions=table(mine=["ride", "limits"]), name="mine")
    assert [c.expected for c in named.checks] == ["always 1 <= x_dem <= 40 mm", "always -20 <= i_cmd <= 20 mA"]
    other = inject.run(made, reactions=table(mine=["ride"]), name="other")
    assert [c.expected for c in other.checks][0] == "RUN by 0.200 s" and len(other.checks) == 3
    assert len(inject.run(made, name="mine").checks) == 4


def test_a_scenario_is_called_by_its_file_unless_a_name_is_given(tmp_path: Path) -> None:
    file = tmp_path / "short.toml"
    file.write_text('title = "short"\nduration = 0.02\n')
    assert [inject.run(file).name, inject.run(str(file)).name, inject.run(file, name="mine").name] == [
        "short", "short", "mine",
    ]  # fmt: skip


def test_a_controller_of_the_user_s_own_runs_apart_and_its_failure_is_an_outcome(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[Any] = []

    def fails(task: Any, save_crash: str | None) -> Any:
        given.append(save_crash)
        raise injection.ControllerFailed("it crashed")

    monkeypatch.setattr(injection, "isolated", fails)
    scenario = Scenario(title="made", duration=0.02)
    own = load_calibration()._replace(program="mine.so")
    outcome = inject.run(scenario, calibration=own, save_crash="crash.log", name="mine")
    assert outcome.checks == [Check("the controller runs to the end", "it crashed", False)] and given == ["crash.log"]
    assert outcome.name == "mine"
    assert inject.run(scenario, calibration=load_calibration()).held and len(given) == 1, "the firmware here runs here"


def test_a_machine_with_more_stages_sends_more_and_claims_of_stages_it_lacks_are_refused(tmp_path: Path) -> None:
    plant, calibration = machine(tmp_path, 5)
    late = inject.Drop(frame="VGV_ANGLES_2", start=0.2)
    scenario = Scenario(
        title="made", duration=0.4, inject=[late], expect=[
            Expect(late="VGV_ANGLES_2", at=0.25), Expect(signal="vgv4", low=-90, by=0.1),
        ],
    )  # fmt: skip
    outcome = inject.run(scenario, plant=plant, calibration=calibration)
    assert outcome.held, outcome.text()
    assert list(outcome.trace.late) == ["VGV_STATUS", "VGV_SERVO", "VGV_ANGLES", "VGV_HEALTH", "VGV_ANGLES_2"]
    for claim, said in (
        (Expect(late="VGV_ANGLES_3", by=0.1), "VGV_ANGLES_3"),
        (Expect(signal="vgv5", low=0, by=0.1), "vgv5"),
    ):
        with pytest.raises(
            InputError, match=f"^mine: expect {said}: this machine has the vane rows vigv, vgv1, vgv2, vgv3"
        ):
            inject.run(Scenario(title="made", duration=0.4, expect=[claim]), plant=plant, name="mine")
    with pytest.raises(InputError, match="expect VGV_ANGLES_2: this machine has the vane rows vigv, vgv1, vgv2$"):
        inject.run(scenario)


def test_what_is_done_to_an_actuator_that_the_machine_lacks_is_refused() -> None:
    def lacks(kind: str, **keys: Any) -> str:
        of = Scenario(title="made", duration=1.0, inject=[inject.Drop(), inject.Machine(**keys)])
        return injection.lacks(of, build_plant({"hydraulic": "plant.toml"}.get(kind, f"plant_{kind}.toml")))

    assert lacks("hydraulic", p_s=1.0) == lacks("electromechanical", t_oil=1.0) == ""
    assert lacks("electromechanical", p_s=1.0) == "machine: p_s: the electromechanical actuator takes no oil"
    assert lacks("hydraulic", effect="valve_lag") == lacks("electromechanical", effect="amplifier_lag") == ""
    assert lacks("hydraulic", effect="amplifier_lag") == (
        "machine: effect amplifier_lag is of an actuator of kind electromechanical; this machine's is hydraulic"
    )
    motor = Scenario(title="made", duration=1.0, inject=[inject.Machine(effect="amplifier_lag")])
    with pytest.raises(
        InputError, match="^scenario: machine: effect amplifier_lag is of an actuator of kind electromech"
    ):
        inject.run(motor, plant=build_plant())


def test_supply_and_effects_change_from_the_first_tick_on_until_the_end_and_are_put_back() -> None:
    node, ecu = Node(), Ecu()
    ((bias, _),) = node.plant.parameters_of("lvdt_bias").items()
    action = inject.Machine(
        p_s=5.0, t_oil=80.0, effect="lvdt_bias", parameters={"bias": 2.0}, start=0.003, duration=0.004
    )
    change = on_lockstep.MachineChange(action, node, ecu)
    assert (change.first, change.end) == (3, 7)
    seen = []
    for k in range(9):
        change.tick(k)
        seen.append((*node.arrays.supply[:2].tolist(), float(node.loop.p[bias, 0]), float(ecu.arrays.p[bias, 0])))
    before, during = (21e6, 40.0, 0.0, 0.0), (5e6, 80.0, 0.002, 0.002)
    assert seen == [before] * 3 + [during] * 4 + [before] * 2


@pytest.mark.parametrize(("keys", "supply"), [({"p_s": 0.0}, (0.0, 40.0)), ({"t_oil": -20.0}, (21e6, -20.0))])
def test_what_a_machine_action_does_not_name_stays(keys: dict[str, float], supply: tuple[float, float]) -> None:
    node, ecu = Node(), Ecu()
    p = node.loop.p.copy()
    change = on_lockstep.MachineChange(inject.Machine(**keys), node, ecu)
    change.tick(0)
    change.tick(1)
    assert tuple(node.arrays.supply[:2]) == supply and np.array_equal(node.loop.p, p)


def test_an_effect_of_a_stage_that_the_machine_lacks_is_refused() -> None:
    action = inject.Machine(effect="pot_bias", parameters={"vgv7": 1.0})
    with pytest.raises(
        InputError, match=r"^parameters\.vgv7 of pot_bias: this machine has the vane rows vigv, vgv1, vgv2$"
    ):
        on_lockstep.MachineChange(action, Node(), Ecu())


def wire_of_two(now: int = 0, free: int = 0) -> Any:
    """A wire at bit ``now`` that is free since bit ``free``."""
    bus = wire.new_wire(2)
    bus.clock[[wire.NOW, wire.FREE]] = now, free
    return bus


def disturbed(ticks: int, *actions: Any) -> list[tuple[float, np.ndarray]]:
    """The chance of an error and the nodes' state at each tick: two nodes, of which the second has 3 frames waiting."""
    bus = wire_of_two()
    bus.node[1, wire.TX_N] = 3
    disturber = on_lockstep.Disturber(actions, bus, {"ECU": 0, "VGV": 1})
    out = []
    for k in range(ticks):
        disturber.tick(k)
        out.append((float(bus.chance[0]), bus.node.copy()))
    return out


def test_error_frames_have_their_chance_while_they_last_and_two_add_up_as_chances_do() -> None:
    chances = [c for c, _ in disturbed(
        8, inject.ErrorFrames(probability=0.5, start=0.001, duration=0.004),
        inject.ErrorFrames(probability=0.2, start=0.003, duration=0.004),
    )]  # fmt: skip
    assert chances == pytest.approx([0.0, 0.5, 0.5, 0.6, 0.6, 0.2, 0.2, 0.0])
    assert [c for c, _ in disturbed(2, inject.ErrorFrames())] == [1.0, 1.0], "every frame, if nothing else is said"
    assert [c for c, _ in disturbed(2, inject.BusOff())] == [0.0, 0.0]


def test_a_node_in_bus_off_loses_its_queue_and_recovers_when_the_standard_allows() -> None:
    (_, (ecu, vgv)), (_, (_, later)) = disturbed(2, inject.BusOff(node="VGV"))
    assert not ecu.any(), "the other node is left alone"
    assert {q: int(vgv[getattr(wire, q)]) for q in ("TEC", "MODE", "TO_RECOVER", "TX_N", "REFUSED", "BUS_OFFS")} == {
        "TEC": 256, "MODE": wire.BUS_OFF, "TO_RECOVER": 128, "TX_N": 0, "REFUSED": 3, "BUS_OFFS": 1,
    }  # fmt: skip
    assert np.array_equal(vgv, later), "the wire counts down from there"


def test_a_bus_off_with_a_duration_recovers_after_it_and_not_before() -> None:
    states = [n[1] for _, n in disturbed(6, inject.BusOff(node="VGV", start=0.001, duration=0.003))]
    assert [int(s[wire.MODE]) == wire.BUS_OFF for s in states] == [False, True, True, True, True, True]
    assert [int(s[wire.TO_RECOVER]) for s in states] == [0, 1 << 40, 1 << 40, 1 << 40, 128, 128]
    assert [int(s[wire.BUS_OFFS]) for s in states] == [0, 1, 1, 1, 1, 1]


@pytest.mark.parametrize(
    ("now", "free", "times"), [(1000, 1000, 128), (1000, 989, 129), (1000, 988, 130), (1000, 1200, 128)]
)
def test_what_the_wire_was_free_before_does_not_count_for_the_recovery(now: int, free: int, times: int) -> None:
    """The wire counts 11 recessive bits from where it became free."""
    for k, action in ((0, inject.BusOff()), (5, inject.BusOff(duration=0.005))):
        bus = wire_of_two(now, free)
        disturber = on_lockstep.Disturber([action], bus, {"ECU": 0, "VGV": 1})
        disturber.tick(0)
        disturber.tick(k)
        assert bus.node[0, wire.TO_RECOVER] == times


def test_a_disturber_is_over_with_the_last_of_its_actions() -> None:
    def end(*actions: Any) -> float:
        return on_lockstep.Disturber(actions, wire_of_two(), {"ECU": 0, "VGV": 1}).end

    assert end() == end(inject.Drop(start=5.0, duration=1.0)) == 0.0
    assert end(inject.ErrorFrames(duration=0.5), inject.BusOff(start=1.0, duration=0.25)) == 1250
    assert end(inject.ErrorFrames(duration=0.5), inject.BusOff()) == math.inf


def test_a_node_back_from_bus_off_is_heard_again() -> None:
    """The controller is alone meanwhile: nobody acknowledges its frames, which it repeats with one pause of 11 bits or
    little more between them. 128 of these take some 40 ms.
    """
    off = lockstep(0.4, inject.BusOff(start=0.2, duration=0.06))
    assert [k for k in rises(off, "good") if 185 < k < 325] == [191, 311, 321]
    assert rises(off, "sync") == [1, 301], "the first frame after a silence shows where the counter is"
    at_once = lockstep(0.3, inject.BusOff(start=0.2))
    assert [k for k in rises(at_once, "good") if 185 < k < 255] == [191, 241, 251] and rises(at_once, "lost") == [
        241
    ] * 4


def test_whose_frames_an_action_works_on_is_told_by_their_name() -> None:
    assert on_lockstep.sender_of(inject.Drop()) == "ECU"
    assert {on_lockstep.sender_of(inject.Drop(frame=f)) for f in ("VGV_STATUS", 0xB5, "0xB3")} == {"VGV"}


# ---- one station among others ----------------------------------------------------------------------------------------


class Live:
    """A bus in made-up time on which a controller sends status, current and angles every 10 ms: in STANDBY until 30 ms,
    then in RUN; x_dem is 20 mm and 1 mm more after 100 ms of RUN.

    until       s: the controller is silent after that
    run         whether it comes to RUN
    writes      (s, frame) of what was sent to it
    """

    refused = lost = 0

    def __init__(self, until: float = 99.0, run: bool = True, servo: bool = True, damaged: tuple[int, ...] = ()):
        self.now, self.begun, self.k = 100.0, 100.0, 0
        self.until, self.run, self.servo, self.damaged = until, run, servo, damaged
        self.writes: list[tuple[float, Row]] = []
        self.closed = False

    def perf_counter(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def shutdown(self) -> None:
        self.closed = True

    def read(self, rows: np.ndarray) -> int:
        n = 0
        while self.k * 0.01 <= self.now - self.begun + 1e-9 and self.k * 0.01 < self.until:
            k, self.k = self.k, self.k + 1
            state = 2 if self.run and k >= 3 else 1
            counter = k % 15
            x_dem = 20.0 + (k >= 13)
            raw = [round((x + 8.0) / 0.001).to_bytes(2, "little") for x in (x_dem, 19.5)]
            frames = [(STATUS, protected(STATUS, counter, b"".join(raw) + b"\0\0", state))]
            if self.servo:
                servo = round(1.5 / 0.002).to_bytes(2, "little") + bytes([0b100, 0, 0, 0])
                frames.append((SERVO, protected(SERVO, counter, servo)))
            angles = b"".join(round(a / 0.002).to_bytes(2, "little", signed=True) for a in (3.0, -2.0))
            frames.append((ANGLES, protected(ANGLES, counter, angles + b"\x00\x80")))
            for ident, data in frames:
                rows[n] = row(ident, data)
                n += 1
            if k in self.damaged:
                rows[n - len(frames), 1] ^= 1
        return n

    def write(self, rows: np.ndarray) -> None:
        assert rows.shape[1:] == (2,)
        self.writes += [(self.now - self.begun, (int(h), int(d))) for h, d in rows]


def on_bus(live: Live, monkeypatch: pytest.MonkeyPatch, *actions: Any, duration: float = 0.5, **keys: Any) -> Outcome:
    """Play a scenario on it."""
    monkeypatch.setattr(injection, "open_bus", lambda name: live)
    monkeypatch.setattr(injection, "Port", lambda opened: opened)
    monkeypatch.setattr(injection, "time", live)
    scenario = Scenario(title="made", duration=duration, inject=list(actions), expect=keys.pop("expect", []))
    return inject.run(scenario, bus="vcan9", **keys)


def test_on_a_live_bus_time_begins_with_run_and_the_frames_are_the_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    live, told = Live(), list[float]()
    outcome = on_bus(live, monkeypatch, progress=told.append)
    of = outcome.trace
    # a receiver knows the counter with the first frame and takes the second: samples from 10 ms on, RUN from 30 ms
    assert of.t == pytest.approx(np.arange(51) * 0.01, abs=0.0011) and of.t[0] == 0.0
    assert set(of.mode.tolist()) == {MODES.index("RUN")} and set(of.faults.tolist()) == {4}
    assert outcome.modes == [(0.0, "RUN")] and outcome.faults == [(0.0, "lvdt_range")]
    assert list(of.signals) == ["x_dem", "x_lvdt", "i_cmd", "vigv", "vgv1"], "what is nowhere told is left out"
    assert of.signals["x_dem"].tolist() == pytest.approx([20.0] * 10 + [21.0] * 41)
    assert {n: v[0] for n, v in of.signals.items()} == pytest.approx(
        {"x_dem": 20.0, "x_lvdt": 19.5, "i_cmd": 1.5, "vigv": 3.0, "vgv1": -2.0}
    )
    cal = load_calibration().scalars
    assert of.stroke == (cal.stroke_min * 1e3, cal.stroke_max * 1e3) and of.current == cal.current_limit * 1e3
    assert not of.exact and live.closed and outcome.held and len(outcome.checks) == 2
    assert (outcome.bus, outcome.simulated_s, outcome.state_hash, outcome.notes) == ("vcan9", 0.5, None, [])
    assert outcome.wall_s == pytest.approx(0.53, abs=0.002)
    assert told == sorted(told) and told[-1] == pytest.approx(1.0, abs=0.003) and 0.0 < told[0] < 0.01


def test_on_a_live_bus_an_outsider_sends_at_its_ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    live = Live()
    send = inject.Send(frame=0x10, data="01", start=0.1, period=0.02, duration=0.05)
    on_bus(live, monkeypatch, send, inject.Send(frame=0x11, data="02", start=0.2), duration=0.3)
    begin = 0.03
    assert [frame for _, frame in live.writes] == [row(0x10, b"\1")] * 3 + [row(0x11, b"\2")]
    assert [t - begin for t, _ in live.writes] == pytest.approx([0.1, 0.12, 0.14, 0.2], abs=0.0011)
    assert min(t - begin - at for (t, _), at in zip(live.writes, (0.1, 0.12, 0.14, 0.2), strict=True)) > -1e-9


def test_on_a_live_bus_what_was_heard_since_the_begin_comes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    live = Live()
    again = inject.Replay(begin=0.095, length=0.02, start=0.2, frame="VGV_STATUS", loop=False)
    on_bus(live, monkeypatch, again, duration=0.3)
    numbers = [frame[1] >> 8 & 15 for _, frame in live.writes]
    assert numbers == [13, 14], "those of 100 and 110 ms after RUN was heard with the frame of 30 ms"
    assert [t - 0.03 for t, _ in live.writes] == pytest.approx([0.205, 0.215], abs=0.0021)


def test_on_a_live_bus_chance_is_the_action_s_own(monkeypatch: pytest.MonkeyPatch) -> None:
    live = Live()
    on_bus(live, monkeypatch, inject.Send(frame=0x10, data="01"), inject.Flood(rate=100.0), duration=0.1)
    chance = random.Random("1 1")
    flood = [(chance.randint(0x7FF, 0x7FF), chance.getrandbits(64)) for _ in range(10)]
    assert live.writes[0][1] == row(0x10, b"\1"), "at tick 0"
    floods = [frame for _, frame in live.writes if frame[0] & 0x7FF == 0x7FF]
    assert [d & (1 << 64) - 1 for _, d in floods] == [d for _, d in flood]


def test_what_the_bus_did_not_take_or_we_did_not_read_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    live = Live()
    live.refused, live.lost = 3, 4
    assert on_bus(live, monkeypatch).notes == [
        "3 frames were not taken by the bus", "4 frames came faster than they could be read",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("live", "heard"),
    [(Live(until=0.0), "none was heard"), (Live(run=False), "it is in STANDBY"), (Live(servo=False), "none was heard")],
    ids=["silence", "standby", "no current"],
)
def test_without_a_controller_in_run_within_5_s_there_is_no_run(
    live: Live, heard: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError) as e:
        on_bus(live, monkeypatch)
    assert str(e.value) == (
        f"vcan9: no controller in RUN within 5 s ({heard}); start vaneloop run --bus vcan9 and vaneloop ecu --bus vcan9"
    )
    assert live.closed and live.now - live.begun == pytest.approx(5.0, abs=0.002)


def test_frames_that_are_damaged_are_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The status of 130 ms, the first with 21 mm, has a wrong CRC: 20 mm stand until the next."""
    outcome = on_bus(Live(damaged=(13,)), monkeypatch)
    assert outcome.trace.signals["x_dem"].tolist() == pytest.approx([20.0] * 11 + [21.0] * 40)


def test_a_controller_that_is_not_heard_again_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    live = Live(until=0.035)
    with pytest.raises(InputError, match=r"^vcan9: the controller was not heard again after 0\.0 s$"):
        on_bus(live, monkeypatch)
    assert live.closed


def test_what_no_outsider_can_do_is_refused_before_the_bus_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    live = Live()
    with pytest.raises(InputError) as e:
        on_bus(live, monkeypatch, inject.Machine(t_oil=1.0), inject.Drop(), inject.Babble(), inject.Drop())
    assert str(e.value) == "scenario on vcan9: drop, machine: no other station on a bus can do that; --bus lockstep can"
    assert not live.closed
    outsiders = [inject.Send(frame=1, data=""), inject.Flood(), inject.Babble(), inject.Replay(log="a.log")]
    assert injection.cannot(Scenario(title="made", duration=1.0, inject=outsiders)) == ""
