"""Simple formulas of one quantity: which of them is a curve that was learned?

The formulas are in `vaneloop.base.forms`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from vaneloop.base.forms import NAMED, Form
from vaneloop.identification.settings import FORM_DAMPING, FORM_DIFFERENCE, FORM_ENOUGH, FORM_STEPS
from vaneloop.identification.subsystem import Array

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
        return np.asarray(w * z - ((w * z) @ across) @ across.T)

    aim = told(y)
    total = float(aim @ aim)
    if not total > 0.0:
        return None
    units = {"per": 1.0 / span, "share": span, "plain": 1.0, "kelvin": 1e4}
    grids = [[low + v * span if kind == "at" else v * units[kind] for v in values] for kind, values in form.inner]

    def left(inner: Array) -> tuple[Array, Array]:
        """Of each row of numbers inside the form: the best multiple, and what is left of the curve."""
        with np.errstate(all="ignore"):
            numbers = np.concatenate([np.ones((1, len(inner))), inner.T])[:, :, None]
            g = told(np.broadcast_to(form.value(q, numbers), (len(inner), len(q))))
            size = np.sum(g * g, axis=1)
            a = np.where(size > 1e-300, g @ aim / np.maximum(size, 1e-300), 0.0)
            return a, aim - a[:, None] * g

    inner = np.array(np.meshgrid(*grids)).reshape(len(grids), -1).T if grids else np.zeros((1, 0))
    if grids and form.name != "step":  # which has no slope
        size = np.maximum(np.abs(inner), 1e-3 * np.array([units.get(k, span) for k, _ in form.inner]))
        inner = _refined(lambda z, rows: left(z * size[rows])[1], inner / size) * size
    a, rest = left(inner)
    cost = np.sum(rest * rest, axis=1)
    k = int(np.argmin(np.where(np.isfinite(cost), cost, np.inf)))
    best = np.concatenate([[a[k]], inner[k]])
    if not (np.isfinite(cost[k]) and np.all(np.isfinite(best))):
        return None
    return form.plain(best), float(cost[k]) / total


def _refined(left: Callable[[Array, Array], Array], begins: Array) -> Array:
    """Levenberg and Marquardt's least squares from every row of ``begins`` at one time.

    left  from rows of numbers, of about 1, and which of ``begins`` each is of, to what each leaves
    """
    z, k = begins.copy(), begins.shape[1]
    rows = np.arange(len(z))
    rest = left(z, rows)
    cost = np.sum(rest * rest, axis=1)
    damping = np.full(len(z), FORM_DAMPING)
    for _ in range(FORM_STEPS):
        if not len(rows):
            break
        moved = np.repeat(z[rows], k, axis=0)
        h = FORM_DIFFERENCE * np.maximum(np.abs(z[rows]), 1.0)
        moved[np.arange(len(moved)), np.tile(np.arange(k), len(rows))] += h.ravel()
        slopes = (left(moved, np.repeat(rows, k)).reshape(len(rows), k, -1) - rest[rows][:, None]) / h[:, :, None]
        normal = slopes @ slopes.transpose(0, 2, 1)
        pull = -np.einsum("skn,sn->sk", slopes, rest[rows])
        on_diagonal = np.einsum("skk->sk", normal)
        usable = np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(pull).all(axis=1) & (on_diagonal > 0.0).any(axis=1)
        rows, normal, pull, on_diagonal = rows[usable], normal[usable], pull[usable], on_diagonal[usable]
        ridge = damping[rows, None] * on_diagonal + 1e-12 * on_diagonal.max(axis=1, keepdims=True)
        step = np.linalg.solve(normal + ridge[:, :, None] * np.eye(k), pull[:, :, None])[:, :, 0]
        now = left(z[rows] + step, rows)
        costs = np.sum(now * now, axis=1)
        better = costs < cost[rows]
        little = better & (cost[rows] - costs <= FORM_ENOUGH * cost[rows]) | (np.abs(step).max(axis=1) <= FORM_ENOUGH)
        won = rows[better]
        z[won] += step[better]
        rest[won], cost[won] = now[better], costs[better]
        damping[rows] *= np.where(better, 0.1, 10.0)
        rows = rows[~little]
    return z


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
    y = NAMED[formula.form].value(q, np.array(list(formula.numbers.values())))
    return np.broadcast_to(y, q.shape).astype(float)
