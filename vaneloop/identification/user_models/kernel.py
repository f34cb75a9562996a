"""The function that simulates a system on a log: source written for its states, inputs and parameters, and compiled."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from vaneloop.base.curve import on_even, on_grid
from vaneloop.base.kept import kept_njit
from vaneloop.identification.candidates import laws
from vaneloop.identification.user_models.codegen import Dispatch, compiled_code
from vaneloop.identification.user_models.terms import COLUMN, INPUT, OUTPUT
from vaneloop.identification.user_models.user_code import UserCode

__all__ = ["Kernel", "build_kernels"]

Kernel = Callable[..., Any]
Compile = Callable[[Any], Any]


def build_kernels(
    code: UserCode, dispatch: Dispatch, curved: bool = False, surfaces: bool = False
) -> tuple[Kernel, Kernel]:
    """The function ``run`` of the source below for a system: compiled when it is first called, and not compiled.

    curved  it takes curves (`identification.unmodelled.curve_candidates`), too: eight arguments more, `_CURVED`
    surfaces  and surfaces (`identification.user_models.terms`): seven more, `_SURFACES`
    """
    s = code.system
    rates = "\n".join(f"dx[{i}] = d" if code.single else f"dx[{i}] = d[{i}]" for i in range(len(s.states)))
    u = (", ".join(f"u[{i}]" for i in range(len(code.U._fields))) + ",") if s.inputs or s.commands else "0.0,"
    p = (", ".join(f"p[{i}]" for i in range(len(s.parameters))) + ",") if s.parameters else "0.0,"

    def rhs(match: re.Match[str]) -> str:
        indent, at, to = match.groups()
        states = ", ".join(f"AT[{i}]" for i in range(len(s.states))) + ","
        own = _OWN_RATE if dispatch.rate is not None else ""
        at_u, at_p = (u.replace("u[", "ub["), p.replace("p[", "pb[")) if curved else (u, p)
        text = _RHS.format(
            x=states, u=at_u, p=at_p, rates=rates, own=own, bend=_BEND if curved else "", bent=_BENT if curved else ""
        ).strip()
        text = re.sub(r"\bAT\b", at, re.sub(r"\bdx\b", to, text))
        return textwrap.indent(text, indent)

    source = _SOURCE.replace("{accelerations}", _FELT if code.accelerations else "")
    source = source.replace("{anything}", "True" if curved else "len(code) > 0")
    source = re.sub(r"^( *)rhs (\w+) (\w+)$", rhs, source, flags=re.MULTILINE)
    source = source.replace("{own}", _OWN_HELD if dispatch.rate is not None else "")
    felt = "\n".join(
        f"out[{o}, k] += {a!r} * (dx[{w}] - d)" if code.single else f"out[{o}, k] += {a!r} * (dx[{w}] - d[{w}])"
        for o, w, a in code.accelerations
    )
    source = source.replace("{felt}", textwrap.indent(felt, " " * 16).lstrip())
    source = source.replace("{curved}", _CURVED_FUNCTIONS if curved else "")
    source = source.replace("{more}", f", rough, {_CURVED}" if curved else "").replace(
        "{rooms}", _ROOMS if curved else ""
    )
    source = source.replace("{tries}", _TRIES if curved else "").replace("{stays}", _STAYS if curved else "")
    source = source.replace("{rough}", "rough" if curved else "steps")
    source = source.replace("shown(x, u, p, y)", f"shown(x, u, p, k, {_CURVED}, ub, pb, add, y)" if curved else _PLAIN)
    source = source.replace("{as it is}", _AS_IT_IS if surfaces else "")
    source = source.replace("{bend more}", _BEND_MORE if surfaces else "")
    source = source.replace("{show more}", _SHOW_MORE if surfaces else "")
    source = source.replace(_CURVED, f"{_CURVED}, {_SURFACES}") if surfaces else source
    driving = len(s.commands) if s.kind == "closed_loop" else len(code.in_names)
    numbers = {"x0": len(s.states), "inputs": len(code.in_names), "u": max(driving, 1), "out": len(s.outputs)}
    for name, number in numbers.items():  # loops over so many are written out by the compiler
        source = source.replace(f"len({name})", str(number))
    source = source.replace("{outs}", _output_source(code)).replace("{control}", _control_source(code))

    def build(jit: Compile, returned: Compile, inline: Compile, inline_own: Compile) -> Kernel:
        space: dict[str, Any] = {
            "np": np, "jit": jit, "inline": inline, "inline_own": inline_own,
            "X": code.X, "U": code.U, "P": code.P, "Y": code.Y, "R": code.R,
            "model": returned(s.model),
            "output": returned(s.output) if s.output else None,
            "control": returned(s.control) if s.control else None,
            "force_of": laws.force_of, "state_rate": laws.state_rate, "transform": dispatch.transform,
            "own_rate": dispatch.rate, "MEMORY": dispatch.memory, "on_even": on_even, "on_grid": on_grid,
            "LOOP": s.kind == "closed_loop", "INPUT": INPUT, "OUTPUT": OUTPUT, "COLUMN": COLUMN,
            "STATE_LIMIT": laws.STATE_LIMIT, "STATE_RATE_LIMIT": laws.STATE_RATE_LIMIT,
            "STATE_OVERFLOW": laws.STATE_OVERFLOW,
        }  # fmt: skip
        exec(compile(source, f"<{s.name}>", "exec"), space)
        return space["run"]

    def uncompiled(f: Any) -> Any:
        return getattr(f, "py_func", f)

    # Parts of the kernel are compiled into what calls them: a call that hands over a dozen arrays and counts who refers
    # to them takes 0.3 us. What calls the user's functions counts: they may return arrays.
    own = partial(kept_njit, error_model="numpy", nogil=True, forceinline=True)
    returned = partial(compiled_code, in_a_tuple=True)
    return build(compiled_code, returned, partial(own, _nrt=False), own), build(*[uncompiled] * 4)


def _output_source(code: UserCode) -> str:
    s = code.system
    if s.output is not None:
        call = (
            "o = output(X(*xs), U(*us), P(*ps))".replace("X(*xs)", "X({x})")
            .replace("U(*us)", "U({u})")
            .replace("P(*ps)", "P({p})")
        )
        fill = {
            "x": ", ".join(f"x[{i}]" for i in range(len(s.states))),
            "u": ", ".join(f"u[{i}]" for i in range(len(code.U._fields))) if s.inputs or s.commands else "0.0",
            "p": ", ".join(f"p[{i}]" for i in range(len(s.parameters))) if s.parameters else "0.0",
        }
        lines = [call.format(**fill)]
        lines += [f"y[{i}] = o" if code.single_out else f"y[{i}] = o[{i}]" for i in range(len(s.outputs))]
    else:
        states, commands = list(s.states), list(s.commands)
        lines = [
            f"y[{i}] = x[{states.index(o)}]" if o in states else f"y[{i}] = u[{commands.index(o)}]"
            for i, o in enumerate(s.outputs)
        ]
    return "\n    ".join(lines)


def _control_source(code: UserCode) -> str:
    s = code.system
    if s.kind != "closed_loop":
        return "pass"
    r = ", ".join(f"r[{i}]" for i in range(len(code.in_names))) if code.in_names else "0.0"
    y = ", ".join(f"y[{i}]" for i in range(len(s.outputs)))
    p = ", ".join(f"p[{i}]" for i in range(len(s.parameters))) if s.parameters else "0.0"
    lines = [f"c = control(R({r},), Y({y},), P({p},))"]
    lines += [f"u[{i}] = c" if code.single_control else f"u[{i}] = c[{i}]" for i in range(len(s.commands))]
    return "\n    ".join(lines)


# what stands for "rhs x k": the derivative k at x. Written out in place, since handing fifteen arrays to a function
# costs more
_RHS = """
{bend}d = model(X({x}), U({u}), P({p}))
{rates}
if len(code) > 0:
    for i in range(len(code)):
        w = where[i]
        c = code[i]
        {own}if c > 40:
            if c != STATE_LIMIT and c != STATE_RATE_LIMIT and c != STATE_OVERFLOW:
                other = 0.0 if to[i] < INPUT else u[to[i] - INPUT]
                dx[w] -= state_rate(c, AT[w], rows[i], other)
        elif not memory[i]:
            f = force_of(c, against(AT, w, to[i]), way(AT, position, w, to[i]), False, rows[i], own(gap, w, to[i]),
                         own(asymmetry, w, to[i]), small[w], none)
            push(dx, f, w, to[i], mass)
    if holds:
        for w in range(m):
            dx[w] -= held[w]
    if brakes:
        for i in range(len(code)):
            if code[i] == STATE_RATE_LIMIT:
                w = where[i]
                dx[w] = min(max(dx[w], -rows[i, 0]), rows[i, 0])
{bent}"""

# curves: what each does (how: see `bend`) with which signal, state or parameter (at), of which quantity (of; beside it
# what is taken off that, below 0: nothing), from low on with so many points of its table per one of that, the jump of
# each (half its height, where, within how much of the quantity; behind it after how much of that the curve repeats
# itself, 0: never), and the other columns that they may be of
_PLAIN = "outputs(x, u, p, y)"
_CURVED = "c_how, c_at, c_of, c_low, c_per, c_table, c_jump, columns"
_BEND = f"bend(AT, u, p, k, {_CURVED}, ub, pb, add, bent)\n"
_BENT = "for w in range(m):\n    if add[w] != 0.0:\n        dx[w] -= add[w] / mass[w]\n"
# what no curve moves stays as it is for a whole simulation: only what drives the model is new at each step
_ROOMS = """ub, pb, add, bent = np.zeros(len(u)), p.copy(), np.zeros(m), np.zeros(len(out))
    before, side, now_side = np.zeros(m), np.zeros(len(c_how)), np.zeros(len(c_how))"""
# between two samples, ``rough`` steps are tried first where a curve jumps: only an interval that a jump is met in needs
# its many
_TRIES = f"""tries = rough > 0 and not holds
        if tries:
            sides(x, u, p, k, {_CURVED}, bent, side)
            for w in range(m):
                before[w] = x[w]"""
_STAYS = f"""if attempt == 0:
                sides(x, u, p, k, {_CURVED}, bent, now_side)
                met = False
                for i in range(len(c_how)):
                    met |= c_jump[i, 0] != 0.0 and (side[i] == 0.0 or now_side[i] != side[i])
                if not met:
                    break
                for w in range(m):
                    x[w] = before[w]"""
_CURVED_FUNCTIONS = f"""
@inline
def quantity(of, x, u, y, columns, k):
    if of < INPUT:
        return x[of]
    if of < OUTPUT:
        return u[of - INPUT]
    if of < COLUMN:
        return y[of - OUTPUT]
    return columns[of - COLUMN, k]


