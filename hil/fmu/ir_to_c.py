"""C99 from the LLVM IR of compiled functions: the same operations on the same numbers in the same order.

For functions as `hil.fmu.kernel` has them: no allocation, no vectors, scalars of double, i64, i32, i8, i1 and pointers.
Each value is a variable, each block a label; a value that comes from several blocks (phi) is handed over in a second
variable. Pointers are whole numbers, so that what LLVM does with addresses has a meaning in C. Arithmetic of whole
numbers wraps, as it does there. What is not known raises NotImplementedError with the line.

The text is that of LLVM 20 (llvmlite 0.50): https://llvm.org/docs/LangRef.html
"""

from __future__ import annotations

import contextlib
import math
import re
import struct
from collections.abc import Iterator

__all__ = ["translate"]


class _Types(dict[str, str]):
    """Types in C. An integer of another width, which the optimiser makes to mask one of 64 bits (trunc, then zext), is
    kept in 64 bits without sign; nothing else is done with it.
    """

    def __missing__(self, kind: str) -> str:
        if _bits(kind):
            return "uint64_t"
        raise KeyError(kind)


def _bits(kind: str) -> int:
    """Width of an integer that C does not have; 0: it has it, or this is none."""
    known = kind in ("i1", "i8", "i32", "i64")
    return int(kind[1:]) if not known and re.fullmatch(r"i[1-9]\d?", kind) and int(kind[1:]) < 64 else 0


_C = _Types({"double": "double", "i64": "int64_t", "i32": "int32_t", "i8": "int8_t", "i1": "int", "ptr": "uintptr_t"})
_SIZE = {"double": 8, "i64": 8, "i32": 4, "i8": 1, "ptr": 8}
_UNSIGNED = {"i64": "uint64_t", "i32": "uint32_t", "i8": "uint8_t", "i1": "unsigned"}
_FLOAT = {"fadd": "+", "fsub": "-", "fmul": "*", "fdiv": "/"}
_AS_UNSIGNED = {"add": "+", "sub": "-", "mul": "*", "shl": "<<", "and": "&", "or": "|", "xor": "^", "lshr": ">>"}
_AS_UNSIGNED |= {"udiv": "/", "urem": "%"}
_AS_SIGNED = {"sdiv": "/", "srem": "%", "ashr": ">>"}
_ORDER = {"lt": "<", "gt": ">", "le": "<=", "ge": ">="}
_OPPOSITE = {"lt": ">=", "gt": "<=", "le": ">", "ge": "<"}
_FLAGS = re.compile(r"\b(nuw|nsw|exact|disjoint|nneg|samesign|inbounds|tail|musttail|notail|volatile)\b ")
_NAME = r'(?:"[^"]*"|[\w.$-]+)'
_MATHS = {"fabs", "floor", "ceil", "trunc", "rint", "sqrt", "sin", "cos", "tan", "exp", "log", "pow", "copysign"}
_MATHS |= {
    "atan2",
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "tanh",
    "log10",
    "exp2",
    "log2",
    "fmod",
    "hypot",
    "round",
    "expm1",
}
_CHOICES = {"smin": "<", "smax": ">", "umin": "<", "umax": ">"}
HEAD = """#include <math.h>
#include <stdint.h>
#include <string.h>

static inline double ld_double(uintptr_t p) { double v; memcpy(&v, (const void *)p, sizeof v); return v; }
static inline int64_t ld_i64(uintptr_t p) { int64_t v; memcpy(&v, (const void *)p, sizeof v); return v; }
static inline int32_t ld_i32(uintptr_t p) { int32_t v; memcpy(&v, (const void *)p, sizeof v); return v; }
static inline uintptr_t ld_ptr(uintptr_t p) { uintptr_t v; memcpy(&v, (const void *)p, sizeof v); return v; }
static inline void st_double(uintptr_t p, double v) { memcpy((void *)p, &v, sizeof v); }
static inline void st_i64(uintptr_t p, int64_t v) { memcpy((void *)p, &v, sizeof v); }
static inline void st_i32(uintptr_t p, int32_t v) { memcpy((void *)p, &v, sizeof v); }
static inline void st_ptr(uintptr_t p, uintptr_t v) { memcpy((void *)p, &v, sizeof v); }
static inline double as_double(int64_t b) { double v; memcpy(&v, &b, sizeof v); return v; }
static inline int64_t as_i64(double d) { int64_t v; memcpy(&v, &d, sizeof v); return v; }
"""


