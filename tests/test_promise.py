"""What is promised before anything is fitted is what a fit then finds; what starts, edges and steps tell is used."""

from __future__ import annotations

import numpy as np
import pytest

from vaneloop import Record, System, unknown
from vaneloop.identification.candidates.laws import STICTION, apply
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance
from vaneloop.identification.selection.screening import Linearisation, _solved, along, followed, out_of, within
from vaneloop.identification.selection.search import Search
from vaneloop.identification.subsystem import Effect, Parameter, Stage
from vaneloop.identification.user_models.bound_system import BoundSystem, steps_seen
from vaneloop.identification.user_models.motion import low_pass

N = 600
T = np.arange(N) * 0.1
RNG = np.random.default_rng(3)
U, W = np.cumsum(RNG.standard_normal((2, N)), axis=1) / 10.0


def linear_stage() -> Stage:
    """y = offset + gain u + size w, with size 0.7 hidden."""

    def run(theta: np.ndarray) -> np.ndarray:
        return (theta[:, :1] + theta[:, 1:2] * U + theta[:, 2:3] * W)[:, None]

    measured = run(np.array([[0.3, 2.0, 0.7]]))[0] + 0.05 * np.random.default_rng(4).standard_normal((1, N))
    own = (Parameter("offset", 0.0, "-", tolerance=10.0), Parameter("gain", 1.0, "-", tolerance=10.0))
    effects = (
        Effect("w", (Parameter("size", 0.0, "-", -5.0, 5.0),), ((0.2,), (4.0,))),
        Effect(
            "two",
            (Parameter("size", 0.0, "-"), Parameter("how", 0.5, "-", shape=True)),
            ((0.5, 0.5),),
            "",
            (("w", (None, 0.0)),),
        ),
    )
    return Stage("linear", ("y",), ("-",), own, effects, run, T, measured, floor=np.array([0.05]))


def test_the_best_size_of_what_acts_linearly_follows_from_one_simulation():
    judge = LeastSquaresProblem(linear_stage(), np.array([0.05]))
    base = judge.fit((), judge.stage.neutral())
    fit = judge.fit(("w",), base.theta)
    slopes = Linearisation(judge, base.theta, base.free, base.prior)
    for start in (0.2, 4.0):
        tried = base.theta.copy()
        tried[2] = start
        share, left = slopes.line(judge.errors(tried[None]))
        assert share[0] * start == pytest.approx(fit.theta[2], rel=1e-3)
        assert left[0] == pytest.approx(fit.cost.sum(), rel=1e-3)
        moved = along(judge.stage.effects[0], np.array([start]), float(share[0]), np.array([-5.0]), np.array([5.0]))
        assert moved == pytest.approx([fit.theta[2]], rel=1e-3)


def test_a_gain_that_is_far_off_follows_at_once():
    judge = LeastSquaresProblem(linear_stage(), np.array([0.05]))
    base = judge.fit((), judge.stage.neutral())
    start = np.array([5.0, -8.0, 0.7, 0.0, 0.5])
    thetas = [start]
    errors, left = followed(judge, thetas, base.free, base.prior)
    assert errors[0] == pytest.approx(judge.errors(start[None])[0])
    assert thetas[0][:2] == pytest.approx([0.3, 2.0], abs=0.02)
    assert left[0] == pytest.approx(float(np.sum(judge.errors(thetas[0][None]) ** 2)), rel=1e-2)


def test_an_effect_and_one_that_holds_it_say_the_same_in_both_directions():
    stage = linear_stage()
    theta = np.array([0.1, 2.0, 0.6, 0.0, 0.5])
    wider = within(stage, theta, "two", "w")
    assert wider.tolist() == [0.1, 2.0, 0.0, 0.6, 0.0]
    assert out_of(stage, wider, "two", "w").tolist() == theta.tolist()


