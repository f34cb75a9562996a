"""Hardware in the loop, in software: lockstep runner, logs, replay, error figures, pages."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.logs import Channel, Log, LogError, read_log, write_log
    from hil.loop.engines import lockstep_engines
    from hil.loop.lanes import lockstep_lanes
    from hil.loop.lockstep import Run, Stimulus
    from hil.replay import ReplayResult

_HOME = {
    "Channel": "hil.logs",
    "Log": "hil.logs",
    "LogError": "hil.logs",
    "read_log": "hil.logs",
    "write_log": "hil.logs",
    "lockstep_engines": "hil.loop.engines",
    "lockstep_lanes": "hil.loop.lanes",
    "Run": "hil.loop.lockstep",
    "Stimulus": "hil.loop.lockstep",
    "ReplayResult": "hil.replay",
}

__all__ = [
    "Channel", "Log", "LogError", "ReplayResult", "Run", "Stimulus", "lockstep_engines", "lockstep_lanes", "read_log",
    "write_log",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: ``vaneloop --help`` must not wait for numpy and numba."""
    if name in _HOME and name in __all__:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
