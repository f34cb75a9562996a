"""The laws of a system by their numbers: the library's as they are compiled, with the user's own beside them.

A system without laws of its own gets the library's functions themselves. Else the functions are written anew with one
branch for each law, and compiled; where numba cannot compile a law, they stay Python.
"""

from __future__ import annotations

import types
from collections import namedtuple
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numba import njit

from vaneloop.base.kept import kept_njit
from vaneloop.identification.candidates import laws, library
from vaneloop.identification.subsystem import Array, StageError
from vaneloop.identification.user_models.system import FIRST_CODE, Law
from vaneloop.identification.user_models.user_code import InATuple, cannot, place_of

__all__ = ["Dispatch", "compiled_code", "dispatch_of", "try_law"]

Function = Callable[..., Any]


@dataclass
class Dispatch:
    """The laws that a system may be given.

    transform, apply, argument  as in `identification.candidates.laws`, for all laws on signals
    rate      function (code, v, x, t, dt, p, s) of the user's own laws on forces and states; None: there are none
    forces    the same on a whole log, (code, t, v, x, p)
    memory    numbers that a law may remember at most; ``parameters``: that it may have
    own       the user's laws as the search has them, by what they act on
    python    why numba cannot compile one of them; "": it can
    """

    transform: Function = laws.transform
    apply: Function = laws.apply
    argument: Function = laws.argument
    rate: Function | None = None
    forces: Function | None = None
    memory: int = laws.MEMORY
    parameters: int = laws.PARAMETERS
    own: dict[str, dict[str, library.Law]] = field(default_factory=dict)
    python: str = ""


def compiled_code(f: Any, done: dict[int, Any] | None = None, in_a_tuple: bool = False) -> Any:
    """A user's function compiled, with the functions of the same file that it calls.

    in_a_tuple  what it returns in a list or an array comes in a tuple, where that is all the same to it
    """
    if hasattr(f, "py_func") or not isinstance(f, types.FunctionType):
        return f if hasattr(f, "py_func") else njit(error_model="numpy", nogil=True)(f)
    done = {} if done is None else done
    if id(f) in done:
        return done[id(f)]
    done[id(f)] = f  # a function that calls itself
    helpers = {
        name: compiled_code(other, done)
        for name in f.__code__.co_names
        if isinstance(other := f.__globals__.get(name), types.FunctionType) and other.__module__ == f.__module__
    }
    if helpers:
        g = types.FunctionType(f.__code__, {**f.__globals__, **helpers}, f.__name__, f.__defaults__, f.__closure__)
        g.__module__ = f.__module__
    else:
        g = f
    if in_a_tuple:  # under another name: another function may call it, which then gets its list
        named = types.FunctionType(g.__code__, g.__globals__, f"{f.__name__}_in_a_tuple", g.__defaults__, g.__closure__)
        named.__module__ = g.__module__
        return kept_njit(named, error_model="numpy", nogil=True, pipeline_class=InATuple)
    done[id(f)] = kept_njit(g, error_model="numpy", nogil=True)
    return done[id(f)]


def dispatch_of(own: Sequence[Law]) -> Dispatch:
    """The library's laws and these."""
    if not own:
        return Dispatch()
    numbered = [(FIRST_CODE[law.on] + i, law) for i, law in enumerate(own)]
    families: dict[str, dict[str, library.Law]] = {on: {} for on in FIRST_CODE}
    for code, law in numbered:
        families[law.on][law.name] = law.as_of_library(code)
    out = Dispatch(own=families)
    out.memory = max(laws.MEMORY, *(law.memory for law in own))
    out.parameters = max(laws.PARAMETERS, *(len(law.parameters) for law in own))
    try:
        _put(out, numbered, compiled_code)
        _call(out, numbered)
    except Exception as e:  # numba says so in many ways
        out.python = f"law {_culprit(out, numbered)!r}: {cannot(e)}"
        _put(out, numbered, lambda f: getattr(f, "py_func", f))
    return out


def _put(out: Dispatch, numbered: Sequence[tuple[int, Law]], jit: Function) -> None:
    space: dict[str, Any] = {"np": np, "jit": jit, "known": laws.transform, "MEMORY": out.memory}
    cases: dict[bool, list[str]] = {True: [], False: []}  # of signals; of what moves
    for code, law in numbered:
        space[f"law_{code}"] = jit(law.function)
        space[f"P_{code}"] = namedtuple(f"P_{code}", [p.name for p in law.parameters])
        place = {"signal": "u[k]", "force": "v, x", "state": "v"}[law.on]
        when = "t[k]" if law.on == "signal" else "t"
        sizes = "".join(f"p[{i}], " for i in range(len(law.parameters)))
        rest = f"{when}, dt, P_{code}({sizes}), s" if law.memory else f"{when}, P_{code}({sizes})"
        cases[law.on == "signal"].append(f"    if code == {code}:\n        return float(law_{code}({place}, {rest}))")
    source = _SOURCE.replace("{signals}", "\n".join(cases[True])).replace("{rates}", "\n".join(cases[False]))
    exec(compile(source, "<laws>", "exec"), space)
    mine = {"transform": space["transform"], "MEMORY": out.memory}
    out.transform, out.rate, out.forces = space["transform"], space["rate"], space["forces"]

    def anew(f: Any) -> Function:
        """A function of the library with these laws in place of its own."""
        code = types.FunctionType(f.py_func.__code__, {**f.py_func.__globals__, **mine}, f.__name__)
        return cast("Function", jit(code))

    out.apply, out.argument = anew(laws.apply), anew(laws.argument)


