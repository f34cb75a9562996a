"""Replay a logged engine run through the controller's firmware and the plant, and say where they agree with it.

``python -m hil.replay LOG`` and ``vaneloop replay LOG`` are the same command. What the firmware gets is what the log's
ECU sent: ``n_dem`` and, where logged, ``n_r``; otherwise the plant's engine supplies the speed. Supply pressure and oil
temperature are taken from the log too. Everything behind is simulated in closed loop and held against what the log
measured; vane angles also against the schedule's target at the measured speed, as in the paper's Table 5.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from controller import load_calibration
from hil.figures import error_figures
from hil.logs import LogError
from hil.logs.held import ANSWERS, COMMANDS, SAME, answers, held, phase_of_ticks, taken
from hil.logs.notes import Note, told
from hil.loop.lockstep import FRAME, Stimulus, lockstep
from plant import build_plant
from vaneloop.base.signals import SIDES, UNITS
from vaneloop.base.vanes import VANES

if TYPE_CHECKING:
    from hil.figures import SignalError
    from hil.logs import Channel, Log

__all__ = ["ReplayResult", "apart", "replay", "replay_json"]

STAGE = {
    "n_r": "engine", "x_dem": "demand", "i_cmd": "servo", **dict.fromkeys(("x_lvdt", *SIDES), "actuator"),
    **dict.fromkeys(VANES, "linkage"),
}  # fmt: skip
DRIVERS = ("n_dem", "n_r", "p_s", "t_oil")  # what the simulated loop takes from the log
BRIDGED = 0.1  # s, the longest period of the product's own frames that carry a driver
STATISTICS = ("rms", "mean_abs", "max_abs", "mean_abs_99_100")


@dataclass(frozen=True)
class ReplayResult:
    """A replayed log: figures per signal and the curves behind them. Units as at every border
    (docs/architecture.md).
    """

    log: str
    simulated_s: float
    wall_s: float
    state_hash: str
    signals: list[SignalError]
    t: np.ndarray
    model: dict[str, np.ndarray]
    target: dict[str, np.ndarray]
    measured: dict[str, Channel]
    notes: list[str] = field(default_factory=list)


def replay(
    log: Log,
    *,
    strategy: str | None = None,
    plant: Any = None,
    calibration: Any = None,
    progress: Callable[[float], None] | None = None,
    floors: Mapping[str, float] | None = None,
) -> ReplayResult:
    """Run ``log`` through controller and plant and compare.

    strategy     one of `controller.STRATEGIES`; default: the calibration's
    plant        `plant.Plant`; default: the nominal one
    calibration  `controller.Calibration`; default: the shipped tables
    floors       noise floors of signals, in their units, where they are known better than from this run

    Raises LogError for a log that cannot drive the loop.
    """
    machine = plant or build_plant()
    cal = calibration or load_calibration(strategy=strategy)
    notes, known = list(log.notes), dict(floors or {})
    channels, begin = _driven(log, notes)
    demand = channels["n_dem"]
    end = float(demand.t[-1])
    if end < 0.1:
        raise LogError(f"{log.path}: n_dem: lasts {end:g} s; at least 0.1 s is needed")
    raster = float(np.median(np.diff(demand.t))) if len(demand.t) > 1 else end
    first = phase_of_ticks(channels, FRAME)
    ticks = first + np.arange(int((end - first) * 100.0 + 1e-6) + 1) * 1e-2
    had = taken(channels, ticks, 0.5 * FRAME)
    given = {
        name: c.values[held(c, had if name in COMMANDS and c.framed else ticks)]
        for name in DRIVERS
        if (c := channels.get(name)) is not None
    }
    stimulus = Stimulus.of(
        given["n_dem"],
        given.get("n_r"),
        given["p_s"] * 1e6 if "p_s" in given else machine.usual["p_s"] * 1e6,
        given.get("t_oil", machine.usual["t_oil"]),
    )
    angles = tuple(np.deg2rad(_begins(channels[a])) if a in channels else np.nan for a in machine.vanes)
    start = _begins(channels["x_dem"]) * 1e-3 if "x_dem" in channels else None
    outputs = [channels[s] for s in STAGE if s in channels]
    fine = min((float(np.median(np.diff(c.t))) for c in outputs if len(c.t) > 1), default=1e-2) < 5e-3
    run = lockstep(
        stimulus,
        calibration=cal,
        plant=machine,
        angles=angles,
        stroke_demand=start,
        every=1 if fine else 10,
        progress=progress,
    )

    t, model = first + run.t, {name: run.columns[name] for name in UNITS if name in run.columns}
    model["n_r"] = run.columns["n_engine"]
    if "i_motor" in run.columns:
        model["i_motor"] = run.columns["i_motor"]
    speed = run.columns["n_r"]
    target = dict(zip(machine.vanes, np.rad2deg(machine.schedules.targets(speed)).T, strict=True))
    gap = max(0.5, 5.0 * raster)
    holes = np.diff(demand.t) > gap
    if holes.any():
        notes.append(
            f"n_dem: {int(holes.sum())} gaps longer than {gap:g} s; the last value is held and errors there do not "
            f"count"
        )
    notes += apart(model)
    in_ticks = answers(channels) is not None
    signals = []
    for name, stage in STAGE.items():
        if name in channels and name not in model:
            why = "has one actuator" if name in SIDES else "has no such vane row (geometry)"
            notes.append(f"{name}: this machine {why}; not compared")
        elif name in channels:
            c = channels[name]
            if name in COMMANDS and c.framed:  # the plant's engine gets a demand when the controller has it
                c = _when_had(c, ticks, had)
            use = (c.t >= -SAME) & (c.t <= end + 1e-9) & ~_in_hole(c.t, demand, gap)
            if use.any():
                sent = in_ticks and c.framed and name in ANSWERS and name != "i_cmd"
                values = _model_at(name, t, model[name], _in_tick(c.t, t) if sent else c.t)
                signals.append(
                    error_figures(
                        name,
                        stage,
                        UNITS[name],
                        "measured",
                        c.t[use],
                        values[use],
                        c.values[use],
                        np.interp(c.t[use], t, speed),
                        known.get(name),
                    )  # fmt: skip
                )
            else:
                notes.append(f"{name}: no sample while n_dem is known; not compared")
        if name in target:
            use = ~_in_hole(t, demand, gap)
            noise = known.get(name, float(machine.sigma[1]) * 180.0 / np.pi)
            signals.append(
                error_figures(
                    name, stage, "deg", "schedule", t[use], model[name][use], target[name][use], speed[use], noise
                )
            )
    return ReplayResult(
        log.path, run.simulated_s, run.wall_s, run.state_hash, signals, t + begin, model, target, dict(log.channels),
        notes,
    )  # fmt: skip


def apart(columns: Mapping[str, np.ndarray]) -> list[str]:
    """How far apart the LVDTs of two actuators are in a run, in words; of one actuator nothing."""
    if not columns.keys() >= {*SIDES}:
        return []
    way = columns[SIDES[0]] - columns[SIDES[1]]
    most = way[np.argmax(np.abs(way))]
    return [f"{SIDES[0]} - {SIDES[1]}: {way.mean():.3f} mm in the mean, {most:.3f} mm at most"]


def _driven(log: Log, notes: list[str]) -> tuple[dict[str, Channel], float]:
    """The channels in time since all drivers are known, and when that is (s of the log's time): of what was before it
    nobody knows what drove it. A driver of a single sample is a constant; one of a slower raster is known as long
    before its first sample as its samples are apart, up to `BRIDGED`.
    """
    first = {"n_dem": float(log.channels["n_dem"].t[0])}
    for name in DRIVERS[1:]:
        if (c := log.channels.get(name)) is not None and len(c.t) > 1:
            first[name] = float(c.t[0]) - min(float(np.median(np.diff(c.t))), BRIDGED)
    last = max(first, key=lambda n: first[n])
    begin = first[last]
    before = begin - min(float(c.t[0]) for c in log.channels.values())
    if before > 0.5:
        said = f"the first {before:.4g} s of the log are before {last} begins: not simulated, not compared"
        rows = max(int(np.count_nonzero(c.t < begin)) for c in log.channels.values())
        notes.append(Note(said, "left out", "time", rows))
    same: dict[int, np.ndarray] = {}  # channels of a table share their time
    return {n: replace(c, t=same.setdefault(id(c.t), c.t - begin)) for n, c in log.channels.items()}, begin


def _begins(c: Channel) -> float:
    """A channel's value at time 0: of the last sample before it, or the first behind."""
    return float(c.values[held(c, np.zeros(1))][0])


def _when_had(c: Channel, ticks: np.ndarray, had: np.ndarray) -> Channel:
    """A command in frames, each at the first of the ``ticks`` that had it; ``had`` as of `hil.logs.held.taken`."""
    row = held(c, had)
    new = np.flatnonzero(np.diff(row, prepend=-1))
    return replace(c, t=ticks[new], values=c.values[row[new]])


def _in_tick(when: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The nearest of the simulated times ``t``: what the controller sent is that of its tick, when the bus was free."""
    return t[np.clip(np.rint((when - t[0]) / (t[1] - t[0])).astype(int), 0, len(t) - 1)]


def _in_hole(t: np.ndarray, c: Channel, gap: float) -> np.ndarray:
    """True where a channel's last sample is longer ago than ``gap`` (s)."""
    return t - c.t[held(c, t)] > gap


def _model_at(name: str, t: np.ndarray, values: np.ndarray, when: np.ndarray) -> np.ndarray:
    """The model's signal at the log's times: a current as its mean since the log's last sample, as it is logged; the
    rest in between.
    """
    if name != "i_cmd" or len(when) < 2:
        return np.interp(when, t, values)
    edges = np.concatenate([[2.0 * when[0] - when[1]], when])
    total = np.concatenate([[0.0], np.cumsum(values) * (t[1] - t[0])])
    integral = np.interp(edges, np.concatenate([[t[0] - (t[1] - t[0])], t]), total)
    return np.diff(integral) / np.maximum(np.diff(edges), 1e-9)


def replay_json(result: ReplayResult) -> dict[str, Any]:
    """Return the result as the JSON of the command."""
    return {
        "schema": 1,
        "log": result.log,
        "simulated_s": result.simulated_s,
        "wall_s": result.wall_s,
        "state_hash": result.state_hash,
        "signals": [asdict(s) for s in result.signals],
        **told(result.notes),
    }
