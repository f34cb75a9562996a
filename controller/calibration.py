"""The controller's calibration: the tables it is flashed with, checked and laid out flat for the compiled tick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from controller.channels import PAIR_SCALARS
from controller.monitors import FAR
from controller.records import (
    INPUT_FIELDS,
    OUTPUTS,
    SCALARS,
    STATE_FIELDS,
    STRATEGIES,
    Record,
    as_scalars,
    flat,
    record,
)
from vaneloop.base.errors import InputError
from vaneloop.base.tables import Axis, Bound, Bounded, Quantity, Table, load_toml, path, read
from vaneloop.base.vanes import VANES, Staged, vane_in

__all__ = ["Calibration", "load_calibration", "new_inputs", "new_outputs", "new_state"]

_DEG = np.pi / 180.0
SI = {
    "mm": 1e-3,
    "mm/s": 1e-3,
    "mA": 1e-3,
    "deg": _DEG,
    "deg/s": _DEG,
}  # mA/mm = A/m and the other ratios need no factor
DRIVES = ("one", "both")


class Calibration(NamedTuple):
    """What `controller.tick` reads.

    k       float64[n] of `records.SCALARS`, SI; ``scalars``: their record
    table   float64[4, n]: speed (%), then stroke (m) for extension, retraction and the single mean curve
    angles  float64[1 + stages, m]: stroke (m), then the angle (rad) of each stage at it in the middle of the play
    program a controller of the user's own, to be flashed with it (`hil.native.Program`); None: the firmware here
    channels  float64[n] of `controller.channels.PAIR_FIELDS`, SI: the firmware runs in two channels; None: in one
    """

    k: np.ndarray
    table: np.ndarray
    angles: np.ndarray
    program: Any = None
    channels: np.ndarray | None = None

    def of_one_channel(self, what: str) -> None:
        """Refuse two channels: InputError in one line, for ``what`` takes one alone."""
        if self.channels is not None:
            raise InputError(f"calibration: channels.number (=2) must be 1 for {what} (docs/channels.md)")

    @property
    def vanes(self) -> tuple[str, ...]:
        """Stages of the machine that it is for, in order."""
        return VANES[: len(self.angles) - 1]

    @property
    def scalars(self) -> Record:
        """The scalars by name, in the same memory: ``calibration.scalars.kp``."""
        return as_scalars(self.k)


class Trend(Bounded):
    """Direction of the demand."""

    trend_alpha: Annotated[Quantity, Bound("-", 1e-3, 1.0)]
    trend_beta: Annotated[Quantity, Bound("-", 1e-6, 2.0)]
    trend_rate_on: Annotated[Quantity, Bound("%/s", 0.0, 10.0)]
    trend_change: Annotated[Quantity, Bound("%", 0.0, 10.0)]
    trend_hold: Annotated[Quantity, Bound("s", 0.0, 10.0)]


class Schedule(Bounded):
    """From speed to stroke demand."""

    strategy: str
    table_input: str
    speed_filter: Annotated[Quantity, Bound("s", 0.0, 10.0)]
    blend_time: Annotated[Quantity, Bound("s", 0.01, 10.0)]
    stroke_rate: Annotated[Quantity, Bound("mm/s", 1.0, 1000.0)]
    stroke_min: Annotated[Quantity, Bound("mm", 0.0, 100.0)]
    stroke_max: Annotated[Quantity, Bound("mm", 0.0, 100.0)]

    @model_validator(mode="after")
    def _choices(self) -> Schedule:
        if self.strategy not in STRATEGIES:
            raise ValueError(f"strategy (={self.strategy!r}) must be one of {', '.join(STRATEGIES)}")
        if self.table_input not in ("n_r", "n_dem"):
            raise ValueError(f"table_input (={self.table_input!r}) must be n_r or n_dem")
        if not self.stroke_min.value < self.stroke_max.value:
            raise ValueError(
                f"stroke_min (={self.stroke_min.value:g} mm) must be below stroke_max (={self.stroke_max.value:g} mm)"
            )
        return self


class Servo(Bounded):
    """Stroke loop."""

    kp: Annotated[Quantity, Bound("mA/mm", 0.0, 1000.0)]
    ki: Annotated[Quantity, Bound("mA/(mm s)", 0.0, 100000.0)]
    kff: Annotated[Quantity, Bound("mA/(mm/s)", 0.0, 10.0)]
    current_limit: Annotated[Quantity, Bound("mA", 0.1, 1000.0)]


class FailSafe(Bounded):
    """Start, loss and return."""

    init_time: Annotated[Quantity, Bound("s", 0.0, 60.0)]
    fail_safe_stroke: Annotated[Quantity, Bound("mm", 0.0, 100.0)]
    fail_safe_current: Annotated[Quantity, Bound("mA", -1000.0, 1000.0)]
    fail_safe_rate: Annotated[Quantity, Bound("mm/s", 0.1, 1000.0)]
    degraded_hold: Annotated[Quantity, Bound("s", 0.0, 3600.0)]
    recover_time: Annotated[Quantity, Bound("s", 0.001, 3600.0)]


class DemandMonitor(Bounded):
    """When the ECU's demand is not to be believed."""

    demand_timeout: Annotated[Quantity, Bound("s", 0.001, 60.0)]
    demand_reject_limit: Annotated[Quantity, Bound("-", 1.0, 10000.0)]
    demand_reject_leak: Annotated[Quantity, Bound("1/s", 0.0, 10000.0)]
    demand_low: Annotated[Quantity, Bound("%", -10.0, 100.0)]
    demand_high: Annotated[Quantity, Bound("%", 1.0, 150.0)]


