"""Times and periods within names of quantities: ``138_s``, ``136986_us``, ``0p8976``. Names have no dot, which parts
place and law.
"""

from __future__ import annotations

import re

__all__ = ["folded", "in_name", "named_lag", "of_name", "period_in_name", "period_of", "within_no_period"]

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


def in_name(seconds: float, digits: int) -> str:
    """A time (s) to so many digits, as a whole number of a unit."""
    time = float(f"{seconds:.{digits}g}")
    unit = next((u for u, size in UNITS.items() if time / size >= 1.0 - 1e-9 and _whole(time / size)), "ns")
    return f"{max(round(time / UNITS[unit]), 1)}_{unit}"


def of_name(name: str, word: str) -> tuple[str, float] | None:
    """Channel and time (s) of a quantity named ``CHANNEL_word_TIME``; None: it is none."""
    found = re.fullmatch(rf"(.+)_{word}_([1-9]\d*)_({'|'.join(UNITS)})", name)
    return (found[1], int(found[2]) * UNITS[found[3]]) if found else None


def named_lag(name: str) -> tuple[str, float] | None:
    """Channel and time constant (s) of a lagged quantity ``CHANNEL_lagged_by_TIME``; None: it is none."""
    return of_name(name, "lagged_by")


def period_of(name: str) -> float:
    """Period (s) of a quantity ``time_every_TIME``, the time within each; 0: it is another one."""
    found = of_name(name, "every")
    return found[1] if found and found[0] == "time" else 0.0


def period_in_name(period: float, digits: int) -> str:
    """A period of what is no time, to so many digits: ``0p8976``, ``1p2e-05`` as ``1p2em05``."""
    return f"{period:.{digits}g}".replace(".", "p").replace("-", "m").replace("+", "")


def folded(name: str) -> tuple[str, float] | None:
    """Channel and period of a quantity ``CHANNEL_every_PERIOD``, what it is within each; of time a time, of another
    channel a number in its unit. None: it is none.
    """
    if period := period_of(name):
        return "time", period
    found = re.fullmatch(r"(.+)_every_(\d+(?:p\d+)?(?:em?\d+)?)", name)
    period = float(found[2].replace("p", ".").replace("m", "-")) if found else 0.0
    return (found[1], period) if found and 0.0 < period < float("inf") else None


def within_no_period(name: str) -> str:
    """A name less the period within which it counts."""
    found = folded(name) or of_name(name, "every")
    return found[0] if found else name


def _whole(x: float) -> bool:
    return abs(x - round(x)) < 1e-10 * x
