"""Page 1, Missing physics: a log in, where the model fails, which effect it lacks, and the error falling."""

from __future__ import annotations

import math
from typing import Any

from nicegui import events, ui

from plant.effects import EFFECTS
from vaneloop.base.signals import UNITS
from vaneloop.discrepancy.locate import AGREES, Located
from vaneloop.pages.figures import Line as PageLine
from vaneloop.pages.figures import Panel as PagePanel
from vaneloop.pages.figures import heat, overlay, waterfall
from vaneloop.pages.style import number
from vaneloop.web.charts import Chart
from vaneloop.web.frame import Live, card, command_line, dark, figure_of, frame, opened, table, tone
from vaneloop.web.session import LOG_SUFFIXES, OTHER_SUFFIXES, LogFile, Session, safe_name

__all__ = ["build", "receive", "suffixes"]


def build(session: Session, most: int) -> None:
    """Draw the page; ``most`` is the largest upload in bytes."""
    with frame(session, "/"):
        live = Live(session)
        page = _Page(session, live, most)
        page.log()
        page.where()
        page.what()
        page.next()


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


class _Page:
    def __init__(self, session: Session, live: Live, most: int):
        self.s, self.live, self.most = session, live, most
        self.readout: ui.label | None = None
        self.sliders: dict[tuple[str, str], tuple[ui.slider, ui.label]] = {}
        self.switches: dict[str, tuple[ui.switch, ui.element]] = {}

    def _stage_toggle(self, stages: list[str], props: str) -> None:
        """Choose the stage shown; follows where it is chosen elsewhere."""
        s = self.s

        def chosen(e: events.ValueChangeEventArguments[Any]) -> None:
            if e.value and e.value != s.stage:
                s.show(e.value)

        toggle = ui.toggle(stages, value=s.stage if s.stage in stages else None, on_change=chosen).props(
            f"dense unelevated no-caps {props}"
        )

        def follow() -> None:
            if s.stage in stages:
                toggle.set_value(s.stage)

        self.live.watch(follow, "compare", "diagnosis", "fit", of=toggle)

    # ---- 1: the log

    def log(self) -> None:
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

    # ---- 2: where

    def where(self) -> None:
        """Errors stage by stage, and the failure map of one stage."""
        s, live = self.s, self.live
        with card("2  Where does the model fail?"):
            live.complaint("compare")
            live.progress("compare")
            hint = ui.label(
                "Choose a log: each stage of the machine is then driven by its own logged inputs and compared."
            ).classes("soft")
            live.shown(hint, lambda: s.choice.file is None, "compare", "log")
            live.part(self._compared, "compare", shows=lambda: (s.compared,))

    def _compared(self) -> None:
        s = self.s
        c = s.compared
        if c is None:
            return
        ui.label(c["verdict"]).classes(f"verdict {c['tone']}")
        with ui.element("div").classes("half"):
            with ui.element("div").classes("stackc"):
                self._figures(c)
            with ui.element("div").classes("stackc"):
                stages = list(c["located"])
                if stages:
                    with ui.element("div").classes("rowc"):
                        ui.label("Failure map of").classes("soft")
                        self._stage_toggle(stages, "padding='2px 10px'")
                    self.live.part(
                        self._map, "compare", "diagnosis", "fit", "theme", shows=lambda: (s.compared, s.stage, dark(s))
                    )

    def _figures(self, c: dict[str, Any]) -> None:
        s = self.s
        rows = []
        for f in c["figures"]:
            width = 100 * min(1.0, math.log10(max(f.ratio, 1.0)) / 2.2) + 2
            bar = f'<span class="bar {tone(f.ratio)}" style="width:{width:.0f}px"></span>'
            rows.append(
                [f.stage, f.signal, f"{f.rms:.4g}", f"{f.noise_floor:.4g}", f.unit, f"{f.ratio:.2f}", ("html", bar)]
            )
        for name, why in c["not_observed"].items():
            rows.append([name, f"not observed: {why}", "", "", "", "", ""])
        table(["stage", "signal", "RMS error", "noise floor", "unit", "noise floors", ""], rows, numbers=(2, 3, 5))
        given = [
            f"{f.signal} {number(f.rms_as_given / f.noise_floor)}"
            for f in c["figures"]
            if f.rms_as_given > AGREES * f.noise_floor
        ]
        as_given = f" With the parameters as given, in noise floors: {', '.join(given)}." if given else ""
        ui.label(f"Nominal parameters are refitted within their tolerances.{as_given}").classes("note")
        if c["loop"]:
            with opened(s, "The whole loop"):
                table(
                    ["signal", "against", "RMS", "max", "unit"],
                    [[g.signal, g.reference, number(g.rms), number(g.max_abs), g.unit] for g in c["loop"]],
                    numbers=(2, 3),
                )
        elif c["loop_missing"]:
            ui.label(f"no whole loop: {s.clean(c['loop_missing'])}").classes("note")
        command_line(s.command("compare"))
        command_line(s.command("locate"))

    def _map(self) -> None:
        c = self.s.compared
        if c is not None and self.s.stage in c["located"]:
            self._heat(c["located"][self.s.stage])

    def _heat(self, located: Located) -> None:
        hot = located.hot
        ui.label(f"{located.stage}: {located.verdict()}.").classes("soft")
        if not hot:
            return
        if located.onset is not None:
            ui.label(f"The error begins at t = {located.onset:.0f} s.")
        output = hot[0].output
        mine = [r for r in hot if r.output == output][:9]
        width = max(len(r.ratio) for r in mine)
        cells = [
            [float(v) if n > 20 else None for v, n in zip(r.ratio, r.samples, strict=True)]
            + [None] * (width - len(r.ratio))
            for r in mine
        ]
        names = [f"{r.condition} [{r.condition_unit}]" if r.condition_unit else r.condition for r in mine]
        f = heat(
            cells,
            [str(i + 1) for i in range(width)],
            names,
            "noise floors",
            "an eighth of the samples each, lowest to highest",
            "",
        )
        figure_of(f, dark(self.s), height=90 + 27 * max(3, len(names)))
        ui.label(f"Worst: {mine[0].worst()}.").classes("note")

    # ---- 3: what

    def what(self) -> None:
        """The search, switches of effects, waterfall, curves, sliders."""
        s, live = self.s, self.live
        with card("3  What is missing?"):
            words = (
                "After the comparison: every effect of the library is fitted, and what earns its place on "
                "held-out data is named."
            )
            live.shown(ui.label(words).classes("soft"), lambda: s.compared is None, "compare", "log")
            start = ui.button("Find the missing physics", icon="search", on_click=s.diagnose).props(
                "unelevated size=md"
            )
            ready = lambda: s.compared is not None and s.diagnosis is None and not s.working["diagnose"]  # noqa: E731
            live.shown(start, ready, "compare", "log", "diagnosis", "diagnose", "jobs")
            live.progress("diagnose")
            live.complaint("diagnose")
            live.part(self._verdict, "diagnosis", "compare", "log", shows=lambda: (s.compared, s.diagnosis))
            with ui.element("div").classes("two"):
                with ui.element("div").classes("stackc"):
                    live.part(self._stages, "diagnosis", shows=lambda: (s.diagnosis,))
                    live.part(self._effects, "diagnosis", "compare", "fit", shows=lambda: (s.diagnosis, s.stage))
                    live.watch(self._switched, "fit", "diagnosis")
                with ui.element("div").classes("stackc"):
                    live.complaint("fit", "hand")
                    live.progress("refit")
                    with ui.element("div").classes("stackc") as box:
                        live.part(
                            self._fall,
                            "fit",
                            "diagnosis",
                            "compare",
                            "theme",
                            shows=lambda: (s.diagnosis, s.shown_fit(), dark(s)),
                        )

                    def stale() -> None:
                        box.classes(**{"remove" if s.fitted() is s.shown_fit() else "add": "stale"})

                    live.watch(stale, "fit", "diagnosis", "compare")
                    live.part(self._sliders, "fit", "diagnosis", "compare", shows=lambda: (s.diagnosis, s.fitted()))
                    self.chart_title = ui.label().classes("soft small")
                    chart = Chart("stage")
            self._title()
            live.watch(self._by_hand, "hand", "fit")
            live.watch(self._title, "fit", "diagnosis", "compare", "hand")
            live.watch(chart.refetch, "fit", "diagnosis", "compare", "hand")

    def _title(self) -> None:
        s = self.s
        text = (
            f"The {s.stage} stage on its own logged inputs: measured, model and error. Grey band: three noise floors "
            f"to each side."
            if s.stage
            else ""
        )
        self.chart_title.set_text(text)

    def _verdict(self) -> None:
        s = self.s
        if s.compared is None:
            return
        if s.diagnosis is not None:
            j = s.diagnosis["json"]
            tones = {"missing": "", "none": "good", "unknown": "bad"}
            ui.label(s.diagnosis["verdict"]).classes(f"verdict {tones[j['verdict']]}")
            for u in j["unknown"]:
                near = (
                    f" Nearest in the library: {', '.join(u['nearest_effects'])}." if u.get("nearest_effects") else ""
                )
                ui.label(f"What is left in the {u['stage']} stage: {u['shape']}.{near}").classes("note")
        command_line(s.command("diagnose"))

    def _stages(self) -> None:
        if self.s.diagnosis is not None:
            self._stage_toggle([x.stage for x in self.s.diagnosis["diagnosis"].stages], "padding='2px 8px' size=sm")

    def _switched(self) -> None:
        """Switches and their marks as the session has them."""
        on = self.s.chosen.get(self.s.stage, ())
        for name, (switch, row) in self.switches.items():
            if not switch.is_deleted:
                switch.set_value(name in on)
                row.classes(**{"add" if name in on else "remove": "on"})

    def _effects(self) -> None:
        s = self.s
        d = s.stage_diagnosis()
        self.switches = {}
        if d is None:
            return
        found = {f.effect: f for f in d.effects}
        named = {r: f.effect for f in d.effects for r in f.rivals}
        gain = {c.effect: c for c in d.candidates}
        top = max((c.nats for c in d.candidates), default=1.0)
        on = s.chosen.get(s.stage, ())
        with ui.element("div").classes("effects"):
            for name in s.effects():
                with (
                    ui.element("div")
                    .classes("effect" + (" on" if name in on else ""))
                    .props(f'data-effect="{name}"') as row
                ):
                    switch = ui.switch(
                        value=name in on, on_change=lambda e, name=name: self._switch(name, bool(e.value))
                    )
                    switch.props(f'dense aria-label="{name}"')
                    self.switches[name] = switch, row
                    ui.label(name).classes("name")
                    c = gain.get(name)
                    share = (
                        0.0
                        if c is None or c.nats <= 0 or top <= 0
                        else max(0.03, math.log10(1 + c.nats) / math.log10(1 + top))
                    )
                    with (
                        ui.element("div")
                        .classes("gain")
                        .tooltip(f"gain alone: {c.nats:,.0f} nats on held-out data" if c else "not tried alone")
                    ):
                        ui.element("i").style(f"width:{100 * share:.0f}%")
                    ui.label(self._about_effect(name, found, named, c)).classes("about")

    def _switch(self, name: str, on: bool) -> None:
        if on != (name in self.s.chosen.get(self.s.stage, ())):
            self.s.switch(name, on)

    def _about_effect(self, name: str, found: dict[str, Any], named: dict[str, str], c: Any) -> str:
        summary = EFFECTS[name].summary if name in EFFECTS else ""
        if name in found:
            f = found[name]
            parts = [
                f"{n} {number(p['value'], 4)} [{number(p['low'], 4)}, {number(p['high'], 4)}] {p['unit']}"
                for n, p in f.parameters.items()
            ]
            text = f"{100 * f.probability:.0f} %: " + "; ".join(parts)
            return (
                text + (f". As good: {', '.join(f.rivals)}" if f.rivals else "") + (f". {summary}" if summary else "")
            )
        if name in named:
            return f"Rival of {named[name]}: this log cannot tell them apart. {summary}"
        if c is not None and c.reason:
            return f"Not observable in this log; needs: {c.reason}"
        return summary

    def _fall(self) -> None:
        s = self.s
        f = s.shown_fit()
        if s.diagnosis is None or f is None:
            return
        r = f.result
        k = int((r.error_before / r.floor).argmax())
        with ui.element("div").classes("tiles error-tiles"):
            for label, v in (
                ("nominal", r.error_before[k]),
                ("with the effects that are on", r.error_after[k]),
                ("noise floor", r.floor[k]),
            ):
                with ui.element("div").classes("tile"):
                    ui.label(f"{number(v)} {r.units[k]}").classes("v")
                    ui.label(f"{label}: {r.outputs[k]}").classes("l")
            with ui.element("div").classes("tile"):
                ui.label(f"{number(r.error_after[k] / r.floor[k])}").classes("v after").props(
                    f'data-ratio="{r.error_after[k] / r.floor[k]:.4f}"'
                )
                ui.label("noise floors, held out").classes("l")
        figure_of(
            waterfall([*r.steps, ("noise floor", 1.0)], "held-out error [noise floors]", floor=1.0), dark(s), height=250
        )

    def _sliders(self) -> None:
        s = self.s
        f = s.fitted()
        self.sliders = {}
        if s.diagnosis is None or f is None or not f.result.effects:
            return
        with opened(s, "Turn the parameters by hand").classes("by-hand"):
            with ui.element("div").classes("rowc"):
                self.readout = ui.label().classes("mono hand-error")
                ui.button("Back to the fit", icon="undo", on_click=s.release).props("flat dense padding='2px 10px'")
            now = s.values()
            with ui.element("div").style(
                "display:grid;grid-template-columns:repeat(auto-fill,minmax(300px,1fr));gap:4px 28px;width:100%"
            ):
                for e in f.result.effects:
                    for name, p in e.parameters.items():
                        self._slider(e.effect, name, float(p["value"]), str(p["unit"]), now[e.effect][name])
            self._by_hand()

    def _by_hand(self) -> None:
        s, f = self.s, self.s.fitted()
        if self.readout is None or self.readout.is_deleted or f is None:
            return
        left = [f"{o} {number(v, 4)} {u}" for (o, v), u in zip(s.hand_rms.items(), f.result.units, strict=False)]
        self.readout.set_text("error by hand: " + (", ".join(left) or "move a slider"))
        if not s.hand:  # back to the fit
            for (effect, name), value in ((k, s.values()[k[0]][k[1]]) for k in self.sliders):
                slider, box = self.sliders[effect, name]
                slider.set_value(value)
                box.set_text(f"{value:.5g}")

    def _slider(self, effect: str, name: str, fitted: float, unit: str, now: float) -> None:
        p = EFFECTS[effect][name]
        reach = abs(fitted - p.neutral) or abs(p.high - p.neutral) / 4
        low, high = max(p.low, min(p.neutral, fitted) - reach), min(p.high, max(p.neutral, fitted) + reach)
        with ui.element("div").classes("turn"):
            ui.label(f"{effect}: {name} [{unit}], fitted {number(fitted, 4)}").classes("what soft")
            slider = ui.slider(min=low, max=high, step=(high - low) / 400 or 1e-9, value=now).props(
                f'dense aria-label="{effect} {name}"'
            )
            box = ui.label(f"{now:.5g}").classes("mono")
            self.sliders[effect, name] = slider, box

            def turned(e: events.GenericEventArguments) -> None:
                value = float(e.args)
                box.set_text(f"{value:.5g}")
                self.s.turn(effect, name, value)

            slider.on("update:model-value", turned, throttle=0.08)

    # ---- 4: next

    def next(self) -> None:
        """The next experiment, and what can be saved."""
        s, live = self.s, self.live
        with card("4  What next?"), ui.element("div").classes("half"):
            with ui.element("div").classes("stackc"):
                ui.html("<h3>The next experiment</h3>", sanitize=False)
                live.part(self._rivals, "diagnosis", "log", shows=lambda: (s.diagnosis,))
                ask = ui.button("Recommend an experiment", icon="science", on_click=s.recommend).props(
                    "outline dense padding='4px 14px'"
                )
                open_question = lambda: bool(self._pairs()) and not s.experiment_done and not s.working["experiment"]  # noqa: E731
                live.shown(ask.classes("self-start"), open_question, "diagnosis", "experiment", "log", "jobs")
                live.progress("experiment")
                live.complaint("experiment")
                live.part(
                    self._experiment,
                    "experiment",
                    "diagnosis",
                    "log",
                    "theme",
                    shows=lambda: (s.diagnosis, s.experiment, dark(s)),
                )
            with ui.element("div").classes("stackc"):
                ui.html("<h3>Save</h3>", sanitize=False)
                hint = ui.label("The extended model (TOML, for --model), and the report (HTML).").classes("soft small")
                live.shown(hint, lambda: s.diagnosis is None, "diagnosis", "log")
                live.complaint("save")
                live.progress("report", "command")
                with ui.element("div").classes("rowc"):
                    report = ui.button("Report", icon="description", on_click=s.save_report).props(
                        "outline dense padding='4px 14px'"
                    )
                    model = ui.button("Extended model", icon="save", on_click=s.save_model).props(
                        "outline dense padding='4px 14px'"
                    )
                live.shown(report, lambda: s.diagnosis is not None, "diagnosis", "log")
                live.shown(model, lambda: s.diagnosis is not None and bool(s.all_chosen()), "diagnosis", "log", "fit")
                live.part(self._saved, "save", "diagnosis", "log", shows=lambda: (s.diagnosis, tuple(s.saved)))
                live.part(self._commands, "diagnosis", "log", "fit", shows=lambda: (s.diagnosis, tuple(s.all_chosen())))

    def _pairs(self) -> list[tuple[str, str]]:
        """Effects and rivals that this log cannot tell apart."""
        d = self.s.diagnosis
        return [] if d is None else [(f.effect, r) for x in d["diagnosis"].stages for f in x.effects for r in f.rivals]

    def _rivals(self) -> None:
        if self.s.diagnosis is None:
            ui.label("Where this log cannot tell rivals apart: the safe demand profile that would.").classes(
                "soft small"
            )
        elif self._pairs():
            ui.label("Rivals: " + "; ".join(f"{a} or {b}" for a, b in self._pairs())).classes("small")
        else:
            ui.label("No rivals are left: this log needs no further experiment.").classes("soft small")

    def _experiment(self) -> None:
        s = self.s
        if s.diagnosis is None:
            return
        e = s.experiment
        if e is not None:
            ui.label(e["text"])
            lines = [PageLine("n_dem", e["t"], e["n_dem"], "target")]
            figure_of(overlay([PagePanel("n_dem [%]", lines)]), dark(s), height=230)
        command_line(s.command("experiment", "--out", "next_demand.csv"))

    def _saved(self) -> None:
        s = self.s
        links = {"report": "diagnosis.html", "model": "extended.toml", "extended": "extended.html"}
        with ui.element("div").classes("rowc"):
            for key, name in links.items():
                if key in s.saved:
                    ui.link(f"download {name}", f"/saved/{key}").props(f'download="{name}"').classes(
                        f"saved-{key}"
                    ).style("color:var(--measured)")
            if "model" in s.saved:

                def go_on() -> None:
                    s.choose(LogFile(s.saved["model"], "extended.toml", "extended.toml"))

                ui.button("Go on with this model", icon="arrow_forward", on_click=go_on).props(
                    "flat dense padding='2px 10px'"
                )

    def _commands(self) -> None:
        s = self.s
        if s.diagnosis is not None:
            command_line(s.command("diagnose", "--report", "diagnosis.html"))
            if s.all_chosen():
                command_line(s.command("extend", *s.extend_words()))
