"""``vaneloop campaign``: does every machine within tolerance survive every scenario; which comes closest to failing?"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING
from xml.etree import ElementTree as Xml

from hil.loop.engines import DEVICES
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.extras import needs
from vaneloop.base.files import write
from vaneloop.cli import options
from vaneloop.cli.fleet import tell_damaged, unusable
from vaneloop.fleet import campaign, state
from vaneloop.fleet.folder import Folder
from vaneloop.fleet.leases import BEATS
from vaneloop.fleet.plan import load_plan
from vaneloop.fleet.rent import known, rent
from vaneloop.pages.campaign import campaign_page

if TYPE_CHECKING:
    from vaneloop.pages.campaign import CampaignView

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Scenarios times tolerances of the machine times calibrations times firmwares: failure probability with
its interval, margin of each requirement, and the machine that comes closest to failing, saved as a scenario.

A campaign is a run folder as that of vaneloop fleet: it can be killed at any moment and goes on where it was,
vaneloop fleet work RUN joins from another machine, vaneloop fleet status RUN says how far it is. Needs the extra
`fleet`: pip install 'vaneloop[fleet]'. The plan's keys: docs/campaigns.md.

examples:
  vaneloop campaign PLAN.toml --out RUN --report campaign.html
  vaneloop campaign PLAN.toml --out RUN --workers 8 --junit campaign.xml
  vaneloop campaign PLAN.toml --out RUN --on slurm --workers 200 --json -

exit codes: 0 every combination passes, 1 one does not, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("plan", metavar="PLAN.toml", help="what is tried (docs/campaigns.md)")
    parser.add_argument(
        "--out", required=True, metavar="RUN", help="folder of the run; one that is there is gone on with"
    )
    parser.add_argument(
        "--on", default="local", metavar="WHERE", help="local (default), slurm, tcp://HOST:PORT of Dask"
    )
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="trials run side by side (default 2)")
    parser.add_argument("--queue", action="append", default=[], metavar="NAME=value", help="option of the Slurm queue")
    parser.add_argument("--limit", type=float, default=3600.0, metavar="S", help="s for one trial or one search")
    parser.add_argument("--patience", type=float, default=60.0, metavar="S", help="s without a heartbeat until another "
                        "worker takes over (default 60)")  # fmt: skip
    parser.add_argument(
        "--device", default="auto", choices=DEVICES, help="what runs the trials side by side: auto (default), the GPU "
        "where there is one; cuda, the GPU; cpu, the processor",
    )  # fmt: skip
    options.add_trust_option(parser, "the plan")
    terminal.add_output_options(parser, report=True)
    parser.add_argument("--junit", metavar="FILE", help="write JUnit XML: a suite a combination, a case a requirement")


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    needs("vaneloop campaign", "psutil", "duckdb")
    with unusable():
        return _command(args)


def _command(args: argparse.Namespace) -> int:
    if not 1 <= args.workers <= 10_000:
        raise InputError(f"--workers (={args.workers}) must be in [1, 10000]")
    for option, low, high in (("limit", 1e-3, 1e6), ("patience", 0.5, 1e5)):
        if not low <= getattr(args, option) <= high:
            raise InputError(f"--{option} (={getattr(args, option):g} s) must be in [{low:g}, {high:g}]")
    known(args.on)
    terminal.pairs(args.queue, "queue")
    own = [c.controller for c in load_plan(args.plan).firmware if c.controller]
    options.trusted(args, args.plan, own)
    gpu = campaign.has_gpu(args.device, args.on == "local")
    plan, quantities, folder = campaign.begin(args.plan, args.out, args.limit, args.device)
    new = campaign.take_samples(plan, quantities, folder, args.workers if gpu else 0)
    terminal.say(args, f"{new} trials to take up")
    _work(args, folder, "running the trials")
    new = campaign.take_searches(plan, folder)
    if new:
        terminal.say(args, f"searches for the worst case and subset simulations to take up: {new}")
    _work(args, folder, "searching")
    with terminal.progress_bar(args, "running the worst cases again") as progress:
        view = campaign.judge(plan, quantities, folder, progress or (lambda fraction: None))
    _show(args, view, plan.search)
    tell_damaged(args, folder.damaged)
    terminal.write_json(args, view.json())
    if args.report:
        words = terminal.typed("campaign")
        terminal.say(args, f"page: {campaign_page(view, words).write(args.report)}")
    if args.junit:
        _write_junit(args.junit, view)
    return 0 if all(view.passed(g) for g in view.groups) else 1


def _work(args: argparse.Namespace, folder: object, what: str) -> None:
    """Have the workers do what is left."""
    assert isinstance(folder, Folder)
    state.tidy(folder)
    if not set(folder.chunks()) - folder.finished():
        return
    with terminal.progress_bar(args, what) as progress:
        rent(folder, args.on, args.workers, terminal.pairs(args.queue, "queue"), args.patience / BEATS,
             lambda n, of: progress(n / max(of, 1)) if progress else None, folder.job["machine"],
             args.device)  # fmt: skip


def _show(args: argparse.Namespace, view: CampaignView, search: int) -> None:
    rows = [
        [g.name, "passes" if view.passed(g) else "FAILS", f"{g.failed} of {g.trials}", f"{g.low:.2g} to {g.high:.2g}",
         f"{g.least:.3g}", g.found_by, "yes" if g.reproduces else "NO"] for g in view.groups
    ]  # fmt: skip
    interval = f"{100.0 * view.confidence:g} % interval"
    columns = ["combination", "", "failed", interval, "least margin", "found by", "reproduces"]
    terminal.print_table(args, view.title, columns, rows)
    if view.texts:
        traced = [[t.id, "holds" if t.holds else "FAILS", t.text, ", ".join(sorted({g for g, _ in t.verified_by}))]
                  for t in view.traced]  # fmt: skip
        terminal.print_table(args, "Requirements", ["id", "", "requirement", "verified in"], traced)
    for g in view.groups:
        for r in g.requirements:
            if r.fails:
                where = f"in {r.broken} of {r.trials} machines" if r.broken else "by the search's worst machine"
                terminal.say(args, f"broken {where}: {g.name}: {r.expected}")
        for why, n in g.alone.items():
            terminal.say(args, f"on the lockstep bus, not in lanes: {n} of {g.trials} machines of {g.name}: {why}")
        if g.lost:
            terminal.say(args, f"without an answer: {g.lost} trials of {g.name}; vaneloop fleet status says what came")
        if g.rare:
            terminal.say(args, f"{g.name}: {g.rare.text}")
        if g.counted:
            terminal.say(args, f"{g.name}: the failure probability is counted: {g.counted}")
        if search and not g.runs:
            terminal.say(args, f"no search in {g.name}: too few of its trials have an answer")
        terminal.say(args, f"worst case: {g.command}")
        if saved := g.saved_failures():
            terminal.say(args, f"{g.name}: {saved}{f'; the first: {g.failures[0].command}' if g.failures else ''}")
        for f in g.failures:
            if not f.same:
                terminal.say(args, f"does NOT reproduce: {f.command}")
    if view.simulated_s:
        terminal.say(args, view.simulated_on)
    for note in view.notes:
        terminal.say(args, note)
    terminal.say(args, view.sentence())


def _write_junit(file: str, view: CampaignView) -> None:
    """Write JUnit's XML: a suite a combination, a case a requirement, and one for the verdict of the combination."""
    root = Xml.Element("testsuites", name=view.title)
    for g in view.groups:
        cases: list[tuple[str, str]] = []
        for r in g.requirements:
            text = f"broken in {r.broken} of {r.trials} machines, least margin {r.least} {r.unit}; {g.command}"
            cases.append((" ".join([*r.ids, r.expected]), text if r.fails and view.allowed is None else ""))
        text = f"failed {g.failed} of {g.trials} machines, {g.low:.3g} to {g.high:.3g}; {g.lost} without an answer; "
        text += f"worst case {'reproduces' if g.same else 'does not reproduce'}: {g.command}"
        text += "".join(f"; failed machine does not reproduce: {f.command}" for f in g.failures if not f.same)
        cases.append(("the combination passes", "" if view.passed(g) else text))
        numbers = {"tests": len(cases), "failures": sum(bool(t) for _, t in cases), "errors": 0, "skipped": 0}
        suite = Xml.SubElement(root, "testsuite", {"name": g.name, **{k: str(v) for k, v in numbers.items()}})
        for name, why in cases:
            case = Xml.SubElement(suite, "testcase", classname=f"vaneloop.campaign.{g.name}", name=name)
            if why:
                Xml.SubElement(case, "failure", message=why)
    Xml.indent(root)
    write(file, Xml.tostring(root, encoding="utf-8", xml_declaration=True))
