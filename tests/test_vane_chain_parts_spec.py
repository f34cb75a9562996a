"""Parts of the vane chain, each by itself: rows that count, what is said of a log, the order in which clocks are
sought, and what a machine of two actuators shares.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller import load_calibration
from hil.figures import noise_floor
from hil.logs import Channel, Log, LogError
from hil.loop.lockstep import Stimulus, lockstep
from plant import Model, build_plant
from plant.curve import TURN
from plant.drive import nominal_compliance
from plant.effects import EFFECTS, piston_stiction
from plant.model import Learned
from plant.parameters import LINE_CONDUCTANCE
from tests.small_logs import log_of, white
from vaneloop.base.vanes import VANES
from vaneloop.identification.subsystem import Array, Stage, without_jumps
from vaneloop.identification.vane_chain import chain as module
from vaneloop.identification.vane_chain.actuator import actuator_stage
from vaneloop.identification.vane_chain.alignment import Late
from vaneloop.identification.vane_chain.candidates import reversals
from vaneloop.identification.vane_chain.chain import (
    Chain,
    _cut,
    _hides_no_less,
    _lost_bits,
    _lost_step,
    _moved,
    _one_stroke,
    _rows,
    _sampled,
    _slow_current,
    _used,
    build_chain,
    subsystems_of,
    with_mean_stroke,
)
from vaneloop.identification.vane_chain.engine import engine_stage
from vaneloop.identification.vane_chain.linkage import _earlier, _with_midpoints, _with_reversals, linkage_stage
from vaneloop.identification.vane_chain.low_pass import LowPass
from vaneloop.identification.vane_chain.parameters import BOTH, _has, declared_by_side, lanes_by_side, sides_of
from vaneloop.identification.vane_chain.resample import (
    OF_SIDES,
    OF_SUBSYSTEM,
    Gaps,
    Grid,
    _between,
    _between_rows,
    _held,
    _settled,
    _to_frame,
    expect_draws,
    first_row,
    grid_of,
    last_digit,
    on_raster,
    rms,
)
from vaneloop.identification.vane_chain.subsystem_data import STROKE_OFF, VANES_LATE, Driven

CALIBRATION, MACHINE = load_calibration(), build_plant()
TWO = build_plant("plant_two_actuators.toml")
DT = 0.01


# ---- rows that count -------------------------------------------------------------------------------------------------


def test_rows_count_3_s_after_a_start_a_gap_and_after_the_firmware_came_back() -> None:
    n = 2000
    t = DT * np.arange(n)
    none = np.zeros(n, dtype=bool)
    far, lost = none.copy(), none.copy()
    far[805:815] = lost[800:820] = True
    gaps = Gaps(none, {"n_r": far}, {"n_r": lost})
    running = (t < 14.0) | (t >= 15.0)
    whole = _rows(t, Gaps(none, {}, {}), ("n_r",), None, True)
    assert np.array_equal(whole.usable, t >= 3.0) and whole.fresh.all() and not whole.missing.any()
    assert whole.run is whole.law_holds is whole.machine is whole.currents is whole.usable

    rows = _rows(t, gaps, ("n_r",), running, True)
    assert np.array_equal(rows.fresh, ~lost) and np.array_equal(rows.missing, lost)
    # a window of 1 s with a gap counts nowhere; then all settles for 3 s
    usable = (t >= 3.0) & ~((t >= 8.0) & (t < 8.2 + 3.0 - 1e-9))
    assert np.array_equal(rows.usable, usable) and np.array_equal(rows.run, usable & running)
    assert np.array_equal(rows.law_holds, usable & running & ((t < 14.0) | (t >= 18.0 - 1e-9)))
    assert rows.machine is rows.run and rows.currents is rows.law_holds and rows.machine_spell is rows.spell
    assert rows.stretch.tolist() == (t >= 8.2 - 1e-9).astype(int).tolist()
    assert rows.spell.tolist() == ((t >= 8.2 - 1e-9).astype(int) + (t >= 15.0)).tolist()

    aside = _rows(t, gaps, ("n_r",), running, False)  # the machine is judged in all modes
    assert aside.machine is aside.currents is aside.usable and aside.machine_spell is aside.stretch
    assert np.array_equal(aside.run, rows.run) and np.array_equal(aside.law_holds, rows.law_holds)
    assert set(aside.columns()) == {"stretch", "spell", "machine_spell", "fresh", "missing"}
    assert aside.columns()["fresh"].tolist() == (~lost).astype(float).tolist()
    assert not _rows(t, gaps, ("x_lvdt",), None, True).missing.any()  # another channel's gap
    state = Gaps(none, {"state": far}, {"state": lost})
    assert np.array_equal(_rows(t, state, ("x_lvdt",), None, True).missing, lost)  # who knows the mode there


def test_gaps_that_count_in_a_subsystem_are_of_what_drives_it_and_of_what_it_explains_but_for_vanes() -> None:
    assert _used(OF_SUBSYSTEM["actuator"]) == ("i_cmd", "n_r", "p_s", "t_oil", "x_lvdt")
    assert _used(OF_SUBSYSTEM["linkage"]) == ("x_lvdt", "n_r", "t_oil")


# ---- what is said of a log -------------------------------------------------------------------------------------------


def test_time_that_a_subsystem_has_not_is_told_with_the_channel_and_the_samples_lost() -> None:
    t = 5.0 + DT * np.arange(6001)
    begins, ends = t[730:], t[:5000]
    log = log_of(
        t, x_lvdt=np.sin(t), vigv=np.sin(t), vgv1=(t[1500:], t[1500:]), vgv2=(t[:3000], t[:3000]),
        i_cmd=(begins, np.sin(begins)), p_s=(ends, 21.0 + 0.0 * ends),
    )  # fmt: skip
    grid = grid_of(log)
    of = {name: OF_SUBSYSTEM[name] for name in ("actuator", "linkage")}
    notes = {str(n): n for n in _cut(log, grid, of)}
    assert {(str(n), n.kind, n.of, n.number) for n in notes.values()} == {  # type: ignore[attr-defined]
        ("vgv1: measured from 20 to 65 s, judged there alone", "cut", "vgv1", 1500),
        ("vgv2: measured from 5 to 34.99 s, judged there alone", "cut", "vgv2", 3001),
        ("i_cmd begins at 12.3 s: actuator not judged before it", "cut", "i_cmd", 800),  # from a whole window on
        ("p_s ends at 54.99 s: actuator not judged after it", "cut", "p_s", 1001),
    }
    assert _cut(log, grid, {}) == []
    short = log_of(t, x_lvdt=np.sin(t), vigv=np.sin(t), i_cmd=(t[140:], t[140:]))  # within a window and a half
    assert [str(n) for n in _cut(short, grid_of(short), of)] == ["i_cmd begins at 6.4 s: actuator not judged before it"]
    soon = log_of(t, x_lvdt=np.sin(t), vigv=np.sin(t), i_cmd=(t[90:], t[90:]))
    assert _cut(soon, grid_of(soon), of) == []
    for rows, told in ((160, True), (140, False)):
        early = log_of(t, x_lvdt=np.sin(t), vigv=np.sin(t), i_cmd=(t[:-rows], t[:-rows]))
        assert bool(_cut(early, grid_of(early), of)) == told, rows


def test_of_what_drives_and_what_is_explained_the_driver_is_named_and_of_two_the_last() -> None:
    t = DT * np.arange(6001)
    late, later = t[730:], t[790:]  # both have whole windows from 8 s on
    of = {"actuator": OF_SUBSYSTEM["actuator"]}
    for one, other, named in (("p_s", "t_oil", "t_oil"), ("t_oil", "p_s", "p_s"), ("p_s", "x_lvdt", "p_s")):
        made = {n: (t, np.sin(t)) for n in ("i_cmd", "x_lvdt", "vigv", "n_dem", "n_r")}
        made |= {one: (late, np.cos(late)), other: (later, np.cos(later))}
        log = log_of(**made)
        (note,) = (str(n) for n in _cut(log, grid_of(log), of) if "actuator" in str(n))
        at = {one: 7.3, other: 7.9}[named]
        assert note == f"{named} begins at {at:g} s: actuator not judged before it"


def test_what_was_moved_is_told_once_for_all_subsystems_that_it_was_moved_in() -> None:
    one, other = Late(("x_dem",), 0.02), Late(("x_lvdt", "vigv"), -0.01)
    notes = _moved({"servo": (one,), "actuator": (one, other), "linkage": (other,)})
    assert [str(n) for n in notes] == [
        "servo, actuator: x_dem: stand 20 ms late in the file; moved",
        "actuator, linkage: x_lvdt, vigv: stand 10 ms early in the file; moved",
    ]
    assert [(n.kind, n.of) for n in notes] == [("converted", "x_dem"), ("converted", "x_lvdt, vigv")]
    assert _moved({}) == []


def test_a_digit_of_a_logger_is_told_from_a_converter_s_lost_bits() -> None:
    sensors = MACHINE.table.sensors
    bit = float(sensors.lvdt_range.value) / 2.0 ** float(sensors.lvdt_bits.value)
    x = 20.0 + 8.0 * np.sin(0.01 * np.arange(6000)) + 0.3 * np.sin(0.37 * np.arange(6000))

    def found(step: float, machine: Any = MACHINE) -> float:
        return _lost_step(log_of(DT * np.arange(6000), x_lvdt=np.round(x / step) * step), machine)

    for digits in (1.0, 2.0, 2.5, 5.0):
        for power in (0.1, 0.01):
            assert found(digits * power) == 0.0, digits
    for step in (0.0333, 0.07, 0.012, 0.045):
        assert found(step) == (pytest.approx(step, rel=1e-3) if step >= 4.0 * bit else 0.0), step
    # four of a converter's steps count, fewer do not: a converter of a power of two has exact ones
    coarse = SimpleNamespace(table=SimpleNamespace(sensors=SimpleNamespace(
        lvdt_range=SimpleNamespace(value=48.0), lvdt_bits=SimpleNamespace(value=10.0))))  # fmt: skip
    assert found(0.1875, coarse) == pytest.approx(0.1875) and found(0.140625, coarse) == 0.0
    assert _lost_bits(0.1875, coarse) == "x_lvdt comes in steps of 0.1875 mm, 4 of its converter's: low bits are lost"  # type: ignore[arg-type]


def test_samples_joined_by_lines_count_at_their_own_rows_alone() -> None:
    t, grid = DT * np.arange(200), Grid(5.0, DT, 200, {})
    for off, counts in ((0.0, True), (0.0029, True), (0.0031, False), (-0.0029, True), (-0.0031, False)):
        slow = Channel(5.05 + off + 0.1 * np.arange(20), np.arange(20.0), apart=0.1)
        there = _sampled(slow, t, grid, (0, 200))
        assert there is not None and np.flatnonzero(there).tolist() == (list(range(5, 200, 10)) if counts else [])
    usual = replace(slow, apart=0.014)
    assert _sampled(usual, t, grid, (0, 200)) is None
    part = _sampled(usual, t, grid, (3, 200))
    assert part is not None and np.flatnonzero(~part).tolist() == [0, 1, 2]


# ---- the order in which zeros and clocks are sought ------------------------------------------------------------------

Finder = tuple[str, list[dict[str, tuple[Late, ...]]]]


@pytest.fixture
def sought(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Scripted finders: what each finds in turn, then nothing. Returns what was asked, and of what each was built."""

    def play(zeros: list[Any], clocks: list[Any], vanes: list[Any], log: Log, **kw: Any) -> Any:
        asked, built = [], []
        scripts = {"zeros_in_controller": zeros, "late_in_controller": clocks, "late_vanes": vanes}

        def finder(name: str) -> Any:
            def find(stages: Any) -> Any:
                asked.append(name)
                return scripts[name].pop(0) if scripts[name] else {}

            return find

        def build(log: Log, plant: Any, calibration: Any, present: Any, grid: Any, pieces: Any, draws: Any, late: Any):  # type: ignore[no-untyped-def]  # noqa: E501
            built.append(late)
            return Chain(np.zeros(1), [], {}, {}, MACHINE, CALIBRATION, CALIBRATION, ["before"])

        def noise(stages: Any) -> list[str]:
            asked.append("noise")
            return ["noise"]

        for name in scripts:
            monkeypatch.setattr(module, name, finder(name))
        monkeypatch.setattr(module, "_build", build)
        monkeypatch.setattr(module, "expect_stationary_noise", noise)
        chain = build_chain(log, MACHINE, **kw)
        return chain, asked, built

    return play


