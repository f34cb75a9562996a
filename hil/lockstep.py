"""The closed loop in simulated time: controller, plant and sensors, tick by tick, as fast as the machine can.

Time is an integer number of ticks; no clock is read. The same stimulus, tables and seed give the same states, bit for bit, in any process;
`Run.state_hash` is the proof. One tick k, at t = k ms::

    every 10th tick: the ECU's frame (n_dem, n_r) arrives
    the sensors' samples at t go into the controller's tick
    what is logged at t is written down
    the plant moves on to t + 1 ms under the new current
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from controller import Calibration, load_calibration, new_inputs, new_state, tick
from controller.firmware import (
    BLEND,
    DIRECTION,
    FAULT_BITS,
    I_CMD,
    IN_FRESH,
    IN_MODE_REQUEST,
    IN_N_DEM,
    IN_N_R,
    IN_REJECTED,
    IN_VIGV,
    IN_X_LVDT,
    KFF,
    KI,
    KP,
    MODE,
    SLOW,
    TREND_CHANGE,
    TREND_RATE_ON,
    X_DEM,
)
from plant import Plant, build_plant, chain
from plant.compiled import compiled_free, in_place
from plant.effects import can_delay, controller_gain_error, frame_hold, schedule_error, trend_threshold_error

__all__ = ["COLUMNS", "FRAME", "Run", "Stimulus", "flashed", "lockstep", "move", "sense", "spoil", "warm_up"]

FRAME = 1e-2  # s, period of the ECU's frame
CHUNK = 10_000  # ticks between two calls of the progress function
WARM_UP = 1_000  # ticks before t = 0 with the first frame held: the controller reaches RUN and the servo settles
COLUMNS = ("t", "n_dem", "n_r", "x_dem", "x_lvdt", "i_cmd", "p_s", "t_oil", "vigv", "vgv1", "vgv2", "state", "n_engine")
_BORDER = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3, 1e-6, 1.0, *[180.0 / np.pi] * 3, 1.0, 1.0])  # SI -> border units
_BORDER.setflags(write=False)

# columns of a stimulus
S_N_DEM, S_N_R, S_P_S, S_T_OIL, S_FRESH, S_REJECTED, S_MODE_REQUEST, N_STIMULUS = range(8)


@dataclass(frozen=True)
class Stimulus:
    """What the ECU sends and the hydraulic supply gives, one row every 10 ms.

    n_dem   %, float64[n]
    n_r     %, float64[n]; NaN where the plant's own engine supplies it
    p_s     Pa, float64[n]
    t_oil   degC, float64[n]
    mode_request  float64[n], 1 run, 0 standby
    """

    rows: np.ndarray  # float64[n, N_STIMULUS]

    @classmethod
    def of(cls, n_dem, n_r=None, p_s=21e6, t_oil=40.0, mode_request=1.0) -> Stimulus:
        """Build from arrays or constants; all frames arrive and are good."""
        n_dem = np.atleast_1d(np.asarray(n_dem, dtype=np.float64))
        rows = np.empty((len(n_dem), N_STIMULUS))
        rows[:, S_N_DEM] = n_dem
        rows[:, S_N_R] = np.nan if n_r is None else n_r
        rows[:, S_P_S] = p_s
        rows[:, S_T_OIL] = t_oil
        rows[:, S_FRESH] = 1.0
        rows[:, S_REJECTED] = 0.0
        rows[:, S_MODE_REQUEST] = mode_request
        return cls(rows)


@dataclass(frozen=True)
class Run:
    """One simulated run: ``columns`` of border-unit arrays on the raster ``t`` (s), and the digest of every tick's state."""

    columns: dict[str, np.ndarray]
    simulated_s: float
    wall_s: float
    state_hash: str
    faults: int

    @property
    def t(self) -> np.ndarray:
        """Time from the start, s."""
        return self.columns["t"]


@in_place
def sense(inputs, s, p, sigma, noise, m, t_oil):
    """Sample LVDT and stem potentiometers into the controller's inputs, with row ``m`` of ``noise``."""
    inputs[IN_X_LVDT] = chain.sample_lvdt(s, p, 0, sigma[0] * noise[m, 0], t_oil)
    for q in range(3):
        inputs[IN_VIGV + q] = s[chain.POT + q, 0] + sigma[1 + q] * noise[m, 1 + q]


@in_place
def spoil(inputs, pots, row):
    """Replace each potentiometer's reading by a share of it and an offset (rad), from ``row`` of ``pots``."""
    for q in range(3):
        inputs[IN_VIGV + q] = pots[row, 2 * q] * inputs[IN_VIGV + q] + pots[row, 2 * q + 1]


@in_place
def move(k, s, p, i_cmd, n_dem, n_r, p_s, t_oil):
    """Let the machine move on from tick ``k`` to the next under ``i_cmd`` (A), at demand ``n_dem`` and speed ``n_r`` (%)."""
    chain.rotor_step(s, p, 0, n_dem, chain.TICK)
    chain.drive_step(s, p, 0, i_cmd, n_r, p_s, t_oil, chain.TICK, chain.SUBSTEPS)
    chain.vane_step(s, p, 0, n_r, t_oil, (k + 1) * chain.TICK)


