"""Files that are there whole or not at all, whatever is killed and however full the disk is."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import signal
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vaneloop.base.errors import InputError
from vaneloop.base.files import replacing

__all__ = [
    "create", "digest_of", "passed", "plain_bytes", "plain_file", "read_json", "reason_of", "whole", "whole_json",
]  # fmt: skip

MOST_BYTES = 64 << 20  # of a JSON file of a run; the answer to a log has some 100 kB
MOST_DEEP = 64  # tables and lists of JSON within each other; an answer has 6

KILL = (
    "VANELOOP_FLEET_KILL"  # POINT:N, for tests: the process ends as by kill -9 when it passes a point for the Nth time
)
FULL = "VANELOOP_FLEET_FULL"  # N, for tests: from the Nth file on, the disk is full
_seen: dict[str, int] = {}


def passed(point: str) -> None:
    """Note that the process is at a point where a kill would matter; a test may have it end here."""
    where, _, which = os.environ.get(KILL, "").partition(":")
    if where == point:
        _seen[point] = _seen.get(point, 0) + 1
        if _seen[point] == int(which or 1):
            os.kill(os.getpid(), signal.SIGKILL)


def whole(path: Path, write: Callable[[Path], object], only_new: bool = False) -> None:
    """Have ``write`` fill a temporary file, which then takes the place of ``path`` (`vaneloop.base.files`)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, only_new) as temporary:
        _seen[FULL] = _seen.get(FULL, 0) + 1
        if _seen[FULL] >= int(os.environ.get(FULL, "0") or 0) > 0:
            raise OSError(28, "No space left on device")
        write(temporary)
        passed("written")


def create(path: Path, write: Callable[[Path], object]) -> bool:
    """As `whole`, but only where there is no such file; return whether this process made it, of several that try."""
    try:
        whole(path, write, only_new=True)
    except FileExistsError:
        return False
    return True


def whole_json(path: Path, data: Any) -> None:
    """Write JSON as a whole file."""
    whole(path, lambda f: f.write_text(json.dumps(data, sort_keys=True), encoding="utf-8"))


def plain_file(path: str | Path, links: bool = False) -> int:
    """Open a plain file for reading, and return its number. A link is followed with ``links`` only, a pipe not waited
    for.

    Raises OSError, whose ``strerror`` says what the thing is, where it is no plain file.
    """
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if links else os.O_NOFOLLOW))
    except OSError as e:
        if not links and os.path.islink(path):
            raise OSError(e.errno, "it is a link", str(path)) from None
        raise
    if stat.S_ISREG(os.fstat(number).st_mode):
        return number
    os.close(number)
    raise OSError(errno.EINVAL, "it is no plain file", str(path))


def plain_bytes(path: str | Path, most: int = MOST_BYTES) -> bytes:
    """The content of a plain file of a run. Raises OSError, also where it is longer than ``most`` bytes."""
    with open(plain_file(path), "rb") as f:
        if os.fstat(f.fileno()).st_size > most:
            raise OSError(errno.EFBIG, f"it is longer than {most:,} bytes", str(path))
        return f.read(most)


def read_json(path: Path, most: int = MOST_BYTES) -> Any:
    """Read a JSON file of the run. Raises FileNotFoundError, and InputError where it is damaged."""
    try:
        return _sane(json.loads(plain_bytes(path, most).decode("utf-8")))
    except FileNotFoundError:
        raise
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({reason_of(e)})") from None
    except (ValueError, RecursionError):  # also a number of thousands of digits, or thousands of brackets
        raise InputError(f"{path}: is no JSON; the run folder is damaged") from None


def _sane(data: Any) -> Any:
    """JSON that holds nothing at which a later step would stumble: no NaN, no infinity, no whole number beyond 64 bits,
    no half of a character, no more than `MOST_DEEP` levels. Raises ValueError for other.
    """
    level, deep = [data], 0
    while level:
        deep += 1
        inner: list[Any] = []
        for v in level:
            if isinstance(v, dict):
                inner += (*v, *v.values())
            elif isinstance(v, list):
                inner += v
            elif isinstance(v, str):
                v.encode("utf-8")
            elif isinstance(v, int | float) and not abs(v) < (2.0**63 if isinstance(v, int) else math.inf):
                raise ValueError(f"{v} is no number of a run's")
        if deep > MOST_DEEP:
            raise ValueError("too deep")
        level = inner
    return data


def reason_of(e: OSError) -> str:
    """Why a file cannot be used, in words."""
    return str(e.strerror or e)


def digest_of(path: str | Path) -> str:
    """SHA-256 of a plain file's content, or of that which a link leads to. Raises OSError."""
    with open(plain_file(path, links=True), "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()
