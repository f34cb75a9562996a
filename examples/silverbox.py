"""Silverbox (Wigren and Schoukens 2013), an electronic circuit that oscillates as a mass on a spring does: mass,
damping and a linear spring are known of, nothing else.

Data: SNLS80mV.csv from nonlinearbenchmark.org. Ten multisines of 8,696 samples follow an arrow-shaped run.

    vaneloop diagnose SNLS80mV.csv --fit 66.45:73.00 --test 94.95:109.15 --system examples/silverbox.py
"""

from vaneloop import System, unknown

RATE = 1e7 / 2**14  # samples a second


def derivative(x, u, p):
    """Rates of the displacement (V) and of its speed (V/s), per unit of mass."""
    return x.speed, p.drive * u.u - p.damping * x.speed - p.spring * x.y


def read(path):
    """Channels of one file."""
    import numpy as np

    u, y = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1), unpack=True)
    return {"t": np.arange(len(u)) / RATE, "u": u, "y": y}


system = System(
    name="silverbox",
    kind="simulate",
    model=derivative,
    inputs={"u": "V"},
    states={"y": "V", "speed": "V/s"},
    outputs={"y": "V"},
    rates={"speed": "y"},
    between="smooth",  # the input was measured behind a low-pass: between two samples it bends
    start={"speed": "fitted"},
    parameters=[
        unknown("drive", 1e5, "1/s^2", low=0.0),
        unknown("damping", 10.0, "1/s", low=0.0),
        unknown("spring", 1e5, "1/s^2", low=0.0),
    ],
    read=read,
)
