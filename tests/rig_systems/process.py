"""Families of process engineering and heat: tanks, flow loop, valve bench, thermal mass, heat exchanger."""

from __future__ import annotations

import numpy as np

from tests.rig_systems.family import HELD, Family, Outside, Signal

__all__ = ["FAMILIES"]

# "linear": one input, one output, linear but for the law; what delays may stand before or after it.


def _tanks(x, u, p):
    """Torricelli's outflow; levels cm, pump V. Ranges: laboratory tanks (Johansson 2000; Schoukens, Noel 2017)."""
    a, b = p.upper_outflow * max(x[0], 0.0) ** 0.5, p.lower_outflow * max(x[1], 0.0) ** 0.5
    return p.inflow * u[0] - a, a - b


def _spill(t, x, u, p, s, d):
    """What flows over the upper tank's rim falls into the lower one, as in the cascaded-tanks benchmark."""
    rim = (1.0 - s) * (8.0 * p.inflow / p.upper_outflow) ** 2
    over = 5.0 * p.upper_outflow / rim**0.5 * max(x[0] - rim, 0.0)
    return [d[0] - over, d[1] + over]


def _clog(t, x, u, p, s, d):
    lost = s * t * p.lower_outflow * max(x[1], 0.0) ** 0.5
    return [d[0], d[1] + lost]


TANKS = Family(
    name="tanks",
    text="two tanks in cascade, a pump; both levels measured",
    kind="simulate",
    parameters={"inflow": (0.15, 0.3), "upper_outflow": (0.2, 0.4), "lower_outflow": (0.2, 0.4)},
    inputs={"pump": Signal(("steps", "multisine", "binary", "cycle"), 0.0, 8.0)},
    states=("upper", "lower"),
    outputs=("upper", "lower"),
    rhs=_tanks,
    timescale=lambda p: 2.0 * 4.0 * p.inflow / min(p.upper_outflow, p.lower_outflow) ** 2,
    start=lambda p, u: (
        (p.inflow * max(u[0], 1.0) / p.upper_outflow) ** 2,
        (p.inflow * max(u[0], 1.0) / p.lower_outflow) ** 2,
    ),
    noise={"upper": (0.002, 0.02), "lower": (0.002, 0.02)},
    laws=(
        *("pump.dead_zone", "pump.saturation", "pump.smooth_saturation", "pump.dead_time", "pump.lag", "pump.bias"),
        *("upper.saturation", "upper.leak", "lower.quadratic_drag", "lower.offset", "lower.leak"),
        *("lower_sensor.bias", "lower_sensor.saturation", "lower_sensor.lag", "upper_sensor.cubic"),
    ),
    outside={
        "spill": Outside(
            "the upper tank's overflow falls into the lower one",
            0.02,
            0.6,
            rate=_spill,
            amounts_to=(frozenset({"upper.overflow_to_lower"}),),
        ),
        "clogging": Outside("the lower outflow clogs over the log", 0.01, 0.4, rate=_clog),
    },
    # inflow (u + b) = inflow u + a constant rate
    same=(frozenset({"pump.bias", "upper.offset"}),),
)


def _first(x, u, p):
    return ((p.gain * u[0] - x[0]) / p.time_constant,)


def _sticky(t, u, p, s):
    """Valve stem with a dead band S and a slip jump J = S/2 (Choudhury, Thornhill, Shah 2005): it stays until the
    controller has moved by S, then jumps by J and follows at S - J.
    """
    band, out = s * 80.0, np.empty_like(u)
    stem, turn, moving, way, last = u[0, 0], u[0, 0], False, 0.0, u[0, 0]
    for k, x in enumerate(u[0].tolist()):
        new = np.sign(x - last)
        if new and new != way:
            way, turn, moving = new, last, False
        if not moving and abs(x - turn) > band and abs(x - stem) > 0.5 * band:
            moving = True
        if moving and new:
            stem = x - way * 0.25 * band
        out[0, k] = stem
        last = x
    return out


