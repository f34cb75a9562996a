"""The closed loop as a user of python-control writes it: two discrete-time blocks, interconnected, and
`input_output_response`.

The library's best case: one block for the controller, one for the machine, one sampling time of 1 ms (the ten plant
steps of 0.1 ms run inside the machine's block), and blocks that call the product's own compiled functions, so that what
is measured is the library's share.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from benchmarks.ours import OurLoop, Setup
from controller import STATE, flat, new_inputs, tick
from controller.records import STATE_FIELDS, as_inputs, record
from plant import chain, places

__all__ = ["SIGNALS", "run"]

SIGNALS = ("n_engine", "x_dem", "x_lvdt", "vigv", "vgv1", "vgv2")


@njit(cache=True)
def machine_step(s, p, i_cmd, n_dem, p_s, t_oil):
    """Engine, valve, actuator, LVDT, linkage and potentiometers: one tick."""
    chain.rotor_step(s, p, 0, n_dem)
    chain.drive_step(s, p, 0, i_cmd, n_dem, p_s, t_oil)
    chain.vane_step(s, p, 0, n_dem, t_oil)


@njit(cache=True)
def lvdt_sample(s, p):
    """Sample of the LVDT, m."""
    return chain.sample_lvdt(s, p, 0, 0.0)


def run(setup: Setup) -> np.ndarray:
    """Simulate the setup from the state after its warm-up; return `SIGNALS` in SI, a row every 10 ms."""
    import control

    cal, p, rows = setup.calibration, setup.plant.p, setup.stimulus.rows
    p_s, t_oil = rows[0, 2], rows[0, 3]
    inputs = as_inputs(new_inputs())

    def ticked(z, u):
        inputs.n_dem, inputs.n_r, inputs.demand_fresh, inputs.x_lvdt = u
        state = record(STATE_FIELDS, z.copy())
        tick(inputs, state, cal)
        return state

    def firmware_output(t, z, u, params):
        z = ticked(z, u)
        return np.array([z.i_cmd, z.x_dem])

    def machine_update(t, s, u, params):
        i_cmd, n_dem = u
        s = s.reshape(-1, 1).copy()
        machine_step(s, p, i_cmd, n_dem, p_s, t_oil)
        return s[:, 0]

    def machine_output(t, s, u, params):
        return np.array(
            [s[places.N_R], lvdt_sample(s.reshape(-1, 1), p), s[places.POT], s[places.POT + 1], s[places.POT + 2]]
        )

    firmware = control.NonlinearIOSystem(
        lambda t, z, u, params: flat(ticked(z, u)),
        firmware_output,
        name="firmware",
        inputs=["n_dem", "n_r", "fresh", "x_lvdt"],
        outputs=["i_cmd", "x_dem"],
        states=len(STATE),
        dt=chain.TICK,
    )
    machine = control.NonlinearIOSystem(
        machine_update,
        machine_output,
        name="machine",
        inputs=["i_cmd", "n_dem"],
        outputs=["n_r", "x_lvdt", "vigv", "vgv1", "vgv2"],
        states=chain.N_STATE,
        dt=chain.TICK,
    )
    loop = control.interconnect(
        [firmware, machine],
        inputs=["n_dem", "fresh"],
        outputs=["n_r", "x_dem", "x_lvdt", "vigv", "vgv1", "vgv2"],
        name="loop",
    )
    t = np.arange(setup.ticks) * chain.TICK
    fresh = (np.arange(setup.ticks) % 10 == 0).astype(float)
    start = OurLoop(setup)
    x0 = np.concatenate([start.loop.z, start.loop.s[:, 0]])
    response = control.input_output_response(loop, t, np.array([np.repeat(rows[:, 0], 10), fresh]), x0)
    return response.outputs[:, ::10].T
