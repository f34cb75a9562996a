"""Families of mechanics: servo axis, hydraulic cylinder, pendulum, quarter car, hysteretic damper, resonator, excavator
joint, rolling ship.
"""

from __future__ import annotations

import math

import numpy as np

from tests.rig_systems.family import HELD, Family, Outside, Signal

__all__ = ["FAMILIES"]


def _axis(motion, p):
    _, v, a = motion
    return p.mass * a + p.viscous * v


SERVO_AXIS = Family(
    name="servo_axis",
    text="belt axis that follows its profile: position (m), speed (m/s) and drive force (N) measured",
    kind="force",
    parameters={"mass": (10.0, 150.0), "viscous": (30.0, 300.0)},  # Janot, Gautier, Brunot 2019: 95 kg, 203 N s/m
    inputs={"position": Signal(("moves", "multisine", "sweep"), -0.25, 0.25)},
    outputs=("force",),
    rhs=_axis,
    timescale=lambda p: 0.4,
    per_scale=(150.0, 450.0),
    samples=(3000, 6000),
    noise={"force": (0.003, 0.03), "position": (1e-5, 1e-4)},
    laws=(
        *("force.coulomb", "force.stribeck", "force.force_offset", "force.quadratic_drag", "force.spring"),
        *("force.friction_asymmetry", "force.elastic_plastic", "force.cubic_spring"),
    ),
    partners={"force.friction_asymmetry": "force.coulomb"},
    outside={
        "pulley": Outside(
            "an eccentric pulley: the belt's lever swings with the position (0.2 m a turn)", 0.005, 0.2,
            output=lambda t, x, u, p, s, y: y * (1.0 + s * np.sin(x[0] * 2.0 * np.pi / 0.2)),
        ),
        "warming": Outside(
            "viscous friction falls over the log as the grease warms", 0.05, 0.8,
            output=lambda t, x, u, p, s, y: y - s * t * p.viscous * x[1],
        ),
    },
)  # fmt: skip


def _joint(motion, p):
    x, v, a = motion
    return p.inertia * a + p.weight * np.cos(x) + p.viscous * v


EXCAVATOR_JOINT = Family(
    name="excavator_joint",
    text="boom joint: angle (rad) and torque from the cylinder's pressures (kN m)",
    kind="force",
    parameters={"inertia": (2.0, 15.0), "weight": (10.0, 50.0), "viscous": (1.0, 10.0)},  # 6 to 20 t machines
    inputs={"position": Signal(("moves", "multisine", "moves"), -0.8, 0.8)},
    outputs=("torque",),
    rhs=_joint,
    timescale=lambda p: 1.0,
    per_scale=(50.0, 200.0),
    samples=(3000, 6000),
    noise={"torque": (0.005, 0.03), "position": (2e-5, 2e-4)},
    laws=(
        *("force.coulomb", "force.stribeck", "force.force_offset", "force.quadratic_drag", "force.elastic_plastic"),
        *("force.bouc_wen", "force.spring", "torque.saturation", "torque.lag"),
    ),
    outside={
        "loaded": Outside(
            "friction grows with the load on the pin", 0.01, 0.3,
            output=lambda t, x, u, p, s, y: y + s * np.abs(y) * np.sign(x[1]),
        ),
        "bucket": Outside(
            "the bucket fills in the middle of the log", 0.01, 0.4,
            output=lambda t, x, u, p, s, y: y + s * p.weight * np.cos(x[0]) * (t > 0.5),
        ),
    },
)  # fmt: skip


def _damper(motion, p):
    x, v, _ = motion
    return p.stiffness * x + p.damping * v


