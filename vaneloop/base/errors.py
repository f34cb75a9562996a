"""What every part of VaneLoop raises for bad input. Only the standard library, so that help is quick."""

import difflib
from collections.abc import Iterable

__all__ = ["DeviceError", "InputError", "meant"]


class InputError(ValueError):
    """Something from outside cannot be used. One line: the thing, its value, what is allowed."""


class DeviceError(InputError):
    """What was asked to run something, a GPU, cannot be used or has failed: no fault of what was to be run."""


def meant(word: str, allowed: Iterable[str]) -> str:
    """Words that ask whether another one of ``allowed`` was meant; "" where none is near."""
    fold = {a.casefold(): a for a in allowed}
    near = difflib.get_close_matches(word.casefold(), fold, 1, 0.6)
    return f" (did you mean {fold[near[0]]}?)" if near else ""
