"""Two actuators on the same unison rings: closed forms of their forces, energy that never grows, and what two
equal ones have in common with the one that stands for both.
"""

# ruff: noqa: D103 - a test's name is its claim
from __future__ import annotations

import argparse
import importlib
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

import vaneloop
from controller.calibration import CalibrationTable
from hil import inject
from hil.fmu import write_fmu
from hil.logs import read_log
from hil.loop.engines import lockstep_engines
from hil.loop.lanes import lockstep_lanes
from hil.loop.lockstep import Run, Stimulus, lockstep, snapshot_names
from hil.replay import replay
from plant import Model, Plant, build_plant, chain, load_model, unison, write_model
from plant.effects import ROW, oil_compressibility
from plant.linkage import G_LC, N_CRANK, N_PER_STAGE, stage_vane_angle
from plant.model import SIDE_NAMES, Side
from plant.parameters import AREA, LINE_CONDUCTANCE, PLAY, POT_POSITION, RING_STIFFNESS, derive
from plant.places import GIVE, POT, READING, RING, X_LVDT, X
from tests.test_tables import document
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path, read
from vaneloop.cli.main import COMMANDS, main
from vaneloop.design.servo_motor import plant_of_tables
from vaneloop.fleet.plan import model_of
from vaneloop.verbs.machine import Machine

TABLE = "plant_two_actuators.toml"
TWO, ONE = build_plant(TABLE), build_plant()
KAPPA = 1e5  # N m/rad, of the table
C = oil_compressibility.NOMINAL * 2.0  # m/N, of half the area
A, P_S = 0.6e-3, 21e6  # m2, Pa
DEMAND = np.interp(np.arange(0.0, 12.0, 0.01), [0, 1, 5, 6, 9, 12], [60, 60, 95, 95, 55, 70])


def with_rings(kappa: float = KAPPA, position: float = 90.0, model: Model | None = None) -> Plant:
    """The shipped machine with other rings: stiffness (N m/rad), potentiometers' place (deg)."""
    plant = model.plant(TWO) if model else TWO
    p = plant.p.copy()
    p[RING_STIFFNESS], p[POT_POSITION] = kappa, math.radians(position)
    derive(p, chain.TICK / chain.SUBSTEPS, chain.TICK)
    return replace(plant, p=p)


def at(plant: Plant, x_a: float, x_b: float) -> np.ndarray:
    """Its state at rest at unequal strokes (m), with no oil compressed."""
    s = plant.start(x_a, 70.0)
    s[[X, X_LVDT, READING], 1] = x_b
    return s


def drive(plant: Plant, s: np.ndarray, seconds: float, i_cmd: float = 0.0, substeps: int = 10) -> np.ndarray:
    """Let the actuators move under a current (A); return both strokes after each tick."""
    out = []
    for _ in range(round(seconds / chain.TICK)):
        chain.drive_step(s, plant.p, 0, i_cmd, 70.0, P_S, 40.0, chain.TICK, substeps)
        out.append(s[X].copy())
    return np.array(out)


def stiffness(plant: Plant, x: float) -> float:
    """N/m between the pistons, near the stroke ``x`` (m): by the difference of vane angles, undone by the lever."""
    g, total, h = plant.geometry.arrays(), 0.0, 1e-6
    for k in range(len(plant.vanes)):
        ldp, lever = plant.lever(k)
        ring = [math.atan(lever * math.sin(stage_vane_angle(x + d, g, k)) / ldp) for d in (-h, h)]
        total += plant.p[RING_STIFFNESS, 0] * ((ring[1] - ring[0]) / (2.0 * h)) ** 2
    return total


# ---- rings and pistons -----------------------------------------------------------------------------------------------


@given(st.floats(0.0, 48e-3), st.floats(0.0, 48e-3))
def test_forces_on_the_pistons_are_the_slope_of_the_elastic_energy(x_a: float, x_b: float) -> None:
    s, h = at(TWO, x_a, x_b), 1e-7
    tie = unison.tie(s, TWO.p, 0)
    for lane, force in enumerate((tie.f_a, tie.f_b)):
        ends = []
        for way in (-h, h):
            moved = s.copy()
            moved[X, lane] += way
            ends.append(unison.energy(moved, TWO.p, 0))
        assert force == pytest.approx((ends[1] - ends[0]) / (2.0 * h), rel=1e-5, abs=0.5)


def test_a_millimetre_between_the_strokes_takes_the_share_that_the_table_says() -> None:
    tie = unison.tie(at(TWO, 24.5e-3, 23.5e-3), TWO.p, 0)
    assert tie.f_a == pytest.approx(2.25e3, rel=0.02) and tie.f_b == pytest.approx(-tie.f_a, rel=1e-2)
    assert tie.f_a / (A * P_S) == pytest.approx(0.18, abs=0.005)


