"""Clocks, zeros and low-passes of a recorder, each told on a small subsystem whose answer is a closed form."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy

from controller import load_calibration
from hil.figures import noise_floor
from hil.logs import Channel, Log
from plant import build_plant
from tests.small_logs import white
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.subsystem import Array, Effect, Parameter, Stage
from vaneloop.identification.vane_chain import alignment
from vaneloop.identification.vane_chain.alignment import (
    Late,
    _both_behind,
    _both_passed,
    _chance,
    _fit,
    _lvdt_lag,
    _moving,
    _servo,
    _significant,
    aligned,
    demand_of,
    driving,
    fits,
    late_in_controller,
    late_vanes,
    on_rows,
    passed_by,
    vanes_late,
    zeros_in_controller,
)
from vaneloop.identification.vane_chain.current import law_of
from vaneloop.identification.vane_chain.low_pass import AS_LOGGED, LOW_PASSES, LowPass, lagged
from vaneloop.identification.vane_chain.resample import OF_SUBSYSTEM, Grid
from vaneloop.identification.vane_chain.servo import servo_stage
from vaneloop.identification.vane_chain.subsystem_data import VANES_LATE, Driven, Made
from vaneloop.identification.vane_chain.swapped import swapped

CALIBRATION, MACHINE = load_calibration(), build_plant()
DT, ROWS = 0.01, 2000
T = DT * np.arange(ROWS)
NOISE = 1e-3
BEGIN = 3.0  # s, first row of the subsystems
INNER = (np.arange(ROWS) >= 300) & (np.arange(ROWS) < ROWS - 100)  # all has settled, and clocks move nothing beyond
SPEED = 75.0 + 10.0 * np.sin(0.6 * T) + 2.0 * np.sin(2.1 * T + 0.4)  # %
Run = Callable[[Driven, Array], Array]


def subsystem(
    name: str,
    run: Run,
    columns: dict[str, Array],
    outputs: tuple[str, ...],
    parameters: tuple[Parameter, ...] = (),
    effects: tuple[Effect, ...] = (),
    window: float | None = None,
    machine: Any = MACHINE,
    floor: float = NOISE,
) -> Stage:
    """A subsystem that a function of its columns and one parameter set gives, float64[outputs, samples], and that is
    made anew from others.
    """

    def make(driven: Driven) -> Stage:
        def simulate(thetas: Array) -> Array:
            one = [driven.passed.of_rows(run(driven, theta), DT) for theta in thetas]
            return np.array(one)

        stage = Stage(name, outputs, ("mm",) * len(outputs), parameters, effects, simulate, driven.t,
                      driven.measured(driven.run), window=window)  # fmt: skip
        stage.made = Made(make, driven)
        return stage

    n = len(next(iter(columns.values())))
    stage = make(Driven(BEGIN + DT * np.arange(n), columns, machine, CALIBRATION, outputs, INNER, ()))
    stage.floor = np.full(len(outputs), 1.02 * floor)
    return stage


# ---- what is said and done of a channel that stands late -------------------------------------------------------------


def test_a_zero_and_a_low_pass_are_said_in_the_channel_s_unit() -> None:
    assert Late(("x_lvdt",), 0.0, zero=0.0213).text() == (
        "x_lvdt: reads 0.0213 mm higher in the file than in the controller; subtracted"
    )
    assert Late(("n_r",), 0.0, zero=-0.5).text().startswith("n_r: reads 0.5 % lower in the file")
    passed = LowPass("mean", 0.005)
    assert Late(("x_lvdt", "vigv"), 0.0, passed=passed).text() == (
        "x_lvdt, vigv: have passed a mean over 10 ms; the model's have, too"
    )
    assert Late(("n_dem",), 0.004, passed=passed).text() == (
        "n_dem: stand 4 ms late in the file, because the analogue channels have passed a mean over 10 ms; moved"
    )
    assert Late(("n_dem",), -0.004, passed=passed).besides == pytest.approx(0.001)  # 5 ms of it the mean makes


def test_a_zero_is_taken_off_its_channel_and_of_no_other() -> None:
    log = Log("a.csv", {n: Channel(T, STROKE) for n in ("n_r", "x_lvdt", "vigv")})
    grid = Grid(0.0, DT, ROWS, {})
    out = aligned(log, [Late(("x_lvdt",), 0.0, zero=0.25), Late(("n_r", "i_cmd"), 0.0, zero=-0.5)], grid)
    assert out["x_lvdt"].values == pytest.approx(STROKE - 0.25) and out["x_lvdt"].t is log["x_lvdt"].t
    assert out["n_r"].values == pytest.approx(STROKE + 0.5) and out["vigv"] is log["vigv"]
    assert set(out.channels) == set(log.channels)
    passed = Late(("x_lvdt", "vigv"), 0.0, passed=LowPass("mean", 0.02))  # nothing stands elsewhere by it
    assert aligned(log, [passed], grid) is log and aligned(log, [], grid) is log
    drifts = aligned(log, [Late(("x_lvdt",), 0.0, 1e-3, 10.0)], grid)
    assert drifts["x_lvdt"].t == pytest.approx(T - 1e-3 * (T - 10.0))


@pytest.mark.parametrize(("apart", "behind"), [(0.0, 0.0), (0.003, 0.003), (0.0049, 0.0049), (0.008, -0.002)])
def test_samples_lie_behind_their_row_by_at_most_half_a_row(apart: float, behind: float) -> None:
    log = Log("a.csv", {"n_r": Channel(T, SPEED), "vigv": Channel(T + apart, SPEED)})
    late = Late(("vgv1", "vigv"), 0.02)
    begun = Log("a.csv", {"n_r": Channel(3.0037 + T, SPEED), "vigv": Channel(3.0037 + T + apart, SPEED)})
    assert on_rows(begun, late, Grid(3.0037, DT, ROWS, {})) == pytest.approx(behind, abs=1e-9)
    assert on_rows(log, late, Grid(0.0, DT, ROWS, {})) == pytest.approx(behind, abs=1e-9)
    left = vanes_late(T, [Late(("n_r",), 0.1), late._replace(seconds=0.0, drift=1e-4, middle=10.0)], log,
                      Grid(0.0, DT, ROWS, {}))[VANES_LATE]  # fmt: skip
    assert left == pytest.approx(1e-4 * (T - 10.0) - behind, abs=1e-9)


def test_speeds_drive_a_subsystem_from_where_they_belong() -> None:
    ramp = {"n_r": 2.0 * T, "n_dem": 3.0 * T, "x_lvdt": 4.0 * T}
    passed = LowPass("mean", 0.03)
    out = driving(T, ramp, [Late(("n_r",), 0.02), Late(("n_dem",), -0.03, passed=passed), Late(("x_lvdt",), 1.0)])
    assert out["n_r"][:-10] == pytest.approx(2.0 * (T + 0.02)[:-10]) and out["x_lvdt"] is ramp["x_lvdt"]
    assert out["n_dem"] is ramp["n_dem"]  # the low-pass makes all of it
    assert set(driving(T, {"n_dem": T}, [Late(("n_r",), 0.02)])) == {"n_dem"}


def test_a_low_pass_is_the_demand_s_or_that_of_what_is_explained() -> None:
    passed = LowPass("first order", 0.01, 0.004)
    of_demand, of_speed = Late(("x_dem",), -0.014, passed=passed), Late(("n_dem",), 0.002, passed=passed)
    assert demand_of([of_speed, of_demand]) == (passed, (of_speed,)) and demand_of([of_speed]) == (
        AS_LOGGED,
        (of_speed,),
    )
    assert passed_by([of_demand, of_speed]) == LowPass("first order", 0.01)
    assert passed_by([of_demand, Late(("x_lvdt",), 0.01)]) == AS_LOGGED


# ---- low-passes ------------------------------------------------------------------------------------------------------


def test_a_mean_is_that_of_the_ticks_before_and_a_log_stood_still_before_it() -> None:
    x = white(1, 40)
    longer = np.concatenate([np.full(9, x[0]), x])
    mean = LOW_PASSES["mean"]
    assert mean(x, 0.0) == pytest.approx(x) and mean(x, 0.4) == pytest.approx(x)
    for half, weights in ((1.5, [1.0, 1.0, 1.0]), (1.25, [1.0, 1.0, 0.5]), (2.0, [1.0] * 4), (3.0, [1.0] * 6)):
        wanted = np.convolve(longer, np.array(weights) / sum(weights))[9 : 9 + len(x)]
        assert mean(x, half) == pytest.approx(wanted), half


@pytest.mark.parametrize("delay", [0.7, 3.0, 12.0])
def test_a_first_order_is_the_bilinear_transform_of_its_lag(delay: float) -> None:
    x = 5.0 + white(2, 300)
    b, a = scipy.signal.bilinear([1.0], [delay, 1.0])
    assert LOW_PASSES["first order"](x, delay) == pytest.approx(x[0] + scipy.signal.lfilter(b, a, x - x[0]))
    slow = lagged(x - x[0], 0.25)
    wanted = 0.0
    for k in range(50):
        wanted += 0.25 * (x[k] - x[0] - wanted)
        assert slow[k] == pytest.approx(wanted)


@pytest.mark.parametrize("delay", [4.0, 15.0])
def test_a_second_order_halves_the_power_at_its_corner(delay: float) -> None:
    at = np.arange(4000.0)
    corner = 2.0**0.5 / delay  # rad a tick
    for frequency, share in ((corner, 0.5), (0.2 * corner, 1.0 / (1.0 + 0.2**4))):
        out = LOW_PASSES["second order"](3.0 + np.sin(frequency * at), delay)[1000:]
        assert 2.0 * np.var(out) == pytest.approx(share, rel=0.03)
        assert out.mean() == pytest.approx(3.0, abs=0.01)
    smooth = np.sin(0.3 * at)
    assert LOW_PASSES["second order"](smooth, 0.0) == pytest.approx(smooth, abs=0.01)  # hardly any


@pytest.mark.parametrize(("kind", "delay"), [("mean", 0.02), ("first order", 0.02), ("second order", 0.03)])
@pytest.mark.parametrize("held", [False, True])
def test_noise_behind_a_low_pass_shows_less_of_itself_the_slower_it_is(kind: str, delay: float, held: bool) -> None:
    low, t = LowPass(kind, delay, held=held), DT * np.arange(20_000)
    # `of` on ticks of a tenth of a row: what a row holds is the noise of the row before, or that of each of its ticks
    ticks = white(5, len(t), 1).repeat(10, axis=1) if held else white(5, len(t), 10)
    seen = low.of(ticks, 0.1 * DT)[:, -1]
    shown = low.shown(t)
    assert shown == pytest.approx(noise_floor(t, seen) / np.std(seen), rel=0.06) and shown < 0.97
    assert LowPass(kind, 4.0 * delay, held=held).shown(t) < shown


def test_a_low_pass_of_rows_keeps_a_constant_and_moves_a_late_one_alike() -> None:
    for kind in LOW_PASSES:
        low = LowPass(kind, 0.03, 0.02)
        assert low.of_rows(np.full((2, 200), 7.0), DT) == pytest.approx(7.0)
        ramp = low.of_rows(T, DT)
        assert (T - ramp)[300:-300] == pytest.approx(0.05, abs=5e-4)
        early = LowPass(kind, 0.01, -0.04).of_rows(T, DT)
        assert (T - early)[300:-300] == pytest.approx(-0.03, abs=5e-4)


# ---- vane angles against the stroke ----------------------------------------------------------------------------------

STROKE = 20.0 + 4.0 * np.sin(0.9 * T) + 0.7 * np.sin(3.1 * T + 1.0)  # mm
VANES_OF = np.array([[1.0], [-0.6]])


def stroke_at(t: Array) -> Array:
    return np.asarray(20.0 + 4.0 * np.sin(0.9 * t) + 0.7 * np.sin(3.1 * t + 1.0))


def linkage(late: Array | float, of: int = 2, more: Array | float = 0.0, begin: float = 0.0) -> Stage:
    """Angles that follow the stroke at once, and stand ``late`` (s) in the file."""
    angles = VANES_OF[:of] * stroke_at(T - late) + more + NOISE * white(4, of, ROWS)
    names = ("vigv", "vgv1")[:of]
    columns = {"x_lvdt": STROKE, **dict(zip(names, angles, strict=True))}

    def run(driven: Driven, theta: Array) -> Array:
        return VANES_OF[:of] * driven.columns.get("stroke", driven.columns["x_lvdt"])

    stage = subsystem("linkage", run, columns, names)
    stage.t = stage.t + begin
    return stage


@pytest.mark.parametrize("late", [0.017, -0.012])
@pytest.mark.parametrize("drift", [0.0, 4e-4])
def test_all_vanes_that_stand_late_alike_do_so_by_their_recorder_s_clock(late: float, drift: float) -> None:
    middle = 0.5 * T[-1]
    (one,) = late_vanes([linkage(late + drift * (T - middle))])["linkage"]
    assert one.channels == ("vigv", "vgv1") and one.middle == pytest.approx(BEGIN + middle)
    assert one.seconds == pytest.approx(late, abs=1e-4) and one.drift == pytest.approx(drift, abs=1e-5)
    assert not one.zero and one.passed == AS_LOGGED


def test_a_drift_of_less_than_a_tick_at_either_end_is_none() -> None:
    middle, length = 0.5 * T[-1], T[-1]
    for ends, told in ((1.8e-3, False), (2.3e-3, True)):
        (one,) = late_vanes([linkage(0.02 + ends / length * (T - middle))])["linkage"]
        assert bool(one.drift) == told
    assert one.drift == pytest.approx(2.3e-3 / length, rel=0.05)


def test_vanes_are_not_moved_where_they_fit_are_alone_or_are_another_run_s() -> None:
    assert late_vanes([linkage(0.0)]) == {} == late_vanes([])
    assert late_vanes([linkage(0.02, of=1)]) == {}  # a lag of one potentiometer
    assert late_vanes([linkage(0.045)]) == {} == late_vanes([linkage(-0.045)])  # beyond what recorders differ by
    assert set(late_vanes([linkage(0.036)])) == {"linkage"} == set(late_vanes([linkage(-0.036)]))
    assert late_vanes([linkage(0.01, more=0.5 * np.sign(np.sin(0.9 * T)))]) == {}  # play, most of which stays
    one_alone = np.array([[0.0], [0.02]])
    assert late_vanes([linkage(one_alone)]) == {}  # the other would get worse


def actuator(lag: float, more: float = 0.0) -> Stage:
    """A stroke that shows the current of ``lag`` (s) before, and what nothing explains."""
    lvdt_lag = Effect("lvdt_lag", (Parameter("time_constant", 0.0, "s", 0.0, 0.1),), ((0.01,),))

    def behind(late: float) -> Array:
        return np.asarray(stroke_at(T - late) - late**2)  # no pure shift: a lag

    def run(driven: Driven, theta: Array) -> Array:
        return behind(float(theta[0]))[None]

    x = behind(lag) + more * np.sign(np.sin(0.9 * T)) + NOISE * white(6, ROWS)
    return subsystem("actuator", run, {"x_lvdt": x, "i_cmd": STROKE}, ("x_lvdt",), effects=(lvdt_lag,))


def test_a_slow_lvdt_makes_vanes_look_early_and_is_no_clock() -> None:
    early = linkage(-0.012)
    assert set(late_vanes([early, actuator(0.0)])) == {"linkage"}
    assert set(late_vanes([early, actuator(0.0, more=0.02)])) == {"linkage"}  # it fails, of something else
    assert late_vanes([early, actuator(0.012)]) == {} and late_vanes([early, actuator(0.007)]) == {}
    assert set(late_vanes([early, actuator(0.004)])) == {"linkage"}  # a third of it
    assert set(late_vanes([linkage(0.012), actuator(0.012)])) == {"linkage"}  # late: no lag makes that
    assert _lvdt_lag(actuator(0.009), 0.02) == pytest.approx(0.009, abs=2e-4)
    assert _lvdt_lag(actuator(0.0), 0.02) == 0.0 == _lvdt_lag(linkage(0.02), 0.02)


# ---- speeds and demands ----------------------------------------------------------------------------------------------


def lag_of(values: Array, tau: float = 0.3) -> Array:
    share = 1.0 - np.exp(-DT / tau)
    return np.asarray(values[0] + scipy.signal.lfilter([share], [1.0, share - 1.0], values - values[0]))


def speed_at(t: Array) -> Array:
    return np.asarray(75.0 + 10.0 * np.sin(0.6 * t) + 2.0 * np.sin(2.1 * t + 0.4))


def engine(late: float, zero: float = 0.0, more: Array | float = 0.0) -> Stage:
    """A speed behind a lag of its demand, which stands ``late`` in the file."""

    def run(driven: Driven, theta: Array) -> Array:
        return lag_of(driven.columns["n_dem"])[None]

    columns = {"n_dem": speed_at(T - late), "n_r": lag_of(SPEED) + zero + more + NOISE * white(7, ROWS)}
    return subsystem("engine", run, columns, ("n_r",))


def table_of(n_r: Array) -> Array:
    return 0.3 * (n_r - 60.0) + 0.01 * (n_r - 75.0) ** 2


def demand(late: float, zero: float = 0.0, offset: float = 0.0) -> Stage:
    """A stroke demand from the table's at a speed that stands ``late`` in the file, and reads high there."""

    def run(driven: Driven, theta: Array) -> Array:
        return table_of(driven.columns["n_r"])[None]

    columns = {"n_r": speed_at(T - late) + zero, "x_dem": table_of(SPEED) + offset + NOISE * white(8, ROWS)}
    return subsystem("demand", run, columns, ("x_dem",))


