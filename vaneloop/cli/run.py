"""``vaneloop run``: controller and plant as a node on the bus, in real time or in lockstep."""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from controller import FAULTS
from hil.bus.frames import AUTH_NAMES, ECU_DEMAND, FRESHNESS, HEAD_MASK, IDENT_MASK, NAMES, PAUSE, PREPARED
from hil.bus.lockstep_bus import run_lockstep
from hil.bus.port import Port
from hil.bus.wire import BIT_RATE, BITS_PER_TICK
from hil.calibrate.station import replay_attended
from hil.fmu.plant_fmu import PlantFmu, PlantNode
from hil.logs.notes import told
from hil.logs.recorder import Recorder, check_name
from hil.logs.recordings import read_record
from hil.loop.node import Ecu, Node, replay
from hil.loop.realtime import Ticker, packed, run_realtime, stop_on_signals, wall_clock
from hil.loop.secured import run_secured
from hil.native.program import observables
from plant import build_plant
from plant.effects import rows_at
from plant.parameters import ACCELERATION, DECELERATION, LAG
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.cli import attended, options, station
from vaneloop.cli.ecu import demand_of

__all__ = ["DESCRIPTION", "add_options", "command"]

LOST = {"dropped": "frames dropped", "untaken": "answers not taken"}  # of a service, `hil.calibrate.Attended.lost`

