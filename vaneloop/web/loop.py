"""The loop live, in processes of its own: lockstep at a chosen speed, or nodes and a listener in real time. ``python -m
vaneloop.web.loop FD``

Lockstep is controller, ECU and wire in simulated time with everything of `hil.inject` on it; in real time each node is
the loop that ``vaneloop run`` and ``vaneloop ecu`` run, in a process of its own, and what is shown is what a third
station hears on the bus.
"""

from __future__ import annotations

import os
import random
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from hil.bus import frames
from hil.bus.lockstep_bus import Channel
from hil.bus.port import Port, open_bus
from hil.bus.wire import BITS_PER_TICK, TX_N, put, run_wire, take
from hil.calibrate.master import Master
from hil.calibrate.station import MASTER, SLAVE, data_of, row_of
from hil.inject import actions, on_lockstep
from hil.inject.injection import run
from hil.inject.scenario import load_scenario
from hil.inject.tamper import Gateway, Intruder
from hil.logs.recorder import Recorder, RecorderProcess
from hil.loop.ecu import EcuStation, Typed, builtin
from hil.loop.node import Ecu, Node
from hil.loop.realtime import Stop, packed, run_realtime, undisturbed
from hil.native import black_box
from vaneloop.base import terminal
from vaneloop.cli.attended import accepted, attend
from vaneloop.verbs.machine import Machine
from vaneloop.web.jobs import COLUMNS, COMPILING
from vaneloop.web.process import INBOX, Progress, answer, parsed

__all__ = ["TASKS"]

MOST_TRACE = 120  # frames of the trace sent at a time; the rest are counted only
NEWS = 0.1  # s between two messages to the page


class Heard:
    """What the frames on the bus say: a row with every VGV_ANGLES, the trace of frames, counts."""

    def __init__(self) -> None:
        self.now = dict.fromkeys(COLUMNS, float("nan"))
        self.rows: list[list[float]] = []
        self.trace: list[tuple[float, int, int, dict[str, float]]] = []
        self.frames = self.refused = 0

    def hear(self, t: float, head: int, data: int) -> None:
        """Take one frame."""
        self.frames += 1
        ident = head & frames.IDENT_MASK
        ours = (
            ident in frames.NAMES
            and not head & (frames.ERROR | frames.EXTENDED | frames.REMOTE | frames.FD)
            and (head >> 32) & 0xFF == frames.LENGTH
        )
        good = ours and frames.crc(ident, data) == (data & 0xFF)
        values = frames.decode(head, data) if ours else {}
        if ours and not good:
            self.refused += 1
        if len(self.trace) < MOST_TRACE:
            self.trace.append((t, head, data, values if good else {}))
        if not good:
            return
        for name, v in values.items():
            if name in self.now:
                self.now[name] = v
        if ident == frames.VGV_SERVO:
            self.now["faults"] = float(frames.decode_servo(data)[1])
        if ident == frames.VGV_ANGLES:
            self.now["t"] = t
            self.rows.append([self.now[c] for c in COLUMNS])

    def news(self) -> dict[str, Any]:
        """Everything since the last call."""
        out = {
            "rows": np.array(self.rows).reshape(-1, len(COLUMNS)),
            "trace": self.trace,
            "frames": self.frames,
            "refused": self.refused,
        }
        self.rows, self.trace = [], []
        return out


class Tool:
    """The calibration tool on the bus: what the page asks for goes through an XCP master to the controller's slave."""

    def __init__(self) -> None:
        self._master, self._idents, self._row, self._data = Master(), (MASTER, SLAVE), row_of, data_of

    def ask(self, jobs: list[tuple[int, list[bytes]]]) -> None:
        """Take jobs: their numbers and commands."""
        for number, commands in jobs:
            self._master.ask(number, commands)

    def send(self, ms: float) -> list[tuple[int, int]]:
        """Frames to send now."""
        command = self._master.send(ms)
        return [] if command is None else [self._row(self._idents[0], command)]

    def hear(self, head: int, data: int) -> None:
        """Take one frame of the bus."""
        if head & ~(0xFF << 32) == self._idents[1]:
            self._master.hear(self._data(head, data))

    def news(self) -> dict[str, Any]:
        """Jobs done since the last call."""
        done, self._master.done = self._master.done, []
        return {"xcp": done} if done else {}


def _attended(progress: Progress, node: Any, tuned: str | None, bus: str = "") -> Any:
    """The node with its XCP slave, which saves into ``tuned``; tells the page what may be calibrated.

    bus  it runs on in real time; "": in simulated time
    """
    args = parsed("run", ["--xcp", "--xcp-open", "--xcp-save", str(tuned)])
    attended = attend(args, node, recorded=not bus)
    attended.told = bool(bus)
    progress(None, {"elements": attended.services[0].memory.elements})
    return attended


