"""A law that was learned, from its table in a model file: put where it acts."""

from __future__ import annotations

import numpy as np

from plant.model import Learned
from vaneloop.base.durations import folded
from vaneloop.base.errors import InputError
from vaneloop.base.forms import NAMED
from vaneloop.identification.candidates.library import Law
from vaneloop.identification.settings import CURVE_BOUND, LEVEL_SPREAD
from vaneloop.identification.subsystem import Effect, Parameter, StageError
from vaneloop.identification.user_models.data import Data
from vaneloop.identification.user_models.exogenous_regressors import DISTANCE, SINCE, TIME, WAY, sides_of
from vaneloop.identification.user_models.hysteresis_regressors import STOPS, named_lag
from vaneloop.identification.user_models.simulation import Placed
from vaneloop.identification.user_models.terms import COLUMN, HOW, INPUT, OUTPUT, Curve, Surface, runs

__all__ = ["CURVE_LAW", "from_file"]

CURVE_LAW = Law("curve", 0, "a function of one quantity", lambda _: ((), ()))


def from_file(name: str, law: Learned, data: Data) -> tuple[Placed, Effect]:
    """What runs, and what the search is told of it. Raises StageError, one line, for what the system does not have."""
    s = data.system

    def wrong(what: str, value: object, allowed: str, where: str = "") -> StageError:
        return StageError(
            f"curves.{name}{where}: {what} (={value!r}) is not one of system {s.name!r}; allowed: {allowed}"
        )

    if law.how not in HOW:
        raise wrong("how", law.how, ", ".join(HOW))
    signals = list(s.commands) if s.kind == "closed_loop" else data.in_names
    where = law.how.split()[0]
    named = {
        "parameter": [p.name for p in s.parameters], "input": signals, "state": list(s.states),
        "force": ["force"] if s.kind == "force" else [],
        "output": [s.reading_of(o) for o in s.outputs],
    }[where]  # fmt: skip
    if law.at not in named:
        raise wrong("at", law.at, ", ".join(named) or f"nothing, with how = {law.how!r}")
    moves = s.kind in ("simulate", "closed_loop")
    known = {o: OUTPUT + i for i, o in enumerate(s.outputs)}
    known |= {u: INPUT + i for i, u in enumerate(signals)}
    known |= {x: i for i, x in enumerate(s.states)} if moves else {}
    columns = set.intersection(*(set(r.columns) for r in data.records))
    prefixes = (WAY, DISTANCE, SINCE) if law.second else (WAY, DISTANCE, SINCE, STOPS)  # of two nothing slips
    shaped = {prefix + c for c in columns for prefix in prefixes}

    def number(of: str, where: str = "") -> int:
        lag, found, period = named_lag(of), known.get(of, COLUMN), folded(of)
        if found == COLUMN and period and of not in columns:
            return number(period[0], where)
        column = of in (TIME, *columns, *shaped) or lag and lag[0] in columns
        if found == COLUMN and not column:
            raise wrong("of", of, ", ".join([*known, TIME, *sorted(columns - set(known))]), where)
        return found

    sides = None if law.second else sides_of(law.of, {*known, *columns})  # a surface is of no difference
    of, less = number(sides[0] if sides else law.of), (number(sides[1]), sides[1]) if sides else None
    try:
        law.check(f"curves.{name}")
    except InputError as e:
        raise StageError(str(e)) from None
    form = NAMED.get(law.form) if law.second is None else None
    table, jump = runs(form, *law.ends) if form else (law.table(), None)
    if law.jump and not form:
        smooth = law.model_copy(update={"jump": False}).table()
        table, jump = (lambda v: smooth(v[:-1])), (lambda v: (float(v[-1]), 0.0))
    within = folded(law.of) if of < COLUMN and law.of not in known else None
    period = within[1] if within else 0.0
    curve = Curve(law.how, named.index(law.at), of, law.of, *law.ends, table, jump, less, period)
    if (two := law.second) is not None:
        curve = Surface(
            curve.how, curve.place, of, law.of, law.low, law.high, table, of_second=number(two.of, ".second"),
            second=two.of, low_second=two.low, high_second=two.high,
        )  # fmt: skip
    names = law.numbers
    sizes = [max(abs(v), 1e-9) for v in law.values] if law.form else [abs(law.size) or 1.0] * len(names)
    wide = np.sqrt(3.0) * LEVEL_SPREAD if not law.form else 0.0  # a curve's values are known to be of its size
    ps = tuple(
        Parameter(n, 0.0, law.unit, -CURVE_BOUND * z, CURVE_BOUND * z, scale=z, tolerance=float(wide * z))
        for n, z in zip(names, sizes, strict=True)
    )
    effect = Effect(name, ps, (tuple(float(v) for v in law.values),), "a function that was learned")
    return Placed(name, CURVE_LAW, "curve", -1, 0.0, neutral=np.zeros(len(ps)), curve=curve), effect
