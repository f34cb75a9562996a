"""Channels as a table of Arrow, which CSV and Parquet are written from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa

from hil.logs.source import Channel

__all__ = ["arrow_table"]


def _raster(channels: dict[str, Channel]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """All times of all channels, and each channel on them, NaN where it has no sample."""
    t = np.unique(np.concatenate([c.t for c in channels.values()]))
    columns = {}
    for name, c in channels.items():
        columns[name] = np.full(t.size, np.nan)
        columns[name][np.searchsorted(t, c.t)] = c.values
    return t, columns


def arrow_table(channels: dict[str, Channel]) -> Any:
    """Channels as a table of Arrow, t first, null where a channel has no sample."""
    t, columns = _raster(channels)
    arrays = [t, *columns.values()]
    # from buffers: pa.array imports pandas, which takes a quarter of a second
    known = [pa.py_buffer(np.packbits(~np.isnan(a), bitorder="little")) for a in arrays]
    filled = [
        pa.Array.from_buffers(pa.float64(), a.size, [k, pa.py_buffer(a)]) for k, a in zip(known, arrays, strict=True)
    ]
    return pa.Table.from_arrays(filled, names=["t", *columns])
