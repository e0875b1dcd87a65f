"""Nodes of our own OPC UA server: quantities with unit and range, states with names."""

from collections.abc import Sequence
from dataclasses import dataclass

from asyncua import Node, Server, ua
from asyncua.common.instantiate_util import instantiate

UNECE = "http://www.opcfoundation.org/UA/units/un/cefact"
Names = tuple[ua.NodeId, ua.QualifiedName]


@dataclass(frozen=True)
class Unit:
    """An engineering unit: its UNECE common code ("" where there is none) and symbol."""

    code: str
    symbol: str

    @property
    def information(self) -> ua.EUInformation:
        """The unit for OPC UA: the code's bytes are its number (OPC 10000-8)."""
        return ua.EUInformation(
            NamespaceUri=UNECE if self.code else "",
            UnitId=int.from_bytes(self.code.encode(), "big") if self.code else -1,
            DisplayName=ua.LocalizedText(self.symbol),
            Description=ua.LocalizedText(self.symbol),
        )


async def add_quantity(
    server: Server,
    group: Node,
    names: Names,
    unit: Unit,
    span: tuple[float, float],
    kind: ua.NodeId,
) -> Node:
    """Add an AnalogItem below ``group`` whose value is of the data type ``kind``."""
    node = await _add(server, group, names, ua.ObjectIds.AnalogItemType)
    await node.write_attribute(ua.AttributeIds.DataType, ua.DataValue(kind))
    await (await node.get_child("0:EURange")).write_value(ua.Range(*span))
    units = ua.NodeId(f"{names[0].Identifier}.EngineeringUnits", names[0].NamespaceIndex)
    await node.add_property(units, ua.QualifiedName("EngineeringUnits"), unit.information)
    return node


async def add_state(server: Server, group: Node, names: Names, states: Sequence[str]) -> Node:
    """Add a MultiStateDiscrete below ``group``: a UInt32 that counts in ``states``."""
    node = await _add(server, group, names, ua.ObjectIds.MultiStateDiscreteType)
    await node.write_attribute(
        ua.AttributeIds.DataType, ua.DataValue(ua.NodeId(ua.ObjectIds.UInt32))
    )
    texts = [ua.LocalizedText(state) for state in states]
    await (await node.get_child("0:EnumStrings")).write_value(texts)
    return node


async def _add(server: Server, group: Node, names: Names, kind: int) -> Node:
    """Add a node of type ``kind``, without the optional nodes of its type."""
    node, *_ = await instantiate(
        group,
        server.get_node(kind),
        *names,
        idx=names[0].NamespaceIndex,
        instantiate_optional=False,
    )
    return node
