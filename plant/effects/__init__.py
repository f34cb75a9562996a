"""The library of effects: one file each, found by itself.

An effect's parameters follow the nominal plant's in p, its states the nominal ones in s, in the alphabetical order of
the files. A new file shifts the rows behind it; nothing else in the plant has numbers of rows in it.
"""

from __future__ import annotations

import importlib
import pkgutil

from plant.effect import Effect
from plant.layout import N_NOMINAL, NOMINAL_STATE
from vaneloop.base.vanes import MOST

__all__ = ["DERIVED", "EFFECTS", "NEUTRAL", "N_PARAMETERS", "N_STATE", "ROW", "STATE", "STATE_ROW", "rows_at"]


def _found() -> dict[str, Effect]:
    out = {}
    for name in sorted(m.name for m in pkgutil.iter_modules(__path__)):
        effect = importlib.import_module(f"{__name__}.{name}").EFFECT
        if effect.name != name:
            raise ValueError(
                f"plant/effects/{name}.py declares the effect {effect.name!r}; both must have the same name"
            )
        out[name] = effect
    return out


EFFECTS: dict[str, Effect] = _found()
ROW: dict[str, int] = {}  # effect -> row of its first parameter in p
STATE_ROW: dict[str, int] = {}  # effect -> row of its first state in s
NEUTRAL: list[float] = []  # SI, of the effects' rows of p
_row, _states = N_NOMINAL, list(NOMINAL_STATE)
for _name, _effect in EFFECTS.items():
    ROW[_name], STATE_ROW[_name] = _row, len(_states)
    _row += len(_effect.parameters)
    NEUTRAL += [q.neutral * q.si for q in _effect.parameters]
    _states += [f"{_name}.{state}" for state in _effect.states]

DERIVED = _row  # rows worked out from the effects' parameters by `plant.parameters.derive`, see there
N_PARAMETERS = DERIVED + 5 + MOST
STATE: tuple[str, ...] = tuple(_states)
N_STATE = len(STATE)


def rows_at(*sites: str) -> list[int]:
    """Return the rows of p with the parameters of all effects that act at these sites."""
    return [ROW[e.name] + i for e in EFFECTS.values() if e.site in sites for i in range(len(e.parameters))]
