"""The layout that docs/architecture.md promises: who imports whom, what each package exports, what is in the
repository.
"""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import scipy

from tests.conftest import ROOT
from tests.pythons import PYTHONS
from tests.syntax import nodes
from vaneloop.cli.main import IN_CHECKOUT

PACKAGES = ("controller", "plant", "hil", "vaneloop")
OURS = {*PACKAGES, "tests", "benchmarks", "examples"}

# The table of docs/architecture.md: what code in a room may import besides the room itself. The longest path counts.
MODELS = ("user_models", "unmodelled", "vane_chain")  # of the identification package: what it can look at
LOWER = {"vaneloop.base", "controller", "plant", "hil"}
SEARCH = {*LOWER, "vaneloop.identification"}
MAY_IMPORT: dict[str, set[str]] = {
    "controller": {"vaneloop.base"},
    "plant": {"vaneloop.base"},
    "hil": {"vaneloop.base", "controller", "plant"},
    "vaneloop/base": set(),
    "vaneloop/identification": {"vaneloop.base"},
    **{f"vaneloop/identification/{models}": SEARCH for models in MODELS},
    "vaneloop/design": SEARCH,
    "vaneloop/pages": {*SEARCH, "vaneloop.design"},
    "vaneloop/verbs": {*SEARCH, "vaneloop.pages"},
    "vaneloop/fleet": {*SEARCH, "vaneloop.pages", "vaneloop.verbs"},
    "vaneloop/cli": {*SEARCH, "vaneloop.design", "vaneloop.pages", "vaneloop.verbs", "vaneloop.fleet"},
    "vaneloop/web": {*SEARCH, "vaneloop.design", "vaneloop.pages", "vaneloop.verbs", "vaneloop.fleet", "vaneloop.cli"},
    "vaneloop": set(PACKAGES),
    "tests/rig": set(),
    "tests/rig_systems": set(),
}
# Doors that stand in a lower room: what else these files may import.
DOORS: dict[str, tuple[str, ...]] = {
    "hil/replay/__main__.py": ("vaneloop.cli.replay",),  # python -m hil.replay
    "hil/inject/__main__.py": ("vaneloop.cli.inject",),  # python -m hil.inject
    # what a user describes is offered at the room's door
    "vaneloop/identification/__init__.py": (
        "vaneloop.identification.user_models.user_code",
        "vaneloop.identification.user_models.system",
    ),
}
CLOCKS_AND_BUSES = {
    "asyncio",
    "can",
    "cantools",
    "datetime",
    "sched",
    "selectors",
    "signal",
    "socket",
    "threading",
    "time",
}

