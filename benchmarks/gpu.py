"""``python -m benchmarks.gpu [FILE.json]``: very many closed loops on this computer's GPU against its processor.

Each row is printed, and the file written anew, when it is measured. Ratios are against lanes on all of the processor's
cores (`hil.loop.lanes`) in the same run: of whole calls, and of the loops alone. First 10,000 engines of many kinds are
compared, figure by figure. Then the same of scenarios, as a campaign runs them: verdicts and margins are compared.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ours import OurLanes, Setup
from controller import load_calibration
from hil.inject import load_scenario
from hil.inject.heard import Heard, hear
from hil.inject.in_lanes import WATCHED, margins_in_lanes, margins_on_gpu
from hil.inject.margin import Margin
from hil.inject.scenario import Scenario
from hil.loop.cuda import Kernel, kernel
from hil.loop.engines import Engines, lockstep_engines, put_on_gpu
from hil.loop.lockstep import CHUNK, S_FRESH, S_P_S, WARM_UP, Stimulus
from plant import Model, Plant, build_plant
from plant.chain_lanes import W
from plant.stages.blocks import on_all_cores
from vaneloop.base.compiled import threads

COMPARED = 10_000
SIZES = (1_000, 10_000, 33_792, 100_000)
LONG, SHORT = 60.0, 10.0  # s
ON_PROCESSOR = 4096  # engines
SCENARIOS = ("demand_gap_200ms", "lvdt_jumps", "bad_day")  # frames that are missing; a machine that changes; long
RESULT = Path(__file__).parent / "results" / "gpu.json"


def within_tolerance(count: int, seed: int = 1) -> list[Plant]:
    """Machines of flow gains and plays drawn from their tolerances."""
    base, rng = build_plant(), np.random.default_rng(seed)
    names = ("actuator.flow_gain", "linkage.vigv_play", "linkage.vgv1_play")
    known = {n.name: n for n in base.nominal}
    draws = {n: known[n].value + known[n].tolerance * rng.uniform(-1.0, 1.0, count) for n in names}
    return [Model(parameters={n: float(draws[n][i]) for n in names}).plant(base) for i in range(count)]


EFFECTS = {  # largest values
    "valve_null_bias": {"bias": 2.0}, "valve_dead_band": {"half_width": 0.5}, "linkage_friction": {"vigv": 0.2},
    "aero_load": {"force": 2e3}, "piston_friction": {"force": 200.0}, "lvdt_bias": {"bias": 0.05},
}  # fmt: skip


def with_effects(count: int, seed: int = 2) -> list[Plant]:
    """Machines of which each has effects all along the chain."""
    base, rng = build_plant(), np.random.default_rng(seed)
    drawn = (
        {e: {k: float(rng.uniform(0.0, v)) for k, v in of.items()} for e, of in EFFECTS.items()} for _ in range(count)
    )
    return [Model(effects=effects).plant(base) for effects in drawn]


def demand(duration: float) -> Stimulus:
    """Rises and falls of the demand, with rests between them."""
    t = np.arange(0.0, duration, 0.01)
    return Stimulus.of(np.interp(t % 20.0, [0.0, 2.0, 7.0, 9.0, 14.0, 20.0], [60.0, 60.0, 92.0, 92.0, 65.0, 60.0]))


def stimuli(duration: float) -> list[Stimulus]:
    """The demand as it is; with a gap in its frames; without oil for a while; asked to stand by."""
    as_it_is = demand(duration).rows
    gap, dry, idle = as_it_is.copy(), as_it_is.copy(), as_it_is.copy()
    gap[300:420, S_FRESH] = 0.0
    dry[400:600, S_P_S] = 0.0
    idle[500:, -1] = 0.0
    return [Stimulus(rows) for rows in (as_it_is, gap, dry, idle)]


def difference(a: Engines, b: Engines) -> dict[str, Any]:
    """How far two answers are from each other: largest relative differences, engines whose counts differ."""
    out: dict[str, Any] = {}
    for name in ("servo_error", "angle_error", "stroke", "angles"):
        x, y = getattr(a, name), getattr(b, name)
        out[f"{name}, relative"] = float(np.nanmax(np.abs(x - y) / np.maximum(np.abs(y), 1e-12)))
    for name in ("mode", "faults", "finite"):
        out[f"{name}, engines that differ"] = int((getattr(a, name) != getattr(b, name)).sum())
    out["time in a mode, engines that differ"] = int((a.in_mode != b.in_mode).any(axis=1).sum())
    out["seen modes, s"] = b.in_mode.sum(axis=0).tolist()
    return out


def measure(sizes: tuple[int, ...] = SIZES, compared: int = COMPARED) -> Iterator[dict[str, Any]]:
    """Measure; a row at a time."""
    made = time.perf_counter()
    plants, affected = within_tolerance(max(*sizes, compared)), with_effects(compared // 2)
    yield {"what": "machines made", "engines": len(plants), "s": time.perf_counter() - made}
    started = time.perf_counter()
    lockstep_engines(demand(0.1), plants[:1], seed=1, device="cuda")
    yield {"what": "kernel compiled", "device": kernel().name, "s": time.perf_counter() - started}
    started = time.perf_counter()
    for some in (plants[:1], affected[:1]):
        lockstep_engines(demand(0.1), some, seed=1, device="cpu")
    yield {"what": "lanes of the processor compiled", "s": time.perf_counter() - started}
    mixed = [plant for pair in zip(plants, affected, strict=False) for plant in pair][:compared]
    kinds, cals = stimuli(SHORT), [load_calibration(), load_calibration(strategy="single")]
    given = [kinds[i % len(kinds)] for i in range(len(mixed))]
    flashed = [cals[i // len(kinds) % 2] for i in range(len(mixed))]
    answers = {}
    for device in ("cuda", "cpu"):
        answers[device] = run = lockstep_engines(given, mixed, calibrations=flashed, seed=1, device=device)
        yield {"what": "engines of many kinds", "device": run.devices, "engines": len(mixed), "s": run.wall_s}
    yield {"what": "cuda against cpu", **difference(answers["cuda"], answers["cpu"])}
    n = min(ON_PROCESSOR, len(plants))
    whole = n * SHORT / lockstep_engines(demand(SHORT), plants[:n], seed=1, device="cpu").wall_s
    alone = lanes_alone(LONG)
    yield {"what": "the processor", "threads": threads(), "whole calls, s/s": whole, "loops alone, s/s": alone}
    for kind, those, count in [("tolerances", plants, c) for c in sizes] + [("effects", affected, len(affected))]:
        run = lockstep_engines(demand(LONG), those[:count], seed=1, device="cuda")
        speed, loops = count * LONG / run.wall_s, kernel_alone(those[:count], LONG)
        yield {
            "what": kind, "device": run.devices, "engines": count, "simulated s": count * LONG,
            "whole call, s": run.wall_s, "whole call, s/s": speed, "ratio": speed / whole,
            "loops alone, s/s": loops, "ratio of loops": loops / alone, "servo, mm": float(run.servo_error.max()),
        }  # fmt: skip


def lanes_alone(seconds: float) -> float:
    """Simulated s/s of full blocks of lanes on all of the processor's cores, without what is around them."""
    setup = Setup(demand(seconds))
    blocks = [OurLanes(setup, W) for _ in range(threads())]
    rooms = [b.lanes.room(setup.ticks) for b in blocks]
    started = time.perf_counter()
    on_all_cores(
        lambda part: blocks[part.start].advance(rooms[part.start]), [range(q, q + 1) for q in range(len(blocks))]
    )
    return len(blocks) * W * seconds / (time.perf_counter() - started)


