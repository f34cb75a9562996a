"""The workbench in a headless browser: its first page, a long log at every zoom, answers while a diagnosis runs."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.measure import ROOT, Row

__all__ = ["MEASUREMENTS"]

REPEATS = 15  # the example's 200 s, so often: 3,000 s at 100 Hz, 11 signals and the time
PATIENCE = 240_000  # ms
EMPTY = 2.0  # s until the browser has a tab ready: it starts a process for it, whatever the tab shows then
QUIET = 12.0  # s after which what a page has begun to load for its first log is loaded

# One step on the chart of all channels: ms until the browser has drawn the moved view, and until the points of that
# view are there.
STEP = """async ({dx, dy, at}) => {
  const chart = document.querySelector('.curves'), over = chart.querySelector('.u-over');
  const box = over.getBoundingClientRect();
  const answers = chart.dataset.answers, frame = () => new Promise(requestAnimationFrame), began = performance.now();
  over.dispatchEvent(new WheelEvent('wheel', {deltaX: dx, deltaY: dy, clientX: box.left + at * box.width,
    clientY: box.top + 20,
    bubbles: true, cancelable: true}));
  await frame(); await frame();
  const moved = performance.now() - began;
  while (chart.dataset.answers === answers && performance.now() - began < 20000)
    await new Promise((r) => setTimeout(r, 1));
  await frame();
  return [moved, performance.now() - began, Number(chart.dataset.points)];
}"""

# A press on another stage: ms until the page shows that stage.
PRESS = """async (name) => {
  const button = [...document.querySelectorAll('.q-btn-toggle button')].find((b) => b.innerText.trim() === name);
  const began = performance.now();
  button.click();
  while (![...document.querySelectorAll('.soft.small')].some((x) => x.innerText.startsWith('The ' + name)) &&
         performance.now() - began < 20000)
    await new Promise((r) => setTimeout(r, 1));
  return performance.now() - began;
}"""


def long_log(path: Path) -> None:
    """The example again and again, as one log."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(ROOT / "examples" / "hidden_effect.parquet")
    n = table.num_rows
    columns = {name: np.tile(table[name].to_numpy(), REPEATS) for name in table.column_names}
    columns["t"] = np.arange(n * REPEATS) * 0.01
    pq.write_table(pa.table(columns), path)


def chromium() -> str:
    """The path of a Chromium; RuntimeError without one."""
    found = next((p for p in (shutil.which(n) for n in ("chromium", "chromium-browser", "google-chrome")) if p), None)
    if found is None:
        raise RuntimeError("no chromium on this machine")
    return found


@contextlib.contextmanager
def workbench(folder: Path) -> Iterator[tuple[Any, str, int]]:
    """A browser, the address of ``vaneloop web``, and the number of its process."""
    from playwright.sync_api import sync_playwright

    browser_path = chromium()
    words = [
        sys.executable,
        "-m",
        "vaneloop.cli.main",
        "web",
        "--port",
        "0",
        "--no-open",
        "--quiet",
        "--folder",
        str(folder),
    ]
    server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert server.stdout is not None
        url = server.stdout.readline().strip()
        with sync_playwright() as p:
            browser = p.chromium.launch(executable_path=browser_path, args=["--no-sandbox"])
            yield browser, url, server.pid
            browser.close()
    finally:
        server.terminate()
        server.wait(60)


def row(what: str, seconds: list[float], limit: float, note: str) -> Row:
    """Median against ``limit``, the worst beside it."""
    ours, worst = float(np.median(seconds)), max(seconds)
    note = f"worst of {len(seconds)}: {worst * 1e3:,.0f} ms; {note}"
    return Row(
        what, f"{ours * 1e3:,.0f} ms", f"limit {limit * 1e3:,.0f} ms", limit / ours, ">= 1", bool(ours <= limit), note
    )


