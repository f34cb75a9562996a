"""Inputs of a controller that failed, tick by tick from power-on, in a Parquet file that runs to the same failure.

Each row is a tick, each column an input of `controller.INPUTS` (SI, float64); the file also keeps the calibration.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from controller import INPUTS, Calibration, new_outputs, new_state
from hil.logs.parquet_format import whole_parquet
from hil.native.call import firmware
from hil.native.program import Program
from vaneloop.base.compiled import compiled_free
from vaneloop.base.errors import InputError
from vaneloop.base.files import whole

if TYPE_CHECKING:
    from hil.native.black_box import Box

__all__ = ["feed", "is_crash_log", "read", "write"]

_KEY = b"vaneloop.controller_crash"


def write(path: str, box: Box, line: str) -> str:
    """Write the inputs of ``box``; return what came of it, in words."""
    if len(box.inputs) <= box.tick:
        return f"no crash log: it ran for more ticks ({box.tick + 1:,}) than are kept"
    about = {"tick": box.tick, "controller": box.controller, "failure": line, "calibration": box.calibration}
    columns = [pa.array(box.inputs[:, i]) for i in range(len(INPUTS))]
    table = pa.table(columns, names=list(INPUTS)).replace_schema_metadata({_KEY: json.dumps(about)})
    try:
        with whole(path) as part:
            parquet.write_table(table, part, compression="zstd")
    except InputError as e:
        return f"no crash log: {e}"
    return f"crash log: {path}"


def is_crash_log(path: str | Path) -> bool:
    """Whether the file is one that `write` wrote."""
    try:
        return Path(path).suffix == ".parquet" and _KEY in (parquet.read_schema(path).metadata or {})
    except (OSError, ValueError):
        return False


def read(path: str | Path) -> tuple[np.ndarray, dict[str, Any], Calibration]:
    """Return the inputs (float64[ticks, inputs]), what is known of the failure, and the calibration."""
    try:
        table = whole_parquet(Path(path)).read()
        about = json.loads(table.schema.metadata[_KEY])
        rows = np.column_stack([table[name].to_numpy() for name in INPUTS])
        k, tables, angles = (np.array(about["calibration"][name], np.float64) for name in ("k", "table", "angles"))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as e:
        raise InputError(f"{path}: is no crash log of this version ({' '.join(str(e).split())[:200]})") from None
    return np.ascontiguousarray(rows), about, Calibration(k, tables, angles)


@compiled_free
def _feed(rows: np.ndarray, z: np.ndarray, outputs: np.ndarray, calibration: Calibration, foreign: Any) -> None:
    for i in range(rows.shape[0]):
        firmware(rows[i], outputs, z, calibration, foreign)


def feed(rows: np.ndarray, calibration: Calibration, program: Program) -> np.ndarray:
    """Give a controller the inputs of a crash log, tick by tick from power-on; return its last outputs."""
    outputs = new_outputs()
    _feed(rows, new_state(), outputs, calibration, program.start(calibration))
    return outputs
