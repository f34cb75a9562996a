"""Many closed loops side by side, each of a machine and a calibration of its own, in simulated time.

A lane is one loop: controller, plant and sensors, tick by tick, with the functions that `hil.loop.lockstep` calls for a
single one. They agree to rounding; the linkage's arctangents are series here (`plant.linkage_lanes`). Lanes of one
block move together, and the compiler puts eight of them into one vector instruction.

A loop that does not go through blocks runs alone, in `hil.loop.lockstep`: strategies inverse and adaptive, a controller
of the user's own, an electromechanical actuator, learned curves, can_delay and frame_hold.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from controller import Calibration, load_calibration
from controller.records import SLOW
from hil.loop import firmware_lanes
from hil.loop.lockstep import (
    CHUNK,
    S_FRESH,
    S_MODE_REQUEST,
    S_N_DEM,
    S_N_R,
    S_P_S,
    S_REJECTED,
    S_T_OIL,
    VIGV,
    WARM_UP,
    Run,
    Stimulus,
    columns_of,
    lockstep,
    to_border,
)
from hil.loop.tick import FRAME, Loop, new_loop
from plant import Plant, chain, chain_lanes
from plant.chain_lanes import W
from plant.lanes import wide_vectors
from plant.stages.blocks import on_all_cores
from vaneloop.base.compiled import compiled, in_place_free
from vaneloop.base.vanes import VANES

__all__ = ["BLOCK", "EIGHT", "Lanes", "aligned", "for_each", "lockstep_lanes", "loops_of", "place_machine"]

EIGHT = 8  # lanes of a vector: a block runs a multiple of it
LINE = 64  # bytes of a line of the cache
# heard: %, speed in the ECU's frame; n_dem: %; count: of the currents in ``sum``
_FIELDS = ("n_dem", "heard", "sum", "count", "sigma_lvdt", "sigma_speed")
BLOCK = np.dtype([*firmware_lanes.fields(), *chain_lanes.fields(), *((name, np.float64, (W,)) for name in _FIELDS)])


@compiled
def place_machine(block: np.ndarray, j: int, p: np.ndarray, s: np.ndarray, stages: int) -> None:
    """Put a machine into lane ``j`` of a block (`plant.chain_lanes.place`)."""
    chain_lanes.place(block[0], j, p, s, stages)


@in_place_free
def _advance(
    k0: int,
    ticks: int,
    stimuli: np.ndarray,
    which: np.ndarray,
    noise: np.ndarray,
    sigma_pots: np.ndarray,
    tables: np.ndarray,
    block: np.ndarray,
    n: int,
    stages: int,
    drive_way: int,
    vane_effects: bool,
    every: int,
    out: np.ndarray,
) -> None:
    """Advance ``n`` lanes, a multiple of 8, by ``ticks`` ticks from tick ``k0``, a multiple of 10.

    stimuli, which  float64[:, frames, N_STIMULUS], and which of them each lane has
    noise           float64[ticks or 1, 2 + stages] standard normal numbers, the same for every lane
    sigma_pots      float64[lane, stages] rad
    out             float64[rows or 0, columns, lane] in SI, a row every ``every`` ticks (`columns_of`)
    """
    wide_vectors()
    b = block[0]
    noisy = noise.shape[0] > 1
    last_frame = stimuli.shape[1] - 1
    n = min(n // EIGHT * EIGHT, W)
    for i in range(ticks):
        k = k0 + i
        m = i if noisy else 0
        if k % SLOW == 0:
            frame = min(max(k // SLOW, 0), last_frame)
            for j in range(n):
                now = stimuli[which[j], frame]
                b.n_dem[j], b.p_s[j], b.t_oil[j] = now[S_N_DEM], now[S_P_S], now[S_T_OIL]
                own = b.n_r[j] + b.sigma_speed[j] * noise[m, 1 + stages]
                b.heard[j] = own if now[S_N_R] != now[S_N_R] else now[S_N_R]
                b.in_demand_fresh[j], b.in_demand_rejected[j] = now[S_FRESH], now[S_REJECTED]
                if now[S_FRESH] > 0.5:
                    b.in_n_dem[j], b.in_n_r[j], b.in_mode_request[j] = b.n_dem[j], b.heard[j], now[S_MODE_REQUEST]
            chain_lanes.feed(b, n)
            chain_lanes.sample_lvdt(b, n, drive_way, noise[m, 0])
            firmware_lanes.on_frame(b, n, tables)
        else:
            chain_lanes.sample_lvdt(b, n, drive_way, noise[m, 0])
            firmware_lanes.between_frames(b, n, k % SLOW)
        for j in range(n):
            b.sum[j] += b.z_i_cmd[j]
        b.count[0] += 1.0
        if k % every == 0 and out.shape[0] > 0:
            row = out[i // every]
            for j in range(n):
                row[0, j], row[1, j], row[2, j] = k * 1e-3, b.n_dem[j], b.heard[j]
                row[3, j], row[4, j], row[5, j] = b.z_x_dem[j], b.in_x_lvdt[j], b.sum[j] / b.count[0]
                row[6, j], row[7, j] = b.p_s[j], b.t_oil[j]
                row[VIGV + stages, j], row[VIGV + stages + 1, j] = b.z_mode[j], b.n_r[j]
                b.sum[j] = 0.0
            b.count[0] = 0.0
            for q in range(stages):
                for j in range(n):
                    row[VIGV + q, j] = b.pot[q, j] + sigma_pots[j, q] * noise[m, 1 + q]
        chain_lanes.move(b, n, stages, drive_way, vane_effects, (k + 1) * chain.TICK)


def lockstep_lanes(
    stimulus: Stimulus | Sequence[Stimulus],
    plants: Sequence[Plant],
    *,
    calibrations: Calibration | Sequence[Calibration] | None = None,
    seed: int | None = None,
    every: int = 10,
    duration: float | None = None,
) -> list[Run]:
    """Run a closed loop for each of the ``plants``, side by side; return their runs in the same order.

    stimulus      what the ECU sends and the supply gives: one for all, or one for each, equally long
    calibrations  one for all, or one for each; default the shipped one
    seed          of the sensors' noise, the same numbers in every loop; None = noise-free sensors
    every         ticks (1 ms each) between logged samples; must divide 10,000
    duration      s, default the stimulus's length

    A run is that of `hil.loop.lockstep.lockstep` to rounding. It has no state hash, and its ``wall_s`` is its share of
    the wall clock. Raises ValueError where there is not one stimulus or calibration for each plant.
    """
    stimuli, cals, ticks = loops_of(stimulus, calibrations, len(plants), every, duration)
    blocks: dict[Any, list[int]] = {}  # loops that can stand in one block
    loops: dict[int, Loop] = {}
    alone: list[int] = []
    for i, (plant, cal, s) in enumerate(zip(plants, cals, stimuli, strict=True)):
        way = chain_lanes.way(plant.p)
        if way is None or not firmware_lanes.runs_in_lanes(cal):
            alone.append(i)
            continue
        loops[i] = _at_start(plant, cal, s, seed is not None)
        blocks.setdefault((way, len(plant.vanes), cal.table.shape), []).append(i)
    runs: dict[int, Run] = {}
    started = time.perf_counter()
    work = [(key[0], of[a : a + W]) for key, of in blocks.items() for a in range(0, len(of), W)]

    def run(part: range) -> None:
        for way, some in work[part.start : part.stop]:
            lanes = Lanes([loops[i] for i in some], [stimuli[i] for i in some], way, every)
            runs.update(zip(some, _run(lanes, ticks, seed), strict=True))

    if work:
        on_all_cores(run, [range(q, q + 1) for q in range(len(work))])
    wall = time.perf_counter() - started
    runs = {i: Run(r.columns, r.simulated_s, wall / max(len(runs), 1), "", r.faults) for i, r in runs.items()}
    for i in alone:
        runs[i] = lockstep(
            stimuli[i], calibration=cals[i], plant=plants[i], seed=seed, every=every, duration=duration, hashed=False
        )
    return [runs[i] for i in range(len(plants))]


def loops_of(
    stimulus: Stimulus | Sequence[Stimulus],
    calibrations: Calibration | Sequence[Calibration] | None,
    count: int,
    every: int,
    duration: float | None,
) -> tuple[list[Stimulus], list[Calibration], int]:
    """Stimulus and calibration of each of ``count`` loops, and their ticks, checked as `lockstep_lanes` says."""
    if CHUNK % every:
        raise ValueError(f"every (={every}) must divide {CHUNK}")
    stimuli = for_each(stimulus, Stimulus, count, "stimulus")
    lengths = {len(s.rows) for s in stimuli}
    if len(lengths) > 1:
        raise ValueError(f"stimuli (={sorted(lengths)} rows) must be equally long")
    ticks = int(round((duration if duration is not None else max(lengths, default=0) * FRAME) * 1000))
    return stimuli, for_each(calibrations or load_calibration(), Calibration, count, "calibrations"), ticks


def for_each(one_or_many: Any, kind: type, count: int, name: str) -> list[Any]:
    """A list of ``count``: what was given once, or for each."""
    many = [one_or_many] * count if isinstance(one_or_many, kind) else list(one_or_many)
    if len(many) != count:
        raise ValueError(f"{name} (={len(many)} of them) must be one, or one for each of the {count} plants")
    return many


def _at_start(plant: Plant, calibration: Calibration, stimulus: Stimulus, noisy: bool) -> Loop:
    """The loop at rest that `lockstep` begins with."""
    n_dem, n_r, t_oil = (float(stimulus.rows[0, c]) for c in (S_N_DEM, S_N_R, S_T_OIL))
    loop = new_loop(
        plant, calibration, n_engine=n_dem, n_r=n_r if np.isfinite(n_r) else n_dem, t_oil=t_oil, noisy=noisy
    )
    loop.state.direction, loop.state.blend = 1.0, 1.0
    return loop


class Lanes:
    """Loops side by side in one block, warmed up to t = 0. All have as many stages and tables of one size.

    loops    at rest, `W` at most; those that fill the block up to whole vectors are the last one again
    stimuli  one for each of them, equally long
    way      of their plants: `plant.chain_lanes.way`
    """

    def __init__(self, loops: Sequence[Loop], stimuli: Sequence[Stimulus], way: tuple[int, bool], every: int = 10):
        self.count, self.every = len(loops), every
        self._n = n = -(-len(loops) // EIGHT) * EIGHT
        self._way, self._stages = way, len(loops[0].angles)
        last = len(loops) - 1
        filled = [loops[min(j, last)] for j in range(n)]
        self._block = aligned(BLOCK)
        for j, loop in enumerate(filled):
            firmware_lanes.place(self._block[0], j, loop)
            place_machine(self._block, j, loop.p, loop.s, self._stages)
            self._block[0]["sigma_lvdt"][j], self._block[0]["sigma_speed"][j] = loop.sigma[0], loop.sigma[-1]
        self._sigma_pots = np.array([loop.sigma[1:-1] for loop in filled])
        self._tables = np.array([loop.calibration.table for loop in filled])
        numbers: dict[int, int] = {}  # of the stimuli that differ
        which = [numbers.setdefault(id(s), len(numbers)) for s in stimuli]
        self._which = np.array([which[min(j, last)] for j in range(n)])
        self._rows = np.array([stimuli[which.index(q)].rows for q in range(len(numbers))])
        self._advance(-WARM_UP, WARM_UP, self._rows[:, :1].copy(), None, np.empty((0, 0, n)))
        self._block[0]["sum"][:] = self._block[0]["count"][:] = 0.0

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that `advance` writes."""
        return columns_of(VANES[: self._stages])

    def room(self, ticks: int) -> np.ndarray:
        """Return memory for what `advance` writes in so many ticks: float64[rows, columns, lane]."""
        return np.zeros((-(-ticks // self.every), len(self.columns), self._n))

    def advance(self, k0: int, ticks: int, noise: np.ndarray | None, out: np.ndarray) -> None:
        """Run from tick ``k0``, a multiple of 10; ``noise``: float64[ticks, 2 + stages] standard normal numbers."""
        self._advance(k0, ticks, self._rows, noise, out)

    def _advance(self, k0: int, ticks: int, rows: np.ndarray, noise: np.ndarray | None, out: np.ndarray) -> None:
        silent = np.zeros((1, 2 + self._stages))
        _advance(
            k0, ticks, rows, self._which, silent if noise is None else noise, self._sigma_pots, self._tables,
            self._block, self._n, self._stages, *self._way, self.every, out,
        )  # fmt: skip

    def faults(self, lane: int) -> int:
        """Fault bits that stand now."""
        return int(self._block[0]["z_faults"][lane])


def aligned(layout: np.dtype[Any]) -> np.ndarray:
    """One record of zeros that begins with a line of the cache: a vector that lies across two lines takes longer."""
    memory = np.zeros(layout.itemsize + LINE, np.uint8)
    start = -memory.ctypes.data % LINE
    return memory[start : start + layout.itemsize].view(layout)


def _run(lanes: Lanes, ticks: int, seed: int | None) -> list[Run]:
    """Run a block over ``ticks`` ticks."""
    out, sensors = lanes.room(ticks), lanes.columns.index("state") - VIGV + 2
    generator = np.random.Generator(np.random.PCG64(seed or 0))
    for k0 in range(0, ticks, CHUNK):
        n = min(CHUNK, ticks - k0)
        noise = None if seed is None else generator.standard_normal((n, sensors))
        lanes.advance(k0, n, noise, out[k0 // lanes.every :])
    return [
        Run(to_border(out[:, :, j], lanes.columns), ticks * 1e-3, 0.0, "", lanes.faults(j)) for j in range(lanes.count)
    ]
