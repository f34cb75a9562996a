"""Two actuators on the same unison rings: what unequal strokes do to the rings, and the rings to the pistons.

Each actuator, A and B, turns a bell crank of its own, and by a vertical link of its own drives each ring at a point;
the two points lie opposite each other. Ring k would turn to th_A with A alone, to th_B with B alone (`plant.linkage`,
at the strokes x_A and x_B). It comes to rest between::

    V   = 1/2 sum_k kappa (th_A,k - th_B,k)^2                    elastic energy (J)
    F_A =   dV/dx_A =   sum_k kappa th_A,k' (th_A,k - th_B,k)    load on piston A, against extension (N)
    F_B =   dV/dx_B = - sum_k kappa th_B,k' (th_A,k - th_B,k)    on piston B
    th(phi) = 1/2 (th_A + th_B) + 1/2 (th_A - th_B) cos phi      what a vane at phi sees

Symbols: kappa stiffness of a ring between its driven points (N m/rad; less where one is soft,
`plant.effects.ring_stiffness`), ' d/dx (rad/m, `plant.linkage.ring_motion`), phi angle around the ring from the point
that A drives (rad). The piston ahead is pushed back and the other pulled along.

th(phi) is exact for a ring that stays round. It turns by th and shifts sideways by e, held by its rollers and levers;
a point at phi then moves along the circumference by R th + e cos phi, R radius. At the driven points, phi = 0 and pi,
this is R th_A and R th_B. So th is their mean and e = R (th_A - th_B) / 2. Rollers and levers of the sideways stiffness
k (N/m) give kappa = k R^2 / 4. A vane a quarter around, phi = pi/2, sees the mean.

Within a tick the forces are linear in both strokes, about those at its start::

    F = F0 + K (x - x0),   K_AA = sum kappa th_A'^2,   K_AB = - sum kappa th_A' th_B',   K_BB = sum kappa th_B'^2

What is left out is kappa th'' (th_A - th_B + th' dx / 2) dx: with 1 mm between the strokes and 0.15 mm of travel in a
tick, at full speed, 7e-4 of what the travel adds, and nothing of it stays after the tick. The oil columns of compliance
C give way under the same forces (x = w - C F, w the stroke without them), so that each step solves
(1 + K C) F = F0 + K (w - x0): springs in series, stable at any stiffness.

With a valve each, the oil of each piston is its own. With one valve, both hang on its ports by lines, and the piston
with less pressure takes more of the flow::

    v_i = u g sqrt(max(0, (p_s - sign(u) p) / p_ref)) + G (p - p_i),   p = 1/2 (p_A + p_B)

Symbols: v_i speed of piston i (m/s), u spool, g flow gain (m/s), p_i = F_i / A load pressure (Pa), p that at the ports,
G conductance of the lines to one piston, as speed per pressure (m/s/Pa); what they take at equal pressures is in the
flow gain. G is bounded so that the step of 0.1 ms is stable with rings of any stiffness: G h < A C.

Limits: the ring does not bend and does not tilt out of its plane. One that stretches evenly between its points is
linear in phi instead: a vane then sees up to 0.11 (th_A - th_B) less. No mass, no damping of its own. Play acts on the
mean of both points. At equal strokes nothing of this acts, unless the links of one side are set otherwise
(`plant.effects.rigging_offset`). While one piston stands at its stop, the other does not get its oil.
Source: kinematics of a rigid body in the plane; virtual work, Lanczos, The Variational Principles of Mechanics (1970),
ch. III; stiffness of the oil, Merritt (1967), section 6-2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from plant import stem
from plant.drive import DriveState
from plant.effects import oil_compressibility, ring_stiffness
from plant.linkage import G_LE, G_LX0, G_X1, G_Y1, crank, crank_slope, ring_angle, ring_motion
from plant.parameters import GEOMETRY, POT_SHIFT, RING_STIFFNESS, VANE_COUNT
from plant.places import RING_STIFFNESS_RATIO, X
from vaneloop.base.compiled import in_place, inlined

__all__ = ["Tie", "energy", "felt", "forces", "ring_at", "shared", "tie", "unjoined", "yielding"]


class Tie(NamedTuple):
    """What the rings do to both pistons, about the strokes ``x_a``, ``x_b`` (m): loads against extension (N) there, and
    their slopes (N/m); ``k_ab`` is what a metre of B takes off the load of A, and of A off that of B.
    """

    x_a: float
    x_b: float
    f_a: float
    f_b: float
    k_a: float
    k_b: float
    k_ab: float


@inlined
def _crank(s: np.ndarray, p: np.ndarray, j: int, side: int) -> tuple[float, float]:
    """Return the direction of the crank that the actuator in lane ``side`` turns."""
    g = GEOMETRY
    return crank(s[X, side], p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])


@inlined
def _turning(s: np.ndarray, p: np.ndarray, j: int, side: int) -> float:
    """Return the slope (rad/m) of that crank."""
    g = GEOMETRY
    return crank_slope(s[X, side], p[g + G_LX0, j], p[g + G_X1, j], p[g + G_Y1, j], p[g + G_LE, j])


@in_place
def tie(s: np.ndarray, p: np.ndarray, j: int) -> Tie:
    """Return what joins the pistons in lanes ``j`` (A) and ``j`` + 1 (B) at their strokes."""
    f_a = f_b = k_a = k_b = k_ab = 0.0
    kappa = p[RING_STIFFNESS, j] * yielding(p, j)[0]
    c_a, e_a = _crank(s, p, j, j)
    c_b, e_b = _crank(s, p, j, j + 1)
    turning_a, turning_b = _turning(s, p, j, j), _turning(s, p, j, j + 1)
    for k in range(int(p[VANE_COUNT, j])):
        d, d_b = stem.prepare(p, j, k), stem.prepare(p, j + 1, k)
        theta_a, slope_a = ring_motion(turning_a, c_a, e_a, d.ax, d.ay, d.lb, d.lc, d.ld)
        theta_b, slope_b = ring_motion(turning_b, c_b, e_b, d_b.ax, d_b.ay, d_b.lb, d_b.lc, d_b.ld)
        torque = kappa * (theta_a - theta_b)
        f_a += slope_a * torque
        f_b -= slope_b * torque
        k_a += kappa * slope_a * slope_a
        k_b += kappa * slope_b * slope_b
        k_ab += kappa * slope_a * slope_b
    return Tie(s[X, j], s[X, j + 1], f_a, f_b, k_a, k_b, k_ab)


@inlined
def unjoined(z: DriveState, d: Any, load: float, dt: float) -> float:
    """Return the stroke (m) to which a piston in the state ``z`` comes in a step ``dt`` (s) without the rings' force,
    under the rest of its ``load`` (N).
    """
    compliance, drag = d.oil_compressibility_compliance, d.oil_compressibility_drag
    give = oil_compressibility.step(load, z.speed, compliance, drag, d.nominal)
    return z.x - z.give + z.speed * dt + give


@inlined
def forces(t: Tie, w_a: float, w_b: float, c_a: float, c_b: float) -> tuple[float, float]:
    """Return the rings' loads (N, against extension) on pistons that would be at ``w_a``, ``w_b`` (m) without them,
    with oil of compliance ``c_a``, ``c_b`` (m/N) behind.
    """
    d_a, d_b = w_a - t.x_a, w_b - t.x_b
    r_a = t.f_a + t.k_a * d_a - t.k_ab * d_b
    r_b = t.f_b + t.k_b * d_b - t.k_ab * d_a
    m_a, m_b, n_a, n_b = 1.0 + t.k_a * c_a, 1.0 + t.k_b * c_b, t.k_ab * c_a, t.k_ab * c_b
    per = 1.0 / (m_a * m_b - n_a * n_b)  # of a determinant of 1 or more
    return (m_b * r_a + n_b * r_b) * per, (m_a * r_b + n_a * r_a) * per


@inlined
def felt(load: float, slope: float, w: float, c: float) -> float:
    """Return the rings' load (N, against extension) on a piston beside another of known stroke. It would be at ``w``
    (m) without them, with oil of compliance ``c`` (m/N) behind; ``load`` (N) at stroke 0, and its ``slope`` (N/m).
    """
    return (load + slope * w) / (1.0 + slope * c)


@inlined
def yielding(p: np.ndarray, j: int) -> tuple[float, float, float]:
    """Return what is left of the rings' stiffness between both sides, and the shares by which their points give way
    (`plant.effects.ring_stiffness`).
    """
    return ring_stiffness.step(p[RING_STIFFNESS_RATIO, j], p[RING_STIFFNESS_RATIO, j + 1])


@inlined
def shared(theta_a: float, theta_b: float, shift: float, give_a: float, give_b: float) -> tuple[float, float]:
    """Return the angle (rad) of a ring that A alone would turn to ``theta_a`` and B to ``theta_b``, and what its
    potentiometer's place adds: ``shift`` = 1/2 cos phi of their difference. The driven points give way by the shares
    ``give_a`` and ``give_b`` of it.
    """
    between = theta_a - theta_b
    theta_a, theta_b = theta_a - give_a * between, theta_b + give_b * between
    return 0.5 * (theta_a + theta_b), shift * (theta_a - theta_b)


@inlined
def ring_at(s: np.ndarray, p: np.ndarray, j: int, k: int, theta: float) -> tuple[float, float]:
    """Return the angle (rad) of ring ``k``, which actuator A alone would turn to ``theta``, the mean of both, and what
    its potentiometer's place adds.
    """
    c, e = _crank(s, p, j, j + 1)
    d = stem.prepare(p, j + 1, k)
    _, give_a, give_b = yielding(p, j)
    return shared(theta, ring_angle(c, e, d.ax, d.ay, d.lb, d.lc, d.ld), p[POT_SHIFT, j], give_a, give_b)


@in_place
def energy(s: np.ndarray, p: np.ndarray, j: int) -> float:
    """Return the elastic energy (J) in the rings of lanes ``j`` and ``j`` + 1."""
    total = 0.0
    c_a, e_a = _crank(s, p, j, j)
    c_b, e_b = _crank(s, p, j, j + 1)
    for k in range(int(p[VANE_COUNT, j])):
        d, d_b = stem.prepare(p, j, k), stem.prepare(p, j + 1, k)
        theta_a = ring_angle(c_a, e_a, d.ax, d.ay, d.lb, d.lc, d.ld)
        theta_b = ring_angle(c_b, e_b, d_b.ax, d_b.ay, d_b.lb, d_b.lc, d_b.ld)
        total += 0.5 * p[RING_STIFFNESS, j] * yielding(p, j)[0] * (theta_a - theta_b) ** 2
    return total
