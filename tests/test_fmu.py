"""FMUs: the loop's bits in another simulator, parameters, states, many instances, no Python, and plants of others."""

from __future__ import annotations

import re
import shutil
import subprocess
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from controller import load_calibration
from controller.calibration import CalibrationTable
from hil.bus.lockstep_bus import run_lockstep
from hil.fmu import source, write_fmu
from hil.fmu.memory import Shape
from hil.fmu.plant_fmu import PlantFmu, PlantNode
from hil.loop.lockstep import Stimulus, lockstep
from hil.loop.node import Node
from plant import Model, build_plant
from plant.model import Learned
from tests.conftest import ROOT
from vaneloop.base.errors import InputError
from vaneloop.base.tables import read
from vaneloop.cli.main import main

fmpy = pytest.importorskip("fmpy")
DEG = 180.0 / np.pi
WORN = Model(
    parameters={"actuator.flow_gain": 0.147, "linkage.vgv1_play": 1.05},
    effects={
        "valve_dead_band": {"half_width": 1.2},
        "valve_hysteresis": {"width": 0.8},
        "piston_friction": {"force": 900.0},
        "linkage_friction": {"vigv": 0.2},
        "lvdt_gain": {"factor": 1.01},
        "can_delay": {"delay": 0.05},
        "controller_gain_error": {"factor": 1.2},
    },
)


def written(out: Path, part: str, version: str = "3.0", model: Model | None = None) -> Path:
    table = read("calibration.toml", CalibrationTable)
    write_fmu(out, part, build_plant(model=model), load_calibration(), table, model, version)
    return out


class Fmus(dict[str, Path]):
    """FMUs by part and first digit of the version, each made when it is first asked for."""

    EVERY = tuple(f"{part}{version}" for part in ("loop", "plant", "controller") for version in (3, 2))

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __missing__(self, name: str) -> Path:
        self[name] = written(self.folder / f"{name}.fmu", name[:-1], f"{name[-1]}.0")
        return self[name]


@pytest.fixture(scope="module")
def fmus(gcc: str, tmp_path_factory: pytest.TempPathFactory) -> Fmus:
    return Fmus(tmp_path_factory.mktemp("fmus"))


def test_two_that_export_at_once_make_the_source_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def make(kept: Path, part: str, shape: Shape) -> None:
        made.append(part)
        time.sleep(0.2)
        kept.write_text("the source")

    monkeypatch.setattr(source, "_folder", lambda: tmp_path / "kept")
    monkeypatch.setattr(source, "_make_source", make)
    with ThreadPoolExecutor(2) as two:
        said = list(two.map(source.part_source, ["loop", "loop"], [Shape(3, 66, 49)] * 2))
    assert made == ["loop"] and said == ["the source"] * 2


class Driven:
    """An instance of an FMU, by names of its variables."""

    def __init__(self, path: Path, folder: Path, **start: float):
        self.described = fmpy.read_model_description(str(path))
        self.reference = {v.name: v.valueReference for v in self.described.modelVariables}
        self.kind = {v.name: v.type for v in self.described.modelVariables}
        if not (folder / "modelDescription.xml").exists():
            fmpy.extract(str(path), str(folder))
        three = self.described.fmiVersion == "3.0"
        self.said: list[str] = []
        new = fmpy.fmi3.FMU3Slave if three else fmpy.fmi2.FMU2Slave
        self.f: Any = new(
            guid=self.described.guid, unzipDirectory=str(folder),
            modelIdentifier=self.described.coSimulation.modelIdentifier, instanceName="it",
        )  # fmt: skip
        if three:
            self.f.instantiate(logMessage=lambda e, status, category, message: self.said.append(message.decode()))
        else:
            self.f.instantiate()
            self.f.setupExperiment(startTime=0.0)
        self.f.enterInitializationMode()
        self.set(**start)
        self.f.exitInitializationMode()
        self.t = 0.0

    def set(self, **values: float) -> None:
        for name, value in values.items():
            getattr(self.f, f"set{self.kind[name]}")([self.reference[name]], [value])

    def get(self, *names: str) -> list[float]:
        read = self.f.getFloat64 if self.described.fmiVersion == "3.0" else self.f.getReal
        return list(read([self.reference[n] for n in names]))

    def step(self, k: int, ticks: int = 10) -> None:
        self.f.doStep(currentCommunicationPoint=k * 1e-3, communicationStepSize=ticks * 1e-3)


