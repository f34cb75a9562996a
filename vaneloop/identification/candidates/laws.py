"""Reusable laws: what a measured system may do that its model does not, one small function each.

A law acts at a *place* of a model (`identification.user_models.system.System`):

- on a **signal**, an input or an output: y = law(u), `transform`;
- as a **force** added where things move (or to the derivative of a velocity), from velocity v and displacement x:
  `force_of`;
- on the derivative of a **state** x of first order (a level, a pressure, a temperature): `state_rate`.

Every law has neutral parameters at which it is an exact identity (or adds exactly nothing); the laws are dimensionally
right for any unit. Their names, parameters, bounds and starting values are declared in
`identification.candidates.library`.

Laws with memory keep it in a state row of `MEMORY` numbers. All steps are numba functions at module level, called
sample by sample.
"""

from __future__ import annotations

import math

import numpy as np

from vaneloop.base.compiled import compiled_free, inlined
from vaneloop.identification.subsystem import Array

__all__ = [
    "HYSTERETIC", "MEMORY", "MODIFIERS", "PARAMETERS", "SWITCHING", "apply", "argument", "force_of", "load",
    "state_rate", "transform",
]  # fmt: skip

MEMORY = 4  # numbers that a law may remember
PARAMETERS = 3  # most parameters of one law


# ---- laws on a signal ------------------------------------------------------------------------------------------------

BIAS, GAIN, ASYMMETRIC_GAIN, ABSOLUTE, SQUARE_ROOT, CUBIC, DEAD_ZONE, SATURATION, SMOOTH_SATURATION, QUANTISATION = (
    range(1, 11)
)
PLAY, RATE_LIMIT, LAG, SECOND_ORDER_LAG, DEAD_TIME, STICTION, STICK_SLIP, SQUARE = range(11, 19)


@inlined
def transform(code: int, k: int, t: Array, u: Array, p: Array, s: Array) -> float:
    """Law ``code`` on sample ``k`` of the signal ``u`` at times ``t`` (s), with parameters ``p`` and memory ``s``
    (changed in place).

    Samples after ``k`` are not looked at, so that the same function serves inside a loop. At k = 0 the memory is set
    up: laws start at rest at the first value; what has play may begin anywhere in it.
    """
    x = u[k]
    dt = t[k] - t[k - 1] if k > 0 else 0.0
    if code == BIAS:
        return x + p[0]
    if code == GAIN:
        return x * p[0]
    if code == ASYMMETRIC_GAIN:
        return x * (1.0 + p[0]) if x > 0.0 else x * (1.0 - p[0])
    if code == ABSOLUTE:
        return x + p[0] * (abs(x) - x)
    if code == SQUARE_ROOT:  # p[1]: magnitude that stays as it is
        root = math.sqrt(abs(x) * p[1])
        return x + p[0] * ((root if x > 0.0 else -root) - x)
    if code == CUBIC:
        return x + p[0] * x * x * x
    if code == SQUARE:  # p[1]: magnitude that stays as it is
        return x + p[0] * (x * x / p[1] - x)
    if code == DEAD_ZONE:
        if x > p[0]:
            return x - p[0]
        return x + p[0] if x < -p[0] else 0.0
    if code == SATURATION:
        return min(max(x, p[0]), p[1])
    if code == SMOOTH_SATURATION:
        z = p[0] * x
        return math.tanh(z) / p[0] if abs(z) > 1e-9 else x
    if code == QUANTISATION:
        return math.floor(x / p[0] + 0.5) * p[0] if p[0] > 0.0 else x
    if code == PLAY:
        h = 0.5 * p[0]
        s[0] = x + p[1] * h if k == 0 else min(max(s[0], x - h), x + h)
        return s[0]
    if code == STICTION or code == STICK_SLIP:  # p[0]: width, p[1]: jump as a share of it
        return _stuck(code, t[k], x, x - u[k - 1] if k > 0 else 0.0, k == 0, p, s)
    if code == RATE_LIMIT:
        s[0] = x if k == 0 else s[0] + min(max(x - s[0], -p[0] * dt), p[0] * dt)
        return s[0]
    if code == LAG:  # exact for an input that runs straight between samples
        if k == 0:
            s[0] = x
            return x
        if p[0] <= 0.0:
            s[0] = x
            return x
        a = dt / p[0]
        e = math.exp(-a)
        ramp = (1.0 - e) / a if a > 1e-6 else 1.0 - 0.5 * a
        s[0] = e * s[0] + (ramp - e) * u[k - 1] + (1.0 - ramp) * x
        return s[0]
    if (
        code == SECOND_ORDER_LAG
    ):  # p[0] = 1/natural frequency, p[1] = damping; trapezoidal, input straight between samples
        if k == 0 or p[0] <= 0.0:
            s[0], s[1] = x, 0.0
            return x
        w, z = 1.0 / p[0], p[1]
        n = int(min(max(math.ceil(4.0 * dt * w), 1.0), 50.0))
        h = dt / n
        for i in range(n):
            f0 = u[k - 1] + (x - u[k - 1]) * i / n
            f1 = u[k - 1] + (x - u[k - 1]) * (i + 1) / n
            # (I - h/2 A) y1 = (I + h/2 A) y0 + h/2 (b f0 + b f1), A = [[0, 1], [-w^2, -2 z w]]
            g = 0.5 * h
            r0 = s[0] + g * s[1]
            r1 = s[1] + g * (-w * w * s[0] - 2.0 * z * w * s[1]) + g * w * w * (f0 + f1)
            d = 1.0 + 2.0 * g * z * w + g * g * w * w
            s[0], s[1] = ((1.0 + 2.0 * g * z * w) * r0 + g * r1) / d, (r1 - g * w * w * r0) / d
        return s[0]
    if code == DEAD_TIME:
        when = t[k] - p[0]
        if p[0] <= 0.0:
            return x
        j = int(s[0])
        if k == 0:
            j = 0
        while j + 1 <= k and t[j + 1] <= when:
            j += 1
        s[0] = j
        if when <= t[0] or j >= k:
            return u[0] if when <= t[0] else x
        f = (when - t[j]) / (t[j + 1] - t[j])
        return u[j] + f * (u[j + 1] - u[j])
    return x


