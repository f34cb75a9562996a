"""``vaneloop fleet``: many engines, many logs: which engine lacks what, since when, how fast it grows."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hil.loop.engines import DEVICES
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.extras import needs
from vaneloop.base.tables import file_of
from vaneloop.cli import options
from vaneloop.fleet import report, sources, state, tables
from vaneloop.fleet.folder import Folder, copies_of
from vaneloop.fleet.kinds import DIAGNOSIS
from vaneloop.fleet.leases import BEATS
from vaneloop.fleet.rent import known, rent
from vaneloop.fleet.state import state_of
from vaneloop.fleet.worker import work
from vaneloop.identification import StageError, load_system
from vaneloop.identification.user_models.by_log import load_model_of
from vaneloop.pages.fleet import day, fleet_page

__all__ = ["DESCRIPTION", "add_options", "command", "tell_damaged", "unusable"]

DESCRIPTION = """Diagnose the logs of a fleet, and report which engine lacks what, since when, how fast it grows, and
which engine is unlike its fleet peers.

A run is a folder. It can be killed at any moment: the same command goes on where it was, and takes up logs that are new
or have changed. A log that cannot be read is a row with its reason. Any number of machines that see the folder can work
on it at once. Needs the extra `fleet`: pip install 'vaneloop[fleet]'. See docs/fleet.md.

  run     take up the logs and diagnose them
  work    join a run from this or another machine
  status  how far a run is
  report  tables and a page of what the logs have in common

examples:
  vaneloop fleet run examples/ --out out/fleet
  vaneloop fleet run LOGS --out out/fleet --engines ENGINES.csv --workers 8
  vaneloop fleet run LOGS --out out/fleet --system MY.py
  vaneloop fleet run LOGS --out out/fleet --on slurm --workers 200 --queue queue=batch
  vaneloop fleet work out/fleet
  vaneloop fleet status out/fleet --json -
  vaneloop fleet report out/fleet --report fleet.html --tables-out TABLES

exit codes: 0 done (report: nothing found), 1 a part of the run is damaged (report: or an engine lacks something or is
unlike its fleet peers), 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the parts of the command and their options."""
    parts = parser.add_subparsers(dest="verb", metavar="PART", required=True, parser_class=terminal.Parser)
    run = parts.add_parser("run", help="take up the logs and diagnose them")
    run.add_argument("logs", nargs="+", metavar="LOGS", help="logs, and folders that hold logs at any depth")
    run.add_argument("--out", required=True, metavar="RUN", help="folder of the run; one that is there is gone on with")
    run.add_argument(
        "--engines", metavar="F.csv", help="columns path, engine, time: whose a log is and when it began (default: its "
        "Parquet metadata engine and time, else its folder's name and a date in its own name)",
    )  # fmt: skip
    run.add_argument("--on", default="local", metavar="WHERE", help="local (default), slurm, tcp://HOST:PORT of Dask")
    run.add_argument("--workers", type=int, default=2, metavar="N", help="logs diagnosed side by side (default 2)")
    run.add_argument("--queue", action="append", default=[], metavar="NAME=value", help="option of the Slurm queue")
    run.add_argument("--limit", type=float, default=3600.0, metavar="S", help="s for one log, then it is given up")
    run.add_argument("--retry", action="store_true", help="once more what died, took too long or met a defect")
    _add_patience(run)
    options.add_reading_options(run.add_argument_group("reading the logs (docs/logs.md)"))
    options.add_machine_options(run)
    run.add_argument("--controller", metavar="PATH.so", help="your own controller in place of the firmware")
    run.add_argument("--system", metavar="MY.py", help="logs of a system of your own (docs/your_own_model.md)")
    work = parts.add_parser("work", help="join a run from this or another machine")
    status = parts.add_parser("status", help="how far a run is")
    report = parts.add_parser("report", help="tables and a page of what the logs have in common")
    for part in (work, status, report):
        part.add_argument("run", metavar="RUN", help="folder of the run")
    _add_patience(work)
    work.add_argument(
        "--device", default="auto", choices=DEVICES, help="what runs a campaign's trials (docs/campaigns.md)"
    )
    options.add_trust_option(work, "the run's folder")
    report.add_argument("--limits", metavar="F.csv", help="columns quantity, limit: where an effect's parameter or a "
                        "nominal one ends its life; of a nominal one without, the end of its tolerance")  # fmt: skip
    report.add_argument("--tables-out", metavar="DIR", help="write every table as Parquet and CSV")
    for part in (run, work, status):
        terminal.add_output_options(part)
    terminal.add_output_options(report, report=True)


def _add_patience(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--patience", type=float, default=60.0, metavar="S", help="s without a heartbeat until another "
                        "worker takes over (default 60)")  # fmt: skip


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    needs("vaneloop fleet", "psutil", "duckdb", "ruptures")
    parts = {"run": _run, "work": _work, "status": _status, "report": _report}
    with unusable():
        return parts[args.verb](args)


@contextmanager
def unusable() -> Iterator[None]:
    """Say in one line which file of a run cannot be used; a disk that is full or a folder of others is no defect."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as e:
        what = f"{e.filename}: {e.strerror}" if e.filename else str(e.strerror or e)
        raise InputError(f"{what}; what is done is kept, run the same command again") from None


