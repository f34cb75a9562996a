"""What a scenario lets a controller hear, tick by tick, whatever engine it controls: the scenario as a stimulus.

What an action does to frames does not depend on the engine: a frame comes, late, twice, refused or not at all, and its
content is the demand, a number of the action's, or the speed that the ECU measured for some frame. So the scenario is
played on the bus (`hil.inject.on_lockstep`) in which the ECU sends marks in place of measured speeds. What arrives says
which frame's speed it is, and loops without a bus (`hil.inject.in_lanes`) take it from there.

Where loads and errors fill the wire, the length of other frames, which their content has a part in, decides when a
frame comes. Each scenario is played with several contents; one that is heard differently then has no rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from controller.records import INPUTS, SLOW
from hil.bus.frames import SPEED_STEP
from hil.inject.actions import BusOff, ErrorFrames, Outsider, Replay, Send
from hil.inject.on_lockstep import OnLockstep, demand_at
from hil.inject.scenario import COUNTS, Scenario
from hil.loop.heard_lanes import (
    H_DEMAND,
    H_FRESH,
    H_N_DEM,
    H_N_R,
    H_P_S,
    H_REJECTED,
    H_REQUEST,
    H_SOURCE,
    H_T_OIL,
    N_HEARD,
)

if TYPE_CHECKING:
    from plant import Plant

__all__ = ["Heard", "hear"]

MOST = 62_500  # greatest mark: 125 %
N_DEM, N_R, REQUEST, FRESH, REJECTED = map(
    INPUTS.index, ("n_dem", "n_r", "mode_request", "demand_fresh", "demand_rejected")
)
PLAIN, DISTURBED = 3, 9  # contents with which a scenario is played: without, and with a disturbed wire


@dataclass(frozen=True)
class Heard:
    """Rows of a scenario.

    rows   float64[ticks, N_HEARD] (`hil.loop.heard_lanes`)
    counts, late   as of `hil.inject.verdict.Trace`
    """

    rows: np.ndarray
    counts: dict[str, np.ndarray]
    late: dict[str, np.ndarray]


class _Played:
    """A scenario played with one content: what came in at each tick."""

    def __init__(self, scenario: Scenario, plant: Plant, times: int):
        """Play it; ``times``: of the marks (`_mark`), 0: speeds of 0 %."""
        ticks = round(scenario.duration * 1000.0)
        loop = OnLockstep(scenario, plant, None)
        self.inputs = np.empty((ticks, len(INPUTS)))
        self.counts = np.empty((ticks, len(COUNTS)), np.int64)
        self.late = np.zeros((ticks, len(loop.heard)), bool)
        self.supply = np.empty((ticks, 2))
        self.heard = loop.heard
        for k in range(ticks):
            loop.tick(SPEED_STEP * _mark(k // SLOW, times))
            self.inputs[k], self.supply[k] = loop.node.loop.inputs, loop.node.arrays.supply[:2]
            self.counts[k] = loop.counts()
            self.late[k] = [n in loop.missed for n in loop.heard]

    def speeds(self) -> np.ndarray:
        """The speeds that came, as the frames have them: int64."""
        return np.rint(self.inputs[:, N_R] / SPEED_STEP).astype(np.int64)

    def same(self, other: _Played) -> bool:
        """Whether all but the speeds is the same."""
        of = [FRESH, REJECTED, N_DEM, REQUEST]
        pairs = ((self.inputs[:, of], other.inputs[:, of]), (self.counts, other.counts), (self.late, other.late))
        return all(np.array_equal(a, b) for a, b in pairs)


def _mark(frame: Any, times: int) -> Any:
    """The mark of a frame (or of several): ``times`` its number from 1 on; with many times, bits that have nothing to
    do with it.
    """
    return (frame + 1) * times % (MOST + 1)


def _disturbed(scenario: Scenario) -> bool:
    """Whether something fills the wire or destroys frames on it."""
    return any(isinstance(a, BusOff | ErrorFrames) or (isinstance(a, Outsider) and not isinstance(a, Send | Replay))
               for a in scenario.inject)  # fmt: skip


def hear(scenario: Scenario, plant: Plant) -> Heard | str:
    """Play a scenario; return what is heard, or why its rows are not the same for every engine.

    plant  any machine with the vane rows that those of interest have
    """
    ticks = round(scenario.duration * 1000.0)
    if ticks // SLOW + 1 >= MOST:
        return f"longer than {MOST * SLOW // 1000} s"
    zero = _Played(scenario, plant, 0)
    others = []
    for times in (1, *(40_503 + 7_919 * q for q in range((DISTURBED if _disturbed(scenario) else PLAIN) - 2))):
        played = _Played(scenario, plant, times)
        if not zero.same(played):
            return "when frames come depends on the bits of others (arbitration)"
        others.append((times, played.speeds()))
    came, own = zero.inputs[:, FRESH] > 0.5, zero.speeds()
    source = np.where(came, own ^ others[0][1], 0) - 1
    for times, speeds in others:
        marks = np.where(source < 0, 0, _mark(source, times))
        if ((speeds ^ own) != marks)[came].any() or (own > MOST)[came & (source >= 0)].any():
            return "bits of the measured speed are mixed with others"
    rows = np.zeros((ticks, N_HEARD))
    for to, of in ((H_FRESH, FRESH), (H_REJECTED, REJECTED), (H_N_DEM, N_DEM), (H_REQUEST, REQUEST), (H_N_R, N_R)):
        rows[:, to] = zero.inputs[:, of]
    rows[:, H_SOURCE], rows[:, [H_P_S, H_T_OIL]] = source, zero.supply
    rows[:, H_DEMAND] = [demand_at(scenario, k // SLOW * SLOW) for k in range(ticks)]
    return Heard(rows, dict(zip(COUNTS, zero.counts.T, strict=True)), dict(zip(zero.heard, zero.late.T, strict=True)))
