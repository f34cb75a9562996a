"""Formulas of two quantities: products of a formula of each, where a surface is one as well.

A surface that is f(q1) g(q2) is found by turns: g as it is, the f that comes nearest, and the other way round. What f
and g may be is looked for as for a curve; the likeliest pairs are fitted inside the simulation, in the surface's place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from vaneloop.base.curve import FINE_SIDE as FINE
from vaneloop.base.curve import POINTS
from vaneloop.base.forms import FORMS, Form, product
from vaneloop.identification.candidates.closed_forms import Formula, begin, text_of
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import rms_of
from vaneloop.identification.selection.relative_error_acceptance import score
from vaneloop.identification.settings import (
    FORM,
    FORM_MEAN_VALUES,
    FORM_POOR,
    FORM_SHAPED,
    FORMS_ALIKE,
    FORMS_NEAR,
    PER_NUMBER,
    PRODUCT_FORMS,
    PRODUCT_TURNS,
    PRODUCTS_REFITTED,
    RIVAL,
)
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.closed_form_fits import DEGREES, effect_of, goes_on
from vaneloop.identification.unmodelled.fitted_candidate import CandidateSource, FittedCandidate, with_held_out
from vaneloop.identification.unmodelled.parametric_substitution import more_left, takes_mean_back
from vaneloop.identification.unmodelled.problem import CurveProblem
from vaneloop.identification.unmodelled.surface_candidates import SurfaceCandidate
from vaneloop.identification.user_models.simulation import Placed

__all__ = ["Product", "as_the_law", "fitted_products", "likely_products"]

Begun = tuple[Form, Array]  # a formula, and numbers to begin with
Ends = tuple[tuple[float, float], tuple[float, float]]  # ranges of both quantities


@dataclass(frozen=True)
class Product(Formula):
    """A formula of two quantities: ``form`` of the first times ``second_form`` of the second."""

    second_form: str = ""

    @property
    def forms(self) -> tuple[Form, Form]:
        """Both."""
        one, other = (next(f for f in FORMS if f.name == name) for name in (self.form, self.second_form))
        return one, other


def fitted_products(ground: CandidateSource, tried: FittedCandidate) -> list[tuple[Formula, FittedCandidate]]:
    """The products that come nearest to a surface, each fitted in the simulation in its place; best first."""
    c = tried.candidate
    assert isinstance(c, SurfaceCandidate)
    samples = _samples(c)
    pairs = []
    for lent in (False, True):
        if (apart := _factors(tried, c, samples, lent)) is not None:
            pairs.append(_likely(c, samples, apart))
    some = [pair for rank in zip_longest(*pairs) for pair in rank if pair is not None]
    fitted = [
        f for one, other in some[:PRODUCTS_REFITTED] if (f := _in_simulation(ground, tried, c, one, other)) is not None
    ]
    return sorted(fitted, key=lambda f: np.log(f[0].error) + PER_NUMBER * len(f[0].numbers))


def likely_products(tried: FittedCandidate, before: float) -> list[Formula]:
    """Of the products that were fitted those that do as well as the best, simplest first.

    before  held-out error without the surface, in noise floors: no law's form is known better than `FORM` of it
    """
    own = rms_of(tried.judge, tried.fit)
    poor = float(np.hypot(FORM_POOR * max(own, 1.0), FORM * before))
    near = [f for f, _ in tried.formulas or () if f.error <= poor]
    limit = max(min((f.error for f in near), default=0.0), min(own, 1.0)) * (1.0 + FORMS_NEAR)
    out: dict[str, Formula] = {}
    for f in sorted((f for f in near if f.error <= limit), key=lambda f: (f.complexity, f.error)):
        out.setdefault(f.text, f)
    return list(out.values())


def _likely(
    c: SurfaceCandidate, samples: tuple[Array, Array], apart: tuple[_Factor, _Factor]
) -> list[tuple[Begun, Begun]]:
    """Formulas of both quantities that come near to these factors, the likeliest pair first."""
    near = []
    for (q, _), values, factor in zip(c.axes, samples, apart, strict=True):
        some = np.quantile(values, np.linspace(0.005, 0.995, POINTS))
        mine = []
        for form in FORMS:
            if form.name == "constant" or (form.name == "Arrhenius" and q.unit not in DEGREES):
                continue
            got = begin(form, some, factor(some), ())
            if got is not None and got[1] < FORM_SHAPED:
                mine.append((float(np.log(max(got[1], FORMS_ALIKE)) + 0.3 * form.complexity), (form, got[0])))
        near.append(sorted(mine, key=lambda m: m[0])[:PRODUCT_FORMS])
    ranked = sorted(((a[0] + b[0], a[1], b[1]) for a in near[0] for b in near[1]), key=lambda p: p[0])
    return [(one, other) for _, one, other in ranked]


def _samples(c: SurfaceCandidate) -> tuple[Array, Array]:
    """Places where the logs have been."""
    x, z = c.quantity.visited, c.other.visited
    good = np.flatnonzero(np.isfinite(x) & np.isfinite(z))
    some = good[np.linspace(0, len(good) - 1, min(len(good), FORM_MEAN_VALUES)).astype(int)]
    return x[some], z[some]


class _Factor:
    """One of a surface's factors: a curve of one quantity."""

    def __init__(self, c: SurfaceCandidate, axis: int, amplitudes: Array):
        self.basis, self.amplitudes = c.axes[axis][1], amplitudes

    def __call__(self, x: Array) -> Array:
        return np.asarray(self.basis.design(x) @ self.basis.turn @ self.amplitudes)