@pytest.mark.parametrize("between", [1e-4, 1e-3, -3e-3])
@pytest.mark.parametrize("kappa", [0.0, 1e4, 1e5, 1e6])
def test_shut_in_pistons_come_to_rest_as_springs_in_series_do(kappa: float, between: float) -> None:
    """Ring and both oil columns share the way: x_A - x_B = D / (1 + 2 C K), the force is K of that."""
    plant = with_rings(kappa)
    s = at(plant, 24e-3 + between / 2.0, 24e-3 - between / 2.0)
    drive(plant, s, 0.05)
    k = stiffness(plant, 24e-3)
    assert s[X, 0] - s[X, 1] == pytest.approx(between / (1.0 + 2.0 * C * k), rel=2e-4)
    assert -s[GIVE, 0] / C == pytest.approx(k * (s[X, 0] - s[X, 1]), rel=2e-3, abs=1e-6)
    assert s[X].sum() == pytest.approx(48e-3, abs=abs(between) * 1e-3)


def of_side(side: str, **effects: dict[str, float]) -> Model:
    return Model(**{side: Side(effects=effects)})


def ring_of(plant: Plant, x: float, k: int, longer: float = 0.0) -> float:
    """Angle (rad) of ring ``k`` at a stroke (m) with a vertical link that is ``longer`` (m): lever and link undone."""
    g = plant.geometry.arrays().copy()
    g[N_CRANK + k * N_PER_STAGE + G_LC] += longer
    ldp, lever = plant.lever(k)
    return math.atan(lever * math.sin(stage_vane_angle(x, g, k)) / ldp)


@pytest.mark.parametrize("length", [-1e-3, 5e-4])
@pytest.mark.parametrize("side", [0, 1])
def test_links_set_too_long_load_both_pistons_at_equal_strokes(side: int, length: float) -> None:
    """F_A = sum kappa th_A' (th_A - th_B), F_B = - sum kappa th_B' (th_A - th_B): a longer link turns its ring back."""
    plant = of_side(SIDE_NAMES[side], rigging_offset={"length": 1e3 * length}).plant(TWO)
    x, h = 24e-3, 1e-6
    tie = unison.tie(at(plant, x, x), plant.p, 0)
    own = (length, 0.0) if side == 0 else (0.0, length)
    loads = [0.0, 0.0]
    for k in range(len(plant.vanes)):
        torque = KAPPA * (ring_of(plant, x, k, own[0]) - ring_of(plant, x, k, own[1]))
        for j, sign in enumerate((1.0, -1.0)):
            slope = (ring_of(plant, x + h, k, own[j]) - ring_of(plant, x - h, k, own[j])) / (2.0 * h)
            loads[j] += sign * slope * torque
    assert (tie.f_a, tie.f_b) == pytest.approx(tuple(loads), rel=1e-6)
    assert (tie.f_a < 0.0) == ((length > 0.0) == (side == 0)) and tie.f_a * tie.f_b < 0.0


@pytest.mark.parametrize("length", [-1.0, 0.5])
def test_shut_in_pistons_share_a_rigging_offset_as_springs_in_series_do(length: float) -> None:
    """Pistons at equal strokes give way by C F each: x_A - x_B = - 2 C F, F = F_0 / (1 + 2 C K)."""
    plant = of_side("side_b", rigging_offset={"length": length}).plant(TWO)
    s = at(plant, 24e-3, 24e-3)
    tie = unison.tie(s, plant.p, 0)
    drive(plant, s, 0.05)
    force = (tie.f_a - tie.f_b) / 2.0 / (1.0 + C * ((tie.k_a + tie.k_b) / 2.0 + tie.k_ab))
    assert s[X, 0] - s[X, 1] == pytest.approx(-2.0 * C * force, rel=3e-3)


def test_both_sides_off_alike_load_no_piston_and_mirrored_ones_change_places() -> None:
    links = {"rigging_offset": {"length": 1.0}}
    tie = unison.tie(at(TWO, 24e-3, 24e-3), Model(effects=links).plant(TWO).p, 0)
    assert tie.f_a == tie.f_b == 0.0
    a, b = (run(of_side(side, **links).plant(TWO), DEMAND[:600]).columns for side in SIDE_NAMES)
    assert np.allclose(a["x_lvdt_a"], b["x_lvdt_b"], rtol=0.0, atol=1e-9)
    assert np.allclose(a["vigv"], b["vigv"], rtol=0.0, atol=1e-9)
    assert np.ptp(a["x_lvdt_a"] - a["x_lvdt_b"]) > 0.01


