"""A plant ready to run: its parameters in SI, its starting state, its sensors' noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plant import chain
from plant.geometry import Geometry, Schedules, load_schedules
from plant.linkage import G_L, G_LDP, N_CRANK, N_PER_STAGE, ring_angle_of_vane, ring_angles, vane_angle
from plant.parameters import GEOMETRY, PLAY, POT_BIAS, PlantTable, derive, load_plant

__all__ = ["Plant", "build_plant"]


@dataclass(frozen=True)
class Plant:
    """One machine.

    table, geometry, schedules  the tables it came from
    p      float64[N_PARAMETERS, 1], SI, derived rows included
    sigma  float64[5]: rms noise of LVDT (m), three potentiometers (rad), speed (%)
    """

    table: PlantTable
    geometry: Geometry
    schedules: Schedules
    p: np.ndarray
    sigma: np.ndarray

    def start(self, stroke: float, n_r: float) -> np.ndarray:
        """Return a state at rest at ``stroke`` (m) and speed ``n_r`` (%), every ring in the middle of its play."""
        s = np.zeros((chain.N_STATE, 1))
        s[chain.N_R, 0] = n_r
        s[chain.X, 0] = s[chain.X_LVDT, 0] = stroke
        for k, ring in enumerate(ring_angles(stroke, self.p[GEOMETRY:, 0])):
            s[chain.RING + k, 0] = ring
            s[chain.POT + k, 0] = vane_angle(ring, *self._lever(k)) + self.p[POT_BIAS + k, 0]
        return s

    def place_rings(self, s: np.ndarray, angles: tuple[float, ...]) -> None:
        """Set each ring, as far as its play allows, to where the vane angle is the given one (rad; NaN = leave it)."""
        for k, drive in enumerate(ring_angles(s[chain.X, 0], self.p[GEOMETRY:, 0])):
            if np.isfinite(angles[k]):
                half = 0.5 * self.p[PLAY + k, 0]
                ring = ring_angle_of_vane(angles[k] - self.p[POT_BIAS + k, 0], *self._lever(k))
                s[chain.RING + k, 0] = min(max(ring, drive - half), drive + half)
                s[chain.POT + k, 0] = vane_angle(s[chain.RING + k, 0], *self._lever(k)) + self.p[POT_BIAS + k, 0]

    def _lever(self, k: int) -> tuple[float, float]:
        o = GEOMETRY + N_CRANK + k * N_PER_STAGE
        return float(self.p[o + G_LDP, 0]), float(self.p[o + G_L, 0])


def build_plant(
    source: str | Path = "plant.toml", geometry: str | Path = "geometry.toml", schedules: str | Path = "schedules.toml"
) -> Plant:
    """Read the plant's tables and return the machine they describe. Raises InputError for a table that cannot be used."""
    table, geo, p = load_plant(source, geometry)
    derive(p, chain.TICK / chain.SUBSTEPS, chain.TICK)
    deg = np.pi / 180.0
    sensors = table.sensors
    sigma = np.array([sensors.lvdt_noise.value * 1e-3, *[sensors.pot_noise.value * deg] * 3, sensors.speed_noise.value])
    return Plant(table, geo, load_schedules(schedules), p, sigma)
