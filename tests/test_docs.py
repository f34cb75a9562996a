"""Every command and every Python snippet of README.md, CONTRIBUTING.md and docs/ runs as it is written.

A page's steps run in their order, in a folder of its own. What cannot run here as written stands in one of the tables,
with the reason: `REPLACED` (smaller, or a placeholder filled in), `NOT_RUN` (only parsed), `LONG` (run by `make
test-all`, which also runs the pages `DEAR`). An entry that no page has fails. Every command line is parsed by the
command's own parser, whether it is run or not; commands, targets, modules and files that the text names in passing must
be there.
"""

from __future__ import annotations

import importlib.util
import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.pictures import REPORTS, WORK
from hil.logs import Channel, read_log, write_log
from tests.conftest import ROOT
from tests.quotes import absent, lines_of, tokens
from tests.test_help import MODULES, parser_of
from vaneloop.cli.main import COMMANDS, main

PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md")),
]
EXAMPLE = "examples/hidden_effect.parquet"

# words of a page's commands and snippets -> what is run instead, and why
REPLACED: dict[str, dict[str, tuple[str, str]]] = {
    "docs/your_own_model.md": {
        "LOG": ("tank.csv", "the page's own example"),
        "OTHER": ("other.csv", "the page's own example"),
        "my_model.py": ("tank.py", "the page's own example"),
        "u.dead_zone": ("level.square_root", "a law that the example lacks"),
    },
    "docs/learn.md": {
        "LOG": ("cold.csv", "the page's own example"),
        "OTHER": ("warm.csv", "the page's own example"),
        "NEW": ("warm.csv", "the page's own example"),
        "my_model.py": ("tank.py", "the page's own example"),
    },
    "docs/diagnosis.md": {"LOG": (EXAMPLE, "any log")},
    "docs/own_controller.md": {
        "LOG": ("examples/engine_run.blf", "any log"),
        "./my_controller.so": ("my_controller/my_controller.so", "the page's session is in that folder"),
    },
    "docs/replay.md": {"LOG": ("examples/engine_run.blf", "any log")},
    "docs/architecture.md": {"LOG": ("examples/engine_run.blf", "any log")},
    "docs/real_time.md": {
        "--bus local --record run.mf4": (
            "--bus local:docs --duration 3 --record run.mf4",
            "else it runs until Ctrl-C, and meets others on its bus",
        )
    },
    "docs/bus.md": {
        "--frames 10000000": ("--frames 20000", "ten million frames take minutes"),
        "--frames 1000000 ": ("--frames 2000 ", "a million frames take minutes"),
    },
    "docs/guides.md": {"strategies --report": ("strategies --dwell 0.05 --report", "989 s of run take half a minute")},
    "docs/rig.md": {"manoeuvre(seed=7)": ("manoeuvre(seed=7, duration=30.0)", "300 s take long")},
}

