"""Channels as a table of Arrow, which CSV and Parquet are written from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa

from hil.logs.channels import Channel, raster
from vaneloop.base.signals import UNITS, heading

__all__ = ["arrow_table"]


def arrow_table(channels: dict[str, Channel]) -> Any:
    """Channels as a table of Arrow, t first, null where a channel has no sample; what is no signal says its unit."""
    t, columns = raster(channels)
    arrays = [t, *columns.values()]
    # from buffers: pa.array imports pandas, which takes a quarter of a second
    known = [pa.py_buffer(np.packbits(~np.isnan(a), bitorder="little")) for a in arrays]
    filled = [
        pa.Array.from_buffers(pa.float64(), a.size, [k, pa.py_buffer(a)]) for k, a in zip(known, arrays, strict=True)
    ]
    heads = [name if name in UNITS else heading(name, c.unit) for name, c in channels.items()]
    return pa.Table.from_arrays(filled, names=["t", *heads])
