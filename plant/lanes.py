"""Many parameter sets side by side: the fields of a NamedTuple as rows of ``width`` lanes in one block of memory.

A block is one record, so that the compiler sees constant strides and no two rows that could be the same memory; it then
turns a loop over lanes into vector instructions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from vaneloop.base.lean import called_by_code

__all__ = ["block", "compiled_text", "filler", "getter", "on_stack", "putter", "wide_vectors"]


def block(
    width: int,
    *kinds: type[NamedTuple],
    more: tuple[str, ...] = (),
    each: tuple[int, tuple[type[NamedTuple], ...], tuple[str, ...]] = (0, (), ()),
) -> np.dtype[np.void]:
    """Layout of a block: every field of the ``kinds``, and ``more``, ``width`` lanes each.

    each  how often, kinds and names that a lane has several times: [k, lane]
    """
    count, of_each, more_of_each = each
    once = [*(name for kind in kinds for name in kind._fields), *more]
    several = [*(name for kind in of_each for name in kind._fields), *more_of_each]
    if len({*once, *several}) != len(once) + len(several):
        raise ValueError(f"a name stands twice among {', '.join([*once, *several])}")
    shapes: list[tuple[int, ...]] = [(width,)] * len(once) + [(count, width)] * len(several)
    return np.dtype([(name, np.float64, shape) for name, shape in zip([*once, *several], shapes, strict=True)])


def compiled_text(source: str, space: dict[str, Any]) -> Callable[..., Any]:
    """Compiled function ``f`` of a text of Python, inlined where it is called; ``space``: names that the text uses."""
    exec(source, space)  # noqa: S102
    options: dict[str, Any] = {"error_model": "numpy", "forceinline": True, "no_cfunc_wrapper": True}
    out: Callable[..., Any] = njit(**options)(space["f"])
    return called_by_code(out)


def getter(kind: type[NamedTuple], which: str = "", prefix: str = "", **known: float) -> Callable[..., Any]:
    """Compiled function (block, lane) -> ``kind``: what stands there; ``which`` "k": (block, k, lane).

    prefix before the names of the fields in the block
    known  fields that are these numbers in every lane, whatever stands there
    """
    at = f"{which}, j" if which else "j"
    fields = (repr(known[n]) if n in known else f"b.{prefix}{n}[{at}]" for n in kind._fields)
    return compiled_text(f"def f(b, {at}): return Kind({', '.join(fields)})", {"Kind": kind})


def putter(kind: type[NamedTuple], which: str = "", prefix: str = "") -> Callable[..., Any]:
    """Compiled function (block, lane, ``kind``) that puts it there; ``which`` and ``prefix`` as of `getter`."""
    at = f"{which}, j" if which else "j"
    lines = "".join(f"    b.{prefix}{n}[{at}] = v.{n}\n" for n in kind._fields)
    return compiled_text(f"def f(b, {at}, v):\n{lines}", {})


def filler(names: dict[str, int], prefix: str, put: bool) -> Callable[..., Any]:
    """Compiled function (block, lane, record) that fills the record from the block; ``put``: the block from the record.

    names   of the record's numbers, and how many there are of each: 0 for one that is no array
    prefix  before these names in the block
    """
    lines = []
    for name, count in names.items():
        for q in range(count or 1):
            own, there = (f"v.{name}[{q}]", f"{name}[{q}, j]") if count else (f"v.{name}", f"{name}[j]")
            lines.append(f"    b.{prefix}{there} = {own}\n" if put else f"    {own} = b.{prefix}{there}\n")
    return compiled_text(f"def f(b, j, v):\n{''.join(lines)}", {})


def _on_stack(_: Any, layout: Any) -> Any:
    """Return a record of the dtype ``layout`` in the frame of the compiled function that calls this; not filled.

    The compiler keeps its numbers in registers where it can, so a function that works on a record works on lanes, too.
    """
    kind = layout.dtype

    def build(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        there = _helpers.alloca_once(builder, ir.ArrayType(ir.IntType(8), kind.size))
        return builder.bitcast(there, context.get_value_type(kind))

    return kind(layout), build


def _wide_vectors(_: Any) -> Any:
    """Let the compiler use the processor's widest vectors in the compiled function that calls this.

    Of many processors with vectors of 512 bits it prefers halves. Each function with a loop over lanes says so itself:
    it is vectorised before it is inlined. Others are as quick with halves, or quicker.
    """

    def build(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')  # llvmlite does not list it
        return context.get_dummy_value()

    return types.void(), build


_helpers: Any = cgutils
on_stack: Any = intrinsic(_on_stack)
wide_vectors: Any = intrinsic(_wide_vectors)
