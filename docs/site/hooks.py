"""What MkDocs asks while it builds the site: pages made from the code, notebooks as pages, a place for every page, and
what its search and a screen reader need.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]  # this checkout is described, whatever is installed

import notebooks  # noqa: E402
import reference  # noqa: E402
from mkdocs.config.defaults import MkDocsConfig  # noqa: E402
from mkdocs.exceptions import PluginError  # noqa: E402
from mkdocs.structure.files import File, Files  # noqa: E402
from mkdocs.structure.pages import Page  # noqa: E402
from mkdocs.utils import get_relative_url  # noqa: E402

COMMANDS = "reference/commands/"
WORKER = "https://unpkg.com/iframe-worker/shim"  # Material would fetch this when the site is read from a folder
OURS = "assets/iframe_worker.js"
# how a page's name begins -> the part and the section of `nav` that it joins when it has no line there
PLACES = {
    "decisions/": ("Explanation", "Decisions"),
    "notebooks/": ("Tutorial", "Notebooks"),
    "examples_": ("How-to guides", "Worked examples"),
    "coming_from_": ("How-to guides", "Coming from another tool"),
    "": ("How-to guides", "More"),
}
SYNONYMS = tomllib.loads((ROOT / "docs/site/search_words.toml").read_text("utf-8"))  # page -> words that lead to it
# Material's search takes "--design-rpm" for words that a page must not have. It is asked for the pages of the commands
# that have the option, which `tagged` gives a word for each, and for its words.
ASKED = "e=ce(e)"
MEANT = (
    r'e=ce(e.replace(/(^|\s)--(\w[\w-]*)/g,(m,a,n)=>a+"option_"+n.replace(/-/g,"_")+" "+n)'
    r'.replace(/(^|\s)-+(?=\S)/g,"$1"))'
)
# a file of the checkout -> the page that is made from it, to which a link to it leads on the site
MADE_FROM = {
    "tables/vgv.dbc": "reference/can.md",
    "tables/calibration.toml": "reference/calibration.md",
    "vaneloop/cli/main.py": "reference/index.md",
    "vaneloop/identification/candidates/library.py": "reference/laws.md",
}
# what a screen reader is not told: markup as Material writes it -> with a name, or reached by keyboard
UNNAMED = {
    'data-md-component="search" role="dialog"': 'data-md-component="search" role="dialog" aria-label="Search"',
    "<th></th>": "<td></td>",  # a heading without words is none
    '<nav class="md-nav" aria-label="': '<nav class="md-nav" aria-label="On this page: ',  # a page may have that name
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that no file holds, then give each page its place."""
    made: dict[str, str | bytes] = {**reference.pages(), OURS: (ROOT / "docs/site/iframe_worker.js").read_text("utf-8")}
    for file in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        made[f"notebooks/{file.stem}.md"] = notebooks.page(file)
        made |= {f"notebooks/{name}": picture for name, picture in notebooks.pictures(file).items()}
    for name, content in made.items():
        files.append(File.generated(config, name, content=content))
    config.nav = placed(config.nav or [], [f.src_uri for f in files.documentation_pages()])
    return files


def placed(nav: list[Any], pages: list[str]) -> list[Any]:
    """`nav` with the commands written out, and with a line for every page that it has not."""
    commands = [p for p in pages if p.startswith(COMMANDS)]  # in the order of the help
    there = set(re.findall(r"'([\w./-]+\.md)'", str(nav))) | set(commands)
    parts = {name: sections for part in nav if isinstance(part, dict) for name, sections in part.items()}
    for line in parts["Reference"]:
        if isinstance(line, dict) and line.get("Commands") == COMMANDS:
            line["Commands"] = commands
    for page in sorted(p for p in pages if p not in there):
        part, section = next(place for begins, place in PLACES.items() if page.startswith(begins))
        sections = {name: lines for s in parts[part] if isinstance(s, dict) for name, lines in s.items()}
        if section not in sections:
            sections[section] = []
            parts[part].append({section: sections[section]})
        sections[section].append(page)
    return nav


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """A link to a file from which a page is made leads to that page, on the site; of a link to another file outside of
    docs/ the text stays. Lists get the blank line that Markdown of the site wants before them.
    """
    page.meta["tags"] = tagged(page.file.src_uri)
    up = "../" * (page.file.src_uri.count("/") + 1)
    for file, made in MADE_FROM.items():
        markdown = markdown.replace(f"]({up}{file})", f"]({up.removeprefix('../')}{made})")
    markdown = re.sub(r"\]\(((?:\.\./)*notebooks/\w+)\.ipynb\)", r"](\1.md)", markdown)
    markdown = re.sub(rf"\[([^\]]+)\]\({re.escape(up)}[^)]*\)", r"\1", markdown)
    return spaced(markdown)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Nothing is fetched from elsewhere: the site has its own copy of what its search needs."""
    return named(output).replace(WORKER, get_relative_url(OURS, page.url))


def on_post_template(output_content: str, template_name: str, config: MkDocsConfig) -> str:
    """The same for pages that no Markdown stands behind."""
    return named(output_content).replace(WORKER, f"/{OURS}")


def on_post_build(config: MkDocsConfig) -> None:
    """Let the search take an option for its words."""
    (worker,) = Path(config.site_dir).glob("assets/javascripts/workers/search.*.min.js")
    text = worker.read_text("utf-8")
    if text.count(ASKED) != 1:
        raise PluginError(f"{worker.name}: {ASKED!r} is not there once; the search would not find options")
    worker.write_text(text.replace(ASKED, MEANT), "utf-8")


def tagged(page: str) -> list[str]:
    """Words by which the search finds a page beside its own: synonyms, and of a command's page its options."""
    options = reference.options_of(Path(page).stem) if page.startswith(COMMANDS) else []
    return [*SYNONYMS.get(page, []), *(f"option_{o.lstrip('-').replace('-', '_')}" for o in options)]


def named(output: str) -> str:
    """A page whose parts have the names that a screen reader tells."""
    for plain, better in UNNAMED.items():
        output = output.replace(plain, better)
    return output


def spaced(markdown: str) -> str:
    """A blank line before each list that follows a paragraph at once, as GitHub allows and Python-Markdown does not."""
    out: list[str] = []
    code = False
    item = re.compile(r"(?:[-*+]|\d+\.) ")
    for line in markdown.splitlines():
        code ^= line.lstrip().startswith("```")
        before = out[-1] if out else ""
        if not code and item.match(line) and before.strip() and not item.match(before) and not before.startswith(" "):
            out.append("")
        out.append(line)
    return "\n".join(out) + "\n"
