"""The rig: an independent machine. Its physics, its agreement with the design's nominal equations, and what can be
hidden in it.
"""

from __future__ import annotations

import ast
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from tests.rig import (
    CATALOGUE,
    EFFECTS,
    MOTOR_EFFECTS,
    OUTSIDE,
    AsObject,
    Compiled,
    Hidden,
    draw,
    kernel,
    machine,
    manoeuvre,
    neutral,
    playback,
    reference,
    simulate,
    slow_ramps,
    small_moves,
    stand_in,
    steady,
    write,
)
from tests.rig.geometry import load, ring_angle, vane_angle
from tests.rig.kernel import P, log_names
from tests.rig.manoeuvre import Manoeuvre
from tests.rig.simulate import UNITS

LOG = log_names(("vigv", "vgv1", "vgv2"))
DEG = np.pi / 180.0
VANES = ("vigv", "vgv1", "vgv2")
DESIGN_LIBRARY = [  # in the order of the design's table
    "can_delay", "frame_hold", "schedule_error", "trend_threshold_error", "controller_gain_error", "rotor_lag_error",
    "acceleration_limit_error", "valve_null_bias", "valve_dead_band", "valve_hysteresis", "valve_flow_saturation",
    "valve_lag",
    "valve_gain_asymmetry", "supply_pressure_droop", "oil_viscosity", "piston_friction", "piston_stiction",
    "internal_leakage",
    "oil_compressibility", "aero_load", "end_stop_shift", "lvdt_bias", "lvdt_gain", "lvdt_nonlinearity", "lvdt_lag",
    "lvdt_thermal_drift",
    "linkage_backlash", "linkage_compliance", "linkage_friction", "linkage_wear", "thermal_growth",
    "crank_length_error",
    "link_length_error", "ring_eccentricity", "pot_bias", "pot_gain", "pot_lag",
]  # fmt: skip

controller = lru_cache(stand_in)


def constant(n: float, seconds: float, p_s: float = 21e6, t_oil: float = 40.0) -> Manoeuvre:
    """One speed, one pressure, one temperature."""
    rows = round(seconds * 100)
    return Manoeuvre("constant", 0, np.full(rows, n), np.full(rows, p_s), np.full(rows, t_oil))


def open_loop(
    currents: np.ndarray, hidden=(), *, x0: float = 24e-3, test: Manoeuvre | None = None, rate: int = 1000, **options
):
    """Play currents (A, one a tick) into the exactly nominal, noise-free machine, without run-up."""
    test = test or constant(60.0, len(currents) / 1000)
    options = {"randomised": False, "noise": False, "jitter": 0.0} | options
    return simulate(test, playback(currents), hidden, rate=rate, run_up=0.0, x0=x0, **options)


@lru_cache
def closed_loop(hidden: tuple[tuple[str, tuple], ...] = (), seed: int = 1, seconds: float = 40.0):
    """Engine test with the rig's own controller at 1000 Hz; ``hidden`` as hashable (name, parameter items)."""
    effects = [Hidden(name, dict(items)) for name, items in hidden]
    return simulate(manoeuvre(seed, seconds), controller(), effects, seed=seed, rate=1000)


# ---- independence ----------------------------------------------------------------------------------------------------


def test_the_rig_imports_nothing_of_the_product():
    allowed = {"numpy", "numba", "scipy", "pyarrow"}
    import sys

    for file in (Path(__file__).parent / "rig").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [a.name.split(".")[0] for a in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module.split(".")[0]]
            for name in names:
                assert name in allowed or name in sys.stdlib_module_names, f"{file.name} imports {name}"


# ---- kinematics ------------------------------------------------------------------------------------------------------


