"""Small wrong changes to a module: each operator, comparison, number and statement in turn, one change at a time.

What numba compiles keeps the code and the numbers that it was compiled from. Where it does run compiled, neither such a
function is changed nor a number that one reads.
"""

from __future__ import annotations

import ast
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from types import CodeType
from typing import cast

__all__ = ["Derived", "Mutant", "derived_from", "made_of", "mentions", "mutants_of", "own_names", "with_hits"]

COMPARISONS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
}  # fmt: skip
OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitOr,
}  # fmt: skip
NAMES = {"min": "max", "max": "min"}
SHRUNK, GROWN = 0.8, 1.25
AROUND = 60  # characters of a long statement that are shown before and behind what changes
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
Function = ast.FunctionDef | ast.AsyncFunctionDef
# The decorators of what numba compiles (vaneloop/base/compiled.py), and what takes a function to generate such code.
COMPILERS = {
    "compiled", "compiled_free", "fused", "in_place", "in_place_free", "inlined", "intrinsic", "jit", "njit", "overload"
}  # fmt: skip
PRODUCT = ("controller", "plant", "hil", "vaneloop")
FUNCTION, MODULE, FIELD, DEFAULT = "function", "module", "field", "default"


@dataclass(frozen=True)
class Mutant:
    """One change.

    file, where   path from the root, and the function or class ("" = a constant of the module)
    line, last    of the statement
    was, becomes  the statement, or the head of a compound one
    nth           which of the changes that read alike, from 1
    code          compiles the changed function; else what gives ``names`` their new values
    kind          what is changed: a FUNCTION's code, a constant of the MODULE, the default of a FIELD of a class, the
                  DEFAULT of an argument
    names         those constants, that field, that argument
    """

    file: str
    where: str
    line: int
    last: int
    was: str
    becomes: str
    nth: int
    code: Callable[[], CodeType]
    kind: str = FUNCTION
    names: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """What it is, wherever its line moves."""
        again = f" (#{self.nth})" if self.nth > 1 else ""
        return f"{self.file} {self.where or 'module'}: `{self.was}` -> `{self.becomes}`{again}"

    def __str__(self) -> str:
        was, becomes = _around(self.was, self.becomes)
        return f"{self.file}:{self.line} {self.where or 'module'}: `{was}` -> `{becomes}`"


def _around(a: str, b: str) -> tuple[str, str]:
    """Of two long texts what differs, with something around it."""
    first = len(os.path.commonprefix([a, b]))
    last = len(os.path.commonprefix([a[first:][::-1], b[first:][::-1]]))

    def part(text: str) -> str:
        end = len(text) - last
        before, after = max(first - AROUND, 0), min(end + AROUND, len(text))
        return ("... " if before else "") + text[before:after] + (" ..." if after < len(text) else "")

    return (part(a), part(b)) if max(len(a), len(b)) > 4 * AROUND else (a, b)


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
        if type(node.op) in OPERATORS and not _is_of_text(node):  # else an error that tells nothing
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
        for new in _number(cast("float", node.value)):
            yield _Edit(owner, field, index, new)
    elif isinstance(node, ast.Constant) and type(node.value) is bool:
        yield _Edit(owner, field, index, ast.Constant(not node.value))
    if field in ("test", "ifs") and not isinstance(node, (ast.Compare, ast.BoolOp, ast.UnaryOp, ast.Constant)):
        yield _Edit(owner, field, index, ast.UnaryOp(ast.Not(), node))  # type: ignore[arg-type]


def _is_of_text(node: ast.BinOp | ast.AugAssign) -> bool:
    """Text, or a type: "or None"."""
    return any(
        isinstance(n, ast.JoinedStr) or (isinstance(n, ast.Constant) and isinstance(n.value, (str, bytes, type(None))))
        for n in ast.iter_child_nodes(node)
    )


_SKIPPED = {"annotation", "returns", "decorator_list", "args_defaults", "body", "orelse", "finalbody", "handlers"}


