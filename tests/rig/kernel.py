"""The machine between two servo ticks: engine, spool, two oil chambers, friction, pins, vanes, sensors. All compiled
code of the rig.

Equations, symbols and signs are in docs/rig.md. Units SI, speeds in %, temperatures in degC. State ``s`` is read by
`S`, parameters ``p`` by `P`. Slots and constants stand in this file with the code that uses them: numba's cache looks
at one file's date only.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numba import njit

TICK = 1e-3  # s, servo tick
FRAME = 10  # ticks: the ECU sends every 10 ms
LINKS = 10  # linkage steps in a tick: 0.1 ms against a contact of 0.3 ms
MOST = 8  # vane stages that the arrays have room for; a run has as many as its ring tables
PINS = 4  # pins in parallel a stage, each with its own gap
PLAYS = 4  # Preisach elements of the torque motor's hysteresis
PIN_OFFSET = np.array([-1.3416, -0.4472, 0.4472, 1.3416])  # zero mean, unit variance
BUSHING = np.array([2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3, 8e-3])  # m: half-widths after which parts of a bushing slip
MOTOR_GAP = np.array([0.4, 0.8, 1.2, 1.6])  # mean 1
X_LOW, X_HIGH, X_STEP = -1e-3, 49e-3, 1e-5  # m: the ring-angle tables run 1 mm beyond both stops in 10 um steps
X_LAST = round((X_HIGH - X_LOW) / X_STEP)
HALF_STROKE = 0.024  # m


class P(IntEnum):
    """Slots of the kernel's parameter array. ``_0`` marks the first of MOST, one a stage."""

    # engine
    engine_lag = 0  # s
    acceleration = 1  # %/s
    deceleration = 2  # %/s
    knee = 3  # - sharpness of the limits
    # valve
    i_rated = 4  # A
    spool_omega = 5  # rad/s
    spool_zeta = 6  # -
    # actuator
    flow_gain = 7  # m/s at full spool and p_ref
    p_ref = 8  # Pa
    area = 9  # m2
    mass = 10  # kg, pistons and linkage seen at the rod
    bulk = 11  # Pa
    dead_volume = 12  # m3 a chamber
    viscous = 13  # N/(m/s)
    stroke = 14  # m
    stop_stiffness = 15  # N/m
    stop_damping = 16  # N/(m/s)
    centring = 17  # 1/s: rate at which the lands' null leakage brings the mean chamber pressure to p_s/2
    bristle = 18  # m: LuGre deflection at breakaway
    # sensors
    lvdt_tau = 19  # s
    lvdt_noise = 20  # m
    lvdt_step = 21  # m
    pot_noise = 22  # rad
    pot_step = 23  # rad
    speed_noise = 24  # %
    # linkage
    contact_tau = 25  # s: damping over stiffness of the pins' contact
    spread = 26  # - spread of the four pins' gaps about their mean
    half_gap_0 = 27  # rad at the ring
    half_gap_1 = 28
    half_gap_2 = 29
    half_gap_3 = 30
    half_gap_4 = 31
    half_gap_5 = 32
    half_gap_6 = 33
    half_gap_7 = 34
    vane_ratio_0 = 35  # - Ld'/L
    vane_ratio_1 = 36
    vane_ratio_2 = 37
    vane_ratio_3 = 38
    vane_ratio_4 = 39
    vane_ratio_5 = 40
    vane_ratio_6 = 41
    vane_ratio_7 = 42
    pot_tau_0 = 43  # s
    pot_tau_1 = 44
    pot_tau_2 = 45
    pot_tau_3 = 46
    pot_tau_4 = 47
    pot_tau_5 = 48
    pot_tau_6 = 49
    pot_tau_7 = 50
    pot_bias_0 = 51  # rad
    pot_bias_1 = 52
    pot_bias_2 = 53
    pot_bias_3 = 54
    pot_bias_4 = 55
    pot_bias_5 = 56
    pot_bias_6 = 57
    pot_bias_7 = 58
    # ---- hidden effects of the library, at their neutral values
    can_delay = 59  # s
    frame_hold = 60  # s
    schedule_offset = 61  # m
    controller_gain = 62  # -
    null_bias = 63  # A
    dead_band = 64  # A half width
    valve_hysteresis = 65  # A total width
    flow_limit = 66  # m/s
    valve_lag = 67  # s
    asymmetry = 68  # -
    droop = 69  # Pa/(m/s)
    viscosity = 70  # 1/K
    coulomb = 71  # N
    stiction = 72  # N above Coulomb
    stribeck_speed = 73  # m/s
    leakage = 74  # m/s/Pa
    compliance = 75  # m/N
    aero_force = 76  # N at 100 %
    stop_shift = 77  # m
    lvdt_bias = 78  # m
    lvdt_gain = 79  # -
    lvdt_nonlinearity = 80  # m
    lvdt_lag = 81  # s
    lvdt_thermal = 82  # m/K
    gap_change_0 = 83  # rad, total width
    gap_change_1 = 84
    gap_change_2 = 85
    gap_change_3 = 86
    gap_change_4 = 87
    gap_change_5 = 88
    gap_change_6 = 89
    gap_change_7 = 90
    ring_compliance = 91  # rad at the aerodynamic load of 100 %
    friction_width_0 = 92  # rad, total
    friction_width_1 = 93
    friction_width_2 = 94
    friction_width_3 = 95
    friction_width_4 = 96
    friction_width_5 = 97
    friction_width_6 = 98
    friction_width_7 = 99
    friction_distance = 100  # rad
    wear_0 = 101  # rad/s
    wear_1 = 102
    wear_2 = 103
    wear_3 = 104
    wear_4 = 105
    wear_5 = 106
    wear_6 = 107
    wear_7 = 108
    thermal_growth_0 = 109  # rad/K
    thermal_growth_1 = 110
    thermal_growth_2 = 111
    thermal_growth_3 = 112
    thermal_growth_4 = 113
    thermal_growth_5 = 114
    thermal_growth_6 = 115
    thermal_growth_7 = 116
    eccentricity_0 = 117  # rad
    eccentricity_1 = 118
    eccentricity_2 = 119
    eccentricity_3 = 120
    eccentricity_4 = 121
    eccentricity_5 = 122
    eccentricity_6 = 123
    eccentricity_7 = 124
    eccentricity_phase = 125  # rad
    pot_gain_0 = 126  # -
    pot_gain_1 = 127
    pot_gain_2 = 128
    pot_gain_3 = 129
    pot_gain_4 = 130
    pot_gain_5 = 131
    pot_gain_6 = 132
    pot_gain_7 = 133
    # ---- hidden effects outside the library
    ripple_amplitude = 134  # m
    ripple_frequency = 135  # Hz
    vibration_amplitude = 136  # rad at resonance
    vibration_speed = 137  # % at resonance
    gap_thermal = 138  # rad/K
    area_growth = 139  # - relative area added at full stroke
    dip_depth = 140  # Pa
    dip_period = 141  # s
    cross_talk = 142  # -
    silt_time = 143  # s of rest after which the spool sticks
    silt_current = 144  # A that frees it
    creep = 145  # - share of a move that comes late
    creep_tau = 146  # s
    ring_frequency = 147  # Hz
    ring_damping = 148  # -
    track_angle = 149  # rad where the wiper's track is worn
    track_width = 150  # rad
    track_error = 151  # rad
    dither_amplitude = 152  # A
    dither_frequency = 153  # Hz
    rumble_amplitude = 154  # rad
    rumble_speed = 155  # %
    cushion = 156  # N/(m/s)^2
    lag_slope = 157  # 1/% relative change of the engine's lag with speed
    lvdt_lost_step = 158  # m: resolution left after lost bits
    snag_angle = 159  # rad of the VIGV ring where it catches
    snag_depth = 160  # rad
    t_ref = 161  # degC
    lvdt_cubic = 162  # m, at the ends of the stroke
    flow_exponent = 163  # -, 2: an orifice in series, 20: nearly a corner
    # electromechanical actuator in place of valve and pistons
    motor = 164  # 1: it has one
    motor_rated = 165  # rad/s at i_rated
    motor_gain = 166  # A s/rad of the speed loop
    motor_time = 167  # s, its integral time
    motor_peak = 168  # A
    motor_band = 169  # rad/s of the current loop
    motor_torque = 170  # N m/A
    motor_ohm = 171  # Ohm
    motor_henry = 172  # H
    motor_inertia = 173  # kg m2, rotor and gear
    motor_viscous = 174  # N m s/rad
    screw_r = 175  # m/rad
    screw_loss = 176  # share of the load that friction takes
    screw_friction = 177  # N at the rod
    screw_lead = 178  # m
    screw_stiffness = 179  # N/m of screw and bearings
    screw_damping = 180  # N/(m/s)
    bus_voltage = 181  # V
    # ---- and its hidden effects
    amp_offset = 182  # A
    amp_dead_band = 183  # A half width
    amp_lag = 184  # s
    tacho_drift = 185  # 1/K
    torque_factor = 186  # -
    extra_friction = 187  # N at the rod
    motor_play = 188  # m, total
    pitch_error = 189  # m
    pitch_phase = 190  # rad
    rod_friction = 191  # N, of the vanes' stems and the linkage
    # ---- more hidden effects outside the library
    spring = 192  # N/m, towards mid-stroke
    null_thermal = 193  # A/K
    null_pressure = 194  # A/Pa
    lvdt_pressure = 195  # m/Pa
    rise_slope = 196  # 1/% relative change of the acceleration limit with speed
    gain_thermal = 197  # 1/K of the controller's current
    schedule_bend = 198  # m at 75 % speed
    bushing = 199  # m of the stroke that the crank's bushing takes when all of it has slipped


