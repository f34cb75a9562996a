"""Each effect against its docstring's equation, written down here once more in numpy; loads and droop against physics.

Nothing here calls what it checks: lanes and chain share their kernel, so that one against the other proves nothing
about it. The numbers that stand in docs/effects.md (temperature of reference, stiffness of the oil) are written out.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import Legendre
from scipy.integrate import quad
from scipy.optimize import brentq

from plant import chain, places
from plant.effects import piston_stiction, valve_flow_saturation
from tests.test_effects import machine_with, speed

RNG = np.random.default_rng(0)
SOFT = (0.048 + 2 * 0.0024) / (4 * 1.6e9 * 1.2e-3)  # m/N: two columns of oil, docs/effects.md


def effect(name: str) -> Any:
    return importlib.import_module(f"plant.effects.{name}")


def each(*columns: tuple[float, ...]) -> list[tuple[float, ...]]:
    """Every combination of the columns' values."""
    return [tuple(float(v) for v in row) for row in np.stack(np.meshgrid(*columns), -1).reshape(-1, len(columns))]


def stribeck(force: float, v: float, excess: float, slow: float) -> float:
    r = (v / slow) ** 2
    return force + excess * (1 + r / 8) ** -8 * (1 + 50 * r) / (1 + 100 * r)


def dahl(y: float, travel: float, distance: float) -> float:
    """The bristle's differential equation dy/da = 1 - s y, integrated by hand: y - s falls by exp(-|a|)."""
    s = np.sign(travel)
    return float((y - s) * np.exp(-np.abs(travel / distance)) + s)


