"""The calibration of the loop that runs, as an XCP master has it: read, changed, pages switched, saved.

Commands go to the process that stands on the bus (`vaneloop.web.loop.Tool`), and from there as frames to the same slave
that INCA or CANape would see. Numbers are shown in the units of the tables.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import numpy as np

from hil.calibrate import master
from hil.calibrate.elements import Element
from vaneloop.web.jobs import WorkError
from vaneloop.web.session import Session

__all__ = ["Tuning", "shown"]

PATIENCE = 60.0  # s: simulated time may run at a tenth of real time
GROUPS = {"stroke_tables": "stroke tables", "vane_angles": "vane angles", "own_calibration": "your controller's own"}


def shown(value: float) -> str:
    """A number as the panel shows it."""
    return f"{value:.7g}"


class Tuning:
    """What the tool knows of the controller that runs.

    elements  what may be calibrated;  (): nothing runs
    pages     float64[2, n] working and reference page, SI;  empty: not read yet
    page      that the firmware uses
    saved     files that the slave wrote last
    told      takes a line and the name of what was changed: for the list of events and the chart
    """

    def __init__(self, session: Session, send: Callable[[int, list[bytes]], None], told: Callable[[str], None]):
        self.session, self._send, self._told = session, send, told
        self.elements: tuple[Element, ...] = ()
        self.pages = np.empty((2, 0))
        self.page = 0
        self.saved: list[Path] = []
        self._waiting: dict[int, asyncio.Future[list[bytes] | str]] = {}
        self._number = 0
        self.asked: set[int] = set()  # numbers whose change is under way: their fields show what was typed

    @property
    def folder(self) -> Path:
        """Where the slave saves."""
        return self.session.folder / "tuned"

    # ---- from the processes

    def began(self, elements: tuple[Element, ...]) -> None:
        """A controller has started; it has what ``elements`` say."""
        self.ended()
        self.elements = elements
        self.session.touch("calibrate")

    def ended(self) -> None:
        """It has stopped."""
        for waits in self._waiting.values():
            if not waits.done():
                waits.set_result("the loop has stopped")
        self._waiting.clear()
        self.elements, self.pages, self.page = (), np.empty((2, 0)), 0
        self.session.touch("calibrate")

    def answered(self, done: list[tuple[int, list[bytes] | str]]) -> None:
        """Jobs have been done."""
        for number, result in done:
            waits = self._waiting.pop(number, None)
            if waits is not None and not waits.done():
                waits.set_result(result)

    # ---- what the panel offers

    def read(self) -> None:
        """Read both pages."""
        self._do(self._read())

    def change(self, number: int, text: str | float | None) -> None:
        """Change a number of the working page: ``text`` in the unit of its table."""
        e = self.elements[number]
        try:
            value = float(str(text).strip())
        except ValueError:
            self._do(self._refused(f"{e.name} (={text!r}) must be a number, in {e.border or '-'}"))
            return
        if self.pages.shape[1] and shown(value) != shown(self.pages[0, number] / e.factor):
            self.asked.add(number)
            self._do(self._change(number, value))

    def use(self, page: int) -> None:
        """Switch the firmware to a page."""
        self._do(self._switch(page))

    def copy(self) -> None:
        """Copy the reference page over the working page."""
        self._do(self._copy())

    def save(self) -> None:
        """Have the working page saved as tables."""
        self._do(self._save())

    def groups(self) -> dict[str, list[int]]:
        """Numbers of what may be calibrated, by section and table."""
        out: dict[str, list[int]] = {}
        for i, e in enumerate(self.elements):
            if not e.fixed and e.table:
                of_table = e.of_curve or e.table != "calibration"
                out.setdefault(GROUPS[e.table] if of_table else e.section.replace("_", " "), []).append(i)
        return out

    # ---- over XCP

    def _do(self, work: Coroutine[Any, Any, None]) -> None:
        self.session.do("calibrate", work)

    async def _refused(self, why: str) -> None:
        raise WorkError(why)

    async def _ask(self, commands: list[bytes], what: str) -> list[bytes]:
        """The answers to commands. Raises WorkError: what could not be done, and why."""
        if not self.elements:
            raise WorkError(f"{what}: no loop runs")
        self._number += 1
        number, waits = self._number, asyncio.get_running_loop().create_future()
        self._waiting[number] = waits
        self._send(number, [master.CONNECT, *commands])
        try:
            result = await asyncio.wait_for(waits, PATIENCE)
        except TimeoutError:
            result = f"no answer within {PATIENCE:g} s"
        if isinstance(result, str):
            raise WorkError(f"{what}: {result}")
        return result[1:]

    async def _read(self) -> None:
        n = len(self.elements)
        answers = await self._ask(
            [*master.read_page(0, n), *master.read_page(1, n), master.PAGE_IN_USE], "reading the calibration"
        )
        half = len(answers) // 2
        self.pages = np.array([master.numbers_of(answers[:half]), master.numbers_of(answers[half : 2 * half])])
        self.page = answers[-1][2]
        self.session.touch("calibrate")

    async def _change(self, number: int, value: float) -> None:
        e = self.elements[number]
        unit = e.border or "-"
        allowed = f"[{shown(e.low / e.factor)}, {shown(e.high / e.factor)}] {unit}"
        what = f"{e.name} (={value:g} {unit}), in {allowed}"
        try:
            answers = await self._ask(master.write_number(number, value * e.factor), what)
        finally:
            self.asked.discard(number)
            self.session.touch("calibrate")  # the field shows again what is
        self.pages[0, number] = np.frombuffer(answers[-1], "<f8")[0]
        if self.page == 0:
            self._told(f"{e.name} {shown(value)} {e.border}".strip())

    async def _switch(self, page: int) -> None:
        name = ("working", "reference")[page]
        try:
            await self._ask(master.use_page(page), f"switching the firmware to the {name} page")
            self.page = page
            self._told(f"{name} page")
        finally:
            self.session.touch("calibrate")

    async def _copy(self) -> None:
        await self._ask(master.copy_page(), "copying the reference page over the working page")
        self._told("reference page copied")
        await self._read()

    async def _save(self) -> None:
        self.saved = []
        await self._ask(master.save_page(), "saving the working page")
        self.saved = sorted(self.folder.glob("*.toml"))
        self.session.saved |= {f"tuned-{f.name}": f for f in self.saved}
        self.session.touch("calibrate")
