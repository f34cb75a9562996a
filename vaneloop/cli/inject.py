"""``vaneloop inject`` and ``python -m hil.inject``: scenarios of frame and fault injection, and what came of them."""

from __future__ import annotations

import argparse
from pathlib import Path
from xml.etree import ElementTree as Xml

from hil.inject.any_controller import SHIPPED, load_reactions
from hil.inject.injection import cannot, lacks, run
from hil.inject.scenario import library, load_scenario
from hil.inject.verdict import Outcome
from hil.loop.lockstep import warm_up
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.files import write
from vaneloop.cli import options

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Frame and fault injection: do to the bus what a scenario says, and judge whether the controller reacted
as it must.

examples:
  vaneloop inject --list                     what ships
  vaneloop inject demand_stops               one of them
  vaneloop inject --all --junit inject.xml   all of them, for continuous integration
  vaneloop inject MY_DAY.toml                your own (docs/injection.md)
  vaneloop inject --all --channels 2 --plant tables/plant_two_actuators.toml   those of two channels (docs/channels.md)
  vaneloop inject --all --controller FW.so --junit fw.xml   a controller of your own (docs/own_controller.md)
  vaneloop inject flood_low_priority --bus vcan0   against vaneloop run and vaneloop ecu, in real time

On lockstep (default) controller, ECU and bus run in simulated time, bit for bit the same every time. On another bus
only what an outsider can do is done (send, flood, babble, replay), and only what the controller's frames show is
judged.

exit codes: 0 every expectation held, 1 one did not, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "scenario", metavar="SCENARIO", nargs="*", help="scenario files (.toml), or names of shipped ones"
    )
    parser.add_argument("--all", action="store_true", help="all scenarios that ship")
    parser.add_argument("--list", action="store_true", help="list the scenarios that ship, and stop")
    parser.add_argument("--bus", default="lockstep", metavar="BUS", help="lockstep (default), local, vcan0, ...")
    parser.add_argument("--seed", type=int, metavar="N", help="instead of the scenario's own")
    options.add_machine_options(parser)
    options.add_channels_option(parser)
    options.add_controller_options(parser)
    parser.add_argument(
        "--reactions",
        metavar="F.toml",
        help="limits and fail-safe times that count for any controller, instead of the scenarios' own claims; with "
        "--controller the shipped any_controller.toml is the default",
    )
    terminal.add_output_options(parser)
    parser.add_argument("--junit", metavar="FILE", help="write the result as JUnit XML, one test case a scenario")


def command(args: argparse.Namespace) -> int:
    """Run what ``args`` ask for; return the exit code."""
    known = library(args.channels or 1)
    if args.list:
        return _list(args, known)
    if bool(args.scenario) == args.all:
        raise InputError("give the scenarios to run, or --all (vaneloop inject --list shows those that ship)")
    if args.seed is not None and args.seed < 0:
        raise InputError(f"--seed {args.seed} must be 0 or more")
    named = list(known) if args.all else args.scenario
    made = [(Path(n).stem, load_scenario(n)) for n in named]
    if args.seed is not None:
        made = [(n, s.model_copy(update={"seed": args.seed})) for n, s in made]
    if args.bus != "lockstep" and (
        given := [f"--{n}" for n in ("model", "tables", "plant", "channels") if vars(args)[n]]
    ):
        raise InputError(
            f"{given[0]} is for --bus lockstep; on {args.bus} the machine is vaneloop run's: give it there"
        )
    machine = options.machine_of(args)
    if args.bus == "lockstep":
        warm_up(lambda text: terminal.say(args, text))
    if args.bus != "lockstep" and (args.controller or args.reactions):
        raise InputError(f"--controller and --reactions are for --bus lockstep; on {args.bus} give vaneloop run yours")
    if args.save_crash is not None and (args.controller is None or not args.save_crash.endswith(".parquet")):
        raise InputError(f"--save-crash {args.save_crash}: must end with .parquet, and needs --controller")
    reactions = None
    if args.controller or args.reactions:
        reactions = load_reactions(args.reactions or SHIPPED)
    outcomes, skipped = [], []
    with terminal.progress_bar(args, "injecting") as progress:
        for i, (name, scenario) in enumerate(made):
            why = cannot(scenario) if args.bus != "lockstep" else lacks(scenario, machine.plant, machine.calibration)
            if why and len(made) > 1:
                skipped.append((name, scenario.title, why))
                continue

            def share(fraction: float, i: int = i) -> None:
                if progress is not None:
                    progress((i + fraction) / len(made))

            told = share if progress is not None else None
            outcomes.append(
                run(
                    scenario,
                    bus=args.bus,
                    plant=machine.plant,
                    calibration=machine.calibration,
                    name=name,
                    progress=told,
                    reactions=reactions,
                    save_crash=args.save_crash and _crash_file(args.save_crash, name, len(made) > 1),
                )
            )
    _report(args, outcomes, skipped)
    return 0 if all(o.held for o in outcomes) else 1


