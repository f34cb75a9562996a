"""Seed and key, as XCP and UDS have them: seeds that nobody can foresee, and a pause after wrong keys."""

from __future__ import annotations

import hashlib
import hmac
import secrets
import struct

__all__ = ["ATTEMPTS", "DELAY", "Lock"]

ATTEMPTS, DELAY = 3, 10_000  # wrong keys, and the ticks for which there is then no seed


class Lock:
    """The lock of one service.

    service  its name: each service has seeds of its own
    size     bytes of a seed
    number   of 64 bits, signed; all seeds follow from it, by HMAC-SHA-256. None: from the system's entropy. A run with
             the same number has the same seeds, which is how a record is repeated
    wrong    wrong keys since the last right one or the last pause; `ATTEMPTS`: the pause lasts
    """

    def __init__(self, service: str, size: int, number: int | None = None, wrong: int = 0):
        self.number = secrets.randbits(64) - (1 << 63) if number is None else number
        self.wrong = min(wrong, ATTEMPTS)
        self._service, self._size = service, size
        self._given = 0
        self._until = DELAY

    def seed(self) -> bytes:
        """The next seed."""
        self._given += 1
        of = f"{self._service} {self._given}".encode()
        return hmac.new(struct.pack("<q", self.number), of, hashlib.sha256).digest()[: self._size]

    def pauses(self, k: int) -> bool:
        """Whether there is no seed at tick ``k``: too many keys were wrong."""
        if self.wrong >= ATTEMPTS and k >= self._until:
            self.wrong = 0
        return self.wrong >= ATTEMPTS

    def fits(self, k: int, key: bytes, right: bytes) -> bool:
        """Whether a key that came before tick ``k`` is the right one; a wrong one is counted."""
        if hmac.compare_digest(key, right):
            self.wrong = 0
            return True
        self.wrong += 1
        if self.wrong >= ATTEMPTS:
            self._until = k + DELAY
        return False
