"""``vaneloop a2l``: the firmware's signals and calibration as an A2L file, for INCA, CANape or pyxcp."""

from __future__ import annotations

import argparse

from hil.calibrate import Memory
from hil.calibrate.a2l import a2l_of
from hil.calibrate.station import MASTER, SLAVE
from hil.loop.node import Node
from vaneloop.base import terminal
from vaneloop.base.files import write
from vaneloop.cli import options

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Write the A2L file of the firmware: addresses, units, bounds and groups of what a calibration tool may
measure and change, and how it connects (vaneloop run --xcp). The same file can be fetched over XCP (docs/xcp.md).

examples:
  vaneloop a2l --out vgv.a2l
  vaneloop a2l --out mine.a2l --controller ./my_controller.so

exit codes: 0 written, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", metavar="F.a2l", required=True, help="file to write")
    options.add_machine_options(parser)
    options.add_controller_options(parser)
    terminal.add_output_options(parser)


@options.guarded
def command(args: argparse.Namespace) -> int:
    """Write the file; return the exit code."""
    machine = options.machine_of(args)
    memory = Memory(Node(machine.plant, machine.calibration))
    text = a2l_of(memory, master=MASTER, slave=SLAVE)
    write(args.out, text)
    values = sum(not e.fixed for e in memory.elements)
    terminal.say(
        args,
        f"{args.out}: {len(memory.signals)} measurements, {values} calibration values, of them in curves "
        f"{sum(c.n for c in memory.curves)}; XCP on CAN, {MASTER:#x} to the controller, {SLAVE:#x} from it",
    )
    terminal.write_json(
        args, {"schema": 1, "file": args.out, "measurements": len(memory.signals), "values": values,
               "can": {"master": MASTER, "slave": SLAVE}},
    )  # fmt: skip
    return 0
