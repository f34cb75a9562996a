"""The list of log formats: what is made from it, and formats that other packages bring."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.logs import Channel, LogError, read_log, write_log
from hil.logs.formats import _PARTS, FORMATS, GROUP, OURS, Format, _function, format_of, spoken, suffixes, with_part
from hil.logs.recorder import check_name
from hil.logs.recordings import read_record
from tests.conftest import ROOT
from tests.test_help import parser_of
from vaneloop.base.errors import InputError
from vaneloop.base.extras import EXTRAS
from vaneloop.cli.main import main
from vaneloop.fleet.sources import find

PAGE = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
SUFFIXES = tuple(dict.fromkeys(s for f in OURS for s in f.suffixes))
T = np.arange(400) * 0.01
SPEED = 60.0 + 10.0 * np.sin(T)


# ---- ours ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("of", OURS, ids=lambda f: f.name)
def test_a_format_of_ours_has_its_parts(of: Format) -> None:
    for part in _PARTS:
        if (place := getattr(of, part)) is not None:
            assert callable(_function(place)), (of.name, part)
    assert of.source or of.frames
    written = bool(of.channels or of.frames_out)
    assert all((FORMATS.get(s) is of) == written for s in of.suffixes if written or s not in FORMATS)
    assert not of.extra or of.extra in EXTRAS


def test_formats_that_share_a_suffix_are_told_by_their_beginning_and_none_begins_as_another() -> None:
    for suffix in suffixes():
        alike = [f for f in OURS if suffix in f.suffixes]
        assert sum(not f.begins for f in alike) <= 1 and sum(bool(f.channels or f.frames_out) for f in alike) <= 1
    begins = [b for f in OURS for b in f.begins]
    assert not [(a, b) for a in begins for b in begins if a is not b and a.startswith(b)]


@pytest.mark.parametrize("suffix", [s for s, f in FORMATS.items() if f.begins])
def test_what_is_written_begins_as_its_format_and_is_told_by_that(suffix: str, tmp_path: Path) -> None:
    write_log(tmp_path / f"a{suffix}", {"n_dem": Channel(T, SPEED)})
    file = (tmp_path / f"a{suffix}").rename(tmp_path / "a.bin")
    first = FORMATS[suffix].suffixes[0]
    with pytest.raises(LogError, match=rf"suffix '\.bin' is not a log's; .*; it begins as .* does \(\{first}\)$"):
        read_log(file)


def test_the_page_s_tables_are_those_of_the_list() -> None:
    row = "| {} | {}{} | {} | {} |"
    lines = [
        row.format(", ".join(f"`{s}`" for s in f.suffixes), f.about,
                   f" (`pip install 'vaneloop[{f.extra}]'`)" if f.extra else "", f.names, "yes" if f.packed else "")
        for f in OURS
    ]  # fmt: skip
    missing = [line for line in lines if line not in PAGE]
    assert not missing, "docs/logs.md lacks\n" + "\n".join(missing)
    recorded = [s for f in OURS if f.recorder for s in f.suffixes]
    page = (ROOT / "docs" / "real_time.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\.\w+)` \|", page.split("## The record")[1].split("\n## ")[0], re.M) == recorded


def test_help_names_every_format() -> None:
    for name, option in (("replay", "log"), ("schedule", "--log"), ("replay", "--out")):
        assert all(s in help_of(name, option) for s in FORMATS), (name, option)
    known = spoken(f for f in OURS if f.recorder)
    assert known in help_of("record", "out") and known in help_of("run", "--record")


def help_of(name: str, option: str) -> str:
    action = next(a for a in parser_of(name)._actions if option in (*a.option_strings, a.dest))
    return str(action.help)


def test_what_a_list_of_formats_needs_imports_no_reader() -> None:
    code = (
        "import sys, hil.logs.formats as f\nf.suffixes()\n"
        "print(*(m for m in ('numpy', 'can', 'pyarrow') if m in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


# ---- of another package ----------------------------------------------------------------------------------------------


def blocks(kind: str) -> list[str]:
    """The code of a kind in the part of the page that says how a format is added from outside."""
    part = PAGE.split("### In a package of your own")[1].split("\n## ")[0]
    return re.findall(rf"```{kind}\n(.*?)```", part, re.S)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Put a package with this module and these entry points where Python finds it, as pip does."""

    def install(module: str, entries: str, name: str = "rig_logs") -> Path:
        place = tmp_path / f"site_{name}"
        (info := place / f"{name}-1.0.dist-info").mkdir(parents=True)
        (place / f"{name}.py").write_text(module)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name.replace('_', '-')}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{GROUP}]\n{entries}\n")
        monkeypatch.syspath_prepend(place)
        monkeypatch.delitem(sys.modules, name, raising=False)
        return place

    return install


