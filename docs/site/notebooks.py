"""A notebook as a page: its text, its code, and what the code printed and drew when it was last run. That this is what
it prints now is tested (tests/test_notebooks.py).
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

__all__ = ["page", "pictures"]


def cells(file: Path) -> list[dict[str, Any]]:
    """The cells of a notebook."""
    found: list[dict[str, Any]] = json.loads(file.read_text(encoding="utf-8"))["cells"]
    return found


def printed(cell: dict[str, Any]) -> str:
    """What a cell of code printed."""
    return "".join("".join(output.get("text", "")) for output in cell.get("outputs", []))


def drawn(cell: dict[str, Any]) -> list[bytes]:
    """The pictures of a cell, PNG."""
    data = (output.get("data", {}).get("image/png") for output in cell.get("outputs", []))
    return [base64.b64decode("".join(picture)) for picture in data if picture]


def pictures(file: Path) -> dict[str, bytes]:
    """The pictures of a notebook, by the name under which its page shows them."""
    every = [picture for cell in cells(file) for picture in drawn(cell)]
    return {f"{file.stem}_{k}.png": picture for k, picture in enumerate(every)}


def page(file: Path) -> str:
    """Markdown of a notebook; the file itself stands beside the page, to be opened in Jupyter."""
    out, shown = [], 0
    for cell in cells(file):
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            out.append(text)
            if len(out) == 1:
                out.append(f"This page is a notebook: [{file.name}]({file.name}).")
            continue
        out.append(f"```python\n{text}\n```")
        if told := printed(cell).rstrip():
            out.append(f"```text\n{told}\n```")
        for _ in drawn(cell):
            out.append(f"![What the code above draws]({file.stem}_{shown}.png)")
            shown += 1
    return "\n\n".join(out) + "\n"
