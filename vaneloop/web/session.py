"""One user's work, apart from any page that shows it: a reload, or a second tab, finds everything as it was.

Every action calls what the command line calls, in a process beside the server (worker.py), and says which command does
the same, where there is one (docs/workbench.md).
"""

from __future__ import annotations

import asyncio
import hashlib
import re
import shlex
import shutil
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hil.logs import Channel, Log, write_log
from hil.logs.formats import is_framed
from hil.logs.formula import Formula, named
from vaneloop.base.errors import InputError
from vaneloop.web import moments
from vaneloop.web.charts import OVER, Curves, Mark, Over, of_log, of_stage
from vaneloop.web.choice import CODE, OTHER_SUFFIXES, Choice, LogFile, Overlay, safe_name
from vaneloop.web.jobs import Cancelled, Job, Spare, Worker, WorkError

__all__ = ["CODE", "OTHER_SUFFIXES", "STOPPED", "Choice", "LogFile", "Session", "safe_name"]

STOPPED = "stopped; nothing is kept of it, start it again when you like"  # in place of a complaint
SEARCHED = ("compare", "loop", "diagnose", "learn", "fit", "experiment", "save")  # sections of a comparison
LEADERS = 4  # candidate effects whose fits are made ahead


@dataclass(eq=False)
class Fitted:
    """One stage fitted with a set of effects."""

    result: Any  # StageDiagnosis
    curves: dict[str, Any]
    theta: Any
    floor: Any
    bounds: dict[str, dict[str, Any]]  # effect -> parameter -> its `Parameter`