FLOW_LOOP = Family(
    name="flow_loop",
    text="flow behind a control valve, first order; valve command in %, flow in m3/h",
    kind="simulate",
    parameters={"gain": (0.05, 1.0), "time_constant": (0.3, 5.0)},  # Seborg, Edgar, Mellichamp 2016, table 12.2: flow
    inputs={"valve": Signal(("cycle", "multisine", "sweep", "steps"), 10.0, 90.0)},
    states=("flow",),
    outputs=("flow",),
    rhs=_first,
    timescale=lambda p: p.time_constant,
    start=lambda p, u: (p.gain * u[0],),
    noise={"flow": (0.003, 0.03)},
    laws=(
        *("valve.play", "valve.dead_time", "valve.lag", "valve.rate_limit", "valve.saturation", "valve.cubic"),
        *("flow_sensor.saturation", "flow_sensor.square_root", "flow_sensor.quantisation", "flow_sensor.dead_time"),
        *("flow.quadratic_drag", "flow_sensor.bias"),
    ),
    outside={
        "stiction": Outside(
            "the valve sticks and jumps", 0.005, 0.15, source=_sticky,
            amounts_to=(frozenset({"valve.stiction"}), frozenset({"valve.stick_slip"})),
        ),
        "equal_percentage": Outside(
            "equal-percentage trim: flow rises exponentially with the stroke", 0.05, 3.0,
            source=lambda t, u, p, s: 100.0 * np.expm1(s * u / 100.0) / np.expm1(s),
        ),
    },
    same=(
        frozenset({"valve.dead_time", "flow_sensor.dead_time"}),  # linear
        frozenset({"valve.lag", "flow_sensor.lag"}),
        frozenset({"valve.second_order_lag", "flow_sensor.second_order_lag"}),
        # a valve above 10 % never crosses 0: a dead zone is a constant, as is one in flow, rate or sensor
        frozenset({"valve.bias", "valve.dead_zone", "flow.offset", "flow_sensor.bias", "flow_sensor.dead_zone"}),
    ),
    apart={"valve.rate_limit": HELD},
)  # fmt: skip


def _bench(u, p):
    return p.gain * u[0] + p.offset


VALVE_BENCH = Family(
    name="valve_bench",
    text="proportional valve on a flow bench: flow (l/min) over current (A), quasi-static",
    kind="static",
    parameters={"gain": (5.0, 100.0), "offset": (0.2, 5.0)},
    inputs={"current": Signal(("cycle", "sweep", "multisine", "steps"), -1.0, 1.0)},
    outputs=("flow",),
    rhs=_bench,
    timescale=lambda p: 1.0,
    per_scale=(8.0, 30.0),
    line=True,
    noise={"flow": (0.003, 0.03)},
    laws=(
        *("current.dead_zone", "current.saturation", "current.smooth_saturation", "current.play", "current.lag"),
        *("current.cubic", "current.asymmetric_gain", "current.rate_limit", "flow.quantisation", "flow.dead_time"),
        *("flow.absolute_value", "current.second_order_lag", "current.square_root"),
    ),
    outside={
        "one_edge": Outside(
            "overlap on one control edge only", 0.01, 0.4,
            output=lambda t, x, u, p, s, y: y - p.gain * np.clip(u, 0.0, s),
            # shifted by half the overlap, a dead zone of half the overlap is one on one side
            amounts_to=(frozenset({"current.bias", "current.dead_zone"}),),
        ),
        "notches": Outside(
            "metering notches: flow ripples with the stroke", 0.003, 0.1,
            output=lambda t, x, u, p, s, y: y + s * p.gain * np.sin(14.0 * u),
        ),
    },
    # y = gain u + offset: a law without memory but with odd or even symmetry may stand on either side
    same=(
        frozenset({"current.lag", "flow.lag"}),
        frozenset({"current.second_order_lag", "flow.second_order_lag"}),
        frozenset({"current.dead_time", "flow.dead_time"}),
        frozenset({"current.rate_limit", "flow.rate_limit"}),
        frozenset({"current.play", "flow.play"}),
        frozenset({"current.saturation", "flow.saturation"}),
        # a gain that differs with the sign of the current is one of rectifying a share of it
        frozenset({"current.asymmetric_gain", "current.absolute_value"}),
    ),
)  # fmt: skip


def _thermal(x, u, p):
    return ((u[0] - p.loss * x[0]) / p.capacity,)


def _radiate(t, x, u, p, s, d):
    """Grey body at 293 K, s times as much radiated as convected for small rises."""
    h = s * p.loss / (4.0 * 293.0**3)
    return [d[0] - h * ((293.0 + x[0]) ** 4 - 293.0**4) / p.capacity]


