"""Every command in this process: the options that it takes, what it prints and writes, and the exit code, held against
the texts that were approved (`tests/page_outline.py`). What takes long is stood in for by answers made by hand.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest

from hil.calibrate.prepare import AtOnce
from hil.logs import Channel, write_log
from hil.loop.node import Node
from hil.loop.realtime import Lateness
from plant import build_plant
from tests.page_outline import approve, digest
from tests.test_page_outlines import TESTED, diagnosis, fit_of, group, learned, requirement, stage, surface
from tests.test_web_pages_spec import links
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path
from vaneloop.base.version import installed_version
from vaneloop.cli import (
    ahead,
    attended,
    campaign,
    chains,
    clearance,
    compare,
    completion,
    demo,
    engine_test,
    experiment,
    export_fmu,
    fleet,
    inject,
    main,
    new_controller,
    options,
    record,
    replay,
    run,
    schedule,
    station,
    strategies,
)
from vaneloop.cli import map as of_map
from vaneloop.cli.options import ControllerFailed
from vaneloop.design.strategies import FIGURES
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.regimes import locate
from vaneloop.identification.vane_chain.experiment import HEADS
from vaneloop.pages.page import Page

COMMANDS = [n for n in main.COMMANDS if n != "web"]


# ---- what is taken ---------------------------------------------------------------------------------------------------


def taken(parser: argparse.ArgumentParser, at: str = "") -> Iterator[str]:
    """Each option and place of a command, and of its parts."""
    for section in parser._action_groups:
        for a in section._group_actions:
            if isinstance(a, argparse._SubParsersAction):
                yield f"{at}{a.dest}: parts, required {a.required}, by {a._parser_class.__name__}"
                for name, part in a.choices.items():
                    yield f"{at}{name}:"
                    yield from taken(part, f"{at}  ")
                continue
            kind = getattr(a.type, "__name__", a.type)
            about = re.sub(r"\s+", " ", (a.help or "").replace("%(default)s", str(a.default)))
            yield (
                f"{at}[{section.title}] {' '.join(a.option_strings) or a.dest}: {type(a).__name__} of {kind}, "
                f"nargs {a.nargs}, default {a.default!r}, const {a.const!r}, choices {a.choices}, "
                f"required {a.required}, {a.metavar}; {about}"
            )


def test_options_of_every_command() -> None:
    out = []
    for name in COMMANDS:
        module = importlib.import_module(main.COMMANDS[name][0])
        parser = terminal.Parser(prog=name)
        module.add_options(parser)
        out += [f"# {name}", *taken(parser), f"defaults {parser._defaults}", f"epilog {parser.epilog}"]
    text = "\n".join(out) + "\n"
    approve("cli_options", text.replace(str(Path.home()), "~"))


# ---- what is said ----------------------------------------------------------------------------------------------------


def short(value: Any, at: str = "") -> Iterator[str]:
    """A JSON, a line each value."""
    if isinstance(value, dict):
        for k, v in value.items():
            yield from short(v, f"{at}.{k}" if at else k)
        if not value:
            yield f"{at} {{}}"
    elif isinstance(value, list):
        if value and all(isinstance(v, int | float | None) and not isinstance(v, bool) for v in value):
            yield f"{at} {digest(value)}"
        elif len(value) > 12:
            yield f"{at} {len(value)} entries"
            yield from short(value[0], f"{at}[0]")
            yield from short(value[-1], f"{at}[-1]")
        else:
            for k, v in enumerate(value):
                yield from short(v, f"{at}[{k}]")
            if not value:
                yield f"{at} []"
    else:
        yield f"{at} {value:.6g}" if isinstance(value, float) else f"{at} {value!r}"


CLOCKED = [  # how long it took is another each time, and what rounding leaves on each processor
    (r"(simulated in|repeated in|of computing|searched in) [\d,.]+ s", r"\1 … s"),
    (r"\([\d,]+ times real time\)", "(… times real time)"), (r", [\d.]+ s of computing", ", … s of computing"),
    (r"[\d.]+ s \([\d,]+/s\)", "… s (…/s)"), (r"(state.hash:? )'?[0-9a-f]{8,}'?", r"\1…"),
    (r' time="\d+\.\d{3}"', ' time="…"'), (r"(wall_s|elapsed_s|grown_mb) [\d.e-]+", r"\1 …"),
    (r"grown by -?[\d.]+ MB", "grown by … MB"), (r"s simulated in [\d.]+ s", "s simulated in … s"),
    (r"-?\b[\d.]+e-1\d\b", "0"),
]  # fmt: skip


class Ran:
    """Commands of one test: what was typed, said, written and returned."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
        self.folder, self.monkeypatch, self.capsys = folder, monkeypatch, capsys
        self.out: list[str] = []
        self.pages: list[str] = []
        monkeypatch.chdir(folder)
        monkeypatch.setenv("COLUMNS", "220")

        def write(page: Page, path: str | Path) -> Path:
            self.pages.append(f"page {path}: {page.title}; {page.facts.get('command')}; {len(page.figures)} figures")
            return Path(path)

        monkeypatch.setattr(Page, "write", write)

    def __call__(self, *words: str, files: tuple[str, ...] = ()) -> int:
        """Run one command; note all of it."""
        self.monkeypatch.setattr(sys, "argv", ["vaneloop", *words])
        self.capsys.readouterr()
        try:
            code = main.main(list(words))
        except SystemExit as e:
            code = int(e.code or 0)
        said = self.capsys.readouterr()
        self.out += ["", f"$ vaneloop {' '.join(words)}"]
        lines = [re.sub(r"[\s─╷╵┃│╶╴]+", " ", line).strip() for line in said.out.splitlines()]
        self.out += [x for x in lines if not re.match(r"compiling .*\(once, about", x)]  # where nothing is compiled yet
        self.out += [f"! {line}" for line in said.err.splitlines()]
        self.out += self.pages
        self.pages.clear()
        if (data := self.folder / "j.json").exists():
            self.out += [f"  {line}" for line in short(json.loads(data.read_text()))]
            data.unlink()
        for f in files:
            text = (self.folder / f).read_text(errors="replace")
            self.out += [f"file {f}: {len(text.splitlines())} lines", *(f"  {x}" for x in text.splitlines()[:12])]
        self.out.append(f"exit code {code}")
        return code

    def text(self) -> str:
        """All of it."""
        text = "\n".join(line.rstrip() for line in self.out if line.strip(" -")) + "\n"
        for pattern, by in CLOCKED:
            text = re.sub(pattern, by, text)
        return text.replace(str(self.folder), "FOLDER")


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ran:
    return Ran(tmp_path, monkeypatch, capsys)


@pytest.fixture
def log(tmp_path: Path) -> str:
    """A short log of the machine."""
    t = np.arange(0.0, 12.0, 0.05)
    columns = {
        "n_dem": 70.0 + 8.0 * np.sin(t),
        "n_r": 70.0 + 8.0 * np.sin(t - 0.1),
        "x_lvdt": 20.0 + 3.0 * np.sin(t - 0.2),
    }
    write_log(tmp_path / "run.csv", {k: Channel(t, v) for k, v in columns.items()})
    return "run.csv"


J = ("--json", "j.json")
OWN = """
from vaneloop import System
system = System(
    "a", "static", lambda u, p: u.u, inputs={"u": "V"}, outputs={"y": "V"}, parameters=[], places=["y"],
)
"""