def web() -> Iterator[Row]:
    """First page; zoom and pan of 3,000 s; answers while a diagnosis runs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        long_log(folder / "long.parquet")
        with workbench(folder) as (browser, url, _):
            first = []
            for k in range(6):
                context = browser.new_context(viewport={"width": 1920, "height": 1000})
                page = context.new_page()
                page.set_default_timeout(PATIENCE)
                time.sleep(EMPTY)
                began = time.perf_counter()
                page.goto(url)
                page.locator(".choose").click()
                page.get_by_role("option", name="long.parquet").wait_for()
                if k:  # the first one after the server's start loads modules
                    first.append(time.perf_counter() - began)
                if k < 5:
                    context.close()
                    time.sleep(QUIET)
            yield row("web: first page, until the list of logs is open", first, 1.0, "empty browser cache each time")

            page.get_by_role("option", name="long.parquet").click()
            page.get_by_text("All channels").click()
            page.locator(".curves .uplot").first.wait_for()
            page.get_by_role("button", name="Find the missing physics").wait_for()
            time.sleep(3.0)
            steps = [{"dx": 0, "dy": -400, "at": 0.4}] * 14 + [{"dx": 400, "dy": 0, "at": 0.5}] * 10
            steps += [{"dx": 0, "dy": 400, "at": 0.6}] * 10
            moved, fresh, points = map(list, zip(*(page.evaluate(STEP, s) for s in steps), strict=True))
            note = f"3,000 s, 100 Hz, 11 signals and the time; {max(points):,.0f} points drawn at most"
            yield row("web: zoom and pan, the view moves", [m / 1e3 for m in moved], 0.1, note)
            yield row(
                "web: zoom and pan, the points of the view are there",
                [f / 1e3 for f in fresh],
                0.2,
                "thinned on the server",
            )

            page.get_by_role("button", name="Find the missing physics").click()
            page.get_by_text("subsystems searched").wait_for()
            answers = []
            stages = ["servo", "engine", "linkage", "actuator", "demand"]
            for k in range(20):
                answers.append(page.evaluate(PRESS, stages[k % 5]) / 1e3)
                time.sleep(0.3)
            running = page.get_by_role("button", name="Cancel").first.is_visible()
            zooms = [page.evaluate(STEP, s)[1] / 1e3 for s in steps[:10]]
            yield row(
                "web: another stage, while a diagnosis runs", answers, 0.2, "" if running else "THE DIAGNOSIS HAD ENDED"
            )
            yield row("web: zoom, while a diagnosis runs", zooms, 0.2, "until the points of the view are there")


# A press on a switch: ms until the page shows the fit with it, or without.
SWITCH = """async (name) => {
  const before = document.querySelector('.after').dataset.ratio, began = performance.now();
  document.querySelector(`[aria-label="${name}"]`).click();
  while (document.querySelector('.after').dataset.ratio === before && performance.now() - began < 60000)
    await new Promise((r) => setTimeout(r, 1));
  return performance.now() - began;
}"""
LIVE = 180.0  # s of the live loop at ten times real time: half an hour of its own time
GROWTH = 0.1  # of the memory that half an hour may add once the page has all that it keeps
KEPT, LISTED = 420.0, 60  # s of the loop's own time, and events, after which it forgets as much as it takes in


def resident(pid: int) -> int:
    """Memory of a process and all that it started, in bytes."""
    process = psutil.Process(pid)
    return sum(p.memory_info().rss for p in (process, *process.children(recursive=True)))


def two_minutes() -> Iterator[Row]:
    """The way of a user with a log of 200 s: where it fails, the first finding, the diagnosis, a switch."""
    with workbench(ROOT / "examples") as (browser, url, _):
        page = browser.new_context(viewport={"width": 1280, "height": 900}).new_page()
        page.set_default_timeout(PATIENCE)
        page.goto(url)
        page.locator("input[type=file]").first.wait_for(state="attached")
        dropped, found, whole, switched = [], [], [], []
        for k in range(4):
            file = page.locator("input[type=file]").first
            began = time.perf_counter()
            file.set_input_files(str(ROOT / "examples" / "hidden_effect.parquet"))
            if k:
                page.get_by_text("fails most in the actuator subsystem").wait_for(state="detached")
            page.get_by_text("fails most in the actuator subsystem").wait_for()
            dropped.append(time.perf_counter() - began)
            began = time.perf_counter()
            page.get_by_role("button", name="Find the missing physics").click()
            page.locator(".sofar").first.wait_for()
            found.append(time.perf_counter() - began)
            page.get_by_text("The actuator subsystem lacks").wait_for()
            whole.append(time.perf_counter() - began)
            page.locator(".after").wait_for()
        time.sleep(20.0)  # the fits ahead
        for _ in range(8):
            switched.append(page.evaluate(SWITCH, "aero_load") / 1e3)
        note = "the first is with modules still to load"
        yield row("web: a log of 200 s, until where it fails is shown", dropped, 3.0, note)
        yield row("web: a diagnosis, until the first stage has its answer", found, 2.0, "stages as they finish")
        yield row("web: a diagnosis, whole", whole, 5.0, "five stages, two processes")
        yield row("web: a switch whose fit is made ahead", switched, 0.2, "")


def heap(page: Any) -> float:
    """What a page's script holds after the garbage is collected, in bytes."""
    asked = page.context.new_cdp_session(page)
    asked.send("HeapProfiler.enable")
    asked.send("HeapProfiler.collectGarbage")
    held = float(asked.send("Runtime.getHeapUsage")["usedSize"])
    asked.detach()
    return held