@pytest.mark.parametrize("late", [0.03, -0.02, 0.0146])
def test_a_demand_stands_late_or_early_against_the_speed_that_follows_it(late: float) -> None:
    found = late_in_controller([engine(late)])
    assert set(found) == {"engine"}
    (one,) = found["engine"]
    assert one == Late(("n_dem",), one.seconds) and one.seconds == pytest.approx(late, abs=2e-4)


def test_a_demand_that_fits_or_is_of_another_run_is_not_moved() -> None:
    assert late_in_controller([engine(0.0)]) == {} == late_in_controller([engine(0.044)])
    assert set(late_in_controller([engine(-0.036)])) == {"engine"}
    assert late_in_controller([engine(0.01, more=np.sign(np.sin(0.6 * T)))]) == {}


def test_an_answer_before_its_cause_is_the_recorder_s_and_a_late_one_the_controller_s() -> None:
    found = late_in_controller([demand(0.02)])
    assert set(found) == {"demand"} and found["demand"][0].channels == ("n_r",)
    assert found["demand"][0].seconds == pytest.approx(0.02, abs=1e-4)
    assert late_in_controller([demand(-0.02)]) == {}  # a slow controller


def test_a_demand_that_is_late_in_the_servo_may_be_an_answer_that_comes_too_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The same clock has made it late here, to a tick; a stroke that is late in the servo says nothing of it."""
    found: list[Late] = []
    monkeypatch.setattr(alignment, "_servo", lambda stage: found)
    held = linkage(0.0)
    held.name = "servo"
    for late, by, told in (
        (((("x_dem",), 0.02),), 0.0205, True), (((("x_dem",), 0.02),), 0.0225, False),
        (((("x_dem",), -0.02),), 0.01, False), (((("x_lvdt",), 0.02), (("x_dem",), 0.001)), 0.01, False),
    ):  # fmt: skip
        found[:] = [Late(*one) for one in late]
        both = late_in_controller([held, demand(-by)])
        assert ("demand" in both) == told, (late, by)
        assert both["servo"] == both["actuator"] == tuple(found)
        assert ("linkage" in both) == (found[0].channels == ("x_lvdt",))  # the linkage has no demand


def test_a_subsystem_is_made_anew_with_other_columns_and_takes_its_noise_over() -> None:
    stage = linkage(0.0)
    passed = LowPass("mean", 0.02)
    stage.made = Made(stage.made.make, stage.made.driven._replace(passed=passed))  # type: ignore[attr-defined]
    for given, behind in ((None, passed), (AS_LOGGED, AS_LOGGED)):
        moved = _moving(stage, lambda late: {"stroke": late + STROKE}, given)(np.array([0.5]))
        driven = moved.made.driven  # type: ignore[attr-defined]
        assert driven.again and driven.passed == behind and driven.columns["stroke"] == pytest.approx(STROKE + 0.5)
        assert driven.columns["x_lvdt"] is stage.made.driven.columns["x_lvdt"]  # type: ignore[attr-defined]


@pytest.mark.parametrize("most", [np.inf, 0.3])
def test_an_offset_is_fitted_beside_the_parameters_within_what_is_known_of_them(most: float) -> None:
    """Least squares of two slopes, of which one has a prior of the width of its tolerance."""
    slope, rise, tolerance, floor = np.sin(0.9 * T), np.cos(0.4 * T) + 0.3 * np.sin(0.9 * T), 0.02, 1.0
    gain = Parameter("gain", 2.0, "-", tolerance=tolerance)
    measured = 2.1 * slope + 0.8 * rise + 0.5 * white(1, ROWS)

    def run(driven: Driven, theta: Array) -> Array:
        return theta[0] * slope[None] + driven.columns.get("more", 0.0 * rise)

    stage = subsystem("engine", run, {"n_r": measured}, ("n_r",), (gain,), floor=floor / 1.02)
    moved = _moving(stage, lambda late: {"more": late[0] * rise})
    (found,), before, after = _fit(stage, moved, 1, most=most)
    a, b = np.array([slope[INNER], rise[INNER]]).T, measured[INNER] - 2.0 * slope[INNER]
    normal = a.T @ a + np.diag([3.0 / tolerance**2, 0.0])
    wanted = np.linalg.solve(normal, a.T @ b)
    assert found == pytest.approx(min(wanted[1], most), rel=1e-4)
    if most == np.inf:
        e = b - a @ np.array([np.clip(wanted[0], -tolerance, tolerance), wanted[1]])
        assert after == pytest.approx([np.mean(e**2)], rel=1e-2)
    alone = (a[:, 0] @ b) / (a[:, 0] @ a[:, 0] + 3.0 / tolerance**2)
    e = b - a[:, 0] * np.clip(alone, -tolerance, tolerance)
    assert before == pytest.approx([np.mean(e**2)], rel=1e-2)
    (whole,), *_ = _fit(stage, moved, 1, frame=0.4, most=np.inf)
    assert whole == pytest.approx(wanted[1]) or whole == 0.8  # whole frames, where they suit as well


def servo(
    late: float = 0.0,
    zero: float = 0.0,
    late_stroke: float = 0.0,
    floor: float = NOISE,
    own: float = 0.05,
    digit: float = 0.0,
) -> Stage:
    """The firmware's law on a demand that stands ``late`` in the file and a stroke that reads high there; the piston
    follows its demand, so that the integral stays where it is, but for a motion of its ``own`` (mm).
    """
    none, x = np.zeros(ROWS), stroke_at(T - 0.06) + own * np.sin(5.0 * T)
    law = law_of(STROKE, none, CALIBRATION, behind=LowPass(late=-late))
    law = law + law_of(none, np.interp(T + late_stroke, T, x), CALIBRATION)
    high = x + zero
    c = {
        "x_dem": STROKE, "x_lvdt": high, "stroke": high, "missing": none, "law": law_of(STROKE, high, CALIBRATION),
        "i_cmd": law.mean(axis=1) + floor * white(1, ROWS), "law_error": floor * white(2, ROWS, 3),
    }  # fmt: skip
    if digit:
        c["x_dem"] = np.round(STROKE / digit) * digit
    driven = Driven(BEGIN + T, c, MACHINE, CALIBRATION, ("i_cmd",), INNER, (), digits={"x_dem": digit} if digit else {})
    stage = servo_stage(driven)
    stage.floor = np.array([1.05 * floor])
    return stage


def test_a_stroke_that_stands_late_in_the_servo_does_so_in_the_linkage_too() -> None:
    for late, late_stroke in ((0.004, 0.015),):
        found = late_in_controller([servo(late, late_stroke=late_stroke, own=0.5)])
        assert set(found) == {"servo", "actuator", "linkage"} and found["servo"] == found["actuator"]
        assert found["linkage"] == tuple(one for one in found["servo"] if one.channels == ("x_lvdt",))
        assert found["linkage"][0].seconds == pytest.approx(late_stroke, abs=3e-4)
        assert len(found["servo"]) == 1 + (late > 0.0)


def test_rounding_of_a_demand_is_no_low_pass_of_the_stroke() -> None:
    """What smooths the digits of a demand leaves less of them: they are taken off before kinds are compared."""
    (one,) = _servo(servo(0.02, digit=0.02))
    assert _servo(servo(digit=0.02)) == []
    assert one.channels == ("x_dem",) and one.seconds == pytest.approx(0.02, abs=1e-3) and not one.passed.kind


# ---- low-passes that the analogue channels have passed ---------------------------------------------------------------


def play_of(x: Array, half: float = 0.2) -> Array:
    """What follows a stroke within a play of twice ``half`` (mm)."""
    out, y = [], float(x[0])
    for one in x.tolist():
        y = one - half if y < one - half else one + half if y > one + half else y
        out.append(y)
    return np.array(out)


def filtered(passed: LowPass, clock: float = 0.0) -> Stage:
    """Rings with play, whose stroke and angles have passed the same low-pass; the angles' clock is late besides."""
    fast = STROKE + 0.8 * np.sin(9.0 * T)

    def run(driven: Driven, theta: Array) -> Array:
        return VANES_OF * play_of(driven.columns.get("stroke", driven.columns["x_lvdt"]))

    angles = passed.of_rows(VANES_OF * play_of(np.interp(T - clock, T, fast)), DT) + NOISE * white(9, 2, ROWS)
    columns = {"x_lvdt": passed.of_rows(fast, DT), "vigv": angles[0], "vgv1": angles[1]}
    return subsystem("linkage", run, columns, ("vigv", "vgv1"))


