"""An XCP master as a pure machine: jobs of commands, each command sent after the answer to the one before.

It has no clock and no bus: whoever has one calls `Master.send` with the time, and `Master.hear` with what the slave
sent. Measurements and events are passed over. Commands and addresses as in docs/xcp.md.
"""

from __future__ import annotations

import struct
from collections import deque

import numpy as np

from hil.calibrate.errors import WORDS
from hil.calibrate.memory import CALIBRATION

__all__ = [
    "CONNECT", "PAGE_IN_USE", "Master", "copy_page", "numbers_of", "read_page", "save_page", "use_page", "write_number",
]  # fmt: skip

CONNECT = b"\xff\x00"
PAGE_IN_USE = b"\xea\x01\x00"  # of the firmware: the third byte behind 0xFF
PATIENCE = 2000.0  # ms that an answer may take
MOST_UPLOAD = 255  # bytes
OK, ERROR = 0xFF, 0xFE


class Master:
    """The jobs that wait, and those that are done.

    done  number of each job, with the answers (their bytes behind 0xFF), one a command; or why it ended, in words
    """

    def __init__(self) -> None:
        self.done: list[tuple[int, list[bytes] | str]] = []
        self._jobs: deque[tuple[int, list[bytes]]] = deque()
        self._answers: list[bytes] = []
        self._part = b""
        self._sent_at: float | None = None

    def ask(self, number: int, commands: list[bytes]) -> None:
        """Have commands carried out after those that wait."""
        self._jobs.append((number, commands))

    def send(self, ms: float) -> bytes | None:
        """Return the command to send now, if one is due; ``ms`` is the time."""
        if not self._jobs:
            return None
        if self._sent_at is not None:
            if ms - self._sent_at > PATIENCE:
                self._end(f"no answer within {PATIENCE * 1e-3:g} s")
            return None
        self._sent_at, self._part = ms, b""
        return self._jobs[0][1][len(self._answers)]

    def hear(self, data: bytes) -> None:
        """Take a frame of the slave."""
        if self._sent_at is None or not data or data[0] not in (OK, ERROR):
            return
        number, commands = self._jobs[0]
        command = commands[len(self._answers)]
        if data[0] == ERROR:
            code = data[1] if len(data) > 1 else 0
            self._end(f"{WORDS.get(code, 'refused')} (XCP error {code:#04x})")
            return
        self._part += data[1:]
        if command[0] == 0xF5 and len(self._part) < command[1]:  # a block of frames
            return
        self._sent_at = None
        self._answers.append(self._part)
        if len(self._answers) == len(commands):
            self._end(self._answers)

    def _end(self, result: list[bytes] | str) -> None:
        self.done.append((self._jobs.popleft()[0], result))
        self._answers, self._sent_at = [], None


def _at(number: int) -> bytes:
    """SET_MTA to a number of the calibration, in double precision."""
    return struct.pack("<BxxBI", 0xF6, 0, CALIBRATION + 8 * number)


def read_page(page: int, n: int) -> list[bytes]:
    """Commands that read the ``n`` numbers of a page; the tool sees page 0 afterwards. For `numbers_of`."""
    left = [min(MOST_UPLOAD, 8 * n - i) for i in range(0, 8 * n, MOST_UPLOAD)]
    return [bytes([0xEB, 2, 0, page]), _at(0), *(bytes([0xF5, size]) for size in left), b"\xeb\x02\x00\x00"]


def numbers_of(answers: list[bytes]) -> np.ndarray:
    """The numbers in the answers to `read_page`."""
    return np.frombuffer(b"".join(answers[2:-1]), "<f8")


def write_number(number: int, value: float) -> list[bytes]:
    """Commands that change a number of the working page, and read it."""
    raw = struct.pack("<d", value)
    return [_at(number), b"\xf0\x06" + raw[:6], b"\xf0\x02" + raw[6:], _at(number), b"\xf5\x08"]


def use_page(page: int) -> list[bytes]:
    """Commands that switch the firmware to a page."""
    return [bytes([0xEB, 1, 0, page])]


def copy_page() -> list[bytes]:
    """Commands that copy the reference page over the working page."""
    return [b"\xe4\x00\x01\x00\x00"]


def save_page() -> list[bytes]:
    """Commands that save the working page."""
    return [b"\xe6\x01\x00", b"\xf9\x01\x00\x00"]