@inline
def of_both(of, x, u, y, columns, k):
    q = quantity(of[0], x, u, y, columns, k)
    if of[1] >= 0:
        q -= quantity(of[1], x, u, y, columns, k)
    return q


@inline
def within(q, period):
    if period > 0.0:
        q -= np.floor(q / period) * period
    return q


@inline
def on_curve(q, low, per, table, jump):
    q = within(q, jump[3])
    c = on_even(q, low, per, table)
    if jump[0] != 0.0:
        c += jump[0] * min(max((q - jump[1]) / jump[2], -1.0), 1.0)
    return c


@inline
def sides(x, u, p, k, {_CURVED}, y, side):
    for i in range(len(c_how)):
        if c_jump[i, 0] != 0.0:
            if OUTPUT <= c_of[i, 0] < COLUMN:
                outputs(x, u, p, y)
            past = within(of_both(c_of[i], x, u, y, columns, k), c_jump[i, 3]) - c_jump[i, 1]
            side[i] = 1.0 if past > c_jump[i, 2] else -1.0 if past < -c_jump[i, 2] else 0.0


@inline
def as_it_is(how, at, p, pb, add):
    if how == 1:
        pb[at] = p[at]
    elif how == 4:
        add[at] = 0.0


@inline
def put_in(how, at, c, ub, pb, add):
    if how == 1:
        pb[at] *= 1.0 + c
    elif how == 2:
        ub[at] += c
    elif how == 3:
        ub[at] *= 1.0 + c
    else:
        add[at] += c


