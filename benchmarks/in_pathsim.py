"""The closed loop as a user of pathsim writes it: blocks, connections, a solver with a fixed step.

Engine, valve with actuator and LVDT are differential equations; firmware and linkage are sampled blocks of 1 ms. The
library's best case: few blocks, compiled right-hand sides, and sampled blocks that call the product's own compiled
functions.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from benchmarks.in_control import SIGNALS
from benchmarks.ours import OurLoop, Setup
from controller import new_inputs, tick
from controller.records import as_inputs
from plant import chain, places
from plant import parameters as par

__all__ = ["SIGNALS", "run"]


@njit(cache=True)
def rotor(x, u, lag, acceleration, deceleration):
    """Rate of the rotor speed, %/s."""
    return np.array([min(max((u[0] - x[0]) / lag, -deceleration), acceleration)])


@njit(cache=True)
def drive(x, u, rated, w, damping, gain, lvdt_lag):
    """Rates of spool, spool rate, stroke, LVDT; the spool stays off its stops at small currents."""
    return np.array(
        [x[1], w * w * (u[0] / rated - x[0]) - 2.0 * damping * w * x[1], gain * x[0], (x[2] - x[3]) / lvdt_lag]
    )


@njit(cache=True)
def vanes_step(s, p, stroke):
    """Linkage and potentiometers: one tick at ``stroke`` (m)."""
    s[places.X, 0] = stroke
    chain.vane_step(s, p, 0, 0.0, 0.0)


def run(setup: Setup, step: float, solver: str) -> np.ndarray:
    """Simulate the setup from the state after its warm-up; return `SIGNALS` in SI, a row every 10 ms.

    step: s, of the solver; solver: its name in pathsim.solvers
    """
    import pathsim
    from pathsim import solvers
    from pathsim.blocks import ODE, Scope, Source, Wrapper

    cal, p, rows = setup.calibration, setup.plant.p, setup.stimulus.rows
    start = OurLoop(setup)
    z, s = start.loop.state, start.loop.s
    n_dem, inputs, ticks = rows[:, 0], as_inputs(new_inputs()), [0]
    gain = p[par.FLOW_GAIN, 0] * math.sqrt(rows[0, 2] / p[par.P_REF, 0])
    engine_values = [float(v) for v in p[[par.LAG, par.ACCELERATION, par.DECELERATION], 0]]
    drive_values = [
        float(p[par.RATED_CURRENT, 0]),
        2.0 * math.pi * p[par.BANDWIDTH, 0],
        p[par.DAMPING, 0],
        gain,
        p[par.LVDT_LAG, 0],
    ]

    def firmware(demand, n_r, lvdt):
        lvdt = math.floor(lvdt / p[par.LVDT_STEP, 0] + 0.5) * p[par.LVDT_STEP, 0]
        inputs.n_dem, inputs.n_r, inputs.demand_fresh, inputs.x_lvdt = demand, n_r, float(ticks[0] % 10 == 0), lvdt
        ticks[0] += 1
        tick(inputs, z, cal)
        return z.i_cmd, z.x_dem, lvdt

    linkage_state = s.copy()

    def linkage(x):
        if ticks[0] > 1:  # the state at t = 0 is given
            vanes_step(linkage_state, p, x)
        return tuple(linkage_state[places.POT : places.POT + 3, 0])

    source = Source(lambda t: n_dem[min(int(t * 100.0 + 1e-6), len(n_dem) - 1)])
    engine = ODE(lambda x, u, t: rotor(x, u, *engine_values), np.array([s[places.N_R, 0]]))
    actuator = ODE(
        lambda x, u, t: drive(x, u, *drive_values), s[[places.SPOOL, places.SPOOL_RATE, places.X, places.X_LVDT], 0]
    )
    servo, vanes = Wrapper(firmware, T=1e-3), Wrapper(linkage, T=1e-3)
    scope = Scope(sampling_period=1e-2)
    connections = [
        pathsim.Connection(source, engine, servo),
        pathsim.Connection(engine, servo[1], scope),
        pathsim.Connection(actuator[3], servo[2]),
        pathsim.Connection(actuator[2], vanes),
        pathsim.Connection(servo, actuator),
        pathsim.Connection(servo[1], scope[1]),
        pathsim.Connection(servo[2], scope[2]),
        *[pathsim.Connection(vanes[i], scope[3 + i]) for i in range(3)],
    ]
    blocks = [source, engine, actuator, servo, vanes, scope]
    loop = pathsim.Simulation(blocks, connections, dt=step, Solver=getattr(solvers, solver), log=False)
    loop.run(setup.ticks * 1e-3)
    _, signals = scope.read()
    return signals.T
