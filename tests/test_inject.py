"""Frame and fault injection: the actions do what they say, the verdict is not fooled, the shipped scenarios hold, and a
user can use it.
"""

from __future__ import annotations

import json
import math
import os
import random
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from controller import MODES, load_calibration
from hil import inject
from hil.bus import frames
from hil.bus.frames import ECU_DEMAND, VERDICTS, new_receiver, receive
from hil.inject import Expect, Outcome, Scenario, Trace, judge
from hil.inject.actions import OnFrame
from hil.inject.scenario import library, load_scenario
from hil.inject.tamper import Gateway, Intruder
from hil.logs.candump import write_candump
from hil.logs.frames import Frames
from tests.conftest import ROOT
from vaneloop.base.errors import InputError
from vaneloop.cli.main import main

# ---- the shipped scenarios -------------------------------------------------------------------------------------------


def test_at_least_25_scenarios_ship_and_use_every_action() -> None:
    made = [load_scenario(name) for name in library() | library(2)]
    assert len(library()) >= 25
    used = {type(a) for s in made for a in s.inject}
    assert set(inject.ACTIONS.values()) - used == set()
    for scenario in made:
        assert scenario.why, f"{scenario.title}: where do its figures come from?"
        assert scenario.expect, f"{scenario.title}: nothing is expected"


def test_the_page_names_every_action_with_its_keys() -> None:
    page = (ROOT / "docs" / "injection.md").read_text(encoding="utf-8")
    rows: dict[str, str] = {}
    name = ""
    for line in page.splitlines():  # a row may go on in the next, which then has no name
        if line.startswith("| `"):
            name = line.split("`")[1]
        if line.startswith(("| `", "| |")):
            rows[name] = rows.get(name, "") + line
    for name, action in inject.ACTIONS.items():
        common = {"action", "start", "duration", "every", "probability", "count"} | (
            {"frame"} if issubclass(action, OnFrame) else set()
        )
        for key in set(action.model_fields) - (common if name != "error_frames" else common - {"probability"}):
            assert f"`{key}`" in rows[name], f"docs/injection.md: {name} takes {key}"


@pytest.mark.parametrize("name", library())
def test_the_controller_reacts_as_the_scenario_says(name: str) -> None:
    outcome = inject.run(name)
    assert outcome.held, outcome.text()


def test_the_same_scenario_gives_the_same_run_bit_for_bit() -> None:
    first, again, other = (
        inject.run(load_scenario("random_traffic").model_copy(update={"seed": seed})) for seed in (1, 1, 2)
    )
    assert first.state_hash == again.state_hash
    assert first.state_hash != other.state_hash
    assert all(np.array_equal(first.trace.signals[k], again.trace.signals[k]) for k in first.trace.signals)


def test_a_controller_that_reacts_too_late_is_found_out() -> None:
    slow = load_calibration()
    slow.scalars.demand_timeout = 0.1
    outcome = inject.run("demand_stops", calibration=slow)
    assert not outcome.held
    broken = [c for c in outcome.checks if c.held is False]
    assert any(c.expected.startswith("DEGRADED") and "2.091" in c.seen for c in broken), outcome.text()


# ---- the verdict -----------------------------------------------------------------------------------------------------


def trace(modes: list[str], step: float = 0.1, x_dem: list[float] | None = None) -> Trace:
    """A trace with a mode each ``step`` s."""
    n = len(modes)
    signals = {"x_dem": np.array(x_dem or [20.0] * n), "i_cmd": np.zeros(n)}
    return Trace(
        np.arange(n) * step,
        np.array([MODES.index(m) for m in modes]),
        np.zeros(n, np.int64),
        signals,
        stroke=(0.5, 47.5),
    )


RUN_THEN_DEGRADED = ["INIT", "STANDBY", "RUN", "RUN", "RUN", "DEGRADED", "DEGRADED", "RUN", "RUN", "RUN"]


