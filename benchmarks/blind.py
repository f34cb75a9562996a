"""What the blind benchmarks share: a run that goes on where it was stopped, what a log shows, what a learned curve is,
shares.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.stats import binomtest

from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.files import whole
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.vane_chain.chain import Chain

__all__ = [
    "INSIDE", "KINDS", "add_learn_options", "add_result_options", "add_run_options", "as_curve", "check_run",
    "detected", "print_shares", "read_rows", "run", "share", "write_rows",
]  # fmt: skip

Row = dict[str, Any]
KINDS = ("clean", "outside", "pair", "single")  # of what is hidden; outside: what the library does not have
SEEN = 3.0  # spreads of a noise floor
INSIDE = 0.90  # of the visited values: there the truth must be in the band of a curve that is the law


def add_learn_options(parser: argparse.ArgumentParser, laws: str) -> None:
    """Declare what is learned; ``laws``: what can be left out of the library."""
    parser.add_argument(
        "--learn", action="store_true", help="ask vaneloop learn, too: is the law that nobody listed found?"
    )
    parser.add_argument(
        "--leave-out",
        action="store_true",
        help=f"hide only {laws} of the library that are functions of one quantity, each taken out of the library: does "
        "vaneloop learn find it?",
    )


def add_run_options(parser: argparse.ArgumentParser, what: str, one: str, out: str) -> None:
    """Declare which of ``what`` (``one`` of them) are drawn, by how many workers, and the file of the results."""
    parser.add_argument(
        "--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND",
        help=f"draw only {what} of these kinds: {', '.join(KINDS)} (default: all)",
    )  # fmt: skip
    add_result_options(parser, what, one, out)


def add_result_options(parser: argparse.ArgumentParser, what: str, one: str, out: str) -> None:
    """Declare by how many workers ``what`` (``one`` of them) are diagnosed, and the file of the results."""
    parser.add_argument(
        "--workers", type=int, default=2, metavar="N", help=f"{what} diagnosed side by side (default 2)"
    )
    parser.add_argument(
        "--out", metavar="F.parquet", default=out, help=f"results, a row a {one}; an existing file is continued"
    )
    terminal.add_output_options(parser)


def check_run(args: argparse.Namespace, what: str) -> None:
    """Refuse a number of ``what``, workers or a seed that no run can have: InputError."""
    many = getattr(args, what)
    if not 1 <= many <= 100_000:
        raise InputError(f"--{what} (={many}) must be in [1, 100000]")
    if not 1 <= args.workers <= 64:
        raise InputError(f"--workers (={args.workers}) must be in [1, 64]")
    if args.seed is not None and not 0 <= args.seed < 2**63:
        raise InputError(f"--seed (={args.seed}) must be in [0, 2^63)")


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
    done = {r["index"] for r in rows}
    with (
        terminal.progress_bar(args, f"{many} {what}") as progress,
        ProcessPoolExecutor(args.workers, mp_context=multiprocessing.get_context("spawn")) as pool,
    ):
        jobs = [pool.submit(judge, seed, i, *more) for i in range(many) if i not in done]
        for job in as_completed(jobs):
            rows.append(job.result())
            write_rows(path, rows)
            if progress:
                progress(len(rows) / max(many, len(rows)))
    rows.sort(key=lambda r: r["index"])


def write_rows(path: Path, rows: list[Row]) -> None:
    """Write rows as a Parquet file; what a row does not say is null."""
    names = dict.fromkeys(name for row in rows for name in row)
    with whole(path) as part:
        pq.write_table(pa.table({n: [row.get(n) for row in rows] for n in names}), part)


def read_rows(path: Path, what: str) -> list[Row]:
    """Rows of an earlier run; InputError where the file is no result of ``what``."""
    try:
        return pq.read_table(path).to_pylist()
    except Exception as e:
        raise InputError(f"{path}: not a result of {what} ({type(e).__name__})") from None


def as_curve(law: Any, value: Callable[[Any], Any], forms: Iterable[str]) -> Row:
    """How far a learned law is the true one, where the logs have been.

    value  the true curve; ``forms``: names of the formulas that it is

    inside   share of the visited values at which the truth is in the curve's band. What the answer says that the logs
             do not tell, a constant or a slope, is taken as the truth has it.
    formula  whether one of ``forms`` is among those given; None: the truth has no formula
    """
    weight = np.interp(law.x, 0.5 * (law.edges[1:] + law.edges[:-1]), law.visited)
    visited = weight > 0.0
    x, w = law.x[visited], weight[visited]
    off = law.y[visited] - value(x)
    if law.untold:  # a slope that a gain takes makes the rest larger by as much, but no constant
        larger = [2] if 1 in law.untold and np.ptp(value(x)) > 0.0 else []
        lines = np.stack([(np.ones(len(x)), x, value(x))[k] for k in (*law.untold, *larger)])
        off = off - np.linalg.lstsq((lines * np.sqrt(w)).T, off * np.sqrt(w), rcond=1e-9)[0] @ lines
    low, high = (law.low - law.y)[visited], (law.high - law.y)[visited]
    within = (low <= -off) & (-off <= high)
    given = {f.form for f in law.formulas}
    return {"inside": float(w[within].sum() / w.sum()), "formula": bool(given & set(forms)) if forms else None}


def detected(hidden: Chain, clean: Chain) -> bool:
    """Whether a log shows what is hidden in it: in a subsystem the nominal model's held-out error, refitted, is worse
    than that of the same machine without it by more than `SEEN` spreads of the floor.
    """
    worse = 0.0
    for s in hidden.stages:
        without = next((c for c in clean.stages if c.name == s.name), None)
        if without is None or without.floor is None:
            continue
        judges = [LeastSquaresProblem(x, without.floor) for x in (s, without)]
        a, b = (float(np.sqrt(j.fit((), j.stage.neutral()).held_out.sum() / j.n)) for j in judges)
        worse = max(worse, (a - b) * np.sqrt(2.0 * judges[1].n))
    return bool(worse > SEEN)


def share(hits: list[bool]) -> dict[str, Any]:
    """A share with its 90 % binomial interval (Wilson)."""
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