def _factors(
    tried: FittedCandidate, c: SurfaceCandidate, samples: tuple[Array, Array], lent: bool
) -> tuple[_Factor, _Factor] | None:
    """The curves whose product comes nearest to a surface; None where none is near.

    lent  whether it comes beside a mean and a slope of each quantity, which parameters of the model could have
    """
    surface = tried.curves[-1][0].curve
    assert surface is not None
    table, amplitudes = tried.table()
    y = surface.at(np.stack(samples), table(amplitudes))
    phi, psi = (basis.design(v) @ basis.turn for (_, basis), v in zip(c.axes, samples, strict=True))
    a = np.zeros((phi.shape[1], psi.shape[1]))
    for (i, j), v in zip(c.pairs, amplitudes, strict=True):
        a[i, j] = v
    g = psi @ np.linalg.svd(a)[2][0]
    one = np.ones((len(y), 0 if c.mean else 1))  # a parameter of the model has the mean
    if lent:
        one = np.stack([np.ones(len(y)), *(v - v.mean() for v in samples)], axis=1)

    def nearest(rows: Array) -> Array:
        design = np.hstack([rows, one])
        normal = design.T @ design
        return np.linalg.solve(normal + 1e-9 * np.diag(np.diag(normal) + 1e-300), design.T @ y)

    for _ in range(PRODUCT_TURNS):
        f = nearest(phi * g[:, None])[: phi.shape[1]]
        back = nearest(psi * (phi @ f)[:, None])
        other = back[: psi.shape[1]]
        left = y - (phi @ f) * (psi @ other) - one @ back[psi.shape[1] :]
        other = other / max(float(np.sqrt(np.mean((psi @ other) ** 2))), 1e-300)
        g = psi @ other
    if not np.var(left) < FORM_SHAPED * np.var(y):
        return None
    return _Factor(c, 0, f), _Factor(c, 1, other)


def _in_simulation(
    ground: CandidateSource, tried: FittedCandidate, c: SurfaceCandidate, first: Begun, second: Begun
) -> tuple[Formula, FittedCandidate] | None:
    """A product in the surface's place, fitted with the model's own parameters."""
    (one, a), (other, b) = first, second
    own = tried.fit.theta[: tried.judge.stage.index()[c.name].start]
    ends = ((c.basis.low, c.basis.high), (c.across.low, c.across.high))
    return _fitted(ground, tried, one, other, np.concatenate([own, [a[0] * b[0]], a[1:], b[1:]]), ends, not c.mean)


