"""Stage `engine`: rotor speed from its demand, run freely."""

from __future__ import annotations

import numpy as np

from plant import chain, places
from plant.stages import engine_run
from vaneloop.identification.onset import that_begins
from vaneloop.identification.settings import NOISE_DRAWS, RASTER
from vaneloop.identification.subsystem import Array, Stage
from vaneloop.identification.vane_chain.parameters import declared, lanes
from vaneloop.identification.vane_chain.resample import expect_draws, last_digit, pieces_of
from vaneloop.identification.vane_chain.subsystem_data import Driven, Made

__all__ = ["engine_stage"]


@that_begins
def engine_stage(driven: Driven) -> Stage:
    """Rotor speed from its demand; the speed at the start of each stretch is what suits its first second."""
    t, c, machine, _, outputs, run = driven[:6]
    parameters, effects, rows, si = declared("engine", driven)
    dt = float(t[1] - t[0])
    inner = 1 if dt <= 1.5 * RASTER else int(round(dt / RASTER))

    def between_rows(n_dem: Array) -> Array:  # of a slow log the demand is taken to run straight there
        return np.interp(np.arange(len(t) * inner) / inner, np.arange(len(t)), n_dem)

    logged = between_rows(c["n_dem"])
    signals = driven.signals()
    between = np.repeat(signals, inner, axis=1)
    pieces = pieces_of(c["stretch"])
    second = max(1, int(round(1.0 / dt)))

    def simulate(thetas: Array, n_dem: Array = logged) -> Array:
        p = lanes(driven, thetas, rows, si)
        s = np.zeros((chain.N_STATE, len(thetas)))
        out = np.empty((len(n_dem), len(thetas)))
        slipped = driven.slipping(signals, p)
        known = between if slipped is signals else np.repeat(slipped, inner, axis=1)
        for piece in pieces:
            head = min(piece.start + second, piece.stop)
            start = np.full(len(thetas), np.median(c["n_r"][piece][:5]))
            # at its rate limit the engine never forgets how it began: the speed at the start is what suits the first
            # second
            for stop in (head, piece.stop):
                inside = slice(piece.start * inner, stop * inner)
                s[places.N_R] = start
                engine_run(n_dem[inside], dt / inner, p, s, out[inside], np.ascontiguousarray(known[:, inside]))
                began = driven.passed.of_rows(out[piece.start * inner : head * inner : inner].T, dt).T
                start = start + np.mean(c["n_r"][piece.start : head, None] - began, axis=0)
        return driven.passed.of_rows(out[::inner].T[:, None, :], dt)

    measured = driven.measured(run)
    stage = Stage("engine", outputs, ("%",), parameters, effects, simulate, t, measured)
    stage.made = Made(engine_stage, driven)
    if driven.digit("n_dem") and not driven.again:
        neutral = stage.neutral()[None]
        digit = last_digit(c["n_dem"], driven.digit("n_dem"))
        drawn = (digit(np.random.default_rng(k)) for k in range(NOISE_DRAWS))
        draws = [simulate(neutral, logged + between_rows(d))[0] for d in drawn]
        expect_draws(stage, np.array(draws) - simulate(neutral)[0])
    return stage
