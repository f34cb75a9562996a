"""Pictures of README and docs: ``python -m benchmarks.pictures [FOLDER]``. They are figures of the pages that commands
write, and pages of the workbench. Beside the pictures lies what their bars say (`FIGURES`).
"""

from __future__ import annotations

import itertools
import json
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import ROOT
from benchmarks.web import PATIENCE, chromium, workbench
from vaneloop.base.files import write

__all__ = ["FIGURES", "REPORTS", "take"]

PUBLISHED = (".mat", ".json", ".csv")  # logs of others, which the reports of the worked examples are made of
FIGURES = "figures.json"  # picture -> the words on its bars, from left to right
EXAMPLE = "examples/hidden_effect.parquet"
# command that writes a page -> picture -> its figures, by a caption's words or their number on the page
REPORTS: dict[str, dict[str, tuple[str | int, ...]]] = {
    f"locate {EXAMPLE}": {
        "tutorial_error": ("actuator: measured and model",), "tutorial_where": ("Where the actuator subsystem fails",),
    },
    f"extend {EXAMPLE} --effect valve_dead_band --effect aero_load --out extended.toml": {
        "tutorial_falls": ("How the error falls",),
    },
    "clearance": {"clearance": (0, 2)},
    "diagnose DATA_EMPS.mat --test DATA_EMPS_PULSES.mat --system examples/emps.py": {
        "emps_force": ("DATA_EMPS.mat (fitted)",), "emps_falls": ("How the error falls",),
    },
    "diagnose 0.5Hz36lbtension1amplitude.json --system examples/friction_damper.py --test "
    "0.25Hz36lbtension1amplitude.json 1Hz36lbtension1amplitude.json 2Hz36lbtension0.5amplitude.json KocaeliDBE.json": {
        "damper_loops": ("1Hz36lbtension1amplitude.json: force over displacement",),
        "damper_where": ("Short bars help",),
    },
    "diagnose ex_1.csv --also ex_9.csv ex_20.csv ex_21.csv ex_23.csv ex_24.csv --test ex_4.csv ex_22.csv "
    "--system examples/micro_gas_turbine.py": {
        "turbine_power": ("ex_4.csv (test)",), "turbine_where": ("Short bars help",),
    },
}  # fmt: skip

WIDE = {"width": 1280, "height": 860}


def missing(page: Any) -> None:
    """The error has fallen."""
    page.locator(".choose").click()
    page.get_by_role("option", name="hidden_effect.parquet").click()
    page.get_by_role("button", name="Find the missing physics").click()
    page.locator(".fell").wait_for()
    page.wait_for_timeout(3000)
    page.locator(".vcard", has_text="What is missing?").evaluate("(e) => window.scrollTo(0, e.offsetTop - 8)")


def own(page: Any) -> None:
    """The same for a model of one's own."""
    page.locator(".choose-model").click()
    page.get_by_role("option", name="tank.py").last.click()
    page.locator(".choose").click()
    page.get_by_role("option", name="tank.csv").click()
    page.get_by_role("button", name="Find the missing physics").click()
    page.locator(".fell").wait_for()
    page.wait_for_timeout(3000)


def formulas(page: Any) -> None:
    """A channel made by a formula, over another."""
    page.locator(".choose").click()
    page.get_by_role("option", name="hidden_effect.parquet").click()
    page.get_by_text("All channels").first.click()
    for text in ("v = rate(x_dem)", "lag = x_dem - x_lvdt [um]"):
        page.get_by_label("formula", exact=True).fill(text)
        page.get_by_label("formula", exact=True).press("Enter")
        page.locator(".made", has_text=text.split()[0]).wait_for()
    for k, t in ((1, "75"), (2, "100")):
        page.get_by_label(f"cursor {k} [s]").fill(t)
        page.get_by_label(f"cursor {k} [s]").press("Enter")
    for axis, name in (("x", "v"), ("y", "lag")):
        page.locator(f".xy-{axis}").click()
        page.get_by_role("option", name=name, exact=True).last.click()
        page.locator(".q-menu").wait_for(state="detached")
    page.locator(".xy-said").wait_for()
    page.get_by_text("fails most in the").wait_for()
    page.locator(".formulas").evaluate("(e) => e.scrollIntoView()")


def schedule(page: Any) -> None:
    """The mechanism drawn to scale."""
    page.get_by_role("button", name="Mechanism").click()
    page.locator(".mech-link").first.wait_for()


def run(page: Any) -> None:
    """A fault in the loop that runs."""
    page.get_by_role("button", name="Start", exact=True).click()
    page.locator('[data-lamp="RUN"].good').wait_for()
    page.wait_for_timeout(12000)
    page.get_by_role("button", name="demand_stops", exact=True).click()
    page.wait_for_timeout(8000)


def calibrate(page: Any) -> None:
    """A gain that is changed while the loop runs."""
    page.get_by_role("button", name="Start", exact=True).click()
    kp = page.locator('[data-name="kp"] input')
    kp.wait_for()
    page.wait_for_timeout(6000)
    kp.fill("60")
    kp.press("Enter")
    page.get_by_text("calibration: kp 60").wait_for()
    page.wait_for_timeout(4000)
    page.locator(".vcard", has_text="Calibrate").evaluate("(e) => window.scrollTo(0, e.offsetTop - 480)")


