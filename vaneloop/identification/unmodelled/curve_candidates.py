"""Curves that nobody named, at every place of a user's own model, of every quantity that its logs or it know; surfaces
of two of these; and the model with some of them as effects.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from vaneloop.base.curve import FINE, POINTS, SIDE
from vaneloop.base.durations import folded, within_no_period
from vaneloop.base.hull import hull_of, nearest_within, within
from vaneloop.identification.candidates.spline_basis import Basis, basis_of, waves_of
from vaneloop.identification.settings import (
    CURVE_SPLINES,
    FINE_HARMONICS,
    FINER_SLOPES,
    HARMONICS,
    JUMP_SIDES,
    LEVEL_SPREAD,
    MOST_SAMPLES,
    SURFACE_SPLINES,
    TIME_SPLINES,
)
from vaneloop.identification.subsystem import Array, Effect, Parameter, Stage, size_of
from vaneloop.identification.unmodelled.regressors import Quantity, difference, quantities
from vaneloop.identification.unmodelled.spectral_lines import Course
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.by_log import Logs
from vaneloop.identification.user_models.exogenous_regressors import DISTANCE, SINCE, STOPS, TIME, WAY, every
from vaneloop.identification.user_models.injection_points import CURVE_LAW, nominal_course
from vaneloop.identification.user_models.simulation import Placed
from vaneloop.identification.user_models.system import System
from vaneloop.identification.user_models.terms import COLUMN, INPUT, OUTPUT, Curve, Jump, Surface, Table

__all__ = [
    "Candidate", "SurfaceCandidate", "UserModelCandidates", "candidates", "may_be_of", "on_logs", "surface_of",
    "with_curves",
]  # fmt: skip

JUMP = -1  # of a curve's amplitudes, the one that is of no function of its basis


SHAPES = {
    "zero": "nothing where its quantity is 0",
    "odd": "the same with the other sign where its quantity has the other sign",
    "rising": "never falls",
    "falling": "never rises",
}  # what may be known of a curve


@dataclass(frozen=True, eq=False)
class Candidate:
    """A curve that may be missing.

    name   place.curve_of_QUANTITY where it adds, place.gain_of_QUANTITY where it multiplies
    how, place, unit   as `Curve` has them; ``at``: the place's name; ``unit``: of the curve
    size   how large such a curve is in usual
    mean   whether it may have a mean
    near   whether the quantity is at the place itself, whatever their names
    untold of its mean (0) and slope (1): what it has not, as the logs do not tell it from fitted parameters
    shape  what is known of it beforehand (`SHAPES`)
    jump   whether it has a jump, too, where its quantity is 0
    settled  samples at which it does not remember what was before the log; None: all
    splines  how many it was to have (0: as many as usual)
    """

    name: str
    how: str
    place: int
    at: str
    unit: str
    size: float
    mean: bool
    quantity: Quantity
    basis: Basis
    near: bool = False
    untold: tuple[int, ...] = ()
    shape: tuple[str, ...] = ()
    jump: bool = False
    settled: Array | None = None
    splines: int = 0

    @property
    def lent(self) -> set[int]:
        """Of its mean (0) and slope (1), what parameters of the model have."""
        return {*self.untold, *(() if self.mean else (0,))}

    @property
    def axes(self) -> tuple[tuple[Quantity, Basis], ...]:
        """What it is a function of, and its functions."""
        return ((self.quantity, self.basis),)

    def reaches(self, *values: Array) -> Array:
        """At which values of what it is a function of it was learned."""
        return self.basis.reaches(values[0])

    @property
    def kept(self) -> list[int]:
        """Its basis' functions that it has."""
        gone = self.lent | ({0} if "zero" in self.shape else set())
        step = 2 if "odd" in self.shape else 1  # of a basis over as much below 0 as above, every other one
        return [k for k in range(step - 1, self.basis.turn.shape[1], step) if k not in gone]

    @property
    def parts(self) -> list[int]:
        """What each of its amplitudes is of: a function of its basis, or `JUMP`."""
        return [*self.kept, JUMP] if self.jump else self.kept

    def coefficients(self, amplitudes: Array) -> Array:
        """Those of B-splines, behind them half the jump that it may have."""
        n = len(self.kept)
        return np.append(self.turn @ amplitudes[:n], amplitudes[n:])

    def jumping(self) -> Candidate | None:
        """The same with a jump where its quantity is 0; None where that is hardly below, or above, 0."""
        q, x = self.quantity, self.quantity.visited
        plain = q.stops or q.period or q.name == TIME or {"rising", "falling"} & set(self.shape)
        if self.jump or plain or len(self.basis.bend) < 3:
            return None
        return replace(self, jump=True) if min(np.mean(x > 0.0), np.mean(x < 0.0)) > JUMP_SIDES else None

    def shaped(self, shape: Sequence[str]) -> Candidate | None:
        """The same with what is known of its shape; None where its quantity cannot have that."""
        if not shape or self.quantity.stops:
            return self
        c = replace(self, shape=tuple(shape))
        basis = c.basis_of()
        if basis is None or len(basis.bend) < 3:
            return None
        return replace(c, basis=basis)

    def basis_of(self, count: int = 0) -> Basis | None:
        """Splines for it, ``count`` of them (0: as many as usual)."""
        q, shape = self.quantity, self.shape
        if not shape or q.stops:
            return basis_for(q, count)
        x = q.visited[np.isfinite(q.visited)]
        if not shape_fits(shape, x):
            return None
        basis = basis_of(np.concatenate([x, -x]) if "odd" in shape else x, count or usual(q))
        if basis is not None and (rises := ("rising" in shape) - ("falling" in shape)):
            basis = basis.rising(rises)
        return basis.zeroed() if basis is not None and "zero" in shape else basis

    def every(self, period: float, harmonics: int = HARMONICS) -> Candidate:
        """The same of its quantity within each ``period``, in its unit, with so many harmonics."""
        whole = self.quantity
        span = float(np.ptp(whole.visited))

        def within(period: float) -> Quantity:
            name = every(period, span / period, whole.name)
            found = folded(name)
            assert found is not None
            said, further = found[1], lambda times: within(found[1] * times)
            return replace(whole, name=name, visited=whole.visited % said, slower=further, span=span)

        q = within(period)
        name = self.name.removesuffix(whole.name) + q.name
        return replace(self, name=name, quantity=q, basis=waves_of(q.period, harmonics))

    def slower(self, times: float) -> Candidate | None:
        """The same, as fine, with a lag, or a period, so many times as long; None: it has none, or it would not be
        one.
        """
        q = self.quantity.slower(times) if self.quantity.slower is not None else None
        many = len(self.basis.bend) if self.quantity.period else self.splines
        basis = replace(self, quantity=q).basis_of(many) if q is not None else None
        if q is None or basis is None:
            return None
        return replace(self, name=self.name.replace(self.quantity.name, q.name), quantity=q, basis=basis)

    def finer(self, splines: int) -> Candidate | None:
        """The same with so many splines; None where it has as many, or where its quantity has too few values."""
        basis = self.basis_of(splines)
        if basis is None or len(basis.bend) <= len(self.basis.bend):
            return None
        return replace(self, basis=basis, splines=splines)

    def as_of(self, other: Candidate, amplitudes: Array) -> Array:
        """Its amplitudes where it is nearest to another's curve, from end to end of both."""
        n = len(other.kept)
        curve = other.basis.design(other.grid) @ (other.turn @ amplitudes[:n])
        own = np.linalg.lstsq(self.basis.design(self.grid) @ self.turn, curve, rcond=None)[0]
        return np.maximum(np.append(own, amplitudes[n:]), [p.low for p in self.effect(1.0).parameters])

    @property
    def turn(self) -> Array:
        """B-spline coefficients of each of its functions."""
        return self.basis.turn[:, self.kept]

    @property
    def grid(self) -> Array:
        """Where a curve's table has its points."""
        return np.linspace(self.basis.low, self.basis.high, POINTS)

    def placed(self) -> Placed:
        """What runs."""
        design = self.basis.design(self.grid) @ self.turn
        n = design.shape[1]
        if self.jump:
            return self.placed_as(lambda a: design @ a[:n], n + 1, jump=lambda a: (float(a[n]), 0.0))
        return self.placed_as(design.__matmul__, n)

    def placed_as(
        self, table: Table, parameters: int, reach: tuple[float, float] | None = None, jump: Jump | None = None
    ) -> Placed:
        """The same with another function from so many parameters to its table, over another range, and with a jump."""
        q = self.quantity
        if q.stops:  # where they have not moved they make nothing
            whole = table

            def table(values: Array) -> Array:
                y = whole(values)
                return y - y[0]

        low, high = reach or (self.basis.low, self.basis.high)
        period = q.period if q.of < COLUMN else 0.0
        curve = Curve(self.how, self.place, q.of, q.name, low, high, table, jump, q.less, period)
        return Placed(self.name, CURVE_LAW, "curve", -1, 0.0, neutral=np.zeros(parameters), curve=curve)

    def effect(self, wiggle: float) -> Effect:
        """What the search is told."""
        return self.basis.effect(self.name, self.unit, self.size, wiggle, self.kept, self.jump)


