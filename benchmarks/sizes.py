"""How much each kind of installation takes: files of the packages that it brings, as they are installed here."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from importlib import metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from benchmarks.measure import ROOT, Row

__all__ = ["MEASUREMENTS"]

MIB = 2**20
BLOCK = 512  # bytes of `st_blocks`
NAMED = 6  # largest packages


def _brought(requirements: list[str], extra: str, found: set[str]) -> None:
    """Add to ``found`` the packages that requirements bring, with those that they require in turn."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for text in requirements:
        wanted = Requirement(text)
        name = canonicalize_name(wanted.name)
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": extra}):
            continue
        if name == project["name"]:
            for also in wanted.extras:
                _brought(project["optional-dependencies"][also], "", found)
            continue
        requires = metadata.requires(name) or []
        if name not in found:
            found.add(name)
            _brought(requires, "", found)
        for also in wanted.extras:
            _brought([r for r in requires if "extra ==" in r], also, found)


def _size(name: str) -> float:
    """MiB that a package's files take on the disk, without what Python compiles of them."""
    files = [f.locate() for f in metadata.distribution(name).files or [] if f.suffix != ".pyc"]
    return sum(f.stat().st_blocks * BLOCK for f in files if f.exists()) / MIB


def _row(what: str, packages: set[str], more: str) -> Row:
    sizes = sorted(((_size(name), name) for name in packages), reverse=True)
    large = ", ".join(f"{name} {size:.0f}" for size, name in sizes[:NAMED] if size >= 1.0)
    return Row(what, f"{more}{sum(size for size, _ in sizes):,.0f} MiB", note=large)


def installation_sizes() -> Iterator[Row]:
    """The core, and what each extra adds to it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    core: set[str] = set()
    _brought(project["dependencies"], "", core)
    yield _row("pip install .", core, "")
    for extra in project["optional-dependencies"]:
        found = set(core)
        try:
            _brought([f"{project['name']}[{extra}]"], "", found)
        except metadata.PackageNotFoundError as e:
            yield Row(f"[{extra}]", "not measured", note=f"{e.name} is not installed here")
            continue
        yield _row(f"[{extra}]", found - core, "+")


MEASUREMENTS = {"installation sizes": installation_sizes}
