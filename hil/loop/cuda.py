"""The closed loop as a kernel for a GPU: a thread is an engine with its controller, plant and sensors.

numba-cuda compiles the kernel from the same Python functions that the processor runs: `controller.firmware.tick`,
`plant.chain` and all that they call. Products and sums are not fused into one rounding, so firmware and actuator have
the same bits as on the processor; sines and arctangents, which only the vane angles need, agree to rounding.

Where numba's simulator stands in for a GPU (NUMBA_ENABLE_CUDASIM=1), Python interprets the same functions.
"""

from __future__ import annotations

import contextlib
import dis
import importlib
import math
from collections import namedtuple
from collections.abc import Iterator
from functools import cache, partial
from types import FunctionType, ModuleType
from typing import Any, NamedTuple
from unittest.mock import patch

import numba
import numpy as np

from controller.firmware import tick
from controller.records import (
    INPUT_FIELDS,
    MODES,
    SCALAR_FIELDS,
    SLOW,
    STATE,
    STATE_FIELDS,
    as_inputs,
    as_outputs,
    as_scalars,
    as_state,
    kind,
)
from controller.schedule import look_up
from controller.strategies import filter_pots, inverse_step, learn
from hil.loop.lockstep import S_FRESH, S_MODE_REQUEST, S_N_DEM, S_N_R, S_P_S, S_REJECTED, S_T_OIL
from plant import chain, curve, unison
from plant.chain import SUBSTEPS, TICK, drive_step, rotor_step, sample_lvdt, vane_step
from plant.effects import CURVES
from plant.places import N_R, POT, X
from vaneloop.base.errors import InputError
from vaneloop.base.extras import needs
from vaneloop.base.vanes import MOST

__all__ = [
    "ANGLE_ERROR",
    "ANGLE_LAST",
    "FIGURES",
    "FOUND",
    "LAST_MODE",
    "LAST_STROKE",
    "LOST",
    "NUMBERS",
    "P_ROWS",
    "ROWS",
    "SAMPLES",
    "SERVO",
    "S_ROWS",
    "Z_ROWS",
    "Figures",
    "Frames",
    "Kernel",
    "Machines",
    "Scalars",
    "Watched",
    "check",
    "kernel",
    "said",
    "unusable",
]  # fmt: skip

# what a thread finds out about its engine: largest error of the stroke (m), number of samples that are no
# number, mode and stroke (m) at the last sample, samples in each mode; of each stage the largest error of
# its angle and the angle at the last sample (rad)
SERVO, LOST, LAST_MODE, LAST_STROKE, SAMPLES = range(5)
ANGLE_ERROR = SAMPLES + len(MODES)
ANGLE_LAST = ANGLE_ERROR + MOST
FOUND = ANGLE_LAST + MOST
# rows of the firmware's state that the strategies of curves have; of the plant's state and parameters, without curves
Z_ROWS, S_ROWS, P_ROWS = STATE.index("speed"), curve.S_CURRENT + 1, CURVES + 1
ROWS = Z_ROWS + S_ROWS + P_ROWS
NUMBERS = ROWS + FOUND + 1  # of an engine, beside the noise of its sensors
THREADS = 256  # of a block: all that the registers of a multiprocessor of an H100 or H200 allow
NOTHING_TO_COMPILE = "NVIDIA's compiler is missing: pip install 'numba-cuda[cu13]'"

cuda: Any = None  # numba.cuda, in the kernel's own copy of these names
_Inputs, _State, _number = kind(INPUT_FIELDS), kind(STATE_FIELDS), numba.float64


_named: Any = namedtuple  # mypy wants its names spelled out
Scalars: Any = _named("Scalars", [f.name for f in SCALAR_FIELDS])


class _Calibration(NamedTuple):
    """What `tick` takes of a calibration: scalars (a record), stroke table, angle table."""

    k: Any
    table: Any
    angles: Any