def translate(ir: str, entry: str, name: str) -> str:
    """Return C99 source with the function ``entry`` of the module ``ir`` as ``name``, and all that it calls.

    The arguments of ``entry`` stay as they are: numba puts a place for the answer and one for an error before them, and
    it returns 0 where all is well.
    """
    bodies = {
        m[2].strip('"'): m
        for m in re.finditer(rf"^define ([^@\n]*)@({_NAME})\((.*)\)[^\n]*\{{\n((?s:.)*?)^\}}", ir, re.M)
    }
    names: dict[str, str] = {}
    waiting, texts, used = [entry], [], set()
    names[entry] = name
    while waiting:
        found = bodies[waiting.pop(0)]
        function = _Function(found, bodies, names)
        texts.append(function.text())
        waiting += function.calls
        used |= function.globals
    heads = [t[: t.index("{")].strip() + ";" for t in texts]
    constants = [_constant(ir, g) for g in sorted(used)]
    return "\n".join([HEAD, *constants, *heads, "", *texts])


@contextlib.contextmanager
def _known(line: str) -> Iterator[None]:
    """Raise NotImplementedError with the line where a type, an operand or a constant in it is not as expected."""
    try:
        yield
    except (LookupError, ValueError, struct.error) as e:
        raise NotImplementedError(line) from e


def _identifier(name: str) -> str:
    return "g_" + re.sub(r"\W", "_", name.strip('"'))


def _constant(ir: str, name: str) -> str:
    """A global array of bytes as whole numbers of 8 bytes, which every byte order reads; what only describes an error
    as nothing.
    """
    found = re.search(rf"^@{re.escape(name)} = .*?constant \[(\d+) x i8\] (c\"(.*)\"|zeroinitializer)", ir, re.M)
    if found is None or "pickle" in name:
        return f"static const uint64_t {_identifier(name)}[1] = {{0}};"
    data = b"\0" * int(found[1])
    if found[3] is not None:
        text = re.sub(r"\\([0-9A-Fa-f]{2})", lambda m: chr(int(m[1], 16)), found[3].replace("\\\\", "\\5C"))
        data = text.encode("latin-1")
    with _known(found[0]):
        words = struct.unpack(f"<{len(data) // 8}Q", data)
    return f"static const uint64_t {_identifier(name)}[] = {{{', '.join(f'{w:#x}u' for w in words)}}};"


def _split(text: str) -> list[str]:
    """Arguments between commas, not those within brackets."""
    out, depth, now = [], 0, ""
    for c in text:
        depth += (c in "([{<") - (c in ")]}>")
        if c == "," and depth == 0:
            out.append(now.strip())
            now = ""
        else:
            now += c
    return [*out, now.strip()] if now.strip() else out


