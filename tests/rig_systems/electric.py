"""Families with electricity in them: DC motor, drive with a rectifying sensor, battery, magnetic levitation, pneumatic
cylinder behind its electric regulator, gas turbine spool.
"""

from __future__ import annotations

import math

import numpy as np

from tests.rig_systems.family import HELD, Family, Outside, Signal

__all__ = ["FAMILIES"]


def _motor(x, u, p):
    """J w' = k i, i = (v - k w) / R: no friction in the nominal model; winding time constant below the log's."""
    current = (u[0] - p.constant * x[0]) / p.resistance
    return p.constant * current / p.inertia, x[0]


def _heats(t, x, u, p, s, d):
    """The winding's resistance grows over the log; mechanical side only, which the current sensor does not see."""
    current = (u[0] - p.constant * x[0]) / p.resistance
    return [d[0] - s * t * p.constant * current / p.inertia, d[1]]


DC_MOTOR = Family(
    name="dc_motor",
    text="DC motor with gear: armature voltage in, speed (rad/s) and current (A) measured",
    kind="simulate",
    parameters={"resistance": (0.5, 2.0), "constant": (0.03, 0.08), "inertia": (2e-5, 2e-4)},  # 50 to 200 W catalogues
    inputs={"voltage": Signal(("steps", "binary", "sweep", "cycle"), -12.0, 12.0)},
    states=("speed", "angle"),
    outputs=("speed", "current"),
    output=lambda x, u, p: (x[0], (u[0] - p.constant * x[0]) / p.resistance),
    rhs=_motor,
    rates={"speed": "angle"},
    masses={"speed": "inertia"},
    timescale=lambda p: p.inertia * p.resistance / p.constant**2,
    start=lambda p, u: (0.0, 0.0),
    noise={"speed": (0.003, 0.02), "current": (0.005, 0.03)},
    laws=(
        *("speed.coulomb", "speed.stribeck", "speed.viscous", "speed.quadratic_drag", "speed.force_offset"),
        *("speed.friction_asymmetry", "voltage.dead_zone", "voltage.saturation", "voltage.dead_time"),
        *("voltage.asymmetric_gain", "speed_sensor.lag", "speed_sensor.quantisation", "current.bias"),
    ),
    partners={"speed.friction_asymmetry": "speed.coulomb"},
    outside={
        "cogging": Outside(
            "torque ripples with the angle (7 slots)", 0.02, 0.6,
            rate=lambda t, x, u, p, s, d: [
                d[0] - s * p.constant * 3.0 / p.resistance / p.inertia * math.sin(7.0 * x[1]), d[1]
            ],
        ),
        "weakening": Outside("the magnets weaken as they warm over the log", 0.01, 0.3, rate=_heats),
    },
    apart={"voltage.dead_time": HELD},
)  # fmt: skip


def _drive(x, u, p):
    """Two pulleys and a belt behind a motor of first order (Wigren, Schoukens 2017: coupled electric drives)."""
    w2 = p.belt**2
    return (p.gain * u[0] - x[0]) / p.lag, x[2], w2 * (x[0] - x[1]) - 2.0 * p.damping * p.belt * x[2]


