"""A value that came in a frame holds from that frame on: the stages and the replay get what the controller had."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vaneloop
from hil.figures import SignalError
from hil.logs import Channel, Log, read_log, write_log
from hil.logs.candump import read_candump
from hil.logs.held import answers, held, phase_of_ticks, taken, time_on_wire
from hil.replay import replay
from tests.bus_logs import by_ticks, by_wire, with_effect, write_frames
from tests.conftest import quick_first
from vaneloop.base.spans import Span
from vaneloop.cli.main import main
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.selection.diagnosis import diagnose_stage
from vaneloop.identification.settings import AGREES
from vaneloop.identification.vane_chain.chain import Chain, build_chain
from vaneloop.identification.vane_chain.resample import grid_of, on_raster, rms
from vaneloop.verbs.parts import part_of

PHASES = (0, 5, 9)  # ms after the controller's tick at which the ECU's frame is taken
MORE_PHASES = (1, 2, 3, 4, 6, 7, 8)  # the same, in `make test-all`
ON_WIRE = (0.0, 9.8)  # ms at which it is queued; at 9.8 and later the status frame waits for it
MORE_ON_WIRE = (0.2, 3.7, 9.5, 9.9)  # the same, in `make test-all`
TICKS = 0.01 * np.arange(1000)


def in_floors(chain: Chain) -> dict[str, float]:
    """Error of the model as it is, in noise floors, of each stage."""
    out = {}
    for s in chain.stages:
        assert s.floor is not None
        off = s.run(s.neutral()[None])[0] - np.where(np.isfinite(s.measured), s.measured, 0.0)
        out[s.name] = float(np.max(rms(s, off) / s.floor))
    return out


def settled_loop(log: Log) -> dict[str, SignalError]:
    """Figures of the whole loop from a dwell on: a record begins with a controller that was just switched on."""
    return {e.signal: e for e in replay(part_of(log, [Span(10.0, np.inf)])).signals if e.reference == "measured"}


def demand_of(path: Path) -> StageDiagnosis:
    stage = build_chain(read_log(path)).stage("demand")
    assert stage.floor is not None
    return diagnose_stage(stage, stage.floor)


# ---- what is recorded fits ------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("profile", "suffix"), [("slam", ".log"), ("staircase", ".parquet"), ("ramp", ".mf4"), ("sine", ".blf")]
)
def test_a_recorded_run_fits_in_every_stage_and_lacks_nothing(profile: str, suffix: str, tmp_path: Path) -> None:
    record = tmp_path / f"run{suffix}"
    run = ["run", "--bus", "lockstep", "--profile", profile, "--seed", "2", "--record", str(record), "--quiet"]
    assert main(run) == 0
    said = vaneloop.diagnose(str(record))
    errors = {s.stage: float(np.max(s.error_before / s.floor)) for s in said.diagnosis.stages}
    assert list(errors) == ["demand", "servo", "engine", "actuator", "linkage"]
    assert max(errors.values()) < AGREES, errors
    assert said.verdict == "none"


def test_without_noise_the_demand_is_the_firmwares_to_the_last_digit(tmp_path: Path) -> None:
    record = tmp_path / "run.log"
    assert main(["run", "--bus", "lockstep", "--profile", "slam", "--record", str(record), "--quiet"]) == 0
    assert in_floors(build_chain(read_log(record)))["demand"] < 0.2


# ---- the phase of the ECU's frames is no physics --------------------------------------------------------------------


@pytest.mark.parametrize("phase", [*PHASES, *(pytest.param(p, marks=pytest.mark.slow) for p in MORE_PHASES)])
def test_the_phase_of_the_ecus_frames_leaves_the_answer(phase: int, tmp_path: Path) -> None:
    log = read_log(by_ticks(tmp_path / "run.log", "slam", phase))
    errors = in_floors(build_chain(log))
    assert errors["demand"] < 0.2 and max(errors.values()) < AGREES, errors
    loop = {e.signal: e.rms / e.noise_floor for e in replay(log).signals if e.reference == "measured"}
    assert loop["n_r"] < AGREES, loop


@pytest.mark.parametrize("phase", [*ON_WIRE, *(pytest.param(p, marks=pytest.mark.slow) for p in MORE_ON_WIRE)])
def test_on_a_wire_too(phase: float, tmp_path: Path) -> None:
    log = read_log(by_wire(tmp_path / "run.log", "slam", phase))
    errors = in_floors(build_chain(log))
    assert errors["demand"] < 0.2 and max(errors.values()) < AGREES, errors
    assert settled_loop(log)["x_dem"].rms < 5e-3  # a frame too many or too few: 0.06 mm
    n_r = next(e for e in replay(log).signals if e.signal == "n_r")
    assert n_r.rms < AGREES * n_r.noise_floor


@pytest.mark.slow
def test_the_jitter_of_a_loggers_stamps_leaves_the_figures(tmp_path: Path) -> None:
    """A busy computer stamps frames up to a millisecond late; the controller's ticks are as even as ever."""
    frames = read_candump(by_wire(tmp_path / "run.log", "slam", 5.0))
    late = np.random.default_rng(1).uniform(0.0, 1e-3, frames.t.size)
    write_frames(tmp_path / "late.log", replace(frames, t=np.maximum.accumulate(frames.t + late)))
    plain, other = (read_log(tmp_path / f"{name}.log") for name in ("run", "late"))
    assert in_floors(build_chain(other))["demand"] < 0.2
    for name in ("x_dem", "x_lvdt"):
        assert settled_loop(other)[name].rms == pytest.approx(settled_loop(plain)[name].rms, rel=0.05), name


