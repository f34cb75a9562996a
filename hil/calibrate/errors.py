"""XCP's errors: the codes of negative answers, and the exception that carries one."""

from __future__ import annotations

__all__ = ["WORDS", "Refusal"]

SYNCH, BUSY, ACTIVE, UNKNOWN, SYNTAX, RANGE = 0x00, 0x10, 0x11, 0x20, 0x21, 0x22
PROTECTED, DENIED, LOCKED, NO_PAGE, MODE, SEGMENT, SEQUENCE, CONFIG = 0x23, 0x24, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2A
FULL, VERIFY = 0x30, 0x32
WORDS = {
    BUSY: "busy", RANGE: "out of range", PROTECTED: "write protected", DENIED: "access denied", LOCKED: "locked",
    NO_PAGE: "no such page", MODE: "not in this mode", SEQUENCE: "out of order", VERIFY: "no whole set of tables",
}  # fmt: skip


class Refusal(Exception):
    """A request that changes nothing: XCP's error code, and why."""

    def __init__(self, code: int, why: str):
        super().__init__(why)
        self.code = code
