"""``python -m benchmarks [--all | WORD ...]``: measure, print each row and write it when it is measured.

Without more, what takes some five minutes together (`QUICK`); ``--all``: everything; words: what has one of them in its
name. benchmarks/results/latest.json is written anew after each row. Never fails for a slow figure.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks import bus, fleet, learn, long_log, measure, native, sizes, tools, web
from benchmarks.measure import ROOT, Row, machine
from vaneloop.base.errors import InputError
from vaneloop.base.files import write

MEASUREMENTS = {
    **measure.MEASUREMENTS, **native.MEASUREMENTS, **bus.MEASUREMENTS, **tools.MEASUREMENTS, **web.MEASUREMENTS,
    **fleet.MEASUREMENTS, **long_log.MEASUREMENTS, **learn.MEASUREMENTS, **sizes.MEASUREMENTS,
}  # fmt: skip
QUICK = (
    "the loop in C", "the loop in lanes", "the loop in python-control", "the loop in pathsim", "the interpreted loop",
    "start of the command", "replay of a long log", "the search for effects", "a controller of one's own",
    "the loop with every CAN frame", "decoding of logs", "the embedded bus", "tools on the bus: a tick's time",
    "curves side by side", "installation sizes",
)  # fmt: skip
RESULT = ROOT / "benchmarks" / "results" / "latest.json"
COLUMNS = ("what", "ours", "peer", "ratio", "target", "held", "note")


def main(words: list[str] | None = None, result: Path = RESULT) -> None:
    """Run the measurements; one that cannot run says why in its row."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="How fast it is (docs/benchmarks.md).")
    parser.add_argument("words", metavar="WORD", nargs="*", help="only what has one of the words in its name")
    parser.add_argument("--all", action="store_true", help="everything, and not only what takes some five minutes")
    args = parser.parse_args(words)
    chosen = MEASUREMENTS if args.all or args.words else {name: MEASUREMENTS[name] for name in QUICK}
    chosen = {name: of for name, of in chosen.items() if not args.words or any(w in name for w in args.words)}
    if not chosen:
        parser.error(f"{' '.join(args.words)} is in no name; names: {', '.join(MEASUREMENTS)}")
    console = Console(markup=False, width=None if sys.stdout.isatty() else 160)
    host = machine()
    console.print("  ".join(f"{k} {v}" for k, v in host.items()))
    rows: list[Row] = []

    def kept(row: Row, left: list[str]) -> None:
        rows.append(row)
        console.print(f"      {line(row)}")
        data = {"machine": host, "rows": [asdict(r) for r in rows], "left": left}
        try:
            result.parent.mkdir(exist_ok=True)
            write(result, json.dumps(data, indent=2) + "\n")
        except (OSError, InputError) as e:
            console.print(f"      {result.name} cannot be written: {e}")

    for i, (name, rows_of) in enumerate(chosen.items()):
        console.print(f"[{i + 1}/{len(chosen)}] measuring {name} ...")
        started = time.perf_counter()
        for row in rows_or_why(name, rows_of):
            kept(row, list(chosen)[i + 1 :])
        console.print(f"      {time.perf_counter() - started:.0f} s")
    console.print(table(rows))
    console.print(f"written: {result}")


def rows_or_why(name: str, rows_of: Callable[[], Iterable[Row]]) -> Iterable[Row]:
    """Rows as they are measured; where a measurement fails, a last one that says why."""
    try:
        yield from rows_of()
    except Exception as e:  # a benchmark reports, it does not fail
        yield Row(name, "not measured", note=f"{type(e).__name__}: {e}".splitlines()[0][:200])


def cells(r: Row) -> list[str]:
    """What the table says of a row, by `COLUMNS`."""
    ratio = "" if r.ratio is None else f"{r.ratio:,.0f}" if r.ratio >= 100 else f"{r.ratio:.2f}"
    return [r.what, r.ours, r.peer, ratio, r.target, "" if r.held is None else "yes" if r.held else "NO", r.note]


def line(r: Row) -> str:
    """A row in one line."""
    what, ours, peer, ratio, target, held, note = cells(r)
    more = [peer and f"peer {peer}", ratio and f"ratio {ratio}", target and f"target {target}", held and f"held {held}"]
    return f"{what}: {ours}" + "".join(f", {m}" for m in more if m) + (f" ({note})" if note else "")


def table(rows: Iterable[Row]) -> Table:
    """All rows."""
    out = Table(box=box.SIMPLE_HEAD, title="s/s = simulated seconds per second")
    for column in COLUMNS:
        out.add_column(column, justify="right" if column in ("ours", "peer", "ratio") else "left")
    for r in rows:
        out.add_row(*cells(r))
    return out


if __name__ == "__main__":
    main()