def _edits(owner: ast.AST) -> Iterator[_Edit]:
    """Changes of the expressions of one statement, not of the statements in it."""
    for field, value in ast.iter_fields(owner):
        if field in _SKIPPED and isinstance(owner, ast.stmt):
            continue
        for i, node in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(node, ast.JoinedStr) or not isinstance(node, ast.AST):
                continue
            if isinstance(node, ast.keyword) and node.arg == "strict":
                continue  # of a zip: it asserts
            yield from _of_expression(owner, field, i, node)
            if not (isinstance(node, ast.UnaryOp) and _is_reshape(owner)):  # numpy takes any length below 0 for -1
                yield from _edits(node)


def _is_reshape(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "reshape"


def _statements(body: list[ast.stmt], owner: ast.AST, field: str) -> Iterator[tuple[ast.AST, str, int, ast.stmt]]:
    for i, s in enumerate(body):
        yield owner, field, i, s
        if isinstance(s, ast.ClassDef) or (isinstance(s, FUNCTIONS) and _is_compiled(s)):
            continue
        for inner in ("body", "orelse", "finalbody"):
            yield from _statements(getattr(s, inner, []), s, inner)
        for part in (*getattr(s, "handlers", []), *getattr(s, "cases", [])):
            yield from _statements(part.body, part, "body")


def _is_compiled(function: Function) -> bool:
    return any(
        isinstance(n, ast.Name) and n.id in COMPILERS
        for d in function.decorator_list
        for n in [d.func if isinstance(d, ast.Call) else d]
    )


def _can_go(s: ast.stmt) -> bool:
    """Is it a statement whose removal still is a program that means something?"""
    if isinstance(s, ast.Assign):
        places = [e for t in s.targets for e in (t.elts if isinstance(t, ast.Tuple) else [t])]
        return any(not isinstance(t, ast.Name) for t in places)
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


def _code_of(path: str, function: Function, knows_class: bool = False) -> CodeType:
    """Compile the function named by ``path`` ("Class.function") as it stands in its class; ``knows_class``: as one that
    asks for that, even if it does no more.
    """
    decorators, function.decorator_list = function.decorator_list, []
    if knows_class:
        function.body.append(ast.copy_location(ast.Expr(ast.Name("__class__", ast.Load())), function.body[-1]))
    inside: ast.stmt = function
    path = path.removesuffix(".setter")
    for owner in reversed(path.split(".")[:-1]):
        inside = ast.ClassDef(owner, [], [], [inside], [])
        ast.copy_location(inside, function)
    try:
        code = compile(ast.fix_missing_locations(ast.Module([inside], [])), "<mutant>", "exec")
    finally:
        function.decorator_list = decorators
        if knows_class:
            function.body.pop()
    for part in path.split("."):
        code = next(c for c in code.co_consts if isinstance(c, CodeType) and c.co_name == part)
    return code


def _code_of_statement(s: ast.stmt) -> CodeType:
    if isinstance(s, ast.AnnAssign):  # a field: what it is annotated with is of no matter
        s = ast.copy_location(ast.Assign([s.target], s.value or ast.Constant(None)), s)
    return compile(ast.fix_missing_locations(ast.Module([s], [])), "<mutant>", "exec")


def _code_of_value(name: str, value: Callable[[], ast.expr]) -> CodeType:
    s = ast.Assign([ast.Name(name, ast.Store())], value())
    return _code_of_statement(ast.copy_location(s, value()))


def _text_of_value(name: str, value: Callable[[], ast.expr]) -> str:
    return f"{name}={ast.unparse(value())}"


def _functions(tree: ast.Module, compiled: bool) -> Iterator[tuple[str, Function]]:
    """Every function by its path, ``compiled`` those that numba compiles, too."""
    generators = {
        a.id
        for n in ast.walk(tree)
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Name) and n.func.id in COMPILERS
        for a in n.args
        if isinstance(a, ast.Name)
    }

    def within(body: list[ast.stmt], path: str) -> Iterator[tuple[str, Function]]:
        for node in body:
            if isinstance(node, FUNCTIONS):
                if compiled or not (_is_compiled(node) or node.name in generators):
                    sets = any(isinstance(d, ast.Attribute) and d.attr == "setter" for d in node.decorator_list)
                    yield path + node.name + (".setter" if sets else ""), node
            elif isinstance(node, ast.ClassDef):
                yield from within(node.body, f"{path}{node.name}.")

    return within(tree.body, "")


