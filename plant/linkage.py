"""Bell crank, vertical link, unison ring and lever arm: stroke in, ring angle, vane angle out.

Source: Kim & Ki, Appl. Sci. 2020, 10, 6643, equations (3) to (17), figures 2 and 3. One stage, in the plane:

                        J2 ----Lb---- J3      Le upper arm, direction th0 + th1 from J1 to J2; Lb lower arm
                      Le |             |      J2 pivot at (x1, y1) seen from J0
         J0 -----Lx---- J1             |      Lx = Lx0 + stroke, actuator length, direction th0
                                       | Lc   vertical link
                                       |
                    J5 -------Ld------ J4     J5 ring centre at (dx, dy) seen from J2, Ld ring radius at the clevis

Units and signs: m, rad; angles count anticlockwise; a longer stroke turns crank, ring and vane the positive way.
Points of the plane are complex numbers below: e = exp(i (th0 + th1)) is the direction of the upper arm from J1 to J2,
w = exp(i (th0 + th1 + th3 + th4)) that of the ring radius from J4 to J5, A = La exp(i (3 pi/2 + th6)) the place of J5
seen from J2 in the frame of (11), La^2 = dx^2 + dy^2.

Two forms of the same equations. The runtime form intersects circles with square roots; of the transcendental functions
it needs one arctangent for a ring angle, one tangent and one arcsine for a vane angle. The documentary form (`paper_*`)
follows (6) to (15) as printed, and says where the printed principal values do not suffice. Tests hold both against a
third, independent one.

No NaN comes out for finite arguments: where the linkage cannot be assembled the nearest stretched or folded position is
returned; `check_assembly` refuses such a geometry beforehand. NaN in gives NaN out.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vaneloop.base.compiled import compiled
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import MOST, VANES

__all__ = [
    "G_AX", "G_AY", "G_HYSTERESIS", "G_L", "G_LB", "G_LC", "G_LD", "G_LDP", "G_LE", "G_LX0", "G_X1", "G_Y1", "N_CRANK",
    "N_GEOMETRY", "N_PER_STAGE", "STROKE_HIGH", "STROKE_LOW", "assembly_range", "check_assembly", "clevis_axial",
    "crank", "crank_angle", "crank_slope", "paper_crank", "paper_ring", "paper_theta0", "paper_theta1", "paper_theta3",
    "paper_theta4", "paper_theta5", "paper_vane", "ring_angle", "ring_angle_of_vane", "ring_motion", "ring_tangent",
    "stage_ring_angle", "stage_vane_angle", "vane_angle", "vane_angle_table", "vane_per_ring", "vane_slope",
]  # fmt: skip

STROKE_LOW = -2e-3  # m; the linkage is used a little beyond the stops (0 and 48 mm): play and end-stop effects
STROKE_HIGH = 50e-3  # m

# Flat geometry: float64[N_CRANK + n N_PER_STAGE], SI. Four numbers of the crank, then N_PER_STAGE for each of the n
# stages at N_CRANK + k N_PER_STAGE.
G_LX0, G_X1, G_Y1, G_LE = 0, 1, 2, 3
N_CRANK = 4
G_LB = 0  # lower arm
G_LC = 1  # vertical link
G_LD = 2  # ring radius at the clevis
G_LDP = 3  # Ld', radius of the lever-arm end
G_L = 4  # lever arm
G_AX = 5  # real part of A
G_AY = 6  # imaginary part of A
G_HYSTERESIS = 7  # rad at the vane, total width
N_PER_STAGE = 8
N_GEOMETRY = N_CRANK + MOST * N_PER_STAGE  # room in the plant's parameters


# --- runtime form -----------------------------------------------------------------------------------------------------


@compiled
def crank(stroke: float, lx0: float, x1: float, y1: float, le: float) -> tuple[float, float]:
    """Direction (cos, sin) of the crank's upper arm, J1 to J2: the angle th0 + th1 of (6) and (7) without its angles.

    e = (x1 + i y1) (m + i sqrt(D^2 Le^2 - m^2)) / (D^2 Le),   D^2 = x1^2 + y1^2,   m = (D^2 + Le^2 - Lx^2) / 2

    (law of cosines at J2). The positive root is the assembly with 0 <= th1 <= pi, as the arccosine of (6) has it. All
    lengths in m.
    """
    lx = lx0 + stroke
    d2 = x1 * x1 + y1 * y1
    m = 0.5 * (d2 + le * le - lx * lx)
    r = d2 * le * le - m * m
    if r > 0.0:
        s = math.sqrt(r)
    elif r <= 0.0:  # stretched or folded
        s = 0.0
        m = math.copysign(math.sqrt(d2) * le, m)
    else:  # NaN
        s = r
    f = 1.0 / (d2 * le)
    return (x1 * m - y1 * s) * f, (x1 * s + y1 * m) * f


@compiled
def crank_angle(stroke: float, lx0: float, x1: float, y1: float, le: float) -> float:
    """Angle th0 + th1 of the crank's upper arm against the actuator's base line, rad (equations 6 and 7)."""
    c, s = crank(stroke, lx0, x1, y1, le)
    return math.atan2(s, c)


@compiled
def _ring_direction(c: float, s: float, ax: float, ay: float, lb: float, lc: float, ld: float) -> tuple[float, float]:
    """Components (cos th5, sin th5) of the ring's rotation.

    Q = A + Lb e = Lc exp(i (th0 + th1 + th3)) + Ld w closes the loop J2 J3 J4 J5. With u = (|Q|^2 + Ld^2 - Lc^2) / (2
    Ld),

    w = Q (u - i sqrt(|Q|^2 - u^2)) / |Q|^2,   exp(i th5) = -i w   since -810 deg is -90 deg.

    The minus sign before the root is the assembly with -pi <= th4 <= 0: see `paper_theta4`.
    """
    qx = ax + lb * c
    qy = ay + lb * s
    q2 = qx * qx + qy * qy
    u = 0.5 * (q2 + ld * ld - lc * lc) / ld
    r = q2 - u * u
    if r > 0.0:
        v = math.sqrt(r)
    elif r <= 0.0:  # stretched or folded
        if q2 == 0.0:
            return 1.0, 0.0
        v = 0.0
        u = math.copysign(math.sqrt(q2), u)
    else:  # NaN
        v = r
    f = 1.0 / q2
    return (qy * u - qx * v) * f, -(qx * u + qy * v) * f


@compiled
def ring_angle(c: float, s: float, ax: float, ay: float, lb: float, lc: float, ld: float) -> float:
    """Rotation th5 of the unison ring, rad, equation (15), from the crank's direction (c, s) of `crank`."""
    cos5, sin5 = _ring_direction(c, s, ax, ay, lb, lc, ld)
    return math.atan2(sin5, cos5)


