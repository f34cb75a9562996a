"""The actuator: stroke from the current."""

from __future__ import annotations

import numpy as np

from plant import chain, curve
from plant.chain import bent_reading, measured_stroke, straightened, true_stroke
from plant.curve_lanes import alike
from plant.effects import CURVES, aero_load
from plant.parameters import ACTUATORS, DRIVE_EFFECTS, KIND, LVDT_FACTOR, LVDT_LAG, LVDT_SHARE, VALVE_SHARE
from plant.places import AERO_LOAD, LVDT_LAG_ERROR, READING, SCREW_PITCH_ERROR, VALVE_LAG, X_LVDT, X
from plant.stages import hydraulic_blocks, motor_blocks
from plant.stages.blocks import NO_RINGS, NOTHING, W, between, in_blocks, on_all_cores, parts_of
from vaneloop.base.compiled import compiled_free

__all__ = ["actuator_run"]

FEW = 1  # so few lanes or fewer are quicker one by one


def actuator_run(
    current: np.ndarray,
    n_r: np.ndarray,
    p_s: np.ndarray,
    t_oil: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    x_lvdt: np.ndarray | None = None,
    window: int = 0,
    known: np.ndarray = NOTHING,
    rings: np.ndarray = NO_RINGS,
) -> None:
    """Fill out[k, lane] with the stroke (m) as the LVDT gives it at sample k, without noise. ``s`` is moved on.

    current           A in every step, of `step_currents`
    n_r, p_s, t_oil   %, Pa, degC; their mean over the step is used
    out               quickest where a lane's samples lie side by side in memory
    x_lvdt, window    measured stroke (m): every ``window`` samples, from the first on, the piston is put where the LVDT
                      saw it, so that a small error of speed does not carry it away; without them it starts from ``s``
                      and runs free
    known             signals of curves (`plant.curve.take`); the current's is that of every step
    rings             float64[2, lanes, samples]: of one of two actuators, what the rings do to its piston
                      (`plant.stages.ring_loads`); its ``p`` has its share of the air's load

    The lags' shares in ``p`` are set to h / (h + tau): over long steps h this keeps the delay of a ramp exact, where
    the share of a constant input, 1 - exp(-h / tau), would be early by h / 2.
    """
    if window and x_lvdt is None:
        raise ValueError(f"window (={window}) needs x_lvdt")
    x = np.ascontiguousarray(x_lvdt) if window else np.zeros(1)
    if window:
        _rest(p, s, current[0, 0], n_r[0], t_oil[0])
    h = dt / current.shape[1]
    for share, tau in ((LVDT_FACTOR, LVDT_LAG), (LVDT_SHARE, LVDT_LAG_ERROR), (VALVE_SHARE, VALVE_LAG)):
        p[share] = h / (h + np.maximum(p[tau], 0.0))
    # what one lane of a block needs is computed for all eight: those that need the same are put side by side
    motor = p[KIND, 0] != 0.0  # all lanes are of one machine
    curved = p[CURVES] != 0.0
    alone = curved & ~alike(p)
    # neighbours are those that cost little more together
    need = np.zeros(p.shape[1]) if motor else hydraulic_blocks.costs(p)
    needed = np.empty((0, 0)) if motor else hydraulic_blocks.needs(p)
    order = np.lexsort((need, p[SCREW_PITCH_ERROR] != 0.0, curved, alone))
    # the chain joins both of two actuators; here one is alone
    wide = in_blocks(p.shape[1] - np.count_nonzero(alone), W, FEW if p[ACTUATORS, 0] == 0.0 else 0)

    def run(part: range) -> None:
        some = order[part.start : part.stop]
        if part.start < wide and motor:
            block = np.empty(1, motor_blocks.BLOCK)
            motor_blocks.run(current, n_r, t_oil, dt, p, s, out.T, x, window, some, block, known)
        elif part.start < wide:
            block = np.empty(1, hydraulic_blocks.BLOCK)
            hydraulic_blocks.run(
                current, n_r, p_s, t_oil, dt, p, s, out.T, x, window, some, block, known, needed, rings
            )
        else:
            _actuator_lanes(current, n_r, p_s, t_oil, dt, p, s, out.T, x, window, some, known)

    on_all_cores(run, parts_of(p.shape[1], wide, W))


@compiled_free
def _rest(p: np.ndarray, s: np.ndarray, i: float, n_r: float, t_oil: float) -> None:
    """Valve and oil at rest, a motor at its steady speed, under the current ``i`` (A) at ``n_r`` (%) and ``t_oil``
    (degC).
    """
    for j in range(p.shape[1]):
        chain.rest_actuator(s, p, j, i, aero_load.step(n_r, p[AERO_LOAD, j]), t_oil)


@compiled_free
def _actuator_lanes(
    current: np.ndarray,
    n_r: np.ndarray,
    p_s: np.ndarray,
    t_oil: np.ndarray,
    dt: float,
    p: np.ndarray,
    s: np.ndarray,
    out: np.ndarray,
    x_lvdt: np.ndarray,
    window: int,
    lanes: np.ndarray,
    known: np.ndarray,
) -> None:
    """These ``lanes``, one after the other; out[lane, k]."""
    n, substeps = current.shape
    h = dt / substeps
    for j in lanes:
        effects, curved = p[DRIVE_EFFECTS, j] != 0.0, p[CURVES, j] != 0.0
        for k in range(n):
            if k > 0:
                speed, supply, warm = between(n_r, k), between(p_s, k), between(t_oil, k)
                if curved:
                    curve.take(s, p, j, known, k - 1, k)
                for m in range(substeps):
                    if curved:
                        s[curve.S_CURRENT, j] = current[k, m]
                    chain.drive_step(s, p, j, current[k, m], speed, supply, warm, h, 1)
            if not effects:
                s[READING, j] = s[X_LVDT, j]
            if curved:
                curve.take(s, p, j, known, k, k)
            if window > 0 and k % window == 0:
                x = true_stroke(straightened(x_lvdt[k], s, p, j), p, j, t_oil[k])
                if k == 0:
                    s[X, j] = s[X_LVDT, j] = s[READING, j] = x
                else:
                    shift = x - s[READING, j]
                    s[X, j] += shift
                    s[X_LVDT, j] += shift
                    s[READING, j] += shift
            out[j, k] = s[READING, j]
            if effects:
                out[j, k] = bent_reading(measured_stroke(s[READING, j], p, j, t_oil[k]), s, p, j)
