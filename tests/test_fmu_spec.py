"""What each line of the FMU's making promises: C that computes what LLVM computes, the XML and the archive, numbers of
the memory, and a plant of others with its units.
"""

from __future__ import annotations

import ctypes
import gc
import itertools
import math
import re
import struct
import subprocess
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from llvmlite import binding as llvm

from controller import load_calibration, new_inputs, new_state
from controller.calibration import CalibrationTable
from controller.records import INPUTS, SCALARS, STATE, as_outputs
from hil.fmu import description, export, kernel, plant_fmu, source
from hil.fmu.ir_to_c import translate
from hil.fmu.memory import FED, NEXT, OWN_ENGINE, SHOWN, Shape, first, places_of
from hil.fmu.plant_fmu import PlantFmu, PlantNode
from hil.fmu.variables import FIXED, INPUT, OUTPUT, PARTS, REAL, TRUTH, TUNABLE, WHOLE, Variable, variables_of
from hil.loop.node import Node
from plant import Model, build_plant, places
from plant.parameters import LVDT_STEP
from vaneloop.base import extras
from vaneloop.base.child import python_module
from vaneloop.base.errors import InputError
from vaneloop.base.tables import read

PLANT, CAL = build_plant(), load_calibration()
TABLE = read("calibration.toml", CalibrationTable)
SHAPE, MEMORY = first(PLANT, CAL)

# ---- C from LLVM's text ----------------------------------------------------------------------------------------------

ORDERS = ("oeq", "ogt", "oge", "olt", "ole", "one", "ord", "ueq", "ugt", "uge", "ult", "ule", "une", "uno")
WHOLE_ORDERS = ("eq", "ne", "ugt", "uge", "ult", "ule", "sgt", "sge", "slt", "sle")


class Text:
    """A function in LLVM's text that puts each result in the next eight bytes of ``out``."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.n = 0

    def new(self, line: str) -> str:
        self.lines.append(f"  %t{len(self.lines)} = {line}")
        return f"%t{len(self.lines) - 1}"

    def put(self, kind: str, line: str) -> None:
        """Compute, and store as the kind of eight bytes that it is or becomes."""
        v = self.new(line) if " " in line else line
        if kind in ("i1", "i8", "i33"):
            v, kind = self.new(f"zext {kind} {v} to i64"), "i64"
        self.store(kind, v)

    def store(self, kind: str, value: str) -> None:
        at = self.new(f"getelementptr inbounds double, ptr %out, i64 {self.n}")
        self.lines.append(f"  store {kind} {value}, ptr {at}, align 8")
        self.n += 1


def arithmetic() -> Text:
    """Every operation on two doubles, two numbers of 64 bits and two of 32."""
    f = Text()
    a, b = (f.new(f"load double, ptr %{n}, align 8") for n in ("in", "in1"))
    x, y = (f.new(f"load i64, ptr %{n}, align 8, !noalias !5") for n in ("in2", "in3"))
    p, q = (f.new(f"load i32, ptr %{n}, align 4") for n in ("in4", "in5"))
    for op in ("fadd", "fsub", "fmul", "fdiv"):
        f.put("double", f"{op} double {a}, {b}")
    f.put("double", f"fneg double {a}")
    odd, few, odd32 = f.new(f"or i64 {y}, 1"), f.new(f"and i64 {y}, 63"), f.new(f"or i32 {q}, 1")
    small = f.new(f"and i64 {odd}, 1048575")
    for op in ("add nsw", "sub", "mul", "and", "or disjoint", "xor"):
        op = "or" if op == "or disjoint" else op
        f.put("i64", f"{op} i64 {x}, {y}")
        f.put("i64", f"zext i32 {f.new(f'{op} i32 {p}, {q}')} to i64")
    for op in ("shl", "lshr", "ashr"):
        f.put("i64", f"{op} i64 {x}, {few}")
    for op, by in (("udiv", odd), ("urem", odd), ("sdiv", small), ("srem", small)):
        f.put("i64", f"{op} i64 {x}, {by}")
    f.put("i64", f"zext i32 {f.new(f'udiv i32 {p}, {odd32}')} to i64")
    flags = [f.new(f"fcmp {how} double {a}, {b}") for how in ORDERS]
    flags += [f.new(f"icmp {how} i64 {x}, {y}") for how in WHOLE_ORDERS]
    flags += [f.new(f"icmp {how} i32 {p}, {q}") for how in WHOLE_ORDERS]
    flags += [f.new(f"fcmp {how} double {a}, {a}") for how in ("ord", "uno", "oeq", "une")]
    for flag in flags:
        f.put("i1", flag)
    for op, (u, v) in zip(("and", "or", "xor", "add"), itertools.pairwise(flags[::3]), strict=False):
        f.put("i1", f"{op} i1 {u}, {v}")
    f.put("i64", f"sext i1 {flags[1]} to i64")
    f.put("i64", f"sext i32 {p} to i64")
    f.put("i64", f"zext nneg i32 {f.new(f'and i32 {p}, 1023')} to i64")
    f.put("i64", f"zext i32 {f.new(f'trunc i64 {x} to i32')} to i64")
    byte = f.new(f"trunc i64 {x} to i8")
    f.put("i64", f"sext i8 {byte} to i64")
    f.put("i8", byte)
    f.put("i1", f"trunc i64 {x} to i1")
    f.put("i33", f"trunc i64 {x} to i33")
    f.put("i64", f"zext i7 {f.new(f'trunc i64 {x} to i7')} to i64")
    f.put("double", f"sitofp i64 {x} to double")
    f.put("double", f"uitofp i64 {x} to double")
    f.put("double", f"sitofp i32 {p} to double")
    f.put("double", f"uitofp i32 {p} to double")
    f.put("i64", f"fptosi double {f.new(f'sitofp i32 {q} to double')} to i64")
    f.put("i64", f"bitcast double {a} to i64")
    f.put("double", f"bitcast i64 {y} to double")
    f.put("i64", f"ptrtoint ptr {f.new(f'inttoptr i64 {x} to ptr')} to i64")
    f.put("double", f"freeze double {b}")
    f.put("double", f"select i1 {flags[3]}, double {a}, double {b}")
    f.put("i64", f"select i1 {flags[16]}, i64 {x}, i64 -7")
    for name in ("fabs", "floor", "ceil", "trunc", "rint"):
        f.put("double", f"call double @llvm.{name}.f64(double {a})")
    f.put("double", f"tail call double @llvm.sqrt.f64(double {f.new(f'call double @llvm.fabs.f64(double {a})')}) #3")
    f.put("double", f"call double @llvm.copysign.f64(double {a}, double {b})")
    for name in ("smin", "smax", "umin", "umax"):
        f.put("i64", f"call i64 @llvm.{name}.i64(i64 {x}, i64 {y})")
        f.put("i64", f"zext i32 {f.new(f'call i32 @llvm.{name}.i32(i32 {p}, i32 {q})')} to i64")
    f.put("double", "call double @atan2(double " + f"{a}, double {b})")
    for kind, value in (
        ("double", "1.500000e+00"), ("double", "-2.500000e-01"), ("double", "0x7FF8000000000000"),
        ("double", "0xFFF0000000000000"), ("double", "0x7FF0000000000000"), ("double", "-0.000000e+00"),
        ("double", "0x3FB999999999999A"), ("double", "0xBFB999999999999A"), ("i64", "-9223372036854775808"),
        ("i64", "-9223372036854775807"), ("i64", "9223372036854775807"), ("ptr", "null"),
    ):  # fmt: skip
        f.store(kind, value)
    f.put("i1", f"xor i1 {flags[0]}, true")
    f.put("i1", f"or i1 {flags[0]}, false")
    return f


FLOW = """
@.tab = internal constant [16 x i8] c"\\01\\02\\03\\04\\05\\06\\07\\88ab\\22defg\\\\", align 8
@.zero = internal constant [8 x i8] zeroinitializer

