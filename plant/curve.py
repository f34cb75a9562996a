"""Curves that were learned: at one place of the plant, a function of one signal.

The library's effects are laws that somebody wrote down. A curve is a law that nobody did: a table of `POINTS` values,
at a `PLACES` of the machine, of one of `plant.layout.SIGNALS`. What adds, adds its value there; what multiplies, does
so with 1 + its value. Beyond the table's range a curve stays as at its end. Rows of a curve: `plant.layout`.

The signals are what the machine itself has at the last tick: a curve of the stroke is one of the true stroke. Where a
stage is held against a log, they are what the log says (`take`). The opening's current is the one that would hold the
spool where it is: a valve's lands know nothing else. A curve may have its signal through a first-order lag
of its own, which starts settled. Or it is the virgin curve of a hysteresis (`vaneloop.base.hysteresis`) of its signal,
which starts at rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from plant.effect import HYDRAULIC, KINDS, UNITS
from plant.effects import CURVES, N_STATE, SIGNAL_AT
from plant.layout import (
    C_HIGH,
    C_LAG,
    C_LOW,
    C_OF,
    C_PERIOD,
    C_SITE,
    C_STOPS,
    C_TABLE,
    CURVE_ROWS,
    MOST_CURVES,
    P_REF,
    SIGNALS,
    STROKE,
    VANE_COUNT,
)
from plant.places import N_R, POT, SPEED, X
from vaneloop.base.compiled import compiled, in_place, inlined
from vaneloop.base.curve import POINTS, between_points
from vaneloop.base.durations import named_lag, period_of
from vaneloop.base.hysteresis import RADII, slip, stops_of, weights_of
from vaneloop.base.vanes import MOST, VANES

__all__ = [
    "CRANK_ADDS", "CURRENT_ADDS", "DEMAND_ADDS", "ENGINE_ADDS", "FLOW_TIMES", "KNOWN", "LAG_TIMES", "LOAD_ADDS",
    "LVDT_ADDS", "LVDT_TIMES", "OPENING_ADDS", "PLACES", "PLAY_ADDS", "POT_ADDS", "POT_TIMES", "QUANTITIES",
    "RING_ADDS", "RISE_TIMES", "SERVO_ADDS", "SERVO_TIMES", "Place", "Quantity", "acts", "at_curve", "begin",
    "bend", "bent", "factor", "follow", "quantity_of", "take", "times", "turn", "turns", "unbent",
]  # fmt: skip

(
    DEMAND_ADDS, SERVO_ADDS, SERVO_TIMES, ENGINE_ADDS, LAG_TIMES, RISE_TIMES, CURRENT_ADDS, FLOW_TIMES, LOAD_ADDS,
    LVDT_ADDS, LVDT_TIMES, CRANK_ADDS, OPENING_ADDS,
) = range(1, 14)  # fmt: skip
# of all stages; of each stage k: the number behind it and k
RING_ADDS, PLAY_ADDS, POT_ADDS, POT_TIMES = (100 * n for n in range(1, 5))
LEAST = 0.05  # a factor 1 + c is not less
TURN = 0.02  # of the full stroke, of any other channel's range: a smaller way back is no reversal
KNOWN = SIGNALS.index(VANES[0]) + MOST  # signals that a curve may be of; behind them the memory of `turn`
(
    S_CURRENT, S_X, S_SPEED, S_N_R, S_P_S, S_T_OIL, S_TIME, S_N_DEM, S_X_DEM, S_DIRECTION, S_DISTANCE, S_SINCE, S_VANE,
) = range(SIGNAL_AT, SIGNAL_AT + 13)  # fmt: skip
S_FARTHEST = SIGNAL_AT + KNOWN
S_LATE = S_FARTHEST + 4  # a row a curve
S_LAST = S_LATE + MOST_CURVES  # and here
S_STOP = S_LAST + MOST_CURVES  # `RADII` rows a curve


@dataclass(frozen=True)
class Quantity:
    """A signal as a log and a reader have it: name, unit, factor to SI, its number in `SIGNALS`.

    period  SI, after which what is a function of it repeats itself; 0: it does not
    lag     s, time constant of the first-order lag behind which it is seen; 0: none
    stops   whether a curve is the virgin curve of a hysteresis of it
    """

    name: str
    unit: str
    si: float
    of: int
    period: float = 0.0
    lag: float = 0.0
    stops: bool = False


@dataclass(frozen=True)
class Place:
    """Where a curve may act.

    at, how  name of the place; "adds" or "times"
    stages   of the diagnosis that show it; first the one that shows it best
    unit, si of the curve, "-" where it multiplies; its factor to SI
    site     number in the plant's parameters
    vane     the only stage that it moves; "": all
    kinds    of actuators that have it
    """

    at: str
    how: str
    stages: tuple[str, ...]
    unit: str
    si: float
    site: int
    vane: str = ""
    kinds: tuple[str, ...] = KINDS


_DEG = UNITS["deg"]
QUANTITIES = {
    q.name: q
    for q in (
        Quantity("i_cmd", "mA", 1e-3, 0),
        Quantity("x_lvdt", "mm", 1e-3, 1),
        Quantity("speed_of_x_lvdt", "mm/s", 1e-3, 2),
        Quantity("n_r", "%", 1.0, 3),
        Quantity("p_s", "MPa", 1e6, 4),
        Quantity("t_oil", "degC", 1.0, 5),
        Quantity("time", "s", 1.0, 6),
        Quantity("n_dem", "%", 1.0, 7),
        Quantity("x_dem", "mm", 1e-3, 8),
        Quantity("direction_of_x_lvdt", "-", 1.0, 9),
        Quantity("distance_since_reversal_of_x_lvdt", "mm", 1e-3, 10),
        Quantity("time_since_reversal_of_x_lvdt", "s", 1.0, 11),
        *(Quantity(v, "deg", _DEG, 12 + k) for k, v in enumerate(VANES)),
    )
}
PLACES = {
    f"{p.at} {p.how}": p
    for p in (
        Place("controller.demand", "adds", ("demand",), "mm", 1e-3, DEMAND_ADDS),
        Place("servo.current", "adds", ("servo",), "mA", 1e-3, SERVO_ADDS),
        Place("servo.current", "times", ("servo",), "-", 1.0, SERVO_TIMES),
        Place("engine.demand", "adds", ("engine",), "%", 1.0, ENGINE_ADDS),
        Place("engine.lag", "times", ("engine",), "-", 1.0, LAG_TIMES),
        Place("engine.acceleration", "times", ("engine",), "-", 1.0, RISE_TIMES),
        Place("valve.current", "adds", ("actuator",), "mA", 1e-3, CURRENT_ADDS),
        Place("valve.opening", "adds", ("actuator",), "mA", 1e-3, OPENING_ADDS, kinds=HYDRAULIC),
        Place("actuator.flow_gain", "times", ("actuator",), "-", 1.0, FLOW_TIMES, kinds=HYDRAULIC),
        Place("actuator.load", "adds", ("actuator",), "N", 1.0, LOAD_ADDS),
        Place("sensors.lvdt", "adds", ("linkage", "actuator"), "mm", 1e-3, LVDT_ADDS),
        Place("sensors.lvdt", "times", ("linkage",), "-", 1.0, LVDT_TIMES),
        Place("linkage.crank", "adds", ("linkage",), "mm", 1e-3, CRANK_ADDS),
        Place("linkage.ring", "adds", ("linkage",), "deg", _DEG, RING_ADDS),
        Place("linkage.play", "adds", ("linkage",), "deg", _DEG, PLAY_ADDS),
        *(
            Place(at, how, ("linkage",), unit, si, base + 1 + k, v)
            for k, v in enumerate(VANES)
            for at, how, unit, si, base in (
                (f"linkage.{v}_ring", "adds", "deg", _DEG, RING_ADDS),
                (f"linkage.{v}_play", "adds", "deg", _DEG, PLAY_ADDS),
                (f"sensors.{v}", "adds", "deg", _DEG, POT_ADDS),
                (f"sensors.{v}", "times", "-", 1.0, POT_TIMES),
            )
        ),
    )
}


def quantity_of(name: str) -> Quantity | None:
    """The quantity of this name, of those in `QUANTITIES`, ``time_every_TIME``, ``SIGNAL_lagged_by_TIME`` and
    ``stops_of_SIGNAL``; None: there is none.
    """
    if period := period_of(name):
        return replace(QUANTITIES["time"], name=name, period=period)
    if (lag := named_lag(name)) and lag[0] in QUANTITIES and lag[0] != "time":
        return replace(QUANTITIES[lag[0]], name=name, lag=lag[1])
    if (of := stops_of(name)) in QUANTITIES and of != "time":
        return replace(QUANTITIES[of], name=name, stops=True)
    return QUANTITIES.get(name)


def at_curve(p: np.ndarray, place: Place, q: Quantity, low: float, high: float, tables: np.ndarray) -> None:
    """Put a curve at a place behind those that ``p`` has; its range and ``tables`` (a column a lane, or one for all)
    are in border units.

    Raises ValueError where there is no room for it.
    """
    c = int(p[CURVES].max())
    if c >= MOST_CURVES:
        raise ValueError(f"a machine has room for {MOST_CURVES} curves")
    r = CURVES + 1 + c * CURVE_ROWS
    p[CURVES] = c + 1
    p[r + C_SITE], p[r + C_OF], p[r + C_LOW], p[r + C_HIGH] = place.site, q.of, low * q.si, high * q.si
    p[r + C_PERIOD], p[r + C_LAG], p[r + C_STOPS] = q.period, q.lag, q.stops
    if q.stops:
        p[r + C_TABLE : r + C_TABLE + RADII] = weights_of(low, high, tables) * (place.si / q.si)
        return
    p[r + C_TABLE : r + CURVE_ROWS] = tables * place.si


@in_place
def bend(s: np.ndarray, p: np.ndarray, j: int, site: int) -> float:
    """Return the sum of lane ``j``'s curves at a site, SI, at the signals in ``s``."""
    total = 0.0
    for c in range(int(p[CURVES, j])):
        r = CURVES + 1 + c * CURVE_ROWS
        if p[r + C_SITE, j] == site and p[r + C_STOPS, j] != 0.0:
            total += s[S_LATE + c, j]
        elif p[r + C_SITE, j] == site:
            x, period = s[SIGNAL_AT + int(p[r + C_OF, j]), j], p[r + C_PERIOD, j]
            if period > 0.0:
                x -= math.floor(x / period) * period
            if p[r + C_LAG, j] > 0.0:
                x = s[S_LATE + c, j]
            k, share = between_points(x, p[r + C_LOW, j], p[r + C_HIGH, j], POINTS)
            a = p[r + C_TABLE + k, j]
            total += a + share * (p[r + C_TABLE + k + 1, j] - a)
    return total


