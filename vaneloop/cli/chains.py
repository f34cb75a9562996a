"""A log in the stages of the machine, as the commands that search want it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from hil.loop.lockstep import warm_up
from plant.stages import hydraulic_blocks, motor_blocks
from vaneloop.base import terminal
from vaneloop.base.compiled import is_cached
from vaneloop.cli import options
from vaneloop.verbs.parts import bind_parts, split

__all__ = ["chain_of", "tell_search"]


def tell_search(say: Callable[[str], None]) -> None:
    """Tell the user that the first search compiles; silent when the compiled code is there already."""
    if not (is_cached(hydraulic_blocks.run) or is_cached(motor_blocks.run)):
        say("compiling the subsystems of the search for this machine (once, about 30 s) ...")


def chain_of(args: argparse.Namespace, model: Any = None, loop: bool = False, alone: str = "") -> Any:
    """Read the log that ``args`` name and put it into stages of the machine that ``model`` (default: ``args.model``)
    describes.

    loop  the command simulates the whole loop, too: compiled first, where it is not
    alone what the command does that takes a machine with one actuator alone; "": it takes two
    """
    machine = options.machine_of(args, model)
    if alone:
        machine.plant.of_one_actuator(alone)
    if not loop:
        machine.calibration.of_one_channel("judging subsystems")
    own_parts = split([x for group in getattr(args, "fit", ()) for x in group], options.parts_to_test(args))[:2]
    log = options.read_log_of(args, require=())
    if loop:
        warm_up(lambda text: terminal.say(args, text))
    tell_search(lambda text: terminal.say(args, text))
    chain = bind_parts(machine, log, *own_parts)
    terminal.notes(args, chain.notes)
    return chain
