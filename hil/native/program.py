"""A compiled controller of the user's own: a shared library with the functions of `vaneloop_controller.h`.

Each loop gets a private copy of the file, so that global variables of the library belong to one loop. What it is given
to write to ends at a wall of memory that nobody may touch: a controller that writes beyond ends itself.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import platform
import shutil
import struct
import tempfile
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from controller import Calibration
from controller.header import VERSION
from hil.native import black_box
from hil.native.call import CANARIES, CANARY, N_IN, N_OUT, N_SEEN, SHOWN, STARTED, Foreign
from vaneloop.base.errors import InputError
from vaneloop.base.tables import load_toml
from vaneloop.base.vanes import VANES

__all__ = ["NEEDED", "OPTIONAL", "Program", "observables", "own_scalars", "restore", "save"]

NEEDED = ("vaneloop_version", "vaneloop_init", "vaneloop_step")
OPTIONAL = ("vaneloop_observe", "vaneloop_save", "vaneloop_restore", "vaneloop_describe")
_MACHINES = {"x86_64": (2, 62), "aarch64": (2, 183), "i686": (1, 3), "armv7l": (1, 40), "ppc64le": (2, 21)}
_NAMES = {
    **{number: name for name, (_, number) in _MACHINES.items()},
    243: "RISC-V",
    94: "Xtensa",
    8: "MIPS",
    20: "PowerPC",
}
_SHARED_OBJECT = 3  # ELF's e_type
_libc = ctypes.CDLL(None, use_errno=True)
_libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
_dlclose = _libc.dlclose
_dlclose.argtypes = [ctypes.c_void_p]
_Doubles = ctypes.POINTER(ctypes.c_double)


class _Calibration(ctypes.Structure):
    """``vaneloop_calibration`` of the header."""

    _fields_ = [
        ("scalars", ctypes.c_void_p),
        ("points", ctypes.c_int32),
        ("speed", ctypes.c_void_p),
        ("extension", ctypes.c_void_p),
        ("retraction", ctypes.c_void_p),
        ("single", ctypes.c_void_p),
        ("strokes", ctypes.c_int32),
        ("stroke", ctypes.c_void_p),
        ("angle", ctypes.c_void_p * len(VANES)),
    ]


class _OwnScalar(ctypes.Structure):
    """``vaneloop_own_scalar``."""

    _fields_ = [
        ("name", ctypes.c_char_p),
        ("unit", ctypes.c_char_p),
        ("meaning", ctypes.c_char_p),
        ("value", _Doubles),
        ("low", ctypes.c_double),
        ("high", ctypes.c_double),
    ]


class _OwnObservable(ctypes.Structure):
    """``vaneloop_own_observable``."""

    _fields_ = [("name", ctypes.c_char_p), ("unit", ctypes.c_char_p), ("meaning", ctypes.c_char_p), ("value", _Doubles)]


class _Description(ctypes.Structure):
    """``vaneloop_description``."""

    _fields_ = [
        ("scalars", ctypes.c_int32),
        ("observables", ctypes.c_int32),
        ("scalar", ctypes.POINTER(_OwnScalar)),
        ("observable", ctypes.POINTER(_OwnObservable)),
    ]


def _description(library: ctypes.CDLL) -> _Description:
    """What the controller says of itself; nothing where it has no vaneloop_describe."""
    if not hasattr(library, "vaneloop_describe"):
        return _Description()
    library.vaneloop_describe.restype = ctypes.POINTER(_Description)
    return cast("_Description", library.vaneloop_describe()[0])


def _given(cal: Calibration) -> _Calibration:
    """The calibration as C sees it, in the memory of ``cal``."""
    assert cal.k.flags.c_contiguous and cal.table.flags.c_contiguous and cal.angles.flags.c_contiguous
    speed, extension, retraction, single = (row.ctypes.data for row in cal.table)
    stroke, *angles = (row.ctypes.data for row in cal.angles)
    every = (ctypes.c_void_p * len(VANES))(*angles, *([None] * (len(VANES) - len(angles))))
    points, strokes = cal.table.shape[1], cal.angles.shape[1]
    return _Calibration(cal.k.ctypes.data, points, speed, extension, retraction, single, strokes, stroke, every)


def _walled(numbers: int) -> np.ndarray:
    """Memory for canaries and a struct of ``numbers`` doubles, float64[CANARIES + numbers], with a wall right behind
    it.
    """
    page = mmap.PAGESIZE
    block = mmap.mmap(-1, 2 * page)
    whole = np.frombuffer(block, np.float64)
    if _libc.mprotect(whole.ctypes.data + page, page, 0):
        raise OSError(ctypes.get_errno(), "mprotect")
    end = page // 8
    out = whole[end - numbers - CANARIES : end]
    out[:CANARIES] = CANARY
    return out


@dataclass(frozen=True)
class Program:
    """A shared library that is a controller.

    path  of the file; a missing one, or one that is no shared library of this machine's kind, raises InputError
    own   TOML file with calibration scalars of the controller's own, a section each: value, unit, origin
    """

    path: str
    own: str | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be loaded, without running any of it."""
        _check_file(self.path)

    def start(self, calibration: Calibration) -> Foreign:
        """Switch on a copy of the controller with a calibration, which it may read as long as it runs.

        Raises InputError for a library with other functions or another interface, and with the controller's own words
        where it refuses the calibration.
        """
        head, rows = black_box.new(self.path, calibration)
        try:
            return self._started(calibration, head, rows)
        finally:  # what ends the process here leaves the box as it is
            head[STARTED] = 1.0

    def _started(self, calibration: Calibration, head: np.ndarray, rows: np.ndarray) -> Foreign:
        library = self._copy()
        for name in NEEDED:
            if not hasattr(library, name):
                raise InputError(f"{self._named}: {name} is missing; {', '.join(NEEDED)} are needed")
        library.vaneloop_version.restype = ctypes.c_uint32
        fed, given, seen = map(_walled, (N_IN, N_OUT, N_SEEN))
        weakref.finalize(fed.base, _dlclose, library._handle).atexit = False
        if (found := library.vaneloop_version()) != VERSION:
            raise InputError(
                f"{self._named}: is compiled for interface {found}; this VaneLoop has interface {VERSION}: compile it "
                f"again with the header that ships"
            )
        self._set_own(library)
        told = _given(calibration)
        library.vaneloop_init.restype = ctypes.c_char_p
        library.vaneloop_init.argtypes = [ctypes.POINTER(_Calibration)]
        complaint = library.vaneloop_init(ctypes.byref(told))
        if complaint is not None:
            raise InputError(f"{self._named} refuses the calibration: {_line(complaint)}")
        address = {name: _address(library, name) for name in (*NEEDED, *OPTIONAL)}
        out = Foreign(
            address["vaneloop_step"],
            address["vaneloop_observe"],
            _address(_libc, "abort"),
            fed,
            given,
            seen,
            fed.ctypes.data + 8 * CANARIES,
            given.ctypes.data + 8 * CANARIES,
            seen.ctypes.data + 8 * CANARIES,
            head,
            rows,
            SHOWN,
        )
        _KEPT[out.at_fed] = (library, told, calibration)
        weakref.finalize(fed.base, _KEPT.pop, out.at_fed, None)
        return out

    def _set_own(self, library: ctypes.CDLL) -> None:
        """Set the controller's own calibration scalars. Raises InputError with file, scalar, value, what is allowed."""
        if self.own is None:
            return
        told = _description(library)
        known = {_text(s.name): s for s in told.scalar[: told.scalars]}
        for name, section in load_toml(self.own).items():
            if name not in known:
                allowed = ", ".join(known) or "none; it has no vaneloop_describe"
                raise InputError(f"{self.own}: {name} is no calibration scalar of {self.path}; allowed: {allowed}")
            s, value, unit = known[name], (section or {}).get("value"), (section or {}).get("unit")
            if unit != _text(s.unit):
                raise InputError(f"{self.own}: {name}.unit (={unit!r}) must be {_text(s.unit)!r}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not s.low <= value <= s.high:
                raise InputError(f"{self.own}: {name} (={value!r} {unit}) must be in [{s.low:g}, {s.high:g}]")
            s.value[0] = float(value)

    @property
    def _named(self) -> str:
        return f"--controller {self.path}"

    def _copy(self) -> ctypes.CDLL:
        """Load a copy of the file: the loader gives each file one set of global variables."""
        handle, name = tempfile.mkstemp(prefix="vaneloop-", suffix=".so")
        os.close(handle)
        try:
            shutil.copyfile(self.path, name)
            return ctypes.CDLL(name, mode=os.RTLD_NOW | os.RTLD_LOCAL)
        except OSError as e:
            raise InputError(f"{self._named}: cannot be loaded ({_line(e).replace(name, self.path)})") from None
        finally:
            os.unlink(name)


_KEPT: dict[int, tuple[ctypes.CDLL, _Calibration, Calibration]] = {}  # what a running controller reads, by its memory


def observables(foreign: Any) -> dict[str, dict[str, Any]]:
    """Quantities of the controller's own after its last step: name -> value, unit, meaning; none of the firmware
    here.
    """
    if not foreign:
        return {}
    told = _description(_KEPT[foreign.at_fed][0])
    return {
        _text(o.name): {"value": float(o.value[0]), "unit": _text(o.unit), "meaning": _text(o.meaning)}
        for o in told.observable[: told.observables]
    }


def own_scalars(foreign: Any) -> dict[str, dict[str, Any]]:
    """Calibration scalars of the controller's own, in its own memory: name -> value (float64[1]), unit, meaning, low,
    high; none of the firmware here.
    """
    if not foreign:
        return {}
    told = _description(_KEPT[foreign.at_fed][0])
    return {
        _text(s.name): {
            "value": np.ctypeslib.as_array(s.value, (1,)),
            "unit": _text(s.unit),
            "meaning": _text(s.meaning),
            "low": float(s.low),
            "high": float(s.high),
        }
        for s in told.scalar[: told.scalars]
    }


def save(foreign: Any) -> bytes | None:
    """The whole state of a controller (`Foreign`); None where it has no vaneloop_save and vaneloop_restore, and of the
    firmware here.
    """
    if not foreign:
        return None
    library = _KEPT[foreign.at_fed][0]
    if not (hasattr(library, "vaneloop_save") and hasattr(library, "vaneloop_restore")):
        return None
    library.vaneloop_save.restype = ctypes.c_size_t
    library.vaneloop_save.argtypes = [ctypes.c_void_p]
    room = ctypes.create_string_buffer(library.vaneloop_save(None))
    library.vaneloop_save(room)
    return room.raw


def restore(foreign: Foreign, state: bytes | None) -> None:
    """Give the controller a state that `save` took."""
    library = _KEPT[foreign.at_fed][0]
    library.vaneloop_restore.argtypes = [ctypes.c_void_p]
    library.vaneloop_restore.restype = None
    library.vaneloop_restore(state)


def _address(library: Any, name: str) -> int:
    return ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0 if hasattr(library, name) else 0


def _text(words: bytes | None) -> str:
    return (words or b"").decode("utf-8", "replace")


def _line(text: Any) -> str:
    words = text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)
    return " ".join(words.split())[:300]


