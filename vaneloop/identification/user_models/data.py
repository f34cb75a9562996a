"""The logs of a system, checked, one after the other on one time axis."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import scipy

from hil.logs.notes import MOST_ROWS, Note
from vaneloop.base.sizes import LARGEST, beyond, no_smaller
from vaneloop.identification.regimes import steady
from vaneloop.identification.settings import (
    CONDITION_BAND,
    EDGE_PERIODS,
    INPUT_JUMP,
    LEAST_POINTS,
    LEAST_SAMPLES,
    LONGEST_SPIKE,
    MOST_PLANES,
    MOVES,
    PLANE_FREE,
    SPIKE_ANSWERS,
    SPIKE_BACK,
    SPIKE_FAR,
    SPIKE_SHARE,
    SPLINE_MEMORY,
    UNORDERED,
)
from vaneloop.identification.subsystem import Array, StageError
from vaneloop.identification.user_models.exogenous_regressors import column_of
from vaneloop.identification.user_models.motion import (
    MOTION,
    differentiated_to,
    highest_frequency,
    low_pass,
    motion,
    smoothed,
    uses,
)
from vaneloop.identification.user_models.system import Record, System

__all__ = ["Data", "noise_of_channel", "noise_of_neighbours", "spikes", "without_order"]


class Data:
    """The logs that a system is held against.

    records   the logs, from time 0; what drives the model has no NaN
    times     s, log by log: as the log it was cut out of counts
    logs      name -> slice of samples
    in_names  what drives the model: for kind force the motion, then the inputs
    u, y      log by log: float64[in_names, samples] and float64[outputs, samples]
    t         s, of all logs, one after the other
    measured  float64[outputs, samples], of all logs
    cutoff    Hz, up to which forces are compared; None: they are as measured
    motion_cutoff   Hz, up to which motion is differentiated for it
    window    s, after which the model starts anew from the measured states; None: it does not
    notes     what the user should know
    ordered   rows stand in the order of time
    like      take the cut-off from an earlier one (for test logs)
    """

    def __init__(self, system: System, records: Sequence[Record], like: Data | None = None):
        self.system, self.like = system, like
        self.cutoff: float | None = None
        self.motion_cutoff: float | None = None
        self.notes: list[str] = []
        if not records:
            raise StageError(f"system {system.name!r}: no log")
        self.notes += [n for r in records for n in r.notes]
        self.records = [self._checked(r) for r in records]
        self.ordered = all(r.ordered for r in self.records)
        self.times = [r.t + r.begin for r in self.records]
        self.logs: dict[str, slice] = {}
        at = 0
        for r in self.records:
            name = r.name
            while name in self.logs or (like is not None and name in like.logs):
                name += "'"
            self.logs[name] = slice(at, at + len(r.t))
            at += len(r.t)
        self._prepare()
        self.window = system.window
        self._restart_cache: dict[tuple[int, float], tuple[Array, Array]] = {}
        self._columns: dict[tuple[int, str], Array] = {}

    def _checked(self, r: Record) -> Record:
        s = self.system
        for c in s.channels():
            if c not in r.columns and c not in s.optional():
                close = difflib.get_close_matches(c, r.columns, 1)
                hint = f"; close: {close[0]}" if close else ""
                raise StageError(
                    f"{r.name}: no channel {c!r}, which system {s.name!r} needs{hint}; the log has "
                    f"{', '.join(list(r.columns)[:12])}"
                )
        t = no_smaller(np.asarray(r.t, dtype=float))
        least = LEAST_POINTS if s.kind == "static" else LEAST_SAMPLES
        if t.ndim != 1 or len(t) < least:
            raise StageError(f"{r.name}: {t.size} samples; at least {least} are needed")
        if not np.all(np.isfinite(t)) or np.any(np.diff(t) <= 0):
            raise StageError(f"{r.name}: time must rise from sample to sample")
        if beyond(t).any():
            raise StageError(f"{r.name}: time reaches {t[-1]:.3g} s; allowed: {LARGEST:g}")
        t, given, begin = self._driven(r, t)
        columns = {}
        for c, v in given.items():
            v = no_smaller(np.asarray(v, dtype=float))
            if (far := beyond(v) & np.isfinite(v)).any():
                raise StageError(f"{r.name}: channel {c!r} reaches {v[far][0]:.3g}; allowed: {LARGEST:g}")
            if v.shape != t.shape:
                raise StageError(f"{r.name}: channel {c!r} has shape {v.shape}; {t.shape} is needed, as the time has")
            if c in (*s.inputs, s.position, s.velocity):
                bad = ~np.isfinite(v)
                if bad.mean() > 0.2:
                    raise StageError(
                        f"{r.name}: channel {c!r}: {bad.sum()} of {len(v)} samples are NaN; an input may lack 20 % at "
                        f"most"
                    )
                if bad.any():
                    v = np.interp(t, t[~bad], v[~bad])
                    filled = f"{r.name}: {c}: {int(bad.sum())} NaN filled from their neighbours"
                    self.notes.append(Note(filled, "filled", c, bad.sum(), np.flatnonzero(bad)[:MOST_ROWS] + 1))
            columns[c] = v
        drives = [columns[c] for c in (*s.inputs, s.position, s.velocity) if c in columns]
        for c in s.outputs:
            if c in columns and (away := spikes(columns[c], drives)).any():
                k, n = int(np.argmax(away)), int(away.sum())
                said = "1 sample left out that jumps" if n == 1 else f"{n} samples left out that jump"
                said = f"{r.name}: {c}: {said} away and back, first {columns[c][k]:.4g} at {t[k]:.6g} s"
                self.notes.append(Note(said, "left out", c, n, np.flatnonzero(away)[:MOST_ROWS] + 1))
                columns[c] = np.where(away, np.nan, columns[c])
        return Record(r.name, t - t[0], columns, begin, r.notes, r.ordered)

    def _driven(self, r: Record, t: Array) -> tuple[Array, dict[str, Array], float]:
        """Times and channels of a log from where all that drives the model is known to where the first of it ends, and
        when that begins: before a driver's first sample nobody knows what drove the machine.
        """
        s, use = self.system, slice(0, len(t))
        for c in (*s.inputs, s.position, s.velocity):
            good: Array = (
                np.flatnonzero(np.isfinite(np.asarray(r.columns[c], dtype=float)))
                if c in r.columns
                else np.zeros(0, int)
            )
            if len(good):
                use = slice(max(use.start, int(good[0])), min(use.stop, int(good[-1]) + 1))
        lost = len(t) - (use.stop - use.start)
        if lost == 0 or use.stop - use.start < LEAST_SAMPLES:
            return t, dict(r.columns), r.begin
        said = f"{r.name}: {lost} samples at its ends, where what drives the model is not known, do not count"
        self.notes.append(Note(said, "cut", "time", lost))
        cut = {c: np.asarray(v)[use] if np.shape(v) == t.shape else v for c, v in r.columns.items()}
        return t[use], cut, r.begin + float(t[use.start] - t[0])

    def _prepare(self) -> None:
        s = self.system
        outs, ins = list(s.outputs), list(s.inputs)
        self.in_names = list(ins)
        if s.kind == "force":
            self._choose_cutoff()
            self.in_names = [*MOTION, *ins]
        self.u: list[Array] = []
        self.y: list[Array] = []
        for r in self.records:
            y = np.array([r.columns.get(o, np.full(len(r.t), np.nan)) for o in outs])
            u = [r.columns[c] for c in ins]
            if s.kind == "force":
                x, v, a = motion(s, r, self.motion_cutoff)
                u = [x, v, a, *u]
                if self.cutoff and self.motion_cutoff:  # as the model's: its motion, then the force that follows
                    y = np.array([low_pass(r.t, low_pass(r.t, row, self.motion_cutoff), self.cutoff) for row in y])
                    edge = EDGE_PERIODS / self.cutoff + SPLINE_MEMORY * float(np.median(np.diff(r.t)))
                    y[:, (r.t < edge) | (r.t > r.t[-1] - edge)] = np.nan
            self.u.append(np.ascontiguousarray(np.array(u, dtype=float).reshape(len(u), len(r.t))))
            self.y.append(y)
        gap = 0.0
        times = []
        for r in self.records:
            times.append(r.t + gap)
            gap = times[-1][-1] + float(np.median(np.diff(r.t)))
        self.t = np.concatenate(times)
        self.measured = np.concatenate(self.y, axis=1)

    def _choose_cutoff(self) -> None:
        """Up to which frequency the forces are compared, and the motion is differentiated."""
        s = self.system
        if s.velocity and not uses(s.model, "acceleration"):
            return
        if self.like is not None:
            self.cutoff, self.motion_cutoff = self.like.cutoff, self.like.motion_cutoff
            return
        self.cutoff = s.cutoff or highest_frequency(s.outputs, self.records)
        self.motion_cutoff = differentiated_to(s, self.records, self.cutoff)
        if s.cutoff is None:
            self.notes.append(f"forces compared up to {self.cutoff:.3g} Hz (cutoff= sets another)")

    def first_state(self, log: int, state: str, fallback: float, at: int = 0) -> float:
        """A state at the start of a log: given, measured, or else ``fallback``."""
        s = self.system
        if at == 0 and isinstance(begin := s.start.get(state), int | float):
            return float(begin)
        r = self.records[log]
        if state in s.outputs and state in r.columns:
            y = r.columns[state][at : at + 3]
            good = y[np.isfinite(y)]
            if len(good):
                return float(good[0])
        return fallback

    def begin(self, log: int, state: str) -> tuple[float, float]:
        """Where a state that is fitted may start, and how large it is: as measured, from its displacement, or of kind
        force in the middle of its way; 0 where the log does not tell.
        """
        s, r = self.system, self.records[log]
        if s.kind == "force":
            x = self.u[log][0]
            return -0.5 * float(x.max() + x.min()), 0.5 * float(np.ptp(x))
        if state in s.outputs and state in r.columns:
            return self.first_state(log, state, 0.0), float(np.nanstd(r.columns[state]))
        if s.rates.get(state, "") in r.columns:
            v = self._speed(log, state)
            return float(np.median(v[:3])), float(np.sqrt(np.mean(v**2)))
        return 0.0, 0.0

    def begins_in_motion(self, log: int, state: str) -> list[str]:
        """A note where a velocity that starts at rest was none."""
        s, r = self.system, self.records[log]
        if s.rates[state] not in r.columns:
            return []
        v = self._speed(log, state)
        first, size = float(np.median(v[:3])), float(np.sqrt(np.mean(v**2)))
        if not abs(first) > MOVES * size:
            return []
        return [
            f"{r.name}: {state} is about {first:.3g} {s.states[state]} at the start, where the model starts at rest; "
            f"start={{'{state}': 'fitted'}} fits it"
        ]

    def _speed(self, log: int, state: str) -> Array:
        """A velocity from its measured displacement, float64[samples]."""
        r = self.records[log]
        return np.asarray(np.gradient(smoothed(r.t, r.columns[self.system.rates[state]]), r.t))

    def restarts(self, log: int, n: int) -> tuple[Array, Array]:
        """At which of a log's first ``n`` samples a window starts anew, bool[n]; states there, float64[states, n]."""
        s = self.system
        if not self.window:
            if (n, 0.0) not in self._restart_cache:
                self._restart_cache[n, 0.0] = np.zeros(n, dtype=np.bool_), np.zeros((len(s.states), 1))
            return self._restart_cache[n, 0.0]
        if (log, self.window) not in self._restart_cache:
            r = self.records[log]
            w = (r.t / self.window + 1e-9).astype(int)
            first = np.diff(w, prepend=-1) > 0
            values = np.zeros((len(s.states), len(r.t)))
            moving = dict(s.rates)
            for i, name in enumerate(s.states):
                if name in r.columns:
                    values[i] = r.columns[name]
                elif name in moving and moving[name] in r.columns:
                    values[i] = np.gradient(smoothed(r.t, r.columns[moving[name]]), r.t)
                else:
                    raise StageError(
                        f"system {s.name!r}: window= needs state {name!r} measured at every start; the log has "
                        f"{', '.join(r.columns)} (name a channel like it, or declare it in rates= as the rate of a "
                        "measured one)"
                    )
            first &= np.all(np.isfinite(values), axis=0)
            self._restart_cache[log, self.window] = first, values
        first, values = self._restart_cache[log, self.window]
        return first[:n], np.ascontiguousarray(values[:, :n])

    def column(self, log: int, name: str) -> Array:
        """A quantity that is known before the model runs (`identification.user_models.exogenous_regressors`)."""
        if (log, name) not in self._columns:
            self._columns[log, name] = column_of(self.records[log], self.times[log], name)
        return self._columns[log, name]

    def held(self, log: int) -> float:
        """Measured force at the start of a log."""
        y = self.records[log].columns[next(iter(self.system.outputs))][:5]
        return float(np.median(y[np.isfinite(y)])) if np.isfinite(y).any() else 0.0

    def noise(self) -> Array:
        """RMS of the noise in every measured output, as far as its samples tell, and never quite zero."""
        out = []
        for name, y in zip(self.system.outputs, self.measured, strict=True):
            good = y[np.isfinite(y)]
            level = noise_of_channel(good)
            if (
                self.system.kind == "static"
                and (u := np.concatenate(self.u, axis=1)).size
                and (not self.ordered or without_order(u))
            ):
                level = noise_of_neighbours(u[:, np.isfinite(y)], good)
            if self.cutoff:  # what the low-pass leaves of the noise in the force as it was logged
                raw = [r.columns[name] for r in self.records]
                rate = 1.0 / float(np.median(np.diff(self.records[0].t)))
                level = max(noise_of_channel(v) for v in raw) * float(np.sqrt(min(2.0 * self.cutoff / rate, 1.0)))
            out.append(max(level, 1e-6 * float(np.std(good)) if len(good) else 0.0, 1e-300))
        return np.array(out)

    def regimes(self) -> tuple[dict[str, Array], dict[str, str]]:
        """Conditions under which the model may fail, and their units."""
        s = self.system
        out: dict[str, Array] = {"time": self.t} if self.ordered else {}
        units = {"time": "s"} if self.ordered else {}
        u = np.concatenate(self.u, axis=1) if self.u[0].size else np.zeros((0, len(self.t)))
        names = self.in_names
        unit = s.unit_of_position
        all_units = {**s.inputs, "position": unit, "velocity": f"{unit}/s", "acceleration": f"{unit}/s^2"}
        for i, n in enumerate(names):
            if n == "acceleration" and not np.any(u[i]):
                continue
            out[n], units[n] = u[i], all_units.get(n, "")
        if s.kind == "force":
            v = u[1]
            still = 0.01 * float(np.sqrt(np.mean(v**2)))
            out["direction"], units["direction"] = np.sign(np.where(np.abs(v) > still, v, 0.0)), ""
        for i, o in enumerate(s.outputs):
            y = self.measured[i]
            if o not in out and np.isfinite(y).any():
                out[o], units[o] = np.where(np.isfinite(y), y, np.nanmean(y)), s.outputs[o]
        if s.kind != "static":  # rows of a static model may be in any order
            out = {n: v if n == "time" else steady(v, CONDITION_BAND * noise_of_channel(v)) for n, v in out.items()}
        if len(self.records) > 1:
            out["log"] = np.concatenate([np.full(len(r.t), float(k + 1)) for k, r in enumerate(self.records)])
            units["log"] = ""
        return out, units


