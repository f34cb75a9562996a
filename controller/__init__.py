"""The controller's firmware, without clock, bus, file or plant: one pure `tick`."""

from controller.calibration import STRATEGIES, Calibration, load_calibration, new_inputs, new_state
from controller.firmware import FAULTS, INPUTS, MODES, SCALARS, STATE, tick

__all__ = [
    "FAULTS",
    "INPUTS",
    "MODES",
    "SCALARS",
    "STATE",
    "STRATEGIES",
    "Calibration",
    "load_calibration",
    "new_inputs",
    "new_state",
    "tick",
]
