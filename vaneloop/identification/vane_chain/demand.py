"""Stage `demand`: the stroke demand that the firmware's own trend, tables and rate limits make of the logged speeds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from controller import Calibration, new_inputs, new_outputs, new_state
from controller.records import SLOW, SLOW_TICK, TICK, Record, as_inputs, as_outputs, as_scalars, as_state
from controller.schedule import ROW_EXTENSION, ROW_RETRACTION, move_demand, schedule_step
from controller.trend import trend_step
from hil.figures import noise_floor
from hil.native.call import firmware
from plant.curve import DEMAND_ADDS
from plant.effects import ROW
from vaneloop.base.compiled import compiled, compiled_free
from vaneloop.identification.onset import that_begins
from vaneloop.identification.settings import APPROACH, CURRENT_DRAWS, DEMAND_SAME, LEAST_FLOOR, RASTER, WARM_FRAMES
from vaneloop.identification.subsystem import Array, Effect, Parameter, Stage
from vaneloop.identification.vane_chain.parameters import bends, declared
from vaneloop.identification.vane_chain.resample import last_digit, lately, pieces_of
from vaneloop.identification.vane_chain.subsystem_data import Driven, Made

__all__ = ["demand_stage", "own_demand_stage"]


@compiled
def _demand_run(
    first: int,
    last: int,
    t: np.ndarray,
    n_dem: np.ndarray,
    n_r: np.ndarray,
    delay: float,
    hold: float,
    phase: float,
    k: Record,
    table: np.ndarray,
    z: Record,
    offset: np.ndarray,
    out: np.ndarray,
) -> None:
    """The firmware's 10 ms part on the logged frames from row ``first`` to before ``last``: x_dem (m) of every
    frame. ``offset`` (m) is added to the tables' stroke.
    """
    dt = t[1] - t[0]
    skipped = round(t[first] / dt) - first  # rows of the log's raster before this one that are not here
    for i in range(first, last):
        at = t[i]
        if hold > dt:  # within a period of the frames there is nothing to hold
            at = np.floor((at - phase) / hold + 1e-9) * hold + phase
        at = (at - delay) / dt - skipped
        j = min(max(int(np.floor(at + 1e-9)), first), last - 1)
        w = min(max(at - j, 0.0), 1.0)
        if w < 1e-6 or j == last - 1:
            a, b = n_dem[j], n_r[j]
        else:
            a = n_dem[j] + w * (n_dem[j + 1] - n_dem[j])
            b = n_r[j] + w * (n_r[j + 1] - n_r[j])
        if i == first:
            z.trend_n = a
            z.trend_turn = a
            z.trend_last = a
            z.n_r = b
        z.n_dem = a
        z.n_r += (b - z.n_r) * SLOW_TICK / (k.speed_filter + SLOW_TICK)
        trend_step(z, k, a)
        schedule_step(z, k, table)
        z.x_target += offset[i]
        if i == first:
            z.x_dem = z.x_target
        move_demand(z, k, z.x_target, k.stroke_rate)
        out[i] = z.x_dem


@compiled
def _directions(n_dem: np.ndarray, k: Record, z: Record, out: np.ndarray) -> None:
    """Direction of the demand's trend at each row, from the trend's state ``z``."""
    for i in range(len(n_dem)):
        trend_step(z, k, n_dem[i])
        out[i] = z.direction


def _direction_known(n_dem: Array, cal: Calibration) -> Array:
    """Rows at which the trend's direction does not turn on what the demand did before the first of them.

    How far the demand had already come back then is not known: nothing, or nearly all that turns the direction. Where
    the two lead to different directions, from either, the row does not count, nor those in which the curves blend.
    """
    known = np.ones(len(n_dem), dtype=bool)
    for direction in (1.0, -1.0):
        out = np.empty((2, len(n_dem)))
        for back, row in zip((0.0, 0.999 * cal.scalars.trend_change), out, strict=True):
            z = as_state(new_state())
            z.trend_n = z.trend_last = n_dem[0]
            z.trend_turn, z.direction = n_dem[0] + direction * back, direction
            _directions(n_dem, cal.scalars, z, row)
        known &= out[0] == out[1]
    return known & ~lately(~known, cal.scalars.blend_time + 0.1)


@that_begins
def demand_stage(driven: Driven) -> Stage:
    """Stroke demand from logged speeds, by the firmware as it is flashed."""
    t, c, machine, cal, outputs, run = driven[:6]
    _, effects, _, _ = declared("demand", driven)
    signals = driven.signals()
    none = np.zeros((1, len(t)))
    n_dem, n_r = np.ascontiguousarray(c["n_dem"]), np.ascontiguousarray(c["n_r"])
    pieces = pieces_of(c["spell"])
    run = (
        run
        & np.concatenate([_direction_known(n_dem[piece], cal) for piece in pieces])
        & ~lately(c["missing"] > 0.0, 0.4)
    )
    measured = driven.measured(run)[0]
    at = {e.name: sum(len(f.parameters) for f in effects[:i]) for i, e in enumerate(effects)}

    def value(theta: Array, name: str, neutral: float) -> float:
        return float(theta[at[name]]) if name in at else neutral

    def simulate(thetas: Array, n_dem: Array = n_dem, n_r: Array = n_r, signals: Array = signals) -> Array:
        out = np.empty((len(thetas), 1, len(t)))
        other = np.empty(len(t))
        shift = next(bends(driven, thetas, signals, DEMAND_ADDS)) * 1e-3 if driven.curved else none
        for i, theta in enumerate(thetas):
            k, table = as_scalars(cal.k.copy()), cal.table.copy()
            factor = value(theta, "trend_threshold_error", 1.0)
            k.trend_rate_on *= factor
            k.trend_change *= factor
            offset = value(theta, "schedule_error", 0.0)
            table[1:] += offset * 1e-3
            hold = value(theta, "frame_hold", float(machine.p[ROW["frame_hold"], 0]))
            phase = float(theta[at["frame_hold"] + 1]) * hold if hold > 0.0 and "frame_hold" in at else 0.0
            delay = value(theta, "can_delay", float(machine.p[ROW["can_delay"], 0]))
            for piece in pieces:
                first, last = piece.start, piece.stop
                curves = [
                    float(np.interp(n_r[first], table[0], table[row])) * 1e3 for row in (ROW_EXTENSION, ROW_RETRACTION)
                ]
                rising = abs(curves[0] - c["x_dem"][first]) <= abs(curves[1] - c["x_dem"][first])
                # at the start of a log the demand stands on a curve; later both directions are tried
                for x, up in ((out[i, 0], rising), (other, not rising)) if first else ((out[i, 0], rising),):
                    z = as_state(new_state())
                    z.demand_seen = 1.0
                    z.direction, z.blend = (1.0, 1.0) if up else (-1.0, 0.0)
                    _demand_run(first, last, t, n_dem, n_r, delay, hold, phase, k, table, z, shift[i % len(shift)], x)
                if first:
                    one, two = (np.nansum((x[piece] * 1e3 - measured[piece]) ** 2) for x in (out[i, 0], other))
                    if two < one:
                        out[i, 0, piece] = other[piece]
        return out * 1e3

    # the hold's clock is not the log's: where it stands is a nuisance that is fitted with it
    held = []
    for e in effects:
        if e.name == "frame_hold":
            phase = Parameter("phase", 0.0, "-", 0.0, 1.0, shape=True, period=1.0)
            starts = tuple((s[0], k * RASTER / s[0]) for s in e.starts for k in range(max(1, round(s[0] / RASTER))))
            e = Effect(e.name, (*e.parameters, phase), starts, e.excites)
        held.append(e)
    effects = tuple(held)
    at = {e.name: sum(len(f.parameters) for f in effects[:i]) for i, e in enumerate(effects)}
    stage = Stage("demand", outputs, ("mm",), (), effects, simulate, t, measured[None])
    stage.made = Made(demand_stage, driven)
    if driven.again:
        return stage
    neutral = stage.neutral()[None]
    as_logged, draws = simulate(neutral)[0, 0], []
    of_demand, of_speed = last_digit(n_dem, driven.digit("n_dem")), _other_noise(t, n_r, driven.digit("n_r"))
    for k in range(CURRENT_DRAWS):
        came, read = (of(np.random.default_rng(s)) for of, s in ((of_demand, k), (of_speed, CURRENT_DRAWS + k)))
        other = {"n_dem": n_dem + came, "n_r": n_r + read}
        run_of_it = simulate(neutral, **other, signals=driven._replace(columns=c | other).signals())[0, 0]
        draws.append(np.where(np.isfinite(measured), run_of_it - as_logged, np.nan))
    by_noise = np.array(draws)
    share, beyond = _by_noise(t, measured - as_logged, by_noise, LEAST_FLOOR["demand"])
    stage.lost, stage.raster_error = np.sqrt(share) * by_noise[:, None], np.array([beyond])
    return stage


def _other_noise(t: Array, values: Array, step: float) -> Callable[[np.random.Generator], Array]:
    """Function that draws noise such as a measured channel has: the rounding of its last digit, a ``step``, and
    white.
    """
    digit, size = last_digit(values, step), noise_floor(t, values)
    white = max(size**2 - (step / 12.0**0.5) ** 2, 0.0)
    white = np.sqrt(white if white > 0.05 * size**2 else 0.0)
    return lambda draw: digit(draw) + white * draw.standard_normal(len(t))


def _by_noise(t: Array, error: Array, draws: Array, least: float) -> tuple[float, float]:
    """How much of the noise of an input is an error, as a share of its power, and the RMS of what it makes beyond what
    is seen of it as noise of the error.

    Behind a filter noise is slow, and differs with the gain, so that the quiet parts of a log show little of it. How
    much of the input's noise is an error is not known, for the controller may have had the same: no more than makes
    the noise seen in the error.

    draws  what all of it makes, float64[draws, samples]
    least  what the floor is at least
    """
    seen, whole = noise_floor(t, error), float(np.nanmean(draws**2))
    shown = float(np.mean([noise_floor(t, d) for d in draws]))
    share = min(1.0, (seen / shown) ** 2) if shown > 0.0 else 0.0
    slow = share * max(whole - shown**2, 0.0)
    return share, float(np.sqrt(max(seen**2 + slow - max(seen, least) ** 2, 0.0)))


# ---- Stage `demand` of a controller of the user's own: the stroke demand that it makes of logged speeds


@compiled_free
def _run(
    n_dem: np.ndarray,
    n_r: np.ndarray,
    start: float,
    angles: np.ndarray,
    before: float,
    inputs: np.ndarray,
    outputs: np.ndarray,
    z: np.ndarray,
    calibration: Calibration,
    foreign: object,
    out: np.ndarray,
) -> None:
    """Run a controller on a frame every 10 ms, its piston from ``start`` (m) on: x_dem (m) of every frame.

    before  %, by which the demand begins below the log's first one, `WARM_FRAMES` frames before it
    """
    fed, given = as_inputs(inputs), as_outputs(outputs)
    n, x = len(n_dem), start
    scalars = as_scalars(calibration.k)
    per_ampere = 1.0 / scalars.kff if scalars.kff > 0.0 else scalars.stroke_rate / scalars.current_limit
    for i in range(-WARM_FRAMES, n):
        j = max(i, 0)
        to_go = 0.0 if i >= -WARM_FRAMES // 2 else 2.0 * (-i - WARM_FRAMES // 2) / WARM_FRAMES
        fed.n_dem, fed.n_r = n_dem[j] - before * to_go, n_r[j] - before * to_go
        for q in range(angles.shape[0]):
            fed.pots[q] = angles[q, j]
        for k in range(SLOW):
            fed.demand_fresh = 1.0 if k == 0 else 0.0
            fed.x_lvdt = x
            firmware(inputs, outputs, z, calibration, foreign)
            x = min(max(x + given.i_cmd * per_ampere * TICK, scalars.stroke_min), scalars.stroke_max)
            if k == 0 and i >= 0:
                out[i] = given.x_dem


@that_begins
def own_demand_stage(driven: Driven) -> Stage:
    """Stroke demand from logged speeds, by the user's library as it is flashed.

    What it remembers from before the log is not known: it is run twice, with a demand that came from below and one that
    came from above, and only rows where both agree count.
    """
    t, c, machine, cal, outputs, run = driven[:6]
    _, effects, _, _ = declared("demand", driven)
    effects = tuple(e for e in effects if e.name != "frame_hold")
    at = {e.name: sum(len(f.parameters) for f in effects[:i]) for i, e in enumerate(effects)}
    n_dem, n_r, start = c["n_dem"], c["n_r"], float(c["x_dem"][0]) * 1e-3
    angles = np.array([np.deg2rad(c[v]) if v in c else np.full(len(t), np.nan) for v in machine.vanes])

    def demanded(theta: Array, before: float) -> Array:
        def value(name: str, neutral: float) -> float:
            return float(theta[at[name]]) if name in at else neutral

        k, table = cal.k.copy(), cal.table.copy()
        scalars, factor = as_scalars(k), value("trend_threshold_error", 1.0)
        scalars.trend_rate_on *= factor
        scalars.trend_change *= factor
        table[1:] += value("schedule_error", 0.0) * 1e-3
        flashed = cal._replace(k=k, table=table, program=None)
        late = value("can_delay", float(machine.p[ROW["can_delay"], 0]))
        frames = np.arange(len(t)) - late / SLOW_TICK
        came, came_r = (np.interp(frames, np.arange(len(t)), v) for v in (n_dem, n_r))
        out, program = np.empty(len(t)), cal.program.start(flashed)
        _run(came, came_r, start, angles, before, new_inputs(), new_outputs(), new_state(), flashed, program, out)
        return out

    def simulate(thetas: Array) -> Array:
        return np.array([[demanded(theta, APPROACH) * 1e3] for theta in thetas])

    neutral = Stage("demand", outputs, ("mm",), (), effects, simulate, t, c["x_dem"][None]).neutral()
    differs = np.abs(demanded(neutral, APPROACH) - demanded(neutral, -APPROACH)) > DEMAND_SAME
    rows = run & ~lately(differs, 0.5) & ~lately(c["missing"] > 0.0, 0.4)
    return Stage("demand", outputs, ("mm",), (), effects, simulate, t, driven.measured(rows))
