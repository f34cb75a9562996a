"""Terms that the library does not have: curves and surfaces, their regressors, their closed forms."""

__all__: list[str] = []
