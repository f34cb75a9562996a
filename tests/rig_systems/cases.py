"""Draw a system, hide laws in it, simulate its logs, and say whether what is hidden can be seen at all."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tests.rig_systems import electric, mechanical, process
from tests.rig_systems.family import Array, Family, Hidden, Outside
from tests.rig_systems.laws import Size, draw_values
from tests.rig_systems.signals import motion, signal
from tests.rig_systems.simulate import FINE, course, simulate

__all__ = ["FAMILIES", "KINDS", "Case", "Log", "draw_case", "left_over", "place_size"]

FAMILIES: dict[str, Family] = {f.name: f for f in (*process.FAMILIES, *electric.FAMILIES, *mechanical.FAMILIES)}
KINDS = ("clean", "outside", "pair", "single")
SHARES = (0.25, 0.25, 0.20, 0.30)
RATES = tuple(m * 10.0**e for e in range(-1, 4) for m in (1.0, 2.0, 5.0) if 0.2 <= m * 10.0**e <= 2000.0)  # Hz
QUANTISED = 0.2  # of the sensors give whole steps
WRONG = 10.0  # factor by which a start is off at most
TRIES = 20  # draws of sizes until the system stays within bounds
CHORDS = 4  # steps of the refit that decides whether a law can be seen


@dataclass
class Log:
    """One log before noise: what drives the system (see `simulate`), on ``t``, and of which kind it is."""

    kind: str
    t: Array
    drive: Any
    outputs: Array = field(default_factory=lambda: np.zeros(0))


@dataclass
class Case:
    """One system of the benchmark.

    values   its true parameters; ``factors``: by how much the nominal model's starts are off
    hidden   what the nominal model lacks
    floors   output -> RMS of noise and rounding; ``steps``: output -> step of rounding, 0 where there is none
    logs     the fitted logs and, last, the test log
    greatest  place -> magnitude that the law square_root leaves as it is
    """

    index: int
    family: Family
    kind: str
    p: Any
    factors: dict[str, float]
    hidden: list[Hidden]
    rate: float
    logs: list[Log]
    noise: dict[str, float]
    steps: dict[str, float]
    greatest: dict[str, float]
    seed: list[int]

    @property
    def values(self) -> dict[str, float]:
        """True parameters and what is known, by name."""
        return dict(vars(self.p))

    @property
    def floors(self) -> Array:
        """RMS of noise and rounding of every output."""
        return np.array([(self.noise[o] ** 2 + self.steps[o] ** 2 / 12.0) ** 0.5 for o in self.family.outputs])

    def columns(self, k: int, noisy: bool = True) -> dict[str, Array]:
        """Channels of log ``k`` as a logger writes them."""
        rng = np.random.default_rng([*self.seed, 1000 + k])
        f, log = self.family, self.logs[k]
        out: dict[str, Array] = {}
        if f.kind == "force":
            out["position"] = log.drive[0][::FINE] + noisy * self.noise["position"] * rng.standard_normal(len(log.t))
        else:
            out |= {name: row.copy() for name, row in zip(f.inputs, log.drive, strict=True)}
        for name, y in zip(f.outputs, log.outputs, strict=True):
            z = y + noisy * self.noise[name] * rng.standard_normal(len(y))
            out[name] = np.round(z / self.steps[name]) * self.steps[name] if noisy and self.steps[name] else z
        return out


def _rate(f: Family, scale: float, rng: np.random.Generator) -> float:
    """A rate that loggers have, with the family's samples in a time scale."""
    wanted = rng.uniform(*f.per_scale) / scale
    return min(RATES, key=lambda r: abs(np.log(r / wanted)))


def _log(f: Family, p: Any, kinds: list[str], rate: float, n: int, rng: np.random.Generator) -> Log:
    t = np.arange(n) / rate
    scale = max(f.timescale(p), 10.0 / rate)
    if f.kind == "force":
        fine = np.arange((n - 1) * FINE + 1) / (rate * FINE)
        (s,) = f.inputs.values()
        return Log(kinds[0], t, motion(kinds[0], fine, scale, s.high, rng))
    rows = []
    for kind, s in zip(kinds, f.inputs.values(), strict=True):
        size = s.scale(p) if s.scale else 1.0
        rows.append(signal(kind, t, scale, s.low * size, s.high * size, f.line, rng))
    return Log("+".join(kinds), t, np.array(rows))


