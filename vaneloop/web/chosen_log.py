"""The log of page 1: dropped or chosen, its names and units, and what is in it."""

from __future__ import annotations

from typing import Any

from nicegui import events, ui

from vaneloop.base.signals import UNITS
from vaneloop.web.charts import Chart
from vaneloop.web.frame import Live, card, opened, table
from vaneloop.web.session import LOG_SUFFIXES, OTHER_SUFFIXES, LogFile, Session, safe_name

__all__ = ["ChosenLog", "receive", "suffixes"]


def suffixes() -> str:
    """What an upload accepts."""
    return ",".join((*LOG_SUFFIXES, *OTHER_SUFFIXES))


async def receive(s: Session, e: events.UploadEventArguments, section: str) -> LogFile | None:
    """Keep an uploaded file in the session's private folder; None, and a complaint, where it is of no kind that we
    know.
    """
    name = safe_name(e.file.name)
    if not name.lower().endswith((*LOG_SUFFIXES, *OTHER_SUFFIXES)):
        s.errors[section] = (
            f"{name}: suffix {name[name.rfind('.') :] if '.' in name else ''!r} is not a log's; allowed: "
            f"{', '.join(LOG_SUFFIXES)}"
        )
        s.touch(section)
        return None
    folder = s.folder / f"upload{len(list(s.folder.glob('upload*'))) + 1}"
    folder.mkdir(mode=0o700)
    path = folder / name
    await e.file.save(path)
    path.chmod(0o600)
    file = LogFile(path, name, name)
    if name.lower().endswith(LOG_SUFFIXES):
        s.files.append(file)
    s.touch("files")
    return file