def test_circle_intersection_closes_every_loop():
    g = load()
    strokes = np.linspace(0.0, 48e-3, 13)
    for k, s in enumerate(g.stages):
        ring = ring_angle(g, k, strokes)
        for x, turn in zip(strokes, ring, strict=True):
            j4 = complex(s.dx, s.dy) + s.Ld * np.exp(1j * (turn - np.pi / 2))
            # J3 lies on the prolongation of the upper arm; the actuator and the vertical link have their lengths
            reach = [abs(s.Lb * np.exp(1j * a) - j4) - s.Lc for a in np.linspace(-np.pi, np.pi, 20001)]
            candidates = np.linspace(-np.pi, np.pi, 20001)[np.nonzero(np.diff(np.sign(reach)))[0]]
            lengths = [abs(complex(g.x1, g.y1) + g.Le * np.exp(1j * a)) - g.length_0 - x for a in candidates]
            assert min(abs(v) for v in lengths) < 5e-5  # grid of candidate angles: 0.3 mrad x 112 mm


def test_published_sensitivities_come_out():
    """+1 mm of lower arm is about +2 % of slope, +1 mm of vertical link about -1.6 deg (Kim & Ki 2020)."""
    g, x = load(), np.linspace(0.0, 48e-3, 49)

    def line(geometry, k):
        return np.polyfit(x * 1e3, vane_angle(ring_angle(geometry, k, x), geometry.stages[k].vane_ratio) / DEG, 1)

    for k in range(3):
        slope, offset = line(g, k)
        longer_arm, longer_link = line(g.with_error(k, crank=1e-3), k), line(g.with_error(k, link=1e-3), k)
        assert 1.01 < longer_arm[0] / slope < 1.035
        assert np.mean(np.polyval(longer_link, x * 1e3) - np.polyval((slope, offset), x * 1e3)) == pytest.approx(
            -1.6, abs=0.15
        )


# ---- physics ---------------------------------------------------------------------------------------------------------


def test_full_spool_moves_at_the_nominal_speed():
    currents = np.full(200, 0.040)
    for sign in (1.0, -1.0):
        run = open_loop(sign * currents, x0=24e-3 - sign * 15e-3)
        assert sign * run.truth["v"][150] == pytest.approx(0.150, rel=0.005)  # viscous drag takes 0.4 %
    half = open_loop(0.5 * currents, x0=9e-3, test=constant(60.0, 0.2, p_s=21e6 / 4))
    assert half.truth["v"][150] == pytest.approx(0.150 / 4, rel=0.01)  # u sqrt(p_s / 21 MPa)


def test_a_load_takes_its_pressure_from_the_valve():
    """Merritt: speed falls with sqrt(1 - p_L / p_s), and rises where the load helps."""
    force = 8000.0
    fall = force / 1.2e-3 / 21e6
    test = constant(100.0, 0.5)
    hidden = [Hidden("aero_load", {"force": force})]
    out = open_loop(np.full(500, 0.010), hidden, test=test)
    back = open_loop(np.full(500, -0.010), hidden, test=test)
    assert out.truth["v"][400] == pytest.approx(0.0375 * np.sqrt(1 - fall), rel=0.005)
    assert back.truth["v"][400] == pytest.approx(-0.0375 * np.sqrt(1 + fall), rel=0.005)


def test_resting_chambers_hold_half_the_supply_pressure():
    run = open_loop(np.zeros(3000), test=constant(60.0, 3.0, p_s=19e6))
    assert run.truth["p1"][-1] == pytest.approx(9.5e6, rel=1e-3)
    assert run.truth["p2"][-1] == pytest.approx(9.5e6, rel=1e-3)
    assert np.abs(run.truth["x"] - 24e-3).max() < 1e-8


def test_the_stops_hold_the_piston():
    run = open_loop(np.full(800, 0.040))
    assert run.truth["x"].max() == pytest.approx(48e-3, abs=5e-5)
    assert abs(run.truth["v"][-1]) < 1e-5
    shifted = open_loop(np.full(800, -0.040), [Hidden("end_stop_shift", {"shift": 3e-3})])
    assert shifted.truth["x"].min() == pytest.approx(3e-3, abs=5e-5)


