"""The logged stroke with less of the LVDT's noise in it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_coeffs, savgol_filter

from hil.figures import noise_floor
from plant import Plant, chain, places
from plant.parameters import NAMES, derive
from plant.stages import actuator_run, step_currents
from vaneloop.discrepancy.models.vane_stages.raster import SUBSTEPS
from vaneloop.discrepancy.stage import Array

__all__ = ["SMOOTH", "Smooth", "without_noise"]

SMOOTH = (9, 15, 25, 41)  # rows over which the stroke's noise may be smoothed
SMOOTH_ORDER = 3
BENDS = (0.3, 0.6, 0.85, 0.97)  # shares of the rows that move less: where the curve of flow over opening may bend


class Smooth(NamedTuple):
    """Stroke (mm) at the rows with less of the LVDT's noise; its RMS (mm); errors (mm) such as it leaves, and as
    smoothing makes.

    off: mm, the logged stroke less the fitted model's, whose motion is mostly gone.
    """

    stroke: Array
    noise: float
    left: Array
    distortion: Array
    off: Array


def without_noise(t: Array, c: dict[str, Array], machine: Plant) -> Smooth:
    """The logged stroke with less of the LVDT's noise in it: the nominal model's, plus what it is off by, smoothed.

    The model takes the motion out, so that what is smoothed changes slowly; over how many rows, is decided by
    leave-one-out errors.
    """
    dt = float(t[1] - t[0])
    p = machine.p.copy()
    p[NAMES.index("actuator.stroke")] = 2e3  # the stops out of the way: a wrong null runs away in minutes
    derive(p, dt / SUBSTEPS, dt)
    s = np.zeros((chain.N_STATE, 1))
    s[places.X] = s[places.X_LVDT] = s[places.READING] = 1e3
    out = np.empty((len(t), 1))
    n_r = np.ascontiguousarray(c.get("n_r", np.zeros(len(t))))
    current = step_currents(c["i_cmd"] * 1e-3, dt, SUBSTEPS)
    actuator_run(current, n_r, np.ascontiguousarray(c["p_s"] * 1e6), np.ascontiguousarray(c["t_oil"]), dt, p, s, out)
    # the model's steps, calibrated by least squares: the flow of both directions as a curve, its lag, null
    step = np.diff(out[:, 0], prepend=1e3) * 1e3
    bends = [0.0, *np.quantile(np.abs(step), BENDS)]
    sides = [np.maximum(side * step - bend, 0.0) for side in (1.0, -1.0) for bend in bends]
    parts = np.column_stack([np.roll(side, k) for side in sides for k in (-1, 0, 1)] + [np.ones(len(t))])
    logged = np.diff(c["x_lvdt"], prepend=c["x_lvdt"][0])
    whole = uniform_filter1d(c["fresh"], 5) > 0.999  # rows with their neighbours
    calibrated = parts @ np.linalg.lstsq(parts[whole], logged[whole], rcond=None)[0]
    model = np.cumsum(np.where(whole, calibrated, logged))  # over a gap the model goes where the stroke went
    off = c["x_lvdt"] - model
    tried = []
    for rows in SMOOTH:
        smooth, own = savgol_filter(off, rows, SMOOTH_ORDER), savgol_coeffs(rows, SMOOTH_ORDER)[rows // 2]
        left = float(np.mean((off - smooth) ** 2)) / (1.0 - own)  # white noise leaves 1 - own of its power
        tried.append((left / (1.0 - own), rows, np.sqrt(left), smooth))
    _, rows, size, smooth = min(tried, key=lambda x: x[0])
    noise = min(noise_floor(t, np.where(whole, off, np.nan)), size)
    left = savgol_filter(noise * np.random.default_rng(1).standard_normal(len(t)), rows, SMOOTH_ORDER)
    distortion = smooth - savgol_filter(off, rows // 4 * 2 + 1, SMOOTH_ORDER)
    fast = np.abs(distortion) > 2.0 * noise  # rather noisy than wrong
    return Smooth(
        np.where(fast, c["x_lvdt"], model + smooth), noise, left, np.where(fast, off - smooth, distortion), off
    )
