"""What is said of a law that was learned: its curve and band, where the logs have been, what it trades with, and its
formulas.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vaneloop.base.curve import POINTS
from vaneloop.base.durations import period_of, within_no_period
from vaneloop.base.forms import FORMS, Form
from vaneloop.discrepancy.error_share import score
from vaneloop.discrepancy.fit import Fit, Judge
from vaneloop.discrepancy.formulas import begin, text_of
from vaneloop.discrepancy.models.curved import Candidate
from vaneloop.discrepancy.models.learning import Ground, Tried, with_held_out
from vaneloop.discrepancy.models.memory import STOPS, named_lag
from vaneloop.discrepancy.stage import Array, Effect, Parameter
from vaneloop.discrepancy.stage_answer import rms_of

__all__ = ["Formula", "LearnedLaw", "law_of"]

DRAWS = 400
BAND = 0.90
REFITTED = 5  # formulas that are fitted in the simulation
NEAR = 0.05  # share of the error by which a formula may be worse than the best and is still given
POOR = 1.5  # times the error of the curve itself: a formula that is worse is not the curve
SHAPED = 0.2  # share of a curve's variance that a formula may leave, to be fitted at all
STRAIGHT = ("constant", "line", "straight line")
DEGREES = ("degC", "°C", "C")
FAR = 100.0  # times the curve's range that a formula's may be
SAME = 0.02  # share of its spread by which a formula must differ from a simpler one to be given beside it
BINS = 24
MEANT = 2_000  # values of a quantity of which a formula's mean is taken
PER_NUMBER = 0.005  # log error that a number of a formula costs


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


@dataclass(frozen=True)
class LearnedLaw:
    """A law that was learned.

    name, how, at, of   of the effect; what it does (`vaneloop.discrepancy.models.curve`), at which place, of what
    x, y, low, high     the curve, at places of its quantity, with its 90 % band
    edges, visited      of a histogram: where the logs have been, as shares
    untold   of its mean (0) and slope (1): what the logs do not tell from the model's parameters; it has none
    trades   parameters that left their intervals when it was given none
    rivals   curves at other places or of other quantities that do as well
    """

    name: str
    how: str
    at: str
    of: str
    unit: str
    of_unit: str
    x: Array
    y: Array
    low: Array
    high: Array
    edges: Array
    visited: Array
    error_before: float
    error_after: float
    knots: Array = field(repr=False)
    formulas: list[Formula] = field(default_factory=list)
    untold: tuple[int, ...] = ()
    trades: list[str] = field(default_factory=list)
    rivals: list[str] = field(default_factory=list)

    def of_the_kind_of(self, other: LearnedLaw) -> bool:
        """Whether it does the same, at the same place and of the same quantity, whatever its curve and its period."""
        mine, its = (within_no_period(law.of) for law in (self, other))
        return (self.how, self.at, mine) == (other.how, other.at, its)

    def sentence(self) -> str:
        """What it is, in words."""
        stops, lag = self.of.startswith(STOPS), named_lag(self.of)
        what = f"a hysteresis of {self.of.removeprefix(STOPS)}" if stops else f"a function of {self.of}"
        if lag:
            what = f"a function of {lag[0]} (lagged by {lag[1]:.4g} s)"
        if period := period_of(self.of):
            what = f"a function of the time within each {period:.6g} s"
        does = {
            "parameter times": f"{self.at} is multiplied by 1 + {what}",
            "input adds": f"{what} is added to {self.at}",
            "input times": f"{self.at} is multiplied by 1 + {what}",
            "state adds": f"{what} is taken off the derivative of {self.at}",
            "force adds": f"{what} is added to the force",
            "output adds": f"{what} is added to the reading {self.at}",
            "output times": f"the reading {self.at} is multiplied by 1 + {what}",
            "adds": f"{what} is added to {self.at}",
            "times": f"{self.at} is multiplied by 1 + {what}",
        }[self.how]
        best = self.formulas[0] if self.formulas else None
        said = f"{best.text}{f' ({best.law} of the library)' if best.law else ''}" if best else ""
        said = f", {'with the virgin curve ' if stops else ''}{said}" if said else ""
        return f"{does}{said}"


def law_of(ground: Ground, before: tuple[Judge, Fit], tried: Tried) -> LearnedLaw:
    """Everything that is said of the last curve of ``tried``."""
    c, judge, fit = tried.candidate, tried.judge, tried.fit
    table, amplitudes = tried.table()
    grid, y = c.grid, table(amplitudes)
    formulas = _formulas(ground, tried, y)
    low, high = _with_formulas(c, y, *_band(tried), formulas)
    visited = c.quantity.visited[np.isfinite(c.quantity.visited)]
    counts, edges = np.histogram(visited, bins=BINS, range=(c.basis.low, c.basis.high))
    return LearnedLaw(
        c.name, c.how, c.at, c.quantity.name, c.unit, c.quantity.unit, grid, y, low, high, edges,
        counts / max(counts.sum(), 1), rms_of(*before), rms_of(judge, fit), c.basis.knots,
        formulas, c.untold, _trades(tried), list(tried.rivals),
    )  # fmt: skip


def _band(tried: Tried) -> tuple[Array, Array]:
    """90 % band of a curve: blocks of the log and values known beforehand drawn anew, each draw solved by the slopes of
    the fit. What the log cannot tell apart is as wide as it was known before.
    """
    judge, fit, c = tried.judge, tried.fit, tried.candidate
    table, amplitudes = tried.table()
    scale = judge.scale[fit.free]
    prior = fit.prior * scale**2
    n = judge.n_blocks
    rng = np.random.default_rng(0)
    weights = rng.multinomial(n, np.full(n, 1.0 / n), DRAWS)
    known = rng.standard_normal((DRAWS, len(prior))) * np.sqrt(prior)
    at = judge.stage.index()[c.name]
    bounds = tuple(b[fit.free] for b in judge.bounds())
    mine = np.flatnonzero((fit.free >= at.start) & (fit.free < at.stop))
    curves = []
    for w, drawn in zip(weights, known, strict=True):
        a = np.tensordot(w, fit.normals, 1) + np.diag(prior + 1e-9)
        step = np.linalg.solve(a, (w - 1.0) @ fit.gradients + drawn)
        curves.append(table(np.clip(fit.theta[fit.free] + step * scale, *bounds)[mine]))
    edge = 50.0 * (1.0 - BAND)
    low, high = np.percentile(curves, [edge, 100.0 - edge], axis=0)
    y = table(amplitudes)
    return np.minimum(low, y), np.maximum(high, y)


def _with_formulas(c: Candidate, y: Array, low: Array, high: Array, formulas: list[Formula]) -> tuple[Array, Array]:
    """The band about a curve, and about each formula that does as well: a smooth curve is no corner."""
    x, visited = c.grid, np.isin(np.arange(POINTS), np.searchsorted(c.grid, c.quantity.visited).clip(0, POINTS - 1))
    below, above = y - low, high - y
    for formula in formulas:
        f = values_of(formula, x)
        gone = sorted(c.lent)
        if gone:  # the curve has them as the parameters leave them, and the formula has its own
            lines = np.stack([(np.ones(POINTS), x, f)[k] for k in (*gone, *([2] if 1 in gone else []))])
            f = f + np.linalg.lstsq(lines[:, visited].T, (y - f)[visited], rcond=1e-9)[0] @ lines
        low, high = np.minimum(low, f - below), np.maximum(high, f + above)
    return low, high


def _trades(tried: Tried) -> list[str]:
    """Parameters of the model that stand elsewhere than where the curve had a mean and a slope."""
    told, now = tried.told, tried.fit
    if told is None:
        return []
    names, out = [p.name for p in tried.judge.stage.parameters], []
    for k, column in enumerate(told.free):
        if column < len(names) and not told.low[k] <= now.theta[column] <= told.high[k]:
            out.append(names[column])
    return out


# ---- formulas --------------------------------------------------------------------------------------------------------


def _formulas(ground: Ground, tried: Tried, y: Array) -> list[Formula]:
    """Formulas that come within `NEAR` of the best, simplest first, each fitted in the simulation."""
    c = tried.candidate
    x = c.grid
    visited = np.quantile(c.quantity.visited[np.isfinite(c.quantity.visited)], np.linspace(0.005, 0.995, POINTS))
    at_visited = np.interp(visited, x, y)
    shaped = []
    few = len(np.unique(visited)) <= 3  # a direction: every formula is a straight line, or a constant
    warm = c.quantity.unit in DEGREES
    for form in FORMS:
        if (few and form.name not in ("constant", "line")) or (not warm and form.name == "Arrhenius"):
            continue
        if not c.mean and form.name in ("constant", "straight line"):  # less its mean: nothing, and a line
            continue
        # a gain takes a line through 0, and leaves another mean than a line about the middle: only the bends tell
        free = {*c.lent, 0} if 1 in c.lent and form.name not in STRAIGHT else c.lent
        got = begin(form, visited, at_visited, free)
        if got is not None and np.ptp(form.value(visited, got[0])) > FAR * np.ptp(at_visited):
            continue  # nearly a straight line, of which the parameters would have to take all but the bend
        if got is not None and got[1] < SHAPED and _is_shaped(form, got[0], c):
            shaped.append((np.log(max(got[1], 1e-4)) + 0.3 * form.complexity, form, got[0]))
    shaped.sort(key=lambda s: s[0])
    fitted = [f for _, form, numbers in shaped[:REFITTED] if (f := _in_simulation(ground, tried, form, numbers))]
    own = max(rms_of(tried.judge, tried.fit), 1.0)
    fitted = [f for f in fitted if f.error <= POOR * own]
    if not fitted:
        return []
    fitted.sort(key=lambda f: np.log(f.error) + PER_NUMBER * len(f.numbers))
    limit = min(f.error for f in fitted) * (1.0 + NEAR)
    limit = max(limit, min(rms_of(tried.judge, tried.fit), 1.0) * (1.0 + NEAR))
    out: list[Formula] = []
    for f in sorted((f for f in fitted if f.error <= limit), key=lambda f: (f.complexity, f.error)):
        y = values_of(f, visited)
        if all(np.std(y - values_of(g, visited)) > SAME * np.std(y) for g in out):
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


def values_of(formula: Formula, q: Array) -> Array:
    """A formula at values of its quantity."""
    form = next(f for f in FORMS if f.name == formula.form)
    return np.broadcast_to(form.value(q, np.array(list(formula.numbers.values()))), q.shape).astype(float)


def _in_simulation(ground: Ground, tried: Tried, form: Form, numbers: Array) -> Formula | None:
    """A formula in the curve's place, fitted with the model's own parameters."""
    c = tried.candidate
    size = np.maximum(np.abs(numbers), 1e-9 * np.max(np.abs(numbers)))
    ps = tuple(Parameter(n, 0.0, "", scale=float(s)) for n, s in zip(form.numbers, size, strict=True))
    effect = Effect(c.name, ps, (tuple(float(v) for v in numbers),))
    grid = c.grid
    been = c.quantity.visited[np.isfinite(c.quantity.visited)]
    been = been[np.linspace(0, len(been) - 1, min(len(been), MEANT)).astype(int)]

    def mean(n: Array) -> float:  # where a parameter that is fitted has it, the formula has none
        if c.quantity.stops:
            return float(form.value(grid[:1], n)[0])
        return 0.0 if c.mean else float(np.mean(form.value(been, n)))

    def table(n: Array) -> Array:
        return np.broadcast_to(form.value(grid, n) - mean(n), grid.shape).astype(float)

    placed = c.placed_as(table, len(numbers))
    judge = Judge(ground.stage((), (*tried.curves[:-1], (placed, effect))), ground.floor)
    theta = np.concatenate([tried.fit.theta[: tried.judge.stage.index()[c.name].start], numbers])
    if not np.all(np.isfinite(judge.stage.run(theta[None]))):
        return None
    names = tuple(e.name for e in judge.stage.effects)
    theta = judge.fit(names[:-1], theta, 8).theta  # first the rest of the model with the formula as it stands
    fit = with_held_out(judge, judge.fit(names, theta, 12))
    if not np.isfinite(score(judge, fit)):
        return None
    values = form.plain(fit.theta[-len(numbers) :])
    said = dict(zip(form.numbers, (float(v) for v in values), strict=True))
    law = library_name(c, form)
    return Formula(
        form.name,
        text_of(form, values, c.quantity.name, bool(c.basis.low >= 0.0), mean(values)),
        said,
        rms_of(judge, fit),
        form.complexity,
        law,
        -mean(values),
    )


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
