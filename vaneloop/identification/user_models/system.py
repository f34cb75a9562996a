"""A user's own model: which channels it explains, how, and where laws may act. `BoundSystem` turns it,
with logs, into a `Stage`.

kind         the model is                                  scored
-----------  --------------------------------------------  -------------------------------------------------------
static       y = model(u, p)                               at every sample
force        force = model(u, p) from measured motion      at every sample (inverse dynamics); u has position,
                                                           velocity, acceleration
simulate     dx/dt = model(x, u, p)                        free run from the start, or in windows restarted from
                                                           measured states
closed_loop  dx/dt = model(x, u, p), u = control(r, y, p)  free run with the loop closed

docs/your_own_model.md says which to choose when.

A user's own law is declared beside the model in the same file, and from there on like one of the library:

| on     | function      | with memory          | gives                                                                |
|--------|---------------|----------------------|----------------------------------------------------------------------|
| signal | f(u, t, p)    | f(u, t, dt, p, m)    | what an input or output ``u`` becomes                                |
| force  | f(v, x, t, p) | f(v, x, t, dt, p, m) | force at velocity v, displacement x; positive opposes motion         |
| state  | f(x, t, p)    | f(x, t, dt, p, m)    | what is taken off the derivative of the state ``x``                  |

``t``: s, the log's own time; ``p``: the sizes, by name (``p.slope``); ``m``: float64[memory], zeros at the first sample
of a log, changed in place; ``dt``: s since the sample (in a simulation: the step) before, 0 at the first.
"""

from __future__ import annotations

import inspect
import keyword
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.logs.units import factor_of
from vaneloop.base.quantities import kind_of
from vaneloop.identification.candidates import library
from vaneloop.identification.subsystem import Array, Parameter, StageError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = ["FIRST_CODE", "Law", "Record", "System", "check_parameters", "is_name", "unknown"]

MOST_PARAMETERS, MOST_MEMORY = 8, 64
FIRST_CODE = {"signal": 101, "force": 201, "state": 301}  # numbers in the compiled dispatch; the library's are below


