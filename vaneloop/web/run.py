"""Page 3, Run: the loop live. Demand, strip charts, lamps, the bus's trace, faults on purpose, lateness, and a record
for page 1.
"""

from __future__ import annotations

import html
import math
import shlex
import time
from itertools import islice
from typing import Any

from nicegui import events, ui

from controller import FAULTS, MODES
from hil.bus.frames import IDENT_MASK, NAMES
from hil.inject.scenario import library, load_scenario
from hil.loop.ecu import BUILTIN
from vaneloop.pages.figures import bars
from vaneloop.web.calibrate import Calibrate
from vaneloop.web.charts import Chart
from vaneloop.web.frame import Live, card, command_line, dark, figure_of, frame, list_of_moments
from vaneloop.web.running import ANY, Loop
from vaneloop.web.session import Session

__all__ = ["build"]

LIT = 1.5  # s that a lamp stays lit once it is shown, so that what passes quickly is seen
TRACE_LINES = 40
EVENTS = 60  # listed
# of the bus, with what is demanded: signal, demand, words, ends of the dial
GAUGES = (
    ("n_r", "n_dem", "speed, %", 0.0, 110.0),
    ("x_lvdt", "x_dem", "stroke, mm", 0.0, 48.0),
    ("vigv", "", "VIGV, deg", -40.0, 40.0),
    ("i_cmd", "", "current, mA", -40.0, 40.0),
    ("p_s", "", "supply, MPa", 0.0, 30.0),
)
SWEEP = 240.0  # deg, of a dial
TONES = {"RUN": "good", "STANDBY": "mid", "INIT": "mid", "DEGRADED": "bad", "FAIL_SAFE": "bad"}


def build(session: Session, most: int) -> None:
    """Draw the page."""
    if "loop" not in session.extra:
        session.extra["loop"] = Loop(session)
    session.extra["loop"].warm()
    with frame(session, "/run"):
        page = _Page(session, Live(session))
        page.controls()
        with ui.element("div").classes("two").style("grid-template-columns:minmax(0,1fr) minmax(330px,28%)"):
            page.strips()
            page.inject()
        Calibrate(page.live, page.loop).draw()
        with ui.element("div").classes("two").style("grid-template-columns:minmax(0,1fr) minmax(330px,28%)"):
            page.trace()
            page.lateness()


