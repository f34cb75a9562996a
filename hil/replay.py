"""Replay a logged engine run through the controller's firmware and the plant, and say where they agree with it.

``python -m hil.replay LOG`` and ``vaneloop replay LOG`` are the same command. What the firmware gets is what the log's ECU sent: ``n_dem``
and, where logged, ``n_r``; otherwise the plant's engine supplies the speed. Supply pressure and oil temperature are taken from the log too.
Everything behind is simulated in closed loop and held against what the log measured; vane angles also against the schedule's target at the
measured speed, as in the paper's Table 5.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from hil import cli

if TYPE_CHECKING:
    import numpy as np

    from hil.figures import SignalError
    from hil.logs import Channel, Log

__all__ = ["ReplayResult", "add_options", "command", "replay", "replay_json"]

STAGE = {
    "n_r": "engine",
    "x_dem": "demand",
    "i_cmd": "servo",
    "x_lvdt": "actuator",
    "vigv": "linkage",
    "vgv1": "linkage",
    "vgv2": "linkage",
}
STATISTICS = ("rms", "mean_abs", "max_abs", "mean_abs_99_100")


@dataclass(frozen=True)
class ReplayResult:
    """A replayed log: figures per signal and the curves behind them. Units as at every border (docs/architecture.md)."""

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
    import numpy as np

    from controller import load_calibration
    from hil.figures import error_figures
    from hil.lockstep import Stimulus, lockstep
    from hil.logs import UNITS, LogError
    from plant import build_plant

    machine = plant or build_plant()
    cal = calibration or load_calibration(strategy=strategy)
    demand = log.channels["n_dem"]
    end = float(demand.t[-1])
    if end < 0.1:
        raise LogError(f"{log.path}: n_dem: lasts {end:g} s; at least 0.1 s is needed")
    raster = float(np.median(np.diff(demand.t))) if len(demand.t) > 1 else end
    frames = np.arange(int(end * 100.0 + 1e-6) + 1) * 1e-2
    held = {name: _hold(log.channels[name], frames) for name in ("n_dem", "n_r", "p_s", "t_oil") if name in log.channels}
    supply = machine.table.supply
    stimulus = Stimulus.of(
        held["n_dem"],
        held.get("n_r"),
        held["p_s"] * 1e6 if "p_s" in held else supply.pressure.value * 1e6,
        held.get("t_oil", supply.temperature.value),
    )
    angles = tuple(np.deg2rad(log.channels[a].values[0]) if a in log.channels else np.nan for a in ("vigv", "vgv1", "vgv2"))
    start = float(log.channels["x_dem"].values[0]) * 1e-3 if "x_dem" in log.channels else None
    outputs = [log.channels[s] for s in STAGE if s in log.channels]
    fine = min((float(np.median(np.diff(c.t))) for c in outputs if len(c.t) > 1), default=1e-2) < 5e-3
    run = lockstep(stimulus, calibration=cal, plant=machine, angles=angles, stroke_demand=start, every=1 if fine else 10, progress=progress)

    t, model = run.t, {name: run.columns[name] for name in UNITS}
    model["n_r"] = run.columns["n_engine"]
    speed = run.columns["n_r"]
    target = dict(zip(("vigv", "vgv1", "vgv2"), np.rad2deg(machine.schedules.targets(speed)).T, strict=True))
    notes, known = list(log.notes), dict(floors or {})
    gap = max(0.5, 5.0 * raster)
    holes = np.diff(demand.t) > gap
    if holes.any():
        notes.append(f"n_dem: {int(holes.sum())} gaps longer than {gap:g} s; the last value is held and errors there do not count")
    signals = []
    for name, stage in STAGE.items():
        if name in log.channels:
            c = log.channels[name]
            use = (c.t <= end + 1e-9) & ~_in_hole(c.t, demand.t, gap)
            if use.any():
                values = _model_at(name, t, model[name], c.t)
                signals.append(
                    error_figures(
                        name, stage, UNITS[name], "measured", c.t[use], values[use], c.values[use], np.interp(c.t[use], t, speed),
                        known.get(name),
                    )  # fmt: skip
                )
            else:
                notes.append(f"{name}: no sample while n_dem is known; not compared")
        if name in target:
            use = ~_in_hole(t, demand.t, gap)
            noise = known.get(name, float(machine.sigma[1]) * 180.0 / np.pi)
            signals.append(error_figures(name, stage, "deg", "schedule", t[use], model[name][use], target[name][use], speed[use], noise))
    return ReplayResult(log.path, run.simulated_s, run.wall_s, run.state_hash, signals, t, model, target, dict(log.channels), notes)


def _hold(channel: Channel, t: np.ndarray) -> np.ndarray:
    """Value of the last sample at or before each ``t``; before the first sample, the first."""
    import numpy as np

    i = np.searchsorted(channel.t, t + 1e-6, side="right") - 1
    return channel.values[np.maximum(i, 0)]


def _in_hole(t: np.ndarray, known: np.ndarray, gap: float) -> np.ndarray:
    """True where the last of the ``known`` times is longer ago than ``gap`` (s)."""
    import numpy as np

    i = np.maximum(np.searchsorted(known, t + 1e-6, side="right") - 1, 0)
    return t - known[i] > gap


def _model_at(name: str, t: np.ndarray, values: np.ndarray, when: np.ndarray) -> np.ndarray:
    """The model's signal at the log's times: a current as its mean since the log's last sample, as it is logged; the rest in between."""
    import numpy as np

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
        "notes": result.notes,
    }


# ---- command line -------------------------------------------------------------------------------------------------------------------

