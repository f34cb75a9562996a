"""The formulas that a curve or a surface may be, each fitted inside the simulation in its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from vaneloop.base.curve import FINE, FINE_SIDE, POINTS
from vaneloop.base.forms import FORMS, NAMED, Form, product
from vaneloop.base.side_by_side import side_by_side
from vaneloop.identification.candidates.closed_forms import Formula, begin, text_of, values_of
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem, covariance
from vaneloop.identification.regimes import agrees
from vaneloop.identification.results import rms_of
from vaneloop.identification.selection.relative_error_acceptance import score
from vaneloop.identification.settings import (
    FORM,
    FORM_FAR,
    FORM_MEAN_VALUES,
    FORM_NOTHING,
    FORM_POOR,
    FORM_SAME,
    FORM_SHAPED,
    FORM_STEEPER,
    FORMS_ALIKE,
    FORMS_NEAR,
    FORMS_REFITTED,
    PER_NUMBER,
    PRODUCT_FORMS,
    PRODUCT_TURNS,
    PRODUCTS_REFITTED,
)
from vaneloop.identification.subsystem import Array, Effect, Parameter
from vaneloop.identification.unmodelled.curve_candidates import Candidate, SurfaceCandidate
from vaneloop.identification.unmodelled.fitted_candidate import (
    CandidateSource,
    FittedCandidate,
    Placings,
    at_samples,
    with_held_out,
)
from vaneloop.identification.user_models.simulation import Placed
from vaneloop.identification.user_models.terms import runs

__all__ = [
    "Product", "effect_of", "fitted_formulas", "fitted_product", "fitted_products", "goes_on", "library_name", "likely",
    "likely_products", "reach_of",
]  # fmt: skip

STRAIGHT = ("constant", "line", "straight line")
DEGREES = ("degC", "°C", "C")


def _visited(tried: FittedCandidate) -> Array:
    """Values of a curve's quantity, as often as the samples that are judged have them."""
    q, counted = tried.candidate.quantity.visited, tried.judge.valid.any(axis=0)
    judged = at_samples(q, len(counted))
    x = q[np.isfinite(q)] if judged is None or not counted.any() else judged[counted]
    return np.quantile(x, np.linspace(0.005, 0.995, POINTS))


def _variance(tried: FittedCandidate, visited: Array) -> Array:
    """Variance of a curve at values of its quantity, by the noise of what it was fitted to."""
    c, judge, fit = tried.candidate, tried.judge, tried.fit
    scale, own = judge.scale[fit.free], judge.stage.index()[c.name]
    mine = np.flatnonzero((fit.free >= own.start) & (fit.free < own.stop))
    known = covariance(fit.normals.sum(axis=0) + np.diag(fit.prior * scale**2))[np.ix_(mine, mine)]
    known *= max(1.0, float(fit.cost.sum()) / max(judge.n, 1))
    rows = np.array([tried.at(visited, step) for step in np.diag(scale[mine])])
    return np.asarray(np.maximum(np.einsum("in,ij,jn->n", rows, known, rows), 0.0))


def fitted_formulas(
    ground: CandidateSource, tried: FittedCandidate, loose: bool = False
) -> list[tuple[Formula, FittedCandidate]]:
    """The formulas that come nearest to a curve, each fitted in the simulation in its place; best first.

    A curve is known where the log tells it. Splines that leave more than noise are off by their smoothness, too, most
    where a law has its corner: there formulas count as well that come near it everywhere alike.

    loose  whether only the curve's bends choose them: its mean and slope may be what parameters of the model could have
    """
    c = tried.candidate
    visited = _visited(tried)
    at_visited = tried.at(visited, tried.table()[1])
    lent = c.lent | ({0, 1} if loose else set())
    variance, spread = _variance(tried, visited), max(float(np.var(at_visited)), 1e-300)
    weights = [1.0 / np.sqrt(variance + FORMS_ALIKE * spread)]
    if not agrees(rms_of(tried.judge, tried.fit), 1.0):
        weights.append(np.ones(len(visited)))
    ranked = [_nearest(c, visited, at_visited, variance, lent, weight) for weight in weights]
    taken = {form.name: (form, numbers) for turn in zip_longest(*ranked) for form, numbers in filter(None, turn)}
    shaped = list(taken.values())[:FORMS_REFITTED]
    fitted = [f for f in side_by_side(lambda s: _in_simulation(ground, tried, *s), shaped, ground.shares) if f]
    grain = tried.judge.stage.grain
    return sorted(fitted, key=lambda f: np.log(f[0].error) / grain + PER_NUMBER * len(f[0].numbers))


