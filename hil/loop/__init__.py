"""The closed loop: the one tick, lockstep runner, nodes, the ECU, real time."""

__all__: list[str] = []
