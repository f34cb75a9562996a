"""Data of the engine, its controller and its bus, and the one function that reads and checks a table."""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from vaneloop.base.errors import InputError

__all__ = ["Axis", "Bound", "Bounded", "Quantity", "Table", "file_of", "load_toml", "path", "read"]

_ROOM = Path(__file__).parent.parent
MOST_BYTES = (
    1 << 20
)  # of a TOML file; the largest shipped has 6 kB. The parser takes up to 600 bytes for each of dotted keys
MOST_PARTS = 16  # of a dotted key: the parser's memory grows with their square, 6.8 GB for 50,000
MOST_LETTERS = 1_000  # of a word or number; the parser slows down on longer ones
_PART = rb"""(?:[A-Za-z0-9_-]++|"(?!"")(?:[^"\\\n]|\\[^\n])*+"|'(?!'')[^'\n]*+')"""
# The words of a TOML file, each read once from the left: keys, words and numbers that are too long, other keys and
# texts, and a quotation that nobody ends, where the parser stops, too.
_WORDS = re.compile(
    rb"(?P<word>[A-Za-z0-9_-]{%(letters)d})|(?P<long>%(part)s(?:[ \t]*+\.[ \t]*+%(part)s){%(most)d})|%(part)s"
    rb'|"""(?:[^"\\]|\\.|"(?!""))*+"""(?:"{0,2}+)'
    rb"|\'\'\'(?:[^\']|\'(?!\'\'))*+\'\'\'(?:\'{0,2}+)"
    rb"|(?P<open>[\"'])|\#[^\n]*+|[^A-Za-z0-9_\"'\#-]++"
    % {b"part": _PART, b"most": MOST_PARTS, b"letters": MOST_LETTERS + 1},
    re.DOTALL,
)
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]  # strict: neither "1.0" nor true is a number