@compiled
def ring_tangent(c: float, s: float, ax: float, ay: float, lb: float, lc: float, ld: float) -> float:
    """tan th5 of the unison ring: what (16) needs, without a transcendental function."""
    cos5, sin5 = _ring_direction(c, s, ax, ay, lb, lc, ld)
    return sin5 / cos5


@compiled
def vane_angle(theta5: float, ldp: float, l: float) -> float:  # noqa: E741
    """Vane angle thl = asin(Ld' tan th5 / L), rad, equation (16). th5 in rad, Ld' and L in m; held at +-pi/2 beyond the
    lever's reach.
    """
    q = ldp * math.tan(theta5) / l
    if q > 1.0:
        q = 1.0
    elif q < -1.0:
        q = -1.0
    return math.asin(q)


@compiled
def clevis_axial(theta5: float, ldp: float, l: float) -> float:  # noqa: E741
    """Axial motion of the clevis xa = L (1 - cos thl), m, equation (17); the planar model neglects it."""
    return l * (1.0 - math.cos(vane_angle(theta5, ldp, l)))


@compiled
def ring_angle_of_vane(thetal: float, ldp: float, l: float) -> float:  # noqa: E741
    """Ring rotation th5 = atan(L sin thl / Ld'), rad: the inverse of (16) for |thl| <= pi/2."""
    return math.atan(l * math.sin(thetal) / ldp)


@compiled
def vane_per_ring(theta5: float, ldp: float, l: float) -> float:  # noqa: E741
    """Slope d thl / d th5 = Ld' (1 + tan^2 th5) / (L cos thl), rad/rad: turns a width at the ring into one at
    the vane.
    """
    t = math.tan(theta5)
    q = ldp * t / l
    r = 1.0 - q * q
    if r < 1e-12:
        r = 1e-12
    return ldp * (1.0 + t * t) / (l * math.sqrt(r))