N_P = len(P)


class S(IntEnum):
    """Slots of the state array. ``_0`` marks the first of several."""

    n = 0  # % rotor speed
    u = 1  # - spool
    w = 2  # 1/s spool speed
    i_lagged = 3  # A
    i_valve = 4  # A after the torque motor
    p1 = 5  # Pa, extends
    p2 = 6  # Pa, retracts
    p_valve = 7  # Pa supply at the valve
    x = 8  # m
    v = 9  # m/s
    z = 10  # m LuGre bristle
    work = 11  # J taken by friction
    x_sensor = 12  # m
    x_sensor_2 = 13  # m behind the extra lag
    rest = 14  # s since the piston last moved
    stuck_at = 15  # A at which the silted spool stands
    motor_0 = 16  # A, PLAYS outputs
    pin_0 = 20  # rad, MOST x PINS
    ring_0 = 52  # rad
    ring_speed_0 = 60  # rad/s
    ring_in_0 = 68  # rad
    bristle_0 = 76  # - linkage friction
    creep_0 = 84  # rad
    vane_0 = 92  # rad
    pot_0 = 100  # rad
    silted = 108
    friction = 109  # N
    i_motor = 110  # A
    volt_integral = 111  # V of the current loop
    speed_integral = 112  # A of the speed loop
    turn = 113  # rad of the motor
    turn_speed = 114  # rad/s
    turn_bristle = 115  # rad, LuGre deflection of the motor's friction
    demanded = 116  # A behind the amplifier's lag
    bushing_0 = 117  # m, as many as `BUSHING` has widths


