"""MDF4 files through asammdf, read in a process of their own.

asammdf follows the links and sizes of a file as they stand: one flipped bit can end in a segmentation fault, an endless
chain of blocks or an allocation of terabytes (seen in fuzzing, asammdf 8.8). A log from outside must not take its
reader down, so a child process with limits on time and memory opens the file and hands back arrays. It costs 0.3 s a
file.

Request, one line of JSON on the child's stdin: {"path", "wanted": [names], "guess"}. Answer on its stdout: one line of
JSON, then the bytes of the arrays it lists. {"error": text} stands for what the file is to blame for.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from hil.logs.bus_log import encode_channels, open_bus_log
from hil.logs.frames import EXTENDED, Frames, in_order
from hil.logs.names import meaning
from hil.logs.record_formats import NOTE_CHANNEL, FramesOfRecord, frames_of
from hil.logs.source import Channel, LogError, Options, Series, Source, check_file, find, names_held, read_bytes
from vaneloop.base.child import python
from vaneloop.base.extras import needs
from vaneloop.base.files import whole
from vaneloop.base.signals import UNITS

__all__ = ["Groups", "open_mdf", "read_mdf", "read_record_mdf", "write_bus", "write_groups", "write_mdf"]

_MEMORY = 1 << 30, 40  # bytes the child may take beyond its start, and bytes more for each byte of the file
_TIME = 20, 1e6  # s of a processor, and bytes of file per further second
_BUSY = 20  # times as long by the wall clock: others may have the processors, too
_BUS = "CAN_DataFrame"
_FRAMES = (
    "CAN_DataFrame",
    "CAN_ErrorFrame",
    "CAN_RemoteFrame",
    "CAN_OverloadFrame",
    "LIN_",
    "FLX_",
)  # kept by the standard for bus events


class Groups:
    """Channel groups of an MDF4 file: `CHANNEL`, or `GROUP.CHANNEL` where several groups have it."""

    kind = "channel"
    sorted = False

    def __init__(self, content: dict[str, Any]):
        self.notes: list[str] = []
        self.names = {key: tuple(names) for key, names in content["names"].items()}
        self.comments: dict[str, str] = content["comments"]
        self._series, self._why = content["series"], content["why"]

    def has(self) -> str:
        return names_held(self.kind, self.names)

    def absent(self, name: str) -> str:
        return ""

    def series(self, key: str) -> Series:
        if key not in self._series:
            self.notes.append(f"{key}: {self._why.get(key, 'has no samples')}")
            return Series(np.empty(0), np.empty(0))
        t, values, unit, framed = self._series[key]
        return Series(t, values, unit, framed=framed)


def open_mdf(path: Path, options: Options) -> Source:
    """MDF4: bus logging where the file holds CAN frames and a DBC is given or no channel has a name that is
    asked for.
    """
    wanted = [*UNITS, *options.mapping]
    content, frames = read_mdf(path, wanted, options.guess)
    groups = Groups(content)
    if frames is not None and (
        options.dbc is not None or not any(find(groups, n, n in options.mapping) for n in wanted)
    ):
        return open_bus_log(frames, options)
    return groups


def read_mdf(path: Path, wanted: list[str], guess: bool = False) -> tuple[dict[str, Any], Frames | None]:
    """Channels and CAN frames of a file.

    Returns a dict with "names" (key -> names it may be asked by), "series" (key -> t, values, unit, whether they came
    in frames of a bus) of the keys that answer to ``wanted`` (with ``guess``, of those too whose name or comment means
    one of our signals), "comments" of these, "why" (key -> reason it has no numbers), and the frames of its bus
    logging, if any.
    """
    reply, arrays = _answered(path, {"wanted": wanted, "guess": guess})
    series = {
        key: (arrays[f"t{i}"], arrays[f"v{i}"], unit, framed) for key, (i, unit, framed) in reply["series"].items()
    }
    parts = []
    for i in range(reply["buses"]):
        t, ident, bus, length, data = (arrays[f"b{i}.{k}"] for k in range(5))
        parts.append((*in_order(str(path), t, notes := []), ident, bus, length, data, notes))  # type: ignore[var-annotated]
    return {**{k: reply[k] for k in ("names", "comments", "why")}, "series": series}, _merge(parts)


def read_record_mdf(path: Path) -> FramesOfRecord:
    """Frames of an MDF4 file as python-can reads them, with their directions."""
    _, arrays = _answered(path, {"record": True})
    return arrays["us"], arrays["rows"], arrays["sent"]


def _answered(path: Path, request: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What the child answers to a request on a file, and its arrays. Every reader of the format asks here."""
    head = read_bytes(path, 168)
    if head[:8] not in (b"MDF     ", b"UnFinMF ") or len(head) < 168 or head[64:68] != b"##HD":
        old = head[:8] == b"MDF     " and head[8:9] in (b"2", b"3")
        raise LogError(
            f"{path}: is not a whole MDF4 file" + (" but MDF " + head[8:12].decode("ascii", "replace") if old else "")
        )
    needs(f"{path}: MDF4", "asammdf")
    seconds = _TIME[0] + int(check_file(path) / _TIME[1])
    request = {"path": str(path.absolute()), "seconds": seconds, **request}
    answer = _child(json.dumps(request).encode() + b"\n", _BUSY * seconds)
    line, _, body = answer.partition(b"\n")
    try:
        reply = json.loads(line)
    except ValueError:
        raise LogError(f"{path}: is damaged (the MDF4 reader could not finish it)") from None
    if "error" in reply:
        raise LogError(f"{path}: is not an MDF4 file that asammdf reads ({reply['error']})")
    arrays, at = {}, 0
    for name, kind, shape in reply.pop("arrays"):
        array = np.frombuffer(body, kind, int(np.prod(shape)), at).reshape(shape)
        at += array.nbytes
        arrays[name] = array
    return reply, arrays


