"""The vane chain's stages from a log: its raster, its rows, its clocks, the current between rows, and what is declared
to the search, each against a closed form or a simulated machine.
"""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy

from controller import load_calibration
from hil.logs import Channel, Log, LogError
from hil.logs.notes import Note
from hil.loop.lockstep import Stimulus, lockstep
from plant import Model, build_plant
from plant.curve import KNOWN, PLACES, QUANTITIES
from plant.effects import EFFECTS
from plant.model import Learned
from plant.stages.linkage import speed_reach
from tests.small_logs import log_of, white
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import VANES
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.settings import COLOUR
from vaneloop.identification.subsystem import Array, Parameter, Stage
from vaneloop.identification.unmodelled.regressors import Quantity
from vaneloop.identification.user_models.terms import COLUMN
from vaneloop.identification.vane_chain import candidates, demand, experiment, hum, resample
from vaneloop.identification.vane_chain.actuator import _quadratic_drag
from vaneloop.identification.vane_chain.alignment import (
    Late,
    _servo,
    _shifted,
    aligned,
    demand_of,
    driving,
    explains,
    late_in_controller,
    late_vanes,
    on_rows,
    vanes_late,
)
from vaneloop.identification.vane_chain.candidates import (
    LAGGED,
    NEAR,
    VaneChainCandidates,
    _says_more,
    curve_effect,
    remade,
    reversals,
    room_for,
    with_laws,
    without_laws,
)
from vaneloop.identification.vane_chain.chain import (
    Chain,
    _lost_bits,
    _lost_step,
    _never_changes,
    _sampled,
    build_chain,
)
from vaneloop.identification.vane_chain.current import (
    BEFORE,
    SAMPLED,
    SLOW_CURRENTS,
    LowPass,
    _above_noise,
    _calibrated,
    _smoothed,
    _weights,
    between_rows,
    law_of,
    other_current,
    samples_of,
    servo_law,
    without_noise,
)
from vaneloop.identification.vane_chain.demand import (
    _by_noise,
    _direction_known,
    _other_noise,
    demand_stage,
    own_demand_stage,
)
from vaneloop.identification.vane_chain.engine import engine_stage
from vaneloop.identification.vane_chain.linkage import _cross_talk, _crossed, _late_recorder
from vaneloop.identification.vane_chain.parameters import (
    ALL_PLACES,
    FREE,
    _starts,
    declared,
    lanes,
    like_temperature,
    like_time,
)
from vaneloop.identification.vane_chain.resample import (
    Gaps,
    Grid,
    every_other,
    grid_of,
    last_digit,
    lately,
    no_gap_in_window,
    on_raster,
    pieces_of,
    regimes_of,
    rms,
    since,
    stretches,
)
from vaneloop.identification.vane_chain.servo import servo_stage
from vaneloop.identification.vane_chain.subsystem_data import VANES_LATE, Driven

CALIBRATION = load_calibration()
LATE, TICK = 0.04, 1e-3  # s
VANES_SET = set(VANES)
NATS, RIVAL_SPREADS = 12.0, 0.3  # docs/settings.md


# ---- raster and rows -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("step", "raster"), [(0.001, 0.01), (0.01, 0.01), (0.014, 0.01), (0.016, 0.02), (0.05, 0.05)])
def test_the_raster_is_the_frames_period_or_the_log_s_own_in_whole_ones(step: float, raster: float) -> None:
    t = 3.0 + step * np.arange(2000)
    g = grid_of(log_of(t, n_dem=np.cos(t), n_r=np.sin(t)))
    assert g.dt == pytest.approx(raster) and g.start == 3.0 and g.steps["n_r"] == pytest.approx(step)
    assert g.rows == int((t[-1] - 3.0) / raster + 1e-6) + 1 and not g.known
    assert g.window == round(1.0 / raster) and g.rows_of("n_r") == (0, g.rows)


def test_what_begins_a_window_later_or_ends_earlier_does_so_in_the_raster() -> None:
    t = 0.01 * np.arange(6001)
    late, early = t[730:], t[:5000]
    g = grid_of(log_of(t, x_lvdt=np.sin(t), vigv=np.sin(t), i_cmd=(late, np.sin(late)), p_s=(early, early)))
    # the actuator has all of its channels from 7.3 s on, in whole windows from 8 s; and as long as the pressure
    assert (g.start, g.rows) == (0.0, 6001)
    assert g.known["i_cmd"] == (800, 6001) and g.known["p_s"] == (0, 5000) and g.known["actuator"] == (800, 5000)
    assert g.pieces_of("actuator") == ((800, 5000),) and g.pieces_of("linkage") == ()
    assert g.pieces_of("actuator", [(0, 900), (1000, 1200), (4900, 5100)]) == ((800, 900), (1000, 1200), (4900, 5000))
    assert g.pieces_of("actuator", [(0, 800)]) is None and g.pieces_of("linkage", [(0, 9)]) == ((0, 9),)
    soon = grid_of(log_of(t, x_lvdt=(t[60:], t[60:]), vigv=(t[:-50], t[:-50])))
    assert soon.start == pytest.approx(0.6) and soon.rows == 6001 - 60 - 50 and not soon.known
    with pytest.raises(LogError, match="a.csv: no channel has more than"):
        grid_of(log_of(t[:1], n_r=[1.0]))


def test_a_log_comes_on_its_raster_with_its_gaps_told() -> None:
    t = 5.0 + 0.01 * np.arange(1000)
    kept = np.ones(1000, dtype=bool)
    kept[300:310] = kept[500:502] = False  # ten rows lack, and two
    slow = t[::5]
    log = log_of(
        n_r=(t[kept], np.sin(t[kept])), x_lvdt=(t, t), vigv=(t, t), t_oil=(slow, 40.0 + 0.1 * slow),
        n_dem=(slow, slow), p_s=([5.0], [18.0]),
    )  # fmt: skip
    g = grid_of(log)
    rows, columns, gaps, notes = on_raster(log, g)
    missing = gaps.lost["n_r"]
    assert rows == pytest.approx(0.01 * np.arange(g.rows)) and notes == [] and set(columns) == set(log.channels)
    assert columns["n_r"][kept[: g.rows]] == pytest.approx(np.sin(t[kept])[: kept[: g.rows].sum()])
    assert columns["t_oil"] == pytest.approx(40.0 + 0.1 * (5.0 + rows)) and set(columns["p_s"]) == {18.0}
    assert columns["n_dem"] == pytest.approx(slow[np.rint(np.arange(g.rows) / 5).astype(int)])
    bad = np.flatnonzero(gaps.far["n_r"])
    assert bad[0] == 301 and bad[-1] == 308 and len(bad) == 8  # as far as one row and a half from any sample
    assert np.flatnonzero(missing)[[0, -1]].tolist() == [300, 501] and missing.sum() == 12
    assert np.flatnonzero(~gaps.fresh(["n_r", "vigv"])[0]).tolist() == list(range(300, 310))  # to the ends of the gap
    assert gaps.fresh(["vigv", "x_lvdt"])[0].all()  # a gap is none of the other channels
    part = on_raster(log, g, [(0, 200), (400, 600)])
    assert part[0] == pytest.approx(rows[np.r_[0:200, 400:600]])
    for name, values in part[1].items():
        assert values == pytest.approx(columns[name][np.r_[0:200, 400:600]]), name
    assert np.flatnonzero(part[2].border).tolist() == [199, 200]  # the border of two pieces


def test_a_current_of_every_tick_is_its_mean_over_the_row() -> None:
    ticks = 0.001 * np.arange(10001)
    t = 0.01 * np.arange(1001)
    i = white(1, 10001)
    log = log_of(i_cmd=(ticks, i), x_lvdt=(t, np.sin(t)), n_r=(t, t))
    rows, columns, _, _ = on_raster(log, grid_of(log)._replace(dt=0.01, rows=1001))
    wanted = i[1:].reshape(-1, 10).mean(axis=1)
    assert columns["i_cmd"][1:] == pytest.approx(wanted)
    assert columns["x_lvdt"] == pytest.approx(np.sin(rows))


def test_every_other_row_and_the_mean_of_two_of_a_current() -> None:
    c = {"x_lvdt": np.arange(7.0), "i_cmd": np.array([1.0, 2.0, 4.0, 6.0, 8.0, 0.0, 2.0])}
    assert every_other(c)["x_lvdt"].tolist() == [0.0, 2.0, 4.0, 6.0]
    assert every_other(c)["i_cmd"].tolist() == [1.0, 3.0, 7.0, 1.0]
    assert every_other(c, np.arange(4.0))["i_cmd"].tolist() == [0.0, 1.0, 2.0, 3.0]


def test_stretches_of_rows() -> None:
    good = np.array([0, 0, 1, 1, 0, 1, 1, 1, 0], dtype=bool)
    number = stretches(good)
    assert number.tolist() == [0, 0, 1, 1, 1, 2, 2, 2, 2]
    assert [(p.start, p.stop) for p in pieces_of(number)] == [(0, 2), (2, 5), (5, 9)]
    assert since(0.1 * np.arange(9) + 3.0, number) == pytest.approx([0, 0.1, 0, 0.1, 0.2, 0, 0.1, 0.2, 0.3])
    assert stretches(np.ones(3, dtype=bool)).tolist() == [0, 0, 0]
    t = 0.25 * np.arange(12)
    fresh = np.ones(12, dtype=bool)
    fresh[5] = False
    assert np.flatnonzero(~no_gap_in_window(t, fresh)).tolist() == [4, 5, 6, 7]
    rows = np.zeros(12, dtype=bool)
    rows[[2, 8]] = True
    assert np.flatnonzero(lately(rows, 0.03)).tolist() == [2, 3, 4, 8, 9, 10]
    assert np.flatnonzero(lately(rows, 0.5, 0.25)).tolist() == [2, 3, 8, 9] and not lately(rows & False, 9.0).any()


def test_an_rms_counts_what_is_measured_and_not_the_constants_of_windows() -> None:
    measured = np.zeros((1, 10))
    measured[0, 7] = np.nan
    e = np.array([[1.0, 1, 1, 1, 1, 3, 3, 9, 3, 3]])
    stage = SimpleNamespace(measured=measured, t=0.2 * np.arange(10), window=None)
    assert rms(stage, e) == pytest.approx(np.sqrt([41.0 / 9.0]))  # type: ignore[arg-type]
    windowed = SimpleNamespace(measured=np.zeros((1, 11)), t=0.2 * np.arange(11), window=1.0)
    steps = np.array([[1.0, 1, 1, 1, 1, 3, 3, 3, 3, 8, 99]])
    assert rms(windowed, steps) == pytest.approx(np.sqrt([(5 * 0.0 + 4 * 1.0 + 16.0) / 10.0]))  # type: ignore[arg-type]


def test_conditions_are_speed_direction_and_way_since_the_stroke_turned() -> None:
    t = 0.01 * np.arange(1000)
    x = 20.0 + 5.0 * np.abs((t / 2.5) % 2.0 - 1.0)  # triangles: 2 mm/s down and up
    gap = np.zeros(1000, dtype=bool)
    none, lost = Gaps(gap, {}, {}), Gaps(gap, {"n_r": t > 9.0}, {"n_r": gap})
    out, units = regimes_of(t + 3.0, {"x_lvdt": x, "n_r": 50.0 + t, "t_oil": 40.0 + 0.0 * t, "vigv": x}, lost)
    assert np.isnan(out["rotor speed"]).tolist() == (t > 9.0).tolist()
    assert units == {
        "time": "s", "stroke": "mm", "stroke speed": "mm/s", "direction": "", "distance since reversal": "mm",
        "rotor speed": "%", "oil temperature": "degC",
    }  # fmt: skip
    assert set(out) == set(units)
    for k in (100, 350, 600, 900):
        assert abs(out["stroke speed"][k]) == pytest.approx(2.0, rel=1e-3)
        assert out["direction"][k] == (-1.0 if int(t[k] / 2.5) % 2 == 0 else 1.0)
    way = out["distance since reversal"]
    assert way[240] == pytest.approx(4.8, abs=0.1) and way[490] == pytest.approx(4.8, abs=0.2)
    assert way[300] == pytest.approx(1.0, abs=0.2)
    assert set(regimes_of(t, {"i_cmd": x, "p_s": x}, none)[0]) == {"time", "current", "supply pressure"}


# ---- clocks ----------------------------------------------------------------------------------------------------------


def test_a_late_channel_is_put_where_it_belongs() -> None:
    late = Late(("vigv", "vgv1"), 0.02, 1e-4, 50.0)
    t = np.arange(0.0, 100.0, 10.0)
    assert late.text() == "vigv, vgv1: stand 20 ms late in the file, and 100 us more each second; moved"
    assert Late(("n_r",), -0.005).text() == "n_r: stand 5 ms early in the file; moved"
    assert late.times(t) == pytest.approx(t - 0.02 - 1e-4 * (t - 50.0))
    log = log_of(n_r=(7.0 + t, t), x_lvdt=(7.0 + t, 0.1 * t), vigv=(7.3 + t, t))
    grid = Grid(7.0, 1.0, 91, {}, {})
    moved = aligned(log, [late, Late(("n_r",), 0.5), late._replace(channels=("x_lvdt",))], grid)
    assert moved["x_lvdt"].t == pytest.approx(7.0 + late.times(t)) and moved["n_r"].t is log["n_r"].t
    assert moved["vigv"].t == pytest.approx(7.0 + t)  # angles go to the rows, and the model of them to the angles
    assert on_rows(log, late, grid) == pytest.approx(0.3)
    rows = np.arange(100.0)
    left = vanes_late(rows, [late], log, grid)[VANES_LATE]
    assert left == pytest.approx(0.02 + 1e-4 * (rows - 50.0) - 0.3)
    assert vanes_late(rows, [Late(("n_r",), 0.5), Late(("vigv",), 0.0)], log, grid) == {}
    fast = log_of(n_r=(7.0 + 0.01 * rows, rows), vigv=(7.002 + 0.005 * rows, rows))
    assert on_rows(fast, late, grid._replace(dt=0.01)) == pytest.approx(0.002)
    here = {"vigv": t, "n_r": 3.0 * t}
    moved_here = driving(t, here, [late, Late(("n_r",), 0.5)])
    assert moved_here["n_r"][:-1] == pytest.approx(3.0 * (t + 0.5)[:-1])
    assert moved_here["vigv"] is here["vigv"] and set(moved_here) == set(here)
    assert _shifted(t, 2.0 * t, 3.0)[:5] == pytest.approx(2.0 * (t[:5] + 3.0))


@pytest.mark.parametrize(
    ("before", "after", "holds"),
    [
        ([5.0, 3.0], [2.9, 2.0], True), ([5.0, 3.0], [3.1, 2.0], False), ([5.0, 3.0], [1.0, 3.1], False),
        ([5.0, 0.5], [1.0, 0.5], True), ([5.0], [3.0], True), ([1.0], [1.0], False),
    ],
)  # fmt: skip
def test_a_clock_explains_what_gets_better_everywhere_and_by_half(
    chain: Chain, before: list[float], after: list[float], holds: bool
) -> None:
    stage = chain.stage("linkage")
    assert explains(stage, np.array([*before, 1.0, 1.0])[:3], np.array([*after, 1.0, 1.0])[:3]) == holds