N_S = 123


@njit(cache=True, error_model="numpy")
def clip(v, low, high):
    """Return ``v`` within [low, high]."""
    return min(max(v, low), high)


@njit(cache=True, error_model="numpy")
def dead_zone(v, half):
    """Return how far ``v`` lies outside +-half."""
    return v - clip(v, -half, half)


@njit(cache=True, error_model="numpy")
def approach(tau, h):
    """Return the share of the way a lag ``tau`` goes in ``h``."""
    if tau <= 0.0:
        return 1.0
    return 1.0 - math.exp(-h / tau)


@njit(cache=True, error_model="numpy")
def orifice(dp):
    """Signed square root of a pressure drop (Pa), laminar below about 0.2 MPa: sqrt(dp) for dp >> 0.2 MPa."""
    return dp / math.sqrt(math.sqrt(dp * dp + 4e10))


@njit(cache=True, error_model="numpy")
def acceleration(e, p, n):
    """Rotor acceleration (%/s) for the speed error ``e``: the wanted rate, bent smoothly into the limit."""
    rate = e / (p[P.engine_lag] * (1.0 + p[P.lag_slope] * (n - 70.0)))
    limit = p[P.acceleration] * (1.0 + p[P.rise_slope] * (n - 70.0)) if rate > 0.0 else p[P.deceleration]
    return rate / (1.0 + (abs(rate) / limit) ** p[P.knee]) ** (1.0 / p[P.knee])


@njit(cache=True, error_model="numpy")
def engine(s, p, n_dem):
    """Rotor speed over one tick (Heun)."""
    n = s[S.n]
    a = acceleration(n_dem - n, p, n)
    b = acceleration(n_dem - n - TICK * a, p, n)
    s[S.n] = n + 0.5 * TICK * (a + b)


@njit(cache=True, error_model="numpy")
def torque_motor(s, p, i, t, p_s, t_oil):
    """Current that moves the spool: null bias and what shifts it, dither, magnetic hysteresis (Preisach: plays in
    parallel), silt after long rest.
    """
    i = i + p[P.null_bias] + p[P.null_thermal] * (t_oil - p[P.t_ref]) + p[P.null_pressure] * (p_s - p[P.p_ref])
    if p[P.dither_amplitude] != 0.0:
        i += p[P.dither_amplitude] * math.sin(2.0 * math.pi * p[P.dither_frequency] * t)
    if p[P.valve_hysteresis] > 0.0:
        total = 0.0
        for k in range(PLAYS):
            half = 0.5 * p[P.valve_hysteresis] * MOTOR_GAP[k]
            s[S.motor_0 + k] = clip(s[S.motor_0 + k], i - half, i + half)
            total += s[S.motor_0 + k]
        i = total / PLAYS
    if p[P.silt_current] > 0.0:
        if abs(s[S.v]) < 5e-4:
            s[S.rest] += TICK
        elif s[S.silted] == 0.0:
            s[S.rest] = 0.0
        if s[S.silted] == 0.0 and s[S.rest] > p[P.silt_time]:
            s[S.silted] = 1.0
            s[S.stuck_at] = i
        if s[S.silted] == 1.0:
            if abs(i - s[S.stuck_at]) > p[P.silt_current]:
                s[S.silted] = 0.0
                s[S.rest] = 0.0
            else:
                i = s[S.stuck_at]
    s[S.i_valve] = i


