"""Page 1, Missing physics: a log in, where the model fails, which effect it lacks, and the error falling."""

from __future__ import annotations

import math
from typing import Any

from nicegui import events, ui

from plant.effects import EFFECTS
from vaneloop.base.signals import heading
from vaneloop.identification.candidates.library import LAWS
from vaneloop.identification.regimes import Located
from vaneloop.identification.settings import AGREES
from vaneloop.pages.diagnosis import experiment_panels
from vaneloop.pages.failures import failure_map, worst_cell
from vaneloop.pages.figures import overlay, waterfall
from vaneloop.pages.story import (
    CANNOT,
    EXPLAINED,
    FITS,
    doubt,
    fall,
    falling,
    floors,
    jumps,
    reached,
    since,
    sizes,
    together,
    worths,
)
from vaneloop.pages.style import capital, number
from vaneloop.web.charts import Chart
from vaneloop.web.chosen_log import ChosenLog
from vaneloop.web.frame import Live, card, command_line, dark, figure_of, frame, notes_of, opened, table, tone
from vaneloop.web.further import show_apart
from vaneloop.web.learning import LearnedPart
from vaneloop.web.session import LogFile, Session

__all__ = ["build"]

WARM = 0.5  # s after the page: first it is drawn


def build(session: Session, most: int) -> None:
    """Draw the page; ``most`` is the largest upload in bytes."""
    with frame(session, "/"):
        live = Live(session)
        ChosenLog(session, live, most).card()
        page = _Page(session, live)
        page.where()
        page.what()
        page.next()
        ui.timer(WARM, session.warm, once=True)


