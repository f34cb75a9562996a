"""Which name of a log is which of our signals, and in what unit, where nobody has said so.

A guess needs three things: a name that says the signal (`hil.logs.names`), numbers that such a signal has in the unit
that the log states or in exactly one unit, and no contradiction with the other signals (a vane that turns against the
stroke, two speeds that are not of one rotor). Two candidates that are alike are not guessed, they are named. Our own
names with their own units need no guess. docs/logs.md is the user's page.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from hil.logs import plausible
from hil.logs.names import Meaning, bracketed, lacks, meaning, spool, unit_kind
from hil.logs.source import LogError, Source
from hil.logs.units import NO_UNIT, factor_of, scale_of
from vaneloop.base.signals import SIDES, UNITS
from vaneloop.base.vanes import VANES

if TYPE_CHECKING:
    from controller import Calibration

__all__ = [
    "ENOUGH", "Files", "Guess", "Guesses", "contradictions", "design_speed", "guess", "mean_stroke", "planned_angles",
    "withdrawn",
]  # fmt: skip

ENOUGH = 0.7  # confidence below which a name is only mentioned
ALIKE = 0.1  # two candidates whose confidences differ by no more are not told apart
_COMMENT = 0.05  # what a comment is worth less than a name
_LONGEST_COMMENT = 80  # letters
# a machine with an effect that its model lacks stays nearer to its schedule
_OFF, _STRETCHED = 0.18, 1.5  # of the schedule's reach (8 mm of the shipped 44 mm), ratio

# unit -> lowest and highest of the 99th percentile of the size, of a run that shows its unit; only units whose ranges
# tell them apart
_USUAL: dict[str, dict[str, tuple[float, float]]] = {
    "n_dem": {"%": (20.0, 130.0), "ratio": (0.2, 1.3), "rpm": (1_000.0, 200_000.0)},
    "x_dem": {"mm": (6.0, 60.0), "m": (0.004, 0.06), "um": (6_000.0, 60_000.0), "inch": (0.4, 2.4), "cm": (0.6, 6.0)},
    "i_cmd": {"mA": (0.5, 100.0), "A": (0.0005, 0.1), "uA": (500.0, 1e5)},
    "p_s": {"MPa": (8.0, 40.0), "bar": (80.0, 400.0), "psi": (1_200.0, 5_800.0), "kPa": (8e3, 4e4), "Pa": (8e6, 4e7)},
    "t_oil": {"degC": (5.0, 160.0), "K": (253.0, 433.0), "degF": (90.0, 250.0)},
    "vgv": {"deg": (3.0, 90.0), "rad": (0.05, 1.57)},
}  # fmt: skip
_LIKE = {"n_r": "n_dem", "x_lvdt": "x_dem", **dict.fromkeys(VANES, "vgv")}


@dataclass(frozen=True)
class Guess:
    """A guess that is made: the log's ``name`` is ``signal``, in ``unit``.

    confidence  0 to 1: of the name, times that of the unit
    why         what speaks for it, in words
    """

    signal: str
    name: str
    unit: str
    confidence: float
    why: str

    def note(self) -> str:
        """The guess in a sentence, with what undoes it."""
        return (
            f"{self.signal}: guessed to be {self.name!r} in {self.unit or '-'}, {100 * self.confidence:.0f} % sure "
            f"({self.why}); --map NAME={self.signal} takes another, --no-guess none"
        )


@dataclass
class Guesses:
    """What is guessed, by signal, and what is not and why: ``open`` signal -> words, the names in them.

    unused  name of the log -> why it is no signal, in a few words
    """

    made: dict[str, Guess] = field(default_factory=dict)
    open: dict[str, str] = field(default_factory=dict)
    unused: dict[str, str] = field(default_factory=dict)
    rpm: dict[str, str] = field(default_factory=dict)  # speeds that wait for the design speed: signal -> name


def guess(
    source: Source, missing: Iterable[str], taken: set[str], stated: Mapping[str, str], design_rpm: float | None
) -> Guesses:
    """Guess which name of a log is which of the ``missing`` signals.

    taken   names of the log that are a signal already
    stated  signal -> unit, where the user named it
    """
    signals = tuple(s for s in missing if s in UNITS and s not in ("state", *SIDES))
    comments: Mapping[str, str] = getattr(source, "comments", {})
    found: dict[str, list[Guess]] = {}
    out = Guesses()
    doubts: dict[str, list[str]] = {}
    for key in source.names:
        if key in taken:
            continue
        m, comment = _meant(key, comments.get(key, ""), signals), comments.get(key, "")
        out.unused[key] = lacks(key)
        if m is None and out.unused[key].startswith("no signal"):
            continue
        try:
            s = source.series(key)
        except LogError:
            out.unused[key] = "words, not numbers"
            continue
        if (m is None or m.confidence < ENOUGH) and unit_kind(s.unit):  # the unit may say what the name does not
            m, out.unused[key] = _meant(key, comment, signals, s.unit), lacks(key, s.unit)
        if m is None:
            other = _meant(key, comment, tuple(UNITS), s.unit)
            if other is not None and other.confidence >= 0.5:
                out.unused[key] = f"{other.signal} has a name already"
            continue
        out.unused[key] = f"{m.signal}? {m.why}"
        if m.confidence < ENOUGH:
            if m.confidence >= 0.5:
                doubts.setdefault(m.signal, []).append(f"{key!r} ({m.why}; that is not enough)")
            continue
        unit, sure, why = _unit(
            m.signal, stated.get(m.signal, ""), s.unit, m.unit or bracketed(key), s.values, design_rpm
        )
        if unit is None:
            out.unused[key] = f"{m.signal}? {why}"
            doubts.setdefault(m.signal, []).append(f"{key!r} ({why})")
            continue
        found.setdefault(m.signal, []).append(Guess(m.signal, key, unit, m.confidence * sure, f"{m.why}; {why}"))
    _of_one_rotor(found, doubts)
    _counted_from_the_inlet(found, doubts, "vigv" in signals)
    for signal, candidates in found.items():
        first, *rest = sorted(candidates, key=lambda g: -g.confidence)
        alike = [g for g in rest if g.confidence >= first.confidence - ALIKE]
        if alike:
            names = " or ".join(repr(g.name) for g in (first, *alike[:3]))
            out.open[signal] = f"may be {names}: not guessed; --map NAME={signal} takes one"
            out.unused |= dict.fromkeys((g.name for g in candidates), f"two could be {signal}: {names}")
        elif first.confidence < ENOUGH:
            doubts.setdefault(signal, []).append(f"{first.name!r} ({first.why})")
        elif signal in ("n_dem", "n_r") and design_rpm is None and isinstance(factor_of(first.unit, "rpm"), tuple):
            out.rpm[signal] = first.name
            out.open[signal] = f"{first.name!r} is in {first.unit} and needs the design speed: --design-rpm R"
        else:
            out.made[signal] = first
            out.unused |= {g.name: f"{signal} is {first.name!r}, more surely" for g in rest}
            del out.unused[first.name]
    for signal, which in doubts.items():
        if signal not in out.made and signal not in out.open:
            out.open[signal] = f"may be {' or '.join(which[:3])}: not guessed; --map NAME={signal} takes one"
    return out


def _of_one_rotor(found: dict[str, list[Guess]], doubts: dict[str, list[str]]) -> None:
    """Leave the measured speed of another rotor than the demand's out: N2_ACT beside N1_DEM."""
    demands = {spool(g.name) for g in found.get("n_dem", [])}
    if len(demands) != 1 or not (which := demands.pop()):
        return
    for g in found.get("n_r", [])[:]:
        if spool(g.name) not in ((), which):
            found["n_r"].remove(g)
            doubts.setdefault("n_r", []).append(f"{g.name!r} (another rotor than that of {found['n_dem'][0].name!r})")
    if not found.get("n_r"):
        found.pop("n_r", None)


