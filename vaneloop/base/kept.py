"""Compiled code that is kept in files: found again by what it was compiled from, and written so that none is ever half.

numba's own files have an index for each function, which two processes that write at once can leave pointing at the
wrong code (numba's issues 4807 and 10128). Here each compiled signature has a file of its own. Its name is a digest of
all that the code follows from, and it appears by a rename.

A function of this program follows from all its sources. A function that a user wrote, or that was written for a user's
system, follows from its bytecode and from whatever that refers to (`digest_of`).
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import pickle
import sys
import threading
import types
import uuid
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba import njit
from numba.core import compiler, config, event, serialize
from numba.core.caching import FunctionCache

from vaneloop.base import terminal

__all__ = ["AHEAD", "Waiting", "digest_of", "is_kept", "keep", "kept_njit", "sources_digest"]

_ROOT = Path(__file__).parents[2]
_PACKAGES = ("controller", "plant", "hil", "vaneloop/base", "vaneloop/design", "vaneloop/identification")
# What was compiled when the program was set up (`vaneloop.cli.ahead`), for each Python; here it is only read.
AHEAD = Path(os.environ.get("VANELOOP_AHEAD") or Path(__file__).parent / "ahead" / str(sys.implementation.cache_tag))
ENTERED, INNER = ".nbc", ".nbi"  # files of code that Python can call, and of code that only compiled code can
OWN = 1_000  # files of users' functions that are kept
_unknown = itertools.count()
_Result: Any = compiler.CompileResult  # what has no types
_dumps: Any = serialize.dumps


@lru_cache(maxsize=1)
def sources_digest() -> str:
    """Digest of all sources that are compiled, and of numba's version."""
    h = hashlib.sha256(numba.__version__.encode())
    for package in _PACKAGES:
        for f in sorted((_ROOT / package).rglob("*.py")):
            h.update(f.name.encode() + f.read_bytes())
    return h.hexdigest()[:16]


def keep(dispatcher: Any, stamp: Callable[[], str] | None = None, folder: str = "") -> Any:
    """Let a function that numba compiles be kept in files; return it.

    stamp   what says from what the code follows besides this program's sources; default the file that it stands in
    folder  within that of compiled code
    """
    function = getattr(dispatcher, "py_func", None)  # none where compiling is switched off
    if function is not None:
        file = function.__code__.co_filename
        dispatcher._cache = _Files(function, stamp or (lambda: _file_digest(file)), folder)
    return dispatcher


