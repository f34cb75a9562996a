"""Design of the servo loop: margins, noise, steps and the limit cycles that play makes, each predicted and held against
the simulation, and the stated limits that they must keep.

The loop and its margins are in `servo`, the predictions of limit cycles in `limit_cycles`, the simulation in
`servo_simulation`. Units: SI in the code, the border's units (mm, mA, deg, Hz) in every figure of a `DesignResult`, as
its names say.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vaneloop.base.errors import InputError
from vaneloop.design.limit_cycles import LimitCycle, Play, harmonic_balance, limit_cycles
from vaneloop.design.servo import (
    Gains,
    Margins,
    ServoPlant,
    analyse,
    continuous_response,
    default_gains,
    frequency_grid,
    frequency_response,
    noise_current,
    sampled_loop,
)
from vaneloop.design.servo_motor import plant_of_tables
from vaneloop.design.servo_simulation import ramp_demand, simulate, steady_cycle

__all__ = [
    "BACKLASH_INSIDE", "MIDDLE", "Check", "DesignResult", "Limits", "PlayFigures", "design", "evaluate", "summary",
]  # fmt: skip

Complex = NDArray[np.complex128]
BACKLASH_INSIDE = 0.02e-3  # m: a rod end in good order, between piston and LVDT
MIDDLE = 24e-3  # m: simulations run about mid-stroke, away from the stops


# ---------------------------------------------------------------- limits and result


@dataclass(frozen=True)
class Limits:
    """What the design must keep; why is in docs/control_design.md."""

    gain_margin_db: float = 8.0
    phase_margin_deg: float = 50.0
    disk_margin: float = 0.86  # 8 dB and 46.6 deg at the same time: alpha = 2 (r - 1)/(r + 1), r = 10^(8/20)
    noise_current_ma: float = 1.0  # rms; 2.5 % of rated: a valve's own threshold is about 0.5 to 1 %
    overshoot_percent: float = 20.0  # of a linear step of x_dem; the product's demand never steps
    ramp_peak_mm: float = 0.15  # at 20 mm/s; 0.15 deg of VIGV, a tenth of its hysteresis
    ramp_steady_mm: float = 0.005  # the LVDT's noise
    bias_settled_s: float = 0.5  # 1 mA of null bias, back within 0.005 mm
    hunting_mm: float = 0.05  # amplitude of the piston in a limit cycle by play or hysteresis inside the loop
    hunting_at_rest_codes: float = 3.0  # peak to peak at rest with a quantised, noise-free LVDT


@dataclass(frozen=True)
class Check:
    """One stated margin and whether it holds."""

    name: str
    value: float
    limit: float
    unit: str
    ok: bool
    at: str = ""


@dataclass(frozen=True)
class PlayFigures:
    """Limit cycle by play: predicted by the describing function, and simulated. Lengths and currents in ``unit``."""

    site: str
    gap: float
    unit: str
    inside: bool
    predicted_amplitude: float | None
    predicted_hz: float | None
    harmonic_amplitude: float | None  # the same prediction with the odd harmonics kept
    harmonic_hz: float | None
    simulated_amplitude: float | None
    simulated_hz: float | None
    simulated_lvdt_mm: float  # half of peak to peak of what the LVDT sees in the second half of the run
    without_integral: float | None  # predicted amplitude with ki = 0
    grazing: (
        bool  # the piston hardly leaves the gap: the signal after the play is far from a sine, expect 30 % in frequency
    )


@dataclass(frozen=True)
class DesignResult:
    """All figures of a design, in border units; `to_dict` is JSON."""

    gains: Gains
    plant: ServoPlant
    limits: Limits
    nominal: Margins
    worst: dict[str, float]
    worst_at: dict[str, str]
    corners: list[Any]  # `Corner`, or what the plant has in its place
    noise_current_ma: float
    step: dict[str, float]
    ramp: dict[str, float]
    bias: dict[str, float]
    rest: dict[str, float]
    play: list[PlayFigures]
    checks: list[Check]
    ok: bool
    curves: dict[str, Any] = field(repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values: no NaN, no infinity (both become null), no curves."""
        d = {k: v for k, v in asdict(replace(self, curves={})).items() if k != "curves"}
        return {"schema": 1, **_plain(d)}


