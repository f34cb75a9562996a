"""No bytes whatever take the reader down: a log is read with its invariants kept, or refused in one line."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest

import hil.logs.mdf
from hil.logs import Channel, LogError, dbc, read_log, write_log
from hil.logs.formats import FORMATS
from tests.test_logs import check, run
from vaneloop.base import tables

DBC = tables.path("vgv.dbc")
# Damaged files of each format: that none of them takes the reader down says, with 95 % confidence, that fewer than
# 3 in 1,000 of such damages would.
FILES = 1_000
MAPS: list[dict[str, str]] = [{}, {}, {"n_r": "n_dem"}]


def mutations(raw: bytes, rng: random.Random) -> bytes:
    """The file as a broken disk, a cut transfer, or another program might leave it."""
    kind = rng.random()
    if kind < 0.1:
        return rng.randbytes(rng.choice([1, 3, 17, 200, 3000]))
    if kind < 0.15:
        return raw[: rng.choice([4, 8, 12, 64, 144, 168, 200])] + rng.randbytes(300)
    if kind < 0.35:
        return raw[: rng.randrange(1, len(raw))]
    out = bytearray(raw)
    # headers of binary formats stand at either end: most damage goes there
    span = rng.choice([200, 2000, len(out), -400, -4000])
    for _ in range(rng.choice([1, 1, 2, 3, 8, 40])):
        at = rng.randrange(min(span, len(out))) if span > 0 else rng.randrange(max(0, len(out) + span), len(out))
        how = rng.random()
        if how < 0.35:
            out[at] = rng.randrange(256)
        elif how < 0.5:
            out[at] ^= 1 << rng.randrange(8)
        elif how < 0.75:
            at &= ~7
            number = rng.choice(
                [
                    0,
                    1,
                    8,
                    0xFFFFFFFF,
                    (1 << 63) - 1,
                    (1 << 64) - 1,
                    1 << 40,
                    rng.randrange(len(out)) & ~7,
                    rng.randrange(1 << 16),
                ]
            )
            out[at : at + 8] = number.to_bytes(8, "little")
        elif how < 0.85:
            out[at : at + rng.randrange(1, 60)] = b""
        elif how < 0.95:
            out[at:at] = out[at : at + rng.randrange(1, 300)]
        else:
            out[at : at + 4] = rng.choice(
                [
                    b"nan,",
                    b",,,,",
                    b"\n\n\n\n",
                    b"1e99",
                    b"-inf",
                    b'"',
                    b"\0\0\0\0",
                    b"#",
                    b"(",
                    b"\xff\xfe\xfd",
                    "٣".encode(),
                ]
            )
        if not out:
            return b"\0"
    return bytes(out)


def campaign(folder: Path, suffix: str, seeds: range, dbc: Path | None = None) -> None:
    """Read mutated logs of one format."""
    write_log(folder / f"good{suffix}", run(120), dbc=dbc)
    raw = (folder / f"good{suffix}").read_bytes()
    file = folder / f"bad{suffix}"
    for seed in seeds:
        rng = random.Random(seed)
        file.write_bytes(mutations(raw, rng))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                check(
                    read_log(
                        file,
                        mapping=rng.choice(MAPS),
                        dbc=dbc,
                        design_rpm=rng.choice([None, 38000.0]),
                        require=rng.choice([(), ("n_dem",)]),
                    )
                )
        except LogError as e:
            assert "\n" not in str(e) and str(file) in str(e), f"seed {seed}: {e}"
        except BaseException as e:
            raise AssertionError(f"seed {seed} of {suffix}: {type(e).__name__}: {e}") from e


@pytest.mark.slow
@pytest.mark.parametrize("suffix", list(FORMATS))
def test_no_damage_takes_the_reader_down(tmp_path: Path, suffix: str, quick_mdf: None) -> None:
    campaign(tmp_path, suffix, range(FILES))


def test_no_damage_takes_the_reader_of_bus_mdf_down(tmp_path: Path, quick_mdf: None) -> None:
    campaign(tmp_path, ".mf4", range(1000, 1050), DBC)


@pytest.mark.slow
def test_no_damage_at_all_takes_the_reader_of_bus_mdf_down(tmp_path: Path, quick_mdf: None) -> None:
    campaign(tmp_path, ".mf4", range(1050, 1000 + FILES), DBC)


def test_damaged_statistics_of_a_parquet_do_not_end_the_process(tmp_path: Path) -> None:
    campaign(tmp_path, ".parquet", range(14_396, 14_397))  # a histogram too long: pyarrow 26 calls std::terminate


@pytest.mark.slow
def test_a_damaged_mdf_ends_the_child_and_not_the_reader(tmp_path: Path) -> None:
    """Without any stand-in: the reader's own child on files that end it by a fault, and on one that it reads."""
    write_log(tmp_path / "a.mf4", run(50))
    raw = (tmp_path / "a.mf4").read_bytes()
    for seed in (3, 5):
        out = bytearray(raw)
        rng = random.Random(seed)
        for _ in range(30):
            at = rng.randrange(200, len(out)) & ~7
            out[at : at + 8] = rng.randrange(1 << 62).to_bytes(8, "little")
        (tmp_path / "b.mf4").write_bytes(out)
        try:
            check(read_log(tmp_path / "b.mf4"))
        except LogError as e:
            assert "\n" not in str(e)
    check(read_log(tmp_path / "a.mf4"))