# Imports inside functions: file -> module -> why it is not at the top: an extra of pyproject.toml that brings it, or
# the processor time that whoever does not use it would spend.
LATE: dict[str, dict[str, str]] = {
    "hil/bus/frames.py": {"can": "start-up: 120 ms"},
    "hil/inject/__main__.py": {"vaneloop.cli.inject": "start-up: 900 ms, in which Ctrl-C is heard"},
    "hil/inject/fuzz.py": {"can": "start-up: 120 ms"},
    "hil/inject/fuzz_tools.py": {"hil.uds.station": "extra diagnostics"},
    "hil/inject/sil.py": {  # loaded by every pytest
        "controller": "start-up: 600 ms",
        "hil.inject.any_controller": "start-up: 700 ms",
        "hil.native": "start-up: 700 ms",
    },
    "hil/logs/dbc.py": {"cantools": "start-up: 120 ms"},
    "hil/logs/guess.py": {"controller": "start-up: 300 ms", "plant.geometry": "start-up: 300 ms"},
    "hil/logs/units.py": {"pint": "start-up: 270 ms"},
    "hil/loop/cuda.py": {"numba.cuda": "extra gpu", "numba.cuda.libdevice": "extra gpu"},
    "hil/replay/__main__.py": {"vaneloop.cli.replay": "start-up: 900 ms, in which Ctrl-C is heard"},
    "vaneloop/base/terminal.py": {
        "rich": "start-up: 60 ms",
        "rich.console": "start-up: 60 ms",
        "rich.progress": "start-up: 70 ms",
        "rich.table": "start-up: 70 ms",
    },
    "vaneloop/cli/attended.py": {"hil.uds.station": "extra diagnostics"},
    "vaneloop/cli/design.py": {
        "vaneloop.design.servo_design": "start-up: 1900 ms",
        "vaneloop.pages.design": "start-up: 1900 ms",
    },
    "vaneloop/__init__.py": {"vaneloop.base.version": "start-up: 30 ms"},
    "vaneloop/cli/main.py": {"vaneloop.base.version": "start-up: 30 ms"},
    "vaneloop/cli/map.py": {"hil.logs.others": "start-up: 150 ms"},
    "vaneloop/design/multibody.py": {
        "exudyn": "extra multibody",
        "exudyn.itemInterface": "extra multibody",
        "exudyn.utilities": "extra multibody",
    },
    "vaneloop/fleet/leases.py": {"psutil": "extra fleet"},
    "vaneloop/fleet/rent.py": {
        "dask": "extra fleet",
        "dask.distributed": "extra fleet",
        "distributed.security": "extra fleet",
    },
    "vaneloop/fleet/tables.py": {"duckdb": "extra fleet"},
    "vaneloop/pages/page.py": {"plotly.offline": "start-up: 50 ms"},
    "vaneloop/verbs/answer.py": {"matplotlib.figure": "extra notebook", "plotly.graph_objects": "start-up: 50 ms"},
    "vaneloop/verbs/machine.py": {  # a loop that runs has the machine and searches nothing
        "vaneloop.identification.vane_chain.chain": "start-up: 300 ms",
        "vaneloop.identification.vane_chain.resample": "start-up: 300 ms",
        "vaneloop.verbs.long": "start-up: 300 ms",
    },
    "vaneloop/web/command.py": {"vaneloop.web.server": "extra web"},
}
# Files of the product that import each other, also by imports in functions and for types: no others may, and these
# should not.
CIRCLES: list[set[str]] = []

# What each package exports. To change it on purpose, paste the line that the failing test prints.
EXPORTS: dict[str, list[str]] = {
    "controller": [
        *("Calibration", "FAULTS", "INPUTS", "MODES", "OUTPUTS", "SCALARS", "STATE", "STRATEGIES", "flat", "give"),
        *("load_calibration", "new_inputs", "new_outputs", "new_state", "tick"),
    ],
    "hil": [
        "Channel",
        "Log",
        "LogError",
        "ReplayResult",
        "Run",
        "Stimulus",
        "lockstep_engines",
        "lockstep_lanes",
        "read_log",
        "write_log",
    ],
    "hil.bus": ["Port", "open_bus"],
    "hil.calibrate": ["Attended", "Memory", "Slave"],
    "hil.inject": [
        "ACTIONS",
        "Babble",
        "BusOff",
        "ChannelFault",
        "Check",
        "Corrupt",
        "Delay",
        "Drop",
        "Duplicate",
        "ErrorFrames",
        "Expect",
        "Flood",
        "Freeze",
        "Link",
        "Machine",
        "Outcome",
        "Override",
        "Reorder",
        "Replay",
        "Scenario",
        "Send",
        "TRANSITIONS",
        "Trace",
        "judge",
        "library",
        "load_scenario",
        "run",
    ],
    "hil.fmu": ["is_made", "write_fmu"],
    "hil.replay": ["ReplayResult", "apart", "replay", "replay_json"],
    "hil.native": ["Program"],
    "hil.uds": ["Server", "TroubleMemory"],
    "hil.logs": [
        *("Channel", "Format", "Frames", "Log", "LogError", "Options", "Samples", "Series", "Source", "offered"),
        *("read_log", "write_log"),
    ],
    "plant": [
        "Geometry",
        "Model",
        "Plant",
        "Schedules",
        "build_plant",
        "load_geometry",
        "load_model",
        "load_schedules",
        "write_model",
    ],
    "plant.effects": [
        "CURVES",
        "DERIVED",
        "EFFECTS",
        "MOTOR",
        "MOTOR_AT",
        "NEUTRAL",
        "N_PARAMETERS",
        "N_STATE",
        "ROW",
        "SIGNAL_AT",
        "STATE",
        "STATE_ROW",
        "UNISON",
        "rows_at",
        "states_of",
    ],
    "plant.stages": ["actuator_run", "engine_run", "linkage_run", "ring_loads", "run_bends", "step_currents"],
    "vaneloop": [
        *(
            "Channel",
            "InputError",
            "Law",
            "Log",
            "Machine",
            "Parameter",
            "Record",
            "Scenario",
            "System",
            "compare",
            "diagnose",
        ),
        *("experiment", "extend", "learn", "load_system", "locate", "open_bus", "read_log", "replay", "unknown"),
        "write_log",
    ],
    "vaneloop.identification": [
        "Effect",
        "Parameter",
        "Record",
        "Stage",
        "StageError",
        "System",
        "load_system",
        "unknown",
    ],
}


