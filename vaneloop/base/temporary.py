"""A folder for temporary files that only this user may enter, and that goes with its process."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from pathlib import Path

__all__ = ["own_folder"]


def own_folder(prefix: str) -> Path:
    """Make one; nobody can have made it before, as its name is drawn."""
    place = tempfile.mkdtemp(prefix=prefix)
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    return Path(place)
