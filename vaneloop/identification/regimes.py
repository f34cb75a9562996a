"""By how much does a stage fail, where, since when, and what is the shape of what no effect in the library explains?

`locate` is the only place that says whether a stage agrees with its log: terminal, JSON, pages, workbench and users'
own models draw it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from vaneloop.base.compiled import compiled
from vaneloop.identification.least_squares.noise import colour_of, most_floor, tolerance
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem, recalibrate
from vaneloop.identification.results import rms_per_output
from vaneloop.identification.settings import AGREES, COLOUR, RASTER_KNOWN_TO, REGIME_BINS, REGIME_LEVEL, SHAPE_TOLD
from vaneloop.identification.subsystem import Array, without_jumps

__all__ = [
    "Bins", "Located", "Regime", "Shape", "StageFigures", "agrees", "bins_of", "locate", "onset", "regimes", "shape",
    "stands_out", "steady",
]  # fmt: skip


def agrees(error: float, floor: float) -> bool:
    """Whether an RMS error is no more than noise of this RMS."""
    return bool(error <= AGREES * floor)


@dataclass(frozen=True)
class StageFigures:
    """Error of one output of a stage driven by its own logged inputs, in its unit.

    rms           with the stage's nominal parameters refitted within their tolerances
    rms_as_given  with the parameters as they are
    tolerance     error, in noise floors, that is no more than noise: the more, the shorter the log
    """

    stage: str
    signal: str
    unit: str
    rms: float
    rms_as_given: float
    noise_floor: float
    samples: int
    tolerance: float = AGREES

    @property
    def ratio(self) -> float:
        """Error in noise floors."""
        return self.rms / self.noise_floor

    @property
    def agrees(self) -> bool:
        """Whether the error is no more than noise."""
        return bool(self.rms <= self.tolerance * self.noise_floor)

    def json(self) -> dict[str, Any]:
        """The figures as the commands' JSON."""
        return {**asdict(self), "ratio": self.ratio, "agrees": self.agrees}


