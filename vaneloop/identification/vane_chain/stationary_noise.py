"""Noise that is slower than a log's rows, or that comes into a subsystem through a channel that drives it.

`hil.figures.noise_floor` sees what changes from row to row, and the coloured noise of a recorder is more than that.
What tells it from missing physics: it is the same under every condition. An error is taken for noise where

* its mean square in the bins of each condition is what is expected, within `NOISE_ALIKE` of what exceeds the floor and
  chance: one test for all bins of a condition,
* no bin has a mean that makes as much of it, or such a slope in the windows whose constant is free,
* no line of its spectrum does: what swings has a cause,
* the nominal parameters, beyond their tolerances, would take no more of it than chance allows,
* no effect of the library explains it: a friction leaves much the same error wherever the piston moves,
* and the log is long enough to tell: an error found in only half of a condition's bins would fail that test with a
  probability of `NOISE_TOLD`, for at least half of the conditions. Outputs of one subsystem have one recorder: one of
  them has to tell.

Expected is the output's own noise, which is no more than how the output moves where the demand rests, and a share of
what draws of noise do in a channel that drives the subsystem, which through a table or through play is not alike
everywhere; what slow rows hide is expected where they hide it. The noise of a channel is how it moves where the demand
rests, or what the subsystem that explains it leaves, once that is known to be noise. So a valve's dead band, whose
error is much the same under every condition, is none: its piston rests.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy

from vaneloop.identification.least_squares.problem import LeastSquaresProblem, recalibrate
from vaneloop.identification.regimes import bins_of
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance
from vaneloop.identification.selection.search import Search
from vaneloop.identification.settings import (
    AGREES,
    FLOOR_KNOWN,
    NOISE_ALIKE,
    NOISE_BY_CHANCE,
    NOISE_DRAWS,
    NOISE_TOLD,
    NOISE_WINDOW,
    QUIET_KNOWN_TO,
    WINDOW,
)
from vaneloop.identification.subsystem import Array, Stage, noise_of
from vaneloop.identification.vane_chain.current import law_of
from vaneloop.identification.vane_chain.subsystem_data import ALSO, Made

__all__ = ["bounded", "expect_stationary_noise", "like"]

# each subsystem after those that explain what drives it: the channel whose noise it may pass on
ORDER: Mapping[str, str] = {
    "engine": "", "servo": "x_lvdt", "actuator": "i_cmd", "actuator_a": "i_cmd", "actuator_b": "i_cmd", "demand": "n_r",
    "linkage": "x_lvdt",
}  # fmt: skip


class Expected(NamedTuple):
    """The noise of an output: its RMS, the share of the draws' power in it, whether its bins are known well enough to
    tell it from physics, and the share of what the rows hide that stands where they hide it.
    """

    size: float
    share: float
    told: bool = True
    hidden: float = 1.0


def expect_stationary_noise(stages: Sequence[Stage]) -> list[str]:
    """Have each stage whose error is noise that its floor does not hold expect it: its ``lost``, ``raster_error`` and
    ``floor``. Returns what is to be said of them.
    """
    of = {s.name: s for s in stages if isinstance(s.made, Made) and s.floor is not None}
    noise: dict[str, Array] = {}  # channel -> its noise in windows
    for stage, channel in ((of[name], channel) for name, channel in ORDER.items() if name in of):
        if channel in (columns := stage.made.driven.columns):  # type: ignore[attr-defined]
            demand = _demand(columns, channel)
            seconds = WINDOW if demand is None else NOISE_WINDOW
            noise[channel] = _quietest(*_windows_of(stage, columns[channel], demand, seconds))
    notes = []
    for stage, through in ((of[name], through) for name, through in ORDER.items() if name in of):
        judge = LeastSquaresProblem(stage, np.asarray(stage.floor))
        theta = recalibrate(judge).theta
        e = judge.errors(theta[None])[0] * judge.floor[:, None]
        if np.any(judge.mean_squares(e) > ((1.0 + FLOOR_KNOWN) * judge.floor) ** 2):
            draws = _draws(stage, through, noise[through]) if through in noise else None
            made = np.zeros_like(e)
            if draws is not None:  # as errors are: without the free constants
                made = np.mean(judge._whiten(judge.measured - draws) ** 2, axis=0) * judge.floor[:, None] ** 2
            columns = stage.made.driven.columns  # type: ignore[attr-defined]
            lost = judge.lost()
            found = [
                _noise_in(judge, k, e[k], made[k], columns[o], lost[k], _demand(columns, o))
                for k, o in enumerate(stage.outputs)
            ]
            expected = [one for one in found if one is not None]
            told = any(one.told and one.size > seen for one, seen in zip(expected, judge.floor, strict=False))
            if len(expected) < len(found) or not told or np.any(_of_parameters(judge, theta) > NOISE_BY_CHANCE):
                continue
            if _explained(judge):
                continue
            notes += _said(stage, expected, judge.floor)
            _expect(stage, expected, draws)
        for k, channel in enumerate(stage.outputs):
            noise[channel] = _windows(stage, np.where(judge.valid[k], e[k], np.nan), stage.window)
    return notes


def like(windows: Array, samples: int, seed: int) -> Array:
    """Noise with the mean spectrum of ``windows``, float64[windows, any], each of its frequencies at a phase by chance:
    float64[samples].
    """
    width = windows.shape[1]
    taper = np.hanning(width)
    power = np.mean(np.abs(np.fft.rfft(windows * taper)) ** 2, axis=0) / np.sum(taper**2)
    at = np.fft.rfftfreq(samples)
    draw = np.random.default_rng(seed)
    phases = draw.standard_normal(len(at)) + 1j * draw.standard_normal(len(at))
    size = np.sqrt(np.interp(at, np.fft.rfftfreq(width), power) * samples / 2.0)
    return np.asarray(np.fft.irfft(size * phases, samples))


def _windows(stage: Stage, values: Array, seconds: float | None) -> Array:
    """Values in windows of so many seconds without a gap, float64[windows, samples]."""
    return _windows_of(stage, values, None, seconds)[0]


def _windows_of(stage: Stage, values: Array, beside: Array | None, seconds: float | None) -> tuple[Array, Array]:
    """Values in windows of so many seconds without a gap in them or in another channel, and that channel in the same
    windows, float64[windows, samples] each; no other channel: the values themselves.
    """
    width = max(8, round((seconds or NOISE_WINDOW) / float(stage.t[1] - stage.t[0])))
    both = np.array([values, values if beside is None else beside])
    both = both[:, : both.shape[1] // width * width].reshape(2, -1, width)
    whole, others = both[:, np.isfinite(both).all(axis=(0, 2))]
    return whole, others


def _demand(columns: Mapping[str, Array], channel: str) -> Array | None:
    """The demand that stroke, current and angles follow; None: of another channel, or not logged."""
    return None if channel in ("n_r", "x_dem") else columns.get("x_dem")


def _draws(stage: Stage, channel: str, windows: Array) -> Array | None:
    """What draws of the noise of a ``channel``, seen in ``windows``, make of a stage's outputs, float64[draws, outputs,
    samples]; None where no window shows any.
    """
    if not windows.any():
        return None
    made, neutral = stage.made, stage.neutral()[None]
    assert isinstance(made, Made)
    columns, as_logged = made.driven.columns, stage.run(neutral)[0]
    out = []
    for seed in range(NOISE_DRAWS):
        noise = like(windows, len(stage.t), seed)
        names = {channel, *ALSO.get(channel, ())} & columns.keys()
        noisy = {c: columns[c] + (noise if columns[c].ndim == 1 else noise[:, None]) for c in names}
        if stage.name == "servo":
            law = law_of(np.zeros(len(noise)), noise, made.driven.calibration)
            noisy["law"] = columns["law"] + law[:, -columns["law"].shape[1] :]
        varied = made.make(made.driven._replace(columns=columns | noisy, again=True))
        out.append(varied.run(neutral)[0] - as_logged)
    return np.array(out)


def _noise_in(
    judge: LeastSquaresProblem, k: int, error: Array, made: Array, output: Array, lost: Array,
    demand: Array | None = None,
) -> Expected | None:  # fmt: skip
    """The noise that the ``error`` of output ``k`` is, float64[samples] in its unit; None: it is none.

    made    mean square of what draws of noise in a driving channel make of it, float64[samples]
    output  as it was logged: in its quietest windows there is no less than its noise
    lost    squared error that the rows make expect in each sample, in squared noise floors, 1 on average
    demand  that the output follows; None: none is logged
    """
    stage, floor = judge.stage, float(judge.floor[k])
    bins = [b for values in stage.regimes.values() if (b := bins_of(judge, k, values)) is not None]
    if not bins:
        return None
    place = ((stage.t - stage.t[0]) / stage.window) % 1.0 - 0.5 if stage.window else np.ones_like(stage.t)
    spread = floor**2 * (lost - 1.0)  # what the rows hide, beside its mean
    n, square, uneven, through, sign = (
        np.concatenate([b.sums(x) for b in bins]) for x in (np.ones_like(error), error**2, spread, made, error * place)
    )
    count = n.sum(axis=1)
    whole = float(square.sum() / count.sum())
    if whole <= ((1.0 + FLOOR_KNOWN) * floor) ** 2:
        return Expected(floor, 0.0)
    counted = np.where(judge.valid[k], error, np.nan)
    quietest = _quietest(*_windows_of(stage, np.where(judge.valid[k], output, np.nan), demand, stage.window))
    own_most = QUIET_KNOWN_TO**2 * _power(quietest)
    weight = 1.0 / (np.sqrt(count) * whole)
    a = np.array([whole * count, through.sum(axis=1), uneven.sum(axis=1)]).T
    most = np.array([own_most / whole, QUIET_KNOWN_TO**2, 1.0])
    own, share, hidden = bounded(a * weight[:, None], square.sum(axis=1) * weight, most) * (whole, 1.0, 1.0)
    excess = 1.0 - floor**2 / whole
    expected = own * n + share * through + hidden * uneven
    of = np.maximum(expected, whole * n)  # where little is expected, what is left counts as it does elsewhere
    ratio, deviation = _over_blocks(square - expected + of, of)
    mean, of_mean = _over_blocks(sign, n)
    of_sign = NOISE_ALIKE * excess * whole * float(np.mean(place[judge.valid[k]] ** 2))
    ends = np.cumsum([b.many for b in bins])[:-1]
    conditions = zip(*(np.split(x, ends) for x in (ratio, deviation, n)), strict=True)
    tests = [_alike(r, d, m, excess, NOISE_BY_CHANCE / len(bins)) for r, d, m in conditions]
    signed = np.maximum(np.abs(mean) - 2.0 * of_mean, 0.0) ** 2 > of_sign
    spectrum = np.abs(np.fft.rfft(np.nan_to_num(counted - np.nanmean(counted)))) ** 2
    line = float(np.convolve(spectrum, np.ones(3), "same").max() / spectrum.sum())
    short = 1.0 - float(expected.sum() / square.sum())  # where own noise and that of the channel are not enough
    if line >= NOISE_ALIKE * excess or short > 0.5 * NOISE_ALIKE * excess:
        return None
    if not all(one.holds for one in tests) or np.mean(signed) > NOISE_BY_CHANCE:
        return None
    told = bool(np.median([one.power for one in tests]) >= NOISE_TOLD)
    return Expected(float(np.sqrt(whole)), float(share), told, float(hidden))


class Alike(NamedTuple):
    """Whether an error passes for alike in all bins of a condition, and the power of that test against an error found
    in half of them alone.
    """

    holds: bool
    power: float


def _alike(ratio: Array, deviation: Array, n: Array, excess: float, level: float) -> Alike:
    """The F test of a condition's bins: the variance between bins over that within them, from block to block, which is
    pooled. Bins without samples do not count, and a single bin says nothing.

    ratio, deviation  mean square of each bin over what is expected, and its standard deviation, float64[bins]
    n       samples, float64[bins, blocks of the log]
    excess  of the error over the floor, in mean squares of the error; noise is alike to `NOISE_ALIKE` of it, which
            counts as two standard deviations
    level   chance of an error that is alike to fail
    """
    there = n.any(axis=1)
    ratio, deviation, n = ratio[there], deviation[there], n[there]
    if len(ratio) < 2:
        return Alike(True, 0.0)
    samples, blocks = n.sum(axis=1), (n > 0.0).sum(axis=1) - 1.0
    within, bins = max(float(blocks.sum()), 1.0), len(ratio) - 1
    variance = float(np.sum(blocks * samples * deviation**2)) / within / samples + (0.5 * NOISE_ALIKE * excess) ** 2
    most = float(scipy.special.fdtri(bins, within, 1.0 - level))
    found, away = (float(np.sum(x**2 / variance)) for x in (ratio - 1.0, excess))
    return Alike(found <= bins * most, float(1.0 - scipy.special.ncfdtr(bins, within, away, most)))


def _of_parameters(judge: LeastSquaresProblem, theta: Array) -> Array:
    """Share of the power of each output's error that a straight step of all nominal parameters together would take."""
    e, slopes = judge.nominal_slopes(theta)
    out = []
    for left, columns in zip(e, slopes.transpose(1, 2, 0), strict=True):
        taken = columns @ np.linalg.lstsq(columns, left, rcond=None)[0]
        out.append(float(taken @ taken) / max(float(left @ left), 1e-300))
    return np.array(out)


