"""Signals in the frames of a message: cut out of all of them at once, put into new ones, and E2E protection.

Bit order, as in DBC: a little-endian signal starts at its least significant bit, a big-endian one at its most
significant bit; bit k of the frame is bit k % 8 (0 = least significant) of byte k // 8.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.logs.columns import cut, wrong_crc
from hil.logs.dbc import Message
from hil.logs.frames import EXTENDED, Frames
from hil.logs.notes import MOST_ROWS, Note
from hil.logs.source import LogError

__all__ = ["crc_table", "cut_raw", "cut_signal", "e2e_crc", "encode", "pgn", "select"]


# --- frames of a message ----------------------------------------------------------------------------------------------


def pgn(ident: np.ndarray | int) -> Any:
    """J1939 parameter group number of a 29-bit identifier: without priority, source and (PDU1) destination."""
    specific = ((ident >> 16) & 0xFF) < 240
    return ((ident >> 8) & 0x3FF00) | np.where(specific, 0, (ident >> 8) & 0xFF)


def select(frames: Frames, message: Message) -> tuple[np.ndarray, list[str]]:
    """Rows of ``frames`` that carry ``message``, with notes on what was left out.

    The exact identifier counts first, then, for 29-bit identifiers, the J1939 parameter group. Where several senders or
    buses carry it, the one with most frames is taken: two sources in one channel would be a signal that nobody
    measured.
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
        notes.append(
            f"{name}: {kinds.size} senders or buses; took 0x{(best >> 16) & 0x1FFFFFFF:X} ({counts.max()} of "
            f"{rows.size} frames)"
        )
        rows = rows[source == best]
    short = frames.length[rows] < message.layout.length
    if short.any():
        what = f"{int(short.sum())} of {rows.size} frames are shorter than its {message.layout.length} bytes"
        # bytes of a transport protocol, of which nothing could be put together, are no signals
        carried = message.layout.length > 8 and int(frames.length[rows].max()) <= 8
        if message.e2e is None and (not carried or message.layout.is_multiplexed()):
            notes.append(Note(f"{name}: {what}: read as far as they reach", "cut", name, short.sum()))
        else:  # a CRC is over all of them
            notes.append(Note(f"{name}: {what}: left out", "left out", name, short.sum()))
            rows = rows[~short]
    if message.e2e is not None and rows.size:
        if message.layout.length == 8 and frames.data.shape[1] == 8:
            wrong = np.empty(rows.size, bool)
            wrong_crc(frames.words, rows, _CRC, _CRC[_CRC[message.e2e & 0xFF] ^ (message.e2e >> 8)], wrong)
        else:
            data = frames.data[rows, : message.layout.length]
            wrong = e2e_crc(data, message.e2e) != data[:, 0]
        if wrong.any():
            said = f"{name}: {int(wrong.sum())} of {rows.size} frames have a wrong CRC: left out"
            notes.append(Note(said, "left out", name, wrong.sum(), rows[wrong][:MOST_ROWS] + 1))
            rows = rows[~wrong]
    return rows, notes


# --- E2E --------------------------------------------------------------------------------------------------------------


def crc_table() -> np.ndarray:
    """CRC-8 SAE J1850, polynomial 0x1D."""
    c: Any = np.arange(256)
    for _ in range(8):
        c = np.where(c & 0x80, (c << 1) ^ 0x1D, c << 1) & 0xFF
    return c.astype(np.uint8)


_CRC = crc_table()


def e2e_crc(data: np.ndarray, data_id: int) -> np.ndarray:
    """CRC of AUTOSAR E2E profile 1, data identifier mode BOTH, over rows of bytes whose first is the CRC's place."""
    start = _CRC[_CRC[data_id & 0xFF] ^ (data_id >> 8)]
    crc = np.full(len(data), start, np.uint8)
    for k in range(1, data.shape[1]):
        crc = _CRC[crc ^ data[:, k]]
    return crc


# --- signals ----------------------------------------------------------------------------------------------------------


