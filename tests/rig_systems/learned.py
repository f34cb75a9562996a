"""What learning should find: for each law outside the library, the curves that are it by the family's equations.

A curve is named by its place and its quantity, as the product names it. Several can be one: an outflow that grows with
the level is a gain of the outflow over the level, and a curve taken off the level's derivative. Empty: the law is no
function of one quantity that is known (a product of two, a ripple that no log resolves). `tests/test_rig_learned.py`
holds each against the family's equations.
"""

from __future__ import annotations

__all__ = ["LEARNED"]

LEARNED: dict[tuple[str, str], frozenset[str]] = {
    (family, law): frozenset(names.split())
    for family, law, names in (
        ("tanks", "spill", "upper_outflow.gain_of_upper"),  # what flows out of the one flows into the other
        ("tanks", "clogging", "lower_outflow.gain_of_time"),
        ("flow_loop", "stiction", ""),
        ("flow_loop", "equal_percentage", "valve.curve_of_valve gain.gain_of_valve flow.curve_of_valve"),
        ("valve_bench", "one_edge", "current.curve_of_current gain.gain_of_current offset.gain_of_current "
         "flow.curve_of_current flow.gain_of_current flow.curve_of_flow"),
        ("valve_bench", "notches", "current.curve_of_current gain.gain_of_current offset.gain_of_current "
         "flow.curve_of_current flow.gain_of_current flow.curve_of_flow"),
        ("thermal_mass", "radiation", "loss.gain_of_rise rise.curve_of_rise heater.curve_of_rise"),
        ("thermal_mass", "draught", "loss.gain_of_time"),
        ("heat_exchanger", "film", "conductance.gain_of_hot_flow"),
        ("heat_exchanger", "fouling", "conductance.gain_of_time"),
        ("dc_motor", "cogging", "speed.curve_of_angle"),
        ("dc_motor", "weakening", "inertia.gain_of_time"),  # the current's sensor does not see it
        # the belt's torque; its parameter is in the damping, too, so that no gain of it is the same
        ("rectified_drive", "slip", "change.curve_of_motor_minus_speed"),
        ("rectified_drive", "ripple", "motor.curve_of_time drive.curve_of_time"),
        ("battery", "empties", "r0.gain_of_charge fall.gain_of_current"),  # proportional to charge times current
        ("battery", "cold", "r0.gain_of_time"),
        ("levitation", "saturates", ""),
        ("levitation", "eddies", ""),
        ("pneumatic_cylinder", "seal", "area.gain_of_speed"),  # pressure times area times a function of the speed
        ("pneumatic_cylinder", "vents", "fill.gain_of_direction_of_pressure"),
        ("spool", "sluggish", "spool_lag.gain_of_speed"),
        ("spool", "fouled", "exhaust.curve_of_time"),
        ("servo_axis", "pulley", "force.gain_of_position"),
        ("servo_axis", "warming", "viscous.gain_of_time"),
        ("excavator_joint", "loaded", "torque.gain_of_direction_of_position"),
        ("excavator_joint", "bucket", "weight.gain_of_time"),
        ("hysteretic_damper", "fade", "damping.gain_of_time"),
        ("hysteretic_damper", "membrane", "stiffness.gain_of_position force.curve_of_position"),
        ("hydraulic_cylinder", "leakage", "position.curve_of_load"),
        ("hydraulic_cylinder", "worn_edge", "valve.curve_of_valve gain.gain_of_valve"),
        ("pendulum", "shaken", "gravity.gain_of_time"),
        ("pendulum", "cable", "rate.curve_of_angle gravity.gain_of_angle torque.curve_of_angle"),
        ("quarter_car", "rebound", "rate.curve_of_rate damping.gain_of_rate damping.gain_of_direction_of_travel "
         "axle.curve_of_rate"),
        ("quarter_car", "bump_stop", "rate.curve_of_travel spring.gain_of_travel axle.curve_of_travel"),
        ("resonator", "one_sided", "speed.curve_of_place spring.gain_of_place force.curve_of_place"),
        ("resonator", "pumped", "spring.gain_of_time"),
        ("rolling_ship", "cargo", "frequency.gain_of_time"),  # the model has one number for lever and waves
        ("rolling_ship", "lever", "rate.curve_of_roll slope.curve_of_roll"),
    )
}  # fmt: skip