RECTIFIED_DRIVE = Family(
    name="rectified_drive",
    text="two motors drive a belt; a pulse counter measures the pulley's speed",
    kind="simulate",
    parameters={"gain": (0.5, 3.0), "lag": (0.1, 0.5), "belt": (3.0, 20.0), "damping": (0.1, 0.5)},
    inputs={"drive": Signal(("binary", "steps", "multisine", "sweep"), -1.0, 1.0)},
    states=("motor", "speed", "change"),
    outputs=("pulses",),
    output=lambda x, u, p: (x[1],),
    rhs=_drive,
    timescale=lambda p: p.lag + 1.0 / p.belt,
    per_scale=(20.0, 40.0),
    start=lambda p, u: (0.0, 0.0, 0.0),
    noise={"pulses": (0.003, 0.02)},
    laws=(
        *("pulses.absolute_value", "pulses.saturation", "pulses.lag", "pulses.dead_time", "pulses.dead_zone"),
        *("drive.dead_zone", "drive.saturation", "drive.dead_time", "drive.asymmetric_gain", "drive.smooth_saturation"),
        *("drive.bias", "motor.quadratic_drag", "motor.rate_limit"),
    ),
    outside={
        "slip": Outside(
            "the belt slips beyond a torque", 0.02, 1.0,
            rate=lambda t, x, u, p, s, d: [
                d[0], d[1], d[2] - p.belt**2 * ((x[0] - x[1]) - math.tanh(s * (x[0] - x[1])) / s)
            ],
        ),
        "ripple": Outside(
            "the motor's supply has a ripple that nobody logs", 0.005, 0.2,
            rate=lambda t, x, u, p, s, d: [d[0] + s * p.gain / p.lag * math.sin(220.0 * t), d[1], d[2]],
        ),
    },
    same=(
        frozenset({"drive.dead_time", "pulses.dead_time"}),  # linear from the drive to the pulses
        frozenset({"drive.lag", "pulses.lag"}),
        frozenset({"drive.second_order_lag", "pulses.second_order_lag"}),
        frozenset({"drive.bias", "motor.offset"}),
        frozenset({"drive.asymmetric_gain", "drive.absolute_value"}),
    ),
)  # fmt: skip


def _cell(x, u, p):
    """Thevenin model (Plett 2015): charge in Ah drawn, voltage over one RC pair; a discharge is positive."""
    return u[0] / 3600.0, (p.r1 * u[0] - x[1]) / p.tau


BATTERY = Family(
    name="battery",
    text="lithium-ion cell: current in, terminal voltage out",
    kind="simulate",
    parameters={"e0": (3.6, 4.1), "fall": (0.1, 0.4), "r0": (0.005, 0.05), "r1": (0.005, 0.05), "tau": (10.0, 60.0)},
    inputs={"current": Signal(("cycle", "binary", "steps"), -3.0, 5.0)},
    states=("charge", "polarisation"),
    outputs=("voltage",),
    output=lambda x, u, p: (p.e0 - p.fall * x[0] - p.r0 * u[0] - x[1],),
    rhs=_cell,
    timescale=lambda p: p.tau,
    start=lambda p, u: (0.0, 0.0),
    noise={"voltage": (0.005, 0.03)},
    laws=(
        *("current.bias", "current.asymmetric_gain", "current.dead_zone", "current.saturation", "current.dead_time"),
        *("polarisation.cubic", "polarisation.quadratic_drag", "charge.leak", "charge.square_root"),
        *("current.smooth_saturation", "voltage.lag", "voltage.quantisation", "current.cubic"),
    ),
    outside={
        "empties": Outside(
            "the inner resistance rises as the cell empties", 0.02, 2.0,
            output=lambda t, x, u, p, s, y: y - s * p.r0 * u * x[0] / max(float(np.ptp(x[0])), 1e-9),
        ),
        "cold": Outside(
            "the inner resistance falls as the cell warms over the log", 0.02, 0.6,
            output=lambda t, x, u, p, s, y: y + s * p.r0 * u * t,
        ),
    },
    same=(
        # a constant current: the charge drawn grows steadily, the rest is a constant voltage, which e0 takes
        frozenset({"current.bias", "charge.offset"}),
        frozenset({"current.asymmetric_gain", "current.absolute_value"}),
        frozenset({"current.dead_time", "voltage.dead_time"}),
        frozenset({"current.lag", "voltage.lag"}),
        frozenset({"current.second_order_lag", "voltage.second_order_lag"}),
    ),
    apart={"current.dead_time": HELD, "voltage.lag": HELD},
)  # fmt: skip


def _levitation(x, u, p):
    """m g - k (i / gap)^2 (Woodson, Melcher 1968), per mass: gap mm, current A."""
    return x[1], 9810.0 - p.strength * (u[0] / x[0]) ** 2