def noise_of_channel(y: Array) -> float:
    """RMS of the white noise that evenly sampled values can hold; 0 is possible.

    The smaller of two estimates, each held against what it makes of white noise: third differences over the quieter
    half of the stretches (motion is smooth), and the quietest tenth of the spectrum (white noise is everywhere).
    """
    y = y[np.isfinite(y)]
    if len(y) < 40:
        return 0.0
    return min(level / white for level, white in zip(_quiet(y), _of_white(len(y)), strict=True))


def without_order(u: Array) -> bool:
    """Whether rows of inputs float64[inputs, rows] stand in no order: each input changes from row to row as much as
    between any two rows (von Neumann's ratio, 2 for white noise, near 0 for a run).
    """
    varied = u[np.std(u, axis=1) > 0.0]
    steps = np.mean(np.diff(varied, axis=1) ** 2, axis=1)
    return bool(varied.size and np.all(steps > UNORDERED * np.var(varied, axis=1)))


def noise_of_neighbours(u: Array, y: Array) -> float:
    """RMS of the noise in ``y``, by the residuals of planes through each row and its neighbours in the space of the
    inputs ``u`` (float64[inputs, rows]): the order of the rows does not matter, and a smooth function passes through.
    """
    varied = u[np.std(u, axis=1) > 0.0]
    z = ((varied - varied.mean(axis=1, keepdims=True)) / varied.std(axis=1, keepdims=True)).T
    n, free = z.shape[1] + 1, PLANE_FREE
    if len(y) < 2 * (n + free):
        return 0.0
    some = np.unique(np.linspace(0, len(y) - 1, MOST_PLANES).astype(int))
    _, rows = scipy.spatial.cKDTree(z).query(z[some], n + free)
    planes = np.concatenate([np.ones((*rows.shape, 1)), z[rows]], axis=2)
    fitted = np.einsum("nij,njk,nk->ni", planes, np.linalg.pinv(planes), y[rows])
    left = np.sum((y[rows] - fitted) ** 2, axis=1)
    return float(np.sqrt(np.median(left) / scipy.stats.chi2.median(free)))


