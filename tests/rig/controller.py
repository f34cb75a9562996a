"""How a controller is handed to the rig, and a simple one of the rig's own for runs without the firmware."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numba import njit
from scipy.interpolate import CubicSpline

from .geometry import load, ring_angle, schedule, vane_angle


class Controller(Protocol):
    """A controller called every 1 ms from Python: slow, but anything will do."""

    x_dem: float  # m
    state: int  # number of the mode

    def step(self, n_dem: float, n_r: float, x_lvdt: float, demand_fresh: bool, mode_request: int) -> float:
        """Return the current (A) for the demand and speed (%) of the last frame and the stroke (m) as the LVDT gives
        it.
        """
        ...


@dataclass
class Compiled:
    """A compiled controller ``tick(inputs, state, calibration)`` that changes ``state`` in place, and where its signals
    are.

    inputs, state   float64 arrays to start from (copied for each run)
    n_dem .. fresh  places in ``inputs``: %, %, m, 1 on a tick with a new frame
    i_cmd .. mode   places in ``state``: A, m, number of the mode
    current_limit   A
    vigv            place in ``inputs`` of the first of three stem angles (rad); -1: it takes none
    mode_request    place in ``inputs`` of the mode asked for (0 standby, 1 run); -1: it takes none
    change          (effect name, parameters) -> another Compiled with that error in it, or None where the rig is to do
                    it from outside
    """

    tick: Callable[..., None]
    inputs: np.ndarray
    state: np.ndarray
    calibration: Any
    n_dem: int
    n_r: int
    x_lvdt: int
    fresh: int
    i_cmd: int
    x_dem: int
    mode: int
    current_limit: float = 0.040
    vigv: int = -1
    mode_request: int = -1
    change: Callable[[str, dict[str, float]], Compiled | None] | None = None

    @property
    def slots(self) -> np.ndarray:
        """Places of the signals in the order the kernel wants them."""
        return np.array(
            [
                self.n_dem,
                self.n_r,
                self.x_lvdt,
                self.fresh,
                self.i_cmd,
                self.x_dem,
                self.mode,
                self.vigv,
                self.mode_request,
            ]
        )


class Settings(NamedTuple):
    """Calibration of the stand-in: scalars ``k`` = kp (A/m), ki (A/m/s), kff (A/(m/s)), trend (%), limit (A); stroke
    table (%, m, m).
    """

    k: np.ndarray
    table: np.ndarray


@njit(error_model="numpy")
def stand_in_tick(inputs, state, calibration):
    """PI on the stroke error with feed-forward, and two stroke tables chosen by the trend of the demand.

    inputs  n_dem, n_r, x_lvdt, fresh
    state   i_cmd, x_dem, mode, integral, direction, turning point, n_r filtered, table 0..1, x_dem before, ticks
    """
    k, table = calibration.k, calibration.table
    if state[9] == 0.0:
        state[5] = inputs[0]
        state[6] = inputs[1]
        state[4] = 1.0
        state[7] = 1.0
    if state[9] % 10.0 == 0.0:
        n_dem = inputs[0]
        if state[4] * (n_dem - state[5]) > 0.0:
            state[5] = n_dem
        elif abs(n_dem - state[5]) > k[3]:
            state[4] = -state[4]
            state[5] = n_dem
        goal = 1.0 if state[4] > 0.0 else 0.0
        state[7] += min(max(goal - state[7], -0.04), 0.04)
        state[6] += 0.25 * (inputs[1] - state[6])
        up = np.interp(state[6], table[0], table[1])
        down = np.interp(state[6], table[0], table[2])
        target = down + state[7] * (up - down)
        state[8] = state[1] if state[9] > 0.0 else target
        if state[9] == 0.0:
            state[1] = target
        state[1] += min(max(target - state[1], -1e-3), 1e-3)
    part = (state[9] % 10.0 + 1.0) / 10.0
    rate = (state[1] - state[8]) / 0.01
    e = state[8] + part * (state[1] - state[8]) - inputs[2]
    integral = state[3] + k[1] * e * 1e-3
    i = k[0] * e + integral + k[2] * rate
    if abs(i) <= k[4]:
        state[3] = integral
    state[0] = min(max(i, -k[4]), k[4])
    state[2] = 2.0
    state[9] += 1.0


def stroke_tables() -> np.ndarray:
    """Speeds (%) and strokes (m) that put the VIGV on its schedule when extending and when retracting: half the play
    apart each way.
    """
    g = load()
    s = g.stages[0]
    x = np.linspace(0.0, 48e-3, 97)
    angle = vane_angle(ring_angle(g, 0, x), s.vane_ratio)
    n, target = schedule()
    inverse = CubicSpline(angle, x)
    return np.array(
        [
            n,
            np.clip(inverse(target + s.hysteresis / 2), 5e-4, 47.5e-3),
            np.clip(inverse(target - s.hysteresis / 2), 5e-4, 47.5e-3),
        ]
    )


def stand_in(trend: float = 0.3) -> Compiled:
    """Return the rig's own controller. ``trend`` (%) is the change of demand that turns the direction."""

    def change(name: str, parameters: dict[str, float]) -> Compiled | None:
        if name == "trend_threshold_error":
            return stand_in(trend * parameters["factor"])
        return None

    settings = Settings(np.array([13.0, 80.0, 0.267, trend, 0.040]), stroke_tables())
    return Compiled(stand_in_tick, np.zeros(4), np.zeros(10), settings, 0, 1, 2, 3, 0, 1, 2, change=change)


class AsObject:
    """A `Compiled` controller behind the Python face of `Controller` (its plain Python source runs), to test that both
    give the same.
    """

    def __init__(self, compiled: Compiled):
        self.c = replace(compiled, inputs=compiled.inputs.copy(), state=compiled.state.copy())
        self.x_dem, self.state = 0.0, 0

    def step(self, n_dem: float, n_r: float, x_lvdt: float, demand_fresh: bool, mode_request: int) -> float:
        """One tick."""
        c = self.c
        c.inputs[[c.n_dem, c.n_r, c.x_lvdt, c.fresh]] = n_dem, n_r, x_lvdt, float(demand_fresh)
        c.tick(c.inputs, c.state, c.calibration)
        self.x_dem, self.state = float(c.state[c.x_dem]), int(c.state[c.mode])
        return float(c.state[c.i_cmd])


class Tape(NamedTuple):
    """Recorded currents (A), stroke demands (m) and modes, one a tick."""

    i_cmd: np.ndarray
    x_dem: np.ndarray
    mode: np.ndarray


@njit(error_model="numpy")
def playback_tick(inputs, state, calibration):
    """Next current of the tape; the last one is held."""
    k = min(int(state[3]), len(calibration.i_cmd) - 1)
    state[0] = calibration.i_cmd[k]
    state[1] = calibration.x_dem[k]
    state[2] = calibration.mode[k]
    state[3] += 1.0


def playback(i_cmd: np.ndarray, x_dem: np.ndarray | None = None, mode: np.ndarray | None = None) -> Compiled:
    """Return a controller that plays currents back, one a tick from the first tick of the run-up on: the machine in
    open loop.
    """
    i_cmd = np.ascontiguousarray(i_cmd, dtype=float)
    tape = Tape(
        i_cmd, np.zeros_like(i_cmd) if x_dem is None else x_dem, np.full_like(i_cmd, 2.0) if mode is None else mode
    )
    return Compiled(playback_tick, np.zeros(4), np.zeros(4), tape, 0, 1, 2, 3, 0, 1, 2)
