"""``python -m vaneloop``: the command line."""

from vaneloop.cli.main import run

run()
