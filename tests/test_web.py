"""The workbench in a real browser: headless Chromium, driven by Playwright. Skips, saying so, where there is no
Chromium.

Pictures are kept in the folder VANELOOP_SHOTS, where it is set.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import vaneloop
from hil.logs.notes import counted
from hil.logs.survey import survey
from tests.browser import AXE, CHROMIUM, LONG, WHY_NOT, driver, look_at, shot, violations
from tests.conftest import ROOT, examples
from tests.test_realtime import ON_TIME_US

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason=WHY_NOT)


class Server:
    """``vaneloop web`` as a user starts it."""

    def __init__(self, folder: Path, *options: str, module: str = "vaneloop.cli.main", **environment: str):
        words = [
            sys.executable,
            "-m",
            module,
            "web",
            "--port",
            "0",
            "--no-open",
            "--quiet",
            "--folder",
            str(folder),
            *options,
        ]
        more = environment.pop("PYTHONPATH", "")
        path = os.pathsep.join([str(ROOT), more, os.environ.get("PYTHONPATH", "")])
        self.folder, self.environment = folder, {**os.environ, "PYTHONPATH": path, **environment}
        self.said = folder / "said.txt"  # on standard error
        with self.said.open("w") as said:
            self.process = subprocess.Popen(
                words, stdout=subprocess.PIPE, stderr=said, text=True, cwd=folder, env=self.environment
            )
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()
        link = re.fullmatch(r"(http://[^/]+:(\d+)/)\?token=([\w-]{16,})", self.url)
        assert link, f"vaneloop web printed no link, but {self.url!r}"
        self.port, self.token = int(link[2]), link[3]
        self.known = f"vaneloop_token_{self.port}={self.token}"  # the cookie
        self.session = ""  # the cookie of the one session that all requests of our own share

    def at(self, page: str) -> str:
        """Address of a page, with the token."""
        return self.url.replace("/?", f"/{page}?")

    def workers(self) -> list[int]:
        """All processes that the server has started, and theirs."""
        found, look = [], [self.process.pid]
        while look:
            pid = look.pop()
            children = [
                int(c) for task in Path(f"/proc/{pid}/task").glob("*/children") for c in task.read_text().split()
            ]
            found += children
            look += children
        return found

    def searching(self) -> set[int]:
        """Workers that have processes of their own, and these."""
        below: dict[int, set[int]] = {}
        for pid in self.workers():
            with contextlib.suppress(OSError):
                own = [c for task in Path(f"/proc/{pid}/task").glob("*/children") for c in task.read_text().split()]
                below[pid] = {int(c) for c in own}
        return {p for pid, own in below.items() if own for p in (pid, *own)}

    def hold_search(self) -> set[int]:
        """Stop the processes of the search that was just asked for where they are, as soon as there are any."""
        deadline = time.monotonic() + LONG / 1000.0
        while len(found := self.searching()) < 2:  # a search has a worker and its own processes
            assert time.monotonic() < deadline, "no search has begun"
            time.sleep(0.01)
        for pid in found:
            os.kill(pid, signal.SIGSTOP)
        return found

    def stop(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.wait(600)


def renamed(path: Path) -> None:
    """Thirty seconds of the example under names of a test bench, the speeds in rpm, the stroke in m."""
    import numpy as np

    from hil.logs import read_log

    log = read_log(ROOT / "examples" / "hidden_effect.parquet")
    other = {"n_dem": ("N1_DEM", 380.0), "n_r": ("N1", 380.0), "x_lvdt": ("ACT_POS", 1e-3)}
    other |= {name: (name, 1.0) for name in ("x_dem", "i_cmd")}
    columns = {name: log.channels[signal].values[:3000] * scale for signal, (name, scale) in other.items()}
    columns["Fuel"] = log.channels["n_r"].values[:3000] * 0.1  # no signal of ours
    table = np.column_stack([log.channels["n_r"].t[:3000], *columns.values()])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=",".join(["t", *columns]), comments="")


def faulted(path: Path) -> None:
    """Thirty seconds in which the controller is in DEGRADED and in FAIL_SAFE, each for a tenth of a second."""
    t = np.arange(0.0, 30.0, 0.01)
    state = np.where(t < 10.0, 2.0, np.where(t < 10.1, 3.0, np.where(t < 10.2, 4.0, 2.0)))
    fault = (t >= 10.0) & (t < 10.2)
    table = np.column_stack([t, 70.0 + np.sin(t), 20.0 + np.sin(t), state, fault])
    np.savetxt(path, table, delimiter=",", header="t,n_dem,x_lvdt,state,fault_demand_stale", comments="", fmt="%.6g")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("web")
    (folder / "broken.csv").write_text("time_s,n_dem\n0.0,60\n0.1,sixty\n")
    renamed(folder / "renamed.csv")
    faulted(folder / "faulted.csv")
    s = Server(folder)
    yield s
    s.stop()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    with driver() as p:
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


def tab_to(page: Any, selector: str) -> None:
    """Press Tab until the element that matches has the focus."""
    for _ in range(200):
        page.keyboard.press("Tab")
        if page.evaluate("(s) => !!document.activeElement && document.activeElement.matches(s)", selector):
            return
    raise AssertionError(f"{selector} cannot be reached by keyboard")


# curves that show what a cell of a failure map leads to
SHOWS_4_S = (
    "[...document.querySelectorAll('.curves')].some((c) => c.dataset.view && "
    "Math.abs(c.dataset.view.split(' ')[1] - c.dataset.view.split(' ')[0] - 4) < 0.01)"
)


def holds_focus(page: Any, selector: str) -> None:
    """What matches has the focus, or gets it, and shows it: by an outline, a shadow, or a border that changes."""
    page.wait_for_function("(s) => document.activeElement.matches(s)", arg=selector)
    shows = "(c) => c.outlineStyle !== 'none' || c.boxShadow !== 'none' || c.borderTopWidth === '2px'"
    page.wait_for_function(
        f"""() => {{ const e = document.activeElement, f = e.closest(".q-field__control");
            return [getComputedStyle(e), ...(f ? [getComputedStyle(f, "::after")] : [])].some({shows}); }}"""
    )


# elements that reach over the right edge, with their classes and widths
STICKS_OUT = """[...document.querySelectorAll('body *')].filter((e) =>
    e.getBoundingClientRect().right > document.documentElement.clientWidth + 0.5).slice(0, 12).map((e) =>
    `${e.tagName}.${e.getAttribute('class')} ${Math.round(e.getBoundingClientRect().right)}`)"""


def looks(page: Any, name: str) -> None:
    """A laptop, a phone, a wide screen: nothing sticks out, axe-core is content, in light and in dark. A page has the
    same elements on a laptop and on a wide screen, and no colour is set by a width.
    """
    for width, dark, rules in ((1280, False, AXE), (360, True, AXE), (1920, True, "")):
        page.set_viewport_size({"width": width, "height": 900})
        if dark != ("body--dark" in (page.locator("body").get_attribute("class") or "")):
            page.get_by_label("light or dark").click()
            page.wait_for_function(f"document.body.classList.contains('body--dark') === {str(dark).lower()}")
        page.wait_for_timeout(700)  # charts are drawn in their new colours; on a busy machine that takes longer
        fits = "document.documentElement.scrollWidth <= document.documentElement.clientWidth"
        end = time.monotonic() + 1e-3 * LONG
        while not page.evaluate(fits) and time.monotonic() < end:
            page.wait_for_timeout(3000)  # a chart that is drawn while the width changes takes the next width
            page.set_viewport_size({"width": width + 1, "height": 900})
            page.wait_for_timeout(700)  # two sizes in one frame are one change, or none
            page.set_viewport_size({"width": width, "height": 900})
            page.wait_for_timeout(700)
        assert page.evaluate(fits), f"{name} at {width}: what sticks out: {page.evaluate(STICKS_OUT)}"
        end = time.monotonic() + 30.0
        while (found := violations(page, rules) if rules else {}) and time.monotonic() < end:
            page.wait_for_timeout(1000)
        shot(page, f"{name}_{width}_{'dark' if dark else 'light'}")
        assert not found, f"{name} at {width}: {found}"
    page.get_by_label("light or dark").click()
    page.set_viewport_size({"width": 1280, "height": 800})


def choose(page: Any, name: str) -> None:
    page.locator(".choose").click()
    page.get_by_role("option", name=name).click()


def ratio(page: Any) -> float:
    """Held-out error in noise floors, as the page shows it."""
    return float(page.locator(".after").get_attribute("data-ratio"))


def wait_ratio(page: Any, condition: str) -> None:
    page.wait_for_function(
        f"(() => {{ const e = document.querySelector('.after'); return e && e.dataset.ratio {condition}; }})()"
    )


# ---- every page ------------------------------------------------------------------------------------------------------


@needs_browser
def test_every_page_opens_without_a_complaint_and_is_open_to_all(server: Server, page: Any) -> None:
    for place, shows in (("", "Missing physics"), ("schedule", "Schedule"), ("run", "Run"), ("fleet", "Fleet")):
        page.goto(server.at(place))
        page.get_by_role("heading", level=1, name=shows).wait_for(state="attached")
        if place:  # the first is looked at with what its search has found
            assert not violations(page, AXE), shows


# ---- page 1: missing physics -----------------------------------------------------------------------------------------


@needs_browser
def test_missing_physics_from_the_log_to_the_falling_error(server: Server, page: Any) -> None:
    page.goto(server.url)
    # all of the way by keyboard: the log, the search, a switch
    page.get_by_text("Drop a log here").first.wait_for()
    tab_to(page, ".choose input")
    page.keyboard.press("Enter")
    option = page.get_by_role("option", name="hidden_effect.parquet")
    option.wait_for()
    chosen = "[...document.querySelectorAll('[role=option]')].findIndex((o) => o.innerText.includes('hidden_effect'))"
    for _ in range(1 + page.evaluate(chosen)):
        page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    page.get_by_text("fails most in the actuator subsystem").wait_for()
    holds_focus(page, ".choose input")  # drawn anew meanwhile
    tab_to(page, "[aria-label^='failure map']")
    for key in ("ArrowDown", "ArrowRight", "ArrowUp"):  # the lowest row has no eight cells
        page.keyboard.press(key)
    page.get_by_text(re.compile(r"stroke .*: 1\d\d noise floors")).wait_for(state="attached")
    assert page.locator(".shapelayer path").count() == 1
    page.keyboard.press("Enter")
    page.wait_for_function(SHOWS_4_S)
    page.keyboard.press("Tab")
    holds_focus(page, ".show-worst")
    page.keyboard.press("Enter")  # the curves go to the worst moment of the map
    page.wait_for_function(SHOWS_4_S)

    # a cancelled search leaves nothing behind
    tab_to(page, ".find-missing")
    page.keyboard.press("Enter")
    during = server.hold_search()
    holds_focus(page, ".cancel")  # the button that began it is gone
    page.keyboard.press("Enter")
    page.get_by_text("stopped").wait_for()
    holds_focus(page, ".find-missing")
    deadline = time.monotonic() + 600
    while during & set(server.workers()) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not during & set(server.workers())  # workers and the spare process that had nothing to do stay

    # a reload in the middle of a search keeps it
    page.keyboard.press("Enter")
    during = server.hold_search()
    page.reload()
    page.get_by_role("button", name="Cancel").wait_for()
    for pid in during:
        os.kill(pid, signal.SIGCONT)
    page.get_by_text("The actuator subsystem lacks valve_dead_band and aero_load").wait_for()
    wait_ratio(page, "< 1.1")
    found = page.locator('[data-effect="valve_dead_band"] .about').inner_text()
    assert (m := re.search(r"half_width ([\d.]+)", found)) and 0.75 < float(m[1]) < 0.85, found
    assert page.get_by_text("vaneloop diagnose", exact=False).first.is_visible()
    shot(page, "missing_1280_light")

    # the error follows the switches
    tab_to(page, "[aria-label=aero_load]")
    page.keyboard.press(" ")
    wait_ratio(page, "> 5")
    page.get_by_role("switch", name="aero_load").click()
    wait_ratio(page, "< 1.1")

    # a button stays the same element while work goes on in the background: a click on one that was drawn anew would be
    # lost
    page.evaluate(
        "window.kept = [...document.querySelectorAll('button')].find((b) => b.innerText.includes('Extended model'))"
    )

    # and the sliders
    page.get_by_text("Turn the parameters by hand").click()
    slider = page.get_by_role("slider", name="valve_dead_band half_width")
    slider.click(position={"x": 0.7 * slider.bounding_box()["width"], "y": 8})
    page.get_by_text(re.compile(r"error by hand: x_lvdt [\d.]+")).wait_for()
    page.get_by_role("button", name="Back to the fit").click()

    assert page.evaluate("window.kept.isConnected")
    page.get_by_role("button", name="Extended model").click()
    with page.expect_download() as download:
        page.get_by_text("download extended.toml").click()
    text = Path(download.value.path()).read_text()
    assert "[effects.valve_dead_band]" in text and "[effects.aero_load]" in text
    looks(page, "missing")


@pytest.mark.slow
@needs_browser
def test_where_the_library_knows_nothing_a_law_is_learned_saved_and_added(
    server: Server, page: Any, tmp_path: Path
) -> None:
    """The engine of tests/test_learn_vanes.py: its lag grows with its speed."""
    from hil.logs import Channel, write_log
    from tests import rig
    from tests.firmware_on_rig import firmware

    hidden = rig.Hidden("speed_dependent_lag", {"slope": 0.012})
    run = rig.simulate(rig.manoeuvre(31, 100.0), firmware(), [hidden], seed=7, rate=100)
    channels = {k: Channel(run.log["t"], v) for k, v in run.log.items() if k in ("n_dem", "n_r")}
    write_log(tmp_path / "lag.parquet", channels)
    page.goto(server.url)
    page.locator("input[type=file]").first.set_input_files(tmp_path / "lag.parquet")
    page.get_by_role("button", name="Find the missing physics").click()
    learn = page.get_by_role("button", name="Learn the law")
    learn.click()
    page.locator(".rowc", has_text="trying every quantity at every place").locator(".cancel").click()
    page.get_by_text("stopped").wait_for()
    learn.click()
    page.get_by_text("Engine.lag is multiplied by 1 + a function of n_r").first.wait_for()
    before, after = (float(x) for x in re.findall(r"[\d.]+", page.locator(".law-error").inner_text()))
    assert after < 1.2 < before
    assert page.locator(".vtable", has_text="0.01").count()  # the formulas
    page.wait_for_function("document.querySelectorAll('.half .main-svg').length >= 2")
    looks(page, "learned")
    with page.expect_download() as download:
        page.get_by_text("download law.toml").click()
    law = tomllib.loads(Path(download.value.path()).read_text())
    assert list(law["curves"]) == ["engine.lag.gain_of_n_r"]
    page.locator(".add-law").click()
    with page.expect_download() as download:
        page.get_by_text("download extended.toml").click()
    assert "engine.lag.gain_of_n_r" in tomllib.loads(Path(download.value.path()).read_text())["curves"]
    page.get_by_role("button", name="Go on with this model").click()
    page.locator(".verdict.good", has_text="fits").wait_for()


@needs_browser
def test_a_bad_file_gets_the_command_lines_one_line(server: Server, page: Any, tmp_path: Path) -> None:
    page.goto(server.url)
    page.get_by_role("button", name="Open the example").click()
    page.get_by_text("19,700").or_(page.get_by_text("20,000")).first.wait_for()  # samples of its signals
    choose(page, "broken.csv")
    alert = page.get_by_role("alert").filter(has_text="broken.csv")
    alert.wait_for()
    said = alert.inner_text()
    assert said.startswith("vaneloop: broken.csv: ") and "\n" not in said and "Traceback" not in said
    words = [sys.executable, "-m", "vaneloop.cli.main", "compare", "broken.csv"]
    done = subprocess.run(words, cwd=server.folder, env=server.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.strip().splitlines()[-1] == said

    strange = tmp_path / "model.exe"
    strange.write_bytes(b"MZ")
    page.locator("input[type=file]").first.set_input_files(strange)
    page.get_by_text("this file cannot be taken").wait_for()
    junk = tmp_path / "junk.parquet"
    junk.write_bytes(b"PAR1" + bytes(range(256)) * 40 + b"PAR1")
    page.locator("input[type=file]").first.set_input_files(junk)
    page.get_by_role("alert").filter(has_text="junk.parquet").wait_for()
    assert "Traceback" not in page.get_by_role("alert").inner_text()

    # a file that cannot be opened has no names to be mapped, whatever was chosen before it
    junk = tmp_path / "junk.mf4"
    junk.write_bytes(b"MDF     4.10    " + bytes(range(256)) * 40)
    page.locator("input[type=file]").first.set_input_files(junk)
    page.get_by_role("alert").filter(has_text="junk.mf4").wait_for()
    page.get_by_text("Names and units").first.wait_for(state="detached")


@pytest.mark.slow
@needs_browser
def test_a_page_that_fails_inside_says_so_in_a_plain_line(browser: Any, tmp_path: Path) -> None:
    """In the browser what to do next, in the terminal the line of the defect; no traceback anywhere. The other parts
    go on: a search whose answer is late shows what its stages said meanwhile.
    """
    (tmp_path / "broken_pages.py").write_text(
        "import sys\nfrom vaneloop.cli.main import main\nimport vaneloop.web.schedule as s\n"
        "import vaneloop.web.chosen_log as c\n"
        "s.build = lambda *_: 1 / 0\nc.ChosenLog._channels = lambda self: self.s.choice.file and {}['gone']\n"
        "import asyncio, pathlib\nfrom vaneloop.web.jobs import Worker\ncall = Worker.call\n"
        "async def late(self, name, text, **given):\n"
        "    answer = await call(self, name, text, **given)\n"
        "    while name == 'diagnose' and not pathlib.Path('answered').exists():\n"
        "        await asyncio.sleep(0.05)\n"
        "    return answer\n"
        "Worker.call = late\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    server = Server(tmp_path, module="broken_pages", PYTHONPATH=str(tmp_path))
    try:
        page = browser.new_page()
        page.set_default_timeout(LONG)
        assert page.goto(server.at("schedule")).status == 500
        assert page.get_by_text("This page could not be made").count()
        page.goto(server.at(""))
        choose(page, "hidden_effect.parquet")
        page.get_by_role("alert").filter(has_text="a part of this page failed").wait_for()
        page.get_by_text("fails most in the actuator subsystem").wait_for()  # the other parts go on
        page.get_by_role("button", name="Find the missing physics").click()
        page.get_by_text(re.compile("so far: .* fits")).first.wait_for()  # stages as they finish
        page.get_by_text("subsystems searched").wait_for()
        (tmp_path / "answered").touch()
        page.get_by_text("The actuator subsystem lacks valve_dead_band and aero_load").wait_for()
        page.get_by_text("so far:").first.wait_for(state="detached")  # the answer says it
        server.stop()
        page.get_by_role("alert").filter(has_text="The workbench has ended. Start it again").wait_for()
        page.context.close()
    finally:
        server.stop()
    lines = server.said.read_text().strip().splitlines()
    assert lines and all(line.startswith("vaneloop: internal error: ") for line in lines)
    assert any("ZeroDivisionError" in line for line in lines) and any("KeyError: 'gone'" in line for line in lines)


@pytest.mark.slow
@needs_browser
def test_names_and_units_are_given_in_a_form(server: Server, page: Any) -> None:
    page.goto(server.url)
    choose(page, "renamed.csv")
    # the form is open: a name is guessed, and the speeds are in rpm, whose design speed is proposed
    stroke = page.get_by_label("name of x_lvdt in the log")
    stroke.wait_for()
    assert stroke.get_attribute("placeholder") == "ACT_POS"
    page.get_by_text(re.compile("guessed, 8. % sure")).first.wait_for()
    assert page.locator(".spark").count() >= 4
    page.get_by_text("--design-rpm 38000, if that is 100 %").first.wait_for()
    # what the log has beside them is named, with the reason, in the words of `vaneloop map`
    seen = survey(server.folder / "renamed.csv")
    assert page.locator(".unused li").all_inner_texts() == seen.unused() != []
    page.get_by_text("What reading did to the log").click()  # as data: the table of the command's page
    table = page.locator(".vtable", has_text="in words")
    assert table.locator("tr").count() == 1 + len(counted(seen.notes)) > 1
    assert "guessed" in table.inner_text()
    looks(page, "guessed")
    page.get_by_text("What reading did to the log").click()
    for ours, name in (("n_dem", "N1_DEM"), ("n_r", "N1"), ("x_lvdt", "ACT_POS")):
        page.get_by_label(f"name of {ours} in the log").fill(name)
    for ours, unit in (("n_dem", "rpm"), ("n_r", "rpm"), ("x_lvdt", "m")):
        page.get_by_label(f"unit of {ours} in the log").fill(unit)
    page.get_by_role("button", name="Use 38000 rpm").click()
    page.locator(".cmd code", has_text=re.compile(r" compare .*--design-rpm 38000")).first.wait_for()
    page.get_by_text("fails most in the").wait_for()
    assert page.get_by_label("name of n_r in the log").input_value() == "N1"
    # typed and confirmed with Enter, a name stays; all of it is saved as the file that --mapping takes
    page.get_by_text("Names and units").click()  # nothing is guessed any more: the form is closed
    page.get_by_label("name of x_dem in the log").click()
    page.keyboard.type("x_dem")
    page.keyboard.press("Enter")
    page.locator(".cmd code", has_text=re.compile(r" compare .*--map x_dem=x_dem")).first.wait_for()
    page.get_by_text("fails most in the").wait_for()
    page.get_by_role("button", name="Save as mapping file").click()
    with page.expect_download() as download:
        page.get_by_text("download mapping.toml").click()
    bench = tomllib.loads(Path(download.value.path()).read_text())
    assert bench["names"]["n_r"] == "N1" and bench["units"]["x_lvdt"] == "m"
    preview = page.locator(".vtable").first.inner_text()
    assert "ACT_POS" in preview and "N1_DEM" in preview
    command = page.locator(".cmd code", has_text=" compare ").inner_text()
    assert "--map N1=n_r" in command and "--unit x_lvdt=m" in command and "--design-rpm 38000" in command
    shot(page, "mapped_1280_light")
    # another day: the mapping file first, then a log of that bench
    file = server.folder / "mapping_of_the_bench.toml"
    file.write_bytes(Path(download.value.path()).read_bytes())
    context = page.context.browser.new_context(viewport={"width": 1280, "height": 800})
    later = context.new_page()
    later.set_default_timeout(LONG)
    later.goto(server.url)
    later.locator("input[type=file]").first.set_input_files(str(file))
    later.locator(".for-the-next", has_text="mapping_of_the_bench.toml").wait_for()
    choose(later, "renamed.csv")
    later.get_by_text("fails most in the").wait_for()
    assert "--mapping mapping_of_the_bench.toml" in later.locator(".cmd code", has_text=" compare ").inner_text()
    context.close()


def test_a_file_that_never_changes_is_answered_from_memory_and_nothing_else_is() -> None:
    """The same bytes and headers; what is for one browser, may change, or is asked for in part goes to the pages."""

    from vaneloop.web.lasting import Lasting

    asked: list[str] = []
    lasting = [(b"cache-control", b"public, max-age=31536000, immutable")]
    headers = {"/file": lasting, "/page": [], "/own": [*lasting, (b"set-cookie", b"id=1")], "/gone": lasting}

    async def pages(scope: Any, receive: Any, send: Any) -> None:
        asked.append(scope["path"])
        status = 404 if scope["path"] == "/gone" else 200
        await send({"type": "http.response.start", "status": status, "headers": list(headers[scope["path"]])})
        await send({"type": "http.response.body", "body": b"one, ", "more_body": True})
        await send({"type": "http.response.body", "body": b"two"})

    app = Lasting(pages)

    def get(path: str, **more: Any) -> tuple[int, list[Any], bytes]:
        said: list[Any] = []

        async def send(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"].append((b"from", b"the guard"))  # as the guard adds its own: to this answer only
            said.append(message)

        scope = {"type": "http", "method": "GET", "path": path, "headers": [], "query_string": b"", **more}
        with ThreadPoolExecutor(1) as apart:  # the browser's own loop may run in this thread
            apart.submit(asyncio.run, app(scope, None, send)).result()  # type: ignore[arg-type]
        return said[0]["status"], said[0]["headers"], b"".join(m["body"] for m in said[1:])

    for path in headers:
        assert get(path) == get(path) == get(path), path
    assert asked.count("/file") == 1 and all(asked.count(p) == 3 for p in headers if p != "/file")
    assert get("/file")[2] == b"one, two"
    for more in ({"method": "HEAD"}, {"query_string": b"x=1"}, {"headers": [(b"Range", b"bytes=0-1")]},
                 {"headers": [(b"if-none-match", b"x")]}):  # fmt: skip
        before = len(asked)
        get("/file", **more)
        assert len(asked) == before + 1, more


@pytest.mark.slow
def test_a_worker_takes_the_process_that_is_loaded_and_what_that_does_first_is_told(tmp_path: Path) -> None:

    from vaneloop.web.jobs import LOADING, Spare, Worker

    async def go() -> None:
        spare = Spare()
        spare.refill()
        assert spare._ready is not None
        loaded = spare._ready[0].pid
        w = Worker(spare=spare)
        try:
            asked = asyncio.ensure_future(w.call("offers", "opening the file", words=[str(file)]))
            await asyncio.sleep(0)
            assert w.process is not None and w.process.pid == loaded
            w._progress(LOADING, None, "compiling ...")
            assert [j.text for j in w.jobs.values()] == [w.loading] == ["compiling ..."]
            w._progress(LOADING, None, "")
            assert [j.text for j in w.jobs.values()] == ["opening the file"] and not w.loading
            assert await asked == ["t", "n_dem"]
            w.stop()
            assert not Path(f"/proc/{loaded}").exists()
            spare.refill()
            other = spare._ready[0]
        finally:
            w.stop()
            spare.close()
        assert other.poll() is not None

    file = tmp_path / "a.csv"
    file.write_text("t,n_dem\n0,60\n0.1,61\n0.2,62\n")
    with ThreadPoolExecutor(1) as thread:  # where no browser's loop runs
        thread.submit(asyncio.run, go()).result()


def test_the_form_says_the_options_of_a_command(tmp_path: Path) -> None:
    from vaneloop.web.session import Choice, LogFile

    log, bench = (LogFile(tmp_path / n, n, n) for n in ("a.csv", "bench.toml"))
    c = Choice(
        file=log, bench=bench, mapping={"n_dem": "N1"}, units={"n_dem": "rpm"}, design_rpm=" 38000 ", guess=False
    )
    assert c.words(real=False) == [
        "a.csv", "--map", "N1=n_dem", "--unit", "n_dem=rpm", "--design-rpm", "38000", "--mapping", "bench.toml",
        "--no-guess",
    ]  # fmt: skip


def test_further_logs_and_parts_are_the_options_of_a_command(tmp_path: Path) -> None:
    from vaneloop.web.session import Choice, LogFile

    log, other, third, model = (LogFile(tmp_path / n, n, n) for n in ("a.csv", "b.csv", "c.csv", "m.py"))
    c = Choice(file=log, system=model, also=[other], test=[third], fit_part=":200 300:400", test_part="200:")
    said = ["--also", "b.csv", "--fit", ":200", "300:400", "--test", "200:", "c.csv"]
    assert c.words(real=False) == ["a.csv", "--system", "m.py", *said]
    assert c.reading(real=False) == ["a.csv", "--system", "m.py"]  # map knows of one log
    assert Choice(file=log, test_part="9:").words(real=True) == [str(log.path), "--test", "9:"]


def amplifier(folder: Path) -> list[str]:
    """An amplifier that rectifies, the model that knows only its gain, and how a log that has another name for its
    input is held against that; as the words of a command.
    """
    t = np.arange(0.0, 10.0, 0.02)
    u = np.sin(0.4 * t) + 0.7 * np.sin(1.7 * t + 1.0)
    y = np.abs(2.0 * u) + 0.01 * np.random.default_rng(1).standard_normal(len(t))
    np.savetxt(folder / "amplifier.csv", np.column_stack([t, u, y]), delimiter=",", header="t,Drive,y", comments="")
    (folder / "amplifier.py").write_text(
        "from vaneloop import System, unknown\n"
        "system = System('amplifier', 'static', lambda u, p: p.gain * u.u, inputs={'u': 'V'}, outputs={'y': 'V'},\n"
        "                parameters=[unknown('gain', 1.0, '-')], places=['output'])\n"
    )
    return [str(folder / "amplifier.csv"), "--map", "Drive=u", "--system", str(folder / "amplifier.py")]


def test_a_model_of_one_s_own_gets_the_answers_of_the_commands(tmp_path: Path) -> None:
    """What the page shows is what the verbs say, and what went to the page and back serves as well."""
    import pickle

    import vaneloop
    from vaneloop.verbs.search import read_record
    from vaneloop.web import worker

    words, told = amplifier(tmp_path), lambda *_: None
    seen = worker.look(told, words)
    assert seen["ours"] == {"u": "V", "y": "V"} and seen["signals"]["u"][0] == "Drive"
    assert {k: unit for k, (unit, _, _) in worker.preview(told, words)["channels"].items()} == seen["ours"]
    compared, diagnosed = (pickle.loads(pickle.dumps(f(told, words))) for f in (worker.compare, worker.diagnose))
    system = vaneloop.load_system(words[-1])
    record, _ = read_record(words[0], system, mapping={"Drive": "u"})
    assert compared["verdict"] == vaneloop.compare(record, system).sentence()
    answer = vaneloop.diagnose(record, system)
    assert answer.effects == ["y.absolute_value"] and diagnosed["verdict"] == answer.sentence()
    assert {**diagnosed["json"], "elapsed_s": 0} == {**answer.to_dict(), "elapsed_s": 0}
    fitted = worker.refit(told, words, "amplifier", ("y.absolute_value",))
    better = vaneloop.extend(record, ["y.absolute_value"], system)
    assert fitted["result"].error_after.tolist() == [better.rows()[0]["error_after"]]
    share = fitted["bounds"]["y.absolute_value"]["share"]
    assert (share.value, share.low, share.high) == (0.0, 0.0, 1.0)
    given = {"stage": "amplifier", "theta": fitted["theta"], "floor": fitted["floor"]}
    worse = worker.hand(told, words, **given, values={"y.absolute_value": {"share": 0.5}})
    assert worse["rms"]["y"] > 10.0 * better.rows()[0]["error_after"]
    page = Path(worker.report(told, words, diagnosed["diagnosis"], str(tmp_path / "page.html"), "vaneloop diagnose"))
    assert answer.sentence() in page.read_text(encoding="utf-8")


def test_each_log_s_error_is_the_one_of_the_commands(tmp_path: Path) -> None:
    import vaneloop
    from vaneloop.pages.by_log import errors_by_log
    from vaneloop.web import worker

    words, told = amplifier(tmp_path), lambda *_: None
    twin = tmp_path / "twin.csv"
    twin.write_text((tmp_path / "amplifier.csv").read_text())
    more = [*words, "--fit", ":7", "--test", "7:", str(twin)]
    assert worker.compare(told, words)["apart"] is None
    title, columns, rows = worker.compare(told, more)["apart"]
    assert [r[:3] for r in rows][:3] == [
        ["amplifier.csv :7", "fitted", "y"], ["amplifier.csv 7:", "test", "y"], ["twin", "test", "y"],
    ] and "log by log" in title  # fmt: skip
    system = vaneloop.load_system(words[-1])
    record, other = (vaneloop.verbs.search.read_record(f, system, mapping={"Drive": "u"})[0] for f in (words[0], twin))
    answer = vaneloop.compare(record, system, fit=(None, 7), test=[(7, None), other])
    assert answer.by_log is not None and errors_by_log(answer.by_log) == (columns, rows)
    _, *found = worker.diagnose(told, more)["apart"]
    told_by_verb = vaneloop.diagnose(record, system, fit=(None, 7), test=[(7, None), other]).by_log
    assert told_by_verb is not None and (found[0], found[1]) == errors_by_log(told_by_verb)


def test_no_code_of_a_model_runs_before_the_user_has_allowed_what_it_says_now(tmp_path: Path) -> None:
    from vaneloop.web.chosen_log import receive
    from vaneloop.web.jobs import WorkError
    from vaneloop.web.server import models_in
    from vaneloop.web.session import LogFile, Session

    ran = tmp_path / "ran"
    model = tmp_path / "mine.py"
    model.write_text(f"open({str(ran)!r}, 'w')\nfrom vaneloop import System\nsystem = System(name='a')\n")
    (tmp_path / "no_model.py").write_text(f"open({str(ran)!r}, 'w')\n")
    found = {m.name: m for m in models_in(tmp_path)}
    assert "no_model.py" not in found and found["example: tank.py"].shipped and not found["mine.py"].shipped
    s = Session("x", tmp_path / "0123456789abcdef", [], models=list(found.values()))
    s.hold_against(found["example: tank.py"])
    assert s.asked is None and s.choice.system == found["example: tank.py"]
    s.choose(found["mine.py"])
    assert s.asked == found["mine.py"] and s.choice.system == found["example: tank.py"]
    s.refuse()
    assert s.asked is None and s.choice.system == found["example: tank.py"]
    s.choose(found["mine.py"])
    s.allow()
    assert s.asked is None and s.choice.system == found["mine.py"] and not ran.exists()
    s.choice.file = LogFile(tmp_path / "a.csv", "a.csv", "a.csv")  # as when it is read
    assert s.words() == [str(tmp_path / "a.csv"), "--system", str(model)]
    model.write_text(model.read_text() + "# more\n")
    with pytest.raises(WorkError, match=r"mine\.py: has changed since its code was allowed to run"):
        s.words()
    s.choice.file = None
    s.hold_against(None)
    assert s.asked is s.choice.system is None

    class Upload:
        """What the page gets of a file that is dropped."""

        class file:
            name = "other.py"

    s.takes_code = False  # elsewhere than on loopback a token is no right to run code here
    with ThreadPoolExecutor(1) as apart:  # a browser's loop may run in this thread
        told = apart.submit(asyncio.run, receive(s, Upload, "log", own=True)).result()  # type: ignore[arg-type]
    assert told is None
    assert "is code, which is taken from this machine only" in s.errors["log"] and not ran.exists()


@pytest.mark.slow
@needs_browser
def test_a_model_of_one_s_own_from_its_file_to_the_error_at_the_noise(
    server: Server, page: Any, tmp_path: Path
) -> None:
    """The way of the vane chain: model and log, names, where, what, a switch, the model extended, compared again."""
    page.goto(server.url)
    tab_to(page, ".choose-model input")
    page.keyboard.press("Enter")
    page.get_by_role("option", name="example: tank.py").wait_for()
    chosen = "[...document.querySelectorAll('[role=option]')].findIndex((o) => o.innerText.includes('tank.py'))"
    for _ in range(page.evaluate(chosen)):
        page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    choose(page, "example: tank.csv")
    page.get_by_text("fails most in the tank subsystem").wait_for()
    tab_to(page, "[aria-label^='failure map']")
    for key in ("ArrowDown", "ArrowRight", "Enter"):
        page.keyboard.press(key)
    page.wait_for_function(SHOWS_4_S.replace("- 4)", "- 40)"))  # twenty samples to each side
    tab_to(page, ".find-missing")
    page.keyboard.press("Enter")
    page.get_by_text("The tank subsystem lacks level.square_root").first.wait_for()
    wait_ratio(page, "< 1.1")
    tab_to(page, "[aria-label='level.square_root']")
    page.keyboard.press(" ")
    wait_ratio(page, "> 50")
    page.keyboard.press(" ")
    wait_ratio(page, "< 1.1")
    page.get_by_role("button", name="Recommend an experiment").click()
    page.get_by_text("No rivals are left. For the parameters").wait_for()
    looks(page, "own_model")
    page.get_by_role("button", name="Extended model").click()
    page.get_by_role("button", name="Go on with this model").click()
    page.locator(".verdict.good", has_text="fits").wait_for()
    said = page.locator(".cmd code", has_text=" compare ").inner_text()
    assert re.search("--system .*tank.py --model extended.toml", said)

    # a file of the user's own: nothing of it runs before the click; its log calls the input otherwise
    ran = tmp_path / "ran"
    amplifier(tmp_path)
    model = tmp_path / "amplifier.py"
    model.write_text(f"open({str(ran)!r}, 'w')\n" + model.read_text())
    upload = page.locator("input[type=file]").first
    upload.set_input_files(model)
    page.get_by_text("amplifier.py is code").wait_for()
    assert not violations(page, AXE) and not ran.exists()
    tab_to(page, ".leave-code")
    page.keyboard.press("Enter")
    page.get_by_text("amplifier.py is code").wait_for(state="detached")
    upload.set_input_files(model)
    tab_to(page, ".run-code")
    page.keyboard.press("Enter")
    page.get_by_role("alert").filter(has_text="tank.csv: ").wait_for()  # the log of the other model has no u
    upload.set_input_files(tmp_path / "amplifier.csv")
    page.get_by_role("alert").filter(has_text="amplifier.csv: ").wait_for()  # one line: it has no u
    assert ran.exists() and "Traceback" not in page.locator("body").inner_text()
    page.get_by_label("name of u in the log").fill("Drive")
    page.keyboard.press("Enter")
    page.get_by_text("fails most in the amplifier subsystem").wait_for()
    page.get_by_role("button", name="Find the missing physics").click()
    page.get_by_text("The amplifier subsystem lacks y.absolute_value").first.wait_for()


@pytest.mark.slow
@needs_browser
def test_a_law_of_a_model_of_one_s_own_is_learned_and_another_log_confirms_it(
    server: Server, page: Any, tmp_path: Path
) -> None:
    """The tank of tests/test_learn.py: its outflow grows with the warmth of the oil."""
    from tests.test_learn import logs_of_a_tank

    logs_of_a_tank(tmp_path)
    page.goto(server.url)
    upload = page.locator("input[type=file]").first
    upload.set_input_files(tmp_path / "tank.py")
    page.locator(".run-code").click()
    upload.set_input_files(tmp_path / "warm.csv")
    page.get_by_text("fails most in the tank subsystem").wait_for()
    upload.set_input_files(tmp_path / "cold.csv")
    page.locator(".cmd code", has_text="vaneloop compare cold.csv").wait_for()
    page.get_by_role("button", name='Expand "Fit and test"').click()
    pick(page, ".log-test", "warm.csv")
    apart = page.locator(".vtable", has_text="fitted or test")
    apart.locator("tr", has_text="warm").wait_for()
    page.get_by_label("seconds that are fitted").fill("1:0")
    page.keyboard.press("Enter")
    page.get_by_role("alert").filter(has_text="--fit '1:0': the end (=0 s) must be above").wait_for()
    page.get_by_label("seconds that are fitted").fill("")
    page.keyboard.press("Enter")
    assert "--test warm.csv" in page.locator(".cmd code", has_text=" compare ").inner_text()
    page.get_by_role("button", name="Find the missing physics").click()
    page.get_by_role("button", name="Learn the law").click()
    page.get_by_text("Outflow is multiplied by 1 + a function of oil").first.wait_for()
    before, after = (float(x) for x in re.findall(r"[\d.]+", page.locator(".law-error").inner_text()))
    assert after < 2.0 < before
    looks(page, "own_learned")
    page.locator(".add-law").click()
    page.get_by_role("button", name="Go on with this model").click()
    page.locator(".verdict.good", has_text="fits").wait_for()
    said = page.locator(".cmd code", has_text=" compare ").inner_text()
    assert re.search(r"cold.csv --system tank.py --model extended.toml --test warm.csv$", said)


IN_ONE_TEST = ("locate", "replay", "extend", "diagnose", "experiment")  # the others where they are made anyway


@pytest.mark.slow
@needs_browser
def test_every_report_is_open_to_phone_and_screen_reader(browser: Any, tmp_path: Path) -> None:
    import vaneloop
    from vaneloop.identification.vane_chain.experiment import HEADS
    from vaneloop.pages.diagnosis import diagnosis_page, experiment_page

    log = ROOT / "examples" / "hidden_effect.parquet"
    extended = vaneloop.extend(log, ["valve_dead_band", "aero_load"])
    parts = extended.diagnosis, extended.bound, "vaneloop", str(log)
    t = np.arange(100.0)
    row = {"profile": "ramp", "nats": 30.0, "spreads": 4.0, "repeats": 1}
    experiment = {
        "text": "Ramp it.",
        "t": t,
        "inputs": {"n_dem": ("%", t)},
        "separates": True,
        "table": [row],
        "heads": HEADS,
    }
    reports = {
        "locate": vaneloop.locate(log).page(),
        "replay": vaneloop.replay(vaneloop.read_log(log)).page(),
        "extend": extended.page(),
        "diagnose": diagnosis_page(*parts),
        "experiment": experiment_page(*parts, "Ramp it.", experiment),
    }
    assert tuple(reports) == IN_ONE_TEST
    for name, made in reports.items():
        file = made.write(tmp_path / f"{name}.html")
        look_at(browser, file, name, every=name == "replay")
        if name == "extend":  # the way from a cell to its moment, by keyboard
            page = browser.new_page()
            page.set_default_timeout(LONG)
            page.goto(file.as_uri())
            page.wait_for_function("document.querySelectorAll('.show').length > 0", timeout=LONG)
            tab_to(page, ".show")
            page.keyboard.press("Enter")
            page.wait_for_function(
                "[...document.querySelectorAll('.plot')].some((p) => p.layout.xaxis.range && "
                "Math.abs(p.layout.xaxis.range[1] - p.layout.xaxis.range[0] - 4) < 1e-6)"
            )
            page.close()


def test_every_command_with_a_report_has_it_held_against_axe_core() -> None:
    import importlib

    from vaneloop.base import terminal
    from vaneloop.cli.main import COMMANDS

    written = set()
    for name, (module, *_) in COMMANDS.items():
        parser = terminal.Parser(prog=name)
        importlib.import_module(module).add_options(parser)
        if "--report" in parser.format_help() or name == "fleet":  # fleet has it in a part
            written.add(name)
    texts = [f.read_text(encoding="utf-8") for f in (ROOT / "tests").glob("test_*.py")]
    held = set(re.findall(r'open_to_all\(.*, "([\w-]+)"\)', "\n".join(texts)))
    assert written - held - set(IN_ONE_TEST) == set() and len(written) >= 14


@pytest.mark.slow
@needs_browser
def test_curves_of_several_logs_with_their_events_layouts_and_exports(server: Server, page: Any) -> None:
    page.goto(server.url)
    choose(page, "faulted.csv")
    page.get_by_text("All channels").click()
    curves = page.locator(".curves").first
    page.wait_for_function("document.querySelector('.curves').dataset.points > 0")
    assert curves.locator(".uplot").count() == 3 and not curves.locator(".curves-name").count()  # titles name them
    # a log laid over stays when the log is read again
    page.locator(".other").click()
    page.get_by_role("option", name="renamed.csv").click()
    legend = page.locator(".curves-legend", has_text="renamed.csv")
    legend.wait_for()
    page.get_by_role("alert").first.wait_for()  # this log has too little to compare, so that the form stands open
    page.evaluate("document.querySelectorAll('.moment').forEach((m) => { m.dataset.before = '1'; })")
    page.get_by_role("button", name="Read again").click()
    page.wait_for_function("document.querySelector('.moment') && !document.querySelector('.moment[data-before]')")
    page.get_by_role("alert").first.wait_for()
    legend.wait_for()

    # a press on an event shows it; short bands' names do not lie over each other
    tab_to(page, ".moment")
    page.locator(".moment", has_text="mode DEGRADED").click()
    page.wait_for_function("document.querySelector('.curves').dataset.view === '8.0000 12.0000'")
    page.wait_for_function("document.querySelector('.curves').dataset.labels.includes('FAIL_SAFE')")
    _, below = json.loads(curves.get_attribute("data-labels"))
    assert {text for *_, text in below} == {"DEGRADED", "FAIL_SAFE", "demand_stale"}
    for k, (a, b, row, _) in enumerate(below):
        assert all(r != row or d < a or c > b for c, d, r, _ in below[k + 1 :]), below

    # channels are chosen from the tree; what is seen is kept under a name, over a reload
    page.locator(".curves-tree summary").click()
    page.locator(".curves-tree").get_by_label("speed").uncheck()
    page.get_by_text("Channels: 2 of 3 shown").wait_for()
    page.get_by_label("name of a layout").fill("fault")
    page.keyboard.press("Enter")
    page.get_by_label("show a layout that was kept").wait_for()
    page.reload()
    page.get_by_text("All channels").click()
    page.get_by_text("Channels: 3 of 3 shown").wait_for()
    page.get_by_label("show a layout that was kept").select_option("fault")
    page.get_by_text("Channels: 2 of 3 shown").wait_for()
    page.wait_for_function("document.querySelector('.curves').dataset.view === '8.0000 12.0000'")

    # a layout is shown again after the view has changed; by keyboard the cursors of all curves move
    tab_to(page, ".curves-stack")
    for key in ("Home", "ArrowRight", "Enter", "ArrowRight"):
        page.keyboard.press(key)
    said = page.locator(".curves [role=status]").first.inner_text()
    assert len(readings := said.split("; ")) == 2 and all("to the reference" in r for r in readings), said
    page.get_by_label("show a layout that was kept").select_option("fault")
    page.wait_for_function("document.querySelector('.curves').dataset.view === '8.0000 12.0000'")

    # what is exported is what is seen: dashes, bands, names
    page.locator(".curves-name", has_text="renamed.csv").first.click()
    with page.expect_download() as download:
        page.get_by_label("save these curves as CSV").first.click()
    rows = [line.split(",") for line in Path(download.value.path()).read_text().splitlines()]
    assert rows[0] == ["channel", "line", "t", "value"] and not any("renamed.csv" in name for _, name, *_ in rows)
    stroke = {float(t): float(v) for channel, _, t, v in rows[1:] if channel == "x_lvdt [mm]"}
    assert stroke and all(8.0 <= t <= 12.0 and abs(v - 20.0 - np.sin(t)) < 1e-3 for t, v in stroke.items())
    page.locator(".curves-name", has_text="renamed.csv").first.click()
    with page.expect_download() as download:
        page.get_by_label("save these curves as SVG").first.click()
    drawn = Path(download.value.path()).read_text()
    assert drawn.count("stroke-dasharray") >= 3  # the other log's name and curve, the reference
    assert all(name in drawn for name in ("renamed.csv", "FAIL_SAFE", "demand_stale")) and "n_dem" not in drawn
    ticks = [float(x) for x in re.findall(r'text-anchor="middle">([\d.]+)<', drawn)]
    assert len(ticks) > 3 and len(set(np.diff(ticks).round(6))) == 1 and 8.0 <= ticks[0] < ticks[-1] <= 12.0
    heights = re.findall(r'y="[\d.]+" text-anchor="end">(-?[\d.,]+)<', drawn)
    assert len(heights) >= 2 * page.evaluate("document.querySelectorAll('.curves .uplot').length")
    looks(page, "curves")


FOCUSED = ".q-manual-focusable--focused"


def pick(page: Any, field: str, name: str) -> None:
    """Choose an option of a field by keyboard."""
    tab_to(page, f"{field} input")
    page.keyboard.press("Enter")
    page.get_by_role("option", name=name, exact=True).last.wait_for()
    options = page.locator(".q-menu").last.get_by_role("option").all_inner_texts()
    page.keyboard.press("Home")
    for _ in range(len(options)):
        if (here := page.locator(FOCUSED).last.inner_text()) == name:
            break
        page.keyboard.press("ArrowDown")
        page.wait_for_function(f"was => [...document.querySelectorAll('{FOCUSED}')].at(-1).innerText !== was", arg=here)
    page.keyboard.press("Enter")
    page.locator(".q-menu").wait_for(state="detached")


@pytest.mark.slow
@needs_browser
def test_channels_of_channels_one_over_the_other_and_what_is_between_the_cursors(server: Server, page: Any) -> None:
    """By keyboard alone; the file has the samples of the log, not the points drawn."""
    page.goto(server.url)
    choose(page, "renamed.csv")
    page.get_by_role("button", name="Use 38000 rpm").click()
    # a formula given before the log is read is kept as it is, and its line says later what is wrong with it
    page.locator(".cmd code", has_text=re.compile(r" compare .*--design-rpm 38000")).first.wait_for()
    page.get_by_text("All channels").click()
    page.wait_for_function("document.querySelector('.curves').dataset.points > 0")
    field = ".formula input"
    tab_to(page, field)
    page.keyboard.type("lag = x_dem - x_lvt [um]")
    page.keyboard.press("Enter")
    page.get_by_role("alert").filter(has_text="position 15: no channel 'x_lvt' (did you mean x_lvdt?)").wait_for()
    for text in ("lag = x_dem - x_lvdt [um]", "v = rate(x_lvdt)"):
        page.keyboard.press("Control+A")
        page.keyboard.type(text)
        page.keyboard.press("Enter")
        page.wait_for_function("document.querySelector('.formula input').value === ''")
    page.get_by_text("lag [um] = x_dem - x_lvdt, 3,000 samples").wait_for()
    page.get_by_text("v [mm/s] = rate(x_lvdt), 3,000 samples").wait_for()
    assert not page.get_by_role("alert").filter(has_text="formula").count()
    page.get_by_text("Channels: 7 of 7 shown").wait_for()

    for k, text in ((1, "10"), (2, "99"), (2, "20")):
        page.get_by_label(f"cursor {k} [s]").fill(text)
        page.keyboard.press("Enter")
        if text == "99":
            page.get_by_text("cursor 2 (=99) must be a time of the log, 0 to 29.99 s").wait_for()
    page.get_by_text("10 s apart").wait_for()
    for which, name in (("x", "x_dem"), ("y", "lag"), ("colour", "v")):
        pick(page, f".xy-{which}", name)
    page.get_by_text("lag [um] over x_dem [mm], from 10 to 20 s: 1,000 samples. Coloured by v [mm/s]").wait_for()
    page.locator(".xy .colorbar, .xy .cbaxis").first.wait_for()
    points = page.evaluate("document.querySelector('.xy .js-plotly-plot').data[1].customdata")
    assert min(points) == 10.0 and max(points) == 19.99
    looks(page, "formulas")

    tab_to(page, "[aria-label='save the channels as CSV']")
    page.keyboard.press("Enter")
    with page.expect_download() as download:
        page.get_by_text("download between.csv").click()
    head, *rows = Path(download.value.path()).read_text().splitlines()
    names = head.split(",")
    assert names[-2:] == ["lag [um]", "v [mm/s]"] and len(rows) == 1000
    values = np.array([[float(v) for v in row.split(",")] for row in rows])
    of = dict(zip(names, values.T, strict=True))
    assert np.allclose(of["lag [um]"], 1e3 * (of["x_dem"] - of["x_lvdt"]), atol=1e-6) and of["t"][0] == 10.0
    said = page.locator(".formulas .cmd code").inner_text()
    assert "--formula 'lag = x_dem - x_lvdt [um]'" in said and said.endswith("--between 10:20 --export between.csv")

    # a layout keeps both cursors; a formula stays with another log, and says why it makes nothing of that
    page.get_by_label("name of a layout").fill("two")
    page.keyboard.press("Enter")
    tab_to(page, ".curves-stack")
    for key in ("Home", "ArrowRight", "Shift+Enter", "Enter"):
        page.keyboard.press(key)
    page.wait_for_function(
        "!document.querySelector('.curves-apart') || document.querySelector('.curves-apart').innerText !== '10 s apart'"
    )
    page.get_by_label("show a layout that was kept").select_option("two")
    page.get_by_text("10 s apart").wait_for()
    choose(page, "faulted.csv")
    page.get_by_text("position 7: no channel 'x_dem'").wait_for()
    page.get_by_text("v [mm/s] = rate(x_lvdt), 3,000 samples").wait_for()
    cursor = page.get_by_label("cursor 1 [s]").element_handle()
    page.wait_for_function("field => field.value === ''", arg=cursor)
    page.get_by_role("button", name="take lag away").click()
    page.get_by_text("position 7: no channel 'x_dem'").wait_for(state="detached")


@given(st.integers(0, 2**32 - 1))
def test_a_channel_over_another_keeps_every_extreme_its_time_and_its_way(seed: int) -> None:
    from vaneloop.web.xy import ARROWS, MOST, plane, xy_figure

    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 30_000))
    t = np.cumsum(rng.uniform(0.005, 0.015, n))
    angle = rng.uniform(1.0, 5.0) * t / t[-1]
    a, b = (vaneloop.Channel(t, 5.0 * f(angle) + 0.01 * rng.standard_normal(n), unit="mm") for f in (np.cos, np.sin))
    span = (float(t[n // 4]), float(t[-1]))
    p = plane(a, b, None, span)
    inside = (t >= span[0]) & (t < span[1])
    assert p.n == np.count_nonzero(inside) and len(p.t) <= MOST + 4
    for drawn, c in ((p.x, a), (p.y, b)):
        if inside.any():
            assert (np.nanmin(drawn), np.nanmax(drawn)) == (c.values[inside].min(), c.values[inside].max())
    assert np.isin(p.t, t).all() and np.array_equal(p.colour, p.t) and np.isin(p.x, a.values).all()
    arrows = next(d for d in xy_figure(p, ["x", "y", "t"])["data"] if d.get("name") == "direction")
    x, y = np.array(arrows["x"]).reshape(-1, 2), np.array(arrows["y"]).reshape(-1, 2)
    assert len(x) <= ARROWS
    if np.ptp(angle[inside] if inside.any() else angle[:1]) > 0.5:  # each arrow goes round as the run does
        assert len(x) and (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0] > 0.0).all()


def test_a_hole_is_not_drawn_over_and_a_third_channel_colours() -> None:
    from vaneloop.web.xy import plane

    t = np.concatenate([np.arange(0, 500), np.arange(900, 1400)]) / 100.0
    x, y = vaneloop.Channel(t, t, unit="s"), vaneloop.Channel(t, -t)
    fine = vaneloop.Channel(np.arange(0, 14000) / 1000.0, np.arange(0, 14000) / 1000.0)
    p = plane(x, y, fine)
    assert p.n == 9982 and np.allclose(p.colour[np.isfinite(p.x)], p.x[np.isfinite(p.x)])
    lines = plane(x, y, None)
    assert np.isnan(lines.x).sum() == 1 and lines.t[np.isnan(lines.x)] == 4.99


@needs_browser
@given(st.lists(st.tuples(st.floats(0, 1000), st.sampled_from(["RUN", "DEGRADED", "a fault with a long name"]))))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(30), deadline=None)
def test_names_in_a_chart_never_lie_over_each_other(page: Any, words: list[tuple[float, str]]) -> None:
    source = (ROOT / "vaneloop" / "web" / "chart.js").read_text(encoding="utf-8")
    script = re.sub(r"^import .*$", "", source, flags=re.M).replace("export default", "return")
    placed = page.evaluate(
        f"(list) => {{ const chart = (() => {{ {script} }})(); "
        "return chart.methods.placed(list, 0, 1000, (t) => 6 * t.length, 4).map((m) => [m.from, m.to, m.row]); }",
        [{"x": x, "text": text} for x, text in words],
    )
    assert len(placed) >= min(1, len(words))
    for k, (a, b, row) in enumerate(placed):
        assert 0 <= a < b <= 1000 and all(r != row or d < a or c > b for c, d, r in placed[k + 1 :])


# ---- page 2: schedule ------------------------------------------------------------------------------------------------


def step(page: Any, name: str) -> None:
    page.get_by_role("button", name=name).click()
    page.get_by_role("heading", name=re.compile(f"Step .: {name}")).wait_for()


@pytest.mark.slow
@needs_browser
def test_schedule_from_lengths_to_tables_for_the_controller(server: Server, page: Any, tmp_path: Path) -> None:
    page.goto(server.at("schedule"))
    page.locator(".loop-log").click()
    option = page.get_by_role("option", name="hidden_effect.parquet")
    assert option.bounding_box()["width"] <= 560  # a list is as wide as what it holds
    option.click()

    # a point of the curve is dragged
    page.get_by_text("As numbers").click()
    number = page.get_by_label("at 78 %")
    before = float(number.input_value())
    point = page.locator(".editor-point").nth(9)
    point.scroll_into_view_if_needed()
    box = point.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y - 3, steps=3)
    page.mouse.up()
    page.get_by_text("--schedules schedules.toml").wait_for()
    assert before < float(number.input_value()) < before + 5.0

    step(page, "Mechanism")
    stroke = page.get_by_label("stroke", exact=True)
    drawn = page.locator(".mech-link").first.get_attribute("d")
    stroke.fill("10")
    page.wait_for_function(f"document.querySelector('.mech-link').getAttribute('d') !== {drawn!r}")
    step(page, "Stroke for the VIGV")
    page.reload()  # a reload in the middle keeps what was done
    page.get_by_role("heading", name="Step 2: Stroke for the VIGV").wait_for()
    step(page, "Links of the other vane rows")
    step(page, "Measured loop")
    step(page, "Tables")
    with page.expect_download() as download:
        page.get_by_text("download stroke_tables.toml").click()
    tables = tomllib.loads(Path(download.value.path()).read_text())
    values = tables["extension"]["values"]
    assert all(0.0 < v < 48.0 for v in values) and values == sorted(values)
    looks(page, "schedule")


# ---- page 3: run -----------------------------------------------------------------------------------------------------


# What lamps have shown in this browser, however short: a busy machine may draw a lamp's end with its beginning.
WATCH_LAMPS = """window.lamps = new Set(); new MutationObserver((changes) => { for (const c of changes)
  if (c.target.dataset.lamp) window.lamps.add(c.target.dataset.lamp + ' ' + c.target.className.split(' ')[1]); })
  .observe(document, { subtree: true, attributes: true, attributeFilter: ['class'] });"""


def press(page: Any, button: str, until: str) -> None:
    """Press ``button`` until ``until`` (JavaScript) is so: a page that could not answer for long is loaded anew, and
    loses a click.
    """
    from playwright.sync_api import TimeoutError as Late

    end = time.monotonic() + 2 * LONG / 1000.0
    while True:
        with contextlib.suppress(Late):
            page.get_by_role("button", name=button, exact=True).click(timeout=LONG / 4)
        with contextlib.suppress(Late):
            page.wait_for_function(until, timeout=LONG / 4)
            return
        assert time.monotonic() < end, f"{button}: never {until}"


def downloaded(page: Any, name: re.Pattern[str]) -> Path:
    with page.expect_download() as download:
        page.get_by_role("link", name=name).click()
    return Path(download.value.path()).rename(Path(download.value.path()).with_suffix(".log"))


def states_in(record: Path) -> tuple[set[str], set[int]]:
    """Modes that the controller said in a record, and the identifiers in it."""
    from controller import MODES
    from hil.bus.frames import IDENT_MASK
    from hil.logs import read_log
    from hil.logs.recordings import read_record

    state = read_log(record, require=("state",)).channels["state"].values
    return {MODES[int(v)] for v in state}, set((read_record(record).rows[:, 0] & IDENT_MASK).tolist())


RECORD_IS_THERE = "!!document.querySelector('.open-record')"


@pytest.mark.slow
@needs_browser
def test_a_fleet_s_run_is_followed_and_leads_to_its_logs(server: Server, page: Any, tmp_path: Path) -> None:
    """The page says what `fleet report` says, of what is done and then of all; a click leads to a log's own page."""
    from tests.test_fleet_report import synthetic
    from vaneloop.fleet.folder import Folder
    from vaneloop.fleet.report import view_of
    from vaneloop.fleet.tables import roll_up

    folder = synthetic(server.folder / "engines", 6, 30)
    *_, last = sorted((folder.path / "parts").iterdir())
    last.rename(tmp_path / last.name)  # the last chunk is not done
    so_far = view_of(roll_up(folder), {})
    Folder.begin(server.folder / "trials", "trial", {"plan": {}}, {})
    page.goto(server.at("fleet"))
    page.locator(".run-folder").click()
    page.get_by_role("option", name="engines/run").click()
    page.get_by_text("128 of 180 logs done").wait_for()
    page.get_by_text(so_far.sentence()).wait_for()
    page.get_by_text("vaneloop fleet work engines/run").wait_for()
    (tmp_path / last.name).rename(last)
    page.get_by_text("180 of 180 logs done").wait_for()  # by itself
    view = view_of(roll_up(folder), {})
    page.get_by_text(view.sentence()).wait_for()
    for title in ("Engines and effects", "What changes", "Unlike their fleet peers", "What the logs could not show"):
        page.get_by_role("heading", name=title).wait_for()
    page.wait_for_function(f"document.querySelectorAll('.main-svg').length >= {len(view.changed) + 1}")
    looks(page, "fleet")
    page.set_viewport_size({"width": 1280, "height": 800})
    page.locator('a[href^="fleet_logs/"]').first.click()
    key = view.lacking[0]["key"]
    page.get_by_role("heading", name=f"Log {key[:8]}").wait_for()
    assert page.url.endswith(f"/fleet_logs/{key}.html") and not violations(page)
    assert page.goto(page.url.replace(key[:8], "deadbeef")).status == 404
    page.complaints.clear()  # of the 404
    page.goto(server.at("fleet"))
    page.locator(".run-folder").click()
    page.get_by_role("option", name="trials").click()
    page.get_by_text("This is a campaign's run").wait_for()