def test_the_loop_in_simulated_time(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(time_ns=lambda: 1_700_000_000_123_456_789, perf_counter=time.perf_counter)
    monkeypatch.setattr("vaneloop.cli.run.time", clock)
    key = ran.folder / "key"
    key.write_text("00112233445566778899aabbccddeeff")
    key.chmod(0o600)
    assert ran("run", "--bus", "lockstep", "--profile", "slam", "--duration", "3", "--record", "a.log", *J) == 0
    assert ran("run", "--bus", "lockstep", "--inputs", "a.log", "--record", "b.log", *J) == 0
    assert (ran.folder / "a.log").read_text() == (ran.folder / "b.log").read_text()
    assert ran("run", "--bus", "lockstep", "--inputs", "a.log", "--duration", "2", *J) == 0
    assert ran("run", "--bus", "lockstep", "--inputs", "a.log", "--xcp", "--xcp-open", *J) in (0, 1)
    assert ran("run", "--bus", "lockstep", "--inputs", "a.log", "--start-speed", "70", *J) == 1
    assert ran("run", "--bus", "lockstep", "--inputs", "a.log", "--seed", "3", "--quiet") == 1
    assert (
        ran("run", "--bus", "lockstep", "--duration", "1", "--secoc", "key", "--record", "s.log", "--seed", "2", *J)
        == 0
    )
    assert ran("run", "--bus", "lockstep", "--inputs", "s.log", "--secoc", "key", "--seed", "2", *J) == 0
    assert ran("run", "--bus", "lockstep", "--inputs", "s.log") == 2
    assert ran("run", "--bus", "lockstep", "--inputs", "a.log", "--secoc", "key") == 2
    lines = (ran.folder / "a.log").read_text().splitlines()
    (ran.folder / "cut.log").write_text("\n".join(lines[:-40]) + "\n")
    (ran.folder / "heard.log").write_text("\n".join(x for x in lines if x.split()[2].startswith("0A0")) + "\n")
    ran("run", "--bus", "lockstep", "--inputs", "cut.log", *J)
    ran("run", "--bus", "lockstep", "--inputs", "heard.log", *J)
    assert ran("run", "--bus", "lockstep", "--duration", "0.5", "--record", "a.log") == 0
    approve("cli_run", re.sub(r"(it is now \S+?)[\d-]{6,}\S*", r"\1…", ran.text()))


@pytest.mark.parametrize(
    "words",
    [
        ["--limit-late-us", "-1"], ["--limit-share", "100"], ["--limit-share", "-1"], ["--start-speed", "121"],
        ["--start-speed", "-1"], ["--seed", "-1"], ["--plant-map", "A=n_r"], ["--bus", "local:x", "--profile", "ramp"],
        ["--bus", "lockstep", "--limit-late-us", "5"], ["--bus", "lockstep", "--profile", "a", "--log", "b.csv"],
        ["--plant", "x.FMU", "--model", "m.toml"], ["--bus", "local:x", "--inputs", "a.log"], ["--record", "a.xyz"],
        ["--spin-us", "-1"], ["--realtime-priority", "0"], ["--duration", "1.1e7"], ["--xcp-open"], ["--xcp-lock"],
        ["--tool-seed", "9223372036854775808", "--xcp"], ["--bus", "lockstep", "--uds"], ["--dbc", "x.dbc"],
    ],
)  # fmt: skip
def test_what_a_run_does_not_take(ran: Ran, words: list[str]) -> None:
    assert ran("run", *words) == 2
    (line,) = [x for x in ran.out if x.startswith("! ")]
    option = next(w for w in words[::-1] if w.startswith("--"))
    said = {
        "--log": "--inputs, --profile and --log",
        "--uds": "--uds needs a bus",
        "--record": "a.xyz",
        "--xcp": "--tool-seed",
    }
    assert said.get(option, option) in line


def test_faults_and_attacks(ran: Ran) -> None:
    assert ran("inject", "--list", *J) == 0
    assert ran("inject", "demand_stops", "--junit", "j.xml", *J, files=("j.xml",)) == 0
    assert ran("inject", "demand_gap_40ms", "lvdt_jumps", "--seed", "3", *J) == 0
    assert ran("inject") == 2 and ran("inject", "demand_stops", "--all") == 2
    assert ran("inject", "demand_stops", "--seed", "-1") == 2
    assert ran("inject", "demand_stops", "--bus", "local:x", "--model", "m.toml") == 2
    assert ran("inject", "demand_stops", "--bus", "local:x", "--reactions", "m.toml") == 2
    assert ran("inject", "demand_stops", "--save-crash", "c.parquet") == 2
    (ran.folder / "strict.toml").write_text(
        (Path(main.__file__).parents[2] / "hil/inject/scenarios/demand_stops.toml")
        .read_text()
        .replace("0.06", "0.0001")
    )
    ran("inject", "strict.toml", "demand_stops", "--junit", "j.xml", *J)
    assert ran("fuzz", "--frames", "3000", "--seed", "5", *J) == 0
    (ran.folder / "none.log").write_text("(0.000000) vcan0 0A0#0102030405060708\n")
    ran("fuzz", "--replay", "none.log", *J)
    ran("fuzz", "--replay", "none.log", "--stroke-limit", "0.001", *J)
    ran(
        "fuzz", "--frames", "500", "--current-limit", "0.001", "--recovery", "2", "--out", "f.log", *J, files=("f.log",)
    )
    approve("cli_inject", ran.text())


def test_a_run_is_replayed(ran: Ran, log: str) -> None:
    assert ran("replay", log, "--report", "p.html", "--out", "model.csv", *J, files=("model.csv",)) == 0
    assert ran("replay", log, "--tolerance", "x_lvdt=0.001", "--strategy", "single", "--out", "m.blf", *J) == 1
    assert ran("replay", log, "--tolerance", "x_lvdt.max_abs=50", "--quiet") == 0
    assert ran("replay", log, "--strategy", "none") == 2
    own = ran.folder / "tables"
    own.mkdir()
    (own / "calibration.toml").write_text(path("calibration.toml").read_text(encoding="utf-8"))
    assert ran("replay", log, "--tables", "tables", "--quiet") == 0 and ran("replay", log, "--tables", "tables") == 0
    approve("cli_replay", ran.text())


def test_clearances_of_the_joints(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    studied = clearance.clearance_study
    asked: list[Any] = []
    found: list[Any] = []

    def study(geometry: Any, stage: str, *more: Any) -> Any:
        asked.append((stage, more))
        found.append(studied(geometry, stage, *more) if len(found) < 3 else found[-3])
        return found[-1]

    monkeypatch.setattr(clearance, "clearance_study", study)
    ran("clearance", "--ring", "0.3", "--report", "p.html", *J)
    ran("clearance", "--width", "vigv=2", "--vane", "90", "--quiet", *J)
    assert ran("clearance", "--vane", "-360", "--width", "vgv1=10", "--crank-link", "0") == 0
    ran.out += [str(a) for a in asked]
    for words in (["--vane", "361"], ["--vane", "-361"], ["--width", "vigv=11"], ["--width", "vigv=x"],
                  ["--ring", "-1"],
                  ["--width", "x=1"], ["--crank-link", "-1"]):  # fmt: skip
        assert ran("clearance", *words) == 2
    approve("cli_clearance", ran.text())


def test_the_mechanism_in_space(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "exudyn", None)  # an extra, which says what is left after rounding
    assert ran("spatial", "--points", "7", "--offset", "5", "--report", "p.html", *J) in (0, 1)
    assert ran("spatial", "--points", "5", "--limit", "0", "--quiet", *J) == 1
    assert ran("spatial", "--limit", "-0.1") == 2
    approve("cli_spatial", ran.text())


def test_an_engine_is_scheduled(ran: Ran) -> None:
    some = ("--lb-range", "0.5", "--lc-range", "0.5")
    assert ran("schedule", *some, "--out", "engine", "--report", "p.html", *J) == 0
    assert ran("schedule", *some, "--adjust", "lb", "--criterion", "max", "--quiet") == 0
    ran("schedule", "--adjust", "none", "--limit", "0.001")
    for words in (["--step", "0"], ["--adjust", "ld"], ["--lb-range", "101"], ["--map", "A=vigv"]):
        assert ran("schedule", *words) == 2
    approve("cli_schedule", ran.text())


def test_files_of_a_machine(ran: Ran) -> None:
    assert ran("design", "--kp", "-1") == 2 and ran("design", "--ki", "1.1e6") == 2
    ran("a2l", "--out", "f.a2l", *J, files=("f.a2l",))
    assert ran("new-controller", "mine", *J) == 0 and ran("new-controller", "mine") == 2
    (ran.folder / "file").write_text("x")
    (ran.folder / "empty").mkdir()
    assert ran("new-controller", "file") == 2 and ran("new-controller", "empty", "--quiet") == 0
    approve("cli_files", ran.text())


def test_names_of_a_log(ran: Ran, log: str) -> None:
    (ran.folder / "odd.csv").write_text("t,N,x_dem,x_lvdt,other\n" + "".join(
        f"{0.1 * k:.1f},{60 + k % 7},{20 + k % 5},{20.5 + k % 5},{k}\n" for k in range(50)))  # fmt: skip
    lag = ("--formula", "lag = x_dem - x_lvdt [mm]")
    ran("map", "odd.csv", "--map", "N=n_dem", *lag, "--export", "lag.csv", "--between", "1:2", *J, files=("lag.csv",))
    ran("map", "odd.csv", "--map", "N=n_dem", "--out", "bench.toml", *J, files=("bench.toml",))
    ran("map", "odd.csv", "--mapping", "bench.toml", "--no-guess")
    ran("map", log, "--export", "all.csv", "--quiet")
    assert ran("map", log, "--between", "1:2") == 2 and ran("map", log, "--formula", "x = (") == 2
    (ran.folder / "none.csv").write_text("a,b\n1,2\n2,3\n")
    assert ran("map", "none.csv", *lag, "--export", "x.csv", *J) == 2
    (ran.folder / "none.csv").write_text("t,b\n1,2\n2,3\n")
    assert ran("map", "none.csv", *lag, "--export", "x.csv", *J) == 1 and not (ran.folder / "x.csv").exists()
    (ran.folder / "own.py").write_text(OWN)
    ran("map", "odd.csv", "--system", "own.py", "--map", "N=u", "--map", "other=y", *J)
    approve("cli_map", ran.text())


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_script_for_a_shell(shell: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a few commands: one that takes a log, one of parts, one that takes words, one that cannot be imported."""

    few = {n: (main.COMMANDS[n][0], f"about '{n}'") for n in ("extend", "fleet", "inject", "ecu", "completion")}
    monkeypatch.setattr(completion, "COMMANDS", {**few, "web": ("vaneloop.no.such.module", "not there")})
    monkeypatch.setattr(completion, "suffixes", lambda: (".csv", ".mf4"))
    monkeypatch.setattr(completion, "EFFECTS", {"grip": 1, "more": 2})
    monkeypatch.setattr("hil.inject.library", lambda: {"demand_stops": 1, "bad_day": 2})
    assert main.main(["completion", shell]) == 0
    approve(f"cli_completion_{shell}", capsys.readouterr().out)
    assert main.main(["completion", "bsh"]) == 2
    assert "'bsh' is not a shell" in capsys.readouterr().err


def test_the_program_s_own_words(ran: Ran) -> None:
    assert ran() == 2 and ran("--help") == 0 and ran("help") == 0 and ran("-h") == 0 and ran("--version") == 0
    assert ran("diagnoze") == 2 and ran(next(iter(main.IN_CHECKOUT)).split()[0]) == 2

    approve("cli_main", ran.text().replace(installed_version(), "VERSION"))


# ---- what the search says --------------------------------------------------------------------------------------------


def chain(notes: tuple[str, ...] = ("read at 20 Hz",)) -> Any:
    return SimpleNamespace(stages=[], not_observed={"servo": "no i_cmd"}, notes=list(notes))


class Answered:
    """In place of an answer of `vaneloop.verbs`."""

    def __init__(self, **more: Any):
        self.by_log, self.tested, self.held, self.path, self.bound = None, [], None, "", chain()
        vars(self).update(more)

    def sentence(self) -> str:
        return "So it is."

    def to_dict(self) -> dict[str, Any]:
        return {"answer": 1, "tested": "t", "whole": "w"}

    def report(self, path: str, words: str = "") -> str:
        return f"{path} of {words}"

    def write(self, path: str) -> None:
        Path(path).write_text("model")

    def write_python(self, path: str, system: Any) -> None:
        Path(path).write_text("code")


def located() -> list[Any]:
    fails, fits = stage(), stage("linkage")
    floor = np.array([0.05, 0.2])
    first = locate(LeastSquaresProblem(fails, floor), fit_of(fails, (1.02, 0.0, 0.0)))
    return [replace(first, onset=31.4), locate(LeastSquaresProblem(fits, floor), fit_of(fits, (1.02, 0.5, 0.0)))]


def test_what_the_search_finds_is_printed(ran: Ran, log: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from vaneloop.cli import compare, diagnose, experiment, extend, learn, locate

    asked: list[Any] = []

    def noted(name: str, answer: Any) -> Callable[..., Any]:
        def call(*given: Any, **more: Any) -> Any:
            plain = [g for g in given if isinstance(g, str | int | list | tuple)]
            asked.append((name, plain, {k: v for k, v in more.items() if not callable(v) and v is not None}))
            return answer

        return call

    modules = (compare, diagnose, experiment, extend, learn, locate)
    for m in modules:
        monkeypatch.setattr(
            m, "chain_of", lambda args, model=None, loop=False, alone="": asked.append(("chain", loop)) or chain()
        )
    monkeypatch.setattr(
        "vaneloop.cli.replay.replayed", lambda args, *more: asked.append(("replayed", args.report, more)) or 0
    )
    stages = Answered(located=located(), fails=True, tested=TESTED, held=SimpleNamespace(failing=["the whole log: x"]))
    monkeypatch.setattr(compare, "compared", noted("compare", stages))
    monkeypatch.setattr(locate, "compared", noted("locate", stages))
    ran("compare", log, "--report", "p.html")
    ran("compare", log, "--quiet")
    ran("locate", log, "--report", "p.html", *J)
    d, _ = diagnosis()
    d.stages[1].nearest, d.stages[1].refused = ["grip"], ["it degrades"]
    d = replace(d, notes=["read at 20 Hz", "the log is short"])
    found = Answered(diagnosis=d, verdict="unknown", tested=TESTED)
    monkeypatch.setattr(diagnose, "diagnosed", noted("diagnose", found))
    monkeypatch.setattr(diagnose, "not_given", lambda chain, without: asked.append(("without", without)) or chain)
    assert ran("diagnose", log, "--report", "p.html", "--workers", "3", "--without", "a", "b", *J) == 1
    found.verdict = "none"
    assert ran("diagnose", log, "--quiet") == 0
    model = SimpleNamespace(noted=lambda words: ("noted", words))
    monkeypatch.setattr(extend, "with_law_files", lambda wanted, machine: (wanted, SimpleNamespace(curves={"mine": 1})))
    monkeypatch.setattr(extend, "known", lambda names: asked.append(("known", names)))
    monkeypatch.setattr(extend, "replace", lambda answer, **more: vars(answer).update(more) or answer)
    extended = Answered(diagnosis=d, refused="", model=model, reached=True, tested=TESTED)
    monkeypatch.setattr(extend, "extended", noted("extend", extended))
    assert (
        ran(
            "extend",
            log,
            "--effect",
            "grip",
            "more",
            "--effect",
            "grip",
            "mine",
            "--out",
            "m.toml",
            "--report",
            "p.html",
            *J,
        )
        == 0
    )
    asked.append(("noted", extended.model[1]))
    extended.reached, extended.model = False, model
    assert ran("extend", log, "--effect", "grip", "--out", "m.toml", "--quiet") == 1
    extended.refused = "it is no better"
    assert ran("extend", log, "--effect", "grip", "--out", "n.toml") == 1 and not (ran.folder / "n.toml").exists()
    assert ran("extend", log, "--out", "n.toml") == 2
    laws = Answered(laws=[learned(), surface()], notes=["a note"], outcome=SimpleNamespace(nearest=["x"]), explained={},
                    verdict="learned", model=1)  # fmt: skip
    monkeypatch.setattr(learn, "learned", noted("learn", laws))
    monkeypatch.setattr(learn, "not_given", lambda chain, without: chain)
    monkeypatch.setattr(
        learn, "with_path", lambda answer, path, words: vars(answer).update(path=path) or asked.append(words) or answer
    )
    assert (
        ran("learn", log, "--out", "l.toml", "--python", "l.py", "--report", "p.html", "--shape", "odd", "--curve", *J)
        == 1
    )
    laws.laws, laws.verdict, laws.path = [], "none", ""
    assert ran("learn", log) == 0
    laws.verdict = "unknown"
    assert ran("learn", log, "--quiet") == 1
    table = [{"profile": "stairs", "nats": 40.0, "spreads": 9.5, "repeats": 1}]
    plan: dict[str, Any] = {"text": "Move.", "t": np.arange(200.0) * 0.1, "separates": True, "table": table,
                            "heads": HEADS, "inputs": {"n_dem": ("%", 60.0 + np.arange(200.0) * 0.1)}}  # fmt: skip
    run = Answered(recommended=plan)
    monkeypatch.setattr(experiment, "diagnosed", noted("diagnosed", found))
    monkeypatch.setattr(experiment, "recommend", noted("experiment", run))
    assert ran("experiment", log, "--out", "n.csv", "--report", "p.html", *J, files=("n.csv",)) == 0
    plan["separates"] = False
    assert ran("experiment", log, "--out", "no.csv") == 1 and not (ran.folder / "no.csv").exists()
    run.recommended = None
    assert ran("experiment", log, "--out", "no.csv") == 0
    assert ran("experiment", log, "--rate", "a=1") == 2 and ran("experiment", log, "--seconds", "1") == 2
    ran.out += [str(a) for a in asked]
    approve("cli_search", re.sub(r"array\([^)]*\)|<[^<>]* at 0x[0-9a-f]+>|StageFigures\([^)]*\)", "…", ran.text()))


def test_the_limits_of_a_run_of_one_s_own(tmp_path: Path) -> None:
    def of(**more: Any) -> Any:
        return experiment._limits(argparse.Namespace(**{"limit": [], "rate": [], "seconds": None} | more))

    made = of(limit=["pump=0:8", "level=-2:60"], rate=["pump=0.5"], seconds="30")
    assert made == experiment.Limits({"pump": (0.0, 8.0), "level": (-2.0, 60.0)}, {"pump": 0.5}, 30.0)
    assert of().seconds is None
    for bad, why in (
        ({"limit": ["a=1"]}, "--limit a=1: must be NAME=LOW:HIGH, two numbers"),
        ({"limit": ["a=2:2"]}, "--limit a=2:2: the low end must be below the high one, both finite"),
        ({"limit": ["a=0:inf"]}, "--limit a=0:inf: the low end must be below the high one, both finite"),
        ({"rate": ["a=0"]}, "--rate a=0: must be a number above 0"),
        ({"rate": ["a=x"]}, "--rate a=x: must be a number above 0"),
        ({"seconds": "inf"}, "--seconds inf: must be a number above 0"),
        ({"seconds": "-1"}, "--seconds -1: must be a number above 0"),
    ):  # fmt: skip
        with pytest.raises(InputError) as e:
            of(**bad)
        assert str(e.value) == why
    drives = {
        "t": np.array([0.0, 0.5]),
        "inputs": {"u": ("V", np.array([1.0, 2.5])), "v": ("V", np.array([0.1, 1e-7]))},
    }
    experiment._write(tmp_path / "n.csv", drives)  # type: ignore[arg-type]
    assert (tmp_path / "n.csv").read_text() == "t,u,v\n0,1,0.1\n0.5,2.5,1e-07\n"
    with pytest.raises(InputError, match="must end with .csv, with --system"):
        experiment._write(tmp_path / "n.blf", drives)  # type: ignore[arg-type]


# ---- on a bus --------------------------------------------------------------------------------------------------------


def reported(**more: Any) -> Any:
    """What a loop in real time reports."""
    begin, end, work = Lateness(), Lateness(), Lateness()
    for k in range(3000):
        begin.add(5_000 + 17 * k, k)
        end.add(90_000 + k, k)
        work.add(40_000 + 3 * k, k)
    begin.add(2_500_000, 1234)
    known = {"begin": begin, "end": end, "work": work, "ticks": 3000, "missed": 2, "skipped": 1, "pauses": 1,
             "dropped": 4, "wall_s": 3.0, "started_ns": 1_700_000_000_000_000_000, "failed": "", "ended": "SIGINT",
             "received": 300, "sent": 601}  # fmt: skip
    return SimpleNamespace(**known | more)


class Port:
    """In place of a port."""

    def __init__(self, bus: Any):
        self.refused, self.lost, self.errors = 3, 4, 5


def on_a_bus(monkeypatch: pytest.MonkeyPatch, module: str, report: Any, live: list[str]) -> list[Any]:
    """A loop in real time that reports at once; what it was given."""
    given: list[Any] = []

    @contextmanager
    def joined(name: str, priority: Any = None, **more: Any) -> Iterator[Any]:
        given.append(("joined", name, priority, sorted(more)))
        yield SimpleNamespace()

    @contextmanager
    def undisturbed(args: Any) -> Iterator[list[str]]:
        yield ["memory is not locked"]

    def run(node: Any, port: Any, **more: Any) -> Any:
        ticker = more["ticker"]
        given.append((type(node).__name__, more.get("ticks"), ticker.spin, ticker.policy, more.get("put") is not None,
                      more["live"] is not None))  # fmt: skip
        nothing = np.zeros((1, 2), np.int64)
        for k in range(30):
            node.tick(nothing, 0)
            more["watch"](k)
        if more["live"]:
            more["live"](report)
        return report

    class Live:
        def __init__(self, args: Any):
            self.on = args.live

        def say(self, text: str) -> None:
            live.append(text)

        def close(self) -> None:
            live.append("closed")

    station = "vaneloop.cli.station"
    monkeypatch.setattr(f"{station}.joined", joined)
    monkeypatch.setattr(f"{station}.undisturbed", undisturbed)
    monkeypatch.setattr(f"{station}.Live", Live)
    monkeypatch.setattr(f"{module}.Port", Port)
    monkeypatch.setattr(f"{module}.run_realtime", run)
    return given


def test_the_controller_in_real_time(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    report, live = reported(), []
    given = on_a_bus(monkeypatch, "vaneloop.cli.run", report, live)

    class Recorder:
        def __init__(self, path: str, name: str):
            given.append(("recorder", path, name))
            self.kept, self.error, self.lost, self.frames = "old.log", "", 0, 901

        put = close = lambda self, *_: None

    monkeypatch.setattr("vaneloop.cli.station.RecorderProcess", Recorder)
    bus = ("run", "--bus", "local:x")
    assert ran(*bus, "--duration", "3", "--record", "r.log", "--live", "--spin-us", "20", "--policy", "skip", *J) == 0
    Recorder.put = lambda self, *_: None  # type: ignore[method-assign]
    assert ran(*bus, "--limit-late-us", "2499", *J) == 1 and ran(*bus, "--limit-late-us", "2500", "--quiet") == 0
    assert ran(*bus, "--limit-late-us", "20", "--limit-share", "50", *J) == 1
    assert ran(*bus, "--limit-late-us", "20", "--limit-share", "80", "--quiet") == 0
    report.failed, report.ended, report.missed, report.pauses = "the bus is gone", "", 0, 0
    assert ran(*bus, "--realtime-priority", "5", "--xcp", "--xcp-open", "--tool-seed", "1", *J) == 1
    report.failed, report.ticks = "", 0
    assert ran(*bus, "--seed", "2") == 0
    recorder = SimpleNamespace(error="disk full", lost=0, frames=1)

    exceeded: list[str] = []
    args = argparse.Namespace(record="r.log", quiet=True, json=None)
    assert run._record_json(args, recorder, exceeded) == {"path": "r.log", "frames": 1, "lost": 0, "error": "disk full"}
    recorder.error, recorder.lost = "", 2
    run._record_json(args, recorder, exceeded)
    assert exceeded == ["the record is incomplete: disk full",
                        "the record is incomplete: the disk was too slow for 2 frames"]  # fmt: skip
    assert run._record_json(args, None, exceeded) is None
    ran.out += [str(g) for g in given] + live
    approve("cli_run_real", re.sub(r"\(\d\d:\d\d:\d\d\.\d{3}\)", "(time)", ran.text()))


def test_the_engine_in_real_time(ran: Ran, log: str, monkeypatch: pytest.MonkeyPatch) -> None:
    report, live = reported(), []
    given = on_a_bus(monkeypatch, "vaneloop.cli.ecu", report, live)
    monkeypatch.setattr("vaneloop.cli.ecu.terminal.input_of", lambda stream: None)
    bus = ("ecu", "--bus", "local:x")
    assert ran(*bus, "--profile", "staircase", "--live", "--seed", "1", *J) == 0
    assert ran(*bus, "--log", log, "--duration", "2", "--mode", "standby", *J) == 0
    assert ran(*bus, "--live") == 0
    report.ended = "no answer within 10 s"
    assert ran(*bus, "--profile", "idle", "--quiet", *J) == 1
    report.ended, report.failed = "done", "the bus is gone"
    assert ran(*bus, "--profile", "engine-test") == 1
    report.failed = ""
    (ran.folder / "p.toml").write_text("t = [0.0, 1.0]\nn_dem = [50.0, 60.0]\n")
    (ran.folder / "p.csv").write_text("t,n_dem\n0,50\n1,60\n")
    assert ran(*bus, "--profile", "p.toml") == 0 and ran(*bus, "--profile", "p.csv", "--no-guess") == 0
    for words in (["--timeout", "0"], ["--wait", "-1"], ["--seed", "-1"], ["--bus", "lockstep"],
                  ["--profile", "nobody"],
                  ["--profile", "p.toml", "--dbc", "x"], ["--profile", "absent.toml"]):  # fmt: skip
        assert ran("ecu", *words) == 2
    ran.out += [str(g) for g in given] + live
    approve("cli_ecu", ran.text())


def test_a_bus_is_recorded(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=10.0)
    said: list[str] = []
    lost = SimpleNamespace(n=0, fails=False)

    class Bus:
        left = 5

        def recv(self, timeout: float) -> Any:
            clock.now += timeout + 0.25
            if lost.fails:
                raise can.CanError("the bus is gone")
            if self.left <= 0:
                return None
            self.left -= 1
            return can.Message(timestamp=clock.now, arbitration_id=0x100 + self.left, data=[1, 2], is_extended_id=False)

    @contextmanager
    def joined(name: str, **more: Any) -> Iterator[Any]:
        said.append(name)
        yield Bus()

    class Live:
        def __init__(self, args: Any):
            pass

        def say(self, text: str) -> None:
            said.append(text)

        def close(self) -> None:
            said.append("closed")

    monkeypatch.setattr(record.station, "joined", joined)
    monkeypatch.setattr(record.station, "Live", Live)
    monkeypatch.setattr(record, "Port", lambda bus: SimpleNamespace(lost=lost.n))
    monkeypatch.setattr(record, "time", SimpleNamespace(monotonic=lambda: clock.now))
    assert ran("record", "a.log", "--bus", "local:x", "--duration", "4", *J, files=("a.log",)) == 0
    lost.n = 3
    assert ran("record", "b.log", "--bus", "local:x", "--duration", "1", "--quiet", *J) == 1
    lost.fails = True
    assert ran("record", "a.log", "--bus", "local:x", *J) == 1
    assert ran("record", "a.xyz") == 2
    ran.out += said
    approve("cli_record", re.sub(r"(it is now \S+?)[\d-]{6,}\S*", r"\1…", ran.text()))


# ---- what is compiled ahead, shown and begun -------------------------------------------------------------------------


def test_what_is_compiled_when_the_program_is_set_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "a" / "ahead"
    asked: list[Any] = []
    good = [True, True]
    monkeypatch.setattr(ahead, "AHEAD", place)

    def side_by_side(module: str, jobs: Any, folder: Path, environment: Any) -> bool:
        asked.append((module, list(jobs), folder.is_dir(), environment["NUMBA_CACHE_DIR"], "PATH" in environment))
        return good[len(asked) - 1]

    monkeypatch.setattr(ahead, "done_side_by_side", side_by_side)
    assert ahead.main([]) == 0
    both = [("vaneloop.cli.ahead", jobs, True, str(place), True) for jobs in (["simulator"], ["search", "bus"])]
    assert asked == both and (place / "done.txt").read_text() == ahead._what()
    out = capsys.readouterr().out
    assert out.startswith("[vaneloop] compiling for this machine") and "[vaneloop] compiled in 0 s\n" in out
    assert ahead.main([]) == 0 and len(asked) == 2 and capsys.readouterr().out == ""  # it is there
    (place / "done.txt").write_text("another Python")
    (place / "old").write_text("")
    good[0] = False
    asked.clear()
    assert ahead.main([]) == 1 and len(asked) == 1 and not (place / "old").exists()
    monkeypatch.setattr(ahead, "AHEAD", tmp_path / "file" / "ahead")
    (tmp_path / "file").write_text("")
    assert ahead.main([]) == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith("Not a directory; the first command will compile")
    ran: list[Any] = []
    monkeypatch.setattr(ahead, "JOBS", ({"one": ran.append}, {"two": lambda folder: ran.append((2, folder))}))
    enabled: list[int] = []
    monkeypatch.setattr(ahead.gc, "disable", lambda: enabled.append(1))
    assert ahead.main(["one", "f"]) == 0 and ahead.main(["two", "g"]) == 0
    assert ran == [Path("f"), (2, Path("g"))] and len(enabled) == 2


def test_jobs_are_done_side_by_side(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    begun: list[Any] = []

    class Popen:
        def __init__(self, words: list[str], **more: Any):
            begun.append((words[-2:], more["env"]))
            self.returncode = int(words[-2] == "bad")

        def communicate(self) -> Any:
            assert len(begun) == 2  # all have begun before one is waited for
            return None, f" {'x' * 400}why \n"

    monkeypatch.setattr(ahead.subprocess, "Popen", Popen)
    assert ahead.done_side_by_side("m", ["a", "b"], Path("f"), {"A": "1"}) is True
    assert begun == [(["a", "f"], {"A": "1"}), (["b", "f"], {"A": "1"})] and capsys.readouterr().out == ""
    begun.clear()
    assert ahead.done_side_by_side("m", ["bad", "b"], Path("f"), {}) is False
    assert capsys.readouterr().out == f"[vaneloop] bad: not compiled ahead: {'x' * 297}why\n"


def test_what_a_job_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wrote: list[Any] = []
    ran: list[Any] = []
    monkeypatch.setattr(ahead, "write_log", lambda path, columns: wrote.append((path, sorted(columns))))
    run = SimpleNamespace(t=np.arange(3.0), columns={k: np.arange(3.0) for k in ("t", "n_dem", "n_engine", "x_lvdt")})
    monkeypatch.setattr(ahead, "lockstep", lambda stimulus, seed: ran.append((len(stimulus.rows), seed)) or run)
    monkeypatch.setattr(ahead, "vaneloop", lambda words: ran.append(words) or 1)
    ticks: list[str] = []
    for name in ("Node", "Ecu"):
        made = SimpleNamespace(tick=lambda rows, n, name=name: ticks.append(f"{name} {rows.shape} {n}"))
        monkeypatch.setattr(ahead, name, lambda made=made: made)
    jobs = {k: v for entry in ahead.JOBS for k, v in entry.items()}
    jobs["simulator"](tmp_path)
    assert wrote == [(tmp_path / f"run.{s}", ["n_dem", "x_lvdt"]) for s in ("parquet", "blf")] and ran == [(4000, 1)]
    jobs["search"](tmp_path)
    jobs["bus"](tmp_path)
    assert ran[1:] == [["diagnose", str(tmp_path / "run.parquet"), "--quiet", "--workers", "1"],
                       ["replay", str(tmp_path / "run.blf"), "--quiet"]]  # fmt: skip
    assert ticks == ["Node (1, 2) 0", "Ecu (1, 2) 0"]
    monkeypatch.setattr(ahead, "vaneloop", lambda words: 2)
    for job in ("search", "bus"):
        with pytest.raises(AssertionError):
            jobs[job](tmp_path)


def test_the_demonstration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["demo"])
    codes: dict[str, int] = {}
    typed: list[list[str]] = []
    found = ["dead_band", "load"]

    def vaneloop(words: list[str]) -> int:
        assert sys.argv == ["vaneloop", *words]
        typed.append(words)
        if words[0] == "diagnose":
            Path(words[words.index("--json") + 1]).write_text(json.dumps({"effects": [{"effect": e} for e in found]}))
        if "--report" in words:
            Path(words[words.index("--report") + 1]).write_text("page")
        return codes.get(words[0], 0)

    process = SimpleNamespace(stdout=["searched\n"], wait=lambda: codes.get("search", 0), ended=0)
    process.terminate = lambda: setattr(process, "ended", process.ended + 1)
    started: list[Any] = []
    monkeypatch.setattr(demo, "vaneloop", vaneloop)
    monkeypatch.setattr(demo.subprocess, "Popen", lambda words, **_: started.append(words) or process)
    monkeypatch.setattr(demo, "_shared_data", lambda: None)
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "diagnosis.html").write_text("old")
    assert demo.main([]) == 0
    example = Path(typed[0][1])
    assert [w[0] for w in typed] == ["replay", "engine-test"] and example.name == "engine_run.blf" and example.exists()
    assert Path(started[0][-1]).name == "hidden_effect.parquet" and process.ended == 1
    out = capsys.readouterr().out
    assert "searched\n" in out and "demo/engine_run.html" in out and "diagnosis.html" not in out.split("made, the")[1]
    assert "\n== The paper's engine test" in out and "$ vaneloop engine-test --report demo/engine_test.html" in out
    codes["search"] = 3
    assert demo.main([]) == 3 and process.ended == 2
    codes.clear()
    typed.clear()
    assert demo.main(["log.parquet"]) == 0
    assert [w[0] for w in typed] == ["compare", "locate", "diagnose", "extend", "compare"]
    assert typed[3][1:] == ["log.parquet", "--effect", "dead_band", "--effect", "load", "--out", "demo/extended.toml",
                            "--report", "demo/extended.html"]  # fmt: skip
    assert typed[4][1:] == ["log.parquet", "--model", "demo/extended.toml"]
    codes.update(dict.fromkeys(("compare", "locate", "diagnose", "extend"), 1))
    found.clear()
    typed.clear()
    assert demo.main(["log.parquet"]) == 0 and [w[0] for w in typed] == ["compare", "locate", "diagnose"]
    found.append("load")
    for command, allowed in (("compare", 1), ("locate", 1), ("diagnose", 1), ("extend", 1)):
        codes[command] = 2
        with pytest.raises(SystemExit) as e:
            demo.main(["log.parquet"])
        assert e.value.code == 2 and "stopped: exit code 2" in capsys.readouterr().err
        codes[command] = allowed
    codes["replay"] = 1
    with pytest.raises(SystemExit):
        demo.main([])
    assert process.ended == 3
    codes.clear()
    typed.clear()
    monkeypatch.setattr(demo, "_shared_data", lambda: tmp_path / "data")
    demo._simulate("e.blf")
    folder = "data/can_honda"
    assert typed[1] == ["replay", f"{folder}/revlog.log", "--dbc", f"{folder}/honda_pilot_2017.dbc", "--map",
                        "ENGINE_RPM=n_dem", "--unit", "n_dem=rpm", "--design-rpm", "6000", "--report",
                        "demo/real_engine.html"]  # fmt: skip


def test_real_logs_are_found_where_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "ROOT", tmp_path / "product")
    monkeypatch.delenv("VANELOOP_DATA", raising=False)
    assert demo._shared_data() is None
    beside = tmp_path / "shared" / "data"
    own = tmp_path / "own"
    for place in (beside, own):
        (place / "can_honda").mkdir(parents=True)
        (place / "can_honda" / "revlog.log").write_text("")
    assert demo._shared_data() == beside
    monkeypatch.setenv("VANELOOP_DATA", str(own))
    assert demo._shared_data() == own


def test_the_program_is_entered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "is_command", False)
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    monkeypatch.setattr(sys, "argv", ["vaneloop", "--version"])
    monkeypatch.setattr(main, "main", lambda words: 7 if words == ["--version"] else 0)
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with pytest.raises(SystemExit) as e:
        main.run()
    assert e.value.code == 7 and terminal.is_command is True

    assert os.environ["OPENBLAS_NUM_THREADS"] == "1" and type(sys.meta_path[0]).__name__ == "_CanWithoutMdf"
    finder = main._CanWithoutMdf()
    assert finder.find_spec("asammdf") is None and finder.find_spec("other") is None
    asks = SimpleNamespace(__spec__=SimpleNamespace(_initializing=True))
    monkeypatch.setitem(sys.modules, "can.io.mf4", asks)  # type: ignore[arg-type]
    with pytest.raises(ImportError, match="not for python-can"):
        finder.find_spec("asammdf")
    assert finder.find_spec("numpy") is None


# ---- fleets, campaigns, strategies -----------------------------------------------------------------------------------


def test_a_fleet_is_begun_worked_on_and_reported(ran: Ran, log: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.test_page_outlines import fleet as view_of

    asked: list[Any] = []

    class Folder:
        path, job, damaged = Path("RUN"), {"machine": "m"}, {"part-1": "cut"}  # noqa: RUF012

        def __init__(self, run: str = ""):
            asked.append(("folder", run))

        @classmethod
        def begin(cls, out: str, kind: Any, options: Any, files: Any) -> Any:
            asked.append(("begin", out, options, files))
            return cls(out)

        def add(self, logs: Any, again: Any) -> int:
            asked.append(("add", logs, sorted(again)))
            return 2

        def chunks(self) -> list[str]:
            return ["a", "b", "c"]

        def finished(self) -> set[str]:
            return {"a"}

        def code(self) -> list[str]:
            return ["mine.py"]

    state = SimpleNamespace(came={"done": 1200}, done=1200, contents=2000, logs=3000, workers={"w": "slurm"},
                            damaged={}, json=lambda: {"done": 3})  # fmt: skip
    monkeypatch.setattr(fleet, "Folder", Folder)
    monkeypatch.setattr(fleet, "state_of", lambda folder: state)
    monkeypatch.setattr(fleet.state, "tidy", lambda folder: asked.append("tidy"))
    came = {"k1": "died", "k2": "done", "k3": "changed", "k4": "unreadable", "k5": "timeout", "k6": "defect"}
    monkeypatch.setattr(fleet.state, "came_to", lambda folder: came)
    monkeypatch.setattr(fleet.tables, "damaged", lambda folder: {"k7"})
    monkeypatch.setattr(fleet.sources, "find", lambda logs, engines: asked.append((logs, engines)) or ["x"] * 3)
    monkeypatch.setattr(fleet, "copies_of", lambda given: {"copies": sorted(given)})

    def rent(folder: Any, *given: Any) -> None:
        progress = given[4]
        progress(1, 0)
        asked.append(("rent", *[g for g in given if not callable(g)]))

    monkeypatch.setattr(fleet, "rent", rent)
    assert ran("fleet", "run", log, "--out", "RUN", *J) == 0
    assert ran("fleet", "run", log, log, "--out", "RUN", "--retry", "--on", "slurm", "--queue", "a=b", "--workers", "7",
               "--limit", "5", "--patience", "30", "--engines", "e.csv", "--map", "A=n_dem", "--plant",
               "plant_electromechanical.toml", "--quiet") == 0  # fmt: skip
    (ran.folder / "own.py").write_text(OWN)
    assert ran("fleet", "run", log, "--out", "RUN", "--system", "own.py", "--quiet") == 0
    for words in (["--workers", "0"], ["--workers", "10001"], ["--limit", "0"], ["--limit", "1.1e6"], ["--on", "moon"],
                  ["--system", "own.py", "--plant", "p.toml"], ["--system", "no.py"], ["--patience", "0.4"],
                  ["--queue", "x"], ["--plant", "p.toml"]):  # fmt: skip
        assert ran("fleet", "run", log, "--out", "RUN", *words) == 2
    monkeypatch.setattr(fleet, "work", lambda run, **more: asked.append(("work", run, more)) or {"done": 3, "died": 1})
    assert ran("fleet", "work", "RUN", "--trust", "--patience", "6") == 0 and ran("fleet", "work", "RUN") == 2
    monkeypatch.setattr(fleet, "work", lambda run, **more: {})
    assert ran("fleet", "work", "RUN", "--trust") == 0
    state.damaged = {"p": "cut"}
    assert ran("fleet", "status", "RUN", *J) == 1
    view = view_of()
    monkeypatch.setattr(fleet.tables, "roll_up", lambda folder: "db")
    monkeypatch.setattr(fleet.report, "limits_of", lambda path: {"limits": path})
    monkeypatch.setattr(fleet.report, "view_of", lambda *given: asked.append(("view", *given)) or view)
    monkeypatch.setattr(fleet.tables, "write_tables", lambda *given: asked.append(("tables", *given)))
    monkeypatch.setattr(fleet.tables, "answers", lambda folder, keys: dict.fromkeys(keys, 1))
    monkeypatch.setattr(fleet.report, "write_pages", lambda pages, said: asked.append(("pages", str(pages), len(said))))
    assert ran("fleet", "report", "RUN", "--report", "o/fleet.html", "--tables-out", "T", "--limits", "l.csv", *J) == 1
    monkeypatch.setattr(fleet.tables, "answers", lambda folder, keys: {})
    assert ran("fleet", "report", "RUN", "--report", "o/fleet.html", "--quiet") == 1
    many: dict[str, Any] = {"lacks": [], "outliers": view.outliers * 50, "series": view.series * 30, "coverage": []}
    view = view_of(**many)
    assert ran("fleet", "report", "RUN") == 1
    view = view_of(lacks=[], outliers=[], series=[], coverage=[])
    assert ran("fleet", "report", "RUN", "--quiet") == 0
    ran.out += [str(a) for a in asked]
    approve("cli_fleet", re.sub(r"(/\S+)+/(plant_\w+\.toml)", r"\2", ran.text()))


def test_a_campaign_is_run(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.test_page_outlines import campaign as view_of

    asked: list[Any] = []
    folder = SimpleNamespace(
        damaged={"p": "cut"}, chunks=lambda: ["a"], finished=lambda: set(done), job={"machine": "m"}
    )
    done: list[str] = []
    plan = SimpleNamespace(firmware=[SimpleNamespace(controller="own.so"), SimpleNamespace(controller=None)], search=16)
    view = view_of([group(), group("stop.soft.mine", failed=3, requirements=[requirement(held=False, broken=2)])])
    monkeypatch.setattr(campaign, "Folder", SimpleNamespace)
    monkeypatch.setattr(campaign, "load_plan", lambda path: plan)
    monkeypatch.setattr(campaign.campaign, "begin", lambda *given: asked.append(given) or (plan, "q", folder))
    monkeypatch.setattr(campaign.campaign, "take_samples", lambda *given: 12)
    searches = [4]
    monkeypatch.setattr(campaign.campaign, "take_searches", lambda *given: searches[0])
    monkeypatch.setattr(campaign.campaign, "judge", lambda plan, q, folder, tell: tell(0.5) or view)
    monkeypatch.setattr(campaign.state, "tidy", lambda folder: asked.append("tidy"))

    def rent(folder: Any, *given: Any) -> None:
        given[4](1, 0)
        asked.append(("rent", *[g for g in given if not callable(g)]))

    monkeypatch.setattr(campaign, "rent", rent)
    code = ran("campaign", "plan.toml", "--out", "RUN", "--trust", "--report", "c.html", "--junit", "c.xml", *J,
               files=("c.xml",))  # fmt: skip
    assert code == int(not all(view.passed(g) for g in view.groups))
    done.append("a")
    searches[0] = 0
    view = view_of([group()])
    assert (
        ran("campaign", "plan.toml", "--out", "RUN", "--trust", "--workers", "3", "--limit", "9", "--patience", "30")
        == 0
    )
    assert ran("campaign", "plan.toml", "--out", "RUN") == 2
    for words in (["--workers", "0"], ["--workers", "10001"], ["--limit", "0.0009"], ["--limit", "1.1e6"],
                  ["--on", "x"],
                  ["--patience", "0.4"], ["--patience", "1.1e5"], ["--queue", "x"]):  # fmt: skip
        assert ran("campaign", "plan.toml", "--out", "RUN", "--trust", *words) == 2
    ran.out += [str(a) for a in asked]
    approve("cli_campaign", ran.text())


def test_strategies_side_by_side(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    @dataclass
    class Failure:
        during: str
        failure: str
        at: float = 99.0
        step: float = 0.1
        departure: float = 0.2
        crossings: int = 3
        mean_abs: float = 0.4
        mean_abs_dual: float = 0.5

    def run(row: Any, n_dem: Any, calibration: Any, seed: int, base: Any) -> Any:
        asked.append(("run", row.name, len(n_dem), seed))
        figures = {"vigv": dict.fromkeys(FIGURES, 0.1 * len(asked))}
        return SimpleNamespace(scenario=row.name, strategy=names[calibration], figures=figures, travel=1.0, reversals=2,
                               current=3.0, to_dict=lambda: {"row": row.name})  # fmt: skip

    names: dict[str, str] = {}

    def machine_of(args: Any, strategy: str) -> Any:
        names[f"of {strategy}"] = strategy
        return SimpleNamespace(calibration=f"of {strategy}")

    rows = [SimpleNamespace(name=n) for n in ("nominal", "worn")]
    monkeypatch.setattr(strategies.options, "machine_of", machine_of)
    monkeypatch.setattr(strategies, "run", run)
    monkeypatch.setattr(strategies, "ThreadPoolExecutor", lambda n: contextlib.nullcontext(SimpleNamespace(map=map)))
    monkeypatch.setattr(strategies, "warm_up", lambda say: say("compiling"))
    monkeypatch.setattr(strategies, "build_plant", lambda *files: "plant")
    monkeypatch.setattr(
        strategies, "load_profile", lambda profile, dwell: asked.append((profile, dwell)) or np.zeros(1200)
    )
    monkeypatch.setattr(strategies, "scenarios", lambda *given: asked.append(given) or rows)
    monkeypatch.setattr(strategies, "FAILURES", ("stuck", "bias"))
    found = ["at rest"]
    monkeypatch.setattr(strategies, "moments", lambda n_dem: found)

    def failing(name: str, during: str, healthy: Any, dual: Any, *more: Any) -> Any:
        asked.append((name, during, healthy.strategy, dual.strategy, more[2:]))
        return Failure(during, name), healthy

    monkeypatch.setattr(strategies, "failing", failing)
    held = [True]
    monkeypatch.setattr(
        strategies,
        "judged",
        lambda rows, outcomes, failures, best: (
            asked.append(best)
            or [
                {"goal": "better", "value": 2.0, "limit": 1.5, "held": True},
                {"goal": "b", "value": 1.0, "limit": 2.0, "held": held[0]},
            ]
        ),
    )
    monkeypatch.setattr(
        strategies, "report", lambda path, rows, plant, outcomes, failures, goals, best, words: f"{path} {words}"
    )
    assert ran("strategies", "--seed", "4", "--play", "2", "--report", "p.html", *J) == 0
    found[:] = ["at rest", "in motion"]
    held[0] = False
    assert ran("strategies", "--quiet", "--dwell", "1") == 1
    for option, low, high in (("play", 0.0, 5.0), ("growth", -2.0, 2.0), ("noise", 0.0, 20.0), ("dither", 0.0, 1.0),
                              ("dwell", 0.01, 10.0)):  # fmt: skip
        assert ran("strategies", f"--{option}", str(low - 0.001)) == 2
        assert ran("strategies", f"--{option}", str(high + 0.001)) == 2
        assert ran("strategies", f"--{option}", str(low), "--quiet") == 1
    ran.out += [str(a) for a in asked]
    approve("cli_strategies", ran.text())


# ---- tools, controllers and FMUs -------------------------------------------------------------------------------------


def test_trouble_codes_are_kept_in_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registered: list[Any] = []
    monkeypatch.setattr(attended.atexit, "register", registered.append)
    monkeypatch.setattr(attended, "time", SimpleNamespace(sleep=registered.append))
    file = tmp_path / "new" / "codes.json"
    keeper = attended._Keeper(file)
    keeper("first")
    for _ in range(2000):
        if file.exists() and file.read_text() == "first" and len(registered) > 1:
            break
        threading.Event().wait(0.001)
    assert file.read_text() == "first" and registered[:2] == [keeper._now, 0.1] and not keeper._wake.is_set()
    keeper._text = "last"
    registered[0]()
    assert file.read_text() == "last"
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"^cannot write --uds-memory .*codes\.json: File exists$"):
        attended._Keeper(tmp_path / "file" / "codes.json")
    with pytest.raises(InputError):
        attended._Keeper(tmp_path)


def test_services_that_attend_to_the_controller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    apart: list[int] = []
    monkeypatch.setattr(attended, "Outside", lambda elements: apart.append(1) or AtOnce(elements))
    slaves: list[dict[str, Any]] = []
    slave = attended.Slave

    def made(memory: Any, **more: Any) -> Any:
        slaves.append(more)
        return slave(memory, **more)

    monkeypatch.setattr(attended, "Slave", made)

    def of(*words: str, recorded: bool = False) -> Any:
        parser = argparse.ArgumentParser()
        attended.add_service_options(parser)
        return attended.attend(parser.parse_args(list(words)), Node(), recorded=recorded)

    both = of("--xcp", "--uds", "--tool-seed", "3")
    assert [type(s).__name__ for s in both.services] == ["XcpService", "UdsService"] and both.told is True
    assert (
        apart == [1] and slaves[0]["seed"] == 3 and slaves[0]["save"] is None and "/begin PROJECT" in slaves[0]["a2l"]()
    )
    uds = of("--uds")
    assert [type(s).__name__ for s in uds.services] == ["UdsService"] and uds.told is True and len(apart) == 2
    of("--xcp", "--xcp-save", str(tmp_path), recorded=True)
    of("--xcp", "--xcp-lock", recorded=True)
    of("--xcp", "--xcp-open", recorded=True)
    assert len(apart) == 2 and slaves[1]["save"] == tmp_path
    locked = [sorted(s["locked"]) for s in slaves]
    assert locked == [["cal", "stim"], ["cal", "stim"], ["cal", "daq", "stim"], []]
    codes = tmp_path / "codes.json"
    monkeypatch.setattr(attended.atexit, "register", lambda call: call())
    of("--uds", "--uds-memory", str(codes), recorded=True)
    for _ in range(2000):
        if codes.exists() and codes.read_text():
            break
        threading.Event().wait(0.001)
    assert json.loads(codes.read_text()) is not None


def test_a_controller_or_a_plant_of_one_s_own(ran: Ran, log: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fed: list[Any] = []
    monkeypatch.setattr(replay, "is_crash_log", lambda log: log == "crash.parquet")
    monkeypatch.setattr(
        replay.crash_log, "read", lambda log: (np.zeros((1234, 3)), {"failure": "it hung"}, "calibration")
    )
    monkeypatch.setattr(replay.crash_log, "feed", lambda *given: fed.append(given[1:]))
    monkeypatch.setattr(replay, "Program", lambda path: ("program", path))
    monkeypatch.setattr("vaneloop.cli.options.isolated", lambda call, save: fed.append(save) or call())
    assert ran("replay", "crash.parquet", "--controller", "own.so", "--save-crash", "c.parquet", *J) == 0
    assert ran("replay", "crash.parquet", "--controller", "own.so", "--save-crash", "c.csv") == 2

    def fails(call: Any, save: Any) -> int:
        raise ControllerFailed("own.so: it hung")

    monkeypatch.setattr("vaneloop.cli.options.isolated", fails)
    assert ran("replay", "crash.parquet", "--controller", "own.so") == 1
    roles = [export_fmu.INPUT] * 2 + [export_fmu.OUTPUT] * 3 + [export_fmu.FIXED] * 4 + [export_fmu.TUNABLE] * 5

    def write_fmu(out: str, part: str, *given: Any, version: str) -> Any:
        variables = [SimpleNamespace(role=r) for r in roles]
        return SimpleNamespace(path=out, part=part, version=version, token="tok", variables=variables)

    monkeypatch.setattr(export_fmu, "write_fmu", write_fmu)
    for made in (False, True):
        monkeypatch.setattr(export_fmu, "is_made", lambda *_, made=made: made)
        assert ran("export-fmu", "--part", "loop", "--out", "l.fmu", "--fmi", "2.0", *J) == 0
    made_of: list[Any] = []

    class Fmu:
        notes = ["an output is missing"]  # noqa: RUF012

        def __init__(self, *given: Any, n_r: float):
            made_of.append((given, n_r))

    monkeypatch.setattr(run, "PlantFmu", Fmu)
    monkeypatch.setattr(
        run, "PlantNode", lambda fmu, *given, n_r, seed: made_of.append((n_r, seed)) or run.Node(n_r=n_r)
    )
    assert ran("run", "--bus", "lockstep", "--duration", "0.2", "--plant", "p.fmu", "--plant-map", "S=n_r",
               "--start-speed", "70", "--seed", "3") == 0  # fmt: skip
    assert ran("run", "--bus", "lockstep", "--duration", "0.2", "--plant", "p.fmu", "--plant-map", "S") == 2
    ran.out += [str(m) for m in made_of] + [str(f) for f in fed]
    approve("cli_own", re.sub(r"<[^<>]*>", "…", ran.text()))


def test_a_controller_s_project_that_cannot_be_written_leaves_nothing(
    ran: Ran, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(contents: Any) -> None:
        raise InputError("the disk is full")

    monkeypatch.setattr(new_controller, "write_all", full)
    assert ran("new-controller", "mine") == 2 and not (ran.folder / "mine").exists()
    (ran.folder / "empty").mkdir()
    assert ran("new-controller", "empty") == 2 and list((ran.folder / "empty").iterdir()) == []
    (ran.folder / "file").write_text("")
    assert ran("new-controller", "file/mine") == 2
    assert next(x for x in ran.out if x.startswith("! ")) == "! vaneloop: the disk is full"


def test_a_log_is_put_into_the_subsystems_of_a_machine(log: str, ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    cached = {"hydraulic": False, "motor": False}
    of = {id(chains.hydraulic_blocks.run): "hydraulic", id(chains.motor_blocks.run): "motor"}
    monkeypatch.setattr(chains, "is_cached", lambda run: cached[of[id(run)]])
    chains.tell_search(said.append)
    for one in cached:
        cached.update(hydraulic=False, motor=False)
        cached[one] = True
        chains.tell_search(said.append)
    assert said == ["compiling the subsystems of the search for this machine (once, about 30 s) ..."]
    asked: list[Any] = []
    monkeypatch.setattr(chains, "warm_up", lambda say: asked.append("warm"))
    monkeypatch.setattr(chains, "bind_parts", lambda machine, log, *parts: asked.append(parts) or chain(("a note",)))
    monkeypatch.setattr(terminal, "say", lambda args, text: said.append(text))
    parser = argparse.ArgumentParser()
    chains.options.add_log_options(parser)
    chains.options.add_machine_options(parser)
    args = parser.parse_args([log])
    args.fit, args.test, args.quiet = [["0:5"], ["6:9"]], [["9:"]], False
    assert chains.chain_of(args).notes == ["a note"] and said[-1] == "note: a note"
    assert chains.chain_of(args, loop=True).notes == ["a note"] and asked[1] == "warm"
    assert asked[0] == asked[2] == chains.split(["0:5", "6:9"], ["9:"])[:2]
    args.plant = "plant_two_actuators.toml"
    assert chains.chain_of(args).notes == ["a note"]
    with pytest.raises(Exception, match=r"actuators\.number \(=2\) must be 1 for learning"):
        chains.chain_of(args, alone="learning")


def test_what_else_is_in_a_log_is_told(ran: Ran, log: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def row(signal: str, how: str) -> Any:
        return SimpleNamespace(signal=signal, name=f"in the log {signal}", unit="%", how=how, confidence=0.87, low=1.0,
                               high=2.5, curve=np.array([1.0, 2.0]))  # fmt: skip

    seen = SimpleNamespace(
        rows=[row("t", "as named"), row("n_dem", "guessed"), row("n_r", "as named")], other=["spare", "more"],
        open={"i_cmd": "two names could be it"}, unused=lambda: ["spare: 3 samples"], dbc=None, complaint="",
        notes=["N is guessed to be n_dem", "i_cmd: two names could be it, a or b", "3 rows are out of order"],
        to_dict=lambda: {"seen": 1}, bench=lambda: {"names": {"n_dem": "N"}},
    )  # fmt: skip
    asked: list[Any] = []
    compared: dict[str, Any] = {"what": "frames", "ours": "3", "theirs": "3", "by": "python-can"}
    found = [SimpleNamespace(**compared, same=s, to_dict=lambda s=s: {"same": s}) for s in (True, None)]
    monkeypatch.setattr(of_map, "survey", lambda *given, **more: asked.append((given, sorted(more))) or seen)
    monkeypatch.setattr("hil.logs.others.compare", lambda *given: asked.append(given) or found)
    monkeypatch.setattr(of_map, "write_mapping", lambda *given: asked.append(given))
    assert ran("map", log, "--check", "--out", "b.toml", *J) == 0
    found[1].same = False
    assert ran("map", log, "--check", "--quiet") == 1
    seen.complaint = "no time"
    assert ran("map", log, "--export", "x.csv") == 1 and not (ran.folder / "x.csv").exists()
    ran.out += [str(a) for a in asked]
    approve("cli_map_more", ran.text())


def test_a_measured_loop_is_scheduled(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    result = links()
    result.log = "loop.csv"
    for s in result.links:
        s.error_initial = s.error + 1.0
        for figures in (s.at_design, s.rms, s.largest):
            figures |= {"extension": 0.5, "retraction": 0.25}
    for k, m in enumerate(result.loops.values()):
        m.misfit, m.drift, m.lag, m.extension_covered, m.retraction_covered = (
            0.01,
            None if k else 0.02,
            0.0123,
            (1, 40),
            (2, 39),
        )
    asked: list[Any] = []
    monkeypatch.setattr(schedule, "schedule", lambda g, s, log, options, tell: asked.append((log, options)) or result)
    monkeypatch.setattr(schedule, "result_json", lambda result: {"schema": 1})
    monkeypatch.setattr(schedule, "schedule_page", lambda result, path, words: f"{path} of {words}")
    monkeypatch.setattr(schedule, "write_tables", lambda result, out: [Path(out) / "a.toml", Path(out) / "b.toml"])
    monkeypatch.setattr(schedule.options, "read_log_of", lambda args, require: (args.log, require))
    assert ran("schedule", "--log", "loop.csv", "--adjust", " lb , lc", "--report", "p.html", "--out", "o", *J) == 0
    result.links = result.links[:1]
    result.loops, result.speed = {}, result.speed - 50.5
    assert ran("schedule", "--step", "0.25") == 0
    ran.out += [str(a) for a in asked]
    approve("cli_schedule_loop", ran.text())


def test_what_a_node_says(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    args = argparse.Namespace(model="m.toml", quiet=False, json=None, secoc=None, xcp=True, uds=False)
    same = SimpleNamespace(plant=build_plant())
    run._say_engine(args, same, "vcan0")
    other = SimpleNamespace(plant=build_plant())
    other.plant.p[run.ACCELERATION] *= 1.1
    run._say_engine(argparse.Namespace(model=None, quiet=False), other, "vcan0")
    assert capsys.readouterr().out == ""
    run._say_engine(args, other, "vcan0")
    assert capsys.readouterr().out.strip() == (
        "note: the engine of m.toml runs in the ECU: vaneloop ecu --bus vcan0 --model m.toml"
    )
    monkeypatch.setattr(run, "observables", lambda foreign: {"seen": {"value": 1.5, "unit": "V", "meaning": "what"}})
    run._say_node(args, Node())
    assert "seen: 1.5 V (what)" in capsys.readouterr().out
    assert run._node_json(Node())["own"] == {"seen": {"value": 1.5, "unit": "V", "meaning": "what"}}
    lost = SimpleNamespace(lost={"xcp": {"dropped": 1200, "untaken": 3}})
    assert run._say_tools(args, lost) == {"tools": lost.lost}
    assert capsys.readouterr().out == "tools over XCP: 1,200 frames dropped, 3 answers not taken\n"
    args.xcp = False
    assert run._say_tools(args, lost) == {}
    for cached in (True, False):
        monkeypatch.setattr(station, "is_cached", lambda run, cached=cached: cached)
        station.warm_nodes(args)
        assert ("compiling the nodes" in capsys.readouterr().out) is not cached


def test_a_bus_is_joined_left_and_watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Any] = []
    bus = SimpleNamespace(shutdown=lambda: opened.append("left"))
    monkeypatch.setattr(station, "open_bus", lambda name, **more: opened.append((name, more)) or bus)
    for name, priority in (("local:x", None), ("local", 7), ("vcan0", 7)):
        with pytest.raises(ValueError, match="x"), station.joined(name, priority, can_filters=1) as joined:
            assert joined is bus
            raise ValueError("x")
    of_broker = [("local:x", {"can_filters": 1, "priority": 0}), ("local", {"can_filters": 1, "priority": 7})]
    assert opened[::2] == [*of_broker, ("vcan0", {"can_filters": 1})] and opened[1::2] == ["left"] * 3
    assert station.bus_name(argparse.Namespace(bus="x")) == "x"
    said: list[str] = []
    monkeypatch.setattr(station.BusWatch, "_say", lambda watch, text: said.append(text))
    port = SimpleNamespace(refused=0, errors=0)
    watch = station.BusWatch(argparse.Namespace(quiet=False), "nowhere0", port)
    port.refused = 1
    for k in range(201):
        watch(k)
    assert len(said) == 1
    watch(201)
    assert said[1] == "nowhere0: takes frames again after 0.0 s; 1 were not sent"
    flags: dict[str, str] = {}
    monkeypatch.setattr(station, "Path", lambda path: SimpleNamespace(read_text=lambda: flags[path]))
    for text, why in (("0x1003", "does not take frames (full or bus-off)"), ("0x1002", "is down"),
                      ("x", "does not take frames (gone, full or bus-off)")):  # fmt: skip
        flags["/sys/class/net/nowhere0/flags"] = text
        assert watch._why() == why

    @contextmanager
    def refused(priority: Any, cpu: Any) -> Iterator[list[str]]:
        raise PermissionError(1, "Operation not permitted")
        yield []

    monkeypatch.setattr(station.realtime, "undisturbed", refused)
    args = argparse.Namespace(realtime_priority=5, cpu=None)
    why = "--realtime-priority 5: Operation not permitted; run as root, or allow it with ulimit -r 5"
    with pytest.raises(InputError) as e, station.undisturbed(args):
        pass
    assert str(e.value) == why


def test_options_are_offered_where_they_count() -> None:
    def offered(**more: Any) -> set[str]:
        parser = argparse.ArgumentParser()
        options.add_controller_options(parser, **more)
        return {a.dest for a in parser._actions} - {"help"}

    assert offered() == {"controller", "save_crash"} and offered(save_crash=False) == {"controller"}
    parser = argparse.ArgumentParser()
    options.add_tables_option(parser, plant=False)
    assert {a.dest for a in parser._actions} == {"help", "tables"}


# ---- how far it is, and the ends of what is allowed ------------------------------------------------------------------


def test_a_bar_goes_from_nothing_to_all(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    bars: list[tuple[str, list[float]]] = []

    @contextmanager
    def bar(args: Any, text: str) -> Iterator[Callable[..., None]]:
        bars.append((text, []))
        yield lambda fraction, *_: bars[-1][1].append(float(fraction))

    monkeypatch.setattr(terminal, "progress_bar", bar)
    assert ran("inject", "demand_gap_40ms", "mode_request_insane", "--quiet") == 0
    assert ran("run", "--bus", "lockstep", "--duration", "0.5", "--quiet") == 0
    assert ran("fuzz", "--frames", "400", "--quiet") == 0
    result = SimpleNamespace(
        signals=[SimpleNamespace(signal="vigv", samples=9, **dict.fromkeys(engine_test.STATISTICS, 0.001))],
        simulated_s=3164.0, wall_s=2.0, model={},
    )  # fmt: skip
    asked: list[Any] = []

    def tested(n_dem: Any, strategy: str, seed: int, width: Any, progress: Any, *more: Any) -> Any:
        progress(1.0)
        asked.append((strategy, seed, width))
        return result

    monkeypatch.setattr(engine_test, "engine_test", tested)
    monkeypatch.setattr(engine_test, "replay_json", lambda r: {})
    monkeypatch.setattr(
        engine_test, "engine_test_report", lambda one, two, paper, path, command: f"{path} of {command}"
    )
    monkeypatch.setattr(engine_test, "apart", lambda model: ["vanes are apart"])
    monkeypatch.setattr(engine_test, "warm_up", lambda say: say("compiled"))
    words = ("--strategy", "inverse", "--report", "e.html", "--hysteresis", "10", "--seed", "0")
    assert ran("engine-test", *words) == 0
    assert asked == [(s, 0, 10.0) for s in ("single", "dual", "inverse")]
    assert "page: e.html of vaneloop engine-test --strategy inverse --report e.html --hysteresis 10 --seed 0" in ran.out
    assert {"single: vanes are apart", "inverse: vanes are apart", "compiled"} <= set(ran.out)
    assert [text for text, _ in bars] == ["injecting", "lockstep", "frames", *(f"engine test, {a[0]}" for a in asked)]
    for text, shares in bars:
        assert shares and (np.diff(shares) >= 0.0).all() and shares[0] >= 0.0 and shares[-1] <= 1.0, text
    injecting = bars[0][1]
    assert injecting[0] < 0.5 < injecting[-1] and max(s for s in injecting if s <= 0.5) > 0.4


@pytest.mark.parametrize(
    "words",
    [
        ["strategies", "--play", "5", "--growth", "2", "--noise", "20", "--dither", "1", "--dwell", "10"],
        ["fleet", "run", "x", "--out", "R", "--workers", "10000", "--limit", "1e6", "--patience", "1e5"],
        ["fleet", "run", "x", "--out", "R", "--workers", "1", "--limit", "0.001", "--patience", "0.5"],
        ["campaign", "p", "--out", "R", "--workers", "10000", "--limit", "1e6", "--patience", "1e5"],
        ["campaign", "p", "--out", "R", "--workers", "1", "--limit", "0.001", "--patience", "0.5"],
        ["diagnose", "x", "--workers", "64"], ["diagnose", "x", "--workers", "1"],
        ["fuzz", "--frames", "1", "--seed", str(2**63 - 1), "--recovery", "3600"], ["fuzz", "--current-limit", "1000"],
        ["fuzz", "--frames", "1", "--seed", "0", "--recovery", "0.01", "--stroke-limit", "1000"],
        ["run", "--bus", "x", "--limit-late-us", "0", "--limit-share", "99.9", "--start-speed", "120", "--seed", "0"],
        ["run", "--bus", "x", "--start-speed", "0", "--spin-us", "1000", "--realtime-priority", "99"],
        ["run", "--bus", "x", "--duration", "1e7"],
        ["run", "--bus", "x", "--spin-us", "0", "--realtime-priority", "1", "--xcp", "--tool-seed", str(2**63 - 1)],
        ["inject", "x", "--seed", "0"], ["design", "--kp", "1e6", "--ki", "0"], ["engine-test", "--hysteresis", "0"],
    ],
)  # fmt: skip
def test_what_stands_at_the_end_of_what_is_allowed_is_taken(
    ran: Ran, words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Enough(Exception):
        """It has been taken."""

    def taken(*_: Any, **__: Any) -> Any:
        raise Enough

    where = {
        "strategies": ["options.tables_of"], "fleet": ["terminal.pairs"], "campaign": ["known"],
        "diagnose": ["own_model.asked"], "fuzz": ["options.machine_of"],
        "run": ["attended.check_service_options"],
        "inject": ["load_scenario"], "engine_test": ["load_profile"],
    }  # fmt: skip
    name = words[0].replace("-", "_")
    for at in where.get(name, []):
        monkeypatch.setattr(f"vaneloop.cli.{name}.{at}", taken)
    monkeypatch.setattr("vaneloop.design.servo_design.evaluate", taken)
    module = importlib.import_module(main.COMMANDS[words[0]][0])
    parser = terminal.Parser(prog=words[0])
    module.add_options(parser)
    command = getattr(module.command, "__wrapped__", module.command)
    with pytest.raises(Enough):
        command(parser.parse_args(words[1:]))


def test_frames_are_compiled_for_only_where_a_log_has_some(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(options, "warm_up", lambda say: say("compiling") or asked.append(1))
    monkeypatch.setattr(terminal, "say", lambda args, text: asked.append(text))
    for log, begun in (("a.csv", []), ("a.parquet", []), ("a.blf", ["compiling", 1]), ("a.log", ["compiling", 1])):
        asked.clear()
        options.warm_up_for(argparse.Namespace(log=log))
        assert asked == begun


def test_a_scenario_that_cannot_be_is_left_out_among_others(ran: Ran, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(inject, "lacks", lambda scenario, *machine: "no such part")

    def run(scenario: Any, name: str, **more: Any) -> Any:
        asked.append(name)
        raise InputError("it lacks a part")

    monkeypatch.setattr(inject, "run", run)
    assert ran("inject", "demand_stops") == 2 and asked == ["demand_stops"]
    assert ran("inject", "demand_stops", "nominal") == 0 and len(asked) == 1
    assert "skipped: nominal: no such part" in ran.out


def test_a_record_is_complete_whatever_ends_the_run(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    closed: list[int] = []
    kept = ["old.log"]

    class Recorder:
        def __init__(self, path: str, channel: str):
            closed.append(0)
            self.kept, self.of = kept[0], (path, channel)

        def close(self) -> None:
            closed[-1] += 1

    monkeypatch.setattr(station, "RecorderProcess", Recorder)
    args = argparse.Namespace(record="r.log", quiet=False, json=None)
    with pytest.raises(ValueError, match="x"), station.recording(args, "local:x") as recorder:
        assert recorder.of == ("r.log", "local-x") and closed == [0]
        raise ValueError("x")
    assert closed == [1] and "r.log was there already: it is now old.log" in capsys.readouterr().out
    kept[0] = ""
    with station.recording(args, "x"):
        pass
    assert closed == [1, 1] and capsys.readouterr().out == ""
    with station.recording(argparse.Namespace(record=None), "x") as none:
        assert none is None


def test_what_names_a_machine_and_a_log_reaches_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(options, "Machine", lambda *given: given)
    args = argparse.Namespace(tables="T", model="m.toml", plant="p", controller="c.so")
    assert options.machine_of(args, strategy="dual") == ("T", "m.toml", "dual", "p", "c.so", None)
    assert options.machine_of(args, "other") == ("T", "other", None, "p", "c.so", None)
    assert options.machine_of(argparse.Namespace(model="")) == (None, None, None, None, None, None)
    order: list[Any] = []
    monkeypatch.setattr(options, "log_options", lambda args: {"part": 3})
    monkeypatch.setattr(options, "warm_up_for", order.append)
    monkeypatch.setattr(options, "read_log", lambda log, **more: order.append((log, more)) or "the log")
    args = argparse.Namespace(log="a.blf")
    assert options.read_log_of(args, require=("x",)) == "the log"
    assert order == [args, ("a.blf", {"part": 3, "require": ("x",)})]


def test_a_model_of_one_s_own_is_compared_without_a_loop(ran: Ran, log: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(compare.own_model, "asked", lambda args: True)
    monkeypatch.setattr(compare.own_model, "ask", lambda args, verb: shown.append(verb) or Answered(by_log="the logs"))
    monkeypatch.setattr(compare.own_model, "show", lambda args, by_log: shown.append(by_log))
    assert ran("compare", log, "--report", "p.html", *J) == 0 and shown == ["compare", "the logs"]
    assert (
        "So it is." in ran.out and "page: p.html of vaneloop compare run.csv --report p.html --json j.json" in ran.out
    )
    assert "  answer 1" in ran.out
