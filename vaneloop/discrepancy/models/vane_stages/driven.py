"""What a log gives a stage of the vane chain, and the same of some of its rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from controller import Calibration
from plant import Plant
from vaneloop.discrepancy.stage import Array, Stage

__all__ = ["Driven", "excerpts"]


class Driven(NamedTuple):
    """What a stage is made of.

    t, columns           s, and every channel on it, border units (`raster.on_raster`)
    machine, calibration the plant, and the controller as it is flashed
    outputs              channels that the stage explains, of those that the log has
    run                  bool[samples]: rows that count
    present              effects that the model already has: not tried again
    """

    t: Array
    columns: dict[str, Array]
    machine: Plant
    calibration: Calibration
    outputs: tuple[str, ...]
    run: Array
    present: tuple[str, ...]


def excerpts(
    make: Callable[[Driven], Stage], driven: Driven, stage: Stage, keep: Callable[[Array], Array]
) -> Callable[[Array], Stage]:
    """Return a stage's ``excerpt`` (`Stage`): made anew by ``make`` from some rows, the noise that of the whole log.

    keep  function from the rows to those of them that count
    """

    def excerpt(at: Array) -> Stage:
        columns = {k: v[at] for k, v in driven.columns.items()}
        part = make(driven._replace(t=driven.t[at], columns=columns, run=keep(at)))
        part.floor, part.quiet, part.noise = stage.floor, stage.quiet, stage.noise
        part.raster_error, part.memory = stage.raster_error, stage.memory
        return part

    return excerpt
