"""Files that are there whole or not at all, whatever is killed and however full the disk is."""

from __future__ import annotations

import hashlib
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vaneloop.base.errors import InputError
from vaneloop.base.files import replacing

__all__ = ["create", "digest_of", "passed", "read_json", "whole", "whole_json"]

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


def read_json(path: Path) -> Any:
    """Read a JSON file of the run. Raises InputError where it is damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        raise InputError(f"{path}: is no JSON; the run folder is damaged") from None


def digest_of(path: str | Path) -> str:
    """SHA-256 of a file's content. Raises OSError."""
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()
