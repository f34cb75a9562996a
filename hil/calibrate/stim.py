"""Inputs of the firmware that a tool gives instead of the ECU, the LVDT and the stem potentiometers (STIM).

Speeds and the request to run go into the ECU's good frames, stroke and potentiometers into what the sensors give. So
the firmware's monitors judge them as ever. What is not given again within 100 ms ends, and the loop has its own inputs.
"""

from __future__ import annotations

import math

import numpy as np

from controller.records import INPUTS
from hil.bus.frames import with_demand
from hil.calibrate.errors import PROTECTED, RANGE, Refusal
from hil.calibrate.memory import INPUTS as AREA
from hil.calibrate.memory import SHORT
from hil.loop.node import Node

__all__ = ["Stimulus"]

LASTS = 100  # ticks
_ECU = tuple(INPUTS.index(name) for name in ("n_dem", "n_r", "mode_request"))
_LVDT, _POTS = INPUTS.index("x_lvdt"), INPUTS.index("vigv")


class Stimulus:
    """The inputs given for one node: number of the input -> value."""

    def __init__(self, node: Node):
        self.node = node
        self.given: dict[int, float] = {}
        self._until = 0
        self._pots = node.loop.pots.copy()

    def number(self, size: int, ext: int, address: int) -> int:
        """Return which input stands there.

        Raises `Refusal` where that is not one whole input in single precision, and for one that cannot be given: what
        the judge of the frames and the supervisor say, by which monitors judge.
        """
        number, rest = divmod(address - AREA, 4)
        if (size, ext, rest) != (4, SHORT, 0) or not 0 <= number < len(INPUTS):
            raise Refusal(RANGE, f"{size} bytes at {address:#x} (extension {ext}) must be one input, 4 bytes")
        if number not in (*_ECU, _LVDT) and not _POTS <= number < _POTS + len(self.node.loop.angles):
            raise Refusal(PROTECTED, f"{INPUTS[number]} cannot be given")
        return number

    def give(self, k: int, values: dict[int, float]) -> None:
        """Give inputs, finite ones, from tick ``k`` on."""
        self.given |= {i: v for i, v in values.items() if math.isfinite(v)}
        self._until = k + LASTS
        pots, lvdt = self.node.loop.pots, self.node.loop.lvdt
        for i, v in self.given.items():
            if i == _LVDT:
                lvdt[0] = v
            elif i not in _ECU:
                pots[:, 2 * (i - _POTS)], pots[:, 2 * (i - _POTS) + 1] = 0.0, v

    def clear(self) -> None:
        """Leave the loop its own inputs."""
        if self.given:
            self.given = {}
            self.node.loop.pots[:] = self._pots
            self.node.loop.lvdt[:] = math.nan

    def change(self, k: int, rows: np.ndarray, n: int) -> tuple[np.ndarray, int]:
        """Return the frames of tick ``k`` with the given speeds in the ECU's good ones."""
        if k >= self._until:
            self.clear()
        if not any(i in self.given for i in _ECU):
            return rows, n
        return with_demand(rows[:n], self._given_for), n

    def _given_for(self, *own: float) -> tuple[float, float, int]:
        """The demand that the ECU's ``own`` becomes: n_dem, n_r, mode_request."""
        n_dem, n_r, request = (self.given.get(i, float(v)) for i, v in zip(_ECU, own, strict=True))
        return n_dem, n_r, min(max(int(request), 0), 3)
