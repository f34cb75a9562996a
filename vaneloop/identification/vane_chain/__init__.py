"""The vane chain as subsystems, one module each, and what they share."""

__all__: list[str] = []
