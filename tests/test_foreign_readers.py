"""Logs that other libraries write, whatever is in them, are read as these libraries read them: frames as python-can
has them, channels as asammdf, tables as pandas. `vaneloop map --check` makes the comparison of frames.

`pytest tests/test_foreign_readers.py --hypothesis-profile campaign` tries 1,000 logs of each format, `make test-all`
100.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import asammdf
import can
import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hil.logs import read_log
from hil.logs.others import compare
from tests.conftest import examples
from tests.test_field_traces import Frame, can_message, recordings

LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)  # of CAN FD
EACH = settings(
    max_examples=examples(100), suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
SIGNALS = {"n_dem": 100.0, "x_lvdt": 40.0, "i_cmd": 30.0, "vigv": 60.0}  # and what they reach


def written(path: Path, log: list[Frame]) -> int:
    """Frames as python-can writes them, and one remote frame among them; how many data frames."""
    with can.Logger(str(path)) as out:
        for k, f in enumerate(log):
            size = max(n for n in LENGTHS if n <= len(f.data))
            out.on_message_received(can_message(Frame(f.us, f.ident, f.extended, f.data[:size], f.bus)))
            if k == 1 and path.suffix != ".trc":  # its writer knows none
                out.on_message_received(can.Message(f.us / 1e6, 5, is_remote_frame=True, channel=f.bus))
    return len(log)


def as_python_can_has_them(path: Path, log: list[Frame]) -> None:
    """The comparison of `vaneloop map --check`, of all frames."""
    n = written(path, log)
    rows = compare(path, {})
    assert [(r.what, r.same) for r in rows] == [
        (what, True) for what in ("frames", "identifiers", "lengths", "bytes of data", "times")
    ], rows
    assert rows[0].ours == rows[0].theirs == f"{n:,}"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".trc", ".csv"])
@given(data=st.data())
@EACH
def test_frames_are_those_of_python_can(tmp_path: Path, suffix: str, data: st.DataObject) -> None:
    longest = 8 if suffix == ".trc" else 64  # its writer knows no CAN FD
    as_python_can_has_them(tmp_path / f"a{suffix}", data.draw(recordings(longest)))


@pytest.mark.slow
@given(log=recordings(64))
@settings(EACH, max_examples=examples(25))
def test_frames_of_bus_logging_are_those_of_python_can(tmp_path: Path, quick_mdf: None, log: list[Frame]) -> None:
    as_python_can_has_them(tmp_path / "a.mf4", log)


@st.composite
def channels(draw: st.DrawFn) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Some signals, each with times of its own (s from 0) and values of any digits, the first at 0 s."""
    names = draw(st.lists(st.sampled_from(list(SIGNALS)), min_size=1, unique=True))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    out = {}
    for name in names:
        n = draw(st.integers(2, 40))
        t = np.concatenate([[0.0], np.cumsum(rng.choice([1e-3, 0.01, 0.1, rng.uniform(0.001, 9.0)], n - 1))])
        out[name] = t, np.array(rng.uniform(0.2, 1.0, n) * SIGNALS[name])
    return out


@pytest.mark.slow
@pytest.mark.parametrize(("version", "suffix"), [("4.10", ".mf4"), ("3.30", ".mdf"), ("2.14", ".dat")])
@given(made=channels(), together=st.booleans(), compression=st.sampled_from([0, 2]))
@EACH
def test_channels_are_those_of_asammdf(
    tmp_path: Path, quick_mdf: None, version: str, suffix: str, made: Any, together: bool, compression: int
) -> None:
    made_at, path = tmp_path / ("a.mf4" if suffix == ".mf4" else "a.mdf"), tmp_path / f"b{suffix}"
    with asammdf.MDF(version=version) as mdf:
        if together:
            t = next(iter(made.values()))[0]
            made = {k: (t, np.resize(v, t.size)) for k, (_, v) in made.items()}
            mdf.append([asammdf.Signal(v, t, name=k) for k, (t, v) in made.items()])
        else:
            for k, (t, v) in made.items():
                mdf.append([asammdf.Signal(v, t, name=k)])
        mdf.save(made_at, overwrite=True, compression=compression if suffix == ".mf4" else 0)
    made_at.replace(path)  # the library would give it a name of its own
    log = read_log(path, require=())
    assert set(log.channels) == set(made)
    with asammdf.MDF(path) as again:
        for name, c in log.channels.items():
            theirs = again.get(name)
            assert c.t.tolist() == theirs.timestamps.tolist() and c.values.tolist() == theirs.samples.tolist()
            assert c.values.tolist() == made[name][1].tolist()


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@given(made=channels(), separator=st.sampled_from(",;\t"), digits=st.sampled_from(["%.17g", "%.6g", "%.3f", None]))
@EACH
def test_tables_are_those_of_pandas(tmp_path: Path, suffix: str, made: Any, separator: str, digits: str | None) -> None:
    path = tmp_path / f"a{suffix}"
    frame = pd.concat([pd.Series(v, t, name=k) for k, (t, v) in made.items()], axis=1, sort=True)
    if suffix == ".csv":
        frame.to_csv(path, sep=separator, float_format=digits, index_label="t")
        theirs = pd.read_csv(path, sep=separator, dtype=np.float64).groupby("t").last()
    else:
        frame.rename_axis("t").to_parquet(path)
        theirs = pd.read_parquet(path)
    log = read_log(path, require=())
    assert set(log.channels) == set(made)
    for name, c in log.channels.items():
        column = theirs[name].dropna()
        assert c.t.tolist() == column.index.tolist() and c.values.tolist() == column.tolist()
