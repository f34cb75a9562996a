"""A learned law as a Python file: its formula, or its curve as a table, with units, range, and a test of its own.

On a user's own model it is a `vaneloop.Law`, for the ``laws`` of the `System`; there a law may be a function of the
signal or state that it acts on, of a displacement, or of time. Of a difference of two, which no such law is given, it
is functions for the model itself. Of the vane chain, and of two quantities, it is the function alone.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np

from vaneloop.base.errors import InputError
from vaneloop.base.forms import NAMED
from vaneloop.identification.candidates.closed_forms import Formula
from vaneloop.identification.settings import LAW_TEST_VALUES, SURFACE_TEST_VALUES, TABLE_POINTS
from vaneloop.identification.unmodelled.closed_form_fits import Product
from vaneloop.identification.unmodelled.learned_law import LearnedLaw, LearnedSurface
from vaneloop.identification.user_models.exogenous_regressors import TIME, sides_of
from vaneloop.identification.user_models.system import System

__all__ = ["python_law"]

FILE = '''"""{sentence}

Equation::

    curve = {equation}

Symbols: q is {of} ({of_unit}); the curve is in {unit}.
Range: learned for q in [{been}]{goes}; beyond, it stays as at the ends.
Error on held-out data: {before:.3g} noise floors without it, {after:.3g} with it.
"""

import math
{imports}
{constants}

def curve(q):
    """The curve at ``q``."""
    q = {within}
    return {code}

{law}
def test_curve():
    """The curve is what was learned."""
    for q, y in {held}:
        assert math.isclose(curve(q), y, rel_tol=1e-6, abs_tol=1e-9)
{test}'''

OWN_LAW = '''
def {function}({arguments}):
    """What the law gives, ``p.scale`` times as much as was learned."""
    return {gives}


LAW = Law(
    "{name}",
    "{on}",
    {function},
    parameters=[Parameter("scale", 0.0, "-", low=-3.0, high=3.0)],
    starts=[1.0],
    places=["{place}"],
)

'''

OF_DIFFERENCE = '''
def quantity(x, u):
    """What it is a function of: a difference that no law of its own is given, so that the model calls both functions.

    With c = curve(quantity(x, u)), {use}.
    """
    return {one} - {other}

'''
USES = {
    "parameter times": "p.{at} * (1.0 + c) stands in the place of p.{at}",
    "input adds": "u.{at} + c stands in the place of u.{at}",
    "input times": "u.{at} * (1.0 + c) stands in the place of u.{at}",
    "state adds": "{c} is taken off the derivative of {at}",
    "output adds": "c is added to what the output {at} gives",
    "output times": "the output {at} gives 1.0 + c times as much",
}

OWN_TEST = '''

def test_law():
    """At its neutral value it changes nothing."""
    p = type("P", (), {{"scale": 0.0}})
    assert {function}({some}) == {nothing}
'''


def python_law(law: LearnedLaw, system: System | None = None) -> str:
    """The text of the file; ``system``: the user's own model, else the vane chain.

    Raises InputError where a `Law` cannot say it: where it is a function of another channel, or multiplies a parameter.
    """
    if isinstance(law, LearnedSurface):
        return _surface(law)
    low, high = law.reach if law.spoken else (float(law.x[0]), float(law.x[-1]))
    code, constants, equation = _code(law)
    curve = _compiled("curve(q)", constants, f"return {code}")
    parts = _own_law(law, system) if system is not None else {"imports": "", "law": "", "test": ""}
    been = f"{law.x[0]:.6g}, {law.x[-1]:.6g}"
    period = law.period
    along = period > 0.0 and law.channel != TIME  # what the file is given is the whole way, not that within a period
    within = f"q % {period!r}" if along else f"min(max(q, {low!r}), {high!r})"
    of = f"{law.channel}, of which each {period:.6g} {law.of_unit.strip('-')} are alike" if along else law.of
    places = np.linspace(low, high, LAW_TEST_VALUES, endpoint=not along).tolist()
    held = [(q, float(curve(q))) for q in places]
    goes = f", and goes on to [{low:.6g}, {high:.6g}]" if law.spoken else ""
    return FILE.format(
        **_said(law), equation=equation, of=of, been=been, goes=goes, code=code, constants=constants, held=held,
        within=within, **parts,
    )  # fmt: skip


def _said(law: LearnedLaw) -> dict[str, object]:
    """What the head of the file says of any law."""
    sentence = law.sentence().rstrip(".")
    return {
        "sentence": f"{sentence[0].upper()}{sentence[1:]}.", "of_unit": law.of_unit or "-", "unit": law.unit or "-",
        "before": law.error_before, "after": law.error_after,
    }  # fmt: skip


def _compiled(head: str, constants: str, body: str) -> Callable[..., float]:
    """The function that the file will have."""
    space: dict[str, Any] = {}
    exec(f"import math\n{constants}\ndef {head}:\n    {body}", space)  # our own text
    return cast("Callable[..., float]", space[head.partition("(")[0]])


def _formula(formula: Formula, code: str) -> tuple[str, str]:
    """The code of a formula, less what a parameter of the model has of it, and its constants."""
    constants = "".join(f"{k.upper()} = {v!r}\n" for k, v in formula.numbers.items())
    if not formula.level:
        return code, constants
    return f"{code} + LEVEL", f"{constants}LEVEL = {formula.level!r}  # the model's own parameter has the mean\n"


def _code(law: LearnedLaw) -> tuple[str, str, str]:
    """The curve as an expression of q, its constants, and the equation in words."""
    if f := law.spoken or (law.formulas[0] if law.formulas else None):
        names = {k: k.upper() for k in f.numbers}
        return *_formula(f, NAMED[f.form].code.format(**names)), f.text.replace(law.of, "q")
    places = np.linspace(0, len(law.x) - 1, TABLE_POINTS).astype(int)
    x, y = (tuple(float(f"{v:.9g}") for v in a[places]) for a in (law.x, law.y))
    step = (x[-1] - x[0]) / (TABLE_POINTS - 1)
    constants = f"Y = {y!r}\n"
    at = f"min(int((q - {x[0]!r}) / {step!r}), {TABLE_POINTS - 2})"
    code = f"Y[{at}] + (Y[{at} + 1] - Y[{at}]) * ((q - {x[0]!r}) / {step!r} - {at})"
    return code, constants, f"a table of {TABLE_POINTS} points, straight between them (no formula fits it)"


def _own_law(law: LearnedLaw, system: System) -> Mapping[str, str]:
    """The parts of the file that make it a `Law`, or functions for the model."""
    if (sides := _sides(law, system)) is not None:
        c = f"c / p.{system.masses[law.at]}" if law.at in system.masses else "c"
        one, other = sides
        use = USES[law.how].format(at=law.at, c=c)
        return {"imports": "", "law": OF_DIFFERENCE.format(use=use, one=one, other=other), "test": ""}
    own = law.at.removesuffix("_sensor")
    name = law.name.rpartition(".")[2]
    on = {"input adds": "signal", "output adds": "signal", "state adds": "state", "force adds": "force"}.get(law.how)
    if on == "state" and law.at in system.rates:
        on = "force"
    way = "position" if law.how == "force adds" else system.rates.get(law.at, "")
    speed = "velocity" if law.how == "force adds" else law.at
    of = {
        "signal": {own: "u"}, "state": {own: "x"}, "force": {speed: "v", **({way: "x"} if way else {})},
    }.get(on or "", {}).get(law.channel)  # fmt: skip
    if on is None or of is None:
        raise InputError(
            f"--python: {law.name} is a function of {law.of} at {law.at}; a Law of your own can be one of the signal, "
            f"state or motion that it acts on. --out writes this one"
        )
    arguments = {"signal": "u, t, p", "state": "x, t, p", "force": "v, x, t, p"}[on]
    does = f"p.scale * curve({of})"
    some = {"signal": "1.5, 0.0, p", "state": "1.5, 0.0, p", "force": "1.5, 0.5, 0.0, p"}[on]
    parts = {
        "function": "acts", "arguments": arguments, "gives": f"u + {does}" if on == "signal" else does, "name": name,
        "on": on, "place": law.at, "some": some, "nothing": "1.5" if on == "signal" else "0.0",
    }  # fmt: skip
    return {
        "imports": "\nfrom vaneloop import Law, Parameter\n", "law": OWN_LAW.format(**parts),
        "test": OWN_TEST.format(**parts),
    }  # fmt: skip


def _sides(law: LearnedLaw, system: System) -> tuple[str, str] | None:
    """Of a law of a difference of what the model is called with, both as the model has them; None: it is another."""
    drives = system.commands if system.kind == "closed_loop" else system.inputs
    known = {**{n: f"u.{n}" for n in drives}, **{n: f"x.{n}" for n in system.states}}
    sides = sides_of(law.of, known) if system.states and law.how in USES else None
    return None if sides is None else (known[sides[0]], known[sides[1]])


# ---- A law of two quantities


SURFACE_FILE = '''"""{sentence}