@inline
def put_on(how, at, c, y):
    if how == 5:
        y[at] += c
    else:
        y[at] *= 1.0 + c


@inline
def bend(x, u, p, k, {_CURVED}, ub, pb, add, y):
    for j in range(len(u)):
        ub[j] = u[j]
    for i in range(len(c_how)):
        as_it_is(c_how[i], c_at[i], p, pb, add)
{{as it is}}
    for i in range(len(c_how)):
        if c_how[i] > 4:
            continue
        if OUTPUT <= c_of[i, 0] < COLUMN:
            outputs(x, u, p, y)
        c = on_curve(of_both(c_of[i], x, u, y, columns, k), c_low[i], c_per[i], c_table[i], c_jump[i])
        put_in(c_how[i], c_at[i], c, ub, pb, add)
{{bend more}}

@inline
def shown(x, u, p, k, {_CURVED}, ub, pb, add, y):
    bend(x, u, p, k, {_CURVED}, ub, pb, add, y)
    outputs(x, ub, pb, y)
    for i in range(len(c_how)):
        if c_how[i] > 4:
            c = on_curve(of_both(c_of[i], x, u, y, columns, k), c_low[i], c_per[i], c_table[i], c_jump[i])
            put_on(c_how[i], c_at[i], c, y)
{{show more}}

