"""Links adjusted to the schedule: which lengths may change and by how much, and those that best meet the schedule.

    adjust_links(geometry, schedules, ...)                          Lb and Lc of one stage that best meet its schedule
    geometry_with(geometry, changes) -> Geometry                    a geometry with other lengths or hysteresis

Lengths in mm and angles in deg, as at every border.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from plant import Geometry, Schedules
from plant.geometry import WORKING_SPEED, Stage, vane_angles
from plant.linkage import G_LB, G_LC, N_CRANK, N_PER_STAGE, check_assembly
from vaneloop.base.errors import InputError, meant
from vaneloop.design.stroke_tables import schedules_at_design

__all__ = ["CRITERIA", "Criterion", "LinkChange", "ScheduleOptions", "adjust_links", "geometry_with"]

Array = NDArray[np.float64]
Criterion = Literal["rms", "max", "design"]
CRITERIA = ("rms", "max", "design")
MAX_CANDIDATES = 200_000  # pairs of lengths tried


@dataclass(frozen=True)
class ScheduleOptions:
    """What may be changed, by how much, and what counts as good.

    step       mm, lengths change by multiples of it (manufacturing)
    lb_range   mm, largest change of a bell crank's lower arm
    lc_range   mm, largest change of a vertical link
    adjust     the lengths that may change, out of lb and lc
    criterion  rms or max of the error over the working speeds (40 to 102 %), or design: error at 100 % plus rms
    limit      deg, largest error of a stage but the VIGV at a working speed; a schedule that no length brings below it
               is refused
    """

    step: float = 0.5
    lb_range: float = 5.0
    lc_range: float = 5.0
    adjust: tuple[str, ...] = ("lb", "lc")
    criterion: Criterion = "rms"
    limit: float = 1.0

    def check(self) -> None:
        """Raise InputError for an option out of range."""
        for name, value, low, high in (
            ("step", self.step, 1e-3, 50.0),
            ("lb-range", self.lb_range, 0.0, 100.0),
            ("lc-range", self.lc_range, 0.0, 100.0),
        ):
            if not low <= value <= high:
                raise InputError(f"--{name} (={value:g} mm) must be in [{low:g}, {high:g}]")
        if not 0.0 < self.limit <= 180.0:
            raise InputError(f"--limit (={self.limit:g} deg) must be in (0, 180]")
        if self.criterion not in CRITERIA:
            near = meant(self.criterion, CRITERIA)
            raise InputError(f"--criterion (={self.criterion!r}) must be one of {', '.join(CRITERIA)}{near}")
        for name in self.adjust:
            if name not in ("lb", "lc"):
                raise InputError(f"--adjust: {name!r} is not a length that can be adjusted; allowed: lb, lc, none")
        pairs = (2 * int(self.lb_range / self.step) + 1) * (2 * int(self.lc_range / self.step) + 1)
        if pairs > MAX_CANDIDATES:
            raise InputError(
                f"--step (={self.step:g} mm) is too fine for the ranges: {pairs:,} pairs of lengths; limit "
                f"{MAX_CANDIDATES:,}"
            )


@dataclass(frozen=True)
class LinkChange:
    """Lengths of one stage and how well they meet its schedule. mm, deg; errors are target minus angle, over ``speed``
    of the result.

    lb_built, lc_built       as in the geometry table (lb as first built: lb_initial)
    lb, lc                   after the adjustment
    error_initial            with lb_initial; error_built: as the machine is (measured where there is a log); error:
                             adjusted
    error_extension, error_retraction  adjusted, with the play and both stroke tables: what remains in either direction
    """

    stage: str
    lb_initial: float
    lb_built: float
    lc_built: float
    lb: float
    lc: float
    error_initial: Array
    error_built: Array
    error: Array
    error_extension: Array
    error_retraction: Array
    at_design: dict[str, float] = field(default_factory=dict)
    rms: dict[str, float] = field(default_factory=dict)
    largest: dict[str, float] = field(default_factory=dict)


def geometry_with(
    geometry: Geometry, changes: dict[str, dict[str, float]], origins: dict[str, str] | None = None, check: bool = True
) -> Geometry:
    """A geometry with other lengths (mm) or hysteresis (deg) of some stages: {"vgv1": {"lb": 49.0}}. Refuses what does
    not assemble.
    """
    stages: dict[str, Stage] = {}
    for name in geometry.vanes:
        stage = geometry.stage(name)
        update = {}
        for key, value in changes.get(name, {}).items():
            q = getattr(stage, key)
            update[key] = q.model_copy(
                update={"value": float(value), "origin": (origins or {}).get(f"{name}.{key}", q.origin)}
            )
        stages[name] = stage.model_copy(update=update)
    changed = geometry.model_copy(update=stages)
    if check:
        check_assembly(changed.arrays())
    return changed


def adjust_links(
    geometry: Geometry,
    schedules: Schedules,
    stage: str,
    stroke: Array,
    speed: Array,
    options: ScheduleOptions,
    correction: Callable[[Array], Array] | None = None,
) -> tuple[float, float, Array]:
    """Changes (mm) of Lb and Lc of one stage that best meet its schedule at the strokes (mm) scheduled for the VIGV.

    correction  deg over stroke (mm): measured mean curve minus the geometry's
    Returns the two changes and the remaining error (deg) at each speed. Raises InputError where no lengths meet the
    schedule.
    """
    k = geometry.vanes.index(stage)
    built = geometry.stage(stage)
    target = np.rad2deg(schedules.targets(speed)[:, k])
    extra = correction(stroke) if correction is not None else np.zeros(stroke.size)
    works = (speed >= WORKING_SPEED[0]) & (speed <= WORKING_SPEED[1])
    if not works.any():
        works = np.ones(speed.size, bool)
    grids = []
    for name, reach in (("lb", options.lb_range), ("lc", options.lc_range)):
        n = int(reach / options.step + 1e-9) if name in options.adjust else 0
        grids.append(np.arange(-n, n + 1) * options.step)
    g = geometry.arrays()
    o = N_CRANK + k * N_PER_STAGE
    worth = np.full((grids[0].size, grids[1].size), np.inf)
    design = schedules_at_design(speed)
    for i, d_lb in enumerate(grids[0]):
        for j, d_lc in enumerate(grids[1]):
            if built.lb.value + d_lb > 0.0 and built.lc.value + d_lc > 0.0:
                g[o + G_LB], g[o + G_LC] = (built.lb.value + d_lb) * 1e-3, (built.lc.value + d_lc) * 1e-3
                error = target - extra - np.rad2deg(vane_angles(stroke * 1e-3, g)[:, k])
                rms = float(np.sqrt(np.mean(error[works] ** 2)))
                largest = float(np.max(np.abs(error[works])))
                worth[i, j] = {"rms": rms, "max": largest, "design": abs(float(error[design])) + rms}[options.criterion]
    order = np.argsort(worth + 1e-9 * (np.abs(grids[0])[:, None] + np.abs(grids[1])[None, :]), axis=None)
    fault: InputError | None = None
    for flat in order[:2000]:
        i, j = divmod(int(flat), worth.shape[1])
        if not np.isfinite(worth[i, j]):
            break
        change = float(grids[0][i]), float(grids[1][j])
        try:
            changed = geometry_with(
                geometry, {stage: {"lb": built.lb.value + change[0], "lc": built.lc.value + change[1]}}
            )
        except InputError as e:
            fault = fault or e
            continue
        error = target - extra - np.rad2deg(vane_angles(stroke * 1e-3, changed)[:, k])
        worst = int(np.argmax(np.where(works, np.abs(error), -1.0)))
        if abs(error[worst]) > options.limit:
            reach_lb = f"lb (={built.lb.value:g} mm) within {abs(grids[0]).max():g} mm"
            reach_lc = f"lc (={built.lc.value:g} mm) within {abs(grids[1]).max():g} mm"
            raise InputError(
                f"{stage}: no length meets the schedule at {speed[worst]:g} % speed (stroke {stroke[worst]:.4g} mm): "
                f"with {reach_lb} and {reach_lc} an error of {error[worst]:.3g} deg remains; allowed: "
                f"{options.limit:g} deg (--limit, --lb-range, --lc-range)"
            )
        return change[0], change[1], error
    raise fault or InputError(f"{stage}: no pair of lb and lc within the ranges can be assembled")