ZERO, CLOCK, OTHER, OF_VANES = (
    Late(("x_lvdt",), 0.0, zero=0.1), Late(("x_dem",), 0.02), Late(("x_dem",), 0.03), Late(("vigv",), 0.01),
)  # fmt: skip
ALL = ("zeros_in_controller", "late_in_controller", "late_vanes")


def short_log(framed: bool = False) -> Log:
    t = DT * np.arange(600)
    channels = {n: Channel(t, 60.0 + np.sin(t), framed and n == "n_dem") for n in ("n_dem", "n_r")}
    return Log("a.csv", channels)


def test_zeros_come_before_clocks_and_clocks_before_the_vanes_and_noise_behind_the_clocks(sought: Any) -> None:
    chain, asked, built = sought([], [], [], short_log())
    assert asked == ["zeros_in_controller", "late_in_controller", "noise", "late_vanes"]
    assert built == [{}] and chain.late == {} and list(chain.notes) == ["before", "noise"]

    chain, asked, built = sought([{"servo": (ZERO,)}], [], [{"linkage": (OF_VANES,)}], short_log())
    assert asked == ["zeros_in_controller", "noise", "late_in_controller", "noise", "late_vanes", "noise"]
    assert built == [{}, {"servo": (ZERO,)}, {"servo": (ZERO,), "linkage": (OF_VANES,)}] and chain.late == built[-1]
    assert [str(n).split(":")[0] for n in chain.notes] == ["before", "servo", "linkage", "noise"]


def test_clocks_may_have_hidden_a_zero_which_may_have_made_them_wrong(sought: Any) -> None:
    zeros, clocks = [{}, {"servo": (ZERO,), "demand": (ZERO,)}], [{"servo": (CLOCK,)}, {"servo": (OTHER,)}]
    chain, asked, built = sought(zeros, clocks, [], short_log())
    assert [a for a in asked if a != "noise"] == [
        "zeros_in_controller", "late_in_controller", "zeros_in_controller", "late_in_controller", "late_vanes"
    ]  # fmt: skip
    # once a zero is found the clocks that were read off channels with a wrong one are sought again
    assert built[1] == {"servo": (CLOCK,)} and built[2] == {"servo": (ZERO,), "demand": (ZERO,)}
    assert built[3] == {"servo": (ZERO, OTHER), "demand": (ZERO,)} == chain.late
    # a zero is sought behind clocks once only
    _, asked, _ = sought([], [{"servo": (CLOCK,)}], [], short_log())
    assert asked.count("zeros_in_controller") == 2 and asked.count("late_in_controller") == 1
    # the first zeros leave nothing to seek again
    _, asked, _ = sought([{"servo": (ZERO,)}], [{"engine": (CLOCK,)}], [], short_log())
    assert asked.count("zeros_in_controller") == 2 and asked.count("late_in_controller") == 1


def test_clocks_are_not_sought_where_they_are_known_or_there_is_one(sought: Any) -> None:
    known = {"servo": (CLOCK,)}
    chain, asked, built = sought([], [{"servo": (OTHER,)}], [], short_log(), late=known)
    assert asked == ["noise"] and built == [known] and chain.late == known
    assert [str(n).split(":")[0] for n in chain.notes] == ["before", "servo", "noise"]
    _, asked, built = sought([], [{"servo": (OTHER,)}], [], short_log(), late={})
    assert asked == ["noise"] and built == [{}]
    _, asked, _ = sought([], [{"servo": (OTHER,)}], [], short_log(framed=True))  # frames are stamped by one clock
    assert asked == ["noise"]


def test_a_slow_log_whose_channels_were_moved_hides_no_less_than_before() -> None:
    t = 0.05 * np.arange(400)
    for dt_of, before, now, wanted in (
        (t, 0.3, 0.1, 0.3), (t, 0.1, 0.3, 0.3), (0.2 * t, 0.3, 0.1, 0.1), (t, None, 0.1, 0.1), (t, 0.3, None, None),
    ):  # fmt: skip
        stage = Stage("s", ("y",), ("mm",), (), (), lambda p: np.zeros((len(p), 1, 400)), dt_of, np.zeros((1, 400)))
        stage.noise = lambda when, error: 0.4
        stage.floor = np.array([7.0])
        stage.raster_error = None if now is None else np.array([now])
        _hides_no_less(stage, None if before is None else np.array([before]))
        assert stage.raster_error == (None if wanted is None else pytest.approx([wanted]))
        changed = wanted is not None and wanted != now
        assert stage.floor == pytest.approx([np.hypot(0.4, 0.3) if changed else 7.0])


# ---- two actuators ---------------------------------------------------------------------------------------------------


def test_the_mean_of_two_strokes_is_the_controller_s_where_it_is_not_logged() -> None:
    t = DT * np.arange(500)
    a, b = (t, 20.0 + t), (t + 0.002, 21.0 + t)
    log = log_of(x_lvdt_a=a, x_lvdt_b=b)
    mean = with_mean_stroke(log, TWO)["x_lvdt"]
    assert np.array_equal(mean.t, t) and mean.values[1:] == pytest.approx(20.5 + t[1:] - 0.001)
    assert with_mean_stroke(log, MACHINE) is log
    has, alone = log_of(x_lvdt_a=a, x_lvdt_b=b, x_lvdt=a), log_of(x_lvdt_a=a)
    assert with_mean_stroke(has, TWO) is has and with_mean_stroke(alone, TWO) is alone
    (said,) = _one_stroke(alone, TWO)
    assert said.startswith("x_lvdt_b: not logged; which actuator or LVDT is at fault cannot be told")
    assert _one_stroke(log_of(n_r=a), TWO)[0].startswith("x_lvdt_a, x_lvdt_b: not logged")
    assert _one_stroke(log, TWO) == [] == _one_stroke(alone, MACHINE)


def test_a_machine_of_two_actuators_has_a_subsystem_for_each() -> None:
    t = DT * np.arange(500)
    log = log_of(t, x_lvdt_a=t, x_lvdt_b=t)
    assert subsystems_of(log, MACHINE) is OF_SUBSYSTEM
    both = subsystems_of(log, TWO)
    assert list(both) == ["demand", "servo", "engine", "actuator_a", "actuator_b", "linkage"]
    assert both["linkage"].needs == ("x_lvdt_a", "x_lvdt_b") and both["actuator_a"] is OF_SIDES["actuator_a"]
    assert subsystems_of(log_of(t, x_lvdt_a=t), TWO)["linkage"].needs == ("x_lvdt",)


@pytest.fixture(scope="module")
def rings() -> Driven:
    """Two actuators whose strokes differ, of a log of 7 s."""
    n = 700
    t = DT * np.arange(n)
    a, b = 20.0 + 5.0 * np.sin(t), 20.3 + 5.0 * np.sin(t - 0.02)
    c = {
        "x_lvdt_a": a, "x_lvdt_b": b, "x_lvdt": 0.5 * (a + b), "i_cmd": 8.0 * np.cos(t), "n_r": 70.0 + t,
        "p_s": np.full(n, 21.0), "t_oil": np.full(n, 40.0), "missing": np.zeros(n), "stretch": np.zeros(n, dtype=int),
        "machine_spell": np.zeros(n, dtype=int), **{v: np.zeros(n) for v in TWO.vanes},
    }  # fmt: skip
    return Driven(t, c, TWO, CALIBRATION, TWO.vanes, np.ones(n, dtype=bool), ())


