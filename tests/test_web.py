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
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT

CHROMIUM = next((p for p in (shutil.which(n) for n in ("chromium", "chromium-browser", "google-chrome")) if p), None)
SHOTS = Path(os.environ.get("VANELOOP_SHOTS", ROOT / "out" / "web"))
LONG = 1000.0 * float(os.environ.get("VANELOOP_PATIENCE", "240"))  # ms; a slow machine with other work compiles the simulator first

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium (make test does, where it may)")


class Server:
    """``vaneloop web`` as a user starts it."""

    def __init__(self, folder: Path, *options: str, **environment: str):
        words = [sys.executable, "-m", "app.main", "web", "--port", "0", "--no-open", "--quiet", "--folder", str(folder), *options]
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        self.folder, self.environment = folder, {**os.environ, "PYTHONPATH": path, **environment}
        self.process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=folder, env=self.environment)
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
        self.process.wait(60)


def renamed(path: Path) -> None:
    """Thirty seconds of the example under names of a test bench, the speeds in rpm, the stroke in m."""
    import numpy as np

    from hil.logs import read_log

    log = read_log(ROOT / "examples" / "hidden_effect.parquet")
    other = {"n_dem": ("N1_DEM", 380.0), "n_r": ("N1", 380.0), "x_lvdt": ("ACT_POS", 1e-3)}
    other |= {name: (name, 1.0) for name in ("x_dem", "i_cmd")}
    columns = {name: log.channels[signal].values[:3000] * scale for signal, (name, scale) in other.items()}
    table = np.column_stack([log.channels["n_r"].t[:3000], *columns.values()])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=",".join(["t", *columns]), comments="")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("web")
    (folder / "broken.csv").write_text("time_s,n_dem\n0.0,60\n0.1,sixty\n")
    renamed(folder / "renamed.csv")
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


def looks(page: Any, name: str) -> None:
    """Pictures at both widths, light and dark; nothing may stick out of the page."""
    for width, dark in ((1280, False), (1920, False), (1920, True), (1280, True)):
        page.set_viewport_size({"width": width, "height": 900})
        if dark != ("body--dark" in (page.locator("body").get_attribute("class") or "")):
            page.get_by_label("light or dark").click()
            page.wait_for_function(f"document.body.classList.contains('body--dark') === {str(dark).lower()}")
        page.wait_for_timeout(700)  # charts and figures follow the width
        assert page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"), f"{name} at {width}"
        shot(page, f"{name}_{width}_{'dark' if dark else 'light'}")
    page.get_by_label("light or dark").click()
    page.set_viewport_size({"width": 1280, "height": 800})


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
    deadline = time.monotonic() + 60
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

    # a button stays the same element while work goes on in the background: a click on one that was drawn anew would be lost
    page.evaluate("window.kept = [...document.querySelectorAll('button')].find((b) => b.innerText.includes('Extended model'))")

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