def _explained(judge: LeastSquaresProblem) -> bool:
    """Whether one effect of the library explains the error: it is accepted, and leaves hardly more than the floor."""
    search = Search(LikelihoodAcceptance(judge))
    criterion, effects = search.criterion, judge.stage.effects
    if search.quiet or not effects:
        return False
    best = min(search.singles([e.name for e in effects]).values(), key=criterion.order)
    criterion.learn(best)
    accepted = criterion.accepts(search.base, best)
    return accepted and criterion.conclude(search.base, best, [], [], []).verdict == "missing"


def bounded(a: Array, b: Array, most: Array) -> Array:
    """The least squares of a x = b, float64[rows, n], with each x from 0 to ``most``, which may be infinite: the best
    of those with some x on an edge and the others inside.
    """
    tried = []
    for edges in product(*((np.nan, 0.0, one) if np.isfinite(one) else (np.nan, 0.0) for one in most)):
        x = np.array(edges)
        free = np.isnan(x)
        x[free] = 0.0
        x[free] = np.linalg.lstsq(a[:, free], b - a @ x, rcond=None)[0]
        if np.all((x >= 0.0) & (x <= most)):
            tried.append(x)
    return min(tried, key=lambda x: float(np.sum((a @ x - b) ** 2)))


def _quietest(windows: Array, by: Array | None = None) -> Array:
    """The tenth of windows, float64[windows, samples], in which the machine moves least, beside their trend: at least
    one, if there is any.

    by  what tells how the machine moves in them: the demand, for those that move least themselves have less slow noise
        than the others. None: themselves
    """
    moves = _detrended(windows if by is None else by).std(axis=1)
    return _detrended(windows[np.argsort(moves, kind="stable")[: max(1, round(0.1 * len(windows)))]])