IMPORTERS = ("import_module", "__import__")


def called(call: ast.Call) -> str:
    """Last word of what is called: import_module of importlib.import_module(x)."""
    f = call.func
    return f.attr if isinstance(f, ast.Attribute) else f.id if isinstance(f, ast.Name) else ""


def imported_names(source: str, file: str) -> Iterator[tuple[int, str]]:
    """Every dotted name that ``source`` imports, with its line, wherever in the file the import stands.

    ``from a.b import c`` gives a.b and a.b.c (c may be a module); relative imports are resolved against ``file``;
    import_module("a") and __import__("a") with a constant name count too.
    """
    package = Path(file).parent.parts
    for node in nodes(source):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield node.lineno, base
            for alias in node.names:
                yield node.lineno, f"{base}.{alias.name}"
        elif (
            isinstance(node, ast.Call)
            and node.args
            and isinstance(node.args[0], ast.Constant)
            and isinstance(node.args[0].value, str)
        ) and called(node) in IMPORTERS:
            yield node.lineno, node.args[0].value


def within(name: str, room: str) -> bool:
    """Whether the dotted ``name`` is ``room`` or in it."""
    return name == room or name.startswith(f"{room}.")


def may_import(file: str, name: str) -> bool:
    """Whether the architecture lets ``file`` (path from the root, with /) import the dotted ``name``."""
    top = name.split(".")[0]
    home = max((room for room in MAY_IMPORT if file.startswith(f"{room}/")), key=len)
    if home in ("controller", "plant") and top in CLOCKS_AND_BUSES:
        return False
    if top not in OURS or any(within(name, door) for door in DOORS.get(file, ())):
        return True
    if home == "tests/rig":
        return name == "tests" or within(name, "tests.rig")
    if home == "vaneloop/identification" and any(within(name, f"vaneloop.identification.{m}") for m in MODELS):
        return False  # the core would know the vane chain through them
    if name in ("vaneloop", "hil") or (name == "vaneloop.cli" and file in DOORS):
        return True  # `from vaneloop import x` also gives vaneloop.x, which is judged by itself
    mine = home.replace("/", ".")
    return within(name, mine) or any(within(name, room) for room in MAY_IMPORT[home])


def complaints(source: str, file: str) -> list[str]:
    """Imports in ``source`` that the architecture forbids to ``file``, as ``file:line imports name``."""
    return sorted(
        {f"{file}:{line} imports {name}" for line, name in imported_names(source, file) if not may_import(file, name)}
    )


def python_files(folder: str) -> list[Path]:
    """Python sources under ``folder`` of the checkout."""
    return sorted(p for p in (ROOT / folder).rglob("*.py") if "__pycache__" not in p.parts)


def tracked_files() -> list[Path]:
    """Files that git tracks; skips outside a git checkout (a source archive, say)."""
    try:
        listed = subprocess.run(
            ["git", "-C", str(ROOT), "ls-files", "-z"], capture_output=True, check=True
        ).stdout.decode()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout: tracked files are not known")
    return [ROOT / name for name in listed.split("\0") if name and (ROOT / name).is_file()]


@pytest.mark.parametrize("home", MAY_IMPORT)
def test_imports_run_the_way_the_architecture_says(home: str) -> None:
    files = python_files(home)
    assert files, f"{home} has no Python file"
    wrong = [c for f in files for c in complaints(f.read_text(encoding="utf-8"), f.relative_to(ROOT).as_posix())]
    assert not wrong, "\n" + "\n".join(wrong)


