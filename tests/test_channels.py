"""Two channels of the controller: the requirements of docs/channels.md, their parts, and what refuses them."""

# ruff: noqa: D103 - a test's name is its claim
from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller import Calibration, load_calibration, new_state
from controller.calibration import CalibrationTable
from controller.channels import (
    FAR,
    KEPT,
    LINE_FIELDS,
    LINK,
    NEVER,
    PAIR_SCALARS,
    SEEN,
    as_channel,
    as_latch,
    as_pair,
    listen,
    new_channel,
    speak,
)
from controller.records import as_state, record
from hil import inject
from hil.calibrate.memory import Memory
from hil.fmu import write_fmu
from hil.inject.fuzz import Bench
from hil.inject.scenario import OF_CHANNELS, library, load_scenario
from hil.inject.verdict import Outcome
from hil.logs import read_log
from hil.loop.engines import lockstep_engines
from hil.loop.lanes import lockstep_lanes
from hil.loop.lockstep import Run, Stimulus, lockstep
from hil.loop.node import Node
from hil.loop.pair import COILS, seen
from plant import build_plant
from tests.test_tables import document
from tests.test_two_actuators import short_profile
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path, read
from vaneloop.cli.main import main
from vaneloop.fleet.plan import files_of_plan, group_machine, groups, load_plan, scenario_of
from vaneloop.identification.vane_chain.chain import build_chain
from vaneloop.verbs.machine import Machine

TABLE = "plant_two_actuators.toml"
MACHINE = ("--plant", TABLE, "--channels", "2")
TWO, ONE = build_plant(TABLE), build_plant()
CAL = load_calibration(channels=2)
SLOW = sorted(library().keys() - {"lvdt_jumps", "supply_lost"})  # of one channel
DEMAND = np.interp(np.arange(0.0, 6.0, 0.01), [0, 1, 3, 6], [60, 60, 90, 65])


def with_channels(**changed: float) -> Calibration:
    """The shipped calibration with other numbers (SI) of the channels."""
    of = CAL.channels
    assert of is not None
    of = of.copy()
    for name, value in changed.items():
        of[PAIR_SCALARS.index(name)] = value
    return CAL._replace(channels=of)


def outcome(name: str, calibration: Calibration = CAL) -> Outcome:
    return inject.run(name, plant=TWO, calibration=calibration)


# ---- requirements ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", library(2))
def test_a_requirement_holds(name: str) -> None:
    done = outcome(name)
    assert done.held, done.text()


@pytest.mark.parametrize(
    "name", ["lvdt_jumps", "supply_lost", *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW)]
)
def test_a_scenario_of_one_channel_holds_with_two(name: str) -> None:
    done = outcome(name)
    assert done.held, done.text()


def test_every_requirement_is_a_scenario_and_stands_in_the_docs() -> None:
    text = Path("docs/channels.md").read_text(encoding="utf-8")
    for name in library(2):
        wanted = name.upper().replace("_", "-")[:6]
        assert load_scenario(name).why.startswith(f"{wanted}: ") and f"| {wanted} | `{name}` |" in text
    assert text.count("| CHA-") == len(library(2)) >= 12


@pytest.mark.parametrize(
    ("name", "without"),
    [
        ("cha_02_lvdt_b_off", {"disagree_limit": 0.01}),  # no disagreement is seen
        ("cha_03_lvdt_a_off", {"confirm_time": 10.0}),  # no source is chosen
        ("cha_04_hysteresis", {"hysteresis": 0.0}),
        ("cha_05_link_lost", {"link_timeout": 10.0}),  # an old stroke is still used
        ("cha_06_link_late", {"link_timeout": 0.2}),
        ("cha_07_link_losses", {"link_timeout": 0.001}),
        ("cha_09_lvdt_frozen", {"rate_gain": 0.0}),  # the model thinks that nothing moves
        ("cha_11_active_off", {"takeover_time": 10.0}),  # no change-over
        ("cha_12_coil_open", {"coil_time": 10.0}),
        ("cha_13_coil_short", {"coil_limit": 1.0}),
        ("cha_15_integral_follows", {"track_time": 1e4}),
        ("cha_16_off_without_link", {"takeover_time": 10.0}),
    ],
)
def test_a_requirement_is_broken_without_the_reaction(name: str, without: dict[str, float]) -> None:
    assert not outcome(name, with_channels(**without)).held