def test_oil_spring_rings_at_its_textbook_frequency():
    """omega^2 = 2 beta A^2 / (V m) at mid stroke (Merritt 1967, ch. 6), here with beta made soft by a hidden
    compliance.
    """
    c = 1e-6
    p = machine()
    p[P.viscous] = 50.0
    own = 0.5 * (p[P.dead_volume] + p[P.area] * 0.024) / (p[P.bulk] * p[P.area] ** 2)
    expected = np.sqrt(1.0 / ((c + own) * p[P.mass])) / (2.0 * np.pi)
    test = constant(0.0, 0.6)
    test.n_dem[20:] = 100.0
    currents = np.zeros(600)
    currents[20:30] = 0.02
    run = open_loop(currents, [Hidden("oil_compressibility", {"compliance": c})], test=test, parameters=p)
    v = run.truth["v"][60:] - run.truth["v"][60:].mean()
    spectrum = np.abs(np.fft.rfft(v * np.hanning(len(v)), 16384))
    assert np.fft.rfftfreq(16384, 1e-3)[spectrum.argmax()] == pytest.approx(expected, rel=0.03)


def test_friction_only_takes_energy():
    t = np.arange(4000) * 1e-3
    currents = 0.008 * np.sin(2 * np.pi * 0.7 * t) + 0.002 * np.sin(2 * np.pi * 5 * t)
    for name, main in (("piston_friction", "force"), ("piston_stiction", "excess")):
        run = open_loop(currents, [Hidden(name, {main: 2000.0})])
        assert run.truth["work"][-1] > 0.0
        # the bristle gives back at most what it stores: F^2 / (2 sigma0) = 2000 N x 3 um / 2
        assert np.min(run.truth["work"] - np.maximum.accumulate(run.truth["work"])) > -2000.0 * 3e-6
    slide = open_loop(np.full(300, 0.010), [Hidden("piston_friction", {"force": 2000.0})])
    assert slide.truth["friction"][200] == pytest.approx(2000.0, rel=1e-3)


def test_the_vane_loses_its_nominal_play_on_reversal():
    """1.6, 1.1 and 0.8 deg lie between the strokes at which the vane passes zero opening and closing."""
    run = open_loop(
        np.concatenate([np.full(8000, 0.0012), np.full(8000, -0.0012)]), x0=4e-3
    )  # 4.5 mm/s to 40 mm and back
    x, g = run.truth["x"], load()
    for k, width in enumerate((1.6, 1.1, 0.8)):
        vane = run.truth[f"vane_{k}"]
        opening = np.interp(0.0, vane[500:8000], x[500:8000])
        closing = np.interp(0.0, vane[9000:][::-1], x[9000:][::-1])
        there, back = vane_angle(ring_angle(g, k, np.array([opening, closing])), g.stages[k].vane_ratio) / DEG
        assert there - back == pytest.approx(width, rel=0.005)


@pytest.mark.slow
def test_the_engine_keeps_its_acceleration_limits():
    n = np.concatenate([np.full(300, 45.0), np.full(1200, 95.0), np.full(1200, 45.0)])
    test = Manoeuvre("slam", 0, n, np.full(len(n), 21e6), np.full(len(n), 40.0))
    run = simulate(test, controller(), randomised=False, noise=False, rate=100, jitter=0.0)
    rate = np.diff(run.truth["n"]) * 100.0
    assert rate.max() == pytest.approx(8.0, rel=2e-3)
    assert rate.min() == pytest.approx(-10.0, rel=2e-3)
    tail = run.truth["n"][1200:1300]
    assert -1.0 / np.polyfit(np.arange(100) * 0.01, np.log(95.0 - tail), 1)[0] == pytest.approx(1.2, rel=0.01)


