"""Make the corpus: small logs, written by other libraries alone. `python -m tests.corpus.make` writes it anew.

Every file holds the same run, as far as its format can: a demand and a speed in %, a stroke in mm.
"""

from __future__ import annotations

import sys
from pathlib import Path

import asammdf
import can
import cantools
import numpy as np
from asammdf.blocks.conversion_utils import from_dict

__all__ = ["FOLDER", "make"]

FOLDER = Path(__file__).parent
START = 1_600_000_000.25  # s since 1970
N = 40
T = np.arange(N) * 0.01
SPEED, STROKE = 60.0 + 10.0 * np.sin(5.0 * T), 20.0 + 5.0 * np.cos(5.0 * T)

_DBC = """VERSION ""
BU_: ECU
BO_ 291 SPEEDS: 8 ECU
 SG_ n_dem : 0|16@1+ (0.01,0) [0|150] "%" ECU
 SG_ n_r : 23|16@0+ (0.01,0) [0|150] "%" ECU
BO_ 2566844714 STROKE: 8 ECU
 SG_ x_lvdt : 8|16@1- (0.001,0) [-25|75] "mm" ECU
BO_ 1365 WIDE: 16 ECU
 SG_ x_dem : 96|16@1+ (0.001,0) [-25|75] "mm" ECU
"""


def messages(fd: bool) -> list[can.Message]:
    """The frames of the run, in order of time: two identifiers on two buses, with CAN FD a third; one remote frame."""
    db = cantools.database.load_string(_DBC, "dbc")
    out = []
    for t, speed, stroke in zip(T.tolist(), SPEED.tolist(), STROKE.tolist(), strict=True):
        parts = [("SPEEDS", {"n_dem": speed, "n_r": speed - 0.5}), ("STROKE", {"x_lvdt": stroke})]
        parts += [("WIDE", {"x_dem": stroke})] * fd
        for k, (name, values) in enumerate(parts):
            m = db.get_message_by_name(name)
            data = m.encode(values, strict=False)
            out.append(
                can.Message(round(START + t + 0.0002 * k, 6), m.frame_id, m.is_extended_frame, data=data, channel=k % 2,
                            is_fd=len(data) > 8)
            )  # fmt: skip
    remote = can.Message(round(START + 0.005, 6), 0x7FF, is_extended_id=False, is_remote_frame=True, channel=0)
    return sorted([*out, remote], key=lambda m: m.timestamp)


def _by_python_can(folder: Path) -> None:
    for kind, fd in (("classic", False), ("fd", True)):
        for suffix in (".asc", ".blf", ".log", ".csv", ".trc"):
            if fd and suffix == ".trc":
                continue
            with can.Logger(str(folder / f"python_can_{kind}{suffix}")) as out:
                for m in messages(fd):
                    if suffix != ".trc" or not m.is_remote_frame:
                        out.on_message_received(m)
    trace = folder / "python_can_classic.trc"  # whose head says where it was written
    trace.write_bytes(trace.read_bytes().replace(str(trace.resolve()).encode(), trace.name.encode()))
    with can.MF4Writer(str(folder / "python_can.mf4")) as mf4:
        for m in messages(False):
            mf4.on_message_received(m)


def _by_asammdf(folder: Path) -> None:
    signals = [
        asammdf.Signal(SPEED, T, "%", "n_dem"), asammdf.Signal(SPEED - 0.5, T, "%", "n_r"),
        asammdf.Signal(np.rint(1000.0 * STROKE).astype(np.int16), T, "mm", "x_lvdt",
                       conversion=from_dict({"a": 0.001, "b": 0.0})),
    ]  # fmt: skip
    for version, name in (("4.10", "asammdf.mf4"), ("3.30", "asammdf.dat")):  # it calls the latter .mdf
        with asammdf.MDF(version=version) as mdf:
            for s in signals:
                mdf.append([s], common_timebase=True)
            Path(mdf.save(folder / name, overwrite=True)).rename(folder / name)
    frames = [m for m in messages(False) if not m.is_remote_frame and not m.is_extended_id]
    with asammdf.MDF(version="4.11") as mdf:  # as newer loggers state what is the same in all frames
        t = np.array([m.timestamp - START for m in frames])

        def signal(name: str, values: np.ndarray, constant: int | None = None) -> asammdf.Signal:
            s = asammdf.Signal(values, t, name=f"CAN_DataFrame.{name}")
            if constant is not None:
                s.flags |= asammdf.Signal.Flags.virtual
                s.virtual_conversion = from_dict({"a": 0.0, "b": float(constant)})
            return s

        zeros, eight = np.zeros(len(frames), np.uint8), np.full(len(frames), 8, np.uint8)
        data = np.frombuffer(b"".join(bytes(m.data) for m in frames), np.uint8).reshape(-1, 8)
        mdf.append(
            [signal("BusChannel", zeros, 1), signal("ID", np.array([m.arbitration_id for m in frames], np.uint32)),
             signal("IDE", zeros, 0), signal("DLC", eight), signal("DataLength", eight), signal("DataBytes", data)],
            common_timebase=True,
        )  # fmt: skip
        mdf.save(folder / "asammdf_virtual.mf4", overwrite=True)


def make(folder: Path) -> None:
    """Write every file of the corpus into a folder."""
    (folder / "corpus.dbc").write_text(cantools.database.load_string(_DBC, "dbc").as_dbc_string(), newline="")
    _by_python_can(folder)
    _by_asammdf(folder)


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