Equation::

    surface = {equation}

Symbols: q1 is {of} ({of_unit}), q2 is {second} ({second_unit}); the surface is in {unit}.
Range: learned for q1 in [{low[0]:.6g}, {high[0]:.6g}] and q2 in [{low[1]:.6g}, {high[1]:.6g}]; beyond, it stays as at
the ends.
Error on held-out data: {before:.3g} noise floors without it, {after:.3g} with it.
"""

import math

{constants}

def surface(q1, q2):
    """The surface at ``q1`` and ``q2``."""
    q1, q2 = min(max(q1, {low[0]!r}), {high[0]!r}), min(max(q2, {low[1]!r}), {high[1]!r})
    {code}


def test_surface():
    """The surface is what was learned."""
    for q1, q2, y in {held}:
        assert math.isclose(surface(q1, q2), y, rel_tol=1e-6, abs_tol=1e-9)
'''
TABLE = """z1, z2 = (q1 - {low[0]!r}) / {step[0]!r}, (q2 - {low[1]!r}) / {step[1]!r}
    k, m = min(int(z1), {last}), min(int(z2), {last})
    near = Y[k][m] + (Y[k][m + 1] - Y[k][m]) * (z2 - m)
    far = Y[k + 1][m] + (Y[k + 1][m + 1] - Y[k + 1][m]) * (z2 - m)
    return near + (far - near) * (z1 - k)"""


def _surface(law: LearnedSurface) -> str:
    """The text of the file."""
    low, high = ((float(law.x[k]), float(law.across[k])) for k in (0, -1))
    code, constants, equation = _surface_code(law, low, high)
    surface = _compiled("surface(q1, q2)", constants, code)
    places = [np.linspace(a, b, SURFACE_TEST_VALUES).tolist() for a, b in zip(low, high, strict=True)]
    held = [(p, q, float(surface(p, q))) for p in places[0] for q in places[1]]
    return SURFACE_FILE.format(
        **_said(law), equation=equation, of=law.of, second=law.second, second_unit=law.second_unit or "-", low=low,
        high=high, code=code, constants=constants, held=held,
    )  # fmt: skip


def _surface_code(law: LearnedSurface, low: tuple[float, float], high: tuple[float, float]) -> tuple[str, str, str]:
    """The surface in lines of Python, its constants, and the equation in words."""
    best = law.formulas[0] if law.formulas else None
    if isinstance(best, Product):
        one, other = best.forms
        first, second = (re.sub(r"\bq\b", f"q{k + 1}", form.code) for k, form in enumerate((one, other)))
        first = first.format(**{n: n.upper() for n in one.numbers})
        second = second.format(**{n: f"SECOND_{n.upper()}" for n in other.numbers[1:]} | {other.numbers[0]: "1.0"})
        names = {law.of: "q1", law.second: "q2"}
        equation = re.sub(r"\b(" + "|".join(map(re.escape, names)) + r")\b", lambda m: names[m.group(1)], best.text)
        return *_formula(best, f"return ({first}) * ({second})"), equation
    some = np.linspace(0, len(law.x) - 1, TABLE_POINTS).astype(int)
    rows = [tuple(float(f"{v:.9g}") for v in row) for row in law.values[np.ix_(some, some)]]
    constants = "Y = (\n" + "".join(f"    {row!r},\n" for row in rows) + ")\n"
    step = tuple((b - a) / (TABLE_POINTS - 1) for a, b in zip(low, high, strict=True))
    said = f"a table of {TABLE_POINTS} x {TABLE_POINTS} points, straight between them (no formula fits it)"
    return TABLE.format(low=low, step=step, last=TABLE_POINTS - 2), constants, said
