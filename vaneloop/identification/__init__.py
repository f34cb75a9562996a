"""Compare, locate, diagnose, extend: for any model made of stages."""

from vaneloop.identification.subsystem import Effect, Parameter, Stage, StageError
from vaneloop.identification.user_models.system import Record, System, unknown
from vaneloop.identification.user_models.user_code import load_system

__all__ = ["Effect", "Parameter", "Record", "Stage", "StageError", "System", "load_system", "unknown"]