@pytest.fixture
def rig(installed: Callable[..., Path], tmp_path: Path) -> Path:
    """The package that the page shows, installed, and a log of its format."""
    (module,), (project,) = blocks("python"), blocks("toml")
    name, value = re.findall(r'"(\.\w+)" = "([\w:]+)"', project)[0]
    installed(module, f"{name} = {value}")
    (tmp_path / "logs").mkdir()
    file = tmp_path / "logs" / "bench_2026-03-14.rig"
    file.write_text("".join(f"{t:.2f} {v:.9f} {v - 1.0:.9f}\n" for t, v in zip(T, SPEED, strict=True)))
    return file


def test_the_package_of_the_page_is_read_written_and_recorded_to(rig: Path, tmp_path: Path) -> None:
    log = read_log(rig)
    assert log.channels["n_dem"].values == pytest.approx(SPEED) and log.channels["n_r"].t == pytest.approx(T)
    write_log(tmp_path / "copy.rig", {k: log.channels[k] for k in ("n_dem", "n_r")})
    again = read_log(tmp_path / "copy.rig")
    assert again.channels["n_dem"].values == pytest.approx(log.channels["n_dem"].values)
    assert suffixes() == (*SUFFIXES, ".rig") and ".rig" in [s for f in with_part("channels") for s in f.suffixes]
    with pytest.raises(InputError, match=r"suffix '\.rig' is not one of a recording; allowed: candump"):
        check_name(tmp_path / "run.rig")
    with pytest.raises(LogError, match=r"suffix '\.rig' is not a recording's; allowed: \.log"):
        read_record(rig)


@pytest.mark.parametrize("command", ["map", "replay"])
def test_the_commands_read_the_format_of_a_package(rig: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, str(rig)]) in (0, 1)
    assert "n_dem" in capsys.readouterr().out or command == "replay"


