"""Names and units of the signals at every border: logs, CAN, tables, command line, plots (docs/architecture.md)."""

from vaneloop.base.vanes import VANES

__all__ = ["SIDES", "UNITS", "heading"]

SIDES = ("x_lvdt_a", "x_lvdt_b")  # stroke of each of two actuators; x_lvdt is their mean
UNITS = {
    "n_dem": "%", "n_r": "%", "x_dem": "mm", "x_lvdt": "mm", "i_cmd": "mA", "p_s": "MPa", "t_oil": "degC",
    **dict.fromkeys(VANES, "deg"), "state": "-", **dict.fromkeys(SIDES, "mm"),
}  # fmt: skip


def heading(name: str, unit: str) -> str:
    """A quantity as a column or an axis is headed: its unit in brackets, where it has one."""
    return f"{name} [{unit}]" if unit not in ("", "-") else name