def _run(args: argparse.Namespace) -> int:
    if not 1 <= args.workers <= 10_000:
        raise InputError(f"--workers (={args.workers}) must be in [1, 10000]")
    if not 0.0 < args.limit <= 1e6:
        raise InputError(f"--limit (={args.limit:g} s) must be in (0, 1e6]")
    patience, queue = _patience(args), terminal.pairs(args.queue, "queue")
    known(args.on)
    logs = sources.find(args.logs, args.engines)
    folder = Folder.begin(args.out, DIAGNOSIS, *_job(args))
    state.tidy(folder)
    again = {"changed", "unreadable", *(("died", "timeout", "defect") if args.retry else ())}
    statuses = state.came_to(folder)
    keys = {k for k, s in statuses.items() if s in again} | (tables.damaged(folder) if args.retry else set())
    new = folder.add(logs, again=frozenset(keys))
    left = len(set(folder.chunks()) - folder.finished())
    terminal.say(args, f"{len(logs)} logs, {new} of them new or changed; {left} chunks to do")
    if left:
        with terminal.progress_bar(args, "diagnosing the fleet") as progress:
            # its code is that of --system and --controller, which the user has named
            rent(folder, args.on, args.workers, queue, patience / BEATS,
                 lambda n, of: progress(n / max(of, 1)) if progress else None, folder.job["machine"])  # fmt: skip
    return _show(args)


def _job(args: argparse.Namespace) -> tuple[dict[str, Any], dict[str, str]]:
    """Options of the job, and the files that it needs."""
    _known_machine(args)
    files = {"tables": args.tables, "model": args.model, "plant": args.plant, "controller": args.controller,
             "system": args.system, "dbc": args.dbc, "mapping": args.mapping}  # fmt: skip
    given = {name: str(f) for name, f in files.items() if f is not None}
    if args.plant:
        given["plant"] = str(file_of(args.plant))
    reading = options.log_options(args, source="LOGS")
    for in_files in ("dbc", "mapping_file", "tables"):
        reading.pop(in_files, None)
    return {"files": copies_of(given), "reading": reading, "limit": args.limit}, given


def _known_machine(args: argparse.Namespace) -> None:
    """Refuse a machine or a system that cannot be read, before anything is begun."""
    if not args.system:
        machine = options.machine_of(args)
        machine.calibration.of_one_channel("a fleet's logs")
        return
    for name in ("tables", "plant", "controller"):
        if getattr(args, name):
            raise InputError(f"--{name} does not go with --system")
    try:
        system = load_system(args.system)
        if args.model:
            load_model_of(args.model, system)
    except StageError as e:
        raise InputError(str(e)) from None


def _work(args: argparse.Namespace) -> int:
    patience, folder = _patience(args), Folder(args.run)
    options.trusted(args, str(folder.path), folder.code())
    came = work(args.run, every=patience / BEATS, patience=patience, trust=folder.job["machine"],
                device=args.device)  # fmt: skip
    terminal.say(args, "this worker: " + (", ".join(f"{n} {s}" for s, n in sorted(came.items())) or "nothing to do"))
    return _show(args)


def _status(args: argparse.Namespace) -> int:
    return _show(args)


def _report(args: argparse.Namespace) -> int:
    folder = Folder(args.run)
    limits = report.limits_of(args.limits)
    db = tables.roll_up(folder)
    view = report.view_of(db, limits, str(args.run), folder.damaged)
    if args.tables_out:
        tables.write_tables(db, args.tables_out, (*tables.TABLES, "lacks", "trends", "outliers"))
    rows = [[r["engine"], r["effect"], f"{r['named']} of {r['able']}", day(r["first"])] for r in view.lacking]
    terminal.print_table(args, "engines that lack an effect", ["engine", "effect", "named in logs", "first"], rows)
    changes = [
        [s.engine, s.quantity, s.trend["kind"], day(s.trend["onset"]), f"{s.trend['rate']:.3g}", s.unit,
         day(s.trend["limit_time"])] for s in view.changed
    ]  # fmt: skip
    columns = ["engine", "quantity", "change", "since", "a year, or step", "unit", "limit"]
    terminal.print_table(args, "what changes", columns, changes[:40])
    odd = [[r["engine"], r["quantity"], f"{r['value']:.4g}", f"{r['sisters']:.4g}", r["unit"]] for r in view.outliers]
    terminal.print_table(args, "unlike their fleet peers", ["engine", "quantity", "value", "peers", "unit"], odd[:40])
    tell_damaged(args, view.damaged)
    terminal.say(args, view.sentence())
    terminal.write_json(args, view.json())
    if args.report:
        pages = Path(args.report).with_suffix("")
        pages = pages.with_name(f"{pages.name}_logs")
        said = tables.answers(folder, view.keys())
        words = terminal.typed("fleet")
        page = fleet_page(view, words, pages.name if said else "").write(args.report)
        if said:
            report.write_pages(pages, said)
        terminal.say(args, f"page: {page}")
    return int(view.found or bool(view.damaged))


def tell_damaged(args: argparse.Namespace, damaged: dict[str, str]) -> None:
    """Print what of a run's folder cannot be used."""
    if damaged:
        rows = [[name, why] for name, why in damaged.items()]
        terminal.print_table(args, "damaged, and left out (the same fleet run repeats it)", ["part", "reason"], rows)


def _patience(args: argparse.Namespace) -> float:
    if not 0.5 <= args.patience <= 1e5:
        raise InputError(f"--patience (={args.patience:g} s) must be in [0.5, 1e5]")
    return float(args.patience)


def _show(args: argparse.Namespace) -> int:
    """Print how far the run is."""
    folder = Folder(args.run if args.verb != "run" else args.out)
    s = state_of(folder)
    rows = [[status, f"{n:,}"] for status, n in s.came.items()]
    terminal.print_table(args, f"{s.done:,} of {s.contents:,} contents done ({s.logs:,} logs)", ["came to", "n"], rows)
    for name, kind in s.workers.items():
        terminal.say(args, f"at work: {kind} {name}")
    tell_damaged(args, s.damaged)
    terminal.write_json(args, {"schema": 1, "run": str(folder.path), **s.json()})
    return int(bool(s.damaged))
