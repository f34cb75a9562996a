"""A law that nobody listed: where it acts, of which quantity it is a function, and its curve.

Every injection point of the model is tried with every regressor of the logs or the model. Linear screening ranks the
candidates: one linear solve each, with the derivatives of the residuals by the curve's amplitudes. The leaders are
fitted inside the simulation, with the model's own parameters. A curve is accepted by the rules for a library term
(`identification.selection.rules`), and must do clearly better than the best library terms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.regimes import agrees
from vaneloop.identification.results import rms_of
from vaneloop.identification.selection.relative_error_acceptance import score
from vaneloop.identification.selection.rules import DISSIPATES
from vaneloop.identification.selection.stepwise import stepwise
from vaneloop.identification.settings import (
    BENDS_TRIED,
    BETTER,
    CURVES_FINISHED,
    CURVES_QUICK,
    FAR_OFF,
    FEW_STEPS,
    FINE_SPLINES,
    FORMULAS_WITHIN,
    HARM,
    LAG_TIMES,
    LEAST_LAG_GAIN,
    MANY_STEPS,
    MAY_CATCH_UP,
    MOST_CURVES,
    MOST_HYSTERESES,
    MOST_LEFT,
    MOST_OVER_TIME,
    MOST_PLAINER,
    PER_PARAMETER,
    PERIOD_TURNS,
    RIVAL,
    SCREENED_BEND,
    SURE_BY_HELD_OUT,
    UNKNOWN,
)
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.closed_form_fits import fitted_formulas
from vaneloop.identification.unmodelled.curve_candidates import Candidate
from vaneloop.identification.unmodelled.curve_choice import (
    all_in_their_place,
    another_confirms,
    at_its_place,
    earning_by_formula,
    harmless,
    instead_of,
    leaves,
    said_first,
    tell_each_by_its_formula,
    without_memory,
)
from vaneloop.identification.unmodelled.fitted_candidate import (
    MEASURED,
    FittedCandidate,
    Outcome,
    adds_what,
    channel_of,
    one_constant,
    plain,
    stands,
    strange,
    surely_more,
    without_its_lag,
)
from vaneloop.identification.unmodelled.problem import CurveProblem, grain_of, in_grains, promises
from vaneloop.identification.unmodelled.screening import screened, smoothed
from vaneloop.identification.unmodelled.surface_search import SurfaceSelection
from vaneloop.identification.user_models.exogenous_regressors import TIME, share_given_back

__all__ = ["CurveSearch"]


class CurveSearch(CurveProblem):
    """The search for curves on one subsystem: the candidates of `stepwise` are the model with one curve more.

    out        what is learned, as far as it is known
    by_formula of the last step, names of the curves that are accepted by a closed form only
    ended      whether no further curve is looked for: a closed form leaves nothing but noise
    """

    out: Outcome
    unknown: bool
    by_formula: frozenset[str] = frozenset()
    ended = False

    def learned(self) -> Outcome:
        """Curves one after the other, at most two, then a surface in their place; each must be accepted."""
        out = self._searched()
        out.decisions = list(self.decisions)
        return out

    def _searched(self) -> Outcome:
        out = self.out = Outcome("none")
        self.unknown = self.d.verdict == "unknown"  # the diagnosis says that something is missing: so it is
        if not (self.unknown or self.faint or self.form.fails(self.base)):
            out.why = "the model comes down to the noise of its samples: nothing is missing"
            return out
        named = self._named()
        if named is not None and self.d.effects and agrees(rms_of(*named), 1.0):
            out.verdict = "named"
            out.why = f"{' + '.join(self.d.final.effects)} of the library leaves nothing but noise"
            return out
        if self.candidates:
            nothing = FittedCandidate(self.candidates[0], 0.0, self.judge, self.base, ())
            out.tried = stepwise(self, nothing)[1:]
            surfaces = SurfaceSelection(self, out, nothing)
            surface = stepwise(surfaces, surfaces.before)[1:]
            out.tried = surface or out.tried
        return self._concluded(out, named)

    # ---- the steps of `stepwise` -------------------------------------------------------------------------------------

    def wants_more(self, current: FittedCandidate) -> bool:
        """Whether the model leaves more than noise and may have another curve."""
        curves = len(current.curves)
        if self.ended or curves >= MOST_CURVES:
            return False
        return self.fails(current) or (not curves and (self.unknown or self.faint))

    def accepted(self, current: FittedCandidate, tried: Sequence[FittedCandidate]) -> list[FittedCandidate]:
        """Curves that the rules accept, by themselves or by a closed form, and that harm no validation log."""
        self.out.nearest = self.out.nearest or [t.candidate.name for t in tried[:3]]
        good = [t for t in tried if self.allowed(current, t)]
        poor = [t for t in tried if t not in good]
        only_said = earning_by_formula(self, current, poor, tried) if self.speaks else []
        self.by_formula = frozenset(t.candidate.name for t in only_said)
        return [*good, *only_said]

    def chosen(self, current: FittedCandidate, accepted: Sequence[FittedCandidate]) -> FittedCandidate | None:
        """Of the curves that do as well as the best, the preferred one that other logs or amplitudes confirm."""
        good = list(accepted)
        left = {t.candidate.name: self.left(current, t, good) for t in good}
        self._with_formulas(current, good, left)
        good = harmless(self, current, good, left)
        good = without_memory(self, current, good)
        self._tell_apart(good, left)
        near = said_first(self, self._near(current, good, left), left)
        harms = []
        for chosen in (t for t in near if another_confirms(self, current, t)):  # what harms makes way for the next
            best, why = self._as_learned(current, chosen)
            if not why:
                break
            harms.append(f"{best.candidate.name} fits, but is not learned: {why}")
        else:
            confirms = "no validation log is better for it"
            if near[0].candidate.quantity.remembers:
                confirms = "it remembers, and neither another log nor another amplitude confirms it"
            forgets = f"{near[0].candidate.name} fits, but is not learned: {confirms}"
            self.out.notes += harms[:1] or [forgets]
            return None
        limit = left[chosen.candidate.name] + RIVAL
        rivals = [t.candidate.name for t in good if t is not chosen and left[t.candidate.name] < limit]
        # what splines do not follow is no second law where a formula does
        self.ended = any(not self.fails(f) for _, f in best.formulas or ()) or best.candidate.name in self.by_formula
        return replace(best, rivals=rivals)

    def pruned(self, models: list[FittedCandidate]) -> list[FittedCandidate]:
        """Without a first curve that only stood for what the second one is; the closed forms of those that stay."""
        nothing, *curves = models
        if len(curves) > 1:
            curves = self._without_first(*curves)
        if len(curves) > 1:
            tell_each_by_its_formula(self, *curves)
        return [nothing, *curves]

    def _as_learned(self, current: FittedCandidate, tried: FittedCandidate) -> tuple[FittedCandidate, str]:
        """A curve with the lag that suits it best, and without what parameters of the model can have; and why it is not
        learned, "" if it is: it harms a test log, and no formula that does as well is harmless.
        """
        best = self._settled(current, self._with_its_lag(current, tried, LAG_TIMES[1:]))
        why = self.objection(current, best)
        if why or self.fails(best):
            best.formulas = fitted_formulas(self.ground, best)
        for _, f in best.formulas or () if why and self.speaks else ():
            if not self.objection(current, f) and self.score(f, [f, best]) <= self.score(best, [f, best]) + RIVAL:
                why = ""
        return best, why

    def _without_first(self, first: FittedCandidate, second: FittedCandidate) -> list[FittedCandidate]:
        """The two curves; the second one alone where that does as well."""
        own = second.judge.stage.index()
        gone = {*range(own[first.candidate.name].start, own[first.candidate.name].stop)}
        theta = np.array([v for k, v in enumerate(second.fit.theta) if k not in gone])
        nothing = FittedCandidate(second.candidate, 0.0, self.judge, self.base, ())
        alone = self.fitted(nothing, second.candidate, second.wiggle, theta, 16)
        if self.score(alone, [alone, first]) <= self.score(second, [alone, first]) + BETTER:
            return [replace(alone, told=second.told, rivals=second.rivals)]
        return [first, second]

    def _named(self) -> tuple[LeastSquaresProblem, Fit] | None:
        """The best laws of the library, fitted with their held-out errors, where there are any."""
        effects = self.d.final.effects or tuple(self.d.nearest[:1])
        if not effects:
            return None
        judge = self.judge_of(effects, ())
        theta = judge.stage.neutral()
        whole, part = self.ground.whole.index(), judge.stage.index()
        theta[: len(self.base.theta)] = self.d.final.theta[: len(self.base.theta)]
        for e in effects:
            if self.d.final.effects:
                theta[part[e]] = self.d.final.theta[whole[e]]
            else:
                theta[part[e]] = self.ground.whole.effect(e).starts[0]
        return judge, judge.fit(effects, theta, 8)

    def _concluded(self, out: Outcome, named: tuple[LeastSquaresProblem, Fit] | None) -> Outcome:
        if not out.tried:
            out.verdict = "named" if self.d.effects else "unknown"
            out.why = (
                "no function of one or two quantities, at any place, explains enough of the error on data left out"
            )
            return out
        last = out.tried[-1]
        left, was = leaves(last), rms_of(self.judge, self.base)
        share = max(left**2 - 1.0, 0.0) / max(was**2 - 1.0, 1e-300)
        if left > UNKNOWN and share > MOST_LEFT:
            out.verdict, out.why = "unknown", f"the best curve leaves {np.sqrt(share):.0%} of the error"
        elif named and self.d.effects and not instead_of(self, self._as_tried(last.candidate, *named), out.tried):
            out.verdict = "named"
            out.why = f"{' + '.join(self.d.final.effects)} of the library does as well, or nearly"
        else:
            out.verdict = "learned"
        return out

    def _as_tried(self, candidate: Candidate, judge: LeastSquaresProblem, fit: Fit) -> FittedCandidate:
        """The laws of the library, to hold a candidate against them."""
        return FittedCandidate(candidate, 0.0, judge, fit, (), errors=self.ground.errors((), fit.theta, fit.effects))

    def allowed(self, before: FittedCandidate, tried: FittedCandidate) -> bool:
        """Whether the rules accept a curve by itself; a hysteresis must dissipate."""
        c = tried.candidate
        if c.quantity.stops:
            table, amplitudes = tried.table()
            share = share_given_back(c.basis.low, c.basis.high, table(amplitudes))
            if not self.decisions.decide([DISSIPATES], share, tried.names, before.names):
                return False
        return self.accepts(before, tried)

    def _with_formulas(self, before: FittedCandidate, good: Sequence[FittedCandidate], left: dict[str, float]) -> None:
        """Where the best curve still fails, or harms a test log, what each may leave with a formula in its place, else
        those of a plainer quantity: a corner or a jump is none for splines, and beyond what other blocks tell them they
        go astray. Where one of those is then before the best, all have theirs. Every formula counts as many numbers as
        the sparest of these curves, however many its own has.
        """
        best = min(good, key=lambda t: left[t.candidate.name])
        costs = [left, {t.candidate.name: 0.5 * float(np.log(t.fit.cost.sum() / t.judge.n)) for t in good}]
        close = [t for t in good if any(c[t.candidate.name] <= c[best.candidate.name] + FORMULAS_WITHIN for c in costs)]
        close += [t for t in at_its_place(before, good) if t not in close]
        first = close
        if not (self.fails(best) or self.objection(before, best)):
            first = [t for t in close if strange(t.candidate) < strange(best.candidate)]
        sparest, least = min(len(t.fit.free) for t in (*close, best)), left[best.candidate.name]
        for some in (first, [t for t in close if t not in first]):
            all_in_their_place(self.ground, some)
            for t in some:
                name = t.candidate.name
                for f in t.loose or ():
                    spared = PER_PARAMETER * (sparest - len(f.fit.free))
                    left[name] = min(left[name], self.left(before, f, good) + max(spared, 0.0))
            if min((left[t.candidate.name] for t in first), default=least) >= least:
                break

    def _tell_apart(self, good: Sequence[FittedCandidate], left: dict[str, float]) -> None:
        """Put those behind that are surely worse, block by block, than the best of what neither remembers nor drifts,
        where that leaves nothing but noise: at the noise a wrong channel that goes together with the right one leaves
        little more.
        """
        plain_ones = [t for t in good if strange(t.candidate) <= MEASURED and not self._echoes(t.candidate)]
        best = min(plain_ones, key=lambda t: left[t.candidate.name], default=None)
        if best is None or self.fails(best):
            return
        for t in plain_ones:
            (_, worse), (_, fit) = (self.judged(one, [t, best]) for one in (t, best))
            if surely_more((worse.held_out - fit.held_out)[self.judge.samples > 0]):
                left[t.candidate.name] = max(left[t.candidate.name], left[best.candidate.name] + 2.0 * RIVAL)

    def _echoes(self, candidate: Candidate) -> bool:
        """Whether a curve is of what the stage itself gives elsewhere, as measured: with that goes its noise, and a
        little of that off the error.
        """
        return channel_of(candidate) in self.ground.measured and strange(candidate) > 0

    def _preferred(self, tried: FittedCandidate, left: float) -> tuple[float, ...]:
        """What orders candidates that do as well: the plainer first; of equally plain ones that which leaves less, and
        where the held-out error is noise, less in all.
        """
        return *plain(tried.candidate), round(left, 2), rms_of(tried.judge, tried.fit)

    def _near(
        self, before: FittedCandidate, good: list[FittedCandidate], left: Mapping[str, float]
    ) -> list[FittedCandidate]:
        """The candidates that do as well as the best, plainest first; ``good`` is put in order."""
        good.sort(key=lambda t: left[t.candidate.name])
        near = [t for t in good if left[t.candidate.name] < left[good[0].candidate.name] + RIVAL]
        plainer = [t for t in good if t not in near and self._plainer(before, t, good[0])]
        limit = max((left[t.candidate.name] for t in plainer), default=-np.inf) + RIVAL  # as good as one of those
        alike = [t for t in good if t not in near and adds_what(t.candidate, good[0].candidate)]
        near += [t for t in alike if t in plainer or left[t.candidate.name] < limit]
        return sorted(near, key=lambda t: self._preferred(t, left[t.candidate.name]))

    def _plainer(self, before: FittedCandidate, tried: FittedCandidate, best: FittedCandidate) -> bool:
        """Whether a curve adds what the best one makes of a parameter, of the same quantity, and that does not earn its
        place before it: a damping times a function of the speed is a force that is one of the speed.
        """
        if not adds_what(tried.candidate, best.candidate):
            return False
        if self.accepts(tried, best):
            return False
        mine, its = (self.tested(before, t, [tried, best]) for t in (tried, best))
        return mine < its + HARM

    def _with_its_lag(self, current: FittedCandidate, best: FittedCandidate, steps: Sequence[float]) -> FittedCandidate:
        """The curve with the lag that suits it best, by such ``steps`` up and down; or with the period."""
        q = best.candidate.quantity
        if q.period:  # by so many turns over the whole way
            steps = [1.0 + turns * q.period / q.span for turns in PERIOD_TURNS]
        for times in steps if q.slower is not None else ():
            for factor in (times, 1.0 / times):
                while (more := self._slower(current, best, factor)) is not None:
                    best = more
        return best

    def _slower(self, current: FittedCandidate, best: FittedCandidate, times: float) -> FittedCandidate | None:
        """The curve with a lag so many times as long; None where that is no better."""
        if (slower := best.candidate.slower(times)) is None or stands(current, slower):
            return None
        more = self.fitted(current, slower, best.wiggle, self._begun(best, slower), 12, slopes=best.slopes())
        (judge, now), (_, was) = (self.judged(t, [more, best]) for t in (more, best))
        worse = score(judge, now) - score(judge, was)
        # within the noise the score does not tell: what is left there still does
        falls = 0.5 * float(np.log(was.held_out.sum() / now.held_out.sum()))
        return more if worse < -LEAST_LAG_GAIN or (worse < LEAST_LAG_GAIN and falls > LEAST_LAG_GAIN) else None

    def _begun(self, tried: FittedCandidate, candidate: Candidate) -> Array:
        """Parameters from which a candidate begins that is nearly what has been fitted."""
        c, theta = tried.candidate, tried.fit.theta
        if candidate.splines == c.splines and candidate.parts == c.parts:
            return theta
        own = tried.judge.stage.index()[c.name]
        return np.concatenate([theta[: own.start], candidate.as_of(c, theta[own])])

    def _settled(self, current: FittedCandidate, best: FittedCandidate) -> FittedCandidate:
        """The curve without mean, without slope, or without both, where the logs do not tell them from the model's own
        parameters.

        Along such a valley a fit ends anywhere; here it ends where the parameters say all that they can.
        """
        whole = best.candidate
        found = dict(zip(whole.parts, best.fit.theta[best.judge.stage.index()[whole.name]], strict=True))
        nominal, near = [current.fit.theta, best.fit.theta[: len(current.fit.theta)]], best.slopes()
        for untold in ((0, 1), (1,), (0,)) if whole.basis.straight == 2 else ((0,),):
            c = replace(whole, untold=untold)
            if len(c.kept) == len(whole.kept) or not c.kept:
                continue
            bends = [found[k] for k in c.parts]
            with self.told_in_nats(best):
                fits = [self.fitted(current, c, best.wiggle, np.append(n, bends), 16, False, near) for n in nominal]
                simpler = min(fits, key=self.score)
                as_well = self.score(simpler) <= self.score(best) + BETTER
            if as_well:
                simpler.judge.stage.grain = best.judge.stage.grain
                return replace(simpler, told=best.fit)
        return best

    # ---- candidates --------------------------------------------------------------------------------------------------

    def finalists(self, current: FittedCandidate) -> list[FittedCandidate]:
        """The candidates that promise most, fitted; best first."""
        near, (bare, promising) = current.slopes(beside=False), screened(self, current, CURVES_QUICK, LAG_TIMES[0])
        quick: list[FittedCandidate] = []
        if self.faint and not (promising and promises(bare, promising[0][0])):
            return []
        steps = MANY_STEPS if not self.ground.noise_known and bare > FAR_OFF**2 * self.judge.n else FEW_STEPS
        few = lambda p: self.fitted(current, p[1], SCREENED_BEND, p[2], steps, True, near)  # noqa: E731
        for k, t in enumerate(self.each(few, promising)):
            quick.append(t)
            self.progress((k + 1.0) / (CURVES_QUICK + CURVES_FINISHED + 1.0))
        short = len(quick[0].judge.stage.t) < len(self.judge.stage.t) if quick else False
        if short and not all(self.fails(t) for t in quick):  # where an excerpt does not tell them apart, all samples do
            quick = [self.fitted(current, t.candidate, SCREENED_BEND, t.fit.theta, 1) for t in quick]
        quick.sort(key=lambda t: score(t.judge, t.fit))
        self.ranked.append(list(quick))
        quick, done = one_constant(quick), []
        over_time = [t for t in quick if t.candidate.quantity.name == TIME][MOST_OVER_TIME:]
        quick = [t for t in quick if t not in over_time]
        # of what varies slowly a block that is left out says little at one smoothness: some go on by how well they fit
        first, others = quick[:SURE_BY_HELD_OUT], quick[SURE_BY_HELD_OUT:]
        others.sort(key=lambda t: float(t.fit.cost.sum()))
        chosen = [*first, *others[: CURVES_FINISHED - SURE_BY_HELD_OUT]]
        # a short excerpt has too few turns for what slips: the hystereses that promised most go on, too
        slipping = [c.name for _, c, _ in promising if c.quantity.stops][:MOST_HYSTERESES]
        chosen += [t for t in quick if t.candidate.name in slipping and t not in chosen]
        for k, t in enumerate(self.each(lambda t: self._finished(current, t), chosen)):
            done.append(t)
            self.progress((CURVES_QUICK + k + 1.0) / (CURVES_QUICK + len(chosen) + 1.0))
        if self.faint and done:
            nearest = min(done, key=lambda t: rms_of(t.judge, t.fit))
            grain = grain_of(nearest.judge, nearest.fit)
            in_grains(self.ground, grain, [self.judge, *(t.judge for t in (*quick, *done))])
        done = self.ordered(done)
        if done:  # what is plainer may say the same
            leader, have = done[0].candidate, {t.candidate.name for t in done}
            reach = min(score(t.judge, t.fit) for t in quick) + MAY_CATCH_UP
            plainer = [t for t in quick if t.candidate.name not in have and plain(t.candidate) < plain(leader)]
            alike = {t.candidate.name for t in plainer if channel_of(t.candidate) == channel_of(leader)}
            home = sorted(at_its_place(current, plainer), key=lambda t: float(t.fit.cost.sum()))[:MOST_PLAINER]
            plainer = [t for t in plainer if t.candidate.name in alike or score(t.judge, t.fit) < reach]
            plainer.sort(key=lambda t: (t.candidate.name not in alike, t.candidate.at != leader.at))
            more = dict.fromkeys([*plainer[:MOST_PLAINER], *home])
            done = self.ordered([*done, *self.each(lambda t: self._finished(current, t), more)])
        if done and self.fails(done[0]):  # a curve may turn more often than its splines
            best = self.score(done[0], done)
            close = [t for t in done if self.score(t, done) < best + MAY_CATCH_UP or without_its_lag(t, done[0])]
            more_splines = zip(close, self.each(lambda t: self._finer(current, t), close), strict=True)
            finer = {t: f for t, f in more_splines if f is not None}
            home = at_its_place(current, done)
            close = [t for t in done if t in home or self.score(t, done) < best + FORMULAS_WITHIN]
            jumping = [j for j in self.each(lambda t: self._jumping(current, t), close) if j is not None]
            coarse = [t for t in done if t in finer and self.accepts(t, finer[t])]  # a second law would patch them
            done = self.ordered([*(t for t in done if t not in coarse), *finer.values(), *jumping])
            first_of = {t.candidate.name: t for t in reversed(done)}
            done = [t for t in done if first_of[t.candidate.name] is t]
        return done

    def _finished(self, current: FittedCandidate, quick: FittedCandidate) -> FittedCandidate:
        """A candidate fitted to the end, as smooth and with the lag that suits it best."""
        begin = quick.fit if len(quick.judge.stage.t) == len(self.judge.stage.t) else quick.fit.theta
        done = smoothed(self, current, quick.candidate, begin, BENDS_TRIED)
        # what was before the log is no matter of the curve; of own models laws with names remember it as well
        if self.ground.noise_known and (settled := done.forgotten()) is not None:
            done = smoothed(self, current, replace(done.candidate, settled=settled), done.fit, BENDS_TRIED, done.wiggle)
        return self._with_its_lag(current, done, LAG_TIMES[:1])

    def _finer(self, current: FittedCandidate, coarse: FittedCandidate) -> FittedCandidate | None:
        """The same curve with `FINE_SPLINES` splines."""
        if (fine := coarse.candidate.finer(FINE_SPLINES)) is None:
            return None
        return self.fitted(current, fine, BENDS_TRIED[-1], self._begun(coarse, fine), 12, slopes=coarse.slopes())

    def _jumping(self, current: FittedCandidate, smooth: FittedCandidate) -> FittedCandidate | None:
        """The same curve with a jump where its quantity is 0."""
        c = smooth.candidate.jumping() if self.ground.jumps else None
        if c is None:
            return None
        begun = replace(smooth.fit, theta=np.append(smooth.fit.theta, 0.0))
        return self._finished(current, replace(smooth, candidate=c, fit=begun))
