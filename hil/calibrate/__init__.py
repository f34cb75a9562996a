"""The running firmware as a calibration engineer's tool sees it: memory, XCP slave, DAQ, A2L (docs/xcp.md)."""

from hil.calibrate.memory import Memory
from hil.calibrate.slave import Slave
from hil.calibrate.station import Attended

__all__ = ["Attended", "Memory", "Slave"]
