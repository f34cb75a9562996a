"""How pages and figures look: the colours of the roles in light and in dark, the tone of a verdict, numbers for a
reader.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

__all__ = ["STAGE_ROLES", "THEMES", "TONE_OF", "Tone", "capital", "number", "painted"]

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
        "cold": "#1f5fae",
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
        "cold": "#6fb1ff",
    },
}


def number(value: object, digits: int = 3) -> str:
    """Return ``value`` for a reader: three significant digits, no exponent between 0.001 and 100,000, an en dash for
    nothing.
    """
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
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
        decimals = max(0, digits - 1 - math.floor(math.log10(abs(v))))
        while decimals > 0 and round(v, decimals - 1) == v:  # 0.55 as published, not 0.550
            decimals -= 1
        return f"{v:,.{decimals}f}"
    return str(value)


def capital(text: str) -> str:
    """``text`` as a sentence begins."""
    return text[:1].upper() + text[1:]


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
