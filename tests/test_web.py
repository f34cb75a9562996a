"""The workbench in a real browser: headless Chromium, driven by Playwright. Skips, saying so, where there is no Chromium.

Screenshots are kept in ``out/web`` (or VANELOOP_SHOTS).
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT

CHROMIUM = next((p for p in (shutil.which(n) for n in ("chromium", "chromium-browser", "google-chrome")) if p), None)
SHOTS = Path(os.environ.get("VANELOOP_SHOTS", ROOT / "out" / "web"))
LONG = 300_000.0  # ms; generous: a slow machine with other work compiles the simulator first

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium (make test does, where it may)")


class Server:
    """``vaneloop web`` as a user starts it."""

    def __init__(self, folder: Path, *options: str, **environment: str):
        words = [sys.executable, "-m", "app.main", "web", "--port", "0", "--no-open", "--quiet", "--folder", str(folder), *options]
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        self.process = subprocess.Popen(
            words, stdout=subprocess.PIPE, text=True, cwd=folder, env={**os.environ, "PYTHONPATH": path, **environment}
        )
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()
        assert self.url.startswith("http://"), "vaneloop web printed no address"

    def workers(self) -> list[int]:
        """All processes that the server has started, and theirs."""
        found, look = [], [self.process.pid]
        while look:
            pid = look.pop()
            children = [int(c) for task in Path(f"/proc/{pid}/task").glob("*/children") for c in task.read_text().split()]
            found += children
            look += children
        return found

    def stop(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.wait(20)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("web")
    (folder / "broken.csv").write_text("time_s,n_dem\n0.0,60\n0.1,sixty\n")
    s = Server(folder)
    yield s
    s.stop()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    from playwright.sync_api import sync_playwright

    SHOTS.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as p:
        b = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield b
        b.close()


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    page = context.new_page()
    page.set_default_timeout(LONG)
    page.complaints = []
    page.on("pageerror", lambda e: page.complaints.append(str(e)))
    page.on("console", lambda m: page.complaints.append(m.text) if m.type == "error" else None)
    yield page
    complaints = [c for c in page.complaints if "favicon" not in c and "413" not in c]
    context.close()
    assert not complaints, complaints


def shot(page: Any, name: str) -> None:
    """Keep a picture of the whole page."""
    page.screenshot(path=str(SHOTS / f"{name}.png"), full_page=True)


def choose(page: Any, name: str) -> None:
    page.locator(".choose").click()
    page.get_by_role("option", name=name).click()


def ratio(page: Any) -> float:
    """Held-out error in noise floors, as the page shows it."""
    return float(page.locator(".after").get_attribute("data-ratio"))


def wait_ratio(page: Any, condition: str) -> None:
    page.wait_for_function(f"(() => {{ const e = document.querySelector('.after'); return e && e.dataset.ratio {condition}; }})()")


# ---- page 1: missing physics ------------------------------------------------------------------------------------------------------------


@needs_browser
def test_missing_physics_from_the_log_to_the_falling_error(server: Server, page: Any) -> None:
    page.goto(server.url)
    choose(page, "hidden_effect.parquet")
    page.get_by_text("The actuator stage fails most").wait_for()
    search = page.get_by_role("button", name="Find the missing physics")

    # a cancelled search leaves nothing behind
    search.click()
    page.get_by_text("searching the library").wait_for()
    during = server.workers()
    page.get_by_role("button", name="Cancel").click()
    page.get_by_text("stopped").wait_for()
    deadline = time.monotonic() + 20
    while set(during) & set(server.workers()) and time.monotonic() < deadline:
        before = set(during) & set(server.workers())
        if len(before) <= 1:  # the other worker, which had nothing to do
            break
        time.sleep(0.1)
    assert len(set(during) & set(server.workers())) <= 1

    # a reload in the middle of a search keeps it
    search.click()
    page.get_by_text("searching the library").wait_for()
    page.reload()
    page.get_by_text("The actuator stage lacks valve_dead_band and aero_load").wait_for()
    wait_ratio(page, "< 1.1")
    found = page.locator('[data-effect="valve_dead_band"] .about').inner_text()
    assert (m := re.search(r"half_width ([\d.]+)", found)) and 0.75 < float(m[1]) < 0.85, found
    assert page.get_by_text("vaneloop diagnose", exact=False).first.is_visible()
    shot(page, "missing_1280_light")

    # the error follows the switches
    page.get_by_role("switch", name="aero_load").click()
    wait_ratio(page, "> 5")
    page.get_by_role("switch", name="aero_load").click()
    wait_ratio(page, "< 1.1")

    # and the sliders
    page.get_by_text("Turn the parameters by hand").click()
    slider = page.get_by_role("slider", name="valve_dead_band half_width")
    slider.click(position={"x": 0.7 * slider.bounding_box()["width"], "y": 8})
    page.get_by_text(re.compile(r"error by hand: x_lvdt [\d.]+")).wait_for()
    page.get_by_role("button", name="Back to the fit").click()

    page.get_by_role("button", name="Extended model").click()
    with page.expect_download() as download:
        page.get_by_text("download extended.toml").click()
    text = Path(download.value.path()).read_text()
    assert "[effects.valve_dead_band]" in text and "[effects.aero_load]" in text