def _told() -> dict[str, Any]:
    """Everything that the server has told since the last call; of a thing told twice the latest, of scenarios and of a
    tool's commands all.
    """
    out: dict[str, Any] = {}
    while (news := INBOX.take()) is not None:
        for every in ("inject", "xcp"):
            if every in news:
                out.setdefault(every, []).append(news.pop(every))
        out |= news
    return out


class _Injected:
    """Actions of the scenarios that were started, shifted to when they were."""

    def __init__(self, node: Any, ecu: Any, channel: Any, places: dict[str, int]):
        self.node, self.ecu, self.channel, self.places = node, ecu, channel, places
        self.gateways: dict[str, list[Any]] = {"ECU": [], "VGV": []}
        self.intruders: list[tuple[int, Any]] = []
        self.machines: list[Any] = []
        self.disturbers: list[Any] = []
        self.recorded: list[tuple[int, int, int]] = []
        self.begun: list[tuple[float, str]] = []  # s, name: since the last news
        self.end = 0.0

    def add(self, name: str, k: int) -> None:
        """Begin the shipped scenario ``name`` now: its first action starts at tick ``k``."""

        scenario = load_scenario(name)
        first = min((a.start for a in scenario.inject), default=0.0)
        self.begun.append((k * 1e-3, name))
        moved = [a.model_copy(update={"start": k * 1e-3 + a.start - first}) for a in scenario.inject]
        chance = random.Random(scenario.seed)
        for who in self.gateways:
            mine = [a for a in moved if isinstance(a, actions.OnFrame) and on_lockstep.sender_of(a) == who]
            if mine:
                self.gateways[who].append(Gateway(mine, chance))
        for a in moved:
            if isinstance(a, actions.Outsider):
                self.intruders.append((self.channel.join(), Intruder(a, chance, self.recorded)))
            elif isinstance(a, actions.Machine):
                self.machines.append(on_lockstep.MachineChange(a, self.node, self.ecu))
        on_bus = [a for a in moved if isinstance(a, actions.OnBus)]
        if on_bus:
            self.disturbers.append(on_lockstep.Disturber(on_bus, self.channel.wire, self.places))
        self.end = max(self.end, *(min(a.end, k * 1e-3 + scenario.duration - first) for a in moved), 0.0)

    def news(self) -> list[tuple[float, str]]:
        """What began since the last call, and when, s."""
        out, self.begun = self.begun, []
        return out

    def tidy(self, k: int) -> None:
        """Forget what is done before tick ``k``, and leave the wire's places of outsiders."""
        for place, intruder in [x for x in self.intruders if x[1].end <= k]:
            self.channel.leave(place)
            self.intruders.remove((place, intruder))
        for who, gateways in self.gateways.items():
            self.gateways[who] = [g for g in gateways if not g.done(k)]
        self.machines = [m for m in self.machines if m.end >= k]  # at its last tick it undoes what it did
        self.disturbers = [d for d in self.disturbers if d.end >= k]


def _compile() -> None:
    rows = np.zeros((1, 2), np.int64)
    channel = Channel(seed=0)
    place = channel.join()
    for sender in (Node(), Ecu()):
        for head, data in sender.tick(rows, 0).tolist():
            put(channel.wire, place, head, data)
    run_wire(channel.wire, BITS_PER_TICK, -1)
    take(channel.wire, place, np.zeros((256, 2), np.int64))


def _machine(tables: str | None, controller: str | None, boxes: str | None) -> Machine:
    """The machine of a run; a controller of the user's own leaves its black boxes in ``boxes``."""
    if boxes is not None:
        black_box.watched(Path(boxes), False)
    return Machine(tables, controller=controller)


def ready(progress: Progress) -> None:
    """Load and compile what a run needs."""
    progress(None, COMPILING)
    _compile()


