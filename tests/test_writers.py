"""Every place of the packages that writes a file: through `vaneloop.base.files`, or with a reason why not."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest

from tests.conftest import ROOT
from tests.syntax import nodes
from tests.test_structure import PACKAGES, python_files

# Functions and methods that make, fill, cut or replace a file, of whatever library.
WRITES = {
    *("write_text", "write_bytes", "truncate", "ftruncate", "tofile", "save", "savez", "savez_compressed", "savetxt"),
    *("savefig", "to_csv", "to_parquet", "to_excel", "to_pickle", "to_hdf", "to_feather", "write_table", "write_csv"),
    *("write_feather", "write_dataset", "write_metadata", "write_html", "write_image", "ElementTree", "memmap"),
    *("copyfile", "copy2", "copytree", "copyfileobj", "rename", "renames", "hardlink_to", "symlink_to", "mkstemp"),
    "NamedTemporaryFile",
}
OF_MODULES = {"os", "shutil", "json", "pickle"}  # words that say nothing without their module
SHORT_WORDS = {"copy", "move", "dump", "link", "symlink", "replace"}
TO_BE_WRITTEN = {"O_WRONLY", "O_RDWR", "O_CREAT", "O_TRUNC", "O_APPEND"}  # flags of os.open
OURS = {"whole", "replacing", "create"}  # of vaneloop.base.files; whole and create of vaneloop.fleet.files
ELSEWHERE = ("vaneloop/base/files.py", "vaneloop/templates/")  # the one function; what users begin with

APPENDED = "a recording: appended to, whole after every append"
KEPT = "an earlier recording keeps its bytes, under another name"
PIPE = "a pipe or a device, no file"
PRIVATE = "a new file in a folder of this process, for itself"
BESIDE = "a file of the fleet's run folder that is read only when it is there whole, or that a restart makes anew"
CACHE = "a cache: what is cut counts as none, and bringing each of hundreds of files to the disk takes 10 ms"
REASONS = {
    ("hil/bus/broker.py", "open"): PIPE,
    ("vaneloop/fleet/together.py", "open"): "a lock, which has no content",
    ("vaneloop/verbs/answer.py", "savefig"): "to memory",
    ("hil/calibrate/prepare.py", "write_bytes"): PRIVATE,
    ("hil/calibrate/slave.py", "save"): "the memory's, which writes through `write_all`",
    ("hil/fmu/export.py", "write_text"): PRIVATE,
    ("hil/fmu/source.py", "open"): "a lock, which has no content",
    ("hil/fmu/source.py", "write_text"): PRIVATE,
    ("hil/inject/fuzz.py", "save"): "a state in memory",
    ("hil/logs/csv_format.py", "writer"): "into memory",
    ("hil/logs/mdf_child.py", "fdopen"): PIPE,
    ("hil/logs/mdf_write.py", "open"): APPENDED,
    ("hil/logs/mdf_write.py", "save"): APPENDED,
    ("hil/logs/record_formats.py", "ftruncate"): APPENDED,
    ("hil/logs/record_formats.py", "open"): APPENDED,
    ("hil/logs/record_parquet.py", "open"): APPENDED,
    ("hil/logs/record_parquet.py", "write_table"): "into memory",
    ("hil/logs/recorder.py", "replace"): KEPT,
    ("hil/logs/recorder.py", "rename"): KEPT,
    ("hil/logs/recorder.py", "truncate"): KEPT,
    ("hil/logs/through_can.py", "open"): APPENDED,
    ("hil/logs/through_can.py", "writer"): APPENDED,
    ("hil/native/black_box.py", "mkstemp"): PRIVATE,
    ("hil/native/black_box.py", "ftruncate"): PRIVATE,
    ("hil/native/black_box.py", "write_text"): PRIVATE,
    ("hil/native/isolation.py", "write_text"): PRIVATE,
    ("hil/native/isolation.py", "write_bytes"): PRIVATE,
    ("hil/native/program.py", "ftruncate"): "memory that is a file",
    ("hil/native/program.py", "mkstemp"): PRIVATE,
    ("hil/native/program.py", "copyfile"): PRIVATE,
    ("vaneloop/base/kept.py", "replace"): CACHE,
    ("vaneloop/base/kept.py", "write_bytes"): CACHE,
    ("vaneloop/base/terminal.py", "NamedTemporaryFile"): "the traceback of a defect, always a new file",
    ("vaneloop/base/terminal.py", "open"): PIPE,
    ("vaneloop/base/terminal.py", "BufferedWriter"): PIPE,
    ("vaneloop/fleet/folder.py", "rename"): BESIDE,
    ("vaneloop/fleet/leases.py", "open"): "a sign of life: harmless where it is cut",
    ("vaneloop/fleet/reader.py", "fdopen"): PIPE,
    ("vaneloop/fleet/reader.py", "open"): "a lock, which has no content",
    ("vaneloop/fleet/worker.py", "open"): "a journal and a list of failures, appended to line by line",
    ("vaneloop/web/chosen_log.py", "save"): PRIVATE,
    ("vaneloop/web/private.py", "open"): "a lock, which has no content",
    ("vaneloop/web/private.py", "rename"): "a lock, which has no content",
}


def name_of(call: ast.Call) -> str:
    """Last word of what is called: open, write_text, BLFWriter; getattr where it is looked up by name."""
    f = call.func
    return (
        f.attr
        if isinstance(f, ast.Attribute)
        else f.id
        if isinstance(f, ast.Name)
        else name_of(f)
        if isinstance(f, ast.Call)
        else ""
    )


def names_in(node: ast.AST) -> set[str]:
    """Every plain name in an expression."""
    return {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}


def writes(call: ast.Call) -> bool:
    """Whether a call may write a file."""
    name, words = name_of(call), [*call.args, *(k.value for k in call.keywords)]
    if name in ("open", "fdopen", "ZipFile", "TarFile"):
        modes = {w.value for w in words if isinstance(w, ast.Constant) and isinstance(w.value, str)}
        flags = {n.attr for w in words for n in ast.walk(w) if isinstance(n, ast.Attribute)}
        if isinstance(call.func, ast.Attribute) and ast.unparse(call.func.value) == "os" and name == "open":
            return "O_RDONLY" not in flags or bool(flags & TO_BE_WRITTEN)  # flags of another name may be any
        if isinstance(call.func, ast.Name) and len(call.args) > 1 and not isinstance(call.args[1], ast.Constant):
            return True  # a mode of another name may be any
        return bool(flags & TO_BE_WRITTEN) or any(set(m) <= set("rwaxbt+") and set(m) & set("wax+") for m in modes)
    if name in SHORT_WORDS:
        module = ast.unparse(call.func.value) if isinstance(call.func, ast.Attribute) else ""
        path = name == "replace" and len(call.args) == 1 and not call.keywords  # a text's has two arguments
        return module in OF_MODULES or path
    if name == "execute":
        return any("COPY " in ast.unparse(w) for w in words)
    if name == "getattr":  # getattr(can, writer)(path)
        return isinstance(call.func, ast.Call) and bool(names_in(call.func) & {"can", "pq", "pa", "np", "asammdf"})
    return name in WRITES or name == "writer" or name.endswith("Writer")


def writers(source: str) -> Iterator[tuple[int, str, bool]]:
    """Each call in ``source`` that may write a file: its line, its name, and whether it writes to a temporary file that
    one of OURS gives: by ``with``, or to a function that it calls.
    """

    def walk(node: ast.AST, given: frozenset[str]) -> Iterator[tuple[int, str, bool]]:
        if isinstance(node, ast.With):
            for item in node.items:
                call, name = item.context_expr, item.optional_vars
                yield from walk(call, given)
                ours = isinstance(call, ast.Call) and name_of(call) in OURS
                if isinstance(name, ast.Name) and (ours or names_in(call) & given):
                    given |= {name.id}
            for inner in node.body:
                yield from walk(inner, given)
            return
        if isinstance(node, ast.Call) and writes(node):
            yield node.lineno, name_of(node), bool(names_in(node) & given)
        for child in ast.iter_child_nodes(node):
            if isinstance(node, ast.Call) and isinstance(child, ast.Lambda) and name_of(node) in OURS:
                yield from walk(child, given | {a.arg for a in child.args.args})
            else:
                yield from walk(child, given)

    yield from walk(nodes(source)[0], frozenset())


def test_every_writer_goes_through_the_one_function_or_says_why_not() -> None:
    by_themselves, through = {}, 0
    for file in (f for top in PACKAGES for f in python_files(top)):
        place = file.relative_to(ROOT).as_posix()
        if not place.startswith(ELSEWHERE):
            for line, name, ours in writers(file.read_text(encoding="utf-8")):
                through += ours
                if not ours:
                    by_themselves.setdefault((place, name), line)
    new = [f"{place}:{by_themselves[place, name]} {name}" for place, name in by_themselves.keys() - REASONS.keys()]
    assert not new, f"write through vaneloop.base.files, or give a reason here: {sorted(new)}"
    gone = sorted(REASONS.keys() - by_themselves.keys())
    assert not gone, f"these write no longer: {gone}"
    assert through >= 15


@pytest.mark.parametrize(
    "source",
    [
        *(
            "open(p, 'w')",
            "p.open('r+b')",
            "open(p, mode='xb')",
            "os.open(p, os.O_RDWR | os.O_CREAT)",
            "os.open(p, flags)",
            "open(p, mode)",
            "p.write_text(x)",
        ),
        *("Path(p).write_bytes(x)", "fig.savefig(p)", "table.to_csv(p)", "pq.write_table(t, p)", "can.BLFWriter(p)"),
        *("getattr(can, w)(p)", "os.replace(a, b)", "a.replace(b)", "shutil.copy(a, b)", "zipfile.ZipFile(p, 'w')"),
        *("db.execute(f'COPY {t} TO {p}')", "np.savetxt(p, x)", "json.dump(x, f)", "Xml.ElementTree(x).write(p)"),
        "with whole(a) as part:\n    p.write_text(x)",
        "with other(a) as part:\n    part.write_text(x)",
        "f(a, lambda part: part.write_text(x))",
    ],
)
def test_a_writer_is_seen(source: str) -> None:
    assert [ours for *_, ours in writers(source)] == [False]


@pytest.mark.parametrize(
    "source",
    [
        "with whole(a) as part:\n    part.write_text(x)",
        "with whole(a) as part, open(part, 'wb') as f:\n    m.save(f)",
        "with replacing(a) as part:\n    with pq.ParquetWriter(part) as w:\n        pass",
        "create(a, lambda part: part.write_text(x))",
    ],
)
def test_a_writer_to_a_temporary_file_is_no_writer_by_itself(source: str) -> None:
    assert {ours for *_, ours in writers(source)} == {True}


@pytest.mark.parametrize(
    "source", ["open(p)", "open(p, 'rb')", "t.replace(a, b)", "x.copy()", "os.open(p, os.O_RDONLY)"]
)
def test_a_reader_is_no_writer(source: str) -> None:
    assert list(writers(source)) == []
