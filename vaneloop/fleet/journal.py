"""What each worker did: one file a worker, a line each, never changed. A line torn by a kill is left out."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

__all__ = ["Journal", "lines"]


class Journal:
    """The journal of one worker."""

    def __init__(self, run: Path, worker: str):
        """Open it for appending."""
        (run / "journal").mkdir(parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW
        self.file = os.open(run / "journal" / f"{worker}.jsonl", flags, 0o644)

    def note(self, what: str, **more: Any) -> None:
        """Append a line, on the disk before this returns."""
        text = json.dumps({"at": round(time.time(), 3), "what": what, **more}, sort_keys=True)
        os.write(self.file, f"{text}\n".encode())
        os.fsync(self.file)

    def close(self) -> None:
        """Close the file."""
        os.close(self.file)


def lines(run: Path) -> Iterator[dict[str, Any]]:
    """Every line of every journal, with its ``worker``."""
    for file in sorted((run / "journal").glob("*.jsonl")):
        with open(file, encoding="utf-8", errors="replace") as f:
            for text in f:
                with suppress(ValueError):
                    yield {**json.loads(text), "worker": file.stem}