def kept_njit(function: types.FunctionType, **options: Any) -> Any:
    """``njit`` of a copy of a user's function, kept where all that it refers to is known.

    Its name has the digest: in a process, symbols of the same name from several files would be taken for one.
    """
    digest = digest_of(function)
    copy = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    copy.__module__ = __name__  # whoever loads the code must be able to import it
    copy.__qualname__ = f"{function.__name__}_{digest[:24] if digest else f'{next(_unknown)}_{uuid.uuid4().hex}'}"
    dispatcher = njit(**options)(copy)
    if not digest or not hasattr(dispatcher, "py_func"):
        return dispatcher
    dispatcher.vaneloop_digest = digest
    return keep(dispatcher, lambda: f"{digest} {digest_of(function)} {sorted(options.items())}", "own")


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether compiled code of a function of this program is there already, of these sources. Compiling takes
    seconds.
    """
    cache = getattr(function, "_cache", None)
    return not isinstance(cache, _Files) or cache.has_any()


class _Files(FunctionCache):
    """What numba asks for compiled code of one function, and gives it to."""

    _index_key: Any  # of a signature and a processor, as numba makes it
    inner = False  # whether compiled code calls: it may be code without an entry for Python (`vaneloop.base.lean`)

    def __init__(self, function: Any, stamp: Callable[[], str], folder: str):
        self._py_func, self._stamp, self._folder = function, stamp, folder
        self._title = f"{Path(function.__code__.co_filename).stem}.{function.__name__}"[:80].replace(os.sep, "_")

    @property
    def cache_path(self) -> str:
        """Folder of the compiled code, as numba's statistics show it."""
        return str(self._folders()[0])

    def _folders(self) -> list[Path]:
        return [Path(config.CACHE_DIR) / self._folder, AHEAD / self._folder]  # type: ignore[attr-defined]

    def _begins(self) -> str:
        """How the names of all files of this function begin."""
        what = (self._py_func.__module__, self._py_func.__qualname__, self._py_func.__code__.co_firstlineno)
        says = f"{what} {numba.__version__} {sys.version} {sources_digest()} {self._stamp()}"
        return f"{self._title}-{hashlib.sha256(says.encode()).hexdigest()[:24]}"

    def _file(self, key: Any, suffix: str) -> str:
        return f"{self._begins()}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}{suffix}"

    def has_any(self) -> bool:
        """Whether there is code for any signature that Python calls."""
        return any(any(folder.glob(f"{self._begins()}-*{ENTERED}")) for folder in self._folders())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Compiled code for a signature, or None. A file that cannot be read counts as none."""
        key = self._index_key(sig, target_context.codegen())
        for suffix in (INNER, ENTERED) if self.inner else (ENTERED,):
            for folder in self._folders():
                with contextlib.suppress(Exception):
                    kept, data = pickle.loads((folder / self._file(key, suffix)).read_bytes())
                    if kept == key:
                        target_context.refresh()
                        return _Result._rebuild(target_context, *data)
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code; code with addresses of this process cannot be kept, nor any where nothing can be
        written.
        """
        if data.library.has_dynamic_globals or data.lifted:
            return
        key = self._index_key(sig, data.codegen)
        folder = self._folders()[0]
        file = folder / self._file(key, INNER if self.inner else ENTERED)
        writing = file.with_suffix(f".{uuid.uuid4().hex}")
        try:
            if pickle.loads(_dumps(key)) != key:
                return  # it takes a named tuple of the user's: only part of what is called from outside
            content = _dumps((key, data._reduce()))
            folder.mkdir(parents=True, exist_ok=True)
            writing.write_bytes(content)
            writing.replace(file)
        except (OSError, pickle.PicklingError):
            with contextlib.suppress(OSError):
                writing.unlink(missing_ok=True)
            return
        if self._folder:
            _prune(folder)

    def enable(self) -> None:
        """Nothing to do: it is never off."""

    def disable(self) -> None:
        """Nothing to do: it is never off."""

    def flush(self) -> None:
        """Forget what is kept of this function."""
        for suffix in (INNER, ENTERED):
            for file in self._folders()[0].glob(f"{self._begins()}-*{suffix}"):
                file.unlink(missing_ok=True)


def _prune(folder: Path) -> None:
    with contextlib.suppress(OSError):
        files = sorted(folder.glob(f"*{ENTERED}"), key=lambda f: f.stat().st_mtime)
        for old in files[: max(len(files) - OWN, 0)]:
            old.unlink(missing_ok=True)


@cache
def _file_digest(file: str) -> str:
    try:
        return hashlib.sha256(Path(file).read_bytes()).hexdigest()
    except OSError:
        return uuid.uuid4().hex  # no file: nothing to know the code by


class Waiting(event.Listener):
    """Tells the user (`terminal.compiling`) when a compilation, with all that it calls, has taken ``after`` seconds.
    Once is enough.
    """

    def __init__(self, after: float = 1.0):
        self.after, self.depth, self.told = after, 0, False
        self.timer: threading.Timer | None = None

    def on_start(self, event: Any) -> None:
        """A function begins to be compiled: the outermost, or one that it calls."""
        self.depth += 1
        if self.depth == 1 and not self.told:
            self.timer = threading.Timer(self.after, self.tell)
            self.timer.daemon = True
            self.timer.start()

    def on_end(self, event: Any) -> None:
        """It is compiled."""
        self.depth -= 1
        if self.depth == 0:
            terminal.told_of_compiling = False
            if self.timer is not None:
                self.timer.cancel()

    def tell(self) -> None:
        """Tell it, unless the command has told it itself."""
        self.told = not terminal.told_of_compiling
        terminal.compiling()


