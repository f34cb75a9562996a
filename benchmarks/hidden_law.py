"""``python -m benchmarks.hidden_law``: the blind benchmark for users' own models. An independent integrator hides laws
in systems of many families (``tests/rig_systems``), the diagnosis sees logs and a nominal model
(``tests/nominal_systems.py``), and every answer is counted.
"""

from __future__ import annotations

import argparse
import json
import logging
import secrets
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import start
from benchmarks.blind import (
    INSIDE,
    KINDS,
    add_learn_options,
    add_run_options,
    as_curve,
    check_run,
    print_shares,
    read_rows,
    run,
    share,
)
from benchmarks.same_law import same_by_equations
from tests import rig_systems as rig
from tests.nominal_systems import nominal
from tests.rig_systems import left_out
from tests.rig_systems.surfaces import draw_surface
from tests.system_variants import variants as variants_of
from vaneloop.base import terminal
from vaneloop.base.durations import within_no_period
from vaneloop.base.errors import InputError
from vaneloop.identification import Record
from vaneloop.verbs import learn as learning
from vaneloop.verbs import search

__all__ = ["DESCRIPTION", "DETECTABLE", "add_options", "command", "judge_case", "misses", "summary"]

DESCRIPTION = """Blind benchmark of `vaneloop diagnose --system`: systems of many families are drawn (tanks, drives,
cylinders, resonators, ...), with no hidden law (25 %), a law that the library does not have (25 %), two laws (20 %) or
one (30 %), from undetectable to gross, and simulated by an independent integrator. The diagnosis gets one to three
noisy logs, a test log and a nominal model whose parameters start off by up to ten times. docs/hidden_law.md says how
answers are judged.

examples:
  python -m benchmarks.hidden_law --systems 32 --seed 1 --out out/hidden_law.parquet
  python -m benchmarks.hidden_law --systems 200 --seed 1 --out out/hidden_law.parquet  (continues where it was stopped)
  python -m benchmarks.hidden_law --systems 32 --seed 1 --kinds outside clean --learn --out out/learned.parquet
  python -m benchmarks.hidden_law --systems 32 --seed 1 --leave-out --out out/left_out.parquet
  python -m benchmarks.hidden_law --systems 10 --seed 2 --family tanks --family pendulum --variants --out out/v.parquet

exit codes: 0 done, 2 bad input. The figures are for reading; no threshold decides."""

DETECTABLE = 0.5  # noise floors (RMS) that a law must leave after the refit, to be one that can be seen
BANDS = ((0.0, 0.5), (0.5, 1.0), (1.0, 3.0), (3.0, 10.0), (10.0, float("inf")))
Row = dict[str, Any]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--systems", type=int, default=32, metavar="N", help="number of systems (default 32)")
    parser.add_argument("--seed", type=int, metavar="S", help="seed of the draw (default: fresh, and printed)")
    parser.add_argument(
        "--family", action="append", default=[], metavar="NAME", help="draw from this family only; again for more"
    )
    parser.add_argument(
        "--variants",
        action="store_true",
        help="diagnose each system again with its time and channels scaled, a sign flipped, everything reordered, "
        "other starts, logs cut in two: is the answer the same?",
    )
    add_learn_options(parser, "laws")
    parser.add_argument(
        "--surface",
        action="store_true",
        help="hide a law of two quantities in every other system, and in the others nothing, or a law of one: does "
        "vaneloop learn find both quantities, and no surface where there is none?",
    )
    add_run_options(parser, "systems", "system", "out/hidden_law.parquet")


