"""The controller once more, written from docs/controller.md and docs/strategies.md: plain Python, time counted in whole
ticks.

It shares nothing with `controller.firmware`: the numbers come from ``calibration.toml`` by their names, faults are
objects, modes are words, the three stages are numpy arrays. It is slow and has no guard against insane inputs;
`tests/test_firmware_spec.py` compares.
"""

from __future__ import annotations

import math
import tomllib
from functools import cache

import numpy as np

from vaneloop.base import tables

SI = {"mm": 1e-3, "mm/s": 1e-3, "mA": 1e-3, "deg": math.pi / 180.0, "deg/s": math.pi / 180.0}
STEP = 0.01  # s, the slow part


@cache
def _shipped() -> dict[str, float]:
    out = {}
    angles = tomllib.loads(tables.path("vane_angles.toml").read_text())
    for part in (*tomllib.loads(tables.path("calibration.toml").read_text()).values(), angles):
        for name, q in part.items():
            if isinstance(q, dict) and "value" in q:
                out[name] = q["value"] * SI.get(q["unit"], 1.0)
    return out


def numbers(**changed: float) -> dict[str, float]:
    """Return calibration.toml and the play by name, in SI, with some numbers ``changed``."""
    assert set(changed) <= set(_shipped())
    return {**_shipped(), **changed}


def clip(v: float, low: float, high: float) -> float:
    """``v`` held within the two."""
    return low if v < low else high if v > high else v


class Fault:
    """Set at the ``after``-th bad tick, healed at the ``heal``-th good one in a row; ``adding_up``: a good one takes
    back a tenth.
    """

    def __init__(self, after: float, heal: float, adding_up: bool = False):
        self.after, self.heal, self.adding_up = max(1, round(after * 1000)), round(heal * 1000), adding_up
        self.on, self.bad, self.good = False, 0.0, 0

    def tick(self, bad: bool, weight: int = 1) -> None:
        """Count one tick."""
        if self.on:
            self.good = 0 if bad else self.good + 1
            if self.good >= self.heal:
                self.on, self.bad = False, 0.0
            return
        if bad:
            self.bad += weight
        else:
            self.bad = max(0.0, self.bad - 0.1) if self.adding_up else 0.0
        if bad and self.bad >= self.after - 0.5:  # where tenths add up, to the nearest tick
            self.on, self.good = True, 0

    @property
    def present(self) -> bool:
        """Is the cause there now?"""
        return self.on and self.good == 0


