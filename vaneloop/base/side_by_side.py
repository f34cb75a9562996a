"""Work on one item after the other, shared out among the threads that compiled code may use.

Compiled loops and numpy's run side by side; the Python between them does not. So whole fits are shared out rather than
the few simulations that each asks for at one time: while one thread works out its next step, the other simulates.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from vaneloop.base.compiled import threads

__all__ = ["Answer", "Item", "shared_out", "side_by_side"]

Item = TypeVar("Item")
Answer = TypeVar("Answer")
_here = threading.local()


def shared_out() -> bool:
    """Whether this thread is one of several that share work: what it does is not shared out again."""
    return getattr(_here, "one_of_many", False)


def side_by_side(f: Callable[[Item], Answer], items: Iterable[Item], may: bool = True) -> Iterator[Answer]:
    """What ``f`` makes of each item, in their order; ``may``: whether calls may run at one time."""
    todo = list(items)
    many = min(threads(), len(todo))
    if not may or many < 2 or shared_out():
        yield from map(f, todo)
        return
    with ThreadPoolExecutor(many, initializer=setattr, initargs=(_here, "one_of_many", True)) as pool:
        try:
            yield from pool.map(f, todo)
        finally:  # what is left of an answer that nobody waits for
            pool.shutdown(cancel_futures=True)
