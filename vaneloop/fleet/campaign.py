"""A campaign: trials drawn from the tolerances, run on a run folder like the logs of a fleet, then searched and judged.

    trials/GROUP/000012.json      a sample; b..., ab...: points of the sensitivity indices; search.json: the search;
                                  subset.json: the levels of a subset simulation
    worst/GROUP/                  scenario, model and tables of the worst machine, and the command that runs it again
    failed/GROUP/                 the same files, and in machines/ a model file for each failed sample, the worst first

A group is one scenario with one calibration and one firmware.
"""

from __future__ import annotations

import fnmatch
import json
import math
import shlex
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from plant.model import text_of
from vaneloop.base.errors import InputError
from vaneloop.base.files import write_all
from vaneloop.fleet import plan as plans
from vaneloop.fleet.files import digest_of, read_json, whole_json
from vaneloop.fleet.folder import Folder, copies_of
from vaneloop.fleet.kinds import TRIAL
from vaneloop.fleet.plan import Group, Plan, Varied
from vaneloop.fleet.probability import SHARE, Level, Subset, interval
from vaneloop.fleet.sources import Source
from vaneloop.fleet.tables import answers
from vaneloop.fleet.together import CPU, demand_gpu, no_gpu
from vaneloop.fleet.trial import is_answer, model_at, moving, trial_once, worst_share
from vaneloop.pages.campaign import CampaignView, FailedMachine, GroupView, Rare, Requirement

__all__ = ["begin", "has_gpu", "interval", "judge", "take_samples", "take_searches"]

KNOWN = 64  # worst samples that a search begins with
ON_GPU = 1024  # samples in a chunk: a GPU takes hardly longer for them than for one


def has_gpu(device: str, here: bool) -> bool:
    """Whether samples will run on a GPU, as far as that is known before anything is begun; ``here``: on this computer.
    Raises InputError where they must, and cannot.
    """
    if device == CPU or not here:
        return device == "cuda"
    if (why := no_gpu()) and device == "cuda":
        raise InputError(f"device 'cuda': {why}")
    return not why


def begin(file: str | Path, out: str | Path, limit: float, device: str = "auto") -> tuple[Plan, list[Varied], Folder]:
    """Read the plan, check it against the machine, and begin the run or open it. Raises InputError; with ``device``
    "cuda" also for a scenario that no GPU can run.
    """
    plan = plans.load_plan(file)
    files = plans.files_of_plan(plan)
    quantities: list[Varied] = []
    for g in plans.groups(plan):
        machine = plans.group_machine(files, g)
        quantities = plans.varied(plan, machine.plant, file)
        for corner in (0.0, 1.0):  # limits that a model file may not have are refused before anything is begun
            plans.group_machine(files, g, model_at(files, g, quantities, [corner] * len(quantities)))
    if device == "cuda":
        demand_gpu(files, plans.groups(plan), quantities)
    told = plan.model_dump(mode="json", exclude={"title", "confidence", "allowed", "saved", "requirement"})
    for c in (
        told["calibration"] + told["firmware"]
    ):  # where the files lay is no part of the campaign; their contents are
        c.pop("tables"), c.pop("controller")
    told |= {"scenarios": [Path(s).stem for s in plan.scenarios], "model": bool(plan.model), "plant": bool(plan.plant)}
    options = {"files": copies_of(files), "limit": limit, "plan": told, **plans.as_options(plan, quantities)}
    return plan, quantities, Folder.begin(out, TRIAL, options, files)


