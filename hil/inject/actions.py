"""What a scenario can do to the bus and to the machine: frames dropped, delayed, changed or sent, faults set.

Times are seconds from power-on of controller and ECU. Nothing here runs anything: `hil.inject` does.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from hil.bus import frames
from hil.logs.dbc import load_dbc
from plant.effects import EFFECTS
from vaneloop.base.tables import Table, path

__all__ = [
    "ACTIONS",
    "IDENTIFIERS",
    "Action",
    "AnyAction",
    "Babble",
    "BusOff",
    "ChannelFault",
    "Corrupt",
    "Delay",
    "Drop",
    "Duplicate",
    "ErrorFrames",
    "Flood",
    "Frame",
    "Freeze",
    "Link",
    "Machine",
    "Number",
    "OnBus",
    "OnFrame",
    "Outsider",
    "Override",
    "Positive",
    "Reorder",
    "Replay",
    "Seconds",
    "Send",
    "identifier",
    "raw_signal",
]  # fmt: skip

Frame = str | int
Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]  # strict: neither "1.0" nor true is a number
Seconds = Annotated[Number, Field(ge=0.0)]
Positive = Annotated[Number, Field(gt=0.0)]
Share = Annotated[Number, Field(gt=0.0, le=1.0)]
IDENTIFIERS = {name: ident for ident, name in (frames.NAMES | frames.AUTH_NAMES).items()}


@lru_cache(maxsize=1)
def layouts() -> dict[str, Any]:
    """Return the messages of ``vgv.dbc`` by name."""
    return {m.layout.name: m for m in load_dbc(path("vgv.dbc"))[0]}


def identifier(frame: Frame, extended: bool = False) -> int:
    """Return the identifier of a frame given by name or number; refuses other names, and numbers beyond 11 (extended:
    29) bits.
    """
    if isinstance(frame, str) and frame in IDENTIFIERS:
        return IDENTIFIERS[frame]
    try:
        ident = int(frame, 0) if isinstance(frame, str) else frame
    except ValueError:
        ident = -1
    last = 0x1FFFFFFF if extended else 0x7FF
    if not 0 <= ident <= last:
        raise ValueError(
            f"frame (={frame!r}) must be one of {', '.join(IDENTIFIERS)}, or an identifier from 0 to 0x{last:X}"
        )
    return ident


def raw_signal(frame: Frame, name: str, value: float) -> tuple[int, int]:
    """Return the bits of a signal's physical value and their mask, both within the frame's eight bytes (first byte
    lowest).
    """
    message = next((m for m in layouts().values() if m.ident == identifier(frame)), None)
    if message is None:
        raise ValueError(f"frame (={frame!r}) has no signals in vgv.dbc; frames with signals: {', '.join(IDENTIFIERS)}")
    signal = next((s for s in message.layout.signals if s.name == name), None)
    if signal is None:
        raise ValueError(
            f"signal (={name!r}) is not in {message.layout.name}; allowed: "
            f"{', '.join(s.name for s in message.layout.signals)}"
        )
    low, high = (
        (-(1 << signal.length - 1), (1 << signal.length - 1) - 1) if signal.is_signed else (0, (1 << signal.length) - 1)
    )
    raw = round((value - float(signal.offset)) / float(signal.scale))
    if not low <= raw <= high:
        a, b = (r * float(signal.scale) + float(signal.offset) for r in (low, high))
        raise ValueError(
            f"{name} (={value:g}) does not fit its bits in {message.layout.name}; allowed: {a:g} to {b:g} "
            f"{signal.unit or ''}".rstrip()
        )
    mask = ((1 << signal.length) - 1) << signal.start
    return (raw << signal.start) & mask, mask


# ---- actions ---------------------------------------------------------------------------------------------------------


class Action(Table):
    """Something done from ``start`` on for ``duration`` seconds (default: to the end)."""

    start: Seconds = 0.0
    duration: Positive | None = None

    @property
    def end(self) -> float:
        """Time at which it is over."""
        return math.inf if self.duration is None else self.start + self.duration


class OnFrame(Action):
    """Something done to frames on their way from the sender to the bus, as a faulty sender or gateway would.

    frame        which frames
    every        only each n-th of them
    probability  each with this chance (scenario's ``seed``)
    count        at most so many
    """

    frame: Frame = "ECU_DEMAND"
    every: Annotated[int, Field(ge=1)] = 1
    probability: Share = 1.0
    count: Annotated[int, Field(ge=1)] | None = None

    @field_validator("frame")
    @classmethod
    def _known(cls, frame: Frame) -> Frame:
        if identifier(frame) not in IDENTIFIERS.values():
            raise ValueError(f"frame (={frame!r}) is sent by neither node; allowed: {', '.join(IDENTIFIERS)}")
        return frame


class Drop(OnFrame):
    """The frame is not sent."""

    action: Literal["drop"] = "drop"


class Delay(OnFrame):
    """The frame is sent ``delay`` s later, and up to ``jitter`` s more, at random (which can change the order)."""

    action: Literal["delay"] = "delay"
    delay: Seconds
    jitter: Seconds = 0.0


class Duplicate(OnFrame):
    """The frame is sent ``copies`` times more, right behind itself."""

    action: Literal["duplicate"] = "duplicate"
    copies: Annotated[int, Field(ge=1, le=1000)] = 1


class Reorder(OnFrame):
    """Frames are held until ``window`` of them are there, and sent in reverse order."""

    action: Literal["reorder"] = "reorder"
    window: Annotated[int, Field(ge=2, le=100)] = 2


class Corrupt(OnFrame):
    """``bits`` random bits of the data are inverted, or those in ``at`` (0..63); or the frame is cut to ``length``
    bytes.
    """

    action: Literal["corrupt"] = "corrupt"
    bits: Annotated[int, Field(ge=0, le=64)] = 1
    at: list[Annotated[int, Field(ge=0, le=63)]] | None = None
    length: Annotated[int, Field(ge=0, le=7)] | None = None


class Freeze(OnFrame):
    """A signal keeps the value that it has at ``start``, while CRC and counter stay right (``e2e = "keep"``: the CRC
    stays as it was).
    """

    action: Literal["freeze"] = "freeze"
    signal: str
    e2e: Literal["right", "keep"] = "right"

    @model_validator(mode="after")
    def _signal(self) -> Freeze:
        raw_signal(self.frame, self.signal, 0.0)
        return self


class Override(OnFrame):
    """Signals are sent with other values, with right CRC and counter (``e2e = "keep"``: the CRC stays as it was)."""

    action: Literal["override"] = "override"
    signals: Annotated[dict[str, Number], Field(min_length=1)]
    e2e: Literal["right", "keep"] = "right"

    @model_validator(mode="after")
    def _signals(self) -> Override:
        for name, value in self.signals.items():
            raw_signal(self.frame, name, value)
        return self


class Outsider(Action):
    """Something that a third station on the bus sends."""


class Send(Outsider):
    """A frame, once or every ``period`` s: raw (``data`` in hex) or by ``signals`` with E2E protection.

    e2e      right, wrong_crc, wrong_counter (it never counts on), none (CRC and counter as the bytes have them)
    counter  of the first frame
    length   bytes sent, default all of ``data``, 8 with ``signals``
    secoc    of the authentication frame behind it: none, right (who sends has the key), stale (the same, but the
             freshness value of a second ago), wrong_mac (a random one), wrong_key
    """

    action: Literal["send"] = "send"
    frame: Frame
    data: str | None = None
    signals: dict[str, Number] | None = None
    e2e: Literal["right", "wrong_crc", "wrong_counter", "none"] | None = None
    counter: Annotated[int, Field(ge=0, le=15)] = 0
    period: Annotated[Number, Field(ge=0.001)] | None = None
    length: Annotated[int, Field(ge=0, le=8)] | None = None
    extended: bool = False
    remote: bool = False
    secoc: Literal["none", "right", "stale", "wrong_mac", "wrong_key"] = "none"

    @model_validator(mode="after")
    def _contents(self) -> Send:
        identifier(self.frame, self.extended)
        if (self.data is None) == (self.signals is None):
            raise ValueError("send takes either data (hex) or signals, and not both")
        if self.data is not None:
            try:
                raw = bytes.fromhex(self.data)
            except ValueError:
                raise ValueError(f"data (={self.data!r}) must be bytes in hex, for example '0011AABB'") from None
            if len(raw) > 8:
                raise ValueError(f"data (={self.data!r}) has {len(raw)} bytes; a classic CAN frame holds at most 8")
        for name, value in (self.signals or {}).items():
            raw_signal(self.frame, name, value)
        known = identifier(self.frame, self.extended) in frames.NAMES
        protected = ", ".join(frames.NAMES.values())
        if self.protection != "none" and not known:
            raise ValueError(f"e2e (={self.e2e!r}) needs a frame with a DataID in vgv.dbc: {protected}")
        if self.secoc != "none" and not known:
            raise ValueError(f"secoc (={self.secoc!r}) needs a frame that is authenticated: {protected}")
        return self

    @property
    def protection(self) -> str:
        """``e2e``, by default right with signals and none with raw data."""
        signals = self.signals is not None and identifier(self.frame) not in frames.AUTH_NAMES
        return self.e2e or ("right" if signals else "none")


class Flood(Outsider):
    """Frames of one identifier, or random ones from ``frame`` to ``last``, random data, ``rate`` a second (default: all
    the bus takes).
    """

    action: Literal["flood"] = "flood"
    frame: Frame = 0x7FF
    last: Frame | None = None
    rate: Annotated[Number, Field(gt=0.0, le=1e5)] | None = None

    @model_validator(mode="after")
    def _range(self) -> Flood:
        if self.last is not None and identifier(self.last) < identifier(self.frame):
            raise ValueError(f"last (={self.last!r}) must not be below frame (={self.frame!r})")
        identifier(self.frame)
        return self


class Babble(Outsider):
    """A babbling idiot: identifier 0, which wins every arbitration, without a pause."""

    action: Literal["babble"] = "babble"


class Replay(Outsider):
    """Old frames again, with their old spacing, over and over if ``loop``.

    log            a log that holds frames alone (candump, BLF, ...), or instead of it
    begin, length  s: what was on the bus in this run from ``begin`` on for ``length``
    frame          only this one
    """

    action: Literal["replay"] = "replay"
    log: str | None = None
    begin: Seconds | None = None
    length: Positive = 1.0
    frame: Frame | None = None
    loop: bool = True

    @model_validator(mode="after")
    def _source(self) -> Replay:
        if (self.log is None) == (self.begin is None):
            raise ValueError("replay takes either log (a file) or begin (s, of this run), and not both")
        if self.begin is not None and self.begin + self.length > self.start + 1e-9:  # 0.1 + 0.2 is more than 0.3
            raise ValueError(
                f"begin + length (={self.begin + self.length:g} s) must not be after start (={self.start:g} s)"
            )
        if self.frame is not None:
            identifier(self.frame)
        return self


class OnBus(Action):
    """Something that happens to the bus itself."""


class ErrorFrames(OnBus):
    """Frames on the wire are destroyed by error frames, each with ``probability``; the senders try again, as
    CAN does.
    """

    action: Literal["error_frames"] = "error_frames"
    probability: Share = 1.0


class BusOff(OnBus):
    """A node is in bus-off at ``start``, neither sends nor hears, and recovers when the standard allows it, or after
    ``duration``.
    """

    action: Literal["bus_off"] = "bus_off"
    node: Literal["ECU", "VGV"] = "ECU"


class Machine(Action):
    """The machine itself: supply pressure ``p_s`` (MPa), oil temperature ``t_oil`` (degC), an ``effect`` and its
    ``parameters``; of two actuators the effect of one ``side`` alone.
    """

    action: Literal["machine"] = "machine"
    p_s: Annotated[Number, Field(ge=0.0, le=40.0)] | None = None
    t_oil: Annotated[Number, Field(ge=-60.0, le=200.0)] | None = None
    effect: str | None = None
    parameters: dict[str, Number] = {}
    side: Literal["a", "b"] | None = None

    @model_validator(mode="after")
    def _known(self) -> Machine:
        if self.effect is None:
            if self.p_s is None and self.t_oil is None:
                raise ValueError("machine takes p_s, t_oil or effect")
            if self.parameters or self.side:
                raise ValueError(f"{'parameters need' if self.parameters else 'side needs'} an effect")
            return self
        if self.effect not in EFFECTS:
            raise ValueError(f"effect (={self.effect!r}) must be one of {', '.join(EFFECTS)}")
        known = {q.name: q for q in EFFECTS[self.effect].parameters}
        for name, value in self.parameters.items():
            if name not in known:
                raise ValueError(f"parameters.{name} is not one of {self.effect}'s: {', '.join(known)}")
            q = known[name]
            if not q.low <= value <= q.high:
                raise ValueError(f"parameters.{name} (={value:g} {q.unit}) must be in [{q.low:g}, {q.high:g}]")
        return self


class ChannelFault(Action):
    """One of two channels of the controller: it is switched ``off``, and on again at the end; its coil is open or
    shorted; its LVDT gives nothing (``lvdt_lost``) or the stroke of ``start`` (``lvdt_frozen``).
    """

    action: Literal["channel"] = "channel"
    channel: Literal["A", "B"]
    fault: Literal["off", "coil_open", "coil_short", "lvdt_lost", "lvdt_frozen"]


class Link(Action):
    """The link between two channels: messages come ``delay`` s later, and the share ``loss`` of them is lost (1: all);
    of those that the ``sender`` sends.
    """

    action: Literal["link"] = "link"
    delay: Annotated[Number, Field(ge=0.0, le=0.2)] = 0.0
    loss: Annotated[Number, Field(ge=0.0, le=1.0)] = 0.0
    sender: Literal["A", "B", "both"] = "both"

    @model_validator(mode="after")
    def _does_something(self) -> Link:
        if self.delay == self.loss == 0.0:
            raise ValueError("link takes delay or loss")
        return self


AnyAction = Annotated[
    Drop
    | Delay
    | Duplicate
    | Reorder
    | Corrupt
    | Freeze
    | Override
    | Send
    | Flood
    | Babble
    | Replay
    | ErrorFrames
    | BusOff
    | Machine
    | ChannelFault
    | Link,
    Field(discriminator="action"),
]
ACTIONS: dict[str, type[Action]] = {
    str(c.model_fields["action"].default): c
    for c in (
        Drop,
        Delay,
        Duplicate,
        Reorder,
        Corrupt,
        Freeze,
        Override,
        Send,
        Flood,
        Babble,
        Replay,
        ErrorFrames,
        BusOff,
        Machine,
        ChannelFault,
        Link,
    )
}