def usual(q: Quantity) -> int:
    """How many splines a curve of a quantity has."""
    return TIME_SPLINES if q.name == TIME else CURVE_SPLINES


def basis_for(q: Quantity, count: int = 0) -> Basis | None:
    """Splines of a curve of a quantity, ``count`` of them (0: as many as usual); None where it has been at too few
    values.
    """
    if q.period:
        return waves_of(q.period, FINE_HARMONICS if count > CURVE_SPLINES else HARMONICS)
    count = count or usual(q)
    if q.stops:  # from a radius of 0 to where every way there and back is within it
        return basis_of(0.5 * float(np.ptp(np.concatenate(q.course))) * np.linspace(0.0, 1.0, 20 * count) ** 2, count)
    return basis_of(q.visited, count)


def shape_fits(shape: Sequence[str], x: Array) -> bool:
    """Whether a quantity that has been at ``x`` can have curves of a shape: what speaks of 0 needs values there."""
    low, high = (float(x.min()), float(x.max())) if len(x) else (1.0, 0.0)
    return ("zero" not in shape or low <= 0.0 <= high) and ("odd" not in shape or low < 0.0 < high)


def _slips(how: str, at: str, q: Quantity, s: System) -> bool:
    """Whether stops of a quantity may be at a place: the force on what moves, a reading of what is driven, the input
    itself.
    """
    if s.kind == "force":
        return how == "force adds" and q.name == f"{STOPS}{s.position}"
    return how == "output adds" if s.kind == "static" else how == "input adds" and q.name == STOPS + at


