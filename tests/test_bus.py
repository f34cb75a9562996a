"""One class of tests for every bus: lockstep, the embedded bus between processes, SocketCAN where the kernel has it."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import numpy as np
import pytest

from hil.bus import broker, frames
from hil.bus.lockstep_bus import Channel, LockstepBus
from hil.bus.port import Port, open_bus
from hil.loop.node import Ecu, Node
from tests.conftest import ROOT
from vaneloop.base.errors import InputError

Join = Callable[..., can.BusABC]
PATIENCE = 120.0  # s for what must come: a busy machine takes its time, and nothing here judges it


def data_frame(ident: int, data: bytes = b"", **more: object) -> can.Message:
    return can.Message(arbitration_id=ident, data=data, is_extended_id=ident > 0x7FF, **more)  # type: ignore[arg-type]


def same(a: can.Message | None, b: can.Message) -> bool:
    return a is not None and a.equals(b, timestamp_delta=None, check_channel=False, check_direction=False)


class BusTests:
    """What every bus must do. A subclass gives `join`: open another participant of one and the same bus."""

    has_fd = True
    tells_own_process = True  # SocketCAN says "transmitted" of every frame of this machine
    burst = 100  # frames that may wait on this bus

    @pytest.fixture
    def join(self) -> Iterator[Join]:
        raise NotImplementedError

    def test_a_frame_reaches_every_other_participant_and_not_its_sender(self, join: Join) -> None:
        a, b, c = join(), join(), join()
        sent = data_frame(0x123, b"\x01\x02\x03")
        a.send(sent)
        assert same(b.recv(PATIENCE), sent) and same(c.recv(PATIENCE), sent)
        assert a.recv(0.05) is None

    def test_own_frames_are_heard_only_where_asked_for(self, join: Join) -> None:
        a, b = join(receive_own_messages=True), join()
        sent = data_frame(0x321, b"own")
        a.send(sent)
        assert same(own := a.recv(PATIENCE), sent) and own is not None and not own.is_rx
        other = b.recv(PATIENCE)
        assert same(other, sent) and other is not None and (other.is_rx or not self.tells_own_process)

    @pytest.mark.parametrize("length", range(9))
    def test_every_length_and_both_kinds_of_identifier_arrive(self, join: Join, length: int) -> None:
        a, b = join(), join()
        for ident in (0, 0x7FF, 0x800, 0x1FFFFFFF):
            sent = data_frame(ident, bytes(range(length)))
            a.send(sent)
            assert same(b.recv(PATIENCE), sent)

    def test_extended_identifier_below_0x800_stays_extended(self, join: Join) -> None:
        a, b = join(), join()
        sent = can.Message(arbitration_id=0xA0, is_extended_id=True, data=bytes(8))
        a.send(sent)
        assert same(b.recv(PATIENCE), sent)

    def test_remote_frame_arrives_with_its_length(self, join: Join) -> None:
        a, b = join(), join()
        sent = can.Message(arbitration_id=0xA0, is_extended_id=False, is_remote_frame=True, dlc=5)
        a.send(sent)
        assert same(b.recv(PATIENCE), sent)

    def test_can_fd_arrives_or_is_refused(self, join: Join) -> None:
        a, b = join(), join()
        sent = data_frame(0xA0, bytes(range(48)), is_fd=True)
        if not self.has_fd:
            with pytest.raises(can.CanError):
                a.send(sent)
            return
        a.send(sent)
        assert same(b.recv(PATIENCE), sent)

    def test_order_is_kept_in_a_burst(self, join: Join) -> None:
        a, b = join(), join()
        n = self.burst
        for k in range(n):
            a.send(data_frame(0x100, k.to_bytes(4, "little")), timeout=PATIENCE)
        got = [b.recv(PATIENCE) for _ in range(n)]
        assert [int.from_bytes(m.data, "little") for m in got if m] == list(range(n))

    def test_filters_let_through_what_they_name(self, join: Join) -> None:
        a, b = join(), join(can_filters=[{"can_id": 0x0B0, "can_mask": 0x7F0, "extended": False}])
        for ident in (0x0A0, 0x0B0, 0x0B3, 0x1B0):
            a.send(data_frame(ident, bytes(8)))
        assert [m.arbitration_id for m in (b.recv(PATIENCE), b.recv(PATIENCE)) if m] == [0x0B0, 0x0B3]
        assert b.recv(0.05) is None
        b.set_filters(None)
        a.send(data_frame(0x1B0, bytes(8)))
        assert same(b.recv(PATIENCE), data_frame(0x1B0, bytes(8)))

    def test_recv_gives_none_when_nothing_comes(self, join: Join) -> None:
        a = join()
        assert a.recv(0) is None and a.recv(0.02) is None

    def until_stamped(self, a: can.BusABC, b: can.BusABC) -> None:
        """Wait until frames have the time of their arrival."""

    def test_timestamps_do_not_run_backwards(self, join: Join) -> None:
        a, b = join(), join()
        self.until_stamped(a, b)
        for k in range(8):
            a.send(data_frame(k, bytes(8)), timeout=PATIENCE)
        stamps = [m.timestamp for m in (b.recv(PATIENCE) for _ in range(8)) if m]
        assert len(stamps) == 8 and stamps == sorted(stamps)

    def test_port_carries_frames_as_words(self, join: Join) -> None:
        a, b = Port(join()), Port(join())
        rows = np.array(
            [[frames.word0(0xA0), -1], [3 << 32 | 0x7FF, 0x030201], [frames.EXTENDED | 1 << 32 | 0x12345, 0x7F]],
            np.int64,
        )
        assert a.write(rows) == 3
        got = np.zeros((10, 2), np.int64)
        n, deadline = 0, time.monotonic() + PATIENCE
        while n < 3 and time.monotonic() < deadline:
            n += b.read(got[n:])
            self.wait(b.bus)
        assert np.array_equal(got[:n], rows)
        assert a.refused == b.lost == 0

    def wait(self, bus: can.BusABC) -> None:
        time.sleep(0.001)

    def test_ecu_and_controller_run_over_the_bus(self, join: Join) -> None:
        vgv_port, ecu_port = Port(join()), Port(join())
        vgv, ecu = Node(seed=1), Ecu(seed=1)
        rows = np.zeros((64, 2), np.int64)
        by_ecu = 0
        for _ in range(
            700
        ):  # the nodes have no clock: each tick waits for what the other has sent, however long the bus takes
            by_vgv = vgv_port.write(vgv.tick(rows, self.arrived(vgv_port, rows, by_ecu)))
            by_ecu = ecu_port.write(ecu.tick(rows, self.arrived(ecu_port, rows, by_vgv)))
        assert vgv.mode == "RUN" and vgv.counts["good"] >= 60 and ecu.stale() == []
        assert vgv.faults == 0 and ecu.values["state"] == 2.0

    def arrived(self, port: Port, rows: np.ndarray, frames: int) -> int:
        """Take so many frames into the first ``rows``."""
        got, until = port.read(rows), time.monotonic() + PATIENCE
        while got < frames and time.monotonic() < until:
            self.step(port.bus)
            got += port.read(rows[got:])
        assert got == frames
        return got

    def step(self, bus: can.BusABC) -> None:
        time.sleep(0.0002)

    def test_after_shutdown_a_bus_refuses(self, join: Join) -> None:
        a = join()
        a.shutdown()
        a.shutdown()
        with pytest.raises((can.CanError, ValueError, OSError)):
            a.send(data_frame(1))


def keep(opened: list[can.BusABC], bus: can.BusABC) -> can.BusABC:
    opened.append(bus)
    return bus


class TestLockstep(BusTests):
    """The simulated wire."""

    has_fd = False
    burst = 60

    @pytest.fixture
    def join(self) -> Iterator[Join]:
        opened: list[can.BusABC] = []
        channel = Channel()
        yield lambda **options: keep(opened, LockstepBus(channel, **options))
        for bus in opened:
            bus.shutdown()

    def wait(self, bus: can.BusABC) -> None:
        bus.channel.advance(0.001)  # type: ignore[attr-defined]

    step = wait


@pytest.mark.socketcan
@pytest.mark.any_speed
class TestSocketcan(BusTests):
    """A real vcan0: this machine's own, or that of a kernel booted for it."""

    tells_own_process = False

    @pytest.fixture
    def join(self) -> Iterator[Join]:
        opened: list[can.BusABC] = []
        yield lambda **options: keep(opened, open_bus("vcan0", **options))
        for bus in opened:
            bus.shutdown()

    def until_stamped(self, a: can.BusABC, b: can.BusABC) -> None:
        """A kernel begins to stamp frames some time after the first socket that asks for it. Until then they have the
        time at which they are read.
        """
        for _ in range(round(PATIENCE / 0.01)):
            a.send(data_frame(0x100, b""), timeout=PATIENCE)
            time.sleep(0.01)
            before_reading = time.time()
            m = b.recv(PATIENCE)
            assert m is not None
            if m.timestamp < before_reading:
                return
        raise AssertionError("the kernel does not stamp frames when they arrive")