@njit(cache=True, error_model="numpy")
def hydraulics(s, p, p_s, t_oil, n, h, steps):
    """Spool, chambers and piston over ``steps`` steps of ``h`` (s).

    Spool by Heun; pressures, then speed, then stroke (symplectic order), friction's bristle and viscous part
    implicitly.
    """
    u, w, i_lagged = s[S.u], s[S.w], s[S.i_lagged]
    p1, p2, p_valve = s[S.p1], s[S.p2], s[S.p_valve]
    x, v, z, work = s[S.x], s[S.v], s[S.z], s[S.work]
    xs, xs2 = s[S.x_sensor], s[S.x_sensor_2]

    i = s[S.i_valve]
    lag_share = approach(p[P.valve_lag], h)
    om2 = p[P.spool_omega] * p[P.spool_omega]
    damp = 2.0 * p[P.spool_zeta] * p[P.spool_omega]
    i_rated = p[P.i_rated]
    overlap = p[P.dead_band] / i_rated
    area0, mass = p[P.area], p[P.mass]
    gain = p[P.flow_gain] * area0 / math.sqrt(0.5 * p[P.p_ref])
    gain *= 1.0 + p[P.viscosity] * (t_oil - p[P.t_ref])
    k_in, k_out = gain / math.sqrt(p[P.asymmetry]), gain * math.sqrt(p[P.asymmetry])
    stroke = p[P.stroke]
    # a hidden compliance (m/N) adds to the oil's own: V/(4 beta A^2) at mid stroke
    v_mid = p[P.dead_volume] + area0 * 0.5 * stroke
    own = 0.5 * v_mid / (p[P.bulk] * area0 * area0)
    bulk = p[P.bulk] * own / (own + p[P.compliance])
    force = p[P.aero_force] * (n * 0.01) ** 2
    f_c, f_x = p[P.coulomb], p[P.stiction]
    rough = f_c + f_x > 0.0
    sigma0 = (f_c + f_x) / p[P.bristle]
    sigma1 = 0.5 * math.sqrt(sigma0 * mass) if rough else 0.0
    low = max(0.0, p[P.stop_shift])
    high = stroke + min(0.0, p[P.stop_shift])
    droop_share = approach(2e-3, h)
    lvdt_share = approach(p[P.lvdt_tau], h)
    lvdt_share_2 = approach(p[P.lvdt_lag], h)
    centring = p[P.centring]
    friction = 0.0

    for _ in range(steps):
        i_lagged += lag_share * (i - i_lagged)
        target = i_lagged / i_rated
        a0 = om2 * (target - u) - damp * w
        u1, w1 = u + h * w, w + h * a0
        a1 = om2 * (target - u1) - damp * w1
        u, w = u + 0.5 * h * (w + w1), w + 0.5 * h * (a0 + a1)
        if u > 1.0:
            u, w = 1.0, min(w, 0.0)
        elif u < -1.0:
            u, w = -1.0, max(w, 0.0)

        opening = dead_zone(u, overlap)
        if opening >= 0.0:
            q1 = k_out * opening * orifice(p_valve - p1)
            q2 = k_out * opening * orifice(p2)
        else:
            q1 = k_in * opening * orifice(p1)
            q2 = k_in * opening * orifice(p_valve - p2)
        if p[P.flow_limit] < 1e9:
            ratio = 0.5 * abs(q1 + q2) / (area0 * p[P.flow_limit])
            share = (1.0 + ratio ** p[P.flow_exponent]) ** (-1.0 / p[P.flow_exponent])
            q1, q2 = q1 * share, q2 * share
        p_valve += droop_share * (p_s - p[P.droop] * 0.5 * abs(q1 + q2) / area0 - p_valve)

        area = area0
        if p[P.area_growth] != 0.0:
            near = clip((x - 0.030) / 0.018, 0.0, 1.0)
            area = area0 * (1.0 + p[P.area_growth] * near * near)
        leak = p[P.leakage] * area0 * (p1 - p2)
        v1 = p[P.dead_volume] + area0 * clip(x, 0.0, stroke)
        v2 = p[P.dead_volume] + area0 * clip(stroke - x, 0.0, stroke)
        centre = centring * (0.5 * p_valve - 0.5 * (p1 + p2))
        p1 += h * (bulk / v1 * (q1 - area * v - leak) + centre)
        p2 += h * (bulk / v2 * (area * v - q2 + leak) + centre)
        # no chamber falls below vapour pressure or rises above the relief valve
        p1 = clip(p1, 0.0, 4e7)
        p2 = clip(p2, 0.0, 4e7)

        f = area * (p1 - p2) - force - p[P.spring] * (x - 0.5 * stroke)
        b = p[P.viscous] + p[P.cushion] * abs(v)
        if x > high:
            f -= p[P.stop_stiffness] * (x - high)
            b += p[P.stop_damping]
        elif x < low:
            f += p[P.stop_stiffness] * (low - x)
            b += p[P.stop_damping]
        if rough:
            level = f_c + f_x * math.exp(-((v / p[P.stribeck_speed]) ** 2)) + 1e-3
            rate = sigma0 * abs(v) / level
            # z' = v - rate z, solved exactly over the step; its mean speed gives the bristle's damping
            share = rate * h
            decay = math.exp(-share)
            gain_z = h * (1.0 - 0.5 * share) if share < 1e-6 else (1.0 - decay) / rate
            z_new = z * decay + v * gain_z
            friction = sigma0 * z_new + sigma1 * (z_new - z) / h
            z = z_new
            f -= friction
        v_new = (v + h * f / mass) / (1.0 + h * b / mass)
        if rough:
            work += h * friction * 0.5 * (v + v_new)
        v = v_new
        x += h * v
        xs += lvdt_share * (x - 0.5 * h * v - xs)
        xs2 += lvdt_share_2 * (xs - xs2)

    s[S.u], s[S.w], s[S.i_lagged] = u, w, i_lagged
    s[S.p1], s[S.p2], s[S.p_valve] = p1, p2, p_valve
    s[S.x], s[S.v], s[S.z], s[S.work] = x, v, z, work
    s[S.x_sensor], s[S.x_sensor_2] = xs, xs2
    s[S.friction] = friction


