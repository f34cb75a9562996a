"""The process in which an MDF file is opened (`hil.logs.mdf`): with limits on time and memory, as damaged files end
asammdf.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import pkgutil
import resource
import sys
from collections import Counter
from pathlib import Path
from typing import Any, BinaryIO

import asammdf  # before the limit: its own libraries count for little, but take address space
import numpy as np
from asammdf.blocks.v4_constants import CHANNEL_TYPE_VIRTUAL, CHANNEL_TYPE_VIRTUAL_MASTER, SOURCE_BUS

from hil.logs.frames import EXTENDED
from hil.logs.names import meaning
from vaneloop.base.signals import UNITS

__all__ = ["answer", "serve"]

MEMORY = 1 << 30, 40  # bytes that may be taken beyond the start, and bytes more for each byte of the file
RECORDING = "hil.logs.recordings:read_opened_mdf"  # loads the compiled code of the bus, which channels do without
OTHERS = "hil.logs.others:by_python_can"
_BUS = "CAN_DataFrame"
_FRAMES = (
    "CAN_DataFrame",
    "CAN_ErrorFrame",
    "CAN_RemoteFrame",
    "CAN_OverloadFrame",
    "LIN_",
    "FLX_",
)  # kept by the standard for bus events


def serve() -> None:
    """Answer one request on stdin."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not get between the arrays
    with out:
        answer(sys.stdin.buffer.readline(), out)


def answer(request: bytes, out: BinaryIO) -> None:
    """Read the file of ``request`` and write the answer."""
    asked = json.loads(request)
    path = asked["path"]
    with contextlib.suppress(OSError, ValueError):
        used = resource.getrusage(resource.RUSAGE_SELF)
        ends = math.ceil(used.ru_utime + used.ru_stime) + int(asked["seconds"])
        resource.setrlimit(resource.RLIMIT_CPU, (ends, ends))
        now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        limit = now + MEMORY[0] + MEMORY[1] * os.path.getsize(path)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    arrays: dict[str, np.ndarray] = {}
    try:
        reply: dict[str, Any] = {}
        if asked.get("record"):
            arrays.update(zip(("us", "rows", "sent"), pkgutil.resolve_name(RECORDING)(path), strict=True))
        elif asked.get("frames"):
            arrays.update(pkgutil.resolve_name(OTHERS)(path))
        elif "channels" in asked:
            with asammdf.MDF(path) as mdf:
                places = {key: (g, i) for key, g, i, *_ in _found(mdf)}
                for n, key in enumerate(asked["channels"]):
                    s = mdf.get(group=places[key][0], index=places[key][1])
                    arrays[f"t{n}"], arrays[f"v{n}"] = s.timestamps.astype(np.float64), s.samples.astype(np.float64)
        else:
            with asammdf.MDF(path, process_bus_logging=False) as mdf:  # type: ignore[call-arg]
                reply = _read(mdf, asked["wanted"], asked["guess"], arrays)
    except MemoryError:
        reply = {
            "error": f"unpacks to more memory than its size allows, {MEMORY[0]:,} bytes and {MEMORY[1]} for each of "
            f"its own"
        }
        arrays = {}
    except Exception as e:  # the library meets a damaged file with any exception there is
        reply = {"error": f"{type(e).__name__}: {' '.join(str(e).split())}"[:160]}
        arrays = {}
    reply["arrays"] = [(name, a.dtype.str, a.shape) for name, a in arrays.items()]
    out.write(json.dumps(reply).encode() + b"\n")
    for a in arrays.values():
        out.write(np.ascontiguousarray(a).tobytes())


