"""Many engines, many logs: diagnosed by any number of processes, never lost, never twice; then read as one table."""

__all__: list[str] = []
