"""Bad days on the bus, on purpose: run a scenario of frame and fault injection and say whether the controller reacted
as it must.

On ``lockstep`` (default) controller, ECU and bus run in simulated time: every action is possible and the same scenario
gives the same run, bit for bit. On another bus (``local``, ``vcan0``) a controller and an ECU are running already and
we are one more station on it, so only what an outsider can do is done, and only what the controller's frames show is
judged.

::

    from hil import inject
    outcome = inject.run("demand_stops")                       # a shipped scenario, a TOML file, or a Scenario made in
                                                               Python
    assert outcome.held, outcome.text()

The schema of scenarios is `hil.inject.scenario` and `hil.inject.actions`; its names are here, too.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from controller import MODES, load_calibration
from hil.bus import frames
from hil.bus import wire as w
from hil.bus.lockstep_bus import Channel
from hil.bus.port import Port, open_bus
from hil.bus.secoc import Authenticator
from hil.bus.wire import BITS_PER_TICK, TX_N, put, run_wire, take
from hil.inject.actions import (
    ACTIONS,
    Action,
    Babble,
    BusOff,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    ErrorFrames,
    Flood,
    Freeze,
    Machine,
    OnBus,
    OnFrame,
    Outsider,
    Override,
    Reorder,
    Replay,
    Send,
    identifier,
)
from hil.inject.any_controller import Reactions, expected_of_any
from hil.inject.scenario import COUNTS, Expect, Scenario, library, load_scenario
from hil.inject.tamper import Gateway, Intruder, tick_of
from hil.inject.verdict import TRANSITIONS, Check, Outcome, Trace, failed, judge, outcome_of
from hil.loop.node import Ecu, Node
from hil.loop.secured import DEMANDED, FROM_CONTROLLER, Secured
from hil.native.isolation import ControllerFailed, isolated
from plant import build_plant, chain, places
from plant.effects import EFFECTS
from plant.parameters import derive
from vaneloop.base.errors import InputError
from vaneloop.base.extras import is_there
from vaneloop.base.vanes import VANES

if TYPE_CHECKING:
    from controller import Calibration
    from plant import Plant

__all__ = [
    "ACTIONS", "TRANSITIONS", "Babble", "BusOff", "Check", "Corrupt", "Delay", "Drop", "Duplicate", "ErrorFrames",
    "Expect", "Flood",
    "Freeze", "Machine", "Outcome", "Override", "Reorder", "Replay", "Scenario", "Send", "Trace", "judge", "library",
    "load_scenario",
    "run",
]  # fmt: skip

TICK = 1e-3  # s
SENDER = {"ECU": ("ECU_DEMAND",), "VGV": tuple(n for n in frames.NAMES.values() if n != "ECU_DEMAND")}

# ---- lockstep: controller, ECU and bus in simulated time -------------------------------------------------------------


class MachineChange:
    """What a `Machine` action does to the machine, undone at its end: the controller's plant and calibration, the ECU's
    engine.
    """

    def __init__(self, action: Machine, node: Node, ecu: Ecu):
        self.loop, self.fed, self.engine = node.loop, node.arrays.supply, ecu.arrays
        self.first, self.end = tick_of(action.start), tick_of(action.end)
        self.new: dict[int, float] = {}
        if action.effect is not None:
            own = {q.name: (row, q.si) for row, q in node.plant.parameters_of(action.effect).items()}
            for name, value in action.parameters.items():
                if name not in own:
                    stages = ", ".join(node.plant.vanes)
                    raise InputError(f"parameters.{name} of {action.effect}: this machine has the vane rows {stages}")
                row, si = own[name]
                self.new[row] = value * si
        self.supply = {i: v for i, v in ((0, action.p_s), (1, action.t_oil)) if v is not None}
        if 0 in self.supply:
            self.supply[0] *= 1e6
        self.old: tuple[dict[int, float], dict[int, float]] = ({}, {})

    def tick(self, k: int) -> None:
        """Change the machine at the first tick, and back at the end."""
        if k == self.first:
            self.old = ({r: float(self.loop.p[r, 0]) for r in self.new}, {i: float(self.fed[i]) for i in self.supply})
            self._set(self.new, self.supply)
        elif k == self.end:
            self._set(*self.old)

    def _set(self, rows: dict[int, float], supply: dict[int, float]) -> None:
        for i, v in supply.items():
            self.fed[i] = v
        if rows:
            chain.wake(self.loop.s, self.loop.p, 0, self.loop.given.i_cmd)
            for p in (self.loop.p, self.engine.p):
                for r, v in rows.items():
                    p[r, 0] = v
                derive(p, chain.TICK / chain.SUBSTEPS, chain.TICK)


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


def _sent_by(frame: str, plant: Plant) -> bool:
    """Whether the machine sends the frame: not those of angles of stages that it lacks."""
    vanes = frames.ANGLES.get(identifier(frame))
    return vanes is None or vanes[0] in plant.vanes


def _check_stages(name: str, scenario: Scenario, plant: Plant) -> None:
    """Refuse a scenario that is about stages which the machine lacks: InputError."""
    for claim in scenario.expect:
        stage = claim.signal in VANES and claim.signal not in plant.vanes
        if stage or (claim.late is not None and not _sent_by(claim.late, plant)):
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


def _lockstep(
    name: str,
    scenario: Scenario,
    plant: Plant | None,
    calibration: Calibration | None,
    progress: Callable[[float], None] | None,
    reactions: Reactions | None,
) -> Outcome:
    """Run a scenario in simulated time."""
    plant = plant or build_plant()
    if why := lacks(scenario, plant):
        raise InputError(f"{name}: {why}")
    started = time.perf_counter()
    points = np.array(scenario.demand)
    _check_stages(name, scenario, plant)
    node = Node(plant, calibration, n_r=float(points[0, 1]), seed=scenario.seed)
    ecu = Ecu(plant, n_dem=float(points[0, 1]), seed=scenario.seed + 1)
    ticks = round(scenario.duration * 1000.0)
    of = {kind: [a for a in scenario.inject if isinstance(a, kind)] for kind in (OnFrame, Outsider, OnBus, Machine)}
    chance = [random.Random(f"{scenario.seed} {i}") for i in range(len(of[Outsider]) + 2)]
    gateways = [
        Gateway([a for a in of[OnFrame] if sender_of(a) == who], c)
        for who, c in zip(("ECU", "VGV"), chance, strict=False)
    ]
    recorded: list[tuple[int, int, int]] = []
    keep = any(isinstance(a, Replay) and a.begin is not None for a in scenario.inject)
    keys = _keys(scenario)
    vgv, demanding = (node, ecu) if keys is None else _secured(node, ecu, keys[0])
    intruders = [Intruder(a, c, recorded, keys) for a, c in zip(of[Outsider], chance[2:], strict=True)]
    machines = [MachineChange(a, node, ecu) for a in of[Machine]]  # type: ignore[arg-type]
    channel = Channel(seed=scenario.seed)
    wire, join = channel.wire, channel.join
    stations = {"ECU": join(), "VGV": join()}
    outside = [join() for _ in intruders]
    ears = join(silent=True) if keep else -1
    disturber = Disturber(of[OnBus], wire, stations)
    rows = np.zeros((256, 2), np.int64)

    z, s, receiver = node.loop.state, node.loop.s, node.arrays.receiver
    mode, faults = np.empty(ticks, np.int8), np.empty(ticks, np.int64)
    stages, heard = len(plant.vanes), [n for n in SENDER["VGV"] if _sent_by(n, plant)]
    values = np.empty((ticks, 5 + stages))
    counts = np.empty((ticks, len(COUNTS)), np.int64)
    late = np.zeros((ticks, len(heard)), bool)
    to_border = np.array([1e3, 1e3, 1e3, 1.0, 1.0, *([180.0 / np.pi] * stages)])
    for k in range(ticks):
        if k % 10 == 0:
            ecu.set_demand(float(np.interp(k * TICK, points[:, 0], points[:, 1])))
        for m in machines:
            m.tick(k)
        disturber.tick(k)
        from_ecu = demanding.tick(rows, take(wire, stations["ECU"], rows)).tolist()
        from_vgv = vgv.tick(rows, take(wire, stations["VGV"], rows)).tolist()
        mode[k], faults[k] = z.mode, z.faults
        values[k] = (z.x_dem, z.x_meas, z.i_cmd, z.n_dem, z.n_r_raw, *s[places.POT : places.POT + stages, 0])
        counts[k, :8] = receiver[:8]
        counts[k, 8], counts[k, 9] = frames.refused(receiver), receiver[frames.R_UNAUTHENTIC]
        if k % 10 == 0:
            missed = ecu.stale()
            late[k : k + 10] = [n in missed for n in heard]
        for who, gateway, sent in zip(("ECU", "VGV"), gateways, (from_ecu, from_vgv), strict=True):
            for head, data in gateway.feed(k, sent):
                put(wire, stations[who], head, data)
        for place, intruder in zip(outside, intruders, strict=True):
            if intruder.first <= k < intruder.end:
                for head, data in intruder.tick(k, int(wire.node[place, TX_N])):
                    put(wire, place, head, data)
        run_wire(wire, (k + 1) * BITS_PER_TICK, -1)
        if keep:
            recorded += [(k, head, data) for head, data in rows[: take(wire, ears, rows)].tolist()]
        if progress is not None and k % 1000 == 0:
            progress(k / ticks)
    cal = node.loop.calibration.scalars
    trace = Trace(
        np.arange(ticks) * TICK,
        mode,
        faults,
        dict(zip(("x_dem", "x_lvdt", "i_cmd", "n_dem", "n_r", *plant.vanes), (values * to_border).T, strict=True)),
        dict(zip(COUNTS, counts.T, strict=True)),
        dict(zip(heard, late.T, strict=True)),
        (float(cal.stroke_min) * 1e3, float(cal.stroke_max) * 1e3),
        float(cal.current_limit) * 1e3,
        ours=reactions is None,
    )
    if reactions is not None:
        of_any = reactions.limits
        trace.stroke, trace.current = (of_any.stroke_min.value, of_any.stroke_max.value), of_any.current.value
    wall = time.perf_counter() - started
    return outcome_of(
        name,
        scenario,
        "lockstep",
        trace,
        notes=[],
        simulated_s=ticks * TICK,
        wall_s=wall,
        state_hash=node.fingerprint(),
    )


# ---- another bus: one station among others, in real time -------------------------------------------------------------


class _Witness:
    """What the controller's frames say, as a trace grows from them."""

    NAMES = ("x_dem", "x_lvdt", "i_cmd", *VANES)
    NEEDED = ("x_dem", "x_lvdt", "i_cmd", "state", "faults")

    def __init__(self) -> None:
        self.receivers = {i: frames.new_receiver(i) for i in frames.NAMES if i != frames.ECU_DEMAND}
        self.now: dict[str, float] = {}
        self.rows: list[tuple[float, ...]] = []

    def hear(self, head: int, data: int, t: float) -> None:
        """Take one frame that came at ``t`` s; a sample is due with each VGV_STATUS once all signals are known."""
        ident = head & frames.IDENT_MASK
        receiver = self.receivers.get(ident)
        if receiver is None or frames.receive(receiver, head, data, int(t * 1000.0)) != frames.GOOD:
            return
        self.now |= frames.decode(head, data)
        if ident == frames.VGV_ANGLES and all(n in self.now for n in self.NEEDED):
            self.rows.append((t, self.now["state"], self.now["faults"], *(self.now.get(n, np.nan) for n in self.NAMES)))

    def trace(self, begin: float) -> Trace:
        """Return the samples from ``begin`` s on, with times from there."""
        table = np.array(self.rows)
        table = table[table[:, 0] >= begin]
        cal = load_calibration().scalars
        return Trace(
            table[:, 0] - begin,
            table[:, 1].astype(int),
            table[:, 2].astype(np.int64),
            {n: v for n, v in zip(self.NAMES, table[:, 3:].T, strict=True) if not np.isnan(v).all()},
            stroke=(float(cal.stroke_min) * 1e3, float(cal.stroke_max) * 1e3),
            current=float(cal.current_limit) * 1e3,
            exact=False,
        )


