"""Stand-ins for the diagnosis: cheap, and each log says by its text what it does to the process that reads it."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

from vaneloop.base.errors import InputError


def read(path: str, options: dict[str, Any], run: str) -> dict[str, Any]:
    """Count the letters of a log, or do what it says."""
    text = Path(path).read_text(encoding="utf-8")
    if "kill the reader" in text:
        os.kill(os.getpid(), signal.SIGSEGV)
    if "hang" in text:
        while True:
            time.sleep(3600.0)
    if "refuse" in text:
        raise InputError(f"{Path(path).name}: n_dem (=-3 %) must be in [0, 120] %")
    if "defect" in text:
        raise KeyError("level")
    if "alter" in text:
        Path(path).write_text("it has grown", encoding="utf-8")
    if "pause" in text:
        time.sleep(0.05)
    return {"verdict": "none", "answer": {"letters": len(text), "first": text[:12]}}