def test_effects_of_two_actuators_are_those_of_the_side_and_of_what_the_rings_bring(rings: Driven) -> None:
    lvdt, valve, load, link = (EFFECTS[n] for n in ("lvdt_bias", "valve_null_bias", "aero_load", "rigging_offset"))
    one_stroke = rings._replace(columns={k: v for k, v in rings.columns.items() if k != "x_lvdt_b"})
    a, b = rings._replace(side=0), rings._replace(side=1)
    assert sides_of(lvdt, a) == (0, 1) and sides_of(lvdt, b) == (1, 0) and sides_of(valve, b) == (1,)
    assert sides_of(load, a) == (BOTH,) and sides_of(link, a) == (0, 1) == sides_of(link, rings)
    assert sides_of(lvdt, rings) == (BOTH, 0, 1) and sides_of(lvdt, one_stroke) == (BOTH,)
    assert sides_of(link, one_stroke) == () and sides_of(lvdt, one_stroke._replace(side=1)) == (1,)
    assert sides_of(lvdt, rings._replace(machine=MACHINE)) == (BOTH,)


def test_a_model_that_has_an_effect_of_both_sides_has_it_of_each() -> None:
    for present, name, has in (
        ("lvdt_bias", "side_a.lvdt_bias", True), ("side_a.lvdt_bias", "lvdt_bias", True),
        ("side_a.lvdt_bias", "side_a.lvdt_bias", True), ("side_a.lvdt_bias", "side_b.lvdt_bias", False),
        ("lvdt_gain", "lvdt_bias", False), ("lvdt_bias", "lvdt_bias", True),
    ):  # fmt: skip
        assert _has((present,), name) == has, (present, name)
    assert not _has((), "lvdt_bias")


def test_parameters_of_a_side_are_named_after_it_and_act_on_it_alone(rings: Driven) -> None:
    for side, name in ((0, "side_a"), (1, "side_b")):
        driven = rings._replace(side=side, outputs=(f"x_lvdt_{'ab'[side]}",))
        of = declared_by_side("actuator", driven)
        names = [p.name for p in of.parameters]
        assert f"{name}.actuator.flow_gain" in names and "actuators.ring_stiffness" in names
        assert of.sides[names.index("actuators.ring_stiffness")] == BOTH
        assert of.sides[names.index(f"{name}.actuator.flow_gain")] == side
        effects = {e.name: e for e in of.effects}
        assert {f"{name}.valve_null_bias", "side_a.lvdt_bias", "side_b.lvdt_bias"} <= effects.keys()
        other = f"side_{'ba'[side]}"
        assert f"{other}.valve_null_bias" not in effects
        assert effects[f"{name}.lvdt_bias"].family == "lvdt_bias" and effects["aero_load"].family == ""
        few = declared_by_side("actuator", driven._replace(laws=(f"{name}.valve_null_bias",)))
        assert [e.name for e in few.effects] == [f"{name}.valve_null_bias"]
        assert few.sides.tolist()[-1] == side and len(few.rows) == len(few.si) == len(few.sides)
        none = declared_by_side("actuator", driven._replace(present=("lvdt_bias",)))
        assert not any("lvdt_bias" in e.name for e in none.effects)


def test_a_set_moves_the_lane_of_its_side_and_what_is_of_both_moves_both(rings: Driven) -> None:
    driven = rings._replace(laws=("lvdt_bias", "side_a.lvdt_bias", "side_b.lvdt_bias"))
    of = declared_by_side("linkage", driven)
    neutral = np.array([p.value for p in (*of.parameters, *(p for e in of.effects for p in e.parameters))])
    assert [e.name for e in of.effects] == list(driven.laws or ()) and of.sides.tolist()[-3:] == [BOTH, 0, 1]
    thetas = np.repeat(neutral[None], 4, axis=0)
    thetas[1, -3], thetas[2, -2], thetas[3, -1] = 0.5, 0.25, -0.125
    row, si = int(of.rows[-1]), float(of.si[-1])
    a, b = lanes_by_side(driven, thetas, of)
    assert a[row] == pytest.approx(np.array([0.0, 0.5, 0.25, 0.0]) * si)
    assert b[row] == pytest.approx(np.array([0.0, 0.5, 0.0, -0.125]) * si)
    play = [p.name for p in of.parameters].index("linkage.vigv_play")
    thetas[:, play] *= 1.5
    for lane in lanes_by_side(driven, thetas, of):
        assert lane[of.rows[play]] == pytest.approx(1.5 * neutral[play] * of.si[play])
    (one,) = lanes_by_side(driven._replace(machine=MACHINE), thetas[:, : len(of.parameters)],
                           declared_by_side("linkage", driven._replace(machine=MACHINE, laws=())))  # fmt: skip
    assert one.shape == (len(MACHINE.p), 4)


def test_a_play_is_known_at_the_vane_and_used_at_the_ring(rings: Driven) -> None:
    driven = rings._replace(machine=MACHINE, laws=())
    of = declared_by_side("linkage", driven)
    nominal = {n.name: n for n in MACHINE.nominal}
    for vane in range(len(MACHINE.vanes)):
        name = f"linkage.{MACHINE.vanes[vane]}_play"
        k = [p.name for p in of.parameters].index(name)
        ldp, lever = MACHINE.lever(vane)
        assert of.si[k] == pytest.approx(nominal[name].si * lever / ldp)
        assert of.parameters[k].output == MACHINE.vanes[vane]
        assert MACHINE.p[of.rows[k], 0] == pytest.approx(of.parameters[k].value * of.si[k])


def test_each_actuator_feels_the_rings_as_far_as_the_strokes_differ(rings: Driven) -> None:
    """Where the other stroke is that of the piston without rings, they push nothing, however stiff they are."""
    for side in (0, 1):
        name = f"x_lvdt_{'ab'[side]}"
        apart = actuator_stage(rings._replace(side=side, outputs=(name,)))
        assert apart.name == f"actuator_{'ab'[side]}" and f"side_{'ab'[side]}.valve_flow_saturation" in apart.alike
        theta = apart.neutral()
        theta[[p.name for p in apart.parameters].index("actuators.ring_stiffness")] *= 1e-6
        pushed, free = (apart.run(x[None])[0, 0] for x in (apart.neutral(), theta))
        alike = rings.columns | dict.fromkeys(("x_lvdt_a", "x_lvdt_b", "x_lvdt"), free)
        one = actuator_stage(rings._replace(side=side, outputs=(name,), columns=alike))
        first = slice(round(apart.window / 0.01) - 5)  # at the next window the piston jumps to where it was seen
        assert one.run(one.neutral()[None])[0, 0][first] == pytest.approx(free[first], abs=2e-3)
        assert np.abs(pushed - free).max() > 1e-3
        blind = {k: v for k, v in rings.columns.items() if k in (name, "i_cmd", "n_r", "p_s", "t_oil", "missing")}
        without = actuator_stage(rings._replace(side=side, outputs=(name,), columns=blind))  # one stroke alone
        assert without.run(without.neutral()[None])[0, 0] == pytest.approx(free, abs=1e-3)


# ---- a stroke between its rows ---------------------------------------------------------------------------------------


def test_midpoints_stand_half_way_between_rows() -> None:
    rows = np.array([[1.0, 3.0, 4.0], [0.0, -2.0, 8.0]])
    assert _with_midpoints(rows).tolist() == [[1.0, 2.0, 3.0, 3.5, 4.0], [0.0, -1.0, -2.0, 3.0, 8.0]]
    assert _with_midpoints(np.array([7.0])).tolist() == [7.0] and _with_midpoints(np.zeros(0)).shape == (0,)


@pytest.mark.parametrize("at", [2.2, 3.5, 4.9])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_corner_between_two_rows_has_its_peak_and_a_parabola_less_of_the_way(at: float, sign: float) -> None:
    n = np.arange(8.0)
    x = sign * np.where(n < at, 2.0 * (n - at), -0.5 * (n - at))
    rows, k = int(at), 2 * int(at) + 1
    corner = _with_reversals(x, 1.0)
    assert corner[k] == pytest.approx(0.0, abs=1e-12) and corner[::2] == pytest.approx(x)
    farther = max(sign * x[rows], sign * x[rows + 1]) * sign
    assert _with_reversals(x, 0.0)[k] == pytest.approx(farther)
    share = np.arange(7.0) / 10.0  # one for each pair of rows
    assert _with_reversals(x, share)[k] == pytest.approx((1.0 - share[rows]) * farther)
    others = [i for i in range(1, 15, 2) if i != k]
    assert corner[others] == pytest.approx(_with_midpoints(x)[others])


def test_a_stroke_that_stops_or_goes_on_does_not_turn() -> None:
    for x in ([5.0, 5.0, 5.0, 4.5, 3.5, 2.5], [0.0, 1.0, 2.0, 4.0, 7.0, 9.0], [3.0, 3.0, 3.0, 3.0, 3.0, 3.0]):
        assert _with_reversals(np.array(x), 1.0).tolist() == _with_midpoints(np.array(x)).tolist()
    # where the two lines meet outside the pair of rows nothing turned between them
    jump = np.array([0.0, 1.0, 2.0, 4.0, 3.0, 2.0, 1.0])
    for x in (jump, jump[::-1].copy(), -jump, -jump[::-1]):
        assert _with_reversals(x, 1.0).tolist() == _with_midpoints(x).tolist()


def test_values_of_an_earlier_row_lie_on_straight_lines_and_end_with_the_log() -> None:
    n = np.arange(50.0)
    values = np.array([2.0 * n, 5.0 - n])
    late = np.where(n < 25, 2.5, -1.25)
    wanted = np.clip(n - late, 0.0, 49.0)
    assert _earlier(values, late) == pytest.approx(np.array([2.0 * wanted, 5.0 - wanted]))


# ---- small subsystems of the machine ---------------------------------------------------------------------------------


