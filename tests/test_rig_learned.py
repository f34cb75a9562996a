"""Which curve a hidden law is, by the family's own equations: `tests.rig_systems.LEARNED` against them.

A curve is the law where one value of it, put in at its place, makes of the nominal equations those of the law, at any
states, inputs and time; and where that value is the same wherever its quantity is the same.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.rig_systems import FAMILIES, LEARNED, Family, draw_case
from tests.rig_systems.simulate import course

POINTS = 32
SAME = 1e-5  # of its greatest value: two values of a curve that are one
MINUS, WAY = "_minus_", "direction_of_"
NO_POINT = {
    "levitation": "in a closed loop what the controller gives drives the equations; none of its laws has a curve",
    "flow_loop stiction": "it remembers: no function of states, inputs and time",
    "rolling_ship cargo": "the nearest that there is: the model has one number for the lever and for what waves do",
}
LAWS = [(n, law) for n, f in FAMILIES.items() for law in f.outside if not {n, f"{n} {law}"} & {*NO_POINT}]
Point = dict[str, np.ndarray]


class Equations:
    """A family's equations with one of its laws, and without."""

    def __init__(self, f: Family, law: str):
        case = draw_case(31, 0, (f.name,), [law], 300)
        self.f, self.p, self.law = f, case.p, f.outside[law]
        self.size = case.hidden[0].values["size"]
        self.states = ("position", "velocity", "acceleration") if f.kind == "force" else f.states
        self.inputs = () if f.kind == "force" else tuple(f.inputs)
        self.moves = f.kind == "simulate"
        names = [*self.states, *self.inputs]
        ends = []
        for log in case.logs:
            _, x, u = course(f, case.p, [], log.t, log.drive, case.greatest)
            rows = [*(x if f.kind != "static" else ()), *(u if f.kind != "force" else ())]
            ends.append([(float(np.min(r)), float(np.max(r))) for r in rows])
        low, high = np.min(ends, axis=0), np.max(ends, axis=0)
        self.ranges = {name: (low[i, 0], high[i, 1]) for i, name in enumerate(names)}
        self.ranges["time"] = (0.0, 1.0)
        self.rng = np.random.default_rng(3)
        while np.mean((self.true(at := self.draw()) != self.nominal(at)).any(axis=0)) < 0.2:  # a rim above all levels
            self.ranges |= {name: (a, b + 0.5 * (b - a)) for name, (a, b) in self.ranges.items() if name != "time"}

    def draw(self) -> Point:
        """Anywhere in the ranges of a log, each by itself; in all draws from end to end."""
        return {name: np.array([*ends, *self.rng.uniform(*ends, POINTS - 2)]) for name, ends in self.ranges.items()}

    def parts(self, at: Point) -> list[np.ndarray]:
        """States and inputs."""
        return [np.array([at[n] for n in of]).reshape(len(of), POINTS) for of in (self.states, self.inputs)]

    def nominal(self, at: Point, p: Any = None) -> np.ndarray:
        """Derivatives, then outputs; ``p``: one set of parameters at each point."""
        x, u = self.parts(at)
        columns = []
        for k in range(POINTS):
            q = self.p if p is None else p[k]
            if self.moves:
                columns.append([*self.f.rhs(x[:, k], u[:, k], q), *self._shown(x[:, k], u[:, k], q)])
            else:
                columns.append([float(self.f.rhs((x if self.f.kind == "force" else u)[:, k], q))])
        return np.array(columns).T

    def _shown(self, x: np.ndarray, u: np.ndarray, p: Any) -> np.ndarray:
        if output := self.f.output:
            return np.array(output(x[:, None], u[:, None], p), dtype=float).ravel()
        return np.array([x[self.f.states.index(o)] for o in self.f.outputs])

    def true(self, at: Point) -> np.ndarray:
        """The same with the law."""
        x, u = self.parts(at)
        n = len(self.states) if self.moves else 0
        if self.law.source:
            u = np.array(self.law.source(at["time"], u, self.p, self.size))
            at = {**at, **dict(zip(self.inputs, u, strict=True))}
        out = self.nominal(at)
        if rate := self.law.rate:
            for k in range(POINTS):
                out[:n, k] = rate(at["time"][k], x[:, k], u[:, k], self.p, self.size, list(out[:n, k]))
        if self.law.output:
            out[n:] = self.law.output(at["time"], x, u, self.p, self.size, out[n:])
        return out

    def places(self) -> dict[str, Callable[[Point, np.ndarray], np.ndarray]]:
        """What a curve at each place makes of the equations, by its value at each point."""
        f, n = self.f, len(self.states) if self.moves else 0
        out: dict[str, Any] = {}
        for name in f.parameters:
            out[f"{name}.gain"] = lambda at, c, name=name: self.nominal(at, [_with(self.p, name, g) for g in c])
        for name in self.inputs:
            out[f"{name}.curve"] = lambda at, c, name=name: self.nominal({**at, name: at[name] + c})
            out[f"{name}.gain"] = lambda at, c, name=name: self.nominal({**at, name: at[name] * (1.0 + c)})
        at_rows = [(s, i) for i, s in enumerate(f.states if self.moves else ())]
        at_rows += [("force" if f.kind == "force" else o, n + i) for i, o in enumerate(f.outputs) if o not in f.states]
        for name, row in at_rows:
            unit = np.eye(n + len(f.outputs))[row][:, None]
            out[f"{name}.curve"] = lambda at, c, unit=unit: self.nominal(at) + unit * c
            out[f"{name}.gain"] = lambda at, c, unit=unit: self.nominal(at) * (1.0 + unit * c)
        return out

    def quantity(self, name: str, at: Point) -> np.ndarray:
        """Its values."""
        if name in at:
            return at[name]
        if name.startswith(WAY):
            of = name.removeprefix(WAY)
            velocity = at["velocity"] if self.f.kind == "force" else self.true(at)[self.states.index(of)]
            return np.sign(velocity)
        one, other = name.split(MINUS)
        return at[one] - at[other]

    def as_at(self, name: str, at: Point) -> Point:
        """Elsewhere, with the quantity as it is at ``at``."""
        new = self.draw()
        if name in new:
            return {**new, name: at[name]}
        if MINUS in name:
            one, other = name.split(MINUS)
            return {**new, one: new[other] + at[one] - at[other]}
        return new

    def value(self, put: Callable[[Point, np.ndarray], np.ndarray], at: Point) -> tuple[np.ndarray, np.ndarray] | None:
        """The curve's value at each point with which the equations are those of the law, and what 1 of it does; None:
        there is none.
        """
        true, c, h = self.true(at), np.zeros(POINTS), 1e-6
        moved = np.abs(true - self.nominal(at)).max(axis=1, keepdims=True)
        size = np.where(moved > 0.0, moved, 1e-6 * np.abs(true).max(axis=1, keepdims=True) + 1e-300)
        for _ in range(12):
            off, slope = (put(at, c) - true) / size, (put(at, c + h) - put(at, c - h)) / (2.0 * h) / size
            c = np.clip(c - np.sum(off * slope, axis=0) / np.maximum(np.sum(slope**2, axis=0), 1e-300), -1e6, 1e6)
        does = np.abs(slope).max(axis=0)
        return (c, does) if np.abs((put(at, c) - true) / size).max() < SAME and np.any(c) else None

    def is_curve(self, place: str, name: str) -> bool:
        """Whether the law is a curve at a place, of a quantity."""
        put, at = self.places()[place], self.draw()
        other = self.as_at(name, at)
        if (first := self.value(put, at)) is None or (second := self.value(put, other)) is None:
            return False
        same = self.quantity(name, at) == self.quantity(name, other) if name.startswith(WAY) else np.ones(POINTS, bool)
        apart = np.abs(first[0] - second[0]) * np.minimum(first[1], second[1])
        return bool(apart[same].max() < SAME)


def _with(p: Any, name: str, gain: float) -> Any:
    out = copy.copy(p)
    setattr(out, name, getattr(p, name) * (1.0 + gain))
    return out


@pytest.mark.parametrize(("name", "law"), LAWS)
def test_a_law_is_its_curves_and_no_other_of_a_parameter_or_a_derivative(name: str, law: str) -> None:
    e = Equations(FAMILIES[name], law)
    said = {tuple(c.split("_of_", 1)) for c in LEARNED[name, law]}
    own = e.places()
    told = [(place, of) for place, of in said if place in own and of not in e.f.outputs or of in e.states]
    wrong = [f"{place}_of_{of}" for place, of in told if not e.is_curve(place, of)]
    assert not wrong
    plain = [*e.states, *e.inputs, "time"] if e.moves else []
    where = [p for p in own if p.removesuffix(".gain") in e.f.parameters or p in [f"{s}.curve" for s in e.f.states]]
    missing = [f"{p}_of_{q}" for p in where for q in plain if (p, q) not in said and e.is_curve(p, q)]
    assert not missing
