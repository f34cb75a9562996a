"""Self-contained HTML pages, one module a kind of answer; `page` draws them."""

__all__: list[str] = []