def _counted_from_the_inlet(found: dict[str, list[Guess]], doubts: dict[str, list[str]], no_inlet: bool) -> None:
    """Leave vanes out that are counted 1, 2, 3 where no name says which is the inlet's: it may be 1."""
    numbered = [v for v in VANES[1:4] if v in found and not re.search("(?i)v[gs]v", found[v][0].name)]
    if no_inlet and "vigv" not in found and len(numbered) == 3:
        for v in VANES[1:]:
            for g in found.pop(v, []):
                doubts.setdefault(v, []).append(
                    f"{g.name!r} (counted from 1 and no name of an inlet vane: 1 may be it)"
                )


def _meant(key: str, comment: str, signals: tuple[str, ...], unit: str = "") -> Meaning | None:
    """What a name means in its unit, or the comment that its database has on it."""
    m = meaning(key, signals, unit)
    if (m is None or m.confidence < ENOUGH) and 0 < len(comment) <= _LONGEST_COMMENT:
        said = meaning(comment, signals, unit)
        if said is not None and said.confidence >= ENOUGH:
            return Meaning(said.signal, said.unit, said.confidence - _COMMENT, f"its comment: {comment!r}")
    return m


def _unit(
    signal: str, stated: str, in_file: str, in_name: str, values: np.ndarray, design_rpm: float | None
) -> tuple[str | None, float, str]:
    """Unit of a candidate, how sure it is, and why; None where no unit, or none alone, makes it the signal."""
    v = values[np.isfinite(values)]
    if not v.size:
        return None, 0.0, "it has no sample"
    own = UNITS[signal]
    if not stated and in_file and in_name and _differ(in_file, in_name):
        return None, 0.0, f"the log says {in_file}, its name says {in_name}"
    if v.size > 20 and np.array_equal(v, v[0] + np.arange(v.size)):
        return None, 0.0, "it counts the rows"
    for unit, where in ((stated, "you say"), (in_file, "the log says"), (in_name, "its name says")):
        if unit.strip().casefold() in NO_UNIT or unit.strip() == "1":
            continue
        given = unit
        gain, unit, zero = scale_of(unit) if where == "you say" else (1.0, unit, 0.0)
        scaled = gain * v + zero
        factor, speed = factor_of(unit, own), None
        if signal in ("n_dem", "n_r") and not isinstance(factor, tuple):
            speed = factor_of(unit, "rpm")
        if isinstance(speed, tuple):
            factor = (speed[0] * 100.0 / design_rpm, 0.0) if design_rpm is not None else None
            if factor is None:
                return unit, 1.0, f"{where} {unit}"
        if not isinstance(factor, tuple):
            if factor is None and where == "the log says":
                continue  # a unit that nobody knows
            return None, 0.0, f"{where} {unit}, which is no unit of {signal}"
        if why := plausible.judge(signal, scaled * factor[0] + factor[1])[1]:
            return None, 0.0, f"{where} {unit}, but {why}"
        size = float(np.percentile(np.abs(scaled * factor[0] + factor[1]), 99.0))
        if signal == "p_s" and where != "you say" and not _USUAL["p_s"]["MPa"][0] <= size <= _USUAL["p_s"]["MPa"][1]:
            return None, 0.0, f"{where} {unit}, but its values reach {size:.3g} MPa, and a supply has 8 to 40"
        return given, 1.0, f"{where} {given}"
    size = float(np.percentile(np.abs(v), 99.0))
    able = [u for u, (low, high) in _USUAL[_LIKE.get(signal, signal)].items() if low <= size <= high]
    said = f"its values reach {size:.4g}"
    if len(able) == 1:
        return able[0], 0.95 if able[0] == own else 0.9, f"{said}, so {able[0]}"
    if own in able:  # the signal's own unit and a smaller one, such as mm and cm
        return None, 0.0, f"{said}: {' or '.join(able)}? --unit {signal}={own} states it"
    return None, 0.0, f"{said}, which no {signal} does in any usual unit" if not able else f"{said}: {', '.join(able)}?"


