"""What the engine test asks of the machine: rotor-speed demand, supply pressure and oil temperature over time, drawn by
seed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FRAME = 1e-2  # s, period of the demand's frame
N_LOW, N_HIGH = 40.0, 100.0  # %


@dataclass(frozen=True)
class Manoeuvre:
    """One engine test, a row every 10 ms: n_dem (%), p_s (Pa), t_oil (degC)."""

    name: str
    seed: int
    n_dem: np.ndarray
    p_s: np.ndarray
    t_oil: np.ndarray

    @property
    def duration(self) -> float:
        """Length, s."""
        return len(self.n_dem) * FRAME


def _time(duration: float) -> np.ndarray:
    return FRAME * np.arange(round(duration / FRAME))


def _wander(rng: np.random.Generator, t: np.ndarray, corner: float) -> np.ndarray:
    """Smooth noise of about unit size: a few sines slower than ``corner`` (Hz)."""
    y = np.zeros_like(t)
    for f in rng.uniform(0.1, 1.0, 5) * corner:
        y += np.sin(2.0 * np.pi * (f * t + rng.random()))
    return y / np.sqrt(2.5)


def _oil(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Oil warming from 20..40 towards 65..90 degC within the test, with excursions of some kelvin as the cooler
    works.
    """
    first, last = rng.uniform(20.0, 40.0), rng.uniform(65.0, 88.0)
    tau = rng.uniform(0.3, 0.6) * max(t[-1], 1.0)
    warm = first + (last - first) * (1.0 - np.exp(-t / tau))
    swing = rng.uniform(3.0, 8.0) * _wander(rng, t, 0.02)
    return np.clip(warm + swing, 20.0, 90.0)


def _pressure(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Supply pressure between 19 and 22 MPa: slow wander and some steps of the pump's control, 0.3 s long."""
    p = 20.6e6 + 0.5e6 * _wander(rng, t, 0.05)
    for at in rng.uniform(0.0, t[-1] + 1.0, max(1, int(t[-1] / 40.0))):
        p += rng.uniform(-0.6e6, 0.6e6) / (1.0 + np.exp(-np.clip((t - at) / 0.06, -50, 50)))
    return np.clip(p, 19e6, 22e6)


def _speed(rng: np.random.Generator) -> float:
    """A speed to go to: three times of four where the schedule is steep (62 to 100 %)."""
    return rng.uniform(62.0, N_HIGH) if rng.random() < 0.75 else rng.uniform(N_LOW, 62.0)


def _pieces(rng: np.random.Generator, duration: float) -> list[np.ndarray]:
    """Pieces of demand, one after the other: dwell, ramp, step, small reversals, slam, chop, sine dither, staircase."""
    out: list[np.ndarray] = [np.full(round(2.0 / FRAME), rng.uniform(55.0, 85.0))]
    length = len(out[0])
    kinds = ["dwell", "ramp", "step", "reversals", "slam", "dither", "stairs"]
    bag: list[str] = []
    total = round(duration / FRAME)
    while length < total:
        if not bag:
            bag = [*rng.permutation(kinds)]
        kind = bag.pop()
        now = float(out[-1][-1])
        if kind == "dwell":
            piece = np.full(round(rng.uniform(2.0, 8.0) / FRAME), now)
        elif kind == "ramp":
            goal = _speed(rng)
            piece = np.linspace(now, goal, max(2, round(abs(goal - now) / rng.uniform(1.0, 6.0) / FRAME)))
        elif kind == "step":
            goal = np.clip(now + rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 10.0), N_LOW, N_HIGH)
            piece = np.full(round(rng.uniform(3.0, 6.0) / FRAME), goal)
        elif kind == "reversals":
            size, period = rng.uniform(0.5, 3.0), rng.uniform(1.5, 4.0)
            s = FRAME * np.arange(round(rng.integers(3, 6) * period / FRAME))
            piece = now + size * (2.0 / np.pi) * np.arcsin(np.sin(2.0 * np.pi * s / period))
        elif kind == "slam":
            goal = rng.uniform(90.0, N_HIGH) if now < 75.0 else rng.uniform(N_LOW, 70.0)
            piece = np.full(round(rng.uniform(7.0, 11.0) / FRAME), goal)
        elif kind == "dither":
            size, f = rng.uniform(0.3, 2.0), rng.uniform(0.15, 1.0)
            s = FRAME * np.arange(round(rng.integers(3, 7) / f / FRAME))
            piece = now + size * np.sin(2.0 * np.pi * f * s)
        else:
            goal, steps = _speed(rng), int(rng.integers(3, 7))
            piece = np.repeat(np.linspace(now, goal, steps + 1)[1:], round(rng.uniform(1.0, 2.5) / FRAME))
        piece = np.clip(piece, N_LOW, N_HIGH)
        out.append(piece)
        length += len(piece)
    return out


def manoeuvre(seed: int, duration: float = 300.0) -> Manoeuvre:
    """Draw an engine test: dwells, ramps, steps, small reversals, slams, dithers, stairs; warming oil. 300 s excite
    most effects.
    """
    rng = np.random.default_rng([seed, 1])
    t = _time(duration)
    n = np.concatenate(_pieces(rng, duration))[: len(t)]
    return Manoeuvre("engine test", seed, n, _pressure(rng, t), _oil(rng, t))


def steady(seed: int, duration: float = 300.0) -> Manoeuvre:
    """One speed, constant oil: almost nothing is excited."""
    rng = np.random.default_rng([seed, 2])
    t = _time(duration)
    return Manoeuvre(
        "steady",
        seed,
        np.full(len(t), rng.uniform(60.0, 95.0)),
        np.full(len(t), 21e6),
        np.full(len(t), rng.uniform(40.0, 70.0)),
    )


def small_moves(seed: int, duration: float = 300.0) -> Manoeuvre:
    """Moves of at most 1.5 % about one speed, constant oil: gains, geometry, limits and temperature stay hidden."""
    rng = np.random.default_rng([seed, 3])
    t = _time(duration)
    n = rng.uniform(60.0, 95.0) + 0.75 * np.clip(_wander(rng, t, 0.5), -2.0, 2.0)
    return Manoeuvre("small moves", seed, n, np.full(len(t), 21e6), np.full(len(t), 50.0))


def slow_ramps(seed: int, duration: float = 300.0) -> Manoeuvre:
    """Slow rises and falls over the whole range, constant oil: the hysteresis loops, no dynamics."""
    rng = np.random.default_rng([seed, 4])
    t = _time(duration)
    turns = np.linspace(0.0, duration, max(3, int(duration / 60.0) + 1))
    ends = np.where(
        np.arange(len(turns)) % 2 == 0, rng.uniform(40.0, 50.0, len(turns)), rng.uniform(93.0, 100.0, len(turns))
    )
    return Manoeuvre("slow ramps", seed, np.interp(t, turns, ends), np.full(len(t), 21e6), np.full(len(t), 50.0))


MANOEUVRES = {"engine test": manoeuvre, "steady": steady, "small moves": small_moves, "slow ramps": slow_ramps}
