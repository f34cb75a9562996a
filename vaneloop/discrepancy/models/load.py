"""Read a user's model file: a Python file with a `System` in it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

from vaneloop.discrepancy.models.system import System
from vaneloop.discrepancy.models.user_code import place_of
from vaneloop.discrepancy.stage import StageError

__all__ = ["load_system"]


def load_system(path: str | Path) -> System:
    """Read a user's model file: a Python file in which a `System` stands, whatever its name.

    Raises StageError, one line, for a file that is absent, does not run, or has no System or more than one.
    """
    path = Path(path)
    if not path.is_file():
        raise StageError(
            f"{path}: no such file; --system wants a Python file with a System in it (docs/your_own_model.md)"
        )
    name = f"_system_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise StageError(f"{path}: is not a Python file (*.py)")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(path.parent.resolve()))
    older = importlib.util.find_spec("discrepancy") is None  # the package's name in the first version
    if older:
        sys.modules["discrepancy"] = sys.modules["vaneloop.discrepancy"]
    try:
        spec.loader.exec_module(module)
    except StageError as e:
        raise StageError(f"{path}: {e}") from None
    except SyntaxError as e:
        raise StageError(f"{path}: line {e.lineno}: {e.msg}") from None
    except Exception as e:
        raise StageError(f"{path}: failed{place_of(e)}: {type(e).__name__}: {e}") from None
    finally:
        sys.path.remove(str(path.parent.resolve()))
        if older:
            del sys.modules["discrepancy"]
    found = {id(v): v for v in vars(module).values() if isinstance(v, System)}
    if len(found) != 1:
        raise StageError(
            f"{path}: {len(found)} objects of vaneloop.System; exactly one is needed, as in system = System(...)"
        )
    return next(iter(found.values()))
