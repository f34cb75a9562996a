"""``python -m benchmarks.campaign [ENGINES [COMPARED]]``: trials of a campaign in lanes against one by one on the bus.

Each scenario that has rows runs on ENGINES machines (1,000) in lanes, and on a share of COMPARED (500 in all) one by
one, in the same run and on the same machines; both from the plan's points to margins, without the run folder. Times are
the processor's. Verdicts and margins are compared. Each row is printed, and the file written anew, when it is measured.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from hil.inject.in_lanes import warm_up_lanes
from hil.inject.scenario import library
from vaneloop.fleet.plan import Group, Varied
from vaneloop.fleet.together import Alone, in_lanes
from vaneloop.fleet.trial import trial_once
from vaneloop.verbs.machine import Machine

VARIED = ("actuator.flow_gain", "valve.bandwidth", "linkage.vigv_play", "linkage.vigv_lc", "engine.lag")
SHARE = 0.1  # of the value, where a table gives no tolerance
CLOSE = 1e-9  # of margins
RESULT = Path(__file__).parent / "results" / "campaign.json"


def quantities() -> list[Varied]:
    """What is varied, within its table's tolerance."""
    known = {n.name: n for n in Machine().plant.nominal}
    spread = {name: known[name].tolerance or SHARE * known[name].value for name in VARIED}
    return [Varied(n, known[n].unit, known[n].value - spread[n], known[n].value + spread[n], False) for n in VARIED]


def differ(alone: dict[str, Any], lanes: Any) -> tuple[bool, bool]:
    """Whether a verdict differs, and whether a margin does."""
    pairs = list(zip(alone["margins"], lanes, strict=True))
    verdict = any((a["expected"], a["held"]) != (b.expected, b.held) for a, b in pairs)
    margins = ((math.nan if a["value"] is None else a["value"], b.value) for a, b in pairs)
    return verdict, not all(np.isclose(a, b, rtol=CLOSE, atol=CLOSE, equal_nan=True) for a, b in margins)


def main(engines: int = 1000, compared: int = 500) -> None:
    """Measure every shipped scenario; print and write what comes of it."""
    varied, scenarios = quantities(), library()
    points = np.random.default_rng(1).random((engines, len(varied))).tolist()
    each = -(-compared // len(scenarios))
    warm_up_lanes()
    trial_once({"scenario.nominal": str(scenarios["nominal"])}, Group("nominal", "s", "s"), varied, points[0])
    rows: list[dict[str, Any]] = []
    for name, file in scenarios.items():
        files, g = {f"scenario.{name}": str(file)}, Group(name, "shipped", "shipped")
        started = time.process_time()
        found = in_lanes(files, g, varied, points)
        lanes = time.process_time() - started
        if isinstance(found[0], Alone):
            rows.append({"scenario": name, "alone": found[0].why})
            print(f"{name:28} on the bus: {found[0].why}", flush=True)
            continue
        started = time.process_time()
        alone = [trial_once(files, g, varied, point) for point in points[:each]]
        one = (time.process_time() - started) / each
        said = [differ(a, b) for a, b in zip(alone, found, strict=False)]
        rows.append({
            "scenario": name, "alone_s": one, "lanes_s": lanes / engines, "ratio": one * engines / lanes,
            "compared": each, "verdicts_differ": sum(v for v, _ in said), "margins_differ": sum(m for _, m in said),
            "failed": sum(not m.held for of in found if not isinstance(of, Alone) for m in of),
        })  # fmt: skip
        r = rows[-1]
        print(
            f"{name:28} {1e3 * one:7.1f} ms alone {1e3 * r['lanes_s']:7.2f} ms in lanes {r['ratio']:6.0f} times, "
            f"verdicts differ {r['verdicts_differ']} of {each}, margins {r['margins_differ']}",
            flush=True,
        )
        RESULT.parent.mkdir(exist_ok=True)
        RESULT.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    ran = [r for r in rows if "ratio" in r]
    ratio = sum(r["alone_s"] for r in ran) / sum(r["lanes_s"] for r in ran)
    print(f"{len(ran)} of {len(rows)} scenarios in lanes, {engines} engines each: {ratio:.0f} times as fast; of "
          f"{sum(r['compared'] for r in ran)} engines run both ways {sum(r['verdicts_differ'] for r in ran)} verdicts "
          f"and {sum(r['margins_differ'] for r in ran)} margins differ")  # fmt: skip


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]))
