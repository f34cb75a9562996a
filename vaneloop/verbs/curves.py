"""What was measured, what a fitted model says of it, and what is left: curves in the units of the log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hil.logs.channels import Channel, Channels
from vaneloop.identification.least_squares.problem import recalibrate
from vaneloop.identification.subsystem import Array
from vaneloop.identification.user_models.by_log import Logs
from vaneloop.verbs.estimates import Fitted

__all__ = ["Curve", "Curves", "curves_of_logs", "curves_of_stages"]


class Curve(NamedTuple):
    """One output on one log.

    residual  measured minus model, in ``unit``; NaN where nothing was measured
    before    the same with the nominal model
    floor     noise floor; NaN: not known
    """

    name: str
    of: str
    unit: str
    t: Array
    measured: Array
    residual: Array
    before: Array
    floor: float

    def ratio(self) -> float:
        """RMS of what the nominal model leaves, in noise floors."""
        good = self.before[np.isfinite(self.before)]
        return float(np.sqrt(np.mean(good**2)) / self.floor) if len(good) and self.floor > 0.0 else 0.0


class Curves:
    """Curves of an answer by name: that of the output, with its log or subsystem before it where two have the same."""

    def __init__(self, curves: Sequence[Curve], path: str):
        many = Counter(c.name for c in curves)
        self.by_name: Mapping[str, Curve] = {f"{c.of}: {c.name}" if many[c.name] > 1 else c.name: c for c in curves}
        self.path = path

    @property
    def residuals(self) -> Channels:
        """Measured minus model, where there is a number for it."""
        return self._channels({n: c.residual for n, c in self.by_name.items()})

    @property
    def fitted(self) -> Channels:
        """What the model says, where something was measured."""
        return self._channels({n: c.measured - c.residual for n, c in self.by_name.items()})

    def worst(self) -> str:
        """The curve that the nominal model misses most."""
        return max(self.by_name, key=lambda n: self.by_name[n].ratio(), default="")

    def _channels(self, of: Mapping[str, Array]) -> Channels:
        channels = {}
        for name, values in of.items():
            c, there = self.by_name[name], np.isfinite(values)
            channels[name] = Channel(c.t[there], values[there], False, c.unit)
        return Channels(self.path, channels)


def curves_of_stages(fits: Sequence[Fitted], path: str) -> Curves:
    """Every output of every stage, driven by its own logged inputs. Of a stage that integrates, its model starts anew
    in each window: the constant there is taken off the error.
    """
    out = []
    for judge, fit, base, start in fits:
        stage = judge.stage
        nominal = base or recalibrate(judge)
        e = judge.errors(np.array([fit.theta, nominal.theta])) * judge.floor[None, :, None]
        e = np.where(judge.valid, e, np.nan)
        for k, name in enumerate(stage.outputs):
            y = np.where(judge.valid[k], stage.measured[k], np.nan)
            out.append(
                Curve(name, stage.name, stage.units[k], start + stage.t, y, e[0, k], e[1, k], float(judge.floor[k]))
            )
    return Curves(out, path)


def curves_of_logs(logs: Logs, theta: Array, base: Array, path: str) -> Curves:
    """Every output of a user's own system, log by log, also of those that only test it."""
    out = []
    after, before = logs.errors(theta), logs.errors(base)  # model minus measured
    for bound in (logs.fitted, logs.test):
        if bound is None:
            continue
        for (log, at), t in zip(bound.logs.items(), bound.data.times, strict=True):
            for k, (name, unit) in enumerate(bound.system.outputs.items()):
                floor = float(logs.fitted.floor[k])
                y = bound.measured[k, at]
                out.append(Curve(name, log, unit, t, y, -after[log][k], -before[log][k], floor))
    return Curves(out, path)
