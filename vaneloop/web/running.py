"""The loop of one session of page 3: begun, stopped, told what to do, and what it said."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Coroutine
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from controller import FAULTS, MODES
from hil.inject.scenario import load_scenario
from hil.native import black_box, isolation
from vaneloop.base.vanes import VANES
from vaneloop.pages.style import STAGE_ROLES
from vaneloop.web.charts import Curves, Mark, Panel, Trace, mode_bands
from vaneloop.web.jobs import COLUMNS, COMPILING, Cancelled, Worker, WorkError
from vaneloop.web.moments import Moment, bit_bands, told
from vaneloop.web.session import LogFile, Session
from vaneloop.web.tuning import Tuning

__all__ = ["ANY", "Loop"]

MOST = 200  # events and marks kept
ANY = "any fault"
KEPT = 36_000  # rows kept for the charts: six minutes at 100 Hz
AFTER = 3.0  # s that the charts show after the moment that they stop at
SHOWN = 30.0  # s in the strip charts
TRACED = 2000  # frames kept for the trace
STRIPS: tuple[
    tuple[str, str, float, tuple[tuple[str, str], ...]], ...
] = (  # title, unit, least height of the axis, lines
    ("speed [%]", "%", 2.0, (("n_dem", "target"), ("n_r", "measured"))),
    ("stroke [mm]", "mm", 0.5, (("x_dem", "target"), ("x_lvdt", "measured"))),
    ("current [mA]", "mA", 2.0, (("i_cmd", "model"),)),
    ("vanes [deg]", "deg", 1.0, tuple(zip(VANES, STAGE_ROLES, strict=True))),
)


@dataclass
class Loop:
    """The loop that runs, or ran last, in one session."""

    session: Session
    bus: str = "lockstep"
    speed: float = 1.0
    demand: float = 70.0
    profile: str | None = None
    seed: int | None = 1
    record: bool = True
    running: bool = False
    rows: np.ndarray = field(default_factory=lambda: np.empty((0, len(COLUMNS))))
    filled: int = 0
    trace: deque[tuple[float, int, int, dict[str, float]]] = field(default_factory=lambda: deque(maxlen=TRACED))
    status: dict[str, Any] = field(default_factory=dict)
    late: dict[str, Any] = field(default_factory=dict)
    recorded: LogFile | None = None
    events: deque[Moment] = field(default_factory=lambda: deque(maxlen=MOST))
    injected: deque[Mark] = field(default_factory=lambda: deque(maxlen=MOST))  # scenarios begun, with their times
    changes: deque[Mark] = field(default_factory=lambda: deque(maxlen=MOST))  # values and pages changed, likewise
    asked: str = ""  # the scenario asked for last
    last: tuple[int, int] = (-1, 0)  # latest mode and faults
    trigger: str = ""  # the charts stop at the next fault of this name (ANY: whichever), or "mode RUN"
    held: float | None = None  # s: the moment that they stop at
    first: float = 0.0  # s: the first row, where the record begins
    clock: float = 0.0  # s of this machine's clock at the listener's start
    workers: dict[str, Worker] = field(default_factory=dict)
    runs: int = 0
    boxes: Path | None = None  # folder of the black boxes of a controller of the user's own
    lit: dict[str, int] = field(default_factory=dict)  # lamp -> how often news came in which it was on

    def __post_init__(self) -> None:
        self.tuning = Tuning(self.session, self._calibrate, self._changed)

    @property
    def bus_name(self) -> str:
        """The bus as a command names it: an embedded one is this session's own."""
        return self.bus if self.bus != "local" else f"local:web-{self.session.folder.name[:8]}"

    def commands(self) -> list[tuple[str, list[str]]]:
        """Commands for what Start does, each after what it leaves out ("" where nothing)."""
        seed = ["--seed", str(self.seed)] if self.seed is not None else []
        record = ["--record", f"run{self.runs + (not self.running)}.log"] if self.record else []
        profile = ["--profile", self.profile] if self.profile else []
        tables = [*self.tables_words(), *self.controller_words()]
        if self.bus == "lockstep":
            if not profile:
                return [("By slider no command does this; choose a profile to see the one that runs it.", [])]
            words = ["run", "--bus", "lockstep", *profile, "--start-speed", f"{self.demand:g}", *seed, *record, *tables]
            return [("The profile alone; pace, slider and buttons are the page's own:", words)]
        return [
            ("", ["run", "--bus", self.bus_name, *seed, *record, *tables]),
            ("", ["ecu", "--bus", self.bus_name, *profile, *self.tables_words()]),
        ]

    def tables_words(self) -> list[str]:
        """Options that name the machine."""
        tables = self.session.tables
        return ["--tables", tables] if tables is not None else []

    def controller_words(self) -> list[str]:
        """Options that name a controller of the user's own."""
        return ["--controller", self.session.controller] if self.session.controller else []

    def _own(self) -> dict[str, Any]:
        """What the loop's process takes of it."""
        if not self.session.controller:
            return {}
        self.boxes = self.session.folder / f"boxes{self.runs}"
        self.boxes.mkdir(exist_ok=True)
        return {"controller": self.session.controller, "boxes": str(self.boxes)}

    async def _watched(self, worker: Worker, call: Coroutine[Any, Any, Any]) -> Any:
        """Wait for a run; end its process where a controller of the user's own hangs, and say how it failed."""
        task = asyncio.ensure_future(call)
        task.add_done_callback(lambda t: t.cancelled() or t.exception())  # the page may be gone: nobody asks for it
        seen = b""
        since, hung = time.monotonic(), False
        while not (await asyncio.wait([task], timeout=0.5))[0]:
            now = black_box.progress(self.boxes) if self.boxes is not None else b""
            if now != seen or not now:
                seen, since = now, time.monotonic()
            elif time.monotonic() - since > isolation.PATIENCE:
                hung = True
                worker.stop()
        try:
            return await task
        except (WorkError, Cancelled):
            box = black_box.left(self.boxes) if self.boxes is not None else None
            if box is None:
                raise
            raise WorkError(
                isolation.told(
                    box, f"did not come back within {isolation.PATIENCE:g} s" if hung else "ended its process"
                )
            ) from None

    # ---- begin and end

    def start(self) -> None:
        """Start as the page says."""
        if self.running:
            return
        s = self.session
        self.running, self.filled, self.status, self.late = True, 0, {}, {}
        self.rows = np.empty((KEPT, len(COLUMNS)))
        self.trace.clear()
        self.events.clear()
        self.injected.clear()
        self.changes.clear()
        self.last, self.held, self.asked = (-1, 0), None, ""
        self.runs += 1
        s.do("run", self._in_lockstep() if self.bus == "lockstep" else self._in_real_time())
        s.touch("loop")

    def _worker(self, name: str) -> Worker:
        w = self.workers.get(name)
        if w is None:
            w = self.workers[name] = Worker("vaneloop.web.loop", changed=lambda: self.session.touch("loop-jobs"))
            w.news = self._news
            self.session.extra.setdefault("closers", []).append(w.stop)
        return w

    def warm(self) -> None:
        """Load the simulator before it is asked for."""
        if not self.workers:
            self.session.do("warm", self._warm())

    async def _warm(self) -> None:
        await self._worker("loop").call("ready", COMPILING)

    def _record_path(self) -> str | None:
        return str(self.session.folder / f"run{self.runs}.log") if self.record else None

    async def _in_lockstep(self) -> None:
        record = self._record_path()
        try:
            worker, own = self._worker("loop"), self._own()
            call = worker.call(
                "lockstep",
                "running",
                demand=self.demand,
                speed=self.speed,
                record=record,
                seed=self.seed,
                profile=self.profile,
                tables=self.session.tables,
                tuned=str(self.tuning.folder),
                **own,
            )
            await self._watched(worker, call)
        finally:
            self._ended(record)

    async def _in_real_time(self) -> None:
        record = self._record_path()
        bus = self.bus_name
        listener, controller, engine = (self._worker(n) for n in ("listen", "node", "ecu"))
        calls = [
            listener.call("listen", "running", bus=bus),
            self._watched(
                controller,
                controller.call(
                    "node",
                    "running",
                    bus=bus,
                    record=record,
                    seed=self.seed,
                    tables=self.session.tables,
                    tuned=str(self.tuning.folder),
                    **self._own(),
                ),
            ),
            engine.call(
                "ecu", "running", bus=bus, demand=self.demand, profile=self.profile, tables=self.session.tables
            ),
        ]
        tasks = [asyncio.ensure_future(c) for c in calls]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
            for t in done:
                t.result()
            self.late = {**self.late, **tasks[1].result()}
        except (WorkError, Cancelled):
            for w in (listener, controller, engine):
                w.stop()
            await asyncio.gather(*tasks, return_exceptions=True)
            raise
        finally:
            self._ended(record)

    def _ended(self, record: str | None) -> None:
        self.running = False
        self.tuning.ended()
        path = self.session.folder / f"run{self.runs}.log"
        if record is not None and path.is_file() and path.stat().st_size:
            marks = tuple((max(0.0, m.t - self.first), m.text) for m in self.injected)
            self.recorded = LogFile(path, f"recorded: {path.name}", path.name, marks)
            self.session.files.append(self.recorded)
            self.session.saved[f"run-{path.name}"] = path
            self.session.touch("files")
        self.session.touch("loop", "run")

    def stop(self) -> None:
        """Ask it to end; the record is complete then."""
        for w in self.workers.values():
            if w.jobs:
                w.tell(stop=True)

    # ---- while it runs

    def tell(self, **content: Any) -> None:
        """Say something to whoever it concerns."""
        for name, w in self.workers.items():
            if w.jobs and name != "listen":
                w.tell(**content)

    def _calibrate(self, number: int, commands: list[bytes]) -> None:
        """Let the process that stands on the bus send a tool's commands."""
        w = self.workers.get("loop" if self.bus == "lockstep" else "listen")
        if w is not None and w.jobs:
            w.tell(xcp=(number, commands))

    def _changed(self, what: str) -> None:
        """Note that the calibration was changed."""
        self.changes.append(Mark(self.now(), what))
        self._tell(Moment(self.now(), f"calibration: {what}"))

    def inject(self, name: str) -> None:
        """Start a scenario of the library now."""
        self.asked = name
        if self.bus == "lockstep":
            self.tell(inject=name)
        else:
            self.session.do("inject", self._inject_outside(name))
        self.session.touch("events")

    def _begun(self, t: float, name: str) -> None:
        """Note a scenario whose first action began at ``t`` (s)."""
        self.injected.append(Mark(t, name))
        self._tell(Moment(t, f"injected: {name}: {load_scenario(name).title}"))

    def _tell(self, *moments: Moment) -> None:
        self.events.extend(moments)
        self.session.touch("events")

    def judge(self, name: str) -> None:
        """Run a scenario by itself, and hold what the machine does against what the scenario expects."""
        self.session.do("inject", self._judge(name))

    async def _judge(self, name: str) -> None:
        words = ["inject", name, *self.tables_words(), *self.controller_words()]
        answer = await self.session.aside.call("judge", f"judging {name}", words=words)
        self._judged(None, f"{name}, by itself", answer["code"] == 0)

    def _judged(self, t: float | None, name: str, held: bool) -> None:
        self._tell(Moment(t, f"{name}: {'pass' if held else 'FAIL'}"))

    async def _inject_outside(self, name: str) -> None:
        w = Worker("vaneloop.web.loop", changed=lambda: self.session.touch("jobs"))
        w.news = lambda news: self._begun(news["at"] - self.clock, news["name"])
        closers = self.session.extra.setdefault("closers", [])
        closers.append(w.stop)
        try:
            held = await w.call("outside", f"injecting {name}", scenario=name, bus=self.bus_name)
            self._judged(self.now(), name, held)
        finally:
            w.stop()
            closers.remove(w.stop)

    def show(self, t: float) -> None:
        """Stop the charts at a moment of this run; where it is no longer kept, at the first one that is."""
        self.held = max(t, float(self.rows[0, 0])) if self.filled else t
        self._draw()

    def go_on(self) -> None:
        """Let the charts move again."""
        self.held = None
        self._draw()

    def now(self) -> float:
        """Time of the latest row, s."""
        return float(self.rows[self.filled - 1, 0]) if self.filled else 0.0

    def latest(self, name: str) -> float:
        """Return the latest value of a column; NaN before the first."""
        return float(self.rows[self.filled - 1, COLUMNS.index(name)]) if self.filled else float("nan")

    def _news(self, news: dict[str, Any]) -> None:
        if "late" in news:
            self.late = news
            return
        if "elements" in news:
            self.tuning.began(news["elements"])
            self.tuning.read()
            return
        self.tuning.answered(news.pop("xcp", []))
        first = not self.filled
        rows = news.pop("rows")[-KEPT:]
        if first and len(rows):
            self.first = float(rows[0, 0])
        self.clock = news.pop("clock", self.clock)
        over = self.filled + len(rows) - KEPT
        if over > 0:
            drop = max(over, KEPT // 10)
            self.rows[: self.filled - drop] = self.rows[drop : self.filled].copy()
            self.filled = max(0, self.filled - drop)
        self.rows[self.filled : self.filled + len(rows)] = rows
        self.filled += len(rows)
        self.trace.extend(news.pop("trace"))
        self._light(rows)
        for t, name in news.pop("injected", ()):
            self._begun(t, name)
        self._note(rows)
        if first and self.filled:
            self.session.touch("loop")
        self.status = news
        self._draw()

    def _light(self, rows: np.ndarray) -> None:
        for mode in set(rows[:, COLUMNS.index("state")].tolist()):
            if mode == mode and 0 <= mode < len(MODES):
                self.lit[MODES[int(mode)]] = self.lit.get(MODES[int(mode)], 0) + 1
        faults = rows[:, COLUMNS.index("faults")]
        bits = int(np.bitwise_or.reduce(faults[np.isfinite(faults)].astype(np.int64), initial=0))
        for i, fault in enumerate(FAULTS):
            if bits >> i & 1:
                self.lit[fault] = self.lit.get(fault, 0) + 1

    def _note(self, rows: np.ndarray) -> None:
        """Write changes of mode and faults into the list of events."""
        columns = [COLUMNS.index(c) for c in ("t", "state", "faults")]
        for t, state, faults in rows[:, columns].tolist():
            now = int(state) if state == state else -1, int(faults) if faults == faults else 0
            if now == self.last:
                continue
            new = told(t, *now, self.last)
            self.last = now
            self._tell(*new)
            if self.held is None and any(
                (m.fault and self.trigger in (ANY, m.fault)) or m.text == self.trigger for m in new
            ):
                self.held = t

    def _draw(self) -> None:
        rows = self.rows[: self.filled]
        if self.held is not None:
            rows = rows[: np.searchsorted(rows[:, 0], self.held + AFTER)]
        if not len(rows):
            self.session.curves["run"] = Curves()
            return
        rows = rows[np.searchsorted(rows[:, 0], rows[-1, 0] - SHOWN) :].copy()
        keep = np.concatenate([[True], np.diff(rows[:, 0]) > 0.0])
        rows = rows[keep]
        t = rows[:, 0]
        unfitted = {v for v in VANES if np.isnan(rows[:, COLUMNS.index(v)]).all()}
        panels = [
            Panel(
                title,
                unit,
                t,
                [Trace(n, rows[:, COLUMNS.index(n)], role) for n, role in lines if n not in unfitted],
                height=120,
                least=least,
            )
            for title, unit, least, lines in STRIPS
        ]
        marks = [m for m in (*self.injected, *self.changes) if t[0] <= m.t <= t[-1]]
        state, faults = rows[:, COLUMNS.index("state")], rows[:, COLUMNS.index("faults")]
        spans = [*mode_bands(t, state), *bit_bands(t, faults)]
        self.session.curves["run"] = Curves(panels, "run", marks, spans)