DAMPER = Family(
    name="hysteretic_damper",
    text="damper in a test rig: displacement (mm) imposed, force (kN) measured",
    kind="force",
    parameters={"stiffness": (0.02, 0.5), "damping": (0.005, 0.1)},
    inputs={"position": Signal(("sweep", "multisine", "moves"), -20.0, 20.0)},
    outputs=("force",),
    rhs=_damper,
    timescale=lambda p: 0.5,
    per_scale=(100.0, 500.0),
    samples=(3000, 6000),
    noise={"force": (0.003, 0.03), "position": (1e-5, 1e-4)},
    laws=(
        *("force.elastic_plastic", "force.bouc_wen", "force.coulomb", "force.cubic_spring", "force.quadratic_drag"),
        *("force.force_offset", "force.backlash_gap", "force.stribeck"),
    ),
    partners={"force.backlash_gap": "force.elastic_plastic"},
    outside={
        "fade": Outside(
            "the damping fades over the log", 0.03, 0.7,
            output=lambda t, x, u, p, s, y: y - s * t * p.damping * x[1],
        ),
        "membrane": Outside(
            "a membrane stiffens with the displacement's square, either way", 0.01, 0.6,
            output=lambda t, x, u, p, s, y: y + s * p.stiffness * x[0] * np.abs(x[0]) / 20.0,
        ),
    },
)  # fmt: skip


def _cylinder(x, u, p):
    """Sharp-edged valve at constant supply (Merritt 1967): opening -1 to 1, load as a share of the supply; mm."""
    way = 1.0 if u[0] > 0.0 else -1.0 if u[0] < 0.0 else 0.0
    return (p.gain * u[0] * max(1.0 - way * u[1], 0.0) ** 0.5,)


HYDRAULIC_CYLINDER = Family(
    name="hydraulic_cylinder",
    text="valve-driven cylinder: opening and load pressure in, position (mm) out; integrates",
    kind="simulate",
    parameters={"gain": (30.0, 600.0)},
    inputs={
        "valve": Signal(("steps", "multisine", "sweep", "cycle"), -1.0, 1.0),
        "load": Signal(("cycle", "multisine", "steps"), -0.5, 0.5),
    },
    states=("position",),
    outputs=("position",),
    rhs=_cylinder,
    timescale=lambda p: 0.5,
    per_scale=(25.0, 100.0),
    window=6.0,
    start=lambda p, u: (0.0,),
    noise={"position": (0.0005, 0.003)},
    laws=(
        *("valve.dead_zone", "valve.asymmetric_gain", "valve.bias", "valve.play", "valve.lag", "valve.dead_time"),
        *("valve.saturation", "valve.smooth_saturation", "valve.cubic", "position.offset", "position.rate_limit"),
        *("load.bias", "valve.rate_limit"),
    ),
    outside={
        "leakage": Outside(
            "oil leaks past the piston with the load", 0.003, 0.1,
            rate=lambda t, x, u, p, s, d: [d[0] - s * p.gain * u[1]],
        ),
        "worn_edge": Outside(
            "one control edge opens late", 0.01, 0.3,
            rate=lambda t, x, u, p, s, d: [
                d[0] * (max(u[0] - s, 0.0) / u[0] if u[0] > 0.0 else 1.0)
            ],
            # shifted by half the overlap, a dead zone of half the overlap is one on one side
            amounts_to=(frozenset({"valve.bias", "valve.dead_zone"}),),
        ),
    },
    same=(frozenset({"valve.asymmetric_gain", "valve.absolute_value"}),),
    apart={"valve.rate_limit": HELD},
)  # fmt: skip


def _pendulum(x, u, p):
    return p.drive * u[0] - p.gravity * math.sin(x[1]) - p.damping * x[0], x[0]


