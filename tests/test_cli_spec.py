"""What commands take, print and return, of answers that a test makes: which options go together, what is said of what,
the exit code, JUnit's files.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import json
import os
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np
import pytest

from controller import STRATEGIES
from hil.calibrate.station import MASTER
from hil.replay import STATISTICS
from hil.uds.server import FUNCTIONAL, REQUEST
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.cli import attended, campaign, completion, ecu, fleet, fuzz, inject, main, options, replay, station
from vaneloop.cli import engine_test as engine
from vaneloop.cli import strategies as of_strategies
from vaneloop.design.strategies import FIGURES
from vaneloop.pages.engine_test import PAPER_TABLE_5

Said = pytest.CaptureFixture[str]


def args(**more: Any) -> argparse.Namespace:
    return argparse.Namespace(**{"quiet": False, "json": None, **more})


def lines(capsys: Said) -> list[str]:
    return [s for line in capsys.readouterr().out.splitlines() if (s := re.sub(r"\s+", " ", line).strip(" ─╷╵┃│"))]


def refused(what: Any, *given: Any, **more: Any) -> str:
    with pytest.raises(InputError) as e:
        what(*given, **more)
    return str(e.value)


# ---- a model of one's own: the commands as a user types them ---------------------------------------------------------

MAP = """
from vaneloop import System, unknown

