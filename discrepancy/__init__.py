"""Compare, locate, diagnose, extend: for any model made of stages."""

from discrepancy.stage import Effect, Parameter, Stage, StageError

__all__ = ["Effect", "Parameter", "Stage", "StageError"]
