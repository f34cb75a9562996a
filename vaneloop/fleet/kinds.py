"""What a run may have done with each of its entries: a name in its run.json, and the function of ours behind it.

A run folder may come from somebody else, so it names a kind of this list, and no function.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StrictBool, ValidationError

from vaneloop.base.errors import InputError
from vaneloop.base.tables import Finite, Table

__all__ = ["DIAGNOSIS", "KINDS", "TRIAL", "Kind", "Options", "checked"]

DIAGNOSIS, TRIAL = "diagnosis", "trial"


class Options(BaseModel):
    """What each kind is told: the most that one entry may take in s, and its files, copies within the run's folder."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    limit: Annotated[Finite, Field(gt=0.0, le=1e6)] = 3600.0
    files: dict[str, str] = {}


class Reading(Table):
    """How logs are read: arguments of `hil.logs.read_log` that name no file."""

    mapping: dict[str, str] = {}
    units: dict[str, str] = {}
    design_rpm: Finite | None = None
    guess: StrictBool = True
    part: Annotated[int, Field(ge=0)] = 0


class _Diagnosis(Options):
    reading: Reading


class _Varied(Table):
    name: str
    unit: str
    low: Finite
    high: Finite
    effect: StrictBool


class _Trial(Options):
    vary: list[_Varied]
    seed: Annotated[int, Field(ge=0)]
    plan: dict[str, Any]


@dataclass(frozen=True)
class Kind:
    """A kind of work.

    function  module and name; called with an entry's path, the options and the run's folder; returns what JSON holds
    options   what run.json may tell it
    together  whether it is quicker with many entries at once: it is called with the paths of those to come, too, and
              with the device that is to run them
    """

    function: tuple[str, str]
    options: type[Options]
    together: bool = False


KINDS = {
    DIAGNOSIS: Kind(("vaneloop.fleet.diagnosis", "diagnose_log"), _Diagnosis),
    TRIAL: Kind(("vaneloop.fleet.trial", "run_trial"), _Trial, together=True),
}


def checked(kind: str, options: dict[str, Any], source: object) -> Options:
    """The options of a kind of work. Raises InputError for a kind that is none of ours, and for what it is not told."""
    if kind not in KINDS:
        raise InputError(f"{source}: run.json has kind {kind[:60]!r}; allowed: {', '.join(KINDS)}")
    try:
        return KINDS[kind].options.model_validate(options)
    except ValidationError as e:
        first = e.errors()[0]
        where = ".".join(str(x)[:40] for x in first["loc"])
        raise InputError(f"{source}: run.json has options with a wrong {where} ({first['msg']})") from None
