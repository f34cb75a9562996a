"""`make mutants`: print which mutants the tests kill; exit 1 where they kill too few."""

from __future__ import annotations

import argparse
import ast
import json
import os
import sys
import tempfile
import time
import tomllib
from collections import Counter
from fnmatch import fnmatch
from pathlib import Path

from numba.core import config

from vaneloop.identification import settings

from .campaign import ROOT, SETTINGS, Outcome, Target, run_target, sample
from .mutate import Mutant, mutants_of

ENOUGH = 0.90  # of the mutants that are not equivalent
STRICT = 0.95  # where a wrong answer is sent or believed: firmware, wire, calibration, diagnosis, search
FIRMWARE = ("firmware", "modes", "monitors", "records", "schedule", "servo", "strategies", "trend")
SEARCH = tuple(
    f"vaneloop/identification/{f}.py"
    for f in (
        "least_squares/levenberg_marquardt", "selection/diagnosis", "least_squares/problem",
        "selection/likelihood_acceptance", "selection/search", "workflow", "regimes",
    )
)  # fmt: skip


def read_by(files: tuple[str, ...]) -> tuple[str, ...]:
    """Thresholds of the identification that these files import."""
    lines = [s for f in files for s in ast.parse((ROOT / f).read_text()).body if isinstance(s, ast.ImportFrom)]
    return tuple(sorted({a.name for s in lines if s.module == settings.__name__ for a in s.names}))


def under(package: str) -> tuple[str, ...]:
    """Thresholds of the identification that a room of it reads: its tests hold them."""
    if not package.startswith("vaneloop.identification"):
        return ()
    files = (ROOT / package.replace(".", "/")).glob("*.py")
    return read_by(tuple(sorted(str(f.relative_to(ROOT)) for f in files)))


def files_of(package: str) -> tuple[str, ...]:
    """A package's own files, and the record of thresholds where it reads some."""
    own = f"{package.replace('.', '/')}/*.py"
    return (own, SETTINGS) if under(package) and not fnmatch(SETTINGS, own) else (own,)


