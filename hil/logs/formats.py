"""The one list of log formats: what each is called, how it is known, and what reads, writes and records it.

A part of a format is a function, or the place of one as ``"module:function"``, which is imported when it is first used:
who reads a CSV imports no reader of CAN, and who asks for help imports none at all.

Formats of other packages come by entry points of the group `GROUP`, as ``".rig" = "rig_logs:RIG"``. They are looked for
where a suffix is none of ours, and loaded where a file has theirs.
"""

from __future__ import annotations

import contextlib
import pkgutil
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.logs.errors import LogError
from vaneloop.base.errors import InputError
from vaneloop.base.extras import EXTRAS, needs

if TYPE_CHECKING:
    from hil.logs.frames import Frames
    from hil.logs.record_formats import FramesOfRecord, RecordFormat
    from hil.logs.source import Channel, Options, Source

__all__ = [
    "FORMATS", "GROUP", "OURS", "Format", "format_at", "format_of", "is_framed", "listed", "spoken", "suffixes",
    "with_part",
]  # fmt: skip

GROUP = "vaneloop.log_formats"
_SUFFIX = re.compile(r"\.[a-z0-9_+-]{1,20}")  # as a script of `vaneloop completion` can hold it
_FRAMES_SEEN = "hil.logs.bus_log:open_bus_log"
_FRAMES_MADE = "hil.logs.bus_log:encode_channels"
_ARCHIVE = b"PK\x03\x04"
_CHECK = "hil.logs.source:check_file"
_SOURCE = ("kind", "names", "notes", "sorted", "series", "has", "absent")  # what each has
_READ = ("source", "frames", "recording", "said")
_PARTS = ("source", "channels", "frames", "frames_out", "recorder", "recording", "said")

Part = str | Callable[..., Any] | None


