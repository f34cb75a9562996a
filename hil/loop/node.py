"""The two nodes on the bus, tick by tick: controller with its plant (VGV), and the engine control unit (ECU).

A node takes the frames that came since its last tick and gives the frames to send. It has no clock and no bus, so that
the real-time loop, the lockstep bus and fault injection run the very same compiled tick; a run whose received frames
were kept tick by tick is repeated bit for bit by `replay`. Frames are rows of two int64 (`hil.bus.frames`).

One tick k of the VGV node, at t = k ms::

    judge the received frames in order of arrival; the values of the last good ECU_DEMAND count
    sample the sensors at t, run the firmware
    every 10th tick   VGV_STATUS, VGV_SERVO (mean current since the last one), VGV_ANGLES;   every 100th   VGV_HEALTH;
                      every 10th   VGV_ANGLES_2 and VGV_ANGLES_3, where the machine has stages for them
    the plant moves on to t + 1 ms under the new current
"""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import numpy as np

from controller import MODES, Calibration, load_calibration
from controller.records import SLOW, as_inputs, as_outputs, as_scalars
from hil.bus import frames
from hil.bus.frames import (
    ECU_DEMAND,
    ERROR,
    GOOD,
    IDENT_MASK,
    IN_FRAME,
    N_RECEIVER,
    OTHER,
    PAUSE,
    VGV_ANGLES,
    VGV_ANGLES_2,
    VGV_ANGLES_3,
    VGV_HEALTH,
    VGV_SERVO,
    VGV_STATUS,
    decode_demand,
    encode_angles,
    encode_demand,
    encode_health,
    encode_servo,
    encode_status,
    grow_old,
    new_receiver,
    receive,
    refused,
    stand_still,
)
from hil.loop.tick import Loop, arrive, control, mean_current, move, new_loop
from plant import Plant, build_plant, chain, places
from vaneloop.base.compiled import in_place
from vaneloop.base.vanes import VANES

__all__ = ["Ecu", "EcuArrays", "Node", "NodeArrays", "ecu_tick", "node_tick", "replay", "run_ticks"]

MOST_SENT = 6  # frames of one tick
BLOCK = 100  # ticks of sensor noise drawn at a time
DEGREES = 180.0 / np.pi

# counters of a node: int64[N_COUNTER]
(C_STATUS, C_SERVO, C_ANGLES, C_HEALTH, C_OTHER, C_OURS, C_ERROR_FRAMES, C_ANGLES_2, C_ANGLES_3, N_COUNTER) = range(10)


class NodeArrays(NamedTuple):
    """All that the VGV node's tick works on, in place.

    loop        the closed loop's (`hil.loop.tick.Loop`)
    supply      float64[4] supply pressure (Pa), oil temperature (degC); demand and speed (%) of the machine: the last
                plausible frame's
    receiver    int64, of ECU_DEMAND (`hil.bus.frames`)
    counter     int64: E2E counters of the frames sent; frames of other identifiers, under our own identifiers, error
                frames
    """

    loop: Loop
    supply: np.ndarray
    receiver: np.ndarray
    counter: np.ndarray


@in_place
def _take(a: NodeArrays, received: np.ndarray, n: int, k: int) -> None:
    """Judge the ``n`` received frames of tick ``k``, and the loop's word that it stood still; set the firmware's
    inputs.
    """
    before = refused(a.receiver)
    fresh = pause = 0.0
    n_dem = n_r = 0.0
    request = 0
    for i in range(n):
        head, data = received[i, 0], received[i, 1]
        if head == PAUSE:
            pause += data * chain.TICK
            stand_still(a.receiver)
            continue
        verdict = receive(a.receiver, head, data, k)
        if verdict == GOOD:
            n_dem, n_r, request = decode_demand(data)
            fresh = 1.0
        elif verdict == OTHER:
            ident = head & IDENT_MASK
            if head & ERROR:
                a.counter[C_ERROR_FRAMES] += 1
            elif VGV_STATUS <= ident <= _last_ident(a.loop.angles.shape[0]):
                a.counter[C_OURS] += 1
            else:
                a.counter[C_OTHER] += 1
    grow_old(a.receiver, k)
    if fresh == 1.0:
        arrive(k, a.loop, n_dem, n_r, float(request))
        k_of = as_scalars(a.loop.calibration.k)
        low, high = k_of.demand_low, k_of.demand_high
        if low <= n_dem <= high and low <= n_r <= high and request <= 1:
            a.supply[2], a.supply[3] = n_dem, n_r
    inputs = as_inputs(a.loop.inputs)
    inputs.demand_fresh = fresh
    inputs.pause = pause
    inputs.demand_rejected = float(refused(a.receiver) - before)


