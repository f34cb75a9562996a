"""The scheduling method: published figures, measured loops of another machine than the nominal one, tables that the
controller loads.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from controller import load_calibration
from hil.engine_test import engine_test, load_profile
from hil.logs import Channel, Log, LogError, write_log
from plant import Geometry, build_plant, load_geometry, load_schedules
from plant.linkage import G_HYSTERESIS, G_L, G_LDP, N_CRANK, N_PER_STAGE, stage_ring_angle, vane_angle
from tests.browser import open_to_all
from tests.firmware_on_rig import firmware
from tests.rig import Hidden, Manoeuvre, simulate
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path
from vaneloop.base.vanes import VANES
from vaneloop.cli.main import main
from vaneloop.design.links import LinkChange, ScheduleOptions, geometry_with
from vaneloop.design.measured_loop import MeasuredLoop, measure_loop
from vaneloop.design.schedule_files import write_tables
from vaneloop.design.scheduling import schedule
from vaneloop.design.stroke_tables import table_speeds

STAGES = VANES[:3]
GEOMETRY = load_geometry()
SCHEDULES = load_schedules()
OTHER = geometry_with(  # another engine: lengths and play beyond what the geometry table says
    GEOMETRY,
    {
        "vigv": {"lb": 74.6, "lc": 497.6, "hysteresis": 2.3},
        "vgv1": {"lc": 493.2, "hysteresis": 1.5},
        "vgv2": {"lb": 37.5, "hysteresis": 0.5},
    },
)


def zigzag(
    points: list[float], rate: float = 4.0, dt: float = 0.05, dwell: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Time, s, and stroke, mm, there and back between ``points`` at ``rate`` mm/s."""
    t, x = [0.0], [points[0]]
    for p in points[1:]:
        t += [t[-1] + abs(p - x[-1]) / rate, t[-1] + abs(p - x[-1]) / rate + dwell]
        x += [p, p]
    raster = np.arange(0.0, t[-1], dt)
    return raster, np.interp(raster, t, x)


def branch(geometry: Geometry, k: int, stroke: np.ndarray, side: int) -> np.ndarray:
    """True angle, deg, on the extension (1) or retraction (-1) branch: play at the ring, by its definition."""
    g = geometry.arrays()
    o = N_CRANK + k * N_PER_STAGE
    half = 0.5 * g[o + G_HYSTERESIS] * g[o + G_L] / g[o + G_LDP]
    return np.degrees(
        [vane_angle(stage_ring_angle(x * 1e-3, g, k) - side * half, g[o + G_LDP], g[o + G_L]) for x in stroke]
    )


def angles(geometry: Geometry, k: int, stroke: np.ndarray) -> np.ndarray:
    """Angle, deg, of a stage whose ring lags behind its drive by the play, stroke by stroke."""
    g = geometry.arrays()
    o = N_CRANK + k * N_PER_STAGE
    half = 0.5 * g[o + G_HYSTERESIS] * g[o + G_L] / g[o + G_LDP]
    ring, out = stage_ring_angle(stroke[0] * 1e-3, g, k), []
    for x in stroke:
        drive = stage_ring_angle(x * 1e-3, g, k)
        ring = min(max(ring, drive - half), drive + half)
        out.append(vane_angle(ring, g[o + G_LDP], g[o + G_L]))
    return np.degrees(out)


def measured(
    points: list[float],
    seed: int = 1,
    noise: float = 0.03,
    drift: float = 0.0,
    dt: float = 0.05,
    rate: float = 4.0,
    stage: str = "vigv",
    dither: float = 0.0,
    spikes: int = 0,
) -> MeasuredLoop:
    """The loop that `measure_loop` finds in a noisy log of the machine OTHER."""
    rng = np.random.default_rng(seed)
    t, x = zigzag(points, rate, dt)
    x = x + dither * np.sin(2.0 * np.pi * 2.0 * t)
    y = angles(OTHER, STAGES.index(stage), x) + noise * rng.standard_normal(t.size) + drift * (t / t[-1] - 0.5)
    x = x + 0.17 * noise * rng.standard_normal(t.size)
    for a, size in ((x, 5.0), (y, 20.0)):
        a[rng.integers(0, t.size, spikes)] += size * rng.choice([-1.0, 1.0], spikes)
    return measure_loop(Channel(t, x), Channel(t, y), GEOMETRY, stage)


