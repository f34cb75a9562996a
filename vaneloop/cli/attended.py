"""Options of ``vaneloop run`` that let tools attend to the controller: XCP for calibration, UDS for service."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from hil.calibrate import Attended, Memory, Slave
from hil.calibrate.a2l import a2l_of
from hil.calibrate.daq import gather
from hil.calibrate.prepare import Desk, Outside
from hil.calibrate.station import MASTER, SLAVE, XcpService
from hil.uds import Server, TroubleMemory
from hil.uds.server import FUNCTIONAL, REQUEST
from vaneloop.base.errors import InputError
from vaneloop.base.extras import needs
from vaneloop.base.files import cannot_write, check, write
from vaneloop.cli import station

__all__ = ["accepted", "add_service_options", "attend", "check_service_options", "wanted"]


def add_service_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    group = parser.add_argument_group("tools on the bus")
    group.add_argument("--xcp", action="store_true", help="answer calibration tools: XCP on CAN (docs/xcp.md)")
    group.add_argument(
        "--xcp-save", metavar="DIR", help="folder into which a tool may save the working page, for --tables"
    )
    group.add_argument(
        "--xcp-open", action="store_true", help="calibration and STIM need no seed and key, as they do without this"
    )
    group.add_argument("--xcp-lock", action="store_true", help="measurement needs seed and key too")
    group.add_argument("--uds", action="store_true", help="answer service tools: UDS on ISO-TP (docs/uds.md)")
    group.add_argument("--uds-memory", metavar="F.json", help="file that keeps the trouble codes over a restart")
    group.add_argument(
        "--tool-seed", metavar="N", type=int, help="seeds of the locks follow from N (default: unpredictable)"
    )


def wanted(args: argparse.Namespace) -> bool:
    """Whether a tool may attend."""
    return bool(args.xcp or args.uds)


def check_service_options(args: argparse.Namespace, lockstep: bool) -> None:
    """Refuse options that do not go together. Raises InputError."""
    for option in ("xcp_save", "xcp_lock", "xcp_open"):
        if getattr(args, option) and not args.xcp:
            raise InputError(f"--{option.replace('_', '-')} belongs to --xcp")
    if args.xcp_lock and args.xcp_open:
        raise InputError("--xcp-lock and --xcp-open exclude each other")
    if args.tool_seed is not None:
        if not wanted(args):
            raise InputError("--tool-seed belongs to --xcp and --uds")
        if not 0 <= args.tool_seed < 2**63:
            raise InputError(f"--tool-seed (={args.tool_seed}) must be 0 to 2^63 - 1")
    if args.uds_memory and not args.uds:
        raise InputError("--uds-memory belongs to --uds")
    if args.uds:
        needs("--uds", "isotp")
    if lockstep and wanted(args) and not args.inputs:
        option = "--xcp" if args.xcp else "--uds"
        raise InputError(
            f"{option} needs a bus that a tool can join: vcan0, local; --bus lockstep is within one process"
        )
    if args.xcp_save and Path(args.xcp_save).exists() and not Path(args.xcp_save).is_dir():
        raise InputError(f"--xcp-save {args.xcp_save}: is a file; a folder is needed")


def accepted(args: argparse.Namespace) -> list[dict[str, int]]:
    """The acceptance filters: the node's, and those of its tools."""
    idents: list[int] = []
    if args.xcp:
        idents.append(MASTER)
    if args.uds:
        idents += [REQUEST, FUNCTIONAL]
    return [*station.ACCEPTED, *({"can_id": ident, "can_mask": 0x7FF} for ident in idents)]


def attend(args: argparse.Namespace, node: Any, *, recorded: bool = False) -> Any:
    """The node with what answers its tools; the node itself where none may come.

    recorded  it gets the frames of a record, in simulated time
    """
    if not wanted(args):
        return node
    memory = Memory(node)
    if not recorded:
        memory.desk = Desk(Outside(memory.elements))
    services: list[Any] = []
    if args.uds:
        services.append(_uds(args, memory))
    if not args.xcp:
        return Attended(node, *services, told=True)
    gather(memory.raw, np.zeros((0, 4), np.int64), np.zeros((0, 2), np.int64), 0)  # compiles now, not in a tick
    text = a2l_of(memory, master=MASTER, slave=SLAVE)  # written now: it takes longer than a tick
    slave = Slave(
        memory,
        ident=SLAVE,
        a2l=lambda: text,
        save=Path(args.xcp_save) if args.xcp_save else None,
        locked=() if args.xcp_open else ("cal", "stim", "daq") if args.xcp_lock else ("cal", "stim"),
        seed=args.tool_seed,
    )
    return Attended(node, XcpService(slave), *services, told=True)


def _uds(args: argparse.Namespace, memory: Any) -> Any:
    """The UDS server, with the trouble codes of ``--uds-memory``."""
    from hil.uds.station import UdsService

    if not args.uds_memory:
        return UdsService(Server(memory, seed=args.tool_seed))
    file = Path(args.uds_memory)
    trouble = TroubleMemory.load(file)
    keeper = _Keeper(file)
    keeper(trouble.dump())
    return UdsService(Server(memory, trouble, store=keeper, seed=args.tool_seed))


class _Keeper:
    """Writes the latest text into a file, on a thread of its own: a disk may be slow, a tick may not."""

    def __init__(self, file: Path):
        self._file, self._text = file, ""
        self._wake = threading.Event()
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            raise InputError(cannot_write(f"--uds-memory {file}", e)) from None
        check(file)
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()
        atexit.register(self._now)

    def __call__(self, text: str) -> None:
        self._text = text
        self._wake.set()

    def _write(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            self._now()
            time.sleep(0.1)

    def _now(self) -> None:
        with contextlib.suppress(InputError):
            write(self._file, self._text)