def _the_only(scalars: Any, c: int) -> Any:
    """The scalars of the one calibration that all engines have: arguments of the kernel, in no memory."""
    return scalars


def _own(scalars: Any, c: int) -> Any:
    """The scalars of an engine's own calibration."""
    return scalars[c]


def _mover(put: bool) -> Any:
    """Function (rows, lane, record) that fills the firmware's state from ``rows``; ``put``: the rows from the state."""
    lines, row = [], 0
    for f in STATE_FIELDS:
        for own in [f"v.{f.name}[{q}]" for q in range(len(f.each))] or [f"v.{f.name}"]:
            if row < Z_ROWS:
                lines.append(f"    z[{row}, j] = {own}\n" if put else f"    {own} = z[{row}, j]\n")
            row += 1
    space: dict[str, Any] = {}
    exec(f"def f(z, j, v):\n{''.join(lines)}", space)  # noqa: S102
    return space["f"]


_take, _put = _mover(False), _mover(True)


def _same(row: Any) -> Any:
    """A record as a record."""
    return row


def _nothing(*_: Any) -> None:
    """What only strategies inverse and adaptive, curves, motors and second actuators need: these engines have none."""


def _still(s: Any, p: Any, j: int, k: int, theta: float) -> tuple[float, float]:
    """What a second actuator makes of a ring; these engines have none."""
    return theta, 0.0


def _zero(s: Any, p: Any, j: int, site: int) -> float:
    """What the curves of a machine without curves give."""
    return 0.0


def _nearest(libdevice: Any) -> Any:
    """Function that rounds to the nearest whole number, halves to the even one."""

    def nearest(v: float) -> float:
        return libdevice.rint(v)

    return nearest


class Watched(NamedTuple):
    """What a loop on a GPU hears and what is noted of it: functions with ``hears`` or ``notes`` before all else, which
    are tuples of arrays on the GPU.

    stretch  (hears, k) -> ticks from tick k on, 10 at most, in which nothing new is heard
    hear     (hears, k, j, inputs, k_of, n_r, sigma, noise) -> n_dem (%), n_r (%) at which the machine runs, p_s (Pa),
             t_oil (degC), at the beginning of such a stretch; puts what comes into the firmware's inputs.
             ``n_r``: %, of the engine; ``sigma``, ``noise``: of its measurement
    tick     (notes, k, j, state, inputs): notes what the firmware did at tick k
    before, after  (notes, k, j, s, sigma, noise, m, n_r): note where the vanes are before tick k moves them, and after
    """

    stretch: Any
    hear: Any
    tick: Any
    before: Any = _nothing
    after: Any = _nothing


class Machines(NamedTuple):
    """Engines as arrays on the GPU.

    sigma     float64[2 + stages, engine], of the sensors
    own       which calibration each engine has: ``scalars`` (records, or `Scalars` of the only one),
              float64[:, 4, points] ``tables``, float64[:, 1 + stages, points] ``angles``
    s, p, z   rows of the plant's state and parameters and of the firmware's state, float64[row, engine]
    """

    sigma: Any
    own: Any
    scalars: Any
    tables: Any
    angles: Any
    s: Any
    p: Any
    z: Any


class Frames(NamedTuple):
    """What engines hear of a `hil.loop.lockstep.Stimulus`.

    stimuli, which  float64[:, frames, N_STIMULUS], and which of them each engine has
    """

    stimuli: Any
    which: Any


class Figures(NamedTuple):
    """What is noted of engines whose figures are asked for.

    every    ticks between two samples that count, from tick 0 on; ``last``: tick of the last one
    targets  float64[1 + stages, points] speed (%) and each stage's target (rad) at it
    found    float64[FOUND, engine]
    """

    every: int
    last: int
    targets: Any
    found: Any


def _whole_frame(hears: Frames, k: int) -> int:
    return SLOW


