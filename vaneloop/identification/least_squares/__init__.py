"""The least-squares problem of a subsystem: residuals, bounded Levenberg-Marquardt, Broyden's updates."""

__all__: list[str] = []
