"""What a scenario of frame and fault injection is: what is done to the bus and the machine, when, and what must then be
seen.

A scenario is a TOML file or the same as Python objects (`Scenario`, the actions, `Expect`). Times are seconds from
power-on of controller and ECU. Nothing here runs anything: `hil.inject` does.
"""

from __future__ import annotations

import difflib
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from controller import FAULTS, MODES
from controller.channels import SEEN
from hil.bus.frames import NAMES
from hil.inject.actions import AnyAction, ChannelFault, Link, Machine, Number, Positive, Replay, Seconds, Send
from plant.model import Side
from vaneloop.base.errors import InputError
from vaneloop.base.signals import SIDES
from vaneloop.base.tables import Table, read
from vaneloop.base.vanes import VANES

__all__ = ["COUNTS", "OF_CHANNELS", "SIGNALS", "Expect", "Scenario", "library", "load_scenario"]

# what an expectation can be about, besides mode and faults: signals of the controller in border units, and what its
# receiver counts
SIGNALS = ("x_dem", "x_lvdt", "i_cmd", "n_dem", "n_r", *VANES)
OF_CHANNELS = (*SEEN, "i_coils")  # of two channels
COUNTS = (
    "good", "sync", "wrong_crc", "repeated", "wrong_sequence", "wrong_length", "wrong_kind", "lost", "refused",
    "unauthentic",
)  # fmt: skip


# ---- expectations ----------------------------------------------------------------------------------------------------


class Expect(Table):
    """One claim: a condition, and when it must hold.

    The condition is one of::

        mode = "DEGRADED"        the controller's mode
        fault = "demand_stale"   this fault stands; "any" is any of them
        signal = "x_dem", low = 1.9, high = 2.1     a signal (border unit) is within limits
        count = "wrong_crc", low = 10, high = 10    what the receiver has counted since power-on
        late = "VGV_STATUS"      the ECU misses this frame

    The time is one of::

        at = 2.041, tolerance = 0.002   becomes true then (default tolerance 2 ms)
        by = 5.0, after = 2.0           is true at some time from ``after`` (default 0) to ``by``
        during = [2.0, 3.0]             holds all the time
        never = true                    never holds (within ``during``, where that is given)

    because  the rule behind the number, for the reader
    only     "lockstep": follows from arbitration or timing that a bus between processes does not have; not judged there
    """

    mode: str | None = None
    fault: str | None = None
    signal: str | None = None
    count: str | None = None
    late: str | None = None
    low: Number | None = None
    high: Number | None = None
    at: Seconds | None = None
    tolerance: Positive = 0.002
    by: Seconds | None = None
    after: Seconds = 0.0
    during: Annotated[list[Seconds], Field(min_length=2, max_length=2)] | None = None
    never: bool = False
    because: str = ""
    only: Literal["lockstep"] | None = None

    @model_validator(mode="after")
    def _one_claim(self) -> Expect:
        kinds = {
            "mode": MODES,
            "fault": (*FAULTS, "any"),
            "signal": (*SIGNALS, *SIDES, *OF_CHANNELS),
            "count": COUNTS,
            "late": tuple(n for n in NAMES.values() if n != "ECU_DEMAND"),
        }
        given = [k for k in kinds if getattr(self, k) is not None]
        if len(given) != 1:
            raise ValueError(
                f"an expectation is about exactly one of {', '.join(kinds)}; here: {', '.join(given) or 'none'}"
            )
        kind, value = given[0], getattr(self, given[0])
        if value not in kinds[kind]:
            raise ValueError(f"{kind} (={value!r}) must be one of {', '.join(kinds[kind])}")
        limits = self.low is not None or self.high is not None
        if limits != (kind in ("signal", "count")):
            raise ValueError(f"{kind} {'does not take' if limits else 'needs'} low or high")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError(f"low (={self.low:g}) must not be above high (={self.high:g})")
        times = [k for k in ("at", "by") if getattr(self, k) is not None]
        times += ["never"] if self.never else ["during"] if self.during is not None else []
        if len(times) != 1:
            raise ValueError(
                f"an expectation has exactly one of at, by, during, never; here: {', '.join(times) or 'none'}"
            )
        if self.during is not None and not self.during[0] < self.during[1]:
            raise ValueError(f"during (={self.during}) must be a time and a later one")
        if self.by is not None and not self.after < self.by:
            raise ValueError(f"by (={self.by:g} s) must be after {self.after:g} s")
        return self

    @property
    def condition(self) -> str:
        """The condition in words."""
        if self.mode or self.fault:
            return self.mode or ("any fault" if self.fault == "any" else str(self.fault))
        if self.late:
            return f"{self.late} late"
        low = f"{self.low:g} <= " if self.low is not None else ""
        high = f" <= {self.high:g}" if self.high is not None else ""
        return f"{low}{self.signal or self.count}{high}"

    @property
    def words(self) -> str:
        """The whole claim in words."""
        if self.at is not None:
            return f"{self.condition} from {self.at:.3f} s on (+-{self.tolerance * 1e3:g} ms)"
        if self.by is not None:
            return f"{self.condition} by {self.by:.3f} s" + (f", after {self.after:.3f} s" if self.after else "")
        span = f" from {self.during[0]:.3f} to {self.during[1]:.3f} s" if self.during else ""
        return f"never {self.condition}{span}" if self.never else f"{self.condition}{span}"

    @property
    def latest(self) -> float:
        """Last moment that the claim speaks of."""
        return max(self.at or 0.0, self.by or 0.0, self.during[1] if self.during else 0.0)