@pytest.mark.parametrize(
    ("hidden", "limit"),
    [
        ((), 1e-6),
        ((("piston_friction", 2000.0),), 1e-6),
        ((("aero_load", 4000.0), ("oil_compressibility", 1e-7)), 1e-6),
    ],
    ids=["nominal", "friction", "load on soft oil"],
)
def test_halving_the_step_changes_nothing_that_matters(hidden, limit):
    """First-order convergence: each halving halves the change, which is far below the LVDT's noise of 5 um."""
    rng = np.random.default_rng(3)
    t = np.arange(6000) * 1e-3
    currents = 0.006 * np.sin(2 * np.pi * 0.6 * t) + np.repeat(rng.uniform(-0.004, 0.004, 60), 100)
    effects = [Hidden(name, {CATALOGUE[name].main: size}) for name, size in hidden]
    runs = [open_loop(currents, effects, substeps=n).truth for n in (50, 100, 200)]
    one, two = (np.abs(b["x"] - a["x"]).max() for a, b in zip(runs, runs[1:], strict=False))
    assert one < limit
    assert two < 0.75 * one
    for k in range(3):
        assert np.abs(runs[1][f"vane_{k}"] - runs[0][f"vane_{k}"]).max() < 1e-3 * DEG


def test_stick_slip_converges_in_its_statistics():
    """Each hop is F / k, some 12 um long; when it comes depends on the last digit, so single hops do not converge, but
    work and size do.
    """
    t = np.arange(6000) * 1e-3
    currents = 0.006 * np.sin(2 * np.pi * 0.6 * t)
    work, size = [], []
    for substeps in (50, 200):
        rough = open_loop(currents, [Hidden("piston_stiction", {"excess": 2000.0})], substeps=substeps).truth
        smooth = open_loop(currents, substeps=substeps).truth
        work.append(rough["work"][-1])
        size.append(np.std(rough["x"] - smooth["x"]))
    assert work[1] == pytest.approx(work[0], rel=0.1)
    assert size[1] == pytest.approx(size[0], rel=0.2)


# ---- agreement with the design's nominal equations -------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_clean_log_is_clean_at_the_noise_floor(seed):
    run = closed_loop(seed=seed)
    actuator = reference.actuator_residual(run, window=1.0)
    assert actuator.std() < 1.02 * 0.005  # mm
    linkage = reference.linkage_residual(run)
    assert np.sqrt((linkage**2).mean(axis=0)).max() < 1.03 * 0.03  # deg
    assert np.std(reference.engine_residual(run)) < 1.02 * 0.02  # %


@pytest.mark.slow
def test_without_noise_only_model_form_is_left():
    run = simulate(manoeuvre(1, 60.0), controller(), seed=1, rate=1000, noise=False)
    actuator = reference.actuator_residual(run, window=1.0)
    assert actuator.std() < 1e-3
    assert np.abs(actuator).max() < 10e-3  # two sigmas of the LVDT, in a slam
    linkage = reference.linkage_residual(run)
    assert linkage.std(axis=0).max() < 6e-3
    assert np.abs(linkage).max() < 0.04
    assert np.abs(reference.engine_residual(run)).max() < 0.015  # %; the frame resolves 0.002 %


# ---- hidden effects --------------------------------------------------------------------------------------------------


def test_every_effect_of_the_design_can_be_hidden():
    assert set(EFFECTS) == set(DESIGN_LIBRARY)
    assert len(OUTSIDE) >= 16
    assert {e.stage for e in OUTSIDE.values()} == {"demand", "servo", "engine", "actuator", "linkage"}
    assert not set(OUTSIDE) & set(EFFECTS)


@pytest.mark.parametrize("name", CATALOGUE)
def test_an_effect_of_neutral_size_is_absent(name):
    plain = closed_loop(seconds=4.0)
    without = simulate(manoeuvre(1, 4.0), controller(), [neutral(name)], seed=1, rate=1000)
    for channel in LOG:
        np.testing.assert_array_equal(without.log[channel], plain.log[channel], err_msg=channel)


# stage error (of the stage's reference equations) that a gross size must leave, as a multiple of the clean one
FAINT = {
    "oil_compressibility": 1.01,
    "internal_leakage": 1.15,
    "linkage_resonance": 1.3,
    "piston_stiction": 2.0,
    "area_growth": 1.5,
    "supply_dips": 1.5,
    "vane_vibration": 2.0,
}


HYDRAULIC = [name for name in CATALOGUE if name not in MOTOR_EFFECTS]  # what the reference stages know


# in `make test` the first of each stage
FIRST = {CATALOGUE[name].stage: name for name in reversed(HYDRAULIC)}.values()


