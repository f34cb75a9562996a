"""C99 source of an FMU: its tick from the compiled functions, its variables and its memory as tables.

The functions are compiled anew in a process of their own, for any processor of 64 bits and without vectors, which
leaves their results as they are; the C text that comes of it is kept, since it takes some seconds.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import hashlib
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
import numpy as np

from hil.fmu.description import OPTIONS
from hil.fmu.ir_to_c import translate
from hil.fmu.kernel import entry
from hil.fmu.memory import Shape, places_of
from hil.fmu.variables import Variable
from hil.loop.lockstep import WARM_UP
from vaneloop.base.child import python_module
from vaneloop.base.compiled import cache_folder
from vaneloop.base.files import write

__all__ = ["SHELL", "build", "kept_source", "model_source", "part_object", "part_source"]

SHELL = Path(__file__).parent / "c"
_PLAIN = {
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_CPU_FEATURES": "",
    "NUMBA_LOOP_VECTORIZE": "0",
    "NUMBA_SLP_VECTORIZE": "0",
}


def kept_source(part: str, shape: Shape) -> Path:
    """Return where ``part.c`` is kept."""
    return _folder() / f"{part}-{'-'.join(map(str, shape))}.c"


@lru_cache(maxsize=1)
def _folder() -> Path:
    """Its name has a digest of the sources that the C text follows from."""
    root = Path(__file__).parents[2]
    h = hashlib.sha256(f"{numba.__version__} {WARM_UP}".encode())
    own = ("hil/fmu/kernel.py", "hil/fmu/memory.py", "hil/fmu/ir_to_c.py", "hil/loop/tick.py", "hil/native/call.py")
    rooms = (f for room in ("controller", "plant", "vaneloop/base") for f in sorted((root / room).rglob("*.py")))
    for f in (*(root / name for name in own), *rooms):
        h.update(f.name.encode() + f.read_bytes())
    return cache_folder().parent / f"fmu-{h.hexdigest()[:16]}"


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Who makes the same at the same time waits, and finds it made. The kernel ends the lock with its process."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def part_source(part: str, shape: Shape) -> str:
    """Return ``part.c`` of a part (`hil.fmu.variables.PARTS`) for a machine of this shape."""
    kept = kept_source(part, shape)
    if not kept.is_file():
        with _alone(kept.parent):
            if not kept.is_file():
                _make_source(kept, part, shape)
    return kept.read_text(encoding="ascii")


def _make_source(kept: Path, part: str, shape: Shape) -> None:
    folder = kept.parent
    environment = {**os.environ, **_PLAIN, "NUMBA_CACHE_DIR": str(folder)}
    words = python_module("hil.fmu.source", part, *map(str, shape))
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"the source of the FMU could not be made: {done.stderr[-2000:]}")
    write(kept, done.stdout)


def part_object(part: str, shape: Shape) -> Path:
    """Return the object file of ``part.c``, built once: most of what gcc does for an FMU, and the same for all."""
    kept = kept_source(part, shape).with_suffix(f".{platform.machine()}.o")
    if not kept.is_file():
        text = part_source(part, shape)
        with tempfile.TemporaryDirectory(prefix="vaneloop-fmu-") as folder:
            (Path(folder) / "part.c").write_text(text, encoding="ascii")
            build(["-c", "part.c"], "part.o", Path(folder))
            kept.parent.mkdir(parents=True, exist_ok=True)
            write(kept, (Path(folder) / "part.o").read_bytes())
    return kept


def build(words: Sequence[str], out: str, folder: Path) -> None:
    """Let gcc make ``out`` in a folder; only FMI's functions can be seen from outside."""
    words = ["gcc", *OPTIONS.split(), "-fPIC", "-fvisibility=hidden", "-o", out, *words]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"gcc could not build the FMU: {done.stderr[-2000:]}")


def _translated(part: str, shape: Shape) -> str:
    compiler: Any = numba
    types = compiler.types
    signature = types.void(types.CPointer(types.float64), types.int64, types.int64)
    made = compiler.njit(signature, error_model="numpy", _nrt=False, no_cpython_wrapper=True)(entry(part, shape))
    compiled = made.overloads[made.signatures[0]]
    return translate(compiled.library.get_llvm_str(), compiled.fndesc.llvm_func_name, "serve")


def _number(v: float) -> str:
    if v != v:
        return "NAN"
    if abs(v) == np.inf:
        return "INFINITY" if v > 0 else "-INFINITY"
    return float(v).hex() if v else ("-0.0" if str(v)[0] == "-" else "0")


def _text(words: str) -> str:
    return '"' + words.replace("\\", "\\\\").replace('"', '\\"') + '"'


def model_source(part: str, shape: Shape, memory: np.ndarray, variables: Sequence[Variable]) -> tuple[str, str]:
    """Return ``model.h`` and ``model.c``: sizes, variables and the memory before the start.

    The first variable of the FMU is time; the others follow in their order, and so do their value references.
    """
    own = [v for v in variables if v.at < 0]
    numbers = [*memory, *(v.start for v in own)]
    behind = iter(range(len(memory), len(numbers)))
    rows = ['    {REAL, TIME, 0, -1, 1, 1, -INFINITY, INFINITY, "time", "s"},']
    for v in variables:
        at = next(behind) if v.at < 0 else v.at
        if v.at >= 0:
            numbers[at] = v.start
        kind, role = ("REAL", "WHOLE", "TRUTH")[v.kind], ("TIME", "INPUT", "OUTPUT", "FIXED", "TUNABLE")[v.role]
        limits = ", ".join(map(_number, (v.si, v.ratio, v.low, v.high)))
        rows.append(f"    {{{kind}, {role}, {at}, {v.acts}, {limits}, {_text(v.name)}, {_text(v.unit)}}},")
    cells = [_number(float(v)) for v in numbers]
    lines = [f"    {', '.join(cells[i : i + 8])}," for i in range(0, len(cells), 8)]
    places = places_of(shape)
    body = "\n".join([
        '#include "fmu.h"', "", "#include <math.h>", "",
        "const Variable variables[VARIABLES] = {", *rows, "};", "",
        "const double first[NUMBERS] = {", *lines, "};", "",
    ])  # fmt: skip
    token = hashlib.sha256((part + body).encode()).hexdigest()
    token = f"{{{token[:8]}-{token[8:12]}-{token[12:16]}-{token[16:20]}-{token[20:32]}}}"
    head = "\n".join([
        f"#define NUMBERS {len(numbers)}", f"#define VARIABLES {len(rows)}",
        f"#define CLOCK {places['clock'].at} /* the next tick */",
        f"#define WARM_UP {WARM_UP if part == 'loop' else 0} /* ticks before the start */", 
        f'#define TOKEN "{token}"', "",
    ])  # fmt: skip
    return head, body


if __name__ == "__main__":
    gc.disable()  # for some seconds of compiling: a collection finds nothing to free
    sys.stdout.write(_translated(sys.argv[1], Shape(*map(int, sys.argv[2:]))))