def curve_error(m: MeasuredLoop) -> float:
    """Largest distance, deg, of the two curves from the truth where both branches were measured."""
    low = max(m.extension_covered[0], m.retraction_covered[0])
    high = min(m.extension_covered[1], m.retraction_covered[1])
    inside = (m.stroke >= low) & (m.stroke <= high)
    k = STAGES.index(m.stage)
    return max(
        float(np.max(np.abs(c[inside] - branch(OTHER, k, m.stroke[inside], side))))
        for c, side in ((m.extension, 1), (m.retraction, -1))
    )


# --- the paper's figures ----------------------------------------------------------------------------------------------


def test_the_papers_numbers_give_the_papers_errors():
    r = schedule(GEOMETRY, SCHEDULES)
    errors = [(s.at_design["initial"], s.at_design["built"]) for s in r.links[1:]]
    assert np.round(errors, 2).tolist() == [[1.03, 0.39], [2.16, 0.08]]
    assert [(s.lb_initial, s.lb_built) for s in r.links[1:]] == [(48.0, 49.0), (35.0, 38.0)]


def test_adjusting_from_the_first_built_lengths_ends_at_or_below_the_papers_errors():
    first = geometry_with(GEOMETRY, {"vgv1": {"lb": 48.0}, "vgv2": {"lb": 35.0}})
    r = schedule(first, SCHEDULES)
    for s, built, paper in zip(r.links[1:], (1.03, 2.16), (0.39, 0.08), strict=True):
        assert s.at_design["built"] == pytest.approx(built, abs=0.005)
        assert abs(s.at_design["adjusted"]) <= paper + 0.005
        assert s.rms["adjusted"] < 0.25 * s.rms["built"]
        assert (s.lb - s.lb_built) % 0.5 == 0.0


@pytest.mark.parametrize("criterion", ["rms", "max", "design"])
def test_no_other_pair_of_lengths_on_the_step_is_better(criterion):
    o = ScheduleOptions(criterion=criterion, step=1.0, lb_range=3.0, lc_range=2.0)
    best = schedule(GEOMETRY, SCHEDULES, options=o).links[1]

    def worth(s: LinkChange, state: str) -> float:
        return {"rms": s.rms[state], "max": s.largest[state], "design": abs(s.at_design[state]) + s.rms[state]}[
            criterion
        ]

    for lb in range(-3, 4):
        for lc in range(-2, 3):
            g = geometry_with(GEOMETRY, {"vgv1": {"lb": 49.0 + lb, "lc": 493.7 + lc}})
            s = schedule(g, SCHEDULES, options=ScheduleOptions(adjust=())).links[1]
            assert worth(s, "built") >= worth(best, "adjusted") - 1e-9


# --- the measured loop ------------------------------------------------------------------------------------------------


def test_one_noisy_loop_gives_width_lengths_and_both_curves():
    m = measured([1.0, 47.0, 1.0], dt=0.1)
    assert m.width == pytest.approx(2.3, abs=0.05)
    assert (m.lb, m.lc) == (pytest.approx(74.6, abs=0.1), pytest.approx(497.6, abs=0.03))
    assert curve_error(m) < 0.06


