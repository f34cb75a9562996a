"""Simulation of a system of any family with hidden laws: scipy's LSODA where all is smooth, DOP853 with events where
something switches (stick and slip, overflow, end stops).

Signal laws act on inputs on a grid `FINE` times finer than the log, and on outputs on that grid; then the log's samples
are taken. Nothing of the product is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.integrate import odeint, solve_ivp

from tests.rig_systems.family import Array, Family, Hidden
from tests.rig_systems.laws import SIGNAL_MEMORY, on_signal, state_loss

__all__ = ["FINE", "course", "simulate"]

FINE = 8  # grid points from sample to sample
RTOL = 1e-7
Motion = tuple[Array, Array, Array]


def simulate(
    f: Family, p: Any, hidden: Sequence[Hidden], t: Array, drive: Array | Motion, greatest: dict[str, float]
) -> Array:
    """Outputs float64[outputs, samples] without noise.

    drive     float64[inputs, samples] on ``t``; for kind force the motion on the fine grid
    greatest  place -> magnitude that the law square_root leaves as it is
    """
    return course(f, p, hidden, t, drive, greatest)[0]


def course(
    f: Family, p: Any, hidden: Sequence[Hidden], t: Array, drive: Any, greatest: dict[str, float]
) -> tuple[Array, Array, Array]:
    """Outputs on the log's samples; states (or the motion) and inputs on the fine grid."""
    h = (t[1] - t[0]) / FINE
    fine = t[0] + h * np.arange((len(t) - 1) * FINE + 1)
    if f.kind == "force":
        states = np.array(drive)
        y = np.array([_force(f, p, hidden, drive, fine)])
        u = np.zeros((0, len(fine)))
    else:
        u, steps = _inputs(f, p, hidden, t, drive, fine, greatest)
        if f.kind == "static":
            states = np.zeros((0, len(fine)))
            y = np.array([np.asarray(f.rhs(u, p), dtype=float)])
        else:
            run = _loop if f.kind == "closed_loop" else _integrate
            states = run(f, p, hidden, fine, u, steps, greatest)
            y = np.array(
                f.output(states, u, p) if f.output else [states[f.states.index(o)] for o in f.outputs], dtype=float
            )
    s = (fine - fine[0]) / (fine[-1] - fine[0])
    for hid in hidden:
        outside = f.outside.get(hid.name)
        if outside and outside.output:
            y = np.array(outside.output(s, states, u, p, hid.values["size"], y), dtype=float)
        elif not outside and f.where(hid.place)[0] == "output":
            k = f.where(hid.place)[1]
            y[k] = on_signal(hid.law, hid.values, y[k], h, False, greatest.get(hid.place, 1.0))
    return y[:, ::FINE], states, u


def _inputs(
    f: Family, p: Any, hidden: Sequence[Hidden], t: Array, drive: Array, fine: Array, greatest: dict[str, float]
) -> tuple[Array, list[bool]]:
    """What drives the system, on the fine grid, after the laws of the inputs; which inputs hold between points."""
    h = fine[1] - fine[0]
    rows, steps = [], []
    for i in range(len(f.inputs)):
        y = np.interp(fine, t, drive[i]) if f.line else np.append(np.repeat(drive[i][:-1], FINE), drive[i][-1])
        hold = not f.line
        for hid in hidden:
            if hid.name not in f.outside and f.where(hid.place) == ("input", i):
                y = on_signal(hid.law, hid.values, y, h, hold, greatest.get(hid.place, 1.0))
                hold = hold and (hid.law not in SIGNAL_MEMORY or hid.law in ("dead_time", "play"))
        rows.append(y)
        steps.append(hold)
    u = np.array(rows).reshape(len(rows), len(fine))
    for hid in hidden:
        outside = f.outside.get(hid.name)
        if outside and outside.source:
            u = np.array(outside.source((fine - fine[0]) / (fine[-1] - fine[0]), u, p, hid.values["size"]))
    return u, steps