def _plain(v: Any) -> Any:
    """Replace what JSON cannot hold."""
    if isinstance(v, dict):
        return {k: _plain(w) for k, w in v.items()}
    if isinstance(v, list | tuple):
        return [_plain(w) for w in v]
    if isinstance(v, np.bool_):
        return bool(v)
    if isinstance(v, float | np.floating):
        return float(v) if math.isfinite(v) else None
    return v


# ---------------------------------------------------------------- figures


def _step_figures(gains: Gains, plant: ServoPlant, curves: dict[str, Any]) -> dict[str, float]:
    """Linear step (no feed-forward, no limit), and 10 mm as a bare step and as the firmware would draw it (100
    mm/s).
    """
    closed = ct.feedback(sampled_loop(gains, plant), 1)
    t = np.arange(0.0, 1.0, plant.tick)
    y = np.asarray(ct.step_response(closed, t).outputs).ravel()
    final = float(np.real(closed.dcgain()))
    inside = np.abs(y - final) <= 0.05 * abs(final)
    last_outside = int(np.flatnonzero(~inside)[-1]) if not inside.all() else 0
    curves["step_t"], curves["step_linear"] = t, y
    bare = simulate(gains, plant, np.full(1000, MIDDLE + 5e-3), start=MIDDLE - 5e-3)
    points = np.clip(MIDDLE - 5e-3 + 0.1 * np.arange(100) * 10e-3, None, MIDDLE + 5e-3)
    drawn = simulate(gains, plant, *ramp_demand(points, plant), start=MIDDLE - 5e-3)
    curves["step_bare"], curves["step_drawn"] = bare, drawn
    return {
        "rise_10_90_ms": float(1e3 * plant.tick * (np.argmax(y >= 0.9 * final) - np.argmax(y >= 0.1 * final))),
        "settle_5_percent_ms": 1e3 * plant.tick * (last_outside + 1),
        "overshoot_percent": 100.0 * max(0.0, float(y.max()) / final - 1.0),
        "bare_10mm_overshoot_mm": 1e3 * max(0.0, float(bare.x.max()) - (MIDDLE + 5e-3)),
        "bare_10mm_saturated_ms": 1e3 * plant.tick * float(np.sum(np.abs(bare.i) >= plant.current_limit)),
        "drawn_10mm_overshoot_mm": 1e3 * max(0.0, float(drawn.x.max()) - (MIDDLE + 5e-3)),
        "drawn_10mm_error_mm": 1e3 * float(np.abs(drawn.x_dem - drawn.x_lvdt).max()),
    }


def _ramp_figures(gains: Gains, plant: ServoPlant, curves: dict[str, Any]) -> dict[str, float]:
    """A ramp of 20 mm/s for 0.6 s, then hold: greatest error, error at the end of the ramp."""
    points = MIDDLE - 6e-3 + 0.02 * np.clip(np.arange(120) * 10e-3 - 0.1, 0.0, 0.6)
    run = simulate(gains, plant, *ramp_demand(points, plant))
    error = 1e3 * (run.x_dem - run.x_lvdt)
    curves["ramp"] = run
    moving = (run.t >= 0.65) & (run.t < 0.70)
    return {
        "speed_mm_s": 20.0,
        "peak_error_mm": float(np.abs(error).max()),
        "steady_error_mm": float(np.abs(error[moving]).max()),
        "overshoot_mm": 1e3 * max(0.0, float(run.x.max() - run.x_dem.max())),
    }


def _bias_figures(gains: Gains, plant: ServoPlant) -> dict[str, float]:
    """A null bias of 1 mA appears: greatest stroke error, and time until it stays within 0.005 mm."""
    run = simulate(gains, plant, np.full(3000, MIDDLE), null_bias=1e-3)
    error = 1e3 * np.abs(run.x - MIDDLE)
    outside = np.flatnonzero(error > 0.005)
    return {
        "current_ma": 1.0,
        "peak_mm": float(error.max()),
        "settled_s": plant.tick * float(outside[-1] + 1 if outside.size else 0),
    }