def _said(
    system: Any, records: list[Any], test: list[Any], floors: Any = None, truth: Any = None, true: Any = None
) -> dict[str, Any]:
    """What `diagnose` answers, or the error that it raised; with its processor seconds.

    floors  true noise of every output: `learn` is asked, too, and its errors on the test log are held against it
    truth   a law that is hidden as a curve (`tests.rig_systems.left_out.Truth`): what was learned is held against it
    true    the system with its true parameters
    """
    started = time.process_time()
    learned: dict[str, Any] = {}
    try:
        if floors is None:
            said = search.diagnose(records, system, test=test)
        else:
            asked = learning.learn(records, system, test=test)
            said, learned = asked.diagnosed, _as_learned(asked, test[0].name, floors, truth, true)
        answer = terminal.plain(said.to_dict())
        out = {"verdict": answer["verdict"], "effects": answer["effects"], "answer": answer, "error": ""}
    except Exception as e:  # one system must not end the run; it counts as a miss
        out = {"verdict": "error", "effects": [], "answer": {}, "error": " ".join(f"{type(e).__name__}: {e}".split())}
    return {**out, "learned": learned, "seconds": time.process_time() - started}


def _as_learned(asked: Any, test: str, floors: Any, truth: Any, true: Any) -> dict[str, Any]:
    """What `learn` answers: each law with its rivals and formulas, and the error on the test log in noise floors."""
    by = list(asked.by_log.steps.values())[-1] if asked.by_log else {}
    error = float(((by[test] / floors) ** 2).mean() ** 0.5) if test in by else None
    laws: list[dict[str, Any]] = [
        {"names": [law.name, *law.rivals], "formulas": [f.text for f in law.formulas], "two": law.axis() is not None}
        for law in asked.laws
    ]
    if truth is not None:
        for law, row in zip(asked.laws, laws, strict=True):
            if truth.found(law.name):
                row |= as_curve(law, truth.value, truth.forms)
            elif asked.by_log is not None:
                fitted = asked.by_log.logs.fitted
                same = same_by_equations(law, fitted, true, truth.at, truth.quantity, truth.value)
                row |= same if same["inside"] >= INSIDE else {}
    return {"verdict": asked.verdict, "laws": laws, "error": error, "nearest": asked.outcome.nearest}


def judge_case(
    seed: int, index: int, families: tuple[str, ...] = (), variants: bool = False, learn: bool = False,
    leave_out: bool = False, surface: bool = False, kinds: Sequence[str] = KINDS,
) -> Row:  # fmt: skip
    """Draw, simulate and diagnose one system; a flat record.

    kinds      of `KINDS`, that are drawn
    leave_out  hide a law of the library that is a function of one quantity, and take it out of the library
    surface    hide a law of two quantities in systems of even number, in the others nothing, or a law of one
    """
    logging.getLogger("numba").setLevel(logging.ERROR)
    case = _left_out_case(seed, index, families) if leave_out else rig.draw_case(seed, index, families, kinds=kinds)
    both: tuple[str, ...] = ()
    if surface and index % 2 == 0:
        case, both = draw_surface(seed, index, families)
    elif surface:
        case = _case_of_one(seed, index, families)
    left = rig.left_over(case)
    records = [Record(f"log {k + 1}", log.t, case.columns(k)) for k, log in enumerate(case.logs)]
    system, truth = nominal(case.family, case.values, case.factors), None
    if leave_out:
        (h,) = case.hidden
        system = replace(system, without=sorted(case.family.equivalent(h.name)))
        truth = left_out.truth_of(case.family, h, case.greatest.get(h.place, 1.0))
    floors = case.floors if learn or leave_out or surface else None
    true = nominal(case.family, case.values, {})
    said = _said(system, records[:-1], records[-1:], floors, truth, true)
    learned, effects, also = said["learned"], said["effects"], set()
    while leave_out and learned.get("verdict") == "named":  # another law says the same: it is left out, too
        also |= {name for e in effects for name in (e["effect"], *e["rivals"])}
        again = _said(
            replace(system, without=sorted({*system.without, *also})), records[:-1], records[-1:], floors, truth, true
        )
        learned, effects = again["learned"], again["effects"]
    if leave_out and learned:
        learned["also"] = sorted(also)
    tried: dict[str, Any] = {}
    if variants and not said["error"]:
        for name, (system, fitted, test) in variants_of(case, records, nominal):
            other = _said(system, fitted, test)
            named = sorted(e["effect"] for e in other["effects"])
            same = (other["verdict"], named) == (said["verdict"], sorted(e["effect"] for e in said["effects"]))
            tried[name] = {"same": same, "verdict": other["verdict"], "named": named, "error": other["error"]}
    sizes = {e["effect"]: e["parameters"] for e in said["effects"]}
    intervals = [
        {"effect": h.name, "parameter": k, "truth": v, **sizes[h.name][k]}
        for h in case.hidden if h.name in sizes
        for k, v in h.values.items() if k in sizes[h.name] and abs(v) < _far(h, v)
    ]  # fmt: skip
    return {
        "seed": seed, "index": index, "families": " ".join(families), "family": case.family.name,
        "kind": "left out" if leave_out else "surface" if both else case.kind, "both": list(both),
        "truth": [h.name for h in case.hidden], "sizes": json.dumps([h.values for h in case.hidden]),
        "same": json.dumps({h.name: sorted(case.family.equivalent(h.name)) for h in case.hidden}),
        "amounts": json.dumps(
            [sorted(s) for h in case.hidden if h.name in case.family.outside
             for s in case.family.outside[h.name].amounts_to]
        ),
        "left": left, "rate": case.rate, "samples": len(case.logs[0].t), "logs": [log.kind for log in case.logs],
        "parameters": json.dumps({k: [case.values[k], f] for k, f in case.factors.items()}),
        "verdict": said["verdict"], "named": [e["effect"] for e in said["effects"]],
        "rivals": json.dumps({e["effect"]: e["rivals"] for e in said["effects"]}), "error": said["error"],
        "seconds": said["seconds"], "intervals": json.dumps(intervals), "variants": json.dumps(tried),
        "answer": json.dumps(said["answer"]), "learned": json.dumps(learned),
        "curves": json.dumps(sorted({c for h in case.hidden for c in rig.LEARNED.get((case.family.name, h.name), ())})),
    }  # fmt: skip


