"""Curves side by side give what each lane's curves give alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from plant import build_plant
from plant.curve import KNOWN, PLACES, QUANTITIES, Place, at_curve, quantity_of
from plant.curve_lanes import tables_of
from plant.effects import CURVES, EFFECTS
from plant.layout import C_LOW, CURVE_ROWS, MOST_CURVES
from plant.parameters import derive
from plant.stages import (
    actuator,
    actuator_run,
    bends,
    engine,
    engine_run,
    linkage,
    linkage_run,
    run_bends,
    step_currents,
)
from vaneloop.base.curve import POINTS
from vaneloop.base.vanes import VANES

MACHINES = {"hydraulic": "plant.toml", "electromechanical": "plant_electromechanical.toml"}
N, LANES, DT = 240, 19, 0.01
T = np.arange(N) * DT
SITES = {  # of each stage: where its curves may act, and channels that they may be of
    "actuator": ("valve.", "actuator.", "sensors.lvdt"),
    "linkage": ("sensors.", "linkage."),
    "engine": ("engine.",),
    "controller": ("controller.", "servo."),
}
ONE_BY_ONE = (
    (actuator, "_actuator_lanes"), (linkage, "_linkage_lanes"), (engine, "_engine_lanes"), (bends, "_lane_by_lane"),
)  # fmt: skip
OF = [q for q in QUANTITIES if q not in VANES]
# what makes a lane of a block need more than the others
BESIDE = {
    "valve_hysteresis": 0.3, "piston_friction": 200.0, "piston_stiction": 200.0, "supply_pressure_droop": 0.3,
    "valve_flow_saturation": 60.0, "aero_load": 1500.0, "valve_null_bias": 0.3, "oil_viscosity": 0.005,
    "lvdt_nonlinearity": 0.1, "linkage_friction": 0.1, "ring_eccentricity": 0.2, "linkage_wear": 10.0,
    "screw_pitch_error": 0.02, "tacho_thermal_drift": 1e-4,
}  # fmt: skip


def size_of(place: Place) -> float:
    """How large a curve there may be, in its unit."""
    return {"-": 0.4, "mm": 0.3, "deg": 0.4, "mA": 1.0, "N": 800.0, "%": 3.0}[place.unit]


def random_signals(rng: np.random.Generator, at: list[Place], of: list[str]) -> np.ndarray:
    """What curves are of, and what hystereses give, SI: smooth, and of each channel's size."""
    curves, slipping = len(of), any("stops" in name for name in of)
    rows = KNOWN + (LANES * curves if slipping else curves)
    phase, pace = rng.uniform(0.0, 6.0, (rows, 1)), rng.uniform(1.0, 9.0, (rows, 1))
    wave = np.sin(pace * T + phase)
    si = np.ones((rows, 1))
    for q in QUANTITIES.values():
        si[q.of] = q.si
    for c, (place, name) in enumerate(zip(at, of, strict=True)):
        if "stops" in name:
            si[KNOWN + c :: curves] = size_of(place) * place.si
        else:  # a lag is the same in all lanes
            wave[KNOWN + c :: curves] = wave[KNOWN + c]
    return wave * si


def machines(
    rng: np.random.Generator, kind: str, at: list[Place], of: list[str], effects: list[str], bare: int = 5
) -> np.ndarray:
    """Lanes with the same curves and other tables; one of every ``bare`` has none (0: all have them), every other one
    an effect beside.
    """
    plant = build_plant(MACHINES[kind])
    p = np.repeat(plant.p, LANES, axis=1)
    none = np.arange(LANES) % bare == 3 if bare else np.zeros(LANES, dtype=bool)
    for place, name in zip(at, of, strict=True):
        q = quantity_of(name)
        assert q is not None
        low, high = (0.0, 1.3) if q.stops else (-0.8, 0.9)
        at_curve(
            p, place, q, low, high, size_of(place) * rng.standard_normal((POINTS, LANES)).cumsum(axis=0) / POINTS**0.5
        )
    p[CURVES:, none] = plant.p[CURVES:]
    for name in effects:
        for row, q in plant.parameters_of(name).items():
            if q.name in ("phase", "distance", "spread", "speed"):
                continue
            p[row, ::2] = (q.neutral + BESIDE[name]) * q.si
            break
    derive(p, 2e-3, DT)
    return p