@pytest.mark.parametrize(
    ("claim", "held"),
    [
        (Expect(mode="DEGRADED", at=0.5), True),
        (Expect(mode="DEGRADED", at=0.6), False),  # it is DEGRADED then, but did not become it
        (Expect(mode="DEGRADED", at=0.42, tolerance=0.1), True),
        (Expect(mode="RUN", at=0.7), True),  # the second time
        (Expect(mode="FAIL_SAFE", at=0.5), False),
        (Expect(mode="DEGRADED", by=0.5), True),
        (Expect(mode="DEGRADED", by=0.4), False),
        (Expect(mode="RUN", by=0.9, after=0.65), True),
        (Expect(mode="DEGRADED", by=0.9, after=0.65), False),
        (Expect(mode="RUN", during=[0.2, 0.4]), True),
        (Expect(mode="RUN", during=[0.2, 0.5]), False),
        (Expect(mode="FAIL_SAFE", never=True), True),
        (Expect(mode="DEGRADED", never=True), False),
        (Expect(mode="DEGRADED", never=True, during=[0.6, 0.9]), False),
        (Expect(mode="DEGRADED", never=True, during=[0.7, 0.9]), True),
        (Expect(signal="x_dem", low=19.0, high=21.0, during=[0.0, 0.9]), True),
        (Expect(signal="x_dem", low=20.5, during=[0.0, 0.9]), False),
        (Expect(fault="any", never=True), True),
        (Expect(fault="demand_stale", by=0.9), False),
        (Expect(mode="RUN", during=[5.0, 6.0]), False),  # nothing was seen then: not held
        (Expect(count="lost", high=0, during=[0.0, 0.9]), None),  # not shown here: neither held nor broken
    ],
)
def test_a_claim_holds_exactly_where_it_is_true(claim: Expect, held: bool | None) -> None:
    made = Scenario(title="test", duration=10.0, expect=[claim])
    assert judge(made, trace(RUN_THEN_DEGRADED))[0].held is held


def test_unsafe_outputs_and_undocumented_mode_changes_are_always_broken() -> None:
    made = Scenario(title="test", duration=1.0)
    assert all(c.held for c in judge(made, trace(["INIT", "STANDBY", "RUN"])))
    assert [c.held for c in judge(made, trace(["INIT", "RUN", "RUN"]))] == [True, True, False]
    assert [c.held for c in judge(made, trace(["RUN"] * 3, x_dem=[20.0, 47.6, 20.0]))] == [False, True, True]
    assert [c.held for c in judge(made, trace(["RUN"] * 3, x_dem=[20.0, math.nan, 20.0]))] == [False, True, True]


# ---- frames on their way ---------------------------------------------------------------------------------------------


