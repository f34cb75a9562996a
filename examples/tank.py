"""A tank with a pump, whose outflow is taken to be proportional to the level: docs/your_own_model.md."""

from vaneloop import System, unknown


def derivative(x, u, p):
    """Rate of the level, cm/s."""
    return p.inflow * u.pump - p.outflow * x.level


system = System(
    name="tank",
    kind="simulate",
    model=derivative,
    inputs={"pump": "V"},
    states={"level": "cm"},
    outputs={"level": "cm"},  # named like a state: it is that state
    parameters=[unknown("inflow", 0.1, "cm/(V s)", low=0.0), unknown("outflow", 0.01, "1/s", low=0.0)],
)