def fleet(page: Any) -> None:
    """A run of a fleet."""
    page.locator(".run-folder").click()
    page.get_by_role("option").first.click()
    page.get_by_text("What the logs say together").wait_for()
    page.wait_for_timeout(6000)
    page.locator(".vcard", has_text="What the logs say together").evaluate("(e) => window.scrollTo(0, e.offsetTop - 8)")


WORK = (
    ("", "missing", missing),
    ("", "own", own),
    ("", "formulas", formulas),
    ("schedule", "schedule", schedule),
    ("run", "run", run),
    ("run", "calibrate", calibrate),
)
FLEET = ROOT / "out" / "fleet"  # a run of `vaneloop fleet`, for its picture


def take(folder: Path) -> list[Path]:
    """Take every picture; return the files."""
    out = [*_reports(folder), *_take(folder, ROOT / "examples", WORK)]
    if not (FLEET / "run.json").is_file():
        print(f"no picture of a fleet: {FLEET} is no run; docs/fleet.md says how one is made")
        return out
    return out + _take(folder, FLEET.parent, (("fleet", "fleet", fleet),))


def _reports(folder: Path) -> list[Path]:
    """Take pictures of figures of the commands' pages, and write what their bars say."""
    from playwright.sync_api import sync_playwright

    out, said = [], {}
    file = folder / FIGURES
    before = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    with tempfile.TemporaryDirectory() as own, sync_playwright() as p:
        browser = p.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
        page = browser.new_page(viewport=WIDE, color_scheme="light", reduced_motion="reduce")
        page.set_default_timeout(PATIENCE)
        for line, pictures in REPORTS.items():
            words = [str(ROOT / w) if w.startswith("examples/") else w for w in shlex.split(line)]
            missing_logs = [w for w in words if w.endswith(PUBLISHED) and not _brought(w, Path(own))]
            if missing_logs:
                print(f"no picture of {', '.join(pictures)}: {', '.join(missing_logs)} not found below {_data()}")
                said |= {f"{name}.png": before[f"{name}.png"] for name in pictures if f"{name}.png" in before}
                continue
            words = [sys.executable, "-m", "vaneloop", *words, "--quiet", "--report", f"{own}/page.html"]
            done = subprocess.run(words, cwd=own, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False)
            if done.returncode not in (0, 1):
                raise RuntimeError(f"vaneloop {line}: exit code {done.returncode}")
            page.goto(Path(own, "page.html").as_uri())
            page.wait_for_function(DRAWN)
            for name, captions in pictures.items():
                all_figures = page.locator("figure")
                found = [
                    all_figures.nth(c) if isinstance(c, int) else all_figures.filter(has_text=c).first for c in captions
                ]
                figures = [f.element_handle() for f in found]
                for one, other in itertools.pairwise(figures):
                    one.evaluate("(a, b) => a.after(b)", other)
                figures[0].scroll_into_view_if_needed()
                boxes = [f.bounding_box() for f in figures]
                top, left = page.evaluate("[scrollY, scrollX]")
                first, last = boxes[0], boxes[-1]
                clip = {
                    "x": first["x"] + left, "y": first["y"] + top, "width": first["width"],
                    "height": last["y"] + last["height"] - first["y"],
                }  # fmt: skip
                out.append(folder / f"{name}.png")
                page.screenshot(path=str(out[-1]), full_page=True, clip=clip)
                bars = [t for f in figures for t in _texts(f, ".bartext, .annotation-text") if t]
                names = [t for f in figures for t in _texts(f, ".xtick text")]
                if bars:
                    said[out[-1].name] = {"bars": bars, "axis": names}
        browser.close()
    out.append(write(file, json.dumps(said, indent=1, ensure_ascii=False) + "\n"))
    return out


def _texts(figure: Any, what: str) -> list[str]:
    return [e.text_content() or "" for e in figure.query_selector_all(what)]


def _data() -> Path:
    """Folder of the published logs: VANELOOP_DATA, or shared/data beside the checkout."""
    named = os.environ.get("VANELOOP_DATA")
    return Path(named) if named else ROOT.parent / "shared" / "data"


def _brought(name: str, folder: Path) -> bool:
    """Whether a published log is found, by its name or behind its folders' names, and is now in ``folder``."""
    found = next((f for f in _data().rglob(f"*{name}") if f.name == name or f.name.endswith(f"__{name}")), None)
    if found is not None and not (folder / name).exists():
        (folder / name).symlink_to(found.resolve())
    return found is not None


DRAWN = "[...document.querySelectorAll('.plot')].every((p) => p.querySelector('.main-svg'))"


def _take(folder: Path, served: Path, scenes: Sequence[tuple[str, str, Callable[[Any], None]]]) -> list[Path]:
    """Take pictures of pages of one workbench: its address, the picture's name, what is done before."""
    out = []
    with workbench(served) as (browser, url, _):
        for path, name, scene in scenes:
            page = browser.new_context(viewport=WIDE, color_scheme="light").new_page()
            page.set_default_timeout(PATIENCE)
            page.goto(url.replace("/?", f"/{path}?"))
            page.wait_for_timeout(1500)
            scene(page)
            page.wait_for_timeout(1500)
            out.append(folder / f"web_{name}.png")
            page.screenshot(path=str(out[-1]))
    return out


if __name__ == "__main__":
    for file in take(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "pictures"):
        print(file)
