"""Where every number of the nominal plant stands in its two flat arrays: parameters p[row, lane] and state s[row,
lane], SI.

What a stage has stands in `MOST` rows side by side, those of the machine's own stages first. The rows of the effects
follow behind (`plant.effects`).
"""

from __future__ import annotations

from plant.linkage import N_GEOMETRY
from vaneloop.base.curve import POINTS
from vaneloop.base.hysteresis import RADII
from vaneloop.base.vanes import MOST, VANES

__all__ = [
    "ACCELERATION", "AREA", "BANDWIDTH", "CURVE_ROWS", "C_HIGH", "C_LAG", "C_LOW", "C_OF", "C_PERIOD", "C_SITE",
    "C_STOPS", "C_TABLE", "DAMPING", "DECELERATION", "FLOW_GAIN", "GEOMETRY", "LAG", "LVDT_FACTOR", "LVDT_LAG",
    "LVDT_STEP", "MOST_CURVES", "MOTOR_NAMES", "MOTOR_STATE", "NAMES", "NOMINAL_STATE", "N_NOMINAL", "PLAY", "POT_BIAS",
    "POT_FACTOR", "POT_LAG", "P_REF", "RATED_CURRENT", "SIGNALS", "STROKE", "UNISON_NAMES", "VALVE_A11", "VALVE_A12",
    "VALVE_A21", "VALVE_A22", "VANE_COUNT",
]  # fmt: skip

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
    *(f"linkage.{v}_play" for v in VANES),
    *(f"sensors.{v}_bias" for v in VANES),
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
    PLAY,  # a row a stage: total width at the ring, rad
) = range(len(NAMES) - 2 * MOST + 1)
POT_BIAS = PLAY + MOST  # a row a stage, rad
GEOMETRY = len(NAMES)  # N_GEOMETRY rows, see plant.linkage
VANE_COUNT = GEOMETRY + N_GEOMETRY  # -, stages that the machine has; rows of stages that it lacks are not used
# rows worked out from the others by `plant.parameters.derive`
(LVDT_STEP, VALVE_A11, VALVE_A12, VALVE_A21, VALVE_A22, LVDT_FACTOR, POT_FACTOR, N_NOMINAL) = range(
    VANE_COUNT + 1, VANE_COUNT + 9
)

# ---- state
NOMINAL_STATE = (
    "n_r",  # %, rotor speed
    "spool",  # -
    "spool_rate",  # 1/s
    "speed",  # m/s
    "x",  # m, stroke
    "x_lvdt",  # m, LVDT after its lag
    *(f"ring_{v}" for v in VANES),  # rad, ring angle behind its play
    *(f"pot_{v}" for v in VANES),  # rad, vane angle after the potentiometer's lag
)

# ---- curves that were learned (`plant.curve`): behind all others too
MOST_CURVES = 4
# rows of one: where, of which signal, its range, the period after which it repeats itself (0: it does not), the time
# constant of the lag behind which it has its signal (0: none), whether it is a hysteresis (1; 0: no), its table; of a
# hysteresis the first rows are the weights of its stops, and the others are not used
(C_SITE, C_OF, C_LOW, C_HIGH, C_PERIOD, C_LAG, C_STOPS, C_TABLE) = range(8)
CURVE_ROWS = C_TABLE + POINTS
SIGNALS = (  # what a curve may be a function of, SI (speeds in %, temperature in degC)
    "i_cmd",
    "x",
    "speed",
    "n_r",
    "p_s",
    "t_oil",
    "time",
    "n_dem",
    "x_dem",
    "direction",  # of the stroke, -1 or 1; 0 before it first moves
    "distance",  # m since the stroke last turned
    "since",  # s since then
    *VANES,
    "farthest",  # m: memory of the last three
    "turned",  # m
    "reached",  # s
    "turned_at",  # s
    *(f"late_{c}" for c in range(MOST_CURVES)),  # of each curve with a lag, its signal behind that; of a hysteresis,
    # what it gives
    *(f"last_{c}" for c in range(MOST_CURVES)),  # of each hysteresis, its signal at the last tick
    *(f"stop_{c}_{i}" for c in range(MOST_CURVES) for i in range(RADII)),  # and how far each of its stops is bent
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

# ---- two actuators (`plant.unison`): their rows stand behind those
UNISON_NAMES = (
    "actuators.ring_stiffness",  # N m/rad
    "actuators.pot_position",  # rad around the ring from where actuator A drives it
    "actuators.line_conductance",  # m/s/Pa, from the one valve to either piston; 0: a valve each
)
