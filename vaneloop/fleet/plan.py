"""The plan of a campaign: which scenarios, which tolerances, which calibrations and firmwares, and how many trials.

::

    title = "Silence of the ECU, over the machine's tolerances"
    scenarios = ["demand_stops", "my_day.toml"]   # shipped ones by name, others relative to the plan
    samples = 64                                  # trials of each scenario x calibration x firmware
    search = 40                                   # runs more in each, towards the worst case

    [vary]                                        # a nominal parameter (docs/tables.md): its table's tolerance
    "actuator.flow_gain" = "tolerance"            # or limits in the table's unit
    "valve.bandwidth" = [48.0, 72.0]
    "valve_null_bias.null_current" = [-1.0, 1.0]  # a parameter of an effect (docs/effects.md), in its unit

    [[calibration]]
    name = "soft"
    tables = "SOFT"                               # folder, as --tables takes it

    [[firmware]]
    name = "mine"
    controller = "mine.so"                        # as --controller takes it

    [[requirement]]                               # traced to the claims that verify it
    id = "VGV-014"
    text = "The vanes do not move by more than 1 deg while the ECU is silent"
    verified_by = ["demand_stops: vigv"]          # a scenario's claims with these words; without words all of them
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import scipy
from pydantic import Field, field_validator, model_validator

from hil.inject.actions import Replay
from hil.inject.scenario import Scenario, library, load_scenario
from plant import Model, Plant, load_model
from plant.effects import EFFECTS
from vaneloop.base import tables
from vaneloop.base.errors import InputError, meant
from vaneloop.base.tables import Finite, Table, read
from vaneloop.verbs.machine import Machine

__all__ = [
    "LEAST", "Group", "Plan", "Varied", "Verified", "as_options", "base_model", "draw", "files_of_plan",
    "group_machine", "groups", "load_plan", "model_of", "scenario_of", "values_at", "varied", "varied_by",
]  # fmt: skip

_NAME = re.compile(r"[A-Za-z0-9_-]{1,60}")
MOST = 1_000_000  # trials of a campaign


class Choice(Table):
    """A calibration (``tables``) or a firmware (``controller``); without either the shipped one."""

    name: str
    tables: str | None = None
    controller: str | None = None

    @field_validator("name")
    @classmethod
    def _plain(cls, name: str) -> str:
        if not _NAME.fullmatch(name):
            raise ValueError(f"name (={name!r}) must be letters, digits, - and _")
        return name


class Verified(Table):
    """A requirement: its identifier, its text, and what verifies it: ``SCENARIO``, all claims of a scenario, or
    ``SCENARIO: words``, those with these words.
    """

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9_./-]{1,60}$")]
    text: Annotated[str, Field(min_length=4)]
    verified_by: Annotated[list[str], Field(min_length=1)]

    def parts(self) -> Iterator[tuple[str, str]]:
        """Each scenario that verifies it, and the words of its claims; "": all."""
        for one in self.verified_by:
            scenario, _, words = one.partition(":")
            yield scenario.strip(), words.strip()

    def takes(self, scenario: str, claim: str) -> bool:
        """Whether a claim of a scenario verifies it."""
        return any(scenario == one and words in claim for one, words in self.parts())


LEAST = 5  # samples that a search begins with
LEAST_OF_LEVEL = 250  # samples of a level of a subset simulation: chains begin from a tenth of them
MOST_OF_LEVEL = 10_000  # one worker runs the levels


class Plan(Table):
    """``plan.toml``.

    scenarios    names of shipped ones, or files
    samples      trials of each group (scenario, calibration, firmware), drawn uniformly between the limits
    sampling     sobol (scrambled), random (independent), or subset (random, then levels of as many machines nearer and
                 nearer to failing: `vaneloop.fleet.probability`)
    search       runs more in each group, in search of the worst case; 0: none
    sensitivity  base points of the sensitivity indices: so many times (parameters + 1) runs more; 0: none
    confidence   of the intervals
    saved        failed samples of each group that are saved as files, the worst first
    allowed      greatest failure probability that the interval's upper end may reach; without, any failure is one
    requirement  requirements with identifiers, each traced to the claims that verify it
    seed         of the draw and of the search
    """

    title: Annotated[str, Field(min_length=4)]
    scenarios: Annotated[list[str], Field(min_length=1)]
    samples: Annotated[int, Field(ge=4, le=100_000)] = 64
    sampling: Literal["sobol", "random", "subset"] = "sobol"
    search: Annotated[int, Field(ge=0, le=10_000)] = 40
    sensitivity: Annotated[int, Field(ge=0, le=10_000)] = 0
    saved: Annotated[int, Field(ge=0, le=1000)] = 20
    confidence: Annotated[Finite, Field(gt=0.5, lt=1.0)] = 0.95
    allowed: Annotated[Finite, Field(gt=0.0, lt=1.0)] | None = None
    seed: Annotated[int, Field(ge=0)] = 1
    model: str | None = None
    plant: str | None = None
    vary: Annotated[dict[str, Literal["tolerance"] | Annotated[list[Finite], Field(min_length=2, max_length=2)]],
                    Field(min_length=1, max_length=100)]  # fmt: skip
    calibration: list[Choice] = [Choice(name="shipped")]
    firmware: list[Choice] = [Choice(name="shipped")]
    requirement: list[Verified] = []

    @model_validator(mode="after")
    def _fits(self) -> Plan:
        both = (("calibration", self.calibration, "controller"), ("firmware", self.firmware, "tables"))
        for what, choices, idle in both:
            names = [c.name for c in choices]
            if not names or len(set(names)) < len(names):
                raise ValueError(f"{what}: its names (={names}) must be there and differ")
            for c in choices:
                if getattr(c, idle) is not None:
                    raise ValueError(f"{what} {c.name!r} takes no {idle}")
        stems = [Path(s).stem for s in self.scenarios]
        if len(set(stems)) < len(stems):
            raise ValueError(f"scenarios: their names (={stems}) must differ")
        for stem in stems:
            if not _NAME.fullmatch(stem):
                raise ValueError(f"scenarios: a file's name (={stem!r}) must be letters, digits, - and _")
        ids = [r.id for r in self.requirement]
        if len(set(ids)) < len(ids):
            raise ValueError(f"requirement: its ids (={ids}) must differ")
        for r in self.requirement:
            if unknown := next((s for s, _ in r.parts() if s not in stems), None):
                raise ValueError(f"requirement {r.id!r}: verified_by {unknown!r} must be one of the scenarios {stems}")
        if self.search and self.samples < LEAST:
            raise ValueError(f"samples (={self.samples}) must be at least {LEAST} where a search begins with them")
        if self.sensitivity > self.samples:
            raise ValueError(f"sensitivity (={self.sensitivity}) must not be above samples (={self.samples})")
        for key in ("samples", "sensitivity"):
            n = getattr(self, key)
            if self.sampling == "sobol" and n & (n - 1):
                raise ValueError(f"{key} (={n}) must be a power of two with sampling = 'sobol'")
        if self.sampling == "subset" and not LEAST_OF_LEVEL <= self.samples <= MOST_OF_LEVEL:
            raise ValueError(
                f"samples (={self.samples}) must be in [{LEAST_OF_LEVEL}, {MOST_OF_LEVEL}] with sampling = 'subset'"
            )
        n = len(stems) * len(self.calibration) * len(self.firmware)
        n *= self.samples + self.sensitivity * (len(self.vary) + 1)
        if n > MOST:
            raise ValueError(f"the plan asks for {n:,} trials; allowed: {MOST:,}")
        return self


@dataclass(frozen=True)
class Varied:
    """One quantity that is varied, between ``low`` and ``high`` in ``unit``."""

    name: str
    unit: str
    low: float
    high: float
    effect: bool


@dataclass(frozen=True)
class Group:
    """One scenario with one calibration and one firmware."""

    scenario: str
    calibration: str
    firmware: str

    @property
    def name(self) -> str:
        """Short name, fit for a folder."""
        return f"{self.scenario}.{self.calibration}.{self.firmware}"


def load_plan(file: str | Path) -> Plan:
    """Read a plan; its files become absolute paths. Raises InputError: file, key, value, what is allowed."""
    plan, folder = read(Path(file), Plan), Path(file).parent

    def at(path: str | None) -> str | None:
        return None if path is None else str((folder / path).absolute())

    def placed(c: Choice) -> Choice:
        return c.model_copy(update={"tables": at(c.tables), "controller": at(c.controller)})

    known = library() | library(2)
    scenarios = [s if s in known and not (folder / s).is_file() else str(at(s)) for s in plan.scenarios]
    for s in scenarios:
        made = load_scenario(s)
        claims = [claim.words for claim in made.expect]
        for r in plan.requirement:
            for words in (words for scenario, words in r.parts() if scenario == Path(s).stem):
                if not any(words in claim for claim in claims):
                    raise InputError(
                        f"{file}: requirement {r.id!r}: no claim of {Path(s).stem!r} has the words {words!r}; its "
                        f"claims: {'; '.join(claims)}"
                    )
        if any(isinstance(a, Replay) and a.log for a in made.inject):
            raise InputError(f"{file}: scenarios: {Path(s).stem!r} replays a log file, which a campaign does not take")
    own = plan.plant if plan.plant is None or not (folder / plan.plant).is_file() else at(plan.plant)
    return plan.model_copy(update={
        "scenarios": scenarios, "model": at(plan.model), "plant": own,
        "calibration": [placed(c) for c in plan.calibration], "firmware": [placed(c) for c in plan.firmware],
    })  # fmt: skip


def groups(plan: Plan) -> Iterator[Group]:
    """Every scenario with every calibration and every firmware."""
    for s in plan.scenarios:
        for c in plan.calibration:
            for f in plan.firmware:
                yield Group(Path(s).stem, c.name, f.name)


def files_of_plan(plan: Plan) -> dict[str, str]:
    """Files that trials need, by the names under which a run keeps copies."""
    known = library() | library(2)
    files = {f"scenario.{Path(s).stem}": str(known.get(s, s)) for s in plan.scenarios}
    files |= {f"tables.{c.name}": c.tables for c in plan.calibration if c.tables}
    files |= {f"firmware.{c.name}": c.controller for c in plan.firmware if c.controller}
    files |= {"model": plan.model} if plan.model else {}
    return files | ({"plant": str(tables.file_of(plan.plant))} if plan.plant else {})


def group_machine(files: dict[str, str], g: Group, model: Model | None = None) -> Machine:
    """The machine of a group; ``model``: what a trial adds, in place of the plan's model file."""
    return Machine(files.get(f"tables.{g.calibration}"), model if model is not None else files.get("model"), None,
                   files.get("plant"), files.get(f"firmware.{g.firmware}"))  # fmt: skip


