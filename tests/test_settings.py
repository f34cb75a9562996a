"""The thresholds of the identification stand once, in `vaneloop/identification/settings.py`, and docs/settings.md lists
them.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.settings import PAGE, page, record
from tests.conftest import ROOT
from tests.syntax import nodes
from vaneloop.identification import settings

PACKAGE = ROOT / "vaneloop" / "identification"
KINDS = ("principle", "physics", "numerics", "benchmark", "budget of work", "judgement")
# Numbers that decide nothing: what they count is laid out in arrays and codes, and any other would do as well.
LAYOUT = {
    "candidates/laws.py": {"MEMORY", "PARAMETERS"},  # columns of a law's state and parameters
    "user_models/terms.py": {"INPUT", "OUTPUT", "COLUMN", "NOTHING", "HOW"},  # numbers of quantities and of places
    "user_models/system.py": {"MOST_PARAMETERS", "MOST_MEMORY", "FIRST_CODE"},  # room of users' laws; their codes
    "unmodelled/curve_candidates.py": {"JUMP"},  # index of an amplitude that is of no function of the basis
    "unmodelled/fitted_candidate.py": {"MEASURED"},  # rank in an order
    "unmodelled/spectral_lines.py": {"ALONE"},  # one harmonic, beside the threshold of a line
    "vane_chain/parameters.py": {"BOTH"},  # a code, beside the numbers of two sides
}  # fmt: skip


def numeric(node: ast.expr) -> bool:
    """Whether an expression is a number, or made of some by arithmetic, tuples, lists and the values of a table."""
    match node:
        case ast.Constant(value=value):
            return isinstance(value, int | float) and not isinstance(value, bool)
        case ast.UnaryOp(operand=operand):
            return numeric(operand)
        case ast.BinOp(left=left, right=right):
            return numeric(left) or numeric(right)
        case ast.Tuple(elts=parts) | ast.List(elts=parts) | ast.Set(elts=parts):
            return any(map(numeric, parts))
        case ast.Dict(values=parts):
            return any(map(numeric, parts))
        case _:
            return False


def constants(tree: ast.Module) -> Iterator[str]:
    """Names that a module gives numbers to."""
    for s in tree.body:
        if isinstance(s, ast.Assign):
            targets, value = s.targets, s.value
        elif isinstance(s, ast.AnnAssign) and s.value is not None:
            targets, value = [s.target], s.value
        else:
            continue
        for target in targets:
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = list(zip(target.elts, value.elts, strict=True))
            else:
                pairs = [(target, value)]
            yield from (t.id for t, v in pairs if isinstance(t, ast.Name) and numeric(v))


def modules() -> Iterator[tuple[str, tuple[ast.AST, ...]]]:
    """Every other module of the package, and its nodes."""
    for f in sorted(PACKAGE.rglob("*.py")):
        if f.name != "settings.py":
            yield str(f.relative_to(PACKAGE)), nodes(f.read_text(encoding="utf-8"))


def test_what_a_number_is() -> None:
    source = "A = 1\nB, C = -0.5, 'c'\nD: float = 2 * B\nE = {'e': (1, 2)}\nF = G = [3.0]\nH = True\nK = f(1)\nL = A\n"
    assert list(constants(ast.parse(source))) == ["A", "B", "D", "E", "F", "G"]


def test_no_threshold_stands_outside_the_record() -> None:
    found = {name: set(constants(found[0])) for name, found in modules()}
    assert {name: numbers for name, numbers in found.items() if numbers} == LAYOUT


def test_every_name_stands_once_with_unit_meaning_and_origin() -> None:
    found = record()
    assert [n for n, times in Counter(s.name for s in found).items() if times > 1] == []
    assert {s.name for s in found} == {n for n in vars(settings) if n.isidentifier() and not n.startswith("_")}
    for s in found:
        assert s.name.isupper() and s.heading, s.name
        assert re.fullmatch(r"[A-Z].{15,}\.", s.meaning) and ". " not in s.meaning, (s.name, s.meaning)
        kind, _, reason = s.origin.partition(": ")
        assert kind in KINDS and len(reason) > 3, (s.name, s.origin)
        assert "|" not in s.unit + s.meaning + s.origin, s.name


@pytest.mark.parametrize("below", ["", '"""mm. It ends here. numerics: 2 bits"""', '"""mm: It ends here"""'])
def test_a_threshold_of_which_nothing_is_said_is_named(
    below: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "settings.py"
    file.write_text(f"# ---- Ends ----\nLIMIT = 4.0\n{below}\nLAST = 1.0\n")
    monkeypatch.setattr(settings, "__file__", str(file))
    with pytest.raises(ValueError, match="LIMIT"):
        record()


def test_every_threshold_decides_something() -> None:
    read = {n.id for _, found in modules() for n in found if isinstance(n, ast.Name)}
    own = {n.id for n in ast.walk(ast.parse(Path(settings.__file__).read_text()))
           if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)}  # fmt: skip
    imported = {
        a.name
        for _, found in modules()
        for n in found
        if isinstance(n, ast.ImportFrom) and n.module == settings.__name__
        for a in n.names
    }
    assert {s.name for s in record()} - own == imported - own and imported <= read


def test_the_record_depends_on_nothing_of_the_program() -> None:
    tree = ast.parse(Path(settings.__file__).read_text())
    assert not [n for n in ast.walk(tree) if isinstance(n, ast.Import | ast.ImportFrom)]


def test_the_page_is_up_to_date() -> None:
    assert PAGE.read_text() == page(), "python -m benchmarks.settings --write"
