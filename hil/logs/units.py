"""Samples to the unit of their signal: units as files and users write them, through pint."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hil.logs.errors import LogError
from hil.logs.notes import Note
from vaneloop.base.signals import UNITS

__all__ = ["NO_UNIT", "USUAL_UNITS", "UnitError", "Units", "factor_of", "registry", "scale_of"]

_SPEED = ("n_dem", "n_r")
_ALIASES = {
    "%": "percent", "pct": "percent", "per cent": "percent", "1": "", "ratio": "",
    "°": "degree", "deg": "degree", "°c": "degC", "c": "degC", "celsius": "degC", "deg c": "degC",
    "°f": "degF", "degf": "degF", "f": "degF", "k": "kelvin", "rpm": "rpm", "1/min": "rpm", "u/min": "rpm",
    "r/min": "rpm",
    "rev/min": "rpm", "min^-1": "rpm", "rps": "turn/second", "rev/s": "turn/second", "1/s": "turn/second",
    "hz": "turn/second",
    "khz": "kiloturn/second", "sec": "second", "s": "second",
    "ms": "millisecond", "us": "microsecond", "µs": "microsecond", "ns": "nanosecond", "min": "minute",
}  # fmt: skip
# A unit text comes from a file: 9**9**9 would keep pint busy for hours.
_UNIT = re.compile(r"[A-Za-z%°µμΩ_/*^.0-9 ()-]*")
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_SCALED = re.compile(
    rf"(?P<sign>-?) *(?P<gain>{_NUMBER})? *\*? *(?P<unit>[A-Za-z%°µμΩ][^+]*?) *(?P<zero>[+-] *{_NUMBER})?"
)  # gain * unit + zero
_POWER_TOWER = re.compile(r"(\*\*|\^)\s*-?\d{2}|(\*\*|\^).*(\*\*|\^)|\d{4}")


@functools.lru_cache(maxsize=1)
def registry() -> Any:
    """Return pint's units, read once."""
    import pint

    return pint.UnitRegistry(autoconvert_offset_to_baseunit=True)


@functools.lru_cache(maxsize=256)
def factor_of(unit: str, into: str) -> tuple[float, float] | None | str:
    """(a, b) with value_in_into = a * value_in_unit + b; None where ``unit`` is no unit, its name where it cannot be
    converted.

    Frequencies are turns: 1 Hz of a rotor is 60 rpm (pint alone would take it for 1 rad/s).
    """
    text = unit.strip()
    text = _ALIASES.get(text.casefold(), text)
    if len(text) > 32 or not _UNIT.fullmatch(text) or _POWER_TOWER.search(text):
        return None
    units = registry()
    into = _ALIASES.get(into.casefold(), into)
    try:
        parsed = units.parse_units(text)
    except Exception as e:  # the tokenizer of pint's grammar has error types of its own
        if type(e).__module__.partition(".")[0] in ("pint", "tokenize", "builtins"):
            return None
        raise
    try:
        a, b = (float(units.Quantity(v, parsed).to(into).magnitude) for v in (0.0, 1.0))
    except (ValueError, TypeError, ArithmeticError):  # pint's own are of these
        return text
    if not (math.isfinite(a) and math.isfinite(b)) or a == b:
        return None
    return b - a, a


@functools.lru_cache(maxsize=256)
def scale_of(text: str) -> tuple[float, str, float]:
    """What a user says of a number in the log: gain, unit and zero of ``0.1*mA``, ``17.14*mm-12``, ``-deg+80``.

    The number times the gain, and the zero, are in the unit. A unit alone has the gain 1, with a minus -1.
    """
    text = text.strip()
    if (
        text.removeprefix("-").strip().casefold() in NO_UNIT
        or factor_of(text.removeprefix("-"), "s") is not None
        or (m := _SCALED.fullmatch(text)) is None
    ):
        return (-1.0, text[1:].strip(), 0.0) if text.startswith("-") and len(text) > 1 else (1.0, text, 0.0)
    gain = float(m["gain"] or 1.0) * (-1.0 if m["sign"] else 1.0)
    return gain, m["unit"].strip(), float((m["zero"] or "0").replace(" ", ""))


USUAL_UNITS = (
    "%", "ratio", "rpm", "Hz", "rad/s", "mm", "cm", "m", "um", "inch", "mA", "A", "uA", "MPa", "bar", "psi", "kPa",
    "Pa", "degC", "degF", "K", "deg", "rad", "s", "ms", "us",
)  # fmt: skip
NO_UNIT = ("", "-", "none", "n/a", "null")  # and "1" where a file says it: MDF writers put it for "nothing"


class UnitError(LogError):
    """A unit that is not the signal's: ``key`` of the log has it, for the ``signal``."""

    def __init__(self, text: str, signal: str, key: str):
        super().__init__(text)
        self.signal, self.key = signal, key


@dataclass(frozen=True)
class Units:
    """How to bring a signal's samples to its own unit; ``stated`` are the units that the user named, signal -> unit."""

    path: Path
    stated: Mapping[str, str]
    design_rpm: float | None
    notes: list[str]
    signals: Mapping[str, str] = field(default_factory=lambda: UNITS)
    unknown: dict[str, str] = field(default_factory=dict)  # signal -> unit of the log that nobody knows

    def convert(self, signal: str, key: str, values: np.ndarray, unit: str) -> np.ndarray:
        own = self.signals.get(signal, "s")
        stated = signal in self.stated
        unit, gain, zero = unit.strip(), 1.0, 0.0
        if stated:
            gain, unit, zero = scale_of(self.stated[signal])
        if gain != 1.0 or zero != 0.0:
            values = gain * values + zero
        if signal == "state" or unit == own or unit.casefold() in NO_UNIT or (unit == "1" and not stated):
            return values
        factor = factor_of(unit, own)
        if isinstance(factor, tuple):
            return values if factor == (1.0, 0.0) else values * factor[0] + factor[1]
        if factor is None and not stated:
            self.unknown[signal] = unit
            self.notes.append(
                Note(f"{signal} ({key}): unit {unit!r} is not known, {own} assumed", "guessed", signal, 1)
            )
            return values
        allowed = f"{own} or what converts to it"
        if signal in _SPEED:
            allowed = "%, or rpm, Hz, rad/s with the design speed"
            speed = factor_of(unit, "rpm")
            if isinstance(speed, tuple):
                if self.design_rpm is None:
                    way = f"--design-rpm R gives the design speed, --unit {signal}=% says that it is % already"
                    raise LogError(
                        f"{self.path}: {signal} ({key}) is in {unit} and needs the design speed to become %; {way}"
                    )
                return values * (speed[0] * 100.0 / self.design_rpm)
        what = "unit is not known" if factor is None else "unit does not convert"
        allowed += f" (--unit {signal}=..., with gain and zero --unit '{signal}=2.5*{own}-10')"
        raise UnitError(f"{self.path}: {signal} ({key}) in {unit!r}: {what}; allowed: {allowed}", signal, key)