DESCRIPTION = """Controller with its plant as a node on the CAN bus: it takes ECU_DEMAND and sends VGV_STATUS,
VGV_SERVO, VGV_ANGLES (_2, _3) and VGV_HEALTH (tables/vgv.dbc), 1,000 ticks a second. On vcan0 or local in real
time, until --duration or Ctrl-C; at the end it says how late its ticks were. On lockstep in simulated time with an ECU
of its own, or with the frames of a record (--inputs).

examples:
  vaneloop run --bus vcan0                      (and in another terminal: vaneloop ecu --bus vcan0 --profile ramp)
  vaneloop run --bus local --duration 60 --record run.mf4 --limit-late-us 2000
  vaneloop run --bus lockstep --profile slam --record slam.log
  vaneloop run --bus lockstep --inputs run.mf4  the recorded run again: must send the same frames, bit for bit
  vaneloop run --bus vcan0 --xcp --uds          for INCA, CANape, pyxcp (docs/xcp.md) and service tools (docs/uds.md)

exit codes: 0 good (also after Ctrl-C), 1 a limit is exceeded, the repeated run differs or the record is incomplete, 2
bad input
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--bus",
        metavar="B",
        help=f"{station.BUS_HELP}, or lockstep (simulated time); default: vcan0 if there is one, else local",
    )
    parser.add_argument(
        "--duration",
        metavar="S",
        type=float,
        help="seconds to run (default: until Ctrl-C; in lockstep the profile's or the record's)",
    )
    parser.add_argument(
        "--record", metavar="F", help=f"record the frames taken and sent, at their ticks: {station.A_RECORDING}"
    )
    parser.add_argument(
        "--limit-late-us", metavar="N", type=float, help="exit 1 if a tick began more than N us after its deadline"
    )
    parser.add_argument(
        "--limit-share",
        metavar="P",
        type=float,
        default=0.0,
        help="per cent of ticks that may be later than --limit-late-us (default 0)",
    )
    parser.add_argument("--seed", metavar="N", type=int, help="noisy sensors, with this seed (default: noise-free)")
    options.add_machine_options(parser)
    options.add_channels_option(parser)
    parser.add_argument(
        "--plant-map",
        metavar="NAME=signal",
        action="append",
        default=[],
        help="with --plant X.fmu, a plant of your own (docs/fmu.md): the FMU's NAME is our signal",
    )
    options.add_controller_options(parser)
    parser.add_argument(
        "--start-speed",
        metavar="N",
        type=float,
        default=60.0,
        help="rotor speed, %%, that the machine starts at (default 60)",
    )
    group = parser.add_argument_group("lockstep")
    group.add_argument(
        "--inputs", metavar="RECORD", help="repeat a recorded run with the frames it took; compare the frames it sent"
    )
    group.add_argument("--profile", metavar="F", help="demand of the run's own ECU: as in vaneloop ecu (default: ramp)")
    group.add_argument("--log", metavar="F", help="demand of the run's own ECU from a log")
    options.add_reading_options(parser.add_argument_group("reading the log (docs/logs.md)"))
    attended.add_service_options(parser)
    station.add_secoc_option(parser)
    station.add_realtime_options(parser)
    terminal.add_output_options(parser)
    parser.add_argument(
        "--live", action="store_true", help="a line every second on standard error, also where that is no terminal"
    )


@options.guarded
def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    station.check_realtime_options(args)
    if args.limit_late_us is not None and not args.limit_late_us >= 0.0:
        raise InputError(f"--limit-late-us (={args.limit_late_us:g}) must be 0 or more")
    if not 0.0 <= args.limit_share < 100.0:
        raise InputError(f"--limit-share (={args.limit_share:g} %) must be in [0, 100)")
    if not 0.0 <= args.start_speed <= 120.0:
        raise InputError(f"--start-speed (={args.start_speed:g} %) must be in [0, 120]")
    if args.seed is not None and args.seed < 0:
        raise InputError(f"--seed (={args.seed}) must be 0 or more")
    args.plant_fmu = None
    if args.plant is not None and args.plant.lower().endswith(".fmu"):
        if args.model:
            raise InputError(f"--model {args.model}: is about the plant here, which {args.plant} replaces")
        args.plant_fmu, args.plant = args.plant, None
    elif args.plant_map:
        raise InputError("--plant-map names variables of an FMU: it needs --plant X.fmu")
    if args.record:
        check_name(args.record)
    name = station.bus_name(args)
    lockstep = name.partition(":")[0] == "lockstep"
    attended.check_service_options(args, lockstep)
    for option in ("inputs", "profile", "log"):
        if getattr(args, option) and not lockstep:
            raise InputError(
                f"--{option} is for --bus lockstep; on {name} the demand comes from the bus: vaneloop ecu --bus {name}"
            )
    if lockstep and args.limit_late_us is not None:
        raise InputError("--limit-late-us is for real time; --bus lockstep is never late")
    if sum(bool(o) for o in (args.inputs, args.profile, args.log)) > 1:
        raise InputError("--inputs, --profile and --log exclude each other")
    options.log_options(args, args.profile)
    if not lockstep:
        return _in_real_time(args, name)
    return _repeat(args) if args.inputs else _in_lockstep(args)


def _node(args: argparse.Namespace, machine: Any = None) -> Any:
    machine = machine or options.machine_of(args)
    station.warm_nodes(args)
    if args.plant_fmu is not None:
        mapping = terminal.pairs(args.plant_map, "plant-map")
        fmu = PlantFmu(args.plant_fmu, machine.plant.vanes, mapping, n_r=args.start_speed)
        terminal.notes(args, fmu.notes)
        return PlantNode(fmu, machine.plant, machine.calibration, n_r=args.start_speed, seed=args.seed)
    return Node(machine.plant, machine.calibration, n_r=args.start_speed, seed=args.seed)


def _say_engine(args: argparse.Namespace, machine: Any, bus: str) -> None:
    """Say where the model's changed engine runs: in the ECU, which is another program here."""
    rows = [LAG, ACCELERATION, DECELERATION, *rows_at("engine")]
    if args.model and (machine.plant.p[rows] != build_plant().p[rows]).any():
        terminal.say(
            args, f"note: the engine of {args.model} runs in the ECU: vaneloop ecu --bus {bus} --model {args.model}"
        )


def _node_json(node: Any) -> dict[str, Any]:
    faults = [name for bit, name in enumerate(FAULTS) if node.faults >> bit & 1]
    n_dem = float(node.loop.state.n_dem)
    own = observables(node.loop.foreign)
    return {
        **({"own": own} if own else {}),
        "mode": node.mode,
        "n_dem": n_dem,
        "faults": faults,
        "counts": node.counts,
        "state_hash": node.fingerprint(),
    }


def _say_tools(args: argparse.Namespace, serviced: Any) -> dict[str, Any]:
    """Say what was lost of tools' frames because more came than a tick has time for; return it for the JSON."""
    if not attended.wanted(args):
        return {}
    for name, lost in serviced.lost.items():
        said = ", ".join(f"{n:,} {LOST[what]}" for what, n in lost.items())
        terminal.say(args, f"tools over {name.upper()}: {said}")
    return {"tools": serviced.lost}