class _Page:
    def __init__(self, session: Session, live: Live):
        self.s, self.live = session, live
        self.loop: Loop = session.extra["loop"]
        self.traced: tuple[Any, str] = (None, "")
        self.seen = {
            name: (n, time.monotonic() - LIT) for name, n in self.loop.lit.items()
        }  # lamp -> news counted, clock when shown

    # ---- start, stop, demand

    def controls(self) -> None:
        """Bus, speed, start and stop; demand; the commands."""
        with card("1  The loop", "Controller with its plant, the engine's ECU, and the CAN bus between them."):
            lp = self.loop
            self.live.part(self._start, "loop", "run", shows=lambda: (lp.running, lp.bus, lp.recorded), classes="rowc")
            self.live.complaint("run", "inject")
            with ui.element("div").classes("rowc").style("margin-top:10px;width:100%;flex-wrap:nowrap"):
                ui.label("speed demand").classes("soft").style("white-space:nowrap")
                slider = (
                    ui.slider(min=30, max=102, step=0.5, value=self.loop.demand)
                    .props('aria-label="speed demand"')
                    .style("flex:1;max-width:560px")
                )
                self.demand = ui.label(f"{self.loop.demand:.1f} %").classes("mono").style("width:70px")

                def turned(e: events.GenericEventArguments) -> None:
                    self.loop.demand, self.loop.profile = float(e.args), None
                    self.demand.set_text(f"{self.loop.demand:.1f} %")
                    self.loop.tell(demand=self.loop.demand)
                    if not self.loop.running:
                        self.s.touch("loop")

                slider.on("update:model-value", turned, throttle=0.05)

                def chosen(e: events.ValueChangeEventArguments[Any]) -> None:
                    self._set("profile", e.value or None)
                    if e.value:
                        self.loop.tell(profile=e.value)

                options = {"": "by slider", **{n: f"{n}: {words}" for n, (words, _) in BUILTIN.items()}}
                ui.select(options, value=self.loop.profile or "", label="or a profile", on_change=chosen).props(
                    "outlined dense options-dense"
                ).style("min-width:260px").classes("profile")

                def ask(e: events.ValueChangeEventArguments[Any]) -> None:
                    self.loop.tell(mode_request=int(e.value == "run"))

                ui.toggle({"run": "run", "standby": "standby"}, value="run", on_change=ask).props(
                    "dense unelevated no-caps padding='2px 10px' title='mode that the ECU asks for'"
                )
            self.live.part(self._waiting, "loop", "loop-jobs", "run", shows=lambda: (" ".join(self._waits()),))
            self.live.part(self._commands, "loop", "run", shows=lambda: tuple(" ".join(w) for _, w in lp.commands()))

    def _start(self) -> None:
        lp = self.loop
        if lp.running:
            ui.button("Stop", icon="stop", on_click=lp.stop).props("unelevated color=negative padding='5px 18px'")
        else:
            ui.button("Start", icon="play_arrow", on_click=lp.start).props("unelevated padding='5px 18px'")
        kinds = {
            "lockstep": "lockstep: simulated time",
            "local": "real time, embedded bus",
            "vcan0": "real time, vcan0",
        }

        def join(e: events.ValueChangeEventArguments[Any]) -> None:
            lp.bus = e.value
            self.s.touch("loop")

        bus = ui.select(kinds, value=lp.bus, on_change=join)
        bus.props("outlined dense options-dense").style("min-width:220px").classes("bus")
        if lp.running:
            bus.disable()
        if lp.bus == "lockstep":
            speeds = {
                0.1: "0.1 x real time",
                0.5: "0.5 x",
                1.0: "1 x",
                3.0: "3 x",
                10.0: "10 x",
                0.0: "as fast as it goes",
            }

            def speed(e: events.ValueChangeEventArguments[Any]) -> None:
                lp.speed = float(e.value)
                lp.tell(speed=lp.speed)

            ui.select(speeds, value=lp.speed, on_change=speed).props("outlined dense options-dense").style(
                "min-width:150px"
            ).classes("pace")
        noisy = ui.checkbox(
            "noisy sensors", value=lp.seed is not None, on_change=lambda e: self._set("seed", 1 if e.value else None)
        )
        record = ui.checkbox("record", value=lp.record, on_change=lambda e: self._set("record", bool(e.value)))
        if lp.running:
            noisy.disable()
            record.disable()
        if lp.recorded is not None and not lp.running:
            name = lp.recorded.path.name
            ui.link(f"download {name}", f"/saved/run-{name}").props(f'download="{name}"').style("color:var(--measured)")

            def find() -> None:
                assert lp.recorded is not None
                self.s.choose(lp.recorded)
                ui.navigate.to("/")

            ui.button("Open in missing physics", icon="arrow_forward", on_click=find).props(
                "outline dense padding='4px 12px'"
            ).classes("open-record")

    def _set(self, name: str, value: Any) -> None:
        setattr(self.loop, name, value)
        self.s.touch("loop")

    def _waits(self) -> list[str]:
        lp = self.loop
        jobs = [j for w in lp.workers.values() for j in w.jobs.values()] if lp.running and not lp.filled else []
        return [f"{j.name}: {j.text} ..." for j in jobs if j.text != "running"]

    def _waiting(self) -> None:
        for line in self._waits():
            ui.label(line).classes("note")

    def _commands(self) -> None:
        for without, words in self.loop.commands():
            if without:
                ui.label(without).classes("note")
            if words:
                command_line(shlex.join(["vaneloop", *words]))

    # ---- charts and lamps

    def strips(self) -> None:
        """Lamps, figures, strip charts."""
        with card("2  Signals, as the bus has them"):
            with ui.element("div").classes("rowc"):
                self.lamps: dict[str, ui.element] = {}
                for name in (*MODES, *FAULTS):
                    with ui.element("span").classes("lamp").props(f'data-lamp="{name}"') as lamp:
                        ui.element("i")
                        ui.label(name if name in MODES else name.replace("_", " "))
                    self.lamps[name] = lamp
            with ui.element("div").classes("tiles").style("margin:8px 0"):
                self.tiles: dict[str, ui.label] = {}
                self.hands: dict[str, ui.element] = {}
                self._tile("t", "time, s")
                for name, demand, words, low, high in GAUGES:
                    self._tile(name, words, (demand, low, high))
                self._tile("pace", "x real time")
            with ui.element("div").classes("rowc"):

                def arm(e: events.ValueChangeEventArguments[Any]) -> None:
                    self.loop.trigger = e.value or ""

                options = {"": "never", ANY: ANY, **{f: f.replace("_", " ") for f in FAULTS}}
                options |= {f"mode {m}": f"mode {m}" for m in MODES}
                ui.select(options, value=self.loop.trigger, label="hold the charts at", on_change=arm).props(
                    "outlined dense options-dense"
                ).style("min-width:190px").classes("trigger")
                self.held = ui.label().classes("small held")

                def again() -> None:
                    self.loop.go_on()
                    self.chart.run_method("moment", None)

                self.again = ui.button("Go on", icon="play_arrow", on_click=again)
                self.again.props("outline dense padding='2px 10px'").classes("go-on")
            self.chart = Chart("run", live=8.0)
            self.again.set_visibility(False)
            ui.timer(0.3, self._shown)

    def _tile(self, name: str, words: str, dial: tuple[str, float, float] | None = None) -> None:
        """A figure in words, with a dial where it has one: a hand for what is measured, a mark for what is demanded."""
        with ui.element("div").classes("tile"):
            if dial is not None:
                ui.html(_dial(*dial[1:]), sanitize=False)
                with ui.element("div").classes("hands").props('aria-hidden="true"'):
                    for signal, what in ((dial[0], "wanted"), (name, "hand")):
                        if signal:
                            self.hands[signal] = ui.element("i").classes(what)
            self.tiles[name] = ui.label("-").classes("v")
            ui.label(words).classes("l")

    def _shown(self) -> None:
        """Lamps, figures and trace together: the browser goes through the page once for all of them."""
        held = self.loop.held
        self.held.set_text("" if held is None else f"held at {held:.2f} s")
        self.again.set_visibility(held is not None)
        for signal, demand, _, low, high in GAUGES:
            for name in filter(None, (signal, demand)):
                v = self.loop.latest(name)
                turn = f"rotate({SWEEP * (min(max((v - low) / (high - low), 0.0), 1.0) - 0.5):.0f}deg)"
                self.hands[name].style(f"transform:{turn};visibility:visible" if v == v else "visibility:hidden")
        self._lamps()
        self._trace()

    def _lamps(self) -> None:
        lp = self.loop
        state, now = lp.latest("state"), time.monotonic()
        mode = MODES[int(state)] if state == state and 0 <= state < len(MODES) else ""
        for name, lamp in self.lamps.items():
            if lp.lit.get(name, 0) != self.seen.get(name, (0, 0.0))[0]:
                self.seen[name] = lp.lit[name], now  # from now on, however late this page comes to show it
            fresh = now - self.seen.get(name, (0, now - LIT))[1] < LIT or name == mode
            tone = (TONES.get(name, "mid") if name in MODES else "bad") if fresh else ""
            # the controller is in one mode: another that has just passed is drawn as past
            past = " was" if fresh and name in MODES and mode and name != mode else ""
            wanted = f"lamp {tone}{past}".strip()
            if getattr(lamp, "shown", None) != wanted:
                lamp.classes(replace=wanted)
                lamp.shown = wanted  # type: ignore[attr-defined]
        for name, tile in self.tiles.items():
            v = (
                lp.status.get("speed", 1.0 if lp.bus != "lockstep" and lp.running else float("nan"))
                if name == "pace"
                else lp.latest(name)
            )
            tile.set_text("-" if v != v else f"{v:.1f}" if name in ("t", "pace") else f"{v:.2f}")

    # ---- injection

    def inject(self) -> None:
        """A button for every scenario of the library."""
        with card("3  Fault-injection scenarios"):
            find = (
                ui.input(placeholder="find a scenario")
                .props('outlined dense clearable aria-label="find a scenario"')
                .classes("w-full")
            )
            with ui.element("div").classes("effects").style("max-height:330px"):
                boxes = []
                for name in library():
                    scenario = load_scenario(name)
                    if scenario.secoc:  # the live loop's frames are not authenticated
                        continue
                    title = scenario.title
                    with ui.element("div").style("padding:3px 0;border-bottom:1px solid var(--grid)") as box:
                        ui.button(name, on_click=lambda name=name: self._begin(name)).props(
                            "flat dense no-caps align=left padding='1px 6px'"
                        )
                        ui.label(title).classes("note").style("padding-left:6px;line-height:1.3")
                    boxes.append((box, f"{name} {title}".lower()))

            def search(e: events.ValueChangeEventArguments[Any]) -> None:
                for box, text in boxes:
                    box.set_visibility((e.value or "").lower() in text)

            find.on_value_change(search)
            self.live.progress("judge")
            self.live.part(self._scenario, "events", "loop", shows=lambda: (self.loop.asked, self.loop.bus))
            ui.html("<h3>What happened</h3>", sanitize=False)
            ui.label("A press shows the moment in the charts; six minutes are kept.").classes("note")
            list_of_moments(self.live, lambda: self.loop.events, self._look, "events", "loop", most=EVENTS)

    def _look(self, t: float) -> None:
        self.loop.show(t)
        self.chart.run_method("moment", t)

    def _begin(self, name: str) -> None:
        if self.loop.running:
            self.loop.inject(name)
        else:
            ui.notify("start the loop first")

    def _scenario(self) -> None:
        """The scenario asked for last: its verdict by itself, and its command."""
        last = self.loop.asked
        if not last:
            return
        if self.loop.bus == "lockstep":
            ui.button(f"Judge {last}", icon="rule", on_click=lambda: self.loop.judge(last)).props(
                "outline dense padding='2px 12px'"
            ).classes("judge")
            ui.label("Here it begins in the running loop. Alone, compared with its expected reactions:").classes("note")
        command_line(shlex.join(["vaneloop", "inject", last, "--bus", self.loop.bus_name]))

    # ---- trace

    def trace(self) -> None:
        """Decoded frames, with a filter."""
        with card("5  The bus"):
            with ui.element("div").classes("rowc"):
                self.words = ui.input(placeholder="filter: name, 0B0, signal").props(
                    'outlined dense clearable aria-label="filter of the trace"'
                )
                self.hold = ui.checkbox("hold")
                self.counts = ui.label().classes("soft small")
            self.trace_box = (
                ui.html("", sanitize=False).classes("trace w-full").props('role="log" tabindex="0" aria-label="frames"')
            )

    def _trace(self) -> None:
        lp, text = self.loop, (self.words.value or "").lower()
        s = lp.status
        now = s.get("frames"), text
        if self.hold.value or not s or now == self.traced:
            return
        self.traced = now
        load = f", load {100 * s['load']:.0f} %" if "load" in s else ""
        self.counts.set_text(f"{s.get('frames', 0):,} frames, {s.get('refused', 0):,} with a wrong CRC{load}")
        lines = (_in_words(*f) for f in reversed(lp.trace))
        kept = islice((x for x in lines if not text or text in x.lower()), TRACE_LINES)
        self.trace_box.set_content(html.escape("\n".join(kept)))

    # ---- lateness

    def lateness(self) -> None:
        """Lateness of the ticks in real time."""
        with card("6  Real time"):
            ui.label("How late each 1 ms tick of the controller began.").classes("soft small")
            holder = ui.element("div").classes("stackc")
            seen: dict[str, Any] = {"ticks": None, "dark": None}

            def show() -> None:
                late = self.loop.late
                figures = late.get("late")
                key = (late.get("ticks", (figures or {}).get("ticks")), dark(self.s), self.loop.bus, bool(figures))
                if key == seen["ticks"]:
                    return
                seen["ticks"] = key
                holder.clear()
                with holder:
                    if not figures:
                        ui.label(
                            "Lockstep is never late; start it in real time to see."
                            if self.loop.bus == "lockstep"
                            else "Not started yet."
                        ).classes("soft")
                        return
                    ui.label(
                        ", ".join(
                            f"{n} {figures[k]:.0f} us"
                            for n, k in (("p50", "p50_us"), ("p99", "p99_us"), ("p99.9", "p999_us"), ("max", "max_us"))
                        )
                    ).classes("mono")
                    names, counts = zip(*late["histogram"], strict=True)
                    f = bars(list(names), {"ticks": [max(c, 0) for c in counts]}, "ticks")
                    f["layout"]["yaxis"] = {**f["layout"].get("yaxis", {}), "type": "log"}
                    figure_of(f, dark(self.s), 300)

            ui.timer(0.5, show)