class LvdtMonitor(Bounded):
    """When the stroke measurement is not to be believed."""

    lvdt_low: Annotated[Quantity, Bound("mm", -100.0, 100.0)]
    lvdt_high: Annotated[Quantity, Bound("mm", 0.0, 200.0)]
    lvdt_rate: Annotated[Quantity, Bound("mm/s", 1.0, 100000.0)]
    lvdt_debounce: Annotated[Quantity, Bound("s", 0.001, 60.0)]
    lvdt_heal: Annotated[Quantity, Bound("s", 0.001, 3600.0)]
    stuck_current: Annotated[Quantity, Bound("mA", 0.0, 1000.0)]
    stuck_motion: Annotated[Quantity, Bound("mm", 0.0, 100.0)]
    stuck_time: Annotated[Quantity, Bound("s", 0.001, 60.0)]
    stuck_margin: Annotated[Quantity, Bound("mm", 0.0, 100.0)]


class ServoMonitor(Bounded):
    """When the loop does not follow."""

    tracking_limit: Annotated[Quantity, Bound("mm", 0.001, 100.0)]
    tracking_time: Annotated[Quantity, Bound("s", 0.001, 60.0)]
    saturated_time: Annotated[Quantity, Bound("s", 0.001, 60.0)]


class Observer(Bounded):
    """The engine as the strategies inverse and adaptive know it."""

    engine_lag: Annotated[Quantity, Bound("s", 0.05, 60.0)]
    engine_acceleration: Annotated[Quantity, Bound("%/s", 0.01, 1000.0)]
    engine_deceleration: Annotated[Quantity, Bound("%/s", 0.01, 1000.0)]
    observer_alpha: Annotated[Quantity, Bound("-", 1e-3, 1.0)]
    observer_beta: Annotated[Quantity, Bound("-", 0.0, 1.0)]
    observer_band: Annotated[Quantity, Bound("%", 0.0, 10.0)]


class Inverse(Bounded):
    """When to cross the play: strategies inverse and adaptive."""

    lead: Annotated[Quantity, Bound("s", 0.0, 0.5)]
    look_ahead: Annotated[Quantity, Bound("s", 0.0, 1.0)]
    turn_band: Annotated[Quantity, Bound("deg", 0.0, 10.0)]
    turn_noise: Annotated[Quantity, Bound("-", 0.0, 100.0)]


class Adaptive(Bounded):
    """What is believed of the stem potentiometers, and learned: strategy adaptive."""

    pot_low: Annotated[Quantity, Bound("deg", -90.0, 90.0)]
    pot_high: Annotated[Quantity, Bound("deg", -90.0, 90.0)]
    pot_gate: Annotated[Quantity, Bound("deg", 0.0, 10.0)]
    pot_trust: Annotated[Quantity, Bound("deg", 0.1, 60.0)]
    learn_time: Annotated[Quantity, Bound("s", 0.1, 3600.0)]
    learn_rate: Annotated[Quantity, Bound("deg/s", 0.0, 1.0)]
    learn_budget: Annotated[Quantity, Bound("deg", 0.0, 5.0)]
    apply_rate: Annotated[Quantity, Bound("deg/s", 0.0, 1.0)]
    offset_limit: Annotated[Quantity, Bound("deg", 0.0, 5.0)]
    width_limit: Annotated[Quantity, Bound("deg", 0.0, 5.0)]


