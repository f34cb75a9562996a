"""Curves of real parts: a passage in series bends gradually, an LVDT's windings err with the cube. Both are in the
library.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from hil.logs import Channel, Log
from tests import rig
from tests.firmware_on_rig import firmware
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance
from vaneloop.identification.selection.search import Search
from vaneloop.identification.vane_chain.chain import build_chain
from vaneloop.identification.workflow import diagnose


def said(seed: int, effect: str, parameters: Mapping[str, float], stage: str) -> StageDiagnosis:
    """What the diagnosis says of one stage of a machine of the rig with this effect."""
    hidden = [rig.Hidden(effect, parameters)]
    links = rig.load_geometry(rng=np.random.default_rng(seed))
    run = rig.simulate(rig.manoeuvre(seed, 120.0), firmware(), hidden, seed=seed, geometry=links)
    log = Log("hidden", {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"}, [])
    return diagnose([build_chain(log).stage(stage)], workers=1).stages[0]


@pytest.mark.slow
@pytest.mark.parametrize(("exponent", "roundness"), [(2.0, (0.8, 1.0)), (20.0, (0.0, 0.2))])
def test_a_passage_in_series_is_flow_saturation_whether_its_corner_is_round_or_sharp(exponent, roundness):
    d = said(51, "valve_flow_saturation", {"limit": 0.020, "exponent": exponent}, "actuator")
    assert [f.effect for f in d.effects] == ["valve_flow_saturation"]
    assert d.excess <= 1.1
    found = d.effects[0].parameters
    assert found["limit"]["value"] == pytest.approx(20.0, rel=0.05)
    assert roundness[0] <= found["roundness"]["value"] <= roundness[1]


@pytest.mark.slow
def test_a_sharp_limit_is_found_wherever_it_lies_below_the_speeds_of_the_log() -> None:
    """Too high a start has no slope to follow, too low a one costs more than none: one of the starts must be near
    enough.
    """
    run = rig.simulate(rig.manoeuvre(53, 120.0), firmware(), (), seed=53)
    stage = build_chain(Log("clean", {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"}, [])).stage(
        "actuator"
    )
    assert stage.floor is not None
    noise = stage.floor[:, None] * np.random.default_rng(53).standard_normal(stage.measured.shape)
    fast = float(
        np.quantile(np.abs(np.gradient(run.log["x_lvdt"], run.log["t"])), 0.998)
    )  # mm/s, for some tenths of a second
    for limit in (0.35 * fast, 0.52 * fast, 0.68 * fast, 0.85 * fast):
        theta = stage.neutral()
        theta[stage.index()["valve_flow_saturation"]] = limit, 0.0
        limited = stage.run(theta[None])[0] + noise
        judge = LeastSquaresProblem(
            replace(stage, measured=np.where(np.isfinite(stage.measured), limited, np.nan)), stage.floor
        )
        fit = Search(LikelihoodAcceptance(judge)).single("valve_flow_saturation")
        assert fit.theta[stage.index()["valve_flow_saturation"]][0] == pytest.approx(limit, rel=0.01), limit


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["amplitude", "cubic"])
def test_an_lvdt_that_errs_with_a_sine_or_with_the_cube_of_its_stroke_is_nonlinear(shape):
    d = said(52, "lvdt_nonlinearity", {"amplitude": 0.0, shape: 0.8e-3}, "linkage")
    assert "lvdt_nonlinearity" in [n for f in d.effects for n in (f.effect, *f.rivals)]
    assert d.excess <= 1.1