V = (-0.15, -0.01, 0.0, 0.003, 0.15)
EQUATIONS: dict[str, tuple[Callable[..., Any], list[tuple[float, ...]]]] = {
    "acceleration_limit_error": (
        lambda n, e: n + e if n + e > 0.01 else 0.01,
        each((8.0,), (-8.5, -7.995, -2.0, 0.0, 3.0)),
    ),
    "aero_load": (lambda n, f: f * (n / 100.0) ** 2, each((0.0, 50.0, 100.0, 110.0), (-900.0, 0.0, 3500.0))),
    "can_delay": (lambda t, d: t - d, each((0.0, 1.0, 7.25), (0.0, 0.02, 0.31))),
    "controller_gain_error": (lambda g, f: g * f, each((16e3, 100.0), (0.5, 1.0, 1.2))),
    "crank_length_error": (lambda a, e: a + e, each((0.06,), (-0.001, 0.0, 0.002))),
    "end_stop_shift": (
        lambda stroke, e: (e, stroke) if e > 0 else (0.0, stroke + e),
        each((0.048, 0.05), (-0.002, 0.0, 0.003)),
    ),
    "frame_hold": (
        lambda t, p: t if p == 0 else p * math.floor(t / p + 1e-6 / p),
        each((0.0, 0.05, 0.0999989, 0.0999991, 0.1, 0.19, 1.234), (0.0, 0.1, 0.03)),
    ),
    "internal_leakage": (  # v = v0 - c (p + r v)
        lambda v, p, r, c: (v - c * p) / (1 + c * r),
        each(V, (-3e6, 0.0, 2e6), (1.25e6,), (0.0, 1.5e-9, 2e-8, 1.0)),
    ),
    "link_length_error": (lambda a, e: a + e, each((0.1,), (-0.001, 0.0, 0.002))),
    "linkage_backlash": (
        lambda w, e, r: np.clip(w + e * r, 0, None),
        each((0.02,), (-0.03, -0.01, 0.0, 0.03), (0.6, 1.4)),
    ),
    "linkage_compliance": (
        lambda th, n, c: th - c * (n / 100.0) ** 2,
        each((-0.1, 0.2), (0.0, 60.0, 105.0), (-0.01, 0.0, 0.02)),
    ),
    "linkage_friction": (dahl, each((-1.0, -0.3, 0.0, 0.7, 1.0), (-0.02, -0.001, 0.002, 0.05), (0.004, 0.02))),
    "linkage_wear": (
        lambda w, e, r, t: w + e * r * t if t > 0 else w,
        each((0.02,), (0.0, 1e-6), (0.6, 1.4), (-5.0, 0.0, 3000.0)),
    ),
    "lvdt_bias": (lambda x, b: x + b, each((0.0, 0.03), (-1e-3, 0.0, 2e-3))),
    "lvdt_gain": (lambda x, f: x * f, each((0.0, 0.03), (0.9, 1.0, 1.1))),
    "lvdt_lag": (lambda y, x, a: (1 - a) * y + a * x, each((0.01, 0.02), (0.01, 0.03), (0.1, 0.6, 1.0))),
    "lvdt_nonlinearity": (  # Legendre's third polynomial, held beyond the stroke
        lambda x, s, a, c: x - a * np.sin(2 * np.pi * x / s) + c * Legendre.basis(3)(np.clip(2 * x / s - 1, -1, 1)),
        each(
            (-0.001, 0.0, 0.011, 0.024, 0.04, 0.048, 0.05), (0.048,), (-1e-3, 0.0, 2e-3, 1.0), (-5e-4, 0.0, 1e-3, 1.0)
        ),
    ),
    "lvdt_thermal_drift": (
        lambda x, t, c: x + c * (t - 40.0),
        each((0.02,), (-20.0, 40.0, 90.0), (-1e-6, 0.0, 2e-6, 1.0)),
    ),
    "oil_compressibility": (
        lambda f, v, c, d: -(SOFT + c) * f - c * d * v,
        each((-2000.0, 0.0, 4000.0), (-0.1, 0.0, 0.05), (0.0, 5e-8), (0.0, 1500.0)),
    ),
    "oil_viscosity": (
        lambda g, t, c: g * np.clip(1 + c * (t - 40.0), 0.05, None),
        each((0.15,), (-40.0, 0.0, 40.0, 90.0), (-0.02, -0.003, 0.0, 0.01, 0.02, 1.0)),
    ),
    "piston_friction": (
        lambda z, s, level, k: 0.0 if level == 0 else float(np.clip(z + s * k, -level, level)),
        each((-800.0, 0.0, 900.0), (-1e-5, -1e-7, 0.0, 1e-6, 1e-4), (0.0, 1.0, 900.0, 1000.0), (1e8,)),
    ),
    "piston_stiction": (stribeck, each((500.0,), V, (0.0, 1.0, 300.0), (0.005, 0.02))),
    "pot_bias": (lambda n, b: n + b, each((0.001,), (-0.01, 0.0, 0.01))),
    "pot_gain": (lambda v, f: v * f, each((-0.3, 0.2), (0.9, 1.0, 1.1))),
    "pot_lag": (lambda n, e: n + e, each((0.01,), (-0.005, 0.0, 0.1))),
    "ring_eccentricity": (
        lambda th, a, ph: th + a * np.sin(th + ph),
        each((-0.1, 0.0, 0.15), (0.0, 0.01, 1.0), (-2.0, 0.0, 1.0)),
    ),
    "rotor_lag_error": (lambda n, e: n + e if n + e > 0.01 else 0.01, each((1.2,), (-1.5, -1.195, -0.3, 0.0, 2.0))),
    "schedule_error": (lambda x, e: x + e, each((0.01, 0.04), (-0.001, 0.0, 0.002))),
    "supply_pressure_droop": (  # v^2 = v0^2 (1 - droop |v| / p), its root of v0's sign
        lambda v0, p, d: float(np.sign(v0) * max(np.roots([1.0, v0 * v0 * d / p, -v0 * v0]).real)),
        each(V, (5e5, 8e6, 21e6), (0.0, 1.0, 2e6, 6e7)),
    ),
    "thermal_growth": (
        lambda th, t, c, r: th + c * r * (t - 40.0),
        each((0.1,), (-20.0, 40.0, 90.0), (-1e-3, 0.0, 2e-3, 1.0), (0.6, 1.4)),
    ),
    "trend_threshold_error": (lambda a, f: a * f, each((0.06, 0.5), (0.5, 1.0, 3.0))),
    "valve_dead_band": (
        lambda u, h: float(np.sign(u) * np.clip(abs(u) - h, 0, None)),
        each((-1.0, -0.05, -0.01, 0.0, 0.02, 0.03, 0.8), (0.0, 0.02)),
    ),
    "valve_flow_saturation": (  # at 1 m/s and above there is none
        lambda v, s, r: v if s >= 1 else (1 - r) * float(np.clip(v, -s, s)) + r * v / float(np.hypot(1, v / s)),
        each((*V, 0.9, 3.0), (0.005, 0.05, 0.9, 1.0), (0.0, 0.3, 1.0)),
    ),
    "valve_gain_asymmetry": (lambda g, r: (g * r**0.5, g * r**-0.5), each((0.15,), (0.5, 1.0, 1.21))),
    "valve_lag": (lambda i, c, a: (1 - a) * i + a * c, each((0.01, -0.02), (0.03,), (0.1, 0.6, 1.0))),
    "valve_null_bias": (lambda i, b: i + b, each((-0.01, 0.02), (-1e-3, 0.0, 2e-3))),
}