def _rest_figures(gains: Gains, plant: ServoPlant) -> dict[str, float]:
    """At rest: quantised LVDT without noise (hunting by the converter's steps), then with noise (current, piston)."""
    middle = MIDDLE + 0.37 * plant.lvdt_step  # between two codes: the error can never be 0
    quiet = simulate(gains, plant, np.full(10_000, middle), quantised=True, null_bias=1e-3, integral=-1e-3)
    noisy = simulate(gains, plant, np.full(5000, middle), quantised=True, noise_seed=1)
    return {
        "quantised_codes": float(np.ptp(quiet.x[5000:])) / plant.lvdt_step if plant.lvdt_step else 0.0,
        "quantised_current_ma": 1e3 * float(np.ptp(quiet.i[5000:])),
        "noisy_current_ma_rms": 1e3 * float(np.std(noisy.i[500:])),
        "noisy_stroke_mm_rms": 1e3 * float(np.std(noisy.x[500:])),
    }


@dataclass(frozen=True)
class _Predicted:
    """Limit cycles of a play of width 1: by the describing function, with harmonics, and without the integral. All
    scale with the gap.
    """

    plain: LimitCycle | None
    harmonic: LimitCycle | None
    proportional: LimitCycle | None


def _predict(gains: Gains, plant: ServoPlant) -> _Predicted:
    """Limit cycles of the loop with a play of width 1 in it, wherever it sits: broken there, the loop is the same."""
    low, high = 0.05, 0.9 * math.pi / plant.tick

    def greatest(g: Gains) -> tuple[Any, LimitCycle | None]:
        loop = sampled_loop(g, plant)

        def response(w: ArrayLike) -> Complex:
            return frequency_response(loop, np.asarray(w, dtype=float))

        return response, max(limit_cycles(response, 1.0, low, high), key=lambda c: c.amplitude, default=None)

    response, top = greatest(gains)
    return _Predicted(
        top, harmonic_balance(response, 1.0, top, high) if top else None, greatest(replace(gains, ki=0.0))[1]
    )


