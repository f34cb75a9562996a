"""The firmware's memory as a calibration tool sees it: a view of the arrays that the tick works on.

Addresses are of 32 bits; every number is a double, little-endian::

    0x1000_0000  inputs of the last tick      read only
    0x1100_0000  outputs of the last tick     read only
    0x1200_0000  state after the last tick    read only
    0x2000_0000  the calibration (`hil.calibrate.elements`): segment 0 with two pages

Address extension 1 shows the same numbers in single precision, number i at 4 i instead of 8 i: classic CAN carries one
of them in a frame. Page 0 is the working page, page 1 the reference page, the calibration as it was loaded.

A write is kept back until all bytes of a number are there, then it is checked and takes effect whole. Whoever writes
calls between two ticks. What takes longer than a tick may is a `hil.calibrate.prepare.Task`, for the `desk`.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from controller.records import INIT, INPUT_FIELDS, OUTPUT_FIELDS, STANDBY, STATE_FIELDS, Field
from hil.calibrate import elements
from hil.calibrate.errors import DENIED, NO_PAGE, PROTECTED, RANGE, Refusal
from hil.calibrate.prepare import AtOnce, Desk, Task
from hil.loop.node import Node
from hil.native.program import own_scalars
from vaneloop.base.errors import InputError

__all__ = ["CALIBRATION", "EXACT", "INPUTS", "SHORT", "Memory", "Refusal", "Signal"]

INPUTS, OUTPUTS, STATE, CALIBRATION = 0x1000_0000, 0x1100_0000, 0x1200_0000, 0x2000_0000
EXACT, SHORT = 0, 1  # address extensions: double, single precision
WORKING, REFERENCE = 0, 1


class Signal(NamedTuple):
    """A number that may be measured: its address (extension 0) and what it is."""

    name: str
    unit: str
    meaning: str
    address: int


class Area(NamedTuple):
    """Numbers side by side in memory: ``exact`` are the firmware's own, ``short`` a copy in single precision."""

    base: int
    exact: np.ndarray
    short: np.ndarray


