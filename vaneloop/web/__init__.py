"""The workbench: a local page that schedules, runs, and finds the missing physics. `command` is its command line."""

__all__: list[str] = []
