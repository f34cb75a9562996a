"""What is changed inside numba (`vaneloop.base.lean`) changes how long it compiles, and nothing that it makes."""

import gc
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core import compiler, event

from vaneloop.base import compiled, lean
from vaneloop.base.compiled import in_place, inlined

ROOT = Path(__file__).parents[1]
known = pytest.mark.skipif(not lean.is_known(), reason="another numba: nothing is changed")

SYSTEM = """
import sys
import numba
if sys.argv[1] == "as it comes":
    numba.__version__ = "0.0"
import numpy as np
from vaneloop.base import lean
from vaneloop.base.compiled import compiled, in_place, inlined

@compiled
def lag(x, u):
    return x + 0.1 * (min(max(u, -1.0), 1.0) - x)

@inlined
def put(s, row, x):
    s[row, 0] = max(x, 0.5 * s[row, 0])

@in_place
def step(s, u):
    put(s, 0, lag(s[0, 0], u))
    put(s, 1, s[0, 0] / s[2, 0])

s = np.arange(6.0).reshape(3, 2)
step(s, 0.3)
assert lean.is_known() == (sys.argv[1] != "as it comes")
print(s.tobytes().hex())
print(step.inspect_asm(step.signatures[0]))
"""


@pytest.mark.slow
@known
def test_the_machine_code_is_that_of_numba_as_it_comes(tmp_path: Path) -> None:
    made = []
    for how in ("as it comes", "changed"):
        (tmp_path / "system.py").write_text(SYSTEM, encoding="utf-8")
        said = subprocess.run(
            [sys.executable, str(tmp_path / "system.py"), how],
            env={**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path / how[:2])},
            capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        named = re.sub(r"[.\w$]*(_ZN|numba)[^\s,(]*", "NAME", said)
        made.append([line for line in named.splitlines() if not re.match(r"\s*\.(comm|type)\s", line)])
    assert any("div" in line for line in made[0])
    assert made[0] == made[1]


@known
def test_options_are_equal_where_numba_says_so() -> None:
    options: Any = compiler.Flags
    plain, explicit, other, marked = (options() for _ in range(4))
    explicit.nrt = plain.nrt  # its default, given
    other.nrt = not plain.nrt
    marked.dbg_directives_only = True
    every = (plain, explicit, other, marked)
    assert [[a == b for b in every] for a in every] == [[a.values() == b.values() for b in every] for a in every]
    assert hash(plain) == hash(explicit)


@known
def test_what_compiled_code_called_first_python_can_call_too() -> None:
    @inlined
    def double(s: np.ndarray, row: int) -> float:
        return 2.0 * s[row]

    @in_place
    def both(s: np.ndarray) -> float:
        return double(s, 0) + double(s, 1)

    made: Any = double
    s = np.array([1.5, 4.0])
    assert both(s) == 11.0
    assert len(made.overloads) == 1  # constants 0 and 1 are no functions of their own
    assert double(s, 1) == 8.0 and double(s, row=0) == 3.0
    assert len(made.overloads) == 1


@known
def test_garbage_is_collected_again_after_compiling() -> None:
    seen: list[bool] = []
    events: Any = event

    class During(event.Listener):
        def on_start(self, event: Any) -> None:
            seen.append(gc.isenabled())

        def on_end(self, event: Any) -> None:
            pass

    during = During()
    events.register("numba:compile", during)
    try:
        assert njit(lambda x: x + 1.0)(2.0) == 3.0  # not kept: the next run compiles it, too
        with pytest.raises(Exception, match="no_such_name"):
            njit(lambda x: x.no_such_name)(2.0)
    finally:
        events.unregister("numba:compile", during)
    assert seen == [False, False]
    assert gc.isenabled()


def test_where_nothing_can_be_kept_compiled_code_lies_where_nobody_else_may_write(monkeypatch: Any) -> None:
    """Code is loaded from there: a name in the folder for temporary files that others know could be theirs."""
    monkeypatch.setattr(os, "access", lambda place, mode: False)
    folders = []
    for _ in range(2):
        compiled.cache_folder.cache_clear()
        folders.append(compiled.cache_folder())
    monkeypatch.undo()
    compiled.cache_folder.cache_clear()
    assert folders[0].parent != folders[1].parent
    for folder in folders:
        about = folder.parent.lstat()
        assert about.st_uid == os.getuid() and about.st_mode & 0o77 == 0
        folder.parent.rmdir()
