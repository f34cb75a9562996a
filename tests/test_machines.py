"""Machines with one to eight vane stages: the same equations, frames, logs and search for every number of them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cantools
import e2e.p01
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.records import STATE, state_rows
from hil.bus import frames
from hil.bus.frames import VGV_ANGLES, VGV_ANGLES_2, VGV_ANGLES_3, VGV_HEALTH, VGV_SERVO, VGV_STATUS
from hil.logs import Channel, LogError, read_log, write_log
from hil.logs.formats import FORMATS
from hil.loop.lockstep import Stimulus, lockstep, snapshot_names
from hil.loop.node import Ecu, Node
from plant import Model, build_plant, chain, load_geometry
from plant.effects import EFFECTS, ROW
from plant.geometry import vane_angles
from tests import rig
from tests.conftest import ROOT
from tests.firmware_on_rig import firmware
from tests.machines import geometry_of, machine, write_machine
from vaneloop import Machine, diagnose
from vaneloop.base import tables
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import MOST, VANES, own_rows, vane_in, vanes_of
from vaneloop.cli.main import main

NONE = np.empty((0, 2), np.int64)
COUNTS = range(1, MOST + 1)
DEMAND = np.interp(np.arange(0.0, 12.0, 0.01), [0, 2, 5, 7, 10], [60, 60, 84, 84, 66])
STIMULUS = Stimulus.of(DEMAND)
DEG = math.pi / 180.0


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Function n -> (plant, calibration) of a machine with n stages, and n -> its folder."""
    folder = tmp_path_factory.mktemp("machines")
    kept: dict[tuple[int, str | None], Any] = {}

    def of(stages: int, strategy: str | None = None) -> Any:
        if (stages, strategy) not in kept:
            kept[stages, strategy] = machine(folder / str(stages), stages, strategy)
        return kept[stages, strategy]

    of.folder = lambda stages: (of(stages), folder / str(stages))[1]  # type: ignore[attr-defined]
    return of


# ---- names -----------------------------------------------------------------------------------------------------------


@given(st.sets(st.sampled_from(VANES)))
def test_stages_are_the_first_ones_without_a_gap(present: set[str]) -> None:
    own = tuple(v for v in VANES if v in present)
    if own and own == VANES[: len(own)]:
        assert vanes_of(present) == own
    else:
        with pytest.raises(ValueError, match="is missing"):
            vanes_of(present)


@pytest.mark.parametrize("n", COUNTS)
def test_the_state_of_a_machine_has_no_number_of_a_stage_that_it_lacks(n: int) -> None:
    own, other = VANES[:n], VANES[n:]
    for names, rows in ((STATE, state_rows(n)), (chain.STATE, own_rows(chain.STATE, own))):
        kept = [names[i] for i in rows]
        assert sorted(rows) == list(rows)
        assert not any(vane_in(name) in other for name in kept)
        assert {vane_in(name) for name in kept} - {None} == set(own)
        assert len(names) - len(kept) == (MOST - n) * sum(vane_in(name) == "vigv" for name in names)


# ---- plant and loop --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strategy", ["dual", "adaptive"])
def test_the_vigv_does_not_depend_on_how_many_stages_follow_it(made: Any, strategy: str) -> None:
    kept = []
    for n in COUNTS:
        plant, calibration = made(n, strategy)
        run = lockstep(STIMULUS, plant=plant, calibration=calibration)
        assert run.faults == 0 and tuple(v for v in VANES if v in run.columns) == VANES[:n]
        kept.append(run)
    for name in ("x_dem", "x_lvdt", "i_cmd", "n_engine", "vigv"):
        assert all(np.array_equal(run.columns[name], kept[0].columns[name]) for run in kept), name
    for k, name in enumerate(VANES):  # nor any stage on those behind it
        assert all(np.array_equal(run.columns[name], kept[-1].columns[name]) for run in kept[k:]), name
    assert len({run.state_hash for run in kept}) == MOST


