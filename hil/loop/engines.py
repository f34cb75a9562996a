"""Very many closed loops, on a GPU where there is one: what became of each engine, without its log.

Where `hil.loop.lanes` returns the whole log of each loop, this keeps the figures that a campaign judges: the largest
errors of stroke and vane angles, the time in each mode, where the engine stands at the end. They are taken on the
raster of the log while the loop runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from controller import Calibration, new_state
from controller.records import MODES, SCALAR_FIELDS, STATE, kind
from hil.loop import cuda as gpu
from hil.loop.firmware_lanes import runs_in_lanes
from hil.loop.heard_lanes import change_machine
from hil.loop.lanes import lockstep_lanes, loops_of
from hil.loop.lockstep import CHUNK, S_N_DEM, S_N_R, S_T_OIL, WARM_UP, Run, Stimulus
from hil.loop.tick import CHANGED_BY, flashed, mean_stroke
from plant import Plant, chain, places
from plant.effects import CURVES
from plant.parameters import ACTUATORS, KIND
from vaneloop.base.compiled import in_place, threads
from vaneloop.base.errors import InputError

__all__ = [
    "DEVICES", "MOST", "SHARE", "Engines", "Unfinished", "change_on_gpu", "lockstep_engines", "machines_on_gpu",
    "on_gpu", "put_on_gpu",
]  # fmt: skip

DEVICES = ("auto", "cpu", "cuda")
AT_ONCE = 128  # engines whose logs the processor has at once, for each of its cores
MOST = 1 << 17  # engines on a GPU at once: several for each of its threads; the host builds what the next ones need
SHARE = 0.8  # of the GPU's free memory
# rows of p that are 0 in an engine for the GPU: the kernel has no motor, no second actuator, no curves and no frames of
# the past
ELSEWHERE = [KIND, ACTUATORS, CURVES, places.CAN_DELAY, places.FRAME_HOLD]
DEG = 180.0 / np.pi


@dataclass(repr=False)
class Engines:
    """What became of each engine; arrays with a row an engine, in the order of the plants.

    servo_error  mm, largest abs(x_dem - x_lvdt)
    angle_error  deg, largest distance of each stage's reading from the schedule's target at the measured speed; NaN:
                 the machine lacks the stage
    stroke, angles  mm and deg, the sensors' readings at the last sample
    mode         number of the mode in `controller.records.MODES` at the last sample
    in_mode      s in each mode
    faults       fault bits that stand at the end
    ran          whether the engine was run to the end; the figures of others are zeros
    finite       whether every sample was a number; an engine that runs away has none of these figures
    on           number in ``devices`` of what ran it
    devices      names of what ran the engines
    simulated_s  s, of each engine
    wall_s       s on the wall clock, of all
    notes        what was done otherwise than asked for
    """

    servo_error: np.ndarray
    angle_error: np.ndarray
    stroke: np.ndarray
    angles: np.ndarray
    mode: np.ndarray
    in_mode: np.ndarray
    faults: np.ndarray
    ran: np.ndarray
    finite: np.ndarray
    on: np.ndarray
    devices: list[str]
    simulated_s: float
    wall_s: float = 0.0
    notes: list[str] = field(default_factory=list)


class Unfinished(InputError):
    """The GPU stopped half way; ``engines`` has what was finished before."""

    def __init__(self, text: str, engines: Engines):
        super().__init__(text)
        self.engines = engines


def lockstep_engines(
    stimulus: Stimulus | Sequence[Stimulus],
    plants: Sequence[Plant],
    *,
    calibrations: Calibration | Sequence[Calibration] | None = None,
    seed: int | None = None,
    every: int = 10,
    duration: float | None = None,
    device: str = "auto",
    at_once: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Engines:
    """Run a closed loop for each of the ``plants`` and return what became of each.

    stimulus, calibrations, seed, every, duration  as of `hil.loop.lanes.lockstep_lanes`, whose runs these are
    device    "cuda": the GPU; "cpu": the processor; "auto": the GPU, and the processor for what it cannot do, which
              ``notes`` says
    at_once   engines on the GPU at once; default: what its memory holds, `MOST` at most
    progress  called with the number of engines that are done

    Engines that do not go through lanes (`hil.loop.lanes`) run on the processor in any case, one by one. Raises
    InputError for another device, and with "cuda" where there is no GPU that can be used; `Unfinished` where it fails
    half way.
    """
    if device not in DEVICES:
        raise InputError(f"device (={device!r}) must be one of {', '.join(DEVICES)}")
    stimuli, cals, ticks = loops_of(stimulus, calibrations, len(plants), every, duration)
    work = _Work(stimuli, plants, cals, seed, every, ticks)
    out = work.out
    started = time.perf_counter()

    def done() -> None:
        if progress is not None:
            progress(int(out.ran.sum()))

    if device != "cpu":
        try:
            kernel = gpu.kernel()
            for some in work.for_gpu(kernel, at_once):
                _on_gpu(kernel, work, some)
                done()
        except gpu.unusable() as e:
            said = f"device {device!r}: {gpu.said(e)}"
            if device == "cuda" and not out.ran.any():
                raise InputError(said) from None
            if device == "cuda":
                raise Unfinished(f"{said}; {int(out.ran.sum())} of {len(plants)} engines are finished", out) from e
            out.notes.append(f"{said}; the processor runs the engines that are left")
    left = np.flatnonzero(~out.ran)
    each = AT_ONCE * threads()
    for some in (left[a : a + each] for a in range(0, len(left), each)):
        _on_processor(work, some)
        done()
    out.wall_s = time.perf_counter() - started
    return out


class _Work:
    """What is to be run, and what has become of it."""

    def __init__(
        self, stimuli: list[Stimulus], plants: Sequence[Plant], cals: list[Calibration], seed: int | None, every: int,
        ticks: int,
    ):  # fmt: skip
        self.stimuli, self.plants, self.cals, self.seed, self.every, self.ticks = (
            stimuli, plants, cals, seed, every, ticks
        )  # fmt: skip
        n, stages = len(plants), max(map(_stages, plants), default=0)
        self.out = Engines(
            np.zeros(n), np.full((n, stages), np.nan), np.zeros(n), np.full((n, stages), np.nan), np.zeros(n, int),
            np.zeros((n, len(MODES))), np.zeros(n, int), np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, int), [],
            ticks * 1e-3,
        )  # fmt: skip

    def ran_on(self, device: str, some: np.ndarray) -> None:
        """Note that engines were run to the end, and on what."""
        if device not in self.out.devices:
            self.out.devices.append(device)
        self.out.on[some], self.out.ran[some] = self.out.devices.index(device), True

    def for_gpu(self, kernel: gpu.Kernel, at_once: int | None) -> Iterator[np.ndarray]:
        """Engines that can go side by side: as many stages, tables of one size, the same targets."""
        groups: dict[Any, list[int]] = {}
        differ = {id(cal): cal for cal in self.cals}
        curves = {i: runs_in_lanes(cal) for i, cal in differ.items()}
        for i, (plant, cal) in enumerate(zip(self.plants, self.cals, strict=True)):
            if curves[id(cal)] and not any(plant.p[row, 0] for row in ELSEWHERE):
                key = (_stages(plant), cal.table.shape, cal.angles.shape, id(plant.schedules))
                groups.setdefault(key, []).append(i)
        for of in groups.values():
            most = at_once or kernel.room(8 * (gpu.NUMBERS + 2 + _stages(self.plants[of[0]])), SHARE, MOST)
            for a in range(0, len(of), most):
                yield np.array(of[a : a + most])


def _stages(plant: Plant) -> int:
    """How many vane stages a machine has."""
    return len(plant.vanes)


@in_place
def _at_rest(s: np.ndarray, p: np.ndarray, strokes: np.ndarray, n_engine: np.ndarray, t_oil: np.ndarray) -> None:
    """Put every engine to rest at its stroke (m), speed (%) and temperature (degC)."""
    for j in range(s.shape[1]):
        chain.rest(s, p, j, strokes[j], n_engine[j], t_oil[j])


def _numbers(of: list[Any]) -> tuple[np.ndarray, list[Any]]:
    """Which of the objects that differ each one is, int32, and those."""
    known: dict[int, int] = {}
    which = np.array([known.setdefault(id(a), len(known)) for a in of], np.int32)
    return which, [of[int(i)] for i in np.unique(which, return_index=True)[1]]


def _flashed(plants: Sequence[Plant], cals: Sequence[Calibration], p: np.ndarray) -> list[Calibration]:
    """Each engine's calibration as it is flashed, its parameters p[:, engine]; the same object where it is the same."""
    known: dict[Any, Calibration] = {}
    out = []
    for j, (plant, cal) in enumerate(zip(plants, cals, strict=True)):
        key = (id(cal), *p[list(CHANGED_BY), j])
        if key not in known:
            known[key] = flashed(cal, replace(plant, p=p[:, j : j + 1].copy()))
        out.append(known[key])
    return out


