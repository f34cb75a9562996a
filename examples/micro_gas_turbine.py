"""Micro gas turbine (Bielski and Kottonau 2024): the steady electrical power for each input voltage, nothing else.

Data: UCI Machine Learning Repository, dataset 994, ex_1.csv to ex_24.csv.

    vaneloop diagnose ex_1.csv --also ex_9.csv ex_20.csv ex_21.csv ex_23.csv ex_24.csv --test ex_4.csv ex_22.csv \\
        --system examples/micro_gas_turbine.py --report turbine.html
"""

from vaneloop import System, unknown


def power(u, p):
    """Steady electrical power in W."""
    v = (u.input_voltage - 6.5) / 3.5
    return p.middle + v * (p.slope + v * (p.bend + v * p.twist))


system = System(
    name="turbine",
    kind="static",
    model=power,
    inputs={"input_voltage": "V"},
    outputs={"el_power": "W"},
    parameters=[
        unknown("middle", 2000.0, "W"),
        unknown("slope", 1000.0, "W"),
        unknown("bend", 100.0, "W"),
        unknown("twist", 100.0, "W"),
    ],
)
