"""Rows of the plant's two arrays by name: what moves, in s[row, lane], and the effects' parameters, in p[row, lane].

The nominal parameters' rows are in `plant.layout`.
"""

from __future__ import annotations

from plant.effects import MOTOR_AT, ROW, STATE_ROW
from plant.layout import MOTOR_STATE, NOMINAL_STATE
from vaneloop.base.vanes import MOST

(N_R, SPOOL, SPOOL_RATE, SPEED, X, X_LVDT, RING) = range(len(NOMINAL_STATE) - 2 * MOST + 1)
POT = RING + MOST

# ---- the effects' first rows in p, in the order of the signal flow
CAN_DELAY = ROW["can_delay"]
FRAME_HOLD = ROW["frame_hold"]
SCHEDULE_ERROR = ROW["schedule_error"]
TREND_THRESHOLD_ERROR = ROW["trend_threshold_error"]
CONTROLLER_GAIN_ERROR = ROW["controller_gain_error"]
ROTOR_LAG_ERROR = ROW["rotor_lag_error"]
ACCELERATION_LIMIT_ERROR = ROW["acceleration_limit_error"]
VALVE_NULL_BIAS = ROW["valve_null_bias"]
VALVE_HYSTERESIS = ROW["valve_hysteresis"]  # width, spread
VALVE_LAG = ROW["valve_lag"]  # used through VALVE_SHARE
VALVE_DEAD_BAND = ROW["valve_dead_band"]
VALVE_GAIN_ASYMMETRY = ROW["valve_gain_asymmetry"]
OIL_VISCOSITY = ROW["oil_viscosity"]
AERO_LOAD = ROW["aero_load"]
SUPPLY_PRESSURE_DROOP = ROW["supply_pressure_droop"]
VALVE_FLOW_SATURATION = ROW["valve_flow_saturation"]
INTERNAL_LEAKAGE = ROW["internal_leakage"]
PISTON_STICTION = ROW["piston_stiction"]  # excess, speed
PISTON_FRICTION = ROW["piston_friction"]
OIL_COMPRESSIBILITY = ROW["oil_compressibility"]  # compliance, drag
AMPLIFIER_OFFSET = ROW["amplifier_offset"]
AMPLIFIER_LAG = ROW["amplifier_lag"]  # used through AMPLIFIER_SHARE
AMPLIFIER_DEAD_BAND = ROW["amplifier_dead_band"]
TACHO_THERMAL_DRIFT = ROW["tacho_thermal_drift"]
MOTOR_TORQUE_CONSTANT_ERROR = ROW["motor_torque_constant_error"]
SCREW_FRICTION_ERROR = ROW["screw_friction"]
GEAR_BACKLASH = ROW["gear_backlash"]
SCREW_PITCH_ERROR = ROW["screw_pitch_error"]  # amplitude, phase
END_STOP_SHIFT = ROW["end_stop_shift"]
LVDT_LAG_ERROR = ROW["lvdt_lag"]  # used through LVDT_SHARE
LVDT_NONLINEARITY = ROW["lvdt_nonlinearity"]  # amplitude, cubic
LVDT_GAIN = ROW["lvdt_gain"]
LVDT_THERMAL_DRIFT = ROW["lvdt_thermal_drift"]
LVDT_BIAS = ROW["lvdt_bias"]
RIGGING_OFFSET = ROW["rigging_offset"]
RING_STIFFNESS_RATIO = ROW["ring_stiffness"]
CRANK_LENGTH_ERROR = ROW["crank_length_error"]  # here and below: MOST rows, one a vane stage
LINK_LENGTH_ERROR = ROW["link_length_error"]
RING_ECCENTRICITY = ROW["ring_eccentricity"]  # amplitudes, then one phase
THERMAL_GROWTH = ROW["thermal_growth"]
LINKAGE_COMPLIANCE = ROW["linkage_compliance"]  # one row for all
LINKAGE_BACKLASH = ROW["linkage_backlash"]
LINKAGE_WEAR = ROW["linkage_wear"]
LINKAGE_FRICTION = ROW["linkage_friction"]  # widths, then one distance
POT_GAIN = ROW["pot_gain"]
POT_LAG_ERROR = ROW["pot_lag"]  # used through POT_SHARE
POT_BIAS_ERROR = ROW["pot_bias"]

# ---- and in s
CURRENT = STATE_ROW["valve_hysteresis"]  # four of A: the valve's memory
LAGGED = STATE_ROW["valve_lag"]  # A, behind the valve's lag
FRICTION = STATE_ROW["piston_friction"]  # N: force, off centre
GIVE = STATE_ROW["oil_compressibility"]  # m
READING = STATE_ROW["lvdt_lag"]  # m, stroke behind both lags of the LVDT
BRISTLE = STATE_ROW["linkage_friction"]  # -1..1, of each stage
DRIVEN = BRISTLE + MOST  # rad, each ring at the last tick, as friction saw it
DEMANDED = STATE_ROW["amplifier_lag"]  # A, command behind the amplifier's lag
AHEAD = STATE_ROW["gear_backlash"]  # m, motor ahead of the rod
I_MOTOR, SPEED_INTEGRAL, MOTOR_SPEED, BENT = range(MOTOR_AT, MOTOR_AT + len(MOTOR_STATE))
