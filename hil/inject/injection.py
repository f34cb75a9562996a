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
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from controller import MODES, STATE, flat, load_calibration
from controller.channels import SEEN
from hil.bus import frames
from hil.bus.port import Port, open_bus
from hil.inject.actions import (
    ACTIONS,
    Babble,
    BusOff,
    ChannelFault,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    ErrorFrames,
    Flood,
    Freeze,
    Link,
    Machine,
    Outsider,
    Override,
    Reorder,
    Replay,
    Send,
)
from hil.inject.any_controller import Reactions, expected_of_any
from hil.inject.on_lockstep import TICK, OnLockstep, check_stages
from hil.inject.scenario import COUNTS, OF_CHANNELS, Expect, Scenario, library, load_scenario
from hil.inject.tamper import Intruder
from hil.inject.verdict import TRANSITIONS, Check, Outcome, Trace, failed, judge, outcome_of
from hil.loop.pair import seen as seen_of
from hil.native.isolation import ControllerFailed, isolated
from plant import Model, build_plant, places
from plant.effects import EFFECTS
from plant.model import Side
from vaneloop.base.errors import InputError
from vaneloop.base.extras import is_there
from vaneloop.base.signals import SIDES
from vaneloop.base.vanes import VANES

if TYPE_CHECKING:
    from controller import Calibration
    from plant import Plant

__all__ = [
    "ACTIONS", "TRANSITIONS", "Babble", "BusOff", "ChannelFault", "Check", "Corrupt", "Delay", "Drop", "Duplicate",
    "ErrorFrames", "Expect", "Flood", "Freeze", "Link", "Machine", "Outcome", "Override", "Reorder", "Replay",
    "Scenario", "Send", "Trace", "judge", "library", "load_scenario", "run",
]  # fmt: skip

# ---- lockstep: controller, ECU and bus in simulated time -------------------------------------------------------------


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
    if why := lacks(scenario, plant, calibration):
        raise InputError(f"{name}: {why}")
    if scenario.of_two_actuators:
        for a in scenario.inject:
            if isinstance(a, Machine) and a.side is not None:
                side = Side(effects={str(a.effect): a.parameters})
                (Model(side_a=side) if a.side == "a" else Model(side_b=side)).check(plant, name)
        plant = Model(side_a=scenario.side_a, side_b=scenario.side_b).plant(plant)
    started = time.perf_counter()
    check_stages(name, scenario, plant)
    loop = OnLockstep(scenario, plant, calibration)
    node, ticks, stages = loop.node, round(scenario.duration * 1000.0), len(plant.vanes)
    z, s = flat(node.loop.state), node.loop.s
    seen = np.array([STATE.index(n) for n in ("mode", "faults", "x_dem", "x_meas", "i_cmd", "n_dem", "n_r_raw")])
    firmware, pots = np.empty((ticks, len(seen))), np.empty((ticks, stages))
    pair, sides = node.loop.pair, node.loop.sides
    channels, lvdts = np.empty((ticks, len(SEEN) + 1 if pair else 0)), np.empty((ticks, len(sides)))
    counts = np.empty((ticks, len(COUNTS)), np.int64)
    late = np.zeros((ticks, len(loop.heard)), bool)
    to_border = np.array([1e3, 1e3, 1e3, 1.0, 1.0, *([180.0 / np.pi] * stages)])
    for k in range(ticks):
        loop.tick()
        firmware[k], pots[k] = z[seen], s[places.POT : places.POT + stages, 0]
        lvdts[k] = sides
        if pair:
            channels[k] = (*seen_of(pair), node.loop.given.i_cmd * 1e3)
        counts[k] = loop.counts()
        late[k] = [n in loop.missed for n in loop.heard]
        if progress is not None and k % 1000 == 0:
            progress(k / ticks)
    cal = node.loop.calibration.scalars
    signals = np.hstack([firmware[:, 2:], pots]) * to_border
    trace = Trace(
        np.arange(ticks) * TICK,
        firmware[:, 0].astype(np.int8),
        firmware[:, 1].astype(np.int64),
        {
            **dict(zip(("x_dem", "x_lvdt", "i_cmd", "n_dem", "n_r", *plant.vanes), signals.T, strict=True)),
            **dict(zip(SIDES, lvdts.T * 1e3, strict=False)),
            **dict(zip(OF_CHANNELS, channels.T, strict=False)),
        },
        dict(zip(COUNTS, counts.T, strict=True)),
        dict(zip(loop.heard, late.T, strict=True)),
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


def lacks(scenario: Scenario, plant: Plant, calibration: Calibration | None = None) -> str:
    """Return what the scenario does to an actuator that this machine does not have, to channels that its controller
    does not have, or with a package that is not installed; empty if there is no such thing.
    """
    if scenario.of_two_channels and (calibration is None or calibration.channels is None):
        return "is about two channels of the controller: --channels 2 --plant plant_two_actuators.toml has them"
    if scenario.of_two_actuators and plant.sides != 2:
        return "is about one of two actuators: --plant plant_two_actuators.toml has them"
    if scenario.secoc and not is_there("cryptography"):
        return "secoc: authentication needs cryptography, which is not installed: pip install 'vaneloop[secoc]'"
    for a in scenario.inject:
        if isinstance(a, Machine):
            if a.p_s is not None and plant.kind != "hydraulic":
                return f"machine: p_s: the {plant.kind} actuator takes no oil"
            if a.effect is not None and (why := plant.lacks(EFFECTS[a.effect])):
                return f"machine: effect {a.effect} {why}"
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