@pytest.mark.parametrize(
    ("what", "limit"),
    [
        ({"points": [1.0, 47.0, 1.0, 47.0, 1.0], "noise": 0.15}, 0.1),
        ({"points": [1.0, 47.0, 1.0, 47.0, 1.0, 47.0, 1.0], "drift": 1.0}, 0.08),
        ({"points": [1.0, 47.0, 1.0, 47.0, 1.0], "dt": 0.01, "spikes": 100}, 0.05),
        ({"points": [1.0, 47.0, 1.0], "dt": 1.0}, 0.1),
        ({"points": [20.0, 30.0, 20.0, 30.0, 20.0]}, 0.05),
        ({"points": [5.0, 20.0, 12.0, 30.0, 22.0, 45.0, 33.0, 40.0, 20.0, 28.0, 5.0, 9.0, 3.0]}, 0.06),
        ({"points": [1.0, 47.0, 1.0, 47.0, 1.0], "dither": 0.3, "rate": 1.0}, 0.06),
        ({"points": [1.0, 47.0, 1.0], "stage": "vgv1"}, 0.06),
        ({"points": [1.0, 47.0, 1.0], "stage": "vgv2"}, 0.06),
    ],
    ids=["noise x5", "drift of 1 deg", "spikes", "1 Hz", "partial loop", "nested loops", "dither", "vgv1", "vgv2"],
)
def test_the_curves_hold_under(what, limit):
    m = measured(**what)
    assert curve_error(m) < limit
    assert m.width == pytest.approx(getattr(OTHER, m.stage).hysteresis.value, abs=0.06)
    assert (m.extension <= m.mean).all() and (m.mean <= m.retraction).all()


def test_a_drift_is_reported_as_large_as_it_was():
    m = measured([1.0, 47.0, 1.0, 47.0, 1.0, 47.0, 1.0], drift=1.0)
    assert m.drift == pytest.approx(1.0, abs=0.15)
    assert measured([1.0, 47.0, 1.0]).drift is None


def test_a_mechanism_without_play_has_a_loop_of_no_width():
    t, x = zigzag([1.0, 47.0, 1.0])
    y = angles(geometry_with(GEOMETRY, {"vigv": {"hysteresis": 0.0}}), 0, x) + 0.03 * np.random.default_rng(
        2
    ).standard_normal(t.size)
    assert measure_loop(Channel(t, x), Channel(t, y), GEOMETRY).width == pytest.approx(0.0, abs=0.03)


# --- end to end -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def engine(tmp_path_factory) -> Path:
    """A folder: tables of another engine (machine/geometry.toml), and a noisy 10 Hz log of it (loop.csv)."""
    folder = tmp_path_factory.mktemp("engine")
    r = schedule(OTHER, SCHEDULES, options=ScheduleOptions(adjust=()))
    write_tables(r, folder / "machine")
    (folder / "machine" / "stroke_tables.toml").unlink()
    t, x = zigzag([1.0, 47.0, 1.0, 47.0, 1.0], dt=0.1)
    rng = np.random.default_rng(7)
    channels = {"x_lvdt": Channel(t, x + 0.005 * rng.standard_normal(t.size))}
    channels |= {n: Channel(t, angles(OTHER, k, x) + 0.03 * rng.standard_normal(t.size)) for k, n in enumerate(STAGES)}
    write_log(folder / "loop.csv", channels)
    return folder


@pytest.mark.slow
def test_log_to_tables_to_engine_test_shows_small_errors(engine, capsys):
    out = engine / "out"
    report = engine / "schedule.html"
    to = ["--out", str(out), "--report", str(report), "--json", str(engine / "s.json")]
    assert main(["schedule", "--log", str(engine / "loop.csv"), *to]) == 0
    assert "vgv1: adjusted" in capsys.readouterr().out
    assert report.stat().st_size > 1e5
    data = json.loads((engine / "s.json").read_text())
    assert data["loops"]["vigv"]["width"] == pytest.approx(2.3, abs=0.05)
    assert {s["stage"] for s in data["stages"]} == set(STAGES)

    machine = build_plant(geometry=engine / "machine" / "geometry.toml")
    n_dem = load_profile()[:120_000]
    nominal = engine_test(n_dem, "dual", plant=machine).signals[0]
    tables = {s: load_calibration(strokes=out / "stroke_tables.toml", strategy=s) for s in ("dual", "single")}
    own = engine_test(n_dem, "dual", plant=machine, calibration=tables["dual"]).signals[0]
    single = engine_test(n_dem, "single", plant=machine, calibration=tables["single"])
    assert own.mean_abs < 0.1
    assert own.mean_abs < 0.2 * nominal.mean_abs
    assert own.mean_abs < 0.2 * single.signals[0].mean_abs
    open_to_all(report, "schedule")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 11])
