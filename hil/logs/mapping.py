"""Mapping files: the names and units of a bench's logs, said once (`vaneloop map LOG --out bench.toml`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hil.logs.source import LogError, close_names
from vaneloop.base.files import write
from vaneloop.base.signals import UNITS
from vaneloop.base.tables import load_toml

__all__ = ["Bench", "read_mapping", "write_mapping"]


@dataclass(frozen=True)
class Bench:
    """How the logs of a bench are read.

    names       signal (or t) -> name in the log
    units       signal (or t) -> unit in the log
    design_rpm  rotor speed that is 100 %, rpm
    dbc         database of its CAN logs; a relative path counts from the mapping file
    """

    names: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    design_rpm: float | None = None
    dbc: Path | None = None


def read_mapping(path: str | Path, signals: Mapping[str, str] = UNITS) -> Bench:
    """Read a mapping file for ``signals``. Raises InputError, one line, for a key or value that is none."""
    path = Path(path)
    table = load_toml(path)
    known = ("names", "units", "design_rpm", "dbc")
    if wrong := next((k for k in table if k not in known), None):
        raise LogError(f"{path}: {wrong!r} is unknown{close_names(wrong, known)}; allowed: {', '.join(known)}")
    for section in ("names", "units"):
        given = table.get(section, {})
        if not isinstance(given, dict):
            raise LogError(f"{path}: {section} (={given!r}) must be a table: [{section}] and a line a signal below it")
        for signal, value in given.items():
            if signal not in signals and signal != "t":
                raise LogError(
                    f"{path}: {section}.{signal}: is not a signal{close_names(signal, signals)}; allowed: "
                    f"{', '.join(signals)}, t"
                )
            if not isinstance(value, str) or not value.strip():
                raise LogError(f"{path}: {section}.{signal} (={value!r}) must be a word in quotation marks")
    rpm, dbc = table.get("design_rpm"), table.get("dbc")
    if rpm is not None and (isinstance(rpm, bool) or not isinstance(rpm, int | float) or not 0.0 < rpm < 1e7):
        raise LogError(f"{path}: design_rpm (={rpm!r} rpm) must be above 0 and below 10,000,000")
    if dbc is not None and not isinstance(dbc, str):
        raise LogError(f"{path}: dbc (={dbc!r}) must be a file name in quotation marks")
    return Bench(
        dict(table.get("names", {})), dict(table.get("units", {})), None if rpm is None else float(rpm),
        None if dbc is None else path.parent / dbc,
    )  # fmt: skip


def write_mapping(path: str | Path, bench: Bench, remarks: Mapping[str, str] | None = None, head: str = "") -> None:
    """Write a mapping file; ``remarks`` signal -> what is said behind its name, ``head`` stands above."""
    remarks = remarks or {}
    lines = [f"# {line}" for line in head.splitlines()]
    if bench.design_rpm is not None:
        lines.append(f"design_rpm = {bench.design_rpm!r}  # rotor speed that is 100 %")
    if bench.dbc is not None:
        lines.append(f"dbc = {_word(str(bench.dbc.absolute()))}")
    for section, of in (("names", bench.names), ("units", bench.units)):
        lines += ["", f"[{section}]  # signal = {section[:-1]} in the log"]
        for signal, value in of.items():
            said = " ".join(remarks.get(signal, "").split()) if section == "names" else ""
            remark = f"  # {said}" if said else ""
            lines.append(f"{signal} = {_word(value)}{remark}")
    write(path, "\n".join(lines) + "\n")


def _word(text: str) -> str:
    """A TOML basic string: JSON's, whose escapes TOML has too."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
