"""The one tick of the closed loop: every effect of the library acts in it, whoever runs it, and by the same amount."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from controller import load_calibration
from hil.bus import frames
from hil.bus.frames import ECU_DEMAND
from hil.bus.lockstep_bus import run_lockstep
from hil.inject import Machine, Scenario
from hil.inject import injection as inject
from hil.inject.on_lockstep import MachineChange
from hil.logs import Channel, Log
from hil.loop.lockstep import Stimulus, advance, columns_of, lockstep
from hil.loop.node import Ecu, Node
from hil.loop.node import replay as repeat
from hil.loop.tick import arrive, new_loop
from hil.replay import replay
from plant import Model, Plant, build_plant
from plant.effect import MOTOR, PAIR
from plant.effects import EFFECTS
from tests.effect_table import EXAMPLES
from vaneloop.base.vanes import VANES

# a gross size of each effect, in declared units
GROSS = {name: example.gross for name, example in EXAMPLES.items()}
ALONE = [name for name, e in EFFECTS.items() if e.kinds != PAIR]  # those of a pair: tests/test_two_actuators.py
ELECTRIC = {name for name, e in EFFECTS.items() if e.kinds == MOTOR}


def nominal(*names: str) -> Plant:
    """The nominal machine that can have these effects."""
    return build_plant("plant_electromechanical.toml" if ELECTRIC & set(names) else "plant.toml")


LOADED = ("piston_stiction", "internal_leakage", "oil_compressibility")  # show under a load only
T_OIL = 80.0  # degC, so that what grows with heat shows
POINTS = [
    [0.0, 45.0],
    [0.5, 45.0],
    [0.6, 60.0],
    [1.6, 62.0],
    [1.9, 57.0],
    [2.5, 59.0],
    [3.0, 59.0],
]  # s, %: a slam, ramps, two reversals
SECONDS = 3.0
DEMAND = np.interp(np.arange(0.0, SECONDS, 0.01), *np.array(POINTS).T)
SHOWN = ("x_dem", "x_lvdt", "i_cmd", "vigv", "vgv1", "vgv2", "n_r")
# border units, several steps of the frames: what two runs that act alike may differ by, and the least that a gross
# effect moves
LEAST = {"x_dem": 0.01, "x_lvdt": 0.02, "i_cmd": 0.1, "vigv": 0.01, "vgv1": 0.01, "vgv2": 0.01, "n_r": 0.01}

Curves = dict[str, np.ndarray]


def machine(*names: str) -> Plant:
    """The nominal machine with these effects at their gross sizes."""
    return Model(effects={name: GROSS[name] for name in names}).plant(nominal(*names)) if names else build_plant()


def in_lockstep(plant: Plant, names: tuple[str, ...]) -> tuple[str, Curves]:
    run = lockstep(Stimulus.of(DEMAND, t_oil=T_OIL), plant=plant)
    return run.state_hash, {s: run.columns[s] for s in SHOWN}


def on_the_bus(plant: Plant, names: tuple[str, ...]) -> tuple[str, Curves]:
    """Controller and ECU as nodes; what they say in frames."""
    node, ecu = Node(plant, n_r=DEMAND[0], t_oil=T_OIL), Ecu(plant, n_dem=DEMAND[0])
    run = run_lockstep(DEMAND, vgv=node, ecu=ecu)
    words = {
        ident: [frames.decode(*row) for row in run.rows.tolist() if row[0] & frames.IDENT_MASK == ident]
        for ident in frames.NAMES
    }
    of = {s: i for i, (_, signals) in frames.FRAMES.items() for s in signals}
    taken = run.rows[:, 0] & frames.IDENT_MASK == ECU_DEMAND
    again = Node(plant, n_r=DEMAND[0], t_oil=T_OIL)
    at = -(-np.rint(run.t[taken] * 500e3).astype(np.int64) // 500)
    use = at < node.k
    repeat(again, at[use], run.rows[taken][use], node.k)
    assert again.fingerprint() == node.fingerprint()  # a recorded run repeats, whatever the machine is like
    return hashlib.sha256(run.rows.tobytes()).hexdigest(), {s: np.array([v[s] for v in words[of[s]]]) for s in SHOWN}


def replayed(plant: Plant, names: tuple[str, ...]) -> tuple[str, Curves]:
    t = np.arange(len(DEMAND)) * 0.01
    log = Log("made", {"n_dem": Channel(t, DEMAND), "t_oil": Channel(t, np.full(len(t), T_OIL))}, [])
    result = replay(log, plant=plant)
    return result.state_hash, {s: result.model[s] for s in SHOWN}


def injected(plant: Plant, names: tuple[str, ...]) -> tuple[str, Curves]:
    """The nominal machine, which an action of a scenario changes at power-on."""
    actions = [Machine(effect=name, parameters=GROSS[name]) for name in names]
    outcome = inject.run(
        Scenario(title="made", duration=SECONDS, demand=POINTS, seed=3, inject=[Machine(t_oil=T_OIL), *actions]),
        plant=nominal(*names) if names else plant,
    )
    return str(outcome.state_hash), {s: outcome.trace.signals[s] for s in SHOWN}


WAYS = {"lockstep": in_lockstep, "node": on_the_bus, "replay": replayed, "injection": injected}


@pytest.fixture(scope="module", params=WAYS)
def way(request: pytest.FixtureRequest):
    """A way to run the loop, and its runs without an effect and under load alone."""
    run = WAYS[request.param]
    electric = run(nominal(*ELECTRIC), ())
    return request.param, run, run(machine(), ()), run(machine("aero_load"), ("aero_load",)), electric


@pytest.mark.parametrize("name", ALONE)
def test_every_effect_acts_in_lockstep_node_replay_and_injection_alike(way, name: str) -> None:
    called, run, plain, loaded, electric = way
    under = ("aero_load",) if name in LOADED else ()
    state_hash, curves = run(machine(*under, name), (*under, name))
    without = loaded if under else electric if name in ELECTRIC else plain
    assert state_hash != without[0], f"{name} changes nothing in {called}"
    moved = {s: float(np.abs(curves[s] - without[1][s]).max()) for s in SHOWN}
    assert any(moved[s] > LEAST[s] for s in SHOWN), f"{name} moves nothing in {called}: {moved}"


def raw(percent: np.ndarray) -> np.ndarray:
    """Speeds as a frame carries them."""
    return np.array([frames.decode_demand(frames.encode_demand(v, v, 1, 0))[0] for v in percent])


@pytest.mark.parametrize("name", ALONE)
def test_an_effect_acts_by_the_same_amount_in_lockstep_and_node_bit_for_bit(name: str) -> None:
    plant = machine("aero_load", name) if name in LOADED else machine(name)
    demand = raw(DEMAND)
    stimulus = Stimulus.of(demand, demand, t_oil=T_OIL)
    stimulus.rows[0, 4] = 0.0  # a node's first frame only shows the counter
    ticks = 10 * len(demand)
    noise = np.random.Generator(np.random.PCG64(4)).standard_normal((ticks, 5))
    loop = new_loop(plant, load_calibration(), n_engine=demand[0], n_r=demand[0], t_oil=T_OIL, noisy=True)
    advance(0, ticks, stimulus.rows, noise, loop, 10, np.empty((0, len(columns_of(VANES[:3])))), np.empty((0, 0)))
    node = Node(plant, n_r=demand[0], t_oil=T_OIL, seed=4)
    at = np.arange(0, ticks, 10)
    rows = np.array(
        [[frames.word0(ECU_DEMAND), frames.encode_demand(v, v, 1, k % 15)] for k, v in enumerate(demand)], np.int64
    )
    repeat(node, at, rows, ticks)
    assert np.array_equal(node.loop.z, loop.z)
    assert np.array_equal(node.loop.s, loop.s)


@pytest.mark.parametrize("name", [n for n in ALONE if n not in LOADED])
def test_an_effect_injected_at_power_on_is_the_effect_in_the_machine(name: str) -> None:
    made = machine(name)
    fixed, changed = Node(made, n_r=60.0, t_oil=T_OIL), Node(nominal(name), n_r=60.0, t_oil=T_OIL)
    engines = Ecu(made), Ecu(nominal(name))
    change = MachineChange(Machine(effect=name, parameters=GROSS[name]), changed, engines[1])
    change.tick(0)
    assert np.array_equal(changed.loop.p, fixed.loop.p) and np.array_equal(engines[1].arrays.p, engines[0].arrays.p)
    for node in (fixed, changed):
        node.loop.s[:] = 0.0  # a machine that has the effect from the start may stand elsewhere
        repeat(node, np.empty(0), np.empty((0, 2)), 1)
    assert np.array_equal(fixed.loop.calibration.k, changed.loop.calibration.k)
    assert np.array_equal(fixed.loop.calibration.table, changed.loop.calibration.table)
    assert fixed.fingerprint() == changed.fingerprint()


def test_an_effect_that_ends_leaves_the_calibration_as_it_was() -> None:
    node, ecu = Node(), Ecu()
    before = node.loop.calibration.k.copy(), node.loop.calibration.table.copy()
    wrong = Machine(effect="schedule_error", parameters={"offset": 1.0}, duration=0.02)
    change, seen = MachineChange(wrong, node, ecu), []
    for k in range(40):
        change.tick(k)
        node.tick(np.zeros((0, 2), np.int64))
        seen.append(float(node.loop.calibration.table[1, 0] - before[1][1, 0]))
    assert seen == [pytest.approx(1e-3)] * 20 + [0.0] * 20
    assert np.array_equal(node.loop.calibration.k, before[0]) and np.array_equal(node.loop.calibration.table, before[1])


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if e.states])
def test_an_effect_with_a_memory_that_begins_later_makes_no_jump(name: str) -> None:
    """Injected into a piston that has come far from where it was at power-on and stands."""
    sizes = {q: v * 1e-9 for q, v in GROSS[name].items()}  # next to nothing: what jumps is not the effect
    action = Machine(effect=name, parameters=sizes, start=2.5)
    made = {"duration": 2.6, "demand": [[0.0, 60.0], [1.0, 90.0], [2.6, 90.0]], "seed": 3}
    one, other = (
        inject.run(Scenario(title="made", inject=actions, **made), plant=nominal(name)).trace
        for actions in ([], [action])
    )
    assert one.signals["x_lvdt"][-1] - one.signals["x_lvdt"][0] > 8.0
    for s in SHOWN:
        assert np.abs(one.signals[s] - other.signals[s]).max() < 1e-3, s


@pytest.mark.parametrize(("delay", "period"), [(0.083, 0.0), (0.0, 0.055), (0.3, 0.4), (1.0, 1.0)])
def test_a_demand_arrives_with_the_age_that_delay_and_hold_give_it(delay: float, period: float) -> None:
    plant = Model(effects={"can_delay": {"delay": delay}, "frame_hold": {"period": period}}).plant()
    node = Node(plant)
    a = node.loop
    for j in range(700):
        arrive(10 * j, a, j * 0.1, j * 0.05, 1.0)
        t = 0.01 * j
        content = t - delay
        if period:
            content = np.floor((content + 1e-6) / period) * period
        frame = max(int(np.floor(content / 0.01 + 1e-6)), 0)
        assert (a.fed.n_dem, a.fed.n_r) == (frame * 0.1, frame * 0.05)


def test_a_late_demand_after_a_gap_is_the_last_that_came_before_it() -> None:
    node = Node(Model(effects={"can_delay": {"delay": 0.1}}).plant())
    came = [j for j in range(200) if not 40 <= j < 55 and j % 7]
    for j in came:
        arrive(10 * j + 3, node.loop, float(j), float(j), 1.0)
        assert node.loop.fed.n_dem == max([i for i in came if i <= j - 10], default=came[0])
