"""The mechanism in space, and what clearance in its joints does to the vane angle.

The planar model neglects that the lever arms pull the ring along the engine's axis while it turns, equation (17). Here
the loop is closed in space by Newton's method on its constraint equations, in the plane's x, y and the engine's axis z
(m), for one stage:

    |J1 - J0| = Lx + g1             J1 = J2 + s2 + R(alpha) a1     actuator; g1 its clearance taken up, + in tension
    |J4 - J3| = Lc + g3             J3 = J2 + s2 + R(alpha) a3     vertical link; g3 likewise
                                    J4 = J5 + s5 + R(theta5) a4 + z e_z
    L sin thl = Ld' tan theta5      z = L (1 - cos thl)            lever arms, equations (16) and (17)

s2 and s5 are the places of crank and ring inside their clearance. With all of them zero this is the mechanism of the
paper's multibody model; `vaneloop.design.multibody` solves the same joints with a general multibody library.

A ring hangs on two such chains, left and right, and each link takes one of its six freedoms: 6 (4 - 1) - 3 * 4 = 6 by
equation (1), less two links' idle rotations, leaves 4. The second chain is taken for the first turned by 180 deg about
the engine's axis, so that two equal strokes close exactly. What remains: a shift of the ring across its links (its
centre wanders), one along the engine's axis, two tilts.

Under load each joint rests on the side that carries the load. The vanes resist motion, so the load turns round with it
and every joint crosses its clearance: that is the hysteresis. Between the two the ring stays where friction holds it:
the play operator (`plant.play`).
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, fields, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from plant.geometry import DEG, MM, Geometry
from plant.linkage import G_LE, G_LX0, G_X1, G_Y1, crank, stage_ring_angle
from vaneloop.base.errors import InputError

__all__ = [
    "Clearances", "clearance_for", "clearance_loop", "clearance_width", "contributions", "freedoms", "plane_joints",
    "spatial_angles",
]  # fmt: skip

Array = NDArray[np.float64]


def plane_joints(geometry: Geometry, stage: str, stroke: float) -> dict[str, complex]:
    """Places J0 to J5 of one stage's joints in the plane, x + i y in m, at a stroke (m); the actuator's mount J0 is the
    origin.

    The angle between the crank's arms is theta6 less the inclination of the line from J2 to J5 (docs/linkage.md).
    """
    k = geometry.vanes.index(stage)
    g, s = geometry.arrays(), geometry.stages()[k]
    dx, dy = s.dx.value * MM, s.dy.value * MM
    between = s.theta6.value * DEG - math.atan2(dx, -dy)
    c, d = crank(stroke, g[G_LX0], g[G_X1], g[G_Y1], g[G_LE])
    e = complex(c, d)
    j2 = complex(g[G_X1], g[G_Y1])
    j5 = j2 + complex(dx, dy)
    turn = cmath.exp(-1j * between)
    j3 = j2 - s.lb.value * MM * e * turn
    j4 = j5 - s.ld.value * MM * 1j * cmath.exp(1j * stage_ring_angle(stroke, g, k)) * turn
    return {"J0": 0j, "J1": j2 - g[G_LE] * e, "J2": j2, "J3": j3, "J4": j4, "J5": j5}


@dataclass(frozen=True)
class Clearances:
    """Total clearance of each joint, mm: of a pin the difference of the diameters, of the ring how far its centre can
    wander across.

    actuator      both ends of the actuator together, along it
    crank_pivot   bearing of the bell crank
    crank_link    spherical joint between lower arm and vertical link
    link_clevis   spherical joint between vertical link and the ring's clevis
    ring          ring across its links, between its supports: twice the eccentricity
    lever_pin     between a lever arm's end and the ring, along the circumference
    """

    actuator: float = 0.0
    crank_pivot: float = 0.0
    crank_link: float = 0.0
    link_clevis: float = 0.0
    ring: float = 0.0
    lever_pin: float = 0.0

    def check(self) -> None:
        """Raise InputError for a clearance that is negative, not a number, or larger than a joint."""
        for f in fields(self):
            value = getattr(self, f.name)
            if not 0.0 <= value <= 5.0:
                raise InputError(f"clearance {f.name} (={value:g} mm) must be in [0, 5]")


@dataclass(frozen=True)
class _Loop:
    """Fixed numbers of one stage's loop in the plane, m."""

    lx0: float
    j2: complex
    j5: complex
    a1: complex  # joints on the crank, seen from its pivot with the upper arm upright
    a3: complex
    a4: complex  # clevis seen from the ring's centre, ring at rest
    lc: float
    ldp: float
    lever: float
    offset: float  # along z, from the crank's plane to the clevis at vane angle 0

    @classmethod
    def of(cls, geometry: Geometry, stage: str, offset: float) -> _Loop:
        s, c = geometry.stages()[geometry.vanes.index(stage)], geometry.crank
        dx, dy = s.dx.value * MM, s.dy.value * MM
        turn = cmath.exp(-1j * (s.theta6.value * DEG - math.atan2(dx, -dy)))
        j2 = complex(c.x1.value, c.y1.value) * MM
        a1, a3, a4 = -1j * c.le.value * MM, -1j * s.lb.value * MM * turn, -1j * s.ld.value * MM * turn
        long = (s.lc.value * MM, s.ld_prime.value * MM, s.l.value * MM)
        return cls(c.lx0.value * MM, j2, j2 + complex(dx, dy), a1, a3, a4, *long, offset * MM)

    def places(
        self, alpha: float, theta5: float, s2: complex, s5: complex, rise: float
    ) -> tuple[complex, complex, complex, float]:
        """J1, J3, J4 in the plane and the clevis' place along z; ``rise`` (m) is what the ring has beside equation
        (17).
        """
        crank, ring = cmath.exp(1j * alpha), cmath.exp(1j * theta5)
        sine = self.ldp * math.tan(theta5) / self.lever
        z = self.lever * (1.0 - math.sqrt(max(0.0, 1.0 - sine * sine)))
        centre = self.j2 + s2
        return centre + crank * self.a1, centre + crank * self.a3, self.j5 + s5 + ring * self.a4, self.offset + z + rise

    def chain(
        self, alpha: float, theta5: float, lx: float, gaps: tuple[float, float], s2: complex, s5: complex, rise: float
    ) -> list[float]:
        """What actuator and link of one chain miss, m."""
        j1, j3, j4, z = self.places(alpha, theta5, s2, s5, rise)
        return [abs(j1) - (lx + gaps[0]), math.sqrt(abs(j4 - j3) ** 2 + z * z) - (self.lc + gaps[1])]

    def solve(
        self,
        q: Array,
        stroke: float,
        stage: str,
        gaps: tuple[float, float] = (0.0, 0.0),
        s2: complex = 0j,
        across: float = 0.0,
        rises: tuple[float, float] = (0.0, 0.0),
    ) -> Array:
        """Newton's method from q = (alpha right, alpha left, theta5, shift along y), the ring's centre held at
        ``across`` (m) along x.

        The left chain is the right one turned by 180 deg: in its own frame the ring's centre is shifted the other way.
        InputError with the stroke where the loop does not close.
        """
        lx = self.lx0 + stroke

        def residual(p: Array) -> Array:
            s5 = complex(across, p[3])
            return np.array(
                self.chain(p[0], p[2], lx, gaps, s2, s5, rises[0]) + self.chain(p[1], p[2], lx, gaps, s2, -s5, rises[1])
            )

        scale = np.array([1.0, 1.0, 1.0, 0.1])  # rad, rad, rad, m
        r = residual(q)
        for _ in range(50):
            if float(np.max(np.abs(r))) < 1e-15:
                return q
            h = 1e-6 * scale
            jacobian = np.column_stack([(residual(q + d) - residual(q - d)) / (2.0 * d.max()) for d in np.diag(h)])
            step = np.linalg.solve(jacobian, r)
            q = q - step
            r = residual(q)
            if float(np.max(np.abs(step) / scale)) < 1e-13:
                return q
            if not (np.isfinite(q).all() and float(np.max(np.abs(q))) < math.pi):
                break
        missing = float(np.abs(r).max()) / MM
        raise InputError(
            f"{stage}: the mechanism does not close in space at stroke {stroke / MM:.4g} mm: {missing:.3g} mm are "
            f"missing"
        )

    def vane(self, theta5: float, sideways: float = 0.0) -> float:
        """Vane angle, rad, where the ring's slot is ``sideways`` (m) along the circumference from where a centred ring
        has it.
        """
        return math.asin((self.ldp * math.tan(theta5) + sideways / math.cos(theta5)) / self.lever)

    def sideways(self, q: Array, across: float, vane: float) -> float:
        """Shift of the ring's centre along the circumference at the vane, m."""
        along = 1j * cmath.exp(1j * (math.radians(vane) + q[2])) * self.a4 / abs(self.a4)
        return across * along.real + float(q[3]) * along.imag

    def forces(self, q: Array, s2: complex, s5: complex, motion: float) -> tuple[float, float, complex]:
        """Tension of link and actuator, and the sum of both on the crank, for a unit torque on the ring against the
        motion.
        """
        j1, j3, j4, z = self.places(q[0], q[2], s2, s5, 0.0)
        pull = (j3 - j4) / math.sqrt(abs(j3 - j4) ** 2 + z * z)  # of the link on the clevis, its part in the plane
        link = motion / _cross(j4 - self.j5 - s5, pull)
        towards = -j1 / abs(j1)  # pull of the actuator on the crank
        centre = self.j2 + s2
        actuator = _cross(j3 - centre, link * pull) / _cross(j1 - centre, towards)
        return link, actuator, actuator * towards - link * pull