def test_the_state_of_the_first_stages_is_hashed_in_the_same_order_whatever_follows(made: Any) -> None:
    seen: dict[int, np.ndarray] = {}
    for n in (2, 5):
        plant, calibration = made(n)
        rows: list[np.ndarray] = []
        lockstep(
            STIMULUS, plant=plant, calibration=calibration, duration=1.0, watch=lambda s, r=rows: r.append(s.copy())
        )
        seen[n] = rows[0]
    names = snapshot_names(made(5)[0])
    common = [i for i, name in enumerate(names) if vane_in(name) in (None, *VANES[:2])]
    assert [names[i] for i in common] == snapshot_names(made(2)[0])
    assert np.array_equal(seen[5][:, common], seen[2])


def test_a_machine_of_three_has_the_hash_that_it_had() -> None:
    """Of the release before machines could have another number of stages."""
    demand = np.interp(np.arange(0, 60, 0.01), [0, 20, 40, 60], [60, 90, 70, 95])
    run = lockstep(Stimulus.of(demand), seed=3)
    assert run.state_hash == "9d829be0151fb04366f8a1f3f8e29503fa9a02f0359b08c2383ffc3bbf6b4f78"


@settings(max_examples=15, deadline=None)
@given(n=st.integers(1, MOST), scale=st.floats(0.8, 0.95), stroke=st.floats(0.0, 48e-3))
def test_every_stage_follows_its_own_linkage(n: int, scale: float, stroke: float) -> None:
    geometry = geometry_of(n, scale)
    angles = vane_angles([stroke], geometry)
    assert angles.shape == (1, n)
    for k, name in enumerate(geometry.vanes):  # the same stage alone behind the same crank
        alone = geometry.model_copy(update={"vigv": geometry.stage(name), **dict.fromkeys(VANES[1:])})
        assert vane_angles([stroke], alone)[0, 0] == angles[0, k]


@pytest.mark.parametrize("n", [1, 4, 8])
def test_an_effect_at_the_last_stage_moves_that_stage_alone(made: Any, n: int) -> None:
    plant, calibration = made(n)
    last = VANES[n - 1]
    worn = Model(effects={"pot_bias": {last: 0.5}}).plant(plant)
    runs = [lockstep(STIMULUS, plant=p, calibration=calibration, hashed=False).columns for p in (plant, worn)]
    off = {v: runs[1][v] - runs[0][v] for v in plant.vanes}
    assert off.pop(last)[100:] == pytest.approx(0.5, abs=1e-9)
    assert all((v == 0.0).all() for v in off.values())


def test_a_machine_has_the_parameters_of_its_own_stages(made: Any) -> None:
    plant, _ = made(2)
    assert plant.parameters_of("pot_lag") == {ROW["pot_lag"] + k: EFFECTS["pot_lag"][VANES[k]] for k in range(2)}
    assert [p.name for p in plant.parameters_of("linkage_friction").values()] == ["vigv", "vgv1", "distance"]
    play = plant.parameters_of("linkage_backlash")
    assert [p.low for p in play.values()] == [-1.6, -1.1]  # no less than none: the tables' hysteresis


# ---- bus -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def db() -> Any:
    return cantools.database.load_file(tables.path("vgv.dbc"))


