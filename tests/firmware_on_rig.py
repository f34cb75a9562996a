"""The product's firmware, handed to the independent rig."""

from __future__ import annotations

from dataclasses import replace

from controller import Calibration, load_calibration, new_inputs, new_state, tick
from controller.records import as_scalars, flat
from tests.columns import (
    I_CMD,
    IN_FRESH,
    IN_MODE_REQUEST,
    IN_N_DEM,
    IN_N_R,
    IN_X_LVDT,
    MODE,
    ROW_EXTENSION,
    ROW_RETRACTION,
    ROW_SINGLE,
    X_DEM,
)
from tests.rig import Compiled

__all__ = ["firmware"]


def firmware(calibration: Calibration | None = None) -> Compiled:
    """Return the controller as the rig takes it; controller errors are put into its calibration."""
    cal = calibration or load_calibration()
    out = Compiled(
        tick=tick, inputs=new_inputs(), state=new_state(), calibration=cal,
        n_dem=IN_N_DEM, n_r=IN_N_R, x_lvdt=IN_X_LVDT, fresh=IN_FRESH,
        i_cmd=I_CMD, x_dem=X_DEM, mode=MODE, mode_request=IN_MODE_REQUEST,
    )  # fmt: skip

    def change(name: str, parameters: dict[str, float]) -> Compiled:
        k, table = as_scalars(cal.k.copy()), cal.table.copy()
        if name == "schedule_error":
            table[[ROW_EXTENSION, ROW_RETRACTION, ROW_SINGLE]] += parameters["offset"]
        elif name == "trend_threshold_error":
            k.trend_rate_on *= parameters["factor"]
            k.trend_change *= parameters["factor"]
        else:
            k.kp, k.ki, k.kff = (parameters["factor"] * v for v in (k.kp, k.ki, k.kff))
        return replace(out, calibration=cal._replace(k=flat(k), table=table), change=None)

    return replace(out, change=change)