DATA = "needs published data that are not ours to ship; tests/test_real_data.py runs it where they are"
VCAN = (
    "runs until Ctrl-C, on a kernel with vcan0; tests/test_socketcan.py, tests/test_realtime.py, tests/test_record.py"
)
LIVE = (
    "runs in real time until Ctrl-C, or beside such a run; tests/test_realtime.py, tests/test_record.py, "
    "tests/test_inject.py"
)
# the beginning of a command or snippet that is parsed, not run -> why
NOT_RUN: dict[str, str] = {
    "make demo": "sets up an environment; its steps are the commands of this page",
    "make test": "runs this test",
    "vaneloop run --bus vcan0": VCAN,
    "vaneloop ecu --bus vcan0": VCAN,
    "vaneloop run --xcp": "runs until Ctrl-C; tests/test_xcp.py",
    "vaneloop run --uds": "runs until Ctrl-C; tests/test_uds.py",
    "vaneloop record run.mf4 --bus vcan0": VCAN,
    "vaneloop record night.mf4 --bus vcan0": VCAN,
    "candump vcan0": VCAN,
    "vaneloop replay run.mf4": "wants a run with an ECU, which is there until Ctrl-C; tests/test_record.py",
    "vaneloop inject masquerade --bus local": LIVE,
    "vaneloop inject --all --controller": "every scenario on a controller of one's own; tests/test_native.py",
    "python warm_play.py": "the page's snippet under that name, which is run as such",
    "python -m can.logger": "runs until Ctrl-C; tests/test_bus.py",
    "python -m can.player": "plays what the logger recorded; tests/test_bus.py",
    "vaneloop fuzz --replay fuzz_failure.log": "needs a failure to repeat; tests/test_fuzz.py makes one",
    "vaneloop diagnose DATA_EMPS.mat": DATA,
    "vaneloop diagnose 0.5Hz36lbtension1amplitude.json": DATA,
    "vaneloop diagnose ex_1.csv": DATA,
    "vaneloop diagnose SNLS80mV.csv": DATA,
    "vaneloop replay revlog.log --dbc": DATA,
    "vaneloop replay log.mf4 --dbc": DATA,
    "vaneloop map --check bench.blf": "a log and a DBC of the reader's own; tests/test_corpus.py",
    "vaneloop replay rig.mf4": "a file with several groups of one channel name; tests/test_logs.py writes one",
    "vaneloop extend warm_play.parquet --effect play_temperature": "after the page's change to the library",
    "python -m benchmarks.effects_page": "overwrites docs/effects.md; tests/test_effects.py compares it",
    "python -m tests.costs": "reads what the runs of the whole left; tests/test_costs.py",
    "python -m tests.rig.ladder": "some 40 effects in five sizes take an hour",
    "python -m benchmarks": "measures for minutes; no test judges time",
    "python -m benchmarks.fleet": "holds a run of hundreds of logs against its truth",
    "vaneloop fleet": "needs the logs of many engines; tests/test_fleet_run.py, tests/test_fleet_report.py",
    "python -m benchmarks.fleet_demo": "simulates the logs of many engines; tests/test_fleet_report.py",
    "python -m benchmarks.hidden_effect": "draws and diagnoses logs for an hour; tests/test_hidden_effect.py",
    "python -m benchmarks.two_actuators": "diagnoses logs for half an hour; tests/test_two_actuators_blind.py",
    "python -m benchmarks.hidden_law": "draws and diagnoses systems for an hour; tests/test_hidden_law.py",
    "python -m benchmarks.campaign": "measures for minutes; no test judges time",
    "python -m tests.corpus.make": "overwrites tests/corpus; tests/test_corpus.py compares it",
    "python -m benchmarks.gpu": "measures on an NVIDIA GPU; tests/test_gpu.py",
    "python -m benchmarks.settings": "overwrites docs/settings.md; tests/test_settings.py compares it",
    "vaneloop diagnose two_strokes.parquet": "a log of two actuators; tests/test_diagnosis_by_side.py",
    "vaneloop extend two_strokes.parquet": "a log of two actuators; tests/test_diagnosis_by_side.py",
    "vaneloop compare two_strokes.parquet": "a log of two actuators; tests/test_diagnosis_by_side.py",
    "vaneloop campaign": "runs for minutes, on workers; tests/test_campaign.py",
    "vaneloop web": "serves until Ctrl-C; tests/test_web.py",
    "make mutants": "changes the code under test for many minutes; tests/test_mutants.py runs small campaigns",
    "# vaneloop/base/errors.py": "signatures, not a program",
}

# named in passing, not as a run -> where it is run
NAMES: dict[str, str] = {
    "python -m hil.replay": "docs/architecture.md",
    "python -m hil.inject": "tests/test_exit_codes.py",
    "vaneloop engine-test --profile": "tests/test_machines.py",
    "vaneloop learn LOG": "tests/test_learn_vanes.py",
    "vaneloop ecu --model": "an option, which the command must have",
}