@pytest.mark.parametrize("suffix", quick_first([".blf", ".asc", ".trc", ".mf4"], 2))
@pytest.mark.parametrize("phase", [0.0, pytest.param(0.5, marks=pytest.mark.slow)])
def test_every_format_of_frames_says_that_they_are(phase: float, suffix: str, tmp_path: Path, quick_mdf: None) -> None:
    by_wire(tmp_path / "run.log", "slam", phase, seconds=15.0)
    path = tmp_path / f"run{suffix}"
    write_frames(path, read_candump(tmp_path / "run.log"))
    log = read_log(path)
    assert all(c.framed for c in log.channels.values())
    assert in_floors(build_chain(log))["demand"] < 0.2


def test_frames_whose_stamps_are_rounded_to_a_tenth_of_a_millisecond_fit(tmp_path: Path) -> None:
    frames = read_candump(by_wire(tmp_path / "run.log", "slam", 0.0, seconds=15.0))
    for late in (3e-5, 7e-5):
        path = tmp_path / f"run{late}.log"
        write_frames(path, replace(frames, t=np.round(frames.t + late, 4)))
        assert in_floors(build_chain(read_log(path)))["demand"] < 0.2


@pytest.mark.parametrize("drift", [-1e-3, 1e-3])
def test_an_ecu_whose_clock_passes_the_controllers_fits(drift: float, tmp_path: Path) -> None:
    """Now and then the controller gets no frame in 10 ms, or two; the model then does the same."""
    log = read_log(by_ticks(tmp_path / "run.log", "staircase", 5, drift=drift))
    had = held(log.channels["n_dem"], taken(log.channels, log.channels["x_dem"].t, 0.005))
    assert {0, 2} & set(np.diff(had).tolist())
    assert in_floors(build_chain(log))["demand"] < AGREES


@pytest.mark.parametrize("phase", [1, 9])
def test_frames_that_a_logger_lost_cost_rows_and_no_fit(phase: int, tmp_path: Path) -> None:
    log = read_log(by_ticks(tmp_path / "run.log", "staircase", phase))
    keep = np.ones(len(log.channels["n_dem"].t), bool)
    rng = np.random.default_rng(phase)
    for length in (1, 1, 1, 2, 3, 5):
        begin = int(rng.integers(400, len(keep) - 400))
        keep[begin : begin + length] = False
    c = {n: replace(x, t=x.t[keep], values=x.values[keep]) if n in ("n_dem", "n_r") else x
         for n, x in log.channels.items()}  # fmt: skip
    assert in_floors(build_chain(Log("run", c)))["demand"] < 0.2


@pytest.mark.parametrize("first", range(6))
def test_a_loop_replayed_from_any_frame_of_the_record_on_is_as_near(first: int, tmp_path: Path) -> None:
    frames = read_candump(by_ticks(tmp_path / "whole.log", "slam", 5))
    part = {k: getattr(frames, k)[first:] for k in ("t", "ident", "bus", "length", "data")}
    write_frames(tmp_path / "run.log", replace(frames, **part))
    log = read_log(tmp_path / "run.log")
    run, c = replay(log), log.channels["x_dem"]
    off = (run.t[0] - phase_of_ticks(log.channels, 0.01)) % 0.01
    assert min(off, 0.01 - off) < 1e-4 and -1e-9 <= run.t[0] - log.channels["n_dem"].t[0] < 0.0101
    late = c.t > 4.0  # the record begins with a controller that was just switched on
    nearest = np.rint((c.t - run.t[0]) / 0.01).astype(int).clip(0, len(run.t) - 1)
    assert np.sqrt(np.mean((run.model["x_dem"][nearest] - c.values)[late] ** 2)) < 1e-3