class _Function:
    """One function on its way into C."""

    def __init__(self, found: re.Match[str], bodies: dict[str, re.Match[str]], names: dict[str, str]):
        self.bodies, self.names = bodies, names
        self.globals: set[str] = set()
        self.calls: list[str] = []
        self.returned = found[1].split()[-1]
        self.name = names[found[2].strip('"')]
        self.static = "static " if self.name.startswith("part_") else ""
        self.variables: dict[str, str] = {}
        self.types: dict[str, str] = {}
        self.labels: dict[str, str] = {}
        self.arguments = []
        for a in _split(found[3]):
            kind, value = a.split()[0], a.split()[-1]
            with _known(a):
                self.arguments.append(f"{_C[kind]} {self._variable(value, kind, declare=False)}")
        self.blocks = self._blocks(found[4])

    def _blocks(self, body: str) -> dict[str, list[str]]:
        """Lines of each block without comments and notes; a switch in one line."""
        out: dict[str, list[str]] = {}
        now: list[str] = []
        joined = re.sub(r"\[\n((?:\s+i\d+ .*\n)+)\s*\]", lambda m: "[" + m[1].replace("\n", ";") + "]", body)
        for line in joined.split("\n"):
            line = re.sub(r"(?:\s+#\d+|, ![\w.]+ !\d+)*(?:\s+;.*)?$", "", line.rstrip())
            if label := re.fullmatch(rf"({_NAME}):", line):
                now = out.setdefault(label[1], [])
            elif line.strip():
                if not out:
                    now = out.setdefault("", [])
                now.append(line.strip())
        return out

    def _variable(self, name: str, kind: str = "", declare: bool = True) -> str:
        if name not in self.variables:
            self.variables[name] = f"v{len(self.variables)}"
        if kind and declare:
            self.types[self.variables[name]] = _C[kind]
        return self.variables[name]

    def _label(self, name: str) -> str:
        return self.labels.setdefault(name.lstrip("%"), f"L{len(self.labels)}")

    def _value(self, text: str, kind: str) -> str:
        """A value in C: a variable, a global's address, a constant."""
        text = text.strip()
        if text.startswith("%"):
            return self._variable(text)
        if text.startswith("@"):
            self.globals.add(text[1:])
            return f"(uintptr_t){_identifier(text[1:])}"
        if "getelementptr" in text:
            m = re.fullmatch(rf"getelementptr (?:inbounds )?(?:nuw )?\(i8, ptr (@{_NAME}), i64 (-?\d+)\)", text)
            if m is None:
                raise NotImplementedError(text)
            return f"({self._value(m[1], 'ptr')} + {m[2]})"
        if text in ("null", "undef", "poison", "zeroinitializer"):
            return "0"
        if text in ("true", "false"):
            return "1" if text == "true" else "0"
        if kind == "double":
            bits = int(text, 16) if text.startswith("0x") else 0
            v = struct.unpack("<d", struct.pack("<Q", bits))[0] if text.startswith("0x") else float(text)
            if not math.isfinite(v):
                sign, rest = bits >> 63, bits & ~(1 << 63)
                return f"(-as_double({rest:#x}))" if sign else f"as_double({rest:#x})"
            return f"({v.hex()})" if v < 0 or str(v)[0] == "-" else v.hex()
        if kind == "i64" and int(text) == -(1 << 63):
            return "INT64_MIN"
        return f"INT64_C({text})" if kind == "i64" else text

    def text(self) -> str:
        lines: list[str] = []
        for label, block in self.blocks.items():
            if lines or label:
                lines.append(f"{self._label(label)}:;")
            phis = [line for line in block if re.search(r"= phi ", line)]
            for line in phis:
                with _known(line):
                    v = self._variable(line.split(" = ")[0], line.split(" = phi ")[1].split()[0])
                self.types[f"{v}_in"] = self.types[v]
                lines.append(f"{v} = {v}_in;")
            for line in block:
                if line not in phis:
                    with _known(line):
                        lines += self._lines(line, label)
        variables = [f"    {kind} {v};" for v, kind in self.types.items()]
        with _known(f"define {self.returned}"):
            head = f"{self.static}{_C[self.returned]} {self.name}({', '.join(self.arguments)}) {{"
        return "\n".join([head, *variables, *(f"    {x}" for x in lines), "}", ""])

    def _edge(self, here: str, there: str) -> Iterator[str]:
        """Hand over the values that the block ``there`` takes from ``here``."""
        for line in self.blocks[there.lstrip("%")]:
            m = re.fullmatch(rf"(%{_NAME}) = phi (\w+) (.*)", line)
            if m is None:
                continue
            for value, source in re.findall(rf"\[ (.*?), %({_NAME}) \]", m[3]):
                if source == here or (here == "" and source not in self.blocks):
                    yield f"{self._variable(m[1], m[2])}_in = {self._value(value, m[2])};"

    def _lines(self, line: str, here: str) -> Iterator[str]:
        line = _FLAGS.sub("", line)
        line = re.sub(r", align \d+$", "", line)
        target, rest = line.split(" = ", 1) if re.match(rf"%{_NAME} = ", line) else ("", line)
        op, _, args = rest.partition(" ")
        if op == "br":
            yield from self._branch(args, here)
        elif op == "switch":
            yield from self._switch(args, here)
        elif op == "ret":
            kind, value = args.split(" ", 1)
            yield f"return {self._value(value, kind)};"
        elif op == "unreachable":
            yield "return 1;"
        elif op == "store":
            (kind, value), (_, place) = (a.split(" ", 1) for a in _split(args))
            _at_address(kind, line)
            yield f"st_{kind}({self._value(place, 'ptr')}, {self._value(value, kind)});"
        elif op == "call":
            yield self._call(target, args)
        elif op == "alloca":
            self.types[f"{self._variable(target, 'ptr')}_of[{_words(args)}]"] = "uint64_t"
            v = self._variable(target)
            yield f"{v} = (uintptr_t){v}_of;"
        else:
            kind, text = self._operation(op, args, line)
            yield f"{self._variable(target, kind)} = {text};"

    def _branch(self, args: str, here: str) -> Iterator[str]:
        m = re.fullmatch(rf"i1 (.*?), label (%{_NAME}), label (%{_NAME})", args)
        if m is None:
            there = args.removeprefix("label ")
            yield from self._edge(here, there)
            yield f"goto {self._label(there)};"
            return
        for there in {m[2]: 0, m[3]: 0}:
            yield from self._edge(here, there)
        yield f"if ({self._value(m[1], 'i1')}) goto {self._label(m[2])}; else goto {self._label(m[3])};"

    def _switch(self, args: str, here: str) -> Iterator[str]:
        m = re.fullmatch(rf"(i\d+) (\S+), label (%{_NAME}) \[(.*)\]", args)
        if m is None:
            raise NotImplementedError(args)
        cases = re.findall(rf"i\d+ (-?\d+), label (%{_NAME})", m[4])
        for there in {m[3]: 0, **{c[1]: 0 for c in cases}}:
            yield from self._edge(here, there)
        for value, there in cases:
            yield f"if ({self._value(m[2], m[1])} == {value}) goto {self._label(there)};"
        yield f"goto {self._label(m[3])};"

    def _call(self, target: str, args: str) -> str:
        m = re.match(rf"(.*?)(\w+) @({_NAME})\((.*)\)", args)
        if m is None:
            raise NotImplementedError(args)
        kind, name, given = m[2], m[3].strip('"'), _split(m[4])
        kinds = [a.split()[0] for a in given]
        values = [
            self._value(a.split()[-1] if "getelementptr" not in a else a.split(" ", 1)[1], k)
            for a, k in zip(given, kinds, strict=True)
        ]
        if name.startswith("llvm."):
            short = name.split(".")[1]
            if short in ("memcpy", "memmove", "memset"):
                first = f"(const void *)({values[1]})" if short != "memset" else values[1]
                return f"{short}((void *)({values[0]}), {first}, (size_t){values[2]});"
            if short in _CHOICES:
                c = _UNSIGNED if short[0] == "u" else _C
                a, b = (f"({c[kind]}){v}" for v in values)
                return f"{self._variable(target, kind)} = {a} {_CHOICES[short]} {b} ? {values[0]} : {values[1]};"
            if short in ("lifetime", "assume", "experimental"):
                return ""
            name = short
        if name in self.bodies:
            if name not in self.names:
                self.names[name] = f"part_{len(self.names)}"
                self.calls.append(name)
            call = f"{self.names[name]}({', '.join(values)})"
        elif name in _MATHS:
            call = f"{name}({', '.join(values)})"
        else:
            raise NotImplementedError(f"{name}: no function that C has")
        return f"{self._variable(target, kind)} = {call};" if target else f"{call};"

    def _operation(self, op: str, args: str, line: str) -> tuple[str, str]:
        """Type and C text of an operation."""
        if op in ("fcmp", "icmp"):
            how, kind, pair = args.split(" ", 2)
            a, b = (self._value(v, kind) for v in _split(pair))
            return "i1", _compared(op, how, kind, a, b)
        if op == "getelementptr":
            of, base, *index = _split(args)
            if len(index) != 1 or of not in _SIZE:
                raise NotImplementedError(line)
            kind, value = index[0].split(" ", 1)
            size = f" * {_SIZE[of]}" if _SIZE[of] != 1 else ""
            return "ptr", f"{self._value(base.split(' ', 1)[1], 'ptr')} + (uintptr_t){self._value(value, kind)}{size}"
        if op == "load":
            kind, place = _split(args)
            _at_address(kind, line)
            return kind, f"ld_{kind}({self._value(place.split(' ', 1)[1], 'ptr')})"
        if op == "select":
            condition, a, b = _split(args)
            kind = a.split()[0]
            x, y = (self._value(v.split(" ", 1)[1], kind) for v in (a, b))
            return kind, f"{self._value(condition.split(' ', 1)[1], 'i1')} ? {x} : {y}"
        if m := re.fullmatch(r"(\w+) (.+) to (\w+)", args):
            return m[3], _converted(op, m[1], m[3], self._value(m[2], m[1]), line)
        kind, pair = args.split(" ", 1)
        values = [self._value(v, kind) for v in _split(pair)]
        if op == "fneg":
            return kind, f"-{values[0]}"
        if op == "freeze":
            return kind, values[0]
        a, b = values
        if op in _FLOAT:
            return kind, f"{a} {_FLOAT[op]} {b}"
        if op in _AS_UNSIGNED:
            u = _UNSIGNED[kind]
            whole = f"({_C[kind]})(({u}){a} {_AS_UNSIGNED[op]} ({u}){b})"
            return kind, f"({whole}) & 1" if kind == "i1" else whole
        if op in _AS_SIGNED and kind != "i1":
            return kind, f"{a} {_AS_SIGNED[op]} {b}"
        raise NotImplementedError(line)