class _Friction:
    """Dry friction on one velocity: it slips either way, or sticks until the load exceeds what breaks it away."""

    def __init__(self, w: int, laws: list[Hidden], difference: float):
        self.w, self.laws, self.difference = w, laws, difference
        self.mode = 0

    def size(self, v: float, way: int) -> float:
        total = 0.0
        for hid in self.laws:
            q = hid.values
            total += q["friction"] + q.get("breakaway_excess", 0.0) * math.exp(-((v / q.get("speed", 1.0)) ** 2))
        return total * (1.0 + way * self.difference)


class _System:
    """The equation of motion of a family with the hidden laws in it.

    Vector z: the family's states, then the force or deflection of each hysteretic element.
    """

    def __init__(self, f: Family, p: Any, hidden: Sequence[Hidden], span: tuple[float, float]):
        self.f, self.p, self.n = f, p, len(f.states)
        self.start, self.length = span[0], span[1] - span[0]
        inside = [g for g in hidden if g.name not in f.outside and f.where(g.place)[0] in ("force", "state")]
        self.rates: list[tuple[int, Hidden]] = []
        self.forces: list[tuple[int, Hidden]] = []
        self.springs: list[list[Any]] = []  # state, law, mode: 0 elastic, +-1 the slider moves
        self.slopes: list[tuple[int, float]] = []
        self.limits: list[list[Any]] = []  # state, low, high, mode
        self.gap = dict.fromkeys(range(self.n), 0.0)
        rubbing: dict[int, list[Hidden]] = {}
        uneven = dict.fromkeys(range(self.n), 0.0)
        for g in inside:
            kind, w = f.where(g.place)
            if kind == "state" and g.law == "saturation":
                self.limits.append([w, g.values["low"], g.values["high"], 0])
            elif kind == "state" and g.law == "rate_limit":
                self.slopes.append((w, g.values["rate"]))
            elif kind == "state":
                self.rates.append((w, g))
            elif g.law == "backlash_gap":
                self.gap[w] += 0.5 * g.values["gap"]
            elif g.law == "friction_asymmetry":
                uneven[w] += g.values["difference"]
            elif g.law in ("coulomb", "stribeck"):
                rubbing.setdefault(w, []).append(g)
            elif g.law in ("elastic_plastic", "bouc_wen"):
                self.springs.append([w, g, 0])
            else:
                self.forces.append((w, g))
        self.friction = [_Friction(w, laws, uneven[w]) for w, laws in rubbing.items()]
        self.outside = [
            (f.outside[g.name].rate, g.values["size"]) for g in hidden if g.name in f.outside and f.outside[g.name].rate
        ]
        self.mass = [getattr(p, f.masses[n]) if n in f.masses else 1.0 for n in f.states]
        self.place = [f.states.index(f.rates[n]) if n in f.rates else -1 for n in f.states]

    @property
    def switches(self) -> bool:
        return bool(self.friction or self.limits or any(g.law == "elastic_plastic" for _, g, _ in self.springs))

    def first(self, u: Sequence[float]) -> list[float]:
        x = list(self.f.start(self.p, u)) if self.f.start else [0.0] * self.n
        for limit in self.limits:
            x[limit[0]] = min(max(x[limit[0]], limit[1]), limit[2])
        return [*x, *([0.0] * len(self.springs))]

    def smooth(self, t: float, z: Any, u: Sequence[float]) -> list[float]:
        """Derivatives without dry friction and limits."""
        x = [float(v) for v in z[: self.n]]
        d = [float(v) for v in self.f.rhs(x, u, self.p)]
        for rate, size in self.outside:
            d = rate((t - self.start) / self.length, x, u, self.p, size, d)
        for w, g in self.rates:
            d[w] -= state_loss(g.law, g.values, x[w])
        for w, g in self.forces:
            d[w] -= _plain(g, x[w], x[self.place[w]], self.gap[w]) / self.mass[w]
        more = []
        for k, (w, g, mode) in enumerate(self.springs):
            force, rate = _spring(g, float(z[self.n + k]), x[w], self.gap[w], mode)
            d[w] -= force / self.mass[w]
            more.append(rate)
        for w, most in self.slopes:
            d[w] = min(max(d[w], -most), most)
        return [*d, *more]

    def __call__(self, t: float, z: Any, u: Sequence[float]) -> list[float]:
        d = self.smooth(t, z, u)
        for rub in self.friction:
            if rub.mode == 0:
                d[rub.w] = 0.0
            else:
                d[rub.w] -= rub.mode * rub.size(z[rub.w], rub.mode) / self.mass[rub.w]
        for w, _, _, mode in self.limits:
            if mode:
                d[w] = min(d[w], 0.0) if mode > 0 else max(d[w], 0.0)
        return d

    def settle(self, t: float, z: list[float], u: Sequence[float]) -> None:
        """Choose the modes at a state: after an event, and where an input has jumped."""
        for rub in self.friction:
            if z[rub.w] != 0.0:
                rub.mode = 1 if z[rub.w] > 0.0 else -1
                continue
            load = self.smooth(t, z, u)[rub.w] * self.mass[rub.w]
            rub.mode = 1 if load > rub.size(0.0, 1) else -1 if load < -rub.size(0.0, -1) else 0
        for limit in self.limits:
            w, low, high, _ = limit
            near = 1e-9 * max(abs(z[w]), 1e-12)
            limit[3] = 0
            if z[w] >= high - near:
                z[w], limit[3] = high, 1 if self.smooth(t, z, u)[w] > 0.0 else 0
            elif z[w] <= low + near:
                z[w], limit[3] = low, -1 if self.smooth(t, z, u)[w] < 0.0 else 0

        for k, spring in enumerate(self.springs):
            w, g, _ = spring
            if g.law == "elastic_plastic":
                most, s = self.most(spring), z[self.n + k]
                way = 1 if s >= most * (1 - 1e-9) else -1 if s <= -most * (1 - 1e-9) else 0
                spring[2] = way if way * z[w] > 0.0 else 0
                if way:
                    z[self.n + k] = way * most

    def most(self, spring: list[Any]) -> float:
        """Deflection at which the slider of an element moves."""
        w, g, _ = spring
        return self.gap[w] + g.values["friction"] / g.values["stiffness"]

    def events(self, at: Callable[[float], Sequence[float]]) -> list[Any]:
        """What ends the present modes."""
        out: list[Any] = []

        def add(g: Callable[[float, Any], float], way: int) -> None:
            g.terminal, g.direction = True, way  # type: ignore[attr-defined]
            out.append(g)

        for rub in self.friction:
            w, m = rub.w, self.mass[rub.w]
            if rub.mode:
                add(lambda t, z, w=w: z[w], -rub.mode)
            else:
                add(lambda t, z, w=w, m=m, r=rub: self.smooth(t, z, at(t))[w] * m - r.size(0.0, 1) * (1 + 1e-9), 1)
                add(lambda t, z, w=w, m=m, r=rub: self.smooth(t, z, at(t))[w] * m + r.size(0.0, -1) * (1 + 1e-9), -1)
        for w, low, high, mode in self.limits:
            if mode:
                add(lambda t, z, w=w: self.smooth(t, z, at(t))[w], -mode)
            else:
                add(lambda t, z, w=w, b=high: z[w] - b, 1)
                add(lambda t, z, w=w, b=low: z[w] - b, -1)
        for k, spring in enumerate(self.springs):
            w, g, mode = spring
            most = self.most(spring)
            if g.law == "elastic_plastic" and mode:
                add(lambda t, z, w=w: z[w], -mode)
            elif g.law == "elastic_plastic":
                add(lambda t, z, k=k + self.n, b=most: z[k] - b, 1)
                add(lambda t, z, k=k + self.n, b=most: z[k] + b, -1)
        return out


