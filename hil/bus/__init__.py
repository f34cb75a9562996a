"""Frames and the buses that carry them: SocketCAN, the embedded bus, the wire in simulated time."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.bus.port import Port, open_bus

_HOME = {"Port": "hil.bus.port", "open_bus": "hil.bus.port"}

__all__ = ["Port", "open_bus"]


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: frames and wire need no bus."""
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
