"""Where the joints of the linkage are: bell crank and unison ring as intersections of circles.

Joints, in a plane (paper's letters)::

    J0 actuator mount (origin) --Lx--> J1 --Le-- J2 bell-crank pivot (x1, y1)
    J2 --Lb--> J3 --Lc--> J4 --Ld-- J5 ring centre = J2 + (dx, dy)

J1 is where a circle of radius Lx about J0 meets one of radius Le about J2; J4 where a circle of radius Lc about J3
meets one of radius Ld about J5. The crank is rigid, so J3 turns with J1. Two intersections exist each time; the one
next to the previous stroke's is kept. Ring angle (rad): ring turn from its neutral position; vane angle = asin(Ld'
tan(ring) / L).
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .kernel import MOST, X_HIGH, X_LOW, X_STEP

STAGES = ("vigv", *(f"vgv{k}" for k in range(1, MOST)))  # as many as the table has, from the first on
TABLES = Path(__file__).resolve().parents[2] / "tables"


@dataclass(frozen=True)
class Stage:
    """Links of one vane stage, m; vane_ratio = Ld'/L."""

    Lb: float
    Lc: float
    Ld: float
    vane_ratio: float
    dx: float
    dy: float
    hysteresis: float  # rad at the vane, total width


@dataclass(frozen=True)
class Geometry:
    """The whole linkage, m; Lx = length_0 + stroke."""

    x1: float
    y1: float
    Le: float
    length_0: float
    stages: tuple[Stage, ...]

    def with_error(self, stage: int, *, crank: float = 0.0, link: float = 0.0) -> Geometry:
        """Return the geometry with one stage's lower arm or vertical link made longer by an error (m)."""
        s = self.stages[stage]
        changed = replace(s, Lb=s.Lb + crank, Lc=s.Lc + link)
        return replace(self, stages=tuple(changed if k == stage else o for k, o in enumerate(self.stages)))


def _meet(ax, ay, ra, bx, by, rb, near):
    """Return the intersection of circles (a, ra) and (b, rb) nearest to the point ``near``."""
    ex, ey = bx - ax, by - ay
    d = np.hypot(ex, ey)
    along = (d * d + ra * ra - rb * rb) / (2.0 * d)
    height2 = ra * ra - along * along
    if height2 < 0.0:
        raise ValueError(f"circles of radius {ra:g} and {rb:g} m, {d:g} m apart, do not meet")
    h = np.sqrt(height2)
    mx, my = ax + along * ex / d, ay + along * ey / d
    one = (mx - h * ey / d, my + h * ex / d)
    two = (mx + h * ey / d, my - h * ex / d)
    return min((one, two), key=lambda p: np.hypot(p[0] - near[0], p[1] - near[1]))


def ring_angle(g: Geometry, stage: int, strokes: np.ndarray, start: float = 24e-3) -> np.ndarray:
    """Return the ring angle (rad) of one stage at each stroke (m), walking outwards from the stroke ``start`` where the
    branch is known.
    """
    s = g.stages[stage]
    out = np.empty(len(strokes))
    middle = int(np.argmin(np.abs(strokes - start)))

    def walk(indices, j1, j4):
        for k in indices:
            j1 = _meet(0.0, 0.0, g.length_0 + strokes[k], g.x1, g.y1, g.Le, j1)
            arm = np.arctan2(j1[1] - g.y1, j1[0] - g.x1)
            j3 = (g.x1 + s.Lb * np.cos(arm), g.y1 + s.Lb * np.sin(arm))
            j5 = (g.x1 + s.dx, g.y1 + s.dy)
            j4 = _meet(j3[0], j3[1], s.Lc, j5[0], j5[1], s.Ld, j4)
            out[k] = np.arctan2(j4[1] - j5[1], j4[0] - j5[0]) + 0.5 * np.pi
        return j1, j4

    # at the start J1 hangs below the pivot, the clevis is near its neutral position
    below = (g.x1, g.y1 - 2.0 * g.Le)
    clevis = (g.x1 + s.dx, g.y1 + s.dy - s.Ld)
    j1, j4 = walk([middle], below, clevis)
    walk(range(middle, len(strokes)), j1, j4)
    walk(range(middle, -1, -1), j1, j4)
    return out


def ring_tables(g: Geometry) -> np.ndarray:
    """Return float64[stages, n]: ring angle (rad) on the strokes X_LOW, X_LOW + X_STEP, ..., X_HIGH (a spline through
    every 0.25 mm).
    """
    from scipy.interpolate import CubicSpline

    coarse = np.linspace(X_LOW, X_HIGH, 201)
    fine = X_LOW + X_STEP * np.arange(round((X_HIGH - X_LOW) / X_STEP) + 1)
    return np.array([CubicSpline(coarse, ring_angle(g, k, coarse))(fine) for k in range(len(g.stages))])


def vane_angle(ring: np.ndarray, ratio: float) -> np.ndarray:
    """Vane angle (rad) from ring angle (rad)."""
    return np.arcsin(ratio * np.tan(ring))


def load(folder: Path = TABLES, rng: np.random.Generator | None = None) -> Geometry:
    """Read ``geometry.toml``; with ``rng``, every length and angle is drawn uniformly within the tolerance that stands
    beside it.

    Its ring centre is given as the paper has it (equations 11, 12): straight below the pivot at the distance La of (dx,
    dy), turned by theta6, in the frame where the lower arm is the upper arm's prolongation J2 -> J1; the ring is
    neutral with J4 straight below J5.
    """
    table = tomllib.loads((folder / "geometry.toml").read_text(encoding="utf-8"))

    def drawn(part: str, key: str) -> float:
        cell = table[part][key]
        return cell["value"] + (0.0 if rng is None else rng.uniform(-1.0, 1.0) * cell["tolerance"])

    def mm(part: str, key: str) -> float:
        return drawn(part, key) * 1e-3

    stages = []
    for name in (name for name in STAGES if name in table):
        distance = float(np.hypot(mm(name, "dx"), mm(name, "dy")))
        direction = np.deg2rad(270.0 + drawn(name, "theta6"))
        stages.append(
            Stage(
                Lb=mm(name, "lb"),
                Lc=mm(name, "lc"),
                Ld=mm(name, "ld"),
                vane_ratio=mm(name, "ld_prime") / mm(name, "l"),
                dx=float(distance * np.cos(direction)),
                dy=float(distance * np.sin(direction)),
                # the play's own tolerance is the specimen's (`parameters.TOLERANCES`)
                hysteresis=float(np.deg2rad(table[name]["hysteresis"]["value"])),
            )
        )
    return Geometry(mm("crank", "x1"), mm("crank", "y1"), mm("crank", "le"), mm("crank", "lx0"), tuple(stages))


def schedule(folder: Path = TABLES) -> tuple[np.ndarray, np.ndarray]:
    """Read ``schedules.toml``: speeds (%) and the VIGV's target angles (rad)."""
    table = tomllib.loads((folder / "schedules.toml").read_text(encoding="utf-8"))
    return np.array(table["speed"]["values"]), np.deg2rad(table["vigv"]["values"])
