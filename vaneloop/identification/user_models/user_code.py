"""The functions that a user wrote for a system, called with named tuples, and the file that they stand in; what goes
wrong in them becomes one line.
"""

from __future__ import annotations

import importlib.util
import itertools
import sys
import traceback
import types
import warnings
from collections import Counter, namedtuple
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core import compiler, ir
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.ir_utils import build_definitions, find_callname, guard
from numba.core.untyped_passes import ReconstructSSA

from vaneloop.identification.settings import SAME_EQUATION
from vaneloop.identification.subsystem import Array, StageError
from vaneloop.identification.user_models.system import System

__all__ = ["FormerName", "InATuple", "UserCode", "cannot", "load_system", "place_of"]


class UserCode:
    """The functions of a system.

    P, U, X, Y, R   types of their arguments: parameters, what drives the model, states, outputs, and what the control
                    follows
    single, single_out, single_control   the model, output or control returns a number and no sequence
    accelerations   outputs that are the derivative of a velocity, as `_accelerations` has them
    """

    def __init__(self, system: System, in_names: list[str]):
        self.system, self.in_names = system, in_names
        self.single = self.single_out = self.single_control = False
        self.accelerations: list[tuple[int, int, float]] = []
        s = system
        self.P = _tuple_type("P", [p.name for p in s.parameters])
        self.U = _tuple_type("U", list(s.commands) if s.kind == "closed_loop" else self.in_names)
        self.X = _tuple_type("X", list(s.states))
        self.Y = _tuple_type("Y", list(s.outputs))
        self.R = _tuple_type("R", self.in_names)

    def call(self, what: str, f: Callable[..., Any], *args: Any) -> Any:
        """Call a function of the user; its exception becomes one line."""
        try:
            return f(*args)
        except StageError:
            raise
        except Exception as e:
            fields = getattr(getattr(e, "obj", None), "_fields", None)
            why = (
                f"no {e.name!r} among {', '.join(fields)}"
                if isinstance(e, AttributeError) and fields
                else f"{type(e).__name__}: {e}"
            )
            raise StageError(f"system {self.system.name!r}: {what} failed{place_of(e)}: {why}") from None

    def flat(self, what: str, value: Any, n: int, of: str) -> list[float]:
        """What a function returned, as ``n`` numbers; else one line says what it should be."""
        values = list(value) if isinstance(value, tuple | list | np.ndarray) and np.ndim(value) else [value]
        if len(values) != n:
            raise StageError(
                f"system {self.system.name!r}: {what} returned {len(values)} values; {n} are needed ({of})"
            )
        for name, v in zip(of.split(", "), values, strict=True):
            if np.ndim(v) != 0:
                raise StageError(
                    f"system {self.system.name!r}: {what} returned an array of shape {np.shape(v)} for {name}; a "
                    f"number is needed"
                )
            if isinstance(v, str | complex | np.complexfloating) or v is None:
                raise StageError(
                    f"system {self.system.name!r}: {what} returned {v!r} for {name} at the first sample; a number is "
                    f"needed"
                )
            if not np.isfinite(v):
                raise StageError(
                    f"system {self.system.name!r}: {what} returned {v} for {name} at the first sample; it must be "
                    f"finite"
                )
        return [float(v) for v in values]

    def try_once(self, states: Sequence[float], drives: Array, measured: Array) -> None:
        """Call each function of a simulation at the first sample and see what it returns."""
        s = self.system
        p = self.P(*[q.value for q in s.parameters]) if s.parameters else self.P(0.0)
        x = self.X(*states)
        r = self.R(*drives) if self.in_names else self.R(0.0)
        control = s.control
        if s.kind == "closed_loop":
            assert control is not None
            y = self.Y(*[float(v) if np.isfinite(v) else 0.0 for v in measured])
            got = self.call("control", control, r, y, p)
            u = self.U(*self.flat("control", got, len(s.commands), ", ".join(s.commands)))
            self.single_control = np.ndim(got) == 0
        else:
            u, self.single_control = r, False
        d = self.call("model", s.model, x, u, p)
        self.flat("model", d, len(s.states), ", ".join(s.states))
        self.single = np.ndim(d) == 0
        self.single_out = False
        if s.output is not None:
            o = self.call("output", s.output, x, u, p)
            self.flat("output", o, len(s.outputs), ", ".join(s.outputs))
            self.single_out = np.ndim(o) == 0

    def find_accelerations(self, sizes: Sequence[float], drives: Array) -> None:
        """Find the outputs that are accelerations by the model's own equations: (output, velocity, factor).

        Such an output is a constant factor times the derivative of a velocity, and whatever else the inputs give. It is
        one if it follows that derivative through `SAME_EQUATION` states and parameters drawn at random. What a law does
        to the motion an accelerometer then feels, though the user's formula cannot know of the law.

        sizes   of the states; ``drives``: values of the inputs, float64[inputs, samples]
        """
        s, rng = self.system, np.random.default_rng(0)
        if s.kind != "simulate" or s.output is None or not s.rates or not s.parameters:
            return
        values = np.array([q.value for q in s.parameters])
        usual = np.where(values == 0.0, 1.0, values)
        low, high = (np.array([getattr(q, side) for q in s.parameters]) for side in ("low", "high"))
        rows = []  # of each input: what outputs and derivatives are, of what they are at its first draw of the others
        for u in drives[:, rng.integers(0, drives.shape[1], 4)].T if len(drives) else np.zeros((4, 1)):
            drawn: list[tuple[Array, ...]] = []
            for k in range(SAME_EQUATION // 4 + 1):
                # by turns the states alone, and the parameters alone
                x = rng.standard_normal(len(sizes)) * sizes if k % 2 or not drawn else drawn[-1][0]
                p = np.clip(usual * 2.0 ** rng.uniform(-1, 1, len(usual)), low, high) if not k % 2 else drawn[-1][1]
                args = self.X(*x), self.U(*u), self.P(*p)
                try:
                    with np.errstate(all="ignore"):
                        both = [np.atleast_1d(np.asarray(f(*args), dtype=float)) for f in (s.output, s.model)]
                except Exception:  # the user's model may be nothing there
                    return
                drawn.append((x, p, *both))
            rows += [(b[2] - a[2], b[3] - a[3]) for a, b in itertools.pairwise(drawn)]
        outputs, rates = (np.array([r[i] for r in rows]) for i in (0, 1))
        turned = np.arange(len(rows)) % (SAME_EQUATION // 4) % 2 == 1  # the parameters alone changed
        for w in (list(s.states).index(v) for v in s.rates):
            d = rates[:, w]
            if not (np.isfinite(d).all() and d[turned].any() and d[~turned].any()):
                continue
            for o, y in enumerate(outputs.T):
                factor = float(y @ d / (d @ d)) if np.isfinite(y).all() else 0.0
                if factor and np.all(np.abs(y - factor * d) <= 1e-9 * np.max(np.abs(y))):
                    self.accelerations.append((o, w, factor))

    def static(self, p: Array, u: Array, t: Array, check: bool = False) -> Array:
        """Outputs float64[outputs, samples] of a model of kind static or force, driven by ``u`` at times ``t``."""
        s = self.system
        n = len(t)
        args = self.R(*u) if len(u) else self.R(np.zeros(n))
        values = self.call("model", s.model, args, self.P(*p) if len(p) else self.P(0.0))
        rows = list(values) if isinstance(values, tuple | list) else [values]
        if len(rows) != len(s.outputs) and np.ndim(values) == 2:
            rows = list(np.asarray(values))
        if len(rows) != len(s.outputs):
            raise StageError(
                f"system {s.name!r}: model returned {len(rows)} values; {len(s.outputs)} are needed "
                f"({', '.join(s.outputs)})"
            )
        out = np.empty((len(rows), n))
        for i, (name, row) in enumerate(zip(s.outputs, rows, strict=True)):
            row = np.asarray(row, dtype=float)
            if row.shape not in ((), (n,)):
                raise StageError(
                    f"system {s.name!r}: model returned shape {row.shape} for {name}; ({n},) is needed, one value a "
                    f"sample"
                )
            if check and not np.all(np.isfinite(row)):
                k = int(np.flatnonzero(~np.isfinite(np.broadcast_to(row, (n,))))[0])
                raise StageError(
                    f"system {s.name!r}: model returned {np.broadcast_to(row, (n,))[k]} for {name} "
                    f"at t = {t[k]:g} s; it must be finite"
                )
            out[i] = row
        return out


def _tuple_type(name: str, fields: Sequence[str]) -> Any:
    return namedtuple(name, list(fields) or ["nothing"])


def place_of(e: BaseException) -> str:
    """Where in the user's file an exception came from."""
    ours = str(Path(__file__).parents[1]), str(Path(numba.__file__).parent), "<frozen"
    frames = [f for f in traceback.extract_tb(e.__traceback__) if not f.filename.startswith(ours)]
    return f" at line {frames[-1].lineno} of {Path(frames[-1].filename).name}" if frames else ""


def cannot(e: BaseException) -> str:
    """Why numba cannot compile a function of the user, in some words."""
    if "IMPORT_NAME" in str(e):
        return "an import inside a function; it belongs at the top of the file"
    said = [line.strip() for line in str(e).splitlines() if line.strip() and "nopython" not in line]
    return (said[0] if said else type(e).__name__)[:100]


# ---- How a user's function is compiled that returns a list

# what has no types
_register: Any = register_pass
_Expr: Any = ir.Expr
_definitions: Any = build_definitions
_guard: Any = guard
_usual: Any = compiler.DefaultPassBuilder.define_nopython_pipeline
ARRAYS = {("array", "numpy"), ("asarray", "numpy")}  # what makes an array of a list


@_register(mutates_CFG=False, analysis_only=False)
class _ReturnTuples(FunctionPass):
    """``return [a, b]`` and ``return np.array([a, b])`` return ``(a, b)``."""

    _name = "vaneloop_return_tuples"

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]

    def run_pass(self, state: Any) -> bool:
        """Where each return gives a tuple, or a list of the same length that nothing else uses."""
        ends = _ends(state.func_ir)
        for made, unpacked in ends or ():
            made.value = _Expr.build_tuple(items=made.value.items, loc=made.value.loc)
            if unpacked is not None:
                unpacked.value = made.target
        if ends:
            state.func_ir._definitions = _definitions(state.func_ir.blocks)
        return bool(ends)


class InATuple(compiler.CompilerBase):
    """numba's compiler with that pass."""

    def define_pipelines(self) -> list[Any]:
        """The usual ones."""
        passes = _usual(self.state)
        passes.add_pass_after(_ReturnTuples, ReconstructSSA)
        passes.finalize()
        return [passes]


def _ends(func_ir: Any) -> list[tuple[Any, Any]]:
    """Of each return of a list: the statement that makes the list, and the one that makes an array of it or None."""
    statements = [s for block in func_ir.blocks.values() for s in block.body if not isinstance(s, ir.Del)]
    sets = {s.target.name: s for s in statements if isinstance(s, ir.Assign)}
    defined = Counter(s.target.name for s in statements if isinstance(s, ir.Assign))
    used = Counter(v.name for s in statements for v in s.list_vars())  # its definition, and each use
    ends, lengths = [], set()
    for end in (s for s in statements if isinstance(s, ir.Return)):
        name, array = end.value.name, None
        while True:
            s = sets.get(name)
            if s is None or defined[name] != 1 or used[name] != 2:
                return []
            value = s.value
            if isinstance(value, ir.Var):
                name = value.name
            elif not isinstance(value, ir.Expr):
                return []
            elif value.op == "cast":
                name = value.value.name
            elif value.op == "call" and array is None and _makes_array(func_ir, value):
                name, array = value.args[0].name, s
            elif value.op == "build_list" and value.items:
                ends.append((s, array))
                break
            elif value.op == "build_tuple" and array is None:
                break
            else:
                return []
        lengths.add(len(value.items))
    return ends if len(lengths) == 1 else []


def _makes_array(func_ir: Any, call: Any) -> bool:
    return _guard(find_callname, func_ir, call) in ARRAYS and len(call.args) == 1 and not call.kws and not call.vararg


# ---- The file in which a user describes a system


class FormerName(types.ModuleType):
    """A former name of `vaneloop.identification`: it still has the public names there, and warns of each."""

    def __getattr__(self, name: str) -> Any:
        """A public name of the package."""
        package = sys.modules["vaneloop.identification"]
        if name not in package.__all__:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        warnings.warn(
            f"{self.__name__}.{name} is now vaneloop.identification.{name}; the former name goes with the next version",
            FutureWarning,
            stacklevel=2,
        )
        return getattr(package, name)


def load_system(path: str | Path) -> System:
    """Read a user's model file: a Python file in which a `System` stands, whatever its name.

    Raises StageError, one line, for a file that is absent, does not run, or has no System or more than one.
    """
    path = Path(path)
    if not path.is_file():
        raise StageError(
            f"{path}: no such file; --system wants a Python file with a System in it (docs/your_own_model.md)"
        )
    name = f"_system_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise StageError(f"{path}: is not a Python file (*.py)")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(path.parent.resolve()))
    older = importlib.util.find_spec("discrepancy") is None
    if older:
        sys.modules["discrepancy"] = FormerName("discrepancy")
    try:
        spec.loader.exec_module(module)
    except StageError as e:
        raise StageError(f"{path}: {e}") from None
    except SyntaxError as e:
        raise StageError(f"{path}: line {e.lineno}: {e.msg}") from None
    except Exception as e:
        raise StageError(f"{path}: failed{place_of(e)}: {type(e).__name__}: {e}") from None
    finally:
        sys.path.remove(str(path.parent.resolve()))
        if older:
            del sys.modules["discrepancy"]
    found = {id(v): v for v in vars(module).values() if isinstance(v, System)}
    if len(found) != 1:
        raise StageError(
            f"{path}: {len(found)} objects of vaneloop.System; exactly one is needed, as in system = System(...)"
        )
    return next(iter(found.values()))
