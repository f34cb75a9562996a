"""A controller of the user's own in C: the interface, the bits of the firmware, failures in processes of their own."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from benchmarks.ours import profile, troubled
from controller import Calibration, load_calibration, new_inputs, new_state
from controller.header import FOLDER, VERSION, header
from controller.records import (
    INPUT_FIELDS,
    INPUTS,
    OBSERVABLE_FIELDS,
    OUTPUT_FIELDS,
    OUTPUTS,
    SCALAR_FIELDS,
    STATE,
    STRATEGIES,
    flat_names,
)
from hil.inject import injection
from hil.inject.any_controller import load_reactions
from hil.inject.fuzz import fuzz
from hil.loop.lockstep import Stimulus, lockstep
from hil.loop.node import Node
from hil.native import Program
from hil.native.call import firmware
from hil.native.isolation import ControllerFailed, isolated
from hil.native.program import _VIEWS, observables, readable, restore, save
from tests.conftest import ROOT, quick_first
from tests.native_builds import BITWISE, REFERENCE, build, wrong
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import VANES
from vaneloop.cli.main import main

SEGV = "*(volatile int *)0 = 1;"


@pytest.fixture(scope="module")
def reference(gcc: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    return build(gcc, REFERENCE, tmp_path_factory.mktemp("reference") / "reference.so", *BITWISE)


def with_program(path: str, **options: str) -> Calibration:
    return load_calibration(**options)._replace(program=Program(path))


# ---- the header ------------------------------------------------------------------------------------------------------


def test_the_header_is_what_the_records_say() -> None:
    text = (FOLDER / "vaneloop_controller.h").read_text(encoding="utf-8")
    assert text == header(), "python -m controller.header > controller/native/vaneloop_controller.h"


def test_every_field_lies_in_c_where_the_record_has_it(gcc: str, tmp_path: Path) -> None:
    structs = {
        "inputs": INPUT_FIELDS, "outputs": OUTPUT_FIELDS, "observables": OBSERVABLE_FIELDS, "scalars": SCALAR_FIELDS,
    }  # fmt: skip
    lines = [f'P("{s} {f.name}", offsetof(vaneloop_{s}, {f.name}));' for s, fields in structs.items() for f in fields]
    lines += [f'P("{s}", sizeof(vaneloop_{s}));' for s in structs]
    source = tmp_path / "offsets.c"
    source.write_text(
        '#include <stdio.h>\n#include "vaneloop_controller.h"\n#define P(n, v) printf("%s %zu\\n", n, (size_t)(v))\n'
        f"int main(void) {{ {' '.join(lines)} return 0; }}\n"
    )
    program = tmp_path / "offsets"
    subprocess.run([gcc, "-std=c99", "-Wall", "-Werror", f"-I{FOLDER}", "-o", program, source], check=True)
    said = subprocess.run([program], capture_output=True, text=True, check=True).stdout.splitlines()
    expected = []
    for s, fields in structs.items():
        at = 0
        for f in fields:
            expected.append(f"{s} {f.name} {8 * at}")
            at += len(f.each) or 1
    expected += [f"{s} {8 * len(flat_names(fields))}" for s, fields in structs.items()]
    assert said == expected


def test_the_header_is_c99_and_c_plus_plus(gcc: str, tmp_path: Path) -> None:
    for language, standard in (("c", "c99"), ("c++", "c++11")):
        words = [gcc, "-x", language, f"-std={standard}", "-pedantic", "-Werror", "-fsyntax-only"]
        done = subprocess.run(
            [*words, str(FOLDER / "vaneloop_controller.h")], capture_output=True, text=True, check=False
        )
        if "cc1plus" in done.stderr:
            continue  # a gcc without C++
        assert done.returncode == 0, done.stderr


# ---- the same bits ---------------------------------------------------------------------------------------------------


@njit(cache=False)
def _outputs(rows, z, calibration, foreign, out):
    """Outputs of every tick; the piston moves with the current, and the inputs hold what its measurement adds."""
    x = 0.01
    for i in range(rows.shape[0]):
        rows[i, X_LVDT] += x
        firmware(rows[i], out[i], z, calibration, foreign)
        x = min(max(x + 3.75e-3 * out[i, 0], 0.0), 0.048)  # 150 mm/s at 40 mA


X_LVDT = INPUTS.index("x_lvdt")


def wild_inputs(ticks: int, seed: int) -> np.ndarray:
    """Inputs of a controller, tick by tick, with everything thrown in that cannot be; of the stroke its error."""
    rng = np.random.default_rng(seed)
    column = {name: i for i, name in enumerate(INPUTS)}
    rows = np.tile(new_inputs(), (ticks, 1))
    t = np.arange(ticks) * 1e-3
    n = np.clip(
        80.0 + 25.0 * np.sin(2 * np.pi * t / rng.uniform(5, 60)) + np.cumsum(rng.normal(0, 0.01, ticks)), 0, 120
    )
    rows[:, column["n_dem"]], rows[:, column["n_r"]] = n, n + rng.normal(0, 0.1, ticks)
    fresh = (np.arange(ticks) % 10 == 0) & (rng.random(ticks) < rng.choice([1.0, 0.98, 0.9]))
    quiet = rng.integers(0, ticks, 20)[:, None] + np.arange(0, 700)[None]
    fresh[np.minimum(quiet.ravel(), ticks - 1)] = False
    rows[:, column["demand_fresh"]] = fresh
    rows[:, column["demand_rejected"]] = (rng.random(ticks) < 2e-4) * rng.integers(0, 20, ticks)
    rows[:, column["mode_request"]] = np.repeat(rng.choice([1.0, 1.0, 1.0, 0.0], ticks // 1000 + 1), 1000)[:ticks]
    rows[:, column["x_lvdt"]] = rng.normal(0, 5e-6, ticks)
    for vane in VANES[:3]:  # angles that hang about what the tables say, and some that do not
        share, offset = rng.uniform(0.9, 1.1), rng.normal(0, 0.02)
        rows[:, column[vane]] = np.interp(n, [0.0, 120.0], [-0.6, 0.9]) * share + offset
    for begin in rng.integers(0, ticks, ticks // 20_000 + 2):  # the LVDT is gone, has jumped, does not move
        some = slice(begin, begin + rng.integers(5, 3000))
        rows[some, column["x_lvdt"]] = rng.choice([np.nan, 0.004, -0.3])
    for name, share in (("n_dem", 1e-3), ("n_r", 1e-3), ("x_lvdt", 2e-3), ("demand_rejected", 2e-5), ("pause", 2e-5)):
        bad = rng.random(ticks) < share
        rows[bad, column[name]] = rng.choice([np.nan, np.inf, -np.inf, 1e9, -5.0, 0.03, 0.2], int(bad.sum()))
    return rows


def both(reference: str, ticks: int, seed: int) -> None:
    """Fail unless firmware and C give the same bits in every tick of wild inputs."""
    rows = wild_inputs(ticks, seed)
    calibration = load_calibration(strategy=STRATEGIES[seed % 4])
    given = [np.zeros((ticks, len(OUTPUTS))) for _ in range(2)]
    states = [new_state() for _ in range(2)]
    _outputs(rows.copy(), states[0], calibration, (), given[0])
    _outputs(rows, states[1], calibration, Program(reference).start(calibration), given[1])
    differs = (given[0].view(np.int64) != given[1].view(np.int64)).any(axis=1)
    differs &= (given[0] != given[1]).any(axis=1)  # +0 and -0 are the same current
    assert not differs.any(), f"seed {seed}, tick {np.argmax(differs)}: {given[0][differs][0]} {given[1][differs][0]}"
    for name in flat_names(OBSERVABLE_FIELDS):
        assert states[0][STATE.index(name)] == states[1][STATE.index(name)], name
    modes = set(given[0][:, OUTPUTS.index("mode")])
    assert modes >= {0.0, 1.0, 2.0, 3.0, 4.0}


@pytest.mark.slow
def test_wild_inputs_give_the_same_bits_as_the_firmware(reference: str) -> None:
    for seed in range(4):
        both(reference, 100_000, seed)


@pytest.mark.slow
def test_ten_million_ticks_of_wild_inputs_give_the_same_bits(reference: str) -> None:
    for seed in range(10):
        both(reference, 1_000_000, 100 + seed)


@pytest.mark.parametrize("strategy", quick_first(["dual", "single", "inverse", "adaptive"]))
def test_the_closed_loop_gives_the_same_bits_as_the_firmware(reference: str, strategy: str) -> None:
    for stimulus in (Stimulus.of(profile(130.0)), troubled(130.0)):
        runs = [
            lockstep(stimulus, calibration=c, seed=3, every=1).columns
            for c in (load_calibration(strategy=strategy), with_program(reference, strategy=strategy))
        ]
        for name, values in runs[0].items():
            np.testing.assert_array_equal(values, runs[1][name], err_msg=name)


SOME = ("bad_day", "demand_stops", "lvdt_jumps", "supply_lost", "garbage_in_frames")


def same_outcome(reference: str, name: str) -> None:
    ours, theirs = injection.run(name), injection.run(name, calibration=with_program(reference))
    assert (ours.modes, ours.faults, ours.counts) == (theirs.modes, theirs.faults, theirs.counts)
    assert theirs.held, theirs.text()
    for what, values in ours.trace.signals.items():
        np.testing.assert_array_equal(values, theirs.trace.signals[what], err_msg=f"{name} {what}")


@pytest.mark.slow
@pytest.mark.parametrize("name", SOME)
def test_a_scenario_is_the_same_to_the_bit(reference: str, name: str) -> None:
    same_outcome(reference, name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in injection.library() if n not in SOME])
def test_every_scenario_is_the_same_to_the_bit(reference: str, name: str) -> None:
    same_outcome(reference, name)


def test_a_changed_table_is_the_same_to_the_bit_while_it_runs(reference: str) -> None:
    """An effect that changes the flashed tables acts on the controller's own pointers to them."""
    change = injection.Machine(start=2.0, duration=2.0, effect="schedule_error", parameters={"offset": 0.5})
    scenario = injection.Scenario(title="tables change", duration=6.0, inject=[change])
    traces = [injection.run(scenario, calibration=c).trace for c in (load_calibration(), with_program(reference))]
    for what, values in traces[0].signals.items():
        np.testing.assert_array_equal(values, traces[1].signals[what], err_msg=what)


