"""What `vaneloop COMMAND --help` shows can be typed, and what a benchmark's shows, too: options that exist, files that
are there or are made by an example before.
"""

from __future__ import annotations

import importlib
import json
import re
import shlex
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

from benchmarks import start
from hil.logs import Channel, read_log, write_log
from hil.logs.formats import FORMATS
from tests.conftest import ROOT
from vaneloop.base import terminal
from vaneloop.cli.main import COMMANDS, GROUPS, IN_CHECKOUT, main

_KINDS = "|".join(s[1:] for s in (*FORMATS, ".toml", ".dbc", ".html", ".py", ".json"))
_FILE = re.compile(rf"[\w./-]+\.(?:{_KINDS})|[\w./-]+/")
_MAKES = {"--out", "--export", "--record", "--report", "--json"}
# what follows `vaneloop` or `python -m` -> the module that takes the words after it
MODULES = {name: module for name, (module, _) in COMMANDS.items()} | {module: module for module in IN_CHECKOUT.values()}


def typed(words: list[str]) -> int:
    """Run the words behind ``vaneloop`` or ``python -m``; return the exit code."""
    return main(words) if words[0] in COMMANDS else start.main(words[0], words[1:])


def parser_of(name: str) -> terminal.Parser:
    module = importlib.import_module(MODULES[name])
    parser = terminal.Parser(prog=f"vaneloop {name}", description=module.DESCRIPTION)
    module.add_options(parser)
    return parser


@cache
def examples(name: str) -> list[list[str]]:
    """Words behind ``vaneloop`` or ``python -m`` of every example in a help; what is two blanks away is a remark."""
    text = parser_of(name).format_help()
    lines = re.search(r"^examples:\n((?:  .*\n?)+)", text, re.M)
    assert lines, f"{name} --help shows no example"
    out = []
    for line in lines[1].splitlines():
        command = re.split(r"\S(?=\s{2,})", line.strip(), maxsplit=1)[0]
        whole = line.strip()[: len(command) + 1]
        program = re.search(r"\b(?:vaneloop|python -m) ", whole)
        assert program, line
        out.append(shlex.split(whole[program.end() :]))
    return out


@pytest.mark.parametrize("name", list(MODULES))
def test_every_example_of_the_help_parses(name: str) -> None:
    for words in examples(name):
        parser_of(words[0]).parse_args(words[1:])  # exits with 2 where an option does not exist


@pytest.mark.parametrize("name", list(MODULES))
def test_every_file_that_the_help_names_is_there(name: str) -> None:
    """It is in the checkout, an example above it makes it, or it is in capitals: the reader's own."""
    there: set[str] = set()
    for words in examples(name):
        makes = {b for a, b in zip(words, words[1:], strict=False) if a in _MAKES}
        makes |= {words[1]} if words[0] in ("record", "new-controller") else set()
        made = (*(there | makes), *(f for f in there if f.endswith("/")))
        for word in words[1:]:
            if _FILE.fullmatch(word) and not word.startswith(made):
                assert (ROOT / word).exists() or Path(word).stem.isupper(), f"{' '.join(words)}: {word}"
        there |= makes


def test_a_missing_file_and_a_wrong_option_in_an_example_would_be_seen() -> None:
    with pytest.raises(SystemExit):
        parser_of("replay").parse_args(["examples/engine_run.blf", "--tolerence", "vigv=1"])
    assert not (ROOT / "examples/engine_run.log").exists() and _FILE.fullmatch("examples/engine_run.log")


# ---- the help of the whole -------------------------------------------------------------------------------------------