@njit(cache=True, error_model="numpy")
def servo_motor(s, p, i, t_oil, n, h, steps):
    """Amplifier, motor, screw and rod over ``steps`` steps of ``h`` (s).

    The winding has its inductance and a PI current loop that sets the voltage; motor and rod are two masses on the
    screw's spring, with the play between them; both rub (LuGre at the motor); the stops are springs with dampers.
    Currents implicitly, then speeds, then ways (symplectic order).
    """
    lag_share = approach(p[P.amp_lag], h)
    rated = p[P.motor_rated] * (1.0 + p[P.tacho_drift] * (t_oil - p[P.t_ref]))
    torque = p[P.motor_torque] * p[P.torque_factor]
    ohm, henry, band = p[P.motor_ohm], p[P.motor_henry], p[P.motor_band]
    r, mass, inertia = p[P.screw_r], p[P.mass], p[P.motor_inertia]
    stiff, damping = p[P.screw_stiffness], p[P.screw_damping]
    force = p[P.aero_force] * (n * 0.01) ** 2
    level = r * (p[P.screw_friction] + p[P.extra_friction] + abs(force) * p[P.screw_loss])
    sigma0 = level / 2e-3  # breaks away after 2 mrad of the motor, 0.8 um of the rod
    sigma1 = 0.5 * math.sqrt(sigma0 * inertia)
    half = 0.5 * p[P.motor_play]
    k = 2.0 * math.pi / p[P.screw_lead]
    low, high = max(0.0, p[P.stop_shift]), p[P.stroke] + min(0.0, p[P.stop_shift])
    lvdt_share, lvdt_share_2 = approach(p[P.lvdt_tau], h), approach(p[P.lvdt_lag], h)
    a, volt, whole = s[S.i_motor], s[S.volt_integral], s[S.speed_integral]
    turn, w, z = s[S.turn], s[S.turn_speed], s[S.turn_bristle]
    x, v, xs, xs2 = s[S.x], s[S.v], s[S.x_sensor], s[S.x_sensor_2]
    demanded = s[S.demanded]
    for _ in range(steps):
        demanded += lag_share * (i + p[P.amp_offset] - demanded)
        target = rated * dead_zone(demanded, p[P.amp_dead_band]) / p[P.i_rated]
        # speed loop: its integral is wound back by what the limit cuts off
        wanted = p[P.motor_gain] * (target - w) + whole
        asked = clip(wanted, -p[P.motor_peak], p[P.motor_peak])
        whole += h * p[P.motor_gain] / p[P.motor_time] * (target - w) + (asked - wanted) * h / 5e-3
        # current loop: PI whose zero is the winding's pole; the bus limits its voltage
        want_u = band * henry * (asked - a) + volt + torque * w
        u = clip(want_u, -p[P.bus_voltage], p[P.bus_voltage])
        volt += h * band * ohm * (asked - a) + (u - want_u) * 0.1
        a = (a + h * (u - torque * w) / henry) / (1.0 + h * ohm / henry)
        # the screw's way for the motor's turn, and the spring between nut and rod
        way = r * turn
        nut = way + p[P.pitch_error] * math.sin(k * way + p[P.pitch_phase])
        lead = r * (1.0 + k * p[P.pitch_error] * math.cos(k * way + p[P.pitch_phase]))
        bent = dead_zone(nut - x, half)
        pull = stiff * bent + damping * (lead * w - v) if bent != 0.0 or half == 0.0 else 0.0
        rate = sigma0 * abs(w) / (level + 1e-6)
        share = rate * h
        decay = math.exp(-share)
        gain_z = h * (1.0 - 0.5 * share) if share < 1e-6 else (1.0 - decay) / rate
        z_new = z * decay + w * gain_z
        rub = sigma0 * z_new + sigma1 * (z_new - z) / h
        z = z_new
        w = (w + h / inertia * (torque * a - lead * pull - rub)) / (1.0 + h / inertia * p[P.motor_viscous])
        # the vanes' stems rub, below 0.1 mm/s as a viscous drag: they hold the rod while the motor crosses the play
        f, b = pull - force, p[P.rod_friction] / max(abs(v), 1e-4)
        if x > high:
            f -= p[P.stop_stiffness] * (x - high)
            b += p[P.stop_damping]
        elif x < low:
            f += p[P.stop_stiffness] * (low - x)
            b += p[P.stop_damping]
        v = (v + h * f / mass) / (1.0 + h * b / mass)
        turn += h * w
        x += h * v
        xs += lvdt_share * (x - 0.5 * h * v - xs)
        xs2 += lvdt_share_2 * (xs - xs2)
    s[S.i_motor], s[S.volt_integral], s[S.speed_integral] = a, volt, whole
    s[S.turn], s[S.turn_speed], s[S.turn_bristle] = turn, w, z
    s[S.x], s[S.v], s[S.x_sensor], s[S.x_sensor_2] = x, v, xs, xs2
    s[S.demanded] = demanded


