"""Channels of a run as a frame: by name, cut by time, on one raster, as a `pandas.DataFrame`. pandas is imported only
where a frame of it is asked for.
"""

from __future__ import annotations

from collections.abc import ItemsView, Iterator, KeysView, Mapping, ValuesView
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, overload

import numpy as np

from hil.logs.errors import LogError
from hil.logs.formula import formula_of
from vaneloop.base.errors import meant
from vaneloop.base.extras import needed
from vaneloop.base.notebook import html_table
from vaneloop.base.signals import heading
from vaneloop.base.spans import Span, span_of

if TYPE_CHECKING:
    from numpy.typing import DTypeLike
    from pandas import DataFrame, Series

__all__ = ["Channel", "Channels", "NoChannel", "raster"]

Self = TypeVar("Self", bound="Channels")
SHOWN = 8  # names in a line that says what there is


class NoChannel(LogError, KeyError):
    """A name that is none of the channels."""

    __str__ = ValueError.__str__  # that of KeyError shows the line in quotes


def _part(asked: slice) -> Span:
    """The part of a run that a slice in s asks for."""
    if asked.step is not None:
        raise LogError(f"step (={asked.step!r}) of a slice must be left out: a log is cut by its time, log[10:20]")
    return span_of((asked.start, asked.stop), "log[FROM:TO]")


@dataclass(frozen=True, repr=False)
class Channel:
    """Samples of one signal, each with its time.

    numpy takes it for its values: ``np.mean(channel)``. ``channel[10:20]`` is what was sampled from 10 s to before
    20 s.

    Attributes
    ----------
    t : numpy.ndarray
        s, strictly increasing.
    values : numpy.ndarray
        In the signal's unit, finite.
    framed : bool
        It came in the frames of a bus: a value holds from its frame on. Else it was polled, sampled or resampled.
    unit : str
        Of the values; "": not known.
    apart : float
        s from one true sample to the next, where an exporter joined them by straight lines; 0: each is one.
    """

    t: np.ndarray
    values: np.ndarray
    framed: bool = False
    unit: str = ""
    apart: float = 0.0

    def __len__(self) -> int:
        """How many samples there are."""
        return len(self.t)

    def __bool__(self) -> bool:
        """Whether there is a channel: there is."""
        return True

    def __iter__(self) -> Iterator[float]:
        """Each value in turn."""
        return iter(self.values)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        """Its values, for numpy."""
        return np.array(self.values, dtype=dtype, copy=copy)

    def __getitem__(self, part: slice) -> Channel:
        """What was sampled in a part of the log, from and to in s of its own time."""
        if not isinstance(part, slice):
            raise LogError(f"channel[{part!r}]: allowed: a slice in s, such as channel[10:20]; .values has the samples")
        span = _part(part)
        low, high = (int(k) for k in np.searchsorted(self.t, [span.low, span.high]))
        return replace(self, t=self.t[low:high], values=self.values[low:high])

    def __repr__(self) -> str:
        """Size, time and range on one line."""
        unit = f" {self.unit}" if self.unit not in ("", "-") else ""
        if not len(self):
            return f"Channel(no sample{unit})"
        low, high = float(np.min(self.values)), float(np.max(self.values))
        return f"Channel({len(self):,} samples, {self.t[0]:.6g} to {self.t[-1]:.6g} s, {low:.4g} to {high:.4g}{unit})"

    def to_pandas(self) -> Series:
        """The samples as a ``pandas.Series``: its index is the time in s, ``attrs["unit"]`` the unit.

        Raises InputError where pandas is not installed.
        """
        pandas = needed("to_pandas", "pandas")
        series = pandas.Series(self.values, index=pandas.Index(self.t, name="t"))
        series.attrs["unit"] = self.unit
        return series