def outputs(stage: str, p: np.ndarray, kind: str, rng: np.random.Generator, known: np.ndarray) -> np.ndarray:
    """What a stage gives."""
    plant = build_plant(MACHINES[kind])
    s = np.repeat(plant.start(0.024, 60.0), LANES, axis=1)
    n_r, t_oil, p_s = 60.0 + 5.0 * np.sin(T), 30.0 + T, 21e6 - 1e5 * np.cos(T)
    stroke = 0.024 + 2e-3 * np.sin(3.0 * T)
    if stage == "actuator":
        out = np.empty((N, LANES), order="F")
        i = step_currents(4e-3 * np.sin(7.0 * T) + 1e-4 * rng.standard_normal(N), DT, 5)
        actuator_run(i, n_r, p_s, t_oil, DT, p, s, out, stroke, 100, known)
    elif stage == "linkage":
        out = np.empty((N, 3, LANES), order="F")
        linkage_run(stroke, n_r, t_oil, T, DT, p, s, out, known)
    elif stage == "engine":
        out = np.empty((N, LANES))
        engine_run(60.0 + 5.0 * np.sin(4.0 * T), DT, p, s, out, known)
    else:
        gives = [np.empty((LANES, N)) for _ in range(3)]
        for site, one in zip((1, 2, 3), gives, strict=True):
            run_bends(known, p, s, site, one)
        out = np.array(gives)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("stage", SITES)
@pytest.mark.parametrize("kind", MACHINES)
@settings(max_examples=25, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(data=st.data())
def test_side_by_side_as_lane_by_lane(stage: str, kind: str, data: st.DataObject) -> None:
    places = [p for p in PLACES.values() if p.at.startswith(SITES[stage]) and kind in p.kinds]
    at = data.draw(st.lists(st.sampled_from(places), min_size=1, max_size=MOST_CURVES))
    slips = data.draw(st.booleans())
    how = ["{}", "{}", "{}_lagged_by_2_s", *(["stops_of_{}"] if slips else [])]
    plain = st.sampled_from([q for q in OF if q != "time"])
    of = [data.draw(st.sampled_from(how)).format(data.draw(plain)) for _ in at]
    if data.draw(st.booleans()):
        of[0] = "time_every_137_ms"
    own = [n for n in BESIDE if kind in EFFECTS[n].kinds]
    effects = data.draw(st.lists(st.sampled_from(own), max_size=2, unique=True))
    seed = data.draw(st.integers(0, 2**32 - 1))

    # blocks mix lanes with curves and without; engine and controller run side by side where all lanes have them
    bare = 5 if stage in ("actuator", "linkage") else 0

    def run() -> np.ndarray:
        rng = np.random.default_rng(seed)
        known = random_signals(rng, at, of)
        return outputs(stage, machines(rng, kind, at, of, effects, bare), kind, rng, known)

    with pytest.MonkeyPatch.context() as m:  # no lane with curves is run alone
        for module, name in ONE_BY_ONE:
            m.setattr(module, name, lambda *_: pytest.fail("a lane ran alone"))
        together = run()
    with pytest.MonkeyPatch.context() as m:
        for module in (actuator, linkage, engine, bends):
            m.setattr(module, "alike", lambda p: np.zeros(p.shape[1], dtype=bool))
        alone = run()
    scale = max(float(np.nanmax(np.abs(alone))), 1e-6)
    assert np.isfinite(together).all()
    assert np.allclose(together, alone, rtol=0.0, atol=1e-9 * scale)


@pytest.mark.slow
def test_lanes_with_other_curves_run_alone() -> None:
    """Curves of another range, or none, are not those of their neighbours."""
    rng = np.random.default_rng(3)
    place = PLACES["valve.current adds"]
    p = machines(rng, "hydraulic", [place], ["i_cmd"], [])
    row = CURVES + 1 + C_LOW
    p[row, 4] *= 2.0
    curved = p[CURVES] != 0.0
    assert (actuator.alike(p) == (curved & (np.arange(LANES) != 4))).all()
    known = random_signals(rng, [place], ["i_cmd"])
    got = outputs("actuator", p, "hydraulic", np.random.default_rng(1), known)
    for j in (3, 4, 5):
        one = np.repeat(p[:, j : j + 1], LANES, axis=1)
        alone = outputs("actuator", one, "hydraulic", np.random.default_rng(1), known)[:, 0]
        assert np.allclose(got[:, j], alone, rtol=0.0, atol=1e-12)
    assert np.abs(got[:, 4] - got[:, 5]).max() > 1e-9 and np.abs(got[:, 3] - got[:, 5]).max() > 1e-9


def test_tables_stand_lane_by_lane() -> None:
    p = machines(np.random.default_rng(0), "hydraulic", [PLACES["actuator.load adds"]], ["n_r"], [])
    lanes = np.array([6, 3, 1])
    tables = tables_of(p, 6, lanes, 8)
    assert tables.shape == (1, POINTS, 8)
    first = CURVES + CURVE_ROWS - POINTS + 1
    for j, lane in enumerate(lanes):
        assert np.array_equal(tables[0, :, j], p[first : first + POINTS, lane] if lane != 3 else np.zeros(POINTS))
    assert not tables[0, :, 3:].any()