def _hover(r, y, p):
    return p.bias + p.stiff * (y[0] - r[0]) + p.damp * y[1]


def _gains(p):
    """Gains that place the loop's poles at 1.5 times the open loop's, damping 0.8, around 8 mm."""
    current = 8.0 * (9810.0 / p.strength) ** 0.5
    pole = (2.0 * 9810.0 / 8.0) ** 0.5
    b = 2.0 * 9810.0 / current
    return {"bias": current, "stiff": (pole**2 + (1.5 * pole) ** 2) / b, "damp": 2.0 * 0.8 * 1.5 * pole / b}


LEVITATION = Family(
    name="levitation",
    text="magnetic levitation in its loop: gap reference in, gap and its rate measured; the controller is known",
    kind="closed_loop",
    parameters={"strength": (5e4, 5e6)},
    known=_gains,
    inputs={"reference": Signal(("steps", "binary", "multisine"), 7.2, 8.8)},
    states=("gap", "rate"),
    outputs=("gap", "rate"),
    rhs=_levitation,
    control=_hover,
    timescale=lambda p: 0.02,
    per_scale=(20.0, 40.0),
    samples=(1000, 1600),
    start=lambda p, u: (8.0, 0.0),
    rates={"rate": "gap"},
    noise={"gap": (0.003, 0.02), "rate": (0.005, 0.03)},
    laws=(
        *("command.bias", "command.cubic", "command.gain", "gap_sensor.bias", "gap_sensor.cubic", "gap_sensor.gain"),
        *("rate.force_offset", "rate.viscous", "rate.spring", "rate.quadratic_drag", "rate_sensor.gain"),
    ),
    outside={
        "saturates": Outside(
            "the iron saturates with the flux", 0.01, 0.3,
            rate=lambda t, x, u, p, s, d: [
                d[0], 9810.0 - (9810.0 - d[1]) / (1.0 + s * (9810.0 - d[1]) / 9810.0)
            ],
        ),
        "eddies": Outside(
            "eddy currents brake in proportion to the force", 0.01, 0.3,
            rate=lambda t, x, u, p, s, d: [d[0], d[1] - s * x[1] / 0.02 * (9810.0 - d[1]) / 9810.0],
        ),
    },
)  # fmt: skip


def _pneumatic(x, u, p):
    """Regulator of first order, piston against a spring: pressure bar, speed mm/s, position mm; mass known; N, N/mm."""
    force = p.area * x[0] - p.spring * x[2] - p.damping * x[1]
    return (6.0 * u[0] - x[0]) / p.fill, 1e3 * force / p.mass, x[1]