@pytest.mark.parametrize("ratio", [0.5, 0.1])
def test_a_soft_point_is_a_spring_in_series_and_the_ring_leans_to_the_stiff_side(ratio: float) -> None:
    """1 / kappa' = 1 / kappa + (1 - r) / (r kappa); a vane half-way sees (1 - r/2) th_A + (r/2) th_B of a soft B."""
    x_a, x_b = 24.5e-3, 23.5e-3
    stiff = unison.tie(at(TWO, x_a, x_b), TWO.p, 0)
    for side in SIDE_NAMES:
        plant = of_side(side, ring_stiffness={"ratio": ratio}).plant(TWO)
        s = at(plant, x_a, x_b)
        soft = unison.tie(s, plant.p, 0)
        left = 1.0 / (1.0 + (1.0 - ratio) / ratio)
        assert tuple(soft[2:]) == pytest.approx(tuple(left * v for v in stiff[2:]), rel=1e-12)
        share = ratio / 2.0 if side == "side_b" else 1.0 - ratio / 2.0
        for k in range(len(plant.vanes)):
            th_a, th_b = ring_of(plant, x_a, k), ring_of(plant, x_b, k)
            ring, _ = unison.ring_at(s, plant.p, 0, k, th_a)
            assert ring == pytest.approx((1.0 - share) * th_a + share * th_b, abs=1e-9)


def test_soft_points_at_both_sides_add_their_compliances() -> None:
    both = {
        side: Side(effects={"ring_stiffness": {"ratio": r}}) for side, r in zip(SIDE_NAMES, (0.5, 0.25), strict=True)
    }
    left, give_a, give_b = unison.yielding(Model(**both).plant(TWO).p, 0)
    assert 1.0 / left == pytest.approx(1.0 + 1.0 + 3.0)
    assert (give_a, give_b) == pytest.approx((0.2, 0.6)) and left + give_a + give_b == pytest.approx(1.0)


def test_one_actuator_has_no_side_to_be_rigged_wrong() -> None:
    for name in ("rigging_offset", "ring_stiffness"):
        with pytest.raises(InputError, match=f"{name}' is of two hydraulic actuators on the same rings; .* has one$"):
            Model(effects={name: {}}).check(ONE)
        with pytest.raises(InputError, match=f"effect {name} is of two hydraulic actuators on the same rings"):
            inject.run(inject.Scenario(title="made", duration=1.0, inject=[inject.Machine(effect=name)]), plant=ONE)


def test_leakage_lets_the_strokes_come_together_with_the_time_of_the_springs() -> None:
    """v = -c F / A on either side, the drag taking a share: the difference decays with (1 + 2 C K) A / (2 c K)."""
    leak = 5e-9  # m/s/Pa
    plant = with_rings(model=Model(effects={"internal_leakage": {"coefficient": leak * 1e9}}))
    s = at(plant, 24.5e-3, 23.5e-3)
    x = drive(plant, s, 0.2)
    between = x[:, 0] - x[:, 1]
    k = stiffness(plant, 24e-3)
    time = (1.0 + 2.0 * C * k) * A / (2.0 * leak * k) * (1.0 + leak * 1500.0 / A)
    assert -0.1 / math.log(between[149] / between[49]) == pytest.approx(time, rel=2e-3)


@settings(max_examples=25)
@given(
    st.floats(0.0, 1e6), st.floats(-5e-3, 5e-3), st.floats(0.0, 50.0), st.floats(0.0, 2000.0), st.floats(0.0, 10.0)
)  # fmt: skip
def test_with_valves_shut_the_energy_of_rings_and_oil_never_grows(
    kappa: float, between: float, leak: float, friction: float, soft: float
) -> None:
    effects = {
        "internal_leakage": {"coefficient": leak},
        "piston_friction": {"force": friction},
        "oil_compressibility": {"compliance": soft},
    }
    plant = with_rings(kappa, model=Model(effects=effects))
    s = at(plant, 24e-3 + between / 2.0, 24e-3 - between / 2.0)
    energy, force = [], abs(unison.tie(s, plant.p, 0).f_a)
    for _ in range(100):
        energy.append(unison.energy(s, plant.p, 0) + 0.5 * float((s[GIVE] ** 2).sum()) / (C + soft * 1e-6))
        drive(plant, s, chain.TICK)
    rounding = 1e-6 if friction else 1e-10  # what the oil stores of the friction is not counted
    assert (np.diff(energy) <= rounding * energy[0] + 1e-15).all()
    # friction holds what the rings do not push beyond it
    assert leak < 0.1 or abs(kappa * between) < 1.0 or force <= friction or energy[-1] < energy[1]


