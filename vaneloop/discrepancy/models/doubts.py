"""What should make a reader doubt an answer on a model of his own: parameters at their bounds, signs the wrong way."""

from __future__ import annotations

import numpy as np

from vaneloop.discrepancy import laws
from vaneloop.discrepancy.fit import Fit, Judge
from vaneloop.discrepancy.models.bound import Bound
from vaneloop.discrepancy.stage_answer import StageDiagnosis, at_bound

__all__ = ["doubts"]

PULL = 0.01  # share of the squared error that a parameter at its bound would take off beyond it: the logs ask for it
AGAINST = -0.05  # power of the measured force, in RMS force times RMS velocity: what is driven takes some
# laws that may have either sign, and what the unusual one means
BACKWARDS = {
    laws.QUADRATIC_DRAG: "drives the motion instead of braking it",
    laws.SPRING: "pushes away from the middle instead of back to it",
    laws.CUBIC_SPRING: "pushes away from the middle instead of back to it",
    laws.LEAK: "feeds the state instead of draining it",
    laws.STATE_QUADRATIC: "feeds the state instead of draining it",
    laws.STATE_SQUARE_ROOT: "feeds the state instead of draining it",
    laws.STATE_CUBIC: "feeds the state instead of draining it",
}
ROUND = "is a sign the other way round?"


def doubts(bound: Bound, judge: Judge, d: StageDiagnosis) -> list[str]:
    """Parameters and laws at their bounds, and signs that physics or convention speak against, a line each."""
    out = []
    fit = d.final
    for k, p in enumerate(bound.stage.parameters):
        value = float(fit.theta[k])
        low, high = p.limits()
        near = 1e-6 * max(abs(value), p.scale, 1e-300)
        side = -1.0 if value <= low + near else 1.0 if value >= high - near else 0.0
        if side == 0.0 or p.tolerance == 0.0 or k in judge.spared or (value == 0.0 != d.base.theta[k]):
            continue
        limit, of = (low, p.low) if side < 0.0 else (high, p.high)
        if limit == of:
            more = f": the logs would have it go beyond; {ROUND}" if _pulled(fit, judge, k, side) else ""
            out.append(f"{p.name} stands at its bound, {limit:.4g} {p.unit}{more}")
        elif _pulled(fit, judge, k, side):
            out.append(
                f"{p.name} stands at the end of its tolerance, {value:.4g} {p.unit}: the logs would have it go on"
            )
    index = bound.stage.index()
    law_of = {q.effect: q.law for q in bound.placed}
    for name in fit.effects:
        if at_bound(bound.stage, fit, name):
            out.append(f"{name} stands at the end of its physical range: the log would have it go on")
        size = float(fit.theta[index[name]][0])
        if size < 0.0 and (meaning := BACKWARDS.get(law_of[name].code)):
            unit = bound.stage.effect(name).parameters[0].unit
            out.append(f"{name} is negative ({size:.4g} {unit}): it {meaning}; {ROUND}")
    return out + _against(bound)


def _pulled(fit: Fit, judge: Judge, column: int, side: float) -> bool:
    """Whether the logs would have a parameter go on beyond the bound at which it stands."""
    where = np.flatnonzero(fit.free == column)
    if not len(where):
        return False
    k = int(where[0])
    g, a = float(fit.gradients[:, k].sum()), float(fit.normals[:, k, k].sum())
    return g * side > 0.0 and a > 0.0 and g * g / a > PULL * float(fit.cost.sum())


def _against(bound: Bound) -> list[str]:
    """A measured force that takes more power out of the motion than it puts in."""
    if bound.system.kind != "force":
        return []
    out = []
    for (log, at), u in zip(bound.logs.items(), bound.data.u, strict=True):
        force, v = bound.measured[0, at], u[1]
        use = np.isfinite(force)
        size = float(np.sqrt(np.mean(force[use] ** 2) * np.mean(v[use] ** 2))) if use.any() else 0.0
        if size > 0.0 and float(np.mean(force[use] * v[use])) < AGAINST * size:
            name = next(iter(bound.system.outputs))
            out.append(
                f"{log}: {name} acts against the motion, so that the machine gives power; friction is looked for where "
                f"a positive force drives positive motion: {ROUND}"
            )
    return out