@pytest.mark.slow
@needs_browser
def test_run_the_loop_inject_a_fault_and_open_the_record(server: Server, page: Any) -> None:
    page.add_init_script(WATCH_LAMPS)
    page.goto(server.at("run"))
    page.locator(".pace").click()
    page.get_by_role("option", name="10 x", exact=True).click()
    press(page, "Start", "window.lamps.has('RUN good')")
    slider = page.get_by_role("slider", name="speed demand")
    box = slider.bounding_box()
    slider.click(position={"x": 0.8 * box["width"], "y": box["height"] / 2})
    page.wait_for_function(
        "parseFloat(document.querySelectorAll('.tiles .v')[1].innerText) > 80"
    )  # rotor speed follows
    page.get_by_label("find a scenario").fill("demand_stops")
    press(page, "demand_stops", "window.lamps.has('FAIL_SAFE bad') && window.lamps.has('demand_stale bad')")
    page.get_by_label("filter of the trace").fill("VGV_HEALTH")
    page.wait_for_function(
        "(() => { const l = document.querySelector('.trace').innerText.trim().split('\\n');"
        " return l.length > 3 && l.every((x) => x.includes('VGV_HEALTH')); })()"
    )
    page.locator(".moment", has_text="injected: demand_stops").wait_for()
    page.locator(".moment", has_text="mode FAIL_SAFE").first.click()  # its moment is held
    page.locator(".held", has_text="held at").wait_for()
    page.get_by_role("button", name="Go on").click()
    page.locator(".held", has_text="held at").wait_for(state="detached")
    page.reload()  # the loop goes on
    page.locator('[data-lamp="RUN"].good').wait_for()
    page.wait_for_function("parseFloat(document.querySelectorAll('.tiles .v')[0].innerText) > 15")
    looks(page, "run")
    press(page, "Stop", RECORD_IS_THERE)
    page.locator(".open-record").click()
    page.locator(".verdict").first.wait_for()
    assert "noise" in page.locator(".verdict").first.inner_text()


