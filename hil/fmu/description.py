"""The XML of an FMU: modelDescription of FMI 3.0 and 2.0, and what its sources are built with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree import ElementTree as ET

from hil.fmu.variables import FIXED, INPUT, OUTPUT, REAL, TRUTH, WHOLE, Variable
from hil.logs.units import registry

__all__ = ["OPTIONS", "SOURCES", "base_unit", "build_description", "model_description"]

OPTIONS = "-std=c99 -O2 -ffp-contract=off"
SOURCES = {
    "3.0": ("part.c", "model.c", "fmu.c", "fmi3.c", "fmi3_absent.c"),
    "2.0": ("part.c", "model.c", "fmu.c", "fmi2.c"),
}
_TYPES = {"3.0": ("Float64", "Int32", "Boolean"), "2.0": ("Real", "Integer", "Boolean")}
_BASE = {"kilogram": "kg", "meter": "m", "second": "s", "ampere": "A", "kelvin": "K", "radian": "rad"}
_SHOWN = {"mm": 1e3, "mA": 1e3, "MPa": 1e-6, "deg": 180.0 / math.pi}  # border's unit -> factor from SI
_ABILITIES = {
    "3.0": {"canGetAndSetFMUState": "true", "canSerializeFMUState": "true", "fixedInternalStepSize": "0.001"},
    "2.0": {
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
        "canNotUseMemoryManagementFunctions": "true",
    },
}


def base_unit(unit: str) -> dict[str, str]:
    """Attributes of FMI's BaseUnit: exponents of the SI's base units, factor and offset."""
    if unit == "%":
        return {"factor": "0.01"}
    if unit in ("-", ""):
        return {}
    if unit == "degC":
        return {"K": "1", "offset": "273.15"}
    words = unit.replace("m2", "m**2").replace("%", "0.01").replace(" ", "*").replace("Ohm", "ohm")
    units = registry()
    q = (units.Quantity(1.0, "dimensionless") * units.parse_expression(words)).to_base_units()
    out = {_BASE[name]: f"{power:g}" for name, power in q.unit_items()}
    if abs(q.magnitude - 1.0) > 1e-15:
        out["factor"] = repr(float(q.magnitude))
    return out


def _number(v: float) -> str:
    return f"{int(v)}" if v == int(v) and abs(v) < 1e15 else repr(float(v))


def _unit_definitions(variables: Sequence[Variable]) -> ET.Element:
    out = ET.Element("UnitDefinitions")
    shown = {v.unit: v.shown for v in variables if v.shown}
    for unit in dict.fromkeys(["s", *(v.unit for v in variables if v.unit)]):
        element = ET.SubElement(out, "Unit", name=unit)
        ET.SubElement(element, "BaseUnit", base_unit(unit))
        if border := shown.get(unit):
            ET.SubElement(element, "DisplayUnit", name=border, factor=repr(_SHOWN[border]))
    return out


def _attributes(v: Variable, reference: int) -> dict[str, str]:
    out = {"name": v.name, "valueReference": str(reference), "description": v.description}
    if v.role == INPUT:
        out |= {"causality": "input", "variability": "continuous" if v.kind == REAL else "discrete"}
    elif v.role == OUTPUT:
        out |= {"causality": "output", "variability": "continuous" if v.kind == REAL else "discrete"}
        out["initial"] = "calculated"
    else:
        out |= {"causality": "parameter", "variability": "fixed" if v.role == FIXED else "tunable"}
    return out


def _of_type(v: Variable) -> dict[str, str]:
    out: dict[str, str] = {}
    if v.kind == REAL:
        out |= {"unit": v.unit} if v.unit else {}
        out |= {"displayUnit": v.shown} if v.shown else {}
    if v.kind in (REAL, WHOLE):
        out |= {key: _number(x) for key, x in (("min", v.low), ("max", v.high)) if math.isfinite(x)}
    if v.role != OUTPUT:
        out["start"] = ("true" if v.start else "false") if v.kind == TRUTH else _number(v.start)
    return out


def _head(version: str, name: str, token: str, identifier: str, release: str) -> ET.Element:
    out = ET.Element("fmiModelDescription", fmiVersion=version, modelName=name)
    out.set("instantiationToken" if version == "3.0" else "guid", token)
    out.set("description", "Variable guide vanes of a gas turbine, in ticks of 1 ms")
    out.set("license", "Apache-2.0")
    out.set("generationTool", f"VaneLoop {release}")
    out.set("variableNamingConvention", "structured")
    if version == "2.0":
        out.set("numberOfEventIndicators", "0")
    abilities = {"modelIdentifier": identifier, "canHandleVariableCommunicationStepSize": "true", **_ABILITIES[version]}
    part = ET.SubElement(out, "CoSimulation", abilities)
    if version == "2.0":
        files = ET.SubElement(part, "SourceFiles")
        for file in SOURCES[version]:
            ET.SubElement(files, "File", name=file)
    return out


def model_description(
    version: str, name: str, identifier: str, token: str, variables: Sequence[Variable], release: str
) -> bytes:
    """Return modelDescription.xml of FMI ``version``; value references as `hil.fmu.source.model_source` has them."""
    out = _head(version, name, token, identifier, release)
    out.append(_unit_definitions(variables))
    logs = ET.SubElement(out, "LogCategories")
    ET.SubElement(logs, "Category", name="logStatusError")
    ET.SubElement(out, "DefaultExperiment", startTime="0", stopTime="60", stepSize="0.01")
    listed = ET.SubElement(out, "ModelVariables")
    types = _TYPES[version]
    time = {"name": "time", "valueReference": "0", "causality": "independent", "variability": "continuous"}
    if version == "3.0":
        ET.SubElement(listed, types[REAL], time, unit="s")
    else:
        ET.SubElement(ET.SubElement(listed, "ScalarVariable", time), types[REAL], unit="s")
    for i, v in enumerate(variables, 1):
        if version == "3.0":
            ET.SubElement(listed, types[v.kind], {**_attributes(v, i), **_of_type(v)})
        else:
            ET.SubElement(ET.SubElement(listed, "ScalarVariable", _attributes(v, i)), types[v.kind], _of_type(v))
    structure = ET.SubElement(out, "ModelStructure")
    outputs = [i for i, v in enumerate(variables, 1) if v.role == OUTPUT]
    if version == "3.0":
        for what in ("Output", "InitialUnknown"):
            for i in outputs:
                ET.SubElement(structure, what, valueReference=str(i))
    else:
        for what in ("Outputs", "InitialUnknowns"):
            unknowns = ET.SubElement(structure, what)
            for i in outputs:
                ET.SubElement(unknowns, "Unknown", index=str(i + 1))
    return _bytes(out)


def build_description(identifier: str) -> bytes:
    """Return sources/buildDescription.xml of FMI 3.0."""
    out = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(out, "BuildConfiguration", modelIdentifier=identifier)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99", compilerOptions=OPTIONS)
    for file in SOURCES["3.0"]:
        ET.SubElement(files, "SourceFile", name=file)
    ET.SubElement(configuration, "Library", name="m")
    return _bytes(out)


def _bytes(root: ET.Element) -> bytes:
    ET.indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="utf-8") + b"\n"