@compiled
def crank_slope(stroke: float, lx0: float, x1: float, y1: float, le: float) -> float:
    """Slope d(th0 + th1) / d stroke of the crank, rad/m (`vane_slope`); 0 where it is held stretched or folded."""
    lx = lx0 + stroke
    d2 = x1 * x1 + y1 * y1
    m = 0.5 * (d2 + le * le - lx * lx)
    r = d2 * le * le - m * m
    return 0.0 if r <= 0.0 else lx / math.sqrt(r)


@compiled
def ring_motion(
    turning: float, c: float, s: float, ax: float, ay: float, lb: float, lc: float, ld: float
) -> tuple[float, float]:
    """Rotation th5 of the ring, rad (`ring_angle`), and its slope d th5 / d stroke, rad/m (`vane_slope`), of a crank in
    the direction (c, s) that is ``turning`` by `crank_slope`; the slope is 0 where the linkage is held stretched or
    folded.
    """
    cos5, sin5 = _ring_direction(c, s, ax, ay, lb, lc, ld)
    theta = math.atan2(sin5, cos5)
    wx, wy = -sin5, cos5
    px = ax + lb * c - ld * wx
    py = ay + lb * s - ld * wy
    turn = py * wx - px * wy
    if abs(turn) < 1e-9 * ld:
        return theta, 0.0
    return theta, turning * lb * (py * c - px * s) / (ld * turn)


@compiled
def stage_ring_angle(stroke: float, g: np.ndarray, k: int) -> float:
    """Ring rotation th5 of stage k, rad, from stroke in m and the flat geometry g."""
    c, s = crank(stroke, g[G_LX0], g[G_X1], g[G_Y1], g[G_LE])
    o = N_CRANK + k * N_PER_STAGE
    return ring_angle(c, s, g[o + G_AX], g[o + G_AY], g[o + G_LB], g[o + G_LC], g[o + G_LD])


@compiled
def stage_vane_angle(stroke: float, g: np.ndarray, k: int) -> float:
    """Vane angle thl of stage k, rad, from stroke in m: no play."""
    o = N_CRANK + k * N_PER_STAGE
    return vane_angle(stage_ring_angle(stroke, g, k), g[o + G_LDP], g[o + G_L])


@compiled
def vane_slope(stroke: float, g: np.ndarray, k: int) -> float:
    """Slope d thl / d stroke of stage k, rad/m: turns a width in stroke into one at the vane and back.

    d(th0 + th1)/dLx = Lx / sqrt(D^2 Le^2 - m^2)                      from the law of cosines at J2
    d th5 = Lb Re(conj(p) i e) / Re(conj(p) i w) / Ld d(th0 + th1)   p = Q - Ld w along the link: its length does not
                                                                     change
    d thl = `vane_per_ring` d th5
    0 where the linkage is held stretched or folded.
    """
    o = N_CRANK + k * N_PER_STAGE
    turning = crank_slope(stroke, g[G_LX0], g[G_X1], g[G_Y1], g[G_LE])
    c, s = crank(stroke, g[G_LX0], g[G_X1], g[G_Y1], g[G_LE])
    ax, ay, lb, lc, ld = g[o + G_AX], g[o + G_AY], g[o + G_LB], g[o + G_LC], g[o + G_LD]
    theta, dring = ring_motion(turning, c, s, ax, ay, lb, lc, ld)
    return 0.0 if dring == 0.0 else dring * vane_per_ring(theta, g[o + G_LDP], g[o + G_L])


@compiled
def vane_angle_table(stroke: np.ndarray, g: np.ndarray, out: np.ndarray) -> None:
    """Fill out (n, stages) with the vane angles, rad, of the strokes (n), m."""
    for i in range(stroke.shape[0]):
        c, s = crank(stroke[i], g[G_LX0], g[G_X1], g[G_Y1], g[G_LE])
        for k in range(out.shape[1]):
            o = N_CRANK + k * N_PER_STAGE
            ring = ring_angle(c, s, g[o + G_AX], g[o + G_AY], g[o + G_LB], g[o + G_LC], g[o + G_LD])
            out[i, k] = vane_angle(ring, g[o + G_LDP], g[o + G_L])


# --- documentary form: equations (6) to (16) as printed ---------------------------------------------------------------


@compiled
def paper_theta1(lx: float, x1: float, y1: float, le: float) -> float:
    """Equation (6): th1 = acos((x1^2 + y1^2 - Le^2 - Lx^2) / (2 Lx Le)), rad. The printed principal value is the branch
    used.
    """
    return math.acos((x1 * x1 + y1 * y1 - le * le - lx * lx) / (2.0 * lx * le))