THERMAL_MASS = Family(
    name="thermal_mass",
    text="heated body, temperature rise above ambient (K), heater in W",
    kind="simulate",
    parameters={"capacity": (100.0, 2000.0), "loss": (1.0, 10.0)},  # 0.2 to 4 kg of aluminium; h A of Incropera 2011
    inputs={"heater": Signal(("binary", "steps", "cycle"), 0.0, 1.0, lambda p: 150.0 * p.loss)},
    states=("rise",),
    outputs=("rise",),
    rhs=_thermal,
    timescale=lambda p: p.capacity / p.loss,
    start=lambda p, u: (0.0,),
    noise={"rise": (0.002, 0.01)},
    laws=(
        *("rise.quadratic_drag", "rise.cubic", "rise.saturation", "rise.rate_limit", "rise.offset"),
        *("heater.saturation", "heater.lag", "heater.dead_time", "heater.square_root", "heater.smooth_saturation"),
        *("rise_sensor.lag", "rise_sensor.second_order_lag", "rise_sensor.cubic", "rise_sensor.quantisation"),
    ),
    outside={
        "radiation": Outside(
            "radiates with the fourth power of the temperature", 0.02, 1.0, rate=_radiate,
            # (T + x)^4 - T^4 = 4 T^3 x + 6 T^2 x^2 + 4 T x^3 + x^4; the loss takes the first term
            amounts_to=(
                frozenset({"rise.radiation"}), frozenset({"rise.quadratic_drag"}),
                frozenset({"rise.quadratic_drag", "rise.cubic"}),
            ),
        ),
        "draught": Outside(
            "the loss swings with a draught", 0.01, 0.4,
            rate=lambda t, x, u, p, s, d: [d[0] - s * p.loss / p.capacity * x[0] * np.sin(43.0 * t)],
        ),
    },
    same=(
        frozenset({"heater.dead_time", "rise_sensor.dead_time"}),  # linear
        frozenset({"heater.lag", "rise_sensor.lag"}),
        frozenset({"heater.second_order_lag", "rise_sensor.second_order_lag"}),
        frozenset({"heater.bias", "rise.offset"}),
    ),
)  # fmt: skip


def _exchanger(x, u, p):
    """Counterflow lumped into two stirred volumes (Bequette 1998): capacity flows W/K, temperatures degC."""
    q = p.conductance * (x[0] - x[1])
    return (u[0] * (u[1] - x[0]) - q) / p.capacity, (p.cold_flow * (p.cold_in - x[1]) + q) / p.capacity


def _film(t, x, u, p, s, d):
    """Film coefficient grows with flow^0.8 (Dittus, Boelter); s is its share of the resistance."""
    ratio = 1.0 / (1.0 - s + s * (max(u[0], 50.0) / 800.0) ** -0.8)
    dq = (ratio - 1.0) * p.conductance * (x[0] - x[1])
    return [d[0] - dq / p.capacity, d[1] + dq / p.capacity]


def _foul(t, x, u, p, s, d):
    dq = -s * t * p.conductance * (x[0] - x[1])
    return [d[0] - dq / p.capacity, d[1] + dq / p.capacity]


HEAT_EXCHANGER = Family(
    name="heat_exchanger",
    text="heat exchanger with measured hot flow and hot inlet; both outlets measured",
    kind="simulate",
    parameters={"conductance": (200.0, 2000.0), "capacity": (2e3, 2e4)},
    known=lambda p: {"cold_flow": 700.0, "cold_in": 15.0},
    inputs={
        "hot_flow": Signal(("steps", "cycle", "binary"), 300.0, 1500.0),
        "hot_in": Signal(("cycle", "steps", "multisine"), 60.0, 90.0),
    },
    states=("hot_out", "cold_out"),
    outputs=("hot_out", "cold_out"),
    rhs=_exchanger,
    timescale=lambda p: p.capacity / (800.0 + p.conductance),
    start=lambda p, u: tuple(
        np.linalg.solve(
            [[u[0] + p.conductance, -p.conductance], [-p.conductance, p.cold_flow + p.conductance]],
            [u[0] * u[1], p.cold_flow * p.cold_in],
        )
    ),
    noise={"hot_out": (0.003, 0.02), "cold_out": (0.003, 0.02)},
    laws=(
        *("hot_flow.bias", "hot_flow.gain", "hot_flow.saturation", "hot_flow.lag", "hot_in.bias", "hot_in.dead_time"),
        *("hot_in.lag", "hot_out_sensor.lag", "cold_out_sensor.bias", "cold_out_sensor.gain", "cold_out.leak"),
        *("hot_out_sensor.cubic", "hot_out.offset", "cold_out_sensor.dead_time"),
    ),
    outside={
        "film": Outside("the conductance grows with the flow", 0.05, 0.8, rate=_film),
        "fouling": Outside("the conductance falls over the log", 0.01, 0.5, rate=_foul),
    },
    # all flows and temperatures stay above 0, where a dead zone is a bias
    same=(
        frozenset({"hot_flow.bias", "hot_flow.dead_zone"}),
        frozenset({"hot_in.bias", "hot_in.dead_zone"}),
        frozenset({"cold_out_sensor.bias", "cold_out_sensor.dead_zone"}),
        frozenset({"hot_flow.gain", "hot_flow.asymmetric_gain"}),
        frozenset({"cold_out_sensor.gain", "cold_out_sensor.asymmetric_gain"}),
    ),
)

FAMILIES = (TANKS, FLOW_LOOP, VALVE_BENCH, THERMAL_MASS, HEAT_EXCHANGER)
