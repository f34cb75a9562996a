"""A controller of the user's own in C: its memory, quantities and files, what is kept of its ticks, and how the end of
its process is told.
"""

from __future__ import annotations

import copyreg
import ctypes
import faulthandler
import gc
import json
import os
import pickle
import resource
import shutil
import signal
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller import INPUTS, OUTPUTS, load_calibration, new_inputs, new_outputs, new_state
from controller.header import VERSION
from controller.records import INPUT_FIELDS, STATE
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
from tests.native_builds import build, wrong
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


class OfTwo(Exception):
    """One that pickle writes, but cannot read."""

    def __init__(self, a: int, b: int):
        super().__init__(f"{a} and {b}")


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
    half = Program(wrong(gcc, tmp_path, top="size_t vaneloop_save(void *at) { return 1; }")).start(CAL)
    assert save(half) is None  # what could not be given back
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


def test_a_controller_that_nobody_has_any_more_is_unloaded(gcc: str, tmp_path: Path) -> None:
    left = tmp_path / "left"
    ends = f'__attribute__((destructor)) static void end(void) {{ fclose(fopen("{left}", "w")); }}'
    foreign = Program(wrong(gcc, tmp_path, top=ends)).start(CAL)
    at, head = foreign.at_fed, foreign.box
    assert at in program._KEPT and not left.exists()
    del foreign
    gc.collect()
    assert at not in program._KEPT and left.exists() and head[CALL] == STEP


# ---- what a library is given, and what it says -----------------------------------------------------------------------


def test_what_a_controller_reads_it_cannot_make_writable() -> None:
    before = len(os.listdir("/proc/self/fd"))
    mine = readable(CAL)
    assert len(os.listdir("/proc/self/fd")) == before + 2  # which the two mappings have
    page = _VIEWS[mine.k.ctypes.data]
    assert page % 4096 == 0 and program._libc.mprotect(page, 4096, 3) != 0
    assert program._libc.mprotect(mine.k.ctypes.data, 4096, 3) == 0  # ours is ours
    assert mine.program is None


def test_memory_to_write_to_lies_between_two_walls() -> None:
    room = program._walled(5)
    begin = room.ctypes.data // 4096 * 4096
    spans = {}
    for line in Path("/proc/self/maps").read_text().splitlines():
        ends, rights = line.split()[:2]
        first, last = (int(end, 16) for end in ends.split("-"))
        spans[range(first, last)] = rights

    def rights(at: int) -> str:
        return next(r for span, r in spans.items() if at in span)

    assert room.ctypes.data + 8 * room.size == begin + 4096 and room.size == CANARIES + 5
    assert [rights(begin + d)[:2] for d in (-4096, -1, 0, 4095, 4096, 8191)] == ["--", "--", "rw", "rw", "--", "--"]