class Channels(Bounded):
    """How many channels the controller has, and what two do together (`controller.channels`).

    drive  which of two drive the valves: "one", the channel in charge, or "both", half of the current each
    """

    number: Annotated[Quantity, Bound("-", 1.0, 2.0)]
    drive: str
    disagree_limit: Annotated[Quantity, Bound("mm", 0.05, 10.0)]
    hysteresis: Annotated[Quantity, Bound("mm", 0.0, 10.0)]
    confirm_time: Annotated[Quantity, Bound("s", 0.001, 10.0)]
    fade_rate: Annotated[Quantity, Bound("mm/s", 0.1, 1000.0)]
    rate_gain: Annotated[Quantity, Bound("mm/s/mA", 0.01, 100.0)]
    rate_lag: Annotated[Quantity, Bound("s", 0.0, 1.0)]
    model_time: Annotated[Quantity, Bound("s", 0.005, 10.0)]
    link_timeout: Annotated[Quantity, Bound("s", 0.001, 0.2)]
    track_time: Annotated[Quantity, Bound("s", 0.0, 10.0)]
    takeover_time: Annotated[Quantity, Bound("s", 0.001, 10.0)]
    coil_limit: Annotated[Quantity, Bound("mA", 0.01, 100.0)]
    coil_time: Annotated[Quantity, Bound("s", 0.001, 10.0)]

    @model_validator(mode="after")
    def _choices(self) -> Channels:
        if self.number.value not in (1.0, 2.0):
            raise ValueError(f"number (={self.number.value:g}) must be 1 or 2")
        if self.drive not in DRIVES:
            raise ValueError(f"drive (={self.drive!r}) must be one of {', '.join(DRIVES)}")
        if not self.hysteresis.value < self.disagree_limit.value:
            raise ValueError(
                f"hysteresis (={self.hysteresis.value:g} mm) must be below disagree_limit "
                f"(={self.disagree_limit.value:g} mm)"
            )
        return self

    def flat(self) -> np.ndarray:
        """Its numbers, float64[n] of `controller.channels.PAIR_FIELDS`, SI."""
        values = {key: q.value * SI.get(q.unit, 1.0) for key, q in self if isinstance(q, Quantity)}
        values["both"] = float(DRIVES.index(self.drive))
        return np.array([values[name] for name in PAIR_SCALARS])


def _shipped_channels() -> Channels:
    """What a calibration table has that says nothing of channels."""
    return Channels.model_validate(load_toml(path("calibration.toml"))["channels"])


class CalibrationTable(Table):
    """``calibration.toml``: every scalar of the controller, by job."""

    trend: Trend
    schedule: Schedule
    servo: Servo
    fail_safe: FailSafe
    demand_monitor: DemandMonitor
    lvdt_monitor: LvdtMonitor
    servo_monitor: ServoMonitor
    observer: Observer
    inverse: Inverse
    adaptive: Adaptive
    channels: Channels = Field(default_factory=_shipped_channels)

    @model_validator(mode="after")
    def _together(self) -> CalibrationTable:
        """Refuse values that are possible one by one but not together."""
        low, high = self.schedule.stroke_min.value, self.schedule.stroke_max.value
        limit, half = self.servo.current_limit.value, 0.5 * (high - low)
        d, m = self.demand_monitor, self.lvdt_monitor
        stroke, current = self.fail_safe.fail_safe_stroke.value, self.fail_safe.fail_safe_current.value
        for good, key, value, unit, allowed in (
            (
                low <= stroke <= high,
                "fail_safe.fail_safe_stroke",
                stroke,
                "mm",
                f"in [{low:g}, {high:g}], stroke_min to stroke_max",
            ),
            (
                abs(current) <= limit,
                "fail_safe.fail_safe_current",
                current,
                "mA",
                f"in [{-limit:g}, {limit:g}], the current_limit",
            ),
            (
                d.demand_low.value < d.demand_high.value,
                *_named(d, "demand_low"),
                f"below demand_high (={d.demand_high.value:g} %)",
            ),
            (m.lvdt_low.value < low, *_named(m, "lvdt_low"), f"below stroke_min (={low:g} mm)"),
            (m.lvdt_high.value > high, *_named(m, "lvdt_high"), f"above stroke_max (={high:g} mm)"),
            (
                m.stuck_margin.value < half,
                *_named(m, "stuck_margin"),
                f"below {half:g}, half the way from stroke_min to stroke_max",
            ),
            (
                self.adaptive.pot_low.value < self.adaptive.pot_high.value,
                *("adaptive.pot_low", self.adaptive.pot_low.value, "deg"),
                f"below pot_high (={self.adaptive.pot_high.value:g} deg)",
            ),
            (m.stuck_current.value < limit, *_named(m, "stuck_current"), f"below current_limit (={limit:g} mA)"),
        ):
            if not good:
                raise ValueError(f"{key} (={value:g} {unit}) must be {allowed}")
        return self