def _crash_file(file: str, name: str, several: bool) -> str:
    """Name of a scenario's crash log."""
    return str(Path(file).with_name(f"{Path(file).stem}_{name}.parquet")) if several else file


def _list(args: argparse.Namespace, known: dict[str, Path]) -> int:
    scenarios = {n: load_scenario(n) for n in known}
    rows = [[n, s.title, f"{s.duration:g} s", "any" if not cannot(s) else "lockstep"] for n, s in scenarios.items()]
    terminal.print_table(
        args, f"{len(rows)} scenarios ship with VaneLoop", ["name", "what happens", "lasts", "bus"], rows
    )
    terminal.write_json(
        args,
        {
            "schema": 1,
            "scenarios": [{"name": n, "title": s.title, "duration_s": s.duration} for n, s in scenarios.items()],
        },
    )
    return 0


MARK = {True: "held", False: "BROKEN", None: "not seen"}


def _report(args: argparse.Namespace, outcomes: list[Outcome], skipped: list[tuple[str, str, str]]) -> None:
    if len(outcomes) == 1:
        o = outcomes[0]
        terminal.print_table(
            args,
            f"{o.name} on {o.bus}: {o.title}",
            ["", "expected", "seen", "because"],
            [[MARK[c.held], c.expected, c.seen, c.because] for c in o.checks],
        )
        terminal.say(args, "modes: " + ", ".join(f"{m} {t:.3f} s" for t, m in o.modes))
        terminal.say(args, "faults: " + (", ".join(f"{f} {t:.3f} s" for t, f in o.faults) or "none"))
    elif outcomes:
        rows = [
            [
                o.name,
                MARK[o.held],
                o.title,
                " > ".join(m for _, m in o.modes[-4:]),
                f"{sum(c.held is True for c in o.checks)} of {len(o.checks)}",
            ]
            for o in outcomes
        ]
        terminal.print_table(
            args,
            f"{len(outcomes)} scenarios on {outcomes[0].bus}",
            ["scenario", "", "what happens", "last modes", "held"],
            rows,
        )
        for o in outcomes:
            for c in o.checks:
                if c.held is False:
                    terminal.say(args, f"broken: {o.name}: {c.expected}; seen: {c.seen}")
    for o in outcomes:
        for note in o.notes:
            terminal.say(args, f"note: {o.name}: {note}")
    for name, _, why in skipped:
        terminal.say(args, f"skipped: {name}: {why}")
    held = sum(o.held for o in outcomes)
    seconds = sum(o.simulated_s for o in outcomes), sum(o.wall_s for o in outcomes)
    terminal.say(args, f"{held} of {len(outcomes)} scenarios held ({seconds[0]:.0f} s simulated in {seconds[1]:.1f} s)")
    data = {"schema": 1, "bus": args.bus, "held": held == len(outcomes), "scenarios": [o.json() for o in outcomes]}
    terminal.write_json(args, data | {"skipped": [{"name": n, "reason": w} for n, _, w in skipped]})
    if args.junit:
        _write_junit(args.junit, outcomes, skipped)


def _write_junit(file: str, outcomes: list[Outcome], skipped: list[tuple[str, str, str]]) -> None:
    """Write JUnit's XML: a test case a scenario, its claims in the failure's text."""
    broken = sum(not o.held for o in outcomes)
    numbers = {"tests": len(outcomes) + len(skipped), "failures": broken, "errors": 0, "skipped": len(skipped)}
    seconds = f"{sum(o.wall_s for o in outcomes):.3f}"
    suite = Xml.Element(
        "testsuite", {"name": "vaneloop inject", "time": seconds, **{k: str(v) for k, v in numbers.items()}}
    )
    for o in outcomes:
        case = Xml.SubElement(
            suite, "testcase", classname=f"vaneloop.inject.{o.bus}", name=o.name, time=f"{o.wall_s:.3f}"
        )
        first = next((c for c in o.checks if c.held is False), None)
        if first is not None:
            Xml.SubElement(case, "failure", message=f"{first.expected}; seen: {first.seen}").text = o.text()
        Xml.SubElement(case, "system-out").text = o.text()
    for name, _, why in skipped:
        Xml.SubElement(
            Xml.SubElement(suite, "testcase", classname="vaneloop.inject", name=name, time="0"), "skipped", message=why
        )
    root = Xml.Element("testsuites")
    root.append(suite)
    Xml.indent(root)
    write(file, Xml.tostring(root, encoding="utf-8", xml_declaration=True))
