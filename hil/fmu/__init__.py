"""Functional Mock-up Units: plant and controller for other simulators, and others' plants here."""

from hil.fmu.export import is_made, write_fmu

__all__ = ["is_made", "write_fmu"]