def stroke_log(n: int = 900, dt: float = DT) -> tuple[Array, dict[str, Array]]:
    """A stroke with two swings, constant speed and oil that warms up."""
    t = dt * np.arange(n)
    x = 20.0 + 6.0 * np.sin(0.9 * t) + 1.5 * np.sin(2.6 * t)
    whole = np.zeros(n, dtype=int)
    c = {
        "x_lvdt": x, "n_r": np.full(n, 70.0), "t_oil": 40.0 + 8.0 * (1.0 - np.exp(-t / 4.0)), "p_s": np.full(n, 21.0),
        "stretch": whole, "spell": whole, "machine_spell": whole, "missing": np.zeros(n), "fresh": np.ones(n),
    }  # fmt: skip
    return t, c


def rings_of(t: Array, c: dict[str, Array], outputs: tuple[str, ...] = MACHINE.vanes, **more: Any) -> Stage:
    columns = {v: np.zeros(len(t)) for v in outputs} | c
    return linkage_stage(Driven(t, columns, MACHINE, CALIBRATION, outputs, np.ones(len(t), dtype=bool), (), **more))


def test_vane_angles_of_some_outputs_are_those_of_all() -> None:
    t, c = stroke_log()
    three = rings_of(t, c)
    angles = three.run(three.neutral()[None])[0]
    assert angles.shape == (3, len(t)) and three.units == ("deg", "deg", "deg")
    columns = c | {v: a + 0.0 for v, a in zip(MACHINE.vanes, angles, strict=True)}
    for some in (("vigv", "vgv2"), ("vgv1",)):
        stage = rings_of(t, columns, some)
        out = stage.run(stage.neutral()[None])[0]
        which = [MACHINE.vanes.index(v) for v in some]
        assert out[:, 300:] == pytest.approx(angles[which][:, 300:], abs=1e-9)
        assert stage.measured.shape == out.shape


def test_rings_begin_where_their_angles_are_read_and_one_that_begins_later_in_the_middle_of_its_play() -> None:
    t, c = stroke_log()
    still = c | {"x_lvdt": np.full(len(t), 20.0)}
    nobody = {v: np.full(len(t), np.nan) for v in MACHINE.vanes}
    centre = rings_of(t, still | nobody)
    middle = centre.run(centre.neutral()[None])[0]
    for off in (0.03, -0.03):  # nothing moves, so that a ring stays where it began, within its play
        near = dict(zip(MACHINE.vanes, middle + off, strict=True))
        began = rings_of(t, still | near)
        assert began.run(began.neutral()[None])[0] == pytest.approx(middle + off, abs=1e-4)
        spike = {v: np.concatenate([[9.0, -9.0], a[2:]]) for v, a in near.items()}  # the median of five readings
        same = rings_of(t, still | spike)
        assert same.run(same.neutral()[None])[0] == pytest.approx(middle + off, abs=1e-4)
    for rows, begun in ((0, True), (99, True), (100, False)):  # within a window of 1 s, or later
        late = (np.arange(len(t)) >= rows).astype(float)
        one = rings_of(t, still | near | {"sampled vgv1": late})
        out = one.run(one.neutral()[None])[0]
        assert out[[0, 2]] == pytest.approx(middle[[0, 2]] - 0.03, abs=1e-4)
        assert out[1] == pytest.approx(middle[1] - 0.03 * begun, abs=1e-4)


def test_angles_that_stand_late_are_made_for_where_they_were() -> None:
    t, c = stroke_log()
    plain = rings_of(t, c)
    angles = plain.run(plain.neutral()[None])[0]
    columns = c | dict(zip(MACHINE.vanes, angles, strict=True))
    by = 0.023 + 1e-3 * t
    late = rings_of(t, columns | {VANES_LATE: by})
    again = rings_of(t, columns)
    wanted = [np.interp(t - by, t, a) for a in again.run(again.neutral()[None])[0]]
    assert late.run(late.neutral()[None])[0] == pytest.approx(np.array(wanted), abs=1e-9)


def test_time_and_oil_stand_for_each_other_in_the_linkage() -> None:
    t, c = stroke_log()
    stage = rings_of(t, c)
    turn_on_oil = {e.name for e in stage.effects if e.name in ("thermal_growth", "lvdt_thermal_drift")}
    assert turn_on_oil and set(stage.twins) == {"linkage_wear", *turn_on_oil}
    assert {name: of for name, (of, _) in stage.twins.items()} == {
        "linkage_wear": "oil temperature", **dict.fromkeys(turn_on_oil, "time"),
    }  # fmt: skip
    # of an oil that warms evenly both are one
    even = rings_of(t, c | {"t_oil": 40.0 + t})
    for name in even.twins:
        theta = even.neutral()
        theta[even.index()[name]] = even.effect(name).starts[-1]
        other = even.twins[name][1](theta[None])
        assert other == pytest.approx(even.run(theta[None]), abs=2e-3), name
        assert np.abs(even.run(theta[None]) - even.run(even.neutral()[None])).max() > 0.02, name


@pytest.mark.parametrize("digit", [0.0, 0.02])
def test_slow_rows_and_the_last_digit_of_a_stroke_are_errors_of_the_vanes(digit: float) -> None:
    t, c = stroke_log(500, 0.05)
    draws = 0.5 * digit * np.sign(white(3, 500, 4)) if digit else None
    stage = rings_of(t, c if draws is None else c | {STROKE_OFF: draws})
    assert stage.lost is not None and stage.lost.shape == (4, 3, 500) and stage.raster_error is not None
    again = rings_of(t, c, again=True)
    assert again.lost is None and again.raster_error is None
    # between rows of 50 ms the model's stroke runs straight, as a tenth of the raster would show it
    fine_t, fine = stroke_log(2500 - 4, 0.01)
    known = rings_of(fine_t, fine)
    by_fine = known.run(known.neutral()[None])[0][:, ::5]
    assert stage.run(stage.neutral()[None])[0] == pytest.approx(by_fine, abs=0.02)
    if digit:
        quick, _ = stroke_log(500)
        fast = rings_of(quick, c | {STROKE_OFF: draws})
        assert fast.lost is not None and np.std(fast.lost) > 0.0 and rings_of(quick, c).lost is None
        slope = np.gradient(by_fine[0], c["x_lvdt"])[100:-100]
        most = 0.5 * digit * np.sqrt(np.mean(slope**2))  # the play takes some of it
        assert 0.3 * most < np.std(fast.lost[:, 0, 100:-100]) < most


def test_the_play_is_known_once_the_stroke_has_crossed_it() -> None:
    t, c = stroke_log()
    small = np.clip(c["x_lvdt"], 19.0, 21.0)  # until 4 s it moves by less than 3 mm
    moves = np.where(t < 4.0, small, c["x_lvdt"])
    stage = rings_of(t, c | {"x_lvdt": moves})
    crossed = np.maximum.accumulate(moves) - np.minimum.accumulate(moves) > 3.0
    assert np.array_equal(np.isfinite(stage.measured[0]), crossed) and 0.3 < crossed.mean() < 0.7
    always = rings_of(t, c | {"x_lvdt": small})  # and where it never does, all counts
    assert np.isfinite(always.measured).all()
    back = np.repeat([0, 1], [600, 300])  # behind a spell of another mode the firmware settles first
    two = rings_of(t, c | {"machine_spell": back})
    again = c["x_lvdt"][900:] if len(t) > 900 else c["x_lvdt"]
    counts = np.isfinite(two.measured[0])
    assert not counts[600:900].any() and len(again) == 900  # 3 s


def test_a_motor_s_actuator_and_a_hydraulic_one_have_models_of_their_own_fineness() -> None:
    n = 600
    t = DT * np.arange(n)
    c = {"i_cmd": 5.0 * np.sin(2.0 * t), "x_lvdt": 20.0 - 2.0 * np.cos(2.0 * t), "n_r": np.full(n, 70.0),
         "p_s": np.full(n, 21.0), "t_oil": np.full(n, 40.0), "missing": np.zeros(n)}  # fmt: skip

    def of(**more: Any) -> Stage:
        driven = Driven(t, c, MACHINE, CALIBRATION, ("x_lvdt",), np.ones(n, dtype=bool), ())
        return actuator_stage(driven._replace(**more))

    plain = of()
    assert plain.raster_error == pytest.approx([4e-4]) and plain.unlogged is None and plain.hidden is None
    as_is = plain.run(plain.neutral()[None])[0]
    # one standard deviation more of a pressure, or an oil, that nobody logged
    assumed = of(assumed={"p_s": 1.2, "t_oil": 2.3})
    assert assumed.unlogged is not None and assumed.unlogged.shape == (2, 1, n)
    for k, more in enumerate(({"p_s": c["p_s"] + 1.2}, {"t_oil": c["t_oil"] + 2.3})):
        moved = of(columns=c | more)
        assert assumed.unlogged[k] == pytest.approx(moved.run(moved.neutral()[None])[0] - as_is, abs=1e-12)
    (alone,) = of(assumed={"p_s": 1.2}).unlogged
    assert alone == pytest.approx(assumed.unlogged[0]) and np.abs(alone).max() > 1e-3
    # of slow rows steps of 2 ms; a stroke that starts anew in each window
    slow = Driven(5.0 * t, c, MACHINE, CALIBRATION, ("x_lvdt",), np.ones(n, dtype=bool), ())
    stage = actuator_stage(slow)
    starts = np.arange(0, n, 20)
    assert stage.run(stage.neutral()[None])[0, 0, starts] == pytest.approx(c["x_lvdt"][starts], abs=0.6)
    assert stage.finer is not None
    assert np.abs(stage.finer(stage.neutral()[None]) - stage.run(stage.neutral()[None])).max() < 0.05


