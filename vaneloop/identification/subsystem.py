"""What a model is to the search: stages with inputs, outputs, parameters, and effects that can be set free. Nothing
here knows vanes.

A stage is one part of the machine driven by its own *logged* inputs, so that one part's error does not hide in
another's, as it does in a closed loop. It is a function from parameters to outputs, nothing more; the search does the
rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from vaneloop.base.errors import InputError
from vaneloop.identification.settings import FLOOR_KNOWN, NOISE_KNOWN_TO

__all__ = [
    "Bound", "Effect", "Model", "Named", "Parameter", "Stage", "StageError", "lifted", "noise_of", "reach_of",
    "size_of", "without_jumps",
]  # fmt: skip

Array = np.ndarray
Named = Mapping[str, Mapping[str, Mapping[str, Any]]]  # effect -> parameter -> value, low, high, unit


class StageError(InputError):
    """A stage that cannot be used: one line naming the stage, the thing and what is allowed."""


@dataclass(frozen=True)
class Parameter:
    """One number of a stage or of an effect, in ``unit``.

    value      nominal value of a stage's parameter, neutral value of an effect's
    low, high  physical bounds
    tolerance  half-width of the plausible interval around a nominal value; 0: exactly known, never refitted. Of an
               effect's parameter: how well it is known beforehand; 0: not at all
    middle     of that interval, where it is not ``value``: a recalibrated model begins elsewhere in it
    output     the only output that it moves, if there is one: parameters of different outputs are then varied in one
               simulation
    log        the only log that it moves, as the stage's condition "log" counts them, if there is one; likewise
    scale      size of a usual change of it; 0: from its tolerance, its value or its effect's starts
    shape      of an effect's parameter: it says how the effect acts, not how much, and has no neutral value of its own
    period     after which it repeats itself, as an angle does: ``low`` and ``high`` are where one turn is cut, no
               bounds. 0: it does not
    """

    name: str
    value: float
    unit: str
    low: float = -np.inf
    high: float = np.inf
    tolerance: float = 0.0
    output: str | None = None
    scale: float = 0.0
    shape: bool = False
    period: float = 0.0
    log: int | None = None
    middle: float | None = None

    @property
    def expected(self) -> float:
        """What is expected beforehand: the middle of the tolerance."""
        return self.value if self.middle is None else self.middle

    def limits(self) -> tuple[float, float]:
        """Lowest and highest value of a fit: within the tolerance, where there is one, or at ``value`` beyond it."""
        if self.tolerance == 0.0:
            return self.value, self.value
        low, high = self.expected - self.tolerance, self.expected + self.tolerance
        return max(self.low, min(self.value, low)), min(self.high, max(self.value, high))

    def wrapped(self, value: float) -> float:
        """Return the same value within the turn that begins at ``low``; of a parameter without period, the value."""
        return value if self.period == 0.0 else value - self.period * float(np.floor((value - self.low) / self.period))


@dataclass(frozen=True)
class Effect:
    """A physical effect that may be missing.

    parameters  what it sets free; at their (neutral) values the effect is not there
    starts      parameter vectors from which a fit is tried; they span undetectable to gross, both signs where the sign
                is free
    excites     what a log needs to show it, in words
    holds       effects that it is at some values of its parameters: (name, a number for each parameter that is fixed,
                NaN where any will do, None for each that is the other's, in order)
    family      name of the effect that several places of the machine may have: of its members one stands in place of
                another, and where each place names its own of the same size, all have it; "": it is of one place
    onward      function from the parameters of the one that it holds to starts that do nearly the same, farther and
                farther from it; None: its own starts will do
    """

    name: str
    parameters: tuple[Parameter, ...]
    starts: tuple[tuple[float, ...], ...]
    excites: str = ""
    holds: tuple[tuple[str, tuple[float | None, ...]], ...] = ()
    onward: Callable[[Sequence[float]], list[tuple[float, ...]]] | None = None
    family: str = ""


@dataclass(eq=False)
class Stage:
    """One part of the machine on one log.

    run       function from parameter sets, float64[sets, parameters], to outputs, float64[sets, outputs, samples]. The
              columns are the stage's parameters, then each effect's in the order of ``effects`` (`index`)
    t         s, float64[samples]
    measured  float64[outputs, samples]; NaN where not measured
    window    s: within each window of this length the initial state is free, so one constant per output is taken off
              the error there; None for stages that do not integrate
    regimes   conditions on the same samples, for example rotor speed, direction of motion: where does it fail?
    raster_error  RMS of what the log's raster hides from each output, in its unit; None: nothing
    coarse    channels that the stage explains or is driven by whose reading is coarser than its sensor's, and what is
              to be said of it: no name rests on such a reading
    lost      draws of the error that the raster causes in each output, float64[draws, outputs, samples]: it need not
              be even; None: it is
    unlogged  what one standard deviation of each input that nobody logged does to each output, float64[inputs, outputs,
              samples]: of a stage with windows, in each of which it has a value of its own; None: there is none
    hidden    function from one parameter set to the RMS of what the raster hides from each output with these
              parameters: an effect may turn on what happens between two rows; None: no more than ``raster_error``
    floor     RMS of an output's error when nothing is missing, in its unit
    quiet     upper bounds on the RMS of the noise in each output that do not rest on this model, float64[outputs];
              None: there are none
    finer     ``run`` with a finer step of its own, for stages that have one: their difference is the numerical error
    noise     function from times and errors to the RMS of the noise in them; with it the floor is measured again once
              the best model is known, whose errors hold less of the machine's motion
    twins     effects that turn on time or on the oil's temperature: (the other of the two, ``run`` with it in place of
              theirs)
    alike     effects whose law is also that of something the library does not have: function from the parameters of all
              effects named, with their intervals, to what that is, "" where the sizes rule it out
    memory    s: longer than the stage remembers; blocks of the log that are judged apart are as long. None: not known
    begins    float64[sets, parameters] values from which a fit may begin beside the nominal ones, which a model without
              what it lacks may have lost its way to; None: there are none
    quick     a run costs next to nothing: slopes are taken at every start
    carries   slopes are carried along the steps of a fit (`identification.least_squares.levenberg_marquardt`)
    excerpt   function from ascending sample indices, in whole windows, to the same stage on these samples only: a long
              log is searched on an excerpt, and the answer confirmed on the whole; None: always searched whole
    counted   function from such indices to bool[samples]: which of them count in an excerpt of them, where not all do
    grain     log error that counts as much as 1 does far from the noise: less, where a known noise tells laws apart
    made      how and from what it was made, for who makes others like it
    """

    name: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    effects: tuple[Effect, ...]
    run: Callable[[Array], Array]
    t: Array
    measured: Array
    window: float | None = None
    regimes: Mapping[str, Array] = field(default_factory=dict)
    regime_units: Mapping[str, str] = field(default_factory=dict)
    raster_error: Array | None = None
    coarse: Mapping[str, str] = field(default_factory=dict)
    lost: Array | None = None
    unlogged: Array | None = None
    hidden: Callable[[Array], Array] | None = None
    floor: Array | None = None
    quiet: Array | None = None
    noise: Callable[[Array, Array], float] | None = None
    finer: Callable[[Array], Array] | None = None
    twins: Mapping[str, tuple[str, Callable[[Array], Array]]] = field(default_factory=dict)
    alike: Mapping[str, Callable[[Named], str]] = field(default_factory=dict)
    memory: float | None = None
    begins: Array | None = None
    quick: bool = False
    carries: bool = False
    excerpt: Callable[[Array], Stage] | None = None
    counted: Callable[[Array], Array] | None = None
    grain: float = 1.0
    made: object = None

    def __post_init__(self) -> None:
        """Check shapes and names."""
        m, n = len(self.outputs), len(self.t)
        self.measured = np.atleast_2d(np.asarray(self.measured, dtype=float))
        if self.measured.shape != (m, n):
            raise StageError(f"subsystem {self.name!r}: measured has shape {self.measured.shape}; ({m}, {n}) is needed")
        names = [p.name for p in self.parameters] + [e.name for e in self.effects]
        if len(set(names)) != len(names):
            raise StageError(
                f"subsystem {self.name!r}: two parameters or effects share a name among {', '.join(names)}"
            )
        for e in self.effects:
            for s in e.starts:
                if len(s) != len(e.parameters):
                    raise StageError(
                        f"subsystem {self.name!r}, effect {e.name!r}: a start has {len(s)} values; {len(e.parameters)} "
                        f"are needed"
                    )

    def all_parameters(self) -> tuple[Parameter, ...]:
        """Columns of ``run``'s argument."""
        return self.parameters + tuple(p for e in self.effects for p in e.parameters)

    def index(self) -> dict[str, slice]:
        """Columns of each effect, by name."""
        out, at = {}, len(self.parameters)
        for e in self.effects:
            out[e.name] = slice(at, at + len(e.parameters))
            at += len(e.parameters)
        return out

    def neutral(self) -> Array:
        """Nominal parameters, every effect absent: float64[parameters]."""
        return np.array([p.value for p in self.all_parameters()], dtype=float)

    def expected(self) -> Array:
        """What is expected of every parameter beforehand, the middle of its prior: float64[parameters]."""
        return np.array([p.expected for p in self.all_parameters()], dtype=float)

    def effect(self, name: str) -> Effect:
        """Return the effect of that name, or of that family the first; an effect of both actuators stands before that
        of either.
        """
        return next(e for e in self.effects if name in (e.name, e.family))


