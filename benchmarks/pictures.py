"""Pictures of the workbench for README and docs: ``python -m benchmarks.pictures [FOLDER]``."""

from __future__ import annotations

import sys
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


def take(folder: Path) -> list[Path]:
    """Take every picture; return the files."""
    out = []
    with workbench(ROOT / "examples") as (browser, url, _):
        for path, name, scene in (
            ("", "missing", missing),
            ("schedule", "schedule", schedule),
            ("run", "run", run),
            ("run", "calibrate", calibrate),
        ):
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
