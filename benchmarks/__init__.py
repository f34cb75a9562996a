"""How fast the loop is, beside the same loop in C, python-control and pathsim: ``python -m benchmarks``."""

__all__: list[str] = []
