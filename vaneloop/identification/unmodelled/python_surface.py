"""A learned law of two quantities as a Python file: its formula, or its values as a table, with units, range, and a
test of its own. It is the function alone: a `vaneloop.Law` is one of what it acts on.
"""

from __future__ import annotations

import re

import numpy as np

from vaneloop.identification.settings import SURFACE_TEST_VALUES, TABLE_POINTS
from vaneloop.identification.unmodelled.learned_surface import LearnedSurface
from vaneloop.identification.unmodelled.surface_closed_forms import Product

__all__ = ["python_surface"]


FILE = '''"""{sentence}

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


def python_surface(law: LearnedSurface) -> str:
    """The text of the file."""
    low, high = ((float(law.x[k]), float(law.across[k])) for k in (0, -1))
    code, constants, equation = _code(law, low, high)
    space: dict[str, object] = {}
    exec(f"import math\n{constants}\ndef surface(q1, q2):\n    {code}", space)  # our own text
    places = [np.linspace(a, b, SURFACE_TEST_VALUES).tolist() for a, b in zip(low, high, strict=True)]
    held = [(p, q, float(space["surface"](p, q))) for p in places[0] for q in places[1]]  # type: ignore[operator]
    sentence = law.sentence().rstrip(".")
    return FILE.format(
        sentence=f"{sentence[0].upper()}{sentence[1:]}.", equation=equation, of=law.of, of_unit=law.of_unit or "-",
        second=law.second, second_unit=law.second_unit or "-", unit=law.unit or "-", low=low, high=high,
        before=law.error_before, after=law.error_after, code=code, constants=constants, held=held,
    )  # fmt: skip


def _code(law: LearnedSurface, low: tuple[float, float], high: tuple[float, float]) -> tuple[str, str, str]:
    """The surface in lines of Python, its constants, and the equation in words."""
    best = law.formulas[0] if law.formulas else None
    if isinstance(best, Product):
        constants = "".join(f"{k.upper()} = {v!r}\n" for k, v in best.numbers.items())
        one, other = best.forms
        first, second = (re.sub(r"\bq\b", f"q{k + 1}", form.code) for k, form in enumerate((one, other)))
        first = first.format(**{n: n.upper() for n in one.numbers})
        second = second.format(**{n: f"SECOND_{n.upper()}" for n in other.numbers[1:]} | {other.numbers[0]: "1.0"})
        code = f"return ({first}) * ({second})"
        if best.level:
            constants += f"LEVEL = {best.level!r}  # the model's own parameter has the mean\n"
            code += " + LEVEL"
        names = {law.of: "q1", law.second: "q2"}
        equation = re.sub(r"\b(" + "|".join(map(re.escape, names)) + r")\b", lambda m: names[m.group(1)], best.text)
        return code, constants, equation
    some = np.linspace(0, len(law.x) - 1, TABLE_POINTS).astype(int)
    rows = [tuple(float(f"{v:.9g}") for v in row) for row in law.values[np.ix_(some, some)]]
    constants = "Y = (\n" + "".join(f"    {row!r},\n" for row in rows) + ")\n"
    step = tuple((b - a) / (TABLE_POINTS - 1) for a, b in zip(low, high, strict=True))
    code = TABLE.format(low=low, step=step, last=TABLE_POINTS - 2)
    return (
        code,
        constants,
        f"a table of {TABLE_POINTS} x {TABLE_POINTS} points, straight between them (no formula fits it)",
    )