@compiled
def paper_theta0(lx: float, x1: float, y1: float, le: float, theta1: float) -> float:
    """Equation (7): th0 = asin((y1 Le cos th1 + Lx y1 - x1 Le sin th1) / (x1^2 + y1^2)), rad.

    The principal value holds while the actuator points within 90 deg of its base line, cos th0 > 0.
    """
    return math.asin((y1 * le * math.cos(theta1) + lx * y1 - x1 * le * math.sin(theta1)) / (x1 * x1 + y1 * y1))


@compiled
def paper_ring(dx: float, dy: float, theta6: float, theta0: float, theta1: float) -> tuple[float, float]:
    """Equations (11) and (12): ring centre (x5, y5) seen from J2 in the frame of the crank, m.

    x5 + i y5 = sqrt(dx^2 + dy^2) exp(i (3 pi/2 + th6 - th0 - th1)). As printed, J5 is straight below J2 (3 pi/2): the
    inclination of the line from J2 to J5, where dx is not 0, is a part of th6.
    """
    la = math.sqrt(dx * dx + dy * dy)
    a = 1.5 * math.pi + theta6 - theta0 - theta1
    return la * math.cos(a), la * math.sin(a)


@compiled
def paper_theta4(x5: float, y5: float, lb: float, lc: float, ld: float) -> float:
    """Equation (13): cos th4 = ((x5 + Lb)^2 + y5^2 - Ld^2 - Lc^2) / (2 Ld Lc), rad, on the branch th4 = 2 pi -
    acos(...).

    The principal value alone gives the mirrored assembly, with the clevis on the other side of the ring's centre. There
    a longer link raises the vane angle; published is that it lowers it (1.6 deg for 1 mm), so the other branch is
    meant.
    """
    b = x5 + lb
    return 2.0 * math.pi - math.acos((b * b + y5 * y5 - ld * ld - lc * lc) / (2.0 * ld * lc))


@compiled
def paper_theta3(x5: float, y5: float, lb: float, lc: float, ld: float, theta4: float) -> float:
    """Equation (14): sin th3 = (y5 Ld cos th4 + y5 Lc - (x5 + Lb) Ld sin th4) / ((x5 + Lb)^2 + y5^2), rad.

    The arcsine alone does not suffice: a link square to the lower arm has th3 = 90 deg. The linkage starts there at
    stroke 0 (VGV1 passes it at -0.2 mm), where the arcsine folds back and keeps half of the digits. The cosine from the
    same rows of (10) decides the quadrant: cos th3 = ((x5 + Lb) (Ld cos th4 + Lc) + y5 Ld sin th4) / ((x5 + Lb)^2 +
    y5^2).
    """
    b = x5 + lb
    d2 = b * b + y5 * y5
    p = ld * math.cos(theta4) + lc
    q = ld * math.sin(theta4)
    return math.atan2((y5 * p - b * q) / d2, (b * p + y5 * q) / d2)


@compiled
def paper_theta5(theta0: float, theta1: float, theta3: float, theta4: float) -> float:
    """Equation (15): th5 = -810 deg + (th0 + th1 + th3 + th4), rad, brought to [-pi, pi] by whole turns.

    With the branches above the sum is near 450 deg, one turn below the 810 deg as printed.
    """
    a = -4.5 * math.pi + (theta0 + theta1 + theta3 + theta4)
    return a - 2.0 * math.pi * math.floor(a / (2.0 * math.pi) + 0.5)


@compiled
def paper_crank(stroke: float, lx0: float, x1: float, y1: float, le: float) -> tuple[float, float]:
    """Angles (th0, th1) of actuator and upper arm, rad, by equations (7) and (6)."""
    theta1 = paper_theta1(lx0 + stroke, x1, y1, le)
    return paper_theta0(lx0 + stroke, x1, y1, le, theta1), theta1


@compiled
def paper_vane(
    stroke: float,
    lx0: float,
    x1: float,
    y1: float,
    le: float,
    dx: float,
    dy: float,
    theta6: float,
    lb: float,
    lc: float,
    ld: float,
    ldp: float,
    l: float,  # noqa: E741
) -> tuple[float, float]:
    """Angles (th5, thl) of ring and vane, rad, by equations (6) to (16) one after the other. Lengths in m."""
    theta0, theta1 = paper_crank(stroke, lx0, x1, y1, le)
    x5, y5 = paper_ring(dx, dy, theta6, theta0, theta1)
    theta4 = paper_theta4(x5, y5, lb, lc, ld)
    theta3 = paper_theta3(x5, y5, lb, lc, ld, theta4)
    theta5 = paper_theta5(theta0, theta1, theta3, theta4)
    return theta5, math.asin(ldp * math.tan(theta5) / l)


