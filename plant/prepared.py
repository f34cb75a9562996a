"""What a part of the plant needs of a lane of parameters, worked out once: numbers of its own, and those of every
effect at its sites.

An effect's parameter has the effect's name, with the parameter's behind it where the effect has several:
``linkage_wear``, ``piston_stiction_speed``. Of a parameter of the vane stages it is that of the stage. So a new effect
is there for the part that calls its ``step``.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from typing import Any

from plant.effects import EFFECTS, ROW
from plant.lanes import compiled_text

__all__ = ["with_effects"]


def with_effects(
    kind: type[Any], numbers: Callable[..., Any], arguments: str, *sites: str
) -> tuple[Any, Callable[..., Any]]:
    """Return a NamedTuple of ``kind``'s name, with its fields and those of the effects at these ``sites``, and the
    compiled function (``arguments``) that gives it from the parameters ``p`` of lane ``j``, stage ``k``.

    numbers  compiled function of the same arguments that gives ``kind``
    """
    rows: dict[str, str] = {}
    for e in EFFECTS.values():
        if e.site in sites:
            of_stage = any(q.vane for q in e.parameters)
            for i, q in enumerate(e.parameters):
                name = e.name if q.vane or len(e.parameters) == 1 else f"{e.name}_{q.name}"
                rows.setdefault(name, f"p[{ROW[e.name] + i}{' + k' if of_stage and q.vane else ''}, j]")
    made: Any = namedtuple(kind.__name__, [*kind._fields, *rows])  # type: ignore[misc]
    made.__module__, made.__doc__ = kind.__module__, kind.__doc__
    given = ", ".join([*(f"v.{name}" for name in kind._fields), *rows.values()])
    lines = f"def f({arguments}):\n    v = numbers({arguments})\n    return Kind({given})\n"
    return made, compiled_text(lines, {"Kind": made, "numbers": numbers})
