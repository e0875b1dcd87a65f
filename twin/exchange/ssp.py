"""A system structure with the FMU in it, and parameter sets: the type's, and over it the unit's.

SSP 1.0: of several parameter bindings of a component the later one holds.
"""

from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement

from twin.exchange.description import as_xml, number, units
from twin.exchange.fmu import Fmu, packed
from twin.exchange.variables import Component, Variable

_SPACE = "http://ssp-standard.org/SSP1/SystemStructure"
_SPACES = {
    "xmlns:ssd": f"{_SPACE}Description",
    "xmlns:ssc": f"{_SPACE}Common",
    "xmlns:ssv": f"{_SPACE}ParameterValues",
}
TYPE, UNIT = "resources/type.ssv", "resources/unit.ssv"
ELEMENT = "ejector"


def make_ssp(fmu: Fmu, name: str, unit: Component, kind: Component) -> bytes:
    """The package: ``unit`` is the component of the FMU, ``kind`` the same as its type has it."""
    resource = f"resources/{fmu.name}"
    return packed(
        {
            "SystemStructure.ssd": _structure(name, resource, unit),
            resource: fmu.content,
            TYPE: parameter_set(f"{name}: its type", kind.parameters),
            UNIT: parameter_set(f"{name}: the unit itself", overlay(unit, kind)),
        }
    )


def overlay(unit: Component, kind: Component) -> Sequence[Variable]:
    """The parameters in which a unit differs from its type."""
    below = {one.name: one.start for one in kind.parameters}
    return [one for one in unit.parameters if one.start != below[one.name]]


def parameter_set(name: str, parameters: Sequence[Variable]) -> bytes:
    """A parameter set (``.ssv``)."""
    root = Element("ssv:ParameterSet", _spaces("ssv", "ssc") | {"version": "1.0", "name": name})
    listed = SubElement(root, "ssv:Parameters")
    for one in parameters:
        parameter = SubElement(listed, "ssv:Parameter", name=one.name)
        if one.choices:
            chosen = next(word for word, value in one.choices.items() if value == one.start)
            kind = {"value": chosen, "name": one.type_name}
            SubElement(parameter, "ssv:Enumeration", kind)
        else:
            measure = {"unit": one.unit} if one.unit else {}
            SubElement(parameter, "ssv:Real", {"value": number(one.start)} | measure)
    _enumerations(root, "ssv:", parameters)
    _units(root, "ssv:", parameters)
    return as_xml(root)


def _structure(name: str, resource: str, component: Component) -> bytes:
    head = _spaces("ssd", "ssc") | {"version": "1.0", "name": name}
    root = Element("ssd:SystemStructureDescription", head)
    system = SubElement(root, "ssd:System", name="system")
    ports = [one for one in component.variables if not one.is_parameter]
    _connectors(system, ports)
    elements = SubElement(system, "ssd:Elements")
    element = SubElement(
        elements,
        "ssd:Component",
        name=ELEMENT,
        type="application/x-fmu-sharedlibrary",
        source=resource,
        implementation="CoSimulation",
    )
    _connectors(element, ports)
    bindings = SubElement(element, "ssd:ParameterBindings")
    for source in (TYPE, UNIT):  # the later one holds
        kind = "application/x-ssp-parameter-set"
        SubElement(bindings, "ssd:ParameterBinding", type=kind, source=source)
    connections = SubElement(system, "ssd:Connections")
    for one in ports:
        inner = {"Element": ELEMENT, "Connector": one.name}
        outer = {"Connector": one.name}
        start, end = (inner, outer) if one.is_output else (outer, inner)
        ends = {f"start{key}": value for key, value in start.items()}
        ends |= {f"end{key}": value for key, value in end.items()}
        SubElement(connections, "ssd:Connection", ends)
    _enumerations(root, "ssd:", ports)
    _units(root, "ssd:", ports)
    SubElement(root, "ssd:DefaultExperiment", startTime="0.0", stopTime="10.0")
    return as_xml(root)


def _connectors(parent: Element, ports: Sequence[Variable]) -> None:
    listed = SubElement(parent, "ssd:Connectors")
    for one in ports:
        kind = "output" if one.is_output else "input"
        connector = SubElement(listed, "ssd:Connector", name=one.name, kind=kind)
        if one.truth:
            SubElement(connector, "ssc:Boolean")
        elif one.choices:
            SubElement(connector, "ssc:Enumeration", name=one.type_name)
        else:
            SubElement(connector, "ssc:Real", unit=one.unit)


def _enumerations(root: Element, tag: str, variables: Sequence[Variable]) -> None:
    chosen = [one for one in variables if one.choices]
    listed = SubElement(root, f"{tag}Enumerations") if chosen else root
    for one in chosen:
        kind = SubElement(listed, "ssc:Enumeration", name=one.type_name)
        for word, value in (one.choices or {}).items():
            SubElement(kind, "ssc:Item", name=word, value=str(value))


def _units(root: Element, tag: str, variables: Sequence[Variable]) -> None:
    names = [one.unit for one in variables if one.unit]
    if names:
        units(names, SubElement(root, f"{tag}Units"), "ssc:", shown=False)


def _spaces(*prefixes: str) -> dict[str, str]:
    return {key: _SPACES[key] for key in (f"xmlns:{prefix}" for prefix in prefixes)}
