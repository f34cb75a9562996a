"""What an installation may lack: packages that only some commands and formats need, its extras."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from vaneloop.base.errors import InputError

__all__ = ["EXTRAS", "is_there", "needed", "needs"]

# the extra, and its packages that are asked for: module -> name on the package index
EXTRAS = {
    "mdf": {"asammdf": "asammdf"},
    "fleet": {"psutil": "psutil", "duckdb": "duckdb", "distributed": "dask", "dask_jobqueue": "dask-jobqueue",
              "cryptography": "cryptography", "ruptures": "ruptures"},
    "web": {"nicegui": "nicegui", "tsdownsample": "tsdownsample"},
    "fmu": {"fmpy": "fmpy"},
    "diagnostics": {"isotp": "can-isotp"},
    "multibody": {"exudyn": "exudyn"},
    "secoc": {"cryptography": "cryptography"},
    "gpu": {"numba_cuda": "numba-cuda"},
    "notebook": {"pandas": "pandas", "matplotlib": "matplotlib"},
}  # fmt: skip


def is_there(module: str) -> bool:
    """Whether a module's package is installed; nothing is imported."""
    return importlib.util.find_spec(module.partition(".")[0]) is not None


def needs(thing: str, *modules: str, extra: str | None = None) -> None:
    """Raise InputError where ``thing``, which a user has asked for, needs a package that is not installed.

    The line names the thing, what is missing and the extra that brings it: ``extra``, where several do.
    """
    for module in modules:
        if not is_there(module):
            extra = extra or next(e for e, brought in EXTRAS.items() if module in brought)
            package = EXTRAS[extra][module.partition(".")[0]]
            raise InputError(f"{thing} needs {package}, which is not installed: pip install 'vaneloop[{extra}]'")


def needed(thing: str, module: str, extra: str | None = None) -> Any:
    """The module, imported; InputError as `needs` where it is not installed."""
    needs(thing, module, extra=extra)
    return importlib.import_module(module)
