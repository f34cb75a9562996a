"""What a campaign does with one trial: a scenario on one machine, judged; a search for the worst machine; or the levels
of a subset simulation.

A trial is a file of JSON in the campaign's folder, which makes it an entry like a log of a fleet: ``group``, ``point``
(in the unit cube) and, for a search, ``search`` (runs), ``among`` (claims that guide it) and ``known`` (points and
their margins). The levels of a subset simulation have ``subset`` (true), ``among``, and as ``known`` all samples.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy
from pydantic import BaseModel, Field, StrictBool, ValidationError

from hil.inject.any_controller import SHIPPED, expected_of_any, load_reactions
from hil.inject.in_lanes import warm_up_lanes
from hil.inject.injection import run
from hil.inject.margin import Margin, margins
from hil.inject.scenario import Scenario
from hil.inject.verdict import Outcome
from hil.loop.lockstep import warm_up
from plant import Model
from vaneloop.base.errors import InputError
from vaneloop.base.tables import Finite, Table
from vaneloop.fleet.files import read_json
from vaneloop.fleet.plan import Group, Varied, base_model, group_machine, model_of, scenario_of, values_at
from vaneloop.fleet.probability import subset
from vaneloop.fleet.together import BUS, CPU, Alone, Ran, side_by_side, warm_up_gpu

__all__ = ["is_answer", "model_at", "moving", "run_trial", "trial_once", "worst_share"]


def run_trial(
    path: str, options: dict[str, Any], run_folder: str, beside: Sequence[str] = (), device: str = CPU
) -> dict[str, Any]:
    """Do what the file asks for; the answer has the point, the margins and the state's digest of the (worst) run.

    beside  files of trials that will be asked for next: those of the same group run side by side with this one, and
            their answers are kept until then
    device  what runs trials side by side: "cpu", "cuda" or "auto". Raises DeviceError where "cuda" cannot be used
    """
    asked = _asked(path)
    files = {name: str(Path(run_folder) / f) for name, f in options["files"].items()}
    g, quantities = Group(*asked["group"]), [Varied(**q) for q in options["vary"]]
    if _is_sample(asked):
        answer = _sample(files, g, quantities, asked, beside, device)
    elif asked.get("subset"):
        answer = _subset(files, g, quantities, asked, int(options["seed"]), device)
    else:
        answer = _search(files, g, quantities, asked, int(options["seed"]))
    return {"verdict": "held" if answer["held"] else "failed", "answer": answer}


def _is_sample(asked: dict[str, Any]) -> bool:
    return "search" not in asked and not asked.get("subset")


_kept: dict[str, dict[str, Any]] = {}  # answers that will be asked for: by what the file asks for, as JSON


def _sample(
    files: dict[str, str], g: Group, quantities: list[Varied], asked: dict[str, Any], beside: Sequence[str], device: str
) -> dict[str, Any]:
    """The answer to a sample: side by side with others, where it can be."""
    key = json.dumps([files, asked], sort_keys=True)
    if key not in _kept:
        _kept.clear()
        all_asked = {key: asked}
        for other in beside:
            with suppress(InputError, OSError):  # asked for, it is told
                next_one = _asked(other)
                if next_one["group"] == asked["group"] and _is_sample(next_one):
                    all_asked[json.dumps([files, next_one], sort_keys=True)] = next_one
        found = side_by_side(files, g, quantities, [a["point"] for a in all_asked.values()], device)
        for name, one, ran in zip(all_asked, all_asked.values(), found, strict=True):
            _kept[name] = {"alone": ran.why} if isinstance(ran, Alone) else _beside_others(ran, one["point"])
    answer = _kept.pop(key)
    if answer["alone"]:
        return {**trial_once(files, g, quantities, asked["point"]), **answer, "ran": {BUS: 1}}
    return answer


def _beside_others(ran: Ran, point: list[float]) -> dict[str, Any]:
    """The answer of a machine that ran side by side with others: it has no digest, and nothing was seen but its
    margins.
    """
    held = all(m.held for m in ran.margins)
    return {
        "point": point, "held": held, "margins": _rows(ran.margins), "state_hash": None, "seen": [], "alone": "",
        "ran": {ran.on: 1}, "note": ran.note,
    }  # fmt: skip


class _Margin(BaseModel):
    """A claim's margin in an answer."""

    expected: str
    held: bool
    value: Finite | None
    unit: str
    share: Finite | None


