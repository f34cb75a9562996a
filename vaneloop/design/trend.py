"""Design of the trend filter: is the rotor speed demanded rising or falling?

Model, one step of T = 10 ms, n the demand (%), r its rate (%/s)::

    n(k+1) = n(k) + T r(k) + T^2/2 a(k),   r(k+1) = r(k) + T a(k),   y(k) = n(k) + v(k)

a is white with standard deviation sigma_a (%/s^2), v with sigma_v (%). The Kalman filter of this model settles to
constant gains K = [alpha, beta/T], and then is the alpha-beta filter that the firmware runs
(`controller.trend.trend_step`)::

    n- = n + T r,   e = y - n-,   n = n- + alpha e,   r = r + beta e / T

Its noise is filterpy's, its gain that of the Riccati equation. Tests hold both, and what the firmware estimates,
against filterpy's filter. Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation
(2001), section 6.5 (alpha-beta filter, tracking index).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np
import scipy
from filterpy.common import Q_discrete_white_noise
from numpy.typing import ArrayLike, NDArray

from vaneloop.base.errors import InputError

__all__ = ["TrendDesign", "TrendModel", "direction", "false_turns_per_hour", "recommend", "riccati_gain"]

Array = NDArray[np.float64]

STEP = 10e-3  # s, period of the ECU's frame


@dataclass(frozen=True)
class TrendModel:
    """What the filter believes.

    acceleration  %/s^2, standard deviation of the change of rate
    noise         % rms of the demand's noise
    resolution    %, step of the demand on the bus; adds resolution^2/12 to the variance
    """

    acceleration: float = 0.3
    noise: float = 0.02
    resolution: float = 0.002
    step: float = STEP

    def __post_init__(self) -> None:
        for name in ("acceleration", "noise", "step"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} (={getattr(self, name):g}) must be above 0")

    @property
    def sigma(self) -> float:
        """Standard deviation (%) of a measured demand."""
        return math.hypot(self.noise, self.resolution / math.sqrt(12.0))

    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """F, H, Q, R; Q from `filterpy.common.Q_discrete_white_noise`."""
        f = np.array([[1.0, self.step], [0.0, 1.0]])
        h = np.array([[1.0, 0.0]])
        q = np.asarray(Q_discrete_white_noise(dim=2, dt=self.step, var=self.acceleration**2), dtype=float)
        return f, h, q, np.array([[self.sigma**2]])


# ---------------------------------------------------------------- gains, direction


def riccati_gain(model: TrendModel) -> tuple[float, float]:
    """(alpha, beta) from the discrete algebraic Riccati equation."""
    f, h, q, r = model.matrices()
    p = scipy.linalg.solve_discrete_are(f.T, h.T, q, r)
    k = p @ h.T / (h @ p @ h.T + r)
    return float(k[0, 0]), float(k[1, 0]) * model.step


def direction(n_dem: ArrayLike, design: TrendDesign) -> Array:
    """Direction (+1, -1) of a demand sampled every 10 ms, written down once more from the rule alone.

    ::

        turn = farthest demand along the direction d that two samples in a row reached,   back = d (turn - n_dem)
        against: (-d r > rate_on and back > change/2) or back > change
        d turns once `against` has stood for `hold` without a gap
    """
    y = np.asarray(n_dem, dtype=float)
    n, r, d, turn, last, stands = y[0], 0.0, 1.0, y[0], y[0], 0
    needed = math.ceil(design.hold / STEP - 1e-9)
    out = np.empty(y.size)
    for i, v in enumerate(y):
        e = v - (n + STEP * r)
        n, r = n + STEP * r + design.alpha * e, r + design.beta * e / STEP
        low, high, last = min(v, last), max(v, last), v
        turn = max(turn, low) if d > 0.0 else min(turn, high)
        back = d * (turn - v)
        against = (-d * r > design.rate_on and back > 0.5 * design.change) or back > design.change
        stands = stands + 1 if against else 0
        if stands >= max(needed, 1):
            d, turn, stands = -d, high if d > 0.0 else low, 0
        out[i] = d
    return out


# ---------------------------------------------------------------- thresholds


@dataclass(frozen=True)
class TrendDesign:
    """The calibration of the trend and the figures behind it.

    alpha, beta   per 10 ms
    rate_on       %/s
    change        %
    hold          s, time for which the condition must stand
    rate_noise    %/s rms of the rate under the demand's noise
    bandwidth     rad/s and damping (-) of the filter
    false_turns   per hour, if the rate alone decided (upper bound; the change and the hold come on top)
    detection     %/s: the slowest manoeuvre, and by how many standard deviations of the rate it clears the threshold
    """

    alpha: float
    beta: float
    rate_on: float
    change: float
    hold: float
    rate_noise: float
    bandwidth: float
    damping: float
    false_turns: float
    slowest: float
    clearance: float

    def to_dict(self) -> dict[str, float]:
        """Plain JSON values."""
        return asdict(self)


def _error_system(alpha: float, beta: float, step: float) -> tuple[Array, Array]:
    """x(k+1) = A x + B v for the estimates (n, r) under measurement noise v alone."""
    gain = np.array([[alpha], [beta / step]])
    f = np.array([[1.0, step], [0.0, 1.0]])
    return (np.eye(2) - gain @ np.array([[1.0, 0.0]])) @ f, gain


def rate_noise(alpha: float, beta: float, model: TrendModel) -> tuple[float, float]:
    """(rms of the rate in %/s, its correlation from one step to the next) under the demand's noise, by the Lyapunov
    equation.
    """
    a, b = _error_system(alpha, beta, model.step)
    c = scipy.linalg.solve_discrete_lyapunov(a, b @ b.T * model.sigma**2)
    return math.sqrt(c[1, 1]), float((a @ c)[1, 1] / c[1, 1])


def false_turns_per_hour(alpha: float, beta: float, rate_on: float, model: TrendModel) -> float:
    """How often per hour noise alone carries the rate beyond ``rate_on``, on either side.

    Rice's formula in discrete time: a Gaussian sequence with step-to-step correlation rho crosses 0 upwards
    arccos(rho)/(2 pi) times a step, and a level of u standard deviations exp(-u^2/2) times as often.
    """
    sigma, rho = rate_noise(alpha, beta, model)
    return 2.0 * 3600.0 / model.step * math.acos(rho) / (2.0 * math.pi) * math.exp(-0.5 * (rate_on / sigma) ** 2)


def recommend(
    model: TrendModel | None = None,
    *,
    rate_on: float = 0.06,
    change: float = 0.5,
    hold: float = 0.1,
    slowest: float = 0.1,
) -> TrendDesign:
    """The trend's calibration for ``model``, and how safe it is.

    slowest  %/s, the slowest manoeuvre that must turn the direction by its rate
    """
    m = model or TrendModel()
    alpha, beta = riccati_gain(m)
    sigma, _ = rate_noise(alpha, beta, m)
    # poles of the alpha-beta filter -> equivalent continuous frequency and damping
    a, _ = _error_system(alpha, beta, m.step)
    s = np.log(np.linalg.eigvals(a).astype(complex)) / m.step
    w = float(np.sqrt(np.prod(np.abs(s))))
    return TrendDesign(
        alpha=alpha,
        beta=beta,
        rate_on=rate_on,
        change=change,
        hold=hold,
        rate_noise=sigma,
        bandwidth=w,
        damping=float(-s.real.mean() / w),
        false_turns=false_turns_per_hour(alpha, beta, rate_on, m),
        slowest=slowest,
        clearance=(slowest - rate_on) / sigma,
    )
