"""Whether a curve that was learned on the vane chain is the effect that was hidden: by what both do to the output of
the stage, not by how they are called.

A valve's dead band is a curve of its current, and as well a gain of the flow that is one of the current: in that stage
the equations are the same. So the hidden effect is put into the product's own stage at its true size, on the log's
inputs and without noise. Of the curves at the learned place, one comes nearest to what the stage then gives. Where it
gives the same, it is what should have been learned there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from plant.curve import PLACES
from plant.effects import EFFECTS
from vaneloop.base.curve import splines
from vaneloop.identification.candidates.spline_basis import basis_of
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.subsystem import Array, Stage
from vaneloop.identification.unmodelled.curve_candidates import Candidate
from vaneloop.identification.unmodelled.learned_law import LearnedLaw
from vaneloop.identification.unmodelled.regressors import Quantity
from vaneloop.identification.user_models.exogenous_regressors import is_memory
from vaneloop.identification.user_models.terms import COLUMN
from vaneloop.identification.vane_chain.candidates import remade
from vaneloop.identification.vane_chain.chain import Chain
from vaneloop.identification.vane_chain.parameters import ALL_PLACES
from vaneloop.identification.vane_chain.subsystem_data import Made

__all__ = ["as_a_curve", "like_it", "with_effect"]

SAME = 0.02  # of what an effect moves, RMS: no equation is known better, so two that differ by less are one
FINE = 40  # splines of the curve that imitates the effect
LOOSE = 30.0  # standard deviations of its bends, in its usual size: nothing keeps it from the truth


def with_effect(stage: Stage, name: str, sizes: Mapping[str, float]) -> tuple[Array, Array]:
    """A stage's own parameters as they suit the log when an effect of these sizes (the library's names and units) is in
    it, and what the stage then gives without noise.
    """
    assert stage.floor is not None
    true = remade(stage, (name,), ())
    theta = true.neutral()
    for k, p in enumerate(true.effects[0].parameters):
        theta[true.index()[name].start + k] = sizes.get(p.name, p.value)
    theta = LeastSquaresProblem(true, stage.floor).fit((), theta).theta
    return theta[: len(stage.parameters)], true.run(theta[None])[0]


def like_it(
    stage: Stage, law: tuple[str, str, str], size: float, own: Array, aim: Array
) -> tuple[Candidate, Array, float] | None:
    """The curve of a law (how, at, of) that comes nearest to what a stage gives with an effect: candidate, amplitudes,
    and the share of what the effect moves that it leaves, RMS. None: there is none, or the law remembers.

    What a constant at that place does is not counted: it would be the same of any quantity.

    size      of such a curve
    own, aim  the stage's own parameters, and what it gives with the effect
    """
    assert isinstance(stage.made, Made) and stage.floor is not None
    how, at, of = law
    values = None if is_memory(of) else stage.made.driven.quantity(of)
    rows = np.isfinite(stage.measured).any(axis=0)
    basis = None if values is None else basis_of(values[rows], FINE)
    if values is None or basis is None:
        return None
    place = next(i for i, p in enumerate(ALL_PLACES) if (p.at, p.how) == (at, how))
    c = Candidate(of, how, place, at, "", size, True, Quantity(of, "", COLUMN, values[rows]), basis)
    told = np.where(np.isfinite(stage.measured), aim, np.nan)
    left, fitted = [], np.zeros(0)
    for one in (replace(c, untold=tuple(range(1, len(c.kept)))), c):  # its mean alone, and all of it
        curved = replace(remade(stage, (), ((one.placed(), one.effect(LOOSE)),)), measured=told)
        judge = LeastSquaresProblem(curved, stage.floor)
        judge.spared = set(range(len(own)))
        fit = judge.fit((of,), np.concatenate([own, np.zeros(len(one.kept))]), 20)
        left.append(float(np.sum(judge.errors(fit.theta[None]) ** 2)))
        fitted = fit.theta[len(own) :]
    return c, fitted, float(np.sqrt(left[1] / max(left[0], 1e-300)))


def as_a_curve(
    chain: Chain, law: LearnedLaw, name: str, sizes: Mapping[str, float], named: bool = False
) -> Array | None:
    """What should have been learned at the place and of the quantity of ``law``, at ``law.x``, where the effect of
    these sizes is hidden; None where no curve there is the effect.

    named  the effect is a curve there by its equation: the nearest one is it, as far as the log's rows show it
    """
    shown = [n for n in PLACES[f"{law.at} {law.how}"].stages if n in EFFECTS[name].stages]
    stage = next((s for n in shown for s in chain.stages if s.name == n), None)
    if stage is None:
        return None
    size = max(float(np.max(np.abs(law.y))), 1e-300)
    near = like_it(stage, (law.how, law.at, law.of), size, *with_effect(stage, name, sizes))
    if near is None or not (named or near[2] <= SAME):
        return None
    c, amplitudes, _ = near
    return np.asarray(splines(c.basis.knots, law.x) @ (c.turn @ amplitudes))