def _nearest(
    c: Candidate, visited: Array, at_visited: Array, variance: Array, lent: set[int], weight: Array
) -> list[tuple[Form, Array]]:
    """Formulas that come near a curve, the nearest first, each with its numbers.

    variance  of the curve at visited values; ``weight`` that each of them has; ``lent``: a mean, a slope it may have
    """
    middle = np.average(at_visited, weights=weight**2)
    doubt = float(np.sum(weight**2 * variance) / max(np.sum((weight * (at_visited - middle)) ** 2), 1e-300))
    shaped = []
    few = len(np.unique(visited)) <= 3  # a direction: every formula is a straight line, or a constant
    warm = c.quantity.unit in DEGREES
    for form in FORMS:
        if (few and form.name not in ("constant", "line")) or (not warm and form.name == "Arrhenius"):
            continue
        if not c.mean and form.name in ("constant", "straight line"):  # less its mean: nothing, and a line
            continue
        # a gain takes a line through 0, and leaves another mean than a line about the middle: only the bends tell
        free = {*lent, 0} if 1 in lent and form.name not in STRAIGHT else lent
        got = begin(form, visited, at_visited, free, weight)
        if got is not None and np.ptp(form.value(visited, got[0])) > FORM_FAR * np.ptp(at_visited):
            continue  # nearly a straight line, of which the parameters would have to take all but the bend
        if got is not None and got[1] < FORM_SHAPED and _is_shaped(form, got[0], c):
            shaped.append((np.log(max(got[1], doubt, FORMS_ALIKE)) + 0.3 * form.complexity, form, got[0]))
    shaped.sort(key=lambda s: s[0])
    return [(form, numbers) for _, form, numbers in shaped]


def likely(tried: FittedCandidate, fitted: list[tuple[Formula, FittedCandidate]], before: float) -> list[Formula]:
    """Of formulas that were fitted those that come within `FORMS_NEAR` of the best, simplest first.

    before  held-out error without the curve, in noise floors: no law's form is known better than `FORM` of it
    """
    own, grain = rms_of(tried.judge, tried.fit), tried.judge.stage.grain
    poor = float(np.hypot(FORM_POOR**grain * max(own, 1.0), FORM * before if grain == 1.0 else 0.0))
    near = [f for f, _ in fitted if f.error <= poor]
    if not near:
        return []
    limit = max(min(f.error for f in near), min(own, 1.0)) * (1.0 + FORMS_NEAR * grain)
    out: list[Formula] = []
    visited = _visited(tried)
    for f in sorted((f for f in near if f.error <= limit), key=lambda f: (f.complexity, f.error)):
        y = values_of(f, visited)
        simpler = [values_of(g, visited) for g in out if g.complexity < f.complexity]
        if all(np.std(y - other) > FORM_SAME * np.std(y) for other in simpler):
            out.append(f)
    return out


def _is_shaped(form: Form, numbers: Array, c: Candidate) -> bool:
    """Whether a formula has the shape that its curve is known to have."""
    x = c.grid
    y, other, none = (np.broadcast_to(form.value(q, numbers), q.shape) for q in (x, -x, np.zeros(1)))
    little = 1e-6 * float(np.max(np.abs(y)))
    steps = np.diff(y) * (("rising" in c.shape) - ("falling" in c.shape))
    return bool(
        ("zero" not in c.shape or abs(none[0]) <= little)
        and ("odd" not in c.shape or np.max(np.abs(y + other)) <= little)
        and steps.min() >= -little
    )


