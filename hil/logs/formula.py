"""Formulas of channels: ``lag = x_dem - x_lvdt [um]``. One small grammar for notebook, command line and workbench.

A formula is read here, and nothing of it is ever run as code. What it says of its samples:

- Each channel has a raster of its own. Where two meet, the finer raster stays, from where both have begun to where the
  first ends. Between two samples of the other lies a straight line; a channel of whole numbers, such as ``state``,
  holds its value.
- In a hole of a channel (`vaneloop.base.holes`) there is no sample, nor where the result is no finite number.
- Units go along: a product has the product of its units; a sum needs units that convert, and has that of its first
  part. What has no unit takes that of what it is added to. Angles in deg are deg for ``sin``, too.
"""

from __future__ import annotations

import functools
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from hil.logs.errors import LogError
from hil.logs.units import NO_UNIT, factor_of
from vaneloop.base.errors import meant
from vaneloop.base.holes import holes

__all__ = ["FUNCTIONS", "OPERATORS", "Formula", "FormulaError", "Made", "aligned", "formula_of", "named"]

Array = np.ndarray
MOST = 400  # characters
DEEPEST = 40  # brackets, signs and functions within each other
OPERATORS = "+ - * / % ** ^ < <= > >= == != and or not ( ) ,"
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[^\W\d][\w.]*)|`(?P<quoted>[^`]+)`"
    r"|(?P<sign>\*\*|<=|>=|==|!=|[-+*/%^<>(),]))"
)
_HEAD = re.compile(r"\s*(?P<name>[^\W\d]\w*)?\s*=(?!=)")
_UNIT = re.compile(r"\[(?P<unit>[^\[\]]*)\]\s*$")
_UNIT_TEXT = re.compile(r"(?=.*[^\W\d_]|.*[%°])[\w%°/*^.() -]{1,32}")
_SYMBOL = re.compile(
    r"(?P<by>[*/ ·]?)(?P<symbol>[^\W\d_]+(?:_[^\W\d_]+)*|[%°])(?:(?:\*\*|\^)?(?P<power>-?\d+))?|1(?=/)"
)


class FormulaError(LogError):
    """A formula that cannot be read or made: one line with the position of what is wrong, counted from 1."""

    def __init__(self, text: str, at: int, what: str):
        super().__init__(f"formula {text!r}, position {at + 1}: {what}")
        self.at = at


class Sampled(Protocol):
    """What a formula needs of a channel."""

    @property
    def t(self) -> Array: ...

    @property
    def values(self) -> Array: ...

    @property
    def unit(self) -> str: ...


class Made(NamedTuple):
    """A channel made by a formula: s, values, and their unit ("-": none)."""

    t: Array
    values: Array
    unit: str


# ---- units -----------------------------------------------------------------------------------------------------------

Powers = tuple[tuple[str, Fraction], ...]  # symbol and power, in the order in which they came
NONE: Powers = ()


@functools.lru_cache(maxsize=256)
def _powers(unit: str) -> Powers:
    """The symbols of a unit with their powers; one that cannot be taken apart is a symbol itself."""
    if unit.strip().casefold() in (*NO_UNIT, "1"):
        return NONE
    out: Powers = ()
    at = 0
    while m := _SYMBOL.match(unit, at):
        at = m.end()
        if m["symbol"]:
            power = Fraction(int(m["power"] or 1)) * (-1 if m["by"] == "/" else 1)
            out = _product(out, ((m["symbol"], power),))
    return out if at == len(unit) else ((unit, Fraction(1)),)


def _product(a: Powers, b: Powers, times: Fraction = Fraction(1)) -> Powers:
    """The unit ``a`` times ``b`` to the power ``times``."""
    both = dict(a)
    for symbol, power in b:
        both[symbol] = both.get(symbol, Fraction(0)) + times * power
    left = {s: p for s, p in both.items() if p}
    if list(left.values()) != [1]:  # of a temperature a product has the degrees, not the zero
        left = {_degrees(s): p for s, p in left.items()}
    return tuple(left.items())


def _degrees(symbol: str) -> str:
    """The unit of a difference: K of degC; of anything without a zero of its own the same."""
    factor = factor_of(symbol, "K")
    if not isinstance(factor, tuple) or factor[1] == 0.0:
        return symbol
    return "K" if factor[0] == 1.0 else "delta_degF"


def _said(unit: Powers) -> str:
    """A unit in words: ``N*m/s**2``; "-" for none."""

    def part(symbol: str, power: Fraction) -> str:
        if power == 1:
            return symbol
        return f"{symbol}**{power}" if power.denominator == 1 else f"{symbol}**{float(power):g}"

    above = "*".join(part(s, p) for s, p in unit if p > 0)
    below = "".join(f"/{part(s, -p)}" for s, p in unit if p < 0)
    return f"{above or '1'}{below}" if unit else "-"


# ---- what is computed ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Value:
    """A number, or samples: s, values, unit; ``held``: whole numbers, which are not interpolated."""

    values: Any
    unit: Powers = NONE
    t: Array | None = None
    held: bool = False


def _on(x: _Value, t: Array) -> Array:
    """Samples at other times; NaN outside, and in a hole."""
    assert x.t is not None
    if not t.size:
        return t
    before = np.clip(np.searchsorted(x.t, t, side="right") - 1, 0, None)
    if x.held:
        out = x.values[before].astype(float)
        out[(t < x.t[0]) | (t > x.t[-1])] = np.nan
    else:
        out = np.interp(t, x.t, x.values, np.nan, np.nan)
    ends = np.zeros(x.t.size, bool)  # samples behind which there is a hole
    ends[holes(x.t)] = True
    out[ends[before] & (t > x.t[before])] = np.nan
    return out


def _together(*parts: _Value) -> tuple[Array | None, list[Any]]:
    """The finest raster of all parts, and the values of each on it."""
    times = [p.t for p in parts if p.t is not None]
    if not times:
        return None, [p.values for p in parts]
    t = min(times, key=lambda t: float(np.median(np.diff(t))) if t.size > 1 else np.inf if t.size else -1.0)
    if all(other is t or np.array_equal(other, t) for other in times):
        return t, [p.values for p in parts]
    if t.size:  # else no sample is left of a part
        t = t[(t >= max(other[0] for other in times)) & (t <= min(other[-1] for other in times))]
    return t, [p.values if p.t is None else _on(p, t) for p in parts]


def _made(f: Callable[..., Any], parts: list[_Value], unit: Powers, held: bool = False) -> _Value:
    """``f`` of all parts on one raster."""
    t, values = _together(*parts)
    return _Value(f(*values), unit, t, held and all(p.held or p.t is None for p in parts))


class _Refused(ValueError):
    """What is wrong with an operation, without its place."""


def _alike(parts: list[_Value]) -> tuple[list[_Value], Powers]:
    """All parts in the unit of the first that has one."""
    unit = next((p.unit for p in parts if p.unit), NONE)
    out = []
    for p in parts:
        if p.unit and p.unit != unit:
            factor = factor_of(_said(p.unit), _said(unit))
            if not isinstance(factor, tuple):
                raise _Refused(f"{_said(unit)} and {_said(p.unit)} do not go together")
            p = replace(p, values=factor[0] * p.values + factor[1])
        out.append(p)
    return out, unit


def _sum(f: Callable[..., Any], parts: list[_Value]) -> _Value:
    """Of what has one unit, which stays."""
    parts, unit = _alike(parts)
    return _made(f, parts, unit, True)


def _difference(parts: list[_Value]) -> _Value:
    """Of two temperatures it is in K: their zero has gone."""
    both = all(p.unit for p in parts)
    out = _sum(operator.sub, parts)
    return replace(out, unit=tuple((_degrees(s), p) for s, p in out.unit)) if both else out


def _truth(f: Callable[..., Any], parts: list[_Value]) -> _Value:
    """1 where it is so, 0 where not, none where a part has none."""

    def whether(*x: Any) -> Any:
        out = np.asarray(f(*x), dtype=float)
        return np.where(np.any(np.broadcast_arrays(*(np.isnan(v) for v in x)), axis=0), np.nan, out)

    return replace(_made(whether, _alike(parts)[0], NONE), held=True)


def _times(parts: list[_Value]) -> _Value:
    return _made(operator.mul, parts, _product(parts[0].unit, parts[1].unit), True)


def _over(parts: list[_Value]) -> _Value:
    return _made(np.divide, parts, _product(parts[0].unit, parts[1].unit, Fraction(-1)))


def _power(parts: list[_Value]) -> _Value:
    x, n = parts
    if n.unit or (x.unit and n.t is not None):
        raise _Refused(f"the power of {_said(x.unit)} must be a number")
    times = Fraction(float(n.values)).limit_denominator(1000) if x.unit else Fraction(1)
    return _made(np.power, parts, _product(NONE, x.unit, times))


def _root(parts: list[_Value]) -> _Value:
    return _made(np.sqrt, parts, _product(NONE, parts[0].unit, Fraction(1, 2)))


def _plain(f: Callable[..., Any], parts: list[_Value]) -> _Value:
    """Of the number as it stands; the result has no unit."""
    return _made(f, parts, NONE)


def _of_angle(f: Callable[..., Any], parts: list[_Value]) -> _Value:
    """Of an angle: in its unit, or in rad where it has none; of a time, too: a number before it is in rad/s."""
    unit = parts[0].unit
    factor = factor_of(_said(unit), "rad") if unit not in (NONE, _powers("s")) else (1.0, 0.0)
    if not isinstance(factor, tuple):
        raise _Refused(f"{_said(unit)} is no angle")
    return _made(lambda x: f(factor[0] * x), parts, NONE)


def _angle(f: Callable[..., Any], parts: list[_Value]) -> _Value:
    """What gives an angle, in rad, of what has one unit."""
    return _made(f, _alike(parts)[0], _powers("rad"))


def _sampled(parts: list[_Value], name: str) -> tuple[Array, Array]:
    x = parts[0]
    if x.t is None or x.t.size < 2:
        raise _Refused(f"{name} needs a channel of two samples")
    return x.t, np.asarray(x.values, dtype=float)


def _rate(parts: list[_Value]) -> _Value:
    t, v = _sampled(parts, "rate")
    out = np.gradient(v, t)
    at = holes(t)
    out[at] = out[at + 1] = np.nan  # beside a hole nobody knows
    return _Value(out, _product(parts[0].unit, (("s", Fraction(1)),), Fraction(-1)), t)


def _integral(parts: list[_Value]) -> _Value:
    t, v = _sampled(parts, "integral")
    step = np.diff(t) * (np.nan_to_num(v[1:]) + np.nan_to_num(v[:-1])) / 2.0
    step[holes(t)] = 0.0  # over a hole nothing is added
    return _Value(np.concatenate([[0.0], np.cumsum(step)]), _product(parts[0].unit, (("s", Fraction(1)),)), t)


def _delay(parts: list[_Value]) -> _Value:
    t, v = _sampled(parts, "delay")
    later, unit = parts[1], parts[1].unit
    factor = factor_of(_said(unit), "s") if unit else (1.0, 0.0)
    if later.t is not None or not isinstance(factor, tuple):
        raise _Refused("the second part of delay must be a number of seconds")
    shifted = replace(parts[0], values=v, t=t + float(later.values) * factor[0])
    return replace(shifted, values=_on(shifted, t), t=t)


def _mean(parts: list[_Value]) -> _Value:
    _, v = _sampled(parts, "mean")
    finite = v[np.isfinite(v)]
    return _Value(float(finite.mean()) if finite.size else np.nan, parts[0].unit)


def _where(parts: list[_Value]) -> _Value:
    both, unit = _alike(parts[1:])

    def chosen(so: Any, a: Any, b: Any) -> Any:
        return np.where(np.isnan(so), np.nan, np.where(so != 0.0, a, b))

    return _made(chosen, [parts[0], *both], unit, True)


class Function(NamedTuple):
    """A function of the grammar: how many parts it takes (most: None is any number), what it is, what it does."""

    least: int
    most: int | None
    meaning: str
    of: Callable[[list[_Value]], _Value]


FUNCTIONS: dict[str, Function] = {
    "abs": Function(1, 1, "size without sign", partial(_sum, np.abs)),
    "sign": Function(1, 1, "-1, 0 or 1", partial(_plain, np.sign)),
    "round": Function(1, 1, "nearest whole number", partial(_sum, np.round)),
    "sqrt": Function(1, 1, "square root", _root),
    "exp": Function(1, 1, "e to the power of the number", partial(_plain, np.exp)),
    "log": Function(1, 1, "natural logarithm of the number", partial(_plain, np.log)),
    "log10": Function(1, 1, "decimal logarithm of the number", partial(_plain, np.log10)),
    "sin": Function(
        1, 1, "of an angle; a number without unit is in rad, and of `2 * pi * 50 * t`", partial(_of_angle, np.sin)
    ),
    "cos": Function(1, 1, "the same", partial(_of_angle, np.cos)),
    "tan": Function(1, 1, "the same", partial(_of_angle, np.tan)),
    "asin": Function(1, 1, "angle in rad", partial(_angle, np.arcsin)),
    "acos": Function(1, 1, "angle in rad", partial(_angle, np.arccos)),
    "atan": Function(1, 1, "angle in rad", partial(_angle, np.arctan)),
    "atan2": Function(2, 2, "angle of y, x in rad", partial(_angle, np.arctan2)),
    "hypot": Function(2, 2, "square root of the sum of both squares", partial(_sum, np.hypot)),
    "min": Function(2, None, "the least, sample by sample", partial(_sum, lambda *x: functools.reduce(np.minimum, x))),
    "max": Function(
        2, None, "the greatest, sample by sample", partial(_sum, lambda *x: functools.reduce(np.maximum, x))
    ),
    "mean": Function(1, 1, "one number: the mean over the log", _mean),
    "rate": Function(1, 1, "change per s, by central differences", _rate),
    "integral": Function(1, 1, "sum over time, by trapezoids, 0 at the first sample", _integral),
    "delay": Function(2, 2, "x as it was so many s before", _delay),
    "where": Function(3, 3, "the second where the first holds, else the third", _where),
}

BINARY: dict[str, tuple[int, Callable[[list[_Value]], _Value]]] = {
    "or": (1, partial(_truth, lambda a, b: (a != 0.0) | (b != 0.0))),
    "and": (2, partial(_truth, lambda a, b: (a != 0.0) & (b != 0.0))),
    "<": (4, partial(_truth, operator.lt)), "<=": (4, partial(_truth, operator.le)),
    ">": (4, partial(_truth, operator.gt)), ">=": (4, partial(_truth, operator.ge)),
    "==": (4, partial(_truth, operator.eq)), "!=": (4, partial(_truth, operator.ne)),
    "+": (5, partial(_sum, operator.add)), "-": (5, _difference),
    "*": (6, _times), "/": (6, _over), "%": (6, partial(_sum, np.mod)),
    "**": (8, _power), "^": (8, _power),
}  # fmt: skip
SIGNED = 7  # a sign binds tighter than a product, less than a power
NOT = 3


# ---- the grammar -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Node:
    """A part of a formula: what it computes from the channels, and where it stands."""

    at: int
    of: Callable[[Mapping[str, _Value]], _Value]


class _Token(NamedTuple):
    kind: str  # number, name, quoted, sign, end
    text: str
    at: int


class _Parser:
    """Precedence climbing over the tokens of a formula."""

    def __init__(self, text: str, start: int, end: int):
        self.text, self.tokens, self.k, self.depth = text, [], 0, 0
        self.names: dict[str, int] = {}  # of channels, where each stands first
        at = start
        while text[at:end].strip():
            m = _TOKEN.match(text, at, end)
            if m is None or m.lastgroup is None:
                at += len(text[at:end]) - len(text[at:end].lstrip())
                raise FormulaError(text, at, f"{text[at]!r} is not understood; allowed: names of channels, numbers, "
                                             f"{OPERATORS}")  # fmt: skip
            self.tokens.append(_Token(m.lastgroup, m[m.lastgroup], m.start(m.lastgroup)))
            at = m.end()
        self.tokens.append(_Token("end", "", end))

    def whole(self) -> _Node:
        node = self.parsed(0)
        if (left := self.tokens[self.k]).kind != "end":
            raise self.wrong(left, f"{left.text!r} is not expected here")
        return node

    def wrong(self, token: _Token, what: str) -> FormulaError:
        return FormulaError(self.text, token.at, what)

    def take(self) -> _Token:
        token = self.tokens[self.k]
        self.k += token.kind != "end"
        return token

    def needs(self, sign: str, why: str) -> None:
        token = self.take()
        if token.text != sign or token.kind != "sign":
            found = f"{token.text!r}" if token.text else "the end"
            raise self.wrong(token, f"{found} where {sign!r} {why}")

    def parsed(self, least: int) -> _Node:
        self.depth += 1
        if self.depth > DEEPEST:
            raise self.wrong(self.tokens[self.k], f"more than {DEEPEST} parts within each other")
        left = self.first()
        while (rank := BINARY.get((sign := self.tokens[self.k]).text)) and sign.kind != "quoted" and rank[0] >= least:
            self.take()
            right = self.parsed(rank[0] + (sign.text not in ("**", "^")))  # a power is taken from the right
            left = self.node(sign, rank[1], [left, right])
            if rank[0] == 4 and (again := self.tokens[self.k]).text in BINARY and BINARY[again.text][0] == 4:
                raise self.wrong(again, f"a second comparison: write a {sign.text} b and b {again.text} c")
        self.depth -= 1
        return left

    def first(self) -> _Node:
        token = self.take()
        if token.kind == "number":
            number = _Value(np.float64(token.text))
            return _Node(token.at, lambda channels: number)
        if token.text in ("+", "-") and token.kind == "sign":
            part = self.parsed(SIGNED)
            return self.node(token, partial(_sum, operator.neg if token.text == "-" else operator.pos), [part])
        if token.kind == "name" and token.text == "not":
            return self.node(token, partial(_truth, lambda x: x == 0.0), [self.parsed(NOT)])
        if token.text == "(" and token.kind == "sign":
            node = self.parsed(0)
            self.needs(")", f"closes the bracket of position {token.at + 1}")
            return node
        if token.kind == "quoted" or (token.kind == "name" and token.text not in BINARY):
            after = self.tokens[self.k]
            if token.kind == "name" and after.text == "(" and after.kind == "sign":
                return self.called(token)
            if token.kind == "name" and token.text == "pi":
                return _Node(token.at, lambda channels: _Value(np.float64(np.pi)))
            self.names.setdefault(token.text, token.at)
            return _Node(token.at, lambda channels: channels[token.text])
        found = f"{token.text!r}" if token.text else "the end"
        raise self.wrong(token, f"{found} where a channel, a number or a bracket is needed")

    def called(self, name: _Token) -> _Node:
        function = FUNCTIONS.get(name.text)
        if function is None:
            raise self.wrong(name, f"no function {name.text!r}{meant(name.text, FUNCTIONS)}; allowed: "
                                   f"{', '.join(FUNCTIONS)}")  # fmt: skip
        self.take()
        parts: list[_Node] = []
        while self.tokens[self.k].text != ")" or not parts:
            parts.append(self.parsed(0))
            if self.tokens[self.k].text != ",":
                break
            self.take()
        self.needs(")", f"closes {name.text}( of position {name.at + 1}")
        if len(parts) < function.least or (function.most is not None and len(parts) > function.most):
            allowed = f"{function.least}" if function.most == function.least else f"{function.least} or more"
            raise self.wrong(name, f"{name.text} is given {len(parts)}; it takes {allowed}")
        return self.node(name, function.of, parts)

    def node(self, token: _Token, of: Callable[[list[_Value]], _Value], parts: list[_Node]) -> _Node:
        text = self.text

        def compute(channels: Mapping[str, _Value]) -> _Value:
            values = [p.of(channels) for p in parts]
            try:
                return of(values)
            except _Refused as e:
                raise FormulaError(text, token.at, str(e)) from None

        return _Node(token.at, compute)


def aligned(channels: Sequence[Sampled]) -> tuple[Array, list[Array]]:
    """The finest raster of all channels, from where the last begins to where the first ends, and each on it.

    NaN in a hole.
    """
    t, values = _together(*(_sampled_of(c) for c in channels))
    assert t is not None
    return t, values


def _sampled_of(channel: Sampled) -> _Value:
    values = np.asarray(channel.values, dtype=float)
    whole = bool((values == np.rint(values)).all())
    return _Value(values, _powers(channel.unit), np.asarray(channel.t, dtype=float), whole)


# ---- the formula -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Formula:
    """A formula that can be read: ``name`` ("": not said), ``expression``, stated ``unit`` ("": as computed).

    ``text`` is what was written, ``names`` are the channels that it needs.
    """

    text: str
    name: str
    expression: str
    unit: str
    names: tuple[str, ...]
    _node: _Node = field(repr=False, compare=False)
    _places: Mapping[str, int] = field(repr=False, compare=False)

    def made(self, channels: Mapping[str, Sampled], unit: str = "") -> Made:
        """Compute it from all samples of a log's channels.

        unit  unit that the result must have; default: the one stated, or as computed

        Raises FormulaError: a channel that is not there, units that do not go together, no sample left.
        """
        given: dict[str, _Value] = {}
        for name in self.names:
            if name == "t" and name not in channels:
                continue
            if name not in channels:
                there = ", ".join(channels)
                raise self._wrong(name, f"no channel {name!r}{meant(name, channels)}; the log has {there}")
            if not len(channels[name].t):
                raise self._wrong(name, f"{name} has no sample")
            given[name] = _sampled_of(channels[name])
        whole = all(x.unit for x in given.values())  # a result without a unit is then a ratio
        if "t" in self.names and "t" not in given:
            others = list(given.values()) or [_Value(c.values, NONE, c.t) for c in channels.values()]
            given["t"] = _Value(t := _together(*others)[0], _powers("s"), t)
        with np.errstate(all="ignore"):  # what is not finite is left out below
            value = self._node.of(given)
            values = np.asarray(value.values, dtype=float)
            if value.t is None:
                raise FormulaError(self.text, self._node.at, "names no channel: a number alone has no time")
            now, values = value.unit, np.broadcast_to(values, value.t.shape)
            for wanted in (w for w in (self.unit, unit) if w and _powers(w) != now):
                factor = factor_of(_said(now) if now else "", wanted) if now or whole else None
                if isinstance(factor, tuple):
                    values = factor[0] * values + factor[1]
                elif now:
                    what = f"is in {_said(now)}, which does not convert to {wanted}"
                    raise FormulaError(self.text, self._node.at, what)
                now = _powers(wanted)
        finite = np.isfinite(values)
        if not finite.any():
            raise FormulaError(self.text, self._node.at, "gives no finite number at any time that its channels share")
        return Made(value.t[finite], values[finite], unit or self.unit or _said(now))

    def _wrong(self, name: str, what: str) -> FormulaError:
        return FormulaError(self.text, self._places[name], what)


def formula_of(text: str) -> Formula:
    """Read ``NAME = FORMULA [UNIT]``; name and unit may be left out. docs/logs.md has the grammar.

    Raises FormulaError, one line with the position of what is wrong.

    Examples
    --------
    >>> f = formula_of("lag = x_dem - x_lvdt [um]")
    >>> f.name, f.expression, f.unit, f.names
    ('lag', 'x_dem - x_lvdt', 'um', ('x_dem', 'x_lvdt'))
    """
    if len(text) > MOST:
        raise FormulaError(text[:60] + "...", MOST, f"{len(text)} characters; allowed: up to {MOST}")
    head, tail = _HEAD.match(text), _UNIT.search(text)
    start, end = head.end() if head else 0, tail.start() if tail else len(text)
    name, unit = (head["name"] or "") if head else "", tail["unit"].strip() if tail else ""
    if head and not name:
        raise FormulaError(text, 0, "no name before '='")
    if name in (*FUNCTIONS, "t", "pi", "and", "or", "not"):
        raise FormulaError(text, text.index(name), f"the name {name!r} has a meaning of its own; choose another")
    if tail and unit not in NO_UNIT and not _UNIT_TEXT.fullmatch(unit):
        raise FormulaError(text, end, f"[{unit}] is no unit")
    if not text[start:end].strip():
        raise FormulaError(text, start, "no formula")
    parser = _Parser(text, start, end)
    node = parser.whole()
    return Formula(text, name, text[start:end].strip(), unit, tuple(parser.names), node, parser.names)


def named(text: str) -> Formula:
    """Read a formula that says its name, as one beside others must.

    Raises FormulaError, one line.
    """
    formula = formula_of(text)
    if not formula.name:
        raise FormulaError(text, 0, "has no name; allowed: NAME = FORMULA [UNIT], such as lag = x_dem - x_lvdt [um]")
    return formula
