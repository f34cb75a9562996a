"""What a log gives a stage of the vane chain, and the same of some of its rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from controller import Calibration
from plant import Plant
from plant.curve import KNOWN, QUANTITIES, quantity_of
from plant.effects import CURVES
from plant.layout import C_OF, CURVE_ROWS
from plant.stages.blocks import NOTHING
from vaneloop.base.vanes import VANES
from vaneloop.discrepancy.models.motion import smoothed
from vaneloop.discrepancy.models.runner import Placed
from vaneloop.discrepancy.stage import Array, Effect, Stage

__all__ = ["Driven", "Made", "excerpts"]


class Driven(NamedTuple):
    """What a stage is made of.

    t, columns           s, and every channel on it, border units (`raster.on_raster`)
    machine, calibration the plant, and the controller as it is flashed
    outputs              channels that the stage explains, of those that the log has
    run                  bool[samples]: rows that count
    present              effects that the model already has: not tried again
    laws                 effects of the library that may be tried; None: all that the stage can have
    curves               what may be tried besides: curves as they run, and as the search has them
    turns                what follows from the whole stroke (`ground.reversals`), worked out when it is asked for
    """

    t: Array
    columns: dict[str, Array]
    machine: Plant
    calibration: Calibration
    outputs: tuple[str, ...]
    run: Array
    present: tuple[str, ...]
    laws: tuple[str, ...] | None = None
    curves: tuple[tuple[Placed, Effect], ...] = ()
    turns: Callable[[], dict[str, Array]] = dict

    def at(self, rows: Array | slice, columns: dict[str, Array], run: Array) -> Driven:
        """Some of the rows, with their ``columns``, and which of them count."""
        turns = self.turns
        return self._replace(
            t=self.t[rows], columns=columns, run=run, turns=lambda: {k: v[rows] for k, v in turns().items()}
        )

    @property
    def curved(self) -> bool:
        """Whether any curve can be there."""
        return bool(self.curves) or bool(self.machine.p[CURVES].any())

    def quantity(self, name: str) -> Array | None:
        """A quantity of `plant.curve` on the log, in its unit; None: the log has it not."""
        q = quantity_of(name)
        if q is not None and q.name == "time":
            return self.t
        if q is not None and q.period:
            return self.t % q.period
        if name == "x_lvdt":  # with less noise, where it can be had
            return self.columns.get("stroke", self.columns.get(name))
        values = self.columns.get(name)
        if values is None:
            values = self.turns().get(name)
        return values if values is None or name not in VANES else smoothed(self.t, values)

    def signals(self) -> Array:
        """What curves are of, as the log has it, float64[KNOWN, samples], SI; NaN: what it has not, and what no curve
        here is of. Without curves: no samples.
        """
        if not self.curved:
            return NOTHING
        out = np.full((KNOWN, len(self.t)), np.nan)
        have = {int(of) for of in self.machine.p[CURVES + 1 + C_OF :: CURVE_ROWS, 0]}
        have |= {q.of for c, _ in self.curves if c.curve is not None and (q := quantity_of(c.curve.quantity))}
        for q in QUANTITIES.values():
            if q.of in have:
                values = self.quantity(q.name)
                if values is not None:
                    out[q.of] = values * q.si
        return out


class Made(NamedTuple):
    """How a stage was made: by ``make`` from ``driven``."""

    make: Callable[[Driven], Stage]
    driven: Driven


def excerpts(
    make: Callable[[Driven], Stage], driven: Driven, stage: Stage, keep: Callable[[Array], Array]
) -> Callable[[Array], Stage]:
    """Return a stage's ``excerpt`` (`Stage`): made anew by ``make`` from some rows, the noise that of the whole log.

    keep  function from the rows to those of them that count
    """

    def excerpt(at: Array) -> Stage:
        columns = {k: v[at] for k, v in driven.columns.items()}
        part = make(driven.at(at, columns, keep(at)))
        part.floor, part.quiet, part.noise = stage.floor, stage.quiet, stage.noise
        part.raster_error, part.memory = stage.raster_error, stage.memory
        return part

    return excerpt
