"""OPC UA over the trace: an address space whose values come from the newest scans."""

import logging
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from asyncua import Node, Server, ua
from asyncua.common.utils import ServiceError

from drivers.opcua.security import GuardedServer, authenticator_of, secure
from drivers.outputs.nodes import Unit, add_quantity
from drivers.plc.opcua_server import Behaviour
from drivers.plc.partner import Written
from drivers.plc.registers import Registers
from drivers.plc.scan import DEPTH, OVERFLOW, PERIOD_NS, REPORTED, Scans
from drivers.plc.settings import OpcuaServer, PlcSettings
from twin.errors import ConfigError, SourceError
from twin.signals import Command

# The library logs clients that hang up as errors; what stops the PLC is raised as well.
logging.getLogger("asyncua").setLevel(logging.CRITICAL)
_log = logging.getLogger(__name__)

NAMESPACE = "urn:ejector-twin:plc"
APPLICATION = "urn:ejector-twin:simulated-plc"
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

Type = ua.VariantType
Read = Callable[[], ua.DataValue]


MBAR = Unit("MBR", "mbar")
MILLISECOND = Unit("C26", "ms")


class Memory:
    """The PLC's memory as OPC UA values; each read shows the scans up to now."""

    def __init__(self, registers: Registers, catch_up: Callable[[], None], depth: int) -> None:
        opcua = registers.task.settings.opcua
        self.prefix = opcua.prefix if opcua else ""
        self._task = registers.task
        self.partner = registers.partner
        self._registers = registers
        self._boot = registers.boot
        self.catch_up = catch_up
        self._depth = depth

    @property
    def newest(self) -> int:
        """Sequence of the newest scan."""
        return self._task.newest

    def time(self, sequence: int) -> datetime:
        """PLC time of a scan, to the microsecond: the library keeps no more."""
        return EPOCH + timedelta(
            microseconds=(self._registers.start_ns + sequence * PERIOD_NS) // 1000
        )

    def value(self, name: str, sequence: int) -> ua.DataValue:
        """One value of one scan, stamped with its time."""
        variant = OF_SCANS[name](self._task.ring[sequence % DEPTH])
        return ua.DataValue(Value=variant, SourceTimestamp=self.time(sequence))

    def trace(self, name: str) -> ua.DataValue:
        """One of the trace's values."""
        variant = TRACE[name](self)
        return ua.DataValue(Value=variant, SourceTimestamp=self.time(self.newest))

    def command(self, bit: Command, on: bool) -> None:
        """Take a client's command; it counts if the program takes commands from coils."""
        coils = self._task.coils
        self._task.coils = coils | bit if on else coils & ~bit

    def reader(self, name: str) -> Read:
        """The function that answers a client's read of a node."""

        def read() -> ua.DataValue:
            self.catch_up()
            return self.trace(name) if name in TRACE else self.value(name, self.newest)

        return read

    @property
    def header(self) -> Mapping[str, ua.Variant]:
        """The trace's header: newest sequence, its time, boot counter and period."""
        newest = self.newest
        return {
            "Trace.Sequence": ua.Variant(newest & 0xFFFFFFFF, Type.UInt32),
            "Trace.Time": ua.Variant(self._registers.start_ns + newest * PERIOD_NS, Type.UInt64),
            "Trace.Boot": ua.Variant(self._boot, Type.UInt16),
            "Trace.Period": ua.Variant(PERIOD_NS // 1000, Type.UInt16),
        }

    def ring(self) -> Scans:
        """The newest scans: scan s at s mod depth; zeros before the first scan."""
        newest = self.newest
        slots = np.arange(self._depth)
        return self._task.ring[(newest - (newest - slots) % self._depth) % DEPTH]


def _bit(bit: int) -> Callable[[np.void], ua.Variant]:
    return lambda scan: ua.Variant(bool(int(scan["status"]) & bit), Type.Boolean)


def _column(field: str, kind: ua.VariantType) -> Callable[[Memory], ua.Variant]:
    return lambda memory: ua.Variant(memory.ring()[field].tolist(), kind, is_array=True)


def _header(name: str) -> Callable[[Memory], ua.Variant]:
    return lambda memory: memory.header[name]


MEASURED: dict[str, Callable[[np.void], ua.Variant]] = {
    "Cmd.Suction": _bit(Command.SUCTION),
    "Cmd.BlowOff": _bit(Command.BLOW_OFF),
    "Meas.Pressure": lambda scan: ua.Variant(float(scan["pressure"]), Type.Float),
    "Meas.Supply": lambda scan: ua.Variant(int(scan["supply"]), Type.Int16),
    "Meas.Overflow": _bit(OVERFLOW),
}
REPORTS: dict[str, Callable[[np.void], ua.Variant]] = {  # with reports.bits
    "Meas.Nozzle": _bit(1 << REPORTED),
    "Meas.AirSaving": _bit(2 << REPORTED),
    "Meas.PartPresent": _bit(4 << REPORTED),
}
VALUES: dict[str, Callable[[np.void], ua.Variant]] = {  # with reports.values
    "Meas.Ambient": lambda scan: ua.Variant(float(scan["ambient"]) / 10, Type.Float),
    "Meas.Temperature": lambda scan: ua.Variant(float(scan["temperature"]) / 10, Type.Float),
    "Meas.Pressure2": lambda scan: ua.Variant(float(scan["vessel"]), Type.Float),
    "Meas.Flow": lambda scan: ua.Variant(float(scan["flow"]), Type.Float),
}
OF_SCANS = MEASURED | REPORTS | VALUES
TRACE: dict[str, Callable[[Memory], ua.Variant]] = {
    "Trace.Sequence": _header("Trace.Sequence"),
    "Trace.Time": _header("Trace.Time"),
    "Trace.Boot": _header("Trace.Boot"),
    "Trace.Period": _header("Trace.Period"),
    "Trace.Sequences": lambda memory: ua.Variant(
        (memory.ring()["sequence"] & 0xFFFFFFFF).tolist(), Type.UInt32, is_array=True
    ),
    "Trace.Statuses": _column("status", Type.UInt16),
    "Trace.Pressures": _column("pressure", Type.Float),
}
WRITTEN = {  # by a twin that answers the program
    "Hil.Pressure": ("pressure", Type.Float),  # mbar, absolute
    "Hil.PartPresent": ("part_present", Type.Boolean),
    "Hil.AirSaving": ("air_saving", Type.Boolean),
    "Hil.Watchdog": ("watchdog", Type.UInt16),
}
KINDS: dict[ua.VariantType, Callable[[Any], Any]] = {
    Type.Float: float,
    Type.Boolean: bool,
    Type.UInt16: int,
}
RANGES: dict[str, tuple[Unit, float, float]] = {
    "Meas.Pressure": (MBAR, 0.0, 2000.0),  # absolute
    "Meas.Supply": (MBAR, 0.0, 10_000.0),  # gauge
    "Meas.Ambient": (MBAR, 500.0, 1200.0),  # absolute
    "Meas.Temperature": (Unit("CEL", "°C"), -40.0, 100.0),
    "Meas.Pressure2": (MBAR, 0.0, 2000.0),  # absolute
    "Meas.Flow": (Unit("L2", "l/min"), -2000.0, 2000.0),  # standard litres
}


def served_of(settings: PlcSettings) -> tuple[str, ...]:
    """Names of the values that are served of each scan."""
    reports = settings.reports
    bits = tuple(REPORTS) if reports.bits else ()
    return (*MEASURED, *bits, *(VALUES if reports.values else ()))


@asynccontextmanager
async def serving(
    memories: Sequence[Registers], settings: OpcuaServer, catch_up: Callable[[], None]
) -> AsyncIterator["Serving"]:
    """Serve OPC UA while the context lasts. SourceError if the address is not available."""
    served = [Memory(registers, catch_up, settings.trace_depth) for registers in memories]
    pairs = [
        (memory, name)
        for memory, registers in zip(served, memories, strict=True)
        for name in served_of(registers.task.settings)
    ]
    named = {f"{memory.prefix}{name}": (memory, name) for memory, name in pairs}
    if len(named) < len(pairs):
        raise ConfigError("two ejectors have the same nodes", "set prefix under [plc.opcua]")

    def value(node: str, sequence: int) -> ua.DataValue:
        memory, name = named[node]
        return memory.value(name, sequence)

    server = Server(GuardedServer())
    await server.init()
    server.set_endpoint(f"opc.tcp://{settings.host}:{settings.port}/")
    server.set_server_name("ejector-twin simulated PLC")
    await server.set_application_uri(APPLICATION)
    authenticator = authenticator_of(settings.users, _log.warning)
    await secure(server, settings, authenticator, _log.warning)
    index = await _namespace(server, settings.namespace_index)
    for memory, registers in zip(served, memories, strict=True):
        await _AddressSpace(server, index, memory).build(registers.task.settings)
    behaviour = Behaviour(server, settings, value, set(named), lambda: served[0].newest)
    try:
        await server.start()
    except OSError as error:
        raise SourceError(
            f"cannot listen on {settings.host}:{settings.port} (OPC UA)",
            "take another port under [plc.opcua], or 0 for any free one",
        ) from error
    try:
        yield Serving(server, behaviour)
    finally:
        await server.stop()


@dataclass(frozen=True)
class Serving:
    """A running server."""

    server: Server
    behaviour: Behaviour

    @property
    def url(self) -> str:
        """The address for clients."""
        binary = self.server.bserver
        assert binary is not None
        return f"opc.tcp://{self.server.endpoint.hostname}:{binary.port}"

    def sample(self) -> None:
        """Give subscribers the values of the scans since the last call."""
        self.behaviour.sample()


async def _namespace(server: Server, index: int) -> int:
    """Register our namespace at ``index``, as in a server that has others too."""
    for number in range(len(await server.get_namespace_array()), index):
        await server.register_namespace(f"urn:ejector-twin:other-{number}")
    return int(await server.register_namespace(NAMESPACE))


class _AddressSpace:
    """Builds the address space; its NodeIds are strings that name the path."""

    def __init__(self, server: Server, index: int, memory: Memory) -> None:
        self._server = server
        self._index = index
        self._memory = memory

    async def build(self, settings: PlcSettings) -> None:
        """Create ``Identification, Cmd, Meas, Param, Trace`` below one object."""
        objects = self._server.get_objects_node()
        root = await objects.add_object(*self._names("Ejector"))
        groups = {
            name: await root.add_object(*self._names(name))
            for name in ("Identification", "Cmd", "Meas", "Param", "Trace")
        }
        await self._add_identification(groups["Identification"])
        for name in (*served_of(settings), *TRACE):
            await self._add_readable(groups[name.partition(".")[0]], name)
        await self._add_parameters(groups["Param"], settings)
        if self._memory.partner is not None:
            group = await root.add_object(*self._names("Hil"))
            for name in WRITTEN:
                await self._add_writable(group, name, self._memory.partner.written)
        if settings.program.commands == "coils":
            for name, bit in (("Cmd.Suction", Command.SUCTION), ("Cmd.BlowOff", Command.BLOW_OFF)):
                await self._add_command(name, bit)

    async def _add_writable(self, group: Node, name: str, written: Written) -> None:
        """Add a value that the twin writes, where it answers the program."""
        field, kind = WRITTEN[name]
        value = ua.Variant(KINDS[kind](getattr(written, field)), kind)
        node = await group.add_variable(*self._names(name), value)
        await node.set_writable()

        def read(_node: object, _attribute: object) -> ua.DataValue:
            return ua.DataValue(ua.Variant(KINDS[kind](getattr(written, field)), kind))

        def write(_node: object, _attribute: object, value: ua.DataValue) -> None:
            if value.Value is None or value.Value.VariantType != kind:
                raise ServiceError(ua.StatusCodes.BadTypeMismatch)
            self._memory.catch_up()
            setattr(written, field, KINDS[kind](value.Value.Value))

        space = self._server.iserver.aspace
        space.set_attribute_value_callback(node.nodeid, ua.AttributeIds.Value, read)
        space.set_attribute_value_setter(node.nodeid, ua.AttributeIds.Value, write)

    def _names(self, name: str) -> tuple[ua.NodeId, ua.QualifiedName]:
        """NodeId and browse name: the last part of the path."""
        last = name.rpartition(".")[2]
        node = ua.NodeId(f"{self._memory.prefix}{name}", self._index)
        return node, ua.QualifiedName(last, self._index)

    async def _add_identification(self, group: Node) -> None:
        texts = {
            "Manufacturer": "ejector-twin",
            "Model": "simulated PLC with a compact ejector",
            "SerialNumber": "0",
        }
        for name, text in texts.items():
            await group.add_variable(*self._names(f"Identification.{name}"), text, Type.String)

    async def _add_readable(self, group: Node, name: str) -> None:
        read = self._memory.reader(name)
        example = read().Value
        assert example is not None
        if name in RANGES:
            node = await self._add_analog(group, name, *RANGES[name], example)
        else:
            kind = example.VariantType
            node = await group.add_variable(*self._names(name), example.Value, kind)
        space = self._server.iserver.aspace
        space.set_attribute_value_callback(
            node.nodeid, ua.AttributeIds.Value, lambda _node, _attribute: read()
        )

    async def _add_analog(
        self, group: Node, name: str, unit: Unit, low: float, high: float, value: ua.Variant
    ) -> Node:
        kind = ua.NodeId(value.VariantType.value)
        node = await add_quantity(self._server, group, self._names(name), unit, (low, high), kind)
        await node.write_value(value)
        return node

    async def _add_parameters(self, group: Node, settings: PlcSettings) -> None:
        program, control = settings.program, settings.control
        values = {
            "SuctionTime": (MILLISECOND, 3.6e6, program.suction_ms),
            "BlowOffTime": (MILLISECOND, 3.6e6, program.blow_off_ms),
            "IdleTime": (MILLISECOND, 3.6e6, program.idle_ms),
            "H1": (MBAR, 998.0, control.h1_mbar),  # vacuum
            "H2": (MBAR, 998.0, control.h2_mbar),  # vacuum
        }
        for name, (unit, high, number) in values.items():
            value = ua.Variant(number, Type.Double)
            await self._add_analog(group, f"Param.{name}", unit, 0.0, high, value)

    async def _add_command(self, name: str, bit: Command) -> None:
        """Let clients write a command, where the program leaves it to them."""
        node = self._server.get_node(self._names(name)[0])
        await node.set_writable()

        def write(_node: object, _attribute: object, value: ua.DataValue) -> None:
            if value.Value is None or value.Value.VariantType != Type.Boolean:
                raise ServiceError(ua.StatusCodes.BadTypeMismatch)
            self._memory.command(bit, bool(value.Value.Value))

        space = self._server.iserver.aspace
        space.set_attribute_value_setter(node.nodeid, ua.AttributeIds.Value, write)
