"""``vaneloop fuzz``: the safety campaign on the command line."""

from __future__ import annotations

import argparse

import numpy as np

from controller import MODES
from hil.inject import fuzz_tools
from hil.inject.fuzz import (
    CLAIMS,
    HELD,
    KINDS,
    RECOVERY,
    Campaign,
    fuzz,
    read_attack,
    run_attack,
    watched_ticks,
    write_attack,
    write_frames,
)
from vaneloop.base import terminal
from vaneloop.base.compiled import is_cached
from vaneloop.base.errors import InputError
from vaneloop.base.extras import needs
from vaneloop.cli import options

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Safety campaign: random and mutated frames against controller and plant in simulated time.

In every tick: current and stroke demand within their limits, state finite, only the mode transitions of
docs/controller.md; after every attack RUN must return on good frames. A failure is shrunk to the fewest frames and
written as a candump log that --replay runs again.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of ``vaneloop fuzz``."""
    parser.add_argument(
        "--frames", type=int, default=1_000_000, metavar="N", help="random and mutated frames (default 1,000,000)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="S", help="the same seed gives the same frames (default 0)"
    )
    parser.add_argument(
        "--out",
        default="fuzz_failure.log",
        metavar="F",
        help="candump log if something fails: of the fewest frames, with --tool of the episode",
    )
    parser.add_argument("--replay", metavar="F", help="run this candump log from switch-on instead of random frames")
    parser.add_argument(
        "--tool",
        choices=("xcp", "uds", "both"),
        help="hostile commands of a tool instead: XCP (docs/xcp.md), UDS (docs/uds.md), sequences of both by rules",
    )
    parser.add_argument(
        "--current-limit",
        type=float,
        metavar="mA",
        help="what the current must not exceed (default: the calibration's limit)",
    )
    parser.add_argument(
        "--stroke-limit",
        type=float,
        metavar="mm",
        help="what the stroke demand must not exceed (default: the calibration's)",
    )
    parser.add_argument(
        "--recovery",
        type=float,
        metavar="S",
        help=f"s within which RUN must be back (default {RECOVERY * 1e-3:g}; with --tool 8: its session ends first)",
    )
    options.add_machine_options(parser)
    options.add_controller_options(parser)
    parser.epilog = """examples:
  vaneloop fuzz --frames 10000000 --seed 1 --out fuzz_failure.log
  vaneloop fuzz --replay fuzz_failure.log
  vaneloop fuzz --tool xcp --frames 100000
  vaneloop fuzz --tool both --frames 100000

