"""The blind benchmark's draw: the same kinds for the same seed, ordinary machines and loggers, and what counts as named
too easily.
"""

from __future__ import annotations

import json

import numpy as np

from tests.rig import load_geometry
from vaneloop.cli.hidden_effect import _too_easy, draw_case, judge_case

N = 200


def test_every_machine_has_its_own_links_a_fifth_has_gaps_and_a_fifth_another_mode():
    cases = [draw_case(7, i) for i in range(N)]
    nominal = load_geometry()
    assert all(c["geometry"] != nominal for c in cases)
    assert len({c["geometry"].Le for c in cases}) == N
    for key in ("gaps", "modes"):
        share = np.mean([bool(c[key]) for c in cases])
        assert 0.12 < share < 0.28, key
    gaps = [g for c in cases for g in c["gaps"]]
    assert {len(c["gaps"]) for c in cases} == {0, 1, 2, 3}
    assert all(1.0 <= length <= 10.0 and 15.0 <= start <= 270.0 for start, length in gaps)
    modes = [m for c in cases for m in c["modes"]]
    assert {m.kind for m in modes} == {"standby", "deaf"}
    assert all(m.start >= 60.0 and m.start + m.length <= 250.0 for m in modes)


def test_the_same_seed_draws_the_same_case():
    for i in range(5):
        assert repr(draw_case(3, i)) == repr(draw_case(3, i))


def test_a_row_says_what_was_done_to_the_log():
    seed, index = next(
        (s, i)
        for s in range(20)
        for i in range(10)
        if (c := draw_case(s, i, 40.0))["kind"] == "clean" and c["gaps"] and c["modes"]
    )
    row = judge_case(seed, index, 40.0, 100)
    case = draw_case(seed, index, 40.0)
    assert json.loads(row["gaps"]) == [list(g) for g in case["gaps"]]
    assert [m["kind"] for m in json.loads(row["modes"])] == [m.kind for m in case["modes"]]
    assert json.loads(row["geometry"])["Le"] == case["geometry"].Le


def test_a_name_is_too_easy_when_improbable_without_rival_or_on_a_bound():
    def named(effect: str, probability: float, rivals: list[str], **parameters: float) -> dict[str, object]:
        return {
            "effect": effect,
            "probability": probability,
            "rivals": rivals,
            "parameters": {k: {"value": v} for k, v in parameters.items()},
        }

    assert _too_easy(named("lvdt_bias", 0.37, [], bias=0.1))
    assert not _too_easy(named("lvdt_bias", 0.37, ["pot_bias"], bias=0.1))
    assert not _too_easy(named("lvdt_bias", 0.9, [], bias=0.1))
    from plant.effects import EFFECTS

    top = EFFECTS["lvdt_bias"]["bias"].high
    assert _too_easy(named("lvdt_bias", 0.9, [], bias=top))
    # the bound that is also the neutral value is no bound met: the other stages of an effect stand there
    assert not _too_easy(named("linkage_wear", 0.9, [], vigv=0.0, vgv1=5.0, vgv2=0.0))