@pytest.mark.slow
def test_a_fuzz_campaign_is_the_same(reference: str) -> None:
    ours, theirs = fuzz(20_000, 3), fuzz(20_000, 3, calibration=with_program(reference))
    assert ours.failure is None and theirs.failure is None
    assert (ours.transitions == theirs.transitions).all() and ours.verdicts == theirs.verdicts
    assert ours.longest_recovery_s == theirs.longest_recovery_s


# ---- state -----------------------------------------------------------------------------------------------------------

NONE = np.zeros((1, 2), np.int64)


def test_two_loops_have_two_copies(reference: str) -> None:
    def ticked(nodes: list[Node], ticks: int) -> list[str]:
        for _ in range(ticks):
            for node in nodes:
                node.tick(NONE, 0)
        return [node.fingerprint() for node in nodes]

    def made(n_r: float) -> Node:
        return Node(calibration=with_program(reference), n_r=n_r, seed=1)

    assert ticked([made(60.0), made(90.0)], 700) == [*ticked([made(60.0)], 700), *ticked([made(90.0)], 700)]


def test_a_state_that_is_given_back_goes_on_with_the_same_bits(reference: str) -> None:
    calibration = load_calibration()
    rows = wild_inputs(20_000, 7)
    foreign, z, out = Program(reference).start(calibration), new_state(), np.zeros((len(rows), len(OUTPUTS)))
    _outputs(rows[:7000].copy(), z, calibration, foreign, out[:7000])
    kept, kept_z = save(foreign), z.copy()
    _outputs(rows[7000:].copy(), z, calibration, foreign, out[7000:])
    other, again = Program(reference).start(calibration), np.zeros((13_000, len(OUTPUTS)))
    restore(other, kept)
    _outputs(rows[7000:], kept_z, calibration, other, again)
    np.testing.assert_array_equal(again, out[7000:])