class Bound(Protocol):
    """A model held against logs: what the search looks at, whatever machine it is of.

    stages        each driven by its own logged inputs
    not_observed  stage -> what the logs lack for it
    notes         what the user should know
    """

    stages: list[Stage]
    not_observed: dict[str, str]
    notes: list[str]


class Model(Protocol):
    """What can be held against logs: the vane machine, a user's own system."""

    def bind(self, logs: Any) -> Bound:
        """Hold it against logs. Raises StageError or InputError, in one line, for logs that it cannot be held to."""


def reach_of(stage: Stage, floor: Array, theta: Array) -> Array:
    """How close a model can come to each output: ``floor``, and what the effects in ``theta`` make more of what happens
    between two rows than the nominal model does, which the floor holds already.
    """
    neutral = stage.neutral()
    if stage.hidden is None or np.array_equal(theta[len(stage.parameters) :], neutral[len(stage.parameters) :]):
        return floor
    more = stage.hidden(theta) ** 2 - stage.hidden(neutral) ** 2
    return lifted(floor, np.sqrt(np.maximum(more, 0.0)))


def lifted(floor: Array, error: Array | float) -> Array:
    """A noise floor with another independent error, where that lifts it by more than it is known to."""
    both = np.hypot(floor, error)
    return np.where(both > (1.0 + FLOOR_KNOWN) * floor, both, floor)


