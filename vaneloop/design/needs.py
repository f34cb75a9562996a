"""Packages of the extra ``design``, which only the design of servo and trend filter wants."""

from __future__ import annotations

import importlib
from typing import Any

from vaneloop.base.errors import InputError

__all__ = ["needed"]


def needed(module: str) -> Any:
    """A module of python-control or filterpy; InputError, one line, where its package is not installed."""
    package = module.partition(".")[0]
    try:
        importlib.import_module(package)
    except ModuleNotFoundError as e:
        if e.name != package:
            raise
        raise InputError(f"the design needs the package {package}: pip install 'vaneloop[design]'") from None
    return importlib.import_module(module)