@pytest.mark.parametrize("name", [n if n in FIRST else pytest.param(n, marks=pytest.mark.slow) for n in HYDRAULIC])
def test_a_gross_effect_shows_in_its_own_stage(name):
    effect = CATALOGUE[name]
    clean = stage_errors()
    run = closed_loop(hidden=((name, tuple({effect.main: effect.ladder[4], **effect.others}.items())),))
    error = reference.stage_errors(run, controller(), (effect.stage,))
    assert error[effect.stage] > FAINT.get(name, 2.5) * clean[effect.stage]


# the demand stage has no noise: a whole frame's delay or a turned table always shows
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in HYDRAULIC if CATALOGUE[name].site != "demand"])
def test_the_smallest_size_is_lost_in_noise(name):
    effect = CATALOGUE[name]
    clean = stage_errors()
    run = closed_loop(hidden=((name, tuple({effect.main: effect.ladder[0], **effect.others}.items())),))
    error = reference.stage_errors(run, controller(), (effect.stage,))
    assert error[effect.stage] < 1.12 * clean[effect.stage]


@lru_cache
def stage_errors():
    """Errors of a clean run."""
    return reference.stage_errors(closed_loop(), controller())


def test_an_onset_leaves_the_time_before_untouched():
    late = simulate(manoeuvre(1, 20.0), controller(), [Hidden("valve_null_bias", {"bias": 1e-3}, onset=12.0)], seed=1)
    clean = simulate(manoeuvre(1, 20.0), controller(), seed=1)
    np.testing.assert_array_equal(late.log["x_lvdt"][:1200], clean.log["x_lvdt"][:1200])
    assert np.mean(late.log["i_cmd"][1800:] - clean.log["i_cmd"][1800:]) == pytest.approx(-1.0, abs=0.05)


def test_two_effects_add_up():
    both = simulate(
        steady(1, 10.0),
        controller(),
        [Hidden("valve_null_bias", {"bias": 5e-4}), Hidden("pot_bias", {"bias": 0.02, "stage": 1})],
        seed=1,
    )
    clean = simulate(steady(1, 10.0), controller(), seed=1)
    difference = {name: np.mean(both.log[name][300:] - clean.log[name][300:]) for name in LOG}
    assert difference["i_cmd"] == pytest.approx(-0.5, abs=0.02)
    assert difference["vgv1"] == pytest.approx(
        0.02 / DEG, abs=0.05
    )  # the servo's start with a bias leaves the pins elsewhere
    assert abs(difference["vigv"]) < 0.05


def test_what_cannot_be_hidden_is_refused_by_name():
    with pytest.raises(ValueError, match="effect \\(='rust'\\)"):
        Hidden("rust", {})
    with pytest.raises(ValueError, match="parameter \\(='size'\\)"):
        Hidden("pot_bias", {"size": 1.0})
    with pytest.raises(ValueError, match="rate \\(=50\\)"):
        simulate(steady(1, 1.0), controller(), rate=50)


def test_drawn_sizes_stay_near_their_rung():
    rng = np.random.default_rng(0)
    for name, effect in CATALOGUE.items():
        for size in range(5):
            h = draw(name, size, rng)
            value, rung, rest = h.parameters[effect.main], effect.ladder[size], effect.parameters[effect.main].neutral
            if rest == 1.0:
                assert abs(np.log(value)) <= 1.3 * abs(np.log(rung))
            else:
                assert 0.6 * abs(rung) <= abs(value) <= 1.4 * abs(rung)


# ---- runs and logs ---------------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_log():
    one, two, other = (simulate(manoeuvre(5, 10.0), controller(), seed=s) for s in (5, 5, 6))
    for channel in LOG:
        np.testing.assert_array_equal(one.log[channel], two.log[channel])
    assert not np.array_equal(one.log["x_lvdt"], other.log["x_lvdt"])


