"""Systems of many families, simulated independently of the product, with laws hidden in them: docs/hidden_law.md."""

from .cases import FAMILIES, KINDS, Case, Log, draw_case, left_over
from .family import Family, Hidden, Outside, Signal
from .learned import LEARNED

__all__ = [
    "FAMILIES", "KINDS", "LEARNED", "Case", "Family", "Hidden", "Log", "Outside", "Signal", "draw_case", "left_over",
]  # fmt: skip