class TestLocal(BusTests):
    """The embedded bus between processes."""

    @pytest.fixture
    def name(self) -> str:
        return f"test-{os.getpid()}-{uuid.uuid4().hex[:8]}"

    @pytest.fixture
    def join(self, name: str) -> Iterator[Join]:
        opened: list[can.BusABC] = []
        yield lambda **options: keep(opened, open_bus(f"local:{name}", **options))
        for bus in opened:
            bus.shutdown()

    def test_a_slow_reader_is_told_in_place_how_much_it_lost(
        self, join: Join, caplog: pytest.LogCaptureFixture
    ) -> None:
        fast, slow, quick = join(), join(), join()
        n = broker.BACKLOG + 6000
        for k in range(n):
            fast.send(data_frame(0x100, k.to_bytes(4, "little")))
            while k % 64 == 63 and (m := quick.recv(PATIENCE)) is not None and m.data[0] & 63 != 63:
                pass
        numbers, told = [], []
        while len(numbers) - len(told) + sum(told) < n:
            m = slow.recv(PATIENCE)
            assert m is not None
            if m.is_error_frame:
                told.append(int.from_bytes(m.data[4:8], "little"))
                assert m.arbitration_id == 0x4 and m.data[1] == 1
                numbers.append(None)
            else:
                numbers.append(int.from_bytes(m.data, "little"))
        assert sum(told) > 0 and len(numbers) - len(told) + sum(told) == n and slow.recv(0.05) is None
        gap = numbers.index(None)
        assert numbers[:gap] == list(range(gap))
        after = [k for k in numbers[gap:] if k is not None]
        assert after == sorted(after)
        assert slow.lost == sum(told) and quick.lost == 0  # type: ignore[attr-defined]
        assert "too slow" in caplog.text

    def test_any_python_can_program_joins_by_the_interface_name(self, join: Join, name: str) -> None:
        a, heard = join(), []
        command = [sys.executable, "-u", "-m", "can.logger", "-i", "vaneloop", "-c", name]  # it prints each frame
        # a shell has what it starts in the background ignore interrupts, and what that starts
        heeding = ["env", "--default-signal=INT", *command]
        logger = subprocess.Popen(heeding, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        try:
            assert logger.stdout is not None
            while b"Can Logger" not in logger.stdout.readline():
                pass
            for k in range(50):
                a.send(data_frame(0x0A0, bytes([k] * 8)))
            heard = [logger.stdout.readline().decode() for _ in range(50)]
            logger.send_signal(signal.SIGINT)
            assert b" ID: " not in logger.communicate(timeout=PATIENCE)[0]  # no frame came twice
        finally:
            logger.kill()
            logger.wait()
        assert all(" 0a0 " in line.lower() and f"{k:02x} {k:02x}" in line for k, line in enumerate(heard)), heard

    def test_a_killed_broker_is_replaced_and_the_reader_told(self, join: Join, name: str) -> None:
        a, b = join(), join()
        a.send(data_frame(1))
        assert same(b.recv(PATIENCE), data_frame(1))
        os.kill(broker_of(name), signal.SIGKILL)
        told = b.recv(PATIENCE)
        assert told is not None and told.is_error_frame and told.arbitration_id == 0x100
        deadline = time.monotonic() + PATIENCE
        while b.restarts < 1 or a.restarts < 1:  # type: ignore[attr-defined]
            assert time.monotonic() < deadline
            a.recv(0.05)
        a.send(data_frame(2))
        assert same(b.recv(PATIENCE), data_frame(2))

    def test_the_broker_ends_after_its_last_participant(self, join: Join, name: str) -> None:
        a = join()
        pid = broker_of(name)
        a.shutdown()
        deadline = time.monotonic() + PATIENCE
        while Path(f"/proc/{pid}").exists():
            assert time.monotonic() < deadline, "the broker stays"
            time.sleep(0.05)

    def test_the_broker_has_the_highest_priority_of_its_participants(self, join: Join, name: str) -> None:
        if resource.getrlimit(resource.RLIMIT_RTPRIO)[0] < 7 and os.geteuid() != 0:
            pytest.skip("this user may not use SCHED_FIFO")
        a = join()
        pid = broker_of(name)
        assert os.sched_getscheduler(pid) == os.SCHED_OTHER
        low, high = join(priority=3), join(priority=7)
        assert (os.sched_getscheduler(pid), os.sched_getparam(pid).sched_priority) == (os.SCHED_FIFO, 7)
        high.shutdown()
        a.send(data_frame(1))
        assert same(low.recv(PATIENCE), data_frame(1))
        deadline = time.monotonic() + PATIENCE
        while os.sched_getparam(pid).sched_priority != 3:  # the broker hears of the two in whichever order
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def test_a_killed_participant_leaves_the_others_undisturbed(self, join: Join, name: str) -> None:
        a, b = join(), join()
        code = f"from hil.bus.port import open_bus; b = open_bus('local:{name}'); print('in', flush=True); b.recv(60)"
        other = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE)
        assert other.stdout is not None and other.stdout.readline() == b"in\n"
        other.kill()
        other.wait()
        other.stdout.close()
        for k in range(20):
            a.send(data_frame(k))
            assert same(b.recv(PATIENCE), data_frame(k))

    @pytest.mark.slow
    def test_two_that_start_at_once_are_on_one_bus(self, name: str) -> None:
        code = (
            f"from hil.bus.port import open_bus; import can, time; b = open_bus('local:{name}'); end = "
            f"time.monotonic() + 120; heard = None\n"
            "while heard is None and time.monotonic() < end:\n"
            "    b.send(can.Message(arbitration_id=5, is_extended_id=False)); heard = b.recv(0.05)\n"
            "b.send(can.Message(arbitration_id=5, is_extended_id=False)); print(heard is not None)"
        )
        both = [subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE) for _ in range(2)]
        assert [p.communicate(timeout=180)[0] for p in both] == [b"True\n", b"True\n"]

    @pytest.mark.parametrize("bad", ["a b", "a/b", "x" * 61, "ä"])
    def test_a_bad_name_is_refused_in_one_line(self, bad: str) -> None:
        with pytest.raises(InputError, match="1 to 60 letters"):
            open_bus(f"local:{bad}")


def broker_of(name: str) -> int:
    """Process of the broker of bus ``name``."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                words = (entry / "cmdline").read_bytes().split(b"\0")
                if len(words) > 3 and words[-3].endswith(b"broker.py") and words[-2] == name.encode():
                    return int(entry.name)
    raise AssertionError(f"no broker of {name}")


# ---- choice ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["", "lo", "eth0", "can", "vcan0:x", "serial", "loc al"])
def test_an_unknown_bus_is_one_line(name: str) -> None:
    with pytest.raises(InputError, match="--bus") as e:
        open_bus(name)
    assert "\n" not in str(e.value) and "local" in str(e.value)


def test_an_interface_that_is_not_there_names_the_way_out() -> None:
    with pytest.raises(InputError, match=r"--bus can987: .*--bus local") as e:
        open_bus("can987")
    assert "\n" not in str(e.value)