define internal i32 @"my::helper.1"(double %0, i64 %1, ptr %2) {
  %4 = call i32 @inner(i64 %1)
  %5 = sitofp i32 %4 to double
  %6 = fadd double %0, %5
  store double %6, ptr %2, align 8
  ret i32 0
}

define internal i32 @inner(i64 %0) {
entry:
  switch i64 %0, label %other [
    i64 -3, label %low
    i64 5, label %high
  ]

low:                                              ; preds = %entry
  ret i32 11

high:
  br label %other

other:                                            ; preds = %high, %entry
  %said = phi i32 [ 22, %high ], [ 33, %entry ]
  ret i32 %said
}

define i32 @flow(ptr %in, ptr %out) #0 {
  %n = load i64, ptr %in, align 8
  %own = alloca double, align 8
  call void @llvm.lifetime.start.p0(i64 8, ptr %own)
  store double 2.000000e+00, ptr %own, align 8
  br label %loop

loop:                                             ; preds = %loop, %0
  %i = phi i64 [ 0, %0 ], [ %next, %loop ]
  %x = phi i64 [ 1, %0 ], [ %y, %loop ]
  %y = phi i64 [ 2, %0 ], [ %x, %loop ]
  %sum = phi i64 [ 0, %0 ], [ %more, %loop ]
  %more = add i64 %sum, %x
  %next = add nuw nsw i64 %i, 1
  %done = icmp sge i64 %next, %n
  br i1 %done, label %end, label %loop

end:                                              ; preds = %loop
  store i64 %more, ptr %out, align 8
  %o1 = getelementptr i8, ptr %out, i64 8
  store i64 %y, ptr %o1, align 8
  %o2 = getelementptr inbounds i64, ptr %out, i64 2
  %r1 = call i32 @"my::helper.1"(double 5.000000e-01, i64 %n, ptr nonnull %o2)
  %o3 = getelementptr double, ptr %out, i64 3
  %r2 = call i32 @"my::helper.1"(double 2.500000e-01, i64 5, ptr %o3)
  %two = load double, ptr %own, align 8
  %o4 = getelementptr double, ptr %out, i64 4
  store double %two, ptr %o4, align 8
  %c = load i64, ptr @.tab, align 8
  %o5 = getelementptr double, ptr %out, i64 5
  store i64 %c, ptr %o5, align 8
  %d = load i64, ptr getelementptr inbounds (i8, ptr @.tab, i64 8), align 8
  %o6 = getelementptr double, ptr %out, i64 6
  store i64 %d, ptr %o6, align 8
  %o7 = getelementptr i32, ptr %out, i64 14
  call void @llvm.memset.p0.i64(ptr %o7, i8 -91, i64 16, i1 false)
  %o8 = getelementptr i32, ptr %out, i64 16
  call void @llvm.memcpy.p0.p0.i64(ptr %o8, ptr @.zero, i64 4, i1 false)
  %o9 = getelementptr double, ptr %out, i64 9
  call void @llvm.memmove.p0.p0.i64(ptr align 8 %o9, ptr align 8 %o5, i64 16, i1 false)
  %odd = and i64 %n, 1
  %is = icmp eq i64 %odd, 1
  br i1 %is, label %last, label %last

last:                                             ; preds = %end, %end
  %of = phi i64 [ %more, %end ], [ %more, %end ]
  %o11 = getelementptr double, ptr %out, i64 11
  store i64 %of, ptr %o11, align 8
  %b = icmp sgt i64 %n, 4
  br i1 %b, label %yes, label %no

yes:
  br label %no

no:                                               ; preds = %yes, %last
  %took = phi double [ 1.000000e+00, %yes ], [ 0x7FF0000000000000, %last ]
  %o12 = getelementptr double, ptr %out, i64 12
  store double %took, ptr %o12, align 8
  ret i32 %r2
}

declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
declare void @llvm.memmove.p0.p0.i64(ptr, ptr, i64, i1)
declare void @llvm.lifetime.start.p0(i64, ptr)
attributes #0 = { nounwind }
"""


def module() -> tuple[str, int]:
    f = arithmetic()
    declared = [f"declare double @llvm.{n}.f64(double)" for n in ("fabs", "floor", "ceil", "trunc", "rint", "sqrt")]
    declared += ["declare double @llvm.copysign.f64(double, double)", "declare double @atan2(double, double)"]
    declared += [f"declare i{w} @llvm.{n}.i{w}(i{w}, i{w})" for n in ("smin", "smax", "umin", "umax") for w in (64, 32)]
    places_in = [f"  %in{k} = getelementptr double, ptr %in, i64 {k}" for k in range(1, 6)]
    body = "\n".join(["define i32 @every(ptr %in, ptr %out) #0 {", *places_in, *f.lines, "  ret i32 0", "}"])
    return "\n".join([FLOW, *declared, "attributes #3 = { nounwind }", "!5 = !{}", "", body, ""]), f.n


Both = tuple[Any, Any]


@pytest.fixture(scope="module")
def both(gcc: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Both]:
    """Each function as LLVM runs it, and as the C that it is translated into."""
    ir, _ = module()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    made = llvm.parse_assembly(ir)
    made.verify()
    engine = llvm.create_mcjit_compiler(made, llvm.Target.from_default_triple().create_target_machine())
    engine.finalize_object()
    folder = tmp_path_factory.mktemp("c")
    out: dict[str, Both] = {}
    kind = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)
    for name in ("every", "flow"):
        (folder / f"{name}.c").write_text(translate(ir, name, "serve"))
        words = [gcc, *description.OPTIONS.split(), "-O0", "-fPIC", "-shared", "-o", f"{name}.so", f"{name}.c", "-lm"]
        subprocess.run(words, cwd=folder, check=True)
        library = ctypes.CDLL(str(folder / f"{name}.so"))
        theirs = kind(engine.get_function_address(name))
        theirs.engine = engine  # type: ignore[attr-defined]
        out[name] = theirs, kind(("serve", library))
    return out


def ran(function: Any, given: bytes, n: int) -> tuple[int, list[str]]:
    data, out = ctypes.create_string_buffer(given), ctypes.create_string_buffer(8 * n + 8)
    code = function(ctypes.addressof(data), ctypes.addressof(out))
    words = [w.hex() for w in struct.iter_unpack("8s", out.raw[: 8 * n]) for w in w]
    assert out.raw[8 * n :] == bytes(8)
    return code, [w if not is_nan(w) else "nan" for w in words]


def is_nan(word: str) -> bool:
    return math.isnan(struct.unpack("<d", bytes.fromhex(word))[0])


DOUBLES = (1.5, -2.25, 0.0, -0.0, math.nan, math.inf, -math.inf, 1e300, -7.5)
WHOLES = (0, 1, -1, 5, -(1 << 63), (1 << 63) - 1, 0x8000_0080, -129, 1 << 40)


def test_every_operation_is_llvms(both: dict[str, Both]) -> None:
    theirs, ours = both["every"]
    n, rng = module()[1], np.random.default_rng(1)
    pairs = [*itertools.product(DOUBLES, DOUBLES)]
    for k, (a, b) in enumerate(pairs):
        x, y = (int(v) for v in rng.choice(np.array(WHOLES, dtype=np.int64), 2))
        if k % 2:
            x, y = (int(v) for v in rng.integers(-(1 << 63), (1 << 63) - 1, 2))
        p, q = (int(v) for v in rng.integers(-(1 << 31), 1 << 31, 2))
        p = q if k % 5 == 0 else p
        y = x if k % 7 == 0 else y
        given = struct.pack("<ddqqi4xi4x", a, b, x, y, p, q)
        assert ran(ours, given, n) == ran(theirs, given, n), (a, b, x, y, p, q)


def test_every_way_through_is_llvms(both: dict[str, Both]) -> None:
    theirs, ours = both["flow"]
    seen = set()
    for n in (-3, 0, 1, 2, 5, 6):
        got = ran(ours, struct.pack("<q", n), 13)
        assert got == ran(theirs, struct.pack("<q", n), 13), n
        seen.add(tuple(got[1]))
    assert len(seen) == 5  # -3, 0 and 1 differ by what the switch says; 0 and 1 by nothing


def one(*lines: str, before: str = "") -> str:
    return before + "define i32 @f(ptr %a, double %d, i64 %i) {\n" + "".join(f"  {x}\n" for x in lines) + "}\n"


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("%x = call double @unheard(double %d)", "unheard: no function that C has"),
        ("%x = call double %d(double %d)", "double %d(double %d)"),
        ("%x = getelementptr [2 x double], ptr %a, i64 0, i64 1", "getelementptr"),
        ("%x = getelementptr float, ptr %a, i64 1", "getelementptr"),
        ("%x = load i64, ptr getelementptr inbounds ([9 x i64], ptr @g, i64 0, i64 2)", "getelementptr"),
        ("%x = fptoui double %d to i64", "fptoui"),
        ("%x = sext i7 %i to i64", "sext"),
        ("%x = frem double %d, %d", "frem"),
        ("%x = sdiv i1 %i, %i", "sdiv"),
        ("switch ptr %a, label %b []", "label"),
        ("store i64 i8*, ptr %a", "store i64 i8*, ptr %a"),
        ("store i1 true, ptr %a", "store i1 true, ptr %a"),
        ("%x = load float, ptr %a", "load float"),
        ("%x = fadd double %d, one", "fadd double %d, one"),
        ("%x = fadd double %d", "fadd double %d"),
        ("%x = add <2 x i64> %i, %i", "add <2 x i64> %i, %i"),
        ("%x = phi <2 x i64> [ %i, %b ]", "phi <2 x i64>"),
        ("%x = icmp slt i7 %i, %i", "icmp slt i7"),
        ("%x = icmp eq i64", "icmp eq i64"),
        ("%x = alloca float", "alloca float"),
        ("%x = alloca i64, i64 %i", "alloca i64, i64 %i"),
        ("br i1 true, label %b, label %c", "br i1 true"),
        ("ret", "ret"),
    ],
)
def test_what_is_not_known_is_refused_with_its_line(line: str, says: str) -> None:
    with pytest.raises(NotImplementedError, match=re.escape(says)):
        translate(one(line, "ret i32 0"), "f", "serve")


def test_bytes_that_are_no_whole_numbers_are_refused() -> None:
    text = one("store ptr @tab, ptr %a", "ret i32 0", before='@tab = constant [9 x i8] c"abcdefghi"\n')
    with pytest.raises(NotImplementedError, match=r"\[9 x i8\]"):
        translate(text, "f", "serve")


def test_a_type_that_c_has_not_is_refused() -> None:
    for kind in ("float", "i65", "i64x", "<2 x double>", "i0"):
        with pytest.raises(NotImplementedError, match="fadd"):
            translate(one(f"%x = fadd {kind.split()[0]} %d, %d", "ret i32 0"), "f", "serve")
    for head in ("define float @f(ptr %a) {", "define i32 @f(float %a) {", "define i32 @f(ptr %a, <2 x i64> %i) {"):
        with pytest.raises(NotImplementedError):
            translate(f"{head}\n  ret i32 0\n}}\n", "f", "serve")


def test_the_text_is_one_function_and_what_it_calls() -> None:
    text = translate(module()[0], "flow", "serve")
    assert text.startswith("#include <math.h>")
    heads = [x for x in text.split("\n") if x.endswith(";") and ("part_" in x or "serve" in x) and x[0] != " "]
    assert heads == [
        "int32_t serve(uintptr_t v0, uintptr_t v1);",
        "static int32_t part_1(double v0, int64_t v1, uintptr_t v2);",
        "static int32_t part_2(int64_t v0);",
    ]
    assert "static const uint64_t g__tab[] = {0x8807060504030201u, 0x5c67666564226261u};" in text
    assert "static const uint64_t g__zero[] = {0x0u};" in text
    assert "return 1;" in translate(one("unreachable"), "f", "serve")
    for kind, n in (("ptr", 1), ("i32", 1), ("{ double, [3 x i64], i8 }", 5), ("[2 x { i64, ptr }]", 4)):
        assert f"uint64_t v3_of[{n}];" in translate(one(f"%x = alloca {kind}, align 8", "ret i32 0"), "f", "serve")
    pickled = one("store ptr @.pickle, ptr %a", "ret i32 0", before='@.pickle = constant [8 x i8] c"abcdefgh"\n')
    assert "static const uint64_t g__pickle[1] = {0};" in translate(pickled, "f", "serve")


def test_a_compiled_function_is_what_its_c_computes(gcc: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def serve(m: Any, what: int, ticks: int) -> None:
        if what > 1:
            m[0] = m[what] / (ticks - 2) + math.floor(m[1])  # a division by zero is infinite, no error

    monkeypatch.setattr(source, "entry", lambda part, shape: serve)
    (tmp_path / "f.c").write_text(source._translated("plant", Shape(1, 2, 3)))
    subprocess.run([gcc, "-std=c99", "-fPIC", "-shared", "-o", "f.so", "f.c", "-lm"], cwd=tmp_path, check=True)
    m, made = np.array([1.5, -2.75, -3.25, 8.0]), ctypes.CDLL(str(tmp_path / "f.so")).serve
    place = ctypes.create_string_buffer(64)
    words = [ctypes.c_void_p(ctypes.addressof(place)), ctypes.c_void_p(ctypes.addressof(place))]
    for what, ticks, expected in ((1, 9, 1.5), (3, 4, 1.0), (2, 2, -math.inf), (3, 2, math.inf)):
        assert made(*words, m.ctypes.data_as(ctypes.c_void_p), ctypes.c_int64(what), ctypes.c_int64(ticks)) == 0
        assert m.tolist() == [expected, -2.75, -3.25, 8.0]


# ---- the memory and its variables ------------------------------------------------------------------------------------


def test_the_arrays_lie_one_behind_the_other() -> None:
    at = 0
    for name, place in places_of(Shape(5, 30, 20)).items():
        assert place.at == at, name
        at += int(np.prod(place.shape)) if place.shape else 0
    shapes = {n: p.shape for n, p in places_of(Shape(5, 30, 20)).items()}
    assert shapes["fed"] == (len(FED) + 5,) and shapes["shown"] == (len(SHOWN) + 5,)
    assert shapes["table"] == shapes["built_table"] == (4, 30) and shapes["built_angles"] == (6, 20)
    assert shapes["sigma"] == (7,) and shapes["still"] == (1, 7) and shapes["angles"] == (5,)
    assert shapes["z"] == (len(STATE),) and shapes["inputs"] == (len(INPUTS),) and shapes["k"] == (len(SCALARS),)


def held(name: str) -> np.ndarray:
    shape, memory = first(PLANT, CAL)
    at, size = places_of(shape)[name]
    return memory[at : at + int(np.prod(size))].reshape(size)


def test_the_memory_before_the_start_is_the_machines() -> None:
    assert first(PLANT, CAL)[0] == (len(PLANT.vanes), CAL.table.shape[1], CAL.angles.shape[1])
    assert held("clock").tolist() == [0.0, 1.0, 0.0, 0.0]
    fed = dict(zip(FED, held("fed"), strict=False))
    assert fed == {
        "n_dem": 60.0, "n_r": 60.0, "i_cmd": 0.0, "x_lvdt": 0.0, "p_s": 21e6, "t_oil": 40.0, "mode_request": 1.0,
        "demand_fresh": 1.0, "demand_rejected": 0.0, "pause": 0.0,
    }  # fmt: skip
    for name, values in (
        ("inputs", new_inputs()), ("z", new_state()), ("k", CAL.k), ("built_k", CAL.k), ("table", CAL.table),
        ("built_table", CAL.table), ("built_angles", CAL.angles), ("p", PLANT.p),
    ):  # fmt: skip
        np.testing.assert_array_equal(held(name), values, err_msg=name)
    assert np.isnan(held("flash")).all() and np.isnan(held("sent")).all()
    for name in ("shown", "outputs", "s", "sigma", "still", "mean", "angles"):
        assert not held(name).any(), name


WORN = Model(
    parameters={"actuator.flow_gain": 0.147},
    effects={"valve_dead_band": {"half_width": 1.2}, "can_delay": {"delay": 0.05}},
)


def of(part: str, plant: Any = PLANT, model: Model | None = None) -> dict[str, Variable]:
    shape, memory = first(plant, CAL)
    return {v.name: v for v in variables_of(part, plant, model or Model(), CAL, TABLE, memory, shape)}


def test_each_parameter_is_the_number_of_the_memory_that_it_acts_on() -> None:
    acting = {n: v for n, v in of("loop").items() if v.acts >= 0}
    assert len(acting) > 300
    for name, v in acting.items():
        # the effects' rows of the memory are as they are without the effect
        assert MEMORY[v.acts] == pytest.approx(v.start * v.si * v.ratio, rel=1e-12, abs=1e-15), name
        assert v.role == TUNABLE and v.kind == REAL and v.at == -1 and v.low <= v.start <= v.high and v.description
    for name, v in of("loop").items():
        if v.role == INPUT:
            assert MEMORY[v.at] == v.start, name
    assert acting["controller.stroke_table.retraction[7]"].start == pytest.approx(1e3 * CAL.table[2, 6])
    v = acting["controller.stroke_table.single[1]"]
    assert (v.low, v.high, v.unit) == (
        0.0,
        100.0,
        "mm",
    ) and v.description == f"stroke of the curve single at {CAL.table[0, 0]:g} %"
    assert f"controller.stroke_table.extension[{SHAPE.points}]" in acting
    assert acting["plant.linkage.vigv_play"].ratio != 1.0 and acting["plant.actuator.flow_gain"].ratio == 1.0


def test_each_part_has_its_own_signals() -> None:
    plant, controller, loop = (of(part) for part in PARTS)

    def names(found: dict[str, Variable], role: int) -> list[str]:
        return [n for n, v in found.items() if v.role == role]

    vanes = list(PLANT.vanes)
    assert names(plant, INPUT) == ["n_dem", "n_r", "i_cmd", "p_s", "t_oil"]
    assert names(plant, OUTPUT) == ["x_lvdt", "x", "n_engine", *vanes]
    assert names(controller, INPUT) == [
        "n_dem",
        "n_r",
        "x_lvdt",
        "mode_request",
        "demand_fresh",
        "demand_rejected",
        "pause",
        *vanes,
    ]
    assert names(controller, OUTPUT) == ["i_cmd", "x_dem", "state", "faults"]
    assert names(loop, INPUT) == ["n_dem", "n_r", "p_s", "t_oil", "mode_request", "demand_fresh", "demand_rejected"]
    assert names(loop, OUTPUT) == [n for n in SHOWN if n != "i_motor"] + vanes
    assert names(plant, FIXED) == ["own_engine"] and names(controller, FIXED) == ["controller.schedule.strategy"]
    assert names(loop, FIXED) == ["own_engine", "controller.schedule.strategy"]
    assert "i_motor" in of("plant", build_plant("plant_electromechanical.toml"))
    assert not any(n.startswith(("plant.", "effects.valve")) for n in controller)
    assert not any(n.startswith("controller.") for n in plant)
    # the frames' delay acts where the demand comes in, everything else in the machine
    demand = {n for n in controller if n.startswith("effects.")}
    assert demand and demand.isdisjoint(plant) and demand < set(loop)


def test_signals_have_their_places_units_and_bounds() -> None:
    at, controller, loop = places_of(SHAPE), of("controller"), of("loop")
    for k, name in enumerate(FED):
        for found in (controller, loop, of("plant")):
            if name in found and found[name].role == INPUT:
                assert found[name].at == at["fed"].at + k
    for k, name in enumerate(SHOWN):
        if name in loop:
            assert loop[name].at == at["shown"].at + k
    for k, vane in enumerate(PLANT.vanes):
        assert controller[vane].at == at["fed"].at + len(FED) + k
        assert loop[vane].at == at["shown"].at + len(SHOWN) + k
        assert math.isnan(controller[vane].low) and math.isnan(controller[vane].high)
        assert (loop[vane].unit, loop[vane].shown) == (controller[vane].unit, controller[vane].shown) == ("rad", "deg")
    assert loop["own_engine"].at == at["clock"].at + OWN_ENGINE
    assert loop["own_engine"][5:8] == (1.0, 0.0, 1.0) and loop["own_engine"].kind == TRUTH
    assert (loop["n_dem"].low, loop["n_dem"].high) == (-math.inf, math.inf)
    assert math.isnan(controller["n_dem"].low)  # a measured signal may be missing
    assert (loop["mode_request"].low, loop["mode_request"].high, loop["mode_request"].kind) == (0.0, 1.0, WHOLE)
    assert (loop["demand_rejected"].low, loop["demand_rejected"].high) == (0.0, 1e6)
    assert (loop["demand_fresh"].high, loop["demand_fresh"].kind) == (1.0, TRUTH)
    assert (loop["p_s"].start, loop["t_oil"].start, loop["n_dem"].start) == (21e6, 40.0, 60.0)
    assert loop["state"].description.startswith("controller mode: 0 ") and "faults: 1 " in loop["faults"].description
    assert "without effect" in loop["n_r"].description and controller["n_r"].description == "measured rotor speed"
    s = loop["controller.schedule.strategy"]
    assert (s.kind, s.low, s.high, s.start) == (WHOLE, 0.0, 3.0, float(CAL.scalars.strategy))
    assert s.at == at["built_k"].at + SCALARS.index("strategy") and s.description.startswith("0 single, 1 ")


def test_a_models_numbers_take_the_place_of_the_nominal_ones() -> None:
    plain, worn = of("loop"), of("loop", model=WORN)
    assert (plain["plant.actuator.flow_gain"].start, worn["plant.actuator.flow_gain"].start) == (0.150, 0.147)
    name = "effects.valve_dead_band.half_width"
    assert (plain[name].start, worn[name].start) == (0.0, 1.2)
    assert "neutral: 0" in plain[name].description
    assert {n for n in plain if plain[n] != worn[n]} == {
        "plant.actuator.flow_gain", name, "effects.can_delay.delay"
    }  # fmt: skip


# ---- the text of model.c, and what is kept ---------------------------------------------------------------------------


def test_the_models_source_is_its_variables_and_numbers() -> None:
    variables = [
        Variable("n", REAL, INPUT, "%", "speed", 61.0, math.nan, math.inf, 1, shown=""),
        Variable("own", REAL, TUNABLE, "mm", "a length", 2.5, -1.0, 4.0, -1, 7, 1e-3, 3.0),
        Variable('q"\\', TRUTH, FIXED, "", "yes", 1.0, 0.0, 1.0, 2),
        Variable("out", WHOLE, OUTPUT, "", "mode", at=0),
        Variable("more", REAL, TUNABLE, "-", "a number", -0.0, -math.inf, 1.0, -1, 8),
    ]
    memory = np.array([4.0, 5.0, 6.0, math.nan, math.inf, -math.inf, 0.1, 7.0, 8.0])
    head, body = source.model_source("loop", Shape(1, 2, 3), memory, variables)
    rows = re.findall(r"    \{(\w+), (\w+), (-?\d+), (-?\d+), (.*?), (\"(?:[^\"\\]|\\.)*\"), (\".*?\")\},", body)
    assert rows == [
        ("REAL", "TIME", "0", "-1", "1, 1, -INFINITY, INFINITY", '"time"', '"s"'),
        ("REAL", "INPUT", "1", "-1", f"{(1.0).hex()}, {(1.0).hex()}, NAN, INFINITY", '"n"', '"%"'),
        ("REAL", "TUNABLE", "9", "7", f"{(1e-3).hex()}, {(3.0).hex()}, {(-1.0).hex()}, {(4.0).hex()}", '"own"', '"mm"'),
        ("TRUTH", "FIXED", "2", "-1", f"{(1.0).hex()}, {(1.0).hex()}, 0, {(1.0).hex()}", '"q\\"\\\\"', '""'),
        ("WHOLE", "OUTPUT", "0", "-1", f"{(1.0).hex()}, {(1.0).hex()}, -INFINITY, INFINITY", '"out"', '""'),
        ("REAL", "TUNABLE", "10", "8", f"{(1.0).hex()}, {(1.0).hex()}, -INFINITY, {(1.0).hex()}", '"more"', '"-"'),
    ]
    cells = body.split("first[NUMBERS] = {\n")[1].split("};")[0].replace("\n", " ").split(",")
    assert [c.strip() for c in cells if c.strip()] == [
        "0", 61.0.hex(), 1.0.hex(), "NAN", "INFINITY", "-INFINITY", 0.1.hex(), 7.0.hex(), 8.0.hex(), 2.5.hex(), "-0.0"
    ]  # fmt: skip
    assert max(line.count(",") for line in body.split("first[NUMBERS]")[1].split("\n")) == 8
    assert "#define NUMBERS 11\n" in head and "#define VARIABLES 6\n" in head
    assert f"#define CLOCK {places_of(Shape(1, 2, 3))['clock'].at} " in head
    assert f"#define WARM_UP {source.WARM_UP} " in head and source.WARM_UP > 0
    assert re.search(r'#define TOKEN "\{[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}\}"\n', head)
    other = source.model_source("plant", Shape(1, 2, 3), memory, variables)
    assert other[1] == body and "#define WARM_UP 0 " in other[0]
    assert head.rsplit('"', 2)[1] != other[0].rsplit('"', 2)[1]


class Ran:
    """In place of `subprocess.run`."""

    def __init__(self, code: int = 0, out: str = "the source") -> None:
        self.code, self.out, self.asked = code, out, list[tuple[list[str], dict[str, Any]]]()

    def __call__(self, words: list[str], **more: Any) -> Any:
        self.asked.append((words, more))
        if "-o" in words:
            (Path(more["cwd"]) / words[words.index("-o") + 1]).write_bytes(b"made")
        return SimpleNamespace(returncode=self.code, stdout=self.out, stderr="x" * 3000 + " the end")


def test_the_source_and_the_object_are_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Ran()
    monkeypatch.setattr(source, "_folder", lambda: tmp_path / "kept")
    monkeypatch.setattr(source.subprocess, "run", made)
    shape = Shape(3, 66, 49)
    assert source.kept_source("loop", shape) == tmp_path / "kept" / "loop-3-66-49.c"
    assert not export.is_made("loop", PLANT, CAL) and export.is_made("no part", PLANT, CAL)
    assert source.part_source("loop", shape) == source.part_source("loop", shape) == "the source"
    ((words, more),) = made.asked
    assert words == python_module("hil.fmu.source", "loop", "3", "66", "49")
    assert more["env"]["NUMBA_CACHE_DIR"] == str(tmp_path / "kept")
    assert more["env"]["NUMBA_CPU_NAME"] == "generic" and more["env"]["NUMBA_SLP_VECTORIZE"] == "0"
    at = source.part_object("loop", shape)
    assert at.read_bytes() == b"made" and at == source.part_object("loop", shape) and at.name.endswith(".o")
    assert len(made.asked) == 2 and made.asked[1][0][:2] == ["gcc", "-std=c99"] and "-c" in made.asked[1][0]
    assert {"-fPIC", "-fvisibility=hidden"} <= set(made.asked[1][0])
    assert {f.name for f in (tmp_path / "kept").iterdir()} == {"lock", "loop-3-66-49.c", at.name}


def test_what_fails_says_the_end_of_what_was_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source, "_folder", lambda: tmp_path)
    monkeypatch.setattr(source.subprocess, "run", Ran(1))
    with pytest.raises(RuntimeError, match=r"could not be made: x{1992} the end$"):
        source.part_source("loop", Shape(3, 66, 49))
    assert not source.kept_source("loop", Shape(3, 66, 49)).exists()
    with pytest.raises(RuntimeError, match=r"gcc could not build the FMU: x{1992} the end$"):
        source.build(["x.c"], "x.so", tmp_path)


def test_the_folder_of_what_is_kept_follows_the_sources() -> None:
    name = source._folder().name
    assert re.fullmatch(r"fmu-[0-9a-f]{16}", name)
    source._folder.cache_clear()
    assert source._folder().name == name


# ---- the XML ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "base"),
    [
        ("%", {"factor": "0.01"}), ("-", {}), ("", {}), ("degC", {"K": "1", "offset": "273.15"}), ("s", {"s": "1"}),
        ("mm", {"m": "1", "factor": "0.001"}), ("m2", {"m": "2"}), ("N", {"kg": "1", "m": "1", "s": "-2"}),
        ("A s/rad", {"A": "1", "s": "1", "rad": "-1"}), ("kg m2", {"kg": "1", "m": "2"}),
        ("Ohm", {"kg": "1", "m": "2", "s": "-3", "A": "-2"}),
        ("MPa", {"kg": "1", "m": "-1", "s": "-2", "factor": "1000000.0"}),
    ],
)  # fmt: skip
def test_a_unit_is_the_powers_of_the_base_units(unit: str, base: dict[str, str]) -> None:
    got = description.base_unit(unit)
    assert {k: v for k, v in got.items() if k != "factor"} == {k: v for k, v in base.items() if k != "factor"}
    assert float(got.get("factor", 1.0)) == pytest.approx(float(base.get("factor", 1.0)), rel=1e-14)
    assert ("factor" in got) == ("factor" in base)
    assert float(description.base_unit("%/s")["factor"]) == pytest.approx(0.01)


DESCRIBED = [
    Variable("n", REAL, INPUT, "%", "speed", 61.5, -math.inf, 120.0),
    Variable("x", REAL, OUTPUT, "m", "stroke", shown="mm"),
    Variable("mode", WHOLE, OUTPUT, "", "mode"),
    Variable("count", WHOLE, INPUT, "", "count", 0.0, 0.0, 1e6),
    Variable("own", TRUTH, FIXED, "", "own", 1.0, 0.0, 1.0),
    Variable("off", TRUTH, INPUT, "", "off", 0.0, 0.0, 1.0),
    Variable("kp", REAL, TUNABLE, "mA/mm", "gain", 1e16, 0.25, math.inf),
]


def test_the_description_of_fmi_3() -> None:
    root = ET.fromstring(description.model_description("3.0", "A machine", "it", "{token}", DESCRIBED, "1.2"))
    assert root.attrib == {
        "fmiVersion": "3.0", "modelName": "A machine", "instantiationToken": "{token}",
        "description": "Variable guide vanes of a gas turbine, in ticks of 1 ms", "license": "Apache-2.0",
        "generationTool": "VaneLoop 1.2", "variableNamingConvention": "structured",
    }  # fmt: skip
    assert root.find("CoSimulation").attrib == {  # type: ignore[union-attr]
        "modelIdentifier": "it", "canHandleVariableCommunicationStepSize": "true", "canGetAndSetFMUState": "true",
        "canSerializeFMUState": "true", "fixedInternalStepSize": "0.001",
    }  # fmt: skip
    assert root.find("CoSimulation/SourceFiles") is None
    variables = [(v.tag, v.attrib) for v in root.find("ModelVariables")]  # type: ignore[union-attr]
    assert [int(a["valueReference"]) for _, a in variables] == list(range(8))
    rest = {a.pop("name"): (tag, {k: v for k, v in a.items() if k != "valueReference"}) for tag, a in variables}
    calculated, fed, own = (
        {"causality": "output", "initial": "calculated"},
        {"causality": "input"},
        {"causality": "parameter"},
    )
    smooth, leaps = {"variability": "continuous"}, {"variability": "discrete"}
    assert rest == {
        "time": ("Float64", {"causality": "independent", "variability": "continuous", "unit": "s"}),
        "n": ("Float64", {"description": "speed", **fed, **smooth, "unit": "%", "max": "120", "start": "61.5"}),
        "x": ("Float64", {"description": "stroke", **calculated, **smooth, "unit": "m", "displayUnit": "mm"}),
        "mode": ("Int32", {"description": "mode", **calculated, **leaps}),
        "count": ("Int32", {"description": "count", **fed, **leaps, "min": "0", "max": "1000000", "start": "0"}),
        "own": ("Boolean", {"description": "own", **own, "variability": "fixed", "start": "true"}),
        "off": ("Boolean", {"description": "off", **fed, **leaps, "start": "false"}),
        "kp": ("Float64", {
            "description": "gain", **own, "variability": "tunable", "unit": "mA/mm", "min": "0.25", "start": "1e+16"
        }),
    }  # fmt: skip
    structure = [(e.tag, e.attrib["valueReference"]) for e in root.find("ModelStructure")]  # type: ignore[union-attr]
    assert structure == [("Output", "2"), ("Output", "3"), ("InitialUnknown", "2"), ("InitialUnknown", "3")]
    units = root.find("UnitDefinitions")
    assert units is not None and [u.attrib["name"] for u in units] == ["s", "%", "m", "mA/mm"]
    (display,) = units.iter("DisplayUnit")
    assert display.attrib == {"name": "mm", "factor": "1000.0"}
    assert root.find("LogCategories/Category").attrib == {"name": "logStatusError"}  # type: ignore[union-attr]
    assert root.find("DefaultExperiment").attrib == {"startTime": "0", "stopTime": "60", "stepSize": "0.01"}  # type: ignore[union-attr]
    assert {k: description._SHOWN[k] for k in ("mA", "MPa", "deg")} == {
        "mA": 1e3,
        "MPa": 1e-6,
        "deg": math.degrees(1.0),
    }


def test_the_description_of_fmi_2() -> None:
    root = ET.fromstring(description.model_description("2.0", "A machine", "it", "{token}", DESCRIBED, "1.2"))
    assert (root.attrib["guid"], root.attrib["numberOfEventIndicators"]) == ("{token}", "0")
    part = root.find("CoSimulation")
    assert part is not None and part.attrib["canNotUseMemoryManagementFunctions"] == "true"
    assert [f.attrib["name"] for f in part.iter("File")] == list(description.SOURCES["2.0"])
    variables = root.find("ModelVariables")
    assert variables is not None
    assert [(v.attrib["name"], int(v.attrib["valueReference"]), v[0].tag) for v in variables] == [
        ("time", 0, "Real"), ("n", 1, "Real"), ("x", 2, "Real"), ("mode", 3, "Integer"), ("count", 4, "Integer"),
        ("own", 5, "Boolean"), ("off", 6, "Boolean"), ("kp", 7, "Real"),
    ]  # fmt: skip
    assert variables[0][0].attrib == {"unit": "s"} and variables[1][0].attrib["start"] == "61.5"
    # indices count from 1, and time is the first
    for what in ("Outputs", "InitialUnknowns"):
        assert [u.attrib["index"] for u in root.find(f"ModelStructure/{what}")] == ["3", "4"]  # type: ignore[union-attr]


def test_the_build_description_names_the_sources() -> None:
    data = description.build_description("it")
    assert data.startswith(b'<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">\n')
    root = ET.fromstring(data)
    assert root[0].attrib == {"modelIdentifier": "it"}
    (files,) = root.iter("SourceFileSet")
    assert files.attrib == {"language": "C99", "compilerOptions": description.OPTIONS}
    assert [f.attrib["name"] for f in files] == list(description.SOURCES["3.0"])
    assert [x.attrib["name"] for x in root.iter("Library")] == ["m"]


# ---- the archive -----------------------------------------------------------------------------------------------------


@pytest.fixture
def unbuilt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Exports without a compiler; what was asked of it."""
    asked: list[tuple[Any, ...]] = []
    monkeypatch.setattr(export, "part_source", lambda part, shape: f"/* {part} {tuple(shape)} */")
    monkeypatch.setattr(export, "part_object", lambda part, shape: tmp_path / f"{part}.o")
    monkeypatch.setattr(export.shutil, "which", lambda name: "/usr/bin/gcc")

    def build(words: list[str], out: str, folder: Path) -> None:
        asked.append((words, out, sorted(f.name for f in folder.iterdir())))
        (folder / out).write_bytes(b"binary")

    monkeypatch.setattr(export, "build", build)
    return asked