"""
_SURFACES = "f_how, f_at, f_of, f_low, f_high, f_table, f_columns"
_AS_IT_IS = """
    for i in range(len(f_how)):
        as_it_is(f_how[i], f_at[i], p, pb, add)
"""
_BEND_MORE = """
    for i in range(len(f_how)):
        if f_how[i] > 4:
            continue
        if OUTPUT <= f_of[i, 0] < COLUMN or OUTPUT <= f_of[i, 1] < COLUMN:
            outputs(x, u, p, y)
        c = on_grid(quantity(f_of[i, 0], x, u, y, f_columns, k), quantity(f_of[i, 1], x, u, y, f_columns, k), f_low[i],
                    f_high[i], f_table[i])
        put_in(f_how[i], f_at[i], c, ub, pb, add)
"""
_SHOW_MORE = """
    for i in range(len(f_how)):
        if f_how[i] > 4:
            c = on_grid(quantity(f_of[i, 0], x, u, y, f_columns, k), quantity(f_of[i, 1], x, u, y, f_columns, k),
                        f_low[i], f_high[i], f_table[i])
            put_on(f_how[i], f_at[i], c, y)
"""

_OWN_RATE = """if c > 100:
            if not memory[i]:
                dx[w] -= own_rate(c, AT[w], AT[position[w]], now, 1.0, rows[i], none) / mass[w]
        el"""
_OWN_HELD = """if memory[i] and code[i] > 100:
                        w = where[i]
                        since = 0.0 if first else h
                        held[w] += own_rate(code[i], x[w], x[position[w]], now, since, rows[i], remembered[i]) / mass[w]
                    el"""

# an output that is an acceleration by the model's own equations feels what laws and curves make of that
_FELT = """if {anything}:
                now = t[k]
                if holds:
                    for w in range(m):
                        held[w] = 0.0
                for i in range(len(code) if holds else 0):
                    if memory[i] and code[i] <= 40:
                        for j in range(MEMORY):
                            none[j] = remembered[i, j]
                        w = where[i]
                        f = force_of(code[i], against(x, w, to[i]), way(x, position, w, to[i]), first, rows[i],
                                     own(gap, w, to[i]), own(asymmetry, w, to[i]), small[w], none)
                        push(held, -f, w, to[i], mass)
                rhs x dx
                {felt}"""

_SOURCE = """
@inline_own
def outputs(x, u, p, y):
    {outs}


@inline_own
def controls(r, y, p, u):
    {control}


@inline
def between(u, slope, t, k, part):
    h, rise = t[k + 1] - t[k], u[k + 1] - u[k]
    return part * (1.0 - part) * ((1.0 - part) * (h * slope[k] - rise) - part * (h * slope[k + 1] - rise))


# a force acts on a body from outside, or between two (to: the other velocity), with its reaction on the other; what
# changes the forces on a body changes none of those
@inline
def against(x, w, to):
    return x[w] - x[to] if to >= 0 else x[w]


@inline
def way(x, position, w, to):
    return x[position[w]] - x[position[to]] if to >= 0 else x[position[w]]


@inline
def own(of, w, to):
    return 0.0 if to >= 0 else of[w]


@inline
def push(dx, f, w, to, mass):
    dx[w] -= f / mass[w]
    if to >= 0:
        dx[to] += f / mass[to]


