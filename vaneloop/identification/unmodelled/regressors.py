"""Every quantity that a curve in a user's own model may be a function of, with the values that it has had."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from vaneloop.base.durations import folded
from vaneloop.identification.settings import (
    DERIVATIVE_PLACES,
    DERIVATIVE_STEP,
    FORM,
    LAG_PLACES,
    LONGEST_LAG,
    MOST_DIFFERENCES,
    NOISY_DIFFERENCE,
    SHORTEST_LAG,
)
from vaneloop.identification.subsystem import Array
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.data import noise_of_channel
from vaneloop.identification.user_models.exogenous_regressors import (
    DISTANCE,
    MINUS,
    SINCE,
    STOPS,
    TIME,
    WAY,
    is_memory,
    lagged_name,
)
from vaneloop.identification.user_models.injection_points import nominal_course
from vaneloop.identification.user_models.motion import MOTION, highest_frequency, low_pass
from vaneloop.identification.user_models.system import Record
from vaneloop.identification.user_models.terms import COLUMN, INPUT, OUTPUT

__all__ = ["Quantity", "difference", "quantities"]

NO_KIND = ("", "-", "1", "%")  # units that do not say that two quantities are of one kind


@dataclass(frozen=True, eq=False)
class Quantity:
    """What a curve may be a function of: its name, unit, number (`Curve.of`) and the values that it has had; of stops,
    the radii.

    course  of what remembers, the channel that it follows, log by log; ``slower``: the same with a lag, or a period, so
            many times as long
    less    of a difference, number and name of what is taken off; ``of`` is then that of what it is taken off from
    span    of what is within each period, how far its channel has been from one end to the other; 0: of all others
    """

    name: str
    unit: str
    of: int
    visited: Array
    course: tuple[Array, ...] = ()
    slower: Callable[[float], Quantity | None] | None = None
    less: tuple[int, str] | None = None
    span: float = 0.0

    @property
    def stops(self) -> bool:
        """Whether a curve of it is a hysteresis (`identification.user_models.exogenous_regressors`)."""
        return self.name.startswith(STOPS)

    @property
    def period(self) -> float:
        """Of time, or of a channel, within each period: this period (s, or in its unit); 0: it is another quantity."""
        found = folded(self.name) if self.span else None
        return found[1] if found else 0.0

    @property
    def sides(self) -> tuple[str, ...]:
        """Of a difference, the names of both; of any other, its own."""
        return (self.name,) if self.less is None else (self.name.removesuffix(f"{MINUS}{self.less[1]}"), self.less[1])

    @property
    def remembers(self) -> bool:
        """Whether it is a lag or stops."""
        return is_memory(self.name)


def quantities(bound: BoundSystem, values: Array, states: Sequence[Sequence[Array]] | None = None) -> list[Quantity]:
    """Every quantity that is known, with the values that it has in the fitted logs; ``values``: the model's own
    parameters, and starts; ``states``: their courses as `nominal_course` has them, where they are known.
    """
    s, data = bound.system, bound.data
    out: list[Quantity] = []
    moves = s.kind in ("simulate", "closed_loop")
    if moves:
        states = states or nominal_course(bound.runner, values).states
        out += [Quantity(n, u, i, np.concatenate(states[i])) for i, (n, u) in enumerate(s.states.items())]
    if s.kind == "closed_loop":
        for i, (name, unit) in enumerate(s.commands.items()):
            if all(name in r.columns for r in data.records):
                out.append(Quantity(name, unit, INPUT + i, np.concatenate([r.columns[name] for r in data.records])))
    else:
        unit = s.unit_of_position
        units = {"position": unit, "velocity": f"{unit}/s", "acceleration": f"{unit}/s^2", **s.inputs}
        for i, name in enumerate(data.in_names):
            out.append(Quantity(name, units[name], INPUT + i, np.concatenate([u[i] for u in data.u])))
    for i, (name, unit) in enumerate(s.outputs.items()):
        if name not in s.states and name not in s.inputs and name not in s.commands:
            out.append(Quantity(name, unit, OUTPUT + i, bound.measured[i]))

    def column(name: str, unit: str) -> None:
        rows = [data.column(k, name) for k in range(len(data.records))]
        out.append(Quantity(name, unit, COLUMN, np.concatenate(rows)))

    column(TIME, "s")
    known = {q.name for q in out} | {s.position, s.velocity}
    shared = set.intersection(*(set(r.columns) for r in data.records))
    for name in sorted(shared - known):
        column(name, s.inputs.get(name, ""))
    all_units = {**s.inputs, **s.outputs, **({s.position: s.unit_of_position} if s.position else {})}
    for name, unit in all_units.items():
        if name in shared:
            column(WAY + name, "-")
            column(DISTANCE + name, unit)
            column(SINCE + name, "s")
    return [*out, *_differences(bound, values, out), *_remembering(bound, shared)]


def _differences(bound: BoundSystem, values: Array, have: Sequence[Quantity]) -> list[Quantity]:
    """Differences of states and of what drives the model, of one unit: what flows, slips and bends between two. None of
    one that is a multiple of a quantity that is there by then, as far as any law tells.
    """
    s = bound.system
    declared = [*s.states, *s.commands, *MOTION, *s.inputs]
    channels = [q for q in have if q.of < OUTPUT or q.name in s.inputs]
    channels.sort(key=lambda q: declared.index(q.name))
    pairs = [(a, b) for a, b in combinations(channels, 2) if a.unit == b.unit and a.unit not in NO_KIND]
    if len(pairs) > (most := MOST_DIFFERENCES * len(channels)):
        together = _acting(bound, values, {q.name: q.visited for q in channels})
        pairs = sorted(pairs, key=lambda p: (p[0].name, p[1].name) not in together)[:most]
    out: list[Quantity] = []
    for a, b in pairs:
        with np.errstate(all="ignore"):  # a state may have run away
            name, d = f"{a.name}{MINUS}{b.name}", difference(bound, a.visited, b.visited)
            if all(q.name != name for q in have) and not any(_alike(d, q.visited) for q in (*have, *out)):
                out.append(Quantity(name, a.unit, a.of, d, less=(b.of, b.name)))
    return out


def difference(bound: BoundSystem, a: Array, b: Array) -> Array:
    """The difference of two quantities on all samples of the logs in ``bound``.

    Two readings that go nearly together differ by little more than their noise, which the model has not: what lies
    above the difference's own frequencies is taken out where it is much of it.
    """
    d = np.asarray(a - b, dtype=float)
    for r, at in zip(bound.data.records, bound.data.logs.values(), strict=True):
        if noise_of_channel(d[at]) > NOISY_DIFFERENCE * np.nanstd(d[at]):
            cutoff = highest_frequency(["d"], [Record(r.name, r.t, {"d": d[at]})])
            d[at] = low_pass(r.t, d[at], cutoff)
    return d


def _alike(one: Array, other: Array) -> bool:
    """Whether two quantities are a straight line of each other, or one of them is constant."""
    good = np.isfinite(one) & np.isfinite(other)
    x, y = ((v[good] - v[good].mean()) if good.any() else np.zeros(1) for v in (one, other))
    size = float(np.sqrt((x @ x) * (y @ y)))
    return not float(x @ x) > 0.0 or (size > 0.0 and abs(float(x @ y)) > np.sqrt(1.0 - FORM**2) * size)


def _acting(bound: BoundSystem, values: Array, visited: Mapping[str, Array]) -> set[tuple[str, str]]:
    """Pairs of channels of which the model has one taken off from the other: in some derivative they stand with
    opposite signs, at most places of the logs.
    """
    s, code = bound.system, bound.runner.code
    p = code.P(*values[: len(s.parameters)]) if s.parameters else code.P(0.0)

    def rates(point: Mapping[str, float]) -> Array:
        u = [point.get(name, 0.0) for name in code.U._fields]
        return np.atleast_1d(np.asarray(s.model(code.X(*[point[n] for n in s.states]), code.U(*u), p), dtype=float))

    places = np.linspace(0, len(bound.t) - 1, DERIVATIVE_PLACES + 2).astype(int)[1:-1]
    signs = np.zeros((DERIVATIVE_PLACES, len(visited), max(len(s.states), 1)))
    for k, at in enumerate(places if s.kind in ("simulate", "closed_loop") else ()):
        point = {name: float(v[at]) for name, v in visited.items()}
        for j, (name, v) in enumerate(visited.items()):
            by = DERIVATIVE_STEP * max(float(np.nanstd(v)), 1e-300)
            try:
                with np.errstate(all="ignore"):
                    signs[k, j] = np.sign(rates({**point, name: point[name] + by}) - rates(point))
            except Exception:  # the user's model may be nothing there
                continue
    opposed = ((signs[:, :, None] * signs[:, None]) < 0.0).any(axis=3).mean(axis=0) > 0.5
    return {(a, b) for i, a in enumerate(visited) for j, b in enumerate(visited) if opposed[i, j]}


def _remembering(bound: BoundSystem, shared: set[str]) -> list[Quantity]:
    """Lags of what drives the model, and stops that it moves. What the model gives is none of them: its measured course
    would tell the model what it has to say.
    """
    s, data = bound.system, bound.data
    unit = s.unit_of_position
    motion = ((s.position, unit), (s.velocity, f"{unit}/s")) if s.kind == "force" else ()
    driving = [(n, u) for n, u in (*motion, *s.inputs.items()) if n in shared]

    def course(name: str) -> tuple[Array, ...]:
        return tuple(data.column(k, name) for k in range(len(data.records)))

    step = max(float(np.median(np.diff(r.t))) for r in data.records)
    shortest, longest = SHORTEST_LAG * step, LONGEST_LAG * min(float(r.t[-1] - r.t[0]) for r in data.records)

    def slow(name: str, unit: str, tau: float) -> Quantity | None:
        if not 0.5 * shortest < tau < 2.0 * longest:
            return None
        lag = lagged_name(name, tau)
        again = lambda times: slow(name, unit, tau * times)  # noqa: E731
        return Quantity(lag, unit, COLUMN, np.concatenate(course(lag)), course(name), again)

    out = []
    for name, unit in driving:
        if not any(np.ptp(c) > 0.0 for c in course(name)):
            continue
        if longest > 4.0 * shortest:
            out += [q for z in LAG_PLACES if (q := slow(name, unit, shortest * (longest / shortest) ** z)) is not None]
        if name != s.velocity:
            radii = 0.5 * np.concatenate(course(DISTANCE + name))
            out.append(Quantity(STOPS + name, unit, COLUMN, radii, course(name)))
    return out
