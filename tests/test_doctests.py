"""The examples in the docstrings of the public interface run, and print what stands beside them."""

from __future__ import annotations

import doctest
import importlib
import inspect

import pytest

import vaneloop
from tests.conftest import ROOT
from vaneloop.verbs import answer, curves, estimates

MODULES = sorted({getattr(vaneloop, name).__module__ for name in vaneloop.__all__} | {"hil.logs.channels", "vaneloop"})
ANALYSES = ("compare", "diagnose", "experiment", "extend", "learn", "locate", "replay", "read_log")


def examples_of(module: str) -> list[doctest.DocTest]:
    """The docstrings of a module that have examples."""
    return [t for t in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(module)) if t.examples]


@pytest.mark.parametrize("test", [t for m in MODULES for t in examples_of(m)], ids=lambda t: t.name)
def test_an_example_prints_what_stands_beside_it(test: doctest.DocTest, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas")
    monkeypatch.chdir(ROOT)
    said: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE, verbose=False)
    runner.run(test, out=said.append)
    assert not runner.failures, "".join(said)


@pytest.mark.parametrize("name", ANALYSES)
def test_each_analysis_says_its_arguments_and_has_an_example(name: str) -> None:
    """numpydoc: a section for parameters, in which each stands, for what is returned, and an example."""
    function = getattr(vaneloop, name)
    text = inspect.getdoc(function) or ""
    assert all(f"{head}\n{'-' * len(head)}\n" in text for head in ("Parameters", "Returns", "Examples")), text
    told = text.partition("Parameters\n")[2].partition("\nReturns\n")[0]
    missing = [p for p in inspect.signature(function).parameters if p not in told.replace(",", " ").split()]
    assert not missing


def test_what_an_analysis_returns_is_documented() -> None:
    for thing in (answer.Answer, curves.Curves, estimates.Parameters, estimates.Correlation):
        public = [m for n, m in inspect.getmembers(thing) if not n.startswith("_") and "vaneloop" in str(m)]
        assert all(inspect.getdoc(m) for m in (thing, *public))
