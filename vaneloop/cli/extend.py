"""``vaneloop extend``: add effects to the model, fit them to a log, write the model file."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

from vaneloop.base import terminal
from vaneloop.cli import options, own_model
from vaneloop.cli.options import chain_of

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Add physical effects to the model, fit their parameters to a log, and write a model file that every
command takes with --model.

Effects that --model brings along are fitted again together with the new ones. Errors before and after are on data that
the parameters were not fitted to, beside the noise floor that no model can undercut.

examples:
  vaneloop extend examples/hidden_effect.parquet --effect valve_dead_band --out with_dead_band.toml
  vaneloop extend examples/hidden_effect.parquet --model with_dead_band.toml --effect aero_load --out both.toml

exit codes: 0 each stage extended is at its noise floor (within 10 %), 1 an error remains, or the effects
bring the model no nearer to the log (nothing is written then), 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    options.add_log_options(parser)
    parser.add_argument("--model", metavar="M.toml", help="model file to extend (default: the nominal model)")
    parser.add_argument(
        "--effect", metavar="NAME", action="append", nargs="+", default=[], help="effect to add (docs/effects.md)"
    )
    parser.add_argument("--out", metavar="M2.toml", required=True, help="model file to write")
    own_model.add_options(parser)
    terminal.add_output_options(parser)
    parser.add_argument("--report", metavar="F.html", help="write a self-contained HTML page with plots")


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if own_model.asked(args):
        return own_model.command(args, "extend")
    from plant import Model, load_model, write_model
    from plant.effects import EFFECTS
    from vaneloop.base.errors import InputError
    from vaneloop.discrepancy.locate import agrees
    from vaneloop.discrepancy.workflow import Diagnosis, diagnosis_json, extend_stage, no_better

    wanted = list(dict.fromkeys(e for group in args.effect for e in group))
    if not wanted:
        raise InputError("extend needs at least one --effect NAME; vaneloop diagnose names candidates")
    for name in wanted:
        if name not in EFFECTS:
            import difflib

            close = difflib.get_close_matches(name, EFFECTS, 1)
            raise InputError(
                f"--effect {name!r} is not in the library{f'; probably {close[0]!r} is meant' if close else ''}; "
                f"docs/effects.md lists it"
            )
    out = Path(args.out)
    if out.is_dir() or not out.parent.is_dir():  # before the fit, which takes a while
        raise InputError(
            f"{args.out}: cannot be written ({'it is a folder' if out.is_dir() else f'no folder {out.parent}'})"
        )
    before = load_model(args.model) if args.model else Model()
    chain = chain_of(args, Model())
    started = time.perf_counter()
    by_stage: dict[str, list[str]] = {}
    carried: dict[str, dict[str, float]] = {}
    for name in dict.fromkeys([*before.effects, *wanted]):
        stage = next((s for s in EFFECTS[name].stages if any(s == c.name for c in chain.stages)), None)
        if stage is not None:
            by_stage.setdefault(stage, []).append(name)
        elif name in wanted:
            why = "; ".join(f"{s}: {chain.not_observed.get(s, 'not observed')}" for s in EFFECTS[name].stages)
            raise InputError(f"{args.log}: --effect {name}: the log does not show its stage ({why})")
        else:
            carried[name] = before.effects[name]
    results = [extend_stage(chain.stage(s), tuple(names)) for s, names in by_stage.items()]
    for text in filter(None, map(no_better, results)):
        print(f"vaneloop extend: {args.log}: {text}; {args.out} is not written", file=sys.stderr)
        return 1
    parameters, effects = dict(before.parameters), dict(carried)
    for r in results:
        for q in r.recalibrated:
            parameters[str(q["parameter"])] = float(q["value"])  # type: ignore[arg-type]
        for f in r.effects:
            known = [p.name for p in EFFECTS[f.effect].parameters]
            effects[f.effect] = {k: float(v["value"]) for k, v in f.parameters.items() if k in known}  # type: ignore[arg-type]
    history = before.meta.get("history", [])
    meta: dict[str, Any] = {
        **before.meta,
        "history": [*(history if isinstance(history, list) else [str(history)]), _words()],
    }
    write_model(args.out, Model(parameters=parameters, effects=effects, meta=meta))
    rows = []
    for r in results:
        for k in range(len(r.floor)):
            figures = [f"{v:.4g}" for v in (r.error_before[k], r.error_after[k], r.floor[k])]
            rows.append([r.stage, r.outputs[k], *figures, f"{r.error_after[k] / r.floor[k]:.2f}", r.units[k]])
    columns = ["stage", "signal", "error before", "error after", "noise floor", "after / floor", "unit"]
    terminal.print_table(args, "errors are RMS on held-out data", columns, rows)
    for r in results:
        for f in r.effects:
            values = ", ".join(
                f"{n} {p['value']:.4g} [{p['low']:.4g}, {p['high']:.4g}] {p['unit']}" for n, p in f.parameters.items()
            )
            terminal.say(args, f"{f.effect}: {values}")
        terminal.say(
            args,
            f"{r.stage}, in noise floors: "
            + " -> ".join(f"{name} {level:.2f}" for name, level in r.steps)
            + " -> noise floor 1.00",
        )
    terminal.say(args, f"model: {args.out}")
    d = Diagnosis("missing", results, {}, chain.not_observed, time.perf_counter() - started, list(chain.notes))
    waterfall = {r.stage: [{"step": n, "noise_floors": v} for n, v in r.steps] for r in results}
    terminal.write_json(args, {**diagnosis_json(d, args.log), "model": args.out, "waterfall": waterfall})
    if args.report:
        from vaneloop.pages.diagnosis import diagnosis_report

        terminal.say(args, f"page: {diagnosis_report(d, chain, args.report, _words(), args.log)}")
    return 0 if all(agrees(e, f) for r in results for e, f in zip(r.error_after, r.floor, strict=True)) else 1


def _words() -> str:
    return " ".join(["vaneloop extend", *sys.argv[2:]])
