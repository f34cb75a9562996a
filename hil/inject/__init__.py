"""Bad days on the bus, on purpose: scenarios of frame and fault injection, their verdicts, the fuzzer.

::

    from hil import inject
    outcome = inject.run("demand_stops")  # a shipped scenario, a TOML file, or a Scenario made in Python
    assert outcome.held, outcome.text()
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.inject.injection import (
        ACTIONS,
        TRANSITIONS,
        Babble,
        BusOff,
        ChannelFault,
        Check,
        Corrupt,
        Delay,
        Drop,
        Duplicate,
        ErrorFrames,
        Expect,
        Flood,
        Freeze,
        Link,
        Machine,
        Outcome,
        Override,
        Reorder,
        Replay,
        Scenario,
        Send,
        Trace,
        judge,
        library,
        load_scenario,
        run,
    )

_HOME = {
    "ACTIONS": "hil.inject.injection",
    "TRANSITIONS": "hil.inject.injection",
    "Babble": "hil.inject.injection",
    "BusOff": "hil.inject.injection",
    "ChannelFault": "hil.inject.injection",
    "Check": "hil.inject.injection",
    "Corrupt": "hil.inject.injection",
    "Delay": "hil.inject.injection",
    "Drop": "hil.inject.injection",
    "Duplicate": "hil.inject.injection",
    "ErrorFrames": "hil.inject.injection",
    "Expect": "hil.inject.injection",
    "Flood": "hil.inject.injection",
    "Freeze": "hil.inject.injection",
    "Link": "hil.inject.injection",
    "Machine": "hil.inject.injection",
    "Outcome": "hil.inject.injection",
    "Override": "hil.inject.injection",
    "Reorder": "hil.inject.injection",
    "Replay": "hil.inject.injection",
    "Scenario": "hil.inject.injection",
    "Send": "hil.inject.injection",
    "Trace": "hil.inject.injection",
    "judge": "hil.inject.injection",
    "library": "hil.inject.injection",
    "load_scenario": "hil.inject.injection",
    "run": "hil.inject.injection",
}

__all__ = [
    "ACTIONS",
    "TRANSITIONS",
    "Babble",
    "BusOff",
    "ChannelFault",
    "Check",
    "Corrupt",
    "Delay",
    "Drop",
    "Duplicate",
    "ErrorFrames",
    "Expect",
    "Flood",
    "Freeze",
    "Link",
    "Machine",
    "Outcome",
    "Override",
    "Reorder",
    "Replay",
    "Scenario",
    "Send",
    "Trace",
    "judge",
    "library",
    "load_scenario",
    "run",
]


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: pytest loads the plugin `sil` from here."""
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
