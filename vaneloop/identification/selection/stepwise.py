"""The search: rank, fit, accept, prune. Stepwise selection over candidates of any kind.

Effects of the library, curves and surfaces differ in how they are ranked and fitted, and in which rules accept them.
Each kind says so as a `Selection`; `stepwise` is the loop over all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

__all__ = ["Selection", "eliminate", "stepwise"]

Model = TypeVar("Model")


class Selection(Protocol[Model]):
    """How candidates of one kind are added to a model."""

    def wants_more(self, model: Model) -> bool:
        """Whether the model leaves what a further candidate may explain."""

    def finalists(self, model: Model) -> list[Model]:
        """Rank what can be added to the model, and fit what promises most: models, best first."""

    def accepted(self, model: Model, tried: Sequence[Model]) -> list[Model]:
        """Of the models tried those that the acceptance rules allow."""

    def chosen(self, model: Model, accepted: Sequence[Model]) -> Model | None:
        """The model to go on from; None: none after all."""

    def pruned(self, models: list[Model]) -> list[Model]:
        """The first model and those chosen, step by step, without what is not needed any more."""


def stepwise(selection: Selection[Model], model: Model) -> list[Model]:
    """Add candidates to a model, one step after the other, as long as the rules accept one.

    Returns the model as it was, and that of each step, pruned.
    """
    models = [model]
    while selection.wants_more(model):
        accepted = selection.accepted(model, selection.finalists(model))
        chosen = selection.chosen(model, accepted) if accepted else None
        if chosen is None:
            break
        models.append(model := chosen)
    return selection.pruned(models)


def eliminate(
    model: Model,
    without: Callable[[Model], list[Model]],
    needed: Callable[[Model, Model], bool],
    preferred: Callable[[Sequence[Model]], Model],
) -> Model:
    """Backward elimination: take out one candidate after the other that the model does not need.

    without    the models with one candidate less; empty: none can go
    needed     whether a model is accepted over one of these
    preferred  which of several models that do as well goes on
    """
    while idle := [less for less in without(model) if not needed(less, model)]:
        model = preferred(idle)
    return model