class _Page:
    def __init__(self, session: Session, live: Live):
        self.s, self.live = session, live
        self.readout: ui.label | None = None
        self.sliders: dict[tuple[str, str], tuple[ui.slider, ui.label]] = {}
        self.switches: dict[str, tuple[ui.switch, ui.element, ui.element, ui.element]] = {}

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

    # ---- 2: where

    def where(self) -> None:
        """Errors stage by stage, and the failure map of one stage."""
        s, live = self.s, self.live
        with card("2  Where does the model fail?"):
            live.complaint("compare")
            live.progress("compare")
            hint = ui.label(
                "Choose a log: each subsystem of the model is then driven by its own logged inputs and compared."
            ).classes("soft")
            live.shown(hint, lambda: s.choice.file is None, "compare", "log")
            live.part(self._compared, "compare", shows=lambda: (s.compared,))

    def _compared(self) -> None:
        s = self.s
        c = s.compared
        if c is None:
            return
        ui.label(c["verdict"]).classes(f"verdict {c['tone']}")
        with ui.element("div").classes("stackc"):
            self._figures(c)
        stages = list(c["located"])
        if stages:
            with ui.element("div").classes("rowc").style("margin-top:12px"):
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
                [f.stage, f.signal, f"{f.rms:.4g}", f"{f.noise_floor:.4g}", f.unit, floors(f.ratio), ("html", bar)]
            )
        for name, why in c["not_observed"].items():
            rows.append([name, f"{CANNOT}: {why}", "", "", "", "", ""])
        table(
            ["subsystem", "signal", "RMS error", "noise floor", "unit", "noise floors", "size"], rows, numbers=(2, 3, 5)
        )
        given = [
            f"{f.signal} {floors(f.rms_as_given / f.noise_floor)}"
            for f in c["figures"]
            if f.rms_as_given > AGREES * f.noise_floor
        ]
        as_given = f" With the parameters as given, in noise floors: {', '.join(given)}." if given else ""
        ui.label(f"Nominal parameters are refitted within their tolerances.{as_given}").classes("note")
        known = s.preview["notes"] if s.preview else []
        notes_of(s, "What judging did to the log", [n for n in c["notes"] if n not in known])
        show_apart(c["apart"])
        self.live.part(self._whole_loop, "compare", "loop", shows=lambda: (s.loop,))
        command_line(s.command("compare"))
        command_line(s.command("locate"))

    def _whole_loop(self) -> None:
        """The errors of the whole loop, once they are there."""
        s = self.s
        self.live.complaint("loop")
        if s.loop is None:
            return
        figures, why = s.loop
        if figures:
            with opened(s, "The whole loop"):
                table(
                    ["signal", "against", "RMS", "max", "unit"],
                    [[g.signal, g.reference, number(g.rms), number(g.max_abs), g.unit] for g in figures],
                    numbers=(2, 3),
                )
        else:
            ui.label(f"no whole loop: {s.clean(why)}").classes("note")

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
        mine = [r for r in hot if r.output == output]
        figure = failure_map(mine)
        worst = figure["layout"]["meta"]["worst"]
        with ui.element("div").classes("scroll"):
            figure_of(figure, dark(self.s)).on("cell", lambda e: self._show(e.args)).style("min-width:1040px")
        with ui.element("div").classes("rowc"):
            k, b = worst_cell(mine)
            ui.label(f"Worst: {mine[k].told(b)}. A click on a cell, or Enter, shows its moment.").classes("note")
            ui.button("Show me the worst moment", icon="visibility", on_click=lambda: self._show(worst)).props(
                "outline dense padding='2px 12px'"
            ).classes("show-worst")

    def _show(self, t: Any) -> None:
        """Move the curves of the stage to a moment of the log."""
        if isinstance(t, int | float):
            self.chart.run_method("moment", float(t))

    # ---- 3: what

    def what(self) -> None:
        """The search, switches of effects, waterfall, curves, sliders."""
        s, live = self.s, self.live
        with card("3  What is missing?"):
            words = (
                "After the comparison: every effect of the library is fitted, and those that improve the fit to "
                "held-out data are accepted."
            )
            live.shown(ui.label(words).classes("soft"), lambda: s.compared is None, "compare", "log")
            start = (
                ui.button("Find the missing physics", icon="search", on_click=s.diagnose)
                .props("unelevated size=md")
                .classes("find-missing")
            )
            ready = lambda: s.compared is not None and s.diagnosis is None and not s.working["diagnose"]  # noqa: E731
            live.shown(start, ready, "compare", "log", "diagnosis", "diagnose", "jobs")
            live.progress("diagnose")
            live.part(self._sofar, "sofar", "diagnose", "diagnosis", shows=lambda: (len(s.sofar), s.diagnosis))
            live.complaint("diagnose")
            live.part(self._verdict, "diagnosis", "compare", "log", shows=lambda: (s.compared, s.diagnosis))
            LearnedPart(s, live).build()
            with ui.element("div").classes("two").style("margin-top:10px"):
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
                    self.chart = chart = Chart("stage")
            self._title()
            live.watch(self._by_hand, "hand", "fit")
            live.watch(self._title, "fit", "diagnosis", "compare", "hand")
            live.watch(chart.refetch, "fit", "diagnosis", "compare", "hand")

    def _title(self) -> None:
        s = self.s
        windows = s.compared["windows"] if s.compared is not None else {}
        text = (
            f"The {s.stage} subsystem on its own logged inputs: measured, model and error. Grey band: three noise "
            f"floors to each side.{jumps(windows.get(s.stage))}"
            if s.stage
            else ""
        )
        self.chart_title.set_text(text)

    def _sofar(self) -> None:
        """What the stages said that are searched already."""
        if self.s.diagnosis is None:
            for text in self.s.sofar:
                ui.label(f"so far: {text}").classes("small sofar")

    def _verdict(self) -> None:
        s = self.s
        if s.compared is None:
            return
        if s.diagnosis is not None:
            j = s.diagnosis["json"]
            tones = {"missing": "", "none": "good", "unknown": "bad"}
            ui.label(s.diagnosis["verdict"]).classes(f"verdict {tones[j['verdict']]}")
            for u in j["unknown"]:
                left = "; ".join(x for x in u["shape"].split("; ") if x not in s.diagnosis["verdict"])
                near = ", ".join(u.get("nearest_effects") or ())
                said = [f"What is left in the {u['stage']} subsystem: {left}."] if left else []
                said += [f"Nearest to it in the library, for the {u['stage']} subsystem: {near}."] if near else []
                if said:
                    ui.label(" ".join(said)).classes("note")
            show_apart(s.diagnosis["apart"])
        command_line(s.command("diagnose"))

    def _stages(self) -> None:
        if self.s.diagnosis is not None:
            self._stage_toggle([x.stage for x in self.s.diagnosis["diagnosis"].stages], "padding='2px 8px'")

    def _switched(self) -> None:
        """Switches and their marks as the session has them."""
        on = self.s.chosen.get(self.s.stage, ())
        for name, (switch, row, _, _) in self.switches.items():
            if not switch.is_deleted:
                switch.set_value(name in on)
                row.classes(**{"add" if name in on else "remove": "on"})
        self._shares()

    def _effects(self) -> None:
        s = self.s
        d = s.stage_diagnosis()
        self.switches = {}
        if d is None:
            return
        found = {f.effect: f for f in d.effects}
        named = {r: f.effect for f in d.effects for r in f.rivals}
        alone = {c.effect: c for c in d.candidates}
        on = s.chosen.get(s.stage, ())
        ui.label(
            "Bar: what the model would lose without the effect, of the way from noise to the nominal error."
        ).classes("note")
        with ui.element("div").classes("effects").props('tabindex="0" role="group" aria-label="effects"'):
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
                    ui.label(name).classes("name")
                    with ui.element("div").classes("gain") as gain:
                        bar = ui.element("i")
                    self.switches[name] = switch, row, gain, bar
                    ui.label(self._about_effect(name, found, named, alone.get(name))).classes("about")
        self._shares()

    def _shares(self) -> None:
        """The bars: each effect's share in the model as it is fitted now."""
        f, d = self.s.shown_fit(), self.s.stage_diagnosis()
        if d is None:
            return
        worth = {w.effect: w for w in (worths(f.result) if f is not None else worths(d))}
        for name, (_, _, gain, bar) in self.switches.items():
            if bar.is_deleted:
                continue
            w = worth.get(name)
            said = f"without it {floors(w.without)} noise floors" if w else "not in the model"
            gain.props["title"] = said
            bar.style(f"width:{max(3.0, 100 * w.share) if w else 0:.0f}%")
            gain.update()

    def _switch(self, name: str, on: bool) -> None:
        if on != (name in self.s.chosen.get(self.s.stage, ())):
            self.s.switch(name, on)

    def _about_effect(self, name: str, found: dict[str, Any], named: dict[str, str], c: Any) -> str:
        summary = capital(_summary(name))
        if name in found:
            f = found[name]
            text = f"{100 * f.probability:.0f} %: {sizes(f)}"
            d = self.s.stage_diagnosis()
            when = "" if d is None else since(d)
            return ". ".join(part for part in (text, capital(when), capital(doubt(f)), summary) if part)
        if name in named:
            return f"Rival of {named[name]}: this log cannot distinguish them. {summary}"
        if c is not None and c.reason:
            return f"{capital(CANNOT)}; needs: {c.reason}"
        left = f"Alone it leaves {floors(c.left)} noise floors. " if c is not None and c.left == c.left else ""
        return left + summary

    def _fall(self) -> None:
        s = self.s
        f = s.shown_fit()
        if s.diagnosis is None or f is None:
            return
        r = f.result
        k, before, after = fall(r)
        good = reached(r)
        names = " and ".join(x.effect for x in r.effects) or "nothing added"
        end = "An error remains." if not good else capital(f"{EXPLAINED if r.effects else FITS}.")
        whose = f"{capital(together(r))}. " if len(r.outputs) > 1 else ""
        with ui.element("div").classes(f"verdict fell {'good' if good else 'bad'}"):
            ui.label(f"{before} → {after} noise floors").classes("v after").props(
                f'data-ratio="{r.error_after[k] / r.floor[k]:.4f}"'
            )
            ui.label(
                f"{whose}{r.outputs[k]} with {names}: {number(r.error_before[k])} → {number(r.error_after[k])} "
                f"{r.units[k]}, noise floor {number(r.floor[k])}, held out. {end}"
            ).classes("l")
        figure_of(waterfall(falling(r), "held-out error [noise floors]", floor=1.0, told=floors), dark(s), height=300)

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
                "display:grid;grid-template-columns:repeat(auto-fill,minmax(min(300px,100%),1fr));"
                "gap:4px 28px;width:100%"
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
        f = self.s.fitted()
        assert f is not None
        p = f.bounds[effect][name]
        reach = abs(fitted - p.value) or (abs(p.high - p.value) / 4 if math.isfinite(p.high) else 1.0)
        low, high = max(p.low, min(p.value, fitted) - reach), min(p.high, max(p.value, fitted) + reach)
        with ui.element("div").classes("turn"):
            ui.label(f"{effect}: {heading(name, unit)}, fitted {number(fitted, 4)}").classes("what soft")
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
                open_question = lambda: self._open() and not s.experiment_done and not s.working["experiment"]  # noqa: E731
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

    def _open(self) -> bool:
        """Whether a run could tell more: rivals, or the parameters of a model of the user's own."""
        return bool(self._pairs()) or (self.s.diagnosis is not None and self.s.choice.system is not None)

    def _rivals(self) -> None:
        if self.s.diagnosis is None:
            ui.label("If this log cannot distinguish rivals: the safe run that can.").classes("soft small")
        elif self._pairs():
            ui.label("Rivals: " + "; ".join(f"{a} or {b}" for a, b in self._pairs())).classes("small")
        elif self._open():
            ui.label("No rivals are left: a run can still tell the parameters better.").classes("soft small")
        else:
            ui.label("No rivals are left: this log needs no further experiment.").classes("soft small")

    def _experiment(self) -> None:
        s = self.s
        if s.diagnosis is None:
            return
        e = s.experiment
        if e is not None:
            ui.label(e["text"])
            if e["separates"]:
                figure_of(overlay(experiment_panels(e)), dark(s), height=230)
        command_line(s.command("experiment", "--out", "next_run.csv" if s.choice.system else "next_demand.csv"))

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


def _summary(name: str) -> str:
    """What an effect is, in words; "" of a law of the user's own, or one that was learned."""
    if name in EFFECTS:
        return EFFECTS[name].summary
    law = name.rpartition(".")[2]
    return next((of[law].text for of in LAWS.values() if law in of), "")
