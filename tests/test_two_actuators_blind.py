"""The blind benchmark of two actuators: what is drawn, and what an answer is worth."""

# ruff: noqa: D103 - a test's name is its claim
from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.two_actuators import CLEAN, HIDDEN, KINDS, OF_BOTH, STIFFNESS, TABLE, draw_case, outcome, summary
from plant import build_plant
from plant.effects import EFFECTS
from plant.model import of_a_side

TWO = build_plant(TABLE)
MANY = 4 * len(KINDS)


def row(truth: str, named: dict[str, list[str]], verdict: str = "missing", at_limit: tuple[str, ...] = ()) -> dict:
    return {
        "truth": truth, "named": list(named), "rivals": json.dumps(named), "verdict": verdict,
        "at_limit": list(at_limit),
    }  # fmt: skip


def test_the_same_seed_draws_the_same_case() -> None:
    for i in range(len(KINDS)):
        a, b = draw_case(3, i, 40.0), draw_case(3, i, 40.0)
        assert a["model"] == b["model"] and np.array_equal(a["demand"], b["demand"]) and a["noise"] == b["noise"]
    assert draw_case(3, 1, 40.0)["size"] != draw_case(4, 1, 40.0)["size"]


def test_each_kind_comes_at_each_side_as_often() -> None:
    truths = [draw_case(7, i, 40.0)["truth"] for i in range(MANY)]
    for kind in HIDDEN:
        if kind in OF_BOTH:
            assert truths.count(kind) == 4
        else:
            assert truths.count(f"side_a.{kind}") == truths.count(f"side_b.{kind}") == 2
    assert truths.count("") == 4


def test_every_machine_can_be_made_and_its_sides_differ_by_up_to_one_per_cent() -> None:
    nominal = {n.name: n.value for n in TWO.nominal}
    for i in range(MANY):
        case = draw_case(11, i, 40.0)
        case["model"].plant(TWO)
        for side in (case["model"].side_a, case["model"].side_b):
            off = [abs(v / nominal[name] - 1.0) for name, v in side.parameters.items()]
            assert len(off) == 3 and 0.0 < max(off) <= 0.01
        low, high = HIDDEN[case["kind"]][2:4] if case["kind"] != CLEAN else (0.0, 0.0)
        assert low <= abs(case["size"]) <= high
        assert case["demand"].min() >= 50.0 and case["demand"].max() <= 99.0 and len(case["demand"]) == 4000


def test_what_has_a_side_is_of_the_library_and_can_be_of_one() -> None:
    assert all(of_a_side(kind, False) == (kind not in OF_BOTH) for kind in HIDDEN if kind != STIFFNESS)
    assert all(HIDDEN[kind][0] in [p.name for p in EFFECTS[kind].parameters] for kind in HIDDEN if kind != STIFFNESS)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (row("side_b.lvdt_bias", {"side_b.lvdt_bias": []}), "named"),
        (row("side_b.lvdt_bias", {"side_a.lvdt_bias": ["side_b.lvdt_bias"]}), "among rivals"),
        (row("side_b.lvdt_bias", {"side_b.lvdt_bias": ["lvdt_bias"]}), "among rivals"),
        (row("side_b.lvdt_bias", {"side_b.lvdt_gain": []}), "its side, another part"),
        (row("side_b.lvdt_bias", {"side_a.lvdt_bias": []}), "wrong"),
        (row("linkage_backlash", {"linkage_wear": []}), "wrong"),
        (row(STIFFNESS, {}, "none", (STIFFNESS,)), "nothing"),
        (row("", {"aero_load": []}), "wrong"),
        (row("side_a.piston_friction", {}, "unknown"), "unknown"),
    ],
)
def test_an_answer_is_worth_what_it_names(answer: dict, said: str) -> None:
    assert outcome(answer) == said


def test_shares_count_clean_logs_and_the_stiffness_apart() -> None:
    rows = [
        row("", {}, "none") | {"kind": CLEAN},
        row("", {}, "unknown") | {"kind": CLEAN},
        row(STIFFNESS, {}, "none", (STIFFNESS,)) | {"kind": STIFFNESS},
        row("side_a.lvdt_gain", {"side_a.lvdt_gain": []}) | {"kind": "lvdt_gain"},
        row("side_b.lvdt_gain", {"side_a.lvdt_gain": []}) | {"kind": "lvdt_gain"},
        row("linkage_backlash", {}, "unknown") | {"kind": "linkage_backlash"},
    ]
    seen = [False, False, True, True, True, False]
    s = summary(
        [r | {"outcome": outcome(r), "elapsed_s": 2.0, "detectable": d} for r, d in zip(rows, seen, strict=True)]
    )
    count = {k: (v["hits"], v["of"]) for k, v in s.items() if isinstance(v, dict)}
    assert count == {
        "hidden: named or among rivals": (1, 3), "of one side: named or among rivals": (1, 2),
        "detectable: named or among rivals": (1, 2), "detectable: alone or first of its rivals": (1, 2),
        "of one side: named alone": (1, 2), "where effects are named: wrong": (1, 2),
        "stiffness of the rings off: at the end of its tolerance": (1, 1),
        "stiffness of the rings right: at the end of its tolerance": (0, 5),
        "clean logs with an effect named": (0, 2), "clean logs with a false alarm": (1, 2),
    }  # fmt: skip
    assert s["median seconds"] == 2.0
