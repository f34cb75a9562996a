"""Rules for hostile tools that know both protocols: they lead into every state, and ask for what is not allowed there.

A rule gives the frames of a few commands, most of them well formed; which rule comes next is drawn. So lists are made,
run, and are changed while they run; locks are opened, or not; files are loaded, and the loop is closed meanwhile.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from controller.records import INPUTS
from hil.calibrate.memory import CALIBRATION, STATE
from hil.calibrate.memory import INPUTS as INPUT
from hil.calibrate.slave import RESOURCES
from hil.calibrate.slave import key_of as xcp_key
from hil.calibrate.station import MASTER

__all__ = ["RULES", "Tool", "in_frames", "rules_of"]

UDS, ALL = 0x7E0, 0x7DF  # CAN identifiers of requests (`hil.uds.station` needs an extra)
FLOOD = 60  # frames of one tick
GIVEN = ("n_dem", "n_r", "mode_request", "x_lvdt", "vigv", "vgv1")  # inputs that a tool may give
Frames = list[tuple[int, bytes]]


class Tool(NamedTuple):
    """What a rule draws from, and whom it attacks.

    rng     random numbers
    slave, server  the XCP slave and the UDS server
    key     the UDS key of a seed;  keys: whether the tool has the secrets. One without never sends a right key
    """

    rng: np.random.Generator
    slave: Any
    server: Any
    key: Callable[[bytes], bytes]
    keys: bool

    def of(self, *choices: Any) -> Any:
        """One of these."""
        return choices[int(self.rng.integers(len(choices)))]

    def below(self, n: int) -> int:
        """A whole number from 0 to ``n`` - 1."""
        return int(self.rng.integers(n))

    def noise(self, least: int, most: int) -> bytes:
        """So many random bytes."""
        return self.rng.integers(0, 256, self.rng.integers(least, most + 1), dtype=np.uint8).tobytes()


def in_frames(ident: int, request: bytes) -> Frames:
    """A request as ISO-TP's frames."""
    if len(request) < 8:
        return [(ident, bytes([len(request)]) + request)]
    head = bytes([0x10 | len(request) >> 8, len(request) & 0xFF])
    rest = [request[i : i + 7] for i in range(6, len(request), 7)]
    return [(ident, head + request[:6]), *((ident, bytes([0x20 | n & 15]) + part) for n, part in enumerate(rest, 1))]


# ---- XCP -------------------------------------------------------------------------------------------------------------


def _xcp(*commands: bytes) -> Frames:
    return [(MASTER, command) for command in commands]


def connect(t: Tool) -> Frames:
    """Begin a session, begin it again."""
    return _xcp(b"\xff\x00")


def leave(t: Tool) -> Frames:
    """End a session, and begin the next."""
    return _xcp(b"\xfe", b"\xff\x00")


def open_xcp(t: Tool) -> Frames:
    """Ask for a seed, or send a key: right, wrong or too short."""
    if not t.slave.connected:
        return _xcp(b"\xff\x00")
    if t.slave._seed is None:
        return _xcp(bytes([0xF8, 0, t.of(*RESOURCES.values(), t.below(256))]))
    resource, seed = t.slave._seed
    name = next(n for n, bit in RESOURCES.items() if bit == resource)
    if t.keys and t.below(20):
        return _xcp(b"\xf7\x06" + xcp_key(name, seed))
    return _xcp(t.of(b"\xf7\x06" + bytes(6), b"\xf7\x06\x01", b"\xf7\xff" + seed, b"\xf7\x00"))


def make_list(t: Tool) -> Frames:
    """Make a list, measured or given, whole or nearly, and start it."""
    stim, tables = t.below(2), 1 + t.below(3)
    entries = 1 if stim else 1 + t.below(2)
    out = [b"\xd6", struct.pack("<BxH", 0xD5, 1 + t.below(3)), struct.pack("<BxHB", 0xD4, 0, tables)]
    out += [struct.pack("<BxHBB", 0xD3, 0, table, entries) for table in range(tables)]
    for table in range(tables):
        out.append(struct.pack("<BxHBB", 0xE2, 0, table, 0))
        for _ in range(entries):
            place = INPUT + 4 * INPUTS.index(t.of(*GIVEN, *GIVEN, *GIVEN, *INPUTS)) if stim else STATE + 4 * t.below(99)
            out.append(struct.pack("<BBBBI", 0xE1, 0xFF, 4 if stim else t.of(4, 4, 1, 2), 1, place))
    out += [struct.pack("<BBHHBB", 0xE0, 2 if stim else 16, 0, t.below(2), 1 + t.below(4), 0), b"\xde\x01\0\0"]
    if not t.below(3):
        del out[t.below(len(out))]
    return _xcp(*out)


