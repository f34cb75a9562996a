"""VaneLoop: compare an engine-controller and its variable guide vanes with measurements, and find what the model lacks.

The names below are the public interface, for notebooks and tests of your own; each is imported when it is first used::

    import vaneloop
    log = vaneloop.read_log("run.mf4")
    result = vaneloop.replay(log)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.bus.port import open_bus
    from hil.inject.scenario import Scenario
    from hil.logs import Channel, Log, read_log, write_log
    from hil.replay import replay
    from vaneloop.base.errors import InputError
    from vaneloop.discrepancy.models.system import Record, System, load_system, unknown
    from vaneloop.discrepancy.stage import Parameter

_HOME = {
    "Channel": "hil.logs",
    "InputError": "vaneloop.base.errors",
    "Log": "hil.logs",
    "Parameter": "vaneloop.discrepancy.stage",
    "Record": "vaneloop.discrepancy.models.system",
    "Scenario": "hil.inject.scenario",
    "System": "vaneloop.discrepancy.models.system",
    "load_system": "vaneloop.discrepancy.models.system",
    "open_bus": "hil.bus.port",
    "read_log": "hil.logs",
    "replay": "hil.replay",
    "unknown": "vaneloop.discrepancy.models.system",
    "write_log": "hil.logs",
}

__all__ = [
    "Channel",
    "InputError",
    "Log",
    "Parameter",
    "Record",
    "Scenario",
    "System",
    "load_system",
    "open_bus",
    "read_log",
    "replay",
    "unknown",
    "write_log",
]


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: ``vaneloop --help`` must not wait for numpy and numba."""
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names that a notebook offers on Tab."""
    return sorted({*globals(), *__all__})
