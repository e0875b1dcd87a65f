"""The description of an FMU: modelDescription.xml for FMI 3.0 and 2.0, buildDescription.xml."""

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
    """The asset and program of an FMU, and the token that ties its parts together."""

    name: str  # for people
    identifier: str  # the name in a form valid for C and file systems
    origin: str  # where the data set is from, in words
    program: str
    token: str


def model_description(
    component: Component, identity: Identity, version: int, files: Sequence[str]
) -> bytes:
    """modelDescription.xml; ``files`` are the sources to compile."""
    return as_xml(_fmi3(component, identity) if version == 3 else _fmi2(component, identity, files))


def build_description(identity: Identity, files: Sequence[str]) -> bytes:
    """sources/buildDescription.xml of FMI 3.0."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    build = SubElement(root, "BuildConfiguration", modelIdentifier=identity.identifier)
    file_set = SubElement(build, "SourceFileSet", language="C99")
    for file in files:
        SubElement(file_set, "SourceFile", name=file)
    SubElement(build, "Library", name="m", external="true", description="mathematics")
    return as_xml(root)


def as_xml(root: Element) -> bytes:
    """An XML document, indented for people."""
    indent(root)
    text: bytes = tostring(root, encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


def units(names: Sequence[str], parent: Element, tag: str = "", *, shown: bool = True) -> None:
    """Declare units by name; ``tag`` is the namespace."""
    for name in sorted(set(names) - {""}):
        unit = SubElement(parent, f"{tag}Unit", name=name)
        base = {kind: str(exponent) for kind, exponent in UNITS[name].base.items()}
        SubElement(unit, f"{tag}BaseUnit", base | _factor(UNITS[name].factor))
        for display_name, factor in UNITS[name].shown.items() if shown else ():
            SubElement(unit, "DisplayUnit", {"name": display_name} | _factor(factor))


def number(value: float) -> str:
    """A number to the last bit."""
    return repr(float(value))


def _factor(factor: float) -> dict[str, str]:
    return {} if factor == 1.0 else {"factor": number(factor)}


def _common(component: Component, identity: Identity) -> dict[str, str]:
    scope = "with the vessel inside" if component.where == "inside" else "with a port for a vessel"
    sentences = [WORDS, scope, f"data: {identity.origin}"]
    sentences += [component.remark] if component.remark else []
    return {
        "modelName": identity.name,
        "description": "; ".join(sentences),
        "license": LICENSE,
        "generationTool": identity.program,
        "variableNamingConvention": "structured",
    }


def _experiment(root: Element) -> None:
    categories = SubElement(root, "LogCategories")
    SubElement(
        categories, "Category", name="logStatusError", description="what was refused, and why"
    )
    SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="10.0", stepSize=number(MS))


def _bounds(variable: Variable) -> dict[str, str]:
    """Bounds of a variable that may be set; outputs have none."""
    if variable.is_output or variable.truth:
        return {}
    to_text = (lambda value: str(int(value))) if variable.choices else number
    bounds = {"min": variable.low, "max": variable.high}
    return {key: to_text(value) for key, value in bounds.items() if math.isfinite(value)}


def _start(variable: Variable) -> str:
    if variable.truth:
        return "true" if variable.start else "false"
    return str(int(variable.start)) if variable.choices else number(variable.start)


def _measure(variable: Variable) -> dict[str, str]:
    return ({"unit": variable.unit} if variable.unit else {}) | (
        {"displayUnit": variable.shown} if variable.shown else {}
    )


def _head(variable: Variable, reference: int) -> dict[str, str]:
    causality, variability = variable.role.value
    attributes = {
        "name": variable.name,
        "valueReference": str(reference),
        "description": variable.words,
    }
    attributes |= {"causality": causality, "variability": variability}
    return attributes | ({"initial": "calculated"} if variable.is_output else {})


# --- FMI 3.0 ------------------------------------------------------------------------------------


def _fmi3(component: Component, identity: Identity) -> Element:
    attributes = {"fmiVersion": "3.0", "instantiationToken": identity.token} | _common(
        component, identity
    )
    root = Element("fmiModelDescription", attributes)
    SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identity.identifier,
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
        canHandleVariableCommunicationStepSize="true",
        fixedInternalStepSize=number(MS),
    )
    units(
        [*(variable.unit for variable in component.variables), "s"],
        SubElement(root, "UnitDefinitions"),
    )
    types = SubElement(root, "TypeDefinitions")
    for variable in component.variables:
        if variable.choices:
            kind = SubElement(types, "EnumerationType", name=variable.type_name)
            for name, value in variable.choices.items():
                SubElement(kind, "Item", name=name, value=str(value))
    _experiment(root)
    variables = SubElement(root, "ModelVariables")
    for reference, variable in enumerate(component.variables):
        _variable3(variables, variable, reference)
    time = {"name": "time", "valueReference": str(len(component.variables))}
    time |= {"causality": "independent", "variability": "continuous", "unit": "s"}
    SubElement(variables, "Float64", time)
    structure = SubElement(root, "ModelStructure")
    outputs = [str(n) for n, variable in enumerate(component.variables) if variable.is_output]
    for output in outputs:  # no output depends directly on an input
        SubElement(structure, "Output", valueReference=output, dependencies="")
    for output in outputs:
        SubElement(structure, "InitialUnknown", valueReference=output)
    return root


def _variable3(variables: Element, variable: Variable, reference: int) -> None:
    attributes = _head(variable, reference)
    start = {} if variable.is_output else {"start": _start(variable)}
    if variable.truth:
        SubElement(variables, "Boolean", attributes | start)
    elif variable.choices:
        kind = {"declaredType": variable.type_name}
        SubElement(variables, "Enumeration", attributes | kind | _bounds(variable) | start)
    else:
        SubElement(
            variables, "Float64", attributes | _measure(variable) | _bounds(variable) | start
        )


# --- FMI 2.0 ------------------------------------------------------------------------------------


def _fmi2(component: Component, identity: Identity, files: Sequence[str]) -> Element:
    attributes = {"fmiVersion": "2.0", "guid": identity.token} | _common(component, identity)
    root = Element("fmiModelDescription", attributes)
    simulation = SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identity.identifier,
        canHandleVariableCommunicationStepSize="true",
        canNotUseMemoryManagementFunctions="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    listed = SubElement(simulation, "SourceFiles")
    for file in files:
        SubElement(listed, "File", name=file)
    units([variable.unit for variable in component.variables], SubElement(root, "UnitDefinitions"))
    types = SubElement(root, "TypeDefinitions")
    for variable in component.variables:
        if variable.choices:
            kind = SubElement(
                SubElement(types, "SimpleType", name=variable.type_name), "Enumeration"
            )
            for name, value in variable.choices.items():
                SubElement(kind, "Item", name=name, value=str(value))
    _experiment(root)
    variables = SubElement(root, "ModelVariables")
    for reference, variable in enumerate(component.variables):
        _variable2(SubElement(variables, "ScalarVariable", _head(variable, reference)), variable)
    structure = SubElement(root, "ModelStructure")
    outputs = [str(n) for n, variable in enumerate(component.variables, 1) if variable.is_output]
    listed = SubElement(structure, "Outputs")
    for index in outputs:
        SubElement(listed, "Unknown", index=index, dependencies="")
    listed = SubElement(structure, "InitialUnknowns")
    for index in outputs:
        SubElement(listed, "Unknown", index=index)
    return root


def _variable2(parent: Element, variable: Variable) -> None:
    start = {} if variable.is_output else {"start": _start(variable)}
    if variable.truth:
        SubElement(parent, "Boolean", start)
    elif variable.choices:
        kind = {"declaredType": variable.type_name}
        SubElement(parent, "Enumeration", kind | _bounds(variable) | start)
    else:
        SubElement(parent, "Real", _measure(variable) | _bounds(variable) | start)