def demand(seconds: int, seed: int = 1) -> np.ndarray:
    """Rotor speed demand (%), a row every 10 ms: waves, steps and dwells."""
    i = np.arange(100 * seconds)
    steps = np.repeat(np.random.default_rng(seed).uniform(-3.0, 3.0, seconds), 100)
    return np.clip(60.0 + 30.0 * np.abs(np.sin(i / 700)) + steps, 50.0, 100.0)


SEEN = ("x_lvdt", "n_engine", "vigv", "vgv1", "vgv2")  # what the sensors give at the end of a step
GIVEN = ("x_dem", "i_cmd")  # what the firmware gave in its last tick


def followed(fmu: Driven, n: np.ndarray) -> np.ndarray:
    """The loop's outputs in border units after each 10 ms."""
    factors = np.array([1e3, 1.0, DEG, DEG, DEG, 1e3, 1e3])
    out = np.empty((len(n), 7))
    for i, v in enumerate(n):
        fmu.set(n_dem=v)
        fmu.step(10 * i)
        out[i] = fmu.get(*SEEN, *GIVEN)
    return out * factors


def differing(got: np.ndarray, columns: dict[str, np.ndarray]) -> list[str]:
    """Signals that are not lockstep's, bit for bit; ``columns`` has a row every tick."""
    seen = [name for q, name in enumerate(SEEN) if (got[:-1, q] != columns[name][10::10]).any()]
    return seen + [name for q, name in enumerate(GIVEN, 5) if (got[:, q] != columns[name][9::10]).any()]


@pytest.mark.parametrize("version", ["3", "2"])
def test_the_loop_gives_the_bits_of_lockstep(fmus: Fmus, tmp_path: Path, version: str) -> None:
    n = demand(300 if version == "3" else 30)
    run = lockstep(Stimulus.of(n), every=1)
    got = followed(Driven(fmus[f"loop{version}"], tmp_path, n_dem=n[0]), n)
    assert np.ptp(got[:, 0]) > 20.0
    assert not differing(got, run.columns)


def test_a_model_file_s_machine_is_in_the_fmu_and_so_are_its_parameters(fmus: Fmus, tmp_path: Path, gcc: str) -> None:
    n = demand(20, seed=2)
    run = lockstep(Stimulus.of(n), plant=build_plant(model=WORN), every=1)
    exported = followed(Driven(written(tmp_path / "worn.fmu", "loop", model=WORN), tmp_path / "worn", n_dem=n[0]), n)
    assert not differing(exported, run.columns)
    values = {f"plant.{name}": v for name, v in WORN.parameters.items()}
    values |= {f"effects.{e}.{key}": v for e, given in WORN.effects.items() for key, v in given.items()}
    changed = followed(Driven(fmus["loop3"], tmp_path / "plain", n_dem=n[0], **values), n)
    assert not differing(changed, run.columns)
    assert differing(changed, lockstep(Stimulus.of(n), every=1).columns)


def test_laws_that_remember_are_in_the_fmu(tmp_path: Path, gcc: str) -> None:
    """A lag and a hysteresis that were learned."""
    n, of = demand(20, seed=3), "speed_of_x_lvdt_lagged_by_2_s"
    late = Learned(how="adds", at="linkage.crank", of=of, low=-50.0, high=50.0, form="line", values=[-0.2])
    slips = Learned(how="adds", at="valve.current", of="stops_of_i_cmd", low=0.0, high=2.0, form="line", values=[-0.2])
    model = Model(effects={"late": {}, "slips": {}}, curves={"late": late, "slips": slips})
    run = lockstep(Stimulus.of(n), plant=build_plant(model=model), every=1)
    got = followed(Driven(written(tmp_path / "remembers.fmu", "loop", model=model), tmp_path, n_dem=n[0]), n)
    assert not differing(got, run.columns)
    for name in model.curves:
        one = Model(effects={name: {}}, curves={name: model.curves[name]})
        assert differing(got, lockstep(Stimulus.of(n), plant=build_plant(model=one), every=1).columns)