def test_a_channel_that_comes_up_without_the_others_state_takes_the_wrong_curve(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """CHA-14 without its reaction: the caught-up flag is set beforehand."""
    w = as_channel(new_channel())
    w.caught_up = 1.0
    monkeypatch.setattr("hil.loop.pair.new_channel", lambda: np.asarray(w.base).view(np.float64).reshape(-1))
    assert not outcome("cha_14_and_back").held


# ---- link ------------------------------------------------------------------------------------------------------------


def told(delay: float = 0.0, loss: float = 0.0, ticks: int = 400) -> list[tuple[float, float]]:
    """Age (s) and content at each tick of what one channel tells the other: the number of the tick."""
    a, b, z = as_channel(new_channel()), as_channel(new_channel()), as_state(new_state())
    link, line, out = np.full((KEPT, len(LINK)), NEVER), record(LINE_FIELDS), []
    line.delay, line.loss, line.chance = delay, loss, 1.0
    for k in range(ticks):
        listen(b, link, line, k)
        out.append((float(b.age), float(b.other_x)))
        a.x_meas = float(k)
        speak(a, z, link, line, k)
    return out


@pytest.mark.parametrize("delay", [0.0, 0.005, 0.2])
def test_a_message_is_as_old_as_its_way_took(delay: float) -> None:
    ticks = 1 + round(delay * 1000.0)
    for k, (age, x) in enumerate(told(delay)):
        assert (age, x) == ((pytest.approx(ticks * 1e-3), k - ticks) if k >= ticks else (FAR, 0.0))


@pytest.mark.parametrize("loss", [0.3, 0.9, 1.0])
def test_lost_messages_make_the_last_one_older(loss: float) -> None:
    heard = told(loss=loss, ticks=4000)
    came = sum(1 for age, _ in heard if age == pytest.approx(1e-3))
    assert came / 4000 == pytest.approx(1.0 - loss, abs=0.03)
    assert all(x == k - round(age * 1000.0) for k, (age, x) in enumerate(heard) if age < FAR)


# ---- the loop --------------------------------------------------------------------------------------------------------


def run(calibration: Calibration | None = CAL, **more: Any) -> Run:
    return lockstep(Stimulus.of(DEMAND), plant=TWO, calibration=calibration, **more)


def test_two_healthy_channels_move_the_vanes_as_one() -> None:
    one, two = run(None, seed=1), run(seed=1)
    assert one.columns.keys() == two.columns.keys() and one.state_hash != two.state_hash == run(seed=1).state_hash
    assert np.array_equal(one.columns["state"], two.columns["state"])
    assert np.allclose(one.columns["x_lvdt"], two.columns["x_lvdt"], rtol=0.0, atol=0.05)
    assert np.allclose(one.columns["vigv"], two.columns["vigv"], rtol=0.0, atol=0.03)


def test_a_hash_covers_what_the_standby_remembers() -> None:
    assert run(seed=1).state_hash != run(with_channels(track_time=0.5), seed=1).state_hash


def test_lanes_and_engines_run_two_channels_alone() -> None:
    stimulus = Stimulus.of(DEMAND[:100])
    alone = lockstep(stimulus, plant=TWO, calibration=CAL)
    lanes = lockstep_lanes(stimulus, [TWO], calibrations=CAL)
    assert all(np.array_equal(v, lanes[0].columns[k]) for k, v in alone.columns.items())
    engines = lockstep_engines(stimulus, [TWO], calibrations=CAL, device="cpu")
    assert engines.stroke[0] == pytest.approx(alone.columns["x_lvdt"][-1], abs=0.05)


def ticks_of(node: Node, ticks: int, coil: str = "whole") -> np.ndarray:
    """Let a node run on without frames, one coil of A as it is said; float64[ticks, `OF_CHANNELS`]."""
    node.loop.pair.coil[0] = float(COILS.index(coil))
    nothing, out = np.zeros((1, 2), np.int64), []
    for _ in range(ticks):
        node.tick(nothing, 0)
        out.append([*seen(node.loop.pair), node.loop.given.i_cmd * 1e3])
    return np.array(out)


@pytest.mark.parametrize("both", [0.0, 1.0])
def test_with_both_driving_each_sends_half_until_a_coil_is_wrong(both: float) -> None:
    node = Node(TWO, with_channels(both=both), n_r=80.0)
    i_a, i_b, i = (OF_CHANNELS.index(name) for name in ("i_a", "i_b", "i_coils"))
    ticks_of(node, 60)
    for z in node.loop.pair.z:
        as_state(z).integral = 8e-3  # A: something to send
    healthy = ticks_of(node, 3)
    assert np.allclose(healthy[:, i], healthy[:, i_a] + healthy[:, i_b])
    assert (np.abs(healthy[:, i_a]) > 0.5).all()
    assert np.allclose(healthy[:, i_b], both * healthy[:, i_a], rtol=0.1, atol=0.02)
    ticks_of(node, 5, "open")
    failed = ticks_of(node, 10, "open")
    assert (failed[3:, i_a] == 0.0).all() and (failed[3:, i] == failed[3:, i_b]).all()
    assert as_latch(node.loop.pair.latch).in_charge == 1.0


# ---- tables and commands ---------------------------------------------------------------------------------------------


def test_what_stands_in_the_table_is_flashed_in_si() -> None:
    assert CAL.channels is not None and load_calibration().channels is None
    k, table = as_pair(CAL.channels), read("calibration.toml", CalibrationTable).channels
    assert k.disagree_limit == pytest.approx(table.disagree_limit.value * 1e-3)
    assert k.rate_gain == table.rate_gain.value and k.coil_limit == pytest.approx(1e-3) and k.both == 0.0
    p = TWO.table.actuator, TWO.table.valve  # type: ignore[union-attr]
    assert k.rate_gain == pytest.approx(p[0].flow_gain.value / (p[1].rated_current.value * 1e-3))


def tables(folder: Path, **changed: Any) -> Path:
    """A folder with the shipped calibration and other entries in its section [channels]."""
    data = tomllib.loads(path("calibration.toml").read_text(encoding="utf-8"))
    for key, value in changed.items():
        data["channels"][key] = value if isinstance(value, str) else data["channels"][key] | {"value": value}
    (folder / "calibration.toml").write_text(document(data), encoding="utf-8")
    return folder


def test_a_table_that_says_nothing_of_channels_has_one(tmp_path: Path) -> None:
    text = path("calibration.toml").read_text(encoding="utf-8")
    (tmp_path / "old.toml").write_text(text[: text.index("[channels]")], encoding="utf-8")
    assert load_calibration(tmp_path / "old.toml").channels is None
    two = load_calibration(tmp_path / "old.toml", channels=2).channels
    assert two is not None and np.array_equal(two, CAL.channels)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"number": 3.0}, "number (=3 -) must be in [1, 2]"),
        ({"number": 1.5}, "number (=1.5) must be 1 or 2"),
        ({"drive": "none"}, "drive (='none') must be one of one, both"),
        ({"hysteresis": 0.6}, "hysteresis (=0.6 mm) must be below disagree_limit (=0.6 mm)"),
        ({"link_timeout": 0.3}, "link_timeout (=0.3 s) must be in [0.001, 0.2]"),
        ({"model_time": 0.0}, "model_time (=0 s) must be in [0.005, 10]"),
    ],
)
def test_a_wrong_number_of_channels_is_refused_in_one_line(tmp_path: Path, changed: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError) as e:
        load_calibration(tables(tmp_path, **changed) / "calibration.toml")
    assert said in str(e.value) and "\n" not in str(e.value)


