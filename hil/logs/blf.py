"""Vector binary logs, `.blf`."""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hil.logs.frames import Frames, frames_in_order
from hil.logs.source import LogError, read_bytes

__all__ = ["read_blf", "unpacked", "whole_blf"]

_OBJECT = struct.Struct("<4sHHII")  # signature, header size, header version, size, type
_CONTAINER, _CAN, _CAN2, _FD, _FD64 = 10, 1, 86, 100, 101
_HEADER = 144  # bytes of the file's own header
_PART = 1 << 20  # bytes of a container that is written here
_MOST = (
    32 << 20,
    50,
)  # bytes of all containers together, and more for each byte of the file; frames that never change shrink 11-fold


def read_blf(path: Path) -> Frames:
    """Frames of a Vector binary log; each kind of object is decoded as one matrix."""
    stream, damaged = unpacked(path)
    objects, more = _blf_objects(stream)
    notes = [f"{damaged + more} damaged places in the BLF: what is there was left out"] if damaged + more else []
    parts = [part for kind in (_CAN, _CAN2, _FD, _FD64) for part in _blf_frames(stream, objects, kind)]
    if not any(part[0].size for part in parts):  # remote frames may be all there are
        raise LogError(f"{path}: no CAN data frame in it")
    order = np.argsort(np.concatenate([p[0] for p in parts]), kind="stable")
    _, ns, ident, bus, length = (np.concatenate([p[k] for p in parts])[order] for k in range(5))
    wide = 8 if length.max() <= 8 else 64
    data = np.zeros((order.size, wide), np.uint8)
    row = 0
    for p in parts:
        w = min(wide, p[5].shape[1])
        data[row : row + len(p[5]), :w] = p[5][:, :w]
        row += len(p[5])
    return frames_in_order(str(path), ns, ident, bus, length, data[order], notes)


def unpacked(path: Path) -> tuple[bytes, int]:
    """The objects of a Vector binary log, its containers unpacked and joined, and how many damaged places were met.

    Every reader of the format begins here. A damaged container costs its own frames; what unpacks to more than `_MOST`
    is refused.
    """
    raw = read_bytes(path)
    if len(raw) < _HEADER or raw[:4] != b"LOGG":
        raise LogError(f"{path}: is not a BLF (it must begin with LOGG and a header of {_HEADER} bytes)")
    chunks, damaged, total = [], 0, 0
    most = _MOST[0] + _MOST[1] * len(raw)
    at = min(max(int.from_bytes(raw[4:8], "little"), _HEADER), len(raw))
    while at + 16 <= len(raw):
        signature, _, _, size, kind = _OBJECT.unpack_from(raw, at)
        if signature != b"LOBJ" or size < 16:
            damaged += 1
            at = raw.find(b"LOBJ", at + 1)
            if at < 0:
                break
            continue
        body = raw[at + 32 : at + size]
        damaged += at + size > len(raw)
        if kind == _CONTAINER and len(body):
            method, length = struct.unpack_from("<H6xI", raw, at + 16)
            if method == 2:
                inflate = zlib.decompressobj()
                try:  # deflate cannot shrink more than 1032-fold: a longer promise is a lie
                    body = inflate.decompress(body, min(length, 1032 * len(body) + 1024, most - total + 1) or 1)
                except zlib.error:
                    body = b""
                    damaged += 1
            elif method != 0:
                damaged += 1
                body = b""
        elif kind != _CONTAINER:
            body = raw[at : at + size]
        total += len(body)
        if total > most:
            raise LogError(
                f"{path}: {len(raw):,} bytes unpack to more than {most:,}; allowed: {_MOST[1]} times as much, and "
                f"{_MOST[0]:,}"
            )
        chunks.append(body)
        at += size + size % 4
    return b"".join(chunks), damaged


