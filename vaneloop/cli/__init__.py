"""The ``vaneloop`` command line: `main` has its verbs, each a module of its own."""

__all__: list[str] = []
