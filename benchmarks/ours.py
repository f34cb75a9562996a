"""The product's own loop, set up for a comparison: the same start, stimulus and arrays that every peer gets."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from controller import Calibration, load_calibration
from hil.loop.lanes import Lanes
from hil.loop.lockstep import WARM_UP, Stimulus, advance, columns_of
from hil.loop.tick import new_loop
from plant import Model, Plant, build_plant, chain_lanes
from plant.parameters import nominal
from vaneloop.base.vanes import VANES

__all__ = ["COLUMNS", "OurLanes", "OurLoop", "Setup", "profile", "troubled"]

COLUMNS = columns_of(VANES[:3])
_SILENT, _NO_SNAPSHOTS = np.zeros((1, 5)), np.empty((0, 0))


@dataclass(frozen=True)
class Setup:
    """What is simulated: a stimulus, the shipped tables, sensors with or without noise."""

    stimulus: Stimulus
    calibration: Calibration = field(default_factory=load_calibration)
    plant: Plant = field(default_factory=build_plant)
    noisy: bool = False
    every: int = 10
    warm_up: int = WARM_UP

    @property
    def ticks(self) -> int:
        """Ticks in the stimulus."""
        return 10 * len(self.stimulus.rows)

    @property
    def sigma(self) -> np.ndarray:
        """Rms of the sensors' noise, SI; 0 where they are noise-free."""
        return self.plant.sigma if self.noisy else np.zeros(5)

    @property
    def stroke(self) -> float:
        """Stroke (m) at the start: where the mean curve has it."""
        return float(np.interp(self.stimulus.rows[0, 0], self.calibration.table[0], self.calibration.table[3]))


class OurLoop:
    """One closed loop of the product: `hil.loop.lockstep` without its hash."""

    def __init__(self, setup: Setup):
        self._setup = s = setup
        n_dem, t_oil = s.stimulus.rows[0, 0], s.stimulus.rows[0, 3]
        self.loop = new_loop(s.plant, s.calibration, n_engine=n_dem, n_r=n_dem, t_oil=t_oil, noisy=s.noisy)
        self._advance(-s.warm_up, s.warm_up, s.stimulus.rows[:1], _SILENT, np.empty((0, len(COLUMNS))))
        self.loop.mean[:] = 0.0

    def _advance(self, k0: int, ticks: int, rows: np.ndarray, noise: np.ndarray, out: np.ndarray) -> None:
        advance(k0, ticks, rows, noise, self.loop, self._setup.every, out, _NO_SNAPSHOTS)

    def advance(self, out: np.ndarray, noise: np.ndarray | None = None, ticks: int | None = None) -> None:
        """Run the stimulus from its start into ``out`` (SI, a row every 10 ticks)."""
        self._advance(
            0, ticks or self._setup.ticks, self._setup.stimulus.rows, _SILENT if noise is None else noise, out
        )

    @property
    def faults(self) -> int:
        """Fault bits that stand now."""
        return int(self.loop.given.faults)


class OurLanes:
    """As many closed loops side by side, each a machine of its own within 2 % of flow gain and play."""

    def __init__(self, setup: Setup, count: int):
        s = self._setup = setup
        n_dem, t_oil = s.stimulus.rows[0, 0], s.stimulus.rows[0, 3]
        known = {n.name: n.value for n in nominal(s.plant.table, s.plant.geometry)}
        loops = []
        for j in range(count):
            share = 0.98 + 0.04 * j / max(count - 1, 1)
            model = Model(parameters={n: known[n] * share for n in ("actuator.flow_gain", "linkage.vigv_play")})
            plant = model.plant(s.plant)
            loops.append(new_loop(plant, s.calibration, n_engine=n_dem, n_r=n_dem, t_oil=t_oil, noisy=False))
            loops[-1].state.direction = loops[-1].state.blend = 1.0
        way = chain_lanes.way(s.plant.p)
        assert way is not None
        self.lanes = Lanes(loops, [s.stimulus] * count, way, s.every)

    def advance(self, out: np.ndarray) -> None:
        """Run the stimulus from its start into ``out`` (`hil.loop.lanes.Lanes.room`)."""
        self.lanes.advance(0, self._setup.ticks, None, out)


def profile(seconds: float) -> np.ndarray:
    """Speed demand (%) every 10 ms: rises and falls between 60 and 100 %, slow and fast, with dwells."""
    t = (0, 2, 8, 11, 13, 17, 25, 31, 33, 36, 40, 48, 50)
    n = (60, 60, 85, 85, 70, 70, 100, 100, 92, 98, 98, 60, 60)
    return np.interp(np.arange(0.0, seconds, 1e-2) % t[-1], t, n)


def troubled(seconds: float) -> Stimulus:
    """The profile with everything that a controller can meet on the bus and in the supply.

    Lost and refused frames, a demand out of range and one that is no number, standby asked for and withdrawn, a
    measured speed that comes and goes, and a supply pressure that fails for a while.
    """
    n = profile(seconds)
    t = np.arange(len(n)) * 1e-2
    fresh, rejected, mode_request = np.ones(len(n)), np.zeros(len(n)), np.ones(len(n))
    n_r = np.full(len(n), np.nan)
    p_s = 21e6 + 1e6 * np.sin(0.7 * t)
    fresh[(t >= 10) & (t < 10.04)] = 0.0  # four frames: tolerated
    fresh[(t >= 14) & (t < 14.3)] = 0.0  # stale: DEGRADED and back
    fresh[(t >= 20) & (t < 22)] = 0.0  # stale for long: FAIL_SAFE and back
    refused = (t >= 30) & (t < 30.2)
    fresh[refused], rejected[refused] = 0.0, 1.0
    rejected[(t >= 37) & (t < 37.02)] = 1e9
    n[(t >= 45) & (t < 45.2)] = 400.0
    mode_request[(t >= 55) & (t < 57)] = 0.0
    p_s[(t >= 62) & (t < 64)] = 0.0  # no pressure: the piston stands, tracking and saturation follow
    p_s[(t >= 74) & (t < 75)] = 2e6
    rejected[(t >= 82) & (t < 82.1)] = np.nan
    logged = t >= 95
    n_r[logged] = n[logged] + 0.3 * np.sin(3.0 * t[logged])
    n_r[(t >= 105) & (t < 105.2)] = -50.0
    s = Stimulus.of(n, n_r, p_s)
    s.rows[:, 4], s.rows[:, 5], s.rows[:, 6] = fresh, rejected, mode_request
    return s
