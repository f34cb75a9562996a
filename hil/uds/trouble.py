"""Memory of trouble codes: the firmware's faults with ISO 14229's status byte, counters and freeze frames.

An operation cycle lasts from power-on, or a reset, to the next one. The firmware debounces its faults itself, so a
fault bit that stands is a failed test. A fault is confirmed with the first or the second cycle in which it failed
(`CODES`); a confirmed one ages away after `AGE` cycles that completed the test without failing.
"""

from __future__ import annotations

import base64
import binascii
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from controller import FAULTS
from controller.records import DEGRADED, INIT, RUN, SERVO_MASK
from vaneloop.base.errors import InputError

__all__ = ["ALL", "CODES", "MASK", "Code", "TroubleMemory"]

FAILED, THIS_CYCLE, PENDING, CONFIRMED, NOT_SINCE_CLEAR, SINCE_CLEAR, NOT_THIS_CYCLE = (1 << b for b in range(7))
MASK = 0x7F  # of the status byte; there is no lamp
NEW = NOT_SINCE_CLEAR | NOT_THIS_CYCLE
ALL = 0xFFFFFF
AGE = 40
MOST_BYTES = 1 << 16  # of the file


class Code(NamedTuple):
    """A trouble code: number (its last byte is the type of failure of ISO 15031-6), cycles until it is confirmed."""

    number: int
    confirm: int


CODES = {
    "demand_stale": Code(0x1A0187, 2),  # missing message
    "demand_rejected": Code(0x1A0282, 2),  # alive counter or CRC
    "lvdt_range": Code(0x1A0322, 1),  # amplitude beyond its limits
    "lvdt_rate": Code(0x1A0427, 1),  # rate of change above its limit
    "lvdt_stuck": Code(0x1A052A, 1),  # stuck in range
    "tracking": Code(0x1A0677, 2),  # commanded position not reachable
    "current_saturated": Code(0x1A0719, 2),  # current above its limit
    "demand_range": Code(0x1A0864, 2),  # not plausible
    "paused": Code(0x1A0947, 1),  # watchdog
}
assert tuple(CODES) == FAULTS


@dataclass
class Entry:
    """What is known of one fault.

    failures  times that it began;  trips  cycles in which it failed, up to its confirmation;  age  cycles since
    first, last  freeze frames of its first and its latest begin (bytes), empty: none
    """

    status: int = NEW
    failures: int = 0
    trips: int = 0
    age: int = 0
    first: bytes = b""
    last: bytes = b""