def _say_node(args: argparse.Namespace, node: Any) -> None:
    c, state = node.counts, _node_json(node)
    faults = ", ".join(state["faults"]) or "none"
    for name, o in state.get("own", {}).items():
        terminal.say(args, f"{name}: {o['value']:g} {o['unit']} ({o['meaning']})")
    refused = sum(
        c[k] for k in ("wrong_crc", "repeated", "wrong_sequence", "wrong_length", "wrong_kind", "unauthentic")
    )
    terminal.say(
        args,
        f"controller: {node.mode}; faults now: {faults}; ECU_DEMAND good {c['good']:,}, lost {c['lost']:,}, refused "
        f"{refused:,}",
    )
    station.say_authentication(args, node, c["unauthentic"])
    terminal.say(args, f"state hash: {state['state_hash']}")


# ---- real time -------------------------------------------------------------------------------------------------------


def _in_real_time(args: argparse.Namespace, name: str) -> int:
    authenticator = station.authenticator(args)
    machine = options.machine_of(args)
    machine.calibration.of_one_channel("a bus in real time")
    node = _node(args, machine)
    _say_engine(args, machine, name)
    ticks = None if args.duration is None else round(args.duration * 1000)
    serviced = station.secured(attended.attend(args, node), authenticator, clock=wall_clock())
    accepted = attended.accepted(args)
    with stop_on_signals() as stop, station.joined(name, args.realtime_priority, can_filters=accepted) as bus:
        port = Port(bus)
        live = station.Live(args)

        def show(report: Any) -> None:
            begin = report.begin
            live.say(
                f"{report.ticks // 1000:>6} s  {node.mode:<9}  late: p99 {begin.quantile(0.99):.0f}, p99.9 "
                f"{begin.quantile(0.999):.0f}, max {begin.worst_ns / 1000:.0f} us  missed {report.missed}  frames in "
                f"{report.received}, out {report.sent}"
            )

        with station.recording(args, name) as recorder:
            terminal.say(
                args,
                f"controller and plant on {name}, 1 kHz{'' if ticks is None else f', {args.duration:g} s'}, "
                f"{station.authentication_words(args)}; Ctrl-C ends",
            )
            try:
                with station.undisturbed(args) as notes:
                    report = run_realtime(
                        serviced, port, ticks=ticks, ticker=Ticker(spin_us=args.spin_us, policy=args.policy), stop=stop,
                        put=recorder.put if recorder is not None else None, live=show if live.on else None,
                        watch=station.BusWatch(args, name, port),
                    )  # fmt: skip
            finally:
                live.close()
    terminal.notes(args, notes)
    terminal.say(args, f"{report.ticks / 1000:,.3f} s on {name}{f', ended by {report.ended}' if report.ended else ''}")
    station.print_lateness(args, report)
    terminal.say(
        args,
        f"frames: {report.received:,} taken, {report.sent:,} sent, {port.refused:,} not taken by the bus, "
        f"{port.lost:,} lost",
    )
    tools = _say_tools(args, serviced)
    _say_node(args, serviced)
    exceeded = []
    if report.failed:
        exceeded.append(report.failed)
    if args.limit_late_us is not None:
        worst = report.begin.worst_ns * 1e-3
        share = 100.0 * (
            report.begin.share_over(args.limit_late_us) if args.limit_share else float(worst > args.limit_late_us)
        )
        if share > args.limit_share:
            what = f"{share:.3f} % of ticks" if args.limit_share else f"a tick ({worst:,.1f} us)"
            allowed = f"; allowed: {args.limit_share:g} %" if args.limit_share else ""
            exceeded.append(f"{what} began later than the limit of {args.limit_late_us:g} us{allowed}")
    record = _record_json(args, recorder, exceeded)
    for line in exceeded:
        terminal.say(args, f"exceeded: {line}")
    terminal.write_json(args, {
        "schema": 1, "bus": name, "time": "real", "ended": report.ended, **station.realtime_json(report),
        "policy": args.policy, "realtime_priority": args.realtime_priority, "spin_us": args.spin_us, "notes": notes,
        "frames": {"received": report.received, "sent": report.sent, "refused": port.refused, "lost": port.lost,
        "bus_errors": port.errors},
        **tools, **_node_json(node), "secoc": station.authentication_json(args, serviced), "record": record,
        "exceeded": exceeded,
    })  # fmt: skip
    return 1 if exceeded else 0


