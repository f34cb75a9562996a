"""``vaneloop``: one verb, one function, one command. Each command's module is imported only when it is used."""

from __future__ import annotations

import importlib
import os
import sys

from vaneloop.base import terminal
from vaneloop.base.errors import meant

__all__ = ["COMMANDS", "GROUPS", "IN_CHECKOUT", "main", "run"]

# group -> command -> (module with add_options, command and DESCRIPTION; one line of help)
GROUPS = {
    "find what a model lacks": {
        "compare": (
            "vaneloop.cli.compare",
            "the model against a log: the whole loop, and each subsystem on its own logged inputs",
        ),
        "locate": ("vaneloop.cli.locate", "which subsystem fails, under which conditions, since when"),
        "diagnose": ("vaneloop.cli.diagnose", "which physical effects the model lacks, with probabilities and rivals"),
        "extend": ("vaneloop.cli.extend", "add effects to the model, fitted to a log; writes a model file"),
        "learn": ("vaneloop.cli.learn", "a law that the library does not have: where it acts, its curve, its formula"),
        "experiment": ("vaneloop.cli.experiment", "the demand profile that best separates the remaining rivals"),
        "map": ("vaneloop.cli.map", "which name of a log is which signal, guessed and shown; writes a mapping file"),
        "web": ("vaneloop.web.command", "the workbench in the browser: missing physics, schedule, run"),
    },
    "many engines": {
        "fleet": ("vaneloop.cli.fleet", "many engines, many logs: who lacks what, since when, how fast it grows"),
        "campaign": (
            "vaneloop.cli.campaign",
            "scenarios times tolerances, calibrations, firmwares: failure probability, margins, worst cases",
        ),
    },
    "run the firmware": {
        "replay": (
            "vaneloop.cli.replay",
            "run a logged engine run through firmware and plant; errors in figures and pictures",
        ),
        "engine-test": (
            "vaneloop.cli.engine_test",
            "a 3,000 s engine test under one mean curve and under dual curves, beside the paper's figures",
        ),
        "inject": (
            "vaneloop.cli.inject",
            "fault-injection scenarios: frames and faults on the bus, and whether the controller reacted as it must",
        ),
        "fuzz": (
            "vaneloop.cli.fuzz",
            "safety campaign: random and mutated frames by the million; limits, transitions, recovery must hold",
        ),
        "run": ("vaneloop.cli.run", "controller and plant as a node on the CAN bus, in real time or in lockstep"),
        "ecu": (
            "vaneloop.cli.ecu",
            "the engine control unit on the CAN bus: demand from a profile, a log or the keyboard",
        ),
        "record": (
            "vaneloop.cli.record",
            "all frames of a CAN bus into MDF4, BLF, candump or Parquet; survives kill -9",
        ),
    },
    "design the machine and its controller": {
        "schedule": (
            "vaneloop.cli.schedule",
            "links and stroke tables from geometry, schedules and a measured stroke-angle loop",
        ),
        "strategies": (
            "vaneloop.cli.strategies",
            "control strategies against each other on worn, hot, noisy engines: errors and cost",
        ),
        "design": (
            "vaneloop.cli.design",
            "servo loop: margins, step response, limit cycles, against the time simulation",
        ),
        "spatial": (
            "vaneloop.cli.spatial",
            "the planar linkage against the mechanism in space, by constraint equations",
        ),
        "clearance": ("vaneloop.cli.clearance", "the hysteresis traced to clearances of the joints, in millimetres"),
    },
    "work with other tools": {
        "new-controller": (
            "vaneloop.cli.new_controller",
            "a project of a controller of your own in C, which the other commands run with --controller",
        ),
        "a2l": ("vaneloop.cli.a2l", "the firmware's signals and calibration as an A2L file, for tools that speak XCP"),
        "export-fmu": ("vaneloop.cli.export_fmu", "plant, controller or their loop as an FMU for other simulators"),
        "completion": ("vaneloop.cli.completion", "completion of commands and options for bash, zsh and fish"),
    },
}
# command -> (module, one line of help), in the order of the help
COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}
# what was a command once -> the module of a checkout that it is now
IN_CHECKOUT = {
    "hidden-effect": "benchmarks.hidden_effect",
    "hidden-law": "benchmarks.hidden_law",
    "fleet demo": "benchmarks.fleet_demo",
}

_HELP = """\
For engineers whose model of a machine does not reproduce a log of the real one. VaneLoop estimates the size of the
error, the subsystem and the conditions in which it arises, and the physical effect that the model lacks. Add the
effect, and the error falls.

It ships with a complete example: the controller of a gas turbine's variable guide vanes, the hydraulics and linkage
that it moves, and the CAN bus to the engine's ECU. Models and firmware of your own work as well.

usage: vaneloop COMMAND [options]        vaneloop COMMAND --help explains a command

{commands}

first steps, in a checkout:
  vaneloop compare  examples/hidden_effect.parquet
  vaneloop locate   examples/hidden_effect.parquet
  vaneloop diagnose examples/hidden_effect.parquet --report diagnosis.html
  vaneloop extend   examples/hidden_effect.parquet --effect valve_dead_band --effect aero_load --out extended.toml
  vaneloop compare  examples/hidden_effect.parquet --model extended.toml
or in the browser, where the same log is among the examples: vaneloop web

exit codes: 0 good, 1 differs or a limit is exceeded, 2 bad input, 70 a defect of VaneLoop (VANELOOP_DEBUG=1 prints the
traceback)
""".format(
    commands="\n\n".join(
        "\n".join([f"{title}:", *(f"  {name:<16}{text}" for name, (_, text) in group.items())])
        for title, group in GROUPS.items()
    )
)


def main(argv: list[str]) -> int:
    """Run the command line ``argv`` (without the program's name); return the exit code."""
    return terminal.run(lambda: _main(argv))


def _main(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(_HELP)
        return 0 if argv else 2
    if argv[0] == "--version":
        from vaneloop.base.version import installed_version

        print(f"vaneloop {installed_version()}")
        return 0
    name = argv[0]
    if (gone := next((w for w in (name, " ".join(argv[:2])) if w in IN_CHECKOUT), None)) is not None:
        module = IN_CHECKOUT[gone]
        print(f"vaneloop: {gone!r} is not a command; in a checkout: python -m {module}", file=sys.stderr)
        return 2
    if name not in COMMANDS:
        near = meant(name, COMMANDS)
        print(f"vaneloop: {name!r} is not a command{near}; allowed: {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    # a command's imports take half a second, in which Ctrl-C may come, too
    return terminal.start(f"vaneloop {name}", lambda: importlib.import_module(COMMANDS[name][0]), argv[1:])


class _CanWithoutMdf:
    """python-can imports asammdf for a format that is read in another process here (`hil.logs.mdf`): 0.8 of its 0.9 s.
    In the process of a command it is told that there is none. Whoever else imports asammdf gets it.
    """

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        asks = sys.modules.get("can.io.mf4")
        if name == "asammdf" and getattr(getattr(asks, "__spec__", None), "_initializing", False):
            raise ImportError("not for python-can")


def run() -> None:
    """Entry point of the console script."""
    terminal.is_command = True
    # the matrices here are tall and narrow: a second thread of linear algebra spins more than it computes
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.meta_path.insert(0, _CanWithoutMdf())
    sys.exit(main(sys.argv[1:]))


if __name__ == "__main__":
    run()
