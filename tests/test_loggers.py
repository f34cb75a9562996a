"""What a logger or a mode does is not physics: rows that are missing, a controller that stood aside, a servo at its
limit.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest

from hil.logs import Channel, Log
from tests import rig
from tests.conftest import quick_first
from tests.firmware_on_rig import firmware
from vaneloop.identification.settings import SETTLE
from vaneloop.identification.vane_chain.chain import Chain, build_chain
from vaneloop.identification.workflow import diagnose

DURATION = 120.0  # s
FREE_RUNNING = ("demand", "servo", "engine")


@functools.cache
def rows(seed: int, spell: str = "", at: float = 60.0, length: float = 5.0) -> dict[str, np.ndarray]:
    """A clean log of the rig, with some seconds in another mode."""
    spells = [rig.Spell(spell, at, length)] if spell else []
    return rig.simulate(rig.manoeuvre(seed, DURATION), firmware(), seed=seed, spells=spells).log


def chain(log: dict[str, np.ndarray], keep: np.ndarray | slice = slice(None)) -> Chain:
    """The stages of these rows of a log."""
    return build_chain(Log("clean", {k: Channel(log["t"][keep], v[keep]) for k, v in log.items() if k != "t"}, []))


def verdicts(c: Chain, names: tuple[str, ...] = FREE_RUNNING) -> dict[str, tuple[str, float]]:
    """Verdict and error over the floor of these stages."""
    d = diagnose([c.stage(n) for n in names], workers=1)
    return {s.stage: (s.verdict, round(s.excess, 3)) for s in d.stages}


def clean(said: dict[str, tuple[str, float]]) -> bool:
    return all(verdict == "none" and excess < 1.05 for verdict, excess in said.values())


@pytest.mark.slow
@pytest.mark.parametrize("gaps", [[(40.0, 8.0)], [(20.0, 1.0), (55.3, 8.0), (90.0, 2.5)]])
def test_stages_start_anew_after_a_gap(gaps):
    log = rows(41)
    keep = np.ones(len(log["t"]), dtype=bool)
    for start, length in gaps:
        keep &= (log["t"] < start) | (log["t"] >= start + length)
    c = chain(log, keep)
    assert clean(said := verdicts(c, (*FREE_RUNNING, "actuator", "linkage"))), said
    counted = np.isfinite(c.stage("engine").measured).sum() / len(log["t"])
    assert counted > 1.0 - (sum(g[1] for g in gaps) + 5.0 * len(gaps) + 6.0) / DURATION  # and little else is lost


@pytest.mark.parametrize("spell", quick_first(["standby", "deaf"]))
def test_a_controller_that_was_in_another_mode_starts_anew(spell):
    assert clean(said := verdicts(chain(rows(42, spell)))), said


def test_rows_lost_one_by_one_are_bridged():
    log = rows(41)
    rng = np.random.default_rng(3)
    keep = np.ones(len(log["t"]), dtype=bool)
    for length in (1, 1, 1, 1, 1, 2, 2, 2, 3, 5):
        for start in rng.integers(500, len(keep) - 500, 3):
            keep[start : start + length] = False
    c = chain(log, keep)
    assert clean(said := verdicts(c)), said
    assert np.isfinite(c.stage("engine").measured).mean() > 0.6


def test_a_servo_at_its_limit_is_judged_where_it_is_not():
    log = {k: v.copy() for k, v in rows(41).items()}
    # the current stands at its limit for a second, while the law would ask for more; afterwards the integral is another
    # one
    at = slice(7000, 7100)
    log["i_cmd"][at] = 40.0
    log["i_cmd"][at.stop :] += 0.4
    assert clean(said := verdicts(chain(log), ("servo",))), said


def test_where_play_was_left_by_a_controller_that_caught_up_at_full_speed_is_not_known() -> None:
    """Its piston turns between two rows, and play keeps where: 0.08 deg until the next reversal, which two lags would
    patch.
    """
    log = rows(42)
    stood_by = (log["t"] >= 60.0) & (log["t"] < 66.0)
    plain, spell = (
        chain({**log, "state": np.where(by, 1.0, log["state"])}).stage("linkage") for by in (False, stood_by)
    )
    before, judged = np.isfinite(plain.measured[0]), np.isfinite(spell.measured[0])
    x = np.interp(plain.t, log["t"], log["x_lvdt"])
    settled = int(np.searchsorted(plain.t, 66.0 + SETTLE))
    crossed = settled + int(np.argmax(np.maximum.accumulate(x[settled:]) - np.minimum.accumulate(x[settled:]) > 3.0))
    begin = int(np.searchsorted(plain.t, 60.0))
    assert crossed - settled > 10 and before[begin:crossed].all() and not judged[begin:crossed].any()
    assert np.array_equal(judged[:begin], before[:begin]) and np.array_equal(
        judged[crossed + 2 :], before[crossed + 2 :]
    )