class ChosenLog:
    """The card of the log."""

    def __init__(self, session: Session, live: Live, most: int):
        self.s, self.live, self.most = session, live, most

    def card(self) -> None:
        """Drop or choose a log; names and units by form; the preview."""
        with card("1  The log", "A measured run: any CAN log, MDF4, CSV or Parquet. It stays on this machine."):
            with ui.element("div").classes("two"):
                with ui.element("div").classes("stackc"):
                    self.upload = ui.upload(
                        label="drop a log here, or press +", auto_upload=True, max_file_size=self.most,
                        on_upload=self._uploaded,
                        on_rejected=self._rejected,
                    )  # fmt: skip
                    self.upload.props(f'accept="{suffixes()}" flat')
                    s = self.s
                    self.live.part(
                        self._choose, "files", "log", shows=lambda: (tuple(f.name for f in s.files), s.choice.file)
                    )
                    self.live.complaint("log")
                    self.live.progress("offers", "preview")
                    self.live.part(self._about, "log", shows=lambda: (s.preview,))
                with ui.element("div").classes("stackc"):
                    self.live.part(self._channels, "log", shows=lambda: (s.choice.file, s.preview))
            self.live.part(self._form, "log", "compare", shows=self._form_shows)
            with ui.expansion("All channels", value=False).classes("w-full") as all_channels:
                chart = Chart("log")
            all_channels.props("dense")
            self.live.watch(chart.refetch, "log")

    def _choose(self) -> None:
        s = self.s
        options = {i: f.name for i, f in enumerate(s.files)}
        at = next((i for i, f in enumerate(s.files) if f == s.choice.file), None)

        def chosen(e: events.ValueChangeEventArguments[Any]) -> None:
            if e.value is not None and s.files[e.value] != s.choice.file:
                s.choose(s.files[e.value])

        ui.select(options, value=at, label="or choose one", on_change=chosen).props(
            "outlined dense options-dense"
        ).classes("w-full choose")

    async def _uploaded(self, e: events.UploadEventArguments) -> None:
        file = await receive(self.s, e, "log")
        self.upload.reset()
        if file is not None:
            self.s.choose(file)

    def _rejected(self) -> None:
        limit = f"{self.most / 2**20:.0f} MB"
        self.s.errors["log"] = (
            f"this file cannot be taken: it is larger than {limit}, or no log ({', '.join(LOG_SUFFIXES)})"
        )
        self.s.touch("log")

    def _about(self) -> None:
        s = self.s
        if s.preview is not None:
            for note in s.preview["notes"][:6]:
                ui.label(f"note: {note}").classes("note")

    def _channels(self) -> None:
        s = self.s
        if s.choice.file is None:
            ui.label(
                "Nothing chosen yet. The example hidden_effect.parquet is a machine with two effects that the model "
                "lacks."
            ).classes("soft")
            return
        if s.preview is None:
            return
        rows = []
        for name, (unit, t, v) in s.preview["channels"].items():
            step = f"{1.0 / ((t[-1] - t[0]) / (len(t) - 1)):.4g}" if len(t) > 1 and t[-1] > t[0] else "-"
            given = s.choice.mapping.get(name, name)
            rows.append([name, given, unit, f"{len(t):,}", step, f"{t[-1]:.1f}", f"{v.min():.4g} to {v.max():.4g}"])
        table(["signal", "in the log", "unit", "samples", "per s", "until s", "range"], rows, numbers=(3, 4, 5))
        absent = [n for n in UNITS if n not in s.preview["channels"]]
        if absent:
            ui.label(f"not in the log: {', '.join(absent)}").classes("note")

    def _wrong(self) -> bool:
        return any(self.s.errors.get(x, "stopped") != "stopped" for x in ("log", "compare"))

    def _form_shows(self) -> tuple[Any, ...]:
        s, c = self.s, self.s.choice
        return (
            c.file,
            c.dbc,
            c.model,
            tuple(s.offered),
            tuple(c.mapping.items()),
            tuple(c.units.items()),
            c.design_rpm,
            self._wrong(),
        )

    def _form(self) -> None:
        s = self.s
        if s.choice.file is None or not s.offered:
            return
        choice = s.choice
        with opened(s, "Names and units", self._wrong()).classes("names"):
            ui.label(
                "Where the log calls a signal otherwise, or has it in another unit. Empty: our own name, and the unit "
                "that the log states."
            ).classes("soft small")
            names: dict[str, ui.select] = {}
            units: dict[str, ui.input] = {}
            with ui.element("div").style(
                "display:grid;grid-template-columns:repeat(auto-fill,minmax(330px,1fr));gap:8px 18px;margin:8px 0"
            ):
                for signal in ("t", *UNITS):
                    with ui.element("div").style(
                        "display:grid;grid-template-columns:66px minmax(0,1fr) 84px;gap:8px;align-items:center"
                    ):
                        ui.label(signal).classes("mono")
                        options = ["", *s.offered]
                        value = choice.mapping.get(signal, "")
                        names[signal] = ui.select(
                            options, value=value if value in options else "", with_input=True
                        ).props(f'outlined dense options-dense clearable aria-label="name of {signal} in the log"')
                        hint = UNITS.get(signal, "s")
                        units[signal] = ui.input(value=choice.units.get(signal, ""), placeholder=hint).props(
                            f'outlined dense aria-label="unit of {signal} in the log"'
                        )
            with ui.element("div").classes("rowc"):
                rpm = (
                    ui.input("design speed [rpm]", value=choice.design_rpm).props("outlined dense").style("width:170px")
                )
                beside = [f for f in (choice.dbc, choice.model) if f is not None]
                ui.label(
                    "with " + " and ".join(f.name for f in beside)
                    if beside
                    else "a .dbc or a model .toml: drop it above"
                ).classes("soft small")

                def apply() -> None:
                    choice.mapping = {k: str(v.value) for k, v in names.items() if v.value}
                    choice.units = {k: str(v.value).strip() for k, v in units.items() if (v.value or "").strip()}
                    choice.design_rpm = str(rpm.value or "")
                    s.read()

                def plain() -> None:
                    choice.dbc = choice.model = None
                    choice.mapping, choice.units, choice.design_rpm = {}, {}, ""
                    s.read()

                ui.button("Read again", icon="refresh", on_click=apply).props("unelevated dense padding='4px 14px'")
                ui.button("Forget all of it", on_click=plain).props("flat dense padding='4px 14px'")
