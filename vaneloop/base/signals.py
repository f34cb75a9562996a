"""Names and units of the signals at every border: logs, CAN, tables, command line, plots (docs/architecture.md)."""

from vaneloop.base.vanes import VANES

__all__ = ["UNITS"]

UNITS = {
    "n_dem": "%", "n_r": "%", "x_dem": "mm", "x_lvdt": "mm", "i_cmd": "mA", "p_s": "MPa", "t_oil": "degC",
    **dict.fromkeys(VANES, "deg"), "state": "-",
}  # fmt: skip