def test_valves_with_opposite_null_biases_fight_up_to_the_force_that_leakage_lets_through() -> None:
    """Each valve feeds u g sqrt(1 - F / (A p_s)) against c F / A: by bisection."""
    bias, leak = 0.4, 5.0  # mA, mm/s/MPa
    model = Model(
        effects={"internal_leakage": {"coefficient": leak}},
        side_a=Side(effects={"valve_null_bias": {"bias": bias}}),
        side_b=Side(effects={"valve_null_bias": {"bias": -bias}}),
    )
    plant = model.plant(TWO)
    s = plant.start(24e-3, 70.0)
    drive(plant, s, 3.0)

    def missing(force: float) -> float:
        return bias / 40.0 * 0.150 * math.sqrt(1.0 - force / (A * P_S)) - leak * 1e-9 * force / A

    force = brentq(missing, 0.0, A * P_S)
    assert -s[GIVE, 0] / C == pytest.approx(force, rel=1e-3) and -s[GIVE, 1] / C == pytest.approx(-force, rel=1e-3)
    assert (s[X, 0] - s[X, 1]) * stiffness(plant, 24e-3) == pytest.approx(force, rel=3e-3)


@pytest.mark.parametrize(("position", "share"), [(0.0, 1.0), (60.0, 0.75), (90.0, 0.5), (180.0, 0.0), (360.0, 1.0)])
def test_a_potentiometer_feels_the_nearer_actuator_more(position: float, share: float) -> None:
    plant, g = with_rings(position=position), TWO.geometry.arrays()
    plant.p[PLAY : PLAY + 3] = 0.0
    s = at(plant, 25e-3, 23e-3)
    for _ in range(200):
        chain.vane_step(s, plant.p, 0, 70.0, 40.0)
    for k in range(3):
        ldp, lever = plant.lever(k)
        a, b = (math.atan(lever * math.sin(stage_vane_angle(x, g, k)) / ldp) for x in (25e-3, 23e-3))
        seen = math.atan(lever * math.sin(s[POT + k, 0]) / ldp)
        assert seen == pytest.approx(share * a + (1.0 - share) * b, abs=1e-9)
        assert s[RING + k, 0] == pytest.approx(0.5 * (a + b), abs=1e-9)


@pytest.mark.parametrize("kappa", [1e5, 1e6])
def test_halving_the_step_moves_the_strokes_by_less_each_time(kappa: float) -> None:
    effects = {"internal_leakage": {"coefficient": 5.0}}
    model = Model(effects=effects, side_b=Side(parameters={"actuator.flow_gain": 0.14}))
    ends = []
    for substeps in (5, 10, 20, 40):
        plant = with_rings(kappa, model=model)
        derive(plant.p, chain.TICK / substeps, chain.TICK)
        s = plant.start(10e-3, 70.0)
        ends.append(drive(plant, s, 0.15, 0.02, substeps)[-1])
    off = np.abs(np.diff(ends, axis=0)).max(axis=1)
    assert off[0] < 2e-6 and (off[1:] < 0.6 * off[:-1]).all()


# ---- in the loop -----------------------------------------------------------------------------------------------------


