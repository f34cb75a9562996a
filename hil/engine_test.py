"""The paper's engine test: a speed profile, run in closed loop under a strategy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import model_validator

from controller import Calibration, load_calibration
from hil.figures import error_figures
from hil.logs.plausible import LONGEST
from hil.loop.lockstep import Stimulus, lockstep
from hil.replay import ReplayResult
from plant import Plant, build_plant
from plant.parameters import PLAY
from vaneloop.base.tables import Axis, Bound, Bounded, Quantity, read

__all__ = ["RASTER", "EngineTestTable", "engine_test", "load_profile"]

RASTER = 100  # ticks between logged samples: 10 Hz, as in the paper


class EngineTestTable(Bounded):
    """``engine_test.toml``: steps of the speed demand."""

    start: Annotated[Quantity, Bound("%", 0.0, 120.0)]
    speed: Annotated[Axis, Bound("%", 0.0, 120.0)]
    rate: Annotated[Axis, Bound("%/s", 0.01, 1000.0)]
    dwell: Annotated[Axis, Bound("s", 0.0, 100000.0)]

    @model_validator(mode="after")
    def _lengths(self) -> EngineTestTable:
        n = len(self.speed.values)
        for key in ("rate", "dwell"):
            if len(getattr(self, key).values) != n:
                raise ValueError(f"{key}.values has {len(getattr(self, key).values)} numbers; speed has {n}")
        steps = np.abs(np.diff([self.start.value, *self.speed.values])) / np.array(self.rate.values)
        if (lasts := float(steps.sum() + sum(self.dwell.values))) > LONGEST:
            raise ValueError(f"rate and dwell make a test of {lasts:g} s; allowed: up to {LONGEST:g} s")
        return self


def load_profile(source: str | Path = "engine_test.toml", dwells: float = 1.0) -> np.ndarray:
    """Return the speed demand (%) of a profile table, one value every 10 ms; each dwell for the share ``dwells`` of its
    time.
    """
    table = read(source, EngineTestTable)
    times, speeds = [0.0], [table.start.value]
    for speed, rate, dwell in zip(table.speed.values, table.rate.values, table.dwell.values, strict=True):
        times.append(times[-1] + abs(speed - speeds[-1]) / rate)
        speeds.append(speed)
        times.append(times[-1] + dwells * dwell)
        speeds.append(speed)
    t = np.arange(0.0, times[-1], 1e-2)
    return np.interp(t, times, speeds)


def engine_test(
    n_dem: np.ndarray,
    strategy: str,
    seed: int = 1,
    hysteresis: float | None = None,
    progress: Callable[[float], None] | None = None,
    plant: Plant | None = None,
    calibration: Calibration | None = None,
) -> ReplayResult:
    """Run the test under one strategy, noisy sensors and all.

    n_dem       %, one value every 10 ms
    strategy    one of `controller.STRATEGIES`
    hysteresis  deg, total width at the VIGV; default: the geometry's
    plant       the machine; default: the shipped tables
    calibration of the controller, with this strategy; default: the shipped tables

    Vane angles are what the (noisy) potentiometers measure, held against the schedule at the measured speed: Table 5 of
    the paper.
    """
    machine = plant or build_plant()
    if hysteresis is not None:
        p = machine.p.copy()
        width = machine.geometry.vigv
        p[PLAY, 0] = np.deg2rad(hysteresis) * width.l.value / width.ld_prime.value
        machine = replace(machine, p=p)
    run = lockstep(
        Stimulus.of(n_dem),
        calibration=calibration or load_calibration(strategy=strategy),
        plant=machine,
        seed=seed,
        every=RASTER,
        progress=progress,
    )
    speed = run.columns["n_r"]
    target = dict(zip(machine.vanes, np.rad2deg(machine.schedules.targets(speed)).T, strict=True))
    noise = machine.table.sensors.pot_noise.value
    signals = [
        error_figures(name, "linkage", "deg", "schedule", run.t, run.columns[name], values, speed, noise)
        for name, values in target.items()
    ]
    return ReplayResult(
        f"engine test, {strategy}",
        run.simulated_s,
        run.wall_s,
        run.state_hash,
        signals,
        run.t,
        dict(run.columns),
        target,
        {},
    )