def place_size(f: Family, p: Any, logs: list[Log], place: str) -> Size:
    """How large the nominal system is at a place, over the fitted logs."""
    kind, at = f.where(place)
    values, rates, forces, speeds, ways = [], [], [], [], []
    mass = 1.0
    for log in logs:
        y, states, u = course(f, p, [], log.t, log.drive, {})
        h = (log.t[1] - log.t[0]) / FINE
        if kind == "command":
            assert f.control is not None
            row = np.array([f.control(u[:, i], states[:, i], p) for i in range(0, u.shape[1], FINE)])
            h *= FINE
        elif kind == "input":
            row, h = log.drive[at], h * FINE
        elif f.kind == "force" and kind == "force":
            row = states[1]
            speeds.append(states[1])
            ways.append(states[0])
            forces.append(y[0])
        elif kind in ("state", "force"):
            row = states[at]
        else:
            row, h = y[at], h * FINE
        values.append(row)
        rates.append(np.gradient(row, h))
        if kind == "force" and f.kind != "force":
            name = f.states[at]
            mass = getattr(p, f.masses[name]) if name in f.masses else 1.0
            forces.append(mass * rates[-1])
            speeds.append(row)
            ways.append(states[f.states.index(f.rates[name])])
    v, r = np.concatenate(values), np.concatenate(rates)
    low, high = np.quantile(v, [0.001, 0.999])
    scale = f.timescale(p)
    # in a slow test inflow and outflow, or spring and drive, all but cancel: what flows is the spread in a time scale
    rate = max(float(np.sqrt(np.mean(r**2))), float(np.std(v)) / scale)
    more = {}
    if kind == "force":
        x = np.concatenate(ways)
        force = float(np.sqrt(np.mean(np.concatenate(forces) ** 2)))
        if f.kind != "force" and f.rates[f.states[at]] in f.outputs:
            force = max(force, mass * float(np.std(x)) * (2.0 / scale) ** 2)
        more = {
            "force": force, "speed": float(np.sqrt(np.mean(np.concatenate(speeds) ** 2))),
            "travel": 0.5 * float(np.ptp(x)),
        }  # fmt: skip
    return Size(
        float(low), float(high), rate, float(np.quantile(np.abs(r), 0.999)), scale,
        float(logs[0].t[1] - logs[0].t[0]), **more,
    )  # fmt: skip


def hide(f: Family, p: Any, logs: list[Log], names: list[str], rng: np.random.Generator) -> list[Hidden]:
    """Laws of these names with sizes that suit the system."""
    out = []
    for name in names:
        if name in f.outside:
            o = f.outside[name]
            out.append(Hidden(name, {"size": float(np.exp(rng.uniform(np.log(o.low), np.log(o.high))))}))
            continue
        place, _, law = name.rpartition(".")
        out.append(Hidden(name, draw_values(law, f.where(place)[0], place_size(f, p, logs, place), rng)))
    return out


def _names(f: Family, kind: str, rng: np.random.Generator) -> list[str]:
    alone = [name for name in f.laws if name not in f.partners]
    if kind == "single":
        return [str(rng.choice(alone))]
    if kind == "outside":
        return [str(rng.choice(list(f.outside)))]
    if kind == "pair":
        first = str(rng.choice(list(f.laws)))
        if first in f.partners:
            return [f.partners[first], first]
        others = [n for n in alone if n not in f.equivalent(first)]
        return [first, str(rng.choice(others))]
    return []