@njit(cache=True, error_model="numpy")
def linkage(s, p, ring_table, n, t_oil, t, h):
    """Rings, vanes and potentiometers over one step ``h`` (s): kinematics, then what bends or loosens the way to the
    vane.
    """
    stroke = s[S.x]
    for j in range(len(BUSHING)):
        s[S.bushing_0 + j] += dead_zone(s[S.x] - s[S.bushing_0 + j], BUSHING[j])
        stroke -= p[P.bushing] / len(BUSHING) * (s[S.x] - s[S.bushing_0 + j]) / BUSHING[j]
    place = clip((stroke - X_LOW) / X_STEP, 0.0, X_LAST - 1e-6)
    cell = int(place)
    part = place - cell
    load = (n * 0.01) ** 2
    warm = t_oil - p[P.t_ref]
    contact = approach(p[P.contact_tau], h)
    for k in range(ring_table.shape[0]):
        ring_in = ring_table[k, cell] + part * (ring_table[k, cell + 1] - ring_table[k, cell])
        if p[P.eccentricity_0 + k] != 0.0:
            ring_in += p[P.eccentricity_0 + k] * math.sin(ring_in + p[P.eccentricity_phase])
        ring_in += p[P.thermal_growth_0 + k] * warm - p[P.ring_compliance] * load
        if k == 0 and p[P.snag_depth] != 0.0:
            d = (ring_in - p[P.snag_angle]) / (0.5 * math.pi / 180.0)
            ring_in += p[P.snag_depth] * d * math.exp(0.5 - 0.5 * d * d)

        # lost motion: pins in parallel, each with its own gap and a stiff, damped contact
        half = p[P.half_gap_0 + k] + 0.5 * (
            p[P.gap_change_0 + k] + p[P.wear_0 + k] * max(t, 0.0) + p[P.gap_thermal] * warm
        )
        half = max(half, 0.0)
        ring = 0.0
        for j in range(PINS):
            slot = S.pin_0 + k * PINS + j
            s[slot] += contact * dead_zone(ring_in - s[slot], half * (1.0 + p[P.spread] * PIN_OFFSET[j]))
            ring += s[slot]
        ring /= PINS

        # smooth friction in the joints (Dahl's bristle, normalised to +-1): it lags behind the drive
        if p[P.friction_width_0 + k] > 0.0:
            moved = (ring - s[S.ring_in_0 + k]) / p[P.friction_distance]
            y = s[S.bristle_0 + k]
            sign = 1.0 if moved >= 0.0 else -1.0
            s[S.bristle_0 + k] = sign + (y - sign) * math.exp(-abs(moved))
            s[S.ring_in_0 + k] = ring
            ring -= 0.5 * p[P.friction_width_0 + k] * s[S.bristle_0 + k]
        else:
            s[S.ring_in_0 + k] = ring

        if p[P.creep] != 0.0:
            s[S.creep_0 + k] += approach(p[P.creep_tau], h) * (ring - s[S.creep_0 + k])
            ring -= p[P.creep] * (ring - s[S.creep_0 + k])
        else:
            s[S.creep_0 + k] = ring

        if p[P.ring_frequency] > 0.0:
            omega = 2.0 * math.pi * p[P.ring_frequency]
            a = omega * omega * (ring - s[S.ring_0 + k]) - 2.0 * p[P.ring_damping] * omega * s[S.ring_speed_0 + k]
            s[S.ring_speed_0 + k] += h * a
            s[S.ring_0 + k] += h * s[S.ring_speed_0 + k]
        else:
            s[S.ring_0 + k] = ring

        vane = math.asin(clip(p[P.vane_ratio_0 + k] * math.tan(s[S.ring_0 + k]), -1.0, 1.0))
        if p[P.vibration_amplitude] != 0.0:
            d = (n - p[P.vibration_speed]) / 3.0
            vane += p[P.vibration_amplitude] / (1.0 + d * d) * math.sin(2.0 * math.pi * 0.37 * n * t + k)
        if p[P.rumble_amplitude] != 0.0:
            d = (n - p[P.rumble_speed]) / 4.0
            shake = math.sin(2.0 * math.pi * 1.9 * t) + math.sin(2.0 * math.pi * 3.1 * t + k)
            vane += p[P.rumble_amplitude] * math.exp(-0.5 * d * d) * shake
        s[S.vane_0 + k] = vane
        s[S.pot_0 + k] += approach(p[P.pot_tau_0 + k], h) * (vane - s[S.pot_0 + k])


@njit(cache=True, error_model="numpy")
def advance(s, p, ring_table, i_cmd, n_dem, p_s, t_oil, t, steps):
    """Move the machine from ``t`` to ``t`` + 1 ms under a constant current, in ``steps`` hydraulic steps (a multiple of
    LINKS).
    """
    torque_motor(s, p, i_cmd, t, p_s, t_oil)
    if p[P.dip_depth] != 0.0:
        phase = (t / p[P.dip_period]) % 1.0
        if phase < 0.15:
            p_s -= p[P.dip_depth] * math.sin(math.pi * phase / 0.15)
    n = s[S.n]
    h = TICK / steps
    each = steps // LINKS
    for k in range(LINKS):
        if p[P.motor] != 0.0:
            servo_motor(s, p, i_cmd, t_oil, n, h, each)
        else:
            hydraulics(s, p, p_s, t_oil, n, h, each)
        linkage(s, p, ring_table, n, t_oil, t + (k + 1) * TICK / LINKS, TICK / LINKS)
    engine(s, p, n_dem)