def goes_on(ground: CandidateSource, c: Candidate, form: Form, numbers: Array) -> tuple[float, float]:
    """From where to where a formula stands in a curve's place: beyond the curve's range as far as the ground lets it,
    while it is not much steeper than within.
    """
    low, high = ground.reach(c)
    x = np.linspace(low, high, FINE)
    middle = 0.5 * (x[1:] + x[:-1])
    with np.errstate(all="ignore"):
        slope = np.abs(np.diff(np.broadcast_to(form.value(x, numbers), x.shape)))
    inside = c.basis.reaches(middle)
    wild = middle[~(slope <= FORM_STEEPER * slope[inside].max(initial=0.0)) & ~inside]
    return (
        float(max(wild[wild < c.basis.low].max(initial=low), low)),
        float(min(wild[wild > c.basis.high].min(initial=high), high)),
    )


def effect_of(name: str, names: Sequence[str], numbers: Array) -> Effect:
    """A formula as the search has it: its numbers begin at these, and are in usual as large."""
    size = np.maximum(np.abs(numbers), 1e-9 * np.max(np.abs(numbers)))
    ps = tuple(Parameter(n, 0.0, "", scale=float(s)) for n, s in zip(names, size, strict=True))
    return Effect(name, ps, (tuple(float(v) for v in numbers),))


def _in_simulation(
    ground: CandidateSource, tried: FittedCandidate, form: Form, numbers: Array
) -> tuple[Formula, FittedCandidate] | None:
    """A formula in the curve's place, fitted with the model's own parameters.

    Its first number is fitted as the RMS of the whole formula where the logs have been: the height of a limit is known
    well, and its slope and its corner make up for each other.
    """
    c = tried.candidate
    been = c.quantity.visited[np.isfinite(c.quantity.visited)]
    been = been[np.linspace(0, len(been) - 1, min(len(been), FORM_MEAN_VALUES)).astype(int)]

    def size(inner: Array) -> float:
        y = form.value(been, np.concatenate([[1.0], inner]))
        return float(np.sqrt(np.mean(y * y)))

    def plain(n: Array) -> Array:
        of = size(n[1:])  # 0 where a corner has left the logs
        return np.concatenate([[n[0] / of if of > FORM_NOTHING else 0.0], n[1:]])

    reach = goes_on(ground, c, form, numbers)  # what a model says to a reading may lie beyond what the logs show of it
    numbers = np.concatenate([[numbers[0] * size(numbers[1:])], numbers[1:]])
    effect = effect_of(c.name, form.numbers, numbers)

    def mean(n: Array) -> float:  # where a parameter that is fitted has it, the formula has none
        if c.quantity.stops:
            return float(form.value(c.grid[:1], n)[0])
        return 0.0 if c.mean else float(np.mean(form.value(been, n)))

    def placed(low: float, high: float) -> Placed:
        table, jump = runs(form, low, high, ground.points)
        jumps = None if jump is None else lambda n: jump(plain(n))
        return c.placed_as(lambda n: table(plain(n)) - mean(plain(n)), len(numbers), (low, high), jumps)

    curves = (*tried.curves[:-1], (placed(*reach), effect))
    theta = np.concatenate([tried.fit.theta[: tried.judge.stage.index()[c.name].start], numbers])
    if (got := _in_place(ground, tried, curves, theta, 12)) is None:
        return None
    judge, fit = got
    values = form.plain(plain(fit.theta[-len(numbers) :]))
    said = dict(zip(form.numbers, (float(v) for v in values), strict=True))
    formula = Formula(
        form.name,
        text_of(form, values, c.quantity.name, bool(c.basis.low >= 0.0), mean(values)),
        said,
        rms_of(judge, fit),
        form.complexity,
        library_name(c, form),
        -mean(values),
    )
    further = (*tried.curves[:-1], (placed(*goes_on(ground, c, form, values)), effect))  # on test logs
    return formula, replace(tried.refitted(judge, fit, further), form=form.name)


def _in_place(
    ground: CandidateSource, tried: FittedCandidate, curves: Placings, theta: Array, iterations: int
) -> tuple[LeastSquaresProblem, Fit] | None:
    """The model with ``curves``, of which the last is a formula in place of what was ``tried``, fitted from parameters
    ``theta``: first the rest of the model with the formula as it stands. None where it leaves all bounds.
    """
    judge = LeastSquaresProblem(ground.stage((), curves), ground.floor, tried.settled)
    judge.sparing = True
    if not np.all(np.isfinite(judge.stage.run(theta[None]))):
        return None
    names = tuple(e.name for e in judge.stage.effects)
    led = judge.lead(names[:-1], theta, 8, tried.slopes())
    fit = with_held_out(judge, judge.fit(names, led.theta, iterations, slopes=led.slopes))
    return (judge, fit) if np.isfinite(score(judge, fit)) else None