class _Subset(BaseModel):
    """Levels of a subset simulation in an answer: `vaneloop.fleet.probability.Subset`."""

    levels: Annotated[list[tuple[Finite, Finite, Finite]], Field(min_length=1)]
    reached: bool
    runs: int


class _Answer(BaseModel):
    """The answer to a trial, as a campaign counts it."""

    point: list[Finite]
    held: bool
    margins: list[_Margin]
    state_hash: str | None  # None: the controller did not run to the end, or it ran side by side with others
    seen: list[str]
    runs: int = 0
    alone: str | None = None  # why it did not run side by side with others; empty: it did
    ran: dict[str, Annotated[int, Field(ge=0)]] = {}  # runs by what ran them: a GPU's name, "cpu", "bus"
    note: str = ""  # why a GPU that was asked for ran none, or not all
    subset: _Subset | None = None


class _Asked(Table):
    """A trial's file."""

    group: Annotated[list[str], Field(min_length=3, max_length=3)]
    name: str = ""
    point: list[Finite] = []
    search: Annotated[int, Field(ge=1, le=10_000)] | None = None
    subset: StrictBool = False
    among: list[str] = []
    known: list[tuple[list[Finite], Finite]] = []


def is_answer(answer: Any) -> bool:
    """Whether it is the answer to a trial, whole and undamaged."""
    try:
        _Answer.model_validate(answer)
    except ValidationError:
        return False
    return True


def _asked(path: str) -> dict[str, Any]:
    """What a trial's file asks for. Raises InputError where it asks for nothing of ours."""
    asked = read_json(Path(path))
    try:
        _Asked.model_validate(asked)
    except ValidationError as e:
        where = ".".join(str(x) for x in e.errors()[0]["loc"])
        raise InputError(f"{path}: is no trial of a campaign ({where}: {e.errors()[0]['msg']})") from None
    return dict(asked)


def model_at(files: dict[str, str], g: Group, quantities: list[Varied], point: list[float]) -> Model:
    """The model file of a point of the unit cube."""
    base = base_model(files, group_machine(files, g, Model()).plant) if "model" in files else None
    return model_of(quantities, values_at(quantities, point), base)


def trial_once(files: dict[str, str], g: Group, quantities: list[Varied], point: list[float]) -> dict[str, Any]:
    """Run a group's scenario on the machine of a point, as ``vaneloop inject`` would."""
    made = model_at(files, g, quantities, point)
    machine, scenario = group_machine(files, g, made), scenario_of(files, g)
    reactions = load_reactions(SHIPPED) if machine.controller is not None else None
    outcome = run(scenario, plant=machine.plant, calibration=machine.calibration, name=g.scenario, reactions=reactions)
    if reactions is not None and g.scenario in reactions.reactions:
        scenario = expected_of_any(g.scenario, scenario, reactions)
    return _answer(scenario, outcome, point)


def _answer(scenario: Scenario, outcome: Outcome, point: list[float]) -> dict[str, Any]:
    return {
        "point": [float(u) for u in point], "held": outcome.held, "margins": _rows(margins(scenario, outcome)),
        "state_hash": outcome.state_hash, "seen": [c.seen for c in outcome.checks if c.held is False],
    }  # fmt: skip


def _rows(found: Iterable[Margin]) -> list[dict[str, Any]]:
    return [
        {"expected": m.expected, "held": m.held, "value": None if np.isnan(m.value) else m.value, "unit": m.unit,
         "share": None if np.isnan(m.share) else m.share} for m in found
    ]  # fmt: skip


def moving(answers: Iterable[dict[str, Any]]) -> list[str]:
    """Claims whose margin differs between trials; all that have one where none does.

    A margin that no tolerance moves would hide those that come nearer and nearer to it.
    """
    shares: dict[str, set[float]] = {}
    for answer in answers:
        for m in answer["margins"]:
            if m["share"] is not None:
                shares.setdefault(m["expected"], set()).add(m["share"])
    return sorted(c for c, s in shares.items() if len(s) > 1) or sorted(shares)


def worst_share(answer: dict[str, Any], among: Sequence[str]) -> float:
    """Least margin of a trial, as a share, of the claims ``among``, and of any that is broken; 1: none has one."""
    counts = (
        m["share"] for m in answer["margins"] if m["share"] is not None and (m["expected"] in among or not m["held"])
    )
    return min(counts, default=1.0)


class _Spent(Exception):
    """The runs of a search are used up."""


