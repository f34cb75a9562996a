"""``python -m benchmarks [WORD ...]``: measure (only what has one of the words in its name), print a table, write
benchmarks/results/latest.json. Never fails for a slow figure.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict

from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks import bus, fleet, learn, long_log, measure, native, sizes, tools, web
from benchmarks.measure import ROOT, Row, machine

MEASUREMENTS = {
    **measure.MEASUREMENTS, **native.MEASUREMENTS, **bus.MEASUREMENTS, **tools.MEASUREMENTS, **web.MEASUREMENTS,
    **fleet.MEASUREMENTS, **long_log.MEASUREMENTS, **learn.MEASUREMENTS, **sizes.MEASUREMENTS,
}  # fmt: skip


def main() -> None:
    """Run the measurements; one that cannot run says why in the table."""
    console = Console(markup=False, width=None if sys.stdout.isatty() else 160)
    host = machine()
    console.print("  ".join(f"{k} {v}" for k, v in host.items()))
    rows: list[Row] = []
    words = sys.argv[1:]
    chosen = {name: rows_of for name, rows_of in MEASUREMENTS.items() if not words or any(w in name for w in words)}
    for i, (name, rows_of) in enumerate(chosen.items(), 1):
        console.print(f"[{i}/{len(chosen)}] measuring {name} ...")
        started = time.perf_counter()
        try:
            rows += list(rows_of())
        except Exception as e:  # a benchmark reports, it does not fail
            rows.append(Row(name, "not measured", note=f"{type(e).__name__}: {e}".splitlines()[0][:200]))
        console.print(f"      {time.perf_counter() - started:.0f} s")
    table = Table(box=box.SIMPLE_HEAD, title="s/s = simulated seconds per second")
    for column in ("what", "ours", "peer", "ratio", "target", "held", "note"):
        table.add_column(column, justify="right" if column in ("ours", "peer", "ratio") else "left")
    for r in rows:
        ratio = "" if r.ratio is None else f"{r.ratio:,.0f}" if r.ratio >= 100 else f"{r.ratio:.2f}"
        held = "" if r.held is None else "yes" if r.held else "NO"
        table.add_row(r.what, r.ours, r.peer, ratio, r.target, held, r.note)
    console.print(table)
    path = ROOT / "benchmarks" / "results" / "latest.json"
    try:
        path.parent.mkdir(exist_ok=True)
        path.write_text(
            json.dumps({"machine": host, "rows": [asdict(r) for r in rows]}, indent=2) + "\n", encoding="utf-8"
        )
        console.print(f"written: {path.relative_to(ROOT)}")
    except OSError as e:
        console.print(f"{path}: cannot be written ({e.strerror})")


if __name__ == "__main__":
    main()
