"""Measurement lists of XCP (DAQ): which bytes go into which frames, and when; gathered by compiled code.

A list has tables (ODT), one frame each: identifier of the table (1 byte), in the first one the time in ms modulo
65,536 (2 bytes, little-endian), then the bytes of its entries. Lists run with an event, every 1 ms or every 10 ms, and
are sampled after the firmware's tick, all in one piece. The time is that of the tick: simulated time.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from hil.calibrate.errors import ACTIVE, CONFIG, FULL, MODE, RANGE, SEQUENCE, Refusal
from hil.calibrate.memory import Memory
from hil.calibrate.stim import Stimulus
from vaneloop.base.compiled import in_place

__all__ = ["EVENTS", "STIM", "Daq"]

EVENTS = (("1 ms", 1), ("10 ms", 10))  # name, period in ticks; the event's number is its place
PAYLOAD, STAMP = 7, 2  # bytes of a frame behind the table's identifier; of them the time's in a list's first table
MEASURED, STIM = 0x10, 0x02  # modes of a list: measured with a time, or given without
MOST_LISTS, MOST_TABLES, MOST_ENTRIES = 16, 64, 7
MOST_FRAMES = 32  # of one tick; what is beyond is an overload: the bus carries some four


class Entry(NamedTuple):
    """Bytes to measure: how the tool names them, and which of `Memory.raw` has them from where on."""

    size: int
    ext: int
    address: int
    array: int
    offset: int


@dataclass
class DaqList:
    """One list: its tables, and with which event it runs."""

    tables: list[list[Entry | None]] = field(default_factory=list)
    event: int = -1
    prescaler: int = 1
    priority: int = 0
    selected: bool = False
    running: bool = False
    stim: bool = False
    raw: list[bytes] = field(default_factory=list)
    inputs: list[list[int]] = field(default_factory=list)
    first_pid: int = 0
    plan: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), np.int64))
    heads: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))


@in_place
def gather(raw: tuple[np.ndarray, ...], plan: np.ndarray, out: np.ndarray, first: int) -> None:
    """Put bytes of memory into frames: row of ``plan`` = frame, bit, array, offset."""
    for q in range(plan.shape[0]):
        out[first + plan[q, 0], 1] |= np.int64(raw[plan[q, 2]][plan[q, 3]]) << plan[q, 1]


class Daq:
    """The measurement lists of one slave.

    overloads  lists left out because a tick would have had too many frames
    """

    def __init__(self, memory: Memory, ident: int):
        self.memory, self.ident = memory, ident
        self.lists: list[DaqList] = []
        self.step = 0  # 0 free, 1 lists, 2 tables, 3 entries allocated: the order is prescribed
        self.pointer: tuple[int, int, int] | None = None
        self.overloads = 0
        self.stimulus = Stimulus(memory.node)
        self._running: list[DaqList] = []
        self._used: set[int] = set()
        self._out = np.zeros((MOST_FRAMES, 2), np.int64)

    # ---- allocation --------------------------------------------------------------------------------------------------

    def free(self) -> None:
        """Stop and forget all lists."""
        self.stimulus.clear()
        self.lists, self._running, self.step, self.pointer = [], [], 1, None

    def allocate_lists(self, n: int) -> None:
        """Make room for ``n`` lists."""
        self._in_order(1, 1)
        if n > MOST_LISTS:
            raise Refusal(FULL, f"lists (={n}) must be at most {MOST_LISTS}")
        self.lists, self.step = [DaqList() for _ in range(n)], 2

    def allocate_tables(self, at: int, n: int) -> None:
        """Make room for ``n`` tables of a list."""
        self._in_order(2, 3)
        own = self._list(at)
        if sum(len(of.tables) for of in self.lists) + n > MOST_TABLES:
            raise Refusal(FULL, f"tables must be at most {MOST_TABLES}")
        own.tables += [[] for _ in range(n)]
        self.step = 3

    def allocate_entries(self, at: int, table: int, n: int) -> None:
        """Make room for ``n`` entries of a table."""
        self._in_order(3, 4)
        tables = self._list(at).tables
        if table >= len(tables):
            raise Refusal(RANGE, f"table (={table}) must be below {len(tables)}")
        if len(tables[table]) + n > MOST_ENTRIES:
            raise Refusal(FULL, f"entries must be at most {MOST_ENTRIES}")
        tables[table] += [None] * n
        self.step = 4

    def _in_order(self, low: int, high: int) -> None:
        if self.running:
            raise Refusal(ACTIVE, "a list runs")
        if not low <= self.step <= high:
            raise Refusal(SEQUENCE, "the order is FREE_DAQ, ALLOC_DAQ, ALLOC_ODT, ALLOC_ODT_ENTRY")

    def _list(self, at: int) -> DaqList:
        if not 0 <= at < len(self.lists):
            raise Refusal(RANGE, f"list (={at}) must be below {len(self.lists)}")
        return self.lists[at]

    # ---- what is measured --------------------------------------------------------------------------------------------

    def point(self, at: int, table: int, entry: int) -> None:
        """Set the pointer to an entry that exists."""
        own = self._list(at)
        tables = own.tables
        if own.running:
            raise Refusal(ACTIVE, "the list runs")
        if table >= len(tables) or entry >= len(tables[table]):
            raise Refusal(RANGE, f"list {at} has no entry {entry} of table {table}")
        self.pointer = at, table, entry

    def write(self, bit: int, size: int, ext: int, address: int) -> None:
        """Say what the entry under the pointer is, and move on to the next."""
        if self.pointer is None:
            raise Refusal(SEQUENCE, "SET_DAQ_PTR comes first")
        at, table, entry = self.pointer
        own = self._list(at)
        if own.running:
            raise Refusal(ACTIVE, "the list runs")
        entries = own.tables[table]
        if entry >= len(entries):
            raise Refusal(RANGE, f"table {table} has {len(entries)} entries")
        room = PAYLOAD - (STAMP if table == 0 else 0)
        taken = sum(e.size for i, e in enumerate(entries) if e is not None and i != entry)
        where = self.memory.place(ext, address, size)
        if bit != 0xFF or not 1 <= size <= room - taken or where is None:
            raise Refusal(RANGE, f"{size} bytes at {address:#x} (extension {ext}) cannot be measured here")
        if own.stim:
            self.stimulus.number(size, ext, address)
        entries[entry] = Entry(size, ext, address, *where)
        self.pointer = at, table, entry + 1

    def look(self) -> tuple[int, int, int]:
        """Return size, extension and address of the entry under the pointer, and move on."""
        if self.pointer is None:
            raise Refusal(SEQUENCE, "SET_DAQ_PTR comes first")
        at, table, entry = self.pointer
        entries = self._list(at).tables[table]
        if entry >= len(entries):
            raise Refusal(RANGE, f"table {table} has {len(entries)} entries")
        self.pointer = at, table, entry + 1
        found = entries[entry]
        return found[:3] if found else (0, 0, 0)

    def clear(self, at: int) -> None:
        """Stop a list and forget what its entries are."""
        own = self._list(at)
        self._stop(own)
        self._order()
        own.tables = [[None] * len(t) for t in own.tables]

    # ---- running -----------------------------------------------------------------------------------------------------

    def mode(self, at: int, mode: int, event: int, prescaler: int, priority: int) -> None:
        """Say with which event a list runs."""
        own = self._list(at)
        if own.running:
            raise Refusal(ACTIVE, "the list runs")
        if mode not in (MEASURED, STIM):  # not alternating, with identifiers
            raise Refusal(MODE, f"mode (={mode:#x}) must be 0x10, or 0x02 for STIM")
        if event >= len(EVENTS) or prescaler < 1:
            raise Refusal(RANGE, f"event (={event}) must be below {len(EVENTS)}, prescaler (={prescaler}) 1 or more")
        if mode == STIM:
            for e in (e for t in own.tables for e in t if e is not None):
                self.stimulus.number(*e[:3])
        own.event, own.prescaler, own.priority, own.stim = event, prescaler, priority, mode == STIM

    def mode_of(self, at: int) -> tuple[int, int, int, int]:
        """Return mode, event, prescaler and priority of a list."""
        own = self._list(at)
        mode = (STIM if own.stim else MEASURED) | own.selected | own.running << 6
        return mode, max(own.event, 0), own.prescaler, own.priority

    def start_list(self, what: int, at: int) -> int:
        """Stop (0), start (1) or select (2) a list; return the identifier of its first table."""
        own = self._list(at)
        if what == 0:
            self._stop(own)
        elif what == 1:
            self._compile(own)
            own.running = True
        elif what == 2:
            self._compile(own)
            own.selected = True
        else:
            raise Refusal(MODE, f"mode (={what}) must be 0, 1 or 2")
        self._order()
        return own.first_pid

    def start_selected(self, what: int) -> None:
        """Stop all lists (0), start (1) or stop (2) those that are selected."""
        if what not in (0, 1, 2):
            raise Refusal(MODE, f"mode (={what}) must be 0, 1 or 2")
        chosen = [of for of in self.lists if what == 0 or of.selected]
        if what == 1:
            for own in chosen:
                self._compile(own)
        for own in chosen:
            if what == 1:
                own.running, own.selected = True, False
            else:
                self._stop(own)
        self._order()

    def _compile(self, own: DaqList) -> None:
        """Work out which byte goes where. Raises Refusal for a list that is not complete."""
        if own.event < 0 or not own.tables or any(e is None for t in own.tables for e in t):
            raise Refusal(CONFIG, "the list has no event, no tables or entries that were not written")
        before = takewhile(lambda of: of is not own, self.lists)
        own.first_pid = pid = sum(len(of.tables) for of in before)
        if own.stim:
            own.raw = [b""] * len(own.tables)
            own.inputs = [[self.stimulus.number(*e[:3]) for e in t if e is not None] for t in own.tables]
            return
        rows = np.array([(q, *e) for q, t in enumerate(own.tables) for e in t if e is not None], np.int64).reshape(
            -1, 6
        )
        row, size = rows[:, 0], rows[:, 1]
        begin = np.cumsum(size) - size  # of each entry, counted through all bytes of the list
        each = np.repeat(np.arange(len(rows)), size)  # the entry of each byte
        byte = np.arange(len(each))
        used = np.bincount(row, size, len(own.tables)).astype(np.int64)
        head = np.where(np.arange(len(own.tables)) == 0, 1 + STAMP, 1)  # bytes before the entries
        place = byte + (head - np.cumsum(used) + used)[row[each]]
        own.plan = np.stack([row[each], 8 * place, rows[each, 4], rows[each, 5] + byte - begin[each]], axis=1)
        own.heads = np.stack([self.ident | (head + used) << 32, pid + np.arange(len(used))], axis=1)

    def _stop(self, own: DaqList) -> None:
        if own.stim and own.running:
            self.stimulus.clear()
        own.running = own.selected = False

    def _order(self) -> None:
        self._running = sorted((of for of in self.lists if of.running and not of.stim), key=lambda of: -of.priority)
        self._used = set(np.concatenate([of.plan[:, 2] for of in self._running]).tolist()) if self._running else set()

    @property
    def running(self) -> bool:
        """Whether a list runs."""
        return any(of.running for of in self.lists)

    def stimulate(self, k: int, data: bytes) -> None:
        """Take a frame of a STIM list; with its last one the inputs are given, from tick ``k`` on."""
        for own in self.lists:
            at = data[0] - own.first_pid
            if own.stim and own.running and 0 <= at < len(own.inputs):
                own.raw[at] = data[1:]
                if at == len(own.inputs) - 1:
                    values: dict[int, float] = {}
                    for numbers, raw in zip(own.inputs, own.raw, strict=True):
                        if len(raw) < 4 * len(numbers):
                            return
                        for i, number in enumerate(numbers):
                            values[number] = struct.unpack_from("<f", raw, 4 * i)[0]
                    own.raw = [b""] * len(own.inputs)
                    self.stimulus.give(k, values)
                return

    def sample(self, k: int) -> np.ndarray:
        """Return the frames (int64[n, 2]) of tick ``k``, whose numbers are in memory now."""
        out, n = self._out, 0
        for own in self._running:
            period = EVENTS[own.event][1] * own.prescaler
            if k % period:
                continue
            m = len(own.heads)
            if n + m > MOST_FRAMES:
                self.overloads += 1
                continue
            if n == 0:
                self.memory.refresh(self._used)
            out[n : n + m] = own.heads
            out[n, 1] |= (k & 0xFFFF) << 8
            gather(self.memory.raw, own.plan, out, n)
            n += m
        return out[:n]
