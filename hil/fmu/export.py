"""Writes an FMU: machine and calibration in, an archive with binary and sources out."""

from __future__ import annotations

import platform
import re
import shutil
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from controller import Calibration
from controller.calibration import CalibrationTable
from hil.fmu.description import SOURCES, build_description, model_description
from hil.fmu.memory import first
from hil.fmu.source import SHELL, build, kept_source, model_source, part_object, part_source
from hil.fmu.variables import PARTS, Variable, variables_of
from plant import Model, Plant
from vaneloop.base.errors import InputError
from vaneloop.base.files import whole
from vaneloop.base.version import installed_version

__all__ = ["VERSIONS", "Written", "is_made", "write_fmu"]

VERSIONS = ("3.0", "2.0")
_THEN = (2020, 1, 1, 0, 0, 0)  # of every file in the archive: the same machine gives the same bytes
_HEADERS = {
    "3.0": ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
    "2.0": ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
}


@dataclass(frozen=True)
class Written:
    """An FMU that was written: its file, FMI version, part, token and variables."""

    path: str
    version: str
    part: str
    token: str
    variables: list[Variable]


def is_made(part: str, plant: Plant, calibration: Calibration) -> bool:
    """Whether the C source for such a machine is there already; making it takes a minute."""
    return part not in PARTS or kept_source(part, first(plant, calibration)[0]).is_file()


def write_fmu(
    path: str | Path,
    part: str,
    plant: Plant,
    calibration: Calibration,
    table: CalibrationTable,
    model: Model | None = None,
    version: str = "3.0",
) -> Written:
    """Write ``path`` as an FMU for co-simulation.

    part   plant, controller or loop
    table  the calibration as its file has it
    model  what the plant has beyond its tables
    Raises InputError for a name that does not end in .fmu, a file that cannot be written, or a machine without gcc.
    """
    out = Path(path)
    if out.suffix.lower() != ".fmu":
        raise InputError(f"{out}: the name of an FMU ends in .fmu")
    if part not in PARTS:
        raise InputError(f"part (={part!r}) must be one of {', '.join(PARTS)}")
    if version not in VERSIONS:
        raise InputError(f"FMI version (={version!r}) must be one of {', '.join(VERSIONS)}")
    if shutil.which("gcc") is None:
        raise InputError("gcc is needed to build an FMU and is not installed")
    identifier = re.sub(r"\W", "_", out.stem, flags=re.ASCII)
    identifier = identifier if re.match(r"[A-Za-z_]", identifier) else f"m{identifier}"
    shape, memory = first(plant, calibration)
    variables = variables_of(part, plant, model or Model(), calibration, table, memory, shape)
    head, body = model_source(part, shape, memory, variables)
    token = head.rsplit('"', 2)[1]
    files = {"part.c": part_source(part, shape), "model.h": head, "model.c": body}
    for name in ("fmu.h", *SOURCES[version], *_HEADERS[version]):
        if name not in files:
            files[name] = (SHELL / name).read_text(encoding="utf-8")
    described = model_description(version, f"VaneLoop {part}", identifier, token, variables, installed_version())
    binary = _built(files, SOURCES[version], part_object(part, shape))
    where = f"{platform.machine()}-linux" if version == "3.0" else "linux64"
    with whole(out) as made, zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        _put(archive, "modelDescription.xml", described)
        _put(archive, f"binaries/{where}/{identifier}.so", binary)
        for name, text in files.items():
            _put(archive, f"sources/{name}", text.encode())
        if version == "3.0":
            _put(archive, "sources/buildDescription.xml", build_description(identifier))
    return Written(str(out), version, part, token, variables)


def _put(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    info = zipfile.ZipInfo(name, _THEN)
    info.compress_type = zipfile.ZIP_DEFLATED
    info.external_attr = (0o755 if name.endswith(".so") else 0o644) << 16
    archive.writestr(info, data)


def _built(files: dict[str, str], sources: tuple[str, ...], part: Path) -> bytes:
    """Compile and link the sources, of which the object file ``part`` is there already."""
    with tempfile.TemporaryDirectory(prefix="vaneloop-fmu-") as name:
        folder = Path(name)
        for file, text in files.items():
            (folder / file).write_text(text, encoding="utf-8")
        own = [file for file in sources if file != "part.c"]
        build(["-shared", *own, str(part), "-lm"], "fmu.so", folder)
        return (folder / "fmu.so").read_bytes()
