"""VaneLoop's version: that of the installed package, which takes it from pyproject.toml."""

from __future__ import annotations

from importlib import metadata

__all__ = ["installed_version"]


def installed_version(unknown: str = "0") -> str:
    """Version of the installed package, such as "0.1.0"; ``unknown`` where these sources were never installed."""
    try:
        return metadata.version("vaneloop")
    except metadata.PackageNotFoundError:
        return unknown