@pytest.mark.parametrize("kind", ["mean", "first order", "second order"])
def test_a_low_pass_of_stroke_and_vanes_is_told_by_the_turns_that_it_rounds(kind: str) -> None:
    found = _both_passed(filtered(LowPass(kind, 0.02)))
    assert (found.kind, found.late) == (kind, 0.0) and found.delay == pytest.approx(0.02, rel=0.05)


def test_without_a_servo_the_linkage_s_low_pass_is_the_engine_s_too() -> None:
    passed = LowPass("second order", 0.03)
    assert _both_passed(filtered(AS_LOGGED)) == AS_LOGGED
    assert _both_passed(linkage(0.02)) == AS_LOGGED  # a clock
    n_dem = SPEED + 5.0 * np.sin(8.0 * T)
    behind = subsystem(
        "engine", lambda driven, theta: lag_of(driven.columns["n_dem"])[None],
        {"n_dem": n_dem, "n_r": passed.of_rows(lag_of(n_dem), DT) + NOISE * white(7, ROWS)}, ("n_r",),
    )  # fmt: skip
    both = late_in_controller([filtered(passed), behind])
    assert set(both) == {"linkage", "engine"}
    (one,), (demanded,) = both["linkage"], both["engine"]
    assert one.channels == ("x_lvdt", "vigv", "vgv1") and (one.seconds, one.passed.kind) == (0.0, "second order")
    assert demanded.channels == ("n_dem",) and demanded.passed.kind == "second order"
    assert demanded.seconds == pytest.approx(
        -demanded.passed.delay, abs=1e-3
    )  # it stands early by what the others wait


