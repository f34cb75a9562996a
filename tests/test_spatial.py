"""The planar linkage against the mechanism in space, by a multibody library and by Newton's method; hysteresis out of
clearances.
"""

from __future__ import annotations

import cmath
import json
import math

import numpy as np
import pytest
from scipy.optimize import minimize

from plant import load_geometry
from plant.geometry import vane_angles
from plant.linkage import clevis_axial, stage_ring_angle
from plant.spatial import (
    Clearances,
    clearance_for,
    clearance_loop,
    clearance_width,
    contributions,
    freedoms,
    plane_joints,
    spatial_angles,
)
from tests.browser import open_to_all
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path
from vaneloop.base.vanes import VANES
from vaneloop.cli.main import main
from vaneloop.design.clearance import FITS, clearance_study
from vaneloop.design.links import geometry_with
from vaneloop.design.multibody import multibody_angles

STAGES = VANES[:3]
GEOMETRY = load_geometry()
STROKE = np.linspace(0.0, 48.0, 25)
PINS = Clearances(**FITS)


def planar(stage: str, stroke: np.ndarray = STROKE) -> np.ndarray:
    return np.degrees(vane_angles(stroke * 1e-3, GEOMETRY)[:, STAGES.index(stage)])


# --- the mechanism in space -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "limit"), [("vigv", 0.041), ("vgv1", 0.012), ("vgv2", 0.0035)])
def test_planar_model_is_the_multibody_mechanism_to_hundredths_of_a_degree(stage, limit):
    pytest.importorskip("exudyn")
    difference = multibody_angles(GEOMETRY, stage, STROKE) - planar(stage)
    assert 0.5 * limit < np.max(np.abs(difference)) < limit


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("offset", [0.0, 15.0])
def test_two_codes_close_the_same_loop_in_space(stage, offset):
    pytest.importorskip("exudyn")
    assert multibody_angles(GEOMETRY, stage, STROKE, offset) == pytest.approx(
        spatial_angles(GEOMETRY, stage, STROKE, offset), abs=1e-7
    )


@pytest.mark.parametrize("stage", STAGES)
def test_the_difference_is_the_link_leaning_by_the_clevis_axial_motion(stage):
    k, s, h = STAGES.index(stage), getattr(GEOMETRY, stage), 1e-4
    axial = np.array(
        [clevis_axial(stage_ring_angle(x * 1e-3, GEOMETRY.arrays(), k), s.ld_prime.value, s.l.value) for x in STROKE]
    )
    shorter = geometry_with(GEOMETRY, {stage: {"lc": s.lc.value - h}})
    per_mm = (np.degrees(vane_angles(STROKE * 1e-3, shorter)[:, k]) - planar(stage)) / h
    expected = per_mm * axial**2 / (2.0 * s.lc.value)
    assert spatial_angles(GEOMETRY, stage, STROKE) - planar(stage) == pytest.approx(expected, abs=5e-4)


def test_a_lever_that_pulls_the_ring_nowhere_leaves_the_planar_angle():
    at_zero = np.array([27.3034])  # mm, VIGV angle 0: no axial motion, so no difference
    k = float(np.interp(0.0, planar("vigv"), STROKE))
    assert abs(k - at_zero[0]) < 0.1
    assert spatial_angles(GEOMETRY, "vigv", [k]) == pytest.approx(planar("vigv", np.array([k])), abs=1e-6)


@pytest.mark.parametrize("stage", STAGES)
def test_drawn_joints_have_the_lengths_of_the_table(stage):
    s, c = getattr(GEOMETRY, stage), GEOMETRY.crank
    for stroke in (0.0, 24.0, 48.0):
        j = plane_joints(GEOMETRY, stage, stroke * 1e-3)
        lengths = [
            abs(j[b] - j[a]) * 1e3 for a, b in (("J0", "J1"), ("J1", "J2"), ("J2", "J3"), ("J3", "J4"), ("J4", "J5"))
        ]
        assert lengths == pytest.approx(
            [c.lx0.value + stroke, c.le.value, s.lb.value, s.lc.value, s.ld.value], abs=1e-9
        )


@pytest.mark.slow
def test_a_mechanism_that_does_not_close_is_refused_with_its_stroke():
    with pytest.raises(InputError, match="vigv: the mechanism does not close in space at stroke 400 mm"):
        spatial_angles(GEOMETRY, "vigv", [24.0, 400.0])
    pytest.importorskip("exudyn")
    with pytest.raises(InputError, match="vigv: the multibody system does not close at stroke"):
        multibody_angles(GEOMETRY, "vigv", np.array([24.0, 400.0]))


