"""What must be seen of any controller in a scenario, whatever its thresholds are: limits, fail-safe times, recovery.

The figures are a TOML table that users edit (``any_controller.toml`` ships): limits, times, and for each scenario which
reactions count. They become claims (`Expect`) about the time in which the scenario injects something.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from hil.inject.scenario import Expect, Scenario
from vaneloop.base.errors import InputError
from vaneloop.base.tables import Bound, Bounded, Quantity, Table, read

__all__ = ["SHIPPED", "Reactions", "expected_of_any", "load_reactions"]

SHIPPED = Path(__file__).with_name("any_controller.toml")
Reaction = Literal["ride", "leave", "fail_safe", "sensor", "standby", "wait", "recover", "limits"]


class Limits(Bounded):
    """What no tick may leave."""

    current: Annotated[Quantity, Bound("mA", 0.1, 1000.0)]
    stroke_min: Annotated[Quantity, Bound("mm", -10.0, 100.0)]
    stroke_max: Annotated[Quantity, Bound("mm", 0.0, 100.0)]


class Times(Bounded):
    """Within which a reaction must be seen."""

    start: Annotated[Quantity, Bound("s", 0.0, 60.0)]
    leave: Annotated[Quantity, Bound("s", 0.0, 60.0)]
    fail_safe: Annotated[Quantity, Bound("s", 0.0, 60.0)]
    sensor: Annotated[Quantity, Bound("s", 0.0, 60.0)]
    recover: Annotated[Quantity, Bound("s", 0.0, 60.0)]


class Reactions(Table):
    """``any_controller.toml``."""

    limits: Limits
    times: Times
    reactions: dict[str, Annotated[list[Reaction], Field(min_length=1)]]


def load_reactions(source: str | Path = SHIPPED) -> Reactions:
    """Read the table. Raises InputError with file, key, value and what is allowed."""
    return read(Path(source), Reactions)


def expected_of_any(name: str, scenario: Scenario, table: Reactions) -> Scenario:
    """Return the scenario with the claims that hold for any controller in place of its own.

    Raises InputError for a scenario of which the table says nothing.
    """
    if name not in table.reactions:
        raise InputError(f"reactions.{name}: the table of reactions says nothing of this scenario")
    times = {key: float(q.value) for key, q in table.times if isinstance(q, Quantity)}
    begin = min((a.start for a in scenario.inject), default=0.0)
    end = max((min(a.end, scenario.duration) for a in scenario.inject), default=0.0)
    claims = []

    def claim(mode: str, first: float, last: float, because: str, never: bool = False) -> None:
        first, last = (round(v, 3) for v in (first, last))
        if last - first > 2e-3:
            claims.append(Expect(mode=mode, during=[first, last], never=never, because=because))

    last = math.nextafter(scenario.duration, 0.0)
    for reaction in table.reactions[name]:
        if reaction == "ride":
            claim("RUN", times["start"], last, "ride: the controller goes on")
        elif reaction == "leave":
            claim("RUN", begin + times["leave"], end, "leave: RUN without what it needs", never=True)
        elif reaction == "fail_safe":
            claim("FAIL_SAFE", begin + times["fail_safe"], end, "fail_safe: the cause lasts")
        elif reaction == "sensor":
            by = round(begin + times["sensor"], 3)
            claims.append(Expect(mode="FAIL_SAFE", after=begin, by=by, because="sensor: the stroke is not known"))
        elif reaction == "standby":
            claim("STANDBY", begin + times["leave"], end, "standby: it is asked for")
        elif reaction == "wait":
            claim("RUN", 0.0, end, "wait: no demand yet", never=True)
        elif reaction == "recover":
            claim("RUN", end + times["recover"], last, "recover: the cause has gone")
    return scenario.model_copy(update={"expect": claims})
