"""Rotary friction damper with backlash, driven by a hydraulic actuator: only viscous friction is in the model.

Data: ARTS-Laboratory, Dataset-Friction-Damper-with-Backlash (GitHub), the JSON files of dataset-2.

    vaneloop diagnose *0.5Hz*.json --test *1Hz*.json --test *Kocaeli*.json --system examples/friction_damper.py --report
    damper.html
"""

from vaneloop import System, unknown


def force(u, p):
    """Force of the damper in kN, from its motion in mm."""
    return p.viscous * u.velocity


def read(path):
    """Channels of one file, in mm, kN, mm/s."""
    import json

    import numpy as np

    with open(path) as f:
        data = np.array(json.load(f)["data"])
    return {
        "t": data[:, 0],
        "displacement": 25.4 * data[:, 1],
        "force": 4.4482216 * data[:, 2],
        "speed": 25.4 * data[:, 3],
    }  # mm, kN, mm/s


system = System(
    name="damper",
    kind="force",
    model=force,
    position="displacement",
    velocity="speed",
    outputs={"force": "kN"},
    parameters=[unknown("viscous", 0.1, "kN s/mm", low=0.0)],
    units={"position": "mm"},
    read=read,
)