LISTEN = 5.0  # s in which the controller must be heard in RUN


def cannot(scenario: Scenario) -> str:
    """Return why an outsider cannot do what the scenario asks for; empty if it can."""
    if scenario.secoc:
        return "authentication under a key of the scenario's own; --bus lockstep has it"
    inside = sorted({a.action for a in scenario.inject if not isinstance(a, Outsider)})
    return f"{', '.join(inside)}: no other station on a bus can do that; --bus lockstep can" if inside else ""


def lacks(scenario: Scenario, plant: Plant) -> str:
    """Return what the scenario does to an actuator that this machine does not have, or with a package that is not
    installed; empty if there is no such thing.
    """
    if scenario.secoc and not is_there("cryptography"):
        return "secoc: authentication needs cryptography, which is not installed: pip install 'vaneloop[secoc]'"
    for a in scenario.inject:
        if isinstance(a, Machine):
            if a.p_s is not None and plant.kind != "hydraulic":
                return f"machine: p_s: the {plant.kind} actuator takes no oil"
            if a.effect is not None and plant.kind not in EFFECTS[a.effect].kinds:
                return f"machine: effect {a.effect}: not of an actuator of kind {plant.kind}"
    return ""


def _on_bus(name: str, scenario: Scenario, bus: str, progress: Callable[[float], None] | None) -> Outcome:
    """Play a scenario in real time on a bus on which a controller and an ECU run."""
    why = cannot(scenario)
    if why:
        raise InputError(f"{name} on {bus}: {why}")
    recorded: list[tuple[int, int, int]] = []
    chance = [random.Random(f"{scenario.seed} {i}") for i in range(len(scenario.inject))]
    intruders = [Intruder(a, c, recorded) for a, c in zip(scenario.inject, chance, strict=True)]
    keep = any(isinstance(a, Replay) and a.begin is not None for a in scenario.inject)
    witness, rows = _Witness(), np.zeros((256, 2), np.int64)
    opened = open_bus(bus)
    try:
        port = Port(opened)
        started = time.perf_counter()
        begin: float | None = None  # time at which the controller was first heard in RUN: the scenario's 0
        k = 0
        while True:
            now = time.perf_counter() - started
            for head, data in rows[: port.read(rows)].tolist():
                witness.hear(head, data, now)
                if keep and begin is not None:
                    recorded.append((round((now - begin) * 1000.0), head, data))
            if begin is None:
                if witness.rows and MODES[int(witness.rows[-1][1])] == "RUN":
                    begin = now
                elif now > LISTEN:
                    heard = f"it is in {MODES[int(witness.rows[-1][1])]}" if witness.rows else "none was heard"
                    start = f"start vaneloop run --bus {bus} and vaneloop ecu --bus {bus}"
                    raise InputError(f"{bus}: no controller in RUN within {LISTEN:g} s ({heard}); {start}")
            else:
                t = now - begin
                if t >= scenario.duration:
                    break
                while k <= t * 1000.0:
                    for intruder in intruders:
                        port.write(np.array(intruder.tick(k, 0), np.int64).reshape(-1, 2))
                    k += 1
                if progress is not None:
                    progress(t / scenario.duration)
            time.sleep(0.0005)
    finally:
        opened.shutdown()
    notes = [f"{port.refused} frames were not taken by the bus"] if port.refused else []
    notes += [f"{port.lost} frames came faster than they could be read"] if port.lost else []
    trace = witness.trace(begin)
    if not trace.t[-1] > 0.0:
        raise InputError(f"{bus}: the controller was not heard again after {begin:.1f} s")
    wall = time.perf_counter() - started
    return outcome_of(
        name, scenario, bus, trace, notes=notes, simulated_s=scenario.duration, wall_s=wall, state_hash=None
    )