@pytest.mark.slow
@needs_browser
def test_the_loop_is_calibrated_while_it_runs(server: Server, page: Any) -> None:
    """All by keyboard: gains to nothing, and the stroke stays; the reference page, and it follows."""
    page.goto(server.at("run"))
    press(page, "Start", "!!document.querySelector('[data-name=kp] input')")
    page.locator('[data-lamp="RUN"].good').wait_for()
    stroke = "parseFloat(document.querySelectorAll('.tiles .v')[2].innerText)"
    page.wait_for_function(f"Math.abs({stroke} - 6.9) < 0.2")
    events = page.get_by_role("log", name="what happened")
    for name in ("kp", "ki", "kff"):
        tab_to(page, f'[data-name="{name}"] input')
        page.keyboard.press("Control+a")
        page.keyboard.type("0")
        page.keyboard.press("Enter")
        events.get_by_text(f"calibration: {name} 0").wait_for()
    kp = page.locator('[data-name="kp"]')
    kp.locator(".reference.other", has_text="reference 16").wait_for()
    slider = page.get_by_role("slider", name="speed demand")
    slider.click(position={"x": 0.8 * slider.bounding_box()["width"], "y": 8})
    page.wait_for_function("parseFloat(document.querySelectorAll('.tiles .v')[1].innerText) > 79")
    assert page.evaluate(stroke) < 8.0, "nobody moves the piston"

    # refused in a line, and the field shows what is
    kp.locator("input").fill("2000")
    kp.locator("input").press("Enter")
    alert = page.get_by_role("alert")
    alert.wait_for()
    assert alert.inner_text() == "vaneloop: kp (=2000 mA/mm), in [0, 1000] mA/mm: out of range (XCP error 0x22)"
    page.wait_for_function("document.querySelector('[data-name=kp] input').value === '0'")

    page.get_by_role("button", name="Save the working page").click()
    with page.expect_download() as download:
        page.get_by_text("download calibration.toml").click()
    assert tomllib.loads(Path(download.value.path()).read_text())["servo"]["kp"]["value"] == 0.0
    page.get_by_role("button", name="reference", exact=True).click()
    page.wait_for_function(f"{stroke} > 12")  # the shipped gains are back
    looks(page, "calibrate")
    page.get_by_role("button", name="Copy reference over working").click()
    page.wait_for_function("document.querySelector('[data-name=kp] input').value === '16'")
    page.get_by_label("find a calibration value").fill("greatest current")
    page.wait_for_function(
        "[...document.querySelectorAll('.calibrated')].map((e) => e.dataset.name).join() === 'current_limit'"
    )
    press(page, "Stop", RECORD_IS_THERE)
    page.get_by_text("Start the loop: then its calibration is read.").wait_for()


