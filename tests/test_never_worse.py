"""With more effects a fit never ends farther off, and no command writes a model that is."""

from __future__ import annotations

import argparse
import itertools
from dataclasses import replace

import numpy as np
import pytest

from controller import load_calibration
from plant import build_plant
from vaneloop.cli import extend
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.selection.diagnosis import extend_stage
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance
from vaneloop.identification.selection.search import Search
from vaneloop.identification.subsystem import Effect, Parameter, Stage
from vaneloop.identification.vane_chain.chain import Chain
from vaneloop.identification.workflow import no_better
from vaneloop.verbs import search as verbs

N = 1200


def rough_stage(seed: int) -> Stage:
    """A stage with effects whose error has many valleys: sizes act through sines and saturations, some starts lie far
    off.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(N) * 0.1
    inputs = np.cumsum(rng.standard_normal((4, N)), axis=1) / 10.0
    gains = rng.uniform(0.5, 4.0, 4)

    def run(theta: np.ndarray) -> np.ndarray:
        offset, size = theta[:, :1, None], theta[:, 1:, None]
        y = offset + np.sum(np.sin(gains[:, None] * size * inputs) * size, axis=1, keepdims=True)
        return y + size[:, :1] * size[:, 1:2] * inputs[2]

    truth = np.concatenate([[0.05], np.where(rng.random(4) < 0.5, rng.uniform(-1.5, 1.5, 4), 0.0)])
    measured = run(truth[None])[0] + 0.1 * rng.standard_normal((1, N))
    effects = tuple(
        Effect(f"e{k}", (Parameter("size", 0.0, "-", -2.0, 2.0),), tuple((v,) for v in rng.uniform(-2.0, 2.0, 2)))
        for k in range(4)
    )
    return Stage(
        "rough",
        ("y",),
        ("-",),
        (Parameter("offset", 0.0, "-", tolerance=0.1),),
        effects,
        run,
        t,
        measured,
        floor=np.array([0.1]),
    )


@pytest.mark.parametrize("seed", range(12))
def test_no_fit_is_worse_than_one_it_contains(seed):
    search = Search(LikelihoodAcceptance(LeastSquaresProblem(rough_stage(seed), np.array([0.1]))))
    total = search.judge.total_of
    names = [e.name for e in search.stage.effects]
    if search.quiet:
        pytest.skip("nothing hidden")
    search.singles(names)
    for many in (2, 3, 4):
        sets = list(itertools.combinations(names, many))
        for fit in search.best_of(sets):
            for key, part in search.fits.items():
                if key < frozenset(fit.effects):
                    assert total(fit) <= total(part) * (1.0 + 1e-9), (fit.effects, part.effects)


@pytest.mark.parametrize(("after", "written"), [(972.0, False), (151.0, False), (1.4, True)])
def test_extend_writes_no_model_that_is_no_better(after, written, monkeypatch, tmp_path, capsys):
    """Both ends on both bounds at 972 noise floors, nominal 151: such a model was once written."""
    stage = rough_stage(0)
    effect = Effect("internal_leakage", (Parameter("coefficient", 0.0, "mm/s/MPa", 0.0, 50.0),), ((1.0,),))
    stage = replace(stage, name="actuator", effects=(effect,), run=lambda theta: np.zeros((len(theta), 1, N)))
    ended = replace(
        extend_stage(stage, ("internal_leakage",)),
        steps=[("nominal", 151.0), ("+ internal_leakage", after)],
        excess=after,
    )
    chain = Chain(stage.t, [stage], {}, {}, build_plant(), load_calibration(), load_calibration())
    monkeypatch.setattr(extend, "chain_of", lambda args, model: chain)
    monkeypatch.setattr(verbs, "extend_stage", lambda stage, effects: ended)
    parser = argparse.ArgumentParser()
    extend.add_options(parser)
    out = tmp_path / "m.toml"
    code = extend.command(parser.parse_args(["run.csv", "--effect", "internal_leakage", "--out", str(out)]))
    err = capsys.readouterr().err
    assert out.exists() == written
    assert code == 1
    assert err.count("\n") == (0 if written else 1)
    assert written or ("internal_leakage takes the error from 151 to" in err and "is not written" in err)


def test_what_is_no_better_is_said_in_one_line():
    stage = rough_stage(0)
    r = extend_stage(stage, ("e0", "e1"))
    assert (no_better(r) is None) == (r.excess < r.steps[0][1])
    r.excess = r.steps[0][1] * 6.0
    text = no_better(r)
    assert text is not None and "e0" in text and "no better" in text and "\n" not in text
