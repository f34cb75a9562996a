"""What every part of VaneLoop raises for bad input. Only the standard library, so that help is quick."""

__all__ = ["InputError"]


class InputError(ValueError):
    """Something from outside cannot be used. One line: the thing, its value, what is allowed."""
