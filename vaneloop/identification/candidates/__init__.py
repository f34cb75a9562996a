"""What may be missing: the library's terms and their laws, bases of curves, closed forms."""

__all__: list[str] = []
