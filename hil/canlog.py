"""Frames of a CAN log as columns of numbers, and the signals in them.

A log of any format becomes one `Frames` (time, identifier, bus, length, bytes as arrays); a signal is then cut out
of all frames of its message at once. That is what makes an hour of CAN readable in a second: python-can and cantools
walk frame by frame at 0.2 to 0.3 million frames/s and serve here as the reference in the tests, as the readers of
the formats where speed matters less (`.asc`, `.trc`), and as the source of the layout (DBC).

Bit order, as in DBC: a little-endian signal starts at its least significant bit, a big-endian one at its most significant
bit; bit k of the frame is bit k % 8 (0 = least significant) of byte k // 8.
"""

from __future__ import annotations

import functools
import io
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tables import InputError

__all__ = [
    "DISORDER_S", "Frames", "LogError", "Message", "cut_signal", "e2e_crc", "encode", "load_dbc", "read_asc", "read_blf",
    "read_candump", "read_trc", "select", "write_asc", "write_blf", "write_candump", "write_trc",
]  # fmt: skip

EXTENDED = 1 << 31  # flag in `Frames.ident`, as socketcan sets it
DISORDER_S = 0.050  # loggers that merge several channels swap frames by a few ms; more is a clock that jumped
MAX_FILE = 4 << 30  # bytes; a CAN log beyond this is split by every logger


class LogError(InputError):
    """A log cannot be used. One line: file, channel, reason."""


@dataclass(frozen=True)
class Frames:
    """All data frames of a log, in order of time.

    t       float64[n]      s from the first frame
    ident   uint32[n]       identifier, bit 31 set for the 29-bit kind
    bus     int32[n]        number of the bus (interface) in the log
    length  uint8[n]        bytes of data
    data    uint8[n, w]     data, zeros behind `length`; w = 8, or 64 where the log has CAN FD
    """

    t: np.ndarray
    ident: np.ndarray
    bus: np.ndarray
    length: np.ndarray
    data: np.ndarray
    notes: list[str] = field(default_factory=list)


def _frames(name: str, t: np.ndarray, ident: np.ndarray, bus: np.ndarray, length: np.ndarray, data: np.ndarray, notes: list[str]) -> Frames:
    """Put frames in order of time from the first; refuse a clock that jumped back (t in s, or int64 ns)."""
    if t.dtype == np.int64:
        t = (t - t[0]) / 1e9 if t.size else t.astype(np.float64)
    elif t.size:
        t = t - t[0]
    if t.size:
        back = np.maximum.accumulate(t) - t
        worst = int(np.argmax(back))
        if back[worst] > DISORDER_S:
            raise LogError(
                f"{name}: time runs backwards by {back[worst]:.6g} s at frame {worst + 1}; allowed: up to {DISORDER_S * 1e3:g} ms (sorted)"
            )
        if back[worst] > 0:
            order = np.argsort(t, kind="stable")
            notes.append(f"{int(np.count_nonzero(np.diff(t) < 0))} frames out of order by up to {back[worst] * 1e3:.3g} ms: sorted by time")
            t, ident, bus, length, data = t[order], ident[order], bus[order], length[order], data[order]
        t = t - t[0]
    return Frames(t, ident, bus, length, data, notes)


def read_bytes(path: Path) -> bytes:
    """The file's bytes, or a LogError for one that is missing, a folder, empty, or too long."""
    try:
        if path.is_dir():
            raise LogError(f"{path}: is a folder, not a log")
        size = path.stat().st_size
        if size > MAX_FILE:
            raise LogError(f"{path}: {size} bytes; allowed: up to {MAX_FILE}")
        raw = path.read_bytes()
    except (OSError, ValueError) as e:
        raise LogError(f"{path}: cannot be read ({getattr(e, 'strerror', None) or e})") from None
    if not raw:
        raise LogError(f"{path}: is empty")
    return raw


# --- candump -----------------------------------------------------------------------------------------------------------------------------

