"""The library of effects: one file each, found by itself.

An effect's parameters follow the nominal plant's in p, its states the nominal ones in s, in the alphabetical order of
the files. A new file shifts the rows behind it; nothing else in the plant has numbers of rows in it. Behind them all
stands what only an electromechanical actuator has, then what only two actuators have, then learned curves.
"""

from __future__ import annotations

import importlib
import pkgutil

from plant.effect import Effect
from plant.layout import (
    CURVE_ROWS,
    MOST_CURVES,
    MOTOR_NAMES,
    MOTOR_STATE,
    N_NOMINAL,
    NOMINAL_STATE,
    SIGNALS,
    UNISON_NAMES,
)
from vaneloop.base.vanes import MOST

__all__ = [
    "CURVES", "DERIVED", "EFFECTS", "MOTOR", "MOTOR_AT", "NEUTRAL", "N_PARAMETERS", "N_STATE", "ROW", "SIGNAL_AT",
    "STATE", "STATE_ROW", "UNISON", "rows_at", "states_of",
]  # fmt: skip


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
MOTOR = DERIVED + 5 + MOST  # rows of an electromechanical actuator: its kind, `MOTOR_NAMES`, two derived ones
UNISON = MOTOR + 1 + len(MOTOR_NAMES) + 2  # rows of two actuators: how many, `UNISON_NAMES`, a derived one
CURVES = UNISON + 1 + len(UNISON_NAMES) + 1  # rows of curves that were learned: their number, and each (`plant.layout`)
N_PARAMETERS = CURVES + 1 + MOST_CURVES * CURVE_ROWS
MOTOR_AT = len(_states)  # first row of `MOTOR_STATE` in s
SIGNAL_AT = MOTOR_AT + len(MOTOR_STATE)  # first row of `SIGNALS` in s
STATE: tuple[str, ...] = (*_states, *MOTOR_STATE, *(f"signal_{name}" for name in SIGNALS))
N_STATE = len(STATE)


def rows_at(*sites: str) -> list[int]:
    """Return the rows of p with the parameters of all effects that act at these sites."""
    return [ROW[e.name] + i for e in EFFECTS.values() if e.site in sites for i in range(len(e.parameters))]


def states_of(kind: str) -> list[int]:
    """Return the rows of s that a machine with an actuator of this ``kind`` has, in their order; not those that only
    curves look at.
    """
    hydraulic = kind == "hydraulic"
    absent = set(MOTOR_STATE) if hydraulic else {"spool", "spool_rate"}
    absent |= {f"{e.name}.{state}" for e in EFFECTS.values() if kind not in e.kinds for state in e.states}
    return [row for row, name in enumerate(STATE[:SIGNAL_AT]) if name not in absent]