def test_a_log_of_the_independent_rig_gives_tables_that_serve_the_same_machine(seed):
    t = np.arange(0.0, 135.0, 0.01)
    n = np.interp(t, [0, 3, 33, 36, 66, 69, 99, 102, 132, 135], [42, 42, 104, 104, 42, 42, 104, 104, 42, 42])
    loops = Manoeuvre("loops", 0, n, np.full(t.size, 21e6), np.full(t.size, 40.0))
    t = np.arange(0.0, 90.0, 0.01)
    times = [0, 4, 9, 16, 20, 27, 32, 40, 48, 55, 58, 66, 67, 72, 90]
    n = np.interp(t, times, [48, 48, 62, 62, 75, 75, 92, 99.5, 99.5, 84, 84, 99, 99, 60, 60])
    engine_run = Manoeuvre("engine run", 0, n, np.full(t.size, 21e6), np.full(t.size, 40.0))
    hidden = [Hidden("link_length_error", {"error": 6e-4, "stage": 0}), Hidden("linkage_backlash", {"width": 5e-3})]
    run = simulate(loops, firmware(), hidden, seed=seed, rate=100)
    channels = {k: Channel(run.log["t"], run.log[k]) for k in ("x_lvdt", *STAGES)}
    r = schedule(GEOMETRY, SCHEDULES, Log("rig", channels))
    assert r.loops["vigv"].lc == pytest.approx(
        497.7, abs=0.08
    )  # a bias of the potentiometer is within: 0.1 deg are 0.06 mm
    assert r.loops["vigv"].width == pytest.approx(
        1.6 + np.degrees(5e-3), abs=0.08
    )  # the rig draws the play within 0.05 deg
    shipped = load_calibration()
    own = shipped._replace(table=np.vstack([r.table[0], r.table[1:] * 1e-3]))
    errors = []
    for calibration in (shipped, own):
        log = simulate(engine_run, firmware(calibration), hidden, seed=seed, rate=100).log
        errors.append(float(np.mean(np.abs(log["vigv"] - np.degrees(SCHEDULES.targets(log["n_r"])[:, 0])))))
    assert errors[1] < 0.12
    assert errors[1] < 0.15 * errors[0]


def test_the_written_tables_are_what_the_commands_load(engine, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["schedule", "--log", str(engine / "loop.csv"), "--adjust", "none", "--out", str(out), "--quiet"]) == 0
    files = {f.name for f in out.iterdir()}
    assert files == {"stroke_tables.toml", "vane_angles.toml", "geometry.toml", "schedules.toml"}
    assert "measured in loop.csv" in tomllib.loads((out / "stroke_tables.toml").read_text())["extension"]["origin"]
    t = np.arange(0.0, 60.0, 0.1)
    write_log(tmp_path / "demand.csv", {"n_dem": Channel(t, np.interp(t, [0, 20, 40, 60], [60, 95, 60, 95]))})
    command = ["replay", str(tmp_path / "demand.csv"), "--quiet", "--json", "-"]
    assert main([*command, "--tables", str(out)]) == 0
    with_tables = json.loads(capsys.readouterr().out)
    assert main(command) == 0
    without = json.loads(capsys.readouterr().out)
    assert with_tables["state_hash"] != without["state_hash"]
    assert next(s for s in with_tables["signals"] if s["signal"] == "vigv")["mean_abs"] < 0.2