def test_stroke_and_vanes_are_behind_a_known_low_pass_unless_that_is_worse() -> None:
    passed = LowPass("second order", 0.03)
    stage = filtered(passed, clock=0.01)
    (one,) = _both_behind(stage, passed)
    assert one == Late(("x_lvdt", "vigv", "vgv1"), 0.0, passed=passed)
    assert _both_behind(filtered(AS_LOGGED), passed) == ()


# ---- zeros -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("zero", [0.02, -0.035])
def test_a_stroke_that_reads_high_makes_the_integral_drift(zero: float) -> None:
    found = zeros_in_controller([servo(zero=zero)])
    assert set(found) == set(OF_SUBSYSTEM) and len({*found.values()}) == 1
    (one,) = found["servo"]
    assert one == Late(("x_lvdt",), 0.0, zero=one.zero) and one.zero == pytest.approx(zero, rel=0.03)
    assert zeros_in_controller([servo()]) == {}
    assert zeros_in_controller([servo(late=0.02)]) == {}  # a clock is no zero


@pytest.mark.parametrize("zero", [0.2, -0.35])
def test_a_speed_that_reads_high_lies_elsewhere_on_the_tables(zero: float) -> None:
    (one,) = zeros_in_controller([demand(0.0, zero=zero)])["demand"]
    assert one.channels == ("n_r",) and one.zero == pytest.approx(zero, rel=0.01)
    assert zeros_in_controller([demand(0.0, offset=zero)]) == {}  # as tables make whose strokes are off alike
    assert zeros_in_controller([demand(0.0)]) == {}