# --- clearance --------------------------------------------------------------------------------------------------------


def branch_by_optimisation(stage: str, stroke: float, c: Clearances, side: float) -> float:
    """Least (side 1) or greatest (side -1) ring angle, rad, that the clearances of one planar chain allow: no statics,
    no sides.
    """
    s, k = getattr(GEOMETRY, stage), GEOMETRY.crank
    arms = math.radians(s.theta6.value) - math.atan2(s.dx.value, -s.dy.value)
    j2 = complex(k.x1.value, k.y1.value)
    j5 = j2 + complex(s.dx.value, s.dy.value)
    turn = cmath.exp(-1j * arms)

    def lengths(q: np.ndarray) -> tuple[float, float]:
        centre = j2 + complex(q[2], q[3])
        j1 = centre - 1j * cmath.exp(1j * q[0]) * k.le.value
        j3 = centre - 1j * cmath.exp(1j * q[0]) * turn * s.lb.value
        j4 = j5 - 1j * cmath.exp(1j * q[1]) * turn * s.ld.value
        sine = s.ld_prime.value * math.tan(q[1]) / s.l.value
        z = s.l.value * (1.0 - math.sqrt(1.0 - sine * sine))
        return abs(j1) - k.lx0.value - stroke, math.hypot(abs(j4 - j3), z) - s.lc.value

    link = 0.5 * (c.crank_link + c.link_clevis)
    limits = [
        {"type": "ineq", "fun": lambda q: [0.5 * c.actuator - lengths(q)[0], 0.5 * c.actuator + lengths(q)[0]]},
        {"type": "ineq", "fun": lambda q: [link - lengths(q)[1], link + lengths(q)[1]]},
        {"type": "ineq", "fun": lambda q: 0.25 * c.crank_pivot**2 - q[2] ** 2 - q[3] ** 2},
    ]
    start = np.array([0.4, stage_ring_angle(stroke * 1e-3, GEOMETRY.arrays(), STAGES.index(stage)), 0.0, 0.0])
    found = minimize(
        lambda q: side * 1e3 * q[1], start, constraints=limits, method="SLSQP", options={"maxiter": 500, "ftol": 1e-14}
    )
    return float(found.x[1])


@pytest.mark.parametrize("stage", STAGES)
def test_branches_are_the_ends_of_what_the_clearances_allow(stage):
    c = Clearances(actuator=0.3, crank_pivot=0.2, crank_link=0.1, link_clevis=0.2)
    s = getattr(GEOMETRY, stage)
    for stroke in (3.0, 24.0, 46.0):
        branches = clearance_loop(GEOMETRY, stage, [stroke], c)
        for branch, side in zip(branches, (1.0, -1.0), strict=True):
            ring = branch_by_optimisation(stage, stroke, c, side)
            assert branch[0] == pytest.approx(
                math.degrees(math.asin(s.ld_prime.value * math.tan(ring) / s.l.value)), abs=2e-3
            )


@pytest.mark.parametrize("stage", STAGES)
def test_widths_of_single_joints_add_up(stage):
    c = Clearances(0.1, 0.04, 0.05, 0.05, 0.5, 0.03)
    assert sum(contributions(GEOMETRY, stage, c).values()) == pytest.approx(
        clearance_width(GEOMETRY, stage, c), rel=2e-3
    )


def test_clearance_of_the_link_is_worth_what_a_longer_link_is():
    longer = geometry_with(GEOMETRY, {"vigv": {"lc": 498.1}})
    by_length = np.mean(
        planar("vigv") - np.degrees(vane_angles(STROKE * 1e-3, longer)[:, 0])
    )  # published: 1.6 deg for 1 mm
    up, down = clearance_loop(GEOMETRY, "vigv", STROKE, Clearances(crank_link=1.0))
    assert np.mean(down - up) == pytest.approx(by_length, rel=0.01)
    assert clearance_loop(GEOMETRY, "vigv", STROKE, Clearances())[0] == pytest.approx(
        spatial_angles(GEOMETRY, "vigv", STROKE), abs=1e-9
    )


@pytest.mark.parametrize(
    ("stage", "ring"),
    [("vigv", 0.81), *(pytest.param(*of, marks=pytest.mark.slow) for of in (("vgv1", 0.49), ("vgv2", 0.31)))],
)
def test_nominal_hysteresis_is_traced_to_tenths_of_a_millimetre(stage, ring):
    study = clearance_study(GEOMETRY, stage, getattr(GEOMETRY, stage).hysteresis.value, PINS)
    assert study.made == pytest.approx(getattr(GEOMETRY, stage).hysteresis.value, abs=1e-4)
    assert study.clearances.ring == pytest.approx(ring, abs=0.01)
    assert sum(v for j, v in study.parts.items() if j != "ring") < 0.5 * study.width


