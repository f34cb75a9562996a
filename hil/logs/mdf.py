"""MDF files through asammdf, read in a process of their own.

asammdf follows the links and sizes of a file as they stand: one flipped bit can end in a segmentation fault, an endless
chain of blocks or an allocation of terabytes (seen in fuzzing, asammdf 8.8). A log from outside must not take its
reader down, so a child process with limits on time and memory (`hil.logs.mdf_child`) opens the file and hands back
arrays. It costs 0.3 s a file.

Request, one line of JSON on the child's stdin: {"path", "wanted": [names], "guess"}. Answer on its stdout: one line of
JSON, then the bytes of the arrays it lists. {"error": text} stands for what the file is to blame for.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from hil.logs.bus_log import open_bus_log
from hil.logs.frames import Frames, in_order
from hil.logs.notes import Note
from hil.logs.record_formats import FramesOfRecord
from hil.logs.source import LogError, Options, Samples, Series, Source, check_file, find, read_bytes
from vaneloop.base.child import python
from vaneloop.base.extras import needs

__all__ = ["Groups", "open_mdf", "read_as_others", "read_mdf", "read_record_mdf"]

_TIME = 20, 1e6  # s of a processor, and bytes of file per further second
_BUSY = 20  # times as long by the wall clock: others may have the processors, too


class Groups(Samples):
    """Channel groups of an MDF file: `CHANNEL`, or `GROUP.CHANNEL` where several groups have it."""

    def __init__(self, content: dict[str, Any]):
        held = content["series"].items()
        super().__init__({key: Series(t, values, unit, framed=framed) for key, (t, values, unit, framed) in held})
        self.names = {key: tuple(names) for key, names in content["names"].items()}
        self.comments: dict[str, str] = content["comments"]
        self._why, self._invalid = content["why"], content["invalid"]

    def series(self, key: str) -> Series:
        if key in self._series:
            if lost := self._invalid.pop(key, 0):
                said = f"{key}: {lost:,} samples that the logger marks as invalid: left out"
                self.notes.append(Note(said, "left out", key, lost))
            return super().series(key)
        self.notes.append(f"{key}: {self._why.get(key, 'has no samples')}")
        return Series(np.empty(0), np.empty(0))


def open_mdf(path: Path, options: Options) -> Source:
    """MDF: bus logging where the file holds CAN frames and a DBC is given or no channel has a name that is
    asked for.
    """
    wanted = [*options.signals, *options.mapping]
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
    one of our signals), "comments" of these, "why" (key -> reason it has no numbers), "invalid" (key -> how many
    samples the logger marks as invalid, which are left out), and the frames of its bus logging, if any.
    """
    reply, arrays = _answered(path, {"wanted": wanted, "guess": guess})
    series = {
        key: (arrays[f"t{i}"], arrays[f"v{i}"], unit, framed) for key, (i, unit, framed) in reply["series"].items()
    }
    parts = []
    for i in range(reply["buses"]):
        t, ident, bus, length, data = (arrays[f"b{i}.{k}"] for k in range(5))
        parts.append((*in_order(str(path), t, notes := []), ident, bus, length, data, notes))  # type: ignore[var-annotated]
    return {**{k: reply[k] for k in ("names", "comments", "why", "invalid")}, "series": series}, _merge(parts)


def read_as_others(path: Path, request: dict[str, Any]) -> dict[str, np.ndarray]:
    """The frames of an MDF4 file as python-can reads them (``frames``), or t0, v0, t1, ... of the ``channels`` of these
    keys as asammdf's own `get` gives them.
    """
    return _answered(path, request)[1]


def read_record_mdf(path: Path) -> FramesOfRecord:
    """Frames of an MDF4 file as python-can reads them, with their directions."""
    _, arrays = _answered(path, {"record": True})
    return arrays["us"], arrays["rows"], arrays["sent"]


def _answered(path: Path, request: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What the child answers to a request on a file, and its arrays. Every reader of the format asks here."""
    head = read_bytes(path, 168)
    old = head[8:9] in (b"2", b"3") and head[64:66] == b"HD"
    if head[:8] not in (b"MDF     ", b"UnFinMF ") or len(head) < 168 or (head[64:68] != b"##HD" and not old):
        raise LogError(f"{path}: is not a whole MDF file")
    needs(f"{path}: MDF", "asammdf")
    seconds = _TIME[0] + int(check_file(path) / _TIME[1])
    request = {"path": str(path.absolute()), "seconds": seconds, **request}
    answer = _child(json.dumps(request).encode() + b"\n", _BUSY * seconds)
    line, _, body = answer.partition(b"\n")
    try:
        reply = json.loads(line)
    except ValueError:
        raise LogError(f"{path}: is damaged (the MDF reader could not finish it)") from None
    if "error" in reply:
        raise LogError(f"{path}: is not an MDF file that asammdf reads ({reply['error']})")
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
    """Answer of a fresh interpreter that runs `hil.logs.mdf_child.serve`; empty where it was ended by a fault or a
    limit.

    Temporary files lie in a folder that goes with it: of a file that was not finalised the library leaves a copy there.
    """
    with tempfile.TemporaryDirectory(prefix="vaneloop-mdf-") as own:
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "TMPDIR": own}
        try:
            done = subprocess.run(
                python("from hil.logs.mdf_child import serve; serve()"), input=request, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, timeout=seconds, env=environment, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return b""
    return done.stdout if done.returncode == 0 else b""
