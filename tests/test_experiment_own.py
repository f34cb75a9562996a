"""The next run of a user's own model: within its limits, as optimal as a closed form says, and an independent machine
that makes it is diagnosed without the rivals.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import vaneloop
from vaneloop.base.errors import InputError
from vaneloop.cli.main import main
from vaneloop.identification.user_models.by_log import bind
from vaneloop.identification.user_models.experiment import SHAPES, Limits, _Bench
from vaneloop.identification.user_models.system import Record, System, unknown

T = np.arange(0.0, 8.0, 0.02)
NOISE = 0.02


def amplifier() -> System:
    return System(
        "amplifier", "static", lambda u, p: p.gain * u.u, inputs={"u": "V"}, outputs={"y": "V"},
        parameters=[unknown("gain", 1.0, "-")], places=["u"],
    )  # fmt: skip


def machine(u: np.ndarray, seed: int = 1) -> Record:
    """What the amplifier really does: nothing passes below 0.5 V."""
    y = 2.0 * np.sign(u) * np.maximum(np.abs(u) - 0.5, 0.0)
    return Record("run", T, {"u": u, "y": y + NOISE * np.random.default_rng(seed).standard_normal(len(u))})


LOG = machine(2.0 + 0.5 * np.sin(0.4 * T) + 0.5 * np.sin(1.7 * T + 1.0))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--limit", "u=1"], "--limit u=1: must be NAME=LOW:HIGH, two numbers"),
        (["--limit", "u=2:1"], "--limit u=2:1: the low end must be below the high one, both finite"),
        (["--rate", "u=0"], "--rate u=0: must be a number above 0"),
        (["--seconds", "nan"], "--seconds nan: must be a number above 0"),
        (["--tables", "x"], "--tables does not go with --system"),
    ],
)
def test_bad_limits_get_one_line(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "a.csv", "--system", "a.py", *words]) == 2
    assert capsys.readouterr().err == f"vaneloop: {said}\n"


def test_limits_without_a_model_of_one_s_own_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "a.csv", "--limit", "n_dem=50:90"]) == 2
    assert capsys.readouterr().err == "vaneloop: --limit needs --system MY.py\n"


def test_every_run_keeps_its_range_and_rate() -> None:
    bound = bind(amplifier(), [LOG]).fitted
    bench = _Bench(bound, Limits({"u": (-3.0, 1.0)}, {"u": 5.0}, 12.0))
    assert bench.t[-1] == pytest.approx(12.0)
    rng = np.random.default_rng(0)
    runs = [bench.of_shape(shape, size)["u"] for shape in SHAPES.values() for size in (1.0, 0.3)]
    runs += [bench.shifted({"u": u}, rng)["u"] for u in runs]
    for u in (*runs, bench.log_again["u"]):
        assert u.min() >= -3.0 and u.max() <= 1.0 and np.abs(np.diff(u)).max() <= 5.0 * bench.t[1] + 1e-9
    assert max(u.max() for u in runs) > 0.9 and min(u.min() for u in runs) < -2.9  # and uses what it may
    below = _Bench(bound, Limits({"u": (-3.0, 3.0), "y": (-1.0, 1.0)}))
    theta = bound.stage.neutral()
    assert below.simulated({"u": np.full(len(below.t), 2.0)}, theta, np.ones(1), 0) is None  # y would be 3 or so
    for limits, said in (
        (Limits({"v": (0.0, 1.0)}), "limit 'v'"),
        (Limits(rates={"y": 1.0}), "rate 'y'"),
        (Limits(seconds=0.5), "25 samples; allowed: 50 or more"),
    ):
        with pytest.raises(InputError, match=said):
            _Bench(bound, limits)


@pytest.mark.slow
def test_the_run_that_is_recommended_tells_the_rivals_of_the_log_apart() -> None:
    """The log stays above the dead zone, where it is a bias: only a run through zero tells them apart. The machine that
    makes the run is this test's own.
    """
    system = amplifier()
    found = vaneloop.diagnose(LOG, system)
    (effect,) = found.diagnosis.stages[0].effects
    assert {effect.effect, *effect.rivals} == {"u.bias", "u.dead_zone"}
    none = vaneloop.experiment(LOG, found)
    assert none.recommended is not None and not none.recommended["separates"]
    assert none.sentence().startswith("No run within the limits separates u.")
    best = vaneloop.experiment(LOG, found, limits=Limits({"u": (-3.0, 3.0)}))
    assert best.recommended is not None and best.recommended["separates"]
    assert "in 4 of 4 simulations with noise the right law is told" in best.sentence()
    rows = best.rows()
    assert best.sentence().count(f"{rows[0]['told']:.2f} times") == 1  # the table's best is the sentence's
    assert [r["told"] for r in rows] == sorted((r["told"] for r in rows), reverse=True)
    assert best.recommended["profile"] != "steps to 100 random levels"  # four samples a level: that looks like noise
    unit, u = best.recommended["inputs"]["u"]
    again = vaneloop.diagnose(machine(u, 2), system)
    (effect,) = again.diagnosis.stages[0].effects
    assert unit == "V" and (effect.effect, effect.rivals) == ("u.dead_zone", [])


@pytest.mark.slow
def test_without_rivals_the_run_is_as_good_as_a_closed_form_allows() -> None:
    """Of a straight line over -1 to 1 the best run is at the ends, as long at each: the information is the identity."""
    system = System(
        "line", "static", lambda u, p: p.offset + p.slope * u.u, inputs={"u": "V"}, outputs={"y": "V"},
        parameters=[unknown("offset", 0.5, "V"), unknown("slope", 1.0, "-")], places=["u"],
    )  # fmt: skip
    u = 0.6 + 0.3 * np.sin(1.3 * T)
    y = 0.2 + 2.0 * u + NOISE * np.random.default_rng(1).standard_normal(len(T))
    answer = vaneloop.experiment(Record("run", T, {"u": u, "y": y}), system, limits=Limits({"u": (-1.0, 1.0)}))
    assert answer.recommended is not None and answer.recommended["separates"]
    assert answer.sentence().startswith("No rivals are left. For the parameters: ")
    regressors = np.stack([np.ones(len(T)), u])
    of_log = np.linalg.slogdet(regressors @ regressors.T / len(T))[1]
    told = answer.rows()[0]["told"]
    assert isinstance(told, float) and np.exp(0.25 * of_log) * 0.999 <= told <= np.exp(0.25 * of_log) * 1.02


@pytest.mark.slow
def test_the_command_writes_the_run_as_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path(__file__).parents[1] / "examples"
    words = ["experiment", f"{folder}/tank.csv", "--system", f"{folder}/tank.py", "--limit", "level=2:60"]
    out = tmp_path / "next.csv"
    assert main([*words, "--rate", "pump=4", "--out", str(out), "--report", str(tmp_path / "page.html")]) == 0
    said = capsys.readouterr().out
    assert "standard errors are" in said and "4 simulated runs with noise scatter" in said
    run = vaneloop.read_log(out, signals={"pump": "V"}, require=["pump"])["pump"]
    assert run.values.min() >= 0.2 and run.values.max() <= 7.9 and np.abs(np.diff(run.values)).max() <= 4.0 + 1e-6
    assert "The next experiment" in (tmp_path / "page.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_windowed_model_s_run_is_what_the_machine_would_do() -> None:
    """The log restarts the model each two seconds; a proposed run is one free course of the same equation."""
    t = np.arange(0.0, 20.0, 0.01)
    rng = np.random.default_rng(0)
    u, w = np.repeat(rng.uniform(0.0, 5.0, 40), 50), np.zeros(len(t))
    for k in range(1, len(t)):
        w[k] = w[k - 1] + 0.01 * (0.8 * u[k - 1] - 0.6 * w[k - 1])
    system = System(
        "rotor", "simulate", lambda x, u, p: p.a * u.u - p.c * x.w, inputs={"u": "V"}, states={"w": "rad/s"},
        outputs={"w": "rad/s"}, window=2.0, parameters=[unknown(n, 1.0, "-") for n in "ac"], places=["w"],
    )  # fmt: skip
    bound = bind(system, [Record("run", t, {"u": u, "w": w})]).fitted
    bench = _Bench(bound, Limits())
    run = bench.of_shape(SHAPES["stairs up and down with dwells"], 1.0)
    on = bench.simulated(run, bound.stage.neutral(), np.ones(1), 0)
    assert on is not None
    a, c = bound.stage.neutral()[:2]
    decay = np.exp(-c * bench.t[1])
    exact = np.zeros(len(bench.t))  # of a held input, step by step in closed form
    for k in range(1, len(exact)):
        exact[k] = decay * exact[k - 1] + (1.0 - decay) * a / c * run["u"][k - 1]
    assert np.abs(on.measured[0] - exact).max() < 1e-3 * exact.max()
