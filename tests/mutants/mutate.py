"""Small wrong changes to a module: each operator, comparison, number and statement in turn, one change at a time."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType

__all__ = ["Mutant", "mutants_of", "with_hits"]

COMPARISONS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,),
}  # fmt: skip
OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitOr,
}  # fmt: skip
NAMES = {"min": "max", "max": "min"}
SHRUNK, GROWN = 0.8, 1.25
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(frozen=True)
class Mutant:
    """One change.

    file, where   path from the root, and the function ("" = a constant of the module)
    line, last    of the statement
    was, becomes  the statement, or the head of a compound one
    nth           which of the changes that read alike, from 1
    code          compiles the changed function, or the changed module
    """

    file: str
    where: str
    line: int
    last: int
    was: str
    becomes: str
    nth: int
    code: Callable[[], CodeType]

    @property
    def name(self) -> str:
        """What it is, wherever its line moves."""
        again = f" (#{self.nth})" if self.nth > 1 else ""
        return f"{self.file} {self.where or 'module'}: `{self.was}` -> `{self.becomes}`{again}"

    def __str__(self) -> str:
        return self.name.replace(" ", f":{self.line} ", 1)


@dataclass(frozen=True)
class _Edit:
    owner: object
    field: str
    index: int | None
    new: object

    def swap(self, value: object) -> object:
        """Put ``value`` in the place and return what was there."""
        if self.index is None:
            old = getattr(self.owner, self.field)
            setattr(self.owner, self.field, value)
        else:
            place = getattr(self.owner, self.field)
            old, place[self.index] = place[self.index], value
        return old


def _number(value: float) -> list[ast.expr]:
    if isinstance(value, int):
        return [ast.Constant(value + 1)]
    return [ast.Constant(1.0 if value == 0.0 else value * GROWN)]


def _of_expression(owner: ast.AST, field: str, index: int | None, node: ast.AST) -> Iterator[_Edit]:
    """Changes of one expression that stands in ``owner.field[index]``."""
    if isinstance(node, ast.Compare):
        for i, op in enumerate(node.ops):
            for other in COMPARISONS.get(type(op), ()):
                yield _Edit(node, "ops", i, other())
    elif isinstance(node, (ast.BinOp, ast.AugAssign)):
        if type(node.op) in OPERATORS:
            yield _Edit(node, "op", None, OPERATORS[type(node.op)]())
    elif isinstance(node, ast.BoolOp):
        yield _Edit(node, "op", None, ast.And() if isinstance(node.op, ast.Or) else ast.Or())
    elif isinstance(node, ast.UnaryOp):
        if isinstance(node.op, (ast.Not, ast.USub, ast.Invert)):
            yield _Edit(owner, field, index, node.operand)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        if node.func.id in NAMES and len(node.args) > 1:
            yield _Edit(node, "func", None, ast.Name(NAMES[node.func.id], ast.Load()))
        elif node.func.id == "abs":
            yield _Edit(owner, field, index, node.args[0])
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        for new in _number(node.value):
            yield _Edit(owner, field, index, new)
    elif isinstance(node, ast.Constant) and type(node.value) is bool:
        yield _Edit(owner, field, index, ast.Constant(not node.value))
    if field == "test" and not isinstance(node, (ast.Compare, ast.BoolOp, ast.UnaryOp, ast.Constant)):
        yield _Edit(owner, field, index, ast.UnaryOp(ast.Not(), node))  # type: ignore[arg-type]


_SKIPPED = {"annotation", "returns", "decorator_list", "args_defaults", "body", "orelse", "finalbody", "handlers"}


def _edits(owner: ast.AST) -> Iterator[_Edit]:
    """Changes of the expressions of one statement, not of the statements in it."""
    for field, value in ast.iter_fields(owner):
        if field in _SKIPPED and isinstance(owner, ast.stmt):
            continue
        for i, node in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(node, ast.JoinedStr) or not isinstance(node, ast.AST):
                continue
            yield from _of_expression(owner, field, i, node)
            yield from _edits(node)


def _statements(body: list[ast.stmt], owner: ast.AST, field: str) -> Iterator[tuple[ast.AST, str, int, ast.stmt]]:
    for i, s in enumerate(body):
        yield owner, field, i, s
        for inner in ("body", "orelse", "finalbody"):
            if not isinstance(s, (*FUNCTIONS, ast.ClassDef)):
                yield from _statements(getattr(s, inner, []), s, inner)


def _can_go(s: ast.stmt) -> bool:
    """Is it a statement whose removal still is a program that means something?"""
    if isinstance(s, ast.Assign):
        return any(not isinstance(t, ast.Name) for t in s.targets)
    if isinstance(s, ast.Expr):
        return isinstance(s.value, ast.Call)
    return isinstance(s, (ast.AugAssign, ast.Continue, ast.Break)) or (isinstance(s, ast.Return) and s.value is None)


def _text(s: ast.stmt) -> str:
    if isinstance(s, (ast.If, ast.While)):
        return f"{type(s).__name__.lower()} {ast.unparse(s.test)}"
    if isinstance(s, ast.For):
        return f"for {ast.unparse(s.target)} in {ast.unparse(s.iter)}"
    if isinstance(s, ast.With):
        return "with " + ", ".join(ast.unparse(i) for i in s.items)
    return ast.unparse(s)


def _code_of(function: ast.FunctionDef) -> CodeType:
    decorators, function.decorator_list = function.decorator_list, []
    try:
        module = ast.Module([function], [])
        code = compile(ast.fix_missing_locations(module), "<mutant>", "exec")
    finally:
        function.decorator_list = decorators
    return next(c for c in code.co_consts if isinstance(c, CodeType) and c.co_name == function.name)


def _functions(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef]]:
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, node
        elif isinstance(node, ast.ClassDef):
            for inner in node.body:
                if isinstance(inner, ast.FunctionDef):
                    yield f"{node.name}.{inner.name}", inner


def _changes(s: ast.stmt, owner: ast.AST, field: str, at: int) -> Iterator[_Edit]:
    if isinstance(s, (ast.Raise, ast.Assert, ast.Import, ast.ImportFrom, ast.ClassDef, *FUNCTIONS)):
        return
    if isinstance(s, ast.AugAssign):
        yield from _of_expression(owner, field, at, s)
    yield from _edits(s)
    if _can_go(s):
        yield _Edit(owner, field, at, ast.Pass())


def _constants(tree: ast.Module) -> Iterator[tuple[ast.stmt, _Edit]]:
    """The numbers of the module's own lines, smaller and greater: what they decide must be tested on both sides."""
    for s in tree.body:
        if not isinstance(s, (ast.Assign, ast.AnnAssign)) or s.value is None:
            continue
        if isinstance(s.value, ast.Call) and ast.unparse(s.value.func) == "njit":
            continue  # how it is compiled
        for edit in _edits(s):
            if isinstance(edit.new, ast.Constant):
                place = getattr(edit.owner, edit.field)
                old = place if edit.index is None else place[edit.index]
                if isinstance(old, ast.Constant) and type(old.value) is float and old.value != 0.0:
                    for factor in (SHRUNK, GROWN):
                        yield s, _Edit(edit.owner, edit.field, edit.index, ast.Constant(old.value * factor))
                    continue
                if (
                    isinstance(old, ast.Constant)
                    and type(old.value) is int
                    and old.value >= 1000
                    and old.value % 100 == 0
                ):
                    for factor in (SHRUNK, GROWN):
                        yield s, _Edit(edit.owner, edit.field, edit.index, ast.Constant(int(old.value * factor)))
                    continue
            yield s, edit


