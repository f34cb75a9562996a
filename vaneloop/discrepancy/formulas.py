"""Simple formulas of one quantity: which of them is a curve that was learned?

The formulas are in `vaneloop.base.forms`.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from vaneloop.base.forms import FORMS, Form
from vaneloop.discrepancy.stage import Array

__all__ = ["Formula", "begin", "text_of", "values_of"]


@dataclass(frozen=True)
class Formula:
    """A formula fitted inside the simulation.

    text     with its numbers
    numbers  name -> value; ``error``: held-out RMS, in noise floors, with it in the curve's place
    law      name of the law of the library that it is; "": none
    level    added to it: less its mean, where a parameter of the model has that
    """

    form: str
    text: str
    numbers: dict[str, float]
    error: float
    complexity: int
    law: str = ""
    level: float = 0.0


def begin(
    form: Form, q: Array, y: Array, free: Collection[int], weight: Array | None = None
) -> tuple[Array, float] | None:
    """Numbers with which a form comes nearest to a curve, and the share of the curve's variance that it leaves.

    free    what may be added, as the model does it with parameters that are fitted: a constant (0), a straight line (1)
    weight  of the curve's values (default: 1)
    """
    from scipy.optimize import least_squares

    if (form.positive and not q.min() > 0.0) or (form.signed and not q.min() < 0.0 < q.max()):
        return None
    if form.name == "Arrhenius" and not q.min() > -200.0:
        return None
    straight = {"constant": {0}, "line": {1}, "straight line": {0, 1}}.get(form.name)
    if straight and straight <= set(free):
        return None
    span, low = float(np.ptp(q)), float(q.min())
    w = np.ones(len(q)) if weight is None else weight
    lines = [g for k, g in enumerate((np.ones(len(q)), q - q.mean())) if k in free and g.any()]
    across = np.linalg.qr(w[:, None] * np.array(lines).T)[0] if lines else np.zeros((len(q), 0))

    def told(z: Array) -> Array:
        return np.asarray(w * z - across @ (across.T @ (w * z)))

    aim = told(y)
    total = float(aim @ aim)
    if not total > 0.0:
        return None
    units = {"per": 1.0 / span, "share": span, "plain": 1.0, "kelvin": 1e4}
    grids = [[low + v * span if kind == "at" else v * units[kind] for v in values] for kind, values in form.inner]
    best: tuple[float, Array] | None = None

    def left(inner: Array) -> tuple[float, float, Array]:
        g = told(form.value(q, np.concatenate([[1.0], inner])))
        size = float(g @ g)
        a = float(g @ aim) / size if size > 1e-300 else 0.0
        return a, float(np.sum((aim - a * g) ** 2)), aim - a * g

    for start in np.array(np.meshgrid(*grids)).reshape(len(grids), -1).T if grids else [np.zeros(0)]:
        inner = start
        if len(start) and form.name != "step":  # which has no slope
            size = np.maximum(np.abs(start), 1e-3 * np.array([units.get(k, span) for k, _ in form.inner]))
            got = least_squares(lambda z, size=size: left(z * size)[2], start / size, max_nfev=30)
            inner = got.x * size
        a, cost, _ = left(inner)
        if np.isfinite(cost) and (best is None or cost < best[0]):
            best = cost, np.concatenate([[a], inner])
    if best is None or not np.all(np.isfinite(best[1])):
        return None
    return form.plain(best[1]), best[0] / total


def text_of(form: Form, numbers: Array, quantity: str, above_zero: bool = False, mean: float = 0.0) -> str:
    """The formula with its numbers, less its ``mean``; ``above_zero``: its quantity never turns negative."""
    values = dict(zip(form.numbers, numbers, strict=True))
    text = form.text.replace("sign(q) ", "").replace("|q|", "q") if above_zero else form.text
    text = re.sub(r"\b([abc])\b", lambda m: f"{values[m.group(1)]:.4g}", text)
    if mean:
        text = f"{text} + {-mean:.4g}"
    return re.sub(r"\bq\b", quantity, text).replace("+ -", "- ").replace("- -", "+ ").replace("(--", "(")


def values_of(formula: Formula, q: Array) -> Array:
    """A formula at values of its quantity."""
    form = next(f for f in FORMS if f.name == formula.form)
    return np.broadcast_to(form.value(q, np.array(list(formula.numbers.values()))), q.shape).astype(float)