@dataclass
class TroubleMemory:
    """Entries of all faults, in the order of their bits.

    on       False: nothing is entered (0x85)
    changed  set with every change; whoever stores the memory resets it
    wrong_keys  wrong keys in a row (0x27): a restart does not forgive them
    """

    entries: list[Entry] = field(default_factory=lambda: [Entry() for _ in CODES])
    on: bool = True
    changed: bool = False
    texts: dict[str, str] = field(default_factory=dict)  # what a tool has written (0x2E), by identifier
    wrong_keys: int = 0
    _before: int = 0
    _tested: int = 0

    def look(self, mode: int, faults: int, frame: Any) -> None:
        """Take over the fault bits of a tick; ``frame()`` gives the signals at this moment, for a fault that begins."""
        tested = 0 if mode == INIT else (1 << len(FAULTS)) - 1
        if mode not in (RUN, DEGRADED):
            tested &= ~(SERVO_MASK | 1 << FAULTS.index("lvdt_stuck"))
        tested |= faults
        if not self.on or (faults == self._before and not tested & ~self._tested):
            return
        for bit, (entry, code) in enumerate(zip(self.entries, CODES.values(), strict=True)):
            one = 1 << bit
            if tested & one:
                entry.status &= ~NEW
            if not faults & one:
                entry.status &= ~FAILED
                continue
            if self._before & one and entry.status & FAILED:
                continue
            if not entry.status & THIS_CYCLE:
                entry.trips = min(entry.trips + 1, 255)
            entry.status |= FAILED | THIS_CYCLE | PENDING | SINCE_CLEAR
            entry.failures, entry.age = min(entry.failures + 1, 255), 0
            if entry.trips >= code.confirm:
                entry.status |= CONFIRMED
            entry.last = frame()
            entry.first = entry.first or entry.last
        self._before, self._tested, self.changed = faults, self._tested | tested, True

    def new_cycle(self) -> None:
        """End an operation cycle and begin the next: what did not fail is no longer pending, and ages."""
        for entry in self.entries:
            done, failed = not entry.status & NOT_THIS_CYCLE, entry.status & THIS_CYCLE
            if done and not failed:
                entry.status &= ~PENDING
                if not entry.status & CONFIRMED:
                    entry.trips = 0
                elif (age := entry.age + 1) >= AGE:
                    entry.status &= ~CONFIRMED
                    entry.age = entry.trips = 0
                    entry.first = entry.last = b""
                else:
                    entry.age = age
            entry.status = (entry.status & ~(FAILED | THIS_CYCLE)) | NOT_THIS_CYCLE
        self._before = self._tested = 0
        self.changed = True

    def count_keys(self, wrong: int) -> None:
        """Keep how many wrong keys there were in a row."""
        self.changed |= wrong != self.wrong_keys
        self.wrong_keys = wrong

    def clear(self, number: int) -> bool:
        """Forget one trouble code, or all with `ALL`; False where there is no such code."""
        numbers = [c.number for c in CODES.values()]
        if number != ALL and number not in numbers:
            return False
        for i, one in enumerate(numbers):
            if number in (ALL, one):
                self.entries[i] = Entry()
                self._before &= ~(1 << i)  # one that still stands begins anew
                self._tested &= ~(1 << i)
        self.changed = True
        return True

    def by_mask(self, mask: int) -> list[tuple[int, int]]:
        """Return number and status of the codes of which a bit of ``mask`` is set."""
        pairs = zip(CODES.values(), self.entries, strict=True)
        return [(c.number, e.status) for c, e in pairs if e.status & mask & MASK]

    def entry(self, number: int) -> Entry | None:
        """Return the entry of a trouble code."""
        return next((e for c, e in zip(CODES.values(), self.entries, strict=True) if c.number == number), None)

    # ---- kept over a restart -----------------------------------------------------------------------------------------

    def dump(self) -> str:
        """The memory as JSON."""
        rows = [
            {
                "code": f"{c.number:06X}", "fault": name, "status": e.status, "failures": e.failures, "trips": e.trips,
                "age": e.age, "first": base64.b64encode(e.first).decode(), "last": base64.b64encode(e.last).decode(),
            }
            for (name, c), e in zip(CODES.items(), self.entries, strict=True)
        ]  # fmt: skip
        kept = {"schema": 1, "codes": rows, "texts": self.texts, "wrong_keys": self.wrong_keys}
        return json.dumps(kept, indent=1) + "\n"

    @classmethod
    def load(cls, file: Path) -> TroubleMemory:
        """Read a memory that was stored, and begin an operation cycle; an empty one where there is no file.

        Raises InputError, in one line, for a file that is none.
        """
        out = cls()
        if not file.exists():
            return out
        try:
            raw = file.read_bytes()
            if len(raw) > MOST_BYTES:
                raise ValueError(f"more than {MOST_BYTES} bytes")
            data = json.loads(raw)
            rows = {str(row["fault"]): row for row in data["codes"]}
            for i, name in enumerate(CODES):
                row = rows[name]
                numbers = [int(row[key]) for key in ("status", "failures", "trips", "age")]
                if not all(0 <= n <= 255 for n in numbers):
                    raise ValueError(f"{name} has a number beyond 255")
                first, last = (base64.b64decode(row[key], validate=True) for key in ("first", "last"))
                if max(len(first), len(last)) > 255:
                    raise ValueError(f"{name} has a freeze frame of more than 255 bytes")
                status, failures, trips, age = numbers
                out.entries[i] = Entry(status, failures, trips, age, first, last)
            out.wrong_keys = int(data.get("wrong_keys", 0))
            if not 0 <= out.wrong_keys <= 255:
                raise ValueError("wrong_keys is beyond 255")
            out.texts = {str(k)[:4]: str(v)[:32] for k, v in data["texts"].items()}
        except OSError as e:
            raise InputError(f"{file}: cannot be read ({e.strerror})") from None
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError, binascii.Error) as e:
            raise InputError(f"{file}: is no memory of trouble codes ({type(e).__name__}: {e})"[:200]) from None
        out.new_cycle()
        return out
