"""Trials of a campaign's group side by side in lanes (`hil.inject.in_lanes`): what a worker has before it at once."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

from hil.inject.heard import Heard, hear
from hil.inject.in_lanes import can, margins_in_lanes
from hil.inject.injection import lacks
from hil.inject.on_lockstep import check_stages
from hil.inject.scenario import Scenario
from plant import Model
from vaneloop.base.errors import InputError
from vaneloop.fleet.plan import Group, Varied, base_model, group_machine, model_of, scenario_of, values_at

if TYPE_CHECKING:
    from controller import Calibration
    from hil.inject.margin import Margin
    from plant import Plant

__all__ = ["Alone", "in_lanes"]


@dataclass(frozen=True)
class Alone:
    """Why a trial is run alone, on the lockstep bus."""

    why: str


@dataclass(frozen=True)
class _Prepared:
    """What the trials of a group have in common."""

    scenario: Scenario
    plant: Plant
    calibration: Calibration
    base: Model | None
    heard: Heard


def in_lanes(
    files: dict[str, str], g: Group, quantities: list[Varied], points: Sequence[list[float]]
) -> list[list[Margin] | Alone]:
    """Margins of a group's scenario on the machine of each point; or why it is to be run alone."""
    of = _prepared(tuple(sorted(files.items())), g)
    if isinstance(of, Alone):
        return [of] * len(points)
    plants: dict[int, Plant] = {}
    for i, point in enumerate(points):
        with suppress(InputError):  # alone, it says what is wrong
            plants[i] = model_of(quantities, values_at(quantities, point), of.base).plant(of.plant)
    fit = [i for i, plant in plants.items() if can(of.scenario, plant, of.calibration)]
    found = margins_in_lanes(of.scenario, [plants[i] for i in fit], of.calibration, of.heard)
    out: list[list[Margin] | Alone] = [Alone("the machine has what lanes do not have")] * len(points)
    for i, margins in zip(fit, found, strict=True):
        out[i] = margins
    return out


@lru_cache(maxsize=4)
def _prepared(files: tuple[tuple[str, str], ...], g: Group) -> _Prepared | Alone:
    """What a group's trials have in common, worked out once; or why they are run alone."""
    named = dict(files)
    machine = group_machine(named, g, Model())
    plant, calibration, scenario = machine.plant, machine.calibration, scenario_of(named, g)
    if machine.controller is not None:
        return Alone("a controller of the user's own")
    if why := lacks(scenario, plant, calibration):
        raise InputError(f"{g.scenario}: {why}")
    check_stages(g.scenario, scenario, plant)
    if not can(scenario, plant, calibration):
        return Alone("lanes have no such actuator, strategy or effect")
    heard = hear(scenario, plant)
    if isinstance(heard, str):
        return Alone(heard)
    return _Prepared(scenario, plant, calibration, base_model(named, plant), heard)
