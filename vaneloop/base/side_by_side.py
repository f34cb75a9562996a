"""Work on one item after the other, shared out among the threads that compiled code may use, or among processes.

Compiled loops and numpy's run side by side; the Python between them does not. So whole fits are shared out rather than
the few simulations that each asks for at one time: while one thread works out its next step, the other simulates.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from vaneloop.base.compiled import threads

__all__ = ["Answer", "Item", "Submit", "forks", "in_processes", "shared_out", "side_by_side"]

Item = TypeVar("Item")
Answer = TypeVar("Answer")
Submit = Callable[[Item], "Future[Answer]"]
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


def forks(workers: int, items: int) -> bool:
    """Whether ``items`` are worth ``workers`` processes, and this process may be forked.

    Only the main thread forks: locks that other callers' threads hold would stay locked in the new process.
    """
    main = threading.current_thread() is threading.main_thread()
    return workers > 1 and items > 1 and main and hasattr(os, "fork")


@contextmanager
def in_processes(f: Callable[[Any, Item], Answer], work: Any, workers: int) -> Iterator[Submit[Item, Answer]]:
    """Processes in which ``f(work, item)`` runs. They are forked, so ``work`` need not be sent to them: it may hold
    functions and memory that all share.
    """
    fork = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(workers, mp_context=fork, initializer=_begin, initargs=(f, work)) as pool:
        yield lambda item: pool.submit(_answer, item)


def _begin(f: Callable[[Any, Any], Any], work: Any) -> None:
    """Keep what a forked process was started for; it has no other work."""
    _here.f, _here.work = f, work


def _answer(item: Any) -> Any:
    return _here.f(_here.work, item)