def _on_gpu(kernel: gpu.Kernel, work: _Work, some: np.ndarray) -> None:
    """Run engines on the GPU; what they come to is written down when all of them are at the end."""
    out = work.out
    plants = [work.plants[i] for i in some]
    stages = _stages(plants[0])
    last = (work.ticks - 1) // work.every * work.every
    machines, hears, notes = put_on_gpu(
        kernel, plants, [work.cals[i] for i in some], [work.stimuli[i] for i in some], work.seed, work.every, last
    )
    silent = kernel.cuda.to_device(np.zeros((1, 2 + stages)))
    kernel(-WARM_UP, WARM_UP, silent, machines, hears, notes)
    generator = np.random.Generator(np.random.PCG64(work.seed or 0))
    for k0 in range(0, work.ticks, CHUNK):
        ticks, noise = min(CHUNK, work.ticks - k0), silent
        if work.seed is not None:
            noise = kernel.cuda.to_device(generator.standard_normal((ticks, 2 + stages)))
        kernel(k0, ticks, noise, machines, hears, notes)
    z, found = machines.z.copy_to_host(), notes.found.copy_to_host()
    out.servo_error[some], out.stroke[some] = 1e3 * found[gpu.SERVO], 1e3 * found[gpu.LAST_STROKE]
    out.angle_error[some, :stages] = DEG * found[gpu.ANGLE_ERROR : gpu.ANGLE_ERROR + stages].T
    out.angles[some, :stages] = DEG * found[gpu.ANGLE_LAST : gpu.ANGLE_LAST + stages].T
    out.mode[some], out.faults[some] = found[gpu.LAST_MODE], z[STATE.index("faults")]
    out.in_mode[some] = found[gpu.SAMPLES : gpu.SAMPLES + len(MODES)].T * work.every * 1e-3
    out.finite[some] = found[gpu.LOST] == 0.0
    work.ran_on(kernel.name, some)