@inlined
def _stuck(code: int, t: float, x: float, dx: float, first: bool, p: Array, s: Array) -> float:
    """Position of a valve's stem that sticks, for its command ``x`` that has just, at ``t``, changed by ``dx``.

    It rests until the command is farther from it than static friction holds, (1 + j) S/2 with width S and jump j; then
    it jumps, and slides (1 - j) S/2 behind. STICTION slides on until the command stops or turns (Choudhury, Thornhill
    and Shah 2005, S and J = j S); STICK_SLIP sticks again at once (He, Wang, Pottmann and Qin 2007). Without a jump
    both are play of the width S. A log may repeat each value until the controller's next: a command has stopped that
    has not changed for longer than p[3]. ``p``: S, j, where in its band it begins (-1 to 1), s; ``s``: position,
    direction of sliding or 0, time of the last change.
    """
    holds, behind = 0.5 * p[0] * (1.0 + p[1]), 0.5 * p[0] * (1.0 - p[1])
    if first:
        s[0], s[1], s[2] = x + p[2] * holds, 0.0, t
    if dx != 0.0:
        s[2] = t
    if s[1] * dx < 0.0 or t - s[2] > p[3] or code == STICK_SLIP:
        s[1] = 0.0
    e = x - s[0]
    if s[1] == 0.0 and abs(e) > holds:
        s[1] = 1.0 if e > 0.0 else -1.0
    if s[1] != 0.0:
        s[0] = x - s[1] * behind
    return s[0]


@compiled_free
def apply(code: int, t: Array, u: Array, p: Array) -> Array:
    """Law ``code`` on a whole signal: float64[samples] from float64[samples]."""
    s = np.zeros(MEMORY)
    out = np.empty(len(u))
    for k in range(len(u)):
        out[k] = transform(code, k, t, u, p, s)
    return out


