"""One stage of the mechanism as a 3-D multibody system in Exudyn: the check that the planar model's source makes with
ADAMS.

Four rigid bodies (bell crank, vertical link, unison ring with its clevis, lever arm with its vane) and ground. Joints
as in the paper's Table 3, and the lever that gives the axial motion of equation (17):

    crank - ground   revolute about the crank's pivot
    crank - link     spherical             link - clevis   spherical
    ring - ground    revolute about the engine's axis, and free to slide along it
    lever - ground   revolute about the vane's stem, which points to the engine's axis
    lever - ring     the lever's end slides radially in the ring: square to it, it is held

The actuator is a given distance between its mount and the crank's upper arm. No formula of the planar model is used:
lengths only. Exudyn (J. Gerstmayr, Multibody System Dynamics 60 (2024) 447-477) is an optional dependency: ``pip
install 'vaneloop[multibody]'``.
"""

from __future__ import annotations

import cmath
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant import Geometry
from plant.geometry import DEG, MM
from vaneloop.base.errors import InputError
from vaneloop.base.extras import needs

__all__ = ["multibody_angles"]

Array = NDArray[np.float64]


def multibody_angles(geometry: Geometry, stage: str, stroke: Array, offset: float = 0.0, vane: float = 90.0) -> Array:
    """Vane angles, deg, of one stage at strokes (mm) in rising order, from the multibody system's constraint equations.

    offset  mm along the engine's axis between the crank's plane and the clevis' where the vane angle is 0
    vane    deg on the ring from the clevis to the lever

    Raises InputError where Exudyn is not installed or where the system does not close.
    """
    needs("the multibody check", "exudyn")
    import exudyn as exu
    from exudyn.itemInterface import (
        CoordinateConstraint,
        MarkerBodyRigid,
        MarkerNodeCoordinate,
        NodePointGround,
        SphericalJoint,
    )
    from exudyn.utilities import InertiaCuboid

    s, c = getattr(geometry, stage), geometry.crank
    le, lb, lc, ld, ldp, lever = (q.value * MM for q in (c.le, s.lb, s.lc, s.ld, s.ld_prime, s.l))
    dx, dy = s.dx.value * MM, s.dy.value * MM
    arms = s.theta6.value * DEG - math.atan2(dx, -dy)  # between the crank's arms
    turn = cmath.exp(-1j * arms)
    j2 = complex(c.x1.value, c.y1.value) * MM
    j5 = j2 + complex(dx, dy)
    upper, lower, clevis = (
        -1j * le,
        -1j * lb * turn,
        -1j * ld * turn,
    )  # seen from pivot and centre, upper arm upright, ring at rest
    z = offset * MM

    def at(p: complex, height: float = 0.0) -> list[float]:
        return [p.real, p.imag, height]

    exu.config.printToConsole = False
    system: Any = exu.SystemContainer()
    mbs: Any = system.AddSystem()
    block = InertiaCuboid(density=1000.0, sideLengths=[0.1, 0.1, 0.1])
    turning = exu.NodeType.RotationRxyz
    ground = mbs.CreateGround()
    crank = mbs.CreateRigidBody(inertia=block, referencePosition=at(j2), nodeType=turning)
    ring = mbs.CreateRigidBody(inertia=block, referencePosition=at(j5), nodeType=turning)
    mbs.CreateGenericJoint(itemNumbers=[ground, crank], position=at(j2), constrainedAxes=[1, 1, 1, 1, 1, 0])
    mbs.CreateGenericJoint(itemNumbers=[ground, ring], position=at(j5), constrainedAxes=[1, 1, 0, 1, 1, 0])

    a, b = np.array(at(j2 + lower, -z)), np.array(at(j5 + clevis))
    along = (b - a) / np.linalg.norm(b - a)
    across = np.cross([0.0, 0.0, 1.0], along)
    across /= np.linalg.norm(across)
    frame = np.column_stack([across, np.cross(along, across), along])
    link = mbs.CreateRigidBody(
        inertia=block, referencePosition=0.5 * (a + b), referenceRotationMatrix=frame, nodeType=turning
    )
    spin = mbs.AddMarker(MarkerNodeCoordinate(nodeNumber=mbs.GetObject(link)["nodeNumber"], coordinate=5))
    held = mbs.AddMarker(MarkerNodeCoordinate(nodeNumber=mbs.AddNode(NodePointGround()), coordinate=0))
    mbs.AddObject(CoordinateConstraint(markerNumbers=[held, spin]))  # the link's idle rotation about itself
    for body, place, end in ((crank, at(lower, -z), -0.5 * lc), (ring, at(clevis), 0.5 * lc)):
        m0 = mbs.AddMarker(MarkerBodyRigid(bodyNumber=body, localPosition=place))
        m1 = mbs.AddMarker(MarkerBodyRigid(bodyNumber=link, localPosition=[0.0, 0.0, end]))
        mbs.AddObject(SphericalJoint(markerNumbers=[m0, m1]))

    outward = clevis / abs(clevis) * cmath.exp(1j * math.radians(vane))
    tangent = outward * 1j
    stem = at(j5 + ldp * outward, lever)
    arm = mbs.CreateRigidBody(inertia=block, referencePosition=stem, nodeType=turning)
    axis = np.column_stack([at(tangent), [0.0, 0.0, 1.0], at(outward)])  # third column: the stem
    mbs.CreateGenericJoint(
        itemNumbers=[ground, arm], position=stem, rotationMatrixAxes=axis, constrainedAxes=[1, 1, 1, 1, 1, 0]
    )
    slot = np.column_stack([at(outward), at(tangent), [0.0, 0.0, 1.0]])  # first column: free to slide
    mbs.CreateGenericJoint(
        itemNumbers=[ring, arm],
        position=at(j5 + ldp * outward),
        rotationMatrixAxes=slot,
        constrainedAxes=[0, 1, 1, 0, 0, 0],
    )
    first = abs(j2 + upper)
    actuator = mbs.CreateDistanceConstraint(itemNumbers=[ground, crank], localPosition1=at(upper), distance=first)
    mbs.Assemble()

    settings: Any = exu.SimulationSettings()
    static = settings.staticSolver
    static.numberOfLoadSteps = 1
    static.verboseMode = 0
    static.newton.relativeTolerance = static.newton.absoluteTolerance = 1e-12
    static.newton.maxIterations = 50
    static.adaptiveStep = False
    settings.solution.file.write = False
    settings.show.statistics = False

    def solve(length: float) -> float:
        mbs.SetObjectParameter(actuator, "distance", length)
        try:
            solved = mbs.SolveStatic(settings, updateInitialValues=True, showHints=False)
        except exu.SolverError:
            solved = False
        if not solved:
            raise InputError(
                f"{stage}: the multibody system does not close at stroke {(length - c.lx0.value * MM) / MM:.4g} mm"
            )
        end = mbs.GetObjectOutputBody(arm, exu.OutputVariableType.Position, localPosition=[0.0, 0.0, -lever])
        sideways = (end[0] - stem[0]) * tangent.real + (end[1] - stem[1]) * tangent.imag
        return math.degrees(math.atan2(sideways, stem[2] - end[2]))

    lengths = c.lx0.value * MM + np.asarray(stroke) * MM
    for length in np.linspace(first, lengths[0], max(2, int(abs(first - lengths[0]) / 2e-3) + 1)):
        solve(float(length))
    return np.array([solve(float(length)) for length in lengths])
