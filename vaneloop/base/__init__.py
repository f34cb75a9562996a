"""What everything stands on: errors, names and units of the signals, reading of tables, the terminal."""

__all__: list[str] = []
