"""Probabilities that come true: fitted to blind answers, and judged on others.

    python -m benchmarks.trust fit effects.parquet laws.parquet        # coefficients for results.py
    python -m benchmarks.trust judge effects2.parquet laws2.parquet    # reliability, Brier score, 90 % set of names

The files are results of `benchmarks.hidden_effect` and `benchmarks.hidden_law`. Fit and judgement must not see the same
seeds.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.blind import share
from vaneloop.identification.results import terms, trust
from vaneloop.identification.settings import TRUST_COEFFICIENTS

RIDGE = 1.0  # observations that a coefficient of 0 is worth: few answers must not make a name certain
BINS = (0.0, 0.3, 0.6, 0.8, 0.9, 0.95, 1.001)
Row = dict[str, Any]


@dataclass
class Name:
    """An effect that an answer named: what its probability follows from, and which of its names was hidden."""

    criterion: str
    evidence: dict[str, float]
    probabilities: dict[str, float]
    right: frozenset[str]


def names_of(rows: list[Row]) -> list[Name]:
    """Every name of every answer of a blind benchmark."""
    out = []
    for r in rows:
        law = "amounts" in r  # a row of hidden_law
        for e in json.loads(r["answer"]).get("effects", []):
            if law:
                right = {n for n in e["probabilities"] if any(n in json.loads(r["same"])[t] for t in r["truth"])}
                if sorted(r["named"]) in json.loads(r["amounts"]):
                    right.add(e["effect"])
            else:
                right = {n for n in e["probabilities"] if n in r["truth"]}
            criterion = "error_share" if law else "noise_floor"
            out.append(Name(criterion, e["evidence"], e["probabilities"], frozenset(right)))
    return out


def fitted(names: list[Name]) -> tuple[float, ...]:
    """Coefficients of the regression of "the law that is missing is among the names" on `terms`."""
    from scipy.optimize import minimize

    x = np.array([terms(n.evidence) for n in names])
    y = np.array([bool(n.right) for n in names], dtype=float)

    def cost(b: np.ndarray) -> float:
        z = x @ b
        return float(np.sum(np.logaddexp(0.0, z) - y * z) + 0.5 * RIDGE * np.sum(b[1:] ** 2))

    # more left, or a smaller share, never speaks for a name; more fall never against it
    bounds = [(None, None), (None, 0.0), (0.0, None), (0.0, None)]
    return tuple(float(v) for v in minimize(cost, np.zeros(4), bounds=bounds).x)


def judged(names: list[Name]) -> tuple[list[list[str]], float, float, dict[str, Any]]:
    """Reliability, a row a bin; Brier score; mean size of the least set of names with 90 %; how often that has it."""
    now = []
    for n in names:
        together = trust(n.criterion, n.evidence)
        whole = sum(n.probabilities.values())
        now.append({m: together * v / max(whole, 1e-300) for m, v in n.probabilities.items()})
    said = [(p, m in n.right) for n, ps in zip(names, now, strict=True) for m, p in ps.items()]
    table = []
    for low, high in zip(BINS, BINS[1:], strict=False):
        mine = [(p, ok) for p, ok in said if low <= p < high]
        if mine:
            s = share([ok for _, ok in mine])
            table.append([f"{low:g} to {min(high, 1.0):g}", f"{np.mean([p for p, _ in mine]):.2f}",
                          f"{s['hits']} of {s['of']}", f"{s['low']:.2f} to {s['high']:.2f}"])  # fmt: skip
    brier = float(np.mean([(p - ok) ** 2 for p, ok in said])) if said else 0.0
    sizes, hits = [], []
    for n, ps in zip(names, now, strict=True):
        chosen, total = [], 0.0
        for m in sorted(ps, key=lambda m: -ps[m]):
            chosen.append(m)
            total += ps[m]
            if total >= 0.9:
                break
        something_else = total < 0.9  # "none of these" belongs to the set, too
        sizes.append(len(chosen) + something_else)
        hits.append(bool(n.right & set(chosen)) or (something_else and not n.right))
    return table, brier, float(np.mean(sizes)) if sizes else 0.0, share(hits)


def main() -> None:
    """Fit or judge, as the first argument says."""
    import pyarrow.parquet as pq

    if len(sys.argv) < 3 or sys.argv[1] not in ("fit", "judge"):
        raise SystemExit("usage: python -m benchmarks.trust fit|judge RESULT.parquet ...")
    names = [n for f in sys.argv[2:] for n in names_of(pq.read_table(f).to_pylist())]
    for criterion in TRUST_COEFFICIENTS:
        mine = [n for n in names if n.criterion == criterion]
        print(f"{criterion}: {len(mine)} names, {sum(bool(n.right) for n in mine)} with what was hidden among them")
        if not mine:
            continue
        if sys.argv[1] == "fit":
            print(f'    "{criterion}": ({", ".join(f"{b:.3g}" for b in fitted(mine))}),')
            continue
        table, brier, size, covered = judged(mine)
        for line in (["probability", "mean", "right", "90 % interval"], *table):
            print("  " + "".join(f"{c:<20}" for c in line))
        print(f"  Brier score {brier:.3f}; 90 % set: {size:.2f} names, holds {covered['hits']} of {covered['of']}")


if __name__ == "__main__":
    main()