# ---- a delay that is there is found ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "phase"), [(0.01, 0), (0.01, 1), (0.01, 5), (0.01, 9), (0.03, 1)])
def test_a_true_delay_is_named_at_any_phase(delay: float, phase: int, tmp_path: Path) -> None:
    plant = with_effect("can_delay", delay=delay)
    said = demand_of(by_ticks(tmp_path / "run.log", "slam", phase, plant=plant))
    assert [e.effect for e in said.effects] == ["can_delay"]
    assert said.effects[0].parameters["delay"]["value"] == pytest.approx(delay, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("phase", [0.0, 9.9])
def test_a_true_delay_is_named_on_a_wire(phase: float, tmp_path: Path) -> None:
    said = demand_of(by_wire(tmp_path / "run.log", "slam", phase, plant=with_effect("can_delay", delay=0.01)))
    assert [e.effect for e in said.effects] == ["can_delay"]
    assert said.effects[0].parameters["delay"]["value"] == pytest.approx(0.01, abs=1e-3)


# ---- what did not come in frames ------------------------------------------------------------------------------------


def polled(tmp_path: Path, late: float) -> dict[str, Channel]:
    """A run as a logger polls it that takes the commands ``late`` after the answers to them."""
    log = read_log(by_ticks(tmp_path / "run.log", "slam", 0))
    return {n: Channel(c.t + late if n in ("n_dem", "n_r") else c.t, c.values) for n, c in log.channels.items()}


def test_a_polled_command_is_the_nearest_one(tmp_path: Path) -> None:
    """A controller's variable that is read a moment after it was used is still the one that was used."""
    channels = polled(tmp_path, 0.002)
    assert in_floors(build_chain(Log("polled", channels)))["demand"] < 0.2
    in_frames = {n: replace(c, framed=True) for n, c in channels.items()}
    assert in_floors(build_chain(Log("in frames", in_frames)))["demand"] > 5.0


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mf4"])
def test_tables_and_channel_groups_do_not_come_in_frames(suffix: str, tmp_path: Path, quick_mdf: None) -> None:
    path = tmp_path / f"run{suffix}"
    write_log(path, {"n_dem": Channel(TICKS, 60.0 + TICKS), "x_dem": Channel(TICKS, 20.0 + TICKS)})
    assert not any(c.framed for c in read_log(path).channels.values())


@pytest.mark.slow
def test_channel_groups_that_were_taken_out_of_frames_came_in_frames(tmp_path: Path) -> None:
    import asammdf

    from vaneloop.base.tables import path as table

    by_ticks(tmp_path / "run.log", "slam", 1, seconds=15.0)
    write_frames(tmp_path / "bus.mf4", read_candump(tmp_path / "run.log"))
    with asammdf.MDF(tmp_path / "bus.mf4") as mdf:
        mdf.extract_bus_logging({"CAN": [(str(table("vgv.dbc")), 0)]}).save(tmp_path / "groups.mf4")
    log = read_log(tmp_path / "groups.mf4")
    assert all(c.framed for c in log.channels.values())
    assert in_floors(build_chain(log))["demand"] < 0.2


def test_parts_and_other_clocks_of_a_log_of_frames_stay_frames(tmp_path: Path) -> None:
    log = read_log(by_ticks(tmp_path / "run.log", "slam", 1, seconds=15.0))
    part = part_of(log, [Span(0.0, 10.0)])
    assert part.channels["n_dem"].t[-1] < 10.0 and all(c.framed for c in part.channels.values())


# ---- a model of the user's own --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("between", "value"), [("hold", 1.0), ("line", 1.5)])
def test_an_input_in_frames_holds_where_the_model_says_so(between: str, value: float, tmp_path: Path) -> None:
    from vaneloop.identification.user_models.system import System
    from vaneloop.verbs.search import read_record

    frames = read_candump(by_ticks(tmp_path / "run.log", "ramp", 5, seconds=15.0))
    write_frames(tmp_path / "run.blf", frames)
    system = System(
        "valve", "simulate", lambda t, x, u, p: (u.n_dem - x.x_dem,), {"x_dem": "mm"}, {"n_dem": "%"},
        states={"x_dem": "mm"}, between=between,
    )  # fmt: skip
    record, _ = read_record(tmp_path / "run.blf", system)
    log = read_log(tmp_path / "run.blf")
    n = log.channels["n_dem"]
    before = held(n, record.t)
    inside = slice(500, 1000)
    step = n.values[before + (before + 1 < len(n.t))] - n.values[before]
    expected = n.values[before] + (value - 1.0) * step
    assert np.allclose(record.columns["n_dem"][inside], expected[inside], atol=1e-9)
    assert np.any(step[inside] != 0.0)


# ---- the rule itself ------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 10_000), min_size=1, max_size=20, unique=True), st.integers(-100, 10_100))
def test_the_last_one_at_or_before_holds_and_before_the_first_the_first(stamps: list[int], when: int) -> None:
    t = np.array(sorted(stamps)) * 1e-3
    before = [k for k, s in enumerate(sorted(stamps)) if s <= when]
    assert held(Channel(t, t), np.array([when * 1e-3]))[0] == (before[-1] if before else 0)


def bus(*, apart: float, ecu: float, framed: bool = True) -> dict[str, Channel]:
    """A tick's frames ``apart`` s from each other, the ECU's ``ecu`` s after the tick."""
    after = {"n_dem": ecu, "x_dem": 0.0, "i_cmd": apart, "vigv": 2.0 * apart}
    return {n: Channel(TICKS + t, TICKS, framed) for n, t in after.items()}


@pytest.mark.parametrize("apart", [1e-6, 2e-5])
def test_frames_by_ticks_or_on_a_virtual_bus_take_no_time(apart: float) -> None:
    channels = bus(apart=apart, ecu=0.004)
    assert time_on_wire(channels) == 0.0
    assert np.array_equal(taken(channels, TICKS, 0.005), channels["x_dem"].t)


@pytest.mark.parametrize("apart", [1.2e-4, 2.4e-4, 5e-4])  # 1 Mbit/s, 500 and 250 kbit/s
def test_a_frame_back_to_back_with_the_answer_is_not_in_it(apart: float) -> None:
    channels = bus(apart=apart, ecu=-1.1 * apart)
    assert 1.1 * apart < time_on_wire(channels) < 1.5 * apart
    had = held(channels["n_dem"], taken(channels, TICKS, 0.005))
    assert np.array_equal(had[1:], np.arange(len(TICKS) - 1))
    earlier = bus(apart=apart, ecu=-2.0 * apart)
    assert np.array_equal(held(earlier["n_dem"], taken(earlier, TICKS, 0.005)), np.arange(len(TICKS)))


def test_frames_that_never_follow_each_other_say_nothing_of_the_wire() -> None:
    assert time_on_wire(bus(apart=0.002, ecu=0.005)) == 0.0
    assert time_on_wire(bus(apart=2.4e-4, ecu=0.005, framed=False)) == 0.0


def test_an_ecu_that_passes_close_by_now_and_then_says_nothing_of_the_wire() -> None:
    """On a virtual bus its frame comes at any time, now and then a fraction of a millisecond before the answer."""
    passing = {"n_dem": Channel(TICKS * 1.001, TICKS, True), "x_dem": Channel(TICKS + 0.005, TICKS, True)}
    apart = np.diff(np.sort(np.concatenate([c.t for c in passing.values()])))
    assert (apart < 5e-4).any() and time_on_wire(passing) == 0.0


def test_without_commands_in_frames_the_log_has_no_answers() -> None:
    channels = bus(apart=2.4e-4, ecu=0.004)
    assert answers(channels) is channels["x_dem"]
    assert answers(bus(apart=2.4e-4, ecu=0.004, framed=False)) is None
    assert answers({"x_dem": channels["x_dem"]}) is None


@given(st.integers(0, 99), st.floats(0.0, 1e-3))
def test_the_phase_of_the_ticks_is_found_whatever_the_jitter(tenths: int, jitter: float) -> None:
    t = 1e-4 * tenths + TICKS + jitter * np.sin(np.arange(len(TICKS)) * 2.0)
    channels = {"x_dem": Channel(t, TICKS, True), "n_dem": Channel(TICKS, TICKS, True)}
    off = phase_of_ticks(channels, 0.01) - 1e-4 * tenths
    assert abs((off + 0.005) % 0.01 - 0.005) <= 1.5e-4
    assert 0.0 <= phase_of_ticks(channels, 0.01) < 0.01


def test_rows_stand_at_the_answers_of_a_log_of_frames(tmp_path: Path) -> None:
    """Else rows half-way between two answers would flip from one to the other."""
    log = read_log(by_wire(tmp_path / "run.log", "slam", 5.0, seconds=15.0))
    t, columns, _, _ = on_raster(log, grid_of(log))
    c = log.channels["x_lvdt"]
    assert len(t) > 1400
    assert np.isin(columns["x_lvdt"], c.values).all()
    row = np.flatnonzero(c.values == columns["x_lvdt"][700])
    assert any(np.array_equal(columns["x_lvdt"][700:900], c.values[k : k + 200]) for k in row)