def _plain(g: Hidden, v: float, x: float, half: float) -> float:
    """Force of a law without memory, against positive motion."""
    q = g.values
    if g.law == "force_offset":
        return q["force"]
    if g.law == "viscous":
        return q["coefficient"] * v
    if g.law == "quadratic_drag":
        return q["coefficient"] * v * abs(v)
    d = math.copysign(max(abs(x) - half, 0.0), x)
    return q["stiffness"] * d if g.law == "spring" else q["stiffness"] * d**3


def _spring(g: Hidden, s: float, v: float, half: float, mode: int = 0) -> tuple[float, float]:
    """Force of a hysteretic element and the rate of its state.

    elastic_plastic: s is the deflection between the end and the slider, which moves in modes +-1.
    bouc_wen: s is the force, F' = k v (1 - abs(F/f)^n) while it is loaded, k v while it is relieved.
    """
    k, f = g.values["stiffness"], g.values["friction"]
    if g.law == "elastic_plastic":
        e = math.copysign(max(abs(s) - half, 0.0), s)
        force = min(max(k * e, -f), f)
        return force, 0.0 if mode else v
    loaded = s * v > 0.0
    return s, k * v * (max(1.0 - (abs(s) / f) ** g.values["sharpness"], 0.0) if loaded else 1.0)


