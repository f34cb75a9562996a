"""``vaneloop export-fmu``: plant, controller or their loop as an FMU for other simulators."""

from __future__ import annotations

import argparse
from collections import Counter

from controller.calibration import CalibrationTable
from hil.fmu import is_made, write_fmu
from hil.fmu.variables import FIXED, INPUT, OUTPUT, TUNABLE
from vaneloop.base import terminal
from vaneloop.base.tables import read
from vaneloop.cli import options

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Write the plant, the controller or their closed loop as an FMU (Functional Mock-up Unit) for
co-simulation, which Simulink, Dymola, CANoe, FMPy and others run. It needs no Python: its tick is C code made from
the functions that run here, and gives the same bits. The archive holds the source, too. All effects are in it, set as
--model says, and every parameter can be changed (docs/fmu.md). gcc builds it.

examples:
  vaneloop export-fmu --part loop --out loop.fmu
  vaneloop export-fmu --part plant --model M.toml --out plant.fmu
  vaneloop export-fmu --part controller --strategy adaptive --fmi 2.0 --out controller.fmu

exit codes: 0 written, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--part", metavar="P", required=True, help="plant, controller or loop")
    parser.add_argument("--out", metavar="F.fmu", required=True, help="file to write")
    parser.add_argument("--fmi", metavar="V", default="3.0", help="version of FMI: 3.0 (default) or 2.0")
    parser.add_argument("--strategy", metavar="S", help="control strategy: single, dual, inverse or adaptive")
    options.add_machine_options(parser)
    terminal.add_output_options(parser)


def command(args: argparse.Namespace) -> int:
    """Write the FMU; return the exit code."""
    machine = options.machine_of(args, strategy=args.strategy)
    if not is_made(args.part, machine.plant, machine.calibration):
        terminal.say(args, "making the source for such a machine (once, about a minute) ...")
    table = read(machine.files["calibration"], CalibrationTable)
    made = write_fmu(args.out, args.part, machine.plant, machine.calibration, table, machine.added, version=args.fmi)
    roles = Counter(v.role for v in made.variables)
    what = f"{roles[INPUT]} inputs, {roles[OUTPUT]} outputs"
    parameters = roles[FIXED] + roles[TUNABLE]
    terminal.say(args, f"{made.path}: {made.part}, FMI {made.version}, co-simulation, {what}, {parameters} parameters")
    terminal.write_json(args, {
        "schema": 1, "path": made.path, "part": made.part, "fmi": made.version, "token": made.token, "inputs":
        roles[INPUT], "outputs": roles[OUTPUT], "parameters": parameters,
    })  # fmt: skip
    return 0