def change_list(t: Tool) -> Frames:
    """One command of lists, whatever state they are in."""
    at, table, entry = t.below(3), t.below(4), t.below(4)
    return _xcp(
        t.of(
            b"\xd6",
            struct.pack("<BxH", 0xD5, t.of(1, 2, 16, 17, 0xFFFF)),
            struct.pack("<BxHB", 0xD4, at, t.of(1, 2, 64, 255)),
            struct.pack("<BxHBB", 0xD3, at, table, t.of(1, 7, 255)),
            struct.pack("<BxHBB", 0xE2, at, table, entry),
            struct.pack("<BBBBI", 0xE1, 0xFF, t.of(0, 1, 4, 5, 255), t.below(3), STATE + t.below(2000)),
            struct.pack("<BBHHBB", 0xE0, t.of(2, 16, 18, 0), at, t.below(3), t.below(3), t.below(9)),
            struct.pack("<BBH", 0xDE, t.below(4), at),
            struct.pack("<BxH", 0xE3, at),
            struct.pack("<BxH", 0xDF, at),
            bytes([0xDD, t.below(4)]),
            b"\xdb",
        )
    )


def give(t: Tool) -> Frames:
    """Frames of a STIM list: numbers of every kind, in and out of order."""
    kinds = (float("nan"), float("inf"), 3e38, -3e38, 0.0, 70.0, 0.03, t.rng.normal(), 1e-40)
    values = [struct.pack("<2f", t.of(*kinds), t.of(*kinds))[: t.of(4, 7, 7, 2)] for _ in range(3)]
    return _xcp(*(bytes([pid if t.below(9) else t.below(0xC0)]) + v for pid, v in enumerate(values)))


def calibrate(t: Tool) -> Frames:
    """Write a number, whole or a part of it; at, before and behind the end of the calibration too."""
    elements = t.slave.memory.elements
    at = t.below(len(elements))
    e = elements[at]
    value = t.of(t.rng.uniform(e.low, e.high), e.low, e.high, 2.0 * e.high + 1.0, float("nan"), float("inf"))
    ext = t.below(2)
    raw = struct.pack("<f", np.clip(value, -3e38, 3e38)) if ext else struct.pack("<d", value)
    address = CALIBRATION + (4 if ext else 8) * t.of(at, at, at, at, -1, len(elements) - 1, len(elements))
    parts = [raw[:6], raw[6:]][: t.of(1, 2, 2, 2)]
    return _xcp(struct.pack("<BxxBI", 0xF6, ext, address), *(bytes([0xF0, len(part)]) + part for part in parts if part))


def pages(t: Tool) -> Frames:
    """Switch, copy, freeze and save pages."""
    return _xcp(
        t.of(
            bytes([0xEB, t.of(1, 2, 3, 0x83, 0), t.of(0, 0, 0, 1), t.below(3)]),
            bytes([0xEA, 1 + t.below(2), 0]),
            bytes([0xE4, 0, t.below(2), 0, t.below(2)]),
            bytes([0xE6, t.below(2), 0]),
            b"\xf9\x01\0\0",
        )
    )


def read(t: Tool) -> Frames:
    """Read memory and texts of every size, also over their end."""
    base = t.of(INPUT, 0x11000000, STATE, CALIBRATION, 0)
    at = struct.pack("<BxxBI", 0xF6, t.below(3), base + t.below(5000))
    n = t.of(1, 7, 8, 255, 0)
    size = t.of(1, 100, 1 << 20, (1 << 20) + 1, 0xFFFFFFFF)
    then = t.of(bytes([0xF5, n]), struct.pack("<BxxxI", 0xF3, size), bytes([0xFA, t.below(6)]))
    return _xcp(at, then) if t.below(4) else _xcp(bytes([0xFA, t.below(6)]), bytes([0xF5, n]))


def any_xcp(t: Tool) -> Frames:
    """A known command with random bytes, or random bytes alone."""
    raw = bytearray(t.noise(1, 8))
    if t.below(3):
        raw[0] = t.of(*t.slave._commands, 0xF2, 0xFF)
    if raw[0] == 0xF7:
        del raw[1:]
    return _xcp(bytes(raw))


def flood_xcp(t: Tool) -> Frames:
    """One command so often that it must wait."""
    return _xcp(t.of(b"\xf5\xff", b"\xfd", b"\xfa\x04", b"\x00\0\0\0\0")) * FLOOD


# ---- UDS -------------------------------------------------------------------------------------------------------------


def session(t: Tool) -> Frames:
    """Begin a session, or keep it."""
    begin = t.of(b"\x10\x03", b"\x10\x03", b"\x10\x02", b"\x10\x01")
    return in_frames(t.of(UDS, UDS, UDS, ALL), begin if t.server.session == 1 or not t.below(9) else b"\x3e\x80")


