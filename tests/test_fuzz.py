"""The safety campaign: it holds, it finds what is wrong, and what it finds is small and replays."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from hil.bus.frames import ERROR, REMOTE
from hil.calibrate import Memory, station
from hil.calibrate.lock import Lock
from hil.calibrate.station import MASTER
from hil.inject import fuzz
from hil.inject.fuzz import KINDS, Campaign, make_attack, read_attack, run_attack, write_attack
from hil.inject.fuzz_tools import fuzz_tools
from hil.uds.server import Server
from tests.columns import FAIL_SAFE, INIT, RUN, STANDBY
from tests.conftest import ROOT
from vaneloop.cli.main import main


def held(campaign: Campaign, frames: int) -> None:
    assert campaign.failure is None, campaign.failure
    assert campaign.frames == frames and (campaign.kinds > 0).all() and campaign.longest_recovery_s < 2.1
    assert not campaign.transitions[~fuzz.TRANSITIONS].any()
    seen = {verdict for verdict, count in campaign.verdicts.items() if count}
    assert seen == campaign.verdicts.keys() - {"unauthentic"}, campaign.verdicts  # no authentication is on
    assert (campaign.ticks_in > 0).all()
    by_sensor_only = {
        (INIT, FAIL_SAFE),
        (STANDBY, FAIL_SAFE),
        (RUN, FAIL_SAFE),
    }  # an LVDT that fails; frames cannot bring these about
    assert {(int(a), int(b)) for a, b in np.argwhere(campaign.transitions)} == {
        (int(a), int(b)) for a, b in np.argwhere(fuzz.TRANSITIONS)
    } - by_sensor_only


@pytest.mark.slow
def test_a_million_frames_do_no_harm() -> None:
    """So fewer than three in a million such frames would, with 95 % confidence."""
    held(fuzz.fuzz(1_000_000, seed=12), 1_000_000)


def test_the_same_seed_gives_the_same_campaign_and_another_another() -> None:
    a, b, c = (fuzz.fuzz(5_000, seed=s) for s in (3, 3, 4))
    assert a.verdicts == b.verdicts and np.array_equal(a.transitions, b.transitions)
    assert a.verdicts != c.verdicts


def test_attacks_are_what_they_are_said_to_be() -> None:
    """Each kind is judged as its description says, as far as it says something."""
    from hil.bus import frames

    rng = np.random.default_rng(5)
    rows, kinds = [], []
    while len(kinds) < 20_000:
        attack, kind = make_attack(rng)
        assert (np.diff(attack.at) >= 0).all() and attack.end > attack.at[-1]
        rows += attack.rows.tolist()
        kinds += kind.tolist()
    by_kind: dict[str, set[str]] = {name: set() for name in KINDS}
    for (head, data), kind in zip(rows, kinds, strict=True):
        by_kind[KINDS[kind]].add(frames.VERDICTS[frames.receive(frames.new_receiver(0xA0), head, data, 0)])
    assert by_kind["payload"] <= {"wrong_crc", "sync", "wrong_sequence"} and "wrong_crc" in by_kind["payload"]
    assert by_kind["insane"] == by_kind["good"] == {"sync"}
    assert by_kind["wrong kind"] == {"wrong_kind", "other"}
    assert by_kind["foreign"] == {"other", "sync"}  # a tenth of them is left a frame of the ECU
    assert {"wrong_length", "sync"} == by_kind["length"]
    assert {"sync", "wrong_sequence"} == by_kind["counter"]
    assert "wrong_crc" in by_kind["mutated"] and by_kind["noise"] >= {
        "other",
        "wrong_kind",
        "wrong_crc",
        "wrong_length",
    }


SCRIPT = (
    "from hil.inject.fuzz import fuzz; c = fuzz({frames}, seed=21); print(c.failure, c.verdicts, "
    "c.transitions.tolist(), c.longest_recovery_s)"
)


@pytest.mark.slow
def test_no_index_is_out_of_bounds_and_compiled_code_does_what_the_source_says() -> None:
    answers = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT.format(frames=40)],
            cwd=ROOT,
            env={**os.environ, **env},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for env in (
            {},
            {"NUMBA_DISABLE_JIT": "1"},
        )  # plain Python raises IndexError, and OverflowError where an int64 is not enough
    ]
    assert answers[0] == answers[1] and answers[0].startswith("None")


# ---- what it does with a failure -------------------------------------------------------------------------------------


TIGHT = np.array([0.040, 0.0, 0.030])  # A, m, m: the controller is allowed 0.0475 m


@pytest.fixture(scope="module")
def failure() -> fuzz.Failure:
    """What a campaign with limits that are too tight finds first, shrunk."""
    found = fuzz.fuzz(200_000, seed=1, limits=TIGHT).failure
    assert found is not None
    return found


def test_a_failure_is_shrunk_written_and_replays(failure: fuzz.Failure, tmp_path: Path) -> None:
    f = failure
    assert f.claim == "the stroke demand left its limits"
    whole = make_attack(np.random.default_rng([1, f.episode]))[0]
    assert 1 <= len(f.attack.at) < len(whole.at) / 10
    log = tmp_path / "failure.log"
    write_attack(log, f.attack)
    claim, tick, _ = run_attack(read_attack(log), TIGHT)
    assert claim == f.claim and tick == f.tick
    assert run_attack(read_attack(log))[0] == "held"


def test_no_frame_can_be_left_out_of_a_shrunk_failure(failure: fuzz.Failure) -> None:
    f = failure
    assert 1 <= len(f.attack.at) < 10
    for k in range(len(f.attack.at)):
        at, rows = np.delete(f.attack.at, k), np.delete(f.attack.rows, k, axis=0)
        assert run_attack(fuzz.Attack(at, rows, f.attack.end, f.attack.counter, f.attack.warm), TIGHT)[0] != f.claim


def test_a_log_carries_every_kind_of_frame(tmp_path: Path) -> None:
    attack, _ = make_attack(np.random.default_rng([7, 3]))
    log = tmp_path / "attack.log"
    write_attack(log, attack)
    back = read_attack(log)
    warm = 60 if attack.warm else 0
    n = len(attack.at)
    rows, error, remote = back.rows[warm : warm + n], attack.rows[:, 0] & ERROR != 0, attack.rows[:, 0] & REMOTE != 0
    assert np.array_equal(back.at[warm : warm + n], attack.at)
    assert np.array_equal(rows[~error & ~remote], attack.rows[~error & ~remote]) and error.any() and remote.any()
    assert (rows[error, 0] & ERROR != 0).all()
    assert np.array_equal(
        rows[remote, 0], attack.rows[remote, 0] & ~0xFF00000000
    )  # python-can does not write a remote frame's length


# ---- command ---------------------------------------------------------------------------------------------------------


def test_command_reports_and_exits_0_when_everything_held(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "answer.json"
    assert main(["fuzz", "--frames", "20000", "--seed", "2", "--json", str(out)]) == 0
    answer = json.loads(out.read_text())
    assert answer["held"] and answer["frames"] == 20000 and answer["failure"] is None
    assert sum(answer["kinds"].values()) == 20000
    assert "held: limits, transitions, recovery" in capsys.readouterr().out


def test_command_exits_1_on_a_failure_and_its_log_replays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "failure.log"
    assert main(["fuzz", "--frames", "200000", "--seed", "1", "--stroke-limit", "30", "--out", str(log)]) == 1
    assert "the stroke demand left its limits" in capsys.readouterr().out
    assert main(["fuzz", "--replay", str(log), "--stroke-limit", "30"]) == 1
    assert main(["fuzz", "--replay", str(log)]) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("right", "wrong", "claim"),
    [
        ("elif z.degraded_timer >= k.degraded_hold - HALF_TICK:\n            mode = FAIL_SAFE",
         "elif z.degraded_timer >= k.degraded_hold - HALF_TICK:\n            mode = STANDBY",
         "a mode transition that is not in the table"),
        ("0.0 if trouble else z.recover_timer + TICK", "0.0 if trouble else z.recover_timer",
         "RUN did not come back on good frames"),
    ],
    ids=["leaves DEGRADED for STANDBY", "stays in FAIL_SAFE"],
)  # fmt: skip
def test_a_broken_controller_is_caught_and_its_shrunk_log_replays(
    right: str, wrong: str, claim: str, tmp_path: Path
) -> None:
    for package in ("controller", "hil", "plant", "tables", "vaneloop"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    firmware = tmp_path / "controller" / "modes.py"
    assert firmware.read_text().count(right) == 1
    firmware.write_text(firmware.read_text().replace(right, wrong))

    def broken(*options: str) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
        command = [sys.executable, "-m", "vaneloop.cli.main", "fuzz", *options]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)

    found = broken("--frames", "100000", "--json", "answer.json", "--out", "failure.log")
    assert found.returncode == 1 and claim in found.stdout, (found.stdout, found.stderr)
    frames = json.loads((tmp_path / "answer.json").read_text())["failure"]["frames"]
    again = broken("--replay", "failure.log")
    assert again.returncode == 1 and claim in again.stdout
    assert main(["fuzz", "--replay", str(tmp_path / "failure.log"), "--quiet"]) == 0, "the right controller survives it"
    assert frames <= 10, frames


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--frames", "0"], "--frames (=0) must be at least 1"),
        (["--seed", "-1"], "--seed (=-1)"),
        (["--recovery", "nan"], "--recovery (=nan)"),
        (["--current-limit", "-3"], "--current-limit (=-3)"),
        (["--stroke-limit", "1e9"], "--stroke-limit (=1e+09)"),
        (["--replay", "no such file"], "no such file"),
        (["--replay", "README.md"], "README.md"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    os.chdir(ROOT)
    assert main(["fuzz", *options]) == 2
    err = capsys.readouterr().err
    assert said in err and len(err.strip().splitlines()) == 1


@pytest.mark.parametrize("tool", ["xcp", "uds"])
def test_ten_thousand_hostile_commands_of_a_tool_do_no_harm(tool: str) -> None:
    hostile(tool, 10_000)


def test_sequences_of_both_protocols_do_no_harm() -> None:
    hostile("both", 2_000)


@pytest.mark.slow
def test_thirty_thousand_frames_of_sequences_do_no_harm() -> None:
    hostile("both", 30_000)


@pytest.mark.slow
@pytest.mark.parametrize("tool", ["xcp", "uds"])
def test_a_hundred_thousand_hostile_commands_of_a_tool_do_no_harm(tool: str) -> None:
    hostile(tool, 100_000)


FREE = np.array([np.inf, np.inf])


def hostile(tool: str, frames: int) -> None:
    if tool != "xcp":
        pytest.importorskip("isotp")
    campaign = fuzz_tools(tool, frames, seed=31, limits=FREE)
    assert not campaign.failure and campaign.frames >= frames
    refused = [name for name in campaign.answers if name.startswith("fe") or name == "answers"]
    assert len(refused) > (0 if tool == "uds" else 5), campaign.answers


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "name", "broken", "said"),
    [
        (Server, "silent", property(lambda s: s._quiet), "no frame was sent in"),
        (Server, "_unlocked", lambda s: None, "something was changed without a key"),
        (Lock, "fits", lambda s, k, key, right: True, "something was changed without a key"),
        (station, "MOST_WORK", 20, "frames' work in one tick"),
    ],
)
def test_a_campaign_of_sequences_notices_what_is_broken(
    where: Any, name: str, broken: Any, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(where, name, broken)
    assert said in fuzz_tools("both", 30_000, seed=1, limits=FREE).failure


def test_a_campaign_against_tools_notices_a_monitor_that_can_be_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Memory, "_allowed", lambda self, numbers: None)
    campaign = fuzz_tools("xcp", 30_000, seed=31, limits=FREE)
    assert "while the loop was closed" in campaign.failure or "RUN is not back" in campaign.failure, campaign


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--frames", "7000", "--current-limit", "0.2"], "beyond the limit asked for (=0.0002)"),
        (["--frames", "7000", "--stroke-limit", "1"], "stroke demand (=0."),
        (["--frames", "50", "--recovery", "0.01"], "RUN is not back after 0.01 s"),
    ],
)
def test_a_campaign_against_tools_heeds_its_options(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "failed.log"
    assert main(["fuzz", "--tool", "xcp", *options, "--out", str(log)]) == 1
    out = capsys.readouterr().out
    assert "FAILED: episode " in out and said in out and str(log) in out
    idents = {m.arbitration_id for m in can.CanutilsLogReader(log)}
    assert idents == {MASTER}
    nowhere = tmp_path / "no" / "folder.log"
    assert main(["fuzz", "--tool", "xcp", *options, "--out", str(nowhere)]) == 2
    assert f"cannot write {nowhere}: No such file or directory" in capsys.readouterr().err
