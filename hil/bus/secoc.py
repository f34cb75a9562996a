"""Authentication of frames after AUTOSAR SecOC: who sent a frame, and that it is no old one.

A classic frame of eight bytes has no room for a MAC beside its signals. So each frame keeps its bytes, and right behind
it goes an authentication frame (AUTOSAR: authentic and cryptographic I-PDU of a secured PDU collection)::

    identifier   the frame's + 8
    bytes 0..3   the low 32 bits of the freshness value, little-endian
    bytes 4..7   the first 32 bits of the MAC

    MAC = AES-128-CMAC (RFC 4493) over DataID (16 bits) | the frame's eight bytes | freshness value (64 bits)

both numbers big-endian, as SecOC has them. DataID is that of the frame's E2E protection.

The freshness value is a time, ms since 1970, that a node counts by its own ticks. A receiver completes the 32 bits to
the value nearest to its own, and takes a frame only if this value

    differs from its own by WINDOW at most, and
    is greater than that of the last frame it took under this identifier, and than its own at its start.

So nothing recorded before a receiver's start is taken after it, and loss, silence or a restart of the sender need no
message that brings both together again: the clocks do. They have to agree within WINDOW.

Nothing here reads a clock or keeps a state of the bus: `hil.loop.secured` does.
"""

from __future__ import annotations

import hmac
import os
import re
import struct
from pathlib import Path

from hil.bus import frames
from vaneloop.base.errors import InputError
from vaneloop.base.extras import needed, needs

__all__ = ["KEY_VARIABLE", "WINDOW", "Authenticator", "completed", "read_key"]

KEY_VARIABLE = "VANELOOP_SECOC_KEY"
WINDOW = 2000  # ms; chosen: machines with NTP agree far better, and a frame held back is older after two seconds
_HEX = re.compile(r"[0-9a-fA-F]{32}")
_INPUT = struct.Struct(">H8sQ")
_LOW = 1 << 32


def read_key(source: str) -> bytes:
    """Return the 16 bytes of the key: in a file that only its owner may read, or for ``env`` in ``VANELOOP_SECOC_KEY``,
    as 32 hexadecimal digits. Raises InputError, which never shows what it found.
    """
    needs("--secoc", "cryptography", extra="secoc")
    if source == "env":
        where, text = KEY_VARIABLE, os.environ.get(KEY_VARIABLE)
        if text is None:
            raise InputError(f"--secoc env: {KEY_VARIABLE} is not set; it must hold 32 hexadecimal digits")
    elif _HEX.fullmatch(source):
        raise InputError("--secoc takes the file that holds the key, or env: others see what is on a command line")
    else:
        where, text = f"--secoc {source}", _private(Path(source))
    if not _HEX.fullmatch(text.strip()):
        raise InputError(f"{where}: must hold a key of 32 hexadecimal digits, and nothing else")
    return bytes.fromhex(text.strip())


def _private(path: Path) -> str:
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode & 0o777
            if mode & 0o077:
                raise InputError(f"--secoc {path}: others may use it (mode {mode:o}); allowed: 600 (chmod 600 {path})")
            return file.read(200).decode("ascii", errors="replace")
    except OSError as e:
        raise InputError(f"--secoc {path}: cannot be read ({e.strerror})") from None


def completed(low: int, near: int) -> int:
    """Return the freshness value with the low 32 bits ``low`` that is nearest to ``near``."""
    return near + (low - near + _LOW // 2) % _LOW - _LOW // 2


class Authenticator:
    """MACs under one key (16 bytes)."""

    def __init__(self, key: bytes):
        words = "authentication (SecOC)"
        aes = needed(words, "cryptography.hazmat.primitives.ciphers.algorithms", "secoc").AES
        self._begun = needed(words, "cryptography.hazmat.primitives.cmac", "secoc").CMAC(aes(key))

    def mac(self, ident: int, data: int, freshness: int) -> bytes:
        """Return the 16 bytes of the MAC of a frame (word 1) at a freshness value."""
        c = self._begun.copy()
        c.update(_INPUT.pack(frames.DATA_ID + ident, data.to_bytes(8, "little", signed=True), freshness))
        return bytes(c.finalize())

    def frame(self, ident: int, data: int, freshness: int) -> tuple[int, int]:
        """Return both words of the authentication frame that goes behind a frame."""
        mac = int.from_bytes(self.mac(ident, data, freshness)[:4], "little")
        return int(frames.word0(ident + frames.AUTH)), int(frames.encode_auth(freshness, mac))

    def proves(self, ident: int, data: int, freshness: int, mac: int) -> bool:
        """Whether a frame has the MAC that came, as `hil.bus.frames.decode_auth` gives it."""
        return hmac.compare_digest(self.mac(ident, data, freshness)[:4], mac.to_bytes(4, "little"))
