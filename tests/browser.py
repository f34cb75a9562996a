"""A headless Chromium for the tests: pictures, what axe-core finds, and whether a report is open to everybody."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = next((p for p in (shutil.which(n) for n in ("chromium", "chromium-browser", "google-chrome")) if p), None)
# Where pictures are kept, "": nowhere. Each costs a second, and no check needs them.
SHOTS = os.environ.get("VANELOOP_SHOTS", "")
# axe describes every element that a rule passes, unless it is told that nobody asks. All rules are held all the same;
# of 29 s on the page of a replay 4 s are left.
AXE = "axe.run(document, {resultTypes: ['violations']})"
# those of axe's default rules that ask for a colour
COLOURS = AXE.replace("]}", "], runOnly: {type: 'rule', values: ['color-contrast', 'link-in-text-block']}}")
# A curve is a path for each of its strokes, 13,000 of the 19,000 elements of a replay's page. A path has no words, name
# or role that a rule could ask for, and axe takes three times as long with them.
NO_STROKES = "for (const e of document.querySelectorAll('.main-svg path')) e.remove()"
# A page draws its curves anew some time after the scheme has changed: before that, their colours are the other's, and
# after it the strokes are back.
REDRAWN = """(scheme) => [...document.querySelectorAll('.js-plotly-plot')].every((p) => p._fullLayout.font.color ===
    JSON.parse(document.getElementById('themes').textContent)[scheme].text)"""
# ms; a slow machine with other work compiles the simulator first
LONG = 1000.0 * float(os.environ.get("VANELOOP_PATIENCE", "240"))
WHY_NOT = "no Chromium: apt-get install chromium (make test does, where it may)"


def shot(page: Any, name: str) -> None:
    """Keep a picture of the whole page, where pictures are wanted."""
    if SHOTS:
        Path(SHOTS).mkdir(parents=True, exist_ok=True)
        page.screenshot(path=str(Path(SHOTS) / f"{name}.png"), full_page=True)


def violations(page: Any, run: str = AXE) -> dict[str, str]:
    """What axe-core finds wrong for somebody who uses a keyboard or a screen reader: rule -> the first place.

    run  `AXE`, or `COLOURS`: the rules of colours only, of a page of which nothing else has changed
    """
    axe = pytest.importorskip("axe_playwright_python", reason="no axe-core: pip install -e '.[test]'")
    if not page.evaluate("!!window.axe"):
        page.evaluate((Path(axe.__file__).parent / "axe.min.js").read_text(encoding="utf-8"))
    found = page.evaluate(f"{run}.then((r) => r.violations.map((v) => [v.id, v.nodes[0].html]))")
    return dict(found)


def look_at(browser: Any, file: Path, name: str, *, every: bool = False) -> None:
    """Hold a report against axe-core, light on a laptop and dark on a phone of 360 px; nothing sticks out.

    every  both schemes on both. One page is enough for that: a width sets no colour (`test_a_width_sets_no_colour`)
    """
    context = browser.new_context()
    context.set_default_timeout(LONG)
    page = context.new_page()
    complaints: list[str] = []
    page.on("pageerror", lambda e: complaints.append(str(e)))
    for width, schemes in ((1280, ("light", "dark")), (360, ("dark", "light"))):
        page.goto("about:blank")  # then drawn anew, as on that screen; the process has read the page's programs before
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=schemes[0])
        page.goto(file.as_uri())
        drawn = "[...document.querySelectorAll('.plot')].every((p) => p.querySelector('.main-svg'))"
        page.wait_for_function(drawn, timeout=LONG)
        wide = page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width, f"{name}: {wide} px of {width}"
        for scheme in schemes if every else schemes[:1]:
            page.emulate_media(color_scheme=scheme)
            page.wait_for_function(REDRAWN, arg=scheme, timeout=LONG)
            shot(page, f"report_{name}_{width}_{scheme}")
            page.evaluate(f"() => {{ {NO_STROKES} }}")
            assert not violations(page, AXE if scheme == schemes[0] else COLOURS), f"{name} at {width}, {scheme}"
    context.close()
    assert not complaints, complaints


def driver() -> Any:
    """What starts browsers. Skips where it is not installed."""
    reason = "no driver of browsers: pip install -e '.[test-all]'"
    return pytest.importorskip("playwright.sync_api", reason=reason).sync_playwright()


def open_to_all(file: Path, name: str) -> None:
    """`look_at` in a browser of its own. Skips, saying so, where there is no Chromium or no driver: stands last in its
    test.
    """
    if CHROMIUM is None:
        pytest.skip(WHY_NOT)
    with driver() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        look_at(browser, file, name)
        browser.close()
