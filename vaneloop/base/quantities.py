"""What kind of quantity a unit is one of, as far as laws ask for it: a unit is what a user wrote."""

from __future__ import annotations

import re

__all__ = ["absolute_zero", "kind_of"]

_LENGTHS = "nm um µm μm mm cm dm m km in ft yd mi meter meters metre metres"
_ANGLES = "rad mrad deg ° degree degrees rev turn"
_VOLUMES = "l L ml mL cl dl litre liter gal"
_MASSES = "mg g kg t lb"
_SHARES = "% - 1"
# absolute temperature at the zero of a unit, in its own degrees
_ZEROS = {"K": 0.0, "degC": 273.15, "°C": 273.15, "deg C": 273.15, "celsius": 273.15, "degF": 459.67, "°F": 459.67}
_KINDS = {
    **dict.fromkeys(_LENGTHS.split(), "length"), **dict.fromkeys(_ANGLES.split(), "angle"),
    **dict.fromkeys(_VOLUMES.split(), "volume"), **dict.fromkeys(_MASSES.split(), "mass"),
    **dict.fromkeys(_SHARES.split(), "share"), **dict.fromkeys(_ZEROS, "temperature"),
    **dict.fromkeys(("rpm", "RPM", "r/min", "1/min"), "angular velocity"),
    **dict.fromkeys(("kmh", "kph", "mph", "kn"), "velocity"),
}  # fmt: skip
_RATES = {"length": "velocity", "angle": "angular velocity"}
_PER_TIME = re.compile(r"(.+?)\s*(?:/\s*(?:s|sec|ms|min|h)|[ *·]\s*s(?:\^-|\*\*-|-)1)")


def kind_of(unit: str) -> str:
    """The kind of quantity: length, angle, volume, mass, share, temperature, velocity or angular velocity; else ""."""
    unit = unit.strip()
    if unit in _KINDS:
        return _KINDS[unit]
    if (power := re.fullmatch(r"(\w+?)(?:\^|\*\*)?3", unit)) and _KINDS.get(power[1]) == "length":
        return "volume"
    per = _PER_TIME.fullmatch(unit)
    return _RATES.get(_KINDS.get(per[1].strip("()"), ""), "") if per else ""


def absolute_zero(unit: str) -> float:
    """Absolute temperature at the zero of a unit of temperature, in its own degrees; 0 of any other unit."""
    return _ZEROS.get(unit.strip(), 0.0)
