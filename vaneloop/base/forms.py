"""Simple formulas of one quantity: y = a f(q), with at most two numbers inside f and operators of mechanics and heat:
powers, roots, exponentials, tanh, magnitudes, dead zones, limits, quotients, Arrhenius' law, sines.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

__all__ = ["FORMS", "NAMED", "Form", "product"]

Array = np.ndarray
KELVIN = 273.15


@dataclass(frozen=True)
class Form:
    """A formula: ``value(q, numbers)``; ``text`` with the quantity as q and the numbers by name.

    complexity  operators and numbers
    code      the same in Python, for one number q, with each of the numbers' names in braces
    numbers   its names; the first multiplies the whole
    inner     sizes of the numbers inside f to begin from, as shares: of q's range (``per``: of one over it, ``at``: of
              the way from lowest to highest, ``kelvin``: of 10,000 K, ``plain``: as they are)
    positive  only for a quantity that stays above 0; ``signed``: only for one that does not, else it is another form
    magnitudes  which of the numbers have a sign that changes nothing
    jump      of one that is a level and a jump: from its numbers to the level, half the jump, and where it is
    """

    name: str
    text: str
    code: str
    complexity: int
    value: Callable[[Array, Array], Array]
    numbers: tuple[str, ...] = ("a",)
    inner: tuple[tuple[str, tuple[float, ...]], ...] = ()
    positive: bool = False
    signed: bool = False
    magnitudes: tuple[int, ...] = ()
    jump: Callable[[Array], tuple[float, float, float]] | None = None

    def plain(self, numbers: Array) -> Array:
        """The same numbers, without signs that change nothing."""
        out = np.array(numbers, dtype=float)
        out[list(self.magnitudes)] = np.abs(out[list(self.magnitudes)])
        return out


def _power(q: Array, n: Array) -> Array:
    return np.asarray(n[0] * np.sign(q) * np.maximum(np.abs(q), 1e-12) ** np.clip(n[1], -8.0, 8.0))


def _exp(q: Array, n: Array) -> Array:
    return np.asarray(n[0] * np.expm1(np.clip(n[1] * q, -50.0, 50.0)))


_PER = ("per", (0.3, -0.3, 1.0, -1.0, 3.0, -3.0))
_AT = ("at", (0.15, 0.4, 0.6, 0.85))
_WIDTH = ("share", (0.05, 0.15, 0.3))

FORMS: tuple[Form, ...] = (
    Form("constant", "a", "{a}", 1, lambda q, n: n[0] + 0.0 * q),
    Form("line", "a q", "{a} * q", 2, lambda q, n: n[0] * q),
    Form("straight line", "a (q - b)", "{a} * (q - {b})", 3, lambda q, n: n[0] * (q - n[1]), ("a", "b"), (_AT,)),
    Form("magnitude", "a |q|", "{a} * abs(q)", 3, lambda q, n: n[0] * np.abs(q), signed=True),
    Form("sign", "a sign(q)", "{a} * ((q > 0.0) - (q < 0.0))", 3, lambda q, n: n[0] * np.sign(q), signed=True,
         jump=lambda n: (0.0, float(n[0]), 0.0)),
    Form("square", "a q^2", "{a} * q * q", 3, lambda q, n: n[0] * q * q),
    Form("signed square", "a q |q|", "{a} * q * abs(q)", 4, lambda q, n: n[0] * q * np.abs(q), signed=True),
    Form("cube", "a q^3", "{a} * q**3", 3, lambda q, n: n[0] * q**3),
    Form("root", "a sign(q) sqrt(|q|)", "{a} * math.copysign(math.sqrt(abs(q)), q)", 4,
         lambda q, n: n[0] * np.sign(q) * np.sqrt(np.abs(q))),
    Form("inverse", "a / q", "{a} / max(q, 1e-12)", 3, lambda q, n: n[0] / np.maximum(q, 1e-12), positive=True),
    Form("power", "a sign(q) |q|^b", "{a} * ((q > 0.0) - (q < 0.0)) * max(abs(q), 1e-12) ** {b}", 5, _power,
         ("a", "b"), (("plain", (0.5, 0.8, 1.5, 2.5, 4.0)),)),
    Form("exponential", "a (exp(b q) - 1)", "{a} * math.expm1(min(max({b} * q, -50.0), 50.0))", 5, _exp, ("a", "b"),
         (_PER,)),
    Form("tanh", "a tanh(b q)", "{a} * math.tanh({b} * q)", 4, lambda q, n: n[0] * np.tanh(n[1] * q), ("a", "b"),
         (("per", (1.0, 3.0, 10.0)),)),
    Form("quotient", "a q / (1 + b |q|)", "{a} * q / max(1.0 + {b} * abs(q), 1e-3)", 5,
         lambda q, n: n[0] * q / np.maximum(1.0 + n[1] * np.abs(q), 1e-3), ("a", "b"), (("per", (0.3, 1.0, 5.0)),)),
    Form("above", "a max(q - b, 0)", "{a} * max(q - {b}, 0.0)", 4, lambda q, n: n[0] * np.maximum(q - n[1], 0.0),
         ("a", "b"), (_AT,)),
    Form("below", "a min(q - b, 0)", "{a} * min(q - {b}, 0.0)", 4, lambda q, n: n[0] * np.minimum(q - n[1], 0.0),
         ("a", "b"), (_AT,)),
    Form("step", "a (q > b)", "{a} * (q > {b})", 4, lambda q, n: n[0] * (q > n[1]), ("a", "b"),
         (("at", tuple(np.linspace(0.02, 0.98, 97))),), jump=lambda n: (0.5 * n[0], 0.5 * float(n[0]), float(n[1]))),
    Form("gentle step", "a / (1 + exp(-(q - b)/c))", "{a} / (1.0 + math.exp(min(max(({b} - q) / {c}, -50.0), 50.0)))",
         6, lambda q, n: n[0] / (1.0 + np.exp(np.clip(-(q - n[1]) / np.maximum(np.abs(n[2]), 1e-9), -50.0, 50.0))),
         ("a", "b", "c"), (_AT, _WIDTH), magnitudes=(2,)),
    Form("dead zone", "a sign(q) max(|q| - b, 0)", "{a} * math.copysign(max(abs(q) - {b}, 0.0), q)", 5,
         lambda q, n: n[0] * np.sign(q) * np.maximum(np.abs(q) - np.abs(n[1]), 0.0), ("a", "b"), (_WIDTH,), signed=True,
         magnitudes=(1,)),
    Form("limit to one side", "a clip(q, min(b, 0), max(b, 0))", "{a} * min(max(q, min({b}, 0.0)), max({b}, 0.0))", 4,
         lambda q, n: n[0] * np.clip(q, np.minimum(n[1], 0.0), np.maximum(n[1], 0.0)), ("a", "b"),
         (("share", (0.05, 0.15, 0.3, -0.05, -0.15, -0.3)),)),
    Form("limit", "a clip(q, -b, b)", "{a} * min(max(q, -{b}), {b})", 4,
         lambda q, n: n[0] * np.clip(q, -np.abs(n[1]), np.abs(n[1])), ("a", "b"),
         (("share", (0.1, 0.2, 0.35)),), magnitudes=(1,)),
    Form("Arrhenius", "a exp(b/300 - b/(q + 273.15))",
         "{a} * math.exp(min(max({b} / 300.0 - {b} / (q + 273.15), -50.0), 50.0))", 6,
         lambda q, n: n[0] * np.exp(np.clip(-n[1] / (q + KELVIN) + n[1] / 300.0, -50.0, 50.0)), ("a", "b"),
         (("kelvin", (0.1, 0.5, -0.3)),)),
    Form("sine", "a sin(b q + c)", "{a} * math.sin({b} * q + {c})", 5, lambda q, n: n[0] * np.sin(n[1] * q + n[2]),
         ("a", "b", "c"), (("per", (3.0, 6.0, 12.0, 25.0)), ("plain", (0.0, 1.6, 3.1)))),
)  # fmt: skip
NAMED = {form.name: form for form in FORMS}


def product(one: Form, other: Form, x: Array, z: Array, numbers: Array) -> Array:
    """``one`` of x times ``other`` of z, float64[x, z]; ``numbers`` are those of the first, and of the other all but
    what multiplies it.
    """
    k = len(one.numbers)
    f, g = one.value(x, numbers[:k]), other.value(z, np.concatenate([[1.0], numbers[k:]]))
    return np.asarray(np.broadcast_to(f, x.shape)[:, None] * np.broadcast_to(g, z.shape))