exit codes: 0 everything held, 1 something did not, 2 bad input"""
    terminal.add_output_options(parser)


@options.guarded
def command(args: argparse.Namespace) -> int:
    """Run ``vaneloop fuzz``."""
    if args.frames < 1:
        raise InputError(f"--frames (={args.frames}) must be at least 1")
    if not 0 <= args.seed < 2**63:
        raise InputError(f"--seed (={args.seed}) must be 0 to 2^63 - 1")
    if args.recovery is not None and not 0.01 <= args.recovery <= 3600:
        raise InputError(f"--recovery (={args.recovery:g}) must be 0.01 to 3600 s")
    for option, unit in (("current_limit", "mA"), ("stroke_limit", "mm")):
        value = getattr(args, option)
        if value is not None and not 0 < value <= 1000:
            raise InputError(f"--{option.replace('_', '-')} (={value:g}) must be above 0, at most 1000 {unit}")
    if args.tool:
        return _tool(args)
    machine = options.machine_of(args)
    k = machine.calibration.scalars
    limits = np.array([k.current_limit, k.stroke_min, k.stroke_max])
    if args.current_limit is not None:
        limits[0] = args.current_limit * 1e-3
    if args.stroke_limit is not None:
        limits[2] = args.stroke_limit * 1e-3
    recovery = RECOVERY if args.recovery is None else round(args.recovery * 1e3)
    if not is_cached(watched_ticks):
        terminal.say(args, "compiling the simulator for this machine (once, about 20 s) ...")
    if args.replay:
        attack = read_attack(args.replay)
        claim, tick, took = run_attack(attack, limits, recovery, machine.plant, machine.calibration)
        held = claim == CLAIMS[HELD]
        said = (
            f"everything held; RUN {took:.3f} s after the last frame"
            if held
            else f"FAILED: {claim}, at {tick * 1e-3:.3f} s"
        )
        terminal.say(args, f"{args.replay}: {len(attack.at)} frames: {said}")
        terminal.write_json(
            args,
            {"schema": 1, "log": args.replay, "frames": len(attack.at), "held": held, "claim": claim, "t": tick * 1e-3},
        )
        return 0 if held else 1
    with terminal.progress_bar(args, "frames") as progress:
        campaign = fuzz(
            args.frames, args.seed, limits=limits, recovery=recovery, progress=progress,
            plant=machine.plant, calibration=machine.calibration,
        )  # fmt: skip
    _tell(args, campaign)
    if campaign.failure is not None:
        n = len(campaign.failure.attack.at)
        terminal.say(
            args,
            f"FAILED: {campaign.failure.claim}, in episode {campaign.failure.episode}; {n} frames show it: {args.out}",
        )
        write_attack(args.out, campaign.failure.attack)
    return 0 if campaign.failure is None else 1


def _tool(args: argparse.Namespace) -> int:
    """The campaign against what answers tools."""
    for option in ("replay", "model", "tables", "plant", "controller"):
        if getattr(args, option, None):
            raise InputError(f"--{option} is not for --tool")
    if args.tool != "xcp":
        needs(f"--tool {args.tool}", "isotp")
    with terminal.progress_bar(args, "frames") as progress:
        c = fuzz_tools.fuzz_tools(
            args.tool, args.frames, args.seed, progress,
            limits=np.array([args.current_limit or np.inf, args.stroke_limit or np.inf]) * 1e-3,
            recovery=fuzz_tools.RECOVERY if args.recovery is None else round(args.recovery * 1e3),
        )  # fmt: skip
    terminal.say(args, f"{c.frames:,} frames in {c.episodes:,} episodes, {c.ticks * 1e-3:,.0f} simulated s")
    terminal.say(args, f"the process has grown by {c.grown:.1f} MB since its first episodes")
    terminal.say(args, f"FAILED: {c.failure}" if c.failure else "held: limits, monitors, memory, recovery to RUN")
    if c.failure:
        write_frames(args.out, c.sent)
        terminal.say(args, f"the {len(c.sent)} frames of the episode: {args.out}; --seed {args.seed} repeats it")
    terminal.write_json(
        args, {"schema": 1, "tool": c.protocol, "seed": c.seed, "frames": c.frames, "episodes": c.episodes,
               "simulated_s": c.ticks * 1e-3, "answers": c.answers, "grown_mb": c.grown, "held": not c.failure,
               "failure": c.failure, "log": args.out if c.failure else None},
    )  # fmt: skip
    return 1 if c.failure else 0


def _tell(args: argparse.Namespace, c: Campaign) -> None:
    """Say what the campaign saw."""
    transitions = {
        f"{a} -> {b}": int(c.transitions[i, j])
        for i, a in enumerate(MODES)
        for j, b in enumerate(MODES)
        if c.transitions[i, j]
    }
    rate = c.frames / c.elapsed_s if c.elapsed_s else 0.0
    terminal.say(
        args,
        f"{c.frames:,} frames in {c.episodes:,} episodes, {c.ticks * 1e-3:,.0f} simulated s, {c.elapsed_s:.1f} s "
        f"({rate:,.0f}/s)",
    )
    rows = [[name, f"{count:,}"] for name, count in zip(KINDS, c.kinds.tolist(), strict=True)]
    terminal.print_table(args, "frames sent, by kind", ["kind", "frames"], rows)
    terminal.print_table(args, "what the receiver made of them, good frames after each attack "
                               "included", ["verdict", "frames"],
                    [[name, f"{count:,}"] for name, count in c.verdicts.items()])  # fmt: skip
    terminal.print_table(
        args, "mode transitions", ["transition", "times"], [[name, f"{count:,}"] for name, count in transitions.items()]
    )
    if c.failure is None:
        terminal.say(args, f"held: limits, transitions, recovery to RUN (longest {c.longest_recovery_s:.3f} s)")
    f = c.failure
    terminal.write_json(
        args,
        {
            "schema": 1, "seed": c.seed, "frames": c.frames, "episodes": c.episodes, "simulated_s": c.ticks * 1e-3,
            "elapsed_s": c.elapsed_s, "held": f is None, "longest_recovery_s": c.longest_recovery_s,
            "transitions": transitions,
            "seconds_in_mode": {name: c.ticks_in[i] * 1e-3 for i, name in enumerate(MODES)},
            "kinds": dict(zip(KINDS, c.kinds.tolist(), strict=True)), "verdicts": c.verdicts,
            "failure": None if f is None
            else {"claim": f.claim, "t": f.tick * 1e-3, "episode": f.episode, "frames": len(f.attack.at),
            "log": args.out},
        },
    )  # fmt: skip