def _detrended(windows: Array) -> Array:
    place = np.linspace(-1.0, 1.0, windows.shape[1])
    level = windows - windows.mean(axis=1, keepdims=True)
    return np.asarray(level - np.outer(level @ place / (place @ place), place))


def _power(windows: Array) -> float:
    return float(np.mean(windows**2)) if len(windows) else np.inf


def _over_blocks(values: Array, expected: Array) -> tuple[Array, Array]:
    """Sum of values over the sum expected, and its standard deviation by the jackknife over blocks: float64[bins] of
    float64[bins, blocks].
    """
    total, of = values.sum(axis=1), expected.sum(axis=1)
    ratio = total / of
    there = expected > 0.0
    left = (total[:, None] - values) / np.where(of[:, None] > expected, of[:, None] - expected, np.inf)
    away = np.where(there, left - ratio[:, None], 0.0)
    blocks = np.maximum(there.sum(axis=1), 2)
    return ratio, np.sqrt(np.sum(away**2, axis=1) * (blocks - 1) / blocks)


def _expect(stage: Stage, noise: Sequence[Expected], draws: Array | None) -> None:
    floor, size = np.asarray(stage.floor), np.array([one.size for one in noise])
    share, hidden = np.sqrt([(one.share, one.hidden) for one in noise]).T[:, :, None]
    parts = [one * by for one, by in ((stage.lost, hidden), (draws, share)) if one is not None]
    draw = np.arange(max(map(len, parts), default=0))
    stage.lost = np.sum([one[draw % len(one)] for one in parts], axis=0) if parts else None
    more = np.sqrt(np.maximum(size**2 - floor**2, 0.0))
    stage.raster_error = np.hypot(0.0 if stage.raster_error is None else stage.raster_error, more)
    stage.floor = noise_of(stage, stage.neutral())


def _said(stage: Stage, noise: Sequence[Expected], floor: Array) -> list[str]:
    """A note on a stage whose noise would fail by its ``floor``; none where it would not."""
    named = ", ".join(
        f"{name} {one.size:.3g} {unit} ({one.size / seen:.3g} times)"
        for name, unit, one, seen in zip(stage.outputs, stage.units, noise, floor, strict=True)
        if one.size > AGREES * seen
    )
    said = f"{stage.name}: noise beyond what changes from row to row, the same under every condition: {named}"
    return [said] if named else []
