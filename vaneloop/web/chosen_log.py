"""The log of page 1: dropped or chosen, its names and units, and what is in it."""

from __future__ import annotations

import html
from typing import Any

from nicegui import events, ui

from hil.logs.formats import suffixes as log_suffixes
from plant import load_geometry
from vaneloop.base.signals import UNITS
from vaneloop.base.vanes import VANES
from vaneloop.verbs.machine import files_of
from vaneloop.web.charts import OVER, Chart
from vaneloop.web.formulas import FormulaPart
from vaneloop.web.frame import Live, card, drop, list_of_moments, notes_of, opened, table
from vaneloop.web.further import FurtherPart
from vaneloop.web.session import CODE, OTHER_SUFFIXES, STOPPED, LogFile, Session, safe_name

__all__ = ["ChosenLog", "receive", "suffixes"]

EXAMPLE = "hidden_effect.parquet"
VANE_CHAIN = "the vane chain"
MOST_SHOWN = 200_000  # characters of code


def suffixes() -> str:
    """What an upload accepts."""
    return ",".join((*log_suffixes(), *OTHER_SUFFIXES))


async def receive(s: Session, e: events.UploadEventArguments, section: str, own: bool = False) -> LogFile | None:
    """Keep an uploaded file in the session's private folder; None, and a complaint, where it is of no kind that we
    know.

    own  a model of the user's own is taken too, and for one that has a reader of its own any file as a log
    """
    name = safe_name(e.file.name)
    code = own and name.lower().endswith(CODE)
    said = ""
    if code and not s.takes_code:
        said = (
            f"{name}: is code, which is taken from this machine only; allowed: a file in the folder that the workbench "
            f"was started with (--folder)"
        )
    elif not code and not name.lower().endswith((*log_suffixes(), *OTHER_SUFFIXES)) and not (own and s.choice.system):
        said = (
            f"{name}: suffix {name[name.rfind('.') :] if '.' in name else ''!r} is not a log's; allowed: "
            f"{', '.join(log_suffixes())}"
        )
    if said:
        s.errors[section] = said
        s.touch(section)
        return None
    folder = s.folder / f"upload{len(list(s.folder.glob('upload*'))) + 1}"
    folder.mkdir(mode=0o700)
    path = folder / name
    await e.file.save(path)
    path.chmod(0o600)
    file = LogFile(path, name, name)
    if code:
        s.models.append(file)
    elif not name.lower().endswith(OTHER_SUFFIXES):
        s.files.append(file)
    s.touch("files")
    return file