@pytest.mark.parametrize("n", COUNTS)
def test_a_machine_sends_the_angles_of_its_stages_and_no_others(made: Any, db: Any, n: int) -> None:
    plant, calibration = made(n)
    node, ecu = Node(plant, calibration), Ecu(plant)
    heard: dict[int, int] = {}
    sent = NONE
    for _ in range(130):
        asked = ecu.tick(sent)
        sent = node.tick(asked).copy()
        heard |= {int(head) & frames.IDENT_MASK: int(data) for head, data in sent}
    angle_frames = [VGV_ANGLES, VGV_ANGLES_2, VGV_ANGLES_3][: -(-n // 3)]
    assert set(heard) == {VGV_STATUS, VGV_SERVO, VGV_HEALTH, *angle_frames}
    for ident in angle_frames:
        raw = heard[ident].to_bytes(8, "little", signed=True)
        assert e2e.p01.e2e_p01_check(bytearray(raw), 0x5600 + ident)
        message = db.get_message_by_frame_id(ident)
        numbers = message.decode(raw, decode_choices=False, scaling=False)
        for name in (s.name for s in message.signals if s.name in VANES):
            k = VANES.index(name)
            if k < n:
                assert numbers[name] * 0.002 == pytest.approx(node.loop.angles[k] / DEG, abs=0.0011)
            else:
                assert numbers[name] == -32768  # not available
    assert {v for v in VANES if not math.isnan(ecu.values.get(v, math.nan))} == set(VANES[:n])
    assert ecu.stale() == []


def test_an_ecu_misses_the_further_angles_only_of_a_machine_that_has_them(made: Any) -> None:
    for n, missed in ((3, []), (4, ["VGV_ANGLES_2"]), (8, ["VGV_ANGLES_2", "VGV_ANGLES_3"])):
        ecu = Ecu(made(n)[0])
        for _ in range(60):
            ecu.tick(NONE)
        assert ecu.stale() == ["VGV_STATUS", "VGV_SERVO", "VGV_ANGLES", *missed]


def test_frames_under_an_identifier_that_only_greater_machines_use_are_others(made: Any) -> None:
    frame = np.array([[frames.word0(VGV_ANGLES_2), 0]], np.int64)
    for n, kind in ((3, "other"), (4, "own_identifier")):
        node = Node(*made(n))
        node.tick(frame)
        assert node.counts[kind] == 1


# ---- logs ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 4, 8])
@pytest.mark.parametrize("suffix", FORMATS)
def test_logs_of_every_format_hold_the_machine_s_stages(
    made: Any, tmp_path: Path, suffix: str, n: int, quick_mdf: None
) -> None:
    plant, calibration = made(n)
    columns = lockstep(STIMULUS, plant=plant, calibration=calibration, duration=2.0, hashed=False).columns
    given = {k: Channel(columns["t"], v) for k, v in columns.items() if k not in ("t", "n_engine")}
    write_log(tmp_path / f"a{suffix}", given)
    log = read_log(tmp_path / f"a{suffix}")
    assert [v for v in VANES if v in log.channels] == list(VANES[:n])
    assert not [note for note in log.notes if "vgv" in note]
    for v in VANES[:n]:
        got = log.channels[v]
        assert np.abs(got.values - np.interp(got.t, columns["t"], columns[v])).max() < 0.0021


def test_a_log_has_no_ninth_stage(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="'vgv8' is not a signal"):
        write_log(tmp_path / "a.csv", {"vgv8": Channel(np.arange(3.0), np.zeros(3))})


# ---- commands --------------------------------------------------------------------------------------------------------


def answer(*words: str) -> Any:
    """What a command says in JSON."""
    out = Path(words[-1])
    assert main([*words[:-1], "--quiet", "--json", str(out)]) in (0, 1)
    return json.loads(out.read_text(encoding="utf-8"))


@pytest.mark.parametrize("n", [pytest.param(1, marks=pytest.mark.slow), 8])
def test_a_run_is_recorded_repeated_and_replayed(made: Any, tmp_path: Path, n: int) -> None:
    folder, out = str(made.folder(n)), str(tmp_path / "out.json")
    record, page = str(tmp_path / "run.parquet"), tmp_path / "replay.html"
    run = ("run", "--bus", "lockstep", "--tables", folder)
    answer(*run, "--profile", "step", "--duration", "3", "--record", record, out)
    assert answer(*run, "--inputs", record, out)["same"]
    replayed = answer("replay", record, "--tables", folder, "--report", str(page), out)
    assert [s["signal"] for s in replayed["signals"] if s["reference"] == "schedule"] == list(VANES[:n])
    assert f"{VANES[n - 1].upper()} angle" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("n", [1, 8])
def test_the_commands_about_the_mechanism_take_its_tables(made: Any, tmp_path: Path, n: int) -> None:
    folder, out = made.folder(n), str(tmp_path / "out.json")
    geometry = ("--geometry", str(folder / "geometry.toml"))
    targets = ("--schedules", str(folder / "schedules.toml"))
    page, tables_out = tmp_path / "page.html", tmp_path / "tables"
    scheduled = answer(
        "schedule", *geometry, *targets, "--adjust", "none", "--report", str(page), "--out", str(tables_out), out
    )
    assert [s["stage"] for s in scheduled["stages"]] == list(VANES[:n])
    assert max(s["rms"]["built"] for s in scheduled["stages"]) < 0.01  # targets are those of the linkage
    assert Machine(tables=tables_out).plant.vanes == VANES[:n]  # what it writes is a machine
    spatial = answer("spatial", *geometry, "--points", "3", "--report", str(page), out)
    assert [s["stage"] for s in spatial["stages"]] == list(VANES[:n])
    tested = answer(
        "engine-test", "--tables", str(folder), "--profile", str(short_test(tmp_path)), "--report", str(page), out
    )
    assert [s["signal"] for s in tested["dual"]["signals"]] == list(VANES[:n])
    injected = answer("inject", "demand_gap_40ms", "--tables", str(folder), out)
    assert injected["held"]


def short_test(folder: Path) -> Path:
    """An engine test of some seconds."""
    chosen = 'origin = "chosen: short"'
    axes = (("speed", "%", [80.0, 70.0]), ("rate", "%/s", [10.0, 10.0]), ("dwell", "s", [1.0, 1.0]))
    lines = [f'start = {{ value = 70.0, unit = "%", {chosen} }}']
    lines += [f'[{name}]\nunit = "{unit}"\n{chosen}\nvalues = {values}' for name, unit, values in axes]
    path = folder / "short.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_clearance_tells_the_stages_of_one(made: Any, tmp_path: Path) -> None:
    geometry = str(made.folder(1) / "geometry.toml")
    told = answer("clearance", "--geometry", geometry, "--report", str(tmp_path / "c.html"), str(tmp_path / "out.json"))
    assert [s["stage"] for s in told["stages"]] == ["vigv"]


# ---- bad tables ------------------------------------------------------------------------------------------------------


def refused(*words: str) -> str:
    """The one line with which a command refuses."""
    import contextlib
    import io

    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        assert main([*words, "--quiet"]) == 2
    assert said.getvalue().count("\n") == 1
    return said.getvalue()


RUN = ("run", "--bus", "lockstep", "--duration", "1", "--tables")


def test_tables_of_different_stages_are_refused_in_one_line(tmp_path: Path) -> None:
    for name, other in (("schedules", "schedules.toml"), ("vane_angles", "vane_angles.toml")):
        folder = write_machine(tmp_path / name, 4)
        write_machine(tmp_path / "five", 5)
        (folder / other).write_text((tmp_path / "five" / other).read_text(encoding="utf-8"), encoding="utf-8")
        line = refused(*RUN, str(folder))
        assert other in line and "vgv4" in line and "geometry.toml" in line
        (folder / other).unlink()  # the shipped one has three
        assert other in refused(*RUN, str(folder))


@pytest.mark.parametrize(
    ("was", "now", "says"),
    [
        ("[vgv1]", "[vgv5]", "vgv1 is missing, but vgv5 is there"),
        ("[vigv]", "[vgv5]", "key 'vigv' is missing"),
        ("[vgv3]", "[vgv8]", "key 'vgv8' is unknown"),
        (
            "[vgv3]\nlb = ",
            "[vgv3]\nlbb = ",
            "key 'vgv3.lbb' is unknown, probably 'lb' is meant; allowed here: lb, lb_initial",
        ),
    ],
)
def test_a_geometry_with_a_gap_or_a_strange_stage_is_refused(tmp_path: Path, was: str, now: str, says: str) -> None:
    text = (write_machine(tmp_path, 4) / "geometry.toml").read_text(encoding="utf-8")
    assert was in text
    (tmp_path / "geometry.toml").write_text(text.replace(was, now), encoding="utf-8")
    with pytest.raises(InputError) as e:
        load_geometry(tmp_path / "geometry.toml")
    assert says in str(e.value) and "\n" not in str(e.value)


def test_angles_and_play_of_a_stage_belong_together(tmp_path: Path) -> None:
    file = write_machine(tmp_path, 2) / "vane_angles.toml"
    lines = file.read_text(encoding="utf-8").splitlines()
    file.write_text("\n".join(x for x in lines if not x.startswith("play_vgv1")), encoding="utf-8")
    assert "vgv1 and play_vgv1 belong together" in refused(*RUN, str(tmp_path))


@pytest.mark.parametrize(
    "text", ["[effects.linkage_backlash]\nvgv3 = 0.3\n", '[parameters]\n"linkage.vgv3_play" = 0.7\n']
)
def test_a_model_of_a_stage_that_the_machine_lacks_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "m.toml").write_text(text, encoding="utf-8")
    line = refused("run", "--bus", "lockstep", "--duration", "1", "--model", str(tmp_path / "m.toml"))
    assert "is of a vane row that this machine lacks (vgv3)" in line


def test_no_more_play_can_be_taken_away_than_there_is(made: Any) -> None:
    plant, _ = made(4)
    least = -plant.geometry.vgv3.hysteresis.value
    Model(effects={"linkage_backlash": {"vgv3": least}}).plant(plant)
    with pytest.raises(InputError, match=r"linkage_backlash.vgv3 .* must be in"):
        Model(effects={"linkage_backlash": {"vgv3": 1.01 * least}}).plant(plant)


# ---- diagnosis -------------------------------------------------------------------------------------------------------


def worn(folder: Path, hidden: list[rig.Hidden], seconds: float = 90.0) -> Any:
    """A log of the rig's machine with these tables."""
    from controller import load_calibration
    from hil.logs import Log

    geometry = rig.load_geometry(folder)
    controller = firmware(load_calibration(angles=folder / "vane_angles.toml"))
    run = rig.simulate(rig.manoeuvre(3, seconds), controller, hidden, seed=11, geometry=geometry)
    return Log("rig", {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"})


@pytest.mark.slow
@pytest.mark.parametrize(("n", "stage"), [(1, 0), (4, 3), (8, 6)])
def test_the_rig_s_wear_is_named_with_its_stage(made: Any, n: int, stage: int) -> None:
    folder = made.folder(n)
    log = worn(folder, [rig.Hidden("linkage_backlash", {"width": 0.5 * DEG, "stage": float(stage)})])
    assert [v for v in VANES if v in log.channels] == list(VANES[:n])
    found = diagnose(log, Machine(tables=folder)).diagnosis
    linkage = next(s for s in found.stages if s.stage == "linkage")
    assert found.verdict == "missing" and [s.stage for s in found.stages if s.effects] == ["linkage"]
    assert linkage.effects[0].effect == "linkage_backlash"
    values = {k: float(p["value"]) for k, p in linkage.effects[0].parameters.items()}
    assert list(values) == list(VANES[:n])
    assert max(values, key=lambda k: abs(values[k])) == VANES[stage]
    assert values[VANES[stage]] == pytest.approx(0.5, abs=0.12)


def test_the_example_of_four_stages_is_a_machine() -> None:
    folder = ROOT / "examples" / "four_stages"
    assert Machine(tables=folder).plant.vanes == VANES[:4]
    log = read_log(folder / "worn_vgv3.parquet")
    assert [v for v in VANES if v in log.channels] == list(VANES[:4])
    assert build_plant().vanes == VANES[:3]