def run(plant: Plant, demand: np.ndarray = DEMAND, **more: object) -> Run:
    return lockstep(Stimulus.of(demand), plant=plant, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("kappa", [0.0, 1e5, 1e6])
def test_two_equal_actuators_move_the_vanes_as_the_one_that_stands_for_both(kappa: float) -> None:
    one, two = run(ONE), run(with_rings(kappa))
    assert set(two.columns) - set(one.columns) == {"x_lvdt_a", "x_lvdt_b"}
    for name, values in one.columns.items():
        assert np.allclose(two.columns[name], values, rtol=0.0, atol=1e-9), name
    assert np.array_equal(two.columns["x_lvdt_a"], two.columns["x_lvdt_b"])
    assert two.state_hash == run(with_rings(kappa)).state_hash != one.state_hash
    assert len(snapshot_names(TWO)) == len(snapshot_names(ONE)) + len(TWO.rows)


def test_two_equal_loaded_actuators_are_the_one_with_the_whole_load_and_friction() -> None:
    """Half of the area, of the load and of the friction: the same pressures."""
    both = {"aero_load": {"force": 5000.0}, "internal_leakage": {"coefficient": 2.0}}
    drag = {"oil_compressibility": {"drag": 1500.0}}, {"oil_compressibility": {"drag": 750.0}}
    one = run(Model(effects=both | {"piston_friction": {"force": 2000.0}} | drag[0]).plant(ONE))
    two = run(Model(effects=both | {"piston_friction": {"force": 1000.0}} | drag[1]).plant(TWO))
    for name, values in one.columns.items():
        assert np.allclose(two.columns[name], values, rtol=0.0, atol=1e-6), name


def test_a_biased_lvdt_at_b_shows_in_the_difference_and_half_of_it_in_the_vanes() -> None:
    demand = np.full(400, 80.0)
    fine, off = run(TWO, demand), run(Model(side_b=Side(effects={"lvdt_bias": {"bias": 0.5}})).plant(TWO), demand)
    step = 50.0 / 2**16  # mm, of the converter
    apart = off.columns["x_lvdt_a"] - off.columns["x_lvdt_b"]
    assert np.allclose(apart, -0.5, atol=2.0 * step)
    assert np.allclose(off.columns["x_lvdt"], 0.5 * (off.columns["x_lvdt_a"] + off.columns["x_lvdt_b"]))
    assert off.columns["x_lvdt_a"][-1] - fine.columns["x_lvdt_a"][-1] == pytest.approx(-0.25, abs=5.0 * step)


def test_the_lvdts_have_noise_of_their_own() -> None:
    noisy = run(TWO, np.full(2000, 80.0), seed=3, every=1)
    a, b = noisy.columns["x_lvdt_a"], noisy.columns["x_lvdt_b"]
    assert np.std(a - b) == pytest.approx(math.sqrt(2.0) * 0.005, rel=0.05)


def test_the_loop_begins_at_rest() -> None:
    model = Model(effects={"aero_load": {"force": 4000.0}})
    still = run(model.plant(TWO), np.full(200, 80.0))
    for name in ("x_lvdt_a", "x_lvdt_b", *TWO.vanes):
        assert np.ptp(still.columns[name]) < 0.02, name


@settings(max_examples=10, deadline=None)
@given(st.floats(0.0, 1e6), st.floats(-10.0, 10.0), st.floats(0.0, 50.0), st.floats(0.0, 10.0), st.floats(0.0, 360.0))
def test_no_stiffness_and_no_fault_of_one_side_lets_a_stroke_run_away(
    kappa: float, bias: float, leak: float, soft: float, position: float
) -> None:
    effects = {
        "valve_null_bias": {"bias": bias},
        "internal_leakage": {"coefficient": leak},
        "oil_compressibility": {"compliance": soft},
    }
    done = run(with_rings(kappa, position, Model(side_b=Side(effects=effects))), DEMAND[:600])
    for name in ("x_lvdt_a", "x_lvdt_b"):
        assert ((done.columns[name] > -0.01) & (done.columns[name] < 48.01)).all()


def test_lanes_and_engines_run_such_a_machine_alone() -> None:
    stimulus = Stimulus.of(DEMAND[:200])
    alone = lockstep(stimulus, plant=TWO)
    lanes = lockstep_lanes(stimulus, [ONE, TWO])
    assert all(np.array_equal(v, lanes[1].columns[k]) for k, v in alone.columns.items())
    engines = lockstep_engines(stimulus, [ONE, TWO], device="cpu")
    assert engines.stroke[0] == pytest.approx(engines.stroke[1], abs=1e-9)


# ---- tables and model files ------------------------------------------------------------------------------------------


def table(tmp_path: Path, **changed: object) -> Path:
    """The shipped table with other entries in its section [actuators]; None removes one."""
    data = tomllib.loads(path(TABLE).read_text(encoding="utf-8"))
    data["actuators"] |= changed
    data["actuators"] = {k: v for k, v in data["actuators"].items() if v is not None}
    file = tmp_path / "two.toml"
    file.write_text(document(data))
    return file


def quantity(value: float, unit: str) -> dict[str, object]:
    return {"value": value, "unit": unit, "origin": "chosen: for a test"}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"number": quantity(0, "-")}, "number (=0 -) must be in [1, 2]"),
        ({"number": quantity(3, "-")}, "number (=3 -) must be in [1, 2]"),
        ({"number": quantity(1.5, "-")}, "number (=1.5) must be 1 or 2"),
        ({"number": None}, "key 'actuators.number' is missing; allowed here: number, feed, ring_stiffness"),
        ({"feed": "one pump"}, "actuators.feed (='one pump'): Input should be 'a valve each'"),
        ({"ring_stiffness": quantity(-1, "N m/rad")}, "ring_stiffness (=-1 N m/rad) must be in [0, 1e+07]"),
        ({"ring_stiffness": quantity(1, "N/m")}, "ring_stiffness.unit (='N/m') must be 'N m/rad'"),
        ({"ring_stiffness": None}, "key 'ring_stiffness' is missing; two actuators need ring_stiffness, pot_position"),
        ({"pot_position": quantity(-1, "deg")}, "pot_position (=-1 deg) must be in [0, 360]"),
        ({"b": {"area": quantity(1, "m2")}}, "key 'actuators.b.area' is unknown; allowed here: bandwidth, damping"),
        ({"b": {"flow_gain": quantity(0, "m/s")}}, "flow_gain (=0 m/s) must be in [0.001, 10]"),
    ],
)
def test_a_wrong_section_is_refused_in_one_line(tmp_path: Path, changed: dict[str, object], said: str) -> None:
    with pytest.raises(InputError) as e:
        build_plant(table(tmp_path, **changed))
    assert said in str(e.value) and "\n" not in str(e.value)