@inlined
def times(by: float) -> float:
    """Return the factor 1 + ``by``, above 0."""
    return max(1.0 + by, LEAST)


@inlined
def bent(x: float, by: float, adds: float) -> float:
    """What a curve that multiplies, and gives ``by``, and one that ``adds`` make of ``x``."""
    return x * times(by) + adds


@inlined
def unbent(y: float, by: float, adds: float) -> float:
    """The inverse of `bent`."""
    return (y - adds) / times(by)


@inlined
def factor(s: np.ndarray, p: np.ndarray, j: int, site: int) -> float:
    """Return 1 + `bend`, above 0."""
    return times(bend(s, p, j, site))


@in_place
def acts(p: np.ndarray, j: int, site: int) -> bool:
    """Whether lane ``j`` has a curve at a site."""
    found = False
    for c in range(int(p[CURVES, j])):
        found |= p[CURVES + 1 + c * CURVE_ROWS + C_SITE, j] == site
    return found


@in_place
def turn(s: np.ndarray, j: int, x: float, t: float, band: float) -> None:
    """Let the stroke come to ``x`` (m) at time ``t`` (s): its direction, and how far and long ago it turned.

    band  m: a smaller way back is no reversal
    """
    farthest, way = s[S_FARTHEST, j], s[S_DIRECTION, j]
    if way != 0.0 and way * (x - farthest) >= 0.0:
        s[S_FARTHEST, j], s[S_FARTHEST + 2, j] = x, t
    elif abs(x - farthest) > band:
        s[S_DIRECTION, j] = 1.0 if x > farthest else -1.0
        s[S_FARTHEST + 1, j], s[S_FARTHEST + 3, j] = farthest, s[S_FARTHEST + 2, j]
        s[S_FARTHEST, j], s[S_FARTHEST + 2, j] = x, t
    s[S_DISTANCE, j], s[S_SINCE, j] = abs(x - s[S_FARTHEST + 1, j]), t - s[S_FARTHEST + 3, j]


