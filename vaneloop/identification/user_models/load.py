"""Read a user's model file: a Python file with a `System` in it."""

from __future__ import annotations

import importlib.util
import sys
import types
import warnings
from pathlib import Path
from typing import Any

from vaneloop.identification.subsystem import StageError
from vaneloop.identification.user_models.system import System
from vaneloop.identification.user_models.user_code import place_of

__all__ = ["FormerName", "load_system"]


class FormerName(types.ModuleType):
    """A former name of `vaneloop.identification`: it still has the public names there, and warns of each."""

    def __getattr__(self, name: str) -> Any:
        """A public name of the package."""
        package = sys.modules["vaneloop.identification"]
        if name not in package.__all__:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        warnings.warn(
            f"{self.__name__}.{name} is now vaneloop.identification.{name}; the former name goes with the next version",
            FutureWarning,
            stacklevel=2,
        )
        return getattr(package, name)


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
    older = importlib.util.find_spec("discrepancy") is None
    if older:
        sys.modules["discrepancy"] = FormerName("discrepancy")
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
