"""A system held against logs: its unknown parameters fitted, laws placed where they may act, all as one `Stage`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy

from plant.model import Learned
from vaneloop.identification.candidates import laws
from vaneloop.identification.settings import (
    FACTOR,
    FITS_FROM,
    GIVEN,
    LEAST_QUANTUM,
    LEAST_WINDOW,
    MOST_DRAWN,
    MOST_SAMPLES,
    MOST_SHRUNK,
    QUANTUM_FINER,
    QUANTUM_FREQUENCIES,
    QUANTUM_MOST_FINER,
    QUANTUM_PEAKS,
    QUANTUM_SAMPLES,
    SLIGHT,
    START_DRAWS,
    START_FORGOTTEN,
    START_STEP,
    START_STEPS,
    START_WINDOWS,
    START_WITHIN,
    WIDE,
)
from vaneloop.identification.subsystem import Array, Effect, Parameter, Stage, StageError, size_of
from vaneloop.identification.user_models.data import Data, noise_of_channel
from vaneloop.identification.user_models.injection_points import Course, from_file, nominal_course, places
from vaneloop.identification.user_models.simulation import Placed, Runner
from vaneloop.identification.user_models.system import Record, System

__all__ = ["BoundSystem", "rms_of_rows", "steps_seen"]


def rms_of_rows(error: Array) -> Array:
    """RMS of each row of an error; NaN of one without a sample."""
    n = np.isfinite(error).sum(axis=1)
    return np.where(n > 0, np.sqrt(np.nansum(error**2, axis=1) / np.maximum(n, 1)), np.nan)


class BoundSystem:
    """A system held against logs: the `Stage`, and which samples belong to which log.

    like      take sizes, fitted parameters and cut-off from an earlier one (for test logs)
    values    parameters fitted before, by name
    present   laws that the model has by now, effect name -> parameters; they are part of it and not looked for again
    curves    laws that were learned, effect name -> what its file says

    stage     the model on all samples; the logs follow each other in time
    thinned   the same on fewer samples, where there are many; ``stages``: it, which is what the search works on
    others    values of the parameters in other valleys of the error than the best
    read_starts  states that start at their sensors' readings are fitted within the sensors' noise: the system forgets
              them slowly
    floor     RMS of each output's error where nothing is missing: its noise, and what noise in starts that are not
              fitted and in measured motion does to the model
    data      the logs as they were checked; ``t``, ``u``, ``measured`` are its
    runner    the model on them; ``run`` is its
    effects, placed   every law at every place: what the search is told of it, and what runs
    logs      name -> slice of samples
    notes     what the user should know
    """

    def __init__(
        self,
        system: System,
        records: Sequence[Record],
        like: BoundSystem | None = None,
        values: Mapping[str, float] | None = None,
        present: Mapping[str, Mapping[str, float]] | None = None,
        curves: Mapping[str, Learned] | None = None,
    ):
        self.system, self.like = system, like
        self.curves: Mapping[str, Learned] = (curves or {}) if like is None else like.curves
        self.values: dict[str, float] = dict(values or {}) if like is None else like.values
        self.present: dict[str, dict[str, float]]
        self.present = {k: dict(v) for k, v in (present or {}).items()} if like is None else like.present
        self.data: Data = Data(system, records, like.data if like else None)
        self.logs, self.notes = self.data.logs, self.data.notes
        self.t, self.u, self.measured = self.data.t, self.data.u, self.data.measured
        self.runner: Runner = Runner(self.data, like.runner if like else None)
        self.run = self.runner.run
        self.effects: list[Effect]
        self.placed: list[Placed]
        self.stage: Stage
        self.others: list[Array] = []  # values of the parameters in other valleys of the error
        self.starts: list[Parameter] = []  # initial states to fit, and the size of each as far as the logs tell it
        self.start_sizes: list[float] = []
        self.read_starts = False
        self._make()

    def _leave_out(self) -> None:
        """Take out the laws that the system is not to be given."""
        names = [e.name for e in self.effects]
        for name in self.system.without:
            if name not in names:
                raise StageError(
                    f"without {name!r}: not a law that system {self.system.name!r} can have; it has {', '.join(names)}"
                )
        keep = [k for k, name in enumerate(names) if name not in self.system.without]
        self.placed = [self.placed[k] for k in keep]
        self.effects = [  # none is said to hold a law within it that is not there
            replace(self.effects[k], holds=tuple(h for h in self.effects[k].holds if h[0] not in self.system.without))
            for k in keep
        ]

    def _make(self) -> None:
        """Fit what is unknown, place the laws, and make the stage."""
        s = self.system
        if self.like is not None:
            self.effects, self.placed = self.like.effects, self.like.placed
        starts = self.starts = self._starts() if s.kind != "static" else []
        if self.like is None:
            known = [p.name for p in s.parameters]
            for name in self.values:
                if name not in known and not name.startswith("start_"):
                    raise StageError(
                        f"model file: parameter {name!r} is not one of system {s.name!r}; allowed: {', '.join(known)}"
                    )
            first = [
                Parameter(p.name, float(np.clip(self.values[p.name], p.low, p.high)), p.unit, p.low, p.high, 0.0)
                if p.name in self.values
                else p
                for p in (*s.parameters, *starts)
            ]
            if s.kind in ("simulate", "closed_loop"):
                self.run(np.array([[p.value for p in first]]))
            self.runner.ready = True
            fitted = self._prefit(first)
            course = Course()
            if s.kind in ("simulate", "closed_loop"):
                course = nominal_course(self.runner, fitted)
                self.runner.smalls = course.smalls
            self.placed, self.effects = places(self.data, course, self.runner.dispatch)
            self._leave_out()
            for name, curve in self.curves.items():
                one, effect = from_file(name, curve, self.data)
                self.placed.append(one)
                self.effects.append(effect)
            sizes = self._felt([*s.parameters, *starts], fitted)
            parameters = [self._fixed(*pvs) for pvs in zip([*s.parameters, *starts], fitted, sizes, strict=True)]
            if self._starts_matter(fitted):
                parameters += self._read_starts()
        else:
            mine = self.like.stage.parameters[: len(s.parameters)]
            parameters = [*mine, *starts, *(self._read_starts() if self.like.read_starts else [])]
        at = len(parameters)
        placed = []
        for name in self.present:
            if all(e.name != name for e in self.effects):
                raise StageError(
                    f"model file: effect {name!r} is not one that system {s.name!r} can have; "
                    f"it has {', '.join(e.name for e in self.effects)}"
                )
        both = list(zip(self.placed, self.effects, strict=True))
        both = [b for b in both if b[1].name in self.present] + [b for b in both if b[1].name not in self.present]
        self.placed, self.effects = [b[0] for b in both], [b[1] for b in both]
        searched = []
        for q, e in both:
            if e.name in self.present:
                for j, w in enumerate(e.parameters):
                    v = self.present[e.name].get(w.name, w.value if w.shape else None)
                    if v is None or not np.isfinite(v):
                        raise StageError(f"model file: effect {e.name!r} needs a number for {w.name}")
                    v = float(np.clip(v, w.low, w.high))
                    size = size_of(w.scale, v, max((abs(start[j]) for start in e.starts), default=0.0))
                    parameters.append(
                        Parameter(f"{e.name}.{w.name}", v, w.unit, w.low, w.high, WIDE * size, scale=0.1 * size)
                    )
            else:
                searched.append(e)
            placed.append(replace(q, columns=slice(at, at + len(e.parameters))))
            at += len(e.parameters)
        self.placed = self.runner.placed = placed
        if self.like is None:
            searched = self._with_steps(searched, parameters)
            self.effects = [next((e for e in searched if e.name == old.name), old) for old in self.effects]
        regimes, units = self.data.regimes()
        self.stage = Stage(
            s.name, tuple(s.outputs), tuple(s.outputs.values()), tuple(parameters), tuple(searched), self.run, self.t,
            self.measured,
            regimes=regimes, regime_units=units,
        )  # fmt: skip
        if self.like is None:
            unknowns = len(s.parameters) + len(starts)
            given = self.stage.neutral()
            given[:unknowns] = [p.value for p in (*s.parameters, *starts)]
            self._scan_starts(given, list(range(len(s.parameters), unknowns)))
            begins = np.repeat(given[None], 1 + len(self.others), axis=0)
            for begin, other in zip(begins[1:], self.others, strict=True):
                begin[:unknowns] = other
            self.stage.begins = None if self.values else begins  # a model file's values are better than these
            self.floor: Array = np.hypot(self.data.noise(), self._carried(self.stage.neutral()))
            self.stage.floor = self.floor
        # the search looks at fewer samples where there are many: neighbours say the same
        stride = max(1, len(self.t) // MOST_SAMPLES)
        self.thinned = Stage(
            s.name, self.stage.outputs, self.stage.units, self.stage.parameters, self.stage.effects,
            lambda thetas: self.run(thetas, stride), self.t[::stride], self.measured[:, ::stride],
            regimes={k: v[::stride] for k, v in regimes.items()}, regime_units=units, floor=self.stage.floor,
            begins=self.stage.begins, quick=s.kind in ("static", "force"),
        )  # fmt: skip

        self.stages: list[Stage] = [self.thinned]
        self.not_observed: dict[str, str] = {}

    def _with_steps(self, effects: list[Effect], parameters: Sequence[Parameter]) -> list[Effect]:
        """Effects, those that round an output with the steps to begin from that its values tell."""
        at = {q.effect: q.at for q in self.placed if q.place == "output" and q.law.code == laws.QUANTISATION}
        if not any(e.name in at for e in effects):
            return effects
        neutral = np.array([p.value for p in (*parameters, *(p for e in effects for p in e.parameters))])
        model, noise = self.run(neutral[None])[0], self.data.noise()
        out = []
        for e in effects:
            if e.name in at:
                k, (step,) = at[e.name], e.parameters
                seen = [s for s in steps_seen(self.measured[k], model[k], noise[k]) if s < step.high]
                e = replace(e, starts=tuple((s,) for s in sorted({*seen, *(v for (v,) in e.starts)})))
            out.append(e)
        return out

    def _carried(self, theta: Array) -> Array:
        """RMS of the error that noise in what the model starts from, and in measured motion, causes in each output: the
        model on the logs with as much noise again, less the model on the logs.

        Inputs are taken as they are: what is quick in them may be what drives the machine.
        """
        rng = np.random.default_rng(0)
        noisy = {*self.system.outputs, self.system.position, self.system.velocity} - {*self.system.inputs}
        out = []
        for _ in range(START_DRAWS):
            again = []
            for r in self.data.records:
                noise = {name: noise_of_channel(v) * rng.standard_normal(len(v)) for name, v in r.columns.items()}
                again.append(
                    Record(r.name, r.t, {k: v + noise[k] if k in noisy else v for k, v in r.columns.items()}, r.begin)
                )
            data = Data(self.system, again, self.data)
            runner = Runner(data, self.runner)
            runner.placed, runner.free_starts = self.placed, self.runner.free_starts
            moved = runner.run(theta[None])[0] - self.run(theta[None])[0]
            out.append(np.sqrt(np.nanmean(np.where(np.isfinite(self.measured), moved, np.nan) ** 2, axis=1)))
        if self.system.kind in ("simulate", "closed_loop"):
            return np.asarray(np.min(out, axis=0))  # a machine that may tip over does so in some draws
        return np.asarray(np.sqrt(np.mean(np.square(out), axis=0)))

    def theta_from(self, other: BoundSystem, theta: Array) -> Array:
        """Parameters of another log's stage as this one's: initial states that no log tells are fitted to this log."""
        n_p = len(self.system.parameters)
        out = np.concatenate(
            [
                theta[:n_p],
                [p.value for p in self.stage.parameters[n_p : n_p + len(self.runner.free_starts)]],
                theta[n_p + len(other.runner.free_starts) :],
            ]
        )
        k = len(self.runner.free_starts)
        if not k:
            return out
        use = np.isfinite(self.measured)
        starts = self.stage.parameters[n_p : n_p + k]
        size = np.array([p.tolerance if np.isfinite(p.tolerance) else self._unit_size(p) for p in starts])
        low = np.array([p.value - p.tolerance for p in starts]) / size
        high = np.array([p.value + p.tolerance for p in starts]) / size

        def error(z: Array) -> Array:
            trial = out.copy()
            trial[n_p : n_p + k] = z * size
            return np.where(use, self.run(trial[None])[0] - np.where(use, self.measured, 0.0), 0.0).ravel()

        self._scan_starts(out, [n_p + i for i, p in enumerate(starts) if np.isinf(p.tolerance)])
        first = out[n_p : n_p + k] / size
        out[n_p : n_p + k] = (
            scipy.optimize.least_squares(error, first, bounds=(low, high), diff_step=1e-3, max_nfev=30).x * size
        )
        return out

    def errors(self, theta: Array) -> dict[str, Array]:
        """Error of every sample of each output, log by log; NaN where nothing was measured."""
        e = self.run(theta[None])[0] - self.measured
        return {name: e[:, at] for name, at in self.logs.items()}

    def _starts(self) -> list[Parameter]:
        """Initial states that no log tells, or that the user wants fitted, as parameters to fit."""
        s = self.system
        out: list[Parameter] = []
        if s.window:
            return out
        states = s.states
        if s.kind == "force":
            states = {} if s.position else {"position": s.unit_of_position}
        for log in range(len(self.data.records)):
            for m, (name, unit) in enumerate(states.items()):
                if s.start.get(name) != "fitted":
                    if name in s.start or (name in s.outputs and name in self.data.records[log].columns):
                        continue
                    if name in s.rates:
                        if not self.like:
                            self.notes += self.data.begins_in_motion(log, name)
                        continue  # machines start at rest
                self.runner.free_starts.append((log, m))
                suffix = f"_{log + 1}" if len(self.data.records) > 1 else ""
                guess, size = self.data.begin(log, name)
                self.start_sizes.append(size)
                out.append(Parameter(f"start_{name}{suffix}", guess, unit, -np.inf, np.inf, np.inf))
        return out

    def _read(self) -> list[tuple[int, int, str]]:
        """Log, state and its name of each state that starts a log at its sensor's reading."""
        s = self.system
        if s.window or s.kind not in ("simulate", "closed_loop"):
            return []
        return [
            (log, m, name) for log in range(len(self.data.records)) for m, name in enumerate(s.states)
            if name in s.outputs and name not in s.start and np.isfinite(self.data.first_state(log, name, np.nan))
        ]  # fmt: skip

    def _starts_matter(self, values: Array) -> bool:
        """Whether noise in the readings that states start at does more to an output than `START_FORGOTTEN` of its
        noise.
        """
        noise, runner = self.data.noise(), self.runner
        names, n_p = list(self.system.outputs), len(self.system.parameters)
        known, read = len(runner.free_starts), self._read()
        sets = [np.concatenate([values, [self.data.first_state(log, name, 0.0) for log, _, name in read]])]
        for state in dict.fromkeys(name for _, _, name in read):
            step = [START_STEP * noise[names.index(name)] * (name == state) for _, _, name in read]
            sets.append(sets[0] + np.concatenate([np.zeros(n_p + known), step]))
        if len(sets) == 1:
            return False
        runner.free_starts += [(log, m) for log, m, _ in read]
        out = self.run(np.array(sets))
        del runner.free_starts[known:]
        moved = np.sqrt(np.mean(np.sum((out[1:] - out[0]) ** 2, axis=0), axis=1)) / START_STEP
        return bool(np.any(moved > START_FORGOTTEN * noise))

    def _read_starts(self) -> list[Parameter]:
        """States that start a log at their sensors' readings, as parameters known to within the sensors' noise."""
        self.read_starts = True
        out = []
        noise = self.data.noise() if self.like is None else self.like.data.noise()
        for log, m, name in self._read():
            self.runner.free_starts.append((log, m))
            suffix = f"_{log + 1}" if len(self.data.records) > 1 else ""
            value, wide = (
                self.data.first_state(log, name, 0.0),
                START_WITHIN * noise[list(self.system.outputs).index(name)],
            )
            unit = self.system.states[name]
            out.append(Parameter(f"start_{name}{suffix}", value, unit, tolerance=float(wide), log=log + 1))
        return out

    def _prefit(self, parameters: Sequence[Parameter]) -> Array:
        """Values of the unknown parameters that suit the logs best while nothing is added."""
        values = np.array([p.value for p in parameters], dtype=float)
        free = [i for i, p in enumerate(parameters) if np.isinf(p.tolerance)]
        scale = np.nanstd(self.measured, axis=1)
        scale = np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)
        size = np.array([self._first_size(parameters[i]) for i in free])
        low, high = (np.array([getattr(parameters[i], side) for i in free]) / size for side in ("low", "high"))
        given = np.clip(values[free] / size, low, high)
        moves = self.system.kind in ("simulate", "closed_loop")
        out = self.run(values[None])[0]
        stays = bool(np.all(np.abs(out) < self.runner.far))
        drawn: list[Array] = []
        if stays and moves:
            self._choose_steps(values)
        if free:
            self._scan_starts(values, [i for i in free if parameters[i].name.startswith("start_")])
            given = np.clip(values[free] / size, low, high)
            drawn = self._drawn(values, free, size, given, low, high, scale)
        if not stays and not drawn:
            k = np.unravel_index(int(np.argmax(~(np.abs(out) < self.runner.far))), out.shape)
            raise StageError(
                f"system {self.system.name!r}: the model leaves all bounds or turns NaN for "
                f"{list(self.system.outputs)[k[0]]} at t = {self.t[k[1]]:g} s with its first parameters; other values "
                f"of {', '.join(p.name for p in parameters) or 'the model'} are needed, or a window="
            )
        if not free:
            return values
        use = np.isfinite(self.measured)
        measured = np.where(use, self.measured, 0.0)
        stride = max(1, self.measured.shape[1] // 20000)

        def error(z: Array) -> Array:
            trial = values.copy()
            trial[free] = z * size
            e = (self.run(trial[None])[0] - measured) / scale[:, None]
            return np.where(use, e, 0.0)[:, ::stride].ravel()

        if moves and not stays:
            self._choose_steps(self._with(values, free, drawn[0] * size))
        begins = [given, *drawn] if stays else drawn
        begins += self._in_windows(error, begins, low, high)
        fits = [scipy.optimize.least_squares(error, b, bounds=(low, high), diff_step=1e-4, max_nfev=20) for b in begins]
        fits.sort(key=lambda f: f.cost)
        again = [
            scipy.optimize.least_squares(error, f.x, bounds=(low, high), diff_step=1e-4, max_nfev=60) for f in fits[:2]
        ]
        best = min(again, key=lambda f: f.cost)
        self.others = []
        for f in fits:  # other valleys
            if all(np.max(np.abs(f.x - o)) > 0.1 * np.max(np.abs(o)) for o in (best.x, *self.others)):
                self.others.append(f.x)
        self.others = [self._with(values, free, x * size) for x in self.others[:2]]
        values[free] = best.x * size
        if self.system.kind in ("simulate", "closed_loop"):
            self._choose_steps(values)
        return values

    def _in_windows(self, error: Callable[[Array], Array], begins: list[Array], low: Array, high: Array) -> list[Array]:
        """Values that suit short windows, each begun from the measured states; nothing where these are not measured.

        A free run from wrong values loses its phase, and its error many valleys; a short one does neither.
        """
        s, data = self.system, self.data
        measured = all(n in s.outputs or (n in s.rates and s.rates[n] in s.outputs) for n in s.states)
        if s.window or s.kind != "simulate" or not s.rates or not measured:
            return []
        data.window = max(
            data.records[0].t[-1] / START_WINDOWS, LEAST_WINDOW * float(np.median(np.diff(data.records[0].t)))
        )
        first = min(begins, key=lambda z: float(np.sum(error(z) ** 2)))
        best = scipy.optimize.least_squares(error, first, bounds=(low, high), diff_step=1e-4, max_nfev=20).x
        data.window = None
        return [best]

    def _with(self, values: Array, columns: list[int], new: Array) -> Array:
        out = values.copy()
        out[columns] = new
        return out

    def _drawn(
        self, values: Array, free: list[int], size: Array, first: Array, low: Array, high: Array, scale: Array
    ) -> list[Array]:
        """Values (in sizes) from which a fit may begin beside the user's own: of many drawn within `FACTOR`, those that
        come nearest to the logs, as they are or but for a gain and an offset of each output; none that leaves all
        bounds.
        """
        power = min(4 + len(free), MOST_DRAWN)
        unit, drawn = scipy.stats.qmc.Sobol(len(free), seed=0).random_base2(power), 2**power
        z = np.clip(np.where(first == 0.0, 2.0 * unit - 1.0, first * FACTOR ** (2.0 * unit - 1.0)), low, high)
        thetas = np.repeat(values[None], drawn, axis=0)
        thetas[:, free] = z * size
        use = np.isfinite(self.measured)
        weight = use / np.maximum(use.sum(axis=1), 1)[:, None]
        y = np.where(use, self.measured, 0.0) / scale[:, None]
        plain, bent = np.empty(drawn), np.empty(drawn)
        for i in range(0, drawn, 32):
            m = self.run(thetas[i : i + 32])
            inside = np.all(np.abs(m) < self.runner.far, axis=(1, 2))
            m = m / scale[:, None]
            plain[i : i + 32] = np.where(inside, np.sum(weight * (m - y) ** 2, axis=(1, 2)), np.inf)
            my, mm = np.sum(weight * y, axis=1), np.sum(weight * m, axis=2)
            var = np.sum(weight * (m - mm[:, :, None]) ** 2, axis=2)
            both = np.sum(weight * (m - mm[:, :, None]) * (y - my[:, None]), axis=2)
            total = np.sum(weight * (y - my[:, None]) ** 2, axis=1)
            bent[i : i + 32] = np.where(inside, np.sum(total - both**2 / np.maximum(var, 1e-12), axis=1), np.inf)
        best = [*np.argsort(plain)[: FITS_FROM // 2], *np.argsort(bent)[: FITS_FROM // 2]]
        return [z[i] for i in dict.fromkeys(int(i) for i in best) if np.isfinite(plain[i])]

    def _scan_starts(self, theta: Array, columns: list[int]) -> None:
        """Set unknown initial states in place to the best of some round sizes of the outputs, one after the other."""
        good = self.measured[np.isfinite(self.measured)]
        size = float(np.max(np.abs(good))) if len(good) else 1.0
        for c in columns:
            trials = np.repeat(theta[None], 11, axis=0)
            own = self.start_sizes[c - len(self.system.parameters)] or size
            trials[:, c] += own * np.array([0.0, 0.1, 0.25, 0.5, 1.0, 2.0, -0.1, -0.25, -0.5, -1.0, -2.0])
            e = np.where(np.isfinite(self.measured), self.run(trials) - np.nan_to_num(self.measured), 0.0)
            theta[c] = trials[int(np.argmin(np.sum(e**2, axis=(1, 2)))), c]

    def _first_size(self, p: Parameter) -> float:
        """Size by which a parameter's first value is varied; a start may lie anywhere near."""
        size = abs(p.value)
        if p.name.startswith("start_"):
            return max(size, self._unit_size(p))
        return size or self._unit_size(p)

    def _unit_size(self, p: Parameter) -> float:
        if p.name.startswith("start_"):
            names = [q.name for q in self.starts]
            if p.name in names and (own := self.start_sizes[names.index(p.name)]):
                return own
            y = self.measured[np.isfinite(self.measured)]
            return float(np.std(y)) or 1.0
        return min((abs(v) for v in (p.low, p.high) if np.isfinite(v) and v != 0.0), default=1.0)

    def _choose_steps(self, values: Array) -> None:
        """Steps of the integration between two samples: doubled until the outputs no longer change by more than 1e-3 of
        their spread.
        """
        scale = np.nanstd(self.measured, axis=1)
        scale = np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)
        before = self.run(values[None])[0]
        while self.runner.steps < START_STEPS:
            self.runner.steps *= 2
            after = self.run(values[None])[0]
            change = float(np.max(np.sqrt(np.mean((after - before) ** 2, axis=1)) / scale))
            before = after
            if change < 1e-3:
                self.runner.steps //= 2
                break

    def _felt(self, parameters: Sequence[Parameter], values: Array) -> list[float]:
        """Of each unknown parameter for which the user gave 0, which says nothing of its size: what moves an output by
        as much as it varies; 0 for the others.
        """
        zero = [i for i, p in enumerate(parameters) if p.value == 0.0 and not np.isfinite(p.tolerance)]
        out = [0.0] * len(parameters)
        if not zero:
            return out
        y, spread = self.run(values[None])[0], np.nanstd(self.measured, axis=1)
        for i in zero:
            step = 1e-3 * max(abs(values[i]), 1e-3 * self._unit_size(parameters[i]))
            for _ in range(MOST_SHRUNK):  # a unit may be far larger than a usual size: slopes are of small steps
                theta = values.copy()
                theta[i] += step
                moved = np.sqrt(np.mean((self.run(theta[None])[0] - y) ** 2, axis=1))
                most = float(np.nanmax(moved / np.where(spread > 0.0, spread, 1.0)))
                if np.isfinite(most) and most <= SLIGHT:
                    out[i] = step / most if most > 0.0 else 0.0
                    break
                step *= 1e-2
        return out

    def _fixed(self, p: Parameter, value: float, felt: float) -> Parameter:
        """An unknown parameter, once fitted, may move by a few of its own sizes, or by what is ``felt`` (`_felt`)."""
        if np.isfinite(p.tolerance):
            return p
        size = size_of(max(abs(value), abs(p.value), felt), 1e-3 * self._unit_size(p))
        if p.name.startswith("start_"):
            size = max(size, self._unit_size(p))
        wide = max(WIDE * size, GIVEN * abs(p.value))
        return Parameter(p.name, float(value), p.unit, p.low, p.high, wide, scale=WIDE * max(abs(value), 0.1 * size))


# ---- Which steps a sensor may round to, as its values and the nominal model's errors tell: a fit sees no slope there


def steps_seen(measured: Array, model: Array, noise: float) -> list[float]:
    """Steps to begin from, ascending; empty where there is nothing to look at.

    measured, model  values of the output, and what the nominal model makes of it, float64[samples]
    noise            RMS of the noise in the values
    """
    good = np.isfinite(measured) & np.isfinite(model)
    y, m = measured[good], model[good]
    if len(y) < 2:
        return []
    span = float(np.ptp(m))
    least = max(LEAST_QUANTUM * noise, 4.0 * span / QUANTUM_FREQUENCIES)
    if not span > 2.0 * least:
        return []
    f = np.arange(2.0 / span, 1.0 / least, 0.25 / span)
    stride = max(1, len(y) // QUANTUM_SAMPLES)
    y, m = y[::stride], m[::stride]
    error = y - m - np.mean(y - m)
    with_error = _sums(f, m - m[0], error)
    of_values = _sums(f, y - y[0], np.full(len(y), 1.0 / len(y)))
    out: set[float] = set()
    finer = 1.0 / (QUANTUM_FINER * max(float(np.max(np.abs(m))), span))
    for height in (with_error, of_values):
        inner = height[1:-1]
        peaks = 1 + np.flatnonzero((inner >= height[:-2]) & (inner > height[2:]))
        for k in peaks[np.argsort(-height[peaks], kind="stable")][:QUANTUM_PEAKS]:
            many = min(int(0.25 / span / finer) + 1, QUANTUM_MOST_FINER // 2)
            sizes = 1.0 / (f[k] + finer * np.arange(-many, many + 1))
            left = [float(np.sum((y - np.round(m / s) * s) ** 2)) for s in sizes]
            best = f[k] + finer * (int(np.argmin(left)) - many)
            out |= {float(1.0 / (best + near * finer)) for near in (-1.0, 0.0, 1.0)}
    return sorted(out)


def _sums(f: Array, x: Array, weights: Array) -> Array:
    """Magnitude of the sum of weights times exp(2 pi i f x), at evenly spaced frequencies ``f``."""
    many = min(len(f), 256)
    turned = np.exp(2j * np.pi * (f[:many, None] - f[0]) * x)  # from the first frequency of a block to each of it
    parts = [np.abs(turned @ (weights * np.exp(2j * np.pi * f[i] * x))) for i in range(0, len(f), many)]
    return np.concatenate(parts)[: len(f)]
