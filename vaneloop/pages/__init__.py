"""Self-contained HTML pages, one module a kind of answer; `page` is the frame of each, `figures` are its pictures."""

__all__: list[str] = []
