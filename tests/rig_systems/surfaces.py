"""Laws of two quantities, hidden in the families: at one place, a function of two of what drives or moves the system
that is no sum of a function of each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tests.rig_systems.cases import FAMILIES, Case, draw_case
from tests.rig_systems.family import Array, Family, Outside
from tests.rig_systems.simulate import course

__all__ = ["SHAPES", "draw_surface"]

# of both quantities, each from -1 to 1 over the logs
SHAPES: dict[str, Callable[[Any, Any], Any]] = {
    "a leak that warms": lambda a, b: (1.0 + a) / (1.0 + np.exp(-3.0 * b)),
    "a product": lambda a, b: a * b,
    "an orifice that warms": lambda a, b: np.sqrt(np.maximum(1.0 + a, 0.0)) * np.exp(0.8 * b),
    "a quotient": lambda a, b: a / np.maximum(1.6 + b, 0.3),
    "crossed waves": lambda a, b: np.sin(1.5 * (a + b)),
    "a corner": lambda a, b: np.maximum(a + b, 0.0),
}
LOW, HIGH = 0.05, 1.0  # of its size: of the place's usual rate, or its output's spread


def _many(f: Family) -> int:
    """How many quantities a law in a family may be of."""
    return 2 if f.kind == "force" else len(f.states) + (0 if f.kind == "closed_loop" else len(f.inputs))


def draw_surface(seed: int, index: int, families: Sequence[str] = ()) -> tuple[Case, tuple[str, str]]:
    """A system with a law of two quantities in it, and the names of these."""
    able = tuple(n for n in families or FAMILIES if _many(FAMILIES[n]) > 1)
    if not able:
        raise ValueError(f"families (={', '.join(families)}): none has two quantities; allowed: others")
    plain = draw_case(seed, index, able, [])
    rng = np.random.default_rng([seed, index, 2])
    f, p = plain.family, plain.p
    runs = [course(f, p, [], log.t, log.drive, {}) for log in plain.logs[:-1]]
    rows: dict[str, Array] = {}
    if f.kind == "force":
        rows |= {name: np.concatenate([x[i] for _, x, _ in runs]) for i, name in enumerate(("position", "velocity"))}
    else:
        rows |= {name: np.concatenate([x[i] for _, x, _ in runs]) for i, name in enumerate(f.states)}
        if f.kind != "closed_loop":
            rows |= {name: np.concatenate([u[i] for *_, u in runs]) for i, name in enumerate(f.inputs)}
    one, two = (str(n) for n in rng.permutation(sorted(rows))[:2])
    ends = [(float(v.min()), float(v.max())) for v in (rows[one], rows[two])]
    shape = SHAPES[str(rng.choice(list(SHAPES)))]

    def value(x: Any, u: Any) -> Any:
        known = dict(zip(("position", "velocity") if f.kind == "force" else f.states, x, strict=False))
        known |= {} if f.kind == "force" else dict(zip(f.inputs, u, strict=False))
        scaled = ((2.0 * known[n] - low - high) / (high - low) for n, (low, high) in zip((one, two), ends, strict=True))
        return shape(*(np.clip(z, -1.5, 1.5) for z in scaled))

    if f.kind in ("simulate", "closed_loop"):
        places = [i for i, n in enumerate(f.states) if n not in f.rates.values()]
        at = int(rng.choice(places))
        h = [(log.t[1] - log.t[0]) * len(log.t) / x.shape[1] for log, (_, x, _) in zip(plain.logs, runs, strict=False)]
        usual = float(
            np.sqrt(np.mean(np.concatenate([np.gradient(r[1][at], s) for r, s in zip(runs, h, strict=True)]) ** 2))
        )

        def rate(t: float, x: Any, u: Any, p: Any, size: float, d: Any) -> Any:
            d = list(d)
            d[at] -= size * usual * float(value(x, u))
            return d

        law = Outside("two act together", LOW, HIGH, rate=rate)
    else:
        spread = float(np.std(np.concatenate([y[0] for y, *_ in runs])))

        def output(t: Array, x: Any, u: Any, p: Any, size: float, y: Any) -> Any:
            return [y[0] + 0.5 * size * spread * value(x, u), *y[1:]]

        law = Outside("two act together", LOW, HIGH, output=output)
    return draw_case(seed, index, able, ["together"], extra={"together": law}), (one, two)