@pytest.mark.slow
def test_plant_and_controller_joined_are_the_loop(fmus: Fmus, tmp_path: Path) -> None:
    n = demand(5, seed=3)
    run = lockstep(Stimulus.of(n), every=1)
    plant = Driven(fmus["plant3"], tmp_path / "plant", n_dem=n[0])
    controller = Driven(fmus["controller2"], tmp_path / "controller", n_dem=n[0])
    every = np.repeat(np.concatenate([np.full(100, n[0]), n]), 10)  # 1 s before the start, as in a run
    got = np.empty((len(every), 3))
    for k, v in enumerate(every):
        x, speed = plant.get("x_lvdt", "n_engine")
        controller.set(n_dem=v, n_r=speed, x_lvdt=x)
        controller.step(k, 1)
        (i_cmd,) = controller.get("i_cmd")
        if k % 10 == 0:
            plant.set(n_dem=v)
        plant.set(i_cmd=i_cmd)
        plant.step(k, 1)
        got[k] = x * 1e3, i_cmd * 1e3, speed
    for q, name in enumerate(("x_lvdt", "i_cmd", "n_engine")):
        assert (got[1000:, q] == run.columns[name]).all(), name


def test_a_state_taken_and_put_back_goes_on_with_the_same_bits(fmus: Fmus, tmp_path: Path) -> None:
    fmu = Driven(fmus["loop3"], tmp_path, n_dem=60.0, **{"effects.valve_hysteresis.width": 1.0})
    fmu.set(n_dem=75.0)
    for i in range(50):
        fmu.step(10 * i)
    state = fmu.f.getFMUState()
    data = fmu.f.serializeFMUState(state)
    ways = []
    for how in ("as it was", "set", "from bytes"):
        if how == "set":
            fmu.f.setFMUState(state)
        if how == "from bytes":
            fmu.f.setFMUState(fmu.f.deserializeFMUState(data))
        fmu.set(n_dem=65.0)
        for i in range(50, 150):
            fmu.step(10 * i)
        ways.append(fmu.get(*SEEN, *GIVEN))
    assert ways[0] == ways[1] == ways[2]


def test_what_cannot_be_is_refused_with_a_line(fmus: Fmus, tmp_path: Path) -> None:
    fmu = Driven(fmus["loop3"], tmp_path, n_dem=60.0)
    for values, line in (
        ({"effects.valve_dead_band.half_width": -1.0}, r"half_width \(=-1 mA\) must be in \[0, "),
        ({"controller.servo.kp": float("nan")}, r"kp \(=-?nan mA/mm\) must be in \[0, 1000\]"),
        ({"x_lvdt": 0.0}, "x_lvdt cannot be set"),
        ({"n_dem": float("inf")}, "n_dem"),
    ):
        with pytest.raises(fmpy.fmi1.FMICallException):
            fmu.set(**values)
        assert re.search(line, fmu.said[-1]), fmu.said
    with pytest.raises(fmpy.fmi1.FMICallException):
        fmu.step(5000)
    assert "communication point" in fmu.said[-1]


def test_a_parameter_tuned_while_it_runs_acts_from_then_on(fmus: Fmus, tmp_path: Path) -> None:
    fmu = Driven(fmus["loop3"], tmp_path, n_dem=60.0)
    fmu.step(0, 1000)
    (before,) = fmu.get("vigv")
    fmu.set(**{"effects.pot_bias.vigv": 2.0})
    fmu.step(1000, 2000)
    assert (fmu.get("vigv")[0] - before) * DEG == pytest.approx(2.0, abs=0.01)


@pytest.mark.slow
def test_every_fmu_is_valid_and_names_its_units(fmus: Fmus) -> None:
    from fmpy.validation import validate_fmu

    for path in map(fmus.__getitem__, fmus.EVERY):
        assert validate_fmu(str(path)) == []
        described = fmpy.read_model_description(str(path))
        for v in described.modelVariables:
            assert v.causality != "parameter" or (v.min is not None and v.max is not None) or v.type == "Boolean", (
                v.name
            )
            assert v.description or v.causality == "independent", v.name
    units = {u.name: u.baseUnit for u in described.unitDefinitions}
    assert (units["mA"].A, units["mA"].factor) == (1, 0.001)


@pytest.mark.slow
def test_a_hundred_instances_in_one_process_do_not_share_anything(fmus: Fmus, tmp_path: Path) -> None:
    many = [Driven(fmus["loop3"], tmp_path, n_dem=50.0 + 0.4 * i) for i in range(100)]
    for k in range(20):
        for fmu in many:
            fmu.step(10 * k)
    alone = Driven(fmus["loop3"], tmp_path, n_dem=50.0 + 0.4 * 37)
    for k in range(20):
        alone.step(10 * k)
    assert many[37].get(*SEEN) == alone.get(*SEEN)
    assert len({tuple(f.get(*SEEN)) for f in many}) == 100


