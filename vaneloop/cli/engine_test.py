"""The paper's engine test: more than 3,000 s with rises and falls, under the single mean curve and under the dual
curves.
"""

from __future__ import annotations

import argparse
from typing import Any

from hil.engine_test import engine_test, load_profile
from hil.loop.lockstep import warm_up
from hil.replay import STATISTICS, ReplayResult, apart, replay_json
from plant import build_plant
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.cli import options
from vaneloop.pages.engine_test import PAPER_TABLE_5, engine_test_report

__all__ = ["DESCRIPTION", "add_options", "command"]


DESCRIPTION = """The paper's engine test in simulation: more than 3,000 s (30,000 samples at 10 Hz), several rises and
falls, 1.6 deg of hysteresis in the VIGV's linkage, under one mean stroke curve and under the dual curves, beside the
figures of the paper's Table 5.

--strategy adds further strategies to the table and the JSON; the page and the exit code are about the two.

examples:
  vaneloop engine-test --report engine_test.html
  vaneloop engine-test --strategy inverse --strategy adaptive
  vaneloop engine-test --profile tables/engine_test.toml --seed 7 --json -
  vaneloop schedule --geometry tables/geometry.toml --out engine7/
  vaneloop engine-test --tables engine7/ --geometry engine7/geometry.toml

exit codes: 0 the dual curves stay at or below the paper's figures, 1 they do not, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--profile",
        metavar="F.toml",
        default="engine_test.toml",
        help="speed demand (default: the shipped engine_test.toml)",
    )
    parser.add_argument(
        "--strategy",
        metavar="S",
        action="append",
        default=[],
        help="run this one too: inverse or adaptive (may be repeated)",
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the sensors' noise (default 1)")
    parser.add_argument(
        "--hysteresis", type=float, metavar="DEG", help="total width at the VIGV (default: the geometry's 1.6 deg)"
    )
    options.add_tables_option(parser)
    options.add_channels_option(parser)
    options.add_controller_options(parser)
    parser.add_argument(
        "--geometry",
        metavar="F.toml",
        help="the machine's own linkage where it is not what the tables were made for (default: theirs)",
    )
    terminal.add_output_options(parser, report=True)


@options.guarded
def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if args.hysteresis is not None and not 0.0 <= args.hysteresis <= 10.0:
        raise InputError(f"--hysteresis (={args.hysteresis:g} deg) must be in [0, 10]")
    if args.seed < 0:
        raise InputError(f"--seed (={args.seed}) must be 0 or more")
    n_dem = load_profile(args.profile)
    files = options.tables_of(args, tell=True)
    machine = build_plant(files["plant"], args.geometry or files["geometry"], files["schedules"])
    calibrations = {
        strategy: options.machine_of(args, strategy=strategy).calibration
        for strategy in ("single", "dual", *args.strategy)
    }
    warm_up(lambda text: terminal.say(args, text))
    results: dict[str, ReplayResult] = {}
    for strategy in calibrations:
        with terminal.progress_bar(args, f"engine test, {strategy}") as progress:
            results[strategy] = engine_test(
                n_dem, strategy, args.seed, args.hysteresis, progress, machine, calibrations[strategy]
            )
    rows: list[list[str]] = []
    for strategy, r in results.items():
        for s in r.signals:
            rows.append(
                [
                    f"{strategy}: {s.signal}",
                    *("-" if (v := getattr(s, k)) is None else f"{v:.3f}" for k in STATISTICS),
                    f"{s.samples:,}",
                ]
            )
    rows.append(["paper, dual: vigv", "-", *(f"{PAPER_TABLE_5[k]:.2f}" for k in STATISTICS[1:]), "over 30,000"])
    dual = results["dual"]
    title = (
        f"engine test: {dual.simulated_s:,.0f} s under each strategy, {dual.wall_s:.1f} s of computing; error of "
        f"the vane angles, deg"
    )
    terminal.print_table(args, title, ["curves", "rms", "mean", "max", "mean 99-100 %", "samples"], rows)
    vigv = dual.signals[0]
    exceeded = [
        f"dual vigv {k} {v:.3f} deg exceeds the paper's {PAPER_TABLE_5[k]:.2f} deg"
        for k in STATISTICS[1:]
        if (v := getattr(vigv, k)) is not None and v > PAPER_TABLE_5[k]
    ]
    for strategy, r in results.items():
        for note in apart(r.model):
            terminal.say(args, f"{strategy}: {note}")
    for line in exceeded:
        terminal.say(args, f"exceeded: {line}")
    out: dict[str, Any] = {
        "schema": 1,
        "paper": PAPER_TABLE_5,
        **{k: replay_json(r) for k, r in results.items()},
        "exceeded": exceeded,
    }
    terminal.write_json(args, out)
    if args.report:
        words = terminal.typed("engine-test")
        page = engine_test_report(results["single"], dual, PAPER_TABLE_5, args.report, command=words)
        terminal.say(args, f"page: {page}")
    return 1 if exceeded else 0
