"""Prose that can be read: no sentence over 38 words and no line over 160 characters in README.md and docs/."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from tests.conftest import ROOT

WORDS, COLUMNS = 38, 160
PAGES = ["README.md", "SECURITY.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md"))]

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\([^()\s]*(?:\([^()]*\)[^()\s]*)*\)")
_BEGINS = re.compile(r"\s*(?:[-*+] |\d+\. |#|\||>|!!!|\?\?\?|:\s)")
_END = re.compile(r"(?<!\be\.g\.)(?<!\bi\.e\.)(?<!\bNo\.)(?<!\bvs\.)(?<=[.!?])[\"”)*_]*\s+|<br>")


def blocks(text: str) -> Iterator[tuple[int, str]]:
    """Paragraphs, list items, headings and cells of tables with the line that they begin in; code left out."""
    code, begun, words = False, 0, ""
    for number, line in enumerate([*text.splitlines(), ""], 1):
        fence = line.lstrip().startswith("```")
        if fence or code or not line.strip() or _BEGINS.match(line):
            if words:
                yield begun, words
            words = ""
        if fence:
            code = not code
        elif code or not line.strip() or (line.startswith("    ") and not words):  # four blanks: code, an equation
            continue
        elif line.lstrip().startswith("|"):
            yield from ((number, cell) for cell in re.split(r"(?<!\\)\|", line.strip().strip("|")))
        else:
            begun = begun if words else number
            words = f"{words} {line.strip()}"


def sentences(block: str) -> list[str]:
    """Sentences of a paragraph, heading or cell; code counts as one word, a link as its text."""
    plain = re.sub(r"`[^`]*`", "CODE", block)
    plain = _LINK.sub(lambda m: "" if m[1] else m[2], plain)
    return [s for s in _END.split(plain) if s.strip()]


def complaints(text: str) -> list[str]:
    """What is too long in a page, one line each."""
    out = [
        f"{n}: {len(line)} characters, at most {COLUMNS}"
        for n, line in enumerate(text.splitlines(), 1)
        if len(line) > COLUMNS
    ]
    for number, block in blocks(text):
        for sentence in sentences(block):
            words = re.findall(r"[^\s]*\w[^\s]*", sentence)
            if len(words) > WORDS:
                out.append(f"{number}: {len(words)} words, at most {WORDS}: {' '.join(words[:6])} ...")
    return out


@pytest.mark.parametrize("page", PAGES)
def test_sentences_and_lines_are_short(page: str) -> None:
    found = complaints((ROOT / page).read_text(encoding="utf-8"))
    assert not found, "\n" + "\n".join(f"{page}:{c}" for c in found)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("an " * 38 + "\n", 0),
        ("an " * 39 + "\n", 1),
        ("an " * 20 + "end. " + "an " * 20 + "\n", 0),
        ("word " * 20 + "\n" + "word " * 20 + "\n", 1),  # a sentence goes on over the end of a line
        ("- " + "word " * 20 + "\n- " + "word " * 20 + "\n", 0),
        ("| " + "word " * 20 + "| " + "word " * 20 + "|\n", 1),  # the row is too long, its sentences are not
        ("```\n" + "an " * 45 + "\n```\n", 0),
        ("x" * 161 + "\n", 1),
    ],
)
def test_what_is_too_long_is_seen(text: str, found: int) -> None:
    assert len(complaints(text)) == found, complaints(text)