# pages whose steps, together, take a processor seconds, and whose commands other quick tests run
DEAR = [
    "README.md",
    *(
        f"docs/{name}.md"
        for name in ("benchmarks", "bus", "coming_from_inca", "diagnosis", "engine_test", "fmu", "injection")
    ),
    *(f"docs/{name}.md" for name in ("linkage", "machines")),
    *(
        f"docs/{name}.md"
        for name in ("own_controller", "pandas", "python", "real_time", "replay", "rig", "your_own_model")
    ),
]
# the beginning of a step that takes long -> the quick test that covers what it does
LONG: dict[str, str] = {
    "vaneloop diagnose worn.log": "tests/test_electromechanical.py",
    "vaneloop design --plant": "tests/test_electromechanical.py",
    "vaneloop engine-test --plant": "tests/test_electromechanical.py",
    "vaneloop strategies": "tests/test_strategies.py",
    "vaneloop design --report": "tests/test_design.py",
    "vaneloop inject --all": "tests/test_inject.py",
    "vaneloop spatial --report": "tests/test_spatial.py",
    "vaneloop clearance --report": "tests/test_linkage.py",
    "vaneloop experiment": "tests/test_search_commands.py",
    "vaneloop diagnose warm_play.parquet": "tests/test_search_commands.py",
    "vaneloop extend warm_play.parquet --effect linkage_backlash": "tests/test_search_commands.py",
    "vaneloop compare tank.csv": "tests/test_your_own_model.py",  # each command compiles the model anew
    "vaneloop locate tank.csv": "tests/test_your_own_model.py",
    "vaneloop diagnose tank.csv --test": "tests/test_your_own_model.py",
    "vaneloop diagnose tank.csv --fit": "tests/test_parts.py",
    "vaneloop diagnose worn.csv": "tests/test_own_laws.py",
    "vaneloop learn cold.csv": "tests/test_learn.py",
    "vaneloop extend warm.csv": "tests/test_learn.py",
    "vaneloop compare warm.csv": "tests/test_learn.py",
    "vaneloop compare cold.csv": "tests/test_learn.py",
    "vaneloop schedule --geometry": "tests/test_schedule.py",
    "vaneloop engine-test --tables": "tests/test_schedule.py",
    "vaneloop diagnose examples/four_stages/worn_vgv3.parquet": "tests/test_machines.py",
    f"vaneloop diagnose {EXAMPLE}": "tests/test_search_commands.py",
    '"""A log of a machine whose play grows': "tests/test_rig.py",
}
OURS = ("vaneloop", "python", "make", "candump")
# page -> the beginning of the output of a block that quotes no output of the step above it -> what it is
NO_OUTPUT: dict[str, dict[str, str]] = {
    "docs/diagnosis.md": {"note: actuator fails from ": "of a log of six hours; tests/test_long_logs.py"},
    "docs/learn.md": {
        "A function of angle within each ": "of a log with an error once a turn; tests/test_learn_turns.py"
    },
    "docs/tables.md": {"my.toml: servo: kp (": "complaints of files with one mistake each; tests/test_tables.py"},
}


@dataclass(frozen=True)
class Step:
    """One command line or one snippet of a page."""

    line: int
    kind: str  # command, python
    text: str

    def listed(self, table: dict[str, str]) -> str | None:
        """The entry of ``table`` that this is, if any."""

        def begins(words: str) -> bool:
            return self.text.startswith(words if self.kind == "python" else f"{words} ")

        return next((k for k in table if self.text == k or begins(k)), None)


def commands_of(block: str) -> list[str]:
    """Command lines of a fenced block, or of words in back-quotes; a comment and the prompt taken off."""
    if (multi := re.match(r'python -c "\n(.*)"\s*$', block, re.S)) is not None:
        return [block.strip()] if multi else []
    out = []
    for line in re.sub(r"\\\n\s*", "", block).splitlines():
        words = line.strip().removeprefix("$ ").split("  #")[0].split(" # ")[0].strip()
        if words.split(" ")[0] in OURS:
            out.append(re.sub(r" +", " ", words.split(" > ")[0]))
    return out


