"""The controller as a service engineer's tool sees it: a UDS server with trouble codes (docs/uds.md)."""

from hil.uds.server import Server
from hil.uds.trouble import TroubleMemory

__all__ = ["Server", "TroubleMemory"]