def kernel_alone(plants: list[Plant], seconds: float) -> float:
    """Simulated s/s of the kernel, with noise, without the building of the engines."""
    k, cal, stimulus = kernel(), load_calibration(), demand(seconds)
    n, ticks = len(plants), round(seconds * 1000)
    arrays = put_on_gpu(k, plants, [cal] * n, [stimulus] * n, 1, 10, ticks - 10)
    numbers = np.random.default_rng(1).standard_normal((CHUNK, 2 + len(plants[0].vanes)))
    noise = k.cuda.to_device(numbers)
    k(-WARM_UP, WARM_UP, noise, *arrays)
    k.cuda.synchronize()
    started = time.perf_counter()
    for k0 in range(0, ticks, CHUNK):
        k(k0, min(CHUNK, ticks - k0), noise, *arrays)
    k.cuda.synchronize()
    return n * seconds / (time.perf_counter() - started)


class Timed:
    """A kernel that notes how long its launches take, s."""

    def __init__(self, of: Kernel):
        self.of, self.s = of, 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.of, name)

    def __call__(self, *arguments: Any) -> None:
        self.of.cuda.synchronize()  # what was put there before
        started = time.perf_counter()
        self.of(*arguments)
        self.of.cuda.synchronize()
        self.s += time.perf_counter() - started


