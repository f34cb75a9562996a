"""What the two blind benchmarks share: modules of the checkout, a run that goes on where it was stopped, shares."""

from __future__ import annotations

import argparse
import importlib
import multiprocessing
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from vaneloop.base import terminal
from vaneloop.base.errors import InputError

__all__ = ["from_checkout", "print_shares", "run", "share"]

Row = dict[str, Any]


def from_checkout(names: Iterable[str], needed: str) -> tuple[Any, ...]:
    """Modules that stand under ``tests`` in a checkout; InputError says what is ``needed`` where there is none."""
    root = str(Path(__file__).resolve().parents[2])  # the checkout, where this is one
    if root not in sys.path:
        sys.path.append(root)
    try:
        return tuple(importlib.import_module(n) for n in names)
    except ImportError:
        raise InputError(f"{needed}: run it from a checkout of the repository") from None


def run(
    args: argparse.Namespace,
    what: str,
    many: int,
    rows: list[Row],
    path: Path,
    judge: Callable[..., Row],
    seed: int,
    *more: Any,
) -> None:
    """Judge what ``rows`` lacks of ``many`` cases, side by side; ``path`` has every row as soon as it is there.

    what   the cases, in words
    judge  function from seed, index and ``more`` to a row
    """
    import polars as pl

    done = {r["index"] for r in rows}
    with (
        terminal.progress_bar(args, f"{many} {what}") as progress,
        ProcessPoolExecutor(args.workers, mp_context=multiprocessing.get_context("spawn")) as pool,
    ):
        jobs = [pool.submit(judge, seed, i, *more) for i in range(many) if i not in done]
        for job in as_completed(jobs):
            rows.append(job.result())
            pl.DataFrame(rows, infer_schema_length=None).write_parquet(path)
            if progress:
                progress(len(rows) / max(many, len(rows)))
    rows.sort(key=lambda r: r["index"])


def share(hits: list[bool]) -> dict[str, Any]:
    """A share with its 90 % binomial interval (Wilson)."""
    from scipy.stats import binomtest

    n, k = len(hits), sum(hits)
    low, high = binomtest(k, n).proportion_ci(0.90, "wilson") if n else (0.0, 1.0)
    return {"share": k / n if n else None, "low": float(low), "high": float(high), "hits": k, "of": n}


def print_shares(args: argparse.Namespace, title: str, summary: dict[str, Any]) -> None:
    """Print the shares of a summary, a line each."""
    table = [
        [
            k,
            f"{v['hits']} of {v['of']}",
            "-" if v["share"] is None else f"{v['share']:.3f}",
            f"{v['low']:.3f} to {v['high']:.3f}",
        ]
        for k, v in summary.items()
        if isinstance(v, dict)
    ]
    terminal.print_table(args, title, ["what", "count", "share", "90 % interval"], table)