def test_without_a_log_the_shipped_tables_come_out(tmp_path):
    assert main(["schedule", "--adjust", "none", "--out", str(tmp_path), "--quiet"]) == 0
    written, shipped = (tomllib.loads((p / "stroke_tables.toml").read_text()) for p in (tmp_path, path("x").parent))
    for row in ("speed", "extension", "retraction", "single"):
        assert written[row]["values"] == shipped[row]["values"]
    assert load_geometry(tmp_path / "geometry.toml") == GEOMETRY
    assert load_schedules(tmp_path / "schedules.toml") == SCHEDULES


def test_the_tables_cover_the_schedule_from_where_it_rises():
    assert table_speeds(SCHEDULES).tolist() == list(range(40, 106))


# --- bad input --------------------------------------------------------------------------------------------------------


def log_of(t: np.ndarray, x: np.ndarray, y: np.ndarray) -> Log:
    return Log("loop.csv", {"x_lvdt": Channel(t, x), "vigv": Channel(t, y)})


def nothing(t, x):
    return t, 24.0 + 0.01 * np.sin(t), angles(GEOMETRY, 0, 24.0 + 0 * t)


def upwards(t, x):
    half = t < t[int(np.argmax(x))]
    return t[half], x[half], angles(GEOMETRY, 0, x[half])


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (nothing, "x_lvdt moves only 0.02 mm"),
        (upwards, "retraction is missing: x_lvdt from 1 to"),
        (lambda t, x: (t, x, -angles(GEOMETRY, 0, x)), "vigv changes by -1.0"),
        (lambda t, x: (t, x, 0.0 * x + 3.0), "vigv stays at 3 deg while x_lvdt moves from 1 to"),
        (
            lambda t, x: (t, 25.4 * x, angles(GEOMETRY, 0, x)),
            "x_lvdt (x_lvdt): 461 of 500 values are outside -25 to 75 mm",
        ),
        (lambda t, x: (t, 1.5 * x, angles(GEOMETRY, 0, x)), "x_lvdt (="),
        (lambda t, x: (t[:10], x[:10], angles(GEOMETRY, 0, x[:10])), "a loop needs at least 20"),
    ],
)
def test_a_log_without_a_loop_is_refused_in_one_line(make, says):
    with pytest.raises(LogError) as e:
        schedule(GEOMETRY, SCHEDULES, log_of(*make(*zigzag([1.0, 47.0, 1.0]))))
    assert says in str(e.value) and "\n" not in str(e.value)


def test_a_dead_potentiometer_of_vgv1_is_named_and_left_out():
    t, x = zigzag([1.0, 47.0, 1.0])
    log = Log(
        "loop.csv",
        {"x_lvdt": Channel(t, x), "vigv": Channel(t, angles(GEOMETRY, 0, x)), "vgv1": Channel(t, 0.0 * t + 3.0)},
    )
    r = schedule(GEOMETRY, SCHEDULES, log)
    assert set(r.loops) == {"vigv"}
    assert any("vgv1 is not measured" in n and "vgv1 stays at 3 deg" in n for n in r.notes)


def edited(name: str, tmp_path: Path, old: str, new: str) -> str:
    text = path(name).read_text()
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new))
    return str(tmp_path / name)


