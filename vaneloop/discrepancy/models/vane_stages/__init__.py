"""The stages of the vane chain, one module each, and what they share: raster, stroke, current, declared parameters."""

__all__: list[str] = []