def test_a_clock_must_gain_as_many_nats_as_an_effect(chain: Chain) -> None:
    stage = chain.stage("linkage")
    per_output = np.isfinite(stage.measured).sum(axis=1)
    enough = 2.0 * COLOUR[1] * NATS / per_output.sum()
    fits = np.full(3, 0.9)  # below the floor, whose level is no evidence
    assert explains(stage, fits, fits - 1.01 * enough) and not explains(stage, fits, fits - 0.99 * enough)


# ---- the current between rows ----------------------------------------------------------------------------------------


def test_the_law_of_the_servo_is_that_of_the_firmware_s_table() -> None:
    k = CALIBRATION.scalars
    t = 0.01 * np.arange(400)
    none = np.zeros(400)
    held = law_of(none, np.full(400, 2.0), CALIBRATION)  # of a constant error: proportional, and the integral's ramp
    n = np.arange(1, 4001)
    assert held.ravel() == pytest.approx(-2.0 * (k.kp + k.ki * n * TICK))
    ramp = law_of(3.0 * t, none, CALIBRATION)
    e = 3.0 * (t[5:, None] - 0.01 + 0.001 * (np.arange(10) - 8.0))  # the ramp comes a row later, its first tick at once
    slope = np.diff(ramp[5:].ravel())
    assert slope == pytest.approx(k.kp * 3.0 * TICK + k.ki * TICK * e.ravel()[1:], rel=2e-2)
    both = law_of(3.0 * t, np.full(400, 2.0), CALIBRATION)
    assert both == pytest.approx(held + ramp)
    logged = law_of(none, np.full(400, 2.0), CALIBRATION, logged=np.full(400, 2.5))
    assert logged[0, :9] == pytest.approx(held[0, :9]) and logged[0, 9] == pytest.approx(
        held[0, 9] - 0.5 * (k.kp + k.ki * TICK)
    )


def test_samples_of_a_row_are_evenly_spaced_and_the_last_is_at_the_row() -> None:
    ticks = np.arange(10.0)[None] + 1.0
    wanted = {1: 10.0, 2: 7.5, 3: (4 + 7 + 10) / 3, 5: 6.0, 10: 5.5}
    assert {n: samples_of(ticks, n)[0] for n in wanted} == pytest.approx(wanted)
    i = np.array([1.0, 3.0, 6.0])
    assert SLOW_CURRENTS["the current at single ticks"](i).tolist() == [1.0, 2.0, 4.5]
    assert SLOW_CURRENTS["the current from each row on"](i).tolist() == [1.0, 1.0, 3.0]


@pytest.mark.parametrize("what", ["", SAMPLED, BEFORE])
@pytest.mark.parametrize("samples", [1, 2])
def test_a_current_that_is_not_the_mean_of_its_ticks_is_made_that(what: str, samples: int) -> None:
    law = 3.0 * white(3, 600, 10) + 5.0
    t, mean = 0.01 * np.arange(600), law.mean(axis=1)
    before = mean + 0.1 * (np.roll(law[:, -1], 1) - law[:, -1])
    logged = {"": mean, SAMPLED: samples_of(law, samples), BEFORE: before}[what] + 0.05 * white(4, 600)
    c = {"i_cmd": logged + 0.2, "missing": np.zeros(600)}
    assert other_current(t, c, law, np.ones(600, dtype=bool), CALIBRATION, samples) == what
    assert c["i_cmd"] == pytest.approx(mean + 0.2, abs=0.3)


def test_the_current_of_every_tick_has_the_logged_mean() -> None:
    law = np.cumsum(white(5, 300, 10).ravel()).reshape(300, 10) * 0.1
    limit = 0.9e3 * CALIBRATION.scalars.current_limit
    c = {"i_cmd": law.mean(axis=1) + 4.0, "missing": np.zeros(300), "fresh": np.ones(300)}
    c["i_cmd"][200] = 1.01 * limit
    run = np.arange(300) >= 20
    ticks = between_rows(c, law, 0.3, run, CALIBRATION, None, 0)
    assert ticks.mean(axis=1) == pytest.approx(c["i_cmd"])
    alone = np.r_[0:20, 200]
    assert ticks[alone] == pytest.approx(np.repeat(c["i_cmd"][alone, None], 10, axis=1))
    rest = np.r_[50:150]
    assert ticks[rest, -1] == pytest.approx(law[rest, -1] + 4.0, abs=1e-9)  # the row's own tick is known
    assert np.std(ticks[rest, :-1] - law[rest, :-1]) == pytest.approx(0.3, rel=0.1)
    assert not np.array_equal(between_rows(c, law, 0.3, run, CALIBRATION, None, 1), ticks)
    c["missing"][120:125], c["i_cmd"][120:125] = 1.0, 8.0  # rows without a sample: the law, or what stands there
    bridged = [between_rows(c, law, 0.0, run, CALIBRATION, None, seed)[120:125] for seed in (0, 1)]
    assert bridged[0] == pytest.approx(law[120:125] + 4.0, abs=1e-9) and np.all(bridged[1] == 8.0)
    c["missing"][:], c["i_cmd"][120:125] = 0.0, law[120:125].mean(axis=1) + 4.0
    errors = np.full((300, 2), 3.0), np.full((300, 2), 1.0)
    assert between_rows(c, law, 0.0, run, CALIBRATION, errors, 0).mean(axis=1) == pytest.approx(c["i_cmd"])
    assert between_rows(c, law, 0.0, run, CALIBRATION, errors, 1).mean(axis=1) == pytest.approx(c["i_cmd"] + 2.0)


@pytest.mark.parametrize("recorders", [0.0, 0.01, 0.2])
@pytest.mark.parametrize("known", [0.0, 0.1])
def test_samples_that_obey_the_law_leave_only_the_noise_of_the_others_unknown(recorders: float, known: float) -> None:
    """What logged samples are off the law beyond its own errors, which the draws hold, is the recorder's."""
    law = np.cumsum(white(5, 4000, 10).ravel()).reshape(4000, 10) * 0.1
    logged = law.mean(axis=1) + recorders * white(6, 4000) + known * white(8, 4000)
    c = {"i_cmd": logged, "missing": np.zeros(4000), "fresh": np.ones(4000)}
    of_some = known * white(9, 4000, 3)
    errors = of_some + 0.05 * white(7, 4000, 3), of_some
    first, other = (
        between_rows(c, law, 0.3, np.ones(4000, dtype=bool), CALIBRATION, errors, seed).mean(axis=1) for seed in (0, 1)
    )
    most = 0.4 * known  # the power of 4,000 rows is known to some per cent
    assert np.hypot(0.05, recorders) * 0.95 < np.std(other - first) < np.hypot(np.hypot(0.05, recorders) * 1.05, most)


def test_a_gap_parts_the_integral_s_constants() -> None:
    """Behind a gap and the rows that settle there the integral has another constant; each side keeps its own."""
    law, run = np.cumsum(white(5, 600, 10).ravel()).reshape(600, 10) * 0.1, np.ones(600, dtype=bool)
    run[280:340] = False
    c = {"i_cmd": law.mean(axis=1) + 4.0, "missing": np.zeros(600), "fresh": np.where(run, 1.0, 0.0)}
    before = between_rows(c, law, 0.0, run, CALIBRATION, None, 0)
    law[280:310] += np.arange(30.0)[:, None] * 50.0  # what the law makes of a gap says nothing
    law[310:] -= 7000.0
    after = between_rows(c, law, 0.0, run, CALIBRATION, None, 0)
    assert after[run] == pytest.approx(before[run], abs=1e-6)
    assert after[run, -1] == pytest.approx(law[run, -1] + np.where(np.arange(600) < 300, 4.0, 7004.0)[run], abs=1e-6)


@pytest.mark.parametrize("rows", [9, 15])
def test_smoothing_keeps_a_cubic_to_its_ends(rows: int) -> None:
    x = np.arange(60.0)
    cubic = 3.0 - x + 0.2 * x**2 - 0.002 * x**3
    assert _smoothed(cubic, rows) == pytest.approx(cubic)
    w = _weights(rows)
    at = np.arange(rows) - rows // 2
    assert [float(np.sum(w * at**k)) for k in range(4)] == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-9)
    assert _smoothed(white(1, 6000), rows).std() == pytest.approx(np.sqrt(np.sum(w**2)), rel=0.05)


def test_what_is_above_the_noise_is_what_a_filter_cannot_make_of_it() -> None:
    w = np.zeros(5)
    w[1:4] = 1.0 / 3.0
    x = 0.5 * np.convolve(white(2, 4000), w, "same")
    assert np.mean(_above_noise(x, w, 0.5, 100) > 0.0) < 0.02
    shaken = x + 2.0 * np.sin(np.arange(4000.0))
    assert np.mean(_above_noise(shaken, w, 0.5, 100)) == pytest.approx(2.0, rel=0.05)  # its mean square


def test_a_model_s_steps_are_calibrated_to_what_was_logged() -> None:
    rng = np.random.default_rng(1)
    step = np.convolve(rng.standard_normal(9000), np.ones(20) / 20.0, "same")
    logged = np.where(step > 0.0, 1.3, 0.8) * step + 0.01
    whole = np.ones(9000, dtype=bool)
    assert _calibrated(step, 0.01, logged, whole) == pytest.approx(logged, abs=1e-8)
    bad = logged.copy()
    bad[4000:4100] = 50.0
    whole[4000:4100] = False
    assert _calibrated(step, 0.01, bad, whole) == pytest.approx(logged, abs=1e-8)
    late = np.zeros(9000)
    late[0] = step[0] * (1.0 - np.exp(-0.01 / 0.03))
    for k in range(1, 9000):
        late[k] = late[k - 1] + (step[k] - late[k - 1]) * (1.0 - np.exp(-0.01 / 0.03))
    assert _calibrated(step, 0.01, late, whole | True) == pytest.approx(late, abs=1e-6)


# ---- what is declared to the search ----------------------------------------------------------------------------------


def test_time_in_place_of_temperature_and_the_other_way_round() -> None:
    t = 10.0 + 0.1 * np.arange(101)
    oil = 60.0 - 20.0 * ((t - 10.0) / 10.0) ** 2
    alike = like_time(t, oil)
    assert alike.mean() == pytest.approx(oil.mean()) and np.diff(alike) == pytest.approx(np.full(100, -0.2))
    assert like_time(t, -oil)[-1] > like_time(t, -oil)[0]
    assert like_time(t, np.full(101, 40.0)) == pytest.approx(40.0 + np.linspace(-0.5, 0.5, 101))
    warm = like_temperature(t, oil)
    assert (warm.min(), warm.max()) == pytest.approx((10.0, 20.0)) and np.argmax(warm) == np.argmax(oil)
    assert like_temperature(t, np.full(101, 40.0)) is t


def test_fits_start_from_small_to_gross_within_bounds() -> None:
    one = (Parameter("size", 0.0, "mm", -2.0, 10.0),)
    assert _starts("other", one) == tuple(
        (v,) for s in (0.003, 0.03, 0.2, 0.6) for v in (s * 10.0, -s * 2.0)
    )  # fmt: skip
    positive = (Parameter("size", 0.0, "mm", 0.0, 10.0), Parameter("speed", 3.0, "mm/s", 0.0, 90.0))
    assert _starts("other", positive) == tuple((s * 10.0, 5.0) for s in (0.003, 0.03, 0.2, 0.6))
    factor = (Parameter("factor", 1.0, "-", 0.9, 2.0),)
    assert [v for (v,) in _starts("other", factor)] == pytest.approx([0.95, 0.99, 1.01, 1.05, 1.25])
    wave = (Parameter("size", 0.0, "deg", -1.0, 1.0), Parameter("phase", 0.0, "deg", 0.0, 360.0))
    assert [p for _, p in _starts("other", wave)] == [0.0, 90.0, 180.0, 270.0] * 8
    assert [v for (v,) in _starts("can_delay", one)] == pytest.approx(0.01 * np.arange(1, 51))
    assert [v for (v,) in _starts("frame_hold", one)] == pytest.approx(0.01 * np.arange(2, 51))
    trend = [v for (v,) in _starts("trend_threshold_error", one)]
    assert (len(trend), trend[0]) == (121, 0.1) and trend[-1] == pytest.approx(12.0)
    assert np.diff(np.log(trend)) == pytest.approx(np.full(120, np.log(120.0) / 120.0))
    assert sorted(_starts("end_stop_shift", one)) == [(s,) for s in (-7.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 7.0)]
    limits = _starts("valve_flow_saturation", one)
    assert [r for _, r in limits] == [0.0] * 24 + [1.0] * 7
    assert limits[0][0] == 4.0 and limits[23][0] == pytest.approx(4.0 * 1.18**23) and limits[-1] == (200.0, 1.0)


def interval(low: float, high: float) -> dict[str, float]:
    return {"low": low, "high": high}


def test_laws_that_are_also_something_else_are_said_by_their_sizes() -> None:
    sharp, round_end = ({"valve_flow_saturation": {"roundness": interval(0.0, r)}} for r in (0.5, 1.0))
    which = "valve_flow_saturation"
    assert _quadratic_drag(which, sharp) == ""
    assert _quadratic_drag(which, round_end).startswith("a drag that grows")
    lags = {"pot_lag": {"vigv": interval(0.02, 0.04), "vgv1": interval(0.03, 0.05)}}
    assert _late_recorder(lags) == "a recorder of the vanes that is late"
    lags["pot_lag"]["vgv1"] = interval(0.041, 0.05)
    assert _late_recorder(lags) == "" and _late_recorder({"pot_lag": {"vigv": interval(0.02, 0.04)}}) == ""
    assert _late_recorder({"pot_lag": {"vigv": interval(0.0, 0.04), "vgv1": interval(0.0, 0.05)}}) == ""
    off, none, gain, one = interval(0.1, 0.2), interval(-0.1, 0.1), interval(1.01, 1.02), interval(0.99, 1.01)
    talk = "a share of another vane row's reading"
    for gains, biases, said in (
        ({"vigv": gain, "vgv1": one}, {"vigv": off, "vgv1": none}, talk),
        ({"vigv": gain, "vgv1": one}, {"vigv": none, "vgv1": off}, ""),
        ({"vigv": gain, "vgv1": gain}, {"vigv": off, "vgv1": off}, ""),
        ({"vigv": gain}, None, ""),
    ):
        named = {"pot_gain": gains} | ({} if biases is None else {"pot_bias": biases})
        assert _cross_talk(named) == said
    assert np.flatnonzero(_crossed(np.array([5.0, 7.0, 4.0, 3.9, 5.0]))).tolist() == [3, 4]


# ---- small questions -------------------------------------------------------------------------------------------------