# dt at the first sample is 0, and the memory is cleared there: of a log, or of a window that starts anew
_SOURCE = """
@jit
def transform(code, k, t, u, p, s):
    if code < 100:
        return known(code, k, t, u, p, s)
    dt = 0.0
    if k > 0:
        dt = t[k] - t[k - 1]
    else:
        s[:] = 0.0
{signals}
    return u[k]


@jit
def rate(code, v, x, t, dt, p, s):
    if dt == 0.0:
        s[:] = 0.0
{rates}
    return 0.0


@jit
def forces(code, t, v, x, p):
    s = np.zeros(MEMORY)
    out = np.empty(len(v))
    for k in range(len(v)):
        out[k] = rate(code, v[k], x[k], t[k], t[k] - t[k - 1] if k > 0 else 0.0, p, s)
    return out
"""


def _call(out: Dispatch, numbered: Sequence[tuple[int, Law]]) -> None:
    """Compile all that may be called."""
    p = np.zeros(out.parameters + 1)
    code, law = numbered[0]
    p[: len(law.parameters)] = [q.value for q in law.parameters]
    t = np.zeros(1)
    assert out.forces is not None
    if any(law.on == "signal" for _, law in numbered):
        out.apply(FIRST_CODE["signal"] - 1, t, t, p)
        out.argument(FIRST_CODE["signal"] - 1, 0.0, p)
    if any(law.on != "signal" for _, law in numbered):
        out.forces(FIRST_CODE["signal"] - 1, t, t, t, p)


def _culprit(out: Dispatch, numbered: Sequence[tuple[int, Law]]) -> str:
    """Name of the law that numba cannot compile."""
    for one in numbered:
        try:
            alone = Dispatch(memory=out.memory, parameters=out.parameters)
            _put(alone, [one], compiled_code)
            _call(alone, [one])
        except Exception:
            return one[1].name
    return numbered[0][1].name


def try_law(law: Law, place: str, size: library.Size) -> None:
    """Call a user's law over the range of the data at a place: at neutral it must change nothing, at every start be a
    finite number.

    Raises StageError, one line.
    """
    t = size.step * np.arange(9)
    u = np.linspace(size.low, size.high, 9)
    v = size.speed * np.array([0.0, 0.5, 1.5, 0.5, -0.5, -1.5, -0.5, 0.5, 0.0])
    x = size.travel * np.linspace(-1.0, 1.0, 9)
    sizes: Any = namedtuple("sizes", [p.name for p in law.parameters])  # type: ignore[misc]
    neutral = tuple(float(p.value) for p in law.parameters)
    function = getattr(law.function, "py_func", law.function)
    for values in (neutral, *law.sizes()):
        said = ", ".join(f"{p.name} {value:g}" for p, value in zip(law.parameters, values, strict=True))
        memory: Array = np.zeros(law.memory)
        for k in range(len(t)):
            at = {"signal": (u[k],), "force": (v[k], x[k]), "state": (u[k],)}[law.on]
            rest = (t[k], size.step if k else 0.0, sizes(*values), memory) if law.memory else (t[k], sizes(*values))
            here = ", ".join(f"{n} = {z:.4g}" for n, z in zip(law.arguments(), at, strict=False))
            try:
                y = function(*map(float, at), *rest)
            except Exception as e:
                raise StageError(
                    f"law {law.name!r} on {place}: failed{place_of(e)} with {said} at {here}: {type(e).__name__}: {e}"
                ) from None
            if np.ndim(y) != 0 or isinstance(y, str | complex) or y is None or not np.isfinite(y):
                raise StageError(
                    f"law {law.name!r} on {place}: returned {y!r} with {said} at {here}; a finite number is needed"
                )
            nothing = at[0] if law.on == "signal" else 0.0
            scale = max(abs(nothing), size.greatest) if law.on == "signal" else max(size.force, size.rate)
            if values == neutral and abs(float(y) - nothing) > 1e-9 * scale:
                raise StageError(
                    f"law {law.name!r} on {place}: must change nothing at its neutral sizes ({said}), but gives "
                    f"{float(y):.6g} at {here}; {nothing:.6g} is needed"
                )
