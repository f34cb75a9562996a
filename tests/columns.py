"""The firmware on rows of numbers, as tests like it: columns by name, and its parts as functions of float64 arrays.

``log[:, MODE]`` of logged states, ``rows[:, IN_N_DEM]`` of inputs. `controller.records` has the order; this names it.
"""

from __future__ import annotations

from numba import njit

from controller import load_calibration, monitors, new_state, records, schedule, servo, strategies, tick, trend
from controller.records import FAULTS, INPUTS, SCALARS, STATE
from controller.schedule import look_up

__all__ = [
    "FAR", "FAULTS", "INPUTS", "SCALARS", "STATE", "filter_pots", "follow_play", "inverse_step", "judge_pot", "learn",
    "load_calibration", "look_up", "move_demand", "new_state", "observe_speed", "schedule_step", "servo_step", "tick",
    "trend_step",
]  # fmt: skip

SHORT = {"demand_fresh": "fresh", "demand_rejected": "rejected", "faults": "fault_bits"}
FAR = monitors.FAR


def named(prefix: str, names: tuple[str, ...]) -> dict[str, int]:
    """Column of each number; of those that every vane stage has, that of the first stage, too."""
    out: dict[str, int] = {}
    for i, name in enumerate(names):
        out[f"{prefix}{SHORT.get(name, name)}".upper()] = i
        out.setdefault(f"{prefix}{name.removesuffix('_vigv')}".upper(), i)
    return out


for module in (records, schedule, strategies):
    globals().update({n: v for n, v in vars(module).items() if n.isupper()})
globals().update(named("", SCALARS) | named("IN_", INPUTS) | named("", STATE))
N_INPUTS, N_SCALARS, N_STATE = len(INPUTS), len(SCALARS), len(STATE)


on_rows = njit(error_model="numpy")


@on_rows
def trend_step(z, k, n_dem):  # noqa: D103
    trend.trend_step(records.as_state(z), records.as_scalars(k), n_dem)


@on_rows
def schedule_step(z, k, table):  # noqa: D103
    schedule.schedule_step(records.as_state(z), records.as_scalars(k), table)


@on_rows
def move_demand(z, k, target, rate):  # noqa: D103
    schedule.move_demand(records.as_state(z), records.as_scalars(k), target, rate)


@on_rows
def servo_step(z, k, x_ref, dx_ref):  # noqa: D103
    servo.servo_step(records.as_state(z), records.as_scalars(k), x_ref, dx_ref)


@on_rows
def observe_speed(z, k):  # noqa: D103
    strategies.observe_speed(records.as_state(z), records.as_scalars(k))


@on_rows
def follow_play(z, stage, drive, width):  # noqa: D103
    strategies.follow_play(records.as_state(z), stage, drive, width)


@on_rows
def inverse_step(z, k, table, angles):  # noqa: D103
    strategies.inverse_step(records.as_state(z), records.as_scalars(k), table, angles)


@on_rows
def learn(z, k):  # noqa: D103
    strategies.learn(records.as_state(z), records.as_scalars(k))


@on_rows
def judge_pot(z, k, stage, expected, plausible):  # noqa: D103
    strategies._judge_pot(records.as_state(z), records.as_scalars(k), stage, expected, plausible)


@on_rows
def filter_pots(z, k, inputs):  # noqa: D103
    strategies.filter_pots(records.as_state(z), records.as_scalars(k), records.as_inputs(inputs))
