"""What the commands of the search for missing physics share: the log as stages, the model file."""

from __future__ import annotations

import argparse
from typing import Any

from hil import cli

__all__ = ["add_model_option", "chain_of", "machine_of"]


def add_model_option(parser: argparse.ArgumentParser) -> None:
    """Declare ``--model``."""
    parser.add_argument("--model", metavar="M.toml", help="model file: changed parameters and added effects (written by vaneloop extend)")


def machine_of(args: argparse.Namespace) -> tuple[Any, Any, Any]:
    """Return (model or None, plant, calibration) that ``--model`` describes."""
    from plant.model import load_model

    from controller import load_calibration
    from plant import build_plant

    if not args.model:
        return None, build_plant(), load_calibration()
    model = load_model(args.model)
    from hil.lockstep import calibration_of

    return model, model.plant(), calibration_of(load_calibration(), model)


def chain_of(args: argparse.Namespace) -> Any:
    """Read the log that ``args`` name and put it into stages."""
    from discrepancy.adapter import build_chain
    from hil.lockstep import warm_up

    model, plant, calibration = machine_of(args)
    log = cli.read_log_of(args, require=())
    warm_up(lambda text: cli.say(args, text))
    present = tuple(model.effects) if model is not None else ()
    chain = build_chain(log, plant, calibration, present)
    for note in chain.notes:
        cli.say(args, f"note: {note}")
    if not chain.stages:
        from hil.logs import LogError

        why = "; ".join(f"{k}: {v}" for k, v in chain.not_observed.items())
        raise LogError(f"{args.log}: no stage can be judged ({why})")
    return chain
