"""Records and tables of the controller by their specification: layouts, views of the same memory, what tables allow."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from controller import header, records
from controller.calibration import AngleTable, CalibrationTable, Schedule, StrokeTable, new_inputs
from vaneloop.base.tables import read

VIEWS = {
    "inputs": (records.as_inputs, records.INPUT_FIELDS), "outputs": (records.as_outputs, records.OUTPUT_FIELDS),
    "scalars": (records.as_scalars, records.SCALAR_FIELDS), "state": (records.as_state, records.STATE_FIELDS),
}  # fmt: skip


@pytest.mark.parametrize("name", VIEWS)
def test_a_row_is_seen_as_its_record_and_a_record_as_itself(name: str) -> None:
    view, fields = VIEWS[name]
    names = records.flat_names(fields)
    row = np.arange(1.0, len(names) + 1.0)
    seen = view(row)
    assert view(seen) is seen and seen.dtype.names == tuple(f.name for f in fields)
    assert records.flat(seen).tolist() == row.tolist() and np.shares_memory(records.flat(seen), row)
    first = fields[0].name
    setattr(seen, first, -7.0)
    assert row[0] == -7.0


@pytest.mark.parametrize("name", VIEWS)
def test_compiled_code_sees_the_same_and_refuses_a_row_that_is_too_short(name: str) -> None:
    view, fields = VIEWS[name]
    last = next(f.name for f in fields[::-1] if not f.each)
    namespace: dict[str, object] = {"view": view}
    exec(f"def of(row):\n    return view(row).{last}\n", namespace)
    of = njit(namespace["of"])
    row = np.arange(float(len(records.flat_names(fields))))
    assert of(row) == of(view(row)) == row[records.flat_names(fields).index(last)]
    with pytest.raises(ValueError, match=f"a row must have at least {len(row)} numbers"):
        of(row[:-1])
    with pytest.raises(Exception, match="view"):
        of(row[::2])  # numbers that do not stand beside each other are no record


def test_the_rows_of_a_state_are_nobody_s_to_change() -> None:
    for stages in (1, 3, 8):
        rows = records.state_rows(stages)
        assert not rows.flags.writeable and rows is records.state_rows(stages)
    assert len(records.state_rows(8)) == len(records.STATE) > len(records.state_rows(3))


def test_a_controller_is_asked_to_run_before_anything_has_come() -> None:
    inputs = records.as_inputs(new_inputs())
    assert inputs.mode_request == 1.0 and np.isnan(inputs.pots).all() and inputs.n_dem == 0.0


def test_the_interface_of_own_controllers_is_the_first() -> None:
    assert header.VERSION == 1 and "#define VANELOOP_CONTROLLER_VERSION 1u" in header.header()


def changed(name: str, model: type, change: str, values: list[float]) -> object:
    """The shipped table with other values of one axis."""
    shipped = read(name, model).model_dump()
    shipped[change]["values"] = values
    return model.model_validate(shipped)


def test_a_mean_curve_may_touch_the_curves_of_both_directions_and_not_cross_them() -> None:
    shipped = read("stroke_tables.toml", StrokeTable)
    for touched in (shipped.extension.values, shipped.retraction.values):
        changed("stroke_tables.toml", StrokeTable, "single", list(touched))
    for k, beyond in ((-1, shipped.extension.values[-1] + 0.01), (0, shipped.retraction.values[0] - 0.01)):
        values = list(shipped.single.values)
        values[k] = beyond
        with pytest.raises(ValueError, match=r"single.values\[\d+\] .* must lie between retraction .* and extension"):
            changed("stroke_tables.toml", StrokeTable, "single", values)


def test_the_strokes_of_vane_angles_rise() -> None:
    values = list(read("vane_angles.toml", AngleTable).stroke.values)
    for wrong in ([values[1], values[0], *values[2:]], [values[0], values[0], *values[2:]]):
        with pytest.raises(ValueError, match="stroke"):
            changed("vane_angles.toml", AngleTable, "stroke", wrong)


def test_a_curve_of_strokes_may_stay_and_not_fall() -> None:
    shipped = read("stroke_tables.toml", StrokeTable)
    values = list(shipped.extension.values)
    values[-2] = values[-1]
    changed("stroke_tables.toml", StrokeTable, "extension", values)
    values[-1] -= 0.001
    with pytest.raises(ValueError, match=r"extension.values\[\d+\] .* must not be less than the value before it"):
        changed("stroke_tables.toml", StrokeTable, "extension", values)


def test_the_least_stroke_is_less_than_the_greatest() -> None:
    schedule = read("calibration.toml", CalibrationTable).schedule.model_dump()
    for least, allowed in ((schedule["stroke_max"]["value"], False), (schedule["stroke_max"]["value"] - 0.1, True)):
        schedule["stroke_min"]["value"] = least
        if allowed:
            assert Schedule.model_validate(schedule).stroke_min.value == least
        else:
            with pytest.raises(ValueError, match=r"stroke_min \(=.* mm\) must be below stroke_max"):
                Schedule.model_validate(schedule)
