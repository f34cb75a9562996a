"""The closed loop against the same loop written by hand in C (benchmarks/loop.c): every bit of every logged signal."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.in_c import BITWISE, FAST, CLoop
from benchmarks.ours import COLUMNS, OurLoop, Setup, profile, troubled
from controller import MODES, load_calibration
from hil.loop.lockstep import Stimulus

SECONDS = 130.0


def sensor_noise(ticks: int, spiked: bool) -> np.ndarray:
    """Standard normal numbers; ``spiked``: with an LVDT that jumps, leaves its range, gives no number, and stands
    still.
    """
    noise = np.random.Generator(np.random.PCG64(7)).standard_normal((ticks, 5))
    if spiked:
        at = 1000 * np.array([5, 12, 26, 40, 60])
        noise[at[0], 0] = 1e5  # one sample
        noise[at[1] : at[1] + 8, 0] = np.nan
        noise[at[2] : at[2] + 400, 0] = np.inf
        noise[at[3] : at[3] + 300 : 3, 0] = 400.0  # 2 mm, again and again
        noise[at[4] : at[4] + 2000, 0] += 800.0  # a step of 4 mm for two seconds
    return noise


def both(
    setup: Setup, gcc: str, noise: np.ndarray | None = None, flags: tuple[str, ...] = BITWISE
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the product and of C."""
    rows = [np.zeros((-(-setup.ticks // setup.every), len(COLUMNS))) for _ in range(2)]
    loops = OurLoop(setup), CLoop(setup, flags, gcc)
    for loop, out in zip(loops, rows, strict=True):
        loop.advance(out, noise)
    assert loops[0].faults == loops[1].faults
    return rows[0], rows[1]


def assert_same_bits(ours: np.ndarray, c: np.ndarray) -> None:
    """Fail with the first signal and time that differ."""
    differs = ours.view(np.int64) != c.view(np.int64)
    differs &= ~(np.isnan(ours) & np.isnan(c))  # which NaN it is says nothing
    for i, name in enumerate(COLUMNS):
        if differs[:, i].any():
            k = int(np.argmax(differs[:, i]))
            pytest.fail(f"{name} differs from t = {ours[k, 0]:.3f} s on: {ours[k, i]!r}, in C {c[k, i]!r}")


@pytest.mark.parametrize("strategy", ["dual", "single"])
@pytest.mark.parametrize("noisy", [False, True], ids=["silent", "noisy"])
def test_rises_and_falls_are_the_same_bits_as_in_c(gcc: str, noisy: bool, strategy: str) -> None:
    setup = Setup(Stimulus.of(profile(SECONDS)), load_calibration(strategy=strategy), noisy=noisy)
    ours, c = both(setup, gcc, sensor_noise(setup.ticks, spiked=False) if noisy else None)
    assert_same_bits(ours, c)
    assert np.ptp(ours[:, COLUMNS.index("x_lvdt")]) > 20e-3


@pytest.mark.parametrize("spiked", [False, True], ids=["bus", "bus and LVDT"])
def test_faults_are_the_same_bits_as_in_c(gcc: str, spiked: bool) -> None:
    setup = Setup(troubled(SECONDS), noisy=spiked)
    ours, c = both(setup, gcc, sensor_noise(setup.ticks, spiked=True) if spiked else None)
    assert_same_bits(ours, c)
    assert {MODES[int(m)] for m in ours[:, COLUMNS.index("state")]} >= {"STANDBY", "RUN", "DEGRADED", "FAIL_SAFE"}


def test_every_tick_from_switching_on_is_the_same_bits_as_in_c(gcc: str) -> None:
    setup = Setup(troubled(25.0), noisy=True, every=1, warm_up=0)
    assert_same_bits(*both(setup, gcc, sensor_noise(setup.ticks, spiked=True)))


def test_contracted_c_differs_by_rounding_only(gcc: str) -> None:
    setup = Setup(Stimulus.of(profile(SECONDS)))
    ours, c = both(setup, gcc, flags=FAST)
    one_count = float(setup.plant.table.sensors.lvdt_range.value) * 1e-3 / 2**16
    assert np.abs(ours - c)[:, COLUMNS.index("x_lvdt")].max() <= 2.0 * one_count