TARGETS: tuple[Target, ...] = (
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
        enough=STRICT,
    ),
    Target(
        "frames",
        ("hil/bus/frames.py",),
        ("tests/test_frames.py",),
        "lockstep or recorded_run or one_wrong_frame or ecu_and or silence_is or health_tells or fifth_refused or "
        "speed_out",
        enough=STRICT,
    ),
    Target(
        "wire",
        ("hil/bus/wire.py",),
        ("tests/test_wire.py",),
        "compiled or cantools_and_e2e or noticed or fast_loop",
        enough=STRICT,
    ),
    Target("node", ("hil/loop/node.py",), ("tests/test_node.py",), enough=STRICT),
    Target("effects", ("plant/effects/*.py",), ("tests/test_effects_reference.py",), constants=False, enough=STRICT),
    Target(
        "drive", ("plant/drive.py",), ("tests/test_effects_reference.py",), constants=False, only="step", enough=STRICT
    ),
    Target(
        "search",
        (*SEARCH, SETTINGS),
        (
            "tests/test_search_limits.py",
            "tests/test_descent.py",
            "tests/test_names.py::test_nine_tenths_are_neither_less_nor_more",
            "tests/test_names.py::test_half_of_the_excess_is_the_limit",
            "tests/test_names.py::test_two_stages_may_differ_by_half_of_a_size",
        ),
        functions=False,
        enough=STRICT,
        thresholds=read_by(SEARCH),
    ),
)
CORE = (
    "vaneloop.identification",
    *(f"vaneloop.identification.{p}" for p in ("candidates", "least_squares", "selection")),
)
OWN_MODELS = ("vaneloop.identification.user_models", "vaneloop.identification.unmodelled")
# Of each package the files of tests that are nearest to it, where its code runs as it does for a user: compiled.
NEAREST = {
    "controller": "records_spec controller channels two_actuators xcp tables c_reference node",
    "plant": (
        "plant_spec plant effects effects_reference linkage electromechanical machines tables tolerances lanes "
        "curve_lanes spatial fmu two_actuators"
    ),
    "plant.stages": "stages_spec curve_lanes same_answer lanes effects machines electromechanical loggers",
    **dict.fromkeys(
        ("hil", "hil.replay"), "hil_spec replay held figures page reading lockstep strategies schedule campaign"
    ),
    "hil.bus": "bus_spec bus_port_spec bus_lockstep_spec bus frames wire loop moments realtime node uds secoc",
    "hil.logs": (
        "logs logs_frames_spec logs_names_spec logs_others_spec logs_parts_spec logs_reading_spec logs_record_spec "
        "logs_recorded_spec logs_tables_spec loggers reading readings guess held record logs_fuzz formulas "
        "formulas_spec field_traces tables_of_the_field transport log_formats recorders dataframes child"
    ),
    "hil.native": "native_spec native c_reference xcp",
    "hil.loop": (
        "loop_spec loop_parts_spec loop lanes lockstep node secoc realtime moments replay native machines frames "
        "strategies scenarios_in_lanes gpu channels two_actuators"
    ),
    "hil.fmu": "fmu_spec fmu",
    "hil.calibrate": "xcp uds xcp_spec tool_states",
    "hil.uds": "uds uds_spec tool_states",
    "hil.inject": (
        "inject fuzz campaign loop moments inject_spec inject_parts_spec fuzz_spec scenarios_in_lanes gpu tool_states "
        "native"
    ),
    "vaneloop": "verbs",
    "vaneloop.base": (
        "base_spec tables_spec files streams lean tables kept parts held machines identification learn_surfaces "
        "learn_turns learn_stops exit_codes your_own_model verbs help curve_lanes cells child sizes plant_spec"
    ),
    **dict.fromkeys(
        CORE,
        "selection_spec search_spec acceptance_spec least_squares_spec descent_steps_spec regimes_spec answer_spec "
        "candidates_spec onset identification rules descent never_worse finite trust latest laws names search_limits "
        "search_ahead promise directions rivals curves readings held long_logs doubts learn_slopes same_answer",
    ),
    "vaneloop.identification.candidates": (
        "candidates_spec laws own_laws curves curves_of_nobody hidden_law learn learn_band learn_confirmed "
        "learn_differences learn_periods kept promise selection_spec"
    ),
    **dict.fromkeys(
        OWN_MODELS,
        "user_models_spec model_warnings_spec unmodelled_spec curve_choice_spec curves_in_place_spec curve_search_spec "
        "experiment_own laws own_laws hidden_law learn learn_beside learn_confirmed "
        "learn_creep learn_differences learn_faint learn_followers learn_lags learn_periods learn_screening "
        "learn_slopes learn_speed learn_stops learn_surfaces learn_turns learn_two learn_vanes promise spikes "
        "starts your_own_model kept held",
    ),
    "vaneloop.identification.vane_chain": (
        "vane_chain_spec vane_chain_clocks_spec vane_chain_noise_spec vane_chain_parts_spec vane_chain_search_spec "
        "recorders hum stationary_noise late_channels same_answer learn_vanes learn_lags learn_stops learn_followers "
        "learn_faint learn_screening held loggers long_logs identification curves directions electromechanical "
        "readings two_actuators onset"
    ),
    "vaneloop.design": "design_spec schedule_spec design schedule spatial strategies tables tolerances",
    "vaneloop.fleet": (
        "fleet_folder fleet_trends fleet_workers campaign_numbers fleet_report fleet_run campaign fleet_damage "
        "probability cells gpu"
    ),
    "vaneloop.pages": (
        "page_parts page_outlines page design campaign fleet_report schedule strategies spatial verbs search_commands "
        "learn_turns"
    ),
    "vaneloop.verbs": (
        "verbs_spec verbs parts held long_logs guess starts spikes doubts machines learn_two own_laws your_own_model "
        "search_commands trust latest late_channels dataframes steady_points"
    ),
    "vaneloop.cli": (
        "cli_spec cli_commands_spec experiment_own help exit_codes completion verbs search_commands "
        "campaign fuzz inject record design fleet_report fmu guess schedule strategies spatial "
        "never_worse native xcp uds reading electromechanical"
    ),
    "vaneloop.web": "web_spec web_pages_spec web_processes_spec web moments",
}
OF_A_GPU = {"hil.loop": ("cuda.py",)}  # a part of its own: numba's simulator runs it in another process
STRICTLY = ("controller", "hil.bus", "hil.calibrate", "hil.uds", *CORE)
TARGETS += tuple(
    Target(
        package,
        files_of(package),
        tuple(f"tests/test_{name}.py" for name in tests.split()),
        compiled=True,
        enough=STRICT if package in STRICTLY else ENOUGH,
        but=OF_A_GPU.get(package, ()),
        thresholds=under(package),
    )
    for package, tests in NEAREST.items()
)
TARGETS += (Target("hil.loop.cuda", ("hil/loop/cuda.py",), ("tests/test_gpu.py",), compiled=True),)
# What numba compiles of them, uncompiled: with those of these tests that are quick then.
KERNELS = {
    "plant": "plant effects_reference linkage electromechanical tables curve_lanes",
    "plant.stages": "curve_lanes effects_reference same_answer electromechanical",
    "hil.loop": "loop_spec loop_parts_spec loop lanes lockstep node moments",
    "vaneloop.base": "tables learn_surfaces learn_stops your_own_model",
    "vaneloop.design": "design_spec schedule_spec design schedule",
    **dict.fromkeys(CORE, "laws identification names search_limits promise trust"),
    **dict.fromkeys(OWN_MODELS, "laws learn hidden_law"),
    "vaneloop.identification.vane_chain": "same_answer learn_vanes",
}
TARGETS += tuple(
    Target(
        f"{package}.kernels",
        files_of(package),
        tuple(f"tests/test_{name}.py" for name in tests.split()),
        kernels=True,
        enough=STRICT if package in STRICTLY else ENOUGH,
        thresholds=under(package),
    )
    for package, tests in KERNELS.items()
)
BY_NAME = {t.name: t for t in TARGETS}
EQUIVALENT = Path(__file__).with_name("equivalent.toml")


