"""The documentation site builds strictly, and its reference says what the code has: every command and option, every
public name, frame, number of the calibration, law and scenario.
"""

from __future__ import annotations

import html
import importlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cantools
import pytest

import vaneloop
from hil.inject.scenario import library
from tests.browser import CHROMIUM, LONG, WHY_NOT, driver, violations
from tests.conftest import ROOT
from vaneloop.base import terminal
from vaneloop.base.tables import load_toml, path
from vaneloop.cli.main import COMMANDS
from vaneloop.identification.candidates.library import LAWS

pytest.importorskip("mkdocs")
pytestmark = pytest.mark.slow


def build(root: Path, site: Path) -> subprocess.CompletedProcess[str]:
    """Run MkDocs as `make docs` does; with --quiet it would count no warnings."""
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]
    surroundings = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(root)}
    return subprocess.run(words, cwd=root, env=surroundings, capture_output=True, text=True, timeout=600, check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    out = tmp_path_factory.mktemp("site")
    done = build(ROOT, out)
    assert done.returncode == 0, done.stderr
    return out


def words_of(page: Path) -> str:
    """Text of a page, without its tags."""
    return html.unescape(re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8")))


def test_every_page_is_on_the_site_and_in_its_navigation(site: Path) -> None:
    home = (site / "index.html").read_text(encoding="utf-8")
    pages = [p.relative_to(ROOT / "docs").with_suffix(".html") for p in (ROOT / "docs").rglob("*.md")]
    pages += [p.relative_to(ROOT / "docs").with_suffix(".html") for p in (ROOT / "docs/notebooks").glob("*.ipynb")]
    assert len(pages) > 40
    assert [str(p) for p in pages if not (site / p).is_file()] == []
    linked = set(re.findall(r'href="([^"#]+\.html)', home))
    away = [str(p) for p in pages if str(p) not in linked and p.name != "index.html"]
    assert not away, f"not in the navigation: {away}"


def test_every_command_has_a_page_with_all_its_options(site: Path) -> None:
    for name, (module, _) in COMMANDS.items():
        text = words_of(site / f"reference/commands/{name}.html")
        command = importlib.import_module(module)
        parser = terminal.Parser(prog=f"vaneloop {name}", description=command.DESCRIPTION)
        command.add_options(parser)
        options = [o for action in parser._actions for o in action.option_strings]
        assert [o for o in options if o not in text] == [], name


def test_the_reference_names_everything_that_the_code_has(site: Path) -> None:
    python = words_of(site / "reference/python.html")
    assert [n for n in vaneloop.__all__ if f"{n}(" not in python] == []
    can = words_of(site / "reference/can.html")
    database = cantools.database.load_file(path("vgv.dbc"))
    assert [s.name for m in database.messages for s in m.signals if s.name not in can or m.name not in can] == []
    numbers = words_of(site / "reference/calibration.html")
    for values in load_toml(path("calibration.toml")).values():
        assert [k for k in values if k not in numbers] == []
    laws = words_of(site / "reference/laws.html")
    assert [n for group in LAWS.values() for n in group if n not in laws] == []
    scenarios = words_of(site / "reference/scenarios.html")
    assert [n for n in library() | library(2) if n not in scenarios] == []


def test_the_page_of_the_json_has_the_keys_that_a_command_writes(site: Path) -> None:
    text = words_of(site / "reference/json.html")
    for key in ("verdict", "stages[].noise_floor", "effects[].probability", "effects[].parameters.half_width.value"):
        assert key in text, key


def test_no_heading_of_a_table_is_without_words(site: Path) -> None:
    assert [p.name for p in site.rglob("*.html") if re.search(r"<th[^>]*></th>", p.read_text(encoding="utf-8"))] == []


def test_the_search_finds_options_and_effects_and_nothing_is_fetched(site: Path) -> None:
    index = json.loads((site / "search/search_index.json").read_text(encoding="utf-8"))
    found = {d["location"].split("#")[0] for d in index["docs"] if "valve_dead_band" in d["text"] + d["title"]}
    assert {"effects.html", "tutorial.html"} <= found
    assert any("--design-rpm" in d["text"] for d in index["docs"] if d["location"].startswith("reference/commands/map"))
    for page in site.rglob("*.html"):
        loads = re.findall(r'(?:src|<link[^>]* href)="(https?:[^"]+)"', page.read_text(encoding="utf-8"))
        assert not loads, f"{page.name}: {loads}"


# what a reader types -> the page that must be among the first three found
SEARCHES = {
    "grey-box": "your_own_model", "system identification": "diagnosis", "identification": "diagnosis",
    "residual": "reading_an_answer", "FMU": "fmu", "FMI": "fmu", "co-simulation": "fmu", "XCP": "xcp",
    "A2L": "xcp", "CANape": "coming_from_inca", "UDS": "uds", "ISO 14229": "uds", "trouble code": "uds",
    "SecOC": "bus", "learn": "learn", "symbolic regression": "learn", "fleet": "fleet",
    "predictive maintenance": "fleet", "Monte Carlo": "campaigns", "failure probability": "campaigns",
    "HIL": "real_time", "SIL": "own_controller", "fault injection": "injection",
    "pandas": "python", "DataFrame": "python", "lookup table": "scheduling", "phase margin": "control_design",
    "backlash": "effects", "valve_dead_band": "effects", "noise floor": "reading_an_answer",
    "confidence interval": "reading_an_answer", "cannot tell": "reading_an_answer",
    "--design-rpm": "reference/commands/", "--system": "reference/commands/", "--tolerance": "reference/commands/",
    "--xcp-open": "reference/commands/run", "--secoc": "reference/commands/", "--shape": "reference/commands/learn",
    ".mf4": "logs", ".blf": "logs", ".parquet": "logs", ".a2l": "xcp", ".fmu": "fmu", ".dbc": "logs",
    "export-fmu": "reference/commands/export-fmu", "new-controller": "reference/commands/new-controller",
    "least squares": "methods", "hysteresis": "effects", "Simulink": "coming_from_simulink",
    "--formula": "reference/commands/map", "calculated channel": "logs", "XY plot": "workbench",
    "CAPL": "coming_from_canoe", "vaneloop.diagnose": "reference",
}  # fmt: skip
# pages of every kind, which are held against axe-core
PAGES = (
    "index", "diagnosis", "add_an_effect", "coming_from_canoe", "workbench", "settings", "notebooks/missing_physics",
    "reference/commands/run", "reference/python",
)  # fmt: skip


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip(WHY_NOT)
    with driver() as p:
        b = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield b
        b.close()


def test_the_search_finds_options_commands_suffixes_and_the_field_s_synonyms(site: Path, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(LONG)
    page.goto((site / "index.html").as_uri())
    field = page.locator("input.md-search__input")

    def asked(words: str, until: str) -> list[str]:
        """The first three pages found."""
        field.click()
        field.fill(words)
        field.press("Shift")  # the search looks when a key goes up
        page.wait_for_function(f"() => document.querySelectorAll('.md-search-result__item').length {until}")
        return page.evaluate(
            "[...document.querySelectorAll('.md-search-result__item > a')].slice(0, 3)"
            ".map((a) => new URL(a.href).pathname)"
        )

    missed = {}
    for words, wanted in SEARCHES.items():
        asked("zzzqqq", "=== 0")
        found = asked(words, "> 0")
        if not any(p.removeprefix(f"{site.as_posix()}/").startswith(wanted) for p in found):
            missed[words] = found
    page.context.close()
    assert not missed and len(SEARCHES) >= 40


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_site_is_open_to_all(site: Path, browser: Any, scheme: str) -> None:
    context = browser.new_context(color_scheme=scheme)
    page = context.new_page()
    page.set_default_timeout(LONG)
    for width in (1280, 360):
        page.set_viewport_size({"width": width, "height": 900})
        for name in PAGES:
            page.goto((site / f"{name}.html").as_uri())
            page.wait_for_function(
                "document.querySelectorAll('.md-typeset pre').length === "
                "document.querySelectorAll('.md-typeset pre .md-code__nav[aria-label]').length"
            )
            assert not violations(page), f"{name} at {width}, {scheme}"
    context.close()


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A checkout with one page only, and a build that makes no reference."""
    (tmp_path / "docs").mkdir()
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    settings = re.sub(
        r"^nav:.*", "nav: [index.md]\n", settings.replace("hooks: [docs/site/hooks.py]", ""), flags=re.S | re.M
    )
    (tmp_path / "mkdocs.yml").write_text(settings, encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize("wrong", ["[no page](gone.md)", "[no anchor](#gone)", "![no picture](pictures/gone.png)"])
def test_a_dead_link_fails_the_build(small: Path, wrong: str) -> None:
    (small / "docs/index.md").write_text(f"# Home\n\n{wrong}\n", encoding="utf-8")
    done = build(small, small / "out")
    assert done.returncode != 0 and "gone" in done.stderr


def test_a_page_without_a_line_in_the_navigation_gets_its_place() -> None:
    sys.path.insert(0, str(ROOT / "docs/site"))
    try:
        from hooks import placed  # type: ignore[import-not-found]
    finally:
        sys.path.remove(str(ROOT / "docs/site"))
    parts = [{"Tutorial": []}, {"How-to guides": [{"Worked examples": ["examples_a.md"]}]}, {"Explanation": []}]
    nav = placed(
        [*parts, {"Reference": [{"Commands": "reference/commands/"}]}],
        ["examples_a.md", "examples_b.md", "new.md", "decisions/new.md", "reference/commands/run.md"],
    )
    assert nav == [
        {"Tutorial": []},
        {"How-to guides": [{"Worked examples": ["examples_a.md", "examples_b.md"]}, {"More": ["new.md"]}]},
        {"Explanation": [{"Decisions": ["decisions/new.md"]}]},
        {"Reference": [{"Commands": ["reference/commands/run.md"]}]},
    ]
