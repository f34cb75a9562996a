"""``vaneloop web``: the workbench in the browser."""

from __future__ import annotations

import argparse
import os
import secrets
import socket
import sys
import webbrowser
from pathlib import Path

from vaneloop.base.errors import InputError
from vaneloop.base.extras import needs
from vaneloop.cli.options import add_controller_options, add_tables_option, machine_of
from vaneloop.web.guard import is_loopback

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Open the workbench: a page of this machine on which a log is dropped, the missing effect is found and
switched on, vanes are scheduled, and the loop runs live.

It prints a link and opens it. Whoever asks must know the token in that link; a cookie then remembers it. Give your own
token in the environment variable VANELOOP_WEB_TOKEN (16 characters or more), or one is made up. It listens on loopback
only, or on another --host. There is no encryption: on a network that others listen to, use an SSH tunnel to loopback
instead.

Logs that are uploaded go into a private temporary folder. It is removed at the end, or after a kill at the next start.
A model of your own is code; the page asks before it runs.

examples:
  vaneloop web
  vaneloop web --port 9000 --folder examples --no-open
  vaneloop schedule --geometry tables/geometry.toml --out engine7/
  vaneloop web --tables engine7/
  vaneloop web --host 0.0.0.0

exit codes: 0 ended, 2 bad input"""

PORT = 8765
LEAST_TOKEN = 16


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--host", metavar="A", default="127.0.0.1", help="address to listen on (default 127.0.0.1: this machine only)"
    )
    parser.add_argument(
        "--port", metavar="N", type=int, default=PORT, help=f"port to listen on; 0 takes a free one (default {PORT})"
    )
    parser.add_argument(
        "--folder", metavar="D", default=".", help="folder whose logs are offered (default: the current one)"
    )
    parser.add_argument(
        "--upload-limit", metavar="MB", type=int, default=512, help="largest file that may be uploaded (default 512)"
    )
    add_tables_option(parser)
    add_controller_options(parser, save_crash=False)
    parser.add_argument("--no-open", action="store_true", help="do not open a browser, only print the link")
    parser.add_argument("--quiet", action="store_true", help="say nothing but the link")


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if not 0 <= args.port <= 65535:
        raise InputError(f"--port (={args.port}) must be in [0, 65535]")
    if not 1 <= args.upload_limit <= 16384:
        raise InputError(f"--upload-limit (={args.upload_limit} MB) must be in [1, 16384]")
    folder = Path(args.folder)
    if not folder.is_dir():
        raise InputError(f"--folder {args.folder}: is not a folder")
    machine = machine_of(args)  # refuses wrong tables, too
    machine.plant.of_one_actuator("the workbench")
    machine.calibration.of_one_channel("the workbench")
    token = os.environ.get("VANELOOP_WEB_TOKEN") or secrets.token_urlsafe(24)
    if len(token) < LEAST_TOKEN or not token.isascii() or not all(c.isalnum() or c in "-_" for c in token):
        raise InputError(
            f"VANELOOP_WEB_TOKEN: {LEAST_TOKEN} or more letters, digits, - and _ are needed; it has {len(token)} "
            f"characters"
        )
    needs("the workbench", "nicegui", "tsdownsample")
    if not args.quiet:
        print("starting the workbench; its link follows ...", file=sys.stderr, flush=True)
    sock = _listen(args.host, args.port)
    host, port = sock.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    if host in ("0.0.0.0", "::"):
        shown = socket.gethostname()
    address = f"http://{shown}:{port}/?token="

    def ready(once: str) -> None:
        print(address + token, flush=True)
        if not args.quiet:
            print("Ctrl-C ends it", file=sys.stderr, flush=True)
        if not args.no_open:
            webbrowser.open(address + once)  # every user may read a browser's command line

    from vaneloop.web.server import serve

    serve(sock, folder, token, args.upload_limit << 20, is_loopback(args.host), ready, args.tables, args.controller)
    return 0


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, kind, proto, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        sock = socket.socket(family, kind, proto)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(where)
        sock.listen(128)
    except (OSError, UnicodeError) as e:
        raise InputError(
            f"--host {host} --port {port}: cannot listen there ({getattr(e, 'strerror', None) or e})"
        ) from None
    return sock
