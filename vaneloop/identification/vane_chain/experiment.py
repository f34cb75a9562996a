"""Which demand profile would best tell the remaining rivals apart? Rivals are simulated and refitted on a bank of safe
profiles.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from hil.logs import Channel, Log
from hil.loop.lockstep import Stimulus, lockstep
from plant import Model, build_plant
from plant.effects import EFFECTS
from plant.model import side_of
from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.selection.diagnosis import floor_of
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance
from vaneloop.identification.selection.rules import gain
from vaneloop.identification.selection.search import Search
from vaneloop.identification.settings import MARGIN, MOST_REPEATS, NATS, RIVAL_SPREADS
from vaneloop.identification.subsystem import Stage
from vaneloop.identification.vane_chain.chain import build_chain

if TYPE_CHECKING:
    from controller import Calibration
    from plant import Plant

__all__ = ["HEADS", "divergence", "profiles", "recommend"]


HEADS = {
    "profile": "profile", "nats": "log-likelihood ratio a run", "spreads": "standard deviations",
    "repeats": "runs needed",
}  # fmt: skip


def _piecewise(points: list[tuple[float, float]]) -> np.ndarray:
    """Straight lines between points (s, %); before the first it stands."""
    t, n = np.array(points).T
    return np.interp(np.arange(0.0, t[-1], 0.01), t, n)


def _sine(middle: float, size: float, low_hz: float, high_hz: float, seconds: float) -> np.ndarray:
    t = np.arange(0.0, seconds, 0.01)
    return middle + size * scipy.signal.chirp(t, low_hz, seconds, high_hz, phi=-90)


@cache
def profiles() -> dict[str, np.ndarray]:
    """Safe profiles of the rotor speed's demand, %, every 10 ms, by what they are."""
    stairs: list[tuple[float, float]] = [(4, 60)]
    for k, n in enumerate([65, 70, 75, 80, 85, 90, 95, 99, 95, 90, 85, 80, 75, 70, 65, 60]):
        stairs += [(4 + 7 * k, stairs[-1][1]), (5 + 7 * k, n)]
    slams: list[tuple[float, float]] = []
    for k in range(4):
        slams += [(5 + 30 * k, 55), (5.2 + 30 * k, 98), (20 + 30 * k, 98), (20.2 + 30 * k, 55), (35 + 30 * k, 55)]
    small: list[tuple[float, float]] = []
    for k in range(24):
        small += [(2 + 4 * k, 80), (2.2 + 4 * k, 80 + (1.5 if k % 2 else -1.5) * (1 + k / 8)), (4 + 4 * k, 80)]
    return {
        "slow ramp up and down over the whole range": _piecewise([(3, 45), (60, 100), (63, 100), (120, 45)]),
        "fast ramps over the whole range": _piecewise(
            [(3, 50), (11, 99), (14, 99), (22, 50), (25, 50), (33, 99), (41, 50), (60, 50)]
        ),
        "slams between 55 and 98 %": _piecewise(slams),
        "stairs of 5 % with dwells": _piecewise(stairs),
        "small reversals about 80 %": _piecewise(small),
        "swept sine, 2 % about 82 %, 0.05 to 1.5 Hz": _sine(82.0, 2.0, 0.05, 1.5, 100.0),
        "swept sine, 6 % about 80 %, 0.02 to 0.5 Hz": _sine(80.0, 6.0, 0.02, 0.5, 100.0),
        "dwells at 50, 80 and 99 %": _piecewise([(30, 50), (36, 80), (66, 80), (70, 99), (100, 99), (106, 50)]),
    }


def divergence(
    profile: np.ndarray,
    truth: dict[str, dict[str, float]],
    stage: str,
    rival: str,
    named: str,
    beside: tuple[str, ...] = (),
    seed: int = 1,
    plant: Plant | None = None,
    calibration: Calibration | None = None,
) -> tuple[float, float]:
    """How much better the effect ``named`` explains a simulated run than ``rival`` does, both refitted, on this
    profile.

    truth   effects of the simulated machine with their parameters (border units); those of one of two actuators as
            ``side_b.lvdt_bias``
    beside  other effects of the stage, refitted together with either
    plant, calibration  the machine without these effects; default: the shipped tables

    Returns (nats, spreads), the two measures by which the diagnosis decides.
    """
    t = np.arange(len(profile)) * 1e-2
    warm = 40.0 + 30.0 * (1.0 - np.exp(-t / 60.0))  # oil warms up in any run
    machine = plant or build_plant()
    run = lockstep(
        Stimulus.of(profile, t_oil=warm),
        calibration=calibration,
        plant=Model.of_effects(truth).plant(machine),
        seed=seed,
        hashed=False,
    )
    log = Log(
        "simulated", {k: Channel(run.t, v) for k, v in run.columns.items() if k not in ("t", "n_engine", "i_motor")}
    )
    chain = build_chain(log, machine, calibration)
    if all(s.name != stage for s in chain.stages):
        return 0.0, 0.0
    s = chain.stage(stage)
    # only these effects are needed: fewer columns, the same run
    needed = tuple(s.effect(name).name for name in (rival, named, *beside))
    rival, named, *others = needed
    full, keep, neutral = s.run, _columns(s, needed), s.neutral()
    s.effects = tuple(e for e in s.effects if e.name in needed)

    def reduced(thetas: np.ndarray) -> np.ndarray:
        wide = np.repeat(neutral[None], len(thetas), axis=0)
        wide[:, keep] = thetas
        return full(wide)

    s.run = reduced
    judge = LeastSquaresProblem(s, floor_of(s))
    search = Search(LikelihoodAcceptance(judge))
    best, other = (search.joined((*others, name)) for name in (named, rival))
    return gain(other, best, correlation_of(judge, best))


