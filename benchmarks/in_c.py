"""The hand-written C loop (`loop.c`), built with gcc and called through ctypes, on the same arrays as the compiled
Python.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np

from benchmarks.ours import COLUMNS, Setup
from plant import parameters as par
from plant.linkage import N_CRANK, N_PER_STAGE

__all__ = ["BITWISE", "FAST", "CLoop", "build"]

FAST = ("-O3", "-march=native")
BITWISE = (*FAST, "-ffp-contract=off")  # no fused multiply-add: every operation rounds, as in the compiled Python

# the product's parameters in the order of loop.c's `Parameters`
_PARAMETERS = [
    *(
        par.LAG,
        par.ACCELERATION,
        par.DECELERATION,
        par.RATED_CURRENT,
        par.BANDWIDTH,
        par.DAMPING,
        par.FLOW_GAIN,
        par.AREA,
        par.STROKE,
    ),
    *(par.P_REF, par.LVDT_LAG, par.POT_LAG, *range(par.PLAY, par.PLAY + 3), *range(par.POT_BIAS, par.POT_BIAS + 3)),
    *range(par.GEOMETRY, par.GEOMETRY + N_CRANK + 3 * N_PER_STAGE),
    *(par.LVDT_STEP, par.VALVE_A11, par.VALVE_A12, par.VALVE_A21, par.VALVE_A22, par.LVDT_FACTOR, par.POT_FACTOR),
]
_Doubles = ctypes.POINTER(ctypes.c_double)


@lru_cache(maxsize=4)
def build(flags: tuple[str, ...], gcc: str = "gcc") -> ctypes.CDLL:
    """Compile ``loop.c`` and load it. Raises CalledProcessError with gcc's words in ``stderr``."""
    folder = tempfile.TemporaryDirectory(prefix="vaneloop-c-")
    library = Path(folder.name) / "loop.so"
    source = Path(__file__).with_name("loop.c")
    command = [gcc, "-std=gnu11", *flags, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"]
    subprocess.run(command, check=True, capture_output=True, text=True)
    c = ctypes.CDLL(str(library))
    folder.cleanup()  # the library stays mapped
    long, double, handle = ctypes.c_long, ctypes.c_double, ctypes.c_void_p
    c.loop_new.argtypes = [_Doubles, _Doubles, ctypes.c_int, _Doubles, _Doubles, double, double, double, double]
    c.loop_new.restype = handle
    c.loop_free.argtypes = [handle]
    c.loop_faults.argtypes = [handle]
    c.loop_faults.restype = ctypes.c_uint
    c.loop_layout.argtypes = [ctypes.c_int]
    c.loop_advance.argtypes = [handle, long, long, _Doubles, long, _Doubles, long, _Doubles]
    return c


def _pointer(a: np.ndarray | None):
    if a is None:
        return None
    assert a.dtype == np.float64 and a.flags.c_contiguous
    return a.ctypes.data_as(_Doubles)


class CLoop:
    """One closed loop in C, from the same start as `benchmarks.ours.OurLoop`."""

    def __init__(self, setup: Setup, flags: tuple[str, ...] = FAST, gcc: str = "gcc"):
        self._c = build(flags, gcc)
        s = self._setup = setup
        # kept: the C side reads the table where it is
        self._arrays = [
            np.ascontiguousarray(a) for a in (s.calibration.k, s.calibration.table, s.plant.p[_PARAMETERS, 0], s.sigma)
        ]
        k, table, p, sigma = self._arrays
        expected = [len(k), len(p), s.stimulus.rows.shape[1], len(sigma)]
        found = [self._c.loop_layout(i) for i in range(4)]
        if found != expected:
            raise RuntimeError(
                f"loop.c has calibration, parameters, frame, noise of {found} numbers; the product has {expected}"
            )
        start = [s.stroke, s.stimulus.rows[0, 0], 1.0, 1.0]
        self._loop = self._c.loop_new(
            _pointer(k), _pointer(table), table.shape[1], _pointer(p), _pointer(sigma), *start
        )
        first = np.ascontiguousarray(s.stimulus.rows[:1])
        self._c.loop_advance(self._loop, -s.warm_up, s.warm_up, _pointer(first), 1, None, 10, None)

    def advance(self, out: np.ndarray, noise: np.ndarray | None = None, ticks: int | None = None) -> None:
        """Run the stimulus from its start into ``out`` (SI, a row every 10 ticks)."""
        rows, ticks = self._setup.stimulus.rows, ticks or self._setup.ticks
        assert out.shape == (-(-ticks // self._setup.every), len(COLUMNS))
        self._c.loop_advance(
            self._loop, 0, ticks, _pointer(rows), len(rows), _pointer(noise), self._setup.every, _pointer(out)
        )

    @property
    def faults(self) -> int:
        """Fault bits that stand now."""
        return int(self._c.loop_faults(self._loop))

    def __del__(self) -> None:
        if getattr(self, "_loop", None):
            self._c.loop_free(self._loop)
            self._loop = None