@pytest.mark.parametrize("version", ["3.0", "2.0"])
def test_the_archive_holds_description_binary_and_sources(
    version: str, tmp_path: Path, unbuilt: list[tuple[Any, ...]]
) -> None:
    out = tmp_path / "9 it-self.FMU"
    done = export.write_fmu(out, "loop", PLANT, CAL, TABLE, WORN, version)
    assert (done.path, done.version, done.part) == (str(out), version, "loop")
    where = f"{export.platform.machine()}-linux" if version == "3.0" else "linux64"
    with zipfile.ZipFile(out) as archive:
        held = {i.filename: i for i in archive.infolist()}
        assert all(
            i.date_time == (2020, 1, 1, 0, 0, 0) and i.compress_type == zipfile.ZIP_DEFLATED for i in held.values()
        )
        assert archive.read(f"binaries/{where}/m9_it_self.so") == b"binary"
        assert held[f"binaries/{where}/m9_it_self.so"].external_attr >> 16 == 0o755
        assert held["modelDescription.xml"].external_attr >> 16 == 0o644
        root = ET.fromstring(archive.read("modelDescription.xml"))
        head, body = source.model_source("loop", SHAPE, MEMORY, done.variables)
        assert archive.read("sources/model.c").decode() == body and archive.read("sources/model.h").decode() == head
        assert archive.read("sources/part.c").decode() == f"/* loop {tuple(SHAPE)} */"
        sources = {n.removeprefix("sources/") for n in held if n.startswith("sources/")}
        headers = {n for n in sources if n.startswith("fmi") and n.endswith(".h")}
        extra = {"buildDescription.xml"} if version == "3.0" else set()
        assert sources == {*description.SOURCES[version], "fmu.h", "model.h", *headers, *extra}
        assert len(headers) == 3 and all(n.startswith(f"fmi{version[0]}") for n in headers)
        assert all(len(archive.read(f"sources/{n}")) > 100 for n in headers)
    assert done.token in head and root.get("instantiationToken", root.get("guid")) == done.token
    assert root.get("modelName") == "VaneLoop loop" and "VaneLoop " in root.get("generationTool", "")
    start = next(v for v in done.variables if v.name == "plant.actuator.flow_gain").start
    assert start == 0.147 and [v.name for v in done.variables] == list(of("loop"))
    ((words, name, files),) = unbuilt
    own = [s for s in description.SOURCES[version] if s != "part.c"]
    assert words == ["-shared", *own, str(tmp_path / "loop.o"), "-lm"] and name == "fmu.so" and "fmu.h" in files
    first_bytes = out.read_bytes()
    export.write_fmu(out, "loop", PLANT, CAL, TABLE, WORN, version)
    assert out.read_bytes() == first_bytes  # the same machine gives the same bytes


