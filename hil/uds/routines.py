"""Routines of the service tool: they ask the firmware for strokes as the ECU would, and judge what comes of it.

While a routine runs, the ECU's frames keep coming; the speeds in them, and the request to run, are replaced. So the
firmware's limits and monitors hold as ever, and whoever ends the routine has the ECU's frames again with the next one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from controller.records import STANDBY
from hil.bus.frames import with_demand
from hil.loop.node import Node

__all__ = ["CLEAR_LEARNED", "LVDT", "SWEEP", "Sweep", "clear_learned", "singles"]

SWEEP, LVDT, CLEAR_LEARNED = 0x0201, 0x0202, 0x0203
LOW, HIGH, RATE = 45.0, 104.0, 12.0  # %, %/s: demands of the sweep, over nearly the whole stroke
HOLD = 1500  # ticks at each end
RAMP = round((HIGH - LOW) / RATE * 1000)  # ticks of the way between them
RUNNING, DONE, ABORTED = 1, 0, 2
_LEARNED = ("offset", "width", "proved_offset", "proved_width", "learned_up", "learned_down", "trusted")


def singles(*values: float) -> bytes:
    """Numbers in single precision, big-endian; what is beyond it is infinite."""
    with np.errstate(over="ignore"):
        return np.array(values, np.float64).astype(">f4").tobytes()


@dataclass
class Sweep:
    """The stroke from one end to the other and back; measured at both ends.

    state  RUNNING, DONE or ABORTED (a fault, or ended by the tool)
    low, high  m, strokes held at the ends: measured by the LVDT, and by the stem potentiometer of the VIGV
    worst  m, largest difference between the servo's reference and the stroke
    """

    node: Node
    begin: int
    state: int = RUNNING
    low: tuple[float, float] = (0.0, 0.0)
    high: tuple[float, float] = (0.0, 0.0)
    worst: float = 0.0
    _held: list[tuple[float, float]] = field(default_factory=list)

    def demand(self, k: int) -> float:
        """Speed to ask for at tick ``k``, %."""
        at = k - self.begin
        if at < HOLD:
            return LOW
        if at < HOLD + RAMP:
            return LOW + RATE * (at - HOLD) * 1e-3
        if at < 2 * HOLD + RAMP:
            return HIGH
        return max(HIGH - RATE * (at - 2 * HOLD - RAMP) * 1e-3, LOW)

    @property
    def length(self) -> int:
        """Ticks that it takes."""
        return 3 * HOLD + 2 * RAMP

    def replace(self, k: int, rows: np.ndarray) -> np.ndarray:
        """Return frames with the routine's demand in the ECU's good ones."""
        speed = self.demand(k)
        return with_demand(rows, lambda n_dem, n_r, request: (speed, speed, 1) if request <= 1 else None)

    def look(self, k: int) -> None:
        """Take note of tick ``k``, which has been run."""
        loop = self.node.loop
        at = k - self.begin
        if self.node.faults:
            self.state = ABORTED
            return
        if at > HOLD // 2:
            self.worst = max(self.worst, abs(float(loop.state.x_servo - loop.state.x_meas)))
        angle, table = float(loop.angles[0]), loop.calibration.angles
        if HOLD - 200 < at % (HOLD + RAMP) <= HOLD:
            self._held.append((float(loop.fed.x_lvdt), float(np.interp(angle, table[1], table[0]))))
        elif self._held:
            mean = tuple(float(v) for v in np.mean(self._held, axis=0))
            self.low, self.high = (mean, self.high) if at <= HOLD + 1 else (self.low, mean)  # type: ignore[assignment]
            self._held = []
        if at >= self.length:
            self.state = DONE

    def result(self, routine: int) -> bytes:
        """What the tool is told: the state, then numbers of single precision, big-endian, mm.

        Of the sweep: lowest and highest stroke, largest error of the servo. Of the two-point calibration: the LVDT's
        gain (-) and offset (mm) against the stem potentiometer through the table of angles. What was not measured is 0.
        """
        if routine == SWEEP:
            return bytes([self.state]) + singles(self.low[0] * 1e3, self.high[0] * 1e3, self.worst * 1e3)
        span = self.high[1] - self.low[1]
        if self.high == (0.0, 0.0) or abs(span) <= 1e-3:  # an end was not reached
            return bytes([self.state]) + bytes(8)
        gain = (self.high[0] - self.low[0]) / span
        return bytes([self.state]) + singles(gain, (self.low[0] - gain * self.low[1]) * 1e3)


def clear_learned(node: Node) -> bool:
    """Forget what the strategy adaptive has learned; False where the loop is closed, or the controller is foreign."""
    loop = node.loop
    if int(loop.given.mode) != STANDBY or loop.foreign:
        return False
    for name in _LEARNED:
        getattr(loop.state, name)[:] = 0.0
    loop.state.offset_in_use = loop.state.width_in_use = 0.0
    return True
