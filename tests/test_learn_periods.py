"""Laws that repeat themselves in time: their periods against closed forms, what is driven and no period, and from a log
to a file that another log and the loop take.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lsim, lti

from hil.logs import Channel, Log
from plant import Model, build_plant, load_model
from plant.curve import LVDT_ADDS, S_TIME, bend, quantity_of
from plant.effects import N_STATE
from plant.model import Learned
from tests import rig
from tests.firmware_on_rig import firmware
from tests.test_learn import TANK
from tests.test_learn_vanes import columns, curved, law
from vaneloop import Record, System
from vaneloop.base.durations import in_name, of_name, period_of, within_no_period
from vaneloop.base.errors import InputError
from vaneloop.base.tables import read
from vaneloop.identification import StageError
from vaneloop.identification.candidates.spline_basis import waves_of
from vaneloop.identification.settings import FINE_HARMONICS
from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.unmodelled.spectral_lines import Course, Lines
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.exogenous_regressors import every
from vaneloop.identification.user_models.injection_points import from_file
from vaneloop.verbs.learn import learn, learned
from vaneloop.verbs.search import diagnose, diagnosed

Array = np.ndarray


# ---- names and curves


@pytest.mark.slow
@given(st.floats(1e-8, 1e5), st.integers(3, 8))
def test_the_name_of_a_period_says_how_long(period: float, digits: int) -> None:
    name = f"place.curve_of_time_every_{in_name(period, digits)}"
    channel, said = of_name(name, "every") or ("", 0.0)
    assert channel == within_no_period(name) == "place.curve_of_time"
    assert "." not in name.removeprefix("place.")
    assert said == pytest.approx(period, rel=max(0.5 * 10.0 ** (1 - digits), 0.5e-9 / period))


@given(st.floats(1e-3, 1e3), st.floats(6.0, 1e4))
def test_a_period_is_named_so_closely_that_the_last_cycle_still_fits(period: float, cycles: float) -> None:
    said = period_of(every(period, cycles))
    assert abs(cycles * (said - period)) < 0.05 * period


@given(st.floats(1e-3, 10.0), st.integers(0, 1000))
def test_a_curve_that_repeats_itself_is_waves_without_a_seam(period: float, seed: int) -> None:
    basis = waves_of(period)
    a = np.random.default_rng(seed).standard_normal(7)
    t = np.linspace(0.0, period, 400, endpoint=False)
    wave = [np.ones(len(t))] + [
        np.sqrt(2.0) * f(2.0 * np.pi * k * t / period) for k in (1, 2, 3) for f in (np.sin, np.cos)
    ]
    ours = basis.design(t) @ basis.turn @ a
    assert ours == pytest.approx(a @ np.array(wave), abs=0.01 * np.abs(a).sum())
    ends = basis.design(np.array([0.0, period])) @ basis.turn @ a
    assert ends[0] == pytest.approx(ends[1], abs=0.01 * np.abs(a).sum())


def test_a_law_file_holds_the_finest_waves() -> None:
    basis = waves_of(20.0, FINE_HARMONICS)
    values = basis.turn @ np.random.default_rng(1).standard_normal(basis.turn.shape[1])
    law = Learned(
        how="times", at="actuator.flow_gain", of="time_every_20_s", low=0.0, high=20.0, values=list(values),
        knots=list(basis.knots),
    )  # fmt: skip
    x = np.linspace(0.0, 20.0, 257)
    assert law.table()(np.array(law.values)) == pytest.approx(basis.design(x) @ values)


# ---- periods


def course(seed: int, wave: float, f: float, phase: float = 0.0, driver: Array | None = None) -> Course:
    rng = np.random.default_rng(seed)
    t = np.arange(4000) * 0.01
    pushed = np.repeat(rng.uniform(-1.0, 1.0, 100), 40) if driver is None else driver
    error = rng.standard_normal(len(t)) + wave * np.sin(2.0 * np.pi * f * t + phase)
    return Course(t, error[None], pushed[None])


@given(st.integers(0, 10_000), st.floats(0.5, 35.0), st.floats(0.4, 3.0))
def test_a_wave_in_the_error_is_found_and_noise_is_none(seed: int, f: float, wave: float) -> None:
    (found, *more) = Lines([course(seed, wave, f)]).periods()
    assert not more
    known = np.sqrt(24.0 / 4000.0) / (2.0 * np.pi * wave)  # turns over the whole log, at best (Rife and Boorstyn 1974)
    assert abs(found - 1.0 / f) * f * f * 40.0 < 5.0 * known
    assert Lines([course(seed, 0.0, f)]).periods() == []


@pytest.mark.slow
@given(st.integers(0, 10_000), st.floats(0.5, 35.0))
def test_a_gain_that_swings_is_found_beside_the_motion_that_it_acts_on(seed: int, f: float) -> None:
    rng = np.random.default_rng(seed)
    plain = course(seed, 0.0, f)
    motion = np.repeat(rng.choice([-1.0, 1.0], 200) * rng.uniform(0.5, 1.5, 200), 20)
    motion -= motion.mean()
    c = plain._replace(error=plain.error + motion * np.sin(2.0 * np.pi * f * plain.t))
    found = Lines([c]).periods([motion[None]])
    assert any(abs(p - 1.0 / f) * f * f * 40.0 < 0.2 for p in found)


@pytest.mark.parametrize("seed", range(8))
def test_a_gain_that_swings_faster_than_the_model_answers_is_found(seed: int) -> None:
    """A spring that swings, in an oscillator of 0.7 Hz: what it does lags, and is not what a steady one does."""
    rng = np.random.default_rng(seed)
    t, own = np.arange(4000) * 0.01, 2.0 * np.pi * 0.7
    f, lag = rng.uniform(1.5, 6.0), rng.random()
    oscillator = lti([1.0], [1.0, 0.4 * own, own**2])
    pushed = rng.uniform(-1.0, 1.0, 40)[np.searchsorted(np.sort(rng.uniform(0.0, 40.0, 39)), t)]
    at = lsim(oscillator, pushed, t)[1]
    more = lsim(oscillator, at * np.sin(2.0 * np.pi * (f * t + lag)), t)[1]
    noise = 0.05 * np.std(more) * rng.standard_normal(len(t))
    c = Course(t, (more + noise)[None], pushed[None], at[None])
    assert any(abs(p - 1.0 / f) * f * f * 40.0 < 0.3 for p, _ in Lines([c]).fast())


@pytest.mark.parametrize("seed", range(8))
def test_noise_has_no_fast_gain(seed: int) -> None:
    rng = np.random.default_rng(seed)
    said = np.cumsum(rng.standard_normal((2, 4000)), axis=1)
    assert Lines([course(seed, 0.0, 1.0)._replace(said=said)]).fast() == []
    assert Lines([course(seed, 2.0, 1.0)]).fast() == []  # nothing is known of what the model says


@given(st.integers(0, 10_000), st.floats(0.5, 5.0), st.integers(1, 5))
def test_what_drives_the_model_has_no_period_of_time(seed: int, f: float, order: int) -> None:
    t = np.arange(4000) * 0.01
    assert Lines([course(seed, 3.0, order * f, driver=np.sin(2.0 * np.pi * f * t))]).periods() == []
    again = np.tile(np.repeat(np.random.default_rng(seed).standard_normal(100), 10), 4)  # the same four times
    assert Lines([course(seed, 3.0, order / 10.0 + 1.0, driver=again)]).periods() == []


@pytest.mark.parametrize("seed", range(4))
def test_dips_of_a_gain_are_found_at_their_own_period_and_not_at_a_part_of_it(seed: int) -> None:
    """A second consumer draws for a seventh of each 20 s, while motion comes and goes: no line stands out."""
    rng = np.random.default_rng(seed)
    t = np.arange(30_000) * 0.01
    phase = (t / 20.0) % 1.0
    dips = np.where(phase < 0.15, np.sin(np.pi * phase / 0.15), 0.0)
    motion = np.repeat(rng.standard_normal(60) * (rng.random(60) < 0.5), 500)
    wander = np.cumsum(rng.standard_normal(len(t))) * 0.01  # it has much of what is slow, and no line
    c = Course(t, (0.3 * rng.standard_normal(len(t)) - 2.0 * dips * motion)[None], wander[None])
    period, harmonics = Lines([c]).found([motion[None]])[0]
    assert period == pytest.approx(20.0, rel=0.005)
    assert harmonics == FINE_HARMONICS


def test_a_drive_that_swings_for_a_while_and_later_in_another_phase_has_no_line() -> None:
    t = np.arange(30_000) * 0.01
    swing, turned = (np.sin(2.0 * np.pi * 0.5 * t + phase) for phase in (0.0, 1.6))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        drive = 0.1 * rng.standard_normal(len(t)) + swing * (abs(t - 92.0) < 9.0) + turned * (abs(t - 212.0) < 9.0)
        error = swing + 0.5 * rng.standard_normal(len(t))
        assert Lines([Course(t, error[None], drive[None])]).periods()[0] == pytest.approx(2.0, rel=0.001)


def test_of_two_logs_a_driven_line_counts_where_its_phase_is_the_same() -> None:
    t = np.arange(4000) * 0.01
    rng = np.random.default_rng(1)
    both = [np.sin(2.0 * np.pi * 1.7 * t + p) + 0.5 * rng.standard_normal(len(t)) for p in (0.0, 2.0)]
    alike = [course(k, 2.0, 1.7, 0.3, driver=u) for k, u in enumerate(both)]
    assert [round(1.0 / p, 2) for p in Lines(alike).periods()] == [1.7]
    unlike = [course(k, 2.0, 1.7, 0.3 + 2.0 * k, driver=u) for k, u in enumerate(both)]
    assert Lines(unlike).periods() == []


# ---- from a log to a law


def hummed(seed: int, name: str, size: float, drift: float = 0.0, n: int = 1500) -> Record:
    """A tank whose pump hums, so that its flow swings with 0.11 Hz, and whose gain drifts; what it is told is known."""
    t = np.arange(float(n))
    rng = np.random.default_rng(seed)
    pump = np.repeat(rng.uniform(0.0, 8.0, n // 50), 50)
    x, level = 20.0, []
    for k in range(n):
        level.append(x)
        for m in range(20):
            at = t[k] + m / 20.0
            told = pump[k] * (1.0 + drift * np.tanh((at - 700.0) / 150.0))
            x += 0.05 * (0.2 * (told + size * np.sin(2.0 * np.pi * 0.11 * at)) - 0.05 * x)
    noise = 0.05 * rng.standard_normal(n)
    return Record(name, t, {"pump": pump, "oil": 40.0 + 0.01 * t, "level": np.array(level) + noise})


HELD = replace(TANK, between="hold")


def left_by(system: System, model: Model, log: Record, values: Mapping[str, float]) -> float:
    """RMS of what a model with these ``values`` of its parameters leaves of the first output."""
    bound = BoundSystem(system, [log], values=values, present=model.effects, curves=model.curves)
    return float(np.std(bound.measured[0] - bound.run(bound.stage.neutral()[None])[0, 0]))


@pytest.fixture(scope="module")
def humming():
    return learn([hummed(1, "one", 1.0)], HELD, test=[hummed(2, "two", 1.0)])


@pytest.mark.slow
def test_a_hum_is_learned_with_its_period_and_size(humming) -> None:
    assert humming.verdict == "learned"
    (found,) = humming.laws
    names = {within_no_period(n) for n in (found.name, *found.rivals)}
    assert "pump.curve_of_time" in names
    assert period_of(found.of) == pytest.approx(1.0 / 0.11, rel=1e-3)
    assert "within each 9.09" in humming.sentence()
    assert not any("stays as at its end" in note for note in humming.notes)
    if found.at == "pump":
        assert np.ptp(found.y) == pytest.approx(2.0, rel=0.1)
    before, *_, after = (by["two"][0] for by in humming.by_log.steps.values())
    assert before > 0.15 and after < 0.06


@pytest.mark.slow
def test_its_file_says_the_same_to_another_log(humming, tmp_path) -> None:
    humming.write(tmp_path / "law.toml")
    model = read(tmp_path / "law.toml", Model)
    (name,) = model.curves
    other = hummed(3, "three", 1.0)
    data = BoundSystem(HELD, [other]).data
    placed, _ = from_file(name, model.curves[name], data)
    assert np.allclose(data.column(0, placed.curve.quantity), other.t % period_of(placed.curve.quantity))

    plain = Model(parameters=model.parameters)
    before, after = (left_by(HELD, m, other, model.parameters) for m in (plain, model))
    assert before > 0.15 and after < 0.06
    wrong = model.curves[name].model_copy(update={"of": "time_every_0_s"})
    with pytest.raises(StageError, match="time_every_0_s"):
        from_file(name, wrong, data)


def step_of(learner: CurveSearch, current: FittedCandidate) -> tuple[str | int, ...]:
    """Which step of the search it is: numbers that the model has to begin with, and the curves that were learned."""
    return len(learner.base.theta), *(q.effect for q, _ in current.curves)


def learned_where_the_gain_drifts():
    return learn([hummed(1, "one", 1.0, 0.4)], HELD, test=[hummed(2, "two", 1.0, 0.4)])


@pytest.fixture(scope="module")
def drifting():
    """What is learned beside a gain that drifts, its diagnosis, and the candidates that each step found."""
    found: dict[tuple[str | int, ...], list[FittedCandidate]] = {}
    diagnoses = []

    def finalists(self, current: FittedCandidate) -> list[FittedCandidate]:
        now = search(self, current)
        found.setdefault(step_of(self, current), now)
        return now

    def diagnosed_once(*words, **options):
        diagnoses.append(diagnose(*words, **options))
        return diagnoses[-1]

    search = CurveSearch.finalists
    with pytest.MonkeyPatch.context() as m:
        m.setattr(CurveSearch, "finalists", finalists)
        m.setattr("vaneloop.verbs.learn.diagnose", diagnosed_once)
        return learned_where_the_gain_drifts(), *diagnoses, found


@pytest.mark.slow
def test_a_hum_beside_a_gain_that_drifts_is_the_second_law(drifting) -> None:
    answer, *_ = drifting
    first, second = answer.laws
    # in these logs the oil is a straight line of time: a gain that drifts is one of either
    assert first.of in ("time", "oil") and first.how.endswith("times")
    assert "inflow.gain_of_time" in (first.name, *first.rivals)
    assert period_of(second.of) == pytest.approx(1.0 / 0.11, rel=1e-3)


@pytest.mark.slow
def test_a_second_law_that_harms_a_log_is_told_and_the_first_one_stands(drifting, monkeypatch) -> None:
    """The same logs, with the candidates that were found for them."""
    _, diagnosis, found = drifting
    harmful = CurveSearch.objection

    def second_harms(self, current, best) -> str:
        return "makes two worse" if current.curves else harmful(self, current, best)

    monkeypatch.setattr(CurveSearch, "objection", second_harms)
    monkeypatch.setattr(CurveSearch, "finalists", lambda self, current: found[step_of(self, current)])
    monkeypatch.setattr("vaneloop.verbs.learn.diagnose", lambda *_, **__: diagnosis)
    answer = learned_where_the_gain_drifts()
    (first,) = answer.laws
    assert first.of in ("time", "oil") and any("is not learned: makes two worse" in note for note in answer.notes)


def test_a_tank_that_does_not_hum_learns_nothing() -> None:
    assert learn([hummed(4, "one", 0.0)], HELD, test=[hummed(5, "two", 0.0)]).laws == []


# ---- the vane chain


@given(st.floats(-50.0, 1e4), st.floats(0.01, 20.0))
def test_in_the_plant_a_curve_of_time_repeats_itself(t: float, period: float) -> None:
    name = f"time_every_{in_name(period, 9)}"
    said = period_of(name)
    p = build_plant(
        model=curved(law("sensors.lvdt adds", name, "sine", 0.4, 2 * np.pi / said, 1.0, low=0.0, high=said))
    ).p
    s = np.zeros((N_STATE, 1))
    s[S_TIME] = t
    assert bend(s, p, 0, LVDT_ADDS) == pytest.approx(0.4e-3 * np.sin(2 * np.pi * t / said + 1.0), abs=1e-6)


def test_in_the_loop_a_hum_moves_the_stroke_and_one_of_nothing_no_bit() -> None:
    law_of = {size: law("sensors.lvdt adds", "time_every_270_ms", "sine", size, 23.27, 0.0) for size in (0.0, 0.4)}
    plain, still, moved = (columns(m) for m in (Model(), *(curved(law_of[size]) for size in (0.0, 0.4))))
    assert np.array_equal(plain, still, equal_nan=True)
    assert np.nanmax(np.abs(moved - plain)) > 0.1


def test_what_no_machine_has_a_period_of_is_refused() -> None:
    assert quantity_of("time_every_20_ms").period == 0.02
    for name in ("n_r_every_20_ms", "time_every_20", "time_every_0_ms", "every_20_ms"):
        assert quantity_of(name) is None
        with pytest.raises(InputError, match="time_every_TIME"):
            build_plant(model=curved(law("sensors.lvdt adds", name, "line", 0.4)))


@pytest.mark.slow
def test_an_oscillating_driver_is_learned_from_a_log_of_the_rig(tmp_path) -> None:
    hidden = rig.draw("driver_oscillation", 3, np.random.default_rng(1))
    run = rig.simulate(rig.manoeuvre(12, 40.0), firmware(), [hidden], seed=12, rate=100, randomised=False)
    log = Log("rig", {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"})
    from vaneloop.identification.vane_chain.chain import build_chain

    chain = build_chain(log)
    chain.stages[:] = [s for s in chain.stages if s.name == "actuator"]
    answer = learned(chain, "rig", Model(), 1, None, diagnosed(chain, "rig", 1))
    (found,) = answer.laws
    assert found.at == "valve.current"
    assert 1.0 / period_of(found.of) == pytest.approx(hidden.parameters["frequency"], rel=1e-3)
    assert 0.5 * np.ptp(found.y) == pytest.approx(1e3 * hidden.parameters["amplitude"], rel=0.1)
    answer.write(tmp_path / "law.toml")
    again = build_chain(log, build_plant(model=load_model(tmp_path / "law.toml"))).stages
    stage = next(s for s in again if s.name == "actuator")
    before = next(s for s in build_chain(log).stages if s.name == "actuator")
    left = [np.sqrt(np.nanmean((s.run(s.neutral()[None])[0] - s.measured) ** 2)) for s in (before, stage)]
    assert left[1] < 0.3 * left[0]
