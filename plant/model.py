"""A model file: the nominal machine with some parameters recalibrated and some effects added. TOML, taken by every
command as ``--model``.

::

    [meta]                                  # free text; `extend` keeps its history here
    history = ["extend run.csv --effect valve_dead_band"]

    [parameters]                            # in the unit of plant.toml; widths of the play at the vane, as in
                                            geometry.toml
    "actuator.flow_gain" = 0.147

    [effects.valve_dead_band]               # in the units of docs/effects.md; what is not named stays neutral
    half_width = 1.2

    [curves."flow_gain_of_oil"]             # written by `vaneloop learn`: a law that nobody listed, its numbers as
    how = "times"                           # learned; those of now are in its table of effects (docs/learn.md)
    at = "actuator.flow_gain"
    of = "t_oil"
    low = 15.2
    high = 64.9
    knots = [15.2, 15.2, 15.2, 15.2, 64.9, 64.9, 64.9, 64.9]
    values = [-0.61, -0.2, 0.2, 0.29]

    [side_b.effects.internal_leakage]       # of two actuators, what B alone has, in place of what both have; side_a
    coefficient = 5.0                       # likewise. Effects and parameters of valve, actuator and LVDT,
                                            # and effects of its links to the rings
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from plant import chain
from plant.curve import PLACES, QUANTITIES, at_curve, quantity_of
from plant.effects import EFFECTS
from plant.geometry import Stage
from plant.layout import MOST_CURVES, PLAY
from plant.machine import Plant, build_plant
from plant.parameters import Nominal, derive
from vaneloop.base.curve import DEGREE, FINE_SIDE, POINTS, SIDE, splines
from vaneloop.base.durations import named_lag, period_of
from vaneloop.base.errors import InputError
from vaneloop.base.files import write
from vaneloop.base.forms import FORMS, NAMED, product
from vaneloop.base.hull import nearest_within, within
from vaneloop.base.hysteresis import stops_of
from vaneloop.base.tables import Bound, Finite, Table, read
from vaneloop.base.vanes import MOST, VANES, vane_in

__all__ = [
    "SIDE_NAMES", "Learned", "Model", "Side", "allowed_of", "load_model", "of_a_side", "side_of", "text_of",
    "write_model",
]  # fmt: skip

SIDE_NAMES = ("side_a", "side_b")  # of two actuators
FAR = 4.0  # tolerances: a nominal parameter farther off is not recalibrated, something else is wrong


class Second(Table):
    """The other quantity of a law that is a function of two.

    of, low, high, knots, form  as a law has them
    been   of splines, corners of where both have been, pairs of values; beyond, the surface stays as at the nearest
           place within. A formula goes on from low to high of either
    """

    of: str
    low: Finite
    high: Finite
    knots: list[Finite] = Field(default_factory=list, max_length=104)
    form: str = ""
    been: list[tuple[Finite, Finite]] = Field(default_factory=list, max_length=1000)


class Learned(Table):
    """A law that was learned: a function of one quantity at one place, or of two.

    how, at, of  what it does, where, of what (docs/learn.md)
    low, high    where its quantity has been; beyond, the function stays as at its end, or
    reach        from where to where a formula goes on; beyond, it stays as at these ends
    knots        of a cubic B-spline with ``values`` as coefficients; or
    jump         whether the last value of such a spline is half a jump where its quantity is 0
    form         name of a formula with ``values`` as numbers
    size         how large such a function is in usual, in ``unit``
    second       of a surface, its other quantity: ``values`` are those of each of the first one's splines in turn, one
                 for each spline of this; of formulas the numbers of the first, and of this all but what multiplies it
    """

    how: str
    at: str
    of: str
    low: Finite
    high: Finite
    values: list[Finite] = Field(min_length=1, max_length=100)
    knots: list[Finite] = Field(default_factory=list, max_length=104)
    jump: bool = False
    form: str = ""
    reach: list[Finite] = Field(default_factory=list, max_length=2)
    unit: str = ""
    size: Finite = 1.0
    second: Second | None = None

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of its values: c1, c2, ... of splines, those of its formula."""
        if self.form:
            own, other = (
                NAMED[axis.form].numbers if axis and axis.form in NAMED else () for axis in (self, self.second)
            )
            return (*own, *(f"second_{n}" for n in other[1:]))
        own = tuple(f"c{k + 1}" for k in range(len(self.values) - self.jump))
        return (*own, "jump") if self.jump else own

    def now(self, values: Mapping[str, float]) -> Learned:
        """The law with these values; what is not named stays as learned."""
        return self.model_copy(
            update={"values": [values.get(n, v) for n, v in zip(self.numbers, self.values, strict=True)]}
        )

    @property
    def ends(self) -> tuple[float, float]:
        """From where to where the function is known, or goes on."""
        return (self.reach[0], self.reach[-1]) if self.reach else (self.low, self.high)

    def check(self, name: str) -> None:
        """Refuse a table that is no curve and no surface: InputError, one line, with its ``name``."""
        axes: list[tuple[str, Learned | Second]] = [
            (name, self),
            *([(f"{name}.second", self.second)] if self.second else []),
        ]
        for where, axis in axes:
            if not self.low < self.high or not axis.low < axis.high:
                raise InputError(f"{where}: low (={axis.low:g}) must be below high (={axis.high:g})")
            if bool(axis.form) != bool(self.form) or axis.form and axis.form not in NAMED:
                one_of = ", ".join(f"{f.name} ({len(f.numbers)} values)" for f in FORMS)
                allowed = one_of if self.form else "none, as the first quantity has splines"
                raise InputError(f"{where}: form (={axis.form!r}, {len(self.values)} values) must be one of {allowed}")
        if self.form and len(self.numbers) != len(self.values):
            allowed = ", ".join(f"{f.name} ({len(f.numbers)} values)" for f in FORMS)
            needed = f"; with second, {', '.join(self.numbers)} are needed" if self.second else ""
            raise InputError(
                f"{name}: form (={self.form!r}, {len(self.values)} values) must be one of {allowed}{needed}"
            )
        if self.second is not None and (self.jump or self.reach):
            raise InputError(f"{name}: jump and reach are of one quantity; with second they are not allowed")
        low, high = self.ends
        if self.reach and not (self.form and len(self.reach) == 2 and low <= self.low and self.high <= high):
            raise InputError(
                f"{name}: reach (={self.reach}) must be of a formula: two numbers that hold low (={self.low:g}) and "
                f"high (={self.high:g})"
            )
        if self.form:
            return
        if self.second is None:
            count = len(self.values) - self.jump
            if len(self.knots) != count + DEGREE + 1 or np.any(np.diff(self.knots) < 0.0):
                raise InputError(
                    f"{name}: knots ({len(self.knots)} of them) must rise, and be {DEGREE + 1} more than the "
                    f"{count} values{' less the jump' if self.jump else ''}"
                )
            return
        for where, axis in axes:
            if len(axis.knots) < 2 * (DEGREE + 1) or np.any(np.diff(axis.knots) < 0.0):
                raise InputError(
                    f"{where}: knots ({len(axis.knots)} of them) must rise, and be {2 * (DEGREE + 1)} at least"
                )
        rows, columns = (len(axis.knots) - DEGREE - 1 for _, axis in axes)
        if len(self.values) != rows * columns:
            raise InputError(
                f"{name}: values ({len(self.values)} of them) must be {rows} x {columns}, as the knots have it"
            )
        if self.second.been:
            try:
                within(np.array(self.second.been), *self._ends(), np.zeros(1), np.zeros(1))
            except ValueError:
                raise InputError(
                    f"{name}.second: been ({len(self.second.been)} corners) must be three or more, not along a line"
                ) from None

    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest values of both quantities."""
        assert self.second is not None
        return np.array([self.low, self.second.low]), np.array([self.high, self.second.high])

    def table(self, points: int = POINTS) -> Callable[[np.ndarray], np.ndarray]:
        """Function from its values to the curve at so many points, evenly from one of its `ends` to the other; to a
        surface at `SIDE` points each way, `FINE_SIDE` of a product of formulas.
        """
        if self.second is not None:
            return self._grid(self.second)
        x = np.linspace(*self.ends, points)
        if self.form:
            form = NAMED[self.form]
            return lambda values: np.broadcast_to(form.value(x, values), x.shape).astype(float)
        design = splines(np.asarray(self.knots, dtype=float), x)
        return np.column_stack([design, np.sign(x)]).__matmul__ if self.jump else design.__matmul__

    def _grid(self, second: Second) -> Callable[[np.ndarray], np.ndarray]:
        side = FINE_SIDE if self.form else SIDE
        x, z = np.linspace(self.low, self.high, side), np.linspace(second.low, second.high, side)
        if self.form:
            one, other = NAMED[self.form], NAMED[second.form]
            return lambda values: product(one, other, x, z, values)
        nearest = nearest_within(np.array(second.been), *self._ends()) if second.been else slice(None)
        a, b = splines(np.array(self.knots), x), splines(np.array(second.knots), z)
        shape = a.shape[1], b.shape[1]
        return lambda values: (a @ np.reshape(values, shape) @ b.T).ravel()[nearest].reshape(SIDE, SIDE)


class Side(Table):
    """What one of two actuators, with its valve and its LVDT, has beyond the tables: as `Model` has it of both."""

    parameters: dict[str, Finite] = Field(default_factory=dict)
    effects: dict[str, dict[str, Finite]] = Field(default_factory=dict)


class Model(Table):
    """What a machine has beyond its tables.

    parameters  name of a nominal parameter (`plant.parameters.nominal`) -> value in its table's unit
    effects     name of an effect -> its parameters, in their declared units
    meta        free text and lists of it
    curves      effects that are functions which were learned
    side_a, side_b  what one of two actuators has, in place of what both have
    """

    parameters: dict[str, Finite] = Field(default_factory=dict)
    effects: dict[str, dict[str, Finite]] = Field(default_factory=dict)
    meta: dict[str, str | bool | int | float | list[str]] = Field(default_factory=dict)
    curves: dict[str, Learned] = Field(default_factory=dict)
    side_a: Side = Side()
    side_b: Side = Side()

    @model_validator(mode="before")
    @classmethod
    def _older(cls, data: Any) -> Any:
        """Files of users' own systems once had their name and history at the top."""
        if isinstance(data, dict) and (own := {k: data[k] for k in ("system", "history") if k in data}):
            return {**{k: v for k, v in data.items() if k not in own}, "meta": {**own, **data.get("meta", {})}}
        return data

    def noted(self, command: str) -> Model:
        """The same model with ``command`` at the end of its history."""
        history = self.meta.get("history", [])
        lines = [*(history if isinstance(history, list) else [str(history)]), command]
        return self.model_copy(update={"meta": {**self.meta, "history": lines}})

    @classmethod
    def of_effects(cls, effects: Mapping[str, Mapping[str, float]]) -> Model:
        """A model of these effects alone, with their parameters: of the machine, or as ``side_b.lvdt_bias`` of one of
        two actuators.
        """
        of: dict[str, dict[str, dict[str, float]]] = {name: {} for name in ("", *SIDE_NAMES)}
        for name, parameters in effects.items():
            side, effect = side_of(name)
            of[side][effect] = dict(parameters)
        a, b = (Side(effects=of[side]) for side in SIDE_NAMES)
        return cls(effects=of[""], side_a=a, side_b=b)

    @property
    def sides(self) -> dict[str, Side]:
        """What one of two actuators has that both have not, of those that have such a thing; side A's first."""
        sides = dict(zip(SIDE_NAMES, (self.side_a, self.side_b), strict=True))
        return {name: side for name, side in sides.items() if side.parameters or side.effects}

    def check(self, plant: Plant, source: str | Path = "model") -> None:
        """Refuse what is not in the library or out of bounds: InputError in one line, naming ``source``."""
        if system := self.meta.get("system"):
            raise InputError(f"{source}: is a model of the system {system!r}; --system says where that is")
        self._check_curves(plant, source)
        self._check_part(plant, f"{source}: ", self)
        for name, side in self.sides.items():
            if plant.sides != 2:
                raise InputError(f"{source}: {name}: this machine has one actuator")
            one_valve = plant.one_valve
            for key in (*side.parameters, *side.effects):
                if not of_a_side(key, one_valve):
                    allowed = "actuator and LVDT" if one_valve else "valve, actuator and LVDT"
                    but = "aero_load, flow gain and area" if one_valve else "aero_load"
                    raise InputError(
                        f"{source}: {name}: {key!r} is not of one side; allowed: parameters and effects of {allowed}, "
                        f"but for {but}; effects of the link"
                    )
            self._check_part(plant, f"{source}: {name}: ", side)

    def _check_part(self, plant: Plant, source: str, part: Model | Side) -> None:
        """`check` of parameters and effects."""
        known = {n.name: n for n in plant.nominal}
        for name, value in part.parameters.items():
            if name not in known:
                raise InputError(
                    f"{source}parameters: {name!r} is {_not(name, plant, known)}; allowed: {', '.join(known)}"
                )
            n = known[name]
            low, high = allowed_of(plant, n)
            _within(value, low, high, n.unit, f"{source}parameters: {name}")
        for effect, values in part.effects.items():
            if effect in self.curves:
                continue
            if effect not in EFFECTS:
                raise InputError(
                    f"{source}effects: {effect!r} is unknown{_meant(effect, EFFECTS)}; docs/effects.md lists them"
                )
            if why := plant.lacks(EFFECTS[effect]):
                raise InputError(f"{source}effects: {effect!r} {why}")
            allowed = {p.name: p for p in plant.parameters_of(effect).values()}
            for key, value in values.items():
                if key not in allowed:
                    raise InputError(
                        f"{source}effects.{effect}: {key!r} is {_not(key, plant, allowed)}; allowed: "
                        f"{', '.join(allowed)}"
                    )
                p = allowed[key]
                _within(value, p.low, p.high, p.unit, f"{source}effects.{effect}.{key}")

    def _check_curves(self, plant: Plant, source: str | Path) -> None:
        """Refuse curves that this machine has no place or quantity for."""
        if self.curves:
            plant.of_one_actuator(f"the curves of {source}")
        if len(self.curves) > MOST_CURVES:
            raise InputError(f"{source}: curves (={len(self.curves)}) must be at most {MOST_CURVES}")
        for name, curve in self.curves.items():
            where = f"{source}: curves.{name}"
            if curve.second is not None:
                raise InputError(
                    f"{where}: second (={curve.second.of!r}) makes it a surface; the vane chain takes curves of one "
                    f"quantity only"
                )
            places = {k: v for k, v in PLACES.items() if plant.kind in v.kinds and v.vane in ("", *plant.vanes)}
            own = [q for q in QUANTITIES if q not in VANES or q in plant.vanes]
            if f"{curve.at} {curve.how}" not in places:
                raise InputError(
                    f"{where}: at, how (={curve.at!r}, {curve.how!r}) is {_not(curve.at, plant, ())}; allowed: "
                    f"{', '.join(places)}"
                )
            lag = named_lag(curve.of)
            channel = lag[0] if lag else stops_of(curve.of) or curve.of
            if channel not in own and period_of(curve.of) == 0.0 or quantity_of(curve.of) is None:
                raise InputError(
                    f"{where}: of (={curve.of!r}) is unknown; allowed: {', '.join(own)}, time_every_TIME such as "
                    f"time_every_20_ms, SIGNAL_lagged_by_TIME such as n_r_lagged_by_20_s, "
                    f"stops_of_SIGNAL"
                )
            curve.check(where)
            values = self.effects.get(name, {})
            if unknown := next((k for k in values if k not in curve.numbers), None):
                raise InputError(
                    f"{source}: effects.{name}: {unknown!r} is unknown; allowed: {', '.join(curve.numbers)}"
                )

    def plant(self, base: Plant | None = None) -> Plant:
        """Return the machine: ``base`` (default: the shipped tables) with this model's parameters and effects.

        Raises InputError for what `check` refuses.
        """
        machine = base or build_plant()
        self.check(machine)
        p = machine.p.copy()
        self._put(p, machine, self)
        for name, side in self.sides.items():
            lane = SIDE_NAMES.index(name)
            self._put(p[:, lane : lane + 1], machine, side)
        derive(p, chain.TICK / chain.SUBSTEPS, chain.TICK)
        if not np.isfinite(p).all():
            raise InputError("model: a number that follows from its parameters, effects or curves is not finite")
        return replace(machine, p=p)

    def _put(self, p: np.ndarray, machine: Plant, part: Model | Side) -> None:
        """Put parameters and effects into ``p``."""
        known = {n.name: n for n in machine.nominal}
        for name, value in part.parameters.items():
            row = known[name].row
            p[row] = value * known[name].si
            if PLAY <= row < PLAY + MOST:  # declared at the vane, used at the ring
                ldp, lever = machine.lever(row - PLAY)
                p[row] *= lever / ldp
        for effect, values in part.effects.items():
            if effect in self.curves:
                with np.errstate(over="ignore", invalid="ignore"):  # refused by `plant`
                    put_curve(p, self.curves[effect], values)
                continue
            for row, parameter in machine.parameters_of(effect).items():
                p[row] = values.get(parameter.name, parameter.neutral) * parameter.si