# ---- what goes wrong -------------------------------------------------------------------------------------------------

WRONG = {
    "crash": (SEGV, "ended by SIGSEGV"),
    "behind its outputs": ("((volatile double *)out)[4] = 1.0;", "ended by SIGSEGV"),
    "before its outputs": ("((volatile double *)out)[-1] = 1.0;", "it wrote outside the structs"),
    "no number": ("out->i_cmd = NAN;", "i_cmd (=nan A) must be a finite number"),
    "infinite": ("out->i_cmd = -INFINITY;", "i_cmd (=-inf A) must be a finite number"),
    "beyond the limit": ("out->i_cmd = -0.0401;", "i_cmd (=-0.0401 A) must be within the current_limit"),
    "no stroke": ("out->x_dem = NAN;", "x_dem (=nan m) must be a finite number"),
    "no mode": ("out->mode = 5.0;", "mode (=5) must be one of 0 to 4"),
    "half a mode": ("out->mode = 1.5;", "mode (=1.5) must be one of 0 to 4"),
    "no fault": ("out->faults = 512.0;", "faults (=512) must be a whole number from 0 to 511"),
    "abort": ("abort();", "ended by SIGABRT (it aborted)"),
    "exit": ("exit(0);", "ended with code 0"),
    "its own limit": (
        "((vaneloop_scalars *)flashed->scalars)->current_limit = 100.0; out->i_cmd = 5.0;", "ended by SIGSEGV"
    ),
    "its own limit by force": (
        "mprotect((void *)((size_t)flashed->scalars / 4096 * 4096), 4096, PROT_READ | PROT_WRITE);"
        "((vaneloop_scalars *)flashed->scalars)->current_limit = 100.0; out->i_cmd = 5.0;",
        "ended by SIGSEGV",
    ),
    "before its outputs' page": ("((volatile double *)out)[-600] = 1.0;", "ended by SIGSEGV"),
    "catches its end": ("signal(SIGABRT, SIG_IGN); out->i_cmd = NAN;", "i_cmd (=nan A) must be a finite number"),
    "recursion": ("sink = deep(1.0);", "ended by SIGSEGV"),
    "a copy goes on in its place": ("if (!times++ && fork()) _exit(0);", "ended with code 0"),
    "its guard": ("if (!times++) kill(getppid(), SIGKILL); for (;;) sink += 1.0;", "ended what watches it"),
}  # fmt: skip
DEEP = "static double deep(double x) { volatile double y[99]; y[0] = x; return deep(x + 1.0) + y[0]; }"