def _search(
    files: dict[str, str], g: Group, quantities: list[Varied], asked: dict[str, Any], seed: int
) -> dict[str, Any]:
    """Look for the least margin: at the corner to which a plane through the known margins falls, by differential
    evolution from the worst samples, then with a simplex from what that found.

    The first two have half of the runs, the simplex the other half. The same file gives the same runs.
    """
    seen = {tuple(point): float(share) for point, share in asked["known"]}
    start = sorted(seen, key=lambda point: (seen[point], point))
    best: list[Any] = [np.inf, None]
    runs, most = 0, 0

    def least(x: np.ndarray) -> float:
        nonlocal runs
        point = tuple(float(u) for u in np.clip(x, 0.0, 1.0))
        if point not in seen:
            if runs >= most:
                raise _Spent
            runs += 1
            answer = trial_once(files, g, quantities, list(point))
            seen[point] = worst_share(answer, asked["among"])
            if seen[point] < best[0]:
                best[:] = [seen[point], answer]
        return seen[point]

    box = [(0.0, 1.0)] * len(quantities)
    first = np.array(start[: max(5, 2 * len(quantities))])
    try:
        most = (asked["search"] + 1) // 2
        plane = np.column_stack([np.array(list(seen)), np.ones(len(seen))])
        slope = np.linalg.lstsq(plane, np.array(list(seen.values())), rcond=None)[0][:-1]
        corner = np.where(slope > 0.0, 0.0, 1.0)
        if least(corner) < seen[start[-1]]:
            first[-1] = corner
        scipy.optimize.differential_evolution(
            least, box, init=first, maxiter=10_000, tol=0.0, atol=-1.0, polish=False, rng=np.random.default_rng(seed)
        )
    except _Spent:
        pass
    try:
        most = asked["search"]
        at = np.array(min(seen, key=lambda point: (seen[point], point)))
        corners = at + np.where(at < 0.5, 0.15, -0.15) * np.eye(len(at))
        scipy.optimize.minimize(
            least, at, method="Nelder-Mead", bounds=box,
            options={"initial_simplex": np.vstack([at, corners]), "maxfev": 100_000, "xatol": 1e-4, "fatol": 1e-6},
        )  # fmt: skip
    except _Spent:
        pass
    answer = best[1] if best[0] < seen[start[0]] else trial_once(files, g, quantities, list(start[0]))
    return {**answer, "runs": runs, "from": seen[start[0]], "ran": {BUS: runs}}


def _subset(
    files: dict[str, str], g: Group, quantities: list[Varied], asked: dict[str, Any], seed: int, device: str
) -> dict[str, Any]:
    """Run level after level from the samples that are known, side by side where they can; answer with the machine of
    the least margin. The same file gives the same runs.
    """
    points, shares = (list(of) for of in zip(*asked["known"], strict=True))
    start = min(zip(shares, points, strict=True))
    best: list[Any] = [start[0], None]
    count: Counter[str] = Counter()
    notes: list[str] = []

    def least(x: np.ndarray) -> np.ndarray:
        of = x.tolist()
        found = side_by_side(files, g, quantities, of, device)
        count.update(BUS if isinstance(ran, Alone) else ran.on for ran in found)
        notes.extend({ran.note for ran in found if isinstance(ran, Ran) and ran.note})
        answers = [trial_once(files, g, quantities, point) if isinstance(ran, Alone) else _beside_others(ran, point)
                   for ran, point in zip(found, of, strict=True)]  # fmt: skip
        out = [worst_share(answer, asked["among"]) for answer in answers]
        k = int(np.argmin(out))
        if out[k] < best[0]:
            best[:] = [out[k], answers[k]]
        return np.array(out)

    found = subset(least, np.array(points), np.array(shares), seed)
    answer = best[1] or trial_once(files, g, quantities, start[1])
    levels = [(level.margin, level.share, level.variation) for level in found.levels]
    said = {"levels": levels, "reached": found.reached, "runs": found.runs}
    return {**answer, "subset": said, "ran": dict(count), "note": notes[0] if notes else ""}


def _warm_up(options: dict[str, Any], run_folder: str) -> None:
    """Compile what a scenario needs."""
    warm_up(lambda text: None)
    run(Scenario(title="warm-up", duration=0.1))
    warm_up_lanes()


run_trial.warm_up = _warm_up  # type: ignore[attr-defined]
run_trial.warm_up_device = warm_up_gpu  # type: ignore[attr-defined]