def open_uds(t: Tool) -> Frames:
    """Ask for a seed, or send a key: right, wrong or too short."""
    if t.server._seed is None:
        return in_frames(UDS, b"\x27\x01")
    if t.keys and t.below(20):
        return in_frames(UDS, b"\x27\x02" + t.key(t.server._seed))
    return in_frames(UDS, b"\x27\x02" + t.of(bytes(8), bytes(7), t.server._seed))


def silence(t: Tool) -> Frames:
    """Stop the controller's own frames, or the entries of its trouble memory, and keep the session."""
    return [*in_frames(UDS, t.of(b"\x28\x01\x01", b"\x28\x00\x01", b"\x85\x02", b"\x85\x01")), (UDS, b"\x02\x3e\x80")]


def reset(t: Tool) -> Frames:
    """Let the firmware start anew."""
    return in_frames(t.of(UDS, ALL), t.of(b"\x11\x01", b"\x11\x03", b"\x11\x81"))


def routine(t: Tool) -> Frames:
    """Start, stop, ask for a result."""
    return in_frames(UDS, bytes([0x31, 1 + t.below(3), 2, 1 + t.below(3)]))


def load(t: Tool) -> Frames:
    """Transfer a file, whole or not, and ask for its check."""
    n = t.of(4, 10, 300)
    out = [b"\x34\0\x44" + struct.pack(">II", 0, t.of(n, n, n, 0, 1 << 16, (1 << 16) + 1))]
    out += [bytes([0x36, i]) + bytes(min(n - at, 254)) for i, at in enumerate(range(0, n, 254), 1)]
    out.append(b"\x37")
    if not t.below(3):
        del out[t.below(len(out))]
    return [frame for request in out for frame in in_frames(UDS, request)]


def trouble(t: Tool) -> Frames:
    """Read and clear trouble codes, write texts."""
    return in_frames(
        UDS,
        t.of(
            b"\x14\xff\xff\xff",
            bytes([0x19, t.below(12)]) + t.noise(0, 4),
            b"\x19\x04\x1a\x01\x87\xff",
            b"\x2e\xf1" + t.of(b"\x98", b"\x99") + t.noise(0, 20),
            b"\x22" + t.of(b"\x20\x00", b"\xf1\xa0", b"\xf1\x97", b"\xf1\x86") * t.of(1, 3, 16, 17),
        ),
    )


def pieces(t: Tool) -> Frames:
    """Pieces of ISO-TP in any order, flow control of every kind or none."""
    size = t.of(0, 7, 8, 100, 1024, 1025, 4095)
    made = {
        "first": struct.pack(">H", 0x1000 | size) + t.noise(0, 6),
        "next": bytes([0x20 | t.below(16)]) + t.noise(0, 7),
        "flow": bytes([0x30 | t.below(4), t.below(9), t.of(0, 5, 0x7F, 0xF1, 0x80)]),
        "long": b"\x10\0" + struct.pack(">I", t.of(5000, 0xFFFFFFFF)),
        "single": bytes([t.below(16)]) + t.noise(0, 7),
        "other": t.noise(0, 8),
    }
    return [(t.of(UDS, UDS, ALL), made[t.of(*made)]) for _ in range(1 + t.below(4))]


def any_uds(t: Tool) -> Frames:
    """A known service with random bytes."""
    raw = bytearray(t.noise(1, 12))
    raw[0] = t.of(*t.server._services, raw[0])
    if raw[0] == 0x27:
        del raw[2:]
    return in_frames(UDS, bytes(raw)) if len(raw) > 7 else in_frames(t.of(UDS, ALL), bytes(raw))


def flood_uds(t: Tool) -> Frames:
    """One frame so often that it must wait."""
    return [t.of((UDS, b"\x10\x64\x2e\xf1\x99\0\0\0"), (ALL, b"\x02\x3e\0"), (ALL, b"\x03\x22\xf1\xa0"))] * FLOOD


XCP_RULES: dict[Callable[[Tool], Frames], int] = {
    connect: 6, leave: 2, open_xcp: 12, make_list: 5, change_list: 24, give: 14, calibrate: 16, pages: 8, read: 6,
    any_xcp: 6, flood_xcp: 1,
}  # fmt: skip
UDS_RULES: dict[Callable[[Tool], Frames], int] = {
    session: 14, open_uds: 18, silence: 10, reset: 6, routine: 12, load: 5, trouble: 10, pieces: 12, any_uds: 8,
    flood_uds: 1,
}  # fmt: skip
RULES = XCP_RULES | UDS_RULES  # how often each one comes


def rules_of(t: Tool) -> Frames:
    """The frames of a rule that is drawn."""
    weights = np.cumsum(list(RULES.values()))
    at = int(np.searchsorted(weights, t.rng.integers(weights[-1]), side="right"))
    return list(RULES)[at](t)
