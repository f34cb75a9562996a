"""The closed loop in simulated time: controller, plant and sensors, tick by tick, as fast as the machine can.

Time is an integer number of ticks; no clock is read. The same stimulus, tables and seed give the same states, bit for
bit, in any process; `Run.state_hash` is the proof. One tick k, at t = k ms::

    every 10th tick: the ECU's frame (n_dem, n_r) arrives
    the sensors' samples at t go into the controller's tick
    what is logged at t is written down
    the plant moves on to t + 1 ms under the new current
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from controller import STATE, Calibration, load_calibration
from controller.records import SLOW, as_inputs, as_outputs
from hil.loop.pair import remember
from hil.loop.tick import FRAME, Loop, control, hear, mean_current, move, new_loop
from plant import Plant, build_plant, chain, places
from vaneloop.base.compiled import compiled_free, is_cached
from vaneloop.base.errors import InputError
from vaneloop.base.signals import SIDES
from vaneloop.base.vanes import VANES, own_rows

__all__ = ["FRAME", "Run", "Stimulus", "columns_of", "lockstep", "snapshot_names", "to_border", "warm_up"]

CHUNK = 10_000  # ticks between two calls of the progress function
WARM_UP = 1_000  # ticks before t = 0 with the first frame held: the controller reaches RUN and the servo settles
_BORDER = {  # columns before those of the vanes -> factor from SI into border units
    "t": 1.0, "n_dem": 1.0, "n_r": 1.0, "x_dem": 1e3, "x_lvdt": 1e3, "i_cmd": 1e3, "p_s": 1e-6, "t_oil": 1.0
}  # fmt: skip
VIGV = len(_BORDER)  # column of the first stage

# columns of a stimulus
S_N_DEM, S_N_R, S_P_S, S_T_OIL, S_FRESH, S_REJECTED, S_MODE_REQUEST, N_STIMULUS = range(8)


@dataclass(frozen=True)
class Stimulus:
    """What the ECU sends and the supply gives, one row every 10 ms.

    n_dem   %, float64[n]
    n_r     %, float64[n]; NaN where the plant's own engine supplies it
    p_s     Pa, float64[n]
    t_oil   degC, float64[n]
    mode_request  float64[n], 1 run, 0 standby
    """

    rows: np.ndarray  # float64[n, N_STIMULUS]

    @classmethod
    def of(
        cls,
        n_dem: ArrayLike,
        n_r: ArrayLike | None = None,
        p_s: ArrayLike = 21e6,
        t_oil: ArrayLike = 40.0,
        mode_request: ArrayLike = 1.0,
    ) -> Stimulus:
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
    """One simulated run: ``columns`` of border-unit arrays on the raster ``t`` (s), and the digest of every tick's
    state.

    Raises InputError where a signal is no number: the machine that was given has no such run.
    """

    columns: dict[str, np.ndarray]
    simulated_s: float
    wall_s: float
    state_hash: str
    faults: int

    def __post_init__(self) -> None:
        for name, values in self.columns.items():
            silent = ~np.isfinite(values)
            if silent.any():
                raise InputError(
                    f"simulation: {name} (={values[silent][0]}) at t = {self.t[silent][0]:.3f} s must be finite; this "
                    f"machine runs away"
                )

    @property
    def t(self) -> np.ndarray:
        """Time from the start, s."""
        return self.columns["t"]


@compiled_free
def advance(
    k0: int,
    ticks: int,
    stimulus: np.ndarray,
    noise: np.ndarray,
    a: Loop,
    every: int,
    out: np.ndarray,
    snapshots: np.ndarray,
) -> None:
    """Advance the loop ``a`` (`hil.loop.tick.Loop`) by ``ticks`` ticks from tick ``k0``, a multiple of 10.

    noise      float64[ticks or 1, sensors] standard normal numbers, in the order of `Loop.sigma`
    out        float64[rows or 0, 10 + stages, with a motor one more, with two actuators two] in SI, a row every
               ``every`` ticks (`columns_of`)
    snapshots  float64[ticks or 0, n] copies of the whole state that the machine has, at each tick (`snapshot_names`)
    """
    z, s, inputs, given = a.z, a.s, as_inputs(a.inputs), as_outputs(a.outputs)
    noisy = noise.shape[0] > 1
    keep = snapshots.shape[0] > 0
    n_z, n_s, stages = a.z_rows.shape[0], a.s_rows.shape[0], a.angles.shape[0]
    last_frame = stimulus.shape[0] - 1
    n_dem = n_r = 0.0
    for i in range(ticks):
        k = k0 + i
        m = i if noisy else 0
        frame = min(max(k // SLOW, 0), last_frame)
        if k % SLOW == 0:
            now = stimulus[frame]
            n_dem = now[S_N_DEM]
            n_r = hear(
                a, n_dem, now[S_N_R], now[S_FRESH], now[S_REJECTED], now[S_MODE_REQUEST], k, noise[m, 1 + stages]
            )
        else:
            inputs.demand_fresh = 0.0
            inputs.demand_rejected = 0.0
        p_s, t_oil = stimulus[frame, S_P_S], stimulus[frame, S_T_OIL]
        control(k, a, noise, m, t_oil)
        if k % every == 0 and out.shape[0] > 0:
            r = i // every
            out[r, 0] = k * 1e-3
            out[r, 1] = n_dem
            out[r, 2] = n_r
            out[r, 3] = given.x_dem
            out[r, 4] = inputs.x_lvdt
            out[r, 5] = mean_current(a)
            out[r, 6] = p_s
            out[r, 7] = t_oil
            for q in range(stages):
                out[r, VIGV + q] = a.angles[q]
            out[r, VIGV + stages] = given.mode
            out[r, VIGV + stages + 1] = s[places.N_R, 0]
            if a.sides.shape[0] > 0:
                out[r, VIGV + stages + 2], out[r, VIGV + stages + 3] = a.sides[0], a.sides[1]
            elif out.shape[1] > VIGV + stages + 2:
                out[r, VIGV + stages + 2] = s[places.I_MOTOR, 0]
        if keep:
            for q in range(n_z):
                snapshots[i, q] = z[a.z_rows[q]]
            for q in range(n_s):
                for side in range(s.shape[1]):
                    snapshots[i, n_z + side * n_s + q] = s[a.s_rows[q], side]
            remember(a.pair, snapshots[i], n_z + s.shape[1] * n_s)
        move(k, a, n_dem, n_r, p_s, t_oil)


def columns_of(vanes: tuple[str, ...], motor: bool = False, two: bool = False) -> tuple[str, ...]:
    """Names of a run's columns, of a machine with these stages, with a motor or without, with two actuators or one."""
    return (*_BORDER, *vanes, "state", "n_engine", *(("i_motor",) if motor else ()), *(SIDES if two else ()))