def _quiet(y: Array) -> tuple[float, float]:
    """Third differences where they are small, and the spectrum where it is."""
    d = np.diff(y, 3)
    width = max(10, len(d) // 60)
    parts = d[: len(d) // width * width].reshape(-1, width)
    level = np.sort(np.sqrt(np.mean(parts**2, axis=1) / 20.0))
    _, power = scipy.signal.welch(y, 1.0, nperseg=min(1024, len(y) // 4))
    return float(np.median(level[: max(1, len(level) // 2)])), float(np.sqrt(np.quantile(power[1:], 0.1) * 0.5))


@lru_cache(maxsize=64)
def _of_white(n: int) -> tuple[float, float]:
    rng = np.random.default_rng(0)
    draws = [_quiet(rng.standard_normal(n)) for _ in range(8)]
    return float(np.mean([d[0] for d in draws])), float(np.mean([d[1] for d in draws]))


# ---- Samples of a reading that jump away from their neighbours and back: a sensor or a logger that failed for a moment


def spikes(y: Array, drives: Sequence[Array] = ()) -> Array:
    """Which samples of a reading are spikes, bool[samples]; NaN is none.

    drives  what drives the model, float64[samples] each
    """
    at, out = np.flatnonzero(np.isfinite(y)), np.zeros(len(y), dtype=bool)
    v = y[at]
    if len(v) < 50:
        return out
    off = np.abs(v[1:-1] - 0.5 * (v[:-2] + v[2:]))
    steps = np.abs(np.diff(v))
    usual = max(float(np.quantile(off, 0.97)), float(steps[steps > 0.0].min(initial=np.inf)))
    found = np.zeros(len(v), dtype=bool)
    for run in range(LONGEST_SPIKE, 0, -1):
        n = len(v) - run - 3
        first, before, after, last = (v[k : k + n] for k in (0, 1, run + 2, run + 3))
        between = np.stack([v[k : k + n] for k in range(2, run + 2)]) - 0.5 * (before + after)
        least = np.abs(between).min(axis=0)
        away = (least > SPIKE_FAR * usual) & (np.all(between > 0.0, axis=0) | np.all(between < 0.0, axis=0))
        for one, other in ((before, after), (first, before), (after, last)):  # what swings does not stand still there
            away &= np.abs(one - other) < SPIKE_BACK * least
        for k in np.flatnonzero(away):
            found[k + 2 : k + 2 + run] = True
    about = np.convolve(found, np.ones(2 * LONGEST_SPIKE + 1), "same") > 0.5
    for u in drives:
        moved = np.abs(np.diff(u[at], prepend=u[at][0]))
        jumps = moved > INPUT_JUMP * np.median(moved)
        if about[jumps].sum() > SPIKE_ANSWERS * jumps.sum():  # so the machine answers to this input
            found &= np.convolve(jumps, np.ones(2 * LONGEST_SPIKE + 1), "same") < 0.5
    if found.mean() <= SPIKE_SHARE:
        out[at[found]] = True
    return out