def test_a_shifted_ring_is_felt_at_the_bottom_led_at_the_top_and_not_at_the_clevises():
    c = Clearances(ring=1.0)
    lowest, clevis, highest = (clearance_width(GEOMETRY, "vigv", c, vane) for vane in (-90.0, 0.0, 90.0))
    assert lowest == pytest.approx(-highest, abs=1e-3)
    assert lowest == pytest.approx(1.51, abs=0.02)
    assert abs(clevis) < 0.05


@pytest.mark.parametrize("stage", STAGES)
def test_of_the_rings_four_freedoms_only_the_shift_across_reaches_the_vanes(stage):
    f = freedoms(GEOMETRY, stage, 0.0)
    assert len(f) == 4
    assert abs(f["across"]) > 1.5
    assert max(abs(f[name]) for name in f if name != "across") < 0.02


def test_two_links_leave_a_free_ring_four_freedoms():
    j = plane_joints(GEOMETRY, "vigv", 0.024)
    centre = j["J5"]
    rows = []
    for turn in (1.0, -1.0):  # right chain, and the one turned by 180 deg
        arm = turn * (j["J4"] - centre)
        along = turn * (j["J3"] - j["J4"]) / abs(j["J3"] - j["J4"])
        a, u = np.array([arm.real, arm.imag, 0.0]), np.array([along.real, along.imag, 0.0])
        rows.append(np.concatenate([u, np.cross(a, u)]))  # speed along the link, of velocity and rotation
    assert 6 - np.linalg.matrix_rank(np.array(rows)) == 4


# --- commands ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_spatial_command_states_the_difference_and_draws_it(tmp_path, capsys):
    page = tmp_path / "p.html"
    assert main(["spatial", "--points", "9", "--json", "-", "--report", str(page)]) == 0
    data = json.loads(capsys.readouterr().out)
    assert [s["stage"] for s in data["stages"]] == list(STAGES)
    assert data["stages"][0]["max_abs"] == pytest.approx(0.0405, abs=1e-3)
    assert page.stat().st_size > 1e5
    assert main(["spatial", "--points", "9", "--limit", "0.01", "--quiet"]) == 1
    open_to_all(page, "spatial")


@pytest.mark.slow
def test_clearance_command_names_the_millimetres(tmp_path, capsys):
    page = tmp_path / "p.html"
    assert main(["clearance", "--json", "-", "--report", str(page)]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["stages"][0]["clearances"]["ring"] == pytest.approx(0.81, abs=0.01)
    assert page.stat().st_size > 1e5
    open_to_all(page, "clearance")


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["spatial", "--offset", "nan"], "--offset (=nan mm) must be in"),
        (["spatial", "--points", "1"], "--points (=1)"),
        (["spatial", "--limit", "nan"], "--limit (=nan deg)"),
        (["clearance", "--actuator", "-1"], "clearance actuator (=-1 mm) must be in [0, 5]"),
        (["clearance", "--ring", "nan"], "clearance ring (=nan mm)"),
        (["clearance", "--width", "vigv=x"], "--width vigv=x"),
        (["clearance", "--width", "vgv3=1"], "'vgv3' is not known"),
        (["clearance", "--vane", "1000"], "--vane (=1000 deg)"),
        (["clearance", "--actuator", "4"], "no clearance of ring gives a width of 1.6 deg: the others alone make 4"),
        (["clearance", "--vane", "0"], "no clearance of ring gives a width"),
    ],
)
def test_bad_options_are_refused_in_one_line(argv, says, capsys):
    assert main(argv) == 2
    err = capsys.readouterr().err
    assert says in err and err.count("\n") == 1


def test_a_geometry_that_does_not_assemble_is_refused_by_both(tmp_path, capsys):
    (tmp_path / "g.toml").write_text(path("geometry.toml").read_text().replace("value = 497.1", "value = 300.0"))
    for command in ("spatial", "clearance"):
        assert main([command, "--geometry", str(tmp_path / "g.toml")]) == 2
        assert "vigv cannot be assembled at stroke -2 mm" in capsys.readouterr().err


def test_the_clearance_for_a_width_gives_that_width():
    needed = clearance_for(GEOMETRY, "vgv1", 1.1, PINS, "actuator")
    c = Clearances(**(FITS | {"actuator": needed}))
    assert clearance_width(GEOMETRY, "vgv1", c) == pytest.approx(1.1, abs=1e-4)
