"""What a user asks, one function a verb, each with one answer that terminal, JSON, page and notebook draw."""

__all__: list[str] = []
