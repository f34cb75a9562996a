"""Pictures of the workbench for README and docs: ``python -m benchmarks.pictures [FOLDER]``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import ROOT
from benchmarks.web import PATIENCE, workbench

__all__ = ["take"]

WIDE = {"width": 1280, "height": 860}


def missing(page: Any) -> None:
    """The error has fallen."""
    page.locator(".choose").click()
    page.get_by_role("option", name="hidden_effect.parquet").click()
    page.get_by_role("button", name="Find the missing physics").click()
    page.locator(".fell").wait_for()
    page.wait_for_timeout(3000)
    page.locator(".vcard", has_text="What is missing?").evaluate("(e) => window.scrollTo(0, e.offsetTop - 8)")


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
    ("schedule", "schedule", schedule),
    ("run", "run", run),
    ("run", "calibrate", calibrate),
)
FLEET = ROOT / "out" / "fleet"  # a run of `vaneloop fleet`, for its picture


def take(folder: Path) -> list[Path]:
    """Take every picture; return the files."""
    out = _take(folder, ROOT / "examples", WORK)
    if not (FLEET / "run.json").is_file():
        print(f"no picture of a fleet: {FLEET} is no run; docs/fleet.md says how one is made")
        return out
    return out + _take(folder, FLEET.parent, (("fleet", "fleet", fleet),))


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
