"""How a Python process of ours is started: it finds this VaneLoop, and no module in the folder where the user stands.

Python puts that folder first in its search path, for ``-c`` and ``-m`` too. It may be a folder of logs of somebody
else, with a ``json.py`` in it.
"""

from __future__ import annotations

import sys
from pathlib import Path

__all__ = ["python", "python_module"]

_ROOT = str(Path(__file__).parents[2])
_HERE = f"import sys; {_ROOT!r} in sys.path or sys.path.insert(0, {_ROOT!r}); "


def python(code: str, *words: str) -> list[str]:
    """Command of a process that runs ``code``, with these words in ``sys.argv[1:]``."""
    return [sys.executable, "-P", "-c", _HERE + code, *words]


def python_module(module: str, *words: str) -> list[str]:
    """Command of a process that runs a module as ``python -m`` does."""
    return python(f"import runpy; runpy.run_module({module!r}, run_name='__main__', alter_sys=True)", *words)
