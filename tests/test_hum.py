"""Hum of the mains is taken out of a log, whatever its alias, and nothing that the machine does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.loggers import Logger, recorded
from hil.logs import Channel, Log
from tests.test_recorders import fine, verdicts
from vaneloop.identification.subsystem import Array
from vaneloop.identification.vane_chain.chain import build_chain
from vaneloop.identification.vane_chain.hum import without_hum

NOISE = {"n_r": 0.02, "x_lvdt": 0.01, "i_cmd": 0.02, "vigv": 0.02, "vgv1": 0.02}
GAINS = {"n_r": 1.0, "x_lvdt": 0.5, "i_cmd": 0.2, "vigv": 0.6, "vgv1": 0.7}


def made(seed: int, rate: float, rows: int = 6000, lost: int = 0, **more: Array) -> Log:
    """A log whose channels follow a demand that steps now and then; ``more`` is added to them."""
    rng, t = np.random.default_rng(seed), np.arange(rows) / rate
    steps = np.sort(rng.integers(0, rows, rows // 500))
    n_dem = rng.uniform(60.0, 90.0, len(steps) + 1)[np.searchsorted(steps, np.arange(rows))] + more.get("n_dem", 0.0)
    smooth = np.convolve(n_dem, np.ones(100) / 100.0, "same")
    values = {name: GAINS[name] * smooth + sigma * rng.standard_normal(rows) + more.get(name, 0.0)
              for name, sigma in NOISE.items()} | {"n_dem": n_dem}  # fmt: skip
    keep = np.delete(np.arange(rows), np.r_[1000 : 1000 + lost]) if lost else np.arange(rows)
    return Log("made", {name: Channel(t[keep], v[keep]) for name, v in values.items()})


def swing(rate: float, hz: float, size: float, phase: float = 0.0, rows: int = 6000) -> Array:
    return np.asarray(size * np.sin(2.0 * np.pi * hz * np.arange(rows) / rate + phase))


@given(
    st.integers(0, 2**31), st.sampled_from([20.0, 100.0, 500.0]), st.floats(0.12, 0.44), st.floats(1.0, 3.0),
    st.sampled_from([0, 40]),
)  # fmt: skip
def test_a_line_in_every_channel_is_taken_out(seed: int, rate: float, share: float, size: float, lost: int) -> None:
    """Wherever it is aliased to, with a phase of its own in each channel, also across lost rows."""
    phases = np.random.default_rng(seed).uniform(0.0, 6.0, len(NOISE))
    hum = {
        name: swing(rate, share * rate, size * sigma, p) for (name, sigma), p in zip(NOISE.items(), phases, strict=True)
    }
    clean, log = made(seed, rate, lost=lost), made(seed, rate, lost=lost, **hum)
    out = without_hum(log)
    (note,) = out.notes
    found = float(note.split("a line at ")[1].split(" Hz")[0])
    assert found == pytest.approx(share * rate, abs=2.0 * rate / 6000, rel=1e-3) and "taken out" in note
    for name, sigma in NOISE.items():
        assert np.std(out.channels[name].values - clean.channels[name].values) < 0.15 * sigma
    assert np.array_equal(out.channels["n_dem"].values, log.channels["n_dem"].values)


@given(st.integers(0, 2**31), st.sampled_from(["nothing", "ripple", "demand", "no speed"]))
def test_what_the_machine_does_stays(seed: int, case: str) -> None:
    """No line; one of the LVDT, the current and the vanes; one of the demand that reaches all; no speed in the log."""
    line = swing(100.0, 7.3, 0.2)
    all_but = {name: line for name in NOISE if name != "n_r"}
    log = {
        "nothing": lambda: made(seed, 100.0),
        "ripple": lambda: made(seed, 100.0, **all_but),
        "demand": lambda: made(seed, 100.0, n_r=line, n_dem=25.0 * line, **all_but),
        "no speed": lambda: made(seed, 100.0, **all_but)[["x_lvdt", "i_cmd", "vigv", "n_dem"]],
    }[case]()
    assert without_hum(log) is log


@pytest.mark.parametrize(
    "logger", [Logger(100, hum=(60.0, 2.0)), Logger(500, hum=(400.0, 2.0)), Logger(200, hum=(60.0, 2.0), drift=3e-5)]
)
@pytest.mark.slow
def test_no_subsystem_of_a_clean_log_fails_with_hum(logger: Logger) -> None:
    chain = build_chain(Log("hum", recorded(fine(), logger, np.random.default_rng(2))))
    assert set(verdicts(chain).values()) == {"none"} and any("hum" in n for n in chain.notes)