def nodes(page: Any) -> float:
    """Elements of a page, those too that are in no document any more."""
    asked = page.context.new_cdp_session(page)
    counted = float(asked.send("Memory.getDOMCounters")["nodes"])
    asked.detach()
    return counted


def browsers(server: int) -> int:
    """Memory of the browser's processes: all that this process started but the server and its own, in bytes."""
    own = psutil.Process(server)
    not_ours = {server, *(p.pid for p in own.children(recursive=True))}
    return sum(p.memory_info().rss for p in psutil.Process().children(recursive=True) if p.pid not in not_ours)


def half_an_hour() -> Iterator[Row]:
    """Memory of the server with all that it started, and of the browser, while the live loop runs for half an hour:
    of its own time, at ten times real time; with ``VANELOOP_TRUE_TIME=1`` of true time.

    A page keeps six minutes of the loop and its latest events. Until they are there it grows, as it must: that is told
    beside. From then on growth would be a leak.
    """
    true_time = bool(os.environ.get("VANELOOP_TRUE_TIME"))
    length = 1800.0 if true_time else LIVE
    with workbench(ROOT / "examples") as (browser, url, server):
        page = browser.new_context(viewport={"width": 1280, "height": 900}).new_page()
        page.set_default_timeout(PATIENCE)
        page.goto(url.replace("/?", "/run?"))
        if not true_time:
            page.locator(".pace").click()
            page.get_by_role("option", name="10 x", exact=True).click()
        page.get_by_role("button", name="Start", exact=True).click()
        page.locator('[data-lamp="RUN"].good').wait_for()

        def fault(wait: float) -> None:
            page.get_by_role("button", name="demand_stops", exact=True).click()
            page.wait_for_timeout(1e3 * wait)

        def reached() -> float:
            return float(page.locator(".tiles .v").first.inner_text().replace(",", ""))

        measured: dict[str, Callable[[], float]] = {
            "page": lambda: heap(page), "nodes": lambda: nodes(page), "browser": lambda: browsers(server),
            "server": lambda: resident(server),
        }  # fmt: skip
        new = {name: m() for name, m in measured.items()}
        while reached() < KEPT or page.locator(".moment").count() < LISTED:
            fault(5.0)
        before = {name: m() for name, m in measured.items()}
        end = time.perf_counter() + length
        while (left := end - time.perf_counter()) > 0:
            fault(min(30.0, left))
        for name, m in measured.items():
            after = m()
            grown = after / before[name] - 1.0
            unit, size = ("", 1.0) if name == "nodes" else (" MB", 2.0**20)
            note = (
                f"new {new[name] / size:,.0f}, full {before[name] / size:,.0f}, then {after / size:,.0f}{unit}; "
                f"{reached():,.0f} s of the loop's own time"
            )
            yield Row(
                f"web: growth of memory, {WHAT[name]}", f"{100 * grown:.1f} %", f"limit {100 * GROWTH:.0f} %",
                GROWTH / max(grown, 1e-3), ">= 1", grown <= GROWTH, note,
            )  # fmt: skip


WHAT = {
    "server": "the server and its processes", "browser": "the browser's processes",
    "page": "what the page's script holds", "nodes": "the page's elements",
}  # fmt: skip
MEASUREMENTS: dict[str, Callable[[], Iterator[Row]]] = {
    "the workbench": web, "two minutes with the workbench": two_minutes, "half an hour of the live loop": half_an_hour,
}  # fmt: skip