def test_without_a_demand_the_speed_s_zero_is_where_the_engine_settles() -> None:
    (one,) = zeros_in_controller([engine(0.0, zero=0.4)])["engine"]
    assert one.channels == ("n_r",) and one.zero == pytest.approx(0.4, rel=0.01)
    assert zeros_in_controller([demand(0.0), engine(0.0, zero=0.4)]) == {}  # an idle speed: the tables say so
    both = zeros_in_controller([demand(0.0, zero=0.2), servo(zero=0.02), engine(0.0)])["linkage"]
    assert [one.channels[0] for one in both] == ["x_lvdt", "n_r"]
    assert [one.zero for one in both] == pytest.approx([0.02, 0.2], rel=0.03)


def valve(zero: float, floor: float = NOISE) -> Stage:
    """A stroke whose speed is the current's, in windows."""

    def run(driven: Driven, theta: Array) -> Array:
        return np.cumsum(driven.columns["i_cmd"])[None] * DT

    i = 10.0 * np.sin(0.9 * T)
    x = np.cumsum(i) * DT + NOISE * white(3, ROWS)
    return subsystem("actuator", run, {"i_cmd": i + zero, "x_lvdt": x}, ("x_lvdt",), window=1.0)


@pytest.mark.parametrize(("in_floors", "told"), [(0.8, True), (-0.8, True), (1.3, False)])
def test_a_zero_of_the_current_is_told_beside_one_as_large_of_another_channel(in_floors: float, told: bool) -> None:
    """In noise floors: the stroke's of 40 floors of 1 um, the current's of so many shares of 40 floors of 10 uA."""
    floor, stroke = 0.01, 0.04  # mA, mm
    size = in_floors * stroke / (1.02 * NOISE) * 1.05 * floor
    of = servo(zero=stroke, floor=floor)
    found = {one.channels[0]: one.zero for one in zeros_in_controller([of, valve(size)]).get("servo", ())}
    assert found["x_lvdt"] == pytest.approx(stroke, rel=0.05)
    assert found.get("i_cmd", 0.0) == pytest.approx(size if told else 0.0, rel=0.02)
    assert zeros_in_controller([servo(floor=floor), valve(size)]) == {}  # alone it would be the valve's null
    assert set(zeros_in_controller([of, valve(0.0)])["servo"]) == {Late(("x_lvdt",), 0.0, zero=found["x_lvdt"])}


