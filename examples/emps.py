"""Electro-mechanical positioning system (Janot, Gautier, Brunot 2019): mass and viscous friction are known of, nothing
else.

Data: DATA_EMPS.mat to fit, DATA_EMPS_PULSES.mat to test, from nonlinearbenchmark.org.

    vaneloop diagnose DATA_EMPS.mat --test DATA_EMPS_PULSES.mat --system examples/emps.py --report emps.html
"""

from vaneloop import System, unknown


def force(u, p):
    """Force on the carriage in N, from its motion."""
    return p.mass * u.acceleration + p.viscous * u.velocity


def read(path):
    """Channels of one file, in SI units."""
    from scipy.io import loadmat

    d = loadmat(path, squeeze_me=True)
    return {"t": d["t"], "position": d["qm"], "motor_force": d["gtau"] * d["vir"]}


system = System(
    name="emps",
    kind="force",  # the axis is a double integrator: simulated freely it would drift away, whatever the model
    model=force,
    position="position",
    outputs={"motor_force": "N"},
    parameters=[unknown("mass", 100.0, "kg", low=1.0), unknown("viscous", 100.0, "N s/m", low=0.0)],
    read=read,
)
