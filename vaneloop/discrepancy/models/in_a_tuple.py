"""How a user's function is compiled that returns a list: numba makes a list in memory at each call, which takes longer
than most models themselves. What only leaves the function becomes a tuple, which stays in registers.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from numba.core import compiler, ir
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.ir_utils import build_definitions, find_callname, guard
from numba.core.untyped_passes import ReconstructSSA

__all__ = ["InATuple"]

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