@pytest.mark.parametrize("name", EQUATIONS)
def test_an_effect_is_its_equation(name: str) -> None:
    equation, inputs = EQUATIONS[name]
    for row in inputs:
        assert np.allclose(effect(name).step(*row), equation(*row), rtol=1e-9, atol=1e-15), row


@pytest.mark.parametrize(
    ("x", "amplitude", "cubic"),
    each((-0.001, 0.0007, 0.011, 0.024, 0.04, 0.05), (-1e-3, 0.0, 2e-3), (-5e-4, 0.0, 1e-3)),
)
def test_the_slope_of_the_reading_is_its_derivative(x: float, amplitude: float, cubic: float) -> None:
    lvdt, h = effect("lvdt_nonlinearity"), 1e-7
    derivative = (lvdt.step(x + h, 0.048, amplitude, cubic) - lvdt.step(x - h, 0.048, amplitude, cubic)) / (2 * h)
    assert lvdt.slope(x, 0.048, amplitude, cubic) == pytest.approx(derivative, abs=1e-6)


def test_the_ends_of_the_stroke_are_no_part_of_the_bend() -> None:
    """At both ends the reading has two slopes; that beyond the stroke, where the piston strikes its stop, is given."""
    assert [effect("lvdt_nonlinearity").slope(x, 0.048, 0.0, 1e-3) for x in (0.0, 0.048)] == [1.0, 1.0]


@pytest.mark.parametrize(("v", "limit"), each((*V, 0.9, 3.0), (0.005, 0.05, 0.9, 1.0)))
def test_a_passage_with_a_corner_lets_no_more_through(v: float, limit: float) -> None:
    assert effect("valve_flow_saturation").corner(v, limit) == (v if limit >= 1 else np.clip(v, -limit, limit))


def test_magnetic_hysteresis_is_four_plays_side_by_side() -> None:
    step, mean = effect("valve_hysteresis").step, effect("valve_hysteresis").mean
    for width, spread in ((0.002, 1.0), (0.002, 0.0), (0.004, 0.5), (0.0, 1.0)):
        half = 0.5 * width * (1 + spread * np.array([-0.75, -0.25, 0.25, 0.75]))
        ours, theirs = (0.0,) * 4, np.zeros(4)
        for i in 0.005 * RNG.normal(size=60):
            ours = step(*ours, i, width, spread)
            theirs = np.clip(theirs, i - half, i + half)
            assert np.allclose(ours, theirs, atol=1e-15) and mean(*ours) == pytest.approx(theirs.mean(), abs=1e-15)


@pytest.mark.parametrize("x", [0.0, 0.01, 0.024, 0.048])
def test_columns_of_oil_are_unequal_off_the_middle(x: float) -> None:
    assert effect("piston_friction").off_middle(x, 1 / 0.048) == pytest.approx(
        1 - 2 * (x + 0.0024) / (0.048 + 0.0048), abs=1e-12
    )


@pytest.mark.parametrize(("off", "jump", "ways"), each((-3.0, 0.0, 5.0), (-1.0, 0.0, 2.0), (0.0, 0.4, 1.0, 1.7)))
def test_the_chambers_mean_pressure_comes_back_within_its_way(off: float, jump: float, ways: float) -> None:
    back = (off + jump) * (ways if ways < 1 else 1)
    assert effect("piston_friction").recentre(off, jump, ways) == pytest.approx((off + jump - back, back), abs=1e-12)


def test_friction_in_the_joints_holds_the_vane_back_by_half_its_width() -> None:
    assert effect("linkage_friction").loop(0.2, 0.5, 0.01, 1.4) == pytest.approx(0.2 - 0.5 * 0.01 * 1.4 * 0.5)
    assert effect("linkage_friction").step(0.3, 0.0, 0.01) == 0.3


def test_droop_without_pressure_to_spare_stops_no_clock() -> None:
    """No pressure left: no speed to lose, no division by nothing."""
    assert effect("supply_pressure_droop").step(0.01, 0.0, 1e6) == pytest.approx(
        0.01 * (math.sqrt(1 + 1e8) - 1e4), rel=1e-9
    )


# ---- loads in the chain: the speed at which pressures balance --------------------------------------------------------