def _length(file: BinaryIO) -> int:
    """Bytes that the segments of a little-endian ELF file of 64 bits need; 0 for others."""
    file.seek(0)
    head = file.read(64)
    if len(head) < 64 or head[4:6] != b"\x02\x01":
        return 0
    start, size, number = int.from_bytes(head[32:40], "little"), *struct.unpack_from("<HH", head, 54)
    file.seek(start)
    table = file.read(size * number)
    if len(table) < size * number or size < 56:
        return start + size * number
    spans = [struct.unpack_from("<8xQ16xQ", table, size * i) for i in range(number)]
    return max((offset + length for offset, length in spans), default=0)


def _check_file(path: str) -> None:
    """Refuse a file that is no shared library of this machine's kind: InputError."""
    named = f"--controller {path}"
    try:
        with Path(path).open("rb") as f:
            head = f.read(20)
            whole = _length(f)
    except OSError as e:
        raise InputError(f"{named}: cannot be read ({e.strerror})") from None
    if len(head) < 20 or head[:4] != b"\x7fELF":
        raise InputError(f"{named}: is no ELF file; a shared library is needed (gcc -shared -fPIC)")
    order = "little" if head[5] == 1 else "big"
    kind, machine = int.from_bytes(head[16:18], order), int.from_bytes(head[18:20], order)  # type: ignore[arg-type]
    here = platform.machine()
    wanted = _MACHINES.get(here)
    if wanted is not None and (head[4], machine) != wanted:
        found = _NAMES.get(machine, f"ELF machine {machine}")
        raise InputError(f"{named}: is built for {found}, {32 * head[4]} bits; this machine is {here}: build it here")
    if (size := Path(path).stat().st_size) < whole:
        raise InputError(f"{named}: is cut short: {size:,} bytes of {whole:,}")  # the loader would crash on it
    if kind != _SHARED_OBJECT:
        raise InputError(f"{named}: is no shared library (ELF type {kind}); build it with gcc -shared -fPIC")