# ---- scenario --------------------------------------------------------------------------------------------------------


class Scenario(Table):
    """What is done, and what must be seen.

    title      in one line
    why        what the scenario stands for and where the expected figures come from
    duration   s
    seed       of everything random in it, sensors' noise too
    demand     the ECU's profile: [time (s), n_dem (%)] points, straight lines between them
    secoc      controller and ECU authenticate their frames (docs/bus.md), under a key that ``seed`` gives
    side_a, side_b  parameters and effects of one of two actuators, from power-on on (`plant.model.Side`)
    inject     actions, in the order in which they act on a frame
    expect     claims; besides them, safe limits and documented mode changes are always demanded
    """

    title: Annotated[str, Field(min_length=4)]
    why: str = ""
    duration: Annotated[Number, Field(gt=0.0, le=3600.0)]
    seed: Annotated[int, Field(ge=0)] = 1
    demand: Annotated[list[Annotated[list[Number], Field(min_length=2, max_length=2)]], Field(min_length=1)] = [
        [0.0, 80.0]
    ]
    secoc: bool = False
    side_a: Side = Side()
    side_b: Side = Side()
    inject: list[AnyAction] = []
    expect: list[Expect] = []

    @model_validator(mode="after")
    def _fits(self) -> Scenario:
        times = [t for t, _ in self.demand]
        if any(b <= a for a, b in zip(times, times[1:], strict=False)):
            raise ValueError(f"demand: its times (={times}) must increase")
        for _, n in self.demand:
            if not 0.0 <= n <= 125.0:
                raise ValueError(f"demand: {n:g} % must be in [0, 125]")
        for i, action in enumerate(self.inject):
            if action.start >= self.duration:
                raise ValueError(
                    f"inject.{i}.start (={action.start:g} s) must be before the end (duration = {self.duration:g} s)"
                )
            if isinstance(action, Send) and action.secoc != "none" and not self.secoc:
                raise ValueError(f"inject.{i}.secoc (={action.secoc!r}) needs secoc = true in the scenario")
        for i, claim in enumerate(self.expect):
            if claim.latest > self.duration:
                raise ValueError(f"expect.{i} speaks of {claim.latest:g} s; the scenario ends at {self.duration:g} s")
        return self

    @property
    def of_two_channels(self) -> bool:
        """Whether it is about two channels of the controller."""
        asked = any(isinstance(a, ChannelFault | Link) for a in self.inject)
        return asked or any(claim.signal in OF_CHANNELS for claim in self.expect)

    @property
    def of_two_actuators(self) -> bool:
        """Whether it is about one of two actuators."""
        own = self.side_a != Side() or self.side_b != Side()
        return own or any(isinstance(a, Machine) and a.side for a in self.inject)


def library(channels: int = 1) -> dict[str, Path]:
    """Return the shipped scenarios, of a controller with so many channels: name -> file."""
    folder = Path(str(resources.files("hil.inject") / ("scenarios" if channels == 1 else "scenarios_of_channels")))
    return {f.stem: f for f in sorted(folder.glob("*.toml"))}


def load_scenario(source: str | Path) -> Scenario:
    """Read a scenario: the name of a shipped one, or a TOML file. A log that it names may lie beside it.

    Raises InputError, in one line, naming file, key, value and what is allowed.
    """
    known = library() | library(2)
    if isinstance(source, str) and source in known:
        return read(known[source], Scenario)
    if not Path(source).is_file():
        close = difflib.get_close_matches(str(source), known, 1)
        hint = f"; {close[0]!r} ships" if close else "; vaneloop inject --list shows those that ship"
        raise InputError(f"{source}: no such file or shipped scenario{hint}")
    made = read(Path(source), Scenario)
    folder = Path(source).parent
    beside = [
        a.model_copy(update={"log": str(folder / a.log)})
        if isinstance(a, Replay) and a.log and (folder / a.log).is_file()
        else a
        for a in made.inject
    ]
    return made.model_copy(update={"inject": beside})