@in_place
def _last_ident(stages: int) -> int:
    """Return the last identifier under which a machine with so many stages sends; the first is VGV_STATUS."""
    return VGV_HEALTH + (stages - 1) // IN_FRAME


@in_place
def _angle(angles: np.ndarray, k: int) -> float:
    """Return the angle of stage ``k`` in deg; NaN where the machine has no such stage."""
    return angles[k] * DEGREES if k < angles.shape[0] else np.nan


@in_place
def _put_angles(sent: np.ndarray, m: int, ident: int, angles: np.ndarray, k: int, counter: int) -> int:
    """Put the frame with the angles of stages ``k`` to ``k`` + 2."""
    data = encode_angles(_angle(angles, k), _angle(angles, k + 1), _angle(angles, k + 2), counter, ident)
    return _put(sent, m, ident, data)


@in_place
def _next(counter: np.ndarray, which: int) -> int:
    """Return the E2E counter for a frame to send, and count on."""
    now = counter[which]
    counter[which] = (now + 1) % 15
    return now


@in_place
def _put(sent: np.ndarray, m: int, ident: int, data: int) -> int:
    sent[m, 0], sent[m, 1] = frames.word0(ident), data
    return m + 1


@in_place
def node_tick(
    k: int, received: np.ndarray, n: int, noise: np.ndarray, row: int, a: NodeArrays, sent: np.ndarray
) -> int:
    """Run tick ``k`` of the VGV node on the first ``n`` rows of ``received``; write the frames to send and return their
    number.

    received  int64[>= n, 2] in order of arrival
    noise     float64[:, 2 + stages] standard normal numbers, of this tick those in ``row``
    a         `NodeArrays`
    sent      int64[MOST_SENT, 2]
    """
    _take(a, received, n, k)
    loop, p_s, t_oil = a.loop, a.supply[0], a.supply[1]
    out, fed = as_outputs(loop.outputs), as_inputs(loop.inputs)
    control(k, loop, noise, row, t_oil)
    m = 0
    if k % SLOW == 0:
        c = a.counter
        m = _put(
            sent, m, VGV_STATUS, encode_status(out.x_dem * 1e3, fed.x_lvdt * 1e3, int(out.mode), _next(c, C_STATUS))
        )
        m = _put(sent, m, VGV_SERVO, encode_servo(mean_current(loop) * 1e3, int(out.faults), _next(c, C_SERVO)))
        angles = loop.angles
        m = _put_angles(sent, m, VGV_ANGLES, angles, 0, _next(c, C_ANGLES))
        if k % (10 * SLOW) == 0:
            lost, rejected = a.receiver[frames.R_LOST], refused(a.receiver)
            m = _put(sent, m, VGV_HEALTH, encode_health(p_s * 1e-6, t_oil, lost, rejected, _next(c, C_HEALTH)))
        if angles.shape[0] > IN_FRAME:
            m = _put_angles(sent, m, VGV_ANGLES_2, angles, IN_FRAME, _next(c, C_ANGLES_2))
        if angles.shape[0] > 2 * IN_FRAME:
            m = _put_angles(sent, m, VGV_ANGLES_3, angles, 2 * IN_FRAME, _next(c, C_ANGLES_3))
    move(k, loop, a.supply[2], a.supply[3], p_s, t_oil)
    return m