# --- assembly ---------------------------------------------------------------------------------------------------------

_OK, _CRANK, _RING, _TURN, _VANE, _FALLS = 0, 1, 2, 3, 4, 5


@compiled
def _fault(stroke: float, g: np.ndarray, k: int) -> tuple[int, float, float, float]:
    """Code of what keeps stage k from being assembled at a stroke (m), with the value and its limits: (code, value,
    low, high).
    """
    x1, y1, le = g[G_X1], g[G_Y1], g[G_LE]
    o = N_CRANK + k * N_PER_STAGE
    lx = g[G_LX0] + stroke
    d = math.sqrt(x1 * x1 + y1 * y1)
    if not abs(d - le) < lx < d + le:
        return _CRANK, lx, abs(d - le), d + le
    c, s = crank(stroke, g[G_LX0], x1, y1, le)
    qx = g[o + G_AX] + g[o + G_LB] * c
    qy = g[o + G_AY] + g[o + G_LB] * s
    q = math.sqrt(qx * qx + qy * qy)
    ld = g[o + G_LD]
    if not abs(q - ld) < g[o + G_LC] < q + ld:
        return _RING, g[o + G_LC], abs(q - ld), q + ld
    cos5, sin5 = _ring_direction(c, s, g[o + G_AX], g[o + G_AY], g[o + G_LB], g[o + G_LC], ld)
    if not cos5 > 0.0:
        return _TURN, math.atan2(sin5, cos5), -0.5 * math.pi, 0.5 * math.pi
    reach = g[o + G_LDP] * abs(sin5 / cos5)
    if not reach < g[o + G_L]:
        return _VANE, g[o + G_L], reach, math.inf
    slope = vane_slope(stroke, g, k)
    if not slope > 0.0:
        return _FALLS, slope, 0.0, math.inf
    return _OK, 0.0, 0.0, 0.0


_SAYS: dict[int, tuple[str, float, str]] = {
    _CRANK: ("actuator length lx", 1e3, "mm to meet the upper arm le"),
    _RING: ("vertical link lc", 1e3, "mm to join crank and ring"),
    _TURN: ("ring angle theta5", 180.0 / math.pi, "deg"),
    _VANE: ("lever arm l", 1e3, "mm to reach the ring"),
    _FALLS: ("slope of vane angle over stroke", 0.18 / math.pi, "deg/mm, a longer stroke must open the vane"),
}


def check_assembly(
    g: NDArray[np.float64], low: float = STROKE_LOW, high: float = STROKE_HIGH, step: float = 1e-4
) -> None:
    """Refuse a flat geometry that does not close, or whose vane angle does not rise, somewhere from low to high (m).

    Raises InputError naming stage, stroke, the quantity, its value and what is allowed there. Strokes are tried every
    ``step``.
    """
    for k, stage in enumerate(VANES[: (len(g) - N_CRANK) // N_PER_STAGE]):
        for stroke in np.linspace(low, high, max(2, int(round((high - low) / step)) + 1)):
            code, value, least, most = _fault(float(stroke), g, k)
            if code != _OK:
                what, scale, unit = _SAYS[code]
                raise InputError(
                    f"{stage} cannot be assembled at stroke {stroke * 1e3:.4g} mm: {what} (={value * scale:.6g}) "
                    f"must be in ({least * scale:.6g}, {most * scale:.6g}) {unit}"
                )


def assembly_range(g: NDArray[np.float64], k: int, start: float = 24e-3) -> tuple[float, float]:
    """Strokes (low, high), m, around ``start`` between which stage k closes and its vane angle rises with stroke.

    Raises InputError where it does not close at ``start`` itself. Searched to 0.5 m either side, to 1 nm.
    """
    check_assembly(g, start, start)
    ends: list[Any] = []
    for sign in (-1.0, 1.0):
        good = bad = start
        while abs(bad - start) < 0.5:
            bad = good + sign * 1e-3
            if _fault(bad, g, k)[0] != _OK:
                break
            good = bad
        while abs(bad - good) > 1e-9:
            mid = 0.5 * (good + bad)
            if _fault(mid, g, k)[0] == _OK:
                good = mid
            else:
                bad = mid
        ends.append(good)
    return ends[0], ends[1]