def _hear_frame(
    hears: Frames, k: int, j: int, inputs: Any, k_of: Any, n_r: float, sigma: float, noise: float
) -> tuple[float, float, float, float]:
    rows = hears.stimuli[hears.which[j]]
    frame = min(max(k // SLOW, 0), rows.shape[0] - 1)
    n_dem, heard = rows[frame, S_N_DEM], rows[frame, S_N_R]
    if heard != heard:
        heard = n_r + sigma * noise
    inputs.n_dem, inputs.n_r, inputs.mode_request = n_dem, heard, rows[frame, S_MODE_REQUEST]
    inputs.demand_fresh, inputs.demand_rejected = rows[frame, S_FRESH], rows[frame, S_REJECTED]
    return n_dem, heard, rows[frame, S_P_S], rows[frame, S_T_OIL]


def _figures_of_tick(notes: Figures, k: int, j: int, state: Any, inputs: Any) -> None:
    if k < 0 or k % notes.every != 0:
        return
    found = notes.found
    error = abs(state.x_dem - inputs.x_lvdt)
    found[SERVO, j] = max(found[SERVO, j], error)
    found[SAMPLES + int(state.mode), j] += 1.0
    if not error < np.inf:
        found[LOST, j] += 1.0
    if k == notes.last:
        found[LAST_MODE, j], found[LAST_STROKE, j] = state.mode, inputs.x_lvdt


def _figures_of_vanes(notes: Figures, k: int, j: int, s: Any, sigma: Any, noise: Any, m: int, n_r: float) -> None:
    if k < 0 or k % notes.every != 0:
        return
    found = notes.found
    for q in range(notes.targets.shape[0] - 1):
        angle = s[POT + q, j] + sigma[1 + q, j] * noise[m, 1 + q]
        error = abs(angle - look_up(0, 1 + q, notes.targets, n_r))
        found[ANGLE_ERROR + q, j] = max(found[ANGLE_ERROR + q, j], error)
        if not error < np.inf:
            found[LOST, j] += 1.0
        if k == notes.last:
            found[ANGLE_LAST + q, j] = angle


FIGURES = Watched(_whole_frame, _hear_frame, _figures_of_tick, before=_figures_of_vanes)
_stretch, _hear, _tick, _before, _after = FIGURES  # in the kernel's own copy of these names those of a `Watched`


def _run(
    k0: int, ticks: int, noise: Any, sigma: Any, own: Any, scalars: Any, tables: Any, angles: Any, s: Any, p: Any,
    z: Any, hears: Any, notes: Any,
) -> None:  # fmt: skip
    """Advance each engine by ``ticks`` ticks from tick ``k0``: the loop of `hil.loop.lockstep` and `hil.loop.node`.

    noise   float64[ticks or 1, 2 + stages] standard normal numbers, the same for every engine
    sigma to z  as of `Machines`
    hears, notes  as of `Watched`
    """
    j = cuda.grid(1)
    if j >= s.shape[1]:
        return
    inputs_here, state_here = cuda.local.array(1, _Inputs), cuda.local.array(1, _State)
    strokes = cuda.local.array(SLOW, _number)
    inputs, state = inputs_here[0], state_here[0]
    _take(z, j, state)
    c = own[j]
    cal: Any = _Calibration(_own(scalars, c), tables[c], angles[c])
    noisy, speed = noise.shape[0] > 1, sigma.shape[0] - 1
    sigma_lvdt = sigma[0, j]
    inputs.pause = 0.0
    first = 0
    while first < ticks:
        k = k0 + first
        many = min(_stretch(hears, k), ticks - first)
        n_dem, n_r, p_s, t_oil = _hear(
            hears, k, j, inputs, cal.k, s[N_R, j], sigma[speed, j], noise[first if noisy else 0, speed]
        )
        for i in range(many):
            m = first + i if noisy else 0
            inputs.x_lvdt = sample_lvdt(s, p, j, sigma_lvdt * noise[m, 0], t_oil)
            tick(inputs, state, cal)
            _tick(notes, k + i, j, state, inputs)
            drive_step(s, p, j, state.i_cmd, n_r, p_s, t_oil, TICK, SUBSTEPS)
            strokes[i] = s[X, j]
            inputs.demand_fresh = inputs.demand_rejected = 0.0
        # what turns behind the piston, and the engine, push back on neither: 10 ms of theirs at a stretch find their
        # parameters near at hand
        for i in range(many):
            m = first + i if noisy else 0
            _before(notes, k + i, j, s, sigma, noise, m, n_r)
            s[X, j] = strokes[i]
            rotor_step(s, p, j, n_dem, TICK)
            vane_step(s, p, j, n_r, t_oil, (k + i + 1) * TICK)
            _after(notes, k + i, j, s, sigma, noise, m, n_r)
        first += many
    _put(z, j, state)


class _Copies:
    """Functions of this program as functions of a GPU: copies, with all that they call.

    here     numba.cuda
    instead  what stands in the place of a function that the processor has
    """

    def __init__(self, here: Any, instead: dict[Any, Any], interpreted: bool):
        self._cuda, self._interpreted = here, interpreted
        self._made: dict[int, Any] = {id(was): self.device(new) for was, new in instead.items()}
        self._keep = list(instead)

    def device(self, function: Any) -> Any:
        """A Python function as one of the GPU's."""
        if self._interpreted or not isinstance(function, FunctionType):
            return function
        return self._cuda.jit(device=True, forceinline=True, **_jit_options(False))(function)

    def of(self, value: Any, attributes: set[str]) -> Any:
        """What stands for ``value``; of a module, for those of its ``attributes`` that are used."""
        if id(value) in self._made:
            return self._made[id(value)]
        if isinstance(value, ModuleType):
            members = {a: getattr(value, a) for a in attributes}
            copies = {a: self.of(member, set()) for a, member in members.items()}
            if all(copies[a] is member for a, member in members.items()):
                return value
            copied = ModuleType(value.__name__)
            copied.__dict__.update(copies)
            return copied
        if (python := getattr(value, "py_func", None)) is None:
            return value
        self._made[id(value)] = made = self.device(self.copy(python))
        self._keep.append(value)
        return made

    def copy(self, python: Any, **more: Any) -> Any:
        """A Python function that calls the copies; ``more``: names that it has besides."""
        used: dict[str, set[str]] = {}
        of = ""  # the global name that was loaded last
        for now in dis.get_instructions(python):
            if now.opname == "LOAD_GLOBAL":
                used.setdefault(now.argval, set())
            elif of and now.opname in ("LOAD_ATTR", "LOAD_METHOD"):
                used[of].add(now.argval)
            of = now.argval if now.opname == "LOAD_GLOBAL" else ""
        space = {n: self.of(python.__globals__[n], used[n]) for n in used if n in python.__globals__ and n not in more}
        copied = FunctionType(python.__code__, {**space, **more}, python.__name__, python.__defaults__)
        copied.__kwdefaults__, copied.__qualname__ = python.__kwdefaults__, python.__qualname__
        copied.__module__ = python.__module__
        return copied


def _jit_options(simulated: bool) -> dict[str, Any]:
    """Options of numba-cuda: no compiling at link time, which would fuse products and sums (`_unfused`)."""
    return {} if simulated else {"lto": False}


class Kernel:
    """`_run` on this computer's GPU, with what its loops hear and what is noted of them."""

    def __init__(self, watched: Watched = FIGURES) -> None:
        here = check()
        self.cuda, self.simulated = here, bool(here.config.ENABLE_CUDASIM)
        self.name = "numba's simulator" if self.simulated else here.get_current_device().name
        if isinstance(self.name, bytes):
            self.name = self.name.decode()
        instead: dict[Any, Any] = dict.fromkeys((as_inputs, as_outputs, as_scalars, as_state), _same)
        absent = (inverse_step, learn, filter_pots, curve.acts, chain._motor_step, chain._joined_step)
        instead |= dict.fromkeys(absent, _nothing)
        instead[unison.ring_at] = _still
        instead[curve.bend] = _zero
        if not self.simulated:
            instead[np.floor] = math.floor  # on a GPU it gives a floating-point number, of infinity too
            instead[np.rint] = _nearest(importlib.import_module("numba.cuda.libdevice"))  # numba-cuda has no np.rint
        records = (_Inputs, _State) if self.simulated else map(numba.from_dtype, (_Inputs, _State))
        names = dict(zip(("_Inputs", "_State"), records, strict=True))
        copies = _Copies(here, instead, self.simulated)
        moved = {"_take": copies.device(_take), "_put": copies.device(_put), "cuda": here, **names}
        moved |= {f"_{name}": copies.device(copies.copy(f)) for name, f in watched._asdict().items()}
        self.functions = [copies.copy(_run, **moved, _own=copies.device(f)) for f in (_the_only, _own)]
        self._kernels = [here.jit(f, **_jit_options(self.simulated)) for f in self.functions]

    def room(self, each: int, share: float, most: int) -> int:
        """How many engines of so many bytes ``each`` fit into a ``share`` of the GPU's free memory, at ``most``.

        Raises MemoryError where not even one block of threads does.
        """
        free = self.cuda.current_context().get_memory_info().free
        fit = min(share * free / each, most) // THREADS * THREADS
        if fit < THREADS:
            raise MemoryError(f"{free / 2**20:.1f} MiB of its memory are free, {THREADS * each / 2**20:.1f} are needed")
        return int(fit)

    def release(self) -> None:
        """Give back the GPU's memory that nothing uses any more: others may be waiting for it."""
        if not self.simulated:
            self.cuda.current_context().deallocations.clear()

    def __call__(self, k0: int, ticks: int, noise: Any, machines: Machines, hears: Any, notes: Any) -> None:
        """Advance the engines; arguments as of `_run`, arrays those of the GPU."""
        engines = machines.s.shape[1]
        with _unfused(self.cuda):  # the first call compiles
            kernel = self._kernels[not isinstance(machines.scalars, Scalars)]
            kernel[-(-engines // THREADS), min(THREADS, engines)](k0, ticks, noise, *machines, hears, notes)


def _cuda() -> Any:
    """numba-cuda. Raises InputError where it is not installed."""
    needs("device='cuda'", "numba_cuda")
    return importlib.import_module("numba.cuda")


def check() -> Any:
    """numba-cuda, where this computer has a GPU that it can use: raises one of `unusable` where not. Takes nothing of
    the GPU's memory.
    """
    here = _cuda()
    if not here.is_available():
        raise here.cudadrv.error.CudaSupportError(f"no GPU can be used: {here.cuda_error() or NOTHING_TO_COMPILE}")
    return here


@contextlib.contextmanager
def _unfused(here: Any) -> Iterator[None]:
    """Compile without fused products and sums: numba-cuda has no option for it, its compiler has."""
    if here.config.ENABLE_CUDASIM:
        yield
        return
    nvvm = here.cudadrv.nvvm
    with patch.object(nvvm, "compile_ir", partial(nvvm.compile_ir, fma=0)):
        yield


def unusable() -> tuple[type[Exception], ...]:
    """What is raised where a GPU cannot be used, or fails."""
    found: list[type[Exception]] = [InputError, ImportError, MemoryError, RuntimeError]
    with contextlib.suppress(InputError, ImportError):
        e = _cuda().cudadrv.error
        found += [getattr(e, n) for n in ("CudaDriverError", "NvvmError", "NvrtcError") if hasattr(e, n)]
    return tuple(found)


def said(e: Exception) -> str:
    """What such an error says, in one line."""
    lines = [line.strip() for line in str(e).splitlines() if line.strip(" :")]
    return " ".join(lines)[:300] or type(e).__name__


@cache
def kernel(watched: Watched = FIGURES) -> Kernel:
    """The kernel, compiled when it first runs. Raises one of `unusable` where there is none."""
    return Kernel(watched)