DRIVER = """
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include "fmi3FunctionTypes.h"
#define F(name) fmi3##name##TYPE *name = (fmi3##name##TYPE *)dlsym(so, "fmi3" #name)
int main(int argc, char **argv) {
    void *so = dlopen(argv[1], RTLD_NOW);
    if (!so) { puts(dlerror()); return 1; }
    F(InstantiateCoSimulation); F(EnterInitializationMode); F(ExitInitializationMode); F(DoStep);
    F(SetFloat64); F(GetFloat64); F(FreeInstance);
    fmi3Instance i = InstantiateCoSimulation("c", argv[2], 0, 0, 0, 0, 0, 0, 0, 0, 0, 0);
    unsigned in = atoi(argv[3]), out = atoi(argv[4]);
    double n = 60.0, x, t;
    fmi3Boolean a, b, c;
    if (!i || EnterInitializationMode(i, 0, 0, 0.0, 0, 0) || SetFloat64(i, &in, 1, &n, 1)) return 2;
    if (ExitInitializationMode(i)) return 3;
    for (int k = 0; k < 500; k++) {
        n = 60.0 + 0.04 * k;
        if (SetFloat64(i, &in, 1, &n, 1) || DoStep(i, k * 0.01, 0.01, 1, &a, &b, &c, &t)) return 4;
    }
    GetFloat64(i, &out, 1, &x, 1);
    printf("%a\\n", x);
    FreeInstance(i);
    return argc < 5;
}
"""


def test_it_runs_without_python_and_so_does_what_its_source_gives(fmus: Fmus, tmp_path: Path, gcc: str) -> None:
    fmpy.extract(str(fmus["loop3"]), str(tmp_path / "it"))
    described = fmpy.read_model_description(str(fmus["loop3"]))
    reference = {v.name: str(v.valueReference) for v in described.modelVariables}
    sources = tmp_path / "it" / "sources"
    build = ElementTree.parse(sources / "buildDescription.xml")
    (files,) = build.iter("SourceFileSet")
    names = [file.attrib["name"] for file in files]
    again = [
        gcc,
        *files.attrib["compilerOptions"].split(),
        "-Wall",
        "-Wno-unused",
        "-Werror",
        "-fPIC",
        "-shared",
        "-o",
        "again.so",
    ]
    subprocess.run([*again, *names, "-lm"], cwd=sources, check=True)
    (tmp_path / "driver.c").write_text(DRIVER)
    words = [gcc, "-std=gnu99", f"-I{sources}", "-o", str(tmp_path / "driver"), str(tmp_path / "driver.c"), "-ldl"]
    subprocess.run(words, check=True)
    run = lockstep(Stimulus.of(60.0 + 0.04 * np.arange(501)), every=1)
    shipped = next((tmp_path / "it" / "binaries").rglob("*.so"))
    needs = subprocess.run(["ldd", str(shipped)], capture_output=True, text=True, check=True).stdout
    assert "python" not in needs and "numba" not in needs and "LLVM" not in needs
    for so in (shipped, sources / "again.so"):
        words = [str(tmp_path / "driver"), str(so), described.guid, reference["n_dem"], reference["x_lvdt"]]
        done = subprocess.run(words, env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=True)
        assert float.fromhex(done.stdout) * 1e3 == run.columns["x_lvdt"][5000]


# ---- plants of others ------------------------------------------------------------------------------------------------


