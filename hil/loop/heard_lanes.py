"""Closed loops side by side from power-on, under what a controller hears tick by tick: frames that come late, are
refused or carry wrong values, a supply and machines that change.

A lane is what `hil.loop.node` runs on a bus, controller, plant and the ECU's engine, with the same functions; the bus
is not there. Who has it says what comes of it in rows (`hil.inject.heard`), the same for all lanes of a block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from controller import Calibration
from controller.records import SLOW
from hil.bus.frames import raw_speed, speed_of
from hil.loop import firmware_lanes
from hil.loop.lanes import BLOCK, EIGHT, aligned, place_machine
from hil.loop.tick import Loop, flashed, new_loop
from plant import Plant, chain, chain_lanes, places
from plant.chain_lanes import W
from plant.lanes import wide_vectors
from plant.parameters import derive_lane
from vaneloop.base.compiled import compiled, in_place, in_place_free, inlined

__all__ = [
    "COLUMNS", "H_DEMAND", "H_FRESH", "H_N_DEM", "H_N_R", "H_P_S", "H_REJECTED", "H_REQUEST", "H_SOURCE", "H_T_OIL",
    "N_HEARD", "OIL", "HeardLanes", "Rows", "believed", "change_machine", "depth", "hear_row", "noise_of", "power_on",
    "sample", "speed_in", "speed_sent", "stretch_of", "stretches",
]  # fmt: skip

# columns of a row
(
    H_FRESH,  # 1: a good frame came
    H_REJECTED,  # frames refused
    H_N_DEM,  # %, in the good frame
    H_REQUEST,  # mode request in it
    H_N_R,  # %, speed in it; with a source, what that frame's speed is changed by, bit by bit
    H_SOURCE,  # number of the ECU's frame whose measured speed came; -1: H_N_R is the speed
    H_DEMAND,  # %, the ECU's own
    H_P_S,  # Pa
    H_T_OIL,  # degC
    N_HEARD,
) = range(10)
COLUMNS = 5  # of a sample before those of the vanes: x_dem, x_meas (m), i_cmd (A), n_dem, n_r_raw (%)
OIL = 40.0  # degC, at power-on


@inlined
def speed_sent(n_r: float, sigma: float, noise: float) -> float:
    """The speed (%) in the ECU's frame: the engine's, as measured, in the steps of the frame; ``noise``: standard
    normal.
    """
    return speed_of(raw_speed(n_r + sigma * noise))


@inlined
def speed_in(now: np.ndarray, sent: float) -> float:
    """The speed (%) in the frame that comes with a row; ``sent``: of the ECU's frame from which the row has it."""
    if now[H_SOURCE] < 0.0:
        return now[H_N_R]
    if now[H_N_R] != 0.0:
        return speed_of(raw_speed(sent) ^ raw_speed(now[H_N_R]))
    return sent


@inlined
def believed(now: np.ndarray, speed: float, low: float, high: float) -> bool:
    """Whether the machine goes on at the speed (%) of a frame: its values are within the firmware's range (%)."""
    return low <= now[H_N_DEM] <= high and low <= speed <= high and now[H_REQUEST] <= 1.0


@in_place
def change_machine(s: np.ndarray, p: np.ndarray, j: int, i_cmd: float, rows: np.ndarray, values: np.ndarray) -> None:
    """Give rows of a machine's parameters other ``values`` (SI) between two ticks; ``i_cmd``: A, of the last one."""
    chain.wake(s, p, j, i_cmd)
    for q in range(rows.shape[0]):
        p[rows[q], j] = values[q]
    derive_lane(p, j, chain.TICK / chain.SUBSTEPS, chain.TICK)


@compiled
def _take_back(block: np.ndarray, j: int, s: np.ndarray, stages: int) -> None:
    chain_lanes.take_back(block[0], j, s, stages)


