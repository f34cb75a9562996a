"""A UDS server (ISO 14229-1) as a pure machine: a request's bytes in, the answers' bytes out, time in ticks.

It has no clock and no bus. Numbers in data identifiers are big-endian, of single precision, in the units of the border
(docs/uds.md has every service). Reading is free; what writes, silences or resets needs the key. A session other than
the default one ends 5 s after the last request; what it has changed of the traffic and of the trouble memory's entries
ends with it.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
import zlib
from collections.abc import Callable

import numpy as np

from controller import new_state
from controller.records import INIT, STANDBY
from hil.calibrate.lock import ATTEMPTS, Lock
from hil.calibrate.memory import WORKING, Memory, Refusal
from hil.calibrate.prepare import Task
from hil.uds import routines
from hil.uds.trouble import CODES, MASK, TroubleMemory

__all__ = ["FUNCTIONAL", "MOST_REQUEST", "REQUEST", "RESPONSE", "SIGNALS", "Server", "key_of"]

REQUEST, RESPONSE, FUNCTIONAL = 0x7E0, 0x7E8, 0x7DF  # CAN identifiers
DEFAULT, PROGRAMMING, EXTENDED = 1, 2, 3
S3, P2, P2_STAR = 5000, 50, 5000  # ticks
MOST_FILE, BLOCK = 1 << 16, 256  # bytes of a calibration file, of a block with its two bytes of head
MOST_REQUEST = 1024  # bytes
SEED = 8  # bytes
RESET_AGAIN = 5000  # ticks from one reset to the next: the firmware must get beyond INIT
CHECKING = 120  # ticks that the check of a loaded file takes: longer than P2, so 0x78 comes first

# negative responses
(NO_SERVICE, NO_SUBFUNCTION, LENGTH, BUSY, CONDITIONS, SEQUENCE, RANGE, LOCKED, WRONG_KEY, ATTEMPTED, WAIT, REFUSED,
 SUSPENDED, FAILURE, WRONG_BLOCK, PENDING, NOT_IN_SESSION) = (
    0x11, 0x12, 0x13, 0x21, 0x22, 0x24, 0x31, 0x33, 0x35, 0x36, 0x37, 0x70, 0x71, 0x72, 0x73, 0x78, 0x7F
)  # fmt: skip
_QUIET = (NO_SERVICE, NO_SUBFUNCTION, RANGE, NOT_IN_SESSION)  # not answered when asked of all

# live signals: identifier -> name, unit; also what a freeze frame has, in this order
SIGNALS = {
    0x2000: ("t", "s"), 0x2001: ("n_dem", "%"), 0x2002: ("n_r", "%"), 0x2003: ("x_dem", "mm"),
    0x2004: ("x_lvdt", "mm"), 0x2005: ("i_cmd", "mA"), 0x2006: ("state", "-"), 0x2007: ("faults", "-"),
    0x2008: ("vigv", "deg"),
}  # fmt: skip
TEXTS = {0xF187: "VGV-1", 0xF18C: "VANELOOP-0001", 0xF195: "1.0", 0xF197: "variable guide vanes"}
WRITABLE = {0xF198: 16, 0xF199: 8}  # repair shop, date of the last programming: longest text


class Negative(Exception):
    """A negative response."""

    def __init__(self, code: int):
        self.code = code


def key_of(seed: bytes) -> bytes:
    """Return the key for a seed: the first eight bytes of HMAC-SHA-256 with the secret ``vaneloop-uds``."""
    return hmac.new(b"vaneloop-uds", seed, hashlib.sha256).digest()[:SEED]


class Server:
    """The server of one node.

    memory   the node's memory, as the XCP slave sees it too
    trouble  its trouble codes
    store    called with the trouble memory's text when it has changed; it must not wait
    seed     number from which the lock's seeds follow; None: the system's entropy
    sweep    the routine that runs, or ran last
    """

    def __init__(
        self,
        memory: Memory,
        trouble: TroubleMemory | None = None,
        *,
        store: Callable[[str], None] | None = None,
        seed: int | None = None,
    ):
        self.memory, self.trouble = memory, trouble or TroubleMemory()
        self.node = memory.node
        self.sweep: routines.Sweep | None = None
        self._routine = 0
        self._results: dict[int, bytes] = {}
        self._store = store
        self.lock = Lock("uds", SEED, seed, self.trouble.wrong_keys)
        self._last: int  # tick of the last request
        self._k: int  # tick of the request
        self._seed: bytes | None
        self._file: bytearray | None
        self._size: int
        self._block: int
        self._since: int | None = None  # tick at which a file was given; None: none is being checked
        self._found: list[np.ndarray | None] | None = None  # its scalars, once read; None: it is no calibration
        self._reset = False
        self._reset_again = 0  # the first tick in which a reset may be asked for
        self._end_session()
        all_sessions, not_default = (DEFAULT, PROGRAMMING, EXTENDED), (PROGRAMMING, EXTENDED)
        # service -> what does it, least length, sessions, whether it has a subfunction
        self._services: dict[int, tuple[Callable[[bytes], bytes | None], int, tuple[int, ...], bool]] = {
            0x10: (self._control, 2, all_sessions, True),
            0x11: (self._ecu_reset, 2, not_default, True),
            0x14: (self._clear, 4, not_default, False),
            0x19: (self._read_trouble, 2, all_sessions, True),
            0x22: (self._read, 3, all_sessions, False),
            0x27: (self._security, 2, not_default, True),
            0x28: (self._communication, 3, (EXTENDED,), True),
            0x2E: (self._write, 4, (EXTENDED,), False),
            0x31: (self._run_routine, 4, (EXTENDED,), True),
            0x34: (self._download, 3, (PROGRAMMING,), False),
            0x36: (self._transfer, 2, (PROGRAMMING,), False),
            0x37: (self._transfer_exit, 1, (PROGRAMMING,), False),
            0x3E: (self._present, 2, all_sessions, True),
            0x85: (self._setting, 2, (EXTENDED,), True),
        }

    # ---- a request ---------------------------------------------------------------------------------------------------

    def request(self, k: int, data: bytes, functional: bool = False) -> list[bytes]:
        """Carry out one request that came before tick ``k``; return the answers, none where none is wanted."""
        self._k = k
        if not data:
            return []
        service = data[0]
        known = self._services.get(service)
        try:
            if self._since is not None and service != 0x3E:
                raise Negative(BUSY)
            if known is None:
                raise Negative(NO_SERVICE)
            carry_out, length, sessions, subfunction = known
            if self.session not in sessions:
                raise Negative(NOT_IN_SESSION)
            if len(data) < length:
                raise Negative(LENGTH)
            quiet = subfunction and data[1] & 0x80 != 0
            if quiet:
                data = bytes([service, data[1] & 0x7F]) + data[2:]
            answer = carry_out(data)
        except Negative as e:
            self._last = k
            return [] if functional and e.code in _QUIET else [bytes([0x7F, service, e.code])]
        self._last = k
        return [] if quiet or answer is None else [bytes([service + 0x40]) + answer]

    def before(self, k: int) -> list[bytes]:
        """Work before tick ``k``: a reset, the end of a session, answers that took their time."""
        if self._reset:
            self._reset = False
            self.memory.loop.z[:] = new_state()
            self.trouble.new_cycle()
            self._end_session()
        if self.session != DEFAULT and self._since is None and k - self._last >= S3:
            self._end_session()
        if self._since is None:
            return []
        waited = k - self._since
        if waited >= CHECKING and self._found is not None and not self.memory.desk.waiting:
            (found,) = self._found
            self._since = self._found = None
            self._last = k
            try:
                self._flash(found)
            except Negative as e:
                return [bytes([0x7F, 0x37, e.code])]
            return [bytes([0x77])]
        if waited == P2 - 10:  # the desk gives up long before P2* is over
            return [bytes([0x7F, 0x37, PENDING])]
        return []

    def after(self, k: int) -> None:
        """Look at the faults of tick ``k``, which has been run."""
        trouble = self.trouble
        trouble.look(int(self.memory.loop.given.mode), self.node.faults, self._freeze)
        self._quiet = self.silent  # a closed loop ends it
        if self.sweep is not None:
            self.sweep.look(k)
            if self.sweep.state != routines.RUNNING:
                self._end_sweep(self.sweep.state)
        if trouble.changed and self._store is not None:
            trouble.changed = False
            self._store(trouble.dump())

    def _freeze(self) -> bytes:
        now = self._signals()
        return routines.singles(*(now[name] for name, _ in SIGNALS.values()))

    def _signals(self) -> dict[str, float]:
        """The live signals after the last tick."""
        loop = self.memory.loop
        given, state = loop.given, loop.state
        return {
            "t": (self.node.k - 1) * 1e-3,
            "n_dem": state.n_dem,
            "n_r": state.n_r_raw,
            "x_dem": given.x_dem * 1e3,
            "x_lvdt": loop.fed.x_lvdt * 1e3,
            "i_cmd": given.i_cmd * 1e3,
            "state": given.mode,
            "faults": given.faults,
            "vigv": np.degrees(loop.angles[0]),
        }

    # ---- sessions ----------------------------------------------------------------------------------------------------

    def _end_session(self) -> None:
        """Leave everything as it was before the session."""
        self.session = DEFAULT
        self._quiet = self._open = False
        self._seed = self._file = None
        self.trouble.on = True
        self._end_sweep(routines.ABORTED)

    def _end_sweep(self, state: int) -> None:
        """Keep the result of the routine that runs, if one does."""
        if self.sweep is not None:
            self.sweep.state = state
            self._results[self._routine] = self.sweep.result(self._routine)
            self.sweep = None

    def _control(self, data: bytes) -> bytes:
        self._exactly(data, 2)
        if data[1] not in (DEFAULT, PROGRAMMING, EXTENDED):
            raise Negative(NO_SUBFUNCTION)
        if data[1] == PROGRAMMING:
            self._idle()
        self._end_session()
        self.session = data[1]
        return struct.pack(">BHH", data[1], P2, P2_STAR // 10)

    def _ecu_reset(self, data: bytes) -> bytes:
        self._exactly(data, 2)
        if data[1] not in (1, 3):
            raise Negative(NO_SUBFUNCTION)
        self._unlocked()
        self._idle()
        if self.memory.loop.foreign or self._k < self._reset_again:
            raise Negative(CONDITIONS)
        self._reset, self._reset_again = True, self._k + RESET_AGAIN
        return data[1:]

    def _present(self, data: bytes) -> bytes:
        self._exactly(data, 2)
        if data[1] != 0:
            raise Negative(NO_SUBFUNCTION)
        return b"\x00"

    def _security(self, data: bytes) -> bytes:
        if data[1] not in (1, 2):
            raise Negative(NO_SUBFUNCTION)
        if data[1] == 1:
            self._exactly(data, 2)
            if self.lock.pauses(self._k):
                raise Negative(WAIT)
            if self._open:
                return b"\x01" + bytes(SEED)
            self._seed = self.lock.seed()
            return b"\x01" + self._seed
        self._exactly(data, 2 + SEED)
        if self._seed is None:
            raise Negative(SEQUENCE)
        seed, self._seed = self._seed, None
        self._open = self.lock.fits(self._k, data[2:], key_of(seed))
        self.trouble.count_keys(self.lock.wrong)
        if not self._open:
            raise Negative(ATTEMPTED if self.lock.wrong >= ATTEMPTS else WRONG_KEY)
        return b"\x02"

    def _communication(self, data: bytes) -> bytes:
        self._exactly(data, 3)
        if data[1] not in (0, 1):  # both ways, or nothing sent; the ECU's demand is always heard
            raise Negative(NO_SUBFUNCTION)
        if data[2] != 1:  # the controller's own frames
            raise Negative(RANGE)
        self._unlocked()
        if data[1] == 1:
            self._idle()
        self._quiet = data[1] == 1
        return data[1:2]

    def _setting(self, data: bytes) -> bytes:
        self._exactly(data, 2)
        if data[1] not in (1, 2):
            raise Negative(NO_SUBFUNCTION)
        self._unlocked()
        self.trouble.on = data[1] == 1
        return data[1:]

    # ---- trouble codes -----------------------------------------------------------------------------------------------

    def _clear(self, data: bytes) -> bytes:
        self._exactly(data, 4)
        self._unlocked()
        if not self.trouble.clear(int.from_bytes(data[1:], "big")):
            raise Negative(RANGE)
        return b""

    def _read_trouble(self, data: bytes) -> bytes:
        what, trouble = data[1], self.trouble
        if what in (0x01, 0x02):
            self._exactly(data, 3)
            found = trouble.by_mask(data[2])
            if what == 0x01:
                return bytes([what, MASK, 0x01]) + struct.pack(">H", len(found))
            return bytes([what, MASK]) + b"".join(_pair(*f) for f in found)
        if what == 0x0A:
            self._exactly(data, 2)
            every = zip(CODES.values(), trouble.entries, strict=True)
            return bytes([what, MASK]) + b"".join(_pair(c.number, e.status) for c, e in every)
        if what == 0x03:
            self._exactly(data, 2)
            every = zip(CODES.values(), trouble.entries, strict=True)
            return bytes([what]) + b"".join(
                c.number.to_bytes(3, "big") + bytes([n]) for c, e in every for n in (1, 2) if e.first
            )
        if what not in (0x04, 0x06):
            raise Negative(NO_SUBFUNCTION)
        self._exactly(data, 6)
        number, record = int.from_bytes(data[2:5], "big"), data[5]
        entry = trouble.entry(number)
        if entry is None:
            raise Negative(RANGE)
        out = bytes([what]) + _pair(number, entry.status)
        if what == 0x06:
            records = {1: entry.failures, 2: entry.age, 3: entry.trips}
            if record != 0xFF and record not in records:
                raise Negative(RANGE)
            return out + b"".join(bytes([n, v]) for n, v in records.items() if record in (n, 0xFF))
        if record not in (1, 2, 0xFF):
            raise Negative(RANGE)
        for n, frame in ((1, entry.first), (2, entry.last)):
            if frame and record in (n, 0xFF):
                parts = (ident.to_bytes(2, "big") + frame[4 * i : 4 * i + 4] for i, ident in enumerate(SIGNALS))
                out += bytes([n, len(SIGNALS)]) + b"".join(parts)
        return out

    # ---- data --------------------------------------------------------------------------------------------------------

    def _read(self, data: bytes) -> bytes:
        if len(data) % 2 == 0 or len(data) > 33:
            raise Negative(LENGTH)
        idents = struct.unpack(f">{len(data) // 2}H", data[1:])
        now = self._signals() if any(i in SIGNALS for i in idents) else {}
        return b"".join(struct.pack(">H", i) + self._value(i, now) for i in idents)

    def _value(self, ident: int, now: dict[str, float]) -> bytes:
        if ident in SIGNALS:
            return routines.singles(now[SIGNALS[ident][0]])
        if ident in TEXTS:
            return TEXTS[ident].encode()
        if ident in WRITABLE:
            return self.trouble.texts.get(f"{ident:04X}", "").encode("ascii", "replace").ljust(WRITABLE[ident])
        if ident == 0xF186:
            return bytes([self.session])
        if ident == 0xF1A0:  # the calibration in use: CRC-32 of its numbers
            return struct.pack(">I", zlib.crc32(self.memory.live().tobytes()))
        raise Negative(RANGE)

    def _write(self, data: bytes) -> bytes:
        ident = int.from_bytes(data[1:3], "big")
        if ident not in WRITABLE:
            raise Negative(RANGE)
        self._unlocked()
        text = data[3:]
        if len(text) > WRITABLE[ident]:
            raise Negative(LENGTH)
        if not all(0x20 <= c < 0x7F for c in text):
            raise Negative(RANGE)
        self.trouble.texts[f"{ident:04X}"] = text.decode()
        self.trouble.changed = True
        return data[1:3]

    # ---- routines ----------------------------------------------------------------------------------------------------

    def _run_routine(self, data: bytes) -> bytes:
        self._exactly(data, 4)
        what, routine = data[1], int.from_bytes(data[2:], "big")
        if routine not in (routines.SWEEP, routines.LVDT, routines.CLEAR_LEARNED):
            raise Negative(RANGE)
        if what not in (1, 2, 3):
            raise Negative(NO_SUBFUNCTION)
        self._unlocked()
        head = data[1:]
        if what == 1:
            if self.sweep is not None:
                raise Negative(SEQUENCE)
            if routine == routines.CLEAR_LEARNED:
                if not routines.clear_learned(self.node):
                    raise Negative(CONDITIONS)
                self._results[routine] = b"\x00"
            else:
                if int(self.memory.loop.given.mode) != STANDBY or self.node.faults:
                    raise Negative(CONDITIONS)
                self.sweep, self._routine = routines.Sweep(self.node, self._k), routine
            return head
        mine = self.sweep if self._routine == routine else None
        if what == 2:
            if mine is None:
                raise Negative(SEQUENCE)
            self._end_sweep(routines.ABORTED)
            return head
        if mine is not None:
            return head + mine.result(routine)
        if routine not in self._results:
            raise Negative(SEQUENCE)
        return head + self._results[routine]

    # ---- a calibration file ------------------------------------------------------------------------------------------

    def _download(self, data: bytes) -> bytes:
        self._unlocked()
        self._idle()
        address, size = data[2] & 15, data[2] >> 4
        self._exactly(data, 3 + address + size)
        if data[1] != 0 or not 1 <= address <= 4 or not 1 <= size <= 4:
            raise Negative(RANGE)
        n = int.from_bytes(data[3 + address :], "big")
        if not 1 <= n <= MOST_FILE:
            raise Negative(REFUSED)
        self._file, self._size, self._block = bytearray(), n, 0
        return struct.pack(">BH", 0x20, BLOCK)

    def _transfer(self, data: bytes) -> bytes:
        if self._file is None:
            raise Negative(SEQUENCE)
        if len(data) > BLOCK:
            raise Negative(LENGTH)
        if data[1] == self._block & 0xFF and self._file:
            return data[1:2]  # the same block again: its answer was lost
        if data[1] != (self._block + 1) & 0xFF:
            raise Negative(WRONG_BLOCK)
        if len(self._file) + len(data) - 2 > self._size:
            raise Negative(SUSPENDED)
        self._file += data[2:]
        self._block += 1
        return data[1:2]

    def _transfer_exit(self, data: bytes) -> None:
        if self._file is None or len(self._file) != self._size:
            raise Negative(SEQUENCE)

        def found(k: np.ndarray | None) -> None:
            self._found = [k]

        def then(why: Refusal | None) -> None:
            if why is not None:
                self._found = [None]

        try:
            self.memory.desk.begin(Task("load", (bytes(self._file),), found), then)
        except Refusal:
            raise Negative(BUSY) from None  # it may be asked for again
        self._file, self._since = None, self._k

    def _flash(self, found: np.ndarray | None) -> None:
        """Take over the scalars of a calibration.toml that has been read, all or none."""
        if found is None:
            raise Negative(FAILURE)
        self._idle()  # the loop may have been closed since the file was given
        if self.memory.ecu_page != WORKING:  # the firmware would not use it
            raise Negative(CONDITIONS)
        of = enumerate(self.memory.elements[: len(found)])
        try:
            self.memory.change({i: float(found[i]) for i, e in of if e.table == "calibration"}, judged=True)
        except Refusal:
            raise Negative(FAILURE) from None

    # ---- conditions --------------------------------------------------------------------------------------------------

    def _exactly(self, data: bytes, n: int) -> None:
        if len(data) != n:
            raise Negative(LENGTH)

    @property
    def _loop_open(self) -> bool:
        return int(self.memory.loop.given.mode) in (INIT, STANDBY)

    @property
    def silent(self) -> bool:
        """Whether the node must not send its own frames (0x28): never while the loop is closed."""
        return self._quiet and self._loop_open

    def _idle(self) -> None:
        if not self._loop_open or self.sweep is not None:
            raise Negative(CONDITIONS)

    def _unlocked(self) -> None:
        if not self._open:
            raise Negative(LOCKED)


def _pair(number: int, status: int) -> bytes:
    return number.to_bytes(3, "big") + bytes([status & MASK])
