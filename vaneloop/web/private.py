"""The server's private folder: its own while it runs, gone at the end, and after a kill gone at the next start.

A folder is named ``vaneloop-web-PID-...``. Its process holds a lock (flock) on the file ``lock`` in it; the kernel
frees the lock when the process ends, however it ends, so a number that another process has got since says nothing.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

__all__ = ["private_folder", "sweep"]

PREFIX = "vaneloop-web-"
LOCK = "lock"


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """Give a folder that only this user may enter (0700); it is removed at the end. Those of processes that are gone
    are removed first.
    """
    sweep(Path(tempfile.gettempdir()))
    folder = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{os.getpid()}-"))
    held = os.open(folder / "locking", os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        (folder / "locking").rename(
            folder / LOCK
        )  # a file of this name has been locked: one that is free has lost its process
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def sweep(place: Path) -> list[Path]:
    """Remove this user's private folders in ``place`` whose process is gone; return them."""
    gone = []
    for folder in place.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):  # another start has removed it, or it is not ours to look into
            about = folder.lstat()
            if stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid() and _left(folder):
                shutil.rmtree(folder, ignore_errors=True)
                gone.append(folder)
    return gone


def _left(folder: Path) -> bool:
    """Whether the process of ``folder`` is gone."""
    try:
        lock = os.open(folder / LOCK, os.O_RDWR | os.O_NOFOLLOW)
    except FileNotFoundError:  # killed, or still at work, between making the folder and locking it
        named = re.match(rf"{PREFIX}(\d+)-", folder.name)
        return named is None or not Path(f"/proc/{named[1]}").exists()
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(lock)
    return True