def edited(path: Path, out: Path, change: Callable[[str], str], drop: str = "") -> str:
    """An FMU with another modelDescription.xml, without the files whose names begin with ``drop``."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            if not (drop and name.startswith(drop)):
                data = old.read(name)
                new.writestr(name, change(data.decode()).encode() if name == "modelDescription.xml" else data)
    return str(out)


@pytest.mark.slow
@pytest.mark.parametrize("version", ["3", "2"])
def test_the_plant_s_fmu_in_the_loop_gives_the_frames_of_the_plant(fmus: Fmus, version: str) -> None:
    n = np.r_[np.linspace(60.0, 75.0, 400), np.linspace(75.0, 65.0, 300)]
    own, cal = build_plant(), load_calibration()
    ours = run_lockstep(n, vgv=Node(own, cal))
    theirs = run_lockstep(n, vgv=PlantNode(PlantFmu(str(fmus[f"plant{version}"]), own.vanes), own, cal))
    assert len(ours.rows) > 2500
    assert (ours.rows == theirs.rows).all()
    assert (ours.vgv.loop.z == theirs.vgv.loop.z).all()


@pytest.mark.slow
def test_units_and_names_of_a_plant_are_turned_into_ours(fmus: Fmus, tmp_path: Path) -> None:
    def change(text: str) -> str:
        text = text.replace('name="x_lvdt"', 'name="piston"').replace('name="t_oil"', 'name="oil"')
        text = re.sub(r'(name="piston"[^>]*unit=)"m"', r'\1"mm"', text)
        text = re.sub(r'(name="oil"[^>]*unit=)"degC"', r'\1"K"', text)
        return text.replace("<UnitDefinitions>", '<UnitDefinitions><Unit name="K"><BaseUnit K="1"/></Unit>')

    path = edited(fmus["plant3"], tmp_path / "named.fmu", change)
    vanes = build_plant().vanes
    fmu = PlantFmu(path, vanes, {"piston": "x_lvdt", "oil": "t_oil"})
    plain = PlantFmu(str(fmus["plant3"]), vanes)
    assert fmu.outputs()["x_lvdt"] == pytest.approx(1e-3 * plain.outputs()["x_lvdt"])
    (oil,) = (v for v in fmu._inputs if v.signal == "t_oil")
    assert (oil.factor, oil.offset) == (1.0, -273.15)


@pytest.mark.slow
def test_an_fmu_that_cannot_be_the_plant_is_refused_in_one_line(
    fmus: Fmus, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant = fmus["plant2"]
    (tmp_path / "text.fmu").write_text("no archive")
    whole = re.compile(r"<CoSimulation.*?</CoSimulation>", re.S)
    exchange = '<ModelExchange modelIdentifier="plant2"/>'
    cases = {
        "text": (str(tmp_path / "text.fmu"), "is no FMU that can be read"),
        "one": (edited(plant, tmp_path / "1.fmu", lambda x: x.replace('fmiVersion="2.0"', 'fmiVersion="1.0"')), "FMI"),
        "exchange": (edited(plant, tmp_path / "me.fmu", lambda x: whole.sub(exchange, x)), "model exchange only"),
        "platform": (edited(plant, tmp_path / "p.fmu", lambda x: x, drop="binaries/"), "has binaries for none"),
        "missing": (str(fmus["loop2"]), "has no input 'i_cmd'"),
        "unit": (
            edited(plant, tmp_path / "u.fmu", lambda x: x.replace('unit="A"', 'unit="Pa"')),
            "i_cmd: unit (='Pa') must be one that turns into A",
        ),
    }
    for name, (path, line) in cases.items():
        assert main(["run", "--bus", "lockstep", "--duration", "1", "--plant", path]) == 2, name
        said = capsys.readouterr().err.strip().splitlines()
        assert len(said) == 1 and line in said[0], (name, said)


def test_bad_words_of_the_export_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for words, line in (
        (["--part", "valve", "--out", "x.fmu"], "part (='valve') must be one of plant, controller, loop"),
        (["--part", "loop", "--out", "x.zip"], "ends in .fmu"),
        (["--part", "loop", "--out", "x.fmu", "--fmi", "1.0"], "FMI version (='1.0') must be one of 3.0, 2.0"),
    ):
        monkeypatch.chdir(tmp_path)
        assert main(["export-fmu", *words]) == 2
        assert line in capsys.readouterr().err
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert main(["export-fmu", "--part", "loop", "--out", "x.fmu"]) == 2
    assert "gcc is needed" in capsys.readouterr().err


def test_the_standard_s_headers_are_those_of_fmpy() -> None:
    there = Path(fmpy.__file__).parent / "c-code"
    for header in (ROOT / "hil" / "fmu" / "c").glob("fmi[23]*.h"):
        assert header.read_bytes() == (there / header.name).read_bytes(), header.name


@pytest.mark.parametrize(("member", "says"), [("modelDescription.xml", "modelDescription.xml has"), ("a", "unpack to")])
def test_an_fmu_that_unpacks_to_more_than_it_is_worth_is_refused(tmp_path: Path, member: str, says: str) -> None:
    bomb = tmp_path / "bomb.fmu"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        if member != "modelDescription.xml":
            archive.writestr("modelDescription.xml", "<fmiModelDescription fmiVersion='3.0'/>")
        with archive.open(member, "w") as out:
            for _ in range(90):
                out.write(bytes(1 << 20))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=says):
            PlantFmu(str(bomb), ("vigv",))
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()
