"""Classic CAN on the wire, in simulated time: who may send, how long each frame takes to the bit, what errors do.

Time is an integer number of bits (2 us at 500 kbit/s). A frame starts when the wire has been free for the three bits of
the intermission. Of all nodes whose first queued frame is ready then, the one with the lowest arbitration field sends;
two frames that only differ behind it destroy each other. A frame's bits are the real ones: identifier, control, data,
CRC-15, and a stuff bit after five equal bits.

Faults and counters as ISO 11898-1 has them: a destroyed frame costs its sender 8 points (TEC) and each receiver 1
(REC), is answered by an error frame and sent again; a frame that went well takes a point back. Beyond 127 a node is
error passive (8 bits of pause after its own frames), beyond 255 it is bus-off: it neither sends nor hears until 128
times 11 recessive bits have passed. A node that nobody acknowledges stays error passive. Simplified: all nodes see an
error at the same bit (error flag of 6, delimiter of 8 bits), receivers never see one alone, and a node's counters
change when its frame begins, up to a frame before they would.

Everything works in place on one `Wire` and allocates nothing. Random numbers are drawn only where ``error_rate`` or
``loss`` is not 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.bus.frames import ERROR, EXTENDED, FD, IDENT_MASK, REMOTE
from vaneloop.base.compiled import in_place

__all__ = [
    "ACTIVE", "BITS_PER_TICK", "BIT_RATE", "BUS_OFF", "OWN", "PASSIVE", "Wire", "frame_bits", "new_wire", "put",
    "run_wire", "take",
]  # fmt: skip

BIT_RATE = 500_000
BITS_PER_TICK = 500  # of 1 ms
END = 10  # bits behind the CRC: its delimiter, acknowledge slot and delimiter, end of frame
INTERMISSION = 3
ERROR_FLAG, ERROR_DELIMITER = 6, 8
SUSPEND = 8
RECOVER = 128  # times RECESSIVE bits
RECESSIVE = 11
ACTIVE, PASSIVE, BUS_OFF = range(3)
OWN = 1 << 48  # in word 0 of a received frame: the node's own
NEVER = 1 << 60

# clock: int64[N_CLOCK]
(
    NOW,  # bits: simulated up to here
    FREE,  # the wire is free from here on
    BUSY,  # bits in which it was not
    FRAMES,  # frames that went well
    ERRORS,  # error frames
    RANDOM,
    DESTROY,  # so many of the next matching frames are destroyed
    DESTROY_NODE,  # that these are of this node; -1 = any
    DESTROY_IDENT,  # and carry this identifier; -1 = any
    RESTART,  # 1 = nodes come back from bus-off by themselves
    N_CLOCK,
) = range(11)

# node: int64[nodes, N_NODE]
(
    JOINED,
    TEC,
    REC,
    MODE,
    TO_RECOVER,  # occurrences of 11 recessive bits still to come while bus-off
    PAUSE,  # bit before which an error-passive node does not start again
    WANTS_OWN,
    WANTS_ERRORS,  # error frames are put into its receive buffer
    TX_AT, TX_N,
    RX_AT, RX_N,
    SENT,
    RECEIVED,
    REFUSED,  # frames that the full queue or the bus-off node did not take
    OVERRUN,  # frames that the full receive buffer did not take
    UNTOLD,  # of these, not yet told by an error frame
    LOST,  # by the rate of loss
    BUS_OFFS,
    SILENT,  # listens only: neither acknowledges nor counts errors
    N_NODE,
) = range(21)  # fmt: skip


class Wire(NamedTuple):
    """One bus.

    clock   int64[N_CLOCK]
    chance  float64[2]: probability that a frame is destroyed; that one receiver misses a frame that went well
    node    int64[nodes, N_NODE]
    tx      int64[nodes, queue, 3]: word 0, word 1, ready from (bits)
    rx      int64[nodes, buffer, 3]: word 0, word 1, received at (bits)
    bits    int64[2, 192] scratch
    """

    clock: np.ndarray
    chance: np.ndarray
    node: np.ndarray
    tx: np.ndarray
    rx: np.ndarray
    bits: np.ndarray


def new_wire(
    nodes: int = 8,
    queue: int = 64,
    buffer: int = 1024,
    error_rate: float = 0.0,
    loss: float = 0.0,
    seed: int = 0,
    restart: bool = True,
) -> Wire:
    """Return a free wire with room for ``nodes`` nodes, none of them joined."""
    clock = np.zeros(N_CLOCK, np.int64)
    clock[RANDOM] = (seed * 0x9E3779B1 + 0x6D2B79F5) % 0xFFFFFFFF + 1
    clock[DESTROY_NODE] = clock[DESTROY_IDENT] = -1
    clock[RESTART] = restart
    node = np.zeros((nodes, N_NODE), np.int64)
    tx, rx = np.zeros((nodes, queue, 3), np.int64), np.zeros((nodes, buffer, 3), np.int64)
    return Wire(clock, np.array([error_rate, loss]), node, tx, rx, np.zeros((2, 192), np.int64))


@in_place
def frame_bits(head: int, data: int, out: np.ndarray) -> int:
    """Write a frame's bits from start of frame to CRC, stuff bits included, to ``out``; return their number."""
    extended = head & EXTENDED != 0
    remote = 1 if head & REMOTE else 0
    length = min((head >> 32) & 0xFF, 8)
    ident = head & IDENT_MASK
    crc, n, run, last = 0, 0, 0, 2
    # the plain bits: 0 start, identifier and control, data, CRC
    control = 39 if extended else 19
    plain = control + (0 if remote else 8 * length)
    for k in range(plain + 15):
        if k == 0:
            bit = 0
        elif k >= plain:
            bit = (crc >> (14 - (k - plain))) & 1
        elif k >= control:
            at = k - control
            bit = (data >> (8 * (at // 8) + 7 - at % 8)) & 1
        elif k >= control - 4:
            bit = (length >> (control - 1 - k)) & 1
        elif not extended:
            bit = (ident >> (11 - k)) & 1 if k <= 11 else remote if k == 12 else 0
        elif k <= 11:
            bit = (ident >> (29 - k)) & 1
        elif k <= 13:
            bit = 1
        else:
            bit = (ident >> (31 - k)) & 1 if k <= 31 else remote if k == 32 else 0
        if k < plain:
            feedback = bit ^ (crc >> 14)
            crc = (crc << 1) & 0x7FFF
            if feedback:
                crc ^= 0x4599
        out[n] = bit
        n += 1
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            last = 1 - bit
            out[n] = last
            n += 1
            run = 1
    return n


@in_place
def _priority(head: int) -> int:
    """Return the arbitration field as a number: the lowest wins."""
    ident = head & IDENT_MASK
    remote = 1 if head & REMOTE else 0
    if head & EXTENDED:
        return (ident >> 18) << 21 | 3 << 19 | (ident & 0x3FFFF) << 1 | remote
    return (ident & 0x7FF) << 21 | remote << 20


@in_place
def _random(clock: np.ndarray) -> float:
    """Return the next random number in [0, 1): xorshift, 32 bits."""
    x = clock[RANDOM]
    x ^= (x << 13) & 0xFFFFFFFF
    x ^= x >> 17
    x ^= (x << 5) & 0xFFFFFFFF
    clock[RANDOM] = x
    return x / 4294967296.0


@in_place
def put(wire: Wire, j: int, head: int, data: int) -> bool:
    """Queue a frame of node ``j``, ready now; return False where it was refused: queue full, bus-off, or not a classic
    frame.
    """
    node = wire.node[j]
    full = node[TX_N] >= wire.tx.shape[1] or node[MODE] == BUS_OFF or node[SILENT] != 0
    if full or head & (FD | ERROR) or (head >> 32) & 0xFF > 8:
        node[REFUSED] += 1
        return False
    at = (node[TX_AT] + node[TX_N]) % wire.tx.shape[1]
    wire.tx[j, at, 0], wire.tx[j, at, 1], wire.tx[j, at, 2] = head, data, wire.clock[NOW]
    node[TX_N] += 1
    return True


@in_place
def take(wire: Wire, j: int, rows: np.ndarray) -> int:
    """Move what node ``j`` has received up to now into the first rows of ``rows`` (int64[n, 2 or 3]); return
    how many.
    """
    node = wire.node[j]
    n = 0
    while n < rows.shape[0] and node[RX_N] > 0 and wire.rx[j, node[RX_AT], 2] <= wire.clock[NOW]:
        for q in range(rows.shape[1]):
            rows[n, q] = wire.rx[j, node[RX_AT], q]
        node[RX_AT] = (node[RX_AT] + 1) % wire.rx.shape[1]
        node[RX_N] -= 1
        n += 1
    return n


@in_place
def _push(wire: Wire, j: int, head: int, data: int, at: int) -> None:
    """Put a frame into the receive buffer of node ``j``; where there is no room, count it and say so once there is."""
    node = wire.node[j]
    room = wire.rx.shape[1] - node[RX_N]
    if room < 2 and node[UNTOLD] > 0 or room < 1:
        node[OVERRUN] += 1
        node[UNTOLD] += 1
        return
    for _ in range(2):
        told = node[UNTOLD] == 0
        place = (node[RX_AT] + node[RX_N]) % wire.rx.shape[1]
        wire.rx[j, place, 2] = at
        if told:
            wire.rx[j, place, 0], wire.rx[j, place, 1] = head, data
        else:
            wire.rx[j, place, 0], wire.rx[j, place, 1] = (
                ERROR | 8 << 32 | 0x004,
                1 << 8 | (node[UNTOLD] & 0x7FFFFFFF) << 32,
            )
            node[UNTOLD] = 0
        node[RX_N] += 1
        if told:
            return


@in_place
def _tell(wire: Wire, j: int, kind: int, detail: int, at: int) -> None:
    """Give node ``j`` an error frame of SocketCAN's class ``kind``, if it wants them."""
    if wire.node[j, WANTS_ERRORS]:
        _push(wire, j, ERROR | 8 << 32 | kind, detail << 8, at)


@in_place
def _judge(wire: Wire, j: int, at: int) -> None:
    """Set the mode of node ``j``, which is not bus-off, by its error counters."""
    node = wire.node[j]
    if node[TEC] > 255:
        node[MODE] = BUS_OFF
        node[TO_RECOVER] = RECOVER
        node[BUS_OFFS] += 1
        node[REFUSED] += node[TX_N]
        node[TX_N] = 0
        _tell(wire, j, 0x040, 0, at)
    elif node[TEC] > 127 or node[REC] > 127:
        if node[MODE] == ACTIVE:
            _tell(wire, j, 0x004, 0x20 if node[TEC] > 127 else 0x10, at)
        node[MODE] = PASSIVE
    else:
        node[MODE] = ACTIVE


@in_place
def _recess(wire: Wire, times: int) -> None:
    """Count ``times`` occurrences of 11 recessive bits for the nodes that are bus-off."""
    for j in range(wire.node.shape[0]):
        if wire.node[j, MODE] == BUS_OFF and wire.clock[RESTART]:
            wire.node[j, TO_RECOVER] = max(wire.node[j, TO_RECOVER] - times, 0)


@in_place
def run_wire(wire: Wire, until: int, watch: int) -> None:
    """Simulate up to bit ``until``; with ``watch`` >= 0 stop as soon as that node has something to take. Sets
    clock[NOW].

    A frame that has begun before ``until`` is carried through; its receivers get it at its end, so `take` gives it
    later.
    """
    clock, node, tx, bits = wire.clock, wire.node, wire.tx, wire.bits
    nodes = node.shape[0]
    while True:
        if watch >= 0 and node[watch, RX_N] > 0 and wire.rx[watch, node[watch, RX_AT], 2] <= until:
            clock[NOW] = max(clock[NOW], wire.rx[watch, node[watch, RX_AT], 2])
            return
        free = clock[FREE]
        start, back, who = NEVER, NEVER, -1
        for j in range(nodes):
            if not node[j, JOINED]:
                continue
            if node[j, MODE] == BUS_OFF:
                if clock[RESTART] and free + RECESSIVE * node[j, TO_RECOVER] < back:
                    back, who = free + RECESSIVE * node[j, TO_RECOVER], j
            elif node[j, TX_N] > 0:
                start = min(start, max(free, tx[j, node[j, TX_AT], 2], node[j, PAUSE]))
        if back <= start and back <= until:
            node[who, MODE], node[who, TEC], node[who, REC] = ACTIVE, 0, 0
            _tell(wire, who, 0x100, 0, back)
            continue
        if start >= until:
            clock[NOW] = max(clock[NOW], until)
            return

        # arbitration
        winner, lowest, listeners = -1, NEVER, 0
        for j in range(nodes):
            if not node[j, JOINED] or node[j, MODE] == BUS_OFF:
                continue
            if not node[j, SILENT]:
                listeners += 1
            if node[j, TX_N] > 0 and max(tx[j, node[j, TX_AT], 2], node[j, PAUSE]) <= start:
                priority = _priority(tx[j, node[j, TX_AT], 0])
                if priority < lowest:
                    winner, lowest = j, priority
        head, data = tx[winner, node[winner, TX_AT], 0], tx[winner, node[winner, TX_AT], 1]
        n = frame_bits(head, data, bits[0])
        senders, spoiled, fits = 0, n + END, clock[DESTROY_NODE] < 0
        for j in range(nodes):
            if not _sends(wire, j, start, lowest):
                continue
            senders += 1
            fits = fits or clock[DESTROY_NODE] == j
            at = node[j, TX_AT]
            if j != winner and (tx[j, at, 0] != head or tx[j, at, 1] != data):
                m = frame_bits(tx[j, at, 0], tx[j, at, 1], bits[1])
                for q in range(min(n, m)):
                    if bits[0, q] != bits[1, q]:
                        spoiled = min(spoiled, q + 1)
                        break
        unheard = listeners <= senders
        if unheard:
            spoiled = min(spoiled, n + 2)  # nobody sets the acknowledge bit
        fits = fits and (clock[DESTROY_IDENT] < 0 or clock[DESTROY_IDENT] == head & IDENT_MASK)
        if clock[DESTROY] > 0 and fits:
            clock[DESTROY] -= 1
            spoiled = min(spoiled, n - 7)  # in the CRC
        elif wire.chance[0] > 0.0 and _random(clock) < wire.chance[0]:
            spoiled = min(spoiled, 1 + int(_random(clock) * n))
        unheard = unheard and spoiled == n + 2  # else it ended before anybody could
        _recess(wire, (start - free) // RECESSIVE + 1)

        if spoiled < n + END:
            end = start + spoiled + ERROR_FLAG + ERROR_DELIMITER
            clock[ERRORS] += 1
            for j in range(nodes):
                if not node[j, JOINED] or node[j, MODE] == BUS_OFF:
                    continue
                if _sends(wire, j, start, lowest):
                    if not (unheard and node[j, MODE] == PASSIVE):
                        node[j, TEC] += 8
                    if node[j, MODE] == PASSIVE:
                        node[j, PAUSE] = end + INTERMISSION + SUSPEND
                elif not node[j, SILENT]:
                    node[j, REC] = min(node[j, REC] + 1, 255)
                _tell(wire, j, 0x088, 0, end)
                _judge(wire, j, end)
        else:
            end = start + n + END
            clock[FRAMES] += 1
            for j in range(nodes):
                if not node[j, JOINED] or node[j, MODE] == BUS_OFF:
                    continue
                if _sends(wire, j, start, lowest):
                    node[j, TX_AT] = (node[j, TX_AT] + 1) % tx.shape[1]
                    node[j, TX_N] -= 1
                    node[j, SENT] += 1
                    node[j, TEC] = max(node[j, TEC] - 1, 0)
                    if node[j, MODE] == PASSIVE:
                        node[j, PAUSE] = end + INTERMISSION + SUSPEND
                    if node[j, WANTS_OWN]:
                        _push(wire, j, head | OWN, data, end)
                else:
                    if not node[j, SILENT]:
                        node[j, REC] = 120 if node[j, REC] > 127 else max(node[j, REC] - 1, 0)
                    if wire.chance[1] > 0.0 and _random(clock) < wire.chance[1]:
                        node[j, LOST] += 1
                    else:
                        node[j, RECEIVED] += 1
                        _push(wire, j, head, data, end)
                _judge(wire, j, end)
        clock[FREE] = end + INTERMISSION
        clock[BUSY] += clock[FREE] - start


@in_place
def _sends(wire: Wire, j: int, start: int, priority: int) -> bool:
    """Is node ``j`` one of those that send at ``start`` with this arbitration field?"""
    node = wire.node[j]
    if not node[JOINED] or node[MODE] == BUS_OFF or node[TX_N] == 0:
        return False
    at = node[TX_AT]
    return max(wire.tx[j, at, 2], node[PAUSE]) <= start and _priority(wire.tx[j, at, 0]) == priority
