"""What the search can look at: the vane chain (`vanes`) and systems that users describe themselves (`system`)."""

__all__: list[str] = []
