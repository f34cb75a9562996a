"""Parts of a log by its own time: ``0:200`` are its first 200 s, ``200:`` is what follows; written and read here."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from vaneloop.base.errors import InputError

__all__ = ["Span", "apart", "is_span", "span_of", "spans_of"]

_LOOKS = re.compile(r"[\d.eE+-]*(:([\d.eE+-]*|nan|inf))+|(nan|inf):.*")


class Span(NamedTuple):
    """From ``low`` to before ``high``, s of the log's own time; an open end is infinite."""

    low: float
    high: float

    def __str__(self) -> str:
        """Return it as it is written."""
        return f"{self.low:.10g}:{self.high:.10g}".replace("-inf", "").replace("inf", "")


def is_span(given: object) -> bool:
    """Whether that is meant as a part of a log, and not as a file's name: a text such as 0:200, or a pair."""
    if isinstance(given, str):
        return _LOOKS.fullmatch(given.strip()) is not None
    return isinstance(given, tuple) and len(given) == 2 and all(v is None or isinstance(v, int | float) for v in given)


def span_of(given: Any, option: str) -> Span:
    """A part of a log from a text ``FROM:TO`` or a pair of numbers; None or nothing is an open end.

    Raises InputError, one line that names ``option``.
    """
    if isinstance(given, Span):
        return given
    said = f"{option} {given!r}"
    ends = given.split(":") if isinstance(given, str) else list(given) if isinstance(given, tuple | list) else []
    if len(ends) != 2:
        raise InputError(f"{said}: must be FROM:TO in s of the log's time, such as 0:200, 200: or :200")
    values = []
    for end, of_open in zip(ends, (-math.inf, math.inf), strict=True):
        if end is None or (isinstance(end, str) and not end.strip()):
            values.append(of_open)
            continue
        try:
            value = float(end)
        except (TypeError, ValueError):
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{said}: {end!r} must be a number of seconds, or left out")
        values.append(value)
    span = Span(*values)
    if not span.low < span.high:
        raise InputError(f"{said}: the end (={span.high:g} s) must be above the beginning (={span.low:g} s)")
    return span


def spans_of(given: Any, option: str) -> list[Span]:
    """Parts of a log from one or several of what `span_of` takes."""
    return [span_of(x, option) for x in ([given] if is_span(given) else given)]


def apart(fit: Sequence[Span], test: Sequence[Span]) -> None:
    """Refuse parts that share a time: what is fitted must not test.

    Raises InputError, one line; also where something is to be tested and nothing is said of what to fit.
    """
    if test and not fit:
        raise InputError(f"--test '{test[0]}': a part of the log needs --fit FROM:TO beside it")
    every = [*(("--fit", s) for s in fit), *(("--test", s) for s in test)]
    for i, (option, a) in enumerate(every):
        for other, b in every[i + 1 :]:
            low, high = max(a.low, b.low), min(a.high, b.high)
            if low < high:
                raise InputError(f"{option} '{a}' and {other} '{b}' share '{Span(low, high)}'; parts must not overlap")
