"""What the firmware works on, declared once: inputs, outputs, state, calibration scalars.

Every record is a row of float64 in the order below, so its memory is also a C struct of doubles. As a `record` its
fields are attributes, in compiled code and in Python: ``state.x_dem``, ``state.width[stage]``. `as_state` and its like
show numbers as a record, `flat` a record as numbers: the same memory. The firmware takes either. Units: SI, speeds %.

What each vane stage has stands in an array of eight; a controller works on the first ``stages`` of them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import lower_builtin, type_callable
from numba.np.arrayobj import make_array
from numba.np.numpy_support import from_dtype

from vaneloop.base.vanes import VANES, own_rows

__all__ = [
    "FAULTS", "FAULT_FIELDS", "INPUTS", "INPUT_FIELDS", "MODES", "OBSERVABLE_FIELDS", "OUTPUTS", "OUTPUT_FIELDS",
    "SCALARS", "SCALAR_FIELDS", "STATE", "STATE_FIELDS", "STRATEGIES", "Field", "Record", "as_inputs", "as_outputs",
    "as_scalars", "as_state", "flat", "flat_names", "kind", "record", "state_rows", "viewer",
]  # fmt: skip

_array: Any = make_array  # what has no types
_type_of: Any = type_callable
_code_of: Any = lower_builtin
Record = Any  # a numpy.record: its fields are attributes, which the types of numpy do not know
TICK = 1e-3  # s, servo rate 1 kHz
SLOW = 10  # ticks: demand, trend and schedule run every 10 ms
SLOW_TICK = 1e-2  # s
HALF_TICK = 0.5 * TICK  # s: timers are sums of ticks; half a tick keeps their rounding from costing a whole one

# Strategies: how the stroke demand follows from the speed (docs/strategies.md).
STRATEGIES = ("single", "dual", "inverse", "adaptive")
SINGLE, DUAL, INVERSE, ADAPTIVE = range(4)

MODES = ("INIT", "STANDBY", "RUN", "DEGRADED", "FAIL_SAFE")
INIT, STANDBY, RUN, DEGRADED, FAIL_SAFE = range(5)

# Fault codes: bit numbers in ``faults`` and in the frame VGV_SERVO.
FAULTS = (
    "demand_stale", "demand_rejected", "lvdt_range", "lvdt_rate", "lvdt_stuck", "tracking", "current_saturated",
    "demand_range", "paused",
)  # fmt: skip
N_FAULTS = len(FAULTS)
(F_STALE, F_REJECTED, F_LVDT_RANGE, F_LVDT_RATE, F_LVDT_STUCK, F_TRACKING, F_SATURATED, F_DEMAND_RANGE, F_PAUSED) = (
    range(N_FAULTS)
)
LVDT_MASK = (1 << F_LVDT_RANGE) | (1 << F_LVDT_RATE) | (1 << F_LVDT_STUCK)
DEMAND_MASK = (1 << F_STALE) | (1 << F_REJECTED) | (1 << F_DEMAND_RANGE)
SERVO_MASK = (1 << F_TRACKING) | (1 << F_SATURATED)
STOP_MASK = LVDT_MASK | (1 << F_PAUSED)  # FAIL_SAFE at once
FAULT_FIELDS = (
    "t_stale", "t_rejected", "t_lvdt_range", "t_lvdt_rate", "t_lvdt_stuck", "t_tracking", "t_saturated",
    "t_demand_range", "t_paused",
)  # fmt: skip


class Field(NamedTuple):
    """One number of a record, or one for each of ``each`` (names of the flat columns)."""

    name: str
    unit: str
    meaning: str
    each: tuple[str, ...] = ()


def _vanes(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{vane}" for vane in VANES)


INPUT_FIELDS = (
    Field("n_dem", "%", "demand of the last good ECU frame"),
    Field("n_r", "%", "measured speed of the last good ECU frame"),
    Field("demand_fresh", "-", "1 if a good ECU frame came since the last tick"),
    Field("demand_rejected", "-", "ECU frames refused since the last tick (CRC, counter, length)"),
    Field("mode_request", "-", "0 standby, 1 run"),
    Field("x_lvdt", "m", "stroke as the LVDT gives it"),
    Field("pots", "rad", "vane angles as the stem potentiometers give them; NaN = not fitted", VANES),
    Field("pause", "s", "for which the controller stood still before this tick, as its supervisor says; 0: on time"),
)

OUTPUT_FIELDS = (
    Field("i_cmd", "A", "servo-valve current"),
    Field("x_dem", "m", "stroke demand"),
    Field("mode", "-", "number of the mode in `MODES`"),
    Field("faults", "-", "bit mask of `FAULTS`"),
)

SCALAR_FIELDS = (
    Field("strategy", "-", "of `STRATEGIES`"),
    Field("table_input", "-", "0 table entered with filtered n_r, 1 with n_dem"),
    Field("trend_alpha", "-", "fixed gain of the trend's Kalman filter for the demand, per 10 ms"),
    Field("trend_beta", "-", "and for its rate"),
    Field("trend_rate_on", "%/s", "rate of demand against the direction that counts as moving"),
    Field("trend_change", "%", "way back from the farthest demand that turns the direction; half of it while moving"),
    Field("trend_hold", "s", "for how long both must stand"),
    Field("speed_filter", "s", "lag of the n_r filter"),
    Field("blend_time", "s", "full change from one curve to the other"),
    Field("stroke_rate", "m/s", "fastest stroke demand"),
    Field("stroke_min", "m", "least stroke demand"),
    Field("stroke_max", "m", "greatest stroke demand"),
    Field("kp", "A/m", "proportional gain"),
    Field("ki", "A/(m s)", "integral gain"),
    Field("kff", "A/(m/s)", "feed-forward of the demanded speed"),
    Field("current_limit", "A", "greatest current"),
    Field("init_time", "s", "in INIT at least"),
    Field("fail_safe_stroke", "m", "where FAIL_SAFE goes"),
    Field("fail_safe_current", "A", "when the LVDT cannot be used"),
    Field("fail_safe_rate", "m/s", "on the way to the fail-safe stroke"),
    Field("degraded_hold", "s", "longest presence of a fault's cause in DEGRADED before FAIL_SAFE"),
    Field("recover_time", "s", "all clear for this long before RUN returns"),
    Field("demand_timeout", "s", "without a good frame: stale"),
    Field("demand_reject_limit", "-", "refused frames in the bucket: rejected"),
    Field("demand_reject_leak", "1/s", "refused frames forgiven"),
    Field("demand_low", "%", "least plausible speed of a frame"),
    Field("demand_high", "%", "greatest plausible speed of a frame"),
    Field("lvdt_low", "m", "least plausible stroke"),
    Field("lvdt_high", "m", "greatest plausible stroke"),
    Field("lvdt_rate", "m/s", "fastest plausible motion"),
    Field("lvdt_debounce", "s", "of bad samples: fault"),
    Field("lvdt_heal", "s", "of good samples: healed"),
    Field("stuck_current", "A", "a current above this must move the piston"),
    Field("stuck_motion", "m", "less motion than this is none"),
    Field("stuck_time", "s", "without motion: stuck"),
    Field("stuck_margin", "m", "from the end stops within which no motion is expected"),
    Field("tracking_limit", "m", "of the servo's error"),
    Field("tracking_time", "s", "beyond it: fault"),
    Field("saturated_time", "s", "at the current's limit: fault"),
    Field("engine_lag", "s", "the engine as the speed observer knows it"),
    Field("engine_acceleration", "%/s", "the same"),
    Field("engine_deceleration", "%/s", "the same"),
    Field("observer_alpha", "-", "fixed gain of the speed observer for the speed, per 10 ms"),
    Field("observer_beta", "-", "and for the drift of its rate"),
    Field("observer_band", "%", "farthest from the filtered speed that the observer may be"),
    Field("play", "rad", "total play at the vane, as built", _vanes("play")),
    Field("lead", "s", "delay from the stroke demand to the vane, made up for"),
    Field("look_ahead", "s", "how early the gap is crossed before the vanes must turn round"),
    Field("turn_band", "rad", "the vanes' error that is not worth a reversal"),
    Field("turn_noise", "-", "the same in multiples of the observed speed's noise"),
    Field("pot_low", "rad", "least plausible reading"),
    Field("pot_high", "rad", "greatest plausible reading"),
    Field("pot_gate", "rad", "farthest from its expected value that a reading is believed"),
    Field("pot_trust", "rad", "over which a reading must have followed the linkage before it is learned from"),
    Field("learn_time", "s", "time constant of learning"),
    Field("learn_rate", "rad/s", "fastest change of what is known already"),
    Field("learn_budget", "rad", "by which what is known may change before the readings must have followed again"),
    Field("apply_rate", "rad/s", "fastest change of the compensation in use"),
    Field("offset_limit", "rad", "greatest offset that is learned"),
    Field("width_limit", "rad", "farthest from the play as built"),
    Field("stages", "-", "vane stages of the machine, 1 to 8"),
)

STATE_FIELDS = (
    Field("mode", "-", "number of the mode in `MODES`"),
    Field("ticks", "-", "since power-on"),
    Field("n_dem", "%", "demand in use"),
    Field("n_r_raw", "%", "measured speed of the last good frame"),
    Field("n_r", "%", "filtered measured speed"),
    Field("demand_age", "s", "since the last good frame"),
    Field("reject_bucket", "-", "refused frames not yet forgiven"),
    Field("demand_seen", "-", "1 once a good frame came"),
    Field("trend_n", "%", "filtered demand"),
    Field("trend_rate", "%/s", "its rate"),
    Field("trend_turn", "%", "farthest demand along the present direction, of two steps in a row"),
    Field("trend_timer", "s", "for which a turn has been due"),
    Field("direction", "-", "+1 demand rises (extension curve), -1 falls (retraction curve)"),
    Field("blend", "-", "0 retraction curve .. 1 extension curve"),
    Field("x_target", "m", "stroke from the tables"),
    Field("x_dem", "m", "stroke demand, rate-limited (the end of the present 10 ms)"),
    Field("x_from", "m", "stroke demand 10 ms before"),
    Field("x_meas", "m", "last plausible stroke"),
    Field("x_reach", "m", "how far from x_meas the stroke can have come since that sample"),
    Field("lvdt_good", "-", "1 if the last sample was plausible"),
    Field("stuck_x", "m", "where the stuck timer started"),
    Field("stuck_timer", "s", "of a current that moves nothing"),
    Field("integral", "A", "of the servo"),
    Field("i_cmd", "A", "current"),
    Field("saturated", "-", "1 while the current is limited"),
    Field("recover_timer", "s", "all clear in FAIL_SAFE"),
    Field("degraded_timer", "s", "of a cause present in DEGRADED"),
    Field("faults", "-", "bit mask of `FAULTS`"),
    Field("timers", "s", "of the faults: up to the fault, then down to its end", FAULT_FIELDS),
    Field("x_servo", "m", "reference of the servo at this tick"),
    Field("run_request", "-", "1 if the last good frame asked for RUN"),
    Field("trend_last", "%", "demand of the 10 ms step before"),
    # inverse and adaptive only
    Field("speed", "%", "observed speed"),
    Field("speed_rate", "%/s", "as observed"),
    Field("speed_drift", "%/s", "by which the engine runs away from its model"),
    Field("speed_noise", "%^2", "mean square of what each new speed brings"),
    Field("side", "-", "+1, -1: the pushing side of the VIGV's gap that the stroke is to be on; 0 not yet known"),
    Field("crossing", "-", "-1 .. 1: where in the gap the stroke demand is"),
    Field("x_slow", "m", "stroke as measured, without its noise"),
    Field("quiet", "s", "for which the stroke demand has stood"),
    Field("offset_in_use", "rad", "of the VIGV"),
    Field("width_in_use", "rad", "beyond the play as built, of the VIGV"),
    Field("farthest", "rad", "farthest drive of the stage along its engaged side", _vanes("farthest")),
    Field("engaged", "-", "+1, -1: side of the gap where the stage was last pushed; 0 unknown", _vanes("engaged")),
    Field("pot", "rad", "potentiometer, filtered", _vanes("pot")),
    Field("pot_seen", "-", "1 once a reading came", _vanes("pot_seen")),
    Field("suspect", "-", "0 .. 1: doubts about the readings; with 1 the trust is lost", _vanes("suspect")),
    Field("trusted", "-", "1: the readings are learned from", _vanes("trusted")),
    Field("lowest", "rad", "least angle expected since the last doubt or proof", _vanes("lowest")),
    Field("highest", "rad", "greatest angle expected since then", _vanes("highest")),
    Field("offset", "rad", "learned", _vanes("offset")),
    Field("width", "rad", "beyond the play as built, learned", _vanes("width")),
    Field("proved_offset", "rad", "when the readings last followed the linkage over a motion", _vanes("proved_offset")),
    Field("proved_width", "rad", "the same", _vanes("proved_width")),
    Field("learned_up", "s", "learned on side +1", _vanes("learned_up")),
    Field("learned_down", "s", "learned on side -1", _vanes("learned_down")),
)

# what a controller of the user's own may show of itself (docs/own_controller.md); the same names in its state here
OBSERVED = (
    "n_dem", "n_r_raw", "n_r", "direction", "blend", "x_target", "x_from", "x_meas", "x_servo", "integral", "saturated",
    "speed", "side", "crossing", "offset_in_use", "width_in_use",
)  # fmt: skip
OBSERVABLE_FIELDS = tuple(f for name in OBSERVED for f in STATE_FIELDS if f.name == name)


def flat_names(fields: tuple[Field, ...]) -> tuple[str, ...]:
    """Names of a record's numbers, one by one."""
    return tuple(name for f in fields for name in (f.each or (f.name,)))