def _fitted(
    ground: CandidateSource, tried: FittedCandidate, one: Form, other: Form, theta: Array, ends: Ends, lent: bool
) -> tuple[Formula, FittedCandidate] | None:
    """A product of two formulas in the surface's place, over these ranges of its quantities, and on test logs as far as
    it goes on; None where it is none.

    theta  the model's own parameters and the product's numbers, to begin with
    lent   whether it comes less its mean, as a parameter that is fitted has that
    """
    c = tried.candidate
    assert isinstance(c, SurfaceCandidate)
    names = (*one.numbers, *(f"second_{n}" for n in other.numbers[1:]))
    k, count = len(one.numbers), len(names)
    numbers = theta[-count:]
    effect = effect_of(c.name, names, numbers)
    x, z = _samples(c)

    def mean(n: Array) -> float:
        if not lent:
            return 0.0
        return float(np.mean(one.value(x, n[:k]) * other.value(z, np.concatenate([[1.0], n[k:]]))))

    def placed(ends: Ends) -> Placed:
        own, its = (np.linspace(low, high, FINE) for low, high in ends)
        return c.placed_as(lambda n: product(one, other, own, its, n) - mean(n), count, ends[0], across=ends[1])

    curves = (*tried.curves[:-1], (placed(ends), effect))
    judge = LeastSquaresProblem(ground.stage((), curves), ground.floor)
    judge.sparing = True
    if not np.all(np.isfinite(judge.stage.run(theta[None]))):
        return None
    effects = tuple(e.name for e in judge.stage.effects)
    # first the rest of the model with the formula as it stands
    led = judge.lead(effects[:-1], theta, 8, tried.slopes())
    fit = with_held_out(judge, judge.fit(effects, led.theta, 16, slopes=led.slopes))
    values = fit.theta[-count:].copy()
    if not np.isfinite(score(judge, fit)) or not np.all(np.isfinite(values)):
        return None
    values[:k] = one.plain(values[:k])
    values[k:] = other.plain(np.concatenate([[1.0], values[k:]]))[1:]
    formula = Product(
        one.name, _text(c, one, other, values, mean(values)),
        dict(zip(names, (float(v) for v in values), strict=True)), rms_of(judge, fit),
        one.complexity + other.complexity, "", -mean(values), other.name,
    )  # fmt: skip
    further = (*tried.curves[:-1], (placed(reach_of(ground, tried, formula)), effect))
    return formula, replace(tried.refitted(judge, fit, further), form=f"{one.name} times {other.name}")


def reach_of(ground: CandidateSource, tried: FittedCandidate, formula: Product) -> Ends:
    """From where to where a product goes on, of each quantity: as far as its formula of that one does."""
    c, numbers = tried.candidate, list(formula.numbers.values())
    assert isinstance(c, SurfaceCandidate)
    k = len(formula.forms[0].numbers)
    parts = zip(c.axes, formula.forms, (numbers[:k], [1.0, *numbers[k:]]), strict=True)
    own, its = (goes_on(ground, replace(c, quantity=q, basis=b), f, np.array(n)) for (q, b), f, n in parts)
    return own, its


def as_the_law(
    learner: CurveProblem, tried: FittedCandidate, formulas: Sequence[Formula]
) -> tuple[FittedCandidate, Product] | None:
    """The simplest product that does as well as its surface, held out and on every test log, in its place as far as it
    goes on; None where there is none.
    """
    c, ground = tried.candidate, learner.ground
    assert isinstance(c, SurfaceCandidate)
    for f in formulas:
        alone = next((t for g, t in tried.formulas or () if g is f), None)
        if alone is None or not isinstance(f, Product):
            continue
        theta, at = alone.fit.theta.copy(), len(alone.judge.stage.parameters)
        theta[at:] = list(f.numbers.values())
        if not takes_mean_back(f.level, theta[at:], theta[:at], c.place):
            continue
        got = _fitted(ground, tried, *f.forms, theta, reach_of(ground, tried, f), False)
        if got is None:
            continue
        said, now = got
        held, tests = more_left(learner, tried, now, [now, tried])
        if max([held, *tests]) <= RIVAL and isinstance(said, Product):
            return now, said
    return None


def _text(c: SurfaceCandidate, one: Form, other: Form, numbers: Array, mean: float) -> str:
    """The product with its numbers, less its ``mean``."""
    k = len(one.numbers)
    first = text_of(one, numbers[:k], c.quantity.name, bool(c.basis.low >= 0.0))
    second = text_of(other, np.concatenate([[1.0], numbers[k:]]), c.other.name, bool(c.across.low >= 0.0))
    if second.startswith("1 /"):
        return f"{first} {second[2:]}" + (f" + {-mean:.4g}".replace("+ -", "- ") if mean else "")
    second = second.removeprefix("1 ")
    return f"{first} * {second}" + (f" + {-mean:.4g}".replace("+ -", "- ") if mean else "")