class Table(BaseModel):
    """A table file or a part of one: unknown and missing keys are refused, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Quantity(Table):
    """A physical number with its unit and where it comes from.

    value      in ``unit``
    unit       checked against what the model that holds it expects (`unit_of`)
    origin     published (where), derived (how) or chosen (why)
    tolerance  half-width of the plausible interval around ``value``, in ``unit``; 0 = exactly known.
               A parameter that moved within it is recalibrated, not a missing effect.
    """

    value: Finite
    unit: str
    origin: str = Field(min_length=4)
    tolerance: Annotated[Finite, Field(ge=0)] = 0.0


class Axis(Table):
    """A list of numbers with one unit and one origin, for example the breakpoints of a schedule."""

    values: Annotated[list[Finite], Field(min_length=2)]
    unit: str
    origin: str = Field(min_length=4)

    def increasing(self, key: str) -> Axis:
        """Return self, or refuse a list that is not strictly increasing, naming ``key``."""
        for i, (a, b) in enumerate(zip(self.values, self.values[1:], strict=False)):
            if not b > a:
                raise ValueError(f"{key}.values[{i + 1}] (={b:g}) must be greater than the value before it (={a:g})")
        return self


class Bound:
    """Marks a `Quantity` field with the unit it must have and the range its value must lie in."""

    def __init__(self, unit: str, low: float = -math.inf, high: float = math.inf):
        self.unit, self.low, self.high = unit, low, high


class Bounded(Table):
    """A table whose `Quantity` fields carry a `Bound` in their annotation, checked on reading."""

    @model_validator(mode="after")
    def _check_bounds(self) -> Bounded:
        for key, field in type(self).model_fields.items():
            bound = next((m for m in field.metadata if isinstance(m, Bound)), None)
            q = getattr(self, key)
            if bound is None or not isinstance(q, Quantity | Axis):
                continue
            if q.unit != bound.unit:
                raise ValueError(f"{key}.unit (={q.unit!r}) must be {bound.unit!r}")
            for v in q.values if isinstance(q, Axis) else [q.value]:
                if not bound.low <= v <= bound.high:
                    raise ValueError(f"{key} (={v:g} {q.unit}) must be in [{bound.low:g}, {bound.high:g}]")
        return self


def path(name: str) -> Path:
    """Return the path of a shipped data file, for example ``vgv.dbc``."""
    beside = _ROOM / "tables"  # in an installed package; in a checkout the folder stands at the top
    return (beside if beside.is_dir() else _ROOM.parent / "tables") / name


def load_toml(file: str | Path) -> dict[str, Any]:
    """The content of a TOML file, as it stands.

    Raises InputError in one line for what cannot be read, is no TOML, has more than `MOST_BYTES` or a key of more than
    `MOST_PARTS` parts: the parser would take more memory for it than any table of ours is worth.
    """
    return _parsed(file, _bytes_of(file))


def _bytes_of(file: str | Path) -> bytes:
    try:
        with Path(file).open("rb") as f:
            return f.read(MOST_BYTES + 1)
    except OSError as e:
        raise _refusal(file, f"cannot be read ({e.strerror})") from None
    except ValueError as e:  # a name with a null byte in it
        raise _refusal(file, f"not a TOML table ({e})") from None


def _parsed(file: str | Path, raw: bytes) -> dict[str, Any]:
    try:
        if len(raw) > MOST_BYTES:
            raise _refusal(file, f"is longer than a TOML table may be ({MOST_BYTES:,} bytes)")
        stop = next((m for m in _WORDS.finditer(raw) if m.lastgroup), None)
        if stop is not None and stop.lastgroup != "open":
            start, line = stop[0][:30].decode("utf-8", "replace"), raw.count(b"\n", 0, stop.start()) + 1
            if stop.lastgroup == "word":
                raise _refusal(file, f"line {line}: {start}... is too long a word; allowed: {MOST_LETTERS:,} letters")
            raise _refusal(file, f"line {line}: key {start}... has too many dotted parts; allowed: {MOST_PARTS}")
        return tomllib.loads(raw.decode("utf-8-sig").replace("\r\n", "\n"))
    except InputError:
        raise
    except (ValueError, RecursionError) as e:  # TOMLDecodeError, UnicodeDecodeError, a number of thousands of digits
        raise _refusal(file, f"not a TOML table ({e})") from None


def file_of(source: str | Path) -> Path:
    """Return the file that ``source`` names: a path, or the name of a shipped table such as ``plant.toml``."""
    file = Path(source)
    try:
        if not file.is_file() and path(str(source)).is_file():
            file = path(str(source))
    except (OSError, ValueError) as e:  # a name with a null byte in it
        raise _refusal(source, f"cannot be read ({getattr(e, 'strerror', None) or e})") from None
    return file


M = TypeVar("M", bound=BaseModel)


def read(source: str | Path, model: type[M]) -> M:
    """Read a TOML table into ``model``.

    source: a file's path, or the name of a shipped table such as ``plant.toml``.
    Raises InputError, in one line, naming file, key, value and what is allowed.
    """
    file = file_of(source)
    return (_shipped if file.parent == path("") else _read)(file, _bytes_of(file), model)


def _read(file: Path, raw: bytes, model: type[M]) -> M:
    data = _parsed(file, raw)
    try:
        return model.model_validate(data)
    except ValidationError as e:
        raise _refusal(file, _complaint(e, model)) from None


# Every machine and every controller is made of the same few tables: of a shipped one, what was read is shared.
_shipped = lru_cache(maxsize=32)(_read)


def _refusal(file: str | Path, why: str) -> InputError:
    return InputError(" ".join(f"{file}: {why}".split()))


def _complaint(e: ValidationError, model: type[BaseModel]) -> str:
    """What matters most of pydantic's complaints, as ``key (=value): what is allowed``.

    A misspelt key is both unknown and missing: it is told as unknown, with the key that was probably meant.
    """
    errors = e.errors()
    err = next((x for x in errors if x["type"] == "extra_forbidden"), errors[0])
    key = ".".join(str(p) for p in err["loc"])
    more = "" if len(errors) == 1 else f" (and {len(errors) - 1} more)"
    if err["type"] in ("missing", "extra_forbidden"):
        allowed = _allowed(model, err["loc"][:-1])
        meant = difflib.get_close_matches(str(err["loc"][-1]), allowed, 1) if err["type"] == "extra_forbidden" else []
        hint = f", probably {meant[0]!r} is meant" if meant else ""
        kind = "missing" if err["type"] == "missing" else "unknown"
        return f"key {key!r} is {kind}{hint}; allowed here: {', '.join(allowed)}{more}"
    if err["type"] in ("union_tag_invalid", "union_tag_not_found"):
        kind, got = err["ctx"]["discriminator"].strip("'"), err["ctx"].get("tag")
        if got is None:
            return f"{key}: key {kind!r} is missing{more}"
        return f"{key}.{kind} (={_short(got)}): must be one of {err['ctx']['expected_tags']}{more}"
    message = err["msg"].removeprefix("Value error, ")
    if err["type"] == "value_error":
        return f"{key}{': ' if key else ''}{message}{more}"
    if err["type"] in ("model_type", "model_attributes_type"):
        message = f"must be a table with the keys {', '.join(_allowed(model, err['loc']))}"
    return f"{key} (={_short(err['input'])}): {message}{more}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _allowed(model: type[BaseModel], loc: tuple[Any, ...]) -> list[str]:
    """Names of the keys allowed at ``loc`` inside ``model``."""
    here: Any = model
    for step in loc:
        here = _inside(here, step)
    return list(getattr(here, "model_fields", {}))


def _there(kind: Any) -> Any:
    """The type of what may be left out: X of ``X | None``."""
    parts = [p for p in get_args(kind) if p is not type(None)]
    return parts[0] if len(parts) == 1 < len(get_args(kind)) else kind


def _inside(kind: Any, step: Any) -> Any:
    """Type of what is at ``step`` (a key, a position, the tag of a union's member) inside a value of type ``kind``."""
    if hasattr(kind, "model_fields"):
        field = kind.model_fields.get(step)
        return kind if field is None else _there(field.annotation)
    parts = get_args(kind)
    if get_origin(kind) is Annotated:
        return _inside(parts[0], step)
    if get_origin(kind) is list:
        return parts[0]
    members = [m for m in parts if hasattr(m, "model_fields")]
    return next((m for m in members if any(f.default == step for f in m.model_fields.values())), kind)