def spatial_angles(geometry: Geometry, stage: str, stroke: ArrayLike, offset: float = 0.0) -> Array:
    """Vane angles, deg, of one stage at strokes (mm), the loop closed in space, no clearance.

    offset  mm along the engine's axis between the crank's plane and the clevis' where the vane angle is 0
    Raises InputError, naming the stroke, where the loop does not close.
    """
    loop = _Loop.of(geometry, stage, offset)
    out, q = [], np.zeros(4)
    for x in np.atleast_1d(np.asarray(stroke, dtype=float)):
        q = loop.solve(q, float(x) * MM, stage)
        out.append(math.degrees(loop.vane(q[2])))
    return np.array(out)


def freedoms(
    geometry: Geometry, stage: str, stroke: float, vane: float = -90.0, amount: float = 1.0
) -> dict[str, float]:
    """Change of a vane's angle, deg, by each of the four freedoms that two links leave the ring; both actuators stay at
    ``stroke`` (mm).

    across       the ring's centre shifted by ``amount`` (mm) square to the links
    along        shifted along the engine's axis
    tilt_across  turned about the line from clevis to clevis: the vane's side rises by ``amount``, the clevises do not
    tilt_along   turned about the line square to it: one clevis rises by ``amount``, the other sinks
    """
    loop = _Loop.of(geometry, stage, 0.0)
    d = amount * MM
    base = loop.solve(np.zeros(4), stroke * MM, stage)
    at_rest = loop.vane(base[2])
    out = {}
    for name, across, rises in (
        ("across", d, (0.0, 0.0)),
        ("along", 0.0, (d, d)),
        ("tilt_across", 0.0, (0.0, 0.0)),
        ("tilt_along", 0.0, (d, -d)),
    ):
        q = loop.solve(base, stroke * MM, stage, across=across, rises=rises)
        out[name] = math.degrees(loop.vane(q[2], loop.sideways(q, across, vane)) - at_rest)
    return out