def put_on_gpu(
    kernel: gpu.Kernel,
    plants: list[Plant],
    cals: list[Calibration],
    stimuli: list[Stimulus],
    seed: int | None,
    every: int,
    last: int,
) -> tuple[gpu.Machines, gpu.Frames, gpu.Figures]:
    """Engines at rest as arrays on the GPU, with what they hear and what is to be noted of them."""
    n = len(plants)
    which, stimuli = _numbers(stimuli)
    first = np.array([s.rows[0] for s in stimuli])[which]
    n_r = np.where(np.isfinite(first[:, S_N_R]), first[:, S_N_R], first[:, S_N_DEM])
    machines = machines_on_gpu(kernel, plants, cals, first[:, S_N_DEM], n_r, first[:, S_T_OIL], seed is not None)
    speed, target = plants[0].schedules.arrays()
    rows, numbers, targets, found = (
        on_gpu(kernel, a)
        for a in (np.array([s.rows for s in stimuli]), which, np.vstack([speed, target.T]), np.zeros((gpu.FOUND, n)))
    )
    return machines, gpu.Frames(rows, numbers), gpu.Figures(every, last, targets, found)


def machines_on_gpu(
    kernel: gpu.Kernel,
    plants: Sequence[Plant],
    cals: Sequence[Calibration],
    n_engine: np.ndarray,
    n_r: np.ndarray,
    t_oil: np.ndarray,
    noisy: bool,
) -> gpu.Machines:
    """Engines at rest on the GPU, as `hil.loop.tick.new_loop` has them: each at its speed (%) and oil temperature
    (degC), its stroke where the mean curve has it at the measured speed ``n_r`` (%).
    """
    n = len(plants)
    p = np.ascontiguousarray(np.array([plant.p[: gpu.P_ROWS, 0] for plant in plants]).T)
    own, scalars, tables, angles, flashes = _calibrations(kernel, plants, cals, p)
    sigma = np.array([plant.sigma for plant in plants]).T if noisy else np.zeros((len(plants[0].sigma), n))
    strokes = np.array([mean_stroke(cal.table, v) for cal, v in zip(flashes, n_r, strict=True)])
    s = np.zeros((chain.N_STATE, n))
    _at_rest(s, p, strokes, np.ascontiguousarray(n_engine), np.ascontiguousarray(t_oil))
    z = np.repeat(new_state()[: gpu.Z_ROWS, None], n, axis=1)
    sigma, s, p, z = (on_gpu(kernel, a) for a in (sigma, s[: gpu.S_ROWS], p, z))
    return gpu.Machines(sigma, own, scalars, tables, angles, s, p, z)


