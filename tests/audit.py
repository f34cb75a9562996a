"""``python -m tests.audit``: what the packages that VaneLoop brings in allow, and whether each is pinned.

Asked are the plain install and every extra of pyproject.toml, with all that they require on Linux on each promised
Python, as the installed packages say it. Exit code: 1 where a licence is not allowed or not known, where a package is
not pinned in constraints.txt, where a pin is of nothing that is required, or where a pinned version is on pip-audit's
list of advisories. That list is asked where pip-audit is installed and answers; where not, one line says so.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterable, Mapping
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.pythons import PYTHONS

__all__ = ["advisories", "complaints", "is_allowed", "licence_of", "main", "required"]

ROOT = Path(__file__).resolve().parent.parent
PERMISSIVE = "asks that its text and its authors are named"
LIBRARY = "used as it is, as a library that its user may exchange; its own files stay under it"
ALLOWED = {
    **dict.fromkeys(("0BSD", "CC0-1.0", "MIT-0", "Zlib"), "asks for nothing that we could miss"),
    **dict.fromkeys(("Apache-2.0", "Apache-2.0 WITH LLVM-exception", "ISC", "MIT", "MIT-CMU", "PSF-2.0"), PERMISSIVE),
    **dict.fromkeys(("BSD", "BSD-2-Clause", "BSD-3-Clause"), PERMISSIVE),
    "LicenseRef-EXUDYN-General-License": "the BSD 3-Clause in words of its own",
    **dict.fromkeys(("LGPL-3.0-only", "LGPL-3.0-or-later", "MPL-2.0"), LIBRARY),
}
# Allowed to developers alone: no user's install brings them.
DEVELOPERS = {"scapy": "GPL-2.0-only: checks frames of ours in a test; nothing that is given away has it in it"}
DEVELOPERS_EXTRAS = {"test", "test-all", "docs", "bench", "release"}
# What these say nowhere but in the text of their licence, or cannot say in a classifier.
READ = {
    "fmpy": "BSD-2-Clause",
    "axe-playwright-python": "MIT",
    "docutils": "BSD-2-Clause",
}  # docutils: its tools are GPL
SPELLED = {
    "Apache Software License": "Apache-2.0",
    "Apache 2.0": "Apache-2.0",
    "BSD License": "BSD",
    "BSD 3-Clause": "BSD-3-Clause",
    "3-Clause BSD License": "BSD-3-Clause",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "GNU Lesser General Public License v3 or later (LGPLv3+)": "LGPL-3.0-or-later",
}
Metadata = Callable[[str], metadata.PackageMetadata | None]


def licence_of(name: str, about: metadata.PackageMetadata) -> str:
    """The licence of a package as an SPDX expression; several classifiers count together. "" where it says none."""
    if name in READ:
        return READ[name]
    if expression := about.get("License-Expression"):
        return expression
    said = [c.rpartition(" :: ")[2] for c in about.get_all("Classifier") or [] if c.startswith("License :: ")]
    said = said or (about.get("License") or "").strip().splitlines()[:1]
    return " AND ".join(SPELLED.get(s, s) for s in said)


def is_allowed(expression: str) -> bool:
    """Whether a licence is allowed: of alternatives one, of what counts together each."""
    while (inner := re.search(r"\(([^()]*)\)", expression)) and f" {inner[0]} " in f" {expression} ":
        word = "MIT" if is_allowed(inner[1]) else "none"
        expression = expression.replace(inner[0], word)
    return any(all(part.strip() in ALLOWED for part in way.split(" AND ")) for way in expression.split(" OR "))


def required(of: Mapping[str, Iterable[str]], extras: Iterable[str], about: Metadata) -> set[str]:
    """All packages that the plain install ("") and ``extras`` of a project bring in, by what each requires."""
    found: set[tuple[str, str]] = set()
    left = [("", text) for extra in ("", *extras) for text in of[extra]]
    while left:
        extra, text = left.pop()
        r = Requirement(text)
        worlds = [{"python_version": v, "python_full_version": f"{v}.0", "extra": extra} for v in PYTHONS]
        if r.marker is not None and not any(r.marker.evaluate(w) for w in worlds):
            continue
        name = canonicalize_name(r.name)
        for more in ("", *r.extras):
            if (name, more) in found:
                continue
            found.add((name, more))
            if name == "vaneloop":
                left += [("", text) for text in of[more]] if more else []
            elif its := about(name):
                left += [(more, text) for text in its.get_all("Requires-Dist") or []]
    return {name for name, _ in found} - {"vaneloop"}


def complaints(of: Mapping[str, Iterable[str]], pins: Iterable[str], about: Metadata) -> tuple[list[str], list[str]]:
    """What is wrong, and what could not be judged: the licence of a package that is not installed, and, as it is not
    known what it requires, the pins that may be for it.
    """
    wrong, unknown = [], []
    everyones = required(of, [e for e in of if e not in {"", *DEVELOPERS_EXTRAS}], about)
    all_of_them = required(of, [e for e in of if e], about)
    pinned = {canonicalize_name(r.name): r for r in map(Requirement, pins)}
    for name in sorted(all_of_them):
        if name not in pinned:
            wrong.append(f"{name}: not pinned in constraints.txt")
        if (its := about(name)) is None:
            unknown.append(name)
        elif not is_allowed(licence := licence_of(name, its)) and (name in everyones or name not in DEVELOPERS):
            users = "" if name in everyones else ", developers' alone"
            wrong.append(f"{name}: licence {licence or 'not said'!r} is not one that tests/audit.py allows{users}")
    idle = [n for n, r in sorted(pinned.items()) if n not in all_of_them and (r.marker is None or r.marker.evaluate())]
    if not unknown:
        return wrong + [f"{name}: pinned in constraints.txt, and nothing requires it" for name in idle], []
    told = [f"licences not judged of {len(unknown)} packages that are not installed here: {_some(unknown)}"]
    if idle:
        told.append(f"{len(idle)} pins are of what nothing requires that is installed here: {_some(idle)}")
    return wrong, told


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")


def advisories(pins: Path) -> tuple[list[str], str]:
    """Pinned versions that pip-audit's list has something against; and why it was not asked, "" where it was."""
    if not (tool := shutil.which("pip-audit")):
        return [], "no list of advisories is at hand (pip-audit is not installed)"
    asked = [
        tool,
        "--requirement",
        str(pins),
        "--no-deps",
        "--disable-pip",
        "--format",
        "json",
        "--progress-spinner=off",
    ]
    try:
        done = subprocess.run(asked, capture_output=True, text=True, check=False, timeout=60)
        packages = json.loads(done.stdout)["dependencies"]
    except (OSError, subprocess.TimeoutExpired, ValueError, KeyError):
        return [], "no list of advisories is at hand (pip-audit gave no answer)"
    found = [
        f"{p['name']} {p.get('version', '')}: {v['id']}, mended in {', '.join(v.get('fix_versions') or ['none yet'])}"
        for p in packages
        for v in p.get("vulns", [])
    ]
    return found, ""


def main() -> int:
    """Say what is wrong; return the exit code."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    of = {"": project["dependencies"], **project["optional-dependencies"]}
    file = ROOT / "constraints.txt"
    pins = [line for line in file.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    here = {canonicalize_name(d.name): d.metadata for d in metadata.distributions()}
    wrong, unknown = complaints(of, pins, here.get)
    found, why = advisories(file)
    for line in filter(None, (*unknown, why)):
        print(f"audit: {line}")
    for line in wrong + found:
        print(f"audit: {line}", file=sys.stderr)
    return 1 if wrong or found else 0


if __name__ == "__main__":
    sys.exit(main())
