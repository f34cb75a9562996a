"""A full disk: each file that a command writes is the new one or, byte for byte, the old one, and nothing else is left.

The disk is full by RLIMIT_FSIZE, the kernel's own limit of what a file may hold (EFBIG): at 0 bytes, 1, half of what is
written, and all but one. A full file system (ENOSPC), and kills: tests/test_files.py.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import os
import re
import resource
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from benchmarks import blind
from hil.calibrate import elements, prepare
from hil.logs import Channel, LogError, read_log, write_log
from hil.logs.formats import FORMATS
from hil.logs.recorder import Recorder
from hil.logs.recordings import read_record
from hil.native import black_box, crash_log
from hil.native.black_box import Box
from hil.uds import TroubleMemory
from plant import load_geometry, load_schedules
from tests.conftest import ROOT
from tests.test_fleet_report import synthetic
from tests.test_help import parser_of
from tests.test_learn import logs_of_a_tank
from tests.test_page_outlines import campaign, group
from tests.test_record import some_frames
from tests.test_xcp_spec import shipped
from vaneloop.base import files
from vaneloop.base.errors import InputError
from vaneloop.cli.attended import _Keeper
from vaneloop.cli.main import COMMANDS, main
from vaneloop.design.schedule_files import write_tables
from vaneloop.pages.page import Page
from vaneloop.verbs.learn import Learned

LOG = str(ROOT / "examples" / "hidden_effect.parquet")
OLD = b"what was there before\n" * 40


@contextlib.contextmanager
def full_at(size: int) -> Iterator[None]:
    """No file grows beyond ``size`` bytes. Python ignores the signal (SIGXFSZ), so that a write fails with EFBIG."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def sizes(whole: int) -> list[int]:
    """Where the disk is full: nothing fits, a byte, half, all but a byte of a file of ``whole`` bytes."""
    return sorted({0, 1, whole // 2, whole - 1})


def held(folder: Path) -> dict[str, bytes]:
    """What a folder holds, hidden files too."""
    return {f.relative_to(folder).as_posix(): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


# ---- every option of every command that writes a file ---------------------------------------------------------------


class Case(NamedTuple):
    """A command, its options that write files, its exit code, and what is there and stands in for its work before."""

    words: str
    writes: str
    code: int = 0
    before: Callable[[Path, pytest.MonkeyPatch], object] | None = None
    slow: bool = True


def short_profile(folder: Path, _: pytest.MonkeyPatch) -> None:
    """A demand of half a minute."""
    said = 'unit = "%s"\norigin = "chosen"\n'
    lists = {"speed": ("%", [99.5, 60.0]), "rate": ("%/s", [5.0, 5.0]), "dwell": ("s", [20.0, 5.0])}
    text = f"[start]\nvalue = 60.0\n{said % '%'}"
    for name, (unit, values) in lists.items():
        text += f"[{name}]\n{said % unit}values = {values}\n"
    (folder / "profile").write_text(text)


def old_model(folder: Path, _: pytest.MonkeyPatch) -> None:
    """A model that is read and written under one name."""
    (folder / "m.toml").write_text('[meta]\nnote = "old"\n')


def tank(folder: Path, _: pytest.MonkeyPatch) -> None:
    """A system of the user's own, to learn a law of."""
    logs_of_a_tank(folder)


def rivals(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An experiment's answer: to find rivals and try profiles takes half a minute."""
    t = np.arange(0.0, 60.0, 0.1)
    told = {"t": t, "inputs": {"n_dem": ("%", t)}, "table": [], "heads": {}, "separates": True}
    page = Page("t", "v")
    answer = SimpleNamespace(recommended=told, to_dict=lambda: told, sentence=str, report=lambda p, _: page.write(p))
    monkeypatch.setattr("vaneloop.cli.experiment.diagnosed", lambda *_, **__: None)
    monkeypatch.setattr("vaneloop.cli.experiment.recommend", lambda *_, **__: answer)


def trials(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A campaign whose trials are done."""
    for name, gives in (
        ("begin", (SimpleNamespace(search=None), None, SimpleNamespace(damaged=[]))),
        ("take_samples", 0),
        ("take_searches", 0),
    ):
        monkeypatch.setattr(f"vaneloop.fleet.campaign.{name}", lambda *_, gives=gives: gives)
    monkeypatch.setattr("vaneloop.fleet.campaign.judge", lambda *_: campaign([group()]))
    monkeypatch.setattr("vaneloop.cli.campaign.load_plan", lambda _: SimpleNamespace(firmware=[]))
    for name in ("_work", "_show", "tell_damaged"):
        monkeypatch.setattr(f"vaneloop.cli.campaign.{name}", lambda *_: None)


def fleet(folder: Path, _: pytest.MonkeyPatch) -> None:
    """A finished run of three engines."""
    synthetic(folder, 3, 12)


TABLES = " ".join(f"engine/{name}.toml" for name in ("stroke_tables", "vane_angles", "geometry", "schedules"))
CASES = {
    "map": Case("{log}", "--out m.toml --json j.json --export e.csv", slow=False),
    "replay": Case("{log}", "--out o.csv --report p.html --json j.json"),
    "compare": Case("{log}", "--out o.parquet --report p.html --json j.json"),
    "locate": Case("{log}", "--report p.html --json j.json", 1),
    "diagnose": Case("{log} --workers 1", "--report p.html --json j.json", 1),
    "learn": Case("cold.csv --system tank.py", "--out l.toml --report p.html --json j.json", 1, tank),
    "extend": Case(
        "{log} --effect valve_dead_band --effect aero_load --model m.toml",
        "--out m.toml --report p.html --json j.json", 0, old_model,
    ),
    "experiment": Case("{log}", "--out e.csv --report p.html --json j.json", 0, rivals),
    "engine-test": Case("--profile profile", "--report p.html --json j.json", 0, short_profile),
    "strategies": Case("--profile profile", "--report p.html --json j.json", 1, short_profile),
    "fleet status": Case("run", "--json j.json", 0, fleet, slow=False),
    "fleet report": Case("run", "--report p.html --json j.json", 1, fleet),
    "campaign": Case("plan.toml", "--report p.html --junit u.xml --json j.json", 0, trials, slow=False),
    "schedule": Case("--adjust none", f"--out engine {TABLES} --report p.html --json j.json"),
    "spatial": Case("--points 9", "--report p.html --json j.json"),
    "clearance": Case("", "--report p.html --json j.json"),
    "inject": Case("nominal", "--junit u.xml --json j.json"),
    "fuzz": Case("--frames 200000 --seed 1 --stroke-limit 30", "--out f.log --json j.json", 1),
    "a2l": Case("", "--out a.a2l --json j.json", slow=False),
    "export-fmu": Case("--part plant", "--out f.fmu --json j.json"),
    "design": Case("", "--report p.html --json j.json"),
}  # fmt: skip
RUN_FOLDER = "a run folder: tests/test_fleet_folder.py, with VANELOOP_FLEET_FULL"
RECORDED = "test_a_recording_on_a_full_disk_is_whole"
JSON = "as of every other command"
# options that the cases leave out: where what they write is tried
ELSEWHERE = {
    **{(name, "json"): JSON for name in ("run", "ecu", "record", "new-controller")},
    **{(f"fleet {name}", "json"): JSON for name in ("run", "work")},
    **{(name, "out"): RUN_FOLDER for name in ("campaign", "fleet run")},
    **{("run", "record"): RECORDED, ("record", "out"): RECORDED},
    ("learn", "python"): "test_a_law_in_python",
    ("fleet report", "tables_out"): "DuckDB writes beside the target, tests/test_fleet_folder.py",
    ("run", "xcp_save"): "test_calibration_tables_change_together",
    ("run", "uds_memory"): "test_trouble_codes_are_kept",
    ("new-controller", "folder"): "test_a_project_is_written_whole_or_not_at_all",
}


def options_that_write() -> set[tuple[str, str]]:
    """Command and option, of all that a parser has whose name or help says that it writes."""
    found = set()

    def look(name: str, parser: argparse.ArgumentParser) -> None:
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for inner, its in action.choices.items():
                    look(f"{name} {inner}", its)
            elif action.type is None and action.nargs != 0 and action.metavar:
                told = re.sub(r"written by|writes one|writes an", "", action.help or "")
                if action.dest in ("out", "record") or re.search(r"\b(writes?|keeps?|save|saved)\b", told):
                    found.add((name, action.dest))

    for name in COMMANDS:
        look(name, parser_of(name))
    return found


def test_every_option_that_writes_a_file_is_tried() -> None:
    tried = {(n, w[2:].replace("-", "_")) for n, c in CASES.items() for w in c.writes.split() if w.startswith("--")}
    found = {(name, option) for name, option in options_that_write() if option != "save_crash"}
    assert found == tried | ELSEWHERE.keys() and not tried & ELSEWHERE.keys()
    assert {name for name, _ in found} == {n for n in COMMANDS if n not in ("web", "completion", "fleet")} | {
        f"fleet {n}" for n in ("run", "work", "status", "report")
    }


class FittedCandidate:
    """A run of a command in which each file is first written on a full disk, by children that are forked there."""

    def __init__(self, folder: Path, names: set[str]):
        self.folder, self.names, self.pipe, self.begun = folder, names, -1, list[str]()
        self.tried, self.wrong = set[str](), list[str]()

    def begin(self, path: str | Path, only_new: bool = False) -> Any:
        """In place of `files._begin`: where a file is begun that an option names, and none is open."""
        place = os.path.relpath(path, self.folder)
        ours = place in self.names and sys._getframe(1).f_code.co_name != "check"
        if ours and self.pipe < 0 and not any(map(os.path.exists, self.begun)):
            before, whole = held(self.folder), self.fork(None)
            for size in sizes(int(whole)) if whole is not None else ():
                said = self.fork(size)
                if said is None:
                    break
                code, err = json.loads(said or '["it died", ""]')
                line = re.fullmatch(r"vaneloop: cannot write (.*): File too large", "".join(err.splitlines()[-1:]))
                if code != 2 or line is None or line[1] not in self.names or held(self.folder) != before:
                    self.wrong.append(f"{path} at {size} of {whole}: {code}, {err}; {sorted(held(self.folder))}")
        target = BEGIN(path, only_new)
        if ours:
            self.tried.add(place)
            self.begun.append(target.part)
        return target

    def fork(self, size: int | None) -> str | None:
        """None in a child, which goes on where a file may hold ``size`` bytes; in the parent what it said in the end.

        size  None: as many as it likes, until what belongs together is written; it says how long the longest file is
        """
        out, into = os.pipe()
        pid = os.fork()
        if pid:
            os.close(into)
            with os.fdopen(out) as said:
                text = said.read()
            os.waitpid(pid, 0)
            return text
        self.pipe, self.begun = into, []
        if size is None:
            os.replace = self.tell  # type: ignore[assignment]
        else:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        return None

    def tell(self, *_: object) -> None:
        """In place of os.replace: the end of the child that looks how long the files are."""
        most = max(os.stat(part).st_size for part in self.begun)
        for part in self.begun:
            os.unlink(part)
        os.write(self.pipe, str(most).encode())
        os._exit(0)


BEGIN = files._begin


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * c.slow) for n, c in CASES.items()])
def test_every_file_of_a_command_is_the_old_one_where_the_disk_is_full(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case = CASES[name]
    names = {w for w in case.writes.split() if "." in w}
    (tmp_path / "engine").mkdir()
    for word in names:
        (tmp_path / word).write_bytes(OLD)
    if case.before:
        case.before(tmp_path, monkeypatch)
    old = held(tmp_path)
    monkeypatch.chdir(tmp_path)
    tried = FittedCandidate(tmp_path, names)
    monkeypatch.setattr(files, "_begin", tried.begin)
    words = [w for w in case.writes.split() if w not in TABLES.split()]
    more = ["--out", "run"] if name == "campaign" else []
    try:
        code: Any = main([*name.split(), *case.words.format(log=LOG).split(), *words, *more])
    except BaseException as e:
        code = repr(e)
    err = capsys.readouterr().err
    if tried.pipe >= 0:
        os.write(tried.pipe, json.dumps([code, err]).encode())
        os._exit(0)
    assert code == case.code, err
    assert tried.wrong == []
    assert tried.tried == names
    now = held(tmp_path)
    assert all(now[n] != old[n] for n in names) and not [n for n in now if n.endswith(".part")]


# ---- what the commands above do not write ---------------------------------------------------------------------------


def kept_when_full(
    folder: Path, write: Callable[[], object], error: type[Exception] = InputError, dated: int = 0
) -> None:
    """Hold that ``write`` leaves ``folder`` as it is, wherever the disk is full; and that it writes on an empty one.

    dated  bytes by which the file's length differs from one time to the next
    """
    old = held(folder)
    write()
    new = held(folder)
    changed = [n for n in new if new[n] != old.get(n)]
    assert changed
    for size in sizes(max(len(new[n]) for n in changed) - dated):
        for name in changed:
            (folder / name).write_bytes(old[name]) if name in old else (folder / name).unlink()
        with full_at(size), pytest.raises(error, match=r"^cannot write .*: File too large$"):
            write()
        assert held(folder) == old, size


CHANNELS = {
    name: Channel(np.arange(2000) * 0.01, 50.0 + np.sin(np.arange(2000) * 0.01 * k))
    for k, name in enumerate(("n_dem", "n_r", "x_lvdt"))
}


@pytest.mark.parametrize("suffix", [*FORMATS, pytest.param(".mf4 of frames", marks=pytest.mark.slow)])
def test_a_log_of_every_format(suffix: str, tmp_path: Path) -> None:
    file, _, frames = (tmp_path / f"a{suffix}").as_posix().partition(" ")
    dbc = ROOT / "tables" / "vgv.dbc" if frames else None
    Path(file).write_bytes(OLD)
    dated = 40 if suffix in (".asc", ".trc") else 0
    kept_when_full(tmp_path, lambda: write_log(file, CHANNELS, dbc=dbc), LogError, dated)
    write_log(file, CHANNELS, dbc=dbc)
    assert read_log(file).channels["n_dem"].values[-1] == pytest.approx(CHANNELS["n_dem"].values[-1], abs=0.1)


@pytest.mark.parametrize("suffix", [s for s, f in FORMATS.items() if f.recorder])
@pytest.mark.parametrize("room", [0, 50, 700, 3000, 9000, 40_000])
def test_a_recording_on_a_full_disk_is_whole(suffix: str, room: int, tmp_path: Path) -> None:
    """What was appended before is in the file, and nothing of what did not fit; an earlier recording is there."""
    file, done = tmp_path / f"r{suffix}", 0
    file.write_bytes(OLD)
    with full_at(room):
        try:
            recorder = Recorder(file)
        except InputError as e:
            assert str(e) == f"cannot write {file}: File too large"
            assert held(tmp_path) == {file.name: OLD}
            return
        with pytest.raises(InputError, match=rf"^cannot write {file}: File too large; it ends after ") as e:
            while True:
                recorder.put(some_frames(100, done).tobytes())
                recorder.flush()
                done += 100
        recorder.close()
    assert f"it ends after {done:,} frames" in str(e.value)
    assert (tmp_path / f"r.1{suffix}").read_bytes() == OLD and len(held(tmp_path)) == 2
    if done:
        got = read_record(file)
        assert got.ms.tolist() == (some_frames(done)["ns"] // 10**6).tolist()


def test_calibration_tables_change_together(tmp_path: Path) -> None:
    _, cal = shipped()
    of = elements.elements_of(cal)
    row = np.concatenate([cal.k, cal.table.reshape(-1), cal.angles.reshape(-1)])
    assert prepare.save(of, row, tmp_path) == (0, "")
    for file in tmp_path.iterdir():
        file.write_bytes(OLD)
    kept_when_full(tmp_path, lambda: elements.write_tables(tmp_path, of, row))
    with full_at(500):
        number, why = prepare.save(of, row, tmp_path)
    assert number == prepare.DENIED and why.endswith(": File too large")


@pytest.mark.parametrize("fit", range(4))
def test_schedule_tables_change_together(fit: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full after ``fit`` of the four files."""
    geometry, schedules = load_geometry("geometry.toml"), load_schedules("schedules.toml")
    result: Any = SimpleNamespace(table=np.zeros((4, 9)), geometry=geometry, schedules=schedules, origin="measured")
    for file in write_tables(result, tmp_path):
        file.write_bytes(OLD)
    begun: list[object] = []

    def begin(path: str | Path, only_new: bool = False) -> Any:
        begun.append(path)
        if len(begun) > fit:
            raise OSError(errno.ENOSPC, "full")
        return BEGIN(path, only_new)

    monkeypatch.setattr(files, "_begin", begin)
    with pytest.raises(InputError, match=r"^cannot write .*\.toml: No space left on device$"):
        write_tables(result, tmp_path)
    assert held(tmp_path) == dict.fromkeys(held(tmp_path), OLD) and len(held(tmp_path)) == 4


def test_trouble_codes_are_kept(tmp_path: Path) -> None:
    file = tmp_path / "codes.json"
    keeper = _Keeper(file)
    text = TroubleMemory().dump()
    file.write_bytes(OLD)
    keeper._text = text
    for size in sizes(len(text)):
        with full_at(size):
            keeper._now()
        assert held(tmp_path) == {file.name: OLD}
    keeper._now()
    assert file.read_text() == text


def test_rows_of_a_blind_benchmark(tmp_path: Path) -> None:
    rows = [{"index": k, "verdict": "none"} for k in range(100)]
    blind.write_rows(tmp_path / "r.parquet", rows[:50])
    kept_when_full(tmp_path, lambda: blind.write_rows(tmp_path / "r.parquet", rows))


def test_a_law_in_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vaneloop.verbs.learn.python_law", lambda *_: "def law(x): return x\n")
    found: Any = SimpleNamespace(laws=[None])
    (tmp_path / "l.py").write_bytes(OLD)
    kept_when_full(tmp_path, lambda: Learned.write_python(found, tmp_path / "l.py"))


def test_a_crash_log(tmp_path: Path) -> None:
    _, cal = shipped()
    flashed = {name: getattr(cal, name).tolist() for name in ("k", "table", "angles")}
    box = Box("c.so", flashed, "step", 99, np.zeros((100, len(crash_log.INPUTS))), 0, 0.0)
    file = tmp_path / "c.parquet"
    assert crash_log.write(str(file), box, "it fell") == f"crash log: {file}"
    whole = file.stat().st_size
    file.write_bytes(OLD)
    for size in sizes(whole):
        with full_at(size):
            assert crash_log.write(str(file), box, "it fell") == f"no crash log: cannot write {file}: File too large"
        assert held(tmp_path) == {file.name: OLD}


def test_a_black_box_has_its_place_on_the_disk_before_the_controller_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is memory that is a file: where the disk has no place for it, a tick would end with SIGBUS."""
    _, cal = shipped()
    monkeypatch.setattr(black_box, "_WATCHED", [(tmp_path, 1)])
    head, rows = black_box.new("c.so", cal)
    (box,) = (f for f in tmp_path.iterdir() if f.suffix != ".json")
    assert box.stat().st_blocks * 512 >= head.nbytes + rows.nbytes
    with full_at(100), pytest.raises(InputError, match=f"^cannot write {tmp_path}: File too large$"):
        black_box.new("c.so", cal)


@pytest.mark.parametrize("there", [True, False])
def test_a_project_is_written_whole_or_not_at_all(
    there: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mine"
    if there:
        folder.mkdir()
    before = sorted(tmp_path.rglob("*"))
    for size in (0, 1, 500, 5000):
        with full_at(size):
            assert main(["new-controller", str(folder), "--quiet"]) == 2
        assert re.fullmatch(r"vaneloop: cannot write .*: File too large\n", capsys.readouterr().err)
        assert sorted(tmp_path.rglob("*")) == before
    assert main(["new-controller", str(folder), "--quiet"]) == 0
    assert len(held(folder)) == 8
