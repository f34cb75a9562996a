"""The vane chain's stages from a log: its raster, its rows, its clocks, the current between rows, and what is declared
to the search, each against a closed form or a simulated machine.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller import load_calibration
from hil.logs import Channel, Log, LogError
from hil.loop.lockstep import Stimulus, lockstep
from plant import build_plant
from plant.curve import PLACES
from plant.effects import EFFECTS
from vaneloop.base.vanes import VANES
from vaneloop.identification.subsystem import Array, Parameter, Stage
from vaneloop.identification.unmodelled.regressors import Quantity
from vaneloop.identification.user_models.terms import COLUMN
from vaneloop.identification.vane_chain import experiment
from vaneloop.identification.vane_chain.actuator import _quadratic_drag
from vaneloop.identification.vane_chain.alignment import Late, _explains, _shifted, aligned, driving, late_vanes
from vaneloop.identification.vane_chain.candidates import (
    VaneChainCandidates,
    _says_more,
    remade,
    reversals,
    room_for,
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
    _above_noise,
    _calibrated,
    _smoothed,
    _weights,
    between_rows,
    law_of,
    other_current,
    samples_of,
)
from vaneloop.identification.vane_chain.demand import _direction_known
from vaneloop.identification.vane_chain.linkage import _cross_talk, _crossed, _late_recorder
from vaneloop.identification.vane_chain.parameters import FREE, _starts, declared, like_temperature, like_time
from vaneloop.identification.vane_chain.resample import (
    Gaps,
    Grid,
    every_other,
    grid_of,
    lately,
    no_gap_in_window,
    on_raster,
    pieces_of,
    regimes_of,
    rms,
    since,
    stretches,
)

CALIBRATION = load_calibration()
LATE, TICK = 0.04, 1e-3  # s
NATS, RIVAL_SPREADS = 12.0, 0.3  # docs/settings.md


def white(seed: int, *shape: int) -> Array:
    return np.random.default_rng(seed).standard_normal(shape)


def log_of(t: Array | None = None, **channels: Any) -> Log:
    """A log of channels, each its values on ``t``, or (times, values)."""
    made = {}
    for name, v in channels.items():
        times, values = v if isinstance(v, tuple) else (t, v)
        made[name] = Channel(np.asarray(times, dtype=float), np.asarray(values, dtype=float))
    return Log("a.csv", made)


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
    log = log_of(7.0 + t, vigv=t, n_r=t)
    moved = aligned(log, [late, Late(("n_r",), 0.5)], 7.0)
    assert moved["vigv"].t == pytest.approx(7.0 + late.times(t)) and moved["n_r"].t is log["n_r"].t
    here = {"vigv": t, "n_r": 3.0 * t}
    moved_here = driving(t, here, [late, Late(("n_r",), 0.5)])
    assert moved_here["n_r"][:-1] == pytest.approx(3.0 * (t + 0.5)[:-1])
    assert moved_here["vigv"] is here["vigv"] and set(moved_here) == set(here)
    assert _shifted(t, 2.0 * t, 3.0)[:5] == pytest.approx(2.0 * (t[:5] + 3.0))


@pytest.mark.parametrize(
    ("before", "after", "explains"),
    [
        ([5.0, 3.0], [2.9, 2.0], True), ([5.0, 3.0], [3.1, 2.0], False), ([5.0, 3.0], [1.0, 3.1], False),
        ([5.0, 0.5], [1.0, 0.5], True), ([5.0], [3.0], True), ([1.0], [1.0], True),
    ],
)  # fmt: skip
def test_a_clock_explains_what_gets_better_everywhere_and_by_half(
    before: list[float], after: list[float], explains: bool
) -> None:
    assert _explains(np.array(before), np.array(after)) == explains


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
    c = {"i_cmd": logged + 0.2}
    assert other_current(t, c, law, np.ones(600, dtype=bool), CALIBRATION, samples) == what
    assert c["i_cmd"] == pytest.approx(mean + 0.2, abs=0.3)


def test_the_current_of_every_tick_has_the_logged_mean() -> None:
    law = np.cumsum(white(5, 300, 10).ravel()).reshape(300, 10) * 0.1
    limit = 0.9e3 * CALIBRATION.scalars.current_limit
    c = {"i_cmd": law.mean(axis=1) + 4.0}
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
    unknown = np.full(300, 2.0)
    assert between_rows(c, law, 0.0, run, CALIBRATION, unknown, 0).mean(axis=1) == pytest.approx(c["i_cmd"])
    assert between_rows(c, law, 0.0, run, CALIBRATION, unknown, 1).mean(axis=1) == pytest.approx(c["i_cmd"] + 2.0)


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
    assert _quadratic_drag(sharp) == "" and _quadratic_drag(round_end).startswith("a drag that grows")
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
    bank = experiment.profiles()
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
        assert {p.name for p in s.parameters} <= set(FREE[s.name])
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