def take_samples(plan: Plan, quantities: list[Varied], folder: Folder, gpus: int = 0) -> int:
    """Take up every sample, and every point of the sensitivity indices; return how many are new.

    gpus  workers that have a GPU, whose chunks are larger
    """
    a, b = plans.draw(plan, len(quantities))
    trials: list[str] = []
    for g in plans.groups(plan):
        points = {f"{i:06d}": x for i, x in enumerate(a)} | {f"b{i:06d}": x for i, x in enumerate(b)}
        for k in range(len(quantities) if len(b) else 0):
            mixed = a[: len(b)].copy()
            mixed[:, k] = b[:, k]
            points |= {f"ab{k:03d}-{i:06d}": x for i, x in enumerate(mixed)}
        trials += [_trial(folder, g, name, {"point": x.tolist()}) for name, x in points.items()]
    in_chunk = min(-(-len(trials) // gpus), ON_GPU) if gpus else None
    return folder.add([Source(t, "campaign", 0.0) for t in trials], in_chunk)


def take_searches(plan: Plan, folder: Folder) -> int:
    """Take up one search a group, from its worst samples, and the levels of its subset simulation, from all; return how
    many are new.
    """
    trials = []
    for g in plans.groups(plan):
        rows = [row for row in _rows(folder, g).values() if row is not None]
        among = moving(rows)
        known = [(row["point"], worst_share(row, among)) for row in rows]
        if plan.sampling == "subset" and _are_rare(sum(not row["held"] for row in rows), len(rows)):
            trials.append(_trial(folder, g, "subset", {"subset": True, "among": among, "known": known}))
        if plan.search and len(known) >= plans.LEAST:
            known.sort(key=lambda k: (k[1], k[0]))
            trials.append(_trial(folder, g, "search", {"search": plan.search, "among": among, "known": known[:KNOWN]}))
    return folder.add([Source(t, "campaign", 0.0) for t in trials], in_chunk=1) if trials else 0


def _trial(folder: Folder, g: Group, name: str, asked: dict[str, Any]) -> str:
    """Write a trial's file, unless it is there as it must be; return its path. Raises InputError and OSError."""
    file = (folder.path / "trials" / g.name / f"{name}.json").absolute()
    content = {"group": [g.scenario, g.calibration, g.firmware], "name": name, **asked}
    try:
        if read_json(file) == json.loads(json.dumps(content)):
            return str(file)
        folder.set_aside(file)
    except FileNotFoundError:
        pass
    except InputError:
        folder.set_aside(file)
    folder.room("trials", g.name)
    whole_json(file, content)
    return str(file)


def _rows(folder: Folder, g: Group, pattern: str = "[0-9]*.json") -> dict[str, dict[str, Any] | None]:
    """Answers of a group's trials by their names; None: it has none, or one that is damaged."""
    names: dict[str, str] = {}
    for name in fnmatch.filter(folder.names("trials", g.name), pattern):
        file = folder.path / "trials" / g.name / name
        try:
            names[f"{digest_of(file)}.json"] = file.stem
        except OSError as e:
            folder.note(file, f"cannot be read ({e.strerror})")
    found = answers(folder, list(names)) if names else {}
    return {name: answer if is_answer(answer := found.get(key)) else None for key, name in names.items()}


def judge(plan: Plan, quantities: list[Varied], folder: Folder, told: Callable[[float], None]) -> CampaignView:
    """What the campaign says. The worst case of each group is saved, and run again from its saved files."""
    files = {n: str(folder.path / f) for n, f in folder.job["options"]["files"].items()}
    shown, all_groups = [], list(plans.groups(plan))
    simulated: dict[str, float] = {}
    notes: Counter[str] = Counter()
    for k, g in enumerate(all_groups):
        rows = _rows(folder, g)
        done = [r for r in rows.values() if r is not None]
        if not done:
            raise InputError(f"{folder.path}: no trial of {g.name} came to an end; vaneloop fleet status says why")
        among = moving(done)
        search = _rows(folder, g, "search.json").get("search")
        levels = _rows(folder, g, "subset.json").get("subset")
        beyond = [r for r in (search, levels) if r]
        worst = min([*done, *beyond], key=lambda r: (worst_share(r, among), r["point"]))
        duration = plans.scenario_of(files, g).duration
        runs_on: Counter[str] = Counter()
        for r in (*done, *(b for b in _rows(folder, g, "[ab]*.json").values() if b), *beyond):
            runs_on.update(r.get("ran", {}))
            if r.get("note"):
                notes[r["note"]] += r.get("ran", {}).get(CPU, 0)
        for on, n in runs_on.items():
            simulated[on] = simulated.get(on, 0.0) + n * duration
        nearest = min(beyond, key=lambda r: worst_share(r, among), default=None)
        rare = _rare(levels, plan.confidence, worst is levels)
        failed = sum(not r["held"] for r in done)
        low, high = interval(failed, len(done), plan.confidence)
        if rare is not None:
            low, high = rare.low, min(rare.high, high) if not rare.probability else rare.high
        by_search, agreed = worst is search, True
        if worst.get("alone") == "":  # a verdict from lanes is proved on the lockstep bus
            worst, lanes = trial_once(files, g, quantities, worst["point"]), worst
            agreed = _agree(worst, lanes)
        saved, command, same = _save(folder, files, plan, g, quantities, worst)
        kept = _worst_failed(rows, among, plan.saved)
        failures = _save_failed(folder, files, g, quantities, kept, among)
        shares, points = [worst_share(r, among) for r in done], [r["point"] for r in done]
        least, runs = worst_share(worst, among), search["runs"] if search else 0
        alone = dict(Counter(r["alone"] for r in done if r.get("alone")))
        first, total = _indices(plan, quantities, folder, g, rows, among)
        shown.append(GroupView(
            g.name, g.scenario, g.calibration, g.firmware, len(done), len(rows) - len(done), failed, low, high,
            _requirements(done, nearest, plan, g.scenario), shares, points,
            plans.values_at(quantities, worst["point"]), least, by_search, runs, worst["seen"], worst["state_hash"],
            str(saved), command, same and agreed, first, total, alone, failures, rare,
            "" if rare or plan.sampling != "subset" else _why_counted(failed, len(done)),
        ))  # fmt: skip
        told((k + 1) / len(all_groups))
    return CampaignView(
        plan.title, str(folder.path), folder.job["version"], [vars(q) for q in quantities], plan.confidence,
        plan.allowed, plan.sampling, plan.seed, shown, simulated,
        [f"{why.rstrip('.')}; the processor's lanes ran {n:,} machines" for why, n in notes.items()],
        {r.id: r.text for r in plan.requirement},
    )  # fmt: skip


def _are_rare(failed: int, n: int) -> bool:
    """Whether so few of the samples fail that levels beyond them are asked for."""
    return failed < SHARE * n


def _why_counted(failed: int, n: int) -> str:
    return "the levels have no answer" if _are_rare(failed, n) else f"{failed} of {n} samples fail"


def _rare(levels: dict[str, Any] | None, confidence: float, worst: bool) -> Rare | None:
    """What the levels of a subset simulation say; None: there is none."""
    if levels is None or not (said := levels.get("subset")):
        return None
    of = Subset([Level(*level) for level in said["levels"]], said["reached"], said["runs"])
    low, high = of.interval(confidence)
    return Rare(of.probability, low, high, of.runs, [vars(level) for level in of.levels], worst)


def _worst_failed(rows: dict[str, dict[str, Any] | None], among: list[str], most: int) -> dict[str, dict[str, Any]]:
    """The failed samples with the least margins, by their names, the worst first."""
    failed = [(worst_share(r, among), name, r) for name, r in rows.items() if r is not None and not r["held"]]
    return {name: r for _, name, r in sorted(failed, key=lambda f: f[:2])[:most]}


def _agree(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two answers say the same: verdicts and, to rounding, margins."""
    pairs = list(zip(one["margins"], other["margins"], strict=False))
    return len(one["margins"]) == len(other["margins"]) and all(
        (a["expected"], a["held"]) == (b["expected"], b["held"]) and _close(a["value"], b["value"]) for a, b in pairs
    )


def _close(a: float | None, b: float | None) -> bool:
    return a == b or (a is not None and b is not None and math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-9))


def _requirements(
    done: list[dict[str, Any]], search: dict[str, Any] | None, plan: Plan, scenario: str
) -> list[Requirement]:
    """Every claim over all trials: how often it was broken, its least and its median margin, and that of the worst
    machine beyond them; the interval of the probability that it is broken; which requirements of the plan it verifies.
    """
    by: dict[str, list[dict[str, Any]]] = {}
    for r in done:
        for m in r["margins"]:
            by.setdefault(m["expected"], []).append(m)
    found = {m["expected"]: m for m in (search or {"margins": []})["margins"]}
    for expected in found.keys() - by.keys():
        by[expected] = []
    out = []
    for expected, rows in by.items():
        value = [m["value"] for m in rows if m["value"] is not None]
        share = [m["share"] for m in rows if m["share"] is not None]
        s = found.get(expected)
        unit = next((m["unit"] for m in [*rows, *([s] if s else [])] if m["unit"]), "")
        broken = sum(not m["held"] for m in rows)
        low, high = interval(broken, len(rows), plan.confidence) if rows else (0.0, 1.0)
        out.append(Requirement(
            expected, len(rows), broken, unit, min(value, default=None),
            float(np.median(value)) if value else None, min(share, default=None),
            None if s is None else s["value"], None if s is None else bool(s["held"]), low, high,
            [r.id for r in plan.requirement if r.takes(scenario, expected)],
        ))  # fmt: skip
    return out


def _save(
    folder: Folder, files: dict[str, str], plan: Plan, g: Group, quantities: list[Varied], worst: dict[str, Any]
) -> tuple[Path, str, bool]:
    """Save the worst case with the command that runs it again, all its files or none; True: from these files it is the
    same, bit for bit.
    """
    at = folder.room("worst", g.name)
    model = at / "model.toml"
    contents, own = _copied(folder, files, g, at)
    made = model_at(files, g, quantities, worst["point"])
    contents[model] = text_of(made.noted(f"campaign {folder.path.name}, worst case of {g.name}"))
    command = _command(own, g, model)
    contents[at / "command.txt"] = f"{command}\n"
    _write_alone(at, contents)
    return at, command, _same(worst, trial_once({**own, "model": str(model)}, g, [], []))


def _save_failed(
    folder: Folder,
    files: dict[str, str],
    g: Group,
    quantities: list[Varied],
    failed: dict[str, dict[str, Any]],
    among: list[str],
) -> list[FailedMachine]:
    """Save failed samples, by their names, as model files beside one copy of what they share, all files or none. Each
    is run from its files on the lockstep bus: its verdicts must be the same, its margins to rounding.
    """
    if not failed and not (folder.path / "failed" / g.name).exists():
        return []
    at = folder.room("failed", g.name)
    contents, own = _copied(folder, files, g, at) if failed else ({}, {})
    models = {name: folder.room("failed", g.name, "machines") / f"{name}.toml" for name in failed}
    for name, answer in failed.items():
        made = model_at(files, g, quantities, answer["point"])
        contents[models[name]] = text_of(made.noted(f"campaign {folder.path.name}, sample {name} of {g.name}"))
    _write_alone(at, contents)
    return [
        FailedMachine(
            name, worst_share(answer, among), str(models[name]), _command(own, g, models[name]),
            _same(answer, trial_once({**own, "model": str(models[name])}, g, [], [])),
        )
        for name, answer in failed.items()
    ]  # fmt: skip


def _copied(
    folder: Folder, files: dict[str, str], g: Group, at: Path
) -> tuple[dict[Path, str | bytes], dict[str, str]]:
    """What the machines of a group have in common, copied into a folder of the run: contents of the files, and the
    copies by the names that `Plan` gives them.
    """
    # its name is the user's, who may call it as one of the other files
    scenario = folder.room(*at.relative_to(folder.path).parts, "scenario") / f"{g.scenario}.toml"
    contents: dict[Path, str | bytes] = {scenario: Path(files[f"scenario.{g.scenario}"]).read_bytes()}
    own = {f"scenario.{g.scenario}": str(scenario)}
    for option, key in _options(g):
        if key in files:
            of, copy = Path(files[key]), at / f"{option}{Path(files[key]).suffix}"
            for file in sorted(f for f in of.rglob("*") if f.is_file()) if of.is_dir() else [of]:
                place = copy / file.relative_to(of)
                folder.room(*place.parent.relative_to(folder.path).parts)
                contents[place] = file.read_bytes()
            own[key] = str(copy)
    return contents, own


def _options(g: Group) -> list[tuple[str, str]]:
    """Options of ``vaneloop inject``, and the names of the files that they take in a group."""
    return [("tables", f"tables.{g.calibration}"), ("plant", "plant"), ("controller", f"firmware.{g.firmware}")]


def _command(own: dict[str, str], g: Group, model: Path) -> str:
    """The command that runs one machine of a group from its files."""
    words = ["vaneloop", "inject", own[f"scenario.{g.scenario}"], "--model", str(model)]
    for option, key in _options(g):
        words += [f"--{option}", own[key]] if key in own else []
    return shlex.join(words)


def _write_alone(at: Path, contents: dict[Path, str | bytes]) -> None:
    """Write files into a folder, all or none, and remove what an earlier run left there."""
    write_all(contents)
    for old in sorted(at.rglob("*"), reverse=True):
        if old.is_dir() and not old.is_symlink():
            with suppress(OSError):  # it holds something
                old.rmdir()
        elif old not in contents:
            old.unlink()


def _same(answer: dict[str, Any], again: dict[str, Any]) -> bool:
    """Whether a machine that is run again from its files comes to the same: bit for bit, or, where the answer is from
    lanes, in its verdicts and to rounding in its margins.
    """
    if answer.get("alone") == "":
        return _agree(answer, again)
    return (again["state_hash"], again["margins"]) == (answer["state_hash"], answer["margins"])


def _indices(
    plan: Plan,
    quantities: list[Varied],
    folder: Folder,
    g: Group,
    rows: dict[str, dict[str, Any] | None],
    among: list[str],
) -> tuple[list[float], list[float]]:
    """First-order and total Sobol index of each quantity for the least margin; empty: none was asked for, or the margin
    does not vary.
    """
    n, d = plan.sensitivity, len(quantities)
    if not n:
        return [], []
    more = {**rows, **_rows(folder, g, "*b*.json")}

    def shares(names: Iterable[str]) -> list[float]:
        return [np.nan if (r := more.get(name)) is None else worst_share(r, among) for name in names]

    a, b = (np.array([shares(f"{p}{i:06d}" for i in range(n))]) for p in ("", "b"))
    ab = np.array([[shares(f"ab{k:03d}-{i:06d}" for i in range(n))] for k in range(d)])
    if not (np.isfinite(a).all() and np.isfinite(b).all() and np.isfinite(ab).all()) or np.ptp([a, b]) == 0.0:
        return [], []
    found = scipy.stats.sobol_indices(func={"f_A": a, "f_B": b, "f_AB": ab}, n=n)
    return np.ravel(found.first_order).tolist(), np.ravel(found.total_order).tolist()
