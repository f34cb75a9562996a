"""Many parameter sets side by side: the fields of a NamedTuple as rows of ``width`` lanes in one block of memory.

A block is one record, so that the compiler sees constant strides and no two rows that could be the same memory; it then
turns a loop over lanes into vector instructions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit

__all__ = ["block", "getter", "putter"]


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


def _compiled(source: str, space: dict[str, Any]) -> Callable[..., Any]:
    exec(source, space)  # noqa: S102
    out: Callable[..., Any] = njit(error_model="numpy", forceinline=True)(space["f"])
    return out


def getter(kind: type[NamedTuple], which: str = "", **known: float) -> Callable[..., Any]:
    """Compiled function (block, lane) -> ``kind``: what stands there; ``which`` "k": (block, k, lane).

    known  fields that are these numbers in every lane, whatever stands there
    """
    at = f"{which}, j" if which else "j"
    fields = (repr(known[n]) if n in known else f"b.{n}[{at}]" for n in kind._fields)
    return _compiled(f"def f(b, {at}): return Kind({', '.join(fields)})", {"Kind": kind})


def putter(kind: type[NamedTuple], which: str = "") -> Callable[..., Any]:
    """Compiled function (block, lane, ``kind``) that puts it there; ``which`` as of `getter`."""
    at = f"{which}, j" if which else "j"
    lines = "".join(f"    b.{n}[{at}] = v.{n}\n" for n in kind._fields)
    return _compiled(f"def f(b, {at}, v):\n{lines}", {})