class Memory:
    """Memory of one running node.

    node, loop  the node, and its loop
    elements  what each number of the calibration is (`hil.calibrate.elements.Element`)
    pages     float64[n] working page and reference page
    ecu_page, xcp_page  the page that the firmware uses, and the one that the tool sees
    desk      has done what takes longer than a tick may
    """

    def __init__(self, node: Node):
        if node.loop.pair:
            raise InputError(
                "calibration: channels.number (=2) must be 1 for calibration and service tools (docs/channels.md)"
            )
        # the tables may be another node's too: what is changed here is this node's own
        built = node.loop.built._replace(
            **{key: getattr(node.loop.built, key).copy() for key in ("k", "table", "angles")}
        )
        node.loop = loop = node.loop._replace(built=built)
        node.arrays = node.arrays._replace(loop=loop)
        self.node, self.loop = node, loop
        own = own_scalars(loop.foreign)
        self._own = [o["value"] for o in own.values()]
        self.elements = elements.elements_of(loop.calibration, own)
        self._guarded = np.array([e.guarded for e in self.elements])
        self.curves = elements.curves_of(loop.calibration)
        self.desk = Desk(AtOnce(self.elements))
        live = self.live()
        self.pages = [live.copy(), live.copy()]
        self.ecu_page = self.xcp_page = WORKING
        self._places: list[tuple[Any, ...]] = []
        self._half: dict[int, tuple[bytearray, int]] = {}
        spans = [(INPUTS, loop.inputs), (OUTPUTS, loop.outputs), (STATE, loop.z)]
        first = 0
        for key in ("k", "table", "angles"):
            built, flashed = (getattr(of, key).ravel() for of in (loop.built, loop.calibration))
            self._places.append((first, built, flashed))
            spans.append((CALIBRATION + 8 * first, flashed))
            first += len(built)
        self._places += [(first + i, value) for i, value in enumerate(self._own)]
        if own:
            spans.append((CALIBRATION + 8 * first, np.zeros(len(own))))
        self.areas = [Area(base, a, np.zeros(len(a), np.float32)) for base, a in spans]
        self.raw = tuple(a.exact.view(np.uint8) for a in self.areas) + tuple(a.short.view(np.uint8) for a in self.areas)
        self.refresh()

    @property
    def signals(self) -> list[Signal]:
        """What may be measured: inputs, outputs, and the state that this machine has."""
        out = []
        rows = {STATE: set(self.loop.z_rows.tolist())}
        for base, prefix, fields in (
            (INPUTS, "input", INPUT_FIELDS),
            (OUTPUTS, "output", OUTPUT_FIELDS),
            (STATE, "state", STATE_FIELDS),
        ):
            names: list[tuple[str, Field]] = [(n, f) for f in fields for n in (f.each or (f.name,))]
            out += [
                Signal(f"{prefix}_{name}", f.unit, f.meaning, base + 8 * i)
                for i, (name, f) in enumerate(names)
                if base not in rows or i in rows[base]
            ]
        return out

    def live(self) -> np.ndarray:
        """The calibration that the next tick uses, one row."""
        cal = self.loop.calibration
        return np.concatenate([cal.k, cal.table.ravel(), cal.angles.ravel(), *self._own])

    def refresh(self, used: Collection[int] | None = None) -> None:
        """Bring copies up to date: single precision, and the scalars of a controller's own.

        used  which of ``raw`` will be read; None: all
        """
        n = len(self.areas)
        if self._own:
            np.concatenate(self._own, out=self.areas[-1].exact)
        short = range(n) if used is None else [i - n for i in used if i >= n]
        if short:
            with np.errstate(over="ignore", invalid="ignore"):
                for i in short:
                    self.areas[i].short[:] = self.areas[i].exact

    # ---- reading -----------------------------------------------------------------------------------------------------

    def place(self, ext: int, address: int, size: int) -> tuple[int, int] | None:
        """Return which of ``raw`` holds these bytes and from where on; None where that is not one array of it."""
        if ext not in (EXACT, SHORT) or size < 1:
            return None
        width = 4 if ext == SHORT else 8
        for i, a in enumerate(self.areas):
            base = (a.base & ~0xFFFFFF) + (a.base & 0xFFFFFF) * width // 8
            if base <= address and address + size <= base + width * len(a.exact):
                return i + (len(self.areas) if ext == SHORT else 0), address - base
        return None

    def read(self, ext: int, address: int, size: int) -> bytes:
        """Return ``size`` bytes; of the calibration those of the page that the tool sees. Raises `Refusal`."""
        kind = np.float32 if ext == SHORT else np.float64
        base = address & ~0xFFFFFF
        if ext not in (EXACT, SHORT):
            raise Refusal(RANGE, f"address extension (={ext}) must be 0 or 1")
        if base == CALIBRATION:
            row = self.live() if self.xcp_page == self.ecu_page else self.pages[self.xcp_page]
        else:
            row = next((a.exact for a in self.areas if a.base == base), np.empty(0))
        with np.errstate(over="ignore", invalid="ignore"):
            image = row.astype(kind).tobytes()
        at = address - base
        if at + size > len(image):
            raise Refusal(RANGE, f"no memory from {address:#x} to {address + size:#x}")
        return image[at : at + size]

    # ---- writing -----------------------------------------------------------------------------------------------------

    def forget(self) -> None:
        """Drop the numbers of which not all bytes have come."""
        self._half.clear()

    def write(self, ext: int, address: int, data: bytes) -> Task | None:
        """Write bytes into the working page; numbers that are complete take effect together. Raises `Refusal`, and then
        nothing has changed.
        """
        n, width = len(self.elements), 4 if ext == SHORT else 8
        first = address - CALIBRATION
        if ext not in (EXACT, SHORT) or first < 0 or first + len(data) > width * n:
            known = address & ~0xFFFFFF in (INPUTS, OUTPUTS, STATE)
            raise Refusal(DENIED if known else RANGE, f"{address:#x} must be in the calibration")
        if self.xcp_page != WORKING:
            raise Refusal(PROTECTED, "the reference page cannot be written")
        half: dict[int, tuple[bytearray, int]] = {}  # what these bytes leave incomplete
        values: dict[int, float] = {}
        for i, byte in enumerate(data, first):
            number, at = divmod(i, width)
            key = 2 * number + ext
            kept, mask = half.get(key) or self._half.get(key, (bytearray(width), 0))
            raw = bytearray(kept)
            raw[at] = byte
            mask |= 1 << at
            half[key] = raw, mask
            if mask == (1 << width) - 1:
                del half[key]
                values[number] = float(np.frombuffer(bytes(raw), np.float32 if ext == SHORT else np.float64)[0])
        forgotten = [2 * number + ext for number in values]

        def finish(result: Any) -> None:
            for key in forgotten:
                self._half.pop(key, None)
            if task is not None:
                task.finish(result)
            self._half |= half

        try:
            task = self.change(values)
        except Refusal:
            for key in forgotten:
                self._half.pop(key, None)
            raise
        if task is not None:
            return task._replace(finish=finish)
        finish(None)
        return None

    def change(self, values: dict[int, float], *, judged: bool = False) -> Task | None:
        """Give numbers of the working page other values, all or none: now, or with the task returned. Raises `Refusal`.

        judged  they are of a whole table that has been read
        """
        page = self.pages[WORKING]
        active = self.ecu_page == WORKING
        now = self.live() if active else page
        new = {i: v for i, v in values.items() if not _same(float(now[i]), v)}
        for i, v in new.items():
            e = self.elements[i]
            if not (math.isfinite(v) and e.low <= v <= e.high) or (e.whole and v != math.floor(v)):
                raise Refusal(RANGE, f"{e.name} (={v:g} {e.unit}) must be in [{e.low:g}, {e.high:g}]")
            if e.fixed:
                raise Refusal(PROTECTED, f"{e.name} belongs to the machine")
            if e.name == "current_limit" and v > self.pages[REFERENCE][i]:
                raise Refusal(RANGE, f"current_limit (={v:g} A) must not exceed the reference page's")
        numbers = np.array(list(new), np.int64)
        row = now.copy()
        row[numbers] = list(new.values())

        def finish(why: str = "") -> None:
            if active:
                self._accept(row, numbers, why)
            page[numbers] = row[numbers]

        if active:
            self._allowed(numbers)
        tables = tuple(sorted({self.elements[i].table for i in new} - {""}))
        if active and tables and not judged:
            return Task("judge", (row, tables), finish)
        finish()
        return None

    def _allowed(self, numbers: np.ndarray) -> None:
        """Refuse numbers that must not be changed while the loop is closed. Raises `Refusal`."""
        if int(self.loop.given.mode) in (INIT, STANDBY):
            return
        guarded = numbers[self._guarded[numbers]]
        if len(guarded):
            raise Refusal(PROTECTED, f"{self.elements[guarded[0]].name} may be changed in INIT and STANDBY only")

    def _accept(self, row: np.ndarray, numbers: np.ndarray, why: str) -> None:
        """Put numbers of a row into the firmware, unless there is a reason why not or the loop has been closed. Raises
        `Refusal`.
        """
        if why:
            raise Refusal(RANGE, why)
        self._allowed(numbers)
        self._load(row, numbers)

    def _load(self, row: np.ndarray, numbers: np.ndarray) -> None:
        """Put numbers of a row into the arrays that the firmware reads, and into what an injected effect starts
        from.
        """
        for first, *places in self._places:
            mine = numbers[(numbers >= first) & (numbers < first + len(places[0]))]
            for to in places:
                to[mine - first] = row[mine]

    # ---- pages -------------------------------------------------------------------------------------------------------

    def use(self, page: int, *, ecu: bool, xcp: bool) -> Task | None:
        """Choose the page that the firmware uses, the one that the tool sees, or both: now, or with the task returned.
        Raises `Refusal`.
        """
        if page not in (WORKING, REFERENCE):
            raise Refusal(NO_PAGE, f"page (={page}) must be 0 or 1")
        row = self.pages[page].copy()
        switched = ecu and page != self.ecu_page

        def finish(why: str = "") -> None:
            if switched:
                self._accept(row, np.flatnonzero(row != self.live()), why)
                self.ecu_page = page
            if xcp:
                self.xcp_page = page
                self.forget()

        if switched:
            self._allowed(np.flatnonzero(row != self.live()))
            return Task("judge", (row, tuple(sorted({e.table for e in self.elements} - {""}))), finish)
        finish()
        return None

    def copy(self, source: int, target: int) -> Task | None:
        """Copy the reference page over the working page, whole: now, or with the task returned. Raises `Refusal`."""
        if (source, target) != (REFERENCE, WORKING):
            raise Refusal(PROTECTED if target == REFERENCE else NO_PAGE, "only page 1 can be copied to page 0")
        now = self.live() if self.ecu_page == WORKING else self.pages[WORKING]
        other = np.flatnonzero(self.pages[REFERENCE] != now)
        return self.change({int(i): float(self.pages[REFERENCE][i]) for i in other})

    def save(self, folder: Path) -> Task:
        """The task that writes the working page, as it is now, as tables that ``--tables`` takes."""

        def finish(result: tuple[int, str]) -> None:
            if result[0]:
                raise Refusal(*result)

        return Task("save", (self.pages[WORKING].copy(), folder), finish)

    def by_name(self) -> dict[str, int]:
        """Number of each element, by name."""
        return {e.name: i for i, e in enumerate(self.elements)}


def _same(a: float, b: float) -> bool:
    return a == b or (a != a and b != b)