# ---- commands --------------------------------------------------------------------------------------------------------


def run(
    scenario: Scenario | str | Path,
    *,
    bus: str = "lockstep",
    plant: Plant | None = None,
    calibration: Calibration | None = None,
    name: str | None = None,
    progress: Callable[[float], None] | None = None,
    reactions: Reactions | None = None,
    save_crash: str | None = None,
) -> Outcome:
    """Run a scenario and judge it.

    scenario  a `Scenario`, the name of a shipped one, or a TOML file
    bus       ``lockstep``, or a bus on which a controller and an ECU run (``local``, ``vcan0``)
    plant, calibration  on lockstep: other than the shipped tables; a controller of the user's own in ``calibration``
                        runs in a process of its own
    reactions   judge the scenarios that it names by what must be seen of any controller (`hil.inject.any_controller`)
    save_crash  file for the inputs of a controller of the user's own that fails (`hil.native.crash_log`)
    Raises InputError for what cannot be read, or cannot be done on this bus.
    """
    made = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    called = name or (Path(str(scenario)).stem if not isinstance(scenario, Scenario) else "scenario")
    if reactions is not None and called in reactions.reactions:
        made = expected_of_any(called, made, reactions)
    if bus == "lockstep":

        def go() -> Outcome:
            return _lockstep(called, made, plant, calibration, progress, reactions)

        if calibration is None or calibration.program is None:
            return go()
        try:
            return isolated(go, save_crash)
        except ControllerFailed as e:
            return failed(called, made, str(e))
    return _on_bus(called, made, bus, progress)