def _merge(parts: list[Any]) -> Frames | None:
    """Frames of several channel groups (one per bus or identifier kind), each in order, as one log."""
    if not parts:
        return None
    wide = max(p[5].shape[1] for p in parts)
    t = np.concatenate([p[0][p[1]] for p in parts])
    order = np.argsort(t, kind="stable")
    data = np.concatenate([np.pad(p[5][p[1]], ((0, 0), (0, wide - p[5].shape[1]))) for p in parts])[order]
    ident, bus, length = (np.concatenate([p[k][p[1]] for p in parts])[order] for k in (2, 3, 4))
    t = t[order]
    return Frames(t - t[0], ident, bus, length, data, [n for p in parts for n in p[6]])


def _child(request: bytes, seconds: float) -> bytes:
    """Answer of a fresh interpreter that runs `serve`; empty where it was ended by a fault or a limit.

    Temporary files lie in a folder that goes with it: of a file that was not finalised the library leaves a copy there.
    """
    with tempfile.TemporaryDirectory(prefix="vaneloop-mdf-") as own:
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "TMPDIR": own}
        try:
            done = subprocess.run(
                python("from hil.logs.mdf import serve; serve()"), input=request, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, timeout=seconds, env=environment, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return b""
    return done.stdout if done.returncode == 0 else b""


# --- the child --------------------------------------------------------------------------------------------------------


def serve() -> None:
    """Answer one request on stdin."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not get between the arrays
    with out:
        answer(sys.stdin.buffer.readline(), out)


def answer(request: bytes, out: BinaryIO) -> None:
    """Read the file of ``request`` and write the answer."""
    import asammdf  # before the limit: its own libraries count for little, but take address space

    asked = json.loads(request)
    path = asked["path"]
    with contextlib.suppress(ImportError, OSError, ValueError):  # not on Windows
        import resource

        used = resource.getrusage(resource.RUSAGE_SELF)
        ends = math.ceil(used.ru_utime + used.ru_stime) + int(asked["seconds"])
        resource.setrlimit(resource.RLIMIT_CPU, (ends, ends))
        now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        limit = now + _MEMORY[0] + _MEMORY[1] * os.path.getsize(path)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    arrays: dict[str, np.ndarray] = {}
    try:
        if asked.get("record"):
            reply = {}
            arrays.update(zip(("us", "rows", "sent"), _record(path), strict=True))
        else:
            with asammdf.MDF(path, process_bus_logging=False) as mdf:  # type: ignore[call-arg]
                reply = _read(mdf, asked["wanted"], asked["guess"], arrays)
    except MemoryError:
        reply = {
            "error": f"unpacks to more memory than its size allows, {_MEMORY[0]:,} bytes and {_MEMORY[1]} for each of "
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


def _record(path: str) -> FramesOfRecord:
    """Frames of a recording, as python-can reads them."""
    import can

    with can.LogReader(path) as reader:
        return frames_of(reader, NOTE_CHANNEL)


def _read(mdf: Any, wanted: list[str], guess: bool, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Names, wanted series and bus frames of an open file; numbers go to ``arrays``."""
    from asammdf.blocks.v4_constants import SOURCE_BUS

    found, buses = [], 0
    for g, group in enumerate(mdf.groups):
        names = [str(c.name) for c in group.channels]
        if f"{_BUS}.ID" in names:
            if group.channel_group.cycles_nr:
                for k, a in enumerate(_bus_columns(mdf, g, names)):
                    arrays[f"b{buses}.{k}"] = a
                buses += 1
            continue
        master = mdf.masters_db.get(g)
        label = str(group.channel_group.acq_name or "") or f"group{g}"
        for i, name in enumerate(names):
            if i != master and not name.startswith(_FRAMES):
                found.append((g, i, name, label, master))
    plain = [f[2] for f in found]
    full = [f"{f[3]}.{f[2]}" for f in found]
    reply: dict[str, Any] = {"names": {}, "series": {}, "comments": {}, "why": {}, "buses": buses}
    fold = {w.casefold() for w in wanted}
    for n, (g, i, name, label, master) in enumerate(found):
        short = name.split("\\")[0]
        key = name if plain.count(name) == 1 else full[n] if full.count(full[n]) == 1 else f"{g}.{name}"
        names = list(dict.fromkeys((key, name, short, f"{label}.{name}", f"{label}.{short}", f"{g}.{name}")))
        reply["names"][key] = names
        comment = str(mdf.groups[g].channels[i].comment or "")[:200] if guess else ""
        if not fold & {a.casefold() for a in names} and not (
            guess and any(meaning(x, tuple(UNITS)) for x in (short, comment))
        ):
            continue
        if comment:
            reply["comments"][key] = comment
        if master is None or mdf.groups[g].channels[master].sync_type not in (0, 1):
            reply["why"][key] = "its channel group has no time"
            continue
        s = mdf.get(group=g, index=i, raw=True).physical(ignore_value2text_conversions=True)
        if s.samples.ndim != 1 or s.samples.dtype.kind not in "biuf":
            reply["why"][key] = f"holds {s.samples.dtype}, not numbers"
            continue
        source = mdf.groups[g].channels[i].source or mdf.groups[g].channel_group.acq_source
        reply["series"][key] = (n, str(s.unit or "")[:40], bool(source and source.source_type == SOURCE_BUS))
        arrays[f"t{n}"], arrays[f"v{n}"] = s.timestamps.astype(np.float64), s.samples.astype(np.float64)
    return reply


def _bus_columns(mdf: Any, g: int, names: list[str]) -> list[np.ndarray]:
    """t, identifier, bus, length and bytes of the data frames of one channel group."""

    def column(name: str) -> Any:
        return mdf.get(f"{_BUS}.{name}", group=g, raw=True, ignore_invalidation_bits=True)

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


# --- writing ----------------------------------------------------------------------------------------------------------


def write_mdf(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Channel groups, one per raster; bus logging where a DBC is given."""
    needs(f"{path}: MDF4", "asammdf")
    if dbc is not None:
        write_bus(path, encode_channels(channels, dbc, path))
        return
    rasters: dict[bytes, tuple[np.ndarray, dict[str, tuple[np.ndarray, str]]]] = {}
    for name, c in channels.items():
        rasters.setdefault(c.t.tobytes(), (c.t, {}))[1][name] = c.values, UNITS[name].replace("-", "")
    write_groups(path, list(rasters.values()))


def write_groups(path: Path, groups: list[tuple[np.ndarray, dict[str, tuple[np.ndarray, str]]]]) -> None:
    """Write channel groups: for each the times and name -> (values, unit)."""
    import asammdf

    with whole(path, LogError) as part, asammdf.MDF(version="4.10") as mdf:
        for t, channels in groups:
            mdf.append(
                [asammdf.Signal(v, t, name=name, unit=unit) for name, (v, unit) in channels.items()], comment="VaneLoop"
            )
        with open(part, "wb+") as file:  # given the name, asammdf would put a suffix of its own behind it
            mdf.save(file, compression=2)


def write_bus(path: Path, frames: Frames) -> None:
    """Write a bus-logging file: one channel group of CAN data frames, as the ASAM bus logging standard lays it out."""
    import asammdf
    from asammdf.blocks.v4_blocks import SourceInformation
    from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS

    columns = {
        "BusChannel": np.ones(frames.t.size, np.uint8), "ID": frames.ident & 0x1FFFFFFF,
        "IDE": (frames.ident >> 31).astype(np.uint8),
        "DLC": np.searchsorted([*range(9), 12, 16, 20, 24, 32, 48, 64], frames.length).astype(np.uint8),
        "DataLength": frames.length,
        "DataBytes": frames.data, "Dir": np.zeros(frames.t.size, np.uint8), "EDL": (frames.length > 8).astype(np.uint8),
        "BRS": np.zeros(frames.t.size, np.uint8), "ESI": np.zeros(frames.t.size, np.uint8),
    }  # fmt: skip
    kind = [(f"{_BUS}.{k}", c.dtype.newbyteorder("<"), c.shape[1:]) for k, c in columns.items()]
    samples = np.zeros(frames.t.size, kind)
    for k, c in columns.items():
        samples[f"{_BUS}.{k}"] = c
    source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
    with whole(path, LogError) as part, asammdf.MDF(version="4.10") as mdf:
        mdf.append(
            asammdf.Signal(samples, frames.t, name=_BUS, source=source), comment="VaneLoop", common_timebase=True
        )
        with open(part, "wb+") as file:  # given the name, asammdf would put a suffix of its own behind it
            mdf.save(file, compression=2)
