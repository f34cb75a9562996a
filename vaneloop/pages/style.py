"""How pages and figures look: the colours of the roles in light and in dark, the tone of a verdict, numbers for a
reader.
"""

from __future__ import annotations

import bisect
import math
from typing import Any, Literal

import numpy as np

__all__ = [
    "STAGE_ROLES", "THEMES", "TONE_OF", "Rounded", "Tone", "capital", "cell_role", "heat_colour", "interval", "number",
    "painted",
]  # fmt: skip

Tone = Literal["neutral", "good", "bad"]
# colours of the vane stages side by side, VIGV first
STAGE_ROLES = ("measured", "model", "target", "error", "other", "bad", "noise", "text")
TONE_OF: dict[str, Tone] = {"none": "good", "missing": "neutral", "unknown": "bad"}  # verdict of a diagnosis
# Blue and orange stay apart for all common colour-vision deficiencies; both themes keep a contrast above 4.5 on their
# background.
THEMES: dict[str, dict[str, str]] = {
    "light": {
        "measured": "#1f6fc4",
        "model": "#d1560a",
        "target": "#2b8256",
        "error": "#a8327d",
        "noise": "#7a8694",
        "other": "#6a5acd",
        "good": "#2b8256",
        "bad": "#c0322b",
        "muted": "#8c97a3",
        "text": "#1c2530",
        "soft": "#54606d",
        "grid": "#e3e8ed",
        "panel": "#ffffff",
        "heat0": "#f4f7fa",
        "heat1": "#f6b073",
        "heat2": "#a3240f",
    },
    "dark": {
        "measured": "#63abf5",
        "model": "#ff9447",
        "target": "#56c48b",
        "error": "#ef7fc4",
        "noise": "#8a97a6",
        "other": "#a99cf5",
        "good": "#56c48b",
        "bad": "#ff7b72",
        "muted": "#7b8794",
        "text": "#e8edf2",
        "soft": "#a7b3bf",
        "grid": "#2b343e",
        "panel": "#171d24",
        "heat0": "#1d252e",
        "heat1": "#a8571c",
        "heat2": "#ffb38a",
    },
}


def _luminance(colour: str) -> float:
    """Relative luminance of #rrggbb, 0 to 1, as WCAG 2 defines it."""
    r, g, b = (int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    r, g, b = (v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in (r, g, b))
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


def heat_colour(theme: str, level: float) -> str:
    """Colour of a map's cell at ``level`` of its scale, 0 to 1, as Plotly mixes it."""
    c = THEMES[theme]
    low, high, part = (c["heat0"], c["heat1"], 2 * level) if level <= 0.5 else (c["heat1"], c["heat2"], 2 * level - 1)
    mixed = (round((1 - part) * int(low[i : i + 2], 16) + part * int(high[i : i + 2], 16)) for i in (1, 3, 5))
    return "#" + "".join(f"{v:02x}" for v in mixed)


def _on(colour: str) -> str:
    """Black or white, whichever is read better on ``colour``: their contrast is 4.58 or more on any."""
    return "#000000" if _luminance(colour) > 0.179 else "#ffffff"


# levels of a map at which words on its cells change from black to white or back, in one theme or the other
_CHANGES = tuple(
    k / 200 for k in range(1, 201)
    if any(_on(heat_colour(t, k / 200)) != _on(heat_colour(t, (k - 1) / 200)) for t in THEMES)
)  # fmt: skip
for _name, _theme in THEMES.items():
    _theme |= {f"cell{i}": _on(heat_colour(_name, level)) for i, level in enumerate((0.0, *_CHANGES))}


def cell_role(level: float) -> str:
    """Role of the words on a map's cell at ``level`` of its scale, 0 to 1."""
    return f"cell{bisect.bisect_right(_CHANGES, level)}"


def number(value: object, digits: int = 3) -> str:
    """Return ``value`` for a reader: three significant digits, no exponent between 0.001 and 100,000, an en dash for
    nothing.
    """
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, Rounded):
        return value.text
    if isinstance(value, int | np.integer):
        return f"{int(value):,}"
    if isinstance(value, float | np.floating):
        v = float(value)
        if not math.isfinite(v):
            return "–"
        if v == 0:
            return "0"
        if not 1e-3 <= abs(v) < 1e5:
            return f"{v:.{digits - 1}e}"
        shown = float(f"{abs(v):.{digits - 1}e}")  # 9.98 to two digits is 10, not 10.0
        decimals = max(0, digits - 1 - math.floor(math.log10(shown)))
        while decimals > 0 and math.isclose(round(v, decimals - 1), v, rel_tol=1e-12):  # 0.55 as published, not 0.550
            decimals -= 1
        return f"{v:,.{decimals}f}"
    return str(value)


class Rounded(float):
    """A number with the digits that its interval is worth (`interval`)."""

    text: str

    def __new__(cls, value: float, text: str) -> Rounded:
        out = super().__new__(cls, value)
        out.text = text
        return out

    def __str__(self) -> str:
        return self.text


def interval(value: object, low: object, high: object) -> tuple[Rounded, Rounded, Rounded]:
    """A value and the ends of its interval for a reader: all three end at the digit that the interval's width is worth.

    Of the width one digit is shown, two where it begins with 1 or 2; of the value two at least. Without an interval
    they are shown to four digits.
    """
    three = [float(str(v)) for v in (value, low, high)]
    width, sizes = three[2] - three[1], [abs(v) for v in three if math.isfinite(v)]
    if not sizes or max(sizes) == 0.0 or not 0.0 < width < math.inf:
        texts = [f"{v:.4g}" for v in three]
    else:
        lead = math.floor(math.log10(width))
        place = lead - (width / 10.0**lead < 3.0)  # decimal place of the last digit, 10^place
        if three[0] != 0.0 and math.isfinite(three[0]):
            place = min(place, math.floor(math.log10(abs(three[0]))) - 1)
        fixed = 1e-3 <= max(sizes) < 1e5
        texts = [_to_place(v, place) if fixed else _to_place_of_ten(v, place) for v in three]
    first, second, third = (Rounded(v, t) for v, t in zip(three, texts, strict=True))
    return first, second, third


def _to_place(value: float, place: int) -> str:
    """A number to the digit 10^place, or to the unit; zero without a sign."""
    text = f"{value:.{max(0, -place)}f}"
    return text if math.isinf(value) or float(text) else text.removeprefix("-")


def _to_place_of_ten(value: float, place: int) -> str:
    """The same with an exponent."""
    if not math.isfinite(value) or abs(value) < 10.0**place:
        return f"{value:g}" if math.isinf(value) else "0"
    return f"{value:.{math.floor(math.log10(abs(value))) - place}e}"


def capital(text: str) -> str:
    """``text`` as a sentence begins; a name (x_lvdt, engine.lag) stays as it is written."""
    first = text.split(maxsplit=1)[0].rstrip(".,:;") if text.strip() else ""
    return text if any(c in first for c in "._") else text[:1].upper() + text[1:]


def painted(figure: Any, theme: str = "light") -> Any:
    """A figure with the colours of ``theme`` in place of the roles: ``@role`` and ``@role/opacity``."""
    if isinstance(figure, dict):
        return figure if "bdata" in figure else {k: painted(v, theme) for k, v in figure.items()}
    if isinstance(figure, list | tuple):
        return [painted(v, theme) for v in figure]
    if isinstance(figure, str) and figure.startswith("@"):
        role, _, opacity = figure[1:].partition("/")
        colour = THEMES[theme].get(role, figure)
        return f"{colour}{round(255 * float(opacity)):02x}" if opacity else colour
    return figure