def candidates(bound: BoundSystem, values: Array) -> list[Candidate]:
    """Every curve that may be missing: each place with each quantity."""
    s = bound.system
    moves = s.kind in ("simulate", "closed_loop")
    states = nominal_course(bound.runner, values).states if moves else []
    known = [(q, b) for q in quantities(bound, values, states) if (b := basis_for(q)) is not None]
    out: list[Candidate] = []

    def put(
        how: str, place: int, at: str, unit: str, size: float, but: str = "", mean: bool = True,
        near: Sequence[str] = (), only: str = "", own: Quantity | None = None,
    ) -> None:  # fmt: skip
        for q, basis in known:
            if own is not None and own.name == q.name and (wide := basis_for(own)) is not None:
                q, basis = own, wide
            if (
                q.name == but
                or (only and q.name != only)
                or (not moves and q.of // 100 * 100 == OUTPUT and not how.startswith("output"))
            ):
                continue
            if not mean and len(basis.bend) < 2:
                continue
            if q.stops and not _slips(how, at, q, s):
                continue
            name = f"{at}.{'gain' if how.endswith('times') else 'curve'}_of_{q.name}"
            out.append(Candidate(name, how, place, at, unit, size, mean and not q.stops, q, basis, q.name in near))

    def half(rows: Array) -> float:
        good = rows[np.isfinite(rows)]
        return size_of(0.5 * np.ptp(good), np.max(np.abs(good))) if len(good) else 1.0

    for i, p in enumerate(s.parameters):
        if s.allows("parameter", p.name):
            put("parameter times", i, p.name, "-", 0.5, mean=p.tolerance == 0.0)
    if moves:
        for i, name in enumerate(s.states):
            if name in s.rates.values() and name not in s.rates:
                continue
            if s.allows("force" if name in s.rates else "state", name):
                pairs = zip(states[i], bound.data.records, strict=True)
                rate = size_of(np.sqrt(np.mean(np.concatenate([np.gradient(v, r.t) for v, r in pairs]) ** 2)))
                mass = next((q.value for q in s.parameters if q.name == s.masses.get(name)), 1.0)
                own = [s.rates[name]] if name in s.rates else []  # a force on what moves is one of its position, too
                put("state adds", i, name, s.unit_of_force(name), rate * mass, near=own)
    if s.kind == "force" and s.allows("force", "force"):
        y = bound.measured[0]
        size = size_of(0.5 * np.sqrt(np.nanmean(y**2)))
        put("force adds", 0, "force", next(iter(s.outputs.values())), size, near=("position", "velocity"))
    signals = s.commands if s.kind == "closed_loop" else s.inputs
    for i, (name, unit) in enumerate(signals.items()):
        if s.allows("input", name):
            k = i + (3 if s.kind == "force" else 0)
            rows = next((q.visited for q, _ in known if q.of == INPUT + k and q.less is None), np.array([-1.0, 1.0]))
            put("input adds", k, name, unit, 0.3 * half(rows))
            put("input times", k, name, "-", 0.3, but=name)
    said = _said(bound, values)
    for i, (name, unit) in enumerate(s.outputs.items()):
        if name in s.commands or not s.allows("output", name) or not np.isfinite(bound.measured[i]).any():
            continue
        at = s.reading_of(name)
        # what else adds to a measured force is a force
        before = next((replace(q, visited=_further(q.visited, said[i])) for q, _ in known if q.name == name), None)
        only = name if s.kind == "force" else ""
        put("output adds", i, at, unit, 0.3 * half(bound.measured[i]), only=only, own=before)
        put("output times", i, at, "-", 0.3, but=name)
    return out


def _said(bound: BoundSystem, values: Array) -> Array:
    """What the model says to the logs without any curve."""
    plain = with_curves(bound, (), ())
    theta = plain.stage.neutral()
    theta[: len(values)] = values
    return np.asarray(plain.run(theta[None])[0])


def _further(measured: Array, said: Array) -> Array:
    """Of each sample what is further from the middle, a reading or what the model says, if that is not far off: a
    sensor at its limit does not show where what it reads has been.
    """
    good = measured[np.isfinite(measured)]
    if measured.shape != said.shape or not len(good):
        return measured
    low, middle, high = (float(np.quantile(good, p)) for p in (0.0, 0.5, 1.0))
    near = (said >= 2.0 * low - high) & (said <= 2.0 * high - low)
    return np.where(near & ~(np.abs(measured - middle) >= np.abs(said - middle)), said, measured)


def with_curves(bound: BoundSystem, laws: Sequence[str], curves: Sequence[tuple[Placed, Effect]]) -> BoundSystem:
    """The model on the same logs with only these laws of the library, and these curves, as effects."""
    out = copy.copy(bound)
    runner = out.runner = copy.copy(bound.runner)
    out.run = runner.run
    n_present = sum(e.name in bound.present for e in bound.effects)
    both = list(zip(bound.placed, bound.effects, strict=True))
    kept = both[:n_present] + [b for name in laws for b in both if b[1].name == name] + list(curves)
    at = first = len(bound.stage.parameters) - sum(len(e.parameters) for _, e in both[:n_present])
    placed = []
    for q, e in kept:
        placed.append(replace(q, columns=slice(at, at + len(e.parameters))))
        at += len(e.parameters)
    out.placed = runner.placed = placed
    out.effects = [e for _, e in kept]
    effects = tuple(out.effects[n_present:])
    stride = max(1, len(bound.t) // MOST_SAMPLES)
    # a gain and a curve nearly make up for each other: what tells them apart is small beside how the model bends over
    # a step of a parameter that is far too large
    own = tuple(
        replace(p, scale=(FINER_SLOPES if k < first else 1.0) * p.scale) for k, p in enumerate(bound.stage.parameters)
    )
    as_here = partial(replace, parameters=own, effects=effects, begins=None, carries=True)
    out.stage = as_here(bound.stage, run=runner.run)
    out.thinned = as_here(bound.thinned, run=lambda thetas: runner.run(thetas, stride))
    out.stages = [out.thinned]
    return out


def on_logs(logs: Logs, curves: Sequence[tuple[Placed, Effect]], laws: Sequence[str] = ()) -> Logs:
    """The model with these curves, and these laws of the library, on all its logs."""
    test = with_curves(logs.test, laws, curves) if logs.test is not None else None
    return Logs(with_curves(logs.fitted, laws, curves), test)


class UserModelCandidates:
    """A user's own model, held against logs (`identification.unmodelled.learning.CandidateSource`)."""

    points, jumps, surfaces = FINE, True, True
    noise_known = False
    measured: frozenset[str] = frozenset()  # states are as the model simulates them

    def __init__(self, logs: Logs):
        self.shares = logs.fitted.system.kind in ("simulate", "closed_loop")
        self.logs, self.floor = logs, logs.fitted.floor
        self.whole = logs.fitted.stage
        self.tests = frozenset(logs.test.logs if logs.test else ())
        self._in_tests: dict[str, Array] = {}  # values of quantities there, by name

    def in_grains(self, of: float) -> None:
        """Nothing: errors are compared with each other, not with noise."""

    def stage(self, laws: Sequence[str], curves: Sequence[tuple[Placed, Effect]], quick: bool = False) -> Stage:
        """The same with only these laws of the library, and these curves, as effects."""
        return with_curves(self.logs.fitted, laws, curves).thinned

    def candidates(self, theta: Array) -> list[Candidate]:
        """Every curve that may be missing."""
        starts = len(self.logs.fitted.system.parameters) + len(self.logs.fitted.runner.free_starts)
        return candidates(with_curves(self.logs.fitted, (), ()), theta[:starts])

    def errors(
        self, curves: Sequence[tuple[Placed, Effect]], theta: Array, laws: Sequence[str] = ()
    ) -> dict[str, Array]:  # fmt: skip
        """Error of every sample of each output in noise floors, log by log, test logs too."""
        return {log: e / self.floor[:, None] for log, e in on_logs(self.logs, curves, laws).errors(theta).items()}

    def elsewhere(self, curves: Sequence[tuple[Placed, Effect]], theta: Array) -> dict[str, float]:
        """Nothing: the model is one subsystem."""
        return {}

    def within(self, candidate: Candidate) -> dict[str, Array]:
        """Of test logs, the samples where a candidate's quantity is where its curve was learned."""
        test = self.logs.test
        if test is None or candidate.quantity.stops:
            return {}
        inside = candidate.reaches(*(self._tested(q) for q, _ in candidate.axes))
        return {log: inside[at] for log, at in test.logs.items()}

    def reach(self, candidate: Candidate) -> tuple[float, float]:
        """The range of a candidate's curve, and as much again to each side: no further a formula goes on."""
        low, high = candidate.basis.low, candidate.basis.high
        if candidate.quantity.stops or candidate.quantity.period:
            return low, high
        return 2.0 * low - high, 2.0 * high - low

    def _tested(self, q: Quantity) -> Array:
        """Values of a quantity in the test logs."""
        test = self.logs.test
        assert test is not None
        if q.name in self._in_tests:
            return self._in_tests[q.name]
        if q.period and q.of != COLUMN:
            whole = replace(q, name=within_no_period(q.name))
            self._in_tests[q.name] = self._tested(whole) % q.period
        elif q.less is not None:
            one, other = q.sides
            sides = replace(q, name=one, less=None), replace(q, name=other, of=q.less[0], less=None)
            self._in_tests[q.name] = difference(test, *(self._tested(side) for side in sides))
        elif q.of == COLUMN:
            values = np.concatenate([test.data.column(k, q.name) for k in range(len(test.data.records))])
            self._in_tests[q.name] = values
        else:
            starts = len(test.system.parameters) + len(test.runner.free_starts)
            plain = with_curves(test, (), ())
            own = [p.value for p in plain.stage.parameters[:starts]]
            self._in_tests |= {o.name: o.visited for o in quantities(plain, np.array(own)) if o.of != COLUMN}
        return self._in_tests[q.name]

    def courses(self, curves: Sequence[tuple[Placed, Effect]], theta: Array) -> list[Course]:
        """The error of every sample of the logs that are fitted."""
        bound = with_curves(self.logs.fitted, (), curves)
        said = bound.run(theta[None])[0]
        read = np.where(np.isfinite(bound.measured), bound.measured, said)
        error = (said - read) / self.floor[:, None]
        error[~np.isfinite(error)] = 0.0
        parts = zip(bound.data.records, bound.logs.values(), bound.data.u, strict=True)
        names = list(bound.system.outputs)
        return [
            Course(r.t, error[:, at], u, said[:, at], dict(zip(names, read[:, at], strict=True))) for r, at, u in parts
        ]


# ---- Surfaces that nobody named: functions of two quantities, where no curve of one is enough
#
# A surface is the tensor product of few splines of each quantity. Each function is one of the first quantity's times
# one of the second's, as `identification.candidates.spline_basis` turns them: what it may bend along either is known
# beforehand, and those that are constant along one of them are curves of the other.


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceCandidate(Candidate):
    """A surface that may be missing: a curve's candidate with another quantity.

    other, across  the second quantity and its functions
    been     corners of where both have been (`vaneloop.base.hull`); ``nearest``: within it, of each point of the grid
    additive whether it is only the sum of a curve of each
    """

    other: Quantity
    across: Basis
    been: Array
    nearest: Array
    additive: bool = False

    @property
    def axes(self) -> tuple[tuple[Quantity, Basis], ...]:
        """Its quantities, each with its functions."""
        return ((self.quantity, self.basis), (self.other, self.across))

    def reaches(self, *values: Array) -> Array:
        """At which values of both it was learned."""
        low, high = np.array([self.basis.low, self.across.low]), np.array([self.basis.high, self.across.high])
        return within(self.been, low, high, *values)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Functions of each quantity that it has the products of."""
        n, m = self.basis.turn.shape[1], self.across.turn.shape[1]
        every = [(i, j) for i in range(n) for j in range(m) if not self.additive or 0 in (i, j)]
        return [ij for ij in every if ij != (0, 0) or self.mean]

    @property
    def turn(self) -> Array:
        """B-spline coefficients of each of its functions, of the first quantity's splines in turn."""
        return np.array([np.kron(self.basis.turn[:, i], self.across.turn[:, j]) for i, j in self.pairs]).T

    def coefficients(self, amplitudes: Array) -> Array:
        """Those of B-splines, of each of the first quantity's in turn all of the second's."""
        return np.asarray(self.turn @ amplitudes)

    @property
    def grids(self) -> tuple[Array, Array]:
        """Where its table has its points."""
        return np.linspace(self.basis.low, self.basis.high, SIDE), np.linspace(self.across.low, self.across.high, SIDE)

    def placed(self) -> Placed:
        """What runs."""
        (one, other), pairs = self.grids, self.pairs
        a, b = self.basis.design(one) @ self.basis.turn, self.across.design(other) @ self.across.turn
        design = np.array([np.outer(a[:, i], b[:, j]).ravel()[self.nearest] for i, j in pairs]).T
        return self.placed_as(lambda values: (design @ values).reshape(SIDE, SIDE), len(pairs))

    def placed_as(
        self, table: Table, parameters: int, reach: tuple[float, float] | None = None, jump: Jump | None = None,
        across: tuple[float, float] | None = None,
    ) -> Placed:  # fmt: skip
        """The same with another function from so many parameters to its table, over other ranges."""
        q, ends = (
            self.other,
            (reach or (self.basis.low, self.basis.high), across or (self.across.low, self.across.high)),
        )
        surface = Surface(
            self.how, self.place, self.quantity.of, self.quantity.name, *ends[0], table,
            of_second=q.of, second=q.name, low_second=ends[1][0], high_second=ends[1][1],
        )  # fmt: skip
        return Placed(self.name, CURVE_LAW, "curve", -1, 0.0, neutral=np.zeros(parameters), curve=surface)

    def effect(self, wiggle: float) -> Effect:
        """What the search is told: each product is known to bend as its two functions do."""
        wide, out = float(np.sqrt(3.0) * self.size), []
        for i, j in self.pairs:
            bend = float(self.basis.bend[i] + self.across.bend[j])
            tolerance = wide * (wiggle / np.sqrt(bend) if bend > 0.0 else LEVEL_SPREAD)
            out.append(Parameter(f"w_{i}_{j}", 0.0, self.unit, scale=self.size, tolerance=tolerance))
        return Effect(self.name, tuple(out), (tuple(0.1 * self.size for _ in out),))


def may_be_of(q: Quantity) -> bool:
    """Whether a surface may be of a quantity: of what is measured or simulated. What follows from time or from turning
    points imitates much by itself; a difference is a function of two by itself.
    """
    follows = q.remembers or q.period or q.name == TIME or q.name.startswith((WAY, DISTANCE, SINCE))
    return q.less is None and not follows


def surface_of(one: Candidate, two: Candidate, splines: int = SURFACE_SPLINES) -> SurfaceCandidate | None:
    """The surface of the quantities of two curves at one place; None where the logs do not spread over both."""
    x, z = one.quantity.visited, two.quantity.visited
    a, b = basis_of(x, splines), basis_of(z, splines)
    if a is None or b is None or len(x) != len(z) or min(len(a.bend), len(b.bend)) < 3:
        return None
    low, high = np.array([a.low, b.low]), np.array([a.high, b.high])
    good = np.isfinite(x) & np.isfinite(z)
    been = hull_of(x[good], z[good], low, high)
    if been is None:
        return None
    kind = "gain" if one.how.endswith("times") else "curve"
    name = f"{one.at}.{kind}_of_{one.quantity.name}_and_{two.quantity.name}"
    return SurfaceCandidate(
        name, one.how, one.place, one.at, one.unit, one.size, one.mean, one.quantity, a, one.near or two.near,
        other=two.quantity, across=b, been=been, nearest=nearest_within(been, low, high),
    )  # fmt: skip
