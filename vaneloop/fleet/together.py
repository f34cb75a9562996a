"""Trials of a campaign's group side by side (`hil.inject.in_lanes`), on a GPU or in the processor's lanes: what a
worker has before it at once.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from numba import config

from controller import load_calibration
from hil.inject.heard import Heard, hear
from hil.inject.in_lanes import WATCHED, can, margins_in_lanes, margins_on_gpu
from hil.inject.injection import lacks
from hil.inject.on_lockstep import check_stages
from hil.inject.scenario import Scenario
from hil.loop import cuda as gpu
from plant import Model, build_plant
from vaneloop.base.errors import DeviceError, InputError
from vaneloop.fleet.plan import Group, Varied, base_model, group_machine, model_of, scenario_of, values_at

if TYPE_CHECKING:
    from controller import Calibration
    from hil.inject.margin import Margin
    from plant import Plant

__all__ = ["BUS", "CPU", "Alone", "Ran", "demand_gpu", "no_gpu", "side_by_side", "warm_up_gpu"]

CPU, BUS = "cpu", "bus"  # what runs trials, besides a GPU by its name: the processor's lanes, the lockstep bus
LACKING = "lanes have no such actuator, strategy or effect"


@dataclass(frozen=True)
class Alone:
    """Why a trial is run alone, on the lockstep bus."""

    why: str


@dataclass(frozen=True)
class Ran:
    """What came of a trial that ran side by side with others.

    on    what ran it: the GPU's name, or "cpu"
    note  why it was not a GPU, where one was asked for
    """

    margins: list[Margin]
    on: str = CPU
    note: str = ""


@dataclass(frozen=True)
class _Prepared:
    """What the trials of a group have in common."""

    scenario: Scenario
    plant: Plant
    calibration: Calibration
    base: Model | None
    heard: Heard


def side_by_side(
    files: dict[str, str], g: Group, quantities: list[Varied], points: Sequence[list[float]], device: str = CPU
) -> list[Ran | Alone]:
    """Run a group's scenario on the machine of each point; or say why it is to be run alone.

    device  as of `hil.loop.engines.lockstep_engines`. Raises DeviceError where "cuda" cannot be used, or fails
    """
    of = _prepared(tuple(sorted(files.items())), g)
    if isinstance(of, Alone):
        return [of] * len(points)
    plants: dict[int, Plant] = {}
    for i, point in enumerate(points):
        with suppress(InputError):  # alone, it says what is wrong
            plants[i] = _plant(of, quantities, point)
    fit = [i for i, plant in plants.items() if can(of.scenario, plant, of.calibration)]
    out: list[Ran | Alone] = [Alone("the machine has what lanes do not have")] * len(points)
    left, note = fit, ""
    if device != CPU and fit:
        found, note = _on_gpu(of, [plants[i] for i in fit], device)
        for i, ran in zip(fit, found, strict=False):
            out[i] = ran
        left = fit[len(found) :]
    for i, margins in zip(
        left, margins_in_lanes(of.scenario, [plants[i] for i in left], of.calibration, of.heard), strict=True
    ):
        out[i] = Ran(margins, CPU, note)
    return out


_lost: list[str] = []  # why this process uses no GPU any more


def _on_gpu(of: _Prepared, plants: list[Plant], device: str) -> tuple[list[Ran], str]:
    """What came of the first ones of some machines on the GPU, of all where nothing fails; and why not of all."""
    out: list[Ran] = []
    if not _lost:
        try:
            kernel = gpu.kernel(WATCHED)
            with _turn():
                for _, found in margins_on_gpu(kernel, of.scenario, plants, of.calibration, of.heard):
                    out += [Ran(margins, kernel.name) for margins in found]
                kernel.release()
        except gpu.unusable() as e:
            _lost.append(gpu.said(e))
    return out, _why_not(device)


def _why_not(device: str) -> str:
    """Why the GPU does not run what it was asked for; empty: it does. Raises DeviceError where it must."""
    why = f"device {device!r}: {_lost[0]}" if _lost else ""
    if why and device == "cuda":
        raise DeviceError(why)
    return why


@contextmanager
def _turn() -> Iterator[None]:
    """Have the GPU alone among this computer's workers: each builds its machines while another one's run."""
    cache = Path(config.CACHE_DIR)  # type: ignore[attr-defined]
    cache.mkdir(parents=True, exist_ok=True)
    with open(cache / "gpu.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # ends with the process, however that ends
        yield


def no_gpu() -> str:
    """Why this computer has no GPU that can be used; empty: it has one. Nothing is taken of its memory."""
    try:
        gpu.check()
    except gpu.unusable() as e:
        return gpu.said(e)
    return ""


def warm_up_gpu(device: str) -> None:
    """Compile the GPU's kernel, where ``device`` may be one. Raises DeviceError where it must be and cannot."""
    if device == CPU:
        return
    if why := no_gpu():
        _lost.append(why)
        _why_not(device)
        return
    scenario, plant = Scenario(title="warm-up", duration=0.02), build_plant()
    heard = hear(scenario, plant)
    assert isinstance(heard, Heard)
    _on_gpu(_Prepared(scenario, plant, load_calibration(), None, heard), [plant], device)


def demand_gpu(files: dict[str, str], groups: Iterable[Group], quantities: list[Varied]) -> None:
    """Raise InputError for the first scenario that no GPU can run, with the reason."""
    for g in groups:
        of = _prepared(tuple(sorted(files.items())), g)
        if isinstance(of, Alone):
            raise InputError(f"device 'cuda': {g.name} cannot run on a GPU: {of.why}")
        for corner in (0.0, 1.0):
            plant = _plant(of, quantities, [corner] * len(quantities))
            if not can(of.scenario, plant, of.calibration):
                raise InputError(f"device 'cuda': {g.name} cannot run on a GPU: {LACKING}")


def _plant(of: _Prepared, quantities: list[Varied], point: list[float]) -> Plant:
    """The machine of a point."""
    return model_of(quantities, values_at(quantities, point), of.base).plant(of.plant)


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
        return Alone(LACKING)
    heard = hear(scenario, plant)
    if isinstance(heard, str):
        return Alone(heard)
    return _Prepared(scenario, plant, calibration, base_model(named, plant), heard)
