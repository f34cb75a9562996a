"""A controller of the user's own in C: its memory, quantities and files, what is kept of its ticks, and how the end of
its process is told.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import signal
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller import INPUTS, OUTPUTS, load_calibration, new_inputs, new_outputs, new_state
from controller.records import STATE
from hil.native import black_box, crash_log, isolation, program
from hil.native.call import (
    CALL,
    CANARIES,
    CANARY,
    ENTERED,
    N_HEAD,
    OBSERVABLES,
    REASON,
    REASONS,
    RETURNED,
    STEP,
    VALUE,
    firmware,
)
from hil.native.isolation import ControllerFailed, _End, isolated
from hil.native.program import _VIEWS, Program, _check_file, _length, observables, own_scalars, readable, restore, save
from tests.native_builds import wrong
from vaneloop.base.errors import InputError

CAL = load_calibration()
GOOD = """
static double gain = 2.0, seen = 0.0;
static const vaneloop_own_scalar scalars[] = {{"gain", "A", "what it multiplies", &gain, 1.0, 5.0}};
static const vaneloop_own_observable shown[] = {{"seen", "%", "the demand", &seen}};
static const vaneloop_description about = {1, 1, scalars, shown};
const vaneloop_description *vaneloop_describe(void) { return &about; }
size_t vaneloop_save(void *at) { if (at) memcpy(at, &seen, sizeof seen); return sizeof seen; }
void vaneloop_restore(const void *at) { memcpy(&seen, at, sizeof seen); }
"""


@pytest.fixture(scope="module")
def good(gcc: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A controller that shows the demand that it had, times its gain, once half a second is over."""
    return wrong(gcc, tmp_path_factory.mktemp("good"), fault="seen = gain * in->n_dem; out->x_dem = 0.02;", top=GOOD)


def ticked(foreign: Any, ticks: int, n_dem: float = 70.0, begin: int = 0) -> tuple[Any, Any]:
    inputs, outputs, z = new_inputs(), new_outputs(), new_state()
    inputs[INPUTS.index("n_dem")] = n_dem
    z[STATE.index("ticks")] = begin
    for _ in range(ticks):
        firmware(inputs, outputs, z, CAL, foreign)
    return outputs, z


# ---- the library -----------------------------------------------------------------------------------------------------


def test_a_controller_is_fed_and_read_and_its_ticks_are_counted(good: str) -> None:
    foreign = Program(good).start(CAL)
    outputs, z = ticked(foreign, 3)
    assert outputs[OUTPUTS.index("x_dem")] == 0.01 and z[STATE.index("ticks")] == 3.0
    assert foreign.box[ENTERED] == foreign.box[RETURNED] == 3.0 and foreign.box[CALL] == STEP
    assert foreign.rows[0, INPUTS.index("n_dem")] == 70.0
    outputs, _ = ticked(foreign, 1, 80.0, begin=500)
    assert outputs[OUTPUTS.index("x_dem")] == 0.02
    for memory, many in ((foreign.fed, len(INPUTS)), (foreign.given, len(OUTPUTS)), (foreign.seen, len(OBSERVABLES))):
        assert len(memory) == CANARIES + many and memory[:CANARIES].tolist() == [CANARY] * CANARIES
        assert memory.ctypes.data % 4096 + 8 * len(memory) == 4096  # right before its wall
    assert foreign.at_fed == foreign.fed.ctypes.data + 8 * CANARIES


