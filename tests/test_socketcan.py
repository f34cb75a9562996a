"""On a real vcan0: this machine's own, or that of user-mode Linux (`make test-can`)."""

from __future__ import annotations

import re
import subprocess
import time

import can
import pytest

from tests.uml.run import INTERFACE

pytestmark = pytest.mark.socketcan


@pytest.fixture
def bus():
    with can.Bus(interface="socketcan", channel=INTERFACE) as opened:
        yield opened


def test_a_frame_passes_between_python_can_and_can_utils_both_ways(bus: can.BusABC) -> None:
    with subprocess.Popen(["candump", "-L", "-n", "1", f"{INTERFACE},123:7FF"], stdout=subprocess.PIPE, text=True) as foreign:
        time.sleep(0.3)
        bus.send(can.Message(arbitration_id=0x123, data=bytes(range(8)), is_extended_id=False))
        seen, _ = foreign.communicate(timeout=10)
    assert re.fullmatch(rf"\(\d+\.\d{{6}}\) {INTERFACE} 123#0001020304050607\n", seen)
    subprocess.run(["cansend", INTERFACE, "0A0#DEADBEEF"], check=True, timeout=10)
    received = bus.recv(timeout=5.0)
    assert received is not None
    assert (received.arbitration_id, bytes(received.data)) == (0x0A0, bytes.fromhex("DEADBEEF"))