def scenario_of(files: dict[str, str], g: Group) -> Scenario:
    """The scenario of a group."""
    return load_scenario(Path(files[f"scenario.{g.scenario}"]))


def varied(plan: Plan, plant: Plant, source: str | Path) -> list[Varied]:
    """What a plan varies, with units and limits. Raises InputError for what the machine does not have."""
    return varied_by(plan.vary, plant, source)


def varied_by(vary: Mapping[str, str | Sequence[float]], plant: Plant, source: str | Path) -> list[Varied]:
    """As `varied`, of names with ``"tolerance"`` or their limits."""
    known = {n.name: n for n in plant.nominal}
    effects = {f"{e}.{p.name}": p for e, effect in EFFECTS.items() if plant.kind in effect.kinds
               for p in plant.parameters_of(e).values()}  # fmt: skip
    out = []
    for name, limits in vary.items():
        at = f"{source}: vary: {name!r}"
        if name in known:
            n = known[name]
            if limits == "tolerance" and n.tolerance <= 0.0:
                raise InputError(f"{at} has no tolerance in its table; give its limits [low, high] in {n.unit}")
            low, high = (n.value - n.tolerance, n.value + n.tolerance) if isinstance(limits, str) else limits
            out.append(Varied(name, n.unit, float(low), float(high), False))
        elif name in effects:
            if isinstance(limits, str):
                raise InputError(f"{at} is an effect's parameter; give its limits [low, high] in {effects[name].unit}")
            out.append(Varied(name, effects[name].unit, float(limits[0]), float(limits[1]), True))
        else:
            near = meant(name, [*known, *effects])
            raise InputError(
                f"{at} is unknown{near}; allowed: a nominal parameter, or EFFECT.parameter of this machine"
            )
        if not out[-1].low < out[-1].high:
            raise InputError(f"{at}: low (={out[-1].low:g}) must be below high (={out[-1].high:g})")
    return out


