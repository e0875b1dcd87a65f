"""An SSP package: a system structure with the FMU, and parameter sets of the type and the unit.

In SSP 1.0 the later one of several parameter bindings of a component holds.
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
    """The package: ``unit`` is the component of the FMU, ``kind`` that of its type."""
    resource = f"resources/{fmu.name}"
    return packed(
        {
            "SystemStructure.ssd": _structure(name, resource, unit),
            resource: fmu.content,
            TYPE: parameter_set(f"{name}: its type", _shared(kind, unit)),
            UNIT: parameter_set(f"{name}: the unit itself", overlay(unit, kind)),
        }
    )


def overlay(unit: Component, kind: Component) -> Sequence[Variable]:
    """The parameters in which a unit differs from its type."""
    type_start = {parameter.name: parameter.start for parameter in kind.parameters}
    return [
        parameter
        for parameter in unit.parameters
        if parameter.start != type_start.get(parameter.name)
    ]


def _shared(kind: Component, unit: Component) -> Sequence[Variable]:
    """The parameters of a type that the unit's FMU has as well."""
    names = {parameter.name for parameter in unit.parameters}
    return [parameter for parameter in kind.parameters if parameter.name in names]


def parameter_set(name: str, parameters: Sequence[Variable]) -> bytes:
    """A parameter set (``.ssv``)."""
    root = Element("ssv:ParameterSet", _spaces("ssv", "ssc") | {"version": "1.0", "name": name})
    listed = SubElement(root, "ssv:Parameters")
    for variable in parameters:
        parameter = SubElement(listed, "ssv:Parameter", name=variable.name)
        if variable.choices:
            choice = next(
                label for label, value in variable.choices.items() if value == variable.start
            )
            kind = {"value": choice, "name": variable.type_name}
            SubElement(parameter, "ssv:Enumeration", kind)
        else:
            measure = {"unit": variable.unit} if variable.unit else {}
            SubElement(parameter, "ssv:Real", {"value": number(variable.start)} | measure)
    _enumerations(root, "ssv:", parameters)
    _units(root, "ssv:", parameters)
    return as_xml(root)


def _structure(name: str, resource: str, component: Component) -> bytes:
    attributes = _spaces("ssd", "ssc") | {"version": "1.0", "name": name}
    root = Element("ssd:SystemStructureDescription", attributes)
    system = SubElement(root, "ssd:System", name="system")
    ports = [port for port in component.variables if not port.is_parameter]
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
    for source in (TYPE, UNIT):  # the later binding holds
        kind = "application/x-ssp-parameter-set"
        SubElement(bindings, "ssd:ParameterBinding", type=kind, source=source)
    connections = SubElement(system, "ssd:Connections")
    for port in ports:
        inner = {"Element": ELEMENT, "Connector": port.name}
        outer = {"Connector": port.name}
        start, end = (inner, outer) if port.is_output else (outer, inner)
        ends = {f"start{key}": value for key, value in start.items()}
        ends |= {f"end{key}": value for key, value in end.items()}
        SubElement(connections, "ssd:Connection", ends)
    _enumerations(root, "ssd:", ports)
    _units(root, "ssd:", ports)
    SubElement(root, "ssd:DefaultExperiment", startTime="0.0", stopTime="10.0")
    return as_xml(root)


def _connectors(parent: Element, ports: Sequence[Variable]) -> None:
    listed = SubElement(parent, "ssd:Connectors")
    for port in ports:
        kind = "output" if port.is_output else "input"
        connector = SubElement(listed, "ssd:Connector", name=port.name, kind=kind)
        if port.truth:
            SubElement(connector, "ssc:Boolean")
        elif port.choices:
            SubElement(connector, "ssc:Enumeration", name=port.type_name)
        else:
            SubElement(connector, "ssc:Real", unit=port.unit)


def _enumerations(root: Element, tag: str, variables: Sequence[Variable]) -> None:
    enumerations = [variable for variable in variables if variable.choices]
    listed = SubElement(root, f"{tag}Enumerations") if enumerations else root
    for variable in enumerations:
        kind = SubElement(listed, "ssc:Enumeration", name=variable.type_name)
        for label, value in (variable.choices or {}).items():
            SubElement(kind, "ssc:Item", name=label, value=str(value))


def _units(root: Element, tag: str, variables: Sequence[Variable]) -> None:
    names = [variable.unit for variable in variables if variable.unit]
    if names:
        units(names, SubElement(root, f"{tag}Units"), "ssc:", shown=False)


def _spaces(*prefixes: str) -> dict[str, str]:
    return {key: _SPACES[key] for key in (f"xmlns:{prefix}" for prefix in prefixes)}
