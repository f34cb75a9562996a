"""A scenario in simulated time: controller, ECU and bus tick by tick, while its actions act on frames, bus and machine.

`hil.inject.injection` runs one to a verdict; `hil.inject.heard` finds out with it what a controller hears.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from controller.channels import CHANNELS
from hil.bus import frames
from hil.bus import wire as w
from hil.bus.lockstep_bus import Channel
from hil.bus.secoc import Authenticator
from hil.bus.wire import BITS_PER_TICK, TX_N, put, run_wire, take
from hil.inject.actions import (
    Action,
    BusOff,
    ChannelFault,
    ErrorFrames,
    Link,
    Machine,
    OnBus,
    OnFrame,
    Outsider,
    Replay,
    identifier,
)
from hil.inject.scenario import Scenario
from hil.inject.tamper import Gateway, Intruder, tick_of
from hil.loop.node import Ecu, Node
from hil.loop.pair import COILS, LVDTS, Pair
from hil.loop.secured import DEMANDED, FROM_CONTROLLER, Secured
from plant import chain
from plant.parameters import derive
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import VANES

if TYPE_CHECKING:
    from controller import Calibration
    from plant import Plant

__all__ = [
    "SENDER", "TICK", "Disturber", "MachineChange", "OnLockstep", "changed_rows", "check_stages", "demand_at",
    "sender_of", "sent_by",
]  # fmt: skip

TICK = 1e-3  # s
SENDER = {"ECU": ("ECU_DEMAND",), "VGV": tuple(n for n in frames.NAMES.values() if n != "ECU_DEMAND")}


def changed_rows(action: Machine, plant: Plant) -> dict[int, float]:
    """Rows of a machine's parameters that an action changes, and their values there (SI). Raises InputError for a vane
    row that the machine lacks.
    """
    new: dict[int, float] = {}
    if action.effect is not None:
        own = {q.name: (row, q.si) for row, q in plant.parameters_of(action.effect).items()}
        for name, value in action.parameters.items():
            if name not in own:
                stages = ", ".join(plant.vanes)
                raise InputError(f"parameters.{name} of {action.effect}: this machine has the vane rows {stages}")
            row, si = own[name]
            new[row] = value * si
    return new


class MachineChange:
    """What a `Machine` action does to the machine, undone at its end: the controller's plant and calibration, the ECU's
    engine.
    """

    def __init__(self, action: Machine, node: Node, ecu: Ecu):
        self.loop, self.fed, self.engine = node.loop, node.arrays.supply, ecu.arrays
        self.first, self.end = tick_of(action.start), tick_of(action.end)
        self.new = changed_rows(action, node.plant)
        lane = ("a", "b").index(action.side) if action.side else None
        self.lanes = slice(None) if lane is None else slice(lane, lane + 1)
        self.supply = {i: v for i, v in ((0, action.p_s), (1, action.t_oil)) if v is not None}
        if 0 in self.supply:
            self.supply[0] *= 1e6
        self.old: tuple[dict[int, Any], dict[int, float]] = ({}, {})

    def tick(self, k: int) -> None:
        """Change the machine at the first tick, and back at the end."""
        if k == self.first:
            self.old = (
                {r: self.loop.p[r, self.lanes].copy() for r in self.new},
                {i: float(self.fed[i]) for i in self.supply},
            )
            self._set(self.new, self.supply)
        elif k == self.end:
            self._set(*self.old)

    def _set(self, rows: Mapping[int, Any], supply: dict[int, float]) -> None:
        """Put these numbers into rows of p, one for all actuators or one for each, and into the supply."""
        for i, v in supply.items():
            self.fed[i] = v
        if rows:
            chain.wake(self.loop.s, self.loop.p, 0, self.loop.given.i_cmd)
            for p in (self.loop.p, self.engine.p):
                for r, v in rows.items():
                    p[r, self.lanes] = v
                derive(p, chain.TICK / chain.SUBSTEPS, chain.TICK)


class PairChange:
    """What a `ChannelFault` or a `Link` action does to two channels, undone at its end."""

    def __init__(self, action: ChannelFault | Link, pair: Pair):
        self.first, self.end = tick_of(action.start), tick_of(action.end)
        self.places: list[tuple[np.ndarray, float]] = []  # numbers of the pair, and what they become
        if isinstance(action, Link):
            for side, name in enumerate(CHANNELS):
                if action.sender in (name, "both"):
                    self.places += [(pair.line[side, i : i + 1], v) for i, v in enumerate((action.delay, action.loss))]
        else:
            part, _, what = action.fault.partition("_")
            array, kinds = {"coil": (pair.coil, COILS), "lvdt": (pair.lvdt, LVDTS), "off": (pair.power, ("",))}[part]
            at = CHANNELS.index(action.channel)
            self.places.append((array[at : at + 1], float(kinds.index(what))))
        self.old = [float(place[0]) for place, _ in self.places]

    def tick(self, k: int) -> None:
        """Set them at the first tick, and back at the end."""
        for (place, new), old in zip(self.places, self.old, strict=True):
            if k == self.first:
                place[0] = new
            elif k == self.end:
                place[0] = old


class Disturber:
    """What happens to the bus itself: error frames with a chance, nodes in bus-off."""

    def __init__(self, actions: Sequence[Action], wire: Any, places: dict[str, int]):
        self.wire, self.places = wire, places
        self.errors = [(tick_of(a.start), tick_of(a.end), a.probability) for a in actions if isinstance(a, ErrorFrames)]
        self.off = [(tick_of(a.start), tick_of(a.end), places[a.node]) for a in actions if isinstance(a, BusOff)]
        self.end = max((end for _, end, _ in (*self.errors, *self.off)), default=0.0)

    def tick(self, k: int) -> None:
        """Set the wire's state for tick ``k``."""
        if self.errors:
            well = 1.0
            for first, end, probability in self.errors:
                well *= 1.0 - probability if first <= k < end else 1.0
            self.wire.chance[0] = 1.0 - well
        for first, end, place in self.off:
            node = self.wire.node[place]
            if k == first:
                node[w.TEC], node[w.MODE], node[w.TO_RECOVER] = 256, w.BUS_OFF, self._from_now(w.RECOVER)
                node[w.REFUSED] += node[w.TX_N]
                node[w.TX_N] = 0
                node[w.BUS_OFFS] += 1
            if end < np.inf and first <= k <= end and node[w.MODE] == w.BUS_OFF:
                node[w.TO_RECOVER] = self._from_now(w.RECOVER) if k == end else 1 << 40

    def _from_now(self, times: int) -> int:
        """Return what ``times`` occurrences of 11 recessive bits from now on are for the wire, which counts from where
        it became free.
        """
        idle = max(int(self.wire.clock[w.NOW] - self.wire.clock[w.FREE]), 0)
        return times + -(-idle // w.RECESSIVE)


def sender_of(action: Action) -> str:
    """Return the node whose frames the action works on."""
    assert isinstance(action, OnFrame)
    ident = identifier(action.frame)
    name = frames.NAMES.get(ident) or frames.NAMES[ident - frames.AUTH]
    return next(who for who, names in SENDER.items() if name in names)


def sent_by(frame: str, plant: Plant) -> bool:
    """Whether the machine sends the frame: not those of angles of stages that it lacks."""
    vanes = frames.ANGLES.get(identifier(frame))
    return vanes is None or vanes[0] in plant.vanes


def check_stages(name: str, scenario: Scenario, plant: Plant) -> None:
    """Refuse a scenario that is about stages which the machine lacks: InputError."""
    for claim in scenario.expect:
        stage = claim.signal in VANES and claim.signal not in plant.vanes
        if stage or (claim.late is not None and not sent_by(claim.late, plant)):
            raise InputError(
                f"{name}: expect {claim.signal or claim.late}: this machine has the vane rows {', '.join(plant.vanes)}"
            )


def _keys(scenario: Scenario) -> tuple[Authenticator, Authenticator] | None:
    """What makes MACs under the scenario's key, and under another; None where frames are not authenticated."""
    if not scenario.secoc:
        return None
    chance = random.Random(f"{scenario.seed} keys")
    return Authenticator(chance.randbytes(16)), Authenticator(chance.randbytes(16))


def _secured(node: Node, ecu: Ecu, authenticator: Authenticator) -> tuple[Any, Any]:
    """Both nodes with authentication; the freshness value of a tick is its number."""
    both = Secured(node, authenticator, DEMANDED), Secured(ecu, authenticator, FROM_CONTROLLER)
    for one in both:
        one.gate.correct(0, 0)
    return both


def demand_at(scenario: Scenario, k: int) -> float:
    """Demand (%) that the ECU has at tick ``k``."""
    points = np.array(scenario.demand)
    return float(np.interp(k * TICK, points[:, 0], points[:, 1]))


class OnLockstep:
    """Controller, ECU and bus with a scenario's actions, in simulated time.

    node, ecu  the two nodes; ``k``: the next tick
    heard      frames of the controller that the machine sends, and the ECU waits for
    missed     those of them that are late
    """

    def __init__(self, scenario: Scenario, plant: Plant, calibration: Calibration | None):
        first = float(scenario.demand[0][1])
        self.scenario, self.k = scenario, 0
        self.node = node = Node(plant, calibration, n_r=first, seed=scenario.seed)
        self.ecu = ecu = Ecu(plant, n_dem=first, seed=scenario.seed + 1)
        actions = scenario.inject
        of = {kind: [a for a in actions if isinstance(a, kind)] for kind in (OnFrame, Outsider, OnBus, Machine)}
        paired = [a for a in actions if isinstance(a, ChannelFault | Link)]
        chance = [random.Random(f"{scenario.seed} {i}") for i in range(len(of[Outsider]) + 2)]
        self._gateways = [
            Gateway([a for a in of[OnFrame] if sender_of(a) == who], c)
            for who, c in zip(("ECU", "VGV"), chance, strict=False)
        ]
        self._recorded: list[tuple[int, int, int]] = []
        self._keep = any(isinstance(a, Replay) and a.begin is not None for a in actions)
        keys = _keys(scenario)
        both: tuple[Any, Any] = (node, ecu) if keys is None else _secured(node, ecu, keys[0])
        self._vgv, self._demanding = both
        self._intruders = [Intruder(a, c, self._recorded, keys) for a, c in zip(of[Outsider], chance[2:], strict=True)]
        self._machines: list[MachineChange | PairChange] = [
            *(MachineChange(a, node, ecu) for a in of[Machine]),  # type: ignore[arg-type]
            *(PairChange(a, node.loop.pair) for a in paired),
        ]
        channel = Channel(seed=scenario.seed)
        self._wire, join = channel.wire, channel.join
        self._stations = {"ECU": join(), "VGV": join()}
        self._outside = [join() for _ in self._intruders]
        self._ears = join(silent=True) if self._keep else -1
        self._disturber = Disturber(of[OnBus], self._wire, self._stations)
        self._rows = np.zeros((256, 2), np.int64)
        self.heard = [n for n in SENDER["VGV"] if sent_by(n, plant)]
        self.missed: list[str] = []

    def tick(self, n_r: float = np.nan) -> None:
        """Run the next tick; ``n_r`` (%): the measured speed that the ECU sends from the next frame on, NaN: its
        engine's.
        """
        k, wire, rows, stations = self.k, self._wire, self._rows, self._stations
        if k % 10 == 0:
            self.ecu.set_demand(demand_at(self.scenario, k), n_r)
        for m in self._machines:
            m.tick(k)
        self._disturber.tick(k)
        from_ecu = self._demanding.tick(rows, take(wire, stations["ECU"], rows)).tolist()
        from_vgv = self._vgv.tick(rows, take(wire, stations["VGV"], rows)).tolist()
        if k % 10 == 0:
            self.missed = self.ecu.stale()
        for who, gateway, sent in zip(("ECU", "VGV"), self._gateways, (from_ecu, from_vgv), strict=True):
            for head, data in gateway.feed(k, sent):
                put(wire, stations[who], head, data)
        for place, intruder in zip(self._outside, self._intruders, strict=True):
            if intruder.first <= k < intruder.end:
                for head, data in intruder.tick(k, int(wire.node[place, TX_N])):
                    put(wire, place, head, data)
        run_wire(wire, (k + 1) * BITS_PER_TICK, -1)
        if self._keep:
            self._recorded += [(k, head, data) for head, data in rows[: take(wire, self._ears, rows)].tolist()]
        self.k = k + 1

    def counts(self) -> tuple[int, ...]:
        """What the controller's receiver has counted: `hil.inject.scenario.COUNTS`."""
        r = self.node.arrays.receiver
        return (*r[:8].tolist(), int(frames.refused(r)), int(r[frames.R_UNAUTHENTIC]))
