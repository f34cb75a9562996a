"""The linkage's lengths and the vanes' target angles: tables read, checked, and turned into flat arrays in SI.

Tables are in mm and deg, everything returned here is in m and rad (rotor speed in per cent).
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Annotated, overload

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray
from pydantic import model_validator

from plant.linkage import (
    G_AX,
    G_AY,
    G_HYSTERESIS,
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
    STROKE_HIGH,
    STROKE_LOW,
    check_assembly,
    stage_vane_angle,
    vane_angle_table,
)
from vaneloop.base.errors import InputError
from vaneloop.base.tables import Axis, Bound, Bounded, Quantity, Table, read
from vaneloop.base.vanes import Staged

__all__ = [
    "STANDS_FOR", "Crank", "Geometry", "Schedules", "Stage", "length_tolerances", "load_geometry", "load_schedules",
    "stroke_for_vigv", "vane_angles",
]  # fmt: skip

MM = 1e-3
DEG = math.pi / 180.0
WORKING_SPEED = (40.0, 102.0)  # %; between these a schedule must rise strictly, so that each angle has one speed


class Crank(Bounded):
    """Actuator and upper arm of the bell crank, common to the stages."""

    lx0: Annotated[Quantity, Bound("mm", 50, 2000)]  # actuator length at stroke 0
    x1: Annotated[Quantity, Bound("mm", -2000, 2000)]  # crank pivot J2 seen from the actuator's mount J0
    y1: Annotated[Quantity, Bound("mm", -2000, 2000)]
    le: Annotated[Quantity, Bound("mm", 10, 1000)]  # upper arm


class Stage(Bounded):
    """Lower arm, vertical link, unison ring and lever arm of one stage."""

    lb: Annotated[Quantity, Bound("mm", 1, 1000)]  # lower arm as used
    lb_initial: Annotated[Quantity, Bound("mm", 1, 1000)]  # lower arm as first built
    lc: Annotated[Quantity, Bound("mm", 10, 2000)]  # vertical link
    dx: Annotated[Quantity, Bound("mm", -2000, 2000)]  # ring centre J5 seen from the crank pivot J2
    dy: Annotated[Quantity, Bound("mm", -2000, 2000)]
    theta6: Annotated[Quantity, Bound("deg", -360, 360)]  # fixed angle of the crank
    ld: Annotated[Quantity, Bound("mm", 10, 2000)]  # ring radius at the clevis
    ld_prime: Annotated[Quantity, Bound("mm", 10, 2000)]  # radius of the lever-arm end
    l: Annotated[Quantity, Bound("mm", 1, 500)]  # noqa: E741  lever arm
    hysteresis: Annotated[Quantity, Bound("deg", 0, 10)]  # total width at the vane


class Geometry(Staged, Table):
    """The linkage of the machine's stages."""

    crank: Crank
    vigv: Stage
    vgv1: Stage | None = None
    vgv2: Stage | None = None
    vgv3: Stage | None = None
    vgv4: Stage | None = None
    vgv5: Stage | None = None
    vgv6: Stage | None = None
    vgv7: Stage | None = None

    def stages(self) -> tuple[Stage, ...]:
        """Stages in the order of every array."""
        return tuple(self.stage(v) for v in self.vanes)

    def stage(self, vane: str) -> Stage:
        """The stage of that name, one of ``vanes``."""
        stage: Stage = getattr(self, vane)
        return stage

    def arrays(self, initial: bool = False) -> NDArray[np.float64]:
        """Flat geometry of `plant.linkage`, SI: the crank, then each stage. ``initial`` takes the lower arms as first
        built.

        Layout: [Lx0, x1, y1, Le], then for each stage [Lb, Lc, Ld, Ld', L, Ax, Ay, hysteresis] with A = La exp(i (3
        pi/2 + th6)).
        """
        g = np.zeros(N_CRANK + len(self.vanes) * N_PER_STAGE)
        c = self.crank
        g[G_LX0], g[G_X1], g[G_Y1], g[G_LE] = (q.value * MM for q in (c.lx0, c.x1, c.y1, c.le))
        for k, s in enumerate(self.stages()):
            o = N_CRANK + k * N_PER_STAGE
            la = math.sqrt(s.dx.value * s.dx.value + s.dy.value * s.dy.value) * MM
            a = 1.5 * math.pi + s.theta6.value * DEG
            g[o + G_LB] = (s.lb_initial if initial else s.lb).value * MM
            g[o + G_LC] = s.lc.value * MM
            g[o + G_LD] = s.ld.value * MM
            g[o + G_LDP] = s.ld_prime.value * MM
            g[o + G_L] = s.l.value * MM
            g[o + G_AX] = la * math.cos(a)
            g[o + G_AY] = la * math.sin(a)
            g[o + G_HYSTERESIS] = s.hysteresis.value * DEG
        return g

    @model_validator(mode="after")
    def _assembles(self) -> Geometry:
        for initial in (False, True):
            try:
                check_assembly(self.arrays(initial))
            except InputError as e:
                raise ValueError(f"{e}{' (with lb_initial)' if initial else ''}") from None
        return self