def _play_figures(
    gains: Gains, plant: ServoPlant, play: Play, predicted: _Predicted, curves: dict[str, Any], seconds: float = 16.0
) -> PlayFigures:
    """Predict and simulate the limit cycle of ``play``."""
    inside = play.site != "vanes"
    scale, unit = 1e3, "mA" if play.site == "valve" else "mm"
    gap = scale * play.gap
    top, better, bare = (
        (predicted.plain, predicted.harmonic, predicted.proportional) if inside and gap > 0.0 else (None, None, None)
    )
    n = round(seconds / plant.tick)
    if inside:
        # start on the predicted oscillation: a servo that comes to rest inside its play stays there
        size = play.gap * (top.amplitude if top else 1.0)
        away, wind = (size, 0.0) if play.site == "lvdt" else (0.0, size)
        run = simulate(gains, plant, np.full(n, MIDDLE), play=play, start=MIDDLE + away, integral=wind)
        seen = steady_cycle(run.t, run.play_in, 0.02 * play.gap) if play.gap > 0.0 else None
        ripple = 0.5e3 * float(np.ptp(run.x_lvdt[n // 2 :]))
    else:
        # a reversal, then rest
        points = MIDDLE + np.interp(np.arange(n // 10) * 10e-3, [0.1, 0.3, 0.5], [0.0, 4e-3, 2e-3])
        run = simulate(gains, plant, *ramp_demand(points, plant), outside=play.gap)
        seen = steady_cycle(run.t, run.x_vane, 1e-9)
        ripple = 0.5e3 * float(np.ptp(run.x_vane[n // 2 :]))
    curves.setdefault("play", {})[play.site] = run
    return PlayFigures(
        site=play.site,
        gap=gap,
        unit=unit,
        inside=inside,
        predicted_amplitude=gap * top.amplitude if top else None,
        predicted_hz=top.omega / (2.0 * math.pi) if top else None,
        harmonic_amplitude=gap * better.amplitude if better else None,
        harmonic_hz=better.omega / (2.0 * math.pi) if better else None,
        simulated_amplitude=scale * seen.amplitude if seen else None,
        simulated_hz=seen.omega / (2.0 * math.pi) if seen else None,
        simulated_lvdt_mm=ripple,
        without_integral=gap * bare.amplitude if bare else None,
        grazing=bool(top and top.amplitude < 0.75),
    )


# ---------------------------------------------------------------- the whole design


def design(
    gains: Gains | None = None,
    plant: ServoPlant | None = None,
    limits: Limits | None = None,
    *,
    backlash_inside: float = BACKLASH_INSIDE,
    valve_hysteresis: float = 1.2e-3,
    backlash_outside: float = 1.5e-3,
) -> DesignResult:
    """Analyse the servo loop with ``gains`` (default: ``calibration.toml``) and say whether the stated limits hold.

    backlash_inside   m, total play between piston and LVDT rod
    valve_hysteresis  A, total width of the valve's hysteresis (3 % of rated current)
    backlash_outside  m of stroke, total play between piston and vanes (1.6 deg of VIGV)
    """
    gains = gains or default_gains()
    plant = plant or plant_of_tables()
    limits = limits or Limits()
    curves: dict[str, Any] = {}
    nominal, corners = analyse(gains, plant)
    everywhere = [("nominal", nominal), *((c.describe(), c.margins) for c in corners)]
    worst, worst_at = {}, {}
    for name in ("gain_margin_db", "phase_margin_deg", "disk_margin"):
        at, m = min(everywhere, key=lambda p, name=name: getattr(p[1], name))  # type: ignore[misc]
        worst[name], worst_at[name] = getattr(m, name), at
    at, m = max(everywhere, key=lambda p: p[1].sensitivity_peak)
    worst["sensitivity_peak"], worst_at["sensitivity_peak"] = m.sensitivity_peak, at
    stable = all(m.stable for _, m in everywhere)

    omega = frequency_grid(plant, 1200)
    curves["omega"], curves["sampled"] = omega, frequency_response(sampled_loop(gains, plant), omega)
    curves["continuous"] = continuous_response(gains, plant, omega)
    if not stable:  # nothing else means anything
        checks = [Check("stable at every corner", 0.0, 1.0, "-", False, next(a for a, m in everywhere if not m.stable))]
        return DesignResult(
            gains, plant, limits, nominal, worst, worst_at, corners, math.nan, {}, {}, {}, {}, [], checks, False, curves
        )

    noise = 1e3 * noise_current(gains, plant)
    step = _step_figures(gains, plant, curves)
    ramp = _ramp_figures(gains, plant, curves)
    bias = _bias_figures(gains, plant)
    rest = _rest_figures(gains, plant)
    predicted = _predict(gains, plant)
    sites = [Play("lvdt", backlash_inside), Play("valve", valve_hysteresis), Play("vanes", backlash_outside)]
    play = [_play_figures(gains, plant, p, predicted, curves) for p in sites if p.site != "valve" or plant.hysteretic]
    hunting = max(play[0].predicted_amplitude or 0.0, play[0].simulated_amplitude or 0.0)
    by_valve = [p.simulated_lvdt_mm for p in play if p.site == "valve"]
    checks = [
        *(
            Check(name, worst[key], limit, unit, worst[key] >= limit, worst_at[key])
            for name, key, limit, unit in (
                ("gain margin, worst corner", "gain_margin_db", limits.gain_margin_db, "dB"),
                ("phase margin, worst corner", "phase_margin_deg", limits.phase_margin_deg, "deg"),
                ("disk margin, worst corner", "disk_margin", limits.disk_margin, "-"),
            )
        ),
        *(
            Check(name, value, limit, unit, bool(value <= limit))
            for name, value, limit, unit in (
                ("current from LVDT noise, rms", noise, limits.noise_current_ma, "mA"),
                ("overshoot of a linear step", step["overshoot_percent"], limits.overshoot_percent, "%"),
                ("greatest error on a 20 mm/s ramp", ramp["peak_error_mm"], limits.ramp_peak_mm, "mm"),
                ("steady error on a 20 mm/s ramp", ramp["steady_error_mm"], limits.ramp_steady_mm, "mm"),
                ("1 mA of null bias settled", bias["settled_s"], limits.bias_settled_s, "s"),
                ("hunting by the converter's steps", rest["quantised_codes"], limits.hunting_at_rest_codes, "codes"),
                ("hunting by backlash at the LVDT", hunting, limits.hunting_mm, "mm"),
                *(("hunting by the valve's hysteresis", v, limits.hunting_mm, "mm") for v in by_valve),
            )
        ),
        Check(
            "hunting by backlash outside the loop",
            play[-1].simulated_lvdt_mm,
            1e-4,
            "mm",
            play[-1].simulated_lvdt_mm <= 1e-4,
        ),
    ]
    ok = all(c.ok for c in checks)
    return DesignResult(
        gains, plant, limits, nominal, worst, worst_at, corners, noise, step, ramp, bias, rest, play, checks, ok, curves
    )


def evaluate(
    *,
    kp: float | None = None,
    ki: float | None = None,
    kff: float | None = None,
    backlash_inside: float | None = None,
    plant: str | Path = "plant.toml",
) -> tuple[DesignResult, int]:
    """``vaneloop design``: the calibrated gains with overrides (kp A/m, ki A/(m s), kff A/(m/s)), play inside the loop
    in mm, around the actuator of the table ``plant``.

    Returns the result and the exit code: 0 all stated limits hold, 1 not. Raises InputError for a value outside its
    range.
    """
    base = default_gains()
    gains = Gains(base.kp if kp is None else kp, base.ki if ki is None else ki, base.kff if kff is None else kff)
    if backlash_inside is not None and not 0.0 <= backlash_inside <= 10.0:
        raise InputError(f"backlash_inside (={backlash_inside:g} mm) must be in [0, 10]")
    inside = BACKLASH_INSIDE if backlash_inside is None else backlash_inside * 1e-3
    result = design(gains, plant_of_tables(plant), backlash_inside=inside)
    return result, 0 if result.ok else 1


def summary(result: DesignResult) -> list[str]:
    """What the command prints."""
    g, m = result.gains, result.nominal
    lines = [
        f"gains: kp {g.kp:g} mA/mm, ki {g.ki:g} mA/(mm s), kff {g.kff:g} mA/(mm/s)",
        f"nominal: crossover {m.crossover_hz:.1f} Hz, gain margin {m.gain_margin_db:.1f} dB, phase margin "
        f"{m.phase_margin_deg:.1f} deg, disk margin {m.disk_margin:.2f}, bandwidth {m.bandwidth_hz:.1f} Hz",
    ]
    for c in result.checks:
        at = f", at {c.at}" if c.at else ""
        lines.append(f"{'ok  ' if c.ok else 'MISS'} {c.name}: {c.value:.3g} {c.unit} (limit {c.limit:g}{at})")
    lines += [_say_play(p) for p in result.play]
    return lines


def _say_play(p: PlayFigures) -> str:
    """One line about one play."""
    where = {
        "lvdt": "between piston and LVDT",
        "valve": "in the valve",
        "vanes": "between piston and vanes (outside the loop)",
    }[p.site]

    def cycle(a: float | None, hz: float | None) -> str:
        return "none" if a is None or hz is None else f"{a:.3g} {p.unit} at {hz:.2f} Hz"

    return (
        f"backlash of {p.gap:g} {p.unit} {where}: limit cycle predicted "
        f"{cycle(p.predicted_amplitude, p.predicted_hz)}, with harmonics {cycle(p.harmonic_amplitude, p.harmonic_hz)}, "
        f"simulated {cycle(p.simulated_amplitude, p.simulated_hz)}"
    )