def _case_of_one(seed: int, index: int, families: tuple[str, ...]) -> Any:
    """A system with nothing hidden, or a law outside the library that is a function of one quantity."""
    rng = np.random.default_rng([seed, index, 3])
    family = str(rng.choice(families or list(rig.FAMILIES)))
    laws = [law for law in rig.FAMILIES[family].outside if rig.LEARNED.get((family, law))]
    names = [] if rng.random() < 0.5 or not laws else [str(rng.choice(laws))]
    case = rig.draw_case(seed, index, (family,), names)
    return replace(case, kind="outside" if names else "clean")


def _left_out_case(seed: int, index: int, families: tuple[str, ...]) -> Any:
    """A system with a law that can be left out of the library."""
    rng = np.random.default_rng([seed, index, 1])
    family = str(rng.choice(families or list(rig.FAMILIES)))
    law = str(rng.choice(left_out.laws_of(rig.FAMILIES[family])))
    return rig.draw_case(seed, index, (family,), [law])


def _far(hidden: Any, value: float) -> float:
    """The limit of a saturation that nothing reaches has no size to be found."""
    other = [abs(v) for v in hidden.values.values()]
    return float("inf") if hidden.law != "saturation" else max(other)


# ---- counting --------------------------------------------------------------------------------------------------------


def _seen(row: Row) -> bool:
    """Whether everything that is hidden can be seen."""
    return all(v > DETECTABLE for v in row["left"])


def _hit(law: str, row: Row) -> bool:
    """Whether a law, or what is the same in this family, was named or given as a rival."""
    same, rivals = set(json.loads(row["same"])[law]), json.loads(row["rivals"])
    return any(same & {n, *rivals[n]} for n in row["named"])