def in_lockstep(calibration: Calibration, seconds: float = 2.0) -> float:
    run = lockstep(Stimulus.of(np.full(int(seconds * 100), 80.0)), calibration=calibration, hashed=False)
    return float(run.columns["x_dem"][-1])


@pytest.mark.parametrize("case", WRONG)
def test_what_goes_wrong_ends_its_own_process_and_says_how(gcc: str, tmp_path: Path, case: str) -> None:
    fault, said = WRONG[case]
    calibration = with_program(wrong(gcc, tmp_path, fault, top=DEEP if case == "recursion" else ""))
    with pytest.raises(ControllerFailed) as failure:
        isolated(lambda: in_lockstep(calibration))
    text = str(failure.value)
    assert said in text and "\n" not in text
    assert "in tick 500, 0.500 s after power-on; last inputs: n_dem 80 %" in text


def test_a_controller_that_exits_waits_for_no_library(gcc: str, tmp_path: Path) -> None:
    calibration = with_program(wrong(gcc, tmp_path, "exit(3);"))
    child = os.fork()
    if child == 0:  # a process in which a library waits for ever when it ends
        code = 1
        try:
            libc = ctypes.CDLL(None)
            getattr(libc, "__cxa_atexit")(libc.pause, None, None)
            with pytest.raises(ControllerFailed, match="ended with code 3"):
                isolated(lambda: in_lockstep(calibration), patience=5.0)
            code = 0
        finally:
            os._exit(code)
    assert os.waitpid(child, 0)[1] == 0


def test_a_current_at_its_limit_in_single_precision_is_good(gcc: str, tmp_path: Path) -> None:
    path = wrong(gcc, tmp_path, "out->i_cmd = (double)0.04f;")
    assert isolated(lambda: in_lockstep(with_program(path))) == 10.0


def test_a_controller_that_hangs_is_ended(gcc: str, tmp_path: Path) -> None:
    path = wrong(gcc, tmp_path, "for (;;) sink += 1.0;")
    started = time.monotonic()
    with pytest.raises(ControllerFailed, match=r"did not come back within 1 s, in tick 500, 0\.500 s"):
        isolated(lambda: in_lockstep(with_program(path)), patience=1.0)
    assert time.monotonic() - started > 1.0


def test_a_crash_while_it_is_switched_on_is_told(gcc: str, tmp_path: Path) -> None:
    path = wrong(gcc, tmp_path, init=SEGV)
    with pytest.raises(ControllerFailed, match=r"ended by SIGSEGV .* while it was switched on"):
        isolated(lambda: in_lockstep(with_program(path)))


# what it leaves behind; NUMBER notes the number of the process
NUMBER = (
    'FILE *f = fopen("%s.new", "w"); fprintf(f, "%%d", getpid()); fclose(f); rename("%s.new", "%s");'
    "sleep(1000); _exit(0);"
)
LEFT = {
    "a child": "if (!times++ && !fork()) { NUMBER }",
    "with a session of its own": "if (!times++ && !fork()) { setsid(); NUMBER }",
    "a daemon": "if (!times++ && !fork()) { if (fork()) _exit(0); setsid(); if (fork()) _exit(0); NUMBER }",
    "that keeps signals off": (
        "if (!times++ && !fork()) { sigset_t all; sigfillset(&all); sigprocmask(SIG_BLOCK, &all, 0); setsid(); NUMBER }"
    ),
}