def change_on_gpu(
    kernel: gpu.Kernel,
    machines: gpu.Machines,
    plants: Sequence[Plant],
    cals: Sequence[Calibration],
    values: Sequence[Mapping[int, float]],
) -> gpu.Machines:
    """Engines on the GPU after rows of each one's parameters, the same of all, have got other values (SI)."""
    s, p, z = (np.ascontiguousarray(a.copy_to_host()) for a in (machines.s, machines.p, machines.z))
    rows = np.array(list(values[0]), np.int64)
    _change(s, p, z[STATE.index("i_cmd")], rows, np.array([[of[r] for of in values] for r in rows]))
    own, scalars, tables, angles, _ = _calibrations(kernel, plants, cals, p)
    s, p = on_gpu(kernel, s), on_gpu(kernel, p)
    return machines._replace(own=own, scalars=scalars, tables=tables, angles=angles, s=s, p=p)


@in_place
def _change(s: np.ndarray, p: np.ndarray, i_cmd: np.ndarray, rows: np.ndarray, values: np.ndarray) -> None:
    for j in range(s.shape[1]):
        change_machine(s, p, j, i_cmd[j], rows, values[:, j])


def _calibrations(
    kernel: gpu.Kernel, plants: Sequence[Plant], cals: Sequence[Calibration], p: np.ndarray
) -> tuple[Any, Any, Any, Any, list[Calibration]]:
    """What engines have flashed, as the GPU has it (own, scalars, tables, angles of `hil.loop.cuda.Machines`), and the
    calibration of each engine.
    """
    flashes = _flashed(plants, cals, p)
    own, differ = _numbers(flashes)
    scalars: Any = np.array([cal.k for cal in differ]).view(kind(SCALAR_FIELDS))[:, 0]
    if len(differ) == 1:
        scalars = gpu.Scalars(
            *(tuple(v) if f.each else v for f, v in zip(SCALAR_FIELDS, scalars[0].tolist(), strict=True))
        )
    else:
        scalars = on_gpu(kernel, scalars)
    tables, angles = (on_gpu(kernel, np.array([getattr(cal, name) for cal in differ])) for name in ("table", "angles"))
    return on_gpu(kernel, own), scalars, tables, angles, flashes


def on_gpu(kernel: gpu.Kernel, a: np.ndarray) -> Any:
    """An array on the GPU."""
    return kernel.cuda.to_device(np.ascontiguousarray(a))


def _on_processor(work: _Work, some: np.ndarray) -> None:
    """Run engines in lanes of the processor."""

    def runs_of(those: list[int]) -> list[Run | None]:
        try:
            return list(
                lockstep_lanes(
                    [work.stimuli[i] for i in those], [work.plants[i] for i in those],
                    calibrations=[work.cals[i] for i in those], seed=work.seed, every=work.every,
                    duration=work.ticks * 1e-3,
                )
            )  # fmt: skip
        except InputError:  # one of them runs away
            return [None] if len(those) == 1 else [r for i in those for r in runs_of([i])]

    out = work.out
    for i, run in zip(some, runs_of(list(some)), strict=True):
        out.finite[i] = run is not None
        if run is None:
            continue
        a, plant = run.columns, work.plants[i]
        out.servo_error[i], out.stroke[i] = np.abs(a["x_dem"] - a["x_lvdt"]).max(), a["x_lvdt"][-1]
        targets = plant.schedules.targets(a["n_r"]) * DEG
        for q, vane in enumerate(plant.vanes):
            out.angle_error[i, q], out.angles[i, q] = np.abs(a[vane] - targets[:, q]).max(), a[vane][-1]
        out.mode[i], out.faults[i] = a["state"][-1], run.faults
        out.in_mode[i] = np.bincount(a["state"].astype(int), minlength=len(MODES)) * work.every * 1e-3
    work.ran_on("cpu", some)