class Session:
    """State of the pages of one browser. ``versions`` count what has changed, section by section."""

    def __init__(
        self, number: str, folder: Path, files: list[LogFile], tables: str | None = None, controller: str | None = None,
        spare: Spare | None = None, models: Sequence[LogFile] = (),
    ):  # fmt: skip
        self.number, self.folder, self.files = number, folder, files  # files: what may be chosen
        self.models = list(models)  # models of the user's own, and of the examples
        self.allowed: set[str] = set()  # code that the user lets run, by its digest
        self.asked: LogFile | None = None  # a model whose code nobody has allowed yet
        self.takes_code = True  # whether an upload may be code
        self.tables = tables  # folder of the machine's tables; None: the shipped ones
        self.controller = controller and str(
            Path(controller).resolve()
        )  # library of the user's own; None: the firmware
        folder.mkdir(mode=0o700, parents=True)
        self.versions: dict[str, int] = {}
        self.lookers: list[Callable[[], None]] = []  # pages that want to know
        self.search = Worker(changed=lambda: self.touch("jobs"), spare=spare)  # the long searches
        self.search.news = self._news
        self.bench = Worker(changed=lambda: self.touch("jobs"))  # refits and sliders, answering meanwhile
        self.aside = Worker(changed=lambda: self.touch("jobs"))  # what goes on whichever log is chosen
        self.tasks: set[asyncio.Task[None]] = set()
        self.working: Counter[str] = Counter()  # sections whose work has not ended
        self._fitting = asyncio.Lock()
        self.dark: bool | None = None
        self.errors: dict[str, str] = {}
        self.curves: dict[str, Curves] = {}
        self.extra: dict[str, Any] = {}  # what other pages keep
        self.choice = Choice(tables=tables)
        self.overlays: list[Overlay] = []
        self.formulas: list[Formula] = []  # of channels; they stay when another log is chosen
        self.made: dict[str, Channel | str] = {}  # what each formula makes of this log, or why it makes none
        self.xy: dict[str, str] = {}  # x, y, colour: channels of the plot of one over the other
        self.cursors: tuple[float | None, float | None] = (None, None)  # s, in the curves of the log
        self.offered: list[str] = []
        self.seen: dict[str, Any] | None = None  # what is known of its names and units (worker.look)
        self.draft: dict[str, str] = {}  # what is typed in the form and not yet read
        self.saved: dict[str, Path] = {}
        self._clear_log()

    def _clear_log(self) -> None:
        self.preview: dict[str, Any] | None = None
        self.made = {}
        self.moments: list[moments.Moment] = []
        self._clear_results()

    def _clear_results(self) -> None:
        self.compared: dict[str, Any] | None = None
        self.loop: tuple[list[Any], str] | None = None  # the whole loop's errors, or why there are none
        self.diagnosis: dict[str, Any] | None = None
        self.stage: str = ""
        self.chosen: dict[str, tuple[str, ...]] = {}
        self._last_fit: Fitted | None = None
        self.fits: dict[tuple[str, frozenset[str]], Fitted] = {}
        self.hand: dict[str, dict[str, float]] = {}
        self.hand_rms: dict[str, float] = {}
        self.experiment: dict[str, Any] | None = None
        self.experiment_done = False
        self.learned: dict[str, Any] | None = None  # a law, where the library has none
        self._hand_wanted = False
        self.sofar: list[str] = []  # what the stages said that are searched already
        self.saved = {k: v for k, v in self.saved.items() if k.startswith(("schedule-", "entered-", "run-"))}

    # ---- housekeeping

    def touch(self, *sections: str) -> None:
        """Say that these sections have changed."""
        for s in sections:
            self.versions[s] = self.versions.get(s, 0) + 1
        for wake in self.lookers:
            wake()

    def do(self, section: str, work: Coroutine[Any, Any, None]) -> None:
        """Run ``work`` beside the page; its complaint becomes the section's line."""
        self.errors.pop(section, None)

        async def guarded() -> None:
            try:
                await work
            except WorkError as e:
                self.errors[section] = self.clean(str(e))
            except Cancelled:
                self.errors[section] = STOPPED

        def ended(task: asyncio.Task[None]) -> None:
            self.tasks.discard(task)
            self.working[section] -= 1
            self.touch(section, "jobs")

        task = asyncio.get_running_loop().create_task(guarded())
        self.tasks.add(task)
        self.working[section] += 1
        task.add_done_callback(ended)
        self.touch(section)

    def clean(self, text: str) -> str:
        """Name files as the user does, not by their private folder."""
        beside = [x for x in (self.choice.dbc, self.choice.model, self.choice.bench) if x is not None]
        for f in [*self.files, *self.models, *beside]:
            text = text.replace(str(f.path), f.name)
        return text.replace(str(self.folder) + "/", "")

    def close(self) -> None:
        """End the processes and remove the private folder."""
        for task in list(self.tasks):
            task.cancel()
        for end in (self.search.stop, self.bench.stop, self.aside.stop, *self.extra.get("closers", [])):
            end()
        shutil.rmtree(self.folder, ignore_errors=True)

    @property
    def jobs(self) -> list[Job]:
        """What is being done."""
        return [j for w in (self.search, self.bench, self.aside) for j in w.jobs.values()]

    def busy(self, *names: str) -> Job | None:
        """The first job of one of these names."""
        return next((j for j in self.jobs if j.name in names), None)

    def command(self, verb: str, *more: str) -> str:
        """The equivalent command line."""
        return shlex.join(["vaneloop", verb, *self.choice.words(real=False), *more])

    def warm(self) -> None:
        """Load what the first log will need, before it is there."""
        self.search.start()
        self.bench.start()

    # ---- the log

    def choose(self, file: LogFile) -> None:
        """Take a log; a database, a model file or a mapping file is taken beside it, or for the first log to come. A
        model of the user's own is taken as `hold_against` takes it.
        """
        if file.path.suffix.lower() == CODE:
            self.hold_against(file)
            return
        if file.path.suffix.lower() == ".dbc":
            self.choice.dbc = file
        elif file.path.suffix.lower() == ".toml":
            mapping = re.search(rb"(?m)^\[(names|units)\]", file.path.read_bytes()) is not None
            setattr(self.choice, "bench" if mapping else "model", file)
        else:
            dbc = self.choice.dbc if is_framed(file.path) else None
            first = self.choice if self.choice.file is None else Choice()
            self.choice = Choice(
                file=file, dbc=dbc, model=first.model, bench=first.bench, tables=self.tables, system=self.choice.system
            )
            self.offered, self.seen, self.draft, self.overlays = [], None, {}, []
            self.cursors = None, None
        if self.choice.file is not None:
            self.read()
        self.touch("log")

    def hold_against(self, model: LogFile | None) -> None:
        """Hold logs against a model of the user's own; None: the vane chain. Before code runs, the user is asked."""
        self.asked = None if model is None or self.runs(model) else model
        if self.asked is None and model != self.choice.system:
            c = self.choice
            self.choice = Choice(file=c.file, dbc=c.dbc, tables=self.tables, system=model)  # names were the other's
            self.offered, self.seen, self.draft, self.overlays = [], None, {}, []
            if c.file is not None:
                self.read()
        self.touch("model", "log")

    def runs(self, model: LogFile) -> bool:
        """Whether a model's code may run: it came with the workbench, or the user has allowed what it says now."""
        return model.shipped or _digest(model.path) in self.allowed

    def allow(self) -> None:
        """Let the code run that was asked about, as it stands."""
        if (model := self.asked) is not None:
            self.allowed.add(_digest(model.path))
            self.hold_against(model)

    def refuse(self) -> None:
        """Leave the code that was asked about alone."""
        self.asked = None
        self.touch("model", "log")

    def words(self) -> list[str]:
        """The log, its options and its model, as the worker needs them. WorkError where the model's code is another
        than was allowed.
        """
        model = self.choice.system
        if model is not None and not self.runs(model):
            raise WorkError(f"{model.name}: has changed since its code was allowed to run; choose it again")
        return self.choice.words(real=True)

    def read(self) -> None:
        """Read the log as the form says, then compare it with the model."""
        self.stop()
        self._clear_log()
        self._forget("log", *SEARCHED)
        self.do("log", self._read())

    def _forget(self, *sections: str) -> None:
        """Take the complaints of these sections away, and have them drawn anew."""
        self.errors = {k: v for k, v in self.errors.items() if k not in sections}
        self.touch(*sections, "diagnosis")

    def take_parts(self, fit: str, test: str) -> None:
        """Which seconds of the log are fitted and which only test, as ``--fit`` and ``--test`` take them."""
        if (fit, test) != (self.choice.fit_part, self.choice.test_part):
            self.choice.fit_part, self.choice.test_part = fit, test
            self._held_anew()

    def take_logs(self, which: str, files: Sequence[LogFile]) -> None:
        """Further logs: those of ``--also`` (which: also) or ``--test`` (test)."""
        setattr(self.choice, which, list(files))
        self._held_anew()

    def _held_anew(self) -> None:
        """Compare anew, with what is fitted and tested now."""
        self.touch("further")
        if self.preview is None:
            return
        self.stop()
        self._clear_results()
        self._forget(*SEARCHED)
        if self.preview["channels"]:
            self.do("compare", self._compare())

    async def _read(self) -> None:
        words = self.words()
        self.offered = await self.search.call("offers", "opening the file", words=words)
        self.seen = await self.search.call("look", "looking at its names", words=words)
        self.touch("log")
        self.preview = await self.search.call("preview", "reading the log", words=words)
        if self.choice.system is None:
            self.moments = moments.of_log(self.preview["channels"], self.preview["faults"], self._marks())
        await self._make_channels()
        if self.overlays:
            for o in self.overlays:
                o.channels = None  # names and units may be others now
            self.do("over", self._lay_over())
        if self.preview["channels"]:
            self.do("compare", self._compare())
        else:
            wanted = ", ".join(self.seen["ours"])
            raise WorkError(f"{words[0]}: none of its names is a signal of ours ({wanted}); map them below")

    def _marks(self) -> list[Mark]:
        """What was injected into a run that was recorded here."""
        return [Mark(t, text) for t, text in self.choice.file.marks] if self.choice.file else []

    def _draw_log(self) -> None:
        """Curves of the log, with what is laid over it."""
        if self.preview is None or self.choice.file is None:
            return
        over = [Over(o.file.name, _told(o.shown), o.later) for o in self.overlays if o.channels is not None]
        spans = moments.fault_bands(self.preview["faults"])
        key, modes, made = str(self.choice.file.path), self.choice.system is None, list(self.made)
        self.curves["log"] = of_log(_told(self.channels()), key, over, self._marks(), spans, modes, made)

    # ---- channels of channels

    def channels(self) -> dict[str, Channel]:
        """Channels of the log chosen, and those that formulas make of them."""
        read = {} if self.preview is None else _channels(self.preview["channels"])
        return {**read, **{n: c for n, c in self.made.items() if isinstance(c, Channel)}}

    async def add_formula(self, text: str) -> bool:
        """Take one more formula, as ``vaneloop map --formula`` takes it; where it cannot be read or made, say why."""
        self.errors.pop("formula", None)
        try:
            formula = named(text)
            there = self.channels()
            if formula.name in there or formula.name in self.made:
                raise InputError(f"formula {text!r}, position 1: there is a channel {formula.name!r}; another name")
            if self.preview is not None:
                await asyncio.get_running_loop().run_in_executor(None, formula.made, there)
        except InputError as e:
            self.errors["formula"] = str(e)
            self.touch("formula")
            return False
        self.formulas = [*self.formulas, formula]
        self.do("formula", self._make_channels())
        return True

    def drop_formula(self, name: str) -> None:
        """Take a formula away."""
        self.formulas = [f for f in self.formulas if f.name != name]
        self.do("formula", self._make_channels())

    async def _make_channels(self) -> None:
        """Make what the formulas say of the log and of those laid over it, beside the page; draw the curves."""
        if self.preview is not None:
            logs = [_channels(self.preview["channels"]), *(_channels(o.channels or {}) for o in self.overlays)]
            loop, formulas, overlays = asyncio.get_running_loop(), self.formulas, self.overlays
            made = [await loop.run_in_executor(None, _made, formulas, channels) for channels in logs]
            if formulas is not self.formulas:
                return  # another answer is on its way
            self.made = made[0]
            for o, channels, more in zip(overlays, logs[1:], made[1:], strict=True):
                o.shown = {**channels, **{n: c for n, c in more.items() if isinstance(c, Channel)}}
            self._drop_exports()
            self._draw_log()
        self.touch("log", "formula", "over")

    def set_cursors(self, first: float | None, second: float | None) -> None:
        """Where the cursors of the log's curves are now, s."""
        self.cursors = first, second
        self._drop_exports()
        self.touch("cursors")

    def _drop_exports(self) -> None:
        """Offer no file of channels that was written of other channels or of another part."""
        self.saved = {k: v for k, v in self.saved.items() if not k.startswith("between-")}

    def between(self) -> tuple[float, float] | None:
        """The part of the log between both cursors, s; None where there are not two."""
        a, b = self.cursors
        return None if a is None or b is None or a == b else (min(a, b), max(a, b))

    def save_channels(self, key: str, name: str) -> None:
        """Write all channels, between the cursors, as a log."""
        if self.channels():
            self.do("export", self._save_channels(key, name))

    async def _save_channels(self, key: str, name: str) -> None:
        path, between = self.anew(key, name), self.between()
        channels = {n: c if c.unit else replace(c, unit="-") for n, c in self.channels().items()}
        try:
            await asyncio.get_running_loop().run_in_executor(None, _write_part, path, channels, between)
        except InputError as e:
            raise WorkError(str(e)) from None
        if between == self.between():
            self.saved[key] = path
        self.touch("export")

    def export_command(self, name: str) -> str:
        """The command that writes the same file."""
        words = [w for f in self.formulas if isinstance(self.made.get(f.name), Channel) for w in ("--formula", f.text)]
        if (between := self.between()) is not None:
            words += ["--between", "{:.9g}:{:.9g}".format(*between)]
        return shlex.join(["vaneloop", "map", *self.choice.reading(real=False), *words, "--export", name])

    def lay_over(self, file: LogFile) -> None:
        """Draw another log over this one, read in the same way."""
        if len(self.overlays) < len(OVER) and all(o.file != file for o in self.overlays):
            self.overlays = [*self.overlays, Overlay(file)]
            self.do("over", self._lay_over())

    def take_off(self, overlay: Overlay) -> None:
        """Take a log laid over this one away."""
        self.overlays = [o for o in self.overlays if o is not overlay]
        self.move(overlay, overlay.later)

    def move(self, overlay: Overlay, later: float) -> None:
        """Move a log laid over this one in time."""
        overlay.later = later
        self._draw_log()
        self.touch("over")

    async def _lay_over(self) -> None:
        for o in self.overlays:
            if o.channels is None:
                self.words()
                words = replace(self.choice, file=o.file).reading(real=True)
                try:
                    o.channels = (await self.bench.call("over", "reading the other log", words=words))["channels"]
                except (WorkError, Cancelled):
                    if o in self.overlays:
                        self.take_off(o)
                    raise
                await self._make_channels()

    async def _compare(self) -> None:
        words = self.words()
        self.compared = await self.search.call("compare", "comparing", words=words)
        worst = max(self.compared["figures"], key=lambda f: f.rms / f.noise_floor)
        self.show(worst.stage)
        self.touch("compare", "diagnosis")
        if self.choice.system is None:
            self.do("loop", self._whole_loop(self.compared))

    async def _whole_loop(self, compared: dict[str, Any]) -> None:
        floors = {f.signal: f.noise_floor for f in compared["figures"]}
        loop = await self.bench.call("whole_loop", "", words=self.words(), floors=floors)
        if self.compared is compared:
            self.loop = loop
        self.touch("loop")

    def show(self, stage: str) -> None:
        """Show this stage's curves."""
        self.stage = stage
        self._draw()
        self.touch("compare", "diagnosis", "fit")

    # ---- the search

    def diagnose(self) -> None:
        """Search for missing effects."""
        if self.compared is not None and not self.working["diagnose"]:
            self.do("diagnose", self._diagnose())

    def _news(self, news: dict[str, str]) -> None:
        self.sofar.append(news["found"])
        self.touch("sofar")

    async def _diagnose(self) -> None:
        words = self.words()
        self.sofar = []
        self.touch("sofar")
        self.touch("diagnosis")
        try:
            self.diagnosis = await self.search.call("diagnose", "searching the library of effects", words=words)
        finally:
            self.sofar = []  # said by the answer, or nothing is kept of it
            self.touch("sofar")
        self.experiment, self.experiment_done, self.learned = None, False, None
        d = self.diagnosis["diagnosis"]
        self.chosen = {s.stage: tuple(f.effect for f in s.effects) for s in d.stages}
        bad = [s for s in d.stages if s.verdict != "none"]
        if bad:
            self.stage = max(bad, key=lambda s: float((s.error_before / s.floor).max())).stage
        self.touch("diagnosis", "compare")
        self.do("fit", self._fit(self.stage))
        self.do("ahead", self._ahead())

    def stage_diagnosis(self) -> Any:
        """What the diagnosis says about the stage shown; None without one."""
        if self.diagnosis is None:
            return None
        return next((s for s in self.diagnosis["diagnosis"].stages if s.stage == self.stage), None)

    def effects(self) -> list[str]:
        """Effects of the stage shown, those found first, then by what they gain alone."""
        s = self.stage_diagnosis()
        if s is None:
            return []
        found = [f.effect for f in s.effects]
        rivals = [r for f in s.effects for r in f.rivals]
        rest = sorted(s.candidates, key=lambda c: -c.nats)
        return list(dict.fromkeys([*found, *rivals, *(c.effect for c in rest)]))

    async def _ahead(self) -> None:
        """Fits that the user will ask for next: each found effect taken away, each leader added."""
        d = self.diagnosis
        assert d is not None
        for s in sorted(d["diagnosis"].stages, key=lambda s: s.verdict == "none"):
            found = tuple(f.effect for f in s.effects)
            if s.verdict == "none":
                continue
            rivals = [r for f in s.effects for r in f.rivals]
            leaders = [c.effect for c in sorted(s.candidates, key=lambda c: -c.nats) if c.nats > 0][:LEADERS]
            sets: list[tuple[str, ...]] = [found, (), *(tuple(e for e in found if e != x) for x in found)]
            sets += [(e,) for e in (*rivals, *leaders)] + [(*found, e) for e in (*rivals, *leaders)]
            for effects in sets:
                key = s.stage, frozenset(effects)
                if self.diagnosis is d and key not in self.fits and len(set(effects)) == len(effects):
                    await self._make(s.stage, effects, self.search)

    async def _make(self, stage: str, effects: tuple[str, ...], worker: Worker) -> None:
        words = self.words()
        d = self.diagnosis
        text = f"fitting {' + '.join(effects) or 'the nominal model'}"
        answer = await worker.call(
            "refit" if worker is self.bench else "ahead", text, words=words, stage=stage, effects=effects
        )
        if self.diagnosis is d:
            self.fits[stage, frozenset(effects)] = Fitted(**answer)

    def switch(self, effect: str, on: bool) -> None:
        """Add an effect to the model of the stage shown, or take it away."""
        stage = self.stage
        before = self.chosen.get(stage, ())
        now = [e for e in before if e != effect]
        self.chosen[stage] = tuple([*now, effect] if on else now)
        self.hand, self.hand_rms = {}, {}
        self.do("fit", self._switched(stage, self.chosen[stage], before))

    async def _switched(self, stage: str, now: tuple[str, ...], before: tuple[str, ...]) -> None:
        """Fit what is switched on ``now``; where that fails or is stopped, the switches go back."""
        try:
            await self._fit(stage)
        except (WorkError, Cancelled):
            if self.chosen.get(stage) == now:
                self.chosen[stage] = before
            raise

    async def _fit(self, stage: str) -> None:
        effects = self.chosen.get(stage, ())
        if (stage, frozenset(effects)) not in self.fits:
            async with self._fitting:
                if effects != self.chosen.get(stage, ()):
                    return  # switched again meanwhile
                self.touch("fit")
                await self._make(stage, effects, self.bench)
        if stage == self.stage and effects == self.chosen.get(stage, ()):
            self._draw()
            self.touch("fit")

    def fitted(self) -> Fitted | None:
        """The fit of the effects that are switched on, if it is there."""
        return self.fits.get((self.stage, frozenset(self.chosen.get(self.stage, ()))))

    def shown_fit(self) -> Fitted | None:
        """The fit that the page shows: the one of the switches, or while that is being made the one before."""
        f = self.fitted()
        if f is not None or not self.working["fit"]:
            self._last_fit = f
        return self._last_fit if self._last_fit is not None and self._last_fit.result.stage == self.stage else f

    def values(self) -> dict[str, dict[str, float]]:
        """Parameters of the effects that are on: as fitted, or as set by hand."""
        f = self.fitted()
        if f is None:
            return {}
        fitted = {e.effect: {k: float(v["value"]) for k, v in e.parameters.items()} for e in f.result.effects}
        return {e: {**p, **self.hand.get(e, {})} for e, p in fitted.items()}

    def turn(self, effect: str, parameter: str, value: float) -> None:
        """Set a parameter by hand."""
        self.hand.setdefault(effect, {})[parameter] = value
        if not self._hand_wanted:
            self._hand_wanted = True
            if self.busy("hand") is None:
                self.do("hand", self._turned())

    def release(self) -> None:
        """Back to the fitted parameters."""
        self.hand, self.hand_rms = {}, {}
        self._draw()
        self.touch("fit", "hand")

    async def _turned(self) -> None:
        while self._hand_wanted:  # the latest position wins
            self._hand_wanted = False
            f, stage = self.fitted(), self.stage
            if f is None or not self.hand:
                return
            given = {"stage": stage, "theta": f.theta, "floor": f.floor, "values": self.values()}
            answer = await self.bench.call("hand", "", words=self.words(), **given)
            if self.hand and stage == self.stage and f is self.fitted():
                self.hand_rms = answer["rms"]
                self._draw(answer["curves"])
                self.touch("hand")

    # ---- curves of the stage shown

    def _draw(self, by_hand: dict[str, Any] | None = None) -> None:
        f = self.fitted() if self.diagnosis else None
        curves = f.curves if f is not None else (self.compared or {}).get("curves", {}).get(self.stage)
        key = f"{self.choice.file.path if self.choice.file else ''} {self.stage}"
        self.curves["stage"] = of_stage(curves, by_hand, key) if curves is not None else Curves()

    # ---- what comes next

    def recommend(self) -> None:
        """Look for the experiment that separates the rivals."""
        if self.diagnosis is not None and not self.working["experiment"]:
            self.do("experiment", self._recommend())

    async def _recommend(self) -> None:
        assert self.diagnosis is not None
        given = {"words": self.words(), "diagnosis": self.diagnosis["diagnosis"]}
        self.experiment = await self.search.call("experiment", "trying demand profiles", **given)
        self.experiment_done = True
        self.touch("experiment")

    def anew(self, key: str, name: str) -> Path:
        """Where a file to be downloaded is written; an earlier one is offered no more."""
        self.saved.pop(key, None)
        path = self.folder / name
        path.unlink(missing_ok=True)
        return path

    def save_report(self) -> None:
        """Write the report of the diagnosis."""
        if self.diagnosis is not None:
            self.do("save", self._save_report())

    async def _save_report(self) -> None:
        assert self.diagnosis is not None
        path = self.anew("report", "diagnosis.html")
        self.touch("save")
        await self.search.call(
            "report", "writing the report", words=self.words(), diagnosis=self.diagnosis["diagnosis"],
            path=str(path),
            command=self.command("diagnose", "--report", "diagnosis.html"), next_experiment=self.experiment,
        )  # fmt: skip
        self.saved["report"] = path
        self.touch("save")

    def all_chosen(self) -> list[str]:
        """Effects that are switched on, over all stages."""
        return list(dict.fromkeys(e for effects in self.chosen.values() for e in effects))

    def extend_words(self) -> list[str]:
        """Options of ``vaneloop extend`` beyond the log's."""
        effects = [w for e in self.all_chosen() for w in ("--effect", e)]
        return [*effects, "--out", "extended.toml", "--report", "extended.html"]

    def save_model(self, law: Path | None = None) -> None:
        """Run ``vaneloop extend`` with the effects that are switched on, and with a law that was learned."""
        if self.all_chosen() or law:
            self.do("save", self._save_model(["--effect", str(law)] if law else []))

    async def _save_model(self, law: list[str]) -> None:
        words = ["extend", *self.words(), *law, *self.extend_words()]
        for name in ("extended.toml", "extended.html"):
            words[words.index(name)] = str(self.folder / name)
        files = {"model": self.anew("model", "extended.toml"), "extended": self.anew("extended", "extended.html")}
        self.touch("save")
        await self.bench.call("command", "extending the model", words=words)
        self.saved |= {k: f for k, f in files.items() if f.exists()}  # nothing is written that is no better
        self.touch("save")

    def save_mapping(self) -> None:
        """Run ``vaneloop map`` for the file that ``--mapping`` takes."""
        if self.choice.file is not None:
            self.do("mapping", self._save_mapping())

    async def _save_mapping(self) -> None:
        path = self.anew("mapping", "mapping.toml")
        self.touch("mapping")
        self.words()
        words = ["map", *self.choice.reading(real=True), "--out", str(path)]
        await self.bench.call("command", "writing the mapping file", words=words)
        if path.exists():
            self.saved["mapping"] = path
        self.touch("mapping")

    def stop(self, *names: str) -> None:
        """End jobs of these names (or of any) and whatever else their processes do."""
        for w in (self.search, self.bench, *([self.aside] if names else [])):
            if any(j.name in names or not names for j in w.jobs.values()):
                w.stop()
        self._hand_wanted = False
        self.touch("jobs")