@pytest.mark.parametrize("crash", ["", SEGV])
@pytest.mark.parametrize("case", LEFT)
def test_a_process_that_it_leaves_behind_is_ended_and_not_waited_for(
    gcc: str, tmp_path: Path, case: str, crash: str
) -> None:
    noted = tmp_path / "numbers"
    fault = LEFT[case].replace("NUMBER", NUMBER % (noted, noted, noted))
    wait = f'while (access("{noted}", F_OK)) usleep(1000);'  # it is there before the run ends
    calibration = with_program(wrong(gcc, tmp_path, f"{fault} {wait} {crash}"))
    if crash:
        with pytest.raises(ControllerFailed, match="ended by SIGSEGV .* in tick 500"):
            isolated(lambda: in_lockstep(calibration))
    else:
        assert isolated(lambda: in_lockstep(calibration)) == 10.0
    with pytest.raises(ProcessLookupError):
        os.kill(int(noted.read_text()), 0)


def test_a_copy_of_the_process_does_not_run_the_loop(gcc: str, tmp_path: Path) -> None:
    """A fork that comes back from the step ends there: what follows the run is done once."""
    calibration = with_program(wrong(gcc, tmp_path, "if (!times++) fork();"))
    done = tmp_path / "done"

    def task() -> None:
        in_lockstep(calibration)
        with done.open("a") as f:
            f.write("once")

    isolated(task)
    assert done.read_text() == "once"


CLOSED = {
    "standard output": "close(1);",
    "standard error": 'close(2); open("/dev/null", O_WRONLY);',
    "a file descriptor": "for (int fd = 3; fd < 1024; fd++) close(fd);",
}