@compiled_free
def argument(code: int, y: float, p: Array) -> float:
    """What a signal law without memory reads as ``y``: nearest to it where there are several; ``y`` for none.

    The law is monotonic near its identity; secants from there.
    """
    t, u, s = np.zeros(1), np.empty(1), np.zeros(MEMORY)
    x, size = y, max(abs(y), 1e-300)
    u[0] = x
    e = transform(code, 0, t, u, p, s) - y
    slope = 1.0
    for _ in range(30):
        if abs(e) <= 1e-12 * size:
            return x
        step = -e / slope
        u[0] = x + step
        after = transform(code, 0, t, u, p, s) - y
        if not abs(after) < abs(e):
            return y if abs(e) > 1e-6 * size else x
        slope = (after - e) / step
        x, e = x + step, after
        if slope == 0.0:
            break
    return x if abs(e) <= 1e-6 * size else y


# ---- laws of forces --------------------------------------------------------------------------------------------------

FORCE_OFFSET, VISCOUS, COULOMB, STRIBECK, QUADRATIC_DRAG, SPRING, CUBIC_SPRING, ELASTIC_PLASTIC, BOUC_WEN = range(
    21, 30
)
BACKLASH_GAP, FRICTION_ASYMMETRY, END_STOP, SMOOTH_COULOMB = range(30, 34)
HYSTERETIC = (ELASTIC_PLASTIC, BOUC_WEN)  # carry a force at rest: where they start is unknown
SWITCHING = np.array([COULOMB, SMOOTH_COULOMB, STRIBECK, ELASTIC_PLASTIC, BOUC_WEN, BACKLASH_GAP, FRICTION_ASYMMETRY])
SWITCHING.setflags(write=False)
MODIFIERS = (
    BACKLASH_GAP,
    FRICTION_ASYMMETRY,
)  # add no force of their own: they change what the friction and spring laws add


@inlined
def _slip(v: float, small: float) -> float:
    """Direction of motion; a straight line within ``small``, so that a simulation can come to rest."""
    return min(max(v / small, -1.0), 1.0) if small > 0.0 else (1.0 if v > 0.0 else -1.0 if v < 0.0 else 0.0)


@inlined
def force_of(
    code: int, v: float, x: float, first: bool, p: Array, gap: float, asymmetry: float, small: float, s: Array
) -> float:
    """Force of law ``code`` at velocity ``v`` and displacement ``x``, positive where it opposes positive motion.

    gap        lost motion between the displacement and every elastic element
    asymmetry  friction is (1 + asymmetry) as large in the positive direction, (1 - asymmetry) in the negative one
    small      speed within which friction is regularised; 0: not at all
    s          memory; ``first``: set it up, elements start unloaded
    """
    if code == FORCE_OFFSET:
        return p[0]
    if code == VISCOUS:
        return p[0] * v
    if code == COULOMB:
        return p[0] * _slip(v, small) * (1.0 + asymmetry if v > 0.0 else 1.0 - asymmetry)
    if code == STRIBECK:  # Coulomb level, what breaking away takes beyond it, speed over which that fades
        level = p[0] + p[1] * math.exp(-((v / p[2]) ** 2)) if p[2] > 0.0 else p[0]
        return level * _slip(v, small) * (1.0 + asymmetry if v > 0.0 else 1.0 - asymmetry)
    if code == SMOOTH_COULOMB:  # level, speed over which it builds up
        return p[0] * math.tanh(v / p[1]) * (1.0 + asymmetry if v > 0.0 else 1.0 - asymmetry)
    if code == QUADRATIC_DRAG:
        return p[0] * v * abs(v)
    if code == END_STOP:  # contact stiffness p[0] beyond the displacements p[1] and p[2]
        return p[0] * (min(x - p[1], 0.0) + max(x - p[2], 0.0))
    h = 0.5 * gap
    if code == SPRING or code == CUBIC_SPRING:
        d = x - h if x > h else (x + h if x < -h else 0.0)
        return p[0] * d if code == SPRING else p[0] * d * d * d
    if code == ELASTIC_PLASTIC:  # spring p[0] in series with a slider of level p[1]; s[0]: where the slider stands
        if first:
            s[0] = x
        if p[0] <= 0.0 or p[1] <= 0.0:
            return 0.0
        d = x - s[0]
        e = d - h if d > h else (d + h if d < -h else 0.0)
        f = p[0] * e
        up, down = p[1] * (1.0 + asymmetry), p[1] * (1.0 - asymmetry)
        if f > up:
            f = up
            s[0] = x - h - up / p[0]
        elif f < -down:
            f = -down
            s[0] = x + h + down / p[0]
        return f
    if (
        code == BOUC_WEN
    ):  # p[0] stiffness, p[1] level, p[2] sharpness n; s[0] force, s[1] last x, s[2] place within the gap
        if first:
            s[0], s[1], s[2] = 0.0, x, 0.0
        if p[0] <= 0.0 or p[1] <= 0.0:
            return 0.0
        dx = x - s[1]
        s[1] = x
        f, g = s[0], s[2]
        for _ in range(3):  # out of the load, across the gap, into the next load
            if dx == 0.0:
                break
            if f == 0.0 or (abs(f) < 1e-12 * p[1]):
                f = 0.0
                m = min(dx, h - g) if dx > 0.0 else max(dx, -h - g)
                g += m
                dx -= m
                if dx == 0.0:
                    break
                f = 2e-12 * p[1] * (1.0 if dx > 0.0 else -1.0)
            level = p[1] * (1.0 + asymmetry if f > 0.0 else 1.0 - asymmetry)
            if (f > 0.0) == (dx > 0.0):
                left = 1.0 - (abs(f) / level) ** p[2]
                middle = min(abs(f + 0.5 * p[0] * dx * max(left, 0.0)) / level, 1.0)  # Runge, of second order
                f += p[0] * dx * (1.0 - middle ** p[2])
                f = min(max(f, -level), level)
                dx = 0.0
            else:
                new = f + p[0] * dx
                if new * f <= 0.0:
                    dx += f / p[0]
                    g = h if f > 0.0 else -h
                    f = 0.0
                else:
                    f = new
                    dx = 0.0
        s[0], s[2] = f, g
        return f
    return 0.0