def values_at(quantities: Sequence[Varied], point: Iterable[float]) -> list[float]:
    """Values of the quantities at a point of the unit cube."""
    return [q.low + u * (q.high - q.low) for q, u in zip(quantities, point, strict=True)]


def model_of(quantities: list[Varied], values: list[float], base: Model | None = None) -> Model:
    """The model file of a trial: the plan's own, with these values in it."""
    made = base or Model()
    parameters, effects = dict(made.parameters), {e: dict(p) for e, p in made.effects.items()}
    for q, v in zip(quantities, values, strict=True):
        if q.effect:
            effect, key = q.name.split(".", 1)
            effects.setdefault(effect, {})[key] = float(v)
        else:
            parameters[q.name] = float(v)
    return made.model_copy(update={"parameters": parameters, "effects": effects})


def base_model(files: dict[str, str], plant: Plant) -> Model | None:
    """The plan's model file, if it has one."""
    return load_model(files["model"], plant) if "model" in files else None


def draw(plan: Plan, dimensions: int) -> tuple[np.ndarray, np.ndarray]:
    """The points of the unit cube: ``samples`` of them, and for the indices the second set of ``sensitivity`` points.

    One sequence of twice the dimensions gives both, so that the first ``sensitivity`` samples are the indices' first
    set and are run once.
    """
    if plan.sampling == "sobol":
        both = scipy.stats.qmc.Sobol(2 * dimensions, scramble=True, seed=plan.seed).random(plan.samples)
    else:
        both = np.random.default_rng(plan.seed).random((plan.samples, 2 * dimensions))
    return both[:, :dimensions], both[: plan.sensitivity, dimensions:]


def as_options(plan: Plan, quantities: list[Varied]) -> dict[str, Any]:
    """What a trial has to know besides its own file."""
    return {"vary": [vars(q) for q in quantities], "seed": plan.seed}
