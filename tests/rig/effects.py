"""What can be hidden in the machine: the library's effects by their names, and effects that no library has.

Each entry says where it sits, its parameters with units, and five sizes from undetectable to gross. Equations are in
docs/rig.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from .geometry import Geometry
from .kernel import P

DEG = np.pi / 180.0
ALL_STAGES = -1


@dataclass(frozen=True)
class Parameter:
    """One number of an effect: its slot in the kernel (the first of several where each stage has one), unit, neutral
    value, meaning.
    """

    slot: P | None
    unit: str
    neutral: float
    meaning: str
    per_stage: bool = False
    offset: P | None = None  # slot of the nominal value that is added to the size
    at_vane: bool = False  # the size is meant at the vane, the slot at the ring: over the lever's ratio


@dataclass(frozen=True)
class Effect:
    """An effect that can be hidden.

    stage     stage of the chain where it acts: demand, servo, engine, actuator, linkage
    site      demand, engine, valve, supply, actuator, lvdt, linkage, pot
    main      the parameter whose size is laddered
    ladder    five sizes of ``main``, from undetectable to gross
    others    values of the other parameters
    signed    the size may have either sign (for factors: may be f or 1/f)
    stages    the effect belongs to one vane stage, given as the extra parameter ``stage`` (0, 1, ...; -1 = all)
    """

    name: str
    stage: str
    site: str
    parameters: Mapping[str, Parameter]
    main: str
    ladder: tuple[float, float, float, float, float]
    others: Mapping[str, float] = field(default_factory=dict)
    signed: bool = False
    stages: bool = False


@dataclass(frozen=True)
class Hidden:
    """One effect hidden in a run, with its parameters (SI), from ``onset`` (s) on."""

    name: str
    parameters: Mapping[str, float]
    onset: float = 0.0

    def __post_init__(self) -> None:
        if self.name not in CATALOGUE:
            raise ValueError(f"effect (={self.name!r}) must be one of {', '.join(CATALOGUE)}")
        effect = CATALOGUE[self.name]
        allowed = {*effect.parameters, *(["stage"] if effect.stages else [])}
        for key in self.parameters:
            if key not in allowed:
                raise ValueError(f"{self.name}: parameter (={key!r}) must be one of {', '.join(sorted(allowed))}")
        if effect.main not in self.parameters:
            raise ValueError(f"{self.name}: parameter {effect.main!r} is missing")


def _one(
    name,
    stage,
    site,
    main,
    slot,
    unit,
    neutral,
    meaning,
    ladder,
    *,
    signed=False,
    stages=False,
    more=None,
    others=None,
    **kw,
) -> Effect:
    """Build an entry with one laddered parameter and possibly ``more``."""
    first = Parameter(slot, unit, neutral, meaning, per_stage=stages, **kw)
    return Effect(
        name,
        stage,
        site,
        MappingProxyType({main: first, **(more or {})}),
        main,
        tuple(ladder),
        MappingProxyType(others or {}),
        signed,
        stages,
    )


def _table(*entries: Effect) -> Mapping[str, Effect]:
    return MappingProxyType({e.name: e for e in entries})


# fmt: off
EFFECTS = _table(
    # demand, CAN, controller
    _one("can_delay", "demand", "demand", "delay", P.can_delay, "s", 0.0,
         "age of a frame when the controller gets it", (0.01, 0.02, 0.04, 0.1, 0.25)),
    _one("frame_hold", "demand", "demand", "period", P.frame_hold, "s", 0.0,
         "the content of the frame changes only this often", (0.02, 0.03, 0.06, 0.12, 0.4)),
    _one("schedule_error", "demand", "demand", "offset", P.schedule_offset, "m", 0.0,
         "shift of the stroke table", (5e-7, 5e-6, 5e-5, 3e-4, 1.5e-3), signed=True),
    _one("trend_threshold_error", "demand", "demand", "factor", None, "-", 1.0,
         "threshold of the trend over its nominal value", (1.02, 1.3, 2.0, 4.0, 10.0)),
    _one("controller_gain_error", "servo", "demand", "factor", P.controller_gain, "-", 1.0,
         "current over what the controller meant", (1.002, 1.02, 1.1, 1.3, 1.8), signed=True),
    # engine
    _one("rotor_lag_error", "engine", "engine", "lag", P.engine_lag, "s", 0.0,
         "lag beyond nominal", (2e-3, 0.02, 0.2, 0.5, 1.2), offset=P.engine_lag),
    _one("acceleration_limit_error", "engine", "engine", "limit", P.acceleration, "%/s", 0.0,
         "acceleration limit beyond nominal", (-0.005, -0.05, -0.6, -2.0, -5.0), offset=P.acceleration),
    # valve
    _one("valve_null_bias", "actuator", "valve", "bias", P.null_bias, "A", 0.0,
         "current that the valve adds to its command", (1e-6, 5e-6, 3e-5, 2e-4, 1e-3), signed=True),
    _one("valve_dead_band", "actuator", "valve", "half_width", P.dead_band, "A", 0.0,
         "current that moves the spool but no oil", (3e-6, 1e-5, 5e-5, 3e-4, 1.5e-3)),
    _one("valve_hysteresis", "actuator", "valve", "width", P.valve_hysteresis, "A", 0.0,
         "total width between rising and falling current", (5e-6, 5e-5, 3e-4, 8e-4, 2.5e-3)),
    _one("valve_flow_saturation", "actuator", "valve", "limit", P.flow_limit, "m/s", np.inf,
         "speed beyond which the flow does not rise", (0.14, 0.06, 0.02, 0.016, 0.012),
         more={"exponent": Parameter(P.flow_exponent, "-", 20.0, "how sharp the corner is; 2: an orifice in series")}),
    _one("valve_lag", "actuator", "valve", "time_constant", P.valve_lag, "s", 0.0,
         "first-order lag before the spool", (5e-5, 5e-4, 3e-3, 0.01, 0.03)),
    _one("valve_gain_asymmetry", "actuator", "valve", "ratio", P.asymmetry, "-", 1.0,
         "flow gain extending over flow gain retracting", (1.0005, 1.005, 1.03, 1.1, 1.3), signed=True),
    # supply
    _one("supply_pressure_droop", "actuator", "supply", "droop", P.droop, "Pa/(m/s)", 0.0,
         "supply pressure lost with piston speed", (1e5, 1e6, 1.5e7, 6e7, 2e8)),
    _one("oil_viscosity", "actuator", "supply", "coefficient", P.viscosity, "1/K", 0.0,
         "relative flow gain per kelvin above 40 degC", (1e-5, 1e-4, 1e-3, 3e-3, 8e-3), signed=True),
    # actuator
    _one("piston_friction", "actuator", "actuator", "force", P.coulomb, "N", 0.0,
         "Coulomb friction", (20.0, 100.0, 400.0, 1500.0, 5000.0)),
    _one("piston_stiction", "actuator", "actuator", "excess", P.stiction, "N", 0.0,
         "breakaway force above Coulomb friction", (20.0, 200.0, 1000.0, 3000.0, 8000.0),
         more={"speed": Parameter(P.stribeck_speed, "m/s", 5e-3, "Stribeck speed")}, others={"speed": 5e-3}),
    _one("internal_leakage", "actuator", "actuator", "coefficient", P.leakage, "m/s/Pa", 0.0,
         "stroke speed lost per load pressure", (1e-11, 1e-10, 1e-9, 4e-9, 1.5e-8)),
    _one("oil_compressibility", "actuator", "actuator", "compliance", P.compliance, "m/N", 0.0,
         "oil compliance beyond nominal", (1e-9, 1e-8, 1e-7, 1e-6, 4e-6)),
    _one("aero_load", "actuator", "actuator", "force", P.aero_force, "N", 0.0,
         "force against extension at 100 %, grows with n_r squared", (10.0, 100.0, 1000.0, 4000.0, 10000.0),
         signed=True),
    _one("end_stop_shift", "actuator", "actuator", "shift", P.stop_shift, "m", 0.0,
         "retraction stop in (> 0), extension stop in (< 0)", (5e-4, 1.5e-3, 3e-3, 5e-3, 8e-3), signed=True),
    # LVDT
    _one("lvdt_bias", "linkage", "lvdt", "bias", P.lvdt_bias, "m", 0.0,
         "reading above stroke", (1e-6, 1e-5, 1e-4, 4e-4, 1.2e-3), signed=True),
    _one("lvdt_gain", "linkage", "lvdt", "factor", P.lvdt_gain, "-", 1.0,
         "reading over stroke", (1.0001, 1.001, 1.01, 1.03, 1.1), signed=True),
    _one("lvdt_nonlinearity", "linkage", "lvdt", "amplitude", P.lvdt_nonlinearity, "m", 0.0,
         "one sine wave of error over the stroke", (1e-6, 1e-5, 1e-4, 4e-4, 1.5e-3), signed=True,
         more={"cubic": Parameter(P.lvdt_cubic, "m", 0.0, "cube of the way from mid-stroke, its straight part taken "
                                                          "out")}),
    _one("lvdt_lag", "actuator", "lvdt", "time_constant", P.lvdt_lag, "s", 0.0,
         "first-order lag behind the demodulator", (5e-5, 5e-4, 3e-3, 0.01, 0.03)),
    _one("lvdt_thermal_drift", "linkage", "lvdt", "coefficient", P.lvdt_thermal, "m/K", 0.0,
         "drift per kelvin of oil above 40 degC", (2e-8, 2e-7, 3e-6, 1e-5, 4e-5), signed=True),
    # linkage
    _one("linkage_backlash", "linkage", "linkage", "width", P.gap_change_0, "rad", 0.0,
         "total play at the vane beyond nominal", (5e-5, 5e-4, 3e-3, 8e-3, 2e-2), stages=True, at_vane=True),
    _one("linkage_compliance", "linkage", "linkage", "compliance", P.ring_compliance, "rad", 0.0,
         "ring angle lost at the load of 100 %", (1e-6, 1e-5, 3e-4, 1e-3, 4e-3)),
    _one("linkage_friction", "linkage", "linkage", "width", P.friction_width_0, "rad", 0.0,
         "total width of a smooth loop at the vane", (5e-5, 5e-4, 3e-3, 8e-3, 2e-2),
         stages=True, at_vane=True,
         more={"distance": Parameter(P.friction_distance, "rad", DEG, "turn of the ring after which the loop has "
                                                                      "closed to 1/e")},
         others={"distance": 0.2 * DEG}),
    _one("linkage_wear", "linkage", "linkage", "rate", P.wear_0, "rad/s", 0.0,
         "growth of the total play at the vane", (5e-8, 5e-7, 1.5e-5, 5e-5, 1.5e-4), stages=True, at_vane=True),
    _one("thermal_growth", "linkage", "linkage", "coefficient", P.thermal_growth_0, "rad/K", 0.0,
         "vane angle per kelvin of oil above 40 degC", (1e-7, 1e-6, 4e-5, 1.5e-4, 5e-4),
         signed=True, stages=True, at_vane=True),
    _one("crank_length_error", "linkage", "linkage", "error", None, "m", 0.0,
         "lower arm longer than in the table", (2e-6, 2e-5, 5e-4, 1.5e-3, 4e-3), signed=True, stages=True),
    _one("link_length_error", "linkage", "linkage", "error", None, "m", 0.0,
         "vertical link longer than in the table", (2e-7, 2e-6, 2e-4, 6e-4, 2e-3), signed=True, stages=True),
    _one("ring_eccentricity", "linkage", "linkage", "amplitude", P.eccentricity_0, "rad", 0.0,
         "sine of the ring's own angle added to it", (1e-5, 1e-4, 1e-3, 3e-3, 1e-2),
         stages=True, more={"phase": Parameter(P.eccentricity_phase, "rad", 0.0, "direction of the eccentricity")},
         others={"phase": 1.0}),
    # vane sensor
    _one("pot_bias", "linkage", "pot", "bias", P.pot_bias_0, "rad", 0.0,
         "reading above angle", (2e-5, 2e-4, 4e-3, 1.2e-2, 4e-2), signed=True, stages=True, offset=P.pot_bias_0),
    _one("pot_gain", "linkage", "pot", "factor", P.pot_gain_0, "-", 1.0,
         "reading over angle", (1.0001, 1.001, 1.01, 1.03, 1.1), signed=True, stages=True),
    _one("pot_lag", "linkage", "pot", "time_constant", P.pot_tau_0, "s", 0.0,
         "lag beyond nominal", (1e-4, 1e-3, 8e-3, 0.025, 0.1), stages=True, offset=P.pot_tau_0),
)

OUTSIDE = _table(
    _one("lvdt_ripple", "actuator", "lvdt", "amplitude", P.ripple_amplitude, "m", 0.0,
         "demodulator ripple at a fixed frequency", (5e-7, 2e-6, 1.5e-5, 5e-5, 2e-4),
         more={"frequency": Parameter(P.ripple_frequency, "Hz", 7.3, "frequency")}, others={"frequency": 7.3}),
    _one("vane_vibration", "linkage", "linkage", "amplitude", P.vibration_amplitude, "rad", 0.0,
         "vibration with the rotor, resonant at one speed", (5e-5, 2e-4, 3e-3, 1e-2, 3e-2),
         more={"speed": Parameter(P.vibration_speed, "%", 80.0, "speed of resonance")}, others={"speed": 80.0}),
    _one("play_temperature", "linkage", "linkage", "coefficient", P.gap_thermal, "rad/K", 0.0,
         "growth of every ring's total play per kelvin", (2e-8, 2e-7, 1e-5, 3e-5, 1e-4)),
    _one("area_growth", "actuator", "actuator", "growth", P.area_growth, "-", 0.0,
         "piston area added towards full extension, at the end", (2e-4, 2e-3, 0.03, 0.1, 0.4)),
    _one("supply_dips", "actuator", "supply", "depth", P.dip_depth, "Pa", 0.0,
         "dips of the valve's supply by a second consumer, not logged", (5e3, 1e5, 2e6, 5e6, 1.2e7),
         more={"period": Parameter(P.dip_period, "s", 20.0, "time between dips")}, others={"period": 20.0}),
    _one("pot_cross_talk", "linkage", "pot", "share", P.cross_talk, "-", 0.0,
         "share of the vgv1 signal in the vigv reading", (1e-4, 1e-3, 0.02, 0.06, 0.2), signed=True),
    _one("valve_silting", "actuator", "valve", "current", P.silt_current, "A", 0.0,
         "change of current that frees a spool stuck after long rest", (5e-6, 5e-5, 5e-4, 2e-3, 6e-3),
         more={"rest": Parameter(P.silt_time, "s", 0.0, "rest after which it sticks")}, others={"rest": 2.0}),
    _one("ring_creep", "linkage", "linkage", "share", P.creep, "-", 0.0,
         "share of every move that arrives late", (1e-4, 1e-3, 0.02, 0.06, 0.2),
         more={"time": Parameter(P.creep_tau, "s", 15.0, "time constant of the late part")}, others={"time": 15.0}),
    _one("linkage_resonance", "linkage", "linkage", "frequency", P.ring_frequency, "Hz", 0.0,
         "natural frequency of the ring on its links", (400.0, 60.0, 8.0, 4.0, 2.0),
         more={"damping": Parameter(P.ring_damping, "-", 0.1, "damping ratio")}, others={"damping": 0.05}),
    _one("pot_track_wear", "linkage", "pot", "error", P.track_error, "rad", 0.0,
         "error of the vigv reading where its track is worn", (1e-5, 1e-4, 3e-3, 1e-2, 4e-2),
         signed=True,
         more={"angle": Parameter(P.track_angle, "rad", 0.0, "place"),
         "width": Parameter(P.track_width, "rad", DEG, "size")},
         others={"angle": -5.0 * DEG, "width": 6.0 * DEG}),
    _one("driver_oscillation", "actuator", "valve", "amplitude", P.dither_amplitude, "A", 0.0,
         "current added by an oscillating driver", (3e-6, 2e-5, 1e-4, 5e-4, 2e-3),
         more={"frequency": Parameter(P.dither_frequency, "Hz", 11.0, "frequency")}, others={"frequency": 3.1}),
    _one("stall_rumble", "linkage", "linkage", "amplitude", P.rumble_amplitude, "rad", 0.0,
         "shaking of the vanes in one band of speed", (5e-5, 2e-4, 2e-3, 6e-3, 2e-2),
         more={"speed": Parameter(P.rumble_speed, "%", 70.0, "centre of the band")}, others={"speed": 80.0}),
    _one("piston_cushion", "actuator", "actuator", "coefficient", P.cushion, "N/(m/s)^2", 0.0,
         "drag that grows with speed squared", (1e3, 1e5, 3e6, 1e7, 3e7)),
    _one("speed_dependent_lag", "engine", "engine", "slope", P.lag_slope, "1/%", 0.0,
         "relative change of the engine's lag per % above 70 %", (1e-6, 1e-5, 2e-3, 6e-3, 1.5e-2), signed=True),
    _one("lvdt_lost_bits", "actuator", "lvdt", "step", P.lvdt_lost_step, "m", 0.0,
         "resolution left when low bits are stuck", (1e-6, 4e-6, 5e-5, 2e-4, 8e-4)),
    _one("ring_snag", "linkage", "linkage", "depth", P.snag_depth, "rad", 0.0,
         "the VIGV ring is drawn towards and away from one angle", (1e-5, 1e-4, 1e-3, 3e-3, 8e-3),
         more={"angle": Parameter(P.snag_angle, "rad", 0.0, "ring angle of the snag")}, others={"angle": 0.0}),
    _one("return_spring", "actuator", "actuator", "stiffness", P.spring, "N/m", 0.0,
         "force towards mid-stroke", (1e3, 1e4, 1e5, 3e5, 6e5)),
    _one("null_over_temperature", "actuator", "valve", "coefficient", P.null_thermal, "A/K", 0.0,
         "shift of the valve's null per kelvin above 40 degC", (1e-7, 1e-6, 1e-5, 4e-5, 1.5e-4), signed=True),
    _one("null_over_pressure", "actuator", "valve", "coefficient", P.null_pressure, "A/Pa", 0.0,
         "shift of the valve's null per supply pressure", (1e-13, 2e-12, 5e-11, 2e-10, 6e-10), signed=True),
    _one("lvdt_over_pressure", "linkage", "lvdt", "coefficient", P.lvdt_pressure, "m/Pa", 0.0,
         "reading per supply pressure", (1e-13, 1e-12, 5e-11, 2e-10, 8e-10), signed=True),
    _one("acceleration_by_speed", "engine", "engine", "slope", P.rise_slope, "1/%", 0.0,
         "relative change of the acceleration limit per % above 70 %", (1e-5, 1e-4, 3e-3, 8e-3, 1.5e-2), signed=True),
    _one("servo_gain_warm", "servo", "demand", "coefficient", P.gain_thermal, "1/K", 0.0,
         "relative change of the controller's current per kelvin above 40 degC", (1e-5, 1e-4, 2e-3, 6e-3, 1.5e-2),
         signed=True),
    _one("schedule_bent", "demand", "demand", "amplitude", P.schedule_bend, "m", 0.0,
         "bend of the stroke table round 75 % speed", (5e-7, 5e-6, 5e-5, 3e-4, 1.5e-3), signed=True),
    _one("crank_bushing", "linkage", "linkage", "give", P.bushing, "m", 0.0,
         "stroke that a bushing at the crank takes once all of it has slipped", (1e-6, 1e-5, 2e-4, 6e-4, 2e-3)),
)
# fmt: on

MOTOR_EFFECTS = _table(  # of an electromechanical actuator only
    _one(
        "amplifier_offset",
        "actuator",
        "valve",
        "offset",
        P.amp_offset,
        "A",
        0.0,
        "current that the amplifier adds to its command",
        (1e-6, 5e-6, 3e-5, 2e-4, 1e-3),
        signed=True,
    ),
    _one(
        "amplifier_dead_band",
        "actuator",
        "valve",
        "half_width",
        P.amp_dead_band,
        "A",
        0.0,
        "command that the amplifier takes for none",
        (3e-6, 1e-5, 5e-5, 3e-4, 1.5e-3),
    ),
    _one(
        "amplifier_lag",
        "actuator",
        "valve",
        "time_constant",
        P.amp_lag,
        "s",
        0.0,
        "first-order lag before the speed loop",
        (5e-5, 5e-4, 3e-3, 0.01, 0.03),
    ),
    _one(
        "tacho_thermal_drift",
        "actuator",
        "valve",
        "coefficient",
        P.tacho_drift,
        "1/K",
        0.0,
        "relative speed per kelvin above 40 degC",
        (1e-5, 1e-4, 1e-3, 3e-3, 8e-3),
        signed=True,
    ),
    _one(
        "motor_torque_constant_error",
        "actuator",
        "actuator",
        "factor",
        P.torque_factor,
        "-",
        1.0,
        "torque for a current over nominal",
        (0.999, 0.98, 0.8, 0.5, 0.3),
    ),
    _one(
        "screw_friction",
        "actuator",
        "actuator",
        "force",
        P.extra_friction,
        "N",
        0.0,
        "Coulomb friction at the rod beyond nominal",
        (10.0, 100.0, 500.0, 1500.0, 4000.0),
    ),
    _one(
        "gear_backlash",
        "actuator",
        "actuator",
        "width",
        P.motor_play,
        "m",
        0.0,
        "total play between motor and rod",
        (5e-7, 5e-6, 3e-5, 6e-5, 1.2e-4),
    ),
    _one(
        "screw_pitch_error",
        "actuator",
        "actuator",
        "amplitude",
        P.pitch_error,
        "m",
        0.0,
        "sine of one screw turn in the stroke",
        (5e-7, 5e-6, 3e-5, 8e-5, 2e-4),
        more={"phase": Parameter(P.pitch_phase, "rad", 0.0, "its phase at the retracted stop")},
        others={"phase": 1.0},
    ),
)
WITH_MOTOR = MappingProxyType(
    {  # what can be hidden in a machine that has one
        **{
            k: e
            for k, e in EFFECTS.items()
            if e.stage != "actuator" or k in ("aero_load", "end_stop_shift", "lvdt_lag")
        },
        **MOTOR_EFFECTS,
    }
)

CATALOGUE: Mapping[str, Effect] = MappingProxyType({**EFFECTS, **OUTSIDE, **MOTOR_EFFECTS})


def draw(name: str, size: int, rng: np.random.Generator, onset: float = 0.0, stages: int = 3) -> Hidden:
    """Return the effect in rung ``size`` (0 undetectable .. 4 gross) of its ladder, up to 20 % off, with a random sign
    and vane stage of as many as the machine has.
    """
    e = CATALOGUE[name]
    p = e.parameters[e.main]
    value = e.ladder[size]
    spread = rng.uniform(0.8, 1.2)
    if p.neutral == 1.0:
        value = 1.0 + (value - 1.0) * spread
        if e.signed and rng.random() < 0.5:
            value = 1.0 / value
    else:
        value *= spread
        if e.signed and rng.random() < 0.5:
            value = -value
    if name in ("can_delay", "frame_hold"):
        value = round(value, 2)  # the controller looks at frames every 10 ms: between two multiples nothing changes
    parameters = {e.main: value, **e.others}
    if e.stages:
        parameters["stage"] = float(rng.integers(0, stages))
    return Hidden(name, parameters, onset)


def neutral(name: str) -> Hidden:
    """Return the effect at its neutral size: a machine without it."""
    e = CATALOGUE[name]
    return Hidden(name, {e.main: e.parameters[e.main].neutral, **e.others})


def apply(hidden: Hidden, p: np.ndarray, geometry: Geometry) -> tuple[np.ndarray, Geometry]:
    """Return parameters and geometry of the machine with the effect in it. What belongs to the controller is left
    alone.
    """
    effect = CATALOGUE[hidden.name]
    p = p.copy()
    which = int(hidden.parameters.get("stage", ALL_STAGES))
    own = range(len(geometry.stages))
    if which != ALL_STAGES and which not in own:
        raise ValueError(f"{hidden.name}: stage (={which}) must be -1 (all), or 0 to {own[-1]}")
    stages = own if which == ALL_STAGES else (which,)
    for key, value in hidden.parameters.items():
        if key == "stage":
            continue
        if not np.isfinite(value) and key != "limit":
            raise ValueError(f"{hidden.name}: {key} (={value}) must be finite")
        parameter = effect.parameters[key]
        if parameter.slot is None:
            if hidden.name == "crank_length_error":
                for k in stages:
                    geometry = geometry.with_error(k, crank=value)
            elif hidden.name == "link_length_error":
                for k in stages:
                    geometry = geometry.with_error(k, link=value)
            continue
        for k in stages if parameter.per_stage else (0,):
            base = p[parameter.offset + k] if parameter.offset is not None else 0.0
            p[parameter.slot + k] = base + (value / p[P.vane_ratio_0 + k] if parameter.at_vane else value)
    return p, geometry