# forms that are laws of the library, where the curve is of what is at its own place
OF_STATE = {
    "constant": "offset",
    "line": "leak",
    "root": "square_root",
    "signed square": "quadratic_drag",
    "cube": "cubic",
}
OF_FORCE = {"constant": "force_offset", "line": "viscous", "signed square": "quadratic_drag", "sign": "coulomb"}
OF_POSITION = {"line": "spring", "cube": "cubic_spring"}
OF_SIGNAL = {"constant": "bias", "line": "gain", "cube": "cubic", "magnitude": "asymmetric_gain"}


def library_name(c: Candidate, form: Form) -> str:
    """Name of the law of the library that a form is at this place; "": none."""
    where, own = c.how.split()[0], c.quantity.name == c.at.removesuffix("_sensor")
    if c.how.endswith("times"):
        return ""
    if where == "state":
        table = OF_STATE if own and "/s" in c.unit else OF_FORCE if own else {}
    elif where == "force":
        table = OF_FORCE if c.quantity.name == "velocity" else OF_POSITION if c.quantity.name == "position" else {}
    else:
        table = OF_SIGNAL if own else {}
    name = table.get(form.name, "")
    return f"{c.at}.{name}" if name else ""


# ---- Formulas of two quantities: products of a formula of each, where a surface is one as well
#
# A surface that is f(q1) g(q2) is found by turns: g as it is, the f that comes nearest, and the other way round. What f
# and g may be is looked for as for a curve; the likeliest pairs are fitted inside the simulation, in its place.


Begun = tuple[Form, Array]  # a formula, and numbers to begin with
Ends = tuple[tuple[float, float], tuple[float, float]]  # ranges of both quantities


@dataclass(frozen=True)
class Product(Formula):
    """A formula of two quantities: ``form`` of the first times ``second_form`` of the second."""

    second_form: str = ""

    @property
    def forms(self) -> tuple[Form, Form]:
        """Both."""
        return NAMED[self.form], NAMED[self.second_form]


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
    own = tried.fit.theta[: tried.judge.stage.index()[c.name].start]
    ends = ((c.basis.low, c.basis.high), (c.across.low, c.across.high))
    fitted = []
    for (one, a), (other, b) in some[:PRODUCTS_REFITTED]:
        begin = np.concatenate([own, [a[0] * b[0]], a[1:], b[1:]])
        fitted.append(fitted_product(ground, tried, one, other, begin, ends, not c.mean))
    return sorted(filter(None, fitted), key=lambda f: np.log(f[0].error) + PER_NUMBER * len(f[0].numbers))


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


def fitted_product(
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
        own, its = (np.linspace(low, high, FINE_SIDE) for low, high in ends)
        return c.placed_as(lambda n: product(one, other, own, its, n) - mean(n), count, ends[0], across=ends[1])

    curves = (*tried.curves[:-1], (placed(ends), effect))
    if (got := _in_place(ground, tried, curves, theta, 16)) is None:
        return None
    judge, fit = got
    values = fit.theta[-count:].copy()
    if not np.all(np.isfinite(values)):
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


def _text(c: SurfaceCandidate, one: Form, other: Form, numbers: Array, mean: float) -> str:
    """The product with its numbers, less its ``mean``."""
    k = len(one.numbers)
    first = text_of(one, numbers[:k], c.quantity.name, bool(c.basis.low >= 0.0))
    second = text_of(other, np.concatenate([[1.0], numbers[k:]]), c.other.name, bool(c.across.low >= 0.0))
    if second.startswith("1 /"):
        return f"{first} {second[2:]}" + (f" + {-mean:.4g}".replace("+ -", "- ") if mean else "")
    second = second.removeprefix("1 ")
    return f"{first} * {second}" + (f" + {-mean:.4g}".replace("+ -", "- ") if mean else "")
