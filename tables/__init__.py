"""Data of the engine, its controller and its bus, and the one function that reads and checks a table."""

from __future__ import annotations

import difflib
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

__all__ = ["Axis", "Bound", "Bounded", "InputError", "Quantity", "Table", "path", "read"]

_HERE = Path(__file__).parent
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]  # strict: neither "1.0" nor true is a number


class InputError(ValueError):
    """Something from outside cannot be used. One line: the thing, its value, what is allowed."""


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
    return _HERE / name


M = TypeVar("M", bound=BaseModel)


def read(source: str | Path, model: type[M]) -> M:
    """Read a TOML table into ``model``.

    source: a file's path, or the name of a shipped table such as ``plant.toml``.
    Raises InputError, in one line, naming file, key, value and what is allowed.
    """
    file = Path(source)
    try:
        if not file.is_file() and path(str(source)).is_file():
            file = path(str(source))
        data: dict[str, Any] = tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as e:
        raise _refusal(source, f"cannot be read ({e.strerror})") from None
    except (ValueError, RecursionError) as e:  # TOMLDecodeError, UnicodeDecodeError, a number of thousands of digits
        raise _refusal(file, f"not a TOML table ({e})") from None
    try:
        return model.model_validate(data)
    except ValidationError as e:
        raise _refusal(file, _complaint(e, model)) from None


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


def _inside(kind: Any, step: Any) -> Any:
    """Type of what is at ``step`` (a key, a position, the tag of a union's member) inside a value of type ``kind``."""
    if hasattr(kind, "model_fields"):
        field = kind.model_fields.get(step)
        return kind if field is None else field.annotation
    parts = get_args(kind)
    if get_origin(kind) is Annotated:
        return _inside(parts[0], step)
    if get_origin(kind) is list:
        return parts[0]
    members = [m for m in parts if hasattr(m, "model_fields")]
    return next((m for m in members if any(f.default == step for f in m.model_fields.values())), kind)
