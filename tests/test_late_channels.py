"""A channel that begins late or ends early shortens the subsystems that use it, and no other."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vaneloop
from hil.logs import Channel, Log, read_log, write_log
from hil.logs.notes import Note
from tests.conftest import ROOT
from vaneloop.base.vanes import VANES
from vaneloop.cli.main import main
from vaneloop.identification import Record, System, unknown
from vaneloop.identification.user_models.data import Data
from vaneloop.identification.vane_chain.chain import Chain, build_chain
from vaneloop.identification.vane_chain.resample import OF_SUBSYSTEM, grid_of, rms
from vaneloop.verbs import long
from vaneloop.verbs.machine import Machine
from vaneloop.verbs.parts import read_record

SECONDS = 40.0
CUT = ("x_dem", "t_oil", "vgv1")
MORE_CUT = ("n_dem", "n_r", "x_lvdt", "i_cmd", "p_s", "vigv", "state")  # the same, in `make test-all`


@cache
def a_log() -> Log:
    return read_log(ROOT / "examples" / "hidden_effect.parquet")[:SECONDS]


@cache
def whole() -> Chain:
    return build_chain(a_log())


def between(log: Log, name: str, low: float, high: float) -> Log:
    return replace(log, channels={k: c[low:high] if k == name else c for k, c in log.channels.items()})


def used(stage: str) -> set[str]:
    of = OF_SUBSYSTEM[stage]
    return {*of.needs, *of.takes, *of.gives, "state"}


@pytest.mark.parametrize("name", [*CUT, *(pytest.param(name, marks=pytest.mark.slow) for name in MORE_CUT)])
def test_a_channel_shortens_only_what_uses_it(name: str) -> None:
    rng = np.random.default_rng(len(name))
    log = between(a_log(), name, rng.uniform(0.0, 20.0), rng.uniform(26.0, SECONDS))
    channel = log.channels[name]
    chain = build_chain(log)
    assert {s.name for s in whole().stages if name not in used(s.name)} <= {s.name for s in chain.stages}
    for stage in chain.stages:
        before = whole().stage(stage.name)
        counted = stage.t[np.isfinite(stage.measured).any(axis=0)] + chain.start
        if name not in used(stage.name):
            assert np.array_equal(stage.t + chain.start, before.t + whole().start)
            if not {name} & {"x_dem", "i_cmd", "x_lvdt"}:  # which refine others where they are there
                assert np.array_equal(stage.measured, before.measured, equal_nan=True)
        elif name in VANES:  # the other vanes are measured as ever
            k = stage.outputs.index(name)
            there = stage.t[np.isfinite(stage.measured[k])] + chain.start
            assert channel.t[0] <= there.min() and there.max() < channel.t[-1] + 1e-6
            assert np.array_equal(np.delete(stage.measured, k, 0), np.delete(before.measured, k, 0), equal_nan=True)
        else:
            assert channel.t[0] <= counted.min() and counted.max() < channel.t[-1] + 1e-6
            assert len(stage.t) * 0.01 > channel.t[-1] - channel.t[0] - 2.1  # whole windows of 1 s
    cut = channel.t[0] > 2.0 or channel.t[-1] < SECONDS - 2.0
    assert not cut or any(n.startswith(name) for n in chain.notes)


def test_channels_without_a_time_in_common_leave_their_subsystem_alone() -> None:
    log = a_log()
    for v in machine_vanes():
        log = between(log, v, 30.0, SECONDS)
    chain = build_chain(between(log, "x_lvdt", 0.0, 25.0))
    assert {s.name for s in chain.stages} == {"demand", "servo", "engine", "actuator"}
    assert "no time in common" in chain.not_observed["linkage"]


def machine_vanes() -> tuple[str, ...]:
    return Machine().plant.vanes


def test_a_late_vane_logger_cuts_the_linkage_alone_and_commands_count_what_was_done(tmp_path: Path) -> None:
    log, said = a_log(), []
    for v in machine_vanes():
        log = between(log, v, 25.0, SECONDS)
    for file, channels in (("late", log.channels), ("whole", a_log().channels)):
        write_log(tmp_path / f"{file}.csv", channels)
    lines = (tmp_path / "late.csv").read_text().split("\n")
    lines[299] += ",1"
    (tmp_path / "late.csv").write_text("\n".join(lines))
    for file in ("whole", "late"):
        words = [
            str(tmp_path / f"{file}.csv"),
            "--json",
            str(tmp_path / "j"),
            "--report",
            str(tmp_path / "p"),
            "--quiet",
        ]
        main(["compare", *words])
        said.append(json.loads((tmp_path / "j").read_text()))
    samples = [{(s["stage"], s["signal"]): s["samples"] for s in one["stages"]} for one in said]
    for (stage, signal), n in samples[0].items():
        late = samples[1][stage, signal]
        assert 900 < late <= 1500 if stage == "linkage" else n - 110 <= late <= n  # a row less: a window of 1 s
    assert said[0]["notes"] == said[0]["done"] == []
    cut = "vigv begins at 25 s: linkage not judged before it"
    assert [(d["kind"], d["of"], d["count"], d["rows"]) for d in said[1]["done"]] == [
        ("left out", "rows", 1, [300]), ("cut", "vigv", 2500, []),
    ]  # fmt: skip
    assert said[1]["notes"] == [d["said"] for d in said[1]["done"]] and said[1]["notes"][1] == cut
    page = (tmp_path / "p").read_text()
    assert "What reading did to the log" in page and cut in page


@pytest.mark.parametrize("verb", [vaneloop.locate, vaneloop.replay])
def test_answers_count_what_was_done(verb: Any) -> None:
    note = Note("x: 3 samples are NaN: left out", "left out", "x_lvdt", 3, [4, 5, 9])
    log = replace(a_log()[["n_dem", "n_r"]], notes=[note, "plain"])
    answer = verb(log)
    assert answer.to_dict()["done"] == [
        {"kind": "left out", "of": "x_lvdt", "count": 3, "rows": [4, 5, 9], "said": str(note)}
    ]
    table = str(answer.page().parts[-1])
    assert all(f">{cell}</td>" in table for cell in ("left out", "x_lvdt", "3", "4, 5, 9", str(note)))


READS_A_LOG = [
    "compare", "locate", "diagnose", "extend --effect valve_dead_band --out m.toml", "experiment", "learn", "replay",
    "map", "run --bus lockstep --log", "run --bus lockstep --profile", "schedule --log",
]  # fmt: skip


@pytest.mark.parametrize("command", READS_A_LOG)
def test_every_command_that_reads_a_log_counts_in_json_what_it_did(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    log = a_log()[0:20]
    names = ["n_dem", "n_r"] + ["x_lvdt", "i_cmd", "vigv"] * command.startswith(("extend", "schedule"))
    write_log(tmp_path / "bad.csv", {n: log.channels[n] for n in names})
    lines = (tmp_path / "bad.csv").read_text().splitlines()
    lines[299] += ",1"
    (tmp_path / "bad.csv").write_text("\n".join(lines))
    main([*command.split(), str(tmp_path / "bad.csv"), "--json", str(tmp_path / "j"), "--quiet"])
    said = json.loads((tmp_path / "j").read_text())
    assert [(d["kind"], d["of"], d["count"], d["rows"]) for d in said["done"]] == [("left out", "rows", 1, [300])]
    assert said["done"][0]["said"] in said["notes"]


@pytest.mark.parametrize("name", [*CUT, *(pytest.param(name, marks=pytest.mark.slow) for name in MORE_CUT)])
def test_a_gap_counts_only_in_what_uses_the_channel(name: str) -> None:
    rng = np.random.default_rng(len(name))
    begin = rng.uniform(8.0, 20.0)
    end = begin + rng.uniform(3.0, 10.0)
    c = a_log().channels[name]
    there = (c.t < begin) | (c.t > end)
    log = replace(a_log(), channels={**a_log().channels, name: replace(c, t=c.t[there], values=c.values[there])})
    before, after = ({s.name: s for s in chain.stages} for chain in (whole(), build_chain(log)))
    for stage, one in before.items():
        t, counts, now = one.t, np.isfinite(one.measured), np.isfinite(after[stage].measured)
        settled = end + 3.0 if stage != "linkage" or name in VANES else SECONDS  # play is known from a reversal on
        gap = (t > begin - 1.0) & (t < settled)  # in whole windows
        for output, was, still in zip(one.outputs, counts, now, strict=True):
            mine = output == name if name in VANES else name in used(stage)
            lost = was & ~still
            assert lost.any() == mine and not lost[~gap].any(), (stage, output)
            if mine:
                assert not still[(t > begin + 0.1) & (t < end - 0.1)].any()
        if name not in used(stage):  # nor does what the gap hides from others make it worse
            error, was = (rms(s, s.measured - s.run(s.neutral()[None])[0]) for s in (after[stage], one))
            assert np.allclose(error, was, rtol=0.05), stage
        for condition, values in one.regimes.items():
            known = np.isfinite(after[stage].regimes[condition])
            assert known[~gap].all() and np.isfinite(values).all()


def test_an_excerpt_of_a_long_log_is_cut_likewise() -> None:
    log = between(a_log(), "i_cmd", 12.0, SECONDS)
    grid = grid_of(log)
    stages_of = Machine().stages_of
    chain = stages_of(log, grid, [(0, 2_000), (2_500, 4_000)])
    t = {s.name: s.t for s in chain.stages}
    assert np.array_equal(t["engine"], np.r_[0:2_000, 2_500:4_000] * 0.01)
    assert np.array_equal(t["actuator"], np.r_[1_200:2_000, 2_500:4_000] * 0.01)
    held = long.Whole(log, grid, lambda *p, **few: stages_of(log, grid, *p, **few), (0,))
    fits = [(s.name, [s.neutral()], s.floor, 1.0) for s in chain.stages if s.name == "actuator"]
    sums = long.held_against(replace(chain, whole=held), fits, workers=1).sums["actuator"]
    counted = np.isfinite(build_chain(log).stage("actuator").measured).sum()
    assert sums.samples.sum() == pytest.approx(counted, abs=300)


SYSTEM = System(
    "lag", "simulate", lambda x, u, p: p.gain * u.u - x.x, outputs={"x": "V"}, inputs={"u": "V"}, states={"x": "V"},
    parameters=[unknown("gain", 1.0, "1/s")],
)  # fmt: skip


@given(late=st.integers(0, 300), early=st.integers(0, 300))
def test_nothing_outside_a_drivers_samples_drives_a_users_model(late: int, early: int) -> None:
    t = np.arange(1_000) * 0.01
    u, x = np.sin(t), np.sin(t - 0.1)
    channels = {"u": Channel(t[late : 1_000 - early], u[late : 1_000 - early], unit="V"), "x": Channel(t, x, unit="V")}
    record, notes = read_record(Log("a", channels, signals={"u": "V", "x": "V"}), SYSTEM)
    assert t[late] - 0.016 < record.t[0] <= t[late] and t[-1 - early] <= record.t[-1] < t[-1 - early] + 0.016
    assert bool(notes) == (late > 1 or early > 1)
    gaps = np.where((t < t[late]) | (t > t[-1 - early]), np.nan, u)
    data = Data(SYSTEM, [Record("a", t, {"u": gaps, "x": x})])
    assert np.array_equal(data.u[0][0], u[late : 1_000 - early]) and data.times[0][0] == pytest.approx(t[late])