@inlined
def load(code: int, x: float, p: Array, gap: float, asymmetry: float, held: float, s: Array) -> float:
    """Set up the memory of a hysteretic law so that at displacement ``x`` it carries the force ``held``, or its
    friction; return that.
    """
    f = min(max(held, -p[1] * (1.0 - asymmetry)), p[1] * (1.0 + asymmetry))
    side = 0.5 * gap if f > 0.0 else -0.5 * gap
    if code == ELASTIC_PLASTIC:
        s[0] = x - side - f / p[0]
    else:
        s[0], s[1], s[2] = f, x, side
    return f


# ---- laws of a state of first order ----------------------------------------------------------------------------------

STATE_OFFSET, LEAK, STATE_QUADRATIC, STATE_SQUARE_ROOT, STATE_CUBIC, STATE_LIMIT, STATE_RATE_LIMIT, STATE_OVERFLOW = (
    range(41, 49)
)
RADIATION, RADIATION_TO = range(49, 51)


@inlined
def state_rate(code: int, x: float, p: Array, other: float = 0.0) -> float:
    """What law ``code`` takes off the derivative of the state ``x``, where it is of an ``other`` quantity, too. Limits
    take nothing off; the simulation applies them.
    """
    if code == STATE_OFFSET:
        return p[0]
    if code == LEAK:
        return p[0] * x
    if code == STATE_QUADRATIC:
        return p[0] * x * abs(x)
    if code == STATE_SQUARE_ROOT:
        return p[0] * math.sqrt(x) if x > 0.0 else -p[0] * math.sqrt(-x)
    if code == STATE_CUBIC:
        return p[0] * x * x * x
    if code == RADIATION:  # Stefan and Boltzmann; p[1]: the surroundings, p[2]: absolute temperature at x = 0
        body, around = x + p[2], p[1] + p[2]
        return p[0] * (body**4 - around**4)
    if code == RADIATION_TO:  # to what ``other`` measures; p[1]: absolute temperature at 0
        return p[0] * ((x + p[1]) ** 4 - (other + p[1]) ** 4)
    return 0.0
