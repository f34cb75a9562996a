"""Which candidates are accepted: linear screening, the search, acceptance rules, calibrated probabilities."""

__all__: list[str] = []
