"""What numba need not do while it compiles: the same machine code in less than half the processor time.

All of this is inside numba, of the releases in `KNOWN`. Another release compiles as it comes, only longer.
"""

from __future__ import annotations

import gc
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core import codegen, compiler, errors, event, ir, sigutils, types
from numba.core.annotations import type_annotations
from numba.core.compiler_lock import global_compiler_lock

__all__ = ["KNOWN", "called_by_code", "is_known"]

KNOWN = ("0.68.",)
_DEFAULTS = {name: option.default for name, option in compiler.Flags.options.items()}
_unliteral: Any = types.unliteral  # what has no types
_signature: Any = sigutils.normalize_signature


def is_known() -> bool:
    """Whether this is a numba whose inside is the one that is changed here."""
    return numba.__version__.startswith(KNOWN)


class _Calls:
    """Calls of one compiled function, by compiled code and by Python.

    What compiled code calls gets no entry for Python, which takes a tenth of the time that compiling takes. Where
    Python calls it after all, it is compiled once more, with one.
    """

    def __init__(self, dispatcher: Any) -> None:
        self.of, self.within = dispatcher, False
        self.template, self.compile, self.add = (
            dispatcher.get_call_template, dispatcher.compile, dispatcher.add_overload
        )  # fmt: skip
        dispatcher.get_call_template, dispatcher.compile, dispatcher.add_overload = (
            self.call_by_code, self.compile_as_called, self.add_with_entry
        )  # fmt: skip
        dispatcher._compiler._customize_flags = self.flags

    def call_by_code(self, args: Any, kws: Any) -> Any:
        """What the compiler asks for when it meets a call.

        A constant argument is a type of its own to numba, and each fault's timer a function. Inlined code needs none of
        it: LLVM knows the constant there.
        """
        if self.of.targetoptions.get("forceinline"):
            args = tuple(_unliteral(a) for a in args)
            kws = {name: _unliteral(a) for name, a in kws.items()}
        before, self.within = self.within, True
        try:
            return self.template(args, kws)
        finally:
            self.within = before

    def compile_as_called(self, sig: Any) -> Any:
        """Compile a signature, with an entry for Python where Python calls."""
        with global_compiler_lock:
            args = tuple(_signature(sig)[0])
            there = self.of.overloads.get(args)
            if there is not None and not self.within and not _has_entry(there):
                del self.of.overloads[args]
            self.of._cache.inner = self.within
            return self.compile(sig)

    def flags(self, flags: Any) -> Any:
        """Options of a compilation that begins."""
        if self.within:
            flags.no_cpython_wrapper = True
        return flags

    def add_with_entry(self, compiled: Any) -> None:
        """Let Python know of a compiled signature if it has an entry."""
        if _has_entry(compiled):
            self.add(compiled)
        else:
            self.of.overloads[tuple(compiled.signature.args)] = compiled


def _has_entry(compiled: Any) -> bool:
    return compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cpython_wrapper_name) != 0


def called_by_code(dispatcher: Any) -> Any:
    """Compile a function without an entry for Python as long as only compiled code calls it; return it."""
    if is_known() and hasattr(dispatcher, "py_func"):  # compiling may be switched off
        _Calls(dispatcher)
    return dispatcher


def _given(flags: Any) -> dict[str, Any]:
    return {name: v for name, v in flags._values.items() if v != _DEFAULTS[name]}


def _same_flags(self: Any, other: Any) -> Any:
    """Whether two sets of options say the same. numba compares all sixty, at each look-up of what is compiled."""
    if type(other) is not compiler.Flags:
        return NotImplemented
    return self._values == other._values or _given(self) == _given(other)


def _hash_of_flags(self: Any) -> int:
    """Of those options in which functions of this program differ."""
    return hash((self.nrt, self.forceinline, self.release_gil, self.no_cpython_wrapper))


def _optimise_functions(self: Any, module: Any) -> None:
    """Optimise each function of a module. numba does so with those, too, that are only declared in it: most."""
    module.data_layout = self._codegen._data_layout
    for function in module.functions:
        if not function.is_declaration:
            passes, builder = self._codegen._function_pass_manager()
            with self._recorded_timings.record(f"Function passes on {function.name!r}", builder):
                passes.run(function, builder)


def _remembering(find: Any) -> Any:
    """``get_call_type`` of a function of numbers, such as an addition: found once for each types of arguments.

    numba tries every template of an operator at each call, those of text, lists and dates too. What is itself compiled
    depends on the options as well: that is not remembered.
    """

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws or not all(isinstance(a, types.Number | types.Boolean) for a in args):
            return find(self, context, args, kws)
        known = self.__dict__.setdefault("_vaneloop_known", {})
        key = (context, tuple(args))
        if key not in known:
            found = find(self, context, args, kws)
            if found is None or self._impl_keys.get(found.args) is not self.typing_key:
                return found
            known[key] = found
        return known[key]

    return get_call_type


def _plain(self: Any, message: str, *_: Any) -> str:
    """Messages of errors without colours. While it looks for a function, numba makes thousands that it never shows."""
    return message


_NO_VARIABLES: set[type] = set()  # types that were met and hold none: words, numbers, places in a file


def _variables(self: Any, value: Any) -> list[Any]:
    """Variables in what an instruction holds. numba asks each value for five types, a million times in a minute."""
    out: list[Any] = []
    _gather(value, out)
    return out


def _gather(value: Any, out: list[Any]) -> None:
    kind = type(value)
    if kind is ir.Var:
        out.append(value)
    elif kind in _NO_VARIABLES:
        pass
    elif isinstance(value, dict):
        for v in value.values():
            _gather(v, out)
    elif isinstance(value, ir.Inst):
        instruction: Any = value
        out += instruction.list_vars()
    elif isinstance(value, list | tuple):
        for v in value:
            _gather(v, out)
    else:
        _NO_VARIABLES.add(kind)


def _no_annotation(self: Any) -> str:
    """numba keeps with its machine code each line of the source and the types in it; nobody here reads it."""
    return ""


class _NoCollection(event.Listener):
    """No garbage is collected while a function, with all that it calls, is compiled: there is next to none."""

    def __init__(self) -> None:
        self.depth, self.was = 0, False

    def on_start(self, event: Any) -> None:
        """A function begins to be compiled: the outermost, or one that it calls."""
        if self.depth == 0:
            self.was = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event: Any) -> None:
        """It is compiled."""
        self.depth -= 1
        if self.depth == 0 and self.was:
            gc.enable()


def _change_numba() -> None:
    flags: Any = compiler.Flags
    flags.__eq__, flags.__hash__ = _same_flags, _hash_of_flags
    library: Any = codegen.CPUCodeLibrary
    library._optimize_functions = _optimise_functions
    of_numbers: Any = types.BaseFunction
    of_numbers.get_call_type = _remembering(of_numbers.get_call_type)
    instruction: Any = ir.Inst
    instruction._rec_list_vars = _variables
    annotation: Any = type_annotations.TypeAnnotation
    annotation.annotate = _no_annotation
    colours: Any = type(errors.termcolor())
    colours._markup = _plain
    # numba measures for how long LLVM's lock is held, at each of 150,000 calls
    lock: Any = llvm.ffi.lib._lock
    for pair in [p for p in lock._cblist if p[0].__module__ == "numba.core.base"]:
        lock.unregister(*pair)


_register: Any = event.register
_register("numba:compile", _NoCollection())
if is_known():
    _change_numba()