@needs_browser
def test_a_bad_file_gets_the_command_lines_one_line(server: Server, page: Any, tmp_path: Path) -> None:
    page.goto(server.url)
    choose(page, "broken.csv")
    alert = page.get_by_role("alert")
    alert.wait_for()
    said = alert.inner_text()
    assert said.startswith("vaneloop: broken.csv: ") and "\n" not in said and "Traceback" not in said
    words = [sys.executable, "-m", "app.main", "compare", "broken.csv"]
    done = subprocess.run(words, cwd=server.folder, env=server.environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.strip().splitlines()[-1] == said

    evil = tmp_path / "model.py"
    evil.write_text(f"open({str(tmp_path / 'executed')!r}, 'w')")
    page.locator("input[type=file]").first.set_input_files(evil)
    page.get_by_text("this file cannot be taken").wait_for()
    assert not (tmp_path / "executed").exists()
    junk = tmp_path / "junk.parquet"
    junk.write_bytes(b"PAR1" + bytes(range(256)) * 40 + b"PAR1")
    page.locator("input[type=file]").first.set_input_files(junk)
    page.get_by_role("alert").filter(has_text="junk.parquet").wait_for()
    assert "Traceback" not in page.get_by_role("alert").inner_text()


@needs_browser
def test_names_and_units_are_given_in_a_form(server: Server, page: Any) -> None:
    page.goto(server.url)
    choose(page, "renamed.csv")
    page.get_by_role("alert").wait_for()  # n_dem and n_r are missing under our names
    for ours, name in (("n_dem", "N1_DEM"), ("n_r", "N1"), ("x_lvdt", "ACT_POS")):
        page.get_by_label(f"name of {ours} in the log").click()
        page.get_by_role("option", name=name, exact=True).click()
    for ours, unit in (("n_dem", "rpm"), ("n_r", "rpm"), ("x_lvdt", "m")):
        page.get_by_label(f"unit of {ours} in the log").fill(unit)
    page.get_by_label("design speed [rpm]").fill("38000")
    page.get_by_role("button", name="Read again").click()
    page.get_by_text("stage fails most").wait_for()
    preview = page.locator(".vtable").first.inner_text()
    assert "ACT_POS" in preview and "N1_DEM" in preview
    command = page.locator(".cmd code").first.inner_text()
    assert "--map N1=n_r" in command and "--unit x_lvdt=m" in command and "--design-rpm 38000" in command
    shot(page, "mapped_1280_light")


# ---- page 2: schedule -------------------------------------------------------------------------------------------------------------------


def step(page: Any, name: str) -> None:
    page.get_by_role("button", name=name).click()
    page.get_by_role("heading", name=re.compile(f"Step .: {name}")).wait_for()


@needs_browser
def test_schedule_from_lengths_to_tables_for_the_controller(server: Server, page: Any, tmp_path: Path) -> None:
    page.goto(server.url + "schedule")
    page.locator(".loop-log").click()
    page.get_by_role("option", name="hidden_effect.parquet").click()

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
    step(page, "Links of VGV1 and VGV2")
    step(page, "Measured loop")
    step(page, "Tables")
    with page.expect_download() as download:
        page.get_by_text("download stroke_tables.toml").click()
    tables = tomllib.loads(Path(download.value.path()).read_text())
    values = tables["extension"]["values"]
    assert all(0.0 < v < 48.0 for v in values) and values == sorted(values)
    looks(page, "schedule")


# ---- page 3: run ------------------------------------------------------------------------------------------------------------------------


@needs_browser
def test_run_the_loop_inject_a_fault_and_open_the_record(server: Server, page: Any) -> None:
    page.goto(server.url + "run")
    page.locator(".pace").click()
    page.get_by_role("option", name="10 x", exact=True).click()
    page.get_by_role("button", name="Start", exact=True).click()
    page.locator('[data-lamp="RUN"].good').wait_for()
    slider = page.get_by_role("slider", name="speed demand")
    box = slider.bounding_box()
    slider.click(position={"x": 0.8 * box["width"], "y": box["height"] / 2})
    page.wait_for_function("parseFloat(document.querySelectorAll('.tiles .v')[1].innerText) > 80")  # rotor speed follows
    page.get_by_label("find a scenario").fill("demand_stops")
    page.get_by_role("button", name="demand_stops", exact=True).click()
    page.locator('[data-lamp="FAIL_SAFE"].bad').wait_for()
    page.locator('[data-lamp="demand_stale"].bad').wait_for()
    page.get_by_label("filter of the trace").fill("VGV_HEALTH")
    page.wait_for_function(
        "(() => { const l = document.querySelector('.trace').innerText.trim().split('\\n');"
        " return l.length > 3 && l.every((x) => x.includes('VGV_HEALTH')); })()"
    )
    page.reload()  # the loop goes on
    page.locator('[data-lamp="RUN"].good').wait_for()
    page.wait_for_function("parseFloat(document.querySelectorAll('.tiles .v')[0].innerText) > 15")
    looks(page, "run")
    page.get_by_role("button", name="Stop", exact=True).click()
    page.locator(".open-record").click()
    page.locator(".verdict").first.wait_for()
    assert "noise" in page.locator(".verdict").first.inner_text()


@needs_browser
def test_run_in_real_time_on_the_embedded_bus(server: Server, page: Any) -> None:
    page.goto(server.url + "run")
    page.locator(".bus").click()
    page.get_by_role("option", name="real time, embedded bus").click()
    page.get_by_role("button", name="Start", exact=True).click()
    page.locator('[data-lamp="RUN"].good').wait_for()
    page.get_by_text(re.compile(r"p50 \d+ us")).wait_for()
    shot(page, "run_real_time_1280_light")
    page.get_by_role("button", name="Stop", exact=True).click()
    page.locator(".open-record").wait_for()
    assert not page.get_by_role("alert").count(), page.get_by_role("alert").first.inner_text()


# ---- who may ask ------------------------------------------------------------------------------------------------------------------------


def ask(server: Server, path: str = "/", method: str = "GET", body: bytes = b"", **headers: str) -> tuple[int, str]:
    """One request with headers of our own; status and the first line of the answer."""
    from http.client import HTTPConnection
    from urllib.parse import urlsplit

    at = urlsplit(server.url)
    connection = HTTPConnection("127.0.0.1", at.port, timeout=60)
    connection.request(method, path, body=body, headers={k.replace("_", "-"): v for k, v in headers.items()})
    answer = connection.getresponse()
    return answer.status, answer.read().decode("utf-8", "replace").partition("\n")[0]


def test_another_site_cannot_reach_the_server(server: Server) -> None:
    assert ask(server)[0] == 200
    status, line = ask(server, Host="rebound.example")  # a name of another site that resolves to this machine
    assert status == 421 and "rebound.example" in line
    assert ask(server, Host="127.0.0.1.rebound.example")[0] == 421
    assert ask(server, Origin="http://rebound.example")[0] == 403
    assert ask(server, "/_nicegui_ws/socket.io/?EIO=4&transport=polling", Origin="null")[0] == 403
    assert ask(server, Host="127.1.2.3")[0] == 200 and ask(server, Host="[::1]:80")[0] == 200
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec_WebSocket_Version": "13", "Sec_WebSocket_Key": "A" * 22 + "=="}
    socket = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    assert ask(server, socket, Origin="http://rebound.example", **upgrade)[0] == 403


def test_what_belongs_to_a_session_is_given_to_nobody_else(server: Server) -> None:
    assert ask(server, "/curves/log")[0] == 404
    assert ask(server, "/saved/model")[0] == 404
    assert ask(server, "/saved/..%2f..%2fetc%2fpasswd")[0] == 404


def test_elsewhere_than_on_loopback_a_token_is_needed(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "app.main", "web", "--host", "0.0.0.0", "--port", "0", "--no-open"]
    short = subprocess.run(
        words, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT), "VANELOOP_WEB_TOKEN": "short"}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert short.returncode == 2 and "VANELOOP_WEB_TOKEN" in short.stderr and "Traceback" not in short.stderr
    token = "a-token-for-the-test"
    s = Server(tmp_path, "--host", "0.0.0.0", "--upload-limit", "1", VANELOOP_WEB_TOKEN=token)
    try:
        assert s.url.endswith(f"?token={token}")
        status, line = ask(s)
        assert status == 401 and "token" in line and token not in line
        assert ask(s, Cookie="vaneloop_token=wrong")[0] == 401
        assert ask(s, "/?token=" + token)[0] == 200
        assert ask(s, Cookie=f"vaneloop_token={token}")[0] == 200
        status, line = ask(s, "/_nicegui/client/x/upload/1", "POST", b"0" * (2 << 20), Cookie=f"vaneloop_token={token}")
        assert status == 413 and "1 MB" in line
    finally:
        s.stop()


def test_uploads_are_private_and_gone_at_the_end(tmp_path: Path) -> None:
    import stat

    s = Server(tmp_path, TMPDIR=str(tmp_path))
    (private,) = tmp_path.glob("vaneloop-web-*")
    assert stat.S_IMODE(private.stat().st_mode) == 0o700
    s.stop()
    assert not private.exists()


@pytest.mark.parametrize(
    ("given", "kept"),
    [("run.csv", "run.csv"), ("../../etc/passwd", "passwd"), ("C:\\x\\log.mf4", "log.mf4"), (".bashrc", "bashrc"),
     ("a;rm -rf $HOME.csv", "a_rm -rf _HOME.csv"), ("\u202ecsv.exe", "_csv.exe"), ("", "file"), ("x" * 300 + ".csv", "x" * 80 + ".csv")],
)  # fmt: skip
def test_a_name_of_an_upload_is_a_name_and_no_path(given: str, kept: str) -> None:
    from app.web.session import safe_name

    assert safe_name(given) == kept


# ---- curves -----------------------------------------------------------------------------------------------------------------------------


def test_a_thinned_view_keeps_every_spike_and_hole() -> None:
    import json
    import struct

    import numpy as np

    from app.web.charts import Curves, Panel, Trace, view

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