@compiled
def turns(x: np.ndarray, t: np.ndarray, band: float) -> np.ndarray:
    """Direction (-1, 1; 0 before it first moves) of a channel ``x`` at times ``t``, and way and time since it last
    turned, float64[3, samples].

    band  a smaller way back is no reversal
    """
    s = np.zeros((N_STATE, 1))
    s[S_FARTHEST : S_FARTHEST + 2, 0], s[S_FARTHEST + 2 : S_FARTHEST + 4, 0] = x[0], t[0]
    out = np.empty((3, len(x)))
    for k in range(len(x)):
        turn(s, 0, x[k], t[k], band)
        out[0, k], out[1, k], out[2, k] = s[S_DIRECTION, 0], s[S_DISTANCE, 0], s[S_SINCE, 0]
    return out


@in_place
def follow(
    s: np.ndarray, p: np.ndarray, j: int, i_cmd: float, x_dem: float, n_dem: float, n_r: float, p_s: float,
    t_oil: float, t: float,
) -> None:  # fmt: skip
    """Take the machine's own signals at time ``t`` (s): what curves are a function of until the next tick."""
    since = t - s[S_TIME, j]
    s[S_CURRENT, j], s[S_X, j], s[S_SPEED, j], s[S_N_R, j] = i_cmd, s[X, j], s[SPEED, j], n_r
    s[S_P_S, j], s[S_T_OIL, j], s[S_TIME, j], s[S_N_DEM, j], s[S_X_DEM, j] = p_s, t_oil, t, n_dem, x_dem
    for k in range(int(p[VANE_COUNT, j])):
        s[S_VANE + k, j] = s[POT + k, j]
    turn(s, j, s[X, j], t, TURN * p[STROKE, j])
    for c in range(int(p[CURVES, j])):
        r = CURVES + 1 + c * CURVE_ROWS
        if p[r + C_LAG, j] > 0.0 and since > 0.0:
            signal = s[SIGNAL_AT + int(p[r + C_OF, j]), j]
            s[S_LATE + c, j] += (signal - s[S_LATE + c, j]) * -math.expm1(-since / p[r + C_LAG, j])
        if p[r + C_STOPS, j] != 0.0:
            signal = s[SIGNAL_AT + int(p[r + C_OF, j]), j]
            first, move = S_STOP + c * RADII, signal - s[S_LAST + c, j]
            s[S_LAST + c, j] = signal
            s[S_LATE + c, j] = slip(s, first, j, move, p, r + C_TABLE, p[r + C_HIGH, j])