@pytest.mark.parametrize(
    ("file", "source", "caught"),
    [
        ("vaneloop/base/x.py", "import controller", "controller"),
        ("vaneloop/base/x.py", "from . import errors", None),
        ("vaneloop/base/x.py", "from vaneloop import cli", "vaneloop.cli"),
        ("controller/x.py", "def f():\n    from plant.effects import play", "plant.effects"),
        ("controller/x.py", "import time", "time"),
        ("controller/x.py", "from vaneloop.base.tables import read", None),
        ("controller/x.py", "from vaneloop.identification import System", "vaneloop.identification"),
        ("plant/effects/x.py", "from .. import controller", None),  # plant.controller, which is plant's own
        ("plant/x.py", "import importlib\nimportlib.import_module('hil.runner')", "hil.runner"),
        ("plant/x.py", "m = __import__('controller')", "controller"),
        (
            "hil/x.py",
            "import vaneloop.identification.least_squares.problem as d",
            "vaneloop.identification.least_squares.problem",
        ),
        ("hil/x.py", "from plant import chain\nfrom controller import tick", None),
        ("hil/x.py", "if True:\n    import tests.rig", "tests.rig"),
        ("hil/logs/x.py", "from vaneloop.cli import replay", "vaneloop.cli"),
        ("hil/replay/__main__.py", "from vaneloop.cli import replay", None),
        ("hil/replay/__main__.py", "from vaneloop.cli import compare", "vaneloop.cli.compare"),
        ("vaneloop/identification/regimes.py", "import hil.logs", "hil.logs"),
        ("vaneloop/identification/regimes.py", "from vaneloop.base.errors import InputError", None),
        (
            "vaneloop/identification/regimes.py",
            "from vaneloop.identification.vane_chain import chain",
            "vaneloop.identification.vane_chain",
        ),
        (
            "vaneloop/identification/candidates/x.py",
            "from ..vane_chain.chain import chain",
            "vaneloop.identification.vane_chain.chain",
        ),
        (
            "vaneloop/identification/vane_chain/chain.py",
            "import plant, controller, hil\nfrom vaneloop.identification import workflow",
            None,
        ),
        ("vaneloop/identification/vane_chain/chain.py", "from vaneloop.pages import page", "vaneloop.pages"),
        ("vaneloop/design/x.py", "from vaneloop.pages.page import Page", "vaneloop.pages.page"),
        ("vaneloop/pages/x.py", "from vaneloop.design import servo", None),
        ("vaneloop/pages/x.py", "from vaneloop.base import terminal\nfrom vaneloop.cli import main", "vaneloop.cli"),
        ("vaneloop/cli/x.py", "import hil, vaneloop.pages.page", None),
        ("vaneloop/cli/x.py", "from vaneloop.web import server", "vaneloop.web"),
        ("vaneloop/cli/x.py", "import benchmarks", "benchmarks"),
        ("vaneloop/web/x.py", "from vaneloop.cli import options", None),
        ("tests/rig/x.py", "import vaneloop.base.tables", "vaneloop.base.tables"),
        ("tests/rig/x.py", "from plant.linkage import ring_angle", "plant.linkage"),
        ("tests/rig/x.py", "from tests.test_plant import make", "tests.test_plant"),
        ("tests/rig/x.py", "from tests.rig.geometry import read\nfrom .geometry import read", None),
    ],
)
def test_a_forbidden_import_is_caught(file: str, source: str, caught: str | None) -> None:
    found = complaints(source, file)
    if caught is None:
        assert found == []
    else:
        assert any(c.endswith(f" imports {caught}") for c in found), found


CHECKOUT = ("tests", "benchmarks")  # folders of Python that are not installed