PNEUMATIC_CYLINDER = Family(
    name="pneumatic_cylinder",
    text="spring-returned pneumatic cylinder behind a pressure regulator (0 to 1 opens to 6 bar)",
    kind="simulate",
    parameters={"fill": (0.02, 0.2), "area": (50.0, 200.0), "spring": (5.0, 20.0), "damping": (0.3, 1.0)},
    known=lambda p: {"mass": 4.0},
    inputs={"regulator": Signal(("steps", "cycle", "multisine"), 0.05, 0.95)},
    states=("pressure", "speed", "position"),
    outputs=("pressure", "position"),
    output=lambda x, u, p: (x[0], x[2]),
    rhs=_pneumatic,
    rates={"speed": "position"},
    timescale=lambda p: p.fill + 2.0 * (p.mass / (1e3 * p.spring)) ** 0.5,
    per_scale=(25.0, 60.0),
    start=lambda p, u: (6.0 * u[0], 0.0, p.area * 6.0 * u[0] / p.spring),
    noise={"pressure": (0.003, 0.02), "position": (0.001, 0.01)},
    laws=(
        *("speed.coulomb", "speed.stribeck", "speed.cubic_spring", "speed.force_offset", "speed.quadratic_drag"),
        *("speed.elastic_plastic", "speed.friction_asymmetry", "pressure.leak", "pressure.saturation"),
        *("pressure.rate_limit", "regulator.dead_time", "regulator.lag", "regulator.play", "position_sensor.cubic"),
        "pressure_sensor.bias",
    ),
    partners={"speed.friction_asymmetry": "speed.coulomb"},
    outside={
        "seal": Outside(
            "the seal's friction grows with the pressure", 0.005, 0.1,
            rate=lambda t, x, u, p, s, d: [
                d[0], d[1] - s * 1e3 * p.area * x[0] * math.tanh(x[1] / 2.0) / p.mass, d[2]
            ],
        ),
        "vents": Outside(
            "it vents more slowly than it fills", 0.02, 0.6,
            rate=lambda t, x, u, p, s, d: [d[0] * (1.0 - s) if d[0] < 0.0 else d[0], d[1], d[2]],
        ),
    },
    # (6 u - p)/fill - c p = (6 u / (1 + c fill) - p) / (fill / (1 + c fill))
    same=(
        frozenset({"pressure.leak", "regulator.gain", "regulator.asymmetric_gain"}),
        frozenset({"regulator.bias", "regulator.dead_zone", "pressure.offset"}),
        frozenset({"pressure_sensor.bias", "pressure_sensor.dead_zone"}),
        # while the spring is linear, a constant force and a constant in the position's sensor are the same
        frozenset({"speed.force_offset", "position_sensor.bias", "position_sensor.dead_zone"}),
    ),
)  # fmt: skip


def _spool(x, u, p):
    return ((p.gain * u[0] - x[0]) / p.spool_lag,)


SPOOL = Family(
    name="spool",
    text="gas turbine spool: fuel flow (kg/h) in, speed (%) and exhaust temperature (K) measured",
    kind="simulate",
    parameters={"gain": (0.5, 2.0), "spool_lag": (0.3, 3.0), "heat": (3.0, 8.0), "cooling": (1.0, 3.0)},
    inputs={"fuel": Signal(("cycle", "steps", "multisine"), 0.3, 1.0, lambda p: 100.0 / p.gain)},
    states=("speed",),
    outputs=("speed", "exhaust"),
    output=lambda x, u, p: (x[0], 600.0 + p.heat * p.gain * u[0] - p.cooling * x[0]),
    rhs=_spool,
    timescale=lambda p: p.spool_lag,
    start=lambda p, u: (p.gain * u[0],),
    noise={"speed": (0.002, 0.02), "exhaust": (0.003, 0.03)},
    laws=(
        *("fuel.rate_limit", "fuel.saturation", "fuel.lag", "fuel.dead_time", "fuel.cubic", "speed.rate_limit"),
        *("speed.quadratic_drag", "exhaust.lag", "exhaust.dead_time", "exhaust.second_order_lag"),
        *("speed_sensor.bias", "exhaust.saturation", "speed.offset", "fuel.play"),
    ),
    outside={
        "sluggish": Outside(
            "the spool is slower at low speed", 0.03, 0.8,
            rate=lambda t, x, u, p, s, d: [d[0] / (1.0 + s * (1.0 - x[0] / 100.0))],
        ),
        "fouled": Outside(
            "the compressor fouls: the exhaust gets hotter over the log", 0.003, 0.1,
            output=lambda t, x, u, p, s, y: np.array([y[0], y[1] + s * 500.0 * t]),
        ),
    },
    # fuel and speed stay above 0
    same=(
        frozenset({"fuel.bias", "fuel.dead_zone"}),
        frozenset({"speed_sensor.bias", "speed_sensor.dead_zone"}),
    ),
    apart={"fuel.rate_limit": HELD, "fuel.dead_time": HELD, "exhaust.lag": HELD, "exhaust.dead_time": HELD},
)  # fmt: skip

FAMILIES = (DC_MOTOR, RECTIFIED_DRIVE, BATTERY, LEVITATION, PNEUMATIC_CYLINDER, SPOOL)