def test_one_actuator_is_the_machine_without_the_section(tmp_path: Path) -> None:
    data = tomllib.loads(path("plant.toml").read_text(encoding="utf-8"))
    data["actuators"] = {"number": quantity(1, "-")}
    file = tmp_path / "one.toml"
    file.write_text(document(data))
    made = build_plant(file)
    assert np.array_equal(made.p, ONE.p) and made.p.shape[1] == 1
    assert run(made, DEMAND[:200]).state_hash == run(ONE, DEMAND[:200]).state_hash


def test_side_b_differs_where_its_table_says(tmp_path: Path) -> None:
    b = {"flow_gain": quantity(0.14, "m/s"), "lvdt_lag": quantity(2, "ms")}
    p = build_plant(table(tmp_path, b=b)).p
    names = {n.name: n.row for n in TWO.nominal}
    assert p[names["actuator.flow_gain"]].tolist() == [0.15, 0.14]
    assert p[names["sensors.lvdt_lag"]].tolist() == [1e-3, 2e-3]
    assert p[names["valve.bandwidth"]].tolist() == [60.0, 60.0] and p[AREA].tolist() == [A, A]


def test_a_model_file_gives_each_side_its_own_and_reads_back(tmp_path: Path) -> None:
    model = Model(
        parameters={"actuators.ring_stiffness": 1.1e5},
        effects={"internal_leakage": {"coefficient": 1.0}},
        side_b=Side(parameters={"actuator.flow_gain": 0.14}, effects={"internal_leakage": {"coefficient": 3.0}}),
    )
    write_model(tmp_path / "m.toml", model)
    back = load_model(tmp_path / "m.toml", TWO)
    assert back == model
    p, rows = back.plant(TWO).p, {n.name: n.row for n in TWO.nominal}
    assert p[rows["actuator.flow_gain"]].tolist() == [0.15, 0.14]
    assert p[RING_STIFFNESS].tolist() == [1.1e5, 1.1e5]


@pytest.mark.parametrize(
    ("side", "said"),
    [
        (Side(effects={"pot_bias": {"vigv": 0.1}}), "side_b: 'pot_bias' is not of one side"),
        (Side(effects={"aero_load": {"force": 10.0}}), "side_b: 'aero_load' is not of one side"),
        (Side(effects={"oil_viscosity": {}}), "side_b: 'oil_viscosity' is not of one side"),
        (Side(parameters={"engine.lag": 1.2}), "side_b: 'engine.lag' is not of one side"),
        (Side(effects={"lvdt_bia": {"bias": 0.1}}), "side_b: effects: 'lvdt_bia' is unknown, probably 'lvdt_bias'"),
        (Side(effects={"lvdt_bias": {"bias": 99.0}}), "side_b: effects.lvdt_bias.bias (=99 mm) must be in ["),
        (Side(parameters={"actuator.flow_gain": 9.0}), "side_b: parameters: actuator.flow_gain (=9 m/s) must be in ["),
    ],
)
def test_what_is_not_of_one_side_is_refused(side: Side, said: str) -> None:
    with pytest.raises(InputError) as e:
        Model(side_b=side).check(TWO)
    assert said in str(e.value)
    with pytest.raises(InputError, match="side_b: this machine has one actuator"):
        Model(side_b=side).check(ONE)


# ---- every command that takes a machine ------------------------------------------------------------------------------

LOG = "examples/engine_run.blf"
SHORT = ("--bus", "lockstep", "--duration", "1")
WORKS = {  # what it does with two actuators
    "engine-test": (),
    "replay": (LOG,),
    "compare": (LOG,),
    "locate": (LOG,),
    "diagnose": (LOG,),
    "experiment": (LOG,),
    "fleet": ("run", LOG, "--out", "run"),
    "extend": (LOG, "--effect", "linkage_backlash", "--out", "x.toml"),
    "run": SHORT,
    "inject": ("demand_stops",),
    "strategies": (),
    "fuzz": ("--frames", "1000"),
    "ecu": (),  # of the machine only the engine
    "a2l": (),  # of the firmware
}
REFUSED = {"learn": (LOG,), "design": (), "export-fmu": ("--part", "plant", "--out", "x.fmu"), "web": ("--no-open",)}


def takes_a_plant(parser: argparse.ArgumentParser) -> bool:
    """Whether a command, or one below it, has the option --plant."""
    below = [p for a in parser._actions if isinstance(a, argparse._SubParsersAction) for p in a.choices.values()]
    return "--plant" in parser._option_string_actions or any(map(takes_a_plant, below))


