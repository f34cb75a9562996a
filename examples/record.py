"""Record the shipped example logs: the firmware drives the independent rig of tests/rig, and the bus or the rig's
logger writes.

``python -m examples.record`` from a checkout makes them anew. The machine behind them is not the plant model of this
project: other equations, randomised parameters, noisy and quantised sensors.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hil.logs import Channel, write_log
from tests.firmware_on_rig import firmware
from tests.rig import Hidden, Manoeuvre, manoeuvre, simulate

HERE = Path(__file__).parent
__all__ = ["engine_run", "hidden_run", "main"]


def engine_run() -> Manoeuvre:
    """90 s: two rises to the design point, part load, a slam down."""
    t = np.arange(0.0, 90.0, 0.01)
    times = [0, 4, 9, 16, 20, 27, 32, 33, 38, 40, 48, 55, 58, 66, 67, 72, 84, 90]
    speeds = [48, 48, 62, 62, 75, 75, 92, 92, 99.5, 99.5, 99.5, 84, 84, 99.2, 99.2, 60, 60, 60]
    n = np.interp(t, times, speeds)
    return Manoeuvre("engine run", 0, n, 20.8e6 + 3e5 * np.sin(0.21 * t), 42.0 + 14.0 * (1.0 - np.exp(-t / 50.0)))


def channels(log: dict[str, np.ndarray]) -> dict[str, Channel]:
    """The rig's log as channels."""
    return {k: Channel(log["t"], v) for k, v in log.items() if k != "t"}


RESOLUTION = {
    "x_dem": 3,
    "x_lvdt": 3,
    "i_cmd": 3,
    "n_dem": 3,
    "n_r": 3,
    "p_s": 3,
    "t_oil": 1,
    "vigv": 3,
    "vgv1": 3,
    "vgv2": 3,
    "state": 0,
}


def hidden_run() -> dict[str, np.ndarray]:
    """200 s at 100 Hz of a machine whose valve has a dead band, and whose piston carries an aerodynamic load."""
    hidden = [Hidden("valve_dead_band", {"half_width": 0.8e-3}), Hidden("aero_load", {"force": 3500.0})]
    log = simulate(manoeuvre(4, 200.0), firmware(), hidden, seed=4, rate=100, jitter=0.0).log
    return {k: np.round(v, RESOLUTION.get(k, 6)) for k, v in log.items()}


def main() -> None:
    """Write the logs beside this file."""
    write_log(HERE / "hidden_effect.parquet", channels(hidden_run()))
    run = simulate(engine_run(), firmware(), seed=20, rate=100, jitter=0.0)
    write_log(HERE / "engine_run.blf", channels(run.log))


if __name__ == "__main__":
    main()