def test_a_format_of_a_package_is_named_offered_and_found(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(LogError, match=r"suffix '\.bin' is not a log's; allowed: \.log, .*, \.rig$"):
        read_log(rig.with_suffix(".bin"))
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    ask = f'COMP_WORDS=(vaneloop replay "{rig.parent}/b"); COMP_CWORD=2; _vaneloop; printf "%s\\n" "${{COMPREPLY[@]}}"'
    (rig.parent / "b.txt").touch()
    done = subprocess.run(["bash", "--norc"], input=script + ask, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [str(rig)] and not done.stderr
    (found,) = find([str(rig.parent)])
    assert found.path == str(rig)


def test_a_package_is_loaded_only_for_a_file_of_its_own(
    rig: Path, installed: Callable[..., Path], tmp_path: Path
) -> None:
    installed("raise SystemExit('loaded')", ".oh = oh_logs:OH", "oh_logs")
    write_log(tmp_path / "a.csv", {"n_dem": Channel(T, SPEED)})
    read_log(tmp_path / "a.csv")
    read_log(rig)
    with pytest.raises(LogError):
        read_log(tmp_path / "a.bin")
    assert "oh_logs" not in sys.modules and ".oh" in suffixes()


BROKEN = {
    "no module": ("", ".rig = not_there:RIG", "cannot be loaded (ModuleNotFoundError: No module named 'not_there')"),
    "no name": ("", ".rig = rig_logs:RIG", "which cannot be loaded (AttributeError: module 'rig_logs' has no"),
    "syntax": ("def", ".rig = rig_logs:RIG", "which cannot be loaded (SyntaxError: "),
    "exits": ("raise SystemExit(3)", ".rig = rig_logs:RIG", "which cannot be loaded (SystemExit: 3)"),
    "no format": ("RIG = 5", ".rig = rig_logs:RIG", "which is int, not hil.logs.Format"),
    "other suffix": ("from hil.logs import Format\nRIG = Format('a', ('.gir',))", ".rig = rig_logs:RIG",
                     "whose suffixes are .gir"),
    "no part": ("from hil.logs import Format\nRIG = Format('a rig', ('.rig',))", ".rig = rig_logs:RIG",
                "a rig cannot be read; allowed: .mf4, .dat, .mdf, .csv, .msl, .lvm, .parquet"),
    "no source": ("from hil.logs import Format\nRIG = Format('a', ('.rig',), source=lambda path, options: 3)",
                  ".rig = rig_logs:RIG", "which opens it as int: that is no Source, it has no kind"),
    "opens badly": ("from hil.logs import Format\nRIG = Format('a', ('.rig',), source=lambda path, options: 1 / 0)",
                    ".rig = rig_logs:RIG", "which fails at it (ZeroDivisionError: division by zero)"),
    "part is nowhere": ("from hil.logs import Format\nRIG = Format('a', ('.rig',), source='nowhere:f')",
                        ".rig = rig_logs:RIG", "which fails at it (ModuleNotFoundError: No module named 'nowhere')"),
    "reads badly": (
        "from hil.logs import Format, Samples\n"
        "class Bad(Samples):\n    names = {'n_dem': ('n_dem',)}\n"
        "    def __init__(self): self.notes = []\n"
        "    def series(self, key): return {}[key]\n"
        "RIG = Format('a', ('.rig',), source=lambda path, options: Bad())", ".rig = rig_logs:RIG",
        "which fails at it (KeyError: 'n_dem')"),
}  # fmt: skip


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_format_of_a_package_is_one_line_and_blocks_nobody(
    how: str, installed: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    module, entry, said = BROKEN[how]
    installed(module, entry)
    (tmp_path / "a.rig").write_text("1 2\n")
    with pytest.raises(LogError) as refused:
        read_log(tmp_path / "a.rig")
    assert said in str(refused.value) and str(refused.value).startswith(f"{tmp_path / 'a.rig'}: ")
    assert main(["map", str(tmp_path / "a.rig")]) == (1 if how == "reads badly" else 2)  # shown as far as it goes
    out, err = capsys.readouterr()
    assert str(refused.value) in (out if how == "reads badly" else err) and len(err.splitlines()) <= 1
    write_log(tmp_path / "a.csv", {"n_dem": Channel(T, SPEED)})
    assert read_log(tmp_path / "a.csv").channels["n_dem"].t.size == T.size
    with pytest.raises(LogError, match=r"a\.txt: suffix '\.txt' is not a recording's; allowed: \.log, "):
        (tmp_path / "a.txt").write_text("x")
        read_record(tmp_path / "a.txt")
    assert [s.path for s in find([str(tmp_path)])] == [str(tmp_path / "a.csv"), str(tmp_path / "a.rig")]


def test_no_package_takes_a_suffix_of_ours_or_one_that_is_none(installed: Callable[..., Path], tmp_path: Path) -> None:
    taken = "\n".join(f"{s} = rig_logs:RIG" for s in (*FORMATS, ".CSV", "csv", ".a b", ".x) rm -rf", ".tar.gz"))
    installed("raise SystemExit('loaded')", taken)
    assert suffixes() == SUFFIXES
    for suffix, of in FORMATS.items():
        assert format_of(tmp_path / f"a{suffix}") is of and format_of(tmp_path / f"a{suffix.upper()}") is of


def test_a_package_of_frames_gives_frames_alone(installed: Callable[..., Path], tmp_path: Path) -> None:
    """They are seen through a database, written as the bus would carry them, and say what they say of themselves."""
    installed(
        "from hil.logs import Format\n"
        "def said(path): return {'engine': 'E7', 'time': '2026-03-14'}\n"
        "RIG = Format('a', ('.rig', '.rig2'), framed=True, frames='hil.logs.candump:read_candump', said=said,\n"
        "             frames_out='hil.logs.candump:write_candump', recorder='hil.logs.record_formats:CandumpRecord',\n"
        "             recording='hil.logs.recordings:read_candump')",
        ".rig = rig_logs:RIG\nRIG2 = rig_logs:RIG",
    )
    for suffix in (".rig", ".rig2"):
        write_log(tmp_path / f"a{suffix}", {"n_dem": Channel(T, SPEED)})
        channel = read_log(tmp_path / f"a{suffix}").channels["n_dem"]
        assert channel.framed and np.abs(channel.values - np.interp(channel.t, T, SPEED)).max() < 0.2
    assert check_name(tmp_path / "run.rig") and len(read_record(tmp_path / "a.rig").ms) >= T.size
    first, _ = (s.described() for s in find([str(tmp_path)]))
    assert first.engine == "E7" and first.time == 1_773_446_400.0


def test_a_package_reaches_a_process_of_its_own(rig: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path / "site_rig_logs"), str(ROOT)])}
    done = subprocess.run(
        [sys.executable, "-m", "vaneloop", "map", str(rig)], cwd=ROOT, env=environment, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert "n_dem" in done.stdout


def test_what_is_written_is_told_by_its_name_and_not_by_the_file_that_was_there(tmp_path: Path) -> None:
    """A table in place of frames in CSV: the old file's beginning says nothing of the new one."""
    file = tmp_path / "a.csv"
    file.write_text("Time Stamp,ID,Extended,Dir,Bus,LEN,D1\n0,00000122,false,Rx,0,1,74\n")
    write_log(file, {"n_dem": Channel(T, SPEED)})
    np.testing.assert_allclose(read_log(file).channels["n_dem"].values, SPEED)