def test_an_archive_that_cannot_be_written_is_refused(tmp_path: Path, unbuilt: list[tuple[Any, ...]]) -> None:
    with pytest.raises(InputError, match=r"cannot write .*x\.fmu: No such file or directory$"):
        export.write_fmu(tmp_path / "none" / "x.fmu", "plant", PLANT, CAL, TABLE)
    export.write_fmu(tmp_path / "_ok.fmu", "plant", PLANT, CAL, TABLE)
    with zipfile.ZipFile(tmp_path / "_ok.fmu") as archive:
        assert any(n.endswith("/_ok.so") for n in archive.namelist())


# ---- one function for all --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", PARTS)
def test_the_one_function_of_an_fmu_works_on_its_memory(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In Python in place of compiled code: which function is called, on which parts of the memory."""
    calls: list[tuple[Any, ...]] = []
    at = places_of(SHAPE)

    def view(m: np.ndarray, begin: int, shape: tuple[int, ...]) -> np.ndarray:
        return m[begin : begin + int(np.prod(shape))].reshape(shape)

    monkeypatch.setattr(kernel, "_view", view)
    monkeypatch.setattr(kernel, "inlined", lambda f: f)
    for name in ("plant_run", "controller_run", "loop_run", "_start", "_show", "_change"):
        monkeypatch.setattr(kernel, name, lambda *given, name=name: calls.append((name, *given)))
    monkeypatch.setattr(kernel.chain, "wake", lambda *given: calls.append(("wake", *given)))
    m = np.arange(float(len(MEMORY)))
    serve = kernel.entry(part, SHAPE)
    for what in (kernel.RUN, kernel.SHOW, kernel.START, kernel.WAKE, kernel.CHANGE):
        serve(m, what, 17)
    run, show, start, wake, change = calls
    assert [c[0] for c in calls] == [f"{part}_run", "_show", "_start", "wake", "_change"]

    def is_at(got: np.ndarray, name: str) -> None:
        place = at[name]
        assert got.shape == place.shape, name
        np.testing.assert_array_equal(got.ravel()[1:], np.arange(got.size)[1:] + place.at, err_msg=name)

    loop = run[1]
    for name, got in zip(
        ("inputs", "outputs", "z", "built_k", "built_table", "built_angles", "k", "table", "built_angles", "flash"),
        (*loop[:3], *loop[3][:3], *loop[4][:3], loop[5]), strict=True,
    ):  # fmt: skip
        is_at(got, name)
    for name in ("s", "p", "sigma", "mean", "angles", "sent"):
        is_at(getattr(loop, name), name)
    assert loop.foreign == ()
    is_at(run[3], "fed")
    is_at(run[4], "still")
    is_at(show[2], "fed")
    is_at(show[3], "shown")
    assert run[2].size == 4 and run[5] == 17 and np.shares_memory(run[2], m)
    assert m[at["clock"].at + NEXT] == (-source.WARM_UP if part == "loop" else 0.0)
    is_at(start[3], "fed")
    assert np.shares_memory(start[2], m) and wake[3] == 0
    is_at(wake[1], "s")
    is_at(wake[2], "p")
    outputs = m[at["outputs"].at : at["outputs"].at + at["outputs"].shape[0]]
    assert wake[4] == as_outputs(outputs).i_cmd > 0.0
    is_at(change[1].p, "p")


# ---- a plant of others -----------------------------------------------------------------------------------------------


def unit(name: str, **base: float) -> Any:
    given = {"factor": None, "offset": None, **base}
    return SimpleNamespace(name=name, baseUnit=SimpleNamespace(**given) if base else None)


def variable(name: str, causality: str, reference: int, unit: str | None = None, **more: Any) -> Any:
    given = {"type": "Float64", "dimensions": [], "declaredType": None, **more}
    return SimpleNamespace(name=name, causality=causality, valueReference=reference, unit=unit, **given)


VANES = ("vigv", "vgv1")


def described(*others: Any, version: str = "3.0", drop: tuple[str, ...] = ()) -> Any:
    own = [
        variable("i_cmd", "input", 1, "mA"), variable("p_s", "input", 2, "MPa"), variable("t_oil", "input", 3, "K"),
        variable("x_lvdt", "output", 11, "mm"), variable("vigv", "output", 12, "deg"), variable("vgv1", "output", 13),
        variable("n_engine", "output", 14, "share"),
    ]  # fmt: skip
    names = {v.name for v in others}
    return SimpleNamespace(
        fmiVersion=version, guid="{g}", coSimulation=SimpleNamespace(modelIdentifier="it"),
        modelVariables=[*(v for v in own if v.name not in (*names, *drop)), *others],
        unitDefinitions=[
            unit("K", K=1), unit("share", factor=1.0), unit("deg", rad=1, factor=math.pi / 180), unit("none")
        ],
    )  # fmt: skip


class Failure(Exception):
    """The FMU's own refusal."""


class Slave:
    """An FMU in Python: its outputs follow from its inputs, and it keeps what is asked of it."""

    def __init__(self, **given: Any) -> None:
        self.asked: list[Any] = [given]
        self.inputs: dict[int, float] = {}
        self.fail: Exception | None = None

    def set(self, references: list[int], values: list[float]) -> None:
        self.inputs.update(zip(references, values, strict=True))

    setFloat64 = setReal = set

    def get(self, references: list[int]) -> list[float]:
        values = {11: 24.0 + self.inputs[1], 12: 30.0, 13: 0.25, 14: 0.6}
        return [values[r] for r in references]

    getFloat64 = getReal = get

    def instantiate(self) -> None:
        self.asked.append("instantiate")

    def enterInitializationMode(self, **given: float) -> None:
        self.asked.append(("enter", given))

    def setupExperiment(self, **given: float) -> None:
        self.asked.append(("setup", given))

    def exitInitializationMode(self) -> None:
        self.asked.append("exit")

    def doStep(self, **given: float) -> None:
        if self.fail:
            raise self.fail
        self.asked.append(given)


class OldSlave(Slave):
    """The same of FMI 2.0."""


def fmpy(said: Any, platforms: tuple[str, ...] = ("x86_64-linux", "c-code")) -> Any:
    return SimpleNamespace(
        fmi1=SimpleNamespace(FMICallException=Failure), fmi2=SimpleNamespace(FMU2Slave=OldSlave),
        fmi3=SimpleNamespace(FMU3Slave=Slave), platform="linux64", platform_tuple="x86_64-linux",
        read_model_description=lambda path, validate: said, supported_platforms=lambda path: list(platforms),
        extract=lambda path, folder: (Path(folder) / "its path").write_text(path),
    )  # fmt: skip


@pytest.fixture
def archive(tmp_path: Path) -> str:
    return packed(tmp_path, '<fmiModelDescription fmiVersion="3.0"><CoSimulation/></fmiModelDescription>')


def packed(folder: Path, xml: str) -> str:
    with zipfile.ZipFile(folder / "theirs.fmu", "w") as out:
        out.writestr("modelDescription.xml", xml)
    return str(folder / "theirs.fmu")


def plant_of(monkeypatch: pytest.MonkeyPatch, path: str, said: Any, mapping: Any = None, **more: Any) -> Any:
    monkeypatch.setattr(plant_fmu, "_fmpy", lambda path: fmpy(said, **more))
    return PlantFmu(path, VANES, mapping, n_r=62.0, p_s=20e6, t_oil=50.0)


@pytest.mark.parametrize("version", ["3.0", "2.0"])
def test_signals_go_in_and_out_in_the_plants_own_units(
    version: str, archive: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    fmu = plant_of(monkeypatch, archive, described(version=version))
    its = fmu._fmu
    assert type(its) is (Slave if version == "3.0" else OldSlave)
    start = {"startTime": 0.0}
    entered = [("enter", start)] if version == "3.0" else [("setup", start), ("enter", {})]
    assert its.asked[1:] == ["instantiate", *entered, "exit"]
    given = its.asked[0]
    assert (given["guid"], given["modelIdentifier"], given["instanceName"]) == ("{g}", "it", "plant")
    assert (Path(given["unzipDirectory"]) / "its path").read_text() == archive
    assert its.inputs == pytest.approx({1: 0.0, 2: 20.0, 3: 323.15})
    assert fmu.notes == [f"{archive}: vgv1 has no unit; taken as rad"]
    assert fmu.outputs() == pytest.approx({"x_lvdt": 24e-3, "n_engine": 60.0, "vigv": math.pi / 6, "vgv1": 0.25})
    signals = {"i_cmd": 0.010, "n_dem": 1.0, "n_r": 2.0, "p_s": 19e6, "t_oil": 0.0}
    assert fmu.step(signals)["x_lvdt"] == pytest.approx(34e-3)
    assert its.inputs == pytest.approx({1: 10.0, 2: 19.0, 3: 273.15})
    fmu.step(signals)
    assert its.asked[-2:] == [
        {"currentCommunicationPoint": pytest.approx(t), "communicationStepSize": pytest.approx(1e-3)}
        for t in (0.0, 1e-3)
    ]
    its.fail = Failure("it broke\n  badly")
    with pytest.raises(InputError, match=r"theirs\.fmu: failed at t = 0\.002 s \(it broke badly\)$"):
        fmu.step(signals)
    its.get = its.getFloat64 = fmu._read = lambda references: [math.nan] * len(references)
    with pytest.raises(InputError, match=r"x_lvdt \(=nan\) at t = 0\.002 s must be finite"):
        fmu.outputs()


def test_what_was_unpacked_goes_with_the_plant(archive: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fmu = plant_of(monkeypatch, archive, described())
    folder = Path(fmu._fmu.asked[0]["unzipDirectory"])
    assert folder.is_dir()
    fmu = PlantFmu(archive, VANES)
    assert not folder.exists() and fmu._fmu.inputs == pytest.approx({1: 0.0, 2: 21.0, 3: 313.15})  # the usual supply
    folder = Path(fmu._fmu.asked[0]["unzipDirectory"])
    del fmu
    gc.collect()
    assert not folder.exists()


def test_names_are_joined_by_the_map(archive: str, monkeypatch: pytest.MonkeyPatch) -> None:
    said = described(variable("piston", "output", 21, "m"), variable("speed", "input", 22, "%"), drop=("x_lvdt",))
    fmu = plant_of(monkeypatch, archive, said, {"piston": "x_lvdt", "speed": "n_r"})
    assert [(v.signal, v.reference) for v in fmu._outputs] == [
        ("x_lvdt", 21),
        ("n_engine", 14),
        ("vigv", 12),
        ("vgv1", 13),
    ]
    assert [(v.signal, v.reference, v.factor, v.offset) for v in fmu._inputs if v.signal == "n_r"] == [
        ("n_r", 22, 1.0, 0.0)
    ]
    assert fmu._fmu.inputs[22] == 62.0


@pytest.mark.parametrize(
    ("said", "mapping", "line"),
    [
        (described(drop=("i_cmd",)), None, r"has no input 'i_cmd'.*; it has: p_s, t_oil; --plant-map NAME=i_cmd "),
        (described(drop=("vgv1",)), None, r"has no output 'vgv1'"),
        (described(), {"speed": "n_dem"}, r"has no input 'speed'"),  # named, so it must be there
        (described(), {"x": "nothing"}, r"--plant-map: 'nothing' is no signal of a plant; allowed: i_cmd, "),
        (described(variable("p_s", "input", 2, "MPa", type="Int32")), None, r"p_s \(type Int32\) must be a scalar"),
        (described(variable("p_s", "input", 2, "MPa", dimensions=[3])), None, r"must be a scalar Real or Float64"),
        (described(variable("p_s", "input", 2, "mm")), None, r"p_s: unit \(='mm'\) must be one that turns into Pa"),
        (described(variable("p_s", "input", 2, "furlong per joke")), None, r"unit 'furlong per joke' is not known"),
    ],
)  # fmt: skip
def test_a_plant_whose_variables_do_not_fit_is_refused(
    said: Any, mapping: Any, line: str, archive: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=line):
        plant_of(monkeypatch, archive, said, mapping)


def test_a_unit_may_stand_in_the_declared_type(archive: str, monkeypatch: pytest.MonkeyPatch) -> None:
    typed = variable("p_s", "input", 2, None, type="Real", declaredType=SimpleNamespace(unit="kPa"))
    fmu = plant_of(monkeypatch, archive, described(typed))
    assert fmu._fmu.inputs[2] == pytest.approx(20e3) and len(fmu.notes) == 1


def test_what_cannot_be_run_here_is_refused(tmp_path: Path, archive: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"has binaries for win64; this machine \(.*\) needs x86_64-linux$"):
        plant_of(monkeypatch, archive, described(), platforms=("win64", "c-code"))
    with pytest.raises(InputError, match=r"has binaries for none; .* needs x86_64-linux$"):
        plant_of(monkeypatch, archive, described(), platforms=("c-code",))
    plant_of(monkeypatch, archive, described(), platforms=("linux64",))
    old = packed(tmp_path, '<m fmiVersion="2.0"><CoSimulation/></m>')
    with pytest.raises(InputError, match=r"needs linux64$"):
        plant_of(monkeypatch, old, described(version="2.0"), platforms=())
    for xml, line in (
        ('<m fmiVersion="1.0"/>', r"FMI version \(=1\.0\) must be 2\.0 or 3\.0"),
        ("<m/>", r"FMI version \(=\) must be"),
        ('<m fmiVersion="3.0"><ModelExchange/></m>', "is for model exchange only"),
        ("<m", r"is no FMU that can be read \("),
    ):
        with pytest.raises(InputError, match=line):
            plant_of(monkeypatch, packed(tmp_path, xml), described())
    with pytest.raises(InputError, match=r"none\.fmu: is not there"):
        plant_of(monkeypatch, str(tmp_path / "none.fmu"), described())


def test_an_fmu_that_does_not_start_says_why_in_one_line(archive: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(self: Slave) -> None:
        raise Failure("a  b\n" + "c" * 300)

    monkeypatch.setattr(Slave, "instantiate", fails)
    with pytest.raises(InputError, match=r"cannot be started \(a b c{196}\)$"):
        plant_of(monkeypatch, archive, described())
    assert plant_fmu._line(Failure("")) == "Failure"


def test_without_fmpy_the_extra_is_named(archive: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "is_there", lambda module: False)
    with pytest.raises(InputError, match=r"theirs\.fmu: an FMU needs fmpy, .* pip install 'vaneloop\[fmu\]'"):
        PlantFmu(archive, VANES)


def test_the_node_reads_its_sensors_from_the_fmu() -> None:
    asked: list[dict[str, float]] = []

    class Fmu:
        def outputs(self) -> dict[str, float]:
            return {"x_lvdt": 0.030, "n_engine": 77.0} | {v: 0.1 + k for k, v in enumerate(PLANT.vanes)}

        def step(self, signals: dict[str, float]) -> dict[str, float]:
            asked.append(dict(signals))
            return {"x_lvdt": 0.031} | dict.fromkeys(PLANT.vanes, 0.5)

    node = PlantNode(Fmu(), PLANT, CAL, n_r=60.0)  # type: ignore[arg-type]
    s = node.loop.s
    assert isinstance(node, Node) and node.stride == 1 and node.loop.p[LVDT_STEP, 0] == 0.0
    assert [s[q, 0] for q in (places.X, places.X_LVDT, places.READING, places.N_R)] == [0.030, 0.030, 0.030, 77.0]
    assert [s[places.POT + k, 0] for k in range(len(PLANT.vanes))] == [0.1 + k for k in range(len(PLANT.vanes))]
    still = SimpleNamespace(outputs=lambda: dict.fromkeys(("x_lvdt", *PLANT.vanes), 0.02))
    assert PlantNode(still, PLANT, CAL).loop.s[places.N_R, 0] == 60.0  # type: ignore[arg-type]
    node.loop.given.i_cmd = 0.012
    node.arrays.supply[:] = 19e6, 55.0, 70.0, 71.0
    node.moved()
    assert asked == [{"i_cmd": 0.012, "n_dem": 70.0, "n_r": 71.0, "p_s": 19e6, "t_oil": 55.0}]
    assert [s[q, 0] for q in (places.X, places.READING, places.POT, places.N_R)] == [0.031, 0.031, 0.5, 77.0]