AREA, SUPPLY, RATED, FASTEST = 1.2e-3, 21e6, 0.040, 0.150


def balance(i: float, load: float, droop: float = 0.0, leakage: float = 0.0, drag: float = 1500.0) -> float:
    """The steady speed (m/s) for a current (A) and a load against extension (N).

    What the valve lets in is what the piston and the leak take.

    The line loses droop |q|, the load takes its share of what is left, the orifice the rest; q is the valve's flow per
    area.
    """
    way = math.copysign(1.0, i)

    def missing(q: float) -> float:
        left = SUPPLY - droop * q - way * load / AREA
        return abs(i) / RATED * FASTEST * math.sqrt(max(left, 0.0) / SUPPLY) - q

    q = way * brentq(missing, 0.0, 1.0, xtol=1e-14)
    return brentq(lambda v: q - leakage * (load + drag * v) / AREA - v, -1.0, 1.0, xtol=1e-14)


@pytest.mark.parametrize("i", [0.004, -0.004, 0.012, -0.012])
@pytest.mark.parametrize("load", [-6000.0, 0.0, 6000.0])
@pytest.mark.parametrize(("droop", "leakage"), [(0.0, 0.0), (60e6, 0.0), (0.0, 1.5e-9), (60e6, 1.5e-9)])
def test_speed_under_load_is_where_the_pressures_balance(i: float, load: float, droop: float, leakage: float) -> None:
    machine = machine_with(
        aero_load={"force": load},
        supply_pressure_droop={"droop": droop * 1e-6},
        internal_leakage={"coefficient": leakage * 1e9},
    )
    assert speed(machine, i, n_r=100.0) == pytest.approx(balance(i, load, droop, leakage), rel=1e-6)


@pytest.mark.parametrize("i", [0.008, -0.008])
def test_droop_costs_most_where_the_load_is_against_the_motion_and_never_turns_it(i: float) -> None:
    def lost(load: float) -> float:
        free = speed(machine_with(aero_load={"force": load}), i, n_r=100.0)
        droops = speed(machine_with(aero_load={"force": load}, supply_pressure_droop={"droop": 60.0}), i, n_r=100.0)
        assert 0.0 < droops / free < 1.0
        return 1.0 - droops / free

    against = math.copysign(8000.0, i)
    assert lost(against) > lost(0.0) > lost(-against)


@pytest.mark.parametrize("i", [0.004, -0.004])
def test_the_oil_does_no_less_work_than_the_load_takes(i: float) -> None:
    """Power from the supply (p_s A |v|) covers the load's, under droop too; the rest is lost in orifice and line."""
    machine = machine_with(aero_load={"force": 9000.0}, supply_pressure_droop={"droop": 60.0})
    v = speed(machine, i, n_r=100.0)
    assert np.sign(v) == np.sign(i) and SUPPLY * AREA * abs(v) - 60e6 * v * v * AREA >= 9000.0 * v


def test_a_load_that_holds_the_piston_stops_it_and_no_more() -> None:
    machine = machine_with(aero_load={"force": 20000.0}, supply_pressure_droop={"droop": 60.0})
    s = machine.start(0.024, 100.0)
    for _ in range(50):
        chain.drive_step(s, machine.p, 0, 0.01, 120.0, SUPPLY, 40.0)  # 28.8 kN against 25.2 kN of oil
    assert s[places.SPEED, 0] == 0.0


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_friction_takes_the_energy_of_coulombs_law(way: float) -> None:
    """Over a steady stroke the friction force is against the motion and its work is force times way."""
    friction = effect("piston_friction")
    z, work = 0.0, 0.0
    for _ in range(400):
        after = friction.step(z, way * 1e-5, 900.0, 1e8)
        work += 0.5 * (z + after) * way * 1e-5
        z = after
    assert z == way * 900.0
    spring = quad(lambda s: min(s * 1e8, 900.0), 0.0, 400e-5, points=[900.0 / 1e8])[0]
    assert work == pytest.approx(spring, rel=2e-3)


# ---- all of them together --------------------------------------------------------------------------------------------


