"""What is measured from a checkout: how fast the loop is, beside the same loop in C, python-control and pathsim
(``python -m benchmarks``), and how often the search is right (``python -m benchmarks.hidden_effect``, ``hidden_law``).
"""

import os

__all__: list[str] = []

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the `vaneloop` command does, before numpy is imported
