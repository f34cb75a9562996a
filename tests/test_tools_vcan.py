"""Tools' clients on a real vcan0 (`make test-can`): pyxcp and udsoncan against the installed command."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.installed_run import installed_run, until_heard
from tests.vcan.run import INTERFACE

pytestmark = pytest.mark.socketcan


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[Path]:
    """The controller on vcan0 with both services; the folder that it saves into."""
    tuned = tmp_path / "tuned"
    with installed_run("--bus", INTERFACE, "--xcp", "--uds", "--xcp-save", str(tuned)):
        yield tuned


@pytest.mark.any_speed
def test_both_clients_talk_to_the_controller_on_vcan0(controller: Path) -> None:
    pytest.importorskip("pyxcp")
    pytest.importorskip("udsoncan")
    from pyxcp.master import Master
    from pyxcp.master.errorhandler import UnrecoverableError
    from pyxcp.types import XcpTimeoutError
    from udsoncan.exceptions import TimeoutException

    from controller import load_calibration as load
    from hil.bus.port import open_bus
    from hil.uds.station import RESPONSE
    from tests.test_uds import client_on_a_bus
    from tests.test_xcp import application, save_kp, unlock_calibration

    def calibrate() -> None:
        app = application(interface="socketcan", channel=INTERFACE)
        app.transport.timeout = 10.0
        with Master("can", config=app) as x:
            x.connect()
            unlock_calibration(x)
            save_kp(x, 11.0)
            x.disconnect()

    until_heard(calibrate, XcpTimeoutError, UnrecoverableError)
    assert load(controller / "calibration.toml").scalars.kp == 11.0
    bus = open_bus(INTERFACE, can_filters=[{"can_id": RESPONSE, "can_mask": 0x7FF}])
    with client_on_a_bus(bus) as c:

        def unlock() -> None:
            assert c.read_data_by_identifier(0xF18C).service_data.values[0xF18C] == "VANELOOP-0001"
            c.change_session(3)
            c.unlock_security_access(1)

        until_heard(unlock, TimeoutException)
    bus.shutdown()