def test_the_last_digit_of_a_demand_is_an_error_of_the_speed() -> None:
    n, step = 900, 0.5
    t = DT * np.arange(n)
    smooth = 75.0 + 8.0 * np.sin(0.7 * t)
    c = {"n_dem": np.round(smooth / step) * step, "n_r": smooth, "stretch": np.zeros(n, dtype=int)}
    driven = Driven(t, c, MACHINE, CALIBRATION, ("n_r",), np.ones(n, dtype=bool), (), digits={"n_dem": step})
    stage = engine_stage(driven)
    assert stage.lost is not None and stage.lost.shape == (4, 1, n) and stage.raster_error is not None
    drawn = last_digit(c["n_dem"], step)(np.random.default_rng(0))
    other = engine_stage(driven._replace(columns=c | {"n_dem": c["n_dem"] + drawn}, again=True))
    change = other.run(other.neutral()[None])[0] - stage.run(stage.neutral()[None])[0]
    assert stage.lost[0] == pytest.approx(change, abs=1e-9) and np.std(change) > 0.02
    assert other.lost is None and engine_stage(driven._replace(digits={})).lost is None
    assert stage.raster_error[0] < np.sqrt(np.mean(stage.lost**2)) + 1e-9


def test_what_of_draws_is_not_seen_as_noise_counts_as_the_raster_s() -> None:
    t = DT * np.arange(4000)
    slow, quick = np.sin(0.8 * t), 0.3 * white(1, 4, 4000)
    for draws, beyond in ((quick, 0.0), (quick + slow, np.sqrt(0.5))):
        measured = np.zeros((1, 4000))
        stage = Stage("s", ("y",), ("mm",), (), (), lambda p: np.zeros((len(p), 1, 4000)), t, measured)
        expect_draws(stage, draws[:, None])
        assert stage.raster_error == pytest.approx([beyond], abs=0.06) and stage.lost is not None
        assert np.array_equal(stage.lost[:, 0], draws)
    half = measured.copy()
    half[0, :2000] = np.nan  # where nothing is measured nothing is expected
    part = Stage("s", ("y",), ("mm",), (), (), lambda p: np.zeros((len(p), 1, 4000)), t, half)
    expect_draws(part, (quick + np.where(t < 20.0, 9.0, 1.0) * slow)[:, None])
    assert part.raster_error == pytest.approx([np.sqrt(0.5)], abs=0.06)


# ---- channels on their raster ----------------------------------------------------------------------------------------


def test_the_raster_begins_and_ends_with_what_the_subsystems_have() -> None:
    t = DT * np.arange(6001)
    few = (t[:3], t[:3])
    # a channel that no subsystem needs moves nothing, nor one of a few samples
    log = log_of(t, x_lvdt=np.sin(t), vigv=np.sin(t), n_dem=(t[2000:], t[2000:]), p_s=few)
    g = grid_of(log)
    assert (g.start, g.rows) == (0.0, 6001) and g.known["n_dem"] == (2000, 6001) and "p_s" not in g.known
    assert "linkage" not in g.known and "demand" not in g.known
    # without a subsystem the channels say where the log begins
    only = grid_of(log_of(n_dem=(t[100:500], t[100:500]), i_cmd=(t[150:550], t[150:550])))
    assert only.start == pytest.approx(1.5) and only.rows == 350 and not only.known
    # vanes together begin with the first of them and end with the last
    vanes = grid_of(log_of(t, x_lvdt=np.sin(t), vigv=(t[1000:3000], t[1000:3000]), vgv1=(t[2000:5000], t[2000:5000])))
    assert (vanes.start, vanes.rows) == (10.0, 4000)
    assert vanes.known["vigv"] == (0, 2000) or "vigv" in vanes.known
    assert vanes.known["vgv1"] == (1000, 4000)
    # what begins later does so with a whole window: 7.01 s with that of 8 s, 8 s with itself
    for row, begins in ((701, 800), (800, 800), (801, 900), (99, 0)):
        late = grid_of(log_of(t, x_lvdt=np.sin(t), vigv=np.sin(t), p_s=(t[row:], t[row:])))
        assert late.rows_of("p_s")[0] == begins or row == 99, row
    slow = grid_of(log_of(0.014 * np.arange(900), n_dem=np.ones(900), n_r=np.ones(900)))
    assert slow.dt == 0.01 and slow.window == 100
    assert set(slow.digits) == {"n_dem", "n_r"}


def test_pieces_of_a_subsystem_are_cut_to_its_rows() -> None:
    g = Grid(0.0, DT, 1000, {}, {"servo": (200, 800)})
    assert g.pieces_of("servo") == ((200, 800),) and g.pieces_of("engine") == ()
    assert g.pieces_of("servo", [(0, 200), (200, 300), (700, 900), (800, 1000)]) == ((200, 300), (700, 800))
    assert g.pieces_of("servo", [(0, 200)]) is None and g.pieces_of("engine", [(3, 9)]) == ((3, 9),)
    assert Grid(0.0, 3.0, 9, {}).window == 1


def test_rows_stand_where_the_samples_of_the_controller_do() -> None:
    t = DT * np.arange(1000)
    grid = Grid(5.0, DT, 900, {})
    for off in (0.0, 0.004, -0.003):
        log = log_of(5.0 + t + off, n_r=np.sin(t), x_lvdt=np.sin(t))
        assert first_row(log.channels, grid) == pytest.approx(5.0 + off, abs=1e-9)
    slow = log_of(5.0 + 0.05 * np.arange(200) + 0.011, n_r=np.zeros(200))
    assert first_row(slow.channels, grid._replace(dt=0.05)) == pytest.approx(5.011)
    fast = log_of(5.0 + 0.001 * np.arange(9000) + 4e-4, n_r=np.zeros(9000))
    assert first_row(fast.channels, grid) == 5.0  # every tick has its sample
    jitter = log_of(5.0 + t * 1.001 + 0.004, n_r=np.zeros(1000))  # a clock that is off by a thousandth adds up
    assert abs(first_row(jitter.channels, grid) - 5.0) < 0.5 * DT


def test_the_samples_of_a_piece_have_the_next_one_on_either_side() -> None:
    c = Channel(np.arange(10.0), 2.0 * np.arange(10.0), True)
    assert _between(c, 2.5, 5.5).t.tolist() == [2.0, 3.0, 4.0, 5.0, 6.0] and _between(c, 2.5, 5.5).framed
    assert _between(c, 3.0, 5.0).t.tolist() == [2.0, 3.0, 4.0, 5.0] and _between(c, -4.0, 0.5).t.tolist() == [0.0, 1.0]
    assert _between(c, 7.5, 99.0).values.tolist() == [14.0, 16.0, 18.0]


def test_another_clock_s_samples_stand_between_the_rows_and_a_jitter_about_them() -> None:
    t = DT * np.arange(3000)
    for off, between in ((0.0, False), (0.0009, False), (0.0011, True), (0.005, True), (-0.0011, True)):
        assert _between_rows(Channel(t + off, t), t, DT) == between, off
    jitter = t + 8e-4 * np.clip(white(1, 3000), -3.0, 3.0)
    assert not _between_rows(Channel(jitter, t), t, DT)
    assert _between_rows(Channel(t * 1.0005, t), t, DT)  # through all phases
    assert not _between_rows(Channel(t + 99.0, t), t, DT)  # nothing near: nothing to tell


def test_a_channel_that_stands_for_rows_came_in_frames() -> None:
    t = 0.002 * np.arange(2000)
    steps = np.floor(t / DT + 1e-9)
    assert _held(Channel(t, steps), 0.002, DT) and not _held(Channel(t, t), 0.002, DT)
    assert not _held(Channel(t, steps), 0.007, DT)  # no faster than the raster
    assert not _held(Channel(t, np.floor(t / 0.006 + 1e-9)), 0.002, DT)  # a change every third sample


@pytest.mark.parametrize("phase", [0.0, 0.002, 0.006])
def test_the_next_frame_of_the_controller_is_told_by_the_demand_s_steps(phase: float) -> None:
    t = 3.0 + 0.002 * np.arange(2000)
    frames = np.floor((t - 3.0 - phase) / DT + 1e-6)
    steps = {"x_dem": 0.002, "n_dem": 0.002}
    for name in steps:
        channels = {name: Channel(t, frames)}
        assert _to_frame(channels, steps, 3.0, DT) == pytest.approx(phase, abs=1e-9) or phase == 0.0
        assert _to_frame(channels, steps, 3.001, DT) == pytest.approx((phase - 0.001) % DT, abs=1e-9)
    both = {"x_dem": Channel(t, 0.0 * t), "n_dem": Channel(t, frames)}  # the stroke demand stands still
    assert _to_frame(both, steps, 3.0, DT) == pytest.approx(phase % DT, abs=1e-9) or phase == 0.0
    irregular = np.cumsum(np.random.default_rng(1).random(2000) < 0.2)
    assert _to_frame({"x_dem": Channel(t, irregular.astype(float))}, steps, 3.0, DT) == 0.0
    few = np.where(t < 3.1, frames, 0.0)
    assert _to_frame({"x_dem": Channel(t, few)}, steps, 3.0, DT) == 0.0 == _to_frame({}, steps, 3.0, DT)