def refused(argv: list[str], capsys) -> str:
    assert main(["schedule", *argv]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "Traceback" not in err
    return err


def test_geometry_that_cannot_be_assembled_names_stage_stroke_and_quantity(tmp_path, capsys):
    file = edited("geometry.toml", tmp_path, "value = 497.1", "value = 300.0")
    assert "vigv cannot be assembled at stroke -2 mm: vertical link lc (=300)" in refused(["--geometry", file], capsys)


def test_a_vigv_schedule_beyond_the_stroke_names_speed_and_angle(tmp_path, capsys):
    file = edited("schedules.toml", tmp_path, "19.0, 19.3, 19.6, 20.1", "19.0, 19.3, 19.6, 40.0")
    assert "no stroke meets the schedule at 105 % speed: target angle (=40 deg)" in refused(
        ["--schedules", file], capsys
    )


def test_a_vgv1_schedule_that_no_length_meets_names_speed_stroke_and_error(tmp_path, capsys):
    file = edited("schedules.toml", tmp_path, "10.92, 11.12, 11.32, 11.65", "40.92, 41.12, 41.32, 41.65")
    said = refused(["--schedules", file], capsys)
    assert "vgv1: no length meets the schedule at 1" in said and "stroke" in said and "deg remains" in said


def test_speeds_as_shares_instead_of_per_cent_are_refused(tmp_path, capsys):
    end = "98.0, 99.0, 100.0, 101.0, 102.0, 105.0]"
    speeds = next(line for line in path("schedules.toml").read_text().splitlines() if line.endswith(end))[10:-1]
    shares = ", ".join(f"{float(v) / 100:g}" for v in speeds.split(", "))
    said = refused(["--schedules", edited("schedules.toml", tmp_path, speeds, shares)], capsys)
    assert "vigv rises from 0.4 to 1.05 % speed; it must reach into 40 to 102 %" in said


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["--step", "0"], "--step (=0 mm)"),
        (["--step", "nan"], "--step (=nan mm)"),
        (["--step", "0.001"], "too fine"),
        (["--criterion", "best"], "--criterion (='best')"),
        (["--adjust", "ld"], "--adjust: 'ld'"),
        (["--limit", "-1"], "--limit (=-1 deg)"),
        (["--log", "nowhere.csv"], "nowhere.csv"),
        (["--geometry", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_a_bad_option_is_refused_by_name_and_value(argv, says, capsys):
    assert says in refused(argv, capsys)


def test_a_csv_of_other_names_and_units_gives_the_same_loop(engine, tmp_path, capsys):
    rows = [line.split(",") for line in (engine / "loop.csv").read_text().split()]
    at = {name: rows[0].index(name) for name in ("t", "x_lvdt", "vigv")}
    lines = ["time,stroke,igv"]
    for i, r in enumerate(rows[1:]):
        igv = "nan" if i % 50 == 7 else repr(float(np.radians(float(r[at["vigv"]]))))
        lines.append(f"{r[at['t']]},{float(r[at['x_lvdt']]) * 1e-3!r},{igv}")
    (tmp_path / "other.csv").write_text("\n".join(lines) + "\n")
    names = [
        "--map",
        "time=t",
        "--map",
        "stroke=x_lvdt",
        "--map",
        "igv=vigv",
        "--unit",
        "x_lvdt=m",
        "--unit",
        "vigv=rad",
    ]
    assert main(["schedule", "--log", str(tmp_path / "other.csv"), *names, "--quiet", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["loops"]["vigv"]["width"] == pytest.approx(2.3, abs=0.05)


def test_a_log_without_stroke_or_angle_names_what_is_missing(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("t,n_dem\n" + "".join(f"{i},{50 + i}\n" for i in range(40)))
    assert "x_lvdt" in refused(["--log", str(tmp_path / "a.csv")], capsys)
    (tmp_path / "b.csv").write_text("t,x_lvdt,vigv\n" + "".join(f"{i},{1 + i},nan\n" for i in range(40)))
    assert "vigv" in refused(["--log", str(tmp_path / "b.csv")], capsys)


def test_nan_in_a_schedule_is_refused(tmp_path, capsys):
    file = edited("schedules.toml", tmp_path, "18.6, 19.0", "18.6, nan")
    assert "vigv.values.17 (=nan)" in refused(["--schedules", file], capsys)


@pytest.mark.parametrize("folder", ["missing", "empty"])
def test_a_folder_without_tables_is_refused(folder, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert main(["engine-test", "--tables", str(tmp_path / folder)]) == 2
    assert f"--tables {tmp_path / folder}" in capsys.readouterr().err


def test_nothing_is_written_into_a_place_that_is_no_folder(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert "cannot be made" in refused(["--quiet", "--out", str(tmp_path / "file")], capsys)
    with pytest.raises(InputError, match="lc"):
        geometry_with(GEOMETRY, {"vgv2": {"lc": 300.0}})