PENDULUM = Family(
    name="pendulum",
    text="driven pendulum: torque (N m) in, angle (rad) and rate (rad/s) measured",
    kind="simulate",
    parameters={"gravity": (5.0, 60.0), "damping": (0.2, 1.0), "drive": (0.5, 5.0)},
    inputs={"torque": Signal(("steps", "multisine", "sweep"), -0.5, 0.5, lambda p: p.gravity / p.drive)},
    states=("rate", "angle"),
    outputs=("angle", "rate"),
    rhs=_pendulum,
    rates={"rate": "angle"},
    timescale=lambda p: 2.0 / p.gravity**0.5,
    per_scale=(25.0, 60.0),
    line=True,
    start=lambda p, u: (0.0, math.asin(max(-0.9, min(0.9, p.drive * u[0] / p.gravity)))),
    noise={"angle": (0.002, 0.02), "rate": (0.003, 0.03)},
    laws=(
        *("rate.coulomb", "rate.stribeck", "rate.quadratic_drag", "rate.force_offset", "rate.spring"),
        *("rate.cubic_spring", "rate.friction_asymmetry", "torque.dead_zone", "torque.saturation", "torque.dead_time"),
        *("torque.asymmetric_gain", "angle_sensor.quantisation", "angle_sensor.cubic", "rate_sensor.lag"),
    ),
    partners={"rate.friction_asymmetry": "rate.coulomb"},
    outside={
        "shaken": Outside(
            "its pivot is shaken", 0.01, 0.3,
            rate=lambda t, x, u, p, s, d: [d[0] - s * p.gravity * math.sin(300.0 * t) * math.sin(x[1]), d[1]],
        ),
        "cable": Outside(
            "a cable pulls when it swings out to one side", 0.02, 1.0,
            rate=lambda t, x, u, p, s, d: [d[0] - s * p.gravity * max(x[1] - 0.15, 0.0), d[1]],
        ),
    },
    same=(
        frozenset({"rate.force_offset", "torque.bias"}),  # drive (u + b) = drive u + a constant torque
        frozenset({"torque.asymmetric_gain", "torque.absolute_value"}),
    ),
)  # fmt: skip


def _car(x, u, p):
    """Body over its measured axle: m r'' = - k r - c r' - m a_axle; r: travel in m."""
    return -(p.spring * x[1] + p.damping * x[0]) / p.mass - u[0], x[0]


QUARTER_CAR = Family(
    name="quarter_car",
    text="quarter car: axle acceleration (m/s^2) in, suspension travel (m) and its rate (m/s) measured",
    kind="simulate",
    parameters={"spring": (12e3, 40e3), "damping": (800.0, 3000.0)},  # Gillespie 1992, Wong 2008
    known=lambda p: {"mass": 350.0},
    inputs={"axle": Signal(("multisine", "cycle", "steps"), -2.5, 2.5)},
    states=("rate", "travel"),
    outputs=("travel", "rate"),
    rhs=_car,
    rates={"rate": "travel"},
    masses={"rate": "mass"},
    timescale=lambda p: 2.0 * (p.mass / p.spring) ** 0.5,
    per_scale=(25.0, 80.0),
    line=True,
    start=lambda p, u: (0.0, -u[0] * p.mass / p.spring),
    noise={"travel": (0.003, 0.02), "rate": (0.003, 0.03)},
    laws=(
        *("rate.coulomb", "rate.stribeck", "rate.elastic_plastic", "rate.bouc_wen", "rate.cubic_spring"),
        *("rate.quadratic_drag", "rate.friction_asymmetry", "rate.force_offset", "travel_sensor.lag"),
        *("travel_sensor.cubic", "axle.lag", "axle.dead_time", "axle.saturation"),
    ),
    partners={"rate.friction_asymmetry": "rate.coulomb"},
    outside={
        "rebound": Outside(
            "the damper is softer in compression than in rebound", 0.03, 0.7,
            rate=lambda t, x, u, p, s, d: [d[0] - s * p.damping * abs(x[0]) / p.mass, d[1]],
        ),
        "bump_stop": Outside(
            "a bump stop ends the travel to one side", 0.05, 5.0,
            rate=lambda t, x, u, p, s, d: [d[0] - s * p.spring * max(x[1] - 0.03, 0.0) / p.mass, d[1]],
            amounts_to=(frozenset({"rate.end_stop"}),),
        ),
    },
    same=(frozenset({"rate.force_offset", "axle.bias"}),),  # m (a + b) = m a + a constant force
)  # fmt: skip


def _resonator(x, u, p):
    return (u[0] - p.spring * x[1] - p.damping * x[0]) / p.mass, x[0]


