"""A plant of the user's own, as an FMU, under the controller here: in lockstep and in real time.

The node runs as it always does, but the machine's state that the sensors are read from is what the FMU gives after each
tick of 1 ms. FMPy loads the FMU.
"""

from __future__ import annotations

import importlib
import math
import platform
import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

from controller import Calibration
from hil.fmu.description import base_unit
from hil.loop.node import Node
from plant import Plant, chain, places
from plant.parameters import LVDT_STEP
from vaneloop.base.errors import InputError, meant
from vaneloop.base.extras import needed

__all__ = ["INPUTS", "OUTPUTS", "PlantFmu", "PlantNode"]

_SI = {"i_cmd": "A", "n_dem": "%", "n_r": "%", "p_s": "Pa", "t_oil": "degC", "x_lvdt": "m", "n_engine": "%"}
INPUTS = ("i_cmd", "n_dem", "n_r", "p_s", "t_oil")  # all but the first may be absent
OUTPUTS = ("x_lvdt", "n_engine")  # and the stages; n_engine may be absent

_DESCRIPTION = "modelDescription.xml"
MOST_DESCRIPTION = 32 << 20  # bytes, unpacked; those of whole vehicles have some ten MB
MOST_UNPACKED = 64 << 20, 50  # bytes that an FMU may unpack to, and more for each of its own


class _Joined(NamedTuple):
    """A variable of the FMU and our signal: ours = theirs * factor + offset."""

    signal: str
    reference: int
    factor: float
    offset: float


class PlantFmu:
    """A running FMU that is the plant.

    path     of the FMU, 2.0 or 3.0, for co-simulation
    vanes    stages whose angles it must give
    mapping  name in the FMU -> our signal, where they differ
    n_r      %, speed at the start
    notes    what was assumed

    Raises InputError for an FMU that cannot be this plant, in one line.
    """

    def __init__(
        self,
        path: str,
        vanes: tuple[str, ...],
        mapping: Mapping[str, str] | None = None,
        *,
        n_r: float = 60.0,
        p_s: float = 21e6,
        t_oil: float = 40.0,
    ):
        self.path, self.notes = path, list[str]()
        fmpy = _fmpy(path)
        self._failure = fmpy.fmi1.FMICallException
        described = _described(fmpy, path)
        inputs = _join(path, described, "input", INPUTS, ("i_cmd",), mapping or {}, self.notes)
        outputs = _join(path, described, "output", (*OUTPUTS, *vanes), ("x_lvdt", *vanes), mapping or {}, self.notes)
        known = (*INPUTS, *OUTPUTS, *vanes)
        if unknown := [s for s in (mapping or {}).values() if s not in known]:
            raise InputError(f"--plant-map: {unknown[0]!r} is no signal of a plant; allowed: {', '.join(known)}")
        self._inputs, self._outputs = inputs, outputs
        self._out_refs = [v.reference for v in outputs]
        self._in_refs = [v.reference for v in inputs]
        folder = tempfile.mkdtemp(prefix="vaneloop-fmu-")
        self._end = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        three = described.fmiVersion.startswith("3")
        new = fmpy.fmi3.FMU3Slave if three else fmpy.fmi2.FMU2Slave
        try:
            fmpy.extract(path, folder)
            self._fmu = new(
                guid=described.guid,
                unzipDirectory=folder,
                modelIdentifier=described.coSimulation.modelIdentifier,
                instanceName="plant",
            )
            self._write = self._fmu.setFloat64 if three else self._fmu.setReal
            self._read = self._fmu.getFloat64 if three else self._fmu.getReal
            self._fmu.instantiate()
            if three:
                self._fmu.enterInitializationMode(startTime=0.0)
            else:
                self._fmu.setupExperiment(startTime=0.0)
                self._fmu.enterInitializationMode()
            self._feed({"i_cmd": 0.0, "n_dem": n_r, "n_r": n_r, "p_s": p_s, "t_oil": t_oil})
            self._fmu.exitInitializationMode()
        except InputError:
            raise
        except Exception as e:  # the FMU's own refusal, or a library that does not load
            raise InputError(f"--plant {path}: cannot be started ({_line(e)})") from None
        self._k = 0

    def _feed(self, signals: Mapping[str, float]) -> None:
        values = [(signals[v.signal] - v.offset) / v.factor for v in self._inputs]
        self._write(self._in_refs, values)

    def outputs(self) -> dict[str, float]:
        """What it gives now, SI. InputError where that is no number."""
        values = self._read(self._out_refs)
        out = {v.signal: x * v.factor + v.offset for v, x in zip(self._outputs, values, strict=True)}
        for signal, value in out.items():
            if not math.isfinite(value):
                raise InputError(
                    f"--plant {self.path}: {signal} (={value}) at t = {self._k * chain.TICK:.3f} s must be finite"
                )
        return out

    def step(self, signals: Mapping[str, float]) -> dict[str, float]:
        """Move on by 1 ms under these inputs (SI); return the outputs. InputError where it fails."""
        try:
            self._feed(signals)
            self._fmu.doStep(currentCommunicationPoint=self._k * chain.TICK, communicationStepSize=chain.TICK)
            self._k += 1
            return self.outputs()
        except self._failure as e:
            raise InputError(f"--plant {self.path}: failed at t = {self._k * chain.TICK:.3f} s ({_line(e)})") from None


