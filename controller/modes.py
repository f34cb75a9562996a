"""The modes of the controller and every transition between them (docs/controller.md)."""

from __future__ import annotations

from controller.records import (
    DEGRADED,
    DEMAND_MASK,
    FAIL_SAFE,
    HALF_TICK,
    INIT,
    N_FAULTS,
    RUN,
    SERVO_MASK,
    STANDBY,
    STOP_MASK,
    TICK,
    Record,
)
from vaneloop.base.compiled import inlined

__all__ = ["choose_mode"]


@inlined
def cause_present(z: Record, mask: int) -> bool:
    """Is the cause of any fault in ``mask`` there at this tick, rather than gone and the fault healing?"""
    faults = int(z.faults) & mask
    present = False
    for bit in range(N_FAULTS):
        present |= faults & (1 << bit) != 0 and z.timers[bit] == 0.0
    return present


@inlined
def choose_mode(z: Record, k: Record) -> None:
    """Next mode. The transitions that can happen are listed in docs/controller.md; this is all of them."""
    mode = int(z.mode)
    faults = int(z.faults)
    must_stop = (faults & STOP_MASK) != 0
    trouble = (faults & (DEMAND_MASK | SERVO_MASK)) != 0
    wants_run = z.run_request == 1.0
    if mode == INIT:
        if must_stop:
            mode = FAIL_SAFE
        elif z.ticks * TICK >= k.init_time - HALF_TICK and z.lvdt_good == 1.0:
            mode = STANDBY
    elif must_stop:
        mode = FAIL_SAFE
        z.recover_timer = 0.0
    elif mode == STANDBY:
        if wants_run and z.demand_seen == 1.0 and not trouble:
            mode = RUN
    elif mode == RUN:
        if trouble:
            mode = DEGRADED
        elif not wants_run:
            mode = STANDBY
    elif mode == DEGRADED:
        if cause_present(z, DEMAND_MASK | SERVO_MASK):
            z.degraded_timer += TICK
        if not trouble:
            mode = RUN
        elif z.degraded_timer >= k.degraded_hold - HALF_TICK:
            mode = FAIL_SAFE
    elif mode == FAIL_SAFE:
        z.recover_timer = 0.0 if trouble else z.recover_timer + TICK
        if z.recover_timer >= k.recover_time - HALF_TICK:
            mode = RUN if wants_run and z.demand_seen == 1.0 else STANDBY
    if mode != int(z.mode):
        z.recover_timer = 0.0
        z.degraded_timer = 0.0
        if mode == STANDBY or mode == FAIL_SAFE or int(z.mode) == INIT or int(z.mode) == STANDBY:
            z.x_dem = min(max(z.x_meas, k.stroke_min), k.stroke_max)  # bumpless: start from where the piston is
            z.x_from = z.x_dem
    z.mode = float(mode)