def test_a_subsystem_fits_at_its_floor_and_not_above_it() -> None:
    stage = linkage(0.0)
    assert fits(stage)
    stage.floor = 0.9 * np.asarray(stage.floor)
    assert not fits(stage)


# ---- strokes of two actuators in each other's place ------------------------------------------------------------------


def two(exchanged: bool, apart: float = 1.0, smoothed: bool = False, fails: bool = False) -> list[Stage]:
    """Vane angles that feel A's stroke more, and actuators that fit."""
    a, b = STROKE + apart * np.sin(1.7 * T), STROKE - apart * np.cos(1.3 * T)
    angles = 0.7 * a + 0.3 * b + NOISE * white(2, ROWS)
    strokes = {"x_lvdt_a": b, "x_lvdt_b": a} if exchanged else {"x_lvdt_a": a, "x_lvdt_b": b}
    if smoothed:
        strokes |= {"stroke_a": strokes["x_lvdt_a"], "stroke_b": strokes["x_lvdt_b"]}

    def run(driven: Driven, theta: Array) -> Array:
        assert driven.both is not None
        one, other = driven.both
        return (0.7 * one + 0.3 * other)[None]

    machine = replace_sides(2)
    rings = subsystem("linkage", run, {**strokes, "x_lvdt": STROKE, "vigv": angles}, ("vigv",), machine=machine)
    x = STROKE + fails * np.sign(np.sin(T)) + NOISE * white(3, ROWS)
    side = subsystem("actuator_a", lambda driven, theta: STROKE[None], {"x_lvdt_a": x}, ("x_lvdt_a",), machine=machine)
    return [rings, side]


