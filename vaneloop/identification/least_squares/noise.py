"""What is known of the noise: how many samples of an error count as one, and how well a noise floor is known."""

from __future__ import annotations

import numpy as np

from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.settings import AGREES, COLOUR, SPREADS
from vaneloop.identification.subsystem import Array

__all__ = ["colour_of", "correlation_of", "floor_deviation", "most_floor", "tolerance"]


def correlation_of(judge: LeastSquaresProblem, fit: Fit) -> float:
    """Return how many samples of the fit's error count as one observation, at most 50.

    Variance inflation of a sum of the squared errors: 1 + 2 sum of the squared autocorrelations up to the first that is
    not positive.
    """
    e = judge.errors(fit.theta[None])[0]
    worst = 1.0
    for row in e:
        row = row - row.mean()
        power = float(row @ row)
        if power <= 0.0:
            continue
        total = 1.0
        lags = min(400, len(row) // 4)
        spectrum = np.fft.rfft(row, 1 << (len(row) + lags).bit_length())  # of two, or a prime length takes ten times
        for rho in np.fft.irfft(np.abs(spectrum) ** 2)[1:lags] / power:
            if rho <= 0.05:
                break
            total += 2.0 * rho * rho  # squares of errors are correlated by rho squared
        worst = max(worst, total)
    return min(worst, 50.0)


def colour_of(judge: LeastSquaresProblem, fit: Fit) -> float:
    """`correlation_of` as far as it can be the noise's own: a wrong model's errors are alike for longer."""
    return float(np.clip(correlation_of(judge, fit), *COLOUR))


def floor_deviation(m: Array | int, n: int, correlation: float) -> Array:
    """Standard deviation of an RMS error over its noise floor, in noise floors.

    An RMS of m samples has the relative variance c / (2 m). The floor has one of its own: it comes from the quieter
    half of the log's n samples, whose colour is that of noise.

    correlation  samples of the error that count as one observation, c
    """
    return np.asarray(np.sqrt(correlation / (2.0 * np.asarray(m)) + min(correlation, COLOUR[1]) / n))


def most_floor(n: int, colour: float) -> float:
    """The most that a noise floor from a log of n samples may be wrong by: true floor over estimate."""
    return 1.0 + SPREADS * float(np.sqrt(colour / max(n, 1)))


def tolerance(n: int, colour: float) -> float:
    """RMS error of n samples up to which it is no more than noise, in noise floors."""
    return max(AGREES, 1.0 + SPREADS * float(floor_deviation(max(n, 1), max(n, 1), colour)))