def _read(mdf: Any, wanted: list[str], guess: bool, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Names, wanted series and bus frames of an open file; numbers go to ``arrays``."""
    buses = 0
    for g, group in enumerate(mdf.groups):
        names = [str(c.name) for c in group.channels]
        if f"{_BUS}.ID" in names and group.channel_group.cycles_nr:
            for k, a in enumerate(_bus_columns(mdf, g, names)):
                arrays[f"b{buses}.{k}"] = a
            buses += 1
    found = _found(mdf)
    reply: dict[str, Any] = {"names": {}, "series": {}, "comments": {}, "why": {}, "invalid": {}, "buses": buses}
    fold = {w.casefold() for w in wanted}
    for n, (key, g, i, name, label, master) in enumerate(found):
        short = name.split("\\")[0]
        names = list(dict.fromkeys((key, name, short, f"{label}.{name}", f"{label}.{short}", f"{g}.{name}")))
        reply["names"][key] = names
        comment = str(mdf.groups[g].channels[i].comment or "")[:200] if guess else ""
        if not fold & {a.casefold() for a in names} and not (
            guess and any(meaning(x, tuple(UNITS)) for x in (short, comment))
        ):
            continue
        if comment:
            reply["comments"][key] = comment
        if master is None or getattr(mdf.groups[g].channels[master], "sync_type", 1) not in (0, 1):
            reply["why"][key] = "its channel group has no time"
            continue
        s = mdf.get(group=g, index=i, raw=True).physical(ignore_value2text_conversions=True)
        if s.samples.ndim != 1 or s.samples.dtype.kind not in "biuf":
            reply["why"][key] = f"holds {s.samples.dtype}, not numbers"
            continue
        source = mdf.groups[g].channels[i].source or getattr(mdf.groups[g].channel_group, "acq_source", None)
        framed = getattr(source, "source_type", None) == SOURCE_BUS
        reply["series"][key] = (n, str(s.unit or "")[:40], framed)
        reply["invalid"][key] = max(int(mdf.groups[g].channel_group.cycles_nr) - len(s.samples), 0)
        arrays[f"t{n}"], arrays[f"v{n}"] = s.timestamps.astype(np.float64), s.samples.astype(np.float64)
    return reply


def _found(mdf: Any) -> list[tuple[str, int, int, str, str, int | None]]:
    """Channels that hold no frames: the key that names one alone, group, place in it, name, label of the group, place
    of the group's time.
    """
    found = []
    for g, group in enumerate(mdf.groups):
        names = [str(c.name) for c in group.channels]
        if f"{_BUS}.ID" in names:
            continue
        master = mdf.masters_db.get(g)
        label = str(getattr(group.channel_group, "acq_name", "") or "") or f"group{g}"  # MDF 3 has none
        for i, name in enumerate(names):
            if i != master and not name.startswith(_FRAMES):
                found.append((g, i, name, label, master))
    plain = Counter(f[2] for f in found)
    full = Counter(f"{f[3]}.{f[2]}" for f in found)

    def key(g: int, name: str, label: str) -> str:
        return name if plain[name] == 1 else f"{label}.{name}" if full[f"{label}.{name}"] == 1 else f"{g}.{name}"

    return [(key(g, name, label), g, i, name, label, master) for g, i, name, label, master in found]


def _bus_columns(mdf: Any, g: int, names: list[str]) -> list[np.ndarray]:
    """t, identifier, bus, length and bytes of the data frames of one channel group."""

    def column(name: str) -> Any:
        s = mdf.get(f"{_BUS}.{name}", group=g, raw=True, ignore_invalidation_bits=True)
        kind = mdf.groups[g].channels[names.index(f"{_BUS}.{name}")].channel_type
        # it has no bytes in the record: its raw value is the record's number, and its conversion says the value
        virtual = kind in (CHANNEL_TYPE_VIRTUAL, CHANNEL_TYPE_VIRTUAL_MASTER)
        return s.physical(ignore_value2text_conversions=True) if virtual else s

    ident_signal, data = column("ID"), column("DataBytes").samples
    ident = ident_signal.samples.astype(np.uint32)
    n = ident.size
    extended = ident > 0x7FF
    if f"{_BUS}.IDE" in names:
        extended = column("IDE").samples.astype(np.uint8) != 0
    data = data.reshape(n, -1).view(np.uint8)[:, :64]
    wide = 8 if data.shape[1] <= 8 else 64
    data = np.pad(data, ((0, 0), (0, wide - data.shape[1])))
    if f"{_BUS}.DataLength" in names:
        length = column("DataLength").samples
    else:
        dlc = column("DLC").samples.astype(np.int64)
        length = np.array([*range(9), 12, 16, 20, 24, 32, 48, 64])[np.clip(dlc, 0, 15)]
    bus = column("BusChannel").samples if f"{_BUS}.BusChannel" in names else np.zeros(n)
    return [
        ident_signal.timestamps.astype(np.float64),
        (ident & 0x1FFFFFFF) | np.where(extended, np.uint32(EXTENDED), np.uint32(0)),
        np.asarray(bus).astype(np.int32), np.clip(length, 0, wide).astype(np.uint8), data,
    ]  # fmt: skip