def _segments(u: Array, steps: list[bool]) -> list[int]:
    """Grid points at which an input that stands still jumps, with both ends."""
    n = u.shape[1] if u.size else 0
    jump = np.zeros(n, dtype=bool)
    for row, hold in zip(u, steps, strict=True):
        if hold:
            jump[1:] |= row[1:] != row[:-1]
    return sorted({0, *np.flatnonzero(jump).tolist(), n - 1})


def _integrate(
    f: Family, p: Any, hidden: Sequence[Hidden], fine: Array, u: Array, steps: list[bool], greatest: dict[str, float]
) -> Array:
    """States on the fine grid, driven by ``u``."""
    system = _System(f, p, hidden, (float(fine[0]), float(fine[-1])))
    out = np.empty((system.n, len(fine)))
    z = system.first([float(v) for v in u[:, 0]])
    at = _segments(u, steps)
    rows = [row.tolist() for row in u]
    h, t0 = float(fine[1] - fine[0]), float(fine[0])
    for a, b in zip(at[:-1], at[1:], strict=True):
        held = [float(row[a]) for row in u]

        def inputs(t: float, held: list[float] = held, last: int = len(fine) - 2) -> list[float]:
            i = min(max(int((t - t0) / h), 0), last)
            s = (t - t0) / h - i
            return [
                c if hold else row[i] + (row[i + 1] - row[i]) * s
                for c, row, hold in zip(held, rows, steps, strict=True)
            ]

        z = _advance(system, z, fine[a : b + 1], inputs, out[:, a : b + 1], all(steps))
    return out


def _advance(
    system: _System, z: list[float], t: Array, inputs: Callable[[float], list[float]], out: Array, still: bool
) -> list[float]:
    """Integrate over one segment into ``out``; the state at its end."""
    most = 0.0 if still else 2.0 * FINE * float(t[1] - t[0])
    if not system.switches:
        got, info = odeint(
            lambda z, t: system(t, z, inputs(t)), z, t, rtol=RTOL, atol=1e-10, hmax=most, mxstep=20000, full_output=True
        )
        if "successful" not in info["message"] or not np.isfinite(got).all():
            raise RuntimeError(f"{system.f.name}: {info['message']}")
        out[:] = got[:, : system.n].T
        return [float(v) for v in got[-1]]
    now, end = float(t[0]), float(t[-1])
    out[:, 0] = z[: system.n]
    for _ in range(100_000):
        system.settle(now, z, inputs(now))
        rest = t[t > now]
        got = solve_ivp(
            lambda s, y: system(s, y, inputs(s)), (now, end), z, "DOP853", rest, events=system.events(inputs),
            rtol=RTOL, atol=1e-10, max_step=most or np.inf,
        )  # fmt: skip
        n = got.y.shape[1] if np.size(got.y) else 0
        k = len(t) - len(rest)
        if n:
            out[:, k : k + n] = got.y[: system.n]
        if got.status != 1:
            if got.status < 0:
                raise RuntimeError(f"{system.f.name}: {got.message}")
            return [float(v) for v in got.y[:, -1]]
        which = next(i for i, e in enumerate(got.t_events) if len(e))
        now, z = float(got.t_events[which][0]), [float(v) for v in got.y_events[which][0]]
        for w in {*(rub.w for rub in system.friction), *(spring[0] for spring in system.springs)}:
            if abs(z[w]) < 1e-7 * float(np.abs(out[w, : k + n + 1]).max()):
                z[w] = 0.0  # it came to rest exactly
        if now >= end:
            return z
    raise RuntimeError(f"{system.f.name}: switches without end")


