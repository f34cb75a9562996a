"""What the tests know of each effect of the library: an entry each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

__all__ = ["EXAMPLES", "Example"]

Sizes = dict[str, float]


class Example(NamedTuple):
    """An effect in tests.

    plain    its parameters at a plain size, in declared units: it shows in the stages that it declares. Those of a
             vane stage on VGV1
    gross    the same at a gross size: it shows in three seconds of the closed loop
    neutral  (module, neutral parameters in SI, any a and b, positive c) -> (what its step gives, what that must be)
    """

    plain: Sizes
    gross: Sizes
    neutral: Callable[[Any, list[float], float, float, float], tuple[Any, Any]]


EXAMPLES: dict[str, Example] = {
    "can_delay": Example({"delay": 0.1}, {"delay": 0.3}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "frame_hold": Example({"period": 0.1}, {"period": 0.4}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "schedule_error": Example({"offset": 0.5}, {"offset": 2.0}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "trend_threshold_error": Example({"factor": 4.0}, {"factor": 20.0}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "controller_gain_error": Example({"factor": 1.3}, {"factor": 2.0}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "rotor_lag_error": Example({"lag": 0.4}, {"lag": 1.0}, lambda e, n, a, b, c: (e.step(c + 0.01, *n), c + 0.01)),
    "acceleration_limit_error": Example(
        {"limit": -2.0}, {"limit": -5.0}, lambda e, n, a, b, c: (e.step(c + 0.01, *n), c + 0.01)
    ),
    "valve_null_bias": Example({"bias": 1.0}, {"bias": 3.0}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "valve_dead_band": Example({"half_width": 1.2}, {"half_width": 3.0}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "valve_hysteresis": Example(
        {"width": 1.5, "spread": 0.7},
        {"width": 4.0, "spread": 1.0},
        lambda e, n, a, b, c: (e.mean(*e.step(b, 0.0, -b, c, a, *n)), a),
    ),
    "valve_flow_saturation": Example(
        {"limit": 40.0, "roundness": 0.4}, {"limit": 20.0}, lambda e, n, a, b, c: (e.step(a, *n), a)
    ),
    "valve_lag": Example(
        {"time_constant": 0.01}, {"time_constant": 0.02}, lambda e, n, a, b, c: (e.step(b, a, 1.0), a)
    ),
    "valve_gain_asymmetry": Example({"ratio": 1.2}, {"ratio": 1.5}, lambda e, n, a, b, c: (e.step(a, *n), (a, a))),
    "supply_pressure_droop": Example({"droop": 40.0}, {"droop": 150.0}, lambda e, n, a, b, c: (e.step(a, b, *n), a)),
    "oil_viscosity": Example(
        {"coefficient": -0.004}, {"coefficient": -0.008}, lambda e, n, a, b, c: (e.step(a, b, *n), a)
    ),
    "piston_friction": Example(
        {"force": 2000.0}, {"force": 6000.0}, lambda e, n, a, b, c: (e.step(0.0, a, *n, c), 0.0)
    ),
    "piston_stiction": Example(
        {"excess": 2000.0, "speed": 4.0}, {"excess": 6000.0, "speed": 4.0}, lambda e, n, a, b, c: (e.step(a, b, *n), a)
    ),
    "internal_leakage": Example(
        {"coefficient": 1.0}, {"coefficient": 5.0}, lambda e, n, a, b, c: (e.step(a, b, c, *n), a)
    ),
    "oil_compressibility": Example(
        {"compliance": 0.1}, {"compliance": 0.5}, lambda e, n, a, b, c: (e.step(0.0, a, *n), 0.0)
    ),
    "aero_load": Example({"force": 4000.0}, {"force": 10000.0}, lambda e, n, a, b, c: (e.step(a, *n), 0.0)),
    "end_stop_shift": Example({"shift": 4.0}, {"shift": 15.0}, lambda e, n, a, b, c: (e.step(c, *n), (0.0, c))),
    "lvdt_bias": Example({"bias": 0.4}, {"bias": 1.0}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "lvdt_gain": Example({"factor": 1.03}, {"factor": 1.1}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "lvdt_nonlinearity": Example(
        {"amplitude": 0.3, "cubic": -0.1}, {"amplitude": 1.0}, lambda e, n, a, b, c: (e.step(a, c, *n), a)
    ),
    "lvdt_lag": Example({"time_constant": 0.01}, {"time_constant": 0.02}, lambda e, n, a, b, c: (e.step(b, a, 1.0), a)),
    "lvdt_thermal_drift": Example(
        {"coefficient": 0.01}, {"coefficient": 0.02}, lambda e, n, a, b, c: (e.step(a, b, *n), a)
    ),
    "linkage_backlash": Example({"vgv1": 0.5}, {"vgv1": 1.0}, lambda e, n, a, b, c: (e.step(c, n[0], abs(a)), c)),
    "linkage_compliance": Example(
        {"compliance": 0.1}, {"compliance": 0.5}, lambda e, n, a, b, c: (e.step(a, b, *n), a)
    ),
    "linkage_friction": Example({"vgv1": 0.5}, {"vgv1": 1.0}, lambda e, n, a, b, c: (e.loop(a, b, n[0], c), a)),
    "linkage_wear": Example({"vgv1": 50.0}, {"vgv1": 200.0}, lambda e, n, a, b, c: (e.step(c, n[0], abs(a), b), c)),
    "thermal_growth": Example({"vgv1": 0.02}, {"vgv1": 0.05}, lambda e, n, a, b, c: (e.step(a, b, n[0], c), a)),
    "crank_length_error": Example({"vgv1": 1.0}, {"vgv1": 2.0}, lambda e, n, a, b, c: (e.step(c, n[0]), c)),
    "link_length_error": Example({"vgv1": 0.5}, {"vgv1": 1.0}, lambda e, n, a, b, c: (e.step(c, n[0]), c)),
    "ring_eccentricity": Example(
        {"vgv1": 0.2, "phase": 60.0}, {"vgv1": 0.5, "phase": 60.0}, lambda e, n, a, b, c: (e.step(a, n[0], n[3]), a)
    ),
    "rigging_offset": Example({"length": 0.5}, {"length": 2.0}, lambda e, n, a, b, c: (e.step(c, *n), c)),
    "ring_stiffness": Example(
        {"ratio": 0.5}, {"ratio": 0.1}, lambda e, n, a, b, c: (e.step(n[0], n[0]), (1.0, 0.0, 0.0))
    ),
    "pot_bias": Example({"vgv1": 0.5}, {"vgv1": 1.0}, lambda e, n, a, b, c: (e.step(a, n[0]), a)),
    "pot_gain": Example({"vgv1": 1.03}, {"vgv1": 1.1}, lambda e, n, a, b, c: (e.step(a, n[0]), a)),
    "pot_lag": Example({"vgv1": 0.05}, {"vgv1": 0.1}, lambda e, n, a, b, c: (e.step(c, n[0]), c)),
    "amplifier_offset": Example({"offset": 1.0}, {"offset": 4.0}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "amplifier_dead_band": Example({"half_width": 1.2}, {"half_width": 4.0}, lambda e, n, a, b, c: (e.step(a, *n), a)),
    "amplifier_lag": Example(
        {"time_constant": 0.01}, {"time_constant": 0.03}, lambda e, n, a, b, c: (e.step(b, a, 1.0), a)
    ),
    "tacho_thermal_drift": Example(
        {"coefficient": -0.004}, {"coefficient": -0.015}, lambda e, n, a, b, c: (e.step(a, b, *n), a)
    ),
    "motor_torque_constant_error": Example({"factor": 0.6}, {"factor": 0.2}, lambda e, n, a, b, c: (e.step(c, *n), c)),
    "screw_friction": Example({"force": 1000.0}, {"force": 5000.0}, lambda e, n, a, b, c: (e.step(c, *n), c)),
    "gear_backlash": Example({"width": 0.1}, {"width": 0.4}, lambda e, n, a, b, c: (e.step(0.0, a, *n), (0.0, a))),
    "screw_pitch_error": Example(
        {"amplitude": 0.05, "phase": 30.0},
        {"amplitude": 0.3, "phase": 30.0},
        lambda e, n, a, b, c: (e.step(b, a, c, *n), a),
    ),
}