@pytest.mark.slow
@needs_browser
def test_run_in_real_time_on_the_embedded_bus(server: Server, page: Any) -> None:
    from playwright.sync_api import TimeoutError as Late

    page.goto(server.at("run"))
    chosen = page.get_by_text("vaneloop run --bus local")
    for _ in range(48):  # a page that is loaded anew loses a choice; started then, it would run in lockstep
        if chosen.count():
            break
        with contextlib.suppress(Late):
            page.locator(".bus").click(timeout=LONG / 24)
            page.get_by_role("option", name="real time, embedded bus").click(timeout=LONG / 24)
            chosen.wait_for(timeout=LONG / 24)
    assert chosen.count(), "the bus was chosen, and the page does not say so"
    press(
        page, "Start", "parseFloat(document.querySelectorAll('.tiles .v')[0].innerText) > 3"
    )  # s that the listener has heard
    late = page.get_by_text(re.compile(r"p50 \d+ us"))
    late.wait_for()
    kp = page.locator('[data-name="kp"] input')  # read over XCP on the bus
    while not kp.count():  # a loop that is held up drops what came meanwhile
        again = page.locator(".read-calibration")
        if again.count() and page.get_by_role("alert").count():
            with contextlib.suppress(Late):  # it may be gone by now
                again.click(timeout=LONG / 24)
        page.wait_for_timeout(200)
    assert kp.input_value() == "16"
    press(page, "Stop", RECORD_IS_THERE)
    assert not page.get_by_role("alert").count(), page.get_by_role("alert").first.inner_text()
    shot(page, "run_real_time_1280_light")
    worst = re.search(r"max (\d+) us", late.inner_text())
    states, idents = states_in(downloaded(page, re.compile(r"download run\d+\.log")))
    assert {0x0A0, 0x0B0} <= idents  # the ECU's frames, and the controller's
    assert worst and ("RUN" in states or int(worst[1]) > ON_TIME_US), (states, worst)  # late ticks cost frames


