"""The nominal models of the families in `tests.rig_systems`, written as docs/your_own_model.md teaches a user.

Each function takes ``start``, name -> the user's guess of an unknown parameter, and ``known``, what the user knows
exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from vaneloop import System, unknown
from vaneloop.identification import Parameter

__all__ = ["NOMINAL", "nominal"]

Values = dict[str, float]


def tanks(start: Values, known: Values) -> System:
    """Two tanks: Torricelli's law twice."""

    def derivative(x, u, p):
        upper = p.upper_outflow * max(x.upper, 0.0) ** 0.5
        return p.inflow * u.pump - upper, upper - p.lower_outflow * max(x.lower, 0.0) ** 0.5

    return System(
        "tanks", "simulate", derivative, inputs={"pump": "V"}, states={"upper": "cm", "lower": "cm"},
        outputs={"upper": "cm", "lower": "cm"},
        parameters=[
            unknown("inflow", start["inflow"], "cm/(V s)", low=0.0),
            unknown("upper_outflow", start["upper_outflow"], "cm^0.5/s", low=0.0),
            unknown("lower_outflow", start["lower_outflow"], "cm^0.5/s", low=0.0),
        ],
    )  # fmt: skip


def flow_loop(start: Values, known: Values) -> System:
    """Flow of first order behind a linear valve."""
    return System(
        "flow_loop", "simulate", lambda x, u, p: (p.gain * u.valve - x.flow) / p.time_constant,
        inputs={"valve": "%"}, states={"flow": "m3/h"}, outputs={"flow": "m3/h"},
        parameters=[
            unknown("gain", start["gain"], "m3/(h %)", low=0.0),
            unknown("time_constant", start["time_constant"], "s", low=1e-3),
        ],
    )  # fmt: skip


def valve_bench(start: Values, known: Values) -> System:
    """A straight line."""
    return System(
        "valve_bench", "static", lambda u, p: p.gain * u.current + p.offset, inputs={"current": "A"},
        outputs={"flow": "l/min"},
        parameters=[unknown("gain", start["gain"], "l/(min A)"), unknown("offset", start["offset"], "l/min")],
    )  # fmt: skip


def thermal_mass(start: Values, known: Values) -> System:
    """Heat capacity and a loss in proportion to the rise."""
    return System(
        "thermal_mass", "simulate", lambda x, u, p: (u.heater - p.loss * x.rise) / p.capacity,
        inputs={"heater": "W"}, states={"rise": "K"}, outputs={"rise": "K"},
        parameters=[
            unknown("capacity", start["capacity"], "J/K", low=1e-3), unknown("loss", start["loss"], "W/K", low=0.0)
        ],
    )  # fmt: skip


def heat_exchanger(start: Values, known: Values) -> System:
    """Two stirred volumes and a constant conductance."""

    def derivative(x, u, p):
        heat = p.conductance * (x.hot_out - x.cold_out)
        hot = (u.hot_flow * (u.hot_in - x.hot_out) - heat) / p.capacity
        return hot, (p.cold_flow * (p.cold_in - x.cold_out) + heat) / p.capacity

    return System(
        "heat_exchanger", "simulate", derivative, inputs={"hot_flow": "W/K", "hot_in": "degC"},
        states={"hot_out": "degC", "cold_out": "degC"}, outputs={"hot_out": "degC", "cold_out": "degC"},
        parameters=[
            unknown("conductance", start["conductance"], "W/K", low=0.0),
            unknown("capacity", start["capacity"], "J/K", low=1.0),
            Parameter("cold_flow", known["cold_flow"], "W/K"), Parameter("cold_in", known["cold_in"], "degC"),
        ],
    )  # fmt: skip


def dc_motor(start: Values, known: Values) -> System:
    """Motor without friction; the current settles at once."""

    def derivative(x, u, p):
        return p.constant * (u.voltage - p.constant * x.speed) / p.resistance / p.inertia, x.speed

    def output(x, u, p):
        return x.speed, (u.voltage - p.constant * x.speed) / p.resistance

    return System(
        "dc_motor", "simulate", derivative, inputs={"voltage": "V"}, states={"speed": "rad/s", "angle": "rad"},
        outputs={"speed": "rad/s", "current": "A"}, output=output, rates={"speed": "angle"},
        masses={"speed": "inertia"}, force_unit="N m", start={"angle": 0.0},
        parameters=[
            unknown("resistance", start["resistance"], "ohm", low=1e-3),
            unknown("constant", start["constant"], "V s/rad", low=0.0),
            unknown("inertia", start["inertia"], "kg m^2", low=1e-9),
        ],
    )  # fmt: skip