def side_of(name: str) -> tuple[str, str]:
    """Split a name such as ``side_b.lvdt_bias`` into its side and what it names; "" and the name where it has none."""
    side, _, rest = name.partition(".")
    return (side, rest) if side in SIDE_NAMES else ("", name)


def of_a_side(name: str, one_valve: bool) -> bool:
    """Whether a parameter or an effect can be that of one of two actuators, with a valve each or with one."""
    own = ("actuator", "lvdt") if one_valve else ("valve", "actuator", "lvdt")
    if name in EFFECTS:
        return EFFECTS[name].site in (*own, "link") and name != "aero_load"
    if one_valve and name in ("actuator.flow_gain", "actuator.area"):
        return False
    return name.split(".")[0] in own or name == "sensors.lvdt_lag" or "." not in name


def put_curve(p: np.ndarray, curve: Learned, values: Mapping[str, float]) -> None:
    """Put a curve with these ``values`` (what is not named: as learned) behind those that ``p`` has, in every lane."""
    numbers = np.array(curve.now(values).values)
    place, of = PLACES[f"{curve.at} {curve.how}"], quantity_of(curve.of)
    assert of is not None  # `Model.check`
    at_curve(p, place, of, *curve.ends, curve.table()(numbers)[:, None])


def load_model(path: str | Path, plant: Plant | None = None) -> Model:
    """Read a model file; ``plant`` (default: the shipped tables) gives the nominal values that its parameters must be
    near to.

    Raises InputError in one line: file, key, value, what is allowed.
    """
    model = read(path, Model)
    model.check(plant or build_plant(), path)
    return model


