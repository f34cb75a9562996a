"""What docs/add_an_effect.md promises of the effect that it adds: run in a copy of the sources that has it."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.effects_page import page
from hil.loop.lanes import lockstep_lanes
from hil.loop.lockstep import Stimulus, lockstep
from plant import Model, Plant, build_plant, chain
from plant.parameters import derive
from plant.places import POT
from plant.stages import linkage, linkage_run
from tests.test_fmu import Driven, demand, differing, followed, written
from vaneloop.cli.main import main

NAME = "play_temperature"
WARM = Model(effects={NAME: {"vigv": 0.02, "vgv1": 0.02, "vgv2": 0.02}})  # deg/K
T_OIL = 75.0  # degC


def machine() -> Plant:
    """The machine with the effect."""
    return build_plant(model=WARM)


def check_that_rings_start_where_asked() -> None:
    """A placed ring reads as asked, at the first tick, too."""
    plant = machine()
    s = plant.start(0.024, 80.0, T_OIL)
    plant.place_rings(s, (-1.0,) * 3, 80.0, T_OIL)
    low = s[POT : POT + 3, 0].copy()
    plant.place_rings(s, (1.0,) * 3, 80.0, T_OIL)
    high = s[POT : POT + 3, 0].copy()
    plain = build_plant()
    z = plain.start(0.024, 80.0, T_OIL)
    plain.place_rings(z, (1.0,) * 3, 80.0, T_OIL)
    assert (high > z[POT : POT + 3, 0] + 1e-3).all()  # the play is wider
    asked = low + 0.02 * (high - low)  # where no ring comes without the effect
    plant.place_rings(s, tuple(asked), 80.0, T_OIL)
    chain.vane_step(s, plant.p, 0, 80.0, T_OIL)
    assert np.abs(s[POT : POT + 3, 0] - asked).max() < 1e-12


def check_that_lanes_are_the_loop() -> None:
    """Lanes of a campaign have the effect."""
    stimulus = Stimulus.of(demand(8), t_oil=T_OIL)
    plants = [machine(), build_plant()]
    alone = [lockstep(stimulus, plant=p, hashed=False).columns for p in plants]
    for lane, one in zip(lockstep_lanes(stimulus, plants), alone, strict=True):
        assert all(np.abs(lane.columns[name] - v).max() < 1e-10 for name, v in one.items())
    assert np.abs(alone[0]["vgv1"] - alone[1]["vgv1"]).max() > 0.1


def check_that_blocks_of_the_search_are_the_chain() -> None:
    """So have the search's blocks."""
    lanes, t = 20, np.arange(0.0, 6.0, 0.01)
    p = np.repeat(build_plant().p, lanes, axis=1)
    p[:, ::2] = machine().p
    derive(p, 2e-3, 1e-2)
    n_r, t_oil, stroke = 60.0 + t, 30.0 + 8.0 * t, 0.024 + 6e-3 * np.sin(3.0 * t)
    outs = []
    for some in (linkage.SOME, lanes):  # blocks; one by one
        linkage.SOME, out = some, np.empty((len(t), 3, lanes))
        linkage_run(stroke, n_r, t_oil, t, 0.01, p.copy(), np.repeat(build_plant().start(0.024, 60.0), lanes, 1), out)
        outs.append(out)
    assert np.abs(outs[0] - outs[1]).max() < 1e-12 and np.abs(outs[0][..., 0] - outs[0][..., 1]).max() > 1e-4


def check_that_the_fmu_is_the_loop() -> None:
    """So has an FMU, bit for bit."""
    n = demand(5)
    run = lockstep(Stimulus.of(n), plant=machine(), every=1)
    with tempfile.TemporaryDirectory() as folder:
        fmu = written(Path(folder) / "warm.fmu", "loop", model=WARM)
        assert not differing(followed(Driven(fmu, Path(folder), n_dem=n[0]), n), run.columns)


def check_that_the_page_has_it() -> None:
    """The library's page has its section."""
    assert f"## {NAME}" in page()


def check_that_the_search_finds_it(log: str) -> None:
    """The search names it, and nothing beside it, on a log of a machine that has it."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "answer.json"
        assert main(["diagnose", log, "--json", str(out), "--quiet", "--workers", "1"]) == 1
        found = json.loads(out.read_text(encoding="utf-8"))
        assert [f["effect"] for f in found["effects"]] == [NAME] and not found["unknown"]


if __name__ == "__main__":
    check_that_rings_start_where_asked()
    check_that_lanes_are_the_loop()
    check_that_blocks_of_the_search_are_the_chain()
    check_that_the_fmu_is_the_loop()
    check_that_the_page_has_it()
    check_that_the_search_finds_it(sys.argv[1])