def rectified_drive(start: Values, known: Values) -> System:
    """Motor of first order, belt of second; the speed with its sign."""

    def derivative(x, u, p):
        change = p.belt**2 * (x.motor - x.speed) - 2.0 * p.damping * p.belt * x.change
        return (p.gain * u.drive - x.motor) / p.lag, x.change, change

    return System(
        "rectified_drive", "simulate", derivative, inputs={"drive": "V"},
        states={"motor": "1/s", "speed": "1/s", "change": "1/s^2"}, outputs={"pulses": "1/s"},
        output=lambda x, u, p: x.speed, start={"motor": 0.0, "speed": 0.0, "change": 0.0},
        parameters=[
            unknown("gain", start["gain"], "1/(V s)", low=0.0), unknown("lag", start["lag"], "s", low=1e-3),
            unknown("belt", start["belt"], "rad/s", low=0.0), unknown("damping", start["damping"], "-", low=0.0),
        ],
    )  # fmt: skip


def battery(start: Values, known: Values) -> System:
    """Thevenin's cell."""

    def derivative(x, u, p):
        return u.current / 3600.0, (p.r1 * u.current - x.polarisation) / p.tau

    def output(x, u, p):
        return p.e0 - p.fall * x.charge - p.r0 * u.current - x.polarisation

    return System(
        "battery", "simulate", derivative, inputs={"current": "A"}, states={"charge": "Ah", "polarisation": "V"},
        outputs={"voltage": "V"}, output=output, start={"charge": 0.0, "polarisation": 0.0},
        parameters=[
            unknown("e0", start["e0"], "V"), unknown("fall", start["fall"], "V/Ah"),
            unknown("r0", start["r0"], "ohm", low=0.0), unknown("r1", start["r1"], "ohm", low=0.0),
            unknown("tau", start["tau"], "s", low=0.1),
        ],
    )  # fmt: skip


def levitation(start: Values, known: Values) -> System:
    """Weight and magnet; the controller is known."""

    def derivative(x, u, p):
        return x.rate, 9810.0 - p.strength * (u.command / x.gap) ** 2

    def control(r, y, p):
        return p.bias + p.stiff * (y.gap - r.reference) + p.damp * y.rate

    return System(
        "levitation", "closed_loop", derivative, control=control, commands={"command": "A"},
        inputs={"reference": "mm"}, states={"gap": "mm", "rate": "mm/s"}, outputs={"gap": "mm", "rate": "mm/s"},
        rates={"rate": "gap"},
        parameters=[
            unknown("strength", start["strength"], "mm^3/(A^2 s^2)", low=1.0),
            *(Parameter(k, known[k], unit) for k, unit in (("bias", "A"), ("stiff", "A/mm"), ("damp", "A s/mm"))),
        ],
    )  # fmt: skip


def pneumatic_cylinder(start: Values, known: Values) -> System:
    """Regulator of first order, piston, spring and damper; force in N is 1000 mm/s^2 a kg."""

    def derivative(x, u, p):
        force = p.area * x.pressure - p.spring * x.position - p.damping * x.speed
        return (6.0 * u.regulator - x.pressure) / p.fill, 1e3 * force / p.mass, x.speed

    return System(
        "pneumatic_cylinder", "simulate", derivative, inputs={"regulator": "-"},
        states={"pressure": "bar", "speed": "mm/s", "position": "mm"}, outputs={"pressure": "bar", "position": "mm"},
        rates={"speed": "position"},
        parameters=[
            unknown("fill", start["fill"], "s", low=1e-4), unknown("area", start["area"], "N/bar", low=0.0),
            unknown("spring", start["spring"], "N/mm", low=0.0),
            unknown("damping", start["damping"], "N s/mm", low=0.0), Parameter("mass", known["mass"], "kg"),
        ],
    )  # fmt: skip


def spool(start: Values, known: Values) -> System:
    """Spool of first order; the exhaust follows fuel and speed at once."""
    return System(
        "spool", "simulate", lambda x, u, p: (p.gain * u.fuel - x.speed) / p.spool_lag, inputs={"fuel": "kg/h"},
        states={"speed": "%"}, outputs={"speed": "%", "exhaust": "K"},
        output=lambda x, u, p: (x.speed, 600.0 + p.heat * p.gain * u.fuel - p.cooling * x.speed),
        parameters=[
            unknown("gain", start["gain"], "% h/kg", low=0.0), unknown("spool_lag", start["spool_lag"], "s", low=1e-2),
            unknown("heat", start["heat"], "K/%"), unknown("cooling", start["cooling"], "K/%"),
        ],
    )  # fmt: skip


def servo_axis(start: Values, known: Values) -> System:
    """Mass and viscous friction."""
    return System(
        "servo_axis", "force", lambda u, p: p.mass * u.acceleration + p.viscous * u.velocity,
        outputs={"force": "N"}, position="position",
        parameters=[
            unknown("mass", start["mass"], "kg", low=0.0), unknown("viscous", start["viscous"], "N s/m", low=0.0)
        ],
    )  # fmt: skip


def excavator_joint(start: Values, known: Values) -> System:
    """Inertia, weight and viscous friction."""

    def torque(u, p):
        return p.inertia * u.acceleration + p.weight * np.cos(u.position) + p.viscous * u.velocity

    return System(
        "excavator_joint", "force", torque, outputs={"torque": "kN m"}, position="position",
        units={"position": "rad"},
        parameters=[
            unknown("inertia", start["inertia"], "t m^2", low=0.0), unknown("weight", start["weight"], "kN m"),
            unknown("viscous", start["viscous"], "kN m s/rad", low=0.0),
        ],
    )  # fmt: skip