def test_a_frame_behind_a_low_pass_is_read_just_before_the_next_one() -> None:
    t, when = 0.002 * np.arange(4000), DT * np.arange(790)
    for first in range(5):  # the sample behind the row at which the frame's step begins
        sent = white(3, 900)[((t / 0.002 + 5 - first) // 5).astype(int)]
        for lag, waits in ((1, 4), (2, 4)):
            values = np.convolve(sent, np.ones(lag) / lag)[: len(t)]
            wanted = ((first + waits) % 5) * 0.002
            assert _settled(Channel(t, values), when, 0.002, DT) == pytest.approx(wanted), (first, lag)
    assert _settled(Channel(t, white(1, 4000)), when, 0.002, DT) == 0.0  # every sample its own
    assert _settled(Channel(t, sent), when, 0.004, DT) == 0.0 == _settled(Channel(t, sent), when[:1], 0.002, DT)


def test_a_gap_is_between_samples_and_before_the_first_there_is_none() -> None:
    t = DT * np.arange(2000)
    kept = (t > 4.5) & ((t < 9.0) | (t >= 9.5))
    log = log_of(t, x_lvdt=np.sin(t), i_cmd=np.sin(t), x_dem=np.sin(t), n_dem=np.sin(t), n_r=(t[kept], np.sin(t[kept])))
    grid = grid_of(log)
    assert grid.start == 0.0 and grid.rows_of("n_r") == (500, 2000)
    rows, columns, gaps, _ = on_raster(log, grid)
    assert set(gaps.far) == {"n_r"} == set(gaps.lost)
    assert np.flatnonzero(gaps.lost["n_r"])[[0, -1]].tolist() == [900, 949]
    assert np.flatnonzero(gaps.far["n_r"])[[0, -1]].tolist() == [901, 948]
    # a demand holds its value, but in its gaps lines are as likely
    slow = (t >= 6.0) & (t < 6.5)
    held = log_of(t, x_lvdt=np.sin(t), vigv=np.sin(t), n_r=np.sin(t), n_dem=(t[~slow], 3.0 * t[~slow]))
    line = on_raster(held, grid_of(held))[1]["n_dem"]
    assert line == pytest.approx(3.0 * t, abs=1e-9)


def test_a_current_of_every_other_tick_misses_samples_where_a_quarter_of_a_row_lacks() -> None:
    ticks, t = 0.002 * np.arange(5001), DT * np.arange(1001)
    i = 10.0 * ticks
    kept = np.ones(5001, dtype=bool)
    kept[[1001, 1503, 1504]] = False  # one of five, and two
    log = log_of(i_cmd=(ticks[kept], i[kept]), x_lvdt=(t, np.sin(t)), n_r=(t, t))
    _, columns, gaps, _ = on_raster(log, grid_of(log))
    assert columns["i_cmd"][1:] == pytest.approx(10.0 * t[1:] - 0.04, abs=0.011)
    assert np.flatnonzero(gaps.lost["i_cmd"]).tolist() == [0, 301] and not gaps.far["i_cmd"].any()
    # the row of whose samples too few are there has the mean of its ten ticks on straight lines
    assert columns["i_cmd"][301] == pytest.approx(np.interp(3.01 - 0.001 * np.arange(10), ticks, i).mean())
    assert columns["i_cmd"][201] == pytest.approx(np.mean(i[1002:1006]))


# ---- which current a slow logger has ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("what", "found"), [("mean", ""), ("line", "the current at single ticks"), ("held", "the current from each row on")]
)
def test_a_slow_current_is_told_by_the_stroke_that_it_moves(what: str, found: str) -> None:
    n, dt = 700, 0.05
    t, columns = dt * np.arange(n), stroke_log(n, dt)[1]
    i = 6.0 * np.sin(1.3 * t) + 3.0 * np.sin(4.0 * t + 1.0)
    mean = {"mean": i, "line": 0.5 * (i + np.concatenate([i[:1], i[:-1]])), "held": np.concatenate([i[:1], i[:-1]])}
    driven = Driven(t, columns | {"i_cmd": mean[what]}, MACHINE, CALIBRATION, ("x_lvdt",), np.ones(n, dtype=bool), ())
    truth = actuator_stage(driven)
    for noise in (1e-3, 3e-5):  # also where the stroke has hardly any noise
        x = truth.run(truth.neutral()[None])[0, 0]
        at = x + noise * white(4, n)
        logged = driven._replace(columns=columns | {"x_lvdt": at, "i_cmd": i})
        assert _slow_current(logged) == found, noise


# ---- small logs of a simulated machine -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small() -> Log:
    t = DT * np.arange(800)
    run = lockstep(Stimulus.of(75.0 + 12.0 * np.sin(0.9 * t) + 2.0 * np.sin(2.3 * t)), seed=1, hashed=False)
    return Log("a.csv", {k: Channel(run.t, v) for k, v in run.columns.items() if k not in ("t", "n_engine", "i_motor")})


def only(log: Log, *names: str, **more: Any) -> Log:
    t = log["n_dem"].t
    made = {k: v if isinstance(v, Channel) else Channel(t, v) for k, v in more.items()}
    return Log("a.csv", {k: log.channels[k] for k in names} | made)


def driven_of(stage: Stage) -> Driven:
    return stage.made.driven  # type: ignore[attr-defined, no-any-return]


def test_what_nobody_logged_has_its_usual_value_and_the_spread_of_its_tolerance(small: Log) -> None:
    log = only(small, "i_cmd", "x_lvdt", "n_r")
    chain = build_chain(log, late={})
    assert [str(n) for n in chain.notes] == [
        f"{n}: not logged; {v} assumed, and effects that need it to change cannot be seen"
        for n, v in (("p_s", "21 MPa"), ("t_oil", "40 degC"))
    ]
    driven = driven_of(chain.stage("actuator"))
    assert driven.assumed == pytest.approx({"p_s": 2.1 / 3.0**0.5}) or driven.assumed == pytest.approx(
        {n: v / 3.0**0.5 for n, v in MACHINE.usual_within.items() if v}
    )
    assert set(driven.columns["p_s"]) == {21.0} and set(driven.columns["t_oil"]) == {40.0}
    assert chain.not_observed == {
        "demand": "no n_dem", "servo": "no x_dem", "engine": "no n_dem",
        "linkage": f"no {', '.join(v for v in VANES if v in MACHINE.vanes)}",
    }  # fmt: skip
    regimes, units = chain.stages[0].regimes, chain.stages[0].regime_units
    assert set(regimes) == set(units) >= {"time", "stroke", "direction", "rotor speed", "current"}
    assert units["stroke"] == "mm" and np.ptp(regimes["stroke"]) > 1.0
    whole = build_chain(only(small, "i_cmd", "x_lvdt", "n_r", "p_s", "t_oil"), late={})
    assert whole.notes == [] and driven_of(whole.stage("actuator")).assumed == {}


def test_a_law_of_the_machine_may_be_of_what_follows_from_the_stroke(small: Log) -> None:
    def machine(of: str) -> Any:
        law = Learned(how="adds", at="valve.current", of=of, low=-90.0, high=90.0, values=[0.2] * 4,
                      knots=[-90.0] * 4 + [90.0] * 4)  # fmt: skip
        return Model(curves={"law": law}, effects={"law": {}}).plant(MACHINE)

    log = only(small, "i_cmd", "x_lvdt", "n_r")
    for of in ("speed_of_x_lvdt",):
        assert [s.name for s in build_chain(log, machine(of), late={}).stages] == ["actuator"]
    for of in ("vigv",):
        with pytest.raises(LogError, match=f"^a.csv: has no {of}, of which a learned law of the model is a function$"):
            build_chain(log, machine(of), late={})
    rings = only(small, "n_dem", "n_r")
    with pytest.raises(LogError, match="has no speed_of_x_lvdt, of which"):
        build_chain(rings, machine("speed_of_x_lvdt"), late={})


def test_half_of_a_log_in_mode_run_is_mostly(small: Log) -> None:
    t = small["n_dem"].t
    for many, mostly in ((250, True), (249, False)):  # of the 500 rows that have settled
        run = np.where(np.arange(800) >= 800 - many, 2.0, 1.0)
        chain = build_chain(only(small, "n_dem", "n_r", state=run), late={})
        said = [str(n) for n in chain.notes]
        assert ("judged in all modes" in " ".join(said)) != mostly, many
    assert said[0].startswith("state: mode RUN in 50% of the log") and len(t) == 800


def test_two_actuators_of_a_log_have_their_own_strokes_and_moods() -> None:
    t = DT * np.arange(700)
    run = lockstep(Stimulus.of(75.0 + 12.0 * np.sin(0.9 * t)), plant=TWO, seed=1, hashed=False)
    channels = {k: Channel(run.t, v) for k, v in run.columns.items() if k not in ("t", "n_engine", "i_motor")}
    log = Log("two", {k: c for k, c in channels.items() if k in ("i_cmd", "x_lvdt_a", "x_lvdt_b", "vigv", "n_r")})
    chain = build_chain(log, TWO)
    assert [s.name for s in chain.stages] == ["actuator_a", "actuator_b", "linkage"]
    assert set(chain.not_observed) == {"demand", "servo", "engine"} and not any("both at the mean" in n
                                                                               for n in chain.notes)  # fmt: skip
    for side, stage in enumerate(chain.stages[:2]):
        driven, own = driven_of(stage), f"x_lvdt_{'ab'[side]}"
        assert driven.side == side and stage.outputs == (own,) and driven.both is not None
        smooth = driven.both[side]
        assert smooth is driven.columns[f"stroke_{'ab'[side]}"]
        error = smooth - log[own].values
        assert 0.0 < np.std(error[300:]) < 0.02 and abs(error[300:].mean()) < 5e-3
        e = stage.run(stage.neutral()[None])[0] - stage.measured
        assert np.all(rms(stage, e) < 2.0 * np.asarray(stage.floor)), stage.name
    alone = build_chain(Log("one", {k: c for k, c in log.channels.items() if k != "x_lvdt_b"}), TWO)
    assert any("x_lvdt_b: not logged" in n for n in alone.notes)


def test_a_slow_log_adds_what_its_rows_lose_to_what_else_is_lost(small: Log) -> None:
    t = 0.05 * np.arange(600)
    run = lockstep(Stimulus.of(np.interp(DT * np.arange(3000), t, 75.0 + 8.0 * np.sin(0.9 * t))), seed=1, hashed=False)
    log = Log("slow", {k: Channel(run.t[::5], run.columns[k][::5]) for k in ("x_lvdt", "vigv", "n_r", "t_oil")})
    stage = build_chain(log, late={}).stage("linkage")
    driven = driven_of(stage)
    one = linkage_stage(driven)
    assert stage.lost is not None and one.lost is not None and one.raster_error is not None
    more = stage.lost - one.lost  # one error more of every draw: each of a row that the doubled raster has, twice
    assert np.array_equal(more[0], more[1], equal_nan=True) or np.allclose(more[0], more[1])
    assert np.allclose(more[0][:, 0:-1:2], more[0][:, 1::2]) and np.any(more[0] != 0.0)
    assert np.all(stage.raster_error >= one.raster_error)  # type: ignore[operator]


def test_a_subsystem_of_too_few_rows_says_so_and_the_others_are_judged(small: Log) -> None:
    p_s = Channel(small["p_s"].t[:400], small["p_s"].values[:400])
    chain = build_chain(only(small, "n_dem", "n_r", "i_cmd", "x_lvdt", p_s=p_s), late={})
    assert [s.name for s in chain.stages] == ["engine"] and chain.not_observed["actuator"] == (
        "400 samples of 0.01 s; at least 500 are needed to search for missing physics"
    )
    driven = driven_of(build_chain(only(small, "i_cmd", "x_lvdt", "n_r"), late={}).stage("actuator"))
    speed = driven.quantity("speed_of_x_lvdt")
    assert speed is not None and np.corrcoef(speed, np.gradient(driven.columns["x_lvdt"], DT))[0, 1] > 0.98


def test_the_machine_counts_in_mode_run_and_its_current_once_the_firmware_has_caught_up(small: Log) -> None:
    state = np.where(np.arange(800) >= 100, 2.0, 1.0)
    chain = build_chain(only(small, "n_dem", "n_r", "i_cmd", "x_lvdt", "x_dem", state=state), late={})
    first = {s.name: int(np.flatnonzero(np.isfinite(s.measured).any(axis=0))[0]) for s in chain.stages}
    assert first["engine"] == 300 and first["actuator"] == first["servo"] == 400 and first["demand"] >= 400


def test_a_linkage_without_noise_is_known_to_what_its_simpler_model_leaves(small: Log) -> None:
    names = ("x_lvdt", "n_r", "t_oil")
    noisy = build_chain(only(small, *names, *MACHINE.vanes), late={}).stage("linkage")
    exact = dict(zip(noisy.outputs, noisy.run(noisy.neutral()[None])[0], strict=True))
    stage = build_chain(only(small, *names, **exact), late={}).stage("linkage")
    assert stage.floor == pytest.approx([np.hypot(1e-3, 2e-3)] * 3, rel=0.2) and stage.raster_error is not None
    assert stage.raster_error == pytest.approx([2e-3] * 3, rel=0.2)
    assert noisy.raster_error is None or np.all(noisy.raster_error < 2e-3)
    assert set(stage.alike) == {"pot_gain", "pot_lag"}


def test_rings_of_two_actuators_begin_where_their_angles_are_read() -> None:
    n = 300
    t, whole = DT * np.arange(n), np.zeros(n, dtype=int)
    c = {
        "x_lvdt_a": np.full(n, 20.0), "x_lvdt_b": np.full(n, 26.0), "x_lvdt": np.full(n, 23.0), "n_r": np.full(n, 70.0),
        "t_oil": np.full(n, 40.0), "stretch": whole, "machine_spell": whole, "missing": np.zeros(n),
    }  # fmt: skip

    def of(**vanes: Array) -> Array:
        driven = Driven(t, c | vanes, TWO, CALIBRATION, TWO.vanes, np.ones(n, dtype=bool), ())
        stage = linkage_stage(driven)
        return np.asarray(stage.run(stage.neutral()[None])[0])

    settled = of(**{v: np.full(n, np.nan) for v in TWO.vanes})[:, -1:]
    middle = np.repeat(settled, n, axis=1)
    for off in (0.0, 0.02):
        out = of(**dict(zip(TWO.vanes, middle + off, strict=True)))
        assert out == pytest.approx(middle + off, abs=1e-3)
    alike = c | {"x_lvdt_b": c["x_lvdt_a"]}
    one = linkage_stage(Driven(t, alike | {v: np.full(n, np.nan) for v in TWO.vanes}, TWO, CALIBRATION, TWO.vanes,
                               np.ones(n, dtype=bool), ()))  # fmt: skip
    apart = one.run(one.neutral()[None])[0]
    assert np.abs(middle - apart).max() > 0.05  # 6 mm at B move the vanes


def test_a_small_way_back_is_no_turn() -> None:
    t = DT * np.arange(3000)
    for share, turns in ((0.5, False), (3.0, True)):
        back = share * TURN * 48.0
        x = np.interp(t, [0, 10, 12, 14, 30], [5.0, 15.0, 15.0 - back, 15.0, 31.0])
        way = reversals(t, x, 48.0)["distance_since_reversal_of_x_lvdt"]
        assert way[2500] == pytest.approx((11.0 + back) if turns else 21.0, abs=0.3)


def test_a_frame_of_three_samples_tells_where_it_settles_and_one_of_two_does_not() -> None:
    t = DT / 3.0 * np.arange(3000)
    sent = white(3, 1002)[(np.arange(3000) + 2) // 3]  # a step a sample behind the row
    when = DT * np.arange(990)
    assert _settled(Channel(t, sent), when, DT / 3.0, DT) == pytest.approx(0.0, abs=1e-9)
    later = white(3, 1002)[(np.arange(3000) + 1) // 3]
    assert _settled(Channel(t, later), when, DT / 3.0, DT) == pytest.approx(DT / 3.0)
    two = white(3, 2000)[(np.arange(3000) + 1) // 2]
    assert _settled(Channel(0.005 * np.arange(3000), two), when, 0.005, DT) == 0.0


def test_a_machine_with_one_valve_or_two_channels_is_not_judged(small: Log) -> None:
    p = TWO.p.copy()
    p[LINE_CONDUCTANCE] = 1.0
    with pytest.raises(LogError, match="^a.csv: actuators.feed \\(='one valve'\\) must be 'a valve each' for judging"):
        build_chain(small, replace(TWO, p=p), late={})
    twin = CALIBRATION._replace(channels=SimpleNamespace())
    with pytest.raises(LogError, match="^a.csv: channels.number \\(=2\\) must be 1 for judging subsystems"):
        build_chain(small, MACHINE, twin, late={})


def test_delays_of_frames_are_not_tried_beside_a_clock_that_looks_alike(small: Log) -> None:
    log = only(small, "n_dem", "n_r", "x_dem")

    def names(late: dict[str, tuple[Late, ...]]) -> set[str]:
        return {e.name for e in build_chain(log, late=late).stage("demand").effects}

    every = names({})
    assert {"can_delay", "frame_hold", "schedule_error"} <= every
    assert names({"demand": (Late(("n_r",), 0.01),)}) == every - {"can_delay", "frame_hold"}
    assert names({"demand": (Late(("n_r",), 0.0, zero=0.1),)}) == every  # a zero delays nothing
    assert names({"engine": (Late(("n_dem",), 0.01),)}) == every


def test_stroke_and_vanes_behind_a_low_pass_are_driven_by_the_stroke_before_it(small: Log) -> None:
    passed = LowPass("second order", 0.03)
    log = only(small, "x_lvdt", "n_r", "t_oil", *MACHINE.vanes)
    late = {"linkage": (Late(("x_lvdt", *MACHINE.vanes), 0.0, passed=passed),)}
    stage = build_chain(log, late=late).stage("linkage")
    driven = driven_of(stage)
    assert driven.passed == passed and driven.columns["stroke"] == pytest.approx(
        passed.before(driven.columns["x_lvdt"], DT)
    )
    assert "stroke" not in driven_of(build_chain(log, late={}).stage("linkage")).columns
    # noise behind it looks like motion: the floor is what a noise floor shows of it, made up for
    e = stage.measured[0] - stage.run(stage.neutral()[None])[0, 0]
    assert stage.noise is not None
    shown = passed.shown(stage.t)
    assert stage.noise(stage.t, e) == pytest.approx(noise_floor(stage.t, e) / shown) and shown < 0.97


def test_samples_of_a_driver_that_an_exporter_joined_cost_half_of_the_time_between_them(small: Log) -> None:
    log = only(small, "n_dem", "n_r")
    whole = build_chain(log, late={}).stage("engine")
    joined = Log("a.csv", log.channels | {"n_dem": replace(log["n_dem"], apart=0.05)})
    stage = build_chain(joined, late={}).stage("engine")
    driven = driven_of(stage)
    cost = []
    n_dem = driven.columns["n_dem"]
    for other in (n_dem[np.minimum(np.arange(800) + 2, 799)], np.interp(driven.t, driven.t[::10], n_dem[::10])):
        varied = engine_stage(driven._replace(columns=driven.columns | {"n_dem": other}, again=True))
        cost.append(rms(stage, stage.run(stage.neutral()[None])[0] - varied.run(varied.neutral()[None])[0])[0])
    own = 0.0 if whole.raster_error is None else float(whole.raster_error[0])
    assert stage.raster_error == pytest.approx([np.hypot(max(cost), own)], rel=1e-6)


def test_the_noise_of_a_stroke_is_at_most_what_the_stroke_shows_of_it(small: Log) -> None:
    stage = build_chain(only(small, "i_cmd", "x_lvdt", "n_r"), late={}).stage("actuator")
    x = stage.measured[0]
    assert stage.quiet is not None and 1e-4 <= stage.quiet[0] <= noise_floor(stage.t, x) + 1e-12
    assert stage.memory == 10.0 and stage.noise is not None
    assert stage.noise(stage.t, np.zeros(800)) == 1e-4 and stage.noise(stage.t, white(1, 800)) == pytest.approx(
        noise_floor(stage.t, white(1, 800))
    )
    for name, least in (("engine", 1e-4), ("demand", 2e-3)):
        other = build_chain(only(small, "n_dem", "n_r", "x_dem"), late={}).stage(name)
        assert other.noise is not None and other.noise(other.t, np.zeros(800)) == least


def test_a_current_at_single_ticks_is_worked_out_from_the_firmware_s_law(small: Log) -> None:
    names = ("x_dem", "x_lvdt", "n_r", "p_s", "t_oil", "i_cmd")
    own = driven_of(build_chain(only(small, *names), late={}).stage("servo")).columns
    single = only(small, *names[:-1], i_cmd=own["ticks"][:, -1])
    chain = build_chain(single, late={})
    assert any("the current at single ticks, not the mean of those since the row before" in n for n in chain.notes)
    c = driven_of(chain.stage("servo")).columns
    run = slice(400, None)
    assert np.std((c["i_cmd"] - own["i_cmd"])[run]) < 0.5 * np.std((own["ticks"][:, -1] - own["i_cmd"])[run])
    assert np.array_equal(chain.columns["i_cmd"], c["i_cmd"])
    assert c["law"].shape == (800, 10) and c["law_error"].shape == (800, 8)
    assert np.std((own["other_ticks"].mean(axis=1) - own["i_cmd"])[run]) < 1e-9
    unknown, off = (c["other_ticks"].mean(axis=1) - c["i_cmd"])[run], (c["i_cmd"] - own["i_cmd"])[run]
    assert 0.5 * np.std(off) < np.std(unknown) < 2.0 * np.std(off)
    assert c["ticks"].mean(axis=1)[run] == pytest.approx(c["i_cmd"][run], abs=1e-9)


def valve_of(x: Array, ticks: Array, other: Array | None = None) -> Stage:
    """A hydraulic actuator whose current is known at every tick, and what else it may have been."""
    n = len(x)
    c = {"i_cmd": ticks.mean(axis=1), "ticks": ticks, "x_lvdt": x, "n_r": np.full(n, 70.0), "p_s": np.full(n, 21.0),
         "t_oil": np.full(n, 40.0), "missing": np.zeros(n)}  # fmt: skip
    if other is not None:
        c["other_ticks"] = other
    return actuator_stage(Driven(DT * np.arange(n), c, MACHINE, CALIBRATION, ("x_lvdt",), np.ones(n, dtype=bool), ()))


def test_a_window_starts_where_the_stroke_was_measured() -> None:
    x = 20.0 + 0.5 * white(1, 600)
    stage = valve_of(x, np.zeros((600, 10)))
    out = stage.run(stage.neutral()[None])[0, 0]
    assert out[::100] == pytest.approx(x[::100], abs=1e-6)
    assert np.abs(np.diff(out[100:200])).max() < 0.01  # nothing moves it


def test_a_sticking_piston_gives_by_what_its_oil_lets_it() -> None:
    n = 600
    ticks = (8.0 * np.sin(2.0 * DT * np.arange(n)))[:, None] * np.ones((1, 10))
    stage = valve_of(20.0 - 2.0 * np.cos(2.0 * DT * np.arange(n)), ticks, ticks + 0.0)
    assert stage.hidden is not None
    neutral = stage.neutral()
    assert stage.hidden(neutral) == pytest.approx([0.0], abs=1e-12)  # both currents are one
    sticky = neutral.copy()
    sticky[stage.index()["piston_stiction"]] = stage.effect("piston_stiction").starts[-1]
    once = float(stage.hidden(sticky)[0])
    trapped = float(nominal_compliance(MACHINE.p, 0))  # m/N
    for more in (0.3, 1.0):  # hundredths of mm/kN, which is 1e-6 m/N
        soft = sticky.copy()
        soft[stage.index()["oil_compressibility"].start] = more * 1e-2
        assert float(stage.hidden(soft)[0]) / once == pytest.approx((trapped + 1e-8 * more) / trapped, rel=0.1)
    # the force that sticks scatters where the piston is slow against the law's speed (mm/s)
    out = stage.run(sticky[None])[0, 0]
    v = np.gradient(without_jumps(stage, out)) * 1e-3 / DT
    excess, speed = sticky[stage.index()["piston_stiction"]]
    counts = np.isfinite(stage.measured[0])
    force = piston_stiction.scatter(v, excess, 1e-3 * speed)[counts]
    assert once == pytest.approx(1e3 * trapped * np.sqrt(np.mean(force**2)), rel=1e-9)
    twice = sticky.copy()
    twice[stage.index()["piston_stiction"].start] *= 2.0
    assert float(stage.hidden(twice)[0]) == pytest.approx(2.0 * once, rel=0.2) and once > 0.0
    # what the ticks that nobody logged make, RMS over windows whose start is free
    other = valve_of(20.0 - 2.0 * np.cos(2.0 * DT * np.arange(n)), ticks, ticks + white(2, n, 10))
    swapped = valve_of(20.0 - 2.0 * np.cos(2.0 * DT * np.arange(n)), ticks + white(2, n, 10))
    change = other.run(neutral[None])[0] - swapped.run(neutral[None])[0]
    between = rms(other, change)
    assert other.hidden is not None and other.hidden(neutral) == pytest.approx(between)
    assert other.raster_error == pytest.approx(np.hypot(4e-4, between)) and other.lost is None
    missing = other.made.driven.columns["missing"].copy()  # type: ignore[attr-defined]
    missing[100] = 1.0
    driven = other.made.driven  # type: ignore[attr-defined]
    lacks = actuator_stage(driven._replace(columns=driven.columns | {"missing": missing}))
    assert lacks.lost is not None and lacks.lost[0] == pytest.approx(change)


@pytest.mark.parametrize(("step", "gone"), [(0.01, 0), (0.02, 0), (0.01, 1), (0.02, 1), (0.01, 7)])
def test_frames_that_lack_are_told_whatever_their_period(step: float, gone: int) -> None:
    t, frames = DT * np.arange(1500), step * np.arange(round(15.0 / step))
    kept = np.ones(len(frames), dtype=bool)
    kept[300 : 300 + gone] = False
    log = log_of(t, n_r=np.sin(t), x_lvdt=np.sin(t), x_dem=np.sin(t))
    log = Log("a.csv", log.channels | {"n_dem": Channel(frames[kept] + 0.004, 60.0 + frames[kept], framed=True)})
    gaps = on_raster(log, grid_of(log))[2]
    lost = int(gaps.lost["n_dem"].sum()) if "n_dem" in gaps.lost else 0
    assert abs(lost - gone * step / DT) <= (1.01 if step > DT else 0.01) and ("n_dem" in gaps.far) == (gone > 0)
    assert (gone > 2) == bool(gaps.far.get("n_dem", np.zeros(1)).any())  # two frames are bridged


def test_two_samples_of_a_slow_channel_are_joined_by_a_line_and_one_stands_for_all() -> None:
    t = DT * np.arange(1000)
    log = log_of(t, x_lvdt=np.sin(t), vigv=np.sin(t), t_oil=([0.0, 9.99], [40.0, 60.0]), p_s=([4.0], [21.0]))
    columns = on_raster(log, grid_of(log))[1]
    assert columns["t_oil"] == pytest.approx(40.0 + 20.0 * t / 9.99) and set(columns["p_s"]) == {21.0}


def test_a_gap_of_a_vane_and_what_the_stroke_s_digit_hides_are_the_linkage_s(small: Log) -> None:
    v, digit = small["vigv"], 0.02
    kept = np.ones(800, dtype=bool)
    kept[600:620] = False
    x = np.round(small["x_lvdt"].values / digit) * digit
    log = only(small, "n_r", "t_oil", "vgv1", x_lvdt=x, vigv=Channel(v.t[kept], v.values[kept]))
    stage = build_chain(log, late={}).stage("linkage")
    counts = np.isfinite(stage.measured)
    assert not counts[0, 600:620].any() and counts[1, 600:620].all() and counts[0, 620:].all() and counts[0, 599]
    hidden = driven_of(stage).columns[STROKE_OFF]
    assert hidden.shape == (800, 4) and np.std(hidden) == pytest.approx(digit / 12.0**0.5, rel=0.2)
    assert np.abs(hidden).max() <= 0.5 * digit and stage.lost is not None and len({*hidden[0]}) == 4
    plain = build_chain(only(small, "n_r", "t_oil", "vgv1", "x_lvdt", "vigv"), late={}).stage("linkage")
    assert np.isfinite(plain.measured)[0, 600:620].all()


def test_what_rows_hid_before_a_clock_was_set_right_they_hide_behind_it(monkeypatch: pytest.MonkeyPatch) -> None:
    t, errors = 0.05 * np.arange(400), [0.3, 0.1]

    def build(*_: Any) -> Chain:
        stage = Stage("servo", ("y",), ("mm",), (), (), lambda p: np.zeros((len(p), 1, 400)), t, np.zeros((1, 400)))
        stage.noise, stage.raster_error = lambda when, error: 0.4, np.array([errors.pop(0)])
        return Chain(t, [stage], {}, {}, MACHINE, CALIBRATION, CALIBRATION)

    found = [{"servo": (CLOCK,)}]
    for name in ALL:
        monkeypatch.setattr(module, name, lambda stages: {})
    monkeypatch.setattr(module, "late_vanes", lambda stages: found.pop() if found else {})
    monkeypatch.setattr(module, "_build", build)
    monkeypatch.setattr(module, "expect_stationary_noise", lambda stages: [])
    chain = build_chain(short_log(), MACHINE)
    assert errors == [] and chain.stage("servo").raster_error == pytest.approx([0.3])
    assert chain.stage("servo").floor == pytest.approx([0.5])


def test_a_slow_current_of_single_ticks_is_the_mean_of_its_two_rows() -> None:
    t = DT * np.arange(2400)
    run = lockstep(Stimulus.of(75.0 + 12.0 * np.sin(0.5 * t) + 2.0 * np.sin(2.3 * t)), seed=1, hashed=False)
    log = Log("slow", {k: Channel(run.t[::2], run.columns[k][::2]) for k in ("x_lvdt", "i_cmd", "n_r", "t_oil", "p_s")})
    chain = build_chain(log, late={})
    (note,) = (str(n) for n in chain.notes)
    assert note == (
        "i_cmd: the current at single ticks, not the mean since the row before, which is worked out from it"
    )
    i = log["i_cmd"].values
    wanted = np.concatenate([i[:1], 0.5 * (i[:-1] + i[1:])])
    assert driven_of(chain.stage("actuator")).columns["i_cmd"] == pytest.approx(wanted)
    assert chain.columns["i_cmd"] == pytest.approx(wanted)
