"""The same system and logs, said differently: an answer that changes with the units, the order or the start is luck."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from vaneloop import Record, System

__all__ = ["SCALES", "reordered_laws", "rescaled", "variants"]

SCALES = {"time x 0.05": 0.05, "time x 20": 20.0, "channels x 1000": 1000.0, "channels x 0.001": 0.001}
Case = Any
Setting = tuple[System, list[Record], list[Record]]


def rescaled(system: System, time: float, factor: dict[str, float]) -> System:
    """The same model in another unit of time and of channels: t' = time t, c' = factor[c] c."""
    from numba import njit

    s = system
    position = s.position
    names = {**{c: factor.get(c, 1.0) for c in (*s.states, *s.outputs, *s.inputs, *s.commands)}}
    if position is not None:
        names |= {
            "position": factor.get(position, 1.0), "velocity": factor.get(position, 1.0) / time,
            "acceleration": factor.get(position, 1.0) / time**2,
        }  # fmt: skip
    fields: dict[str, list[str]] = {
        "x": list(s.states), "y": list(s.outputs),
        "u": list(s.commands) or [*(["position", "velocity", "acceleration"] if position else []), *s.inputs],
        "r": list(s.inputs),
    }  # fmt: skip
    from collections import namedtuple

    space: dict[str, Any] = {k.upper(): namedtuple(k.upper(), v or ["nothing"]) for k, v in fields.items()}
    simple = s.kind in ("static", "force")

    def old(kind: str) -> str:
        """The tuple ``kind`` in the model's own units."""
        if not fields[kind]:
            return f"{kind.upper()}(0.0,)"
        return f"{kind.upper()}({', '.join(f'{kind}.{n} * {1.0 / names[n]!r}' for n in fields[kind])},)"

    def wrap(what: str, f: Any, arguments: str, out: list[float]) -> Any:
        space[f"f_{what}"] = f if simple else njit(error_model="numpy", nogil=True)(f)
        given = ", ".join(a if a == "p" else old(a) for a in arguments.replace(" ", "").split(","))
        values = [f"d[{i}] * {v!r}" for i, v in enumerate(out)] if len(out) > 1 else [f"d * {out[0]!r}"]
        source = f"def {what}({arguments}):\n    d = f_{what}({given})\n    return {', '.join(values)}\n"
        exec(compile(source, f"<{s.name}>", "exec"), space)
        return space[what]

    ends = [names[o] for o in s.outputs]
    if simple:
        model = wrap("model", s.model, "u, p", ends)
    else:
        model = wrap("model", s.model, "x, u, p", [names[n] / time for n in s.states])
    return System(
        s.name, s.kind, model, s.outputs, s.inputs, s.parameters, s.position, s.velocity,
        s.cutoff / time if s.cutoff else None, s.start_force, s.states, s.rates, s.masses, s.force_unit,
        wrap("output", s.output, "x, u, p", ends) if s.output else None,
        {k: v * names[k] for k, v in s.start.items()}, s.window * time if s.window else None, s.between,
        wrap("control", s.control, "r, y, p", [names[c] for c in s.commands]) if s.control else None, s.commands,
        s.places, s.read, s.units,
    )  # fmt: skip


def _factors(case: Case, system: System, value: float, time: float, only: str | None = None) -> dict[str, float]:
    """Factor of every channel and state; a velocity follows its displacement and the time."""
    every = [*system.states, *system.outputs, *system.inputs, *system.commands]
    every += [system.position] if system.position else []
    out = {c: value if only is None or c == only else 1.0 for c in every}
    for v, x in system.rates.items():
        if only in (v, x):
            out[v] = out[x] = value
        out[v] = out[x] / time
    return out


def _records(records: list[Record], time: float, factor: dict[str, float]) -> list[Record]:
    return [Record(r.name, r.t * time, {k: v * factor.get(k, 1.0) for k, v in r.columns.items()}) for r in records]


@contextmanager
def reordered_laws() -> Iterator[None]:
    """The library's laws in reverse order."""
    from vaneloop.identification.candidates.library import LAWS

    def turn() -> None:
        for laws in LAWS.values():
            items = list(laws.items())[::-1]
            laws.clear()
            laws.update(items)

    turn()
    try:
        yield
    finally:
        turn()


def _cut(records: list[Record]) -> list[Record]:
    out = []
    for r in records:
        n = len(r.t) // 2
        for k, at in enumerate((slice(0, n), slice(n, None))):
            out.append(Record(f"{r.name}{'ab'[k]}", r.t[at], {c: v[at] for c, v in r.columns.items()}))
    return out


def variants(case: Case, records: list[Record], nominal: Any) -> Iterator[tuple[str, Setting]]:
    """Name and setting (system, fitted logs, test logs) of each variant of a case. The library's laws stand in reverse
    order while the variant `reordered` is out.
    """
    f = case.family

    def build() -> System:
        return nominal(f, case.values, case.factors)

    for name, value in SCALES.items():
        time = value if name.startswith("time") else 1.0
        system = build()
        factor = _factors(case, system, 1.0 if name.startswith("time") else value, time)
        logs = _records(records, time, factor)
        yield name, (rescaled(system, time, factor), logs[:-1], logs[-1:])
    if not any(h.law in ("absolute_value", "quadratic_drag", "square_root") for h in case.hidden):
        # these know which way is up: with another sign they are no law of the library
        system = build()
        which = next(iter(system.outputs)) if f.kind != "static" else next(iter(system.inputs))
        factor = _factors(case, system, -1.0, 1.0, which)
        logs = _records(records, 1.0, factor)
        yield "a sign flipped", (rescaled(system, 1.0, factor), logs[:-1], logs[-1:])
    system = build()
    system.parameters = list(system.parameters)[::-1]
    with reordered_laws():
        yield "reordered", (system, records[:-1], records[-1:])
    rng = np.random.default_rng([*case.seed, 77])
    again = {k: float(10.0 ** rng.uniform(-1.0, 1.0)) for k in case.factors}
    yield "other starts", (nominal(f, case.values, again), records[:-1], records[-1:])
    if all(s in system.outputs for s in system.states):  # else the second half starts in a state that nobody knows
        yield "logs cut in two", (build(), _cut(records[:-1]), records[-1:])
