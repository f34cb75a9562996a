"""Systems that users describe themselves: data, generated code, simulation, injection points, logs."""

__all__: list[str] = []