DESCRIPTION = """Replay a logged engine run through the controller's firmware and the plant.

The log's speed demand (and measured speed, supply pressure, oil temperature where logged) drives the loop; every other signal that the log
measured is compared with the simulated one, and the vane angles with their schedule.

examples:
  vaneloop replay examples/engine_run.blf --report replay.html
  vaneloop replay examples/hidden_effect.parquet --tolerance vigv=0.6 --json -
  vaneloop replay YOURS.log --dbc YOURS.dbc --map ENGINE_RPM=n_dem --unit n_dem=rpm --design-rpm 6000

exit codes: 0 agrees (or no tolerance given), 1 a tolerance is exceeded, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of replay and of compare."""
    cli.add_log_options(parser)
    group = parser.add_argument_group("the model and the judgement")
    group.add_argument(
        "--strategy", metavar="S", help="single (one mean curve), dual (one a direction), inverse or adaptive (docs/strategies.md)"
    )
    group.add_argument("--model", metavar="M.toml", help="a model file: recalibrated parameters and effects beyond the nominal machine")
    cli.add_tables_option(group)
    group.add_argument(
        "--tolerance",
        metavar="signal=value",
        action="append",
        default=[],
        help="largest RMS error allowed, in the signal's unit; signal.max_abs=value, signal.mean_abs=value for the other figures",
    )
    cli.add_output_options(parser)
    parser.add_argument("--report", metavar="F.html", help="write a self-contained HTML page with plots")
    parser.add_argument("--out", metavar="F", help="write the simulated run as a log (.csv, .parquet, .mf4, .log, .asc, .blf, .trc)")


def command(args: argparse.Namespace, extra: dict[str, Any] | None = None, floors: Mapping[str, float] | None = None) -> int:
    """Run replay from parsed options; ``extra`` goes into the JSON too, ``floors`` as in `replay`. Return the exit code."""
    from pathlib import Path

    from hil.logs import Channel, write_log
    from tables import InputError

    limits = _limits(args.tolerance)
    cli.tables_of(args, tell=True)
    calibration = cli.calibration_of(args, args.strategy)  # refuse a wrong name or table before reading a long log
    model = None
    if args.model is not None:
        from plant import load_model

        model = load_model(args.model, cli.machine_of(args))
    machine = cli.machine_of(args, model)
    log = cli.read_log_of(args)
    from hil.lockstep import warm_up

    warm_up(lambda text: cli.say(args, text))
    with cli.progress_bar(args, f"replaying {Path(args.log).name}") as progress:
        result = replay(log, plant=machine, calibration=calibration, progress=progress, floors=floors)
    exceeded = _exceeded(result, limits)
    rows = [
        [s.signal, s.stage, s.reference, *(_figure(getattr(s, k)) for k in (*STATISTICS, "noise_floor")), s.unit, f"{s.samples:,}"]
        for s in result.signals
    ]
    columns = ["signal", "stage", "against", "rms", "mean", "max", "mean 99-100 %", "noise floor", "unit", "samples"]
    cli.print_table(args, f"{result.log}: {result.simulated_s:,.0f} s simulated in {result.wall_s:.2f} s", columns, rows)
    for note in result.notes:
        cli.say(args, f"note: {note}")
    for line in exceeded:
        cli.say(args, f"differs: {line}")
    cli.write_json(args, {**replay_json(result), "exceeded": exceeded, **(extra or {})})
    if args.report:
        from hil.report import replay_report

        words = " ".join(["vaneloop replay", args.log, *(a for a in sys.argv[2:] if a != args.log)])
        cli.say(args, f"page: {replay_report(result, args.report, command=words)}")
    if args.out:
        channels = {k: Channel(result.t, v) for k, v in result.model.items()}
        try:
            write_log(args.out, channels)
        except OSError as e:
            raise InputError(f"{args.out}: cannot be written ({e.strerror})") from None
        cli.say(args, f"simulated run: {args.out}")
    return 1 if exceeded else 0


def _figure(v: float | None) -> str:
    return "-" if v is None else f"{v:.4g}"


def _limits(options: list[str]) -> dict[tuple[str, str], float]:
    """Parse ``--tolerance`` into {(signal, statistic): limit}."""
    from tables import InputError

    out = {}
    for key, text in cli.pairs(options, "tolerance").items():
        signal, _, statistic = key.partition(".")
        statistic = statistic or "rms"
        if signal not in STAGE or statistic not in STATISTICS:
            allowed = f"{', '.join(STAGE)}, each also with .{', .'.join(STATISTICS)}"
            raise InputError(f"--tolerance {key}={text}: {key!r} is not known; allowed: {allowed}")
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not value >= 0.0 or value == float("inf"):
            raise InputError(f"--tolerance {key}={text}: {text!r} must be a number of 0 or more")
        out[signal, statistic] = value
    return out


def _exceeded(result: ReplayResult, limits: dict[tuple[str, str], float]) -> list[str]:
    """Tolerances that are exceeded, in words. The measurement decides; the schedule where nothing was measured."""
    from tables import InputError

    out = []
    for (signal, statistic), limit in limits.items():
        of = [s for s in result.signals if s.signal == signal]
        if not of:
            raise InputError(f"--tolerance {signal}={limit:g}: {result.log} has no {signal} to compare with")
        judged = next((s for s in of if s.reference == "measured"), of[0])
        value = getattr(judged, statistic)
        words = "measurement" if judged.reference == "measured" else "schedule"
        if value is not None and value > limit:
            out.append(f"{signal} {statistic} {value:.4g} {judged.unit} against the {words} exceeds {limit:g} {judged.unit}")
    return out


def main(argv: list[str] | None = None) -> int:
    """Command line of ``python -m hil.replay``."""
    return cli.start("python -m hil.replay", lambda: sys.modules[__name__], argv)


if __name__ == "__main__":
    sys.exit(main())