def _classes(body: list[ast.stmt], path: str = "") -> Iterator[tuple[str, ast.ClassDef]]:
    for node in body:
        if isinstance(node, ast.ClassDef):
            yield path + node.name, node
            yield from _classes(node.body, f"{path}{node.name}.")


def _changes(s: ast.stmt, owner: ast.AST, field: str, at: int) -> Iterator[_Edit]:
    if isinstance(s, (ast.Raise, ast.Assert, ast.Import, ast.ImportFrom, ast.ClassDef, ast.Match, *FUNCTIONS)):
        return
    if isinstance(s, ast.AugAssign):
        yield from _of_expression(owner, field, at, s)
    yield from _edits(s)
    if _can_go(s):
        yield _Edit(owner, field, at, ast.Pass())


def _constants(body: list[ast.stmt]) -> Iterator[tuple[ast.stmt, _Edit]]:
    """The numbers of the module's or a class's own lines, smaller and greater: what they decide must be tested on both
    sides.
    """
    for s in body:
        if not isinstance(s, (ast.Assign, ast.AnnAssign)) or s.value is None:
            continue
        if isinstance(s.value, ast.Call) and ast.unparse(s.value.func) == "njit":
            continue  # how it is compiled
        if isinstance(s.value, ast.Subscript) and ast.unparse(s.value.value) == "Annotated":
            continue  # a type: classes keep what was made of it
        for edit in _edits(s):
            yield from ((s, e) for e in _both_ways(edit))


def _both_ways(edit: _Edit) -> Iterator[_Edit]:
    if isinstance(edit.new, ast.Constant):
        place = getattr(edit.owner, edit.field)
        old = place if edit.index is None else place[edit.index]
        if isinstance(old, ast.Constant) and type(old.value) is float and old.value != 0.0:
            for factor in (SHRUNK, GROWN):
                yield _Edit(edit.owner, edit.field, edit.index, ast.Constant(old.value * factor))
            return
        if isinstance(old, ast.Constant) and type(old.value) is int and old.value >= 1000 and old.value % 100 == 0:
            for factor in (SHRUNK, GROWN):
                yield _Edit(edit.owner, edit.field, edit.index, ast.Constant(int(old.value * factor)))
            return
    yield edit


def _fields(body: list[ast.stmt]) -> Iterator[tuple[str, ast.ClassDef, ast.stmt, _Edit]]:
    """The numbers that a class gives its fields, where a changed one can be put in its place: not of an enumeration,
    nor of what is made by a function later.
    """
    for path, c in _classes(body):
        if any("Enum" in ast.unparse(b) or "Flag" in ast.unparse(b) for b in c.bases):
            continue
        for s, edit in _constants(c.body):
            value = s.value if isinstance(s, (ast.Assign, ast.AnnAssign)) else None
            if not isinstance(value, ast.Call):
                yield path, c, s, edit


def _defaults(function: Function) -> Iterator[tuple[str, Callable[[], ast.expr], _Edit]]:
    """Of each argument that has a number as its default: its name, the default as it is then, the change."""
    for argument, field, i in _arguments(function):
        value = getattr(function.args, field)[i]
        for edit in (*_of_expression(function.args, field, i, value), *_edits(value)):
            yield argument, partial(_default, function, field, i), edit


def _default(function: Function, field: str, i: int) -> ast.expr:
    value: ast.expr = getattr(function.args, field)[i]
    return value


def _arguments(function: Function) -> Iterator[tuple[str, str, int]]:
    """Every argument with a default, and where that stands: in which list of the tree, and at which place."""
    a = function.args
    by_place = [*a.posonlyargs, *a.args]
    yield from ((n.arg, "defaults", i) for i, n in enumerate(by_place[len(by_place) - len(a.defaults) :]))
    yield from ((n.arg, "kw_defaults", i) for i, n in enumerate(a.kwonlyargs) if a.kw_defaults[i] is not None)


def _names_of(s: ast.stmt) -> tuple[str, ...]:
    targets = s.targets if isinstance(s, ast.Assign) else [s.target] if isinstance(s, ast.AnnAssign) else []
    return tuple(n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name))