@dataclass(frozen=True)
class Format:
    """A format of logs: what is known of it without a file, and its parts.

    name        as engineers call it
    suffixes    how its files' names end, with the point
    about       what it is, and which of its kinds are read
    names       what the names in it are
    begins      what a file of it begins with, one of these; empty where nothing marks it. Of formats that share a
                suffix all but one have it
    framed      it may hold frames of a bus, for which there is a database
    packed      its files are compressed
    extra       of VaneLoop, that it needs (`vaneloop.base.extras`)

    Parts, None where the format cannot do it:

    source      (path, Options) -> Source: opens a file. A format that holds nothing but frames needs none
    channels    (path, channels, database or None): writes channels. Likewise
    frames      path -> Frames: reads a file that holds nothing but frames
    frames_out  (path, Frames): writes one
    recorder    (path, name of the bus) -> RecordFormat: begins a recording of frames
    recording   path -> FramesOfRecord: reads a recording back
    said        path -> dict: ``engine`` and ``time``, as far as a file says them of itself
    """

    name: str
    suffixes: tuple[str, ...]
    about: str = ""
    names: str = "channels"
    begins: tuple[bytes, ...] = ()
    framed: bool = False
    packed: bool = False
    extra: str = ""
    source: Part = None
    channels: Part = None
    frames: Part = None
    frames_out: Part = None
    recorder: Part = None
    recording: Part = None
    said: Part = None

    def check(self, path: Path) -> None:
        """Raise InputError where the extra is not installed that the format needs."""
        if self.extra:
            needs(f"{path}: {self.name}", *EXTRAS[self.extra])

    def open(self, path: Path, options: Options) -> Source:
        """Open a file; frames are seen through the database."""
        if self.source is None and self.frames is not None:
            return _function(_FRAMES_SEEN)(self.read_frames(path), options)
        return self._part("source", path, "be read")(path, options)

    def write(self, path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
        """Write channels; as frames of the database (default: the product's own) where the format holds frames."""
        self.check(path)
        if self.channels is None and self.frames_out is not None:
            self.write_frames(path, _function(_FRAMES_MADE)(channels, dbc, path))
        else:
            self._part("channels", path, "be written")(path, channels, dbc)

    def read_frames(self, path: Path) -> Frames:
        """The frames of a file that holds nothing else."""
        return self._part("frames", path, "be read as frames")(path)

    def write_frames(self, path: Path, frames: Frames) -> None:
        """Write frames as they are."""
        self._part("frames_out", path, "be written as frames")(path, frames)

    def record(self, path: Path, channel: str) -> RecordFormat:
        """Begin a recording of frames of the bus ``channel``."""
        return self._part("recorder", path, "be recorded to")(path, channel)

    def read_recording(self, path: Path) -> FramesOfRecord:
        """The frames of a recording."""
        return self._part("recording", path, "be read as a recording")(path)

    def said_by(self, path: Path) -> dict[str, str]:
        """What a file says of itself: ``engine``, ``time``."""
        return {} if self.said is None else self._part("said", path, "be asked")(path)

    def _part(self, name: str, path: Path, what: str) -> Callable[..., Any]:
        part: Part = getattr(self, name)
        if part is None:
            raise LogError(f"{path}: {self.name} cannot {what}; allowed: {listed(with_part(name))}")
        return _function(part)


def _function(part: str | Callable[..., Any]) -> Callable[..., Any]:
    """The function of a part, imported now if only its place is known."""
    return pkgutil.resolve_name(part) if isinstance(part, str) else part


# --- ours -------------------------------------------------------------------------------------------------------------

_SIGNALS = "signals of a DBC"

OURS = (
    Format(
        "candump", (".log",), "candump (`candump -l`, or the console form with `-ta`), classic CAN and CAN FD",
        names=_SIGNALS, framed=True,
        frames="hil.logs.candump:read_candump", frames_out="hil.logs.candump:write_candump",
        recorder="hil.logs.record_formats:CandumpRecord", recording="hil.logs.recordings:read_candump",
    ),
    Format(
        "BUSMASTER", (".log",), "BUSMASTER log in `HEX`, a file that begins with `***BUSMASTER`", names=_SIGNALS,
        begins=(b"***BUSMASTER",), framed=True, frames="hil.logs.tool_traces:read_busmaster",
    ),
    Format(
        "Microchip CAN BUS Analyzer", (".can", ".log"), "log of Microchip's CAN BUS Analyzer, a file that begins with "
        "`//---`",
        names=_SIGNALS, begins=(b"//---",), framed=True, frames="hil.logs.tool_traces:read_microchip",
    ),
    Format(
        "CRTD", (".crtd", ".crt"), "CRTD of the Open Vehicle Monitoring System", names=_SIGNALS, framed=True,
        frames="hil.logs.tool_traces:read_crtd",
    ),
    Format(
        "Vector ASCII", (".asc",), "Vector ASCII, classic and FD, `base hex`, times absolute or relative",
        names=_SIGNALS, begins=(b"date ",), framed=True,
        frames="hil.logs.tool_traces:read_asc", frames_out="hil.logs.through_can:write_asc",
        recording="hil.logs.recordings:read_text",
    ),
    Format(
        "BLF", (".blf",), "Vector binary, classic and FD",
        names=_SIGNALS, begins=(b"LOGG",), framed=True, packed=True,
        frames="hil.logs.blf:read_blf", frames_out="hil.logs.through_can:write_blf",
        recorder="hil.logs.through_can:BlfRecord", recording="hil.logs.recordings:read_blf",
    ),
    Format(
        "PEAK trace", (".trc",), "PEAK trace, versions 1.0 to 1.3, 2.0, 2.1",
        names=_SIGNALS, begins=(b";$FILEVERSION",), framed=True,
        frames="hil.logs.tool_traces:read_trc", frames_out="hil.logs.through_can:write_trc",
        recording="hil.logs.recordings:read_text",
    ),
    Format(
        "CANHacker", (".trc",), "CANHacker trace, a file that begins with `Time   ID     DLC`", names=_SIGNALS,
        begins=(b"Time   ID ", b"CANHacker"), framed=True, frames="hil.logs.tool_traces:read_canhacker",
    ),
    Format(
        "CARBUS Analyzer", (".trc",), "CARBUS Analyzer trace, versions 2 and 3, a file that begins with `@ TEXT @`",
        names=_SIGNALS, begins=(b"@ TEXT @",), framed=True, frames="hil.logs.tool_traces:read_carbus",
    ),
    Format(
        "MDF4", (".mf4",), "MDF 4: CAN bus logging, or channel groups; found out from the content",
        names=f"{_SIGNALS}, or channels", begins=(b"MDF     4", b"UnFinMF 4"), framed=True, packed=True, extra="mdf",
        source="hil.logs.mdf:open_mdf", channels="hil.logs.mdf_write:write_mdf",
        frames_out="hil.logs.mdf_write:write_bus",
        recorder="hil.logs.mdf_write:MdfRecord", recording="hil.logs.mdf:read_record_mdf",
    ),
    Format(
        "MDF3", (".dat", ".mdf"), "MDF 2 and 3: channel groups, as INCA and CANape wrote them",
        names="channels", begins=(b"MDF     3", b"MDF     2"), extra="mdf",
        source="hil.logs.mdf:open_mdf", channels="hil.logs.mdf_write:write_mdf3",
    ),
    Format(
        "CSV", (".csv",), "a header, perhaps with units below and lines before it; `,` `;` or tab; decimal point or "
        "comma; one time or one a column",
        names="columns",
        source="hil.logs.csv_format:open_csv", channels="hil.logs.csv_format:write_csv",
        recording="hil.logs.recordings:read_text",
    ),
    Format(
        "Megasquirt log", (".msl",), "as written by TunerStudio and MegaLogViewer: a CSV with tabs",
        names="columns", source="hil.logs.csv_format:open_csv", channels="hil.logs.csv_format:write_msl",
    ),
    Format(
        "LabVIEW measurement", (".lvm",), "one time for all channels or one for each, or none but the step",
        names="columns", begins=(b"LabVIEW Measurement",),
        source="hil.logs.csv_format:open_csv", channels="hil.logs.csv_format:write_lvm",
    ),
    Format(
        "frames in CSV", (".csv",), "a row a frame, as SavvyCAN and GVRET, CANedge or python-can write it; told by the "
        "header",
        names=_SIGNALS,
        begins=(b"Time Stamp,ID,Extended,", b"TimestampEpoch;BusChannel;ID;IDE;", b"timestamp,arbitration_id,"),
        framed=True, frames="hil.logs.tool_traces:read_csv_frames", recording="hil.logs.recordings:read_text",
    ),
    Format(
        "Parquet", (".parquet",), "flat, numeric columns; time may be a timestamp",
        names="columns", begins=(b"PAR1",), packed=True,
        source="hil.logs.parquet_format:open_parquet", channels="hil.logs.parquet_format:write_parquet",
        recorder="hil.logs.record_parquet:ParquetRecord", recording="hil.logs.record_parquet:read_parquet",
        said="hil.logs.parquet_format:said_by_parquet",
    ),
)  # fmt: skip
FORMATS: dict[str, Format] = {  # those of ours that are written, too, by suffix
    suffix: f for f in OURS if f.channels or f.frames_out for suffix in f.suffixes
}


# --- formats of other packages ----------------------------------------------------------------------------------------


def _foreign() -> dict[str, metadata.EntryPoint]:
    """Formats of other packages by suffix, none of them loaded. None has a suffix of ours."""
    found: dict[str, metadata.EntryPoint] = {}
    for entry in metadata.entry_points(group=GROUP):
        suffix = "." + entry.name.lower().removeprefix(".")
        if not any(suffix in f.suffixes for f in OURS) and _SUFFIX.fullmatch(suffix):
            found.setdefault(suffix, entry)
    return found


def _loaded(path: str | Path, suffix: str, entry: metadata.EntryPoint) -> Format:
    """The format of another package, with parts that raise LogError. Raises LogError where there is no such format."""
    package = f"package {entry.dist.name}" if entry.dist is not None else "a package"
    whose = f"{path}: {suffix} is a format of {package} ({entry.value})"
    try:
        found = entry.load()
    except (Exception, SystemExit) as e:  # whatever the import of foreign code ends with
        raise LogError(f"{whose}, which cannot be loaded ({type(e).__name__}: {e})") from None
    if not isinstance(found, Format):
        raise LogError(f"{whose}, which is {type(found).__name__}, not hil.logs.Format")
    if suffix not in found.suffixes:
        raise LogError(f"{whose}, whose suffixes are {listed([found]) or 'none'}")
    parts: dict[str, Any] = {name: part for name in _PARTS if (part := getattr(found, name)) is not None}
    parts = {name: _guarded(part, name, whose) for name, part in parts.items()}
    return replace(found, extra="", **parts)


def _guarded(part: str | Callable[..., Any], name: str, whose: str) -> Callable[..., Any]:
    """A part whose failure is a line of its own: whose it is, and what it raised."""

    def call(path: Path, *given: Any) -> Any:
        if name in _READ:
            _function(_CHECK)(path)
        made = _said_clearly(_function, whose)(part)
        # what a recorder meets on a full disk is told as of our own
        made = made(path, *given) if name == "recorder" else _said_clearly(made, whose)(path, *given)
        return _clear_source(made, whose) if name == "source" else made

    return call


def _said_clearly(function: Callable[..., Any], whose: str) -> Callable[..., Any]:
    """The function of another package, which raises InputError in one line, whatever it raises."""

    def call(*given: Any) -> Any:
        try:
            return function(*given)
        except InputError:
            raise
        except Exception as e:
            raise LogError(f"{whose}, which fails at it ({type(e).__name__}: {e})") from None

    return call


def _clear_source(source: Any, whose: str) -> Any:
    """A source of another package whose methods raise InputError. Raises LogError for what is no source."""
    if lacking := next((a for a in _SOURCE if not hasattr(source, a)), ""):
        raise LogError(f"{whose}, which opens it as {type(source).__name__}: that is no Source, it has no {lacking}")
    for method in ("series", "has", "absent", "times"):
        if hasattr(source, method):
            setattr(source, method, _said_clearly(getattr(source, method), whose))
    return source


# --- what the others ask ----------------------------------------------------------------------------------------------


def suffixes() -> tuple[str, ...]:
    """Suffixes of all logs, ours first. No package is loaded for it."""
    return (*dict.fromkeys(s for f in OURS for s in f.suffixes), *_foreign())


def with_part(part: str) -> list[Format]:
    """The formats that have a part. Those of other packages are loaded for it; what cannot be is left out."""
    found = list(OURS)
    for suffix, entry in _foreign().items():
        with contextlib.suppress(LogError):
            found.append(_loaded(suffix, suffix, entry))
    return [f for f in found if getattr(f, part) is not None]


def listed(formats: Iterable[Format]) -> str:
    """Suffixes in words: ``.log, .blf, .mf4``."""
    return ", ".join(dict.fromkeys(s for f in formats for s in f.suffixes))


def spoken(formats: Iterable[Format]) -> str:
    """Names and suffixes in words: ``candump (.log), BLF (.blf) or MDF4 (.mf4)``."""
    *most, last = (f"{f.name} ({', '.join(f.suffixes)})" for f in formats)
    return f"{', '.join(most)} or {last}" if most else last


def format_of(
    path: Path, part: str = "", says: str = "is not a log's", tell: Callable[[Iterable[Format]], str] = listed
) -> Format:
    """The format that a file's suffix names; with a ``part``, one that has it.

    Raises LogError where there is none: what the suffix is or is not (``says``), and the allowed ones (``tell``).
    """
    suffix = path.suffix.lower()
    found = FORMATS.get(suffix) or next((f for f in OURS if suffix in f.suffixes), None)
    if found is None and (entry := _foreign().get(suffix)) is not None:
        found = _loaded(path, suffix, entry)
    if found is None or (part and getattr(found, part) is None):
        allowed = tell(with_part(part)) if part else ", ".join(suffixes())
        raise LogError(f"{path}: suffix {path.suffix!r} {says}; allowed: {allowed}{'' if part else _told(path)}")
    return found


def format_at(path: Path, part: str = "", says: str = "is not a log's") -> Format:
    """The format of a file that is there: as of `format_of`, and where formats share the suffix, by how it begins."""
    alike = [f for f in OURS if path.suffix.lower() in f.suffixes]
    head = _head(path) if len(alike) > 1 else b""
    found = next((f for f in alike if head.startswith(f.begins)), None)
    told = found is not None and (not part or getattr(found, part) is not None)
    return found if found is not None and told else format_of(path, part, says)


def is_framed(path: Path) -> bool:
    """Whether a file may hold frames of a bus."""
    with contextlib.suppress(LogError):
        return format_at(path).framed
    return False


def _head(path: Path) -> bytes:
    """How a file begins, behind the mark of UTF-8; empty where it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(64).removeprefix(b"\xef\xbb\xbf") if path.is_file() else b""
    except (OSError, ValueError):
        return b""


def _told(path: Path) -> str:
    """What the content of a file says, whose suffix says nothing."""
    head = _head(path)
    if head.startswith(_ARCHIVE):
        return "; it is a workbook, or another archive: save its table as CSV"
    return next((f"; it begins as {f.name} does ({f.suffixes[0]})" for f in OURS if head.startswith(f.begins)), "")