@pytest.mark.parametrize("rate", [10, 100, 1000])
def test_a_log_has_border_names_units_and_raster(rate, tmp_path):
    run = simulate(manoeuvre(2, 12.0), controller(), seed=2, rate=rate)
    assert tuple(run.log) == LOG and set(LOG) < set(UNITS)
    assert len(run.log["t"]) == 12 * rate
    assert (np.diff(run.log["t"]) > 0.0).all()
    assert np.abs(run.log["t"] - np.arange(12 * rate) / rate).max() <= 2e-4
    assert 0.0 < run.log["x_lvdt"].min() < run.log["x_lvdt"].max() < 48.0
    assert 35.0 < run.log["n_r"].min() < run.log["n_r"].max() < 105.0
    for suffix in (".csv", ".parquet"):
        write(run, tmp_path / f"run{suffix}")
        assert (tmp_path / f"run{suffix}").stat().st_size > 0


def test_the_rows_of_a_slow_log_are_rows_of_the_fast_one():
    """One run, two loggers: only the mean of the current and the noise of the angles' own samples differ."""
    fast, slow = (simulate(manoeuvre(3, 5.0), controller(), seed=3, rate=r, jitter=0.0) for r in (1000, 100))
    for channel in ("t", "n_dem", "n_r", "x_dem", "x_lvdt", "state"):
        np.testing.assert_array_equal(fast.log[channel][::10], slow.log[channel], err_msg=channel)
    mean = fast.log["i_cmd"][1:-9].reshape(-1, 10).mean(axis=1)
    np.testing.assert_allclose(slow.log["i_cmd"][1:], mean, atol=0.002)


def test_a_python_controller_gives_the_same_run_as_a_compiled_one():
    test = manoeuvre(4, 3.0)
    compiled = simulate(test, controller(), seed=4, rate=1000)
    called = simulate(test, AsObject(controller()), seed=4, rate=1000)
    for channel in LOG:
        np.testing.assert_allclose(called.log[channel], compiled.log[channel], atol=1e-12, err_msg=channel)


def test_manoeuvres_stay_in_safe_limits():
    for seed in range(20):
        for make in (manoeuvre, steady, small_moves, slow_ramps):
            m = make(seed, 300.0)
            assert len(m.n_dem) == 30000
            assert 40.0 <= m.n_dem.min() <= m.n_dem.max() <= 100.0
            assert 19e6 <= m.p_s.min() <= m.p_s.max() <= 22e6
            assert 20.0 <= m.t_oil.min() <= m.t_oil.max() <= 90.0
    assert np.ptp(small_moves(1).n_dem) < 3.1


def test_specimens_stay_within_tolerance():
    nominal = machine()
    for seed in range(30):
        p = simulate(steady(seed, 0.1), controller(), seed=seed, run_up=0.0).machine
        assert abs(p[P.flow_gain] / nominal[P.flow_gain] - 1.0) <= 0.05
        assert abs(p[P.spool_omega] / nominal[P.spool_omega] - 1.0) <= 0.15
        assert max(abs(p[P.pot_bias_0 + k]) for k in range(3)) <= 0.1 * DEG


def test_the_firmware_runs_on_the_rig():
    """Through its public tick, handed in by the caller: the rig itself knows nothing of it."""
    firmware = pytest.importorskip("controller")
    inputs = np.zeros(len(firmware.INPUTS))
    inputs[firmware.INPUTS.index("mode_request")] = 1.0
    place, out = firmware.INPUTS.index, firmware.STATE.index
    tick = Compiled(
        firmware.tick, inputs, firmware.new_state(), firmware.load_calibration(),
        n_dem=place("n_dem"), n_r=place("n_r"), x_lvdt=place("x_lvdt"), fresh=place("demand_fresh"),
        i_cmd=out("i_cmd"), x_dem=out("x_dem"), mode=out("mode"),
    )  # fmt: skip
    run = simulate(manoeuvre(1, 60.0), tick, seed=1)
    assert set(run.log["state"]) == {float(firmware.MODES.index("RUN"))}
    assert np.std(run.log["x_dem"] - run.log["x_lvdt"]) < 0.1
    assert np.ptp(run.log["x_lvdt"]) > 5.0


def test_kernel_slots_are_all_different():
    assert len({int(v) for v in P}) == len(P) == kernel.N_P