class PlantNode(Node):
    """Controller of ours, or of the user's, with a plant that is an FMU, as one node on the bus."""

    stride = 1

    def __init__(
        self, fmu: PlantFmu, plant: Plant, calibration: Calibration, *, n_r: float = 60.0, seed: int | None = None
    ):
        plant.of_one_actuator("a plant that is an FMU")
        calibration.of_one_channel("a plant that is an FMU")
        super().__init__(plant, calibration, n_r=n_r, seed=seed)
        self.fmu = fmu
        self.loop.p[LVDT_STEP, 0] = 0.0  # the FMU's converter has its own
        self._set(fmu.outputs())

    def moved(self) -> None:
        """Let the FMU move on by a tick under the current of the last one."""
        p_s, t_oil, n_dem, n_r = (float(v) for v in self.arrays.supply)
        i_cmd = float(self.loop.given.i_cmd)
        self._set(self.fmu.step({"i_cmd": i_cmd, "n_dem": n_dem, "n_r": n_r, "p_s": p_s, "t_oil": t_oil}))

    def _set(self, shown: Mapping[str, float]) -> None:
        s = self.loop.s
        for row in (places.X, places.X_LVDT, places.READING):
            s[row, 0] = shown["x_lvdt"]
        for k, vane in enumerate(self.plant.vanes):
            s[places.POT + k, 0] = shown[vane]
        if "n_engine" in shown:
            s[places.N_R, 0] = shown["n_engine"]


def _fmpy(path: str) -> Any:
    fmpy = needed(f"--plant {path}: an FMU", "fmpy")
    for version in ("fmi1", "fmi2", "fmi3"):
        importlib.import_module(f"fmpy.{version}")
    return fmpy


def _check_size(path: str, archive: zipfile.ZipFile) -> None:
    """Refuse an archive that unpacks to more than its size is worth; no member gives more bytes than are said here."""
    size, most = Path(path).stat().st_size, archive.getinfo(_DESCRIPTION).file_size
    if most > MOST_DESCRIPTION:
        raise InputError(f"--plant {path}: {_DESCRIPTION} has {most:,} bytes; allowed: {MOST_DESCRIPTION:,}")
    unpacked, allowed = sum(m.file_size for m in archive.infolist()), MOST_UNPACKED[0] + MOST_UNPACKED[1] * size
    if unpacked > allowed:
        raise InputError(f"--plant {path}: {size:,} bytes unpack to {unpacked:,}; allowed: {allowed:,}")


