"""The controller's firmware, without clock, bus, file or plant: one pure `tick`."""

from controller.calibration import Calibration, load_calibration, new_inputs, new_outputs, new_state
from controller.firmware import give, tick
from controller.records import FAULTS, INPUTS, MODES, OUTPUTS, SCALARS, STATE, STRATEGIES, flat

__all__ = [
    "FAULTS", "INPUTS", "MODES", "OUTPUTS", "SCALARS", "STATE", "STRATEGIES", "Calibration", "flat", "give",
    "load_calibration", "new_inputs", "new_outputs", "new_state", "tick",
]  # fmt: skip
