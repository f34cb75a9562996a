"""What a recorder does to a log is no physics: rows that repeat, what a sample of the current is, clocks that
differ.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.loggers import Logger, recorded
from hil.figures import noise_floor
from hil.logs import Channel, Log, read_log, write_log
from hil.logs.stale import stale_rows
from plant import Model, build_plant
from tests import rig
from tests.firmware_on_rig import firmware
from tests.test_loggers import rows
from vaneloop.identification.vane_chain.chain import Chain, build_chain
from vaneloop.identification.vane_chain.current import SLOW_CURRENTS, samples_of
from vaneloop.identification.vane_chain.demand import _by_noise, _other_noise
from vaneloop.identification.vane_chain.linkage import _late_recorder
from vaneloop.identification.vane_chain.low_pass import LOW_PASSES, LowPass
from vaneloop.identification.workflow import compare_stages, diagnose

SEED, DURATION = 41, 120.0
GROUPS = {"bus": ("n_dem", "x_dem", "state"), "vanes": ("vigv", "vgv1", "vgv2")}


def verdicts(chain: Chain) -> dict[str, str]:
    return {s.stage: s.verdict for s in diagnose(chain.stages, workers=1).stages}


@given(st.integers(0, 2**31), st.integers(1, 39), st.sampled_from([0.0, 0.001, 1.0]))
def test_rows_that_only_repeat_are_found_and_no_others(seed: int, length: int, digit: float):
    """Noise of 1 in each of five channels; with a last digit of 1 single rows repeat by chance."""
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((5, 2000)) * (3.0 if digit == 1.0 else 1.0)
    columns = np.round(columns / digit) * digit if digit else columns
    assert not stale_rows(list(columns)).any()
    if digit == 1.0:
        return  # five on end may be chance
    first = int(rng.integers(1, 1900))
    columns[:, first : first + length] = columns[:, first - 1 : first]
    assert np.array_equal(np.flatnonzero(stale_rows(list(columns))), first + np.arange(length))


def test_a_channel_that_is_slower_than_the_rows_is_not_stale():
    held = np.repeat(np.random.default_rng(0).standard_normal(200), 10)
    assert not stale_rows([held, 2.0 * held]).any()
    assert not stale_rows([np.zeros(500), np.ones(500)]).any()


def test_what_a_sample_of_the_current_is():
    ticks = np.arange(30.0).reshape(3, 10)
    assert np.array_equal(samples_of(ticks, 10), ticks.mean(axis=1))
    assert np.array_equal(samples_of(ticks, 1), ticks[:, 9])
    assert np.array_equal(samples_of(ticks, 2), ticks[:, [4, 9]].mean(axis=1))
    ramp = np.arange(5.0)  # at each row; the mean since the row before is half a row earlier
    line, held = (mean_of(ramp) for mean_of in SLOW_CURRENTS.values())
    assert np.array_equal(line[1:], ramp[1:] - 0.5)
    assert np.array_equal(held[1:], ramp[:-1])


def test_one_lag_of_all_vanes_may_be_their_recorder_s():
    def lags(*sizes: float) -> dict[str, dict[str, dict[str, float]]]:
        return {"pot_lag": {f"v{k}": {"low": s - 1e-3, "high": s + 1e-3} for k, s in enumerate(sizes)}}

    assert _late_recorder(lags(0.0025, 0.003, 0.0022)) == "a recorder of the vanes that is late"
    assert not _late_recorder(lags(0.003, 0.008, 0.003))  # one of them is slower
    assert not _late_recorder(lags(0.003, 0.0, 0.0))
    assert not _late_recorder(lags(0.003))


def test_clocks_of_several_recorders_are_set_right():
    log, late = rows(SEED), {"bus": 0.02, "vanes": 0.013}
    of = {name: g for g, names in GROUPS.items() for name in names}
    channels = {k: Channel(log["t"] + late.get(of.get(k, ""), 0.0), v) for k, v in log.items() if k != "t"}
    chain = build_chain(Log("clocks", channels, []))
    said = " ".join(chain.notes)
    assert "x_dem: stand 20 ms late" in said
    assert "n_dem: stand 20 ms late" in said
    assert "vigv, vgv1, vgv2: stand 1" in said
    assert "x_lvdt" not in said
    figures = [s for s in compare_stages(chain.stages) if s.stage != "actuator"]
    assert all(s.agrees for s in figures), [(s.signal, s.ratio) for s in figures]


def test_clocks_of_an_excerpt_are_set_right_and_those_that_are_known_are_not_sought():
    log, late = rows(SEED), {"bus": 0.02}
    of = {name: g for g, names in GROUPS.items() for name in names}
    channels = {k: Channel(log["t"] + late.get(of.get(k, ""), 0.0), v) for k, v in log.items() if k != "t"}
    file = Log("clocks", channels, [])
    pieces = [(0, 4000), (6000, 9000)]
    part = build_chain(file, pieces=pieces)
    assert set(part.late) >= {"servo", "engine"} and any("x_dem: stand 20 ms late" in n for n in part.notes)
    assert all(s.agrees for s in compare_stages([part.stage("servo"), part.stage("engine")]))
    other = build_chain(file, pieces=[(3000, 6000)], late=part.late)
    assert other.late == part.late and all(s.agrees for s in compare_stages([other.stage("servo")]))
    assert not any(s.agrees for s in compare_stages([build_chain(file, pieces=pieces, late={}).stage("servo")]))


@pytest.mark.parametrize(("stroke", "speed"), [(0.02, 0.0), (-0.03, 0.02), (0.0, -0.03)])
def test_zeros_of_a_recorder_are_set_right(stroke: float, speed: float):
    log, high = rows(SEED), {"x_lvdt": stroke, "n_r": speed}
    log = log | {name: log[name] + by for name, by in high.items()}
    file = Log("zeros", {k: Channel(log["t"], v) for k, v in log.items() if k != "t"}, [])
    chain = build_chain(file)
    found = {one.channels[0]: one.zero for one in chain.late["linkage"]}
    assert found == pytest.approx({name: by for name, by in high.items() if by}, rel=0.1)
    assert sum("in the file than in the controller" in n for n in chain.notes) == len(found)
    assert all(s.agrees for s in compare_stages(chain.stages))
    assert compare_stages(build_chain(file, late=chain.late).stages) == compare_stages(chain.stages)


def test_zeros_are_found_behind_clocks_that_differ():
    log, high, late = rows(SEED), {"x_lvdt": 0.02, "n_r": 0.03}, {"x_dem": 0.02, "n_dem": 0.02}
    names = [name for name in log if name != "t"]
    channels = {k: Channel(log["t"] + late.get(k, 0.0), log[k] + high.get(k, 0.0)) for k in names}
    chain = build_chain(Log("both", channels, []))
    assert {one.channels[0]: one.zero for one in chain.late["linkage"]} == pytest.approx(high, rel=0.1)
    assert any("x_dem: stand 20 ms late" in n for n in chain.notes)
    assert all(s.agrees for s in compare_stages(chain.stages))


@pytest.mark.parametrize(("current", "told"), [(0.06, True), (-0.06, True), (2.0, False)])
def test_a_zero_of_the_current_is_the_recorder_s_where_the_stroke_has_one_as_large(current: float, told: bool):
    log, high = rows(SEED), {"x_lvdt": 0.02, "i_cmd": current}
    channels = {k: Channel(log["t"], v + high.get(k, 0.0)) for k, v in log.items() if k != "t"}
    chain = build_chain(Log("zeros", channels, []))
    found = {one.channels[0]: one.zero for one in chain.late["actuator"]}
    assert found == pytest.approx(high if told else {"x_lvdt": 0.02}, rel=0.1)
    assert compare_stages([chain.stage("actuator")])[0].agrees == told


@pytest.mark.parametrize(
    "hidden",
    [("schedule_error", {"offset": 2e-4}), ("lvdt_bias", {"bias": 3e-4}), ("controller_gain_error", {"factor": 1.1})],
)
def test_what_the_controller_has_seen_too_is_no_zero_of_the_recorder(hidden: tuple[str, dict[str, float]]):
    log = rig.simulate(rig.manoeuvre(SEED, DURATION), firmware(), [rig.Hidden(*hidden)], seed=SEED).log
    chain = build_chain(Log("machine", {k: Channel(log["t"], v) for k, v in log.items() if k != "t"}, []))
    assert not any(one.zero for late in chain.late.values() for one in late)


def test_an_offset_of_the_model_s_tables_is_no_zero_of_the_recorder():
    log, effects = rows(SEED), {"schedule_error": {"offset": 0.3}}
    file = Log("machine", {k: Channel(log["t"], v) for k, v in log.items() if k != "t"}, [])
    chain = build_chain(file, build_plant(model=Model(effects=effects)), present=tuple(effects))
    assert not any(one.zero for late in chain.late.values() for one in late)
    assert not all(s.agrees for s in compare_stages([chain.stage("demand")]))


def test_one_clock_stays_as_it_is():
    assert not [n for n in build_chain(Log("clean", {k: Channel(rows(SEED)["t"], v) for k, v in rows(SEED).items()
                                                     if k != "t"}, [])).notes if "stand" in n]  # fmt: skip


def test_a_supply_pressure_that_nobody_logged_is_no_missing_physics() -> None:
    log = rows(SEED)
    chain = build_chain(Log("few", {k: Channel(log["t"], v) for k, v in log.items() if k not in ("t", "p_s")}, []))
    stage = chain.stage("actuator")
    assert compare_stages([stage])[0].ratio == pytest.approx(1.0, abs=0.05)
    at = np.r_[1000:2000, 5000:6000]
    assert stage.unlogged is not None and stage.excerpt is not None
    part = stage.excerpt(at)
    assert part.unlogged is not None and part.unlogged.shape == (1, 1, 2000)
    stage.unlogged = None  # taken for exactly known
    assert compare_stages([stage])[0].ratio > 2.0
    chain = build_chain(Log("all", {k: Channel(log["t"], v) for k, v in log.items() if k != "t"}, []))
    assert chain.stage("actuator").unlogged is None


@functools.cache
def fine() -> dict[str, np.ndarray]:
    """A log of the rig with a row each ms."""
    return rig.simulate(rig.manoeuvre(SEED, DURATION), firmware(), seed=SEED, rate=1000).log


@pytest.mark.slow
@pytest.mark.parametrize("rate", [10, 20, 25, 50, 100, 200, 500])
def test_a_current_at_single_ticks_is_no_missing_physics(rate: int):
    log = recorded(fine(), Logger(rate), np.random.default_rng(1))
    said = verdicts(build_chain(Log("ticks", log, [])))
    assert set(said.values()) == {"none"}, said


@pytest.mark.parametrize("kind", LOW_PASSES)
@pytest.mark.parametrize("late", [0.0, 0.0035, -0.002])
def test_a_low_pass_delays_a_ramp_by_its_delay(kind: str, late: float):
    ticks = 0.5 * np.arange(3000.0).reshape(300, 10)  # a row of ten ticks of 1 ms
    out = LowPass(kind, 0.008, late).of(ticks)
    moved = (ticks - out).ravel()[1000:-1000] / 0.5  # ticks
    assert moved == pytest.approx(8.0 + 1e3 * late, abs=0.51)  # a mean of whole ticks lies half a tick beside
    assert np.ptp(moved) < 1e-6


@pytest.mark.parametrize("kind", LOW_PASSES)
def test_a_low_pass_of_rows_is_that_of_their_ticks_and_is_undone(kind: str):
    dt, at = 0.01, np.arange(600.0)
    rows = np.array([np.sin(2.0 * np.pi * at / 60.0), np.interp(at, [0, 100, 200, 500], [0.0, 0.0, 3.0, -1.0])])
    between = np.array([np.interp(np.arange(6000) / 10.0 - 0.9, at, r) for r in rows]).reshape(2, 600, 10)
    straight, held = LowPass(kind, 0.008), LowPass(kind, 0.008, held=True)
    for k in range(2):  # the last of a row's ten ticks is at the row
        assert straight.of_rows(rows, dt)[k] == pytest.approx(straight.of(between[k])[:, -1], abs=0.005)
        before = np.repeat(np.concatenate([rows[k][:1], rows[k][:-1]])[:, None], 10, axis=1)
        assert held.of_rows(rows[k], dt) == pytest.approx(held.of(before)[:, -1], abs=0.005)
    ramp = 0.5 * at
    assert (ramp - straight.of_rows(ramp, dt))[50:-50] == pytest.approx(0.5 * 0.8, abs=0.02)
    rows_late = {"mean": (1.0 + 0.6 * 2.0) / 1.6, "first order": 1.0 / (1.0 - np.exp(-1.0 / 0.8)), "second order": 1.3}
    assert (ramp - held.of_rows(ramp, dt))[50:-50] == pytest.approx(0.5 * rows_late[kind], abs=0.01)
    again = straight.before(straight.of_rows(rows[0], dt), dt)
    assert again[50:-50] == pytest.approx(rows[0][50:-50], abs=2e-3)
    assert np.abs(straight.of_rows(rows[0], dt) - rows[0])[50:-50].max() > 0.07
    t, noise = dt * np.arange(40_000), np.random.default_rng(1).standard_normal((40_000, 10))
    behind = straight.of(noise)[:, -1]
    assert noise_floor(t, behind) / straight.shown(t) == pytest.approx(np.std(behind), rel=0.04)
    assert 0.95 < straight.shown(t) <= 1.0 and LowPass().shown(t) == 1.0
    assert LowPass().of_rows(rows, dt) is rows and LowPass().before(rows, dt) is rows


def test_a_low_pass_is_said_as_its_data_sheet_says_it():
    assert LowPass("mean", 0.005).text() == "a mean over 10 ms"
    assert LowPass("first order", 1.0 / (2.0 * np.pi * 30.0)).text() == "a low-pass of first order of 30 Hz"
    assert LowPass("second order", 2.0**0.5 / (2.0 * np.pi * 20.0)).text() == "a low-pass of second order of 20 Hz"
    assert LowPass(late=0.01).text() == ""


LOGGERS = {
    "a mean over 10": Logger(100, window=0.01), "of first order of 30": Logger(100, filter=(1, 30.0)),
    "of second order of 30": Logger(100, filter=(2, 30.0)),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("said", LOGGERS)
def test_a_low_pass_before_the_analogue_channels_is_found_and_no_missing_physics(said: str):
    chain = build_chain(Log("low-pass", recorded(fine(), LOGGERS[said], np.random.default_rng(1)), []))
    note = next(n for n in chain.notes if "x_dem" in n)
    kind, size = said.rsplit(" ", 1)
    assert kind in note
    assert float(note.split(kind)[1].split()[0]) == pytest.approx(float(size), rel=0.03)
    # a mean over one row hardly rounds the stroke's turns, and may leave no less in the linkage
    linkage = "linkage: x_lvdt, vigv, vgv1, vgv2: have passed"
    assert any(n.startswith(linkage) for n in chain.notes) or kind == "a mean over"
    figures = compare_stages(chain.stages)
    assert all(s.ratio < 1.05 for s in figures), [(s.signal, s.ratio) for s in figures]


def test_noise_of_an_input_that_its_filter_makes_slow_is_in_the_floor():
    """White noise behind a lag of 0.5 s, most of it where a gain is large, which is not where the log is quiet."""
    rng, t = np.random.default_rng(0), np.arange(20_000) * 0.01
    gain = np.where(t % 20.0 < 10.0, 0.1, 1.0)

    def made() -> np.ndarray:
        return gain * scipy.signal.lfilter([0.02], [1.0, -0.98], rng.standard_normal(len(t)))

    error, draws = made(), np.array([made() for _ in range(4)])
    whole, seen = float(np.std(error)), noise_floor(t, error)
    share, beyond = _by_noise(t, error, draws, 0.0)
    assert seen < 0.4 * whole
    assert share == pytest.approx(1.0, abs=0.1)
    assert np.hypot(seen, beyond) == pytest.approx(whole, rel=0.2)
    less, beyond_less = _by_noise(t, 0.1 * error, draws, 0.0)
    assert less == pytest.approx(0.01 * (seen / np.mean([noise_floor(t, d) for d in draws])) ** 2)
    assert beyond_less <= 0.11 * beyond
    assert _by_noise(t, 0.1 * error, draws, whole)[1] == 0.0  # the floor is never less than that
    assert _by_noise(t, 9.0 * error, draws, 0.0)[1] < 1.1 * whole  # what else is in the error is no noise of the input


def test_what_a_last_digit_hides_is_one_error_as_long_as_it_stands():
    t, x = np.arange(40_000) * 0.01, 0.05 * np.repeat(np.arange(400.0), 100)
    stands = (
        _other_noise(t, x, 0.05)(np.random.default_rng(1)).reshape(400, 100).mean(axis=1)
    )  # what else is in it is white
    assert np.std(stands) == pytest.approx(0.05 / 12.0**0.5, rel=0.1)
    assert np.abs(np.corrcoef(stands[1:], stands[:-1])[0, 1]) < 0.15


# A clean log as other people's recorders take it: nothing is missing in any subsystem.
@pytest.mark.slow
@pytest.mark.parametrize(
    "logger",
    [
        Logger(100, resolution=1.0),
        Logger(100, resolution=5.0),
        Logger(20, resolution=5.0),
        Logger(100, window=0.016, resolution=1.0),
        Logger(1000, stale=(0.001, 6)),
        Logger(1000, stale=(0.001, 34)),
        Logger(100, stale=(0.001, 34)),
        Logger(50, window=0.02),  # current and stroke alike: the stroke lies half a row behind, which no valve does
        Logger(25, window=0.04),
        Logger(500, filter=(1, 200.0), offset={"bus": 0.0109}),
        Logger(200, offset={"bus": 0.0166}, stale=(0.001, 34)),
        Logger(1000, resolution=1.0, hum=(50.0, 0.5), offset={"bus": 0.0029}),
        Logger(100, hum=(400.0, 0.5)),  # which stands still in these rows: the zeros of all channels
        Logger(200, hum=(400.0, 0.5), window=0.005, drift=3e-5),
        Logger(20, colour=(0.07, 1.0), drift=-1.3e-5, stale=(0.0002, 11)),
        Logger(25, filter=(2, 10.5), colour=(0.2, 0.5), stale=(0.0, 13)),
        Logger(200, hum=(400.0, 2.0), offset={"bus": -0.0185, "controller": 0.0174}, stale=(0.0002, 25)),
    ],
)
def test_no_subsystem_of_a_clean_log_fails_whatever_its_recorder_rounds_and_repeats(logger: Logger, tmp_path: Path):
    write_log(tmp_path / "log.parquet", recorded(fine(), logger, np.random.default_rng(1)))
    chain = build_chain(read_log(tmp_path / "log.parquet", require=()))
    d = diagnose(chain.stages, chain.not_observed, workers=1)
    assert d.verdict == "none", [(s.stage, s.verdict, s.refused) for s in d.stages]


@pytest.mark.parametrize("kept", [Logger(100), Logger(50, offset={"vanes": 0.02}, window=0.02)])
def test_rows_that_a_recorder_loses_leave_the_others_where_they_were(kept: Logger):
    log = {"t": np.arange(5000) * 1e-3, "vigv": np.arange(5000) * 1e-3, "p_s": np.full(5000, 21.0)}
    whole, lost = (recorded(log, kept, np.random.default_rng(0), gaps) for gaps in ((), ((1.0, 0.5), (3.0, 1.0))))
    for name, c in lost.items():
        there = np.isin(whole[name].t, c.t)
        assert np.array_equal(c.values, whole[name].values[there])
        gone = whole[name].t[~there]
        assert np.all((gone >= 1.0) & (gone < 1.5) | (gone >= 3.0) & (gone < 4.0)) and len(gone) == 1.5 * kept.rate