class Reference:
    """Controller with the stroke tables of ``cal`` and the numbers ``k``."""

    def __init__(self, cal, strategy: str = "dual", table_input: str = "n_r", k: dict[str, float] | None = None):
        self.k = k = k or numbers()
        self.table, self.angles, self.strategy, self.by_demand = cal.table, cal.angles, strategy, table_input == "n_dem"
        self.play = np.array([k["play_vigv"], k["play_vgv1"], k["play_vgv2"]])
        recover, heal = k["recover_time"], k["lvdt_heal"]
        self.faults = {
            "demand_stale": Fault(0, recover), "demand_rejected": Fault(0, recover),
            "lvdt_range": Fault(k["lvdt_debounce"], heal, True), "lvdt_rate": Fault(k["lvdt_debounce"], heal, True),
            "lvdt_stuck": Fault(0, heal), "tracking": Fault(k["tracking_time"], recover),
            "current_saturated": Fault(k["saturated_time"], recover), "demand_range": Fault(0, recover),
            "paused": Fault(0, recover),
        }  # fmt: skip
        self.mode, self.ticks, self.i = "INIT", 0, 0.0
        # LVDT
        self.x, self.reach, self.plausible, self.stuck_from, self.stuck_for = 0.0, 1.0, False, 0.0, 0
        # demand
        self.seen, self.run, self.n_dem, self.raw, self.n, self.age, self.bucket = False, False, 0.0, 0.0, 0.0, 0, 0.0
        # direction
        self.filtered, self.rate, self.turn, self.last, self.due, self.d, self.blend = 0.0, 0.0, 0.0, 0.0, 0, 1, 1.0
        # stroke and servo
        self.target, self.demand, self.before, self.reference, self.integral, self.limited = (
            0.0,
            0.0,
            0.0,
            0.0,
            0.0,
            False,
        )
        self.recovering, self.degraded = 0, 0
        # play and learning
        self.slow_x, self.speed, self.speed_rate, self.drift, self.noise = 0.0, 0.0, 0.0, 0.0, 0.0
        self.side, self.crossing, self.still, self.used = 0, 0.0, 0.0, np.zeros(2)  # still: s at rest
        self.far, self.on_side = np.zeros(3), np.zeros(3)
        self.pot, self.pot_seen, self.doubt, self.trusted = (
            np.zeros(3),
            np.zeros(3, bool),
            np.zeros(3),
            np.zeros(3, bool),
        )
        self.low, self.high = np.zeros(3), np.zeros(3)
        self.known, self.proved = np.zeros((3, 2)), np.zeros((3, 2))  # offset, width
        self.learned = np.zeros((3, 2))  # s on the sides +1 and -1

    # ---- one tick

    def tick(self, n_dem, n_r, fresh, rejected, request, x_lvdt, vigv, vgv1, vgv2, pause=0.0) -> None:
        """One millisecond, after ``pause`` (s) in which nothing ran."""
        k = self.k
        self._lvdt(x_lvdt, pause)
        self._frames(n_dem, n_r, fresh, rejected, request, pause)
        self.faults["paused"].tick(pause > 0.0)
        if self.strategy in ("inverse", "adaptive"):
            self.slow_x += 0.1 * (self.x - self.slow_x)
        if self.strategy == "adaptive":
            self._pots(np.array([vigv, vgv1, vgv2]))
        part = self.ticks % 10
        if part == 0:
            if self.seen:
                self.n += (self.raw - self.n) * STEP / (k["speed_filter"] + STEP)
                self._direction()
                if self.strategy in ("inverse", "adaptive"):
                    if self.strategy == "adaptive":
                        self._learn()
                    self._inverse()
                else:
                    self._curves()
            self.before = self.demand
            goal, fastest = {
                "RUN": (self.target, k["stroke_rate"]), "DEGRADED": (self.target, k["stroke_rate"]),
                "FAIL_SAFE": (k["fail_safe_stroke"], k["fail_safe_rate"]),
            }.get(self.mode, (self.demand, 0.0))  # fmt: skip
            if self.mode in ("RUN", "DEGRADED", "FAIL_SAFE"):
                self.demand = self._in_limits(self.demand + clip(goal - self.demand, -fastest * STEP, fastest * STEP))
        servo = self.mode != "INIT" and not (self.mode == "FAIL_SAFE" and self._lost())
        if not servo:
            self.before = self.demand = self._in_limits(self.x)
        self.reference = self.before + (self.demand - self.before) * (part + 1) / 10.0
        if servo:
            self._servo((self.demand - self.before) / STEP)
        else:
            self.i, self.integral, self.limited = (0.0 if self.mode == "INIT" else k["fail_safe_current"]), 0.0, False
        self.faults["tracking"].tick(servo and abs(self.reference - self.x) > k["tracking_limit"])
        self.faults["current_saturated"].tick(servo and self.limited)
        self.ticks += 1
        self._next_mode()

    def _in_limits(self, x: float) -> float:
        return clip(x, self.k["stroke_min"], self.k["stroke_max"])

    def _lost(self) -> bool:
        return any(self.faults[f].on for f in ("lvdt_range", "lvdt_rate", "lvdt_stuck"))

    def _lvdt(self, x: float, pause: float) -> None:
        k = self.k
        inside = k["lvdt_low"] <= x <= k["lvdt_high"]
        self.reach = min(self.reach + k["lvdt_rate"] * (1e-3 + pause), 1.0)
        jump = inside and abs(x - self.x) > self.reach
        self.plausible = inside and not jump
        if self.plausible:
            self.x, self.reach = x, 0.0
        self.faults["lvdt_range"].tick(not inside)
        self.faults["lvdt_rate"].tick(jump, weight=5)
        stuck = self.stuck_for >= round(k["stuck_time"] * 1000)
        far = k["stroke_min"] + k["stuck_margin"] < self.x < k["stroke_max"] - k["stuck_margin"]
        if (stuck or (far and abs(self.i) > k["stuck_current"])) and abs(self.x - self.stuck_from) < k["stuck_motion"]:
            self.stuck_for += not stuck
        else:
            self.stuck_from, self.stuck_for = self.x, 0
        self.faults["lvdt_stuck"].tick(self.stuck_for >= round(k["stuck_time"] * 1000))

    def _frames(self, n_dem, n_r, fresh, rejected, request, pause) -> None:
        k = self.k
        right = all(k["demand_low"] <= v <= k["demand_high"] for v in (n_dem, n_r)) and 0.0 <= request <= 1.0
        self.bucket = min(max(self.bucket - k["demand_reject_leak"] * 1e-3, 0.0) + rejected, k["demand_reject_limit"])
        self.age += 1 + round(pause * 1000)
        if fresh and right:
            self.age, self.n_dem, self.raw, self.run = 0, n_dem, n_r, request > 0.5
            if not self.seen:
                self.seen, self.n, self.speed = True, n_r, n_r
                self.filtered = self.turn = self.last = n_dem
        self.faults["demand_stale"].tick(self.age >= round(k["demand_timeout"] * 1000))
        self.faults["demand_rejected"].tick(self.bucket >= k["demand_reject_limit"])
        self.faults["demand_range"].tick(fresh and not right)

    def _direction(self) -> None:
        k, n, d = self.k, self.n_dem, self.d
        guess = self.filtered + self.rate * STEP
        self.filtered = guess + k["trend_alpha"] * (n - guess)
        self.rate += k["trend_beta"] * (n - guess) / STEP
        along = min(d * n, d * self.last)  # what two steps in a row have reached
        self.turn = d * max(d * self.turn, along)
        back = d * (self.turn - n)
        if back > k["trend_change"] or (-d * self.rate > k["trend_rate_on"] and back > k["trend_change"] / 2.0):
            self.due += 1
            if self.due >= round(k["trend_hold"] / STEP):
                self.d, self.due = -d, 0
                self.turn = d * max(
                    d * n, d * self.last
                )  # along the new direction: the lesser of the two, two steps in a row
        else:
            self.due = 0
        self.last = n

    def _curve(self, row: int, n: float) -> float:
        return float(np.interp(n, self.table[0], self.table[row]))

    def _curves(self) -> None:
        n = self.n_dem if self.by_demand else self.n
        if self.strategy == "single":
            self.target = self._in_limits(self._curve(3, n))
            return
        step = STEP / self.k["blend_time"]
        self.blend = min(1.0, self.blend + step) if self.d > 0 else max(0.0, self.blend - step)
        self.target = self._in_limits((1.0 - self.blend) * self._curve(2, n) + self.blend * self._curve(1, n))

    def _servo(self, speed: float) -> None:
        k, limit = self.k, self.k["current_limit"]
        e = self.reference - self.x
        integral = self.integral + k["ki"] * e * 1e-3
        free = k["kp"] * e + integral + k["kff"] * speed
        self.i = clip(free, -limit, limit)
        self.limited = self.i != free
        if not (self.limited and e * free > 0.0) and not (self.limited and e == 0.0):
            self.integral = clip(integral, -limit, limit)

    def _next_mode(self) -> None:
        old, k = self.mode, self.k
        lost = self._lost()
        stop = lost or self.faults["paused"].on
        others = [f for name, f in self.faults.items() if not name.startswith("lvdt") and name != "paused"]
        trouble = any(f.on for f in others)
        if old == "INIT":
            if stop:
                self.mode = "FAIL_SAFE"
            elif self.ticks >= round(k["init_time"] * 1000) and self.plausible:
                self.mode = "STANDBY"
        elif stop:
            self.mode, self.recovering = "FAIL_SAFE", 0
        elif old == "STANDBY" and self.run and self.seen and not trouble:
            self.mode = "RUN"
        elif old == "RUN":
            self.mode = "DEGRADED" if trouble else "RUN" if self.run else "STANDBY"
        elif old == "DEGRADED":
            self.degraded += any(f.present for f in others)
            if not trouble:
                self.mode = "RUN"
            elif self.degraded >= round(k["degraded_hold"] * 1000):
                self.mode = "FAIL_SAFE"
        elif old == "FAIL_SAFE":
            self.recovering = 0 if trouble else self.recovering + 1
            if self.recovering >= round(k["recover_time"] * 1000):
                self.mode = "RUN" if self.run and self.seen else "STANDBY"
        if self.mode != old:
            self.recovering = self.degraded = 0
            if self.mode in ("STANDBY", "FAIL_SAFE") or old in ("INIT", "STANDBY"):
                self.before = self.demand = self._in_limits(self.x)

    # ---- play

    def _angle(self, stage: int, stroke: float) -> float:
        return float(np.interp(stroke, self.angles[0], self.angles[1 + stage]))

    def _goal(self, n: float) -> float:
        return self._angle(0, self._curve(3, n))

    def _observe(self) -> None:
        k = self.k
        if self.by_demand:
            self.speed, self.speed_rate = self.n_dem, self.rate
            return
        if self.age >= round(k["demand_timeout"] * 1000):
            self.speed_rate = 0.0
        else:
            engine = clip(
                (self.n_dem - self.speed) / k["engine_lag"], -k["engine_deceleration"], k["engine_acceleration"]
            )
            self.speed_rate = engine + self.drift
            self.speed += self.speed_rate * STEP
            if self.age < 10:
                e = self.raw - self.speed
                self.speed += k["observer_alpha"] * e
                e = clip(e, -k["observer_band"], k["observer_band"])
                self.drift = clip(self.drift + k["observer_beta"] * e / STEP, -3.0, 3.0)
                self.noise += 0.002 * (e**2 - self.noise)
        self.speed = clip(self.speed, self.n - k["observer_band"], self.n + k["observer_band"])

    def _widths(self) -> np.ndarray:
        extra = self.known[:, 1].copy()
        extra[0] = self.used[1]
        return np.maximum(self.play + extra, 0.0)

    def _inverse(self) -> None:
        k = self.k
        self._observe()
        gone = self.slow_x - self.demand  # what the stroke is elsewhere by, beyond 0.03 mm
        stroke = self.demand + math.copysign(max(abs(gone) - 3e-5, 0.0), gone)
        widths = self._widths()
        for j in range(3):
            drive, s = self._angle(j, stroke), self.on_side[j]
            if s == 0.0:
                self.on_side[j], self.far[j] = self.d, drive
            elif s * (drive - self.far[j]) > 0.0:
                self.far[j] = drive
            elif s * (self.far[j] - drive) > widths[j]:
                self.far[j], self.on_side[j] = drive, -s
                new = 1 if s > 0 else 0
                self.learned[j, new] = min(self.learned[j, new], 18.0)  # a side seen again counts as 60 % of well known
        width = widths[0]
        vane = self.far[0] - 0.5 * self.on_side[0] * width + self.used[0]
        goal = self._goal(self.speed + self.speed_rate * k["lead"])
        soon = self._goal(self.speed + self.speed_rate * (k["lead"] + k["look_ahead"]))
        slope = abs(self._goal(self.speed + 0.5) - self._goal(self.speed - 0.5))
        alpha = k["observer_alpha"]
        band = k["turn_band"] + k["turn_noise"] * slope * math.sqrt(self.noise * alpha / (2.0 - alpha))
        if self.side == 0:
            self.side, self.crossing = self.d, float(self.d)
        if self.side * (vane - soon) > band:
            self.side = -self.side
        left = self.side - self.crossing
        fastest = 2.0 * STEP / k["blend_time"] * (1.0 + min(slope * abs(self.speed_rate) / 0.02, 3.0))
        fastest = min(fastest, 0.25 * abs(left) + 1e-3)
        self.crossing += clip(left, -fastest, fastest)
        aim = goal if self.side * (goal - vane) > 0.0 else vane
        angle = aim - self.used[0] + 0.5 * self.crossing * width
        self.target = self._in_limits(float(np.interp(angle, self.angles[1], self.angles[0])))

    # ---- potentiometers

    def _pots(self, y: np.ndarray) -> None:
        k = self.k
        ok = (y >= k["pot_low"]) & (y <= k["pot_high"])  # not NaN
        self.pot = np.where(ok & ~self.pot_seen, y, self.pot)
        self.pot_seen |= ok
        self.pot = np.where(ok, self.pot + 0.1 * (y - self.pot), self.pot)
        self.doubt = np.where(ok, self.doubt, self.doubt + 0.02)

    def _learn(self) -> None:
        k = self.k
        motion = abs(self.demand - self.before)
        rests = self.mode == "RUN" and motion < 2e-5 and abs(self.demand - self.x) < 1e-4
        self.still = min(self.still + STEP, 1.0) if rests else 0.0
        settled = self.still >= 0.1
        for j in range(3):
            s, (offset, width) = self.on_side[j], self.known[j]
            expected = self.far[j] + offset - s * max(self.play[j] + width, 0.0) / 2.0
            r = self.pot[j] - expected
            known = min(self.learned[j])
            gate = k["pot_gate"] + (0.0 if known >= 15.0 else k["offset_limit"] + k["width_limit"] / 2.0)
            gate += 0.0 if settled else 0.004 + 60.0 * motion
            plausible = bool(self.pot_seen[j]) and s != 0.0 and abs(r) <= gate
            self._trust(j, expected, plausible)
            if not (plausible and self.trusted[j] and settled):
                continue
            side = 0 if s > 0 else 1
            new = 1.0 - self.learned[j, side] / 30.0
            fastest = k["learn_rate"] * (1.0 + 11.0 * new)
            g = clip(r / (k["learn_time"] * (1.0 - 0.75 * new)), -fastest, fastest) * STEP
            share = 0.5 + 0.4 * min(known / 30.0, 1.0)
            offset, width = self.known[j] + np.array([share * g, -2.0 * s * (1.0 - share) * g])
            if known >= 15.0:
                budget = k["learn_budget"]
                offset = clip(offset, self.proved[j, 0] - budget, self.proved[j, 0] + budget)
                width = clip(width, self.proved[j, 1] - budget, self.proved[j, 1] + budget)
            self.known[j] = (
                clip(offset, -k["offset_limit"], k["offset_limit"]),
                clip(width, -min(k["width_limit"], self.play[j]), k["width_limit"]),
            )
            self.learned[j, side] = min(self.learned[j, side] + STEP, 30.0)
            if known < 15.0:
                self.proved[j] = self.known[j]
        step = k["apply_rate"] * STEP
        self.used = self.used + np.clip(self.known[0] - self.used, -step, step)

    def _trust(self, j: int, expected: float, plausible: bool) -> None:
        restart = not plausible
        if plausible:
            self.doubt[j] = max(self.doubt[j] - 0.02, 0.0)
            self.low[j], self.high[j] = min(self.low[j], expected), max(self.high[j], expected)
            if self.high[j] - self.low[j] >= self.k["pot_trust"] and self.doubt[j] == 0.0:
                self.trusted[j], self.proved[j], restart = True, self.known[j], True
        else:
            self.doubt[j] += 0.2
        if self.doubt[j] >= 1.0:
            if self.trusted[j]:
                self.known[j] = self.proved[j]
            self.trusted[j] = self.pot_seen[j] = False
            self.doubt[j], restart = 1.0, True
        if restart:
            self.low[j] = self.high[j] = expected