def test_a_stroke_s_speed_direction_and_reversals() -> None:
    t = 0.01 * np.arange(3000)
    x = 20.0 + 8.0 * np.sin(0.5 * t)
    out = reversals(t, x, 48.0)
    inner = slice(300, -300)
    assert out["speed_of_x_lvdt"][inner] == pytest.approx(4.0 * np.cos(0.5 * t)[inner], abs=0.05)
    k = 1000  # 10 s: it turned at pi s and 3 pi s, and goes up again
    assert out["direction_of_x_lvdt"][k] == -1.0 or out["direction_of_x_lvdt"][k] == 1.0
    down = int(100.0 * (np.pi + 1.5))  # 1.5 s behind the top
    assert out["direction_of_x_lvdt"][down] == -1.0
    assert out["distance_since_reversal_of_x_lvdt"][down] == pytest.approx(8.0 * (1.0 - np.cos(0.75)), abs=0.05)
    assert out["time_since_reversal_of_x_lvdt"][down] == pytest.approx(1.5, abs=0.05)


def test_a_channel_that_never_changes_and_samples_that_were_joined_by_lines() -> None:
    assert _never_changes(np.array([np.nan, 2.0, 2.0])) and _never_changes(np.full(3, np.nan))
    assert not _never_changes(np.array([2.0, 2.0 + 1e-15 * 2, 3.0]))
    t = 0.01 * np.arange(100)
    grid = Grid(5.0, 0.01, 100, {})
    assert _sampled(Channel(5.0 + t, t), t, grid, (0, 100)) is None
    some = _sampled(Channel(5.0 + t, t), t, grid, (10, 90))
    assert some is not None and np.flatnonzero(some)[[0, -1]].tolist() == [10, 89]
    slow = Channel(5.0 + 0.05 * np.arange(20), np.arange(20.0), apart=0.05)
    joined = _sampled(slow, t, grid, (0, 100))
    assert joined is not None and np.flatnonzero(joined).tolist() == list(range(0, 100, 5))


def test_a_stroke_in_steps_of_some_bits_is_told_and_one_of_a_logger_s_digit_is_not() -> None:
    machine = build_plant()
    sensors = machine.table.sensors
    bit = float(sensors.lvdt_range.value) / 2.0 ** float(sensors.lvdt_bits.value)
    x = 20.0 + 8.0 * np.sin(0.01 * np.arange(4000))
    for step, lost in ((8.0 * bit, True), (2.0 * bit, False), (0.05, False)):
        log = log_of(0.01 * np.arange(4000), x_lvdt=np.round(x / step) * step)
        found = _lost_step(log, machine)
        assert found == (pytest.approx(step, rel=1e-3) if lost else 0.0)
    assert _lost_step(log_of(np.arange(9.0), n_r=np.arange(9.0)), machine) == 0.0
    assert _lost_bits(0.0, machine) == ""
    assert _lost_bits(8.0 * bit, machine) == (
        f"x_lvdt comes in steps of {8.0 * bit:.4g} mm, 8 of its converter's: low bits are lost"
    )


def test_the_direction_of_a_trend_is_known_once_its_past_no_longer_matters() -> None:
    change = CALIBRATION.scalars.trend_change
    still = np.full(300, 60.0)
    assert not _direction_known(np.concatenate([60.0 + 0.5 * change * np.sin(0.1 * np.arange(300))]), CALIBRATION).all()
    up = np.concatenate([still, 60.0 + 4.0 * change * np.linspace(0.0, 1.0, 300), np.full(800, 60.0 + 4.0 * change)])
    known = _direction_known(up, CALIBRATION)
    assert known[-1] and not known[320] and np.all(np.diff(np.flatnonzero(known[330:])) == 1)


@pytest.mark.parametrize(
    ("at", "how", "quantity", "more"),
    [
        ("linkage.crank", "adds", "x_lvdt", False), ("linkage.ring", "adds", "x_lvdt", True),
        ("linkage.ring", "adds", "stops_of_x_lvdt", True), ("sensors.lvdt", "adds", "stops_of_x_lvdt", False),
        ("valve.current", "adds", "stops_of_i_cmd", True), ("valve.current", "adds", "stops_of_x_lvdt", False),
        ("linkage.crank", "adds", "x_lvdt_lagged_by_1_s", True),
        ("sensors.lvdt", "adds", "x_lvdt_lagged_by_1_s", False),
        ("valve.opening", "adds", "i_cmd_lagged_by_1_s", False),
        ("sensors.vigv", "times", "x_lvdt_lagged_by_1_s", False),
        ("sensors.vigv", "adds", "x_lvdt_lagged_by_1_s", True),
    ],
)  # fmt: skip
def test_a_curve_is_a_candidate_where_no_plainer_one_says_the_same(
    at: str, how: str, quantity: str, more: bool
) -> None:
    place: Any = SimpleNamespace(at=at, how=how)
    values = np.arange(9.0)
    behind = (values,) if "_lagged_" in quantity or quantity.startswith("stops") else ()
    assert _says_more(place, Quantity(quantity, "mm", COLUMN, values, behind)) == more


def test_the_profiles_of_the_bank_are_safe_demands() -> None:
    bank = experiment.profiles.__wrapped__()
    assert len(bank) == 8
    for name, profile in bank.items():
        assert profile.min() >= 45.0 and profile.max() <= 100.0 and 5000 <= len(profile) <= 13000, name
    ramp = bank["slow ramp up and down over the whole range"]
    assert len(ramp) == 12000 and (ramp[0], ramp[6000], ramp[6299]) == pytest.approx((45.0, 100.0, 100.0))
    assert ramp[9150] == pytest.approx(72.5) and ramp[3150] == pytest.approx(72.5)
    slams = bank["slams between 55 and 98 %"]
    assert set(np.round(slams[[400, 600, 1900, 2100]])) == {55.0, 98.0}
    assert np.count_nonzero(np.diff((slams > 76.0).astype(int)) == 1) == 4
    stairs = bank["stairs of 5 % with dwells"]
    assert [float(stairs[100 * (3 + 7 * k)]) for k in range(16)] == [60, 65, 70, 75, 80, 85, 90, 95, 99, 95, 90, 85, 80,
                                                                     75, 70, 65]  # fmt: skip
    small = bank["small reversals about 80 %"]
    assert np.abs(small - 80.0).max() == pytest.approx(1.5 * (1.0 + 23.0 / 8.0), rel=0.01)
    sine = bank["swept sine, 2 % about 82 %, 0.05 to 1.5 Hz"]
    assert len(sine) == 10000 and sine[0] == pytest.approx(82.0) and np.abs(sine - 82.0).max() == pytest.approx(2.0)


