"""How functions of the hot path are compiled, and where the compiled code is kept.

numba keeps compiled code beside a source file and throws it away when that file changes, but not when a file that it
calls changes. Here it is known by a digest of all sources (`vaneloop.base.kept`), so that an edited effect is never
served from stale code; the folder carries that digest in its name, too, so that the code of old sources can go.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

import numba
from numba import njit

from vaneloop.base.files import own_folder
from vaneloop.base.kept import is_kept, keep, sources_digest
from vaneloop.base.lean import called_by_code

__all__ = [
    "cache_folder", "compiled", "compiled_free", "fused", "in_place", "in_place_free", "inlined", "is_cached",
    "sources_digest", "threads",
]  # fmt: skip

KEPT = 6


@cache
def cache_folder() -> Path:
    """Return the folder for compiled code: in the package where that can be written, else in the user's cache, else
    one of this process's own, which goes with it.

    What lies there is loaded as code. A folder with a name that others know, in a place where they may write, could be
    theirs.
    """
    for place in (Path(__file__).parent / "__pycache__", Path.home() / ".cache" / "vaneloop"):
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(place, os.W_OK):
            return place / f"compiled-{sources_digest()}"
    return own_folder("vaneloop-") / f"compiled-{sources_digest()}"


if not os.environ.get("NUMBA_CACHE_DIR"):
    _folder = cache_folder()
    # code of other sources goes, but for the latest: a run that was started before an edit may still be using it
    for old in sorted(_folder.parent.glob("compiled-*"), key=lambda f: -f.stat().st_mtime if f.exists() else 0.0)[
        KEPT:
    ]:
        if old != _folder:
            shutil.rmtree(old, ignore_errors=True)
    numba.config.CACHE_DIR = str(_folder)  # type: ignore[attr-defined]

F = TypeVar("F", bound=Callable[..., Any])


class Compiler(Protocol):
    """Decorator that compiles a function when it is first called; for type checkers the function stays as it is."""

    def __call__(self, function: F, /) -> F: ...


def _compiler(**options: Any) -> Compiler:
    options |= {"error_model": "numpy", "no_cfunc_wrapper": True}  # nobody enters it as a function of C
    compile_: Any = njit(**options)

    def of(function: F, /) -> F:
        return cast("F", called_by_code(keep(compile_(function))))

    return of


compiled = _compiler()
# The same for a loop that runs long on arrays of its own: several may run side by side in threads.
compiled_free = _compiler(nogil=True)
# The same for functions that work in place on their caller's arrays and allocate nothing: without counting references
# to those arrays, which took 50 of 340 ns a tick in the plant and 115 of 148 ns in the firmware. A function that makes
# an array does not compile under it.
in_place = _compiler(_nrt=False)
in_place_free = _compiler(nogil=True, _nrt=False)
# For loop bodies of many scalars, which a call would pass on the stack, and for the parts of the firmware's tick. Its
# strategies inverse and adaptive are `in_place`: inlined, they would double the time that compiling takes, for all.
inlined = _compiler(_nrt=False, forceinline=True)
# The same for what only lanes side by side call: sums of products may be rounded once, where the processor can.
fused = _compiler(_nrt=False, forceinline=True, fastmath={"contract"})


def threads() -> int:
    """How many threads compiled code may use side by side: NUMBA_NUM_THREADS, else the cores that this process has."""
    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def is_cached(function: Callable[..., Any]) -> bool:
    """Whether compiled code of a compiled ``function`` of these sources is there already; compiling takes seconds."""
    return is_kept(function)