def _right(row: Row) -> bool:
    """Whether the answer is what it should be."""
    if row["error"]:
        return False
    if row["kind"] == "clean":
        return not row["named"]
    if row["kind"] == "left out":
        return any("inside" in law for law in json.loads(row["learned"]).get("laws", ()))
    if row["kind"] == "surface":
        return _both(row) or not _seen(row)
    if row["kind"] == "outside":
        if _amounts(row):
            return True
        return not row["named"] and (row["verdict"] == "unknown" or not _seen(row))
    wrong = [n for n in row["named"] if not any(_hit_by(n, law, row) for law in row["truth"])]
    return not wrong and all(_hit(law, row) for law, v in zip(row["truth"], row["left"], strict=True) if v > DETECTABLE)


def _amounts(row: Row) -> bool:
    """Whether laws of the library are named that together are what is hidden."""
    return sorted(row["named"]) in json.loads(row["amounts"])


def _hit_by(name: str, law: str, row: Row) -> bool:
    return bool(set(json.loads(row["same"])[law]) & {name, *json.loads(row["rivals"])[name]})


def summary(rows: list[Row]) -> dict[str, Any]:
    """Count: shares with 90 % binomial intervals, and the median of the processor seconds."""
    single = [r for r in rows if r["kind"] == "single" and _seen(r)]
    alone = [r for r in single if len(r["named"]) == 1 and not json.loads(r["rivals"])[r["named"][0]]]
    clean = [r for r in rows if r["kind"] == "clean"]
    pairs = [r for r in rows if r["kind"] == "pair" and _seen(r)]
    outside = [r for r in rows if r["kind"] == "outside"]
    intervals = [i for r in rows for i in json.loads(r["intervals"])]
    out: dict[str, Any] = {
        "systems": len(rows),
        "detectable single named or among rivals": share([_hit(r["truth"][0], r) for r in single]),
        "a single name given is right": share([_hit(r["truth"][0], r) for r in alone]),
        "a single name given": share([r in alone for r in single]),
        "a detectable single named, and nothing else": share([_right(r) for r in single]),
        "nothing hidden, nothing named": share([not r["named"] and not r["error"] for r in clean]),
        "nothing hidden, verdict none": share([r["verdict"] == "none" for r in clean]),
        "both of a detectable pair": share([all(_hit(law, r) for law in r["truth"]) for r in pairs]),
        "outside the library: unknown, or none where undetectable": share([_right(r) for r in outside]),
        "90 % interval covers the truth": share([i["low"] <= i["truth"] <= i["high"] for i in intervals]),
        "size within 5 % of the truth": share(
            [abs(i["value"] - i["truth"]) <= 0.05 * abs(i["truth"]) for i in intervals]
        ),
        "diagnosed without an error": share([not r["error"] for r in rows]),
        "whole answer right": share([_right(r) for r in rows]),
        "median processor seconds": sorted(r["seconds"] for r in rows)[len(rows) // 2] if rows else None,
        "most processor seconds": max((r["seconds"] for r in rows), default=None),
    }
    out |= learned_summary(rows) | surface_summary(rows)
    tried = [json.loads(r["variants"]) for r in rows]
    for name in sorted({name for t in tried for name in t}):
        out[f"same answer: {name}"] = share([t[name]["same"] for t in tried if name in t])
    return out


def _surfaces(row: Row) -> list[str]:
    """Names of the surfaces that were learned, with their rivals."""
    laws = json.loads(row.get("learned") or "{}").get("laws", ())
    return [name for law in laws if law.get("two") for name in law["names"]]


def _both(row: Row) -> bool:
    """Whether a surface of the right quantities was learned."""
    one, two = row["both"]
    return any(name.endswith((f"_of_{one}_and_{two}", f"_of_{two}_and_{one}")) for name in _surfaces(row))


def surface_summary(rows: list[Row]) -> dict[str, Any]:
    """Count the laws of two quantities, of rows where they were hidden."""
    hidden = [r for r in rows if r["kind"] == "surface" and _seen(r)]
    if not any(r["kind"] == "surface" for r in rows):
        return {}
    said = [json.loads(r["learned"] or "{}") for r in hidden]
    right = [s for r, s in zip(hidden, said, strict=True) if _both(r)]
    close = [s.get("error") is not None and s["error"] <= 1.5 for s in said]
    return {
        "surface: both quantities": share([_both(r) for r in hidden]),
        "surface: both quantities, or other laws that leave 1.5 noise floors on the test log": share(
            [_both(r) or near for r, near in zip(hidden, close, strict=True)]
        ),
        "surface: of those with both, error on the test log within 1.5 noise floors": share(
            [s["error"] is None or s["error"] <= 1.5 for s in right]
        ),
        "surface: none hidden, none learned": share([not _surfaces(r) for r in rows if r["kind"] != "surface"]),
    }


def learned_summary(rows: list[Row]) -> dict[str, Any]:
    """Count what was learned, of rows where that was asked."""
    asked = [(r, json.loads(r.get("learned") or "{}")) for r in rows]
    asked = [(r, said) for r, said in asked if said]
    if not asked:
        return {}
    outside = [(r, said) for r, said in asked if r["kind"] == "outside" and _seen(r)]
    right = [(r, said) for r, said in outside if _learned_right(r, said)]
    gone = [said["laws"] for r, said in asked if r["kind"] == "left out" and _seen(r)]
    also = [said["also"] for r, said in asked if r["kind"] == "left out" and _seen(r)]
    curves: list[Row] = [next((law for law in laws if "inside" in law), {}) for laws in gone]
    return {
        "learned: left out of the library, right place and quantity": share([bool(c) for c in curves]),
        "learned: left out, and no other law of the library does as well": share(
            [bool(c) for c, others in zip(curves, also, strict=True) if not others]
        ),
        "learned: left out, the curve is the law within its band": share(
            [c.get("inside", 0.0) >= INSIDE for c in curves]
        ),
        "learned: left out, the right formula among those given": share(
            [bool(c.get("formula")) for c in curves if c.get("formula", False) is not None]
        ),
        "learned: outside the library, right place and quantity": share([_learned_right(r, s) for r, s in outside]),
        "learned: of these, error on the test log within 1.5 noise floors": share(
            [s["error"] is None or s["error"] <= 1.5 for _, s in right]
        ),
        "learned: nothing hidden, nothing learned": share([not s["laws"] for r, s in asked if r["kind"] == "clean"]),
    }


def _learned_right(row: Row, said: dict[str, Any]) -> bool:
    """Whether a curve that was learned, or a rival of it, is what is hidden; or laws of the library that amount to it
    are named, and no curve instead of them: nothing was left to learn.
    """
    if said["verdict"] == "named" or (_amounts(row) and not said["laws"]):
        return _right(row)
    curves = set(json.loads(row["curves"]))
    return bool(said["laws"]) and any(curves & {within_no_period(n) for n in law["names"]} for law in said["laws"])


def by_size(rows: list[Row]) -> list[list[str]]:
    """How often single laws are found, by what they leave in noise floors."""
    out = []
    for low, high in BANDS:
        hits = [_hit(r["truth"][0], r) for r in rows if r["kind"] == "single" and low <= r["left"][0] < high]
        if hits:
            out.append([f"{low:g} to {high:g}" if high < 1e9 else f"above {low:g}", f"{sum(hits)} of {len(hits)}"])
    return out


def by_family(rows: list[Row]) -> list[list[str]]:
    """Whole answers right, family by family."""
    names = sorted({r["family"] for r in rows})
    of = {n: [r for r in rows if r["family"] == n] for n in names}
    return [[n, f"{sum(_right(r) for r in of[n])} of {len(of[n])}"] for n in names]


def misses(rows: list[Row]) -> list[str]:
    """Every answer that is not what it should be, a line each."""
    out = []
    for r in rows:
        if _right(r):
            continue
        left = ", ".join(f"{v:.3g}" for v in r["left"])
        line = f"#{r['index']} {r['family']} {r['kind']}: hidden {', '.join(r['truth']) or 'nothing'}"
        line += f" {r['sizes']}, {left} noise floors" if r["truth"] else ""
        rivals = {k: v for k, v in json.loads(r["rivals"]).items() if v}
        said = r["error"] or " ".join([r["verdict"], ", ".join(r["named"])]).strip()
        out.append(f"{line}; said {said}" + (f", rivals {rivals}" if rivals else ""))
    return out


# ---- the command -----------------------------------------------------------------------------------------------------


def _before(path: Path, families: tuple[str, ...]) -> list[Row]:
    """Rows of an earlier run with the same families."""
    if not path.exists():
        return []
    rows = read_rows(path, "hidden_law")
    if any(not {"left", "variants", "families", "seed", "amounts"} <= set(r) for r in rows):
        raise InputError(f"{path}: not a result of hidden_law (columns left, variants, families, amounts are needed)")
    if any(r["families"] != " ".join(families) for r in rows):
        was = rows[0]["families"] or "all"
        raise InputError(f"{path}: drawn from families {was}; allowed: the same --family, or another --out")
    return rows


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    for name in args.family:
        if name not in rig.FAMILIES:
            raise InputError(f"--family {name!r}: not a family; allowed: {', '.join(rig.FAMILIES)}")
    check_run(args, "systems")
    families, path = tuple(dict.fromkeys(args.family)), Path(args.out)
    rows = _before(path, families)
    seed = args.seed if args.seed is not None else (rows[0]["seed"] if rows else secrets.randbelow(2**31))
    others = [r for r in rows if r["seed"] != seed]
    if others:
        raise InputError(f"{path}: drawn with seed {others[0]['seed']}; allowed: that --seed, or another --out")
    if args.variants and any(r["variants"] == "{}" and not r["error"] for r in rows):
        raise InputError(f"{path}: has rows without variants; allowed: no --variants, or another --out")
    if args.learn and any((r.get("learned") or "{}") == "{}" and not r["error"] for r in rows):
        raise InputError(f"{path}: has rows without --learn; allowed: no --learn, or another --out")
    if rows and args.leave_out != any(r["kind"] == "left out" for r in rows):
        raise InputError(
            f"{path}: has rows {'without' if args.leave_out else 'of'} --leave-out; allowed: another --out"
        )
    if set(args.kinds) != set(KINDS) and (args.leave_out or args.surface):
        raise InputError(f"--kinds {' '.join(args.kinds)}: not with --leave-out or --surface, which draw their own")
    if other := {r["kind"] for r in rows} - {*args.kinds, "left out", "surface"}:
        raise InputError(f"{path}: has rows of kind {min(other)}; allowed: --kinds with it, or another --out")
    terminal.say(args, f"seed {seed}; {len(rows)} systems done before")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(f"{path.parent}: cannot be made ({e.strerror})") from None
    run(
        args,
        "systems",
        args.systems,
        rows,
        path,
        judge_case,
        seed,
        families,
        args.variants,
        args.learn,
        args.leave_out,
        args.surface,
        tuple(k for k in KINDS if k in args.kinds),
    )
    _print(args, rows)
    tables = {"by_size": by_size(rows), "by_family": by_family(rows), "misses": misses(rows)}
    terminal.write_json(args, {"schema": 1, "seed": seed, "summary": summary(rows), **tables})
    return 0


def _print(args: argparse.Namespace, rows: list[Row]) -> None:
    s = summary(rows)
    title = f"{len(rows)} systems, {s['median processor seconds']:.1f} processor seconds a diagnosis (median)"
    print_shares(args, title, s)
    terminal.print_table(args, "single laws, by what they leave", ["noise floors", "found"], by_size(rows))
    terminal.print_table(args, "whole answers right", ["family", "right"], by_family(rows))
    for line in misses(rows):
        terminal.say(args, "miss " + line)


if __name__ == "__main__":
    start.run("benchmarks.hidden_law")