def test_a_recording_that_was_not_ended_leaves_no_copy_of_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What its logger never finished is finished in a copy; that goes with the process that reads it."""
    file, place = tmp_path / "cut_off.mf4", tmp_path / "temporary"
    place.mkdir()
    t = np.arange(0.0, 2.0, 0.01)
    write_log(file, {"n_dem": Channel(t, 60.0 + t)})
    data = bytearray(file.read_bytes())
    data[:8], data[60] = b"UnFinMF ", 1  # its counters of samples were never written
    file.write_bytes(data[:400])
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setenv("TMPDIR", str(place))
    with pytest.raises(LogError):
        read_log(file)
    assert list(place.iterdir()) == []


def test_a_child_that_never_answers_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_log(tmp_path / "a.mf4", run(50))
    monkeypatch.setattr(hil.logs.mdf, "_TIME", (0.01, 1e12))
    with pytest.raises(LogError, match="damaged"):
        read_log(tmp_path / "a.mf4")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no processor time")
def test_a_reader_that_never_ends_is_stopped_by_the_processor_time_it_takes(tmp_path: Path) -> None:
    """However busy the machine is: by the clock, a whole file would be called damaged there."""
    write_log(tmp_path / "a.mf4", run(50))
    endless = "import asammdf\ndef forever(*_, **__):\n    while True: pass\nasammdf.MDF = forever\n"
    request = {"path": str(tmp_path / "a.mf4"), "wanted": [], "guess": False, "seconds": 1}
    code = endless + "from hil.logs.mdf_child import serve\nserve()"
    done = subprocess.run(
        [sys.executable, "-c", code], input=json.dumps(request).encode() + b"\n", stdout=subprocess.PIPE, check=False
    )
    assert done.returncode < 0 and done.stdout == b""


def test_no_damage_to_a_database_takes_the_reader_down(tmp_path: Path) -> None:
    write_log(tmp_path / "a.log", run(60))
    raw, bad = DBC.read_bytes(), tmp_path / "bad.dbc"
    raw = b"\n".join(line for line in raw.splitlines() if not line.startswith(b"CM_"))
    for seed in range(60):
        bad.write_bytes(mutations(raw, random.Random(seed)))
        try:
            check(read_log(tmp_path / "a.log", dbc=bad))
        except LogError as e:
            assert "\n" not in str(e)
    dbc._load_dbc.cache_clear()


def test_a_suffix_that_lies_is_refused(tmp_path: Path) -> None:
    good = {}
    for suffix in FORMATS:
        write_log(tmp_path / f"a{suffix}", run(60))
        good[suffix] = (tmp_path / f"a{suffix}").read_bytes()
    for suffix in FORMATS:
        for other, raw in good.items():
            if other != suffix and not (FORMATS[other].source and FORMATS[other].source == FORMATS[suffix].source):
                (tmp_path / f"b{suffix}").write_bytes(raw)
                with pytest.raises(LogError):
                    read_log(tmp_path / f"b{suffix}")
    (tmp_path / "folder.csv").mkdir()
    for name in ("folder.csv", "none.log", "a", "a.txt"):
        with pytest.raises(LogError):
            read_log(tmp_path / name)
    for suffix in FORMATS:
        (tmp_path / f"c{suffix}").write_bytes(b"")
        with pytest.raises(LogError, match="empty"):
            read_log(tmp_path / f"c{suffix}")