class Drive:
    """Valve, piston and LVDT of docs/effects.md, one column of oil on either side, in plain Python: 0.1 ms at a time,
    SI.

    Effects act, each by its equation above, in the order of the signal flow. ``sizes`` are those of `machine_with`, in
    the library's units.
    """

    def __init__(self, machine: Any, sizes: dict[str, dict[str, float]], stroke: float) -> None:
        from scipy.linalg import expm

        self.dt, self.sizes, t = 1e-4, sizes, machine.table
        w, zeta = 2 * math.pi * t.valve.bandwidth.value, t.valve.damping.value
        self.turn = expm(np.array([[0.0, 1.0], [-w * w, -2 * zeta * w]]) * self.dt)
        self.lvdt = 1 - math.exp(-self.dt / (t.sensors.lvdt_lag.value * 1e-3))
        self.spool, self.v, self.x, self.y = np.zeros(2), 0.0, stroke, stroke
        self.lagged, self.friction, self.off, self.give, self.reading = 0.0, 0.0, 0.0, 0.0, stroke

    def size(self, effect: str, parameter: str, neutral: float = 0.0) -> float:
        return self.sizes.get(effect, {}).get(parameter, neutral)

    def share(self, effect: str) -> float:
        constant = self.size(effect, "time_constant")
        return 1 - math.exp(-self.dt / constant) if constant > 0 else 1.0

    def step(self, current: float, n_r: float, p_s: float, t_oil: float) -> None:
        size, law = self.size, lambda name, *values: EQUATIONS[name][0](*values)
        biased = law("valve_null_bias", current, size("valve_null_bias", "bias") * 1e-3)
        self.lagged = law("valve_lag", self.lagged, biased, self.share("valve_lag"))
        target = np.array([self.lagged / RATED, 0.0])
        self.spool = target + self.turn @ (self.spool - target)
        if abs(self.spool[0]) > 1:
            self.spool = np.array([np.sign(self.spool[0]), 0.0])
        opening = law("valve_dead_band", self.spool[0], size("valve_dead_band", "half_width") * 1e-3 / RATED)
        thin = law("oil_viscosity", FASTEST, t_oil, size("oil_viscosity", "coefficient"))
        gain = law("valve_gain_asymmetry", thin, size("valve_gain_asymmetry", "ratio", 1.0))[0 if opening > 0 else 1]
        load = law("aero_load", n_r, size("aero_load", "force"))
        pressure = (load + self.friction) / AREA
        left = p_s - (pressure if opening > 0 else -pressure)
        v = opening * gain * math.sqrt(max(left, 0) / SUPPLY)
        v = law("supply_pressure_droop", v, left, size("supply_pressure_droop", "droop") * 1e6) if v else 0.0
        limit, roundness = (
            size("valve_flow_saturation", "limit", 1e3) * 1e-3,
            size("valve_flow_saturation", "roundness"),
        )
        v = law("valve_flow_saturation", v, limit, roundness)
        drag, compliance = size("oil_compressibility", "drag", 1500.0), size("oil_compressibility", "compliance") * 1e-6
        v = law("internal_leakage", v, pressure, drag / AREA, size("internal_leakage", "coefficient") * 1e-9)
        pushed = 0.5 * (self.v + v) * self.dt
        # the oil on both sides, with a twentieth of the stroke behind either end
        before, behind = self.x + 0.0024, 0.048 - self.x + 0.0024
        uneven = (behind - before) / (behind + before)
        soft, even = SOFT + compliance, 1 - uneven**2
        slow = size("piston_stiction", "speed", 5.0) * 1e-3
        level = stribeck(size("piston_friction", "force"), v, size("piston_stiction", "excess"), slow)
        grown = law("piston_friction", self.friction, pushed, level, 1 / (soft * even))
        jump = grown - self.friction
        back = (self.off + uneven * jump) * min(abs(pushed) / (2 * soft * AREA * p_s), 1)
        self.off += uneven * jump - back
        give = law("oil_compressibility", load, v, compliance, drag)
        moved = pushed + give - self.give - (even * jump + uneven * back) * soft
        self.friction, self.give, self.v = grown, give, v
        self.x = float(np.clip(self.x + moved, *law("end_stop_shift", 0.048, size("end_stop_shift", "shift") * 1e-3)))
        self.y += self.lvdt * (self.x - self.y)
        self.reading = law("lvdt_lag", self.reading, self.y, self.share("lvdt_lag"))


