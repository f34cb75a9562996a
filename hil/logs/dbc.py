"""Databases of CAN messages, read through cantools.

What it stumbles over is left out of the file, as long as no signal's layout needs it.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.logs.frames import EXTENDED
from hil.logs.source import LogError, check_file, read_bytes

__all__ = ["Message", "load_dbc"]

MAX_DBC = 32 << 20  # bytes; the largest of whole vehicles have some ten MB
# What a DBC can lose without losing a signal's layout, least needed first.
_DROP = (("VAL_",), ("CM_",),
    ("BA_", "BA_DEF_", "BA_DEF_DEF_", "BA_REL_", "BA_DEF_REL_", "BA_DEF_DEF_REL_", "SIG_GROUP_", "EV_",
         "BO_TX_BU_", "VAL_TABLE_"))  # fmt: skip


_STATEMENT = re.compile(r'(?:[^;"]|"(?:[^"\\]|\\.)*+")*+;', re.DOTALL)  # up to its end, from anywhere in it


@dataclass(frozen=True)
class Message:
    """One message of the database, with what the product needs beyond its layout.

    e2e         DataID of AUTOSAR E2E profile 1, None where the message has none
    j1939       raw values with 0xFE or 0xFF on top mean error or not available (J1939-71)
    missing     signal -> raw value that means not available (attribute NotAvailable of vgv.dbc)
    proves      whether it carries the MAC of another message (attribute AuthenticatorOf of vgv.dbc)
    """

    layout: Any  # cantools.database.can.Message
    ident: int
    e2e: int | None
    j1939: bool
    missing: dict[str, int]
    proves: bool = False


def load_dbc(path: Path) -> tuple[list[Message], list[str]]:
    """Messages of a database file and notes on what had to be left out of it."""
    if (size := check_file(path)) > MAX_DBC:
        raise LogError(f"{path}: {size:,} bytes; a database may have {MAX_DBC:,}")
    return _load_dbc(str(path), read_bytes(path))


@functools.lru_cache(maxsize=8)
def _load_dbc(path: str, raw: bytes) -> tuple[list[Message], list[str]]:
    import cantools

    kind = Path(path).suffix.lower().lstrip(".")
    text = _decoded(raw)
    if kind in ("arxml", "kcd", "sym"):
        tries = [(text, False, "")]
    else:
        kind = "dbc"
        if "BO_ " not in text:
            raise LogError(f"{path}: is not a DBC (it defines no message, BO_)")
        tries = [(text, True, ""), (text, False, "")]
        for k in range(1, len(_DROP) + 1):
            gone = [word for words in _DROP[:k] for word in words]
            tries.append((_without(text, gone), False, "without its lines " + ", ".join(gone)))
    reason = ""
    for content, strict, lost in tries:
        try:
            db: Any = cantools.database.load_string(content, database_format=kind, strict=strict)
            messages = [_message(m) for m in db.messages]
        except Exception as e:  # cantools raises whatever its grammar meets
            reason = reason or " ".join(str(e).split())[:120]
            continue
        return messages, [f"{path}: read {lost} ({reason})"] if lost else []
    raise LogError(f"{path}: is not a database that cantools reads ({reason})")


def _decoded(raw: bytes) -> str:
    """The text of a database, which does not say how it is encoded: UTF-16 by its mark, UTF-8, else cp1252 as Vector's
    editors write it.

    A file that several editors have changed may hold lines of both kinds.
    """
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", errors="replace")
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return "".join(map(_line_decoded, raw.splitlines(keepends=True)))


def _line_decoded(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("cp1252", errors="replace")


def _without(text: str, gone: list[str]) -> str:
    """A database without the statements that begin with some words; what nobody ends with a semicolon stays."""
    begins, kept, at = re.compile(rf"^[ \t]*+(?:{'|'.join(gone)})[ \t]", re.M), [], 0
    while (start := begins.search(text, at)) is not None and (end := _STATEMENT.match(text, start.end())) is not None:
        kept.append(text[at : start.start()])
        at = end.end()
    return "".join([*kept, text[at:]])


def _message(m: Any) -> Message:
    """Read the attributes of a cantools message."""
    attributes = m.dbc.attributes if m.dbc is not None else {}

    def number(of: Any, key: str) -> int | None:
        attribute = of.get(key)
        return None if attribute is None else attribute.value

    missing = {}
    for s in m.signals:
        value = number(s.dbc.attributes if s.dbc is not None else {}, "NotAvailable")
        if isinstance(value, int):
            missing[s.name] = value
    e2e = number(attributes, "DataID") if number(attributes, "E2EProfile") in (1, "P01") else None
    frame_format = attributes.get("VFrameFormat")
    j1939 = m.protocol == "j1939" or (frame_format is not None and frame_format.value in (3, "J1939PG"))
    ident = m.frame_id | (EXTENDED if m.is_extended_frame else 0)
    proves = bool(number(attributes, "AuthenticatorOf"))
    return Message(m, ident, e2e, j1939 and m.is_extended_frame, missing, proves)
