"""What a system's model, with any laws at any places, says to the logs: the outputs of any set of parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np

from vaneloop.base.compiled import compiled_free, threads
from vaneloop.base.side_by_side import shared_out
from vaneloop.base.spline_rates import SplineRates
from vaneloop.identification.candidates import laws
from vaneloop.identification.candidates.library import Law
from vaneloop.identification.settings import SHORT_RUN, SPLINE_SAMPLES, STARTS_LOADED, SWITCHED
from vaneloop.identification.subsystem import Array, StageError, size_of
from vaneloop.identification.user_models.codegen import Dispatch, dispatch_of
from vaneloop.identification.user_models.data import Data
from vaneloop.identification.user_models.kernel import Kernel, build_kernels
from vaneloop.identification.user_models.motion import low_pass
from vaneloop.identification.user_models.system import FIRST_CODE
from vaneloop.identification.user_models.terms import (
    COLUMN,
    INPUT,
    OUTPUT,
    SENSED,
    Curve,
    apart,
    bent,
    curves_for_kernel,
    surfaces_for_kernel,
)
from vaneloop.identification.user_models.user_code import UserCode, cannot

__all__ = ["Placed", "Runner"]

_building = Lock()  # of kernels, by one thread
_SWITCHING = frozenset(laws.SWITCHING.tolist())


@dataclass(eq=False)
class Placed:
    """A law at a place: effect name, law, kind of place, index of the signal or state there, constant.

    to     what else it acts between: a state, the velocity of a second body, from `INPUT` on an input; -1: nothing
    curve  what it does, where it is a function of some quantity that nobody named; its place is then "curve"
    """

    effect: str
    law: Law
    place: str  # input, output, force, state; curve
    at: int
    constant: float
    columns: slice = field(default_factory=lambda: slice(0, 0))
    neutral: Array = field(default_factory=lambda: np.zeros(0))
    curve: Curve | None = None
    to: int = -1


class Runner:
    """The model on its logs.

    placed       laws and their columns in a set of parameters
    free_starts  (log, state) of initial states that follow the model's own parameters in a set; of kind force the
                 position
    steps        of the integration between two samples
    smalls       state by state, speed within which friction is regularised in a simulation; ``small``: with measured
                 motion
    dispatch     the laws that it may be given
    loaded       hysteretic elements start with the measured force
    far          size of an output beyond all measured ones; what is beyond it, or not finite, counts as that
    like         take compiled model, steps and these speeds from an earlier one (for test logs)
    """

    def __init__(self, data: Data, like: Runner | None = None):
        s = data.system
        self.system, self.data = s, data
        self.code = UserCode(s, data.in_names)
        self.dispatch: Dispatch = like.dispatch if like else dispatch_of(s.laws)
        self.trying = False  # whether numba can compile the model
        self._first: dict[int, Array] = {}  # states at the start of each log, as it or the user tells them
        self.kernel: Kernel
        self.slow: Kernel  # the same, not compiled
        # both with curves (and surfaces: True), made when they are first needed; every runner of these logs shares them
        self.curved: dict[bool, tuple[Kernel, Kernel]] = like.curved if like else {}
        self.ready = like is not None  # the model ran with the user's own values
        self.placed = []
        self.free_starts: list[tuple[int, int]] = []
        self.splines: dict[int, tuple[SplineRates, Array]] = {}  # and the rates of the inputs as logged, see `_rates`
        self.steps: int = like.steps if like else 1
        self.small: float = like.small if like else 0.0
        self.smalls: Array = like.smalls if like else np.zeros(len(s.states))
        self.loaded = s.start_force == "measured"
        self._compile(like)
        n_out = len(s.outputs)
        far = np.nanmax(np.abs(data.measured), axis=1) if np.isfinite(data.measured).any() else np.ones(n_out)
        # what is not integrated runs away from nothing: its gain may just start far off
        beyond = 100.0 if s.kind in ("simulate", "closed_loop") else 1e9
        self.far = beyond * size_of(float(np.nanmax(np.where(np.isfinite(far), far, 1.0))))
        self.noise_of_force = float(data.noise()[0]) if s.kind == "force" else 0.0

    def _compile(self, like: Runner | None) -> None:
        """Try the user's functions once, then compile what runs sample by sample."""
        s, data = self.system, self.data
        if s.kind in ("static", "force"):
            values = np.array([q.value for q in s.parameters])
            self.code.static(values, data.u[0], data.records[0].t, check=True)
            if self.dispatch.python and like is None:
                data.notes.append(f"numba cannot compile {self.dispatch.python}; it runs as plain Python")
            return
        if like is not None:
            self.kernel, self.slow = like.kernel, like.slow
            return
        states = [data.first_state(0, n, 0.0) for n in s.states]
        self.code.try_once(states, data.u[0][:, 0], data.measured[:, 0])
        known = [data.records[0].columns.get(n) for n in s.states]
        self.code.find_accelerations([1.0 if v is None else size_of(np.nanstd(v)) for v in known], data.u[0])
        self.kernel = self._tried()

    def _tried(self) -> Kernel:
        """The kernel, tried on three samples: compiled, or where numba cannot, as plain Python."""
        s = self.system
        fast, self.slow = build_kernels(self.code, self.dispatch)
        why = self.dispatch.python
        self.trying = True
        try:
            if not why:
                self._try(fast)
        except Exception as e:  # numba says in many ways that it cannot
            why = cannot(e)
        if why:
            self.data.notes.append(
                f"system {s.name!r}: numba cannot compile the model ({why}); it runs as plain Python, some 100 times "
                f"slower"
            )
            self.code.call("model", self._try, self.slow)
        self.trying = False
        return self.kernel

    def _try(self, kernel: Kernel) -> None:
        self.kernel = kernel
        theta = np.array([q.value for q in self.system.parameters])
        n = min(3, len(self.data.records[0].t))
        self._simulate(
            theta, np.array([self.data.first_state(0, m, 0.0) for m in self.system.states]), 0, [], 1, upto=n
        )

    @property
    def placed(self) -> list[Placed]:
        """Laws and their columns in a set of parameters."""
        return self._placed

    @placed.setter
    def placed(self, placed: list[Placed]) -> None:
        self._placed = placed
        many = [q.columns.stop - q.columns.start for q in placed]
        self._owners = np.repeat(np.arange(len(placed)), many)
        self._columns = np.array([c for q in placed for c in range(q.columns.start, q.columns.stop)], dtype=int)
        idle = [np.zeros(n) if q.curve is not None else q.neutral for q, n in zip(placed, many, strict=True)]
        self._idle = np.concatenate([np.zeros(0), *idle])

    def _active(self, theta: Array, moved: Array) -> list[tuple[Placed, Array]]:
        """The laws that do anything, and their rows; ``moved``: of all their columns, those that do."""
        out = []
        for k in dict.fromkeys(self._owners[moved].tolist()):
            q = self._placed[k]
            values = theta[q.columns]
            if q.curve is not None:
                out.append((q, q.curve.row(values)))
                continue
            row = np.zeros(self.dispatch.parameters + 1)
            row[: len(values)] = values
            row[len(values)] = q.constant
            out.append((q, row))
        return out

    def run(self, thetas: Array, every: int = 1) -> Array:
        """Outputs float64[sets, outputs, samples] of parameter sets; what is not finite is far off.

        every  return only each so many-th sample
        """
        s = self.system
        n = len(self.data.t)
        out = np.empty((len(thetas), len(s.outputs), len(range(0, n, every))))
        moves = s.kind in ("simulate", "closed_loop")
        given = self._columns < thetas.shape[1]  # sets of the model's own parameters alone have no law
        moved = np.zeros((len(thetas), len(given)), dtype=bool)
        moved[:, given] = thetas[:, self._columns[given]] != self._idle[given]

        def one(i: int) -> None:
            active = self._active(thetas[i], moved[i])
            parts = [self._on_log(thetas[i], log, active) for log in range(len(self.data.logs))]
            _bounded(np.concatenate(parts, axis=1) if len(parts) > 1 else parts[0], self.far, every, out[i])

        def work() -> None:
            for i in todo:
                one(i)

        todo = iter(range(len(thetas)))  # which threads share
        if moves and threads() > 1 and not shared_out() and (len(thetas) - 1) * n * self.steps > SHORT_RUN:
            with ThreadPoolExecutor(1) as pool:  # compiled code runs side by side
                other = pool.submit(work)
                work()
                other.result()
        else:
            work()
        return out

    def _on_log(self, theta: Array, log: int, active: list[tuple[Placed, Array]]) -> Array:
        """Outputs of a parameter set on one log; NaN where they are not known."""
        s, n_p = self.system, len(self.system.parameters)
        if s.kind in ("static", "force"):
            starts = [theta[n_p + k] for k, (which, _) in enumerate(self.free_starts) if which == log]
            try:
                return np.ascontiguousarray(self._algebraic(theta[:n_p], log, active, sum(starts)), dtype=float)
            except StageError:
                if not self.ready:
                    raise
                return np.full((len(s.outputs), len(self.data.times[log])), np.nan)
        x0 = self._states(log).copy()
        for k, (which, m) in enumerate(self.free_starts):
            if which == log:
                x0[m] = theta[n_p + k]
        self._read_back(x0, log, active)
        return self._simulate(theta[:n_p], x0, log, active, self.steps)

    def _states(self, log: int) -> Array:
        """States at the start of a log, as it or the user tells them; else 0."""
        if log not in self._first:
            self._first[log] = np.array([self.data.first_state(log, m, 0.0) for m in self.system.states])
        return self._first[log]

    def _read_back(self, x0: Array, log: int, active: list[tuple[Placed, Array]]) -> None:
        """Put a state that starts at its sensor's reading to where the sensor, with its law, reads that."""
        s = self.system
        for q, row in active:
            if q.curve is None and q.place != "output":
                continue
            names = list(s.states)
            if q.curve is not None and q.curve.how in SENSED and (name := list(s.outputs)[q.curve.place]) in names:
                self._read_back_curve(x0, log, names.index(name), q.curve, row)
                continue
            name = list(s.outputs)[q.at] if q.place == "output" else ""
            if q.law.memory or name not in names or name in s.start:
                continue
            m = names.index(name)
            if np.isfinite(self.data.first_state(log, name, np.nan)):
                x0[m] = self.dispatch.argument(q.law.code, x0[m], row)

    def _read_back_curve(self, x0: Array, log: int, m: int, curve: Curve, row: Array) -> None:
        """`_read_back` of a sensor whose reading a curve changes: the reading less what the curve makes of it."""
        name = list(self.system.states)[m]
        if name in self.system.start or not np.isfinite(self.data.first_state(log, name, np.nan)):
            return
        reading, u = x0[m], self.data.u[log][:, :1]

        def first(of: int, quantity: str) -> Array:
            if of < INPUT:
                return x0[of : of + 1]
            if of < OUTPUT:
                return np.asarray(u[of - INPUT])
            return np.array([reading]) if of < COLUMN else self.data.column(log, quantity)[:1]

        for _ in range(8):
            c = float(curve.at(curve.value(first), row)[0])
            x0[m] = reading - c if curve.how == "output adds" else reading / max(1.0 + c, 0.1)

    def _algebraic(self, p: Array, log: int, active: list[tuple[Placed, Array]], position: float) -> Array:
        t, u = self.data.times[log], self.data.u[log]
        if position != 0.0:
            u = np.concatenate([u[:1] + position, u[1:]])
        inputs = [(q, row) for q, row in active if q.place == "input"]
        if inputs:
            u = u.copy()
            for q, row in inputs:
                u[q.at] = self.dispatch.apply(q.law.code, t, np.ascontiguousarray(u[q.at]), row)
        curves = [(q.curve, row) for q, row in active if q.curve is not None]
        driven, known = bent(curves, self.data, log, u, p) if curves else (u, p)
        y = self.code.static(known, driven, t)
        forces = [(q, row) for q, row in active if q.place == "force"]
        if forces:
            gap = sum(row[0] for q, row in forces if q.law.code == laws.BACKLASH_GAP)
            asymmetry = sum(row[0] for q, row in forces if q.law.code == laws.FRICTION_ASYMMETRY)
            for q, row in forces:
                if q.law.code >= FIRST_CODE["force"]:
                    assert self.dispatch.forces is not None
                    y[0] += self.dispatch.forces(q.law.code, t, u[1], u[0], row)
                elif q.law.code not in laws.HYSTERETIC:
                    y[0] += _forces(q.law.code, u[1], u[0], row, gap, asymmetry, self.small, 0.0)
            springs = [(q, row) for q, row in forces if q.law.code in laws.HYSTERETIC and row[1] > 0.0]
            held = self.data.held(log) - y[0, 0] if self.loaded else 0.0
            if not abs(held) > STARTS_LOADED * self.noise_of_force:
                held = 0.0
            total = sum(row[1] for _, row in springs)
            parts = [
                _forces(q.law.code, u[1], u[0], row, gap, asymmetry, self.small, held * row[1] / total)
                for q, row in springs
            ]
            y[0] += np.sum(parts, axis=0)
        for curve, row in curves:
            if curve.how.startswith(("force", "output")):
                c = curve.at(curve.values(self.data, log, u, y), row)
                y[curve.place] = y[curve.place] * (1.0 + c) if curve.how == "output times" else y[curve.place] + c
        if self.data.cutoff:
            y = np.array([low_pass(t, row, self.data.cutoff) for row in y])
        for q, row in active:
            if q.place == "output":
                y[q.at] = self.dispatch.apply(q.law.code, t, np.ascontiguousarray(y[q.at]), row)
        return y

    def _rates(self, log: int, t: Array, u: Array, changed: Sequence[int]) -> Array:
        """Rates of the inputs at the samples where they run in a smooth curve between them: those of a cubic spline,
        float64[inputs, samples]; else none. Those not ``changed`` are as logged.
        """
        if self.system.between != "smooth" or not len(u) or len(t) < SPLINE_SAMPLES:
            return np.zeros((0, len(t)))
        if len(t) < len(self.data.times[log]):
            return SplineRates(t)(u)
        if log not in self.splines:
            spline = SplineRates(t)
            self.splines[log] = spline, spline(self.data.u[log])
        spline, as_logged = self.splines[log]
        if not changed:
            return as_logged
        out = as_logged.copy()
        out[changed] = spline(u[changed])
        return out

    def _kernels_for_curves(self, surfaces: bool) -> tuple[Kernel, Kernel]:
        """The kernel that takes curves, and surfaces, as `_tried` has it, and not compiled."""
        with _building:
            if surfaces not in self.curved:
                fast, slow = build_kernels(self.code, self.dispatch, curved=True, surfaces=surfaces)
                self.curved[surfaces] = slow if self.kernel is self.slow else fast, slow
            return self.curved[surfaces]

    @cached_property
    def _no_states(self) -> Array:
        return np.zeros(len(self.system.states))

    @cached_property
    def _position(self) -> Array:
        """Of each state that is a rate, the state that it is the rate of; else -1."""
        rates, names = self.system.rates, list(self.system.states)
        return np.array([names.index(rates[n]) if n in rates else -1 for n in names], dtype=np.int64)

    @cached_property
    def _masses(self) -> list[tuple[int, int]]:
        """States with a mass, and the parameter that it is."""
        masses, known = self.system.masses, [q.name for q in self.system.parameters]
        return [(m, known.index(masses[n])) for m, n in enumerate(self.system.states) if n in masses]

    @cached_property
    def _nothing(self) -> tuple[Array, Array, Array, Array, Array]:
        none = np.zeros(0, dtype=np.int64)
        return none, none, none, np.zeros((0, self.dispatch.parameters + 1)), np.zeros(0, dtype=np.bool_)

    def _in_the_loop(self, active: list[tuple[Placed, Array]]) -> tuple[Array, Array, Array, Array, Array]:
        """Of laws that act within a simulation: codes, places, what else, parameters, and whether they remember."""
        if not active:
            return self._nothing
        code = np.array([q.law.code for q, _ in active], dtype=np.int64)
        where = np.array([q.at for q, _ in active], dtype=np.int64)
        to = np.array([q.to for q, _ in active], dtype=np.int64)
        memory = np.array([q.law.memory for q, _ in active], dtype=np.bool_)
        return code, where, to, np.array([row for _, row in active]), memory

    def _simulate(
        self, p: Array, x0: Array, log: int, active: list[tuple[Placed, Array]], steps: int, upto: int | None = None
    ) -> Array:
        s = self.system
        t, u = self.data.times[log][:upto], self.data.u[log][:, :upto]
        loop = s.kind == "closed_loop"
        inside = [(q, row) for q, row in active if q.place in ("force", "state") and q.law.code not in laws.MODIFIERS]
        gap = asymmetry = self._no_states
        for q, row in active:
            if q.law.code in laws.MODIFIERS:
                of = np.zeros(len(s.states))
                of[q.at] = row[0]
                if q.law.code == laws.BACKLASH_GAP:
                    gap = gap + of
                else:
                    asymmetry = asymmetry + of
        code, where, to, rows, memory = self._in_the_loop(inside)
        mass = self._no_states + 1.0
        for m, k in self._masses:
            mass[m] = p[k]
        changed = sorted({q.at for q, _ in active if q.place == "input"}) if not loop else []
        if changed:
            u = u.copy()
            for q, row in active:
                if q.place == "input":
                    u[q.at] = self.dispatch.apply(q.law.code, t, np.ascontiguousarray(u[q.at]), row)
        ends = [(q, row) for q, row in active if q.place in ("input", "output")] if loop else []
        e_code, e_at, _, e_rows, _ = self._in_the_loop(ends)
        e_out = np.array([q.place == "output" for q, _ in ends], dtype=np.bool_)
        own_forces = range(FIRST_CODE["force"], FIRST_CODE["state"])
        if any(q.law.code in _SWITCHING or q.law.code in own_forces for q, _ in inside):
            steps = max(steps, SWITCHED)
        restart, at_restart = self.data.restarts(log, len(t))
        curves = [(q.curve, row) for q, row in active if q.curve is not None]
        plain, surfaces = apart(curves)
        rough = 0
        jumping = [c for c, row in plain if c.simulated and c.parts(row)[1]]
        if jumping and steps < SWITCHED:  # of a speed it is friction, and runs as that of the library does
            rough = 0 if any(name in s.speeds for c in jumping for _, name in c.quantities) else steps
            steps = SWITCHED
        kernel, slow = (self.kernel, self.slow) if not curves else self._kernels_for_curves(bool(surfaces))
        out = np.full((len(s.outputs), len(t)), np.nan)
        arguments: tuple[Any, ...] = (
            t, np.ascontiguousarray(u), p if len(p) else np.zeros(1), x0, restart, at_restart, code, where, to,
            memory, rows, self._position, gap,
            asymmetry, self.smalls, mass, steps, s.between != "hold", self._rates(log, t, u, changed), len(s.commands),
            e_code, e_at, e_out, e_rows, out,
        )  # fmt: skip
        if curves:
            arguments += (rough, *curves_for_kernel(plain, self.data, log, len(t), self.smalls))
        if surfaces:
            arguments += surfaces_for_kernel(surfaces, self.data, log, len(t))
        try:
            with np.errstate(all="ignore"):
                kernel(*arguments)
        except Exception as e:  # with the user's own values that is told; what a search tries may be far off
            if self.trying:
                raise
            out[:] = np.nan
            if not self.ready:
                with np.errstate(all="ignore"):
                    self.code.call("model", slow, *arguments)  # says in which line
                raise StageError(f"system {s.name!r}: the model failed: {type(e).__name__}: {e}") from None
        if not loop:
            for q, row in active:
                if q.place == "output":
                    out[q.at] = self.dispatch.apply(q.law.code, t, np.ascontiguousarray(out[q.at]), row)
        return out


@compiled_free
def _forces(
    code: int, v: Array, x: Array, row: Array, gap: float, asymmetry: float, small: float, held: float
) -> Array:
    """A law's force on a whole log; elements with a memory start with the force ``held``, in the middle of their gap
    where that is 0.
    """
    s = np.zeros(laws.MEMORY)
    out = np.empty(len(v))
    for k in range(len(v)):
        out[k] = laws.force_of(code, v[k], x[k], k == 0, row, gap, asymmetry, small, s)
        if k == 0 and held != 0.0:
            out[k] = laws.load(code, x[0], row, gap, asymmetry, held, s)
    return out


@compiled_free
def _bounded(y: Array, far: float, every: int, out: Array) -> None:
    """Each so many-th sample within ``far`` on either side; what is not finite is that far off."""
    for o in range(out.shape[0]):
        for k in range(out.shape[1]):
            v = y[o, k * every]
            out[o, k] = min(max(v, -far), far) if math.isfinite(v) else far