@dataclass(frozen=True)
class Law:
    """A law that a machine may obey and its model does not: what it does, and between which sizes it is looked for.

    name        unlike any of the library
    on          what it acts on: signal, force or state
    function    see above. Plain Python on numbers; compiled with numba where it can be
    parameters  its sizes: `Parameter(name, value, unit, low, high)`, ``value`` neutral: there the law changes nothing
    starts      sizes from which a fit is tried, from hardly seen to gross, both signs where the sign is free; one
                number, or a tuple of as many as there are parameters, each
    memory      how many numbers it remembers from sample to sample; 0: none
    places      where it may act: "input", "output", or channels and states by name; default: everywhere of its kind
    looks       how it shows in a log, in words
    """

    name: str
    on: str
    function: Callable[..., float]
    parameters: Sequence[Parameter]
    starts: Sequence[float | Sequence[float]]
    memory: int = 0
    places: Sequence[str] | None = None
    looks: str = ""

    def __post_init__(self) -> None:
        """Check what the user wrote; one line says what is wrong and what is allowed."""

        def wrong(text: str) -> StageError:
            return StageError(f"law {self.name!r}: {text}")

        if not is_name(self.name):
            raise StageError(f"law {self.name!r}: its name must be a Python name (letters, digits, _)")
        families = [family for family, by in library.LAWS.items() if self.name in by]
        if families:
            raise wrong(f"the library has a law of that name (on a {' and a '.join(families)}); choose another")
        if self.on not in FIRST_CODE:
            raise wrong(f"on (={self.on!r}) must be one of {', '.join(FIRST_CODE)}")
        if isinstance(self.memory, bool) or not isinstance(self.memory, int) or not 0 <= self.memory <= MOST_MEMORY:
            raise wrong(f"memory (={self.memory!r}) must be a whole number in [0, {MOST_MEMORY}]")
        self._check_function(wrong)
        if not isinstance(self.parameters, list | tuple) or not 0 < len(self.parameters) <= MOST_PARAMETERS:
            raise wrong(f"parameters (={self.parameters!r}) must be a list of 1 to {MOST_PARAMETERS} Parameter(...)")
        check_parameters(self.parameters, wrong)
        for p in self.parameters:
            if not p.low < p.high:
                raise wrong(f"parameter {p.name}: low (={p.low:g}) must be below high (={p.high:g})")
        # how well a size is known beforehand is for the library to say: a user's law is looked for everywhere in bounds
        object.__setattr__(self, "parameters", tuple(replace(p, tolerance=0.0) for p in self.parameters))
        object.__setattr__(self, "starts", self._checked_starts(wrong))
        if isinstance(self.places, str):
            raise wrong(f"places (={self.places!r}) must be a list of names")

    def arguments(self) -> tuple[str, ...]:
        """Names of what the function is called with."""
        place = {"signal": ("u",), "force": ("v", "x"), "state": ("x",)}[self.on]
        return (*place, "t", "dt", "p", "m") if self.memory else (*place, "t", "p")

    def _check_function(self, wrong: Callable[[str], StageError]) -> None:
        if not callable(self.function):
            raise wrong(f"function (={self.function!r}) must be a function")
        wanted = self.arguments()
        try:
            inspect.signature(getattr(self.function, "py_func", self.function)).bind(*wanted)
        except TypeError:
            has = str(inspect.signature(self.function))
            memory = f"memory={self.memory}" if self.memory else "no memory"
            raise wrong(
                f"function takes {has}; a law on a {self.on} with {memory} is called with ({', '.join(wanted)})"
            ) from None

    def _checked_starts(self, wrong: Callable[[str], StageError]) -> tuple[tuple[float, ...], ...]:
        n = len(self.parameters)
        if not isinstance(self.starts, list | tuple | np.ndarray) or not len(self.starts):
            raise wrong("starts is empty; give sizes from which a fit is tried, from hardly seen to gross")
        out = []
        for start in self.starts:
            try:
                values = tuple(float(v) for v in np.atleast_1d(np.asarray(start, dtype=float)))
            except (TypeError, ValueError):
                raise wrong(f"starts: {start!r} is not a number, nor a tuple of numbers") from None
            if len(values) != n:
                names = ", ".join(p.name for p in self.parameters)
                raise wrong(f"starts: {start!r} has {len(values)} values; {n} are needed ({names})")
            for v, p in zip(values, self.parameters, strict=True):
                if not (np.isfinite(v) and p.low <= v <= p.high):
                    raise wrong(f"starts: {p.name} (={v:g} {p.unit}) must be in [{p.low:g}, {p.high:g}]")
            if values == tuple(p.value for p in self.parameters):
                raise wrong(f"starts: {start!r} is neutral, where the law changes nothing")
            out.append(values)
        return tuple(out)

    def allowed(self, place: str, name: str, by_default: bool = True) -> bool:
        """Whether it may act at the place of that kind and name."""
        return by_default if self.places is None else place in self.places or name in self.places

    def sizes(self) -> tuple[tuple[float, ...], ...]:
        """Sizes from which a fit is tried, a number for each parameter."""
        return tuple(tuple(float(v) for v in np.atleast_1d(start)) for start in self.starts)

    def as_of_library(self, code: int) -> library.Law:
        """The same as the search has it."""
        made = tuple(self.parameters), self.sizes()
        return library.Law(self.name, code, self.looks, lambda _: made, self.looks, bool(self.memory))


def is_name(name: object) -> bool:
    """Whether a user may call something that: a Python name that no keyword and nothing of ours has."""
    return isinstance(name, str) and name.isidentifier() and not keyword.iskeyword(name) and not name.startswith("_")