@compiled_free
def advance(k0, ticks, stimulus, noise, sigma, inputs, z, calibration, s, p, mean, every, out, snapshots, pots):
    """Advance the loop by ``ticks`` ticks from tick ``k0``.

    noise      float64[ticks or 1, 5] standard normal numbers (LVDT, three potentiometers, speed), sigma float64[5] their rms in SI
    mean       float64[2] sum and number of currents since the last logged sample
    out        float64[rows, 12] in SI, a row every ``every`` ticks
    snapshots  float64[ticks or 0, n] copies of the whole state at each tick
    pots       float64[frames or 0, 6] what the controller gets of each potentiometer: share of its reading, offset (rad), stage by stage
    """
    noisy = noise.shape[0] > 1
    keep = snapshots.shape[0] > 0
    n_z, n_s = z.shape[0], s.shape[0]
    last_frame = stimulus.shape[0] - 1
    stale = p[chain.CAN_DELAY, 0] > 0.0 or p[chain.FRAME_HOLD, 0] > 0.0
    sent_n_dem, sent_n_r = inputs[IN_N_DEM], inputs[IN_N_R]
    for i in range(ticks):
        k = k0 + i
        m = i if noisy else 0
        frame = min(max(k // SLOW, 0), last_frame)
        if k % SLOW == 0:
            n_dem = stimulus[frame, S_N_DEM]
            n_r = stimulus[frame, S_N_R]
            if n_r != n_r:  # not logged: the plant's engine
                n_r = s[chain.N_R, 0] + sigma[4] * noise[m, 4]
                if stale:
                    stimulus[frame, S_N_R] = n_r  # for the frame in which it arrives
            sent_n_dem, sent_n_r = n_dem, n_r
            if stale:
                content = can_delay.step(k * chain.TICK, p[chain.CAN_DELAY, 0])
                content = frame_hold.step(content, p[chain.FRAME_HOLD, 0])
                old = min(max(int(math.floor(content / FRAME + 1e-6)), 0), frame)
                n_dem = stimulus[old, S_N_DEM]
                n_r = stimulus[old, S_N_R]
            inputs[IN_N_DEM] = n_dem
            inputs[IN_N_R] = n_r
            inputs[IN_FRESH] = stimulus[frame, S_FRESH]
            inputs[IN_REJECTED] = stimulus[frame, S_REJECTED]
            inputs[IN_MODE_REQUEST] = stimulus[frame, S_MODE_REQUEST]
        else:
            inputs[IN_FRESH] = 0.0
            inputs[IN_REJECTED] = 0.0
        p_s, t_oil = stimulus[frame, S_P_S], stimulus[frame, S_T_OIL]
        sense(inputs, s, p, sigma, noise, m, t_oil)
        if pots.shape[0] > 0:
            spoil(inputs, pots, min(frame, pots.shape[0] - 1))
        tick(inputs, z, calibration)
        mean[0] += z[I_CMD]
        mean[1] += 1.0
        if k % every == 0 and out.shape[0] > 0:
            r = i // every
            out[r, 0] = k * 1e-3
            out[r, 1] = sent_n_dem
            out[r, 2] = sent_n_r
            out[r, 3] = z[X_DEM]
            out[r, 4] = inputs[IN_X_LVDT]
            out[r, 5] = mean[0] / mean[1]
            out[r, 6] = p_s
            out[r, 7] = t_oil
            out[r, 8] = s[chain.POT, 0] + sigma[1] * noise[m, 1]
            out[r, 9] = s[chain.POT + 1, 0] + sigma[2] * noise[m, 2]
            out[r, 10] = s[chain.POT + 2, 0] + sigma[3] * noise[m, 3]
            out[r, 11] = z[MODE]
            out[r, 12] = s[chain.N_R, 0]
            mean[0] = 0.0
            mean[1] = 0.0
        if keep:
            for q in range(n_z):
                snapshots[i, q] = z[q]
            for q in range(n_s):
                snapshots[i, n_z + q] = s[q, 0]
        move(k, s, p, z[I_CMD], sent_n_dem, sent_n_r, p_s, t_oil)


@lru_cache(maxsize=1)
def _nominal() -> Plant:
    return build_plant()


def lockstep(
    stimulus: Stimulus,
    *,
    calibration: Calibration | None = None,
    plant: Plant | None = None,
    seed: int | None = None,
    every: int = 10,
    angles: tuple[float, ...] | None = None,
    stroke_demand: float | None = None,
    duration: float | None = None,
    hashed: bool = True,
    pots: np.ndarray | None = None,
    watch: Callable[[np.ndarray], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Run:
    """Run controller and plant against ``stimulus``.

    seed           of the sensors' noise; None = noise-free sensors
    every          ticks (1 ms each) between logged samples; must divide 10,000
    angles         rad, measured vane angles at t = 0, to start each stage's play where the machine's was
    stroke_demand  m, logged stroke demand at t = 0: the controller starts on the curve that is nearer to it
    duration       s, default the stimulus's length
    pots           float64[frames, 6], what the controller gets of each stem potentiometer: share of its reading and offset (rad), stage by
                   stage; share 0 = stuck, offset NaN = none. The log keeps the reading itself.
    watch          called with the states of the controller and the plant at each of the next up to 10,000 ticks, side by side
    progress       called with the fraction done
    """
    machine = plant or _nominal()
    cal = flashed(calibration or load_calibration(), machine)
    if CHUNK % every:
        raise ValueError(f"every (={every}) must divide {CHUNK}")
    ticks = int(round((duration if duration is not None else len(stimulus.rows) * FRAME) * 1000))
    p = machine.p
    n0 = stimulus.rows[0, S_N_R] if np.isfinite(stimulus.rows[0, S_N_R]) else stimulus.rows[0, S_N_DEM]
    z, inputs, mean = new_state(), new_inputs(), np.zeros(2)
    z[DIRECTION], z[BLEND] = _starting_curve(cal, n0, stroke_demand)
    stroke, t_oil = float(np.interp(n0, cal.table[0], cal.table[3])), float(stimulus.rows[0, S_T_OIL])
    s = machine.start(stroke=stroke, n_r=stimulus.rows[0, S_N_DEM], t_oil=t_oil)
    sigma = machine.sigma if seed is not None else np.zeros(5)
    generator = np.random.Generator(np.random.PCG64(seed if seed is not None else 0))
    silent = np.zeros((1, 5))
    no_out, no_snapshots, all_pots = np.empty((0, len(COLUMNS))), np.empty((0, 0)), np.empty((0, 6))
    pots = all_pots if pots is None else np.ascontiguousarray(pots, dtype=np.float64)
    advance(-WARM_UP, WARM_UP, stimulus.rows[:1].copy(), silent, sigma, inputs, z, cal, s, p, mean, 10, no_out, no_snapshots, pots)
    mean[:] = 0.0
    if angles is not None:
        machine.place_rings(s, angles, n0, t_oil)

    rows = stimulus.rows.copy()  # a late frame keeps the speed with which it was sent
    out = np.empty((-(-ticks // every), len(COLUMNS)))
    buffers = [np.empty((CHUNK if hashed or watch is not None else 0, len(z) + len(s))) for _ in range(2)]
    digest = hashlib.sha256()
    started = time.perf_counter()
    with ThreadPoolExecutor(1) as pool:
        pending = None
        for c, k0 in enumerate(range(0, ticks, CHUNK)):
            n = min(CHUNK, ticks - k0)
            noise = silent if seed is None else generator.standard_normal((n, 5))
            snap = buffers[c % 2][:n]
            advance(k0, n, rows, noise, sigma, inputs, z, cal, s, p, mean, every, out[k0 // every :], snap, pots)
            if pending is not None:
                pending.result()
            if hashed:
                pending = pool.submit(digest.update, memoryview(snap))  # type: ignore[arg-type]
            if watch is not None:
                watch(snap)
            if progress is not None:
                progress((k0 + n) / ticks)
    wall = time.perf_counter() - started
    columns = {name: np.ascontiguousarray(out[:, i] * _BORDER[i]) for i, name in enumerate(COLUMNS)}
    return Run(columns, ticks * 1e-3, wall, digest.hexdigest() if hashed else "", int(z[FAULT_BITS]))


def flashed(calibration: Calibration, plant: Plant) -> Calibration:
    """Return the calibration as it is in the controller: with the effects that change its tables and gains."""
    p = plant.p[:, 0]
    k, table = calibration.k.copy(), calibration.table.copy()
    table[1:] = schedule_error.step(table[1:], p[chain.SCHEDULE_ERROR])
    for row in (TREND_RATE_ON, TREND_CHANGE):
        k[row] = trend_threshold_error.step(k[row], p[chain.TREND_THRESHOLD_ERROR])
    for row in (KP, KI, KFF):
        k[row] = controller_gain_error.step(k[row], p[chain.CONTROLLER_GAIN_ERROR])
    return calibration._replace(k=k, table=table)


def _starting_curve(cal: Calibration, n: float, stroke_demand: float | None) -> tuple[float, float]:
    """Direction and blend whose curve is nearest to the logged stroke demand at speed ``n`` (%)."""
    if stroke_demand is None:
        return 1.0, 1.0
    extension, retraction = (float(np.interp(n, cal.table[0], cal.table[r])) for r in (1, 2))
    return (1.0, 1.0) if abs(extension - stroke_demand) <= abs(retraction - stroke_demand) else (-1.0, 0.0)


def warm_up(say: Callable[[str], None]) -> None:
    """Compile everything once, telling the user before a wait of some seconds; silent when compiled code is there already."""
    from plant.compiled import is_cached

    if is_cached():
        return
    say("compiling the simulator for this machine (once, about 15 s) ...")
    started = time.perf_counter()
    lockstep(Stimulus.of(np.full(10, 60.0)))
    say(f"compiled in {time.perf_counter() - started:.0f} s")