def _named(section: DemandMonitor | LvdtMonitor, key: str) -> tuple[str, float, str]:
    """Dotted name, value and unit of a quantity, for a message."""
    q = getattr(section, key)
    return f"{'demand' if isinstance(section, DemandMonitor) else 'lvdt'}_monitor.{key}", q.value, q.unit


class StrokeTable(Bounded):
    """``stroke_tables.toml``: stroke against speed, one curve per direction and their mean."""

    speed: Annotated[Axis, Bound("%", 0.0, 150.0)]
    extension: Annotated[Axis, Bound("mm", 0.0, 100.0)]
    retraction: Annotated[Axis, Bound("mm", 0.0, 100.0)]
    single: Annotated[Axis, Bound("mm", 0.0, 100.0)]

    @model_validator(mode="after")
    def _axes(self) -> StrokeTable:
        self.speed.increasing("speed")
        n = len(self.speed.values)
        for key in ("extension", "retraction", "single"):
            if len(getattr(self, key).values) != n:
                raise ValueError(f"{key}.values has {len(getattr(self, key).values)} numbers; speed has {n}")
        for key in ("extension", "retraction", "single"):
            strokes = getattr(self, key).values
            for i, (a, b) in enumerate(zip(strokes, strokes[1:], strict=False)):
                if b < a:
                    raise ValueError(
                        f"{key}.values[{i + 1}] (={b:g}) must not be less than the value before it (={a:g})"
                    )
        for i, (e, m, r) in enumerate(
            zip(self.extension.values, self.single.values, self.retraction.values, strict=True)
        ):
            if not e >= m >= r:
                raise ValueError(
                    f"single.values[{i}] (={m:g}) must lie between retraction (={r:g}) and extension (={e:g})"
                )
        return self


class AngleTable(Staged, Bounded):
    """``vane_angles.toml``: vane angles against stroke in the middle of the play, and the total play at the vane."""

    play_vigv: Annotated[Quantity, Bound("deg", 0.0, 10.0)]
    play_vgv1: Annotated[Quantity | None, Bound("deg", 0.0, 10.0)] = None
    play_vgv2: Annotated[Quantity | None, Bound("deg", 0.0, 10.0)] = None
    play_vgv3: Annotated[Quantity | None, Bound("deg", 0.0, 10.0)] = None
    play_vgv4: Annotated[Quantity | None, Bound("deg", 0.0, 10.0)] = None
    play_vgv5: Annotated[Quantity | None, Bound("deg", 0.0, 10.0)] = None
    play_vgv6: Annotated[Quantity | None, Bound("deg", 0.0, 10.0)] = None
    play_vgv7: Annotated[Quantity | None, Bound("deg", 0.0, 10.0)] = None

    stroke: Annotated[Axis, Bound("mm", -10.0, 100.0)]
    vigv: Annotated[Axis, Bound("deg", -90.0, 90.0)]
    vgv1: Annotated[Axis | None, Bound("deg", -90.0, 90.0)] = None
    vgv2: Annotated[Axis | None, Bound("deg", -90.0, 90.0)] = None
    vgv3: Annotated[Axis | None, Bound("deg", -90.0, 90.0)] = None
    vgv4: Annotated[Axis | None, Bound("deg", -90.0, 90.0)] = None
    vgv5: Annotated[Axis | None, Bound("deg", -90.0, 90.0)] = None
    vgv6: Annotated[Axis | None, Bound("deg", -90.0, 90.0)] = None
    vgv7: Annotated[Axis | None, Bound("deg", -90.0, 90.0)] = None

    @model_validator(mode="after")
    def _axes(self) -> AngleTable:
        self.stroke.increasing("stroke")
        n = len(self.stroke.values)
        for key in VANES:
            if (getattr(self, key) is None) != (getattr(self, f"play_{key}") is None):
                raise ValueError(f"{key} and play_{key} belong together: only one of them is there")
        for key in self.vanes:
            axis = getattr(self, key).increasing(key)
            if len(axis.values) != n:
                raise ValueError(f"{key}.values has {len(axis.values)} numbers; stroke has {n}")
        return self