def test_the_commands_of_a_run_name_the_bus_that_it_is_on(tmp_path: Path) -> None:
    import shlex

    from vaneloop.web.running import Loop
    from vaneloop.web.session import Session
    from vaneloop.web.worker import parsed

    loop = Loop(Session("x", tmp_path / "0123456789abcdef", []))
    asked: list[tuple[str, dict[str, Any]]] = []
    for loop.bus in ("lockstep", "local", "vcan0"):
        for loop.profile, loop.seed, loop.record in ((None, None, True), ("staircase", 7, False)):
            for without, words in loop.commands():
                if not words:  # by slider: no command does that
                    assert loop.bus == "lockstep" and loop.profile is None and without
                    continue
                args = parsed(words[0], words[1:])
                assert args.bus == loop.bus_name and shlex.split(shlex.join(words)) == words
                assert bool(without) == (loop.bus == "lockstep")
                if words[0] == "run":
                    assert (args.seed, args.record) == (loop.seed, "run1.log" if loop.record else None)
                else:
                    assert args.profile == loop.profile
    loop.bus = "local"

    class Asked:
        """Answers at once."""

        async def call(self, task: str, _: str, **given: Any) -> dict[str, Any]:
            asked.append((task, given))
            return {}

    loop._worker = lambda name: Asked()  # type: ignore
    with ThreadPoolExecutor(1) as pool:  # this thread may be Playwright's
        pool.submit(asyncio.run, loop._in_real_time()).result()
    assert [given["bus"] for _, given in asked] == [loop.bus_name] * 3


