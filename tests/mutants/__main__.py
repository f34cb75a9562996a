"""`make mutants`: print which mutants the tests kill; exit 1 where they kill too few."""

from __future__ import annotations

import argparse
import os
import sys
import time
import tomllib
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"
os.environ.setdefault("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
os.environ["PYTHONHASHSEED"] = "0"

from .campaign import Outcome, Target, run_target, sample
from .mutate import Mutant

ENOUGH = 0.95  # of the mutants that are not equivalent
FIRMWARE = ("firmware", "modes", "monitors", "records", "schedule", "servo", "strategies", "trend")
TARGETS = (
    Target(
        "firmware",
        tuple(f"controller/{part}.py" for part in FIRMWARE),
        (
            "tests/test_firmware_spec.py",
            "tests/test_controller.py::test_look_up_is_exact_at_its_breakpoints_and_its_ends",
            "tests/test_controller.py::test_one_wrong_demand_never_turns_the_direction",
            "tests/test_controller.py::test_start_takes_init_time_then_standby_then_run",
            "tests/test_controller.py::test_names_and_indices_of_inputs_scalars_states_and_faults_belong_together",
        ),
    ),
    Target(
        "frames",
        ("hil/bus/frames.py",),
        ("tests/test_frames.py",),
        "lockstep or recorded_run or one_wrong_frame or ecu_and or silence_is or health_tells or fifth_refused or "
        "speed_out",
    ),
    Target(
        "wire", ("hil/bus/wire.py",), ("tests/test_wire.py",), "compiled or cantools_and_e2e or noticed or fast_loop"
    ),
    Target("node", ("hil/loop/node.py",), ("tests/test_node.py",)),
    Target("effects", ("plant/effects/*.py",), ("tests/test_effects_reference.py",), constants=False),
    Target("drive", ("plant/drive.py",), ("tests/test_effects_reference.py",), constants=False, only="step"),
    Target(
        "search",
        (
            "vaneloop/discrepancy/descent.py",
            "vaneloop/discrepancy/diagnose.py",
            "vaneloop/discrepancy/fit.py",
            "vaneloop/discrepancy/noise_floor.py",
            "vaneloop/discrepancy/search.py",
            "vaneloop/discrepancy/workflow.py",
            "vaneloop/discrepancy/locate.py",
        ),
        (
            "tests/test_search_limits.py",
            "tests/test_names.py::test_nine_tenths_are_neither_less_nor_more",
            "tests/test_names.py::test_half_of_the_excess_is_the_limit",
            "tests/test_names.py::test_two_stages_may_differ_by_half_of_a_size",
        ),
        functions=False,
    ),
)
BY_NAME = {t.name: t for t in TARGETS}
EQUIVALENT = Path(__file__).with_name("equivalent.toml")


def equivalents(mutants: dict[str, list[Mutant]]) -> dict[str, str]:
    """Return the reason by `Mutant.name`; exit with one line where an entry is of no mutant (any more)."""
    known = {m.name for found in mutants.values() for m in found}
    files = {m.file for found in mutants.values() for m in found}
    out = {}
    for entry in tomllib.loads(EQUIVALENT.read_text()).get("equivalent", []):
        for name in entry["mutants"]:
            if name.split(" ")[0] in files and name not in known:
                raise SystemExit(f"{EQUIVALENT.name}: there is no mutant {name}")
            out[name] = entry["reason"]
    return out


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    p = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    p.add_argument("targets", nargs="*", choices=[[], *BY_NAME], help=f"of {', '.join(BY_NAME)}; default: all")
    p.add_argument("--all", action="store_true", help="every mutant, not a sample")
    p.add_argument("--sample", type=int, default=100, help="mutants of each target, by --seed (100)")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--jobs", type=int, default=2)
    p.add_argument("--match", default="", help="only mutants whose line of output has this in it")
    p.add_argument("--list", action="store_true", help="print the mutants and run nothing")
    p.add_argument("--verbose", action="store_true", help="print the killed ones too")
    a = p.parse_args(arguments)
    targets = [BY_NAME[n] for n in a.targets] or list(TARGETS)
    mutants = {t.name: t.mutants() for t in targets}
    reasons = equivalents(mutants)
    chosen = {
        n: [m for m in sample(f, None if a.all else a.sample, a.seed) if a.match in str(m)] for n, f in mutants.items()
    }
    if a.list:
        for found in chosen.values():
            print(*found, sep="\n")
        return 0
    enough = True
    for t in targets:
        begin = time.monotonic()

        def say(o: Outcome) -> None:
            if a.verbose and o.by:
                print(f"killed    {o.mutant}   by {o.by.splitlines()[-1][:160]}", flush=True)
            elif not o.by and o.mutant.name not in reasons:
                print(f"SURVIVED  {o.mutant}", flush=True)

        outcomes = run_target(t, chosen[t.name], a.jobs, say) if chosen[t.name] else []
        killed = sum(bool(o.by) for o in outcomes)
        equivalent = [o for o in outcomes if not o.by and o.mutant.name in reasons]
        wrong = [o for o in outcomes if o.by and o.mutant.name in reasons]
        for o in wrong:
            print(f"NOT EQUIVALENT, though {EQUIVALENT.name} says so: {o.mutant}, killed by {o.by}")
        count = len(outcomes) - len(equivalent)
        share = killed / count if count else 1.0
        minutes = (time.monotonic() - begin) / 60.0
        print(
            f"{t.name}: {killed} of {count} killed ({100.0 * share:.1f} %), {count - killed} survived, "
            f"{len(equivalent)} equivalent; {len(mutants[t.name])} mutants in all, {minutes:.1f} min",
            flush=True,
        )
        enough = enough and share >= ENOUGH and not wrong
    if not enough:
        print(f"mutants: fewer than {100.0 * ENOUGH:.0f} % killed, or an equivalent one that is not")
    return 0 if enough else 1


if __name__ == "__main__":
    sys.exit(main())
