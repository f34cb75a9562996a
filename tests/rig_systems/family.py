"""What a family of systems is: a nominal equation of motion, physical ranges, test signals, sensors, and what may be
hidden in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

__all__ = ["HELD", "Array", "Family", "Hidden", "Outside", "Signal"]

Array = np.ndarray
# why a law that delays or limits a signal differs between the product and this simulator
HELD = (
    "an input holds from sample to sample, so that it jumps; the product's lags, dead times and rate limits take a "
    "signal as straight between samples, and a jump comes out wrong by part of a sample"
)
Parameters = SimpleNamespace


@dataclass(frozen=True)
class Signal:
    """A test signal of one input.

    kinds   of `tests.rig_systems.signals.KINDS`, one a log
    low, high   its range; with ``scale`` in multiples of that (a function of the parameters)
    """

    kinds: tuple[str, ...]
    low: float
    high: float
    scale: Callable[[Parameters], float] | None = None


@dataclass(frozen=True)
class Outside:
    """A law that the product's library does not have.

    low, high   range of its size (log-uniform), a number without unit
    rate    (t, x, u, p, size, d) -> d: changes the derivatives; scalars
    output  (t, x, u, p, size, y) -> y: changes the outputs; arrays over samples, t from 0 to 1 over the log.
            For kind force x is (position, velocity, acceleration)
    source  (t, u, p, size) -> u: changes what drives the system; arrays over the fine grid
    amounts_to  sets of the library's laws that together are this law, or a series of it that no log tells apart
    """

    text: str
    low: float
    high: float
    rate: Callable[..., Any] | None = None
    output: Callable[..., Any] | None = None
    source: Callable[..., Any] | None = None
    amounts_to: tuple[frozenset[str], ...] = ()


@dataclass(frozen=True)
class Hidden:
    """One hidden thing: its name (place.law, or the family's name for what is outside) and its values."""

    name: str
    values: dict[str, float]

    @property
    def place(self) -> str:
        """Where it acts; empty for what is outside the library."""
        return self.name.rpartition(".")[0]

    @property
    def law(self) -> str:
        """Which law it is."""
        return self.name.rpartition(".")[2]


@dataclass(frozen=True)
class Family:
    """Systems that differ in their parameters only.

    kind        simulate, static, force or closed_loop, as the product calls them
    parameters  name -> physical range; drawn log-uniformly; unknown to the nominal model
    known       parameters -> further ones that an engineer knows exactly (gains of a controller, a weighed mass)
    rhs         (x, u, p) -> derivatives of the states; scalars. For kinds static and force (u or motion, p) -> output
    output      (x, u, p) -> outputs; arrays. None: outputs are the states of these names
    control     closed_loop: (r, y, p) -> command
    timescale   parameters -> s: what the log rate and the test signals follow
    start       (p, first inputs) -> states at the start
    rates, masses   velocity -> displacement, velocity -> parameter that divides forces there
    per_scale   samples in one time scale, low and high
    noise       output -> range of its noise's RMS as a share of the output's spread
    line        inputs run straight between samples (else they hold)
    window      in time scales: the nominal model starts anew that often
    laws        laws of the product's library that may be hidden, place.law
    partners    law -> the law without which it does nothing
    outside     laws that the library does not have
    same        groups of laws that are one and the same here, with the reason in the family's file
    apart       law -> why the product's model with the true law does not come within a noise floor
    """

    name: str
    text: str
    kind: str
    parameters: dict[str, tuple[float, float]]
    inputs: dict[str, Signal]
    outputs: tuple[str, ...]
    rhs: Callable[..., Any]
    timescale: Callable[[Parameters], float]
    noise: dict[str, tuple[float, float]]
    laws: tuple[str, ...]
    outside: dict[str, Outside]
    states: tuple[str, ...] = ()
    output: Callable[..., Any] | None = None
    control: Callable[..., Any] | None = None
    known: Callable[[Parameters], dict[str, float]] | None = None
    start: Callable[..., Sequence[float]] | None = None
    rates: dict[str, str] = field(default_factory=dict)
    masses: dict[str, str] = field(default_factory=dict)
    per_scale: tuple[float, float] = (20.0, 60.0)
    samples: tuple[int, int] = (1200, 3000)
    line: bool = False
    window: float | None = None
    partners: dict[str, str] = field(default_factory=dict)
    same: tuple[frozenset[str], ...] = ()
    apart: dict[str, str] = field(default_factory=dict)

    def where(self, place: str) -> tuple[str, int]:
        """Kind of a place and its index: input, output, force, state, command."""
        if self.kind == "force" and place == "force":
            return "force", 0
        if self.kind == "closed_loop" and place == "command":
            return "command", 0
        if place in self.inputs:
            return "input", list(self.inputs).index(place)
        if place in self.states:
            i = self.states.index(place)
            return ("force" if place in self.rates else "state"), i
        return "output", self.outputs.index(place.removesuffix("_sensor"))

    def equivalent(self, name: str) -> frozenset[str]:
        """Laws that are the same as this one here, itself among them."""
        return frozenset({name}.union(*(group for group in self.same if name in group)))

    def draw(self, rng: np.random.Generator) -> Parameters:
        """Parameters of one system."""
        p = SimpleNamespace(
            **{k: float(np.exp(rng.uniform(np.log(a), np.log(b)))) for k, (a, b) in self.parameters.items()}
        )
        if self.known:
            vars(p).update(self.known(p))
        return p