_register: Any = event.register
_register("numba:compile", Waiting())


class _Unknown(Exception):
    """A function refers to something whose content cannot be told."""


def digest_of(function: Callable[..., Any]) -> str:
    """Digest of all that compiled code of a user's function follows from, or "" where some of it cannot be told.

    That is its bytecode and constants, and what its global names and its closure stand for: numbers, words, arrays,
    named tuples, functions of numpy and of this program, and other functions of which the same is known.
    """
    h = hashlib.sha256()
    try:
        _add_function(h, function, [])
    except _Unknown:
        return ""
    return h.hexdigest()


def _add_function(h: Any, f: Any, above: list[Any]) -> None:
    if f in above:  # it calls itself
        h.update(f"again {above.index(f)}".encode())
        return
    h.update(f"function {f.__name__} {f.__module__}".encode())
    above = [*above, f]
    names = _add_code(h, f.__code__)
    _add_value(h, f.__defaults__, above)
    _add_value(h, tuple(sorted((f.__kwdefaults__ or {}).items())), above)
    for cell in f.__closure__ or ():
        _add_value(h, cell.cell_contents, above)
    for name in sorted(names & f.__globals__.keys()):
        h.update(f"{name} is ".encode())
        _add_value(h, f.__globals__[name], above)


def _add_code(h: Any, code: types.CodeType) -> set[str]:
    """Add bytecode; return the names in it, of which some are global."""
    h.update(code.co_code)
    parts = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, code.co_argcount, code.co_flags,
             code.co_kwonlyargcount)  # fmt: skip
    h.update(repr(parts).encode())
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            names |= _add_code(h, constant)
        else:
            h.update(f"{type(constant)} {constant!r}".encode())
    return names


def _add_value(h: Any, v: Any, above: list[Any]) -> None:
    if v is None or isinstance(v, bool | int | float | complex | str | bytes):
        h.update(f"{type(v)} {v!r};".encode())
    elif isinstance(v, np.ndarray) and v.dtype.kind in "biufc":
        h.update(f"array {v.dtype.str} {v.shape} {v.strides} {v.flags.writeable}".encode() + v.tobytes())
    elif isinstance(v, np.generic):
        h.update(f"{v.dtype.str}".encode() + v.tobytes())
    elif isinstance(v, tuple):
        h.update(f"{type(v).__name__} {getattr(v, '_fields', '')} {len(v)}".encode())
        for item in v:
            _add_value(h, item, above)
    elif isinstance(v, types.ModuleType) and v.__name__ in ("numpy", "math", "cmath"):
        h.update(f"module {v.__name__} {getattr(v, '__version__', '')}".encode())
    elif isinstance(v, type) and issubclass(v, tuple) and hasattr(v, "_fields"):
        h.update(f"named tuple {v.__name__} {v._fields} {getattr(v, '_field_defaults', '')}".encode())
    elif _is_named(v) and v.__module__ in ("builtins", "math", "cmath", "numpy"):
        h.update(f"{v.__module__}.{v.__name__}".encode())
    elif isinstance(v, np.ufunc):
        h.update(f"ufunc {v.__name__}".encode())
    elif _is_named(getattr(v, "py_func", v), v) and v.__module__.partition(".")[0] in (
        "controller", "plant", "hil", "vaneloop"
    ):  # fmt: skip
        h.update(f"ours {v.__module__}.{v.__name__}".encode())
    elif digest := getattr(v, "vaneloop_digest", ""):
        h.update(f"kept {digest}".encode())
    elif isinstance(v, types.FunctionType):
        _add_function(h, v, above)
    else:
        raise _Unknown


def _is_named(f: Any, v: Any = None) -> bool:
    """Whether a function or a type is what its module has under its name."""
    module = sys.modules.get(getattr(f, "__module__", None) or "")
    found = getattr(module, getattr(f, "__name__", ""), None)
    return found is not None and found is (f if v is None else v)