system = System(
    "map", "static", lambda u, p: p.a * u.u, outputs={"y": "V"}, inputs={"u": "V"}, parameters=[unknown("a", 1.0, "-")],
    places=["u", "y"],
    read=lambda path: dict(zip(("t", "u", "y"), __import__("numpy").loadtxt(path, delimiter=",").T)),
)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A system, a log with a cubic that it lacks, and a log without."""
    at = tmp_path_factory.mktemp("own")
    (at / "map.py").write_text(MAP)
    t = 0.1 * np.arange(100)
    for name, k, u in (("a", 0.2, 1.5 * np.sin(t)), ("b", 0.2, 1.3 * np.cos(0.7 * t)), ("c", 0.0, 1.5 * np.sin(t))):
        y = 2.0 * (u + k * u**3) + 0.01 * np.random.default_rng(4).standard_normal(100)
        np.savetxt(at / f"{name}.csv", np.stack([t, u, y], axis=1), delimiter=",")
    return at


def ran(capsys: Said, folder: Path, *words: str, system: bool = True) -> tuple[int, list[str], str]:
    with pytest.MonkeyPatch.context() as m:
        m.chdir(folder)
        code = main.main([*words, *(["--system", "map.py"] if system else [])])
    out = capsys.readouterr()
    return code, [re.sub(r"\s+", " ", line).strip() for line in out.out.splitlines()], out.err


def test_compare_and_locate_tell_each_log_and_where_the_model_fails(folder: Path, capsys: Said) -> None:
    code, said, _ = ran(capsys, folder, "compare", "a.csv", "--test", "b.csv", "--json", "compare.json")
    assert code == 0 and any(s.startswith("a fitted y ") for s in said)
    assert any(s.startswith("b test y ") for s in said)
    data = json.loads((folder / "compare.json").read_text())
    assert {row["log"]: row["fitted"] for row in data["logs"]} == {"a.csv": True, "b.csv": False}
    code, said, _ = ran(capsys, folder, "locate", "a.csv", "--json", "locate.json")
    assert code == 1 and any(s.startswith("map: ") for s in said) and (folder / "locate.json").exists()
    code, said, _ = ran(capsys, folder, "locate", "c.csv", "--quiet")
    assert code == 0 and said == []


def test_diagnose_names_the_law_and_extend_takes_it_in(folder: Path, capsys: Said) -> None:
    code, said, _ = ran(capsys, folder, "diagnose", "a.csv", "--test", "b.csv", "--explain", "--json", "d.json")
    data = json.loads((folder / "d.json").read_text())
    assert code == 1 and [e["effect"] for e in data["effects"]] == ["u.cubic"] == [
        s.split()[3] for s in said if s.startswith("missing in map:")
    ]
    assert "acceptance rules" in said and any(s.startswith("map: ") for s in said)
    assert any(s.startswith("parameter a: ") for s in said)
    assert sum(s.startswith(("a fitted", "b test")) for s in said) == 2
    code, said, _ = ran(capsys, folder, "diagnose", "c.csv")
    assert (
        code == 0 and not any(s.startswith(("missing", "parameter")) for s in said) and "acceptance rules" not in said
    )
    code, said, _ = ran(capsys, folder, "extend", "a.csv", "--effect", "u.cubic", "--out", "m.toml")
    assert code == 0 and any("u.cubic" in s for s in said) and (folder / "m.toml").exists()
    assert "model: m.toml" in said and any(s.startswith("a fitted y ") for s in said)
    code, said, _ = ran(capsys, folder, "diagnose", "b.csv", "--model", "m.toml")
    assert code == 0
    code, _, err = ran(capsys, folder, "diagnose", "a.csv", "--without", "u.cubic", "--workers", "0")
    assert code == 2 and err == "vaneloop: --workers (=0) must be in [1, 64]\n"
    code, _, err = ran(capsys, folder, "diagnose", "a.csv", "--workers", "65")
    assert code == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["compare", "a.csv", "--also", "b.csv"], "--also needs --system MY.py"),
        (["compare", "a.csv", "--test", "b.csv"], "--test b.csv needs --system MY.py"),
        (["diagnose", "a.csv", "--system", "no.py"], "no.py: no such file; --system wants a Python file"),
        (["diagnose", "a.csv", "--system", "map.py", "--tables", "x"], "--tables does not go with --system"),
        (["compare", "a.csv", "--system", "map.py", "--strategy", "dual"], "--strategy does not go with --system"),
        (["extend", "a.csv", "--system", "map.py", "--effect", "m2.toml", "--out", "n.toml"], "m2.toml"),
        (
            ["diagnose", "a.csv", "--save-crash", "x.parquet"],
            "--save-crash x.parquet: needs --controller; the firmware",
        ),
        (["diagnose", "a.csv", "--controller", "x.so", "--save-crash", "x.csv"], "--save-crash x.csv: must end with"),
        (["run", "--bus", "lockstep", "--xcp"], "--xcp needs a bus that a tool can join: vcan0, local; --bus lockstep"),
        (["run", "--xcp-save", "d"], "--xcp-save belongs to --xcp"),
        (["run", "--xcp", "--xcp-lock", "--xcp-open"], "--xcp-lock and --xcp-open exclude each other"),
        (["run", "--tool-seed", "3"], "--tool-seed belongs to --xcp and --uds"),
        (["run", "--xcp", "--tool-seed", "-1"], "--tool-seed (=-1) must be 0 to 2^63 - 1"),
        (["run", "--uds-memory", "f.json"], "--uds-memory belongs to --uds"),
        (["run", "--spin-us", "1001"], "--spin-us (=1001) must be in [0, 1000]"),
        (["run", "--realtime-priority", "100"], "--realtime-priority (=100) must be in [1, 99]"),
        (["run", "--cpu", "4096"], "--cpu (=4096) must be one of "),
        (["run", "--duration", "0"], "--duration (=0 s) must be above 0, at most 10,000,000 s"),
        (["record", "x.blf", "--duration", "0"], "--duration (=0 s) must be above 0, at most 10,000,000 s"),
        (["record", "x.blf", "--bus", "lockstep"], "--bus lockstep exists within one process"),
        (["fuzz", "--frames", "0"], "--frames (=0) must be at least 1"),
        (["fuzz", "--seed", "-1"], "--seed (=-1) must be 0 to 2^63 - 1"),
        (["fuzz", "--recovery", "0.001"], "--recovery (=0.001) must be 0.01 to 3600 s"),
        (["fuzz", "--current-limit", "1001"], "--current-limit (=1001) must be above 0, at most 1000 mA"),
        (["fuzz", "--stroke-limit", "0"], "--stroke-limit (=0) must be above 0, at most 1000 mm"),
        (["fuzz", "--tool", "xcp", "--model", "m.toml"], "--model is not for --tool"),
        (["strategies", "--play", "5.1"], "--play (=5.1 deg) must be in [0, 5]"),
        (["strategies", "--noise", "21"], "--noise (=21) must be in [0, 20]"),
        (["strategies", "--seed", "-1"], "--seed (=-1) must be 0 or more"),
        (["engine-test", "--hysteresis", "10.1"], "--hysteresis (=10.1 deg) must be in [0, 10]"),
        (["engine-test", "--seed", "-1"], "--seed (=-1) must be 0 or more"),
        (["ecu", "--profile", "ramps", "--log", "a.csv"], "--profile and --log exclude each other"),
        (["ecu", "--profile", "rmap"], "--profile 'rmap' is not known"),
        (["ecu", "--part", "2"], "--part says how to read a log, but none is given (--log LOG)"),
    ],
)
def test_options_that_cannot_be_get_one_line(folder: Path, words: list[str], said: str, capsys: Said) -> None:
    code, out, err = ran(capsys, folder, *words, system=False)
    assert code == 2 and err.startswith(f"vaneloop: {said}") and err.count("\n") == 1 and out == []


def taken(parser: argparse.ArgumentParser) -> set[str]:
    """What a command, or one of its parts, takes."""
    out: set[str] = set()
    for action in parser._actions:
        parts = action.choices.values() if isinstance(action, argparse._SubParsersAction) else ()
        out |= {action.dest}.union(*map(taken, parts))
    return out


@pytest.mark.parametrize("name", [n for n in main.COMMANDS if not n.startswith("-")])
def test_a_command_takes_what_it_reads(name: str) -> None:
    module = importlib.import_module(main.COMMANDS[name][0])
    parser = argparse.ArgumentParser()
    module.add_options(parser)
    of_args = [
        n for n in ast.walk(ast.parse(inspect.getsource(module)))
        if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name) and n.value.id == "args"
    ]  # fmt: skip
    put = {n.attr for n in of_args if isinstance(n.ctx, ast.Store)}
    assert {n.attr for n in of_args} - put - taken(parser) == set()


# ---- options ---------------------------------------------------------------------------------------------------------


def test_what_the_reading_options_say() -> None:
    given = args(
        log="a.csv", dbc="x.dbc", map=["N=n_dem", "N=n_r", "X=x_lvdt"], unit=["n_r=rpm"], design_rpm=9e3,
        mapping="m.toml", no_guess=True, part=3, tables=None,
    )  # fmt: skip
    assert options.log_options(given) == {
        "dbc": "x.dbc", "mapping": {"N": "n_dem", "n_r": "N", "X": "x_lvdt"}, "units": {"n_r": "rpm"},
        "design_rpm": 9e3, "guess": False, "mapping_file": "m.toml", "part": 3,
    }  # fmt: skip
    bare = args(log=None, dbc=None, map=[], unit=[], design_rpm=None, mapping=None, no_guess=False, part=None)
    assert options.log_options(bare)["guess"] is True and "part" not in options.log_options(bare)
    for name, value in (("dbc", "f"), ("map", ["a=b"]), ("no_guess", True), ("part", 1)):
        option = name.replace("_", "-")
        idle = argparse.Namespace(**{**vars(bare), name: value})
        assert refused(options.log_options, idle) == f"--{option} says how to read a log, but none is given (--log LOG)"
        assert options.log_options(idle, source="f.csv")


def test_code_of_others_runs_only_where_somebody_says_so(monkeypatch: pytest.MonkeyPatch, capsys: Said) -> None:
    options.trusted(args(trust=False), "run", [])
    options.trusted(args(trust=True), "run", ["evil.py"])
    monkeypatch.setattr(terminal, "is_terminal", lambda stream: False)
    text = "run: names code that would run here with your rights: a.py, b.so"
    assert refused(options.trusted, args(trust=False), "run", ["a.py", "b.so"]) == f"{text}; --trust says that it may"
    monkeypatch.setattr(terminal, "is_terminal", lambda stream: True)
    monkeypatch.setattr(terminal, "input_of", lambda stream: 0)
    for answer, runs in (("y\n", True), ("YES \n", True), ("n\n", False), ("\n", False)):
        monkeypatch.setattr("sys.stdin", SimpleNamespace(readline=lambda answer=answer: answer))
        if runs:
            options.trusted(args(trust=False), "run", ["a.py"])
        else:
            assert refused(options.trusted, args(trust=False), "run", ["a.py"]) == "run: its code was not run"
    assert capsys.readouterr().err.count("Run it? [y/N] ") == 4


def test_tolerances_are_of_a_signal_s_statistic() -> None:
    assert replay._limits(["vigv=0.5", "x_lvdt.max_abs=2"]) == {("vigv", "rms"): 0.5, ("x_lvdt", "max_abs"): 2.0}
    assert replay._limits(["vigv=0"]) == {("vigv", "rms"): 0.0}
    for bad in ("vigv=-1", "vigv=inf", "vigv=nan", "vigv=much"):
        value = bad.partition("=")[2]
        assert refused(replay._limits, [bad]) == f"--tolerance {bad}: {value!r} must be a number of 0 or more"
    assert refused(replay._limits, ["vigw=1"]).startswith("--tolerance vigw=1: 'vigw' is not known; close: vigv") or (
        "'vigw' is not known" in refused(replay._limits, ["vigw=1"])
    )
    signals = [
        SimpleNamespace(signal="vigv", reference=r, rms=v, max_abs=None, unit="deg")
        for r, v in (("schedule", 9.0), ("measured", 0.61))
    ]
    result: Any = SimpleNamespace(signals=signals, log="a.csv")
    assert replay._exceeded(result, {("vigv", "rms"): 0.61}) == []
    assert replay._exceeded(result, {("vigv", "max_abs"): 0.0}) == []
    assert replay._exceeded(result, {("vigv", "rms"): 0.6}) == [
        "vigv rms 0.61 deg against the measurement exceeds 0.6 deg"
    ]
    only: Any = SimpleNamespace(signals=signals[:1], log="a.csv")
    assert replay._exceeded(only, {("vigv", "rms"): 1.0}) == ["vigv rms 9 deg against the schedule exceeds 1 deg"]
    signals[1].rms = np.nan
    assert len(replay._exceeded(result, {("vigv", "rms"): 1.0})) == 1
    assert (
        refused(replay._exceeded, result, {("n_r", "rms"): 1.0})
        == "--tolerance n_r=1: a.csv has no n_r to compare with"
    )
    assert (replay._figure(None), replay._figure(0.123456)) == ("-", "0.1235")


# ---- stations --------------------------------------------------------------------------------------------------------


def test_tools_are_let_in_where_they_are_wanted() -> None:
    none, xcp, uds = (args(xcp=x, uds=u) for x, u in ((False, False), (True, False), (False, True)))
    assert [attended.wanted(a) for a in (none, xcp, uds)] == [False, True, True]
    more = [[f["can_id"] for f in attended.accepted(a)[len(station.ACCEPTED) :]] for a in (none, xcp, uds)]
    assert more == [[], [MASTER], [REQUEST, FUNCTIONAL]]
    assert all(f["can_mask"] == 0x7FF for f in attended.accepted(xcp)[len(station.ACCEPTED) :])
    node = object()
    assert attended.attend(none, node) is node


def test_a_bus_that_refuses_frames_is_told_once_and_when_it_is_well_again(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(station.BusWatch, "_say", lambda self, text: said.append(text))
    port = SimpleNamespace(refused=0, errors=0)
    watch = station.BusWatch(args(), "nowhere0", port)
    for k in range(1000):
        if 100 <= k <= 300 and k % 10 == 0:
            port.refused += 1
        watch(k)
    assert said == [
        "nowhere0: does not take frames (gone, full or bus-off); frames are neither sent nor heard, going on",
        "nowhere0: takes frames again after 0.2 s; 21 were not sent",
    ]
    port.errors += 1
    watch(1001)
    assert len(said) == 3


def test_a_line_on_the_standard_error_replaces_the_one_before(monkeypatch: pytest.MonkeyPatch, capfd: Said) -> None:
    for is_terminal, live, wanted in (
        (True, False, "\rlonger\rab    \r      \r".replace("\r      \r", "\r" + " " * 2 + "\r")),
        (False, True, "longer\nab\n"), (False, False, ""),
    ):  # fmt: skip
        monkeypatch.setattr(terminal, "is_terminal", lambda stream, is_terminal=is_terminal: is_terminal)
        line = station.Live(args(live=live))
        line.say("longer")
        line.say("ab")
        line.close()
        line.say("nothing")
        assert capfd.readouterr().err == wanted
    monkeypatch.setattr(terminal, "is_terminal", lambda stream: True)
    assert not station.Live(args(live=True, quiet=True)).on


def test_what_authentication_saw() -> None:
    counts = {"verified": 1234, "missing": 1, "wrong_mac": 2, "stale": 3, "unmatched": 4}
    node: Any = SimpleNamespace(authentication=counts)
    assert station.authenticator(args(secoc=None)) is None and station.secured(node, None) is node
    assert station.authentication_json(args(secoc=None), node) is None
    assert station.authentication_json(args(secoc="k"), node) == counts
    assert [station.authentication_words(args(secoc=k)) for k in (None, "k")] == [
        "authentication off", "authentication on (SecOC)",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        (b"88.5\n+1\nstand", ["88.5", "+1", "stand"]), (b"\n", ["", ""]), (b"", [""]),
        (b"x" * 4096 + b"\n1", ["x" * 4096, "1"]), (b"1\n" + b"x" * 9000, ["1"]),
    ],
)  # fmt: skip
def test_lines_are_typed_until_there_are_none_or_one_never_ends(typed: bytes, told: list[str], capfd: Said) -> None:
    read, write = os.pipe()
    os.write(write, typed)
    os.close(write)
    got: list[str] = []
    typing = SimpleNamespace(line=got.append, complaint="88.5: no")
    ecu._lines(args(), read, typing)
    os.close(read)
    assert got == told
    err = capfd.readouterr().err
    assert err.count("vaneloop ecu: 88.5: no\n") == bool(told) and typing.complaint == ("" if told else "88.5: no")
    assert ("a line of more than 4,096 bytes; not read on" in err) == (len(typed) > 8000)


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ([b"\x1b[A", b"\x1b[B", b"\x1b[5~", b"\x1b[6~"], ["+1", "-1", "+5", "-5"]),
        ([b"88.5\r"], ["88.5"]), ([b"89", b"\x7f", b"7\n"], ["87"]), ([b"r", b"s"], ["run", "standby"]),
        ([b"run"], ["run"]), ([b"+", b"-"], ["+1", "-1"]), ([b"7", b"+", b"\r"], ["7+"]),
    ],
)  # fmt: skip
def test_keys_are_what_they_say(keys: list[bytes], told: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    left = [*keys, b""]
    monkeypatch.setattr("select.select", lambda *_: ([1], [], []))
    monkeypatch.setattr("vaneloop.cli.ecu.os", SimpleNamespace(read=lambda fd, most: left.pop(0)))
    got: list[str] = []
    ecu._keys(0, SimpleNamespace(line=got.append, quit=False))
    assert got == told and left == []
    ecu._keys(0, SimpleNamespace(line=got.append, quit=True))
    assert got == told


# ---- what campaigns say ----------------------------------------------------------------------------------------------


def group(**more: Any) -> SimpleNamespace:
    rule = SimpleNamespace(
        expected="stays in RUN", broken=2, trials=9, least=-0.5, unit="s", fails=True, ids=["R-7"],
    )  # fmt: skip
    held = SimpleNamespace(expected="no fault", broken=0, trials=9, least=0.5, unit="s", fails=False, ids=[])
    given: dict[str, Any] = {
        "name": "gust", "failed": 2, "trials": 9, "low": 0.03, "high": 0.6, "least": -0.5, "found_by": "search",
        "same": False, "reproduces": False, "rare": None, "counted": "", "failures": [], "saved_failures": lambda: "",
        "requirements": [rule, held], "alone": {"its bus": 3}, "lost": 1, "runs": 0,
        "command": "vaneloop campaign again",
    }  # fmt: skip
    return SimpleNamespace(**given | more)


def test_a_campaign_is_told_and_written_for_junit(tmp_path: Path, capsys: Said) -> None:
    view: Any = SimpleNamespace(
        groups=[
            group(),
            group(name="calm", failed=0, requirements=[], alone={}, lost=0, runs=4, same=True, reproduces=True),
        ],
        passed=lambda g: g.name == "calm", confidence=0.95, title="a campaign", allowed=None,
        sentence=lambda: "so it is", simulated_s={"cpu": 1.0}, simulated_on="Simulated: 1 s", notes=["no GPU"],
        texts={},
    )  # fmt: skip
    campaign._show(args(), view, 5)
    said = lines(capsys)
    assert "gust FAILS 2 of 9 0.03 to 0.6 -0.5 search NO" in said
    assert "calm passes 0 of 9 0.03 to 0.6 -0.5 search yes" in said
    assert "broken in 2 of 9 machines: gust: stays in RUN" in said and not any("no fault" in s for s in said)
    assert "on the lockstep bus, not in lanes: 3 of 9 machines of gust: its bus" in said
    assert any(s.startswith("without an answer: 1 trials of gust") for s in said)
    assert [s for s in said if s.startswith("no search")] == ["no search in gust: too few of its trials have an answer"]
    assert said.count("worst case: vaneloop campaign again") == 2 and said[-3:] == [
        "Simulated: 1 s",
        "no GPU",
        "so it is",
    ]
    campaign._show(args(), view, 0)
    assert not any(s.startswith("no search") for s in lines(capsys))
    campaign._write_junit(str(tmp_path / "j.xml"), view)
    first, second = Xml.parse(tmp_path / "j.xml").getroot()
    assert first.attrib == {"name": "gust", "tests": "3", "failures": "2", "errors": "0", "skipped": "0"}
    assert second.attrib == {"name": "calm", "tests": "1", "failures": "0", "errors": "0", "skipped": "0"}
    assert [(c.get("name"), len(c)) for c in first] == [
        ("R-7 stays in RUN", 1),
        ("no fault", 0),
        ("the combination passes", 1),
    ]
    assert [c.get("name") for c in second] == ["the combination passes"] and len(second[0]) == 0
    assert first[0][0].get("message") == ("broken in 2 of 9 machines, least margin -0.5 s; vaneloop campaign again")
    assert str(first[2][0].get("message")).startswith("failed 2 of 9 machines, 0.03 to 0.6; 1 without an answer; worst")
    view.allowed = 0.5
    campaign._write_junit(str(tmp_path / "j.xml"), view)
    assert [len(c) for c in Xml.parse(tmp_path / "j.xml").getroot()[0]] == [0, 0, 1]


def outcome(name: str, held: bool) -> Any:
    checks = [
        SimpleNamespace(held=True, expected="RUN by 1 s", seen="0.5 s", because="b"),
        SimpleNamespace(held=held, expected="no fault", seen="one", because="c"),
        SimpleNamespace(held=None, expected="a trip", seen="-", because="d"),
    ]
    return SimpleNamespace(
        name=name, bus="lockstep", title="what happens", checks=checks, modes=[(0.0, "INIT"), (1.0, "RUN")],
        faults=[], held=held, notes=["late"], simulated_s=3.0, wall_s=0.5, json=lambda: {"name": name},
        text=lambda: "t",
    )  # fmt: skip


def test_scenarios_are_told_and_written_for_junit(tmp_path: Path, capsys: Said) -> None:
    given = args(bus="lockstep", junit=str(tmp_path / "j.xml"), json=str(tmp_path / "j.json"))
    inject._report(given, [outcome("good", True), outcome("bad", False)], [("off", "title", "no bus")])
    said = lines(capsys)
    assert "2 scenarios on lockstep" in said and "broken: bad: no fault; seen: one" in said
    assert any(s.startswith("good held what happens INIT > RUN 2 of 3") for s in said)
    assert any(s.startswith("bad BROKEN what happens INIT > RUN 1 of 3") for s in said)
    assert "skipped: off: no bus" in said and "note: bad: late" in said
    assert said[-1] == "1 of 2 scenarios held (6 s simulated in 1.0 s)"
    data = json.loads((tmp_path / "j.json").read_text())
    assert data["held"] is False and data["skipped"] == [{"name": "off", "reason": "no bus"}]
    (suite,) = Xml.parse(tmp_path / "j.xml").getroot()
    assert {k: suite.get(k) for k in ("tests", "failures", "errors", "skipped", "time")} == {
        "tests": "3", "failures": "1", "errors": "0", "skipped": "1", "time": "1.000",
    }  # fmt: skip
    assert [[e.tag for e in case] for case in suite] == [["system-out"], ["failure", "system-out"], ["skipped"]]
    assert suite[1][0].get("message") == "no fault; seen: one"
    inject._report(args(bus="lockstep", junit=None), [outcome("bad", False)], [])
    said = lines(capsys)
    assert "bad on lockstep: what happens" in said and "modes: INIT 0.000 s, RUN 1.000 s" in said
    assert "faults: none" in said and any(s.startswith("BROKEN no fault one c") for s in said)
    assert any(s.startswith("not seen a trip - d") for s in said) and any(s.startswith("held RUN by 1 s") for s in said)
    assert inject._crash_file("d/c.parquet", "good", True) == "d/c_good.parquet"
    assert inject._crash_file("d/c.parquet", "good", False) == "d/c.parquet"


@pytest.mark.parametrize("failure", ["", "it hung"])
def test_a_fuzzed_tool_is_told(failure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said) -> None:
    c = SimpleNamespace(
        protocol="xcp",
        seed=7,
        frames=12345,
        episodes=20,
        ticks=5000,
        grown=0.25,
        failure=failure,
        sent=[1, 2],
        answers=9,
    )
    asked: list[Any] = []

    def campaign_of(*given: Any, **more: Any) -> Any:
        asked.append((given, more))
        return c

    wrote: list[Any] = []
    monkeypatch.setattr("vaneloop.cli.fuzz.fuzz_tools.fuzz_tools", campaign_of)
    monkeypatch.setattr(fuzz, "write_frames", lambda *given: wrote.append(given))
    given = args(
        tool="xcp", frames=100, seed=7, current_limit=30.0, stroke_limit=None, recovery=1.5, out="f.blf",
        json=str(tmp_path / "j.json"), replay=None, model=None, tables=None, plant=None, controller=None,
    )  # fmt: skip
    assert fuzz._tool(given) == (1 if failure else 0)
    ((first, more),) = asked
    assert first[:3] == ("xcp", 100, 7) and more["limits"].tolist() == [0.03, np.inf] and more["recovery"] == 1500
    said = lines(capsys)
    assert said[:2] == [
        "12,345 frames in 20 episodes, 5 simulated s", "the process has grown by 0.2 MB since its first episodes",
    ]  # fmt: skip
    assert said[2] == (f"FAILED: {failure}" if failure else "held: limits, monitors, memory, recovery to RUN")
    assert wrote == ([("f.blf", [1, 2])] if failure else [])
    data = json.loads((tmp_path / "j.json").read_text())
    assert data["held"] is not bool(failure) and data["log"] == ("f.blf" if failure else None)


def test_the_engine_test_is_held_against_the_paper(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Said
) -> None:
    def result(by: float) -> Any:
        figures = {k: PAPER_TABLE_5.get(k, 0.1) * by for k in STATISTICS}
        return SimpleNamespace(
            signals=[SimpleNamespace(signal="vigv", samples=9, **figures)], simulated_s=3164.0, wall_s=2.0, model={}
        )

    monkeypatch.setattr(engine, "warm_up", lambda tell: None)
    for by, code in ((1.0, 0), (1.01, 1)):
        monkeypatch.setattr(engine, "engine_test", lambda *_, by=by: result(by))
        monkeypatch.setattr(engine, "replay_json", lambda r: {"simulated_s": r.simulated_s})
        assert main.main(["engine-test", "--json", str(tmp_path / "e.json")]) == code
        said = lines(capsys)
        assert sum(s.startswith("exceeded: dual vigv ") for s in said) == (len(STATISTICS) - 1) * code
        assert any(s.startswith("paper, dual: vigv - ") for s in said) and any(
            s.startswith("single: vigv") for s in said
        )
        data = json.loads((tmp_path / "e.json").read_text())
        assert set(data) == {"schema", "paper", "single", "dual", "exceeded"} and len(data["exceeded"]) == 3 * code


def test_a_fleet_s_folder_and_patience(monkeypatch: pytest.MonkeyPatch, capsys: Said) -> None:
    for patience, good in ((0.5, True), (1e5, True), (0.49, False), (1.1e5, False)):
        given = args(patience=patience)
        if good:
            assert fleet._patience(given) == patience
        else:
            assert refused(fleet._patience, given) == f"--patience (={patience:g} s) must be in [0.5, 1e5]"
    again = r"^/x: Permission denied; what is done is kept, run the same command again$"
    with pytest.raises(InputError, match=again), fleet.unusable():
        raise PermissionError(13, "Permission denied", "/x")
    with pytest.raises(BrokenPipeError), fleet.unusable():
        raise BrokenPipeError
    fleet.tell_damaged(args(), {})
    assert lines(capsys) == []
    fleet.tell_damaged(args(), {"a.json": "cut"})
    assert "a.json cut" in lines(capsys)
    state = SimpleNamespace(came={"done": 3, "bad": 1}, done=3, contents=4, logs=5, workers={"w": "local"}, damaged={})
    state.json = lambda: {"done": 3}
    monkeypatch.setattr(fleet, "Folder", lambda path: SimpleNamespace(path=path))
    monkeypatch.setattr(fleet, "state_of", lambda folder: state)
    assert fleet._show(args(verb="status", run="r", out=None)) == 0
    said = lines(capsys)
    assert said[0] == "3 of 4 contents done (5 logs)" and "at work: local w" in said and "done 3" in said
    state.damaged = {"a": "b"}
    assert fleet._show(args(verb="run", run=None, out="o")) == 1


def test_strategies_are_judged_by_their_goals(capsys: Said) -> None:
    figures = {"vigv": dict.fromkeys(FIGURES, 0.5)}
    o: Any = SimpleNamespace(figures=figures, travel=1234.0, reversals=7, current=3.0)
    outcomes = {("worn", s): o for s in STRATEGIES}
    failure: Any = SimpleNamespace(
        during="at rest",
        at=99.0,
        failure="stuck",
        step=0.1,
        departure=0.2,
        crossings=3,
        mean_abs=0.4,
        mean_abs_dual=0.5,
    )
    goals = [
        {"goal": "better", "value": 2.0, "limit": 1.5, "held": True},
        {"goal": "b", "value": 1, "limit": 2, "held": False},
    ]
    of_strategies._print(args(), np.zeros(1000), outcomes, [failure, failure], goals)
    said = lines(capsys)
    assert (
        said[0].startswith("10 s under each strategy") and said[-1] == "goals met: 1 of 2; better: 2.0 (at least 1.5)"
    )
    assert any(s.startswith(f"worn {STRATEGIES[0]} 0.500") for s in said)
    assert not any(s.startswith(f"worn {STRATEGIES[1]}") for s in said)
    assert sum(s.startswith("at rest stuck") for s in said) == 1 and sum(s.startswith("stuck") for s in said) == 1


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_what_a_shell_reads(shell: str, capsys: Said) -> None:
    assert completion.command(args(shell=shell)) == 0
    text = capsys.readouterr().out
    assert {"bash": "complete ", "zsh": "compdef", "fish": "complete -c vaneloop"}[shell] in text
    for name in main.COMMANDS:
        assert name in text
    assert "--tolerance" in text or "tolerance" in text