def test_the_help_says_what_the_readme_says(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    said = capsys.readouterr().out
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    first, second = readme.split("\n\n")[1:3]
    assert said.startswith(f"{first}\n\n{second}\n\n")
    block = re.search(r"## Find what a model lacks\n.*?```\n(.*?)```", readme, re.S)
    assert block
    steps = [re.sub(r"\s+#.*", "", line) for line in block[1].splitlines()]
    shown = re.search(r"^first steps, in a checkout:\n((?:  .*\n)+)", said, re.M)
    assert shown and len(steps) == 5
    assert [line.strip() for line in shown[1].splitlines()] == steps


def test_the_help_shows_every_command_in_one_of_five_groups(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--help"])
    said = capsys.readouterr().out
    assert len(GROUPS) == 5 and sum(map(len, GROUPS.values())) == len(COMMANDS)
    for title, group in GROUPS.items():
        shown = re.search(rf"^{title}:\n((?:  .*\n)+)", said, re.M)
        assert shown, title
        rows = [re.split(r"\s{2,}", line.strip(), maxsplit=1) for line in shown[1].splitlines()]
        assert rows == [[name, text] for name, (_, text) in group.items()]
    assert max(map(len, said.splitlines())) <= 120


# ---- the examples, run -----------------------------------------------------------------------------------------------

LIVE = "runs in real time, on a bus or in a browser, until Ctrl-C: tests/test_realtime.py, test_record.py, test_web.py"
# the beginning of an example that is not run here -> why
NOT_RUN = {
    "run --bus vcan0": LIVE,
    "run --bus local": LIVE,
    "run --bus lockstep --inputs run.mf4": LIVE,
    "ecu": LIVE,
    "record": LIVE,
    "web": LIVE,
    "inject flood_low_priority --bus vcan0": LIVE,
    "inject --all --controller FW.so": "a library of the reader's own: tests/test_native.py",
    "inject MY_DAY.toml": "a scenario of the reader's own: tests/test_inject.py",
    "replay YOURS.log": "a log and a DBC of the reader's own: tests/test_logs.py",
    "schedule --log LOOP.mf4": "another format of the loop that the example before it takes",
    "fuzz --replay": "needs a failure to repeat: tests/test_fuzz.py makes one",
    "benchmarks.hidden_effect --logs 200": "the same as the example before it, on more logs",
    "benchmarks.hidden_law --systems": "minutes a system: tests/test_hidden_law.py",
    "learn LOG": "logs and a model of the reader's own: tests/test_learn.py",
    "extend NEW": "goes on from the example before it: tests/test_learn.py",
    "compare NEW": "goes on from the example before it: tests/test_learn.py",
    "fleet": "logs of many engines, workers of a cluster: tests/test_fleet_run.py",
    "benchmarks.fleet_demo": "logs of some engines: tests/test_fleet_report.py makes them",
    "campaign": "a plan of the reader's own, workers of a cluster: tests/test_campaign.py",
    "a2l --out mine.a2l --controller": "a library of the reader's own: tests/test_xcp.py",
    "export-fmu --part plant --model M.toml": "a model of the reader's own: tests/test_fmu.py",
    "fuzz --tool": "a minute each: tests/test_fuzz.py",
}
SMALLER = {"--frames 10000000": "--frames 20000", "--logs 40": "--logs 1 --duration 60",
           "--logs 60": "--logs 1 --duration 60 --seed 3",  # a draw at random takes up to five times as long
           "--out out/motor.parquet": "--out out/motor.parquet --logs 1 --duration 60",
           "engine-test --": "engine-test --profile short.toml --",  # whole in docs/engine_test.md and the README
           "strategies --": "strategies --dwell 0.05 --",
           "inject --all --junit": "inject demand_stops --junit"}  # all of them in the README  # fmt: skip
# commands whose examples take long
LONG = {"strategies", "design", "spatial", "clearance", "experiment", "diagnose", "engine-test"}
LONG_EXAMPLES = {
    "inject --all", "schedule --geometry", "engine-test --tables", "export-fmu --part controller",
    "benchmarks.hidden_effect",
}  # fmt: skip


def runs(long: bool) -> list[tuple[str, str]]:
    """Command and example, as it is run: the quick ones, or the long ones. One that several helps have is run once."""
    out: dict[str, str] = {}
    for name in MODULES:
        for words in examples(name):
            line = shlex.join(words)
            if any(line == k or line.startswith(f"{k} ") for k in NOT_RUN) or "(" in line or "|" in words:
                continue
            slow = words[0] in LONG or any(line.startswith(k) for k in LONG_EXAMPLES)
            if slow == long:
                out.setdefault(line, name)
    return [(name, line) for line, name in out.items()]


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a reader of the help has it: the checkout's files, own logs, and what other examples wrote."""
    folder = tmp_path_factory.mktemp("reader")
    for name in ("examples", "tables"):
        (folder / name).symlink_to(ROOT / name)
    channels = read_log(ROOT / "examples" / "hidden_effect.parquet").channels
    loop = {k: Channel(channels[k].t[::10], channels[k].values[::10]) for k in ("n_dem", "x_lvdt", "vigv")}
    write_log(folder / "LOOP.csv", loop)
    write_log(folder / "BENCH.csv", {k: Channel(c.t[:3000], c.values[:3000]) for k, c in channels.items()})
    profile = tomllib.loads((ROOT / "tables" / "engine_test.toml").read_text(encoding="utf-8"))
    short = []
    for name, table in profile.items():
        cut = {key: value[:9] if isinstance(value, list) else value for key, value in table.items()}
        short += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in cut.items())]
    (folder / "short.toml").write_text("\n".join(short), encoding="utf-8")
    with pytest.MonkeyPatch.context() as m:
        m.chdir(folder)
        for line in (
            "extend examples/hidden_effect.parquet --effect valve_dead_band --out with_dead_band.toml --quiet",
            "map BENCH.csv --design-rpm 38000 --out bench.toml --quiet",
            "schedule --log LOOP.csv --out engine7/ --quiet",
        ):
            assert main(line.split()) in (0, 1), line
        (folder / "engine7" / "geometry.toml").write_bytes((ROOT / "tables" / "geometry.toml").read_bytes())
    return folder


def run(line: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    for words, instead in SMALLER.items():
        line = line.replace(words, instead)
    assert typed(shlex.split(line)) in (0, 1), line


@pytest.mark.parametrize(("name", "line"), runs(long=False), ids=lambda x: x)
def test_an_example_of_the_help_runs(name: str, line: str, reader: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(line, reader, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "line"), runs(long=True), ids=lambda x: x)
def test_a_long_example_of_the_help_runs(name: str, line: str, reader: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(line, reader, monkeypatch)


def test_every_exception_is_an_example_of_some_help() -> None:
    lines = [shlex.join(words) for name in MODULES for words in examples(name)]
    assert [k for k in [*NOT_RUN, *LONG, *LONG_EXAMPLES] if not any(x.startswith(k) for x in lines)] == []
    assert [k for k in SMALLER if not any(k in x for x in lines)] == []


@pytest.mark.slow
def test_a_command_reads_can_without_asammdf() -> None:
    """asammdf takes most of the time in which python-can is imported, and whoever else wants it gets it."""
    code = (
        "import sys\nfrom vaneloop.cli import main\nmain.main = lambda words: 0\n"
        "try:\n    main.run()\nexcept SystemExit:\n    pass\n"
        "import can\nprint('asammdf' in sys.modules)\nimport asammdf\nprint(asammdf.__name__)\n"
    )
    for words in (["replay", "a.log"], ["run", "--inputs", "a.MF4"]):
        done = subprocess.run(
            [sys.executable, "-c", code, *words], cwd=ROOT, capture_output=True, text=True, check=True
        )
        assert done.stdout.split() == ["False", "asammdf"]
