"""Options of ``vaneloop run`` that let tools attend to the controller: XCP for calibration."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from vaneloop.cli import station

__all__ = ["accepted", "add_service_options", "attend", "check_service_options", "wanted"]


def add_service_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    group = parser.add_argument_group("tools on the bus")
    group.add_argument("--xcp", action="store_true", help="answer calibration tools: XCP on CAN (docs/xcp.md)")
    group.add_argument(
        "--xcp-save", metavar="DIR", help="folder into which a tool may save the working page, for --tables"
    )
    group.add_argument("--xcp-lock", action="store_true", help="calibration and measurement need seed and key")


def wanted(args: argparse.Namespace) -> bool:
    """Whether a tool may attend."""
    return bool(args.xcp)


def check_service_options(args: argparse.Namespace, lockstep: bool) -> None:
    """Refuse options that do not go together. Raises InputError."""
    from vaneloop.base.errors import InputError

    for option in ("xcp_save", "xcp_lock"):
        if getattr(args, option) and not args.xcp:
            raise InputError(f"--{option.replace('_', '-')} belongs to --xcp")
    if lockstep and wanted(args) and not args.inputs:
        raise InputError("--xcp needs a bus that a tool can join: vcan0, local; --bus lockstep is within one process")
    if args.xcp_save and Path(args.xcp_save).exists() and not Path(args.xcp_save).is_dir():
        raise InputError(f"--xcp-save {args.xcp_save}: is a file; a folder is needed")


def accepted(args: argparse.Namespace) -> list[dict[str, int]]:
    """The acceptance filters: the node's, and those of its tools."""
    from hil.calibrate.station import MASTER

    return [*station.ACCEPTED, *([{"can_id": MASTER, "can_mask": 0x7FF}] if args.xcp else [])]


def attend(args: argparse.Namespace, node: Any) -> Any:
    """The node with what answers its tools; the node itself where none may come."""
    if not wanted(args):
        return node
    import numpy as np

    from hil.calibrate import Attended, Memory, Slave
    from hil.calibrate.a2l import a2l_of
    from hil.calibrate.daq import gather
    from hil.calibrate.station import MASTER, SLAVE, XcpService

    memory = Memory(node)
    gather(memory.raw, np.zeros((0, 4), np.int64), np.zeros((0, 2), np.int64), 0)  # compiles now, not in a tick
    slave = Slave(
        memory,
        ident=SLAVE,
        a2l=lambda: a2l_of(memory, master=MASTER, slave=SLAVE),
        save=Path(args.xcp_save) if args.xcp_save else None,
        locked=("cal", "daq") if args.xcp_lock else (),
    )
    return Attended(node, XcpService(slave))