def draw_case(
    seed: int, index: int, families: tuple[str, ...] = (), names: list[str] | None = None, samples: int | None = None,
    extra: Mapping[str, Outside] | None = None, kinds: Collection[str] = KINDS,
) -> Case:  # fmt: skip
    """System ``index`` of the series ``seed``, simulated.

    kinds     of `KINDS`, that are drawn
    families  to draw from (default: all); ``names``: what to hide instead of drawing it; ``samples``: a log's length
    extra     laws that the library does not have, beside the family's
    """
    rng = np.random.default_rng([seed, index])
    shares = np.where(np.isin(KINDS, list(kinds)), SHARES, 0.0)
    kind = str(rng.choice(KINDS, p=shares / shares.sum()))
    f = FAMILIES[str(rng.choice(families or list(FAMILIES)))]
    f = replace(f, outside={**f.outside, **extra}) if extra else f
    p = f.draw(rng)
    factors = {k: float(WRONG ** rng.uniform(-1.0, 1.0)) for k in f.parameters}
    rate = _rate(f, f.timescale(p), rng)
    n = samples or int(rng.integers(*f.samples))
    count = int(rng.integers(1, 4)) + 1
    orders = [rng.permutation(len(s.kinds)) for s in f.inputs.values()]
    logs = []
    for k in range(count):
        kinds = [s.kinds[o[k % len(o)]] for s, o in zip(f.inputs.values(), orders, strict=True)]
        logs.append(_log(f, p, kinds, rate, n, rng))
    names = _names(f, kind, rng) if names is None else names
    runs = [simulate(f, p, [], log.t, log.drive, {}) for log in logs]
    nominal = np.concatenate(runs[:-1], axis=1)
    noise, steps = {}, {}
    for name, share in f.noise.items():
        spread = float(np.std(nominal[f.outputs.index(name)])) if name in f.outputs else f.inputs[name].high
        noise[name] = spread * float(np.exp(rng.uniform(np.log(share[0]), np.log(share[1]))))
        steps[name] = noise[name] * float(rng.uniform(0.5, 1.5)) if rng.random() < QUANTISED else 0.0
    case = Case(index, f, kind, p, factors, [], rate, logs, noise, steps, {}, [seed, index])
    for _ in range(TRIES):
        case.hidden = hide(f, p, logs[:-1], names, rng)
        if _simulated(case, np.concatenate(runs, axis=1)):
            return case
    raise RuntimeError(f"{f.name}: no run that ends well in {TRIES} draws of {', '.join(names)}")


def _simulated(case: Case, nominal: Array) -> bool:
    """Simulate the logs; False where the system leaves all bounds (a levitated ball drops): nobody has such logs."""
    f, p = case.family, case.p
    case.greatest = {
        g.place: place_size(f, p, case.logs[:-1], g.place).greatest
        for g in case.hidden
        if g.law == "square_root" and f.where(g.place)[0] in ("input", "output")
    }
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for log in case.logs:
                log.outputs = simulate(f, p, case.hidden, log.t, log.drive, case.greatest)
    except (RuntimeError, OverflowError, ZeroDivisionError, ValueError):
        return False
    far = 10.0 * np.abs(nominal).max(axis=1)
    return all(
        bool(np.isfinite(y).all()) and bool((np.abs(y).max(axis=1) < far).all())
        for y in (log.outputs for log in case.logs)
    )


def left_over(case: Case) -> list[float]:
    """What each hidden thing leaves in the fitted logs' outputs, in noise floors (RMS over all outputs), after the rest
    of the system was refitted: the nominal parameters, and the size of what else is hidden.

    The refit is a chord method: sensitivities by finite differences of this simulator at the truth, `CHORDS` steps with
    each step simulated, the least projected residual counts.
    """
    f, logs = case.family, case.logs[:-1]
    free = list(f.parameters)
    weight = 1.0 / case.floors[:, None]

    def outputs(logp: Array, hidden: list[Hidden]) -> Array:
        p = type(case.p)(**{**case.values, **dict(zip(free, np.exp(logp).tolist(), strict=True))})
        rows = [simulate(f, p, hidden, log.t, log.drive, case.greatest) * weight for log in logs]
        return np.concatenate(rows, axis=1).ravel()

    truth = np.log([case.values[k] for k in free])
    measured = np.concatenate([log.outputs * weight for log in logs], axis=1).ravel()
    out = []
    for g in case.hidden:
        rest = [h for h in case.hidden if h is not g]

        def run(z: Array, rest: list[Hidden] = rest) -> Array:
            sizes = iter(np.exp(z[len(free) :]).tolist())
            scaled = [Hidden(h.name, {k: v * next(sizes) for k, v in h.values.items()}) for h in rest]
            return outputs(z[: len(free)], scaled)

        z = np.concatenate([truth, np.zeros(sum(len(h.values) for h in rest))])
        base = run(z)
        step = 1e-3
        columns = np.array([(run(z + step * e) - base) / step for e in np.eye(len(z))]).T
        best = np.inf
        for _ in range(CHORDS):
            miss = measured - base
            move, *_ = np.linalg.lstsq(columns, miss, rcond=1e-8)
            left = float(np.sqrt(np.mean((miss - columns @ move) ** 2)))
            best = min(best, left)
            if left > 0.99 * float(np.sqrt(np.mean(miss**2))):
                break
            z = z + np.clip(move, -0.5, 0.5)
            try:
                base = run(z)
            except (RuntimeError, ValueError, OverflowError):
                break
            if not np.isfinite(base).all():
                break
        out.append(best)
    return out