def test_every_command_with_a_plant_table_is_listed_here() -> None:
    found = set()
    for name, (module, *_) in COMMANDS.items():
        parser = argparse.ArgumentParser()
        importlib.import_module(module).add_options(parser)
        if takes_a_plant(parser):
            found.add(name)
    assert found == {*WORKS, *REFUSED}


@pytest.mark.parametrize("name", REFUSED)
def test_a_command_that_cannot_take_two_actuators_says_so_in_one_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(Path(w).resolve()) if w == LOG else w for w in REFUSED[name]]
    monkeypatch.chdir(tmp_path)
    assert main([name, *words, "--plant", TABLE]) == 2
    said = capsys.readouterr().err.strip()
    assert "actuators.number (=2) must be 1 for " in said and "\n" not in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["replay", "compare", "run", "inject"])
def test_a_command_that_simulates_takes_two_actuators(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, *WORKS[name], "--plant", TABLE]) == 0
    said = capsys.readouterr()
    assert "no comparison by subsystem" not in said.out + said.err
    assert ("which actuator or LVDT is at fault cannot be told" in said.out + said.err) == (name == "compare")


def test_the_library_refuses_what_the_commands_refuse(tmp_path: Path) -> None:
    machine = Machine(table=TABLE)
    for refused in (
        lambda: write_fmu(
            tmp_path / "x.fmu", "plant", TWO, machine.calibration, read("calibration.toml", CalibrationTable)
        ),
        lambda: plant_of_tables(TABLE),
        lambda: vaneloop.learn("examples/hidden_effect.parquet", machine),
    ):
        with pytest.raises(InputError, match=r"actuators\.number \(=2\) must be 1 "):
            refused()


def test_replay_says_how_far_apart_the_strokes_are_draws_them_and_keeps_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_model(tmp_path / "m.toml", Model(side_b=Side(effects={"lvdt_bias": {"bias": 0.5}})))
    words = ["--plant", TABLE, "--model", str(tmp_path / "m.toml"), "--report", str(tmp_path / "r.html")]
    for name, kept in (("x.csv", True), ("x.log", False)):
        assert main(["replay", LOG, *words, "--out", str(tmp_path / name)]) == 0
        assert "x_lvdt_a - x_lvdt_b: -0.500 mm in the mean" in capsys.readouterr().out
        log = read_log(tmp_path / name)
        assert ({"x_lvdt_a", "x_lvdt_b"} <= log.channels.keys()) == kept
    assert "how far A is ahead of B" in (tmp_path / "r.html").read_text(encoding="utf-8")
    log = read_log(tmp_path / "x.csv")
    assert np.mean(log["x_lvdt_a"].values - log["x_lvdt_b"].values) == pytest.approx(-0.5, abs=1e-3)
    found = replay(log, plant=TWO)
    assert {"x_lvdt_a", "x_lvdt_b"} <= {s.signal for s in found.signals}
    assert "x_lvdt_b: this machine has one actuator; not compared" in replay(log, plant=ONE).notes


def short_profile(folder: Path) -> Path:
    """An engine test of some seconds."""

    def numbers(value: float, unit: str) -> str:
        return f'{{ values = [{value}, {value}], unit = "{unit}", origin = "chosen: for a test" }}'

    profile = folder / "short.toml"
    profile.write_text(
        'start = { value = 70, unit = "%", origin = "chosen: for a test" }\n'
        f"speed = {numbers(75, '%')}\nrate = {numbers(5, '%/s')}\ndwell = {numbers(2, 's')}\n"
    )
    return profile


def test_the_engine_test_says_how_far_apart_the_strokes_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    profile = short_profile(tmp_path)
    assert main(["engine-test", "--plant", TABLE, "--profile", str(profile)]) in (0, 1)
    assert "dual: x_lvdt_a - x_lvdt_b: " in capsys.readouterr().out


def test_a_campaigns_machine_keeps_what_one_side_has() -> None:
    base = Model(side_b=Side(effects={"lvdt_bias": {"bias": 0.5}}))
    made = model_of([], [], base)
    assert made.sides == base.sides and made.plant(TWO).p[ROW["lvdt_bias"]].tolist() == [0.0, 5e-4]


@pytest.mark.parametrize("plant", [TWO, Model(effects={"internal_leakage": {"coefficient": 1.0}}).plant(ONE)])
def test_a_machine_stands_while_its_supply_is_gone_and_goes_on_after_that(plant: Plant) -> None:
    p_s = np.full(len(DEMAND), P_S)
    p_s[200:400] = 0.0
    done = lockstep(Stimulus.of(DEMAND, p_s=p_s), plant=plant, hashed=False)
    stroke = done.columns["x_lvdt"]
    assert np.ptp(stroke[210:400]) < 0.01 < abs(stroke[600] - stroke[400])
    assert stroke[-1] == pytest.approx(run(plant).columns["x_lvdt"][-1], abs=0.05)


