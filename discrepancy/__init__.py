"""Compare, locate, diagnose, extend: for any model made of stages."""

from discrepancy.stage import Effect, Parameter, Stage, StageError
from discrepancy.system import Record, System, load_system, unknown

__all__ = ["Effect", "Parameter", "Record", "Stage", "StageError", "System", "load_system", "unknown"]
