"""Compare, locate, diagnose, extend: for any model made of stages."""

from vaneloop.discrepancy.models.load import load_system
from vaneloop.discrepancy.models.system import Record, System, unknown
from vaneloop.discrepancy.stage import Effect, Parameter, Stage, StageError

__all__ = ["Effect", "Parameter", "Record", "Stage", "StageError", "System", "load_system", "unknown"]