def check_parameters(parameters: Sequence[Any], wrong: Callable[[str], StageError]) -> None:
    """Refuse what is no `Parameter`, or has a value that cannot be."""
    for p in parameters:
        if not isinstance(p, Parameter):
            raise wrong(f"parameters: {p!r} is not a Parameter; write Parameter(...) or unknown(...)")
        for which in ("value", "low", "high", "tolerance"):
            number = getattr(p, which)
            if isinstance(number, bool) or not isinstance(number, int | float | np.floating | np.integer):
                raise wrong(f"parameter {p.name!r}: {which} (={number!r}) must be a number")
        if not is_name(p.name):
            raise wrong(f"parameter {p.name!r} must be a Python name")
        if not (np.isfinite(p.value) and p.low <= p.value <= p.high):
            raise wrong(f"parameter {p.name} (={p.value:g} {p.unit}) must be in [{p.low:g}, {p.high:g}]")
    names = [p.name for p in parameters]
    if len(set(names)) != len(names):
        raise wrong(f"two parameters share a name among {', '.join(names)}")


KINDS = ("static", "force", "simulate", "closed_loop")
BETWEEN = ("hold", "line", "smooth")
NO_UNIT = ("", "-", "1")
PREFIXES = {-6.0: "u", -3.0: "m", 0.0: "", 3.0: "k", 6.0: "M"}  # of a unit, by the power of ten


def unknown(name: str, value: float, unit: str, low: float = -np.inf, high: float = np.inf) -> Parameter:
    """A parameter that the logs must tell: fitted from ``value``, which need be right within a factor of ten or so,
    within its bounds.
    """
    return Parameter(name, value, unit, low, high, np.inf)


@dataclass(eq=False)
class Record:
    """One log: times (s) and channels on them, float64[samples]; NaN where nothing was measured.

    begin  s: where it begins in the log that it was cut out of
    notes  what there is to note on how it was read
    ordered  rows stand in the order of time; else ``t`` only counts them
    """

    name: str
    t: Array
    columns: dict[str, Array]
    begin: float = 0.0
    notes: Sequence[str] = ()
    ordered: bool = True

    def __repr__(self) -> str:
        """Name, samples and channels on one line."""
        return f"Record({self.name!r}, {np.size(self.t):,} samples: {', '.join(self.columns)})"


