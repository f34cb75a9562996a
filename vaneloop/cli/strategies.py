"""``vaneloop strategies``: control strategies side by side on the command line."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

from controller import STRATEGIES
from hil.engine_test import load_profile
from hil.loop.lockstep import warm_up
from plant import build_plant
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.cli import options
from vaneloop.design.strategies import (
    FAILURES,
    FIGURES,
    Array,
    Failure,
    Outcome,
    Outcomes,
    failing,
    judged,
    moments,
    run,
    scenarios,
)
from vaneloop.pages.strategies import report

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Compare the control strategies on the same engine run: single (one mean curve), dual (one curve a
direction, the paper's), inverse (follows the backlash and crosses it when the vanes must turn round), adaptive (the
same, and learns backlash and offset from the stem potentiometers). Six machines: nominal, worn, with thermal growth,
dithered near 99 to 100 %, noisy, and all of it together; then the potentiometers fail in the middle of the last one.
docs/strategies.md explains the strategies.

examples:
  vaneloop strategies --report strategies.html
  vaneloop strategies --play 2.0 --growth 0.3 --json -
  vaneloop schedule --geometry tables/geometry.toml --out engine7/
  vaneloop strategies --tables engine7/ --seed 7

exit codes: 0 all goals are met, 1 one is missed, 2 bad input"""

