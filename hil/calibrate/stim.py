"""Inputs of the firmware that a tool gives instead of the ECU and the stem potentiometers (STIM).

Speeds and the request to run go into the ECU's good frames, potentiometers into what the sensors give; so the
firmware's monitors judge them as ever. What is not given again within 100 ms ends, and the loop has its own inputs.
"""

from __future__ import annotations

import math

import numpy as np

from controller.records import INPUTS
from hil.bus.frames import with_demand
from hil.loop.node import Node

__all__ = ["Stimulus"]

LASTS = 100  # ticks
_ECU = tuple(INPUTS.index(name) for name in ("n_dem", "n_r", "mode_request"))
_POTS = INPUTS.index("vigv")


class Stimulus:
    """The inputs given for one node: number of the input -> value."""

    def __init__(self, node: Node):
        self.node = node
        self.given: dict[int, float] = {}
        self._until = 0
        self._pots = node.loop.pots.copy()

    def allowed(self, number: int) -> bool:
        """Whether this input can be given: the LVDT and the supervisor's words cannot."""
        return number in _ECU or _POTS <= number < _POTS + len(self.node.loop.angles)

    def give(self, k: int, values: dict[int, float]) -> None:
        """Give inputs, finite ones, from tick ``k`` on."""
        self.given |= {i: v for i, v in values.items() if math.isfinite(v)}
        self._until = k + LASTS
        pots = self.node.loop.pots
        for i, v in self.given.items():
            if i >= _POTS and i not in _ECU:
                pots[:, 2 * (i - _POTS)], pots[:, 2 * (i - _POTS) + 1] = 0.0, v

    def clear(self) -> None:
        """Leave the loop its own inputs."""
        if self.given:
            self.given = {}
            self.node.loop.pots[:] = self._pots

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
        return n_dem, n_r, int(min(max(request, 0.0), 3.0))