RESONATOR = Family(
    name="resonator",
    text="resonator on a shaker: force (N) in, displacement (mm) and speed (mm/s, laser) measured",
    kind="simulate",
    parameters={"spring": (0.5, 40.0), "damping": (0.002, 0.02)},  # N/mm; N s/mm
    known=lambda p: {"mass": 1e-4},  # N s^2/mm: 0.1 kg
    inputs={"force": Signal(("multisine", "sweep", "binary"), -1.0, 1.0, lambda p: 2.0 * p.spring)},
    states=("speed", "place"),
    outputs=("place", "speed"),
    rhs=_resonator,
    rates={"speed": "place"},
    masses={"speed": "mass"},
    timescale=lambda p: 2.0 * (p.mass / p.spring) ** 0.5,
    per_scale=(20.0, 40.0),
    line=True,
    start=lambda p, u: (0.0, u[0] / p.spring),
    noise={"place": (0.002, 0.02), "speed": (0.003, 0.03)},
    laws=(
        *("speed.cubic_spring", "speed.coulomb", "speed.quadratic_drag", "speed.elastic_plastic", "speed.bouc_wen"),
        *("place_sensor.cubic", "place_sensor.saturation", "place_sensor.lag", "force.cubic", "force.lag"),
        *("force.saturation", "force.smooth_saturation", "force.dead_time", "speed.force_offset"),
    ),
    outside={
        "one_sided": Outside(
            "the spring stiffens to one side (square term)", 0.01, 0.4,
            rate=lambda t, x, u, p, s, d: [d[0] - s * p.spring * x[1] * x[1] / 2.0 / p.mass, d[1]],
        ),
        "pumped": Outside(
            "its stiffness swings at a frequency of its own", 0.01, 0.3,
            rate=lambda t, x, u, p, s, d: [d[0] - s * p.spring * math.sin(400.0 * t) * x[1] / p.mass, d[1]],
        ),
    },
    same=(frozenset({"speed.force_offset", "force.bias"}),),
)  # fmt: skip


def _ship(x, u, p):
    return p.frequency**2 * (p.wave * u[0] - x[1]) - 2.0 * p.damping * p.frequency * x[0], x[0]


SHIP = Family(
    name="rolling_ship",
    text="roll of a ship: wave slope (deg) in, roll angle (deg) and rate (deg/s) measured",
    kind="simulate",
    parameters={"frequency": (0.3, 1.2), "damping": (0.03, 0.2), "wave": (0.3, 0.9)},  # Faltinsen 1990
    inputs={"slope": Signal(("multisine", "sweep"), -5.0, 5.0)},
    states=("rate", "roll"),
    outputs=("roll", "rate"),
    rhs=_ship,
    rates={"rate": "roll"},
    timescale=lambda p: 2.0 / p.frequency,
    per_scale=(10.0, 25.0),
    line=True,
    start=lambda p, u: (0.0, p.wave * u[0]),
    noise={"roll": (0.003, 0.02), "rate": (0.003, 0.03)},
    laws=(
        *("rate.quadratic_drag", "rate.cubic_spring", "rate.coulomb", "rate.force_offset", "roll_sensor.bias"),
        *("rate_sensor.lag", "slope.lag", "slope.dead_time", "slope.saturation", "roll_sensor.quantisation"),
    ),
    outside={
        "cargo": Outside(
            "the righting lever falls as the cargo shifts over the log", 0.01, 0.4,
            rate=lambda t, x, u, p, s, d: [d[0] + s * t * p.frequency**2 * x[1], d[1]],
        ),
        "lever": Outside(
            "the righting lever bends as the sine of three times the angle", 0.02, 0.5,
            rate=lambda t, x, u, p, s, d: [
                d[0] + s * p.frequency**2 * 10.0 * math.sin(3.0 * math.radians(x[1])), d[1]
            ],
        ),
    },
    same=(frozenset({"rate.force_offset", "slope.bias", "roll_sensor.bias"}),),  # at all but the first instants
)  # fmt: skip

FAMILIES = (SERVO_AXIS, EXCAVATOR_JOINT, DAMPER, HYDRAULIC_CYLINDER, PENDULUM, QUARTER_CAR, RESONATOR, SHIP)