DRAWN: dict[str, Callable[[np.random.Generator], dict[str, float]]] = {
    "valve_null_bias": lambda r: {"bias": r.uniform(-2, 2)},
    "valve_lag": lambda r: {"time_constant": r.uniform(0.5e-3, 10e-3)},
    "valve_dead_band": lambda r: {"half_width": r.uniform(0.1, 2)},
    "valve_gain_asymmetry": lambda r: {"ratio": r.uniform(0.6, 1.5)},
    "oil_viscosity": lambda r: {"coefficient": r.uniform(-0.01, 0.01)},
    "aero_load": lambda r: {"force": r.uniform(-9000, 9000)},
    "supply_pressure_droop": lambda r: {"droop": r.uniform(1, 60)},
    "valve_flow_saturation": lambda r: {"limit": r.uniform(5, 60), "roundness": r.choice([0.0, 0.4, 1.0])},
    "internal_leakage": lambda r: {"coefficient": r.uniform(0.1, 5)},
    "piston_friction": lambda r: {"force": r.uniform(100, 6000)},
    "piston_stiction": lambda r: {"excess": r.uniform(100, 3000), "speed": r.uniform(2, 20)},
    "oil_compressibility": lambda r: {"compliance": r.uniform(0.001, 0.05), "drag": r.uniform(500, 3000)},
    "end_stop_shift": lambda r: {"shift": r.uniform(-3, 3)},
    "lvdt_lag": lambda r: {"time_constant": r.uniform(0.5e-3, 5e-3)},
}


@pytest.mark.parametrize("seed", range(24))
def test_the_drive_with_several_effects_is_their_equations_in_the_order_of_the_flow(seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = (
        list(DRAWN) if seed % 4 == 0 else [str(n) for n in rng.choice(list(DRAWN), rng.integers(1, 6), replace=False)]
    )
    sizes = {name: {k: float(v) for k, v in DRAWN[name](rng).items()} for name in names}
    machine = machine_with(**sizes)
    stroke, n_r, p_s, t_oil = (
        float(rng.uniform(0.002, 0.046)),
        float(rng.uniform(40, 105)),
        float(rng.uniform(12e6, 24e6)),
        65.0,
    )
    s, by_hand = machine.start(stroke=stroke, n_r=n_r, t_oil=t_oil), Drive(machine, sizes, stroke)
    by_hand.lagged, by_hand.give = float(s[places.LAGGED, 0]), float(s[places.GIVE, 0])
    current = 0.0
    for tick in range(40):
        if tick % 8 == 0:
            current = float(rng.uniform(-0.045, 0.045))
        chain.drive_step(s, machine.p, 0, current, n_r, p_s, t_oil)
        for _ in range(10):
            by_hand.step(current, n_r, p_s, t_oil)
        b = by_hand
        rows = [places.SPOOL, places.SPEED, places.X, places.X_LVDT]
        assert np.allclose(s[rows, 0], (b.spool[0], b.v, b.x, b.y), rtol=1e-7, atol=1e-12), tick
        if machine.p[chain.DRIVE_EFFECTS, 0]:
            rows = [places.LAGGED, places.FRICTION, places.FRICTION + 1, places.GIVE, places.READING]
            assert np.allclose(s[rows, 0], (b.lagged, b.friction, b.off, b.give, b.reading), rtol=1e-6, atol=1e-9), tick


def test_a_drag_with_the_square_of_the_speed_is_the_round_end_of_a_saturation() -> None:
    """v = v0 sqrt(1 - b v^2 / (A p)) has one solution; it is the saturation's with limit = sqrt(A p / b)."""
    pressure, area, drag = 21e6, 1.2e-3, 1.1e7
    for v0 in (0.005, 0.03, 0.1, -0.15):
        v = brentq(lambda v, v0=v0: v - v0 * math.sqrt(max(1.0 - drag * v * v / (area * pressure), 0.0)), -0.2, 0.2)
        assert valve_flow_saturation.step(v0, math.sqrt(area * pressure / drag), 1.0) == pytest.approx(v, rel=1e-9)


def test_stictions_scatter_is_that_of_a_sawtooth_twice_as_high_as_its_mean_falls() -> None:
    excess, speed = 2400.0, 5e-3
    assert piston_stiction.scatter(np.zeros(1), excess, speed)[0] == 0.0
    for v in (1e-4, 5e-4, 2e-3):
        r = (v / speed) ** 2
        whole = excess * (1.0 + r / 8.0) ** -8  # without what the sawtooth takes off
        height = 2.0 * (whole - piston_stiction.step(0.0, v, excess, speed))
        sawtooth = height * np.linspace(-0.5, 0.5, 100_001)
        rms = float(np.sqrt(np.mean(sawtooth**2)))
        assert piston_stiction.scatter(np.array([v]), excess, speed)[0] == pytest.approx(rms, rel=1e-3)
