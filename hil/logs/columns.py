"""Signals and CRCs of whole columns of eight-byte frames, compiled: one pass over the frames for each signal."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vaneloop.base.compiled import in_place, is_cached

__all__ = ["cut", "warm_up", "wrong_crc"]


def warm_up(say: Callable[[str], None]) -> None:
    """Tell the user that reading the first CAN log compiles; silent when the compiled code is there already."""
    if not is_cached(cut):
        say("compiling the reader of CAN logs for this machine (once, about 3 s) ...")


@in_place
def cut(
    words: np.ndarray,
    rows: np.ndarray,
    length: np.ndarray,
    need: int,
    big: bool,
    shift: int,
    bits: int,
    signed: bool,
    scale: float,
    offset: float,
    none: int,
    out_rows: np.ndarray,
    out: np.ndarray,
) -> tuple[int, int]:
    """Cut one integer signal out of frames; return how many values there are and how many said "not available".

    words     uint64[n] the frames' bytes, the first lowest; rows int64[m] the frames to look at; length uint8[n] their
              bytes of data
    need      bytes that a frame must have to carry the signal
    big       the bytes count from the other end: ``shift`` is then that of the swapped word
    none      raw value that means not available; outside the signal's range where there is none
    out_rows  int64[m], out float64[m]: the frames that have a value, and raw * scale + offset
    """
    mask = np.uint64(0xFFFFFFFFFFFFFFFF) >> np.uint64(64 - bits)
    half = np.int64(1) << np.int64(bits - 1)
    n, missing = 0, 0
    for i in range(rows.shape[0]):
        r = rows[i]
        if length[r] < need:
            continue
        w = words[r]
        if big:
            w = ((w >> np.uint64(8)) & np.uint64(0x00FF00FF00FF00FF)) | (
                (w & np.uint64(0x00FF00FF00FF00FF)) << np.uint64(8)
            )
            w = ((w >> np.uint64(16)) & np.uint64(0x0000FFFF0000FFFF)) | (
                (w & np.uint64(0x0000FFFF0000FFFF)) << np.uint64(16)
            )
            w = (w >> np.uint64(32)) | (w << np.uint64(32))
        raw = np.int64((w >> np.uint64(shift)) & mask)
        if signed and raw >= half:
            raw = raw - half - half
        if raw == none:
            missing += 1
            continue
        out_rows[n] = r
        out[n] = raw * scale + offset
        n += 1
    return n, missing


@in_place
def wrong_crc(words: np.ndarray, rows: np.ndarray, table: np.ndarray, start: int, wrong: np.ndarray) -> None:
    """Mark in ``wrong`` (bool[m]) the frames whose first byte is not the CRC of the others; ``start`` is the CRC of the
    DataID.
    """
    for i in range(rows.shape[0]):
        w = words[rows[i]]
        c = np.int64(start)
        for k in range(1, 8):
            c = np.int64(table[c ^ np.int64((w >> np.uint64(8 * k)) & np.uint64(0xFF))])
        wrong[i] = c != np.int64(w & np.uint64(0xFF))