def hysteretic_damper(start: Values, known: Values) -> System:
    """Spring and viscous damper."""
    return System(
        "hysteretic_damper", "force", lambda u, p: p.stiffness * u.position + p.damping * u.velocity,
        outputs={"force": "kN"}, position="position", units={"position": "mm"},
        parameters=[
            unknown("stiffness", start["stiffness"], "kN/mm", low=0.0),
            unknown("damping", start["damping"], "kN s/mm", low=0.0),
        ],
    )  # fmt: skip


def hydraulic_cylinder(start: Values, known: Values) -> System:
    """Sharp-edged valve, incompressible oil."""

    def derivative(x, u, p):
        way = 1.0 if u.valve > 0.0 else -1.0 if u.valve < 0.0 else 0.0
        return p.gain * u.valve * max(1.0 - way * u.load, 0.0) ** 0.5

    return System(
        "hydraulic_cylinder", "simulate", derivative, inputs={"valve": "-", "load": "-"}, states={"position": "mm"},
        outputs={"position": "mm"}, window=3.0, parameters=[unknown("gain", start["gain"], "mm/s", low=0.0)],
    )  # fmt: skip


def pendulum(start: Values, known: Values) -> System:
    """Gravity and viscous friction."""

    def derivative(x, u, p):
        return p.drive * u.torque - p.gravity * math.sin(x.angle) - p.damping * x.rate, x.rate

    return System(
        "pendulum", "simulate", derivative, inputs={"torque": "N m"}, states={"rate": "rad/s", "angle": "rad"},
        outputs={"angle": "rad", "rate": "rad/s"}, rates={"rate": "angle"}, between="line",
        parameters=[
            unknown("gravity", start["gravity"], "1/s^2", low=0.0),
            unknown("damping", start["damping"], "1/s", low=0.0),
            unknown("drive", start["drive"], "1/(kg m^2)", low=0.0),
        ],
    )  # fmt: skip


def quarter_car(start: Values, known: Values) -> System:
    """Body on spring and damper over a measured axle."""

    def derivative(x, u, p):
        return -(p.spring * x.travel + p.damping * x.rate) / p.mass - u.axle, x.rate

    return System(
        "quarter_car", "simulate", derivative, inputs={"axle": "m/s^2"}, states={"rate": "m/s", "travel": "m"},
        outputs={"travel": "m", "rate": "m/s"}, rates={"rate": "travel"}, masses={"rate": "mass"}, between="line",
        parameters=[
            unknown("spring", start["spring"], "N/m", low=0.0), unknown("damping", start["damping"], "N s/m", low=0.0),
            Parameter("mass", known["mass"], "kg"),
        ],
    )  # fmt: skip


def resonator(start: Values, known: Values) -> System:
    """Mass, spring, damper; mass in N s^2/mm."""

    def derivative(x, u, p):
        return (u.force - p.spring * x.place - p.damping * x.speed) / p.mass, x.speed

    return System(
        "resonator", "simulate", derivative, inputs={"force": "N"}, states={"speed": "mm/s", "place": "mm"},
        outputs={"place": "mm", "speed": "mm/s"}, rates={"speed": "place"}, masses={"speed": "mass"}, between="line",
        parameters=[
            unknown("spring", start["spring"], "N/mm", low=0.0),
            unknown("damping", start["damping"], "N s/mm", low=0.0), Parameter("mass", known["mass"], "N s^2/mm"),
        ],
    )  # fmt: skip


def rolling_ship(start: Values, known: Values) -> System:
    """Linear roll."""

    def derivative(x, u, p):
        return p.frequency**2 * (p.wave * u.slope - x.roll) - 2.0 * p.damping * p.frequency * x.rate, x.rate

    return System(
        "rolling_ship", "simulate", derivative, inputs={"slope": "deg"}, states={"rate": "deg/s", "roll": "deg"},
        outputs={"roll": "deg", "rate": "deg/s"}, rates={"rate": "roll"}, between="line",
        parameters=[
            unknown("frequency", start["frequency"], "rad/s", low=0.0),
            unknown("damping", start["damping"], "-", low=0.0), unknown("wave", start["wave"], "-", low=0.0),
        ],
    )  # fmt: skip


NOMINAL: dict[str, Callable[[Values, Values], System]] = {
    f.__name__: f
    for f in (
        *(tanks, flow_loop, valve_bench, thermal_mass, heat_exchanger, dc_motor, rectified_drive, battery, levitation),
        *(pneumatic_cylinder, spool, servo_axis, excavator_joint, hysteretic_damper, hydraulic_cylinder, pendulum),
        *(quarter_car, resonator, rolling_ship),
    )
}


def nominal(family: Any, values: Values, factors: Values) -> System:
    """Nominal model of a system: its unknown parameters off by ``factors``, what is known as it is."""
    start = {name: values[name] * factors.get(name, 1.0) for name in family.parameters}
    return NOMINAL[family.name](start, values)