# ---- who may ask -----------------------------------------------------------------------------------------------------

NAVIGATION = {
    "Accept": "text/html,*/*;q=0.8",
    "Sec_Fetch_Site": "none",
    "Sec_Fetch_Mode": "navigate",
    "Sec_Fetch_Dest": "document",
}
UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Key": "A" * 22 + "==",
}
SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"


def answer_of(
    server: Server, path: str = "/", method: str = "GET", body: bytes = b"", **headers: str
) -> tuple[int, dict[str, str], str]:
    """One request with headers of our own; status, headers by small names and content of the answer."""
    from http.client import HTTPConnection

    connection = HTTPConnection("127.0.0.1", server.port, timeout=600)
    connection.request(method, path, body=body, headers={k.replace("_", "-"): v for k, v in headers.items()})
    answer = connection.getresponse()
    return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read().decode("utf-8", "replace")


def ask(server: Server, path: str = "/", method: str = "GET", body: bytes = b"", **headers: str) -> tuple[int, str]:
    """A request of one browser that knows the token; status and the first line of the answer."""
    status, sent, text = answer_of(
        server, path, method, body, **({"Cookie": server.known + server.session} | NAVIGATION | headers)
    )
    if sent.get("set-cookie", "").startswith("vaneloop_session_"):
        server.session = "; " + sent["set-cookie"].partition(";")[0]
    return status, text.partition("\n")[0]


def folders_of(place: Path) -> list[Path]:
    """Folders of sessions that servers with this TMPDIR have made."""
    return [f for f in place.glob("vaneloop-web-*/*") if f.is_dir()]


def test_another_site_cannot_reach_the_server(server: Server) -> None:
    assert ask(server)[0] == 200
    status, line = ask(server, Host="rebound.example")  # a name of another site that resolves to this machine
    assert status == 421 and "rebound.example" in line
    assert ask(server, Host="127.0.0.1.rebound.example")[0] == 421
    assert ask(server, Origin="http://rebound.example")[0] == 403
    assert ask(server, "/_nicegui_ws/socket.io/?EIO=4&transport=polling", Origin="null")[0] == 403
    assert ask(server, Host="127.1.2.3")[0] == 200 and ask(server, Host="[::1]:80")[0] == 200
    assert ask(server, SOCKET, Origin="http://rebound.example", **UPGRADE)[0] == 403


def test_a_page_of_another_port_of_this_machine_cannot_use_the_server(server: Server) -> None:
    """To a browser all ports of a host are one site: it sends the cookie along, however strict that is."""
    for site in ("same-site", "cross-site", "nonsense", "none, none"):
        for path in ("/", "/curves/log", "/_nicegui_ws/socket.io/?EIO=4&transport=polling"):
            assert ask(server, path, Sec_Fetch_Site=site)[0] == 403
        assert ask(server, SOCKET, Sec_Fetch_Site=site, **UPGRADE)[0] == 403
    other = f"http://127.0.0.1:{server.port + 1}"  # of a browser that does not send Sec-Fetch-Site
    for path, more in (("/", {}), (SOCKET, UPGRADE)):
        status, _, _ = answer_of(server, path, Cookie=server.known, Accept="text/html", Origin=other, **more)
        assert status == 403
    status, _, _ = answer_of(server, SOCKET, Cookie=server.known, Origin=f"http://127.0.0.1:{server.port}", **UPGRADE)
    assert status == 101


def test_the_token_is_asked_for_on_loopback_too(server: Server) -> None:
    wrong = server.known[:-1] + ("a" if server.known[-1] != "a" else "b")
    for cookie in ("", wrong, f"vaneloop_token={server.token}", f"x={server.known}", server.known + "x"):
        for path, more in (
            ("/", {}),
            ("/run", {}),
            ("/curves/log", {}),
            (SOCKET, UPGRADE),
            ("/?token=wrong", {}),
            ("/?token=", {}),
        ):
            status, _, text = answer_of(server, path, Cookie=cookie, **NAVIGATION, **more)
            assert status == 403 and server.token not in text
            assert more or "Open the link that `vaneloop web` printed" in text
    others = (
        '{"odd": [1, 2]}; =; ;;; "=x; ' + server.known + "; other=\x7f"
    )  # cookies of other programs on this machine come along
    assert ask(server, "/", Cookie=others + server.session)[0] == 200


def test_the_token_becomes_a_cookie_and_leaves_the_address(server: Server) -> None:
    for page in ("", "schedule", "run"):
        status, headers, text = answer_of(server, f"/{page}?token={server.token}", **NAVIGATION)
        assert (status, headers["location"], text) == (303, f"/{page}", "")
        kept = headers["set-cookie"].split("; ")
        assert kept[0] == server.known and set(kept[1:]) == {"HttpOnly", "SameSite=Strict", "Path=/"}
    for path in (
        "//evil.example/",
        "/\\evil.example",
        "/nowhere",
        "/%0d%0aX:%20y",
    ):  # nothing of the address but a page of ours
        status, headers, _ = answer_of(server, f"{path}?token={server.token}", **NAVIGATION)
        assert status == 400 or (status, headers["location"]) == (303, "/")
    # a link on another site: a redirect would still be that site's
    status, headers, text = answer_of(
        server, f"/run?token={server.token}", **{**NAVIGATION, "Sec_Fetch_Site": "cross-site"}
    )
    assert (
        status == 200
        and headers["set-cookie"].startswith(server.known)
        and server.token not in text
        and "url=/run" in text
    )