def raster(channels: Mapping[str, Channel]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """All times of all channels, and each channel on them, NaN where it has no sample."""
    t = np.unique(np.concatenate([c.t for c in channels.values()])) if channels else np.empty(0)
    columns = {}
    for name, c in channels.items():
        columns[name] = np.full(t.size, np.nan)
        columns[name][np.searchsorted(t, c.t)] = c.values
    return t, columns


@dataclass(frozen=True, repr=False)
class Channels:
    """Channels of one run, by name. It is used as a frame of pandas is.

    ==============================  ====================================================
    written                         is
    ==============================  ====================================================
    ``log["x_lvdt"]``               the `Channel`
    ``log[["x_lvdt", "i_cmd"]]``    these channels alone
    ``log[10:20]``                  all channels, from 10 s to before 20 s of their time
    ``len(log)``                    times at which any channel has a sample
    ``for name in log``             each name
    ``log.units``                   unit of each name
    ``log.to_pandas()``             a ``pandas.DataFrame``
    ``log.assign(lag="a - b")``     with a channel more, made by a formula
    ==============================  ====================================================

    Nothing is changed in place, so threads may share one.

    Attributes
    ----------
    path : str
        The file it was read from, or a name.
    channels : dict
        Each `Channel` by its name; every channel has a time of its own.
    """

    path: str
    channels: dict[str, Channel]

    @overload
    def __getitem__(self, asked: str) -> Channel: ...

    @overload
    def __getitem__(self: Self, asked: slice | list[str]) -> Self: ...

    def __getitem__(self: Self, asked: str | slice | list[str]) -> Channel | Self:
        """A channel by its name, some channels by a list of names, or a part of all by a slice in s."""
        if isinstance(asked, str):
            self._known([asked])
            return self.channels[asked]
        if isinstance(asked, slice):
            return self.within([_part(asked)])
        if isinstance(asked, list) and all(isinstance(name, str) for name in asked):
            self._known(asked)
            return replace(self, channels={name: self.channels[name] for name in asked})
        raise LogError(f"log[{asked!r}]: allowed: a name, a list of names, or a slice in s such as log[10:20]")

    def __len__(self) -> int:
        """Times at which any channel has a sample: the rows of `to_pandas`."""
        return len(self.t)

    def __bool__(self) -> bool:
        """Whether there is a log: there is."""
        return True

    def __iter__(self) -> Iterator[str]:
        """Each name in turn."""
        return iter(self.channels)

    def __contains__(self, name: object) -> bool:
        """Whether there is a channel of that name."""
        return name in self.channels

    def keys(self) -> KeysView[str]:
        """Names."""
        return self.channels.keys()

    def values(self) -> ValuesView[Channel]:
        """Channels."""
        return self.channels.values()

    def items(self) -> ItemsView[str, Channel]:
        """Names and channels."""
        return self.channels.items()

    @property
    def columns(self) -> list[str]:
        """Names, as a list."""
        return list(self.channels)

    @property
    def units(self) -> dict[str, str]:
        """Unit of each channel."""
        return {name: c.unit for name, c in self.channels.items()}

    @property
    def t(self) -> np.ndarray:
        """All times at which any channel has a sample, s."""
        times = list({id(c.t): c.t for c in self.channels.values()}.values())
        return times[0] if len(times) == 1 else np.unique(np.concatenate(times)) if times else np.empty(0)

    def within(self: Self, spans: list[Span]) -> Self:
        """The samples in any of these parts; channels without one are left out.

        Raises LogError where no sample is left.
        """
        channels = {}
        for name, c in self.channels.items():
            use = np.any([(c.t >= s.low) & (c.t < s.high) for s in spans], axis=0)
            if use.any():
                channels[name] = replace(c, t=c.t[use], values=c.values[use])
        if not channels:
            t = self.t
            there = f"the log is from {t[0]:g} to {t[-1]:g} s" if len(t) else "the log has none at all"
            raise LogError(f"{self.path}: no sample in '{' '.join(map(str, spans))}'; {there}")
        return replace(self, channels=channels)

    def assign(self: Self, **made: str | Channel) -> Self:
        """The same with channels that formulas make, or that are given; a name that is there is replaced.

        Parameters
        ----------
        **made : str or Channel
            Name -> formula of channels, such as ``"x_dem - x_lvdt [um]"`` (docs/logs.md#formulas), or a channel. A
            later formula may name an earlier one.

        Raises
        ------
        LogError
            One line with the position of what is wrong in a formula.

        Examples
        --------
        >>> import vaneloop
        >>> log = vaneloop.read_log("examples/hidden_effect.parquet")
        >>> log.assign(lag="x_dem - x_lvdt [um]")["lag"]
        Channel(20,000 samples, 0 to 199.99 s, -224 to 204 um)
        """
        channels = dict(self.channels)
        for name, given in made.items():
            if isinstance(given, Channel):
                channels[name] = given
                continue
            t, values, unit = formula_of(given).made(channels, self._unit_of(name))
            channels[name] = Channel(t, values, unit=unit)
        return replace(self, channels=channels)

    def _unit_of(self, name: str) -> str:
        """The unit that a channel of that name must have; "": any."""
        return ""

    def to_pandas(self) -> DataFrame:
        """All channels as a ``pandas.DataFrame``, which every analysis takes as it takes a log.

        Returns
        -------
        pandas.DataFrame
            A column a channel, on all times of all: NaN where a channel has no sample. Its index ``t`` is the time in
            s. ``attrs["units"]`` has the unit of each column, ``attrs["framed"]`` the columns that came in frames of a
            bus, ``attrs["name"]`` the log's name.

        Raises
        ------
        InputError
            Where pandas is not installed: ``pip install 'vaneloop[notebook]'``.
        """
        pandas = needed("to_pandas", "pandas")
        t, columns = raster(self.channels)
        frame = pandas.DataFrame(columns, index=pandas.Index(t, name="t"))
        frame.attrs = {
            "name": self.path, "units": self.units, "framed": [n for n, c in self.channels.items() if c.framed],
        }  # fmt: skip
        return frame

    def to_frame(self) -> DataFrame:
        """The same as `to_pandas`."""
        return self.to_pandas()

    def __repr__(self) -> str:
        """Name, time and channels on one line."""
        return f"{type(self).__name__}({Path(self.path).name!r}, {self._said()})"

    def _repr_html_(self) -> str:
        """Show it in a notebook: name, unit, samples and range of each channel."""
        rows = [
            [name, c.unit, len(c), *(float(f(c.values)) for f in (np.min, np.mean, np.max))]
            for name, c in self.channels.items() if len(c)
        ]  # fmt: skip
        return html_table(
            ["channel", "unit", "samples", "least", "mean", "greatest"], rows, f"{Path(self.path).name}: {self._said()}"
        )

    def _said(self) -> str:
        names = [heading(name, c.unit) for name, c in list(self.channels.items())[:SHOWN]]
        more = f" and {len(self.channels) - SHOWN} more" if len(self.channels) > SHOWN else ""
        t = self.t
        when = f"{len(t):,} rows, {t[0]:.6g} to {t[-1]:.6g} s" if len(t) else "no rows"
        return f"{when}: {', '.join(names)}{more}" if names else when

    def _known(self, names: list[str]) -> None:
        for name in names:
            if name not in self.channels:
                raise NoChannel(f"{self.path}: no channel {name!r}{meant(name, self)}; it has {', '.join(self)}")
