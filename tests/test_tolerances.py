"""What a table calls tolerance is calibration: machines within it miss no physics, whichever numbers moved."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.logs import Channel, Log
from plant import build_plant
from plant.geometry import STANDS_FOR, Geometry, length_tolerances, load_geometry, vane_angles
from plant.model import Model
from plant.parameters import nominal
from tests import rig
from tests.conftest import examples, quick_first
from tests.firmware_on_rig import firmware
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import VANES
from vaneloop.identification.vane_chain.chain import build_chain
from vaneloop.identification.workflow import diagnose

STROKE = np.linspace(0.0, 48e-3, 49)  # m
STAGES = VANES[:3]
PARTS = ("crank", *STAGES)


def moved(seed: int) -> Geometry:
    """The table's linkage with every length and angle drawn within its tolerance."""
    rng = np.random.default_rng(seed)
    g = load_geometry()
    parts = {}
    for name in PARTS:
        part = getattr(g, name)
        drawn = {
            k: q.model_copy(update={"value": q.value + rng.uniform(-1, 1) * q.tolerance})
            for k, q in part
            if k != "hysteresis"
        }
        parts[name] = part.model_copy(update=drawn)
    return g.model_copy(update=parts)


def stand_ins(g: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """Link and lever arm of each stage (mm off the table) that imitate ``g``'s angles best beside an offset, and what
    is left (deg).
    """
    table = load_geometry()
    off = np.rad2deg(vane_angles(STROKE, g) - vane_angles(STROKE, table))
    sizes, left = [], []
    for k, stage in enumerate(STAGES):
        part = getattr(table, stage)
        shapes = []
        for key in STANDS_FOR:
            q = getattr(part, key)
            longer = table.model_copy(
                update={stage: part.model_copy(update={key: q.model_copy(update={"value": q.value + 0.1})})}
            )
            shapes.append(np.rad2deg(vane_angles(STROKE, longer) - vane_angles(STROKE, table))[:, k] / 0.1)
        a = np.column_stack([*shapes, np.ones(len(STROKE))])
        x = np.linalg.lstsq(a, off[:, k], rcond=None)[0]
        sizes.append(x[:2])
        left.append(float(np.abs(off[:, k] - a @ x).max()))
    return np.array(sizes), np.array(left)


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(0, 2**31))
def test_two_lengths_of_a_stage_stand_for_all_of_them(seed):
    _, left = stand_ins(moved(seed))
    assert left.max() < 3e-3  # deg: a tenth of the potentiometers' noise


@pytest.mark.slow
def test_the_two_lengths_stay_within_their_tolerance_on_all_but_few_machines():
    tolerance = np.array([[length_tolerances(load_geometry())[f"{s}_{key}"] for key in STANDS_FOR] for s in STAGES])
    drawn = np.array([stand_ins(moved(seed))[0] for seed in range(300)])
    beyond = np.abs(drawn) > tolerance
    assert beyond.mean() < 0.01
    assert np.abs(drawn).max() > 0.5 * tolerance.min()  # nor is it wider than machines need


def test_a_table_that_calls_its_lengths_exact_frees_none():
    g = load_geometry()
    parts = {
        n: getattr(g, n).model_copy(update={k: q.model_copy(update={"tolerance": 0.0}) for k, q in getattr(g, n)})
        for n in PARTS
    }
    assert length_tolerances(g.model_copy(update=parts)) == {}


def test_a_model_file_takes_the_two_lengths_and_refuses_them_far_off():
    plant = build_plant()
    row = next(n.row for n in nominal(plant.table, plant.geometry) if n.name == "linkage.vgv1_lc")
    assert Model(parameters={"linkage.vgv1_lc": 493.8}).plant(plant).p[row, 0] == pytest.approx(0.4938)
    with pytest.raises(InputError, match=r"linkage.vgv1_lc \(=480 mm\)"):
        Model(parameters={"linkage.vgv1_lc": 480.0}).plant(plant)


@pytest.mark.parametrize("seed", quick_first([32, 31]))
def test_links_within_their_tolerance_are_no_missing_physics(seed):
    g = rig.load_geometry(rng=np.random.default_rng(seed))
    run = rig.simulate(rig.manoeuvre(seed, 120.0), firmware(), seed=seed, geometry=g)
    log = Log("clean", {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"}, [])
    d = diagnose([build_chain(log).stage("linkage")], workers=1)
    assert d.verdict == "none", [f.effect for s in d.stages for f in s.effects]
    assert d.stages[0].excess < 1.05
