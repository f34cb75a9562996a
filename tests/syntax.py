"""Syntax trees of the sources that tests read. Several tests read the same ones: each is parsed once in a process."""

from __future__ import annotations

import ast
from functools import cache

__all__ = ["nodes"]


@cache
def nodes(source: str) -> tuple[ast.AST, ...]:
    """All nodes of a module's syntax tree, the module first, as `ast.walk` gives them; not to be changed."""
    return tuple(ast.walk(ast.parse(source)))