class Schedules(Staged, Bounded):
    """Target vane angles over rotor speed, linear between the breakpoints."""

    speed: Annotated[Axis, Bound("%", 0, 120)]
    vigv: Annotated[Axis, Bound("deg", -90, 90)]
    vgv1: Annotated[Axis | None, Bound("deg", -90, 90)] = None
    vgv2: Annotated[Axis | None, Bound("deg", -90, 90)] = None
    vgv3: Annotated[Axis | None, Bound("deg", -90, 90)] = None
    vgv4: Annotated[Axis | None, Bound("deg", -90, 90)] = None
    vgv5: Annotated[Axis | None, Bound("deg", -90, 90)] = None
    vgv6: Annotated[Axis | None, Bound("deg", -90, 90)] = None
    vgv7: Annotated[Axis | None, Bound("deg", -90, 90)] = None

    @model_validator(mode="after")
    def _rises(self) -> Schedules:
        n = self.speed.increasing("speed").values
        for key in self.vanes:
            a = self.target(key).values
            if len(a) != len(n):
                raise ValueError(f"{key}.values has {len(a)} numbers, speed.values has {len(n)}: they must be as many")
            for i in range(1, len(a)):
                works = n[i - 1] < WORKING_SPEED[1] and n[i] > WORKING_SPEED[0]
                if a[i] < a[i - 1] or (works and a[i] == a[i - 1]):
                    raise ValueError(
                        f"{key}.values[{i}] (={a[i]:g}) must be greater than the value before it (={a[i - 1]:g})"
                    )
        return self

    def target(self, vane: str) -> Axis:
        """Target angles of a stage, one of ``vanes``, deg."""
        axis: Axis = getattr(self, vane)
        return axis

    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Breakpoints of rotor speed (n), %, and target angles (n, stages), rad."""
        angles = np.column_stack([np.array(self.target(k).values) for k in self.vanes]) * DEG
        return np.array(self.speed.values), angles

    def targets(self, speed: ArrayLike) -> NDArray[np.float64]:
        """Target angles (n, stages), rad, at rotor speeds (n), %; held beyond the ends."""
        n, a = self.arrays()
        s = np.atleast_1d(np.asarray(speed, dtype=float))
        return np.column_stack([np.interp(s, n, a[:, k]) for k in range(a.shape[1])])


def load_geometry(source: str | Path = "geometry.toml") -> Geometry:
    """Read the linkage's geometry; InputError names file, key, value and what is allowed, or the stroke at which it
    does not assemble.
    """
    return read(source, Geometry)


def load_schedules(source: str | Path = "schedules.toml") -> Schedules:
    """Read the target angles over rotor speed; InputError names file, key, value and what is allowed."""
    return read(source, Schedules)


STANDS_FOR = ("lc", "l")  # an offset and a slope of the vane's angle over stroke


@lru_cache(maxsize=32)
def length_tolerances(geometry: Geometry) -> dict[str, float]:
    """How far ``lc`` and ``l`` of each stage may be from the table, mm, when they stand for every length that has a
    tolerance there.

    A length off within its tolerance moves a stage's angle over stroke by an offset, a slope and a bow that goes with
    the offset: nothing else is seen of twelve numbers (the crank's four, the stage's eight). The vertical link Lc gives
    the offset, the lever arm L the slope. Each number's change over the stroke is laid out in these two and a constant,
    by least squares. Errors within tolerance are independent and even, so the sums' standard deviations s add in
    squares; the tolerance is 3 s, at most the plain sum.

    Returns ``{"vigv_lc": ..., "vigv_l": ..., ...}``.
    """
    stroke = np.linspace(0.0, 48e-3, 25)
    here = vane_angles(stroke, geometry)
    out = {}
    for k, stage in enumerate(geometry.vanes):
        shapes = {}
        for part in ("crank", stage):
            for key, q in getattr(geometry, part):
                if key not in ("lb_initial", "hysteresis") and q.tolerance > 0.0:
                    off = q.model_copy(update={"value": q.value + q.tolerance})
                    moved = geometry.model_copy(update={part: getattr(geometry, part).model_copy(update={key: off})})
                    shapes[part, key] = vane_angles(stroke, moved)[:, k] - here[:, k]
        basis = [(stage, key) for key in STANDS_FOR]
        if any(b not in shapes for b in basis):
            continue  # a table that calls them exact
        parts = np.linalg.lstsq(
            np.column_stack([*(shapes[b] for b in basis), np.ones(len(stroke))]),
            np.column_stack(list(shapes.values())),
            rcond=None,
        )[0]
        for (_, key), row in zip(basis, parts, strict=False):
            tolerance = getattr(getattr(geometry, stage), key).tolerance
            out[f"{stage}_{key}"] = float(tolerance * min(np.abs(row).sum(), math.sqrt(3.0 * np.sum(row * row))))
    return out


def _flat(geometry: Geometry | NDArray[np.float64]) -> NDArray[np.float64]:
    return geometry.arrays() if isinstance(geometry, Geometry) else geometry


def vane_angles(stroke: ArrayLike, geometry: Geometry | NDArray[np.float64]) -> NDArray[np.float64]:
    """Vane angles (n, stages), rad, at strokes (n), m, without play. ``geometry`` may be the flat array."""
    x = np.ascontiguousarray(np.atleast_1d(np.asarray(stroke, dtype=float)))
    g = _flat(geometry)
    out = np.empty((x.size, (len(g) - N_CRANK) // N_PER_STAGE))
    vane_angle_table(x, g, out)
    return out


@overload
def stroke_for_vigv(angle: float, geometry: Geometry | NDArray[np.float64]) -> float: ...
@overload
def stroke_for_vigv(angle: NDArray[np.float64], geometry: Geometry | NDArray[np.float64]) -> NDArray[np.float64]: ...
def stroke_for_vigv(
    angle: float | NDArray[np.float64], geometry: Geometry | NDArray[np.float64]
) -> float | NDArray[np.float64]:
    """Stroke, m, that gives the VIGV's angle, rad, without play: the inverse of the linkage, one root by Brent's
    method.

    Raises InputError for an angle that no stroke from -2 to 50 mm gives.
    """
    g = _flat(geometry)
    low, high = stage_vane_angle(STROKE_LOW, g, 0), stage_vane_angle(STROKE_HIGH, g, 0)
    a = np.atleast_1d(np.asarray(angle, dtype=float))
    out = np.empty(a.shape)
    for i, target in enumerate(a.flat):
        if not low <= target <= high:
            raise InputError(
                f"vigv angle (={target / DEG:g} deg) must be in [{low / DEG:.4g}, {high / DEG:.4g}], what the stroke "
                f"can give"
            )
        out.flat[i] = scipy.optimize.brentq(
            lambda x, t=target: stage_vane_angle(x, g, 0) - t, STROKE_LOW, STROKE_HIGH, xtol=1e-12, rtol=1e-14
        )
    return float(out[0]) if np.ndim(angle) == 0 else out
