"""The machine that logs are held against: its tables, what a model file adds, its control strategy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from controller import load_calibration
from hil.logs import LogError
from hil.native import Program
from plant import Model, build_plant, load_model
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import same_stages
from vaneloop.identification.settings import CURRENT_DRAWS

if TYPE_CHECKING:
    from controller import Calibration
    from hil.logs import Log
    from plant import Plant
    from vaneloop.identification.vane_chain.alignment import LateIn
    from vaneloop.identification.vane_chain.chain import Chain
    from vaneloop.identification.vane_chain.resample import Grid

__all__ = ["TABLES", "Machine", "files_of"]

OWN = "own_calibration.toml"  # beside the other tables: scalars of a controller of the user's own
TABLES = ("calibration", "stroke_tables", "vane_angles", "geometry", "schedules", "plant")


def files_of(tables: str | Path | None, plant: str | Path | None = None) -> dict[str, str]:
    """File of each table, by name without suffix: from the folder ``tables`` or the shipped one; the plant's from the
    file ``plant``.
    """
    shipped = {name: f"{name}.toml" for name in TABLES}
    if plant is not None:
        return {**files_of(tables), "plant": str(plant)}
    if tables is None:
        return shipped
    folder = Path(tables)
    if not folder.is_dir():
        raise InputError(f"--tables {folder}: is not a folder")
    found = {name: str(folder / file) for name, file in shipped.items() if (folder / file).is_file()}
    if not found and not (folder / OWN).is_file():
        raise InputError(f"--tables {folder}: holds none of {', '.join(shipped.values())}")
    return {**shipped, **found}


@dataclass(frozen=True)
class Machine:
    """Controller and vanes as tables describe them.

    tables    folder whose TOML files replace the shipped ones; None: the shipped ones
    model     model file (or `plant.Model`) with recalibrated parameters and effects beyond the nominal machine
    strategy  control strategy, one of `controller.STRATEGIES`; None: the calibration's
    table     plant table in place of that of ``tables``, such as plant_electromechanical.toml
    controller  shared library of the user's own in place of the firmware here (docs/own_controller.md)
    channels  1 or 2 of the controller, in place of what its table has (docs/channels.md)

    A wrong folder, table or model raises InputError when the machine is made.
    """

    tables: str | Path | None = None
    model: str | Path | Model | None = None
    strategy: str | None = None
    table: str | Path | None = None
    controller: str | Path | None = None
    channels: int | None = None

    def __post_init__(self) -> None:
        """Read what is named, so that a wrong name, or tables of different stages, are refused here."""
        f = self.files
        same_stages(**{f["geometry"]: self.plant.vanes, f["vane_angles"]: self.calibration.vanes})

    @cached_property
    def files(self) -> dict[str, str]:
        """File of each table, by name without suffix."""
        return files_of(self.tables, self.table)

    @cached_property
    def added(self) -> Model:
        """What the model file adds to the nominal machine."""
        if self.model is None:
            return Model()
        return self.model if isinstance(self.model, Model) else load_model(self.model, self._built(None))

    @cached_property
    def plant(self) -> Plant:
        """The vanes, their actuator and their sensors."""
        return self._built(None if self.model is None else self.added)

    @cached_property
    def calibration(self) -> Calibration:
        """What the controller is flashed with."""
        f = self.files
        made = load_calibration(f["calibration"], f["stroke_tables"], self.strategy, f["vane_angles"], self.channels)
        if self.controller is None:
            return made
        made.of_one_channel("a controller of your own")
        own = Path(self.tables or "") / OWN
        return made._replace(program=Program(str(self.controller), str(own) if self.tables and own.is_file() else None))

    def _built(self, model: Model | None) -> Plant:
        return build_plant(self.files["plant"], self.files["geometry"], self.files["schedules"], model)

    def bind(self, log: Log) -> Chain:
        """Put a log into the stages of this machine, each to be driven by its own logged inputs; of a very long log an
        excerpt (`vaneloop.verbs.long`).

        Raises LogError for a log that shows none of them.
        """
        from vaneloop.identification.vane_chain.chain import with_mean_stroke
        from vaneloop.identification.vane_chain.resample import grid_of
        from vaneloop.verbs.long import LONG, excerpted

        log = with_mean_stroke(log, self.plant)
        grid = grid_of(log)
        return excerpted(log, grid, self.stages_of) if grid.rows > LONG else self.stages_of(log, grid)

    def stages_of(
        self, log: Log, grid: Grid, pieces: Sequence[tuple[int, int]] = (), draws: int = CURRENT_DRAWS,
        late: LateIn | None = None,
    ) -> Chain:  # fmt: skip
        """`bind` of some rows of a log, as `build_chain` takes them; default: of all."""
        from vaneloop.identification.vane_chain.chain import build_chain

        sides = [f"{side}.{effect}" for side, of in self.added.sides.items() for effect in of.effects]
        present = (*self.added.effects, *sides)
        chain = build_chain(log, self.plant, self.calibration, present, grid, pieces, draws, late)
        if not chain.stages:
            why = "; ".join(f"{k}: {v}" for k, v in chain.not_observed.items())
            raise LogError(f"{log.path}: no subsystem can be judged ({why})")
        return chain


def with_law_files(effects: Sequence[str], machine: Machine) -> tuple[list[str], Model]:
    """Effects with those of law files (``X.toml``) by their names, and the machine's model with these laws."""
    added, wanted = machine.added, []
    for e in effects:
        if not e.endswith(".toml"):
            wanted.append(e)
            continue
        law = load_model(e, machine.plant)
        if not law.curves:
            raise InputError(f"--effect {e}: has no table curves; allowed: a law file of vaneloop learn")
        wanted += list(law.curves)
        own = {name: law.effects.get(name, {}) for name in law.curves}
        added = added.model_copy(update={"curves": {**added.curves, **law.curves}, "effects": {**added.effects, **own}})
    return wanted, added