# ---- ordinary machines and loggers -----------------------------------------------------------------------------------


def test_links_are_drawn_within_the_tolerance_that_the_table_states():
    nominal = load()
    drawn = [load(rng=np.random.default_rng(seed)) for seed in range(40)]
    for part in ("x1", "y1", "Le", "length_0"):
        off = [getattr(g, part) - getattr(nominal, part) for g in drawn]
        assert 3e-5 < np.abs(off).max() <= 5e-5 + 1e-12, (
            part
        )  # m: up to the tolerance, and not all of them near nominal
    for k in range(3):
        for part in ("Lb", "Lc", "Ld"):
            off = [getattr(g.stages[k], part) - getattr(nominal.stages[k], part) for g in drawn]
            assert 3e-5 < np.abs(off).max() <= 5e-5 + 1e-12, part
        ratio = [g.stages[k].vane_ratio / nominal.stages[k].vane_ratio - 1.0 for g in drawn]
        assert 5e-4 < np.abs(ratio).max() <= 0.05 / 36.7 + 0.05 / 158.5
        centre = [np.hypot(g.stages[k].dx - nominal.stages[k].dx, g.stages[k].dy - nominal.stages[k].dy) for g in drawn]
        assert 1e-4 < np.max(centre) < 0.02 * DEG * 0.51 + 7.1e-5  # theta6 turns it, dx and dy move it along
        assert {g.stages[k].hysteresis for g in drawn} == {nominal.stages[k].hysteresis}


def test_links_within_tolerance_move_the_vanes_and_nothing_before_them():
    plain = closed_loop(seconds=20.0)
    other = simulate(manoeuvre(1, 20.0), controller(), seed=1, rate=1000, geometry=load(rng=np.random.default_rng(4)))
    assert np.abs(other.log["vigv"] - plain.log["vigv"]).max() > 0.03
    assert np.abs(other.log["x_dem"] - plain.log["x_dem"]).max() < 0.1


def test_a_gap_takes_rows_out_and_leaves_the_others():
    whole = simulate(manoeuvre(2, 20.0), controller(), seed=2)
    cut = simulate(manoeuvre(2, 20.0), controller(), seed=2, gaps=[(4.0, 2.5), (11.0, 1.0)])
    t = whole.truth["t"]
    kept = ~(((t >= 4.0) & (t < 6.5)) | ((t >= 11.0) & (t < 12.0)))
    assert len(cut.log["t"]) == 2000 - 350
    for channel in LOG:
        np.testing.assert_array_equal(cut.log[channel], whole.log[channel][kept], err_msg=channel)
    np.testing.assert_array_equal(cut.truth["x"], whole.truth["x"][kept])


@pytest.mark.parametrize("kind", ["standby", "deaf"])
def test_a_spell_in_another_mode_is_the_firmwares(kind):
    """The controller leaves RUN and comes back by itself; the machine moves as it says; the rows before are
    untouched.
    """
    firmware = pytest.importorskip("controller.records")
    from tests.firmware_on_rig import firmware as controller_of_the_product
    from tests.rig import Spell

    test = manoeuvre(3, 30.0)
    plain = simulate(test, controller_of_the_product(), seed=3)
    run = simulate(test, controller_of_the_product(), seed=3, spells=[Spell(kind, 10.0, 4.0)])
    state, t = run.log["state"], run.truth["t"]
    for channel in LOG:
        np.testing.assert_array_equal(run.log[channel][:1000], plain.log[channel][:1000], err_msg=channel)
    other = firmware.STANDBY if kind == "standby" else firmware.FAIL_SAFE
    assert set(state[(t > 11.0) & (t < 13.5)]) == {other}
    assert set(state[t < 9.9]) == set(state[t > 16.0]) == {firmware.RUN}
    assert np.abs(run.log["x_lvdt"] - plain.log["x_lvdt"])[(t > 11.0) & (t < 13.5)].max() > 1.0
    np.testing.assert_array_equal(run.log["n_dem"], plain.log["n_dem"])  # a logger hears the ECU all the same
