"""Authentication of frames: against the RFC, scapy and cantools; what an attacker without the key can do; the same run
again from its record.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cantools.autosar import secoc as theirs
from hypothesis import example, given
from hypothesis import strategies as st

from hil.bus import frames, secoc
from hil.bus.frames import ECU_DEMAND, VGV_STATUS
from hil.bus.secoc import WINDOW, Authenticator, completed, read_key
from hil.calibrate.station import replay_attended
from hil.logs import read_log
from hil.logs.recorder import Recorder
from hil.logs.recordings import read_record
from hil.loop.node import Ecu, Node
from hil.loop.realtime import TICK_NS, run_realtime
from hil.loop.secured import DEMANDED, FROM_CONTROLLER, Gate, Secured, started
from vaneloop.base.errors import InputError
from vaneloop.cli.main import main

pytest.importorskip("cryptography")

HOLD, MOST_WAITING, BEHIND = 50, 16, 100  # ticks, frames, ms
KEY = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")  # of RFC 4493
NONE = np.zeros((0, 2), np.int64)
START = 1_700_000_000_000  # ms since 1970
word = st.integers(-(2**63), 2**63 - 1)
freshness_value = st.integers(0, 2**63 - 1)


@pytest.fixture(scope="module")
def authenticator() -> Authenticator:
    return Authenticator(KEY)


# ---- the MAC ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("length", "mac"),
    [
        (0, "bb1d6929e95937287fa37d129b756746"),
        (16, "070a16b46b4d4144f79bdd9dd04a287c"),
        (40, "dfa66747de9ae63030ca32611497c827"),
        (64, "51f0bebf7e3b9d92fc49741779363cfe"),
    ],
)
def test_the_mac_is_that_of_rfc_4493(authenticator: Authenticator, length: int, mac: str) -> None:
    text = bytes.fromhex(
        "6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e51"
        "30c81c46a35ce411e5fbc1191a0a52eff69f2445df4f9b17ad2b417be66c3710"
    )
    c = authenticator._begun.copy()
    c.update(text[:length])
    assert c.finalize().hex() == mac


@given(st.sampled_from(list(frames.NAMES)), word, freshness_value)
@example(ECU_DEMAND, -1, 2**63 - 1)
def test_frame_and_authentication_frame_are_the_secured_pdu_of_scapy_and_cantools(
    authenticator: Authenticator, ident: int, data: int, freshness: int
) -> None:
    from scapy.contrib.automotive.autosar.secoc import SecOCMixin

    head, auth = authenticator.frame(ident, data, freshness)
    assert head == frames.word0(ident + 8)
    payload, tail = (int(w).to_bytes(8, "little", signed=True) for w in (data, auth))
    signed = (0x5600 + ident).to_bytes(2, "big") + payload
    assert tail[4:] == SecOCMixin.calculate_cmac(KEY, signed, freshness.to_bytes(8, "big"))[:4]
    assert int.from_bytes(tail[:4], "little") == freshness % 2**32

    properties = SimpleNamespace(
        freshness_bit_length=64, freshness_tx_bit_length=32, auth_tx_bit_length=32, payload_length=8,
        data_id=0x5600 + ident,
    )  # fmt: skip
    message: Any = SimpleNamespace(name="", autosar=SimpleNamespace(secoc=properties))
    cmac = lambda _, data, __: SecOCMixin.calculate_cmac(KEY, data, b"")  # noqa: E731
    # cantools has the freshness value in the byte order of the PDU, the DBC in that of all its signals
    whole = payload + tail[3::-1] + tail[4:]
    assert theirs.apply_authenticator(payload + bytes(8), message, cmac, freshness) == whole
    assert theirs.verify_authenticator(whole, message, cmac, freshness)

    low, mac = frames.decode_auth(auth)
    assert authenticator.proves(ident, data, freshness, int(mac)) and low == freshness % 2**32
    for other in ((ident ^ 1, data, freshness), (ident, data ^ 1, freshness), (ident, data, freshness ^ 1)):
        assert not authenticator.proves(*other, int(mac))
    assert not authenticator.proves(ident, data, freshness, int(mac) ^ 1)
    assert not Authenticator(bytes(16)).proves(ident, data, freshness, int(mac))


@given(st.integers(0, 2**60), st.integers(-(2**31), 2**31 - 1))
def test_the_freshness_value_is_the_nearest_with_these_bits(near: int, off: int) -> None:
    assert completed((near + off) % 2**32, near) == near + off


# ---- the gate --------------------------------------------------------------------------------------------------------


def demand(n_dem: float = 70.0, counter: int = 0) -> int:
    return int(frames.encode_demand(n_dem, n_dem, 1, counter))


def pair(authenticator: Authenticator, data: int, freshness: int) -> list[list[int]]:
    """A frame and its authentication frame."""
    return [[int(frames.word0(ECU_DEMAND)), data], list(authenticator.frame(ECU_DEMAND, data, freshness))]


def gate(authenticator: Authenticator, at: int = START) -> Gate:
    made = Gate(authenticator, DEMANDED)
    made.correct(0, at)
    return made


@given(st.lists(st.integers(-2 * WINDOW, 2 * WINDOW), min_size=1, max_size=12), st.integers(0, 2**40))
def test_only_a_greater_freshness_value_within_the_window_is_taken(
    authenticator: Authenticator, offsets: list[int], start: int
) -> None:
    g, last, start = gate(authenticator, start + WINDOW), start + WINDOW - 1, start + WINDOW
    for i, off in enumerate(offsets):
        k = 20 * i
        value = max(start + k + off, 0)
        right = last < value and abs(value - start - k) <= WINDOW
        out = g.pass_on(k, pair(authenticator, demand(), value))
        good = [row for row in out if not row[0] & frames.UNAUTHENTIC]
        assert len(good) == right
        last = value if right else last
    assert g.verified + g.stale == len(offsets) and g.wrong_mac == g.unmatched == g.missing == 0


def test_what_is_older_than_the_receivers_start_is_refused(authenticator: Authenticator) -> None:
    recorded = [pair(authenticator, demand(), START + k) for k in range(0, 1000, 10)]
    g = gate(authenticator, START + 1000)  # a controller that starts anew a moment later
    for k, rows in enumerate(recorded):
        assert not [row for row in g.pass_on(k, rows) if not row[0] & frames.UNAUTHENTIC]
    assert g.stale == len(recorded)
    assert len(g.pass_on(200, pair(authenticator, demand(), START + 1200))) >= 1 and g.verified == 1


def test_a_frame_without_its_mac_is_refused_after_the_time_of_a_silence(authenticator: Authenticator) -> None:
    g, (frame, mac) = gate(authenticator), pair(authenticator, demand(), START)
    assert g.pass_on(0, [frame]) == []
    assert g.pass_on(HOLD - 1, []) == [] and g.pass_on(HOLD, []) == [(frame[0] | frames.UNAUTHENTIC, frame[1])]
    assert (g.missing, g.unmatched) == (1, 0)
    assert g.pass_on(HOLD + 1, [mac]) == [] and g.unmatched == 1
    k = 3 * HOLD
    assert g.pass_on(k, [frame]) == [] and g.pass_on(k + HOLD - 1, [mac]) == [tuple(frame)] and g.verified == 1
    r = frames.new_receiver(ECU_DEMAND)
    assert frames.VERDICTS[frames.receive(r, frame[0] | frames.UNAUTHENTIC, frame[1], 0)] == "unauthentic"
    assert frames.refused(r) == r[frames.R_UNAUTHENTIC] == 1 and r[frames.R_CANDIDATE] == r[frames.R_LAST] == -1


def test_what_others_send_between_a_frame_and_its_mac_does_not_part_them(authenticator: Authenticator) -> None:
    g, rng = gate(authenticator), np.random.default_rng(1)
    for k in range(0, 2000, 10):
        frame, mac = pair(authenticator, demand(counter=k // 10 % 15), START + k)
        between = []
        for _ in range(MOST_WAITING - 1):
            strange = [int(frames.word0(ECU_DEMAND)), int(rng.integers(2**63))]
            forged = [mac[0], int(frames.encode_auth(START + k, int(rng.integers(2**32))))]
            between += [strange, forged][: int(rng.integers(3))]
        out = g.pass_on(k, [frame, *between, mac])
        assert tuple(frame) in out
    assert g.verified == 200 and g.wrong_mac > 200 and g.stale == 0
    flood = [[int(frames.word0(ECU_DEMAND)), i] for i in range(10_000)]
    g.pass_on(3000, flood)
    assert sum(len(w) for w in g._waiting.values()) == MOST_WAITING


def test_notes_correct_the_freshness_value_and_never_turn_it_back(authenticator: Authenticator) -> None:
    now = [START]
    s = Secured(Node(), authenticator, DEMANDED, lambda: now[0])
    rows = np.zeros((4, 2), np.int64)
    assert s.heed(rows, 0) == 1 and rows[0].tolist() == [frames.FRESHNESS, START]
    s.tick(rows, 1)
    for ahead, said in ((BEHIND, 0), (BEHIND + 1, 1), (0, 0)):
        now[0] = START + s.node.k + ahead
        assert s.heed(rows, 1) == 1 + said
        s.tick(rows[1:], said)
    assert s.gate.now(s.node.k) == START + s.node.k + BEHIND + 1
    assert s.heed(rows, 4) == 4  # no room


# ---- an attacker without the key -------------------------------------------------------------------------------------


class Bench:
    """Controller and ECU, each frame taken in the next tick; ``attack`` says what comes to the controller besides."""

    def __init__(self, authenticator: Authenticator | None, n_dem: float = 60.0, start: int = START):
        self.node, self.ecu = Node(n_r=n_dem), Ecu(n_dem=n_dem)
        self.vgv: Any = self.node
        self.other: Any = self.ecu
        self.to_vgv = self.to_ecu = NONE
        if authenticator is not None:
            self.vgv = Secured(self.node, authenticator, DEMANDED)
            self.other = Secured(self.ecu, authenticator, FROM_CONTROLLER)
            self.to_vgv = self.to_ecu = started(start)
        self.heard: list[list[int]] = []

    def run(self, ticks: int, attack: Callable[[int], list[list[int]]] = lambda k: []) -> Bench:
        for _ in range(ticks):
            more = np.array(attack(self.node.k), np.int64).reshape(-1, 2)
            from_ecu = self.other.tick(self.to_ecu).copy()
            self.to_ecu = self.vgv.tick(np.concatenate([self.to_vgv, more])).copy()
            self.to_vgv = from_ecu
            self.heard += from_ecu.tolist()
        return self


def replays(recorded: list[list[int]], seed: int) -> Callable[[int], list[list[int]]]:
    """Recorded frames at random moments, one each 50 to 100 ms: with what followed it (its MAC, where it had one) or
    alone.
    """
    rng, due = np.random.default_rng(seed), [1500]

    def attack(k: int) -> list[list[int]]:
        if k < due[0]:
            return []
        due[0] = k + int(rng.integers(50, 100))
        i = int(rng.integers(len(recorded) - 2))
        return recorded[i : i + int(rng.integers(1, 3))]

    return attack


def test_without_authentication_recorded_frames_move_the_vanes(authenticator: Authenticator) -> None:
    recorded = Bench(None, 100.0).run(1500).heard
    b = Bench(None).run(6000, replays(recorded, 1))
    assert b.node.counts["repeated"] > 10 and b.node.counts["lost"] > 10  # many were taken
    assert b.node.counts["good"] < 599


def test_with_authentication_none_of_the_recorded_frames_is_taken_and_every_true_one_is(
    authenticator: Authenticator,
) -> None:
    undisturbed = Bench(authenticator).run(6000).node
    earlier = Bench(authenticator, 100.0, START - 60_000).run(1500).heard
    of_this_run = Bench(authenticator).run(1400).heard
    for old in (earlier, of_this_run):
        b = Bench(authenticator).run(6000, replays(old, 2))
        c = b.node.counts
        assert c["good"] == undisturbed.counts["good"] == 599 and c["lost"] == c["repeated"] == 0
        assert b.vgv.authentication["verified"] == 600 and c["unauthentic"] > 20
        assert np.array_equal(b.node.loop.s, undisturbed.loop.s)  # the machine did not notice


@pytest.mark.parametrize("flavour", ["right key", "wrong key", "random MAC", "stale", "no MAC"])
def test_a_made_frame_moves_the_stroke_only_under_the_key(authenticator: Authenticator, flavour: str) -> None:
    b, rng = Bench(authenticator), np.random.default_rng(5)
    key = Authenticator(bytes(16)) if flavour == "wrong key" else authenticator

    def attack(k: int) -> list[list[int]]:
        if k < 1000 or k % 400 != 5:
            return []
        data = demand(100.0, (int(b.node.arrays.receiver[frames.R_LAST]) + 4) % 15)
        frame, mac = pair(key, data, START + k - (1000 if flavour == "stale" else 0))
        if flavour == "random MAC":
            mac[1] = int(frames.encode_auth(START + k, int(rng.integers(2**32))))
        return [frame] if flavour == "no MAC" else [frame, mac]

    b.run(4000, attack)
    still = Bench(authenticator).run(4000)
    moved = not np.array_equal(b.node.loop.s, still.node.loop.s)
    assert moved == (flavour == "right key")
    if not moved:
        assert b.node.counts["good"] == still.node.counts["good"] and b.node.counts["unauthentic"] == 7
        assert b.node.faults == 0


def test_the_ecu_proves_the_controllers_frames_too(authenticator: Authenticator) -> None:
    b = Bench(authenticator).run(500)
    assert b.ecu.stale() == [] and b.other.authentication["verified"] == 3 * 50 + 5
    forged = [int(frames.word0(VGV_STATUS)), int(frames.encode_status(1.0, 1.0, 4, 3))]
    b.to_ecu = np.array([forged], np.int64)
    before = b.ecu.values
    b.run(HOLD + 10)
    assert b.ecu.arrays.receiver[0, frames.R_UNAUTHENTIC] == 1 and b.ecu.values["state"] == before["state"]


def test_the_node_inside_runs_as_it_does_without(authenticator: Authenticator) -> None:
    on, off = Bench(authenticator).run(2000), Bench(None).run(2000)
    assert on.node.fingerprint() == off.node.fingerprint()
    assert [row for row in on.heard if row[0] & 0x7FF == ECU_DEMAND] == off.heard


# ---- records ---------------------------------------------------------------------------------------------------------


class Wire:
    """A bus with a secured ECU on it, an attacker who repeats what was sent, and a reader that is held up once."""

    def __init__(self, authenticator: Authenticator, clock: Callable[[], int]):
        self.ecu = Secured(Ecu(n_dem=70.0), authenticator, FROM_CONTROLLER, clock)
        self.rng, self.old, self.said = np.random.default_rng(2), [], []  # type: ignore[var-annotated]
        self.back, self.reads = NONE, 0

    def read(self, rows: np.ndarray) -> int:
        import time

        self.reads += 1
        room = np.zeros((64, 2), np.int64)
        room[: len(self.back)] = self.back
        out = self.ecu.tick(room, self.ecu.heed(room, len(self.back))).tolist()
        self.old += out
        if self.reads == 400:
            time.sleep(0.15)
        if self.rng.random() < 0.05:
            out += [self.old[int(i)] for i in self.rng.integers(len(self.old), size=2)]
        rows[: len(out)] = np.array(out, np.int64).reshape(-1, 2)
        return len(out)

    def write(self, rows: np.ndarray) -> int:
        self.back = rows.copy()
        self.said += rows.tolist()
        return len(rows)


def test_a_secured_run_in_real_time_repeats_bit_for_bit_and_its_record_holds_no_key(
    authenticator: Authenticator, tmp_path: Path
) -> None:
    import time

    clock = lambda: time.monotonic_ns() // TICK_NS + START  # noqa: E731
    node, kept = Secured(Node(seed=4), authenticator, DEMANDED, clock), []  # type: ignore[var-annotated]
    wire = Wire(authenticator, clock)
    report = run_realtime(node, wire, ticks=900, put=kept.append)
    assert report.pauses >= 1 and node.authentication["stale"] > 5 and node.authentication["verified"] > 30
    for suffix in (".log", ".blf", ".mf4", ".parquet"):
        recorder = Recorder(tmp_path / f"run{suffix}")
        recorder.put(b"".join(kept))
        recorder.close()
        raw = recorder.path.read_bytes()
        assert KEY not in raw and KEY.hex().encode() not in raw.lower()
        record = read_record(recorder.path)
        taken = ~record.sent
        again = Secured(Node(seed=4), authenticator, DEMANDED)
        at = record.ms[taken] - report.started_ns // TICK_NS
        _, sent = replay_attended(again, at, record.rows[taken], node.node.k)  # type: ignore[arg-type]
        assert sent.tolist() == wire.said and again.fingerprint() == node.fingerprint(), suffix
        assert again.authentication == node.authentication


@pytest.fixture
def key_file(tmp_path: Path) -> str:
    file = tmp_path / "bus.key"
    file.write_text(KEY.hex() + "\n")
    file.chmod(0o600)
    return str(file)


def test_run_with_authentication_repeats_with_the_key_and_says_so_without(
    key_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record, plain = str(tmp_path / "run.log"), str(tmp_path / "plain.log")
    run = ["run", "--bus", "lockstep", "--json", "-", "--quiet", "--seed", "3", "--duration", "1.2"]
    assert main([*run, "--record", plain]) == 0
    off = json.loads(capsys.readouterr().out)
    assert main([*run, "--record", record, "--secoc", key_file]) == 0
    on = json.loads(capsys.readouterr().out)
    assert off["secoc"] is None and on["secoc"] == {
        "verified": 120, "wrong_mac": 0, "stale": 0, "unmatched": 0, "missing": 0,
    }  # fmt: skip
    assert on["state_hash"] == off["state_hash"]  # authentication changes nothing else
    monkeypatch.setenv(secoc.KEY_VARIABLE, KEY.hex())
    assert main([*run, "--inputs", record, "--secoc", "env"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["same"] and again["compared"] == 2 * off["record"]["sent"] and again["secoc"] == on["secoc"]
    monkeypatch.setenv(secoc.KEY_VARIABLE, bytes(16).hex())
    assert main([*run, "--inputs", record, "--secoc", "env"]) == 1
    assert main([*run, "--inputs", record]) == 2
    assert "was recorded with authentication: --secoc KEY" in capsys.readouterr().err
    assert main([*run, "--inputs", plain, "--secoc", key_file]) == 2
    assert "was recorded without authentication" in capsys.readouterr().err
    assert KEY.hex() not in Path(record).read_text().lower()
    assert "authentication" not in " ".join(read_log(plain).notes)
    (said,) = (note for note in read_log(record).notes if "authentication" in note)
    assert said.startswith("492 authentication frames (SecOC) in the log: no MAC is checked;")


def test_a_key_is_private_and_is_never_shown(key_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert read_key(key_file) == KEY
    monkeypatch.delenv(secoc.KEY_VARIABLE, raising=False)

    def refused(source: str) -> str:
        with pytest.raises(InputError) as e:
            read_key(source)
        assert KEY.hex()[:20] not in str(e.value)
        return str(e.value)

    assert refused("env") == "--secoc env: VANELOOP_SECOC_KEY is not set; it must hold 32 hexadecimal digits"
    assert "takes the file that holds the key" in refused(KEY.hex())
    assert "cannot be read (No such file" in refused(str(tmp_path / "none"))
    assert "cannot be read (Is a directory" in refused(str(tmp_path))
    for mode in (0o640, 0o604, 0o620, 0o644):
        Path(key_file).chmod(mode)
        assert f"others may use it (mode {mode:o}); allowed: 600" in refused(key_file)
    Path(key_file).chmod(0o600)
    for text in (KEY.hex()[:31], KEY.hex() + "0", KEY.hex() + "\n" + KEY.hex(), "", "g" * 32):
        Path(key_file).write_text(text)
        assert "must hold a key of 32 hexadecimal digits, and nothing else" in refused(key_file)
    monkeypatch.setattr("vaneloop.base.extras.is_there", lambda module: False)
    assert refused(key_file) == "--secoc needs cryptography, which is not installed: pip install 'vaneloop[secoc]'"