def _differ(a: str, b: str) -> bool:
    """Whether two units are of one kind and not the same."""
    factor = factor_of(a, b)
    return isinstance(factor, tuple) and not np.allclose(factor, (1.0, 0.0), rtol=1e-9, atol=1e-9)


# ---- against the other signals ---------------------------------------------------------------------------------------

_Samples = tuple[np.ndarray, np.ndarray]  # t (s), values (own unit)


Files = Mapping[str, str]  # a machine's own tables: name without suffix -> file; the others are the shipped ones
_SHIPPED: Files = {}


def withdrawn(found: Guesses, channels: Mapping[str, _Samples], tables: Files = _SHIPPED) -> None:
    """Withdraw the guesses that contradict the log's other signals or the machine's schedule; ``channels`` signal ->
    t (s), values (own unit).
    """
    for signal, why in contradictions(channels, set(found.made), tables).items():
        g = found.made.pop(signal)
        found.open[signal] = f"{g.name!r} would be it by name, but {why}: not guessed"
        found.unused[g.name] = f"{signal}? {why}"


def contradictions(channels: Mapping[str, _Samples], guessed: set[str], tables: Files = _SHIPPED) -> dict[str, str]:
    """Guessed signals that cannot be what they are taken for, each with words.

    The machine's own signs are the measure: rising speed extends the piston, a longer stroke opens the vanes, current
    above the null extends. Demand and measurement are of one size. What hardly moves proves nothing.
    """
    out: dict[str, str] = {}

    def pair(a: str, b: str) -> tuple[np.ndarray, np.ndarray] | None:
        if a not in channels or b not in channels or a in out or b in out:
            return None
        (ta, va), (tb, vb) = channels[a], channels[b]
        inside = (ta >= tb[0]) & (ta <= tb[-1])
        return (va[inside], np.interp(ta[inside], tb, vb)) if np.count_nonzero(inside) > 20 else None

    def blame(a: str, b: str, why: str) -> None:
        """Put it on the one that is guessed, the first of the two if both are."""
        one, other = (a, b) if a in guessed else (b, a)
        if one in guessed:
            out[one] = why.format(other=other, own=f"{one}=-{UNITS[one]}")

    for a, b, most in (("n_r", "n_dem", 15.0), ("x_lvdt", "x_dem", 15.0)):
        if (p := pair(a, b)) is None:
            continue
        far, turned = (float(np.median(np.abs(p[0] - way * p[1]))) for way in (1.0, -1.0))
        if turned < most / 3.0 and _together(*p, 8.0, 8.0) < -0.7:
            blame(a, b, "it is {other} with the other sign; --unit {own} turns it")
        elif far > most:
            blame(a, b, f"it is {far:.3g} {UNITS[a]} away from {{other}} half of the time")
    for stroke in ("x_lvdt", "x_dem"):
        for speed in ("n_r", "n_dem"):
            if (p := pair(stroke, speed)) is not None and _together(*p, 8.0, 8.0) < -0.7:
                blame(stroke, speed, "it runs against {other}: our stroke grows with the speed")
            if (p := pair(stroke, speed)) is not None and stroke in guessed and (why := _off_schedule(*p, tables)):
                out[stroke] = f"{why} at {speed}; --map NAME={stroke} takes it as it is"
        for vane in VANES:
            if (p := pair(vane, stroke)) is not None and _together(*p, 4.0, 6.0) < -0.7:
                blame(vane, stroke, "it runs against {other}; --unit {own} turns its sign")
    for vane in VANES:
        for speed in ("n_r", "n_dem"):
            if vane in guessed and (p := pair(vane, speed)) is not None and _together(*p, 4.0, 8.0) < -0.7:
                blame(vane, speed, "it runs against {other}; --unit {own} turns its sign")
        if vane in guessed and (like := _other_vane(vane, channels, tables)):
            out.setdefault(vane, f"it moves as {like} does; --map NAME={vane} takes it as it is")
    for moved in ("x_lvdt", "x_dem", "n_r"):
        if "i_cmd" in guessed and (p := pair("i_cmd", moved)) is not None:
            t = channels["i_cmd"][0]
            t = t[(t >= channels[moved][0][0]) & (t <= channels[moved][0][-1])]
            rate = np.gradient(np.convolve(p[1], np.ones(9) / 9, "same"), t)[9:-9]
            if _together(p[0][9:-9], rate, 1.0, 2.0) < -0.5:
                what = "n_r" if moved == "n_r" else "the stroke"
                out["i_cmd"] = f"it drives {what} backwards; --unit i_cmd=-mA turns its sign"
    return out