@pytest.mark.parametrize(("step", "noise", "offset"), [(0.5, 0.05, 0.0), (0.08, 0.03, 0.0), (0.03, 0.012, 7.0)])
def test_the_step_of_a_sensor_is_read_from_its_values(step: float, noise: float, offset: float) -> None:
    model = offset + 1.5 * np.sin(0.37 * T) + 0.8 * np.sin(0.11 * T)
    measured = np.round(model / step) * step + noise * np.random.default_rng(1).standard_normal(N)
    seen = steps_seen(measured, model, noise)
    # within a quarter of a step at the far end of the range
    assert min(abs(s - step) for s in seen) < 0.25 * step * step / np.max(np.abs(model))


def test_nothing_is_read_from_an_output_that_stands_still():
    assert steps_seen(np.ones(200), np.ones(200), 0.1) == []


def test_what_is_linear_in_the_motion_holds_up_to_a_period_from_the_ends():
    """Filtering a force and filtering the motion that it is made of are one and the same there."""
    rate, cutoff = 1000.0, 2.0
    t = np.arange(4000) / rate
    x, a = np.sin(5.0 * t + 1.0), -25.0 * np.sin(5.0 * t + 1.0)
    smooth = low_pass(t, x, cutoff)
    twice = np.gradient(np.gradient(smooth, t), t)
    inside = slice(int(rate / cutoff) + 5, -int(rate / cutoff) - 5)
    error = np.abs(twice - low_pass(t, a, cutoff))
    assert np.max(error[inside]) < 1e-3 * 25.0
    assert np.max(error) > 0.1 * 25.0  # and not before


@pytest.mark.slow
def test_a_system_that_forgets_slowly_has_its_starts_fitted():
    """A pendulum that hardly loses: noise in the first sample would stay in the whole log."""
    rng = np.random.default_rng(0)
    noise = 0.03

    def system(damping: float) -> System:
        return System(
            "swing", "simulate", lambda x, u, p: (-p.stiff * x.angle - p.damping * x.rate, x.rate),
            states={"rate": "rad/s", "angle": "rad"}, outputs={"angle": "rad", "rate": "rad/s"},
            rates={"rate": "angle"},
            parameters=[unknown("stiff", 8.0, "1/s^2", low=0.0), unknown("damping", damping, "1/s", low=0.0)],
        )  # fmt: skip

    def log(damping: float, samples: int) -> Record:
        t = np.arange(samples) * 0.02
        w = np.sqrt(9.0 - 0.25 * damping**2)
        decay = np.exp(-0.5 * damping * t)
        angle = decay * np.cos(w * t)
        rate = np.gradient(angle, t, edge_order=2)
        angle, rate = (v + noise * rng.standard_normal(len(t)) for v in (angle, rate))
        return Record("swing", t, {"angle": angle, "rate": rate})

    slow = BoundSystem(system(0.02), [log(0.02, 1500)])
    assert slow.read_starts and [p.name for p in slow.stage.parameters[2:]] == ["start_rate", "start_angle"]
    assert slow.floor == pytest.approx(slow.data.noise())
    fit = LeastSquaresProblem(slow.stage, slow.floor).fit((), slow.stage.neutral())
    assert float(np.sqrt(fit.cost.sum() / (2 * len(slow.t)))) == pytest.approx(1.0, abs=0.06)
    assert fit.theta[3] == pytest.approx(1.0, abs=0.01)  # the reading is off by some 0.03
    assert not BoundSystem(system(3.0), [log(3.0, 12000)]).read_starts


def test_a_law_that_holds_another_is_no_worse_than_it_though_it_was_fitted_first():
    rng = np.random.default_rng(5)
    command, at, moved = 10.0 * np.sin(0.05 * np.arange(N)), 0.0, []
    for x in command:
        at = min(max(at, x - 2.0), x + 2.0)
        moved.append(at)
    system = System(
        "valve", "static", lambda u, p: p.gain * u.command, inputs={"command": "%"}, outputs={"flow": "-"},
        parameters=[unknown("gain", 1.0, "-")], places=["command"],
    )  # fmt: skip
    flow = 3.0 * np.array(moved) + 0.1 * rng.standard_normal(N)
    bound = BoundSystem(system, [Record("valve", T, {"command": command, "flow": flow})])
    judge = LeastSquaresProblem(bound.thinned, bound.floor)
    search = Search(RelativeErrorAcceptance(judge))
    first = judge.stage.neutral()
    first[judge.stage.index()["command.stiction"]] = 30.0, 1.0, 0.0  # wider than the motion: it never moves
    search.fits[frozenset(["command.stiction"])] = judge.fit(("command.stiction",), first, 1)
    play, stiction = search.single("command.play"), search.single("command.stiction")
    assert judge.total_of(play) < 1.2 * N
    assert judge.total_of(stiction) <= judge.total_of(play) * (1.0 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "jump", "noise"), [(11.0, 0.5, 0.5), (11.0, 0.5, 1.0), (3.0, 0.6, 0.3)])