def clearance_loop(
    geometry: Geometry, stage: str, stroke: ArrayLike, clearances: Clearances, vane: float = -90.0, offset: float = 0.0
) -> tuple[Array, Array]:
    """Vane angles (extension, retraction), deg, at strokes (mm) with clearance in the joints and vanes that resist the
    motion.

    vane    deg along the ring from the right clevis to the vane that is measured; -90 is the lowest

    Link and actuator carry force along themselves; statics of ring and crank give their signs, and the side on which
    the crank's bearing rests: it takes what link and actuator leave. Two equal links load the ring with a couple only
    and do not move its centre; what does is friction where the ring rests by its weight, at its lowest place: against
    the motion there, square to the links. So a ring turning with a longer stroke lags at the bottom and leads at the
    top: the lowest vane feels all of it, vanes beside the clevises nothing.
    """
    clearances.check()
    loop = _Loop.of(geometry, stage, offset)
    c = {f.name: 0.5 * getattr(clearances, f.name) * MM for f in fields(clearances)}
    x = np.atleast_1d(np.asarray(stroke, dtype=float))
    out = np.empty((2, x.size))
    for row, motion in enumerate((1.0, -1.0)):
        q = np.zeros(4)
        gaps, s2, across = (0.0, 0.0), 0j, -motion * c["ring"]
        for i, stroke_i in enumerate(x):
            for _ in range(50):  # places decide the sides, sides the places: a few turns
                before = q
                q = loop.solve(q, float(stroke_i) * MM, stage, gaps, s2, across)
                link, actuator, on_crank = loop.forces(q, s2, complex(across, q[3]), motion)
                gaps = (math.copysign(c["actuator"], actuator), math.copysign(c["crank_link"] + c["link_clevis"], link))
                s2 = c["crank_pivot"] * on_crank / abs(on_crank)
                if float(np.max(np.abs(q - before))) < 1e-12:
                    break
            out[row, i] = math.degrees(loop.vane(q[2], loop.sideways(q, across, vane) - motion * c["lever_pin"]))
    return out[0], out[1]


