"""Records and tables of the controller by their specification: layouts, views of the same memory, what tables allow."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from controller import header, records
from controller.calibration import (
    AngleTable,
    CalibrationTable,
    Schedule,
    StrokeTable,
    load_calibration,
    new_inputs,
    new_outputs,
    new_state,
    scalars_in,
)
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


OWN = (records.Field("a", "m", "one"), records.Field("b", "m", "two", ("b_1", "b_2")), records.Field("c", "m", "last"))


def test_a_view_made_now_is_compiled_as_it_runs() -> None:
    """Only rows of float64 that stand beside each other are records; a record is one already."""
    view = records.viewer(OWN)
    row = np.arange(1.0, 5.0)
    assert view(row).c == 4.0 and view(view(row)).b.tolist() == [2.0, 3.0] and not isinstance(view(row), np.ndarray)

    @njit(cache=False)
    def sum_of(row):  # type: ignore[no-untyped-def]
        seen = view(row)
        seen.a += 10.0
        return seen.a + 100.0 * view(seen).b[1] + 1000.0 * seen.c

    assert sum_of(row) == 11.0 + 300.0 + 4000.0 and row[0] == 11.0
    assert sum_of(view(row)) == 21.0 + 300.0 + 4000.0 and row[0] == 21.0
    assert sum_of(np.arange(1.0, 9.0)) == 4311.0  # the first of a longer row
    for short in (row[:-1], row[:0]):
        with pytest.raises(ValueError, match="a row must have at least 4 numbers"):
            sum_of(short)
    for wrong in (row.astype(np.float32), row[::-1], row.reshape(2, 2), 1.0):
        with pytest.raises(TypingError, match="view"):
            sum_of(wrong)


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


FACTORS = {"mm": 1e-3, "mm/s": 1e-3, "mA": 1e-3, "deg": np.pi / 180.0, "deg/s": np.pi / 180.0}


def test_every_scalar_is_flashed_in_si() -> None:
    table, k = read("calibration.toml", CalibrationTable), load_calibration().scalars
    of_one = [section for section in type(table).model_fields if section != "channels"]
    named = {key: q for section in of_one for key, q in getattr(table, section) if hasattr(q, "unit")}
    assert len(named) > 40 and [s.key for s in scalars_in(table)] == list(named)
    for s in scalars_in(table):
        q = named[s.key]
        assert (s.value, s.unit, s.si) == (q.value, q.unit, pytest.approx(FACTORS.get(q.unit, 1.0), rel=1e-15))
        assert s.low <= s.value <= s.high and getattr(k, s.key) == pytest.approx(q.value * FACTORS.get(q.unit, 1.0))
    angles = read("vane_angles.toml", AngleTable)
    assert k.play[:3] == pytest.approx([np.deg2rad(getattr(angles, f"play_{v}").value) for v in angles.vanes])
    assert (k.play[3:] == 0.0).all() and k.stages == 3.0


def test_tables_are_flashed_in_si() -> None:
    flashed, stroke = load_calibration(), read("stroke_tables.toml", StrokeTable)
    rows = [
        stroke.speed.values,
        *(1e-3 * np.array(c.values) for c in (stroke.extension, stroke.retraction, stroke.single)),
    ]
    assert flashed.table == pytest.approx(np.array(rows), rel=1e-15)
    angles = read("vane_angles.toml", AngleTable)
    assert flashed.angles[0] == pytest.approx(1e-3 * np.array(angles.stroke.values), rel=1e-15)
    assert flashed.vanes == ("vigv", "vgv1", "vgv2")
    for row, vane in zip(flashed.angles[1:], flashed.vanes, strict=True):
        assert row == pytest.approx(np.deg2rad(getattr(angles, vane).values), rel=1e-15)


@pytest.mark.parametrize("strategy, number", [("single", 0.0), ("dual", 1.0), ("inverse", 2.0), ("adaptive", 3.0)])
def test_a_strategy_is_flashed_as_its_number(strategy: str, number: float) -> None:
    assert load_calibration(strategy=strategy).scalars.strategy == number
    own = read("calibration.toml", CalibrationTable).schedule
    assert load_calibration().scalars.strategy == records.STRATEGIES.index(own.strategy)
    assert load_calibration().scalars.table_input == {"n_r": 0.0, "n_dem": 1.0}[own.table_input]


def schedule_of(**words: str) -> Schedule:
    """The shipped section with other choices."""
    return Schedule.model_validate(read("calibration.toml", CalibrationTable).schedule.model_dump() | words)


def test_choices_in_words_are_those_that_there_are() -> None:
    for name in records.STRATEGIES:
        assert schedule_of(strategy=name).strategy == name
    for name in ("n_r", "n_dem"):
        assert schedule_of(table_input=name).table_input == name
    with pytest.raises(ValueError, match=r"strategy \(='triple'\) must be one of single, dual, inverse, adaptive"):
        schedule_of(strategy="triple")
    with pytest.raises(ValueError, match=r"table_input \(='n'\) must be n_r or n_dem"):
        schedule_of(table_input="n")


def table_with(**values: float) -> CalibrationTable:
    """The shipped scalars with other values."""
    shipped = read("calibration.toml", CalibrationTable).model_dump()
    for section in shipped.values():
        for key in section.keys() & values.keys():
            section[key]["value"] = values[key]
    return CalibrationTable.model_validate(shipped)


STROKES = {"stroke_min": 1.0, "stroke_max": 41.0}


@pytest.mark.parametrize("key, others, good, bad, says", [
    ("fail_safe_stroke", STROKES, (1.0, 20.0, 41.0), (0.9, 41.1), r"in \[1, 41\], stroke_min to stroke_max"),
    ("fail_safe_current", {"current_limit": 30.0}, (-30.0, 0.0, 30.0), (-30.1, 30.1), r"in \[-30, 30\]"),
    ("demand_low", {"demand_high": 60.0}, (59.9,), (60.0, 60.1), r"below demand_high \(=60 %\)"),
    ("lvdt_low", STROKES, (0.9,), (1.0, 1.1), r"below stroke_min \(=1 mm\)"),
    ("lvdt_high", STROKES, (41.1,), (41.0, 40.9), r"above stroke_max \(=41 mm\)"),
    ("stuck_margin", STROKES, (19.9,), (20.0, 20.1), "below 20, half the way"),
    ("pot_low", {"pot_high": 50.0}, (49.9,), (50.0, 50.1), r"below pot_high \(=50 deg\)"),
    ("stuck_current", {"current_limit": 30.0}, (29.9,), (30.0, 30.1), r"below current_limit \(=30 mA\)"),
])  # fmt: skip
def test_values_that_are_possible_one_by_one_must_be_so_together(
    key: str, others: dict[str, float], good: tuple[float, ...], bad: tuple[float, ...], says: str
) -> None:
    fitting = {"fail_safe_stroke": 20.0, "lvdt_low": -1.0, "lvdt_high": 50.0, "stuck_margin": 1.0, "stuck_current": 1.0}
    for value in good:
        table_with(**(fitting | others | {key: value}))
    for value in bad:
        with pytest.raises(ValueError, match=rf"\.{key} \(={value:g} .*\) must be {says}"):
            table_with(**(fitting | others | {key: value}))


def test_curves_have_a_value_at_each_point_and_angles_a_play() -> None:
    for curve in ("extension", "retraction", "single"):
        values = list(getattr(read("stroke_tables.toml", StrokeTable), curve).values)
        with pytest.raises(ValueError, match=rf"{curve}.values has {len(values) - 1} numbers; speed has {len(values)}"):
            changed("stroke_tables.toml", StrokeTable, curve, values[:-1])
    speeds = list(read("stroke_tables.toml", StrokeTable).speed.values)
    with pytest.raises(ValueError, match="speed"):
        changed("stroke_tables.toml", StrokeTable, "speed", [speeds[1], speeds[0], *speeds[2:]])
    angles = read("vane_angles.toml", AngleTable)
    for vane in angles.vanes:
        values = list(getattr(angles, vane).values)
        with pytest.raises(ValueError, match=rf"{vane}.values has {len(values) - 1} numbers; stroke has {len(values)}"):
            changed("vane_angles.toml", AngleTable, vane, values[:-1])
    for lacks in ("vgv2", "play_vgv2"):
        shipped = angles.model_dump()
        shipped[lacks] = None
        with pytest.raises(ValueError, match="vgv2 and play_vgv2 belong together: only one of them is there"):
            AngleTable.model_validate(shipped)


def test_a_controller_switched_on_extends_and_its_piston_may_be_anywhere() -> None:
    z = records.as_state(new_state())
    assert (z.direction, z.blend) == (1.0, 1.0) and z.x_reach > 0.048  # more than the stroke
    others = [n for n in records.STATE if n not in ("direction", "blend", "x_reach")]
    assert all(new_state()[records.STATE.index(n)] == 0.0 for n in others)
    assert new_outputs().tolist() == [0.0] * len(records.OUTPUTS)


def test_a_record_of_numbers_is_in_their_memory() -> None:
    row = np.arange(4.0)
    seen = records.record(OWN, row)
    seen.c = 9.0
    assert row.tolist() == [0.0, 1.0, 2.0, 9.0] and records.flat_names(OWN) == ("a", "b_1", "b_2", "c")
    assert records.flat(records.record(OWN)).tolist() == [0.0] * 4
    assert records.kind(OWN).names == ("a", "b", "c") and records.kind(OWN)["b"].shape == (2,)