@pytest.mark.slow
@needs_browser
def test_a_browser_opens_the_link_and_reloads_without_it(server: Server, page: Any) -> None:
    page.goto(server.at("run"))
    assert page.url == server.at("run").partition("?")[0]
    page.reload()
    page.get_by_role("button", name="Start", exact=True).wait_for()
    # a page of another port: neither its requests nor its frames get anywhere
    import http.server
    import threading

    class Other(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("content-type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>other</title>")

        def log_message(self, *_: Any) -> None:
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Other) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        there = page.context.new_page()
        there.set_default_timeout(LONG)
        there.goto(f"http://127.0.0.1:{other.server_port}/")
        ours = f"http://127.0.0.1:{server.port}"
        opened = there.evaluate(f"new Promise((r) => {{ const w = new "
                                f"WebSocket('{ours.replace('http', 'ws')}{SOCKET}');"
                                " w.onopen = () => r('opened'); w.onerror = () => r('refused'); })")  # fmt: skip
        with there.expect_navigation() as navigation:
            there.evaluate(f"location.href = '{ours}/'")
        status, said = navigation.value.status, there.inner_text("body")
        there.close()
        other.shutdown()
    assert opened == "refused" and status == 403 and "another site's page ('same-site')" in said
    page.reload()
    page.get_by_role("button", name="Start", exact=True).wait_for()


@pytest.mark.slow
def test_only_a_page_that_a_browser_goes_to_makes_a_session_and_a_seventh_ends_none(tmp_path: Path) -> None:
    s = Server(tmp_path, TMPDIR=str(tmp_path))
    try:
        for more in ({}, {"Accept": "*/*"},
            {"Accept": "image/*", **{k: v for k, v in NAVIGATION.items() if k != "Accept"}},
                     NAVIGATION | {"Sec_Fetch_Mode": "no-cors"},
                     NAVIGATION | {"Sec_Fetch_Dest": "iframe"}):  # fmt: skip
            assert answer_of(s, "/", Cookie=s.known, **more)[0] == 406
        for path in ("/curves/log", "/saved/model", "/nowhere", "/_nicegui/nothing"):
            assert ask(s, path)[0] == 404
        assert answer_of(s, "/", **NAVIGATION)[0] == 403
        assert folders_of(tmp_path) == []
        for n in range(6):  # each a browser of its own: no cookie of a session
            assert ask(s, Cookie=s.known)[0] == 200 and len(folders_of(tmp_path)) == n + 1
        six = sorted(folders_of(tmp_path))
        status, line = ask(s, Cookie=s.known)
        assert status == 429 and "open tab" in line
        assert sorted(folders_of(tmp_path)) == six
    finally:
        s.stop()


def test_a_session_with_an_open_tab_never_gives_way() -> None:
    from collections import Counter

    from vaneloop.web.server import MOST_SESSIONS, Sessions

    class Made:
        def __init__(self, key: str):
            self.key, self.closed, self.working = key, False, Counter[str]()

        def close(self) -> None:
            self.closed = True

    class Tab:
        def on_delete(self, then: Any) -> None:
            self.close = then

    sessions = Sessions(Made)  # type: ignore[arg-type]
    tabs = [Tab() for _ in range(MOST_SESSIONS)]
    made: list[Any] = [sessions.get(str(i), t) for i, t in enumerate(tabs)]  # type: ignore[arg-type]
    for k in range(20):
        assert sessions.get(f"another {k}", Tab()) is None  # type: ignore[arg-type]
    assert not any(s.closed for s in made)
    second = Tab()
    assert sessions.get("3", second) is made[3]  # type: ignore[arg-type]
    for i in (3, 4, 1):  # 3 has a second tab; 4 is at work
        tabs[i].close()
    made[4].working["diagnose"] += 1
    assert sessions.get("new", Tab()) is not None and made[1].closed  # type: ignore[arg-type]
    assert sessions.get("newer", Tab()) is not None and made[4].closed  # type: ignore[arg-type]
    assert sessions.get("newest", Tab()) is None  # type: ignore[arg-type]
    second.close()
    assert sessions.get("newest", Tab()) is not None and made[3].closed  # type: ignore[arg-type]
    assert [s.closed for s in made] == [False, True, False, True, True, False]
    sessions.close()
    assert all(s.closed for s in made)


TEXTS = st.one_of(
    st.text(st.characters(max_codepoint=255), max_size=40),
    st.sampled_from(
        [
            "",
            "[",
            "[::1",
            "]",
            "::",
            "[::1]",
            "127.0.0.1",
            "127.0.0.1:x",
            "127.0.0.1:99999999",
            "localhost",
            "local host",
        ]
    ),
    st.sampled_from(["a@127.0.0.1", "http://[", "http://127.0.0.1", "null", "http://127.0.0.1:1@x"]),
    st.sampled_from(["\xb2", "9" * 5000, "-1", "1e9", "%", "%zz", "a" * 70_000]),
)


def through_the_guard(
    kind: str, method: str, path: str, query: bytes, headers: list[tuple[bytes, bytes]], guard: Any = None
) -> list[Any]:
    """What a guard in front of an application answers."""
    from vaneloop.web.guard import Guard

    async def behind(scope: Any, receive: Any, send: Any) -> None:
        await receive()
        await send(
            {"type": "http.response.start", "status": 200, "headers": []}
            if kind == "http"
            else {"type": "websocket.accept"}
        )
        if kind == "http":
            await send({"type": "http.response.body", "body": b"secret"})

    async def receive() -> Any:
        return {"type": "http.request", "body": b"12"} if kind == "http" else {"type": "websocket.connect"}

    async def send(message: Any) -> None:
        sent.append(message)

    sent: list[Any] = []
    if guard is None:
        guard = Guard(behind, "the-token-of-the-test", 8765, 100, loopback=True, pages=("/", "/run"))
        guard.ticket()
    scope = {
        "type": kind,
        "method": method,
        "path": path,
        "raw_path": path.encode(),
        "query_string": query,
        "headers": headers,
    }
    with pytest.raises(StopIteration):  # nothing in it waits
        guard(scope, receive, send).send(None)  # type: ignore[attr-defined]
    return sent


GUARDED = st.sampled_from(["host", "origin", "cookie", "content-length", "sec-fetch-site", "sec-fetch-mode", "accept"])


@given(
    st.sampled_from(["http", "websocket"]),
    st.sampled_from(["GET", "POST", "HEAD", "OPTIONS"]),
    st.one_of(st.sampled_from(["/", "/run", "//x", "/curves/log"]), st.text(max_size=30)),
    st.one_of(st.binary(max_size=60), st.just(b"token=%ff")),
    st.lists(st.tuples(GUARDED, TEXTS), max_size=6),
    st.booleans(),
    st.booleans(),
)
@settings(max_examples=examples(400))
def test_nothing_that_is_asked_breaks_the_guard(
    kind: str, method: str, path: str, query: bytes, extra: list[tuple[str, str]], good: bool, known: bool
) -> None:
    """Any header, path and query: one answer, never one that says that the server failed; and without the token nothing
    passes.
    """
    headers = (
        [("host", "127.0.0.1:8765")] * good + [("cookie", "vaneloop_token_8765=the-token-of-the-test")] * known + extra
    )
    raw = [(k.encode(), v.encode("latin-1")) for k, v in headers]
    sent = through_the_guard(kind, method, path, query, raw)
    if kind == "http":
        assert [m["type"] for m in sent] == ["http.response.start", "http.response.body"] and sent[0]["status"] < 500
        passed = sent[1]["body"] == b"secret"
    else:
        assert [m["type"] for m in sent] in (["websocket.close"], ["websocket.accept"])
        passed = sent[0]["type"] == "websocket.accept"
    if passed:
        assert known and sum(k == "host" for k, _ in headers) == 1


def raw_status(server: Server, request: bytes) -> int:
    """Status of the answer to these bytes; 0 where the connection is only closed."""
    import socket

    with socket.create_connection(("127.0.0.1", server.port), timeout=600) as s:
        with contextlib.suppress(OSError):  # closed before it has read all of it
            s.sendall(request)
            s.shutdown(socket.SHUT_WR)
        head = b""
        with contextlib.suppress(OSError):
            while b"\r\n" not in head and (more := s.recv(4096)):
                head += more
    return int(head.split()[1]) if head else 0


ODD_REQUESTS = [
    "GET / HTTP/1.1\r\nHost: [\r\n{c}\r\n",
    "GET / HTTP/1.1\r\n{c}\r\n",
    "GET / HTTP/1.0\r\n{c}\r\n",
    "GET / HTTP/1.1\r\n{h}Host: 127.0.0.1\r\n{c}\r\n",
    "GET / HTTP/1.1\r\n{h}{c}Origin: http://[\r\n\r\n",
    "GET / HTTP/1.1\r\n{h}{c}X: {long}\r\n\r\n",
    "GET /{long} HTTP/1.1\r\n{h}{c}\r\n",
    "GET /_nicegui/{mid} HTTP/1.1\r\n{h}{c}\r\n",
    "POST / HTTP/1.1\r\n{h}{c}Content-Length: \xb2\r\n\r\n",
    "POST / HTTP/1.1\r\n{h}{c}Content-Length: {nines}\r\n\r\n",
    "GET /saved/%00 HTTP/1.1\r\n{h}{c}\r\n",
    "GET /%ff%fe/%zz%% HTTP/1.1\r\n{h}{c}\r\n",
    "GET /assets/uPlot.css%00 HTTP/1.1\r\n{h}{c}\r\n",
    "GET /curves/log?from=nan&to=inf&n=1e400 HTTP/1.1\r\n{h}{s}\r\n",
    "GET /curves/log?from=9&to=1&n=-{nines} HTTP/1.1\r\n{h}{s}\r\n",
    "GET /?token=%00%ff&token= HTTP/1.1\r\n{h}\r\n",
    "GET /?%=&&&=; HTTP/1.1\r\n{h}{c}\r\n",
    "GET * HTTP/1.1\r\n{h}{c}\r\n",
    "OPTIONS * HTTP/1.1\r\n{h}{c}\r\n",
    "CONNECT x:1 HTTP/1.1\r\n{h}{c}\r\n",
    "GET http://other.example/ HTTP/1.1\r\n{h}{c}\r\n",
    "GET / HTTP/1.1\r\n{h}Cookie: vaneloop_session_{p}=e30=.x.y; {k}\r\n\r\n",
    "GET / HTTP/1.1\r\n{h}Cookie: vaneloop_session_{p}=\xff\xfe; {k}\r\n\r\n",
    "GET / HTTP/1.1\r\n{h}{c}Upgrade: websocket\r\nConnection: Upgrade\r\n\r\n",
    "GET /_nicegui_ws/socket.io/?EIO=%ff&transport=%00 HTTP/1.1\r\n{h}{c}\r\n",
    "GET /_nicegui_ws/socket.io/?EIO=4&transport=websocket&client_id=%ff HTTP/1.1\r\n{h}{c}Upgrade: "
    "websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: !\r\n\r\n",
    "POST /_nicegui_ws/socket.io/?EIO=4&transport=polling&sid=x HTTP/1.1\r\n{h}{c}Content-Length: "
    "3\r\n\r\n\xff\xff\xff",
    "POST /_nicegui/client/x/upload/y HTTP/1.1\r\n{h}{c}Content-Length: 0\r\n\r\n",
    "\x00\x01\x02\r\n\r\n",
    "GET / HTTP/9.9\r\n\r\n",
]


def test_no_odd_request_gets_a_server_error(server: Server) -> None:
    """The kind of `Host: [`: hosts, origins, lengths, paths, cookies and upgrades that are none, sent as bytes to the
    real server.
    """
    _, headers, _ = answer_of(server, "/", Cookie=server.known, **NAVIGATION)
    session = headers["set-cookie"].partition(";")[0]
    words = {
        "h": f"Host: 127.0.0.1:{server.port}\r\n", "c": f"Cookie: {server.known}\r\nAccept: "
                                                        f"text/html\r\n", "long": "a" * 200_000,
        "s": f"Cookie: {server.known}; {session}\r\n", "k": server.known, "p": server.port, "nines": "9" * 5000,
        "mid": "a" * 5000,
    }  # fmt: skip
    statuses = {odd: raw_status(server, odd.format(**words).encode("latin-1")) for odd in ODD_REQUESTS}
    assert not {odd: status for odd, status in statuses.items() if status >= 500}
    assert statuses[ODD_REQUESTS[0]] == 400 and ask(server)[0] == 200


