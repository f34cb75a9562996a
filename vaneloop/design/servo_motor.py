"""The servo loop around an electromechanical actuator: its linear model, its corners, its step in time.

From current to speed (symbols of `plant.electromechanical`), with the speed loop closed around motor and current loop::

    v/i = v_rated/i_rated  N/(D + N),   N = k_p K_t w_c (T_i s + 1),   D = T_i s (s + w_c) (J s + B)

Friction, limits and load are left out there; the simulation in time has them, for it steps the plant itself.

Source: Krishnan, Electric Motor Drives (2001), ch. 3.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from controller.calibration import CalibrationTable
from plant import build_plant, chain, places
from plant.parameters import ElectromechanicalTable, derive, read_plant
from vaneloop.base.errors import InputError
from vaneloop.base.tables import read
from vaneloop.design.servo import Complex, Margins, ServoPlant

__all__ = ["MotorCorner", "MotorServoPlant", "plant_of_tables"]


@dataclass(frozen=True)
class MotorCorner:
    """One corner of the tolerances (factors), and its margins."""

    rated_speed: float
    speed_gain: float
    speed_time: float
    torque_constant: float
    delay_ticks: int
    margins: Margins

    def describe(self) -> str:
        """The corner in words."""
        return (
            f"rated speed {self.rated_speed - 1:+.0%}, speed gain {self.speed_gain - 1:+.0%}, integral time "
            f"{self.speed_time - 1:+.0%}, torque constant {self.torque_constant - 1:+.0%}, computation delay "
            f"{self.delay_ticks} ms"
        )


@dataclass(frozen=True)
class MotorServoPlant(ServoPlant):
    """Amplifier, motor, screw, LVDT and sampling as the loop sees them; SI.

    flow_gain  m/s, speed of the rod at rated current: its rated speed
    table      plant table that the simulation in time steps
    """

    speed_gain: float = 0.19  # A s/rad
    speed_time: float = 0.05  # s
    current_bandwidth: float = 800.0  # Hz
    torque_constant: float = 0.6  # N m/A
    inertia: float = 4.5e-4  # kg m2 at the motor
    viscous: float = 1e-3  # N m s/rad
    table: str = "plant_electromechanical.toml"

    @classmethod
    def of(cls, table: Any, source: str | Path, **common: Any) -> MotorServoPlant:
        """The loop of a `plant.parameters.ElectromechanicalTable` read from ``source``; ``common``: what every kind
        has.
        """
        r = table.screw.lead.value * 1e-3 / (2.0 * math.pi * table.gear.ratio.value)
        return cls(
            rated_current=table.drive.rated_current.value * 1e-3,
            bandwidth=math.nan,
            damping=math.nan,
            flow_gain=table.drive.rated_speed.value,
            pressure=1.0,  # there is no oil: the speed does not depend on it
            p_ref=1.0,
            speed_gain=table.drive.speed_gain.value,
            speed_time=table.drive.speed_time.value * 1e-3,
            current_bandwidth=table.drive.current_bandwidth.value,
            torque_constant=table.motor.torque_constant.value,
            inertia=table.motor.inertia.value + table.gear.inertia.value + table.screw.mass.value * r * r,
            viscous=table.screw.viscous.value,
            table=str(source),
            **common,
        )

    @property
    def hysteretic(self) -> bool:
        """An amplifier has no hysteresis."""
        return False

    def dynamics(self) -> tuple[ArrayLike, ArrayLike]:
        """Numerator and denominator, powers of s falling, from speed demand to speed."""
        w = 2.0 * math.pi * self.current_bandwidth
        n = self.speed_gain * self.torque_constant * w * np.array([self.speed_time, 1.0])
        d = np.polymul([self.speed_time, 0.0], np.polymul([1.0, w], [self.inertia, self.viscous]))
        return n, np.polyadd(d, n)

    def response(self, s: Complex) -> Complex:
        """The same at the complex frequencies ``s`` (rad/s)."""
        n, d = (np.asarray(v) for v in self.dynamics())
        return np.asarray(np.polyval(n, s) / np.polyval(d, s))

    def corners(self) -> list[tuple[Callable[[Margins], Any], ServoPlant]]:
        """Rated speed 3 %, speed gain 15 %, integral time 10 %, torque constant 5 %, 0 or 1 tick of computation
        delay.
        """
        out: list[tuple[Callable[[Margins], Any], ServoPlant]] = []
        for f, g, time, torque, delay in itertools.product(
            (0.97, 1.03), (0.85, 1.15), (0.9, 1.1), (0.95, 1.05), (0, 1)
        ):
            plant = replace(
                self,
                flow_gain=self.flow_gain * f,
                speed_gain=self.speed_gain * g,
                speed_time=self.speed_time * time,
                torque_constant=self.torque_constant * torque,
                delay=delay,
            )
            out.append((partial(MotorCorner, f, g, time, torque, delay), plant))
        return out

    def stepper(self, x: float, substeps: int) -> Callable[[float], float]:
        """The plant's own step, from rest at the stroke ``x`` (m)."""
        machine = build_plant(self.table)
        p, s = machine.p.copy(), machine.start(x, 0.0)
        dt = self.tick / substeps
        derive(p, dt, self.tick)

        def step(i: float) -> float:
            chain.drive_step(s, p, 0, i, 0.0, 0.0, 40.0, dt, 1)
            return float(s[places.X, 0])

        return step


def plant_of_tables(plant: str | Path = "plant.toml") -> ServoPlant:
    """Read a plant table, whatever the kind of its actuator; the current limit comes from ``calibration.toml``."""
    t = read_plant(plant)
    if t.sides > 1:
        raise InputError(f"{plant}: actuators.number (={t.sides}) must be 1 for the servo's design (docs/machines.md)")
    common = {
        "stroke": t.actuator.stroke.value * 1e-3,
        "lvdt_lag": t.sensors.lvdt_lag.value * 1e-3,
        "lvdt_noise": t.sensors.lvdt_noise.value * 1e-3,
        "lvdt_step": t.sensors.lvdt_range.value * 1e-3 / 2.0**t.sensors.lvdt_bits.value,
        "current_limit": read("calibration.toml", CalibrationTable).servo.current_limit.value * 1e-3,
    }
    if isinstance(t, ElectromechanicalTable):
        return MotorServoPlant.of(t, plant, **common)
    return ServoPlant(
        rated_current=t.valve.rated_current.value * 1e-3,
        bandwidth=t.valve.bandwidth.value,
        damping=t.valve.damping.value,
        flow_gain=t.actuator.flow_gain.value,
        pressure=t.supply.pressure.value * 1e6,
        **common,
    )