def write_model(path: str | Path, model: Model) -> None:
    """Write a model file that `load_model` reads as the same model. Raises InputError where it cannot be written."""
    write(path, text_of(model))


def text_of(model: Model) -> str:
    """Content of the model file."""
    lines = []
    if model.meta:
        lines += ["[meta]", *(f"{_key(k)} = {json.dumps(v, ensure_ascii=False)}" for k, v in model.meta.items()), ""]
    lines += _lines_of(model)
    for name, side in model.sides.items():
        lines += _lines_of(side, f"{name}.")
    for name, curve in model.curves.items():
        of = curve.model_dump(exclude_defaults=True)
        for key, axis in ((_key(name), of), (f"{_key(name)}.second", of.pop("second", {}))):
            rows = [f"{k} = {json.dumps(v, ensure_ascii=False)}" for k, v in axis.items()]
            lines += [f"[curves.{key}]", *rows, ""] if rows else []
    return "\n".join(lines)


def _lines_of(part: Model | Side, at: str = "") -> list[str]:
    """Lines of parameters and effects, in tables whose names begin with ``at``."""
    lines = []
    if part.parameters:
        lines += [f"[{at}parameters]", *(f"{_key(k)} = {float(v)!r}" for k, v in part.parameters.items()), ""]
    for effect, values in part.effects.items():
        units = {p.name: p.unit for p in EFFECTS[effect].parameters} if effect in EFFECTS else {}
        lines += [
            f"[{at}effects.{_key(effect)}]",
            *(f"{_key(k)} = {float(v)!r}{f'  # {units[k]}' if k in units else ''}" for k, v in values.items()),
            "",
        ]
    return lines