# ---- one valve -------------------------------------------------------------------------------------------------------


def on_one_valve(line: float = 60.0, kappa: float = KAPPA, model: Model | None = None) -> Plant:
    """The machine with one valve and lines of this conductance (mm/s/MPa)."""
    plant = with_rings(kappa, model=model)
    plant.p[LINE_CONDUCTANCE] = line * 1e-9
    return plant


@pytest.mark.parametrize("line", [0.5, 10.0])
def test_the_shut_valve_lets_unequal_strokes_come_together_through_the_lines(line: float) -> None:
    """v_A - v_B = G (p_B - p_A), and the mean stays: the difference decays with (1 + 2 C K) A / (2 G K)."""
    plant = on_one_valve(line)
    x = drive(plant, at(plant, 24.5e-3, 23.5e-3), 0.2)
    between, k = x[:, 0] - x[:, 1], stiffness(plant, 24e-3)
    time = (1.0 + 2.0 * C * k) * A / (2.0 * line * 1e-9 * k)
    first, last = (9, 19) if line > 1.0 else (49, 149)
    assert -(last - first) * 1e-3 / math.log(between[last] / between[first]) == pytest.approx(time, rel=1e-2)
    assert np.allclose(x.sum(axis=1), 48e-3, rtol=0.0, atol=2e-6)


@pytest.mark.parametrize("line", [20.0, 80.0])
def test_more_friction_at_b_leaves_it_behind_by_what_the_rings_make_up_for(line: float) -> None:
    """In steady motion both have the same pressure: F + f_A = -F + f_B, so F = f_B / 2."""
    friction = 2000.0
    plant = on_one_valve(line, model=Model(side_b=Side(effects={"piston_friction": {"force": friction}})))
    s = plant.start(4e-3, 70.0)
    drive(plant, s, 2.0, 2e-3)
    assert s[X, 0] < 0.04
    assert (s[X, 0] - s[X, 1]) * stiffness(plant, s[X, 0]) == pytest.approx(friction / 2.0, rel=2e-2)


@settings(max_examples=10, deadline=None)
@given(st.floats(0.1, 80.0), st.floats(0.0, 1e7), st.floats(0.0, 50.0))
def test_no_line_and_no_stiffness_lets_a_stroke_run_away(line: float, kappa: float, leak: float) -> None:
    model = Model(side_b=Side(effects={"internal_leakage": {"coefficient": leak}, "lvdt_bias": {"bias": 1.0}}))
    done = run(on_one_valve(line, kappa, model), DEMAND[:600])
    for name, off in (("x_lvdt_a", 0.0), ("x_lvdt_b", 1.0)):
        assert ((done.columns[name] > off - 0.01) & (done.columns[name] < off + 48.01)).all()


def test_equal_actuators_on_one_valve_are_as_those_on_two() -> None:
    two, one = run(TWO), run(on_one_valve())
    for name, values in two.columns.items():
        assert np.allclose(one.columns[name], values, rtol=0.0, atol=1e-9), name


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"feed": "one valve"}, "line_conductance must be there with feed 'one valve' and only then (='one valve')"),
        ({"line_conductance": quantity(5, "mm/s/MPa")}, "only then (='a valve each')"),
        ({"feed": "one valve", "line_conductance": quantity(81, "mm/s/MPa")}, "(=81 mm/s/MPa) must be in [0.1, 80]"),
        (
            {"feed": "one valve", "line_conductance": quantity(60, "mm/s/MPa"), "b": {"bandwidth": quantity(50, "Hz")}},
            "b.bandwidth is of a valve of B's own; feed is 'one valve'",
        ),
    ],
)
def test_a_wrong_feed_is_refused_in_one_line(tmp_path: Path, changed: dict[str, object], said: str) -> None:
    with pytest.raises(InputError) as e:
        build_plant(table(tmp_path, **changed))
    assert said in str(e.value) and "\n" not in str(e.value)


def test_one_valve_comes_from_the_table_and_has_no_side(tmp_path: Path) -> None:
    plant = build_plant(table(tmp_path, feed="one valve", line_conductance=quantity(60, "mm/s/MPa")))
    assert plant.p[LINE_CONDUCTANCE].tolist() == [pytest.approx(6e-8)] * 2
    assert "actuators.line_conductance" in {n.name for n in plant.nominal}
    assert "actuators.line_conductance" not in {n.name for n in TWO.nominal}
    for side in (Side(effects={"valve_null_bias": {"bias": 1.0}}), Side(parameters={"actuator.flow_gain": 0.149})):
        with pytest.raises(
            InputError, match="is not of one side; allowed: parameters and effects of actuator and LVDT"
        ):
            Model(side_b=side).check(plant)
    Model(side_b=Side(effects={"lvdt_bias": {"bias": 1.0}})).check(plant)
