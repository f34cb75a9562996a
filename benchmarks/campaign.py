"""``python -m benchmarks.campaign [ENGINES [COMPARED [WORD ...]]]``: scenarios in lanes against one by one on the bus.

Each shipped scenario (with a WORD in its name) that lanes can run is run on ENGINES machines (1,000) in lanes, and the
first COMPARED (500) of them one by one on the lockstep bus; both from the plan's points to margins, without the run
folder. Times are the processor's. Verdicts and margins are compared machine by machine. Machines are drawn beyond their
tolerances, so that claims break. Each row is printed, and the file written anew, when it is measured.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import machine
from hil.inject.in_lanes import warm_up_lanes
from hil.inject.margin import Margin
from hil.inject.scenario import library
from vaneloop.base.errors import InputError
from vaneloop.base.files import write
from vaneloop.fleet.plan import Group, Varied, varied_by
from vaneloop.fleet.together import Alone, side_by_side
from vaneloop.fleet.trial import trial_once
from vaneloop.verbs.machine import Machine

WIDE = {  # beyond what a table allows: some machines must fail
    "actuator.flow_gain": [0.12, 0.18],  # m/s
    "valve_null_bias.bias": [-12.0, 12.0],  # mA
    "lvdt_bias.bias": [-3.0, 3.0],  # mm
    "pot_bias.vigv": [-3.0, 3.0],  # deg
}
CLOSE = 1e-9  # of margins
RESULT = Path(__file__).parent / "results" / "campaign.json"


@dataclass(frozen=True)
class Compared:
    """A scenario both ways: processor time of a machine, s, and how many answers differ.

    alone      why lanes do not run it; empty: they do
    failed     machines of the compared ones in which a claim is broken, on the bus
    verdicts, margins   compared machines with another verdict, with a margin that is not the same to rounding
    """

    scenario: str
    alone: str = ""
    engines: int = 0
    compared: int = 0
    failed: int = 0
    verdicts: int = 0
    margins: int = 0
    bus_s: float = math.nan
    lanes_s: float = math.nan

    @property
    def text(self) -> str:
        """The row as it is printed."""
        if self.alone:
            return f"{self.scenario:28} on the bus: {self.alone}"
        return (
            f"{self.scenario:28} {1e3 * self.bus_s:7.1f} ms on the bus {1e3 * self.lanes_s:7.2f} ms in lanes "
            f"{self.bus_s / self.lanes_s:6.0f} times; {self.failed} of {self.compared} machines fail; verdicts of "
            f"{self.verdicts} differ, margins of {self.margins}"
        )


def quantities() -> list[Varied]:
    """What is varied: every nominal parameter with a tolerance within it, but for what is `WIDE`."""
    plant = Machine().plant
    limits: dict[str, Any] = {n.name: "tolerance" for n in plant.nominal if n.tolerance > 0.0}
    return varied_by(limits | WIDE, plant, "benchmarks.campaign")


def differ(bus: dict[str, Any], lanes: list[Margin]) -> tuple[bool, bool]:
    """Whether a verdict differs, and whether a margin does."""
    pairs = list(zip(bus["margins"], lanes, strict=True))
    verdict = any((a["expected"], a["held"]) != (b.expected, b.held) for a, b in pairs)
    margins = ((math.nan if a["value"] is None else a["value"], b.value) for a, b in pairs)
    return verdict, not all(np.isclose(a, b, rtol=CLOSE, atol=CLOSE, equal_nan=True) for a, b in margins)


def compare(name: str, file: Path, varied: list[Varied], points: list[list[float]], compared: int) -> Compared:
    """Run a scenario both ways."""
    files, g = {f"scenario.{name}": str(file)}, Group(name, "shipped", "shipped")
    started = time.process_time()
    found = side_by_side(files, g, varied, points)
    lanes = time.process_time() - started
    why = next((one.why for one in found if isinstance(one, Alone)), "")
    if why:
        return Compared(name, why)
    started = time.process_time()
    bus = [trial_once(files, g, varied, point) for point in points[:compared]]
    took = time.process_time() - started
    said = [differ(a, b.margins) for a, b in zip(bus, found, strict=False) if not isinstance(b, Alone)]
    return Compared(
        name, "", len(points), len(bus), sum(not a["held"] for a in bus), sum(v for v, _ in said),
        sum(m for _, m in said), took / len(bus), lanes / len(points),
    )  # fmt: skip


def measure(engines: int, compared: int, words: list[str]) -> Iterator[Compared]:
    """Compare every shipped scenario with one of the words in its name; a row at a time."""
    scenarios = {n: f for n, f in library().items() if not words or any(w in n for w in words)}
    varied = quantities()
    points = np.random.default_rng(1).random((engines, len(varied))).tolist()
    warm_up_lanes()
    trial_once({"scenario.nominal": str(library()["nominal"])}, Group("nominal", "s", "s"), varied, points[0])
    for name, file in scenarios.items():
        yield compare(name, file, varied, points, compared)


def main(words: list[str], result: Path = RESULT) -> None:
    """Print each row and write all so far when it is measured."""
    numbers = [int(w) for w in words[:2] if w.isdecimal()]
    engines, compared = [*numbers, *(1000, 500)[len(numbers) :]]
    if not 1 <= min(engines, compared) <= max(engines, compared) <= 1_000_000:
        raise InputError(f"ENGINES (={engines}) and COMPARED (={compared}) must be in [1, 1000000]")
    compared = min(compared, engines)
    host, rows = machine(), []
    for row in measure(engines, compared, words[len(numbers) :]):
        print(row.text, flush=True)
        rows.append(row)
        result.parent.mkdir(exist_ok=True)
        write(result, json.dumps({"machine": host, "rows": [asdict(r) for r in rows]}, indent=2) + "\n")
    ran = [r for r in rows if not r.alone]
    if not ran:
        print("no scenario with these words in its name runs in lanes")
        return
    ratio = sum(r.bus_s for r in ran) / sum(r.lanes_s for r in ran)
    print(f"{len(ran)} of {len(rows)} scenarios in lanes, {engines} machines each: {ratio:.0f} times as fast; of "
          f"{sum(r.compared for r in ran)} runs both ways, {sum(r.failed for r in ran)} of which fail, verdicts of "
          f"{sum(r.verdicts for r in ran)} differ, margins of {sum(r.margins for r in ran)}")  # fmt: skip


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as e:
        print(e, file=sys.stderr)
        sys.exit(2)
