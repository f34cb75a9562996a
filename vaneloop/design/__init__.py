"""Methods that make the numbers in tables: servo gains, trend filter, schedules, strategies, clearances."""

__all__: list[str] = []