def _described(fmpy: Any, path: str) -> Any:
    """Its model description; what cannot be run here is refused."""
    try:
        with zipfile.ZipFile(path) as archive:
            _check_size(path, archive)
            root = ET.fromstring(archive.read(_DESCRIPTION))
        version = root.get("fmiVersion", "")
        if not version.startswith(("2.", "3.")):
            raise InputError(f"--plant {path}: FMI version (={version}) must be 2.0 or 3.0")
        if root.find("CoSimulation") is None:
            raise InputError(f"--plant {path}: is for model exchange only; co-simulation is needed")
        described = fmpy.read_model_description(path, validate=False)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"--plant {path}: is not there") from None
    except Exception as e:
        raise InputError(f"--plant {path}: is no FMU that can be read ({_line(e)})") from None
    here = {fmpy.platform, fmpy.platform_tuple}
    offered = fmpy.supported_platforms(path)
    if not here & set(offered):
        wanted = fmpy.platform_tuple if version.startswith("3") else fmpy.platform
        has = ", ".join(p for p in offered if p != "c-code") or "none"
        raise InputError(f"--plant {path}: has binaries for {has}; this machine ({platform.machine()}) needs {wanted}")
    return described


def _join(
    path: str,
    described: Any,
    causality: str,
    signals: tuple[str, ...],
    needed: tuple[str, ...],
    mapping: Mapping[str, str],
    notes: list[str],
) -> list[_Joined]:
    """Find the FMU's variables for our signals, and how their units turn into ours."""
    variables = {v.name: v for v in described.modelVariables if v.causality == causality}
    named = {signal: name for name, signal in mapping.items() if signal in signals}
    out = []
    for signal in signals:
        name = named.get(signal, signal)
        v = variables.get(name)
        if v is None:
            if signal not in needed and signal not in named:
                continue
            raise InputError(
                f"--plant {path}: has no {causality} {name!r}{meant(name, variables)}; it has: "
                f"{', '.join(variables) or 'none'}; --plant-map NAME={signal} names it"
            )
        if v.type not in ("Real", "Float64") or v.dimensions:
            raise InputError(f"--plant {path}: {name} (type {v.type}) must be a scalar Real or Float64")
        unit = v.unit or (v.declaredType.unit if v.declaredType is not None else None)
        ours = _SI.get(signal, "rad")
        if unit is None:
            notes.append(f"{path}: {name} has no unit; taken as {ours}")
        factor, offset = _conversion(path, name, described, unit or ours, ours)
        out.append(_Joined(signal, v.valueReference, factor, offset))
    return out


def _conversion(path: str, name: str, described: Any, unit: str, ours: str) -> tuple[float, float]:
    """Factor and offset from ``unit``, as the FMU defines it, into ours; InputError for another quantity."""
    target = _base(base_unit(ours))
    defined = next((u.baseUnit for u in described.unitDefinitions if u.name == unit), None)
    if defined is not None:
        of = {key: getattr(defined, key, 0) or 0 for key in _DIMENSIONS}
        source = (of, float(defined.factor or 1.0), float(defined.offset or 0.0))
    else:
        try:
            source = _base(base_unit(unit))
        except Exception:
            raise InputError(f"--plant {path}: {name}: unit {unit!r} is not known") from None
    if any(float(source[0][d]) != float(target[0][d]) for d in _DIMENSIONS if d != "rad"):
        raise InputError(f"--plant {path}: {name}: unit (={unit!r}) must be one that turns into {ours}")
    if source[1:] == target[1:]:
        return 1.0, 0.0
    return source[1] / target[1], (source[2] - target[2]) / target[1]


_DIMENSIONS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


def _base(attributes: Mapping[str, str]) -> tuple[dict[str, float], float, float]:
    dimensions = {d: float(attributes.get(d, 0)) for d in _DIMENSIONS}
    return dimensions, float(attributes.get("factor", 1.0)), float(attributes.get("offset", 0.0))


def _line(e: Exception) -> str:
    return " ".join(str(e).split())[:200] or type(e).__name__