def replace_sides(sides: int) -> Any:
    return SimpleNamespace(sides=sides)


@pytest.mark.parametrize("smoothed", [False, True])
def test_strokes_in_each_other_s_place_are_told_by_the_vanes(smoothed: bool) -> None:
    rings, side = two(True, smoothed=smoothed)
    made, again = rings.made, []
    assert isinstance(made, Made)
    rings.made = made._replace(make=lambda driven: (again.append(driven.again), made.make(driven))[1])
    assert len(swapped([rings, side])) == 1 and again == [True]  # the exchanged one takes the noise over
    (said,) = swapped(two(True, smoothed=smoothed))
    rings, _ = two(True, smoothed=smoothed)
    judge = LeastSquaresProblem(rings, np.asarray(rings.floor))
    error = float(np.sqrt(judge.mean_squares(judge.errors(rings.neutral()[None])[0])[0]))
    assert said.startswith("x_lvdt_a, x_lvdt_b: each seems to stand in the other's place in the log")
    assert f"falls from {error:.3g} to 0.9" in said and "both actuators fit either way" in said


def test_strokes_are_not_told_as_exchanged_where_anything_else_may_be_wrong() -> None:
    assert swapped(two(False)) == [] and swapped(two(True, fails=True)) == []
    assert swapped(two(True)[1:]) == [] and swapped(two(True, apart=0.0)) == []
    rings, side = two(True)
    rings.floor = None
    assert swapped([rings, side]) == []
    one_only = linkage(0.02)
    assert swapped([one_only, side]) == []


def test_chance_lessens_an_error_by_twelve_nats_of_observations_that_are_five_samples_long() -> None:
    stage = linkage(0.0)
    samples = np.isfinite(stage.measured).sum(axis=1)
    assert _chance(0.25) == 0.25 * 2.0 * 5.0 * 12.0
    before = np.array([1.0, 1.0])
    enough = 120.0 / samples.sum()
    assert _significant(stage, before, before - 1.01 * enough)
    assert not _significant(stage, before, before - 0.99 * enough)
