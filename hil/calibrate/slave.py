"""An XCP slave (ASAM MCD-1 XCP 1.x) as a pure machine: a command's bytes in, the answers' bytes out.

It has no clock and no bus. Commands are given between two ticks, so what they change takes effect whole, and what they
read is what the last tick used. The answer to a command whose check takes longer than a tick comes later
(`Slave.late`); while it waits, `Slave.waiting`, no other command may be given. Numbers are little-endian, addresses
count bytes (docs/xcp.md has every command).
"""

from __future__ import annotations

import hashlib
import hmac
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hil.calibrate.daq import EVENTS, PAYLOAD, STAMP, STIM, Daq
from hil.calibrate.errors import (
    DENIED,
    LOCKED,
    MODE,
    NO_PAGE,
    PROTECTED,
    RANGE,
    SEGMENT,
    SEQUENCE,
    SYNCH,
    SYNTAX,
    UNKNOWN,
    Refusal,
)
from hil.calibrate.lock import Lock
from hil.calibrate.memory import CALIBRATION, EXACT, REFERENCE, WORKING, Memory
from hil.calibrate.prepare import Task

__all__ = ["NAME", "RESOURCES", "Slave", "key_of"]

NAME = "vgv"  # of the A2L file, without its ending
RESOURCES = {"cal": 0x01, "daq": 0x04, "stim": 0x08}  # what can be locked
OK, ERROR, EVENT = 0xFF, 0xFE, 0xFD
STORED, OVERLOADED = 0x03, 0x06  # events
STORE_CAL, DAQ_RUNS = 0x01, 0x40  # bits of the session's status
MOST_CHECKED = 1 << 20  # bytes of a checksum
SEED = 6  # bytes: seed and key fill one frame
MILLISECOND = 6  # code of the unit of times
AGAIN = 100  # ticks between two words about an overload that goes on


def key_of(resource: str, seed: bytes) -> bytes:
    """Return the key for a seed: the first six bytes of HMAC-SHA-256 with the secret ``vaneloop-`` and the resource."""
    return hmac.new(f"vaneloop-{resource}".encode(), seed, hashlib.sha256).digest()[:SEED]