INPUTS, OUTPUTS, SCALARS, STATE = map(flat_names, (INPUT_FIELDS, OUTPUT_FIELDS, SCALAR_FIELDS, STATE_FIELDS))


@lru_cache
def state_rows(stages: int) -> np.ndarray:
    """Numbers of the state, int64, that a machine with so many vane stages has."""
    rows = np.array(own_rows(STATE, VANES[:stages]))
    rows.setflags(write=False)
    return rows


def kind(fields: tuple[Field, ...]) -> np.dtype[np.void]:
    """Layout of a record: a row of float64 with names."""
    rows = [(f.name, np.float64, (len(f.each),)) if f.each else (f.name, np.float64) for f in fields]
    return np.dtype((np.record, rows))


def record(fields: tuple[Field, ...], values: np.ndarray | None = None) -> Record:
    """Return a record of ``fields``: zeros, or in the memory of ``values`` (float64[n], its numbers one by one)."""
    numbers = np.zeros(len(flat_names(fields))) if values is None else np.ascontiguousarray(values, dtype=np.float64)
    return numbers.view(kind(fields))[0]


def flat(of: Record) -> np.ndarray:
    """The numbers of a record, float64[n]: the same memory."""
    return np.asarray(of.base).view(np.float64).reshape(-1)


def viewer(fields: tuple[Field, ...]) -> Callable[[Any], Record]:
    """Function, compiled too, that shows a row of numbers as the record of ``fields``, and a record as it is."""
    layout = kind(fields)

    def view(row: Any) -> Record:
        return row if isinstance(row, np.void) else row.view(layout)[0]

    shown: Any = from_dtype(layout)
    count = len(flat_names(fields))

    def type_of(context: Any) -> Any:
        def of(row: Any) -> Any:
            if isinstance(row, types.Record):
                return row
            plain = isinstance(row, types.Array) and (row.dtype, row.ndim, row.layout) == (types.float64, 1, "C")
            return shown if plain else None

        return of

    def code_of_numbers(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        row: Any = _array(signature.args[0])(context, builder, values[0])
        with builder.if_then(builder.icmp_signed("<", row.nitems, row.nitems.type(count)), likely=False):
            context.call_conv.return_user_exc(builder, ValueError, (f"a row must have at least {count} numbers",))
        return builder.bitcast(row.data, context.get_value_type(shown))

    def code_of_record(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return values[0]

    # numba's own view and item would be functions to compile, for each record and each set of options
    _type_of(view)(type_of)
    _code_of(view, types.Array)(code_of_numbers)
    _code_of(view, types.Record)(code_of_record)
    return view


as_inputs, as_outputs, as_scalars, as_state = map(viewer, (INPUT_FIELDS, OUTPUT_FIELDS, SCALAR_FIELDS, STATE_FIELDS))