LOG = str(Path("examples/engine_run.blf").resolve())
REFUSED = {
    "run": ("--bus", "local", "--plant", TABLE),
    "fuzz": ("--frames", "1000", "--plant", TABLE),
    "a2l": ("--out", "x.a2l", "--plant", TABLE),
    "diagnose": (LOG,),
    "locate": (LOG,),
    "learn": (LOG,),
    "export-fmu": ("--part", "loop", "--out", "x.fmu"),
    "fleet": ("run", LOG, "--out", "run"),
    "web": ("--no-open",),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_command_that_cannot_take_two_channels_says_so_in_one_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tables").mkdir()
    folder = tables(tmp_path / "tables", number=2.0)
    monkeypatch.chdir(tmp_path)
    assert main([name, *REFUSED[name], "--tables", str(folder)]) == 2
    said = capsys.readouterr().err.strip()
    assert "channels.number (=2) must be 1 for " in said and "\n" not in said
    assert [f.name for f in tmp_path.iterdir()] == ["tables"]


def test_the_library_refuses_what_the_commands_refuse(tmp_path: Path) -> None:
    table = read("calibration.toml", CalibrationTable)
    for refused in (
        lambda: write_fmu(tmp_path / "x.fmu", "loop", ONE, CAL, table),
        lambda: build_chain(read_log("examples/hidden_effect.parquet"), ONE, CAL),
        lambda: Bench(plant=TWO, calibration=CAL),
        lambda: Memory(Node(TWO, CAL)),
        lambda: Machine(table=TABLE, controller="mine.so", channels=2).calibration,
    ):
        with pytest.raises(InputError, match=r"channels\.number \(=2\) must be 1 for "):
            refused()
    with pytest.raises(InputError, match=r"channels\.number \(=2\) needs two actuators"):
        lockstep(Stimulus.of(DEMAND[:10]), plant=ONE, calibration=CAL)


@pytest.mark.parametrize(
    "words",
    [
        ("replay", LOG, *MACHINE),
        ("run", "--bus", "lockstep", "--duration", "1", *MACHINE),
        ("inject", "cha_19_ecu_silent", "demand_stops", *MACHINE),
    ],
)
def test_a_command_that_simulates_takes_two_channels(words: tuple[str, ...]) -> None:
    assert main(list(words)) == 0


def test_the_engine_test_takes_two_channels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    profile, said = short_profile(tmp_path), []
    for more in (MACHINE, MACHINE[:2]):
        assert main(["engine-test", *more, "--profile", str(profile), "--json", str(tmp_path / "x.json")]) in (0, 1)
        said.append((tmp_path / "x.json").read_text(encoding="utf-8"))
    capsys.readouterr()
    assert said[0] != said[1]


def test_a_campaign_takes_two_channels_from_a_calibration(tmp_path: Path) -> None:
    (tmp_path / "TWO").mkdir()
    tables(tmp_path / "TWO", number=2.0)
    (tmp_path / "plan.toml").write_text(
        'title = "Two channels"\nscenarios = ["cha_11_active_off"]\nsamples = 8\n'
        f'plant = "{TABLE}"\n[vary]\n"actuator.flow_gain" = "tolerance"\n'
        '[[calibration]]\nname = "two"\ntables = "TWO"\n'
    )
    plan = load_plan(tmp_path / "plan.toml")
    files, (group,) = files_of_plan(plan), groups(plan)
    machine = group_machine(files, group)
    done = inject.run(scenario_of(files, group), plant=machine.plant, calibration=machine.calibration)
    assert done.held, done.text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("cha_05_link_lost",), "is about two channels of the controller: --channels 2 --plant"),
        (("cha_05_link_lost", "--plant", TABLE), "is about two channels of the controller"),
        (("nominal", "--channels", "2"), "channels.number (=2) needs two actuators; the plant table's"),
        (("flood_low_priority", "--bus", "local", "--channels", "2"), "--channels is for --bus lockstep"),
    ],
)
def test_a_scenario_on_another_machine_is_refused(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inject", *words]) == 2
    told = capsys.readouterr().err.strip()
    assert said in told and "\n" not in told


@pytest.mark.parametrize(
    ("action", "said"),
    [
        ('action = "link"', "link takes delay or loss"),
        ('action = "link"\ndelay = 0.3', "inject.0.link.delay (=0.3)"),
        ('action = "channel"\nchannel = "C"\nfault = "off"', "inject.0.channel.channel (='C')"),
        ('action = "channel"\nchannel = "A"\nfault = "on"', "inject.0.channel.fault (='on')"),
        ('action = "machine"\np_s = 1.0\nside = "a"', "side needs an effect"),
    ],
)
def test_a_wrong_action_on_channels_is_refused(tmp_path: Path, action: str, said: str) -> None:
    file = tmp_path / "x.toml"
    file.write_text(f'title = "for a test"\nduration = 1.0\n[[inject]]\n{action}\n')
    with pytest.raises(InputError) as e:
        load_scenario(file)
    assert said in str(e.value) and "\n" not in str(e.value)


def test_an_effect_that_is_not_of_one_side_is_refused(tmp_path: Path) -> None:
    for text in (
        "[side_b.effects.aero_load]\nforce = 1.0\n",
        '[[inject]]\naction = "machine"\nside = "b"\neffect = "aero_load"\n',
    ):
        (tmp_path / "x.toml").write_text(f'title = "for a test"\nduration = 0.1\n{text}')
        with pytest.raises(InputError, match="side_b: 'aero_load' is not of one side"):
            inject.run(tmp_path / "x.toml", plant=TWO)
        with pytest.raises(InputError, match="is about one of two actuators"):
            inject.run(tmp_path / "x.toml", plant=ONE)


def test_what_is_seen_of_channels_has_a_name_each() -> None:
    assert len(seen(Node(TWO, CAL).loop.pair)) == len(SEEN) and (*SEEN, "i_coils") == OF_CHANNELS
