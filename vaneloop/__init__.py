"""VaneLoop: compare an engine-controller and its variable guide vanes with measurements, and find what the model lacks.

The names below are the public interface, for notebooks and tests of your own; each is imported when it is first used.

>>> import vaneloop
>>> log = vaneloop.read_log("examples/hidden_effect.parquet")[0:60]  # or a pandas.DataFrame
>>> print(vaneloop.compare(log))  # Machine(...) or a System of your own as second argument
The model fails most in the actuator subsystem: x_lvdt is off by 0.652 mm RMS, 130 times its noise floor.
>>> better = vaneloop.extend(log, ["valve_dead_band", "aero_load"])  # as vaneloop.diagnose(log) names them
>>> better.verdict, better.params["aero_load.force"].unit, better.residuals.units
('explained', 'N', {'x_lvdt': 'mm'})

`answer.report("page.html")` writes the page, `answer.plot()` draws, `better.write("better.toml")` writes the model.
Every verb (`replay`, `compare`, `locate`, `diagnose`, `extend`, `experiment`, `learn`) returns such an answer.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.bus.port import open_bus
    from hil.inject.scenario import Scenario
    from hil.logs import Channel, Log, read_log, write_log
    from vaneloop.base.errors import InputError
    from vaneloop.identification.subsystem import Parameter
    from vaneloop.identification.user_models.system import Law, Record, System, unknown
    from vaneloop.identification.user_models.user_code import load_system
    from vaneloop.verbs.learn import learn
    from vaneloop.verbs.machine import Machine
    from vaneloop.verbs.replay import replay
    from vaneloop.verbs.search import compare, diagnose, experiment, extend, locate

_HOME = {
    "Channel": "hil.logs",
    "InputError": "vaneloop.base.errors",
    "Law": "vaneloop.identification.user_models.system",
    "Log": "hil.logs",
    "Machine": "vaneloop.verbs.machine",
    "Parameter": "vaneloop.identification.subsystem",
    "Record": "vaneloop.identification.user_models.system",
    "Scenario": "hil.inject.scenario",
    "System": "vaneloop.identification.user_models.system",
    "compare": "vaneloop.verbs.search",
    "diagnose": "vaneloop.verbs.search",
    "experiment": "vaneloop.verbs.search",
    "extend": "vaneloop.verbs.search",
    "learn": "vaneloop.verbs.learn",
    "load_system": "vaneloop.identification.user_models.user_code",
    "locate": "vaneloop.verbs.search",
    "open_bus": "hil.bus.port",
    "read_log": "hil.logs",
    "replay": "vaneloop.verbs.replay",
    "unknown": "vaneloop.identification.user_models.system",
    "write_log": "hil.logs",
}

if TYPE_CHECKING:
    __version__: str  # of the installed package

__all__ = [
    "Channel",
    "InputError",
    "Law",
    "Log",
    "Machine",
    "Parameter",
    "Record",
    "Scenario",
    "System",
    "compare",
    "diagnose",
    "experiment",
    "extend",
    "learn",
    "load_system",
    "locate",
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
    if name == "__version__":
        return importlib.import_module("vaneloop.base.version").installed_version()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names that a notebook offers on Tab."""
    return sorted({*globals(), *__all__, "__version__"})