@njit(cache=True, error_model="numpy")
def read_lvdt(s, p, t, t_oil, noise):
    """Stroke as the LVDT gives it at time ``t`` (m); ``noise`` is a standard normal number."""
    x = s[S.x_sensor_2]
    y = x * p[P.lvdt_gain] + p[P.lvdt_bias] + p[P.lvdt_thermal] * (t_oil - p[P.t_ref])
    y += p[P.lvdt_pressure] * (s[S.p_valve] - p[P.p_ref])
    if p[P.lvdt_nonlinearity] != 0.0:
        y += p[P.lvdt_nonlinearity] * math.sin(math.pi * (x - HALF_STROKE) / HALF_STROKE)
    if p[P.lvdt_cubic] != 0.0:
        part = (x - HALF_STROKE) / HALF_STROKE
        y += p[P.lvdt_cubic] * (part**3 - 0.6 * part)
    if p[P.ripple_amplitude] != 0.0:
        y += p[P.ripple_amplitude] * math.sin(2.0 * math.pi * p[P.ripple_frequency] * t)
    y += p[P.lvdt_noise] * noise
    step = max(p[P.lvdt_step], p[P.lvdt_lost_step])
    return math.floor(y / step + 0.5) * step


@njit(cache=True, error_model="numpy")
def read_pot(s, p, k, noise):
    """Vane angle of stage ``k`` as its potentiometer gives it (rad); ``noise`` is a standard normal number."""
    angle = s[S.pot_0 + k]
    y = angle * p[P.pot_gain_0 + k] + p[P.pot_bias_0 + k]
    if k == 0:
        y += p[P.cross_talk] * s[S.pot_0 + 1]
        if p[P.track_error] != 0.0:
            d = (angle - p[P.track_angle]) / (0.5 * p[P.track_width])
            y += p[P.track_error] * math.exp(-(d**4))
    y += p[P.pot_noise] * noise
    return math.floor(y / p[P.pot_step] + 0.5) * p[P.pot_step]


@njit(cache=True, error_model="numpy")
def start(s, p, ring_table, x, n, p_s):
    """Set the state to rest at stroke ``x`` (m) and speed ``n`` (%), pins in the middle of their gaps."""
    s[:] = 0.0
    s[S.n] = n
    s[S.x] = s[S.x_sensor] = s[S.x_sensor_2] = x
    s[S.bushing_0 : S.bushing_0 + len(BUSHING)] = x
    s[S.p1] = s[S.p2] = 0.5 * p_s
    s[S.p_valve] = p_s
    if p[P.motor] != 0.0:
        s[S.turn] = x / p[P.screw_r]
    cell = int(clip((x - X_LOW) / X_STEP, 0.0, X_LAST - 1.0))
    for k in range(ring_table.shape[0]):
        ring = ring_table[k, cell]
        for j in range(PINS):
            s[S.pin_0 + k * PINS + j] = ring
        s[S.ring_0 + k] = s[S.ring_in_0 + k] = s[S.creep_0 + k] = ring
        vane = math.asin(clip(p[P.vane_ratio_0 + k] * math.tan(ring), -1.0, 1.0))
        s[S.vane_0 + k] = s[S.pot_0 + k] = vane


# ---- rows of the log and of the truth record -------------------------------------------------------------------------
_ONES = ("x", "v", "u", "p1", "p2", "p_valve", "n", "i_valve", "friction", "work")
ONES_SLOTS = np.array([S[name] for name in _ONES])


def log_names(vanes):
    """Columns of the log of a machine with these stages."""
    return ("t", "n_dem", "n_r", "x_dem", "x_lvdt", "i_cmd", "p_s", "t_oil", *vanes, "state")


def truth_names(stages):
    """Columns of the truth record of a machine with so many stages."""
    return (*_ONES, *(f"ring_{k}" for k in range(stages)), *(f"vane_{k}" for k in range(stages)))


@njit(cache=True, error_model="numpy")
def ecu_frame(k, warm, p):
    """Which ECU frame the controller has at tick ``k``: the newest that has arrived, or the one whose content is held
    (from t = 0 on).
    """
    t = (k - warm) * TICK - p[P.can_delay]
    period = max(FRAME * TICK, p[P.frame_hold])
    held = math.floor((t + 1e-6) / period) * period
    f = int(math.floor((held + 1e-6) / (FRAME * TICK))) + warm // FRAME
    return max(f, 0)


