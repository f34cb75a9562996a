"""Whether a learned law is a hidden one by the model's equations, wherever and of whatever it was said.

A current's curve and a flow's are one law where the flow follows the current; a damping times a function of the speed
is a force of the speed. So both are put into the true model, one at a time, and what they change in its derivatives and
outputs is compared: not along a log, where a function of time can be anything, but at values of its states and inputs
that are drawn independently of each other from those that the logs visited. The learned law is the hidden one where
that change is within its band, propagated in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from benchmarks.blind import Row
from vaneloop.identification.candidates.closed_forms import values_of
from vaneloop.identification.unmodelled.regressors import quantities
from vaneloop.identification.user_models.terms import INPUT, OUTPUT
from vaneloop.identification.user_models.user_code import UserCode

__all__ = ["same_by_equations"]

DRAWN = 400  # values of states and inputs
ALIKE = 0.02  # of the hidden law's change, RMS: a formula that is nearer is that law
Array = np.ndarray


def same_by_equations(law: Any, bound: Any, model: Any, at: str, of: str, value: Callable[[Array], Array]) -> Row:
    """Share of the drawn values at which a hidden law is within a learned one's band, and whether a formula that was
    given is the hidden law; as of `benchmarks.blind.as_curve`.

    law    as learned, on the logs in ``bound``; ``model``: with the true parameters
    at, of, value   place, quantity ("": none) and curve of the hidden law
    """
    world = _World(bound, model)
    own = {
        **dict.fromkeys(world.inputs, "input adds"),
        **dict.fromkeys(model.states, "state adds"),
        "force": "force adds",
    }
    how = own.get(at, "output adds")
    truth = world.change(how, at, value(world.known(of)))
    if not world.knows(law.of):  # a lag or a period that was fitted: no such law is hidden
        return {"inside": 0.0, "formula": False}
    q = world.known(law.of)

    def learned(y: Array) -> Array:
        return world.change(law.how, law.at, y)

    y, low, high = (np.interp(q, law.x, v) for v in (law.y, law.low, law.high))
    middle, ends = learned(y), [learned(low), learned(high)]
    taken = list(range(len(model.parameters))) if law.untold else []
    if law.how == "parameter times":
        taken.append([p.name for p in model.parameters].index(law.at))
    little = 1e-6 * np.max(np.abs(truth), axis=1, keepdims=True)
    bends = 1 in law.untold and np.ptp(value(world.known(of))) > 0.0  # a gain makes what bends larger, no constant
    # parameters may take what cannot be told, or nothing: least squares moves them a little for any difference at all
    offs = [truth - middle, world.less(truth - middle, taken, [truth] if bends else [])]
    below, above = np.minimum(ends[0], ends[1]) - middle - little, np.maximum(ends[0], ends[1]) - middle + little
    inside = max(float(np.all((below <= off) & (off <= above), axis=0).mean()) for off in offs)
    enough = ALIKE * np.sqrt(np.mean(truth**2, axis=1)) + little.T[0]
    near = []
    for f in law.formulas:
        off = truth - learned(values_of(f, q) + f.level)
        near += [np.all(np.sqrt(np.mean(left**2, axis=1)) <= enough) for left in (off, world.less(off, taken, []))]
    return {"inside": inside, "formula": bool(any(near))}


class _World:
    """A model with its true parameters at values of its states and inputs, drawn independently of each other."""

    def __init__(self, bound: Any, model: Any):
        rng = np.random.default_rng(0)
        self.model, self.code = model, UserCode(model, bound.data.in_names)
        self.inputs = list(model.commands) if model.kind == "closed_loop" else list(bound.data.in_names)
        starts = len(model.parameters) + len(bound.runner.free_starts)
        own = np.array([p.value for p in bound.stage.parameters[:starts]])
        self.values: dict[str, Array] = {}
        for q in quantities(bound, own):
            if q.less is not None:  # it follows from both, which come first
                one, other = q.sides
                self.values[q.name] = self.values[one] - self.values[other]
            elif not OUTPUT <= q.of < OUTPUT + INPUT and (good := q.visited[np.isfinite(q.visited)]).size:
                self.values[q.name] = rng.choice(good, DRAWN)
        self.p = np.array([p.value for p in model.parameters])
        self.plain = self._says(self.p)

    def knows(self, of: str) -> bool:
        """Whether a quantity is one of those."""
        return of in self.values or of in self.model.outputs

    def known(self, of: str) -> Array:
        """Values of a quantity there; of one that is an output, what the model says."""
        if of in self.values:
            return self.values[of]
        outputs = list(self.model.outputs)
        if of in outputs:
            return np.asarray(self.plain[len(self.plain) - len(outputs) + outputs.index(of)])
        return np.zeros(DRAWN)

    def change(self, how: str, at: str, c: Array) -> Array:
        """What a curve with values ``c`` changes in the derivatives, where there are any, and the outputs."""
        return self._says(self.p, how, at, c) - self.plain

    def less(self, off: Array, taken: Iterable[int], more: Iterable[Array]) -> Array:
        """What is left of a change when the parameters ``taken`` take what they can, and ``more`` changes."""
        lines = list(more)
        for k in dict.fromkeys(taken):
            p = self.p.copy()
            p[k] += 1e-4 * (abs(p[k]) or 1.0)
            lines.append((self._says(p) - self.plain) / (p[k] - self.p[k]))
        if not lines:
            return off
        size = np.maximum(np.std(self.plain, axis=1, keepdims=True), 1e-300)
        rows = np.array([(line / size).ravel() for line in lines]).T
        scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        got = np.linalg.lstsq(rows / scale, (off / size).ravel(), rcond=1e-9)[0] / scale
        return np.asarray(off - sum(g * line for g, line in zip(got, lines, strict=True)))

    def _says(self, p: Array, how: str = "", at: str = "", c: Array | float = 0.0) -> Array:
        s, code = self.model, self.code
        known = {q.name: np.full(DRAWN, v) for q, v in zip(s.parameters, p, strict=True)}
        mass = {x: known[m].copy() for x, m in s.masses.items()}
        u = {n: self.values.get(n, np.zeros(DRAWN)) for n in self.inputs}
        for space, kind in ((known, "parameter"), (u, "input")):
            if how.startswith(kind):
                space[at] = space[at] * (1.0 + c) if how.endswith("times") else space[at] + c
        with np.errstate(all="ignore"):
            if s.kind in ("static", "force"):
                rates = np.zeros((0, DRAWN))
                y = code.static(np.array(list(known.values())), np.array(list(u.values())), np.arange(float(DRAWN)))
            else:
                x = [self.values[n] for n in s.states]
                points = [
                    (code.X(*a), code.U(*b) if u else code.U(0.0), code.P(*d) if known else code.P(0.0))
                    for a, b, d in zip(
                        np.array(x).T, np.array(list(u.values())).T if u else np.zeros((DRAWN, 0)),
                        np.array(list(known.values())).T if known else np.zeros((DRAWN, 0)), strict=True,
                    )
                ]  # fmt: skip
                rates = np.array([np.atleast_1d(s.model(*a)) for a in points], dtype=float).T
                if how == "state adds":
                    rates[list(s.states).index(at)] -= c / mass.get(at, 1.0)
                if s.output is not None:
                    y = np.array([np.atleast_1d(s.output(*a)) for a in points], dtype=float).T
                else:
                    both = {**dict(zip(s.states, x, strict=True)), **u}
                    y = np.array([both[o] for o in s.outputs])
        if how.startswith(("output", "force")):
            k = 0 if how.startswith("force") else [s.reading_of(o) for o in s.outputs].index(at)
            y = y.copy()
            y[k] = y[k] * (1.0 + c) if how.endswith("times") else y[k] + c
        return np.vstack([rates, y])