def mutants_of(
    root: Path, file: str, *, functions: bool = True, constants: bool = True, only: str | None = None
) -> list[Mutant]:
    """Return every mutant of ``file``: of its functions (``only`` that one) and of the module's constants, in the order
    of the lines.
    """
    tree = ast.parse((root / file).read_text(), file)
    seen: Counter[tuple[str, str, str]] = Counter()
    out: list[Mutant] = []

    def add(where: str, s: ast.stmt, edit: _Edit, compiled: Callable[[], CodeType]) -> None:
        was = _text(s)
        old = edit.swap(edit.new)
        becomes = "pass" if isinstance(edit.new, ast.Pass) else _text(s)
        edit.swap(old)
        seen[where, was, becomes] += 1

        def code() -> CodeType:
            kept = edit.swap(edit.new)
            try:
                return compiled()
            finally:
                edit.swap(kept)

        head = s.test if isinstance(s, (ast.If, ast.While)) else s.iter if isinstance(s, ast.For) else s
        out.append(
            Mutant(file, where, s.lineno, head.end_lineno or s.lineno, was, becomes, seen[where, was, becomes], code)
        )

    if constants:
        for s, edit in _constants(tree):
            add("", s, edit, lambda: compile(ast.fix_missing_locations(tree), file, "exec"))
    if functions:
        for name, f in _functions(tree):
            if only in (None, name):
                for owner, field, at, s in _statements(f.body, f, "body"):
                    for edit in _changes(s, owner, field, at):
                        add(name, s, edit, lambda f=f: _code_of(f))
    return sorted(out, key=lambda m: m.line)


def with_hits(root: Path, file: str) -> Iterator[tuple[str, CodeType]]:
    """Every function of ``file`` by name, with a call ``__hit__(file, line)`` before each statement."""
    tree = ast.parse((root / file).read_text(), file)
    for name, f in _functions(tree):
        _mark(f, file)
        yield name, _code_of(f)


def _mark(node: ast.AST, file: str) -> None:
    for field in ("body", "orelse", "finalbody"):
        body = getattr(node, field, None)
        if not body or isinstance(node, (ast.Lambda, ast.IfExp)):
            continue
        marked: list[ast.stmt] = []
        for s in body:
            _mark(s, file)
            hit = ast.Call(ast.Name("__hit__", ast.Load()), [ast.Constant((file, s.lineno))], [])
            marked += [ast.copy_location(ast.Expr(hit), s), s]
        setattr(node, field, marked)