class Slave:
    """The slave of one memory.

    memory   `hil.calibrate.memory.Memory`
    ident    CAN identifier of what it sends
    max_cto  bytes of a command or answer: 8 on classic CAN
    a2l      gives the text of the A2L file
    save     folder into which the working page is frozen; None: it cannot be
    locked   resources that need seed and key: of `RESOURCES`
    seed     number from which the lock's seeds follow; None: the system's entropy
    """

    def __init__(
        self,
        memory: Memory,
        *,
        ident: int = 0x6E1,
        max_cto: int = 8,
        a2l: Callable[[], str] | None = None,
        save: Path | None = None,
        locked: tuple[str, ...] = (),
        seed: int | None = None,
    ):
        self.memory, self.ident, self.max_cto, self.folder = memory, ident, max_cto, save
        self.daq = Daq(memory, ident)
        self.connected = False
        self.k = 0  # the next tick
        self.why = ""  # of the last refusal
        self._a2l = a2l
        self._lockable = sum(RESOURCES[name] for name in set(locked))
        self._locked: int
        self.lock = Lock("xcp", SEED, seed)
        self._seed: tuple[int, bytes] | None
        self._freeze: bool
        self._mta: tuple[bytes | None, int, int]  # a text of ours or memory: extension, address
        self.waiting = False  # for the result of a check
        self._late: list[bytes] = []
        self._told: int
        self._told_at = -AGAIN
        self._reset()
        self._commands: dict[int, tuple[Callable[[bytes], list[bytes] | None], int, str]] = {
            0xFE: (self._disconnect, 1, ""),
            0xFD: (self._status, 1, ""),
            0xFC: (self._synch, 1, ""),
            0xFB: (self._comm_mode, 1, ""),
            0xFA: (self._get_id, 2, ""),
            0xF9: (self._request, 4, "cal"),
            0xF8: (self._get_seed, 3, ""),
            0xF7: (self._unlock, 2, ""),
            0xF6: (self._set_mta, 8, ""),
            0xF5: (self._upload, 2, ""),
            0xF4: (self._short_upload, 8, ""),
            0xF3: (self._checksum, 8, ""),
            0xF0: (self._download, 3, "cal"),
            0xED: (self._short_download, 8, "cal"),
            0xEB: (self._set_page, 4, "cal"),
            0xEA: (self._get_page, 3, "cal"),
            0xE9: (self._page_processor, 1, "cal"),
            0xE8: (self._segment, 5, "cal"),
            0xE7: (self._page, 4, "cal"),
            0xE6: (self._set_segment_mode, 3, "cal"),
            0xE5: (self._segment_mode, 3, "cal"),
            0xE4: (self._copy, 5, "cal"),
            0xE3: (self._daq_clear, 4, "daq"),
            0xE2: (self._daq_pointer, 6, "daq"),
            0xE1: (self._daq_write, 8, "daq"),
            0xE0: (self._daq_mode, 8, "daq"),
            0xDF: (self._daq_mode_of, 4, "daq"),
            0xDE: (self._daq_start, 4, "daq"),
            0xDD: (self._daq_synch, 2, "daq"),
            0xDC: (self._daq_clock, 1, "daq"),
            0xDB: (self._daq_read, 1, "daq"),
            0xDA: (self._daq_processor, 1, "daq"),
            0xD9: (self._daq_resolution, 1, "daq"),
            0xD7: (self._daq_event, 4, "daq"),
            0xD6: (self._daq_free, 1, "daq"),
            0xD5: (self._daq_lists, 4, "daq"),
            0xD4: (self._daq_tables, 5, "daq"),
            0xD3: (self._daq_entries, 6, "daq"),
        }

    def command(self, data: bytes) -> list[bytes]:
        """Carry out one command; return the answers that are there now, none while nobody is connected."""
        if not data:
            return []
        code = data[0]
        if code == 0xFF:
            return self._connect(data)
        if code == 0xF2:  # to every slave on the bus: who is there?
            if data[1:5] == b"\xffXCP" and len(data) >= 6 and data[5] in (0, 1):
                name = b"XCP" if data[5] == 0 else bytes(255 - c for c in b"XCP")
                return [bytes([OK]) + name + struct.pack("<I", self.ident - 1)]
            return [self._refuse(UNKNOWN, "this transport command is not known")] if self.connected else []
        if not self.connected:
            return []
        if code < 0xC0:  # a frame of a STIM list; it has no answer
            if not self._locked & (RESOURCES["daq"] | RESOURCES["stim"]):
                self.daq.stimulate(self.k, data)
            return []
        known = self._commands.get(code)
        if known is None:
            return [self._refuse(UNKNOWN, f"command {code:#04x} is not known")]
        carry_out, length, resource = known
        if len(data) < length:
            return [self._refuse(SYNTAX, f"command {code:#04x} has {length} bytes, here {len(data)}")]
        if resource and self._locked & RESOURCES[resource]:
            return [self._refuse(LOCKED, f"{resource} is locked: GET_SEED, UNLOCK")]
        try:
            return carry_out(data) or []
        except Refusal as e:
            return [self._refuse(e.code, str(e))]

    def sample(self, k: int) -> np.ndarray:
        """Return the measurement frames (int64[n, 2]) of tick ``k``, which has been run."""
        self.k = k + 1
        return self.daq.sample(k)

    def late(self) -> list[bytes]:
        """Return the answers and events that have come since the last call: of a check that is done, of measurements
        that were left out.
        """
        out, self._late = self._late, []
        if self.daq.overloads != self._told and self.k - self._told_at >= AGAIN:
            self._told, self._told_at = self.daq.overloads, self.k
            out.append(bytes([EVENT, OVERLOADED]))
        return out

    def _after(self, task: Task | None, answers: Callable[[], list[bytes]]) -> list[bytes] | None:
        """Answer when ``task`` has taken effect; at once where there is none."""
        if task is None:
            return answers()

        def then(why: Refusal | None) -> None:
            self.waiting = False
            self._late += answers() if why is None else [self._refuse(why.code, str(why))]

        self.memory.desk.begin(task, then)
        self.waiting = True
        return None

    def _refuse(self, code: int, why: str) -> bytes:
        self.why = why
        return bytes([ERROR, code])

    # ---- session -----------------------------------------------------------------------------------------------------

    def _connect(self, data: bytes) -> list[bytes]:
        if len(data) < 2 or data[1] not in (0, 1):
            return [self._refuse(SYNTAX, "mode must be 0 or 1")] if self.connected else []
        self.connected = True
        resource = 0x01 | 0x04 | 0x08  # calibration, measurement, STIM
        # Intel byte order, addresses of bytes, blocks from the slave, GET_COMM_MODE_INFO
        return [struct.pack("<BBBBHBB", OK, resource, 0xC0, self.max_cto, 8, 1, 1)]

    def _reset(self) -> None:
        """Begin as if nobody had been here; what was calibrated stays."""
        self.daq.free()
        self.daq.step = 0
        self._told = self.daq.overloads
        self.memory.forget()
        self.memory.xcp_page = WORKING
        self._locked, self._seed = self._lockable, None
        self._freeze = False
        self._mta = None, EXACT, 0

    def _disconnect(self, data: bytes) -> list[bytes]:
        self._reset()
        self.connected = False
        return [bytes([OK])]

    def _status(self, data: bytes) -> list[bytes]:
        return [struct.pack("<BBBBH", OK, DAQ_RUNS if self.daq.running else 0, self._locked, 0, 0)]

    def _synch(self, data: bytes) -> list[bytes]:
        return [self._refuse(SYNCH, "synchronised")]

    def _comm_mode(self, data: bytes) -> list[bytes]:
        return [bytes([OK, 0, 0, 0, 0, 0, 16, 0x10])]  # no blocks from the master; a queue of 16; version 1.0

    def _get_id(self, data: bytes) -> list[bytes]:
        kind = data[1]
        texts = {0: NAME, 1: NAME, 2: f"{NAME}.a2l"}
        if kind == 4 and self._a2l is not None:
            text = self._a2l().encode()
        elif kind in texts:
            text = texts[kind].encode()
        else:
            return [struct.pack("<BBHI", OK, 0, 0, 0)]  # such an identification is not there
        self._mta = text, EXACT, 0
        return [struct.pack("<BBHI", OK, 0, 0, len(text))]

    def _request(self, data: bytes) -> list[bytes] | None:
        if data[1] != STORE_CAL:
            raise Refusal(RANGE, f"mode (={data[1]:#x}) must be 1, store the calibration")
        if self.folder is None:
            raise Refusal(DENIED, "there is no folder to save into")
        if not self._freeze:
            raise Refusal(MODE, "SET_SEGMENT_MODE with freeze comes first")
        return self._after(self.memory.save(self.folder), lambda: [bytes([OK]), bytes([EVENT, STORED])])

    def _get_seed(self, data: bytes) -> list[bytes]:
        resource = data[2]
        if data[1] == 1:  # a rest of the seed: all of it was in the first frame
            raise Refusal(SEQUENCE, "the whole seed was in the first answer")
        if data[1] != 0 or resource not in RESOURCES.values():
            raise Refusal(RANGE, f"resource (={resource:#x}) must be one of 0x01, 0x04, 0x08")
        if not self._locked & resource:
            return [bytes([OK, 0])]
        if self.lock.pauses(self.k):
            raise Refusal(LOCKED, "too many keys were wrong: wait 10 s")
        seed = self.lock.seed()
        self._seed = resource, seed
        return [bytes([OK, SEED]) + seed]

    def _unlock(self, data: bytes) -> list[bytes]:
        if self._seed is None:
            raise Refusal(SEQUENCE, "GET_SEED comes first")
        (resource, seed), self._seed = self._seed, None
        name = next(n for n, bit in RESOURCES.items() if bit == resource)
        key = data[2 : 2 + SEED] if data[1] == SEED else b""
        if not self.lock.fits(self.k, key, key_of(name, seed)):
            self._disconnect(data)  # as the standard has it
            return [self._refuse(LOCKED, "the key is wrong")]
        self._locked &= ~resource
        return [bytes([OK, self._locked])]

    # ---- memory ------------------------------------------------------------------------------------------------------

    def _set_mta(self, data: bytes) -> list[bytes]:
        self._mta = (None, data[3], int.from_bytes(data[4:8], "little"))
        return [bytes([OK])]

    def _take(self, n: int) -> bytes:
        text, ext, at = self._mta
        if text is None:
            out = self.memory.read(ext, at, n)
        elif at + n <= len(text):
            out = text[at : at + n]
        else:
            raise Refusal(RANGE, "the text ends before")
        self._mta = text, ext, at + n
        return out

    def _upload(self, data: bytes) -> list[bytes]:
        if data[1] == 0:
            raise Refusal(RANGE, "number (=0) must be 1 to 255")
        found, room = self._take(data[1]), self.max_cto - 1
        return [bytes([OK]) + found[i : i + room] for i in range(0, len(found), room)]

    def _short_upload(self, data: bytes) -> list[bytes]:
        n = data[1]
        if not 1 <= n < self.max_cto:
            raise Refusal(RANGE, f"number (={n}) must be 1 to {self.max_cto - 1}")
        self._set_mta(data)
        return [bytes([OK]) + self._take(n)]

    def _checksum(self, data: bytes) -> list[bytes]:
        n = int.from_bytes(data[4:8], "little")
        if not 1 <= n <= MOST_CHECKED:
            return [struct.pack("<BBHI", ERROR, RANGE, 0, MOST_CHECKED)]
        return [struct.pack("<BBHI", OK, 0x09, 0, zlib.crc32(self._take(n)))]  # CRC-32 of IEEE 802.3

    def _download(self, data: bytes) -> list[bytes] | None:
        n = data[1]
        if n == 0 or n > self.max_cto - 2:
            raise Refusal(RANGE, f"number (={n}) must be 1 to {self.max_cto - 2}")
        if len(data) < 2 + n:
            raise Refusal(SYNTAX, f"{n} bytes were announced, {len(data) - 2} came")
        text, ext, at = self._mta
        if text is not None:
            raise Refusal(PROTECTED, "a text cannot be written")

        def written() -> list[bytes]:
            self._mta = None, ext, at + n
            return [bytes([OK])]

        return self._after(self.memory.write(ext, at, data[2 : 2 + n]), written)

    def _short_download(self, data: bytes) -> list[bytes] | None:
        n = data[1]
        if not 1 <= n <= self.max_cto - 8:
            raise Refusal(RANGE, f"number (={n}) must be 1 to {self.max_cto - 8}; here a frame has no room for more")
        if len(data) < 8 + n:
            raise Refusal(SYNTAX, f"{n} bytes were announced, {len(data) - 8} came")
        self._set_mta(data)
        return self._download(bytes([0xF0, n]) + data[8 : 8 + n])

    # ---- pages -------------------------------------------------------------------------------------------------------

    def _of_segment(self, segment: int) -> None:
        if segment != 0:
            raise Refusal(SEGMENT, f"segment (={segment}) must be 0")

    def _set_page(self, data: bytes) -> list[bytes] | None:
        mode, segment, page = data[1:4]
        if not mode & 0x80:
            self._of_segment(segment)
        if not mode & 0x03 or mode & ~0x83:
            raise Refusal(MODE, f"mode (={mode:#x}) must say ECU (1), XCP (2) or both")
        return self._after(self.memory.use(page, ecu=bool(mode & 1), xcp=bool(mode & 2)), _done)

    def _get_page(self, data: bytes) -> list[bytes]:
        self._of_segment(data[2])
        if data[1] not in (1, 2):
            raise Refusal(MODE, f"mode (={data[1]}) must be 1, ECU, or 2, XCP")
        return [bytes([OK, 0, 0, self.memory.ecu_page if data[1] == 1 else self.memory.xcp_page])]

    def _page_processor(self, data: bytes) -> list[bytes]:
        return [bytes([OK, 1, 1])]  # one segment, which can be frozen

    def _segment(self, data: bytes) -> list[bytes]:
        mode, segment, what = data[1:4]
        self._of_segment(segment)
        if mode == 0 and what in (0, 1):
            return [struct.pack("<B3xI", OK, CALIBRATION if what == 0 else 8 * len(self.memory.elements))]
        if mode == 1:
            return [bytes([OK, 2, 0, 0, 0, 0])]  # two pages, no mapping
        raise Refusal(RANGE, f"mode (={mode}) must be 0, with information 0 or 1, or 1")

    def _page(self, data: bytes) -> list[bytes]:
        self._of_segment(data[2])
        if data[3] not in (WORKING, REFERENCE):
            raise Refusal(NO_PAGE, f"page (={data[3]}) must be 0 or 1")
        # both are used by the firmware and read whoever uses them; page 0 is written
        return [bytes([OK, 0x3F if data[3] == WORKING else 0x0F, 0])]

    def _set_segment_mode(self, data: bytes) -> list[bytes]:
        self._of_segment(data[2])
        if data[1] not in (0, 1):
            raise Refusal(MODE, f"mode (={data[1]}) must be 0 or 1, freeze")
        self._freeze = data[1] == 1
        return [bytes([OK])]

    def _segment_mode(self, data: bytes) -> list[bytes]:
        self._of_segment(data[2])
        return [bytes([OK, 0, int(self._freeze)])]

    def _copy(self, data: bytes) -> list[bytes] | None:
        self._of_segment(data[1])
        self._of_segment(data[3])
        return self._after(self.memory.copy(data[2], data[4]), _done)

    # ---- measurement lists -------------------------------------------------------------------------------------------

    def _daq_clear(self, data: bytes) -> list[bytes]:
        self.daq.clear(struct.unpack_from("<H", data, 2)[0])
        return [bytes([OK])]

    def _daq_pointer(self, data: bytes) -> list[bytes]:
        self.daq.point(*struct.unpack_from("<HBB", data, 2))
        return [bytes([OK])]

    def _daq_write(self, data: bytes) -> list[bytes]:
        self.daq.write(*struct.unpack_from("<BBBI", data, 1))
        return [bytes([OK])]

    def _daq_mode(self, data: bytes) -> list[bytes]:
        mode, at, event, prescaler, priority = struct.unpack_from("<BHHBB", data, 1)
        if mode == STIM and self._locked & RESOURCES["stim"]:
            raise Refusal(LOCKED, "stim is locked: GET_SEED, UNLOCK")
        self.daq.mode(at, mode, event, prescaler, priority)
        return [bytes([OK])]

    def _daq_mode_of(self, data: bytes) -> list[bytes]:
        mode, event, prescaler, priority = self.daq.mode_of(struct.unpack_from("<H", data, 2)[0])
        return [struct.pack("<BBHHBB", OK, mode, 0, event, prescaler, priority)]

    def _daq_start(self, data: bytes) -> list[bytes]:
        what, at = struct.unpack_from("<BH", data, 1)
        return [bytes([OK, self.daq.start_list(what, at)])]

    def _daq_synch(self, data: bytes) -> list[bytes]:
        self.daq.start_selected(data[1])
        return [bytes([OK])]

    def _daq_clock(self, data: bytes) -> list[bytes]:
        return [struct.pack("<B3xI", OK, self.k & 0xFFFFFFFF)]

    def _daq_read(self, data: bytes) -> list[bytes]:
        size, ext, address = self.daq.look()
        return [struct.pack("<BBBBI", OK, 0xFF, size, ext, address)]

    def _daq_processor(self, data: bytes) -> list[bytes]:
        # dynamic lists, prescaler, times, an event packet for an overload; identifiers of tables are absolute
        return [struct.pack("<BBHHBB", OK, 0x01 | 0x02 | 0x10 | 0x80, len(self.daq.lists), len(EVENTS), 0, 0)]

    def _daq_resolution(self, data: bytes) -> list[bytes]:
        # entries of single bytes; times of two bytes, always there, of 1 ms
        return [struct.pack("<BBBBBBH", OK, 1, PAYLOAD, 4, 4, STAMP | 0x08 | MILLISECOND << 4, 1)]

    def _daq_event(self, data: bytes) -> list[bytes]:
        number = struct.unpack_from("<H", data, 2)[0]
        if number >= len(EVENTS):
            raise Refusal(RANGE, f"event (={number}) must be below {len(EVENTS)}")
        name, period = EVENTS[number]
        self._mta = name.encode(), EXACT, 0
        return [struct.pack("<BBBBBBB", OK, 0x04 | 0x08 | 0x80, 0xFF, len(name), period, MILLISECOND, 0)]

    def _daq_free(self, data: bytes) -> list[bytes]:
        self.daq.free()
        return [bytes([OK])]

    def _daq_lists(self, data: bytes) -> list[bytes]:
        self.daq.allocate_lists(struct.unpack_from("<H", data, 2)[0])
        return [bytes([OK])]

    def _daq_tables(self, data: bytes) -> list[bytes]:
        self.daq.allocate_tables(*struct.unpack_from("<HB", data, 2))
        return [bytes([OK])]

    def _daq_entries(self, data: bytes) -> list[bytes]:
        self.daq.allocate_entries(*struct.unpack_from("<HBB", data, 2))
        return [bytes([OK])]


def _done() -> list[bytes]:
    return [bytes([OK])]
