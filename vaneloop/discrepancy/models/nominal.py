"""States and commands of the nominal model, measured where they are: they give laws inside the model their sizes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vaneloop.discrepancy.models.motion import smoothed
from vaneloop.discrepancy.models.runner import Runner
from vaneloop.discrepancy.stage import Array

__all__ = ["Course", "nominal_course"]


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
        if name in s.rates:
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