def _calibration(tables: Files) -> Calibration:
    from controller import load_calibration  # late: with numba and scipy, which only a guess of these needs

    calibration, strokes, angles = (tables.get(n, f"{n}.toml") for n in ("calibration", "stroke_tables", "vane_angles"))
    return load_calibration(calibration, strokes, angles=angles)


def mean_stroke(tables: Files) -> tuple[np.ndarray, np.ndarray]:
    """Return the controller's mean curve: rotor speed (%), stroke (mm)."""
    table = _calibration(tables).table
    return table[0], 1e3 * table[3]


def feed_forward(tables: Files) -> float:
    """Return the current that the controller gives for a speed of the stroke, mA for each mm/s."""
    return float(_calibration(tables).scalars.kff)  # A/(m/s)


def _off_schedule(stroke: np.ndarray, speed: np.ndarray, tables: Files) -> str:
    """Why a stroke that follows the schedule, in its own way, has another zero or unit; "" where it has not."""
    at, curve = mean_stroke(tables)
    planned, off = np.interp(speed, at, curve), _OFF * float(np.ptp(curve))
    if off <= 0.0 or _together(stroke, planned, 0.5 * off, off) < 0.7:
        return ""
    times, far = float(np.std(stroke) / np.std(planned)), float(np.median(np.abs(stroke - planned)))
    if not 1.0 / _STRETCHED < times < _STRETCHED:
        return f"it moves {times:.2g} times as far as the schedule says"
    return f"it is {far:.2g} mm away, half of the time, from what the schedule says" if far > off else ""


