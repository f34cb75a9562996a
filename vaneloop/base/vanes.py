"""The vane stages' names, and what a table with one entry a stage has in common with every other.

A machine has one to `MOST` stages, all driven by one stroke: `vigv`, then `vgv1`, `vgv2`, ... without a gap. Arrays
that the compiled code works on have room for all of them; what a machine has comes first (docs/machines.md).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from pydantic import BaseModel, model_validator

from vaneloop.base.errors import InputError

__all__ = ["MOST", "VANES", "Staged", "own_rows", "same_stages", "vane_in", "vanes_of"]

MOST = 8  # stages: as many as three CAN frames of three angles take, less one
VANES = ("vigv", *(f"vgv{k}" for k in range(1, MOST)))  # order of the stages in every array


def vanes_of(present: Collection[str]) -> tuple[str, ...]:
    """Return the stages among ``present`` in their order; ValueError where one before another is lacking, or all."""
    own = tuple(v for v in VANES if v in present)
    lacking = next((v for v in VANES[: len(own) or 1] if v not in own), None)
    if lacking is not None:
        why = f", but {own[-1]} is there" if own else ""
        raise ValueError(f"{lacking} is missing{why}: the rows are vigv, vgv1, ... up to {VANES[-1]}, without a gap")
    return own


def same_stages(**tables: Collection[str]) -> None:
    """Refuse tables, by name, that are not of the same stages: InputError in one line."""
    (first, stages), *others = tables.items()
    for name, of in others:
        if tuple(of) != tuple(stages):
            raise InputError(f"{name}: vane rows (={', '.join(of)}) must be those of {first}, {', '.join(stages)}")


def vane_in(name: str) -> str | None:
    """Return the stage that a number is of, by its name: ``vgv1`` of ``linkage.vgv1_play``; None for the machine's."""
    return next((part for part in name.replace(".", "_").split("_") if part in VANES), None)


def own_rows(names: Sequence[str], vanes: Collection[str]) -> list[int]:
    """Return the places of those numbers that a machine with these stages has: the others are of stages it lacks."""
    return [i for i, name in enumerate(names) if vane_in(name) in (None, *vanes)]


class Staged(BaseModel):
    """A table with an entry for each stage of the machine."""

    @property
    def vanes(self) -> tuple[str, ...]:
        """The machine's stages, in order."""
        return vanes_of([v for v in VANES if getattr(self, v, None) is not None])

    @model_validator(mode="after")
    def _without_a_gap(self) -> Staged:
        _ = self.vanes  # raises
        return self