def _channels(told: Mapping[str, tuple[str, Any, Any]]) -> dict[str, Channel]:
    """Channels as the worker tells them: name -> unit, s, values."""
    return {name: Channel(t, values, unit=unit) for name, (unit, t, values) in told.items()}


def _told(channels: Mapping[str, Channel]) -> dict[str, tuple[str, Any, Any]]:
    return {name: (c.unit, c.t, c.values) for name, c in channels.items()}


def _made(formulas: Sequence[Formula], channels: Mapping[str, Channel]) -> dict[str, Channel | str]:
    """What each formula makes of a log's channels, or the line that says why it makes none."""
    out: dict[str, Channel | str] = {}
    there = dict(channels)
    for f in formulas:
        try:
            if f.name in channels:
                raise InputError(f"formula {f.text!r}, position 1: this log has a channel {f.name!r}")
            t, values, unit = f.made(there)
            out[f.name] = there[f.name] = Channel(t, values, unit=unit)
        except InputError as e:
            out[f.name] = str(e)
    return out


def _write_part(path: Path, channels: dict[str, Channel], between: tuple[float, float] | None) -> None:
    log = Log(path.name, channels, signals={})
    if between is not None:
        log = log[between[0] : between[1]]
    write_log(path, log.channels)


def _digest(path: Path) -> str:
    """What a file says, in short; "" where it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