def _read(node: ast.AST) -> set[str]:
    return {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)}


@lru_cache(maxsize=4)
def _compiled_in(root: Path) -> frozenset[str]:
    """The names of the product's constants that compiled code was made from, through other constants too."""
    names: set[str] = set()
    made_of: dict[str, set[str]] = {}
    for f in (f for package in PRODUCT for f in (root / package).rglob("*.py")):
        tree = ast.parse(f.read_text())
        for function in (n for n in ast.walk(tree) if isinstance(n, FUNCTIONS) and _is_compiled(n)):
            names |= _read(function)
        for s in tree.body:
            for name in _names_of(s):
                made_of.setdefault(name, set()).update(_read(s))
    while more := {m for n in names for m in made_of.get(n, ())} - names:
        names |= more
    return frozenset(names)


def mutants_of(
    root: Path,
    file: str,
    *,
    functions: bool = True,
    constants: bool = True,
    only: str | None = None,
    compiled: bool = False,
    kernels: bool = False,
) -> list[Mutant]:
    """Return every mutant of ``file``: of its functions (``only`` that one), and of the module's and its classes'
    constants, in the order of the lines. ``compiled``: it runs compiled, so what numba compiles stays as it is.
    ``kernels``: nothing else is changed.
    """
    tree = ast.parse((root / file).read_text(), file)
    seen: Counter[tuple[str, str, str]] = Counter()
    out: list[Mutant] = []

    def add(
        where: str,
        s: ast.stmt,
        edit: _Edit,
        made: Callable[[], CodeType],
        kind: str = FUNCTION,
        names: tuple[str, ...] = (),
        text: Callable[[], str] | None = None,
    ) -> None:
        says = text or (lambda: _text(s))
        was = says()
        old = edit.swap(edit.new)
        becomes = "pass" if isinstance(edit.new, ast.Pass) else says()
        edit.swap(old)
        seen[where, was, becomes] += 1

        def code() -> CodeType:
            kept = edit.swap(edit.new)
            try:
                return made()
            finally:
                edit.swap(kept)

        head = s.test if isinstance(s, (ast.If, ast.While)) else s.iter if isinstance(s, ast.For) else s
        last = s.lineno if isinstance(s, (*FUNCTIONS, ast.With, ast.Try)) else head.end_lineno or s.lineno
        out.append(Mutant(file, where, s.lineno, last, was, becomes, seen[where, was, becomes], code, kind, names))

    if constants:
        fixed = _compiled_in(root) if compiled or kernels else frozenset()
        for s, edit in _constants(tree.body):
            is_fixed = bool(fixed.intersection(_names_of(s)))
            if not (is_fixed and compiled) and not (kernels and not is_fixed):
                add("", s, edit, partial(_code_of_statement, s), MODULE, _names_of(s))
        for path, _, s, edit in () if kernels else _fields(tree.body):
            add(path, s, edit, partial(_code_of_statement, s), FIELD, _names_of(s))
    if functions:
        plain = {name for name, _ in _functions(tree, False)} if kernels else ()
        for name, f in _functions(tree, not compiled):
            if only not in (None, name) or name in plain:
                continue
            knows = any(isinstance(n, ast.Name) and n.id in ("super", "__class__") for n in ast.walk(f))
            for owner, field, at, s in _statements(f.body, f, "body"):
                for edit in _changes(s, owner, field, at):
                    add(name, s, edit, partial(_code_of, name, f, knows))
            for argument, value, edit in _defaults(f):
                of = argument, value
                add(name, f, edit, partial(_code_of_value, *of), DEFAULT, (argument,), partial(_text_of_value, *of))
    return sorted(out, key=lambda m: m.line)


@dataclass(frozen=True)
class Derived:
    """What a module makes of its constants as it is imported: ``code`` gives ``names`` their values from those that it
    ``reads``. ``kind`` and ``where`` as of a `Mutant`.
    """

    kind: str
    where: str
    names: tuple[str, ...]
    reads: frozenset[str]
    code: CodeType


