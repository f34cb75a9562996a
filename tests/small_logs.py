"""Logs of few channels and rows, in memory and as files that are written for a test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hil.logs import Channel, Log, read_log

__all__ = ["log_of", "read", "white", "written"]


def white(seed: int, *shape: int) -> np.ndarray:
    """White noise of size 1."""
    return np.random.default_rng(seed).standard_normal(shape)


def log_of(t: np.ndarray | None = None, **channels: Any) -> Log:
    """A log of channels, each its values on ``t``, a channel, or (times, values)."""
    made = {}
    for name, v in channels.items():
        times, values = v if isinstance(v, tuple) else (t, v)
        made[name] = (
            v if isinstance(v, Channel) else Channel(np.asarray(times, dtype=float), np.asarray(values, dtype=float))
        )
    return Log("a.csv", made)


def written(folder: Path, text: str | bytes, name: str = "a.csv") -> Path:
    """A file of that text."""
    file = folder / name
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return file


def read(file: Path, **options: Any) -> Log:
    """Its log; no signal is required."""
    return read_log(file, **{"require": ()} | options)
