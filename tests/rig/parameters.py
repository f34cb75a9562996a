"""Numbers of the rig: what each is, its nominal value, and how far a drawn specimen may stray from it. SI; speeds in %.

The kernel reads them by position (`kernel.P`) from one flat array; neutral values of the hidden effects are here too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .kernel import MOST, N_P, P

DEG = np.pi / 180.0


def _nominal() -> np.ndarray:
    p = np.zeros(N_P)
    values = {
        P.engine_lag: 1.2,
        P.acceleration: 8.0,
        P.deceleration: 10.0,
        P.knee: 60.0,
        P.i_rated: 0.040,
        P.spool_omega: 2.0 * np.pi * 60.0,
        P.spool_zeta: 0.8,
        P.flow_gain: 0.150,
        P.p_ref: 21e6,
        P.area: 1.2e-3,
        P.mass: 5.0,
        P.bulk: 1.6e9,
        P.dead_volume: 3e-6,
        P.viscous: 1500.0,
        P.stroke: 0.048,
        P.stop_stiffness: 2e9,
        P.stop_damping: 5e4,
        P.centring: 3.0,
        P.bristle: 3e-6,
        P.lvdt_tau: 1e-3,
        P.lvdt_noise: 5e-6,
        P.lvdt_step: 0.050 / 65536,
        P.pot_noise: 0.03 * DEG,
        P.pot_step: 120.0 / 65536 * DEG,
        P.speed_noise: 0.02,
        P.contact_tau: 3e-4,
        P.spread: 0.02,
        **{P(P.pot_tau_0 + k): 5e-3 for k in range(MOST)},
        **{P(P.pot_gain_0 + k): 1.0 for k in range(MOST)},
        P.controller_gain: 1.0,
        P.flow_limit: np.inf,
        P.flow_exponent: 20.0,
        P.asymmetry: 1.0,
        P.stribeck_speed: 5e-3,
        P.lvdt_gain: 1.0,
        P.friction_distance: 1.0 * DEG,
        P.vibration_speed: 80.0,
        P.ripple_frequency: 7.3,
        P.dip_period: 20.0,
        P.creep_tau: 15.0,
        P.ring_damping: 0.1,
        P.track_width: 1.0 * DEG,
        P.dither_frequency: 11.0,
        P.rumble_speed: 70.0,
        P.t_ref: 40.0,
        P.torque_factor: 1.0,
    }
    for slot, value in values.items():
        p[slot] = value
    return p


R = 5e-3 / (2.0 * np.pi * 2.0)  # m/rad: lead of 5 mm, gear of 2
MOTOR = {  # electromechanical actuator: what differs from the hydraulic one
    P.motor: 1.0,
    P.motor_rated: 0.150 / R,
    P.motor_gain: 0.19,
    P.motor_time: 50e-3,
    P.motor_peak: 20.0,
    P.motor_band: 2.0 * np.pi * 800.0,
    P.motor_torque: 0.6,
    P.motor_ohm: 1.5,
    P.motor_henry: 6e-3,
    P.motor_inertia: 4.5e-4,
    P.motor_viscous: 1e-3,
    P.screw_r: R,
    P.screw_loss: 1.0 / 0.9 - 1.0,
    P.screw_friction: 350.0,
    P.rod_friction: 150.0,
    P.screw_lead: 5e-3,
    P.screw_stiffness: 2e8,
    P.screw_damping: 2e4,
    P.bus_voltage: 270.0,
    P.stop_stiffness: 1e9,
}

NOMINAL = _nominal()
NOMINAL.setflags(write=False)


def with_motor(p: np.ndarray) -> np.ndarray:
    """Return the parameters of the machine with the electromechanical actuator in place of valve and pistons."""
    out = p.copy()
    for slot, value in MOTOR.items():
        out[slot] = value
    return out


@dataclass(frozen=True)
class Tolerance:
    """How far a specimen's parameter may lie from nominal: half-width, relative to nominal or absolute."""

    slot: P
    half_width: float
    relative: bool


TOLERANCES = (  # of the machine; `tolerances` adds the stages'
    Tolerance(P.engine_lag, 0.05, True),
    Tolerance(P.acceleration, 0.03, True),
    Tolerance(P.deceleration, 0.03, True),
    Tolerance(P.spool_omega, 0.15, True),
    Tolerance(P.spool_zeta, 0.10, True),
    Tolerance(P.flow_gain, 0.05, True),
)


MOTOR_TOLERANCES = (
    Tolerance(P.motor_rated, 0.03, True),
    Tolerance(P.motor_gain, 0.10, True),
    Tolerance(P.motor_time, 0.10, True),
    Tolerance(P.motor_inertia, 0.05, True),
    Tolerance(P.motor_torque, 0.05, True),
    Tolerance(P.screw_friction, 0.25, True),
)


def tolerances(stages: int, motor: bool = False) -> tuple[Tolerance, ...]:
    """Return what a specimen with so many stages, and a motor or none, may stray by."""
    gaps = (0.05 / 1.6, 0.05 / 1.1)  # 0.05 deg at the vane; the others 5 %
    return (
        *TOLERANCES,
        *(Tolerance(P(P.half_gap_0 + k), gaps[k] if k < len(gaps) else 0.05, True) for k in range(stages)),
        *(Tolerance(P(P.pot_bias_0 + k), 0.1 * DEG, False) for k in range(stages)),
        *(MOTOR_TOLERANCES if motor else ()),
    )


def specimen(nominal: np.ndarray, rng: np.random.Generator | None, stages: int = 3) -> np.ndarray:
    """Return parameters of one machine: the nominal ones, or (with ``rng``) each drawn uniformly within its
    tolerance.
    """
    p = nominal.copy()
    if rng is not None:
        for t in tolerances(stages, bool(p[P.motor])):
            d = rng.uniform(-t.half_width, t.half_width)
            p[t.slot] += p[t.slot] * d if t.relative else d
    return p
