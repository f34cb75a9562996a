"""A user's own model: which channels it explains, how, and where laws may act. `System.bind` turns it, with logs, into
a `Stage`.

kind        the model is                                   scored
----------  ---------------------------------------------
            -------------------------------------------------------------------
static      y = model(u, p)                                at every sample
force       force = model(u, p) from measured motion       at every sample (inverse dynamics); u has position, velocity,
            acceleration
simulate    dx/dt = model(x, u, p)                         free run from the start, or in windows restarted from
            measured states
closed_loop dx/dt = model(x, u, p), u = control(r, y, p)   free run with the loop closed

docs/your_own_model.md says which to choose when.
"""

from __future__ import annotations

import importlib.util
import keyword
import re
import sys
import textwrap
import traceback
from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core.errors import NumbaError

from vaneloop.base.compiled import compiled_free
from vaneloop.discrepancy import laws
from vaneloop.discrepancy.laws import MEMORY, PARAMETERS, Law, Size
from vaneloop.discrepancy.stage import Array, Effect, Parameter, Stage, StageError

__all__ = ["Bound", "Record", "System", "load_system", "unknown"]

KINDS = ("static", "force", "simulate", "closed_loop")
MOTION = ("position", "velocity", "acceleration")
FORCE_SHARE = 0.9995  # of the power of the measured force lies below the frequency to which motion is differentiated
WIDE = 4.0  # half-width, in sizes of a parameter that the user calls unknown, of the interval that later fits may use
MOST_STEPS = 16
MOST_SAMPLES = 12_000  # that the search looks at; simulations and laws run on all
SENSOR_OF_FORCE = ("gain", "saturation", "lag", "second_order_lag", "dead_time")  # what follows a sum of forces
STARTS_LOADED = 5.0  # times its noise: a measured force above that is carried by the springs at the start of a log
EDGE = 2.0  # periods of the cut-off that do not count at the ends of a differentiated log


def unknown(name: str, value: float, unit: str, low: float = -np.inf, high: float = np.inf) -> Parameter:
    """A parameter that the logs must tell: fitted from ``value``, which need be right within a factor of ten or so,
    within its bounds.
    """
    return Parameter(name, value, unit, low, high, np.inf)


@dataclass
class Record:
    """One log: times (s) and channels on them, float64[samples]; NaN where nothing was measured."""

    name: str
    t: Array
    columns: dict[str, Array]