def _dial(low: float, high: float) -> str:
    """The face of a dial from ``low`` to ``high``: an arc with eleven ticks, and its ends in words."""

    def at(share: float, radius: float) -> str:
        turn = math.radians(SWEEP * (share - 0.5))
        return f"{50 + radius * math.sin(turn):.1f} {50 - radius * math.cos(turn):.1f}"

    ticks = "".join(f'<path d="M{at(k / 10, 44)}L{at(k / 10, 38 if k % 5 else 34)}"/>' for k in range(11))
    words = f'<text x="16" y="92">{low:g}</text><text x="84" y="92">{high:g}</text>'
    arc = f'<path d="M{at(0.0, 44)}A44 44 0 1 1 {at(1.0, 44)}"/>'
    return f'<svg class="dial" viewBox="0 0 100 96" aria-hidden="true">{arc}{ticks}{words}</svg>'


def _in_words(t: float, head: int, data: int, values: dict[str, float]) -> str:
    ident = head & IDENT_MASK
    name = (
        NAMES.get(ident, "?")
        if not head >> 29 & 7
        else "error frame"
        if head >> 29 & 1
        else "remote"
        if head >> 30 & 1
        else "extended"
    )
    raw = (data & (1 << 64) - 1).to_bytes(8, "little")[: min((head >> 32) & 0xFF, 8)].hex(" ").upper()
    said = "  ".join(f"{k} {v:.6g}" for k, v in values.items()) or ("WRONG CRC" if name in NAMES.values() else "")
    return f"{t:10.3f}  {ident:03X}  {name:<11} {raw:<24} {said}"