def _columns(stage: Stage, effects: Sequence[str]) -> list[int]:
    index = stage.index()
    out = list(range(len(stage.parameters)))
    for e in stage.effects:
        if e.name in effects:
            out += list(range(index[e.name].start, index[e.name].stop))
    return out


def recommend(d: Any, progress: Any = None, chain: Any = None) -> dict[str, Any] | None:
    """Return the best profile for the rivals in a diagnosis, or None when there is nothing to separate.

    chain  the log's stages (`identification.vane_chain.chain.Chain`), for their machine; default: the shipped tables

    ``score`` is the smallest divergence over all pairs and all ``repeats``, in nats.
    """
    pairs = [(s, f, rival) for s in d.stages for f in s.effects for rival in f.rivals[:3]]
    if not pairs:
        return None
    machine = {} if chain is None else {"plant": chain.plant, "calibration": chain.built}
    table: list[dict[str, Any]] = []
    bank = profiles()
    jobs = list(itertools.product(bank.items(), pairs))
    scores: dict[str, list[tuple[float, float]]] = {name: [] for name in bank}
    truth: dict[str, dict[str, float]] = {}  # an effect that shows in two stages was fitted in both; the first will do
    for f in (f for s in d.stages for f in s.effects):
        known = [p.name for p in EFFECTS[side_of(f.effect)[1]].parameters]
        truth.setdefault(f.effect, {k: float(v["value"]) for k, v in f.parameters.items() if k in known})
    for i, ((name, profile), (s, f, rival)) in enumerate(jobs):
        beside = tuple(o.effect for o in s.effects if o.effect not in (f.effect, rival))
        without = {k: v for k, v in truth.items() if k != rival}  # which another stage may name
        scores[name].append(divergence(profile, without, s.stage, rival, f.effect, beside, **machine))
        if progress:
            progress((i + 1) / len(jobs))
    for name, found in scores.items():
        # nats grow with the number of runs, spreads with its root; what decides in the diagnosis decides here, with a
        # margin
        nats, spreads = min(n for n, _ in found), min(s for _, s in found)
        needed = max(MARGIN * NATS / max(nats, 1e-9), (MARGIN * RIVAL_SPREADS / max(spreads, 1e-9)) ** 2)
        by_pair = [[f.effect, r, n] for (_, f, r), (n, _) in zip(pairs, found, strict=True)]
        runs = int(np.ceil(needed)) if needed <= MOST_REPEATS else 0
        row = {"profile": name, "nats": nats, "spreads": spreads, "repeats": runs, "needed": needed, "by_pair": by_pair}
        table.append(row)
    # the fewest runs first; of profiles that no number of runs helps, the one that comes nearest
    table.sort(key=lambda r: (r["needed"], -r["nats"]))
    best = table[0]
    once = bank[best["profile"]]
    repeats = max(1, best["repeats"])
    profile = np.tile(once, repeats)
    separated = best["repeats"] > 0
    apart = {frozenset(pair): pair for pair in ((f.effect, r) for _, f, r in pairs)}  # one that two stages have is one
    names = ", ".join(f"{effect} from {rival}" for effect, rival in apart.values())
    often = "" if repeats == 1 else f", {repeats} times over"
    gained = repeats * best["nats"]
    text = (
        f"To distinguish {names}: {best['profile']}{often}, {len(profile) / 100:.0f} s; expected log-likelihood ratio "
        f"{gained:.1f} for the closest pair."
    )
    if not separated:
        text = (
            f"No profile of the bank separates {names}, even {MOST_REPEATS} times over. The best, {best['profile']}, "
            f"has a log-likelihood ratio of {best['nats']:.1f} a run, {best['spreads']:.1f} standard deviations; "
            f"{MARGIN * NATS:g} and {MARGIN * RIVAL_SPREADS:g} are required."
        )
    return {
        "text": text, "profile": best["profile"], "score": gained, "separates": separated, "repeats": repeats,
        "t": np.arange(len(profile)) * 0.01, "inputs": {"n_dem": ("%", profile)}, "table": table, "heads": HEADS,
    }  # fmt: skip