class ChosenLog:
    """The card of the log."""

    def __init__(self, session: Session, live: Live, most: int):
        self.s, self.live, self.most = session, live, most

    def card(self) -> None:
        """Drop or choose a log; names and units by form; the preview."""
        about = (
            "A measured run: any CAN log, MDF4, CSV or Parquet. It stays on this machine. It is held against the vane "
            "chain, or against a model of your own: a Python file with a vaneloop.System in it."
        )
        with card("1  The log", about):
            with ui.element("div").classes("two"):
                with ui.element("div").classes("stackc"):
                    s = self.s
                    self.upload = drop("Drop a log here", self.most, "", self._uploaded, self._rejected)
                    self._accept()
                    self.live.watch(self._accept, "model", of=self.upload)
                    self.live.part(
                        self._model, "files", "model", "log",
                        shows=lambda: (tuple(f.name for f in s.models), s.choice.system, s.asked),
                    )  # fmt: skip
                    self.live.complaint("model")
                    self.live.part(self._asks, "model", shows=lambda: (s.asked,))
                    self.live.part(
                        self._choose, "files", "log", shows=lambda: (tuple(f.name for f in s.files), s.choice.file)
                    )
                    self.live.complaint("log")
                    self.live.progress("offers", "look", "preview")
                    self.live.part(self._loading, "jobs", shows=lambda: (s.search.loading if not s.jobs else "",))
                    self.live.part(self._about, "log", shows=lambda: (s.preview,))
                with ui.element("div").classes("stackc"):
                    self.live.part(self._channels, "log", shows=lambda: (s.choice.file, s.preview, *s.choice.beside()))
            self.live.part(self._form, "log", "compare", shows=self._form_shows)
            FurtherPart(self.s, self.live)
            with ui.expansion("All channels", value=False).classes("w-full") as all_channels:
                self.live.part(
                    self._other,
                    "files",
                    "log",
                    "over",
                    shows=lambda: (tuple(f.name for f in s.files), s.choice.file, tuple(map(id, s.overlays))),
                )
                self.live.complaint("over")
                self.live.progress("over")
                list_of_moments(self.live, lambda: s.moments, lambda t: chart.run_method("moment", t), "log")
                chart = Chart("log", tree=True, cursors=s.cursors)
                chart.on("cursors", lambda e: s.set_cursors(*e.args))
                FormulaPart(s, self.live).build()
            all_channels.props("dense")
            self.live.watch(chart.refetch, "log", "over")

    def _loading(self) -> None:
        """What goes on before a log can be read at once."""
        if self.s.search.loading and not self.s.jobs:
            text = f"{self.s.search.loading} Choose a log meanwhile; it is read as soon as this is done."
            ui.label(text).classes("note").props('role="status"')

    def _choose(self) -> None:
        s = self.s
        options = {i: f.name for i, f in enumerate(s.files)}
        at = next((i for i, f in enumerate(s.files) if f == s.choice.file), None)

        def chosen(e: events.ValueChangeEventArguments[Any]) -> None:
            if e.value is not None and s.files[e.value] != s.choice.file:
                s.choose(s.files[e.value])

        ui.select(options, value=at, label="or choose one", on_change=chosen).props(
            "outlined dense options-dense"
        ).classes("choose")

    def _accept(self) -> None:
        """What the field takes: logs and what goes beside them; any file where the model may read logs of its own."""
        self.upload.props["accept"] = "" if self.s.choice.system else f"{suffixes()},{CODE}"
        self.upload.update()

    def _model(self) -> None:
        """What the log is held against."""
        s = self.s
        options = {-1: VANE_CHAIN, **{i: f.name for i, f in enumerate(s.models)}}
        at = next((i for i, f in enumerate(s.models) if f == (s.asked or s.choice.system)), -1)

        def chosen(e: events.ValueChangeEventArguments[Any]) -> None:
            s.hold_against(s.models[e.value] if e.value is not None and e.value >= 0 else None)

        ui.select(options, value=at, label="held against", on_change=chosen).props(
            "outlined dense options-dense"
        ).classes("choose-model")

    def _asks(self) -> None:
        """Whether the code of a model may run."""
        s = self.s
        if s.asked is None:
            return
        with ui.element("div").classes("verdict asks stackc").props('role="alert"'):
            ui.label(f"{s.asked.name} is code: it would run on this machine with your rights.").classes("asked")
            ui.label(
                "It could read, change or send whatever you may. Nothing of it has run. Run it only if you trust its "
                "author."
            ).classes("small")
            with ui.expansion("Show the code").props("dense").classes("w-full"):
                text = s.asked.path.read_text(encoding="utf-8", errors="replace")[:MOST_SHOWN]
                ui.html(
                    f'<pre class="mono scroll" tabindex="0" role="group" aria-label="code">{html.escape(text)}</pre>',
                    sanitize=False,
                )
            with ui.element("div").classes("rowc"):
                ui.button("Run it", icon="play_arrow", on_click=s.allow).props(
                    "outline dense padding='4px 14px'"
                ).classes("run-code")
                ui.button("Leave it", on_click=s.refuse).props("flat dense padding='4px 14px'").classes("leave-code")

    def _other(self) -> None:
        """Other logs laid over this one."""
        s = self.s
        if s.choice.file is None:
            return

        def lay(e: events.ValueChangeEventArguments[Any]) -> None:
            if e.value is not None:
                s.lay_over(s.files[e.value])

        with ui.element("div").classes("rowc"):
            for o in s.overlays:
                with ui.element("div").classes("rowc overlay"):
                    ui.label(o.file.name).classes("small")
                    later = ui.number(
                        "later by [s]", value=o.later, on_change=lambda e, o=o: s.move(o, float(e.value or 0.0))
                    )
                    later.props("outlined dense debounce=500").style("width:120px")
                    ui.button(icon="close", on_click=lambda o=o: s.take_off(o)).props(
                        f'flat dense round size=sm aria-label="take {html.escape(o.file.name)} away"'
                    )
            if len(s.overlays) < len(OVER):
                on = [o.file for o in s.overlays]
                options = {i: f.name for i, f in enumerate(s.files) if f != s.choice.file and f not in on}
                other = ui.select(options, label="lay another log over it", on_change=lay)
                other.props("outlined dense options-dense").style("min-width:240px").classes("other")

    async def _uploaded(self, e: events.UploadEventArguments) -> None:
        file = await receive(self.s, e, "log", own=True)
        self.upload.reset()
        if file is not None:
            self.s.choose(file)

    def _rejected(self) -> None:
        limit = f"{self.most / 2**20:.0f} MB"
        self.s.errors["log"] = (
            f"this file cannot be taken: it is larger than {limit}, or no log ({', '.join(log_suffixes())}) and no "
            f"model ({CODE})"
        )
        self.s.touch("log")

    def _about(self) -> None:
        s = self.s
        if s.preview is not None:
            guesses = [n for n in s.preview["notes"] if "guessed to be" in n]
            notes_of(s, "What reading did to the log", s.preview["notes"], guesses)
            if guesses:
                what = "1 name or unit is" if len(guesses) == 1 else f"{len(guesses)} names and units are"
                ui.label(f"note: {what} guessed; see below").classes("note")

    def _channels(self) -> None:
        s = self.s
        if s.choice.file is None:
            example = next((f for f in s.files if f.path.name == EXAMPLE), None)
            more = " The example is a log of a machine with two effects that the model lacks." if example else ""
            ui.label(f"Nothing chosen yet.{more}").classes("soft")
            if example is not None:
                ui.button("Open the example", icon="folder_open", on_click=lambda: s.choose(example)).props(
                    "unelevated dense padding='4px 14px'"
                ).classes("open-example self-start")
            if beside := s.choice.beside():
                ui.label(f"For the log to come: {' and '.join(beside)}.").classes("soft for-the-next").props(
                    'role="status"'
                )
            return
        if s.preview is None:
            return
        rows = []
        for name, (unit, t, v) in s.preview["channels"].items():
            step = f"{1.0 / ((t[-1] - t[0]) / (len(t) - 1)):.4g}" if len(t) > 1 and t[-1] > t[0] else "-"
            given = s.seen["signals"].get(name, (name,))[0] if s.seen else name
            rows.append([name, given, unit, f"{len(t):,}", step, f"{t[-1]:.1f}", f"{v.min():.4g} to {v.max():.4g}"])
        table(["signal", "in the log", "unit", "samples", "per s", "until s", "range"], rows, numbers=(3, 4, 5, 6))
        absent = [n for n in self._signals() if n not in s.preview["channels"]]
        if absent:
            ui.label(f"not in the log: {', '.join(absent)}").classes("note")

    def _signals(self) -> list[str]:
        """Signals that this machine has, and those of other machines that the log has or a name was given for; those of
        a model of the user's own.
        """
        s = self.s
        if s.choice.system is not None:
            return list(s.seen["ours"]) if s.seen else []
        own = load_geometry(files_of(s.tables)["geometry"]).vanes
        there = {*own, *(s.seen or {}).get("signals", ()), *(s.preview or {}).get("channels", ()), *s.choice.mapping}
        return [n for n in UNITS if n not in VANES or n in there]

    def _wrong(self) -> bool:
        return any(self.s.errors.get(x, STOPPED) != STOPPED for x in ("log", "compare"))

    def _form_shows(self) -> tuple[Any, ...]:
        s, c = self.s, self.s.choice
        return (
            c.file,
            c.dbc,
            c.model,
            c.bench,
            c.system,
            tuple(s.offered),
            repr(s.seen),
            c.guess,
            tuple(c.mapping.items()),
            tuple(c.units.items()),
            c.design_rpm,
            self._wrong(),
        )

    def _form(self) -> None:
        s = self.s
        if s.choice.file is None or not s.offered or s.seen is None or s.seen["damaged"]:
            return
        choice, seen, draft = s.choice, s.seen, s.draft
        guessed = any(row[2] == "guessed" for row in seen["signals"].values())

        def apply() -> None:
            choice.mapping, choice.units = (
                {k: v for k in ("t", *seen["ours"]) if (v := draft.get(f"{what} {k}", of.get(k, "")).strip())}
                for what, of in (("name", choice.mapping), ("unit", choice.units))
            )
            choice.design_rpm = draft.get("rpm", choice.design_rpm)
            draft.clear()
            s.read()

        def field(key: str, now: str, hint: str, label: str) -> ui.input:
            """A field whose text is kept while it is typed, and read on Enter."""

            def typed(e: events.ValueChangeEventArguments[Any]) -> None:
                draft[key] = str(e.value or "")

            out = ui.input(value=draft.get(key, now), placeholder=hint, on_change=typed)
            out.props(f'outlined dense stack-label aria-label="{label}"')
            return out.on("keydown.enter", apply)

        with opened(s, "Names and units", self._wrong() or guessed or bool(seen["open"])).classes("names"):
            ui.label(
                "Where the log calls a signal otherwise, or has it in another unit. Empty: our own name, or the guess "
                "in grey, and the unit that the log states. Enter reads the log again."
            ).classes("soft small")
            with ui.element("datalist").props("id=names-of-the-log"):
                for name in s.offered[:500]:
                    ui.element("option").props["value"] = name
            with ui.element("div").style(
                "display:grid;width:100%;grid-template-columns:repeat(auto-fill,minmax(min(330px,100%),1fr));"
                "gap:8px 18px;margin:8px 0"
            ):
                for signal in ("t", *self._signals()):
                    name, unit, how, sure, why, curve = seen["signals"].get(signal, ("", "", "", 0.0, "", []))
                    with ui.element("div").style(
                        "display:grid;grid-template-columns:66px minmax(0,1fr) 84px;gap:2px 8px;"
                        "align-items:center;align-content:start"
                    ):
                        ui.label(signal).classes("mono")
                        label = f"name of {signal} in the log"
                        box = field(f"name {signal}", choice.mapping.get(signal, ""), name, label)
                        box.props("list=names-of-the-log")
                        own = unit or seen["ours"].get(signal, "s")
                        field(f"unit {signal}", choice.units.get(signal, ""), own, f"unit of {signal} in the log")
                        if how or signal in seen["open"]:
                            ui.html(_curve(curve), sanitize=False)
                            said = f"guessed, {100 * sure:.0f} % sure" if how == "guessed" else how
                            words = f"{said}: {why}" if said and why else said or seen["open"][signal]
                            ui.label(words).classes("soft small guess").style("grid-column:span 2")
            if seen["unused"]:
                ui.label("Names of the log that are not used:").classes("small")
                about = 'tabindex=0 aria-label="names of the log that are not used"'
                with ui.element("ul").classes("unused soft small").props(about):
                    for line in seen["unused"]:
                        with ui.element("li"):
                            ui.label(line)
            with ui.element("div").classes("rowc"):
                hint = f"{seen['suggested_rpm']:g}?" if seen["suggested_rpm"] else ""
                rpm = field("rpm", choice.design_rpm, hint, "design speed [rpm]").style("width:170px")
                rpm.props('label="design speed [rpm]"')
                if (suggested := seen["suggested_rpm"]) and not choice.design_rpm:

                    def take() -> None:
                        draft["rpm"] = f"{suggested:g}"
                        apply()

                    ui.button(f"Use {suggested:g} rpm", on_click=take).props(
                        "outline dense padding='4px 14px'"
                    ).classes("use-rpm")
                beside = choice.beside()
                ui.label(
                    "with " + " and ".join(beside)
                    if beside
                    else "a .dbc, a mapping .toml or a model .toml: drop it above"
                ).classes("soft small")

                def plain() -> None:
                    choice.dbc = choice.model = choice.bench = None
                    choice.mapping, choice.units, choice.design_rpm = {}, {}, ""
                    draft.clear()
                    s.read()

                def guessing(e: events.ValueChangeEventArguments[Any]) -> None:
                    choice.guess = bool(e.value)
                    apply()

                ui.checkbox("guess what is not stated", value=choice.guess, on_change=guessing)
                ui.button("Save as mapping file", icon="save", on_click=s.save_mapping).props(
                    "outline dense padding='4px 14px'"
                ).classes("save-mapping")
                ui.button("Read again", icon="refresh", on_click=apply).props("unelevated dense padding='4px 14px'")
                ui.button("Forget all of it", on_click=plain).props("flat dense padding='4px 14px'")
                self.live.complaint("mapping")
                self.live.part(lambda: _mapping_link(s), "mapping", shows=lambda: ("mapping" in s.saved,))


def _mapping_link(s: Session) -> None:
    """The mapping file, where it has been written."""
    if "mapping" in s.saved:
        ui.link("download mapping.toml", "/saved/mapping").props('download="mapping.toml"').classes("saved-mapping")


def _curve(values: list[float]) -> str:
    """A small picture of a signal over time, as SVG."""
    low, span = (min(values), (max(values) - min(values)) or 1.0) if values else (0.0, 1.0)
    points = " ".join(
        f"{58.0 * k / max(len(values) - 1, 1) + 1.0:.1f},{15.0 - 14.0 * (v - low) / span:.1f}"
        for k, v in enumerate(values)
    )
    line = f'<polyline points="{points}" fill="none" stroke="currentColor" stroke-width="1.2"/>'
    return f'<svg class="spark" width="60" height="16" viewBox="0 0 60 16" aria-hidden="true">{line}</svg>'
