"""Where laws may act on a system, and how large the data are there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from plant.model import Learned
from vaneloop.base.durations import folded
from vaneloop.base.errors import InputError
from vaneloop.base.forms import NAMED
from vaneloop.base.quantities import absolute_zero
from vaneloop.identification.candidates.library import FORCE_LAWS, LAWS, SIGNAL_LAWS, STATE_LAWS, Law, Size
from vaneloop.identification.settings import CURVE_BOUND, LEVEL_SPREAD, RUN_AWAY
from vaneloop.identification.subsystem import Array, Effect, Parameter, StageError, size_of
from vaneloop.identification.user_models.codegen import Dispatch, try_law
from vaneloop.identification.user_models.data import Data
from vaneloop.identification.user_models.exogenous_regressors import (
    DISTANCE,
    MINUS,
    SINCE,
    STOPS,
    TIME,
    WAY,
    named_lag,
    sides_of,
)
from vaneloop.identification.user_models.motion import smoothed
from vaneloop.identification.user_models.simulation import Placed, Runner
from vaneloop.identification.user_models.system import Record, System
from vaneloop.identification.user_models.terms import COLUMN, HOW, INPUT, OUTPUT, Curve, Surface, runs

__all__ = ["CURVE_LAW", "Course", "from_file", "nominal_course", "places"]

# of a speed whose displacement is no state
OF_SPEED = ("coulomb", "smooth_coulomb", "stribeck", "friction_asymmetry")
NOT_OF_SPEED = tuple(n for n in FORCE_LAWS if n not in OF_SPEED)
# what asks for a zero that means something, which that of degC and degF does not
OF_A_TRUE_ZERO = ("square_root", "quadratic_drag", "cubic")
NOT_BETWEEN = ("force_offset", "backlash_gap", "friction_asymmetry")  # two bodies
SENSOR_OF_FORCE = ("gain", "saturation", "lag", "second_order_lag", "dead_time")  # what follows a sum of forces


def places(data: Data, course: Course, dispatch: Dispatch) -> tuple[list[Placed], list[Effect]]:
    """Every law at every place where it may act, in the same order: what runs, and what the search is told of it."""
    s = data.system
    states, commands = (
        [[np.clip(v, -RUN_AWAY, RUN_AWAY) for v in logs] for logs in of] for of in (course.states, course.commands)
    )
    out: list[Placed] = []
    effects: list[Effect] = []

    def put(name: str, law: Law, place: str, at: int, size: Size, to: int = -1) -> None:
        ps, starts = law.make(size)
        holds: tuple[tuple[str, tuple[float | None, ...]], ...] = ()
        if law.holds is not None:
            other, pattern = law.holds
            holds = ((f"{name.rpartition('.')[0]}.{other}", pattern),)
        effects.append(Effect(name, tuple(ps), starts, law.looks, holds, law.onward))
        constant = law.constant(size) if law.constant else 0.0
        out.append(Placed(name, law, place, at, constant, neutral=np.array([q.value for q in ps]), to=to))

    def add(prefix: str, place: str, name: str, at: int, family: str, size: Size, leave: tuple[str, ...] = ()) -> None:
        for law in LAWS[family].values():
            if law.name not in leave and law.suits(size.unit) and (data.ordered or not law.memory):
                put(f"{prefix}.{law.name}", law, place, at, size)
        for own in s.laws:
            if own.on == family and own.allowed(place, name, by_default="bias" not in leave) and "spring" not in leave:
                try_law(own, prefix, size)
                put(f"{prefix}.{own.name}", dispatch.own[family][own.name], place, at, size)

    outputs = list(s.outputs)
    if s.kind == "force" and s.allows("force", "force"):
        v = np.concatenate([u[1] for u in data.u])
        x = np.concatenate([u[0] for u in data.u])
        force = size_of(np.sqrt(np.nanmean(data.measured[0] ** 2)))
        unit = s.unit_of_position
        size = _size(
            data.records, [u[0] for u in data.u], unit, force=force, force_unit=next(iter(s.outputs.values())),
            speed=size_of(np.sqrt(np.mean(v**2))), speed_unit=f"{unit}/s",
            travel=size_of(np.ptp(x) / 2, np.max(np.abs(x))), travel_unit=unit, ends=_ends(x),
        )  # fmt: skip
        add("force", "force", "force", 0, "force", size)
    if s.kind in ("simulate", "closed_loop"):
        for i, (name, unit) in enumerate(s.states.items()):
            if not (s.allows("state", name) or (name in s.rates and s.allows("force", name))):
                continue
            if name in s.rates.values() and name not in s.rates:
                continue  # a displacement is the integral of its velocity, whatever else is missing
            values = states[i]
            moving: dict[str, Any] = {
                "force": _force(s, data, values, name), "force_unit": s.unit_of_force(name),
                "speed": size_of(np.sqrt(np.nanmean(np.concatenate(values) ** 2))), "speed_unit": unit,
            }  # fmt: skip
            if name in s.rates:
                z = np.concatenate(states[list(s.states).index(s.rates[name])])
                size = _size(
                    data.records,
                    values,
                    unit,
                    **moving,
                    travel=size_of(np.ptp(z) / 2),
                    travel_unit=s.states[s.rates[name]],
                    ends=_ends(z),
                )
                add(name, "force", name, i, "force", size)
            else:
                size = _size(data.records, values, unit)
                relative = OF_A_TRUE_ZERO if absolute_zero(unit) > 0.0 else ()
                add(name, "state", name, i, "state", size, ("overflow", "radiation_to", *relative))
                if name in s.speeds:  # friction asks for no displacement; its other laws are those of a state
                    add(name, "force", name, i, "force", _size(data.records, values, unit, **moving), NOT_OF_SPEED)
                for j, (other, other_unit) in enumerate(s.states.items()):  # into any other of the same kind
                    stores = STATE_LAWS["overflow"].suits(unit) and other not in s.rates.values()
                    if j != i and other_unit == unit and stores:
                        put(f"{name}.overflow_to_{other}", STATE_LAWS["overflow"], "state", i, size, j)
                for j, (other, other_unit) in enumerate(s.inputs.items() if s.kind == "simulate" else ()):
                    if other_unit == unit and STATE_LAWS["radiation_to"].suits(unit):
                        put(f"{name}.radiation_to_{other}", STATE_LAWS["radiation_to"], "state", i, size, INPUT + j)
        for a, b in _bodies(s):
            i, j = (list(s.states).index(n) for n in (a, b))
            slip = [v - w for v, w in zip(states[i], states[j], strict=True)]
            front, back = (list(s.states).index(s.rates[n]) for n in (a, b))
            bend = np.concatenate(states[front]) - np.concatenate(states[back])
            forces = [_force(s, data, states[k], v) for k, v in ((i, a), (j, b))]
            size = _size(
                data.records, slip, s.states[a], force=float(np.sqrt(forces[0] * forces[1])),
                force_unit=s.unit_of_force(a), speed=size_of(np.sqrt(np.nanmean(np.concatenate(slip) ** 2))),
                speed_unit=s.states[a], travel=size_of(np.ptp(bend) / 2), travel_unit=s.states[s.rates[a]],
                ends=_ends(bend),
            )  # fmt: skip
            for law in LAWS["force"].values():
                if law.name not in NOT_BETWEEN:
                    put(f"{a}{MINUS}{b}.{law.name}", law, "force", i, size, j)
    signals = s.commands if s.kind == "closed_loop" else s.inputs
    for i, (name, unit) in enumerate(signals.items()):
        if s.allows("input", name):
            rows = commands[i] if s.kind == "closed_loop" else [u[i + (3 if s.kind == "force" else 0)] for u in data.u]
            first = 3 if s.kind == "force" else 0
            add(name, "input", name, i + first, "signal", _size(data.records, rows, unit))
    for i, name in enumerate(outputs):
        if name in s.commands or not s.allows("output", name):
            continue
        rows = [y[i] for y in data.y]
        if not np.isfinite(np.concatenate(rows)).any():
            rows = [np.zeros(len(y[i])) for y in data.y]
        # a constant force and a constant in the sensor of a force are the same; so are gains
        named = any(p in (s.places or ()) for p in ("output", name))
        leave: tuple[str, ...] = ("square",)  # no sensor reads a square alone; what drives a model may count squared
        if s.kind == "force" and not named:
            leave = tuple(x for x in SIGNAL_LAWS if x not in SENSOR_OF_FORCE)
        prefix = s.reading_of(name)
        add(prefix, "output", name, i, "signal", _size(data.records, rows, s.outputs[name]), leave)
    return out, effects


def _bodies(s: System) -> list[tuple[str, str]]:
    """Pairs of velocities between which forces may act: both have a displacement and a mass, in the same units."""
    units = {
        v: (s.states[v], s.states[x], s.unit_of_force(v)) for v, x in s.rates.items()
        if v in s.masses and s.allows("force", v)
    }  # fmt: skip
    return [(a, b) for a, b in combinations(units, 2) if units[a] == units[b]]


def _force(s: System, data: Data, values: Sequence[Array], name: str) -> float:
    """RMS of what moves a state: of the force where it has a mass, else of its derivative."""
    rates = np.concatenate([np.gradient(w, r.t) for w, r in zip(values, data.records, strict=True)])
    mass = next((q.value for q in s.parameters if q.name == s.masses.get(name)), 1.0)
    return size_of(np.sqrt(np.nanmean(rates**2)) * mass)


def _ends(x: Array) -> tuple[float, float]:
    """Smallest and largest of a displacement; of one that stands still, apart."""
    low, high = float(np.min(x)), float(np.max(x))
    return (low, high) if high > low else (low - 1.0, high + 1.0)


def _size(records: Sequence[Record], rows: list[Array], unit: str, **more: Any) -> Size:
    """How large the data of a place are, given log by log."""
    good = np.concatenate([v[np.isfinite(v)] for v in rows])
    if not len(good):
        good = np.zeros(2)
    low, high = np.quantile(good, [0.001, 0.999])
    if not high > low:
        low, high = float(good.min()), float(good.max())
    if not high > low:
        low, high = low - 0.5 * max(abs(low), 1.0), high + 0.5 * max(abs(high), 1.0)
    rates = np.concatenate([np.gradient(v, r.t)[np.isfinite(v)] for v, r in zip(rows, records, strict=True)])
    rates = rates[np.isfinite(rates)] if len(rates) else np.zeros(1)
    rms = float(np.sqrt(np.mean(rates**2))) if len(rates) else 0.0
    span = max(float(r.t[-1]) for r in records)
    fastest = float(np.quantile(np.abs(rates), 0.999)) if len(rates) else 0.0
    least = (high - low) / span
    step = float(np.median(np.diff(records[0].t)))
    changes = [np.diff(r.t[1:][np.diff(v) != 0.0]) for v, r in zip(rows, records, strict=True)]
    held = float(np.median(np.concatenate(changes))) if any(map(len, changes)) else 0.0
    rate, top = max(rms, least), max(fastest, least)
    return Size(float(low), float(high), rate, top, step, span, unit=unit, held=held, **more)


# ---- States and commands of the nominal model, measured where they are: they give laws inside the model their sizes


@dataclass(eq=False)
class Course:
    """How the nominal model goes.

    states, commands  of each, log by log
    smalls            state by state, speed within which friction is regularised; 0 where the state is no velocity
    """

    states: list[list[Array]] = field(default_factory=list)
    commands: list[list[Array]] = field(default_factory=list)
    smalls: Array = field(default_factory=lambda: np.zeros(0))


def nominal_course(runner: Runner, values: Array) -> Course:
    """Course of the nominal model with these values of its parameters."""
    s, data = runner.system, runner.data
    names = list(s.states)
    course = Course([[] for _ in names], [[] for _ in s.commands], np.zeros(len(names)))
    y = runner.run(values[None])[0]
    for log, (r, at) in enumerate(zip(data.records, data.logs.values(), strict=True)):
        hidden = None
        for i, name in enumerate(names):
            if name in r.columns:
                v = np.where(
                    np.isfinite(r.columns[name]),
                    r.columns[name],
                    y[list(s.outputs).index(name), at] if name in s.outputs else 0.0,
                )
            elif name in s.rates and s.rates[name] in r.columns:
                v = np.gradient(smoothed(r.t, r.columns[s.rates[name]]), r.t)
            else:
                hidden = _hidden(runner, values, log) if hidden is None else hidden
                v = hidden[i]
            course.states[i].append(v)
        for i, name in enumerate(s.commands):
            if name in r.columns:
                course.commands[i].append(r.columns[name])
            elif name in s.outputs:
                course.commands[i].append(y[list(s.outputs).index(name), at])
            else:
                course.commands[i].append(np.linspace(-1.0, 1.0, len(r.t)))
    for i, name in enumerate(names):
        if name in s.speeds:
            course.smalls[i] = 1e-3 * float(np.sqrt(np.mean(np.concatenate(course.states[i]) ** 2)))
    return course


def _hidden(runner: Runner, values: Array, log: int) -> Array:
    """Courses of all states as if none were measured, float64[states, samples], from the nominal model in open loop
    with measured inputs.
    """
    s, data, code = runner.system, runner.data, runner.code
    if s.kind == "closed_loop":
        return np.tile(np.linspace(-1.0, 1.0, len(data.records[log].t)), (len(s.states), 1))
    p = code.P(*values[: len(s.parameters)]) if s.parameters else code.P(0.0)
    t, u = data.records[log].t, data.u[log]
    x = np.array([data.first_state(log, m, 0.0) for m in s.states])
    for k, (which, m) in enumerate(runner.free_starts):
        if which == log:
            x[m] = values[len(s.parameters) + k]
    out = np.empty((len(s.states), len(t)))
    restart, at_restart = data.restarts(log, len(t))
    stride = max(1, len(t) // 4000)
    last = 0
    for k in range(0, len(t), stride):
        if restart.any() and restart[last + 1 : k + 1].any():
            x = at_restart[:, k].copy()
        dt = (t[k] - t[last]) / 4
        for _ in range(4 if k else 0):
            f = s.model
            ui = code.U(*u[:, last]) if len(u) else code.U(0.0)
            a = np.atleast_1d(np.asarray(f(code.X(*x), ui, p), dtype=float))
            b = np.atleast_1d(np.asarray(f(code.X(*(x + 0.5 * dt * a)), ui, p), dtype=float))
            x = x + dt * b
        out[:, k : k + stride] = x[:, None]
        last = k
    bad = ~np.isfinite(out)
    out[bad] = 0.0
    return out


# ---- A law that was learned, from its table in a model file: put where it acts


CURVE_LAW = Law("curve", 0, "a function of one quantity", lambda _: ((), ()))


def from_file(name: str, law: Learned, data: Data) -> tuple[Placed, Effect]:
    """What runs, and what the search is told of it. Raises StageError, one line, for what the system does not have."""
    s = data.system

    def wrong(what: str, value: object, allowed: str, where: str = "") -> StageError:
        return StageError(
            f"curves.{name}{where}: {what} (={value!r}) is not one of system {s.name!r}; allowed: {allowed}"
        )

    if law.how not in HOW:
        raise wrong("how", law.how, ", ".join(HOW))
    signals = list(s.commands) if s.kind == "closed_loop" else data.in_names
    where = law.how.split()[0]
    named = {
        "parameter": [p.name for p in s.parameters], "input": signals, "state": list(s.states),
        "force": ["force"] if s.kind == "force" else [],
        "output": [s.reading_of(o) for o in s.outputs],
    }[where]  # fmt: skip
    if law.at not in named:
        raise wrong("at", law.at, ", ".join(named) or f"nothing, with how = {law.how!r}")
    moves = s.kind in ("simulate", "closed_loop")
    known = {o: OUTPUT + i for i, o in enumerate(s.outputs)}
    known |= {u: INPUT + i for i, u in enumerate(signals)}
    known |= {x: i for i, x in enumerate(s.states)} if moves else {}
    columns = set.intersection(*(set(r.columns) for r in data.records))
    prefixes = (WAY, DISTANCE, SINCE) if law.second else (WAY, DISTANCE, SINCE, STOPS)  # of two nothing slips
    shaped = {prefix + c for c in columns for prefix in prefixes}

    def number(of: str, where: str = "") -> int:
        lag, found, period = named_lag(of), known.get(of, COLUMN), folded(of)
        if found == COLUMN and period and of not in columns:
            return number(period[0], where)
        column = of in (TIME, *columns, *shaped) or lag and lag[0] in columns
        if found == COLUMN and not column:
            raise wrong("of", of, ", ".join([*known, TIME, *sorted(columns - set(known))]), where)
        return found

    sides = None if law.second else sides_of(law.of, {*known, *columns})  # a surface is of no difference
    of, less = number(sides[0] if sides else law.of), (number(sides[1]), sides[1]) if sides else None
    try:
        law.check(f"curves.{name}")
    except InputError as e:
        raise StageError(str(e)) from None
    form = NAMED.get(law.form) if law.second is None else None
    table, jump = runs(form, *law.ends) if form else (law.table(), None)
    if law.jump and not form:
        smooth = law.model_copy(update={"jump": False}).table()
        table, jump = (lambda v: smooth(v[:-1])), (lambda v: (float(v[-1]), 0.0))
    within = folded(law.of) if of < COLUMN and law.of not in known else None
    period = within[1] if within else 0.0
    curve = Curve(law.how, named.index(law.at), of, law.of, *law.ends, table, jump, less, period)
    if (two := law.second) is not None:
        curve = Surface(
            curve.how, curve.place, of, law.of, law.low, law.high, table, of_second=number(two.of, ".second"),
            second=two.of, low_second=two.low, high_second=two.high,
        )  # fmt: skip
    names = law.numbers
    sizes = [max(abs(v), 1e-9) for v in law.values] if law.form else [abs(law.size) or 1.0] * len(names)
    wide = np.sqrt(3.0) * LEVEL_SPREAD if not law.form else 0.0  # a curve's values are known to be of its size
    ps = tuple(
        Parameter(n, 0.0, law.unit, -CURVE_BOUND * z, CURVE_BOUND * z, scale=z, tolerance=float(wide * z))
        for n, z in zip(names, sizes, strict=True)
    )
    effect = Effect(name, ps, (tuple(float(v) for v in law.values),), "a function that was learned")
    return Placed(name, CURVE_LAW, "curve", -1, 0.0, neutral=np.zeros(len(ps)), curve=curve), effect
