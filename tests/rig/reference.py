"""The design's nominal equations, stage by stage, each driven by a run's own logged input: how far the rig departs from
them.

Ideal flow gain, ideal play, clipped engine limits. Used to show that a clean run is clean at the noise floor, and to
size the effects. Wants a run at 1000 Hz whose i_cmd is the current at the row (``mean_through=True``).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from .controller import Compiled
from .geometry import STAGES as VANES
from .geometry import load, ring_tables, vane_angle
from .kernel import X_LOW, X_STEP, P
from .simulate import Run

DEG = np.pi / 180.0
STAGES = ("demand", "servo", "engine", "actuator", "linkage")


@njit(cache=True, error_model="numpy")
def _actuator(i, p_s, omega, zeta, gain, i_rated, tau):
    """Stroke as the LVDT sees it (m), without stops: spool of second order, u sqrt(p_s / 21 MPa), lag. 0.1 ms steps."""
    x = y = u = w = 0.0
    h = 1e-4
    out = np.empty(len(i))
    share = 1.0 - np.exp(-h / tau)
    for k in range(len(i)):
        out[k] = y
        for _ in range(10):
            a = omega * omega * (i[k] / i_rated - u) - 2.0 * zeta * omega * w
            um, wm = u + 0.5 * h * w, w + 0.5 * h * a
            u_new = min(max(u + h * wm, -1.0), 1.0)
            w += h * (omega * omega * (i[k] / i_rated - um) - 2.0 * zeta * omega * wm)
            x_new = x + h * 0.5 * (u + u_new) * gain * np.sqrt(p_s[k] / 21e6)
            y += share * (0.5 * (x + x_new) - y)
            u, x = u_new, x_new
    return out


@njit(cache=True, error_model="numpy")
def _play(drive, width, start):
    """Play operator of total ``width``."""
    out = np.empty(len(drive))
    y = start
    for k in range(len(drive)):
        y = min(max(y, drive[k] - 0.5 * width), drive[k] + 0.5 * width)
        out[k] = y
    return out


@njit(cache=True, error_model="numpy")
def _lag(v, tau, h):
    out = np.empty(len(v))
    y = v[0]
    share = 1.0 - np.exp(-h / tau)
    for k in range(len(v)):
        out[k] = y
        y += share * (v[k] - y)
    return out


@njit(cache=True, error_model="numpy")
def _engine(n_dem, n0, lag, up, down, h):
    out = np.empty(len(n_dem))
    n = n0
    for k in range(len(n_dem)):
        out[k] = n
        n += h * min(max((n_dem[k] - n) / lag, -down), up)
    return out


def actuator_residual(run: Run, window: float = 1.0) -> np.ndarray:
    """Measured minus nominal stroke (mm) on the run's rows, each window's own offset removed."""
    p = run.machine
    i, p_s = run.log["i_cmd"] * 1e-3, run.log["p_s"] * 1e6
    x = _actuator(i, p_s, p[P.spool_omega], p[P.spool_zeta], p[P.flow_gain], p[P.i_rated], p[P.lvdt_tau])
    return by_window(run.log["x_lvdt"] - x * 1e3, window)


def by_window(d: np.ndarray, window: float, rate: int = 1000) -> np.ndarray:
    """Residual with the mean of each window removed; rows after the last whole window are dropped."""
    n = round(window * rate)
    cut = d[: len(d) // n * n].reshape(-1, n)
    return (cut - cut.mean(axis=1, keepdims=True)).ravel()


def linkage_residual(run: Run) -> np.ndarray:
    """Measured minus nominal angles (deg), float64[rows, stages]: kinematics of the logged stroke, ideal play, lag.

    The stroke is a centred mean over 21 ms: the noise of single samples would push an ideal play along by its extremes.
    Each play starts where in its gap it fits the first second best.
    """
    tables = ring_tables(load())
    smooth = np.convolve(np.pad(run.log["x_lvdt"], 10, mode="edge"), np.full(21, 1.0 / 21.0), mode="valid")
    place = np.clip((smooth * 1e-3 - X_LOW) / X_STEP, 0, tables.shape[1] - 1)
    out = []
    for k, name in enumerate(VANES[: len(tables)]):
        drive = np.interp(place, np.arange(tables.shape[1]), tables[k])
        p = run.machine
        width = 2.0 * p[P.half_gap_0 + k]
        tries = []
        for start in drive[0] + width * np.linspace(-0.5, 0.5, 41):
            ring = _play(drive[:1000], width, start)
            model = vane_angle(ring, p[P.vane_ratio_0 + k]) + p[P.pot_bias_0 + k]
            tries.append((abs(np.mean(run.log[name][:1000] * DEG - model)), start))
        ring = _play(drive, width, min(tries)[1])
        model = _lag(vane_angle(ring, p[P.vane_ratio_0 + k]), p[P.pot_tau_0 + k], 1e-3) + p[P.pot_bias_0 + k]
        out.append(run.log[name] - model / DEG)
    return np.column_stack(out)


def engine_residual(run: Run) -> np.ndarray:
    """Measured minus nominal rotor speed (%)."""
    p = run.machine
    n = _engine(run.log["n_dem"], run.truth["n"][0], p[P.engine_lag], p[P.acceleration], p[P.deceleration], 1e-3)
    held = n[np.arange(len(n)) // 10 * 10]  # the frame carries the speed of its own time
    return run.log["n_r"] - held


def controller_residual(run: Run, controller: Compiled) -> tuple[np.ndarray, np.ndarray]:
    """Logged minus replayed stroke demand (mm) and current (mA): the unchanged controller fed with the logged frames
    and strokes.

    The current's slow part is the controller's own integral and drifts in open loop. The log does not say in which
    state the controller starts (the record does say from where it came); the first seconds are left out.
    """
    log = run.log
    inputs, state = controller.inputs.copy(), controller.state.copy()
    x_dem, i_cmd = np.empty(len(log["t"])), np.empty(len(log["t"]))
    for k in range(-1500, len(x_dem)):
        row = max(k, 0)
        inputs[controller.n_dem] = run.record["came_from"] if k < -1000 else log["n_dem"][row]
        inputs[controller.n_r] = log["n_r"][row]
        # before the log the stroke follows its demand, so that no monitor takes it for stuck
        inputs[controller.x_lvdt] = state[controller.x_dem] if -1500 < k < 0 else log["x_lvdt"][row] * 1e-3
        inputs[controller.fresh] = 1.0 if k % 10 == 0 else 0.0
        controller.tick(inputs, state, controller.calibration)
        if k >= 0:
            x_dem[k], i_cmd[k] = state[controller.x_dem] * 1e3, state[controller.i_cmd] * 1e3
    return (log["x_dem"] - x_dem)[3000:], (log["i_cmd"] - i_cmd)[3000:]


def stage_errors(run: Run, controller: Compiled, stages: Sequence[str] = STAGES) -> dict[str, float]:
    """RMS error of each stage: demand (mm), servo (mA), engine (%), actuator (mm), linkage (deg, the worst vane
    stage).
    """
    out = {}
    if "demand" in stages or "servo" in stages:
        demand, servo = controller_residual(run, controller)
        out |= {"demand": float(np.sqrt(np.mean(demand**2))), "servo": float(np.std(by_window(servo, 1.0)))}
    if "engine" in stages:
        out["engine"] = float(np.sqrt(np.mean(engine_residual(run) ** 2)))
    if "actuator" in stages:
        out["actuator"] = float(np.std(actuator_residual(run)))
    if "linkage" in stages:
        out["linkage"] = float(np.sqrt(np.mean(linkage_residual(run) ** 2, axis=0)).max())
    return out
