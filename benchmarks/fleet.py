"""Fleets: a run folder of 100,000 logs, two workers against one, kills, and a report held against what is true.

python -m benchmarks fleet                          # the folder of 100,000 logs, and the workers; free cores
python -m benchmarks.fleet kills [SEED]             # fifty kills at moments drawn by chance; two minutes
python -m benchmarks.fleet judge RUN TRUTH.json     # a run over the logs of benchmarks.fleet_demo
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.fleet_demo import YEAR, YEARS, make
from benchmarks.measure import ROOT, Row

__all__ = ["MEASUREMENTS", "judged"]

LOGS, ENGINES = 100_000, 200
KILLS = 50
RIGHT = 0.1  # of the time axis, by which an onset may be off


# ---- a folder of many logs -------------------------------------------------------------------------------------------


def _measured(*words: str) -> tuple[float, float, float, str]:
    """Run a command of ours: wall time and processor time (s), greatest memory (GiB), and what it said."""
    began = time.perf_counter()
    with tempfile.TemporaryFile("w+") as said:
        p = subprocess.Popen(
            [sys.executable, "-m", "vaneloop", *words], cwd=ROOT, stdout=said, stderr=subprocess.STDOUT
        )
        _, status, used = os.wait4(p.pid, 0)
        wall = time.perf_counter() - began
        said.seek(0)
        text = said.read()
    p.returncode = os.waitstatus_to_exitcode(status)
    if p.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(words)}: {text[-300:]}")
    return wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20, text


def _many(folder: Path) -> None:
    """A run of 100,000 logs with answers drawn by chance; the logs are there, and hold nothing."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from tests.test_fleet_report import synthetic
    from vaneloop.cli import fleet
    from vaneloop.fleet.folder import Folder
    from vaneloop.fleet.kinds import DIAGNOSIS

    made = synthetic(folder / "made", ENGINES, LOGS // ENGINES)
    logs = folder / "logs"
    parser = argparse.ArgumentParser()
    fleet.add_options(parser)
    options, files = fleet._job(parser.parse_args(["run", str(logs), "--out", "x"]))
    run = Folder.begin(folder / "run", DIAGNOSIS, options, files)
    (batch,) = (made.path / "logs").iterdir()
    rows = pq.read_table(batch).to_pylist()
    for row in rows:
        path = logs / str(row["path"]).removeprefix("/logs/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        row |= {"path": str(path), "size": 0, "mtime_ns": path.stat().st_mtime_ns}
    (run.path / "logs").mkdir()
    pq.write_table(pa.Table.from_pylist(rows, schema=pq.read_schema(batch)), run.path / "logs" / batch.name)
    (made.path / "parts").rename(run.path / "parts")


def hundred_thousand() -> Iterator[Row]:
    """List, go on with, and report a run of 100,000 logs."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        _many(folder)
        run, logs = str(folder / "run"), str(folder / "logs")
        for what, limit, words in (
            ("list (fleet status)", 10.0, ("fleet", "status", run)),
            ("go on (fleet run, nothing new)", 10.0, ("fleet", "run", logs, "--out", run)),
            ("report", 60.0, ("fleet", "report", run, "--report", str(folder / "fleet.html"))),
        ):
            wall, cpu, memory, text = _measured(*words)
            assert "100,000" in text or what == "report", text
            yield Row(
                f"100,000 logs: {what}", f"{wall:.1f} s, {memory:.2f} GiB", f"{limit:.0f} s, 2 GiB", wall / limit,
                "at most 1", wall <= limit and memory <= 2.0, f"{cpu:.1f} s of a core; load {os.getloadavg()[0]:.0f}",
            )  # fmt: skip


# ---- workers ---------------------------------------------------------------------------------------------------------


def workers() -> Iterator[Row]:
    """360 logs by one worker and by two; both cores must be free. What starts the workers takes some seconds: of few
    logs it would be a large share.
    """
    with tempfile.TemporaryDirectory() as place:
        logs = f"{place}/logs"
        make(Path(logs), engines=12, logs=360, duration=60.0, seed=1, workers=2, progress=lambda fraction: None)
        seconds = []
        for n in (1, 1, 2):  # the first run compiles
            few = logs if seconds else f"{logs}/engine_000"
            seconds.append(
                _measured("fleet", "run", few, "--out", f"{place}/run{len(seconds)}", "--workers", str(n))[0]
            )
        share = seconds[1] / (2.0 * seconds[2])
        yield Row(
            "a fleet of 360 logs, one worker and two", f"{seconds[2]:.0f} s", f"{seconds[1]:.0f} s", share,
            "efficiency at least 0.9", share >= 0.9, f"load {os.getloadavg()[0]:.1f}",
        )  # fmt: skip


MEASUREMENTS = {"a fleet's run of 100,000 logs": hundred_thousand, "a fleet's workers": workers}


# ---- kills -----------------------------------------------------------------------------------------------------------

STARTER = """
import sys
import tests.fleet_jobs
from vaneloop.fleet import state
from vaneloop.fleet.folder import Folder
from vaneloop.fleet.rent import rent

if __name__ == "__main__":
    folder = Folder(sys.argv[1])
    state.tidy(folder)
    rent(folder, "local", 2, {}, 0.2, lambda n, of: None)
"""


def killed(place: Path, kills: int, logs: int, seed: int) -> dict[str, Any]:
    """Run the same logs undisturbed, and with kills: tables of both, byte for byte.

    Killed is one of the processes of the run drawn by chance, after some more logs were begun (0 to 10) and some time
    (up to 0.3 s), both drawn by chance: the starter, a worker or a reader of logs. A
    starter that was killed or has ended is started again. The logs are a stand-in's (tests/fleet_jobs.py), 0.1 s each.
    """
    import psutil

    import tests.fleet_jobs  # noqa: F401 (the stand-in is a kind of work)
    from vaneloop.fleet import sources, state, tables
    from vaneloop.fleet.folder import Folder
    from vaneloop.fleet.worker import lines, work

    draw = random.Random(seed)
    for k in range(logs):
        path = place / "logs" / f"e{k % 10}" / f"2026-01-{1 + k % 28:02d}_{k:05d}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"log {k}", encoding="utf-8")
    runs = [Folder.begin(place / name, "diagnosed", {}, {}) for name in ("calm", "killed")]
    for run in runs:
        run.add(sources.find([str(place / "logs")]))
    script = place / "starter.py"
    script.write_text(STARTER, encoding="utf-8")
    begin = partial(
        subprocess.Popen, [sys.executable, str(script), str(runs[1].path)], stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    chunks, dead, starts, due = len(runs[1].chunks()), dict.fromkeys(("starter", "worker", "reader"), 0), 0, 1
    begun = lambda: sum(line["what"] == "begin" for line in lines(runs[1].path))  # noqa: E731
    starter = None
    while len(runs[1].finished()) < chunks:
        if starter is None or starter.poll() is not None:
            starter, starts = begin(), starts + 1
        time.sleep(draw.uniform(0.0, 0.3))
        if sum(dead.values()) >= kills or begun() < due:
            continue
        try:
            family = psutil.Process(starter.pid)
            who = draw.choice([family, *family.children(recursive=True)])
            kind = "starter" if who == family else "reader" if "serve()" in " ".join(who.cmdline()) else "worker"
            who.kill()
        except psutil.NoSuchProcess:  # it has ended by itself meanwhile
            continue
        dead[kind] += 1
        due = begun() + draw.randint(0, 10)
    if starter is not None:
        starter.wait()
    state.tidy(runs[1])
    work(runs[0].path)
    same = True
    for run in runs:
        tables.write_tables(tables.roll_up(run), run.path / "tables")
    for name in tables.TABLES:
        calm, other = (sorted((run.path / "tables" / f"{name}.csv").read_bytes().splitlines()) for run in runs)
        same = same and calm == other and len(calm) == logs + 1
    left = [f.name for folder in ("leases", "results", "workers") for f in (runs[1].path / folder).iterdir()]
    return {"killed": dead, "starts": starts, "logs": logs, "again": begun() - logs, "same": same, "left": left}


# ---- a report against the truth --------------------------------------------------------------------------------------


def judged(run: str, truth_file: str) -> dict[str, Any]:
    """Hold the report of a run against ``truth.json`` of `benchmarks.fleet_demo`.

    A growth is found where the engine's own quantity is said to change: the effect's parameter, or the nominal one that
    it moves. Its onset is right within a tenth of the time axis.
    """
    from plant.effects import EFFECTS
    from vaneloop.base.vanes import VANES
    from vaneloop.fleet.folder import Folder
    from vaneloop.fleet.report import view_of
    from vaneloop.fleet.sources import moment
    from vaneloop.fleet.tables import roll_up

    truth = json.loads(Path(truth_file).read_text(encoding="utf-8"))
    begin, year = moment(truth["begin"]), YEAR.total_seconds()
    view = view_of(roll_up(Folder(run)), {})
    growths, healthy, others = [], [], []
    for t in truth["engines"]:
        engine, kind = t["engine"], t["fate"]
        found = [s for s in view.changed if s.engine == engine]
        lacks = [r["effect"] for r in view.lacking if r["engine"] == engine]
        odd = [r["quantity"] for r in view.outliers if r["engine"] == engine]
        if kind == "healthy":
            healthy.append({"engine": engine, "lacks": lacks, "changes": [s.quantity for s in found], "odd": odd})
            continue
        declared = EFFECTS[t["effect"]].parameters
        vane = next((p for p in declared if p.name == VANES[t["stage"]]), None)
        parameter = vane or declared[0]
        nominal = {"linkage_backlash": f"linkage.{parameter.name}_play", "pot_bias": f"sensors.{parameter.name}_bias"}
        names = (f"{t['effect']}.{parameter.name}", nominal.get(t["effect"], ""))
        own = sorted((s for s in found if s.quantity in names), key=lambda s: names.index(s.quantity))
        row = {
            "engine": engine,
            "fate": kind,
            "lacks": t["effect"] in lacks,
            "quantity": own[0].quantity if own else "",
        }
        if t["comes"] != "always":
            size = t["size"] / parameter.si
            true = size / (YEARS - t["onset_years"]) if t["comes"] == "growth" else size
            row |= {"true_onset": t["onset_years"], "true_rate": true}
        if own:
            x = own[0].trend
            row |= {"kind": x["kind"], "onset": (x["onset"] - begin) / year, "rate": x["rate"]}
            row |= {"low": x["rate_low"], "high": x["rate_high"], "unit": own[0].unit}
        (growths if t["comes"] == "growth" else others).append(row)
    known = [g for g in growths if g["quantity"]]
    right = [g for g in known if abs(g["onset"] - g["true_onset"]) <= RIGHT * YEARS]
    covered = [g for g in known if g["low"] <= g["true_rate"] <= g["high"]]
    accused = [h for h in healthy if h["lacks"] or h["changes"] or h["odd"]]
    return {
        "logs": view.statuses, "growths": growths, "others": others, "accused": accused, "healthy": len(healthy),
        "found": len(known), "right": len(right), "covered": len(covered),
    }  # fmt: skip


def _show(said: dict[str, Any]) -> None:
    for g in [*said["growths"], *said["others"]]:
        text = " ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in g.items())
        print(text)
    for h in said["accused"]:
        print("healthy and accused:", h)
    n, found, right, covered = len(said["growths"]), said["found"], said["right"], said["covered"]
    print(f"logs: {said['logs']}")
    print(f"growths found: {found} of {n}")
    print(f"onset within a tenth of the time axis: {right} of {n} growths ({_per_cent(right, n)}; goal: 90 %)")
    share = _per_cent(covered, found)
    print(f"true growth within the 90 % interval: {covered} of {found} found ({share}; goal: 85 to 95 %)")
    accused, healthy = len(said["accused"]), said["healthy"]
    print(f"healthy engines accused: {accused} of {healthy} ({_per_cent(accused, healthy)}; goal: at most 2 %)")


def _per_cent(some: int, of: int) -> str:
    return f"{100.0 * some / of:.0f} %" if of else "none"


def _kills(seed: int) -> int:
    with tempfile.TemporaryDirectory() as place:
        said = killed(Path(place), KILLS, 600, seed)
    who = ", ".join(f"{n} {kind}s" for kind, n in said["killed"].items())
    print(f"seed {seed}: {sum(said['killed'].values())} kills ({who}); started {said['starts']} times")
    left = ", ".join(said["left"]) or "nothing"
    print(f"{said['logs']} logs, {said['again']} of them begun again; left behind: {left}")
    print(f"tables equal those of an undisturbed run, byte for byte after sorting: {'yes' if said['same'] else 'NO'}")
    return 0 if said["same"] and sum(said["killed"].values()) == KILLS else 1


if __name__ == "__main__":
    words = sys.argv[1:]
    if words[:1] == ["kills"] and len(words) <= 2:
        raise SystemExit(_kills(int(words[1]) if len(words) == 2 else 1))
    if len(words) != 3 or words[0] != "judge":
        raise SystemExit(__doc__)
    _show(judged(words[1], words[2]))
