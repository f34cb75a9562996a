"""The words and figures in which an answer is told: terminal, pages and workbench take them from here."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from vaneloop.identification.regimes import Located, agrees
from vaneloop.identification.results import Found, StageDiagnosis
from vaneloop.identification.workflow import Diagnosis
from vaneloop.pages.style import Tone, capital, interval

__all__ = [
    "CANNOT", "EXPLAINED", "FAILS", "FITS", "MISSING", "UNKNOWN", "WORDS", "Worth", "doubt", "extended_sentence",
    "fall", "falling", "floors", "jumps", "reached", "sized", "sizes", "stage_tone", "together", "untold",
    "verdict_word", "word", "word_of_located", "worths",
]  # fmt: skip

# The words of all verdicts (docs/reading_an_answer.md has them as a table).
FITS = "fits"  # no error beyond the noise
FAILS = "fails"  # an error beyond the noise, of which nobody has asked what it is yet
MISSING = "missing"  # an effect of the library would explain the error
UNKNOWN = "unknown"  # the error is there, and nothing in the library explains it
EXPLAINED = "explained"  # effects were added, and no error beyond the noise is left
CANNOT = "cannot tell from this log"
# a subsystem's verdict as the JSON has it -> as a reader is told it
WORDS = {
    "none": FITS, "agrees": FITS, "fails": FAILS, "missing": MISSING, "unknown": UNKNOWN, "not_observed": CANNOT,
}  # fmt: skip


def floors(ratio: float) -> str:
    """An error in noise floors, for a reader."""
    return f"{ratio:.2f}" if ratio < 9.995 else f"{ratio:.3g}" if ratio < 1e5 else f"{ratio:.1e}"


def untold(not_observed: Iterable[str]) -> str:
    """What the log says nothing about, as a sentence to follow the answer; "": it tells of every stage."""
    names = list(not_observed)
    return f" {capital(CANNOT)}: {', '.join(names)}." if names else ""


def jumps(window: float | None) -> str:
    """Why the curve of a stage's model jumps, as a sentence to follow; "": it does not. ``window`` s, of the stage."""
    return f" It integrates, so its model starts anew every {window:g} s: there its curve may jump." if window else ""


def reached(s: StageDiagnosis) -> bool:
    """Whether every output of a stage stands at its noise floor with the best model."""
    return all(agrees(e, f) for e, f in zip(s.error_after, s.floor, strict=True))


def verdict_word(verdict: str) -> str:
    """A verdict as the JSON has it, as a reader is told it."""
    return WORDS.get(verdict, verdict)


def word(s: StageDiagnosis, extended: bool = False) -> str:
    """What a stage says, in one word; ``extended``: the effects have been added."""
    if s.verdict == "none":
        return FITS
    if extended and s.effects:
        return EXPLAINED if reached(s) else MISSING
    return MISSING if s.verdict == "missing" else UNKNOWN


def word_of_located(located: Located) -> str:
    """Whether a stage with nothing added fits or fails."""
    return FAILS if located.fails else FITS


def stage_tone(s: StageDiagnosis, extended: bool = False) -> Tone:
    """Whether that is good news."""
    return {FITS: "good", EXPLAINED: "good", MISSING: "bad" if extended else "neutral"}.get(word(s, extended), "bad")


def fall(s: StageDiagnosis) -> tuple[int, str, str]:
    """The output that fails most, and the stage's error in noise floors before and after, of all outputs together: the
    steps of `falling` begin and end there.
    """
    k = int(np.argmax(s.error_before / s.floor))
    return k, floors(s.steps[0][1] if s.steps else s.excess), floors(s.excess)


def together(s: StageDiagnosis) -> str:
    """Whose error `fall` tells: the stage's only output, or all of them."""
    return s.outputs[0] if len(s.outputs) == 1 else f"the {len(s.outputs)} signals of {s.stage} together"


def sized(name: str, p: Mapping[str, object]) -> str:
    """A parameter of an effect with its interval and unit."""
    value, low, high = interval(p["value"], p["low"], p["high"])
    return f"{name} {value} [{low}, {high}] {p['unit']}"


def sizes(f: Found) -> str:
    """All parameters of an effect."""
    return ", ".join(sized(name, p) for name, p in f.parameters.items())


def since(s: StageDiagnosis) -> str:
    """From when on a stage's effects act, with its interval; "": all along."""
    if s.onset is None:
        return ""
    value, low, high = interval(s.onset.value, s.onset.low, s.onset.high)
    return f"from {value} s on [{low}, {high}]"


def added(s: StageDiagnosis) -> str:
    """The effects of a stage's model, and from when on they act."""
    return f"{' and '.join(f.effect for f in s.effects) or 'the nominal model'} {since(s)}".rstrip()


def doubt(f: Found) -> str:
    """What this log cannot tell about an effect; "": nothing."""
    out = []
    if f.rivals:
        out.append(f"this log cannot distinguish it from {' or '.join(f.rivals)}")
    if f.inseparable:
        out.append(f"this log cannot distinguish its cause from {' or '.join(f.inseparable)}")
    return "; ".join(out)


def extended_sentence(d: Diagnosis, refused: str = "") -> str:
    """What an extended model says, in one sentence."""
    if refused:
        return f"The model is no better with it: {refused}."
    parts = []
    for s in d.stages:
        _, before, after = fall(s)
        end = EXPLAINED if reached(s) else "an error remains"
        parts.append(f"with {added(s)} the error of {together(s)} falls from {before} to {after} noise floors: {end}")
    text = "; ".join(parts) or "nothing was extended"
    return f"{capital(text)}."


@dataclass(frozen=True)
class Worth:
    """What an effect is worth in the final model.

    without  error of the stage without it, all others fitted anew, in noise floors
    share    of the way, in decades, from the final error to the nominal one: 0 to 1
    """

    effect: str
    without: float
    share: float


def worths(s: StageDiagnosis) -> list[Worth]:
    """Worth of every effect of the final model, the greatest first."""
    nominal = s.steps[0][1] if s.steps else 1.0
    way = math.log(max(nominal / max(s.excess, 1e-300), 1.0 + 1e-9))
    out = [
        Worth(f.effect, f.fall * s.excess, min(1.0, max(0.0, math.log(max(f.fall, 1e-300))) / way)) for f in s.effects
    ]
    return sorted(out, key=lambda w: -w.without)


def falling(s: StageDiagnosis) -> list[tuple[str, float]]:
    """Steps in which the error falls, each named by what it adds to the one before, down to the noise floor."""
    out: list[tuple[str, float]] = []
    before: set[str] = set()
    for name, level in s.steps:
        if name in ("nominal", "model", "without numerical error"):
            if name != "without numerical error" or floors(level) != floors(out[-1][1]):  # else it is no step
                out.append((name, level))
            continue
        now = [e for e in name.split(" + ") if e] if not name.startswith("+ ") else [*before, name[2:]]
        new, gone = [e for e in now if e not in before], sorted(before - set(now))
        out.append((" ".join([*(f"+ {e}" for e in new), *(f"− {e}" for e in gone)]) or name, level))
        before = set(now)
    return [*out, ("noise floor", 1.0)]