{curved}@jit
def run(t, inputs, p, x0, restart, at_restart, code, where, to, memory, rows, position, gap, asymmetry, small, mass,
        steps, line, slopes, n_commands, e_code, e_at, e_out, e_rows, out{more}):
    n, m = len(t), len(x0)
    x = x0.copy()
    u = np.zeros(max(n_commands if LOOP else len(inputs), 1))
    r = np.zeros(max(len(inputs), 1))
    y = np.zeros(len(out))
    seen = np.zeros(len(out))
    remembered = np.zeros((len(code), MEMORY))
    e_memory = np.zeros((len(e_code), MEMORY))
    e_past = np.zeros((len(e_code), n if LOOP else 1))
    none = np.zeros(MEMORY)
    held = np.zeros(m)
    dx, total, z = np.zeros(m), np.zeros(m), np.zeros(m)
    {rooms}
    holds = brakes = limits = False
    for i in range(len(code)):
        holds |= memory[i]
        brakes |= code[i] == STATE_RATE_LIMIT
        limits |= code[i] == STATE_LIMIT or code[i] == STATE_OVERFLOW
    first = True
    for k in range(n):
        if restart[k]:
            for j in range(m):
                x[j] = at_restart[j, k]
            first = True
        if LOOP:
            for j in range(len(inputs)):
                r[j] = inputs[j, k]
            shown(x, u, p, y)
            for j in range(len(out)):
                seen[j] = y[j]
            for i in range(len(e_code)):
                if e_out[i]:
                    e_past[i, k] = seen[e_at[i]]
                    seen[e_at[i]] = transform(e_code[i], k, t, e_past[i], e_rows[i], e_memory[i])
            controls(r, seen, p, u)
            shown(x, u, p, y)
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
            shown(x, u, p, y)
            for j in range(len(out)):
                out[j, k] = y[j]
            {accelerations}
        if k == n - 1:
            break
        tries = False
        {tries}
        for attempt in range(0 if tries else 1, 2):
            many = {rough} if attempt == 0 else steps
            h = (t[k + 1] - t[k]) / many
            for q in range(many):
                now = t[k] + q * h
                if holds:
                    for w in range(m):
                        held[w] = 0.0
                for i in range(len(code) if holds else 0):
                    {own}if memory[i] and code[i] <= 40:
                        w = where[i]
                        v, d = against(x, w, to[i]), way(x, position, w, to[i])
                        g, a = own(gap, w, to[i]), own(asymmetry, w, to[i])
                        f = force_of(code[i], v, d, first, rows[i], g, a, small[w], remembered[i])
                        for j in range(MEMORY):
                            none[j] = remembered[i, j]
                        f = force_of(code[i], v, d + 0.5 * h * v, False, rows[i], g, a, small[w], none)
                        push(held, -f, w, to[i], mass)
                first = False
                # the four slopes of Runge and Kutta; written out four times, they took 2.4 times as long to compile
                for j in range(4):
                    part = q + 0.5 * ((j + 1) // 2)
                    now = t[k] + part * h
                    if line and not LOOP:
                        for i in range(len(inputs)):
                            u[i] = inputs[i, k] + (inputs[i, k + 1] - inputs[i, k]) * part / many
                            if len(slopes) > 0:
                                u[i] += between(inputs[i], slopes[i], t, k, part / many)
                    for w in range(m):
                        z[w] = x[w] + 0.5 * ((j + 1) // 2) * h * dx[w] if j > 0 else x[w]
                    rhs z dx
                    for w in range(m):
                        if j == 0:
                            total[w] = dx[w]
                        elif j < 3:
                            total[w] += 2.0 * dx[w]
                        else:
                            x[w] += h / 6.0 * (total[w] + dx[w])
                for i in range(len(code) if limits else 0):
                    if code[i] == STATE_LIMIT:
                        w = where[i]
                        x[w] = min(max(x[w], rows[i, 0]), rows[i, 1])
                    elif code[i] == STATE_OVERFLOW:  # what is cut off goes into another state
                        w = where[i]
                        over = max(x[w] - rows[i, 0], 0.0)
                        x[w] -= over
                        x[to[i]] += rows[i, 1] * over
            {stays}
        for w in range(m):
            if not np.isfinite(x[w]) or abs(x[w]) > 1e150:
                return
"""
