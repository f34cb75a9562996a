"""A compiled controller of the user's own: a shared library with the functions of `vaneloop_controller.h`.

Each loop gets a private copy of the file, so that global variables of the library belong to one loop. What it is given
to write to lies between walls of memory that nobody may touch, and its calibration in memory that it may not write: a
controller that writes elsewhere ends itself.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import mmap
import os
import platform
import shutil
import struct
import sys
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from controller import Calibration
from controller.header import VERSION
from hil.native import black_box
from hil.native.black_box import calling
from hil.native.call import CANARIES, CANARY, N_IN, N_OUT, N_SEEN, SHOWN, Foreign
from vaneloop.base.errors import InputError
from vaneloop.base.tables import load_toml
from vaneloop.base.vanes import VANES

__all__ = ["NEEDED", "OPTIONAL", "Program", "observables", "own_scalars", "readable", "restore", "save"]

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
_F_SEAL_FUTURE_WRITE = 0x10  # Linux 5.1; in Python's fcntl from 3.13
_MOST = 10_000  # scalars or observables of a controller's own
_MOST_STATE = 1 << 28  # bytes
_libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
_libm = ctypes.CDLL("libm.so.6" if sys.platform == "linux" else None)
_FENV = 256  # bytes, more than any machine's fenv_t
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


def _given(cal: Calibration) -> _Calibration:
    """A calibration (`readable`) as C sees it: in memory that it cannot write."""
    k, table, angles = (_VIEWS[array.ctypes.data] for array in (cal.k, cal.table, cal.angles))
    speed, extension, retraction, single = (table + row * cal.table.strides[0] for row in range(4))
    stroke, *lines = (angles + row * cal.angles.strides[0] for row in range(len(cal.angles)))
    every = (ctypes.c_void_p * len(VANES))(*lines, *([None] * (len(VANES) - len(lines))))
    points, strokes = cal.table.shape[1], cal.angles.shape[1]
    return _Calibration(k, points, speed, extension, retraction, single, strokes, stroke, every)


_VIEWS: dict[int, int] = {}  # address of an array of `readable` -> where a controller sees it


def readable(calibration: Calibration) -> Calibration:
    """A copy of a calibration that can be changed here while a controller reads it, and that the controller cannot
    change: the same memory twice, once for each.
    """
    arrays = {name: getattr(calibration, name) for name in ("k", "table", "angles")}
    handle = os.memfd_create("calibration", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(handle, sum(a.nbytes for a in arrays.values()))
        ours = mmap.mmap(handle, 0)
        with contextlib.suppress(OSError):  # an older kernel has no such seal: mprotect could lift what comes next
            fcntl.fcntl(handle, fcntl.F_ADD_SEALS, _F_SEAL_FUTURE_WRITE)
        theirs = mmap.mmap(handle, 0, prot=mmap.PROT_READ)
    finally:
        os.close(handle)
    seen, at, out = np.frombuffer(theirs, np.float64).ctypes.data, 0, {}
    for name, array in arrays.items():
        out[name] = np.frombuffer(ours, np.float64, array.size, at).reshape(array.shape)
        out[name][:] = array
        _VIEWS[out[name].ctypes.data] = seen + at
        weakref.finalize(ours, _VIEWS.pop, out[name].ctypes.data, None)
        at += array.nbytes
    weakref.finalize(ours, theirs.close).atexit = False
    return calibration._replace(program=None, **out)


def _walled(numbers: int) -> np.ndarray:
    """Memory for canaries and a struct of ``numbers`` doubles, float64[CANARIES + numbers], with a wall right behind
    it, and one before its page.
    """
    page = mmap.PAGESIZE
    block = mmap.mmap(-1, 3 * page)
    whole = np.frombuffer(block, np.float64)
    for wall in (0, 2 * page):
        if _libc.mprotect(whole.ctypes.data + wall, page, 0):
            raise OSError(ctypes.get_errno(), "mprotect")
    end = 2 * page // 8
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
        """Switch on a copy of the controller with a calibration, which it may read as long as it runs: of one that is
        `readable` what it is at the time, of another one what it is now.

        Raises InputError for a library with other functions or another interface, and with the controller's own words
        where it refuses the calibration.
        """
        head, rows = black_box.new(self.path, calibration)
        if calibration.k.ctypes.data not in _VIEWS:
            calibration = readable(calibration)
        with _arithmetic_kept():
            return self._started(calibration, head, rows)

    def _started(self, calibration: Calibration, head: np.ndarray, rows: np.ndarray) -> Foreign:
        with calling(head, "the loading of its library"):
            library = self._copy()
        for name in NEEDED:
            if not hasattr(library, name):
                raise InputError(f"{self._named}: {name} is missing; {', '.join(NEEDED)} are needed")
        library.vaneloop_version.restype = ctypes.c_uint32
        fed, given, seen = map(_walled, (N_IN, N_OUT, N_SEEN))
        weakref.finalize(fed.base, _unload, library._handle, head).atexit = False
        with calling(head, "vaneloop_version"):
            found = library.vaneloop_version()
        if found != VERSION:
            raise InputError(
                f"{self._named}: is compiled for interface {found}; this VaneLoop has interface {VERSION}: compile it "
                f"again with the header that ships"
            )
        told = _given(calibration)
        running = _Running(self._named, library, told, calibration, head)
        self._set_own(running)
        library.vaneloop_init.restype = ctypes.c_char_p
        library.vaneloop_init.argtypes = [ctypes.POINTER(_Calibration)]
        with calling(head, "vaneloop_init"):
            complaint = library.vaneloop_init(ctypes.byref(told))
        if complaint is not None:
            raise InputError(f"{self._named} refuses the calibration: {_line(complaint)}")
        address = {name: _address(library, name) for name in (*NEEDED, *OPTIONAL)}
        out = Foreign(
            address["vaneloop_step"],
            address["vaneloop_observe"],
            _address(_libc, "_exit"),  # which the library cannot catch, as it could a signal
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
        _KEPT[out.at_fed] = running
        weakref.finalize(fed.base, _KEPT.pop, out.at_fed, None)
        return out

    def _set_own(self, running: _Running) -> None:
        """Set the controller's own calibration scalars. Raises InputError with file, scalar, value, what is allowed."""
        if self.own is None:
            return
        known = running.described("scalar")
        for name, section in load_toml(self.own).items():
            if name not in known:
                allowed = ", ".join(known) or "none; it has no vaneloop_describe"
                raise InputError(f"{self.own}: {name} is no calibration scalar of {self.path}; allowed: {allowed}")
            s, value, unit = known[name], (section or {}).get("value"), (section or {}).get("unit")
            if unit != s["unit"]:
                raise InputError(f"{self.own}: {name}.unit (={unit!r}) must be {s['unit']!r}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not s["low"] <= value <= s["high"]:
                raise InputError(f"{self.own}: {name} (={value!r} {unit}) must be in [{s['low']:g}, {s['high']:g}]")
            s["value"][0] = float(value)

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


class _Running(NamedTuple):
    """A controller that was switched on.

    named    what messages call it
    told, calibration  what it may read as long as it runs
    head     of its black box
    """

    named: str
    library: ctypes.CDLL
    told: _Calibration
    calibration: Calibration
    head: np.ndarray

    def described(self, kind: str) -> dict[str, dict[str, Any]]:
        """What it says of its own quantities of one ``kind`` (scalar, observable): name -> value (float64[1], in its
        own memory), unit, meaning, and a scalar's low and high. Raises InputError for what cannot be read.
        """
        if not hasattr(self.library, "vaneloop_describe"):
            return {}
        self.library.vaneloop_describe.restype = ctypes.POINTER(_Description)
        with calling(self.head, "vaneloop_describe"):  # its pointers may lead anywhere
            told = self.library.vaneloop_describe()
            if not told:
                raise InputError(f"{self.named}: vaneloop_describe returned NULL; a vaneloop_description is needed")
            count, first = getattr(told[0], f"{kind}s"), getattr(told[0], kind)
            if not (0 <= count <= _MOST and (first or count == 0)):
                where = "" if first else " at NULL"
                raise InputError(f"{self.named}: vaneloop_describe: {kind}s (={count}{where}) must be in [0, {_MOST}]")
            out: dict[str, dict[str, Any]] = {}
            for i in range(count):
                name = _text(first[i].name)
                if not name or name in out or not first[i].value:
                    allowed = "a name of its own and a pointer to its value are needed"
                    raise InputError(f"{self.named}: vaneloop_describe: {kind} {i} (={name!r}): {allowed}")
                out[name] = {
                    "value": np.ctypeslib.as_array(first[i].value, (1,)),
                    "unit": _text(first[i].unit),
                    "meaning": _text(first[i].meaning),
                    **({"low": first[i].low, "high": first[i].high} if kind == "scalar" else {}),
                }
        return out


_KEPT: dict[int, _Running] = {}  # by the address of its inputs


def observables(foreign: Any) -> dict[str, dict[str, Any]]:
    """Quantities of the controller's own after its last step: name -> value, unit, meaning; none of the firmware
    here.
    """
    if not foreign:
        return {}
    running = _KEPT[foreign.at_fed]
    told = running.described("observable")
    with calling(running.head, "vaneloop_describe"):
        return {name: {**o, "value": float(o["value"][0])} for name, o in told.items()}


def own_scalars(foreign: Any) -> dict[str, dict[str, Any]]:
    """Calibration scalars of the controller's own, in its own memory: name -> value (float64[1]), unit, meaning, low,
    high; none of the firmware here.
    """
    return _KEPT[foreign.at_fed].described("scalar") if foreign else {}


def save(foreign: Any) -> bytes | None:
    """The whole state of a controller (`Foreign`); None where it has no vaneloop_save and vaneloop_restore, and of the
    firmware here. Raises InputError for a size that cannot be.
    """
    if not foreign:
        return None
    running = _KEPT[foreign.at_fed]
    library = running.library
    if not (hasattr(library, "vaneloop_save") and hasattr(library, "vaneloop_restore")):
        return None
    library.vaneloop_save.restype = ctypes.c_size_t
    library.vaneloop_save.argtypes = [ctypes.c_void_p]
    with calling(running.head, "vaneloop_save"):
        size = library.vaneloop_save(None)
        if size > _MOST_STATE:
            raise InputError(f"{running.named}: vaneloop_save returned {size:,} bytes; allowed: {_MOST_STATE:,}")
        room = ctypes.create_string_buffer(size)
        library.vaneloop_save(room)
    return room.raw


def restore(foreign: Foreign, state: bytes | None) -> None:
    """Give the controller a state that `save` took."""
    running = _KEPT[foreign.at_fed]
    library = running.library
    with calling(running.head, "vaneloop_restore"):
        library.vaneloop_restore(state)


def _unload(handle: int, head: np.ndarray) -> None:
    with calling(head, "the unloading of its library"):
        _dlclose(handle)


@contextlib.contextmanager
def _arithmetic_kept() -> Iterator[None]:
    """Restore rounding and the treatment of the smallest numbers, which a library built with -ffast-math changes for
    the whole process when it is loaded.
    """
    kept = ctypes.create_string_buffer(_FENV)
    _libm.fegetenv(kept)
    try:
        yield
    finally:
        _libm.fesetenv(kept)


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