_CANDUMP = re.compile(
    rb"\((?P<s>\d{1,10})\.(?P<f>\d{1,9})\)\s+(?P<if>[^\s#]{1,20})\s+(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    rb"(?:(?P<r>R[0-9A-Fa-f]?)|#(?P<fl>[0-9A-Fa-f])(?P<fd>(?:[0-9A-Fa-f]{2}){0,64})|(?P<d>(?:[0-9A-Fa-f]{2}){0,8})(?:_[0-9A-Fa-f])?)"
    rb"(?P<tail>(?:\s+[RTrt](?:x|X)?)?[ \t]*)\Z"
)
_NIBBLE = np.full(256, 255, np.uint8)
for _i, _c in enumerate(b"0123456789ABCDEF"):
    _NIBBLE[_c] = _i
for _i, _c in enumerate(b"abcdef"):
    _NIBBLE[_c] = 10 + _i
_SHAPES = 64  # layouts tried per line length before the rest is called unreadable
_LONGEST = 260  # bytes of the longest candump line, CAN FD with direction


def read_candump(path: Path) -> Frames:
    """Frames of a `candump -l` log, line by line layout rather than line by line.

    Lines of equal length nearly always have equal layout. The first line of each length gives the columns (regular
    expression), all lines that agree with it are parsed as one matrix, the others take the next round.
    """
    raw = read_bytes(path)
    buf = np.frombuffer(raw, np.uint8)
    end = np.flatnonzero(buf == 10)
    start = np.concatenate(([0], end + 1))
    end = np.concatenate((end, [buf.size]))
    end = end - ((end > start) & (buf[np.maximum(end - 1, 0)] == 13))
    size = end - start
    wanted = np.flatnonzero(size > 0)
    start, size = start[wanted], size[wanted]

    parts: list[tuple[np.ndarray, ...]] = []
    names: dict[bytes, int] = {}
    bad = int(np.count_nonzero(size > _LONGEST))
    special = 0  # remote and error frames
    by_size = np.argsort(size, kind="stable")
    cuts = np.flatnonzero(np.diff(size[by_size])) + 1
    for rows in np.split(by_size, cuts) if by_size.size else []:
        width = int(size[rows[0]])
        if width > _LONGEST:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(buf, width)
        for _ in range(_SHAPES):
            if not rows.size:
                break
            first = int(start[rows[0]])
            m = _CANDUMP.match(raw[first : first + width])
            if m is None:
                bad += 1
                rows = rows[1:]
                continue
            text = windows[start[rows]]
            fits, got, kind = _parse_shape(text, m, names)
            if kind is None:
                special += int(np.count_nonzero(fits))
            else:
                ns, ident, number, data = got
                error = ident >= (1 << 29)  # 0x20000000 marks an error frame
                special += int(np.count_nonzero(error))
                keep = ~error
                parts.append((rows[fits][keep], ns[keep], np.where(kind, ident | np.uint32(EXTENDED), ident)[keep],
                              np.full(int(keep.sum()), number, np.int32), data[keep]))  # fmt: skip
            rows = rows[~fits]
        bad += rows.size

    notes = []
    if bad:
        notes.append(f"{bad} of {wanted.size} lines are not candump lines: left out")
    if special:
        notes.append(f"{special} remote or error frames: left out")
    if not parts:
        raise LogError(f"{path}: no candump frame in it; a line looks like (1735329625.329586) can0 17C#0000000010000021")
    order = np.argsort(np.concatenate([p[0] for p in parts]))
    wide = 8 if max(p[4].shape[1] for p in parts) <= 8 else 64
    data = np.zeros((order.size, wide), np.uint8)
    length = np.zeros(order.size, np.uint8)
    at = 0
    for p in parts:
        n, w = p[4].shape
        data[at : at + n, :w] = p[4]
        length[at : at + n] = w
        at += n
    ns, ident, bus = (np.concatenate([p[k] for p in parts])[order] for k in (1, 2, 3))
    return _frames(str(path), ns, ident, bus, length[order], data[order], notes)


def _parse_shape(text: np.ndarray, m: re.Match[bytes], names: dict[bytes, int]) -> tuple[np.ndarray, Any, bool | None]:
    """Parse the lines (rows of ``text``) that have the columns of ``m``.

    Returns which rows fit, (ns, identifier, bus, data) of these, and whether identifiers are 29-bit; None for remote frames.
    """
    line = np.frombuffer(m.string, np.uint8)
    (s0, s1), (f0, f1), (i0, i1) = m.span("s"), m.span("f"), m.span("id")
    d0, d1 = m.span("fd") if m["fl"] is not None else m.span("d") if m["r"] is None else (m.end("r"), m.end("r"))
    same = np.ones(line.size, bool)
    digits = np.r_[s0:s1, f0:f1]
    nibbles = np.r_[i0:i1, d0:d1]
    same[digits] = False
    same[nibbles] = False
    if m["fl"] is not None:
        same[m.start("fl")] = False
    fits = np.ones(len(text), bool)
    for k in np.flatnonzero(same):
        fits &= text[:, k] == line[k]
    number = text[:, digits] - np.uint8(48)
    fits &= (number <= 9).all(axis=1)
    half = _NIBBLE[text[:, nibbles]]
    fits &= (half < 16).all(axis=1)
    number, half = number[fits].astype(np.float64), half[fits]
    seconds = (number[:, : s1 - s0] @ 10.0 ** np.arange(s1 - s0 - 1, -1, -1)).astype(np.int64)
    fraction = (number[:, s1 - s0 :] @ 10.0 ** np.arange(8, 8 - (f1 - f0), -1)).astype(np.int64)
    seconds = np.minimum(seconds, 9_000_000_000)  # int64 nanoseconds end in the year 2262
    width = i1 - i0
    ident = np.zeros(len(half), np.uint32)
    for k in range(width):
        ident = (ident << np.uint32(4)) | half[:, k]
    data = (half[:, width::2] << 4) | half[:, width + 1 :: 2]
    bus = names.setdefault(m["if"], len(names))
    return fits, (seconds * 1_000_000_000 + fraction, ident, bus, data), None if m["r"] is not None else width == 8


def write_candump(path: Path, frames: Frames) -> None:
    """Write a `candump -l` log of classic frames on vcan0, microseconds."""
    text = frames.data.tobytes().hex().upper()
    w = 2 * frames.data.shape[1]
    micros = np.rint(frames.t * 1e6).astype(np.int64).tolist()
    lines = [
        f"({us // 1_000_000:010d}.{us % 1_000_000:06d}) vcan0 {i & 0x1FFFFFFF:0{8 if i >> 31 else 3}X}#{text[k * w : k * w + 2 * n]}\n"
        for k, (us, i, n) in enumerate(zip(micros, frames.ident.tolist(), frames.length.tolist(), strict=True))
    ]
    path.write_text("".join(lines), encoding="ascii")


# --- database ----------------------------------------------------------------------------------------------------------------------------

# What a DBC can lose without losing a signal's layout, least needed first.
_DROP = (("VAL_",), ("CM_",), ("BA_", "BA_DEF_", "BA_DEF_DEF_", "BA_REL_", "BA_DEF_REL_", "BA_DEF_DEF_REL_", "SIG_GROUP_", "EV_",
         "BO_TX_BU_", "VAL_TABLE_"))  # fmt: skip


@dataclass(frozen=True)
class Message:
    """One message of the database, with what the product needs beyond its layout.

    e2e         DataID of AUTOSAR E2E profile 1, None where the message has none
    j1939       raw values with 0xFE or 0xFF on top mean error or not available (J1939-71)
    missing     signal -> raw value that means not available (attribute NotAvailable of vgv.dbc)
    """

    layout: Any  # cantools.database.can.Message
    ident: int
    e2e: int | None
    j1939: bool
    missing: dict[str, int]


def load_dbc(path: Path) -> tuple[list[Message], list[str]]:
    """Messages of a database file and notes on what had to be left out of it."""
    raw = read_bytes(path)
    return _load_dbc(str(path), raw)


@functools.lru_cache(maxsize=8)
def _load_dbc(path: str, raw: bytes) -> tuple[list[Message], list[str]]:
    import cantools

    kind = Path(path).suffix.lower().lstrip(".")
    text = raw.decode("utf-8-sig" if raw.startswith(b"\xef\xbb\xbf") else "cp1252", errors="replace")
    if kind in ("arxml", "kcd", "sym"):
        tries = [(text, False, "")]
    else:
        kind = "dbc"
        if "BO_ " not in text:
            raise LogError(f"{path}: is not a DBC (it defines no message, BO_)")
        tries = [(text, True, ""), (text, False, "")]
        for k in range(1, len(_DROP) + 1):
            gone = [word for words in _DROP[:k] for word in words]
            shorter = re.sub(rf'^[ \t]*(?:{"|".join(gone)})[ \t](?:[^;"]|"(?:[^"\\]|\\.)*")*;', "", text, flags=re.M)
            tries.append((shorter, False, "without its lines " + ", ".join(gone)))
    reason = ""
    for content, strict, lost in tries:
        try:
            db = cantools.database.load_string(content, database_format=kind, strict=strict)
            messages = [_message(m) for m in db.messages]
        except Exception as e:  # cantools raises whatever its grammar meets
            reason = reason or " ".join(str(e).split())[:120]
            continue
        return messages, [f"{path}: read {lost} ({reason})"] if lost else []
    raise LogError(f"{path}: is not a database that cantools reads ({reason})")


def _message(m: Any) -> Message:
    """Read the attributes of a cantools message."""
    attributes = m.dbc.attributes if m.dbc is not None else {}

    def number(of: Any, key: str) -> int | None:
        attribute = of.get(key)
        return None if attribute is None else attribute.value

    missing = {}
    for s in m.signals:
        value = number(s.dbc.attributes if s.dbc is not None else {}, "NotAvailable")
        if isinstance(value, int):
            missing[s.name] = value
    e2e = number(attributes, "DataID") if number(attributes, "E2EProfile") in (1, "P01") else None
    frame_format = attributes.get("VFrameFormat")
    j1939 = m.protocol == "j1939" or (frame_format is not None and frame_format.value in (3, "J1939PG"))
    ident = m.frame_id | (EXTENDED if m.is_extended_frame else 0)
    return Message(m, ident, e2e, j1939 and m.is_extended_frame, missing)


def pgn(ident: np.ndarray | int) -> Any:
    """J1939 parameter group number of a 29-bit identifier: without priority, source and (PDU1) destination."""
    specific = ((ident >> 16) & 0xFF) < 240
    return ((ident >> 8) & 0x3FF00) | np.where(specific, 0, (ident >> 8) & 0xFF)


# --- signals -----------------------------------------------------------------------------------------------------------------------------


def select(frames: Frames, message: Message) -> tuple[np.ndarray, list[str]]:
    """Rows of ``frames`` that carry ``message``, with notes on what was left out.

    The exact identifier counts first, then, for 29-bit identifiers, the J1939 parameter group. Where several senders or
    buses carry it, the one with most frames is taken: two sources in one channel would be a signal that nobody measured.
    """
    name, notes = message.layout.name, []
    rows = np.flatnonzero(frames.ident == np.uint32(message.ident))
    if not rows.size and message.ident & EXTENDED:
        rows = np.flatnonzero((frames.ident >> 31 == 1) & (pgn(frames.ident) == pgn(message.ident & 0x1FFFFFFF)))
    if not rows.size:
        return rows, []
    source = frames.ident[rows].astype(np.int64) << 16 | (frames.bus[rows] & 0xFFFF)
    kinds, counts = np.unique(source, return_counts=True)
    if kinds.size > 1:
        best = kinds[np.argmax(counts)]
        notes.append(f"{name}: {kinds.size} senders or buses; took 0x{(best >> 16) & 0x1FFFFFFF:X} ({counts.max()} of {rows.size} frames)")
        rows = rows[source == best]
    short = frames.length[rows] < message.layout.length
    if short.any():
        notes.append(f"{name}: {int(short.sum())} of {rows.size} frames are shorter than its {message.layout.length} bytes: left out")
        rows = rows[~short]
    if message.e2e is not None and rows.size:
        data = frames.data[rows, : message.layout.length]
        wrong = e2e_crc(data, message.e2e) != data[:, 0]
        if wrong.any():
            notes.append(f"{name}: {int(wrong.sum())} of {rows.size} frames have a wrong CRC: left out")
            rows = rows[~wrong]
    return rows, notes


def _crc_table() -> np.ndarray:
    """CRC-8 SAE J1850, polynomial 0x1D."""
    c = np.arange(256)
    for _ in range(8):
        c = np.where(c & 0x80, (c << 1) ^ 0x1D, c << 1) & 0xFF
    return c.astype(np.uint8)


_CRC = _crc_table()


def e2e_crc(data: np.ndarray, data_id: int) -> np.ndarray:
    """CRC of AUTOSAR E2E profile 1, data identifier mode BOTH, over rows of bytes whose first is the CRC's place."""
    start = _CRC[_CRC[data_id & 0xFF] ^ (data_id >> 8)]
    crc = np.full(len(data), start, np.uint8)
    for k in range(1, data.shape[1]):
        crc = _CRC[crc ^ data[:, k]]
    return crc


def _place(signal: Any) -> tuple[list[int], int]:
    """Bytes of a signal from least to most significant, and how far its lowest bit is above bit 0 of the first of them."""
    if signal.byte_order == "little_endian":
        first, last = signal.start // 8, (signal.start + signal.length - 1) // 8
        return list(range(first, last + 1)), signal.start % 8
    first = 8 * (signal.start // 8) + 7 - signal.start % 8
    after = first + signal.length
    return list(range((after - 1) // 8, first // 8 - 1, -1)), -after % 8


def cut_raw(data: np.ndarray, signal: Any) -> np.ndarray:
    """Raw values of a signal: uint64, int64, or float64 for IEEE signals."""
    places, shift = _place(signal)
    raw = np.zeros(len(data), np.uint64)
    for k, byte in enumerate(places):
        column = data[:, byte].astype(np.uint64)
        up = 8 * k - shift
        raw |= column << np.uint64(up) if up >= 0 else column >> np.uint64(-up)
    n = signal.length
    if n < 64:
        raw &= np.uint64((1 << n) - 1)
    if signal.is_float:
        whole, part = {16: (np.uint16, np.float16), 32: (np.uint32, np.float32), 64: (np.uint64, np.float64)}[n]
        with np.errstate(invalid="ignore"):
            return raw.astype(whole).view(part).astype(np.float64)
    if not signal.is_signed:
        return raw
    lift = np.uint64(64 - n)
    return (raw << lift).view(np.int64) >> np.int64(64 - n)


def cut_signal(frames: Frames, rows: np.ndarray, message: Message, signal: Any) -> tuple[np.ndarray, np.ndarray, int]:
    """Rows that carry the signal's value, the physical values, and how many said "not available".

    value = raw * scale + offset; a multiplexed signal is in the frames whose selector says so.
    """
    selector, wanted = signal.multiplexer_signal, signal.multiplexer_ids
    while selector is not None and wanted:
        chooser = message.layout.get_signal_by_name(selector)
        raw = cut_raw(frames.data[rows], chooser)
        rows = rows[np.isin(raw, np.array(wanted, raw.dtype))]
        selector, wanted = chooser.multiplexer_signal, chooser.multiplexer_ids
    raw = cut_raw(frames.data[rows], signal)
    there = np.ones(rows.size, bool)
    if signal.name in message.missing:
        there = raw.astype(np.int64) != message.missing[signal.name]
    elif message.j1939 and not signal.is_float:
        bits = raw.astype(np.uint64) & np.uint64((1 << signal.length) - 1)
        n = signal.length
        there = bits >> np.uint64(n - 8) < 0xFE if n >= 8 else bits < (1 << n) - 1 if n >= 4 else there
    values = raw.astype(np.float64) * float(signal.scale) + float(signal.offset)
    return rows[there], values[there], int(np.count_nonzero(~there))


def encode(message: Message, values: dict[str, np.ndarray], n: int) -> np.ndarray:
    """Bytes of ``n`` frames: physical values to raw ones (nearest), NaN to "not available", then counter and CRC."""
    data = np.zeros((n, message.layout.length), np.uint8)
    for signal in message.layout.signals:
        if message.e2e is not None and signal.name in ("crc", "counter"):
            continue
        column = values.get(signal.name)
        low, high = (-(1 << signal.length - 1), (1 << signal.length - 1) - 1) if signal.is_signed else (0, (1 << signal.length) - 1)
        none = message.missing.get(signal.name, 0)
        if column is None:
            raw = np.full(n, none, np.int64)
        else:
            exact = (column - float(signal.offset)) / float(signal.scale)
            scaled = np.rint(exact)
            with np.errstate(invalid="ignore"):
                bad = (scaled < low) | (scaled > high) | ((scaled == none) & (signal.name in message.missing))
            if bad.any():
                a, b = sorted((low * float(signal.scale) + float(signal.offset), high * float(signal.scale) + float(signal.offset)))
                raise LogError(
                    f"{signal.name} (={column[np.argmax(bad)]:g} {signal.unit or ''}): does not fit {message.layout.name}, "
                    f"which holds {a:g} to {b:g}; a table format (.csv, .parquet) holds any value"
                )
            raw = np.where(np.isnan(scaled), none, scaled).astype(np.int64)
        bits = raw.astype(np.uint64) & np.uint64((1 << signal.length) - 1)
        places, shift = _place(signal)
        for k, byte in enumerate(places):
            up = 8 * k - shift
            data[:, byte] |= (bits >> np.uint64(up) if up >= 0 else bits << np.uint64(-up)).astype(np.uint8)
    if message.e2e is not None:
        data[:, 1] |= (np.arange(1, n + 1) % 15).astype(np.uint8)
        data[:, 0] = e2e_crc(data, message.e2e)
    return data