@pytest.mark.parametrize("said", CLOSED)
def test_who_closes_what_is_not_its_own_is_told(
    gcc: str, tmp_path: Path, said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = wrong(gcc, tmp_path, CLOSED[said])
    assert main(["run", "--bus", "lockstep", "--duration", "1", "--controller", path]) == 1
    assert capfd.readouterr().err == f"vaneloop: --controller {path}: it closed {said}, which is not its own\n"


HANGS = {
    "stopped": ({"fault": "raise(SIGSTOP);"}, r"was stopped for 0\.5 s, in tick 500"),
    "its guard stopped": (
        {"fault": "kill(getppid(), SIGSTOP); for (;;) sink += 1.0;"}, r"did not come back within 0\.5 s, in tick 500"
    ),
    "a copy beside it": ({"fault": "if (!times++) fork(); for (;;) sink += 1.0;"}, r"within 0\.5 s, in tick 500"),
    "its end": ({"top": "static void end(void) { for (;;) sink += 1.0; }", "fault": "atexit(end); exit(0);"},
                r"within 0\.5 s, in tick 500"),
    "its library's end": ({"top": "__attribute__((destructor)) static void end(void) { for (;;) sink += 1.0; }",
                           "fault": "exit(0);"}, "ended with code 0, in tick 500"),
    "its beginning": ({"top": "__attribute__((constructor)) static void begin(void) { for (;;) sink += 1.0; }"},
                      r"within 0\.5 s, in the loading of its library, while it was switched on"),
    "its black box": (
        {"fault": 'char line[512]; FILE *maps = fopen("/proc/self/maps", "r"); unsigned long a, b;'
                  'while (fgets(line, 512, maps)) if (strstr(line, "box-") && sscanf(line, "%lx-%lx", &a, &b))'
                  "memset((void *)a, 0xff, 4096); for (;;) sink += 1.0;"},
        r"did not come back within 0\.5 s$",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", quick_first(HANGS, 2))
def test_whatever_hangs_is_ended(gcc: str, tmp_path: Path, case: str) -> None:
    parts, said = HANGS[case]
    calibration = with_program(wrong(gcc, tmp_path, **parts))
    with pytest.raises(ControllerFailed, match=said):
        isolated(lambda: in_lockstep(calibration), patience=0.5)


def interrupted(ready: Path, first: Callable[[], object] = lambda: None) -> Callable[[], None]:
    """A task without end. Once it has done what is ``first``, this process gets Ctrl-C."""

    def task() -> None:
        first()
        ready.touch()
        while True:
            time.sleep(0.1)

    def interrupt() -> None:
        while not ready.exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    return task


def test_who_does_not_hear_an_interrupt_is_ended(gcc: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.native.isolation._ENDING", 0.3)
    calibration = with_program(wrong(gcc, tmp_path, init="signal(SIGINT, SIG_IGN);"))
    with pytest.raises(ControllerFailed, match=r"did not end within 0\.3 s of SIGINT"):
        isolated(interrupted(tmp_path / "ready", lambda: in_lockstep(calibration)))


def test_an_interrupt_ends_the_run_of_a_good_controller(gcc: str, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        isolated(interrupted(tmp_path / "ready"))


DESCRIBES = {
    "NULL": ("return NULL;", "vaneloop_describe returned NULL"),
    "too many": ("d.observables = 2000000000;", "observables (=2000000000 at NULL) must be in [0, 10000]"),
    "fewer than none": ("d.observables = -1; d.observable = &o;", "observables (=-1) must be in [0, 10000]"),
    "no value": ("d.observables = 1; d.observable = &o; o.value = NULL;", "observable 0 (='x')"),
    "no name": ("d.observables = 1; d.observable = &o; o.name = NULL;", "observable 0 (='')"),
    "nowhere": ("d.observables = 1; d.observable = (void *)16;", "SIGSEGV (it reached memory that is not its own), in "
                "vaneloop_describe"),
}  # fmt: skip


@pytest.mark.parametrize("case", DESCRIBES)
def test_what_it_says_of_itself_is_checked(
    gcc: str, tmp_path: Path, case: str, capfd: pytest.CaptureFixture[str]
) -> None:
    code, said = DESCRIBES[case]
    top = (
        'static vaneloop_own_observable o = {"x", "m", "", (const double *)&sink}; static vaneloop_description d;'
        f"const vaneloop_description *vaneloop_describe(void) {{ {code} return &d; }}"
    )
    path = wrong(gcc, tmp_path, top=top)
    assert main(["run", "--bus", "lockstep", "--duration", "0.1", "--controller", path, "--quiet"]) in (1, 2)
    line = capfd.readouterr().err.strip()
    assert said in line and path in line and "\n" not in line


def test_a_library_does_not_change_how_this_process_rounds(gcc: str, tmp_path: Path) -> None:
    """As one does that was built with -ffast-math: it changes the arithmetic of who loads it."""
    top = "__attribute__((constructor)) static void begin(void) { fesetround(FE_UPWARD); }"
    path = wrong(gcc, tmp_path, top=top)
    third = np.float64(1.0) / np.float64(3.0)

    def task() -> bool:
        foreign = Program(path).start(load_calibration())
        return bool(foreign) and bool(np.float64(1.0) / np.float64(3.0) == third)

    assert isolated(task)


def test_what_was_flashed_while_it_runs_is_seen_and_not_changed_by_it() -> None:
    """The same numbers twice: the loop's can be written, the controller's follow them."""
    calibration = load_calibration()
    cal = readable(calibration)
    for name in ("k", "table", "angles"):
        ours = getattr(cal, name)
        assert (ours == getattr(calibration, name)).all()
        ours += 1.0
        seen = np.ctypeslib.as_array(ctypes.cast(_VIEWS[ours.ctypes.data], ctypes.POINTER(ctypes.c_double)), ours.shape)
        assert (seen == ours).all() and (ours == getattr(calibration, name) + 1.0).all()


def test_a_defect_of_ours_beside_a_controller_names_its_place(
    gcc: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise KeyError("level.square_root")

    monkeypatch.setenv("VANELOOP_DEBUG", "1")
    monkeypatch.setattr("vaneloop.cli.run.run_lockstep", broken)
    words = ["run", "--bus", "lockstep", "--duration", "0.1", "--controller", wrong(gcc, tmp_path)]
    assert main(words) == 70
    err = capfd.readouterr().err
    assert "in broken" in err and "internal error: KeyError: 'level.square_root' (test_native.py:" in err


def test_a_long_task_without_a_controller_in_a_step_is_not_taken_for_a_hang() -> None:
    assert isolated(lambda: time.sleep(1.0) or os.getpid(), patience=0.3) != os.getpid()


def test_an_exception_of_the_task_comes_back() -> None:
    def refuse() -> None:
        raise InputError("kp (=-1) must be above 0")

    with pytest.raises(InputError, match=r"^kp \(=-1\) must be above 0$"):
        isolated(refuse)


def edited(path: str, change: Callable[[bytearray], None], to: Path) -> str:
    data = bytearray(Path(path).read_bytes())
    change(data)
    to.write_bytes(data)
    return str(to)


def other_machine(data: bytearray) -> None:
    data[18:20] = (243).to_bytes(2, "little")


def an_executable(data: bytearray) -> None:
    data[16:18] = (2).to_bytes(2, "little")


@pytest.mark.parametrize(
    ("case", "said"),
    [
        ("missing", "cannot be read (No such file or directory)"),
        ("folder", "cannot be read (Is a directory)"),
        ("text", "is no ELF file; a shared library is needed"),
        ("machine", "is built for RISC-V, 64 bits; this machine is"),
        ("executable", "is no shared library (ELF type 2)"),
        ("cut", "is cut short: 3,000 bytes of "),
        ("symbol", "vaneloop_step is missing; vaneloop_version, vaneloop_init, vaneloop_step are needed"),
        ("undefined", "undefined symbol: not_there"),
        ("version", f"is compiled for interface 7; this VaneLoop has interface {VERSION}"),
        ("refused", "refuses the calibration: ki (=3) must be 0"),
    ],
)
def test_what_cannot_run_is_one_line_and_exit_code_2(
    gcc: str, reference: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], case: str, said: str
) -> None:
    file = tmp_path / "case.so"
    path = str(file)
    if case == "folder":
        file.mkdir()
    elif case == "text":
        file.write_text("int main(void) { return 0; }\n" * 3)
    elif case == "machine":
        path = edited(reference, other_machine, file)
    elif case == "executable":
        path = edited(reference, an_executable, file)
    elif case == "cut":
        file.write_bytes(Path(reference).read_bytes()[:3000])
    elif case == "symbol":
        source = tmp_path / "two.c"
        source.write_text("unsigned vaneloop_version(void) { return 1; } char *vaneloop_init(void *c) { return c; }")
        path = build(gcc, source, file)
    elif case == "undefined":
        path = wrong(gcc, tmp_path, "extern void not_there(void); not_there();")
    elif case == "version":
        path = wrong(gcc, tmp_path, version="7")
    elif case == "refused":
        path = wrong(gcc, tmp_path, init='return "ki (=3)\\n must be 0";')
    assert main(["run", "--bus", "lockstep", "--duration", "1", "--controller", path, "--quiet"]) == 2
    line = capfd.readouterr().err.strip()
    assert said in line and path in line and "\n" not in line, line


def test_a_crash_log_runs_to_the_same_crash(gcc: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path, log = wrong(gcc, tmp_path, "if (in->x_lvdt > 0.015) " + SEGV), str(tmp_path / "crash.parquet")
    words = ["--controller", path, "--quiet"]
    assert (
        main(["run", "--bus", "lockstep", "--profile", "slam", "--start-speed", "80", "--save-crash", log, *words]) == 1
    )
    first = capfd.readouterr().err
    assert f"crash log: {log}" in first
    tick = re.search(r"in tick (\d+),", first)
    assert main(["replay", log, *words]) == 1
    again = capfd.readouterr().err
    assert tick is not None and tick[0] in again and "ended by SIGSEGV" in again
    assert first.split("last inputs:")[1].split("; crash log")[0].strip() == again.split("last inputs:")[1].strip()
    assert main(["replay", log, "--controller", wrong(gcc, tmp_path), "--quiet"]) == 0  # the mended one


def test_save_crash_without_a_controller_is_refused(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--bus", "lockstep", "--duration", "1", "--save-crash", "x.parquet", "--quiet"]) == 2
    assert "needs --controller" in capfd.readouterr().err


# ---- judged as any controller ----------------------------------------------------------------------------------------


def test_the_table_of_reactions_names_every_scenario() -> None:
    table = load_reactions()
    assert set(table.reactions) == set(injection.library())


@pytest.mark.slow
def test_the_firmware_reacts_as_any_controller_must() -> None:
    for name in injection.library():
        outcome = injection.run(name, reactions=load_reactions())
        assert outcome.held, outcome.text()


def test_a_controller_that_ignores_silence_is_found(gcc: str, tmp_path: Path) -> None:
    outcome = injection.run("demand_stops", calibration=with_program(wrong(gcc, tmp_path)), reactions=load_reactions())
    broken = [c.expected for c in outcome.checks if c.held is False]
    assert len(broken) == 2 and broken[0].startswith("never RUN") and broken[1].startswith("FAIL_SAFE")


def test_a_crash_is_a_failed_scenario_and_the_others_run(
    gcc: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path, junit = wrong(gcc, tmp_path, "if (in->n_dem > 100.0) " + SEGV), tmp_path / "out.xml"
    words = ["inject", "nominal", "demand_insane", "--controller", path, "--junit", str(junit), "--quiet"]
    assert main(words) == 1
    text = junit.read_text(encoding="utf-8")
    assert 'tests="2"' in text and "the controller runs to the end" in text and "in tick" in text
    assert text.count("ended by SIGSEGV") >= 1 and 'name="nominal"' in text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('fail_safe = { value = 1.0, unit = "s"', 'fail_safe = { value = 1.0, unit = "ms"'), "fail_safe.unit (='ms')"),
        (('nominal = ["ride"]', 'nominal = ["fly"]'), "reactions.nominal"),
        (("current = { value = 40.0", "current = { value = -1.0"), "current (=-1 mA) must be in"),
    ],
)
def test_a_wrong_table_of_reactions_is_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], change: tuple[str, str], said: str
) -> None:
    text = (ROOT / "hil" / "inject" / "any_controller.toml").read_text(encoding="utf-8")
    assert change[0] in text
    (tmp_path / "mine.toml").write_text(text.replace(*change), encoding="utf-8")
    assert main(["inject", "nominal", "--reactions", str(tmp_path / "mine.toml"), "--quiet"]) == 2
    assert said in capfd.readouterr().err


# ---- projects --------------------------------------------------------------------------------------------------------


def make(folder: Path, *words: str) -> str:
    done = subprocess.run(["make", "-C", str(folder), *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_new_project_builds_and_runs(gcc: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "mine"
    assert main(["new-controller", str(folder), "--quiet"]) == 0
    flags = "CFLAGS=-std=c99 -O2 -Wall -Wextra -Werror"
    make(folder, f"CC={gcc}", flags), make(folder, f"CC={gcc}", flags, "coder.so")
    for library in ("my_controller.so", "coder.so"):
        path, reactions = str(folder / library), str(folder / "reactions.toml")
        words = ["inject", "nominal", "demand_stops", "--controller", path, "--reactions", reactions, "--quiet"]
        assert main(words) == 0, capfd.readouterr()
    assert main(["new-controller", str(folder), "--quiet"]) == 2
    assert "a new or an empty folder is needed" in capfd.readouterr().err


@pytest.mark.slow
def test_a_new_project_passes_every_scenario(gcc: str, tmp_path: Path) -> None:
    assert main(["new-controller", str(tmp_path / "mine"), "--quiet"]) == 0
    make(tmp_path / "mine", f"CC={gcc}")
    assert main(["inject", "--all", "--controller", str(tmp_path / "mine" / "my_controller.so"), "--quiet"]) == 0


FOLLOWER = ROOT / "examples" / "own_controller"


def test_the_example_takes_its_own_calibration_and_shows_its_own_quantity(gcc: str, tmp_path: Path) -> None:
    path = build(gcc, FOLLOWER / "follower.c", tmp_path / "follower.so", "-std=c99", "-Wall", "-Wextra", "-Werror")
    errors = []
    for own in (None, str(FOLLOWER / "tables" / "own_calibration.toml")):
        node = Node(calibration=load_calibration()._replace(program=Program(path, own)), n_r=60.0)
        node.loop.s[:] = node.loop.s  # at rest
        for _ in range(30):
            node.tick(NONE, 0)
        shown = observables(node.loop.foreign)["error"]
        assert shown["unit"] == "m"
        errors.append((node.loop.given.i_cmd / shown["value"], shown["value"]))
    assert [round(gain, 9) for gain, _ in errors] == [4.0, 8.0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[gian]\nvalue = 1.0\nunit = "A/m"', "gian is no calibration scalar of"),
        ('[gain]\nvalue = 1.0\nunit = "mA/mm"', "gain.unit (='mA/mm') must be 'A/m'"),
        ('[gain]\nvalue = 101.0\nunit = "A/m"', "gain (=101.0 A/m) must be in [0, 100]"),
        ('[gain]\nvalue = "4"\nunit = "A/m"', "gain (='4' A/m) must be in [0, 100]"),
    ],
)
def test_a_wrong_own_scalar_is_refused(gcc: str, tmp_path: Path, text: str, said: str) -> None:
    path = build(gcc, FOLLOWER / "follower.c", tmp_path / "follower.so")
    (tmp_path / "own.toml").write_text(text)
    with pytest.raises(InputError, match=re.escape(said)):
        Program(path, str(tmp_path / "own.toml")).start(load_calibration())


# ---- compare ---------------------------------------------------------------------------------------------------------


def test_the_demand_stage_is_the_users_own_firmware(reference: str, gcc: str, tmp_path: Path) -> None:
    """On a log of the firmware, its own copy in C leaves nothing; another controller is found in the demand stage."""
    from vaneloop import Machine, read_log
    from vaneloop.identification.workflow import locate_stages

    log = read_log(ROOT / "examples" / "hidden_effect.parquet", require=())
    assert main(["new-controller", str(tmp_path / "mine"), "--quiet"]) == 0
    make(tmp_path / "mine", f"CC={gcc}")
    ratios = []
    for path in (reference, str(tmp_path / "mine" / "my_controller.so")):
        chain = Machine(controller=path).bind(log)
        assert "controller of your own" in chain.not_observed["servo"]
        (located,) = locate_stages([chain.stage("demand")])
        ratios.append(located.signals[0].ratio)
    assert ratios[0] < 1.0 and ratios[1] > 3.0