@dataclass(frozen=True, eq=False)
class Regime:
    """Error of one output against one condition.

    edges    of the bins, in ``unit`` (bins + 1)
    rms      error in the output's unit, per bin
    ratio    the same in noise floors
    samples  per bin
    significant  bins whose error exceeds the noise floor, corrected for the number of bins and regimes looked at
    contrast how unevenly the squared error is spread over the bins: 0 even, 1 all in one bin
    moments  s, when the error of each bin is greatest; NaN where a bin has no sample
    """

    output: str
    unit: str
    condition: str
    condition_unit: str
    edges: Array
    rms: Array
    ratio: Array
    samples: Array
    significant: Array
    contrast: float
    moments: Array

    def place(self, b: int) -> str:
        """A bin in words."""
        low, high = self.edges[b], self.edges[b + 1]
        if self.condition == "direction":
            where = {-1.0: "negative", 0.0: "at rest", 1.0: "positive"}
            return f"direction {where[float(round(0.5 * (low + high)))]}"
        return f"{self.condition} {low:.4g} to {high:.4g} {self.condition_unit}".rstrip()

    def worst(self) -> str:
        """The bin with the greatest error, in words."""
        return self.told(int(np.nanargmax(np.where(self.samples > 0, self.rms, np.nan))))

    def told(self, b: int) -> str:
        """The error of a bin, in words."""
        return f"{self.output}: {self.rms[b]:.3g} {self.unit} ({self.ratio[b]:.3g} noise floors) at {self.place(b)}"

    def json(self) -> dict[str, Any]:
        """The condition as the commands' JSON."""
        return {
            "signal": self.output, "unit": self.unit, "condition": self.condition,
            "condition_unit": self.condition_unit,
            "edges": self.edges, "rms": self.rms, "noise_floors": self.ratio, "samples": self.samples,
            "significant": [bool(b) for b in self.significant], "contrast": self.contrast,
            "moments_s": self.moments,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Located:
    """What one stage says with nothing added: how large its error is, whether that is more than noise, under which
    conditions.

    fit      the stage's nominal parameters, refitted within their tolerances; no effect
    floor    noise floor of every output
    signals  the error of every output
    regimes  the error of every output against every condition, most telling first
    onset    s, where the error begins inside the log; None: it does not
    """

    stage: str
    fit: Fit
    floor: Array
    signals: tuple[StageFigures, ...]
    regimes: tuple[Regime, ...]
    onset: float | None

    @property
    def hot(self) -> list[Regime]:
        """Conditions under which the error exceeds the noise."""
        return [r for r in self.regimes if r.significant.any()]

    @property
    def fails(self) -> bool:
        """Whether an output's error is more than noise, over the whole log or under any condition."""
        return bool(self.hot) or not all(s.agrees for s in self.signals)

    @property
    def worst(self) -> StageFigures:
        """The output with the greatest error in noise floors."""
        return max(self.signals, key=lambda s: s.ratio)

    def verdict(self) -> str:
        """Whether it agrees or fails, in words."""
        if not self.fails:
            return "fits everywhere"
        where = (
            f"{len(self.hot)} of {len(self.regimes)} conditions"
            if self.hot
            else "no single condition more than in others"
        )
        if self.worst.agrees:
            return f"fits over the whole log, fails in {where}: {self.hot[0].worst()}"
        return f"fails in {where}: {self.worst.signal} at {self.worst.ratio:.3g} noise floors"

    def json(self) -> dict[str, Any]:
        """The stage as the JSON of ``vaneloop locate``."""
        return {
            "stage": self.stage, "fails": self.fails, "verdict": "fails" if self.fails else "agrees",
            "onset_s": self.onset,
            "signals": [s.json() for s in self.signals], "regimes": [r.json() for r in self.regimes],
        }  # fmt: skip


@compiled
def steady(values: np.ndarray, band: float) -> np.ndarray:
    """A condition's values without what is within ``band`` to each side: it moves when the channel leaves the band.

    A condition that holds its own noise sorts the samples by it: at rest the outer bins hold the largest errors of
    every subsystem that this noise is in, and a model without fault fails there. NaN moves nothing.
    """
    out = np.empty(len(values))
    at = np.nan
    for i in range(len(values)):
        v = values[i]
        if np.isnan(at):
            at = v
        elif not np.isnan(v):
            at = min(max(at, v - band), v + band)
        out[i] = at
    return out


def locate(judge: LeastSquaresProblem, fit: Fit | None = None) -> Located:
    """Where the stage fails with nothing added. ``fit``: its nominal parameters refitted, where that has been done
    (`recalibrate`).
    """
    stage = judge.stage
    fit = fit or recalibrate(judge)
    colour = colour_of(judge, fit)
    given = judge.errors(stage.neutral()[None])[0]
    rms, n = rms_per_output(judge, fit), judge.valid.sum(axis=1)
    as_given = np.sqrt(np.sum(given * given, axis=1) / np.maximum(n, 1)) * judge.floor
    signals = tuple(
        StageFigures(
            stage.name, signal, stage.units[k], float(rms[k]), float(as_given[k]), float(judge.floor[k]), int(n[k]),
            tolerance(int(n[k]), colour),
        )
        for k, signal in enumerate(stage.outputs)
    )  # fmt: skip
    found = tuple(regimes(judge, fit, colour))
    start = onset(judge, fit) if any(r.significant.any() for r in found) else None
    return Located(stage.name, fit, judge.floor, signals, found, start)


def _edges(values: Array) -> Array:
    """Edges of bins of equal population; a categorical condition gets a bin per value."""
    some = np.unique(values[: 8 * REGIME_BINS])  # where these are many, nobody needs to sort all
    distinct = np.unique(values) if len(some) <= REGIME_BINS else some
    if len(distinct) <= REGIME_BINS:
        middle = 0.5 * (distinct[1:] + distinct[:-1])
        return np.concatenate([[distinct[0] - 0.5], middle, [distinct[-1] + 0.5]])
    edges = np.unique(np.quantile(values, np.linspace(0, 1, REGIME_BINS + 1)))
    edges[-1] += 1e-9 * max(1.0, abs(edges[-1]))
    return edges


class Bins(NamedTuple):
    """The samples of one output by bins of a condition and blocks of the log.

    edges   of the bins, bins + 1
    use     bool[samples]: those that count
    bin_of  of each of these
    block_of  of each of these; ``blocks``: how many there are
    """

    edges: Array
    use: Array
    bin_of: Array
    block_of: Array
    blocks: int

    @property
    def many(self) -> int:
        """Number of bins."""
        return len(self.edges) - 1

    def sums(self, values: Array) -> Array:
        """Sums of values, float64[samples], in each bin and block, float64[bins, blocks]."""
        cell = self.bin_of * self.blocks + self.block_of
        return np.bincount(cell, values[self.use], minlength=self.many * self.blocks).reshape(self.many, self.blocks)


def bins_of(judge: LeastSquaresProblem, output: int, values: Array) -> Bins | None:
    """Bins of a condition's values, float64[samples], for an output; None where they say nothing."""
    use = judge.valid[output] & np.isfinite(values)
    if use.sum() < 100 or np.ptp(values[use]) == 0.0:
        return None
    edges = _edges(values[use])
    bin_of = np.clip(np.digitize(values[use], edges) - 1, 0, len(edges) - 2)
    return Bins(edges, use, bin_of, judge.block_of[use], judge.n_blocks)


def regimes(judge: LeastSquaresProblem, fit: Fit, correlation: float) -> list[Regime]:
    """Error of every output against every condition of the stage, most telling first.

    A bin is significant where what is left of it without its worst block of the log is too: one slam that the equations
    do not hold to a micrometre is no condition.
    """
    e, lost = judge.errors(fit.theta[None])[0], judge.lost()
    stage = judge.stage
    raster = np.zeros(len(stage.outputs)) if stage.raster_error is None else (stage.raster_error / judge.floor) ** 2
    known = 1.0 + np.minimum(raster, 1.0) * ((1.0 + RASTER_KNOWN_TO) ** 2 - 1.0)
    raw = []
    looks = 0
    for k, output in enumerate(stage.outputs):
        for name, values in stage.regimes.items():
            bins = bins_of(judge, k, values)
            if bins is None:
                continue
            looks += bins.many
            sums = bins.sums(np.ones(e.shape[1])), bins.sums(e[k] ** 2), bins.sums(lost[k])
            moments = _greatest(bins.bin_of, np.abs(e[k, bins.use]), stage.t[bins.use], bins.many)
            raw.append((k, output, name, bins.edges, sums, moments))
    out = []
    for k, output, name, edges, sums, moments in raw:
        # what all other bins have, too, is no matter of this one, as far as the floor may be wrong
        total, squares, expected = (v.sum() - v.sum(axis=1) for v in sums)
        elsewhere = squares / np.maximum(np.maximum(expected, total), 1.0)
        of_noise = np.maximum(known[k], np.minimum(elsewhere, most_floor(int(sums[0].sum()), correlation) ** 2))
        hot, n, ms = stands_out(*sums, of_noise, looks, correlation)
        ratio = np.sqrt(ms)
        excess = np.maximum(ms - 1.0, 0.0)
        share = excess / excess.sum() if excess.sum() > 0 else np.full(len(n), 1.0 / len(n))
        contrast = float((np.sum(share**2) - 1.0 / len(n)) / (1.0 - 1.0 / len(n))) if len(n) > 1 else 0.0
        unit = judge.floor[k]
        out.append(
            Regime(
                output, stage.units[k], name, stage.regime_units.get(name, ""), edges, ratio * unit, ratio, n,
                hot & (ratio > 1.05), contrast, moments,
            )
        )  # fmt: skip
    out.sort(key=lambda r: (-float(r.significant.any()), -r.contrast))
    return out


def stands_out(
    n: Array, square: Array, floor: Array, known: float | Array, looks: int, correlation: float = COLOUR[0]
) -> tuple[Array, Array, Array]:
    """Bins whose error exceeds the noise, corrected for the number of ``looks``, with and without their worst block;
    samples of each bin, and their mean square error over what is to be expected.

    n, square, floor  samples, sum of squares in noise floors, and the sum to be expected, each float64[bins, blocks]
    known             mean square up to which an error may be noise, in squared noise floors; of each bin, or of all
    """
    worst = (np.arange(len(n)), np.argmax(square - floor, axis=1))
    whole = _mean(*(x.sum(axis=1) for x in (n, square, floor)))
    rest = _mean(*(x.sum(axis=1) - x[worst] for x in (n, square, floor)))
    z, confirmed = ((ms / known - 1.0) * np.sqrt(np.maximum(m, 1) / (2.0 * correlation)) for m, ms in (whole, rest))
    return (z > -scipy.special.ndtri(REGIME_LEVEL / max(looks, 1))) & (
        confirmed > -scipy.special.ndtri(REGIME_LEVEL)
    ) & (whole[0] > 20), *whole


def _mean(n: Array, squares: Array, floor: Array) -> tuple[Array, Array]:
    """How many samples; mean square of their error over that of the noise to be expected of them."""
    return n.astype(int), squares / np.maximum(np.maximum(floor, n), 1.0)


def _greatest(bin_of: Array, size: Array, t: Array, bins: int) -> Array:
    """Time of the greatest ``size`` in each bin."""
    out, most = np.full(bins, np.nan), np.full(bins, -1.0)
    np.maximum.at(most, bin_of, size)
    at = np.flatnonzero(size == most[bin_of])
    out[bin_of[at]] = t[at]
    return out


def onset(judge: LeastSquaresProblem, fit: Fit) -> float | None:
    """Time (s) at which the error rises for good; None if it has no onset inside the log."""
    e = judge.errors(fit.theta[None])[0]
    t = judge.stage.t
    width = max(1, int(round(0.2 * judge.memory / (t[1] - t[0]))))
    n = e.shape[1] // width * width
    counts = judge.valid[:, :n].reshape(len(e), -1, width).sum(axis=(0, 2))
    power = (e[:, :n] ** 2).reshape(len(e), -1, width).sum(axis=(0, 2))
    use = counts > 0.3 * width
    if use.sum() < 16:
        return None
    level = np.log(np.maximum(power[use] / counts[use], 1e-3))
    when = t[:n:width][use]
    k = step_in(level)
    before, after = level[:k], level[k:]
    if len(before) < 4 or len(after) < 4:
        return None
    spread = np.sqrt(before.var() / len(before) + after.var() / len(after))
    quiet = np.exp(before.mean()) < 1.3
    if after.mean() - before.mean() > max(6.0 * spread, 0.5) and quiet:
        return float(when[k])
    return None


def step_in(level: Array) -> int:
    """Index at which a level steps, least squares, each fifth tried: what the step explains is
    k (n - k) / n times the square of its size. As `ruptures.Binseg` finds it, whose import takes a second.
    """
    n = len(level)
    k = np.arange(5, n - 3, 5)
    explained = np.cumsum(level - level.mean())[k - 1] ** 2 / (k * (n - k))
    return int(k[np.argmax(explained)])


@dataclass(frozen=True, eq=False)
class Shape:
    """What is left, as a function of something physical."""

    output: str
    feature: str
    explained: float
    text: str
    x: Array
    y: Array
    x_unit: str
    y_unit: str


def shape(judge: LeastSquaresProblem, fit: Fit, noise: float = 1.0) -> list[Shape]:
    """Describe the remaining error of each output: the feature that explains most of it, and how.

    For a stage that integrates, the slope of the error is described (an effect there adds speed); else the error
    itself.
    """
    stage = judge.stage
    e = judge.errors(fit.theta[None])[0] * judge.floor[:, None]
    t = stage.t
    dt = t[1] - t[0]
    second = 0.1 * judge.memory  # of a stage whose time scale is that of the vanes
    k = max(1, int(round(0.1 * second / dt)))
    out: list[Shape] = []
    for o, output in enumerate(stage.outputs):
        valid = judge.valid[o].copy()
        y, unit, what = e[o].copy(), stage.units[o], f"error of {output}"
        # rates of the error with its jumps closed: one that drifts through a window is no sawtooth, and yet nothing is
        # told at the windows' own rate, at which each of them starts alike
        whole = without_jumps(stage, stage.measured[o] - stage.run(fit.theta[None])[0, o])
        rate = np.diff(whole) / dt
        f, power = scipy.signal.periodogram(np.where(np.isfinite(rate), rate, 0.0), 1.0 / dt)
        power[1:] /= (2.0 * np.sin(np.pi * f[1:] * dt) / dt) ** 2
        resolution = max(0.05 / second, 3.0 / (t[-1] - t[0]))
        keep = f > 0.7 / second
        if stage.window:
            keep &= np.abs(f * stage.window - np.round(f * stage.window)) > resolution * stage.window
        if keep.any() and power[keep].max() > 0:
            peak = int(np.flatnonzero(keep)[np.argmax(power[keep])])
            near = np.abs(f - f[peak]) < resolution
            line = float(power[near].sum() * (f[1] - f[0]))
            background = float(np.median(power[keep])) * near.sum() * (f[1] - f[0])
            if line > 30.0 * background and line > 0.25 * float(np.mean(y[valid] ** 2)):
                amplitude = np.sqrt(2.0 * line)
                text = f"{what} oscillates at {f[peak]:.2f} Hz with an amplitude of {amplitude:.3g} {unit}"
                share = line / float(np.mean(y[valid] ** 2))
                out.append(Shape(output, "frequency", share, text, f[keep], power[keep], "Hz", f"{unit}^2/Hz"))
                continue
        if stage.window:
            slope = np.full_like(y, np.nan)
            slope[k:-k] = (y[2 * k :] - y[: -2 * k]) / (2 * k * dt)
            assert judge.window_start is not None
            for s in judge.window_start:  # no slope across the free constants
                slope[max(0, s - k) : s + k] = np.nan
            y, unit, what = slope, f"{unit}/s", f"rate of the error of {output}"
        use = valid & np.isfinite(y)
        if use.sum() < 200:
            continue
        total = float(np.mean((y[use] - y[use].mean()) ** 2)) + float(y[use].mean() ** 2)
        features: dict[str, tuple[Array, Array, str]] = {}
        direction = stage.regimes.get("direction")
        for name, v in sorted(
            stage.regimes.items(), key=lambda item: item[0] == "time"
        ):  # time explains what nothing physical does
            features[name] = (v, y, stage.regime_units.get(name, ""))
            if direction is not None and name != "direction":
                features[f"{name}, against the motion"] = (v, y * direction, stage.regime_units.get(name, ""))
        best: tuple[float, str, Array, Array, str] | None = None
        for name, (v, target, x_unit) in features.items():
            ok = use & np.isfinite(v) & np.isfinite(target)
            if ok.sum() < 200 or np.ptp(v[ok]) == 0.0:
                continue
            edges = _edges(v[ok])
            b = np.clip(np.digitize(v[ok], edges) - 1, 0, len(edges) - 2)
            half = (
                np.arange(ok.sum()) // max(1, int(5.0 * second / dt))
            ) % 2 == 0  # curves from half of the stretches must hold for the other
            n1, n2 = np.bincount(b[half], minlength=len(edges) - 1), np.bincount(b, minlength=len(edges) - 1)
            mean = np.bincount(b[half], target[ok][half], minlength=len(edges) - 1) / np.maximum(n1, 1)
            rest = float(np.mean((target[ok][~half] - mean[b[~half]]) ** 2))
            explained = 1.0 - rest / max(total, 1e-300)
            curve = np.bincount(b, target[ok], minlength=len(edges) - 1) / np.maximum(n2, 1)
            x = np.bincount(b, v[ok], minlength=len(edges) - 1) / np.maximum(n2, 1)
            if best is None or explained > best[0] + 0.02:
                best = (explained, name, x, curve, x_unit)
        if best is None:
            continue
        explained, name, x, curve, x_unit = best
        if explained < SHAPE_TOLD:
            text = f"{what}: {np.sqrt(total):.3g} {unit} rms, not a function of any one logged condition"
        else:
            text = f"{what} {_in_words(name, x, curve, unit, x_unit)}; explains {100 * explained:.0f} % of what is left"
        out.append(Shape(output, name, explained, text, x, curve, x_unit, unit))
    out.sort(key=lambda s: -s.explained)
    return out


def _in_words(name: str, x: Array, y: Array, unit: str, x_unit: str) -> str:
    """How a curve runs, in words."""
    name, _, against = name.partition(", ")
    sense = ", independent of direction"
    if against:
        sense = " and opposes the motion" if y.mean() < 0 else " and follows the motion"
    if name == "direction":
        return f"changes with the direction of motion: {', '.join(f'{v:.3g}' for v in y)} {unit}"
    if len(x) < 3:
        return f"differs between {name} {x[0]:.3g} and {x[-1]:.3g} {x_unit}: {y[0]:.3g} and {y[-1]:.3g} {unit}{sense}"
    forms = {
        "grows linearly with": x,
        "grows with the square of": x * x,
        "grows with the magnitude of": np.abs(x),
        "depends on the sign of": np.sign(x - (0.0 if x.min() < 0 < x.max() else np.median(x))),
    }
    total = float(np.sum((y - y.mean()) ** 2)) or 1.0
    if np.ptp(y) < 0.25 * np.abs(y).max():
        return f"is nearly constant at {y.mean():.3g} {unit}{sense}"
    best, score = "", -1.0
    for text, f in forms.items():
        if not np.ptp(f) > 1e-12 * np.abs(f).max():  # a curve of one point
            continue
        c = np.polyfit(f, y, 1)
        r2 = 1.0 - float(np.sum((y - np.polyval(c, f)) ** 2)) / total
        if r2 > score + 0.02:
            best, score = text if c[0] > 0 else text.replace("grows", "falls"), r2
    span = f"from {y[0]:.3g} {unit} at {x[0]:.4g} to {y[-1]:.3g} {unit} at {x[-1]:.4g} {x_unit}".rstrip()
    if score > 0.8:
        return f"{best} {name}{sense}, {span}"
    peak = int(np.argmax(np.abs(y)))
    return f"is greatest, {y[peak]:.3g} {unit}, near {name} {x[peak]:.4g} {x_unit}{sense}, {span}"