def to_border(out: np.ndarray, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return the columns ``out[:, i]`` (SI) with their ``names`` (`columns_of`) in border units."""
    factor = {**_BORDER, **dict.fromkeys(VANES, 180.0 / np.pi), **dict.fromkeys(SIDES, 1e3)}
    return {name: np.ascontiguousarray(out[:, i] * factor.get(name, 1.0)) for i, name in enumerate(names)}


def snapshot_names(plant: Plant) -> list[str]:
    """Names of the numbers whose digest is the state hash: the firmware's, then the plant's, that this machine has;
    of two actuators then those of side B.
    """
    firmware, of_a = [STATE[i] for i in own_rows(STATE, plant.vanes)], [chain.STATE[row] for row in plant.rows]
    return [*firmware, *of_a, *(f"b_{name}" for name in of_a if plant.sides == 2)]


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
    pots           float64[frames, 2 stages], what the controller gets of each stem potentiometer: share of its
                   reading and offset (rad), stage by stage; share 0 = stuck, offset NaN = none. The log keeps the
                   reading itself.
    watch          called with the states of the controller and the plant at each of the next up to 10,000 ticks, side
                   by side (`snapshot_names`)
    progress       called with the fraction done
    """
    machine = plant or _nominal()
    if CHUNK % every:
        raise ValueError(f"every (={every}) must divide {CHUNK}")
    rows = stimulus.rows
    ticks = int(round((duration if duration is not None else len(rows) * FRAME) * 1000))
    n_dem, t_oil = float(rows[0, S_N_DEM]), float(rows[0, S_T_OIL])
    n0 = float(rows[0, S_N_R]) if np.isfinite(rows[0, S_N_R]) else n_dem
    loop = new_loop(
        machine,
        calibration or load_calibration(),
        n_engine=n_dem,
        n_r=n0,
        t_oil=t_oil,
        noisy=seed is not None,
        pots=pots,
    )
    s = loop.s
    loop.begin_on(*_starting_curve(loop.calibration, n0, stroke_demand))
    generator = np.random.Generator(np.random.PCG64(seed if seed is not None else 0))
    names = columns_of(machine.vanes, machine.kind == "electromechanical", machine.sides == 2)
    sensors = len(machine.sigma)
    silent = np.zeros((1, sensors))
    advance(-WARM_UP, WARM_UP, rows[:1], silent, loop, 10, np.empty((0, len(names))), np.empty((0, 0)))
    loop.mean[:] = 0.0
    if angles is not None:
        machine.place_rings(s, angles, n0, t_oil)

    out = np.empty((-(-ticks // every), len(names)))
    wide = len(loop.z_rows) + loop.s.shape[1] * len(loop.s_rows) + (len(loop.pair.memory) if loop.pair else 0)
    buffers = [np.empty((CHUNK if hashed or watch is not None else 0, wide)) for _ in range(2)]
    digest = hashlib.sha256()
    started = time.perf_counter()
    with ThreadPoolExecutor(1) as pool:
        pending = None
        for c, k0 in enumerate(range(0, ticks, CHUNK)):
            n = min(CHUNK, ticks - k0)
            noise = silent if seed is None else generator.standard_normal((n, sensors))
            snap = buffers[c % 2][:n]
            advance(k0, n, rows, noise, loop, every, out[k0 // every :], snap)
            if pending is not None:
                pending.result()
            if hashed:
                pending = pool.submit(digest.update, memoryview(snap))  # type: ignore[arg-type]
            if watch is not None:
                watch(snap)
            if progress is not None:
                progress((k0 + n) / ticks)
    wall = time.perf_counter() - started
    return Run(to_border(out, names), ticks * 1e-3, wall, digest.hexdigest() if hashed else "", int(loop.given.faults))


def _starting_curve(cal: Calibration, n: float, stroke_demand: float | None) -> tuple[float, float]:
    """Direction and blend whose curve is nearest to the logged stroke demand at speed ``n`` (%)."""
    if stroke_demand is None:
        return 1.0, 1.0
    extension, retraction = (float(np.interp(n, cal.table[0], cal.table[r])) for r in (1, 2))
    return (1.0, 1.0) if abs(extension - stroke_demand) <= abs(retraction - stroke_demand) else (-1.0, 0.0)


def warm_up(say: Callable[[str], None]) -> None:
    """Compile the loop once, telling the user before a wait of some seconds; silent when its compiled code is there
    already.
    """
    if is_cached(advance):
        return
    say("compiling the simulator for this machine (once, about 15 s) ...")
    started = time.perf_counter()
    lockstep(Stimulus.of(np.full(10, 60.0)))
    say(f"compiled in {time.perf_counter() - started:.0f} s")