def steps_of(page: str) -> list[Step]:
    """Commands and snippets of a page, in their order."""
    text = (ROOT / page).read_text(encoding="utf-8")
    out = []
    # fenced blocks, and back-quoted commands that have at least one word more than their name
    for m in re.finditer(r"^```(\w*)\n(.*?)^```|`((?:vaneloop|python -m|python) [^`\n]+)`", text, re.M | re.S):
        line = text[: m.start()].count("\n") + 1
        if m[3] is not None:
            if len(m[3].split()) > 2 or m[3].endswith(".py") or m[3].startswith("python -m"):
                out += [Step(line, "command", c) for c in commands_of(m[3])]
        elif m[1] == "python":
            out.append(Step(line, "python", m[2]))
        elif m[1] in ("", "sh"):
            out += [Step(line, "command", c) for c in commands_of(m[2])]
    return out


def replaced(page: str, text: str) -> str:
    """The step as it is run."""
    for words, (instead, _) in REPLACED.get(page, {}).items():
        text = re.sub(rf"(?<![\w.]){re.escape(words)}(?![\w(])", lambda _, x=instead: x, text)
    return text


ALL = {page: steps_of(page) for page in PAGES}
REAL = [page for page in PAGES if ALL[page]]


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_to_a_file_of_the_checkout(page: str) -> None:
    """Where there is no site, too: on a page of a repository's browser, in an editor."""
    text = re.sub(r"^```.*?^```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.S | re.M)
    links = [x for x in re.findall(r"\]\(([^)\s]+)\)", text) if not re.match(r"https?:|#|mailto:", x)]
    assert [x for x in links if not ((ROOT / page).parent / x.split("#")[0]).exists()] == []


def test_the_first_picture_shows_the_figures_that_the_command_prints() -> None:
    """The tutorial quotes the line, and is held against what `extend` prints."""
    text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    printed = re.search(r"^actuator, in noise floors: (.*)$", text, re.M)
    assert printed
    shown = json.loads((ROOT / "docs" / "pictures" / "figures.json").read_text(encoding="utf-8"))["tutorial_falls.png"]
    said = [f"{name} {bar}" for name, bar in zip(shown["axis"], shown["bars"], strict=True)]
    assert " -> ".join(said) == printed[1]


def test_one_command_takes_every_picture_and_its_reports_are_commands_of_the_pages() -> None:
    """`make pictures`: a picture that nobody takes, or no page shows, would grow old."""
    shown = {p.name for p in (ROOT / "docs" / "pictures").glob("*.png")}
    taken = {f"{name}.png" for of in REPORTS.values() for name in of} | {f"web_{name}.png" for _, name, _ in WORK}
    assert shown == taken
    text = "\n".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES)
    assert [name for name in shown if f"pictures/{name}" not in text] == []
    commands = [" ".join(shlex.split(s.text)) for steps in ALL.values() for s in steps if s.kind == "command"]
    for line in REPORTS:
        words = set(line.split())
        assert any(words <= set(c.split()) for c in commands), line


