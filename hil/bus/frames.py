"""The bus's frames in compiled form: `tables/vgv.dbc` as code, E2E protection, and the receiver's judgement of each
frame.

A frame is two int64, 16 bytes laid out as SocketCAN's ``struct can_frame`` (little endian), so that a socket's bytes
are frames already::

    word 0   bits 0..28 identifier, 29 error frame, 30 remote, 31 extended; bits 32..39 length; bit 42 CAN FD
    word 1   the eight bytes of data, the first in the lowest bits

Protection is AUTOSAR E2E profile 1: byte 0 is CRC-8 SAE J1850 over both bytes of the DataID and bytes 1 to 7, the low
nibble of byte 1 a counter 0 to 14. The layout is tested against cantools and the autosar-e2e library over random
values; the DBC is the reference.

Physical values are in the DBC's units. Encoding takes the nearest step, holds values at the DBC's limits, and sends a
NaN as the signal's "not available". Everything here works in place and allocates nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.logs.signals import crc_table
from vaneloop.base.compiled import in_place
from vaneloop.base.vanes import VANES

if TYPE_CHECKING:
    import can

__all__ = [
    "ANGLES", "AUTH", "AUTH_NAMES", "COUNTS", "ECU_DEMAND", "ERROR", "EXTENDED", "FD", "FRAMES", "FRESHNESS", "NAMES",
    "PAUSE", "PREPARED", "REMOTE", "SEEDS", "SPEED_STEP", "UNAUTHENTIC", "VGV_ANGLES", "VGV_ANGLES_2", "VGV_ANGLES_3",
    "VGV_HEALTH", "VGV_SERVO", "VGV_STATUS", "decode", "decode_auth", "encode_auth", "from_bytes", "from_message",
    "new_receiver", "passes", "raw_speed", "receive", "refused", "speed_of", "stand_still", "to_bytes", "to_message",
    "with_demand", "word0",
]  # fmt: skip

EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
HEAD_MASK = 0x04FFFFFFFFFF  # what of word 0 has a meaning
FD = 1 << 42  # bit 2 of the flags byte, CANFD_FDF
NOTE = 1 << 56  # no frame: the loop's own word to its node. No bus gives it: it is outside `HEAD_MASK`
UNAUTHENTIC = 1 << 57  # a frame that its MAC does not prove (`hil.bus.secoc`); no bus gives it either
IDENT_MASK = (1 << 29) - 1
LENGTH = 8  # bytes of data of every frame here
SPEED_STEP = 0.002  # %, of a speed in ECU_DEMAND
CLASSIC = LENGTH << 32  # word 0 without its identifier

NAMES = {
    0x0A0: "ECU_DEMAND", 0x0B0: "VGV_STATUS", 0x0B1: "VGV_SERVO", 0x0B2: "VGV_ANGLES", 0x0B3: "VGV_HEALTH",
    0x0B4: "VGV_ANGLES_2", 0x0B5: "VGV_ANGLES_3",
}  # fmt: skip
ECU_DEMAND, VGV_STATUS, VGV_SERVO, VGV_ANGLES, VGV_HEALTH, VGV_ANGLES_2, VGV_ANGLES_3 = NAMES
PERIOD = {ident: 100 if ident == VGV_HEALTH else 10 for ident in NAMES}  # ticks of 1 ms
IN_FRAME = 3  # angles of a frame
ANGLES = {  # identifier -> the stages whose angles it carries; sent by a machine that has the first of them
    ident: VANES[IN_FRAME * q : IN_FRAME * (q + 1)] for q, ident in enumerate((VGV_ANGLES, VGV_ANGLES_2, VGV_ANGLES_3))
}
DATA_ID = 0x5600  # plus the identifier
AUTH = 8  # what the identifier of a frame's authentication frame (freshness and MAC, `hil.bus.secoc`) is greater by
AUTH_NAMES = {ident + AUTH: f"{name}_AUTH" for ident, name in NAMES.items()}

_CRC = crc_table().astype(np.int64)
_CRC.setflags(write=False)

# Notes: the loop's own words to its node among a tick's frames. In a record they are on a channel of their own
# (`hil.logs.record_formats`), so no frame of the bus is ever taken for one, whatever its identifier.
# "this node stood still before this tick": word 1 is for how many ticks
PAUSE = NOTE | EXTENDED | CLASSIC | 0x1FFFFF50
# "work for a tool is done, and takes effect before this tick" (`hil.calibrate.prepare`): word 1 is its number
PREPARED = NOTE | EXTENDED | CLASSIC | 0x1FFFFF51
# "the freshness value of this tick" (`hil.loop.secured`): word 1 is the value
FRESHNESS = NOTE | EXTENDED | CLASSIC | 0x1FFFFF52
# "the seeds of the tools' locks follow from word 1" (`hil.calibrate.lock`)
SEEDS = NOTE | EXTENDED | CLASSIC | 0x1FFFFF53


# ---- bits ------------------------------------------------------------------------------------------------------------


@in_place
def word0(ident: int) -> int:
    """Return word 0 of a classic data frame of eight bytes."""
    return CLASSIC | ident


@in_place
def crc(ident: int, data: int) -> int:
    """Return the E2E CRC of ``data`` (word 1) sent under ``ident``; byte 0 is the CRC's own place and does not
    count.
    """
    data_id = DATA_ID + ident
    c = _CRC[_CRC[data_id & 0xFF] ^ (data_id >> 8)]
    for k in range(1, 8):
        c = _CRC[c ^ ((data >> (8 * k)) & 0xFF)]
    return c


@in_place
def protect(ident: int, data: int, counter: int) -> int:
    """Return ``data`` (word 1) with ``counter`` (0..14) and the CRC in their places."""
    data = (data & ~0xFFF) | (counter << 8)
    return data | crc(ident, data)


@in_place
def u16(data: int, at: int) -> int:
    """Return the unsigned 16-bit number that starts at bit ``at``."""
    return (data >> at) & 0xFFFF


@in_place
def s16(data: int, at: int) -> int:
    """Return the signed 16-bit number that starts at bit ``at``."""
    return ((data >> at) & 0xFFFF ^ 0x8000) - 0x8000


@in_place
def _raw(value: float, scale: float, offset: float, low: float, high: float, none: int) -> int:
    """Return the nearest raw value of ``value`` held within ``low``..``high`` (physical); ``none`` for a NaN."""
    if value != value:
        return none
    return int(np.rint((min(max(value, low), high) - offset) / scale))


@in_place
def _at(raw: int, at: int) -> int:
    """Return 16 bits at bit ``at`` of a word; at bit 48 the sign goes along, so that the word stays within an int64."""
    raw &= 0xFFFF
    if at == 48:
        raw = (raw ^ 0x8000) - 0x8000
    return raw << at


# ---- frames ----------------------------------------------------------------------------------------------------------


@in_place
def raw_speed(speed: float) -> int:
    """Return the 16 bits that ECU_DEMAND has for a speed (%)."""
    return _raw(speed, SPEED_STEP, 0.0, 0.0, 125.0, 65535) & 0xFFFF


@in_place
def speed_of(raw: int) -> float:
    """Return the speed (%) of 16 bits of ECU_DEMAND."""
    return raw * SPEED_STEP


@in_place
def encode_demand(n_dem: float, n_r: float, mode_request: int, counter: int) -> int:
    """Return word 1 of ECU_DEMAND: speeds in %, ``mode_request`` 0 or 1."""
    data = (mode_request & 3) << 12
    data |= _at(raw_speed(n_dem), 16) | _at(raw_speed(n_r), 32)
    return protect(ECU_DEMAND, data, counter)


@in_place
def decode_demand(data: int) -> tuple[float, float, int]:
    """Return n_dem (%), n_r (%) and mode_request of word 1 of ECU_DEMAND."""
    return speed_of(u16(data, 16)), speed_of(u16(data, 32)), (data >> 12) & 3


@in_place
def encode_status(x_dem: float, x_lvdt: float, state: int, counter: int) -> int:
    """Return word 1 of VGV_STATUS: strokes in mm."""
    data = (state & 15) << 12
    data |= _at(_raw(x_dem, 0.001, -8.0, -5.0, 55.0, 65535), 16) | _at(_raw(x_lvdt, 0.001, -8.0, -5.0, 55.0, 65535), 32)
    return protect(VGV_STATUS, data, counter)


@in_place
def decode_status(data: int) -> tuple[float, float, int]:
    """Return x_dem (mm), x_lvdt (mm) and state of word 1 of VGV_STATUS."""
    return u16(data, 16) * 0.001 - 8.0, u16(data, 32) * 0.001 - 8.0, (data >> 12) & 15


@in_place
def encode_servo(i_cmd: float, faults: int, counter: int) -> int:
    """Return word 1 of VGV_SERVO: mean current in mA, nine fault bits."""
    data = _at(_raw(i_cmd, 0.002, 0.0, -50.0, 50.0, -32768), 16) | ((faults & 0x1FF) << 32)
    return protect(VGV_SERVO, data, counter)


@in_place
def decode_servo(data: int) -> tuple[float, int]:
    """Return i_cmd (mA) and the fault bits of word 1 of VGV_SERVO."""
    return s16(data, 16) * 0.002, (data >> 32) & 0x1FF


@in_place
def encode_angles(first: float, second: float, third: float, counter: int, ident: int = VGV_ANGLES) -> int:
    """Return word 1 of VGV_ANGLES, or of VGV_ANGLES_2 or VGV_ANGLES_3: degrees; NaN for a stage that is not there."""
    if ident == VGV_ANGLES_3:  # two stages; the rest of the frame is no signal's
        third = 0.0
    data = _at(_raw(first, 0.002, 0.0, -60.0, 60.0, -32768), 16)
    data |= _at(_raw(second, 0.002, 0.0, -60.0, 60.0, -32768), 32)
    data |= _at(_raw(third, 0.002, 0.0, -60.0, 60.0, -32768), 48)
    return protect(ident, data, counter)


@in_place
def _angle(data: int, at: int) -> float:
    raw = s16(data, at)
    return np.nan if raw == -32768 else raw * 0.002


@in_place
def decode_angles(data: int) -> tuple[float, float, float]:
    """Return the three angles (deg) of word 1 of VGV_ANGLES or its like; NaN for one that is not available."""
    return _angle(data, 16), _angle(data, 32), _angle(data, 48)


@in_place
def encode_health(p_s: float, t_oil: float, lost: int, rejected: int, counter: int) -> int:
    """Return word 1 of VGV_HEALTH: supply in MPa, oil in degC; the counts stay at 255."""
    data = _at(_raw(p_s, 0.001, 0.0, 0.0, 40.0, 65535), 16) | _at(_raw(t_oil, 0.01, 0.0, -60.0, 200.0, -32768), 32)
    data |= _at(min(lost, 255) | min(rejected, 255) << 8, 48)
    return protect(VGV_HEALTH, data, counter)


@in_place
def decode_health(data: int) -> tuple[float, float, int, int]:
    """Return p_s (MPa), t_oil (degC), frames lost and frames rejected of word 1 of VGV_HEALTH."""
    return u16(data, 16) * 0.001, s16(data, 32) * 0.01, (data >> 48) & 0xFF, (data >> 56) & 0xFF


@in_place
def encode_auth(freshness: int, mac: int) -> int:
    """Return word 1 of an authentication frame: the low 32 bits of the freshness value, and the MAC's first 32 bits
    as a number whose lowest byte is the MAC's first.
    """
    return (freshness & 0xFFFFFFFF) | ((mac & 0xFFFFFFFF ^ 0x80000000) - 0x80000000) << 32


@in_place
def decode_auth(data: int) -> tuple[int, int]:
    """Return the low 32 bits of the freshness value, and the MAC, of word 1 of an authentication frame."""
    return data & 0xFFFFFFFF, (data >> 32) & 0xFFFFFFFF


# ---- receiver --------------------------------------------------------------------------------------------------------

MAX_DELTA = 5  # steps of the counter that are taken for loss; more within the time limit is a wrong sequence
MISSED = 5  # periods without a good frame: stale. The firmware's demand_timeout of 50 ms is the same for ECU_DEMAND.

# verdicts on a frame
GOOD, SYNC, WRONG_CRC, REPEATED, WRONG_SEQUENCE, WRONG_LENGTH, WRONG_KIND, OTHER, NOT_AUTHENTIC = range(9)
VERDICTS = (
    "good", "sync", "wrong_crc", "repeated", "wrong_sequence", "wrong_length", "wrong_kind", "other", "unauthentic",
)  # fmt: skip

# a receiver: int64[N_RECEIVER]; the first seven count verdicts
COUNTS = ("good", "sync", "wrong_crc", "repeated", "wrong_sequence", "wrong_length", "wrong_kind", "lost", "stale")
(
    R_GOOD,  # frames taken
    R_SYNC,  # first frames after start or silence: they show where the counter is, their values are not used
    R_WRONG_CRC,
    R_REPEATED,
    R_WRONG_SEQUENCE,
    R_WRONG_LENGTH,
    R_WRONG_KIND,  # extended, remote or CAN FD under our identifier
    R_LOST,  # sent and not come, as the counter proves; in a silence it proves nothing
    R_STALE,  # silences
    R_IDENT,
    R_LAST,  # counter of the last good frame, -1 none
    R_LAST_TICK,
    R_CANDIDATE,  # counter of a frame out of sequence with a right CRC, -1 none
    R_CANDIDATE_TICK,
    R_SILENT,  # periods of the present silence; 0 = not stale
    R_PERIOD,  # ticks
    R_UNAUTHENTIC,  # without a MAC that proves them; always 0 where frames are not authenticated
    N_RECEIVER,
) = range(18)


def new_receiver(ident: int) -> np.ndarray:
    """Return the state of a receiver of ``ident`` that has heard nothing yet."""
    r = np.zeros(N_RECEIVER, np.int64)
    r[R_IDENT], r[R_PERIOD] = ident, PERIOD[ident]
    r[R_LAST] = r[R_CANDIDATE] = -1
    return r


@in_place
def receive(r: np.ndarray, head: int, data: int, now: int) -> int:
    """Judge a frame that came at tick ``now`` (ms); return the verdict. Only after GOOD may its values be used.

    A counter that has gone on by 1..MAX_DELTA since the last good frame is good; what lies between is lost. After
    MISSED periods without a good frame a sender may have started anew: a right frame then becomes the candidate, and
    the next that goes on from it is good. So a sender that only repeats a frame is never believed, however long. A
    frame of another sender is good where its counter is 1..MAX_DELTA ahead: one recorded frame in three.
    """
    if head & ERROR or head & IDENT_MASK != r[R_IDENT]:
        return OTHER
    if head & (EXTENDED | REMOTE | FD | UNAUTHENTIC):
        if head & UNAUTHENTIC:
            r[R_UNAUTHENTIC] += 1
            return NOT_AUTHENTIC
        r[R_WRONG_KIND] += 1
        return WRONG_KIND
    if (head >> 32) & 0xFF != LENGTH:
        r[R_WRONG_LENGTH] += 1
        return WRONG_LENGTH
    if crc(r[R_IDENT], data) != data & 0xFF:
        r[R_WRONG_CRC] += 1
        return WRONG_CRC
    counter = (data >> 8) & 15
    if counter == 15:
        r[R_WRONG_SEQUENCE] += 1
        return WRONG_SEQUENCE
    limit = MISSED * r[R_PERIOD]
    silent = r[R_LAST] < 0 or r[R_SILENT] > 0
    known = r[R_CANDIDATE] >= 0 and now - r[R_CANDIDATE_TICK] <= limit
    before = r[R_CANDIDATE] if silent else r[R_LAST]
    step = (counter - before + 15) % 15
    if 1 <= step <= MAX_DELTA and (known or not silent):
        r[R_LOST] += step - 1
        r[R_GOOD] += 1
        r[R_LAST], r[R_LAST_TICK] = counter, now
        r[R_CANDIDATE] = -1
        r[R_SILENT] = 0
        return GOOD
    r[R_CANDIDATE], r[R_CANDIDATE_TICK] = counter, now
    if step == 0 and (known or not silent):
        r[R_REPEATED] += 1
        return REPEATED
    if silent and not known:
        r[R_SYNC] += 1
        return SYNC
    r[R_WRONG_SEQUENCE] += 1
    return WRONG_SEQUENCE


@in_place
def grow_old(r: np.ndarray, now: int) -> bool:
    """State a silence of MISSED periods at tick ``now``, after the frames of the tick; return True while it lasts. It
    loses nothing.
    """
    if r[R_LAST] < 0:
        return False
    missed = (now - r[R_LAST_TICK]) // r[R_PERIOD]
    if missed < MISSED:
        return r[R_SILENT] > 0
    if r[R_SILENT] == 0:
        r[R_STALE] += 1
    r[R_SILENT] = missed
    return True


@in_place
def stand_still(r: np.ndarray) -> None:
    """Forget where the sender's counter was: its receiver stood still, and what came meanwhile is gone. Begins a
    silence.
    """
    if r[R_LAST] >= 0 and r[R_SILENT] == 0:
        r[R_STALE] += 1
        r[R_SILENT] = MISSED
    r[R_CANDIDATE] = -1


@in_place
def refused(r: np.ndarray) -> int:
    """Return how many frames were refused since start."""
    bad = r[R_WRONG_CRC] + r[R_REPEATED] + r[R_WRONG_SEQUENCE] + r[R_WRONG_LENGTH] + r[R_WRONG_KIND]
    return bad + r[R_UNAUTHENTIC]


def with_demand(rows: np.ndarray, of: Callable[[float, float, int], tuple[float, float, int] | None]) -> np.ndarray:
    """Return a copy of frames in which the ECU's good ones carry what ``of`` makes of their n_dem, n_r (%) and
    mode_request; None leaves a frame as it is.
    """
    rows = rows.copy()
    for row in rows:
        head, data = int(row[0]), int(row[1])
        if head & IDENT_MASK == ECU_DEMAND and crc(ECU_DEMAND, data) == data & 0xFF:
            given = of(*decode_demand(data))
            if given is not None:
                row[1] = encode_demand(*given, data >> 8 & 15)
    return rows


# ---- the same for people ---------------------------------------------------------------------------------------------

# identifier -> (decoder, signal names)
FRAMES: dict[int, tuple[Any, tuple[str, ...]]] = {
    ECU_DEMAND: (decode_demand, ("n_dem", "n_r", "mode_request")),
    VGV_STATUS: (decode_status, ("x_dem", "x_lvdt", "state")),
    VGV_SERVO: (decode_servo, ("i_cmd", "faults")),
    VGV_HEALTH: (decode_health, ("p_s", "t_oil", "frames_lost", "frames_rejected")),
    **{ident: (decode_angles, vanes) for ident, vanes in ANGLES.items()},
    **dict.fromkeys(AUTH_NAMES, (decode_auth, ("freshness", "mac"))),
}


def decode(head: int, data: int) -> dict[str, float]:
    """Return the signals of one frame by name, in the DBC's units; empty for a frame that is not one of ours."""
    if head & (EXTENDED | REMOTE | ERROR | FD) or (head >> 32) & 0xFF != LENGTH or head & IDENT_MASK not in FRAMES:
        return {}
    decoder, names = FRAMES[head & IDENT_MASK]
    return dict(zip(names, decoder(data), strict=False))  # VGV_ANGLES_3 has two angles