def _loop(
    f: Family, p: Any, hidden: Sequence[Hidden], fine: Array, u: Array, steps: list[bool], greatest: dict[str, float]
) -> Array:
    """States on the fine grid with the loop closed: the controller acts once a sample, on what its sensors say."""
    assert f.control is not None
    system = _System(f, p, hidden, (float(fine[0]), float(fine[-1])))
    out = np.empty((system.n, len(fine)))
    z = system.first([float(v) for v in u[:, 0]])
    for a in range(0, len(fine) - 1, FINE):
        y = [z[f.states.index(o)] for o in f.outputs]
        for g in hidden:
            if g.name not in f.outside and f.where(g.place)[0] == "output":
                k = f.where(g.place)[1]
                y[k] = float(on_signal(g.law, g.values, np.array([y[k]]), 1.0, True, greatest.get(g.place, 1.0))[0])
        if not all(abs(v) < 1e6 for v in y):
            raise RuntimeError(f"{f.name}: the loop is unstable")
        c = float(f.control([float(v) for v in u[:, a]], y, p))
        for g in hidden:
            if g.name not in f.outside and f.where(g.place)[0] == "command":
                c = float(on_signal(g.law, g.values, np.array([c]), 1.0, True, greatest.get(g.place, 1.0))[0])

        def inputs(t: float, c: float = c) -> list[float]:
            return [c]

        z = _advance(system, z, fine[a : a + FINE + 1], inputs, out[:, a : a + FINE + 1], True)
    return out


def _force(f: Family, p: Any, hidden: Sequence[Hidden], motion: Motion, fine: Array) -> Array:
    """Measured force of a motion that a test rig imposes: inverse dynamics, laws with memory solved step by step."""
    x, v, _ = motion
    y = np.asarray(f.rhs(motion, p), dtype=float)
    way = np.sign(v)
    inside = [g for g in hidden if g.name not in f.outside and g.place == "force"]
    gap = 0.5 * sum(g.values["gap"] for g in inside if g.law == "backlash_gap")
    uneven = sum(g.values["difference"] for g in inside if g.law == "friction_asymmetry")
    for g in inside:
        q = g.values
        if g.law in ("coulomb", "stribeck"):
            excess = q.get("breakaway_excess", 0.0) * np.exp(-((v / q.get("speed", 1.0)) ** 2))
            y = y + (q["friction"] + excess) * way * (1.0 + uneven * way)
        elif g.law in ("elastic_plastic", "bouc_wen"):
            y = y + _element(g, x, gap)
        elif g.law not in ("backlash_gap", "friction_asymmetry"):
            y = y + np.array([_plain(g, vi, xi, gap) for vi, xi in zip(v.tolist(), x.tolist(), strict=True)])
    return y


def _element(g: Hidden, x: Array, gap: float) -> Array:
    """Force of a hysteretic element over a motion, rate-independent: integrated over the way."""
    k, f = g.values["stiffness"], g.values["friction"]
    out = np.zeros(len(x))
    s = 0.0
    for i in range(1, len(x)):
        dx = float(x[i] - x[i - 1])
        if g.law == "elastic_plastic":
            s = min(max(s + dx, -gap - f / k), gap + f / k)
            out[i] = k * math.copysign(max(abs(s) - gap, 0.0), s)
            continue
        for _ in range(4):  # midpoint rule over a quarter of the way
            _, r0 = _spring(g, s, dx, 0.0)
            _, r1 = _spring(g, s + 0.125 * r0, dx, 0.0)
            s = min(max(s + 0.25 * r1, -f), f)
        out[i] = s
    return out
