"""Curves that nobody named on a stage of the vane chain: every place there, of every quantity that the log has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plant.curve import QUANTITIES, TURN, Place, turns
from plant.effects import CURVES
from plant.layout import AREA, MOST_CURVES, P_REF
from plant.model import Learned
from vaneloop.base.curve import POINTS
from vaneloop.base.errors import InputError
from vaneloop.base.hysteresis import STOPS, stops_of
from vaneloop.base.vanes import VANES
from vaneloop.identification.candidates.spline_basis import basis_of
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import rms_of
from vaneloop.identification.selection.subsampled_search import excerpt_of
from vaneloop.identification.settings import (
    CURVE_SPLINES,
    FREE_PIECE,
    LAG_CHANGES,
    LAG_PLACES,
    LEARN_PIECE,
    LONGEST_LAG,
    MOST_SAMPLES,
    PROBED,
    QUICK_SAMPLES,
    SHORT_PIECE,
    SHORTEST_LAG,
    TIME_SPLINES,
)
from vaneloop.identification.subsystem import Array, Effect, Parameter, Stage
from vaneloop.identification.unmodelled.curve_candidates import Candidate, basis_for
from vaneloop.identification.unmodelled.regressors import Quantity
from vaneloop.identification.unmodelled.spectral_lines import Course
from vaneloop.identification.user_models.exogenous_regressors import lagged_name
from vaneloop.identification.user_models.injection_points import CURVE_LAW
from vaneloop.identification.user_models.motion import smoothed
from vaneloop.identification.user_models.simulation import Placed
from vaneloop.identification.user_models.terms import COLUMN, Curve
from vaneloop.identification.vane_chain.parameters import ALL_PLACES
from vaneloop.identification.vane_chain.subsystem_data import Driven, Made

__all__ = [
    "OF_STROKE", "SCALE", "VaneChainCandidates", "curve_effect", "remade", "reversals", "room_for", "with_laws",
    "without_laws",
]  # fmt: skip

SCALE = "scale"  # of a law from a file
LOG, REST, TEST = "log", "rest of the log", "test"
# a quantity that is the place's own output, or nothing but the reading there: it multiplies by the same as it adds
OWN = {"sensors.lvdt": "x_lvdt", "servo.current": "i_cmd", "controller.demand": "x_dem"}
# quantities that are at a place itself
NEAR = {
    "valve.current": ("i_cmd",), "valve.opening": ("i_cmd",), "actuator.load": ("x_lvdt", "speed_of_x_lvdt"),
    "sensors.lvdt": ("x_lvdt",),
    "servo.current": ("i_cmd",), "actuator.flow_gain": ("x_lvdt", "t_oil"), "linkage.ring": ("x_lvdt",),
    "controller.demand": ("n_r",), "engine.lag": ("n_r",), "engine.acceleration": ("n_r",),
}  # fmt: skip
DRIVERS = ("n_dem", "n_r", "x_dem", "p_s", "t_oil")  # channels that move the machine
LAGGED = {  # what drives a stage, and not what it gives: curves there may have it behind a lag
    "demand": ("n_dem", "n_r"), "servo": ("x_dem", "x_lvdt"), "engine": ("n_dem",),
    "actuator": ("i_cmd", "n_r", "p_s", "t_oil"), "linkage": ("x_lvdt", "speed_of_x_lvdt", "n_r", "t_oil"),
}  # fmt: skip
SLIPS = {  # what moves a place that may have a hysteresis: a torque motor's iron, joints on the way to the vanes
    "valve.current": "i_cmd", "linkage.crank": "x_lvdt", "linkage.ring": "x_lvdt",
    **{f"linkage.{v}_ring": "x_lvdt" for v in VANES},
}  # fmt: skip
OF_STROKE = (  # what `reversals` works out
    "speed_of_x_lvdt", "direction_of_x_lvdt", "distance_since_reversal_of_x_lvdt", "time_since_reversal_of_x_lvdt",
)  # fmt: skip


def reversals(t: Array, stroke: Array, full: float) -> dict[str, Array]:
    """Speed (mm/s) and direction of a stroke (mm), way (mm) and time (s) since it turned, by name of the quantity.

    full  mm, the machine's stroke
    """
    x = smoothed(t, stroke)
    return dict(zip(OF_STROKE, (np.gradient(x, t), *turns(x, t, TURN * full)), strict=True))


def _says_more(place: Place, q: Quantity) -> bool:
    """Whether a curve of a quantity at a place is not the same as another one that is plainer.

    In the linkage what the crank adds to the stroke is what the LVDT takes off it. A reading has no memory of the
    machine's, and a crank that gives at once is a reading. A valve's opening is behind the valve's own lag.
    """
    if q.stops:
        return SLIPS.get(place.at) == stops_of(q.name)
    if q.remembers:
        multiplied = place.at.startswith("sensors.") and place.how == "times"
        return place.at not in ("sensors.lvdt", "valve.opening") and not multiplied
    return place.at != "linkage.crank"


def room_for(p: Array) -> int:
    """How many curves more a machine with these parameters can have."""
    return MOST_CURVES - int(p[CURVES].max())


def curve_effect(name: str, law: Learned) -> tuple[Placed, Effect]:
    """A law from a model file, as it runs and as the search has it: its curve times a scale, which is 1 as learned.

    Another log need not have been everywhere where the law was learned, so that it cannot tell each of its numbers.
    """
    number = next(i for i, p in enumerate(ALL_PLACES) if (p.at, p.how) == (law.at, law.how))
    table = law.table()(np.array(law.values))
    curve = Curve(law.how, number, COLUMN, law.of, *law.ends, lambda scale: scale[0] * table)
    effect = Effect(name, (Parameter(SCALE, 0.0, "-", scale=1.0),), ((1.0,),), "a function that was learned")
    return Placed(name, CURVE_LAW, "curve", -1, 0.0, neutral=np.zeros(1), curve=curve), effect


def remade(stage: Stage, laws: Sequence[str], curves: Sequence[tuple[Placed, Effect]]) -> Stage:
    """A stage of the vane chain with only these laws of the library, and these curves, as effects."""
    assert isinstance(stage.made, Made)
    make, driven = stage.made
    out = make(driven._replace(laws=tuple(laws), curves=tuple(curves), again=True))
    for name in ("floor", "quiet", "noise", "raster_error", "lost", "memory", "regimes", "regime_units", "grain"):
        setattr(out, name, getattr(stage, name))
    return out


def with_laws(stage: Stage, laws: Sequence[str], curves: Sequence[tuple[Placed, Effect]], log: str) -> Stage:
    """`remade`, where the log has what the curves are of; InputError, one line, where it has not. Without curves: the
    stage.
    """
    if not curves:
        return stage
    assert isinstance(stage.made, Made)
    for placed, effect in curves:
        assert placed.curve is not None
        if stage.made.driven.quantity(placed.curve.quantity) is None:
            raise InputError(f"{log}: {effect.name}: the log has no {placed.curve.quantity}")
    return remade(stage, laws, curves)


def without_laws(stages: Sequence[Stage], laws: Sequence[str]) -> list[Stage]:
    """Stages of the vane chain that are not given some laws of the library; one of both actuators is either side's,
    too.
    """
    out = []
    for stage in stages:
        have = [e.name for e in stage.effects]
        rest = [e.name for e in stage.effects if not {e.name, e.family} & {*laws}]
        out.append(stage if rest == have else remade(stage, rest, ()))
    return out


class VaneChainCandidates:
    """A stage of the vane chain on its log (`identification.unmodelled.learning.CandidateSource`).

    stage  with all laws that it can have
    floor  noise of its outputs; None: its own
    test   the same stage on a part of the log that nothing is fitted to
    others the other stages of the log, where a curve at a shared place acts, too
    """

    points, jumps = POINTS, False  # as the plant's rows have them
    noise_known = True
    shares = True
    surfaces = False  # a curve is rows of the plant's parameters, of one signal

    def __init__(
        self, stage: Stage, floor: Array | None = None, test: Stage | None = None, others: Sequence[Stage] = ()
    ):  # fmt: skip
        assert isinstance(stage.made, Made) and stage.floor is not None
        self.others = [s for s in others if isinstance(s.made, Made) and s.floor is not None and not s.coarse]
        self.left: dict[str, float] = {}  # error of each of these without any curve, in noise floors
        self.driven, self.all, self.test = stage.made.driven, stage, test
        self.floor = stage.floor if floor is None else floor
        self.tests: frozenset[str] = frozenset()
        self.measured = frozenset(stage.outputs) & frozenset(VANES)
        self.whole = stage
        judge = LeastSquaresProblem(stage, stage.floor)
        fit = judge.fit((), stage.neutral(), 1)
        piece = LEARN_PIECE if stage.window else FREE_PIECE
        if stage.excerpt is not None and len(stage.t) > MOST_SAMPLES:
            at = excerpt_of(judge, fit, piece, MOST_SAMPLES)
            self.rest = np.ones(len(stage.t), dtype=bool)
            self.rest[at] = False
            self.whole, self.tests = stage.excerpt(at), frozenset((REST,))
        if test is not None:
            self.tests |= {TEST}
        self.small = self.whole
        if stage.excerpt is not None and len(stage.t) > QUICK_SAMPLES:
            self.small = stage.excerpt(
                excerpt_of(judge, fit, SHORT_PIECE if stage.window else LEARN_PIECE, QUICK_SAMPLES)
            )

    def in_grains(self, of: float) -> None:
        """Compare errors in so large steps from now on (`Stage.grain`)."""
        self.whole.grain = self.small.grain = of

    def stage(self, laws: Sequence[str], curves: Sequence[tuple[Placed, Effect]], quick: bool = False) -> Stage:
        """The same stage with only these laws of the library, and these curves, as effects."""
        return remade(self.small if quick else self.whole, laws, curves)

    def errors(
        self, curves: Sequence[tuple[Placed, Effect]], theta: Array, laws: Sequence[str] = ()
    ) -> dict[str, Array]:  # fmt: skip
        """Error of every sample of each output in noise floors: of what was fitted, of the rest of the log where there
        is one, and of the test log.
        """
        rest = self.rest if REST in self.tests else np.zeros(len(self.all.t), dtype=bool)
        asked = [(LOG, self.all, ~rest), (REST, self.all, rest), (TEST, self.test, None)]
        out = {}
        for name, stage, part in asked:
            if stage is None or (name == REST and REST not in self.tests):
                continue
            judge = LeastSquaresProblem(remade(stage, laws, curves), self.floor, part)
            out[name] = np.where(judge.valid, judge.errors(theta[None])[0], np.nan)
        return out

    def elsewhere(self, curves: Sequence[tuple[Placed, Effect]], theta: Array) -> dict[str, float]:
        """Of each other subsystem in which curves act, with the parameters at the end of ``theta``, the log of its
        error with them over that without, both at least the noise: its nominal parameters refitted, the curves as
        they are.
        """
        out = {}
        many = sum(len(effect.parameters) for _, effect in curves)
        quantities = [placed.curve.quantity for placed, _ in curves if placed.curve is not None]
        for stage in self.others:
            assert isinstance(stage.made, Made) and stage.floor is not None
            if any(stage.made.driven.quantity(q) is None for q in quantities):
                continue
            other = remade(stage, (), curves)
            without = other.neutral()
            with_them = np.concatenate([without[: len(without) - many], theta[len(theta) - many :]])
            still, moved = other.run(np.array([without, with_them]))
            if np.array_equal(still, moved, equal_nan=True):
                continue
            judge = LeastSquaresProblem(other, stage.floor)
            if stage.name not in self.left:
                self.left[stage.name] = rms_of(judge, judge.fit((), without, 4))
            now = rms_of(judge, judge.fit((), with_them, 4))
            out[f"the {stage.name} subsystem"] = float(np.log(max(now, 1.0) / max(self.left[stage.name], 1.0)))
        return out

    def within(self, candidate: Candidate) -> dict[str, Array]:
        """Of the rest of the log and of the test log, the samples where a candidate's quantity is where its curve was
        learned.
        """
        out = {}
        for name, stage in ((REST, self.all), (TEST, self.test)):
            if name in self.tests and stage is not None and not candidate.quantity.stops:
                assert isinstance(stage.made, Made)
                values = stage.made.driven.quantity(candidate.quantity.name)
                if values is not None:
                    out[name] = candidate.basis.reaches(values)
        return out

    def reach(self, candidate: Candidate) -> tuple[float, float]:
        """The range of a candidate's curve: formulas stand in its place over no more."""
        return candidate.basis.low, candidate.basis.high

    def courses(self, curves: Sequence[tuple[Placed, Effect]], theta: Array) -> list[Course]:
        """The error of every sample of the log."""
        stage = remade(self.all, (), curves)
        error = (stage.run(theta[None])[0] - stage.measured) / self.floor[:, None]
        error[~np.isfinite(error)] = 0.0
        drivers = [v for c, v in self.driven.columns.items() if c in DRIVERS and np.isfinite(v).all()]
        return [Course(stage.t, error, np.array(drivers).reshape(len(drivers), len(stage.t)))]

    # ---- candidates --------------------------------------------------------------------------------------------------

    def candidates(self, theta: Array) -> list[Candidate]:
        """Every curve that may be missing, at parameters ``theta`` of the stage without any.

        All may have a mean: a nominal parameter is known within its tolerance, and takes no more of it than that.
        """
        if not room_for(self.driven.machine.p):
            return []
        stage = self.stage((), ())
        assert isinstance(stage.made, Made)
        driven = stage.made.driven
        judge = LeastSquaresProblem(stage, self.floor)
        fit = judge.fit((), theta, 1)
        error = float(np.sqrt(np.max(judge.mean_squares(judge.errors(fit.theta)[0] * judge.floor[:, None]))))
        known = []
        rows = np.isfinite(stage.measured).any(axis=0)
        for signal in QUANTITIES.values():
            values = driven.quantity(signal.name)
            if values is None or (signal.name in VANES and signal.name not in driven.machine.vanes):
                continue
            basis = basis_of(values[rows], TIME_SPLINES if signal.name == "time" else CURVE_SPLINES)
            if basis is not None:
                known.append((Quantity(signal.name, signal.unit, COLUMN, values[rows]), basis))
        late = [(c, q, b) for c in LAGGED[stage.name] for q in self._late(driven, c, rows) if (b := basis_for(q))]
        stops = [self._stops(driven, c, rows) for c in sorted({*SLIPS.values()} & {*LAGGED[stage.name]})]
        late += [(stops_of(q.name), q, b) for q in stops if q is not None and (b := basis_for(q))]
        out = []
        for number, place in enumerate(ALL_PLACES):
            if stage.name not in place.stages or driven.machine.kind not in place.kinds:
                continue
            if place.vane and place.vane not in stage.outputs:
                continue
            for channel, q, basis in [*((q.name, q, b) for q, b in known), *late]:
                if self._idle(place, channel, stage.name) or not _says_more(place, q):
                    continue
                word = "gain" if place.how == "times" else "curve"
                name = f"{place.at}.{word}_of_{q.name}"
                size = self._size(place, error)
                near = q.name in NEAR.get(place.at, ())
                out.append(Candidate(name, place.how, number, place.at, place.unit, size, not q.stops, q, basis, near))
        return self._as_the_error(out, fit.theta, rms_of(judge, fit))

    def _as_the_error(self, candidates: Sequence[Candidate], theta: Array, error: float) -> list[Candidate]:
        """Candidates no larger in usual than what moves the outputs by the ``error`` that there is (noise floors):
        where little is missing, a curve that may be a hundred times as large goes astray wherever a block is left out.
        Not so a hysteresis: of that a constant says nothing.
        """
        usual: dict[int, float] = {}
        for c in candidates:
            if c.place in usual or c.quantity.stops:
                continue
            judge = LeastSquaresProblem(self.stage((), ((c.placed(), c.effect(1.0)),)), self.floor)
            moved = np.repeat(np.concatenate([theta, np.zeros(len(c.kept))])[None], 2, axis=0)
            moved[1, len(theta)] = PROBED * c.size  # a constant at that place
            still, by = judge.errors(moved)
            rms = float(np.sqrt(np.sum((by - still) ** 2) / max(judge.n, 1)))
            usual[c.place] = min(c.size, PROBED * c.size * error / max(rms, 1e-300))
        return [c if c.quantity.stops else replace(c, size=usual[c.place]) for c in candidates]

    def _stops(self, driven: Driven, channel: str, rows: Array) -> Quantity | None:
        """Stops that a channel moves; None: it does not move. ``rows``: those that have an output."""
        values = driven.quantity(channel)
        if values is None or not np.ptp(values) > 0.0:
            return None
        way = turns(np.ascontiguousarray(smoothed(driven.t, values)), driven.t, TURN * float(np.ptp(values)))[1]
        return Quantity(f"{STOPS}{channel}", QUANTITIES[channel].unit, COLUMN, 0.5 * way[rows], (values,))

    def _late(self, driven: Driven, channel: str, rows: Array) -> list[Quantity]:
        """Lags of a channel that change it; ``rows``: those that have an output."""
        values = driven.quantity(channel)
        if values is None or not np.ptp(values) > 0.0:
            return []
        whole = self.driven.t
        shortest, longest = SHORTEST_LAG * float(whole[1] - whole[0]), LONGEST_LAG * float(whole[-1] - whole[0])

        def slow(tau: float) -> Quantity | None:
            if not 0.5 * shortest < tau < 2.0 * longest:
                return None
            name = lagged_name(channel, tau)
            late = driven.quantity(name)
            assert late is not None
            if np.std((late - values)[rows]) < LAG_CHANGES * np.std(values[rows]):
                return None
            again = lambda times: slow(tau * times)  # noqa: E731
            return Quantity(name, QUANTITIES[channel].unit, COLUMN, late[rows], (values,), again)

        return [q for z in LAG_PLACES if (q := slow(shortest * (longest / shortest) ** z)) is not None]

    def _idle(self, place: Place, q: str, stage: str) -> bool:
        """Whether a curve there would say nothing of its own in a stage."""
        own = OWN.get(place.at, place.at.removeprefix("sensors."))
        if q == own and place.how == "times":
            return True
        if stage in ("demand", "engine"):
            return q not in ("n_r", "n_dem", "t_oil", "p_s", "time")
        if stage == "servo":
            return q in VANES
        if stage == "actuator":
            if place.at == "sensors.lvdt":  # a reading's curve of what the drive does is one of the drive
                return q not in ("time", "p_s")
            if place.at == "valve.opening":  # of all else a current says the same
                return q != "i_cmd"
            return q in VANES or q == "x_dem"
        return q in ("i_cmd", "x_dem", "n_dem")

    def _size(self, place: Place, error: float) -> float:
        """How large a curve there is in usual, in its unit; ``error``: RMS of the stage, in its output's."""
        if place.how == "times":
            return 0.3
        p = self.driven.machine.p[:, 0]
        return {
            "engine.demand": 5.0, "valve.current": 1.0, "valve.opening": 1.0,
            "actuator.load": 0.2 * float(p[AREA] * p[P_REF]),
            "linkage.play": 0.3, "sensors.lvdt": max(error, 0.05),
        }.get(place.at, 0.3 if place.at.endswith("_play") else error)  # fmt: skip