def from_bytes(raw: bytes) -> np.ndarray:
    """Return the frames (int64[n, 2]) in bytes laid out as ``struct can_frame``."""
    return np.frombuffer(raw, "<i8").reshape(-1, 2)


def to_bytes(rows: np.ndarray) -> list[bytes]:
    """Return each frame as the 16 bytes of ``struct can_frame``."""
    raw = np.ascontiguousarray(rows, "<i8").tobytes()
    return [raw[k : k + 16] for k in range(0, len(raw), 16)]


def from_message(message: can.Message) -> tuple[int, int]:
    """Return both words of a python-can message; of a CAN FD frame's data the first eight bytes."""
    flags = (EXTENDED if message.is_extended_id else 0) | (REMOTE if message.is_remote_frame else 0)
    if message.is_error_frame:
        flags = ERROR
    length = message.dlc if message.is_remote_frame else len(message.data)
    head = message.arbitration_id & IDENT_MASK | flags | min(length, 64) << 32 | (FD if message.is_fd else 0)
    return head, int.from_bytes(bytes(message.data[:8]).ljust(8, b"\0"), "little", signed=True)


def passes(filters: Any, head: int) -> bool:
    """Whether acceptance filters (python-can's ``can_filters``; None: there are none) let a frame with this word 0
    through. An error frame passes all, as in SocketCAN.
    """
    if filters is None or head & ERROR:
        return True
    ident, extended = head & IDENT_MASK, bool(head & EXTENDED)
    return any(not (ident ^ f["can_id"]) & f["can_mask"] and f.get("extended", extended) == extended for f in filters)


def to_message(
    head: int, data: int, timestamp: float = 0.0, channel: str | None = None, is_rx: bool = True
) -> can.Message:
    """Return a frame as a python-can message."""
    import can

    head, data = int(head), int(data)
    length = (head >> 32) & 0xFF
    remote = bool(head & REMOTE)
    return can.Message(
        timestamp=timestamp,
        arbitration_id=head & IDENT_MASK,
        is_extended_id=bool(head & EXTENDED),
        is_remote_frame=remote,
        is_error_frame=bool(head & ERROR),
        is_fd=bool(head & FD),
        channel=channel,
        dlc=length,
        data=None if remote else data.to_bytes(8, "little", signed=True)[:length].ljust(length, b"\0"),
        is_rx=is_rx,
    )