def equivalents(mutants: list[Mutant]) -> dict[str, str]:
    """Return the reason by `Mutant.name`; exit with one line where an entry is of no mutant (any more)."""
    files = {m.file for m in mutants}
    entries = tomllib.loads(EQUIVALENT.read_text()).get("equivalent", [])
    out = {name: entry["reason"] for entry in entries for name in entry["mutants"] if name.split(" ")[0] in files}
    known = {m.name for m in mutants}
    if not out.keys() <= known:  # of a function that this target leaves as it is
        known |= {m.name for f in {name.split(" ")[0] for name in out} for m in mutants_of(ROOT, f)}
    for name in out.keys() - known:
        raise SystemExit(f"{EQUIVALENT.name}: there is no mutant {name}")
    return out


def apart(target: Target, chosen: list[Mutant], jobs: int, reasons: dict[str, str], verbose: bool) -> list[Outcome]:
    """`run_target` in a process of its own, for numba reads once whether it compiles; print what it finds."""
    by_name = {m.name: m for m in chosen}
    at = Path(tempfile.mkstemp(suffix=".json")[1])
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        code = 2
        try:
            os.environ["NUMBA_DISABLE_JIT"] = "0" if target.compiled else "1"
            folder = config.CACHE_DIR  # type: ignore[attr-defined]
            # else the first test that compiles reads it, and forgets the folder
            config.reload_config()  # type: ignore[no-untyped-call]
            config.CACHE_DIR = folder  # type: ignore[attr-defined]

            def say(o: Outcome) -> None:
                if verbose and o.by:
                    print(f"killed       {o.mutant}   by {o.by.splitlines()[-1][:160]}", flush=True)
                elif not o.by and o.mutant.name not in reasons:
                    print(f"{'SURVIVED   ' if o.reached else 'NOT REACHED'}  {o.mutant}", flush=True)

            outcomes = run_target(target, chosen, jobs, say)
            at.write_text(json.dumps([(o.mutant.name, o.by, o.reached) for o in outcomes]))
            code = 0
        except SystemExit as e:
            print(e.code, file=sys.stderr, flush=True)
        finally:
            sys.stdout.flush()
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if code:
        raise SystemExit(f"mutants: {target.name}: could not be tried")
    found = json.loads(at.read_text())
    at.unlink()
    return [Outcome(by_name[name], by, reached) for name, by, reached in found]


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    p = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    p.add_argument("targets", nargs="*", choices=[[], *BY_NAME], help="default: all")
    p.add_argument("--all", action="store_true", help="every mutant, not a sample")
    p.add_argument("--sample", type=int, default=100, help="mutants of each target, by --seed (100)")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--jobs", type=int, default=2)
    p.add_argument("--match", default="", help="only mutants whose line of output has this in it")
    p.add_argument("--list", action="store_true", help="print the mutants and run nothing")
    p.add_argument("--verbose", action="store_true", help="print the killed ones too")
    a = p.parse_args(arguments)
    os.environ.setdefault("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    os.environ["PYTHONHASHSEED"] = "0"
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"  # threads would not outlive a fork
    table = [f"{'':32}{'mutants':>8}{'sampled':>9}{'reached':>9}{'killed':>8}{'equal':>7}{'of the rest':>13}{'min':>6}"]
    short = []
    for t in [BY_NAME[n] for n in a.targets] or TARGETS:
        begin = time.monotonic()
        mutants = t.mutants()
        reasons = equivalents(mutants)
        matching = [m for m in mutants if a.match in str(m)]
        chosen = sample(matching, None if a.all else a.sample, a.seed)
        if a.list:
            print(*chosen, sep="\n")
            continue
        outcomes = apart(t, chosen, a.jobs, reasons, a.verbose) if chosen else []
        wrong = [o for o in outcomes if o.by and o.mutant.name in reasons]
        for o in wrong:
            print(f"NOT EQUIVALENT, though {EQUIVALENT.name} says so: {o.mutant}, killed by {o.by}")
        n = Counter("killed" if o.by else "equivalent" if o.mutant.name in reasons else "survived" for o in outcomes)
        count = n["killed"] + n["survived"]
        share = n["killed"] / count if count else 1.0
        reached = sum(o.reached for o in outcomes)
        minutes = (time.monotonic() - begin) / 60.0
        table.append(
            f"{t.name:32}{len(mutants):8}{len(outcomes):9}{reached:9}{n['killed']:8}{n['equivalent']:7}"
            f"{100.0 * share:11.1f} %{minutes:6.1f}"
        )
        print(table[0], table[-1], sep="\n", flush=True)
        if share < t.enough or wrong:
            short.append(f"{t.name}: needs {100.0 * t.enough:.0f} %" + (", and its list is wrong" if wrong else ""))
    if len(table) > 2:
        print("", *table, sep="\n")
    for line in short:
        print(f"too few are killed in {line}")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
