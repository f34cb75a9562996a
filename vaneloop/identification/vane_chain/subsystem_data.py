"""What a log gives a stage of the vane chain, and the same of some of its rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from controller import Calibration
from plant import Plant
from plant.curve import KNOWN, QUANTITIES, quantity_of
from plant.effects import CURVES
from plant.layout import C_HIGH, C_LAG, C_OF, C_STOPS, C_TABLE, CURVE_ROWS
from plant.model import SIDE_NAMES
from plant.stages.blocks import NOTHING
from vaneloop.base.durations import named_lag
from vaneloop.base.hysteresis import RADII, slipped, stops_of
from vaneloop.base.signals import SIDES
from vaneloop.base.vanes import VANES
from vaneloop.identification.subsystem import Array, Effect, Stage
from vaneloop.identification.user_models.exogenous_regressors import lagged
from vaneloop.identification.user_models.motion import smoothed
from vaneloop.identification.user_models.simulation import Placed
from vaneloop.identification.vane_chain.low_pass import AS_LOGGED, LowPass

__all__ = ["ALSO", "SAMPLED_OF", "STROKE_OFF", "VANES_LATE", "Driven", "Made", "excerpts", "stroke_of"]

SAMPLED_OF = "sampled "  # and an output's name: a column that is 1 where the output was sampled; without it, everywhere
STROKE_OFF = "stroke off"  # a column, float64[rows, draws]: mm, what the last digit of the stroke may be off by
ALSO = MappingProxyType({"x_lvdt": ("stroke",), "i_cmd": ("ticks", "other_ticks")})  # columns that hold the same
VANES_LATE = "vanes late"  # a column: s, by which each row of the vane angles stands late; without it, 0


def stroke_of(name: str) -> str:
    """The column of a measured stroke with less of the LVDT's noise: ``stroke`` of ``x_lvdt``, and of a side's."""
    return name.replace("x_lvdt", "stroke")


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
    assumed              channels that nobody logged: standard deviation of the value in their place, border units
    passed               low-pass that what the stage explains has passed; a stroke in ``columns`` is that before it
    part_of              of an excerpt: the whole, and which of its rows these are
    again                whether the stage takes its noise over, as one does that was made of this log before: it is not
                         estimated
    side                 of two actuators, the one that the stage is about (0 A, 1 B); None: both, or the only one
    digits               step of the last digit of channels as filed (`resample.Grid`), border units
    samples              of the current, that the log has for each row
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
    assumed: Mapping[str, float] = MappingProxyType({})
    passed: LowPass = AS_LOGGED
    part_of: tuple[Driven, Array | slice] | None = None
    again: bool = False
    side: int | None = None
    digits: Mapping[str, float] = MappingProxyType({})
    samples: int = 1

    def digit(self, name: str) -> float:
        """Step of a channel's last digit; 0: it has none."""
        return self.digits.get(name, 0.0)

    def name(self, stage: str) -> str:
        """What a stage is called: that of one of two actuators with its side, ``actuator_b``."""
        return stage if self.side is None else f"{stage}_{SIDE_NAMES[self.side][-1]}"

    def own(self, effect: str) -> str:
        """What an effect is called where it is that of the stage's side."""
        return effect if self.side is None else f"{SIDE_NAMES[self.side]}.{effect}"

    def at(self, rows: Array | slice, columns: dict[str, Array], run: Array) -> Driven:
        """Some of the rows, with their ``columns``, and which of them count."""
        return self._replace(t=self.t[rows], columns=columns, run=run, part_of=(self, rows))

    def measured(self, rows: Array) -> Array:
        """The outputs at the ``rows`` that count, as far as they were sampled there: float64[outputs, samples]."""
        return np.array([np.where(rows & self.sampled(o), self.columns[o], np.nan) for o in self.outputs])

    def sampled(self, name: str) -> Array:
        """At which rows an output was sampled, bool[samples]."""
        there = self.columns.get(SAMPLED_OF + name)
        return np.ones(len(self.t), dtype=bool) if there is None else there > 0.0

    @property
    def both(self) -> tuple[Array, Array] | None:
        """The strokes (mm) of two actuators, A's and B's, with less of the LVDTs' noise; None: there is one, or the log
        has not both.
        """
        if self.machine.sides == 1 or not {*SIDES} <= self.columns.keys():
            return None
        a, b = (self.columns.get(stroke_of(name), self.columns[name]) for name in SIDES)
        return a, b

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
        if lag := named_lag(name):
            return self._late(*lag)
        if channel := stops_of(name):  # how they slip is a matter of the curve
            return self.quantity(channel)
        if name == "x_lvdt":  # with less noise, where it can be had
            return self.columns.get("stroke", self.columns.get(name))
        values = self.columns.get(name)
        if self.part_of is not None and (values is None or name in VANES):  # what follows from the rows around, too
            whole, rows = self.part_of
            values = whole.quantity(name)
            return values if values is None else values[rows]
        if values is None:
            values = self.turns().get(name)
        return values if values is None or name not in VANES else smoothed(self.t, values)

    def _late(self, name: str, tau: float) -> Array | None:
        """A quantity behind a lag of ``tau`` (s) that is settled at the start of the log."""
        whole, rows = self.part_of or (self, slice(None))
        if whole is not self:
            values = whole._late(name, tau)
            return values if values is None else values[rows]
        values = self.quantity(name)
        return values if values is None else np.asarray(lagged(self.t, np.ascontiguousarray(values), tau))

    def signals(self) -> Array:
        """What curves are of, as the log has it, float64[KNOWN + curves, samples], SI (`plant.curve.take`); NaN: what
        it has not, and what no curve here is of. Without curves: no samples.
        """
        if not self.curved:
            return NOTHING
        p = self.machine.p[:, 0]
        own = CURVES + 1 + CURVE_ROWS * np.arange(int(p[CURVES]))
        of = [(int(p[r + C_OF]), float(p[r + C_LAG])) for r in own]
        tried = (quantity_of(c.curve.quantity) for c, _ in self.curves if c.curve is not None)
        of += [(q.of, q.lag) for q in tried if q is not None]
        out = np.full((KNOWN + len(of), len(self.t)), np.nan)
        for q in QUANTITIES.values():
            if any(q.of == number for number, _ in of):
                values = self.quantity(q.name)
                if values is not None:
                    out[q.of] = values * q.si
        for row, (number, tau) in zip(out[KNOWN:], of, strict=True):
            if tau > 0.0:
                name = next(q.name for q in QUANTITIES.values() if q.of == number)
                values = self._late(name, tau)
                if values is not None:
                    row[:] = values * QUANTITIES[name].si
        return out

    def slipping(self, signals: Array, p: Array) -> Array:
        """`signals` with what the hystereses of each lane of the plant's parameters ``p`` give, which rest at the start
        of the log: float64[KNOWN + lanes * curves, samples]; of a current, whose noise is dither to it, the mean over
        each row's ticks. Where no lane has one: as they are.
        """
        n = int(p[CURVES].max())
        own = CURVES + 1 + CURVE_ROWS * np.arange(n)
        stops = [(c, int(r)) for c, r in enumerate(own) if p[r + C_STOPS].any()]
        if not stops:
            return signals
        lanes = p.shape[1]
        out = np.concatenate([signals[:KNOWN], *[signals[KNOWN : KNOWN + n]] * lanes])
        whole, rows = self.part_of or (self, slice(None))
        for c, r in stops:
            q = next(q for q in QUANTITIES.values() if q.of == int(p[r + C_OF, 0]))
            values = whole.columns.get("ticks") if q.name == "i_cmd" else None
            values = whole.quantity(q.name) if values is None else values
            assert values is not None
            course, weights = values.reshape(-1) * q.si, np.ascontiguousarray(p[r + C_TABLE : r + C_TABLE + RADII].T)
            for j in range(lanes):
                gives = slipped(course, p[r + C_HIGH, j], weights[j])
                out[KNOWN + j * n + c] = gives.reshape(len(values), -1).mean(axis=1)[rows]
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
        part = make(driven.at(at, columns, keep(at))._replace(again=True))
        part.floor, part.quiet, part.noise = stage.floor, stage.quiet, stage.noise
        part.raster_error, part.memory = stage.raster_error, stage.memory
        part.lost = None if stage.lost is None else stage.lost[..., at]
        return part

    return excerpt
