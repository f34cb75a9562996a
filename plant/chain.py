"""The nominal plant, part by part in the order of the signal flow. The same functions serve lockstep, real time and diagnosis.

State ``s`` and parameters ``p`` are float64[n, lanes]; lane ``j`` is one plant, so that many parameter sets run side by side. Units: SI.
"""

from __future__ import annotations

from plant.actuator import speed_factor, stroke_step
from plant.compiled import compiled
from plant.engine import engine_step
from plant.linkage import (
    G_AX,
    G_AY,
    G_L,
    G_LB,
    G_LC,
    G_LD,
    G_LDP,
    G_LE,
    G_LX0,
    G_X1,
    G_Y1,
    N_CRANK,
    N_PER_STAGE,
    crank,
    ring_angle,
    vane_angle,
)
from plant.parameters import (
    ACCELERATION,
    DECELERATION,
    FLOW_GAIN,
    GEOMETRY,
    LAG,
    LVDT_FACTOR,
    LVDT_STEP,
    P_REF,
    PLAY,
    POT_BIAS,
    POT_FACTOR,
    RATED_CURRENT,
    STROKE,
    VALVE_A11,
    VALVE_A12,
    VALVE_A21,
    VALVE_A22,
)
from plant.play import play_step
from plant.sensors import quantise
from plant.valve import valve_step

__all__ = ["N_STATE", "STATE", "SUBSTEPS", "TICK", "drive_step", "rotor_step", "sample_lvdt", "vane_step"]

TICK = 1e-3  # s, one servo tick
SUBSTEPS = 10  # plant steps a tick: 10 kHz

STATE = (
    "n_r",  # %, rotor speed
    "spool",  # -
    "spool_rate",  # 1/s
    "speed",  # m/s
    "x",  # m, stroke
    "x_lvdt",  # m, LVDT after its lag
    "ring_vigv",  # rad, ring angle behind its play
    "ring_vgv1",
    "ring_vgv2",
    "pot_vigv",  # rad, vane angle after the potentiometer's lag
    "pot_vgv1",
    "pot_vgv2",
)
N_STATE = len(STATE)
(N_R, SPOOL, SPOOL_RATE, SPEED, X, X_LVDT, RING, _, _, POT, _, _) = range(N_STATE)


@compiled
def rotor_step(s, p, j, n_dem):
    """Engine: one tick towards the demand ``n_dem`` (%)."""
    s[N_R, j] = engine_step(s[N_R, j], n_dem, p[LAG, j], p[ACCELERATION, j], p[DECELERATION, j], TICK)


@compiled
def drive_step(s, p, j, i_cmd, n_r, p_s, t_oil):
    """Valve, actuator and LVDT: one tick under the current ``i_cmd`` (A), at ``n_r`` (%), ``p_s`` (Pa), ``t_oil`` (degC)."""
    target = i_cmd / p[RATED_CURRENT, j]
    a11, a12, a21, a22 = p[VALVE_A11, j], p[VALVE_A12, j], p[VALVE_A21, j], p[VALVE_A22, j]
    out = p[FLOW_GAIN, j] * speed_factor(p_s, 0.0, p[P_REF, j])
    back = p[FLOW_GAIN, j] * speed_factor(p_s, 0.0, p[P_REF, j])
    u, du, v, x, y = s[SPOOL, j], s[SPOOL_RATE, j], s[SPEED, j], s[X, j], s[X_LVDT, j]
    for _ in range(SUBSTEPS):
        u, du = valve_step(u, du, target, a11, a12, a21, a22)
        v_before = v
        v = u * (out if u > 0.0 else back)
        x = stroke_step(x, v_before, v, p[STROKE, j], TICK / SUBSTEPS)
        y += p[LVDT_FACTOR, j] * (x - y)
    s[SPOOL, j], s[SPOOL_RATE, j], s[SPEED, j], s[X, j], s[X_LVDT, j] = u, du, v, x, y


@compiled
def vane_step(s, p, j, n_r, t_oil):
    """Linkage, play and stem potentiometers: one tick at the present stroke."""
    g = GEOMETRY
    c, d = crank(s[X, j], p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])
    for k in range(3):
        o = g + N_CRANK + k * N_PER_STAGE
        drive = ring_angle(c, d, p[o + G_AX, j], p[o + G_AY, j], p[o + G_LB, j], p[o + G_LC, j], p[o + G_LD, j])
        s[RING + k, j] = play_step(s[RING + k, j], drive, p[PLAY + k, j])
        vane = vane_angle(s[RING + k, j], p[o + G_LDP, j], p[o + G_L, j]) + p[POT_BIAS + k, j]
        s[POT + k, j] += p[POT_FACTOR, j] * (vane - s[POT + k, j])


@compiled
def sample_lvdt(s, p, j, noise):
    """Return the LVDT's sample (m): lagged stroke plus ``noise`` (m), in steps of the converter."""
    return quantise(s[X_LVDT, j] + noise, p[LVDT_STEP, j])