def test_the_copy_that_was_loaded_is_no_file_any_more(
    good: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    foreign = Program(good).start(CAL)
    assert list(tmp_path.iterdir()) == [] and foreign.box[CALL] == STEP
    monkeypatch.setattr(program, "_MOST_STATE", 8)
    assert save(foreign) == bytes(8)
    monkeypatch.setattr(program, "_MOST_STATE", 7)
    with pytest.raises(InputError) as e:
        save(foreign)
    assert str(e.value) == f"--controller {good}: vaneloop_save returned 8 bytes; allowed: 7"


def test_what_it_says_of_itself_is_read_in_its_own_memory() -> None:
    values = (ctypes.c_double * 3)(1.5, 2.5, 3.5)
    at = [ctypes.cast(ctypes.byref(values, 8 * i), program._Doubles) for i in range(3)]
    scalars = (program._OwnScalar * 2)(
        (b"a", b"A", "\u00e9".encode(), at[0], -1.0, 4.0), (b"b", None, b"\xff", at[1], 0.0, 9.0)
    )
    shown = (program._OwnObservable * 2)((b"seen", b"%", b"m", at[2]), (b"seen", b"%", b"m", at[2]))
    told = program._Description(2, 1, scalars, shown)
    head = np.zeros(N_HEAD)

    def describe() -> Any:
        assert head[CALL] == 4.0  # its pointers may lead anywhere
        return ctypes.pointer(told)

    running = program._Running("--controller c.so", SimpleNamespace(vaneloop_describe=describe), None, CAL, head)  # type: ignore[arg-type]
    found = running.described("scalar")
    assert {n: {k: v for k, v in q.items() if k != "value"} for n, q in found.items()} == {
        "a": {"unit": "A", "meaning": "\u00e9", "low": -1.0, "high": 4.0},
        "b": {"unit": "", "meaning": "\ufffd", "low": 0.0, "high": 9.0},
    }
    found["a"]["value"][0] = 7.0
    assert values[0] == 7.0 and found["b"]["value"].shape == (1,) and head[CALL] == STEP
    assert list(running.described("observable")) == ["seen"]
    start = "--controller c.so: vaneloop_describe"
    for change, said in (
        (
            {"observables": 2},
            f"{start}: observable 1 (='seen'): a name of its own and a pointer to its value are needed",
        ),
        ({"observables": -1}, f"{start}: observables (=-1) must be in [0, 10000]"),
        ({"observables": 10_001}, f"{start}: observables (=10001) must be in [0, 10000]"),
        ({"observables": 1, "observable": None}, f"{start}: observables (=1 at NULL) must be in [0, 10000]"),
    ):
        for name, value in change.items():
            setattr(told, name, ctypes.POINTER(program._OwnObservable)() if value is None else value)
        with pytest.raises(InputError) as e:
            running.described("observable")
        assert str(e.value) == said
    told.observables = 0
    assert running.described("observable") == {}
    for row, name in (((b"", b"", b"", at[2]), ""), ((b"q", b"", b"", program._Doubles()), "q")):
        shown[0] = program._OwnObservable(*row)
        told.observables, told.observable = 1, ctypes.cast(shown, ctypes.POINTER(program._OwnObservable))
        with pytest.raises(InputError, match=rf"observable 0 \(='{name}'\)"):
            running.described("observable")
    nothing = ctypes.POINTER(program._Description)()
    silent = program._Running("c", SimpleNamespace(vaneloop_describe=lambda: nothing), None, CAL, head)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^c: vaneloop_describe returned NULL; a vaneloop_description is needed$"):
        silent.described("scalar")
    plain = program._Running("c", SimpleNamespace(), None, CAL, head)  # type: ignore[arg-type]
    assert plain.described("scalar") == {}


def test_rounding_is_what_it_was_whatever_a_library_sets() -> None:
    down = 0x400  # FE_DOWNWARD of x86; where another machine has none of this number, nothing is changed
    before = program._libm.fegetround()
    with program._arithmetic_kept():
        program._libm.fesetround(down)
    assert program._libm.fegetround() == before
    with pytest.raises(ValueError, match="x"), program._arithmetic_kept():
        program._libm.fesetround(down)
        raise ValueError("x")
    assert program._libm.fegetround() == before


@pytest.mark.parametrize(
    ("name", "bits", "number"),
    [("x86_64", 64, 62), ("aarch64", 64, 183), ("i686", 32, 3), ("armv7l", 32, 40), ("ppc64le", 64, 21)],
)
def test_a_library_of_another_machine_is_named(
    name: str, bits: int, number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "c.so"
    monkeypatch.setattr(program.platform, "machine", lambda: name)
    file.write_bytes(elf(machine=number, bits=bits // 32))
    _check_file(str(file))
    for other, words in ((243, "RISC-V"), (94, "Xtensa"), (8, "MIPS"), (20, "PowerPC"), (77, "ELF machine 77")):
        file.write_bytes(elf(machine=other))
        with pytest.raises(InputError) as e:
            _check_file(str(file))
        assert str(e.value) == (
            f"--controller {file}: is built for {words}, 64 bits; this machine is {name}: build it here"
        )
    big = bytearray(elf())
    big[5] = 2
    big[16:20] = bytes([0, 3, 0, 243])
    file.write_bytes(big)
    with pytest.raises(InputError, match="is built for RISC-V, 64 bits"):
        _check_file(str(file))
    monkeypatch.setattr(program.platform, "machine", lambda: "other")  # nothing is known of it
    file.write_bytes(elf(machine=77))
    _check_file(str(file))


def test_how_long_a_library_is_what_its_segments_need(tmp_path: Path) -> None:
    def length(content: bytes) -> int:
        (tmp_path / "c.so").write_bytes(content)
        with (tmp_path / "c.so").open("rb") as f:
            return _length(f)

    assert length(elf()) == 200 and length(elf(bits=1)) == 0 and length(elf()[:63]) == 0
    big = bytearray(elf())
    big[5] = 2
    assert length(bytes(big)) == 0
    assert length(elf(number=4)) == 64 + 4 * 56 and length(elf(number=0)) == 0
    small = bytearray(elf())
    struct.pack_into("<H", small, 54, 55)  # segments too small to be some
    assert length(bytes(small)) == 64 + 55
    two = elf(number=2)[:64] + struct.pack("<8xQ16xQ16x", 300, 50) + struct.pack("<8xQ16xQ16x", 100, 40)
    assert length(two) == 350


def test_a_library_of_another_interface_or_without_a_function_is_refused(gcc: str, tmp_path: Path) -> None:
    other = wrong(gcc, tmp_path, version="4294967295u")
    with pytest.raises(InputError) as e:
        Program(other).start(CAL)
    assert str(e.value) == (
        f"--controller {other}: is compiled for interface 4294967295; this VaneLoop has interface {VERSION}: compile "
        "it again with the header that ships"
    )
    (tmp_path / "none.c").write_text("int vaneloop_version(void) { return 1; }")
    none = build(gcc, tmp_path / "none.c", tmp_path / "none.so")
    with pytest.raises(InputError) as e:
        Program(none).start(CAL)
    assert str(e.value) == (
        f"--controller {none}: vaneloop_init is missing; vaneloop_version, vaneloop_init, vaneloop_step are needed"
    )
    refuses = wrong(gcc, tmp_path, init='if (c->points > 0) return "too\\n many";')
    with pytest.raises(InputError) as e:
        Program(refuses).start(CAL)
    assert str(e.value) == f"--controller {refuses} refuses the calibration: too many"


def test_words_of_a_library_are_one_line() -> None:
    assert program._line(b"a\n b\xff\t c") == "a b\ufffd c" and program._line(OSError(2, "x")) == "[Errno 2] x"
    assert program._line("ab" * 400) == "ab" * 150 and program._text(None) == "" and program._text(b"\xff") == "\ufffd"
    assert program._address(SimpleNamespace(), "vaneloop_observe") == 0


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
    assert file.stat().st_size == 8 * (64 + 30_000_000 * len(INPUTS))  # eight hours; it is sparse
    assert np.fromfile(file, np.float64, len(INPUTS), offset=8 * (64 + len(INPUTS))).tolist() == [1.0] * len(INPUTS)
    os.truncate(file, 8)
    assert black_box.progress(watched) == black_box._OVERWRITTEN and black_box.left(watched) is None


def test_the_box_of_the_controller_that_was_called_is_found_among_others(watched: Path) -> None:
    black_box.watched(watched, every_tick=False)
    heads = [black_box.new(f"{n}.so", CAL)[0] for n in range(4)]
    called = sorted(
        range(4), key=lambda n: next(f.name for f in watched.glob("*.json") if f'"{n}.so"' in f.read_text())
    )
    heads[called[1]][CALL] = 77.0  # overwritten: no such function
    heads[called[3]][CALL] = 3.0
    box = black_box.left(watched)
    assert box is not None and box.controller == f"{called[3]}.so" and box.call == "vaneloop_init"
    assert box.tick == -1 and box.inputs.shape == (0, len(INPUTS))  # none was begun
    assert len(black_box.progress(watched)) == 2 * 8 * N_HEAD


@pytest.mark.parametrize(("every_tick", "kept"), [(True, [0, 1, 2, 3, 0, 0]), (False, [0, 1, 1, 1, 1, 1])])
def test_a_box_keeps_what_it_has_room_for(
    every_tick: bool, kept: list[int], watched: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(black_box, "EVERY_TICK", 3)
    black_box.watched(watched, every_tick=every_tick)
    head, rows = black_box.new("c.so", CAL)
    rows[:] = np.arange(1.0, len(rows) + 1.0)[:, None]
    for ticks, n in enumerate(kept):
        head[ENTERED], head[RETURNED] = ticks, -1.0
        box = black_box.left(watched)
        assert box is not None and box.tick == ticks - 1 and box.inputs[:, 0].tolist() == list(range(1, n + 1))


def test_a_box_takes_its_room_on_the_disk_before_the_first_tick(watched: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Head and first row: a disk that fills up later would end the process in the controller's name."""
    asked: list[tuple[int, int]] = []

    def full(handle: int, begin: int, many: int) -> None:
        asked.append((begin, many))
        raise OSError(28, "No space left on device")

    black_box.watched(watched, every_tick=True)
    before = len(os.listdir("/proc/self/fd"))
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(InputError, match="No space left on device"):
        black_box.new("c.so", CAL)
    assert asked == [(0, 8 * (64 + len(INPUTS)))] and len(os.listdir("/proc/self/fd")) == before


# ---- how the end is told ---------------------------------------------------------------------------------------------


def box_of(**more: Any) -> black_box.Box:
    given: dict[str, Any] = {
        "controller": "c.so", "calibration": {n: getattr(CAL, n).tolist() for n in ("k", "table", "angles")},
        "call": "vaneloop_step", "tick": 7, "inputs": np.zeros((8, len(INPUTS))), "reason": 0, "value": 0.0,
    }  # fmt: skip
    return black_box.Box(**given | more)


def test_what_a_controller_did_is_one_line() -> None:
    every, at = isolation._words(np.arange(float(len(INPUTS)))).split(", "), 0
    for field, words in zip(INPUT_FIELDS, every, strict=True):
        numbers = range(at, at := at + (len(field.each) or 1))
        unit = "" if field.unit == "-" else f" {field.unit}"
        assert words == f"{field.name} {' '.join(map(str, numbers))}{unit}"
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
    monkeypatch.setattr(black_box, "left", lambda folder: box_of(tick=0, inputs=np.zeros((1, len(INPUTS)))))
    first = isolation._failure(tmp_path, _End(5, signal.SIGSEGV), "f")
    assert ", in tick 0, 0.000 s after power-on; last inputs: " in first and first.endswith("; crash log: f")
    wrote.pop()
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


def test_an_exception_that_cannot_be_made_anew_comes_as_its_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """It can be written, but its own text is no argument of it. Libraries that teach pickle all exceptions make it."""
    monkeypatch.delitem(copyreg.dispatch_table, OfTwo, raising=False)
    good, what, lines = pickle.loads(isolation._pickled(False, OfTwo(1, 2)))
    assert not good and type(what) is RuntimeError and str(what) == "OfTwo: 1 and 2" and "OfTwo" in lines


def test_a_task_that_takes_away_its_folder_is_told_so() -> None:
    with pytest.raises(ControllerFailed, match=r"^the process with the controller ended what watches it, or took away"):
        isolated(lambda: shutil.rmtree(black_box._WATCHED[0][0]))


def test_how_long_is_waited_is_as_the_guide_says() -> None:
    guide = (Path(isolation.__file__).parents[2] / "docs" / "own_controller.md").read_text()
    assert f"does not come back from a call within {isolation.PATIENCE:g} s" in guide
    assert f"ignores Ctrl-C or SIGTERM for {isolation._ENDING:g} s" in guide
    assert f"more than {program._MOST:,} quantities, a state above {program._MOST_STATE >> 20} MiB" in guide
    assert isolated.__defaults__ == (None, isolation.PATIENCE)


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


# ---- the process with the controller ---------------------------------------------------------------------------------


def test_the_process_with_the_controller_is_one_of_its_own() -> None:
    """Its session, its signals as at the start of a program, an end with its parent's, no core file, first to go."""

    def task() -> dict[str, Any]:
        death, folder = ctypes.c_int(), black_box._WATCHED[0][0]
        ctypes.CDLL(None).prctl(2, ctypes.byref(death))  # PR_GET_PDEATHSIG
        for _ in range(1000):
            if (folder / "child").exists() and (folder / "child").read_text():
                break
            time.sleep(0.002)
        return {
            "session": os.getsid(0) == os.getpid(), "guard": os.getsid(os.getppid()) == os.getppid(),
            "mask": signal.pthread_sigmask(signal.SIG_BLOCK, []), "death": death.value,
            "rows": black_box._WATCHED[0][1],
            "handlers": [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)],
            "interrupt": signal.getsignal(signal.SIGINT) is signal.default_int_handler,
            "core": resource.getrlimit(resource.RLIMIT_CORE), "faults": faulthandler.is_enabled(),
            "memory": Path("/proc/self/oom_score_adj").read_text().strip(),
            "child": (folder / "child").read_text() == str(os.getpid()), "folder": str(folder),
        }  # fmt: skip

    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    handlers = [signal.getsignal(n) for n in isolation._ASKS]
    found = isolated(task)
    assert not os.path.exists(found.pop("folder"))
    assert found == {
        "session": True, "guard": True, "mask": mask, "death": signal.SIGKILL, "rows": 1,
        "handlers": [signal.SIG_DFL, signal.SIG_DFL], "interrupt": True, "core": (0, 0), "faults": False,
        "memory": "1000", "child": True,
    }  # fmt: skip
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == mask
    assert [signal.getsignal(n) for n in isolation._ASKS] == handlers
    assert isolated(lambda: black_box._WATCHED[0][1], save_crash="f") == black_box.EVERY_TICK


def test_what_was_said_before_is_written_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A copy of the process would write what is still in its streams a second time."""

    class Stream:
        flushed = 0

        def flush(self) -> None:
            self.flushed += 1

    out, error = Stream(), Stream()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", error)
    inside = isolated(lambda: (out.flushed, error.flushed))
    monkeypatch.setattr(sys, "stderr", None)
    isolation._flush()
    assert inside == (1, 1) and (out.flushed, error.flushed) == (2, 1)


def test_what_a_task_prints_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its streams are its own copies, and its process ends without what libraries do at an end."""

    def says(fails: bool) -> None:
        print("said", fails)
        if fails:
            raise ValueError("so")

    with (tmp_path / "out").open("w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        isolated(lambda: says(False))
        with pytest.raises(ValueError, match="^so$"):
            isolated(lambda: says(True))
        assert (tmp_path / "out").read_text() == "said False\nsaid True\n"


@pytest.fixture
def interruptible() -> Iterator[None]:
    """With SIGINT as Python has it, which a shell leaves ignored in what it runs in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_signals_go_on_to_the_controller_and_stops_are_waited_out() -> None:
    def asks(number: int) -> int:
        os.kill(os.getppid(), number)
        time.sleep(20.0)
        return 1

    with pytest.raises(KeyboardInterrupt):
        isolated(lambda: asks(signal.SIGINT))
    with pytest.raises(
        ControllerFailed, match=r"^the process with the controller ended by SIGTERM, outside a call of it$"
    ):
        isolated(lambda: asks(signal.SIGTERM))

    def stops_its_guard() -> int:
        os.kill(os.getppid(), signal.SIGSTOP)
        return 7

    assert isolated(stops_its_guard) == 7  # it is woken

    def stops_for_a_while() -> int:
        me = os.getpid()
        if os.fork() == 0:
            time.sleep(0.25)
            os.kill(me, signal.SIGCONT)
            os._exit(0)
        os.kill(me, signal.SIGSTOP)
        time.sleep(0.25)
        return 8

    assert isolated(stops_for_a_while) == 8
    with pytest.raises(ControllerFailed, match=r"^the process with the controller was stopped for 0\.3 s$"):
        isolated(lambda: os.kill(os.getpid(), signal.SIGSTOP), patience=0.3)


def in_a_call(then: Any) -> Any:
    """A task that is in tick 3 of a controller when it does ``then``."""

    def task() -> Any:
        head, _ = black_box.new("c.so", CAL)
        head[ENTERED], head[RETURNED] = 4.0, 3.0
        return then(head)

    return task


def test_a_call_that_does_not_come_back_is_ended_and_one_that_goes_on_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ControllerFailed) as e:
        isolated(in_a_call(lambda head: time.sleep(20.0)), patience=0.3)
    assert str(e.value).startswith(
        "--controller c.so: did not come back within 0.3 s, in tick 3, 0.003 s after power-on; "
    )

    def goes_on(head: Any) -> int:
        for _ in range(30):
            time.sleep(0.05)
            head[ENTERED] += 1.0
            head[RETURNED] += 1.0
        return 9

    assert isolated(in_a_call(goes_on), patience=1.0) == 9

    def does_not_hear(head: Any) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        os.kill(os.getppid(), signal.SIGTERM)
        while True:
            time.sleep(0.05)
            head[ENTERED] += 1.0

    monkeypatch.setattr(isolation, "_ENDING", 0.3)
    with pytest.raises(ControllerFailed, match=r"^--controller c\.so: did not end within 0\.3 s of SIGTERM, in tick "):
        isolated(in_a_call(does_not_hear))


def test_guard_and_controller_end_with_who_started_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The guard is also the next parent of what a controller leaves behind."""
    ask = isolation._prctl

    def noted(option: int, value: int) -> None:
        with (tmp_path / "asked").open("a") as f:
            f.write(f"{os.getpid()} {option} {value}\n")
        ask(option, value)

    monkeypatch.setattr(isolation, "_prctl", noted)
    guard, child = isolated(lambda: (os.getppid(), os.getpid()))
    asked = [tuple(map(int, line.split())) for line in (tmp_path / "asked").read_text().splitlines()]
    assert sorted(asked) == sorted([(guard, 1, signal.SIGKILL), (guard, 36, 1), (child, 1, signal.SIGKILL)])


def test_a_task_may_be_isolated_where_ends_of_processes_are_ignored() -> None:
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        assert isolated(lambda: 5) == 5
    finally:
        signal.signal(signal.SIGCHLD, before)


def test_nothing_stays_open_of_a_controller_or_of_its_process(good: str) -> None:
    mine = readable(CAL)
    before = len(os.listdir("/proc/self/fd"))
    foreign = Program(good).start(mine)
    isolated(lambda: 5)
    with pytest.raises(ControllerFailed):
        isolated(lambda: os._exit(3))
    assert len(os.listdir("/proc/self/fd")) == before and foreign.at_fed


def test_a_task_may_be_isolated_from_any_thread() -> None:
    came: list[int] = []
    thread = threading.Thread(target=lambda: came.append(isolated(lambda: 6)))
    thread.start()
    thread.join(60.0)
    assert came == [6]


def test_what_hears_of_no_end_of_its_session_is_ended_all_the_same() -> None:
    """A process whose parent has ended is the guard's: its next parent."""

    def task() -> int:
        read, write = os.pipe()
        if os.fork() == 0:
            if os.fork() == 0:
                os.setsid()
                os.write(write, str(os.getpid()).encode())
                time.sleep(60.0)
            os._exit(0)
        return int(os.read(read, 20))

    left = isolated(task)
    with pytest.raises(ProcessLookupError):
        os.kill(left, 0)


def test_exit_waits_for_nothing_that_was_registered_before() -> None:
    libc = ctypes.CDLL(None)
    child = os.fork()
    if child == 0:
        late = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_void_p)(lambda code, _: os._exit(9))
        libc.on_exit(late, None)
        isolation._end_at_once()
        libc.exit(4)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 4


def test_a_copy_of_the_process_cannot_write_into_its_box(watched: Path) -> None:
    black_box.watched(watched, every_tick=False)
    head, rows = black_box.new("c.so", CAL)
    head[ENTERED] = 1.0
    child = os.fork()
    if child == 0:
        faulthandler.disable()
        head[ENTERED] = 2.0
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGSEGV
    assert head[ENTERED] == 1.0 and rows.shape == (1, len(INPUTS))


def test_who_closes_what_is_not_its_own_is_named() -> None:
    def closes(*ends: int) -> Any:
        def task() -> str:
            black_box.new("c.so", CAL)
            os.closerange(*ends)
            return "good"

        return task

    for ends, said in (((0, 1), "standard input"), ((2, 3), "standard error"), ((3, 200), "a file descriptor")):
        with pytest.raises(ControllerFailed, match=rf"^--controller c\.so: it closed {said}, which is not its own$"):
            isolated(closes(*ends))
    assert isolated(closes(200, 201)) == "good"
    assert isolated(lambda: os.closerange(0, 1)) is None  # no controller: a task may


def test_a_session_whose_guard_is_gone_is_ended(tmp_path: Path) -> None:
    left = os.fork()
    if left == 0:
        os.setsid()
        time.sleep(60.0)
        os._exit(0)
    while os.getsid(left) != left:
        time.sleep(0.001)
    (tmp_path / "child").write_text(str(left))
    assert isolation._read_end(tmp_path) == _End()
    assert os.waitstatus_to_exitcode(os.waitpid(left, 0)[1]) == -signal.SIGKILL
    with pytest.raises(ControllerFailed) as e:
        isolated(lambda: os.kill(os.getppid(), signal.SIGKILL))
    assert str(e.value) == (
        "the process with the controller ended what watches it, or took away its folder for temporary files"
    )


def test_every_process_below_is_found_and_ours_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = {
        1: b"python\0-m\0hil.logs.recorder\0",
        2: b"python\0/a/hil/bus/broker.py\0",
        3: b"python\0hil/bus/broker.pyc\0",
    }
    for number, line in lines.items():
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "cmdline").write_bytes(line)
    monkeypatch.setattr(isolation, "Path", lambda text: tmp_path / text.removeprefix("/proc/"))
    assert [isolation._is_ours(n) for n in (1, 2, 3, 4)] == [True, True, False, False]
    # children, their children; a dead one counts where it is this process's own to clear away
    stats = {10: "(a b) S 1", 11: "(x)) y) S 10", 12: "(z) Z 10", 13: "(z) Z 7", 14: "(q) R 9", 15: "(broken"}
    for number, line in stats.items():
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "stat").write_text(f"{number} {line} 0 0")
    monkeypatch.setattr(isolation, "Path", lambda text: tmp_path)
    monkeypatch.setattr(os, "waitid", lambda *given: None)
    for me, below in ((1, [10, 11]), (7, [13]), (10, [11, 12]), (3, [])):
        monkeypatch.setattr(os, "getpid", lambda me=me: me)
        assert sorted(isolation._descendants()) == below


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
