"""A user's own law: declared beside the model in the same file, and from there on like one of the library.

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vaneloop.identification.candidates import library
from vaneloop.identification.subsystem import Parameter, StageError

__all__ = ["FIRST_CODE", "Law", "check_parameters", "is_name"]

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
