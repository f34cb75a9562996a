"""What the audit of packages lets pass, and what it does not."""

from __future__ import annotations

import json
from email.message import Message
from pathlib import Path
from typing import Any

import pytest

from tests import audit

OF = {"": ["core>=1"], "fast": ["quick[more]; python_version >= '3.0'"], "test": ["vaneloop[fast]", "scapy"]}


def about(licence: str = "", requires: tuple[str, ...] = (), **more: str) -> Any:
    """Metadata of a package, as its METADATA has it."""
    m = Message()
    for key, value in (("License-Expression", licence), *more.items(), *(("Requires-Dist", r) for r in requires)):
        if value:
            m[key] = value
    return m


def judged(pins: str, **packages: Any) -> tuple[list[str], list[str]]:
    known = {"core": about("MIT"), "quick": about("MIT"), "scapy": about("GPL-2.0-only")} | packages
    return audit.complaints(OF, [f"{name}==1" for name in pins.split()], known.get)


@pytest.mark.parametrize(
    ("expression", "allowed"),
    [
        ("MIT", True),
        ("GPL-3.0-only", False),
        ("", False),
        ("MIT AND GPL-3.0-only", False),
        ("MIT OR GPL-3.0-only", True),
        ("MPL-2.0 AND (Apache-2.0 OR GPL-3.0-only)", True),
        ("(MIT OR ISC) AND GPL-3.0-only", False),
        ("BSD-2-Clause AND Apache-2.0 WITH LLVM-exception", True),
        ("Apache-2.0 WITH something", False),
    ],
)
def test_of_alternatives_one_is_enough_of_what_counts_together_each(expression: str, allowed: bool) -> None:
    assert audit.is_allowed(expression) is allowed


@pytest.mark.parametrize(
    ("said", "licence"),
    [
        (about("MIT", License="GPL"), "MIT"),
        (about(Classifier="License :: OSI Approved :: BSD License", License="a text"), "BSD"),
        (about(License="Apache 2.0\n\nits text"), "Apache-2.0"),
        (about(License="My own"), "My own"),
        (about(), ""),
    ],
)
def test_a_licence_is_read_wherever_a_package_says_it(said: Any, licence: str) -> None:
    assert audit.licence_of("x", said) == licence


def test_a_package_of_everyone_needs_an_allowed_licence_one_of_developers_may_be_an_exception() -> None:
    assert judged("core quick scapy") == ([], [])
    for bad in ("GPL-2.0-only", "Proprietary"):
        (line,), _ = judged("core quick scapy", quick=about(bad))
        assert line == f"quick: licence {bad!r} is not one that tests/audit.py allows"
    (line,), _ = judged("core quick scapy", core=about("MIT", ("scapy",)))
    assert line.startswith("scapy: licence 'GPL-2.0-only' is not one")
    (line,), _ = judged("core quick scapy", core=about())
    assert line.startswith("core: licence 'not said' is not one")


def test_every_package_is_pinned_and_every_pin_is_of_one() -> None:
    deep = about("MIT", ("far; extra == 'more'", "other; extra == 'less'", "w; sys_platform == 'win32'"))
    assert judged("core scapy quick far", quick=deep, far=about("MIT")) == ([], [])
    assert judged("core scapy quick", quick=deep, far=about("MIT")) == (["far: not pinned in constraints.txt"], [])
    assert judged("core scapy quick old") == (["old: pinned in constraints.txt, and nothing requires it"], [])
    wrong, told = judged("core scapy quick far old", quick=deep)
    assert wrong == [] and [t.rpartition(": ")[2] for t in told] == ["far", "old"]


@pytest.mark.parametrize("answer", [None, "no network", "{}", '{"dependencies": []}'])
def test_without_a_list_of_advisories_one_line_says_so(
    answer: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    if answer is not None:
        (tmp_path / "pip-audit").write_text(f"#!/bin/sh\necho '{answer}'\nexit 1\n")
        (tmp_path / "pip-audit").chmod(0o755)
    found, why = audit.advisories(tmp_path / "constraints.txt")
    assert found == [] and why.startswith("no list of advisories is at hand") == ("dependencies" not in (answer or ""))


def test_an_advisory_is_told_with_the_version_that_mends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vulns = [{"id": "CVE-1", "fix_versions": ["2.1"]}, {"id": "CVE-2", "fix_versions": []}]
    answer = {"dependencies": [{"name": "a", "version": "2.0", "vulns": vulns}, {"name": "b", "skip_reason": "x"}]}
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "pip-audit").write_text(f"#!/bin/sh\necho '{json.dumps(answer)}'\nexit 1\n")
    (tmp_path / "pip-audit").chmod(0o755)
    found, why = audit.advisories(tmp_path / "constraints.txt")
    assert found == ["a 2.0: CVE-1, mended in 2.1", "a 2.0: CVE-2, mended in none yet"] and why == ""


def test_the_packages_of_this_environment_pass(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))  # a new advisory is for `make lint` to tell
    assert audit.main() == 0, capsys.readouterr().err
