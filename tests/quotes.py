"""Outputs quoted in the pages: words as they are printed, numbers equal to within one of the last digit quoted."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

__all__ = ["absent", "lines_of", "tokens"]

NUMBER = r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])"
PIECES = re.compile(rf"({NUMBER})|((?:(?!{NUMBER})\S)+)")
WALL = re.compile(r"(simulated in) [\d.]+ s")  # how long this machine took
DRAWN = re.compile(r"[\u2500-\u259f]+")  # frames of tables, bars, small curves


def tokens(text: str) -> list[str | tuple[float, float]]:
    """Words, and numbers as their value and what one of their last digit is worth."""
    out: list[str | tuple[float, float]] = []
    for number, word in PIECES.findall(DRAWN.sub(" ", WALL.sub(r"\1", text))):
        if word:
            out.append(word)
            continue
        mantissa, _, exponent = number.replace(",", "").partition("e")
        digits = len(mantissa.partition(".")[2])
        out.append((float(number.replace(",", "")), 10.0 ** (int(exponent or 0) - digits)))
    return out


def _same(quoted: str | tuple[float, float], said: str | tuple[float, float]) -> bool:
    if isinstance(quoted, str) or isinstance(said, str):
        return quoted == said
    return abs(quoted[0] - said[0]) <= quoted[1] * 1.0001


def absent(quoted: str, said: list[str | tuple[float, float]]) -> bool:
    """Whether what is quoted, in the parts that "..." leaves, is not among what was said."""
    return any(
        not any(all(map(_same, part, said[k : k + len(part)])) for k in range(len(said) - len(part) + 1))
        for part in map(tokens, re.split(r"\.\.\.|…", quoted))
        if part
    )


def lines_of(page: Path, ours: tuple[str, ...]) -> Iterator[tuple[int, int, str]]:
    """Lines of output that a page quotes: the block's line, their own, text. Blocks with a language hold none; nor do
    lines that begin with a command of ``ours``, a prompt or a comment.
    """
    text = page.read_text(encoding="utf-8")
    for m in re.finditer(r"^```(\w*)\n(.*?)^```", text, re.M | re.S):
        if m[1]:
            continue
        block = text[: m.start()].count("\n") + 1
        body = re.sub(r'^python -c "\n.*?"\s*$', lambda c: "\n" * c[0].count("\n"), m[2], flags=re.M | re.S)
        goes_on = False
        for k, line in enumerate(body.splitlines()):
            began, goes_on = goes_on, False
            if began or line.split(" ")[0] in ours or line.startswith(("$", "#", ">", "cd ")):
                goes_on = line.endswith("\\")
            elif line.strip():
                yield block, block + 1 + k, line