def _key(name: str) -> str:
    return (
        name
        if name and all(c.isascii() and (c.isalnum() or c in "_-") for c in name)
        else json.dumps(name, ensure_ascii=False)
    )


def _not(name: str, plant: Plant, known: Iterable[str]) -> str:
    """Why a name cannot be: of a stage that the machine lacks, or unknown."""
    vane = vane_in(name)
    if vane is not None and vane not in plant.vanes:
        return f"of a vane row that this machine lacks ({vane})"
    return f"unknown{_meant(name, known)}"


def _meant(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), 1)
    return f", probably {close[0]!r} is meant" if close else ""


def _within(value: float, low: float, high: float, unit: str, what: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise InputError(f"{what} (={value:g} {unit}) must be in [{low:g}, {high:g}]")


def allowed_of(plant: Plant, n: Nominal) -> tuple[float, float]:
    """Return the least and the greatest value, in its table's unit, that a model may give a nominal parameter."""
    bound = _bound(plant, n.name)
    if n.tolerance <= 0.0:
        return bound.low, bound.high
    return max(bound.low, n.value - FAR * n.tolerance), min(bound.high, n.value + FAR * n.tolerance)


def _bound(plant: Plant, name: str) -> Bound:
    """Physical bounds of a nominal parameter, in its table's unit."""
    section, key = name.split(".")
    if section == "linkage":
        fields: Any = Stage.model_fields["hysteresis" if key.endswith("_play") else key.split("_", 1)[1]]
    else:
        table: Any = type(getattr(plant.table, section))
        fields = table.model_fields["pot_bias" if key.endswith("_bias") else key]
    return next(m for m in fields.metadata if isinstance(m, Bound))