class Node:
    """Controller and plant as one node on the bus.

    plant, calibration  default: the shipped tables
    n_r      %, rotor speed at which the machine stands still at the start, its stroke on the mean curve
    p_s, t_oil  supply pressure (Pa) and oil temperature (degC); change ``arrays.supply`` later
    seed     of the sensors' noise; None = noise-free
    k        the next tick (1 ms each)
    stride   ticks that may be run before `moved` is called
    plant    the machine
    loop     what its tick works on: the firmware's inputs, state and calibration, the plant's state and parameters
    """

    stride = BLOCK

    def __init__(
        self,
        plant: Plant | None = None,
        calibration: Calibration | None = None,
        *,
        n_r: float = 60.0,
        p_s: float = 21e6,
        t_oil: float = 40.0,
        seed: int | None = None,
    ):
        self.plant = machine = plant or build_plant()
        cal = calibration or load_calibration()
        pots = np.array([[1.0, 0.0] * len(machine.vanes)])
        self.loop = new_loop(machine, cal, n_engine=n_r, n_r=n_r, t_oil=t_oil, noisy=seed is not None, pots=pots)
        self.arrays = NodeArrays(
            self.loop, np.array([p_s, t_oil, n_r, n_r]), new_receiver(ECU_DEMAND), np.zeros(N_COUNTER, np.int64)
        )
        self.k = 0
        self._sent = np.zeros((MOST_SENT, 2), np.int64)
        self._generator = np.random.Generator(np.random.PCG64(seed)) if seed is not None else None
        self._noise = np.zeros((BLOCK, len(machine.sigma)))

    def noise(self) -> tuple[np.ndarray, int]:
        """Return standard normal numbers and the row of the next tick in them."""
        row = self.k % BLOCK
        if row == 0 and self._generator is not None:
            self._generator.standard_normal(out=self._noise)
        return self._noise, row

    def tick(self, received: np.ndarray, n: int | None = None) -> np.ndarray:
        """Run the next tick on the first ``n`` rows of ``received`` (int64[:, 2]); return the frames to send.

        The frames are a view that the next tick overwrites.
        """
        k = self.k
        noise, row = self.noise()
        m = node_tick(k, received, len(received) if n is None else n, noise, row, self.arrays, self._sent)
        self.k = k + 1
        self.moved()
        return self._sent[:m]

    def moved(self) -> None:
        """Called after every `stride` ticks: a plant that is simulated elsewhere moves on."""

    @property
    def mode(self) -> str:
        """Mode of the controller."""
        return MODES[int(self.loop.given.mode)]

    @property
    def faults(self) -> int:
        """Fault bits that stand now (`controller.FAULTS`)."""
        return int(self.loop.given.faults)

    @property
    def counts(self) -> dict[str, int]:
        """What the receiver has counted: `hil.bus.frames.COUNTS`, frames of others, under our own identifiers, and
        error frames.
        """
        out = {name: int(v) for name, v in zip(frames.COUNTS, self.arrays.receiver, strict=False)}
        for name, at in (("other", C_OTHER), ("own_identifier", C_OURS), ("error_frames", C_ERROR_FRAMES)):
            out[name] = int(self.arrays.counter[at])
        out["unauthentic"] = int(self.arrays.receiver[frames.R_UNAUTHENTIC])
        return out

    def fingerprint(self) -> str:
        """Return the SHA-256 of the whole state that the machine has: firmware, plant, receiver, counters."""
        digest = hashlib.sha256()
        a, loop = self.arrays, self.loop
        counters = a.counter[: C_ANGLES_2 + (len(loop.angles) - 1) // IN_FRAME]
        receiver = a.receiver if a.receiver[frames.R_UNAUTHENTIC] else a.receiver[: frames.R_UNAUTHENTIC]
        pair = (loop.pair.memory,) if loop.pair else ()
        for part in (loop.z[loop.z_rows], loop.s[loop.s_rows], loop.mean, receiver, counters, *pair):
            digest.update(part.tobytes())
        return digest.hexdigest()


@in_place
def run_ticks(
    k0: int,
    ticks: int,
    at: np.ndarray,
    received: np.ndarray,
    first: int,
    noise: np.ndarray,
    row: int,
    a: NodeArrays,
    out: np.ndarray,
    out_tick: np.ndarray,
    scratch: np.ndarray,
) -> tuple[int, int]:
    """Run ``ticks`` ticks of the VGV node from tick ``k0`` on recorded frames.

    at, received   int64[n] tick of each frame, in order, and int64[n, 2] the frames; ``first`` is the first row not yet
                   taken
    noise, row     float64[:, 2 + stages] standard normal numbers, and the row of tick ``k0``
    out, out_tick  int64[m, 2] and int64[m]: the frames sent and their ticks; m >= MOST_SENT for each 10 ticks begun
    scratch        int64[MOST_SENT, 2]

    Returns how many frames were sent and the first row not taken.
    """
    m = 0
    for i in range(ticks):
        k = k0 + i
        last = first
        while last < len(at) and at[last] <= k:
            last += 1
        n = node_tick(k, received[first:last], last - first, noise, row + i, a, scratch)
        first = last
        for q in range(n):
            out[m, 0], out[m, 1], out_tick[m] = scratch[q, 0], scratch[q, 1], k
            m += 1
    return m, first


def replay(node: Node, at: np.ndarray, received: np.ndarray, ticks: int) -> tuple[np.ndarray, np.ndarray]:
    """Run ``node`` for ``ticks`` ticks on recorded frames; return the ticks (int64[m]) and the frames (int64[m, 2])
    that it sent.

    at        int64[n], tick in which each frame was taken, not decreasing
    received  int64[n, 2], the frames
    A node made and fed as the recorded one was gives the same frames and the same `Node.fingerprint`, bit for bit.
    """
    out_at, out = [], []
    first = 0
    at, received = np.ascontiguousarray(at, np.int64), np.ascontiguousarray(received, np.int64).reshape(-1, 2)
    end = node.k + ticks
    while node.k < end:
        n = min(BLOCK - node.k % BLOCK, end - node.k, node.stride)
        noise, row = node.noise()
        most = MOST_SENT * (n // SLOW + 1)
        some, some_at = np.empty((most, 2), np.int64), np.empty(most, np.int64)
        m, first = run_ticks(node.k, n, at, received, first, noise, row, node.arrays, some, some_at, node._sent)
        node.k += n
        node.moved()
        out.append(some[:m])
        out_at.append(some_at[:m])
    return np.concatenate(out_at or [np.empty(0, np.int64)]), np.concatenate(out or [np.empty((0, 2), np.int64)])


# ---- ECU -------------------------------------------------------------------------------------------------------------


class EcuArrays(NamedTuple):
    """All that the ECU's tick works on, in place.

    s, p       the engine's state and parameters (`plant.chain`)
    demand     float64[3] n_dem (%), n_r (%; NaN = the engine model's), mode_request; set them before a tick
    sigma      float64[1] rms noise of the measured speed, %
    receiver   int64[6, :] of VGV_STATUS, VGV_SERVO, VGV_ANGLES, VGV_HEALTH, VGV_ANGLES_2, VGV_ANGLES_3
    values     float64[17] last good values, `ECU_VALUES`, in the units of the DBC; NaN = not available
    counter    int64[1] E2E counter
    """

    s: np.ndarray
    p: np.ndarray
    demand: np.ndarray
    sigma: np.ndarray
    receiver: np.ndarray
    values: np.ndarray
    counter: np.ndarray


ECU_VALUES = (
    "x_dem", "x_lvdt", "state", "i_cmd", "faults", *VANES[:IN_FRAME], "p_s", "t_oil", "frames_lost", "frames_rejected",
    *VANES[IN_FRAME:],
)  # fmt: skip


@in_place
def _listen(a: EcuArrays, head: int, data: int, k: int) -> None:
    """Judge one frame of the controller; keep its values if it is good. After a pause of the ECU none is known to be
    new.
    """
    if head == PAUSE:
        for row in range(a.receiver.shape[0]):
            stand_still(a.receiver[row])
        return
    ident = head & IDENT_MASK
    if not VGV_STATUS <= ident <= VGV_ANGLES_3:
        return
    row = ident - VGV_STATUS
    if receive(a.receiver[row], head, data, k) != GOOD:
        return
    v = a.values
    if row == 0:
        v[0], v[1], v[2] = frames.decode_status(data)
    elif row == 1:
        v[3], v[4] = frames.decode_servo(data)
    elif row == 2:
        v[5], v[6], v[7] = frames.decode_angles(data)
    elif row == 3:
        v[8], v[9], v[10], v[11] = frames.decode_health(data)
    elif row == 4:
        v[12], v[13], v[14] = frames.decode_angles(data)
    else:
        v[15], v[16] = frames.decode_angles(data)[:2]


@in_place
def ecu_tick(k: int, received: np.ndarray, n: int, noise: float, a: EcuArrays, sent: np.ndarray) -> int:
    """Run tick ``k`` of the ECU on the first ``n`` rows of ``received``: ECU_DEMAND every 10th tick. Returns the number
    of frames sent.

    noise  standard normal number for the measured speed
    """
    for i in range(n):
        _listen(a, received[i, 0], received[i, 1], k)
    for row in range(a.receiver.shape[0]):
        grow_old(a.receiver[row], k)
    m = 0
    n_dem, n_r, request = a.demand[0], a.demand[1], int(a.demand[2])
    if k % SLOW == 0:
        if n_r != n_r:
            n_r = a.s[places.N_R, 0] + a.sigma[0] * noise
        m = _put(sent, m, ECU_DEMAND, encode_demand(n_dem, n_r, request, _next(a.counter, 0)))
    chain.rotor_step(a.s, a.p, 0, n_dem, chain.TICK)
    return m


class Ecu:
    """The engine control unit with its engine: sends ECU_DEMAND every 10 ms, watches the controller's frames.

    n_dem    %, demand at the start, at which the engine runs; set ``arrays.demand`` for later ones
    seed     of the measured speed's noise; None = noise-free
    """

    def __init__(
        self, plant: Plant | None = None, *, n_dem: float = 60.0, mode_request: int = 1, seed: int | None = None
    ):
        machine = plant or build_plant()
        receivers = np.stack([new_receiver(ident) for ident in range(VGV_STATUS, VGV_ANGLES_3 + 1)])
        assert receivers.shape == (6, N_RECEIVER)
        self._last = _last_ident(len(machine.vanes))
        self._others = set(VANES[IN_FRAME:]) - set(machine.vanes)
        self.arrays = EcuArrays(
            machine.start(stroke=0.0, n_r=n_dem),
            machine.p.copy(),
            np.array([n_dem, np.nan, float(mode_request)]),
            np.array([machine.sigma[1 + len(machine.vanes)] if seed is not None else 0.0]),
            receivers,
            np.full(len(ECU_VALUES), np.nan),
            np.zeros(1, np.int64),
        )
        self.k = 0
        self._sent = np.zeros((1, 2), np.int64)
        self._generator = np.random.Generator(np.random.PCG64(seed)) if seed is not None else None

    def set_demand(self, n_dem: float, n_r: float = float("nan"), mode_request: int = 1) -> None:
        """Demand ``n_dem`` (%) from the next frame on; ``n_r`` (%) is the measured speed to send, NaN = the engine
        model's.
        """
        self.arrays.demand[:] = n_dem, n_r, mode_request

    def tick(self, received: np.ndarray, n: int | None = None) -> np.ndarray:
        """Run the next tick on the first ``n`` rows of ``received``; return the frames to send, a view that the next
        tick overwrites.
        """
        noise = self.noise(1)[self.k // SLOW % SLOW]
        m = ecu_tick(self.k, received, len(received) if n is None else n, noise, self.arrays, self._sent)
        self.k += 1
        return self._sent[:m]

    def noise(self, ticks: int) -> np.ndarray:
        """Return ten standard normal numbers for the speeds measured in the next ``ticks`` (at most 100): of tick k at
        k // 10 % 10.
        """
        out = np.zeros(SLOW)
        if self._generator is not None:
            for k in range(-(-self.k // SLOW) * SLOW, self.k + ticks, SLOW):
                out[k // SLOW % SLOW] = self._generator.standard_normal()
        return out

    @property
    def values(self) -> dict[str, float]:
        """Last good values of the controller's signals, NaN before the first; of stages beyond the third those that
        this machine has or that were heard.
        """
        all_values = zip(ECU_VALUES, self.arrays.values.tolist(), strict=True)
        return {name: v for name, v in all_values if name not in self._others or v == v}

    def stale(self) -> list[str]:
        """Return the names of the controller's frames that are late: none for five periods, or of this machine's none
        ever.
        """

        def late(r: np.ndarray) -> bool:
            never = r[frames.R_LAST] < 0 and r[frames.R_IDENT] <= self._last
            return bool(r[frames.R_SILENT] > 0 or (never and self.k >= frames.MISSED * r[frames.R_PERIOD]))

        return [frames.NAMES[int(r[frames.R_IDENT])] for r in self.arrays.receiver if late(r)]
