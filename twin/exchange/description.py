"""What an FMU says of itself: modelDescription.xml for FMI 3.0 and 2.0, buildDescription.xml."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from twin.exchange.units import UNITS
from twin.exchange.variables import Component, Variable
from twin.signals import MS

WORDS = "Pneumatic vacuum ejector with its line and vessel, as its digital twin simulates it"
LICENSE = "Apache-2.0"


@dataclass(frozen=True)
class Identity:
    """Of which asset an FMU is, by which program, and what ties its parts together."""

    name: str  # as people call it
    identifier: str  # the same as C and file systems take it
    origin: str  # where the data set is from, in words
    program: str
    token: str


def model_description(
    component: Component, who: Identity, version: int, files: Sequence[str]
) -> bytes:
    """modelDescription.xml; ``files`` are the sources to compile."""
    return as_xml(_fmi3(component, who) if version == 3 else _fmi2(component, who, files))


def build_description(who: Identity, files: Sequence[str]) -> bytes:
    """sources/buildDescription.xml of FMI 3.0."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    build = SubElement(root, "BuildConfiguration", modelIdentifier=who.identifier)
    together = SubElement(build, "SourceFileSet", language="C99")
    for file in files:
        SubElement(together, "SourceFile", name=file)
    SubElement(build, "Library", name="m", external="true", description="mathematics")
    return as_xml(root)


def as_xml(root: Element) -> bytes:
    """A document, for people to read as well."""
    indent(root)
    text: bytes = tostring(root, encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


def units(names: Sequence[str], parent: Element, tag: str = "", *, shown: bool = True) -> None:
    """Declare units by name; ``tag`` is the namespace."""
    for name in sorted(set(names) - {""}):
        unit = SubElement(parent, f"{tag}Unit", name=name)
        base = {kind: str(exponent) for kind, exponent in UNITS[name].base.items()}
        SubElement(unit, f"{tag}BaseUnit", base | _factor(UNITS[name].factor))
        for other, factor in UNITS[name].shown.items() if shown else ():
            SubElement(unit, "DisplayUnit", {"name": other} | _factor(factor))


def number(value: float) -> str:
    """A number to the last bit."""
    return repr(float(value))


def _factor(factor: float) -> dict[str, str]:
    return {} if factor == 1.0 else {"factor": number(factor)}


def _common(component: Component, who: Identity) -> dict[str, str]:
    where = "with the vessel inside" if component.where == "inside" else "with a port for a vessel"
    return {
        "modelName": who.name,
        "description": f"{WORDS}; {where}; data: {who.origin}",
        "license": LICENSE,
        "generationTool": who.program,
        "variableNamingConvention": "structured",
    }


def _experiment(root: Element) -> None:
    categories = SubElement(root, "LogCategories")
    SubElement(
        categories, "Category", name="logStatusError", description="what was refused, and why"
    )
    SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="10.0", stepSize=number(MS))


def _bounds(one: Variable) -> dict[str, str]:
    """Bounds of what may be set; what is read is as it is."""
    if one.is_output or one.truth:
        return {}
    form = (lambda value: str(int(value))) if one.choices else number
    known = {"min": one.low, "max": one.high}
    return {key: form(value) for key, value in known.items() if math.isfinite(value)}


def _start(one: Variable) -> str:
    if one.truth:
        return "true" if one.start else "false"
    return str(int(one.start)) if one.choices else number(one.start)


def _measure(one: Variable) -> dict[str, str]:
    return ({"unit": one.unit} if one.unit else {}) | (
        {"displayUnit": one.shown} if one.shown else {}
    )


def _head(one: Variable, reference: int) -> dict[str, str]:
    causality, variability = one.role.value
    head = {"name": one.name, "valueReference": str(reference), "description": one.words}
    head |= {"causality": causality, "variability": variability}
    return head | ({"initial": "calculated"} if one.is_output else {})


# --- FMI 3.0 ------------------------------------------------------------------------------------