def _place(signal: Any) -> tuple[list[int], int]:
    """Bytes of a signal from least to most significant, and how far its lowest bit is above bit 0 of the first
    of them.
    """
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
    chain, selector, wanted = [signal], signal.multiplexer_signal, signal.multiplexer_ids
    while selector is not None and wanted and len(chain) < 8:
        chain.append(message.layout.get_signal_by_name(selector))
        selector, wanted = chain[-1].multiplexer_signal, chain[-1].multiplexer_ids
    need = 1 + max(max(_place(s)[0]) for s in chain)
    if any(s.length > 64 or (s.is_float and s.length not in (16, 32, 64)) or min(_place(s)[0]) < 0 for s in chain):
        raise LogError(
            f"{message.layout.name}.{signal.name}: {signal.length} bits cannot be read; allowed: 64, or an IEEE number"
        )
    if need > frames.data.shape[1]:
        return rows[:0], np.empty(0), 0
    if (
        frames.data.shape[1] == 8
        and len(chain) == 1
        and not signal.is_float
        and not message.j1939
        and signal.length < 64
    ):
        return _cut_integer(frames, rows, message, signal, need)
    rows = rows[frames.length[rows] >= need]
    for s, chooser in zip(chain, chain[1:], strict=False):
        raw = cut_raw(frames.data[rows], chooser)
        rows = rows[np.isin(raw.astype(np.int64), np.array(s.multiplexer_ids, np.int64))]
    raw = cut_raw(frames.data[rows], signal)
    there = np.ones(rows.size, bool)
    if signal.name in message.missing:
        there = raw.astype(np.int64) != message.missing[signal.name]
    elif message.j1939 and not signal.is_float:
        bits = raw.astype(np.uint64) & np.uint64((1 << signal.length) - 1)
        n = signal.length
        there = bits >> np.uint64(n - 8) < 0xFE if n >= 8 else bits < (1 << n) - 1 if n >= 4 else there
    with np.errstate(all="ignore"):  # an IEEE signal may hold anything; the reader leaves out what is not finite
        values = raw.astype(np.float64) * float(signal.scale) + float(signal.offset)
    return rows[there], values[there], int(np.count_nonzero(~there))


def _cut_integer(
    frames: Frames, rows: np.ndarray, message: Message, signal: Any, need: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """`cut_signal` for the common case: an integer that is in every frame of eight bytes."""
    places, shift = _place(signal)
    big = len(places) > 1 and places[0] > places[1]
    shift += 8 * (7 - places[0] if big else places[0])
    none = message.missing.get(signal.name, 1 << 62)
    out_rows, out = np.empty(rows.size, np.int64), np.empty(rows.size)
    scale, offset = float(signal.scale), float(signal.offset)
    n, missing = cut(
        frames.words,
        rows,
        frames.length,
        need,
        big,
        shift,
        signal.length,
        bool(signal.is_signed),
        scale,
        offset,
        none,
        out_rows,
        out,
    )
    return out_rows[:n], out[:n], missing


def encode(message: Message, values: dict[str, np.ndarray], n: int) -> np.ndarray:
    """Bytes of ``n`` frames: physical values to raw ones (nearest), NaN to "not available", then counter and CRC."""
    data = np.zeros((n, message.layout.length), np.uint8)
    for signal in message.layout.signals:
        if message.e2e is not None and signal.name in ("crc", "counter"):
            continue
        column = values.get(signal.name)
        if signal.is_float or signal.length > 52:
            if column is None:
                continue
            raise LogError(
                f"{signal.name}: its {signal.length} bits in {message.layout.name} cannot be written; allowed: 52-bit "
                f"integers"
            )
        low, high = (
            (-(1 << signal.length - 1), (1 << signal.length - 1) - 1)
            if signal.is_signed
            else (0, (1 << signal.length) - 1)
        )
        none = message.missing.get(signal.name, 0)
        if column is None:
            raw = np.full(n, none, np.int64)
        else:
            exact = (column - float(signal.offset)) / float(signal.scale)
            scaled = np.rint(exact)
            with np.errstate(invalid="ignore"):
                bad = (scaled < low) | (scaled > high) | ((scaled == none) & (signal.name in message.missing))
            if bad.any():
                a, b = sorted(
                    (
                        low * float(signal.scale) + float(signal.offset),
                        high * float(signal.scale) + float(signal.offset),
                    )
                )
                raise LogError(
                    f"{signal.name} (={column[np.argmax(bad)]:g} {signal.unit or ''}): does not fit "
                    f"{message.layout.name}, which holds {a:g} to {b:g}; a table format (.csv, .parquet) holds any "
                    "value"
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