def test_the_figures_of_the_worked_examples_are_those_of_their_pictures() -> None:
    """What the pages quote of published logs stands on the bars that `make pictures` took from the commands' pages."""
    said = json.loads((ROOT / "docs" / "pictures" / "figures.json").read_text(encoding="utf-8"))
    pages = ("examples_emps", "examples_friction_damper", "examples_micro_gas_turbine", "hysteresis_origin")
    text = {name: (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in pages}
    emps = said["emps_falls.png"]["bars"]
    assert f"falls from {emps[0]} to {emps[-2]} noise floors" in text["examples_emps"]
    damper, logs = said["damper_where.png"]["bars"], len(said["damper_where.png"]["axis"])
    gap_at_2_hz, asymmetry_in_the_earthquake = float(damper[logs + 3]), float(damper[3 * logs - 1])
    assert f"without it: {gap_at_2_hz:.2f})" in " ".join(text["examples_friction_damper"].split())
    assert f"earthquake* ({asymmetry_in_the_earthquake:.2f})" in " ".join(text["examples_friction_damper"].split())
    rows = re.findall(r"^\| ex_(?:4|22) \(test\) \| (\d+) W \| (\d+) W \|$", text["examples_micro_gas_turbine"], re.M)
    assert [round(float(b), 2) for b in said["turbine_where.png"]["bars"][6:8]] == [
        pytest.approx(float(after) / float(before), abs=0.006) for before, after in rows
    ]
    rings = re.search(r"ring across its links\*\* .*\| \*\*([\d.]+)\*\* \| \*\*([\d.]+)\*\* \| \*\*([\d.]+)\*\* \|",
                      text["hysteresis_origin"])  # fmt: skip
    assert rings
    bars = [float(b) for b in said["clearance.png"]["bars"]]
    assert [float(v) for v in rings.groups()] == pytest.approx(bars[4::6], abs=0.006)


def test_the_pages_hold_what_this_test_is_for() -> None:
    assert set(DEAR) <= set(REAL)
    commands = [s.text for steps in ALL.values() for s in steps if s.kind == "command"]
    assert len(commands) > 60 and sum(s.kind == "python" for steps in ALL.values() for s in steps) > 10
    assert "vaneloop diagnose LOG --system my_model.py --model better.toml" in commands
    used = {c.split(" ")[1] for c in commands if c.startswith("vaneloop ")}
    assert {"replay", "compare", "locate", "diagnose", "extend", "run", "ecu", "record", "inject", "schedule"} <= used
    assert used - {"--help"} <= set(COMMANDS)


@pytest.mark.parametrize("table", [NOT_RUN, LONG, NAMES], ids=["not run", "long", "names"])
def test_every_exception_is_a_step_of_some_page(table: dict[str, str]) -> None:
    steps = [t for page, steps in ALL.items() for s in steps for t in (s, Step(s.line, s.kind, replaced(page, s.text)))]
    assert [k for k in table if not any(s.listed({k: ""}) for s in steps)] == []
    assert all(reason for reason in table.values())
    for reason in table.values():
        for file in re.findall(r"tests/\w+\.py", reason):
            assert (ROOT / file).is_file(), file


@pytest.mark.parametrize("page", NO_OUTPUT)
def test_every_block_that_quotes_no_output_is_there(page: str) -> None:
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    assert all(sum(line.startswith(begin) for line in lines) == 1 for begin in NO_OUTPUT[page])


@pytest.mark.parametrize("page", REPLACED)
def test_every_replacement_is_used(page: str) -> None:
    for words in REPLACED[page]:
        assert any(replaced(page, s.text) != s.text and words in s.text for s in ALL[page]), words


@pytest.mark.parametrize("page", REAL)
def test_every_command_of_a_page_parses(page: str) -> None:
    for s in ALL[page]:
        program = re.match(r"vaneloop |python -m ", s.text)
        if s.kind != "command" or program is None:
            continue
        where = f"{page}:{s.line}: {s.text}"
        name, *words = shlex.split(s.text[program.end() :])
        if program[0] != "vaneloop " and name not in MODULES:
            continue
        if name.startswith("--"):
            assert name in ("--help", "--version"), where
            continue
        parser = parser_of(name)
        if len(words) == 1 and words[0].startswith("--"):  # names an option, not a run
            assert words[0] in parser.format_help(), where
            continue
        try:
            parser.parse_args(words)
        except SystemExit as refused:
            assert not refused.code, where


def named(page: str) -> list[tuple[int, list[str]]]:
    """Commands that a page has in back-quotes, also over the end of a line: line and words."""
    text = re.sub(
        r"^```.*?^```", lambda m: "\n" * m[0].count("\n"), (ROOT / page).read_text("utf-8"), flags=re.M | re.S
    )
    found = re.finditer(r"`((?:vaneloop|make|python -m|python|pip install|pytest) [^`]+)`", text)
    return [(text[: m.start()].count("\n") + 1, m[1].split()) for m in found]


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_names_in_passing_is_there(page: str) -> None:
    makefiles = [ROOT / "Makefile"]
    if page == "docs/own_controller.md":
        makefiles.append(ROOT / "vaneloop" / "templates" / "own_controller" / "Makefile")
    targets = {t for file in makefiles for t in re.findall(r"^([\w.-]+):", file.read_text("utf-8"), re.M)}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for line, words in named(page):
        where = f"{page}:{line}: {' '.join(words)}"
        if words[0] == "vaneloop":
            assert words[1] in COMMANDS or words[1] in ("--help", "--version", "COMMAND"), where
        elif words[0] == "make":
            assert words[1] in targets, where
        elif words[:2] == ["python", "-m"]:
            assert importlib.util.find_spec(words[2]) is not None, where
        elif words[0] == "pytest":
            assert all((ROOT / file).exists() for file in words[1:] if file.startswith("tests/")), where
        elif words[0] == "pip" and (extra := re.search(r"vaneloop\[(\w+)\]", words[-1])):
            assert extra[1] in project["optional-dependencies"], where


@pytest.mark.parametrize("page", PAGES)
def test_other_blocks_are_what_they_say(page: str) -> None:
    for m in re.finditer(r"^```(\w+)\n(.*?)^```", (ROOT / page).read_text("utf-8"), re.M | re.S):
        line = (ROOT / page).read_text("utf-8")[: m.start()].count("\n") + 1
        if m[1] == "toml":
            assert tomllib.loads(m[2]), f"{page}:{line}"
        elif m[1] == "diff":  # what it leaves or takes away stands in the file
            files = sorted((ROOT / "plant").glob("*.py"))
            for row in m[2].splitlines():
                if row.startswith("@@") and "/" in row:
                    files = [ROOT / row.split()[1].rstrip(",")]
                kept = row[1:].strip() if row[:1] in (" ", "-") else ""
                assert any(kept in file.read_text("utf-8") for file in files), f"{page}:{line}: {row}"
        else:
            assert m[1] in ("python", "sh"), f"{page}:{line}: {m[1]}"


# ---- running ---------------------------------------------------------------------------------------------------------


def log_of(folder: Path, columns: dict[str, str], name: str = "run.csv", **factors: float) -> None:
    """30 s of the example as a CSV with these columns (title -> signal)."""
    log = read_log(ROOT / EXAMPLE, require=())
    n = 3_000
    values = {"t": log.channels["n_dem"].t[:n], **{k: c.values[:n] for k, c in log.channels.items()}}
    rows = np.column_stack(
        [values[signal] * factors.get(signal, 1.0) + factors.get(f"{signal}_0", 0.0) for signal in columns.values()]
    )
    np.savetxt(folder / name, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.6f")


OWN = {k: k for k in ("t", "n_dem", "n_r", "x_lvdt", "vigv", "p_s", "t_oil")}


def before(page: str, step: Step, folder: Path) -> dict[str, Any]:
    """Put the files of a page's story where the step looks for them; return the names that a snippet takes for
    granted.
    """
    text = step.text
    if page == "docs/logs.md":
        if "bench.csv" in text:
            names = {"Zeit_s": "t", "Drehzahl_Soll_U_min": "n_dem", "Kolbenweg_Ist_mm": "x_lvdt"}
            log_of(folder, {**names, "Versorgungsdruck_bar": "p_s"}, "bench.csv", n_dem=380.0, p_s=10.0)
        elif "N1_DEM" in text and step.kind == "python":
            log_of(folder, {"t": "t", "N1_DEM": "n_dem", "x_lvdt": "x_lvdt"}, n_dem=380.0)
        elif "N1_DEM" in text:
            log_of(folder, {"Zeit": "t", "N1_DEM": "n_dem", "N1_ACT": "n_r", "vigv": "vigv"})
        elif "RPM" in text:
            log_of(folder, {"t": "t", "RPM": "n_dem", "vigv": "vigv"})
        elif "p_s=bar" in text:
            log_of(folder, OWN, t=1e3, p_s=10.0, t_oil_0=273.15, vigv=np.pi / 180.0)
        elif "n_dem=rpm" in text:
            log_of(folder, OWN, n_dem=380.0, n_r=380.0 / 60.0)
        else:
            log_of(folder, OWN)
    if page == "docs/your_own_model.md" and not (folder / "tank.csv").is_file():
        run_command("python make_logs.py")
    if page == "docs/learn.md" and not (folder / "cold.csv").is_file():
        run_command("python make_oil.py")
    if page == "docs/your_own_model.md" and "record = " in text:
        from vaneloop.identification import Record

        data = {n: np.loadtxt(folder / f"{n}.csv", delimiter=",", skiprows=1).T for n in ("tank", "other")}
        t, pump, level = data["tank"]
        other = Record("run 2", data["other"][0], {"pump": data["other"][1], "level": data["other"][2]})
        return {"t": t, "pump": pump, "level": level, "other": other}
    if page == "docs/bus.md":
        none = np.zeros((0, 2), np.int64)
        return {
            "received": none,
            "frames": none,
            "rows": none,
            "at": np.zeros(0, np.int64),
            "ticks": 20,
            "n_dem": np.full(100, 80.0),
        }
    if page == "docs/injection.md":
        toml = re.search(r"```toml\n(title.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.S)
        assert toml is not None
        (folder / "my_day.toml").write_text(toml[1], encoding="utf-8")
        shutil.copy(ROOT / "tables" / "calibration.toml", folder / "mine.toml")
    if page == "docs/own_controller.md" and (folder / "my_controller").is_dir():
        if shutil.which("gcc") is None or shutil.which("make") is None:
            pytest.skip("no C compiler: gcc or make is not installed")
        subprocess.run(["make", "-C", str(folder / "my_controller")], check=True, capture_output=True)
        shutil.copy(folder / "my_controller" / "reactions.toml", folder)
    if page == "docs/fmu.md":
        pytest.importorskip("fmpy")
        (folder / "extended.toml").write_text("[effects.valve_dead_band]\nhalf_width = 1.2\n", encoding="utf-8")
    if page == "docs/tables.md":
        shutil.copy(ROOT / "tables" / "calibration.toml", folder / "my_calibration.toml")
    if page == "docs/scheduling.md":
        shutil.copy(ROOT / "tables" / "geometry.toml", folder / "engine7.toml")
        shutil.copy(ROOT / "tables" / "schedules.toml", folder / "targets.toml")
        c = read_log(ROOT / EXAMPLE, require=()).channels
        write_log(
            folder / "loop.csv",
            {k: Channel(c[k].t[::10], c[k].values[::10]) for k in ("n_dem", "x_lvdt", "vigv", "vgv1", "vgv2")},
        )
    return {}


SAID: dict[str, str] = {}  # what a command printed that several pages have, and that only reads what ships


def run_shared(text: str, heard: pytest.CaptureFixture[str]) -> None:
    """A command line; one that only reads what ships is run once for all pages."""
    words = shlex.split(text)
    if not (len(words) == 3 and words[2].startswith(("examples/", "--all")) or text.startswith("python -m hil.replay")):
        run_command(text)
        return
    before = heard.readouterr()
    if text not in SAID:
        run_command(text)
        SAID[text] = "".join(heard.readouterr())
    print(*before, SAID[text], sep="")


def run_command(text: str) -> None:
    """A command line, in this process where it is ours."""
    words = shlex.split(text)
    if words[0] == "vaneloop":
        with pytest.MonkeyPatch.context() as m:
            m.setattr(sys, "argv", words)
            try:
                code = main(words[1:])
            except SystemExit as leaving:
                code = int(leaving.code or 0)
        assert code in (0, 1), f"{text}: exit code {code}"
    elif words[0] != "make":  # its targets are looked up by name; they run all of this, and more
        assert words[0] == "python", text
        done = subprocess.run([sys.executable, *words[1:]], capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, f"{text}\n{done.stderr}"


def skipped(page: str, step: Step, long: bool) -> bool:
    """Whether the step is not run."""
    run = Step(step.line, step.kind, replaced(page, step.text))
    named = step.text in NAMES or re.match(r"# \w+\.py\n", step.text) is not None
    return named or bool(step.listed(NOT_RUN)) or (bool(run.listed(LONG)) and not long)


def misquoted(page: str, said: str, long: bool) -> list[str]:
    """Lines of output that the page quotes and that its steps, where they were run, did not print."""
    heard, out = tokens(said), []
    first: dict[int, str] = {}  # line of output of a block
    for block, line, quoted in lines_of(ROOT / page, OURS):
        above = [s for s in ALL[page] if s.line <= (block if s.line == block else line)]
        what = next((k for k in NO_OUTPUT.get(page, {}) if first.setdefault(block, quoted).startswith(k)), None)
        if above and not skipped(page, above[-1], long) and what is None and absent(quoted, heard):
            out.append(f"{page}:{line}: {quoted}")
    return out


def run_page(page: str, folder: Path, request: pytest.FixtureRequest, long: bool) -> None:
    """Run a page's steps; ``long``: also those that take long. What it quotes of them must be what they print."""
    (folder / "examples").symlink_to(ROOT / "examples")
    for s in ALL[page]:
        if s.kind == "python" and (name := re.match(r"# (\w+\.py)\n", s.text)):
            (folder / name[1]).write_text(s.text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as m:
        m.chdir(folder)
        m.syspath_prepend(str(ROOT))
        m.setenv("COLUMNS", "200")
        heard = request.getfixturevalue("capfd")
        for s in ALL[page]:
            run = Step(s.line, s.kind, replaced(page, s.text))
            if skipped(page, s, long):
                continue
            given = before(page, run, folder)
            try:
                if run.kind == "command":
                    run_shared(run.text, heard)
                else:
                    file = folder / f"line_{s.line}.py"  # numba caches compiled code beside a file
                    file.write_text(run.text, encoding="utf-8")
                    names = runpy.run_path(str(file), init_globals=given, run_name=f"line_{s.line}")
                    for f in [f for n, f in names.items() if n.startswith("test_") and callable(f)]:
                        f(request.getfixturevalue("sil"))
            except Exception as e:
                pytest.fail(f"{page}:{s.line}: {run.text.splitlines()[0]}: {type(e).__name__}: {e}")
        said = "\n".join(heard.readouterr())
        sys.stdout.write(said)
    assert misquoted(page, said, long) == []


@pytest.mark.parametrize(
    ("quoted", "said", "there"),
    [("x_lvdt  0.6616 mm", "│ x_lvdt │ 0.66162 │ mm │", True), ("x_lvdt 0.6616 mm", "x_lvdt 0.6618 mm", False),
     ("12 of 40", "12 of 40 logs", True), ("vgv1 fits", "vgv2 fits", False), ("fails", "it fails", True),
     ("nominal 130 -> ... -> floor 1.00", "nominal 130.4 -> a 3 -> floor 1.0", True), ("-0.1 mm", "0.1 mm", False),
     ("1,234 frames", "1234 frames", True), ("1.2e-07", "1.23e-07", True), ("1.2e-07", "1.4e-07", False)],
)  # fmt: skip
def test_a_quote_is_held_word_by_word_and_digit_by_digit(quoted: str, said: str, there: bool) -> None:
    assert absent(quoted, tokens(said)) is not there


LEFT = [p for p in REAL if p in DEAR or any(Step(0, s.kind, replaced(p, s.text)).listed(LONG) for s in ALL[p])]


@pytest.mark.parametrize("page", [page for page in REAL if page not in DEAR])
def test_a_page_s_commands_and_snippets_run(page: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    run_page(page, tmp_path, request, long=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", LEFT)
def test_a_long_page_runs_and_what_takes_long_of_the_others(
    page: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    run_page(page, tmp_path, request, long=True)


def test_what_is_run_in_real_time_ends_by_itself() -> None:
    """A command that runs until Ctrl-C would stand in the way of all other tests."""
    live = ("vaneloop run", "vaneloop ecu", "vaneloop record")
    run = [(page, replaced(page, s.text)) for page in PAGES for s in ALL[page] if not skipped(page, s, True)]
    ends = ("--duration", "--bus lockstep")
    endless = [f"{page}: {text}" for page, text in run if text.startswith(live) and not any(e in text for e in ends)]
    assert not endless, f"state a --duration, or enter it in NOT_RUN with its reason: {endless}"