def _fmi3(component: Component, who: Identity) -> Element:
    head = {"fmiVersion": "3.0", "instantiationToken": who.token} | _common(component, who)
    root = Element("fmiModelDescription", head)
    SubElement(
        root,
        "CoSimulation",
        modelIdentifier=who.identifier,
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
        canHandleVariableCommunicationStepSize="true",
        fixedInternalStepSize=number(MS),
    )
    units([*(one.unit for one in component.variables), "s"], SubElement(root, "UnitDefinitions"))
    types = SubElement(root, "TypeDefinitions")
    for one in component.variables:
        if one.choices:
            kind = SubElement(types, "EnumerationType", name=one.type_name)
            for name, value in one.choices.items():
                SubElement(kind, "Item", name=name, value=str(value))
    _experiment(root)
    variables = SubElement(root, "ModelVariables")
    for reference, one in enumerate(component.variables):
        _variable3(variables, one, reference)
    time = {"name": "time", "valueReference": str(len(component.variables))}
    time |= {"causality": "independent", "variability": "continuous", "unit": "s"}
    SubElement(variables, "Float64", time)
    structure = SubElement(root, "ModelStructure")
    outputs = [str(n) for n, one in enumerate(component.variables) if one.is_output]
    for output in outputs:  # nothing passes through at once
        SubElement(structure, "Output", valueReference=output, dependencies="")
    for output in outputs:
        SubElement(structure, "InitialUnknown", valueReference=output)
    return root


def _variable3(variables: Element, one: Variable, reference: int) -> None:
    head = _head(one, reference)
    start = {} if one.is_output else {"start": _start(one)}
    if one.truth:
        SubElement(variables, "Boolean", head | start)
    elif one.choices:
        kind = {"declaredType": one.type_name}
        SubElement(variables, "Enumeration", head | kind | _bounds(one) | start)
    else:
        SubElement(variables, "Float64", head | _measure(one) | _bounds(one) | start)


# --- FMI 2.0 ------------------------------------------------------------------------------------


def _fmi2(component: Component, who: Identity, files: Sequence[str]) -> Element:
    head = {"fmiVersion": "2.0", "guid": who.token} | _common(component, who)
    root = Element("fmiModelDescription", head)
    simulation = SubElement(
        root,
        "CoSimulation",
        modelIdentifier=who.identifier,
        canHandleVariableCommunicationStepSize="true",
        canNotUseMemoryManagementFunctions="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    listed = SubElement(simulation, "SourceFiles")
    for file in files:
        SubElement(listed, "File", name=file)
    units([one.unit for one in component.variables], SubElement(root, "UnitDefinitions"))
    types = SubElement(root, "TypeDefinitions")
    for one in component.variables:
        if one.choices:
            kind = SubElement(SubElement(types, "SimpleType", name=one.type_name), "Enumeration")
            for name, value in one.choices.items():
                SubElement(kind, "Item", name=name, value=str(value))
    _experiment(root)
    variables = SubElement(root, "ModelVariables")
    for reference, one in enumerate(component.variables):
        _variable2(SubElement(variables, "ScalarVariable", _head(one, reference)), one)
    structure = SubElement(root, "ModelStructure")
    outputs = [str(n) for n, one in enumerate(component.variables, 1) if one.is_output]
    listed = SubElement(structure, "Outputs")
    for index in outputs:
        SubElement(listed, "Unknown", index=index, dependencies="")
    listed = SubElement(structure, "InitialUnknowns")
    for index in outputs:
        SubElement(listed, "Unknown", index=index)
    return root


def _variable2(variable: Element, one: Variable) -> None:
    start = {} if one.is_output else {"start": _start(one)}
    if one.truth:
        SubElement(variable, "Boolean", start)
    elif one.choices:
        kind = {"declaredType": one.type_name}
        SubElement(variable, "Enumeration", kind | _bounds(one) | start)
    else:
        SubElement(variable, "Real", _measure(one) | _bounds(one) | start)