def demand(k: int, n_dem: float = 80.0) -> tuple[int, int]:
    """ECU_DEMAND of tick ``k``, its counter by tick."""
    return frames.word0(ECU_DEMAND), int(frames.encode_demand(n_dem + k * 1e-3, 80.0, 1, k // 10 % 15))


def through(action: inject.Scenario | object, ticks: int = 200) -> list[tuple[int, int]]:
    """Tick and index of each frame that leaves a gateway into which one goes every 10 ticks."""
    gateway = Gateway([action], random.Random(1))
    index = {demand(k): k // 10 for k in range(0, ticks, 10)}
    out = []
    for k in range(ticks):
        sent = [demand(k)] if k % 10 == 0 else []
        out += [(k, index[frame]) for frame in gateway.feed(k, sent)]
    return out


def test_dropped_frames_are_gone_and_the_others_untouched() -> None:
    assert through(inject.Drop(start=0.05, duration=0.03)) == [(10 * i, i) for i in range(20) if i not in (5, 6, 7)]
    assert through(inject.Drop(start=0.05, count=2)) == [(10 * i, i) for i in range(20) if i not in (5, 6)]
    assert [i for _, i in through(inject.Drop(every=5))] == [i for i in range(20) if i % 5]


def test_delayed_frames_come_later_once() -> None:
    assert through(inject.Delay(delay=0.025, start=0.05, duration=0.02)) == sorted(
        [(10 * i, i) for i in range(20) if i not in (5, 6)] + [(75, 5), (85, 6)]
    )


def test_duplicates_follow_their_frame() -> None:
    assert through(inject.Duplicate(copies=2, start=0.05, duration=0.01))[4:9] == [
        (40, 4),
        (50, 5),
        (50, 5),
        (50, 5),
        (60, 6),
    ]


def test_reordered_frames_come_backwards_and_none_is_lost() -> None:
    assert [i for _, i in through(inject.Reorder(window=3, start=0.03, duration=0.06))] == [
        0,
        1,
        2,
        5,
        4,
        3,
        8,
        7,
        6,
        *range(9, 20),
    ]
    left = through(inject.Reorder(window=3, start=0.03, duration=0.04))
    assert [i for _, i in left] == [0, 1, 2, 5, 4, 3, 6, *range(7, 20)], (
        "a group that was not complete goes on when it is over"
    )


def verdicts(action: object, ticks: int = 400) -> list[str]:
    """What the receiver says of frames that went through a gateway."""
    gateway, receiver, out = Gateway([action], random.Random(1)), new_receiver(ECU_DEMAND), []
    for k in range(0, ticks, 10):
        for head, data in gateway.feed(k, [demand(k)]):
            out.append((VERDICTS[receive(receiver, head, data, k)], data))
    return [v for v, _ in out]


def test_corrupted_frames_are_refused_for_the_right_reason() -> None:
    assert verdicts(inject.Corrupt(start=0.1, duration=0.03))[9:14] == [
        "good",
        "wrong_crc",
        "wrong_crc",
        "wrong_crc",
        "good",
    ]
    assert verdicts(inject.Corrupt(length=3, start=0.1, duration=0.01))[9:12] == ["good", "wrong_length", "good"]


def test_a_frozen_signal_keeps_its_value_under_a_right_crc() -> None:
    assert set(verdicts(inject.Freeze(signal="n_dem", start=0.1))[1:]) == {"good"}
    gateway = Gateway([inject.Freeze(signal="n_dem", start=0.1, duration=0.1)], random.Random(1))
    seen = [frames.decode(*frame)["n_dem"] for k in range(0, 300, 10) for frame in gateway.feed(k, [demand(k)])]
    assert seen[10:20] == [seen[10]] * 10
    assert seen[9] != seen[10] != seen[20]


def test_an_overridden_signal_is_believed_or_refused_as_its_crc_says() -> None:
    assert set(verdicts(inject.Override(signals={"n_dem": 12.0}))[1:]) == {"good"}
    assert set(verdicts(inject.Override(signals={"n_dem": 12.0}, e2e="keep"))) == {"wrong_crc"}


def test_probability_takes_its_share() -> None:
    assert 0.25 < len(through(inject.Drop(probability=0.7), ticks=10_000)) / 1000 < 0.35


def sent_by(action: object, ticks: int) -> list[tuple[int, int, int]]:
    """Tick and words of what an outsider sends."""
    intruder = Intruder(action, random.Random(1), [])
    return [(k, *frame) for k in range(ticks) for frame in intruder.tick(k, 0)]


@pytest.mark.parametrize(
    ("e2e", "verdict"), [("right", "good"), ("wrong_crc", "wrong_crc"), ("wrong_counter", "repeated")]
)
def test_a_sent_frame_is_protected_as_asked(e2e: str, verdict: str) -> None:
    sent = sent_by(inject.Send(frame="ECU_DEMAND", signals={"n_dem": 70.0, "n_r": 71.0}, period=0.01, e2e=e2e), 100)
    assert [k for k, _, _ in sent] == list(range(0, 100, 10))
    receiver = new_receiver(ECU_DEMAND)
    assert VERDICTS[[receive(receiver, head, data, k) for k, head, data in sent][-1]] == verdict
    if verdict == "good":
        assert frames.decode(sent[-1][1], sent[-1][2])["n_dem"] == pytest.approx(70.0, abs=1e-3)


def test_a_raw_frame_is_sent_once_and_as_it_stands() -> None:
    ((k, head, data),) = sent_by(inject.Send(frame=0x123, data="0102FF", start=0.05), 200)
    message = frames.to_message(head, data)
    assert (k, message.arbitration_id, bytes(message.data), message.is_extended_id) == (
        50,
        0x123,
        b"\x01\x02\xff",
        False,
    )
    ((_, head, data),) = sent_by(inject.Send(frame=0x123, data="00", remote=True, extended=True), 10)
    message = frames.to_message(head, data)
    assert message.is_remote_frame and message.is_extended_id and message.dlc == 1


def test_a_flood_has_the_rate_asked_for() -> None:
    assert len(sent_by(inject.Flood(frame=0x100, rate=2500.0, duration=1.0), 2000)) == 2500
    assert {
        h & frames.IDENT_MASK for _, h, _ in sent_by(inject.Flood(frame=0x100, last=0x103, rate=1000.0), 500)
    } == set(range(0x100, 0x104))
    assert {h & frames.IDENT_MASK for _, h, _ in sent_by(inject.Babble(), 10)} == {0}


def test_old_frames_of_a_log_come_again_with_their_spacing(tmp_path: Path) -> None:
    """A recorded run's demand, sent again by a third station beside the live ECU."""
    t = np.arange(50) * 0.01
    data = np.array([[*int(demand(10 * i)[1] & (2**64 - 1)).to_bytes(8, "little")] for i in range(50)], np.uint8)
    log = Frames(t, np.full(50, ECU_DEMAND, np.uint32), np.zeros(50, np.int32), np.full(50, 8, np.uint8), data)
    write_candump(tmp_path / "old.log", log)
    again = sent_by(inject.Replay(log=str(tmp_path / "old.log"), loop=False), 2000)
    assert [(k, h, d) for k, h, d in again] == [(10 * i, *demand(10 * i)) for i in range(50)]
    scenario = tmp_path / "again.toml"
    scenario.write_text(
        'title = "an old log beside the live ECU"\nduration = 3.0\n'
        '[[inject]]\naction = "replay"\nlog = "old.log"\nstart = 2.005\nduration = 0.5\n'
        '[[expect]]\nmode = "DEGRADED"\nby = 2.2\nafter = 2.0\n'
    )
    outcome = inject.run(scenario)  # the log is found beside the scenario
    assert outcome.held, outcome.text()


# ---- what a user types -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[[inject]]\naction = "dorp"', "inject.0.action (='dorp'): must be one of 'drop', 'delay'"),
        ('[[inject]]\naction = "drop"\nstrt = 1.0', "key 'inject.0.drop.strt' is unknown, probably 'start' is meant"),
        ('[[inject]]\naction = "delay"', "key 'inject.0.delay.delay' is missing"),
        ("[[inject]]\nstart = 1.0", "inject.0: key 'action' is missing"),
        (
            '[[inject]]\naction = "drop"\nprobability = 2.0',
            "inject.0.drop.probability (=2.0): Input should be less than or equal to 1",
        ),
        ('[[inject]]\naction = "drop"\nstart = "1"', "inject.0.drop.start (='1')"),
        ('[[inject]]\naction = "drop"\nframe = "VGV_X"', "frame (='VGV_X') must be one of ECU_DEMAND, VGV_STATUS"),
        ('[[inject]]\naction = "drop"\nframe = 0x123', "frame (=291) is sent by neither node"),
        ('[[inject]]\naction = "drop"\nstart = 5.0', "inject.0.start (=5 s) must be before the end (duration = 3 s)"),
        (
            '[[inject]]\naction = "override"\nsignals = { n_dem = 200.0 }',
            "n_dem (=200) does not fit its bits in ECU_DEMAND; allowed: 0 to 131.07 %",
        ),
        (
            '[[inject]]\naction = "freeze"\nsignal = "n_dm"',
            "signal (='n_dm') is not in ECU_DEMAND; allowed: crc, counter, mode_request, n_dem, n_r",
        ),
        ('[[inject]]\naction = "send"\nframe = 0x10\ndata = "zz"', "data (='zz') must be bytes in hex"),
        ('[[inject]]\naction = "send"\nframe = 0x10\ndata = "00"\ne2e = "right"', "needs a frame with a DataID"),
        ('[[inject]]\naction = "replay"\nlog = "missing.log"', "missing.log: cannot be read"),
        ('[[inject]]\naction = "machine"\neffect = "lvdt_bas"', "effect (='lvdt_bas') must be one of"),
        (
            '[[inject]]\naction = "machine"\neffect = "lvdt_bias"\nparameters = { bias = 50.0 }',
            "parameters.bias (=50 mm) must be in [-5, 5]",
        ),
        (
            '[[expect]]\nmode = "RUNNING"\nby = 1.0',
            "mode (='RUNNING') must be one of INIT, STANDBY, RUN, DEGRADED, FAIL_SAFE",
        ),
        ('[[expect]]\nmode = "RUN"\nby = 1.0\nat = 1.0', "exactly one of at, by, during, never; here: at, by"),
        ('[[expect]]\nmode = "RUN"\nby = 9.0', "expect.0 speaks of 9 s; the scenario ends at 3 s"),
        ('[[expect]]\nsignal = "x_dem"\nby = 2.0', "signal needs low or high"),
        ("demand = [[0.0, 80.0], [0.0, 90.0]]", "its times (=[0.0, 0.0]) must increase"),
        ("demand = [[0.0, 300.0]]", "300 % must be in [0, 125]"),
        ("seed = -1", "seed (=-1)"),
        ("inject = 3", "inject (=3)"),
        ("nonsense", "not a TOML table"),
    ],
)
def test_a_bad_scenario_is_refused_in_one_line(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(f'title = "a bad one"\nduration = 3.0\n{text}\n')
    assert main(["inject", str(file)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("vaneloop: ") and error.count("\n") == 1, error
    assert said in error


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["demand_stps"], "demand_stps: no such file or shipped scenario; 'demand_stops' ships"),
        ([], "give the scenarios to run, or --all"),
        (["--all", "nominal"], "give the scenarios to run, or --all"),
        (["nominal", "--bus", "wire"], "--bus 'wire' is not known"),
        (
            ["demand_stops", "--bus", "local:nobody"],
            "demand_stops on local:nobody: drop: no other station on a bus can do that; --bus lockstep can",
        ),
        (["nominal", "--seed", "-3"], "--seed -3 must be 0 or more"),
    ],
)
def test_a_bad_command_line_is_refused_in_one_line(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inject", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_the_command_reports_as_table_json_and_junit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text('title = "claims too much"\nduration = 1.0\n[[expect]]\nmode = "FAIL_SAFE"\nby = 0.9\n')
    json_file, junit = tmp_path / "out.json", tmp_path / "out.xml"
    assert main(["inject", "demand_gap_40ms", str(wrong), "--json", str(json_file), "--junit", str(junit)]) == 1
    said = capsys.readouterr().out
    assert "broken: wrong: FAIL_SAFE by 0.900 s; seen: never" in said
    assert "1 of 2 scenarios held" in said
    data = json.loads(json_file.read_text())
    assert [(s["name"], s["held"]) for s in data["scenarios"]] == [("demand_gap_40ms", True), ("wrong", False)]
    assert data["held"] is False and data["schema"] == 1
    assert data["scenarios"][0]["counts"]["lost"] == 4
    suite = ElementTree.parse(junit).getroot().find("testsuite")
    assert suite is not None and (suite.get("tests"), suite.get("failures")) == ("2", "1")
    assert [c.find("failure") is not None for c in suite.findall("testcase")] == [False, True]
    assert main(["inject", "demand_gap_40ms", "--quiet"]) == 0
    assert capsys.readouterr().out == ""


def test_the_list_names_every_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inject", "--list", "--json", "-", "--quiet"]) == 0
    assert {s["name"] for s in json.loads(capsys.readouterr().out)["scenarios"]} == set(library())


# ---- in a user's own suite -------------------------------------------------------------------------------------------

OWN_SUITE = """
def test_a_short_silence(sil):
    outcome = sil("demand_gap_200ms")
    assert "demand_rejected" not in outcome.faults_seen()

def test_my_own_bad_day(sil):
    outcome = sil.run(sil.Drop(start=2.0, duration=0.1), duration=4.0)
    assert outcome.mode_at(2.06) == "DEGRADED" and outcome.mode == "RUN"

def test_my_own_file(sil):
    sil("mine.toml", seed=7)

def test_claims_too_much(sil):
    sil.run(sil.Drop(start=2.0), duration=4.0, expect=[sil.Expect(mode="RUN", during=[1.0, 4.0])])
"""


@pytest.mark.slow
def test_the_fixture_works_in_an_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "test_own.py").write_text(OWN_SUITE)
    (tmp_path / "mine.toml").write_text('title = "my own"\nduration = 1.0\n[[expect]]\nmode = "RUN"\nby = 0.06\n')
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST")}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "."],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert "1 failed, 3 passed" in done.stdout, done.stdout + done.stderr
    assert "BROKEN  RUN from 1.000 to 4.000 s  |  seen: broken at 2.041 s: DEGRADED > FAIL_SAFE" in done.stdout


def test_the_fixture_says_which_scenario_broke(sil) -> None:
    with pytest.raises(pytest.fail.Exception, match="NOT held"):
        sil.run(duration=1.0, expect=[sil.Expect(mode="FAIL_SAFE", by=0.5)])
    with pytest.raises(AttributeError, match="Drop"):
        sil.Dorp  # noqa: B018
    with pytest.raises(InputError):
        sil("no_such_scenario")


def test_an_outcome_answers_in_words() -> None:
    outcome: Outcome = inject.run("demand_gap_200ms")
    assert outcome.faults_seen() == {"demand_stale"}
    assert [m for _, m in outcome.modes] == ["INIT", "STANDBY", "RUN", "DEGRADED", "RUN"]
    assert outcome.mode_at(2.5) == "DEGRADED"