def on_gpu(k: Any, scenario: Scenario, plants: list[Plant], heard: Heard) -> list[list[Margin]]:
    """Margins of machines on the GPU."""
    found = margins_on_gpu(k, scenario, plants, load_calibration(), heard)
    return [margins for _, some in found for margins in some]


def in_lanes(scenario: Scenario, plants: list[Plant], heard: Heard) -> list[list[Margin]]:
    """Margins of machines in lanes on all cores."""
    out: dict[int, list[list[Margin]]] = {}

    def run(part: range) -> None:
        some = plants[part.start : part.stop]
        out[part.start] = margins_in_lanes(scenario, some, load_calibration(), heard)

    on_all_cores(run, [range(a, min(a + W, len(plants))) for a in range(0, len(plants), W)])
    return [margins for a in sorted(out) for margins in out[a]]


def apart(a: list[list[Margin]], b: list[list[Margin]]) -> dict[str, Any]:
    """How far margins are from each other: machines whose verdicts differ, largest relative difference."""
    verdicts = sum([m.held for m in one] != [m.held for m in other] for one, other in zip(a, b, strict=True))
    x, y = (np.array([m.value for one in of for m in one]) for of in (a, b))
    far = np.abs(x - y) / np.maximum(np.abs(y), 1e-12)
    return {
        "verdicts, machines that differ": verdicts, "margins, relative": float(np.nanmax(far)),
        "margins that only one has": int((np.isnan(x) != np.isnan(y)).sum()),
        "failed": sum(not all(m.held for m in one) for one in b),
    }  # fmt: skip


def measure_scenarios(
    names: tuple[str, ...] = SCENARIOS, sizes: tuple[int, ...] = SIZES, compared: int = COMPARED
) -> Iterator[dict[str, Any]]:
    """Measure scenarios; a row at a time."""
    plants, affected = within_tolerance(max(*sizes, compared)), with_effects(compared // 2)
    mixed = [plant for pair in zip(plants, affected, strict=False) for plant in pair][:compared]
    for name in names:
        scenario = load_scenario(name)
        heard = hear(scenario, plants[0])
        assert isinstance(heard, Heard)
        started = time.perf_counter()
        on_gpu(kernel(WATCHED), scenario, [plants[0], affected[0]], heard)
        yield {"what": f"{name}: kernel compiled", "device": kernel(WATCHED).name, "s": time.perf_counter() - started}
        in_lanes(scenario, [plants[0], affected[0]], heard)
        started = time.perf_counter()
        lanes = in_lanes(scenario, mixed, heard)
        rate = len(mixed) * scenario.duration / (time.perf_counter() - started)
        yield {"what": f"{name}: in lanes", "threads": threads(), "machines": len(mixed), "whole calls, s/s": rate}
        yield {"what": f"{name}: cuda against cpu", **apart(on_gpu(kernel(WATCHED), scenario, mixed, heard), lanes)}
        for count in sizes:
            timed = Timed(kernel(WATCHED))
            started = time.perf_counter()
            on_gpu(timed, scenario, plants[:count], heard)
            s, simulated = time.perf_counter() - started, count * scenario.duration
            yield {
                "what": name, "device": timed.name, "machines": count, "simulated s": simulated, "whole call, s": s,
                "whole call, s/s": simulated / s, "ratio": simulated / s / rate, "kernel, s/s": simulated / timed.s,
            }  # fmt: skip


def main() -> None:
    """Measure and tell."""
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else RESULT
    file.parent.mkdir(parents=True, exist_ok=True)
    rows = []
    for row in chain(measure(), measure_scenarios()):
        rows.append(row)
        print("  ".join(f"{k}: {v:,.4g}" if isinstance(v, float) else f"{k}: {v}" for k, v in row.items()), flush=True)
        file.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