@in_place_free
def _advance(
    k0: int,
    ticks: int,
    rows: np.ndarray,
    noise: np.ndarray,
    speed_noise: np.ndarray,
    sent: np.ndarray,
    tables: np.ndarray,
    block: np.ndarray,
    n: int,
    stages: int,
    drive_way: int,
    vane_effects: bool,
    out: np.ndarray,
) -> None:
    """Advance ``n`` lanes, a multiple of 8, by ``ticks`` ticks from tick ``k0``.

    rows         float64[:, N_HEARD], one a tick
    noise        float64[:, 2 + stages] standard normal numbers, one row a tick; speed_noise: one number a frame
    sent         float64[frame, lane] %, measured speeds that the ECU has sent so far
    out          float64[ticks, COLUMNS + stages + 2, lane] in SI, after each tick; the last two: mode, faults
    """
    wide_vectors()
    b = block[0]
    n = min(n // EIGHT * EIGHT, W)
    for i in range(ticks):
        k = k0 + i
        now, phase = rows[k], k % SLOW
        came = now[H_FRESH] > 0.5
        if phase == 0:
            frame = k // SLOW
            for j in range(n):
                sent[frame, j] = speed_sent(b.n_r[j], b.sigma_speed[j], speed_noise[frame])
                b.n_dem[j] = now[H_DEMAND]
        if came:
            source = max(int(now[H_SOURCE]), 0)
            for j in range(n):
                speed = speed_in(now, sent[source, j])
                b.in_n_dem[j], b.in_n_r[j], b.in_mode_request[j] = now[H_N_DEM], speed, now[H_REQUEST]
                if believed(now, speed, b.k_demand_low[j], b.k_demand_high[j]):
                    b.heard[j] = speed
        if i == 0 or came or now[H_P_S] != rows[k - 1, H_P_S] or now[H_T_OIL] != rows[k - 1, H_T_OIL]:
            for j in range(n):
                b.p_s[j], b.t_oil[j] = now[H_P_S], now[H_T_OIL]
            chain_lanes.feed(b, n)
        chain_lanes.sample_lvdt(b, n, drive_way, noise[k, 0])
        if phase == 0 or came or now[H_REJECTED] > 0.0:
            for j in range(n):
                b.in_demand_fresh[j], b.in_demand_rejected[j] = now[H_FRESH], now[H_REJECTED]
        if phase == 0:
            firmware_lanes.on_frame(b, n, tables)
        elif came or now[H_REJECTED] > 0.0:
            firmware_lanes.on_late_frame(b, n, phase)
        else:
            firmware_lanes.between_frames(b, n, phase)
        chain_lanes.move(b, n, stages, drive_way, vane_effects, (k + 1) * chain.TICK)
        row = out[i]
        for j in range(n):
            row[0, j], row[1, j], row[2, j] = b.z_x_dem[j], b.z_x_meas[j], b.z_i_cmd[j]
            row[3, j], row[4, j] = b.z_n_dem[j], b.z_n_r_raw[j]
            row[COLUMNS + stages, j], row[COLUMNS + stages + 1, j] = b.z_mode[j], b.z_faults[j]
        for q in range(stages):
            for j in range(n):
                row[COLUMNS + q, j] = b.pot[q, j]


def power_on(plant: Plant, calibration: Calibration, n_r: float) -> Loop:
    """The loop as `hil.loop.node.Node` has it before its first tick."""
    return new_loop(plant, calibration, n_engine=n_r, n_r=n_r, t_oil=OIL, noisy=True)


def noise_of(seed: int, ticks: int, stages: int) -> tuple[np.ndarray, np.ndarray]:
    """Standard normal numbers that the nodes of a bus have with ``seed`` and ``seed + 1``: of the controller's sensors,
    float64[ticks, 2 + stages], and of the ECU's measured speed, one a frame.
    """
    sensors, speed = (np.random.Generator(np.random.PCG64(seed + q)) for q in range(2))
    return sensors.standard_normal((ticks, 2 + stages)), speed.standard_normal(-(-ticks // SLOW))


class Rows(NamedTuple):
    """What engines on a GPU hear (`hil.loop.cuda.Watched`): rows of a scenario.

    rows     float64[ticks, N_HEARD]
    stretch  int64[ticks] from each tick on: ticks in which nothing comes and the supply stays, up to the ECU's next one
    noise    float64[frames] standard normal numbers of the ECU's measured speed
    sent     float64[depth, engine] %, measured speeds that the ECU has sent last: frame n in row n % depth
    speed    float64[engine] %, of the last frame that was believed
    """

    rows: Any
    stretch: Any
    noise: Any
    sent: Any
    speed: Any


def stretches(rows: np.ndarray) -> np.ndarray:
    """`Rows.stretch`: how many ticks from each on have nothing new after their first one."""
    new = (rows[:, H_FRESH] > 0.5) | (rows[:, H_REJECTED] > 0.0)
    new[1:] |= (rows[1:, [H_P_S, H_T_OIL]] != rows[:-1, [H_P_S, H_T_OIL]]).any(axis=1)
    new[::SLOW] = True
    begins = np.append(np.flatnonzero(new), len(rows))
    ticks = np.arange(len(rows))
    return begins[np.searchsorted(begins, ticks, side="right")] - ticks


def depth(rows: np.ndarray) -> int:
    """How many of the ECU's last frames a controller may still get."""
    came = np.flatnonzero((rows[:, H_FRESH] > 0.5) & (rows[:, H_SOURCE] >= 0.0))
    return int(np.max(came // SLOW - rows[came, H_SOURCE], initial=0)) + 1


def stretch_of(hears: Rows, k: int) -> int:
    """`hil.loop.cuda.Watched.stretch` of rows."""
    return hears.stretch[k]


def hear_row(
    hears: Rows, k: int, j: int, inputs: Any, k_of: Any, n_r: float, sigma: float, noise: float
) -> tuple[float, float, float, float]:
    """`hil.loop.cuda.Watched.hear` of rows."""
    now, kept, frame = hears.rows[k], hears.sent.shape[0], k // SLOW
    if k % SLOW == 0:
        hears.sent[frame % kept, j] = speed_sent(n_r, sigma, hears.noise[frame])
    if now[H_FRESH] > 0.5:
        speed = speed_in(now, hears.sent[max(int(now[H_SOURCE]), 0) % kept, j])
        inputs.n_dem, inputs.n_r, inputs.mode_request = now[H_N_DEM], speed, now[H_REQUEST]
        if believed(now, speed, k_of.demand_low, k_of.demand_high):
            hears.speed[j] = speed
    inputs.demand_fresh, inputs.demand_rejected = now[H_FRESH], now[H_REJECTED]
    return now[H_DEMAND], hears.speed[j], now[H_P_S], now[H_T_OIL]


@inlined
def sample(z: Any, column: int) -> float:
    """What the firmware's state ``z`` gives for a column of a sample before those of the vanes."""
    if column == 0:
        return z.x_dem
    if column == 1:
        return z.x_meas
    if column == 2:
        return z.i_cmd
    if column == 3:
        return z.n_dem
    return z.n_r_raw


class HeardLanes:
    """Loops side by side in one block, at power-on. All have as many stages and tables of one size, and go the same way
    through the block (`plant.chain_lanes.way`), also after a change.

    loops         `power_on`, `W` at most; those that fill the block up to whole vectors are the last one again
    plants, cals  their machines and calibrations as built
    rows          float64[ticks, N_HEARD]
    noise         `noise_of`
    """

    def __init__(
        self,
        loops: Sequence[Loop],
        plants: Sequence[Plant],
        cals: Sequence[Calibration],
        rows: np.ndarray,
        noise: tuple[np.ndarray, np.ndarray],
    ):
        self.count, self.k = len(loops), 0
        self.loops, self._plants, self._cals = list(loops), plants, cals
        self._n = -(-len(loops) // EIGHT) * EIGHT
        self._stages, self._rows, self._noise = len(loops[0].angles), rows, noise
        self._block = aligned(BLOCK)
        for j, at in enumerate(self._lanes()):
            loop = loops[at]
            firmware_lanes.place(self._block[0], j, loop)
            self._block[0]["sigma_lvdt"][j], self._block[0]["sigma_speed"][j] = loop.sigma[0], loop.sigma[-1]
            self._block[0]["heard"][j] = loop.s[places.N_R, 0]
        self._sent = np.zeros((len(noise[1]), self._n))
        self._place()

    def _lanes(self) -> list[int]:
        """The loop in each lane."""
        return [min(j, self.count - 1) for j in range(self._n)]

    def _place(self) -> None:
        """Put all machines into the block."""
        for j, at in enumerate(self._lanes()):
            place_machine(self._block, j, self.loops[at].p, self.loops[at].s, self._stages)
        (way,) = {chain_lanes.way(loop.p) for loop in self.loops}
        assert way is not None
        self._way = way
        self._tables = np.array([self.loops[at].calibration.table for at in self._lanes()])

    def room(self, ticks: int) -> np.ndarray:
        """Return memory for what `advance` writes in so many ticks."""
        return np.zeros((ticks, COLUMNS + self._stages + 2, self._n))

    def advance(self, ticks: int, out: np.ndarray) -> None:
        """Run so many ticks more; ``out``: `room`."""
        _advance(
            self.k, ticks, self._rows, *self._noise, self._sent, self._tables, self._block, self._n, self._stages,
            *self._way, out,
        )  # fmt: skip
        self.k += ticks

    def change(self, values: Sequence[Mapping[int, float]]) -> None:
        """Give rows of each machine's parameters other values (SI) before the next tick."""
        for j, (loop, new) in enumerate(zip(self.loops, values, strict=True)):
            _take_back(self._block, j, loop.s, self._stages)
            i_cmd = float(self._block[0]["z_i_cmd"][j])
            change_machine(loop.s, loop.p, 0, i_cmd, np.array(list(new), np.int64), np.array(list(new.values()), float))
            cal = flashed(self._cals[j], replace(self._plants[j], p=loop.p))
            self.loops[j] = loop._replace(calibration=cal)
        self._place()
        for j, at in enumerate(self._lanes()):
            firmware_lanes.flash(self._block[0], j, self.loops[at].calibration)