def planned_angles(speed: np.ndarray, tables: Files) -> dict[str, np.ndarray]:
    """What the schedule has for each vane row at a rotor speed (%): angles (deg)."""
    from plant.geometry import load_schedules  # late: with numba and scipy, which only a guess of these needs

    schedules = load_schedules(tables.get("schedules", "schedules.toml"))
    return dict(zip(schedules.vanes, np.rad2deg(schedules.targets(speed)).T, strict=True))


def _other_vane(vane: str, channels: Mapping[str, _Samples], tables: Files) -> str:
    """The stage whose schedule a vane follows instead of its own, by the rotor speed; "" where none is clear."""
    speed = next((channels[s] for s in ("n_r", "n_dem") if s in channels), None)
    if vane not in channels or speed is None:
        return ""
    t, angle = channels[vane]
    inside = (t >= speed[0][0]) & (t <= speed[0][-1])
    if np.count_nonzero(inside) <= 20 or np.ptp(angle[inside]) < 4.0:
        return ""
    planned = planned_angles(np.interp(t[inside], *speed), tables)
    if vane not in planned:
        return ""
    far = {v: float(np.median(np.abs(p - angle[inside]))) for v, p in planned.items()}
    nearest = min(far, key=lambda v: far[v])
    return nearest if far[vane] > max(2.0, 3.0 * far[nearest]) else ""


def _together(a: np.ndarray, b: np.ndarray, least_a: float, least_b: float) -> float:
    """Correlation of two signals; 0 where one of them moves less than its least."""
    if a.size < 20 or np.ptp(a) < least_a or np.ptp(b) < least_b:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def design_speed(speed: _Samples, stroke: _Samples | None, tables: Files = _SHIPPED) -> tuple[float, str]:
    """Design speed (rpm) that a log in rpm suggests, and why: never taken, only proposed.

    speed   t (s), rotor speed (rpm)
    stroke  t (s), stroke (mm) of the same run; None where there is none

    The schedule's mean curve gives a stroke for each speed in per cent. The design speed under which the log's strokes
    lie nearest to it (median distance) is proposed. Without a stroke that moves it is the largest speed. Two digits, or
    three.
    """
    t, n = speed
    top = float(np.percentile(np.abs(n), 99.9)) if n.size else 0.0
    if top == 0.0:
        return 0.0, "it is 0 throughout"
    best, why = top, f"the largest speed is {top:,.0f} rpm"
    if stroke is not None and np.ptp(stroke[1]) > 8.0:
        of, curve = mean_stroke(tables)
        at = np.linspace(t[0], t[-1], 2000)
        speeds, strokes = np.interp(at, t, n), np.interp(at, *stroke)
        trial = top * np.linspace(0.7, 1.6, 901)
        far = [np.median(np.abs(np.interp(100.0 * speeds / r, of, curve) - strokes)) for r in trial]
        k = int(np.argmin(far))
        if far[k] < 2.0 and 0 < k < len(trial) - 1:
            best, why = float(trial[k]), f"the stroke follows the schedule best with {trial[k]:,.0f} rpm"
    for digits in (2, 3):
        rounded = float(f"{best:.{digits - 1}e}")
        if abs(rounded / best - 1.0) < 0.01:
            return rounded, why
    return float(round(best)), why