def test_its_own_quantities_are_what_it_says(good: str, tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text('gain = { value = 3.0, unit = "A", origin = "x" }\n')
    foreign = Program(good, str(own)).start(CAL)
    ticked(foreign, 1, 50.0, begin=500)
    assert observables(foreign) == {"seen": {"value": 150.0, "unit": "%", "meaning": "the demand"}}
    (gain,) = own_scalars(foreign).values()
    assert (gain["unit"], gain["meaning"], gain["low"], gain["high"]) == ("A", "what it multiplies", 1.0, 5.0)
    assert gain["value"].tolist() == [3.0] and observables(()) == own_scalars(()) == {} and save(()) is None
    state = save(foreign)
    assert state == struct.pack("d", 150.0)
    ticked(foreign, 1, 60.0, begin=500)
    restore(foreign, state)
    assert observables(foreign)["seen"]["value"] == 150.0
    other = Program(good).start(CAL)  # a copy of its own: as it is loaded
    assert own_scalars(other)["gain"]["value"].tolist() == [2.0] and observables(other)["seen"]["value"] == 0.0
    for text, said in (
        ("loss = { value = 1.0 }", f"loss is no calibration scalar of {good}; allowed: gain"),
        ('gain = { value = 3.0, unit = "V" }', "gain.unit (='V') must be 'A'"),
        ('gain = { value = 5.1, unit = "A" }', "gain (=5.1 A) must be in [1, 5]"),
        ('gain = { value = 0.9, unit = "A" }', "gain (=0.9 A) must be in [1, 5]"),
        ('gain = { value = true, unit = "A" }', "gain (=True A) must be in [1, 5]"),
    ):
        own.write_text(text)
        with pytest.raises(InputError) as e:
            Program(good, str(own)).start(CAL)
        assert str(e.value) == f"{own}: {said}"


def test_a_plain_controller_shows_and_keeps_nothing(gcc: str, tmp_path: Path) -> None:
    foreign = Program(wrong(gcc, tmp_path)).start(CAL)
    assert observables(foreign) == own_scalars(foreign) == {} and save(foreign) is None
    (tmp_path / "own.toml").write_text("gain = { value = 3.0 }")
    with pytest.raises(InputError, match="allowed: none; it has no vaneloop_describe"):
        Program(str(tmp_path / "wrong.so"), str(tmp_path / "own.toml")).start(CAL)


def test_a_calibration_is_the_same_memory_twice_once_to_write() -> None:
    mine = readable(CAL)
    for name in ("k", "table", "angles"):
        array, theirs = getattr(mine, name), _VIEWS[getattr(mine, name).ctypes.data]
        assert np.array_equal(array, getattr(CAL, name)) and theirs != array.ctypes.data
        seen = np.ctypeslib.as_array((ctypes.c_double * array.size).from_address(theirs))
        assert np.array_equal(seen, array.ravel())
        array.flat[-1] = 123.0
        assert seen[-1] == 123.0
    addresses = [getattr(mine, name).ctypes.data for name in ("k", "table", "angles")]
    told = program._given(mine)
    assert told.points == CAL.table.shape[1] and told.strokes == CAL.angles.shape[1]
    row = CAL.table.shape[1] * 8
    assert [told.extension - told.speed, told.retraction - told.speed, told.single - told.speed] == [
        row,
        2 * row,
        3 * row,
    ]
    assert told.angle[0] - told.stroke == CAL.angles.shape[1] * 8
    del mine, array, told
    gc.collect()
    assert not set(addresses) & set(_VIEWS)


# ---- files that are no library ---------------------------------------------------------------------------------------


def elf(**more: int) -> bytes:
    """The head of a 64-bit shared library of this machine, with one segment that ends at byte 200."""
    with open("/proc/self/exe", "rb") as f:
        head = bytearray(f.read(64))
    given = {"type": 3, "machine": struct.unpack_from("<H", head, 18)[0], "end": 200, "bits": 2, "number": 1} | more
    head[4] = given["bits"]
    struct.pack_into("<HH", head, 16, given["type"], given["machine"])
    struct.pack_into("<Q", head, 32, 64)
    struct.pack_into("<HH", head, 54, 56, given["number"])
    segment = struct.pack("<8xQ16xQ16x", 100, given["end"] - 100)
    return bytes(head) + segment + bytes(200 - 64 - 56)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (elf(), ""), (elf(end=201), "is cut short: 200 bytes of 201"),
        (elf(type=2), "is no shared library (ELF type 2); build it with gcc -shared -fPIC"),
        (elf()[:19], "is no ELF file; a shared library is needed (gcc -shared -fPIC)"),
        (b"MZ" + elf()[2:], "is no ELF file; a shared library is needed (gcc -shared -fPIC)"),
        (elf(machine=0xFFFE), "is built for ELF machine 65534, 64 bits; this machine is"),
        (elf(bits=1), "32 bits; this machine is"),
        (elf(number=4), "is cut short: 200 bytes of 288"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_library_of_this_machine_is_refused(content: bytes, said: str, tmp_path: Path) -> None:
    file = tmp_path / "c.so"
    file.write_bytes(content)
    if not said:
        _check_file(str(file))
        with file.open("rb") as f:
            assert _length(f) == 200
        return
    with pytest.raises(InputError) as e:
        _check_file(str(file))
    assert str(e.value).startswith(f"--controller {file}: ") and said in str(e.value)


def test_a_library_that_cannot_be_loaded_is_named(tmp_path: Path) -> None:
    (tmp_path / "c.so").write_bytes(elf())
    with pytest.raises(InputError, match=rf"^--controller {tmp_path}/c\.so: cannot be loaded \({tmp_path}/c\.so: "):
        Program(str(tmp_path / "c.so")).start(CAL)
    with pytest.raises(InputError, match=r": cannot be read \(No such file"):
        Program(str(tmp_path / "no.so"))


# ---- the black box ---------------------------------------------------------------------------------------------------


@pytest.fixture
def watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(black_box, "_WATCHED", [])
    return tmp_path


def test_a_box_keeps_the_ticks_of_a_controller_that_is_in_a_call(watched: Path) -> None:
    head, rows = black_box.new("c.so", CAL)
    assert not black_box.begun() and head.tolist() == [0.0] * N_HEAD and rows.shape == (1, len(INPUTS))
    assert list(watched.iterdir()) == []
    black_box.watched(watched, every_tick=False)
    assert black_box.begun()
    before = len(os.listdir("/proc/self/fd"))
    head, rows = black_box.new("c.so", CAL)
    assert len(os.listdir("/proc/self/fd")) == before + 1  # which the mapping has
    assert rows.shape == (1, len(INPUTS)) and len(list(watched.iterdir())) == 2
    assert black_box.controller(watched) == "c.so" and black_box.left(watched) is None
    assert black_box.progress(watched) == b""
    rows[0] = np.arange(len(INPUTS))
    head[ENTERED], head[RETURNED] = 8.0, 7.0
    first = black_box.progress(watched)
    box = black_box.left(watched)
    assert box is not None and len(first) == 8 * N_HEAD
    assert (box.controller, box.call, box.tick, box.reason) == ("c.so", "vaneloop_step", 7, 0)
    assert box.inputs.tolist() == [list(range(len(INPUTS)))]
    assert np.array_equal(np.array(box.calibration["table"]), CAL.table)
    head[REASON], head[VALUE] = 2.0, 0.5
    stopped = black_box.left(watched)
    assert stopped is not None and (stopped.reason, stopped.value) == (2, 0.5)
    head[REASON] = 77.0
    assert (box := black_box.left(watched)) is not None and box.reason == 0
    head[RETURNED] = 8.0
    assert black_box.left(watched) is None
    with black_box.calling(head, "vaneloop_init"):
        assert (box := black_box.left(watched)) is not None and box.call == "vaneloop_init"
        assert black_box.progress(watched) != first
    assert head[CALL] == STEP and black_box.left(watched) is None
    head[ENTERED], head[CALL] = np.nan, 3.0
    assert black_box.left(watched) is None  # overwritten
    assert black_box.controller(watched / "none") == ""


def test_a_box_of_every_tick_keeps_them_all(watched: Path) -> None:
    black_box.watched(watched, every_tick=True)
    head, rows = black_box.new("c.so", CAL)
    assert len(rows) == black_box.EVERY_TICK
    rows[:3] = np.arange(3.0)[:, None]
    head[ENTERED], head[RETURNED] = 3.0, 2.0
    box = black_box.left(watched)
    assert box is not None and box.tick == 2 and box.inputs[:, 0].tolist() == [0.0, 1.0, 2.0]
    file = next(f for f in watched.iterdir() if f.suffix != ".json")
    os.truncate(file, 8)
    assert black_box.progress(watched) == black_box._OVERWRITTEN and black_box.left(watched) is None


# ---- how the end is told ---------------------------------------------------------------------------------------------


def box_of(**more: Any) -> black_box.Box:
    given: dict[str, Any] = {
        "controller": "c.so", "calibration": {n: getattr(CAL, n).tolist() for n in ("k", "table", "angles")},
        "call": "vaneloop_step", "tick": 7, "inputs": np.zeros((8, len(INPUTS))), "reason": 0, "value": 0.0,
    }  # fmt: skip
    return black_box.Box(**given | more)


def test_what_a_controller_did_is_one_line() -> None:
    inputs = np.full((1, len(INPUTS)), np.nan)
    inputs[0, INPUTS.index("n_dem")] = 70.5
    words = isolation._words(inputs[0])
    assert "n_dem 70.5 %" in words and words.startswith(f"{INPUTS[0].split('.')[0]} ")
    line = isolation.told(box_of(inputs=inputs), "ended by SIGSEGV")
    assert line == f"--controller c.so: ended by SIGSEGV, in tick 7, 0.007 s after power-on; last inputs: {words}"
    assert isolation.told(box_of(inputs=inputs[:0]), "x") == "--controller c.so: x, in tick 7, 0.007 s after power-on"
    assert isolation.told(box_of(tick=-1, call="vaneloop_init"), "x") == (
        "--controller c.so: x, in vaneloop_init, while it was switched on"
    )
    assert isolation.told(box_of(reason=1, value=np.inf, inputs=inputs[:0]), "x").startswith(
        f"--controller c.so: {REASONS[1].format(np.inf)}, in tick 7"
    )


def test_how_a_process_ended_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(black_box, "left", lambda folder: None)
    lost = "; memory that the controller overwrote may be the cause"
    for end, said in (
        (_End(5, signal.SIGSEGV), f"ended by SIGSEGV, outside a call of it{lost}"),
        (_End(5, signal.SIGTERM), "ended by SIGTERM, outside a call of it"),
        (_End(5, 3 << 8), "ended with code 3, outside a call of it"),
        (_End(5, signal.SIGKILL, "did not come back within 5 s"), "did not come back within 5 s"),
        (_End(), "ended what watches it, or took away its folder for temporary files"),
    ):
        assert isolation._failure(tmp_path, end, None) == f"the process with the controller {said}"
    monkeypatch.setattr(black_box, "left", lambda folder: box_of(inputs=np.zeros((0, len(INPUTS)))))
    own = "ended by SIGSEGV (it reached memory that is not its own)"
    assert isolation._failure(tmp_path, _End(5, signal.SIGSEGV), None) == (
        f"--controller c.so: {own}, in tick 7, 0.007 s after power-on"
    )
    assert "not its own" not in isolation._failure(tmp_path, _End(5, signal.SIGSEGV, "was stopped for 5 s"), None)
    wrote: list[Any] = []

    def write(*given: Any) -> str:
        wrote.append(given)
        return "crash log: f"

    monkeypatch.setattr(crash_log, "write", write)
    assert isolation._failure(tmp_path, _End(5, signal.SIGSEGV), "f").endswith("after power-on; crash log: f")
    assert len(wrote) == 1
    monkeypatch.setattr(black_box, "left", lambda folder: box_of(tick=-1))
    assert not isolation._failure(tmp_path, _End(5, signal.SIGSEGV), "f").endswith("crash log: f") and len(wrote) == 1
    assert isolation._name(signal.SIGRTMIN + 1) == f"signal {signal.SIGRTMIN + 1}"


def test_an_answer_counts_where_it_is_whole_and_its_process_ended_by_itself(tmp_path: Path) -> None:
    content = isolation._pickled(True, {"a": 1})
    from hashlib import sha256

    (tmp_path / "answer-7").write_bytes(sha256(content).digest() + content)
    assert isolation._read_answer(tmp_path, _End(7)) == (True, {"a": 1}, "")
    for end in (_End(), _End(7, 9), _End(7, 0, "why"), _End(8)):
        assert isolation._read_answer(tmp_path, end) is None
    (tmp_path / "answer-7").write_bytes(sha256(content).digest() + content + b"x")
    assert isolation._read_answer(tmp_path, _End(7)) is None
    (tmp_path / "end").write_text(json.dumps([7, 9, "why"]))
    assert isolation._read_end(tmp_path) == _End(7, 9, "why")
    (tmp_path / "end").write_text("[")
    assert isolation._read_end(tmp_path) == _End()
    file = os.open(tmp_path, os.O_RDONLY)
    (kept,) = isolation._files([file]).values()
    assert kept is not None and kept == (os.stat(tmp_path).st_dev, os.stat(tmp_path).st_ino)
    os.close(file)
    assert isolation._files([file]) == {file: None}


def test_an_exception_comes_back_with_its_traceback_or_in_words() -> None:
    class Local(Exception):
        pass

    def fails() -> None:
        raise ValueError("so")

    with pytest.raises(ValueError, match="^so$") as e:
        isolated(fails)
    assert "in fails" in str(e.value.__cause__)

    def fails_alone() -> None:
        raise Local("here")

    with pytest.raises(RuntimeError, match="^Local: here$"):
        isolated(fails_alone)
    assert isolated(lambda: {"n": 3}) == {"n": 3}
    with pytest.raises(ControllerFailed, match=r"^the process with the controller ended with code 3, outside a call"):
        isolated(lambda: os._exit(3))


def test_what_a_controller_leaves_behind_is_ended_but_not_what_is_ours(tmp_path: Path) -> None:
    """In a process of its own, which is what waits for those."""
    script = tmp_path / "broker.py"
    script.write_text("")

    def task() -> tuple[bool, bool, list[int]]:
        isolation._prctl(isolation._PR_SET_CHILD_SUBREAPER, 1)
        left = os.fork()
        if left == 0:
            os.setsid()
            time.sleep(60)
            os._exit(0)
        below = isolation._descendants()
        isolation._end_others(left)
        return left in below, os.path.exists(f"/proc/{left}"), isolation._descendants()

    assert isolated(task) == (True, False, [])
    assert isolation._descendants() == [] or all(p > 1 for p in isolation._descendants())
    assert not isolation._is_ours(os.getpid()) and not isolation._is_ours(2**22 + 1)


# ---- crash logs ------------------------------------------------------------------------------------------------------


def test_a_crash_log_has_the_ticks_and_the_calibration(good: str, tmp_path: Path) -> None:
    path = str(tmp_path / "c.parquet")
    inputs = np.random.default_rng(1).uniform(0.0, 1.0, (8, len(INPUTS)))
    assert crash_log.write(path, box_of(inputs=inputs), "why") == f"crash log: {path}"
    assert crash_log.is_crash_log(path)
    rows, about, calibration = crash_log.read(path)
    assert np.array_equal(rows, inputs) and (about["tick"], about["failure"], about["controller"]) == (7, "why", "c.so")
    assert np.array_equal(calibration.k, CAL.k) and np.array_equal(calibration.angles, CAL.angles)
    assert crash_log.write(path, box_of(inputs=inputs[:7]), "x") == (
        "no crash log: it ran for more ticks (8) than are kept"
    )
    assert crash_log.write(str(tmp_path / "no" / "c.parquet"), box_of(), "x").startswith("no crash log: ")
    outputs = crash_log.feed(rows, calibration, Program(good))
    assert outputs[OUTPUTS.index("x_dem")] == 0.01
    for name, content in (("a.parquet", b"PAR1"), ("b.csv", b"t\n1\n")):
        (tmp_path / name).write_bytes(content)
        assert not crash_log.is_crash_log(tmp_path / name) and not crash_log.is_crash_log(tmp_path / "none.parquet")
        with pytest.raises(InputError, match="is no crash log of this version"):
            crash_log.read(tmp_path / name)