def _at_address(kind: str, line: str) -> None:
    """Raise NotImplementedError where no value of this type is read or written at an address."""
    if f" ld_{kind}(" not in HEAD:
        raise NotImplementedError(line)


def _words(kind: str) -> int:
    """Places of 8 bytes that a type takes at most: each of its numbers has one."""
    if m := re.fullmatch(r"\[(\d+) x (.+)\]", kind):
        return int(m[1]) * _words(m[2])
    if m := re.fullmatch(r"\{ (.+) \}", kind):
        return sum(map(_words, _split(m[1])))
    return -(-_SIZE[kind] // 8)


def _compared(op: str, how: str, kind: str, a: str, b: str) -> str:
    if op == "icmp":
        if how in ("eq", "ne"):
            return f"{a} {'==' if how == 'eq' else '!='} {b}"
        if kind != "ptr" and kind not in _UNSIGNED:
            raise ValueError(f"{kind} has no order")
        c = (_UNSIGNED if how[0] == "u" else _C).get(kind, "uintptr_t")
        return f"({c}){a} {_ORDER[how[1:]]} ({c}){b}"
    if how in ("ord", "uno"):
        same = f"{a} == {a} && {b} == {b}"
        return same if how == "ord" else f"!({same})"
    if how[1:] == "eq":
        return f"{a} == {b}" if how[0] == "o" else f"!({a} < {b} || {a} > {b})"
    if how[1:] == "ne":
        return f"{a} != {b}" if how[0] == "u" else f"{a} < {b} || {a} > {b}"
    return f"{a} {_ORDER[how[1:]]} {b}" if how[0] == "o" else f"!({a} {_OPPOSITE[how[1:]]} {b})"


def _converted(op: str, of: str, to: str, value: str, line: str) -> str:
    if _bits(to) and op == "trunc":
        return f"(uint64_t){value} & UINT64_C({(1 << _bits(to)) - 1})"
    if _bits(of) and op == "zext":
        return f"({_C[to]}){value}"
    if _bits(of) or _bits(to):
        raise NotImplementedError(line)
    if op == "zext":
        return f"({_C[to]})({_UNSIGNED[of]}){value}"
    if op == "sext" and of == "i1":
        return f"-({_C[to]}){value}"
    if op == "uitofp":
        return f"(double)({_UNSIGNED[of]}){value}"
    if op == "trunc" and to == "i1":
        return f"(int)({value} & 1)"
    if op == "bitcast":
        return f"as_{to}({value})"
    if op in ("sext", "trunc", "sitofp", "fptosi", "inttoptr", "ptrtoint"):
        return f"({_C[to]}){value}"
    raise NotImplementedError(line)
