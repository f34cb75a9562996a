"""What is wrong with a log, in one line."""

from __future__ import annotations

from vaneloop.base.errors import InputError

__all__ = ["LogError"]


class LogError(InputError):
    """A log cannot be used. One line: file, channel, reason."""

    def __init__(self, text: str):
        # names and cells of a damaged file end up in messages: keep them on one printable line
        line = "".join(c if c.isprintable() else " " for c in text)
        super().__init__(" ".join(line.split())[:1000])
