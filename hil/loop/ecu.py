"""The external engine control unit: where its demand comes from, and when it gives the controller up.

The node itself is `hil.loop.node.Ecu`: ECU_DEMAND every 10 ms with the speed that its engine model (or the log) has,
and a watch on the controller's frames. Here it gets a demand for each tick. The demand's time starts with the first
good VGV_STATUS: controller and ECU can be started in any order; until then its first value is sent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.bus.frames import R_LAST, R_LAST_TICK
from hil.logs import read_log
from hil.logs.held import held
from hil.logs.plausible import LONGEST
from hil.loop.node import Ecu
from vaneloop.base.errors import InputError
from vaneloop.base.tables import load_toml

__all__ = ["BUILTIN", "Demand", "EcuStation", "Typed", "builtin", "demand_of_log", "read_profile"]

LOWEST, HIGHEST = 0.0, 120.0  # %, what a demand may be (the firmware's own range)
TICKS_PER_S = 1000

# name -> (what it is, break points: s, %)
BUILTIN: dict[str, tuple[str, tuple[tuple[float, float], ...]]] = {
    "idle": ("60 % held for 10 s", ((0, 60), (10, 60))),
    "step": (
        "60 %, step to 80 % at 5 s, back at 15 s",
        ((0, 60), (5, 60), (5.01, 80), (15, 80), (15.01, 60), (25, 60)),
    ),
    "ramp": ("60 to 100 % and back at 2 %/s", ((0, 60), (2, 60), (22, 100), (27, 100), (47, 60), (50, 60))),
    "slam": (
        "45 to 100 % and back as fast as the engine can",
        ((0, 45), (3, 45), (3.01, 100), (18, 100), (18.01, 45), (30, 45)),
    ),
    "staircase": (
        "50 to 100 % in steps of 10 %, 5 s each, and down again",
        tuple(
            p
            for i, n in enumerate([50, 60, 70, 80, 90, 100, 90, 80, 70, 60, 50])
            for p in ((5 * i + 0.01, n), (5 * i + 5, n))
        ),
    ),
    "sine": (
        "80 % +- 10 %, period 10 s, 60 s",
        tuple((0.1 * i, 80 + 10 * math.sin(2 * math.pi * 0.01 * i)) for i in range(601)),
    ),
}


@dataclass(frozen=True)
class Demand:
    """Speed demand over time: break points ``t`` (s, from 0, increasing), ``n_dem`` (%), and the measured speed ``n_r``
    (%) if it is known.

    held  True: each value is held until the next (a log); False: straight lines in between (a profile)
    """

    t: np.ndarray
    n_dem: np.ndarray
    n_r: np.ndarray | None = None
    held: bool = False

    @property
    def duration(self) -> float:
        """Time of the last value, s."""
        return float(self.t[-1])

    def per_frame(self) -> np.ndarray:
        """Return n_dem and n_r (NaN = not known) for each 10 ms: float64[n, 2]."""
        raster = np.arange(int(self.duration * 100 + 1e-6) + 1) * 0.01
        out = np.full((len(raster), 2), np.nan)
        last = np.maximum(np.searchsorted(self.t, raster + 1e-6, side="right") - 1, 0)
        out[:, 0] = self.n_dem[last] if self.held else np.interp(raster, self.t, self.n_dem)
        if self.n_r is not None:
            out[:, 1] = self.n_r[last] if self.held else np.interp(raster, self.t, self.n_r)
        return out


def builtin(name: str) -> Demand:
    """Return the profile of that name (`BUILTIN`)."""
    points = np.array(BUILTIN[name][1], float)
    return Demand(points[:, 0] - points[0, 0], points[:, 1])


def read_profile(path: str | Path, tell: Callable[[list[str]], None] | None = None, **options: Any) -> Demand:
    """Read a profile: TOML with the lists ``t`` (s) and ``n_dem`` (%), or any log with n_dem (CSV: a header
    ``t,n_dem``).

    ``options`` say how to read a log (`hil.logs.read_log`), ``tell`` gets what there is to note on it.

    Straight lines between the points; a step is two points close to each other. Raises InputError in one line.
    """
    path = Path(path)
    if path.suffix.lower() == ".toml":
        table = load_toml(path)
        columns: dict[str, np.ndarray] = {}
        for key in ("t", "n_dem"):
            values = table.get(key)
            if (
                not isinstance(values, list)
                or not values
                or any(isinstance(v, bool) or not isinstance(v, int | float) for v in values)
            ):
                raise InputError(f"{path}: {key} must be a list of numbers, as t = [0, 10] and n_dem = [60, 90]")
            columns[key] = np.array(values, float)
        if unknown := sorted(set(table) - {"t", "n_dem"}):
            raise InputError(f"{path}: {unknown[0]!r} is unknown; allowed: t, n_dem")
        if len(columns["t"]) != len(columns["n_dem"]):
            raise InputError(
                f"{path}: t has {len(columns['t'])} numbers, n_dem {len(columns['n_dem'])}; they must be as many"
            )
        return _checked(Demand(columns["t"], columns["n_dem"]), path)
    log = read_log(path, **options)
    if tell is not None:
        tell(log.notes)
    channel = log.channels["n_dem"]
    return _checked(Demand(channel.t, channel.values), path)


def demand_of_log(log: Any) -> Demand:
    """Return the demand of a log (`hil.logs.Log`), with its measured speed where it has one; values are held until the
    next.
    """
    c = log.channels["n_dem"]
    t, n_r = c.t, None
    if "n_r" in log.channels:
        r = log.channels["n_r"]
        t = np.union1d(c.t, r.t)
        t = t[t >= max(c.t[0], r.t[0])] if len(r.t) > 1 else c.t
        n_r = r.values[held(r, t)]
    n_dem = c.values[held(c, t)]
    return _checked(Demand(t, n_dem, n_r, held=True), log.path)


def _checked(demand: Demand, source: Any) -> Demand:
    """The demand from time 0 on."""
    t, n = demand.t, demand.n_dem
    if not np.isfinite(t).all() or not np.isfinite(n).all():
        raise InputError(f"{source}: t and n_dem must be finite")
    if (np.diff(t) <= 0).any():
        k = int(np.argmax(np.diff(t) <= 0))
        raise InputError(f"{source}: t (={t[k + 1]:g} s after {t[k]:g} s) must increase")
    if t[-1] - t[0] > LONGEST:
        raise InputError(f"{source}: t spans {t[-1] - t[0]:g} s; allowed: up to {LONGEST:g} s")
    outside = (n < LOWEST) | (n > HIGHEST)
    if outside.any():
        raise InputError(f"{source}: n_dem (={n[np.argmax(outside)]:g} %) must be in [{LOWEST:g}, {HIGHEST:g}]")
    return demand if t[0] == 0.0 else Demand(t - t[0], n, demand.n_r, demand.held)


class Typed:
    """A demand that somebody types: numbers are %, ``+`` and ``-`` change it, ``run`` and ``standby`` ask for the mode,
    ``quit`` ends.
    """

    HELP = "a number sets n_dem (%), +N or -N changes it; run, standby: mode request; quit ends"

    def __init__(self, n_dem: float = 60.0):
        self.n_dem, self.mode_request, self.quit, self.complaint = n_dem, 1, False, ""

    def line(self, text: str) -> None:
        """Take one line; what it cannot be goes into ``complaint``."""
        word = text.strip().lower()
        if word in ("q", "quit", "exit"):
            self.quit = True
        elif word in ("run", "r", "standby", "s"):
            self.mode_request = int(word in ("run", "r"))
        elif word:
            try:
                value = float(word)
            except ValueError:
                self.complaint = f"{text.strip()[:40]!r} is not known: {self.HELP}"
                return
            value = self.n_dem + value if word[0] in "+-" else value
            if LOWEST <= value <= HIGHEST:
                self.n_dem = value
            else:
                self.complaint = f"n_dem (={value:g} %) must be in [{LOWEST:g}, {HIGHEST:g}]"


class EcuStation:
    """The ECU with a demand for each tick, as `hil.loop.realtime.run_realtime` wants it.

    demand   `Demand` or `Typed`
    timeout  s without a good VGV_STATUS after which the controller is given up
    wait     s to wait for the first one
    """

    def __init__(
        self,
        demand: Demand | Typed,
        *,
        timeout: float = 0.5,
        wait: float = 10.0,
        mode_request: int = 1,
        ecu: Ecu | None = None,
    ):
        self.typed = demand if isinstance(demand, Typed) else None
        self.rows = demand.per_frame() if isinstance(demand, Demand) else np.array([[demand.n_dem, np.nan]])
        self.ecu = ecu or Ecu(n_dem=float(self.rows[0, 0]))
        self.mode_request = mode_request
        self.timeout, self.wait = round(timeout * TICKS_PER_S), round(wait * TICKS_PER_S)
        self.met: int | None = None  # tick of the first good VGV_STATUS
        self._status = self.ecu.arrays.receiver[0]

    @property
    def k(self) -> int:
        """The next tick."""
        return self.ecu.k

    @property
    def t(self) -> float:
        """Time of the demand, s."""
        return 0.0 if self.met is None else (self.ecu.k - self.met) / TICKS_PER_S

    def tick(self, received: np.ndarray, n: int) -> np.ndarray:
        """Run the next tick."""
        k = self.ecu.k
        if k % 10 == 0:
            if self.typed is not None:
                self.ecu.set_demand(self.typed.n_dem, mode_request=self.typed.mode_request)
            else:
                at = 0 if self.met is None else min((k - self.met) // 10, len(self.rows) - 1)
                self.ecu.set_demand(float(self.rows[at, 0]), float(self.rows[at, 1]), self.mode_request)
        out = self.ecu.tick(received, n)
        if self.met is None and self._status[R_LAST] >= 0:
            self.met = k
        return out

    def watcher(self, duration: float | None) -> Callable[[int], str | None]:
        """Return a function that says after tick k why to end: ``done``, ``quit``, or a complaint about the
        controller.
        """
        last = None if duration is None else round(duration * TICKS_PER_S)

        def watch(k: int) -> str | None:
            if self.met is None:
                return (
                    f"no good VGV_STATUS within {self.wait / TICKS_PER_S:g} s: is a controller running?"
                    if k >= self.wait
                    else None
                )
            silent = k - int(self._status[R_LAST_TICK])
            if silent >= self.timeout:
                return (
                    f"timed out: no good VGV_STATUS for {silent / TICKS_PER_S:.2f} s at t = "
                    f"{(k - self.met) / TICKS_PER_S:.2f} s"
                )
            if self.typed is not None and self.typed.quit:
                return "quit"
            return "done" if last is not None and k - self.met >= last else None

        return watch