def whole_blf(path: Path) -> bytes:
    """A Vector binary log for python-can's reader, which does not return from an object of size 0 and believes any
    container: the file's own objects, those that are whole, in containers that are not compressed.
    """
    stream, _ = unpacked(path)
    out, part = [read_bytes(path, 4), _HEADER.to_bytes(4, "little"), read_bytes(path, _HEADER)[8:]], bytearray()

    def end_part() -> None:
        size = _OBJECT.size + 16 + len(part)
        out.append(_OBJECT.pack(b"LOBJ", _OBJECT.size, 1, size, _CONTAINER))
        out.append(struct.pack("<H6xI4x", 0, len(part)) + bytes(part))
        part.clear()

    for at, _, size, _ in _blf_objects(stream)[0].tolist():
        part += stream[at : at + size] + bytes(-size % 4)
        if len(part) > _PART:
            end_part()
    end_part()
    return b"".join(out)


def _blf_objects(stream: bytes) -> tuple[np.ndarray, int]:
    """Place, header version, size and type of each object, and how many damaged places were met."""
    unpack, find = _OBJECT.unpack_from, stream.find
    found = array("q")
    at, damaged, end = 0, 0, len(stream)
    while at + 32 <= end:
        signature, _, version, size, kind = unpack(stream, at)
        if signature != b"LOBJ":
            next_at = find(b"LOBJ", at + 1)
            if next_at < 0:
                break
            damaged += next_at - at > 8
            at = next_at
            continue
        if size < 32 or at + size > end:
            damaged += 1
            at += 4
            continue
        found.extend((at, version, size, kind))
        at += size
    return np.frombuffer(found, np.int64).reshape(-1, 4), damaged


def _blf_frames(stream: bytes, objects: np.ndarray, kind: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Place, ns, identifier, bus, length and data of the data frames of one object type, by header version."""
    need = {_CAN: 16, _CAN2: 16, _FD: 84, _FD64: 40}[kind]
    for version, header in ((1, 32), (2, 40)):
        these = objects[(objects[:, 3] == kind) & (objects[:, 1] == version) & (objects[:, 2] >= header + need)]
        if not len(these):
            continue
        width = header + need + (64 if kind == _FD64 else 0)
        # the last object may be shorter than the columns that are cut out of it
        buf = np.frombuffer(stream if int(these[-1, 0]) + width <= len(stream) else stream + bytes(width), np.uint8)
        text = np.lib.stride_tricks.sliding_window_view(buf, width)[these[:, 0]]

        def number(at: int, size: int, text: np.ndarray = text) -> np.ndarray:
            return np.ascontiguousarray(text[:, at : at + size]).view(f"<u{size}")[:, 0]

        step = np.where(number(16, 4) == 1, 10_000, 1).astype(np.uint64)
        ticks = np.minimum(number(24, 8), np.uint64(9e18) // step)
        ident = number(header + 4, 4)
        at = header + (40 if kind == _FD64 else 20 if kind == _FD else 8)
        if kind == _FD64:
            room = np.where(text[:, header + 35] > 0, text[:, header + 35], these[:, 2]) - header - 40
            bus, remote = text[:, header], number(header + 12, 4) & 0x10
            length = np.where(room < 0, 0, np.minimum(text[:, header + 2], 64))
        else:
            bus, remote = number(header, 2), text[:, header + 2] & 0x80
            length = np.minimum(text[:, header + 14], 64) if kind == _FD else np.minimum(text[:, header + 3], 8)
        data = text[:, at : at + (8 if kind in (_CAN, _CAN2) else 64)].copy()
        # of an FD64 object zeros at the end of the frame need not be stored
        stored = np.minimum(length, room) if kind == _FD64 else length
        data[np.arange(data.shape[1]) >= stored[:, None]] = 0
        keep = remote == 0
        ns = (ticks * step).astype(np.int64)
        fields = these[:, 0], ns, ident & np.uint32(0x9FFFFFFF), bus.astype(np.int32), length.astype(np.uint8), data
        yield tuple(f[keep] for f in fields)