@in_place
def begin(s: np.ndarray, p: np.ndarray, j: int, t_oil: float) -> None:
    """The signals of a machine at rest, with oil at ``t_oil`` (degC); lags are settled, and no stop is bent."""
    s[S_X, j] = s[S_X_DEM, j] = s[S_FARTHEST, j] = s[S_FARTHEST + 1, j] = s[X, j]
    s[S_N_R, j] = s[S_N_DEM, j] = s[N_R, j]
    s[S_P_S, j], s[S_T_OIL, j] = p[P_REF, j], t_oil
    for k in range(int(p[VANE_COUNT, j])):
        s[S_VANE + k, j] = s[POT + k, j]
    for c in range(int(p[CURVES, j])):
        r = CURVES + 1 + c * CURVE_ROWS
        s[S_LAST + c, j] = s[SIGNAL_AT + int(p[r + C_OF, j]), j]
        s[S_LATE + c, j] = 0.0 if p[r + C_STOPS, j] != 0.0 else s[S_LAST + c, j]


@in_place
def take(s: np.ndarray, p: np.ndarray, j: int, known: np.ndarray, before: int, k: int) -> None:
    """Take the signals that lane ``j``'s curves are of from a log: their mean at samples ``before`` and ``k``.

    known  float64[KNOWN + curves, samples], SI: signals, and behind them that of each curve with a lag, behind it; or
           float64[KNOWN + lanes * curves, samples], with what each lane's hystereses give in the step to a sample
    """
    n = int(p[CURVES, j])
    own = KNOWN + (j * n if len(known) > KNOWN + n else 0)
    for c in range(n):
        r = CURVES + 1 + c * CURVE_ROWS
        q = int(p[r + C_OF, j])
        s[SIGNAL_AT + q, j] = 0.5 * (known[q, before] + known[q, k])
        if p[r + C_LAG, j] > 0.0:
            s[S_LATE + c, j] = 0.5 * (known[own + c, before] + known[own + c, k])
        if p[r + C_STOPS, j] != 0.0:
            s[S_LATE + c, j] = known[own + c, k]
