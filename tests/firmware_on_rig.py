"""The product's firmware, handed to the independent rig."""

from __future__ import annotations

from dataclasses import replace

from controller import Calibration, load_calibration, new_inputs, new_state, tick
from controller.firmware import (
    I_CMD,
    IN_FRESH,
    IN_MODE_REQUEST,
    IN_N_DEM,
    IN_N_R,
    IN_X_LVDT,
    KFF,
    KI,
    KP,
    MODE,
    ROW_EXTENSION,
    ROW_RETRACTION,
    ROW_SINGLE,
    TREND_CHANGE,
    TREND_RATE_ON,
    X_DEM,
)
from tests.rig import Compiled

__all__ = ["firmware"]


def firmware(calibration: Calibration | None = None) -> Compiled:
    """Return the controller as the rig takes it; controller errors are put into its calibration."""
    cal = calibration or load_calibration()
    inputs = new_inputs()
    out = Compiled(
        tick=tick, inputs=inputs, state=new_state(), calibration=cal, n_dem=IN_N_DEM, n_r=IN_N_R, x_lvdt=IN_X_LVDT,
        fresh=IN_FRESH,
        i_cmd=I_CMD, x_dem=X_DEM, mode=MODE, mode_request=IN_MODE_REQUEST,
    )  # fmt: skip

    def change(name: str, parameters: dict[str, float]) -> Compiled:
        k, table = cal.k.copy(), cal.table.copy()
        if name == "schedule_error":
            table[[ROW_EXTENSION, ROW_RETRACTION, ROW_SINGLE]] += parameters["offset"]
        elif name == "trend_threshold_error":
            k[[TREND_RATE_ON, TREND_CHANGE]] *= parameters["factor"]
        else:
            k[[KP, KI, KFF]] *= parameters["factor"]
        return replace(out, calibration=cal._replace(k=k, table=table), change=None)

    return replace(out, change=change)
