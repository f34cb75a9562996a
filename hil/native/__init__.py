"""A controller of the user's own in the loop: a compiled library in place of the firmware here."""

from hil.native.program import Program

__all__ = ["Program"]
