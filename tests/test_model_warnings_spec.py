"""What a user's own model is warned of, and what its logs say before anything is searched: parameters at bounds, inputs
held between samples, starts that matter, courses of states that nobody measures, sizes of what acts at a place.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy
from numba import njit

from tests.test_user_models_spec import T, mover, record, turning
from vaneloop.identification import System, unknown
from vaneloop.identification.candidates import laws
from vaneloop.identification.settings import NO_HELP
from vaneloop.identification.subsystem import Array, Effect, Parameter
from vaneloop.identification.user_models import by_log, injection_points, motion
from vaneloop.identification.user_models.bound_system import BoundSystem, rms_of_rows, steps_seen
from vaneloop.identification.user_models.by_log import ByLog, _between, _pulled, _seeded, parameter_warnings
from vaneloop.identification.user_models.data import Data, noise_of_channel
from vaneloop.identification.user_models.exogenous_regressors import forgotten, is_memory
from vaneloop.identification.user_models.injection_points import Course, _ends, _force, _hidden, places
from vaneloop.identification.user_models.terms import Surface
from vaneloop.identification.user_models.user_code import InATuple

# docs/settings.md
BOUND_PULL, DRIVES, LEAST_FALL, BEFORE_LOG, QUANTUM_FREQUENCIES, START_FORGOTTEN = 0.01, -0.05, 0.2, 0.05, 6000, 0.2
MOVES, FORCE_SHARE = 0.3, 0.9995


# ---- parameters at their bounds --------------------------------------------------------------------------------------


def warned(p: Parameter, value: float, pull: float = 0.0, base: float = 9.0, spared: tuple[int, ...] = ()) -> list[str]:
    """What is said of one parameter at a value; ``pull``: how far below its cost the logs would have it go, times that
    which counts.
    """
    gradient = np.sqrt(abs(pull) * BOUND_PULL * 100.0) * np.sign(pull)
    fit = SimpleNamespace(
        theta=np.array([value]), free=np.array([0]), gradients=np.array([[gradient], [0.0]]),
        normals=np.array([[[0.25]], [[0.75]]]), cost=np.array([40.0, 60.0]), effects=(),
    )  # fmt: skip
    bound: Any = SimpleNamespace(
        stage=SimpleNamespace(parameters=(p,), index=dict), placed=[], system=SimpleNamespace(kind="static")
    )
    d: Any = SimpleNamespace(final=fit, base=SimpleNamespace(theta=np.array([base])))
    judge: Any = SimpleNamespace(spared=spared)
    return parameter_warnings(bound, judge, d)


def test_a_parameter_at_its_bound_is_said_and_that_the_logs_would_have_it_go_on() -> None:
    p = Parameter("c", 2.0, "N", 0.5, 4.0, np.inf, scale=3.0)
    stands = "c stands at its bound, {} N"
    go_on = ": the logs would have it go beyond; is a sign the other way round?"
    for value, limit, side in ((4.0, "4", 1.0), (0.5, "0.5", -1.0)):
        near = 1e-6 * max(value, 3.0)
        assert warned(p, value) == [stands.format(limit)]
        assert warned(p, value - side * 0.9 * near) == [stands.format(limit)]
        assert warned(p, value - side * 1.1 * near) == []
        assert warned(p, value, 1.01 * side) == [stands.format(limit) + go_on]
        assert warned(p, value, 0.99 * side) == [stands.format(limit)]
        assert warned(p, value, -9.0 * side) == [stands.format(limit)]  # it would go back
        assert warned(p, value, spared=(0,)) == [] and warned(p, value, spared=(1,)) != []
    assert warned(p, 2.0, 9.0) == []
    assert warned(Parameter("c", 2.0, "N", 2.0, 4.0, 0.0), 2.0) == []  # it is known
    zero = Parameter("c", 2.0, "N", 0.0, 4.0, np.inf)
    assert warned(zero, 0.0) == [] and warned(zero, 0.0, base=0.0) == [stands.format("0")]  # not needed any more


def test_a_parameter_at_the_end_of_its_tolerance_is_said_where_the_logs_would_have_it_go_on() -> None:
    p = Parameter("c", 2.0, "N", 0.5, 40.0, 1.0)
    for value, side in ((3.0, 1.0), (1.0, -1.0)):
        assert warned(p, value, 0.99 * side) == []
        assert warned(p, value, 1.01 * side) == [
            f"c stands at the end of its tolerance, {value:g} N: the logs would have it go on"
        ]


def test_what_is_not_fitted_is_not_pulled() -> None:
    fit: Any = SimpleNamespace(
        free=np.array([0, 2]), gradients=np.array([[9.0, 5.0]]), normals=np.array([np.diag([1.0, 0.0])]),
        cost=np.array([1.0]),
    )  # fmt: skip
    judge: Any = SimpleNamespace()
    assert _pulled(fit, judge, 0, 1.0) and not _pulled(fit, judge, 0, -1.0)
    assert not _pulled(fit, judge, 1, 1.0)
    assert not _pulled(fit, judge, 2, 1.0)  # what does nothing to the model cannot be told


@pytest.mark.parametrize("share", [-0.9, -0.06, -0.04, 0.5])
def test_a_force_that_gives_power_is_said(share: float) -> None:
    v = np.sin(T)
    other = np.cos(T)
    other -= v * (other @ v) / (v @ v)
    other *= np.sqrt((v @ v) / (other @ other))
    force = 3.0 * (share * v + np.sqrt(1.0 - share**2) * other)
    force = np.append(force, np.nan)
    bound: Any = SimpleNamespace(
        system=SimpleNamespace(kind="force", outputs={"f": "N"}), logs={"log": slice(0, 61)},
        data=SimpleNamespace(u=[np.array([np.zeros(61), np.append(v, 0.0)])]), measured=force[None],
    )  # fmt: skip
    said = by_log._against(bound)
    assert bool(said) == (share < DRIVES)
    assert not said or said[0].startswith("log: f acts against the motion, so that the machine gives power")
    bound.measured = np.full((1, 61), np.nan)
    assert by_log._against(bound) == []


@pytest.mark.parametrize(("after", "said"), [(41.1, False), (40.9, True)])
def test_inputs_that_had_better_run_straight_are_said(after: float, said: bool) -> None:
    @dataclass
    class Held:
        kind: str = "simulate"
        holds: bool = True
        inputs: tuple[str, ...] = ("u",)
        between: str = "hold"

    seen: list[Any] = []
    system = Held()
    runner = SimpleNamespace(system=system)
    bound: Any = SimpleNamespace(system=system, runner=runner)
    final = SimpleNamespace(cost=np.array([20.0, 31.0]), effects=("a",), theta=np.array([1.0]))
    d: Any = SimpleNamespace(excess=9.0, final=final)

    def fit(effects: Any, theta: Any, steps: int) -> Any:
        seen.append((effects, theta.tolist(), runner.system.between))
        return SimpleNamespace(cost=np.array([0.1, after - 0.1]))

    judge: Any = SimpleNamespace(fit=fit, n=1)  # before 51; a fifth of the 50 that are no noise
    found = _between(bound, judge, d)
    assert bool(found) == said and seen == [(("a",), [1.0], "line")] and runner.system is system
    if said:
        share = np.sqrt(after / 51.0)
        assert found == [
            f'inputs are held from sample to sample; with between="line" the error is {share:.2f} times as large'
        ]
    for change in ({"kind": "static"}, {"holds": False}, {"inputs": ()}):
        bound.system = Held(**change)
        assert _between(bound, judge, d) == []
    bound.system, d.excess = system, 1.0
    assert _between(bound, judge, d) == [] and len(seen) == 1

    def fails(*_: Any) -> Any:
        raise ValueError

    d.excess, judge.fit = 9.0, fails
    with pytest.raises(ValueError):
        _between(bound, judge, d)
    assert runner.system is system  # whatever happens


def test_a_law_that_hardly_helps_on_a_log_and_a_parameter_that_is_not_needed_are_noted() -> None:
    p = (Parameter("c", 2.0, "N", 0.0, 4.0, np.inf), Parameter("k", 2.0, "N", 0.0, 4.0, 0.0),
         Parameter("m", 2.0, "kg", 0.0, 4.0, np.inf), Parameter("b", 2.0, "N", -1.0, 4.0, np.inf))  # fmt: skip
    bound: Any = SimpleNamespace(
        stage=SimpleNamespace(parameters=p, index=dict), placed=[], system=SimpleNamespace(kind="static"), present={}
    )
    final = SimpleNamespace(theta=np.array([0.0, 0.0, 0.0, 0.0]), effects=(), free=np.arange(0))
    d: Any = SimpleNamespace(
        final=final, base=SimpleNamespace(theta=np.array([1.5, 1.5, 0.0, 1.5])), notes=["d"], excess=1.0
    )
    ratios = {"a": {"one": NO_HELP - 1e-3, "two": NO_HELP + 1e-3, "three": 0.979, "four": 0.981}}
    own: Any = SimpleNamespace(logs=SimpleNamespace(fitted=bound), d=d, notes=["n"], ablation=ratios)
    ByLog._remark(own, SimpleNamespace(spared=()))  # type: ignore[arg-type]
    assert own.notes[:5] == [
        "n", f"a hardly helps on two: error with it over error without it is {NO_HELP + 1e-3:.2f}",
        "a hardly helps on three: error with it over error without it is 0.98",
        "a does not help on four: error with it over error without it is 0.98",
        "c: not needed any more, set to 0 (it was 1.5 N while  was missing)",
    ]  # fmt: skip
    assert own.notes[5] == "d" and [n for n in own.notes if "not needed" in n] == own.notes[4:5]


def test_a_fit_begins_with_its_laws_as_they_were_found() -> None:
    index = {"a": slice(2, 3), "b": slice(3, 5)}
    bound: Any = SimpleNamespace(stage=SimpleNamespace(
        neutral=lambda: np.zeros(5), parameters=("p", "q"), index=lambda: index
    ))  # fmt: skip
    base, final = np.arange(10.0, 15.0), np.arange(1.0, 6.0)
    assert _seeded(bound, base, final, ("b",)).tolist() == [1.0, 2.0, 0.0, 4.0, 5.0]
    assert _seeded(bound, base, final, ("a",)).tolist() == [1.0, 2.0, 3.0, 0.0, 0.0]
    assert _seeded(bound, base, final, ()).tolist() == [10.0, 11.0, 0.0, 0.0, 0.0]


# ---- starts and steps ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("slope", "matters"), [(0.99, False), (1.01, True)])
def test_noise_in_readings_that_states_start_at_matters_beyond_a_fifth_of_an_output_s(
    slope: float, matters: bool
) -> None:
    runs: list[Array] = []
    runner = SimpleNamespace(free_starts=[(0, 9)])

    def run(thetas: Array) -> Array:
        assert runner.free_starts == [(0, 9), (0, 0), (1, 0)]
        runs.append(thetas)
        # the first output goes with the starts of both logs, which move at one time, and the second with nothing
        first = slope * 0.5 * START_FORGOTTEN * thetas[:, 2:4].sum(axis=1)
        return np.stack([np.repeat(first[:, None], 8, axis=1), np.full((len(thetas), 8), 5.0)], axis=1)

    own: Any = SimpleNamespace(
        data=SimpleNamespace(noise=lambda: np.array([0.4, 7.0]), first_state=lambda log, name, other: 3.0 + log),
        runner=runner, run=run, system=SimpleNamespace(outputs={"h": "m", "y": "V"}, parameters=("a",)),
        _read=lambda: [(0, 0, "h"), (1, 0, "h")],
    )  # fmt: skip
    values = np.array([2.0, 0.5])
    assert BoundSystem._starts_matter(own, values) == matters
    assert runs[0][0].tolist() == [2.0, 0.5, 3.0, 4.0] and len(runs[0]) == 2
    assert (runs[0][1] - runs[0][0])[2:] == pytest.approx([0.1 * 0.4] * 2) and runner.free_starts == [(0, 9)]
    own._read = list
    assert BoundSystem._starts_matter(own, values) is False


def test_an_output_that_rounds_begins_from_the_steps_that_its_values_tell() -> None:
    m = 4.0 * np.sin(0.013 * np.arange(800)) + 0.3 * np.sin(0.31 * np.arange(800))
    y = np.round(m / 0.3) * 0.3
    runs: list[Array] = []
    rounds = Effect("y.quantisation", (Parameter("step", 0.0, "V", 0.0, 0.5),), ((0.1,), (0.4,)))
    other = Effect("y.gain", (Parameter("gain", 7.0, "1"),), ((0.5,),))
    quantised = SimpleNamespace(code=laws.QUANTISATION)

    def run(theta: Array) -> Array:
        runs.append(theta)
        return np.array([[np.zeros(800), m]])

    own: Any = SimpleNamespace(
        placed=[SimpleNamespace(effect="y.quantisation", place="output", at=1, law=quantised),
                SimpleNamespace(effect="u.quantisation", place="input", at=0, law=quantised),
                SimpleNamespace(effect="y.gain", place="output", at=1, law=SimpleNamespace(code=0))],
        run=run,
        data=SimpleNamespace(noise=lambda: np.array([9.0, 0.002])), measured=np.array([np.zeros(800), y]),
    )  # fmt: skip
    parameters = [Parameter("a", 3.0, "1")]
    got = BoundSystem._with_steps(own, [other, rounds], parameters)
    assert got[0] is other and runs[0].tolist() == [[3.0, 7.0, 0.0]]
    starts = [s for (s,) in got[1].starts]
    assert starts == sorted(set(starts)) and {0.1, 0.4} < set(starts) and max(starts) < 0.5
    assert min(abs(s - 0.3) for s in starts) < 2e-3
    (alone,) = BoundSystem._with_steps(own, [rounds], parameters)
    assert len(alone.starts) == len(starts)
    plain = [other]
    assert BoundSystem._with_steps(own, plain, parameters) is plain and len(runs) == 2  # nothing runs for nothing


def test_no_step_is_looked_for_that_values_cannot_tell() -> None:
    m = 4.0 * np.sin(0.0131 * np.arange(4000)) + 0.3 * np.sin(0.31 * np.arange(4000))
    span = np.ptp(m)
    least = 4.0 * span / QUANTUM_FREQUENCIES
    for times, noise in ((1.3, 0.0), (0.86, 0.0), (30.0, 40.0 * least)):
        found = steps_seen(np.round(m / (times * least)) * times * least, m, noise)
        assert min(found) > 0.99 * max(least, noise)
        assert (min(abs(np.array(found) / (times * least) - 1.0)) < 1e-2) == (times == 1.3)
    assert steps_seen(m[:1], m[:1], 0.0) == [] and steps_seen(m, m, 0.51 * span) == []


def test_an_error_s_rms_is_that_of_its_samples() -> None:
    e = np.array([[3.0, np.nan, 4.0], [np.nan] * 3, [0.0, 0.0, 0.0]])
    assert rms_of_rows(e) == pytest.approx([np.sqrt(12.5), np.nan, 0.0], nan_ok=True)


# ---- courses and sizes -----------------------------------------------------------------------------------------------

X, IN, P = namedtuple("X", "h"), namedtuple("IN", "q"), namedtuple("P", "c")


def filling(**more: Any) -> tuple[Any, Array]:
    """A level that runs off, on two logs; of the second one its start is fitted."""
    t = 0.05 * np.arange(200)
    q = np.sin(0.5 * t)
    s = SimpleNamespace(kind="simulate", parameters=("c",), states={"h": "m"}, model=lambda x, u, p: u.q - p.c * x.h)
    vars(s).update(more)
    never = np.zeros(len(t), dtype=bool)
    data = SimpleNamespace(
        records=[SimpleNamespace(t=t)] * 2, u=[q[None], 2.0 * q[None]], first_state=lambda log, m, other: 0.25,
        restarts=lambda log, n: (never, np.zeros((1, n))),
    )  # fmt: skip
    return SimpleNamespace(system=s, data=data, code=SimpleNamespace(X=X, U=IN, P=P), free_starts=[(1, 0)]), t


def level(t: Array, q: Array, begin: float, c: float = 0.7) -> Array:
    """In closed form, with an input that is held from sample to sample."""
    out = np.empty(len(t))
    h = out[0] = begin
    for k in range(1, len(t)):
        out[k] = h = q[k - 1] / c + (h - q[k - 1] / c) * np.exp(-c * (t[k] - t[k - 1]))
    return out


def test_a_state_that_nobody_measures_runs_from_the_start_of_its_log() -> None:
    runner, t = filling()
    q = np.sin(0.5 * t)
    values = np.array([0.7, 1.5])
    assert _hidden(runner, values, 0)[0] == pytest.approx(level(t, q, 0.25), abs=1e-5)
    assert _hidden(runner, values, 1)[0] == pytest.approx(level(t, 2.0 * q, 1.5), abs=1e-4)
    anew = np.arange(len(t)) == 80
    runner.data.restarts = lambda log, n: (anew, np.full((1, n), 5.0))
    again = _hidden(runner, values, 0)[0]
    assert again[:80] == pytest.approx(level(t, q, 0.25)[:80], abs=1e-5)
    assert again[80] == pytest.approx(q[79] / 0.7 + (5.0 - q[79] / 0.7) * np.exp(-0.7 * 0.05), abs=1e-5)
    runner.system.model = lambda x, u, p: np.nan
    assert _hidden(runner, values, 0).tolist() == [[0.25, *[0.0] * 199]]
    runner.system.kind = "closed_loop"
    assert _hidden(runner, values, 0)[0].tolist() == np.linspace(-1.0, 1.0, 200).tolist()


def test_sizes_of_what_moves_are_those_of_its_force_its_speed_and_its_way(monkeypatch: pytest.MonkeyPatch) -> None:
    t = 0.01 * np.arange(400)
    angle, speed = 3.0 + 2.0 * np.sin(1.3 * t), 2.6 * np.cos(1.3 * t)
    data = Data(turning(masses={"speed": "m"}, parameters=[*turning().parameters, Parameter("m", 4.0, "kg")]),
                [record(t, u=np.sin(t), angle=angle)])  # fmt: skip
    sizes: list[Any] = []
    own = injection_points._size

    def size(records: Any, rows: Any, unit: str, **more: Any) -> Any:
        sizes.append((rows, more))
        return own(records, rows, unit, **more)

    monkeypatch.setattr(injection_points, "_size", size)
    placed, effects = places(data, Course(states=[[angle], [speed]], commands=[]), None)  # type: ignore[arg-type]
    (more,) = [m for _, m in sizes if "travel" in m]
    rate = np.gradient(speed, t)
    assert more["travel"] == pytest.approx(0.5 * np.ptp(angle)) and more["travel_unit"] == "rad"
    assert more["speed"] == pytest.approx(np.sqrt(np.mean(speed**2))) and more["speed_unit"] == "rad/s"
    assert more["force"] == pytest.approx(4.0 * np.sqrt(np.mean(rate**2))) and more["ends"] == (
        angle.min(),
        angle.max(),
    )
    names = [e.name for e in effects]
    assert len(names) == len(set(names)) == len(placed) and [q.effect for q in placed] == names
    assert not any(n.startswith("angle.") and q.place in ("state", "force") for n, q in zip(names, placed, strict=True))
    assert _ends(np.ones(5)) == (0.0, 2.0) and _ends(angle) == (angle.min(), angle.max())
    assert _force(data.system, data, [speed], "angle") == pytest.approx(np.sqrt(np.mean(rate**2)))


@pytest.mark.parametrize(("hertz", "cutoff"), [(0.2, 5.0), (10.0, None), (35.0, 40.0)])
def test_a_displacement_is_smoothed_from_half_as_high_again_as_what_moves_it(
    hertz: float, cutoff: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    t = 0.01 * np.arange(1000)
    seen: list[float] = []
    monkeypatch.setattr(motion, "_butterworth", lambda t, x, cutoff: seen.append(cutoff))
    x = np.sin(2.0 * np.pi * hertz * t)
    gap = x.copy()
    gap[5] = np.nan
    motion.smoothed(t, gap)
    f, power = scipy.signal.welch(np.where(np.isfinite(gap), gap, np.nanmean(gap)), 100.0, nperseg=1000)
    total = np.cumsum(power)
    highest = f[np.flatnonzero(total >= FORCE_SHARE * total[-1])[0]]
    assert seen == [pytest.approx(cutoff or 1.5 * highest, rel=1e-6)]


def test_a_velocity_that_starts_backwards_is_said_as_one_that_starts_forwards() -> None:
    t = 0.01 * np.arange(400)
    for speed in (-6.0, 6.0):
        d = Data(turning(), [record(t, u=np.sin(t), angle=speed * t)])
        (said,) = d.begins_in_motion(0, "speed")
        assert float(said.split("about ")[1].split(" rad/s at the start")[0]) == pytest.approx(speed, rel=0.01)
    for share, moves in ((0.9, False), (1.1, True)):  # beside how fast it is in all
        d = Data(turning(), [record(t, u=np.sin(t), angle=0.0 * t)])
        v = np.where(np.arange(400) < 3, share * MOVES, np.sqrt((1.0 - 0.0075 * (share * MOVES) ** 2) / 0.9925))
        d._speed = lambda log, state, v=v: v  # type: ignore[misc, method-assign]
        assert bool(d.begins_in_motion(0, "speed")) == moves


def test_a_position_that_is_fitted_begins_in_the_middle_of_its_way() -> None:
    t = 0.01 * np.arange(400)
    x = 3.0 + 2.0 * np.sin(t)
    d = Data(mover(), [record(t, x=x, f=np.sin(t))])
    begin, size = d.begin(0, "position")
    way = d.u[0][0]
    assert begin == pytest.approx(-0.5 * (way.max() + way.min())) and size == pytest.approx(0.5 * np.ptp(way))


def test_a_curve_is_forgotten_where_all_but_a_twentieth_of_it_has_been_gone_through() -> None:
    table = np.linspace(0.0, 1.0, 101)
    for share, lost in ((0.94, False), (0.96, True)):  # of a straight curve the rest is what radii beyond give
        q = np.linspace(0.0, 2.0 * share * 3.0, 50)
        assert forgotten(q, 3.0, table)[-1] == lost == (1.0 - share <= BEFORE_LOG)
    falls = np.concatenate([np.linspace(0.0, -1.0, 51), np.full(50, -1.0)])
    assert forgotten(np.linspace(0.0, 6.0, 50), 3.0, falls)[-1] and not forgotten(np.zeros(5), 3.0, falls).any()


# ---- a surface, and what numba makes of a list -----------------------------------------------------------------------


def test_a_surface_is_straight_between_its_points() -> None:
    rng = np.random.default_rng(1)
    table = rng.standard_normal((9, 9))
    s = Surface("output adds", 0, 0, "u", -2.0, 3.0, lambda a: table, of_second=1, second="w", low_second=10.0,
                high_second=12.0)  # fmt: skip
    own, other = np.linspace(-2.0, 3.0, 9), np.linspace(10.0, 12.0, 9)
    q = np.array([rng.uniform(-3.0, 4.0, 200), rng.uniform(9.5, 12.5, 200)])
    inside = np.array([np.clip(q[0], -2.0, 3.0), np.clip(q[1], 10.0, 12.0)])
    wanted = scipy.interpolate.RegularGridInterpolator((own, other), table)(inside.T)
    assert s.at(q, table) == pytest.approx(wanted, abs=1e-9)
    assert s.quantities == ((0, "u"), (1, "w"))
    assert s.value(lambda of, name: np.full(3, of + len(name))).tolist() == [[1.0] * 3, [2.0] * 3]


def test_lists_and_arrays_that_are_only_returned_come_as_tuples() -> None:
    def as_list(a: float, b: float) -> Any:
        return [a + b, a - b]

    def as_array(a: float, b: float) -> Any:
        return np.array([a + b, a - b])

    def used(a: float, b: float) -> Any:
        both = [a + b, a - b]
        both[0] = both[0] + 1.0
        return both

    for f, made in ((as_list, tuple), (as_array, tuple), (used, list)):
        got = njit(pipeline_class=InATuple)(f)(3.0, 1.0)
        assert type(got) is made and list(got) == ([5.0, 2.0] if f is used else [4.0, 2.0])


def test_a_short_channel_tells_no_noise() -> None:
    rng = np.random.default_rng(1)
    y = rng.standard_normal(40)
    assert noise_of_channel(y[:39]) == 0.0 < noise_of_channel(y)
    assert noise_of_channel(np.append(y, np.nan)) == noise_of_channel(y)
    levels = [noise_of_channel(0.3 * rng.standard_normal(600)) for _ in range(20)]
    assert np.mean(levels) == pytest.approx(0.3, rel=0.1)


def test_what_runs_over_runs_into_every_other_store_of_its_kind_and_not_into_itself() -> None:
    t = 0.05 * np.arange(200)
    levels = {"h1": 1.0 + 0.2 * np.sin(t), "h2": 0.5 + 0.1 * np.cos(t), "warm": 20.0 + np.sin(t)}
    system = System(
        "tanks", "simulate", lambda x, u, p: (u.q - p.c * x.h1, p.c * x.h1 - p.c * x.h2, -p.c * x.warm),
        {"h1": "m", "h2": "m", "warm": "degC"}, {"q": "m/s", "around": "degC"}, [unknown("c", 0.5, "1/s")],
        states={"h1": "m", "h2": "m", "warm": "degC"},
    )  # fmt: skip
    data = Data(system, [record(t, q=np.sin(t), around=15.0 + np.cos(t), **levels)])
    placed, effects = places(data, Course(states=[[v] for v in levels.values()], commands=[]), None)  # type: ignore[arg-type]
    names = {e.name for e in effects}
    assert {n for n in names if ".overflow_to_" in n} == {"h1.overflow_to_h2", "h2.overflow_to_h1"}
    assert {n for n in names if ".radiation_to_" in n} <= {"warm.radiation_to_around"}
    assert not any(n.endswith(".coulomb") for n in names)  # no level is a speed
    assert "h1.square_root" in names and "warm.square_root" not in names  # whose zero means nothing
    to = {q.effect: (q.at, q.to) for q in placed if ".overflow_to_" in q.effect}
    assert to == {"h1.overflow_to_h2": (0, 1), "h2.overflow_to_h1": (1, 0)}


def test_lags_and_stops_remember() -> None:
    assert is_memory("stops_of_u") and is_memory("u_lagged_by_20_ms")
    assert not any(is_memory(n) for n in ("u", "time", "direction_of_u", "u_minus_w", "time_every_20_ms"))


@pytest.mark.parametrize("starts", [1, 2])
def test_states_that_start_at_readings_are_known_within_three_times_their_noise(starts: int) -> None:
    runner = SimpleNamespace(free_starts=[])
    own: Any = SimpleNamespace(
        like=None, data=SimpleNamespace(noise=lambda: np.array([9.0, 0.2]), records=[None] * starts,
                                        first_state=lambda log, name, other: 5.0 + log),
        system=SimpleNamespace(outputs={"y": "V", "h": "m"}, states={"h": "m"}), runner=runner,
        _read=lambda: [(log, 0, "h") for log in range(starts)],
    )  # fmt: skip
    out = BoundSystem._read_starts(own)
    names = ["start_h"] if starts == 1 else ["start_h_1", "start_h_2"]
    assert [p.name for p in out] == names and runner.free_starts == [(log, 0) for log in range(starts)]
    assert [(p.value, p.unit, p.log) for p in out] == [(5.0 + k, "m", k + 1) for k in range(starts)]
    assert [p.tolerance for p in out] == pytest.approx([0.6] * starts) and own.read_starts
    own.like = SimpleNamespace(data=SimpleNamespace(noise=lambda: np.array([9.0, 0.4])))  # as the fitted logs have it
    assert BoundSystem._read_starts(own)[0].tolerance == pytest.approx(1.2)
