"""What happened when: changes of mode, faults, faults injected; in a log as in a loop that runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from controller import FAULTS, MODES
from vaneloop.web.charts import Band, Mark, bands

__all__ = ["Moment", "bit_bands", "fault_bands", "of_log", "told"]

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Moment:
    """One thing that happened. t: s; None where it was outside of the time that the curves show."""

    t: float | None
    text: str
    fault: str = ""  # the fault that was set

    @property
    def line(self) -> str:
        """As the list has it."""
        return self.text if self.t is None else f"{self.t:.2f} s  {self.text}"


def told(t: float, mode: int, faults: int, before: tuple[int, int]) -> list[Moment]:
    """What is new at ``t`` against the mode and the fault bits ``before``; a mode that is none is not told."""
    out = []
    if mode != before[0] and 0 <= mode < len(MODES):
        out.append(Moment(t, f"mode {MODES[mode]}"))
    for i, fault in enumerate(FAULTS):
        if (faults ^ before[1]) >> i & 1:
            on = bool(faults >> i & 1)
            out.append(Moment(t, f"{fault} {'set' if on else 'cleared'}", fault if on else ""))
    return out


def of_log(
    channels: Mapping[str, tuple[str, Array, Array]], faults: Mapping[str, tuple[Array, Array]], marks: Sequence[Mark]
) -> list[Moment]:
    """Moments of a log, in order: ``channels`` with the mode, ``faults`` fault -> s, 0 or 1, ``marks`` what was
    injected.
    """
    out = [Moment(m.t, f"injected: {m.text}") for m in marks]
    if "state" in channels:
        _, t, state = channels["state"]
        mode = np.where(np.isfinite(state), state, -1.0).astype(np.int64)
        for i in np.flatnonzero(np.diff(mode, prepend=-1)).tolist():
            out += told(float(t[i]), int(mode[i]), 0, (-1, 0))
    for i, fault in enumerate(FAULTS):
        t, on = faults.get(fault, (np.zeros(0), np.zeros(0)))
        bits = (on > 0.5).astype(np.int64) << i
        for k in np.flatnonzero(np.diff(bits, prepend=0)).tolist():
            out += told(float(t[k]), -1, int(bits[k]), (-1, int(bits[k]) ^ (1 << i)))
    return sorted(out, key=lambda m: m.t or 0.0)


def bit_bands(t: Array, faults: Array) -> list[Band]:
    """Stretches in which fault bits are set, each with the names of all that are."""
    there = np.unique(faults[np.isfinite(faults)]).astype(np.int64).tolist()
    names = {v: (", ".join(f for i, f in enumerate(FAULTS) if v >> i & 1), "noise") for v in there if v > 0}
    return bands(t, faults, names)


def fault_bands(faults: Mapping[str, tuple[Array, Array]]) -> list[Band]:
    """Stretches of a log in which a fault is set."""
    return [band for fault, (t, on) in faults.items() for band in bands(t, np.asarray(on > 0.5), {1: (fault, "noise")})]