@dataclass
class System:
    """A model and what is needed to hold it against logs.

    kind        static, force, simulate or closed_loop
    model       see above; gets named tuples: u.pump, x.level, p.area. Plain Python on numbers (simulate, closed_loop:
                compiled with numba where it can be) or on whole arrays (static, force)
    outputs     measured channels that it explains, name -> unit, in the order in which the model (or ``output``)
                returns them
    inputs      measured channels that drive it, name -> unit
    parameters  `Parameter` (known: exactly, or within a tolerance that is refitted) or `unknown`
    position, velocity   force: the channel of the displacement, and of its rate where it is measured too (else it is
                         differentiated)
    cutoff      force: frequency in Hz up to which motion is differentiated and forces are compared; default: from the
                measured force
    start_force force: hysteretic elements start a log "unloaded", in the middle of their gap, or with the force
    "measured" there
    states      simulate: name -> unit, in the order in which the model returns their derivatives
    rates       simulate: velocity -> displacement, for states that are these; laws of friction then act on the velocity
    masses      simulate: velocity -> name of the parameter that divides forces there, so that laws there are in units
                of force
    force_unit  unit of forces on states with a mass
    output      simulate: function output(x, u, p); default: the states that are named like the outputs
    start       state -> value at the start of a log; others start at their measured value, or where they are not
                measured are fitted
    window      s: start anew from the measured states after each window of this length (for what integrates)
    between     "hold" or "line": what an input does between two samples
    control, commands   closed_loop: u = control(r, y, p), and the names and units of u; r has the inputs, y the outputs
                        after the
                sensors' laws
    places      where laws may act, of "input", "force", "state", "output", or channels and states by name; default:
                everywhere
    read        function path -> {"t": ..., channel: ...} for files that `vaneloop` cannot read
    """

    name: str
    kind: str
    model: Callable[..., Any]
    outputs: dict[str, str]
    inputs: dict[str, str] = field(default_factory=dict)
    parameters: Sequence[Parameter] = ()
    position: str | None = None
    velocity: str | None = None
    cutoff: float | None = None
    start_force: str = "unloaded"
    states: dict[str, str] = field(default_factory=dict)
    rates: dict[str, str] = field(default_factory=dict)
    masses: dict[str, str] = field(default_factory=dict)
    force_unit: str = "N"
    output: Callable[..., Any] | None = None
    start: dict[str, float] = field(default_factory=dict)
    window: float | None = None
    between: str = "hold"
    control: Callable[..., Any] | None = None
    commands: dict[str, str] = field(default_factory=dict)
    places: Sequence[str] | None = None
    read: Callable[[str], Mapping[str, Any]] | None = None
    units: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check what the user wrote; one line says what is wrong and what is allowed."""
        self._check()

    def _check(self) -> None:
        def wrong(text: str) -> StageError:
            return StageError(f"system {self.name!r}: {text}")

        if self.kind not in KINDS:
            raise wrong(f"kind (={self.kind!r}) must be one of {', '.join(KINDS)}")
        if not callable(self.model):
            raise wrong(f"model (={self.model!r}) must be a function")
        if not self.outputs:
            raise wrong("outputs is empty; at least one measured channel must be explained")
        for what, given in (
            ("inputs", self.inputs),
            ("outputs", self.outputs),
            ("states", self.states),
            ("commands", self.commands),
        ):
            if not isinstance(given, dict):
                raise wrong(f"{what} (={given!r}) must be a dict of name -> unit")
            for n in given:
                if not (isinstance(n, str) and n.isidentifier() and not keyword.iskeyword(n) and not n.startswith("_")):
                    raise wrong(
                        f"{what}: {n!r} must be a Python name (letters, digits, _); --map renames a log's channel"
                    )
        for p in self.parameters:
            if not isinstance(p, Parameter):
                raise wrong(f"parameters: {p!r} is not a Parameter; write Parameter(...) or unknown(...)")
            for which in ("value", "low", "high", "tolerance"):
                number = getattr(p, which)
                if isinstance(number, bool) or not isinstance(number, int | float | np.floating | np.integer):
                    raise wrong(f"parameter {p.name!r}: {which} (={number!r}) must be a number")
            if not p.name.isidentifier() or keyword.iskeyword(p.name) or p.name.startswith("_"):
                raise wrong(f"parameter {p.name!r} must be a Python name")
            if not (np.isfinite(p.value) and p.low <= p.value <= p.high):
                raise wrong(f"parameter {p.name} (={p.value:g} {p.unit}) must be in [{p.low:g}, {p.high:g}]")
        names = [p.name for p in self.parameters]
        if len(set(names)) != len(names):
            raise wrong(f"two parameters share a name among {', '.join(names)}")
        moves = self.kind in ("simulate", "closed_loop")
        if self.kind == "force" and not self.position:
            raise wrong("kind 'force' needs position=, the channel of the displacement")
        if moves and not self.states:
            raise wrong(f"kind {self.kind!r} needs states=, name -> unit")
        if self.kind == "closed_loop" and not (self.control and self.commands):
            raise wrong(
                "kind 'closed_loop' needs control=, a function (r, y, p), and commands=, name -> unit of what it "
                "returns"
            )
        for v, x in self.rates.items():
            for n in (v, x):
                if n not in self.states:
                    raise wrong(f"rates: {n!r} is not a state; states are {', '.join(self.states)}")
        for v, m in self.masses.items():
            if v not in self.rates:
                raise wrong(f"masses: {v!r} is not a velocity of rates")
            if m not in names:
                raise wrong(f"masses: {m!r} is not a parameter; parameters are {', '.join(names)}")
        for s in self.start:
            if s not in self.states:
                raise wrong(f"start: {s!r} is not a state; states are {', '.join(self.states)}")
        if moves and self.output is None:
            for o in self.outputs:
                if o not in self.states and o not in self.commands:
                    raise wrong(
                        f"output {o!r} is not a state; name it like one of {', '.join(self.states)}, or give output=, "
                        f"a function (x, u, p)"
                    )
        if self.between not in ("hold", "line"):
            raise wrong(f"between (={self.between!r}) must be 'hold' or 'line'")
        if self.start_force not in ("unloaded", "measured"):
            raise wrong(f"start_force (={self.start_force!r}) must be 'unloaded' or 'measured'")
        for what, size in (("window", self.window), ("cutoff", self.cutoff)):
            if size is not None and not (np.isfinite(size) and size > 0):
                raise wrong(f"{what} (={size!r}) must be above 0")
        known = {"input", "force", "state", "output", *self.inputs, *self.outputs, *self.states, *self.commands}
        for place in self.places or ():
            if place not in known:
                raise wrong(f"places: {place!r} is not known; allowed: {', '.join(sorted(known))}")

    def channels(self) -> tuple[str, ...]:
        """Names that a log must have."""
        motion = [c for c in (self.position, self.velocity) if c]
        return tuple(dict.fromkeys([*self.inputs, *motion, *(o for o in self.outputs)]))

    def optional(self) -> set[str]:
        """Outputs that need not be logged: those that only the loop uses."""
        return set(self.outputs) if self.kind == "closed_loop" else set()

    def bind(
        self,
        records: Sequence[Record],
        like: Bound | None = None,
        values: Mapping[str, float] | None = None,
        present: Mapping[str, Mapping[str, float]] | None = None,
    ) -> Bound:
        """Hold the model against logs.

        like     take sizes, fitted parameters and cut-off from an earlier one (for test logs)
        values   parameters fitted before, by name
        present  laws that the model has by now, effect name -> parameters; they are part of it and not looked for again
        """
        return Bound(self, records, like, values, present)


def _tuple_type(name: str, fields: Sequence[str]) -> Any:
    return namedtuple(name, list(fields) or ["nothing"])


@dataclass
class _Placed:
    """A law at a place: effect name, law, kind of place, index of the signal or state there, constant."""

    effect: str
    law: Law
    place: str  # input, output, force, state
    at: int
    constant: float
    columns: slice = field(default_factory=lambda: slice(0, 0))
    neutral: Array = field(default_factory=lambda: np.zeros(0))


class Bound:
    """A system on logs: the `Stage`, and which samples belong to which log.

    stage     what the search works on; the logs follow each other in time
    logs      name -> slice of samples
    notes     what the user should know
    """

    def __init__(
        self,
        system: System,
        records: Sequence[Record],
        like: Bound | None = None,
        values: Mapping[str, float] | None = None,
        present: Mapping[str, Mapping[str, float]] | None = None,
    ):
        self.system, self.like = system, like
        self.values: dict[str, float]
        self.present: dict[str, dict[str, float]]
        self.cutoff: float | None = None
        self.kernel: Callable[..., Any]
        self.slow: Callable[..., Any]  # the same, not compiled
        self.ready = like is not None  # the model ran with the user's own values
        self.single = self.single_out = self.single_control = False
        self.smalls: Array
        self.stage: Stage
        self.values = dict(values or {}) if like is None else like.values
        self.present = {k: dict(v) for k, v in (present or {}).items()} if like is None else like.present
        self.notes: list[str] = []
        if not records:
            raise StageError(f"system {system.name!r}: no log")
        self.records = [self._checked(r) for r in records]
        self.logs: dict[str, slice] = {}
        at = 0
        for r in self.records:
            name = r.name
            while name in self.logs or (like is not None and name in like.logs):
                name += "'"
            self.logs[name] = slice(at, at + len(r.t))
            at += len(r.t)
        self._prepare()
        self._types()
        self._compile()
        self._make()

    # ---- data

    def _checked(self, r: Record) -> Record:
        s = self.system
        for c in s.channels():
            if c not in r.columns and c not in s.optional():
                import difflib

                close = difflib.get_close_matches(c, r.columns, 1)
                hint = f"; close: {close[0]}" if close else ""
                raise StageError(
                    f"{r.name}: no channel {c!r}, which system {s.name!r} needs{hint}; the log has "
                    f"{', '.join(list(r.columns)[:12])}"
                )
        t = np.asarray(r.t, dtype=float)
        if t.ndim != 1 or len(t) < 50:
            raise StageError(f"{r.name}: {t.size} samples; at least 50 are needed")
        if not np.all(np.isfinite(t)) or np.any(np.diff(t) <= 0):
            raise StageError(f"{r.name}: time must rise from sample to sample")
        columns = {}
        for c, v in r.columns.items():
            v = np.asarray(v, dtype=float)
            if v.shape != t.shape:
                raise StageError(f"{r.name}: channel {c!r} has shape {v.shape}; {t.shape} is needed, as the time has")
            if c in (*s.inputs, s.position, s.velocity):
                bad = ~np.isfinite(v)
                if bad.mean() > 0.2:
                    raise StageError(
                        f"{r.name}: channel {c!r}: {bad.sum()} of {len(v)} samples are NaN; an input may lack 20 % at "
                        f"most"
                    )
                if bad.any():
                    v = np.interp(t, t[~bad], v[~bad])
                    self.notes.append(f"{r.name}: {c}: {int(bad.sum())} NaN filled from their neighbours")
            columns[c] = v
        return Record(r.name, t - t[0], columns)

    def _prepare(self) -> None:
        s = self.system
        outs, ins = list(s.outputs), list(s.inputs)
        self.in_names = list(ins)
        if s.kind == "force":
            self._choose_cutoff()
            self.in_names = [*MOTION, *ins]
        self.u: list[Array] = []
        self.y: list[Array] = []
        for r in self.records:
            y = np.array([r.columns.get(o, np.full(len(r.t), np.nan)) for o in outs])
            u = [r.columns[c] for c in ins]
            if s.kind == "force":
                x, v, a = self._motion(r)
                u = [x, v, a, *u]
                if self.cutoff:
                    y = np.array([_low_pass(r.t, row, self.cutoff) for row in y])
                    edge = EDGE / self.cutoff
                    y[:, (r.t < edge) | (r.t > r.t[-1] - edge)] = np.nan
            self.u.append(np.ascontiguousarray(np.array(u, dtype=float).reshape(len(u), len(r.t))))
            self.y.append(y)
        gap = 0.0
        times = []
        for r in self.records:
            times.append(r.t + gap)
            gap = times[-1][-1] + float(np.median(np.diff(r.t)))
        self.t = np.concatenate(times)
        self.measured = np.concatenate(self.y, axis=1)

    def _choose_cutoff(self) -> None:
        """Up to which frequency the motion is differentiated: where the measured forces have their power."""
        s = self.system
        if s.velocity and not _uses(s.model, "acceleration"):
            return
        if self.like is not None:
            self.cutoff = self.like.cutoff
            return
        if s.cutoff is not None:
            self.cutoff = s.cutoff
            return
        best = 0.0
        for r in self.records:
            rate = 1.0 / float(np.median(np.diff(r.t)))
            for o in s.outputs:
                from scipy.signal import welch

                y = r.columns[o]
                y = np.where(np.isfinite(y), y, np.nanmean(y))
                f, power = welch(y - y.mean(), rate, nperseg=min(4096, len(y)))
                total = np.cumsum(power)
                best = max(best, float(f[int(np.searchsorted(total, FORCE_SHARE * total[-1]))]))
        rate = 1.0 / float(np.median(np.diff(self.records[0].t)))
        self.cutoff = float(np.clip(best, 5.0 / self.records[0].t[-1], 0.2 * rate))
        self.notes.append(
            f"motion differentiated, and forces compared, up to {self.cutoff:.3g} Hz (cutoff= sets another)"
        )

    def _motion(self, r: Record) -> tuple[Array, Array, Array]:
        s = self.system
        x = r.columns[str(s.position)]
        if self.cutoff:
            x = _low_pass(r.t, x, self.cutoff)
        v = np.gradient(x, r.t) if s.velocity is None else r.columns[s.velocity]
        if s.velocity is not None and self.cutoff:
            v = _low_pass(r.t, v, self.cutoff)
        a = np.gradient(v, r.t) if self.cutoff else np.zeros(len(x))
        return x, v, a

    # ---- the user's functions

    def _types(self) -> None:
        s = self.system
        self.P = _tuple_type("P", [p.name for p in s.parameters])
        self.U = _tuple_type("U", list(s.commands) if s.kind == "closed_loop" else self.in_names)
        self.X = _tuple_type("X", list(s.states))
        self.Y = _tuple_type("Y", list(s.outputs))
        self.R = _tuple_type("R", self.in_names)

    def _call(self, what: str, f: Callable[..., Any], *args: Any) -> Any:
        """Call a function of the user; its exception becomes one line."""
        try:
            return f(*args)
        except StageError:
            raise
        except Exception as e:
            fields = getattr(getattr(e, "obj", None), "_fields", None)
            why = (
                f"no {e.name!r} among {', '.join(fields)}"
                if isinstance(e, AttributeError) and fields
                else f"{type(e).__name__}: {e}"
            )
            raise StageError(f"system {self.system.name!r}: {what} failed{_place(e)}: {why}") from None

    def _flat(self, what: str, value: Any, n: int, of: str) -> list[float]:
        values = list(value) if isinstance(value, tuple | list | np.ndarray) and np.ndim(value) else [value]
        if len(values) != n:
            raise StageError(
                f"system {self.system.name!r}: {what} returned {len(values)} values; {n} are needed ({of})"
            )
        for name, v in zip(of.split(", "), values, strict=True):
            if np.ndim(v) != 0:
                raise StageError(
                    f"system {self.system.name!r}: {what} returned an array of shape {np.shape(v)} for {name}; a "
                    f"number is needed"
                )
            if isinstance(v, str | complex | np.complexfloating) or v is None:
                raise StageError(
                    f"system {self.system.name!r}: {what} returned {v!r} for {name} at the first sample; a number is "
                    f"needed"
                )
            if not np.isfinite(v):
                raise StageError(
                    f"system {self.system.name!r}: {what} returned {v} for {name} at the first sample; it must be "
                    f"finite"
                )
        return [float(v) for v in values]

    def _compile(self) -> None:
        """Try the user's functions once, then compile what runs sample by sample."""
        s = self.system
        p = self.P(*[q.value for q in s.parameters]) if s.parameters else self.P(0.0)
        if s.kind in ("static", "force"):
            self._static(np.array([q.value for q in s.parameters]), self.u[0], 0, check=True)
            return
        if self.like is not None:
            self.kernel, self.slow = self.like.kernel, self.like.slow
            self.single, self.single_out = self.like.single, self.like.single_out
            return
        x = self.X(*[self._first_state(0, n, 0.0) for n in s.states])
        r = self.R(*self.u[0][:, 0]) if self.in_names else self.R(0.0)
        control = s.control
        if s.kind == "closed_loop":
            assert control is not None
            y = self.Y(*[float(v) if np.isfinite(v) else 0.0 for v in self.measured[:, 0]])
            got = self._call("control", control, r, y, p)
            u = self.U(*self._flat("control", got, len(s.commands), ", ".join(s.commands)))
            self.single_control = np.ndim(got) == 0
        else:
            u, self.single_control = r, False
        d = self._call("model", s.model, x, u, p)
        self._flat("model", d, len(s.states), ", ".join(s.states))
        self.single = np.ndim(d) == 0
        self.single_out = False
        if s.output is not None:
            o = self._call("output", s.output, x, u, p)
            self._flat("output", o, len(s.outputs), ", ".join(s.outputs))
            self.single_out = np.ndim(o) == 0
        self.kernel = self._kernel()

    def _kernel(self) -> Callable[..., Any]:
        from numba import njit

        s = self.system
        rates = "\n".join(f"dx[{i}] = d" if self.single else f"dx[{i}] = d[{i}]" for i in range(len(s.states)))
        u = (", ".join(f"u[{i}]" for i in range(len(self.U._fields))) + ",") if s.inputs or s.commands else "0.0,"
        p = (", ".join(f"p[{i}]" for i in range(len(s.parameters))) + ",") if s.parameters else "0.0,"

        def rhs(match: re.Match[str]) -> str:
            indent, at, to = match.groups()
            states = ", ".join(f"AT[{i}]" for i in range(len(s.states))) + ","
            text = _RHS.format(x=states, u=u, p=p, rates=rates).strip()
            text = re.sub(r"\bAT\b", at, re.sub(r"\bdx\b", to, text))
            return textwrap.indent(text, indent)

        source = re.sub(r"^( *)rhs (\w+) (\w+)$", rhs, _SOURCE, flags=re.MULTILINE)
        source = source.replace("{outs}", self._output_source()).replace("{control}", self._control_source())

        def build(jit: Callable[[Any], Any]) -> Callable[..., Any]:
            space: dict[str, Any] = {
                "np": np, "jit": jit, "X": self.X, "U": self.U, "P": self.P, "Y": self.Y, "R": self.R,
                "model": jit(s.model),
                "output": jit(s.output) if s.output else None, "control": jit(s.control) if s.control else None,
                "force_of": laws.force_of, "state_rate": laws.state_rate, "transform": laws.transform, "MEMORY": MEMORY,
                "STATE_LIMIT": laws.STATE_LIMIT, "STATE_RATE_LIMIT": laws.STATE_RATE_LIMIT,
            }  # fmt: skip
            exec(compile(source, f"<{s.name}>", "exec"), space)
            return space["run"]

        def compiled(f: Any) -> Any:
            return f if hasattr(f, "py_func") else njit(error_model="numpy", nogil=True)(f)

        self.slow = build(lambda f: getattr(f, "py_func", f))
        fast = build(compiled)
        try:
            self._try(fast)
        except NumbaError as e:
            why = next((line.strip() for line in str(e).splitlines() if line.strip() and "nopython" not in line), "")[
                :100
            ]
            self.notes.append(
                f"system {s.name!r}: numba cannot compile the model ({why}); it runs as plain Python, some 100 times "
                f"slower"
            )
            self._call("model", self._try, self.slow)
            return self.slow
        return fast

    def _output_source(self) -> str:
        s = self.system
        if s.output is not None:
            call = (
                "o = output(X(*xs), U(*us), P(*ps))".replace("X(*xs)", "X({x})")
                .replace("U(*us)", "U({u})")
                .replace("P(*ps)", "P({p})")
            )
            fill = {
                "x": ", ".join(f"x[{i}]" for i in range(len(s.states))),
                "u": ", ".join(f"u[{i}]" for i in range(len(self.U._fields))) if s.inputs or s.commands else "0.0",
                "p": ", ".join(f"p[{i}]" for i in range(len(s.parameters))) if s.parameters else "0.0",
            }
            lines = [call.format(**fill)]
            lines += [f"y[{i}] = o" if self.single_out else f"y[{i}] = o[{i}]" for i in range(len(s.outputs))]
        else:
            states, commands = list(s.states), list(s.commands)
            lines = [
                f"y[{i}] = x[{states.index(o)}]" if o in states else f"y[{i}] = u[{commands.index(o)}]"
                for i, o in enumerate(s.outputs)
            ]
        return "\n    ".join(lines)

    def _control_source(self) -> str:
        s = self.system
        if s.kind != "closed_loop":
            return "pass"
        r = ", ".join(f"r[{i}]" for i in range(len(self.in_names))) if self.in_names else "0.0"
        y = ", ".join(f"y[{i}]" for i in range(len(s.outputs)))
        p = ", ".join(f"p[{i}]" for i in range(len(s.parameters))) if s.parameters else "0.0"
        lines = [f"c = control(R({r},), Y({y},), P({p},))"]
        lines += [f"u[{i}] = c" if self.single_control else f"u[{i}] = c[{i}]" for i in range(len(s.commands))]
        return "\n    ".join(lines)

    def _try(self, kernel: Callable[..., Any]) -> None:
        self.kernel = kernel
        self.placed: list[_Placed] = []
        theta = np.array([q.value for q in self.system.parameters])
        n = min(3, len(self.records[0].t))
        self._simulate(theta, np.array([self._first_state(0, m, 0.0) for m in self.system.states]), 0, [], 1, upto=n)

    # ---- running

    def _first_state(self, log: int, state: str, fallback: float, at: int = 0) -> float:
        s = self.system
        if state in s.start and at == 0:
            return s.start[state]
        r = self.records[log]
        if state in s.outputs and state in r.columns:
            y = r.columns[state][at : at + 3]
            good = y[np.isfinite(y)]
            if len(good):
                return float(good[0])
        return fallback

    def _static(self, p: Array, u: Array, log: int, check: bool = False) -> Array:
        s = self.system
        n = u.shape[1] if u.size else len(self.records[log].t)
        args = self.R(*u) if len(u) else self.R(np.zeros(n))
        values = self._call("model", s.model, args, self.P(*p) if len(p) else self.P(0.0))
        rows = list(values) if isinstance(values, tuple | list) else [values]
        if len(rows) != len(s.outputs) and np.ndim(values) == 2:
            rows = list(np.asarray(values))
        if len(rows) != len(s.outputs):
            raise StageError(
                f"system {s.name!r}: model returned {len(rows)} values; {len(s.outputs)} are needed "
                f"({', '.join(s.outputs)})"
            )
        out = np.empty((len(rows), n))
        for i, (name, row) in enumerate(zip(s.outputs, rows, strict=True)):
            row = np.asarray(row, dtype=float)
            if row.shape not in ((), (n,)):
                raise StageError(
                    f"system {s.name!r}: model returned shape {row.shape} for {name}; ({n},) is needed, one value a "
                    f"sample"
                )
            if check and not np.all(np.isfinite(row)):
                k = int(np.flatnonzero(~np.isfinite(np.broadcast_to(row, (n,))))[0])
                raise StageError(
                    f"system {s.name!r}: model returned {np.broadcast_to(row, (n,))[k]} for {name} "
                    f"at t = {self.records[log].t[k]:g} s; it must be finite"
                )
            out[i] = row
        return out

    def _active(self, theta: Array) -> list[tuple[_Placed, Array]]:
        out = []
        for q in self.placed:
            values = theta[q.columns]
            if not np.array_equal(values, q.neutral):
                row = np.zeros(PARAMETERS + 1)
                row[: len(values)] = values
                row[len(values)] = q.constant
                out.append((q, row))
        return out

    def run(self, thetas: Array) -> Array:
        """Outputs float64[sets, outputs, samples] of parameter sets; what is not finite is far off."""
        s = self.system
        out = np.empty((len(thetas), len(s.outputs), len(self.t)))
        n_p = len(s.parameters)

        def one(i: int) -> None:
            theta = thetas[i]
            active = self._active(theta)
            for log, at in enumerate(self.logs.values()):
                if s.kind in ("static", "force"):
                    try:
                        out[i, :, at] = self._algebraic(theta[:n_p], log, active)
                    except StageError:
                        if not self.ready:
                            raise
                        out[i, :, at] = np.nan
                else:
                    x0 = np.array([self._first_state(log, m, 0.0) for m in s.states])
                    for k, (which, m) in enumerate(self.free_starts):
                        if which == log:
                            x0[m] = theta[n_p + k]
                    out[i, :, at] = self._simulate(theta[:n_p], x0, log, active, self.steps)

        if s.kind in ("simulate", "closed_loop") and len(thetas) > 1:
            with ThreadPoolExecutor(2) as pool:  # compiled code runs side by side
                list(pool.map(one, range(len(thetas))))
        else:
            for i in range(len(thetas)):
                one(i)
        bad = ~np.isfinite(out)
        if bad.any():
            out[bad] = self.far
        return np.clip(out, -self.far, self.far)

    def held(self, log: int) -> float:
        """Measured force at the start of a log."""
        y = self.records[log].columns[next(iter(self.system.outputs))][:5]
        return float(np.median(y[np.isfinite(y)])) if np.isfinite(y).any() else 0.0

    def _algebraic(self, p: Array, log: int, active: list[tuple[_Placed, Array]]) -> Array:
        t, u = self.records[log].t, self.u[log]
        inputs = [(q, row) for q, row in active if q.place == "input"]
        if inputs:
            u = u.copy()
            for q, row in inputs:
                u[q.at] = laws.apply(q.law.code, t, np.ascontiguousarray(u[q.at]), row)
        y = self._static(p, u, log)
        forces = [(q, row) for q, row in active if q.place == "force"]
        if forces:
            gap = sum(row[0] for q, row in forces if q.law.code == laws.BACKLASH_GAP)
            asymmetry = sum(row[0] for q, row in forces if q.law.code == laws.FRICTION_ASYMMETRY)
            for q, row in forces:
                if q.law.code not in laws.HYSTERETIC:
                    y[0] += _forces(q.law.code, u[1], u[0], row, gap, asymmetry, self.small, 0.0)
            springs = [(q, row) for q, row in forces if q.law.code in laws.HYSTERETIC and row[1] > 0.0]
            held = self.held(log) - y[0, 0] if self.loaded else 0.0
            if not abs(held) > STARTS_LOADED * self.noise_of_force:
                held = 0.0
            total = sum(row[1] for _, row in springs)
            parts = [
                _forces(q.law.code, u[1], u[0], row, gap, asymmetry, self.small, held * row[1] / total)
                for q, row in springs
            ]
            y[0] += np.sum(parts, axis=0)
        if self.cutoff:
            y = np.array([_low_pass(t, row, self.cutoff) for row in y])
        for q, row in active:
            if q.place == "output":
                y[q.at] = laws.apply(q.law.code, t, np.ascontiguousarray(y[q.at]), row)
        return y

    def _simulate(
        self, p: Array, x0: Array, log: int, active: list[tuple[_Placed, Array]], steps: int, upto: int | None = None
    ) -> Array:
        s = self.system
        t, u = self.records[log].t[:upto], self.u[log][:, :upto]
        loop = s.kind == "closed_loop"
        n_states = len(s.states)
        names = list(s.states)
        inside = [(q, row) for q, row in active if q.place in ("force", "state") and q.law.code not in laws.MODIFIERS]
        gap, asymmetry = np.zeros(n_states), np.zeros(n_states)
        for q, row in active:
            if q.law.code == laws.BACKLASH_GAP:
                gap[q.at] += row[0]
            elif q.law.code == laws.FRICTION_ASYMMETRY:
                asymmetry[q.at] += row[0]
        code = np.array([q.law.code for q, _ in inside], dtype=np.int64)
        where = np.array([q.at for q, _ in inside], dtype=np.int64)
        memory = np.array([q.law.memory for q, _ in inside], dtype=np.bool_)
        rows = np.array([row for _, row in inside]).reshape(len(inside), PARAMETERS + 1)
        position = np.array([names.index(s.rates[n]) if n in s.rates else -1 for n in names], dtype=np.int64)
        known = [q.name for q in s.parameters]
        mass = np.array([p[known.index(s.masses[n])] if n in s.masses else 1.0 for n in names])
        if not loop:
            for q, row in active:
                if q.place == "input":
                    u = u.copy() if u is self.u[log] or u.base is not None else u
                    u[q.at] = laws.apply(q.law.code, t, np.ascontiguousarray(u[q.at]), row)
        ends = [(q, row) for q, row in active if q.place in ("input", "output")] if loop else []
        e_code = np.array([q.law.code for q, _ in ends], dtype=np.int64)
        e_at = np.array([q.at for q, _ in ends], dtype=np.int64)
        e_out = np.array([q.place == "output" for q, _ in ends], dtype=np.bool_)
        e_rows = np.array([row for _, row in ends]).reshape(len(ends), PARAMETERS + 1)
        restart, at_restart = self._restarts(log, len(t))
        out = np.full((len(s.outputs), len(t)), np.nan)
        arguments = (
            t, np.ascontiguousarray(u), p if len(p) else np.zeros(1), x0, restart, at_restart, code, where, memory,
            rows, position, gap,
            asymmetry, getattr(self, "smalls", np.zeros(n_states)), mass, steps, s.between == "line", loop,
            len(s.commands),
            e_code, e_at, e_out, e_rows, out,
        )  # fmt: skip
        try:
            with np.errstate(all="ignore"):
                self.kernel(*arguments)
        except NumbaError:
            raise
        except Exception as e:  # with the user's own values that is told; what a search tries may be far off
            out[:] = np.nan
            if not self.ready:
                with np.errstate(all="ignore"):
                    self._call("model", self.slow, *arguments)  # says in which line
                raise StageError(f"system {s.name!r}: the model failed: {type(e).__name__}: {e}") from None
        if not loop:
            for q, row in active:
                if q.place == "output":
                    out[q.at] = laws.apply(q.law.code, t, np.ascontiguousarray(out[q.at]), row)
        return out

    def _restarts(self, log: int, n: int) -> tuple[Array, Array]:
        s = self.system
        restart = np.zeros(n, dtype=np.bool_)
        if not s.window:
            return restart, np.zeros((len(s.states), 1))
        if not hasattr(self, "_restart_cache"):
            self._restart_cache: dict[int, tuple[Array, Array]] = {}
        if log not in self._restart_cache:
            r = self.records[log]
            w = (r.t / s.window + 1e-9).astype(int)
            first = np.diff(w, prepend=-1) > 0
            values = np.zeros((len(s.states), len(r.t)))
            moving = dict(s.rates)
            for i, name in enumerate(s.states):
                if name in r.columns:
                    values[i] = r.columns[name]
                elif name in moving and moving[name] in r.columns:
                    values[i] = np.gradient(_smoothed(r.t, r.columns[moving[name]]), r.t)
                else:
                    raise StageError(
                        f"system {s.name!r}: window= needs state {name!r} measured at every start; the log has "
                        f"{', '.join(r.columns)} (name a channel like it, or declare it in rates= as the rate of a "
                        "measured one)"
                    )
            first &= np.all(np.isfinite(values), axis=0)
            self._restart_cache[log] = first, values
        first, values = self._restart_cache[log]
        return first[:n], np.ascontiguousarray(values[:, :n])

    # ---- places, sizes, stage

    def _allowed(self, place: str, name: str) -> bool:
        chosen = self.system.places
        return chosen is None or place in chosen or name in chosen

    def _size(self, rows: list[Array], unit: str, **more: Any) -> Size:
        good = np.concatenate([v[np.isfinite(v)] for v in rows])
        if not len(good):
            good = np.zeros(2)
        low, high = np.quantile(good, [0.001, 0.999])
        if not high > low:
            low, high = float(good.min()), float(good.max())
        if not high > low:
            low, high = low - 0.5 * max(abs(low), 1.0), high + 0.5 * max(abs(high), 1.0)
        rates = np.concatenate([np.gradient(v, r.t)[np.isfinite(v)] for v, r in zip(rows, self.records, strict=True)])
        rates = rates[np.isfinite(rates)] if len(rates) else np.zeros(1)
        rms = float(np.sqrt(np.mean(rates**2))) if len(rates) else 0.0
        span = max(float(r.t[-1]) for r in self.records)
        fastest = float(np.quantile(np.abs(rates), 0.999)) if len(rates) else 0.0
        least = (high - low) / span
        step = float(np.median(np.diff(self.records[0].t)))
        return Size(float(low), float(high), max(rms, least), max(fastest, least), step, span, unit=unit, **more)

    def _places(self) -> list[_Placed]:
        s = self.system
        out: list[_Placed] = []

        def add(
            prefix: str, place: str, at: int, family: dict[str, Law], size: Size, leave: tuple[str, ...] = ()
        ) -> None:
            for law in family.values():
                if law.name in leave:
                    continue
                ps, starts = law.make(size)
                self.effects.append(Effect(f"{prefix}.{law.name}", tuple(ps), starts, law.looks))
                out.append(
                    _Placed(
                        f"{prefix}.{law.name}",
                        law,
                        place,
                        at,
                        law.constant(size) if law.constant else 0.0,
                        neutral=np.array([q.value for q in ps]),
                    )
                )

        self.effects: list[Effect] = []
        outputs = list(s.outputs)
        if s.kind == "force" and self._allowed("force", "force"):
            v = np.concatenate([u[1] for u in self.u])
            x = np.concatenate([u[0] for u in self.u])
            force = float(np.sqrt(np.nanmean(self.measured[0] ** 2)))
            unit = s.units.get("position", "m")
            size = self._size(
                [u[0] for u in self.u], unit, force=force, force_unit=next(iter(s.outputs.values())),
                speed=max(float(np.sqrt(np.mean(v**2))), 1e-300), speed_unit=f"{unit}/s", 
                travel=max(0.5 * float(np.ptp(x)), 1e-300), travel_unit=unit,
            )  # fmt: skip
            add("force", "force", 0, laws.FORCE_LAWS, size)
        if s.kind in ("simulate", "closed_loop"):
            for i, (name, unit) in enumerate(s.states.items()):
                if not (self._allowed("state", name) or (name in s.rates and self._allowed("force", name))):
                    continue
                if name in s.rates.values() and name not in s.rates:
                    continue  # a displacement is the integral of its velocity, whatever else is missing
                course = self.nominal_states[i]
                rates = np.concatenate([np.gradient(w, r.t) for w, r in zip(course, self.records, strict=True)])
                if name in s.rates:
                    j = list(s.states).index(s.rates[name])
                    z = self.nominal_states[j]
                    m = next((q.value for q in s.parameters if q.name == s.masses.get(name)), 1.0)
                    force_unit = s.force_unit if name in s.masses else f"({unit})/s"
                    size = self._size(
                        course, unit, force=max(float(np.sqrt(np.nanmean(rates**2))) * m, 1e-300),
                        force_unit=force_unit,
                        speed=max(float(np.sqrt(np.nanmean(np.concatenate(course) ** 2))), 1e-300), speed_unit=unit,
                        travel=max(0.5 * float(np.ptp(np.concatenate(z))), 1e-300), travel_unit=s.states[s.rates[name]],
                    )  # fmt: skip
                    add(name, "force", i, laws.FORCE_LAWS, size)
                else:
                    add(name, "state", i, laws.STATE_LAWS, self._size(course, unit))
        signals = s.commands if s.kind == "closed_loop" else s.inputs
        for i, (name, unit) in enumerate(signals.items()):
            if self._allowed("input", name):
                rows = (
                    self.nominal_commands[i]
                    if s.kind == "closed_loop"
                    else [u[i + (3 if s.kind == "force" else 0)] for u in self.u]
                )
                add(name, "input", i + (3 if s.kind == "force" else 0), laws.SIGNAL_LAWS, self._size(rows, unit))
        for i, name in enumerate(outputs):
            if name in s.commands or not self._allowed("output", name):
                continue
            rows = [y[i] for y in self.y]
            if not np.isfinite(np.concatenate(rows)).any():
                rows = [np.zeros(len(y[i])) for y in self.y]
            # a constant force and a constant in the sensor of a force are the same; so are gains
            named = any(p in (s.places or ()) for p in ("output", name))
            leave = (
                tuple(x for x in laws.SIGNAL_LAWS if x not in SENSOR_OF_FORCE)
                if s.kind == "force" and not named
                else ()
            )
            prefix = name if name not in s.inputs and name not in s.states else f"{name}_sensor"
            add(prefix, "output", i, laws.SIGNAL_LAWS, self._size(rows, s.outputs[name]), leave)
        return out

    def _make(self) -> None:
        s = self.system
        n_out = len(s.outputs)
        far = np.nanmax(np.abs(self.measured), axis=1) if np.isfinite(self.measured).any() else np.ones(n_out)
        self.far = 100.0 * float(np.nanmax(np.where(np.isfinite(far), far, 1.0))) + 1e-300
        self.free_starts: list[tuple[int, int]] = []
        self.steps = 1
        self.small = 0.0
        self.loaded = s.start_force == "measured"
        self.noise_of_force = float(self.noise()[0]) if s.kind == "force" else 0.0
        if self.like is not None:
            self.steps, self.effects, self.placed, self.small = (
                self.like.steps,
                self.like.effects,
                self.like.placed,
                self.like.small,
            )
            if hasattr(self.like, "smalls"):
                self.smalls = self.like.smalls
        starts: list[Parameter] = []
        if s.kind in ("simulate", "closed_loop"):
            starts = self._starts()
        if self.like is None:
            self.placed = []
            known = [p.name for p in s.parameters]
            for name in self.values:
                if name not in known and not name.startswith("start_"):
                    raise StageError(
                        f"model file: parameter {name!r} is not one of system {s.name!r}; allowed: {', '.join(known)}"
                    )
            first = [
                Parameter(p.name, float(np.clip(self.values[p.name], p.low, p.high)), p.unit, p.low, p.high, 0.0)
                if p.name in self.values
                else p
                for p in (*s.parameters, *starts)
            ]
            if s.kind in ("simulate", "closed_loop"):
                self.run(np.array([[p.value for p in first]]))
            self.ready = True
            fitted = self._prefit(first)
            if s.kind in ("simulate", "closed_loop"):
                self._nominal_course(fitted)
            self.placed = self._places()
            parameters = [self._fixed(p, v) for p, v in zip([*s.parameters, *starts], fitted, strict=True)]
        else:
            mine = self.like.stage.parameters[: len(s.parameters)]
            parameters = [*mine, *starts]
        at = len(parameters)
        placed = []
        for name in self.present:
            if all(e.name != name for e in self.effects):
                raise StageError(
                    f"model file: effect {name!r} is not one that system {s.name!r} can have; "
                    f"it has {', '.join(e.name for e in self.effects)}"
                )
        both = list(zip(self.placed, self.effects, strict=True))
        both = [b for b in both if b[1].name in self.present] + [b for b in both if b[1].name not in self.present]
        self.placed, self.effects = [b[0] for b in both], [b[1] for b in both]
        searched = []
        for q, e in both:
            if e.name in self.present:
                for w in e.parameters:
                    v = self.present[e.name].get(w.name)
                    if v is None or not np.isfinite(v):
                        raise StageError(f"model file: effect {e.name!r} needs a number for {w.name}")
                    v = float(np.clip(v, w.low, w.high))
                    size = w.scale or max(abs(v), 1e-300)
                    parameters.append(
                        Parameter(f"{e.name}.{w.name}", v, w.unit, w.low, w.high, WIDE * size, scale=0.1 * size)
                    )
            else:
                searched.append(e)
            placed.append(
                _Placed(q.effect, q.law, q.place, q.at, q.constant, slice(at, at + len(e.parameters)), q.neutral)
            )
            at += len(e.parameters)
        self.placed = placed
        regimes, units = self._regimes()
        self.stage = Stage(
            s.name, tuple(s.outputs), tuple(s.outputs.values()), tuple(parameters), tuple(searched), self.run, self.t,
            self.measured,
            regimes=regimes, regime_units=units,
        )  # fmt: skip
        self.guess = self.stage.neutral()
        self.guess[: len(s.parameters)] = [p.value for p in s.parameters]
        if self.like is None and not self.values and starts:
            n_p = len(s.parameters)
            self.guess[n_p : n_p + len(starts)] = [p.value for p in starts]
            self._scan_starts(self.guess, list(range(n_p, n_p + len(starts))))
        # the search looks at fewer samples where there are many: neighbours say the same
        stride = max(1, len(self.t) // MOST_SAMPLES)
        self.thinned = Stage(
            s.name, self.stage.outputs, self.stage.units, self.stage.parameters, self.stage.effects,
            lambda thetas: self.run(thetas)[:, :, ::stride], self.t[::stride], self.measured[:, ::stride],
            regimes={k: v[::stride] for k, v in regimes.items()}, regime_units=units,
        )  # fmt: skip

    def theta_from(self, other: Bound, theta: Array) -> Array:
        """Parameters of another log's stage as this one's: initial states that no log tells are fitted to this log."""
        from scipy.optimize import least_squares

        n_p = len(self.system.parameters)
        out = np.concatenate(
            [
                theta[:n_p],
                [p.value for p in self.stage.parameters[n_p : n_p + len(self.free_starts)]],
                theta[n_p + len(other.free_starts) :],
            ]
        )
        k = len(self.free_starts)
        if not k:
            return out
        use = np.isfinite(self.measured)
        size = np.array([self._unit_size(p) for p in self.stage.parameters[n_p : n_p + k]])

        def error(z: Array) -> Array:
            trial = out.copy()
            trial[n_p : n_p + k] = z * size
            return np.where(use, self.run(trial[None])[0] - np.where(use, self.measured, 0.0), 0.0).ravel()

        self._scan_starts(out, list(range(n_p, n_p + k)))
        first = out[n_p : n_p + k] / size
        out[n_p : n_p + k] = least_squares(error, first, diff_step=1e-3, max_nfev=30).x * size
        return out

    def figures(self, theta: Array) -> dict[str, Array]:
        """RMS error of every output, log by log."""
        e = self.run(theta[None])[0] - self.measured
        with np.errstate(invalid="ignore"):
            return {
                name: np.array(
                    [
                        np.sqrt(np.mean(row[np.isfinite(row)] ** 2)) if np.isfinite(row).any() else np.nan
                        for row in e[:, at]
                    ]
                )
                for name, at in self.logs.items()
            }

    def noise(self) -> Array:
        """RMS of the noise in every measured output, as far as its samples tell, and never quite zero."""
        from vaneloop.discrepancy.evidence import noise_of_channel

        out = []
        for name, y in zip(self.system.outputs, self.measured, strict=True):
            good = y[np.isfinite(y)]
            level = noise_of_channel(good)
            if self.cutoff:  # what the low-pass leaves of the noise in the force as it was logged
                raw = [r.columns[name] for r in self.records]
                rate = 1.0 / float(np.median(np.diff(self.records[0].t)))
                level = max(noise_of_channel(v) for v in raw) * float(np.sqrt(min(2.0 * self.cutoff / rate, 1.0)))
            out.append(max(level, 1e-6 * float(np.std(good)) if len(good) else 0.0, 1e-300))
        return np.array(out)

    def _starts(self) -> list[Parameter]:
        """Initial states that no log tells, as parameters to fit."""
        s = self.system
        out: list[Parameter] = []
        if s.window:
            return out
        for log in range(len(self.records)):
            for m, (name, unit) in enumerate(s.states.items()):
                if name in s.start or (name in s.outputs and name in self.records[log].columns):
                    continue
                if name in s.rates:
                    continue  # machines start at rest
                self.free_starts.append((log, m))
                suffix = f"_{log + 1}" if len(self.records) > 1 else ""
                out.append(Parameter(f"start_{name}{suffix}", self._guess(log, name), unit, -np.inf, np.inf, np.inf))
        return out

    def _guess(self, log: int, name: str) -> float:
        return 0.0

    def _prefit(self, parameters: Sequence[Parameter]) -> Array:
        """Values of the unknown parameters that suit the logs best while nothing is added."""
        from scipy.optimize import least_squares

        values = np.array([p.value for p in parameters], dtype=float)
        free = [i for i, p in enumerate(parameters) if np.isinf(p.tolerance)]
        scale = np.nanstd(self.measured, axis=1)
        scale = np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)
        first = self.run(values[None])[0]
        if not np.all(np.abs(first) < self.far):
            k = np.unravel_index(int(np.argmax(~(np.abs(first) < self.far))), first.shape)
            raise StageError(
                f"system {self.system.name!r}: the model leaves all bounds or turns NaN for "
                f"{list(self.system.outputs)[k[0]]} at t = {self.t[k[1]]:g} s with its first parameters; other values "
                f"of {', '.join(p.name for p in parameters) or 'the model'} are needed, or a window="
            )
        if self.system.kind in ("simulate", "closed_loop"):
            self._choose_steps(values)
        if not free:
            return values
        self._scan_starts(values, [i for i in free if parameters[i].name.startswith("start_")])
        size = np.array([abs(values[i]) or self._unit_size(parameters[i]) for i in free])
        low = np.array([parameters[i].low for i in free])
        high = np.array([parameters[i].high for i in free])
        use = np.isfinite(self.measured)
        stride = max(1, self.measured.shape[1] // 20000)

        def error(z: Array) -> Array:
            trial = values.copy()
            trial[free] = z * size
            e = (self.run(trial[None])[0] - np.where(use, self.measured, 0.0)) / scale[:, None]
            return np.where(use, e, 0.0)[:, ::stride].ravel()

        z0 = values[free] / size
        result = least_squares(
            error, np.clip(z0, low / size, high / size), bounds=(low / size, high / size), diff_step=1e-4, max_nfev=60
        )
        values[free] = result.x * size
        if self.system.kind in ("simulate", "closed_loop"):
            self._choose_steps(values)
        return values

    def _scan_starts(self, theta: Array, columns: list[int]) -> None:
        """Set unknown initial states in place to the best of some round sizes of the outputs, one after the other."""
        good = self.measured[np.isfinite(self.measured)]
        size = float(np.max(np.abs(good))) if len(good) else 1.0
        for c in columns:
            trials = np.repeat(theta[None], 11, axis=0)
            trials[:, c] = size * np.array([0.0, 0.1, 0.25, 0.5, 1.0, 2.0, -0.1, -0.25, -0.5, -1.0, -2.0])
            e = np.where(np.isfinite(self.measured), self.run(trials) - np.nan_to_num(self.measured), 0.0)
            theta[c] = trials[int(np.argmin(np.sum(e**2, axis=(1, 2)))), c]

    def _unit_size(self, p: Parameter) -> float:
        if p.name.startswith("start_"):
            y = self.measured[np.isfinite(self.measured)]
            return float(np.std(y)) or 1.0
        return min((abs(v) for v in (p.low, p.high) if np.isfinite(v) and v != 0.0), default=1.0)

    def _choose_steps(self, values: Array) -> None:
        """Steps of the integration between two samples: doubled until the outputs no longer change by more than 1e-3 of
        their spread.
        """
        scale = np.nanstd(self.measured, axis=1)
        scale = np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)
        before = self.run(values[None])[0]
        while self.steps < MOST_STEPS:
            self.steps *= 2
            after = self.run(values[None])[0]
            change = float(np.max(np.sqrt(np.mean((after - before) ** 2, axis=1)) / scale))
            before = after
            if change < 1e-3:
                self.steps //= 2
                break

    def _fixed(self, p: Parameter, value: float) -> Parameter:
        """An unknown parameter, once fitted, may move by a few of its own sizes."""
        if np.isfinite(p.tolerance):
            return p
        size = max(abs(value), abs(p.value), 1e-3 * self._unit_size(p))
        if p.name.startswith("start_"):
            size = max(size, self._unit_size(p))
        return Parameter(p.name, float(value), p.unit, p.low, p.high, WIDE * size)

    def _nominal_course(self, values: Array) -> None:
        """States and commands of the nominal model, measured where they are: for the sizes."""
        s = self.system
        names = list(s.states)
        self.smalls = np.zeros(len(names))
        self.nominal_states: list[list[Array]] = [[] for _ in names]
        self.nominal_commands: list[list[Array]] = [[] for _ in s.commands]
        y = self.run(values[None])[0]
        for log, (r, at) in enumerate(zip(self.records, self.logs.values(), strict=True)):
            for i, name in enumerate(names):
                if name in r.columns:
                    v = np.where(
                        np.isfinite(r.columns[name]),
                        r.columns[name],
                        y[list(s.outputs).index(name), at] if name in s.outputs else 0.0,
                    )
                elif name in s.rates and s.rates[name] in r.columns:
                    v = np.gradient(_smoothed(r.t, r.columns[s.rates[name]]), r.t)
                else:
                    v = self._hidden(values, log, i)
                self.nominal_states[i].append(v)
            for i, name in enumerate(s.commands):
                if name in r.columns:
                    self.nominal_commands[i].append(r.columns[name])
                elif name in s.outputs:
                    self.nominal_commands[i].append(y[list(s.outputs).index(name), at])
                else:
                    self.nominal_commands[i].append(np.linspace(-1.0, 1.0, len(r.t)))
        for i, name in enumerate(names):
            if name in s.rates:
                self.smalls[i] = 1e-3 * float(np.sqrt(np.mean(np.concatenate(self.nominal_states[i]) ** 2)))

    def _hidden(self, values: Array, log: int, state: int) -> Array:
        """Course of a state that is not measured, from the nominal model in open loop with measured inputs."""
        s = self.system
        if s.kind == "closed_loop":
            return np.linspace(-1.0, 1.0, len(self.records[log].t))
        p = self.P(*values[: len(s.parameters)]) if s.parameters else self.P(0.0)
        t, u = self.records[log].t, self.u[log]
        x = np.array([self._first_state(log, m, 0.0) for m in s.states])
        for k, (which, m) in enumerate(self.free_starts):
            if which == log:
                x[m] = values[len(s.parameters) + k]
        out = np.empty(len(t))
        restart, at_restart = self._restarts(log, len(t))
        stride = max(1, len(t) // 4000)
        last = 0
        for k in range(0, len(t), stride):
            if restart.any() and restart[last + 1 : k + 1].any():
                x = at_restart[:, k].copy()
            dt = (t[k] - t[last]) / 4
            for _ in range(4 if k else 0):
                f = s.model
                ui = self.U(*u[:, last]) if len(u) else self.U(0.0)
                a = np.atleast_1d(np.asarray(f(self.X(*x), ui, p), dtype=float))
                b = np.atleast_1d(np.asarray(f(self.X(*(x + 0.5 * dt * a)), ui, p), dtype=float))
                x = x + dt * b
            out[k : k + stride] = x[state]
            last = k
        bad = ~np.isfinite(out)
        out[bad] = 0.0
        return out

    def _regimes(self) -> tuple[dict[str, Array], dict[str, str]]:
        s = self.system
        out: dict[str, Array] = {"time": self.t}
        units = {"time": "s"}
        u = np.concatenate(self.u, axis=1) if self.u[0].size else np.zeros((0, len(self.t)))
        names = self.in_names
        unit = s.units.get("position", "m")
        all_units = {**s.inputs, "position": unit, "velocity": f"{unit}/s", "acceleration": f"{unit}/s^2"}
        for i, n in enumerate(names):
            if n == "acceleration" and not np.any(u[i]):
                continue
            out[n], units[n] = u[i], all_units.get(n, "")
        if s.kind == "force":
            v = u[1]
            still = 0.01 * float(np.sqrt(np.mean(v**2)))
            out["direction"], units["direction"] = np.sign(np.where(np.abs(v) > still, v, 0.0)), ""
        for i, o in enumerate(s.outputs):
            y = self.measured[i]
            if o not in out and np.isfinite(y).any():
                out[o], units[o] = np.where(np.isfinite(y), y, np.nanmean(y)), s.outputs[o]
        if len(self.records) > 1:
            out["log"] = np.concatenate([np.full(len(r.t), float(k + 1)) for k, r in enumerate(self.records)])
            units["log"] = ""
        return out, units


# what stands for "rhs x k": the derivative k at x. Written out in place, since handing fifteen arrays to a function
# costs more
_RHS = """
d = model(X({x}), U({u}), P({p}))
{rates}
if len(code) > 0:
    for i in range(len(code)):
        w = where[i]
        c = code[i]
        if c > 40:
            if c != STATE_LIMIT and c != STATE_RATE_LIMIT:
                dx[w] -= state_rate(c, AT[w], rows[i])
        elif not memory[i]:
            dx[w] -= force_of(c, AT[w], AT[position[w]], False, rows[i], gap[w], asymmetry[w], small[w], none) / mass[w]
    for w in range(m):
        dx[w] -= held[w]
    for i in range(len(code)):
        if code[i] == STATE_RATE_LIMIT:
            w = where[i]
            dx[w] = min(max(dx[w], -rows[i, 0]), rows[i, 0])
"""

_SOURCE = """
@jit
def outputs(x, u, p, y):
    {outs}


@jit
def controls(r, y, p, u):
    {control}


@jit
def run(t, inputs, p, x0, restart, at_restart, code, where, memory, rows, position, gap, asymmetry, small, mass, steps,
        line, loop,
        n_commands, e_code, e_at, e_out, e_rows, out):
    n, m = len(t), len(x0)
    x = x0.copy()
    u = np.zeros(max(n_commands if loop else len(inputs), 1))
    r = np.zeros(max(len(inputs), 1))
    y = np.zeros(len(out))
    seen = np.zeros(len(out))
    remembered = np.zeros((len(code), MEMORY))
    e_memory = np.zeros((len(e_code), MEMORY))
    e_past = np.zeros((len(e_code), n if loop else 1))
    none = np.zeros(MEMORY)
    held = np.zeros(m)
    k1, k2, k3, k4, z = np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m)
    first = True
    for k in range(n):
        if restart[k]:
            for j in range(m):
                x[j] = at_restart[j, k]
            first = True
        if loop:
            for j in range(len(inputs)):
                r[j] = inputs[j, k]
            outputs(x, u, p, y)
            for j in range(len(out)):
                seen[j] = y[j]
            for i in range(len(e_code)):
                if e_out[i]:
                    e_past[i, k] = seen[e_at[i]]
                    seen[e_at[i]] = transform(e_code[i], k, t, e_past[i], e_rows[i], e_memory[i])
            controls(r, seen, p, u)
            outputs(x, u, p, y)
            for j in range(len(out)):
                out[j, k] = y[j]
            for i in range(len(e_code)):
                if e_out[i]:
                    out[e_at[i], k] = seen[e_at[i]]
                else:
                    e_past[i, k] = u[e_at[i]]
                    u[e_at[i]] = transform(e_code[i], k, t, e_past[i], e_rows[i], e_memory[i])
        else:
            for j in range(len(inputs)):
                u[j] = inputs[j, k]
            outputs(x, u, p, y)
            for j in range(len(out)):
                out[j, k] = y[j]
        if k == n - 1:
            break
        h = (t[k + 1] - t[k]) / steps
        for q in range(steps):
            for w in range(m):
                held[w] = 0.0
            for i in range(len(code)):
                if memory[i] and code[i] <= 40:
                    w = where[i]
                    f = force_of(code[i], x[w], x[position[w]], first, rows[i], gap[w], asymmetry[w], small[w],
                                 remembered[i])
                    held[w] += f / mass[w]
            first = False
            if line and not loop:
                for j in range(len(inputs)):
                    u[j] = inputs[j, k] + (inputs[j, k + 1] - inputs[j, k]) * q / steps
            rhs x k1
            if line and not loop:
                for j in range(len(inputs)):
                    u[j] = inputs[j, k] + (inputs[j, k + 1] - inputs[j, k]) * (q + 0.5) / steps
            for w in range(m):
                z[w] = x[w] + 0.5 * h * k1[w]
            rhs z k2
            for w in range(m):
                z[w] = x[w] + 0.5 * h * k2[w]
            rhs z k3
            if line and not loop:
                for j in range(len(inputs)):
                    u[j] = inputs[j, k] + (inputs[j, k + 1] - inputs[j, k]) * (q + 1.0) / steps
            for w in range(m):
                z[w] = x[w] + h * k3[w]
            rhs z k4
            for w in range(m):
                x[w] += h / 6.0 * (k1[w] + 2.0 * k2[w] + 2.0 * k3[w] + k4[w])
            for i in range(len(code)):
                if code[i] == STATE_LIMIT:
                    w = where[i]
                    x[w] = min(max(x[w], rows[i, 0]), rows[i, 1])
        for w in range(m):
            if not np.isfinite(x[w]) or abs(x[w]) > 1e150:
                return
"""


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


def _low_pass(t: Array, x: Array, cutoff: float) -> Array:
    """Zero-phase fourth-order Butterworth filter."""
    from scipy.signal import butter, sosfiltfilt

    rate = 1.0 / float(np.median(np.diff(t)))
    good = np.isfinite(x)
    if not good.all():
        x = np.interp(t, t[good], x[good]) if good.any() else np.zeros(len(x))
    return np.asarray(sosfiltfilt(butter(4, min(cutoff / (0.5 * rate), 0.95), output="sos"), x))


def _smoothed(t: Array, x: Array) -> Array:
    """A measured displacement, smooth enough to be differentiated once, with all that moves it."""
    from scipy.signal import welch

    rate = 1.0 / float(np.median(np.diff(t)))
    y = np.where(np.isfinite(x), x, np.nanmean(x))
    f, power = welch(y - y.mean(), rate, nperseg=min(4096, len(y)))
    total = np.cumsum(power)
    highest = float(f[int(np.searchsorted(total, FORCE_SHARE * total[-1]))])
    return _low_pass(t, x, min(max(0.05 * rate, 1.5 * highest), 0.4 * rate))


def _uses(f: Callable[..., Any], name: str) -> bool:
    """Whether a function mentions an attribute."""
    code = getattr(getattr(f, "py_func", f), "__code__", None)
    return code is None or name in code.co_names or not {"position", "velocity"} & set(code.co_names)


def _place(e: BaseException) -> str:
    """Where in the user's file an exception came from."""
    ours = str(Path(__file__).parents[1]), str(Path(numba.__file__).parent), "<frozen"
    frames = [f for f in traceback.extract_tb(e.__traceback__) if not f.filename.startswith(ours)]
    return f" at line {frames[-1].lineno} of {Path(frames[-1].filename).name}" if frames else ""


def load_system(path: str | Path) -> System:
    """Read a user's model file: a Python file in which a `System` stands, whatever its name.

    Raises StageError, one line, for a file that is absent, does not run, or has no System or more than one.
    """
    path = Path(path)
    if not path.is_file():
        raise StageError(
            f"{path}: no such file; --system wants a Python file with a System in it (docs/your_own_model.md)"
        )
    name = f"_system_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise StageError(f"{path}: is not a Python file (*.py)")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(path.parent.resolve()))
    older = importlib.util.find_spec("discrepancy") is None  # the package's name in the first version
    if older:
        sys.modules["discrepancy"] = sys.modules["vaneloop.discrepancy"]
    try:
        spec.loader.exec_module(module)
    except StageError as e:
        raise StageError(f"{path}: {e}") from None
    except SyntaxError as e:
        raise StageError(f"{path}: line {e.lineno}: {e.msg}") from None
    except Exception as e:
        raise StageError(f"{path}: failed{_place(e)}: {type(e).__name__}: {e}") from None
    finally:
        sys.path.remove(str(path.parent.resolve()))
        if older:
            del sys.modules["discrepancy"]
    found = {id(v): v for v in vars(module).values() if isinstance(v, System)}
    if len(found) != 1:
        raise StageError(
            f"{path}: {len(found)} objects of vaneloop.System; exactly one is needed, as in system = System(...)"
        )
    return next(iter(found.values()))