_OPTIONS = {  # name -> default, low, high, unit, meaning
    "play": (2.4, 0.0, 5.0, "deg", "total backlash of the worn VIGV; the other vane rows' in proportion"),
    "growth": (0.5, -2.0, 2.0, "deg", "turn of all vanes by the casing's heat at full speed"),
    "noise": (3.0, 0.0, 20.0, "X", "factor on the noise of all sensors"),
    "dither": (0.15, 0.0, 1.0, "%", "amplitude of the demand's dither between 99 and 100 %%"),
    "dwell": (0.25, 0.01, 10.0, "SHARE", "share of the profile's dwells that is run; 1 is the whole engine test"),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--profile", metavar="F.toml", default="engine_test.toml", help="speed demand (default: the engine test's)"
    )
    for name, (default, _, _, unit, text) in _OPTIONS.items():
        meta = unit.replace("%", "PCT").upper()
        parser.add_argument(
            f"--{name}", type=float, metavar=meta, default=default, help=f"{text} (default {default:g})"
        )
    options.add_tables_option(parser)
    options.add_controller_options(parser)
    parser.add_argument("--seed", type=int, default=1, help="seed of the sensors' noise (default 1)")
    terminal.add_output_options(parser, report=True)


def _checked(args: argparse.Namespace) -> None:
    for name, (_, low, high, unit, _) in _OPTIONS.items():
        v = getattr(args, name)
        if not low <= v <= high:
            raise InputError(
                f"--{name} (={v:g}{'' if unit in ('X', 'SHARE') else ' ' + unit}) must be in [{low:g}, {high:g}]"
            )
    if args.seed < 0:
        raise InputError(f"--seed (={args.seed}) must be 0 or more")


@options.guarded
def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    _checked(args)
    files = options.tables_of(args)
    plant = build_plant(files["plant"], files["geometry"], files["schedules"])
    calibrations = {s: options.machine_of(args, strategy=s).calibration for s in STRATEGIES}
    n_dem = load_profile(args.profile, args.dwell)
    rows = scenarios(args.play, args.growth, args.noise, args.dither)
    warm_up(lambda text: terminal.say(args, text))
    tried = [(name, during) for during in moments(n_dem) for name in FAILURES]
    failures: list[tuple[Failure, Outcome]] = []
    work = len(rows) * len(STRATEGIES) + len(tried)
    with terminal.progress_bar(args, f"{work} runs of {len(n_dem) * 1e-2:,.0f} s") as progress:
        done = 0

        def counted(results: Iterator[Any]) -> Iterator[Any]:
            nonlocal done
            for result in results:
                done += 1
                if progress is not None:
                    progress(done / work)
                yield result

        last, adaptive = rows[-1], calibrations["adaptive"]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            pairs = [(row, strategy) for row in rows for strategy in STRATEGIES]
            all_runs = pool.map(lambda p: run(p[0], n_dem, calibrations[p[1]], args.seed, base=plant), pairs)
            outcomes = {(o.scenario, o.strategy): o for o in counted(all_runs)}
            healthy, dual = (outcomes[last.name, s] for s in ("adaptive", "dual"))
            again = pool.map(
                lambda f: failing(f[0], f[1], healthy, dual, last, n_dem, adaptive, args.seed, plant), tried
            )
            failures = list(counted(again))
    best = min(STRATEGIES, key=lambda s: outcomes[last.name, s].figures["vigv"]["mean_abs"] or 0.0)
    goals = judged(rows, outcomes, [f for f, _ in failures], best)
    _print(args, n_dem, outcomes, [f for f, _ in failures], goals)
    for during, words in _MOMENTS.items():
        if not any(f.during == during for f, _ in failures):
            terminal.say(
                args, f"note: after its middle the profile never {words}; potentiometers failing then were not tried"
            )
    missed = [g for g in goals if not g["held"]]
    for g in missed:
        terminal.say(args, f"missed: {g['goal']}: {g['value']:.3g}, limit {g['limit']:.3g}")
    terminal.write_json(
        args,
        {
            "schema": 1, "simulated_s": len(n_dem) * 1e-2, "seed": args.seed, "best": best,
            "rows": [o.to_dict() for o in outcomes.values()], "failures": [asdict(f) for f, _ in failures],
            "goals": goals,
        },
    )  # fmt: skip
    if args.report:
        words = terminal.typed("strategies")
        page = report(args.report, rows, plant, outcomes, failures, goals, best, words)
        terminal.say(args, f"page: {page}")
    return 1 if missed else 0


_MOMENTS = {"at rest": "rests at 99 % or more for 15 s", "in motion": "moves at more than 3 %/s for 1 s with 10 s left"}


def _print(
    args: argparse.Namespace, n_dem: Array, outcomes: Outcomes, failures: list[Failure], goals: list[dict[str, Any]]
) -> None:
    rows: list[list[str]] = []
    stages = list(next(iter(outcomes.values())).figures)
    for (scenario, strategy), o in outcomes.items():
        angles = [" ".join("-" if (v := o.figures[s][k]) is None else f"{v:.3f}" for k in FIGURES) for s in o.figures]
        first = scenario if strategy == STRATEGIES[0] else ""
        rows.append([first, strategy, *angles, f"{o.travel:,.0f}", f"{o.reversals:,}", f"{o.current:.2f}"])
    title = (
        f"{len(n_dem) * 1e-2:,.0f} s under each strategy; error of the true angles, deg: mean, max, mean at 99 to "
        f"100 % speed"
    )
    terminal.print_table(
        args, title, ["machine", "strategy", *stages, "travel mm", "reversals", "current mA rms"], rows
    )
    if failures:
        when = {f.during: f.at for f in failures}
        text = [
            [f.during if i == 0 or failures[i - 1].during != f.during else "", f.failure, f"{f.step:.3f}",
            f"{f.departure:.3f}",
             f"{f.crossings}", f"{f.mean_abs:.3f}", f"{f.mean_abs_dual:.3f}"]
            for i, f in enumerate(failures)
        ]  # fmt: skip
        title = "adaptive, all together, all potentiometers failing " + " or ".join(
            f"{d} at {at:,.1f} s" for d, at in when.items()
        )
        columns = ["", "failure", "within 1 s deg", "in 10 s deg", "crossings", "mean VIGV error since", "of dual"]
        terminal.print_table(args, title, columns, text)
    held = sum(g["held"] for g in goals)
    terminal.say(
        args,
        f"goals met: {held} of {len(goals)}; {goals[0]['goal']}: {goals[0]['value']:.1f} (at least "
        f"{goals[0]['limit']:g})",
    )