def test_the_profile_that_needs_the_fewest_runs_is_recommended(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {"dwells at 50, 80 and 99 %": (100.0, 0.4), "stairs of 5 % with dwells": (10.0, 9.0)}

    def divergence(profile: Array, truth: Any, stage: str, rival: str, named: str, *_: Any, **__: Any) -> Any:
        assert truth == {"valve_lag": {"time": 5.0}} and (stage, named) == ("actuator", "valve_lag")
        name = next(n for n, p in experiment.profiles().items() if p is profile)
        nats, spreads = told.get(name, (0.1, 0.1))
        return nats * (2.0 if rival == "lvdt_lag" else 1.0), spreads

    monkeypatch.setattr(experiment, "divergence", divergence)
    monkeypatch.setattr(
        experiment, "EFFECTS", {"valve_lag": SimpleNamespace(parameters=[SimpleNamespace(name="time")])}
    )
    named = SimpleNamespace(
        effect="valve_lag", rivals=["lvdt_lag", "can_delay"], parameters={"time": {"value": 5.0}, "x": {"value": 1.0}}
    )
    d = SimpleNamespace(stages=[SimpleNamespace(stage="actuator", effects=[named])])
    done: list[float] = []
    got = experiment.recommend(d, done.append)
    assert got is not None and done[-1] == 1.0 and len(done) == 16
    nats, spreads = NATS, RIVAL_SPREADS
    needed = [row["needed"] for row in got["table"]]
    assert needed[:2] == pytest.approx([(2.0 * spreads / 0.4) ** 2, 2.0 * nats / 10.0]) and got["separates"]
    best = got["table"][0]
    assert got["repeats"] == 3 and got["profile"] == best["profile"] == "dwells at 50, 80 and 99 %"
    assert got["score"] == pytest.approx(got["repeats"] * best["nats"])
    unit, profile = got["inputs"]["n_dem"]
    assert unit == "%" and len(profile) == got["repeats"] * len(experiment.profiles()[best["profile"]])
    assert got["t"][:2].tolist() == [0.0, 0.01] and len(got["t"]) == len(profile)
    assert [row["needed"] for row in got["table"]] == sorted(row["needed"] for row in got["table"])
    told.clear()
    none = experiment.recommend(d)
    assert none is not None and not none["separates"] and none["repeats"] == 1
    assert none["text"].startswith(
        "No profile of the bank separates valve_lag from lvdt_lag, valve_lag from can_delay, "
    )
    assert experiment.recommend(SimpleNamespace(stages=[SimpleNamespace(effects=[])])) is None


# ---- a simulated machine ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def machine_log() -> Log:
    t = 0.01 * np.arange(2400)
    run = lockstep(Stimulus.of(75.0 + 12.0 * np.sin(0.5 * t) + 2.0 * np.sin(2.3 * t)), seed=1, hashed=False)
    return Log(
        "simulated", {k: Channel(run.t, v) for k, v in run.columns.items() if k not in ("t", "n_engine", "i_motor")}
    )


@pytest.fixture(scope="module")
def chain(machine_log: Log) -> Chain:
    return build_chain(machine_log)


def test_the_nominal_machine_has_every_stage_at_its_noise(chain: Chain) -> None:
    assert [s.name for s in chain.stages] == ["demand", "servo", "engine", "actuator", "linkage"]
    assert chain.not_observed == {} and chain.notes == [] and chain.steps == {}
    units = {"demand": "mm", "servo": "mA", "engine": "%", "actuator": "mm", "linkage": "deg"}
    least = {"demand": 0.002, "servo": 0.001, "engine": 0.0001, "actuator": 0.0001, "linkage": 0.001}
    for s in chain.stages:
        assert set(s.units) == {units[s.name]} and s.memory == 10.0 and s.floor is not None
        assert np.all(s.floor >= least[s.name])
        e = s.run(s.neutral()[None])[0] - s.measured
        assert np.all(rms(s, e) < 1.6 * s.floor), s.name
        assert np.isfinite(s.measured).mean() > 0.6 and not np.isfinite(s.measured[:, :300]).any()  # it settles first
        assert (s.window == 1.0) == (s.name in ("servo", "actuator"))
        *own, onset = s.parameters
        assert {p.name for p in own} <= set(FREE[s.name]) and (onset.name, onset.limits()) == ("onset", (0.0, 0.0))
    assert chain.stage("linkage").outputs == tuple(v for v in VANES if v in chain.plant.vanes)


def test_stages_declare_their_nominal_parameters_and_effects(chain: Chain) -> None:
    for s in chain.stages:
        driven = s.made.driven  # type: ignore[attr-defined]
        parameters, effects, rows, si = declared(s.name, driven)
        nominal = {n.name: n for n in chain.plant.nominal}
        assert [p.name for p in parameters] == [n for n in FREE[s.name] if n in nominal]
        for p in parameters:
            n = nominal[p.name]
            assert p.value == pytest.approx(n.value) and (p.unit, p.tolerance) == (n.unit, n.tolerance)
            assert p.low <= p.value <= p.high
        assert [e.name for e in effects] == [
            e.name for e in EFFECTS.values() if s.name in e.stages and chain.plant.kind in e.kinds
        ]
        assert len(rows) == len(si) == len(parameters) + sum(len(e.parameters) for e in effects)
        some = effects[0].name if effects else ""
        without = declared(s.name, driven._replace(present=(some,)))[1]
        assert [e.name for e in without] == [e.name for e in effects[1:]]
        assert [e.name for e in declared(s.name, driven._replace(laws=(some,)))[1]] == [some] * bool(effects)


def test_vanes_that_a_recorder_has_late_are_told_by_how_much(machine_log: Log, chain: Chain) -> None:
    assert late_vanes(chain.stages) == {}
    channels = dict(machine_log.channels)
    for v in VANES:
        if v in channels:
            c = channels[v]
            channels[v] = Channel(c.t + 0.015, c.values)
    moved = build_chain(Log("late", channels))
    (note,) = moved.notes
    assert note.startswith("linkage: vigv, ") and "late in the file; moved" in note
    assert float(note.split("stand ")[1].split(" ms")[0]) == pytest.approx(15.0, abs=1.0)
    assert moved.stage("linkage").floor == pytest.approx(chain.stage("linkage").floor, rel=0.15)


def test_candidates_are_of_what_moves_at_a_place(chain: Chain) -> None:
    p = chain.plant.p
    assert room_for(p) > 0
    source = VaneChainCandidates(chain.stage("actuator"))
    place = {f"{q.at} {q.how}": q for q in PLACES.values()}
    idle = source._idle
    assert idle(place["sensors.lvdt times"], "x_lvdt", "actuator") and not idle(
        place["sensors.lvdt adds"], "time", "actuator"
    )
    assert idle(place["sensors.lvdt adds"], "x_lvdt", "actuator") and not idle(
        place["valve.opening adds"], "i_cmd", "actuator"
    )
    assert idle(place["valve.opening adds"], "n_r", "actuator") and idle(
        place["actuator.load adds"], "vigv", "actuator"
    )
    assert idle(place["actuator.load adds"], "x_dem", "actuator") and not idle(
        place["actuator.load adds"], "n_r", "actuator"
    )
    assert idle(place["engine.demand adds"], "x_lvdt", "engine") and not idle(
        place["engine.demand adds"], "n_r", "engine"
    )
    assert idle(place["servo.current adds"], "vigv", "servo") and not idle(
        place["servo.current adds"], "x_dem", "servo"
    )
    assert idle(place["linkage.ring adds"], "i_cmd", "linkage") and not idle(
        place["linkage.ring adds"], "x_lvdt", "linkage"
    )
    assert (
        source._size(place["servo.current times"], 9.0) == 0.3 and source._size(place["sensors.lvdt adds"], 0.2) == 0.2
    )
    assert (
        source._size(place["sensors.lvdt adds"], 0.01) == 0.05 and source._size(place["linkage.ring adds"], 0.7) == 0.7
    )
    assert source.reach(SimpleNamespace(basis=SimpleNamespace(low=1.0, high=2.0))) == (1.0, 2.0)  # type: ignore[arg-type]


def test_a_stage_is_made_anew_with_some_laws(chain: Chain) -> None:
    stage = chain.stage("actuator")
    few = remade(stage, ["valve_lag", "lvdt_gain"], ())
    assert {e.name for e in few.effects} == {"valve_lag", "lvdt_gain"} and few.floor is stage.floor
    assert few.regimes is stage.regimes and few.memory == stage.memory and few.raster_error is stage.raster_error
    demand = chain.stage("demand")
    assert demand.lost is not None and remade(demand, ["can_delay"], ()).lost is demand.lost
    neutral = stage.run(stage.neutral()[None])
    assert few.run(few.neutral()[None]) == pytest.approx(neutral, abs=1e-12)
    rest = without_laws(chain.stages, ["valve_lag", "nothing"])
    assert [s is r for s, r in zip(chain.stages, rest, strict=True)] == [True, True, True, False, True]
    assert "valve_lag" not in [e.name for e in rest[3].effects]


def test_excerpts_of_a_stage_say_the_same_as_the_whole(chain: Chain) -> None:
    at = np.r_[600:1200, 1500:2100]
    for name in ("actuator", "linkage"):
        stage: Stage = chain.stage(name)
        assert stage.excerpt is not None
        part = stage.excerpt(at)
        assert part.t == pytest.approx(stage.t[at]) and part.floor is stage.floor
        counts = np.isfinite(part.measured)
        assert 0.4 < counts.mean() < 1.0 and np.array_equal(part.measured[counts], stage.measured[:, at][counts])
        e = part.run(part.neutral()[None])[0] - part.measured
        assert np.all(rms(part, e) < 1.6 * np.asarray(stage.floor))


# ---- clocks of a simulated machine


def servo_of(late: float, late_stroke: float = 0.0, passed: LowPass | None = None, last: bool = False) -> Stage:
    """A servo subsystem whose current follows the firmware's law, of a demand and a stroke that stand late in the log
    by so much (s), or of a demand that has not passed what stroke and current have.
    """
    rows, none, noise = 2000, np.zeros(2000), 1e-3
    t = 0.01 * np.arange(rows)
    x = 20.0 + 5.0 * np.sin(0.9 * t) + np.sin(3.1 * t + 1.0)
    x_dem = np.interp(t, t[::7], 20.0 + 6.0 * np.sin(0.8 * t[::7]) + np.cos(2.3 * t[::7]))
    law = law_of(x_dem, none, CALIBRATION, behind=passed or LowPass(late=-late))
    law = law + law_of(none, np.interp(t + late_stroke, t, x), CALIBRATION)
    c = {
        "x_dem": x_dem, "x_lvdt": x, "stroke": x, "missing": none, "law": law_of(x_dem, x, CALIBRATION),
        "i_cmd": (law[:, -1] if last else law.mean(axis=1)) + noise * white(1, rows),
        "law_error": noise * white(2, rows, 3),
    }  # fmt: skip
    stage = servo_stage(Driven(t, c, build_plant(), CALIBRATION, ("i_cmd",), np.ones(rows, dtype=bool), ()))
    stage.floor = np.array([1.05 * noise])
    return stage


@pytest.mark.parametrize(
    ("late", "late_stroke", "last"),
    [(0.0, 0.0, False), (0.02, 0.0, False), (-0.013, 0.0, False), (0.004, -0.017, False), (0.02, 0.0, True)],
)
def test_a_servo_s_demand_and_stroke_that_stand_late_are_told(late: float, late_stroke: float, last: bool) -> None:
    found = {one.channels: one.seconds for one in _servo(servo_of(late, late_stroke, last=last))}
    wanted = {("x_dem",): late, ("x_lvdt",): late_stroke}
    assert found == pytest.approx({c: v for c, v in wanted.items() if v}, abs=2e-4)


@pytest.mark.parametrize(
    ("passed", "said"),
    [
        (LowPass("mean", 0.015), "a mean over 30 ms"),
        (LowPass("first order", 0.02, 0.004), "a low-pass of first order of 7.96 Hz"),
        (LowPass("second order", 0.02), "a low-pass of second order of 11.3 Hz"),
    ],
)
def test_a_low_pass_that_the_analogue_channels_have_passed_is_told_by_kind_and_corner(
    passed: LowPass, said: str
) -> None:
    (one,) = _servo(servo_of(0.0, passed=passed))
    assert one.channels == ("x_dem",) and one.passed.text() == said
    assert (one.passed.delay, one.passed.late) == pytest.approx((passed.delay, passed.late), abs=1e-4)
    assert one.seconds == pytest.approx(-passed.delay - passed.late, abs=1e-4)
    assert one.text() == (
        f"x_dem: stand {1e3 * abs(one.seconds):.3g} ms early in the file, because the analogue channels have passed "
        f"{said}; moved"
    )
    assert demand_of([one, Late(("n_r",), 0.1)]) == (one.passed, (Late(("n_r",), 0.1),))


def moved_by(log: Log, **late: float) -> Log:
    return Log("moved", {k: replace(c, t=c.t + late.get(k, 0.0)) for k, c in log.channels.items()})


@pytest.mark.parametrize(
    ("late", "found"),
    [
        ({"n_r": 0.03}, {"demand": {"n_r": 30.0}, "engine": {"n_dem": -30.0}}),
        (
            {"x_dem": 0.03, "n_dem": -0.02},
            {"servo": {"x_dem": 30.0}, "demand": {"n_r": -30.0}, "engine": {"n_dem": -20.0}},
        ),
    ],
)
def test_channels_that_a_recorder_has_late_are_told_in_each_subsystem(
    machine_log: Log, late: dict[str, float], found: dict[str, dict[str, float]]
) -> None:
    stages = [s for s in build_chain_as_it_is(moved_by(machine_log, **late)).stages if s.name != "linkage"]
    of = late_in_controller(stages)
    assert of.get("actuator") == of.get("servo") and "linkage" not in of
    got = {
        name: {one.channels[0]: 1e3 * one.seconds for one in all_of}
        for name, all_of in of.items()
        if name != "actuator"
    }
    assert set(got) == set(found)
    for name, of_stage in found.items():
        assert got[name] == pytest.approx(of_stage, abs=1.0), name


def build_chain_as_it_is(log: Log) -> Chain:
    return build_chain(log, late={})


# ---- curves that nobody named


@pytest.fixture(scope="module")
def on_actuator(chain: Chain) -> tuple[VaneChainCandidates, dict[str, Any]]:
    source = VaneChainCandidates(chain.stage("actuator"), others=chain.stages)
    return source, {c.name: c for c in source.candidates(source.stage((), ()).neutral())}


def test_every_place_of_a_subsystem_has_curves_of_all_that_says_something_there(
    on_actuator: tuple[VaneChainCandidates, dict[str, Any]], chain: Chain
) -> None:
    source, found = on_actuator
    driven = source.driven
    places = {f"{p.at} {p.how}" for p in ALL_PLACES if "actuator" in p.stages and driven.machine.kind in p.kinds}
    assert {f"{c.at} {c.how}" for c in found.values()} == places
    for name, c in found.items():
        word = {"adds": "curve", "times": "gain"}[c.how]
        assert name == f"{c.at}.{word}_of_{c.quantity.name}" and ALL_PLACES[c.place].at == c.at
        assert c.mean != c.quantity.stops and c.near == (c.quantity.name in NEAR.get(c.at, ()))
        assert len(c.quantity.visited) == np.isfinite(source.all.measured).any(axis=0).sum()
    of = {at: {c.quantity.name for c in found.values() if f"{c.at} {c.how}" == at} for at in places}
    assert of["sensors.lvdt adds"] == {"time"}  # a constant pressure tells nothing
    assert of["valve.opening adds"] == {"i_cmd"} and "stops_of_i_cmd" in of["valve.current adds"]
    lags = sorted(q for q in of["actuator.load adds"] if q.startswith("i_cmd_lagged"))
    # of 3 samples and of an eighth of the log: a sixth, a half and five sixths of the way, in logarithms
    assert lags == ["i_cmd_lagged_by_1390_ms", "i_cmd_lagged_by_300_ms", "i_cmd_lagged_by_64600_us"]
    assert not any(VANES_SET & of_place or "x_dem" in of_place for of_place in of.values())
    # a usual curve is as large as a constant that moves the stage by its error, where that is less than usual
    theta = source.all.neutral()[: len(source.all.parameters)]
    judge = LeastSquaresProblem(source.stage((), ()), source.floor)
    error = np.sqrt(np.sum(judge.errors(judge.fit((), theta, 1).theta[None]) ** 2) / judge.n)
    for at in ("valve.current adds", "actuator.load adds", "actuator.flow_gain times"):
        c = next(c for c in found.values() if f"{c.at} {c.how}" == at and not c.quantity.stops)
        with_it = LeastSquaresProblem(source.stage((), ((c.placed(), c.effect(1.0)),)), source.floor)
        thetas = np.repeat(with_it.stage.neutral()[None], 2, axis=0)
        thetas[1, len(theta)] = c.size
        still, by = with_it.errors(thetas)
        assert np.sqrt(np.sum((by - still) ** 2) / with_it.n) == pytest.approx(error, rel=0.02), at
    (slips,) = (c for c in found.values() if c.quantity.stops)
    assert (slips.size, slips.quantity.unit) == (1.0, "mA") and slips.basis.low == 0.0
    i = driven.columns["i_cmd"]
    assert slips.basis.high == pytest.approx(0.5 * np.ptp(i))


def test_curves_of_each_subsystem_are_of_what_drives_it(chain: Chain) -> None:
    names = {}
    for stage in ("servo", "engine", "demand"):
        source = VaneChainCandidates(chain.stage(stage))
        found = source.candidates(source.all.neutral()[: len(source.all.parameters)])
        names[stage] = {c.quantity.name.split("_lagged")[0] for c in found}
        assert {c.at.split(".")[0] for c in found} == {{"demand": "controller"}.get(stage, stage)}
        assert {c.quantity.name.split("_lagged")[0] for c in found if "_lagged" in c.quantity.name} == set(
            LAGGED[stage]
        )
    assert names["engine"] == {"n_r", "n_dem", "time"} == names["demand"]
    assert names["servo"] == {
        "i_cmd",
        "x_lvdt",
        "speed_of_x_lvdt",
        "n_r",
        "time",
        "n_dem",
        "x_dem",
        *candidates.OF_STROKE,
    }
    source = VaneChainCandidates(chain.stage("linkage"))
    two = source._late(source.driven, "x_lvdt", np.ones(len(source.all.t), dtype=bool))
    again = two[0].slower(3.0)
    tau = [float(q.name.split("_")[-2]) for q in two]
    assert tau == [64600.0, 300.0, 1390.0] and again is not None and again.name == "x_lvdt_lagged_by_194_ms"
    assert two[0].slower(200.0) is None and two[0].slower(0.1) is None  # longer than a log can tell, and shorter
    assert source._late(source.driven, "p_s", np.ones(len(source.all.t), dtype=bool)) == []
    assert source._stops(source.driven, "t_oil", np.ones(len(source.all.t), dtype=bool)) is None
    sine = source._stops(source.driven, "x_lvdt", np.arange(len(source.all.t)) > 1800)
    assert sine is not None and sine.visited[-1] <= 0.5 * np.ptp(source.driven.columns["x_lvdt"])


def test_a_long_log_is_learned_on_an_excerpt_and_judged_on_the_rest(
    chain: Chain, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, n in (
        ("MOST_SAMPLES", 1200),
        ("QUICK_SAMPLES", 600),
        ("LEARN_PIECE", 300),
        ("FREE_PIECE", 600),
        ("SHORT_PIECE", 100),
    ):
        monkeypatch.setattr(candidates, name, n)
    for name, piece, short in (("actuator", 300, 100), ("linkage", 600, 300)):
        stage = chain.stage(name)
        source = VaneChainCandidates(stage, test=stage)
        assert source.tests == {"rest of the log", "test"} and source.all is stage
        assert np.array_equal(stage.t[~source.rest], source.whole.t) and len(source.whole.t) == pytest.approx(
            1200, abs=piece
        )
        for part, long in ((source.whole, piece), (source.small, short)):
            pieces = np.split(part.t, np.flatnonzero(np.diff(part.t) > 0.011) + 1)
            assert all(len(p) % long == 0 for p in pieces)
        assert len(source.small.t) == pytest.approx(600, abs=short)
        source.in_grains(0.25)
        assert source.whole.grain == source.small.grain == 0.25
        assert len(source.stage((), ()).t) == len(source.whole.t) and len(source.stage((), (), True).t) == len(
            source.small.t
        )
        theta = source.stage((), ()).neutral()
        errors = source.errors((), theta)
        assert list(errors) == ["log", "rest of the log", "test"]
        log, rest, test = (np.isfinite(e) for e in errors.values())
        assert not (log & rest).any() and np.array_equal(log | rest, test)
        assert not log[:, source.rest].any() and not rest[:, ~source.rest].any()
        assert np.nanstd(errors["test"]) == pytest.approx(1.0, abs=0.35)
        on_whole = LeastSquaresProblem(source.stage((), ()), source.floor)
        assert np.array_equal(on_whole.floor, stage.floor)
        q = source.driven.quantity("i_cmd")
        some: Any = SimpleNamespace(
            quantity=SimpleNamespace(stops=False, name="i_cmd"), basis=SimpleNamespace(reaches=lambda v: v > 0.0)
        )
        within = source.within(some)
        assert list(within) == ["rest of the log", "test"] and all(np.array_equal(w, q > 0.0) for w in within.values())
        some.quantity.name = "nothing"
        assert source.within(some) == {}
        some.quantity = SimpleNamespace(stops=True, name="i_cmd")
        assert source.within(some) == {}
        (course,) = source.courses((), theta)
        counts = np.isfinite(stage.measured)
        own = (stage.run(stage.neutral()[None])[0] - stage.measured) / stage.floor[:, None]
        assert np.array_equal(course.t, stage.t) and not course.error[~counts].any()
        assert course.error[counts] == pytest.approx(own[counts])
        assert len(course.drivers) == 5
    plain = VaneChainCandidates(chain.stage("servo"))  # has no excerpts
    assert plain.whole is plain.small is chain.stage("servo") and plain.tests == frozenset()
    assert list(plain.errors((), plain.stage((), ()).neutral())) == ["log"]


def learned(at: str, how: str, of: str, low: float, high: float, *values: float) -> Learned:
    return Learned(how=how, at=at, of=of, low=low, high=high, values=list(values),
                   knots=[low] * 4 + [high] * 4)  # fmt: skip


def test_a_law_from_a_file_is_its_curve_times_a_scale(chain: Chain) -> None:
    low, high = 2.0, 40.0
    law = learned("valve.current", "adds", "x_lvdt", low, high, 0.1, 0.1, 0.1, 0.1)  # splines add up to one
    placed, effect = curve_effect("law", law)
    assert [p.name for p in effect.parameters] == ["scale"] and effect.starts == ((1.0,),)
    assert placed.curve is not None and (placed.curve.low, placed.curve.high) == (low, high)
    assert placed.curve.whole(np.array([2.0])) == pytest.approx(0.2) and not placed.curve.whole(placed.neutral).any()
    stage = chain.stage("actuator")
    assert with_laws(stage, (), (), "a.csv") is stage
    with_it = with_laws(stage, (), [(placed, effect)], "a.csv")
    assert [e.name for e in with_it.effects] == ["law"] and with_it.floor is stage.floor
    two = np.array([with_it.neutral(), with_it.neutral()])
    two[1, -1] = 3.0
    still, by = with_it.run(two)[:, 0]
    theta = np.array([stage.neutral()] * 2)
    theta[1, stage.index()["valve_null_bias"]] = 0.3  # mA
    assert np.array([still, by]) == pytest.approx(stage.run(theta)[:, 0], abs=1e-9) and np.ptp(by - still) > 0.1
    none = curve_effect("law", learned("sensors.lvdt", "adds", "n_dem", 0.0, 1.0, 0.0, 1.0, 2.0, 3.0))
    without = remade(stage, (), ())
    assert isinstance(without.made, tuple)
    driven = without.made.driven  # type: ignore[attr-defined]
    gone = {k: v for k, v in driven.columns.items() if k != "n_dem"}
    without.made = without.made._replace(driven=driven._replace(columns=gone))  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="^a.csv: law: the log has no n_dem$"):
        with_laws(without, (), [none], "a.csv")


def test_a_curve_at_a_shared_place_is_judged_in_the_other_subsystem(chain: Chain) -> None:
    source = VaneChainCandidates(chain.stage("actuator"), others=[s for s in chain.stages if s.name != "actuator"])
    assert [s.name for s in source.others] == ["demand", "servo", "engine", "linkage"]
    law = curve_effect("law", learned("sensors.lvdt", "adds", "x_lvdt", 2.0, 40.0, -2.0, 1.0, -1.0, 2.0))
    theta = source.stage((), [law]).neutral()
    assert source.elsewhere([law], theta) == {}  # a scale of 0 moves nothing
    theta[-1] = 1.0
    (said,) = source.elsewhere([law], theta).items()
    assert said[0] == "the linkage subsystem" and said[1] > 1.0 and list(source.left) == ["linkage"]
    assert source.elsewhere([law], theta) == {said[0]: pytest.approx(said[1])}
    theta[-1] = 2.0
    assert source.elsewhere([law], theta)[said[0]] == pytest.approx(said[1] + np.log(2.0), abs=0.2)
    at_valve = curve_effect("law", learned("valve.current", "adds", "x_lvdt", 2.0, 40.0, -2.0, 1.0, -1.0, 2.0))
    assert source.elsewhere([at_valve], theta) == {}
    of_demand = curve_effect("law", learned("sensors.lvdt", "adds", "n_dem", 0.0, 100.0, -2.0, 1.0, -1.0, 2.0))
    (linkage,) = (s for s in source.others if s.name == "linkage")
    assert list(source.elsewhere([of_demand], theta)) == ["the linkage subsystem"]
    driven, make = driven_of(linkage), linkage.made.make  # type: ignore[attr-defined]
    blind = make(driven._replace(columns={k: v for k, v in driven.columns.items() if k != "n_dem"}))
    blind.floor = linkage.floor
    source.others = [blind]
    assert source.elsewhere([of_demand], theta) == {}  # nothing is known of it there


# ---- what subsystems make of a log


def driven_of(stage: Stage) -> Driven:
    assert stage.made is not None
    return stage.made.driven  # type: ignore[attr-defined, no-any-return]


def test_the_stroke_without_its_noise_and_the_law_on_it_are_as_far_off_as_is_said(chain: Chain) -> None:
    """A stroke that is known, with a noise that is known."""
    driven, k = driven_of(chain.stage("actuator")), CALIBRATION.scalars
    t, c = driven.t, driven.columns
    known = without_noise(t, c, driven.machine)
    for sigma, rows in ((0.001, 25), (0.002, 41), (0.02, 41)):
        x = known.stroke + sigma * white(7, len(t))
        smooth = without_noise(t, c | {"x_lvdt": x}, driven.machine)
        assert smooth.noise == pytest.approx(sigma, rel=0.06) and smooth.rows == rows
        assert smooth.off == pytest.approx(x - (smooth.stroke - _smoothed(smooth.off, rows)), abs=1e-9)
        left = np.std((smooth.stroke - known.stroke)[100:-100])
        draws = [smooth.left(np.random.default_rng(s), np.zeros(len(t))) + smooth.distortion for s in range(4)]
        said = [np.std(d[100:-100]) for d in draws]
        assert left < 0.45 * sigma and np.sqrt(np.mean(np.square(said))) == pytest.approx(left, rel=0.15)
    law, of_mean, of_some = servo_law(t, c | {"x_lvdt": x}, CALIBRATION, smooth, {}, draws=4, samples=2)
    unknown = sigma * white(9, len(t), 10)
    unknown[:, -1] = 0.0  # at the row it is logged
    true = law_of(c["x_dem"], known.stroke, CALIBRATION, logged=x) - k.kp * unknown

    def size(values: Array) -> float:  # in windows, each with a constant of its integral
        v = values[100:2300].reshape(-1, 100)
        return float(np.std(v - v.mean(axis=1, keepdims=True)))

    assert [size(d) for d in of_mean.T] == pytest.approx([size(true.mean(axis=1) - law.mean(axis=1))] * 4, rel=0.08)
    assert [size(d) for d in of_some.T] == pytest.approx([size(samples_of(true - law, 2))] * 4, rel=0.08)
    assert size(law[:, -1] - true[:, -1]) < 0.3 * k.kp * sigma
    again = servo_law(t, c | {"x_lvdt": x}, CALIBRATION, smooth, {}, draws=2)
    assert np.array_equal(again[0], law) and np.array_equal(again[1], of_mean[:, :2])


def test_the_demand_of_the_machine_s_own_firmware_is_the_logged_one(chain: Chain) -> None:
    stage = chain.stage("demand")
    counts, at = np.isfinite(stage.measured[0]), stage.index()
    neutral = stage.neutral()
    as_is = stage.run(neutral[None])[0, 0]
    assert np.array_equal(as_is[counts], stage.measured[0, counts])

    def with_(name: str, *values: float) -> Array:
        theta = neutral.copy()
        theta[at[name]] = values
        return np.asarray(stage.run(np.array([neutral, theta]))[1, 0])

    inner = slice(500, None)
    assert with_("schedule_error", 0.7)[inner] == pytest.approx(as_is[inner] + 0.7, abs=0.05)  # but for the rate limit
    late = with_("can_delay", 0.03)
    assert late[500:] == pytest.approx(as_is[497:-3])
    half = with_("can_delay", 0.025)  # between two frames the speeds run straight
    assert half[inner] == pytest.approx(0.5 * (as_is[498:-2] + as_is[497:-3]), abs=0.04)
    held = with_("frame_hold", 0.05, 0.4)  # frames of every 50 ms, of which one stands 20 ms behind the first row
    driven = driven_of(stage)
    n = np.maximum((np.arange(len(as_is)) - 2) // 5 * 5 + 2, 0)
    columns = driven.columns | {name: driven.columns[name][n] for name in ("n_dem", "n_r")}
    same = demand_stage(driven._replace(columns=columns, again=True))
    assert held[inner] == pytest.approx(same.run(same.neutral()[None])[0, 0, inner])
    assert np.array_equal(with_("frame_hold", 0.0004, 0.4), as_is)  # a frame comes every 10 ms
    assert not np.array_equal(with_("trend_threshold_error", 5.0), as_is)
    assert same.lost is None and stage.lost is not None and len(stage.lost) == 8
    phase = stage.effect("frame_hold").parameters[1]
    assert (phase.low, phase.high, phase.period, phase.shape) == (0.0, 1.0, 1.0, True)
    starts = stage.effect("frame_hold").starts
    assert sorted({h for h, _ in starts}) == pytest.approx(0.01 * np.arange(2, 51))
    assert [p for h, p in starts if h == pytest.approx(0.04)] == pytest.approx([0.0, 0.25, 0.5, 0.75])


def test_a_controller_of_the_user_s_own_is_run_from_below_and_from_above(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its demand (mm): 10 and the table's offset, plus a hundredth of the speed; where it began is forgotten in 1 s."""
    seen = []

    def run(n_dem: Array, n_r: Array, start: float, angles: Array, before: float, *rest: Any) -> None:
        *_, flashed, program, out = rest
        seen.append((start, angles, before, program))
        forgotten = before * np.exp(-np.arange(len(n_r)) / 20.0)
        out[:] = 1e-3 * (10.0 + 0.01 * n_r + 0.001 * forgotten) + flashed.table[1, 0] - CALIBRATION.table[1, 0]

    monkeypatch.setattr(demand, "_run", run)
    n = 1000
    t = 0.01 * np.arange(n)
    n_r = 70.0 + 10.0 * np.sin(t)
    missing = np.zeros(n)
    missing[700] = 1.0
    c = {"n_dem": n_r + 1.0, "n_r": n_r, "x_dem": 10.0 + 0.01 * n_r, "missing": missing, "vigv": 10.0 * np.sin(t)}
    program = SimpleNamespace(start=lambda flashed: "started")
    cal = CALIBRATION._replace(program=program)
    machine = build_plant()
    stage = own_demand_stage(Driven(t, c, machine, cal, ("x_dem",), np.ones(n, dtype=bool), ()))
    assert [(b, p) for _, _, b, p in seen] == [(demand.APPROACH, "started"), (-demand.APPROACH, "started")]
    start, angles = seen[0][:2]
    assert start == pytest.approx(1e-3 * c["x_dem"][0]) and angles.shape == (len(machine.vanes), n)
    assert angles[0] == pytest.approx(np.deg2rad(c["vigv"])) and np.isnan(angles[1]).all()
    assert [e.name for e in stage.effects] == ["can_delay", "schedule_error", "trend_threshold_error"]
    differs = 2e-6 * demand.APPROACH * np.exp(-np.arange(n) / 20.0) > demand.DEMAND_SAME
    counts = ~lately(differs, 0.5) & ~lately(missing > 0.0, 0.4)
    assert np.array_equal(np.isfinite(stage.measured[0]), counts) and 0.5 < counts.mean() < 0.99
    theta = np.array([stage.neutral()] * 3)
    at = stage.index()
    theta[1, at["schedule_error"]] = 0.5
    theta[2, at["can_delay"]] = 0.02
    as_is, more, late = stage.run(theta)[:, 0]
    rest = slice(300, None)
    assert as_is[rest] == pytest.approx(c["x_dem"][rest], abs=1e-4) and more == pytest.approx(as_is + 0.5)
    assert late[rest] == pytest.approx(as_is[298:-2], abs=1e-4)


def test_noise_of_an_input_counts_as_an_error_as_far_as_it_is_seen() -> None:
    t, grid = 0.01 * np.arange(6000), 0.5
    values = np.round(40.0 * np.sin(0.02 * t) / grid) * grid
    for seed in range(3):  # a digit: even over one step, and the same as long as the value is
        draw = last_digit(values, grid)(np.random.default_rng(seed))
        assert np.abs(draw).max() <= 0.5 * grid and np.ptp(draw) > 0.9 * grid
        assert not np.diff(draw)[np.diff(values) == 0.0].any()
    of = _other_noise(t, np.sin(t) + 0.2 * white(3, 6000), 0.0)
    one, two = (of(np.random.default_rng(seed)) for seed in (0, 1))
    assert one.std() == pytest.approx(0.2, rel=0.05) and abs(np.corrcoef(one, two)[0, 1]) < 0.05
    makes = np.array([white(k, 6000) for k in (1, 2, 3)])
    share, beyond = _by_noise(t, 0.5 * white(4, 6000), makes, 1e-3)
    assert share == pytest.approx(0.25, rel=0.05) and beyond == pytest.approx(0.0, abs=0.1)
    assert (
        _by_noise(t, 2.0 * white(4, 6000), makes, 1e-3)[0] == 1.0 and _by_noise(t, makes[0], 0.0 * makes, 1.0)[0] == 0.0
    )
    slow = 3.0 * np.sin(0.3 * t)  # what noise behind a filter makes, beside what is seen of it
    share, beyond = _by_noise(t, 0.5 * white(4, 6000), makes + slow, 1e-3)
    assert share == pytest.approx(0.25, rel=0.05) and beyond == pytest.approx(0.5 * 3.0 / np.sqrt(2.0), rel=0.05)
    assert _by_noise(t, 0.5 * white(4, 6000), makes, 2.0)[1] == 0.0  # the floor holds more


def test_the_current_between_two_rows_is_what_the_raster_hides_from_the_actuator(chain: Chain) -> None:
    stage, driven = chain.stage("actuator"), driven_of(chain.stage("actuator"))
    make = stage.made.make  # type: ignore[attr-defined]
    other = make(driven._replace(columns=driven.columns | {"ticks": driven.columns["other_ticks"]}))
    neutral = stage.neutral()
    between = rms(stage, stage.run(neutral[None])[0] - other.run(neutral[None])[0])
    again = make(driven._replace(again=True))
    assert stage.hidden is not None and stage.hidden(neutral) == pytest.approx(between)
    assert stage.raster_error == pytest.approx(np.hypot(again.raster_error, between)) and between[0] > 0.0
    assert np.array_equal(again.run(neutral[None]), stage.run(neutral[None]))
    sticky = neutral.copy()
    sticky[stage.index()["piston_stiction"]] = stage.effect("piston_stiction").starts[-1]
    soft = sticky.copy()
    soft[stage.index()["oil_compressibility"].start] += 20.0
    hidden = [float(stage.hidden(theta)[0]) for theta in (neutral, sticky, soft)]
    assert hidden[0] < hidden[1] < hidden[2]
    one = make(driven._replace(columns={k: v for k, v in driven.columns.items() if k != "other_ticks"}))
    assert one.hidden is None and one.raster_error == pytest.approx(again.raster_error)
    assert stage.finer is not None
    fine, usual = stage.finer(neutral[None]), stage.run(neutral[None])
    assert 0.0 < np.abs(fine - usual).max() < 0.2 * stage.floor[0] and fine.shape == usual.shape  # type: ignore[index]
    name, warm = stage.twins["oil_viscosity"]
    assert name == "time" and warm(neutral[None]) == pytest.approx(usual, abs=0.05)
    assert stage.quiet is not None and stage.quiet[0] < 1.05 * stage.floor[0]  # type: ignore[index]


def test_a_piston_counts_while_it_leans_on_a_stop_and_a_window_after_it_left(chain: Chain) -> None:
    stage, driven = chain.stage("actuator"), driven_of(chain.stage("actuator"))
    make = stage.made.make  # type: ignore[attr-defined]
    full = chain.plant.table.actuator.stroke.value
    for stop in (0.0, full):
        x = driven.columns["x_lvdt"].copy()
        x[1000:1050] = stop
        counts = np.isfinite(make(driven._replace(columns=driven.columns | {"x_lvdt": x})).measured[0])
        lost = np.flatnonzero(np.isfinite(stage.measured[0]) & ~counts)
        assert lost[[0, -1]].tolist() == [1050, 1148] and len(lost) == 99
    assert stage.counted is not None
    at = np.r_[600:900, 1200:1500]  # the spool and the lags come from another time
    kept = stage.counted(at)
    assert np.flatnonzero(~kept).tolist() == [*range(100), *range(300, 400)]


@pytest.mark.parametrize("name", ["actuator", "linkage", "engine"])
def test_rows_of_an_excerpt_give_what_the_whole_gives_there(chain: Chain, name: str) -> None:
    stage = chain.stage(name)
    at = np.r_[500:1100, 1400:2100]
    theta = np.array([stage.neutral()])
    whole = stage.run(theta)[0][:, at]
    driven = driven_of(stage)
    if stage.excerpt is None:
        numbers = np.repeat([0.0, 1.0], [600, 700])
        columns = {k: v[at] for k, v in driven.columns.items()} | {"stretch": numbers}
        part = stage.made.make(driven.at(at, columns, np.ones(len(at), dtype=bool)))  # type: ignore[attr-defined]
    else:
        part = stage.excerpt(at)
    assert part.t[0] == pytest.approx(5.0) and np.array_equal(driven_of(part).part_of[1], at)  # type: ignore[index]
    difference = part.run(theta)[0] - whole
    counts = np.isfinite(part.measured)
    if stage.window:  # each window's constant is free
        w = difference.reshape(-1, 100)
        difference = (w - w.mean(axis=1, keepdims=True)).reshape(1, -1)
    assert np.abs(difference[counts]).max() < (3.0 if name == "engine" else 0.6) * np.max(stage.floor)  # type: ignore[arg-type]
    if name == "linkage":
        assert stage.counted is not None
        kept = stage.counted(at)
        last = speed_reach(0.01)  # where the stroke leaps to the next piece
        assert kept[600 - last - 1] and not kept[600 - last : 600].any() and not kept[-last:].any()
        assert stage.counted(np.r_[500:1100, 1400:2400])[-1]
        assert np.array_equal(kept, np.isfinite(part.measured).all(axis=0))


def test_the_engine_s_speed_at_the_start_is_what_suits_its_first_second() -> None:
    machine, n = build_plant(), 800
    for dt in (0.01, 0.05, 4.0):
        t = dt * np.arange(n)
        n_dem = 75.0 + 10.0 * np.sin(0.2 * t / max(1.0, 2.0 * dt))
        stretch = (np.arange(n) >= 500).astype(int)
        c = {"n_dem": n_dem, "n_r": n_dem, "stretch": stretch}
        stage = engine_stage(Driven(t, c, machine, CALIBRATION, ("n_r",), np.ones(n, dtype=bool), ()))
        theta = stage.neutral()[None]
        first = stage.run(theta)[0, 0]
        off = stage.made.make(driven_of(stage)._replace(columns=c | {"n_r": first + 0.5}))  # type: ignore[attr-defined]
        again = off.run(theta)[0, 0]
        second = max(1, round(1.0 / dt))
        for start in (0, 500):
            head = slice(start, start + second)
            # the mean of the first second is the logged one: what was off at the start was taken off
            assert np.mean(again[head]) == pytest.approx(np.mean(first[head]) + 0.5, abs=0.26)


def test_a_quantity_of_a_log_is_its_channel_or_what_follows_from_it(chain: Chain) -> None:
    driven = driven_of(chain.stage("linkage"))
    t, c = driven.t, driven.columns
    assert driven.quantity("time") is driven.t and driven.quantity("nothing") is None
    assert driven.quantity("time_every_7_s") == pytest.approx(t % 7.0)
    assert driven.quantity("x_lvdt") is c["stroke"] and driven.quantity("n_r") is c["n_r"]
    assert driven.quantity("stops_of_x_lvdt") is c["stroke"]
    late = driven.quantity("n_r_lagged_by_500_ms")
    assert late is not None and late[0] == pytest.approx(c["n_r"][0])
    wanted = c["n_r"][0]
    share = 1.0 - np.exp(-0.01 / 0.5)
    for k in range(1, 200):
        wanted += share * (c["n_r"][k] - wanted)
    assert late[199] == pytest.approx(wanted, abs=0.03)
    v = driven.quantity("vgv1")
    assert v is not None and 0.0 < np.std(v - c["vgv1"]) < 0.1 and np.std(np.diff(v)) < np.std(np.diff(c["vgv1"]))
    speed = driven.quantity("speed_of_x_lvdt")
    assert speed is not None and np.corrcoef(speed, np.gradient(c["stroke"], t))[0, 1] > 0.98
    assert driven._replace(columns={}, turns=dict).quantity("speed_of_x_lvdt") is None
    at = np.r_[100:300, 700:900]
    part = driven.at(at, {k: x[at] for k, x in c.items()}, driven.run[at])
    for name in ("vgv1", "speed_of_x_lvdt", "n_r_lagged_by_500_ms", "x_lvdt"):
        whole = driven.quantity(name)
        assert whole is not None and np.array_equal(part.quantity(name), whole[at]), name  # type: ignore[arg-type]
    assert part.quantity("nothing") is None and driven._late("nothing", 1.0) is None
    assert driven.signals().size == 0 and not driven.curved  # no curve: no signals
    law = curve_effect("law", learned("linkage.ring", "adds", "n_r", 50.0, 90.0, 0.1, 0.1, 0.1, 0.1))
    lagged_law = curve_effect(
        "late", learned("linkage.ring", "adds", "x_lvdt_lagged_by_300_ms", 2.0, 40.0, 0.0, 1.0, 2.0, 3.0)
    )
    signals = driven._replace(curves=(law, lagged_law)).signals()
    assert driven._replace(curves=(law,)).curved and len(signals) == KNOWN + 2
    assert signals[QUANTITIES["n_r"].of] == pytest.approx(c["n_r"]) and np.isnan(signals[QUANTITIES["time"].of]).all()
    assert signals[QUANTITIES["x_lvdt"].of] == pytest.approx(1e-3 * c["stroke"]) and np.isnan(signals[-2]).all()
    assert signals[-1] == pytest.approx(1e-3 * driven.quantity("x_lvdt_lagged_by_300_ms"))  # type: ignore[operator]


# ---- a log that lacks something


def chain_of(log: Log, **kw: Any) -> Chain:
    """Its stages with every channel where the file has it."""
    grid = grid_of(log)
    return build_chain(log, grid=grid, pieces=[(0, grid.rows)], **kw)


def with_(log: Log, **values: Any) -> Log:
    """The same with other channels: values at its times, or a channel; None: without."""
    t = log["n_dem"].t
    made = {k: v if isinstance(v, Channel) else Channel(t, v) for k, v in values.items() if v is not None}
    return Log("a.csv", {k: v for k, v in (log.channels | made).items() if values.get(k, v) is not None})


NAMES = ["demand", "servo", "engine", "actuator", "linkage"]


def told(c: Chain) -> tuple[list[str], dict[str, str], list[str]]:
    return [s.name for s in c.stages], c.not_observed, list(c.notes)


def test_what_a_log_lacks_is_told_and_the_rest_is_judged(machine_log: Log, chain: Chain) -> None:
    log, n = machine_log, 2400
    none = "not logged; {} assumed, and effects that need it to change cannot be seen"
    assert told(chain_of(with_(log, p_s=None, t_oil=None))) == (
        NAMES, {}, [f"p_s: {none.format('21 MPa')}", f"t_oil: {none.format('40 degC')}"]
    )  # fmt: skip
    assert told(chain_of(with_(log, vgv5=np.sin(np.arange(n))))) == (
        NAMES, {}, ["vgv5: this machine has no such vane row (geometry); not judged"]
    )  # fmt: skip
    with pytest.raises(LogError, match="^a.csv: 400 samples of 0.01 s; at least 500 are needed to search for missing"):
        chain_of(Log("a.csv", {k: Channel(c.t[:400], c.values[:400]) for k, c in log.channels.items()}))
    still = chain_of(with_(log, n_dem=np.full(n, 70.0), n_r=np.full(n, 70.0), x_dem=np.full(n, 5.0)))
    assert told(still) == (
        NAMES[1:2] + NAMES[3:], {"demand": "n_dem, n_r, x_dem never change", "engine": "n_dem, n_r never change"}, []
    )  # fmt: skip
    alone = build_chain(Log("a.csv", {"n_dem": log["n_dem"]}))
    assert [s.name for s in alone.stages] == [] and alone.not_observed == {
        "demand": "no n_r", "servo": "no x_dem, x_lvdt", "engine": "no n_r", "actuator": "no i_cmd",
        "linkage": "no x_lvdt",
    }  # fmt: skip
    n_dem, n_r = log["n_dem"], log["n_r"]
    apart = chain_of(
        with_(log, n_dem=Channel(n_dem.t[:1000], n_dem.values[:1000]), n_r=Channel(n_r.t[1200:], n_r.values[1200:]))
    )
    assert apart.not_observed == {
        "demand": "n_dem, n_r, x_dem have no time in common", "engine": "n_dem, n_r have no time in common"
    }  # fmt: skip
    (note,) = apart.notes
    assert note == "n_r begins at 12 s: actuator, linkage not judged before it"
    assert isinstance(note, Note) and (note.kind, note.of, note.number) == ("cut", "n_r", 1200)


def test_a_controller_that_mostly_stood_aside_leaves_the_machine(machine_log: Log, chain: Chain) -> None:
    t = 0.01 * np.arange(2400)
    mostly = chain_of(with_(machine_log, state=np.where(t < 6.0, 1.0, 2.0)))
    assert told(mostly) == (NAMES, {}, [])
    aside = chain_of(with_(machine_log, state=np.where(t < 15.0, 1.0, 2.0)))
    assert told(aside) == (
        NAMES, {}, ["state: mode RUN in 43% of the log; engine, actuator and linkage are judged in all modes"]
    )  # fmt: skip
    for c, run, machine in ((mostly, 6.0, 6.0), (aside, 15.0, 0.0)):
        first = {s.name: float(s.t[np.isfinite(s.measured).any(axis=0)][0]) for s in c.stages}
        # 3 s after the start, or after a gap, all has settled; so has the firmware that long after it is in mode RUN
        assert first["engine"] == max(machine, 3.0) and first["actuator"] == machine + 3.0
        assert first["demand"] >= run + 3.0 == first["servo"] and first["linkage"] >= first["engine"]
    none: dict[str, Any] = dict.fromkeys(("x_lvdt", *VANES))  # what is left is quick
    absent = {"servo": "no x_lvdt", "actuator": "no x_lvdt", "linkage": "no x_lvdt"}
    few = chain_of(with_(machine_log, **none, state=np.where((t > 19.0) & (t < 23.2), 2.0, 1.0)))
    assert few.not_observed == absent | {"demand": "fewer than 300 samples in mode RUN without gaps"}
    never = chain_of(with_(machine_log, **none, state=np.ones(2400)))
    assert "fewer than 300 samples" in never.not_observed["demand"] and len(never.notes) == 1


def test_a_log_that_is_slow_says_what_its_raster_costs(machine_log: Log, chain: Chain) -> None:
    slow = chain_of(Log("a.csv", {k: Channel(c.t[::2], c.values[::2]) for k, c in machine_log.channels.items()}))
    why = "sample time of 0.02 s; the controller works every 0.01 s"
    assert slow.not_observed == {"demand": why, "servo": why} and [s.name for s in slow.stages] == NAMES[2:]
    assert list(slow.notes) == [
        "i_cmd: the current at single ticks, not the mean since the row before, which is worked out from it"
    ]
    for stage in slow.stages:
        error = stage.run(stage.neutral()[None])[0] - stage.measured
        assert stage.raster_error is not None and np.all(stage.raster_error > 0.0)
        assert np.all(rms(stage, error) < 1.6 * np.asarray(stage.floor)), stage.name
        assert np.all(np.asarray(stage.floor) >= stage.raster_error)
    engine, fast = slow.stage("engine"), chain.stage("engine")
    assert engine.run(engine.neutral()[None])[0] == pytest.approx(fast.run(fast.neutral()[None])[0][:, ::2], abs=0.05)


def test_samples_that_an_exporter_joined_cost_what_lies_between_them(machine_log: Log, chain: Chain) -> None:
    joined = chain_of(with_(machine_log, n_dem=replace(machine_log["n_dem"], apart=0.05)))
    for name in ("demand", "engine"):
        stage, whole = joined.stage(name), chain.stage(name)
        assert stage.raster_error is not None
        driven = driven_of(stage)
        half = driven.columns["n_dem"][np.minimum(np.arange(2400) + 2, 2399)]
        other = stage.made.make(driven._replace(columns=driven.columns | {"n_dem": half}, again=True))  # type: ignore[attr-defined]
        cost = rms(stage, stage.run(stage.neutral()[None])[0] - other.run(other.neutral()[None])[0])
        own = 0.0 if whole.raster_error is None else whole.raster_error
        assert np.all(stage.raster_error >= 0.99 * np.hypot(cost, own))
        assert stage.raster_error[0] < 1.5 * np.hypot(cost, own)[0] and stage.floor[0] > whole.floor[0]  # type: ignore[index]
    for name in ("servo", "actuator"):
        assert joined.stage(name).floor == pytest.approx(chain.stage(name).floor)


def test_a_stroke_whose_low_bits_are_lost_is_no_ground_for_a_name(machine_log: Log) -> None:
    coarse = chain_of(with_(machine_log, x_lvdt=np.round(machine_log["x_lvdt"].values / 0.0733) * 0.0733))
    assert coarse.steps == {"x_lvdt": pytest.approx(0.0733)}
    assert [s.name for s in coarse.stages if s.coarse] == ["servo", "actuator", "linkage"]
    assert {str(s.coarse["x_lvdt"]).split(",")[0] for s in coarse.stages if s.coarse} == {
        "x_lvdt comes in steps of 0.0733 mm"
    }
    source = VaneChainCandidates(coarse.stage("engine"), others=coarse.stages)
    assert [s.name for s in source.others] == ["demand", "engine"]


def test_what_begins_late_or_ends_early_is_told_with_its_channel(machine_log: Log) -> None:
    p_s, vigv = machine_log["p_s"], machine_log["vigv"]
    c = chain_of(
        with_(machine_log, p_s=Channel(p_s.t[500:], p_s.values[500:]), vigv=Channel(vigv.t[:1500], vigv.values[:1500]))
    )
    assert told(c) == (
        NAMES, {},
        ["vigv: measured from 0 to 14.99 s, judged there alone", "p_s begins at 5 s: actuator not judged before it"],
    )  # fmt: skip
    linkage = c.stage("linkage")
    assert [float(linkage.t[np.isfinite(m)][-1]) for m in linkage.measured] == pytest.approx([14.99, 23.99, 23.99])
    assert c.stage("actuator").t[0] == pytest.approx(5.0) and len(c.t) == 2400
    short = Channel(p_s.t[:1900], p_s.values[:1900])
    assert list(chain_of(with_(machine_log, n_dem=None, x_dem=None, p_s=short)).notes) == [
        "p_s ends at 18.99 s: actuator not judged after it"
    ]


def test_a_law_that_the_machine_has_needs_its_channel(machine_log: Log, chain: Chain) -> None:
    law = learned("valve.current", "adds", "vgv2", -90.0, 90.0, 0.2, 0.2, 0.2, 0.2)
    machine = Model(curves={"law": law}, effects={"law": {}}).plant(build_plant())
    with pytest.raises(LogError, match="^a.csv: has no vgv2, of which a learned law of the model is a function$"):
        chain_of(with_(machine_log, vgv2=None), plant=machine)
    stage, without = chain_of(machine_log, plant=machine).stage("actuator"), chain.stage("actuator")
    theta = without.neutral()
    theta[without.index()["valve_null_bias"]] = 0.2  # mA: as the law adds to the current
    by_law, by_bias = stage.run(stage.neutral()[None])[0, 0], without.run(theta[None])[0, 0]
    assert by_law == pytest.approx(by_bias, abs=1e-3)
    assert np.abs(by_law - without.run(without.neutral()[None])[0, 0]).max() > 0.01


# ---- commands in frames, other clocks


def test_a_command_in_frames_is_the_one_that_the_controller_had_in_its_tick() -> None:
    ticks, n = 0.01 * np.arange(1000), np.arange(1000.0)
    kept = np.ones(1000, dtype=bool)
    kept[300:306] = kept[500] = False  # six frames lack, and one
    frames = Channel(ticks[kept] + 0.004, 50.0 + 0.01 * n[kept], framed=True)
    log = log_of(
        n_dem=(ticks, 0.02 * n),
        n_r=(ticks + 0.004, 1.0 + 0.02 * n),
        x_dem=(ticks, 5.0 + 0.01 * n),
        x_lvdt=(ticks, 0.01 * n),
    )
    log = Log("a.csv", log.channels | {"n_dem": frames})
    grid = grid_of(log)
    rows, columns, gaps, _ = on_raster(log, grid)
    at = np.rint((rows + grid.start) / 0.01).astype(int)  # in tick k the controller has the frame of k - 1
    last = np.maximum.accumulate(np.where(kept, n, -1.0))
    assert columns["n_dem"] == pytest.approx(50.0 + 0.01 * last[np.maximum(at - 1, 0)])
    assert columns["x_lvdt"] == pytest.approx(0.01 * at, abs=1e-9)
    lost = np.flatnonzero(gaps.lost["n_dem"])
    assert set(at[lost].tolist()) == {*range(301, 307), 501}
    assert at[np.flatnonzero(gaps.far["n_dem"])].tolist() == [303, 304, 305, 306]  # two frames are bridged
    assert at[np.flatnonzero(~gaps.fresh(["n_dem"])[0])].tolist() == list(range(301, 307))
    whole = on_raster(Log("a.csv", log.channels | {"n_dem": Channel(ticks + 0.004, 0.02 * n, framed=True)}), grid)[2]
    assert "n_dem" not in whole.far and "n_dem" not in whole.lost


def test_a_log_faster_than_the_frames_begins_with_one() -> None:
    """Every 2 ms a sample; commands change with the frame, 6 ms behind the log's first sample."""
    t = 7.0 + 0.002 * np.arange(5001)
    frame = np.floor((t - 7.006) / 0.01 + 1e-6)
    i = white(2, 5001)
    log = log_of(
        t, x_dem=20.0 + np.sin(0.1 * frame), n_dem=60.0 + np.cos(0.1 * frame), n_r=t, x_lvdt=np.sin(t), i_cmd=i
    )
    grid = grid_of(log)
    assert grid.start == pytest.approx(7.006) and grid.dt == 0.01 and grid.rows == 1000
    rows, columns, gaps, _ = on_raster(log, grid)
    assert columns["x_dem"] == pytest.approx(20.0 + np.sin(0.1 * np.arange(1000.0)))
    assert (
        columns["n_r"] == pytest.approx(7.006 + rows)
        and not gaps.far
        and columns["x_lvdt"] == pytest.approx(np.sin(7.006 + rows))
    )
    wanted = i[4:][: 5 * 999].reshape(-1, 5).mean(axis=1)  # the mean of the five samples up to each row
    assert columns["i_cmd"][1:] == pytest.approx(wanted)
    still = grid_of(log_of(t, x_dem=np.where(t < 10.0, 20.0, 21.0), n_dem=0.0 * t, n_r=t, x_lvdt=t))
    assert still.start == 7.0  # one change tells no phase
    moves = grid_of(log_of(t, x_dem=t, n_dem=t, n_r=t, x_lvdt=t))
    assert moves.start == 7.0  # what changes with every sample came in no frames


@pytest.mark.parametrize("begins", range(5))
def test_what_comes_in_frames_behind_a_low_pass_is_read_where_it_has_settled(begins: int) -> None:
    """Every 2 ms a sample of a speed that is sent every 10 ms, each with its noise, behind a lag of 1.5 ms."""
    t = 0.002 * np.arange(15_000)
    sent = (np.arange(len(t)) - begins) // 5
    noise = white(4, 3001)
    held = 60.0 + 0.001 * sent + noise[sent + 1]
    lagged = scipy.signal.lfilter([1.0 - np.exp(-2.0 / 1.5)], [1.0, -np.exp(-2.0 / 1.5)], held - 60.0) + 60.0
    log = log_of(t, n_dem=60.0 + 0.0 * t, n_r=lagged, x_lvdt=white(6, len(t)))
    rows, columns, _, _ = on_raster(log, grid_of(log))
    there = sent[np.rint((rows + log.channels["n_r"].t[0]) / 0.002).astype(int)]
    e = columns["n_r"] - (60.0 + 0.001 * there + noise[there + 1])
    assert np.std(e[10:-10]) < 0.05
    same = columns["x_lvdt"]  # no frames: each row its own sample
    assert np.array_equal(same, log.channels["x_lvdt"].values[::5][: len(same)])


def test_the_last_digit_is_that_of_the_file_whatever_is_worked_out_of_it() -> None:
    t = 0.01 * np.arange(3000)
    x = np.round(50.0 + 20.0 * np.sin(t), 2)
    log = log_of(t, n_dem=x, n_r=x, x_dem=x, x_lvdt=np.sin(t))
    assert grid_of(log).digits == pytest.approx({"n_dem": 0.01, "x_dem": 0.01, "n_r": 0.01, "x_lvdt": 0.0})
    kept = np.ones(3000, dtype=bool)
    kept[np.random.default_rng(1).integers(0, 3000, 400)] = False  # rows between those left are no multiples
    lost = log_of(t[kept], n_dem=x[kept], n_r=x[kept], x_dem=x[kept])
    assert grid_of(lost).digits["x_dem"] == pytest.approx(0.01)


def test_samples_of_another_clock_are_joined_and_a_jitter_is_not() -> None:
    t = 0.01 * np.arange(2000)
    jitter = t + 2e-4 * white(1, 2000).clip(-3.0, 3.0)
    slope = log_of(x_lvdt=(t, t), vigv=(jitter, 0.01 * np.arange(2000.0)), vgv1=(t + 0.004, t + 0.004))
    columns = on_raster(slope, grid_of(slope)._replace(start=0.0, rows=1999))[1]
    assert columns["vigv"] == pytest.approx(0.01 * np.arange(1999.0))  # each row its own sample
    assert columns["vgv1"][1:] == pytest.approx(t[1:1999])  # between two of them by a line


# ---- laws that remember, and the next run


def test_a_hysteresis_slips_by_the_whole_course_of_what_moves_it(chain: Chain) -> None:
    driven = driven_of(chain.stage("linkage"))
    law = curve_effect("law", learned("linkage.ring", "adds", "stops_of_x_lvdt", 0.0, 10.0, 0.0, 0.4, 0.6, 0.7))
    stage = remade(chain.stage("linkage"), (), [law])
    thetas = np.array([stage.neutral()] * 3)
    thetas[1:, -1] = 1.0, 2.0
    with_laws_of = driven_of(stage)
    p = lanes(with_laws_of, thetas, np.zeros(0, dtype=int), np.zeros(0))
    signals = with_laws_of.signals()
    given = with_laws_of.slipping(signals, p)
    assert len(given) == KNOWN + 3 and not given[KNOWN].any()
    assert np.array_equal(given[:KNOWN], signals[:KNOWN], equal_nan=True)
    assert given[KNOWN + 2] == pytest.approx(2.0 * given[KNOWN + 1])
    # on the way up it is the virgin curve; a way back and forth takes power
    x, h = driven.columns["stroke"], given[KNOWN + 1]
    assert np.sum(0.5 * (h[1:] + h[:-1]) * np.diff(x)) > 0.0 and np.corrcoef(x, h)[0, 1] > 0.5
    at = np.r_[600:1100, 1500:2000]
    part = with_laws_of.at(at, {k: v[at] for k, v in driven.columns.items()}, driven.run[at])
    assert part.slipping(part.signals(), p)[KNOWN:] == pytest.approx(given[KNOWN:, at])
    assert driven.slipping(signals, driven.machine.p) is signals
    more = curve_effect("more", learned("linkage.ring", "adds", "stops_of_x_lvdt", 0.0, 10.0, 0.0, 0.8, 1.2, 1.4))
    both = remade(chain.stage("linkage"), (), [law, more])
    sets = np.array([both.neutral()] * 2)
    sets[1, -2:] = 1.0, 1.0
    driven_by_both = driven_of(both)
    p = lanes(driven_by_both, sets, np.zeros(0, dtype=int), np.zeros(0))
    of_both = driven_by_both.slipping(driven_by_both.signals(), p)
    assert len(of_both) == KNOWN + 4 and not of_both[KNOWN : KNOWN + 2].any()
    assert of_both[KNOWN + 2] == pytest.approx(given[KNOWN + 1]) and of_both[KNOWN + 3] == pytest.approx(
        2.0 * of_both[KNOWN + 2]
    )
    still, one, two = stage.run(thetas)[:, 0]
    assert np.abs(two - one - (one - still)).max() < 0.2 * np.abs(one - still).max() and np.ptp(one - still) > 0.1


def test_a_simulated_run_tells_the_law_that_it_has_from_its_rival() -> None:
    t = 0.01 * np.arange(900)
    profile = 75.0 + 12.0 * np.sin(0.5 * t) + 3.0 * np.sign(np.sin(2.0 * t))
    truth = {"valve_lag": {"time_constant": 0.08}}
    nats, spreads = experiment.divergence(profile, truth, "actuator", "valve_null_bias", "valve_lag")
    assert nats > 100.0 and spreads > 1.0
    wrong = experiment.divergence(profile, truth, "actuator", "valve_lag", "valve_null_bias")
    assert wrong[0] < -100.0 and wrong[1] == 0.0
    assert experiment.divergence(profile, truth, "nothing", "valve_lag", "lvdt_lag") == (0.0, 0.0)


def test_a_gap_of_one_vane_is_none_of_the_others(machine_log: Log, chain: Chain) -> None:
    v = machine_log["vigv"]
    kept = np.ones(2400, dtype=bool)
    kept[1500:1520] = False
    stage = chain_of(with_(machine_log, vigv=Channel(v.t[kept], v.values[kept]))).stage("linkage")
    lost = np.isfinite(chain.stage("linkage").measured) & ~np.isfinite(stage.measured)
    assert np.flatnonzero(lost[0]).tolist() == list(range(1500, 1520)) and not lost[1:].any()


def test_of_channels_that_end_in_one_row_the_first_is_named(machine_log: Log) -> None:
    p_s, t_oil = machine_log["p_s"], machine_log["t_oil"]
    ends = with_(
        machine_log, n_dem=None, x_dem=None, p_s=Channel(p_s.t[:1900], p_s.values[:1900]),
        t_oil=Channel(t_oil.t[:1900] + 0.004, t_oil.values[:1900]),
    )  # fmt: skip
    assert list(chain_of(ends).notes) == [
        "p_s ends at 18.99 s: actuator not judged after it", "t_oil ends at 18.994 s: linkage not judged after it"
    ]  # fmt: skip
    begins = with_(
        machine_log, n_dem=None, x_dem=None, p_s=Channel(p_s.t[500:], p_s.values[500:]),
        t_oil=Channel(t_oil.t[500:] - 0.004, t_oil.values[500:]),
    )  # fmt: skip
    assert "p_s begins at 5 s: actuator not judged before it" in chain_of(begins).notes


def test_a_vane_that_begins_late_leaves_the_others_as_they_are(machine_log: Log, chain: Chain) -> None:
    v = machine_log["vigv"]
    late = chain_of(with_(machine_log, n_dem=None, x_dem=None, vigv=Channel(v.t[800:], v.values[800:])))
    stage = late.stage("linkage")
    seen, before = (np.isfinite(s.measured).sum(axis=1).tolist() for s in (stage, chain.stage("linkage")))
    assert seen == [1600, *before[1:]]
    assert stage.run(stage.neutral()[None])[0, 1:] == pytest.approx(
        chain.stage("linkage").run(chain.stage("linkage").neutral()[None])[0, 1:]
    )
    source = VaneChainCandidates(late.stage("actuator"), others=[stage])
    law = curve_effect("law", learned("sensors.lvdt", "adds", "x_lvdt", 2.0, 40.0, -2.0, 1.0, -1.0, 2.0))
    assert source.elsewhere([law], source.stage((), [law]).neutral()) == {}


def test_a_curve_in_the_servo_changes_its_current_by_its_value(chain: Chain) -> None:
    stage = chain.stage("servo")
    for how, of in (("adds", "x_dem"), ("times", "n_r")):
        law = curve_effect("law", learned("servo.current", how, of, 0.0, 100.0, 0.1, 0.1, 0.1, 0.1))
        with_it = remade(stage, ("controller_gain_error",), [law])
        thetas = np.array([with_it.neutral()] * 3)
        thetas[1, -1], thetas[2, with_it.index()["controller_gain_error"]] = 3.0, 2.0
        still, by, twice = with_it.run(thetas)[:, 0]
        assert by == pytest.approx(still + 0.3 if how == "adds" else 1.3 * still)
        assert twice == pytest.approx(2.0 * still)
    # of the current that the law itself gives, which has no noise: a hundredth of it
    line = curve_effect("law", learned("servo.current", "adds", "i_cmd", -60.0, 60.0, -0.6, -0.2, 0.2, 0.6))
    with_it = remade(stage, (), [line])
    thetas = np.array([with_it.neutral()] * 2)
    thetas[1, -1] = 5.0
    still, by = with_it.run(thetas)[:, 0]
    assert by == pytest.approx(1.05 * still, abs=1e-3) and np.abs(still).max() < 60.0
    law = curve_effect("law", learned("controller.demand", "adds", "n_r", 0.0, 100.0, 0.1, 0.1, 0.1, 0.1))
    demand = remade(chain.stage("demand"), (), [law])
    thetas = np.array([demand.neutral()] * 2)
    thetas[1, -1] = 4.0
    still, by = demand.run(thetas)[:, 0]
    assert by[500:] == pytest.approx(still[500:] + 0.4, abs=0.05)  # mm, but for the rate limit


def test_a_machine_s_own_value_of_a_parameter_is_where_its_fit_begins() -> None:
    plain = build_plant()
    nominal = {n.name: n for n in plain.nominal}
    names = ("actuator.flow_gain", "linkage.vigv_play", "engine.lag", "sensors.vgv1_bias")
    changed = Model(parameters={n: nominal[n].value + 0.4 * nominal[n].tolerance for n in names}).plant(plain)
    none = np.zeros(0)
    for machine, more in ((plain, 0.0), (changed, 0.4)):
        driven = Driven(none, {}, machine, CALIBRATION, (), none, ())
        found = {p.name: p for s in ("engine", "actuator", "linkage") for p in declared(s, driven)[0]}
        for name in names:
            n, p = nominal[name], found[name]
            assert p.middle == n.value and p.value == pytest.approx(n.value + more * n.tolerance, rel=1e-9), name
        if not more:
            assert all(p.value == nominal[name].value for name, p in found.items())  # to the last bit


def test_rivals_are_judged_with_the_other_effects_of_their_subsystem(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def divergence(profile: Array, truth: Any, stage: str, rival: str, named: str, beside: Any, **machine: Any) -> Any:
        seen.append((stage, rival, named, beside, machine))
        return 1.0, 1.0

    monkeypatch.setattr(experiment, "divergence", divergence)
    monkeypatch.setattr(experiment, "profiles", lambda: {"one": np.zeros(10)})
    lag, bias = (
        SimpleNamespace(effect=e, rivals=r, parameters={"time_constant": {"value": v}, "of_no_effect": {"value": 1.0}})
        for e, r, v in (("valve_lag", ["lvdt_lag", "lvdt_bias", "a", "b"], 0.1), ("lvdt_bias", [], 2.0))
    )
    d = SimpleNamespace(stages=[SimpleNamespace(stage="actuator", effects=[lag, bias])])
    of = SimpleNamespace(plant="plant", built="tables")
    assert experiment.recommend(d, None, of) is not None
    machine = {"plant": "plant", "calibration": "tables"}
    assert seen == [
        ("actuator", "lvdt_lag", "valve_lag", ("lvdt_bias",), machine),
        ("actuator", "lvdt_bias", "valve_lag", (), machine),
        ("actuator", "a", "valve_lag", ("lvdt_bias",), machine),
    ]  # fmt: skip
    monkeypatch.setattr(experiment, "divergence", lambda *_, **__: (1000.0, 10.0))
    once = experiment.recommend(d, None, of)
    assert once is not None and once["separates"] and once["repeats"] == 1 and "times over" not in once["text"]


def test_a_current_of_single_ticks_is_made_the_mean_of_its_ticks(machine_log: Log, chain: Chain) -> None:
    own = driven_of(chain.stage("servo")).columns
    sampled = chain_of(with_(machine_log, i_cmd=own["ticks"][:, -1]))
    assert list(sampled.notes) == [
        "i_cmd: the current at single ticks, not the mean of those since the row before, which is worked out from "
        "stroke and demand"
    ]
    c = driven_of(sampled.stage("servo")).columns
    run = slice(400, None)
    off = (c["i_cmd"] - own["i_cmd"])[run]
    assert np.std(off) < 0.5 * np.std((own["ticks"][:, -1] - own["i_cmd"])[run])
    assert np.array_equal(sampled.columns["i_cmd"], c["i_cmd"])
    # the tick at the row has the logged stroke, with its noise: what is not known of it changes slowly
    quick, quick_of_mean = (np.std(np.diff(of["law_error"], axis=0)) for of in (c, own))
    assert quick < 0.5 * quick_of_mean
    unknown = (c["other_ticks"].mean(axis=1) - c["i_cmd"])[run]
    as_was = (own["other_ticks"].mean(axis=1) - own["i_cmd"])[run]
    assert np.std(as_was) < 1e-9 < np.std(unknown)


def test_of_vanes_that_all_end_early_the_first_is_named(machine_log: Log) -> None:
    cut = {v: Channel(machine_log[v].t[:1500], machine_log[v].values[:1500]) for v in ("vigv", "vgv1", "vgv2")}
    ended = chain_of(with_(machine_log, n_dem=None, x_dem=None, **cut))
    assert list(ended.notes) == ["vigv ends at 14.99 s: linkage not judged after it"]
    assert len(ended.stage("linkage").t) == 1500 and len(ended.stage("actuator").t) == 2400


def test_signals_of_a_machine_s_own_law_are_behind_its_lag(chain: Chain) -> None:
    law = learned("linkage.ring", "adds", "x_lvdt_lagged_by_300_ms", 2.0, 40.0, 0.0, 0.1, 0.2, 0.3)
    machine = Model(curves={"law": law}, effects={"law": {}}).plant(build_plant())
    driven = driven_of(chain.stage("linkage"))
    signals = driven._replace(machine=machine).signals()
    late = driven.quantity("x_lvdt_lagged_by_300_ms")
    assert late is not None and len(signals) == KNOWN + 1 and signals[-1] == pytest.approx(1e-3 * late)


def test_a_controller_of_the_user_s_own_has_no_servo_that_is_known(
    machine_log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(n_dem: Array, n_r: Array, *rest: Any) -> None:
        rest[-1][:] = 1e-3 * np.interp(n_r, [50.0, 100.0], [0.0, 40.0])

    monkeypatch.setattr(demand, "_run", run)
    own = CALIBRATION._replace(program=SimpleNamespace(start=lambda flashed: ()))
    without = with_(machine_log, vigv=None, vgv1=None, vgv2=None)
    c = chain_of(without, calibration=own)
    assert [s.name for s in c.stages] == ["demand", "engine", "actuator"]
    said = "a controller of your own gives its current for its own demand, not for the logged one"
    assert c.not_observed["servo"] == said
    assert "ticks" not in driven_of(c.stage("actuator")).columns


def test_speed_is_that_of_a_fifth_of_a_second_and_a_turn_begins_anew() -> None:
    gaps: Any = SimpleNamespace(far={"p_s"}, fresh=lambda names: np.arange(400)[None] < 300)
    for dt, k in ((0.01, 10), (0.05, 3)):
        t = dt * np.arange(400)
        turn = t[200]
        columns = {"x_lvdt": 5.0 * np.abs(t - turn), "n_r": 60.0 + t, "p_s": 20.0 + t, "i_cmd": t, "vigv": t}
        got, units = resample.regimes_of(t, columns, gaps)
        v = got["stroke speed"]
        assert abs(v[200]) < 2.5 and abs(v[200 + k // 2]) < 4.0 < v[203 + k]
        assert v[230:380] == pytest.approx(5.0, rel=0.05) and v[20:180] == pytest.approx(-5.0, rel=0.05)
        assert got["direction"][[100, 300]].tolist() == [-1.0, 1.0] and got["time"] is t
        way = got["distance since reversal"]
        assert way[150] == pytest.approx(5.0 * t[150], rel=0.05)
        assert way[300] == pytest.approx(5.0 * (t[300] - turn), rel=0.1)
        assert np.isnan(got["supply pressure"][300:]).all() and not np.isnan(got["supply pressure"][:300]).any()
        assert units == {
            "time": "s", "stroke": "mm", "stroke speed": "mm/s", "direction": "", "distance since reversal": "mm",
            "rotor speed": "%", "supply pressure": "MPa", "current": "mA",
        }  # fmt: skip
    slow, _ = resample.regimes_of(t, {"x_lvdt": 20.0 + 0.19 * t}, gaps)
    assert not slow["direction"].any() and set(slow) == {
        "time", "stroke", "stroke speed", "direction", "distance since reversal",
    }  # fmt: skip
    known, _ = resample.regimes_of(t, {"x_lvdt": t}, SimpleNamespace(far={"x_lvdt"}, fresh=gaps.fresh))  # type: ignore[arg-type]
    assert all(np.isnan(known[n][300:]).all() for n in known if n != "time") and not np.isnan(known["time"]).any()


# ---- a recorder's hum and its low-pass -------------------------------------------------------------------------------


def test_third_differences_are_where_four_rows_follow_each_other() -> None:
    t = np.r_[np.arange(8) * 0.1, 1.0 + np.arange(5) * 0.1]  # two rows are missing
    z, good = hum._third(Channel(t, t**3), 0.1)
    assert good.tolist() == [True] * 5 + [False] * 3 + [True] * 2
    assert z == pytest.approx(np.where(good, 6e-3, 0.0))


def test_power_is_told_in_medians_of_what_is_nearby_by_the_largest_of_three_lines() -> None:
    z = np.random.default_rng(1).standard_normal(4000)
    z += 0.5 * np.sin(2.0 * np.pi * 300.0 * np.arange(4000) / 4000.0)
    power = np.abs(np.fft.rfft(z)) ** 2
    widest = np.array([power[max(k - 1, 0) : k + 2].max() for k in range(len(power))])
    half = hum.HUM_NEARBY // 2
    padded = np.pad(widest, half, mode="edge")
    nearby = np.array([np.median(padded[k : k + hum.HUM_NEARBY]) for k in range(len(widest))])
    np.testing.assert_allclose(hum._power(z), widest / nearby)
    assert set(np.flatnonzero(hum._power(z) > 100.0)) == {299, 300, 301} and not hum._power(np.zeros(100)).any()


def hummed(names: tuple[str, ...], hz: float = 13.37, rows: int = 4000, also: str = "") -> dict[str, Channel]:
    """Noise in each channel at 100 Hz, and a line of twice its size in those named."""
    t = 5.0 + 0.01 * np.arange(rows)
    out = {}
    for k, name in enumerate(("n_r", "x_lvdt", "i_cmd", "vigv", "n_dem")):
        line = 2.0 * np.sin(2.0 * np.pi * hz * t + k) if name in names or name == also else 0.0
        quiet = (
            np.repeat([60.0, 61.0], rows // 2) if name == "n_dem" else np.random.default_rng(k).standard_normal(rows)
        )
        out[name] = Channel(t, quiet + line)
    return out


ANALOGUE = ("n_r", "x_lvdt", "i_cmd", "vigv")


def test_a_common_line_is_in_every_channel_and_in_no_command() -> None:
    made = hummed(ANALOGUE)
    channels, commands = [made[n] for n in ANALOGUE], [made["n_dem"]]
    found = hum._common_line(channels, commands, 0.01)
    assert found is not None and abs(found - 13.37) <= 1.0 / 40.0
    assert hum._common_line([*channels[:3], hummed(())["vigv"]], commands, 0.01) is None
    assert hum._common_line(channels, [hummed((), also="n_dem")["n_dem"]], 0.01) is None
    assert hum._common_line([hummed(())[n] for n in ANALOGUE], commands, 0.01) is None
    slow = hummed(ANALOGUE, hz=0.05)  # two periods in the log are no line
    assert hum._common_line([slow[n] for n in ANALOGUE], commands, 0.01) is None
    line = hum._line(made["vigv"], found, 0.01)
    t = made["vigv"].t
    np.testing.assert_allclose(line, 2.0 * np.sin(2.0 * np.pi * 13.37 * t + 3.0), atol=0.2)
    assert np.std(line) * 2.0**0.5 == pytest.approx(2.0, rel=0.05)


def test_hum_is_taken_out_with_a_note_of_its_sizes_where_speed_and_two_others_have_it() -> None:
    made = hummed(ANALOGUE)
    log = Log("a.csv", made, ["before"])
    out = hum.without_hum(log)
    first, said = out.notes
    assert (
        first == "before"
        and isinstance(said, Note)
        and (said.kind, said.of) == ("converted", "n_r, x_lvdt, i_cmd, vigv")
    )
    sizes = re.fullmatch(
        r"n_r, x_lvdt, i_cmd, vigv: a line at (13\.3\d) Hz in all of them is a recorder's hum, or its alias \("
        r"n_r (\S+) %, x_lvdt (\S+) mm, i_cmd (\S+) mA, vigv (\S+) deg\); taken out", said,
    )  # fmt: skip
    assert sizes is not None and all(abs(float(s) - 2.0) < 0.2 for s in sizes.groups()[1:])
    for k, name in enumerate(ANALOGUE):
        assert np.std(out[name].values - np.random.default_rng(k).standard_normal(4000)) < 0.1
    assert out["n_dem"] is log["n_dem"] and out.path == "a.csv"
    for less in (
        {n: c for n, c in made.items() if n != "n_r"}, {n: c for n, c in made.items() if n in ("n_r", "vigv", "n_dem")},
        {n: c for n, c in made.items() if n != "n_dem"},
        {n: Channel(c.t[:1000], c.values[:1000]) for n, c in made.items()},
        {n: Channel(c.t, c.values, framed=n != "n_dem") for n, c in made.items()},
    ):  # fmt: skip
        other = Log("a.csv", less)
        assert hum.without_hum(other) is other
    framed = Log("a.csv", {**made, "x_lvdt": Channel(made["x_lvdt"].t, made["x_lvdt"].values, framed=True)})
    assert hum.without_hum(framed)["x_lvdt"] is framed["x_lvdt"] and len(hum.without_hum(framed).notes) == 1


@pytest.mark.parametrize(("kind", "second"), [("mean", 1.0 / 3.0), ("first order", 0.0), ("second order", 0.5)])
def test_a_low_pass_delays_and_is_undone(kind: str, second: float) -> None:
    """Of a parabola y = t^2 a filter 1 / (1 + d s + c d^2 s^2) leaves (t - d)^2 + d^2 (1 - 2 c), once it has begun."""
    d, tick = 0.02, 1e-3
    t = np.arange(2000) * tick
    low = LowPass(kind, d)
    late = LowPass(kind, d, late=0.0125).of(t[None], tick)[0]
    behind = t[400:] - d + (0.5 * tick if kind == "mean" else 0.0)  # a mean of whole ticks lies half a tick beside
    np.testing.assert_allclose(low.of(t[None], tick)[0][400:], behind, atol=1e-4)
    np.testing.assert_allclose(late[400:], behind - 0.0125, atol=1e-4)
    assert low.of(np.full((4, 5), 3.0), tick) == pytest.approx(np.full((4, 5), 3.0))  # begins as if it had stood so
    bent = low.of((t**2)[None], tick)[0][400:]
    np.testing.assert_allclose(bent, behind**2 + d * d * (1.0 - 2.0 * second), atol=1e-4)
    dt = 0.01
    rows = np.sin(np.arange(400) * dt * 3.0)
    left = low.of_rows(low.before(rows, dt), dt)
    assert np.abs(left - rows)[60:-60].max() < 0.01 < np.abs(low.of_rows(rows, dt) - rows)[60:-60].max()
    held = LowPass(kind, d, held=True).of_rows(rows, dt)
    straight = low.of_rows(rows, dt)
    np.testing.assert_allclose(held[60:-60], np.sin((np.arange(400) * dt - d - 0.5 * dt) * 3.0)[60:-60], atol=0.01)
    np.testing.assert_allclose(straight[60:-60], np.sin((np.arange(400) * dt - d) * 3.0)[60:-60], atol=0.01)
    assert LowPass(late=-0.02).of_rows(rows, dt)[100:-100] == pytest.approx(
        np.sin((np.arange(400) * dt + 0.02) * 3.0)[100:-100], abs=0.01
    )