def _cross(a: complex, b: complex) -> float:
    return a.real * b.imag - a.imag * b.real


def clearance_width(
    geometry: Geometry, stage: str, clearances: Clearances, vane: float = -90.0, offset: float = 0.0
) -> float:
    """Width of the loop, deg, mean over the stroke: the ring's, times Ld'/L, as `hysteresis` in geometry.toml
    means it.
    """
    s = geometry.stages()[geometry.vanes.index(stage)]
    ratio = s.l.value / s.ld_prime.value
    loop = clearance_loop(geometry, stage, np.linspace(0.0, 48.0, 13), clearances, vane, offset)
    at_ring = [np.arctan(ratio * np.sin(a * DEG)) for a in loop]
    return float(np.mean(at_ring[1] - at_ring[0]) / (ratio * DEG))


def contributions(
    geometry: Geometry, stage: str, clearances: Clearances, vane: float = -90.0, offset: float = 0.0
) -> dict[str, float]:
    """Width, deg, that each joint's clearance makes alone."""
    clearances.check()
    none = Clearances()
    return {
        f.name: clearance_width(geometry, stage, replace(none, **{f.name: getattr(clearances, f.name)}), vane, offset)
        for f in fields(none)
    }


def clearance_for(
    geometry: Geometry,
    stage: str,
    width: float,
    clearances: Clearances,
    joint: str,
    vane: float = -90.0,
    offset: float = 0.0,
) -> float:
    """Clearance, mm, of one joint that brings the loop to ``width`` (deg) beside the given ones of the others.

    Raises InputError where the others alone are wider, or 5 mm are not enough.
    """

    def miss(value: float) -> float:
        return clearance_width(geometry, stage, replace(clearances, **{joint: value}), vane, offset) - width

    low, high = miss(0.0), miss(5.0)
    if not low <= 0.0 <= high:
        raise InputError(
            f"{stage}: no clearance of {joint} gives a width of {width:g} deg: the others alone make {low + width:.3g} "
            f"deg, 5 mm of it {high + width:.3g} deg"
        )
    return float(scipy.optimize.brentq(miss, 0.0, 5.0, xtol=1e-6))