@njit(cache=True, error_model="numpy")
def before_tick(k, warm, s, p, frames, speed_noise, lvdt_noise, n_dem, t_oil, view):
    """Sense at tick ``k``: fill ``view`` (n_dem, n_r, x_lvdt, fresh, x_lvdt as logged, mode request) with what the
    controller sees.

    ``frames`` has a row every 10 ms: n_dem and n_r (written here), the mode asked for, and the newest frame that the
    controller hears then.
    """
    f = k // FRAME
    if k % FRAME == 0:
        frames[f, 0] = math.floor(n_dem[f] / 0.002 + 0.5) * 0.002
        frames[f, 1] = math.floor((s[S.n] + p[P.speed_noise] * speed_noise[f]) / 0.002 + 0.5) * 0.002
    seen = int(frames[min(ecu_frame(k, warm, p), f), 3])
    x = read_lvdt(s, p, (k - warm) * TICK, t_oil[f], lvdt_noise[k])
    view[0] = frames[seen, 0]
    view[1] = frames[seen, 1]
    # a shifted stroke table, as seen from outside the controller: the servo works towards x_dem + offset
    view[2] = x - schedule_error(p, frames[seen, 1])
    # frames go on arriving every 10 ms, whatever they hold
    late = int(math.floor(p[P.can_delay] / TICK + 0.5))
    sent = max(k - late, 0) // FRAME
    view[3] = 1.0 if (k - late) % FRAME == 0 and frames[sent, 3] == sent else 0.0
    view[4] = x
    view[5] = frames[seen, 2]


@njit(cache=True, error_model="numpy")
def schedule_error(p, n):
    """By how much (m) the stroke table is off at the speed ``n`` (%): a shift, and a bend round 75 %."""
    d = (n - 75.0) / 8.0
    return p[P.schedule_offset] + p[P.schedule_bend] * math.exp(-d * d)


@njit(cache=True, error_model="numpy")
def current(i, p, limit, t_oil):
    """Current that leaves the controller: its own, or changed by an error of its gain."""
    gain = p[P.controller_gain] * (1.0 + p[P.gain_thermal] * (t_oil - p[P.t_ref]))
    if gain == 1.0:
        return i
    return clip(i * gain, -limit, limit)


@njit(cache=True, error_model="numpy")
def write_row(row, k, warm, s, p, frames, view, x_dem, mode, i_mean, p_s, t_oil, pot_noise, log, truth):
    """One row of the log, in border units, at the resolution of the bus."""
    f = k // FRAME
    log[row, 0] = (k - warm) * TICK
    log[row, 1] = frames[f, 0]
    log[row, 2] = frames[f, 1]
    log[row, 3] = math.floor((x_dem + schedule_error(p, view[1])) * 1e6 + 0.5) * 1e-3
    log[row, 4] = math.floor(view[4] * 1e6 + 0.5) * 1e-3
    log[row, 5] = math.floor(i_mean * 1e3 / 0.002 + 0.5) * 0.002
    log[row, 6] = math.floor(p_s * 1e-3 + 0.5) * 1e-3
    log[row, 7] = math.floor(t_oil * 100.0 + 0.5) * 0.01
    stages = pot_noise.shape[1]
    for j in range(stages):
        log[row, 8 + j] = math.floor(read_pot(s, p, j, pot_noise[row, j]) * (180.0 / math.pi) / 0.002 + 0.5) * 0.002
    log[row, 8 + stages] = mode
    ones = len(ONES_SLOTS)
    for j in range(ones):
        truth[row, j] = s[ONES_SLOTS[j]]
    for j in range(stages):
        truth[row, ones + j] = s[S.ring_0 + j]
        truth[row, ones + stages + j] = s[S.vane_0 + j]


@njit(error_model="numpy")
def run_compiled(
    tick,
    inputs,
    state,
    calibration,
    slots,
    onset,
    par,
    tables,
    s,
    warm,
    limit,
    through,
    every,
    steps,
    n_dem,
    p_s,
    t_oil,
    speed_noise,
    lvdt_noise,
    pot_noise,
    frames,
    log,
    truth,
):
    """The whole run with a compiled controller ``tick(inputs, state, calibration)``; ``slots`` says where its signals
    are.
    """
    view = np.zeros(6)
    total, count, row = 0.0, 0, 0
    segment = 0
    n_ticks = len(lvdt_noise)
    for k in range(n_ticks):
        while segment + 1 < len(onset) and k >= onset[segment + 1]:
            segment += 1
        p = par[segment]
        f = k // FRAME
        before_tick(k, warm, s, p, frames, speed_noise, lvdt_noise, n_dem, t_oil, view)
        inputs[slots[0]] = view[0]
        inputs[slots[1]] = view[1]
        inputs[slots[2]] = view[2]
        inputs[slots[3]] = view[3]
        if slots[8] >= 0:
            inputs[slots[8]] = view[5]
        if slots[7] >= 0:
            sample = min(
                max((k - warm) // every, 0), len(pot_noise) - 1
            )  # one number for all ticks of a row: noisier than a real one
            for j in range(pot_noise.shape[1]):
                inputs[slots[7] + j] = read_pot(s, p, j, pot_noise[sample, j])
        tick(inputs, state, calibration)
        i = current(state[slots[4]], p, limit, t_oil[f])
        if k == warm:
            total, count = 0.0, 0
        if through:
            total += i
            count += 1
        if k >= warm and (k - warm) % every == 0:
            write_row(
                row,
                k,
                warm,
                s,
                p,
                frames,
                view,
                state[slots[5]],
                state[slots[6]],
                total / count if count > 0 else i,
                p_s[f],
                t_oil[f],
                pot_noise,
                log,
                truth,
            )
            row += 1
            total, count = 0.0, 0
        if not through:
            total += i
            count += 1
        advance(s, p, tables[segment], i, frames[f, 0], p_s[f], t_oil[f], (k - warm) * TICK, steps)
    return row