SECTIONS = tuple(name for name in CalibrationTable.model_fields if name != "channels")  # of the firmware itself


class Scalar(NamedTuple):
    """A scalar as ``calibration.toml`` has it: ``si`` turns ``value`` and its bounds, in ``unit``, into SI."""

    section: str
    key: str
    value: float
    unit: str
    low: float
    high: float
    si: float


def scalars_in(table: CalibrationTable) -> list[Scalar]:
    """Return the firmware's scalars of a calibration table in their order; the choices in words, and what channels do
    together, are not among them.
    """
    out = []
    for section in SECTIONS:
        fields = type(getattr(table, section)).model_fields
        for key, q in getattr(table, section):
            if isinstance(q, Quantity):
                bound = next(m for m in fields[key].metadata if isinstance(m, Bound))
                out.append(Scalar(section, key, q.value, q.unit, bound.low, bound.high, SI.get(q.unit, 1.0)))
    return out


def load_calibration(
    calibration: str | Path = "calibration.toml",
    strokes: str | Path = "stroke_tables.toml",
    strategy: str | None = None,
    angles: str | Path = "vane_angles.toml",
    channels: int | None = None,
) -> Calibration:
    """Read, check and flatten the controller's tables.

    strategy: overrides the table's choice, one of `STRATEGIES`.
    channels: overrides the table's number of channels, 1 or 2.
    Raises InputError with file, key, value and what is allowed.
    """
    cal = read(calibration, CalibrationTable)
    stroke = read(strokes, StrokeTable)
    angle = read(angles, AngleTable)
    if strategy is not None and strategy not in STRATEGIES:
        raise InputError(f"strategy (={strategy!r}) must be one of {', '.join(STRATEGIES)}")
    if channels not in (None, 1, 2):
        raise InputError(f"channels (={channels}) must be 1 or 2")
    values = {
        "strategy": float(STRATEGIES.index(strategy or cal.schedule.strategy)),
        "table_input": 0.0 if cal.schedule.table_input == "n_r" else 1.0,
    }
    values |= {s.key: s.value * s.si for s in scalars_in(cal)}
    values |= {f"play_{v}": getattr(angle, f"play_{v}").value * _DEG for v in angle.vanes}
    values["stages"] = float(len(angle.vanes))
    k = np.array([values.get(name, 0.0) if vane_in(name) else values[name] for name in SCALARS])
    table = np.array(
        [stroke.speed.values]
        + [np.multiply(getattr(stroke, r).values, 1e-3) for r in ("extension", "retraction", "single")]
    )
    vanes = [np.array(angle.stroke.values) * 1e-3, *(np.deg2rad(getattr(angle, s).values) for s in angle.vanes)]
    many = channels if channels is not None else int(cal.channels.number.value)
    return Calibration(k, table, np.array(vanes), None, cal.channels.flat() if many == 2 else None)


def new_inputs() -> np.ndarray:
    """Inputs (float64[n] of `INPUTS`) of a controller to which nothing has come yet, without stem potentiometers; it is
    asked to run.
    """
    inputs = record(INPUT_FIELDS)
    inputs.mode_request = 1.0
    inputs.pots[:] = np.nan
    return flat(inputs)


def new_outputs() -> np.ndarray:
    """Outputs (float64[n] of `OUTPUTS`) of a controller that has not run yet: no current."""
    return np.zeros(len(OUTPUTS))


def new_state() -> np.ndarray:
    """State (float64[n] of `STATE`) of a controller that has just been switched on."""
    z = record(STATE_FIELDS)
    z.direction = z.blend = 1.0
    z.x_reach = FAR
    return flat(z)