def without_jumps(stage: Stage, error: Array) -> Array:
    """An output's error with the jumps closed that windows of a free constant make: the model starts anew in each."""
    if not stage.window:
        return error
    w = ((stage.t - stage.t[0]) / stage.window + 1e-9).astype(int)
    first = np.flatnonzero(np.diff(w, prepend=-1))[1:]
    step = np.zeros(len(error))
    step[first] = error[first] - error[first - 1]
    if len(error) > 2:  # keep what the neighbours say the step would have been without a jump
        step[first] -= 0.5 * (
            error[first - 1] - error[first - 2] + error[np.minimum(first + 1, len(error) - 1)] - error[first]
        )
    return np.asarray(error - np.cumsum(np.where(np.isfinite(step), step, 0.0)))


def size_of(*tries: float) -> float:
    """The first size that says anything: finite, and not 0; 1 in its unit where none does, as of a channel that is 0
    all along.
    """
    return next((abs(float(v)) for v in tries if np.isfinite(v) and v != 0.0), 1.0)


def noise_of(stage: Stage, theta: Array) -> Array:
    """Noise floor of every output: the noise in the error with parameters ``theta``, and what the raster hides.

    The error of a model that lacks much moves, and motion can pass for noise: where ``stage.quiet`` is clearly less,
    that is the noise. Where windows have a free constant the model may jump from one to the next; the jumps are closed
    first, so that they are not noise.
    """
    assert stage.noise is not None
    out = []
    for error in stage.measured - stage.run(theta[None])[0]:
        error = without_jumps(stage, error)
        out.append(stage.noise(stage.t, error))
    noise = np.array(out)
    if stage.quiet is not None:
        noise = np.where(stage.quiet < (1.0 - NOISE_KNOWN_TO) * noise, stage.quiet, noise)
    return noise if stage.raster_error is None else np.hypot(noise, stage.raster_error)
