"""Stage `servo`: the firmware's current from logged demand and stroke, in windows with the integral free."""

from __future__ import annotations

import numpy as np

from hil.figures import noise_floor
from plant.curve import QUANTITIES, SERVO_ADDS, SERVO_TIMES
from vaneloop.identification.onset import that_begins
from vaneloop.identification.settings import NOISE_KNOWN_TO, WINDOW
from vaneloop.identification.subsystem import Array, Stage, without_jumps
from vaneloop.identification.vane_chain.parameters import bends, declared
from vaneloop.identification.vane_chain.resample import no_gap_in_window, rms
from vaneloop.identification.vane_chain.subsystem_data import Driven, Made

__all__ = ["servo_stage"]


@that_begins
def servo_stage(driven: Driven) -> Stage:
    """Current from logged demand and stroke, by the firmware's law."""
    t, c, _, cal, outputs, run = driven[:6]
    parameters, effects, _, _ = declared("servo", driven)
    mean, hidden = c["law"].mean(axis=1), c["law_error"].T
    named = len(effects) > len(driven.curves)  # controller_gain_error
    signals = driven.signals()
    if driven.curved:
        signals[QUANTITIES["i_cmd"].of] = mean * 1e-3  # of the law's own current, which has no noise of the logged one

    def simulate(thetas: Array) -> Array:
        factor = thetas[:, :1] if named else np.ones((len(thetas), 1))
        i = factor * mean[None]
        if driven.curved:
            times, adds = bends(driven, thetas, signals, SERVO_TIMES, SERVO_ADDS)
            i = i * (1.0 + times) + adds
        return i[:, None, :]

    # at the limit the integral stands still: its constant is another one before and after
    at_limit = np.convolve(np.abs(c["i_cmd"]) >= 0.9e3 * cal.scalars.current_limit, np.ones(5), "same") > 0.5
    near = no_gap_in_window(t, ~at_limit) & ~(np.convolve(c["missing"], np.ones(9), "same") > 0.5)
    stage = Stage(
        "servo", outputs, ("mA",), parameters, effects, simulate, t, driven.measured(run & near), window=WINDOW
    )
    stage.lost = hidden[:, None]
    stage.made = Made(servo_stage, driven)
    if driven.again:
        return stage
    # the part of the hidden error that moves too slowly to be seen as noise in the stage's error; two estimates of one
    # noise are one noise
    drawn = float(np.mean([noise_floor(t, h) for h in hidden]))
    own = noise_floor(t, without_jumps(stage, stage.measured[0] - mean))
    seen = own if own < (1.0 + NOISE_KNOWN_TO) * drawn else drawn
    whole = np.mean([rms(stage, h[None]) ** 2 for h in hidden], axis=0)
    stage.raster_error = np.sqrt(np.maximum(whole - seen**2, 0.0))
    return stage
