"""Page 2, Schedule: the paper's tool. Lengths, schedules and a hysteresis log in; one button a step; tables for the
controller out.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import events, ui
from nicegui.element import Element

from plant import Geometry, Schedules, load_geometry, load_schedules
from vaneloop.base.signals import heading
from vaneloop.design.links import CRITERIA
from vaneloop.design.schedule_files import write_geometry, write_schedules
from vaneloop.design.stroke_tables import STROKE_LIMITS
from vaneloop.pages.figures import Line, Panel, overlay
from vaneloop.pages.schedule import NAMES, with_points
from vaneloop.pages.style import STAGE_ROLES
from vaneloop.verbs.machine import files_of
from vaneloop.web.chosen_log import receive, suffixes
from vaneloop.web.frame import Live, card, command_line, dark, drop, figure_of, frame, notes_of, opened, table
from vaneloop.web.jobs import STEPS
from vaneloop.web.session import LogFile, Session

__all__ = ["build"]

TITLES = ("Mechanism", "Stroke for the VIGV", "Links of the other vane rows", "Measured loop", "Tables")


@dataclass
class Plan:
    """What the page holds: the engine as edited, options, and what each step gave."""

    geometry: Geometry
    schedules: Schedules
    edited: bool = False
    log: LogFile | None = None
    options: dict[str, Any] = field(
        default_factory=lambda: {"step": 0.5, "lb_range": 5.0, "lc_range": 5.0, "criterion": "rms"}
    )
    stage: str = "vigv"
    done: dict[str, Any] = field(default_factory=dict)
    loaded: int = 0  # times that a file has replaced numbers

    @classmethod
    def of(cls, session: Session) -> Plan:
        """The machine that the workbench was started for."""
        files = files_of(session.tables)
        return cls(load_geometry(files["geometry"]), load_schedules(files["schedules"]))

    def words(self) -> list[str]:
        """Options of ``vaneloop schedule`` as the user would type them."""
        out = ["--geometry", "geometry.toml", "--schedules", "schedules.toml"] if self.edited else []
        if self.log is not None:
            out += ["--log", self.log.word]
        o = self.options
        for key, default in (("step", 0.5), ("lb_range", 5.0), ("lc_range", 5.0)):
            if o[key] != default:
                out += [f"--{key.replace('_', '-')}", f"{o[key]:g}"]
        return out + (["--criterion", o["criterion"]] if o["criterion"] != "rms" else [])


class Mechanism(Element, component="mechanism.js"):
    """The linkage at any stroke; the slider is the browser's."""

    def __init__(self, drawn: dict[str, Any]):
        """``drawn``: strokes (mm), and for each stage name, joints, ring radius, angles."""
        super().__init__()
        self._props["strokes"] = drawn["strokes"]
        self._props["stages"] = drawn["stages"]


class Editor(Element, component="editor.js"):
    """A curve whose points are dragged."""

    def __init__(self, x: list[float], y: list[float], moved: Any):
        """``moved`` takes the number of the point and its new value."""
        super().__init__()
        self._props |= {"x": x, "y": y, "xtitle": "rotor speed [%]", "ytitle": "vane angle [deg]"}
        self.on("moved", lambda e: moved(int(e.args[0]), float(e.args[1])))

    def put(self, y: list[float]) -> None:
        """Show these values."""
        self._props["y"] = y
        self.update()


def build(session: Session, most: int) -> None:
    """Draw the page."""
    if "plan" not in session.extra:
        session.extra["plan"] = Plan.of(session)
    with frame(session, "/schedule"):
        live = Live(session)
        page = _Page(session, live, most)
        page.engine()
        page.steps()