@given(
    st.sampled_from(["GET", "POST", "HEAD"]), st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=30),
    st.lists(st.tuples(st.sampled_from(["Host", "Origin", "Content-Length", "Transfer-Encoding", "Accept", "Range",
    "Cookie"]),
                       st.text(st.characters(min_codepoint=32, max_codepoint=255, exclude_characters="\x7f"),
                       max_size=20)), max_size=4),
    st.sampled_from(["/", "/curves/", "/saved/", "/_nicegui/", "/_nicegui/3.0/static/", "/_nicegui_ws/socket.io/?"]),
)  # fmt: skip
@settings(max_examples=examples(60), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_requests_get_no_server_error(
    server: Server, method: str, tail: str, more: list[tuple[str, str]], path: str
) -> None:
    lines = [f"{method} {path}{tail} HTTP/1.1", f"Host: 127.0.0.1:{server.port}", f"Cookie: {server.known}"]
    lines += [f"{k}: {v}" for k, v in more]
    assert raw_status(server, ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1")) < 500


def test_what_belongs_to_a_session_is_given_to_nobody_else(server: Server) -> None:
    assert ask(server)[0] == 200 and ask(server, "/curves/log")[0] == 200  # the session's own
    for path in ("/curves/log", "/saved/model", "/saved/..%2f..%2fetc%2fpasswd"):
        assert ask(server, path, Cookie=server.known)[0] == 404


@pytest.mark.slow
def test_elsewhere_than_on_loopback_the_token_is_the_users_own(tmp_path: Path) -> None:
    for host in ("0.0.0.0", "127.0.0.1"):
        words = [sys.executable, "-m", "vaneloop.cli.main", "web", "--host", host, "--port", "0", "--no-open"]
        short = subprocess.run(
            words, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT), "VANELOOP_WEB_TOKEN": "short"},
            capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert short.returncode == 2 and "VANELOOP_WEB_TOKEN" in short.stderr and "Traceback" not in short.stderr
    token = "a-token-for-the-test"
    s = Server(tmp_path, "--host", "0.0.0.0", "--upload-limit", "1", VANELOOP_WEB_TOKEN=token)
    try:
        assert s.token == token
        status, line = ask(s, Cookie="", Host="this.machine:80")
        assert status == 403 and "token" in line and token not in line
        assert ask(s, Host="this.machine:80")[0] == 200
        assert ask(s, Host="[")[0] == 400
        status, line = ask(s, "/_nicegui/client/x/upload/1", "POST", b"0" * (2 << 20))
        assert status == 413 and "1 MB" in line
    finally:
        s.stop()


def test_the_browser_is_opened_with_a_word_that_works_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    """Every user of a machine may read the command line of a browser."""
    import webbrowser

    from vaneloop.cli.main import main
    from vaneloop.web.guard import Guard

    def serve(sock: Any, folder: Path, token: str, most: int, loopback: bool, ready: Any, *machine: str | None) -> None:
        nonlocal guard
        guard = Guard(None, token, 8765, most, loopback=loopback)  # type: ignore[arg-type]
        ready(guard.ticket())
        sock.close()

    guard: Any = None
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr("vaneloop.web.server.serve", serve)
    assert main(["web", "--port", "0", "--folder", str(tmp_path)]) == 0
    printed = capsys.readouterr().out.strip()
    assert printed.endswith(guard.token) and guard.loopback
    (link,) = opened
    assert link.partition("=")[0] == printed.partition("=")[0] and guard.token not in link
    query = link.partition("?")[2].encode()
    host = [(b"host", b"127.0.0.1:8765")]
    for q, statuses in ((query, [303, 403]), (printed.partition("?")[2].encode(), [303, 303])):
        assert [through_the_guard("http", "GET", "/", q, host, guard)[0]["status"] for _ in range(2)] == statuses


# ---- temporary folders -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_uploads_are_private_and_gone_at_the_end_or_after_a_kill_at_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import stat
    import tempfile

    from vaneloop.web.private import private_folder

    killed = Server(tmp_path, TMPDIR=str(tmp_path))
    assert ask(killed)[0] == 200
    (left,) = tmp_path.glob("vaneloop-web-*")
    assert left.name.startswith(f"vaneloop-web-{killed.process.pid}-") and stat.S_IMODE(left.stat().st_mode) == 0o700
    killed.process.kill()
    killed.process.wait()
    assert len(folders_of(tmp_path)) == 1
    left = left.rename(left.with_name(f"vaneloop-web-{os.getpid()}-left"))  # its number is another process's by now
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "elsewhere"))
    (tmp_path / "elsewhere").mkdir()
    with private_folder() as made:
        running = made.rename(tmp_path / made.name)
        another = Server(tmp_path, TMPDIR=str(tmp_path))
        (own,) = tmp_path.glob(f"vaneloop-web-{another.process.pid}-*")
        assert set(tmp_path.glob("vaneloop-web-*")) == {running, own}
        another.stop()
        assert list(tmp_path.glob("vaneloop-web-*")) == [running]


def test_only_folders_of_this_user_whose_process_is_gone_are_swept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import tempfile

    from vaneloop.web.private import private_folder, sweep

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "lock").touch()
    (tmp_path / "vaneloop-web-link").symlink_to(elsewhere, target_is_directory=True)
    (tmp_path / "vaneloop-web-a-file").touch()
    starting = tmp_path / f"vaneloop-web-{os.getppid()}-starting"  # made, not locked yet
    free, dead = tmp_path / f"vaneloop-web-{os.getppid()}-free", tmp_path / "vaneloop-web-99999999-dead"
    for folder in (starting, free, dead):
        (folder / "inside").mkdir(parents=True)
    (free / "lock").touch()
    with private_folder() as held:
        assert not free.exists() and not dead.exists()  # at the start
        free.mkdir()
        (free / "lock").touch()
        monkeypatch.setattr(os, "getuid", lambda: 12345)  # now they are another user's
        assert sweep(tmp_path) == [] and free.exists()
        monkeypatch.undo()
        assert sweep(tmp_path) == [free] and held.is_dir()
    assert not held.exists()
    assert {p.name for p in tmp_path.iterdir()} == {
        "elsewhere",
        "vaneloop-web-link",
        "vaneloop-web-a-file",
        starting.name,
    }
    assert (elsewhere / "lock").exists()


@pytest.mark.parametrize(
    ("name", "kept"),
    [("run.csv", "run.csv"), ("../../etc/passwd", "passwd"), ("C:\\x\\log.mf4", "log.mf4"), (".bashrc", "bashrc"),
     ("a;rm -rf $HOME.csv", "a_rm -rf _HOME.csv"), ("\u202ecsv.exe", "_csv.exe"), ("", "file"),
     ("x" * 300 + ".csv", "x" * 80 + ".csv")],
)  # fmt: skip
def test_a_name_of_an_upload_is_a_name_and_no_path(name: str, kept: str) -> None:
    from vaneloop.web.session import safe_name

    assert safe_name(name) == kept


# ---- curves ----------------------------------------------------------------------------------------------------------


def test_a_thinned_view_keeps_every_spike_and_hole() -> None:
    import json
    import struct

    import numpy as np

    from vaneloop.web.charts import Curves, Panel, Trace, view

    t = np.arange(300_000) * 0.01
    y = np.sin(t / 50)
    y[123_456], y[200_000:210_000] = 9.0, np.nan
    body = view(Curves([Panel("a", "mm", t, [Trace("a", y)])], "k"), None, None, 1200)
    (size,) = struct.unpack_from("<I", body)
    n = json.loads(body[4 : 4 + size])["panels"][0]["n"]
    at = 4 + size + (-(4 + size) % 8)
    x, drawn = np.frombuffer(body, "<f8", n, at), np.frombuffer(body, "<f8", n, at + 8 * n)
    assert n <= 2 * 1200 + 2 and drawn[x == t[123_456]].tolist() == [9.0]
    assert np.isnan(drawn).any() and np.nanmin(drawn) == np.nanmin(y)


def test_another_log_is_laid_over_at_the_first_one_s_times() -> None:
    from vaneloop.web.charts import Over, of_log

    t = np.arange(100) * 0.1
    here, there = {"x": ("mm", t, t), "y": ("mm", t, t)}, {"x": ("mm", t[::2], 3.0 * t[::2])}
    panels = of_log(here, "k", [Over("other", there, 2.0)]).panels
    assert [len(p.traces) for p in panels] == [2, 1]
    over = panels[0].traces[1].y
    after = panels[0].t >= 2.0
    assert np.isnan(over[~after]).all()
    np.testing.assert_allclose(over[after], 3.0 * (panels[0].t[after] - 2.0), atol=1e-9)


def test_a_mode_and_a_fault_are_bands_of_time() -> None:
    from vaneloop.web.charts import bands

    t = np.arange(10.0)
    state = np.array([2, 2, 4, 4, 4, 2, np.nan, 3, 3, 3])
    found = bands(t, state, {2: ("RUN", ""), 3: ("DEGRADED", "model"), 4: ("FAIL_SAFE", "bad")})
    assert [(b.start, b.end, b.text) for b in found] == [(2.0, 5.0, "FAIL_SAFE"), (7.0, 9.0, "DEGRADED")]
    assert bands(t[:0], state[:0], {}) == []


def test_the_workbench_of_another_machine_says_so_in_its_commands(tmp_path: Path) -> None:
    from vaneloop.web.running import Loop
    from vaneloop.web.schedule import Plan
    from vaneloop.web.session import LogFile, Session

    folder = str(ROOT / "examples" / "four_stages")
    s = Session("x", tmp_path / "0123456789abcdef", [], folder)
    s.choice.file = LogFile(tmp_path / "run.csv", "run.csv", "run.csv")
    for real in (False, True):
        assert s.choice.words(real)[-2:] == ["--tables", folder]
    assert all(words[-2:] == ["--tables", folder] for _, words in Loop(s, profile="ramp").commands())
    plan = Plan.of(s)
    assert plan.geometry.vanes == plan.schedules.vanes == ("vigv", "vgv1", "vgv2", "vgv3")


def test_the_live_loop_runs_another_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vaneloop.base.vanes import VANES
    from vaneloop.web import loop
    from vaneloop.web.process import Inbox

    monkeypatch.setattr(loop, "INBOX", Inbox())  # what the loop ends before it hears reaches no other test
    told: list[dict[str, Any]] = []

    def progress(share: float | None, content: Any) -> None:
        if isinstance(content, dict) and "rows" in content:
            told.append(content)
            loop.INBOX.put(0, {"stop": True})

    folder = str(ROOT / "examples" / "four_stages")
    loop.lockstep(progress, 70.0, 0.0, None, 1, None, folder)
    rows = np.concatenate([c["rows"] for c in told])
    known = {v for v in VANES if np.isfinite(rows[-1, loop.COLUMNS.index(v)])}
    assert known == set(VANES[:4])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "told"),
    [("*(volatile int *)0 = 1;", "ended its process"), ("for (;;) {}", "did not come back within 1 s")],
    ids=["crashes", "hangs"],
)
def test_a_controller_of_one_s_own_that_fails_is_told_and_the_page_goes_on(
    tmp_path: Path, gcc: str, monkeypatch: pytest.MonkeyPatch, fault: str, told: str
) -> None:

    from tests.native_builds import wrong
    from vaneloop.web.jobs import WorkError
    from vaneloop.web.loop import COLUMNS
    from vaneloop.web.run import Loop
    from vaneloop.web.session import Session

    path = wrong(gcc, tmp_path, fault)
    monkeypatch.setattr("hil.native.isolation.PATIENCE", 1.0)

    async def run(controller: str | None) -> Loop:
        lp = Loop(Session("x", tmp_path / f"{bool(controller)}0123456789", [], None, controller))
        lp.speed, lp.demand, lp.running, lp.rows = 0.0, 80.0, True, np.empty((36_000, len(COLUMNS)))
        assert ("--controller" in lp.controller_words()) == (controller is not None)
        try:
            await lp._in_lockstep()
        finally:
            for w in lp.workers.values():
                w.stop()
        return lp

    told += r", in tick 500, 0\.500 s after power-on; last inputs: n_dem"
    # the browser's event loop is this thread's
    with ThreadPoolExecutor(1) as thread, pytest.raises(WorkError, match=told):
        thread.submit(asyncio.run, run(path)).result()