def derived_from(root: Path, file: str) -> list[Derived]:
    """Every constant, default of a field and default of an argument that is made of names, by their lines."""
    tree = ast.parse((root / file).read_text(), file)
    out: list[tuple[int, Derived]] = []

    def add(kind: str, where: str, names: tuple[str, ...], s: ast.stmt | ast.expr) -> None:
        if names and (reads := _read(s)):
            code = _code_of_statement(s) if isinstance(s, ast.stmt) else _code_of_value(names[0], lambda: s)
            out.append((s.lineno, Derived(kind, where, names, frozenset(reads), code)))

    for s in tree.body:
        if isinstance(s, (ast.Assign, ast.AnnAssign)) and s.value is not None:
            add(MODULE, "", _names_of(s), s)
    for path, c in _classes(tree.body):
        for s in c.body:
            if isinstance(s, (ast.Assign, ast.AnnAssign)) and s.value is not None and not isinstance(s.value, ast.Call):
                add(FIELD, path, _names_of(s), s.value)
    for path, f in _functions(tree, True):
        for argument, field, i in _arguments(f):
            add(DEFAULT, path, (argument,), _default(f, field, i))
    return [d for _, d in sorted(out, key=lambda d: d[0])]


@lru_cache(maxsize=256)
def made_of(root: Path, file: str, names: tuple[str, ...]) -> frozenset[str]:
    """These constants or classes, and the constants that the file makes of them."""
    out = set(names)
    for d in derived_from(root, file):  # in the order of the lines
        if d.kind == MODULE and d.reads & out:
            out.update(d.names)
    return frozenset(out)


def own_names(root: Path, file: str) -> set[str]:
    """The constants that stand in the file itself."""
    return {name for s in ast.parse((root / file).read_text(), file).body for name in _names_of(s)}


def mentions(root: Path, files: Iterable[str]) -> dict[str, set[tuple[str, int]]]:
    """By name, or name after a point: the statements of functions that mention it, by file and line. A constant that
    others of its module are made of is mentioned where those are.
    """
    out: dict[str, set[tuple[str, int]]] = {}
    made_of: list[tuple[str, set[str]]] = []
    for file in files:
        tree = ast.parse((root / file).read_text(), file)
        for s in tree.body:
            made_of += [(name, _read(s)) for name in _names_of(s)]
        for path, f in _functions(tree, True):
            first = (file, f.body[0].lineno)
            for node in ast.walk(f.args):
                if isinstance(node, ast.Name):
                    out.setdefault(node.id, set()).add(first)
            out.setdefault(f"{file} {path}", set()).add(first)
            for _, _, _, s in _statements(f.body, f, "body"):
                parts = [s.test] if isinstance(s, (ast.If, ast.While)) else [s]
                for node in (n for part in parts for n in ast.walk(part)):
                    if isinstance(node, (ast.Name, ast.Attribute)):
                        name = node.id if isinstance(node, ast.Name) else node.attr
                        out.setdefault(name, set()).add((file, s.lineno))
    for _ in range(3):  # through others that are made of it
        for name, reads in made_of:
            for read in reads:
                out.setdefault(read, set()).update(out.get(name, set()))
    return out


def with_hits(root: Path, file: str, *, compiled: bool = False) -> Iterator[tuple[str, CodeType]]:
    """Every function of ``file`` by name, with a call ``__hit__((file, line))`` before each statement. ``compiled`` as
    of `mutants_of`.
    """
    tree = ast.parse((root / file).read_text(), file)
    for name, f in _functions(tree, not compiled):
        _mark(f, file)
        yield name, _code_of(name, f)


def _mark(node: ast.AST, file: str) -> None:
    for part in (*getattr(node, "handlers", []), *getattr(node, "cases", [])):
        _mark(part, file)
    for field in ("body", "orelse", "finalbody"):
        body = getattr(node, field, None)
        if not body or isinstance(node, (ast.Lambda, ast.IfExp)):
            continue
        marked: list[ast.stmt] = []
        for s in body:
            if not (isinstance(s, FUNCTIONS) and _is_compiled(s)):
                _mark(s, file)
            hit = ast.Call(
                ast.Name("__hit__", ast.Load()),
                [ast.Tuple([ast.Constant(file), ast.Constant(s.lineno)], ast.Load())],
                [],
            )
            marked += [ast.copy_location(ast.Expr(hit), s), s]
        setattr(node, field, marked)