def names_of_the_checkout(source: str) -> list[str]:
    """Modules of the checkout that ``source`` imports, or has as a text, which importlib may be given."""
    texts = [n.value for n in nodes(source) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    spelled = [text for text in texts if re.fullmatch(r"\w+(\.\w+)+", text)]
    imported = [name for _, name in imported_names(source, "x.py")]
    return [name for name in (*imported, *spelled) if name.split(".")[0] in CHECKOUT]


@pytest.mark.parametrize("package", PACKAGES)
def test_no_code_of_the_product_names_what_is_not_installed(package: str) -> None:
    told = {"vaneloop/cli/main.py": set(IN_CHECKOUT.values())}  # what a user is told to type
    found = {
        (f.relative_to(ROOT).as_posix(), name)
        for f in python_files(package)
        for name in names_of_the_checkout(f.read_text(encoding="utf-8"))
    }
    assert found == {(file, name) for file, names in told.items() if file.startswith(package) for name in names}


@pytest.mark.parametrize(
    "source", ["from tests import rig", "def f():\n    import benchmarks.blind", "m = load(['tests.rig'])"]
)
def test_a_name_of_what_is_not_installed_is_caught(source: str) -> None:
    assert names_of_the_checkout(source)
    assert not names_of_the_checkout("'see tests/rig'; row = {'tests': 4}  # tests.rig")


def product_files() -> dict[str, str]:
    """Sources of the product by their paths from the root; what users begin with is theirs."""
    files = (f for top in PACKAGES for f in python_files(top) if "templates" not in f.parts)
    return {f.relative_to(ROOT).as_posix(): f.read_text(encoding="utf-8") for f in files}


def late_imports(source: str) -> dict[str, int]:
    """Modules that functions import, also by import_module with a constant name, with the line of the last import."""
    found: dict[str, int] = {}
    for function in nodes(source):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        for node in ast.walk(function):
            if isinstance(node, ast.Import):
                found |= {alias.name: node.lineno for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                found["." * node.level + (node.module or "")] = node.lineno
            elif isinstance(node, ast.Call) and called(node) in IMPORTERS and isinstance(node.args[0], ast.Constant):
                found[str(node.args[0].value)] = node.lineno
    return found


def test_a_function_imports_only_extras_and_what_start_up_pays_for() -> None:
    found = {file: late for file, source in product_files().items() if (late := late_imports(source))}
    new = [
        f"{file}:{line}: {module} is imported in a function. Import it at the top of the file; or, where an extra "
        f"brings it or start-up pays for it, enter it in LATE of this file with its reason"
        for file, late in found.items()
        for module, line in late.items()
        if module not in LATE.get(file, {})
    ]
    assert not new, "\n".join(new)
    gone = [f"{file}: {module}" for file, late in LATE.items() for module in late if module not in found.get(file, {})]
    assert not gone, f"LATE names what is not imported in a function any more: {gone}"


def test_each_late_import_has_a_reason_that_holds() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    for file, late in LATE.items():
        for module, reason in late.items():
            kind, _, what = reason.partition(" ")
            assert (kind == "extra" and what in extras) or re.match(r"start-up: \d+ ms", reason), (file, module, reason)


@pytest.mark.parametrize(
    ("source", "modules"),
    [
        ("import a\nfrom b import c", []),
        ("def f():\n    import a.b\n    from c import d", ["a.b", "c"]),
        ("class A:\n    async def f(self):\n        if True:\n            from . import d", ["."]),
        ("f = lambda: importlib.import_module('a.b')\ng = lambda n: importlib.import_module(n)", ["a.b"]),
    ],
)
def test_an_import_in_a_function_is_found(source: str, modules: list[str]) -> None:
    assert list(late_imports(source)) == modules


def circles(sources: dict[str, str]) -> list[set[str]]:
    """Sets of files that import each other, directly or by way of others: at the top, in functions, for types.

    ``from a import b`` is an import of the file a/b.py where there is one, and of a else.
    """
    names = {file.removesuffix(".py").removesuffix("/__init__").replace("/", "."): file for file in sources}
    number = {file: i for i, file in enumerate(sources)}
    graph = np.zeros((len(sources), len(sources)), dtype=bool)
    for file, source in sources.items():
        for node in nodes(source):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                wanted = [f"{node.module}.{a.name}" if f"{node.module}.{a.name}" in names else node.module
                          for a in node.names]  # fmt: skip
            else:
                wanted = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            for name in wanted:
                if name in names and names[name] != file:
                    graph[number[file], number[names[name]]] = True
    many, of = scipy.sparse.csgraph.connected_components(graph, connection="strong")
    sets = [{file for file in sources if of[number[file]] == k} for k in range(many)]
    return [s for s in sets if len(s) > 1]


def test_files_import_each_other_in_no_new_circle() -> None:
    found = circles(product_files())
    new = [f"import each other: {', '.join(sorted(c))}" for c in found if c not in CIRCLES]
    assert not new, "\n".join(new)
    assert not (gone := [c for c in CIRCLES if c not in found]), f"no circle any more, take it out of CIRCLES: {gone}"


def test_a_circle_of_files_is_found() -> None:
    sources = {
        "a/__init__.py": "from a.b import x",
        "a/b.py": "def f():\n    from a import c",
        "a/c.py": "if TYPE_CHECKING:\n    import a.d",
        "a/d.py": "from a.b import f",
        "a/e.py": "import a.d",
    }
    assert circles(sources) == [{"a/b.py", "a/c.py", "a/d.py"}]


def packages_with_init() -> list[str]:
    """Dotted names of all our packages that have an ``__init__.py``."""
    inits = [p for top in PACKAGES for p in python_files(top) if p.name == "__init__.py"]
    return sorted(".".join(p.parent.relative_to(ROOT).parts) for p in inits)


@pytest.mark.parametrize("package", packages_with_init())
def test_every_exported_name_exists_and_is_expected(package: str) -> None:
    module = importlib.import_module(package)
    assert Path(str(module.__file__)).is_relative_to(ROOT), (
        f"{package} comes from {module.__file__}, not from this checkout"
    )
    exported = getattr(module, "__all__", None)
    assert exported is not None, f"{package}/__init__.py has no __all__"
    missing = [name for name in exported if not hasattr(module, name)]
    assert not missing, f"{package}.__all__ names what {package} does not have: {missing}"
    line = f'    "{package}": [{", ".join(f"{name!r}" for name in sorted(exported))}],'.replace("'", '"')
    assert sorted(exported) == sorted(EXPORTS.get(package, [])), (
        f"{package} exports something else; if meant, EXPORTS needs\n{line}"
    )


def test_no_file_names_a_place_on_one_machine() -> None:
    place = re.compile(r"(?<![\w./~$}*>-])/(?:work|tmp|home|root|Users)/\w")
    found = []
    for file in tracked_files():
        data = file.read_bytes()
        if b"\0" in data[:8192]:
            continue
        for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
            if place.search(line):
                found.append(f"{file.relative_to(ROOT)}:{number}: {line.strip()[:120]}")
    assert not found, "\n" + "\n".join(found)


def records_of_own_arrays(source: str) -> list[str]:
    """Compiled functions that make an array of records, or show as a record one that they made.

    numba frees an array when its name is used no more, also while a record taken out of it is still in use.
    """
    views = {"as_inputs", "as_outputs", "as_scalars", "as_state"}
    makers = {"empty", "zeros", "ones", "full", "copy", "empty_like", "zeros_like"}
    found = []
    for function in nodes(source):
        if not isinstance(function, ast.FunctionDef):
            continue
        if not any("compiled" in ast.unparse(d) or "njit" in ast.unparse(d) for d in function.decorator_list):
            continue
        calls = [c for c in ast.walk(function) if isinstance(c, ast.Call)]
        made = [c for c in calls if isinstance(c.func, ast.Attribute) and c.func.attr in makers]
        own = {
            ast.unparse(name)
            for a in ast.walk(function)
            if isinstance(a, ast.Assign) and a.value in made
            for name in a.targets
        }
        of_records = [c for c in made for d in [*c.args[1:], *(k.value for k in c.keywords)] if isinstance(d, ast.Name)]
        shown = [
            c
            for c in calls
            if isinstance(c.func, ast.Name) and c.func.id in views
            if c.args[0] in made or ast.unparse(c.args[0]) in own
        ]
        found += [f"{function.name}: {ast.unparse(c)}" for c in [*of_records, *shown]]
    return found


def test_no_record_outlives_the_array_it_stands_in() -> None:
    files = [f for top in PACKAGES for f in python_files(top)]
    found = [f"{f.relative_to(ROOT)} {c}" for f in files for c in records_of_own_arrays(f.read_text())]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("body", "caught"),
    [
        ("m = np.empty(1, LAYOUT)\n    b = m[0]", True),
        ("m = np.zeros(1, dtype=LAYOUT)", True),
        ("z = as_state(np.zeros(40))", True),
        ("z0 = z1.copy()\n    z = as_state(z0)", True),
        ("m = np.empty(4, np.int64)\n    z = as_state(row)", False),
    ],
)
def test_a_record_of_an_own_array_is_caught(body: str, caught: bool) -> None:
    assert bool(records_of_own_arrays(f"@compiled_free\ndef f(row, z1):\n    {body}\n")) == caught
    assert not records_of_own_arrays(f"def f(row, z1):\n    {body}\n")


def test_no_tracked_file_is_larger_than_a_mebibyte() -> None:
    large = [
        f"{f.relative_to(ROOT)}: {f.stat().st_size / 2**20:.2f} MiB"
        for f in tracked_files()
        if f.stat().st_size > 2**20
    ]
    assert not large, "\n".join(large)


def test_no_installed_package_takes_one_of_our_names() -> None:
    owners = metadata.packages_distributions()
    foreign = {top: sorted({d for d in owners.get(top, []) if d.lower() != "vaneloop"}) for top in PACKAGES}
    assert not any(foreign.values()), f"installed packages that hide ours: { {k: v for k, v in foreign.items() if v} }"


def test_every_requirement_is_pinned() -> None:
    def name(requirement: str) -> str:
        return re.sub(r"[-_.]+", "-", re.split(r"[\s<>=!~;\[]", requirement.strip(), maxsplit=1)[0]).lower()

    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {name(x) for x in lines if "==" in x and not x.startswith("#")}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [*project["dependencies"], *(r for extra in project["optional-dependencies"].values() for r in extra)]
    others = {name(r) for r in wanted} - {project["name"]}  # an extra may name others
    assert others <= pinned, others - pinned


def test_the_hooks_of_a_commit_run_the_pinned_ruff() -> None:
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    pinned = re.search(r"^ruff==(.+)$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE)
    assert pinned is not None
    assert re.findall(r"rev: v(.+)", hooks) == [pinned[1]]


def test_the_workflow_runs_the_make_targets_on_every_python_promised() -> None:
    workflow = (ROOT / ".github" / "workflows" / "checks.yml").read_text(encoding="utf-8")
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert {"demo", "test", "test-all"} <= set(re.findall(r"run: make ([a-z-]+)", workflow)) <= set(targets)
    assert all(f'"{version}"' in workflow for version in PYTHONS)


def test_fragments_of_the_changelog_are_of_a_known_kind() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    kinds = {t["directory"] for t in project["tool"]["towncrier"]["type"]}
    fragments = [p for p in (ROOT / "changelog.d").iterdir() if p.name != "README.md"]
    wrong = [p.name for p in fragments if p.suffix != ".md" or p.stem.rpartition(".")[2] not in kinds]
    assert not wrong, f"{wrong}: the name must be NAME.KIND.md, KIND one of {sorted(kinds)}"


def test_prose_stands_in_lines_of_120_columns() -> None:
    """Rows of tables, code, and lines that hold one link or picture only are as long as they must be."""
    long = []
    for file in (f for f in tracked_files() if f.suffix == ".md"):
        code = False
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
            code ^= line.lstrip().startswith("```")
            if len(line) > 120 and not code and not re.match(r"\s*[|#`!]", line):
                long.append(f"{file.relative_to(ROOT)}:{number}: {len(line)} columns")
    assert not long, "\n".join(long)


def test_what_holds_arrays_is_compared_by_identity() -> None:
    """``==`` of two such records, and ``in`` a list of them, would ask arrays whether they are true."""
    fields: dict[str, list[str]] = {}
    identity: dict[str, bool] = {}
    for path in sorted((ROOT / "vaneloop" / "identification").rglob("*.py")):
        for node in nodes(path.read_text(encoding="utf-8")):
            how = [ast.unparse(d) for d in getattr(node, "decorator_list", ()) if "dataclass" in ast.unparse(d)]
            if isinstance(node, ast.ClassDef) and how:
                held = [ast.unparse(a.annotation) for a in node.body if isinstance(a, ast.AnnAssign)]
                name = node.name if node.name not in fields else f"{node.name} of {path.stem}"
                fields[name] = [f for f in held if "Callable" not in f] + [ast.unparse(b) for b in node.bases]
                identity[name] = "eq=False" in how[0]
    arrays = {"Array", "ndarray", "NDArray"}
    while more := {n for n, of in fields.items() if n not in arrays and arrays & set(re.findall(r"\w+", " ".join(of)))}:
        arrays |= more
    holders = arrays & identity.keys()
    assert {"Fit", "FittedCandidate", "Stage"} <= holders
    assert [n for n in sorted(holders) if not identity[n]] == []