class _Page:
    def __init__(self, session: Session, live: Live, most: int):
        self.s, self.live, self.most = session, live, most

    @property
    def plan(self) -> Plan:
        """What the page holds."""
        plan: Plan = self.s.extra["plan"]
        return plan

    # ---- the engine

    def engine(self) -> None:
        """Lengths, schedules, the log."""
        with (
            card(
                "1  The engine",
                "Lengths as built, the angles that each vane row shall have, and a log of stroke and angle driven "
                "there and back.",
            ),
            ui.element("div").classes("two"),
        ):
            with ui.element("div").classes("stackc"):
                self.live.part(
                    self._lengths, "plan", shows=lambda: (self.plan, self.plan.loaded, self.plan.log, len(self.s.files))
                )
            with ui.element("div").classes("stackc"):
                self.live.part(
                    self._curve, "plan", "curve", shows=lambda: (self.plan, self.plan.loaded, self.plan.stage)
                )

    def _number(self, section: str, key: str, label: str) -> None:
        q = getattr(getattr(self.plan.geometry, section), key)

        def changed(e: events.GenericEventArguments) -> None:
            if box.value is None or box.value == getattr(getattr(self.plan.geometry, section), key).value:
                return
            part = getattr(self.plan.geometry, section)
            new = part.model_copy(
                update={
                    key: q.model_copy(update={"value": float(box.value), "origin": "chosen: entered in the workbench"})
                }
            )
            self.plan.geometry = self.plan.geometry.model_copy(update={section: new})
            self._edited()

        box = (
            ui.number(heading(label, q.unit), value=q.value, format="%.6g")
            .props("outlined dense")
            .on("blur", changed)
            .on("keydown.enter", changed)
        )

    def _edited(self) -> None:
        self.plan.edited = True
        self.plan.done = {}
        self.s.errors.pop("schedule", None)
        self.s.touch("steps")

    def _lengths(self) -> None:
        s, plan = self.s, self.plan
        with ui.element("div").classes("numbers").style("grid-template-columns:repeat(3,minmax(0,1fr))"):
            for key, label in (("lb", "Lb"), ("lc", "Lc"), ("hysteresis", "play")):
                for stage in plan.geometry.vanes:
                    self._number(stage, key, f"{NAMES[stage]} {label}")
        with opened(s, "All lengths"):
            for section in ("crank", *plan.geometry.vanes):
                ui.label("actuator and crank" if section == "crank" else NAMES[section]).classes("soft small")
                with ui.element("div").classes("numbers"):
                    for key, q in getattr(plan.geometry, section):
                        if key not in ("lb", "lc", "hysteresis"):
                            self._number(section, key, key)
                        del q
        self.upload = drop(
            "Drop geometry.toml, schedules.toml or a log", self.most, suffixes(), self._uploaded, self._rejected
        )
        options = {-1: "no log: the backlash entered above", **{i: f.name for i, f in enumerate(s.files)}}
        at = next((i for i, f in enumerate(s.files) if f == plan.log), -1)

        def chosen(e: events.ValueChangeEventArguments[Any]) -> None:
            plan.log = s.files[e.value] if e.value is not None and e.value >= 0 else None
            plan.done = {}
            s.touch("steps")

        ui.select(options, value=at, label="hysteresis log", on_change=chosen).props(
            "outlined dense options-dense"
        ).classes("choose loop-log")

        def shipped() -> None:
            s.extra["plan"] = Plan.of(s)
            s.errors.pop("schedule", None)
            s.touch("plan", "steps")

        ui.button("Back to the shipped engine", icon="undo", on_click=shipped).props("flat dense padding='2px 10px'")

    async def _uploaded(self, e: events.UploadEventArguments) -> None:
        file = await receive(self.s, e, "schedule")
        self.upload.reset()
        if file is None:
            return
        if file.path.suffix.lower() != ".toml":
            self.plan.log = file
            self.plan.done = {}
            self.s.touch("plan", "steps")
            return
        self.s.do("schedule", self._read(file))

    async def _read(self, file: LogFile) -> None:
        part, table_read = await self.s.bench.call("engine_part", "reading", path=str(file.path))
        setattr(self.plan, part, table_read)
        self.plan.loaded += 1
        self._edited()
        self.s.touch("plan")

    def _rejected(self) -> None:
        self.s.errors["schedule"] = (
            f"this file cannot be taken: it is larger than {self.most / 2**20:.0f} MB, or of another kind"
        )
        self.s.touch("steps")

    def _curve(self) -> None:
        plan = self.plan
        with ui.element("div").classes("rowc"):
            ui.label("Schedule of").classes("soft")

            def show(e: events.ValueChangeEventArguments[Any]) -> None:
                plan.stage = e.value
                self.s.touch("curve")

            ui.toggle({k: NAMES[k] for k in plan.schedules.vanes}, value=plan.stage, on_change=show).props(
                "dense unelevated no-caps padding='2px 10px'"
            )
            ui.label("drag a point, or give numbers").classes("soft small")

        def set_value(i: int, value: float) -> None:
            axis = getattr(plan.schedules, plan.stage)
            values = list(axis.values)
            if values[i] == value:
                return
            values[i] = value
            plan.schedules = plan.schedules.model_copy(
                update={
                    plan.stage: axis.model_copy(update={"values": values, "origin": "chosen: entered in the workbench"})
                }
            )
            self._edited()
            editor.put(values)
            boxes[i].set_value(value)

        x, y = list(plan.schedules.speed.values), list(getattr(plan.schedules, plan.stage).values)
        boxes: list[ui.number] = []
        editor = Editor(x, y, set_value)
        with opened(self.s, "As numbers"), ui.element("div").classes("numbers"):
            for i, (n, v) in enumerate(zip(x, y, strict=True)):
                box = ui.number(f"at {n:g} %", value=v, format="%.5g").props("outlined dense")
                box.on(
                    "blur", lambda _, i=i, box=box: set_value(i, float(box.value)) if box.value is not None else None
                )
                boxes.append(box)

    # ---- the steps

    def steps(self) -> None:
        """One button a step, and what each gave."""
        s, live = self.s, self.live
        with card("2  The steps"):
            with ui.element("div").classes("stepper"):
                for i, (step, title) in enumerate(zip(STEPS, TITLES, strict=True)):
                    button = ui.button(f"{i + 1}  {title}", on_click=lambda step=step: self._go(step))
                    button.props("dense padding='5px 14px'")
                    live.watch(partial(self._dress, button, step), "steps", "plan", "schedule")
                    self._dress(button, step)
            with ui.element("div").classes("rowc"):
                self._options()
            live.complaint("schedule")
            live.progress("schedule_step", "engine_part")
            live.part(
                self._links_entered,
                "steps",
                "plan",
                shows=lambda: (self.plan.edited and "entered-geometry.toml" in s.saved,),
            )
            live.part(self._command, "steps", "plan", shows=lambda: (" ".join(self.plan.words()),))
        for step, title in zip(STEPS, TITLES, strict=True):
            live.part(partial(self._result, step, title), "steps", "theme", shows=partial(self._shows, step))

    def _go(self, step: str) -> None:
        if not self.s.working["schedule"]:
            self.s.do("schedule", self._run(step))

    def _dress(self, button: ui.button, step: str) -> None:
        done = step in self.plan.done
        button.props(
            add="outline icon-right=check" if done else "unelevated",
            remove="unelevated" if done else "outline icon-right",
        )
        button.set_enabled(not self.s.working["schedule"] and (step != "loop" or self.plan.log is not None))

    def _options(self) -> None:
        plan = self.plan

        def option(key: str, label: str) -> None:
            def changed(e: events.ValueChangeEventArguments[Any]) -> None:
                if e.value is not None and float(e.value) != self.plan.options[key]:
                    self._option(key, float(e.value))

            ui.number(label, value=plan.options[key], on_change=changed).props("outlined dense").style("width:190px")

        option("step", "lengths change by [mm]")
        option("lb_range", "largest change of Lb [mm]")
        option("lc_range", "largest change of Lc [mm]")
        ui.select(
            {"rms": "best rms error", "max": "best largest error", "design": "best at 100 "
                                                                             "%"}, value=plan.options["criterion"],
            on_change=lambda e: self._option("criterion", e.value),
        ).props("outlined dense options-dense").style("width:190px")  # fmt: skip
        assert {"rms", "max", "design"} == set(CRITERIA)

    def _option(self, key: str, value: Any) -> None:
        self.plan.options[key] = value
        self.plan.done = {k: v for k, v in self.plan.done.items() if k in ("mechanism", "stroke", "loop")}
        self.s.touch("steps")

    def _links_entered(self) -> None:
        if self.plan.edited and "entered-geometry.toml" in self.s.saved:
            with ui.element("div").classes("rowc"):
                ui.label("the engine as entered:").classes("soft small")
                for name in ("geometry.toml", "schedules.toml"):
                    ui.link(f"download {name}", f"/saved/entered-{name}").props(f'download="{name}"').style(
                        "color:var(--measured)"
                    )

    def _command(self) -> None:
        command_line(
            shlex.join(["vaneloop", "schedule", *self.plan.words(), "--out", "engine/", "--report", "schedule.html"])
        )

    async def _run(self, step: str) -> None:
        s, plan = self.s, self.plan
        folder = s.folder / "engine"
        folder.mkdir(mode=0o700, exist_ok=True)
        write_geometry(plan.geometry, folder / "geometry.toml")
        write_schedules(plan.schedules, folder / "schedules.toml")
        words = ["--geometry", str(folder / "geometry.toml"), "--schedules", str(folder / "schedules.toml")]
        o = plan.options
        words += [
            "--step",
            str(o["step"]),
            "--lb-range",
            str(o["lb_range"]),
            "--lc-range",
            str(o["lc_range"]),
            "--criterion",
            o["criterion"],
        ]
        if plan.log is not None and step in ("loop", "tables"):
            words += ["--log", str(plan.log.path)]
        command = shlex.join(["vaneloop", "schedule", *plan.words(), "--report", "schedule.html"])
        out = str(s.folder / "tables")
        asked = plan.geometry, plan.schedules, plan.log, dict(o)
        s.saved |= {f"entered-{n}.toml": folder / f"{n}.toml" for n in ("geometry", "schedules")}
        answer = await s.bench.call(
            "schedule_step", TITLES[STEPS.index(step)].lower(), step=step, words=words, out=out, command=command
        )
        if (
            any(a is not b for a, b in zip(asked[:3], (plan.geometry, plan.schedules, plan.log), strict=True))
            or asked[3] != o
        ):
            return  # the engine has been changed meanwhile
        plan.done[step] = answer
        if step == "tables":
            s.saved |= {f"schedule-{Path(p).name}": Path(p) for p in answer["files"]}
        s.touch("steps")

    def _result(self, step: str, title: str) -> None:
        if step in self.plan.done:
            with card(f"Step {STEPS.index(step) + 1}: {title}"):
                getattr(self, f"_{step}")(self.plan.done[step])

    def _shows(self, step: str) -> tuple[Any, ...]:
        return self.plan.done.get(step), dark(self.s)

    def _mechanism(self, r: dict[str, Any]) -> None:
        Mechanism(r)
        x = np.array(r["strokes"])
        lines = [
            Line(NAMES[g["key"]], x, np.array(g["angles"]), role, 2.0)
            for role, g in zip(STAGE_ROLES, r["stages"], strict=False)
        ]
        figure_of(overlay([Panel("vane angle [deg]", lines)], "stroke [mm]"), dark(self.s), 270)

    def _stroke(self, r: dict[str, Any]) -> None:
        n, t = r["speed"], r["table"]
        lines = [
            Line("extension", n, t[1], "measured"),
            Line("retraction", n, t[2], "model"),
            Line("mean", n, t[3], "target"),
        ]
        figure_of(overlay([Panel("stroke [mm]", lines)], "rotor speed [%]"), dark(self.s), 300)
        ui.label("Curves for the backlash entered: while it extends, the VIGV lags by half of it.").classes("note")

    def _links(self, r: Any) -> None:
        rows = []
        for s in r.links[1:]:
            for name, words in (("initial", "as first built"), ("built", "as entered"), ("adjusted", "adjusted")):
                lb = {"initial": s.lb_initial, "built": s.lb_built, "adjusted": s.lb}[name]
                lc = s.lc if name == "adjusted" else s.lc_built
                figures = (f"{v:.3f}" for v in (s.at_design[name], s.rms[name], s.largest[name]))
                rows.append([NAMES[s.stage], words, f"{lb:g}", f"{lc:g}", *figures])
        with ui.element("div").classes("half"):
            table(["vane row", "", "Lb, mm", "Lc, mm", "at 100 %, deg", "rms", "max"], rows, numbers=(2, 3, 4, 5, 6))
            lines = []
            for k, s in enumerate(r.links[1:], start=1):
                lines += [
                    Line(f"{NAMES[s.stage]} as entered", r.speed, s.error_built, STAGE_ROLES[k], 1.3, "dot"),
                    Line(f"{NAMES[s.stage]} adjusted", r.speed, s.error, STAGE_ROLES[k], 2.0),
                ]
            figure_of(overlay([Panel("error [deg]", lines, zero=True)], "rotor speed [%]"), dark(self.s), 300)

    def _loop(self, r: Any) -> None:
        rows = []
        for name, m in r.loops.items():
            width = f"{m.width:.3f} ± {m.width_sigma:.3f}"
            rows.append([NAMES[name], width, f"{m.offset:.3f}", f"{m.lb:.2f}", f"{m.lc:.2f}", f"{m.noise:.3f}"])
        table(
            ["loop", "width, deg", "offset, deg", "Lb equivalent, mm", "Lc equivalent, mm", "noise, deg"],
            rows,
            numbers=(1, 2, 3, 4, 5),
        )
        m = r.loops["vigv"]
        x, y, side = m.samples
        pick = np.linspace(0, x.size - 1, min(x.size, 3000)).astype(int)
        x, y, side = x[pick], y[pick], side[pick]
        inside = (m.stroke >= STROKE_LIMITS[0]) & (m.stroke <= STROKE_LIMITS[1])
        g = m.stroke[inside]
        with ui.element("div").classes("half"):
            for base, title in ((0.0, "VIGV angle [deg]"), (1.0, "less the mean curve [deg]")):
                mean = lambda at, base=base: base * np.interp(at, m.stroke, m.mean)  # noqa: E731
                groups = (("extension", 1, "measured"), ("retraction", -1, "model"), ("inside the gap", 0, "muted"))
                dots = [
                    Line(f"{n}, measured", x[side == k], y[side == k] - mean(x[side == k]), role)
                    for n, k, role in groups
                    if (side == k).any()
                ]
                curves = [Line(n, g, getattr(m, n)[inside] - mean(g), role, 2.0) for n, _, role in groups[:2]]
                figure_of(with_points(dots, curves, title), dark(self.s), 380)
        notes_of(self.s, "What was done to the log", r.notes)

    def _tables(self, answer: dict[str, Any]) -> None:
        r = answer["result"]
        with ui.element("div").classes("rowc"):
            for p in answer["files"]:
                name = Path(p).name
                ui.link(f"download {name}", f"/saved/schedule-{name}").props(f'download="{name}"').style(
                    "color:var(--measured)"
                )
        pick = [i for i, n in enumerate(r.speed) if n % 5 == 0 or n >= 98]
        rows = [
            [f"{r.speed[i]:g}", *(f"{v:.3f}" for v in r.table[1:, i]), *(f"{s.error[i]:.3f}" for s in r.links[1:])]
            for i in pick
        ]
        with ui.element("div").classes("half"):
            table(
                [
                    "speed, %",
                    "extension, mm",
                    "retraction",
                    "mean",
                    *(f"{NAMES[x.stage]} error, deg" for x in r.links[1:]),
                ],
                rows,
                numbers=range(3 + len(r.links)),
            )
            lines = [
                Line(n, r.speed, r.table[k], role)
                for k, n, role in ((1, "extension", "measured"), (2, "retraction", "model"), (3, "mean", "target"))
            ]
            figure_of(overlay([Panel("stroke [mm]", lines)], "rotor speed [%]"), dark(self.s), 360)
        notes_of(self.s, "What was done to the log", r.notes)
        command_line("vaneloop engine-test --tables engine/", "what remains in an engine test with these tables")