def test_stiction_is_found_on_from_the_play_that_stands_in_for_it(width: float, jump: float, noise: float):
    n, every = 1500, 4  # the controller is four times slower than the log
    t, k = 0.1 * np.arange(n), np.arange(n)
    command = np.repeat((40.0 * np.sin(0.01 * k) + 10.0 * np.sin(0.055 * k))[::every], every)
    stem = apply(STICTION, t, command, np.array([width, jump, 0.0, 0.5]))
    flow, kept = stem.copy(), np.exp(-0.13)
    for i in range(1, n):
        flow[i] = kept * flow[i - 1] + (1.0 - kept) * stem[i - 1]
    flow += noise * np.random.default_rng(1).standard_normal(n)
    system = System(
        "valve", "simulate", lambda x, u, p: p.rate * (u.command - x.flow), inputs={"command": "%"},
        states={"flow": "%"}, outputs={"flow": "%"}, parameters=[unknown("rate", 1.0, "1/s")], places=["command"],
    )  # fmt: skip
    bound = BoundSystem(system, [Record("valve", t, {"command": command, "flow": flow})])
    judge = LeastSquaresProblem(bound.thinned, bound.floor)
    search = Search(RelativeErrorAcceptance(judge))
    play, stiction = search.single("command.play"), search.single("command.stiction")
    found = stiction.theta[judge.stage.index()["command.stiction"]]
    assert judge.total_of(stiction) < 1.1 * judge.n < judge.total_of(play) / 1.2
    assert found[0] == pytest.approx(width, rel=0.05) and found[1] == pytest.approx(jump, abs=0.1)


@pytest.mark.parametrize("iterations", [1, 3, 12])
def test_quick_steps_lead_where_the_fit_goes_with_fewer_simulations(iterations: int):
    rng = np.random.default_rng(6)
    u = 3.0 * np.sin(0.03 * np.arange(N))
    system = System(
        "bent", "static", lambda u, p: p.gain * u.u + p.bend * u.u**3 / (1.0 + p.bend * u.u**2), inputs={"u": "V"},
        outputs={"y": "V"}, parameters=[unknown("gain", 1.0, "-"), unknown("bend", 0.1, "-", low=0.0)], places=["u"],
    )  # fmt: skip
    y = 2.0 * u + 0.7 * u**3 / (1.0 + 0.7 * u**2) + 0.5 + 0.05 * rng.standard_normal(N)
    bound = BoundSystem(system, [Record("bent", T, {"u": u, "y": y})])
    asked: list[int] = []

    class Counting(LeastSquaresProblem):
        def _simulated(self, thetas):
            asked.append(len(thetas))
            return super()._simulated(thetas)

    for effects in ((), ("u.bias",)):
        sims = []
        for quick in (False, True):
            judge = Counting(bound.thinned, bound.floor)
            asked.clear()
            task = judge.leading if quick else judge.fitting
            start = judge.stage.neutral()
            start[:2] *= 0.6
            sims.append((judge.together([task(effects, start, iterations)])[0], sum(asked)))
        (fit, whole), ((total, theta, _), fewer) = sims
        np.testing.assert_array_equal(theta, fit.theta)
        assert total == pytest.approx(judge.total_of(fit), rel=1e-9)
        assert fewer <= whole and (iterations > 1 or fewer == whole - len(fit.free))


def test_what_cannot_be_told_apart_is_followed_by_the_least_step():
    # an offset and a gain of a signal that stands still at 2
    offset_and_gain = np.outer([1.0, 2.0], [1.0, 2.0])
    assert _solved(offset_and_gain, np.array([5.0, 10.0])) == pytest.approx([1.0, 2.0])