def _record_json(args: argparse.Namespace, recorder: Any, exceeded: list[str]) -> dict[str, Any] | None:
    """Say what is in the record; what is not goes into ``exceeded``."""
    if recorder is None:
        return None
    if recorder.error:
        exceeded.append(f"the record is incomplete: {recorder.error}")
    elif recorder.lost:
        exceeded.append(f"the record is incomplete: the disk was too slow for {recorder.lost:,} frames")
    terminal.say(args, f"record: {args.record}, {recorder.frames:,} frames")
    return {"path": args.record, "frames": recorder.frames, "lost": recorder.lost, "error": recorder.error}


# ---- lockstep --------------------------------------------------------------------------------------------------------


def _in_lockstep(args: argparse.Namespace) -> int:
    authenticator = station.authenticator(args)
    notes: list[str] = []
    demand = demand_of(args, notes, default="ramp")
    profile = demand.per_frame()
    machine = options.machine_of(args)
    node = _node(args, machine)
    ecu = Ecu(machine.plant, n_dem=float(profile[0, 0]), seed=None if args.seed is None else args.seed + 1)
    secured = station.secured(node, authenticator)
    duration = args.duration if args.duration is not None else demand.duration
    start, whole = time.time_ns() // 10**9 * 1000, None
    with terminal.progress_bar(args, "lockstep") as progress:
        if authenticator is not None:
            other = station.secured(ecu, authenticator, ecu=True)
            whole = run_secured(profile, secured, other, start=start, duration=duration, progress=progress)
            run = whole.run
        else:
            run = run_lockstep(
                profile[:, 0], profile[:, 1], vgv=node, ecu=ecu, duration=duration,
                keep=bool(args.record), progress=progress,
            )  # fmt: skip
    ticks = node.k
    terminal.say(
        args,
        f"{run.simulated_s:,.3f} s simulated in {run.wall_s:.2f} s ({run.simulated_s / run.wall_s:,.0f} times real "
        f"time)",
    )
    terminal.say(
        args,
        f"bus: {run.frames:,} frames, {run.error_frames:,} error frames, load {100 * run.load:.1f} % of 500 kbit/s",
    )
    _say_node(args, secured)
    record = None
    if whole is not None and args.record:
        record = _write_record(args, whole.taken, whole.taken_at, whole.sent_at, whole.sent, start)
    elif args.record:
        # a frame is taken in the first tick that begins after its last bit; in which ticks frames were sent, the same
        # ticks say again
        tick = -(-np.rint(run.t * BIT_RATE).astype(np.int64) // BITS_PER_TICK)
        taken = (run.rows[:, 0] & IDENT_MASK == ECU_DEMAND) & (tick < ticks)
        again = _node(args, machine)
        at, sent = replay(again, tick[taken], run.rows[taken], ticks)
        if again.fingerprint() != node.fingerprint():
            raise RuntimeError("the run does not repeat with the frames that it took: a fault of vaneloop")
        record = _write_record(args, run.rows[taken], tick[taken], at, sent, start)
    terminal.write_json(args, {
        "schema": 1, "bus": "lockstep", "time": "simulated", "ticks": ticks, "simulated_s": run.simulated_s,
        "wall_s": run.wall_s,
        "bus_load": run.load, "frames": {"on_the_bus": run.frames, "error_frames": run.error_frames},
        **_node_json(node), "secoc": station.authentication_json(args, secured),
        "record": record, **(told(notes) if args.log or args.profile else {}), "exceeded": [],
    })  # fmt: skip
    return 0


def _repeat(args: argparse.Namespace) -> int:
    authenticator = station.authenticator(args)
    record = read_record(args.inputs)
    secured = bool((record.rows[:, 0] == FRESHNESS).any())
    if secured != (authenticator is not None):
        raise InputError(
            f"{args.inputs}: was recorded with authentication: --secoc KEY, with the key of then, repeats it"
            if secured
            else f"--secoc: {args.inputs} was recorded without authentication"
        )
    node = _node(args)
    # the first frame sent is VGV_STATUS of tick 0; a record of another program's knows no directions and begins with
    # its first frame
    start = record.ms[np.argmax(record.sent)] if record.sent.any() else record.ms[0]
    tick = record.ms - start
    taken = ~record.sent
    if (tick[taken] < 0).any():
        raise InputError(
            f"{args.inputs}: frames were taken before the first one was sent: not a record of vaneloop run"
        )
    last = int(tick[-1]) + 1
    ticks = (
        last if args.duration is None else round(args.duration * 1000)
    )  # a run ends up to 9 ticks after the last frame it sent
    started = time.perf_counter()
    received = record.rows[taken]
    old = np.isin(received[:, 0], [PAUSE & HEAD_MASK, PREPARED & HEAD_MASK])
    notes = []
    if old.any():
        notes.append(
            f"{args.inputs}: {int(old.sum()):,} frames 0x1FFFFF50 or 0x1FFFFF51 are taken for frames of the bus; in a "
            f"record of an earlier vaneloop they are the loop's pauses, and such a record does not repeat"
        )
        terminal.say(args, f"note: {notes[0]}")
    whole = station.secured(attended.attend(args, node, recorded=True), authenticator)
    if whole is not node:
        at, sent = replay_attended(whole, tick[taken], received, ticks)
    else:
        at, sent = replay(node, tick[taken], received, ticks)
    wall = time.perf_counter() - started
    held = record.sent & (tick < ticks)
    was_at, was = tick[held], record.rows[held]
    terminal.say(
        args,
        f"{ticks / 1000:,.3f} s of {args.inputs} repeated in {wall:.2f} s ({ticks / 1000 / wall:,.0f} times real time)",
    )
    exceeded: list[str] = []
    if not len(was):
        terminal.say(args, "the record says of no frame that it was sent: nothing to compare with")
    else:
        n = min(len(was), len(sent))
        same = (was_at[:n] == at[:n]) & (was[:n] == sent[:n]).all(axis=1)
        if not same.all():
            k = int(np.argmin(same))
            before, now = (
                f"tick {int(tick):,} {(NAMES | AUTH_NAMES).get(int(row[0]) & 0x7FF, '?')} "
                f"{int(row[1]).to_bytes(8, 'little', signed=True).hex().upper()}"
                for tick, row in ((was_at[k], was[k]), (at[k], sent[k]))
            )
            needed = "the same --seed, --model, --tables and --start-speed are needed" + (
                ", and the same key" if secured else ""
            )
            exceeded.append(f"frame {k + 1:,} of {len(was):,}: {before} was sent, now {now}; {needed}")
        elif len(was) != len(sent):
            exceeded.append(f"{len(was):,} frames were sent, now {len(sent):,}")
        else:
            terminal.say(args, f"all {len(was):,} frames sent are the same, bit for bit, in the same ticks")
    tools = _say_tools(args, whole)
    _say_node(args, whole)
    for line in exceeded:
        terminal.say(args, f"differs: {line}")
    terminal.write_json(args, {
        "schema": 1, "bus": "lockstep", "time": "simulated", "inputs": args.inputs, "ticks": ticks,
        "simulated_s": ticks / 1000,
        "wall_s": wall, "compared": len(was), "same": not exceeded, **tools, **_node_json(node),
        "secoc": station.authentication_json(args, whole), "notes": notes,
        "exceeded": exceeded,
    })  # fmt: skip
    if args.record:
        _write_record(args, received, tick[taken], at, sent, int(start))
    return 1 if exceeded else 0


def _write_record(
    args: argparse.Namespace, received: Any, received_at: Any, at: Any, sent: Any, start: int
) -> dict[str, Any]:
    """Record a run in lockstep as one in real time is: frames taken and sent, with their ticks; ``start`` in ms since
    1970.
    """
    recorder = Recorder(args.record, "lockstep")
    if recorder.kept is not None:
        terminal.say(args, f"{args.record} was there already: it is now {recorder.kept}")
    ticks = np.union1d(received_at, at)
    ends = [
        np.searchsorted(these, ticks, side=side).tolist() for these in (received_at, at) for side in ("left", "right")
    ]
    for n, (k, a, b, c, d) in enumerate(zip(ticks.tolist(), *ends, strict=True), 1):
        recorder.put(packed((start + k) * 10**6, received[a:b], sent[c:d]))
        if n % 10_000 == 0:
            recorder.flush()
    recorder.close()
    terminal.say(args, f"record: {args.record}, {recorder.frames:,} frames")
    return {"path": args.record, "frames": recorder.frames, "taken": len(received), "sent": len(sent)}
