"""What a receiver had: a value that came in a frame holds from that frame on, until the next one.

Of a signal that was sampled or resampled, any sample is as good as the next: the nearest one, or a line between two.
A command in frames is another thing. Until its frame came, the controller worked with the frame before. What the
controller itself measures and sends is stamped a little after its tick and belongs to that tick::

    ECU      n_dem, n_r    |1             |2             |3
    VGV      x_dem, ...        |a             |b             |c        a is the answer to 1, b to 2, c to 3
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hil.logs.source import Channel
from vaneloop.base.vanes import VANES

__all__ = ["ANSWERS", "COMMANDS", "FEW", "answers", "held", "phase_of_ticks", "taken", "time_on_wire"]

COMMANDS = ("n_dem", "n_r")  # what the ECU sends to the controller
ANSWERS = ("x_dem", "x_lvdt", "i_cmd", *VANES)  # what the controller sends in each of its ticks of 10 ms
SAME = 1e-6  # s; stamps count in microseconds
FEW = 10  # samples, with which no raster can be told: a constant that may begin and end anywhere
# s that a frame takes: 47 bits at 1 Mbit/s are the fastest, 165 at 250 kbit/s (29-bit identifier) the slowest
QUICKEST, SLOWEST = 40e-6, 0.7e-3
BURSTS = 0.1  # share of distances between frames that are those of frames back to back, where there are any
STUFFED = 1.25  # stuff bits make a frame longer by less than a quarter
COARSE = 1e-4  # s, in which a PEAK trace of version 1 counts


def held(c: Channel, t: np.ndarray) -> np.ndarray:
    """Row of the last sample at or before each ``t`` (s), int64 as ``t``; before the first sample, the first."""
    return np.maximum(np.searchsorted(c.t, t + SAME, side="right") - 1, 0)


def answers(channels: Mapping[str, Channel]) -> Channel | None:
    """Return the channel at whose samples the controller answers commands that came in frames; None: the log has no
    such commands, or no answers.
    """
    if not any(name in channels and channels[name].framed for name in COMMANDS):
        return None
    return next((channels[n] for n in ANSWERS if n in channels and len(channels[n].t) > FEW), None)


def taken(channels: Mapping[str, Channel], when: np.ndarray, within: float) -> np.ndarray:
    """Time (s) up to which a command's frame must have come, to be in what the controller sent at each ``when`` (s).

    That is the stamp of the answer nearest to ``when``, less the time for which it was on the wire; ``when`` itself
    where there is no answer ``within`` that time (s).
    """
    answer = answers(channels)
    if answer is None:
        return when
    i = np.clip(np.searchsorted(answer.t, when), 1, len(answer.t) - 1)
    i -= when - answer.t[i - 1] < answer.t[i] - when
    near = np.abs(answer.t[i] - when) <= within
    return np.where(near, answer.t[i] - (time_on_wire(channels) if answer.framed else 0.0), when)


def time_on_wire(channels: Mapping[str, Channel]) -> float:
    """Time (s) that no frame on the log's bus exceeds; 0 where the stamps are not those of a wire.

    A node fills a frame before it sends it, and a logger stamps it at its last bit. So a command whose frame ended just
    before an answer began is not in that answer. How long a frame takes, frames back to back say: many are, because a
    node sends those of one tick together. On a virtual bus, and in a record by ticks, they are microseconds apart.
    """
    framed = [c.t for c in channels.values() if c.framed]
    stamps = np.unique(np.concatenate(framed)) if framed else np.empty(0)
    apart = np.diff(stamps)
    bursts = apart[apart < SLOWEST]
    if not bursts.size or bursts.size < BURSTS * apart.size:
        return 0.0
    frame = float(np.mean(bursts))
    rounded = COARSE if np.allclose(stamps / COARSE, np.rint(stamps / COARSE), 0.0, 0.01) else 0.0
    return STUFFED * frame + rounded if frame > QUICKEST else 0.0


def phase_of_ticks(channels: Mapping[str, Channel], period: float) -> float:
    """Time (s, from 0 to below ``period``) at which the controller's ticks stand in the log: that of its answers; 0
    where commands did not come in frames, or where the answers come in no such period.
    """
    answer = answers(channels)
    if answer is None:
        return 0.0
    turn = np.exp(2j * np.pi * answer.t / period).mean()
    if abs(turn) < 0.5:
        return 0.0
    return round(float(np.angle(turn)) / (2.0 * np.pi) * period, 4) % period