@dataclass
class System:
    """A model and what is needed to hold it against logs.

    kind        static, force, simulate or closed_loop
    model       see above; gets named tuples: u.pump, x.level, p.area. Plain Python on numbers (simulate, closed_loop:
                compiled with numba where it can be) or on whole arrays (static, force)
    outputs     measured channels that it explains, name -> unit, in the order in which the model (or ``output``)
                returns them
    inputs      measured channels that drive it, name -> unit
    parameters  `Parameter` (known: exactly, or within a tolerance that is refitted) or `unknown`
    position, velocity   force: the channel of the displacement, of its rate, or of both: what is missing is
                         differentiated, or integrated from a start that is fitted to each log (``start_position``)
    cutoff      force: frequency in Hz up to which forces are compared, and three times which motion is differentiated
                where its noise allows; default: from the measured force
    start_force force: hysteretic elements start a log "unloaded", in the middle of their gap, or with the force
                "measured" there
    states      simulate: name -> unit, in the order in which the model returns their derivatives
    rates       simulate: velocity -> displacement, for states that are these; laws of friction then act on the velocity
    masses      simulate: velocity -> name of the parameter that divides forces there (of an angular velocity: torques),
                so that laws there are in units of force
    force_unit  unit of forces on states with a mass; default: what the units of the mass and of the velocity make,
                such as N, N m where an angular velocity is driven, or mN of kg and mm/s
    output      simulate: function output(x, u, p); default: the states that are named like the outputs
    start       state -> value at the start of a log, or "fitted"; others start at their measured value, velocities of
                rates at rest, and what is not measured is fitted
    window      s: start anew from the measured states after each window of this length (for what integrates)
    between     simulate: what an input does between two samples: "hold", "line", or "smooth", a curve (a cubic spline)
    control, commands   closed_loop: u = control(r, y, p), and the names and units of u; r has the inputs, y the outputs
                        after the sensors' laws
    places      where laws may act, of "input", "force", "state", "output", or channels and states by name; default:
                everywhere
    read        function path -> {"t": ..., channel: ...} for files that `vaneloop` cannot read
    units       of the position of kind force, {"position": "mm"}; default: that of its channel among the inputs, else m
    laws        laws of your own beside the library's, `Law`
    without     laws (``place.law``) that are not looked for
    """

    name: str
    kind: str
    model: Callable[..., object]
    outputs: dict[str, str]
    inputs: dict[str, str] = field(default_factory=dict)
    parameters: Sequence[Parameter] = ()
    position: str | None = None
    velocity: str | None = None
    cutoff: float | None = None
    start_force: str = "unloaded"
    states: dict[str, str] = field(default_factory=dict)
    rates: dict[str, str] = field(default_factory=dict)
    masses: dict[str, str] = field(default_factory=dict)
    force_unit: str | None = None
    output: Callable[..., object] | None = None
    start: dict[str, float | str] = field(default_factory=dict)
    window: float | None = None
    between: str = "hold"
    control: Callable[..., object] | None = None
    commands: dict[str, str] = field(default_factory=dict)
    places: Sequence[str] | None = None
    read: Callable[[str], Mapping[str, ArrayLike]] | None = None
    units: dict[str, str] = field(default_factory=dict)
    laws: Sequence[Law] = ()
    without: Sequence[str] = ()

    @property
    def holds(self) -> bool:
        """Whether an input keeps its value until the next one comes."""
        return self.kind in ("simulate", "closed_loop") and self.between == "hold"

    def __post_init__(self) -> None:
        """Check what the user wrote; one line says what is wrong and what is allowed."""
        self._check()

    def _check(self) -> None:
        def wrong(text: str) -> StageError:
            return StageError(f"system {self.name!r}: {text}")

        if self.kind not in KINDS:
            raise wrong(f"kind (={self.kind!r}) must be one of {', '.join(KINDS)}")
        if not callable(self.model):
            raise wrong(f"model (={self.model!r}) must be a function")
        if not self.outputs:
            raise wrong("outputs is empty; at least one measured channel must be explained")
        for what, given in (
            ("inputs", self.inputs),
            ("outputs", self.outputs),
            ("states", self.states),
            ("commands", self.commands),
        ):
            if not isinstance(given, dict):
                raise wrong(f"{what} (={given!r}) must be a dict of name -> unit")
            for n in given:
                if not is_name(n):
                    raise wrong(
                        f"{what}: {n!r} must be a Python name (letters, digits, _); --map renames a log's channel"
                    )
        check_parameters(self.parameters, wrong)
        names = [p.name for p in self.parameters]
        moves = self.kind in ("simulate", "closed_loop")
        if self.kind == "force" and not (self.position or self.velocity):
            raise wrong("kind 'force' needs position=, the channel of the displacement, or velocity=, that of its rate")
        if moves and not self.states:
            raise wrong(f"kind {self.kind!r} needs states=, name -> unit")
        if self.kind == "closed_loop" and not (self.control and self.commands):
            raise wrong(
                "kind 'closed_loop' needs control=, a function (r, y, p), and commands=, name -> unit of what it "
                "returns"
            )
        for v, x in self.rates.items():
            for n in (v, x):
                if n not in self.states:
                    raise wrong(f"rates: {n!r} is not a state; states are {', '.join(self.states)}")
        for v, m in self.masses.items():
            if v not in self.speeds:
                raise wrong(f"masses: {v!r} is no velocity: not of rates, nor in a unit of one")
            if m not in names:
                raise wrong(f"masses: {m!r} is not a parameter; parameters are {', '.join(names)}")
        for s, begin in self.start.items():
            if s not in self.states:
                raise wrong(f"start: {s!r} is not a state; states are {', '.join(self.states)}")
            if begin == "fitted" and self.window:
                raise wrong(f"start: {s!r} 'fitted' does not go with window=, which starts from measured states")
            number = isinstance(begin, int | float | np.floating | np.integer) and not isinstance(begin, bool)
            if begin != "fitted" and not (number and np.isfinite(float(begin))):
                raise wrong(f"start: {s!r} (={begin!r}) must be a number or 'fitted'")
        if moves and self.output is None:
            for o in self.outputs:
                if o not in self.states and o not in self.commands:
                    raise wrong(
                        f"output {o!r} is not a state; name it like one of {', '.join(self.states)}, or give output=, "
                        f"a function (x, u, p)"
                    )
        if self.between not in BETWEEN:
            raise wrong(f"between (={self.between!r}) must be one of {', '.join(BETWEEN)}")
        if self.start_force not in ("unloaded", "measured"):
            raise wrong(f"start_force (={self.start_force!r}) must be 'unloaded' or 'measured'")
        for what, size in (("window", self.window), ("cutoff", self.cutoff)):
            if size is not None and not (np.isfinite(size) and size > 0):
                raise wrong(f"{what} (={size!r}) must be above 0")
        known = {"input", "force", "state", "output", *self.inputs, *self.outputs, *self.states, *self.commands}
        for place in self.places or ():
            if place not in known:
                raise wrong(f"places: {place!r} is not known; allowed: {', '.join(sorted(known))}")
        if not isinstance(self.laws, list | tuple):
            raise wrong(f"laws (={self.laws!r}) must be a list of Law(...)")
        for law in self.laws:
            if not isinstance(law, Law):
                raise wrong(f"laws: {law!r} is not a Law; write Law(name, on, function, parameters, starts)")
            if [other.name for other in self.laws].count(law.name) > 1:
                raise wrong(f"laws: two are named {law.name!r}")
            for place in law.places or ():
                if place not in known:
                    allowed = ", ".join(sorted(known))
                    raise wrong(f"law {law.name!r}: places: {place!r} is not known; allowed: {allowed}")

    @property
    def speeds(self) -> list[str]:
        """States that are velocities: those of ``rates``, and those whose unit says so."""
        return [n for n, unit in self.states.items() if n in self.rates or kind_of(unit).endswith("velocity")]

    def unit_of_force(self, state: str) -> str:
        """The unit of what drives a velocity: of a force or torque where it has a mass, else of its derivative."""
        unit = self.states[state]
        if state not in self.masses:
            return f"({unit})/s"
        if self.force_unit:
            return self.force_unit
        mass = next(p.unit for p in self.parameters if p.name == self.masses[state])
        usual = "N m" if kind_of(unit) == "angular velocity" else "N"
        factor = factor_of(f"({mass})*({unit})/s", usual.replace(" ", "*"))
        if mass in NO_UNIT or not isinstance(factor, tuple):  # what the user calls a mass is none in these units
            return usual
        prefix = PREFIXES.get(round(math.log10(factor[0]), 6))
        return f"({mass}) ({unit})/s" if prefix is None else f"{prefix}{usual}"

    @property
    def unit_of_position(self) -> str:
        """The unit of the position of kind force: what ``units`` says, else that of the channel; else m."""
        return self.units.get("position") or self.inputs.get(self.position or "") or "m"

    def channels(self) -> tuple[str, ...]:
        """Names that a log must have."""
        motion = [c for c in (self.position, self.velocity) if c]
        return tuple(dict.fromkeys([*self.inputs, *motion, *(o for o in self.outputs)]))

    def optional(self) -> set[str]:
        """Outputs that need not be logged: those that only the loop uses."""
        return set(self.outputs) if self.kind == "closed_loop" else set()

    def allows(self, place: str, name: str) -> bool:
        """Whether laws may act at ``name`` (a channel or state) or at all places of its kind."""
        return self.places is None or place in self.places or name in self.places

    def reading_of(self, output: str) -> str:
        """What an output is called as a place of laws: its sensor, where an input or a state has the same name."""
        return f"{output}_sensor" if output in self.inputs or output in self.states else output