def lockstep(
    progress: Progress,
    demand: float,
    speed: float,
    record: str | None,
    seed: int | None,
    profile: str | None,
    tables: str | None = None,
    controller: str | None = None,
    boxes: str | None = None,
    tuned: str | None = None,
) -> dict[str, Any]:
    """Run controller, ECU and bus in simulated time, ``speed`` seconds of it a second, until told to stop.

    tables  folder of the machine's tables; None: the shipped ones
    controller, boxes  shared library of the user's own, and the folder of its black boxes; None: the firmware here
    tuned  folder into which a calibration tool saves
    """
    typed = Typed(demand)
    progress(None, COMPILING)
    _compile()
    machine = _machine(tables, controller, boxes)
    node = Node(machine.plant, machine.calibration, n_r=demand, seed=seed)
    ecu = EcuStation(typed, ecu=Ecu(machine.plant, n_dem=demand, seed=None if seed is None else seed + 1))
    attended, tool = _attended(progress, node, tuned), Tool()
    channel = Channel(seed=seed or 0)
    wire = channel.wire
    places = {"ECU": channel.join(), "VGV": channel.join()}
    ears = channel.join(silent=True)
    injected = _Injected(node, ecu.ecu, channel, places)
    recorder = Recorder(record, "lockstep") if record else None
    heard = Heard()
    rows = np.zeros((256, 2), np.int64)
    curve = builtin(profile).per_frame()[:, 0] if profile else None
    curve_from = 0
    start_ns = time.time_ns() // 10**9 * 10**9
    k, stopped, reached = 0, False, 0.0
    began, began_k = time.perf_counter(), 0
    try:
        while not stopped:
            for name, value in _told().items():
                if name == "stop":
                    stopped = True
                elif name == "demand":
                    typed.n_dem, curve = min(max(float(value), 0.0), 120.0), None
                elif name == "mode_request":
                    typed.mode_request = int(value)
                elif name == "speed":
                    speed, began, began_k = float(value), time.perf_counter(), k
                elif name == "profile":
                    curve, curve_from = builtin(value).per_frame()[:, 0], k
                elif name == "inject":
                    for scenario in value:
                        injected.add(scenario, k + 1)
                elif name == "xcp":
                    tool.ask(value)
                    if "TOOL" not in places:
                        places["TOOL"] = channel.join()
            due = time.perf_counter() + NEWS
            until = began_k + (time.perf_counter() - began + NEWS) * 1000.0 * speed if speed else np.inf
            first_k = k
            while k < until and (k % 10 or time.perf_counter() < due):
                if curve is not None and k % 10 == 0:
                    typed.n_dem = float(curve[min((k - curve_from) // 10, len(curve) - 1)])
                for part in (*injected.machines, *injected.disturbers):
                    part.tick(k)
                taken = take(wire, places["ECU"], rows)
                from_ecu = ecu.tick(rows, taken).tolist()
                taken = take(wire, places["VGV"], rows)
                from_vgv = attended.tick(rows, taken).tolist()
                for who, sent in (("ECU", from_ecu), ("VGV", from_vgv)):
                    for gateway in injected.gateways[who]:
                        sent = gateway.feed(k, sent)
                    for head, data in sent:
                        put(wire, places[who], head, data)
                for head, data in tool.send(k):
                    put(wire, places["TOOL"], head, data)
                for place, intruder in injected.intruders:
                    for head, data in intruder.tick(k, int(wire.node[place, TX_N])):
                        put(wire, place, head, data)
                run_wire(wire, (k + 1) * BITS_PER_TICK, -1)
                n = take(wire, ears, rows)
                if n:
                    for head, data in rows[:n].tolist():
                        heard.hear(k * 1e-3, head, data)
                        tool.hear(head, data)
                        injected.recorded.append((k, head, data))
                    if recorder is not None:
                        recorder.put(packed(start_ns + k * 10**6, rows[:n], rows[:0]))
                k += 1
            del injected.recorded[:-100_000]
            injected.tidy(k)
            if recorder is not None:
                recorder.poll()
            if speed and k >= until:
                time.sleep(max(0.0, began + (k - began_k) / (1000.0 * speed) - time.perf_counter()))
            elif speed:  # this machine cannot keep up: go on from here
                began, began_k = time.perf_counter(), k
            took = time.perf_counter() - due + NEWS
            reached += 0.2 * ((k - first_k) / 1000.0 / max(took, 1e-9) - reached)
            injecting = max(0.0, min(injected.end, 1e6) - k * 1e-3)
            more = {"speed": reached, "n_dem": typed.n_dem, "load": channel.load, "injecting": injecting}
            progress(None, {**heard.news(), **tool.news(), **more, "injected": injected.news()})
    finally:
        if recorder is not None:
            recorder.close()
    return {"simulated_s": k * 1e-3, "record": record, "state_hash": node.fingerprint(), "frames": heard.frames}


def node(
    progress: Progress,
    bus: str,
    record: str | None,
    seed: int | None,
    tables: str | None = None,
    controller: str | None = None,
    boxes: str | None = None,
    tuned: str | None = None,
) -> dict[str, Any]:
    """Controller and plant in real time, as ``vaneloop run`` does: lateness as it goes, until told to stop."""
    progress(None, COMPILING)
    machine = _machine(tables, controller, boxes)
    made = Node(machine.plant, machine.calibration, seed=seed)
    return _in_real_time(progress, bus, _attended(progress, made, tuned, bus), record, None)


def ecu(progress: Progress, bus: str, demand: float, profile: str | None, tables: str | None = None) -> dict[str, Any]:
    """The ECU in real time, as ``vaneloop ecu`` does: the demand is told, until told to stop."""
    typed = Typed(demand)
    return _in_real_time(
        progress, bus, EcuStation(typed, ecu=Ecu(Machine(tables).plant, n_dem=demand)), None, (typed, profile)
    )


def _in_real_time(progress: Progress, name: str, station: Any, record: str | None, typed: Any) -> dict[str, Any]:
    stop = Stop()
    station.tick(np.zeros((1, 2), np.int64), 0)  # compiled before the first deadline

    def follow() -> None:
        curve: Any = builtin(typed[1]).per_frame()[:, 0] if typed and typed[1] else None
        since = time.perf_counter()
        while not stop.asked:
            told = _told()
            if "stop" in told:
                stop.asked = "stop"
            if typed is not None:
                if "demand" in told:
                    typed[0].n_dem, curve = min(max(float(told["demand"]), 0.0), 120.0), None
                if "mode_request" in told:
                    typed[0].mode_request = int(told["mode_request"])
                if "profile" in told:
                    curve, since = builtin(told["profile"]).per_frame()[:, 0], time.perf_counter()
                if curve is not None:
                    typed[0].n_dem = float(curve[min(int((time.perf_counter() - since) * 100.0), len(curve) - 1)])
            time.sleep(0.02)

    bus = open_bus(name, can_filters=accepted(parsed("run", [] if typed else ["--xcp"])))
    recorder = RecorderProcess(record, name.replace(":", "-")) if record else None
    following = threading.Thread(target=follow, daemon=True)
    following.start()

    def live(report: Any) -> None:
        figures = {**report.begin.figures(), "ticks": report.ticks, "missed": report.missed, "skipped": report.skipped}
        progress(None, {"late": figures, "histogram": report.begin.shown()})

    try:
        with undisturbed() as notes:
            report = run_realtime(
                station, Port(bus), stop=stop, put=recorder.put if recorder is not None else None, live=live
            )
    finally:
        stop.asked = stop.asked or "ended"
        following.join()  # what is told from now on is the next task's
        bus.shutdown()
        if recorder is not None:
            recorder.close()
    return {"late": report.begin.figures(), "histogram": report.begin.shown(), "ticks": report.ticks,
        "missed": report.missed,
            "failed": report.failed, "notes": notes, "record": record}  # fmt: skip


def listen(progress: Progress, bus: str) -> dict[str, Any]:
    """Hear everything on a bus, and be the calibration tool on it, until told to stop."""
    opened = open_bus(bus)
    port, heard, tool = Port(opened), Heard(), Tool()
    rows = np.zeros((512, 2), np.int64)
    began = time.perf_counter()
    try:
        while "stop" not in (told := _told()):
            tool.ask(told.get("xcp", []))
            due = time.perf_counter() + NEWS
            while time.perf_counter() < due:
                n = port.read(rows)
                t = time.perf_counter() - began
                for head, data in rows[:n].tolist():
                    heard.hear(t, head, data)
                    tool.hear(head, data)
                commands = tool.send(1000.0 * t)
                if commands:
                    port.write(np.array(commands, np.int64))
                if n < len(rows):
                    time.sleep(0.005)
            progress(None, {**heard.news(), **tool.news(), "lost": port.lost, "clock": began})
    finally:
        opened.shutdown()
    return {"frames": heard.frames}


def outside(progress: Progress, scenario: str, bus: str) -> bool:
    """Do a shipped scenario to a bus in real time, as ``vaneloop inject`` does; whether the expectations held.

    Says when its first action began: ``at`` on this machine's clock, which the listener's ``clock`` counts from.
    """
    made = load_scenario(scenario)
    first = min((a.start for a in made.inject), default=0.0)
    told = False

    def share(fraction: float) -> None:
        nonlocal told
        if not told and fraction * made.duration >= first:
            told = True
            progress(None, {"at": time.perf_counter(), "name": scenario})
        progress(fraction, f"injecting {scenario}")

    return run(made, bus=bus, name=scenario, progress=share).held


TASKS = {f.__name__: f for f in (ready, lockstep, node, ecu, listen, outside)}

if __name__ == "__main__":
    if "--nice" in sys.argv:
        os.nice(5)
    sys.exit(terminal.run(lambda: answer(int(sys.argv[1]), TASKS)))
