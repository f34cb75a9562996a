"""The ``vaneloop`` command line."""

__all__: list[str] = []
