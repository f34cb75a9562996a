"""Where every number of the nominal plant stands in its two flat arrays: parameters p[row, lane] and state s[row,
lane], SI.

The rows of the effects follow behind (`plant.effects`).
"""

from __future__ import annotations

from plant.linkage import N_GEOMETRY

__all__ = [
    "ACCELERATION",
    "AREA",
    "BANDWIDTH",
    "DAMPING",
    "DECELERATION",
    "FLOW_GAIN",
    "GEOMETRY",
    "LAG",
    "LVDT_FACTOR",
    "LVDT_LAG",
    "LVDT_STEP",
    "MOTOR_NAMES",
    "MOTOR_STATE",
    "NAMES",
    "NOMINAL_STATE",
    "N_NOMINAL",
    "PLAY",
    "POT_BIAS",
    "POT_FACTOR",
    "POT_LAG",
    "P_REF",
    "RATED_CURRENT",
    "STROKE",
    "VALVE_A11",
    "VALVE_A12",
    "VALVE_A21",
    "VALVE_A22",
]

# ---- parameters: named rows first, they are what an engineer can recalibrate
NAMES = (
    "engine.lag",
    "engine.acceleration",
    "engine.deceleration",
    "valve.rated_current",
    "valve.bandwidth",
    "valve.damping",
    "actuator.flow_gain",
    "actuator.area",
    "actuator.stroke",
    "supply.pressure",
    "sensors.lvdt_lag",
    "sensors.pot_lag",
    "linkage.vigv_play",
    "linkage.vgv1_play",
    "linkage.vgv2_play",
    "sensors.vigv_bias",
    "sensors.vgv1_bias",
    "sensors.vgv2_bias",
)
(
    LAG,
    ACCELERATION,
    DECELERATION,
    RATED_CURRENT,
    BANDWIDTH,
    DAMPING,
    FLOW_GAIN,
    AREA,
    STROKE,
    P_REF,
    LVDT_LAG,
    POT_LAG,
    PLAY,  # three rows: total width at the ring, rad
    _,
    _,
    POT_BIAS,  # three rows, rad
    _,
    _,
) = range(len(NAMES))
GEOMETRY = len(NAMES)  # N_GEOMETRY rows, see plant.linkage
# rows worked out from the others by `plant.parameters.derive`
(LVDT_STEP, VALVE_A11, VALVE_A12, VALVE_A21, VALVE_A22, LVDT_FACTOR, POT_FACTOR, N_NOMINAL) = range(
    GEOMETRY + N_GEOMETRY, GEOMETRY + N_GEOMETRY + 8
)

# ---- state
NOMINAL_STATE = (
    "n_r",  # %, rotor speed
    "spool",  # -
    "spool_rate",  # 1/s
    "speed",  # m/s
    "x",  # m, stroke
    "x_lvdt",  # m, LVDT after its lag
    "ring_vigv",  # rad, ring angle behind its play
    "ring_vgv1",
    "ring_vgv2",
    "pot_vigv",  # rad, vane angle after the potentiometer's lag
    "pot_vgv1",
    "pot_vgv2",
)

# ---- electromechanical actuator: its rows stand behind all others (`plant.effects`)
MOTOR_NAMES = (
    "drive.rated_speed",
    "drive.speed_gain",
    "drive.speed_time",
    "drive.peak_current",
    "drive.current_bandwidth",
    "motor.torque_constant",
    "motor.resistance",
    "motor.inertia",
    "gear.ratio",
    "gear.inertia",
    "screw.lead",
    "screw.efficiency",
    "screw.friction",
    "screw.viscous",
    "screw.mass",
    "screw.stiffness",
    "supply.voltage",
)
MOTOR_STATE = (
    "i_motor",  # A
    "speed_integral",  # A, integral part of the speed loop
    "motor_speed",  # rad/s
    "bent",  # m, by which the load bends screw and bearings
)
