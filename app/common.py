"""What the commands of the search for missing physics share: the log as stages, the model file."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from hil import cli

__all__ = ["add_model_option", "chain_of", "say_located", "tell_search"]


def add_model_option(parser: argparse.ArgumentParser) -> None:
    """Declare ``--model``."""
    parser.add_argument("--model", metavar="M.toml", help="model file: changed parameters and added effects (written by vaneloop extend)")


def tell_search(say: Callable[[str], None]) -> None:
    """Tell the user that the first search compiles; silent when the compiled code is there already."""
    from plant.compiled import is_cached

    if not is_cached("stages.actuator_run"):
        say("compiling the stages of the search for this machine (once, about 30 s) ...")


def chain_of(args: argparse.Namespace, model: Any = None) -> Any:
    """Read the log that ``args`` name and put it into stages of the machine that ``model`` (default: ``args.model``) describes."""
    from discrepancy.adapter import build_chain
    from hil.lockstep import warm_up
    from hil.logs import LogError
    from plant import load_model

    if model is None and args.model:
        model = load_model(args.model, cli.machine_of(args))
    log = cli.read_log_of(args, require=())
    warm_up(lambda text: cli.say(args, text))
    tell_search(lambda text: cli.say(args, text))
    chain = build_chain(log, cli.machine_of(args, model), present=tuple(model.effects) if model is not None else ())
    for note in chain.notes:
        cli.say(args, f"note: {note}")
    if not chain.stages:
        why = "; ".join(f"{k}: {v}" for k, v in chain.not_observed.items())
        raise LogError(f"{args.log}: no stage can be judged ({why})")
    return chain


def say_located(args: argparse.Namespace, located: Any, most: int = 4) -> None:
    """Print where a stage (`discrepancy.locate.Located`) fails, under ``most`` conditions at most."""
    cli.say(args, f"{located.stage}: {located.verdict()}")
    if located.onset is not None:
        cli.say(args, f"  begins at t = {located.onset:.0f} s")
    for r in located.hot[:most]:
        cli.say(args, f"  {r.worst()}")
